"""Compiled loops: untraceable blocks, traces that are valid only in part, and a missing CasADi."""

import math
from functools import cache

import control as ct
import numpy as np
import pytest
from compiled_cases import T, tight
from repetitions import one_in
from scipy.special import expit

import ctrlplan as cp
from ctrlplan.symbolic import extra

# Blocks that cannot be traced: run by Python, or correct nevertheless


def zeros_and_entries(t, x, u, p):
    dx = np.zeros(2)
    dx[0] = x[1]
    dx[1] = -np.sin(x[0]) - 0.1 * x[1]
    return dx


def entries_by_loop(t, x, u, p):
    dx = np.empty_like(x)
    for i in range(len(x)):
        dx[i] = x[1] if i == 0 else -np.sin(x[0]) - 0.1 * x[1]
    return dx


def unpacked(t, x, u, p):
    angle, rate = x
    return [rate, -np.sin(angle) - 0.1 * rate]


def comprehended(t, x, u, p):
    sines = [np.sin(v) for v in x]
    return np.array([x[1], -sines[0] - 0.1 * x[1]])


def by_math(t, x, u, p):
    return np.array([x[1], -math.sin(x[0]) - 0.1 * x[1]])


def by_float(t, x, u, p):
    return np.array([float(x[1]), -np.sin(float(x[0])) - 0.1 * float(x[1])])


def by_item(t, x, u, p):
    return np.array([x[1].item(), -np.sin(x.tolist()[0]) - 0.1 * x[1]])


def by_solving(t, x, u, p):
    return np.linalg.solve(
        [[2.0, 1.0], [1.0, 1.0]], [2 * x[1] - np.sin(x[0]) - 0.1 * x[1], x[1] - np.sin(x[0]) - 0.1 * x[1]]
    )


def by_inverse(t, x, u, p):
    mass = np.array([[2.0 + np.cos(x[0]) ** 2, 0.0], [0.0, 1.0]])
    return np.linalg.inv(mass) @ np.array([(2.0 + np.cos(x[0]) ** 2) * x[1], -np.sin(x[0]) - 0.1 * x[1]])


def in_place(t, x, u, p):
    y = x.copy()
    y *= 0.1
    return np.array([10.0 * y[1], -np.sin(10.0 * y[0]) - y[1]])


def as_floats(t, x, u, p):
    x = np.asarray(x, dtype=float)
    return np.array([x[1], -np.sin(x[0]) - 0.1 * x[1]])


def by_matrix(t, x, u, p):
    return np.array([[0.0, 1.0], [0.0, -0.1]]) @ x - np.array([0.0, 1.0]) * np.sin(x)[0]


def stacked(t, x, u, p):
    return np.hstack([x[1:], -np.sin(x[:1]) - 0.1 * x[1:]])


def columns(t, x, u, p):
    return np.array([[x[1]], [-np.sin(x[0]) - 0.1 * x[1]]])


PENDULUM = [
    zeros_and_entries,
    entries_by_loop,
    unpacked,
    comprehended,
    by_math,
    by_float,
    by_item,
    by_solving,
    by_inverse,
    in_place,
    as_floats,
    by_matrix,
    stacked,
    columns,
]


def right_or_python(block, times, initial, states, allowed=1e-6):
    """For any block: compiled with a correct result, or run by Python with its name in the reason."""
    found = cp.simulate(block, times, None, initial)
    assert np.abs(found.states - states).max() <= allowed
    if found.method == "python":
        assert block.name in found.reason
        with pytest.raises(ValueError, match=f"compiled.*block {block.name}"):
            cp.simulate(block, times, None, initial, method="compiled")
    else:
        assert found.method == "compiled"
        again = cp.simulate(block, times, None, initial, method="compiled")
        assert np.abs(again.states - states).max() <= allowed
    python = cp.simulate(block, times, None, initial, method="python")
    assert np.abs(python.states - states).max() <= allowed
    return found


@cache
def pendulum_states():
    return tight(lambda t, x: [x[1], -math.sin(x[0]) - 0.1 * x[1]], T, [2.0, 0.5])


@pytest.mark.parametrize("rate", PENDULUM, ids=lambda rate: rate.__name__)
def test_ways_to_write_a_pendulum(rate):
    block = ct.nlsys(rate, None, inputs=0, outputs=2, states=2, name=f"written_{rate.__name__}")
    right_or_python(block, T, [2.0, 0.5], pendulum_states())


FUNCTIONS = {
    "if": lambda v: v if v > 0.5 else 0.5 * v + 0.25,
    "where": lambda v: np.where(v > 0.5, v, 0.5 * v + 0.25),
    "max": lambda v: max(v, 0.7),
    "maximum": lambda v: np.maximum(v, 0.7),
    "fmin": lambda v: np.fmin(v, 1.2),
    "clip": lambda v: np.clip(v, 0.6, 1.2),
    "abs": lambda v: abs(v - 0.7),
    "sign": lambda v: 0.2 * np.sign(v + 3.0) + v,
    "a comparison times": lambda v: (v > 0.5) * (v - 0.5) + 0.5 * v,
    "arctan2": lambda v: np.arctan2(v, 1.0 + v * v),
    "hypot": lambda v: np.hypot(v, 1.0),
    "tanh": np.tanh,
    "expm1": np.expm1,
    "cbrt": np.cbrt,
    "interp": lambda v: np.interp(v, [0.0, 0.5, 1.0, 3.0], [0.0, 0.2, 0.7, 4.0]),
    "polyval": lambda v: np.polyval([0.1, -0.2, 1.0, 0.0], v),
    "expit": expit,
    "copysign": lambda v: math.copysign(1.0, v) * v,
    "select": lambda v: np.select([v > 1.0, v > 0.5], [v, 0.5 + 0.5 * (v - 0.5) / 0.5], 0.5 + 0.0 * v),
    "power": lambda v: v**1.5,
    "mean": lambda v: np.mean([v, 2.0 * v, 0.0]),
    "norm": lambda v: np.linalg.norm([v, 1.0]),
    "heaviside": lambda v: v * np.heaviside(v - 0.5, 1.0) + 0.5 * v * np.heaviside(0.5 - v, 0.0),
}


@pytest.mark.parametrize("name", one_in(3, FUNCTIONS))
def test_functions_of_a_state(name):
    """x' = -f(x) through a kink, from 2."""
    function = FUNCTIONS[name]
    block = ct.nlsys(
        lambda t, x, u, p: np.array([-function(x[0])]), None, inputs=0, outputs=1, states=1, name=f"bent_{name[:5]}"
    )
    breaks = [0.3]
    states = tight(lambda t, x: [-float(function(x[0]))], T[T <= 1.5], [2.0], breaks, "Radau")
    right_or_python(block, T[T <= 1.5], [2.0], states, 1e-5)


def test_a_random_number_is_no_constant():
    rng = np.random.default_rng(0)
    block = ct.nlsys(
        lambda t, x, u, p: -x,
        lambda t, x, u, p: x + 1e-3 * rng.standard_normal(1),
        inputs=0,
        outputs=1,
        states=1,
        name="noisy",
    )
    found = cp.simulate(block, T, None, 1.0)
    assert found.method == "python"
    assert "noisy" in found.reason
    assert np.abs(found.outputs.ravel() - np.exp(-T)).max() <= 0.01
    assert np.unique(found.outputs.ravel() - np.exp(-T)).size == T.size
    with pytest.raises(ValueError, match="noisy"):
        cp.simulate(block, T, None, 1.0, method="compiled")


def test_a_block_that_remembers_its_arguments():
    """A cache must not return a symbol in a run, nor a number of another state."""
    known = {}

    def rate(t, x, u, p):
        key = (x[0],)
        if key not in known:
            known[key] = -(x[0] ** 3)
        return np.array([known[key]])

    block = ct.nlsys(rate, None, inputs=0, outputs=1, states=1, name="remembering")
    right_or_python(block, T, 1.0, 1 / np.sqrt(1 + 2 * T)[None])


def test_a_block_that_remembers_its_last_answer():
    """A hysteresis: only the run by Python is correct, and no trace."""
    memory = {"on": 1.0}

    def rate(t, x, u, p):
        memory["on"] = 1.0 if x[0] < 0.2 else (0.0 if x[0] > 0.8 else memory["on"])
        return np.array([2.0 * memory["on"] - x[0]])

    block = ct.nlsys(rate, None, inputs=0, outputs=1, states=1, name="relay")
    found = cp.simulate(block, T, None, 0.5, rtol=1e-5)
    assert found.method == "python"
    assert "relay" in found.reason


# Traces that are correct only near the start

OSCILLATION = np.pi * np.arange(13)


def rates_with(force):
    return lambda t, x, u, p: np.array([x[1], -x[0] + force(t, x)])


def stop_at(level):
    return lambda t, x: -500.0 * (x[0] - level) if float(x[0]) > level else 0.0


FAR = {
    "float of time": (rates_with(lambda t, x: 0.0 if float(t) < 50.0 else -3.0 * x[0]), (50.0,)),
    "float of a state": (rates_with(lambda t, x: -3.0 * x[0] if float(x[0]) < -8.0 else 0.0), ()),
    "math of a state": (rates_with(lambda t, x: 0.0 if math.floor(x[0]) > -8.0 else -3.0 * (x[0] + 7.0)), ()),
    "lookup by int": (rates_with(lambda t, x: [0.0, -1.0, -2.0][min(int(abs(x[0]) / 6.0), 2)]), ()),
    "where": (rates_with(lambda t, x: np.where(x[0] < -8.0, -3.0 * (x[0] + 8.0), 0.0)), ()),
}


@pytest.mark.parametrize("name", FAR)
def test_traces_that_are_wrong_far_from_the_start(name):
    rate, breaks = FAR[name]
    times = np.linspace(0.0, 70.0, 141) if breaks else np.linspace(0.0, 7.0, 71)
    block = ct.nlsys(rate, None, inputs=0, outputs=2, states=2, name="far")
    states = tight(lambda t, x: rate(t, x, None, None), times, [10.0, 0.0], breaks)
    assert np.abs(states[0] - 10 * np.cos(times)).max() > 1e-3  # or nothing would be shown
    right_or_python(block, times, [10.0, 0.0], states, 1e-3 if "lookup" in name else 1e-4)


@pytest.mark.slow
def test_a_branch_that_is_taken_between_the_visited_states():
    """A stop at 9.9 of an oscillation of 10, evaluated at its zero crossing: no symbol may be converted to float."""
    rate = rates_with(stop_at(9.9))
    block = ct.nlsys(rate, None, inputs=0, outputs=2, states=2, name="stop")
    states = tight(lambda t, x: rate(t, x, None, None), OSCILLATION, [0.0, 10.0])
    assert np.abs(states[0]).max() > 0.1
    right_or_python(block, OSCILLATION, [0.0, 10.0], states, 1e-4)


def test_a_branch_of_time_between_the_visited_states():
    """A bump of 0.8 s once in 50 s, the samples on either side of it; its ends are declared as breakpoints."""

    def rate(t, x, u, p):
        return np.array([-x[0] + (5.0 if 25.1 < float(t) < 25.9 else 0.0)])

    block = ct.nlsys(rate, None, inputs=0, outputs=1, states=1, name="bump")
    cp.declare(block, breakpoints=(25.1, 25.9))
    times = np.arange(51.0)
    bump = np.where(times > 25.5, 5.0 * (np.exp(25.9 - times) - np.exp(25.1 - times)), 0.0)
    right_or_python(block, times, 1.0, (np.exp(-times) + bump)[None])


def test_a_table_with_the_state_as_its_key():
    """A dictionary with one exact value and a default: a symbol is never a key."""
    table = {0.0: 3.0}

    def out(t, x, u, p):
        return np.array([table.get(float(u[0]), 1.0)])

    block = ct.nlsys(None, out, inputs=1, outputs=1, name="table", dt=0)
    found = cp.simulate(block, np.arange(3.0), np.array([1.0, 0.0, 2.0]))
    hashed = ct.nlsys(None, lambda t, x, u, p: [table.get(u[0], 1.0)], inputs=1, outputs=1, name="hashed", dt=0)
    times = np.linspace(0.0, 10.0, 1001)
    signal = np.maximum(np.abs(times - 5.0) - 0.1, 0.0)
    again = cp.simulate(hashed, times, signal)
    assert found.outputs.tolist() == [1.0, 3.0, 1.0]
    assert again.outputs.tolist() == np.where(signal == 0.0, 3.0, 1.0).tolist()


# Without CasADi


def test_without_casadi_python_runs_and_says_what_to_install(monkeypatch):
    monkeypatch.setattr(extra, "find_spec", lambda name: None)
    block = ct.nlsys(lambda t, x, u, p: -(x**3), None, inputs=0, outputs=1, states=1, name="uncompiled")
    found = cp.simulate(block, T, None, 1.0)
    assert found.method == "python"
    assert "pip install" in found.reason
    assert np.abs(found.states[0] - 1 / np.sqrt(1 + 2 * T)).max() <= 1e-6
    with pytest.raises(ValueError, match=r"compiled.*CasADi is not installed \(pip install ctrlplan\[fast\]\)"):
        cp.simulate(block, T, None, 1.0, method="compiled")
    monkeypatch.undo()
    assert cp.simulate(cp.prepare(block), T, None, 1.0, method="compiled").method == "compiled"
