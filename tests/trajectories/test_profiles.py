"""Trapezoidal and jerk-limited moves: closed forms, naive integration, linear programming, and what holds for all."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from repetitions import examples
from scipy.optimize import linprog

from ctrlplan.trajectories import SCurve, Trapezoid, trajectory_from_dict

SIZES = st.floats(-3.0, 3.0).map(lambda x: 10.0**x)
ENDS = st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)).filter(lambda pair: abs(pair[0] - pair[1]) > 1e-3)
STARTS = st.sampled_from([0.0, 1.0, -7.3, 1e4])


def phases(d, v, a, j):
    """Durations of jerk, constant acceleration and cruise, case by case (Biagiotti and Melchiorri, 3.4)."""
    tj, ta = (math.sqrt(v / j), 2.0 * math.sqrt(v / j)) if v * j < a**2 else (a / j, a / j + v / a)
    tv = d / v - ta
    if tv < 0.0:
        tv = 0.0
        if d < 2.0 * a**3 / j**2:
            tj = (d / (2.0 * j)) ** (1.0 / 3.0)
            ta = 2.0 * tj
        else:
            tj = a / j
            ta = tj / 2.0 + math.sqrt(tj**2 / 4.0 + d / a)
    return tj, ta - 2.0 * tj, tv


def integrated(knots, top, t, times):
    """The function that rests at the first knot and whose derivative of order `times` is `top` between knots."""
    a, b = np.minimum(knots[:-1], t[:, None]), np.minimum(knots[1:], t[:, None])
    n = math.factorial(times)
    return (((t[:, None] - a) ** times - (t[:, None] - b) ** times) / n) @ np.array(top)


# Durations


@pytest.mark.parametrize(
    ("d", "v", "a", "segments"),
    [
        (3.0, 1.0, 0.5, [2.0, 1.0, 2.0]),  # d/v + v/a
        (1.0, 9.0, 1.0, [1.0, 1.0]),  # 2 sqrt(d/a)
        (2.0, 2.0, 2.0, [1.0, 1.0]),  # the velocity limit just reached
        (1e-6, 1e3, 4e-6, [0.5, 0.5]),
        (8e6, 2e6, 1e6, [2.0, 2.0, 2.0]),
    ],
)
def test_segments_of_the_trapezoid(d, v, a, segments):
    for final, initial in ((d, 0.0), (0.5 * d, -0.5 * d), (0.0, d)):
        plan = Trapezoid(final, initial, velocity=v, acceleration=a)
        np.testing.assert_allclose(np.diff(plan.breakpoints), segments, rtol=1e-15)
        assert plan.peak(1)[0] == pytest.approx(min(v, math.sqrt(d * a)), rel=1e-15)
        assert plan.peak(2)[0] == pytest.approx(a, rel=1e-15)


@pytest.mark.parametrize(
    ("d", "v", "a", "j", "segments"),
    [
        (4.0, 1.0, 0.5, 0.5, [1, 1, 1, 1, 1, 1, 1]),  # d/v + v/a + a/j
        (4.0, 1.0, 9.0, 1.0, [1, 1, 2, 1, 1]),  # d/v + 2 sqrt(v/j)
        (6.0, 9.0, 1.0, 1.0, [1, 1, 1, 1, 1, 1]),  # a/j + sqrt((a/j)^2 + 4 d/a)
        (2.0, 9.0, 9.0, 1.0, [1, 1, 1, 1]),  # 4 cbrt(d/(2 j))
        # Equalities: of velocity, of acceleration, of both, and the cruise of no length with either.
        (6.0, 2.0, 1.0, 1.0, [1, 1, 1, 1, 1, 1]),
        (4.0, 1.0, 1.0, 1.0, [1, 1, 2, 1, 1]),
        (2.0, 1.0, 1.0, 1.0, [1, 1, 1, 1]),
        (2.0, 1.0, 9.0, 1.0, [1, 1, 1, 1]),
        (2.0, 9.0, 1.0, 1.0, [1, 1, 1, 1]),
    ],
)
def test_segments_of_the_s_curve(d, v, a, j, segments):
    for size, speed in itertools.product((1e-6, 1.0, 1e6), (0.01, 1.0, 50.0)):
        limits = {"velocity": v * size * speed, "acceleration": a * size * speed**2, "jerk": j * size * speed**3}
        plan = SCurve(-d * size, **limits)
        np.testing.assert_allclose(np.diff(plan.breakpoints), np.array(segments) / speed, rtol=4e-15)


@examples(150)
@given(SIZES, SIZES, SIZES, SIZES)
def test_the_duration_is_that_of_the_cases(d, v, a, j):
    assume(min(v / a, a / j) > 1e-12 * (d / v + v / a + a / j))
    tj, ta, tv = phases(d, v, a, j)
    assert SCurve(d, velocity=v, acceleration=a, jerk=j).duration == pytest.approx(4 * tj + 2 * ta + tv, rel=1e-13)
    exact = d / v + v / a if v**2 < d * a else 2.0 * math.sqrt(d / a)
    assert Trapezoid(d, velocity=v, acceleration=a).duration == pytest.approx(exact, rel=1e-14)


@pytest.mark.parametrize("off", [-1e-9, -3e-16, -1e-16, 0.0, 2e-16, 1e-9])
def test_near_an_equality_no_segment_is_rounding(off):
    """A segment that the limits just do not need has the length that they give it, or none."""
    plan = Trapezoid(1.0, velocity=1.0 + off, acceleration=1.0)
    assert len(plan.breakpoints) == (4 if off == -1e-9 else 3)
    plan = SCurve(2.0, velocity=1.0 + off, acceleration=1.0 + off, jerk=1.0)
    assert len(plan.breakpoints) == (8 if off == -1e-9 else 5)


# The function


@pytest.mark.parametrize(
    ("d", "v", "a", "j"),
    [(4.0, 1.0, 0.5, 0.5), (4.0, 1.0, 9.0, 1.3), (6.0, 9.0, 1.1, 1.0), (2.0, 9.0, 9.0, 0.7), (50.0, 3.0, 2.0, 9.0)],
)
def test_jets_are_those_of_the_integrated_jerk(d, v, a, j):
    tj, ta, tv = phases(d, v, a, j)
    knots = np.cumsum([0.0, tj, ta, tj, tv, tj, ta, tj])
    plan = SCurve(d, velocity=v, acceleration=a, jerk=j)
    t = np.random.default_rng(0).uniform(0.0, knots[-1], 200)
    for nu in range(3):
        wanted = integrated(knots, [j, 0.0, -j, 0.0, -j, 0.0, j], t, 3 - nu)
        assert np.abs(plan(t, nu) - wanted).max() <= 1e-13 * max(d, np.abs(wanted).max())
    np.testing.assert_allclose(plan(t, 3), np.array([j, 0, -j, 0, -j, 0, j])[np.searchsorted(knots, t) - 1], rtol=1e-13)
    assert not plan.jet(t, 6)[4:].any()


@pytest.mark.parametrize(("d", "v", "a"), [(3.0, 1.0, 0.5), (1.0, 9.0, 1.3)])
def test_jets_are_those_of_the_integrated_acceleration(d, v, a):
    rise = min(v / a, math.sqrt(d / a))
    knots = np.cumsum([0.0, rise, max(d / v - v / a, 0.0), rise])
    plan = Trapezoid(d, velocity=v, acceleration=a)
    t = np.random.default_rng(0).uniform(0.0, knots[-1], 200)
    for nu in range(2):
        wanted = integrated(knots, [a, 0.0, -a], t, 2 - nu)
        assert np.abs(plan(t, nu) - wanted).max() <= 1e-13 * d
    np.testing.assert_allclose(plan(t, 2), np.array([a, 0.0, -a])[np.searchsorted(knots, t) - 1], rtol=1e-14)
    assert not plan.jet(t, 5)[3:].any()


@examples(50)
@given(ENDS, SIZES, SIZES, SIZES, STARTS)
@example((0.0, 30.0), 1.0, 1.0, 1.0 + 7e-14, -7.3)  # a segment below the resolution of times
@example((0.0, 2.0), 1.0 - 4e-15, 1.0, 1.0, -7.3)
def test_limits_are_met_and_one_of_them_is_reached(ends, v, a, j, time):
    """For any start time; and with continuity up to rounding."""
    final, initial = ends
    minimum = 1e-11 * (abs(time) + abs(final - initial) / v + v / a + a / j)
    assume(min(v / a, a / j) > minimum)
    for plan, highest in (
        (Trapezoid(final, initial, velocity=v, acceleration=a, time=time), 2),
        (SCurve(final, initial, velocity=v, acceleration=a, jerk=j, time=time), 3),
    ):
        used = [plan.peak(nu)[0] / limit for nu, limit in zip(range(1, highest + 1), (v, a, j), strict=False)]
        assert max(used) <= 1.0 + 2e-15
        # Segments are lengthened to the next floating-point time, not more.
        tick = math.ulp(max(abs(plan.start), abs(plan.end)))
        assert max(used) >= 1.0 - 2e-15 - 8.0 * tick / np.diff(plan.breakpoints).min()
        assert plan.start == time
        assert plan.jet(plan.start, 0)[0, 0] == plan.initial[0] == initial
        assert plan.jet(plan.end, 0)[0, 0] == plan.final[0] == final
        assert not plan.jet([plan.start, plan.end], highest - 1)[1:].any()
        assert {jump.order for jump in plan.jumps(highest)} == {highest}


@pytest.mark.parametrize("time", [0.0, -3.7, 1e3, 1e6, 1e9])
def test_a_late_start_preserves_continuity_and_limits(time):
    plan = SCurve([3.0, 1.0], velocity=1.0, acceleration=0.7, jerk=2.0, time=time)
    left, right = (plan.jet(plan.breakpoints[1:-1], 2, left=side)[:, 0] for side in (True, False))
    assert np.abs(left - right).max() <= 1e-15
    for nu, limit in enumerate((1.0, 0.7, 2.0), 1):
        assert -1e-15 <= 1.0 - plan.peak(nu)[0] / limit <= 8e-16 * max(1.0, abs(time))


def test_it_mirrors_itself():
    plan = SCurve(5.0, 2.0, velocity=1.0, acceleration=2.0, jerk=9.0, time=1.0)
    s = np.linspace(0.0, plan.duration, 101)[1:-1]
    assert np.abs(plan(plan.start + s) + plan(plan.end - s) - 7.0).max() <= 1e-14


# Optimality


def farthest(dt, steps, v, a, j):
    """Longest way from rest to rest with jerk constant in each step, by linear programming.

    Velocities are bounded by their Bernstein coefficients in each step: met in between too.
    """
    times = dt * np.arange(steps + 1)
    acceleration, velocity, position = (
        integrated(times, np.eye(steps), times, 1 + k).reshape(steps + 1, steps) for k in range(3)
    )
    middle = velocity[:-1] + 0.5 * dt * acceleration[:-1]
    bounded = np.concatenate([acceleration / a, velocity / v, middle / v])
    found = linprog(
        -position[-1],
        A_ub=np.concatenate([bounded, -bounded]),
        b_ub=np.ones(2 * len(bounded)),
        A_eq=np.stack([acceleration[-1], velocity[-1]]),
        b_eq=np.zeros(2),
        bounds=(-j, j),
        method="highs",
    )
    return -found.fun


@pytest.mark.parametrize(("nj", "na", "nv"), [(2, 3, 4), (3, 0, 4), (2, 4, 0), (4, 0, 0), (1, 1, 7)])
def test_no_other_move_goes_farther_in_the_same_time(nj, na, nv):
    """Symmetric or not: a limit that is not reached is set higher."""
    dt, j = 0.1, 2.0
    a = j * nj * dt
    v = a * (nj + na) * dt
    d = v * (2 * nj + na + nv) * dt
    a, v = a * (1.0 if na else 1.3), v * (1.0 if nv else 1.3)
    steps = 4 * nj + 2 * na + nv
    assert SCurve(d, velocity=v, acceleration=a, jerk=j).duration == pytest.approx(steps * dt, rel=1e-14)
    assert farthest(dt, steps, v, a, j) == pytest.approx(d, rel=1e-9)


def test_the_trapezoid_is_the_s_curve_of_endless_jerk():
    for d, v in ((3.0, 1.0), (1.0, 9.0)):
        wanted = Trapezoid(d, velocity=v, acceleration=2.0)
        off = [SCurve(d, velocity=v, acceleration=2.0, jerk=j).duration - wanted.duration for j in (1e3, 1e4, 1e5)]
        np.testing.assert_allclose(off, 2.0 / np.array([1e3, 1e4, 1e5]), rtol=1e-2)


# Several axes


def test_axes_move_on_a_straight_line_as_fast_as_all_limits_allow():
    final, initial = np.array([1.0, -6.0, 2.0]), np.array([-1.0, 3.0, 2.0])
    plan = SCurve(final, initial, velocity=[0.5, 3.0, 1e-9], acceleration=[9.0, 1.0, 1e-9], jerk=4.0)
    change = final - initial
    # Of the unit move: 0.5/2 against 3/9, 9/2 against 1/9, 4/2 against 4/9.
    law = SCurve(1.0, velocity=0.25, acceleration=1 / 9, jerk=4 / 9)
    t = np.linspace(0.0, law.duration, 57)
    wanted = change[:, None] * law.jet(t, 3)
    wanted[0] += initial[:, None]
    np.testing.assert_allclose(plan.jet(t, 3), wanted, rtol=0, atol=1e-13)
    assert plan.duration == pytest.approx(law.duration, rel=1e-15)
    np.testing.assert_array_equal(plan(t)[2], 2.0)
    np.testing.assert_array_equal(plan(plan.end), final)
    assert plan.peak(1)[0] == pytest.approx(0.5, rel=1e-14)
    assert plan.peak(2)[1] == pytest.approx(1.0, rel=1e-14)


def test_one_initial_position_and_limit_may_stand_for_all_axes():
    plan = Trapezoid([2.0, 3.0], 1.0, velocity=1.0, acceleration=[2.0, 4.0], labels=["x", "z"])
    np.testing.assert_array_equal(plan.initial, [1.0, 1.0])
    np.testing.assert_array_equal(plan.velocity, [1.0, 1.0])
    np.testing.assert_array_equal(plan.acceleration, [2.0, 4.0])
    assert plan.labels == ("x", "z")


# The kind


@pytest.mark.parametrize("duration", [1e-6, 0.3, 7.0, 1e6])
def test_retiming_scales_the_limits(duration):
    plan = SCurve([3.0, -1.0], velocity=[1.0, 4.0], acceleration=0.7, jerk=2.0, time=-2.0)
    fast = plan.retime(duration)
    rate = plan.duration / duration
    assert fast.duration == pytest.approx(duration, rel=1e-9 if duration < 1e-3 else 1e-13)
    np.testing.assert_allclose(fast.velocity, plan.velocity * rate, rtol=1e-15)
    np.testing.assert_allclose(fast.acceleration, plan.acceleration * rate**2, rtol=1e-15)
    np.testing.assert_allclose(fast.jerk, plan.jerk * rate**3, rtol=1e-15)
    assert fast.start == -2.0


def test_jumps():
    """Acceleration at every breakpoint of the trapezoid, jerk at every one of the s-curve: nothing below."""
    plan = Trapezoid(3.0, velocity=1.0, acceleration=0.5)
    assert [(k.order, k.time) for k in plan.jumps(2)] == [(2, 0.0), (2, 2.0), (2, 3.0), (2, 5.0)]
    np.testing.assert_allclose([k.size for k in plan.jumps(2)], [0.5, -0.5, -0.5, 0.5], rtol=1e-15)
    plan = SCurve(4.0, velocity=1.0, acceleration=0.5, jerk=0.5)
    assert plan.jumps(2) == ()
    assert [(k.order, k.time) for k in plan.jumps(3)] == [(3, float(t)) for t in range(8)]
    np.testing.assert_allclose(
        [k.size for k in plan.jumps(3)], 0.5 * np.array([1, -1, -1, 1, -1, 1, 1, -1]), rtol=1e-14
    )


def test_limits_and_positions_cannot_be_changed():
    plan = SCurve([3.0, 1.0], velocity=1.0, acceleration=0.7, jerk=2.0)
    for name in ("velocity", "acceleration", "jerk", "initial", "final", "breakpoints"):
        assert not getattr(plan, name).flags.writeable
        with pytest.raises(AttributeError, match="immutable"):
            setattr(plan, name, 1.0)
    given_limit = np.array([1.0, 2.0])
    plan = Trapezoid([3.0, 1.0], velocity=given_limit, acceleration=1.0)
    given_limit[:] = 9.0
    np.testing.assert_array_equal(plan.velocity, [1.0, 2.0])


def test_it_continues_what_ended_where_it_starts():
    there = SCurve(2.0, velocity=1.0, acceleration=0.7, jerk=2.0)
    back = Trapezoid(0.0, 2.0, velocity=1.0, acceleration=0.7)
    both = there.then(back)
    assert both.duration == pytest.approx(there.duration + back.duration, rel=1e-15)
    assert both.final == 0.0


@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
@pytest.mark.parametrize("kind", [Trapezoid, SCurve])
def test_series_at_a_symbol(kind):
    casadi = pytest.importorskip("casadi")
    limits = {"velocity": 1.0, "acceleration": 0.7} | ({"jerk": 2.0} if kind is SCurve else {})
    plan = kind([3.0, 1.0], [0.5, 2.0], **limits, time=1e4)
    t = casadi.SX.sym("t")
    rows = plan.series(t, 5)
    function = casadi.Function("f", [t], [casadi.vertcat(*rows[0], *rows[1])])
    moments = np.concatenate([plan.breakpoints, 1e4 + np.linspace(-1.0, plan.duration + 1.0, 23)])
    for moment in moments.tolist():
        wanted = plan.jet(moment, 5) / np.array([1, 1, 2, 6, 24, 120])[:, None]
        assert np.abs(np.array(function(moment)).reshape(2, 6).T - wanted).max() <= 2e-15


# What is rejected


def wrong(kind=SCurve, final=1.0, initial=0.0, **changed):
    limits = {"velocity": 1.0, "acceleration": 1.0} | ({"jerk": 1.0} if kind is SCurve else {})
    return kind(final, initial, **(limits | changed))


@pytest.mark.parametrize("kind", [Trapezoid, SCurve])
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"velocity": -1.0}, "velocity must be above 0 and finite, got -1.0$"),
        ({"velocity": 0.0}, "velocity must be above 0 and finite, got 0.0$"),
        ({"acceleration": math.inf}, "acceleration must be above 0 and finite, got inf$"),
        ({"acceleration": math.nan}, "acceleration must be above 0 and finite, got nan$"),
        ({"velocity": "fast"}, "velocity must be numbers, got 'fast'"),
        ({"final": [1.0, 2.0], "velocity": [1.0, -2.0]}, "velocity must be above 0 and finite, got -2.0 of y2$"),
        (
            {"final": [1.0, 2.0], "velocity": [1.0] * 3},
            r"velocity must be a scalar or of shape \(2,\), or pairs of shape \(2, 2\), got shape \(3,\)",
        ),
        (
            {"velocity": [[1.0]]},
            r"velocity must be a scalar or of shape \(1,\), or pairs of shape \(1, 2\), got shape \(1, 1\)",
        ),
        ({"final": 0.0}, r"final must differ from initial by a finite length, got \[0.0\] after \[0.0\]"),
        ({"final": 1e308, "initial": -1e308}, "final must differ from initial by a finite length"),
        ({"final": math.nan}, "final must be finite"),
        ({"final": [1.0, 2.0], "initial": [0.0] * 3}, "initial must have the shape of final"),
        ({"time": math.inf}, "time must be finite"),
        ({"labels": ["a", "b"]}, "labels must be one per axis, 1, got 2"),
        ({"time": 1e17}, "limits must give an acceleration phase of more than 178 s at time = 1e[+]17 s, got"),
        ({"acceleration": 1e300}, "limits must give an acceleration phase of more than"),
        ({"final": 1e300, "velocity": 1e-300}, "limits must give segments of finite durations, got"),
    ],
)
def test_what_is_rejected(kind, changed, message):
    if kind is SCurve and changed.get("acceleration") == 1e300:
        changed = changed | {"jerk": 1e300}
    with pytest.raises(ValueError, match=message):
        wrong(kind, **changed)


def test_jerk_is_checked_too():
    with pytest.raises(ValueError, match=r"jerk must be above 0 and finite, got 0.0$"):
        wrong(jerk=0)


def test_limits_are_given_by_name():
    with pytest.raises(TypeError, match="velocity"):
        Trapezoid(1.0, acceleration=1.0)
    with pytest.raises(TypeError, match="positional"):
        Trapezoid(1.0, 0.0, 1.0)


def test_a_file_that_lacks_a_limit_is_rejected():
    data = wrong().to_dict()
    del data["jerk"]
    with pytest.raises(ValueError, match="a SCurve must have the entry 'jerk'"):
        trajectory_from_dict(data)
