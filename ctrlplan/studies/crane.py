"""The paper's section 5: three simulations of the crane."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan import metrics
from ctrlplan.planning import Fastest, avoid
from ctrlplan.simulation import simulate
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
from ctrlplan.systems.plants import LAWS, crane_loop
from ctrlplan.systems.plants.crane.laws import Law, LawName, as_law
from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Step, Trajectory, TrigSpline, Waypoint

Array = NDArray[np.float64]


class _Loop(DriveLimits, total=False):
    """Law of a `crane_loop`, and limits of its drives."""

    law: LawName


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
            "The load goes 20 m across and 1 m down in 15 s, from rest to rest. The plan of the load becomes "
            "references of trolley and rope through (15a,b); two PIDs follow them. The step sends both drives to the "
            "goal at once."
        ),
        notes=(
            *found.notes,
            f"The paper's claim that both splines are globally equivalent here holds: the load is within "
            f"{1e3 * poly['error_travel']:.3g} mm of the polynomial and {1e3 * trig['error_travel']:.3g} mm of the "
            "trigonometric plan on the way.",
            _step_note(found),
            _limits_note(found),
            f"Figure 3's generator has no feedback from the load. Linearised at R = 10 m, its slowest pole pair is at "
            f"{grows.real:+.5f} ± {abs(grows.imag):.3f}j 1/s: with the study's PIDs the sway is not damped, it grows "
            f"slowly (the integral action does it). Feedback from the load's x moves the slowest pole to "
            f"{damped.real:.2f} 1/s and damps it: the figure shows both.",
            f"The whole law (9)-(11), by dynamic extension, follows a plan of ten constraints to "
            f"{whole['error_travel']:.1g} m on the nominal model; so does its open-loop half, without any feedback to "
            "correct what is not nominal.",
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
            {"plan": "path generator", "generator": "flat law (15a,b)", "trolley_pid": "PID", "hoist_pid": "PID"},
            caption="Structure of the controller (figure 3), drawn from the blocks and connections of the model "
            "itself.",
        ),
        CraneTime(),
        CraneStep(
            caption="The step: force and torque at their limits (dashed), up to the slack rope: where the tension "
            "comes to 0 the model ends, and so does the run."
        ),
        CraneMotion(),
        _sway_curves(),
        AnimatedCrane(),
        FastestMove(limited),
    )


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
            "Only the first and last position are prescribed, 30 s apart. The polynomial is a straight line in time, "
            "which starts and stops at speed; the paper's trigonometric spline is 12 + 2 sin(tau − pi/2) in z."
        ),
        notes=(
            *found.notes,
            f"Holds: on the way the load swings up to {rows['polynomial']['error_travel']:.3g} m about the polynomial, "
            f"and {1e3 * rows['trigonometric']['error_travel']:.2g} mm about the trigonometric plan.",
            "The reason is not that the spline's derivatives never vanish: it is that this spline starts at rest "
            "(gamma = pi/2) where the line starts at speed. With the same alpha and gamma the mean, as the paper's "
            "definition 1 has it, it would start at speed as well.",
            f"The terminal oscillation that the paper reports ({rows['trigonometric']['error_after']:.3g} m here) is a "
            "choice, not a property: the figure shows the speed that is left at the end over alpha. At alpha = pi the "
            f"plan is at rest at both ends, and "
            f"{1e3 * rows['trigonometric, alpha pi']['error_after']:.2g} mm are left.",
            _step_note(found),
            _limits_note(found),
        ),
        sections=(CraneTime(), _speed_curves(points), CraneMotion(), AnimatedCrane()),
    )


def crane_obstacle_study(progress: bool = True) -> Study:
    """Simulation 3 (figure 6): over a wall through two via points."""
    points = obstacle_waypoints()
    plans: dict[str, tuple[Trajectory, _Loop]] = {
        "step": (_step(points), _STEP),
        "polynomial": (PolySpline(points), {}),
        "trigonometric": (TrigSpline(points, alpha=4.0), {}),
        "piecewise": (PiecewiseSpline(points), {}),
        "via points chosen": (_avoiding(PolySpline([points[0], points[-1]])), {}),
    }
    found = _compared(plans, points, 30.0, "Crane, obstacle (simulation 3)")
    rows = found.metrics
    polyline = float(np.sum(np.hypot(*np.diff(np.array([w.position for w in points]).T, axis=1))))
    lengths = {name: rows[name]["path_length"] for name in ("polynomial", "trigonometric", "piecewise")}
    grids = optimality_grids()
    return Study(
        "crane-obstacle",
        "Crane: over an obstacle (simulation 3, figure 6)",
        found,
        summary=(
            "A wall stands in the way; the load passes A at 6 s and B at 11 s with given velocity and acceleration. "
            "One plan meets all twelve constraints an axis (the paper's second approach), or one quintic a leg does "
            "(its first)."
        ),
        notes=(
            *found.notes,
            f"Holds at alpha = 4 and 16 s: the polynomial wanders over {lengths['polynomial']:.2f} m, the "
            f"trigonometric plan takes {lengths['trigonometric']:.2f} m; the polyline through the waypoints has "
            f"{polyline:.1f} m.",
            "Does not hold in general: over alpha and duration the trigonometric path can be far longer than the "
            "polynomial's (alpha above 5), and at 20 s both wander. The figure shows where the claim is true.",
            f"The paper's other approach, one quintic a leg, takes {lengths['piecewise']:.2f} m and "
            f"{_piecewise_lengths()} What it costs is a jump of the jerk at A and B; the load follows it within "
            f"{1e3 * rows['piecewise']['error_travel']:.2g} mm.",
            f"The paper gives A and B. Without them, a load of {LOAD_RADIUS:g} m radius, its rope, and {MARGIN:g} m of "
            f"clearance, the via points are found: {_via_points(found.plans['via points chosen'])}; the path has "
            f"{rows['via points chosen']['path_length']:.2f} m. {clearance_note(found.plans)}",
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
    """Where and when a plan passes between its ends."""
    return ", ".join(f"({w.position[0]:.3g}, {w.position[1]:.3g}) m at {w.time:.3g} s" for w in plan.waypoints[1:-1])


_STEP: _Loop = {"law": "setpoint", "force_limits": FORCE_LIMITS, "torque_limits": TORQUE_LIMITS}


def _avoiding(plan: Trajectory) -> Trajectory:
    """Plan through via points, with a margin between wall and load or rope."""
    return avoid(plan, WALLS, clearance=MARGIN, load=LOAD_RADIUS, rope=CRANE.rope()).plan


def _step(points: tuple[Waypoint, ...]) -> Step:
    return Step(points[-1].position, points[0].position, points[0].time, labels=points[0].labels)


def _compared(
    plans: Mapping[str, tuple[Trajectory, _Loop]], points: tuple[Waypoint, ...], t_end: float, title: str
) -> Comparison:
    timepts = np.union1d(np.linspace(0.0, t_end, int(100 * t_end) + 1), [w.time for w in points])

    def build(name: str, plan: Trajectory) -> ct.InterconnectedSystem:
        return crane_loop(CRANE, plan, **plans[name][1])

    laws = {id(plan): options for plan, options in plans.values()}

    def limited(run: Run) -> dict[str, float]:
        options = laws[id(run.plan)]
        own = as_law(options.get("law", "generator")).outputs != Law.outputs  # it commands force and torque itself
        return {"error_limited": np.nan if own else _limited_error(run.plan, options, timepts)}

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


def _limited_error(plan: Trajectory, options: _Loop, timepts: Array) -> float:
    """Greatest error of the load with force and torque limited as the step's are; nan where the rope goes slack."""
    loop = crane_loop(CRANE, plan, **options | {"force_limits": FORCE_LIMITS, "torque_limits": TORQUE_LIMITS})
    response = simulate(loop, timepts, events=(SLACK,))
    if response.time[-1] < timepts[-1]:
        return np.nan
    signals = signals_of(response)
    return float(np.hypot(*(np.stack([signals["x"], signals["z"]]) - plan.jet(timepts, 0)[0])).max())


def _limits_note(found: Comparison) -> str:
    """What the plans ask of drives that have the step's limits, and what that costs."""
    names = ("polynomial", "trigonometric", "piecewise")
    peaks = ", ".join(f"{name} {1e-3 * found.metrics[name]['force_peak']:.3g} kN" for name in names)
    limited = {name: found.metrics[name]["error_limited"] for name in names}
    errors = ", ".join(
        f"{name} {'none, since the rope goes slack' if np.isnan(error) else f'{error:.2g} m'}"
        for name, error in limited.items()
    )
    return (
        f"Only the step runs with limited drives above; the plans ask for a force of up to {peaks}, much of it where "
        f"their acceleration or speed begins and ends with a jump. With the step's limits (30 kN) their greatest "
        f"errors are: {errors}."
    )


def _parameters(t_end: float) -> dict[str, object]:
    crane = CRANE
    return {
        "load": f"m = {crane.load_mass:g} kg",
        "trolley": f"M_c = {crane.trolley_mass:g} kg, f1 = {crane.trolley_friction:g} N s/m",
        "drum": f"J = {crane.drum_inertia:g} kg m², b = {crane.drum_radius:g} m, f2 = {crane.drum_friction:g} N m s",
        "gravity": f"{crane.gravity:g} m/s²",
        "PIDs": "gains of a triple pole at −5 rad/s; with the derivative filter of 0.02 s the closed loop of the "
        f"trolley has its poles at {_poles(crane.linear_trolley_loop())}, that of the hoist at "
        f"{_poles(crane.linear_hoist_loop())} rad/s",
        "limits for the step": "|F| ≤ 30 kN, C from −3 to 1 kN m, with anti-windup",
        "start": "at rest at the first position",
        "run": f"{t_end:g} s",
    }


def _poles(loop: ct.StateSpace) -> str:
    """Poles of a loop, pairs once."""
    poles = sorted((pole for pole in np.asarray(loop.poles()) if pole.imag >= 0.0), key=lambda pole: -pole.real)
    return ", ".join(f"{p.real:.3g}" + (f" ± {p.imag:.3g}j" if p.imag else "") for p in poles).replace("-", "−")


def _step_note(found: Comparison) -> str:
    step = found.metrics["step"]
    response = found.responses["step"]
    force = np.asarray(response.outputs)[list(response.output_labels).index("F")]
    limited = float(metrics.saturation_time(np.asarray(response.time), force, *FORCE_LIMITS))
    slack = found.stopped.get("step")
    end = (
        f"and the load still swings by {step['sway_after']:.2g} rad after the other plans have arrived."
        if slack is None
        else f"until the rope goes slack at {slack:.3g} s. There the model ends, and so does the run: what a step "
        "would do afterwards is not known, and its figures are not ranked."
    )
    held = f"it holds the trolley's drive at its limit for {limited:.2g} s"
    return f"The step does what the introduction says: {held}, {end}"


def _linear_loop(law: str) -> ct.StateSpace:
    """Closed loop linearised about rest at R = 10 m, with the sway as output."""
    start = Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    loop = crane_loop(CRANE, start, LAWS[law])
    linear = ct.linearize(loop, loop.initial_state, 0)
    row = loop.output_labels.index("theta")
    a = np.asarray(linear.A)
    return ct.ss(a, np.zeros((len(a), 1)), np.asarray(linear.C)[[row]], [[0.0]], outputs=["theta"], inputs=["none"])


def _slowest(system: ct.StateSpace) -> complex:
    """Pole farthest to the right, of those that move the sway."""
    poles = np.asarray(system.poles())
    swinging = poles[np.abs(poles) > 1e-6]
    return complex(swinging[swinging.real.argmax()])


def _sway_curves() -> Curves:
    """Sway of the linearised loops from 0.05 rad, with figure 3's generator and with load feedback."""
    t = np.linspace(0.0, 600.0, 6001)
    rows = {}
    for law, label in (("generator", "figure 3's generator"), ("load_feedback", "with load feedback")):
        system = _linear_loop(law)
        state = np.zeros(system.nstates)
        state[system.nstates - 6 + 2] = 0.05
        rows[label] = np.asarray(simulate(system, t, initial_state=state).outputs).reshape(-1)
    caption = "Sway after a push of 0.05 rad, loops linearised at R = 10 m."
    return Curves("time [s]", "sway [rad]", t, rows, key="crane-sway", caption=caption)


def _speed_curves(points: tuple[Waypoint, Waypoint]) -> Curves:
    """Speed at start and end over alpha, with the paper's gamma and with the mean."""
    alphas = np.linspace(0.05, 5.5, 220)
    rows: dict[str, list[float]] = {"start, gamma pi/2": [], "end, gamma pi/2": [], "both ends, gamma mean": []}
    for alpha in alphas.tolist():
        fixed = (
            TrigSpline(points, alpha=alpha, gamma=np.pi / 2, warn=False)
            if abs(np.cos(0.5 * alpha - np.pi / 2)) > 1e-3
            else None
        )
        ends = np.full(2, np.nan) if fixed is None else np.hypot(*fixed.jet([0.0, 30.0], 1)[1])
        rows["start, gamma pi/2"].append(float(ends[0]))
        rows["end, gamma pi/2"].append(float(ends[1]))
        mean = TrigSpline(points, alpha=alpha, warn=False)
        rows["both ends, gamma mean"].append(float(np.hypot(*mean.jet(30.0, 1)[1])))
    return Curves(
        "alpha [rad]",
        "speed of the plan [m/s]",
        alphas,
        {name: np.array(row) for name, row in rows.items()},
        key="crane-curves",
        caption="Speed at which the plan starts and ends over alpha: what is not 0 there, the load swings off.",
    )


def _piecewise_lengths() -> str:
    """Whether one quintic a leg is the shortest path at every alpha and end time drawn."""
    rows = _length_curves().rows
    pairs = [(rows[name], rows[name.replace("one plan", "one quintic a leg")]) for name in rows if "one plan" in name]
    if all(np.all(segments <= whole) for whole, segments in pairs):
        return "is the shortest at every alpha and end time drawn."
    share = np.mean([np.mean(segments <= whole) for whole, segments in pairs])
    return f"is the shorter one at {100 * share:.0f} % of the alphas and end times drawn."


@cache
def _length_curves() -> Curves:
    """Path length over alpha for several durations, the polynomial at alpha 0, and one quintic a leg."""
    alphas = np.linspace(0.0, 5.6, 113)
    rows = {}
    for duration in (14.0, 16.0, 20.0):
        points = obstacle_waypoints(duration)
        t = np.linspace(0.0, duration, 2001)
        lengths = [float(metrics.path_length(t, TrigSpline(points, alpha=a, warn=False)(t))) for a in alphas.tolist()]
        rows[f"one plan, {duration:g} s"] = np.array(lengths)
        segments = float(metrics.path_length(t, PiecewiseSpline(points)(t)))
        rows[f"one quintic a leg, {duration:g} s"] = np.full(alphas.size, segments)
    return Curves(
        "alpha [rad] (0: polynomial)",
        "path length [m]",
        alphas,
        rows,
        log=True,
        paired=True,
        key="crane-curves",
        caption="Length of the path over alpha for three end times; A and B stay at 6 and 11 s.",
    )
