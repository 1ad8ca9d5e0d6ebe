"""Sweeps that are interrupted by signals, and whose workers are killed: in processes of their own.

Scripts wait for one another by files, and say what they found as JSON.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ctrlplan as cp

PRELUDE = """
import json, os, signal, sys, threading, time, warnings
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
import control as ct
import numpy as np
import ctrlplan as cp

signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background jobs ignore
HERE = Path(__file__).parent
PLANS, TIMES = {"step": cp.Step(1.0)}, np.linspace(0.0, 10.0, 201)

def rate_of(value):
    return 0.5 + value / 100.0

def lag(value):
    rate = rate_of(value)
    return ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs="r", outputs="y")

def dies(response, tau):
    # Ends this process, unless it is the parent, where a response is that of one draw.
    elsewhere = os.getpid() != int((HERE / "parent").read_text())
    if elsewhere and abs(response.outputs[20] - (1.0 - np.exp(-1.0 / tau))) < 1e-3:  # at 1 s
        os.kill(os.getpid(), signal.SIGKILL)

def _rate(t, x, u, p):
    return (float(u[0]) - x) / p["tau"]

def _out(t, x, u, p):
    return x

def drawn(name, plan):
    return ct.nlsys(_rate, _out, states=1, inputs="r", outputs="y", params={"tau": 1.0}, name="lag")

def interrupt(pid=None):
    os.kill(pid or os.getpid(), signal.SIGINT)

def own(function):
    return [cp.Measure("own", of="run", function=function), "settling_time"]

def swept(build, values, executor=None, **options):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        options = {"measures": ["settling_time"], **options, "executor": executor, "progress": False}
        if "draws" in options:
            found = cp.monte_carlo(build, options.pop("draws"), PLANS, TIMES, **options)
        else:
            found = cp.sweep(build, values, PLANS, TIMES, **options)
    return found, [str(one.message) for one in said]

def said_of(found, said):
    metrics = found.metrics["step"]["settling_time"].tolist() if "step" in found.metrics else []
    return {
        "values": found.values.tolist() if hasattr(found, "values") else found.params["tau"].tolist(),
        "settling": [None if np.isnan(x) else x for x in metrics],
        "interrupted": found.interrupted,
        "failures": [(f.draw, f.message) for f in found.failures],
        "said": said,
        "finished": getattr(found, "finished", None),
        "sent again": found.sent_again,
        "missing": found.missing,
    }
"""


def settling(values):
    """Of a lag whose error is exp(-rate t), at the script's rates; settling is found between samples, by splines."""
    return pytest.approx(np.log(50.0) / (0.5 + np.array(values) / 100.0), rel=1e-4)


def run(tmp_path, script):
    """What a script prints as JSON."""
    path = tmp_path / "study.py"
    path.write_text(PRELUDE + script, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(Path(cp.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, str(path)],
        capture_output=True,
        text=True,
        env=environment,
        cwd=tmp_path,
        check=False,
        timeout=1200,  # rather than to wait for a signal that never came
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


SIGNALS = """
values = np.arange(1.0, 41.0)
found = {}

def build(rate):
    if rate == 31.0:
        interrupt()
    return lag(rate)

found["together"] = said_of(*swept(build, values))

def build(rate):
    def update(t, x, u, p):
        if rate == 4.0 and t > 0.0:
            interrupt()
        return rate_of(rate) * (float(u[0]) - x)
    return ct.nlsys(update, None, states=1, inputs="r", outputs="y", name="lag")

found["one by one"] = said_of(*swept(build, values))

go_on = threading.Event()

def build(rate):
    if rate == 1.0 or rate == 6.0:  # the first is slow; another runs when all before it are done
        if rate == 6.0:
            interrupt()
        go_on.wait()
    return lag(rate)

with ThreadPoolExecutor(2) as pool:
    found["threads"] = said_of(*swept(build, values, pool, chunk=1))
    go_on.set()

def measure(run):
    if len(seen) == 7 + 3:  # the nominal loop, two draws that are compared with Python, and seven draws
        interrupt()
    seen.append(1)
    return {}

seen = []
found["draws"] = said_of(*swept(drawn, None, draws={"tau": np.linspace(0.5, 1.5, 20)}, measures=own(measure)))

def build(rate):
    def update(t, x, u, p):
        if rate == 3.0 and t > 0.0 and not lost:
            try:
                interrupt()
            except BaseException:  # as in callbacks of C libraries and of the garbage collector
                lost.append(1)
        return rate_of(rate) * (float(u[0]) - x)
    return ct.nlsys(update, None, states=1, inputs="r", outputs="y", name="lag")

lost = []
found["lost"] = said_of(*swept(build, values))

def build(rate):
    def update(t, x, u, p):
        if rate == 3.0 and t > 0.0:
            try:
                if not mistaken:
                    mistaken.append(1)
                    interrupt()
            except BaseException:
                pass
            raise ValueError("taken for an error")
        return rate_of(rate) * (float(u[0]) - x)
    return ct.nlsys(update, None, states=1, inputs="r", outputs="y", name="lag")

mistaken = []
found["mistaken"] = said_of(*swept(build, values))
found["handler"] = signal.getsignal(signal.SIGINT) is signal.default_int_handler

class Fetched(Future):
    def result(self, timeout=None):
        requests.append("sent")
        if len(requests) == 3 and where == "result":
            interrupt()
        found = super().result(timeout)
        requests[-1] = "answered"
        return found

class Here:
    # Runs tasks within submit, and returns their results on request.
    _max_workers = 1

    def submit(self, function, *arguments):
        taken.append("begun")
        future = Fetched()
        future.set_result(function(*arguments))
        if len(taken) == 4 and where == "submit":
            interrupt()
        taken[-1] = "done"
        return future

def build(rate):
    if rate == 4.0 and where == "run":
        interrupt()
        taken.append("goes on")
    return lag(rate)

for where in ("result", "submit", "run"):
    requests, taken = [], []
    found[f"in {where}"] = said_of(*swept(build, values, Here(), chunk=1))
    found[f"calls in {where}"] = requests, taken

class Again:
    def submit(self, function, *arguments):
        interrupt()

try:
    swept(lag, values, Again())
    found["again"] = "returned"
except KeyboardInterrupt:
    found["again"] = "raised"

def build(rate):
    if rate == 3.0:
        try:
            interrupt()
        finally:
            interrupt()
    return lag(rate)

try:
    swept(build, values)
    found["twice at once"] = "returned"
except KeyboardInterrupt:
    found["twice at once"] = "raised"

class Twice:
    def submit(self, function, *arguments):
        return self
    def result(self):
        interrupt()
    def cancel(self):
        interrupt()

try:
    swept(lag, values, Twice())
    found["twice"] = "returned"
except KeyboardInterrupt:
    found["twice"] = "raised"
print(json.dumps(found))
"""


@pytest.mark.slow
def test_signals_keep_what_is_finished_in_this_process_and_in_threads(tmp_path):
    found = run(tmp_path, SIGNALS)
    for name, values in (
        ("together", range(1, 31)),
        ("one by one", range(1, 4)),
        ("threads", range(2, 6)),
        ("lost", range(1, 3)),
        ("mistaken", range(1, 3)),
    ):
        one = found[name]
        assert one["values"] == list(values)
        assert one["settling"] == settling(values)
        assert one["interrupted"]
        assert one["failures"] == []
        assert one["said"] == [f"the sweep was interrupted: {len(values)} of 40 values are returned"]
    draws = found["draws"]
    tau = np.linspace(0.5, 1.5, 20)
    assert draws["settling"][:7] == pytest.approx(np.log(50.0) * tau[:7], rel=1e-4)
    assert draws["settling"][7:] == [None] * 13
    assert (draws["interrupted"], draws["finished"], draws["failures"]) == (True, 7, [])
    assert draws["said"] == ["monte_carlo was interrupted: 7 of 20 draws are returned"]
    assert found["handler"]
    for where, last, taken in (
        ("result", 4, ["done"] * 4),
        ("submit", 4, ["done"] * 4),
        ("run", 3, ["done"] * 3 + ["begun"]),
    ):
        assert found[f"in {where}"]["settling"] == settling(range(1, last + 1))
        assert found[f"in {where}"]["interrupted"]
        requests, calls = found[f"calls in {where}"]
        assert set(requests) == {"answered"}  # a client of dask with one that was broken off receives no more
        assert calls == taken
    assert found["again"] == "returned"  # one signal alone, while tasks are handed out
    assert found["twice"] == found["twice at once"] == "raised"


KILLED = """
def build(rate):
    with open(HERE / "built", "a") as file:
        print(os.getpid(), rate, file=file)
    if rate == 4.0:
        os.kill(os.getpid(), signal.SIGKILL)
    return lag(rate)

if __name__ == "__main__":
    found, context = {}, get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        found["values"] = said_of(*swept(build, np.arange(1.0, 8.0), pool))
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            swept(lambda rate: lag(rate), [1.0, 2.0], pool)
        except ValueError as error:
            found["lambda"] = str(error)
    found["built"] = [line.split() for line in (HERE / "built").read_text().splitlines()]
    found["parent"] = str(os.getpid())
    print(json.dumps(found))
"""


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_only_the_value_that_killed_it_is_missing(tmp_path):
    found = run(tmp_path, KILLED)
    died = "BrokenProcessPool: A process in the process pool was terminated abruptly"
    values = found["values"]
    assert values["values"] == list(range(1, 8))
    assert values["settling"][3] is None
    assert values["settling"][:3] + values["settling"][4:] == settling([1, 2, 3, 5, 6, 7])
    ((k, message),) = values["failures"]
    assert k == 3
    assert message.startswith(died)
    assert {3.0, 4.0} <= set(values["sent again"])
    assert values["missing"] == [4.0]
    assert [float(rate) for _, rate in found["built"]].count(4.0) == 3
    assert found["parent"] not in {pid for pid, _ in found["built"]}
    assert not values["interrupted"]
    assert found["lambda"].startswith("build must be picklable for other processes, got ")


LOKY = """
import loky

def build(rate):
    if rate == 4.0:
        os._exit(9)
    return lag(rate)

if __name__ == "__main__":
    found = [
        said_of(*swept(build, np.arange(1.0, 8.0), loky.get_reusable_executor(max_workers=2, timeout=60))),
        said_of(*swept(build, np.arange(1.0, 8.0), loky.ProcessPoolExecutor(1))),
    ]
    print(json.dumps(found))
"""


@pytest.mark.slow
def test_a_broken_pool_of_another_library_is_replaced(tmp_path):
    """Its workers fork from a process of their own, its pools have other arguments, and no ``cancel_futures``."""
    for found in run(tmp_path, LOKY):
        assert found["missing"] == [4.0]
        assert found["settling"][:3] + found["settling"][4:] == settling([1, 2, 3, 5, 6, 7])
        assert [k for k, _ in found["failures"]] == [3]
        assert not found["interrupted"]


PROCESSES = """
def build(rate):
    if rate in (1.0, 6.0):
        while not (HERE / "go on").exists():
            time.sleep(0.01)
    return lag(rate)

class Pool(ProcessPoolExecutor):
    # Interrupts this process when it has got four results.
    got = 0

    def submit(self, *arguments, **named):
        task = super().submit(*arguments, **named)
        task.add_done_callback(self.count)
        return task

    def count(self, task):
        if not task.cancelled():
            self.got += 1
            if self.got == 4:
                interrupt()

if __name__ == "__main__":
    with Pool(2, mp_context=get_context("spawn")) as pool:
        found = said_of(*swept(build, np.arange(1.0, 41.0), pool, chunk=1))
        (HERE / "go on").touch()
    print(json.dumps(found))
"""


@pytest.mark.slow
def test_a_signal_keeps_what_processes_have_finished_behind_a_slow_task(tmp_path):
    found = run(tmp_path, PROCESSES)
    assert found["values"] == [2.0, 3.0, 4.0, 5.0]
    assert (found["interrupted"], found["failures"]) == (True, [])


ENDLESS = """
def build(rate):
    def update(t, x, u, p):
        if rate == 2.0:
            time.sleep(0.01)  # a run of many hours
            return np.array([-3e5 * (x[0] - float(u[0]) - np.sin(1e4 * t))])
        return rate_of(rate) * (float(u[0]) - x)
    return ct.nlsys(update, None, states=1, inputs="r", outputs="y", name="lag")

if __name__ == "__main__":
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for one in (None, pool):
            swept(build, [1.0, 3.0], one)  # imports, which a time limit would count
        found = [said_of(*swept(build, [1.0, 2.0, 3.0], one, timeout=4.0)) for one in (None, pool)]
    print(json.dumps(found))
"""


@pytest.mark.slow
def test_one_run_without_an_end_stops_no_sweep(tmp_path):
    for found in run(tmp_path, ENDLESS):
        assert [found["settling"][k] for k in (0, 2)] == settling([1, 3])
        ((k, message),) = found["failures"]
        assert k == 1
        assert message.startswith("TimeLimitError: a run must end within timeout = 4 s, got to t = ")


DASK = """
from functools import partial
import dask
from distributed import Client, LocalCluster

class Seen:
    # Leaves a file when the parent has been told of two tasks that are done.

    def __init__(self, executor, name):
        self.executor, self.done, self.name = executor, [], name

    def submit(self, function, *arguments):
        future = self.executor.submit(function, *arguments)
        future.add_done_callback(self.tell)
        return future

    def tell(self, future):
        self.done.append(1)
        if len(self.done) >= 2:
            (HERE / f"seen {self.name}").touch()

def wait_for(name):
    while not (HERE / name).exists():
        time.sleep(0.01)

def build(name, rate):
    time.sleep(0.05)  # dask moves no short tasks from a busy worker to an idle one
    if rate == 6.0:
        wait_for(f"seen {name}")
        interrupt(int((HERE / "parent").read_text()))
    if rate in (1.0, 6.0):
        wait_for(f"go on {name}")
    return lag(rate)

def measure(run):
    dies(run.response, 1.0)
    return {}

def tasks(client):
    # Tasks that the scheduler has: none once it has heard that those that ran have ended.
    def count(dask_scheduler):
        return len(dask_scheduler.tasks)
    for _ in range(3000):
        left = client.run_on_scheduler(count)
        if not left:
            break
        time.sleep(0.01)
    return left

if __name__ == "__main__":
    (HERE / "parent").write_text(str(os.getpid()))
    dask.config.set({"distributed.scheduler.allowed-failures": 0})
    found = {"interrupted": [], "left": []}
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        for name, executor in (("client", client), ("executor", client.get_executor())):
            seen = Seen(executor, name)
            # All tasks are submitted, and half of them carry the loop: tasks without it end early on a worker without.
            options = {"chunk": 1, "workers": 50}
            found["interrupted"].append(said_of(*swept(partial(build, name), np.arange(1.0, 101.0), seen, **options)))
            (HERE / f"go on {name}").touch()
            found["left"].append(tasks(client))
        found["lambda"] = said_of(*swept(lambda rate: lag(rate), [1.0, 2.0, 3.0], client))
        params = {"tau": np.linspace(0.5, 1.5, 11)}
        found["draws"] = said_of(*swept(drawn, None, client, draws=params, measures=own(measure)))
    print(json.dumps(found))
"""


@pytest.mark.slow
def test_a_dask_cluster_keeps_what_is_finished_and_no_tasks(tmp_path):
    pytest.importorskip("dask.distributed", reason="dask.distributed is not installed")
    found = run(tmp_path, DASK)
    for one in found["interrupted"]:
        assert 2 <= len(one["values"]) < 100
        assert not {1.0, 6.0} & set(one["values"])
        assert one["settling"] == settling(one["values"])
        assert (one["interrupted"], one["failures"]) == (True, [])
    assert found["left"] == [0, 0]
    assert found["lambda"]["settling"] == settling([1, 2, 3])
    one = found["draws"]
    assert [(k, message[:12]) for k, message in one["failures"]] == [(5, "KilledWorker")]
    assert [k for k, value in enumerate(one["settling"]) if value is None] == one["missing"] == [5]
    assert 5 in one["sent again"]
    others = [value for value in one["settling"] if value is not None]
    assert others == pytest.approx(np.log(50.0) * np.delete(np.linspace(0.5, 1.5, 11), 5), rel=1e-4)
    assert not one["interrupted"]


THREADS = """
import casadi

TURNS = threading.Condition()
TRACED = []

def build(value):
    rate = rate_of(value)

    def update(t, x, u, p):
        # The first to be called with symbols leaves first, and only when a second is there.
        numbers = isinstance(x, np.ndarray) and x.dtype == float
        if not numbers and len(TRACED) < 2:
            with TURNS:
                TRACED.append(value)
                TURNS.notify_all()
                TURNS.wait_for(lambda: len(TRACED) > 1 and (TRACED[0] == value or "left" in TRACED), timeout=5.0)
        elif numbers and TRACED and TRACED[0] == value:
            with TURNS:
                TRACED.append("left")
                TURNS.notify_all()
        return rate * (u - x) + 1e-12 * np.sin(x)

    return ct.nlsys(update, None, states=1, inputs="r", outputs="y", name="lag")

names = dir(casadi.SX)
mode = casadi.GlobalOptions.getNumpyMode() if hasattr(casadi.GlobalOptions, "getNumpyMode") else None
with ThreadPoolExecutor(4) as pool:
    found = said_of(*swept(build, np.arange(1.0, 13.0), pool))
found["as it was"] = names == dir(casadi.SX)
found["mode"] = mode is None or mode == casadi.GlobalOptions.getNumpyMode()
found["one"] = float(casadi.SX(1))
print(json.dumps(found))
"""


@pytest.mark.slow
def test_a_sweep_in_threads_leaves_casadi_as_it_was(tmp_path):
    pytest.importorskip("casadi", reason="CasADi is not installed")
    found = run(tmp_path, THREADS)
    assert found["settling"] == settling(np.arange(1, 13))
    assert found["failures"] == []
    assert (found["one"], found["as it was"], found["mode"]) == (1.0, True, True)
