"""Shapes, labels and order of the response: those of python-control's own input_output_response."""

import itertools
from functools import cache

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

T = np.linspace(0.0, 4.0, 81)
MOVE = [cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(1.5, 1, 0, 0)]
PLAN = cp.TrigSpline(MOVE, alpha=1.0, labels=["r"])
TWO = cp.stack([PLAN, -2.0 * PLAN.shift(0.5)], labels=["r", "d"])
A = np.array([[-1.0, 2.0], [0.0, -3.0]])
TIGHT = {"rtol": 1e-6, "atol": 1e-8}


def planned_loop(outputs):
    loop = cp.plants.integrator_lag_loop(5.0, outputs)
    return ct.interconnect(
        [cp.create_source_iosystem(PLAN), loop], inputs=0, outputs=list(outputs), name="planned_loop"
    )


def loop_of_three():
    """States of two blocks, named, in the order of the blocks."""
    error = ct.summing_junction(inputs=["r", "-y"], output="e", name="error")
    filtered = ct.ss(-2.0, 2.0, 1.0, 0.0, inputs="e", outputs="u", states=["lagged"], name="filter")
    plant = ct.ss(A, [[0.0], [1.0]], np.eye(2), 0, inputs="u", outputs=["y", "z"], states=["a", "b"], name="plant")
    return ct.interconnect([plant, error, filtered], inputs=["r"], outputs=["z", "u", "y"], name="three")


def bent(ninputs, noutputs):
    def rate(t, x, u, params):
        return np.array([-(x[0] ** 3) + np.sum(u), x[0] - x[1]])

    def out(t, x, u, params):
        return np.array([x[0], x[1] ** 2])[:noutputs]

    return ct.nlsys(rate, out, inputs=ninputs, outputs=noutputs, states=["p", "q"], name="bent")


SYSTEMS = {
    "one in, one out": (ct.ss(A, [[0], [1]], [[1, 0]], 0, inputs="r", outputs="y", name="siso"), PLAN),
    "one in, two out": (ct.ss(A, [[0], [1]], np.eye(2), [[0], [1]], name="simo"), PLAN),
    "two in, one out": (ct.ss(A, np.eye(2), [[1, 1]], [[0, 2]], name="miso"), TWO),
    "two in, two out": (ct.ss(A, [[1, 2], [0, 1]], np.eye(2), 0, inputs=["f", "g"], name="mimo"), TWO),
    "interconnected": (loop_of_three(), PLAN),
    "one out, no inputs": (planned_loop(["y"]), None),
    "two out, no inputs": (planned_loop(["u", "y"]), None),
    "bent, one in, one out": (bent(1, 1), PLAN),
    "bent, two in, two out": (bent(2, 2), TWO),
    "bent, no inputs": (bent(0, 1), None),
    "sampled": (ct.ss(0.5 * A, np.eye(2), [[1, 1]], 0, 0.05, name="sampled"), TWO),
    "sampled, one in, one out": (ct.ss(0.5, 1.0, 1.0, 0.0, 0.05, name="plain"), PLAN),
}
METHODS = {name: ("python",) if "bent" in name or "sampled" in name else ("exact", "python") for name in SYSTEMS}


@cache
def pair(name, method, squeeze=None):
    system, plan = SYSTEMS[name]
    initial = np.arange(1.0, system.nstates + 1) / 4
    found = cp.simulate(system, T, plan, initial, method=method, **TIGHT)
    inputs = 0 if plan is None else cp.source_samples(plan, T)
    peer = ct.input_output_response(system, T, inputs, initial, solve_ivp_kwargs=TIGHT)
    return found, peer, plan


@pytest.mark.parametrize("squeeze", [None, True, False])
@pytest.mark.parametrize(("name", "method"), [(n, m) for n in SYSTEMS for m in METHODS[n]])
def test_shapes(name, method, squeeze, monkeypatch):
    if squeeze is not None:
        monkeypatch.setitem(ct.config.defaults, "control.squeeze_time_response", squeeze)
    found, peer, plan = pair(name, method, squeeze)
    assert isinstance(found, type(peer))
    assert found.outputs.shape == peer.outputs.shape
    assert found.states.shape == peer.states.shape
    assert np.array_equal(found.time, T)
    if plan is not None:
        assert found.inputs.shape == peer.inputs.shape
    for attribute in (
        "issiso",
        "noutputs",
        "ninputs",
        "nstates",
        "ntraces",
        "squeeze",
        "transpose",
        "return_x",
        "sysname",
    ):
        assert getattr(found, attribute) == getattr(peer, attribute), attribute


@pytest.mark.parametrize(("name", "method"), [(n, m) for n in SYSTEMS for m in METHODS[n]])
def test_labels(name, method):
    found, peer, plan = pair(name, method)
    assert list(found.output_labels) == list(peer.output_labels)
    assert list(found.state_labels) == list(peer.state_labels)
    if plan is not None:
        assert list(found.input_labels) == list(peer.input_labels)


@pytest.mark.parametrize(("name", "method"), [(n, m) for n in SYSTEMS for m in METHODS[n]])
def test_order(name, method):
    """The peer sees the plan as samples, linear in between: near enough to tell the signals apart."""
    found, peer, plan = pair(name, method)
    assert np.abs(found.outputs - peer.outputs).max() <= 0.01
    assert np.abs(found.states - peer.states).max() <= 0.01
    for one in (np.atleast_2d(found.states), np.atleast_2d(found.outputs)):
        apart = [np.abs(a - b).max() for i, a in enumerate(one) for b in one[:i]]
        assert min(apart, default=1.0) > 0.2  # or the comparison could not fail
    if plan is not None:
        assert np.abs(found.inputs - peer.inputs).max() <= 1e-14


@pytest.mark.parametrize("outputs", [["y"], ["u", "y"]])
def test_two_words_for_the_same_response(outputs):
    found = cp.simulate(planned_loop(outputs), T)
    assert np.array_equal(found.y.reshape(found.outputs.shape), found.outputs)
    assert np.array_equal(found.x, found.states)
    assert np.array_equal(found.t, T)
    for i, label in enumerate(outputs):
        assert np.array_equal(np.asarray(found.outputs[label]).ravel(), np.atleast_2d(found.outputs)[i])


def test_a_response_unpacks_as_ever():
    system, plan = SYSTEMS["one in, one out"]
    t, y = cp.simulate(system, T, plan)
    assert np.array_equal(t, T)
    assert y.shape == T.shape


@pytest.mark.parametrize("name", ["one in, one out", "two out, no inputs", "bent, no inputs"])
def test_a_response_plots_without_options(name):
    """A loop without inputs needs plot_inputs=False of python-control's own response."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    system, plan = SYSTEMS[name]
    drawn = cp.simulate(system, T, plan).plot()
    assert np.size(drawn.lines) >= system.noutputs
    plt.close("all")


def test_times_may_be_a_list_of_whole_numbers():
    system, plan = SYSTEMS["one in, one out"]
    found = cp.simulate(system, [0, 1, 3], plan)
    assert np.array_equal(found.time, [0.0, 1.0, 3.0])
    assert np.array_equal(found.outputs, cp.simulate(system, np.array([0.0, 1.0, 3.0]), plan).outputs)


@pytest.mark.parametrize("dt", [0, 0.5])
@pytest.mark.parametrize("linear", [True, False])
def test_systems_without_outputs(linear, dt):
    t = np.linspace(0.0, 2.0, 5)
    if linear:
        system = ct.ss(-0.5, 1.0, np.zeros((0, 1)), np.zeros((0, 1)), dt)
    else:
        system = ct.nlsys(lambda t, x, u, p: u - 0.5 * x, lambda t, x, u, p: [], inputs=1, outputs=0, states=1, dt=dt)
    same = ct.ss(-0.5, 1.0, 1.0, 0.0, dt)
    for method in ("auto", "python"):
        found = cp.simulate(system, t, 1.0, method=method)
        assert found.outputs.shape == (0, 5)
        assert np.abs(found.states[0] - cp.simulate(same, t, 1.0).outputs).max() <= 1e-7


def test_parameters_of_a_response_are_those_given():
    system = ct.nlsys(lambda t, x, u, p: u - p["k"] * x, None, inputs=1, outputs=1, states=1, params={"k": 2.0})
    t = np.linspace(0.0, 1.0, 5)
    for params in (None, {"k": 3.0}):
        peer = ct.input_output_response(system, t, np.ones(5), params=params)
        found = cp.simulate(system, t, 1.0, params=params)
        assert found.params == peer.params
    given = {"k": 4.0}
    found = cp.simulate(system, t, 1.0, params=given)
    given["k"] = 5.0
    assert found.params == {"k": 4.0}


@pytest.mark.parametrize("method", ["auto", "compiled", "python"])
def test_a_system_of_states_alone(method):
    times = np.linspace(0.0, 3.0, 31)
    system = ct.nlsys(lambda t, x, u, p: [-(x[0] ** 2)], None, inputs=0, outputs=0, states=1)
    found = cp.simulate(system, times, None, [1.0], method=method)
    assert found.outputs.shape == found.inputs.shape == (0, times.size)
    assert np.abs(found.states[0] - 1.0 / (1.0 + times)).max() <= 1e-6 * np.ptp(found.states[0])


@pytest.mark.every_combination
@pytest.mark.parametrize("timepts", [np.linspace(0.0, 1.0, 50), [0.0, 0.1, 0.35, 1.0]], ids=["even", "uneven"])
@pytest.mark.parametrize(("nstates", "ninputs", "noutputs"), list(itertools.product((0, 3), (0, 1, 2), (0, 2))))
@pytest.mark.parametrize("method", ["auto", "exact", "compiled", "python"])
def test_any_number_of_signals_may_be_zero(nstates, ninputs, noutputs, method, timepts):
    """x' = -x + sum(u) with a constant input of one: closed form, also where nothing is left to compute."""
    d = np.arange(1.0, noutputs * ninputs + 1.0).reshape(noutputs, ninputs)
    system = ct.ss(-np.eye(nstates), np.ones((nstates, ninputs)), np.ones((noutputs, nstates)), d, 0)
    for inputs in (1.0, np.ones((ninputs, len(timepts)))):
        response = cp.simulate(system, timepts, inputs, np.arange(1.0, nstates + 1.0), method=method)
        decay = np.exp(-np.asarray(timepts))
        states = ninputs * (1.0 - decay) + np.arange(1.0, nstates + 1.0)[:, None] * decay
        np.testing.assert_allclose(response.states, states, rtol=1e-6)
        outputs = states.sum(axis=0) + np.repeat(d.sum(axis=1)[:, None], decay.size, axis=1)
        np.testing.assert_allclose(response.outputs, outputs, rtol=1e-6)


@pytest.mark.parametrize("linear", [True, False])
def test_discrete_systems_without_any_signal(linear):
    system = ct.ss([], [], [], [], 0.5) if linear else ct.nlsys(None, lambda t, x, u, p: u, inputs=0, outputs=0, dt=0.5)
    response = cp.simulate(system, [0.0, 0.5, 1.0])
    assert response.states.shape == (0, 3)
    assert np.shape(response.outputs) == (0, 3)


def test_linear_blocks_without_inputs_in_a_loop_without_inputs():
    """Two outputs that decay, passed on by an interconnection that has no input at all."""
    free = ct.ss(-np.eye(2), np.zeros((2, 0)), np.eye(2), np.zeros((2, 0)), outputs=["y", "z"], name="free")
    loop = ct.interconnect([free], connections=False, outlist=["free.y", "free.z"], outputs=["y", "z"])
    for method in ("auto", "exact", "compiled", "python"):
        response = cp.simulate(loop, T, initial_state=[1.0, 2.0], method=method)
        np.testing.assert_allclose(response.outputs, np.outer([1.0, 2.0], np.exp(-T)), rtol=1e-6)
