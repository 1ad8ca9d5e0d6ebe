"""Jumps of derivatives: where, of what, by how much."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.interpolate import CubicSpline, PPoly

import ctrlplan as cp


def listed(plan, order):
    return [(j.order, j.label, j.time) for j in plan.jumps(order)]


def quintic(a, b, first=(0.0, 0.0, 0.0), last=(1.0, 0.0, 0.0)):
    return cp.PolySpline([cp.Waypoint(a, *first), cp.Waypoint(b, *last)], labels=["y"])


def test_a_line_starts_and_stops_at_speed():
    line = cp.PolySpline([cp.Waypoint(1.0, [0.0, 3.0]), cp.Waypoint(5.0, [8.0, 1.0])], labels=["x", "z"])
    assert line.jumps(0) == ()
    found = line.jumps(3)
    assert [(j.order, j.label, j.time) for j in found] == [(1, "x", 1.0), (1, "z", 1.0), (1, "x", 5.0), (1, "z", 5.0)]
    assert [j.size for j in found] == pytest.approx([2.0, -0.5, -2.0, 0.5])


def test_minimum_jerk_jumps_in_jerk_at_both_ends():
    found = quintic(0.0, 2.0).jumps(3)
    # y''' = 60/T^3 at both ends
    assert [(j.order, j.time) for j in found] == [(3, 0.0), (3, 2.0)]
    assert [j.size for j in found] == pytest.approx([60 / 8, -60 / 8])
    assert quintic(0.0, 2.0).jumps(2) == ()


def test_lower_orders_come_first():
    found = listed(quintic(0.0, 2.0), 4)
    assert found == [(3, "y", 0.0), (3, "y", 2.0), (4, "y", 0.0), (4, "y", 2.0)]


def test_a_step_jumps_in_position_alone():
    (x, z) = cp.Step([2.0, 5.0], [0.0, 6.0], 1.5, labels=["x", "z"]).jumps(4)
    assert (x.order, x.label, x.time, x.size) == (0, "x", 1.5, 2.0)
    assert (z.order, z.label, z.time, z.size) == (0, "z", 1.5, -1.0)
    assert listed(cp.Step([2.0, 6.0], [0.0, 6.0], labels=["x", "z"]), 2) == [(0, "x", 0.0)]


def test_a_join_jumps_by_the_difference_of_its_sides():
    before = quintic(0.0, 1.0, last=(1.0, 0.5, 0.25))
    after = quintic(1.0, 3.0, (1.0, 0.5, -2.0), (4.0, 0.0, 0.0))
    found = [j for j in before.then(after).jumps(2) if j.time == 1.0]
    assert [(j.order, j.label) for j in found] == [(2, "y")]
    assert found[0].size == pytest.approx(-2.25)
    assert before.then(after).jumps(1) == ()


def test_an_interior_waypoint_of_one_polynomial_is_no_jump():
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 2, 1), cp.Waypoint(3, 1, 0, 0)])
    assert {j.time for j in plan.jumps(5)} == {0.0, 3.0}
    segments = cp.PiecewiseSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 2, 1, 0), cp.Waypoint(3, 1, 0, 0)])
    assert segments.jumps(2) == ()
    assert {j.time for j in segments.jumps(3)} == {0.0, 1.0, 3.0}


@pytest.mark.parametrize("entries", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("alpha", [None, 0.5, 3.0])
def test_rest_to_rest_is_smooth_as_far_as_it_prescribes(entries, alpha):
    points = [cp.Waypoint(t, y, *[0.0] * (entries - 1)) for t, y in ((0.0, -1.0), (7.0, 3.0))]
    plan = cp.PolySpline(points) if alpha is None else cp.TrigSpline(points, alpha=alpha)
    assert plan.jumps(entries - 1) == ()
    assert {j.order for j in plan.jumps(entries)} == {entries}


@given(st.floats(-1e5, 1e5), st.floats(0.01, 100.0), st.floats(1e-6, 1e6))
@examples(50)
def test_jumps_shift_with_time_and_scale_with_the_plan(shift, duration, factor):
    plan = factor * quintic(0.0, 1.0).retime(duration).shift(shift)
    first, last = plan.jumps(3)
    assert (first.order, last.order) == (3, 3)
    assert (first.time, last.time) == (plan.start, plan.end)
    size = 60 * factor / duration**3
    assert (first.size, last.size) == pytest.approx((size, -size), rel=1e-6)


@pytest.mark.parametrize("factor", [0.93, 0.99, 1.01, 1.1])
def test_rounding_is_relative_to_the_peak_of_the_derivative(factor):
    """The peak acceleration of minimum jerk, 10/sqrt(3), is between simple parts of the duration."""
    first = factor * 1e-9 * 10 / math.sqrt(3)
    found = listed(quintic(0.0, 1.0, first=(0.0, 0.0, first)), 2)
    assert found == ([(2, "y", 0.0)] if factor > 1.0 else [])


@pytest.mark.parametrize("order", [-1, 1.5, math.nan])
def test_order_must_be_a_count(order):
    with pytest.raises((ValueError, TypeError), match="order"):
        quintic(0.0, 1.0).jumps(order)


def of_samples(times, rows, continuity=None):
    if continuity is None:
        return cp.as_trajectory(CubicSpline(times, np.transpose(rows)))
    return cp.fit(times, rows, continuity=continuity)


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("continuity", [None, 1, 2, 3, 4])
def test_rounding_of_a_fitted_constant_or_line_does_not_jump(continuity, size, length):
    """The derivatives of a constant are of the order eps y/h^k, with differences as large."""
    x = np.linspace(0.0, 1.0, 157)
    rows = size * np.array([np.cos(9.0 * x), np.full(x.size, 0.37), 2.0 + 0.7 * x])
    plan = of_samples(length * x, rows, continuity)
    order = 2 if continuity is None else continuity
    found = [j for j in plan.jumps(order) if j.label != "y1" or plan.start < j.time < plan.end]
    assert {j.label for j in found if j.order == 1} == {"y3"}  # at both ends
    assert {(j.label, j.time) for j in found} == {("y3", plan.start), ("y3", plan.end)}
    assert {j.order for j in found} == {1}


@given(st.integers(0, 2**32 - 1))
@examples(40)
def test_smooth_fits_do_not_jump_inside(seed):
    rng = np.random.default_rng(seed)
    count, continuity = int(rng.integers(8, 300)), int(rng.integers(1, 5))
    times = np.cumsum(rng.uniform(0.3, 1.0, count))
    offset = 10.0 ** rng.uniform(-6.0, 6.0)
    rows = [offset + np.sin(times), np.full(count, offset), offset * (1.0 + times)]
    plan = cp.fit(times, rows, continuity=continuity)
    assert [j for j in plan.jumps(continuity) if plan.start < j.time < plan.end] == []


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("offset", [0.0, 11.0])
@pytest.mark.parametrize("duration", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_small_true_jumps_are_found_at_all_scales(size, duration, offset, order):
    state = [1.0 + offset, 0.8, -2.5, 4.0, 6.0]
    before = cp.PolySpline([cp.Waypoint(0.0, offset, 0, 0, 0, 0), cp.Waypoint(1.0, *state)])
    jump = 1e-8 * float(before.peak(order)[0])
    state[order] += jump
    after = cp.PolySpline([cp.Waypoint(1.0, *state), cp.Waypoint(2.0, offset, 0, 0, 0, 0)])
    plan = (size * before.then(after)).retime(2.0 * duration)
    (found,) = (j for j in plan.jumps(order) if plan.start < j.time < plan.end)
    assert (found.order, found.time) == (order, pytest.approx(duration))
    # The evaluation of both sides has rounding, relative to the size of the derivative.
    assert found.size == pytest.approx(size * jump / duration**order, rel=0.02)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_small_true_jumps_are_found_in_plans_of_many_segments(order):
    """Coefficients given exactly: jumps of 1e-6 of the peak, of segments of 1e-4 of the duration."""
    count, at = 10_000, 6_000
    breakpoints = np.linspace(0.0, 1.0, count + 1)
    jets = np.array([np.sin(3.0 * breakpoints[:-1] + k * np.pi / 2) * 3.0**k / math.factorial(k) for k in range(8)])
    added = 1e-6 * 3.0**order
    s = breakpoints[at:-1] - breakpoints[at]
    for k in range(order + 1):
        jets[k, at:] += added * s ** (order - k) / math.factorial(order - k) / math.factorial(k)
    plan = cp.as_trajectory(PPoly(jets[::-1, :, None], breakpoints))
    found = [j for j in plan.jumps(order) if plan.start < j.time < plan.end]
    assert [(j.order, j.time) for j in found] == [(order, breakpoints[at])]
    assert found[0].size == pytest.approx(added, rel=1e-4)


def test_true_jumps_of_an_axis_at_breakpoints_of_others_are_found():
    """Breakpoints of other axes that are nearly the same make short segments, which are no reason for rounding."""
    axes = [quintic(0.0, 1.0, last=(1.0, 0.5, 0.25)).then(quintic(1.0, 3.0, (1.0, 0.5, 0.25 + 1e-6), (4.0, 0.0, 0.0)))]
    axes += [
        quintic(0.0, time, last=(2.0, 0.0, 0.0)).then(quintic(time, 3.0, (2.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
        for time in (1.0 + 1e-9, 1.0 - 3e-12)
    ]
    found = [j for j in cp.stack(axes, labels=["y", "z1", "z2"]).jumps(2) if j.order == 2 and 0.0 < j.time < 3.0]
    assert [(j.label, j.time) for j in found] == [("y", 1.0)]


def test_a_step_beyond_the_rounding_of_a_distant_position_is_found():
    assert quintic(0.0, 1.0, (1e6, 0.0, 0.0), (1e6 + 1.0, 0.0, 0.0)).jumps(2) == ()
    found = cp.Step(1e6 + 1e-7, 1e6).jumps(2)
    assert [(j.order, j.time, j.size) for j in found] == [(0, 0.0, pytest.approx(1e-7, rel=1e-2))]


def test_jumps_are_computed_once(monkeypatch):
    line = cp.PolySpline([cp.Waypoint(0.0, 0.0), cp.Waypoint(4.0, 8.0)], labels=["y"])
    moved = line.retime(2.0)
    assert [j.size for j in line.jumps(1)] == pytest.approx([2.0, -2.0])
    evaluated = []
    segment_jet = cp.PolySpline.segment_jet
    monkeypatch.setattr(cp.PolySpline, "segment_jet", lambda *given: evaluated.append(given) or segment_jet(*given))
    assert [j.size for j in line.jumps(1)] == pytest.approx([2.0, -2.0])
    assert evaluated == []
    assert [j.size for j in moved.jumps(1)] == pytest.approx([4.0, -4.0])  # of another plan: found again
    assert evaluated != []
