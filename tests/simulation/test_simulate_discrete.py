"""Discrete systems: python-control's own response, driven by the plan's samples."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

DT = 0.1
T = DT * np.arange(41)
PLAN = cp.TrigSpline([cp.Waypoint(0.45, 0, 0, 0), cp.Waypoint(2.3, 1, 0, 0)], alpha=1.0, labels=["r"])
TWO = cp.stack([PLAN, cp.Step(-1.0, time=1.0)], labels=["a", "b"])


def recursion(rate, out, samples, initial):
    x, states, outputs = np.asarray(initial, dtype=float), [], []
    for u in samples.T:
        states.append(x)
        outputs.append(out(x, u))
        x = rate(x, u)
    return np.array(outputs).T, np.array(states).T


@pytest.mark.parametrize("method", ["auto", "python"])
def test_a_linear_recursion(method):
    a, b = np.array([[0.9, 0.2], [-0.3, 0.7]]), np.array([[0.1, 0.0], [0.4, 1.0]])
    c, d = np.array([[1.0, 0.0], [1.0, -1.0]]), np.array([[0.0, 0.5], [0.0, 0.0]])
    found = cp.simulate(ct.ss(a, b, c, d, DT), T, TWO, [1.0, -0.5], method=method)
    outputs, states = recursion(lambda x, u: a @ x + b @ u, lambda x, u: c @ x + d @ u, TWO(T), [1.0, -0.5])
    assert np.abs(found.outputs - outputs).max() <= 1e-13
    assert np.abs(found.states - states).max() <= 1e-13
    assert np.array_equal(found.inputs, TWO(T))
    assert found.method == "python"


def test_a_logistic_recursion_with_params():
    logistic = ct.nlsys(
        lambda t, x, u, p: p["r"] * x * (1 - x) + 0.01 * u,
        None,
        inputs=1,
        outputs=1,
        states=1,
        params={"r": 2.0},
        dt=DT,
    )
    for r in (2.0, 2.9):
        found = cp.simulate(logistic, T, PLAN, 0.3, params={"r": r} if r != 2.0 else None)
        states = recursion(lambda x, u, r=r: r * x * (1 - x) + 0.01 * u, lambda x, u: x, PLAN(T)[None], [0.3])[1]
        assert np.abs(found.states - states).max() <= 1e-12


def test_a_plan_inside_a_discrete_loop():
    held = ct.ss(0.5, 1.0, 1.0, 0.0, DT, inputs="r", outputs="y", name="held")
    loop = ct.interconnect([cp.create_source_iosystem(PLAN), held], inputs=0, outputs=["y"], name="driven")
    found = cp.simulate(loop, T, initial_state=0.25)
    states = recursion(lambda x, u: 0.5 * x + u, lambda x, u: x, PLAN(T)[None], [0.25])[1]
    assert np.abs(found.states - states).max() <= 1e-14
    assert np.abs(found.outputs - states).max() <= 1e-14


def test_samples_numbers_and_names():
    system = ct.ss(0.5, [[1.0, 2.0]], 1.0, 0.0, DT, inputs=["r", "d"], outputs="y")
    samples = np.sin(T)
    found = cp.simulate(system, T, {"d": 0.1, "r": samples})
    states = recursion(lambda x, u: 0.5 * x + u[0] + 2 * u[1], lambda x, u: x, np.array([samples, 0.1 + 0 * T]), [0.0])[
        1
    ]
    assert np.abs(found.states - states).max() <= 1e-14


def test_equal_to_the_peer():
    system = ct.ss(0.5, 1.0, 1.0, 0.0, DT)
    assert np.array_equal(cp.simulate(system, T, PLAN).outputs, ct.input_output_response(system, T, PLAN(T)).outputs)


def test_a_static_discrete_block():
    found = cp.simulate(ct.ss([], [], [], [[2.0]], DT), T, PLAN)
    assert np.abs(found.outputs - 2 * PLAN(T)).max() <= 1e-15


def test_the_exact_method_is_for_continuous_systems():
    with pytest.raises(ValueError, match=r'method "exact".*discrete \(dt = 0.1\)'):
        cp.simulate(ct.ss(0.5, 1.0, 1.0, 0.0, DT, name="held"), T, PLAN, method="exact")
