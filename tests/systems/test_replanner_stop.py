"""A replanner with the input `stop`: the stop of the plan, rest until it falls, and the way on."""

import warnings

import control as ct
import numpy as np
import pytest
from replanner_oracle import METHODS, PLAN, UNREACHABLE, happened, state_of

import ctrlplan as cp
from ctrlplan import Waypoint

LIMITS = {"acceleration": (-0.3, 0.2), "jerk": 1.0}
RUN = np.linspace(0.0, 14.0, 701)
TWO = cp.PiecewiseSpline(
    [
        Waypoint.from_jets(1.0, x=[0.0, 0.0, 0.0], z=[1.0, 0.0, 0.0]),
        Waypoint.from_jets(4.0, x=[2.0], z=[0.0]),
        Waypoint.from_jets(9.0, x=[3.0, 0.0, 0.0], z=[3.0, 0.0, 0.0]),
    ]
)


def pressed(first, last=1e3):
    """1 from the first time to the last."""
    return cp.Step(1.0, 0.0, first) - cp.Step(1.0, 0.0, last)


def quiet_stop(plan, time, limits, **options):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the limits of the stop are exceeded")
        return plan.stop(time, limits, **options)


def run(plan, inputs, method="python", **options):
    block = cp.create_replanner_iosystem(plan, 0.1, stop_limits=LIMITS, **options)
    return cp.simulate(block, RUN, inputs, method=method, rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("time", [0.33, 3.0, 5.05, 8.2])
@pytest.mark.parametrize("plan", [PLAN, TWO], ids=["one axis", "two axes"])
def test_it_is_the_stop_of_the_plan(plan, time, method):
    """From the next sample on; together, at the limits; the outputs are those of the plan's own method."""
    found = run(plan, {"stop": pressed(time)}, method, derivatives=3)
    begins = np.ceil(round(time / 0.1, 9)) * 0.1
    wanted = quiet_stop(plan, begins, LIMITS) if begins >= plan.start else plan.stop(plan.start, LIMITS)
    jets = wanted.jet(RUN, 3).transpose(1, 0, 2).reshape(found.outputs.shape)
    away = np.abs(RUN[:, None] - wanted.breakpoints).min(axis=1) > 1e-6  # the jerk jumps there
    assert np.abs((found.outputs - jets)[:, away]).max() <= 1e-12
    assert not found.outputs.reshape(plan.naxes, 4, -1)[:, 1:, -1].any()  # rest is exact
    assert found.events == []


@pytest.mark.parametrize("horizon", ["shrinking", 3.0])
def test_rest_is_held_until_it_falls(horizon):
    found = run(PLAN, {"stop": pressed(3.0, 6.05)}, horizon=horizon)
    stopped = quiet_stop(PLAN, 3.0, LIMITS)
    held = (stopped.end < RUN) & (RUN < 6.095)
    assert held.sum() > 30
    np.testing.assert_allclose(found.outputs[0, held], stopped.final[0], rtol=1e-14)
    assert not found.outputs[1:, held].any()
    assert state_of(found, "stopped")[RUN < 2.9].max() == state_of(found, "stopped")[RUN > 6.15].max() == 0.0
    # From there the goal is reached, without a jump of a derivative up to the order.
    tolerance = 1e-9 if horizon == "shrinking" else 1e-2
    assert np.abs(found.outputs[:, -1] - [1.0, 0.0, 0.0]).max() <= tolerance
    assert np.abs(np.diff(found.outputs[1])).max() <= 0.02 * 1.5
    assert np.abs(np.diff(found.outputs[2])).max() <= 0.02 * 5.0


def test_the_way_on_is_the_minimum_jerk_plan_from_rest():
    found = run(PLAN, {"stop": pressed(3.0, 6.05)})
    stopped = quiet_stop(PLAN, 3.0, LIMITS)
    way = cp.PolySpline([Waypoint(6.1, stopped.final, 0.0, 0.0), Waypoint(10.0, 1.0, 0.0, 0.0)])
    after = RUN >= 6.1 - 1e-9
    assert np.abs(found.outputs[:, after] - way.jet(RUN[after], 2)[:, 0])[:, 1:].max() <= 1e-9


def test_it_may_fall_during_the_stop():
    found = run(PLAN, {"stop": pressed(5.0, 5.25)})
    assert np.abs(np.diff(found.outputs[2])).max() <= 0.02 * 5.0
    assert np.abs(found.outputs[:, -1] - [1.0, 0.0, 0.0]).max() <= 1e-9
    stopped = quiet_stop(PLAN, 5.0, LIMITS)
    within = (RUN > 5.0) & (RUN < 5.29)
    np.testing.assert_allclose(found.outputs[0, within], stopped(RUN[within]), rtol=1e-12)


@pytest.mark.slow
def test_it_stops_from_a_correction_in_force():
    """The goal has moved before: the reference, not the plan, is stopped."""
    goal = cp.Step(2.0, 1.0, 2.0)
    free = run(PLAN, {"x_goal": goal, "stop": 0.0}, goal_derivatives=0)
    found = run(PLAN, {"x_goal": goal, "stop": pressed(5.0, 7.0)}, goal_derivatives=0)
    before = RUN <= 5.0 + 1e-9
    # Up to rounding: the plan is evaluated at other numbers of times together.
    np.testing.assert_allclose(found.outputs[:, before], free.outputs[:, before], rtol=1e-14, atol=1e-15)
    state = free.outputs[:, np.argmin(np.abs(RUN - 5.0))]
    here = cp.PolySpline([Waypoint(5.0, *state), Waypoint(9.0, 3.0, 0.0, 0.0)], warn=False)
    wanted = quiet_stop(here, 5.0, LIMITS)
    during = (RUN > 5.0) & (RUN < 6.95)
    assert np.abs(found.outputs[:, during] - wanted.jet(RUN[during], 2)[:, 0]).max() <= 1e-10
    assert np.abs(found.outputs[:, -1] - [2.0, 0.0, 0.0]).max() <= 1e-9


def test_a_goal_that_moves_during_the_stop_is_reached_afterwards():
    goal = cp.Step(1.5, 1.0, 4.5)
    found = run(PLAN, {"x_goal": goal, "stop": pressed(4.0, 6.0)}, goal_derivatives=0, trigger="goal")
    assert np.abs(found.outputs[:, -1] - [1.5, 0.0, 0.0]).max() <= 1e-9


@pytest.mark.parametrize("order", [0, 1, 3])
def test_orders(order):
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0, 0), Waypoint(10, 1, 0, 0, 0)], labels=["x"])
    found = run(plan, {"stop": pressed(5.0, 7.0)}, order=order, derivatives=4)
    wanted = quiet_stop(plan, 5.0, LIMITS).jet(RUN, 4)[:, 0]
    during = (RUN > 5.005) & (RUN < 6.95)
    away = np.abs(RUN[:, None] - quiet_stop(plan, 5.0, LIMITS).breakpoints).min(axis=1) > 1e-6
    assert np.abs((found.outputs - wanted)[:, during & away]).max() <= 1e-12
    assert np.abs(found.outputs[: order + 1, -1] - np.eye(order + 1)[0]).max() <= 1e-9


@pytest.mark.slow
def test_a_stop_before_the_start_and_after_the_end():
    early = run(TWO, {"stop": pressed(0.2, 0.6)})
    np.testing.assert_allclose(early.outputs[[0, 3], -1], [3.0, 3.0], rtol=1e-9)
    assert early.events == []
    held = run(TWO, {"stop": pressed(0.2, 3.0)})
    np.testing.assert_array_equal(held.outputs[0, RUN < 3.0], 0.0)
    np.testing.assert_allclose(held.outputs[[0, 3], -1], [3.0, 3.0], rtol=1e-9)
    late = run(TWO, {"stop": pressed(10.0, 11.0)})
    np.testing.assert_allclose(
        late.outputs[[0, 3]][:, RUN > 9.0].T, np.tile([3.0, 3.0], ((RUN > 9.0).sum(), 1)), rtol=1e-12
    )
    assert late.events == []


def test_a_stop_that_is_too_long_leaves_the_goal_out_of_reach():
    found = run(PLAN, {"stop": pressed(3.0, 9.9)})
    assert found.outputs[0, -1] == pytest.approx(quiet_stop(PLAN, 3.0, LIMITS).final[0], rel=1e-13)
    assert happened(found, UNREACHABLE)


@pytest.mark.slow
def test_a_way_on_that_violates_limits_is_rejected():
    peak = {1: 1.05 * PLAN.peak(1)[0]}
    found = run(PLAN, {"stop": pressed(3.0, 8.0)}, limits=peak)
    assert found.outputs[0, -1] == pytest.approx(quiet_stop(PLAN, 3.0, LIMITS).final[0], rel=1e-13)
    assert happened(found, UNREACHABLE)
    short = run(PLAN, {"stop": pressed(1.0, 1.5)}, limits={1: 2.0 * PLAN.peak(1)[0]})
    assert np.abs(short.outputs[:, -1] - [1.0, 0.0, 0.0]).max() <= 1e-9


def test_a_missing_measurement_does_not_prevent_a_stop():
    """It stops from the reference; a nan of the input `stop` itself changes nothing."""
    block = cp.create_replanner_iosystem(
        PLAN, 0.1, measured=0, trigger="deviation", threshold=9.0, stop_limits=LIMITS, suffix="_ref"
    )
    core = next(b for b in block.syslist if b.name.endswith("_correction"))
    planned = PLAN.jet(4.0, 2)[:, 0]
    x = np.zeros(core.nstates)
    sample = cp.traits_of(core).sample
    begun = sample(4.0, x, np.array([*planned, np.nan, 1.0]), {})
    assert begun[core.find_state("stopped")] == 1.0
    assert begun[core.find_state("nan_input")] == 1.0
    kept = sample(4.1, begun, np.array([*planned, 0.3, np.nan]), {})
    assert kept[core.find_state("stopped")] == 1.0
    np.testing.assert_array_equal(
        np.delete(kept, core.find_state("nan_input")), np.delete(begun, core.find_state("nan_input"))
    )
    free = sample(4.0, x, np.array([*planned, 0.3, np.nan]), {})
    assert free[core.find_state("stopped")] == 0.0


def test_a_measured_way_on_starts_at_the_measurement():
    """The plant is a lag behind the reference; the loop goes on from its output and reaches the goal."""
    block = cp.create_replanner_iosystem(
        PLAN, 0.5, measured=0, trigger="deviation", threshold=9.0, stop_limits=LIMITS, suffix="_ref"
    )
    lag = ct.ss([[-5.0]], [[5.0]], [[1.0]], [[0.0]], inputs="x_ref", outputs="x", name="lag")
    loop = ct.interconnect(
        [block, lag],
        inputs=["stop"],
        outputs=["x", "x_ref"],
        warn_duplicate=False,
        ignore_outputs=["replanner.x_ref_d1", "replanner.x_ref_d2"],
    )
    found = cp.simulate(loop, RUN, {"stop": pressed(3.0, 5.0)})
    assert abs(found.outputs[1, -1] - 1.0) <= 1e-9
    assert abs(found.outputs[0, -1] - 1.0) <= 1e-6


def test_without_limits_of_a_stop_nothing_changes():
    block = cp.create_replanner_iosystem(PLAN, 0.1)
    assert block.ninputs in (0, None) or "stop" not in block.input_labels
    assert not any("stop" in label for label in block.state_labels)
    with_stop = cp.create_replanner_iosystem(PLAN, 0.1, stop_limits=LIMITS)
    assert list(with_stop.input_labels) == ["stop"]


def test_a_step_is_stopped_too():
    block = cp.create_replanner_iosystem(
        cp.Step(1.0, time=1.0, labels=["x"]),
        0.1,
        horizon=2.0,
        goal_derivatives=0,
        stop_limits={"acceleration": 5.0, "jerk": 50.0},
    )
    found = cp.simulate(block, RUN, {"x_goal": cp.Step(3.0, 1.0, 2.0), "stop": pressed(3.0, 6.0)})
    assert not np.asarray(found.outputs)[1:, (RUN > 5.0) & (RUN < 5.95)].any()
    assert abs(found.outputs[0, -1] - 3.0) <= 1e-2


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"acceleration": 1.0}, "limits must contain acceleration and jerk, got no jerk of x"),
        ({"acceleration": 1.0, "jerk": -1.0}, "limits of jerk must be finite and above 0"),
        (
            {"acceleration": 1.0, "jerk": 1.0, "velocity": 2.0},
            "stop_limits must be those of acceleration and jerk, got x_d1",
        ),
        ({"acceleration": 1.0, "jerk": 1.0, "force": 2.0}, "got 'force'"),
    ],
)
def test_limits_that_are_rejected(limits, message):
    with pytest.raises(ValueError, match=message):
        cp.create_replanner_iosystem(PLAN, 0.1, stop_limits=limits)
