"""pytest plugin: calls of the two functions of python-control are repeated with ctrlplan and compared.

The test continues with the response of python-control, so that the iterations of
an optimiser, and the number and names of later calls, do not depend on ctrlplan.
Loaded by ``-p`` in a separate process; the environment variable CTRLPLAN_PEERS
contains the folder of the record.
"""

# ruff: noqa: NPY002 (python-control's tests draw from numpy's global generator)

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import os
import sys
import time
import warnings
import zlib
from pathlib import Path

import control as ct
import numpy as np
from adapter import options_of, response
from comparison import better_answers, differences

FUNCTIONS = ("input_output_response", "forced_response")

MAXIMUM_CALLS = 400_000
"""Calls after which a process ends: three times those of all tests and examples."""

LONGEST = (
    "examples.py::test_example[cds112-L9_mhe-pvtol.ipynb]",
    "examples.py::test_example[mhe-pvtol.ipynb]",
    "examples.py::test_example[mpc_aircraft.ipynb]",
    "optimal_test.py",
    "examples.py",
)
"""Beginnings of the names of the longest tests, which go first: two processes then end at about the same time."""


class Recorder:
    """Calls of one process: their number, and which differ."""

    def __init__(self, folder):
        self.originals = {name: getattr(ct, name) for name in FUNCTIONS}
        self.path = Path(folder, f"calls-{os.getpid()}.jsonl").resolve()  # examples change the folder
        self.test, self.count, self.total = "import", 0, 0
        self.started, self.ours = time.process_time(), 0.0  # CPU time [s] at the test's start, and of its comparisons
        self.compared, self.running, self.comparing = {}, [], False

    def begin(self, test):
        """Calls are named after the test and counted in it."""
        self.end()
        self.test, self.count, self.compared = test, 0, {}
        self.started, self.ours = time.process_time(), 0.0

    def end(self):
        """Write how many calls the test has made, its CPU time, and how much of that the comparisons took."""
        spent = time.process_time() - self.started
        self.write({"test": self.test, "calls": self.count, "cpu": round(spent, 3), "ours": round(self.ours, 3)})

    def write(self, entry):
        """One line of the record."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def call(self, function, system, args, kwargs):
        """Response of python-control, after comparison with that of ctrlplan.

        Calls that blocks make while python-control runs them are calls too, as those of a predictive controller; those
        that blocks make while ctrlplan does are not, nor those by which one of the functions hands a system to the
        other, or a list of systems one by one.
        """
        original = self.originals[function]
        if self.comparing or any(system is one for one in self.running):
            return original(system, *args, **kwargs)
        self.count, self.total = self.count + 1, self.total + 1
        if self.total > MAXIMUM_CALLS:
            raise SystemExit(f"calls must number {MAXIMUM_CALLS} at most in a process")
        number, begun, outer = self.count, np.random.get_state(), self.running
        self.running = system if isinstance(system, (list, tuple)) else [system]
        error, answer = None, None
        try:
            answer = original(system, *args, **kwargs)
        except Exception as raised:
            error = raised
        finally:
            self.running = outer
        ended, self.comparing, compared = np.random.get_state(), True, time.process_time()
        try:
            with warnings.catch_warnings(), np.errstate(all="warn"):
                warnings.simplefilter("ignore")
                self.compare(number, function, system, args, kwargs, error or answer, begun)
        finally:
            self.comparing = False
            self.ours += time.process_time() - compared
            np.random.set_state(ended)
        if error is not None:
            raise error
        return answer

    def compare(self, number, function, system, args, kwargs, answer, random):
        """Record differences from the response of python-control.

        A call that repeats one of the test to the last bit, answer included, as an optimiser's finite differences do,
        differs where that one did.
        """
        key = id(system), _digest(function, args, kwargs, answer)
        if key in self.compared:
            self.record(number, function, system, self.compared[key][1])
            return
        options = {}
        try:
            np.random.set_state(random)
            options = options_of(function, args, kwargs)
            ours = response(function, system, options, getattr(answer, "t", None))
        except Exception as raised:
            ours = raised
        one = isinstance(answer, Exception) or not isinstance(answer, list) or not isinstance(ours, list)
        pairs = [(system, ours, answer)] if one else zip(system, ours, answer, strict=True)
        found = [entry for each in pairs for entry in self.differences(function, options, *each)]
        self.compared[key] = system, found  # the system too: while it lives, no other has its id
        self.record(number, function, system, found)

    def record(self, number, function, system, found):
        """Write the differences of a call."""
        if found:
            entry = {"test": self.test, "call": number, "function": function, "system": type(system).__name__}
            entry["differs"] = [[field, text] for field, text, _ in found]
            self.write(entry)

    def differences(self, function, options, system, ours, answer):
        """Differences, in signals from the most accurate response of python-control."""
        found = differences(ours, answer)
        signals = [entry for entry in found if entry[0] in ("outputs", "states")]
        if not signals or any(entry[0] in ("inputs", "times") for entry in found):
            return found
        others = [entry for entry in found if entry not in signals]
        for better in better_answers(self.originals, function, system, options, answer):
            again = [entry for entry in differences(ours, better) if entry[0] in ("outputs", "states")]
            signals = min(signals, again, key=lambda entries: sum(entry[2] for entry in entries))
            if not signals:
                break
        return others + signals


def _digest(*values):
    """Hash of a call and its response."""
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, ct.TimeResponseData):
            value = [value.t, value.y, value.x, value.u]
        if isinstance(value, dict):
            value = [entry for item in value.items() for entry in item]
        if isinstance(value, (list, tuple)):
            digest.update(_digest(*value))
        else:
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        digest.update(b";")
    return digest.digest()


def patch(recorder):
    """Replace the two functions in every module of control by the recorder."""
    for module in ("flatsys", "matlab", "optimal", "phaseplot"):
        importlib.import_module(f"control.{module}")
    for name in FUNCTIONS:
        original = recorder.originals[name]

        @functools.wraps(original)
        def answered(*args, _name=name, **kwargs):
            system = args[0] if args else kwargs.pop("sys" if "sys" in kwargs else "sysdata")
            return recorder.call(_name, system, args[1:], kwargs)

        for module in [m for key, m in sys.modules.items() if key.partition(".")[0] == "control"]:
            for bound in [key for key, value in vars(module).items() if value is original]:
                setattr(module, bound, answered)


def pytest_configure(config):
    """Patch before any test module is imported."""
    if hasattr(config, "workerinput") or config.getoption("numprocesses", None) in (None, 0):
        config.peers = Recorder(os.environ["CTRLPLAN_PEERS"])
        patch(config.peers)


def pytest_collection_modifyitems(config, items):
    """Select the sample: of each file the tests whose name's CRC-32 a number divides; the longest first."""
    sample = json.loads(os.environ.get("CTRLPLAN_PEERS_SAMPLE", "{}"))
    items[:] = [item for item in items if zlib.crc32(_name(item).encode()) % sample.get(item.path.name, 1) == 0]
    items.sort(key=lambda item: [not _name(item).startswith(name) for name in LONGEST])


def pytest_runtest_protocol(item):
    """Name the calls after the test, and draw the same random numbers in it whatever ran before."""
    recorder = getattr(item.config, "peers", None)
    if recorder is not None:
        np.random.seed(zlib.crc32(_name(item).encode()))
        recorder.begin(_name(item))


def _name(item):
    """Name of a test that does not depend on where its file lies."""
    return f"{item.path.name}::{item.nodeid.partition('::')[2]}"


def pytest_unconfigure(config):
    """Write the last test's calls."""
    if hasattr(config, "peers"):
        config.peers.end()
