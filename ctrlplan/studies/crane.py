"""The paper's section 5: three simulations of the crane."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan import metrics
from ctrlplan.planning import Fastest, avoid, plan_length
from ctrlplan.planning.objectives import plan_lengths
from ctrlplan.simulation import simulate
from ctrlplan.simulation.built_forms import shared_forms
from ctrlplan.simulation.simulate import simulate_for_metrics
from ctrlplan.studies.choosing import (
    LOAD_RADIUS,
    MARGIN,
    WALLS,
    clearance_note,
    fastest_notes,
    nominal_benefit,
    nominal_fastest,
    optimality_claim,
    optimality_grids,
)
from ctrlplan.studies.comparison import Comparison, compare
from ctrlplan.studies.crane_setup import (
    CRANE,
    CRANE_MEASURES,
    FORCE_LIMITS,
    LOAD,
    SLACK,
    TORQUE_LIMITS,
    UNITS,
    WALL,
    DriveLimits,
    LoopsOfPlans,
    first_order_waypoints,
    marked_slack,
    nominal_waypoints,
    obstacle_waypoints,
)
from ctrlplan.studies.measures import Measure, Run, signals_of
from ctrlplan.studies.sections import (
    AnimatedCrane,
    ClaimTable,
    CraneMotion,
    CranePaths,
    CraneSketch,
    CraneStep,
    CraneTime,
    Curves,
    FastestMove,
    LoopBlocks,
    Section,
)
from ctrlplan.studies.study import Study
from ctrlplan.studies.units import scientific
from ctrlplan.systems.plants import LAWS, crane_loop
from ctrlplan.systems.plants.crane.laws import Law, LawName, as_law
from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Step, Trajectory, TrigSpline, Waypoint

Array = NDArray[np.float64]


class _Loop(DriveLimits, total=False):
    """Law of a `crane_loop`, and limits of its drives."""

    law: LawName


@shared_forms()
def crane_nominal_study(progress: bool = True) -> Study:
    """Simulation 1 (figure 4): a point-to-point move."""
    points = nominal_waypoints()
    smooth = PolySpline(nominal_waypoints(5))
    plans: dict[str, tuple[Trajectory, _Loop]] = {
        "step": (_step(points), _STEP),
        "polynomial": (PolySpline(points), {}),
        "trigonometric": (TrigSpline(points, alpha=1.0), {}),
        "piecewise": (PiecewiseSpline(points), {}),
        "polynomial, load feedback": (PolySpline(points), {"law": "load_feedback"}),
        "C4 polynomial, dynamic law": (smooth, {"law": "dynamic"}),
        "C4 polynomial, feedforward": (smooth, {"law": "feedforward"}),
    }
    found = _compared(plans, points, 30.0, "Crane, nominal case (simulation 1)")
    poly, trig = found.metrics["polynomial"], found.metrics["trigonometric"]
    found = found.with_benefit(nominal_benefit())
    limited = nominal_fastest()
    whole = found.metrics["C4 polynomial, dynamic law"]
    grows, damped = _slowest(_linear_loop("generator")), _slowest(_linear_loop("load_feedback"))
    return Study(
        "crane-nominal",
        "Crane: nominal case (simulation 1, figure 4)",
        found,
        summary=(
            "The load moves 20 m horizontally and 1 m down in 15 s, from rest to rest. Equations (15a,b) map the "
            "plan of the load to references of the trolley position and the rope length, which two PID controllers "
            "follow. In the step run, both references jump to their final values."
        ),
        notes=(
            *found.notes,
            f"The paper states that both splines give equivalent results for this move. This is confirmed: the peak "
            f"tracking error during the move is {1e3 * poly['error_travel']:.3g} mm with the polynomial and "
            f"{1e3 * trig['error_travel']:.3g} mm with the trigonometric plan.",
            _step_note(found),
            _limits_note(found),
            "The controller of figure 3 has no feedback of the load position. Linearised at R = 10 m, its slowest "
            f"pole pair is at {grows.real:+.5f} ± {abs(grows.imag):.3f}j 1/s: with the PID controllers of this study "
            "the sway is not damped but grows slowly, because of the integral action. Feedback of the load position "
            f"x moves the slowest pole to {damped.real:.2f} 1/s, and the sway is damped. The figure shows both cases.",
            "The complete control law (9)-(11), with dynamic extension, follows a plan with ten constraints per axis "
            f"with a peak tracking error of {scientific(whole['error_travel'], 1)} m on the nominal model. Its "
            "feedforward part alone does the same, but cannot correct deviations from the nominal model.",
            *fastest_notes(limited),
        ),
        sections=_nominal_sections(points, limited),
    )


def _nominal_sections(points: tuple[Waypoint, Waypoint], limited: Fastest) -> tuple[Section, ...]:
    """Sections of the first simulation: figures 2 to 4 of the paper, the sway, and the fastest move."""
    return (
        CraneSketch(caption="The crane and its variables (figure 2), z down."),
        LoopBlocks(
            crane_loop(CRANE, PolySpline(points)),
            {"plan": "path generator", "generator": "flat map (15a,b)", "trolley_pid": "PID", "hoist_pid": "PID"},
            caption="Structure of the controller (figure 3), drawn from the blocks and connections of the model.",
        ),
        *_linear_loops(),
        CraneTime(),
        CraneStep(
            caption="Step run: force and torque with their limits (dashed), up to the time at which the rope becomes "
            "slack. The model is not valid for a slack rope, and the run ends there."
        ),
        CraneMotion(),
        _sway_curves(),
        AnimatedCrane(),
        FastestMove(limited),
    )


@shared_forms()
def crane_first_order_study(progress: bool = True) -> Study:
    """Simulation 2 (figure 5): only first-order data."""
    points = first_order_waypoints()
    plans: dict[str, tuple[Trajectory, _Loop]] = {
        "step": (_step(points), _STEP),
        "polynomial": (PolySpline(points), {}),
        "trigonometric": (TrigSpline(points, alpha=np.pi / 3, gamma=np.pi / 2), {}),
        "piecewise": (PiecewiseSpline(points), {}),
        "trigonometric, alpha pi": (TrigSpline(points, alpha=np.pi), {}),
    }
    found = _compared(plans, points, 60.0, "Crane, first-order data (simulation 2)")
    rows = found.metrics
    return Study(
        "crane-first-order",
        "Crane: first-order data (simulation 2, figure 5)",
        found,
        summary=(
            "Only the initial and the final position are prescribed, 30 s apart. The polynomial has constant velocity, "
            "which is not zero at the start and at the end. The trigonometric spline of the paper is "
            "12 + 2 sin(tau − pi/2) in z."
        ),
        notes=(
            *found.notes,
            "The result of the paper is confirmed: the peak tracking error during the move is "
            f"{rows['polynomial']['error_travel']:.3g} m with the polynomial and "
            f"{1e3 * rows['trigonometric']['error_travel']:.2g} mm with the trigonometric plan.",
            "The reason is the velocity at the start, not, as the paper says, the nonzero derivatives of the spline. "
            "With gamma = pi/2 the spline starts at rest, and the polynomial does not. With the same alpha and the "
            "mean gamma of definition 1, the spline has a nonzero initial velocity as well.",
            f"The residual oscillation that the paper reports ({rows['trigonometric']['error_after']:.3g} m here) is "
            "caused by the velocity of the plan at its end, which depends on alpha and gamma (figure). At alpha = pi "
            "the plan is at rest at both ends, and the residual error is "
            f"{1e3 * rows['trigonometric, alpha pi']['error_after']:.2g} mm.",
            _step_note(found),
            _limits_note(found),
        ),
        sections=(CraneTime(), _speed_curves(points), CraneMotion(), AnimatedCrane()),
    )


@shared_forms()
def crane_obstacle_study(progress: bool = True) -> Study:
    """Simulation 3 (figure 6): over a wall through two via points."""
    points = obstacle_waypoints()
    plans: dict[str, tuple[Trajectory, _Loop]] = {
        "step": (_step(points), _STEP),
        "polynomial": (PolySpline(points), {}),
        "trigonometric": (TrigSpline(points, alpha=4.0), {}),
        "piecewise": (PiecewiseSpline(points), {}),
        "optimized via points": (_avoiding(PolySpline([points[0], points[-1]])), {}),
    }
    found = _compared(plans, points, 30.0, "Crane, obstacle (simulation 3)")
    rows = found.metrics
    polyline = float(np.sum(np.hypot(*np.diff(np.array([w.position for w in points]).T, axis=1))))
    lengths = {name: rows[name]["path_length"] for name in ("polynomial", "trigonometric", "piecewise")}
    grids = optimality_grids()
    return Study(
        "crane-obstacle",
        "Crane: obstacle (simulation 3, figure 6)",
        found,
        summary=(
            "The load passes over a wall through two waypoints, A at 6 s and B at 11 s, with given velocity and "
            "acceleration. In the second approach of the paper, one spline satisfies all twelve constraints per axis; "
            "in the first, one quintic polynomial per segment does."
        ),
        notes=(
            *found.notes,
            "The claim of the paper that the trigonometric path is shorter is confirmed for alpha = 4 and a duration "
            f"of 16 s: the path length is {lengths['polynomial']:.2f} m with the polynomial and "
            f"{lengths['trigonometric']:.2f} m with the trigonometric plan. The polyline through the waypoints has a "
            f"length of {polyline:.1f} m.",
            "The claim is not true in general. For alpha above 5 the trigonometric path can be much longer than that "
            "of the polynomial, and for a duration of 20 s both are much longer than the polyline. The figure shows "
            "where the claim is true.",
            f"The path of the first approach, one quintic polynomial per segment, has a length of "
            f"{lengths['piecewise']:.2f} m and {_piecewise_lengths()} Its jerk is discontinuous at A and B; the peak "
            f"tracking error is {1e3 * rows['piecewise']['error_travel']:.2g} mm.",
            f"The paper prescribes A and B. If they are optimized instead, for a load of {LOAD_RADIUS:g} m radius, its "
            f"rope, and a clearance of {MARGIN:g} m, the via points are "
            f"{_via_points(found.plans['optimized via points'])}, and the path length is "
            f"{rows['optimized via points']['path_length']:.2f} m. {clearance_note(found.plans)}",
            _step_note(found),
            _limits_note(found),
        ),
        sections=(
            CranePaths(WALL),
            CraneTime(),
            _length_curves(),
            CraneMotion(WALL),
            AnimatedCrane(WALL),
            ClaimTable(optimality_claim(grids), grids),
        ),
    )


def _via_points(plan: Trajectory) -> str:
    """Positions and times of the inner waypoints of a plan."""
    return ", ".join(f"({w.position[0]:.3g}, {w.position[1]:.3g}) m at {w.time:.3g} s" for w in plan.waypoints[1:-1])


_STEP: _Loop = {"law": "setpoint", "force_limits": FORCE_LIMITS, "torque_limits": TORQUE_LIMITS}


def _avoiding(plan: Trajectory) -> Trajectory:
    """Plan through via points with a clearance between the wall and load and rope."""
    return avoid(plan, WALLS, clearance=MARGIN, load=LOAD_RADIUS, rope=CRANE.rope()).plan


def _step(points: tuple[Waypoint, ...]) -> Step:
    return Step(points[-1].position, points[0].position, points[0].time, labels=points[0].labels)


def _compared(
    plans: Mapping[str, tuple[Trajectory, _Loop]], points: tuple[Waypoint, ...], t_end: float, title: str
) -> Comparison:
    timepts = np.union1d(np.linspace(0.0, t_end, int(100 * t_end) + 1), [w.time for w in points])

    loops = LoopsOfPlans()

    def build(name: str, plan: Trajectory) -> ct.InterconnectedSystem:
        options = plans[name][1]  # a piecewise spline with two waypoints is the polynomial
        return loops.loop(plan, options, lambda: crane_loop(CRANE, plan, **options))

    laws = {id(plan): options for plan, options in plans.values()}
    limited_errors: dict[int, float] = {}

    def limited(run: Run) -> dict[str, float]:
        options, loop = laws[id(run.plan)], id(run.system)
        if loop not in limited_errors:
            own = as_law(options.get("law", "generator")).outputs != Law.outputs  # the law commands force and torque
            limited_errors[loop] = np.nan if own else _limited_error(run, options, timepts)
        return {"error_limited": limited_errors[loop]}

    found = compare(
        build,
        {name: plan for name, (plan, _) in plans.items()},
        timepts,
        controls=("F", "C"),
        events=(SLACK,),
        waypoints=points,
        measures=CRANE_MEASURES | {"load": LOAD, "limited": Measure("Limited drives", of="run", function=limited)},
        units=UNITS,
        title=title,
        parameters=_parameters(t_end),
    )
    return marked_slack(found)


def _limited_error(run: Run, options: _Loop, timepts: Array) -> float:
    """Peak tracking error with the force and torque limits of the step run; nan if the rope becomes slack."""
    response = run.response
    if "force_limits" not in options and _reaches_limits(run):
        loop = crane_loop(CRANE, run.plan, **options | {"force_limits": FORCE_LIMITS, "torque_limits": TORQUE_LIMITS})
        response = simulate_for_metrics(loop, timepts, events=(SLACK,))[0]
    if response.time[-1] < timepts[-1]:
        return np.nan
    signals = signals_of(response)
    return float(np.hypot(*(np.stack([signals["x"], signals["z"]]) - run.plan.jet(timepts, 0)[0])).max())


def _reaches_limits(run: Run) -> bool:
    """Whether force or torque of an unlimited run come close to the limits, also between samples."""
    middles = ((name, 0.5 * (low + high), 0.5 * (high - low)) for name, (low, high) in _LIMITS.items())
    return any(metrics.peak(run.t, run.signals[name] - middle) > 0.99 * half for name, middle, half in middles)


_LIMITS = {"F": FORCE_LIMITS, "C": TORQUE_LIMITS}


def _limits_note(found: Comparison) -> str:
    """Peak forces of the plans, and their tracking errors with the limits of the step run."""
    names = ("polynomial", "trigonometric", "piecewise")
    times = {name: _time_of_peak(found, name) for name in names}
    peaks = ", ".join(
        f"{name} {1e-3 * found.metrics[name]['force_peak']:.3g} kN at {times[name]:.3g} s" for name in names
    )
    limited = {name: found.metrics[name]["error_limited"] for name in names}
    errors = ", ".join(
        f"{name} {'not defined (slack rope)' if np.isnan(error) else f'{error:.2g} m'}"
        for name, error in limited.items()
    )
    return (
        f"Only the step run has limited drives. The peak trolley forces of the plans are: {peaks}. "
        f"{_discontinuities(found, times)}With the limits of the step run (30 kN) the peak tracking errors are: "
        f"{errors}."
    )


def _time_of_peak(found: Comparison, name: str) -> float:
    """Time of the peak trolley force [s]."""
    response = found.responses[name]
    return float(response.time[np.abs(signals_of(response)["F"]).argmax()])


_AFTER = 0.5
"""Time after a discontinuity of a plan within which a peak is attributed to it [s]."""


def _discontinuities(found: Comparison, times: Mapping[str, float]) -> str:
    """Which discontinuities of the plans the peaks at these times follow, in a sentence; empty for none."""
    said: dict[str, list[str]] = {}
    for name, time in times.items():
        before = [jump for jump in found.plans[name].jumps(3) if 0.0 <= time - jump.time <= _AFTER]
        if before:
            jump = min(before, key=lambda one: one.order)
            derivative = ("position", "velocity", "acceleration", "jerk")[jump.order]
            said.setdefault(f"of the {derivative} at {jump.time:.3g} s", []).append(name)
    listed = "; ".join(f"{what} ({', '.join(names)})" for what, names in said.items())
    return f"They follow a discontinuity of the plan: {listed}. " if said else ""


def _parameters(t_end: float) -> dict[str, object]:
    crane = CRANE
    return {
        "load": f"m = {crane.load_mass:g} kg",
        "trolley": f"M_c = {crane.trolley_mass:g} kg, f1 = {crane.trolley_friction:g} N s/m",
        "drum": f"J = {crane.drum_inertia:g} kg m², b = {crane.drum_radius:g} m, f2 = {crane.drum_friction:g} N m s",
        "gravity": f"{crane.gravity:g} m/s²",
        "PID controllers": "gains for a triple pole at −5 rad/s; with a derivative filter of 0.02 s the closed-loop "
        f"poles are {_poles(crane.linear_trolley_loop())} (trolley) and {_poles(crane.linear_hoist_loop())} rad/s "
        "(hoist)",
        "limits in the step run": "|F| ≤ 30 kN, C from −3 to 1 kN m, with anti-windup",
        "initial state": "at rest at the initial position",
        "simulated time": f"{t_end:g} s",
    }


def _poles(loop: ct.StateSpace) -> str:
    """Poles of a loop, each complex pair once."""
    poles = sorted((pole for pole in np.asarray(loop.poles()) if pole.imag >= 0.0), key=lambda pole: -pole.real)
    return ", ".join(f"{p.real:.3g}" + (f" ± {p.imag:.3g}j" if p.imag else "") for p in poles).replace("-", "−")


def _step_note(found: Comparison) -> str:
    step = found.metrics["step"]
    response = found.responses["step"]
    force = np.asarray(response.outputs)[list(response.output_labels).index("F")]
    limited = float(metrics.saturation_time(np.asarray(response.time), force, *FORCE_LIMITS))
    slack = found.stopped.get("step")
    end = (
        f"The residual sway is {step['sway_after']:.2g} rad."
        if slack is None
        else f"The rope becomes slack at {slack:.3g} s. The model is not valid for a slack rope, so the run ends there "
        "and the metrics of the step are not ranked."
    )
    return f"The step saturates the trolley drive for {limited:.2g} s, as the introduction of the paper says. {end}"


def _linear_loop(law: str) -> ct.StateSpace:
    """Closed loop linearised at the equilibrium with R = 10 m, with the sway as output."""
    start = Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    loop = crane_loop(CRANE, start, LAWS[law])
    linear = ct.linearize(loop, loop.initial_state, 0)
    row = loop.output_labels.index("theta")
    a = np.asarray(linear.A)
    return ct.ss(a, np.zeros((len(a), 1)), np.asarray(linear.C)[[row]], [[0.0]], outputs=["theta"], inputs=["none"])


def linear_pendulum_loop(rope_length: float) -> ct.InterconnectedSystem:
    """Trolley and pendulum at a rope length [m] with the PID of the trolley, linear, in named blocks."""
    plant = CRANE.linear_coupled(rope_length)
    blocks = [CRANE.trolley_pid(), *plant.syslist]
    return ct.interconnect(blocks, inputs=["D_ref"], outputs=["D", "theta"], name="trolley_and_pendulum")


def _linear_loops() -> tuple[LoopBlocks, LoopBlocks]:
    """The two linearised loops of the crane: trolley with pendulum, and hoist."""
    across, up = linear_pendulum_loop(_LENGTH), CRANE.linear_hoist_loop()
    return (
        LoopBlocks(
            across,
            {"trolley_pid": "PID", "trolley": "trolley", "pendulum": "pendulum"},
            caption=f"Trolley loop linearised at R = {_LENGTH:g} m, with the pendulum (reference D_ref). Closed-loop "
            f"poles: {_poles(across)} 1/s. The pair with the smallest magnitude is the sway, which the PID does not "
            "damp.",
        ),
        LoopBlocks(
            up,
            {"hoist_pid": "PID", "hoist": "hoist with load"},
            caption=f"Hoist loop linearised at equilibrium (reference R_ref). Closed-loop poles: {_poles(up)} 1/s.",
        ),
    )


_LENGTH = 10.0
"""Rope length of the linearised trolley loop [m]."""


def _slowest(system: ct.StateSpace) -> complex:
    """Pole with the largest real part, without the poles at 0."""
    poles = np.asarray(system.poles())
    nonzero = poles[np.abs(poles) > 1e-6]
    return complex(nonzero[nonzero.real.argmax()])


def _sway_curves() -> Curves:
    """Sway of the linearised loops from 0.05 rad, for the controller of figure 3 and with load feedback."""
    t = np.linspace(0.0, 600.0, 6001)
    rows = {}
    for law, label in (("generator", "controller of figure 3"), ("load_feedback", "with load feedback")):
        system = _linear_loop(law)
        state = np.zeros(system.nstates)
        state[system.nstates - 6 + 2] = 0.05
        rows[label] = np.asarray(simulate(system, t, initial_state=state).outputs).reshape(-1)
    caption = "Response of the sway to an initial value of 0.05 rad; loops linearised at R = 10 m."
    return Curves("time [s]", "sway [rad]", t, rows, key="crane-sway", caption=caption)


def _speed_curves(points: tuple[Waypoint, Waypoint]) -> Curves:
    """Speed of the plan at start and end versus alpha, for the paper's gamma and for the mean gamma."""
    alphas = np.linspace(0.05, 5.5, 220)
    rows: dict[str, list[float]] = {"start, gamma pi/2": [], "end, gamma pi/2": [], "both ends, gamma mean": []}
    for alpha in alphas.tolist():
        fixed = (
            TrigSpline(points, alpha=alpha, gamma=np.pi / 2, warn=False)
            if abs(np.cos(0.5 * alpha - np.pi / 2)) > 1e-3
            else None
        )
        for name, end in (("start, gamma pi/2", 0.0), ("end, gamma pi/2", 30.0)):
            rows[name].append(np.nan if fixed is None else float(np.hypot(*fixed.jet(end, 1)[1])))
        mean = TrigSpline(points, alpha=alpha, warn=False)
        rows["both ends, gamma mean"].append(float(np.hypot(*mean.jet(30.0, 1)[1])))
    return Curves(
        "alpha [rad]",
        "speed of the plan [m/s]",
        alphas,
        {name: np.array(row) for name, row in rows.items()},
        key="crane-curves",
        caption="Speed of the plan at its start and end versus alpha. A nonzero speed excites the sway.",
    )


def _piecewise_lengths() -> str:
    """Where one quintic per segment gives the shorter path, in words."""
    rows = _length_curves().rows
    pairs = [
        (rows[name], rows[name.replace("one plan", "one quintic per segment")]) for name in rows if "one plan" in name
    ]
    if all(np.all(segments <= whole) for whole, segments in pairs):
        return "is the shortest for all values of alpha and all end times in the figure."
    share = np.mean([np.mean(segments <= whole) for whole, segments in pairs])
    return f"is the shorter one for {100 * share:.0f} % of the values of alpha and end times in the figure."


@cache
def _length_curves() -> Curves:
    """Path length versus alpha for several durations, of one plan and of one quintic per segment."""
    alphas = np.linspace(0.0, 5.6, 113)
    rows = {}
    for duration in (14.0, 16.0, 20.0):
        points = obstacle_waypoints(duration)
        plans = [TrigSpline(points, alpha=a, warn=False) for a in alphas.tolist()]
        rows[f"one plan, {duration:g} s"] = plan_lengths(plans)
        rows[f"one quintic per segment, {duration:g} s"] = np.full(alphas.size, plan_length(PiecewiseSpline(points)))
    return Curves(
        "alpha [rad] (0: polynomial)",
        "path length [m]",
        alphas,
        rows,
        log=True,
        paired=True,
        key="crane-curves",
        caption="Path length versus alpha for three end times. A and B are passed at 6 s and 11 s.",
    )
