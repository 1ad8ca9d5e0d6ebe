"""Trial calls of a block have no side effects: errors, memory, random numbers and warnings."""

import random
import sys
import warnings

import control as ct
import numpy as np
import pytest
from scipy import stats

import ctrlplan as cp

T = np.linspace(0.0, 3.0, 31)


def block(update, output=None, **options):
    return ct.nlsys(update, output, **({"inputs": 0, "outputs": 1, "states": 1, "name": "tried"} | options))


# Errors

TABLE = [40.0, 25.0, 16.0, 12.0, 10.0]
"""Ratio of each gear."""


class OfItsOwnError(Exception):
    pass


def looked_up(u):
    return TABLE[int(u) - 1] if u >= 1 else {}["no gear"]


def exited(u):
    return TABLE[0] if u == 1.0 else sys.exit("no such gear")


def recursive(u):
    return TABLE[0] if u == 1.0 else recursive(u)


def of_its_own(u):
    if u != 1.0:
        raise OfItsOwnError
    return TABLE[0]


def imaginary(u):
    return TABLE[0] if u == 1.0 else 1j


@pytest.mark.parametrize("ratio", [looked_up, exited, recursive, of_its_own, imaginary], ids=lambda f: f.__name__)
def test_arguments_outside_of_a_domain(ratio):
    """x' = -x ratio(gear)/40 with the gear 1 at all times of the run."""
    system = block(lambda t, x, u, p: [-x[0] * ratio(u[0]) / 40.0], inputs="gear", params={"unused": 1.0})
    found = cp.simulate(system, T, 1.0, 1.0)
    assert found.method == "python"
    assert "block tried" in found.reason
    assert np.abs(found.states[0] - np.exp(-T)).max() <= 1e-6


def test_an_exit_in_a_run_reaches_the_caller():
    system = block(lambda t, x, u, p: [1.0 if t < 1.0 else sys.exit("the end")])
    with pytest.raises(SystemExit, match="the end"):
        cp.simulate(system, T, None, 0.0)


def test_an_interruption_of_a_trial_reaches_the_caller():
    def update(t, x, u, p):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cp.simulate(block(update), T, None, 0.0)


# Memory


def relay_in_a_closure():
    on = 1.0

    def force(x):
        nonlocal on
        on = 1.0 if x < 0.2 else (0.0 if x > 0.8 else on)
        return on

    return force


def relay_in_a_dictionary():
    memory = {"on": 1.0}

    def force(x):
        memory["on"] = 1.0 if x < 0.2 else (0.0 if x > 0.8 else memory["on"])
        return memory["on"]

    return force


def relay_that_traces():
    """Written so that a symbol passes through, too."""
    memory = np.ones(1, dtype=object)

    def force(x):
        memory[0] = np.where(x < 0.2, 1.0, np.where(x > 0.8, 0.0, memory[0]))
        return memory[0]

    return force


class Relay:
    def __init__(self):
        self.on = 1.0

    def force(self, x):
        self.on = 1.0 if x < 0.2 else (0.0 if x > 0.8 else self.on)
        return self.on


def relay_in_an_object():
    return Relay().force


def relay_in_a_list():
    states = [1.0]

    def force(x):
        states.append(1.0 if x < 0.2 else (0.0 if x > 0.8 else states[-1]))
        return states[-1]

    return force


def relay_in_a_default():
    def force(x, memory={"on": 1.0}):  # noqa: B006
        memory["on"] = 1.0 if x < 0.2 else (0.0 if x > 0.8 else memory["on"])
        return memory["on"]

    return force


RELAYS = [relay for name, relay in sorted(globals().items()) if name.startswith("relay_")]


@pytest.mark.parametrize("relay", RELAYS, ids=lambda relay: relay.__name__)
def test_a_form_is_not_made_of_a_block_with_memory(relay):
    """A relay between its thresholds is on at the start of the run, whatever trial states lie beyond them."""
    force = relay()
    system = block(lambda t, x, u, p: [2.0 * force(x[0]) - x[0]])
    with pytest.raises(ValueError, match="block tried"):
        cp.simulate(system, T, None, 0.5, method="compiled")
    assert force(0.5) == 1.0
    found = cp.simulate(system, np.linspace(0.0, 0.2, 5), None, 0.5)
    assert found.method == "python"
    # It heats from 0.5 towards 2 and is switched off after ln(1.5/1.2) = 0.22 s.
    assert np.abs(found.states[0] - (2.0 - 1.5 * np.exp(-found.time))).max() <= 1e-6


def test_a_switch_of_memory_that_no_trial_reaches():
    """An object array stores a value above 1000: detected by the stored value, not by outputs."""
    memory = np.zeros(1, dtype=object)

    def update(t, x, u, p):
        memory[0] = np.where(x[0] > 1000.0, 1.0, memory[0])
        return [100.0 - 200.0 * memory[0]]

    found = cp.simulate(block(update), np.linspace(0.0, 15.0, 16), None, 0.0, rtol=1e-6)
    assert found.method == "python"
    assert "has memory" in found.reason


@pytest.mark.parametrize("call", ["simulate", "unread"])
def test_a_counter_counts_the_run_alone(call):
    """With and without a parameter to be looked for, a block is called as often."""
    counts = []
    for params in (None, {"unread": 1.0} if call == "unread" else {"k": 1.0}):
        calls = []

        def update(t, x, u, p, calls=calls):
            calls.append(t)
            return [-x[0]]

        system = block(update, params={"k": 1.0} if call == "simulate" else {})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cp.simulate(system, T, None, 1.0, params=params, method="python")
        counts.append(len(calls))
    assert counts[0] == counts[1] > 0


def log_in_a_list():
    calls = []

    def update(t, x, u, p):
        calls.append((t, x[0]))
        return [-p["k"] * x[0]]

    return update, lambda: len(calls)


def log_in_a_closure():
    calls = 0

    def update(t, x, u, p):
        nonlocal calls
        calls += 1
        return [-p["k"] * x[0]]

    return update, lambda: calls


class Counting:
    calls = 0

    def update(self, t, x, u, p):
        self.calls += 1
        return [-p["k"] * x[0]]


def log_in_an_object():
    counting = Counting()
    return counting.update, lambda: counting.calls


def log_in_an_array():
    calls = np.zeros(2, dtype=int)

    def update(t, x, u, p):
        calls[1] += 1
        return [-p["k"] * x[0]]

    return update, lambda: calls[1]


def log_beside_a_gain():
    known = {"calls": 0, "gain": 1.0}

    def update(t, x, u, p):
        known["calls"] += 1
        return [-p["k"] * known["gain"] * x[0]]

    update.known = known
    return update, lambda: known["calls"]


LOGS = [log for name, log in sorted(globals().items()) if name.startswith("log_")]


@pytest.mark.parametrize("log", LOGS, ids=lambda log: log.__name__)
def test_what_is_written_and_never_read_does_not_matter(monkeypatch, log):
    """Trials do not count; the form is kept though the counter moves on."""
    from ctrlplan.symbolic import tracing as traced_module

    traces = []
    plain = traced_module.traced
    monkeypatch.setattr(traced_module, "traced", lambda *given: traces.append(given) or plain(*given))
    update, calls = log()
    ready = cp.prepare(block(update, params={"k": 1.0}))
    ready.compiled({}, [], 0.0, np.ones(1))
    assert calls() == 0
    for k in range(1, 6):
        found = cp.simulate(ready, T, None, 1.0, params={"k": float(k)})
        assert found.method == "compiled"
        assert np.abs(found.states[0] - np.exp(-k * T)).max() <= 1e-6
        cp.simulate(ready, T, None, 1.0, method="python")
        assert calls() > 0
    assert len(traces) == 2  # without parameters of the run, and with


def test_a_gain_next_to_a_counter_still_counts():
    update, _ = log_beside_a_gain()
    system = block(update, params={"k": 1.0})
    for gain in (1.0, 3.0, 1.0):
        update.known["gain"] = gain
        found = cp.simulate(system, T, None, 1.0)
        assert found.method == "compiled"
        assert np.abs(found.states[0] - np.exp(-gain * T)).max() <= 1e-6


def test_the_first_call_that_is_remembered_is_no_log():
    first = {}

    def update(t, x, u, p):
        start = first.setdefault("time", t)
        return [-x[0] + 0.1 * (t - start)]

    found = cp.simulate(block(update), T + 1.0, None, 1.0)
    assert found.method == "python"
    assert "has memory" in found.reason
    assert first == {"time": 1.0}
    assert np.abs(found.states[0] - (0.1 * T - 0.1 + 1.1 * np.exp(-T))).max() <= 1e-6


def test_a_block_with_two_values_for_equal_arguments_is_named():
    system = block(lambda t, x, u, p: [-x[0]], lambda t, x, u, p: [x[0] + 1e-9 * stats.norm.rvs()])
    found = cp.simulate(system, T, None, 1.0)
    assert found.method == "python"
    assert found.reason == "block tried returns different values for equal arguments: it is random or has memory"


# Random numbers and warnings


def test_global_random_generators_are_found_as_they_were():
    """Trials of a block whose function draws through a library: the next numbers are those without it."""
    from ctrlplan.simulation.network import Block
    from ctrlplan.symbolic.tracing import NotTraceableError, traced

    def update(t, x, u, p):
        return [-x[0] + 1e-9 * stats.norm.rvs()]

    system = block(update)
    np.random.seed(5)  # noqa: NPY002
    random.seed(5)
    expected = np.random.normal(size=3).tolist(), random.random()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    random.seed(5)
    with pytest.raises(NotTraceableError, match="returns different values"):
        traced(Block(system, dict(system.params)), {}, 0.0, np.ones(1), np.zeros(0))
    assert (np.random.normal(size=3).tolist(), random.random()) == expected  # noqa: NPY002


def test_warnings_of_trials_do_not_show_and_filters_stay():
    def output(t, x, u, p):
        if float(np.abs(x[0])) > 1.5:
            warnings.warn("far out", stacklevel=1)
        return [np.sqrt(x[0])]

    before = list(warnings.filters)
    with np.errstate(all="raise"):
        found = cp.simulate(block(lambda t, x, u, p: [-x[0]], output), T, None, 1.0)
    assert found.method == "python"
    assert np.abs(found.outputs[0] - np.exp(-T / 2)).max() <= 1e-6
    assert warnings.filters == before


def unscaled(t, x, u, params):
    return x


def scaled(t, x, u, params):
    return params.get("k", 1.0) * x


@pytest.mark.parametrize("output", [unscaled, scaled])
def test_a_function_that_cannot_read_parameters_is_not_called_to_see_whether_it_does(output):
    """An update may be an optimiser's run of minutes: it is called once a sample, and at no made-up state."""
    calls = []

    def update(t, x, u, params):
        return 0.5 * x + 1.0

    def count(frame, event, _):  # a list that the functions filled would be put back after a trial
        if event == "call":
            calls.append(frame.f_code)

    slow = ct.nlsys(update, output, inputs=0, outputs=1, states=1, name="slow", dt=1.0)
    times = np.arange(5.0)
    sys.setprofile(count)
    try:
        with pytest.warns(UserWarning, match="params 'verbose' is read by no block of slow"):
            found = cp.simulate(slow, times, params={"verbose": True})
    finally:
        sys.setprofile(None)
    assert calls.count(update.__code__) == times.size
    assert output is scaled or calls.count(output.__code__) == times.size
    assert np.array_equal(found.states[0], 2.0 - 2.0 * 0.5**times)  # exact in binary


def test_a_parameter_of_a_block_that_must_not_be_called():
    """Its code shows its arguments."""
    generator = np.random.default_rng(0)

    def update(t, x, u, p):
        return [-p.get("k", 1.0) * x[0] + 0.0 * generator.normal()]

    with pytest.warns(UserWarning, match="'gain' is read by no block"):
        cp.simulate(block(update), T, None, 1.0, params={"gain": 2.0})
    state = generator.bit_generator.state
    assert cp.prepare(block(update)).reads("k", 2.0)
    assert not cp.prepare(block(update)).reads("gain", 2.0)
    assert generator.bit_generator.state == state


@pytest.mark.parametrize("method", ["auto", "python"])
@pytest.mark.parametrize("kind", ["rates", "outputs", "exit", "table"])
def test_what_a_block_raises_outside_the_states_of_a_run_when_its_accuracy_is_estimated(kind, method):
    """A run from the very edge of a block's domain: states close to it are tried for the estimate alone."""
    table = [0.0, 10.0, 20.0, 30.0]

    def checked(x):
        if x[0] > 3.0:
            raise SystemExit(3) if kind == "exit" else KeyError("no such gear")
        return x[0]

    def rates(t, x, u, params):
        return [-0.2 * (checked(x) if kind in ("rates", "exit") else x[0])]

    def outputs(t, x, u, params):
        return [table[int(np.ceil(x[0]))] if kind == "table" else checked(x) if kind == "outputs" else x[0]]

    block = ct.nlsys(rates, outputs, inputs=0, outputs="y", states=1, name="gearbox")
    times = np.linspace(0.0, 5.0, 21)
    found = cp.simulate(block, times, None, 3.0, method=method)
    state = 3.0 * np.exp(-0.2 * times)
    expected = 10.0 * np.ceil(state) if kind == "table" else state
    assert np.abs(found.outputs - expected).max() <= 1e-6


@pytest.mark.parametrize("method", ["auto", "python"])
def test_a_block_that_is_defined_only_where_it_rests(method):
    """No state that is tried lies in its domain."""

    def rates(t, x, u, params):
        if x[0] != 1.0:
            raise RuntimeError("limit switch")
        return [0.0]

    block = ct.nlsys(rates, inputs=0, outputs=1, states=1, name="locked")
    assert np.array_equal(
        cp.simulate(block, np.linspace(0.0, 5.0, 21), None, 1.0, method=method).states, np.ones((1, 21))
    )
