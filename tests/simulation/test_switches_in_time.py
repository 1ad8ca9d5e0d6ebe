"""Pulses and switches in t inside a user's block are not skipped, declared or not."""

import warnings

import control as ct
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp

METHODS = ["compiled", "python"]


def pulsed(pulse, name="pulsed"):
    """x' = pulse(t) - x: from equilibrium, so that the derivative is 0 until the pulse."""
    return ct.nlsys(lambda t, x, u, params: [pulse(t) - x[0]], inputs=0, outputs="x", states="x", name=name)


def after(t, begin, end):
    """Its response to a pulse of height 1 in closed form."""
    rising, falling = np.maximum(np.minimum(t, end) - begin, 0.0), np.maximum(t - end, 0.0)
    return (1.0 - np.exp(-rising)) * np.exp(-falling)


FORMS = {
    "where": lambda begin, end: lambda t: np.where((t > begin) * (t < end), 1.0, 0.0),
    "product": lambda begin, end: lambda t: 1.0 * ((t > begin) * (t < end)),
    "logical": lambda begin, end: lambda t: np.where(np.logical_and(t >= begin, t <= end), 1.0, 0.0),
    "sign": lambda begin, end: lambda t: 0.5 * (np.sign(t - begin) - np.sign(t - end)),
    "distance": lambda begin, end: lambda t: np.where(abs(t - 0.5 * (begin + end)) < 0.5 * (end - begin), 1.0, 0.0),
    "heaviside": lambda begin, end: lambda t: np.heaviside(t - begin, 0.5) - np.heaviside(t - end, 0.5),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("begin", "end"), [(50.0, 60.0), (33.3, 33.31), (7.0, 7.0 + 1e-6), (99.0, 99.9)])
def test_a_pulse_of_any_width_where_the_block_is_compiled(form, begin, end):
    t = np.linspace(0.0, 100.0, 1001)
    found = cp.simulate(pulsed(FORMS[form](begin, end)), t, method="compiled")
    assert np.abs(found.outputs[0] - after(t, begin, end)).max() < 1e-6 * (1.0 - np.exp(begin - end))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("begin", "end"), [(50.0, 60.0), (33.3, 33.55)])
def test_a_pulse_longer_than_the_sample_spacing_by_python(form, begin, end):
    t = np.linspace(0.0, 100.0, 1001)
    found = cp.simulate(pulsed(FORMS[form](begin, end)), t, method="python")
    assert np.abs(found.outputs[0] - after(t, begin, end)).max() < 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_a_pulse_in_a_pendulum_at_rest(method):
    """Torque for ten seconds of a hundred: the energy that it leaves, by an independent integration."""
    from scipy.integrate import solve_ivp

    def rates(t, x, u, params):
        return [x[1], np.where((t > 50) * (t < 60), 1.0, 0.0) - np.sin(x[0]) - 0.1 * x[1]]

    block = ct.nlsys(rates, inputs=0, outputs=2, states=2, name="pendulum")
    t = np.linspace(0.0, 100.0, 1001)
    x, expected = np.zeros(2), np.zeros((2, t.size))
    for left, right, torque in ((50.0, 60.0, 1.0), (60.0, 100.0, 0.0)):
        inside = (t >= left) & (t <= right)
        run = solve_ivp(
            lambda _, z, torque=torque: [z[1], torque - np.sin(z[0]) - 0.1 * z[1]],
            (left, right),
            x,
            t_eval=t[inside],
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
        )
        expected[:, inside], x = run.y, run.y[:, -1]
    found = cp.simulate(block, t, method=method)
    assert np.abs(found.outputs - expected).max() < 1e-6 * np.ptp(expected)


def test_a_switch_that_time_and_a_state_decide_together():
    """Not only from rest: x' = 1 - 0.5 (x > 3 and t < 8), in closed form."""

    def rates(t, x, u, params):
        return [1.0 - 0.5 * np.logical_and(x[0] > 3, t < 8)]

    block = ct.nlsys(rates, inputs=0, outputs="x", states="x", name="slower")
    t = np.linspace(0.0, 20.0, 11)
    expected = np.where(t < 3, t, np.where(t < 8, 3 + (t - 3) / 2, 5.5 + t - 8))
    for method in METHODS:
        assert np.abs(cp.simulate(block, t, method=method).outputs[0] - expected).max() < 1e-6


@pytest.mark.slow
@examples(15)
@given(st.floats(0.05, 5.0), st.floats(0.05, 0.95))
def test_a_train_of_pulses(period, duty):
    """Pulses by the remainder of t: the mean, after whole periods, is exact."""
    block = ct.nlsys(
        lambda t, x, u, params: [np.where(np.mod(t, period) < duty * period, 1.0, 0.0)],
        inputs=0,
        outputs="x",
        states="x",
        name="train",
    )
    t = period * np.array([0.0, 1.0, 10.0, 25.0])
    found = cp.simulate(block, t, method="compiled")
    assert np.abs(found.outputs[0] - duty * t).max() < 1e-6 * t[-1]


@pytest.mark.parametrize("method", METHODS)
def test_declared_breakpoints_are_honoured_however_few_the_samples(method):
    """Two sample times, a pulse of a microsecond, and a declaration: it is seen by every method."""
    begin, end = 37.0, 37.0 + 1e-6
    for pulse in (FORMS["where"](begin, end), lambda t: 1.0 if begin < float(t) < end else 0.0):
        block = cp.declare(pulsed(pulse), breakpoints=[begin, end])
        try:
            found = cp.simulate(block, [0.0, 38.0], method=method)
        except ValueError:  # a branch on the time cannot be compiled
            assert method == "compiled"
            continue
        assert abs(found.outputs[0, -1] / after(38.0, begin, end) - 1.0) < 1e-6


def test_a_pulse_of_a_plan_that_a_block_makes():
    """A threshold that a planned signal passes briefly: a function of time all the same."""
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(100, 1, 0, 0)])
    block = ct.nlsys(
        lambda t, x, u, params: [np.where((u[0] > 0.5) * (u[0] < 0.5001), 1.0, 0.0) - x[0]],
        inputs="r",
        outputs="x",
        states="x",
        name="gate",
    )
    from scipy.optimize import brentq

    begin, end = (brentq(lambda t, level=level: float(plan(t)) - level, 0, 100, xtol=1e-13) for level in (0.5, 0.5001))
    t = np.linspace(0.0, 100.0, 1001)
    found = cp.simulate(block, t, plan, method="compiled")
    assert np.abs(found.outputs - after(t, begin, end)).max() < 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_a_smooth_function_of_time_warns_of_nothing(method):
    t = np.linspace(0.0, 20.0, 201)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = cp.simulate(pulsed(lambda t: np.sin(t)), t, method=method)
    assert np.abs(found.outputs[0] - 0.5 * (np.sin(t) - np.cos(t) + np.exp(-t))).max() < 1e-7
