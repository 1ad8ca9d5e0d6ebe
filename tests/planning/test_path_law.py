"""Fastest time law on a path: against closed forms, and linear programs on a fine grid."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples, one_in
from scipy.optimize import linprog
from scipy.sparse import coo_array

import ctrlplan as cp
from ctrlplan import PiecewiseSpline, PolySpline, TrigSpline, Waypoint, fastest
from ctrlplan.trajectories import Retimed, TimeLaw

COUNT = 40_001


def random_path(count, naxes, seed):
    """Minimum-jerk spline from rest to rest through random points."""
    points = np.random.default_rng(seed).normal(size=(naxes, count))
    times = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points), axis=0)))
    rest = np.full(count, np.nan)
    rest[[0, -1]] = 0.0
    return PiecewiseSpline.from_arrays(times, points, derivatives={1: rest, 2: rest}, warn=False)


def line(count):
    """Straight line from 0 to 1 through equally spaced waypoints."""
    rest = np.full(count, np.nan)
    rest[[0, -1]] = 0.0
    places = np.linspace(0.0, 1.0, count)
    return PiecewiseSpline.from_arrays(places, places, derivatives={1: rest, 2: rest})


def optimum(plan, velocity, acceleration, count=600):
    """Duration by linear programs: b is piecewise linear, and limits hold at the middle of each interval.

    At points of rest the grid is fine. Each program minimises the duration that is
    linearised at the last solution, within a factor of 2 of it.
    """
    u = np.linspace(0.0, 1.0, count + 1)
    s = plan.start + plan.duration * (u**3 * (10 - 15 * u + 6 * u**2))
    h, (first, second) = np.diff(s), plan.jet(0.5 * (s[1:] + s[:-1]), 2)[1:]
    rows = []
    for slope, curvature in zip(first, second, strict=True):
        pair = np.stack([0.5 * curvature - 0.5 * slope / h, 0.5 * curvature + 0.5 * slope / h]) / acceleration
        rows += [pair, -pair, 0.5 * np.stack([slope**2, slope**2]) / velocity**2]
    k = np.arange(count)
    values = np.concatenate([pair.ravel() for pair in rows])
    place = np.concatenate([np.tile(k + j * count, 2) for j in range(len(rows))])
    column = np.tile(np.concatenate([k, k + 1]), len(rows))
    matrix = coo_array((values, (place, column)), shape=(len(rows) * count, count + 1)).tocsr()
    b = np.full(count + 1, 1.0 / max(float((matrix @ np.ones(count + 1)).max()), 1e-9))
    last = math.inf
    for _ in range(60):
        middle = 0.5 * (b[1:] + b[:-1])
        weights = np.zeros(count + 1)
        weights[:-1] -= 0.25 * h * middle**-1.5
        weights[1:] -= 0.25 * h * middle**-1.5
        found = linprog(weights * b, matrix * b[None, :], np.ones(matrix.shape[0]), bounds=(0.5, 2.0), method="highs")
        b = b * found.x
        duration = float((2.0 * h / (np.sqrt(b[1:]) + np.sqrt(b[:-1]))).sum())
        if duration > last * (1.0 - 1e-5):
            return duration
        last = duration
    raise AssertionError("the programs do not converge")


def check_limits(plan, limits):
    """Velocities and accelerations at many times."""
    jet = np.abs(plan.jet(np.linspace(plan.start, plan.end, COUNT), 2)).max(axis=(1, 2))
    for order, name in ((1, "velocity"), (2, "acceleration")):
        if name in limits:
            assert jet[order] <= limits[name] * (1 + 1e-11)


LIMITS = {"velocity": 2.0, "acceleration": 4.0}


@pytest.mark.parametrize(("count", "naxes"), [(3, 2), (6, 3), pytest.param(12, 7, marks=pytest.mark.slow)])
def test_the_duration_is_the_minimum(count, naxes):
    plan = random_path(count, naxes, 1)
    found = fastest(plan, LIMITS, hold="path")
    best = optimum(plan, 2.0, 4.0)
    assert 0.997 * best <= found.duration <= 1.004 * best  # the grid of the program is not exact either
    check_limits(found.plan, LIMITS)
    assert found.active.fraction == pytest.approx(0.0, abs=1e-9)
    assert found.margins.satisfied


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("count", "naxes"), [(2, 2), (20, 2), (50, 3)])
def test_limits_are_satisfied_on_random_paths(count, naxes, seed):
    plan = random_path(count, naxes, seed)
    found = fastest(plan, LIMITS, hold="path")
    check_limits(found.plan, LIMITS)
    assert found.duration < 0.9 * fastest(plan, LIMITS).duration
    assert found.active.fraction == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("count", one_in(2, [2, 3, 5, 10, 25, 50]))
def test_waypoints_on_a_straight_line_do_not_matter(count):
    found = fastest(line(count), {"y_d1": 10.0, "y_d2": 1.0}, hold="path")
    assert 2.0 <= found.duration <= 2.0 * 1.003
    check_limits(found.plan, {"velocity": 10.0, "acceleration": 1.0})


def test_the_path_is_the_same_and_the_law_is_smooth():
    plan = random_path(5, 2, 3)
    found = fastest(plan, LIMITS, hold="path").plan
    assert isinstance(found, Retimed)
    assert isinstance(found.law, TimeLaw)
    passed = found.law(np.linspace(found.start, found.end, 2001))
    assert (np.diff(passed) > 0.0).all()
    np.testing.assert_allclose(found(np.linspace(found.start, found.end, 2001)), plan(passed), atol=1e-12)
    inner = found.law.breakpoints[1:-1]
    right, left = found.law.jet(inner, 3)[:, 0], found.law.jet(inner, 3, left=True)[:, 0]
    rounding = 2 * np.spacing(found.end) * (np.abs(right) + np.abs(left))[1:]  # of the breakpoints
    assert (np.abs(right - left)[:3] <= rounding + 1e-13 * np.abs(right[:3]).max(axis=1, keepdims=True)).all()
    assert found.jumps(2) == ()


def test_different_limits_by_axis_and_by_sign():
    plan = random_path(5, 2, 4)
    limits = {"y1_d1": 1.0, "y2_d1": (-3.0, 0.5), "y1_d2": (-1.0, 6.0), "y2_d2": (None, 2.0)}
    found = fastest(plan, limits, hold="path")
    jet = found.plan.jet(np.linspace(found.plan.start, found.plan.end, COUNT), 2)
    high = np.array([[1.0, 0.5], [6.0, 2.0]])
    low = np.array([[-1.0, -3.0], [-1.0, -np.inf]])
    assert (jet[1:].max(axis=2) <= high * (1 + 1e-11)).all()
    assert (jet[1:].min(axis=2) >= low * (1 + 1e-11)).all()
    # Exchanging the signs of an axis and of its limits changes nothing.
    mirrored = cp.stack([plan.select("y1"), -1.0 * plan.select("y2")])
    other = fastest(mirrored, limits | {"y2_d1": (-0.5, 3.0), "y2_d2": (-2.0, None)}, hold="path")
    assert other.duration == pytest.approx(found.duration, rel=1e-6)


@pytest.mark.parametrize("side", ["low", "high"])
def test_accelerations_limited_on_one_side(side):
    """Not slower than with a limit on the other side as well."""
    waypoints = [Waypoint(0, [0, 0], 0, 0), Waypoint(1, [1, 2]), Waypoint(2, [3, -1]), Waypoint(3, [4, 0], 0, 0)]
    plan, sign = PolySpline(waypoints), 1.0 if side == "high" else -1.0
    limits = {"y1_d1": 1.0, "y2_d2": cp.Limits(**{side: sign * 2.0})}
    found = fastest(plan, limits, hold="path")
    jet = found.plan.jet(np.linspace(found.plan.start, found.plan.end, COUNT), 2)
    assert np.abs(jet[1, 0]).max() <= 1.0 + 1e-11
    assert (sign * jet[2, 1]).max() <= 2.0 * (1.0 + 1e-11)
    both = fastest(plan, limits | {"y2_d2": tuple(sorted((sign * 2.0, -sign * 40.0)))}, hold="path")
    assert found.duration <= both.duration * 1.003


def test_one_direction_without_velocity():
    """A limit of 0 on the side to which the plan does not move."""
    plan = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 10, 0, 0)])
    found = fastest(plan, {"y_d1": (0.0, 1.0), "y_d2": 0.5}, hold="path")
    assert 12.0 <= found.duration <= 12.0 * 1.004
    back = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 10, 0, 0), Waypoint(3, 5, 0, 0)])
    with pytest.raises(ValueError, match="limits must be satisfied for some duration, got y_d1 of both signs"):
        fastest(back, {"y_d1": (0.0, 1.0), "y_d2": 0.5}, hold="path")


# Stops, corners and dwells

REST = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]
MOVE, MOVE_ON = PolySpline(REST), PolySpline([Waypoint(0, 1, 0, 0), Waypoint(1, 2, 0, 0)])


@pytest.mark.slow
def test_a_dwell_keeps_its_duration():
    plan = MOVE.then(PolySpline([Waypoint(0, 1, 0, 0), Waypoint(2.5, 1, 0, 0)])).then(MOVE_ON)
    found = fastest(plan, {"velocity": 10.0, "acceleration": 1.0}, hold="path")
    assert 6.5 <= found.duration <= 6.5 * 1.003
    still = [t for t in np.linspace(found.plan.start, found.plan.end, 1001) if not found.plan(t, 1)]
    assert max(still[1:-1]) - min(still[1:-1]) == pytest.approx(2.5, abs=0.02)
    assert found.stops == ()


@pytest.mark.parametrize("kind", ["joined", "waypoint", "piecewise"])
def test_a_stop_inside_remains(kind):
    points = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0), Waypoint(2, 2, 0, 0)]
    plan = {
        "joined": MOVE.then(PolySpline([points[1], points[2]])),
        "waypoint": PolySpline(points),
        "piecewise": PiecewiseSpline(points),
    }[kind]
    found = fastest(plan, {"velocity": 10.0, "acceleration": 1.0}, hold="path")
    assert 4.0 <= found.duration <= 4.0 * 1.003
    check_limits(found.plan, {"velocity": 10.0, "acceleration": 1.0})
    middle = found.plan.law.moments(np.array([1.0]))[0]
    assert abs(found.plan(middle, 1)) < 1e-9
    assert found.stops == ()


def test_the_plan_stops_at_corners_of_the_path_and_says_so():
    """From the full speed to a stop, from stop to stop, and to the full speed: sqrt(2) + 2 + sqrt(2)."""
    plan = PiecewiseSpline([Waypoint(0, [0, 0]), Waypoint(1, [1, 0]), Waypoint(2, [1, 1]), Waypoint(3, [0, 1])])
    found = fastest(plan, {"velocity": 10.0, "acceleration": 1.0}, hold="path")
    best = 2.0 + 2.0 * math.sqrt(2.0)
    assert best <= found.duration <= 1.003 * best
    assert found.stops == (1.0, 2.0)
    assert "stops at corners of the path at 1 s of the given plan, at 2 s of the given plan" in " ".join(
        str(found).split()
    )
    check_limits(found.plan, {"velocity": 10.0, "acceleration": 1.0})
    assert {jump.time for jump in found.plan.jumps(1)} <= {found.plan.start, found.plan.end}


@pytest.mark.parametrize("start", [0.0, 2.5, -1e4])
@pytest.mark.parametrize("entries", [(0,), (0, 0), (0, 0, 0)])
@pytest.mark.parametrize("limits", [{}, {"jerk": 1e3}, {"both": 1e3}])
def test_corners_at_rest_are_stops(start, entries, limits):
    """To the right, up after a dwell, on in the same direction, to the right, and down."""
    places = [[0, 0], [1, 0], [1, 0], [1, 1], [1, 2], [2, 2], [2, 1]]
    plan = PiecewiseSpline([Waypoint(start + k, place, *entries) for k, place in enumerate(places)])
    system = (lambda jet: {"both": jet[1, 0] + jet[2, 1]}) if "both" in limits else None
    found = fastest(plan, {"velocity": 10.0, "acceleration": 1.0} | limits, system, hold="path")
    assert found.stops == (start + 1.0, start + 2.0, start + 4.0, start + 5.0)


@pytest.mark.parametrize("jerk", [{}, {"jerk": 1e3}])
def test_a_stop_on_a_smooth_path_is_no_corner(jerk):
    """A curve with a stop inside, and lines that meet with an angle of 1e-3 rad."""
    curve = PolySpline([Waypoint(0, [0, 0], [1, 0]), Waypoint(2, [1, 1], [0, 1])])
    law = PiecewiseSpline([Waypoint(0, 0, 0, 0), Waypoint(1, 0.7, 0, 0), Waypoint(3, 2, 0, 0)])
    plan = Retimed(curve, law)
    assert fastest(plan, {"acceleration": 1.0} | jerk, hold="path").stops == ()
    turned = cp.PolySpline([Waypoint(1, [0, 0], 0, 0), Waypoint(3, [1e-3, 1], 0, 0)])
    straight = cp.PolySpline([Waypoint(0, [0, -1], 0, 0), Waypoint(1, [0, 0], 0, 0)])
    assert fastest(straight.then(turned), {"acceleration": 1.0} | jerk, hold="path").stops == (1.0,)


@pytest.mark.parametrize("start", [0.0, 2.5])
@pytest.mark.parametrize("limits", [{}, {"jerk": 1e3}, {"both": 1e3}])
def test_a_cyclic_polygon_stops_at_its_first_corner_too(start, limits):
    """A square from stop to stop, four times 2 sqrt(1 / 1); the ends of a plan that is not cyclic are free."""
    corners = [Waypoint(start + k, corner) for k, corner in enumerate([[0, 0], [1, 0], [1, 1], [0, 1]])]
    plan = PiecewiseSpline.cyclic(corners, 4.0)
    system = (lambda jet: {"both": jet[1, 0] + jet[2, 1]}) if "both" in limits else None
    found = fastest(plan, {"velocity": 10.0, "acceleration": 1.0} | limits, system, hold="path")
    assert 8.0 <= found.duration <= 8.05
    assert found.stops == tuple(start + np.arange(5.0))
    lap = found.plan.repeat(2)
    assert not lap.jumps(1)
    check_limits(lap, {"velocity": 10.0, "acceleration": 1.0})
    free = fastest(
        PiecewiseSpline([*corners, Waypoint(start + 4, [0, 0])]), {"velocity": 10.0, "acceleration": 1.0}, hold="path"
    )
    assert free.duration == pytest.approx(4.0 + 2.0 * math.sqrt(2.0), rel=3e-3)
    assert free.stops == tuple(start + np.arange(1.0, 4.0))


def test_a_corner_is_passed_if_accelerations_are_not_limited():
    plan = PiecewiseSpline([Waypoint(0, [0, 0]), Waypoint(1, [3, 0]), Waypoint(2, [3, 4])])
    found = fastest(plan, {"velocity": 2.0}, hold="path")
    assert found.duration == pytest.approx(3.5, rel=0.02)
    assert found.stops == ()


def test_a_change_of_the_plans_speed_on_a_straight_line_is_no_corner():
    plan = PiecewiseSpline([Waypoint(0, [0, 0]), Waypoint(1, [1, 1]), Waypoint(5, [2, 2]), Waypoint(6, [4, 4])])
    found = fastest(plan, {"velocity": 10.0, "acceleration": 1.0}, hold="path")
    assert found.duration == pytest.approx(0.4, rel=1e-3)
    assert found.stops == ()
    assert {jump.time for jump in found.plan.jumps(1)} <= {found.plan.start, found.plan.end}


@pytest.mark.parametrize("count", [3, pytest.param(10, marks=pytest.mark.slow)])
def test_the_speed_of_the_plan_on_its_path_does_not_matter(count):
    """A straight line through uneven waypoints with any velocities, where accelerations of the plan jump."""
    rng = np.random.default_rng(count)
    places = np.concatenate([[0.0], np.sort(rng.uniform(0, 1, count - 2)), [1.0]])
    velocities = np.concatenate([[0.0], rng.uniform(0.2, 0.6, count - 2), [0.0]])
    plan = PiecewiseSpline.from_arrays(3.0 * places, places, derivatives={1: velocities})
    found = fastest(plan, {"y_d1": 10.0, "y_d2": 1.0}, hold="path")
    assert 2.0 <= found.duration <= 2.0 * 1.003
    assert {jump.time for jump in found.plan.jumps(2)} <= {found.plan.start, found.plan.end}


def test_a_plan_that_jumps_is_rejected():
    plan = MOVE.then(cp.Step(3.0, 1.0)).then(PolySpline([Waypoint(0, 3, 0, 0), Waypoint(1, 4, 0, 0)]))
    with pytest.raises(ValueError, match="plan must be continuous, got y that jumps by 2 at 1 s"):
        fastest(plan, {"velocity": 1.0}, hold="path")


def test_limits_that_do_not_bound_the_speed_are_rejected():
    plan = PolySpline([Waypoint(0, 0, 1.0), Waypoint(1, 1, 1.0)])
    with pytest.raises(ValueError, match="limits must bound the speed along the whole path"):
        fastest(plan, {"acceleration": 1.0}, hold="path")


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"y": (-1.0, 2.0)}, "limits must include one that a shorter plan would violate, got none"),
        ({"y_d1": cp.Limits(-1.0, 1.0, during=(0.3, 0.4))}, "limits must bound the speed along the whole path"),
        ({"y_d1": 1.0, "y_d2": (0.0, 1.0)}, 'limits of y_d2 must allow both signs with hold="path", got from 0 to 1'),
        (
            {"y_d1": cp.Limits(-1.0, lambda t: np.where(t < 0.5, 1.0, -0.5))},
            "limits of y_d1 must include 0, the value at rest, got from -1 to -0.5",
        ),
        ({"velocity": 0.0}, "limits of velocity must be finite and above 0"),
        ({"acceleration": np.nan}, "limits of acceleration must be finite and above 0"),
        ({"y_d1": (2.0, -2.0)}, "limits of y_d1 must increase, got 2 and -2"),
    ],
)
def test_limits_that_are_rejected(limits, message):
    with pytest.raises(ValueError, match=message):
        fastest(MOVE, limits, hold="path")


@pytest.mark.parametrize("size", [1e-9, 1e12])
def test_extreme_limits(size):
    found = fastest(MOVE, {"velocity": 10.0 * size, "acceleration": 100.0 * size**2}, hold="path")
    assert 0.2 / size <= found.duration <= 0.2 / size * 1.003


# Closed paths and start times

CYCLE = TrigSpline.cyclic([Waypoint(0, [0, 0]), Waypoint(1, [3, 0]), Waypoint(2, [1, 2])], 3.0)


def begun_later(plan, delay):
    """Closed plan that begins at another of its points."""
    return cp.Clipped(plan.then(plan), plan.start + delay, plan.end + delay)


def test_the_acceleration_is_continuous_over_the_end_of_a_closed_path():
    """Also where that of the plan is not: it begins and ends with another change of its speed."""
    plan = Retimed(CYCLE, PolySpline([Waypoint(0, 0, 2.0), Waypoint(2, 3, 2.0)]))
    assert np.abs(plan.jet(plan.start, 2) - plan.jet(plan.end, 2, left=True))[2].max() > 0.1
    found = fastest(plan, LIMITS, hold="path")
    first, last = found.plan.jet(found.plan.start, 2), found.plan.jet(found.plan.end, 2, left=True)
    np.testing.assert_allclose(first, last, rtol=0, atol=1e-10)
    assert found.duration == pytest.approx(fastest(CYCLE, LIMITS, hold="path").duration, rel=0.004)


def test_the_start_of_a_closed_path_does_not_matter():
    found = [fastest(plan, LIMITS, hold="path") for plan in (CYCLE, begun_later(CYCLE, 0.7), begun_later(CYCLE, 2.1))]
    durations = [one.duration for one in found]
    assert max(durations) <= 1.004 * min(durations)
    # Twice around with the same speed at the end and the start.
    twice = fastest(CYCLE.then(CYCLE), LIMITS, hold="path").duration
    assert twice == pytest.approx(2.0 * durations[0], rel=0.004)


@pytest.mark.parametrize("start", [1e5, 1.7e9])
def test_the_start_time_does_not_matter(start):
    plan = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(3, 1, 0, 0)])
    limits = {"velocity": 1.0, "acceleration": 1.0}
    found, early = (fastest(one, limits, hold="path") for one in (plan.shift(start), plan))
    assert found.duration == pytest.approx(early.duration, abs=8 * np.spacing(start))
    assert found.plan.start == start
    assert found.margins.satisfied


def test_nanoseconds():
    plan = line(4).retime(1e-9)
    found = fastest(plan, {"velocity": 1e9, "acceleration": 4e18}, hold="path")
    assert 1.25e-9 <= found.duration <= 1.25e-9 * 1.003


@pytest.mark.slow
@examples(8)
@given(size=st.floats(1e-6, 1e6), duration=st.floats(1e-6, 1e6))
def test_units_do_not_matter(size, duration):
    plan = (size * random_path(4, 2, 5)).retime(duration)
    found = fastest(plan, {"velocity": size * 2.0, "acceleration": size * 4.0}, hold="path")
    expected = fastest(random_path(4, 2, 5), LIMITS, hold="path").duration
    assert found.duration == pytest.approx(expected, rel=1e-6)


def test_an_interval_of_durations():
    plan = random_path(4, 2, 5)
    shortest = fastest(plan, LIMITS, hold="path").duration
    longer = fastest(plan, LIMITS, hold="path", durations=(2.0 * shortest, 9.0 * shortest))
    assert longer.duration == pytest.approx(2.0 * shortest, rel=1e-12)
    with pytest.raises(ValueError, match=r"limits must be satisfied for some duration from .* got a minimum of"):
        fastest(plan, LIMITS, hold="path", durations=(0.1, 0.9 * shortest))


def test_positions_that_violate_their_limits_are_rejected():
    with pytest.raises(ValueError, match="limits must be satisfied at rest"):
        fastest(MOVE, {"y": (0.0, 0.9), "velocity": 1.0}, hold="path")


# Limits that depend on the position

TEN = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(10, 10, 0, 0)])


@pytest.mark.parametrize("start", [0.0, 100.0])
def test_a_limit_in_a_part_of_the_path(start):
    """To 2 m/s in 2 s, on for 0.75 s, down to 1 m/s in the middle at 5 m in 1 s, on for 4.5 s, and to rest in 1 s."""
    slow = cp.Limits(-1.0, 1.0, during=(start + 5.0, start + 10.0))
    found = fastest(TEN.shift(start), {"y_d1": [cp.Limits(-2.0, 2.0), slow], "y_d2": 1.0}, hold="path")
    assert 9.25 <= found.duration <= 9.25 * 1.003
    t = np.linspace(found.plan.start, found.plan.end, COUNT)
    position, velocity, acceleration = found.plan.jet(t, 2)[:, 0]
    assert velocity[position > 5.0 + 1e-9].max() <= 1.0 + 1e-10
    assert velocity.max() <= 2.0 + 1e-10
    assert np.abs(acceleration).max() <= 1.0 + 1e-10
    assert found.margins.satisfied
    assert found.margins.active.fraction == pytest.approx(0.0, abs=1e-9)


def test_an_acceleration_that_is_limited_in_a_part_only():
    """To 2 m/s in 2 s with 1 m/s^2, on for 2 s, and in 4 s to rest with 0.5 m/s^2, the limit in the second half."""
    limits = {"y_d1": 2.0, "y_d2": [cp.Limits(-1.0, 1.0), cp.Limits(-0.5, 0.5, during=(5.0, 10.0))]}
    found = fastest(TEN, limits, hold="path")
    assert 8.0 <= found.duration <= 8.0 * 1.003
    position, _, acceleration = found.plan.jet(np.linspace(found.plan.start, found.plan.end, COUNT), 2)[:, 0]
    assert np.abs(acceleration[position > 5.0 + 1e-9]).max() <= 0.5 * (1 + 1e-10)
    assert np.abs(acceleration).max() <= 1.0 + 1e-10


def by_table(times):
    return np.interp(times, [0.0, 4.0, 10.0], [2.0, 0.5, 1.5])


@pytest.mark.parametrize("kind", ["along", "function"])
def test_a_limit_that_changes_along_the_path(kind):
    limit = {
        "along": cp.Limits(high=[2.0, 0.5, 1.5], along=[0.0, 4.0, 10.0]),
        "function": cp.Limits(high=by_table),
    }[kind]
    found = fastest(TEN, {"y_d1": limit, "y_d2": 0.4}, hold="path")
    t = np.linspace(found.plan.start, found.plan.end, COUNT)
    moment, velocity = found.plan.law(t), found.plan(t, 1)
    assert (velocity <= by_table(moment) + 1e-9).all()
    assert np.abs(found.plan(t, 2)).max() <= 0.4 * (1 + 1e-10)
    assert found.margins.satisfied
    # Slower than with the largest limit, faster than with the smallest.
    durations = [fastest(TEN, {"y_d1": v, "y_d2": 0.4}, hold="path").duration for v in (2.0, 0.5)]
    assert durations[0] < found.duration < durations[1]
    # Of the limits over the plan that it plots: the same.
    bound = next(row.bound for row in found.margins if row.bound.name == "y_d1")
    high = found.limited.sides(bound, found.plan, t)[1]
    np.testing.assert_allclose(high, by_table(moment), rtol=1e-12)


def test_accelerations_that_depend_on_the_position():
    """An arm that may accelerate less the further it is out: v^2/2 is the integral of 1 - 0.08 x up to the middle."""
    limits = {"y_d2": cp.Limits(lambda t: -1.0 + 0.08 * TEN(t), lambda t: 1.0 - 0.08 * TEN(t))}
    found = fastest(TEN, limits, hold="path")
    # Speeding up to a position x and braking from there: the areas agree.
    area = 10.0 - 0.04 * 10.0**2
    turn = (1.0 - math.sqrt(1.0 - 0.08 * area)) / 0.08
    u = (np.arange(200_000) + 0.5) / 200_000
    up = turn * u**2
    down = 10.0 - (10.0 - turn) * u**2
    best = (2 * turn * u / np.sqrt(2 * up - 0.08 * up**2)).mean()
    rest = 2.0 * (10.0 - down) - 0.08 * (100.0 - down**2)
    best += (2 * (10.0 - turn) * u / np.sqrt(rest)).mean()
    assert best <= found.duration * (1 + 1e-6)
    assert found.duration <= 1.004 * best


# Speeds at the ends

MOVING = PolySpline([Waypoint(0, 0, 1, 0), Waypoint(3, 3, 1, 0)])


@pytest.mark.parametrize(("velocity", "best"), [(2.0, 2.0), (1.0, 3.0), (1.2, None)])
def test_given_speeds_at_the_ends(velocity, best):
    """From 1 m/s over 3 m to 1 m/s: 1 s to 2 m/s and 1 s back; at a limit of 1 m/s without acceleration."""
    found = fastest(MOVING, {"velocity": velocity, "acceleration": 1.0}, hold="path", ends="given")
    if best is None:  # 0.2 s up and down, and 3 - 2*0.22 m at 1.2 m/s
        best = 0.4 + (3.0 - 0.44) / 1.2
    assert best * (1 - 1e-9) <= found.duration <= best * 1.003
    speeds = [found.plan.jet(t, 1, left=left)[1, 0] for t, left in ((found.plan.start, False), (found.plan.end, True))]
    assert speeds == pytest.approx([1.0, 1.0], rel=1e-14)
    check_limits(found.plan, {"velocity": velocity, "acceleration": 1.0})
    assert found.feasible == ((found.duration, found.duration),)


def test_given_speeds_on_a_path_in_space():
    velocities = np.full((2, 4), np.nan)
    velocities[:, 0], velocities[:, -1] = [0.5, 0.3], [0.2, -0.4]
    points = np.random.default_rng(3).normal(size=(2, 4))
    plan = PiecewiseSpline.from_arrays([0.0, 1.0, 2.5, 4.0], points, derivatives={1: velocities})
    limits = {"velocity": 2.0, "acceleration": 40.0}
    given, free = (fastest(plan, limits, hold="path", ends=ends) for ends in ("given", "free"))
    np.testing.assert_allclose(given.plan.jet(given.plan.start, 1)[1], [0.5, 0.3], rtol=1e-13)
    np.testing.assert_allclose(given.plan.jet(given.plan.end, 1, left=True)[1], [0.2, -0.4], rtol=1e-13)
    check_limits(given.plan, limits)
    assert given.margins.satisfied
    assert free.duration < given.duration < free.duration + 0.5  # less than the time for the change of speed


@pytest.mark.parametrize(
    ("plan", "limits", "message"),
    [
        (MOVING, {"velocity": 0.9, "acceleration": 1.0}, r"with the speeds at the ends, got y_d1 = 1 at 0 s"),
        (
            PolySpline([Waypoint(0, 0, 3, 0), Waypoint(3, 3, 0, 0)]),  # 3^2/2/1.4 is more than 3 m
            {"acceleration": 1.4},
            r"the speed at the start must be feasible .* got 1 times that of the plan, where at most 0\.9[56]",
        ),
        (
            PolySpline([Waypoint(0, 0, 0, 0), Waypoint(3, 3, 3, 0)]),
            {"acceleration": 1.4},
            "the speed at the end must be feasible within the limits",
        ),
    ],
)
def test_speeds_that_are_infeasible(plan, limits, message):
    with pytest.raises(ValueError, match=message):
        fastest(plan, limits, hold="path", ends="given")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ends": "fixed"}, "ends must be one of free, given, got 'fixed'"),
        ({"ends": "given", "hold": "shape"}, 'ends must be "free" unless hold is "path"'),
        ({"ends": "given", "durations": (1.0, 9.0)}, 'durations must not be given with ends="given"'),
        ({"ends": "given", "limits": {"y_d1": 2.0, "y_d6": 1.0}}, 'ends must be "free" with limits that depend on'),
    ],
)
def test_ends_that_do_not_apply(options, message):
    with pytest.raises(ValueError, match=message):
        fastest(MOVING, **({"limits": LIMITS, "hold": "path"} | options))


def test_a_path_with_stops_between_its_segments():
    """A vehicle that turns back: each segment has its own law from rest to rest."""
    there = PolySpline([Waypoint(0, [0, 0], [1, 0]), Waypoint(4, [4, 0], [1, 0])])
    back = PolySpline([Waypoint(0, [4, 0], [-1, 0]), Waypoint(1, [3, 0], [-1, 0])])
    law = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(9, 4, 0, 0)])
    other = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(9, 1, 0, 0)])
    plan = cp.PathPlan([there, back], [1, -1], [law, other])
    found = fastest(plan, {"x_d1": 10.0, "x_d2": 1.0}, hold="path")
    assert isinstance(found.plan, cp.PathPlan)
    assert 6.0 <= found.duration <= 6.0 * 1.003
    assert found.plan.stops[1] - found.plan.stops[0] == pytest.approx(4.0, rel=0.003)
    assert found.margins.satisfied


# Accelerations of one sign

LAUNCH = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 1, 0)])
FASTER = PolySpline([Waypoint(0, 0, 0.5, 0), Waypoint(1, 1, 1, 0)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plan", "limits", "ends", "best"),
    [
        (LAUNCH, {"y_d1": 2.0, "y_d2": (0.0, 1.0)}, "free", math.sqrt(2.0)),  # 1 = T^2/2
        (LAUNCH, {"y_d1": 2.0, "y_d2": (0.0, 1.0)}, "given", 1.5),  # to 1 m/s in 1 s over 0.5 m, and on
        (FASTER, {"y_d1": 2.0, "y_d2": (0.0, 1.0)}, "given", 1.125),  # to 1 m/s in 0.5 s over 0.375 m, and on
        (FASTER, {"y_d1": 2.0, "y_d2": (-1.0, 0.0), "y_d3": 10.0}, "free", 0.5),  # 2 m/s all the way
    ],
)
def test_accelerations_of_one_sign(plan, limits, ends, best):
    found = fastest(plan, limits, hold="path", ends=ends)
    assert best * (1 - 1e-9) <= found.duration <= 1.002 * best
    assert found.margins.satisfied
    acceleration = found.plan(np.linspace(found.plan.start, found.plan.end, COUNT), 2)
    low, high = limits["y_d2"]
    assert low - 1e-12 <= acceleration.min() <= acceleration.max() <= high + 1e-12
    if ends == "given":
        assert found.plan.jet(found.plan.end, 1, left=True)[1, 0] == pytest.approx(1.0, rel=1e-13)


@pytest.mark.parametrize(
    ("plan", "limit", "ends", "message"),
    [
        (MOVE, (0.0, 1.0), "free", "since y is at rest at 1 s"),
        (MOVE, (-1.0, 0.0), "free", "since y is at rest at 0 s"),
        (LAUNCH, (-1.0, 0.0), "free", "since y is at rest at 0 s"),
        (FASTER, (-1.0, 0.0), "given", "since y changes its speed from the start to the end"),
    ],
)
def test_a_sign_of_the_acceleration_that_every_law_has(plan, limit, ends, message):
    with pytest.raises(ValueError, match=f'limits of y_d2 must allow both signs with hold="path".*{message}'):
        fastest(plan, {"y_d1": 2.0, "y_d2": limit}, hold="path", ends=ends)


@pytest.mark.slow
def test_axes_with_times_that_differ_by_rounding():
    """Segments between such times are no part of the path, wherever the plan starts."""
    one = random_path(4, 1, 5)
    best = fastest(one, LIMITS, hold="path").duration
    for start in (0.0, 1e5):
        first = one.shift(start)
        second = first.shift(4 * np.spacing(start + 1.0))
        plan = cp.stack([cp.Clipped(own, second.start, first.end) for own in (first, second)], labels=["a", "b"])
        assert np.diff(plan.breakpoints).min() < 1e-9
        assert fastest(plan, LIMITS, hold="path").duration == pytest.approx(best, rel=1e-4)
