"""The algebra of trajectories: sums, multiples, stacks, joins, steps, and all of them inside each other."""

import numpy as np
import pytest
from trajectory_oracle import waypoints

from ctrlplan.trajectories import (
    Joined,
    PiecewiseSpline,
    PolySpline,
    Scaled,
    Stacked,
    Step,
    Sum,
    TrigSpline,
    Waypoint,
    stack,
)

T = np.linspace(-1.0, 6.0, 281)
MOVE = PolySpline(waypoints([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
WAVE = TrigSpline(waypoints([0.5, 2.0, 3.0], [[1.0, 2.0], [-1.0, 0.3], [0.5, -1.0]]), alpha=3.0)
SEGMENTS = PiecewiseSpline(waypoints([1.0, 2.0, 2.5], [[0.0, 1.0], [2.0, 0.0], [-1.0, 0.5]]), alpha=1.0)


def quintic(t):
    """The jet of MOVE in closed form: held outside, derivatives 0 there, the end its own."""
    u, inside = np.clip(t, 0, 1), (t >= 0) & (t <= 1)
    rows = [
        u**3 * (10 - 15 * u + 6 * u**2),
        30 * u**2 * (1 - u) ** 2 * inside,
        60 * u * (1 - u) * (1 - 2 * u) * inside,
        (60 - 360 * u + 360 * u**2) * inside,
    ]
    return np.array(rows)


def test_held_outside_and_zero_derivatives():
    np.testing.assert_allclose(MOVE.jet(T, 3)[:, 0], quintic(T), rtol=0, atol=1e-13)
    for plan in (MOVE, WAVE, SEGMENTS):
        before, after = [-np.inf, -1e300, plan.start - 1e-9], [plan.end + 1e-9, 1e300, np.inf]
        for nu in range(1, 5):
            np.testing.assert_array_equal(plan(before + after, nu), 0)
        np.testing.assert_array_equal(plan(before), plan(plan.start))
        np.testing.assert_array_equal(plan(after), plan(plan.end))
        np.testing.assert_array_equal(plan.initial, [plan(plan.start)])
        np.testing.assert_array_equal(plan.final, [plan(plan.end)])


def test_the_start_and_the_end_belong_to_the_plan():
    """Third derivatives of minimum jerk: 60 at both ends, 0 beyond; from the left 0 at the start, 60 at the end."""
    assert MOVE(0.0, 3) == pytest.approx(60)
    assert MOVE(1.0, 3) == pytest.approx(60)
    assert MOVE(np.nextafter(0, -1), 3) == MOVE(np.nextafter(1, 2), 3) == 0
    assert MOVE.jet(0.0, 3, left=True)[3, 0] == 0
    assert MOVE.jet(1.0, 3, left=True)[3, 0] == pytest.approx(60)
    assert MOVE.jet(0.0, 3, left=True)[0, 0] == MOVE(0.0)


def test_an_inner_breakpoint_belongs_to_what_follows():
    first, second = SEGMENTS.segments
    for found, own in (
        (SEGMENTS.jet(2.0, 3), second.jet(2.0, 3)),
        (SEGMENTS.jet(2.0, 3, left=True), first.jet(2.0, 3)),
    ):
        np.testing.assert_allclose(found, own, rtol=0.0, atol=16 * np.finfo(float).eps * np.abs(own).max())
    assert not np.allclose(first.jet(2.0, 3), second.jet(2.0, 3))
    inside = np.array([1.0 + 1e-9, 1.5, 2.2])
    np.testing.assert_array_equal(SEGMENTS.jet(inside, 3), SEGMENTS.jet(inside, 3, left=True))


def off_breakpoints(*plans):
    """Times at which no plan jumps."""
    return np.setdiff1d(T, np.concatenate([p.breakpoints for p in plans]))


def test_sum_difference_and_multiple():
    t = off_breakpoints(WAVE, SEGMENTS)
    a, b = WAVE.jet(t, 3), SEGMENTS.jet(t, 3)
    np.testing.assert_allclose((WAVE + SEGMENTS).jet(t, 3), a + b, rtol=0, atol=1e-12)
    np.testing.assert_allclose((WAVE - SEGMENTS).jet(t, 3), a - b, rtol=0, atol=1e-12)
    np.testing.assert_array_equal((2 * WAVE).jet(t, 3), 2 * a)
    np.testing.assert_array_equal((WAVE * -0.5).jet(t, 3), -0.5 * a)
    np.testing.assert_array_equal((-WAVE).jet(t, 3), -a)
    np.testing.assert_array_equal((np.float64(2) * WAVE).jet(t, 3), 2 * a)
    np.testing.assert_array_equal(Sum([WAVE, WAVE, WAVE]).jet(t, 2), (3 * WAVE).jet(t, 2))
    np.testing.assert_array_equal((WAVE - WAVE).jet(T, 3), 0)
    assert isinstance(WAVE + SEGMENTS, Sum)
    assert isinstance(2 * WAVE, Scaled)


def test_a_sum_spans_its_parts():
    total = WAVE + SEGMENTS
    assert (total.start, total.end) == (0.5, 3.0)
    np.testing.assert_array_equal(total.breakpoints, [0.5, 1.0, 2.0, 2.5, 3.0])
    np.testing.assert_array_equal(total.initial, WAVE.initial + SEGMENTS.initial)
    np.testing.assert_array_equal(total.final, WAVE.final + SEGMENTS.final)
    for t in (1.0, 2.0, 2.5):  # right-continuous, the other limit on request
        right, left = total.jet(t + 1e-12, 1), total.jet(t - 1e-12, 1)
        np.testing.assert_allclose(total.jet(t, 1), right, rtol=0, atol=1e-9)
        np.testing.assert_allclose(total.jet(t, 1, left=True), left, rtol=0, atol=1e-9)
    # SEGMENTS ends at 2.5, inside the sum: what follows is its held position, of derivative 0.
    np.testing.assert_allclose(total.jet(2.5, 2)[1:], WAVE.jet(2.5, 2)[1:], rtol=1e-12)


def test_labels_of_combinations():
    x, z = Step(1.0, labels="x"), Step(2.0, labels="z")
    assert stack([x, z]).labels == ("x", "z")
    assert stack([x, z], labels=["a", "b"]).labels == ("a", "b")
    assert stack([MOVE, WAVE]).labels == ("y1", "y2")
    assert stack([stack([MOVE, WAVE]), SEGMENTS]).labels == ("y1", "y2", "y3")
    assert (x + MOVE).labels == ("x",)
    assert (3 * x).labels == ("x",)
    assert x.then(1.0 * Step(3.0, initial=1.0)).labels == ("x",)


def test_stack_combines_axes():
    t = off_breakpoints(MOVE, WAVE, SEGMENTS)
    both = stack([MOVE, WAVE, SEGMENTS])
    assert isinstance(both, Stacked)
    assert both.naxes == 3
    assert (both.start, both.end) == (0.0, 3.0)
    np.testing.assert_allclose(both(t), [MOVE(t), WAVE(t), SEGMENTS(t)], rtol=0, atol=1e-14)
    np.testing.assert_allclose(both(t, 2), [MOVE(t, 2), WAVE(t, 2), SEGMENTS(t, 2)], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(both.initial, [0.0, *WAVE.initial, *SEGMENTS.initial])


def test_then_shifts_the_other():
    back = PolySpline(waypoints([7.0, 9.0], [[1.0, 0.0, 0.0], [0.25, 0.0, 0.0]]))
    joined = MOVE.then(back)
    assert isinstance(joined, Joined)
    assert (joined.start, joined.end) == (0.0, 3.0)
    np.testing.assert_array_equal(joined.breakpoints, [0.0, 1.0, 3.0])
    t = np.linspace(0, 1, 11)
    np.testing.assert_array_equal(joined(t[:-1]), MOVE(t[:-1]))
    # Times near 9 s are rounded, which costs velocity times spacing; so are the terms of the plan, each at most 1.
    rounding = back.peak(1).max() * np.spacing(9.0) + 16 * np.finfo(float).eps
    np.testing.assert_allclose(joined(1 + 2 * t), back(7 + 2 * t), rtol=0, atol=rounding)
    np.testing.assert_allclose(joined(1.0, 3), back(7.0, 3))
    np.testing.assert_array_equal(joined.jet(1.0, 3, left=True), MOVE.jet(1.0, 3))
    assert joined(10.0) == 0.25
    assert [w.time for w in joined.waypoints] == [0.0, 1.0, 3.0]


def test_then_from_any_start_time():
    """A plan from 1e9 s is joined to one that ends at 0.7 s up to the rounding of its times, and shifts with it."""
    rng = np.random.default_rng(1)
    for start in rng.uniform(-2, 2, 50) * 10.0 ** rng.integers(0, 10, 50):
        end = rng.uniform(0.01, 1)
        first = PolySpline(waypoints([0.0, end], [[0.0, 0.0], [1.0, 0.0]]))
        second = PolySpline(waypoints([start, start + 1], [[1.0, 0.0], [2.0, 1.0]]))
        joined = first.then(second)
        assert joined.breakpoints[1] == end
        t = np.linspace(0, 1, 11)
        resolution = 4 * np.spacing(abs(start) + 1)
        np.testing.assert_allclose(joined(end + t), second(start + t), rtol=0, atol=1e-13 + 3 * resolution)
        for moved in (joined.shift(1e6 * end), joined.shift(1e6 * end).shift(-1e6 * end), joined.retime(777 * end)):
            assert moved.initial == 0.0
            assert moved.final == pytest.approx(2.0, rel=1e-8)
            assert moved.breakpoints.size == 3


@pytest.mark.parametrize("alpha", [0.0, 1.0, 3.0])
def test_a_plan_that_returns_to_zero_can_be_continued(alpha):
    """Its last position is 0 to rounding, which is no reason to reject a plan that starts at 0."""
    rng = np.random.default_rng(0)
    for value in rng.normal(size=20):
        home = waypoints([0.0, 0.3, 1.0], [[value, 1.0], [2.0], [0.0, 0.5]])
        joined = TrigSpline(home, alpha=alpha).then(MOVE)
        assert joined(2.0) == 1.0


def test_positions_that_differ_are_rejected():
    with pytest.raises(
        ValueError, match=r"positions must agree where trajectories join, got \[0.0\] after \[1.0\] at 1 s"
    ):
        MOVE.then(MOVE)
    near = PolySpline(waypoints([0.0, 1.0], [[1 + 1e-10], [2.0]]))
    assert MOVE.then(near).end == 2.0
    with pytest.raises(ValueError, match="positions must agree"):
        MOVE.then(PolySpline(waypoints([0.0, 1.0], [[1 + 1e-6], [2.0]])))
    with pytest.raises(ValueError, match="same number of axes"):
        MOVE.then(stack([MOVE, MOVE]))


def test_step_jumps_at_its_time():
    step = Step([1.0, -2.0], initial=[0.5, 3.0], time=2.0)
    assert (step.start, step.end, step.duration) == (2.0, 2.0, 0.0)
    np.testing.assert_array_equal(step([1.0, np.nextafter(2, 0), 2.0, 3.0]), [[0.5, 0.5, 1, 1], [3, 3, -2, -2]])
    np.testing.assert_array_equal(step.jet(2.0, 2, left=True), [[0.5, 3.0], [0, 0], [0, 0]])
    np.testing.assert_array_equal(step.jet([1.0, 2.0, 3.0], 3)[1:], 0)
    assert Step(1.0)(0.0) == 1.0
    assert Step(1.0)(-1e-300) == 0.0
    np.testing.assert_array_equal(step.shift(1.0)([2.5, 3.0]), [[0.5, 1], [3, -2]])
    with pytest.raises(ValueError, match="must have a duration to be retimed"):
        step.retime(1.0)


def test_steps_join_and_add():
    stairs = Step(1.0).then(Step(3.0, initial=1.0, time=9.0)) + Step(1.0, time=2.0)
    np.testing.assert_array_equal(stairs([-1, 0, 1, 2, 3]), [0, 3, 3, 4, 4])
    late = MOVE.then(Step(2.0, initial=1.0)).then(
        Step(5.0, initial=2.0).then(2.5 * MOVE + Step(2.5, 5.0, time=-1.0)) * 1.0
    )
    assert late(0.5) == MOVE(0.5)


def test_a_step_between_two_moves():
    """Up 1, jump to 3, up 1: breakpoints once, the jump with what follows."""
    lifted = MOVE + Step(3.0, initial=3.0)
    plan = MOVE.then(Step(3.0, initial=1.0)).then(lifted)
    np.testing.assert_array_equal(plan.breakpoints, [0.0, 1.0, 2.0])
    np.testing.assert_allclose(plan([0.0, 0.5, 1.0, 1.5, 2.0, 9.0]), [0, 0.5, 3, 3.5, 4, 4], rtol=1e-15)
    assert plan.jet(1.0, 0, left=True)[0, 0] == pytest.approx(1.0)
    found = plan.extrema()
    assert (found.minimum[0], found.maximum[0]) == (0.0, pytest.approx(4.0))


def test_a_step_inside_a_sum():
    """The step's instant is a breakpoint; the left limit is the value before it."""
    plan = SEGMENTS + Step(10.0, initial=1.0, time=1.7)
    np.testing.assert_array_equal(plan.breakpoints, [1.0, 1.7, 2.0, 2.5])
    t = np.array([1.2, 1.7, 2.3])
    np.testing.assert_allclose(plan(t), SEGMENTS(t) + np.array([1, 10, 10]), rtol=1e-14)
    assert plan.jet(1.7, 0, left=True)[0, 0] == pytest.approx(SEGMENTS(1.7) + 1, rel=1e-14)
    np.testing.assert_allclose(plan(t, 1), SEGMENTS(t, 1), rtol=1e-13)


@pytest.mark.parametrize("time", [0.0, 1.0])
def test_a_step_at_an_end_of_a_sum(time):
    """From its time on the step has its final position, at the sum's own end too."""
    plan = MOVE + Step(10.0, time=time)
    assert plan(time) == MOVE(time) + 10.0
    assert plan(time + 1e-9) == pytest.approx(MOVE(time) + 10.0)
    assert plan(time - 1e-9) == pytest.approx(MOVE(time))


def nested():
    """A shifted multiple and a step, stacked with segments joined to a retimed wave."""
    first = 2 * WAVE.shift(0.25) + Step(4.0, initial=1.0, time=2.0)
    rest = TrigSpline(waypoints([0.0, 1.0], [[-1.0, 0.5], [3.0, 0.0]]), alpha=2.0)
    return stack([first, SEGMENTS.then(rest.retime(2.0))])


def naive(t):
    """What `nested` is, from its leaves."""
    rest = TrigSpline(waypoints([0.0, 1.0], [[-1.0, 0.5], [3.0, 0.0]]), alpha=2.0)
    step = np.where(t >= 2.0, 4.0, 1.0)
    late = np.array([np.where(t >= 2.5, rest((t - 2.5) / 2, nu) / 2**nu, SEGMENTS(t, nu)) for nu in range(3)])
    early = 2 * np.array([WAVE(t - 0.25, nu) for nu in range(3)])
    early[0] += step
    return np.stack([early, late], axis=1)


def test_nested_combinations():
    plan = nested()
    t = np.setdiff1d(T, plan.breakpoints)
    np.testing.assert_allclose(plan.jet(t, 2), naive(t), rtol=0, atol=1e-12)
    # 0.75 and 3.25 of the wave; 1, 2, 2.5 and 4.5 of the segments; 2 of the step.
    np.testing.assert_allclose(plan.breakpoints, [0.75, 1.0, 2.0, 2.5, 3.25, 4.5], rtol=1e-15)


def test_nested_combinations_move_as_one():
    plan = nested()
    t = np.setdiff1d(T, plan.breakpoints)
    np.testing.assert_allclose(plan.shift(16.0).jet(t + 16.0, 2), plan.jet(t, 2), rtol=0, atol=1e-11)
    slow = plan.retime(2 * plan.duration)
    moved = plan.start + 2 * (t - plan.start)
    powers = 0.5 ** np.arange(3)[:, None, None]
    np.testing.assert_allclose(slow.jet(moved, 2), plan.jet(t, 2) * powers, rtol=0, atol=1e-12)
    assert (slow.start, slow.duration) == (plan.start, 2 * plan.duration)


def test_breakpoints_that_differ_by_rounding():
    """0.1 + 0.2 is not 0.3: a segment of 5e-17 s is valid."""
    a = PiecewiseSpline(waypoints([0.0, 0.3, 1.0], [[0.0, 0.0], [1.0, 2.0], [0.0, 0.0]]))
    b = PiecewiseSpline(waypoints([0.0, 0.1 + 0.2, 1.0], [[0.0, 0.0], [2.0, 0.0], [1.0, 0.0]]))
    total = a + b
    t = np.setdiff1d(np.linspace(0, 1, 101), total.breakpoints)
    np.testing.assert_allclose(total.jet(t, 2), a.jet(t, 2) + b.jet(t, 2), rtol=0, atol=1e-11)
    assert total.peak()[0] == pytest.approx((a + b.shift(0.0)).peak()[0])


def test_what_is_not_a_trajectory():
    for wrong in (1.0, "plan", None, np.ones(3)):
        with pytest.raises(TypeError):
            MOVE + wrong
    for wrong in ("2", None, [1.0], 1j):
        with pytest.raises(TypeError):
            MOVE * wrong
    with pytest.raises(TypeError, match=r"parts\[1\] must be a Trajectory, got int"):
        Sum([MOVE, 3])
    with pytest.raises(TypeError, match=r"parts\[1\] must be a Trajectory, got Waypoint"):
        stack([MOVE, Waypoint(0, 0)])


def test_a_far_origin_hides_no_jump():
    """1e-9 of 2^40 is 1100: what counts is the range of the positions, 1."""
    at = 2.0**40
    move = PolySpline([Waypoint(0, at, 0, 0), Waypoint(1, at + 1, 0, 0)])
    with pytest.raises(ValueError, match="positions must agree where trajectories join"):
        move.then(move)
    with pytest.raises(ValueError, match="positions must agree where trajectories join"):
        move.then(move + Step(1.01, 1.01))
    move.then(move + Step(1.0, 1.0))
    (jump,) = (move + Step(at + 0.0625, at, time=0.5)).jumps(0)
    assert (jump.order, jump.time, jump.size) == (0, 0.5, 0.0625)
