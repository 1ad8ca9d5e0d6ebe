"""CPU time of the studies of `ctrlplan reproduce`, without the report, next to an earlier version, in turn.

The environment variable CTRLPLAN_EARLIER is the folder of that version, as a git work tree of commit d77afc8; without
it, only the own time is printed. Each run is a new process; imports before the first study are not counted.
"""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from statistics import median

import pytest

import ctrlplan

OWN = Path(ctrlplan.__file__).parent.parent
EARLIER = os.environ.get("CTRLPLAN_EARLIER", "")
ROUNDS = 5 if EARLIER else 1
SAME = ("iae", "path_length", "error_travel", "force_peak")
"""Metrics with the same definition in both versions."""
STUDIES = """
import contextlib, json, time
from ctrlplan.studies import PAPER
try:
    from ctrlplan.simulation.built_forms import shared_forms
except ImportError:  # an earlier version
    shared_forms = contextlib.nullcontext
begin = time.process_time()
with shared_forms():
    found = {name: study(progress=False).comparison.metrics for name, study in PAPER.items()}
print(json.dumps([time.process_time() - begin, found]))
"""


def studies(folder):
    """CPU time [s], and the metrics by study and plan."""
    environment = os.environ | {"PYTHONPATH": str(folder)}
    found = subprocess.run([sys.executable, "-c", STUDIES], check=True, capture_output=True, env=environment, cwd="/")
    return json.loads(found.stdout)


@pytest.mark.benchmark
def test_studies_next_to_an_earlier_version(benchmark, capsys):
    """Goal: at most 0.3 of commit d77afc8, with the same results."""
    rows = [[studies(folder) for folder in (OWN, EARLIER) if folder] for _ in range(ROUNDS)]
    own = median(row[0][0] for row in rows)
    metrics = rows[0][0][1]
    # Step response of k/(s^2 + s) in unity feedback with k = 5.
    overshoot = 100.0 * math.exp(-0.5 * math.pi / math.sqrt(5.0 - 0.25))
    assert metrics["linear"]["step"]["overshoot_error"] == pytest.approx(overshoot, rel=1e-6)
    printed = f"\nstudies of reproduce: {own:.1f} s CPU"
    if EARLIER:
        for study, plans in rows[0][1][1].items():
            # Plans may have other names now; the earlier step run does not end where the rope becomes slack.
            for plan in [plan for plan in plans if plan in metrics[study] and (plan != "step" or study == "linear")]:
                values = plans[plan]
                common = {name: values[name] for name in SAME if name in values}
                ours = {name: metrics[study][plan][name] for name in common}
                assert ours == pytest.approx(common, rel=1e-3, abs=1e-6, nan_ok=True), (study, plan)
        ratio = median(row[0][0] / row[1][0] for row in rows)
        benchmark.extra_info["ratio"] = ratio
        printed += f", earlier version {median(row[1][0] for row in rows):.1f} s, ratio {ratio:.2f}"
    benchmark.pedantic(studies, (OWN,), rounds=1)
    with capsys.disabled():
        print(printed)
