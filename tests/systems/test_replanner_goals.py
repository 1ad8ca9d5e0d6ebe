"""Replanners: goals that move and rest, and what triggers a fit."""

import control as ct
import numpy as np
import pytest
from replanner_oracle import (
    METHODS,
    PLAN,
    PLANS,
    REST,
    UNREACHABLE,
    block_outputs,
    conveyor,
    happened,
    ideal,
    signals,
    state_of,
    steps,
)
from scipy.interpolate import BPoly

import ctrlplan as cp
from ctrlplan import Waypoint

RUN = np.linspace(0.0, 13.0, 131)


@pytest.mark.parametrize("speed", [-0.3, 0.7])
@pytest.mark.parametrize(
    "plan", [PLAN, cp.TrigSpline(REST, alpha=3.0, labels=["x"])], ids=["polynomial", "trigonometric"]
)
def test_a_conveyor_is_met_exactly_and_followed_from_there(plan, speed):
    found = cp.simulate(cp.create_replanner_iosystem(plan, 0.4, goal_derivatives=1), RUN, conveyor(2.0, speed))
    after = RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[0, after] - (2.0 + speed * RUN[after])).max() <= 1e-9
    assert np.abs(found.outputs[1, after] - speed).max() <= 1e-9
    assert np.abs(found.outputs[2, after]).max() <= 1e-8
    assert found.events == []  # it goes on as it was taken to


def test_a_conveyor_whose_speed_changes_is_met_all_the_same():
    """Accelerated between 3 and 5 s; then it is constant."""
    line = (
        cp.PolySpline([Waypoint(-50.0, -5.0, 0.1), Waypoint(3.0, 0.3, 0.1)])
        .then(cp.PolySpline([Waypoint(3.0, 0.3, 0.1, 0), Waypoint(5.0, 1.0, 0.5, 0)]))
        .then(cp.PolySpline([Waypoint(5.0, 1.0, 0.5), Waypoint(50.0, 23.5, 0.5)]))
    )
    fast = cp.PolySpline([Waypoint(3.0, 0.1, 0.0), Waypoint(5.0, 0.5, 0.0)])
    replanner = cp.create_replanner_iosystem(PLAN, 0.25, goal_derivatives=1)
    found = cp.simulate(replanner, RUN, {"x_goal": line, "x_goal_d1": fast})
    after = RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[0, after] - (1.0 + 0.5 * (RUN[after] - 5.0))).max() <= 1e-9
    assert np.abs(found.outputs[1, after] - 0.5).max() <= 1e-9
    assert state_of(found, "fits")[-1] >= 8


def test_a_goal_that_accelerates_is_followed_to_its_second_derivative():
    """x = t^2/20 with both derivatives, order 3."""
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0, 0), Waypoint(10, 1, 0, 0, 0)], labels=["x"])
    replanner = cp.create_replanner_iosystem(plan, 0.5, order=3, goal_derivatives=2)
    square = cp.PolySpline([Waypoint(0, 0, 0), Waypoint(20, 20)])
    slope = cp.PolySpline([Waypoint(0, 0), Waypoint(20, 2)])
    found = cp.simulate(replanner, RUN, {"x_goal": square, "x_goal_d1": slope, "x_goal_d2": 0.1})
    after = RUN >= 10.0 - 1e-9
    wanted = [RUN[after] ** 2 / 20, RUN[after] / 10, np.full(after.sum(), 0.1)]
    assert np.abs(found.outputs[:3, after] - wanted).max() <= 1e-8
    assert found.events == []


def test_a_plan_that_ends_in_motion_onto_the_conveyor_it_was_made_for():
    """The goal is the end of the plan: no fit, and the plan continues."""
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(10, 5, 0.5, 0)], labels=["x"])
    replanner = cp.create_replanner_iosystem(plan, 0.4, goal_derivatives=1)
    found = cp.simulate(replanner, RUN, conveyor(5.0, 0.5, at=10.0))
    during, after = RUN < 9.95, RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[:, during] - plan.jet(RUN[during], 2)[:, 0]).max() <= 1e-9
    assert np.abs(found.outputs[0, after] - (5.0 + 0.5 * (RUN[after] - 10.0))).max() <= 1e-9
    assert np.abs(found.outputs[1, after] - 0.5).max() <= 1e-9
    assert found.events == []


@pytest.mark.parametrize("speed", [0.5, 0.0, -0.2])
def test_a_plan_that_ends_in_motion_onto_another_goal(speed):
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(10, 5, 0.5, 0)], labels=["x"])
    replanner = cp.create_replanner_iosystem(plan, 0.4, goal_derivatives=1)
    found = cp.simulate(replanner, RUN, conveyor(5.3, speed, at=10.0))
    after = RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[0, after] - (5.3 + speed * (RUN[after] - 10.0))).max() <= 1e-9
    assert np.abs(found.outputs[1, after] - speed).max() <= 1e-9


def test_a_goal_that_passes_through_0_goes_on_as_it_was_taken_to():
    """Rounding errors are not a change of the goal, however small it is."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.1, goal_derivatives=1, min_horizon=3.0)
    found = cp.simulate(replanner, RUN, conveyor(0.0, 1.0, at=9.0))
    assert np.abs(found.outputs[0, RUN > 10.0] - (RUN[RUN > 10.0] - 9.0)).max() <= 1e-9
    assert found.events == []


@pytest.mark.parametrize("method", METHODS)
def test_a_resting_goal_given_with_its_derivatives_is_not_new(method):
    """Rounding is none in what a plan arrives with (1e-17 for 0), nor in what the solver keeps: no fit, no event."""
    plan = cp.TrigSpline([Waypoint(0, [0, 1], 0, 0), Waypoint(9, [3, -1], 0, 0)], alpha=2.0, labels=["x", "z"])
    replanner = cp.create_replanner_iosystem(
        plan, 0.25, measured=0, goal_derivatives=2, suffix="_r", trigger="deviation", threshold=5.0
    )
    a, b = np.array([[0.0, 1.0], [-16.0, -8.0]]), np.array([[0.0, 0.0, 0.0], [16.0, 8.0, 1.0]])
    plants = [
        ct.ss(a, b, [[1, 0]], 0, inputs=[f"{s}_r", f"{s}_r_d1", f"{s}_r_d2"], outputs=s, name=f"plant_{s}")
        for s in "xz"
    ]
    goals = replanner.input_labels[:6]
    loop = ct.interconnect([replanner, *plants], inputs=goals, outputs=["x", "z", *replanner.output_labels])
    state = np.zeros(loop.nstates)
    state[-4:] = [0.05, 0.0, 1.0, -0.1]
    t = np.linspace(0.0, 14.0, 57)
    found = cp.simulate(loop, t, {"x_goal": 3.0, "z_goal": -1.0}, state, method=method)
    assert state_of(found, "fits")[-1] == 0
    assert found.events == []
    assert np.abs(found.outputs[[2, 5]] - plan(t)).max() <= 1e-10


@pytest.mark.parametrize("name", ["polynomial", "trigonometric, alpha 1", "trigonometric, alpha 5"])
def test_a_run_that_begins_too_late_for_a_fit_needs_none(name):
    """The goal rests where the plan ends: nothing is missed."""
    plan = PLANS[name]
    replanner = cp.create_replanner_iosystem(plan, 0.25, goal_derivatives=2)
    t = np.linspace(9.5, 12.0, 11)
    found = cp.simulate(replanner, t, {f"{plan.labels[0]}_goal": 1.0})
    assert found.events == []
    assert np.abs(found.outputs - plan.jet(t, 2)[:, 0]).max() <= 1e-10


@pytest.mark.parametrize("moment", [1e6, -1e6])
def test_a_conveyor_met_in_absolute_time(moment):
    """Times of 1e6 s have a resolution of 1e-10 s: no false event from it."""
    goal = conveyor(2.0, 0.3, at=0.0)
    replanner = cp.create_replanner_iosystem(PLAN.shift(moment), 0.5, goal_derivatives=1)
    found = cp.simulate(replanner, moment + RUN, {"x_goal": goal["x_goal"].shift(moment), "x_goal_d1": 0.3})
    after = RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[0, after] - (2.0 + 0.3 * RUN[after])).max() <= 1e-8
    assert found.events == []


def test_shrinking_stops_and_a_goal_moved_too_late_is_an_event():
    """min_horizon 2 s: the last fit at 8 s or before; the goal that moves at 8.6 s is not reached, and comes back."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, min_horizon=2.0)
    t = np.linspace(0.0, 12.0, 241)
    for method in METHODS:
        found = cp.simulate(replanner, t, steps((7.9, 1.2), (8.6, 3.0), (10.8, 1.2)), method=method)
        fits = state_of(found, "fits")
        moved = np.flatnonzero(np.diff(fits)) + 1
        assert t[moved].tolist() == pytest.approx([8.0])
        assert happened(found, UNREACHABLE) == [(9.0, "above"), (11.0, "inside")]
        assert len(found.events) == 2
        peer = BPoly.from_derivatives([8.0, 10.0], [PLAN.jet(8.0, 2)[:, 0], [1.2, 0, 0]])
        held = (t >= 8.0) & (t <= 10.0)
        assert np.abs(found.outputs[0, held] - peer(t[held])).max() <= 1e-10
        assert np.abs(found.outputs[0, t >= 10.0] - 1.2).max() <= 1e-10


@pytest.mark.slow
def test_the_minimum_horizon_is_five_periods_and_half_the_plan_at_most():
    """The last fit of a plant that is measured, by its count."""
    t = np.array([0.0, 10.0])
    assert state_of(ideal(PLAN, 0.5, times=t), "fits")[-1] == 16  # 0, ..., 7.5
    assert state_of(ideal(PLAN, 2.0, times=t), "fits")[-1] == 3  # 0, 2, 4
    assert state_of(ideal(PLAN, 0.5, times=t, min_horizon=0.5), "fits")[-1] == 20  # 0, ..., 9.5
    assert state_of(ideal(PLAN, 0.5, times=t, min_horizon=10.0), "fits")[-1] == 1


def test_a_fixed_horizon_never_stops():
    """Fits at every period for as long as the run, and a goal is met after the plan's end as well as before it."""
    t = np.linspace(0.0, 30.0, 121)
    replanner = cp.create_replanner_iosystem(PLAN, 0.25, horizon=2.0, goal_derivatives=0)
    found = cp.simulate(replanner, t, steps((20.1, 3.0)))
    assert state_of(found, "fits").tolist() == (np.arange(121) + 1).tolist()
    assert np.abs(found.outputs[0, t <= 20.0] - PLAN(t[t <= 20.0])).max() <= 1e-9
    assert abs(found.outputs[0, -1] - 3.0) <= 1e-3
    assert found.events == []


# Triggers


def drifting(rate, **options):
    """Position that drifts off the reference at a constant rate; derivative 0 is measured."""
    plan = cp.PolySpline([Waypoint(0, [0, 0], 0, 0), Waypoint(10, [1, 2], 0, 0)], labels=["x", "z"])
    replanner = cp.create_replanner_iosystem(plan, 0.1, measured=0, suffix="_r", min_horizon=1.0, **options)
    plant = ct.ss(
        np.zeros((2, 2)), np.eye(2, 4), np.eye(2), 0, inputs=["ex", "ez", "ax", "az"], outputs=["x", "z"], name="plant"
    )
    speeds = ct.ss([], [], [], np.eye(2), inputs=["x_r_d1", "z_r_d1"], outputs=["ux", "uz"], name="speeds")
    drift = ct.summing_junction(["ux", "wx"], "ex", name="sx"), ct.summing_junction(["uz", "wz"], "ez", name="sz")
    loop = ct.interconnect(
        [replanner, speeds, *drift, plant],
        inputs=["wx", "wz", "ax", "az"],
        outputs=["x", "z", *replanner.output_labels],
    )
    t = np.linspace(0.0, 10.0, 101)
    return t, cp.simulate(loop, t, {"wx": rate[0], "wz": rate[1]})


def test_deviation_fits_only_above_the_threshold():
    """3-4-5: the distance grows by 0.01 a period; above 0.025 at every third sample, from 0 on again after each fit."""
    t, found = drifting((0.06, 0.08), trigger="deviation", threshold=0.025)
    fits = np.flatnonzero(np.diff(state_of(found, "fits"))) + 1
    assert np.allclose(t[fits], np.arange(0.3, 9.05, 0.3))
    assert state_of(found, "fits")[0] == 0


@pytest.mark.slow
def test_a_distance_below_the_threshold_is_let_be():
    """Drift of 1.0 in all, the threshold at 1.01; without a trigger there are as many fits as periods."""
    _, found = drifting((0.06, 0.08), trigger="deviation", threshold=1.01)
    assert state_of(found, "fits")[-1] == 0
    _, found = drifting((0.06, 0.08))
    assert state_of(found, "fits")[-1] == 91


def test_deviation_heeds_a_new_goal_as_well():
    replanner = cp.create_replanner_iosystem(
        PLAN, 0.5, measured=0, goal_derivatives=0, suffix="_r", trigger="deviation", threshold=0.5
    )
    core = replanner.syslist[1]
    x = np.zeros(core.nstates)
    x = core.sample(1.0, x, signals(PLAN, replanner, 1.0), {})
    assert x[4] == 0
    x = core.sample(1.5, x, signals(PLAN, replanner, 1.5, goal=[[1.1]]), {})
    assert x[4] == 1
    lifted = float(block_outputs(PLAN, replanner, 2.0, x)[0] - PLAN(2.0))
    x = core.sample(2.0, x, signals(PLAN, replanner, 2.0, goal=[[1.1]], off=lifted), {})
    assert x[4] == 1
    x = core.sample(2.5, x, signals(PLAN, replanner, 2.5, goal=[[1.1]], off=0.6), {})
    assert x[4] == 2


def test_goal_fits_for_new_goals_only():
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, trigger="goal", horizon=2.0)
    t = np.linspace(0.0, 14.0, 57)
    found = cp.simulate(replanner, t, steps((2.2, 2.0), (4.0, 1.0), (9.1, 1.5), (9.2, 1.7), (12.9, -1.0)))
    fits = np.flatnonzero(np.diff(state_of(found, "fits"))) + 1
    assert t[fits].tolist() == [2.5, 4.0, 9.5, 13.0]
    assert state_of(found, "fits")[0] <= 1
