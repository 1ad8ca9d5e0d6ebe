"""CPU time of a plan exported to C, at random times, compiled by gcc -O2; printed, not asserted."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

from ctrlplan.trajectories import PolySpline, Waypoint

GCC = shutil.which("gcc")
pytestmark = pytest.mark.skipif(GCC is None, reason="gcc is not installed")

COUNT = 1_000_000
LOOP = """
#include "plan.h"
#include <time.h>

double run(const double *times, int count, double *jets)
{
    clock_t before = clock();
    for (int i = 0; i < count; i++) {
        double jet[PLAN_DERIVATIVES + 1][PLAN_AXES];
        plan_jet(times[i], jet);
        for (int k = 0; k <= PLAN_DERIVATIVES; k++) {
            for (int axis = 0; axis < PLAN_AXES; axis++) {
                jets[(k * PLAN_AXES + axis) * (long)count + i] = jet[k][axis];
            }
        }
    }
    return (double)(clock() - before) / CLOCKS_PER_SEC;
}
"""


def degree_11():
    """Position and 5 derivatives at both ends: 12 constraints an axis."""
    start, end = ({"x": [x, *[0.0] * 5], "z": [z, *[0.0] * 5]} for x, z in ((0.0, 1.0), (2.0, 1.3)))
    return PolySpline([Waypoint.from_jets(0.0, **start), Waypoint.from_jets(1.0, **end)])


def test_jet_in_c(tmp_path, benchmark, capsys):
    plan = degree_11()
    assert plan.degree == (11, 11)
    plan.export(tmp_path / "plan.c", derivatives=3)
    (tmp_path / "loop.c").write_text(LOOP)
    command = [GCC, "-std=c99", "-O2", "-shared", "-fPIC", "loop.c", "plan.c", "-o", "plan.so"]
    subprocess.run(command, cwd=tmp_path, check=True)
    run = ctypes.CDLL(str(tmp_path / "plan.so")).run
    run.restype, run.argtypes = ctypes.c_double, [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p]
    times = np.random.default_rng(0).uniform(0.0, 1.0, COUNT)
    jets = np.empty((4, 2, COUNT))
    arguments = times.ctypes.data, COUNT, jets.ctypes.data
    seconds = min([benchmark.pedantic(run, arguments), *(run(*arguments) for _ in range(4))])
    peaks = np.array([plan.peak(k) for k in range(4)])[:, :, None]
    assert (np.abs(jets - plan.jet(times, 3)) <= 1e-12 * peaks).all()
    with capsys.disabled():
        print(f"\n  position and 3 derivatives of 2 axes of degree 11 in C: {1e9 * seconds / COUNT:.0f} ns of CPU")
