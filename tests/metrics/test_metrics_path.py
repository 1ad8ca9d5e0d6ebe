"""Paths against waypoints: closed forms, what is forced and what is not, rotations."""

from math import comb, factorial, hypot, pi, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctrlplan import metrics

SQUARE = np.array([[0.0, 1, 1, 0], [0, 0, 1, 1]])


def polyline(points, count):
    """Return times and samples of a polyline at one segment a second, `count` samples a segment."""
    segments = points.shape[1] - 1
    t = np.linspace(0, segments, segments * count + 1)
    return t, np.stack([np.interp(t, np.arange(segments + 1), axis) for axis in points])


def wave(t):
    """Return a smooth path that turns on either axis."""
    return np.array([np.sin(t) + 0.3 * np.cos(2.3 * t), np.cos(1.4 * t) + 0.1 * t])


@pytest.mark.parametrize("count", [3, 4, 7])
def test_a_polyline_does_not_exceed_itself(count):
    points = np.array([[0.0, 3, 3, -2, 1], [0, 4, 2, 2, 2]])
    t, path = polyline(points, count)
    length = 5 + 2 + 5 + 3
    assert metrics.path_length(t, path) == pytest.approx(length, rel=1e-12)
    assert metrics.wandering(t, path, points) == pytest.approx(0, abs=1e-12)
    assert metrics.excess_variation(t, path, points) == pytest.approx(0, abs=1e-12)
    assert metrics.turning_points(t, path, points) == 0


def test_closed_forms_on_the_half_circle():
    t = np.linspace(0, pi, 301)
    path = np.array([2 * np.cos(t), 2 * np.sin(t)])
    ends = [[2, -2], [0, 0]]
    assert metrics.path_length(t, path) == pytest.approx(2 * pi, rel=1e-9)
    assert metrics.wandering(t, path, ends) == pytest.approx(pi / 2 - 1, rel=1e-8)
    assert metrics.excess_variation(t, path, ends) == pytest.approx(1, rel=1e-9)
    assert metrics.turning_points(t, path, ends) == 1
    assert metrics.outside_box(t, path, ends) == pytest.approx(2, rel=1e-9)
    assert metrics.outside_box(t, path, [[2, -2], [0, 0.5]]) == pytest.approx(1.5, rel=1e-9)


def test_the_polynomial_through_the_obstacle_has_excess_length():
    """Twelve conditions in 16 s: 33.02 m of way on a polyline of 24.9 m, solved here as monomials in t/16."""
    jets = [
        (0.0, [0, 0, 0], [10, 0, 0]),
        (6.0, [5, 1, 0.1], [5, -1, -0.15]),
        (11.0, [15, 2, 0.1], [5, 1, 1]),
        (16.0, [20, 0, 0], [11, 0, 0]),
    ]
    rows, right = [], []
    for time, x, z in jets:
        for order in range(3):
            factors = [factorial(order) * comb(k, order) for k in range(12)]
            rows.append([f * (time / 16) ** (k - order) if k >= order else 0.0 for k, f in enumerate(factors)])
            right.append([x[order] * 16**order, z[order] * 16**order])
    coefficients = np.linalg.solve(np.array(rows), np.array(right))
    t = np.linspace(0, 16, 2001)
    path = np.polynomial.polynomial.polyval(t / 16, coefficients)
    points = np.array([[x[0] for _, x, _ in jets], [z[0] for _, _, z in jets]])
    straight = hypot(5, 5) + 10 + hypot(5, 6)
    assert metrics.path_length(t, path) == pytest.approx(33.02, abs=0.005)
    assert metrics.wandering(t, path, points) == pytest.approx(33.02 / straight - 1, abs=3e-4)
    assert metrics.path_length(t[::20], path[:, ::20]) == pytest.approx(metrics.path_length(t, path), rel=1e-4)


def test_excess_variation_is_axis_by_axis():
    """x goes 1 too far and back, z falls short of its waypoints by 2: 2 out of 10 + 4."""
    t = np.linspace(0, 4, 401)
    x = 11 - (t - 3) ** 2 * 11 / 9
    x[t > 3] = 11 - (t[t > 3] - 3) ** 2
    assert x[-1] == 10.0
    z = t / 2
    assert metrics.excess_variation(t, [x, z], [[0, 10], [0, 4]]) == pytest.approx(2 / 14, rel=1e-6)
    assert metrics.excess_variation(t, x, [0, 10]) == pytest.approx(2 / 10, rel=1e-6)


def test_turning_points_that_waypoints_force_are_free():
    t = np.linspace(0, 10, 1001)
    wiggle = np.sin(2 * pi * t / 2.5)
    corners = [0, 1, -1, 1, -1, 1, -1, 1, -1, 0]
    assert metrics.turning_points(t, wiggle, corners) == 0
    assert metrics.turning_points(t, wiggle, [0, 1, 0]) == 7
    assert metrics.turning_points(t, wiggle, [0, 1, 2]) == 8
    assert metrics.turning_points(t, [wiggle, t], [corners, np.arange(10)]) == 0
    assert metrics.turning_points(t, [wiggle, t], [np.arange(10), corners]) == 8
    assert metrics.turning_points(t, t, corners) == 0


def test_rounding_and_rests_are_no_turns():
    t = np.linspace(0, 10, 1001)
    rough = np.clip(t, 2, 6) + 1e-9 * (-1) ** np.arange(1001)
    assert metrics.turning_points(t, rough, [2, 6]) == 0
    there_and_back = np.minimum(np.clip(t, 2, 6), 12 - np.clip(t, 6, 10))
    assert metrics.turning_points(t, there_and_back, [2, 6]) == 1
    assert metrics.turning_points(t, np.zeros(1001), [0, 0]) == 0
    small = 1e-9 * np.clip(2 * np.sin(t), -1, 1) + 1e-16 * (-1) ** np.arange(1001)
    assert metrics.turning_points(t, small, [0, 0]) == 3


def test_a_corner_of_the_box_is_far_by_the_diagonal():
    t = np.linspace(0, 2, 201)
    path = [1 + t * (2 - t) * 3, 1 + t * (2 - t) * 4]
    assert metrics.outside_box(t, path, SQUARE) == pytest.approx(5, rel=1e-9)
    assert metrics.outside_box(t, [p / 10 for p in path], SQUARE) == 0.0


def test_a_box_is_left_between_samples():
    """1 + 0.1 - (t - 4.5)^2 leaves the box by 0.1, seen by no sample."""
    t = np.arange(3.0, 7.0)
    path = 1.1 - (t - 4.5) ** 2
    assert path.max() < 1
    assert metrics.outside_box(t, path, [-9, 1]) == pytest.approx(0.1, rel=1e-12)
    assert metrics.outside_box(t, -path, [-1, 9]) == pytest.approx(0.1, rel=1e-12)


def test_points_without_extent_leave_nothing_to_normalise_by():
    t = np.linspace(0, 1, 11)
    for points in ([[0.0], [0.0]], [[1.0, 1.0], [2.0, 2.0]]):
        assert np.isnan(metrics.wandering(t, [t, t], points))
        assert np.isnan(metrics.excess_variation(t, [t, t], points))
    assert metrics.outside_box(t, [t, t], [[0.0], [0.0]]) == pytest.approx(sqrt(2), rel=1e-12)


def test_one_axis_is_a_path_too():
    t = np.linspace(0, 10, 501)
    p = np.sin(t)
    for metric in (metrics.wandering, metrics.excess_variation, metrics.turning_points, metrics.outside_box):
        assert metric(t, p, [0, 1, 0.5]) == metric(t, [p], [[0, 1, 0.5]])
    assert metrics.path_length(t, p) == metrics.path_length(t, [p])


@pytest.mark.parametrize("points", [[[0, 1]], [0, 1], np.zeros((2, 0)), np.zeros((2, 2, 2)), np.zeros((3, 2))])
def test_points_of_other_axes_are_rejected(points):
    t = np.linspace(0, 1, 11)
    for metric in (metrics.wandering, metrics.excess_variation, metrics.turning_points, metrics.outside_box):
        with pytest.raises(ValueError, match=r"^points must have shape \(2, npoints\)"):
            metric(t, [t, t], points)


def test_a_path_has_up_to_two_array_axes():
    t = np.linspace(0, 1, 11)
    with pytest.raises(
        ValueError, match=r"^path must have shape \(ntime,\) or \(naxes, ntime\), got shape \(1, 2, 11\)"
    ):
        metrics.path_length(t, np.zeros((1, 2, 11)))


@given(st.floats(0, 2 * pi), st.floats(-5, 5), st.floats(-5, 5))
def test_lengths_are_invariant_under_rotation(angle, right, up):
    t = np.linspace(0, 8, 801)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = np.array([[right], [up]])
    moved = turn @ wave(t) + shift
    assert metrics.path_length(t, moved) == pytest.approx(metrics.path_length(t, wave(t)), rel=1e-7)
    wandering = metrics.wandering(t, wave(t), SQUARE)
    assert metrics.wandering(t, moved, turn @ SQUARE + shift) == pytest.approx(wandering, rel=1e-7)


@given(st.floats(0.01, 100), st.floats(0.01, 100), st.integers(0, 3))
def test_scale_pace_and_quarter_turns(size, pace, quarters):
    t = np.linspace(0, 8, 201)
    turn = np.linalg.matrix_power(np.array([[0.0, -1], [1, 0]]), quarters)
    path, points = size * turn @ wave(t), size * turn @ SQUARE
    assert metrics.path_length(pace * t, path) == pytest.approx(size * metrics.path_length(t, wave(t)), rel=1e-6)
    for metric in (metrics.wandering, metrics.excess_variation, metrics.turning_points):
        assert metric(pace * t, path, points) == pytest.approx(metric(t, wave(t), SQUARE), rel=1e-6)
    outside = metrics.outside_box(t, wave(t), SQUARE)
    assert metrics.outside_box(pace * t, path, points) == pytest.approx(size * outside, rel=1e-6)


@given(st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50)), min_size=2, max_size=8), st.integers(3, 6))
def test_the_polyline_itself_is_the_shortest_way(corners, count):
    points = np.array(corners, dtype=float).T
    t, path = polyline(points, count)
    length = np.hypot(*np.diff(points)).sum()
    assert metrics.path_length(t, path) == pytest.approx(length, rel=1e-9, abs=1e-9)
    assert metrics.turning_points(t, path, points) == 0
    assert metrics.outside_box(t, path, points) <= 1e-9
