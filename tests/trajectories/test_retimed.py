"""Plans with another time law: closed forms, composite functions in fifty digits, breakpoints."""

import itertools
import json
import math

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.interpolate import PPoly

from ctrlplan.trajectories import (
    PiecewiseSpline,
    PolySpline,
    Retimed,
    SCurve,
    Step,
    Trapezoid,
    TrigSpline,
    Waypoint,
    stack,
    trajectory_from_dict,
)
from ctrlplan.trajectories.retimed import composed

POINTS = [
    Waypoint.from_jets(1.0, x=[0.0, 1.0, 0.0], z=[1.0, 0.0]),
    Waypoint.from_jets(2.0, x=[2.0], z=[-1.0, 0.5, 0.0]),
    Waypoint.from_jets(4.0, x=[1.0, 0.4, 0.0], z=[3.0, 0.0]),
]
PLANS = {
    "polynomial": PolySpline(POINTS),
    "trigonometric": TrigSpline(POINTS, alpha=2.0),
    "piecewise": PiecewiseSpline(POINTS),
    "profile": SCurve([3.0, 1.0], velocity=1.5, acceleration=2.0, jerk=9.0, time=1.0).retime(3.0),
    "sum": PolySpline(POINTS) + Step([1.0, -2.0], time=2.5),
}
every = pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
SQUARE = PolySpline([Waypoint(1.0, 1.0, 2.0), Waypoint(2.0, 4.0)])
"""t^2 from 1 to 2 s."""


def line(start, end, first, last):
    return PolySpline([Waypoint(start, first), Waypoint(end, last)])


def moments(plan, count=60):
    return np.concatenate([plan.breakpoints, np.linspace(plan.start - 1.0, plan.end + 1.0, count)])


def taylor(function, t, order):
    """Derivatives of a function of mpmath."""
    with mp.workdps(50):
        return np.array(
            [float(c * mp.factorial(k)) for k, c in enumerate(mp.taylor(function, mp.mpf(float(t)), order))]
        )


# Laws in closed form


@every
def test_the_identity_is_the_plan(plan):
    again = Retimed(plan, line(1.0, 4.0, 1.0, 4.0))
    np.testing.assert_allclose(again.breakpoints, plan.breakpoints, rtol=1e-15)
    size = np.abs(plan.jet(moments(plan), 4)).max(axis=2, keepdims=True)
    t = np.setdiff1d(moments(plan), plan.breakpoints)
    for left in (False, True):
        assert (np.abs(again.jet(t, 4, left=left) - plan.jet(t, 4, left=left)) <= 1e-12 * size).all()
        pair = [made.jet(made.breakpoints, 4, left=left) for made in (again, plan)]
        assert (np.abs(pair[0] - pair[1]) <= 1e-12 * size).all()
    assert again.labels == plan.labels


@every
@pytest.mark.parametrize(("start", "duration"), [(1.0, 0.2), (-7.0, 3.0), (1e3, 40.0)])
def test_a_linear_law_is_a_change_of_duration(plan, start, duration):
    again = Retimed(plan, line(start, start + duration, 1.0, 4.0))
    wanted = plan.retime(duration).shift(start - 1.0)
    np.testing.assert_allclose(again.breakpoints, wanted.breakpoints, rtol=1e-14)
    t = np.setdiff1d(np.linspace(start - 1.0, start + duration + 1.0, 61), wanted.breakpoints)
    size = np.abs(wanted.jet(t, 4)).max(axis=2, keepdims=True)
    # Late times are rounded.
    assert (np.abs(again.jet(t, 4) - wanted.jet(t, 4)) <= 1e-12 * size * max(1.0, start / 20.0)).all()


def test_two_lines_of_time_and_path():
    """y = 3 sigma, sigma = t^2: all by hand."""
    plan = Retimed(line(1.0, 4.0, 3.0, 12.0), SQUARE)
    t = np.linspace(1.0, 2.0, 21)
    np.testing.assert_allclose(plan.jet(t, 3)[:, 0], [3 * t**2, 6 * t, 0 * t + 6, 0 * t], rtol=0, atol=1e-13)
    assert (plan.start, plan.end, plan.initial[0], plan.final[0]) == (1.0, 2.0, 3.0, 12.0)
    assert plan([0.0, 9.0]).tolist() == [3.0, 12.0]
    assert not plan.jet([0.0, 9.0], 3)[1:].any()


def test_second_derivatives_by_the_chain_rule():
    """y'' = y_d'' sigma'^2 + y_d' sigma'', and y''' so on."""
    plan, law = (
        PLANS["trigonometric"],
        TrigSpline([Waypoint(0, 1, 0.4), Waypoint(2, 2.6), Waypoint(5, 4, 0.1)], alpha=1),
    )
    t = np.linspace(0.0, 5.0, 101)
    (sigma,), (v,), (a,), (j,) = law.jet(t, 3)
    _, d1, d2, d3 = plan.jet(sigma, 3)
    found = Retimed(plan, law).jet(t, 3)
    wanted = [plan(sigma), d1 * v, d2 * v**2 + d1 * a, d3 * v**3 + 3.0 * d2 * v * a + d1 * j]
    assert np.abs(found - wanted).max() <= 1e-12 * np.abs(wanted).max()


# Composite functions in many digits


@pytest.mark.parametrize("t", [1.0, 1.3, 1.77, 2.0])
def test_polynomial_of_a_square_to_order_5(t):
    """Minimum jerk from 1 to 4 s, 10 u^3 - 15 u^4 + 6 u^5."""

    def exact(x):
        u = (x**2 - 1) / 3
        return u**3 * (10 - 15 * u + 6 * u**2)

    plan = Retimed(PolySpline([Waypoint(1.0, 0, 0, 0), Waypoint(4.0, 1, 0, 0)]), SQUARE)
    wanted = taylor(exact, t, 5)
    size = np.abs([taylor(exact, s, 5) for s in (1.0, 1.3, 1.5, 1.77, 2.0)]).max(axis=0)
    assert (np.abs(plan.jet(t, 5)[:, 0] - wanted) <= 1e-13 * size).all()


@pytest.mark.parametrize("t", [0.1, 0.35, 0.62, 0.95])
def test_half_turn_of_a_half_turn_to_order_5(t):
    """The trigonometric move of alpha = pi has the rate 3/4 pi sin^3(pi t): a law as well as a path."""

    def exact(x):
        c = mp.cos(mp.pi * x)
        return mp.mpf(1) / 2 - c * 3 / 4 + c**3 / 4

    move = TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)], alpha=math.pi)
    plan = Retimed(move, move)
    size = np.abs([taylor(lambda x: exact(exact(x)), s, 5) for s in np.linspace(0.05, 0.95, 19)]).max(axis=0)
    wanted = taylor(lambda x: exact(exact(x)), t, 5)
    assert (np.abs(plan.jet(t, 5)[:, 0] - wanted) <= 1e-12 * size).all()


@examples(50)
@given(st.integers(0, 8), st.integers(0, 2**32))
def test_composed_series_are_those_of_polynomials(order, seed):
    """Coefficients multiplied out by numpy."""
    rng = np.random.default_rng(seed)
    outer, inner = rng.normal(size=order + 1), rng.normal(size=order + 1)
    polynomial = np.polynomial.Polynomial([0.0, *inner[1:]])
    wanted = sum(c * polynomial**k for k, c in enumerate(outer)).coef
    wanted = np.append(wanted, np.zeros(order + 1))[: order + 1]
    size = sum(abs(c) * np.polynomial.Polynomial([0.0, *np.abs(inner[1:])]) ** k for k, c in enumerate(outer)).coef
    found = composed(outer.tolist(), inner[1:].tolist())
    assert (np.abs(found - wanted) <= 1e-14 * np.append(size, np.zeros(order + 1))[: order + 1]).all()


def test_composed_series_of_functions():
    """exp(sin t) about 0.7 to order 20, as numbers and as arrays."""
    t, order = 0.7, 20
    rates = [math.sin(t + 0.5 * math.pi * k) / math.factorial(k) for k in range(1, order + 1)]
    outer = [math.exp(math.sin(t)) / math.factorial(k) for k in range(order + 1)]
    with mp.workdps(50):
        wanted = [float(c) for c in mp.taylor(lambda x: mp.exp(mp.sin(x)), mp.mpf(t), order)]
    assert np.abs(np.array(composed(outer, rates)) - wanted).max() <= 1e-15 * 3
    table = composed([c * np.ones((2, 1)) for c in outer], [c * np.ones(3) for c in rates])
    np.testing.assert_allclose(np.array(table[1:]), np.tile(np.array(wanted[1:])[:, None, None], (2, 3)), atol=1e-15)
    assert composed([3.0], []) == [3.0]


# Breakpoints


def test_breakpoints_are_where_the_law_passes_those_of_the_plan():
    """sigma = t^2 passes 2, 2.25 and 3 at their roots."""
    points = [Waypoint(t, math.sin(9 * t), 0.0) for t in (1.0, 2.0, 2.25, 3.0, 4.0)]
    plan = Retimed(PiecewiseSpline(points), SQUARE)
    wanted = [1.0, math.sqrt(2.0), 1.5, math.sqrt(3.0), 2.0]
    assert (np.abs(plan.breakpoints - wanted) <= 4 * np.spacing(wanted)).all()


def test_those_of_the_law_are_there_too_and_once():
    """The law's joint at 2 s meets a breakpoint of the plan, at any rate there, and that at 3 s does not."""
    path = PiecewiseSpline([Waypoint(t, p, 0.0) for t, p in [(1.0, 0.0), (2.0, 1.0), (4.0, -1.0)]])
    for rate in (0.0, 0.3):
        law = PiecewiseSpline(
            [Waypoint(0.0, 1.0, 0.5), Waypoint(2.0, 2.0, rate), Waypoint(3.0, 3.0, rate), Waypoint(5.0, 4.0, 0.5)]
        )
        np.testing.assert_array_equal(Retimed(path, law).breakpoints, [0.0, 2.0, 3.0, 5.0])
    tiny = 1.0 + 3e-14  # to rounding
    law = PiecewiseSpline([Waypoint(0.0, 1.0, 0.0), Waypoint(2.0, 2.0 * tiny, 0.0), Waypoint(5.0, 4.0, 0.0)])
    np.testing.assert_array_equal(Retimed(path, law).breakpoints, [0.0, 2.0, 5.0])


@examples(30)
@given(st.lists(st.floats(0.05, 1.0), min_size=2, max_size=5), st.lists(st.floats(0.05, 1.0), min_size=1, max_size=4))
def test_breakpoints_against_roots_of_polynomials(path, steps):
    """The law as a PPoly of scipy, solved by it."""
    knots = np.cumsum([0.0, *path])
    times = np.cumsum([1.0, *steps])
    values = np.linspace(knots[0], knots[-1], len(times)) ** 2 / knots[-1]
    rates = np.full(len(times), 0.2 * (knots[-1] / (times[-1] - times[0])))
    law = PiecewiseSpline([Waypoint(t, v, r) for t, v, r in zip(times, values, rates, strict=True)])
    if law.extrema(1).minimum[0] < 0.0:
        return
    plan = Retimed(PiecewiseSpline([Waypoint(t, math.sin(t), 0.0) for t in knots]), law)
    cubic = PPoly(np.stack([law.jet(times[:-1], 3)[k, 0] / math.factorial(k) for k in (3, 2, 1, 0)]), times)
    assert set(times) <= set(plan.breakpoints)
    others = np.setdiff1d(plan.breakpoints, times)
    wanted = [cubic.solve(b, extrapolate=False) for b in knots[1:-1] if np.abs(values - b).min() > 1e-9]
    wanted = np.sort(np.concatenate([[], *wanted]))
    assert others.size == wanted.size
    assert np.abs(others - wanted).max(initial=0.0) <= 1e-9
    assert np.abs(law(others) - np.sort(knots[1:-1][np.abs(knots[1:-1, None] - values).min(axis=1) > 1e-9])).max(
        initial=0.0
    ) <= 1e-14 * max(1.0, knots[-1])


def test_each_side_of_a_breakpoint_has_its_own_segment():
    """A path with corners: slopes 1, -2, 0.5 of sigma = t^2."""
    corners = PiecewiseSpline([Waypoint(1.0, 0.0), Waypoint(2.25, 1.25), Waypoint(3.0, -0.25), Waypoint(4.0, 0.25)])
    plan = Retimed(corners, SQUARE)
    inner = plan.breakpoints[1:-1]
    for left, slopes in ((True, [1.0, -2.0]), (False, [-2.0, 0.5])):
        jet = plan.jet(inner, 2, left=left)[:, 0]
        np.testing.assert_allclose(jet[0], [1.25, -0.25], rtol=0, atol=2e-15)
        np.testing.assert_allclose(jet[1], 2.0 * inner * slopes, rtol=1e-14)
        np.testing.assert_allclose(jet[2], 2.0 * np.array(slopes), rtol=1e-13)
    jumps = {(k.order, round(k.time**2, 12)): k.size for k in plan.jumps(2) if plan.start < k.time < plan.end}
    wanted = {(1, 2.25): -9.0, (1, 3.0): 5.0 * math.sqrt(3.0), (2, 2.25): -6.0, (2, 3.0): 5.0}
    assert jumps == pytest.approx(wanted, rel=1e-12)


def test_jumps_of_the_law_are_jumps_of_the_plan():
    """y = 2 sigma on a trapezoid: acceleration jumps with the law's."""
    law = Trapezoid(4.0, velocity=1.0, acceleration=1.0)
    plan = Retimed(line(0.0, 4.0, 0.0, 8.0), law)
    assert [(k.order, k.time) for k in plan.jumps(2)] == [(2, 0.0), (2, 1.0), (2, 4.0), (2, 5.0)]
    np.testing.assert_allclose([k.size for k in plan.jumps(2)], [2.0, -2.0, -2.0, 2.0], rtol=1e-14)
    assert plan.peak(1)[0] == pytest.approx(2.0, rel=1e-14)


def test_jumps_of_position_at_the_ends_and_inside():
    """Of a plan that begins, goes on and ends with one: the end belongs to the plan."""
    path = Step(1.0).then(line(0, 1, 1, 2)).then(Step(5.0, 2.0)).then(line(0, 2, 5, 6)).then(Step(9.0, 6.0))
    plan = Retimed(path, line(10.0, 16.0, 0.0, 3.0))
    assert (plan.initial[0], plan.final[0]) == (0.0, 9.0)
    assert [(k.time, round(k.size, 12)) for k in plan.jumps(0)] == [(10.0, 1.0), (12.0, 3.0), (16.0, 3.0)]
    assert plan([9.0, 10.0, 12.0, 16.0, 17.0]).tolist() == pytest.approx([0.0, 1.0, 5.0, 9.0, 9.0], rel=1e-15)
    assert plan.jet([10.0, 12.0, 16.0], 0, left=True)[0, 0].tolist() == pytest.approx([0.0, 2.0, 6.0], rel=1e-15)


def test_laws_one_after_the_other():
    """A move in two goes, with a rest between."""
    path = PLANS["polynomial"]
    law = SCurve(2.0, 1.0, velocity=1, acceleration=2, jerk=8).then(
        SCurve(4.0, 2.0, velocity=1, acceleration=2, jerk=8)
    )
    plan = Retimed(path, law)
    pause = law.breakpoints[7]
    np.testing.assert_array_equal(plan.breakpoints, law.breakpoints)
    np.testing.assert_allclose(plan(pause), path(2.0), rtol=1e-15)
    for side in (True, False):
        assert np.abs(plan.jet(pause, 2, left=side)[1:]).max() <= 1e-13
    np.testing.assert_array_equal(plan.final, path.final)


def test_a_law_that_rests_for_an_instant():
    """1 + u^3 about its stationary point, where Newton's method alone would stall: a breakpoint there and nearby."""
    law = PolySpline([Waypoint(-1.0, 0.0, 3.0), Waypoint(1.0, 2.0, 3.0)])
    np.testing.assert_allclose(law(np.array([-0.5, 0.5])), [0.875, 1.125], rtol=1e-15)
    path = PiecewiseSpline([Waypoint(t, p, 0.0) for t, p in [(0.0, 0.0), (1.0, 1.0), (1.001, 0.5), (2.0, 3.0)]])
    plan = Retimed(path, law)
    assert abs(plan.breakpoints[1]) <= 1e-5  # the cube root of rounding
    assert plan.breakpoints[2] == pytest.approx(0.1, rel=1e-12)
    np.testing.assert_allclose(plan(plan.breakpoints), [0.0, 1.0, 0.5, 3.0], rtol=0, atol=1e-13)


# What all kinds promise, where it is not plain


def test_many_times_are_as_good_as_few():
    plan = Retimed(
        PLANS["piecewise"], TrigSpline([Waypoint(0, 1, 0.4), Waypoint(2, 2.6), Waypoint(5, 4, 0.1)], alpha=1)
    )
    for t in (np.linspace(-0.5, 5.5, 30_000), np.random.default_rng(0).uniform(0.0, 5.0, 20_000)):
        found, few = plan.jet(t, 2), plan.jet(t[::97], 2)
        size = np.abs(few).max(axis=2, keepdims=True)
        assert (np.abs(found[:, :, ::97] - few) <= 1e-12 * size).all()


def test_extrema_are_those_of_the_composite():
    """Peak velocity of minimum jerk with the time law t^2, in closed form: the derivative of 2 t p'(t^2) is 0."""
    plan = Retimed(PolySpline([Waypoint(1.0, 0, 0, 0), Waypoint(4.0, 1, 0, 0)]), SQUARE)
    t = np.roots(np.polynomial.Polynomial([4.0, 0.0, -25.0, 0.0, 9.0]).coef[::-1]).real  # u = (t^2 - 1)/3
    t = t[(t > 1.0) & (t < 2.0)]
    u = (t**2 - 1.0) / 3.0
    assert plan.peak(1)[0] == pytest.approx((2.0 * t * 10.0 * u**2 * (1.0 - u) ** 2).max(), rel=1e-13)


@every
def test_json_restores_every_bit(plan):
    made = Retimed(plan, SQUARE.retime(7.0), labels=["a", "b"])
    again = trajectory_from_dict(json.loads(json.dumps(made.to_dict(), allow_nan=False)))
    t = moments(made)
    np.testing.assert_array_equal(again.jet(t, 3), made.jet(t, 3))
    np.testing.assert_array_equal(again.breakpoints, made.breakpoints)
    assert again.labels == ("a", "b")
    assert made.waypoints == ()


def test_retiming_and_shifting_act_on_the_law():
    plan = Retimed(PLANS["piecewise"], SQUARE)
    moved = plan.retime(10.0).shift(5.0)
    assert moved.plan is plan.plan
    assert (moved.law.start, moved.law.end) == (6.0, 16.0)
    np.testing.assert_allclose(moved(6.0 + 10.0 * np.array([0.2, 0.7])), plan([1.2, 1.7]), rtol=1e-13)
    twice = Retimed(plan, line(0.0, 1.0, 1.0, 2.0))
    np.testing.assert_allclose(twice([0.2, 0.7], 2), plan([1.2, 1.7], 2), rtol=1e-12)


@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
@every
@pytest.mark.parametrize("symbol", ["SX", "MX"])
def test_series_at_a_symbol(plan, symbol):
    casadi = pytest.importorskip("casadi")
    made, order = Retimed(plan, SQUARE), 4
    t = getattr(casadi, symbol).sym("t")
    rows = made.series(t, order)
    function = casadi.Function("f", [t], [casadi.vertcat(*[value for row in rows for value in row])])
    at = moments(made, 23)
    wanted = made.jet(at, order) / np.array([math.factorial(k) for k in range(order + 1)])[:, None, None]
    size = np.abs(wanted).max(axis=2)
    for moment, column in zip(at.tolist(), np.moveaxis(wanted, 2, 0), strict=True):
        found = np.array(function(moment)).reshape(made.naxes, order + 1).T
        assert (np.abs(found - column) <= 1e-12 * size).all()


def test_it_cannot_be_changed():
    plan = Retimed(PLANS["piecewise"], SQUARE)
    for name in ("plan", "law", "labels", "breakpoints"):
        with pytest.raises(AttributeError, match="immutable"):
            setattr(plan, name, None)
    assert not plan.breakpoints.flags.writeable


# What is rejected


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (line(0.0, 1.0, 1.0, 3.9), "law must lead from the plan's start 1.0 s to its end 4.0 s, got 1.0 to 3.9"),
        (line(0.0, 1.0, 0.9, 4.0), "law must lead from the plan's start 1.0 s to its end 4.0 s, got 0.9 to 4.0"),
        (line(0.0, 1.0, 4.0, 1.0), "law must lead from the plan's start 1.0 s to its end 4.0 s, got 4.0 to 1.0"),
        (stack([SQUARE, SQUARE]), "law must have one axis, got 2: y1, y2"),
        (PolySpline([Waypoint(0, 1, -1.0), Waypoint(1, 4)]), "law must increase, got the rate -1 at 0 s"),
        (
            PolySpline([Waypoint(0, 1), Waypoint(1, 3), Waypoint(2, 4.0, -1e-9)]),
            "law must increase, got the rate -1e-09 at 2 s",
        ),
        (
            line(0, 1, 1, 2).then(line(0, 1, 2, 2)).then(line(0, 1, 2, 4)),
            "law must increase strictly, got 2 from 1 s on",
        ),
        (
            line(0, 1, 1, 2).then(Step(3.0, 2.0)).then(line(0, 1, 3, 4)),
            "law must be continuous, got a jump by 1 at 1 s",
        ),
        (Step(4.0, 1.0), "law must be continuous, got a jump by 3 at 0 s"),
    ],
)
def test_laws_that_are_rejected(law, message):
    with pytest.raises(ValueError, match=message):
        Retimed(PLANS["piecewise"], law)


def test_other_arguments_that_are_rejected():
    with pytest.raises(ValueError, match="plan must have a duration, got a step"):
        Retimed(Step(1.0, time=1.0), SQUARE)
    with pytest.raises(TypeError, match="plan must be a Trajectory, got float"):
        Retimed(1.0, SQUARE)
    with pytest.raises(TypeError, match="law must be a Trajectory, got function"):
        Retimed(PLANS["piecewise"], lambda t: t)
    with pytest.raises(ValueError, match="labels must be one per axis, 2, got 1"):
        Retimed(PLANS["piecewise"], SQUARE, labels=["a"])


@pytest.mark.parametrize("off", [1e-14, -1e-14])
def test_ends_that_agree_to_rounding_are_the_plans_own(off):
    for first, last in itertools.product((1.0, 1.0 + off), (4.0, 4.0 + 4.0 * off)):
        plan = Retimed(PLANS["piecewise"], line(0.0, 1.0, first, last))
        np.testing.assert_array_equal(plan.final, PLANS["piecewise"].final)
        np.testing.assert_array_equal(plan(plan.end), PLANS["piecewise"].final)
        assert not any(jump.order == 0 for jump in plan.jumps(0))
