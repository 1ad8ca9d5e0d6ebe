"""Vibration left in a mode: against simulation, closed forms, and integrals in 60 digits."""

import itertools
import math

import control as ct
import mpmath as mp
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlplan as cp

QUINTIC = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
PLANS = {
    "quintic": QUINTIC,
    "late": QUINTIC.shift(3.0),
    "s-curve": cp.SCurve(2.0, 1.0, velocity=3.0, acceleration=20.0, jerk=300.0, time=1.0),
    "trapezoid": cp.Trapezoid(-1.0, velocity=8.0, acceleration=30.0),
    "step": cp.Step(1.0, -0.5, 0.2),
    "jumps": cp.PolySpline([cp.Waypoint(0, 0.0), cp.Waypoint(1, 1.0, 1.0)]).then(cp.Step(2.0, 1.0)),
    "three segments": cp.PiecewiseSpline(
        [cp.Waypoint(0, 0), cp.Waypoint(1, 1), cp.Waypoint(1.5, -1), cp.Waypoint(3, 0)]
    ),
    "trigonometric": cp.TrigSpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0, 0)], alpha=3.0),
    "shaped": cp.Shaper.ei(7.0, 0.1)(cp.Step(1.0)),
    "shaped on a grid": cp.Shaper.zvd(7.0, 0.1).on_grid(0.013)(QUINTIC),
}
DAMPING = [0.0, 0.05, 0.3, 0.99]
every = pytest.mark.parametrize("name", PLANS)


def exact(plan, omega, zeta):
    """The amplitude by integration by parts of polynomial segments, in 60 digits."""
    with mp.workdps(60):
        root = mp.sqrt(1 - mp.mpf(zeta) ** 2)
        p = mp.mpf(omega) * (mp.mpf(zeta) + 1j * root)
        cuts = [mp.mpf(float(b)) for b in plan.breakpoints]
        total = mp.mpc(0)
        for i, (begin, end) in enumerate(itertools.pairwise(cuts)):
            h = end - begin
            at_start = [mp.mpf(float(v)) for v in plan.segment_jet(i, np.zeros(1), 12)[1:, 0, 0]]
            n = len(at_start)
            at_end = [sum(at_start[k + m] * h**m / mp.factorial(m) for m in range(n - k)) for k in range(n)]
            part = sum((-1) ** k * (at_end[k] - at_start[k] * mp.exp(-p * h)) / p ** (k + 1) for k in range(n))
            total += part * mp.exp(-p * (cuts[-1] - end))
        return float(abs(total) / root)


@pytest.mark.parametrize("name", ["quintic", "late", "s-curve", "trapezoid", "three segments"])
@pytest.mark.parametrize("zeta", DAMPING)
def test_against_60_digits(name, zeta):
    """From w T = 0.01 to 1000."""
    plan = PLANS[name]
    omega = np.array([0.01, 1.0, 2.0 * math.pi, 17.3, 63.0, 250.0, 999.0, 1000.0]) / plan.duration
    found = cp.residual_spectrum(plan, omega, zeta)
    wanted = [exact(plan, w, zeta) for w in omega.tolist()]
    # 1e-10 of the move is the promise; measured 4e-15.
    size = float(plan.extrema().maximum[0] - plan.extrema().minimum[0])
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13 * size)


def quadrature(plan, omega, zeta):
    """The same of any smooth plan, by 60 Gauss nodes on pieces of a few periods."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    total, p = 0.0, omega * (zeta + 1j * math.sqrt(1 - zeta**2))
    pieces = max(4, int(2 * omega * plan.duration / 20))
    cuts = np.linspace(plan.start, plan.end, pieces + 1)
    for begin, end in itertools.pairwise(cuts):
        t = 0.5 * (begin + end) + 0.5 * (end - begin) * nodes
        total += 0.5 * (end - begin) * (plan(t, 1) * np.exp(-p * (plan.end - t))) @ weights
    return abs(total) / math.sqrt(1 - zeta**2)


@pytest.mark.parametrize("alpha", [1e-3, 1.0, 3.0])
@pytest.mark.parametrize("zeta", [0.0, 0.3])
def test_trigonometric_plans(alpha, zeta):
    """Also at the harmonics of their basis, where a division would be 0/0."""
    plan = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0, 0)], alpha=alpha)
    omega = np.concatenate([alpha / 2.0 * np.arange(5), [1.0, 30.0, 500.0]])
    wanted = [quadrature(plan, w, zeta) for w in omega.tolist()]
    np.testing.assert_allclose(cp.residual_spectrum(plan, omega, zeta), wanted, rtol=0, atol=1e-12)


def test_plans_of_a_high_degree():
    """Forty constraints: the velocity has more terms than the exponential."""
    points = [cp.Waypoint(k, math.sin(k)) for k in np.linspace(0, 3, 12).tolist()]
    plan = cp.PolySpline([cp.Waypoint(-0.3, -0.3, 0, 0), *points, cp.Waypoint(3.3, 0.1, 0, 0)], warn=False)
    size = float(np.ptp([plan.extrema().minimum, plan.extrema().maximum]))
    for omega in (0.1, 3.0, 40.0):
        found = float(cp.residual_spectrum(plan, omega)[0])
        assert found == pytest.approx(quadrature(plan, omega, 0.0), abs=1e-12 * size)


@every
@pytest.mark.parametrize("zeta", [0.0, 0.05, 0.9])
def test_against_a_simulated_mode(name, zeta):
    """Amplitude of the free oscillation after the plan, of a mode that starts at rest at its first position."""
    plan = PLANS[name]
    for omega in (0.7, 7.0, 40.0):
        mode = ct.ss([[0, 1], [-(omega**2), -2 * zeta * omega]], [[0], [omega**2]], np.eye(2), [[0], [0]], outputs=2)
        response = cp.simulate(mode, [plan.start - 1.0, plan.end], plan, [plan.initial[0], 0.0])
        y, slope = response.outputs[:, -1]
        y = y - plan.final[0]
        size = math.hypot(y, (slope + zeta * omega * y) / (omega * math.sqrt(1.0 - zeta**2)))
        assert float(cp.residual_spectrum(plan, omega, zeta)[0]) == pytest.approx(size, abs=1e-11)


@every
def test_at_zero_frequency_it_is_the_move(name):
    plan = PLANS[name]
    move = abs(float(plan.final[0] - plan.initial[0]))
    for zeta in DAMPING:
        found = float(cp.residual_spectrum(plan, [0.0], zeta)[0])
        assert found == pytest.approx(move / math.sqrt(1.0 - zeta**2), rel=1e-13, abs=1e-14)


@pytest.mark.parametrize("zeta", DAMPING)
def test_of_a_shaped_step_it_is_the_residual_of_the_shaper(zeta):
    shaper = cp.Shaper.zv(3.0, 0.1).then(cp.Shaper.ei(8.0))
    omega = np.linspace(0.0, 30.0, 101)
    found = cp.residual_spectrum(shaper(cp.Step(2.0)), omega, zeta)
    np.testing.assert_allclose(found, 2.0 * shaper.residual(omega, zeta) / math.sqrt(1 - zeta**2), rtol=0, atol=1e-13)


def test_a_shaper_multiplies_the_spectrum():
    """Convolution: that of the plan times the residual of the shaper."""
    shaper, zeta = cp.Shaper.two_hump_ei(9.0, 0.05), 0.02
    omega = np.linspace(0.1, 30.0, 64)
    found = cp.residual_spectrum(shaper(QUINTIC), omega, zeta)
    np.testing.assert_allclose(
        found, cp.residual_spectrum(QUINTIC, omega, zeta) * shaper.residual(omega, zeta), rtol=0, atol=1e-13
    )


def test_shapes():
    both = cp.stack([QUINTIC, 2.0 * QUINTIC], labels=["a", "b"])
    omega = np.array([1.0, 5.0, 9.0])
    found = cp.residual_spectrum(both, omega)
    assert found.shape == (2, 3)
    np.testing.assert_allclose(found[1], 2.0 * found[0], rtol=1e-14)
    np.testing.assert_allclose(found[0], cp.residual_spectrum(QUINTIC, omega), rtol=1e-14)
    assert cp.residual_spectrum(QUINTIC, 5.0).shape == (1,)
    each = cp.residual_spectrum(QUINTIC, omega, [0.0, 0.1, 0.2])
    for k, zeta in enumerate((0.0, 0.1, 0.2)):
        assert each[k] == cp.residual_spectrum(QUINTIC, omega, zeta)[k]


def test_very_high_frequencies():
    """w T = 2e5: the jerk's jumps, 60 at both ends of the quintic, leave |60 (e^(-iw) - 1)|/w^3 and higher powers."""
    omega = 2e5
    leading = abs(60.0 * (np.exp(-1j * omega) - 1.0)) / omega**3
    assert float(cp.residual_spectrum(QUINTIC, omega)[0]) == pytest.approx(leading, abs=1e-13)


def test_retimed_plans_with_a_time_law():
    law = cp.PolySpline([cp.Waypoint(0.0, 0.0, 0.5), cp.Waypoint(1.0, 1.0, 1.5)])
    plan = cp.Retimed(QUINTIC, law)
    assert float(cp.residual_spectrum(plan, 12.0)[0]) == pytest.approx(quadrature(plan, 12.0, 0.0), abs=1e-12)


def test_a_mode_that_starts_from_rest_in_closed_form():
    """Constant velocity over T: 2 |sin(w T/2)|/(w T) of the move, by the exponential of the chain as well."""
    ramp = cp.PolySpline([cp.Waypoint(0.0, 0.0), cp.Waypoint(2.0, 1.0)])
    for omega in (0.3, math.pi, 5.0):
        wanted, angle = abs(math.sin(omega)) / omega, 2.0 * omega  # whose rounding is that of its size
        rounding = 4.0 * np.finfo(float).eps * (1.0 + angle)
        assert float(cp.residual_spectrum(ramp, omega)[0]) == pytest.approx(wanted, abs=rounding)
        chain = np.array([[0, 1, 0, 0], [-(omega**2), 0, omega**2, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
        y, slope = (expm(2.0 * chain) @ [0.0, 0.0, 0.0, 0.5])[:2]
        assert math.hypot(y - 1.0, slope / omega) == pytest.approx(wanted, abs=1e-13)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((QUINTIC, [1.0, -1.0]), r"frequencies must be at least 0, got frequencies\[1\] = -1.0"),
        ((QUINTIC, [1.0, math.nan]), r"frequencies must be finite, got frequencies\[1\] = nan$"),
        ((QUINTIC, [math.inf] * 400), r"frequencies must be finite, got frequencies\[0\] = inf$"),
        ((QUINTIC, [1.0, math.inf]), "frequencies must be finite"),
        ((QUINTIC, []), "frequencies must be a scalar or of shape"),
        ((QUINTIC, [[1.0]]), "frequencies must be a scalar or of shape"),
        ((QUINTIC, [1.0, 1e12]), "frequencies must be at most 1e[+]08 rad/s for a plan of 1 s, got 1e[+]12"),
        ((QUINTIC, 1.0, 1.0), r"damping must lie in \[0, 1\), got 1.0"),
        ((QUINTIC, 1.0, -0.1), r"damping must lie in \[0, 1\), got -0.1"),
        ((QUINTIC, 1.0, math.nan), r"damping must lie in \[0, 1\), got nan"),
        ((QUINTIC, [1.0, 2.0, 3.0], [0.1, 0.2]), r"damping must be a number or one for each of the 3 frequencies"),
    ],
)
def test_what_is_rejected(arguments, message):
    for function in (cp.residual_spectrum, cp.residual_plot):
        if np.ndim(arguments[1]) == 0:
            arguments = (arguments[0], [arguments[1]], *arguments[2:])
        with pytest.raises(ValueError, match=message.replace("a scalar or ", "(a scalar or )?")):
            function(*arguments)


def test_kinds_that_are_rejected():
    for function in (cp.residual_spectrum, cp.residual_plot):
        with pytest.raises(TypeError, match="plan must be a Trajectory, got float"):
            function(1.0, [1.0])
