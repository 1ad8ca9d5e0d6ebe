"""CPU time of importing the package for one spline, next to what it would be used with; the ratio is printed."""

import resource
import subprocess
import sys
from statistics import median

import pytest

OWN = "import ctrlplan as cp; cp.TrigSpline"
PEER = "import scipy.interpolate, control"


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
