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
    """Uneven times, a loop that is too fast, inputs that are not analytic, and an overflow: another way is used."""
    a, b = np.array([[-1.0]]), np.array([[1.0]])

    def one(times):
        return np.ones((1, times.size))

    even, none = np.linspace(0.0, 1.0, 11), np.zeros(0)
    assert np.abs(moment_states(a, b, one, none, even, np.zeros(1)) + np.expm1(-even)).max() <= 1e-15
    assert moment_states(a, b, one, none, even**2, np.zeros(1)) is None
    assert moment_states(1e16 * a, b, one, none, even, np.zeros(1)) is None
    assert moment_states(a, b, lambda t: np.sign(np.sin(40.0 * t))[None], none, even, np.zeros(1)) is None
    assert moment_states(-1e3 * a, b, one, none, even, np.ones(1)) is None


@pytest.mark.parametrize("marks", [[], [0.25], [0.1, 0.1 + 1e-7, 0.55501, 0.9]])
@pytest.mark.parametrize("turned", [False, True])
def test_fast_and_slow_states(marks, turned):
    """40 lags with rates from 1e-3 to 1e6 1/s follow lines between the marks, at samples far apart.

    Over a part from s to e with w = w_s + v (t - s): x' = -p x + w has the particular solution w/p - v/p^2.
    """
    rates = np.geomspace(1e-3, 1e2 if turned else 1e6, 40)
    turn = np.linalg.qr(np.random.default_rng(2).standard_normal((40, 40)))[0] if turned else np.eye(40)
    corners = np.array([0.0, *marks, 1.0])
    values = np.cos(3.0 * np.arange(corners.size))
    even = np.linspace(0.0, 1.0, 11)
    start = np.sin(np.arange(40.0))
    found = moment_states(
        -turn @ np.diag(rates) @ turn.T,
        turn @ np.ones((40, 1)),
        lambda t: np.interp(t, corners, values)[None],
        np.array(marks),
        even,
        turn @ start,
    )
    assert found is not None
    x, expected = start, {0.0: start}
    for left, right in zip(*(lambda t: (t[:-1], t[1:]))(np.union1d(corners, even)), strict=True):
        k = np.searchsorted(corners, left, side="right") - 1
        v = (values[k + 1] - values[k]) / (corners[k + 1] - corners[k])
        w = values[k] + v * (left - corners[k])
        # x + (1 - exp(-p h)) (w/p - x) + v (h - (1 - exp(-p h))/p)/p, the last factor by its series for small p h
        z = rates * (right - left)
        rise = -np.expm1(-z)
        late = np.where(z < 1e-2, z**2 / 2 - z**3 / 6 + z**4 / 24 - z**5 / 120 + z**6 / 720, z - rise)
        x = x + rise * (w / rates - x) + v * late / rates**2
        expected[right] = x
    error = np.abs(turn.T @ found - np.array([expected[t] for t in even]).T).max(axis=1)
    # Turning rounds entries by half an ulp of the fastest rate, which moves slow states by that over the run.
    assert np.all(error <= (100.0 * 40 * 2.0**-53 * rates.max() if turned else 1e-14))


@pytest.mark.parametrize("rate", [1.0, 1e3])
def test_an_input_that_needs_shorter_steps(rate):
    """x' = -p x + sin(w t) with two periods between two samples: x = Im((exp(i w t) - exp(-p t))/(p + i w))."""
    even, w = np.linspace(0.0, 1.0, 6), 2.0 * np.pi * 10.0
    found = moment_states(
        np.array([[-rate]]), np.array([[1.0]]), lambda t: np.sin(w * t)[None], np.zeros(0), even, np.zeros(1)
    )
    expected = ((np.exp(1j * w * even) - np.exp(-rate * even)) / (rate + 1j * w)).imag
    assert np.abs(found - expected).max() <= 1e-14
