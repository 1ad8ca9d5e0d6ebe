"""The shortest duration against closed forms, scans in plain words, and the crane written out in the test."""

import re
from functools import cache
from math import inf, sqrt

import control as ct
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from natural import NaturalCubic
from repetitions import examples
from scipy.interpolate import BPoly
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan import Waypoint
from ctrlplan.planning import Fastest, fastest, margins
from ctrlplan.studies.crane import CRANE, nominal_waypoints, obstacle_waypoints

MOVE = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
THROUGH = cp.PolySpline([Waypoint(0, 0, 1, 0), Waypoint(1, 1, 1, 0)])
OBSTACLE = cp.TrigSpline(obstacle_waypoints(), alpha=4.0)
HOIST = cp.PolySpline(nominal_waypoints(5))
HOIST_TRIG = cp.TrigSpline(nominal_waypoints(5), alpha=2.0)
COUNT = 100_001


def derivative(plan, nu, count=COUNT):
    return plan.jet(np.linspace(plan.start, plan.end, count), nu)[nu]


def crane_signals(plan, count=COUNT):
    """Equations (15a-d) and the inputs along a plan, with w = x''/(g - z''), differentiated by hand."""
    m, trolley, inertia, b, f1, f2, g = 500.0, 5000.0, 50.0, 0.25, 20.0, 20.0, 9.81
    (_, z), (x1, z1), (x2, z2), (x3, z3), (x4, z4) = plan.jet(np.linspace(plan.start, plan.end, count), 4)
    p, p1, p2 = g - z2, -z3, -z4
    w = x2 / p
    w1 = (x3 - w * p1) / p
    w2 = (x4 - 2 * w1 * p1 - w * p2) / p
    h = np.sqrt(1 + w * w)
    h1 = w * w1 / h
    h2 = (w1 * w1 + w * w2 - h1 * h1) / h
    d1 = x1 - b * h1 + z1 * w + z * w1
    d2 = x2 - b * h2 + z2 * w + 2 * z1 * w1 + z * w2
    r1 = z1 * h + z * h1 - b * w1
    r2 = z2 * h + 2 * z1 * h1 + z * h2 - b * w2
    tension = m * p * h
    return {
        "F": trolley * d2 + f1 * d1 + m * x2,
        "C": inertia * r2 / b + f2 * r1 / b - b * tension,
        "T": tension,
        "theta": np.arctan2(-x2, p),
        "R": z * h - b * w,
        "x_d1": x1,
        "z_d1": z1,
    }


def excess(signals, limits):
    """Maximum excess beyond limits (low, high), as a fraction of half their distance."""
    found = []
    for name, (low, high) in limits.items():
        scale = 0.5 * (high - low)
        found.append(max((signals[name].max() - high) / scale, (low - signals[name].min()) / scale))
    return max(found)


def runs(durations, inside):
    """Intervals of a scan in which limits hold, by their first and last duration."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    return [(durations[a], durations[b - 1]) for a, b in edges.reshape(-1, 2)]


# Fixed shape: closed forms


@pytest.mark.parametrize(
    ("limits", "duration", "active"),
    [
        ({"y_d1": 0.5}, 15 / 8 / 0.5, "y_d1"),
        ({"y_d2": 2.0}, sqrt(10 / sqrt(3) / 2.0), "y_d2"),
        ({"y_d1": 0.5, "y_d2": 2.0}, 3.75, "y_d1"),
        ({"y_d1": 5.0, "y_d2": 0.1}, sqrt(100 / sqrt(3)), "y_d2"),
        ({"velocity": 0.5, "acceleration": 2.0}, 3.75, "y_d1"),
        ({"y_d1": (-0.1, 0.5)}, 3.75, "y_d1"),
        ({"y_d1": (0, 2)}, 0.9375, "y_d1"),
        ({"y_d1": (None, 0.5)}, 3.75, "y_d1"),
        ({"y_d2": (-1.0, 4.0)}, sqrt(10 / sqrt(3)), "y_d2"),
        ({"y_d2": (-4.0, 1.0)}, sqrt(10 / sqrt(3)), "y_d2"),
        ({"y": (-0.5, 1.5), "y_d1": 1.0}, 1.875, "y_d1"),
    ],
)
def test_minimum_jerk_move(limits, duration, active):
    found = fastest(MOVE, limits)
    assert isinstance(found, Fastest)
    assert found.duration == pytest.approx(duration, rel=1e-11)
    assert found.plan.duration == found.duration
    assert found.feasible == ((found.duration, inf),)
    assert found.margins.satisfied
    if limits != {"y_d1": (0, 2)}:  # there the lower side is touched as well
        assert found.active.bound.name == active
    assert found.active.fraction == pytest.approx(0.0, abs=1e-11)
    assert found.hold == "shape"


def test_jerk_and_snap_in_closed_form():
    septic = cp.PolySpline([Waypoint(0, 0, 0, 0, 0), Waypoint(3, 2, 0, 0, 0)])
    assert fastest(septic, {"jerk": 7.0}).duration == pytest.approx((2 * 52.5 / 7.0) ** (1 / 3), rel=1e-11)
    nonic = cp.PolySpline([Waypoint.from_jets(t, y=[float(t), 0, 0, 0, 0]) for t in (0, 1)])
    unit = BPoly.from_derivatives([0, 1], [[0, 0, 0, 0, 0], [1, 0, 0, 0, 0]])
    snap = np.abs(unit.derivative(4)(np.linspace(0, 1, COUNT))).max()
    assert fastest(nonic, {"snap": 30.0}).duration == pytest.approx((snap / 30.0) ** 0.25, rel=1e-9)


@pytest.mark.parametrize("plan", [OBSTACLE, cp.PiecewiseSpline(obstacle_waypoints()), HOIST, MOVE + 2 * MOVE])
def test_limits_on_derivatives_follow_from_the_peaks(plan):
    limits = {"velocity": 1.5, "acceleration": 0.7}
    found = fastest(plan, limits)
    peaks = [np.abs(derivative(plan, nu)).max() for nu in (1, 2)]
    expected = plan.duration * max(peaks[0] / 1.5, sqrt(peaks[1] / 0.7))
    assert found.duration == pytest.approx(expected, rel=1e-8)
    t = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(
        found.plan(found.plan.start + found.duration * t), plan(plan.start + plan.duration * t), rtol=1e-12, atol=1e-12
    )
    for nu, limit in ((1, 1.5), (2, 0.7)):
        assert np.abs(derivative(found.plan, nu)).max() <= limit * (1 + 1e-12)
    shorter = plan.retime(found.duration * (1 - 1e-4))
    assert any(np.abs(derivative(shorter, nu)).max() > limit for nu, limit in ((1, 1.5), (2, 0.7)))


def test_a_slow_plan_is_made_shorter_and_a_fast_one_longer():
    for duration in (1e-3, 1e3):
        found = fastest(MOVE.retime(duration), {"y_d1": 2.0})
        assert found.duration == pytest.approx(0.9375, rel=1e-12)


def test_start_and_kind_stay():
    found = fastest(OBSTACLE.shift(100.0), {"velocity": 2.0})
    assert found.plan.start == 100.0
    assert isinstance(found.plan, cp.TrigSpline)
    assert found.plan.alpha == 4.0
    times = np.array([w.time for w in found.plan.waypoints]) - 100.0
    np.testing.assert_allclose(times / found.duration, np.array([0, 6, 11, 16]) / 16, rtol=1e-13)


@pytest.mark.parametrize("seed", range(6))
def test_position_limits_that_the_move_just_touches(seed):
    rng = np.random.default_rng(seed)
    low, high = sorted(10 * rng.normal(size=2))
    plan = cp.TrigSpline([Waypoint(0, low, 0, 0), Waypoint(1.7, high, 0, 0)], alpha=float(rng.uniform(0, 3)))
    found = fastest(plan, {"y": (low, high), "y_d1": 2.0})
    peak = np.abs(derivative(plan, 1)).max()
    assert found.duration == pytest.approx(1.7 * peak / 2.0, rel=1e-7)
    assert found.margins.satisfied


@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0, 3.0])
def test_never_backwards(alpha):
    plan = cp.TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)], alpha=alpha)
    found = fastest(plan, {"y_d1": (0.0, 2.0)})
    assert found.duration == pytest.approx(derivative(plan, 1).max() / 2.0, rel=1e-8)


sizes = st.floats(1e-3, 1e3)


@examples(12)
@given(size=sizes, duration=sizes, shift=st.floats(-1e3, 1e3), limits=st.tuples(sizes, sizes))
def test_closed_form_scales(size, duration, shift, limits):
    plan = (size * MOVE).retime(duration).shift(shift)
    found = fastest(plan, {"y_d1": limits[0], "y_d2": limits[1]})
    expected = max(15 / 8 * size / limits[0], sqrt(10 / sqrt(3) * size / limits[1]))
    # The times of a plan far from 0 have the rounding of its start.
    assert found.duration == pytest.approx(expected, rel=1e-11 + 1e-14 * abs(shift) / min(expected, duration))


@examples(10)
@given(nu=st.integers(1, 2), factor=st.floats(0.01, 100.0))
def test_wider_limits_by_a_power(nu, factor):
    plan = cp.TrigSpline(obstacle_waypoints(), alpha=4.0)
    word = ("velocity", "acceleration")[nu - 1]
    ours, theirs = fastest(plan, {word: 1.0}).duration, fastest(plan, {word: factor}).duration
    assert theirs == pytest.approx(ours * factor ** (-1 / nu), rel=1e-11)


# Fixed shape: quantities of a plant


CRANE_LIMITS = {
    "drives": {"F": (-30e3, 30e3), "C": (-3e3, 1e3)},
    "weak trolley": {"F": (-2e3, 2e3), "C": (-3e3, 1e3)},
    "sway": {"theta": (-0.02, 0.02), "F": (-30e3, 30e3)},
    "tension": {"T": (0.0, 4950.0), "theta": (-0.5, 0.5)},
    "rope": {"R": (5.0, 11.05), "F": (-30e3, 30e3)},
    "speed": {"x_d1": (-2.0, 2.0), "F": (-30e3, 30e3)},
    "torque": {"C": (-1300.0, -1150.0)},
}


@pytest.mark.parametrize("name", CRANE_LIMITS)
@pytest.mark.parametrize(
    "plan", [HOIST, pytest.param(HOIST_TRIG, marks=pytest.mark.slow)], ids=["polynomial", "trigonometric"]
)
def test_crane(plan, name):
    limits = CRANE_LIMITS[name]
    found = fastest(plan, limits, CRANE)
    assert excess(crane_signals(found.plan), limits) <= 1e-11
    assert excess(crane_signals(plan.retime(found.duration * (1 - 1e-4))), limits) > 0.0
    assert found.active.fraction == pytest.approx(0.0, abs=1e-9)
    signal = crane_signals(found.plan)[found.active.bound.name]
    t = np.linspace(found.plan.start, found.plan.end, COUNT)
    assert np.interp(found.active.time, t, signal) == pytest.approx(found.active.value, rel=1e-7)
    assert len(found.margins) == len(limits)
    for row in found.margins:
        assert row.fraction == pytest.approx(
            -excess(crane_signals(found.plan), {row.bound.name: limits[row.bound.name]}), abs=1e-7
        )
    assert found.feasible[-1][1] == inf


def test_crane_feasible_set_is_that_of_a_scan():
    limits = CRANE_LIMITS["weak trolley"]
    found = fastest(HOIST, limits, CRANE)
    for duration in np.geomspace(2.0, 200.0, 81):
        try:
            holds = excess(crane_signals(HOIST.retime(float(duration)), 2001), limits) <= 0.0
        except ValueError:
            holds = False
        assert holds == any(low <= duration <= high for low, high in found.feasible)


@pytest.mark.slow
def test_crane_does_not_depend_on_the_duration_given():
    expected = fastest(HOIST, CRANE_LIMITS["drives"], CRANE).duration
    for duration in (0.5, 300.0):
        assert fastest(HOIST.retime(duration), CRANE_LIMITS["drives"], CRANE).duration == pytest.approx(
            expected, rel=1e-9
        )


@pytest.mark.slow
def test_the_reason_of_the_plant_is_given():
    found = fastest(HOIST, {"T": (0, None)}, CRANE)
    # The crane can follow only below g - z'' = 0, which no limit says.
    fall = derivative(HOIST, 2)[1].max()
    minimum = 15.0 * sqrt(fall / 9.81)
    assert found.duration == pytest.approx(minimum, rel=1e-5)
    assert found.duration >= minimum


def test_a_static_torque_beyond_the_limit():
    for hold in ("shape", "path"):
        with pytest.raises(
            ValueError, match=r"limits must be satisfied at rest.* got C = -1226.25 at rest at .*within ±1000"
        ):
            fastest(HOIST, {"C": 1000.0, "F": 3e4}, CRANE, hold=hold)
    with pytest.raises(ValueError, match=r"limits must be satisfied for some duration .*C within ±1000: -1226"):
        fastest(HOIST, {"C": 1000.0}, CRANE, hold="waypoints")


def test_a_position_beyond_the_limit():
    with pytest.raises(ValueError, match=r"limits must be satisfied at rest, .* got x = 20 at rest at x = 20, z = 11"):
        fastest(HOIST, {"x": (0, 19.0), "x_d1": 2.0})


def test_limits_that_no_shorter_plan_breaks():
    with pytest.raises(ValueError, match="one that a shorter plan would violate, got none"):
        fastest(MOVE, {"y": 2.0})
    with pytest.raises(ValueError, match="plan must move, got constant axes"):
        fastest(cp.PolySpline([Waypoint(0, 1, 0, 0), Waypoint(1, 1, 0, 0)]), {"y_d1": 1.0})


# Waypoints held


def quintic_peak(duration):
    """Peak acceleration of the quintic from 0 to 1 with end speeds 1: its jerk is 0 where u (1 - u) = 1/6."""
    # y = t + (1 - T) h(t/T) with h the minimum-jerk move.
    return 10 / sqrt(3) * abs(1 - duration) / duration**2


@pytest.mark.parametrize(("duration", "peak"), [(0.8, 1.80), (1.0, 0.0), (2.0, 1.44), (10.0, 0.52)])
def test_the_peaks_of_the_quintic_are_those_of_the_mathematics(duration, peak):
    assert quintic_peak(duration) == pytest.approx(peak, abs=0.005)


@pytest.mark.parametrize("limit", [0.01, 0.5, 1.0, 1.4, 1.5, 3.0])
def test_feasibility_is_not_monotone_where_derivatives_are_held(limit):
    found = fastest(THROUGH, {"y_d2": limit}, hold="waypoints")
    c = 10 / sqrt(3) / limit
    # c |1 - T| <= T^2: below 1 from T^2 + c T - c, above 1 from T^2 - c T + c.
    first = (-c + sqrt(c * c + 4 * c)) / 2
    assert found.duration == pytest.approx(first, rel=1e-9)
    if c > 4:
        between = [(c - sqrt(c * c - 4 * c)) / 2, (c + sqrt(c * c - 4 * c)) / 2]
        assert found.feasible[0] == pytest.approx((first, between[0]), rel=1e-9)
        assert len(found.feasible) == (2 if between[1] < 64.0 else 1)
        if between[1] < 64.0:
            assert found.feasible[1] == pytest.approx((between[1], 64.0), rel=1e-9)
    else:
        assert len(found.feasible) == 1
        assert found.feasible[0] == pytest.approx((first, 64.0), rel=1e-9)
    assert found.active.fraction == pytest.approx(0.0, abs=1e-8)
    np.testing.assert_allclose(found.plan.jet([0, found.duration], 2)[:, 0], [[0, 1], [1, 1], [0, 0]], atol=1e-12)
    assert quintic_peak(found.duration * (1 - 1e-4)) > limit


@pytest.mark.slow
@pytest.mark.parametrize("family", ["trigonometric", "piecewise", "polynomial"])
def test_feasible_set_is_that_of_a_scan(family):
    points = obstacle_waypoints()
    make = {
        "trigonometric": lambda p: cp.TrigSpline(p, alpha=4.0),
        "piecewise": cp.PiecewiseSpline,
        "polynomial": cp.PolySpline,
    }[family]
    fast, hard = (6.0, 4.0) if family == "polynomial" else (5.0, 2.5)
    limits = {"velocity": fast, "acceleration": hard}
    found = fastest(make(points), limits, hold="waypoints", durations=(6.0, 300.0))

    def peaks(duration):
        plan = make([Waypoint(w.time * duration / 16.0, *w.jet) for w in points])
        jet = plan.jet(np.linspace(0, plan.end, 4001), 2)
        return max(np.abs(jet[1]).max() / fast, np.abs(jet[2]).max() / hard) - 1.0

    durations = np.geomspace(6.0, 300.0, 201)
    scanned = runs(durations, np.array([peaks(float(d)) for d in durations]) <= 0.0)
    assert len(found.feasible) == len(scanned)
    step = durations[1] / durations[0]
    for (low, high), (first, last) in zip(found.feasible, scanned, strict=True):
        assert first / step <= low <= first
        assert last <= high * (1 + 1e-12) <= last * step * (1 + 1e-12)
        if first > durations[0]:
            assert low == pytest.approx(brentq(peaks, first / step, first, xtol=1e-9), rel=1e-5)
        if last < durations[-1]:
            assert high == pytest.approx(brentq(peaks, last, last * step, xtol=1e-9), rel=1e-5)
    assert found.duration == pytest.approx(found.feasible[0][0], rel=1e-12)
    given_derivatives = np.array([w.jet for w in points])
    times = [w.time for w in found.plan.waypoints]
    np.testing.assert_allclose(found.plan.jet(times, 2).transpose(2, 0, 1), given_derivatives, atol=1e-9)
    np.testing.assert_allclose(np.array(times) / found.duration, np.array([0, 6, 11, 16]) / 16, rtol=1e-12)


@pytest.mark.slow
def test_waypoints_held_without_derivatives_is_the_shape_held():
    points = [Waypoint(0, [0, 1]), Waypoint(2, [1, 3]), Waypoint(3, [4, 0]), Waypoint(5, [5, 5])]
    for plan in (cp.TrigSpline(points, alpha=2.0), cp.PolySpline(points)):
        shape, held = (fastest(plan, {"velocity": 2.0, "acceleration": 3.0}, hold=h) for h in ("shape", "waypoints"))
        assert held.duration == pytest.approx(shape.duration, rel=1e-9)


def test_waypoints_held_of_a_closed_plan():
    plan = cp.TrigSpline.cyclic([Waypoint(0, 0), Waypoint(1, 1), Waypoint(2, -1)], 3.0)
    shape, held = (fastest(plan, {"y_d1": 1.0}, hold=h) for h in ("shape", "waypoints"))
    assert held.duration == pytest.approx(shape.duration, rel=1e-9)
    assert [w.time for w in held.plan.waypoints] == pytest.approx([0, held.duration / 3, 2 * held.duration / 3])


def test_waypoints_held_with_quantities():
    limits = CRANE_LIMITS["weak trolley"]
    points = [
        Waypoint.from_jets(0, x=[0] * 4, z=[10, 0, 0, 0]),
        Waypoint.from_jets(15, x=[20, 1, 0, 0], z=[11, 0, 0, 0]),
    ]
    found = fastest(cp.PolySpline(points), limits, CRANE, hold="waypoints")
    assert excess(crane_signals(found.plan), limits) <= 1e-11
    assert found.plan(found.duration, 1)[0] == pytest.approx(1.0, abs=1e-10)
    assert found.active.fraction == pytest.approx(0.0, abs=1e-9)
    for low, high in found.feasible:
        middle = cp.PolySpline([points[0], points[1].scaled(sqrt(low * high), 1.0)])
        assert excess(crane_signals(middle, 4001), limits) <= 1e-9


def test_waypoints_are_held_of_splines_alone():
    there_and_back = MOVE.then(cp.PolySpline([Waypoint(1, 1, 0, 0), Waypoint(2, 0, 0, 0)]))
    with pytest.raises(
        TypeError,
        match=r"plan must be a WaypointSpline, .* for hold=.waypoints., got a Joined; use hold=.shape. or .path.",
    ):
        fastest(there_and_back, {"y_d1": 1.0}, hold="waypoints")


# A closed plan stays closed

CYCLE = cp.TrigSpline.cyclic([Waypoint(0, [0, 0]), Waypoint(1, [3, 0]), Waypoint(2, [1, 2])], 3.0)
TURNING = cp.TrigSpline.cyclic([Waypoint(0, 1.0, 0.0), Waypoint(1, 0.0), Waypoint(2, -2.0)], 3.0)
LOOP = [Waypoint(0, [0, 0], [1, 0], 0), Waypoint(1, [2, 1], 0, 0), Waypoint(3, [0, 0], [1, 0], 0)]
CLOSED = {
    "cycle": CYCLE,
    "late": CYCLE.shift(1e4),
    "far away": CYCLE + cp.Step([1e6, -1e6], [1e6, -1e6]),
    "two rounds": CYCLE.then(CYCLE),
    "multiple": -3.0 * CYCLE,
    "stacked": cp.stack([CYCLE, TURNING], labels=["a", "b", "c"]),
    "from a reversal": TURNING,
    "through waypoints": cp.PiecewiseSpline(LOOP),
    "with another time law": cp.Retimed(CYCLE, cp.PolySpline([Waypoint(0, 0, 2.0), Waypoint(2, 3, 2.0)])),
}


@pytest.mark.parametrize("hold", ["shape", "path"])
@pytest.mark.parametrize("name", CLOSED)
def test_a_closed_plan_stays_closed(name, hold):
    found = fastest(CLOSED[name], {"velocity": 2.0, "acceleration": 3.0}, hold=hold).plan
    first, last = found.jet(found.start, 1), found.jet(found.end, 1, left=True)
    np.testing.assert_allclose(first, last, rtol=0, atol=1e-8 * found.peak()[:, None].max())
    jet = np.abs(found.jet(np.linspace(found.start, found.end, COUNT), 2)).max(axis=(1, 2))
    assert jet[1] <= 2.0 * (1 + 1e-11)
    assert jet[2] <= 3.0 * (1 + 1e-11)


@pytest.mark.slow
def test_a_closed_plan_stays_closed_with_a_limited_fifth_derivative():
    found = fastest(CYCLE, {"velocity": 2.0, "y1_d5": 3e4}, hold="path").plan
    first, last = found.jet(found.start, 4), found.jet(found.end, 4, left=True)
    jet = found.jet(np.linspace(found.start, found.end, COUNT), 5)
    sizes = np.abs(jet[:5]).max(axis=2)
    assert (np.abs(first - last) <= 1e-8 * sizes).all()
    assert np.abs(jet[1]).max() <= 2.0 * (1 + 1e-11)
    assert np.abs(jet[5, 0]).max() <= 3e4 * (1 + 1e-9)


@pytest.mark.slow
def test_a_limited_sixth_derivative_is_satisfied_on_the_path():
    """In less time than at fixed shape; the path remains."""
    ends = [Waypoint.from_array(2.0 * k, k * np.eye(7, 1), None) for k in (0, 1)]
    plan = cp.TrigSpline([ends[0], Waypoint(1, 0.3), ends[1]], alpha=1.0)
    limits = {"velocity": 1.0, "y_d6": 500.0}
    found, shape = fastest(plan, limits, hold="path"), fastest(plan, limits)
    assert found.duration < 0.9 * shape.duration
    peaks = np.abs(found.plan.jet(np.linspace(found.plan.start, found.plan.end, COUNT), 6)).max(axis=(1, 2))
    assert peaks[1] <= 1.0 + 1e-9
    assert 450.0 <= peaks[6] <= 500.0 * (1.0 + 1e-9)
    assert found.plan(found.plan.end) == 1.0


def test_a_time_law_with_a_limited_sixth_derivative_would_open_a_closed_plan():
    with pytest.raises(ValueError, match="hold must be 'shape' or 'waypoints' for a closed plan, got 'path'"):
        fastest(CYCLE, {"velocity": 2.0, "y1_d6": 3e6}, hold="path")


@pytest.mark.slow
@pytest.mark.parametrize(
    "plan",
    [
        cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0), Waypoint(2, 0, 0, 0)]),  # there and back, at rest
        cp.PolySpline([Waypoint(0, 0, 1, 0), Waypoint(1, 2, 1, 0)]),  # on with the speed it came with
        cp.PolySpline([Waypoint(0, 0, 1, 0), Waypoint(1, 0, -1, 0)]),  # back the way it came
    ],
)
def test_an_open_plan_has_a_time_law(plan):
    limits = {"velocity": 3.0, "acceleration": 9.0}
    found = fastest(plan, limits, hold="path")
    assert found.duration <= fastest(plan, limits).duration
    jet = np.abs(found.plan.jet(np.linspace(found.plan.start, found.plan.end, COUNT), 2))
    assert jet[1].max() <= 3.0 * (1 + 1e-11)
    assert jet[2].max() <= 9.0 * (1 + 1e-11)
    # At rest stays at rest; of an end in motion the direction is kept.
    before, after = (p.jet([p.start, p.end], 1)[1, 0] for p in (plan, found.plan))
    np.testing.assert_array_equal(np.sign(np.round(after, 9)), np.sign(before))


@cache
def fastest_on_the_path(velocity, acceleration):
    return fastest(MOVE, {"velocity": velocity, "acceleration": acceleration}, hold="path").duration


@pytest.mark.parametrize("start", [100.0, -3e6])
def test_a_late_start_does_not_change_the_time_law(start):
    """Times of the law are counted from the start; what is left is the search's own last step of 1e-5."""
    limits = {"velocity": 1.0, "acceleration": 1.0}
    wanted = fastest_on_the_path(**limits)
    found = fastest(MOVE.shift(start), limits, hold="path")
    assert found.plan.start == start
    assert found.duration == pytest.approx(wanted, rel=1e-4)
    assert found.margins.satisfied


# Quantities that samples do not see


@pytest.mark.slow
@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-4])
def test_a_narrow_peak_of_a_quantity_sets_the_duration(width):
    """A load that grows about one place, in proportion to the speed there: its peak is that of u over the duration."""

    def load(jet):
        return {"load": jet[1, 0] * (1.0 + 5.0 / (1.0 + ((jet[0, 0] - 0.37) / width) ** 2))}

    place = brentq(lambda t: MOVE(t) - 0.37, 0.0, 1.0, xtol=1e-15)
    t = place + np.linspace(-1.0, 1.0, 2_000_001) * min(50 * width, 0.3)
    peak = load(MOVE.jet(t, 1))["load"].max()
    found = fastest(MOVE, {"load": 2.0}, load)
    assert found.duration == pytest.approx(peak / 2.0, rel=1e-8)
    assert load(found.plan.jet(t * found.duration, 1))["load"].max() <= 2.0 * (1 + 1e-9)


def test_a_noisy_quantity_is_not_limited():
    noise = np.random.default_rng(5)
    with pytest.raises(RuntimeError, match="function must be resolved"):
        fastest(MOVE, {"load": 2.0}, lambda jet: {"load": jet[1, 0] + 1e-3 * noise.normal(size=jet.shape[2])})


# Durations given


def test_durations_bound_the_search():
    assert fastest(MOVE, {"y_d1": 1.0}, durations=(0.5, 5.0)).duration == pytest.approx(1.875, rel=1e-9)
    assert fastest(MOVE, {"y_d1": 1.0}, durations=(3.0, 5.0)).duration == 3.0
    with pytest.raises(
        ValueError, match=r"for some duration from 0.5 to 1 s, got none; nearest at 1 s: y_d1 within ±1"
    ):
        fastest(MOVE, {"y_d1": 1.0}, durations=(0.5, 1.0))
    held = fastest(THROUGH, {"y_d2": 1.0}, hold="waypoints", durations=(1.5, 30.0))
    assert held.duration == pytest.approx(quintic_edge(1.0), rel=1e-9)


def quintic_edge(limit):
    c = 10 / sqrt(3) / limit
    return (c + sqrt(c * c - 4 * c)) / 2


@pytest.mark.parametrize(
    ("durations", "message"),
    [
        ((0.0, 1.0), "durations must be above 0 and finite, got 0 to 1"),
        ((-1.0, 1.0), "durations must be above 0 and finite, got -1 to 1"),
        ((2.0, 1.0), "durations must increase, got 2 and 1"),
        ((1.0, 1.0), "durations must increase"),
        ((1.0, inf), "durations must be above 0 and finite, got 1 to inf"),
        ((np.nan, 1.0), "durations must be a number, got nan"),
        ((1.0,), "durations must be two numbers"),
        (3.0, "durations must be two numbers"),
    ],
)
@pytest.mark.parametrize("hold", ["shape", "waypoints"])
def test_durations_that_are_none(durations, message, hold):
    with pytest.raises(ValueError, match=message):
        fastest(MOVE, {"y_d1": 1.0}, durations=durations, hold=hold)


# What is rejected


@pytest.mark.parametrize("hold", ["time", "", None])
def test_unknown_holds(hold):
    with pytest.raises(ValueError, match=f"hold must be one of shape, waypoints, path, got {hold!r}"):
        fastest(MOVE, {"y_d1": 1.0}, hold=hold)


@pytest.mark.parametrize("hold", ["shape", "waypoints", "path"])
@pytest.mark.parametrize(
    ("limits", "error", "message"),
    [
        ({"y_d1": -1.0}, ValueError, "limits of y_d1 must be finite and above 0, got -1"),
        ({"y_d1": np.nan}, ValueError, "limits of y_d1 must be finite and above 0, got nan"),
        ({"y_d1": (1.0, -1.0)}, ValueError, "limits of y_d1 must increase, got 1 and -1"),
        ({"F": 1.0}, ValueError, "no system was given"),
        ({"y_d4": 1.0}, ValueError, "limits of y_d4 require a plan that is continuous up to derivative 3"),
        ({}, ValueError, "limits must name at least one signal, got none"),
        (None, TypeError, "limits must be a mapping"),
        ({"y_d1": "1"}, TypeError, "limits of y_d1 must be a number"),
    ],
)
def test_wrong_limits(limits, error, message, hold):
    with pytest.raises(error, match=message):
        fastest(MOVE, limits, hold=hold)


def test_nothing_to_retime():
    with pytest.raises(ValueError, match="must have a duration, got a step"):
        fastest(cp.Step(1.0), {"y_d1": 1.0})
    with pytest.raises(TypeError, match=r"plan must be a Trajectory .*, got 1\.0"):
        fastest(1.0, {"y_d1": 1.0})


@pytest.mark.parametrize("hold", ["shape", "waypoints", "path"])
@pytest.mark.parametrize("position", [0.0, 1.0, -1e5])
def test_a_plan_that_does_not_move(position, hold):
    still = cp.PolySpline([Waypoint(0, position, 0, 0), Waypoint(1, position, 0, 0)])
    with pytest.raises(ValueError, match="plan must move, got constant axes"):
        fastest(still, {"velocity": 1.0, "acceleration": 1.0}, hold=hold)


@pytest.mark.slow
def test_a_search_that_ends_where_limits_come_nearer_says_so():
    far = cp.PolySpline([Waypoint(0, 0, 0.1), Waypoint(1, 20, 0.1)])
    with pytest.raises(ValueError, match=r"from 0.01562 to 64 s, got none.* for a wider search pass durations="):
        fastest(far, {"velocity": 0.2}, hold="waypoints", durations=(1 / 64, 64.0))
    for durations in ((10.0, 1000.0), None):
        found = fastest(far, {"velocity": 0.2}, hold="waypoints", durations=durations)
        # y' is 0.1 at the ends and 1.5 d/T - 0.05 in the middle.
        assert found.duration == pytest.approx(1.5 * 20 / 0.25, rel=1e-9)
    # It arrives from above, from at least 1 + 1/(2 * 1): between very short and very long durations is the nearest.
    inside = cp.PolySpline([Waypoint(0, 0, 1, 0), Waypoint(1, 1, -1, 0)])
    with pytest.raises(ValueError, match=r"got none; nearest at [0-9.]+ s: y[^;]*$"):
        fastest(inside, {"y": (-0.1, 1.05), "y_d2": 1.0}, hold="waypoints", durations=(0.1, 50.0))


# The report


@pytest.mark.slow
def test_report():
    found = fastest(MOVE, {"y_d1": 0.5, "y_d2": 2.0})
    text = " ".join(str(found).split())
    assert text.startswith("Fastest plan at fixed shape: 3.75 s, active limit y_d1 minimum duration 3.75 s ")
    assert "active limit y_d1 within ±0.5, at 1.875 s feasible durations from 3.75 s" in text
    assert re.search(r"y_d1 within ±0.5 0.5 1.875 0 % y_d2 within ±2 \S+ \S+ 79.5 %$", text)
    assert repr(found) == "<Fastest plan at fixed shape: 3.75 s, active limit y_d1>"
    html = found._repr_html_()
    assert "<dd>3.75 s</dd>" in html
    assert html.count("<tr>") == 3
    peak = 10 / sqrt(3) / 3.75**2
    assert found.margins.rows[1].fraction == pytest.approx(1 - peak / 2.0, rel=1e-10)


def test_report_is_that_of_margins():
    found = fastest(HOIST, CRANE_LIMITS["drives"], CRANE)
    assert str(found.margins) == str(margins(found.plan, CRANE_LIMITS["drives"], CRANE))


def test_figure():
    import matplotlib.pyplot as plt

    drawn = fastest(HOIST, {"F": 3e4, "x_d1": 5.0}, CRANE).plot()
    assert drawn.axes.shape == (2, 1)
    plt.close(drawn.figure)


PROFILES = {
    "s_curve": cp.SCurve(4.0, velocity=1.0, acceleration=0.5, jerk=0.5),
    "trapezoid": cp.Trapezoid(4.0, velocity=1.0, acceleration=0.5),
    "two s-curves": cp.SCurve(4.0, velocity=1.0, acceleration=0.5, jerk=0.5).then(
        cp.SCurve(0.0, 4.0, velocity=1.0, acceleration=0.5, jerk=0.5)
    ),
    "natural cubic": NaturalCubic([Waypoint(0, 0), Waypoint(2, 3), Waypoint(5, 4)]),
}


@pytest.mark.parametrize("name", PROFILES)
def test_plans_of_every_kind_are_retimed(name):
    """With fixed shape the speed scales with the reciprocal of the duration."""
    plan = PROFILES[name]
    found = fastest(plan, {"velocity": 0.8})
    peak = np.abs(plan(np.linspace(plan.start, plan.end, 200_001), 1)).max()
    assert found.duration == pytest.approx(plan.duration * peak / 0.8, rel=1e-6)
    assert type(found.plan) is type(plan)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["s_curve", pytest.param("natural cubic", marks=pytest.mark.slow)])
def test_a_time_law_is_found_for_plans_of_every_kind(name):
    plan = PROFILES[name]
    uniform, path = (fastest(plan, {"velocity": 0.8}, hold=hold).duration for hold in ("shape", "path"))
    length = np.ptp(plan([plan.start, plan.end]))  # both rise from end to end
    assert length / 0.8 <= path <= uniform * (1.0 + 1e-9)


@pytest.mark.parametrize("name", ["s_curve", "trapezoid", "two s-curves"])
def test_waypoints_are_held_only_of_what_is_made_through_them(name):
    plan = PROFILES[name]
    with pytest.raises(TypeError, match=rf"plan must be a WaypointSpline, .*, got a {type(plan).__name__}"):
        fastest(plan, {"velocity": 0.8}, hold="waypoints")


def test_a_shaped_plan_says_that_its_delays_would_change():
    shaped = cp.Shaper.zv(2.0)(PROFILES["s_curve"])
    with pytest.raises(ValueError, match="delays of the shaper would change"):
        fastest(shaped, {"velocity": 0.8})
    assert cp.margins(shaped, {"velocity": 1.0}).satisfied


TURN = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(2, 6.28, 0, 0, 0)])


@pytest.mark.parametrize(
    ("name", "system", "hold"),
    [
        ("u", lambda jet: {"u": jet[1, 0] + 0.05 * jet[2, 0]}, "shape"),
        ("u", ct.tf([0.05, 1, 0], [1e-4, 0.02, 1], inputs="r", outputs="u"), "shape"),
        ("y_d2", None, "waypoints"),
        pytest.param("u", lambda jet: {"u": jet[2, 0]}, "path", marks=pytest.mark.slow),
    ],
)
def test_a_violation_at_every_duration_is_not_rounding_of_a_slow_plan(name, system, hold):
    """Before its end the move brakes: y'' exceeds every multiple of y' there, at any duration.

    The violation in the message is that of the given plan, in 2 s.
    """
    with pytest.raises(
        ValueError, match=rf"got a violation that tends to 0 only with .* plan: {name} from 0 to 24: -\d"
    ) as error:
        cp.fastest(TURN, {name: (0.0, 24.0)}, system, hold=hold)
    if hold == "waypoints":
        lowest = TURN(np.linspace(0.0, 2.0, 20_001), 2).min()
        assert f": {lowest:.6g} at" in str(error.value)


def test_a_limit_that_is_touched_at_rest_and_crossed_at_a_duration():
    """u = v (3 - v) is negative where the peak of v, 2.1875 d/T of a septic, exceeds 3."""
    found = cp.fastest(TURN, {"u": (0.0, 24.0)}, lambda jet: {"u": jet[1, 0] * (3.0 - jet[1, 0])})
    assert found.duration == pytest.approx(2.1875 * 6.28 / 3.0, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("durations", "begin"), [(None, "^"), ((5.0, 9.0), "^the plan must be .*got none; at 9 s: ")])
def test_a_plan_that_is_infeasible_for_the_plant_at_every_duration_says_why(durations, begin):
    """Two tanks, one after the other: the level of the second one cannot fall below its outlet."""
    pytest.importorskip("casadi")

    def update(t, x, u, params):
        first, second = np.sqrt(x[0]), np.sqrt(x[1])
        return [u[0] - first, first - second]

    tanks = ct.nlsys(update, None, states=["h1", "h2"], inputs=["q"], outputs=["h1", "h2"], name="tanks")
    flat = cp.flat_system(tanks, "h2", at={"h2": 0.2})
    plan = cp.PolySpline([cp.Waypoint(0, 0.2, 0, 0), cp.Waypoint(9, -0.1, 0, 0)], labels=["h2"])
    with pytest.raises(ValueError, match=begin + "states of tanks must .* h1 is not determined by the flat outputs"):
        cp.fastest(plan, {"q": 1.0}, flat, durations=durations)


HIGH = [Waypoint.from_jets(t, x=[x, 0, 0, 0, 0], z=[z, 0, 0, 0, 0]) for t, x, z in ((0, 0, -10), (15, 20, -8))]


@pytest.mark.parametrize("function", [fastest, margins])
def test_a_load_above_the_trolley_is_rejected(function):
    with pytest.raises(ValueError, match=r"rope length R must be above 0, got .* m.*below the trolley"):
        function(cp.PolySpline(HIGH), {"F": 5e3}, cp.plants.Crane())


def test_a_plan_that_winds_up_the_rope_is_rejected_at_every_duration():
    ends = [Waypoint.from_jets(t, x=[x, 0, 0, 0, 0], z=[z, 0, 0, 0, 0]) for t, x, z in ((0, 0, 10), (15, 20, -1))]
    with pytest.raises(ValueError, match="rope length R must be above 0"):
        fastest(cp.PolySpline(ends), {"F": 5e3}, cp.plants.Crane())


@pytest.mark.parametrize("limits", [{"velocity": 1.0}, {"velocity": 10.0, "acceleration": 2.0}])
def test_waypoints_that_violate_limits_at_every_duration_are_named(limits):
    moving = cp.PolySpline([Waypoint(0, 0, 3.0, 5.0), Waypoint(1, 1, 0, 0)])
    with pytest.raises(
        ValueError, match=r"at the waypoints, at any duration, got y_d[12] = [35] of the waypoint at 0 s"
    ):
        fastest(moving, limits, hold="waypoints")


def test_a_plant_in_place_of_its_flat_system_is_named():
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
    double = ct.ss([[0, 1], [0, 0]], [[0], [1]], np.eye(2), 0, inputs="u", outputs=["y", "v"], name="double")
    with pytest.raises(ValueError, match=r"taken for a loop with the plan as input u.* system=cp\.flat_system\("):
        fastest(plan, {"u": 5.0}, double)
    with pytest.raises(TypeError, match="got the class Crane"):
        fastest(plan, {"F": 5.0}, cp.plants.Crane)


@pytest.mark.parametrize("tail", [-1.0, float("nan")])
def test_a_tail_is_checked_without_a_loop(tail):
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
    with pytest.raises(ValueError, match="tail must be"):
        fastest(plan, {"velocity": 1.0}, tail=tail)


def test_magnitudes_next_to_pairs():
    move = cp.PolySpline([cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(1, [1, 2], 0, 0)])
    with pytest.raises(ValueError, match=r"got \[1, \(-2, 1\)\]; give a pair for every axis, \(-a, a\) instead"):
        cp.fastest(move, {"velocity": [1, (-2, 1)]})
    with pytest.raises(ValueError, match=r"limits of y1_d1 must be a number or a pair of numbers, got \[1, \(-2, 1\)"):
        cp.fastest(move, {"y1_d1": [1, (-2, 1)]})


def test_a_jerk_of_one_sign_that_no_law_has():
    """From rest to rest the jerk has both signs."""
    move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    with pytest.raises(ValueError, match="limits of y_d3 must allow both signs unless a time law on the path has one"):
        cp.fastest(move, {"y_d3": (0, 5)}, hold="path")


def test_the_smallest_velocities_at_the_ends_are_rest_on_the_path():
    """Without warnings of numpy: 1 m with 5 m/s^2 up to 2 m/s takes 1/2 + 2/5 s."""
    move = cp.PolySpline([cp.Waypoint(0, 0, 1e-160, 0), cp.Waypoint(1, 1, 1e-160, 0)])
    assert cp.fastest(move, {"y_d1": 2.0, "y_d2": 5.0}, hold="path").duration == pytest.approx(0.9, rel=0.005)


@pytest.mark.parametrize("limit", [1e-6, 1e-9, 1e-15])
def test_a_given_plan_that_alone_satisfies_the_limits_is_found(limit):
    """A move at constant velocity 1, prescribed at both ends: no acceleration at its own duration only."""
    plan = cp.PolySpline([cp.Waypoint(0, 0, 1, 0), cp.Waypoint(1, 1, 1, 0)])
    found = cp.fastest(plan, {"acceleration": limit}, hold="waypoints")
    assert found.margins.satisfied
    assert found.duration == pytest.approx(1.0, abs=limit)
