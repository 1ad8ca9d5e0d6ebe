"""Obstacles: their distances against naive geometry, what the Protocol promises, and rejections."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

from ctrlplan.planning.obstacles import Disc, HalfPlane, Obstacle, Rectangle

INF = math.inf
RECTANGLES = [
    Rectangle((7.0, 13.0), (6.5, 12.0)),
    Rectangle((-1.0, 2.0), (-0.5, INF)),
    Rectangle((-INF, INF), (1.0, 1.5)),
    Rectangle((3.0, INF), (-INF, 1.0)),
    Rectangle((0.0, 1e-3), (-4.0, 4.0)),
]
OTHERS = [Disc((1.0, -2.0), 1.5), Disc((0.0, 0.0), 1e-4), HalfPlane((0.0, 1.0), 1.2), HalfPlane((3.0, -4.0), 2.0)]
ALL = pytest.mark.parametrize("thing", RECTANGLES + OTHERS, ids=repr)


def naive(thing, point):
    """Signed distance of one point, case by case in plain numbers."""
    x, z = map(float, point)
    if isinstance(thing, Disc):
        return math.dist((x, z), thing.centre) - thing.radius
    if isinstance(thing, HalfPlane):
        # The foot of the perpendicular from the point; the normal has length 1.
        return -(thing.normal[0] * x + thing.normal[1] * z - thing.offset)
    (x0, x1), (z0, z1) = thing.x, thing.z
    if x0 <= x <= x1 and z0 <= z <= z1:
        return -min(x - x0, x1 - x, z - z0, z1 - z)
    return math.dist((x, z), (min(max(x, x0), x1), min(max(z, z0), z1)))


def naive_segment(thing, p, q):
    """Minimum of the naive distances on a segment by ternary search, as they are convex along it."""
    low, high = 0.0, 1.0
    while high - low > 1e-14:
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        if naive(thing, p + a * (q - p)) < naive(thing, p + b * (q - p)):
            high = b
        else:
            low = a
    return min(naive(thing, p + share * (q - p)) for share in (0.0, low, high, 1.0))


@ALL
def test_distance_is_the_naive_one(thing):
    points = np.random.default_rng(0).uniform(-15.0, 15.0, (2, 4, 300))
    found = thing.distance(points)
    assert found.shape == (4, 300)
    expected = [naive(thing, p) for p in points.reshape(2, -1).T]
    np.testing.assert_allclose(found.ravel(), expected, rtol=0, atol=1e-14 * 20)


@pytest.mark.parametrize("thing", [RECTANGLES[0], RECTANGLES[4], *OTHERS[:2]], ids=repr)
def test_distance_is_that_of_the_nearest_point_of_the_boundary(thing):
    if isinstance(thing, Disc):
        turn = np.linspace(0.0, 2.0 * np.pi, 4001)
        edge = np.array(thing.centre)[:, None] + thing.radius * np.array([np.cos(turn), np.sin(turn)])
    else:
        s = np.linspace(0.0, 1.0, 4001)
        x, z = (a + s * (b - a) for a, b in (thing.x, thing.z))
        sides = [(x, np.full_like(s, side)) for side in thing.z] + [(np.full_like(s, side), z) for side in thing.x]
        edge = np.concatenate([np.array(side) for side in sides], axis=1)
    points = np.random.default_rng(1).uniform(-15.0, 15.0, (2, 100))
    nearest = np.hypot(*(points[:, :, None] - edge[:, None])).min(axis=1)
    spacing = np.hypot(*np.diff(edge[:, :4001])).max()
    difference = nearest - np.abs(thing.distance(points))
    assert np.all((difference > -1e-13) & (difference <= 0.5 * spacing))


@ALL
def test_segment_distance_is_the_minimum_on_the_segment(thing):
    rng = np.random.default_rng(2)
    p, q = rng.uniform(-6.0, 14.0, (2, 2, 150))
    q[:, :20] = p[:, :20]
    q[0, 20:40] = p[0, 20:40]
    q[1, 40:60] = p[1, 40:60]
    found = thing.segment_distance(p, q)
    expected = [naive_segment(thing, a, b) for a, b in zip(p.T, q.T, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, thing.segment_distance(q, p), rtol=0, atol=1e-12)


@ALL
def test_a_segment_without_length_is_a_point(thing):
    p = np.random.default_rng(3).uniform(-10.0, 15.0, (2, 5, 7))
    np.testing.assert_allclose(thing.segment_distance(p, p), thing.distance(p), rtol=0, atol=1e-14)


@ALL
def test_ends_broadcast(thing):
    fan = np.random.default_rng(4).uniform(-9.0, 9.0, (2, 6))
    found = thing.segment_distance(np.array([[1.0], [2.0]]), fan)
    assert found.shape == (6,)
    assert found[3] == thing.segment_distance([1.0, 2.0], fan[:, 3])


place = st.floats(-20.0, 20.0)
pairs = st.tuples(place, place).map(np.array)
obstacles = st.one_of(
    st.builds(lambda x, z, a, b: Rectangle((x, x + a), (z, z + b)), place, place, *[st.floats(1e-3, 30.0)] * 2),
    st.builds(lambda x, z, r: Disc((x, z), r), place, place, st.floats(1e-4, 10.0)),
    st.builds(lambda turn, d: HalfPlane((math.cos(turn), math.sin(turn)), d), st.floats(0.0, 7.0), place),
    st.sampled_from(RECTANGLES),
)


@examples(300)
@given(obstacles, pairs, pairs, pairs, pairs)
def test_no_greater_move_of_an_end_moves_the_distance_more(thing, p, q, a, b):
    moved = abs(thing.segment_distance(p, q) - thing.segment_distance(a, b))
    assert moved <= max(math.dist(p, a), math.dist(q, b)) + 1e-12
    assert abs(thing.distance(p) - thing.distance(a)) <= math.dist(p, a) + 1e-12


@examples(200)
@given(obstacles, pairs, pairs, st.floats(0.0, 1.0))
def test_no_point_of_a_segment_is_nearer(thing, p, q, share):
    assert thing.segment_distance(p, q) <= thing.distance(p + share * (q - p)) + 1e-12


@examples(100)
@given(obstacles, st.floats(0.0, 5.0))
def test_corners_keep_the_margin_and_not_much_more(thing, margin):
    corners = thing.corners(margin)
    gaps = thing.distance(corners)
    assert np.all(gaps >= margin - 1e-12)
    size = thing.radius if isinstance(thing, Disc) else 0.0
    assert np.all(gaps <= 1.083 * margin + 0.02 * size + 1e-12)


@pytest.mark.parametrize("thing", [RECTANGLES[0], OTHERS[0]], ids=repr)
def test_a_polygon_of_the_corners_keeps_the_margin(thing):
    corners = thing.corners(0.8)
    centre = corners.mean(axis=1, keepdims=True)
    assert thing.distance(centre)[0] < 0.0
    ring = corners[:, np.argsort(np.arctan2(*(corners - centre)))]
    for p, q in pairwise([*ring.T, ring[:, 0]]):
        assert 0.8 - 1e-12 <= naive_segment(thing, p, q) <= 0.8 * 1.083


def test_half_plane_and_rectangle_are_one_where_they_describe_the_same_set():
    rng = np.random.default_rng(5)
    p, q = rng.uniform(-9.0, 9.0, (2, 2, 100))
    ground, slab = HalfPlane((0.0, 2.0), 5.0), Rectangle((-INF, INF), (2.5, INF))
    assert ground == HalfPlane((0.0, 1.0), 2.5)
    np.testing.assert_allclose(ground.distance(p), slab.distance(p), rtol=0, atol=1e-14)
    np.testing.assert_allclose(ground.segment_distance(p, q), slab.segment_distance(p, q), rtol=0, atol=1e-14)
    assert ground.corners(1.0).shape == slab.corners(1.0).shape == (2, 0)


def test_whatever_has_the_methods_is_an_obstacle():
    class Mine:
        def distance(self, points):
            return np.ones(np.shape(points)[1:])

        def segment_distance(self, p, q):
            return np.ones(np.shape(p)[1:])

        def corners(self, margin):
            return np.empty((2, 0))

    assert isinstance(Mine(), Obstacle)
    assert not isinstance((1.0, 2.0), Obstacle)


@ALL
def test_obstacles_are_frozen_and_hashable(thing):
    with pytest.raises(dataclasses.FrozenInstanceError):
        thing.anything = 1.0
    assert thing in {thing}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Rectangle((1.0, 1.0), (0.0, 1.0)), "x must increase, got 1 and 1"),
        (lambda: Rectangle((0.0, 1.0), (2.0, -1.0)), "z must increase, got 2 and -1"),
        (lambda: Rectangle((0.0, math.nan), (0.0, 1.0)), "x must be a number, got nan"),
        (lambda: Rectangle((0.0, 1.0, 2.0), (0.0, 1.0)), "x must be two numbers"),
        (lambda: Rectangle((-INF, INF), (-INF, INF)), "must have a finite side"),
        (lambda: Disc((0.0, 0.0), 0.0), "radius must be finite and above 0, got 0"),
        (lambda: Disc((0.0, 0.0), -1.0), "radius must be finite and above 0, got -1"),
        (lambda: Disc((0.0, 0.0), INF), "radius must be finite and above 0, got inf"),
        (lambda: Disc((0.0, 0.0), math.nan), "radius must be a number, got nan"),
        (lambda: Disc((0.0, INF), 1.0), "centre must be finite, got 0 and inf"),
        (lambda: Disc((0.0,), 1.0), "centre must be two numbers"),
        (lambda: Disc(3.0, 1.0), "centre must be two numbers, got 3.0"),
        (lambda: HalfPlane((0.0, 0.0), 1.0), "normal must have a length above 0"),
        (lambda: HalfPlane((0.0, math.nan), 1.0), "normal must be a number, got nan"),
        (lambda: HalfPlane((0.0, 1.0), INF), "offset must be finite, got inf"),
    ],
)
def test_bad_values_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_what_is_no_number_is_rejected():
    with pytest.raises(TypeError, match="radius must be a number, got 'wide'"):
        Disc((0.0, 0.0), "wide")
    with pytest.raises(TypeError, match="x must be a number, got 'left'"):
        Rectangle(("left", 1.0), (0.0, 1.0))


@ALL
def test_points_must_be_of_the_plane(thing):
    with pytest.raises(ValueError, match=r"points must have shape \(2, ...\), got \(3,\)"):
        thing.distance([1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"must have shape \(2, ...\)"):
        thing.segment_distance([1.0, 2.0], 3.0)
