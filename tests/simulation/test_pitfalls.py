"""What users ran into: loops and calls that once ended in a wrong number or a raw error."""

import subprocess
import sys

import control as ct
import numpy as np
import pytest
from strict import WARNINGS

import ctrlplan as cp

T = np.linspace(0.0, 5.0, 501)
MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)]
PLAN = cp.TrigSpline(MOVE, alpha=1.0, labels=["r"])


@pytest.mark.slow
def test_a_quantizer_by_python_is_no_end_of_the_solution():
    """Trial steps that a solver takes back say nothing about how far it is."""
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], round(float(u[0]), 2) - x[0] - x[1]], None, states=2, inputs=["r"], outputs=2
    )
    found = cp.simulate(plant, T, PLAN, method="python")
    # Where the plan's hundredth changes, by bisection: between, the plant is linear.
    steps = [brought(PLAN, 0.005 + 0.01 * k) for k in range(100)]
    exact = sum(0.01 * cp.simulate(ct.ss([[0, 1], [-1, -1]], [[0], [1]], np.eye(2), 0), T, cp.Step(1.0, 0.0, t)).states
                for t in steps)  # fmt: skip
    assert np.abs(found.states - exact).max() <= 1e-5


def brought(plan, level):
    low, high = plan.start, plan.end
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if plan(middle) < level else (low, middle)
    return high


@pytest.mark.parametrize("method", ["exact", "compiled", "python"])
def test_crossings_between_samples_far_apart(method):
    """x = cos(40 t): each turn crosses cos(40 t) = 0.98 twice."""
    linear = ct.ss([[0.0, 1.0], [-1600.0, 0.0]], [[0.0], [0.0]], [[1.0, 0.0]], [[0.0]], inputs="u", outputs="y")
    bent = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], -1600.0 * x[0]]), lambda t, x, u, p: x[:1], states=2, inputs="u", outputs="y"
    )
    system = linear if method == "exact" else bent
    event = cp.Event("y", high=0.98)
    found = cp.simulate(system, [0.0, 3.0], 0.0, [1.0, 0.0], method=method, rtol=1e-10, events=[event])
    angle = np.arccos(0.98)
    turns = 2.0 * np.pi * np.arange(1, 20)
    exact = np.sort(np.concatenate([[angle], turns - angle, turns + angle])) / 40.0
    times = [o.time for o in found.events if o.time > 0.0]
    assert np.abs(np.array(times) - exact[exact < 3.0]).max() <= 1e-6


@pytest.mark.parametrize("name", ["rtol", "atol"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, None, "a", True])
def test_tolerances(name, value):
    if (name, value) == ("atol", None):
        return  # the default: each state's own scale
    with pytest.raises(ValueError, match=rf"{name} must be a finite number above 0, got"):
        cp.simulate(cp.plants.integrator_lag_loop(5.0), T, PLAN, **{name: value})


def test_a_run_of_more_than_a_number_can_tell():
    with pytest.raises(ValueError, match=r"timepts must span at most 1e[+]15 s, got 1e[+]18 s"):
        cp.simulate(cp.plants.integrator_lag_loop(5.0), [0.0, 1e18], PLAN)


@pytest.mark.parametrize("method", ["exact", "python"])
def test_a_delay_of_no_length_next_to_the_run(method):
    found = cp.simulate(cp.create_delay_iosystem(1e-9), T, PLAN, method=method)
    assert found.method == method
    assert np.abs(found.outputs - PLAN.shift(1e-9)(T)).max() <= 1e-15


@pytest.mark.parametrize("delay", [1e-15, 1e-20, 1e-300, 5e-324])
def test_a_delay_of_no_length_in_a_loop(delay):
    late = cp.create_delay_iosystem(delay, inputs="u", outputs="late")
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="late", outputs="y")
    gain = ct.ss([], [], [], [[2.0, -2.0]], inputs=["r", "y"], outputs="u")
    loop = ct.interconnect([late, lag, gain], inputs="r", outputs="y")
    with pytest.raises(ValueError, match=rf"a delay must be at least 1e-05 of the run of 5 s, got {delay:g} s"):
        cp.simulate(loop, T, PLAN)


def test_axes_are_joined_to_inputs_by_name():
    system = ct.ss([], [], [], np.eye(2), inputs=["z", "x"], outputs=["a", "b"])
    plan = cp.stack([PLAN, 2.0 * PLAN], labels=["x", "z"])
    found = cp.simulate(system, T, plan)
    assert np.abs(found.outputs - [2.0 * PLAN(T), PLAN(T)]).max() <= 1e-15


def test_an_error_inside_a_block_says_in_which_and_when():
    block = ct.nlsys(lambda t, x, u, p: -p["k"] * x, None, states=1, inputs=0, outputs=1, name="lost")
    with pytest.raises(KeyError) as caught:
        cp.simulate(block, T, None, 1.0, method="python")
    assert caught.value.__notes__[0] == "in block lost at 0 s"


def stopping(events):
    fast = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(0.2, 1, 0, 0)], alpha=1.0, labels=["r"])
    loop = cp.plants.integrator_lag_loop(20.0, outputs=("y", "u"))
    return cp.compare(loop, {"gentle": PLAN, "violent": fast}, T, events=events)


@pytest.mark.slow
def test_a_plan_whose_run_is_ended_wins_nothing(tmp_path):
    found = stopping([cp.Event("u", high=15.0, stop=True)])
    assert found.responses["violent"].time[-1] < 1.0
    assert found.stopped == {"violent": found.responses["violent"].time[-1]}
    assert "iae" in found.metrics["gentle"]
    violent = found.responses["violent"]
    error = np.abs(found.plans["violent"](violent.time) - violent.outputs[0])
    area = np.sum(0.5 * (error[1:] + error[:-1]) * np.diff(violent.time))
    assert found.metrics["violent"]["iae"] == pytest.approx(area, rel=1e-2)
    assert found.metrics["violent"]["iae"] < found.metrics["gentle"]["iae"]  # and yet it is not the best
    assert "an event ended the run" in found.marks["violent"]
    assert any("Events in the run with violent: u left its limits (at " in note for note in found.notes)
    page = found.report(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "violent is best" not in page


def test_what_happened_on_the_way_is_a_note():
    found = stopping([cp.Event("u", high=15.0)])
    assert "iae" in found.metrics["violent"]
    assert any(note.startswith("Events in the run with violent: u left its limits") for note in found.notes)


def explosive():
    plant = ct.nlsys(
        lambda t, x, u, p: p["g"] * x**3 - 2.0 * x + u, lambda t, x, u, p: x[:1], states=1, inputs="u", outputs="y",
        params={"g": 9.81}, name="plant",
    )  # fmt: skip
    gain = ct.ss([], [], [], [[8.0]], inputs="e", outputs="u", name="gain", dt=0)
    error = ct.summing_junction(["r", "-y"], "e", name="error")
    return ct.interconnect([error, gain, plant], inputs="r", outputs=["y", "u"], name="explosive")


@pytest.mark.slow
def test_a_draw_counts_for_the_plans_that_get_through():
    plans = {"small": cp.Step(0.2), "large": cp.Step(3.0)}
    found = cp.monte_carlo(explosive(), {"g": [0.0, 0.1, 5.0]}, plans, T, progress=False)
    assert np.isfinite(found.metrics["small"]["iae"]).all()
    assert np.isnan(found.metrics["large"]["iae"]).tolist() == [False, False, True]
    assert [(failure.draw, failure.plan) for failure in found.failures] == [(2, "large")]
    assert any("The nominal loop is draw 0 (g = 0), because " in note for note in found.nominal.notes)
    assert found.nominal_draw == 0
    assert "The responses below are those of draw 0." in next(found.notes())


def test_reprs_are_short():
    plans = {"small": cp.Step(0.2)}
    swept = cp.sweep(cp.plants.integrator_lag_loop, [1.0, 2.0], plans, T, progress=False)
    spread = cp.monte_carlo(explosive(), {"g": [0.0, 1.0]}, plans, T, progress=False)
    found = [repr(swept), repr(spread), repr(spread.nominal), repr(cp.prepare(explosive()))]
    assert found[0] == "<Sweep of small over 2 values of value>"
    assert max(map(len, found)) < 120


@pytest.mark.parametrize(
    ("call", "kind", "match"),
    [
        (
            lambda: cp.compare(explosive(), PLAN, T),
            TypeError,
            "mapping of names to trajectories, or waypoints, got Trig",
        ),
        (lambda: cp.compare(explosive(), [PLAN], T), TypeError, "or waypoints, got TrigSpline"),
        (lambda: cp.sweep(explosive(), [1.0, 2.0], {"p": PLAN}, T), TypeError, "build must be a function"),
        (lambda: cp.sweep(explosive, plans={"p": PLAN}, timepts=T), TypeError, "'values'; for draws use monte_carlo"),
        (
            lambda: cp.sweep(explosive(), [1.0], {"p": PLAN}, T, params={"g": 1.0}),
            TypeError,
            "build must be a function",
        ),
    ],
)
def test_calls_that_cannot_be_meant(call, kind, match):
    with pytest.raises(kind, match=match):
        call()


@pytest.mark.slow
def test_all_runs_without_the_extra_fast():
    """In a process of its own, where CasADi cannot be imported at all."""
    program = """
import sys
sys.modules["casadi"] = None
import numpy as np, ctrlplan as cp
from ctrlplan.studies.crane import CRANE, obstacle_waypoints
plan = cp.TrigSpline(obstacle_waypoints(), alpha=4.0)
found = cp.simulate(cp.plants.crane_loop(CRANE, plan), np.linspace(0.0, 4.0, 9))
assert found.method == "python" and "pip install ctrlplan[fast]" in found.reason, found.reason
plans = {"trigonometric": plan}
spread = cp.monte_carlo(lambda n, p: cp.plants.crane_loop(CRANE, p), {"load_mass": [400.0, 600.0]},
                        plans, np.linspace(0.0, 2.0, 41), progress=False)
assert not spread.failures
"""
    subprocess.run([sys.executable, *WARNINGS, "-c", program], check=True, timeout=120)
