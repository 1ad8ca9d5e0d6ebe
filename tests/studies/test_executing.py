"""Sweeps on executors: taken as they complete, kept when interrupted or bereft of a worker, never run twice."""

import contextlib
import pickle
import sys
import threading
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from multiprocessing.pool import ThreadPool
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import budget
from ctrlplan.studies.outcomes import Failed

TIMES = np.linspace(0.0, 10.0, 201)
PLANS = {"step": cp.Step(1.0)}
RATES = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]


def lag(rate):
    return ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs="r", outputs="y")


def bent(rate):
    """The same lag, which only Python runs."""
    return ct.nlsys(
        lambda t, x, u, p: rate * (float(u[0]) - float(x[0])), None, states=1, inputs="r", outputs="y", name="bent"
    )


def drawn(tau=1.0, **names):
    """Lag with a parameter."""
    return ct.nlsys(
        lambda t, x, u, p: (u - x) / p["tau"], None, states=1, inputs="r", outputs="y", params={"tau": tau}, **names
    )


def swept(build, values=RATES, executor=None, progress=False, **options):
    return cp.sweep(
        build, values, PLANS, TIMES, executor=executor, progress=progress, measures=["settling_time"], **options
    )


def check(found, values):
    """A lag settles when exp(-rate t) is a fiftieth."""
    assert found.values.tolist() == list(values)
    np.testing.assert_allclose(found.metrics["step"]["settling_time"], np.log(50.0) / found.values, rtol=1e-5)


# Executors of every kind


class InTurn:
    """Nothing but submit and result."""

    def __init__(self):
        self.tasks = []

    def submit(self, function, /, *arguments):
        future = Future()
        self.tasks.append((future, function, arguments))
        return self.answer(future, len(self.tasks) - 1)

    def answer(self, future, k):
        return SimpleNamespace(result=lambda: self.run(k))

    def run(self, k):
        future, function, arguments = self.tasks[k]
        if not future.done():
            future.set_result(function(*arguments))
        return future.result()


class LastFirst(InTurn):
    """Each task is done only once all that were submitted after it have been taken; it can be asked."""

    def answer(self, future, k):
        return SimpleNamespace(done=lambda: self.later_ones_taken(k), result=lambda: self.taken(k))

    def later_ones_taken(self, k):
        return all(future.done() for future, *_ in self.tasks[k + 1 :])

    def taken(self, k):
        assert self.later_ones_taken(k)
        return self.run(k)


class LastFirstByCallback(LastFirst):
    """The same, and says so by itself."""

    def __init__(self):
        super().__init__()
        self.callbacks = {}

    def answer(self, future, k):
        return SimpleNamespace(
            add_done_callback=lambda call: self.tell(k, call), done=lambda: False, result=lambda: self.taken(k)
        )

    def tell(self, k, call):
        self.callbacks[k] = call
        if k == len(self.tasks) - 1:
            call(None)

    def taken(self, k):
        found = super().taken(k)
        if k:
            self.callbacks[k - 1](None)
        return found


@pytest.mark.parametrize("executor", [InTurn, LastFirst, LastFirstByCallback])
@pytest.mark.parametrize("build", [lag, bent])
def test_results_are_taken_as_they_complete_from_whatever_has_submit_and_result(executor, build):
    check(swept(build, executor=executor()), RATES)


@pytest.mark.parametrize("executor", [InTurn, LastFirst, LastFirstByCallback])
def test_draws_are_taken_as_they_complete_too(executor):
    tau = np.array([0.5, 1.0, 2.0])
    found = cp.monte_carlo(drawn(), {"tau": tau}, PLANS, TIMES, executor=executor(), progress=False)
    np.testing.assert_allclose(found.metrics["step"]["settling_time"], np.log(50.0) * tau, rtol=1e-5)
    assert (found.finished, found.failures, found.interrupted) == (3, (), False)


def not_to_be_built(*arguments):
    raise AssertionError("built")


@pytest.mark.parametrize(
    ("run", "given"), [(cp.sweep, [1.0]), (cp.monte_carlo, {"tau": [1.0]})], ids=["values", "draws"]
)
@pytest.mark.parametrize(
    ("executor", "said"),
    [
        (3, "executor must be an object with submit, as those of concurrent.futures, got 3"),
        ("threads", "executor must be an object with submit, .* got 'threads'"),
        (ThreadPoolExecutor, "executor must be an object with submit, .* got the class ThreadPoolExecutor itself"),
        (SimpleNamespace(submit=None), "executor must be an object with submit"),
    ],
)
def test_what_is_no_executor_is_rejected_before_a_loop_is_built(executor, said, run, given):
    with pytest.raises(TypeError, match=said):
        run(not_to_be_built, given, PLANS, TIMES, executor=executor, progress=False)


def test_a_multiprocessing_pool_is_rejected_before_a_loop_is_built():
    said = "got multiprocessing.pool.ThreadPool, which does not report a worker that dies; use concurrent.futures"
    with ThreadPool(1) as pool, pytest.raises(TypeError, match=said):
        swept(not_to_be_built, executor=pool)


class Pickling(InTurn):
    """What goes in is pickled; what cannot be is said in the result, as by a process pool."""

    def submit(self, function, /, *arguments):
        def run():
            pickled = pickle.dumps((function, arguments))
            return pickle.loads(pickle.dumps(pickle.loads(pickled)[0](*arguments)))

        return super().submit(run)


@pytest.mark.slow
def test_functions_that_only_pickle_rejects_run_where_nothing_is_pickled():
    with ThreadPoolExecutor(2) as pool:
        check(swept(lambda rate: bent(rate), executor=pool), RATES)
        found = cp.monte_carlo(
            lambda name, plan: drawn(), {"tau": [0.5, 2.0]}, PLANS, TIMES, executor=pool, progress=False
        )
        float_only = drawn_by_python()
        alone = cp.monte_carlo(float_only, {"tau": [0.5, 2.0]}, PLANS, TIMES, executor=pool, progress=False)
    for one in (found, alone):
        np.testing.assert_allclose(one.metrics["step"]["settling_time"], np.log(50.0) * np.array([0.5, 2]), rtol=1e-5)


def drawn_by_python():
    def update(t, x, u, p):
        return (float(u[0]) - float(x[0])) / p["tau"]

    return ct.nlsys(update, None, states=1, inputs="r", outputs="y", params={"tau": 1.0}, name="lag")


def test_what_cannot_be_sent_is_said_in_the_executors_words():
    with pytest.raises(
        ValueError, match=r"build must be picklable for other processes, got .*lambda.*; move the builder into a"
    ):
        swept(lambda rate: lag(rate), executor=Pickling())
    with pytest.raises(
        ValueError, match=r"the loop must be picklable for other processes, got lag must be linear or compiled"
    ):
        cp.monte_carlo(drawn_by_python(), {"tau": [0.5]}, PLANS, TIMES, executor=Pickling(), progress=False)


def broken(*_args):
    raise TypeError("cannot be made again")


class OddError(Exception):
    """Pickles, but cannot be made of what pickle keeps of it, whatever reducers another package has registered."""

    def __reduce__(self):
        return broken, self.args


def test_an_error_that_cannot_be_pickled_is_still_told_of():
    failed = pickle.loads(pickle.dumps(Failed.of(OddError("1 and 2"))))
    assert failed.message == "OddError: 1 and 2"
    assert type(failed.error) is RuntimeError
    same = pickle.loads(pickle.dumps(Failed.of(ZeroDivisionError("by 0"), by_executor=True)))
    assert (same.message, type(same.error), same.by_executor) == ("ZeroDivisionError: by 0", ZeroDivisionError, True)


# What an executor loses


class Losing(InTurn):
    """Some tasks are lost with an error of the executor, before they run."""

    def __init__(self, lost, error):
        super().__init__()
        self.lost, self.error = lost, error

    def run(self, k):
        if k in self.lost:
            raise self.error
        return super().run(k)


ERRORS = [RuntimeError("worker died"), CancelledError(), SystemExit(3)]


def stated(error):
    return f"{type(error).__name__}: {error}".removesuffix(": ")


@pytest.mark.parametrize("error", ERRORS)
def test_a_lost_task_is_sent_again_and_the_result_lists_it(error):
    built = []
    found = swept(lambda rate: built.append(rate) or lag(rate), executor=Losing({1, 4}, error))
    assert built == [0.5, 1.5, 2.0, 3.0, 1.0, 2.5]
    check(found, RATES)
    assert (found.failures, found.sent_again, found.missing) == ((), (1.0, 2.5), ())
    assert "sent again" in str(found)


class Killing(InTurn):
    """A task that contains one of some values ends its worker, and then runs no value."""

    def __init__(self, killers, error, workers=None):
        super().__init__()
        self.killers, self.error, self.sizes, self.flight = set(killers), error, [], []
        if workers:
            self.num_workers = workers

    def submit(self, function, task):
        self.sizes.append(task._values)
        return super().submit(function, task)

    def run(self, k):
        self.flight.append(len(self.tasks) - k)
        if self.killers & {getattr(value, "get", lambda _, v=value: v)("tau") for value in self.sizes[k]}:
            raise self.error
        return super().run(k)


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("workers", [None, 2])
def test_only_the_value_that_ends_its_worker_is_missing(error, workers):
    values = np.linspace(0.5, 3.0, 23).tolist()
    built, executor = [], Killing({values[4], values[17]}, error, workers)
    found = swept(lambda rate: built.append(rate) or lag(rate), values, executor, chunk=5)
    missing = [values[4], values[17]]
    assert [(f.draw, f.params, f.message) for f in found.failures] == [
        (k, {"value": values[k]}, stated(error)) for k in (4, 17)
    ]
    assert np.flatnonzero(np.isnan(found.metrics["step"]["settling_time"])).tolist() == [4, 17]
    assert found.sent_again == tuple(values[:5] + values[15:20])
    assert found.missing == tuple(missing)
    assert sorted(built) == [value for value in values if value not in missing]  # each once, and nothing in its place
    lost = [sent for sent in executor.sizes if set(missing) & set(sent)]
    assert [len(sent) for sent in lost] == [5, 5, 1, 1, 1, 1]  # sent again twice, one value at a time
    if workers:
        assert max(executor.flight) <= 2 * workers
    assert executor.flight[-2:] == [1, 1]  # the last time with nothing else in flight
    both = found.merged(swept(lag, missing))
    assert (both.sent_again, both.missing) == (found.sent_again, found.missing)


def test_draws_of_a_lost_worker_are_sent_again_and_run_nowhere_else():
    tau = np.linspace(0.5, 2.0, 12)
    run = []
    loop = drawn()

    def measure(one):
        run.append(float(one.response.outputs[1]))
        return {}

    lost = Killing({tau[11]}, RuntimeError("gone"))
    measures = {"counted": cp.Measure("Counted", of="run", function=measure)}
    found = cp.monte_carlo(loop, {"tau": tau}, PLANS, TIMES, executor=lost, progress=False, measures=measures, chunk=3)
    assert len(run) == 3 + 11  # the nominal loop, two draws that are compared with Python, and all but the lost one
    assert [(f.draw, f.params, f.message) for f in found.failures] == [(11, {"tau": tau[11]}, "RuntimeError: gone")]
    assert np.flatnonzero(np.isnan(found.metrics["step"]["settling_time"])).tolist() == [11]
    assert (found.sent_again, found.missing, found.finished) == ((9, 10, 11), (11,), 12)
    assert "Draws sent again because their worker ended: 9, 10, 11." in found.notes()


def test_an_executor_that_finishes_nothing_raises_its_error():
    lost = Losing(range(10_000), RuntimeError("all gone"))
    with pytest.raises(RuntimeError, match="all gone"):
        swept(lag, np.linspace(0.5, 3.0, 400), executor=lost)
    assert len(lost.tasks) < 4000
    with pytest.raises(RuntimeError, match="all gone"):
        cp.monte_carlo(drawn(), {"tau": [0.5, 1.0]}, PLANS, TIMES, executor=lost, progress=False)


def test_an_executor_that_takes_no_more_keeps_what_it_has():
    class Breaks(InTurn):
        def submit(self, function, /, *arguments):
            if len(self.tasks) == 4:
                raise RuntimeError("broken")
            return super().submit(function, *arguments)

    found = swept(lag, executor=Breaks())
    assert [(f.draw, f.message) for f in found.failures] == [(4, "RuntimeError: broken"), (5, "RuntimeError: broken")]
    assert np.isfinite(found.metrics["step"]["settling_time"][:4]).all()


class Empty(InTurn):
    """Futures of some tasks have a result that no worker returns, and the tasks do not run."""

    def __init__(self, empty, result):
        super().__init__()
        self.empty, self.result = empty, result

    def run(self, k):
        return self.result if k in self.empty else super().run(k)


@pytest.mark.parametrize("result", [None, {}, "done"])
def test_a_future_without_the_reply_of_a_worker_is_a_lost_task(result):
    found = swept(lag, executor=Empty({1, 4}, result))
    check(found, RATES)
    assert (found.failures, found.sent_again, found.missing) == ((), (1.0, 2.5), ())
    never = swept(lag, executor=Empty({1, 6, 7}, result))  # the second value each time
    assert [(f.draw, f.params) for f in never.failures] == [(1, {"value": 1.0})]
    said = "RuntimeError: the executor must return the result of the function submitted, got "
    assert never.failures[0].message == f"{said}{result!r}"
    assert (never.sent_again, never.missing) == ((1.0,), (1.0,))


class Unreachable(InTurn):
    """`submit` raises an OSError at some of its calls."""

    def __init__(self, calls):
        super().__init__()
        self.calls, self.count = calls, 0

    def submit(self, function, /, *arguments):
        self.count += 1
        if self.count in self.calls:
            raise ConnectionResetError("reset")
        return super().submit(function, *arguments)


@pytest.mark.parametrize("calls", [{1}, {3}, {2, 5}])
def test_a_connection_error_of_submit_is_retried_once(calls):
    found = swept(lag, executor=Unreachable(calls))
    check(found, RATES)
    assert (found.failures, found.missing) == ((), ())


def test_after_two_connection_errors_of_submit_the_rest_is_given_up():
    executor = Unreachable({5, 6})
    found = swept(lag, executor=executor)
    said = "ConnectionResetError: reset"
    assert [(f.draw, f.message) for f in found.failures] == [(4, said), (5, said)]
    assert executor.count == 6


# What a run or a builder does


@pytest.mark.parametrize("executor", [None, InTurn], ids=["here", "executor"])
@pytest.mark.parametrize("where", ["builder", "run"])
def test_system_exit_is_the_failure_of_its_value(executor, where):
    def build(rate):
        def update(t, x, u, p):
            if rate == 2.0 and t > 1.0:
                sys.exit(f"at {where}")
            return rate * (u - x)

        if where == "run":
            return ct.nlsys(update, None, states=1, inputs="r", outputs="y", name="lag")
        return sys.exit(f"at {where}") if rate == 2.0 else lag(rate)

    found = swept(build, executor=executor and executor())
    assert [(f.draw, f.message) for f in found.failures] == [(3, f"SystemExit: at {where}")]
    assert np.flatnonzero(np.isnan(found.metrics["step"]["settling_time"])).tolist() == [3]


def test_system_exit_at_every_value_does_not_end_the_caller():
    with pytest.raises(RuntimeError, match="SystemExit: 7"):
        swept(lambda rate: sys.exit(7))
    with pytest.raises(RuntimeError, match="SystemExit: 7"):
        cp.monte_carlo(lambda name, plan: sys.exit(7), {"tau": [1.0]}, PLANS, TIMES, progress=False)


@pytest.mark.parametrize("executor", [None, InTurn], ids=["here", "executor"])
def test_system_exit_is_the_failure_of_its_draw(executor):
    def update(t, x, u, p):
        if p["tau"] > 1.9:
            raise SystemExit
        return (float(u[0]) - x) / p["tau"]

    loop = ct.nlsys(update, None, states=1, inputs="r", outputs="y", params={"tau": 1.0}, name="lag")
    found = cp.monte_carlo(
        loop, {"tau": [2.0, 0.5, 1.0]}, PLANS, TIMES, executor=executor and executor(), progress=False
    )
    assert [(f.draw, f.message) for f in found.failures] == [(0, "SystemExit")]
    assert np.isfinite(found.metrics["step"]["settling_time"][1:]).all()


# The time limit, on a clock of which every look takes a second


@pytest.fixture
def clock(monkeypatch):
    """A clock that moves on by a second at each reading, in each thread by itself."""
    own = threading.local()

    def monotonic():
        own.seconds = getattr(own, "seconds", 0.0) + 1.0
        return own.seconds

    monkeypatch.setattr(budget, "time", SimpleNamespace(monotonic=monotonic))


def trembling(turn):
    """A lag with an oscillator beside it, which takes more evaluations the faster it turns."""

    def update(t, x, u, p):
        return np.array([float(u[0]) - x[0], x[2], -(p["turn"] ** 2) * x[1]])

    return ct.nlsys(
        update, lambda t, x, u, p: x[:1], states=3, inputs="r", outputs="y", params={"turn": turn}, name="trembling"
    )


@pytest.mark.parametrize("executor", [None, InTurn, lambda: ThreadPoolExecutor(2)], ids=["here", "executor", "threads"])
def test_a_run_that_takes_too_long_is_the_failure_of_its_value(executor, clock):
    pool = executor and executor()
    found = swept(trembling, [0.5, 1.0, 300.0], pool, timeout=4000.0, initial_state=[0.0, 1.0, 0.0])
    (failure,) = found.failures
    assert (failure.draw, failure.params) == (2, {"value": 300.0})
    assert failure.message.startswith("TimeLimitError: a run must end within timeout = 4000 s, got to t = ")
    np.testing.assert_allclose(found.metrics["step"]["settling_time"][:2], np.log(50.0), rtol=1e-5)


@pytest.mark.parametrize("executor", [None, InTurn], ids=["here", "executor"])
def test_a_run_that_takes_too_long_is_the_failure_of_its_draw(executor, clock):
    settings = {"initial_state": [0.0, 1.0, 0.0], "measures": ["settling_time"]}
    build = trembling_by_name
    options = {"executor": executor and executor(), "progress": False, "timeout": 4000.0}
    found = cp.monte_carlo(build, {"turn": [300.0, 0.5, 2.0]}, PLANS, TIMES, **settings, **options)
    assert [(f.draw, f.message[:14]) for f in found.failures] == [(0, "TimeLimitError")]
    np.testing.assert_allclose(found.metrics["step"]["settling_time"][1:], np.log(50.0), rtol=1e-5)


def trembling_by_name(name, plan):
    return trembling(1.0)


@pytest.mark.parametrize("timeout", [0, -1.0, np.nan, np.inf, True, "5", [1.0]])
@pytest.mark.parametrize(
    ("run", "given"), [(cp.sweep, [1.0]), (cp.monte_carlo, {"tau": [1.0]})], ids=["values", "draws"]
)
def test_a_time_limit_is_a_number_of_seconds_above_0(timeout, run, given):
    with pytest.raises(ValueError, match="timeout must be a finite number of seconds above 0, or None, got"):
        run(not_to_be_built, given, PLANS, TIMES, progress=False, timeout=timeout)


# Interruptions: KeyboardInterrupt where a run, a builder or a wait is


def interrupted_at(k, build):
    def builds(rate):
        if rate == RATES[k]:
            raise KeyboardInterrupt
        return build(rate)

    return builds


@pytest.mark.parametrize("build", [lag, bent])
@pytest.mark.parametrize("k", [0, 1, 3, 5])
def test_an_interruption_returns_every_value_that_was_finished(build, k):
    with pytest.warns(UserWarning, match=f"the sweep was interrupted: {k} of 6 values are returned"):
        found = swept(interrupted_at(k, build))
    assert found.interrupted
    assert found.values.tolist() == RATES[:k]
    if k:
        check(found, RATES[:k])
    assert found.results([]) == {"value": RATES[:k]} | {plan: {} for plan in found.metrics}
    assert list(found.metrics) == list(PLANS)
    assert all(row.size == k for plan in PLANS for row in found.metrics[plan].values())
    assert "settling_time" in found.metrics["step"]
    if not k:
        with pytest.raises(ValueError, match="got a sweep interrupted before any value"):
            found.report("page.html")


@pytest.mark.parametrize("build", [lag, bent])
@pytest.mark.parametrize("k", [1, 2, 5])
def test_an_interruption_between_two_results_loses_none(build, k, monkeypatch):
    """As in the progress bar: what is measured together with the last one is ready too."""
    from ctrlplan.studies import progress

    class Bar(contextlib.nullcontext):
        def __init__(self, **settings):
            super().__init__(self)
            self.done = 0

        def update(self):
            self.done += 1
            if self.done == k:
                raise KeyboardInterrupt

    monkeypatch.setattr(progress, "tqdm", Bar)
    with pytest.warns(UserWarning, match="interrupted"):
        found = swept(build, progress=True)
    assert found.interrupted
    check(found, RATES if build is lag else RATES[:k])  # linear loops are solved together


def test_a_sweep_that_is_not_interrupted_says_so():
    assert not swept(lag).interrupted
    assert not cp.monte_carlo(drawn(), {"tau": [1.0]}, PLANS, TIMES, progress=False).interrupted


class Cancelled(InTurn):
    """Some tasks are finished in no order; another is interrupted while it is waited for."""

    def __init__(self, finished):
        super().__init__()
        self.finished, self.cancelled = finished, []

    def answer(self, future, k):
        def result():
            if k in self.finished:
                return self.run(k)
            raise KeyboardInterrupt

        return SimpleNamespace(
            result=result,
            done=lambda: k in self.finished and len(self.tasks) == 6,
            exception=lambda: None,
            cancel=lambda: self.cancelled.append(k),
        )


def test_an_interrupted_wait_keeps_what_is_finished_behind_a_slow_task(monkeypatch):
    """The wait for task 0 is interrupted when 2, 3 and 5 are done, of which nobody was told yet."""
    from ctrlplan.studies import executors

    class Interrupts:
        def put(self, k):
            pass

        def get(self, timeout):
            raise KeyboardInterrupt

    monkeypatch.setattr(executors, "SimpleQueue", Interrupts)
    executor = Cancelled({2, 3, 5})
    with pytest.warns(UserWarning, match="interrupted: 3 of 6 values are returned"):
        found = swept(lag, executor=executor)
    assert found.interrupted
    check(found, [1.5, 2.0, 3.0])
    assert set(executor.cancelled) == {0, 1, 4}


def test_a_second_interruption_raises():
    class InterruptedAgain(Cancelled):
        def answer(self, future, k):
            answer = super().answer(future, k)
            answer.cancel = answer.done = answer.result  # which interrupt
            return answer

    with pytest.raises(KeyboardInterrupt):
        swept(lag, executor=InterruptedAgain(()))


def test_merged_sweeps_keep_failures_interruptions_and_metrics_of_one_alone():
    def build(rate):
        if rate in (1.0, 2.5):
            raise ValueError("none")
        return lag(rate)

    one = swept(build, [1.0, 2.0, 3.0])
    with pytest.warns(UserWarning, match="interrupted"):
        other = swept(interrupted_at(5, build), [0.5, 1.5, 2.5, 3.0])
    for both in (one.merged(other), other.merged(one)):
        assert both.interrupted
        assert both.values.tolist() == [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
        assert [(f.draw, f.params["value"]) for f in both.failures] == [(1, 1.0), (4, 2.5)]
        known = np.array([0, 2, 3, 5])
        row = both.metrics["step"]["settling_time"]
        np.testing.assert_allclose(row[known], np.log(50.0) / both.values[known], rtol=1e-5)
        assert np.isnan(row[[1, 4]]).all()
    with pytest.warns(UserWarning, match="interrupted"):
        nothing = swept(interrupted_at(0, lag))
    np.testing.assert_array_equal(
        nothing.merged(one).metrics["step"]["settling_time"], one.metrics["step"]["settling_time"]
    )
