"""Plans on the cycle of a drive: whole numbers of cycles, by rational arithmetic, and limits by closed forms."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ctrlplan as cp
from ctrlplan.trajectories import Joined, Waypoint


def rest(time, *position):
    return Waypoint(time, position, 0, 0)


def cycles_of(times, dt):
    """Whole numbers of cycles since the first time; they must be whole to the rounding of times."""
    counts = (np.asarray(times) - times[0]) / dt
    np.testing.assert_allclose(counts, np.rint(counts), atol=8 * np.spacing(np.abs(times).max()) / dt)
    return np.rint(counts).astype(int).tolist()


def knots(plan):
    return [w.time for w in plan.waypoints]


PATH = [Waypoint(0.2, [0, 1], 0, 0), Waypoint(1.234, [2, 1.5]), Waypoint(2.5, [3, 0], [0.1, -0.2]), rest(4.0, 1, 1)]
FAMILIES = {
    "polynomial": cp.PolySpline(PATH, warn=False),
    "trigonometric": cp.TrigSpline(PATH, alpha=2.0, warn=False),
    "piecewise": cp.PiecewiseSpline(PATH),
}


@pytest.mark.parametrize("plan", FAMILIES.values(), ids=FAMILIES)
@pytest.mark.parametrize("dt", [0.25, 0.1, 0.001, 2.0])
def test_waypoints_are_rounded_up_segment_by_segment(plan, dt):
    found = plan.on_cycle(dt)
    assert type(found) is type(plan)
    assert found.start == plan.start
    times = [Fraction(str(t)) for t in (0.2, 1.234, 2.5, 4.0)]
    expected = [math.ceil((b - a) / Fraction(str(dt))) for a, b in itertools.pairwise(times)]
    assert np.diff(cycles_of(knots(found), dt)).tolist() == expected
    for before, after in zip(plan.waypoints, found.waypoints, strict=True):
        np.testing.assert_array_equal(after.jet, before.jet)
        np.testing.assert_allclose(found(after.time), before.position, atol=1e-9)


@given(
    st.integers(1, 40), st.integers(1, 40), st.sampled_from(["0.1", "0.001", "0.3", "0.7", "1/3"]), st.integers(0, 3)
)
def test_a_plan_on_the_cycle_stays_as_it_is(first, second, cycle, decade):
    """Times are rounded: 3 * 0.1 is above 0.3, and differences near 1000 s have lost digits."""
    dt, start = Fraction(cycle), 10**decade - 1
    times = [float(start + k * dt) for k in (0, first, first + second)]
    plan = cp.PiecewiseSpline([rest(times[0], 0), rest(times[1], 1), rest(times[2], 3)])
    assert plan.on_cycle(float(dt)) is plan


def test_the_start_stays_and_a_step_too():
    step = cp.Step(1.0, time=0.123)
    assert step.on_cycle(0.1) is step
    assert cp.SCurve(1.0, velocity=1, acceleration=1, jerk=1, time=0.123).on_cycle(0.1).start == 0.123


def test_a_profile_is_retimed_as_a_whole():
    plan = cp.SCurve(4.0, velocity=1.1, acceleration=0.5, jerk=0.6)
    found = plan.on_cycle(0.1, {"velocity": 1.1, "acceleration": 0.5, "jerk": 0.6})
    assert 0.0 <= found.duration - plan.duration < 0.1
    assert cycles_of([found.start, found.end], 0.1) == [0, math.ceil(plan.duration / 0.1)]
    np.testing.assert_array_equal(found.final, plan.final)


def test_joined_plans_are_put_on_the_cycle_one_by_one():
    first, second = (
        cp.Trapezoid(1.0, velocity=1.0, acceleration=3.0),
        cp.Trapezoid(0.5, 1.0, velocity=0.7, acceleration=1),
    )
    found = first.then(second).on_cycle(0.1)
    assert isinstance(found, Joined)
    ends = [math.ceil(part.duration / 0.1) for part in (first, second)]
    assert cycles_of([found.start, found.parts[0].end, found.end], 0.1) == [0, ends[0], sum(ends)]
    assert found.on_cycle(0.1) is found


def test_a_cyclic_plan_keeps_its_waypoints_within_the_period():
    points = [Waypoint(0.0, 0.0), Waypoint(0.31, 1.0), Waypoint(0.55, -1.0)]
    found = cp.TrigSpline.cyclic(points, 1.01, warn=False).on_cycle(0.1)
    assert cycles_of([*knots(found), found.end], 0.1) == [0, 4, 7, 12]
    jets = found.jet([found.start, found.end], 3)
    np.testing.assert_allclose(jets[..., 0], jets[..., 1], atol=1e-9 * np.abs(jets).max())


# Limits

PEAKS = {1: 15 / 8, 2: 10 / math.sqrt(3), 3: 60.0}
"""Of the polynomial of degree 5 from 0 to 1 in 1 s, at rest at its ends: velocity, acceleration, jerk."""


def needed(distance, limits, dt, duration):
    """Cycles of the shortest such move within the limits, and no shorter than a duration."""
    shortest = max((PEAKS[k] * abs(distance) / limit) ** (1.0 / k) for k, limit in limits.items())
    return math.ceil(max(shortest, duration) / dt - 1e-9)


@given(st.floats(0.1, 10), st.floats(0.05, 5), st.floats(0.1, 20), st.floats(1, 500), st.floats(0.003, 0.3))
def test_a_move_gets_as_many_cycles_as_its_limits_need(distance, velocity, acceleration, jerk, dt):
    plan = cp.PolySpline([rest(1.0, 0.0), rest(2.0, distance)])
    limits = {"velocity": velocity, "y_d2": acceleration, "jerk": (-jerk, jerk)}
    # The jerk at rest jumps; a limit on it needs a continuous acceleration only, which this has.
    found = plan.on_cycle(dt, limits)
    expected = needed(distance, {1: velocity, 2: acceleration, 3: jerk}, dt, 1.0)
    assert cycles_of([found.start, found.end], dt)[1] == expected


def test_segments_from_rest_to_rest_are_lengthened_each_on_its_own():
    positions, dt = [0.0, 1.0, -2.0, -1.9], 0.05
    plan = cp.PiecewiseSpline([rest(0.5 * k, p) for k, p in enumerate(positions)])
    found = plan.on_cycle(dt, {"y_d1": 2.0, "y_d2": 8.0})
    expected = [needed(b - a, {1: 2.0, 2: 8.0}, dt, 0.5) for a, b in itertools.pairwise(positions)]
    assert np.diff(cycles_of(knots(found), dt)).tolist() == expected
    assert expected[2] == 10  # this one was slow enough


@pytest.mark.parametrize("plan", FAMILIES.values(), ids=FAMILIES)
def test_limits_are_satisfied_over_the_whole_plan(plan):
    limits = {"velocity": 1.5, "acceleration": [3.0, 2.0], "y1": (-0.5, 3.5)}
    found = plan.on_cycle(0.02, limits)
    cycles = np.diff(cycles_of(knots(found), 0.02))
    assert (cycles >= np.diff(cycles_of(knots(plan.on_cycle(0.02)), 0.02))).all()
    t = np.linspace(found.start, found.end, 20001)
    jet = found.jet(t, 2)
    assert (np.abs(jet[1]) <= 1.5 * (1 + 1e-8)).all()
    assert (np.abs(jet[2]) <= np.array([[3.0], [2.0]]) * (1 + 1e-8)).all()
    assert jet[0, 0].min() >= -0.5
    assert jet[0, 0].max() <= 3.5
    # The limit was not satisfied before, and no segment lasts far longer than some limit needs.
    assert np.abs(plan.jet(np.linspace(plan.start, plan.end, 2001), 2)[2]).max() > 3.0
    assert max(np.abs(jet[1]).max() / 1.5, np.abs(jet[2, 0]).max() / 3.0, np.abs(jet[2, 1]).max() / 2.0) > 0.8


def test_a_limit_that_is_just_satisfied_needs_no_cycle():
    plan = cp.PolySpline([rest(0.0, 0.0), rest(2.0, 1.0)])
    assert plan.on_cycle(0.5, {"y_d1": 15 / 16}) is plan


# Requests that cannot be met


@pytest.mark.parametrize("dt", [0.0, -1.0, math.inf, math.nan])
def test_a_cycle_is_above_0(dt):
    with pytest.raises(ValueError, match="dt must be finite and above 0, got"):
        FAMILIES["piecewise"].on_cycle(dt)


def test_a_cycle_that_times_cannot_resolve():
    with pytest.raises(ValueError, match=r"dt must divide the plan into fewer than 2\^53 cycles, got 1e-18 s in 3.8 s"):
        FAMILIES["piecewise"].on_cycle(1e-18)


def test_what_a_waypoint_prescribes_beyond_a_limit_is_named():
    message = r"y2_d1 must stay within ±0.15, got -0.2, which waypoints\[2\] prescribes at 2.5 s; no number of cycles"
    with pytest.raises(ValueError, match=message):
        FAMILIES["piecewise"].on_cycle(0.1, {"y1_d1": 5.0, "y2_d1": 0.15})


def test_a_segment_that_no_duration_helps_is_named():
    """Through 0, 1, 0 a natural path rises above 1 between prescribed speeds, however slow the rest is."""
    points = [rest(0, 0.0), Waypoint(1.0, 1.0, 0.5, 0.0), rest(2, 0.0)]
    message = (
        r"segment 1, from waypoints\[1\] to waypoints\[2\], must keep y at most 1.01, got a relative excess of .* "
        r"with a duration of .* s; no number of cycles of 0.1 s was found that satisfies the limits"
    )
    with pytest.raises(ValueError, match=message):
        cp.PiecewiseSpline(points, warn=False).on_cycle(0.1, {"y": cp.Limits(high=1.01)})


def test_the_part_of_a_joined_plan_is_named():
    way = cp.PiecewiseSpline([rest(0, 0.0), Waypoint(1.0, 1.0, 0.5, 0.0), rest(2, 0.0)])
    with pytest.raises(ValueError, match=r"parts\[1\] of a joined plan: y_d1 must stay within ±0.4, .* waypoints\[1\]"):
        cp.PolySpline([rest(0, 1.0), rest(9, 0.0)]).then(way).on_cycle(0.1, {"velocity": 0.4})


def test_a_limit_needs_the_continuity_of_margins():
    corner = cp.PiecewiseSpline([Waypoint(0, 0, 0), Waypoint(1, 1, 0), Waypoint(2, 0, 0)])
    with pytest.raises(ValueError, match="limits of y_d3 require a plan that is continuous up to derivative 2"):
        corner.on_cycle(0.1, {"y_d3": 10.0})


def test_waypoints_of_a_sum_cannot_be_moved():
    wave = cp.TrigSpline([rest(0, 0.0), Waypoint(0.33, 1.0), rest(1.0, 0.0)], alpha=1.0, warn=False)
    with pytest.raises(ValueError, match=r"waypoints of a Sum must be on the cycle .*got one at 0.33 s, 3.3 cycles"):
        (wave + wave).on_cycle(0.1)
    on = wave.on_cycle(0.1)
    both = 2.0 * on + on
    assert both.on_cycle(0.1) is both


def test_a_shaped_plan_keeps_its_duration():
    shaped = cp.Shaper.zv(3.0)(cp.SCurve(1.0, velocity=1, acceleration=1, jerk=1))
    with pytest.raises(ValueError, match=r"a shaped plan must keep its duration.*retime the plan first, then shape it"):
        shaped.on_cycle(0.1)
