"""The crane as a flat system: its flag against the equations of motion, parameters, copies and limits."""

import copy
import math
import pickle

import control as ct
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan.systems.plants import Crane
from ctrlplan.systems.plants.crane.model import OUTPUTS, STATES

ODD = {"load_mass": 430.0, "trolley_mass": 3100.0, "drum_inertia": 70.0, "drum_radius": 0.5, "gravity": 9.5}
BOTH = pytest.mark.parametrize("wrap", [False, True])
FINITE = {"allow_nan": False, "allow_infinity": False}
HANGING = st.tuples(
    st.floats(-20, 20), st.floats(2, 20), st.floats(-1, 1), st.floats(-2, 2), st.floats(-1, 1), st.floats(-1, 1)
)
PUSHED = st.tuples(st.floats(-2e4, 2e4), st.floats(-2e3, 0))


def load(crane, state):
    """Position of the load by geometry."""
    d, r, theta = state[:3]
    s, c = math.sin(theta), math.cos(theta)
    return np.array([r * s + d + crane.drum_radius * c, r * c - crane.drum_radius * s])


def along(crane, state, inputs, step, count):
    """States at `count` multiples of a step each way, by the Runge-Kutta method with the accelerations only."""

    def rates(x):
        return np.array([*x[3:], *crane.accelerations(x, *inputs)[:3]])

    def walk(sign):
        x, h, found = np.array(state), sign * step / 20, []
        for _ in range(count):
            for _ in range(20):
                a = rates(x)
                b = rates(x + h / 2 * a)
                c = rates(x + h / 2 * b)
                x = x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c))
            found.append(x)
        return found

    return [*walk(-1)[::-1], np.array(state), *walk(1)]


@BOTH
@given(HANGING, PUSHED)
@examples(15)
def test_the_flag_holds_the_load_s_derivatives_under_held_inputs(wrap, state, inputs):
    """Against a polynomial of degree 8 through the positions of the load on a path integrated here."""
    crane = Crane(**ODD, rope_wrap=wrap)
    flag = crane.flat_system().forward(state, inputs)
    step = 0.025
    positions = np.array([load(crane, x) for x in along(crane, state, inputs, step, 4)])
    times = step * np.arange(-4, 5)
    for axis in (0, 1):
        through = np.polynomial.Polynomial.fit(times, positions[:, axis], 8)
        derivatives = [through.deriv(k)(0.0) if k else through(0.0) for k in range(5)]
        size = 1.0 + np.abs(flag[axis]).max()
        np.testing.assert_allclose(flag[axis] / size, np.array(derivatives) / size, atol=2e-4)
    tension = crane.accelerations(state, *inputs)[3]
    angle = state[2]
    np.testing.assert_allclose(flag[0][2], -tension * math.sin(angle) / crane.load_mass, rtol=1e-9, atol=1e-9)
    fall = crane.gravity - tension * math.cos(angle) / crane.load_mass
    np.testing.assert_allclose(flag[1][2], fall, rtol=1e-9, atol=1e-9)


@BOTH
@given(HANGING, PUSHED)
@examples(60)
def test_reverse_after_forward_is_the_identity(wrap, state, inputs):
    crane = Crane(**ODD, rope_wrap=wrap)
    flat, tension = crane.flat_system(), crane.accelerations(state, *inputs)[3]
    flag = flat.forward(state, inputs)
    assume(tension > 1.0 and flag[1][2] < crane.gravity - 0.1)  # a taut rope, the load below the trolley
    found, again = flat.reverse(flag)
    np.testing.assert_allclose(found, state, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(again, inputs, rtol=1e-9, atol=1e-4)


@BOTH
def test_many_states_in_one_call(wrap):
    rng = np.random.default_rng(3)
    flat = Crane(**ODD, rope_wrap=wrap).flat_system()
    x = rng.uniform(-1, 1, (6, 7)) + np.array([0, 8, 0, 0, 0, 0])[:, None]
    u = rng.uniform(-1e3, 0, (2, 7))
    flag = flat.forward(x, u)
    assert [row.shape for row in flag] == [(5, 7), (5, 7)]
    for k in range(7):
        for row, one in zip(flag, flat.forward(x[:, k], u[:, k]), strict=True):
            np.testing.assert_allclose(row[:, k], one, rtol=1e-12, atol=1e-12)


PLAN = cp.PolySpline(
    [
        cp.Waypoint.from_jets(0.0, x=[0, 0, 0, 0, 0], z=[10, 0, 0, 0, 0]),
        cp.Waypoint.from_jets(8.0, x=[12, 0, 0, 0, 0], z=[9, 0, 0, 0, 0]),
    ]
)


def test_it_is_the_crane():
    """The same block as `iosystem`, simulated and linearised by python-control."""
    crane = Crane(**ODD)
    flat, block = crane.flat_system(), crane.iosystem()
    assert (flat.name, tuple(flat.state_labels), tuple(flat.output_labels)) == ("crane", STATES, OUTPUTS)
    assert (flat.input_labels, flat.output_labels) == (block.input_labels, block.output_labels)
    state, inputs = crane.equilibrium(1.0, 10.0)
    for part in "ABCD":
        both = [getattr(ct.linearize(system, state, inputs), part) for system in (flat, block)]
        np.testing.assert_array_equal(*both)
    assert crane.flat_system(name="gantry").name == "gantry"


def test_it_takes_the_crane_s_place_in_a_loop():
    """Between the blocks of figure 3, where undeclared feedthrough would cause an algebraic loop."""
    crane, names = Crane(), list(OUTPUTS)
    blocks = [
        cp.create_source_iosystem(PLAN, 2, suffix="_ref"),
        cp.plants.create_generator_iosystem(crane),
        crane.trolley_pid(),
        crane.hoist_pid(),
    ]
    start = np.concatenate([np.zeros(4), crane.equilibrium(0.0, 10.0)[0]])
    found = [
        cp.simulate(ct.interconnect([*blocks, plant], inputs=0, outputs=names), np.linspace(0, 9, 10), None, start)
        for plant in (crane.flat_system(), crane.iosystem())
    ]
    np.testing.assert_allclose(found[0].outputs, found[1].outputs, atol=1e-7)


def test_the_one_map():
    """`Crane.quantities`, the flat system's quantities and its states and inputs."""
    crane = Crane(**ODD, rope_wrap=True)
    t = np.linspace(0, 8, 13)
    jet = PLAN.jet(t, 4)
    direct, flat = crane.quantities(jet), crane.flat_system()
    x, u = flat.states_and_inputs(PLAN, t)
    assert list(direct) == list(flat.quantities(jet))
    for name, row in flat.quantities(jet).items():
        np.testing.assert_array_equal(row, direct[name])
    for name, row in zip((*STATES, "F", "C"), (*x, *u), strict=True):
        np.testing.assert_array_equal(row, direct[name])


def test_parameters_of_a_run_reach_the_maps_that_are_given_them():
    heavy = Crane(**ODD | {"load_mass": 900.0}).flat_system()
    flat = Crane(**ODD).flat_system()
    flag = [PLAN.jet(3.0, 4)[:, axis] for axis in (0, 1)]
    for got, expected in zip(flat.reverse(flag, {"load_mass": 900.0}), heavy.reverse(flag), strict=True):
        np.testing.assert_array_equal(got, expected)
    state, inputs = heavy.reverse(flag)
    for got, expected in zip(
        flat.forward(state, inputs, {"load_mass": 900.0}), heavy.forward(state, inputs), strict=True
    ):
        np.testing.assert_array_equal(got, expected)
    assert not np.array_equal(flat.reverse(flag)[1], heavy.reverse(flag)[1])


@pytest.mark.parametrize("again", [copy.deepcopy, lambda flat: pickle.loads(pickle.dumps(flat))])
def test_copies_are_whole(again):
    flat = Crane(**ODD).flat_system()
    other = again(flat)
    assert (other.orders, other.extension, other.flat_labels) == (flat.orders, flat.extension, flat.flat_labels)
    for got, expected in zip(other.states_and_inputs(PLAN, 3.0), flat.states_and_inputs(PLAN, 3.0), strict=True):
        np.testing.assert_array_equal(got, expected)


@pytest.mark.slow
def test_a_law_of_the_crane_needs_its_extension():
    """Static feedback does not linearise the crane: its law has the tension and its rate as states."""
    law = cp.create_flat_iosystem(Crane().flat_system(), [[-1, -2, -3, -4]] * 2)
    assert law.nstates == 2


def test_flags_below_the_slack_rope_are_rejected():
    flat = Crane().flat_system()
    with pytest.raises(ValueError, match="taut rope"):
        flat.reverse([[0, 0, 0, 0, 0], [10, 0, 9.81, 0, 0]])
