"""Plans that repeat for all future times, in every export that takes a plan.

Each of them uses one period, or as many as its times require, or raises an error that an end is required.
"""

import inspect
import json
import math
import warnings
from importlib import import_module

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.planning import plan_excess_length, plan_length
from ctrlplan.reports import plot_trajectory
from ctrlplan.simulation import equilibrium_at
from ctrlplan.trajectories import Joined, Repeated, Stacked, Sum

POINTS = [(0.4, 2.0), (0.7, 10.0), (1.2, 10.0), (1.5, 5.0), (1.8, 1.0)]
PERIOD = cp.PiecewiseSpline.cyclic([cp.Waypoint(0, 0, 0, 0), *(cp.Waypoint(t, y) for t, y in POINTS)], 2.0)
ENDLESS, LONG = PERIOD.repeat(None), PERIOD.repeat(20)
MOVE = cp.PolySpline([cp.Waypoint(-1, -3, 0, 0), cp.Waypoint(0, 0, 0, 0)])
TIMES = np.linspace(0.0, 9.0, 181)
LAG = ct.tf([4.0], [1.0, 4.0], inputs="y", outputs="v", name="lag")
LOOP = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
MOTOR = cp.flat_system(cp.plants.dc_motor(), "angle")
FITTED = cp.fit_feedforward(
    cp.read_log({"time": TIMES, "u": 2.0 * PERIOD.repeat(5).jet(TIMES, 1)[1, 0], "y": PERIOD.repeat(5)(TIMES)}),
    PERIOD.repeat(5),
)
NEEDS_END = "must have an end, got a plan that repeats for all future times"


def loop(plan):
    """A saturated loop with the plan as a block."""
    source = cp.create_source_iosystem(plan, labels="r")
    plant = ct.nlsys(lambda t, x, u, p: [5.0 * np.tanh(u[0] - x[0])], None, inputs="r", outputs="y", states=["y"])
    return ct.interconnect([source, plant], inputs=0, outputs=["y", "r"])


def simulated(plan, **options):
    return cp.simulate(loop(plan), TIMES, **options).outputs


def compared(plan):
    found = cp.compare(LOOP, {"cam": plan, "step": cp.Step(1.0)}, TIMES)
    return {k: v for k, v in found.metrics["cam"].items() if np.isfinite(v)}


def stepped(plan):
    """A numerical loop, step by step, beyond the first period."""
    stepper = cp.prepare(loop(plan)).start(0.05)
    return [stepper.step([]) for _ in range(60)]


def swept(plan):
    return cp.sweep(cp.plants.integrator_lag_loop, [2.0, 5.0], {"cam": plan}, TIMES, progress=False).values


def drawn(plan):
    draws = cp.draws(3, gain=(2.0, 5.0))
    found = cp.monte_carlo(cp.plants.integrator_lag_loop, draws, {"cam": plan}, TIMES, progress=False)
    return numbers_in(json.loads(json.dumps(found.results(), allow_nan=False)))


def numbers_in(data):
    """All numbers of nested lists and dicts."""
    if isinstance(data, dict | list):
        return [x for entry in (data.values() if isinstance(data, dict) else data) for x in numbers_in(entry)]
    return [data] if isinstance(data, float) else []


def slowed(plan):
    """The plan is slowed where the error exceeds 1, that is, most of the time."""
    block = cp.create_time_scaling_iosystem(plan, errors={"y": (1.0, 2.0)}, bandwidth=5.0, suffix="_ref")
    return cp.simulate(block, TIMES, 5.0 * np.ones(TIMES.size)).outputs


def driven(plan):
    """A flat motor that follows the cam, with an error of its initial state."""
    loop = cp.flat_loop(MOTOR, plan, poles=[[-20.0, -30.0, -40.0]], initial_state=[0.1, 0.0, 0.0][: MOTOR.nstates])
    return cp.simulate(loop, TIMES).outputs


def pointed(plan):
    """The load of a crane swings for all future times, at constant height."""
    swing = cp.TrigSpline.cyclic([cp.Waypoint(0.0, 0.0), cp.Waypoint(2.0, 1.0)], 4.0).repeat(plan.count)
    both = cp.stack([swing, cp.Step(10.0, 10.0)], labels=["x", "z"])
    flat = cp.plants.Crane().flat_system()
    return flat.states_and_inputs(both, TIMES)[0]


def crane_driven(plan):
    """A crane with a load of constant height."""
    swing = cp.TrigSpline.cyclic([cp.Waypoint(0.0, 0.0), cp.Waypoint(4.0, 1.0)], 8.0).repeat(plan.count)
    both = cp.stack([swing, cp.Step(10.0, 10.0)], labels=["x", "z"])
    return cp.simulate(cp.plants.crane_loop(cp.plants.Crane(), both), TIMES).outputs[:2]


def drawn_lines(plan):
    """Values of the lines of a figure within the first period."""
    lines = [line.get_data() for axes in plan.plot(2).figure.axes for line in axes.lines]
    return np.concatenate([np.asarray(y)[np.asarray(x) < PERIOD.end] for x, y in lines])


def windows(plan):
    return cp.reference_window(plan, 7.3, 0.1, 20)


def logged(plan):
    t = np.linspace(0.0, 6.0, 601)
    jet = plan.jet(t, 2)[:, 0]
    return cp.fit_feedforward(cp.read_log({"time": t, "u": 2 * jet[1] + jet[2], "y": jet[0]}), plan).gains


SAME = {
    "as_trajectory": lambda plan: cp.as_trajectory(plan, 1.0, 7.0)(TIMES),
    "Clipped": lambda plan: cp.Clipped(plan, 1.0, 7.3).jet(TIMES, 2),
    "clearance": lambda plan: cp.clearance(cp.stack([plan, 0.5 * plan]), [cp.Disc((3.0, 9.0), 1.0)]).minimum,
    "create_source_iosystem": simulated,
    "simulate, python": lambda plan: simulated(plan, method="python"),
    "simulate, exact": lambda plan: cp.simulate(LAG, TIMES, plan, method="exact").outputs,
    "simulate, discrete": lambda plan: cp.simulate(ct.ss(0.5, 1, 1, 0, 0.05), TIMES, plan).outputs,
    "prepare": stepped,
    "compare": compared,
    "Experiment": lambda plan: cp.Experiment({"cam": plan}, TIMES, measures=["iae"]).run(LOOP).metrics["cam"],
    "sweep": swept,
    "monte_carlo": drawn,
    "create_time_scaling_iosystem": slowed,
    "reference_window": windows,
    "source_samples": lambda plan: cp.source_samples(plan, TIMES, 2),
    "stack": lambda plan: cp.stack([plan, MOVE], labels=["a", "b"]).jet(TIMES, 3),
    "fit_feedforward": logged,
    "flat_loop": driven,
    "create_flat_feedforward_iosystem": lambda plan: cp.simulate(
        cp.create_flat_feedforward_iosystem(MOTOR, plan=plan), TIMES
    ).outputs,
    "states_and_inputs": pointed,
    "states_and_inputs, motor": lambda plan: MOTOR.states_and_inputs(plan, TIMES)[1],
    "then": lambda plan: MOVE.then(plan).jet(TIMES, 3),
    "crane_loop": crane_driven,
    "check_limits": lambda plan: MOTOR.check_limits(plan, {"voltage"}) is None,
    "equilibrium_at": lambda plan: equilibrium_at(loop(plan), plan, 5.3, [0])[0],
    "create_iosystem": lambda plan: cp.simulate(FITTED.create_iosystem(plan), TIMES).outputs,
    "+": lambda plan: (plan + MOVE - 0.5 * plan.shift(0.3)).jet(TIMES, 3),
    "select": lambda plan: cp.stack([plan, MOVE], labels=["a", "b"]).select("a").jet(TIMES, 3),
    "shaped": lambda plan: cp.Shaper.zv(10.0)(plan).jet(TIMES, 3),
    "shift": lambda plan: plan.shift(-2.3).jet(TIMES, 3),
    "stop": lambda plan: plan.stop(5.3, {"acceleration": 90.0, "jerk": 900.0}).jet(TIMES, 2),
    "to_velocity": lambda plan: plan.to_velocity(5.3, 1.0, {"acceleration": 90.0, "jerk": 900.0}).jet(TIMES, 2),
    "on_cycle": lambda plan: plan.on_cycle(0.03).jet(TIMES, 2),
    "extrema": lambda plan: [plan.peak(nu) for nu in range(4)],
    "extrema_of": lambda plan: plan.extrema_of(lambda jet: jet[1] * jet[2], 2).maximum,
    "bounds": lambda plan: plan.bounds(lambda jet: jet[0, 0], 0, 1.0).upper,
}  # fmt: skip
"""What must give the same as many repetitions."""

ONE_PERIOD = {
    "plan_length": plan_length,
    "plan_excess_length": plan_excess_length,
    "PeakDerivative": cp.PeakDerivative(2),
    "SquaredDerivative": cp.SquaredDerivative(3),
    "plot": drawn_lines,
    "plot_trajectory": lambda plan: [axes.get_xlim() for axes in plot_trajectory(plan).figure.axes],
    "waypoints": lambda plan: [w.time for w in plan.waypoints],
    "breakpoints": lambda plan: plan.breakpoints,
}
"""What is that of one period."""

REJECTED = {
    "avoid": lambda plan: cp.avoid(cp.stack([plan, 0.5 * plan]), [cp.Disc((2.0, 0.0), 0.5)]),
    "fastest": lambda plan: cp.fastest(plan, {"velocity": 1.0}),
    "margins": lambda plan: cp.margins(plan, {"velocity": 1.0}),
    "margins of a loop": lambda plan: cp.margins(plan, {"u": 1.0}, LOOP),
    "loop_quantities": lambda plan: cp.loop_quantities(LOOP).quantities_of(plan),
    "residual_spectrum": lambda plan: cp.residual_spectrum(plan, [1.0]),
    "residual_plot": lambda plan: cp.residual_plot(plan, [1.0]),
    "Retimed": lambda plan: cp.Retimed(plan, cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 2)])),
    "Retimed, law": lambda plan: cp.Retimed(PERIOD, plan),
    "PathPlan": lambda plan: cp.PathPlan([cp.PolySpline([cp.Waypoint(0, [0, 0]), cp.Waypoint(1, [1, 0])])], [1], plan),
    "create_replanner_iosystem": lambda plan: cp.create_replanner_iosystem(plan, 0.1),
    "create_feedforward_iosystem": lambda plan: cp.create_feedforward_iosystem(LAG, plan=plan),
    "flat_loop, TVLQR": lambda plan: cp.flat_loop(MOTOR, plan, law=cp.TVLQR(np.eye(2), [[1.0]])),
    "then": lambda plan: plan.then(MOVE),
    "retime": lambda plan: plan.retime(3.0),
    "repeat": lambda plan: plan.repeat(2),
    "final": lambda plan: plan.final,
    "Repeated": lambda plan: Repeated(plan, 2),
    "Joined": lambda plan: Joined((plan, MOVE)),
    "Stacked": lambda plan: Stacked((plan, MOVE)),
    "Sum": lambda plan: Sum((plan, MOVE)),
    "export .c": lambda plan: plan.export("move.c"),
}

FOLDERS = ("flatness", "planning", "reports", "simulation", "studies", "systems", "systems.plants", "trajectories")

TAKES_NO_TRAJECTORY = {
    "AlphaChoice", "Avoidance", "BlockTraits", "Clearance", "Comparison", "Fastest", "Optimum",  # results
    "Failure", "MeasuredRun", "MetricsTable", "Path", "Run", "Tracked",  # entries of results
    "PiecewiseSpline", "PolySpline", "TrigSpline", "choose_alpha", "explore", "optimize_waypoints",  # waypoints
    "PlanSource",  # made by create_source_iosystem
}  # fmt: skip


def test_every_export_that_takes_a_plan_is_here():
    names = {"plan", "plans", "reference", "trajectory", "law", "parts"}
    folders = [import_module(f"ctrlplan.{name}") for name in FOLDERS]
    found = set()
    for module, export in [(folder, name) for folder in (cp, *folders) for name in folder.__all__]:
        thing = getattr(module, export)
        if callable(thing) and not (inspect.isclass(thing) and issubclass(thing, Exception)):
            found |= {export} if names & set(inspect.signature(thing).parameters) else set()
    tested = {name.partition(",")[0] for name in (*SAME, *ONE_PERIOD, *REJECTED)}
    assert found - TAKES_NO_TRAJECTORY <= tested


@pytest.mark.parametrize("name", ONE_PERIOD)
def test_it_is_that_of_one_period(name):
    # Times of a later period are rounded.
    np.testing.assert_allclose(ONE_PERIOD[name](ENDLESS), ONE_PERIOD[name](PERIOD), rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("name", SAME)
def test_it_is_as_many_repetitions(name):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the plan swings")
        found, wanted = SAME[name](ENDLESS), SAME[name](LONG)
    if isinstance(wanted, dict):
        assert found.keys() == wanted.keys()
        found, wanted = list(found.values()), list(wanted.values())
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert np.isfinite(wanted).any()
    # The rate of a time scaling has kinks at times that are not declared.
    rtol = 1e-4 if name == "create_time_scaling_iosystem" else 1e-7
    np.testing.assert_allclose(found, wanted, rtol=rtol, atol=0.01 * rtol * np.nanmax(np.abs(wanted)))


@pytest.mark.parametrize("name", REJECTED)
def test_an_end_is_required(name):
    with pytest.raises(ValueError, match=NEEDS_END):
        REJECTED[name](ENDLESS)


def test_passes_are_for_finite_times():
    with pytest.raises(ValueError, match="time must be finite, got inf"):
        ENDLESS.covering(math.inf)


def test_a_file_and_equality(tmp_path):
    ENDLESS.save(tmp_path / "cam.json")
    text = (tmp_path / "cam.json").read_text()
    assert json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))["type"] == "Repeated"
    assert cp.load_trajectory(tmp_path / "cam.json") == ENDLESS != LONG


def test_steps_are_shorter_than_segments_whose_times_are_not_declared():
    """A block that is a function of a cam with a long dwell: so that no later period is stepped over."""
    bump = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(0.15, 1, 0, 0, 0), cp.Waypoint(0.3, 0, 0, 0, 0)])
    cam = bump.then(cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(5, 0)]))
    parts = [
        cp.create_flat_feedforward_iosystem(MOTOR, plan=plan, states=False)
        for plan in (cam.repeat(None), cam.repeat(3))
    ]
    assert [cp.traits_of(part).longest for part in parts] == [pytest.approx(0.15), math.inf]
