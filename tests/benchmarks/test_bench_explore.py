"""Cost of one change of a slider (aim: 50 ms): plan, response, metrics and the numbers of the drawing."""

import math

import numpy as np
import pytest

import ctrlplan as cp

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 0.4), cp.Waypoint(4, 1, 0, 0)]
PLANAR = [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[1, 0, 0]), cp.Waypoint.from_jets(4, x=[2, 0, 0], z=[3, 0, 0])]
CRANE = [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[10, 0, 0]), cp.Waypoint.from_jets(15, x=[20, 0, 0], z=[11, 0, 0])]


@pytest.mark.benchmark(group="one change of a slider")
@pytest.mark.parametrize("kind", ["linear loop", "plan of two axes", "crane, a loop built for each plan"])
def test_a_change_of_a_slider(kind, benchmark):
    if kind == "linear loop":
        found = cp.explore(MOVE, cp.plants.integrator_lag_loop(100.0, outputs=("y", "u")))
    elif kind == "plan of two axes":
        found = cp.explore(PLANAR)
    else:
        crane = cp.plants.Crane()
        found = cp.explore(CRANE, lambda name, plan: cp.plants.crane_loop(crane, plan))
    alphas = iter(np.linspace(0.1, 6.0, 10_000))

    benchmark.pedantic(lambda: found.set({"alpha": next(alphas)}), rounds=50, warmup_rounds=2)
    assert found.widget.error == ""
    assert found.plan.alpha == found.values["alpha"]
    assert all(math.isfinite(value) for value in (found.plan.duration, *found.metrics.values()))
