"""Tasks of executors: their sizes, how many are in flight, what travels to a worker, versions of packages."""

import pickle
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from types import SimpleNamespace

import control as ct
import loky
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan._lru import Lru
from ctrlplan.studies import chunks, dispatch, executors

TIMES = np.linspace(0.0, 10.0, 101)
PLANS = {"step": cp.Step(1.0)}
RATES = np.linspace(0.5, 3.0, 40)


def lag(rate):
    return ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs="r", outputs="y")


class Heavy:
    """A builder with much data."""

    def __init__(self):
        self.data = bytes(100_000)

    def __call__(self, rate):
        return lag(rate)


class Workers:
    """Processes in this one: tasks are pickled, and each worker has a memory of its own."""

    def __init__(self, count, monkeypatch, known=True, take=None):
        self.memories, self.patch = [Lru(4) for _ in range(count)], monkeypatch
        if known:
            self.num_workers = count
        self.take = take or (lambda k: k % count)
        self.sent, self.in_flight, self.most = [], 0, 0

    def submit(self, function, task):
        self.sent.append(pickle.dumps((function, task)))
        k = len(self.sent) - 1
        self.in_flight += 1
        self.most = max(self.most, self.in_flight)
        return SimpleNamespace(result=lambda: self.run(k))

    def run(self, k):
        self.in_flight -= 1
        with self.patch.context() as patch:
            patch.setattr(chunks, "_RECEIVED", self.memories[self.take(k)])
            function, task = pickle.loads(self.sent[k])
            return pickle.loads(pickle.dumps(function(task)))


def swept(executor, values=RATES, build=lag, **options):
    options = {"measures": ["settling_time"], "progress": False} | options
    found = cp.sweep(build, values, PLANS, TIMES, executor=executor, **options)
    np.testing.assert_allclose(found.metrics["step"]["settling_time"], np.log(50.0) / found.values, rtol=1e-4)
    assert found.values.tolist() == list(values)
    assert found.failures == found.sent_again == found.missing == ()
    return found


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_the_runs_are_sent_to_each_worker_once_and_at_most_two_tasks_a_worker_are_in_flight(workers, monkeypatch):
    executor = Workers(workers, monkeypatch)
    swept(executor, build=Heavy())
    large = [k for k, sent in enumerate(executor.sent) if len(sent) > 100_000]
    assert large == list(range(workers))
    assert max(len(sent) for sent in executor.sent[workers:]) < 2000
    assert executor.most == 2 * workers
    assert len(executor.sent) == pytest.approx(4 * workers, abs=workers)


def test_a_worker_that_has_not_received_the_runs_is_sent_them(monkeypatch):
    """The first two tasks, which have the runs, are for the first worker; the second gets none of them."""
    executor = Workers(2, monkeypatch, take=lambda k: int(k >= 3))
    swept(executor, build=Heavy())
    large = [k for k, sent in enumerate(executor.sent) if len(sent) > 100_000]
    assert large[:2] == [0, 1]
    assert 3 <= len(large) <= 6  # the four in flight when the worker is found to have none


@pytest.mark.slow
def test_all_tasks_are_in_flight_where_the_number_of_workers_is_unknown(monkeypatch):
    executor = Workers(1, monkeypatch, known=False)
    swept(executor)
    assert executor.most == len(executor.sent) == 40
    limited = Workers(1, monkeypatch, known=False)
    swept(limited, workers=3)
    assert limited.most == 6


def test_a_scheduler_may_pickle_a_task_again(monkeypatch):
    class Scheduler(Workers):
        def submit(self, function, task):
            with self.patch.context() as patch:
                patch.setattr(chunks, "_RECEIVED", Lru(4))
                task = pickle.loads(pickle.dumps(task))
            return super().submit(function, task)

    swept(Scheduler(2, monkeypatch))


@pytest.mark.parametrize(
    ("count", "options", "size"),
    [(500, {}, 63), (5000, {}, 250), (8, {}, 1), (3, {}, 1), (500, {"chunk": 7}, 7), (500, {"workers": 10}, 13)],
)
def test_sizes_of_tasks(count, options, size):
    with ThreadPoolExecutor(2) as pool:
        assert dispatch.task_size(count, pool, options.get("workers"), options.get("chunk")) == size


@pytest.mark.parametrize(
    ("executor", "count"),
    [
        (SimpleNamespace(_max_workers=3), 3),
        (SimpleNamespace(num_workers=5), 5),
        (SimpleNamespace(nthreads=lambda: {"a": 2, "b": 2}), 4),
        (SimpleNamespace(_client=SimpleNamespace(nthreads=lambda: {"a": 1, "b": 1})), 2),
        (SimpleNamespace(), None),
        (SimpleNamespace(nthreads=lambda: 1 / 0), None),
        (SimpleNamespace(_max_workers=None), None),
    ],
)
def test_numbers_of_workers(executor, count):
    assert dispatch.worker_count(executor) == count


def test_a_long_task_returns_what_it_has_not_run(monkeypatch):
    """A clock on which each value takes a second."""
    seconds = iter(range(10_000))
    monkeypatch.setattr(chunks, "time", SimpleNamespace(perf_counter=lambda: float(next(seconds))))
    built = []
    executor = Workers(1, monkeypatch)
    values = np.linspace(0.5, 3.0, 9)

    def update(rate):
        built.append(rate)
        return ct.nlsys(lambda t, x, u, p: rate * (float(u[0]) - x), None, states=1, inputs="r", outputs="y")

    monkeypatch.setattr(Heavy, "__call__", lambda self, rate: update(rate))
    swept(executor, values, Heavy(), chunk=9)
    assert sorted(built) == values.tolist()  # each once
    assert len(executor.sent) > 3


@pytest.mark.parametrize("name", ["ctrlplan", "casadi"])
@pytest.mark.parametrize("run", ["sweep", "monte_carlo"])
def test_a_worker_with_other_versions_is_an_error_that_names_both(name, run, monkeypatch):
    own = chunks.installed_versions()

    class Other(Workers):
        def run(self, k):
            reply = super().run(k)
            object.__setattr__(reply, "versions", own | {name: "0.0.7"})
            return reply

    executor = Other(2, monkeypatch)
    said = f"workers must have the same version of {name} as this process, {own[name]}, got 0.0.7 in a worker"
    calls = {
        "sweep": lambda: swept(executor),
        "monte_carlo": lambda: cp.monte_carlo(lag, {"rate": RATES}, PLANS, TIMES, executor=executor, progress=False),
    }
    with pytest.raises(RuntimeError, match=said):
        calls[run]()


@pytest.mark.parametrize("name", ["workers", "chunk"])
@pytest.mark.parametrize("given", [0, -1, 1.5, True, "2", [1]])
def test_numbers_of_workers_and_values_are_integers_above_0(name, given):
    with pytest.raises(ValueError, match=f"{name} must be an integer of at least 1, or None, got"):
        cp.sweep(lag, [1.0], PLANS, TIMES, progress=False, executor=ThreadPoolExecutor(1), **{name: given})


def test_workers_belong_to_an_executor():
    with pytest.raises(ValueError, match="workers must be None without an executor, got 4; for several processes give"):
        cp.sweep(lag, [1.0], PLANS, TIMES, progress=False, workers=4)


def test_futures_are_dropped_once_they_are_read(monkeypatch):
    """No more results are referenced than tasks are in flight."""

    class Counting(Workers):
        alive, most_alive = 0, 0

        def submit(self, function, task):
            future = super().submit(function, task)
            owner = self

            class Held:
                def __init__(self):
                    owner.alive += 1
                    owner.most_alive = max(owner.most_alive, owner.alive)

                def __del__(self):
                    owner.alive -= 1

            future.held = Held()
            return future

    executor = Counting(2, monkeypatch)
    swept(executor, chunk=1)
    assert executor.most_alive <= 5
    assert executor.alive == 0


# Process pools that break


def test_a_new_pool_has_the_size_and_start_method_of_the_broken_one():
    context = get_context("spawn")
    with ProcessPoolExecutor(3, mp_context=context, initializer=print, initargs=(1,), max_tasks_per_child=7) as pool:
        new = executors.new_pool(pool)
        names = ("_max_workers", "_mp_context", "_initializer", "_initargs", "_max_tasks_per_child")
        assert [getattr(new, name) for name in names] == [3, context, print, (1,), 7]
        new.shutdown()
    assert executors.new_pool(ThreadPoolExecutor(1)) is None


def test_a_new_pool_is_of_the_library_of_the_broken_one():
    with loky.ProcessPoolExecutor(3, timeout=7.0, initializer=print, initargs=(1,), env={"A": "1"}) as pool:
        new = executors.new_pool(pool)
        names = ("_max_workers", "_timeout", "_initializer", "_initargs", "_env", "_context")
        assert [getattr(new, name) for name in names] == [getattr(pool, name) for name in names]
        assert type(new) is type(pool)
        new.shutdown()


def test_an_executor_whose_submit_returns_no_future():
    class Silent:
        _max_workers = 2

        def submit(self, function, task):
            return None

    with pytest.raises(RuntimeError, match="submit of the executor must return a future with result, got None"):
        cp.sweep(lag, RATES, PLANS, TIMES, executor=Silent(), progress=False)


class Breaking(Workers):
    """Pool whose worker ends at some values; it then takes no more tasks, and all that it has are lost."""

    _max_workers = 2

    def __init__(self, killers, monkeypatch):
        super().__init__(2, monkeypatch)
        self.killers, self.broken, self.ended = killers, False, 0

    def submit(self, function, task):
        if self.broken:
            raise BrokenProcessPool("takes no more")
        return super().submit(function, task)

    def run(self, k):
        _, task = pickle.loads(self.sent[k])
        self.broken |= bool(self.killers & set(task._values))
        if self.broken:
            raise BrokenProcessPool("ended")
        return super().run(k)

    def shutdown(self, **options):
        assert options == {"wait": False}  # what every process pool takes
        self.ended += 1


@pytest.mark.parametrize("killers", [set(), {RATES[7]}, {RATES[0], RATES[1], RATES[39]}])
def test_a_broken_pool_is_replaced_and_only_the_values_that_broke_it_are_missing(killers, monkeypatch):
    pools = [Breaking(killers, monkeypatch)]

    def new_pool(broken):
        assert broken is pools[-1]
        assert broken.broken
        pools.append(Breaking(killers, monkeypatch))
        return pools[-1]

    monkeypatch.setattr(dispatch, "new_pool", new_pool)
    found = cp.sweep(lag, RATES, PLANS, TIMES, executor=pools[0], progress=False, measures=["settling_time"])
    assert found.missing == tuple(sorted(killers))
    assert [failure.params["value"] for failure in found.failures] == sorted(killers)
    expected = np.where(np.isin(RATES, list(killers)), np.nan, np.log(50.0) / RATES)
    np.testing.assert_allclose(found.metrics["step"]["settling_time"], expected, rtol=1e-4)
    assert len(pools) <= 1 + 3 * len(killers)
    assert [pool.ended for pool in pools] == [0] + [1] * (len(pools) - 1)  # the first belongs to the caller
    assert max(pool.most for pool in pools) <= 4


def test_a_broken_executor_that_is_no_process_pool_keeps_what_it_has_finished(monkeypatch):
    pool = Breaking({RATES[20]}, monkeypatch)
    found = cp.sweep(lag, RATES, PLANS, TIMES, executor=pool, progress=False, measures=["settling_time"])
    finished = np.isfinite(found.metrics["step"]["settling_time"])
    assert finished[:20].all()
    assert not finished[25:].any()
    assert found.missing == tuple(RATES[~finished])
