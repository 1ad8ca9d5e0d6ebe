"""Methods as objects: a new one is a class and a line; "auto" is the first that applies."""

import copy
import inspect
import itertools
import pickle
import threading
import typing
from concurrent.futures import ThreadPoolExecutor

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import methods
from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.interpreted import InterpretedSolver, SolverError
from ctrlplan.simulation.numerical import numerical
from ctrlplan.simulation.simulate import MethodName

T = np.linspace(0.0, 2.0, 21)


class RK4Solver(InterpretedSolver):
    """Classical Runge-Kutta steps of at most 1/64 s."""

    def advance(self, series, left, grid, state):
        found, t, x = [], left, state
        for end in grid.tolist():
            steps = max(1, int(np.ceil((end - t) * 64.0)))
            h = (end - t) / steps
            for k in range(steps):
                x = self.step(series, t + k * h, h, x)
            t = end
            found.append(x)
        return np.array(found).T.reshape(state.size, grid.size)

    def step(self, series, t, h, x):
        def rate(at, state):
            return self.rates(np.array([at]), state[:, None], series(at)[:, None])[:, 0]

        k1 = rate(t, x)
        k2 = rate(t + h / 2, x + h / 2 * k1)
        k3 = rate(t + h / 2, x + h / 2 * k2)
        k4 = rate(t + h, x + h * k3)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


class RK4:
    """A method of another package: three members."""

    name = "rk4"

    def why_not(self, prepared):
        return "" if prepared.has_blocks and not prepared.is_discrete else f"{prepared.name} is not continuous"

    def run(self, job):
        return numerical(job, self)

    def solver(self, attempt):
        return RK4Solver(attempt.equations, attempt.tolerances, attempt.scales)

    def check(self, attempt):
        pass


class Never:
    """A method that never applies, or turns out not to apply during the run."""

    name = "never"

    def __init__(self, reason="", error=None):
        self.reason, self.error, self.runs = reason, error, 0

    def why_not(self, prepared):
        return self.reason

    def run(self, job):
        self.runs += 1
        raise self.error


def cubic():
    """x' = -x**3 from 1: x = (1 + 2 t)**-0.5."""
    return ct.nlsys(lambda t, x, u, p: -(x**3), None, inputs=0, outputs="x", states="x", name="cubic")


def naive_rk4(rate, x, times, h=1.0 / 64.0):
    found = [x]
    for left, right in itertools.pairwise(times):
        steps = max(1, int(np.ceil((right - left) / h)))
        d = (right - left) / steps
        for _ in range(steps):
            k1 = rate(x)
            k2 = rate(x + d / 2 * k1)
            k3 = rate(x + d / 2 * k2)
            k4 = rate(x + d * k3)
            x = x + d / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        found.append(x)
    return np.array(found)


@pytest.fixture
def with_rk4(monkeypatch):
    monkeypatch.setattr(methods, "METHODS", (*methods.METHODS, RK4()))


def test_a_new_method_is_a_class_and_a_line(with_rk4):
    found = cp.simulate(cubic(), T, initial_state=1.0, method="rk4")
    assert (found.method, found.reason) == ("rk4", 'method "rk4" was requested')
    assert np.abs(found.outputs - naive_rk4(lambda x: -(x**3), 1.0, T)).max() <= 1e-13
    assert np.abs(found.outputs - (1.0 + 2.0 * T) ** -0.5).max() <= 1e-7


def test_a_new_method_has_plans_samples_and_events(with_rk4):
    loop = ct.interconnect(
        [
            ct.nlsys(lambda t, x, u, p: u - x, None, inputs="e", outputs="y", states="y", name="lag"),
            cp.create_pid_iosystem(2.0, 1.0, 0.0, 0.1, inputs=["r", "y"], outputs="e", name="pid"),
        ],
        inputs="r",
        outputs="y",
        name="loop",
    )
    plan = cp.PolySpline([cp.Waypoint(0.3, 0.0, 0.0, 0.0), cp.Waypoint(1.7, 1.0, 0.0, 0.0)])
    event = cp.Event("y", high=0.5)
    one = cp.simulate(loop, T, plan, method="rk4", events=[event])
    other = cp.simulate(loop, T, plan, method="python", events=[event], rtol=1e-10)
    assert np.abs(one.outputs - other.outputs).max() <= 1e-6
    assert [(e.name, e.kind) for e in one.events] == [(e.name, e.kind) for e in other.events]
    assert [e.time for e in one.events] == pytest.approx([e.time for e in other.events], abs=1e-6)


def test_auto_is_the_first_without_a_reason(monkeypatch):
    never = Never("loop is not to its taste")
    monkeypatch.setattr(methods, "METHODS", (never, RK4()))
    found = cp.simulate(cubic(), T, initial_state=1.0)
    assert (found.method, found.reason, never.runs) == ("rk4", "loop is not to its taste", 0)
    monkeypatch.setattr(methods, "METHODS", (RK4(), never))
    assert cp.simulate(cubic(), T, initial_state=1.0).method == "rk4"


@pytest.mark.parametrize("error", [NotApplicableError("too stiff"), SolverError("too stiff")])
def test_what_turns_out_while_it_runs_is_followed_by_the_next(monkeypatch, error):
    never = Never(error=error)
    monkeypatch.setattr(methods, "METHODS", (never, RK4()))
    found = cp.simulate(cubic(), T, initial_state=1.0)
    assert found.method == "rk4"
    assert "too stiff" in found.reason
    assert never.runs == 1
    with pytest.raises(type(error), match="too stiff"):
        cp.simulate(cubic(), T, initial_state=1.0, method="never")


def test_without_a_method_every_reason_is_given(monkeypatch):
    monkeypatch.setattr(methods, "METHODS", (Never("A is missing"), RK4()))
    discrete = ct.nlsys(lambda t, x, u, p: x, None, inputs=0, outputs="x", states="x", dt=0.1, name="counter")
    with pytest.raises(ValueError, match=r'method "never" .*A is missing; method "rk4" .*counter is not continuous'):
        cp.simulate(discrete, [0.0, 0.1])


@pytest.mark.slow
def test_the_predictor_takes_the_same_methods(monkeypatch):
    loop = ct.nlsys(
        lambda t, x, u, params: np.array([x[1], 4 * (u[0] - x[0]) - 3 * x[1]]),
        lambda t, x, u, params: np.array([x[0], 4 * (u[0] - x[0]) - 3 * x[1] + np.sin(x[0])]),
        inputs="r",
        outputs=["angle", "torque"],
        states=["angle", "speed"],
        name="loop",
    )
    runs = []

    class Seen(RK4):
        def run(self, job):
            runs.append(job)
            return super().run(job)

    plain = cp.Predictor(loop, {"torque": (-1.0, 1.0)}, 10.0).fraction([0.0, 0.0], [0.0], [1.0])
    monkeypatch.setattr(methods, "METHODS", (Never("not this one"), Seen()))
    assert cp.Predictor(loop, {"torque": (-1.0, 1.0)}, 10.0).fraction([0.0, 0.0], [0.0], [1.0]) == plain
    assert len(runs) > 2


def test_every_method_of_the_package_has_the_three_members():
    names = typing.get_args(MethodName)
    assert names[0] == "auto"
    assert tuple(dict.fromkeys(method.name for method in methods.METHODS)) == names[1:]
    for method in methods.METHODS:
        assert list(inspect.signature(method.why_not).parameters) == ["prepared"]
        assert list(inspect.signature(method.run).parameters) == ["job"]


@pytest.mark.parametrize(
    ("system", "applies"),
    [
        (cp.plants.integrator_lag_loop(5.0), ["exact", "compiled", "python"]),
        (cubic(), ["compiled", "python"]),
        (ct.ss(0.5, 1.0, 1.0, 0.0, 0.1), ["python"]),
    ],
)
def test_which_methods_apply(system, applies):
    found = list(methods.applicable(methods.METHODS, cp.prepare(system)))
    assert [method.name for method in found] == applies


def test_arguments_after_the_initial_state_have_names():
    with pytest.raises(TypeError, match="positional"):
        cp.simulate(cubic(), T, None, 1.0, {"k": 2.0})
    kinds = [(p.name, p.kind) for p in inspect.signature(cp.simulate).parameters.values()]
    assert [name for name, kind in kinds if kind is inspect.Parameter.POSITIONAL_OR_KEYWORD] == [
        "system",
        "timepts",
        "inputs",
        "initial_state",
    ]


# The response


@pytest.fixture
def response():
    return cp.simulate(cubic(), T, initial_state=1.0, events=[cp.Event("x", low=0.6)])


def test_a_response_has_typed_fields(response):
    assert isinstance(response, cp.SimulationResponse)
    assert isinstance(response, ct.TimeResponseData)
    hints = typing.get_type_hints(cp.SimulationResponse)
    assert hints["method"] is str
    assert typing.get_type_hints(cp.SimulationResponse.reason.fget)["return"] is str
    assert typing.get_type_hints(cp.SimulationResponse.events.fget)["return"] == list[cp.Occurrence]
    assert response.method == "compiled"
    # (1 + 2 t)**-0.5 = 0.6
    assert [e.time for e in response.events] == pytest.approx([(1 / 0.36 - 1) / 2], abs=1e-6)


@pytest.mark.parametrize(
    "copied",
    [copy.copy, copy.deepcopy, lambda r: pickle.loads(pickle.dumps(r)), lambda r: r(squeeze=False)],
    ids=["copy", "deepcopy", "pickle", "call"],
)
def test_a_copy_is_the_same_response(response, copied):
    other = copied(response)
    assert type(other) is cp.SimulationResponse
    assert (other.method, other.reason, other.events) == (response.method, response.reason, response.events)
    for name in ("t", "y", "x", "u"):
        assert np.array_equal(getattr(other, name), getattr(response, name))
    assert other.output_labels == response.output_labels


def test_python_controls_own_use_of_a_response(response):
    t, y = response
    assert np.array_equal(t, response.time)
    assert np.array_equal(y, response.outputs)
    assert np.array_equal(response[0], T)
    assert np.array_equal(response.states["x"], response.outputs["x"])
    assert list(response.to_pandas()["x"]) == response.outputs["x"].tolist()
    lines = response.plot().lines
    assert np.array_equal(lines[0, 0][0].get_ydata(), response.outputs["x"])


def test_a_response_is_made_as_python_controls():
    made = cp.SimulationResponse(T, np.sin(T), output_labels=["y"], issiso=False)
    assert (made.method, made.reason, made.events) == ("", "", [])
    assert np.array_equal(made.outputs["y"], np.sin(T))


def test_a_delegated_run_is_a_response_too():
    class Own(ct.NonlinearIOSystem):
        def _rhs(self, t, x, u):
            return -2.0 * x

    with pytest.warns(UserWarning, match="own .*control.input_output_response") as caught:
        found = cp.simulate(Own(lambda t, x, u, p: x, None, inputs=0, outputs=1, states=1, name="own"), T, None, 1.0)
    assert caught[0].filename == __file__
    assert isinstance(found, cp.SimulationResponse)
    assert np.abs(found.y[0] - np.exp(-2.0 * T)).max() <= 1e-6


def test_a_warning_of_an_exact_run_is_at_the_callers_line():
    hiding = ct.ss([[1.7, 3.9], [1.0, 0.0]], [[1.0], [0.0]], [[1.0, -3.0]], 0.0, name="hiding")
    with pytest.warns(UserWarning, match="uncertain by") as caught:
        cp.simulate(hiding, 20.0 * T, 1.0)
    assert caught[0].filename == __file__


# Equal calls use equal methods


def switching():
    """Two blocks without a loop at u = 0, and with one from t = 1 on."""
    one = ct.nlsys(None, lambda t, x, u, p: [0.5 * u[0] + 1.0 if t > 1.0 else 1.0], inputs="b", outputs="a", name="one")
    two = ct.nlsys(None, lambda t, x, u, p: [0.5 * u[0]], inputs="a", outputs="b", name="two")
    lag = ct.nlsys(lambda t, x, u, p: u - x, None, inputs="a", outputs="y", states="y", name="lag")
    return ct.interconnect([one, two, lag], inputs=0, outputs=["a", "y"], name="switching")


@pytest.mark.slow
def test_a_loop_that_appears_later_leaves_nothing_behind():
    ready = cp.prepare(switching())
    calm = np.linspace(0.0, 0.9, 10)
    before = cp.simulate(ready, calm, method="python")
    first = cp.simulate(ready, T, method="python")
    # From t = 1 on a = 0.25 a + 1.
    assert first.outputs["a"][T > 1.0] == pytest.approx(1.0 / 0.75, abs=1e-9)
    again = cp.simulate(ready, T, method="python")
    after = cp.simulate(ready, calm, method="python")
    for one, other in ((first, again), (before, after)):
        assert (one.method, one.reason) == (other.method, other.reason)
        assert np.array_equal(one.y, other.y)
        assert np.array_equal(one.x, other.x)


@pytest.mark.slow
def test_threads_run_one_system_as_one_thread_does():
    def planned_loop(k):
        return ct.nlsys(
            lambda t, x, u, p: np.array([x[1], -p["k"] * np.sin(x[0]) - 0.1 * x[1] + u[0]]),
            None,
            inputs="u",
            outputs=2,
            states=2,
            params={"k": k},
            name="pendulum",
        )

    values = np.linspace(1.0, 3.0, 12).tolist()
    times = np.linspace(0.0, 3.0, 31)
    shared = planned_loop(1.0)

    def run(k, system):
        return cp.simulate(system, times, 0.3, [0.5, 0.0], params={"k": k})

    expected = [run(k, planned_loop(1.0)) for k in values]
    barrier = threading.Barrier(4)

    def started(k):
        if k in values[:4]:  # the first four build the forms at the same time
            barrier.wait()
        return run(k, shared)

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(started, values))
    for one, other in zip(expected, found, strict=True):
        assert (one.method, one.reason) == (other.method, other.reason)
        assert np.array_equal(one.y, other.y)


@pytest.mark.parametrize("prepared", [False, True])
def test_threads_trace_a_block_with_a_log_once(monkeypatch, prepared):
    """A block that writes a log: while one thread traces it, the log is not a change for another thread."""
    from ctrlplan.symbolic import tracing

    traces, plain = [], tracing.traced
    monkeypatch.setattr(tracing, "traced", lambda *given: traces.append(given) or plain(*given))
    log = []

    def update(t, x, u, params):
        log.append(x[0])
        return -(x**3)

    system = ct.nlsys(update, None, inputs=0, outputs="x", states="x", name="logging")
    ready = cp.prepare(system) if prepared else system
    barrier = threading.Barrier(4)

    def run(start):
        barrier.wait()
        return cp.simulate(ready, T, None, start)

    starts = [0.5, 1.0, 1.5, 2.0]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(run, starts))
    assert len(traces) == 1
    assert all(isinstance(entry, float) for entry in log)
    for start, response in zip(starts, found, strict=True):
        assert response.method == "compiled"
        assert np.abs(response.outputs - start / np.sqrt(1.0 + 2.0 * start**2 * T)).max() <= 1e-6
