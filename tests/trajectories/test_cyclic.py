"""Closed plans: a whole turn, against plain linear algebra in many digits."""

import mpmath as mp
import numpy as np
import pytest
from trajectory_oracle import Direct, miss, scales, waypoints

from ctrlplan.trajectories import TrigSpline, Waypoint

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

# Times, jets and period: N 1, 2, 3, 7, 8, 12.
ROUNDS = {
    "one position": ([0.5], [[2.0]], 3.0),
    "one velocity": ([0.0], [[2.0, 1.0]], 1.0),
    "three positions": ([0.0, 1.0, 2.0], [[0.0], [1.0], [0.5]], 4.0),
    "odd": ([-1.0, 0.0, 2.0], [[1.0, 0.0, 0.0], [2.0], [0.5, 1.0, -1.0]], 3.5),
    "even": ([0.0, 1.0, 2.5], [[0.0, 1.0], [1.0, 0.0, 2.0], [2.0, 0.0, 1.0]], 4.0),
    "even, N 12": ([0.0, 0.2, 0.3, 0.7], [[0.1, 1.0, 0.0]] * 4, 1.0),
}


@pytest.mark.parametrize("name", ROUNDS)
def test_equation_3_at_a_whole_turn(name):
    times, jets, period = ROUNDS[name]
    plan = TrigSpline.cyclic(waypoints(times, jets), period)
    oracle = Direct(times, jets, 2 * mp.pi, period=period)
    t = plan.start + period * np.linspace(0, 1, 41)
    exact = oracle.jet(t, 4)
    assert (np.abs(plan.jet(t, 4)[:, 0] - exact) / np.maximum(scales(exact, period), 1e-300)).max() <= 1e-12
    assert miss(plan) <= 1e-12
    assert plan.degree == (oracle.m,)


@pytest.mark.parametrize("name", ROUNDS)
def test_it_closes_with_every_derivative(name):
    times, jets, period = ROUNDS[name]
    plan = TrigSpline.cyclic(waypoints(times, jets), period)
    assert (plan.start, plan.end) == (times[0], times[0] + period)
    order = 8
    size = scales(
        plan.jet(np.linspace(plan.start, plan.end, 101), order)[:, 0], period / (2 * np.pi * (1 + plan.degree[0]))
    )
    first, last = plan.jet([plan.start, plan.end], order)[:, 0].T
    assert (np.abs(last - first)[:, None] <= 1e-13 * size).all()


def test_rounds_are_appended():
    plan = TrigSpline.cyclic(waypoints(*ROUNDS["even"][:2]), 4.0)
    twice = plan.then(plan)
    assert (twice.start, twice.end) == (0.0, 8.0)
    t = np.linspace(0, 4, 33)
    np.testing.assert_array_equal(twice.jet(t[:-1] + 4, 3), plan.jet(t[:-1], 3))
    np.testing.assert_allclose(twice.jet(4.0, 4), twice.jet(4.0, 4, left=True), rtol=0, atol=1e-10)


def test_a_circle_through_four_points():
    """cos and sin from positions alone: N = 4 leaves the second harmonic zero."""
    t = np.arange(4) * 0.5
    points = [Waypoint(float(s), [np.cos(np.pi * s), np.sin(np.pi * s)]) for s in t]
    plan = TrigSpline.cyclic(points, 2.0)
    fine = np.linspace(0, 2, 41)
    np.testing.assert_allclose(plan(fine), [np.cos(np.pi * fine), np.sin(np.pi * fine)], rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.hypot(*plan(fine, 1)), np.pi, rtol=1e-14)


def test_explicit_gamma_and_spare_harmonics():
    times, jets, period = ROUNDS["even"]
    plan = TrigSpline.cyclic(waypoints(times, jets), period, gamma=0.7)
    t = np.linspace(0, period, 41)
    exact = Direct(times, jets, 2 * mp.pi, gamma=0.7, period=period).jet(t, 3)
    assert (np.abs(plan.jet(t, 3)[:, 0] - exact) / scales(exact, period)).max() <= 1e-12
    smooth = TrigSpline.cyclic(waypoints(times, jets), period, degree=7, smooth=2)
    assert miss(smooth) <= 1e-12
    t = np.linspace(0, period, 200, endpoint=False)
    assert np.mean(smooth(t, 2) ** 2) < np.mean(TrigSpline.cyclic(waypoints(times, jets), period)(t, 2) ** 2)


def test_the_smoothest_closed_plan():
    """Over whole periods harmonics are orthogonal: minimum of sum (k^smooth c_k)^2 in closed form."""
    times, jets, period, degree, smooth = [0.0, 0.3, 0.55], [[0.0], [1.0], [-1.0]], 1.0, 6, 2
    plan = TrigSpline.cyclic(waypoints(times, jets), period, degree=degree, smooth=smooth)
    gamma = 2 * np.pi * np.mean(times)
    harmonics = [(k, f) for k in range(1, degree) for f in (np.cos, np.sin)]
    weight = np.array([float(k) for k, _ in harmonics] + [degree]) ** smooth

    def rows(t):
        tau = 2 * np.pi * np.asarray(t)
        return np.array([f(k * tau) for k, f in harmonics] + [np.sin(degree * (tau - gamma))])

    # Lagrange: [W^2 A^T 0; A 0 1; 0 1^T 0], the constant costs nothing.
    a = rows(times)
    n, m = a.shape
    system = np.block(
        [
            [np.diag(weight**2), a, np.zeros((n, 1))],
            [a.T, np.zeros((m, m)), np.ones((m, 1))],
            [np.zeros((1, n)), np.ones((1, m)), 0],
        ]
    )
    solved = np.linalg.solve(system, np.concatenate([np.zeros(n), [j[0] for j in jets], [0.0]]))
    t = np.linspace(0, 1, 41)
    np.testing.assert_allclose(plan(t), solved[-1] + solved[:n] @ rows(t), rtol=0, atol=1e-12)


def test_with_values_retime_and_several_axes():
    points = [Waypoint.from_jets(0.0, x=[0.0, 1.0], z=[1.0]), Waypoint.from_jets(1.0, x=[1.0], z=[2.0, 0.0])]
    plan = TrigSpline.cyclic(points, 3.0)
    assert plan.labels == ("x", "z")
    assert plan.degree == (1, 1)
    assert plan.gamma == (None, None)
    slow = plan.retime(6.0)
    assert slow.end == 6.0
    t = np.linspace(0, 3, 21)
    np.testing.assert_allclose(slow(2 * t, 1), plan(t, 1) / 2, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(plan.with_values(points)(t), plan(t))
    np.testing.assert_allclose(plan.shift(7.0)(t + 7.0), plan(t), rtol=0, atol=1e-14)


def test_one_waypoint_keeps_its_own_period_when_retimed():
    """The times are the same, the period is not."""
    plan = TrigSpline.cyclic([Waypoint(1.0, 2.0, 0.5)], 2.0)
    slower = plan.retime(5.0)
    assert (slower.start, slower.end) == (1.0, 6.0)
    t = np.linspace(0.0, 1.0, 11)
    np.testing.assert_allclose(slower(1.0 + 5.0 * t), plan(1.0 + 2.0 * t), rtol=1e-13)
    np.testing.assert_allclose(slower(1.0 + 5.0 * t, 1), plan(1.0 + 2.0 * t, 1) * 0.4, rtol=1e-12, atol=1e-15)
