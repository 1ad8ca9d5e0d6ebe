"""Plan as a block: its outputs are the jet of the plan, and functions of python-control accept it."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.systems import PlanSource

JETS = {
    "x": [[0.0, 0.0, 0.0], [2.0, 1.5], [3.0, 0.0, 0.0]],
    "z": [[10.0, 0.0], [5.0, -1.0, -0.15], [11.0, 0.0]],
}
TIMES = (0.5, 1.5, 3.0)
POINTS = [cp.Waypoint.from_jets(t, **{k: jets[i] for k, jets in JETS.items()}) for i, t in enumerate(TIMES)]
PLAN = cp.TrigSpline(POINTS, alpha=1.0)
SINGLE = cp.PolySpline([cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(1.5, 1, 0, 0)], labels=["r"])
T = np.linspace(0.0, 6.0, 61)


def block_outputs(block, t):
    return block.output(t, np.zeros(0), np.zeros(0))


def test_outputs_are_named_axis_by_axis():
    assert cp.create_source_iosystem(PLAN).output_labels == ["x", "z"]
    block = cp.create_source_iosystem(PLAN, derivatives=2, name="reference")
    assert block.output_labels == ["x", "x_d1", "x_d2", "z", "z_d1", "z_d2"]
    assert block.name == "reference"
    assert cp.create_source_iosystem(PLAN).name == "plan"


def test_a_suffix_goes_behind_each_label():
    block = cp.create_source_iosystem(PLAN, derivatives=1, suffix="_ref")
    assert block.output_labels == ["x_ref", "x_ref_d1", "z_ref", "z_ref_d1"]


def test_an_axis_without_a_label_is_named_as_the_plan_names_it():
    unnamed = cp.PolySpline([cp.Waypoint(0, [0, 0]), cp.Waypoint(1, [1, 2])])
    assert cp.create_source_iosystem(unnamed, 1).output_labels == ["y1", "y1_d1", "y2", "y2_d1"]
    assert cp.create_source_iosystem(cp.Step(1.0), 1).output_labels == ["y", "y_d1"]


def test_it_is_a_system_of_python_control_without_inputs_or_states():
    block = cp.create_source_iosystem(PLAN, derivatives=1)
    assert isinstance(block, PlanSource)
    assert isinstance(block, ct.NonlinearIOSystem)
    assert (block.ninputs, block.nstates, block.noutputs) == (0, 0, 4)
    assert block.dt is None
    assert block.plan is PLAN
    assert block.derivatives == 1
    assert block.breakpoints.tolist() == [0.5, 3.0]


@pytest.mark.parametrize("t", [-3.0, 0.0, 0.5, 0.7, 1.5, 2.999, 3.0, 3.1, 100.0])
@pytest.mark.parametrize("derivatives", [0, 1, 3])
def test_values_are_the_jet(derivatives, t):
    found = block_outputs(cp.create_source_iosystem(PLAN, derivatives), t)
    assert found.shape == (2 * (derivatives + 1),)
    jet = PLAN.jet(t, derivatives)
    assert found.tolist() == [jet[nu, axis] for axis in range(2) for nu in range(derivatives + 1)]
    scale = [PLAN.peak(nu)[axis] for axis in range(2) for nu in range(derivatives + 1)]
    separately = [PLAN(t, nu)[axis] for axis in range(2) for nu in range(derivatives + 1)]
    assert np.abs((found - separately) / scale).max() <= 1e-14


def test_values_where_they_are_prescribed():
    block = cp.create_source_iosystem(PLAN, derivatives=1)
    for i, t in enumerate(TIMES):
        assert np.abs(block_outputs(block, t) - [*JETS["x"][i][:2], *JETS["z"][i][:2]]).max() <= 1e-12


def test_the_plan_is_held_outside_its_interval():
    block = cp.create_source_iosystem(PLAN, derivatives=2)
    assert np.abs(block_outputs(block, -1.0) - [0, 0, 0, 10, 0, 0]).max() <= 1e-13
    assert np.abs(block_outputs(block, 9.0) - [3, 0, 0, 11, 0, 0]).max() <= 1e-13


def test_a_step_jumps_at_its_time():
    block = cp.create_source_iosystem(cp.Step([1.0, 2.0], initial=-1.0, time=2.0, labels=["a", "b"]), derivatives=1)
    assert block_outputs(block, np.nextafter(2.0, 0.0)).tolist() == [-1, 0, -1, 0]
    assert block_outputs(block, 2.0).tolist() == [1, 0, 2, 0]


def test_a_whole_number_of_any_kind_counts_derivatives():
    for two in (2, 2.0, np.int64(2)):
        assert cp.create_source_iosystem(SINGLE, two).noutputs == 3


@pytest.mark.parametrize("derivatives", [-1, 0.5, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("function", [cp.create_source_iosystem, lambda plan, n: cp.source_samples(plan, T, n)])
def test_a_wrong_number_of_derivatives(function, derivatives):
    with pytest.raises(ValueError, match="derivatives must be an integer of at least 0, got"):
        function(PLAN, derivatives)


@pytest.mark.parametrize("plan", [None, 1.0, [0.0, 1.0], np.sin, POINTS], ids=lambda p: type(p).__name__)
@pytest.mark.parametrize("function", [cp.create_source_iosystem, lambda plan: cp.source_samples(plan, T)])
def test_what_is_not_a_plan(function, plan):
    with pytest.raises(TypeError, match=f"plan must be a Trajectory, got {type(plan).__name__}"):
        function(plan)


# Next to python-control's own functions


def lag(gain=5.0, signal="r"):
    """k/(s^2 + s) in unity feedback, with functions of python-control only."""
    return ct.ss([[-1, -gain], [1, 0]], [[gain], [0]], [[0, 1]], 0, inputs=signal, outputs="y", name="lag")


def test_interconnect_joins_it_by_name():
    planned_loop = ct.interconnect([cp.create_source_iosystem(SINGLE), lag()], inputs=0, outputs=["y"])
    assert planned_loop.nstates == 2
    assert planned_loop.ninputs == 0
    assert planned_loop.connect_map.tolist() == [[1.0, 0.0]]
    assert np.abs(planned_loop.dynamics(1.2, [0.3, 0.1], []) - [-0.3 - 0.5 + 5 * SINGLE(1.2), 0.3]).max() <= 1e-15
    assert planned_loop.output(1.2, [0.3, 0.1], []).tolist() == [0.1]


def test_interconnect_takes_derivatives_and_several_axes():
    block = cp.create_source_iosystem(PLAN, derivatives=1)
    mix = ct.ss([], [], [], [[1, 2, 3, 4]], inputs=["x", "x_d1", "z", "z_d1"], outputs="y", name="mix")
    whole = ct.interconnect([block, mix], inputs=0, outputs=["y"])
    for t in (0.0, 0.9, 3.0):
        (x, z), (v, w) = PLAN(t), PLAN(t, 1)
        assert abs(whole.output(t, [], [])[0] - (x + 2 * v + 3 * z + 4 * w)) <= 1e-13


@pytest.mark.parametrize("method", ["RK45", "DOP853", "LSODA", "Radau"])
def test_input_output_response_runs_it(method):
    planned_loop = ct.interconnect([cp.create_source_iosystem(SINGLE), lag()], inputs=0, outputs=["y"])
    found = ct.input_output_response(
        planned_loop, T, solve_ivp_method=method, solve_ivp_kwargs={"rtol": 1e-6, "atol": 1e-8, "max_step": 0.1}
    )
    # Superposition over a staircase: the response to the plan is the integral of the step response times its slope.
    s = np.linspace(0.5, 1.5, 2001)
    w = np.sqrt(4.75)
    weights = np.full(s.size, 2.0)
    weights[1::2] = 4.0
    weights[[0, -1]] = 1.0
    age = np.maximum(T[:, None] - s, 0.0)
    step_response = 1 - np.exp(-age / 2) * (np.cos(w * age) + np.sin(w * age) / (2 * w))
    exact = step_response @ (weights * SINGLE(s, 1)) * (s[1] - s[0]) / 3
    assert np.abs(np.ravel(found.outputs) - exact).max() <= 1e-4


def test_input_output_response_runs_it_alone():
    found = ct.input_output_response(cp.create_source_iosystem(PLAN, derivatives=1), T)
    assert np.abs(found.outputs - [PLAN(T)[0], PLAN(T, 1)[0], PLAN(T)[1], PLAN(T, 1)[1]]).max() <= 1e-13


def test_it_takes_the_time_base_of_its_neighbours():
    held = ct.ss(0.5, 1.0, 1.0, 0.0, 0.1, inputs="r", outputs="y", name="held")
    sampled = ct.interconnect([cp.create_source_iosystem(SINGLE), held], inputs=0, outputs=["y"])
    assert sampled.dt == 0.1
    t = 0.1 * np.arange(30)
    x, states = 0.0, []
    for r in SINGLE(t):
        states.append(x)
        x = 0.5 * x + r
    assert np.abs(np.ravel(ct.input_output_response(sampled, t).outputs) - states).max() <= 1e-14
    assert ct.interconnect([cp.create_source_iosystem(SINGLE), lag()], inputs=0, outputs=["y"]).isctime(strict=True)


def test_a_block_can_be_used_twice():
    # interconnect copies a block that is named twice.
    block = cp.create_source_iosystem(SINGLE)
    copied = block.copy(name="again")
    assert isinstance(copied, PlanSource)
    assert copied.plan is SINGLE
    assert copied.name == "again"
    assert block_outputs(copied, 1.1) == block_outputs(block, 1.1)


def test_two_plans_in_one_loop():
    first = cp.create_source_iosystem(SINGLE, name="first")
    second = cp.create_source_iosystem(cp.stack([cp.Step(2.0, time=1.0)], ["d"]), name="second")
    total = ct.summing_junction(inputs=["r", "-d"], output="y", name="total")
    whole = ct.interconnect([first, second, total], inputs=0, outputs=["y"])
    assert abs(whole.output(1.2, [], [])[0] - (SINGLE(1.2) - 2.0)) <= 1e-15
