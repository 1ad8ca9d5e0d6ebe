"""Accuracy in the signals' own scale: a millionth of each range, from nanometres to meganewtons, whatever the units."""

from functools import cache

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan.simulation.scales import Scales, effects

METHODS = ["compiled", "python"]
ALLOWED = 1e-6


def stage(size, kind):
    """Saturation in front of 1e6/(s^2 + 200 s + 1e6), for signals of some size."""
    plant = ct.tf([1e6], [1, 200, 1e6], inputs="u", outputs="y", name="plant")
    if kind == "ss":
        plant = ct.ss([[0, 1], [-1e6, -200]], [[0], [1e6]], [[1, 0]], [[0]], inputs="u", outputs="y", name="plant")

    def out(t, x, u, params):
        return [np.clip(u[0], -0.7 * size, 0.7 * size)]

    limiter = ct.nlsys(None, out, inputs="r", outputs="u", dt=0, name="limiter")
    return ct.interconnect([limiter, plant], inputs="r", outputs=["y", "u"])


@cache
def stage_by_hand():
    """The same for signals of size 1: a plan, times and outputs, with integration stopped where the limit is met."""
    plan, t = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(0.02, 1, 0, 0)]), np.linspace(0, 0.04, 201)
    roots = [r.real for r in np.roots([6, -15, 10, 0, 0, -0.7]) if abs(r.imag) < 1e-12 and 0 < r.real < 1]
    met = 0.02 * roots[0]
    y = np.empty_like(t)
    x = np.zeros(2)
    for left, right in ((0.0, met), (met, t[-1])):
        inside = (t >= left) & (t <= right)
        found = solve_ivp(
            lambda s, z: [z[1], 1e6 * (min(float(plan(s)), 0.7) - z[0]) - 200 * z[1]],
            (left, right),
            x,
            t_eval=np.union1d(t[inside], [right]),
            method="DOP853",
            rtol=1e-12,
            atol=[1e-13, 1e-10],
        )
        x = found.y[:, -1]
        y[inside] = found.y[0, : inside.sum()]
    return plan, t, y


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["tf", "ss"])
@pytest.mark.parametrize("size", [1e-9, 1e-3, 1e6])
def test_a_stage_of_any_size_in_any_realisation(size, kind, method):
    unit, t, expected = stage_by_hand()
    found = cp.simulate(stage(size, kind), t, size * unit, method=method)
    assert np.abs(found.outputs[0] / size - expected).max() < ALLOWED


@pytest.mark.parametrize("method", METHODS)
def test_signals_fifteen_powers_of_ten_apart_in_one_loop(method):
    """A force of meganewtons, a displacement of nanometres: x'' = F/m with a spring that stiffens."""
    size_x, size_f, mass = 2.0**-30, 1e6, 1e6 * 2.0**30

    def rates(t, x, u, params):
        return [x[1], (u[0] - size_f * ((x[0] / size_x) + (x[0] / size_x) ** 3) - 2 * size_f * x[1] / size_x) / mass]

    block = ct.nlsys(rates, inputs="F", outputs=2, states=["x", "v"], name="stage")
    # In units of its own, as mass size_x = size_f: z'' = F - z - z^3 - 2 z'.
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(3, 1, 0, 0)])
    t = np.linspace(0, 8, 161)
    expected = solve_ivp(
        lambda s, z: [z[1], float(plan(s)) - z[0] - z[0] ** 3 - 2 * z[1]],
        (0, 8),
        [0, 0],
        t_eval=t,
        method="DOP853",
        rtol=1e-12,
        atol=1e-14,
    ).y
    found = cp.simulate(block, t, size_f * plan, method=method)
    errors = np.abs(found.outputs / size_x - expected).max(axis=1) / np.ptp(expected, axis=1)
    assert errors.max() < ALLOWED


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("moved", [1e-3, 1e-6, 1e-8])
def test_a_signal_that_moves_little_about_an_offset(moved, method):
    """A tank about 10 m whose inflow differs by very little, against its displacement alone."""

    def rates(t, x, u, params):
        return [u[0] - np.sqrt(x[0] / 10.0)]

    block = ct.nlsys(rates, inputs="q", outputs="h", states="h", name="tank")
    t = np.linspace(0, 60, 61)
    found = cp.simulate(block, t, 1.0 + moved, 10.0, method=method)
    # With s = sqrt(h/10): 20 s s' = 1 + m - s; in its displacement z = s - 1: 20 (1 + z) z' = m - z.
    small = solve_ivp(
        lambda _, z: (moved - z) / (20.0 * (1.0 + z)), (0, 60), [0.0], t_eval=t, method="DOP853", rtol=1e-13, atol=1e-30
    ).y[0]
    expected = 10.0 * (2.0 * small + small**2)
    rounding = 4.0 * np.finfo(float).eps * 10.0
    assert np.abs(found.outputs - 10.0 - expected).max() < ALLOWED * expected[-1] + rounding


@pytest.mark.parametrize("method", METHODS)
def test_a_car_at_speed_against_its_closed_form(method):
    """Unbounded growth of an angle's error: a circle, in closed form."""
    speed, steer = 10.0, 0.1

    def rates(t, x, u, params):
        return [speed * np.cos(x[2]), speed * np.sin(x[2]), speed / 3.0 * np.tan(u[0])]

    block = ct.nlsys(rates, inputs="delta", outputs=3, states=["x", "y", "theta"], name="car")
    t = np.linspace(0, 10, 101)
    found = cp.simulate(block, t, steer, method=method)
    rate = speed / 3.0 * np.tan(steer)
    expected = np.array([np.sin(rate * t), 1.0 - np.cos(rate * t), rate * t]) * [[speed / rate]] * 1.0
    expected[2] = rate * t
    assert (np.abs(found.outputs - expected).max(axis=1) / np.ptp(expected, axis=1)).max() < ALLOWED


def test_a_state_that_is_still_but_for_rounding_is_not_chased():
    """A difference of two equal motions stays at rounding level, and the run ends as soon as without it."""
    count = [0]

    def rates(t, x, u, params):
        count[0] += 1
        return [u[0] - x[0], u[0] - x[1], (x[0] * 0.1 - x[1] * 0.1) * 3.0 - x[2]]

    block = ct.nlsys(rates, inputs="r", outputs=3, states=3, name="twins")
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(3, 1, 0, 0)])
    found = cp.simulate(block, np.linspace(0, 5, 51), plan, [0.3, 0.3, 0.0], method="python")
    assert np.abs(found.outputs[2]).max() < 1e-12
    assert count[0] < 20_000


def test_outputs_that_cancel_say_how_uncertain_they_are():
    """The difference of two states of size 10 that differ by 2e-4: said, with a tolerance that does better."""

    def rates(t, x, u, params):
        return [u[0] - 1e-3 * x[0], u[0] - 1e-3 * x[1] + 1e-4 * np.sin(x[1])]

    block = ct.nlsys(rates, lambda t, x, u, params: [x[1] - x[0]], inputs="r", outputs="y", states=2, name="bridge")
    found = cp.simulate(block, np.linspace(0, 10, 11), 1.0)
    assert "outputs y are differences of larger terms and are uncertain by about" in found.reason
    tolerance = float(found.reason.split("rtol = ")[1].split(" suffices")[0])
    better = cp.simulate(block, np.linspace(0, 10, 11), 1.0, rtol=0.5 * tolerance)
    assert "uncertain" not in better.reason


def test_an_absolute_tolerance_given_is_absolute():
    """A number is the absolute tolerance of every state: motion below it is not resolved."""
    t = np.linspace(0, 0.04, 201)
    plan = 1e-6 * cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(0.02, 1, 0, 0)])
    rough, fine = (cp.simulate(stage(1e-6, "tf"), t, plan, atol=atol, method="python") for atol in (1e-3, None))
    assert np.abs(rough.outputs[0] - fine.outputs[0]).max() > 1e-8
    for atol in (0.0, -1.0, np.nan, True, "small"):
        with pytest.raises(ValueError, match="atol must be a finite number above 0"):
            cp.simulate(stage(1.0, "tf"), t, plan, atol=atol)


@pytest.mark.parametrize("method", METHODS)
def test_many_samples_whose_segments_errors_add_up(method):
    """A car steered by a hundred samples: against an integration from sample to sample at 1e-13."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, 10, 100)
    inputs = np.array([10 + 0.3 * np.sin(3 * t), 0.1 * np.cos(2 * t) + 0.05 * rng.standard_normal(100)])

    def rates(x, v, delta):
        return [np.cos(x[2]) * v, np.sin(x[2]) * v, v / 3.0 * np.tan(delta)]

    expected = np.zeros((3, t.size))
    for k in range(t.size - 1):
        slope = (inputs[:, k + 1] - inputs[:, k]) / (t[k + 1] - t[k])
        run = solve_ivp(
            lambda s, x, k=k, slope=slope: rates(x, *(inputs[:, k] + slope * (s - t[k]))),
            (t[k], t[k + 1]),
            expected[:, k],
            method="DOP853",
            rtol=1e-13,
            atol=1e-13,
        )
        expected[:, k + 1] = run.y[:, -1]
    block = ct.nlsys(lambda t, x, u, p: rates(x, *u), inputs=2, outputs=3, states=3, name="car")
    found = cp.simulate(block, t, inputs, method=method)
    assert (np.abs(found.outputs - expected).max(axis=1) / np.ptp(expected, axis=1)).max() < ALLOWED


@pytest.mark.parametrize("method", METHODS)
def test_a_pendulum_that_falls_from_upright_is_accurate_or_says_that_it_is_not(method):
    """Errors grow by a factor of 1e11 on the way: within a millionth, and its doubt is said with a tolerance."""

    def rates(t, x):
        return [x[1], 9.0 * np.sin(x[0]) - 0.2 * x[1]]

    t = np.linspace(0, 9, 91)
    expected = solve_ivp(rates, (0, 9), [1e-8, 0], t_eval=t, method="DOP853", rtol=1e-13, atol=1e-20).y
    block = ct.nlsys(lambda t, x, u, p: rates(t, x), inputs=0, outputs=2, states=2, name="pendulum")
    found = cp.simulate(block, t, None, [1e-8, 0.0], method=method)
    assert (np.abs(found.outputs - expected).max(axis=1) / np.ptp(expected, axis=1)).max() < ALLOWED
    assert "diverge from neighbouring solutions and are uncertain by about" in found.reason


def turning(rate, phase, speed, start, duration, nsamples):
    """Positions and angle of a car whose angle grows by phase(t), by Gauss quadrature in cells shorter than a turn."""
    count = nsamples * int(np.ceil(4.0 * rate * duration / nsamples))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    edges = np.linspace(0.0, duration, count + 1)
    half = 0.5 * duration / count
    inner = edges[:-1, None] + half * (1.0 + nodes)
    angle = start + phase(inner)
    speeds = np.stack([np.cos(angle), np.sin(angle)]) @ weights * speed * half
    path = np.concatenate([np.zeros((2, 1)), np.cumsum(speeds, axis=1)], axis=1)[:, :: count // nsamples]
    return np.vstack([path, start + phase(edges[:: count // nsamples])])


def rough_turns(scale, method, start=2e4, mean=100.0, ripple=1000.0, duration=2.5):
    """Error, relative to each range, of a car whose angle is huge and whose yaw rate ripples; and its response."""
    speed = mean

    def rates(t, x, u, params):
        rate = mean * (1.0 + 0.5 * np.sin(ripple * t))
        return [speed * np.cos(scale * x[2]), speed * np.sin(scale * x[2]), rate / scale]

    car = ct.nlsys(rates, inputs=0, outputs=3, states=3, name="car")
    t = np.linspace(0.0, duration, 101)
    expected = turning(
        ripple,
        lambda t: mean * (t + (1.0 - np.cos(ripple * t)) / (2.0 * ripple)),
        speed,
        start,
        duration,
        100,
    )
    expected[2] /= scale
    found = cp.simulate(car, t, None, [0.0, 0.0, start / scale], method=method)
    return np.abs(found.outputs - expected).max(axis=1) / np.ptp(expected, axis=1), found


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 7.0, 1e4], ids=["angle", "pole pairs", "turns in small units"])
def test_positions_that_depend_on_the_sine_of_a_huge_angle(scale):
    """The tolerance relative to an angle is too large for what depends on its sine: here far below rtol = 1e-8."""
    errors, found = rough_turns(scale, "compiled")
    assert errors.max() < 2e-9
    assert "uncertain" not in found.reason


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "start", "duration"), [("compiled", 0.0, 50.0), ("python", 0.0, 2.5), ("python", 1e4, 2.5)]
)
def test_many_turns_with_a_rippling_rate(method, start, duration):
    """As far as 1250 rad in 8,000 periods of a ripple."""
    errors, found = rough_turns(1.0, method, start, 25.0, 1000.0, duration)
    assert errors.max() < 1e-7 or "depend on small fractions of large states" in found.reason
    assert errors.max() < ALLOWED


def test_a_lasting_displacement_through_frozen_equations():
    """Against the mean, weighted by exp(-t/T), of the solution of x' = J x + e/T by a matrix exponential."""
    duration = 3.0
    slopes = np.array(
        [[[0.0, 2.0, 0.0], [-1.0, -0.3, 0.0], [5.0, 0.0, -1.0]], [[0.0, -4.0, 7.0], [0.0] * 3, [0.0] * 3]]
    )
    expected = np.zeros((3, 3))
    for slope in slopes:
        # The weighted mean of exp(J s), s >= 0, by Gauss-Laguerre, exact to 1e-10 for these slow motions.
        steps, weights = np.polynomial.laguerre.laggauss(150)
        mean = sum(w * expm(slope * duration * s) for s, w in zip(steps, weights, strict=True) if w > 1e-30)
        expected = np.maximum(expected, np.abs(mean))
    np.fill_diagonal(expected, 0.0)
    assert effects(slopes, duration) == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_a_plant_that_is_fed_by_the_phase_of_an_oscillator():
    """x' = cos(phase) - x with a rippling frequency, by Gauss quadrature of its impulse response."""
    mean, ripple, duration, start = 25.0, 1000.0, 10.0, 2e4

    def rates(t, x, u, params):
        return [np.cos(x[1]) - x[0], mean * (1.0 + 0.5 * np.sin(ripple * t))]

    block = ct.nlsys(rates, lambda t, x, u, params: x[0], inputs=0, outputs="y", states=2, name="oscillator")
    t, edges = np.linspace(0.0, duration, 101), np.linspace(0.0, duration, 20_001)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    half = 0.5 * edges[1]
    inner = edges[:-1, None] + half * (1.0 + nodes)
    phase = start + mean * (inner + (1.0 - np.cos(ripple * inner)) / (2.0 * ripple))
    sums = np.cumsum((np.cos(phase) * np.exp(inner)) @ weights * half)
    expected = (np.exp(-edges) * np.append(0.0, sums))[::200]
    found = cp.simulate(block, t, None, [0.0, start], method="compiled")
    assert np.abs(found.outputs - expected).max() < ALLOWED * np.ptp(expected)
    assert "uncertain" not in found.reason


def calls_of_a_car_with_a_noisy_signal(size):
    """Calls of its equations; its angle is huge, and nothing depends on the signal, which has some size."""
    calls = 0

    def rates(t, x, u, params):
        nonlocal calls
        calls += 1
        noise = 1e-9 * np.sin(1e17 * t)
        return [100.0 * np.cos(x[2]), 100.0 * np.sin(x[2]), 100.0, size * (np.cos(t) + noise)]

    car = ct.nlsys(rates, inputs=0, outputs=4, states=4, name="car")
    t, start = np.linspace(0.0, 2.5, 101), 2e4
    angle = start + 100.0 * t
    expected = np.array([np.sin(angle) - np.sin(start), np.cos(start) - np.cos(angle), angle, size * np.sin(t)])
    found = cp.simulate(car, t, None, [0.0, 0.0, start, 0.0], method="python")
    assert np.all(np.abs(found.outputs - expected).max(axis=1) < ALLOWED * np.ptp(expected, axis=1))
    return calls


@pytest.mark.slow
def test_a_large_state_that_nothing_depends_on_is_not_integrated_more_closely():
    small, large = (calls_of_a_car_with_a_noisy_signal(size) for size in (1.0, 1e8))
    assert large < 2 * small


def test_a_state_held_at_zero_by_others_has_no_smaller_scale_than_their_errors():
    """x0 = 10 rounds to 1e-15 and feeds x1 with slope 2: x1 is rounding, and its scale does not follow it to zero."""
    noise, eps, both = np.array([1e-14, 0.0]), 1e-15, np.arange(2)
    scales = Scales.plain(2, None)
    for size in (1e-15, 1e-19, 1e-24):
        states = np.array([[10.0, 10.0 + eps, 10.0], [0.0, size, -size]])
        found = scales.renewed(states, both, lambda: noise, lambda errors: np.array([0.0, 2.0 * errors[0]]))
        scales = scales if found is None else found
        assert scales.scale[0] == pytest.approx(1e-3)  # 1e11 times the noise
        assert scales.scale[1] == pytest.approx(2e-6)  # a thousandth of what that displaces it by
    # A small motion of its own, which no other state feeds, is resolved.
    states = np.array([[10.0, 10.0 + eps, 10.0], [0.0, 1e-19, -1e-19]])
    found = Scales.plain(2, None).renewed(states, both, lambda: noise, np.zeros_like)
    assert found.scale[1] == pytest.approx(1e-19)
