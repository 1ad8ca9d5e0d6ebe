"""Exact responses of linear loops with many states, or to plans of many segments, by moments of the plans."""

import math

import control as ct
import numpy as np
import pytest
import sampled_oracle as oracle
from sampled_oracle import Plan

import ctrlplan as cp
from ctrlplan.simulation.moments import moment_states

A, B = [[0.0, 1.0], [-4.0, -0.8]], [[0.2], [1.0]]


@pytest.mark.slow
@pytest.mark.parametrize("count", [51, pytest.param(401, marks=pytest.mark.slow)])
def test_many_segments(count):
    """80 segments of 13 ms, compared with power series in 50 digits; breakpoints and times are apart."""
    values = np.random.default_rng(5).standard_normal(81)
    marks = 0.013 * np.arange(81)
    plan = cp.PiecewiseSpline.from_arrays(marks, values[None], alpha=0.0, labels=["r"])
    pieces = []
    for left in marks[:-1]:
        jet = plan.segment_jet_at(left + 0.005, left, np.zeros(1), 5)[:, 0, 0]
        pieces.append([value / math.factorial(k) for k, value in enumerate(jet)])
    planned = Plan(marks, pieces)
    loop = ct.ss(A, B, np.eye(2), 0, inputs="r", outputs=2)
    times = np.linspace(0.0, 1.0, count)
    expected = np.array(oracle.run(A, B, None, [[(planned, 0)]], [], [planned], [0.3, -0.2], times))
    found = cp.simulate(loop, times, plan, [0.3, -0.2])
    assert found.method == "exact"
    # Rounding of a time, 1e-16 s, is 1e-13 of the plan, whose slope is up to 500 1/s.
    assert np.abs(found.outputs - expected).max() <= 2e-14


def test_many_states():
    """60 lags in coordinates turned at random follow a ramp: x = (t - (1 - exp(-p t))/p)/p."""
    poles = np.linspace(0.5, 30.0, 60)
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((60, 60)))[0]
    a, b = -turn @ np.diag(poles) @ turn.T, turn @ np.ones((60, 1))
    loop = ct.ss(a, b, turn.T, 0, inputs="r", outputs=60)
    ramp = cp.PolySpline([cp.Waypoint(0.0, 0.0), cp.Waypoint(4.0, 4.0)], labels=["r"])
    times = np.linspace(0.0, 4.0, 161)
    found = cp.simulate(loop, times, ramp)
    expected = (times + np.expm1(-np.outer(poles, times)) / poles[:, None]) / poles[:, None]
    assert found.method == "exact"
    assert np.abs(found.outputs - expected).max() <= 1e-13


def test_what_moments_do_not_resolve():
    """Uneven times, steps that are too short, inputs that are not analytic, and an overflow: another way is used."""
    a, b = np.array([[-1.0]]), np.array([[1.0]])

    def one(times):
        return np.ones((1, times.size))

    even, none = np.linspace(0.0, 1.0, 11), np.zeros(0)
    assert np.abs(moment_states(a, b, one, none, even, np.zeros(1)) + np.expm1(-even)).max() <= 1e-15
    assert moment_states(a, b, one, none, even**2, np.zeros(1)) is None
    assert moment_states(1e9 * a, b, one, none, even, np.zeros(1)) is None
    assert moment_states(a, b, lambda t: np.sign(np.sin(40.0 * t))[None], none, even, np.zeros(1)) is None
    assert moment_states(-1e3 * a, b, one, none, even, np.ones(1)) is None
