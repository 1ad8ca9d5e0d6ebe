"""Fastest time law on a path with limited jerk: against Ruckig on lines, and a nonlinear program on a fine grid."""

import numpy as np
import pytest
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan import PiecewiseSpline, PolySpline, TrigSpline, Waypoint, fastest
from ctrlplan.trajectories import Retimed

COUNT = 20_001


def move(order, start=0.0):
    """From 0 to 1, at rest at the ends up to a derivative."""
    rest = [0.0] * order
    return PolySpline([Waypoint.from_jets(start, y=[0.0, *rest]), Waypoint.from_jets(start + 1.0, y=[1.0, *rest])])


def random_path(count, naxes, seed):
    points = np.random.default_rng(seed).normal(size=(naxes, count))
    times = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points), axis=0)))
    rest = np.full(count, np.nan)
    rest[[0, -1]] = 0.0
    return PiecewiseSpline.from_arrays(times, points, derivatives={1: rest, 2: rest}, warn=False)


def limits_of(velocity, acceleration, jerk):
    return {"velocity": float(velocity), "acceleration": float(acceleration), "jerk": float(jerk)}


def check_limits(plan, limits):
    """Derivatives at many times."""
    jet = np.abs(plan.jet(np.linspace(plan.start, plan.end, COUNT), 3)).max(axis=(1, 2))
    for order, name in enumerate(("velocity", "acceleration", "jerk"), 1):
        if name in limits:
            assert jet[order] <= limits[name] * (1 + 1e-9)


@pytest.mark.parametrize("order", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("limits", [(1, 2, 10), (1, 1, 1), (10, 1, 100), (1, 10, 1000), (0.1, 1, 10)])
def test_straight_lines_are_those_of_ruckig(order, limits):
    """The profile of `SCurve` by the same algorithm has seven phases of constant jerk."""
    ruckig = pytest.importorskip("ruckig")
    given = ruckig.InputParameter(1)
    given.current_position, given.target_position = [0.0], [1.0]
    given.max_velocity, given.max_acceleration, given.max_jerk = ([float(limit)] for limit in limits)
    profile = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(given, profile)
    found = fastest(move(order), limits_of(*limits), hold="path")
    assert profile.duration * (1 - 1e-9) <= found.duration <= 1.0025 * profile.duration
    check_limits(found.plan, limits_of(*limits))
    assert found.active.fraction == pytest.approx(0.0, abs=1e-9)


def test_a_jerk_limit_alone_in_closed_form():
    """Four phases of length T/4 with jerk 1: the distance is T^3/32."""
    found = fastest(move(2), {"jerk": 1.0}, hold="path")
    assert 32 ** (1 / 3) <= found.duration <= 1.002 * 32 ** (1 / 3)


@pytest.mark.slow
def test_a_path_in_the_plane_is_that_of_a_nonlinear_program():
    """b at the nodes of a fine grid, derivatives by differences, limits at the nodes, by IPOPT.

    Near the ends b is linear: otherwise the program begins with an acceleration.
    """
    casadi = pytest.importorskip("casadi")
    plan, velocity, acceleration, jerk = random_path(3, 2, 1), 2.0, 4.0, 20.0
    count = 300
    s = np.linspace(plan.start, plan.end, count + 1)
    h = s[1] - s[0]
    first, second, third = plan.jet(s[1:-1], 3)[1:]
    b = casadi.MX.sym("b", count + 1)
    slope, bend = (b[2:] - b[:-2]) / (2 * h), (b[2:] - 2 * b[1:-1] + b[:-2]) / h**2
    rows, high = [], []
    for p1, p2, p3 in zip(first, second, third, strict=True):
        rows += [p1**2 * b[1:-1], p2 * b[1:-1] + 0.5 * p1 * slope]
        rows += [casadi.sqrt(b[1:-1]) * (p3 * b[1:-1] + 1.5 * p2 * slope + 0.5 * p1 * bend)]
        high += [velocity**2, acceleration, jerk]
    for middle in (1, 2, count - 2, count - 1):
        rows.append(b[middle - 1] - 2 * b[middle] + b[middle + 1])
    time = 2 * h * casadi.sum1(1 / (casadi.sqrt(b[1:]) + casadi.sqrt(b[:-1])))
    solver = casadi.nlpsol(
        "solver",
        "ipopt",
        {"x": b, "f": time, "g": casadi.vertcat(*rows)},
        {"ipopt.print_level": 0, "print_time": False},
    )
    upper = np.append(np.repeat(high, count - 1), np.zeros(4))
    solved = solver(x0=0.1, lbx=1e-4, lbg=-upper, ubg=upper)
    assert solver.stats()["success"]
    found = fastest(plan, limits_of(velocity, acceleration, jerk), hold="path")
    assert found.duration == pytest.approx(float(solved["f"]), rel=0.006)
    check_limits(found.plan, limits_of(velocity, acceleration, jerk))


@pytest.mark.parametrize(("count", "naxes"), [(4, 2), pytest.param(50, 3, marks=pytest.mark.slow)])
def test_limits_are_satisfied_on_random_paths(count, naxes):
    plan, limits = random_path(count, naxes, 2), limits_of(2, 4, 20)
    found = fastest(plan, limits, hold="path")
    check_limits(found.plan, limits)
    assert found.margins.satisfied
    assert found.duration < 0.95 * fastest(plan, limits).duration
    without = fastest(plan, {"velocity": 2.0, "acceleration": 4.0}, hold="path").duration
    assert without < found.duration < 1.2 * without
    assert isinstance(found.plan, Retimed)
    assert found.plan.jumps(2) == ()
    s = found.plan.law(np.linspace(found.plan.start, found.plan.end, 501))
    np.testing.assert_allclose(found.plan(np.linspace(found.plan.start, found.plan.end, 501)), plan(s), atol=1e-12)


@pytest.mark.slow
def test_different_limits_by_sign_and_position():
    limits = {"y_d2": (-1.0, 3.0), "y_d3": cp.Limits(low=[-20.0, -10.0], high=[20.0, 10.0], along=[0.0, 1.0])}
    found = fastest(move(2), limits, hold="path")
    t = np.linspace(found.plan.start, found.plan.end, COUNT)
    jerk, bound = found.plan(t, 3), 20.0 - 10.0 * found.plan.law(t)
    assert (np.abs(jerk) <= bound * (1 + 1e-9)).all()
    acceleration = found.plan(t, 2)
    assert acceleration.min() >= -1.0 - 1e-9
    assert acceleration.max() <= 3.0 + 1e-9
    assert found.margins.satisfied
    assert found.duration < fastest(move(2), {"y_d2": (-1.0, 3.0), "y_d3": 10.0}, hold="path").duration


def test_a_closed_path_stays_closed():
    cycle = TrigSpline.cyclic([Waypoint(0, [0, 0]), Waypoint(1, [3, 0]), Waypoint(2, [1, 2])], 3.0)
    found = fastest(cycle, limits_of(2, 3, 15), hold="path").plan
    first, last = found.jet(found.start, 3), found.jet(found.end, 3, left=True)
    scale = np.abs(found.jet(np.linspace(found.start, found.end, 101), 3)).max(axis=(1, 2))
    np.testing.assert_allclose(first / scale[:, None], last / scale[:, None], rtol=0, atol=1e-10)
    check_limits(found, limits_of(2, 3, 15))


@pytest.mark.parametrize("start", [1e5, -3e6, 1.7e9])
def test_the_start_time_does_not_matter(start):
    found, early = (fastest(move(2, own), limits_of(1, 2, 10), hold="path") for own in (start, 0.0))
    assert found.duration == pytest.approx(early.duration, rel=1e-8, abs=8 * np.spacing(abs(start)))
    assert found.margins.satisfied
    assert found.plan.start == start


@pytest.mark.slow
def test_stops_and_dwells_remain():
    dwell = PolySpline([Waypoint(0, 1, 0, 0), Waypoint(2.0, 1, 0, 0)])
    on = PolySpline([Waypoint(0, 1, 0, 0), Waypoint(1, 2, 0, 0)])
    limits = limits_of(10, 1, 100)
    single = fastest(move(2), limits, hold="path").duration
    assert fastest(move(2).then(dwell).then(on), limits, hold="path").duration == pytest.approx(
        2 * single + 2.0, rel=0.002
    )
    assert fastest(move(2).then(on), limits, hold="path").duration == pytest.approx(2 * single, rel=0.002)


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (
            cp.Trapezoid(1.0, velocity=1.0, acceleration=2.0),
            "limits of y_d3 require a plan that is continuous up to",
        ),
        (PolySpline([Waypoint(0, 0, 1, 0), Waypoint(1, 1, 1, 0)]), "limits must bound the speed along the whole path"),
    ],
)
def test_plans_and_limits_that_are_rejected(plan, message):
    with pytest.raises(ValueError, match=message):
        fastest(plan, {"jerk": 10.0}, hold="path")


@pytest.mark.parametrize(
    ("length", "duration", "limits"),
    [
        (0.34254, 97.46, (9.155, 2.35, 2.0)),
        (0.01298, 0.0314, (2.194, 1.9696, 1.7013)),
        (0.5022, 3.026, (9.777, 7.905, 0.83194)),
        (70.0, 1.0, (1.0, 1.0, 1.0)),
    ],
)
def test_a_straight_line_in_motion_is_passed_at_the_limit_of_the_velocity(length, duration, limits):
    """Whatever the limits of acceleration and jerk, of which the inequalities have terms of 1e10 that cancel.

    The duration is optimal up to the duality gap of 1e-3.
    """
    plan = PiecewiseSpline([Waypoint(0, [0, 0]), Waypoint(duration, [length, -0.3 * length])])
    found = fastest(plan, limits_of(*limits), hold="path")
    best = length / limits[0]
    assert best * (1.0 - 1e-9) <= found.duration <= 1.001 * best
    assert found.margins.satisfied


def test_speeds_that_jump_on_a_straight_line_are_made_equal():
    """Two metres at the limit of the velocity, and a rounded series of points; a corner and a dwell beside them."""
    limits = limits_of(1, 1, 2)
    line = PiecewiseSpline([Waypoint(0, 0), Waypoint(1, 1), Waypoint(3, 2)])
    assert 2.0 <= fastest(line, limits, hold="path").duration <= 2.002
    even = PiecewiseSpline([Waypoint(1e6 + 0.3 + 0.1 * k, k) for k in range(7)])
    assert 6.0 <= fastest(even, limits, hold="path").duration <= 6.006


def test_a_cyclic_polygon_that_closes_inside_a_side_remains_closed():
    """Four sides from stop to stop; the acceleration is continuous where the lap closes."""
    corners = [
        Waypoint(0, [0.5, 0]),
        *(Waypoint(k + 0.5, corner) for k, corner in enumerate([*CORNERS[1:], CORNERS[0]])),
    ]
    plan = PiecewiseSpline.cyclic(corners, 4.0)
    found = fastest(plan, limits_of(50, 1, 5), hold="path")
    best = 4 * one_metre(5.0)
    assert best * (1 - 1e-6) <= found.duration <= 1.01 * best
    assert found.stops == (0.5, 1.5, 2.5, 3.5)
    lap = found.plan.repeat(2)
    assert {jump.time for jump in lap.jumps(2) if jump.size > 1e-6} <= {lap.start, lap.end}


def one_metre(jerk):
    """Minimum time from rest to rest with an acceleration of at most 1 m/s^2."""
    if jerk**2 >= 2.0:
        return 1 / jerk + np.sqrt(1 / jerk**2 + 4.0)
    return 4.0 * (1 / (2 * jerk)) ** (1 / 3)


CORNERS = ([0, 0], [1, 0], [1, 1], [0, 1])


def polyline(*entries, dwell=0.0):
    """Three sides of a square, with the same entries at all waypoints, and a dwell after the first side."""
    points = [Waypoint(k + (dwell if k > 1 else 0.0), corner, *entries) for k, corner in enumerate(CORNERS)]
    if dwell:
        points.insert(2, Waypoint(1 + dwell, CORNERS[1], *entries))
    return PiecewiseSpline(points)


@pytest.mark.parametrize("jerk", [0.8, 5.0, 200.0])
@pytest.mark.parametrize("entries", [(0,), (0, 0), (0, 0, 0)])
@pytest.mark.parametrize("start", [0.0, -3.0, 1e9])
def test_from_stop_to_stop_whatever_the_time_law_of_the_plan_is_there(jerk, entries, start):
    """Its acceleration may jump at its stops, where another time law is at rest anyway."""
    plan = polyline(*entries, dwell=0.75).shift(start)
    found = fastest(plan, limits_of(50, 1, jerk), hold="path")
    best = 0.75 + 3 * one_metre(jerk)
    assert best * (1 - 1e-6) <= found.duration <= 1.01 * best
    check_limits(found.plan, limits_of(50, 1, jerk))
    assert found.margins.satisfied
    assert found.plan.start == start


@pytest.mark.parametrize("start", [0.0, 7.5])
@pytest.mark.parametrize(("kind", "ends"), [("derivatives", "free"), ("derivatives", "given"), ("quantities", "free")])
def test_the_plan_stops_at_corners_and_says_so(kind, start, ends):
    """With free ends from any speed, braked with -1 m/s^2 and at the end with the jerk; then from stop to stop.

    From the end of the side, with r = 1/j the time of that jerk: j r^3/6 + (r/2) x + x^2/2 = 1 m after r + x.
    """
    plan, jerk = polyline(dwell=0.75).shift(start), 5.0
    limits, system = limits_of(50, 1, jerk), None
    if kind == "quantities":
        limits = {"velocity": 50.0, "push": cp.Limits(-2.0, 2.0, rate=10.0), "pull": cp.Limits(-1.0, 1.0, rate=5.0)}
        system = lambda jet: {"push": 2.0 * jet[2, 0], "pull": jet[2, 1]}  # noqa: E731
    found = fastest(plan, limits, system, hold="path", ends=ends)
    r = 1.0 / jerk
    x = -r / 2 + np.sqrt(r**2 / 4 + 2.0 * (1.0 - jerk * r**3 / 6))
    best = 2 * (r + x) + 0.75 + one_metre(jerk)
    assert found.stops == (start + 1.0, start + 1.75, start + 2.75)
    assert "stops at corners of the path" in " ".join(str(found).split())
    if ends == "free":
        assert best * (1 - 1e-6) <= found.duration <= 1.01 * best
    else:
        assert best < found.duration
        assert found.plan.jet(start, 1)[1].ravel() == pytest.approx([1.0, 0.0], rel=1e-12)
    check_limits(found.plan, limits_of(50, 1, jerk))
    assert {jump.time for jump in found.plan.jumps(2)} <= {start, found.plan.end}


def test_the_plan_is_saved_with_its_law(tmp_path):
    found = fastest(move(2), limits_of(1, 2, 10), hold="path").plan
    found.save(tmp_path / "plan.json")
    t = np.linspace(found.start, found.end, 101)
    np.testing.assert_array_equal(cp.load_trajectory(tmp_path / "plan.json").jet(t, 3), found.jet(t, 3))


def from_half_to_one(acceleration, jerk):
    """Minimum time over 1 m from 0.5 m/s to 1 m/s with any accelerations at the ends.

    At the limit of the acceleration up to v, to that of braking with constant jerk in the time r = 2 a/j, in which the
    speed is v again, and on to 1 m/s: (v^2 - 1/4)/2a + v r + a r^2/2 - j r^3/6 + (v^2 - 1)/2a = 1.
    """
    r = 2 * acceleration / jerk
    lost = 1 + 1.25 / (2 * acceleration) - acceleration * r**2 / 2 + jerk * r**3 / 6
    v = 0.5 * acceleration * (-r + np.sqrt(r**2 + 4 * lost / acceleration))
    return (v - 0.5) / acceleration + r + (v - 1) / acceleration


FASTER = PolySpline([Waypoint(0, 0, 0.5, 0), Waypoint(1, 1, 1, 0)])


@pytest.mark.parametrize("kind", ["derivatives", "quantities"])
def test_given_speeds_at_the_ends(kind):
    limits, system = limits_of(2, 1, 5), None
    if kind == "quantities":
        limits, system = {"y_d1": 2.0, "force": cp.Limits(-3.0, 3.0, rate=15.0)}, lambda jet: {"force": 3.0 * jet[2, 0]}
    plan = FASTER.shift(2.0)
    found = fastest(plan, limits, system, hold="path", ends="given")
    best = from_half_to_one(1.0, 5.0)
    assert best * (1 - 1e-9) <= found.duration <= 1.003 * best
    assert found.plan.start == 2.0
    assert [float(found.plan.jet(t, 1, left=t > 2.0)[1, 0]) for t in (2.0, found.plan.end)] == pytest.approx(
        [0.5, 1.0], rel=1e-13
    )
    check_limits(found.plan, limits_of(2, 1, 5))
    assert found.margins.satisfied
    assert found.plan.jumps(2)[0].time == 2.0  # at its ends alone
    assert {jump.time for jump in found.plan.jumps(2)} <= {2.0, found.plan.end}


def test_a_given_speed_at_its_limit():
    """With 1 m/s as the limit of the speed, at the end as well."""
    found = fastest(FASTER, limits_of(1, 1, 100), hold="path", ends="given")
    without = 0.5 + (1.0 - 0.375) / 1.0  # 0.5 s to 1 m/s over 0.375 m, and on
    assert without <= found.duration <= 1.003 * without
    assert found.plan.jet(found.plan.end, 1, left=True)[1, 0] == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize(
    ("limits", "system", "message"),
    [
        (limits_of(0.9, 1, 5), None, "limits must be satisfied with the speeds at the ends, got y_d1 = 1 at 1 s"),
        # From 0.5 m/s over 1 m at 0.3 m/s^2 to sqrt(0.85) m/s.
        (
            limits_of(2, 0.3, 5),
            None,
            r"the speed at the end must be feasible .* at most 0\.9(18|19|20|21)\d* times it is",
        ),
        ({"v": 0.9}, lambda jet: {"v": jet[1, 0]}, "limits must be satisfied with the speeds at the ends, got v = 1"),
    ],
)
def test_given_speeds_that_are_infeasible(limits, system, message):
    with pytest.raises(ValueError, match=message):
        fastest(FASTER, limits, system, hold="path", ends="given")


def along_a_line(start, duration, speeds, length, direction=(1.0,)):
    """From one speed to another one, with an acceleration of 0 at an end at rest."""
    points = []
    for time, place, speed in zip((start, start + duration), (0.0, length), speeds, strict=True):
        jets = {f"y{k}": [place * c, speed * c] + [0.0] * int(speed == 0.0) for k, c in enumerate(direction)}
        points.append(Waypoint.from_jets(time, **jets))
    return PolySpline(points)


def stops_in(share, time, jerk):
    """Speed from which a plan stops, distance and duration: jerk -j for a share of the time of jerk j to the stop.

    With a share of 0 no shorter distance is possible.
    """
    q = share
    speed = jerk * time**2 * (0.5 + q - q**2 / 2)
    return speed, jerk * time**3 * (1 / 6 + q / 2 + q**2 / 2 - q**3 / 6), (1 + q) * time


@pytest.mark.parametrize("kind", ["derivatives", "quantities"])
@pytest.mark.parametrize("acceleration", [None, 1e3])
@pytest.mark.parametrize("share", [0.5, 0.1, 0.02])
@pytest.mark.parametrize(("start", "reverse"), [(0.0, False), (-3.0, True), (1e9, False)])
def test_a_stop_from_a_given_speed_by_the_jerk_alone(kind, acceleration, share, start, reverse):
    """The speeds are 0.82, 0.985 and 0.9992 times those from which a plan stops in this distance at all."""
    jerk = 3.0
    speed, length, best = stops_in(share, 1.5, jerk)
    speeds = (0.0, speed) if reverse else (speed, 0.0)
    plan = along_a_line(start, 2.0 * length / speed, speeds, length, (1.0, -0.3))
    limits, system = {"jerk": jerk}, None
    if acceleration is not None:
        limits["acceleration"] = acceleration
    if kind == "quantities":
        bound = cp.Limits(*((-2.0 * acceleration, 2.0 * acceleration) if acceleration else ()), rate=2.0 * jerk)
        limits, system = {"push": bound}, lambda jet: {"push": 2.0 * jet[2, 0]}
    found = fastest(plan, limits, system, hold="path", ends="given")
    rounding = 8 * np.spacing(abs(start))
    assert best * (1 - 1e-6) - rounding <= found.duration <= 1.005 * best + rounding
    check_limits(found.plan, {"jerk": jerk})
    assert found.margins.satisfied
    moving = start if not reverse else found.plan.end
    assert abs(found.plan.jet(moving, 1, left=reverse)[1, 0]) == pytest.approx(speed, rel=1e-6)


@pytest.mark.parametrize("acceleration", [None, 1e3])
@pytest.mark.parametrize(("speeds", "jerk"), [((0.5, 1.0), 5.0), ((1.0, 1.0), 0.01), ((1.0, 0.1), 1.0)])
def test_both_speeds_given_by_the_jerk_alone(acceleration, speeds, jerk):
    """Any accelerations at the ends and a constant jerk -j: (v_0 + v_1) T/2 + j T^3/12 is the length."""
    plan = along_a_line(0.0, 2.0 / sum(speeds), speeds, 1.0)
    limits = {"jerk": jerk} | ({"acceleration": acceleration} if acceleration else {})
    found = fastest(plan, limits, hold="path", ends="given")
    best = max(root.real for root in np.roots([jerk / 12, 0.0, sum(speeds) / 2, -1.0]) if abs(root.imag) < 1e-9)
    assert best * (1 - 1e-9) <= found.duration <= 1.002 * best
    check_limits(found.plan, limits)


@pytest.mark.parametrize("share", [0.9, 0.99, 0.999])
def test_a_speed_near_the_largest_one_that_is_braked(share):
    """From v_0 to 0.3 m/s over 1 m: v_0^2 - 0.09 is a share of 2 a; constant jerk for 2 a/j, as for `from_half_to_one`.

    Where the time is shorter, the acceleration at the start is below its limit: speeds follow from it.
    """
    acceleration, jerk, last = 1.0, 5.0, 0.3
    first = np.sqrt(last**2 + 2 * acceleration * share)

    # The acceleration falls from a_0 to -a in the time (a_0 + a)/j, and remains there.
    def passed(peak):
        fall = (peak + acceleration) / jerk
        speed = first + peak * fall - jerk * fall**2 / 2
        length = first * fall + peak * fall**2 / 2 - jerk * fall**3 / 6
        return length + (speed**2 - last**2) / (2 * acceleration), fall + (speed - last) / acceleration

    peak = brentq(lambda own: passed(own)[0] - 1.0, -acceleration, acceleration)
    best = passed(peak)[1]
    plan = along_a_line(0.0, 2.0 / (first + last), (first, last), 1.0)
    found = fastest(plan, limits_of(5, acceleration, jerk), hold="path", ends="given")
    assert best * (1 - 1e-9) <= found.duration <= 1.003 * best
    check_limits(found.plan, limits_of(5, acceleration, jerk))


@pytest.mark.slow
@pytest.mark.parametrize(("count", "naxes"), [(2, 7), (5, 3), (20, 2), (50, 3)])
@pytest.mark.parametrize("speeds", [(1.0, 0.5), (0.0, 1.0), (2.0, 0.0)])
def test_paths_with_given_speeds_satisfy_limits_of_the_jerk(count, naxes, speeds):
    """They are little slower than with free ends, and much faster than the given plan."""
    points = np.random.default_rng(3).normal(size=(naxes, count))
    times = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points), axis=0)))
    derivatives = np.full((2, naxes, count), np.nan)
    for end, inner, speed in ((0, 1, speeds[0]), (-1, -2, speeds[1])):
        chord = (points[:, inner] - points[:, end]) * (1.0 if end == 0 else -1.0)
        derivatives[0, :, end] = speed * chord / np.linalg.norm(chord)
        derivatives[1, :, end] = 0.0
    plan = PiecewiseSpline.from_arrays(times, points, derivatives={1: derivatives[0], 2: derivatives[1]}, warn=False)
    limits = {"velocity": 20.0, "jerk": 100.0}
    found = fastest(plan, limits, hold="path", ends="given")
    jet = np.abs(found.plan.jet(np.linspace(found.plan.start, found.plan.end, 200_001), 3)).max(axis=(1, 2))
    assert jet[1] <= 20.0 * (1 + 1e-9)
    assert jet[3] <= 100.0 * (1 + 1e-9)
    for time, left, speed in ((found.plan.start, False, speeds[0]), (found.plan.end, True, speeds[1])):
        assert np.linalg.norm(found.plan.jet(time, 1, left=left)[1]) == pytest.approx(speed, rel=1e-9, abs=1e-9)
    free = fastest(plan, limits, hold="path").duration
    assert free * (1 - 2e-3) <= found.duration <= free + 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("count", "seed", "jerk"), [(3, 1, 10.0), (4, 2, 40.0), (5, 3, 100.0)])
def test_given_speeds_on_a_path_are_those_of_a_nonlinear_program(count, seed, jerk):
    """Limits of the jerk alone, b = 1 at both ends, and limits at the nodes of a fine grid, by IPOPT."""
    casadi = pytest.importorskip("casadi")
    points = np.random.default_rng(seed).normal(size=(2, count))
    times = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points), axis=0)))
    first = np.full((2, count), np.nan)
    first[:, 0], first[:, -1] = points[:, 1] - points[:, 0], points[:, -1] - points[:, -2]
    first /= np.linalg.norm(first, axis=0)
    plan = PiecewiseSpline.from_arrays(times, points, derivatives={1: first}, warn=False)
    cells = 1600
    s = np.linspace(plan.start, plan.end, cells + 1)
    h = s[1] - s[0]
    b = casadi.MX.sym("b", cells + 1)
    slope, bend = (b[2:] - b[:-2]) / (2 * h), (b[2:] - 2 * b[1:-1] + b[:-2]) / h**2
    rows = [
        casadi.sqrt(b[1:-1]) * (p3 * b[1:-1] + 1.5 * p2 * slope + 0.5 * p1 * bend)
        for p1, p2, p3 in zip(*plan.jet(s[1:-1], 3)[1:], strict=True)
    ]
    time = 2 * h * casadi.sum1(1 / (casadi.sqrt(b[1:]) + casadi.sqrt(b[:-1])))
    problem = {"x": b, "f": time, "g": casadi.vertcat(*rows)}
    solver = casadi.nlpsol("solver", "ipopt", problem, {"ipopt.print_level": 0, "print_time": False})
    low, high = np.full(cells + 1, 1e-4), np.full(cells + 1, np.inf)
    low[[0, -1]] = high[[0, -1]] = 1.0
    solved = solver(x0=1.0, lbx=low, ubx=high, lbg=-jerk, ubg=jerk)
    assert solver.stats()["success"]
    found = fastest(plan, {"jerk": jerk}, hold="path", ends="given")
    assert 0.998 * float(solved["f"]) <= found.duration <= 1.01 * float(solved["f"])
    check_limits(found.plan, {"jerk": jerk})


@pytest.mark.slow
def test_limits_of_the_jerk_far_above_use_cost_nothing():
    plan = random_path(5, 3, 1)
    without = fastest(plan, {"velocity": 2.0, "acceleration": 4.0}, hold="path").duration
    assert fastest(plan, limits_of(2, 4, 1e6), hold="path").duration <= 1.001 * without


@pytest.mark.parametrize("naxes", [1, 5])
@pytest.mark.parametrize("entries", [(), (0,), (0, 0), (0, 0, 0)])
def test_many_stops_on_a_path_of_lines(naxes, entries):
    """From stop to stop the axis of the longest move is at its limits; those of others are not symmetric."""
    rng = np.random.default_rng(7)
    places = np.cumsum(rng.normal(size=(25, naxes)) * rng.choice([-0.3, 1.0, 3.0], (25, 1)), axis=0)
    if naxes == 1 and not entries:
        places = np.cumsum([[1.0] * 2, [-1.0] * 2] * 6).reshape(-1, 1)  # every second one is a corner
    plan = PiecewiseSpline([Waypoint(0.5 * k, place, *entries) for k, place in enumerate(places)], warn=False)
    limits = {"velocity": 3.0, "acceleration": 1.0, "jerk": 5.0}
    found = fastest(plan, limits, hold="path")
    lengths = np.abs(np.diff(places, axis=0)).max(axis=1)
    best = sum(rest_to_rest(length, **limits) for length in lengths.tolist())
    if entries:
        assert best * (1 - 1e-6) <= found.duration <= 1.01 * best
    check_limits(found.plan, limits)
    assert found.margins.satisfied


def rest_to_rest(distance, velocity, acceleration, jerk):
    """Minimum time of a symmetric S-curve."""

    def rise(peak):
        return peak / acceleration + acceleration / jerk if peak * jerk > acceleration**2 else 2 * (peak / jerk) ** 0.5

    low, high = 0.0, velocity
    if velocity * rise(velocity) <= distance:
        return rise(velocity) + distance / velocity
    for _ in range(200):
        peak = 0.5 * (low + high)
        low, high = (peak, high) if peak * rise(peak) < distance else (low, peak)
    return 2.0 * rise(low)


def test_the_strictest_limit_of_each_sign_counts_on_a_line():
    """Jerks of two axes that move against each other, with limits that are not symmetric, as of one axis."""
    points = [Waypoint(0, [0, 0], 0, 0), Waypoint(1, [1, -0.5], 0, 0), Waypoint(2, [0, 0], 0, 0)]
    limits = {
        "y1_d2": 1.0,
        "y2_d2": 10.0,
        "y1_d3": cp.Limits(-8.0, 4.0),
        "y2_d3": cp.Limits(-3.0, 2.0),
    }
    found = fastest(PiecewiseSpline(points), limits, hold="path")
    # -0.5 of the first axis is the second one: -3 <= -0.5 j <= 2 is -4 <= j <= 6.
    single = fastest(
        PiecewiseSpline([Waypoint(k, point.position[:1], 0, 0) for k, point in enumerate(points)]),
        {"acceleration": 1.0, "jerk": 4.0},
        hold="path",
    )
    assert found.duration == pytest.approx(single.duration, rel=2e-3)
    assert found.margins.satisfied
