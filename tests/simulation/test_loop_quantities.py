"""Exact response of a loop along a plan, against closed forms, scipy's matrix exponential and 50 digits."""

import math
from functools import reduce
from itertools import pairwise

import control as ct
import mpmath
import numpy as np
import pytest
import sympy
from loop_oracle import QUINTIC, S_CURVE, SEPTIC, VIA, random_loop, responses, system_of
from scipy.integrate import trapezoid

import ctrlplan as cp
from ctrlplan import Waypoint
from ctrlplan.simulation.exact_response import free_cells
from ctrlplan.simulation.loop_form import LoopForm

LAG = ct.ss([[-4.0]], [[4.0]], [[1.0], [-1.0]], [[0.0], [1.0]], inputs="r", outputs=["y", "e"], name="lag")
SERVO = cp.plants.integrator_lag_loop(1000.0)


def along(loop, plan):
    return cp.loop_quantities(loop).quantities_of(plan)


def lag_error(duration):
    """Error of a first-order lag with rate 4 and a quintic from 0 to 1, during the move, in sympy."""
    t = sympy.Symbol("t", nonnegative=True)
    tau = t / sympy.Integer(duration)
    r = 10 * tau**3 - 15 * tau**4 + 6 * tau**5
    # y' + 4 y = 4 r is solved by the series of derivatives, and by an exponential for y(0) = 0.
    particular = sum(sympy.diff(r, t, k) / sympy.Integer(-4) ** k for k in range(6))
    return t, r - particular + particular.subs(t, 0) * sympy.exp(-4 * t)


@pytest.mark.slow
def test_first_order_lag_in_closed_form():
    """The error of the lag is largest during the move, and its root mean square is an integral."""
    t, error = lag_error(2)
    value, slope = (sympy.lambdify(t, sympy.diff(error, t, k), "mpmath") for k in range(2))
    with mpmath.workdps(40):
        at = mpmath.findroot(slope, 1.0)
        peak, square = value(at), mpmath.quad(lambda x: value(x) ** 2, [0, 1, 2])
    response = along(LAG, QUINTIC.retime(2.0))
    found = response.extremes({"e": 1.0})
    assert found.high == pytest.approx(float(peak), rel=1e-14)
    assert found.time_high == pytest.approx(float(at), abs=1e-7)
    assert found.low == pytest.approx(0.0, abs=1e-15)
    assert response.rms("e") == pytest.approx(math.sqrt(float(square) / 2.0), rel=1e-13)
    rate = response.extremes({"e": 1.0}, rate=True)  # e' = r' - 4 e
    with mpmath.workdps(40):
        highest = mpmath.findroot(sympy.lambdify(t, sympy.diff(error, t, 2), "mpmath"), 0.4)
        assert rate.high == pytest.approx(float(slope(highest)), rel=1e-13)
    assert response.note == "exact"
    assert response.names == ("y", "e", "r")


def test_of_the_lag_after_the_move_in_closed_form():
    """After the move the error decays with the rate of the lag: in an interval its extremes are at the ends."""
    t, error = lag_error(2)
    last = float(error.subs(t, 2).evalf(30))
    response = along(LAG, QUINTIC.retime(2.0).shift(3.0))
    found = response.extremes({"e": 1.0}, during=(5.5, 6.0))
    assert found.high == pytest.approx(last * math.exp(-2.0), rel=1e-12)
    assert found.low == pytest.approx(last * math.exp(-4.0), rel=1e-12)
    assert (found.time_low, found.time_high) == pytest.approx((6.0, 5.5), abs=1e-12)
    before = response.extremes({"r": 1.0, "y": 2.0}, during=(2.0, 2.5))
    assert (before.low, before.high) == (0.0, 0.0)


def test_root_mean_square_with_a_dwell():
    """After the move e^2 is an exponential, whose integral is added."""
    t, error = lag_error(2)
    last = float(error.subs(t, 2).evalf(30))
    plan = QUINTIC.retime(2.0)
    response = along(LAG, plan)
    whole = 2.0 * response.rms("e") ** 2 + last**2 * (1.0 - math.exp(-8.0 * 3.0)) / 8.0
    assert response.rms("e", period=5.0) == pytest.approx(math.sqrt(whole / 5.0), rel=1e-12)
    long = 2.0 * response.rms("r") ** 2 + 1e6 - 2.0  # the position is 1 after the move
    assert response.rms("r", period=1e6) == pytest.approx(math.sqrt(long / 1e6), rel=1e-12)


def test_root_mean_square_of_a_cyclic_plan():
    """In the periodic steady state, which the simulation approaches over 60 periods."""
    plan = cp.PiecewiseSpline([Waypoint(0, 0, 2, 0), Waypoint(0.4, 0.6), Waypoint(1, 0, 2, 0)])
    times = np.linspace(59.0, 60.0, 20_001)
    e = cp.simulate(LAG, np.append(0.0, times), reduce(lambda a, b: a.then(b), [plan] * 60)).outputs["e"][1:]
    exact = math.sqrt(trapezoid(e**2, times))
    assert along(LAG, plan).rms("e") == pytest.approx(exact, rel=1e-7)
    from_rest = along(LAG, plan).rms("e", period=1.0)
    assert abs(from_rest / exact - 1.0) > 1e-4
    tank = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y", name="tank")
    with pytest.raises(ValueError, match=r"periodic steady state .* got tank with a pole at 0"):
        along(tank, plan).rms("y")


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("plan", [QUINTIC, VIA, S_CURVE], ids=["quintic", "via", "s_curve"])
def test_random_loops_against_dense_samples(seed, plan):
    """Dense samples never exceed the extremes, and come near them."""
    rng = np.random.default_rng([seed, 17])
    loop = random_loop(rng, order=seed % 2)
    duration = 10.0 ** rng.uniform(-1.0, 1.0)
    given = plan.retime(duration)
    dense = responses(loop, plan, [duration], steps=6000, tail=12000, spacing=0.02)[0]
    response = along(system_of(loop), given)
    for weights, row in (({"y1": 1.0}, dense[0]), ({"y1": 0.3, "y2": -2.0}, 0.3 * dense[0] - 2.0 * dense[1])):
        found, size = response.extremes(weights), np.ptp(row)
        assert -1e-12 * size <= row.min() - found.low <= 1e-3 * size
        assert -1e-12 * size <= found.high - row.max() <= 1e-3 * size


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_many_random_loops_against_dense_samples(seed):
    rng = np.random.default_rng([seed, 18])
    loop = random_loop(rng, order=seed % 3)
    plan = (QUINTIC, SEPTIC, VIA, S_CURVE)[seed % 4]
    duration = 10.0 ** rng.uniform(-1.5, 1.5)
    dense = responses(loop, plan, [duration], steps=4000, tail=20000, spacing=0.02)[0]
    response = along(system_of(loop), plan.retime(duration))
    for name, row in zip(("y1", "y2"), dense, strict=True):
        found, size = response.extremes({name: 1.0}), np.ptp(row)
        assert -1e-12 * size <= row.min() - found.low <= 1e-3 * size
        assert -1e-12 * size <= found.high - row.max() <= 1e-3 * size


def test_trigonometric_plan_against_samples_of_the_simulation():
    plan = cp.TrigSpline([Waypoint(1, 0, 0, 0), Waypoint(2, 3), Waypoint(3, 20, 0, 0)], alpha=4.0)
    times = np.linspace(1.0, 30.0, 290_001)
    y = cp.simulate(SERVO, times, plan).outputs
    response = along(SERVO, plan)
    found = response.extremes({"y": 1.0})
    assert 0.0 <= found.high - y.max() <= 1e-6 * np.ptp(y)
    assert 0.0 <= y.min() - found.low <= 1e-6 * np.ptp(y)
    assert found.time_high == pytest.approx(times[y.argmax()], abs=2e-4)
    slope = response.extremes({"y": 1.0}, rate=True)
    assert slope.high == pytest.approx(np.gradient(y, times).max(), rel=1e-5)
    inside = (times >= 1.5 - 1e-9) & (times <= 1.8 + 1e-9)
    part = response.extremes({"y": 1.0}, during=(1.5, 1.8))
    assert part.low == pytest.approx(y[inside].min(), abs=1e-6)
    assert part.high == pytest.approx(y[inside].max(), abs=1e-6)


@pytest.mark.parametrize("count", [2, 3])
def test_multiple_pole_in_fifty_digits(count):
    """(1/(s + 1))^count has no basis of eigenvectors: the tail and its bound against mpmath."""
    a = -np.eye(count) + np.eye(count, k=1)
    b, c = np.eye(count)[:, -1:], np.eye(count)[:1]
    loop = ct.ss(a, b, np.vstack([c, -c]), [[0.0], [1.0]], inputs="r", outputs=["y", "e"], name="chain")
    plan = QUINTIC.retime(0.5)
    found = along(loop, plan).extremes({"y": 1.0}, during=(3.0, 4.0))
    with mpmath.workdps(50):
        x = mpmath.quad(
            lambda s: mpmath.exp(-(4 - s)) * (4 - s) ** (count - 1) / mpmath.factorial(count - 1) * _quintic(2 * s),
            [0, 0.25, 0.5],
        )
        rest = mpmath.gammainc(count, 0, 3.5, regularized=True)  # of the constant 1 from 0.5 on
        assert found.high == pytest.approx(float(x + rest), rel=1e-13)
    form = LoopForm(a, b[None], "chain")
    states = np.linspace(-1.0, 2.0, count)[:, None]
    for cells, bounds in free_cells(form, np.eye(count) / form.scale, states):
        later = float(cells.starts.max() + cells.lengths[cells.starts.argmax()])
        with mpmath.workdps(50):
            for s in (0.0, 0.5, 3.0):
                exact = mpmath.expm(mpmath.matrix(form.a.tolist()) * (later + s)) * mpmath.matrix(states.tolist())
                for row in range(count):
                    assert abs(exact[row]) <= bounds[row] * float(form.scale[row]) * (1 + 1e-12)


def _quintic(tau):
    return 10 * tau**3 - 15 * tau**4 + 6 * tau**5


def test_stiff_loop():
    """A filter that is a million times faster than the lag shifts its response by its own time constant."""
    fast = 4e6
    loop = ct.ss(
        [[-4.0, 4.0], [0.0, -fast]], [[0.0], [fast]], [[-1.0, 0.0]], [[1.0]], inputs="r", outputs="e", name="s"
    )
    plan = QUINTIC.retime(2.0)
    t, error = lag_error(2)
    peak = along(LAG, plan).extremes({"e": 1.0})
    found = along(loop, plan).extremes({"e": 1.0})
    # e = r - G F r, F = 1 - s/fast + ...: the peak grows by (G r)'/fast there.
    y = sympy.Rational(1) * sum(c * (t / 2) ** k for k, c in ((3, 10), (4, -15), (5, 6))) - error
    slope = float(sympy.diff(y, t).subs(t, peak.time_high).evalf(30))
    assert found.high - peak.high == pytest.approx(slope / fast, rel=1e-5)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_units_of_time_and_position_do_not_matter(unit):
    a, b = np.array([[0.0, 1.0], [-1000.0, -1.0]]), np.array([[0.0], [1000.0]])
    loop = ct.ss(a / unit, b / unit, [[1.0, 0.0]], [[0.0]], inputs="r", outputs="y", name="loop")
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(0.3 * unit, 1e-9, 0, 0)])
    found = along(loop, plan).extremes({"y": 1.0})
    reference = along(SERVO, QUINTIC.retime(0.3)).extremes({"y": 1.0})
    assert found.high == pytest.approx(1e-9 * reference.high, rel=1e-12)
    assert found.time_high == pytest.approx(unit * reference.time_high, rel=1e-6)


def servo_with_feedforward():
    """Second-order plant k/(s^2 + s) in a loop with the feedforward (r_d2 + r_d1)/k: y = r exactly."""
    a = np.array([[0.0, 1.0], [-50.0, -5.0]])  # the plant, with u = u_ff - 50 y - 4 v
    return ct.ss(
        a,
        [[0.0, 0.0, 0.0], [50.0, 5.0, 1.0]],
        [[1.0, 0.0], [-1.0, 0.0], [-50.0, -4.0]],
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [50.0, 5.0, 1.0]],
        inputs=["r", "r_d1", "r_d2"],
        outputs=["y", "e", "u"],
        name="servo",
    )


def test_feedforward_inputs_are_derivatives_of_the_plan():
    """With the inverse of the plant as feedforward the output is the plan, and the control its v' + v."""
    plan = SEPTIC.retime(0.7)
    response = along(servo_with_feedforward(), plan)
    error = response.extremes({"e": 1.0})
    assert max(abs(error.low), abs(error.high)) <= 1e-13
    reference = plan.extrema_of(lambda jet: jet[2, 0] + jet[1, 0], 2)
    control = response.extremes({"u": 1.0})
    assert control.high == pytest.approx(float(reference.maximum[0]), rel=1e-9)
    assert control.low == pytest.approx(float(reference.minimum[0]), rel=1e-9)
    assert control.time_high == pytest.approx(float(reference.time_max[0]), abs=1e-5)


def test_sources_inside_are_the_plan():
    """The same loop with a source of the plan and two derivatives inside, of any duration."""
    plan = SEPTIC.retime(0.7)
    source = cp.create_source_iosystem(plan, 2, labels="r")
    loop = ct.interconnect([source, servo_with_feedforward()], inputs=0, outputs=["y", "u", "e"], name="closed")
    inside, outside = cp.loop_quantities(loop), cp.loop_quantities(servo_with_feedforward())
    for duration in (0.7, 0.3):
        other = plan.retime(duration)
        found = inside.quantities_of(other).extremes({"u": 1.0})
        assert found.high == pytest.approx(outside.quantities_of(other).extremes({"u": 1.0}).high, rel=1e-12)
    with pytest.raises(ValueError, match="must be those of the plan under limits, got another plan with the axis y"):
        inside.quantities_of(VIA)


def test_axes_by_name_and_other_inputs_are_zero():
    """Two axes are fed by the labels of the plan in any order; a disturbance without an axis is 0."""
    mixed = ct.ss(
        -np.diag([3.0, 5.0]), [[0.0, 3.0, 1.0], [5.0, 0.0, 1.0]], np.eye(2), np.zeros((2, 3)),
        inputs=["b", "a", "d"], outputs=["ya", "yb"], name="mixed",
    )  # fmt: skip
    plan = cp.stack([QUINTIC, 2.0 * QUINTIC], labels=("a", "b"))
    response = along(mixed, plan)
    for name, rate, size in (("ya", 3.0, 1.0), ("yb", 5.0, 2.0)):
        lag = ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs="r", outputs="y")
        for first, last in ((0.5, 0.9), (1.5, 2.0)):
            one = along(lag, QUINTIC).extremes({"y": size}, during=(first, last))
            found = response.extremes({name: 1.0}, during=(first, last))
            assert (found.low, found.high) == pytest.approx((one.low, one.high), rel=1e-13)
    rest = response.extremes({"d": 1.0})
    assert (rest.low, rest.high) == (0.0, 0.0)
    with pytest.raises(ValueError, match="inputs of mixed must be as many as the axes of the plan, or be named after"):
        along(mixed, QUINTIC)


def test_values_for_figures():
    """Along the plan and after it they are those of the simulation, rates included."""
    plan = QUINTIC.retime(0.36).shift(2.0)
    times = np.linspace(2.0, 12.0, 5001)
    y = cp.simulate(SERVO, times, plan).outputs
    response = along(SERVO, plan)
    np.testing.assert_allclose(response.values({"y": 1.0}, times), y, rtol=0, atol=1e-12)
    slopes = np.gradient(np.asarray(y), times, edge_order=2)
    np.testing.assert_allclose(response.values({"y": 1.0}, times, rate=True), slopes, rtol=0, atol=1e-2)
    assert response.values({"y": 1.0}, np.array([1e6]))[0] == pytest.approx(1.0, abs=1e-12)


def test_exposed_states_are_signals():
    loop = cp.expose_states(SERVO)
    plan = QUINTIC.retime(0.36)
    response = along(loop, plan)
    speed = response.extremes({"plant_x_0_state": 1.0})  # of the controllable form: a multiple of the rate of y
    rate = response.extremes({"y": 1.0}, rate=True)
    assert speed.high / rate.high == pytest.approx(speed.low / rate.low, rel=1e-12)


def test_both_values_at_a_jump():
    """A controller with direct feedthrough of the velocity: at the jumps of its plan both sides count."""
    loop = ct.ss([[-2.0]], [[2.0, 0.0]], [[0.0]], [[0.0, 1.0]], inputs=["r", "r_d1"], outputs="u", name="direct")
    plan = cp.PolySpline([Waypoint(0, 0, 3.0, 0), Waypoint(1, 1, -2.0, 0)])
    found = along(loop, plan).extremes({"u": 1.0})
    assert (found.low, found.high) == pytest.approx(
        (min(-2.0, plan.extrema(1).minimum[0]), max(3.0, plan.extrema(1).maximum[0])), rel=1e-12
    )
    after = along(loop, plan).extremes({"u": 1.0}, during=(1.0, 2.0))
    assert (after.low, after.high) == pytest.approx((-2.0, 0.0), abs=1e-12)
    with pytest.raises(ValueError, match="must be continuous, got u that jumps with derivative 1 of the plan, at 0 %"):
        along(loop, plan).extremes({"u": 1.0}, rate=True)


def test_integrators_whose_input_ends_at_zero():
    """A double integrator behind a lag, fed by the acceleration of the plan, ends at the position of the plan."""
    loop = ct.ss(
        [[-20.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        [[0.0, 0.0, 20.0], [0.0] * 3, [0.0] * 3],
        [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]],
        np.zeros((2, 3)),
        inputs=["r", "r_d1", "r_d2"],
        outputs=["y", "v"],
        name="carriage",
    )
    plan = cp.PolySpline([Waypoint(0, 2, 0, 0), Waypoint(1, 5, 0, 0)])
    response = along(loop, plan)
    found = response.extremes({"y": 1.0})
    assert (found.low, found.high) == pytest.approx((2.0, 5.0), abs=1e-13)  # lagged, without overshoot
    late = response.extremes({"y": 1.0}, during=(50.0, 60.0))
    assert (late.low, late.high) == pytest.approx((5.0, 5.0), abs=1e-13)
    speed = response.extremes({"v": 1.0})
    lag = ct.ss([[-20.0]], [[0.0, 20.0]], [[1.0]], [[0.0, 0.0]], inputs=["r", "r_d1"], outputs="v", name="lag")
    assert speed.high == pytest.approx(along(lag, plan).extremes({"v": 1.0}).high, rel=1e-12)


def test_what_a_loop_must_be():
    pole = ct.ss([[0.3]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y", name="runaway")
    with pytest.raises(ValueError, match=r"must be stable .* got runaway with a pole at 0.3 in the right half"):
        along(pole, QUINTIC)
    ringing = ct.ss([[0.0, 7.0], [-7.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]], inputs="r", outputs="y", name="m")
    with pytest.raises(ValueError, match=r"must be damped .* got m with an undamped pole at 0 ± 7j rad/s"):
        along(ringing, QUINTIC)
    integrator = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y", name="tank")
    with pytest.raises(ValueError, match=r"the input of an integrator of tank must be 0 at the end of the plan"):
        along(integrator, QUINTIC).extremes({"y": 1.0})
    with pytest.raises(ValueError, match=r"must start at rest .* got tank without an equilibrium at y = 2"):
        along(integrator, cp.PolySpline([Waypoint(0, 2, 0, 0), Waypoint(1, 3, 0, 0)]))
    started = cp.declare(ct.ss([[-4.0]], [[4.0]], [[1.0]], [[0.0]], inputs="r", outputs="y"), initial_state=[0.5])
    with pytest.raises(ValueError, match=r"must start at rest .* or a block declares another initial state"):
        along(started, QUINTIC)
    with pytest.raises(ValueError, match="signals of the loop must be among y, e, r, got 'z'"):
        along(LAG, QUINTIC).extremes({"z": 1.0})
    with pytest.raises(ValueError, match="period must be above 0 and finite, got -1 s"):
        along(LAG, QUINTIC).rms("y", period=-1.0)


def test_modes_that_hardly_decay():
    """The first oscillations after the move are the largest; a signal that would have to decay first is an error."""
    w, damping = 100.0, 1e-8
    loop = ct.ss(
        [[0.0, w], [-w, -2.0 * damping * w]], [[0.0], [w]], np.eye(2), np.zeros((2, 1)), inputs="r", outputs=["y", "v"],
        name="beam",
    )  # fmt: skip
    response = along(loop, QUINTIC.retime(0.1))
    found = response.extremes({"y": 1.0})
    times = np.linspace(0.0, 1.0, 100_001)
    y = cp.simulate(loop, times, QUINTIC.retime(0.1)).outputs["y"]
    assert found.high == pytest.approx(y.max(), rel=1e-6)
    with pytest.raises(ValueError, match=r"must decay within 100000 cells .* got beam with a pole at -1e-06 ± 100j"):
        response.extremes({"y": 1.0}, during=(1e12, 2e12))


@pytest.mark.parametrize("seed", range(6))
def test_values_at_single_times(seed):
    """An interval of no length gives the value there, to 1e-12 of the range, along the plan and after it."""
    rng = np.random.default_rng([seed, 19])
    loop = random_loop(rng, order=seed % 3)
    plan = (QUINTIC, VIA, S_CURVE)[seed % 3]
    duration = 10.0 ** rng.uniform(-1.5, 1.0)
    steps, spacing = 64, 0.5
    dense = responses(loop, plan, [duration], steps=steps, tail=100, spacing=spacing)[0]
    ends = plan.breakpoints / plan.duration * duration
    along_plan = np.concatenate([np.linspace(a, b, steps + 1) for a, b in pairwise(ends)])
    after = duration + spacing / np.abs(np.linalg.eigvals(loop[0])).max() * np.arange(100)
    times = np.concatenate([along_plan, after])
    response = along(system_of(loop), plan.retime(duration))
    for name, row in zip(("y1", "y2"), dense, strict=True):
        inner = np.setdiff1d(np.arange(times.size), np.flatnonzero(np.isin(times, ends)))  # both sides of a jump
        for k in rng.choice(inner, 12, replace=False):
            found = response.extremes({name: 1.0}, during=(times[k], times[k]))
            assert found.low == pytest.approx(row[1 + k], rel=0, abs=3e-12 * np.ptp(row))
            assert found.high == found.low or found.high == pytest.approx(found.low, rel=0, abs=3e-12 * np.ptp(row))
