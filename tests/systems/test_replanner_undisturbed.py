"""Replanners without disturbances: the plan is followed unchanged."""

import control as ct
import numpy as np
import pytest
from replanner_oracle import METHODS, PLAN, PLANS, TIGHT, block_outputs, ideal, signals, state_of

import ctrlplan as cp
from ctrlplan import Waypoint

TRIGGERS = {
    "period": {},
    "period, goal": {"goal_derivatives": 0},
    "goal": {"goal_derivatives": 0, "trigger": "goal"},
    "measured": {"measured": 2, "suffix": "_r"},
    "position measured": {"measured": 0, "suffix": "_r"},
    "measured, goal": {"measured": 1, "goal_derivatives": 0, "suffix": "_r"},
    "deviation": {"measured": 2, "suffix": "_r", "trigger": "deviation", "threshold": 1e-12},
}


@pytest.mark.parametrize("trigger", TRIGGERS)
@pytest.mark.parametrize("name", PLANS)
def test_undisturbed_every_plan_is_followed_as_it_was_made(name, trigger):
    """Sample by sample on a plant that is where the plan is, to 1e-10 of each derivative's size."""
    plan = PLANS[name]
    replanner = cp.create_replanner_iosystem(plan, 0.4, min_horizon=1.0, **TRIGGERS[trigger])
    core, fits = replanner.syslist[1], []
    x = np.zeros(core.nstates)
    size = np.abs(plan.jet(np.linspace(0, 10, 201), 2)).max(axis=2).T.ravel()
    for t in (0.4 * np.arange(26)).tolist():
        x = core.sample(t, x, signals(plan, replanner, t), {})
        fits.append(x[4])
        for s in (t, t + 0.13, t + 0.39):
            if s <= plan.end:
                wanted = plan.jet(s, 2).T.ravel()
                assert (np.abs(block_outputs(plan, replanner, s, x) - wanted) <= 1e-10 * size).all()
    assert x[3] == 0.0
    if trigger in ("measured", "position measured", "measured, goal"):
        assert fits[-1] == 23  # at 0, 0.4, ..., 8.8
    if trigger in ("goal", "deviation"):
        assert fits[-1] <= 1


@pytest.mark.parametrize("name", ["polynomial", "trigonometric, alpha 5", "piecewise", "joined"])
@pytest.mark.parametrize("trigger", ["period", "period, goal", "goal"])
def test_undisturbed_in_a_run(name, trigger):
    plan, t = PLANS[name], np.linspace(0.0, 10.0, 101)
    replanner = cp.create_replanner_iosystem(plan, 0.25, **TRIGGERS[trigger])
    found = cp.simulate(replanner, t, None if trigger == "period" else float(plan.final[0]))
    wanted = plan.jet(t, 2)[:, 0]
    assert (np.abs(found.outputs - wanted).max(axis=1) <= 1e-10 * np.abs(wanted).max(axis=1)).all()
    assert found.events == []


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("polynomial", {}),
        ("trigonometric, alpha 5", {}),
        ("piecewise, trigonometric", {"goal_derivatives": 0}),
        ("joined", {"trigger": "deviation", "threshold": 1e-3}),
    ],
)
def test_undisturbed_with_a_plant_that_follows(name, options):
    """A chain of integrators driven by the plan's third derivative is where the plan is, to the solver's error."""
    plan, t = PLANS[name], np.linspace(0.0, 10.0, 101)
    found = ideal(plan, 0.5, times=t, **options)
    wanted = plan.jet(t, 0)[0]
    rows = [found.output_labels.index(label) for label in plan.labels]
    assert np.abs(found.outputs[rows] - wanted).max() <= 1e-7
    assert (state_of(found, "fits")[-1] > 5) == (options.get("trigger") is None)


def test_a_plant_that_passes_the_reference_on_at_once():
    """What is measured at a fit is what was there just before it: no loop from a fit to itself."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.1, measured=2, suffix="_r")
    wires = ct.ss([], [], [], np.eye(3), inputs=replanner.output_labels, outputs=["x", "x_d1", "x_d2"], name="wires")
    loop = ct.interconnect([replanner, wires], inputs=0, outputs=["x", "x_d1", "x_d2"])
    t = np.linspace(0.0, 11.0, 111)
    for method in METHODS:
        found = cp.simulate(loop, t, method=method)
        assert np.abs(found.outputs - PLAN.jet(t, 2)[:, 0]).max() <= 1e-10


def test_an_acceleration_that_is_commanded_and_measured():
    """A double integrator driven by x_r_d2: its acceleration has direct feedthrough from the reference."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.25, measured=2, suffix="_r")
    plant = ct.ss(
        [[0, 1], [0, 0]],
        [[0], [1]],
        [[1, 0], [0, 1], [0, 0]],
        [[0], [0], [1]],
        inputs="x_r_d2",
        outputs=["x", "x_d1", "x_d2"],
    )
    loop = ct.interconnect([replanner, plant], inputs=0, outputs=["x", "x_r", "x_r_d1", "x_r_d2", "x_d1", "x_d2"])
    t = np.linspace(0.0, 11.0, 45)
    found = cp.simulate(loop, t, **TIGHT)
    assert np.abs(found.outputs[0] - PLAN(t)).max() <= 1e-7


def test_a_sensor_that_samples_at_the_same_instants_changes_nothing():
    """What is measured at a fit is what the sensor has just taken: neither its first 0 nor a period old."""
    plan = cp.PolySpline([Waypoint(0, 5, 0, 0), Waypoint(10, 6, 0, 0)], labels=["x"])
    t, runs = np.linspace(0.0, 12.0, 49), []
    for sampled in (False, True):
        replanner = cp.create_replanner_iosystem(plan, 0.25, order=1, measured=0, suffix="_r")
        outputs = "p" if sampled else "x"
        plant = ct.ss([[-9.0]], [[9.0, 1.0]], [[1.0]], 0, inputs=["x_r", "x_r_d1"], outputs=outputs, name="plant")
        sensor = cp.sample_hold(ct.ss([], [], [], [[1.0]], inputs="p", outputs="x", name="sensor", dt=None), 0.25)
        blocks = [replanner, plant, sensor] if sampled else [replanner, plant]
        loop = ct.interconnect(blocks, inputs=0, outputs=[outputs, "x_r", "x_r_d1"] + ["x"] * sampled)
        state = np.zeros(loop.nstates)
        state[loop.state_labels.index("plant_x[0]")] = 5.1
        runs.append(cp.simulate(loop, t, None, state, **TIGHT).outputs[:3])
    assert abs(runs[0][0, -1] - 6.0) <= 1e-2
    assert np.abs(runs[1] - runs[0]).max() <= 1e-8


def test_a_goal_that_is_sampled_at_the_same_instants_is_seen_at_once():
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0)
    hold = cp.sample_hold(ct.ss([], [], [], [[1.0]], inputs="wish", outputs="x_goal", name="hold", dt=None), 0.5)
    loop = ct.interconnect([replanner, hold], inputs="wish", outputs=replanner.output_labels)
    t = np.linspace(0.0, 12.0, 121)
    wish = cp.Step(1.5, 1.0, 3.2)
    assert np.abs(cp.simulate(loop, t, wish).outputs - cp.simulate(replanner, t, wish).outputs).max() <= 1e-10
