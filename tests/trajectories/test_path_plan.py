"""Paths of vehicles with stops: geometry, parameter and time, what is rejected."""

import math

import numpy as np
import pytest
from parking import BACKWARD, FORWARD, curve, law, parking

import ctrlplan as cp

PLAN = parking()
T = np.linspace(-1.0, 12.0, 27)


def test_position_and_derivatives_by_the_chain_rule():
    for k, (start, end) in enumerate([(0.0, 5.0), (5.0, 11.0)]):
        t = np.linspace(start, end, 12)[1:-1]
        s = PLAN.laws[k].jet(t, 2)[:, 0]
        p = PLAN.segments[k].jet(s[0], 2)
        np.testing.assert_allclose(PLAN(t), p[0], rtol=1e-14)
        np.testing.assert_allclose(PLAN(t, 1), p[1] * s[1], atol=1e-13)
        np.testing.assert_allclose(PLAN(t, 2), p[2] * s[1] ** 2 + p[1] * s[2], atol=1e-12)


def test_parameter_and_curve_over_time():
    s, p = PLAN.path_jet(T, 3)
    assert (s.shape, p.shape) == ((4, 27), (4, 2, 27))
    for j, t in enumerate(T):
        k = 0 if t < 5.0 else 1
        np.testing.assert_allclose(s[:, j], PLAN.laws[k].jet(t, 3)[:, 0], rtol=1e-13, atol=1e-14)
        inside = PLAN.laws[k](t)  # 0 before the start, 1 after the end
        np.testing.assert_allclose(p[:, :, j], PLAN.segments[k].jet(inside, 3), rtol=1e-12, atol=1e-11)
    assert PLAN.path_jet(2.0, 0)[1].shape == (1, 2)
    assert PLAN.path_jet(np.zeros((2, 3)), 1)[0].shape == (2, 2, 3)
    assert PLAN.path_jet([], 1)[1].shape == (2, 2, 0)


def test_both_sides_of_a_stop_and_of_a_breakpoint_of_a_curve():
    two = cp.PiecewiseSpline(
        [cp.Waypoint(0, [0, 0], [1, 0]), cp.Waypoint(1, [1, 0.5]), cp.Waypoint(2, [2, 0], [1, -1])]
    )
    plan = cp.PathPlan(
        [two, curve((0, [2, -1, 0], [0, 1, 0]), (1, [1, -1], [2, 1]))], [1, -1], [law(4.0, 2.0), law(3.0)]
    )
    middle = float(plan.breakpoints[1])
    assert plan.laws[0](middle) == pytest.approx(1.0, abs=1e-12)
    for t, before, after in ((middle, (two, 1.0), (two, 1.0)), (4.0, (two, 2.0), (plan.segments[1], 0.0))):
        _, left = plan.path_jet(t, 5, left=True)
        _, right = plan.path_jet(t, 5)
        np.testing.assert_allclose(left, before[0].jet(before[1], 5, left=True), atol=1e-10)
        np.testing.assert_allclose(right, after[0].jet(after[1], 5), atol=1e-10)
    assert plan.directions == (1, -1)


def test_other_plans_of_the_same_kind():
    slow, late = PLAN.retime(22.0), PLAN.shift(3.0)
    assert [type(plan) for plan in (slow, late)] == [cp.PathPlan] * 2
    assert slow.stops == pytest.approx((0.0, 10.0, 22.0))
    assert late.stops == pytest.approx((3.0, 8.0, 14.0))
    np.testing.assert_allclose(slow.path_jet(2.0 * T, 1)[0][1], 0.5 * PLAN.path_jet(T, 1)[0][1], atol=1e-14)
    swapped = PLAN.select(["y", "x"])
    assert isinstance(swapped, cp.PathPlan)
    np.testing.assert_allclose(swapped(T), PLAN(T)[::-1], atol=1e-14)
    assert not isinstance(PLAN.select(["x"]), cp.PathPlan)
    cycles = PLAN.on_cycle(0.7)
    assert isinstance(cycles, cp.PathPlan)
    assert cycles.stops == pytest.approx((0.0, 5.6, 11.9))
    assert PLAN.on_cycle(0.5) is PLAN
    limited = PLAN.on_cycle(0.5, {"velocity": 2.0})
    assert isinstance(limited, cp.PathPlan)
    assert (limited.peak(1) <= 2.0).all()


def test_the_sequence_of_two_paths_is_a_path():
    out = cp.PathPlan([curve((0, [2, 0, 0], [-4, 9, 0]), (1, [2, 0], [0, 3]))], [1], law(2.0))
    both = PLAN.then(out)
    assert isinstance(both, cp.PathPlan)
    assert both.stops == pytest.approx((0.0, 5.0, 11.0, 13.0))
    assert both.directions == (1, -1, 1)
    hold = cp.PolySpline([cp.Waypoint(0, [2, -4]), cp.Waypoint(1, [2, -4])])
    assert not isinstance(PLAN.then(hold), cp.PathPlan)


@pytest.mark.parametrize(
    "time", [0.0, 7.0, 11.0, *(pytest.param(time, marks=pytest.mark.slow) for time in (3.0, 4.9, 5.0))]
)
def test_a_stop_on_the_path_is_a_path(time):
    """The plan until then, a point of the path at the end, reached before the next stop, within the limits."""
    limits = {"acceleration": 3.0, "jerk": 15.0}
    stopped = PLAN.stop(time, limits, synchronize="path")
    if time == 0.0:
        assert stopped.duration == 0.0
        return
    assert isinstance(stopped, cp.PathPlan)
    before = np.linspace(0.0, time, 9)[:-1]
    np.testing.assert_allclose(stopped(before), PLAN(before), atol=1e-12)
    assert stopped.end <= min(stop for stop in PLAN.stops if stop >= time) + 2.0
    s, p = stopped.path_jet(stopped.end, 1)
    assert abs(s[1]) <= 1e-9
    k = len(stopped.segments) - 1
    np.testing.assert_allclose(stopped.final, PLAN.segments[k](s[0]), atol=1e-12)
    assert np.hypot(*p[1]) > 1.0  # the heading is determined at the end
    after = np.linspace(time, stopped.end, 101)
    assert (np.abs(stopped(after, 2)) <= 3.0 * (1.0 + 1e-6)).all()
    again = cp.trajectory_from_dict(stopped.to_dict())
    np.testing.assert_array_equal(again(after), stopped(after))
    assert PLAN.stop(time, limits).to_dict() == stopped.to_dict()  # by default
    assert not isinstance(PLAN.stop(3.0, limits, synchronize="time"), cp.PathPlan)


def test_one_time_law_for_all_segments():
    plan = cp.PathPlan([FORWARD, BACKWARD], (1.0, -1.0), law(4.0), labels=["a", "b"])
    assert plan.stops == (0.0, 4.0, 8.0)
    assert plan.labels == ("a", "b")
    assert "backward" in str(plan)
    assert "0 s, 4 s, 8 s" in str(plan)


def test_one_time_law_through_all_segments():
    later = curve((1.0, [6, -5, 0, 0], [2, -5, 0, 0]), (2.0, [2, 0, 0, 0], [-4, -9, 0, 0]))
    whole = law(5.0).then(law(6.0, 2.0, 1.0))
    plan = cp.PathPlan([FORWARD, later], [1, -1], whole)
    assert plan.stops == (0.0, 5.0, 11.0)
    np.testing.assert_allclose(plan(T), PLAN(T), atol=1e-12)
    with pytest.raises(ValueError, match=r"law must be at rest at a breakpoint at the end .* at s = 1; join"):
        cp.PathPlan([FORWARD, later], [1, -1], law(11.0, 2.0))
    moving = cp.PiecewiseSpline([cp.Waypoint(0, 0, 0), cp.Waypoint(5, 1, 0.3), cp.Waypoint(11, 2, 0)])
    with pytest.raises(ValueError, match=r"law\[0\] must be at rest at its ends, got the rate"):
        cp.PathPlan([FORWARD, later], [1, -1], moving)


def test_headings_that_differ_at_a_cusp_are_named():
    with pytest.raises(
        ValueError,
        match=r"heading must be continuous at the stop at 5 s, got 0\.785398 rad \(45 degrees\) at the end of segments"
        r"\[0\] and -2\.35619 rad \(-135 degrees\) at the start of segments\[1\]; with directions\[1\] = -1 it is cont",
    ):
        cp.PathPlan([FORWARD, BACKWARD], [1, 1], [law(5.0), law(6.0)])
    turned = curve((0, [6, -1, 0], [2, 0, 0]), (1, [2, -1], [2, 0]))
    with pytest.raises(ValueError, match=r"\(45 degrees\) at the end of segments\[0\] and 0 rad .*segments\[1\]$"):
        cp.PathPlan([FORWARD, turned], [1, -1], law(5.0))


CORNER = cp.PiecewiseSpline(
    [cp.Waypoint(0, [0, 0], [1, 0]), cp.Waypoint(1, [1, 0], [1, 0]), cp.Waypoint(2, [1, 1])]
).then(cp.PolySpline([cp.Waypoint(0, [1, 1], [5, 0]), cp.Waypoint(1, [5, 5], [5, 5])]))
STANDING = curve((0, [0, 0, 0], [0, 0, 0]), (1, [1, 1], [0, 0]))
SLOWED = cp.PolySpline([cp.Waypoint(t, [x, 0], [v, 0]) for t, x, v in ((0, 0, 1), (1, 1, 0), (2, 2, 1))])
REST = law(5.0)


@pytest.mark.parametrize(
    ("segments", "directions", "laws", "error", "message"),
    [
        (FORWARD, [1], REST, TypeError, "segments must be a sequence of trajectories, got PolySpline"),
        (3, [1], REST, TypeError, "segments must be a sequence"),
        ([], [], REST, ValueError, "segments must contain at least one curve"),
        ([FORWARD, "left"], [1, 1], REST, TypeError, r"segments\[1\] must be a Trajectory, got str"),
        ([REST], [1], REST, ValueError, r"segments\[0\] must have two axes, got 1: y"),
        ([cp.Step([1.0, 2.0])], [1], REST, ValueError, r"segments\[0\] must be a curve over an interval"),
        ([STANDING], [1], REST, ValueError, r"segments\[0\] must have abs\(dp/ds\) above 0, got 0 at s = 0 and up to"),
        (
            [SLOWED],
            [1],
            law(1, 2),
            ValueError,
            r"segments\[0\] must have .* above 0, got .* at s = 1 and up to",
        ),
        (
            [CORNER],
            [1],
            law(1, 3),
            ValueError,
            r"continuously differentiable, got a jump of the deriv.* at s = 2",
        ),
        ([FORWARD], [1, -1], REST, ValueError, "directions must be one for each of 1 segments, got 2"),
        ([FORWARD], [0], REST, ValueError, r"directions\[0\] must be 1 \(forward\) or -1 \(backward\), got 0"),
        ([FORWARD], [math.nan], REST, ValueError, r"directions\[0\] must be 1 \(forward\)"),
        ([FORWARD], ["back"], REST, TypeError, r"directions\[0\] must be 1 or -1, got 'back'"),
        ([FORWARD], [True], REST, TypeError, r"directions\[0\] must be 1 or -1, got True"),
        ([FORWARD], [1], [REST, REST], ValueError, "law must be one trajectory for each of 1 segments, got 2"),
        ([FORWARD], [1], 5.0, TypeError, "law must be a Trajectory or one for each segment, got float"),
        ([FORWARD], [1], [5.0], TypeError, r"law\[0\] must be a Trajectory, got float"),
        (
            [FORWARD],
            [1],
            law(5, 2),
            ValueError,
            r"law\[0\] must be a time law of segments\[0\], its plan: law",
        ),
        ([FORWARD], [1], FORWARD, ValueError, r"law\[0\] .*: law must have one axis"),
        ([FORWARD], [1], law(5, 0, 1), ValueError, r"law\[0\] must be a time law of segments\[0\]"),
        (
            [FORWARD],
            [1],
            cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(5, 1)]),
            ValueError,
            r"law\[0\] must be at rest at its ends, got the rate 0\.4 at 5 s",
        ),
        ([FORWARD, FORWARD], [1, 1], REST, ValueError, r"positions must agree .*\[0.*\] after \[6.*\] at 5 s"),
    ],
)
def test_what_is_no_path(segments, directions, laws, error, message):
    with pytest.raises(error, match=message):
        cp.PathPlan(segments, directions, laws)


def test_labels_and_times_are_checked():
    with pytest.raises(ValueError, match="labels must be one per axis, 2, got 3"):
        cp.PathPlan([FORWARD], [1], REST, labels=["x", "y", "z"])
    with pytest.raises(ValueError, match="times must not be nan"):
        PLAN.path_jet([0.0, math.nan], 1)
    with pytest.raises(ValueError, match="order must be an integer"):
        PLAN.path_jet(0.0, -1)
