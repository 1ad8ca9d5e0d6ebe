"""CPU time of importing the package, next to what it would be used with; ratios are printed."""

import resource
import subprocess
import sys
from statistics import median

import pytest

OWN = "import ctrlplan as cp; cp.TrigSpline"
PEER = "import scipy.interpolate, control"


@pytest.fixture(autouse=True)
def bytecode(monkeypatch):
    """Bytecode of this package is written in the first run, as an installation does for that of the peer."""
    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)


def seconds(code):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.benchmark
def test_import_next_to_scipy_and_control(benchmark, capsys):
    """Goal: at most half."""
    loaded = f"import sys; {OWN}; assert not {{'control', 'scipy.optimize'}} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", loaded], check=True)
    rows = [(seconds(OWN), seconds(PEER)) for _ in range(3)]
    own, peer = (median(column) for column in zip(*rows, strict=True))
    benchmark.extra_info["ratio"] = own / peer
    benchmark.pedantic(lambda: seconds(OWN), rounds=1)
    with capsys.disabled():
        print(
            f"\nimport: {1e3 * own:.0f} ms, scipy.interpolate and control {1e3 * peer:.0f} ms, ratio {own / peer:.2f}"
        )


@pytest.mark.benchmark
def test_import_of_the_simulation(benchmark, capsys):
    """Goal: at most 1.05. In one process, since the time of python-control alone varies by more."""
    parts = "from time import process_time as t; a = t(); import control; b = t(); import ctrlplan.simulation; c = t()"
    loaded = "import sys; assert 'scipy.io' not in sys.modules"
    subprocess.run([sys.executable, "-c", f"{parts}; {loaded}"], check=True)
    rows = []
    for _ in range(9):
        found = subprocess.run([sys.executable, "-c", f"{parts}; print(b - a, c - a)"], check=True, capture_output=True)
        rows.append([float(number) for number in found.stdout.split()])
    peer, own = (min(column) for column in zip(*rows, strict=True))
    benchmark.extra_info["ratio"] = own / peer
    benchmark.pedantic(lambda: seconds("import ctrlplan.simulation"), rounds=1)
    with capsys.disabled():
        print(f"\nctrlplan.simulation: {1e3 * own:.0f} ms, import control {1e3 * peer:.0f} ms, ratio {own / peer:.3f}")
