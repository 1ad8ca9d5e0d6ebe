"""Reference values in 250 digits (make_golden_hermite.py): every case of the file, through the public splines."""

import json
from pathlib import Path

import numpy as np
import pytest
from trajectory_oracle import Direct

from ctrlplan.trajectories import PolySpline, TrigSpline, Waypoint

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

CASES = json.loads(Path(__file__).with_name("golden_hermite.json").read_text())


def size(case):
    return sum(len(jet) for _, jet in case["points"])


def test_the_file_is_what_it_is_said_to_be():
    assert len(CASES) == 64
    assert {c["alpha"] for c in CASES} == {0, 1e-4, 0.3, 1.0, 2.5, np.pi, 4.2, 5.5}
    assert {size(c) for c in CASES} == {2, 4, 6, 7, 10, 12, 24, 40}


@pytest.mark.parametrize("case", [c for c in CASES if size(c) <= 12 and c["alpha"] in (0, 1e-4, 5.5)], ids=size)
def test_the_values_are_those_of_the_generator(case):
    times, jets = zip(*case["points"], strict=True)
    assert Direct(times, jets, case["alpha"], digits=250).jet(case["times"], 3).tolist() == case["values"]


@pytest.mark.parametrize("case", CASES, ids=[f"N{size(c)}-alpha{c['alpha']:.4g}" for c in CASES])
def test_values_and_derivatives(case):
    points = [Waypoint(t, *jet) for t, jet in case["points"]]
    duration = points[-1].time - points[0].time
    plans = [TrigSpline(points, alpha=case["alpha"])] + ([] if case["alpha"] else [PolySpline(points)])
    exact = np.array(case["values"])
    tolerance = 1e-12 if size(case) <= 24 else 1e-10
    for plan in plans:
        for nu in range(4):
            scale = max(np.abs(exact[nu]).max(), np.abs(exact[0]).max() / duration**nu)
            assert np.abs(plan(case["times"], nu) - exact[nu]).max() <= tolerance * scale
