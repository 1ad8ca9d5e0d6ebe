"""Equilibrium of a loop with constant inputs, and its unstable poles."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import equilibrium_state, simulate, unstable_poles

T = np.linspace(0.0, 10.0, 21)


def rests(system, position, state):
    """With constant inputs the state does not change over many time constants."""
    held = cp.Step(position, initial=position)
    found = simulate(system, T, held, state, method="exact").states
    return np.abs(found - np.asarray(state)[:, None]).max() <= 1e-9 * max(1.0, np.abs(state).max())


@pytest.mark.parametrize("position", [0.0, 1.0, -2.5, 1e3, 1e-6])
@pytest.mark.parametrize("gain", [0.1, 0.25, 5.0, 1e3, 1e6])
def test_the_equilibrium_of_the_lag_loop_is_the_reference(gain, position):
    # y' = 0 and y = r, whatever the gain.
    state = equilibrium_state(cp.plants.integrator_lag_loop(gain), position)
    assert np.abs(state - [0.0, position]).max() <= 1e-9 * max(abs(position), 1e-9)


@pytest.mark.parametrize("outputs", [["y"], ["u"], ["e", "y"], ["y", "u", "e"]])
def test_the_order_of_outputs_does_not_move_the_rest(outputs):
    # A x + B w = 0 has one solution here; u and e are 0 in it, and cannot be 1.
    assert np.abs(equilibrium_state(cp.plants.integrator_lag_loop(5.0, outputs), 1.0) - [0.0, 1.0]).max() <= 1e-9


@pytest.mark.parametrize("gain", [1.0, 4.0, 99.0])
def test_a_loop_with_an_offset(gain):
    # gain/(s + 1) in unity feedback has the equilibrium gain/(1 + gain), not 1.
    system = cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], gain)
    state = equilibrium_state(system, 1.0)
    assert np.abs(state - gain / (1 + gain)).max() <= 1e-9
    assert rests(system, 1.0, state)


def test_of_many_rests_the_one_where_outputs_are_the_inputs():
    # Two integrators without input are in equilibrium anywhere: x' = 0 w; y = x.
    system = ct.ss(np.zeros((2, 2)), np.zeros((2, 2)), np.eye(2), np.zeros((2, 2)))
    assert np.abs(equilibrium_state(system, [2.0, -3.0]) - [2.0, -3.0]).max() <= 1e-12


def test_two_axes():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(4, 4)) - 4 * np.eye(4), rng.normal(size=(4, 2))
    c = rng.normal(size=(2, 4))
    gain = np.linalg.inv(c @ -np.linalg.solve(a, b))  # so that the outputs equal the inputs
    system = ct.ss(a, b @ gain, c, np.zeros((2, 2)))
    state = equilibrium_state(system, [1.5, -0.5])
    assert np.abs(state + np.linalg.solve(a, b @ gain @ [1.5, -0.5])).max() <= 1e-9
    assert np.abs(c @ state - [1.5, -0.5]).max() <= 1e-9
    assert rests(system, [1.5, -0.5], state)


def test_where_there_is_no_rest_the_state_is_zero():
    # x' = w has no equilibrium for w = 1.
    assert equilibrium_state(ct.ss(0.0, 1.0, 1.0, 0.0), 1.0).tolist() == [0.0]


def test_a_nonlinear_system_gives_the_zero_state():
    bent = ct.nlsys(lambda t, x, u, p: -(x**3) + u, None, inputs=1, outputs=1, states=1, name="bent")
    assert equilibrium_state(bent, 1.0).tolist() == [0.0]
    assert equilibrium_state(ct.ss(0.5, 1.0, 1.0, 0.0, 0.1), 1.0).tolist() == [0.0]


def test_the_zero_position_needs_no_state():
    assert equilibrium_state(cp.plants.integrator_lag_loop(5.0), 0.0).tolist() == [0.0, 0.0]
    assert equilibrium_state(cp.plants.integrator_lag_loop(5.0), [0.0]).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("gain", "poles"),
    [
        (5.0, []),
        (0.25, []),
        (1e6, []),
        (-2.0, [1.0]),  # s^2 + s - 2 = (s - 1)(s + 2)
        (-0.75, [0.5]),  # (s - 1/2)(s + 3/2)
        (-1e-6, [1e-6]),
    ],
)
def test_poles_of_the_lag_loop(gain, poles):
    found = unstable_poles(cp.plants.integrator_lag_loop(gain))
    assert found.shape == (len(poles),)
    assert np.allclose(found, poles, rtol=2e-6, atol=0.0)


def test_a_pair_in_the_right_half_plane():
    # s^2 - 2 s + 10 = (s - 1 - 3 i)(s - 1 + 3 i), next to a stable pole
    found = unstable_poles(ct.ss([[2, -10, 0], [1, 0, 0], [0, 0, -1]], [[1], [0], [1]], [[0, 1, 1]], 0))
    assert np.allclose(sorted(found, key=lambda p: p.imag), [1 - 3j, 1 + 3j])
    assert found.dtype == complex


def test_poles_on_the_axis_are_not_in_the_half_plane():
    for matrix in (np.zeros((1, 1)), [[0.0, 1.0], [-4.0, 0.0]], np.eye(3, k=1)):
        assert not unstable_poles(ct.ss(matrix, np.ones((len(matrix), 1)), np.ones((1, len(matrix))), 0)).size


def test_poles_of_a_loop_with_a_plan_inside():
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)], labels=["r"])
    loop = cp.plants.integrator_lag_loop(-2.0)
    planned_loop = ct.interconnect([cp.create_source_iosystem(plan), loop], inputs=0, outputs=["y"])
    assert np.allclose(unstable_poles(planned_loop), [1.0])


def test_poles_of_what_is_not_linear_are_not_known():
    bent = ct.nlsys(lambda t, x, u, p: x**3 + u, None, inputs=1, outputs=1, states=1, name="bent")
    assert unstable_poles(bent).size == 0
    assert unstable_poles(ct.ss(2.0, 1.0, 1.0, 0.0, 0.1)).size == 0
