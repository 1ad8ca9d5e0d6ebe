"""Certified clearance: closed forms, dense independent sampling, what samples would miss, and rejections."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan.planning.clearance import clearance
from ctrlplan.planning.obstacles import Disc, HalfPlane, Rectangle
from ctrlplan.systems.plants import Crane


class Plumb:
    """Rope that hangs straight down from z = 0."""

    order = 0

    def top(self, jet):
        return np.stack([jet[0, 0], np.zeros_like(jet[0, 1])])

    def slopes(self, plan):
        return np.array([[1.0, 0.0]])


def move(start, goal, duration=10.0):
    return cp.PolySpline([cp.Waypoint(0, start, 0, 0), cp.Waypoint(duration, goal, 0, 0)])


ACROSS = move([0.0, 5.0], [20.0, 5.0])


def sampled(plan, obstacles, load, crane, count=20001):
    """Clearances of load and rope at samples: naive distances, the rope as a row of points, without the load's end."""
    t = np.linspace(plan.start, plan.end, count)
    jet = plan.jet(t, 2)
    to_load = np.min([naive(thing, *jet[0]) for thing in obstacles], axis=0) - load
    if crane is None:
        return to_load.min()
    found = crane.quantities(jet)
    lean = np.array([np.sin(found["theta"]), np.cos(found["theta"])])
    rows = [np.min([naive(o, *(jet[0] - s * found["R"] * lean)) for o in obstacles]) for s in np.linspace(0.0, 1.0, 51)]
    return min(to_load.min(), *rows)


def naive(thing, x, z):
    if isinstance(thing, Disc):
        return np.sqrt((x - thing.centre[0]) ** 2 + (z - thing.centre[1]) ** 2) - thing.radius
    if isinstance(thing, HalfPlane):
        return thing.offset - thing.normal[0] * x - thing.normal[1] * z
    outside = np.sqrt((x - np.clip(x, *thing.x)) ** 2 + (z - np.clip(z, *thing.z)) ** 2)
    depth = np.min([x - thing.x[0], thing.x[1] - x, z - thing.z[0], thing.z[1] - z], axis=0)
    return np.where(outside > 0.0, outside, -depth)


def test_a_straight_move_past_a_disc_keeps_what_geometry_says():
    found = clearance(ACROSS, [Disc((10.0, 9.0), 1.0), Disc((4.0, 0.0), 3.0)], load=0.5)
    assert found.minimum == pytest.approx(1.5, abs=1e-6)
    assert 1.5 - 2e-6 <= found.lower <= 1.5
    assert (found.obstacle, found.part, found.required, found.certified) == (1, "load", None, None)
    assert found.position == pytest.approx((4.0, 5.0), abs=2e-3)
    np.testing.assert_allclose(ACROSS(found.time), found.position, rtol=0, atol=1e-13)


def test_what_is_attained_at_an_end_is_attained_exactly():
    found = clearance(ACROSS, [Disc((23.0, 9.0), 1.0)])
    assert (found.minimum, found.time, found.position) == (4.0, 10.0, (20.0, 5.0))
    assert 4.0 - 4e-6 <= found.lower <= 4.0


def test_a_parallel_wall_is_as_far_at_every_instant():
    found = clearance(ACROSS, [HalfPlane((0.0, 1.0), 7.0)], load=1.0)
    assert found.minimum == pytest.approx(1.0, abs=1e-14)
    assert 1.0 - 1e-6 <= found.lower <= 1.0


@pytest.mark.parametrize("required", [1.0, 1.0 - 1e-12])
def test_as_near_as_allowed_is_certified(required):
    assert clearance(ACROSS, [HalfPlane((0.0, 1.0), 7.0)], load=1.0, required=required).certified
    descent = move([0.0, 5.0], [20.0, 6.0])
    assert clearance(descent, [HalfPlane((0.0, 1.0), 7.0)], required=required).certified
    assert not clearance(descent, [HalfPlane((0.0, 1.0), 7.0)], required=required + 1e-6).certified


def test_required_decides_and_spends_no_more():
    near = clearance(ACROSS, [Disc((10.0, 9.0), 1.0)], required=2.0, max_cells=100)
    assert near.certified
    assert 2.0 <= near.lower <= near.minimum
    missed = clearance(ACROSS, [Disc((10.0, 9.0), 1.0)], required=3.0 + 1e-6)
    assert not missed.certified
    assert missed.required == 3.0 + 1e-6
    assert missed.minimum == pytest.approx(3.0, abs=1e-6)


@pytest.mark.parametrize("radius", [1e-4, 1e-6])
def test_a_spike_between_samples_is_not_missed(radius):
    plan = cp.TrigSpline([cp.Waypoint(0, [0, 5], 0, 0), cp.Waypoint(10, [20, 6], 0, 0)], alpha=2.0)
    time = math.pi
    velocity = plan(time, 1)
    across = np.array([-velocity[1], velocity[0]]) / np.hypot(*velocity)
    # Grazed: the path cuts off a tenth of the radius.
    spike = Disc(tuple(plan(time) + 0.9 * radius * across), radius)
    t = np.linspace(0.0, 10.0, 1001)
    assert spike.distance(plan(t)).min() > 0.0
    found = clearance(plan, [spike], required=0.0)
    assert not found.certified
    assert found.lower <= -0.1 * radius
    assert found.minimum == pytest.approx(-0.1 * radius, abs=1e-6)
    past = Disc(tuple(plan(time) + 1.1 * radius * across), radius)
    assert clearance(plan, [past], required=0.0).certified


def test_a_corner_at_a_breakpoint_belongs_to_the_plan():
    plan = cp.PiecewiseSpline([cp.Waypoint(0, [0, 5]), cp.Waypoint(math.e, [10, 2]), cp.Waypoint(9, [20, 5])])
    found = clearance(plan, [Disc((10.0, -1.0), 1.0)], required=1.9)
    assert found.certified
    assert found.minimum == 2.0
    assert found.time == math.e


def test_a_rope_from_above_is_cut_by_what_the_load_passes_below():
    disc = Disc((10.0, 2.0), 1.0)
    assert clearance(ACROSS, [disc], required=1.0).certified
    found = clearance(ACROSS, [disc], rope=Plumb(), required=0.0)
    assert (found.part, found.certified) == ("rope", False)
    assert found.minimum == pytest.approx(-1.0, abs=2e-6)
    above = clearance(ACROSS, [Disc((10.0, -3.0), 1.0)], rope=Plumb(), load=3.0)
    assert above.minimum == pytest.approx(2.0, abs=2e-6)
    assert above.part == "rope"


def test_a_point_load_is_at_the_end_of_its_rope():
    found = clearance(ACROSS, [HalfPlane((0.0, 1.0), 7.0)], rope=Plumb())
    assert found.minimum == pytest.approx(2.0, abs=1e-14)
    assert 2.0 - 1e-3 < found.lower <= 2.0


def test_cells_that_do_not_suffice_are_said():
    with pytest.raises(ValueError, match=r"must be decided within 500 cells, got a bound of .* and a minimum of 2 wh"):
        clearance(ACROSS, [HalfPlane((0.0, 1.0), 7.0)], rope=Plumb(), required=2.0 - 1e-6, max_cells=500)


number = st.floats(-3.0, 3.0)
things = st.one_of(
    st.builds(lambda x, z, r: Disc((x, z), r), st.floats(0.0, 20.0), st.floats(0.0, 12.0), st.floats(0.01, 3.0)),
    st.builds(
        lambda x, z, a, b: Rectangle((x, x + a), (z, z + b)),
        st.floats(0.0, 20.0),
        st.floats(0.0, 12.0),
        *[st.floats(0.01, 6.0)] * 2,
    ),
    st.builds(
        lambda turn, d: HalfPlane((math.cos(turn), math.sin(turn)), d), st.floats(0.0, 7.0), st.floats(5.0, 20.0)
    ),
)


@examples(10)
@given(
    st.sampled_from(["polynomial", "trigonometric", "piecewise"]),
    st.lists(st.tuples(st.floats(0.0, 20.0), st.floats(5.0, 12.0)), min_size=2, max_size=4),
    st.lists(things, min_size=1, max_size=3),
    st.floats(0.0, 1.0),
    st.booleans(),
)
def test_no_sample_is_nearer_than_the_bound_and_the_bound_is_near(family, places, obstacles, load, roped):
    ends = (0, len(places) - 1)
    points = [
        cp.Waypoint(6.0 * k, list(p), *([0, 0] if k in ends else [[1.0, 0.1], None])) for k, p in enumerate(places)
    ]
    plan = {
        "polynomial": cp.PolySpline,
        "trigonometric": lambda p: cp.TrigSpline(p, alpha=1.5),
        "piecewise": cp.PiecewiseSpline,
    }[family](points)
    crane = Crane() if roped and float(plan.extrema(2).maximum[1]) < 9.0 else None
    rope = crane and crane.rope()
    found = clearance(plan, obstacles, load=load, rope=rope)
    minimum = sampled(plan, obstacles, load, crane, 20001 if crane is None else 2001)
    assert found.lower <= minimum + 1e-12
    assert found.lower <= found.minimum
    if crane is None:
        assert minimum <= found.minimum + 1e-12 + 1e-3 * float(np.hypot(*plan.peak(1)))
        assert found.lower >= found.minimum - 1e-6 * max(1.0, abs(found.minimum))
        assert found.minimum <= minimum + 1e-6 * max(1.0, abs(minimum)) + 1e-12
    else:
        assert found.minimum <= minimum + 0.05
        assert found.lower >= found.minimum - 1e-2
    required = found.minimum - 0.01
    assert clearance(plan, obstacles, load=load, rope=rope, required=required).certified
    assert not clearance(plan, obstacles, load=load, rope=rope, required=found.minimum + 1e-4).certified


def test_thousands_of_segments_within_the_tolerance():
    times = np.arange(3000.0)
    places = np.random.default_rng(5).uniform(-5.0, 5.0, (2, times.size))
    plan = cp.PiecewiseSpline.from_arrays(times, places, warn=False)
    things = [Disc((0.0, 0.0), 1.0), Rectangle((6.0, 7.0), (1.0, 2.0))]
    found = clearance(plan, things)
    samples = plan.jet(np.linspace(plan.start, plan.end, 90_001), 0)[0]
    minimum = min(naive(thing, *samples).min() for thing in things)
    assert found.lower <= found.minimum <= minimum + 1e-6
    assert found.lower >= found.minimum - 1e-6


def test_the_date_of_a_plan_does_not_matter():
    points = [cp.Waypoint(0, [0, 5], 0, 0), cp.Waypoint(4, [9, 1]), cp.Waypoint(8, [20, 5], 0, 0)]
    plan, things = cp.PolySpline(points), [Disc((13.0, -3.0), 1.0)]
    now, later = clearance(plan, things), clearance(plan.shift(2.0**30), things)
    assert later.minimum == pytest.approx(now.minimum, abs=1e-12)
    assert later.lower == pytest.approx(now.lower, abs=1e-12)


def test_clearance_is_frozen():
    found = clearance(ACROSS, [Disc((10.0, 9.0), 1.0)])
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.lower = 0.0


@pytest.mark.parametrize(
    ("plan", "obstacles", "options", "message"),
    [
        (ACROSS, [], {}, "at least one obstacle, got none"),
        (ACROSS, [Disc((0, 0), 1)], {"load": -0.1}, "load must be finite and at least 0, got -0.1"),
        (ACROSS, [Disc((0, 0), 1)], {"load": math.nan}, "load must be finite and at least 0, got nan"),
        (ACROSS, [Disc((0, 0), 1)], {"load": math.inf}, "load must be finite"),
        (ACROSS, [Disc((0, 0), 1)], {"required": math.nan}, "required must be a number, got nan"),
        (cp.Step([1.0, 2.0]), [Disc((0, 0), 1)], {}, "must have a duration for its clearance, got a step"),
        (ACROSS.select(["y1"]), [Disc((0, 0), 1)], {}, "must have two axes, got 1"),
        (
            cp.PolySpline([cp.Waypoint(0, [0, 0, 0]), cp.Waypoint(1, [1, 1, 1])]),
            [Disc((0, 0), 1)],
            {},
            "must have two axes, got 3",
        ),
    ],
)
def test_bad_values_are_rejected(plan, obstacles, options, message):
    with pytest.raises(ValueError, match=message):
        clearance(plan, obstacles, **options)


def test_what_is_no_obstacle_is_rejected():
    with pytest.raises(TypeError, match=r"obstacles\[1\] must be an obstacle, got \(1, 2\)"):
        clearance(ACROSS, [Disc((0, 0), 1), (1, 2)])
    with pytest.raises(TypeError, match=r"must be a sequence of obstacles, got Disc"):
        clearance(ACROSS, Disc((0, 0), 1))
    with pytest.raises(TypeError, match="load must be a number, got None"):
        clearance(ACROSS, [Disc((0, 0), 1)], load=None)


def test_a_rope_with_wrong_slopes_is_rejected():
    class Wrong(Plumb):
        def slopes(self, plan):
            return np.array([1.0, -1.0])

    with pytest.raises(ValueError, match=r"slopes of the rope must be finite, at least 0 and of shape \(1, 2\)"):
        clearance(ACROSS, [Disc((0, 0), 1)], rope=Wrong())


def test_distances_that_are_no_numbers_are_rejected():
    class Hole(Disc):
        def distance(self, points):
            return np.full(np.shape(points)[1:], np.nan)

    with pytest.raises(ValueError, match="distances must be finite over the plan"):
        clearance(ACROSS, [Hole((0.0, 0.0), 1.0)])


@pytest.mark.parametrize("seed", range(5))
def test_a_bound_is_not_rounded_upwards(seed):
    """On a line at constant speed along a wall the bound is exact, and all samples are equal up to rounding."""
    rng = np.random.default_rng(seed)
    angle, offset, far = rng.uniform(0.0, 2.0 * np.pi), rng.normal(), 10.0 ** rng.uniform(-2.0, 4.0)
    normal, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    points = [(offset + 1.0) * normal + side * far * along for side in (-1.0, 1.0)]
    plan = cp.PolySpline([cp.Waypoint(0, points[0]), cp.Waypoint(10, points[1])])
    wall = HalfPlane(tuple(-normal), -offset)
    found = clearance(plan, [wall])
    assert found.lower <= wall.distance(plan(np.linspace(0.0, 10.0, 100_001))).min()
    assert found.lower == pytest.approx(1.0, abs=1e-13 * max(far, 1.0))
