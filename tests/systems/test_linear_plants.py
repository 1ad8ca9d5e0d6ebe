"""Loops around linear plants, against python-control's own feedback() and by hand."""

import control as ct
import numpy as np
import pytest

from ctrlplan import plants

S = np.concatenate([1j * np.geomspace(1e-3, 1e4, 40), [0.3 + 0.4j, -0.2 + 3j, 2.0]])
GAINS = [1e-3, 0.25, 1.0, 5.0, 1e3, 1e6, -2.0, 0.0]
PLANTS = {
    "integrator and lag": ([1.0], [1.0, 1.0, 0.0]),
    "lag": ([3.0], [2.0, 1.0]),
    "zero": ([1.0, 2.0], [1.0, 3.0, 5.0]),
    "third": ([2.0, -1.0, 4.0], [1.0, 2.0, 3.0, 4.0]),
    "leading zeros": ([0.0, 0.0, 1.0], [0.0, 1.0, 1.0]),
    "integrator": ([4.0], [1.0, 0.0]),
}


def peers(num, den, gain):
    """y, u and e over r, by python-control."""
    plant, forward = ct.tf(np.trim_zeros(num, "f"), np.trim_zeros(den, "f")), ct.tf([gain], [1.0])
    return {
        "y": ct.feedback(forward * plant, 1),
        "u": ct.feedback(forward, plant),
        "e": ct.feedback(ct.tf([1.0], [1.0]), forward * plant),
    }


def agree(loop, num, den, gain):
    """y, u and e of equal value at many points of the plane, to the size of what they are differences of."""
    found = np.array([loop(s).ravel() for s in S]).T
    y, u, e = (np.array([peer(s) for s in S]) for peer in peers(num, den, gain).values())
    sizes = np.maximum(np.abs(y), 1e-3 * np.abs(y).max()), abs(gain) * (1 + np.abs(y)), 1 + np.abs(y)
    return all(np.all(np.abs(f - p) <= 1e-11 * size) for f, p, size in zip(found, (y, u, e), sizes, strict=True))


@pytest.mark.parametrize("gain", GAINS)
@pytest.mark.parametrize("plant", PLANTS)
def test_transfer_functions_of_the_loop(plant, gain):
    num, den = PLANTS[plant]
    loop = plants.unity_feedback_loop(num, den, gain, outputs=("y", "u", "e"))
    assert agree(loop, num, den, gain)


@pytest.mark.parametrize("gain", GAINS)
def test_the_integrator_lag_loop_by_hand(gain):
    # y/r = k/(s^2 + s + k)
    loop = plants.integrator_lag_loop(gain)
    exact = gain / (S**2 + S + gain)
    assert np.all(np.abs([loop(s) for s in S] - exact) <= 1e-11 * np.abs(exact))
    assert np.allclose(np.poly(loop.poles()), [1.0, 1.0, gain], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("direct", [2.0, -0.5])
@pytest.mark.parametrize("gain", [0.3, 1.0, 20.0])
def test_a_plant_with_feedthrough(gain, direct):
    """Solvable as long as 1 + gain direct is not 0: u = (e of the plant's state)/(1 + gain direct)."""
    num, den = np.polyadd([direct, direct], [3.0]), [1.0, 1.0]  # direct + 3/(s + 1)
    loop = plants.unity_feedback_loop(num, den, gain, outputs=("y", "u", "e"))
    assert (loop.nstates, loop.input_labels, loop.output_labels) == (1, ["r"], ["y", "u", "e"])
    assert loop.isctime(strict=True)
    assert agree(loop, num, den, gain)


def test_a_plant_without_dynamics():
    loop = plants.unity_feedback_loop([2.0], [4.0], 3.0, outputs=("y", "u", "e"))
    assert np.abs(loop(1j).ravel() - [1.5 / 2.5, 3.0 / 2.5, 1.0 / 2.5]).max() <= 1e-14


def test_it_is_an_interconnection():
    loop = plants.integrator_lag_loop(5.0)
    assert isinstance(loop, ct.InterconnectedSystem)
    assert isinstance(loop, ct.InputOutputSystem)
    assert loop.input_labels == ["r"]
    assert loop.output_labels == ["y"]
    assert loop.nstates == 2
    assert loop.isctime(strict=True)
    assert [block.name for block in loop.syslist] == ["error", "controller", "plant"]
    assert isinstance(plants.unity_feedback_loop([1.0], [1.0, 1.0]), ct.InterconnectedSystem)


@pytest.mark.parametrize("outputs", [["y"], ["u", "y"], ("e", "u", "y"), "y"])
def test_outputs_in_the_requested_order(outputs):
    loop = plants.integrator_lag_loop(5.0, outputs)
    assert loop.output_labels == list(outputs)
    # At the state y' = 0, y = 1/2 with r = 2: e = 3/2, u = 15/2.
    values = {"y": 0.5, "u": 7.5, "e": 1.5}
    assert np.abs(loop.output(0.0, [0.0, 0.5], [2.0]) - [values[name] for name in outputs]).max() <= 1e-14


def test_the_states_are_the_plants():
    # y'' = -y' + k (r - y), with y' before y.
    loop = plants.integrator_lag_loop(5.0)
    assert np.abs(loop.dynamics(0.0, [0.2, 0.5], [2.0]) - [-0.2 + 5 * 1.5, 0.2]).max() <= 1e-14


def test_python_control_simulates_it_by_itself():
    # The step response of k = 1/4: 1 - (1 + t/2) exp(-t/2).
    t = np.linspace(0.0, 20.0, 101)
    found = ct.step_response(plants.integrator_lag_loop(0.25), t)
    assert np.abs(found.outputs - (1 - (1 + t / 2) * np.exp(-t / 2))).max() <= 1e-12


@pytest.mark.parametrize("gain", [np.nan, np.inf, -np.inf])
def test_a_gain_that_is_not_a_number(gain):
    for make in (plants.integrator_lag_loop, lambda k: plants.unity_feedback_loop([1.0], [1.0, 1.0], k)):
        with pytest.raises(ValueError, match=f"gain must be finite, got {gain}"):
            make(gain)


@pytest.mark.parametrize(("num", "den", "degrees"), [([1, 0, 0], [1, 1], "2 over 1"), ([1, 2], [3], "1 over 0")])
def test_an_improper_plant(num, den, degrees):
    with pytest.raises(ValueError, match=f"num must not be of higher degree than den, got {degrees}"):
        plants.unity_feedback_loop(num, den)


@pytest.mark.parametrize(
    ("num", "den", "gain"), [([1, 0], [1, 1], -1.0), ([-2.0, 1.0], [4.0, 3.0], 2.0), ([1.0], [2.0], -2.0)]
)
def test_a_loop_without_a_solution(num, den, gain):
    with pytest.raises(ValueError, match=r"the loop must have a solution, got 1 \+ gain num/den = 0 at infinity"):
        plants.unity_feedback_loop(num, den, gain)


@pytest.mark.parametrize("name", ["num", "den"])
@pytest.mark.parametrize("wrong", [[], [0.0], [0.0, 0.0], [1.0, np.nan], [np.inf], [[1.0, 2.0]]], ids=str)
def test_coefficients(name, wrong):
    given = {"num": [1.0], "den": [1.0, 1.0, 1.0]} | {name: wrong}
    with pytest.raises(ValueError, match=f"{name} must be finite coefficients, not all 0, got"):
        plants.unity_feedback_loop(**given)


@pytest.mark.parametrize(
    "make", [plants.integrator_lag_loop, lambda g, o: plants.unity_feedback_loop([1], [1, 1], g, o)]
)
@pytest.mark.parametrize("outputs", [["x"], ["y", "r"], ["Y"]])
def test_an_output_that_there_is_not(make, outputs):
    with pytest.raises(ValueError, match=f'outputs must be of "y", "u", "e", got {outputs[-1]!r}'):
        make(1.0, outputs)
