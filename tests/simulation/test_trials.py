"""Blocks that raise or have memory: trial calls have no side effects, and a run calls each function once per step."""

import math
import random
import types

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

T = np.linspace(0, 4, 41)
STEPS = np.arange(12.0)
PLAN = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(3, 1, 0)])


def lag(name="lag", inputs="u", outputs="y"):
    return ct.nlsys(lambda t, x, u, params: [u[0] - x[0]], inputs=inputs, outputs=outputs, states="x", name=name)


def raising(kind):
    """Static block that raises outside of the inputs that a loop really has."""

    def out(t, x, u, params):
        if not -0.5 <= u[0] <= 1.5:
            raise kind("outside of the table")
        return [2.0 * u[0]]

    return ct.nlsys(None, out, inputs="e", outputs="u", name="table", dt=0)


@pytest.mark.parametrize(
    "kind", [IndexError, KeyError, TypeError, AttributeError, AssertionError, RuntimeError, Exception]
)
@pytest.mark.parametrize("method", ["auto", "python"])
def test_whatever_a_block_raises_in_a_trial_its_loop_runs(kind, method):
    """y' = 2 (r - y) - y in a loop closed over the block: against the same loop of linear blocks."""
    error = ct.summing_junction(["r", "-y"], "e", name="error")
    loop = ct.interconnect([error, raising(kind), lag()], inputs="r", outputs="y")
    plain = ct.ss([[-3.0]], [[2.0]], [[1.0]], [[0.0]])
    found = cp.simulate(loop, T, PLAN, method=method)
    assert np.abs(found.outputs - cp.simulate(plain, T, PLAN).outputs).max() < 1e-7


def test_a_block_that_ends_the_program_in_a_trial_does_not():
    found = cp.simulate(ct.interconnect([raising(SystemExit), lag()], inputs="e", outputs="y"), T, PLAN)
    plain = ct.ss([[-1.0]], [[2.0]], [[1.0]], [[0.0]])
    assert np.abs(found.outputs - cp.simulate(plain, T, PLAN).outputs).max() < 1e-7


def test_what_a_block_raises_in_the_run_reaches_the_caller():
    """If the loop leaves the table, the user's error is raised with block and time."""
    with pytest.raises(KeyError, match="outside of the table") as caught:
        cp.simulate(ct.interconnect([raising(KeyError), lag()], inputs="e", outputs="y"), T, 2.0 * PLAN)
    assert any("in block table at" in note for note in caught.value.__notes__)


def staircase(period):
    """Controller that samples every so many steps, as python-control's example writes it: memory in a closure."""
    step, held = 0, 0.0

    def update(t, x, u, params):
        nonlocal step
        following = 0.9 * x + u if step == 0 else x
        step = (step + 1) % period
        return following

    def out(t, x, u, params):
        nonlocal held
        if step == 0:
            held = float(x[0] + 0.0 * u[0])
        return [held]

    return ct.nlsys(update, out, inputs="e", outputs="u", states="xc", dt=1.0, name="controller")


def recursion(period, loop):
    """The same by hand, alone or in unity feedback around y+ = 0.5 y + 0.2 u."""
    x = y = held = 0.0
    found = []
    for k in range(STEPS.size):
        if k % period == 0:
            held = x
        found.append([held, y])
        e = 1.0 - y if loop else 1.0
        if k % period == 0:
            x = 0.9 * x + e
        y = 0.5 * y + 0.2 * held
    return np.array(found).T


def test_a_discrete_block_with_a_memory_alone():
    found = cp.simulate(staircase(3), STEPS, 1.0)
    assert np.abs(found.outputs - recursion(3, False)[0]).max() < 1e-14


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_a_discrete_loop_with_a_memory(order):
    blocks = [
        ct.summing_junction(["r", "-y"], "e", name="error", dt=1.0),
        staircase(3),
        ct.nlsys(
            lambda t, x, u, params: 0.5 * x + 0.2 * u,
            lambda t, x, u, params: x + 0.0 * u,  # reads its input without effect
            inputs="u",
            outputs="y",
            states="y",
            dt=1.0,
            name="plant",
        ),
    ]
    loop = ct.interconnect([blocks[i] for i in order], inputs="r", outputs=["u", "y"])
    for _ in range(2):  # the memory begins again with a new block, not with a new run
        found = cp.simulate(loop, STEPS, 1.0)
    assert np.abs(found.outputs - recursion(3, True)).max() < 1e-14


def logger(kind, calls, dt):
    """Block that writes down its calls, with the memory where `kind` says."""

    class Log:
        def __init__(self):
            self.calls = calls

        def update(self, t, x, u, params):
            self.calls.append(("update", t))
            return [x[0] + u[0]]

        def out(self, t, x, u, params):
            self.calls.append(("out", t))
            return [x[0] + 0.5 * u[0]]

        def __call__(self, t, x, u, params):
            return self.out(t, x, u, params)

    log = Log()
    outs = {
        "method": log.out,
        "object": log,
        "closure": lambda t, x, u, params: log.out(t, x, u, params),
        "default": lambda t, x, u, params, log=log: log.out(t, x, u, params),
    }
    return ct.nlsys(log.update, outs[kind], inputs="e", outputs="v", states="x", dt=dt, name="logger")


@pytest.mark.parametrize("kind", ["method", "object", "closure", "default"])
def test_output_then_update_once_each_a_sample(kind):
    """In a loop that can be told from an algebraic one only by trials, with a block that reads its input."""
    calls = []
    plant = ct.nlsys(
        lambda t, x, u, params: 0.5 * x + u,
        lambda t, x, u, params: x + 0.0 * u,
        inputs="v",
        outputs="y",
        states="y",
        dt=1.0,
        name="plant",
    )
    error = ct.summing_junction(["r", "-y"], "e", name="error", dt=1.0)
    cp.simulate(ct.interconnect([plant, logger(kind, calls, 1.0), error], inputs="r", outputs="y"), STEPS, 1.0)
    expected = [(what, t) for t in STEPS.tolist() for what in ("out", "update")]
    assert calls == expected


@pytest.mark.parametrize("kind", ["method", "closure"])
def test_a_sampled_block_with_a_memory_in_a_continuous_loop(kind):
    """Output, then update, once each a sample, with what the loop holds then."""
    calls = []
    law = cp.sample_hold(logger(kind, calls, 0.5), 0.5)
    error = ct.summing_junction(["r", "-y"], "e", name="error")
    loop = ct.interconnect([error, law, lag(inputs="v")], inputs="r", outputs="y")
    t = np.linspace(0, 2, 5)
    found = cp.simulate(loop, t, 1.0)
    assert calls == [(what, when) for when in t.tolist() for what in ("out", "update")]
    x, y, expected = 0.0, 0.0, []
    for _ in t:
        expected.append(y)
        v, x = x + 0.5 * (1.0 - y), x + (1.0 - y)
        y = v + (y - v) * math.exp(-0.5)
    assert np.abs(found.outputs - expected).max() < 1e-7


def test_a_filter_written_with_a_global_list():
    """Memory in a global variable that two functions share."""
    space = {"np": np}
    exec(
        "past = [0.0]\n"
        "def out(t, x, u, params):\n    return [0.5 * past[-1] + u[0]]\n"
        "def update(t, x, u, params):\n    past.append(0.5 * past[-1] + u[0])\n    return x\n",
        space,
    )
    block = ct.nlsys(space["update"], space["out"], inputs="u", outputs="y", states="x", dt=1.0, name="filter")
    found = cp.simulate(block, STEPS, 1.0)
    assert np.abs(found.outputs - (2.0 - 0.5**STEPS)).max() < 1e-14
    assert len(space["past"]) == 1 + STEPS.size


def test_a_continuous_block_remembers_the_calls_of_the_run_alone():
    """A block that counts its calls: by Python those of the run, and of a compiled run, which has no calls, none."""
    counts, methods = [], []
    for method in ("auto", "python"):
        count = [0]

        def rates(t, x, u, params, count=count):
            count[0] += 1
            return [u[0] - x[0]]

        block = ct.nlsys(rates, inputs="u", outputs="y", states="y", name="counter")
        found = cp.simulate(block, T, PLAN, method=method)
        counts.append(count[0])
        methods.append(found.method)
    assert counts[1] > 0
    assert counts[0] == (0 if methods[0] == "compiled" else counts[1])


def test_random_generators_are_found_as_they_were():
    def out(t, x, u, params):
        return [u[0] + 0.0 * np.random.normal() + 0.0 * random.random()]  # noqa: NPY002

    noisy = ct.nlsys(None, out, inputs="e", outputs="u", name="noisy", dt=1.0)
    plant = ct.nlsys(
        lambda t, x, u, params: 0.5 * x + u,
        lambda t, x, u, params: x + 0.0 * u,
        inputs="u",
        outputs="y",
        states="y",
        dt=1.0,
        name="plant",
    )
    error = ct.summing_junction(["r", "-y"], "e", name="error", dt=1.0)
    loop = ct.interconnect([plant, noisy, error], inputs="r", outputs="y")
    drawn = []
    for calls in (STEPS.size, 0):  # a draw of each a sample, and no more
        np.random.seed(1)  # noqa: NPY002
        random.seed(1)
        if calls:
            cp.simulate(loop, STEPS, 1.0)
        else:
            for _ in STEPS:
                np.random.normal(), random.random()  # noqa: NPY002
        drawn.append((np.random.normal(), random.random()))  # noqa: NPY002
    assert drawn[0] == drawn[1]


# Copies and keepers: what each can do and the other cannot


def counting(box):
    """Block that counts its calls in an attribute of a module."""

    def out(t, x, u, params):
        box.calls = box.calls + 1
        return [u[0]]

    return ct.nlsys(None, out, inputs="u", outputs="y", name="counting", dt=0)


def test_a_keeper_puts_back_what_stands_in_a_module():
    from ctrlplan.symbolic.fingerprint import roots_of
    from ctrlplan.symbolic.keeper import Keeper
    from ctrlplan.symbolic.references import References

    box = types.ModuleType("box")
    box.calls = 7
    system = counting(box)
    keeper = Keeper(References(roots_of(system)))
    system.outfcn(0.0, np.empty(0), np.ones(1), {})
    assert box.calls == 8
    assert "calls" in [key for _, key in keeper.changes()]
    keeper.restore()
    assert box.calls == 7
    assert keeper.changes() == []


def test_a_copy_draws_what_the_block_will_draw_and_a_keeper_says_that_it_cannot():
    from ctrlplan.symbolic.fingerprint import roots_of
    from ctrlplan.symbolic.references import References
    from ctrlplan.symbolic.trials import trial_copy

    generator = np.random.default_rng(3)
    system = ct.nlsys(None, lambda t, x, u, p: [generator.normal()], inputs="u", outputs="y", name="noise", dt=0)
    assert "random numbers" in References(roots_of(system)).opaque
    copied = [trial_copy(system).outfcn(0.0, [], [0.0], {}) for _ in range(2)]
    assert copied[0] == copied[1] == system.outfcn(0.0, [], [0.0], {})


def test_two_memories_at_one_time():
    from ctrlplan.symbolic.trials import trial_copy

    total = [0.0]

    def out(t, x, u, params):
        total[0] += u[0]
        return [total[0]]

    system = ct.nlsys(None, out, inputs="u", outputs="y", name="sum", dt=0)
    system.outfcn(0.0, [], [1.0], {})
    other = trial_copy(system)
    assert [system.outfcn(0.0, [], [1.0], {}), other.outfcn(0.0, [], [10.0], {})] == [[2.0], [11.0]]
    assert [system.outfcn(0.0, [], [1.0], {}), other.outfcn(0.0, [], [10.0], {})] == [[3.0], [21.0]]
