"""One step over a short segment, next to closed forms; and crossings that it locates."""

import math
import pickle

import casadi as ca
import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation.one_step import OneStep, has_step
from ctrlplan.simulation.signals import PlanSignal, TimeSignals


def logistic(rate):
    """Equations x' = rate x (1 - x) with a parameter that scales time, and their solution."""
    t, x, p = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("p")
    return {"t": t, "x": x, "p": p, "ode": rate * p * x * (1.0 - x)}, lambda s: 1.0 / (1.0 + 9.0 * math.exp(-rate * s))


@pytest.mark.parametrize("length", [0.01, 0.1, 0.5])
def test_the_error_of_a_step_is_within_its_tolerance(length):
    equations, exact = logistic(1.0)
    found = OneStep(equations).state(np.array([0.1]), (np.array([length]),), 1e-9, 1e-11)
    assert found is not None
    assert abs(found[0] - exact(length)) <= 1e-9 * exact(length) + 1e-11


def test_a_step_has_order_eight():
    t, x, p = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("p")
    step = OneStep({"t": t, "x": x, "p": p, "ode": p * ca.cos(p * t) * x})  # x = exp(sin(p t))
    ends = [step.state(np.ones(1), (np.array([s]),), 1.0, 1.0)[0] for s in (0.25, 0.5)]
    errors = [abs(end - math.exp(math.sin(s))) for end, s in zip(ends, (0.25, 0.5), strict=True)]
    assert math.log2(errors[1] / errors[0]) >= 8.5  # the error of one step is of order 9


@pytest.mark.parametrize(("start", "length"), [(0.1, 20.0), (math.nan, 0.1)])
def test_a_step_that_is_not_accurate_enough_is_not_used(start, length):
    equations, _ = logistic(1.0)
    assert OneStep(equations).state(np.array([start]), (np.array([length]),), 1e-9, 1e-11) is None


def test_long_equations_have_no_step():
    x = ca.SX.sym("x")
    value = x
    for _ in range(2000):
        value = ca.sin(value) + x
    assert not has_step({"t": ca.SX.sym("t"), "x": x, "p": ca.SX.sym("p"), "ode": value})


def pendulum(t, x, u, params):
    return [x[1], -9.81 * np.sin(x[0])]


def test_crossings_of_a_compiled_loop():
    """The pendulum passes its lowest point after quarters of its period, 4 K(sin(a/2)) sqrt(l/g)."""
    block = ct.nlsys(pendulum, None, outputs=["q", "w"], states=2, name="pendulum", inputs=0)
    times = np.linspace(0.0, 10.0, 501)
    events = [cp.Event("q", high=0.0)]
    found = cp.simulate(block, times, None, [1.0, 0.0], method="compiled", events=events, rtol=1e-10)
    mean, other = 1.0, math.cos(0.5)  # K by the arithmetic-geometric mean
    while abs(mean - other) > 1e-15:
        mean, other = 0.5 * (mean + other), math.sqrt(mean * other)
    quarter = 0.5 * math.pi / mean / math.sqrt(9.81)
    expected = [0.0, *(k * quarter for k in range(1, 100, 2) if k * quarter < 10.0)]
    assert [event.time for event in found.events] == pytest.approx(expected, abs=1e-8)


def test_harmonics_of_a_trigonometric_plan():
    """The sum of harmonics equals the plan and its derivatives."""
    plan = cp.TrigSpline([cp.Waypoint(0.0, 0, 0, 0), cp.Waypoint(3.0, 1, 0, 0)], alpha=4.0)
    signals = TimeSignals([PlanSignal(plan, 2)])
    (series,) = signals.series(1.5, 0.0, 3.0, 4e-15, np.zeros(3) + 1e-14)
    harmonics = series.harmonics
    assert harmonics is not None
    assert harmonics.coefficients.shape[1] < series.coefficients.shape[1]
    times = np.linspace(0.0, 3.0, 50)
    found = np.repeat(harmonics.coefficients[:, :1], times.size, axis=1)
    for k in range(1, harmonics.coefficients.shape[1] // 2 + 1):
        angle, (a, b) = k * harmonics.rate * times, harmonics.coefficients[:, 2 * k - 1 : 2 * k + 1].T
        found = found + a[:, None] * np.cos(angle) + b[:, None] * np.sin(angle)
    expected = plan.jet(times, 2)[:, 0]
    assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()
    each = np.array([series(t) for t in times.tolist()]).T
    assert np.abs(each - expected).max() <= 1e-13 * np.abs(expected).max()
    np.testing.assert_array_equal(series(3.0 + 1e-9), series(3.0))


def test_harmonics_that_cancel_are_not_used():
    plan = cp.TrigSpline([cp.Waypoint(0.0, 0, 0, 0), cp.Waypoint(3.0, 1, 0, 0)], alpha=0.2)
    signals = TimeSignals([PlanSignal(plan, 2)])
    assert all(series.harmonics is None for series in signals.series(1.5, 0.0, 3.0, 4e-15, np.zeros(3)))


def test_outputs_are_those_of_the_run_whenever_they_are_read():
    """The outputs of a compiled run depend neither on later changes of the inputs nor on a pickle in between."""
    block = ct.nlsys(
        lambda t, x, u, p: [u[0] - np.sin(x[0])],
        lambda t, x, u, p: [x[0] ** 2 + u[0]],
        name="b",
        states=1,
        inputs=1,
        outputs=1,
    )
    times = np.linspace(0.0, 1.0, 11)
    samples = np.sin(times)
    found = cp.simulate(block, times, samples, method="compiled")
    expected = found.x[0] ** 2 + np.sin(times)
    samples[:] = 7.0
    copy = pickle.loads(pickle.dumps(found))
    assert copy.y[0] == pytest.approx(expected, rel=1e-14)
    assert found.y[0] == pytest.approx(expected, rel=1e-14)
    assert copy.reason == found.reason
