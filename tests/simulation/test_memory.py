"""Discrete blocks with memory other than their states: studies begin each run with the same memory."""

import array
import collections
import concurrent.futures
import gc
import itertools
import random
import warnings

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

PLAN = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
PERIOD = 0.02


class Attribute:
    def __init__(self):
        self.total = 0.0

    def __call__(self, error):
        self.total += 4.0 * PERIOD * error
        return 2.0 * error + self.total


class Slotted:
    __slots__ = ("total",)

    def __init__(self):
        self.total = 0.0

    __call__ = Attribute.__call__


class Nested:
    def __init__(self):
        self.inner = Attribute()
        self.filters = [lambda error: error, self.inner]

    def __call__(self, error):
        return self.filters[1](self.filters[0](error))


class OfClass:
    def __call__(self, error):
        cls = type(self)
        cls.total += 4.0 * PERIOD * error
        return 2.0 * error + cls.total


def of_class():
    return type("Own", (OfClass,), {"total": 0.0})()


def closure():
    total = 0.0

    def law(error):
        nonlocal total
        total += 4.0 * PERIOD * error
        return 2.0 * error + total

    return law


def stored_in(memory):
    def law(error):
        memory[0] += 4.0 * PERIOD * error
        return 2.0 * error + memory[0]

    return law


def history(kind):
    def law(error, past=kind()):  # noqa: B008
        past.append(error)
        return 2.0 * error + 4.0 * PERIOD * sum(past)

    return law


def default():
    def law(error, memory={"total": 0.0}):  # noqa: B006
        memory["total"] += 4.0 * PERIOD * error
        return 2.0 * error + memory["total"]

    return type(law)(law.__code__, law.__globals__, "law", ({"total": 0.0},))


LAWS = {
    "attribute": Attribute,
    "slot": Slotted,
    "nested": Nested,
    "class": of_class,
    "closure": closure,
    "list": lambda: stored_in([0.0]),
    "ndarray": lambda: stored_in(np.zeros(1)),
    "array": lambda: stored_in(array.array("d", [0.0])),
    "history": lambda: history(list),
    "deque": lambda: history(collections.deque),
    "function default": default,
}


def loop(law, kind="hold"):
    """PI control of x' = -x - 0.1 sin x + u, with the law's own memory as the integral."""
    signals = {"inputs": ["r", "y"], "outputs": "u", "name": "law"}
    plant = ct.nlsys(
        lambda t, x, u, p: [-x[0] - 0.1 * np.sin(x[0]) + u[0]], inputs="u", outputs="y", states=1, name="plant"
    )
    if kind == "hold":
        held = cp.sample_hold(ct.nlsys(None, lambda t, x, u, p: [law(u[0] - u[1])], dt=PERIOD, **signals), PERIOD)
    elif kind == "declare":
        own = ct.nlsys(lambda t, x, u, p: [0.0], lambda t, x, u, p: [x[0]], states=1, **signals)
        held = cp.declare(own, period=PERIOD, sample=lambda t, x, u, p: [law(u[0] - u[1])], feedthrough=False)
    else:
        held = ct.nlsys(None, lambda t, x, u, p: [law(u[0] - u[1])], dt=PERIOD, **signals)
        plant = ct.nlsys(
            lambda t, x, u, p: [x[0] + PERIOD * (u[0] - x[0] - 0.1 * np.sin(x[0]))],
            lambda t, x, u, p: [x[0]],
            inputs="u",
            outputs="y",
            states=1,
            dt=PERIOD,
            name="plant",
        )
    return ct.interconnect([held, plant], inputs="r", outputs=["y", "u"])


KINDS = ["hold", "declare", "discrete"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", LAWS)
def test_each_evaluation_of_limits_begins_with_the_first_memory(name, kind):
    given = loop(LAWS[name](), kind)
    found = [cp.margins(PLAN, {"u": 50.0}, given, tail=1.0).rows[0].value for _ in range(2)]
    times = PERIOD * np.arange(101)
    peak = np.abs(cp.simulate(loop(LAWS[name](), kind), times, PLAN).outputs[1]).max()
    # The limits see all values that the law holds.
    np.testing.assert_allclose(found, peak, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hold", "discrete"])
def test_the_fastest_plan_holds_its_limit_with_a_new_law(kind):
    law = Attribute()
    plan = cp.fastest(PLAN, {"u": 1.5}, loop(law, kind)).plan
    assert law.total == 0.0
    assert cp.margins(plan, {"u": 1.5}, loop(Attribute(), kind)).rows[0].value == pytest.approx(1.5, rel=1e-4)


def test_a_simulation_goes_on_from_what_the_law_remembers():
    law, times = Attribute(), np.linspace(0.0, 1.0, 51)
    given = loop(law)
    first = cp.simulate(given, times, PLAN).outputs
    assert law.total > 0.0
    second = cp.simulate(given, times, PLAN).outputs
    assert np.abs(second - first).max() > 0.05
    law.total = 0.0
    np.testing.assert_array_equal(cp.simulate(given, times, PLAN).outputs, first)


def test_a_memory_that_was_not_zero_before():
    law, new = Attribute(), Attribute()
    law.total = new.total = 0.3
    given, times = loop(law), np.linspace(0.0, 1.0, 51)
    found = cp.compare(given, {"a": PLAN, "b": PLAN}, times, initial_state=0.0)
    assert law.total == 0.3
    expected = cp.simulate(loop(new), times, PLAN).outputs
    for response in found.responses.values():
        np.testing.assert_array_equal(response.outputs, expected)


def test_a_run_that_fails_leaves_the_memory():
    law = Attribute()

    def broken(error):
        value = law(error)
        if law.total > 0.05:
            raise RuntimeError("the valve is stuck")
        return value

    with pytest.raises(RuntimeError, match="stuck"):
        cp.compare(loop(broken), {"a": PLAN}, np.linspace(0.0, 1.0, 51))
    assert law.total == 0.0


def test_threads_with_one_law():
    given, times = loop(Attribute()), np.linspace(0.0, 1.0, 51)
    alone = cp.compare(loop(Attribute()), {"a": PLAN}, times).metrics["a"]["iae"]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        runs = [pool.submit(cp.compare, given, {"a": PLAN}, times) for _ in range(8)]
        assert [run.result().metrics["a"]["iae"] for run in runs] == [alone] * 8


@pytest.mark.parametrize("make", [lambda: itertools.count(), lambda: (k for k in range(10**6))])
def test_a_memory_that_cannot_be_restored_is_told_once(make):
    counted = make()

    def given():
        return loop(lambda error: 2.0 * error + 1e-3 * next(counted))

    times = np.linspace(0.0, 1.0, 51)
    once = given()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cp.compare(once, {"a": PLAN}, times)
    with pytest.warns(UserWarning, match="block law .* cannot be restored") as told:
        cp.compare(once, {"a": PLAN, "b": PLAN, "c": PLAN}, times)
    assert len([w for w in told if "restored" in str(w.message)]) == 1


def test_a_function_that_builds_the_loop_is_not_told():
    def build(name, plan):
        counted = itertools.count()
        return loop(lambda error: 2.0 * error + 1e-3 * next(counted))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = cp.compare(build, {"a": PLAN, "b": PLAN}, np.linspace(0.0, 1.0, 51))
    assert found.metrics["a"]["iae"] == found.metrics["b"]["iae"]
    gc.collect()


def test_a_stepper_inside_of_a_law_begins_again():
    observer = cp.prepare(ct.ss(-1.0, 1.0, 1.0, 0.0)).start(PERIOD)
    once = loop(lambda error: 2.0 * error + observer.step([error])[0])
    found = cp.compare(once, {"a": PLAN, "b": PLAN}, np.linspace(0.0, 1.0, 51))
    assert found.metrics["a"]["iae"] == found.metrics["b"]["iae"]
    assert observer.time == 0.0


def test_a_stepper_goes_on_with_the_memory():
    law, new = Attribute(), Attribute()
    stepper = cp.prepare(loop(law)).start(PERIOD)
    given = [stepper.step([1.0])[0] for _ in range(50)]
    times = PERIOD * np.arange(51)
    np.testing.assert_allclose(given, cp.simulate(loop(new), times, 1.0).outputs[0, 1:], rtol=1e-6)
    assert law.total > 0.0


GENERATORS = {
    "Generator": (np.random.default_rng, lambda rng: rng.normal()),
    "RandomState": (np.random.RandomState, lambda rng: rng.normal()),
    "Random": (random.Random, lambda rng: rng.gauss(0.0, 1.0)),
    "bits": (np.random.PCG64, lambda bits: bits.random_raw() / 2.0**64),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", GENERATORS)
def test_each_plan_of_a_comparison_meets_the_same_random_numbers(name, kind):
    """The measurement noise of the law is the same for all plans, from the present state of its generator."""
    made, draw = GENERATORS[name]
    rng, apart = made(5), made(5)
    before = [draw(rng), draw(apart)]
    assert before[0] == before[1]
    given = loop(lambda error: 2.0 * (error + 0.01 * draw(rng)), kind)
    t = PERIOD * np.arange(51)
    compared = cp.compare(given, {"a": PLAN, "b": PLAN, "late": PLAN.shift(0.1)}, t)
    assert np.array_equal(compared.responses["a"].outputs, compared.responses["b"].outputs)
    noise = np.array([draw(apart) for _ in t])
    for key, plan in (("a", PLAN), ("late", PLAN.shift(0.1))):
        y, u = compared.responses[key].outputs
        assert np.abs(u - 2.0 * (plan(t) - y + 0.01 * noise)).max() <= 1e-12
    assert draw(rng) == draw(made_at(made, draw, 1)), "the generator is left as it was"


def made_at(made, draw, count):
    """A generator of the same seed after some numbers."""
    rng = made(5)
    for _ in range(count):
        draw(rng)
    return rng
