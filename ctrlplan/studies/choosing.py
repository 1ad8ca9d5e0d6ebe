"""What is chosen for the crane: durations under limits, and whether the paper's path is the best there is."""

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
    nominal_waypoints,
    obstacle_waypoints,
)
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.grids import Grid
from ctrlplan.systems.plants import LAWS, crane_loop
from ctrlplan.trajectories import PiecewiseSpline, Trajectory, TrigSpline, Waypoint

LOAD_RADIUS, MARGIN = 0.5, 0.3
"""Radius of the load, and the clearance that it and its rope keep [m]."""
WALLS = (Rectangle(*WALL),)
_LIMITS = {"F": 5e3, "C": TORQUE_LIMITS, "T": (0.0, None), "theta": 0.1, "R": (1.0, 12.0)}
_COMFORT = {"velocity": 2.5, "acceleration": 0.6, "jerk": 0.4, "theta": 0.06, "R": (1.0, 12.0)}
_POLYLINE = "polyline (no path is shorter)"


def nominal_benefit() -> Benefit:
    """The nominal move compared with its baselines, all through the flat map that are smooth enough for it."""

    def build(name: str, plan: Trajectory) -> ct.InterconnectedSystem:
        # The flat map contains accelerations: where these jump, trolley and rope would have to.
        law = LAWS["setpoint" if plan.jumps(2) else "generator"]
        return crane_loop(CRANE, plan, law, force_limits=FORCE_LIMITS, torque_limits=TORQUE_LIMITS)

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
        note="Every plan with a continuous acceleration goes to the drives through the flat map of the load (figure "
        "3): splines, polynomials up to the nonic, S-curves, shaped or not. Steps and the trapezoid, whose "
        "acceleration jumps, go there as if the load hung at rest. All drives are limited. A run ends where the rope "
        "goes slack.",
    )
    title = "Crane, nominal case: planned beside its rivals"
    return benefit_of(experiment, build, choices, units=UNITS, title=title)


@cache
def nominal_fastest() -> Fastest:
    """The nominal move with ten constraints an axis, as fast as 5 kN and the other limits allow."""
    return fastest(TrigSpline(nominal_waypoints(5), alpha=1.0), _LIMITS, CRANE)


def fastest_notes(found: Fastest) -> tuple[str, ...]:
    """What limits make of the nominal move, on its own time law and on another."""
    law = fastest(found.plan, _LIMITS, CRANE, hold="path")
    others = ", ".join(f"{row.bound.name} {row.share}" for row in found.margins.rows[1:] if "%" in row.share)
    active = found.active
    return (
        f"Within 5 kN, 0.1 rad of sway and 12 m of rope the ten-constraint move takes {found.duration:.4g} s at least: "
        f"{active.bound.name} is at its limit at {active.time:.3g} s. What the other limits leave: {others}. The same "
        f"path on another time law takes {law.duration:.4g} s, with {law.active.bound.name} at its limit at "
        f"{law.active.time:.3g} s.",
    )


@cache
def optimality_grids() -> tuple[Grid, Grid]:
    """Length and squared jerk of one trigonometric spline through the paper's waypoints, over alpha and end time."""
    ends, alphas = np.array([14.0, 15.0, 16.0, 17.0, 18.0, 20.0]), np.array([0.0, 1.0, 2.0, 3.0, 4.0, 4.5, 5.0])
    shapes, baselines = [], []
    for end in ends.tolist():
        points = obstacle_waypoints(end)
        shapes.append([TrigSpline(points, alpha=a, warn=False) for a in alphas.tolist()])
        baselines.append(
            {
                "quintic a leg (minimum jerk)": PiecewiseSpline(points),
                "minimum jerk through the positions": _freed(points),
                "shortest of one trigonometric spline a leg": choose_alpha(points, family=PiecewiseSpline).plan,
            }
        )
    polyline = [_polyline(obstacle_waypoints(end)) for end in ends.tolist()]
    jerk = SquaredDerivative(3)
    return (
        Grid(
            "Length of the path",
            "m",
            ends,
            alphas,
            np.array([[plan_length(plan) for plan in row] for row in shapes]),
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
    """What becomes of the paper's claim that the trigonometric path is optimal."""
    length, jerk = grids
    row = int(np.flatnonzero(length.durations == 16.0)[0])
    best = choose_alpha(obstacle_waypoints())
    baseline, shortest = length.best(row)
    bound = float(length.baselines[_POLYLINE][row])
    better = sum(marks[1:].count("better") for grid in grids for marks in grid.marks())
    cells = sum(grid.values[:, 1:].size for grid in grids)
    polynomial = int((length.values[:, 1:] < length.values[:, :1] * (1.0 - 1e-3)).sum())
    straight = choose_alpha(nominal_waypoints())
    freer = ", ".join(f"{length:.2f} m with {freedom}" for freedom, length in _freer_paths(best.plan).items())
    fails = "fails" if not better else f"holds in {better} of {cells} cases, and fails in the others"
    return (
        f"The paper calls its trigonometric path optimal. Over {cells // 2} pairs of alpha and end time, against "
        f"minimum jerk and the shortest plan known through the same waypoints, the claim {fails}.",
        f"Length: with 16 s, of the trigonometric paths of lowest degree and mean gamma the shortest has alpha = "
        f"{best.alpha:.4g} and {best.value:.4g} m. Alpha alone was searched for that; other freedoms give shorter "
        f"ones: {freer}. {baseline[0].upper()}{baseline[1:]} has {shortest:.4g} m, and no path is shorter than the "
        f"polyline's {bound:.4g} m. "
        f"Against the one polynomial through all of them it is shorter in {polynomial} of {length.values[:, 1:].size} "
        "cases: that is what the paper compared with.",
        "Jerk: one quintic a leg has the least squared jerk of all plans through these entries, which is a theorem; "
        f"at 16 s it has {jerk.baselines['quintic a leg (minimum jerk)'][row]:.3g} m²/s⁵, the best trigonometric plan "
        f"of the table {jerk.values[row, 1:].min():.3g}.",
        f"From rest to rest, as in simulation 1, the path is a straight line of {straight.value:.4g} m whatever the "
        f"alpha below pi: it is the shortest, and so is every other; the least squared jerk is the polynomial's "
        f"(alpha = {straight.alpha:g}).",
        length.verdict,
        jerk.verdict,
    )


def _freer_paths(plan: Trajectory) -> dict[str, float]:
    """Lengths of trigonometric paths through the paper's waypoints with more freedom than alpha, by that freedom."""
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
    return found | {"a gamma of its own for each axis": float(freest.fun)}


def clearance_note(plans: Mapping[str, Trajectory]) -> str:
    """How near each plan comes to the wall, with load and rope."""
    found = {
        name: clearance(plan, WALLS, load=LOAD_RADIUS, rope=CRANE.rope())
        for name, plan in plans.items()
        if plan.duration
    }
    parts = ", ".join(f"{name} {least.minimum:.2f} m ({least.part})" for name, least in found.items())
    return f"Certified over the whole way, load and rope keep from the wall: {parts}."


def _freed(points: tuple[Waypoint, ...]) -> Trajectory:
    """Minimum jerk through the positions of inner waypoints."""
    return optimize_waypoints([points[0], *(point.truncated(0) for point in points[1:-1]), points[-1]]).plan


def _polyline(points: tuple[Waypoint, ...]) -> float:
    corners = np.array([w.position for w in points])
    return float(np.hypot(*np.diff(corners, axis=0).T).sum())
