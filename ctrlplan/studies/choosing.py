"""Crane studies of planning: minimum durations under limits, and the paper's claim of optimality."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ctrlplan.planning import (
    Fastest,
    Rectangle,
    SquaredDerivative,
    choose_alpha,
    clearance,
    fastest,
    optimize_waypoints,
    plan_length,
)
from ctrlplan.planning.objectives import plan_lengths
from ctrlplan.studies.baselines import smoother_polynomials
from ctrlplan.studies.benefit import PLANNED, Benefit, Choices, benefit_of
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
    nominal_waypoints,
    obstacle_waypoints,
)
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.grids import Grid, Mark
from ctrlplan.systems.plants import LAWS, crane_loop
from ctrlplan.trajectories import PiecewiseSpline, Trajectory, TrigSpline, Waypoint

LOAD_RADIUS, MARGIN = 0.5, 0.3
"""Radius of the load, and the clearance required of load and rope [m]."""
WALLS = (Rectangle(*WALL),)
_LIMITS = {"F": 5e3, "C": TORQUE_LIMITS, "T": (0.0, None), "theta": 0.1, "R": (1.0, 12.0)}
_COMFORT = {"velocity": 2.5, "acceleration": 0.6, "jerk": 0.4, "theta": 0.06, "R": (1.0, 12.0)}
_QUINTIC = "quintic per segment (minimum jerk)"
_POLYLINE = "polyline (lower bound)"


def nominal_benefit() -> Benefit:
    """The nominal move compared with its baselines; sufficiently smooth plans use the flat map."""
    loops = LoopsOfPlans()

    def build(name: str, plan: Trajectory) -> ct.InterconnectedSystem:
        # The flat map contains accelerations: if these jump, so do the references of trolley and rope.
        law = LAWS["setpoint" if plan.jumps(2) else "generator"]
        limits = DriveLimits(force_limits=FORCE_LIMITS, torque_limits=TORQUE_LIMITS)
        return loops.loop(plan, None, lambda: crane_loop(CRANE, plan, law, **limits))  # a step is that of any duration

    points = nominal_waypoints()
    depth = float(np.mean([point.position[1] for point in points]))
    experiment = Experiment(
        {PLANNED: TrigSpline(points, alpha=1.0)},
        np.linspace(0.0, 40.0, 2001),
        waypoints=points,
        controls=("F", "C"),
        events=(SLACK,),
        measures=CRANE_MEASURES | {"load": LOAD},
    )
    choices = Choices(
        alpha=1.0,
        limits=_COMFORT,
        quantities=CRANE,
        mode=(math.sqrt(CRANE.gravity / depth), 0.0),
        alphas=(0.0, 1.0, 2.0, 3.0, 4.0),
        factors=(0.75, 1.0, 1.5),
        decisive=("settling_time", "sway_after", "force_peak"),
        baselines=smoother_polynomials,
        note="Plans with continuous acceleration (splines, polynomials up to degree 9, S-curves, shaped or not) are "
        "mapped to the drive references by the flat map of the load (figure 3). Steps and the trapezoid, whose "
        "acceleration is discontinuous, are mapped with a vertical rope. All drives are limited. A run ends when the "
        "rope becomes slack.",
    )
    title = "Crane, nominal case: planned reference and baselines"
    return benefit_of(experiment, build, choices, units=UNITS, title=title)


@cache
def nominal_fastest() -> Fastest:
    """The nominal move with ten constraints per axis in minimum time, for 5 kN and further limits."""
    return fastest(TrigSpline(nominal_waypoints(5), alpha=1.0), _LIMITS, CRANE)


def fastest_notes(found: Fastest) -> tuple[str, ...]:
    """Minimum duration of the nominal move under limits, with its own time law and with another."""
    law = fastest(found.plan, _LIMITS, CRANE, hold="path")
    others = ", ".join(f"{row.bound.name} {row.share}" for row in found.margins.rows[1:] if "%" in row.share)
    active = found.active
    return (
        "With limits of 5 kN on the force, 0.1 rad on the sway and 12 m on the rope length, the minimum duration of "
        f"the move with ten constraints per axis is {found.duration:.4g} s. The active limit is {active.bound.name} "
        f"at {active.time:.3g} s. Margins of the other limits: {others}. With an optimized time law on the same path "
        f"the minimum duration is {law.duration:.4g} s, with {law.active.bound.name} as the active limit at "
        f"{law.active.time:.3g} s.",
    )


@cache
def optimality_grids() -> tuple[Grid, Grid]:
    """Path length and squared jerk of a trigonometric spline through the paper's waypoints, by alpha and end time."""
    ends, alphas = np.array([14.0, 15.0, 16.0, 17.0, 18.0, 20.0]), np.array([0.0, 1.0, 2.0, 3.0, 4.0, 4.5, 5.0])
    shapes, baselines = [], []
    for end in ends.tolist():
        points = obstacle_waypoints(end)
        shapes.append([TrigSpline(points, alpha=a, warn=False) for a in alphas.tolist()])
        baselines.append(
            {
                _QUINTIC: PiecewiseSpline(points),
                "minimum jerk through the positions": _freed(points),
                "shortest of one trigonometric spline per segment": choose_alpha(points, family=PiecewiseSpline).plan,
            }
        )
    polyline = [_polyline(obstacle_waypoints(end)) for end in ends.tolist()]
    jerk = SquaredDerivative(3)
    return (
        Grid(
            "Path length",
            "m",
            ends,
            alphas,
            np.array([plan_lengths(row) for row in shapes]),
            {name: np.array([plan_length(row[name]) for row in baselines]) for name in baselines[0]}
            | {_POLYLINE: np.array(polyline)},
            not_ranked=(_POLYLINE,),
        ),
        Grid(
            "Integral of the squared jerk",
            "m²/s⁵",
            ends,
            alphas,
            np.array([[jerk(plan) for plan in row] for row in shapes]),
            {name: np.array([jerk(row[name]) for row in baselines]) for name in baselines[0]},
        ),
    )


def optimality_claim(grids: tuple[Grid, Grid]) -> tuple[str, ...]:
    """Check of the paper's claim that the trigonometric path is optimal."""
    length, jerk = grids
    row = int(np.flatnonzero(length.durations == 16.0)[0])
    best = choose_alpha(obstacle_waypoints())
    baseline, shortest = length.best(row)
    bound = float(length.baselines[_POLYLINE][row])
    better = sum(marks[1:].count(Mark.BETTER) for grid in grids for marks in grid.marks())
    cells = sum(grid.values[:, 1:].size for grid in grids)
    polynomial = int((length.values[:, 1:] < length.values[:, :1] * (1.0 - 1e-3)).sum())
    straight = choose_alpha(nominal_waypoints())
    freer = ", ".join(f"{length:.2f} m with {freedom}" for freedom, length in _freer_paths(best.plan).items())
    verdict = "is true in none of the cases" if not better else f"is true in {better} of {cells} cases"
    return (
        f"The paper calls its trigonometric path optimal. In {cells // 2} combinations of alpha and end time, compared "
        f"with minimum-jerk plans and with the shortest known plan through the same waypoints, the claim {verdict}.",
        f"Length: for 16 s, the shortest trigonometric path of minimum degree with mean gamma has alpha = "
        f"{best.alpha:.4g} and a length of {best.value:.4g} m, from a search over alpha alone. With other free "
        f"parameters there are shorter paths: {freer}. The path of the best baseline, {baseline}, has a length of "
        f"{shortest:.4g} m; the polyline, a lower bound, has {bound:.4g} m. Compared with a single polynomial through "
        f"all waypoints, as in the paper, the trigonometric path is shorter in {polynomial} of "
        f"{length.values[:, 1:].size} cases.",
        "Jerk: one quintic per segment minimizes the integral of the squared jerk among all plans with these "
        f"constraints. For 16 s its value is {jerk.baselines[_QUINTIC][row]:.3g} m²/s⁵; the smallest value of a "
        f"trigonometric plan in the table is {jerk.values[row, 1:].min():.3g} m²/s⁵.",
        f"For a move from rest to rest, as in simulation 1, every path with alpha below pi is the straight line of "
        f"{straight.value:.4g} m and so has minimum length. The integral of the squared jerk is smallest for the "
        f"polynomial (alpha = {straight.alpha:g}).",
        length.verdict,
        jerk.verdict,
    )


def _freer_paths(plan: Trajectory) -> dict[str, float]:
    """Lengths of trigonometric paths through the paper's waypoints with further free parameters."""
    points = obstacle_waypoints()
    found = {
        f"degree {degree} at alpha = {alpha:g}": plan_length(TrigSpline(points, alpha=alpha, degree=degree))
        for degree, alpha in ((7, 4.0), (16, 5.0))
    }
    start = [plan.alpha, *plan.gamma] if isinstance(plan, TrigSpline) else []

    def length(choice: NDArray[np.float64]) -> float:
        try:
            return plan_length(TrigSpline(points, alpha=choice[0], gamma=choice[1:].tolist()))
        except ValueError:  # no such spline
            return math.inf

    freest = minimize(length, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4})
    return found | {"a separate gamma for each axis": float(freest.fun)}


def clearance_note(plans: Mapping[str, Trajectory]) -> str:
    """Clearance between the wall and load and rope, for each plan."""
    found = {
        name: clearance(plan, WALLS, load=LOAD_RADIUS, rope=CRANE.rope())
        for name, plan in plans.items()
        if plan.duration
    }
    parts = ", ".join(f"{name} {one.minimum:.2f} m ({one.part})" for name, one in found.items())
    return f"Clearance of load and rope from the wall, verified over the whole move: {parts}."


def _freed(points: tuple[Waypoint, ...]) -> Trajectory:
    """Minimum jerk through the positions of inner waypoints."""
    return optimize_waypoints([points[0], *(point.truncated(0) for point in points[1:-1]), points[-1]]).plan


def _polyline(points: tuple[Waypoint, ...]) -> float:
    corners = np.array([w.position for w in points])
    return float(np.hypot(*np.diff(corners, axis=0).T).sum())
