"""Nonlinear loops with many short segments: samples of a law, samples as inputs, output times that fit neither."""

import math
from itertools import pairwise

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlplan as cp
from ctrlplan.simulation import compiled, numerical

METHODS = ["compiled", "python"]
PLAN = cp.PolySpline([cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(1.0, 1.0, 0, 0)], labels=["r"])


def pendulum(t, x, u, params):
    return [x[1], -9.81 * np.sin(x[0]) - 0.3 * x[1] * np.abs(x[1]) + u[0]]


def sampled_loop(period, offset, gain=20.0, slow=0.0):
    """A proportional law, with the sum of its errors times a small number as a state."""
    law = ct.ss([[1.0]], [[slow, -slow]], [[0.0]], [[gain, -gain]], period, inputs=["r", "q"], outputs="u", name="law")
    block = ct.nlsys(pendulum, None, inputs="u", outputs=["q", "w"], states=2, name="pendulum")
    return ct.interconnect([block, cp.sample_hold(law, period, offset)], inputs="r", outputs=["q", "w", "u"])


def by_hand(period, offset, times, gain=20.0):
    """Angle and rate at the times, from sample to sample."""
    x, u, left, out = np.zeros(2), 0.0, times[0], []
    marks = times[0] + offset + period * np.arange(int((times[-1] - times[0] - offset) / period) + 1)
    for right in [*marks.tolist(), math.inf]:
        inside = times[(times >= left) & (times < right)]
        end = min(right, times[-1])

        def rates(t, s, u=u):
            return s[1], -9.81 * math.sin(s[0]) - 0.3 * s[1] * abs(s[1]) + u

        if end > left:
            grid = np.unique([left, *inside, end])
            found = solve_ivp(rates, (left, end), x, "DOP853", grid, rtol=1e-12, atol=1e-13).y
            out.append(found[:, np.isin(grid, inside)])
            x = found[:, -1]
        elif inside.size:
            out.append(x[:, None])
        if right < math.inf:
            u, left = gain * (float(PLAN(right)) - x[0]), right
    return np.hstack(out)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("first", [0.0, 0.35])
def test_a_period_and_output_times_without_a_common_multiple(first, method):
    times = first + np.linspace(0.0, 1.3, 102)
    found = cp.simulate(sampled_loop(0.0107, 0.0033), times, PLAN, method=method)
    expected = by_hand(0.0107, 0.0033, times)
    assert np.abs(expected[0]).max() > 0.4
    assert np.abs(found.outputs[:2] - expected).max() <= 2e-8 * np.abs(expected).max()


def test_few_integrators_are_built_for_irregular_output_times(monkeypatch):
    built = []
    made = compiled.Compiled._made
    monkeypatch.setattr(compiled.Compiled, "_made", lambda self, settings: built.append(1) or made(self, settings))
    times = np.concatenate([[0.0], np.sort(np.random.default_rng(0).uniform(0.0, 1.2, 400)), [1.2]])
    found = cp.simulate(sampled_loop(0.01, 0.0), times, PLAN, method="compiled")
    expected = by_hand(0.01, 0.0, times)
    assert np.abs(found.outputs[:2] - expected).max() <= 2e-8 * np.abs(expected).max()
    assert len(built) <= 40  # of 120 segments, each with a pattern of its own


@pytest.mark.parametrize("method", METHODS)
def test_states_of_a_sampled_law_need_no_repeated_run(method, monkeypatch):
    runs = []
    go = numerical.Attempt.go
    monkeypatch.setattr(numerical.Attempt, "go", lambda self: runs.append(1) or go(self))
    times = np.linspace(0.0, 1.2, 61) + 1e-4
    found = cp.simulate(sampled_loop(0.01, 0.0, slow=1e-9), times, PLAN, method=method)
    assert 0.0 < np.abs(found.states[2]).max() < 1e-6
    expected = by_hand(0.01, 0.0, times)
    assert np.abs(found.outputs[:2] - expected).max() <= 2e-8 * np.abs(expected).max()
    assert len(runs) == 1
    assert "uncertain" not in found.reason


@pytest.mark.parametrize("method", METHODS)
def test_samples_that_make_a_loop_stiff(method):
    """x' = -(1 + 1e5 b)(x - 1) with b from 0 to 1: 1 - x = exp(-t - 1e5 times the integral of b)."""
    lag = ct.nlsys(
        lambda t, x, u, p: [-(1.0 + 1e5 * u[0]) * (x[0] - 1.0)], None, inputs="b", outputs="x", states=1, name="lag"
    )
    times = np.linspace(0.0, 2.0, 201)
    b = np.where(times > 1.0, 1.0, 0.0) + 1e-6 * np.random.default_rng(0).uniform(0.0, 1.0, times.size)
    integral = np.append(0.0, np.cumsum(0.5 * (b[1:] + b[:-1]) * np.diff(times)))
    found = cp.simulate(lag, times, b, method=method)
    assert np.abs(found.outputs - (1.0 - np.exp(-times - 1e5 * integral))).max() <= 1e-8


@pytest.mark.parametrize("method", METHODS)
def test_samples_constants_and_a_plan_together(method):
    """x' = a b + c - |x| x with samples a that jump from one to the next, a constant b and a step c."""
    block = ct.nlsys(
        lambda t, x, u, p: [u[0] * u[1] + u[2] - np.abs(x[0]) * x[0]],
        None,
        inputs=["a", "b", "c"],
        outputs="x",
        states=1,
        name="drag",
    )
    times = 5.0 + np.linspace(0.0, 1.0, 41)
    a = np.where((np.arange(41) // 7) % 2, 1.0, -1.0)
    x, out = np.zeros(1), [0.0]
    for (left, first), (right, last) in pairwise(zip(times.tolist(), a.tolist(), strict=True)):
        parts = [left, 5.31, right] if left < 5.31 < right else [left, right]
        for begin, end in pairwise(parts):

            def rates(t, s, left=left, first=first, slope=(last - first) / (right - left), begin=begin):
                return 2.0 * (first + slope * (t - left)) + 3.0 * (begin >= 5.31) - abs(s[0]) * s[0]

            x = solve_ivp(rates, (begin, end), x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        out.append(float(x[0]))
    found = cp.simulate(block, times, {"a": a, "b": 2.0, "c": cp.Step(3.0, time=5.31)}, method=method)
    assert np.abs(found.outputs - out).max() <= 1e-8


def logistic(rate):
    """x' = rate x (1 - x), from x = 1/2: x = 1/(1 + exp(-rate t))."""
    return ct.nlsys(lambda t, x, u, p: [rate * x[0] * (1.0 - x[0])], None, inputs=0, outputs=["y"], states=1)


@pytest.mark.parametrize("exponent", [3, 5, 8])
def test_times_over_many_decades(exponent):
    """Logarithmic times from the fast beginning to the end of a long run."""
    times, rate = np.append(0.0, np.logspace(-5, exponent, 53)), 3e3
    found = cp.simulate(logistic(rate), times, initial_state=[0.5], method="compiled")
    np.testing.assert_allclose(found.outputs[0], 1.0 / (1.0 + np.exp(-rate * times)), rtol=0.0, atol=1e-8)


def test_times_that_nearly_coincide():
    """Pairs of times apart by rounding, and by less than the integrator distinguishes in the whole run."""
    near = np.outer([0.3, 0.5, 0.9], [1.0, 1.0 + 3e-16, 1.0 + 1e-12, 1.0 + 5e-10]).ravel()
    times = np.unique([0.0, *near, 1.0])
    found = cp.simulate(logistic(5.0), times, initial_state=[0.5], method="compiled")
    np.testing.assert_allclose(found.outputs[0], 1.0 / (1.0 + np.exp(-5.0 * times)), rtol=0.0, atol=1e-8)
