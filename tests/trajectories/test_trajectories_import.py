"""The ground floor stands alone: numpy and scipy only."""

import os
import subprocess
import sys
from pathlib import Path

import ctrlplan.trajectories

ROOT = Path(ctrlplan.trajectories.__file__).parents[2]


def test_neither_control_nor_matplotlib_nor_optimisers_are_loaded():
    code = """
import sys
import scipy.linalg
before = set(sys.modules)  # some releases of scipy load more with it
import ctrlplan.trajectories
from ctrlplan.trajectories import Step, TrigSpline, Waypoint, stack
plan = TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)], alpha=1.0)
stack([plan.then(plan + Step(1.0, 1.0)), plan]).extrema(1)
plan([0.5] * 10_000, 2), plan.bounds(lambda jet: jet[0, 0], 0, 1.0), plan.to_dict(), plan.fourier()
loaded = {name.partition(".")[0] for name in sys.modules}
slow = {"scipy.optimize", "scipy.special", "scipy.sparse", "scipy.interpolate"} & (sys.modules.keys() - before)
print(sorted(loaded & {"control", "matplotlib", "pandas", "jinja2", "tqdm", "casadi"}), sorted(slow))
"""
    run = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(run, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout.strip() == "[] []"
