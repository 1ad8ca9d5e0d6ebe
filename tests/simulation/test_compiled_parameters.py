"""Compiled loops: one form for all values of parameters, and precedence of parameters."""

import warnings

import control as ct
import numpy as np
import pytest
from compiled_cases import METHODS, T

import ctrlplan as cp
from ctrlplan.symbolic import tracing as traced_module

# Parameters


def cubic(**params):
    return ct.nlsys(
        lambda t, x, u, p: -p["k"] * x**3,
        lambda t, x, u, p: p.get("c", 1.0) * x,
        inputs=0,
        outputs=1,
        states=1,
        params=params or {"k": 1.0},
        name="cubic",
    )


def counted(monkeypatch):
    """Number of traces of blocks."""
    calls = []
    plain = traced_module.traced
    monkeypatch.setattr(traced_module, "traced", lambda block, *args: calls.append(block.name) or plain(block, *args))
    return calls


def test_one_compiled_form_for_all_values(monkeypatch):
    calls = counted(monkeypatch)
    ready = cp.prepare(cubic())
    for k in (1.0, 2.5, 7, np.float64(0.3), 0):
        for start in (1.0, 2.0):
            found = cp.simulate(ready, T, None, start, params={"k": k})
            assert found.method == "compiled"
            assert np.abs(found.states[0] - start / np.sqrt(1 + 2 * k * start**2 * T)).max() <= 1e-6
    assert calls == ["cubic"]
    assert len(ready._built_forms.forms) == 1


def test_one_compiled_form_for_all_plans_and_times(monkeypatch):
    calls = counted(monkeypatch)
    block = ct.nlsys(lambda t, x, u, p: -x + u, lambda t, x, u, p: x**2, inputs=1, outputs=1, states=1, name="driven")
    for height in (1.0, 2.0):
        for n in (11, 21):
            times = np.linspace(0.0, 2.0, n)
            found = cp.simulate(block, times, cp.Step(height, time=0.5))
            exact = (height * -np.expm1(-np.maximum(times - 0.5, 0.0))) ** 2
            assert np.abs(found.outputs - exact).max() <= 1e-7
    assert calls == ["driven"]


def test_arrays_as_parameters():
    block = ct.nlsys(
        lambda t, x, u, p: p["a"] @ x + p["b"] * np.sin(x[0]) * 0.0,
        None,
        inputs=0,
        outputs=2,
        states=2,
        params={"a": np.array([[0.0, 1.0], [-1.0, 0.0]]), "b": np.zeros(2)},
        name="arrays",
    )
    for method in METHODS:
        for w in (1.0, 2.0, 1.0):
            params = {"a": np.array([[0.0, w], [-w, 0.0]])}
            found = cp.simulate(block, T, None, [1.0, 0.0], method=method, params=params, rtol=1e-10)
            assert found.method == method
            assert np.abs(found.states - [np.cos(w * T), -np.sin(w * T)]).max() <= 1e-7


def test_an_array_parameter_changed_in_place():
    block = ct.nlsys(
        lambda t, x, u, p: -p["k"][0] * x**3, None, inputs=0, outputs=1, states=1, params={"k": np.ones(1)}, name="a"
    )
    k = np.array([1.0])
    for value in (1.0, 4.0, 9.0):
        k[0] = value
        found = cp.simulate(block, T, None, 1.0, params={"k": k}, method="compiled")
        assert np.abs(found.states[0] - 1 / np.sqrt(1 + 2 * value * T)).max() <= 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_parameters_that_are_no_numbers(method):
    """A flag, a word, a count and a list choose the equations; they may change from run to run, and back."""

    def rate(t, x, u, p):
        total = sum(x[0] for _ in range(p["count"]))
        total = total * (2.0 if p["double"] else 1.0)
        if p["sign"] == "minus":
            total = -total
        return np.array([total * p["weights"][0]])

    block = ct.nlsys(
        rate,
        None,
        inputs=0,
        outputs=1,
        states=1,
        params={"count": 1, "double": False, "sign": "minus", "weights": [0.5]},
        name="chosen",
    )
    times = np.linspace(0.0, 1.0, 6)
    cases = [
        ({}, -0.5),
        ({"count": 3}, -1.5),
        ({"count": 2}, -1.0),
        ({"count": 3, "double": True}, -3.0),
        ({"count": 3, "double": False}, -1.5),
        ({"sign": "plus", "count": 1}, 0.5),
        ({"sign": "minus", "count": 1}, -0.5),
        ({"weights": [0.25]}, -0.25),
        ({"weights": [0.75]}, -0.75),
        ({}, -0.5),
    ]
    for params, exponent in cases:
        found = cp.simulate(block, times, None, 1.0, method=method, params=params, rtol=1e-10, atol=1e-12)
        assert found.method == method
        assert np.abs(found.states[0] - np.exp(exponent * times)).max() <= 1e-8


def test_a_number_that_becomes_an_array():
    block = cubic()
    for k in (2.0, np.array([3.0]), 4.0):
        found = cp.simulate(block, T, None, 1.0, params={"k": k})
        assert np.abs(found.states[0] - 1 / np.sqrt(1 + 2 * float(np.ravel(k)[0]) * T)).max() <= 1e-6


def test_a_parameter_that_bends_the_equations_beyond_a_value():
    block = ct.nlsys(
        lambda t, x, u, p: -(p["k"] if float(p["k"]) < 5.0 else 20.0) * x,
        None,
        inputs=0,
        outputs=1,
        states=1,
        params={"k": 1.0},
        name="bending",
    )
    for k, rate in ((1.0, 1.0), (6.0, 20.0), (2.0, 2.0)):
        found = cp.simulate(block, T, None, 1.0, params={"k": k})
        assert np.abs(found.states[0] - np.exp(-rate * T)).max() <= 1e-6


def test_a_parameter_that_no_block_reads():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = cp.simulate(cubic(), T, None, 1.0, params={"unknown": 3.0, "word": "w", "k": 2.0})
    expected = [f"params {name!r} is read by no block of cubic" for name in ("unknown", "word")]
    assert [str(w.message) for w in caught] == expected
    assert np.abs(found.states[0] - 1 / np.sqrt(1 + 4 * T)).max() <= 1e-6


# Precedence of parameters


def nested(inner=None, middle=None, outer=None):
    """A cubic decay nested two levels deep, each level with its own parameters."""
    block = cubic(**{"k": 1.0, "c": 1.0, **(inner or {})})
    wire = ct.ss([], [], [], [[1.0]], inputs="y[0]", outputs="z", name="wire", dt=None)
    options = {} if middle is None else {"params": middle}
    first = ct.interconnect(
        [block, wire], inputs=0, outputs=["z"], connections=[["wire.y[0]", "cubic.y[0]"]], **options
    )
    options = {} if outer is None else {"params": outer}
    further = ct.ss([], [], [], [[1.0]], inputs="z", outputs="q", name="further", dt=None)
    return ct.interconnect([first, further], inputs=0, outputs=["q"], **options)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("levels", "run"),
    [
        ({}, None),
        ({"inner": {"k": 2.0}}, None),
        ({"inner": {"k": 2.0}, "middle": {"k": 3.0}}, None),
        ({"inner": {"k": 2.0}, "outer": {"k": 4.0}}, None),
        ({"inner": {"k": 2.0}, "middle": {"k": 3.0}, "outer": {"k": 4.0}}, None),
        ({"inner": {"k": 2.0}, "middle": {"k": 3.0}, "outer": {"k": 4.0}}, {"k": 5.0}),
        ({"inner": {"k": 2.0}, "middle": {"c": 3.0}, "outer": {"c": 4.0}}, {"k": 5.0}),
        ({"middle": {}, "outer": {}}, None),
        ({"outer": {"c": -2.0}}, {"k": 0.5, "c": 7.0}),
    ],
    ids=str,
)
def test_precedence_is_that_of_the_peer(levels, run, method):
    loop = nested(**levels)
    times = np.linspace(0.0, 1.0, 6)
    tolerances = {"rtol": 1e-10, "atol": 1e-12}
    peer = ct.input_output_response(loop, times, 0, 1.0, params=run or {}, solve_ivp_kwargs=tolerances)
    found = cp.simulate(loop, times, None, 1.0, method=method, params=run, **tolerances)
    assert np.abs(found.outputs.ravel() - peer.outputs.ravel()).max() <= 1e-7
    assert np.abs(found.states.ravel() - peer.states.ravel()).max() <= 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_precedence_after_a_change_is_that_of_the_peer(method):
    loop = nested(inner={"k": 2.0})
    first = loop.syslist[0]
    times = np.linspace(0.0, 1.0, 6)
    tolerances = {"rtol": 1e-10, "atol": 1e-12}
    for change in (
        lambda: first.syslist[0].params.update(k=6.0),
        lambda: first.params.update(k=7.0),
        lambda: loop.params.update(k=8.0),
        lambda: (loop.params.clear(), first.params.clear()),
    ):
        change()
        peer = ct.input_output_response(loop, times, 0, 1.0, solve_ivp_kwargs=tolerances)
        found = cp.simulate(loop, times, None, 1.0, method=method, **tolerances)
        assert np.abs(found.outputs.ravel() - peer.outputs.ravel()).max() <= 1e-7
