"""Loops without inputs that a builder returns again."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies import running

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
PLAN, SAME = cp.PolySpline(MOVE, labels=["y"]), cp.PiecewiseSpline(MOVE, labels=["y"])
TIMES = np.linspace(0.0, 8.0, 401)


def fed(plan, gain):
    """Loop that contains its plan."""
    source = cp.create_source_iosystem(plan, 0)
    servo = ct.nlsys(
        lambda t, x, u, params: params["gain"] * (u - x) - x**3,
        lambda t, x, u, params: x,
        inputs="y_ref",
        outputs="y",
        states=1,
        params={"gain": gain},
        name="servo",
    )
    source.set_outputs(["y_ref"])
    return ct.interconnect([source, servo], inputs=0, outputs=["y"], name="loop", warn_duplicate=False)


@pytest.fixture
def simulated(monkeypatch):
    """Loops that are simulated, in order."""
    calls, simulate = [], running.simulate_for_metrics
    monkeypatch.setattr(
        running, "simulate_for_metrics", lambda loop, *rest, **more: calls.append(loop) or simulate(loop, *rest, **more)
    )
    return calls


def test_a_loop_that_is_returned_again_is_simulated_once(simulated):
    loop = fed(PLAN, 5.0)
    found = cp.compare(lambda name, plan: loop, {"one": PLAN, "two": SAME}, TIMES, outputs=["y"])
    assert len(simulated) == 1
    alone = cp.compare(lambda name, plan: fed(plan, 5.0), {"two": SAME}, TIMES, outputs=["y"])
    assert found.metrics["two"] == pytest.approx(alone.metrics["two"], rel=1e-6, abs=1e-9)
    assert found.plans["two"] is SAME
    assert found.metrics["one"]["settling_time"] == found.metrics["two"]["settling_time"]


def test_a_loop_that_was_changed_meanwhile_is_simulated_again(simulated):
    loop = fed(PLAN, 5.0)

    def build(name, plan):
        loop.params["gain"] = {"one": 5.0, "two": 50.0}[name]
        return loop

    found = cp.compare(build, {"one": PLAN, "two": SAME}, TIMES, outputs=["y"])
    assert len(simulated) == 2
    assert found.metrics["two"]["lag_error"] < 0.2 * found.metrics["one"]["lag_error"]


def test_a_loop_whose_input_is_the_plan_is_simulated_with_each(simulated):
    loop = ct.ss(-2.0, 2.0, 1.0, 0.0, inputs="y_ref", outputs="y", name="lag")
    late = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(4, 1, 0, 0)], labels=["y"])
    found = cp.compare(lambda name, plan: loop, {"one": PLAN, "two": late}, TIMES)
    assert len(simulated) == 2
    assert found.metrics["two"]["settling_time"] > found.metrics["one"]["settling_time"] + 1.0
