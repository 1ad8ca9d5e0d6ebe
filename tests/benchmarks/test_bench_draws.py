"""Costs of many draws: linear loops solved together compared with one by one; tasks on two workers compared with
none; and the cost of this process for each draw that workers run. Ratios of CPU time are printed, none is asserted.
"""

import os
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from time import process_time, sleep
from types import SimpleNamespace

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies.linear import linear_plans

TIMES = np.linspace(0.0, 20.0, 2001)
PLANS = linear_plans()
OPTIONS = {"progress": False, "measures": ("settling_time", "overshoot_error")}


def build(gain):
    return cp.plants.integrator_lag_loop(gain, outputs=("y", "u"))


def seconds(function):
    begin = process_time()
    result = function()
    return process_time() - begin, result


def worker_seconds(_):
    sleep(0.1)  # so that both workers take a task
    return os.getpid(), process_time()


@pytest.mark.benchmark
def test_draws_of_linear_loops_compared_with_one_by_one(benchmark, capsys):
    gains = cp.draws(60, seed=1, gain=(1.0, 100.0))["gain"]
    together = benchmark.pedantic(
        lambda: seconds(lambda: cp.monte_carlo(build, {"gain": gains}, PLANS, TIMES, **OPTIONS)), rounds=2
    )
    apart = seconds(lambda: [cp.compare(build(gain), PLANS, TIMES, measures=OPTIONS["measures"]) for gain in gains])
    for plan, rows in together[1].metrics.items():
        for name, row in rows.items():
            expected = [one.metrics[plan][name] for one in apart[1]]
            np.testing.assert_allclose(row, expected, rtol=1e-9, atol=1e-9)
    benchmark.extra_info["ratio"] = apart[0] / together[0]
    with capsys.disabled():
        print(
            f"\n60 draws, 3 plans: {together[0]:.2f} s, one by one {apart[0]:.2f} s: {apart[0] / together[0]:.1f} times"
        )


@pytest.mark.benchmark
def test_two_workers_compared_with_none(benchmark, capsys):
    gains = np.geomspace(0.25, 1000.0, 300)

    def used(pool):
        return sum(dict(pool.map(worker_seconds, range(4))).values())

    def sweep(executor=None):
        return cp.sweep(build, gains, PLANS, TIMES, executor=executor, **OPTIONS)

    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        cp.sweep(build, gains[:8], PLANS, TIMES, executor=pool, **OPTIONS)  # imports
        alone = seconds(sweep)
        before = used(pool)
        parent, found = benchmark.pedantic(lambda: seconds(lambda: sweep(pool)), rounds=1)
        workers = used(pool) - before
    for plan, rows in alone[1].metrics.items():
        for name, row in rows.items():
            np.testing.assert_allclose(found.metrics[plan][name], row, rtol=1e-14, atol=1e-12)
    benchmark.extra_info["ratio"] = (workers + parent) / alone[0]
    with capsys.disabled():
        print(
            f"\n300 gains on two workers: {workers:.2f} s in them, {parent:.3f} s here, without them {alone[0]:.2f} s: "
            f"{(workers + parent) / alone[0]:.2f} times"
        )


class Prepared:
    """Executor of 64 workers whose replies are all those of the first task, read as if they came from elsewhere."""

    num_workers = 64

    def __init__(self):
        self.reply, self.others = b"", 0.0

    def submit(self, function, task):
        pickle.dumps((function, task))
        if not self.reply:
            self.others, reply = seconds(lambda: pickle.dumps(function(task)))
            self.reply = reply
        return SimpleNamespace(done=lambda: True, result=lambda: pickle.loads(self.reply))


@pytest.mark.benchmark
def test_cost_of_a_draw_that_a_worker_runs(benchmark, capsys):
    count, executor = 4000, Prepared()
    drawn = cp.draws(count, seed=1, gain=(1.0, 100.0))
    total, found = benchmark.pedantic(
        lambda: seconds(
            lambda: cp.monte_carlo(build, drawn, PLANS, TIMES, executor=executor, chunk=50, progress=False)
        ),
        rounds=1,
    )
    assert found.finished == count
    milliseconds = 1e3 * (total - executor.others) / count
    benchmark.extra_info["milliseconds"] = milliseconds
    with capsys.disabled():
        print(f"\n4000 draws, 3 plans, {found.timepts.size} times of the bands: {milliseconds:.3f} ms a draw")
