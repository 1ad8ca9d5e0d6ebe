"""Ways around obstacles: the wall of the paper without its via points, verified by dense sampling of the test's own."""

import copy
import math
import pickle
import re

import numpy as np
import pytest
from natural import NaturalCubic
from repetitions import one_in

import ctrlplan as cp
from ctrlplan.planning import inequalities, plan_length
from ctrlplan.planning.avoid import avoid
from ctrlplan.planning.clearance import clearance
from ctrlplan.planning.obstacles import Disc, HalfPlane, Rectangle
from ctrlplan.studies.crane import WALL
from ctrlplan.systems.plants import Crane

INF = math.inf
PAPER = (
    cp.Waypoint.from_jets(0.0, x=[0.0, 0.0, 0.0], z=[10.0, 0.0, 0.0]),
    cp.Waypoint.from_jets(16.0, x=[20.0, 0.0, 0.0], z=[11.0, 0.0, 0.0]),
)
FAMILIES = {
    "polynomial": cp.PolySpline,
    "trigonometric 1": lambda points: cp.TrigSpline(points, alpha=1.0),
    "trigonometric 4": lambda points: cp.TrigSpline(points, alpha=4.0),
    "piecewise": cp.PiecewiseSpline,
}
EVERY_FAMILY = pytest.mark.parametrize("family", FAMILIES)
GROUND = HalfPlane((0.0, 1.0), 12.5)


def rest(start, goal, duration=16.0):
    return [cp.Waypoint(0.0, start, 0, 0), cp.Waypoint(duration, goal, 0, 0)]


ACROSS = rest([0.0, 5.0], [20.0, 5.0])


def naive(thing, x, z):
    """Distance of points, not above 0 inside."""
    if isinstance(thing, Disc):
        return np.sqrt((x - thing.centre[0]) ** 2 + (z - thing.centre[1]) ** 2) - thing.radius
    if isinstance(thing, HalfPlane):
        return thing.offset - thing.normal[0] * x - thing.normal[1] * z
    return np.sqrt((x - np.clip(x, *thing.x)) ** 2 + (z - np.clip(z, *thing.z)) ** 2)


def check(plan, found, obstacles, *, gap, load=0.0, crane=None, points=4):
    """The same waypoints, via points with positions alone, and clear at 20001 instants."""
    t = np.linspace(plan.start, plan.end, 20001)
    x, z = found(t)
    for thing in obstacles:
        assert np.min(naive(thing, x, z)) >= load + gap - 1e-9
    if crane is not None:
        g, b = crane.gravity, crane.drum_radius
        across, hanging = found(t, 2)[0], g - found(t, 2)[1]
        pull = np.sqrt(across**2 + hanging**2)
        length = (z * pull - b * across) / hanging
        for share in np.linspace(0.0, 1.0, 41):
            along = x + share * length * across / pull, z - share * length * hanging / pull
            for thing in obstacles:
                assert np.min(naive(thing, *along)) >= gap - 1e-9
    assert (found.start, found.end, found.labels) == (plan.start, plan.end, plan.labels)
    preserved = [w for w in found.waypoints if w in plan.waypoints]
    added = [w for w in found.waypoints if w not in plan.waypoints]
    assert tuple(preserved) == plan.waypoints
    assert 1 <= len(added) <= points
    assert all(len(w.jet) == 1 for w in added)
    for w in plan.waypoints:
        values, known = found.jet(w.time, len(w.jet) - 1), np.isfinite(w.jet)
        np.testing.assert_allclose(values[known], w.jet[known], rtol=0, atol=1e-8)


@pytest.mark.slow
@EVERY_FAMILY
def test_the_wall_of_the_paper_is_passed_without_its_via_points(family):
    plan = FAMILIES[family](PAPER)
    obstacles = [Rectangle(*WALL), GROUND]
    found = avoid(plan, obstacles, clearance=0.3, load=0.5, rope=Crane().rope()).plan
    check(plan, found, obstacles, gap=0.3, load=0.5, crane=Crane())
    assert type(found) is type(plan)
    assert found.alpha == plan.alpha
    assert clearance(found, obstacles, load=0.5, rope=Crane().rope(), required=0.3).certified
    # Over the wall without extra reversals: up to one height, and down.
    z = found(np.linspace(0.0, 16.0, 2001))[1]
    assert np.count_nonzero(np.diff(np.sign(np.diff(z)[np.abs(np.diff(z)) > 1e-6]))) <= 3
    assert 5.0 < z.min() < 5.7


@EVERY_FAMILY
def test_without_rope_and_ground_below_the_wall_is_nearer(family):
    plan = FAMILIES[family](PAPER)
    found = avoid(plan, [Rectangle(*WALL)], clearance=0.3, load=0.5).plan
    check(plan, found, [Rectangle(*WALL)], gap=0.3, load=0.5)
    if family != "trigonometric 4":
        assert found(8.0)[1] > 12.8


def test_a_plan_that_keeps_clear_is_returned_itself():
    plan = cp.PolySpline(PAPER)
    assert avoid(plan, [Rectangle((7.0, 13.0), (12.0, 13.0))], clearance=0.3, load=0.5).plan is plan


def test_it_moves_no_farther_than_it_must():
    plan = cp.PolySpline(ACROSS)
    found = avoid(plan, [Disc((10.0, 5.2), 2.0)], clearance=0.5).plan
    check(plan, found, [Disc((10.0, 5.2), 2.0)], gap=0.5)
    # By symmetry the extreme is at the middle, above the disc: 5.2 - 2.5 up to the margin of the search.
    assert found(8.0)[0] == pytest.approx(10.0, abs=1e-2)
    assert 2.68 < found(8.0)[1] <= 2.7


def test_among_several_paths_that_of_minimum_roughness_is_chosen():
    """Two mirrored problems have mirrored answers, though their shortest way is found on the other side."""
    obstacles = [Disc((10.0, 5.2), 2.0), Disc((7.0, 1.6), 1.0)]
    mirrored = [Disc((10.0, 4.8), 2.0), Disc((7.0, 8.4), 1.0)]
    found = avoid(cp.PolySpline(ACROSS), obstacles, clearance=0.3).plan
    other = avoid(cp.PolySpline(ACROSS), mirrored, clearance=0.3).plan
    check(cp.PolySpline(ACROSS), found, obstacles, gap=0.3)
    t = np.linspace(0.0, 16.0, 101)
    np.testing.assert_allclose(found(t)[1], 10.0 - other(t)[1], rtol=0, atol=0.02)


@EVERY_FAMILY
def test_a_slalom_between_walls_without_end(family):
    plan = FAMILIES[family](rest([0.0, 0.0], [20.0, 0.0]))
    obstacles = [Rectangle((5.0, 6.0), (-1.0, INF)), Rectangle((13.0, 14.0), (-INF, 1.0))]
    found = avoid(plan, obstacles, clearance=0.2, load=0.3).plan
    check(plan, found, obstacles, gap=0.2, load=0.3)


LATE = Rectangle((8.0, 15.0), (35.0, 60.0)), cp.HalfPlane((0.0, 1.0), 52.0)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["polynomial", "piecewise"])
@pytest.mark.parametrize("gap", one_in(5, [0.0, 0.01, 0.1, 0.5, 1.0]))
def test_a_wall_that_must_be_passed_far_below(family, gap):
    """The shortest polyline is 62.08 m at a clearance of 0; what is found is at most 5 % above 64 m."""
    still = [[0.0, 0.0]] * 4
    points = [cp.Waypoint(0.0, [0.0, 50.0], *still), cp.Waypoint(40.0, [50.0, 50.0], *still)]
    plan = cp.PolySpline(points) if family == "polynomial" else cp.PiecewiseSpline(points)
    found = avoid(plan, LATE, clearance=gap).plan
    check(plan, found, LATE, gap=gap)
    x, z = found(np.linspace(0.0, 40.0, 20_001))
    assert not ((x > 8.0 + 1e-9) & (x < 15.0 - 1e-9) & (z > 35.0 + 1e-9)).any()
    around = np.hypot(8.0, 15.0 + gap) + 7.0 + np.hypot(35.0, 15.0 + gap)
    assert around * 0.99 < plan_length(found) <= 1.05 * (64.0 + 2.0 * gap)


WALLS = [
    Rectangle((4.0 * k + 1.8, 4.0 * k + 2.2), (-INF, 1.0) if k % 2 else (-1.0, INF)) for k in range(9)
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("order", one_in(3, [2, 3, 4], first=1))
def test_a_slalom_of_nine_walls(order):
    """The shortest polyline has 18 corners, and at a clearance of 0.2 a length of 42.80 m."""
    still = [[0.0, 0.0]] * order
    plan = cp.PiecewiseSpline([cp.Waypoint(0, [0, 0], *still), cp.Waypoint(36, [36, 0], *still)])
    found = avoid(plan, WALLS, clearance=0.2).plan
    check(plan, found, WALLS, gap=0.2, points=10)
    assert 42.79 < plan_length(found) < 1.05 * 42.80
    height = np.interp(4.0 * np.arange(9) + 2.0, *found(np.linspace(0.0, 36.0, 4001)))
    assert (height * (-1.0) ** np.arange(9) < -1.19).all()


@pytest.mark.slow
def test_fewer_via_points_than_walls_are_said():
    plan = cp.PiecewiseSpline(rest([0.0, 0.0], [36.0, 0.0]))
    with pytest.raises(ValueError, match=r"no plan with 2 via points or fewer and a clearance of 0\.2 was found"):
        avoid(plan, WALLS, clearance=0.2, max_points=2)


def test_windows_in_two_walls():
    plan = cp.PolySpline(ACROSS)
    obstacles = [
        *(Rectangle((6.0, 6.5), side) for side in ((-INF, 8.0), (9.5, INF))),
        *(Rectangle((13.0, 13.5), side) for side in ((-INF, 1.0), (2.5, INF))),
    ]
    check(plan, avoid(plan, obstacles, clearance=0.2, load=0.3).plan, obstacles, gap=0.2, load=0.3)


@pytest.mark.slow
def test_many_discs():
    plan = cp.PolySpline(ACROSS)
    places = [(3, 5.5), (7, 4), (11, 6), (15, 4.5), (9, 8), (13, 1), (5, 1)]
    obstacles = [Disc(place, 1.0 + 0.05 * k) for k, place in enumerate(places)]
    check(plan, avoid(plan, obstacles, clearance=0.3).plan, obstacles, gap=0.3)


@pytest.mark.slow
def test_a_long_tunnel():
    plan = cp.PiecewiseSpline(ACROSS)
    obstacles = [Rectangle((6.0, 14.0), (-INF, 6.0)), Rectangle((6.0, 14.0), (7.0, INF))]
    check(plan, avoid(plan, obstacles, clearance=0.15, load=0.3).plan, obstacles, gap=0.15, load=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_scenes_at_random_without_a_rope_are_all_solved(family):
    """Scattered discs and rectangles never close the plane: only a waypoint may be too near."""
    rng = np.random.default_rng(7)
    solved = 0
    for _ in range(4):
        x, z = rng.uniform([[3.0], [0.0]], [[16.0], [10.0]], (2, 3))
        obstacles = [
            Disc((x[0], z[0]), 1.5),
            Rectangle((x[1], x[1] + 1.0), (z[1], z[1] + 3.0)),
            Disc((x[2], z[2]), 0.4),
        ]
        plan = FAMILIES[family](rest([0.0, rng.uniform(0.0, 10.0)], [20.0, rng.uniform(0.0, 10.0)], 10.0))
        found = avoid(plan, obstacles, clearance=0.3, load=0.3).plan
        if found is not plan:
            check(plan, found, obstacles, gap=0.3, load=0.3)
            solved += 1
    assert solved >= 2


@pytest.mark.slow
def test_waypoints_of_the_user_stay_with_all_entries():
    points = [ACROSS[0], cp.Waypoint(8.0, [10.0, 5.0], [2.0, 0.1]), ACROSS[1]]
    plan = cp.PolySpline(points, labels=["x", "z"])
    obstacles = [Disc((5.0, 5.2), 2.0), Disc((15.0, 4.9), 2.0)]
    check(plan, avoid(plan, obstacles, clearance=0.4).plan, obstacles, gap=0.4)


@pytest.mark.slow
def test_there_and_back():
    points = [cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(8, [10, 0], 0, 0), cp.Waypoint(16, [0, 0], 0, 0)]
    plan = cp.PolySpline(points)
    check(plan, avoid(plan, [Disc((5.0, 0.1), 2.0)], clearance=0.5).plan, [Disc((5.0, 0.1), 2.0)], gap=0.5)


def test_positions_alone_leave_no_jerk_to_spare():
    plan = cp.PolySpline([cp.Waypoint(0, [0, 5]), cp.Waypoint(16, [20, 5])])
    check(plan, avoid(plan, [Disc((10.0, 5.2), 2.0)], clearance=0.5).plan, [Disc((10.0, 5.2), 2.0)], gap=0.5)


def test_a_waypoint_as_near_as_allowed_is_no_hindrance():
    plan = cp.PolySpline(rest([0.0, 12.0], [20.0, 12.0]))
    obstacles = [HalfPlane((0.0, 1.0), 12.5), Rectangle((8.0, 12.0), (6.0, 13.0))]
    check(plan, avoid(plan, obstacles, clearance=0.2, load=0.3).plan, obstacles, gap=0.2, load=0.3)


@pytest.mark.parametrize(
    "plan",
    [
        cp.TrigSpline(ACROSS, alpha=2.0, gamma=1.0),  # an even number of constraints: two via points
        cp.TrigSpline(ACROSS, alpha=2.0, degree=5),
        cp.PolySpline(ACROSS, degree=6),
        cp.PiecewiseSpline(ACROSS, alpha=1.0),
    ],
)
def test_options_of_the_plan_are_preserved(plan):
    found = avoid(plan, [Disc((10.0, 5.2), 2.0)], clearance=0.5).plan
    check(plan, found, [Disc((10.0, 5.2), 2.0)], gap=0.5)
    assert type(found) is type(plan)
    assert found.to_dict() == plan.to_dict() | {"waypoints": found.to_dict()["waypoints"]}


def test_what_one_polynomial_cannot_do_is_left_to_segments():
    """With its degree fixed there is no room for a via point: the answer is of another kind."""
    plan = cp.TrigSpline(ACROSS, alpha=2.0, gamma=[1.0, None], degree=3)
    found = avoid(plan, [Disc((10.0, 5.2), 2.0)], clearance=0.5).plan
    check(plan, found, [Disc((10.0, 5.2), 2.0)], gap=0.5)
    assert type(found) is cp.PiecewiseSpline


def test_the_same_question_has_the_same_answer():
    plan = cp.TrigSpline(PAPER, alpha=1.0)
    first, second = (avoid(plan, [Rectangle(*WALL), GROUND], clearance=0.3).plan for _ in range(2))
    assert first.to_dict() == second.to_dict()


RING = [Rectangle(x, z) for x in ((17.0, 18.0), (22.0, 23.0)) for z in ((2.0, 8.0),)] + [
    Rectangle((17.0, 23.0), z) for z in ((2.0, 3.0), (7.0, 8.0))
]


@pytest.mark.slow
def test_a_goal_enclosed_is_said_with_how_near_a_plan_comes():
    """Whoever crosses a wall 1 m thick is 0.5 m deep in it somewhere, and a load of 0.3 m deeper."""
    with pytest.raises(
        ValueError, match=r"no plan with 1 via points or fewer and a clearance of 0.1 was found"
    ) as error:
        avoid(cp.PolySpline(ACROSS), RING, clearance=0.1, load=0.3, max_points=1)
    best, part, thing, x, z, time = re.search(
        r"maximum clearance is (\S+), of the (\w+) from obstacles\[(\d)\] with the load at \((\S+), (\S+)\) at (\S+) s",
        str(error.value),
    ).groups()
    assert (best, part, thing, x, z) == ("-0.8", "load", "0", "17.5", "5")
    # It is the plan given: 17.5/20 of the way of a minimum-jerk move.
    s = float(time) / 16.0
    assert 10 * s**3 - 15 * s**4 + 6 * s**5 == pytest.approx(17.5 / 20.0, abs=1e-3)


@pytest.mark.slow
def test_a_gap_too_narrow_is_said_with_what_it_would_allow():
    walls = [Rectangle((9.0, 11.0), (-INF, 6.0)), Rectangle((9.0, 11.0), (7.0, INF))]
    with pytest.raises(ValueError, match=r"a clearance of 0\.3 was found") as error:
        avoid(cp.PolySpline(ACROSS), walls, clearance=0.3, load=0.3)
    best = float(re.search(r"maximum clearance is (\S+),", str(error.value)).group(1))
    assert 0.15 < best <= 0.2  # half of the gap of 1 m less the load


@pytest.mark.parametrize("wider", [1e-3, 5e-3, 0.02])
@pytest.mark.parametrize("radius", [2.0, 8.0])
def test_a_gap_slightly_wider_than_required_is_passed(wider, radius):
    """Between discs at (5, 2 + g) and (5, 2 - g): polygons around them overlap."""
    half = 0.5 * (1.0 + wider)
    plan = cp.PolySpline(rest([-radius, 0.0], [10.0 + radius, 0.0], 10.0))
    far = half + 2.0 * radius
    obstacles = [
        Disc((5.0, 2.0 + half + radius), radius),
        Disc((5.0, 2.0 - half - radius), radius),
        Rectangle((4.5, 5.5), (2.0 + far, 10.0 + far)),
        Rectangle((4.5, 5.5), (-6.0 - far, 2.0 - far)),
    ]
    found = avoid(plan, obstacles, clearance=0.5)
    check(plan, found.plan, obstacles, gap=0.5)
    assert found.clearance.certified
    assert abs(found.plan(5.0)[1] - 2.0) < 0.5
    assert plan_length(found.plan) < 11.5 + 2.0 * radius


@pytest.mark.parametrize("wider", [-5e-3, 0.0, 1e-4])
def test_a_gap_in_which_no_plan_is_found_is_said(wider):
    """In a wall; the path below it is 20.6 m long."""
    half = 0.5 * (1.0 + wider)
    plan = cp.PolySpline(rest([0.0, 0.0], [10.0, 0.0], 10.0))
    wall = [Rectangle((4.5, 5.5), (2.0 + half, 12.0)), Rectangle((4.5, 5.5), (-8.0, 2.0 - half))]
    with pytest.warns(UserWarning, match=r"a path of length 10\.8\d leads through a gap .* length 2\d\.\d+; reduce"):
        found = avoid(plan, wall, clearance=0.5)
    assert found.clearance.certified
    check(plan, found.plan, wall, gap=0.5)
    clear = [Rectangle((4.5, 5.5), (2.0 + 0.45, 12.0)), wall[1]]
    assert plan_length(avoid(plan, clear, clearance=0.5).plan) > 20.0  # 5 % narrower: without a warning


@pytest.mark.slow
def test_a_rope_has_no_way_under_what_reaches_above_the_trolley():
    plan = cp.PolySpline(rest([0.0, 9.0], [20.0, 9.0]))
    beam = Rectangle((8.0, 12.0), (-1.0, 3.0))
    assert avoid(plan, [beam], clearance=0.3, load=0.3).plan is plan
    with pytest.raises(
        ValueError, match=r"clearance of 0.3 .* of the rope from obstacles\[0\] with the load at \(\S+, \S+\) at"
    ):
        avoid(plan, [beam], clearance=0.3, load=0.3, rope=Crane().rope(), max_points=1)


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        (Disc((20.0, 4.5), 2.0), r"waypoints\[1\] that lies 1.5 inside obstacles\[1\]"),
        (Disc((0.0, 7.5), 2.0), r"waypoints\[0\] that is 0.2 from obstacles\[1\]"),
        (HalfPlane((0.0, 1.0), 4.0), r"waypoints\[0\] that lies 1 inside obstacles\[1\]"),
    ],
)
def test_a_waypoint_too_near_is_rejected(obstacle, message):
    with pytest.raises(ValueError, match="the load must have a clearance of 0.4 at each waypoint, got " + message):
        avoid(cp.PolySpline(ACROSS), [Disc((10.0, 0.0), 1.0), obstacle], clearance=0.4, load=0.3)


def test_a_rope_too_near_at_rest_is_rejected():
    message = r"the rope must have a clearance of 0.4 at each waypoint, got 0.25 from obstacles\[0\] at waypoints\[1\]"
    with pytest.raises(ValueError, match=message):
        avoid(cp.PolySpline(ACROSS), [Disc((21.0, 2.0), 0.75)], clearance=0.4, rope=Crane().rope())


def test_options_are_checked():
    plan, disc = cp.PolySpline(ACROSS), [Disc((10.0, 5.2), 2.0)]
    with pytest.raises(ValueError, match="clearance must be finite and at least 0, got -1"):
        avoid(plan, disc, clearance=-1.0)
    with pytest.raises(ValueError, match="load must be finite and at least 0, got nan"):
        avoid(plan, disc, load=math.nan)
    with pytest.raises(ValueError, match="max_points must be an integer of at least 1, got 0"):
        avoid(plan, disc, max_points=0)
    with pytest.raises(ValueError, match="at least one obstacle, got none"):
        avoid(plan, [])
    with pytest.raises(TypeError, match=r"obstacles\[0\] must be an obstacle"):
        avoid(plan, [(10.0, 5.2, 2.0)])


def test_plans_of_another_kind_are_rejected():
    disc = [Disc((10.0, 5.2), 2.0)]
    with pytest.raises(TypeError, match="plan must be a spline through waypoints with a duration, got a Step"):
        avoid(cp.Step([1.0, 2.0]), disc)
    with pytest.raises(ValueError, match="must have two axes, got 1"):
        avoid(cp.PolySpline([cp.Waypoint(0, 1), cp.Waypoint(1, 2)]), disc)
    with pytest.raises(ValueError, match=r"positions must be prescribed on both axes, got waypoints\[1\]"):
        avoid(cp.PolySpline([cp.Waypoint(0, [0, 0]), cp.Waypoint(1, [1, math.nan]), cp.Waypoint(2, [2, 2])]), disc)
    loop = cp.TrigSpline.cyclic([cp.Waypoint(0, [0, 0]), cp.Waypoint(1, [1, 2]), cp.Waypoint(2, [3, 1])], 4.0)
    with pytest.raises(ValueError, match="plan must end at its last waypoint, at 2 s, got 4 s"):
        avoid(loop, disc)


def test_a_path_much_longer_than_the_shortest_way_is_said():
    """A family that swings at this alpha, past a disc on its way; the shortest path is the waypoint polyline."""
    ends = [
        cp.Waypoint.from_jets(0.0, x=[0.0, 0.0, 0.0], z=[0.0, 0.0, 0.0]),
        cp.Waypoint.from_jets(10.0, x=[25.0], z=[5.0]),
        cp.Waypoint.from_jets(20.0, x=[50.0, 0.0, 0.0], z=[0.0, 0.0, 0.0]),
    ]
    plan = cp.TrigSpline(ends, alpha=5.2, warn=False)
    x, z = plan(5.0).tolist()
    message = r"the path found is (\S+) long, (\S+) times the shortest path around obstacles"
    with pytest.warns(UserWarning, match=message) as caught:
        found = avoid(plan, [Disc((x, z), 0.5)]).plan
    path = found(np.linspace(0.0, 20.0, 200_001))
    length = float(np.hypot(*np.diff(path)).sum())
    shortest = 2.0 * np.hypot(25.0, 5.0)
    words = re.search(r"found is (\S+) long, (\S+) times", str(caught[0].message))
    assert float(words[1]) == pytest.approx(length, rel=1e-3)
    assert float(words[2]) == pytest.approx(length / shortest, rel=0.06)


# Plans that are not made through waypoints, and those of a user's own


def test_a_plan_of_any_kind_that_keeps_clear_is_returned():
    plan = cp.SCurve([20.0, 5.0], [0.0, 5.0], velocity=2.0, acceleration=1.0, jerk=1.0, labels=["x", "z"])
    found = avoid(plan, [Disc((10.0, 0.0), 2.0)], clearance=2.9)
    assert found.plan is plan
    assert found.clearance.certified
    assert found.clearance.minimum == pytest.approx(3.0, abs=1e-9)  # the line passes 5 m above the centre
    shaped = cp.Shaper.zv(2.0)(plan)
    assert avoid(shaped, [Disc((10.0, 0.0), 2.0)], clearance=2.9).plan is shaped


@pytest.mark.parametrize("shaper", [None, cp.Shaper.zv(2.0)])
def test_what_cannot_be_led_round_says_which_capability_is_missing(shaper):
    plan = cp.SCurve([20.0, 5.0], [0.0, 5.0], velocity=2.0, acceleration=1.0, jerk=1.0, labels=["x", "z"])
    plan = plan if shaper is None else shaper(plan)
    name = type(plan).__name__
    message = rf"plan must be a WaypointSpline, such as PolySpline, .* got a {name} with a clearance of -2"
    with pytest.raises(TypeError, match=message):
        avoid(plan, [Disc((10.0, 5.0), 2.0)], clearance=0.5)


def test_a_spline_of_a_users_own_is_led_round():
    plan = NaturalCubic([cp.Waypoint(0.0, [0.0, 5.0]), cp.Waypoint(16.0, [20.0, 5.0])])
    found = avoid(plan, [Disc((10.0, 5.2), 2.0)], clearance=0.5).plan
    check(plan, found, [Disc((10.0, 5.2), 2.0)], gap=0.5)
    assert type(found) is NaturalCubic


# The result, and its use as a plan, which works for one release


PLANS_WITHOUT_WAYPOINTS = {
    "profile": lambda: cp.SCurve([1.0, 2.0], velocity=8.0, acceleration=200.0, jerk=1e4),
    "fit": lambda: cp.fit([0.0, 1.0, 2.0, 3.0], [[0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 1.0, 0.0]]),
    "stacked": lambda: cp.stack([cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1)])] * 2, labels=["x", "z"]),
}


@pytest.mark.parametrize("kind", PLANS_WITHOUT_WAYPOINTS)
def test_a_result_of_a_plan_without_waypoints_is_displayed(kind):
    found = avoid(PLANS_WITHOUT_WAYPOINTS[kind](), [Disc((20.0, 3.0), 1.0)], clearance=0.1)
    assert found.plan.waypoints == ()
    for text in (str(found), found._repr_html_()):
        assert f"clearance at least {found.clearance.lower:.6g}" in text
        assert "waypoint" not in text.split("<svg")[0]


def test_a_result_has_the_plan_and_its_clearance():
    plan, disc = cp.PolySpline(ACROSS), [Disc((10.0, 5.2), 2.0)]
    found = avoid(plan, disc, clearance=0.5)
    assert isinstance(found, cp.Avoidance)
    assert found.clearance.certified
    assert found.clearance.required == 0.5
    again = clearance(found.plan, disc, required=0.5)
    assert again == found.clearance
    assert "PolySpline" in repr(found)


@pytest.mark.parametrize(
    "use",
    [
        lambda p: p(3.0).tolist(),
        lambda p: p.jet([1.0, 2.0], 2).tolist(),
        lambda p: p.to_dict(),
        lambda p: (2.0 * p + p - p / 4.0)(3.0).tolist(),
        lambda p: (-p)(3.0).tolist(),
        lambda p: cp.margins(p, {"velocity": 9.0}).active.value,
        lambda p: cp.fastest(p, {"velocity": 9.0}, hold="waypoints", durations=(8.0, 32.0)).duration,
        lambda p: clearance(p, [Disc((10.0, 0.0), 1.0)]).minimum,
        lambda p: avoid(p, [Disc((10.0, 0.0), 1.0)]).plan.to_dict(),
        lambda p: p.then(cp.Step([20.0, 5.0], [20.0, 5.0])).end,
        lambda p: cp.Retimed(p, cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(8, 16)])).end,
    ],
)
def test_a_result_used_as_a_plan_is_that_plan_with_a_notice(use):
    found = avoid(cp.PolySpline(ACROSS), [Disc((10.0, 0.0), 1.0)])
    expected = use(found.plan)
    with pytest.warns(FutureWarning, match=r"avoid\(...\) used as a plan is deprecated .* use avoid\(...\).plan"):
        assert use(found) == expected


def test_a_result_says_nothing_where_it_is_used_as_one():
    found = avoid(cp.PolySpline(ACROSS), [Disc((10.0, 0.0), 1.0)])
    for again in (copy.copy(found), copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert again.plan.to_dict() == found.plan.to_dict()
        assert again.clearance == found.clearance
    assert repr(found)
    with pytest.raises(AttributeError, match="an Avoidance has the attributes plan and clearance, got 'way'"):
        found.way  # noqa: B018


@pytest.mark.parametrize(
    "error", [RuntimeError("Maximum number of iterations reached."), np.linalg.LinAlgError("singular")]
)
def test_least_squares_that_fail_are_solved_otherwise(monkeypatch, error):
    """Some releases of scipy solve normal equations, and do not end or meet a singular matrix: the plan is the same."""
    obstacles, crane = [Disc((10.0, 5.0), 1.0)], Crane()
    move = cp.PolySpline([cp.Waypoint(0, [0, 10], 0, 0, 0, 0), cp.Waypoint(16, [20, 11], 0, 0, 0, 0)])
    expected = avoid(move, obstacles, clearance=0.2, rope=crane.rope()).plan

    def failing(matrix, right, maxiter):
        raise error

    monkeypatch.setattr(inequalities, "nnls", failing)
    found = avoid(move, obstacles, clearance=0.2, rope=crane.rope()).plan
    assert [point.time for point in found.waypoints] == pytest.approx([point.time for point in expected.waypoints])
    times = np.linspace(0.0, 16.0, 101)
    np.testing.assert_allclose(found(times), expected(times), rtol=0, atol=1e-5)
