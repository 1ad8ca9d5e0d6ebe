"""Bad input: what must hold, what was given, where."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

T = np.linspace(0.0, 2.0, 11)
PLAN = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)], labels=["r"])
LOOP = cp.plants.integrator_lag_loop(5.0)
TWO = ct.ss(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)), inputs=["r", "d"], name="two")
BENT = ct.nlsys(lambda t, x, u, p: -(x**3) + u, None, inputs=["r"], outputs=1, states=1, name="bent")


@pytest.mark.parametrize(
    "timepts",
    [
        [0.0, 1.0, 1.0],
        [0.0, 2.0, 1.0],
        [0.0, np.nan, 1.0],
        [0.0, np.inf],
        [-np.inf, 0.0],
        [0.0],
        [],
        1.0,
        [[0.0, 1.0], [2.0, 3.0]],
    ],
    ids=str,
)
@pytest.mark.parametrize("system", [LOOP, BENT], ids=["linear", "bent"])
def test_times(system, timepts):
    with pytest.raises(ValueError, match="timepts must be two or more finite times that increase strictly, got"):
        cp.simulate(system, timepts, PLAN)


@pytest.mark.parametrize("method", ["compile", "Exact", "", None])
def test_methods(method):
    with pytest.raises(ValueError, match=r"method must be one of auto, exact, .*python, got"):
        cp.simulate(LOOP, T, PLAN, method=method)


@pytest.mark.parametrize("method", ["auto", "exact", "python"])
@pytest.mark.parametrize(
    ("system", "inputs", "match"),
    [
        (LOOP, {"d": 0.1}, "inputs must be among r, got 'd'"),
        (TWO, {"r": PLAN, "y": 0.1}, "inputs must be among r, d, got 'y'"),
        (LOOP, cp.stack([PLAN, PLAN], ["a", "b"]), r"inputs must have 1 axes \(r\), got 2"),
        (TWO, PLAN, r"inputs must have 2 axes \(r, d\), got 1"),
        (TWO, {"d": cp.stack([PLAN, PLAN], ["a", "b"])}, "input d must be driven by one axis, got 2"),
        (TWO, {"d": T[:-1]}, r"input d must be .*11 samples, got shape \(10,\)"),
        (TWO, {"d": np.ones((2, 11))}, r"input d must be .*got shape \(2, 11\)"),
        (TWO, np.ones((3, 11)), r"inputs must have shape \(2, 11\), got \(3, 11\)"),
        (TWO, np.ones((2, 12)), r"inputs must have shape \(2, 11\), got \(2, 12\)"),
        (TWO, T, r"inputs must have shape \(2, 11\), got \(11,\)"),
        (TWO, {"d": np.where(T > 0.5, np.nan, 0.0)}, "input d must be finite, got nan or inf at index 3"),
        (LOOP, np.where(T > 0.5, np.inf, 0.0), "input r must be finite, got nan or inf at index 3"),
        (TWO, {"d": np.nan}, "input d must be finite"),
        (LOOP, np.inf, "input r must be finite"),
    ],
    ids=lambda value: None,
)
def test_inputs(system, inputs, match, method):
    with pytest.raises(ValueError, match=match):
        cp.simulate(system, T, inputs, method=method)


def test_a_system_without_inputs_takes_none():
    driven = ct.interconnect([cp.create_source_iosystem(PLAN), LOOP], inputs=0, outputs=["y"])
    with pytest.raises(ValueError, match="inputs must be among none, got 'r'"):
        cp.simulate(driven, T, {"r": PLAN})
    with pytest.raises(ValueError, match="inputs must have 0 axes"):
        cp.simulate(driven, T, PLAN)


@pytest.mark.parametrize("method", ["exact", "python"])
@pytest.mark.parametrize("initial", [[1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]], []], ids=str)
def test_initial_states(initial, method):
    with pytest.raises(ValueError, match=r"initial_state must be a scalar or have 2 entries, got shape"):
        cp.simulate(LOOP, T, PLAN, initial, method=method)


@pytest.mark.parametrize("method", ["exact", "python"])
@pytest.mark.parametrize("initial", [[np.nan, 0.0], [0.0, np.inf], np.nan], ids=str)
def test_initial_states_that_are_not_numbers(initial, method):
    # Let through, they would come back as a loop that has left the range of numbers.
    with pytest.raises(ValueError, match="initial_state must be finite"):
        cp.simulate(LOOP, T, PLAN, initial, method=method)


@pytest.mark.parametrize(
    ("system", "inputs", "match"),
    [
        (BENT, PLAN, "bent"),
        (ct.interconnect([BENT, LOOP], connections=[["bent.r", "loop.y"]], inplist=["loop.r"], outlist=["bent.y[0]"]),
         PLAN, "bent"),
    ],
    ids=["nonlinear", "nonlinear inside"],
)  # fmt: skip
def test_the_exact_method_says_why_it_cannot(system, inputs, match):
    with pytest.raises(ValueError, match=f'method "exact" .*{match}'):
        cp.simulate(system, T, inputs, method="exact")


@pytest.mark.parametrize("missing", ["states", "inputs"])
def test_a_system_without_stated_sizes_is_named_with_what_to_give(missing):
    sizes = {"states": 1, "inputs": 1, "outputs": 1}
    del sizes[missing]
    system = ct.nlsys(lambda t, x, u, p: -x + u, lambda t, x, u, p: x, name="lag", **sizes)
    with pytest.raises(ValueError, match=rf"system must have a number of {missing}, got lag .* give it {missing}="):
        cp.simulate(system, [0.0, 1.0], 1.0, 0.0)
