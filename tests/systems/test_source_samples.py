"""Samples of a plan for control.forced_response, and the error of linear interpolation."""

import control as ct
import mpmath as mp
import numpy as np
import pytest

import ctrlplan as cp

PLAN = cp.stack(
    [cp.TrigSpline([cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(2.5, 1, 0, 0)], alpha=1.0), cp.Step(2.0, time=1.0)],
    labels=["x", "z"],
)
QUINTIC = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])


def test_order_is_that_of_the_block():
    t = np.linspace(0.0, 4.0, 33)
    samples = cp.source_samples(PLAN, t, derivatives=2)
    block = cp.create_source_iosystem(PLAN, derivatives=2)
    assert samples.shape == (6, 33)
    one_by_one = np.array([block.output(x, np.zeros(0), np.zeros(0)) for x in t]).T
    scale = np.maximum(1.0, np.abs(one_by_one).max(axis=1, keepdims=True))
    assert np.abs((samples - one_by_one) / scale).max() <= 1e-14
    assert np.abs(samples - [f(t, nu)[axis] for axis in range(2) for nu, f in enumerate([PLAN] * 3)]).max() <= 1e-13


def test_a_single_signal_has_one_dimension():
    assert cp.source_samples(QUINTIC, [0.0, 0.5, 1.0]).tolist() == [0.0, 0.5, 1.0]
    assert cp.source_samples(QUINTIC, [0.0, 0.5, 1.0], derivatives=1).shape == (2, 3)
    assert cp.source_samples(PLAN, [0.0, 0.5]).shape == (2, 2)


def test_one_time_is_one_sample():
    assert cp.source_samples(QUINTIC, 0.5).tolist() == [0.5]
    assert cp.source_samples(PLAN, 3.0).tolist() == [[1.0], [2.0]]


def test_bad_times():
    with pytest.raises(ValueError, match="times must not be nan"):
        cp.source_samples(QUINTIC, [0.0, np.nan])


def quintic_response(times, gain):
    """Response of k/(s^2 + s) in unity feedback to 10 t^3 - 15 t^4 + 6 t^5 on [0, 1], in closed form and 40 digits.

    1 - y = sum over both poles p of residue exp(p t): particular solutions of the polynomial, and what is left of them.
    """
    with mp.workdps(40):
        k = mp.mpf(gain)
        root = mp.sqrt(1 - 4 * k)
        poles = [(-1 + root) / 2, (-1 - root) / 2]
        weights = [k / root, -k / root]  # of exp(p t) in the impulse response
        coefficients = [mp.mpf(c) for c in (0, 0, 0, 10, -15, 6)]

        def moment(p, t):
            """Integral of exp(p (t - s)) r(s) over s from 0 to t, t <= 1, by parts."""
            total, derivative = mp.mpf(0), list(coefficients)
            for n in range(6):
                here = mp.fsum(c * t**j for j, c in enumerate(derivative))
                total += (mp.exp(p * t) * derivative[0] - here) / p ** (n + 1)
                derivative = [j * c for j, c in enumerate(derivative)][1:] or [mp.mpf(0)]
            return total

        out = []
        for t in map(mp.mpf, times):
            rise = min(t, mp.mpf(1))
            y = mp.mpf(0)
            for p, w in zip(poles, weights, strict=True):
                y += w * mp.exp(p * (t - rise)) * moment(p, rise) + w * (mp.exp(p * (t - rise)) - 1) / p
            out.append(float(mp.re(y)))
        return np.array(out)


def test_the_closed_form_is_one():
    # It starts at rest, follows the differential equation across the plan's end, and settles at 1.
    gain, h = 5.0, 1e-4
    for t in (0.3, 0.9, 2.0):
        low, here, high = quintic_response([t - h, t, t + h], gain)
        residual = (high - 2 * here + low) / h**2 + (high - low) / (2 * h) + gain * (here - QUINTIC(t))
        assert abs(residual) <= 1e-5
    assert abs(quintic_response([60.0], gain)[0] - 1.0) <= 1e-12
    assert quintic_response([0.0], gain)[0] == 0.0


@pytest.mark.parametrize("gain", [1.0, 5.0, 100.0])
def test_forced_response_converges_at_second_order(gain):
    system = cp.plants.integrator_lag_loop(gain)
    exact = quintic_response(np.linspace(0.0, 4.0, 51), gain)
    errors = []
    for refined in (1, 2, 4, 8, 16, 32):
        t = np.linspace(0.0, 4.0, 50 * refined + 1)
        found = ct.forced_response(system, t, cp.source_samples(QUINTIC, t)).outputs
        errors.append(np.abs(found[::refined] - exact).max())
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[-1] < 1e-5
    assert np.abs(slopes[1:] - 2.0).max() <= 0.05


def test_forced_response_takes_several_signals_and_derivatives():
    """Velocity feedforward into x' = -x + (r + r'): x is r, to the order of the samples."""
    t = np.linspace(0.0, 2.0, 2001)
    system = ct.ss(-1.0, [[1.0, 1.0]], 1.0, 0.0)
    found = ct.forced_response(system, t, cp.source_samples(QUINTIC, t, derivatives=1))
    assert np.abs(found.outputs - QUINTIC(t)).max() <= 1e-6
