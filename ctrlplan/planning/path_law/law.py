"""Time law of minimum duration by successive refinement of the cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctrlplan.planning.bounds import Bound, changes
from ctrlplan.planning.path_law.bernstein import bernstein
from ctrlplan.planning.path_law.grid import Grid, Spline
from ctrlplan.planning.path_law.interior_point import Problem, minimum
from ctrlplan.planning.path_law.rows import POINTS, Activity, Rows
from ctrlplan.planning.path_law.spans import Part, Rates, parts_of
from ctrlplan.planning.path_law.sweep import swept
from ctrlplan.trajectories import Retimed, TimeLaw, Trajectory
from ctrlplan.trajectories.common import Array, readonly

_NODES, _WEIGHTS = (readonly(0.5 * values) for values in np.polynomial.legendre.leggauss(4) + np.array([[1.0], [0.0]]))
"""Quadrature of the duration of a cell."""

_LOSS = 5e-3
"""Mean distance from the nearest limit over the time of the plan below which cells are not divided any more."""

_REFINEMENTS, _PIECES = 4, 4
"""Maximum number of refinements, and of the pieces into which a cell is divided in each."""

_START = 0.9
"""Feasible start relative to the limits."""


def fastest_law(
    plan: Trajectory,
    bounds: Sequence[Bound],
    start: float,
    given: Rates = (None, None),
    reserve: float = 0.0,
    narrow: Sequence[float] = (),
) -> Retimed:
    """Time law of minimum duration under limits of velocities and accelerations.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration and without jumps of the position.
    bounds : sequence of Bound
        Limits of first and second derivatives of axes.
    start : float
        Start [s] of the plan for which limits over time are given.
    given : (float or None, float or None), optional
        Squared rates of the law at its ends; None for free ones.
    reserve : float, optional
        Distance from the limits, relative to them.
    narrow : sequence of float, optional
        Further times [s] of the given plan at which cells end, where limits over time are narrow.

    Raises
    ------
    ValueError
        If the rate is not limited, or velocities at the ends are infeasible.
    """
    edges = [time - start + plan.start for times in (*map(changes, bounds), narrow) for time in times]
    parts = parts_of(plan, any(bound.order == 2 for bound in bounds), edges, given, start)
    grid = Grid.of(plan, [part for part in parts if part.moves])
    for refinement in range(_REFINEMENTS + 1):
        spline, activity = Spline.of(grid), Activity.of(grid, bounds, POINTS, start)
        rows = activity.rows(grid.length).with_reserve(POINTS.size, reserve, *grid.ends(moving=True))
        problem = problem_of(grid, spline, rows)
        x = swept(grid, spline, rows.relaxed())
        scale = _START if any(given) else _START * problem.feasible_scale(x)
        x = minimum(problem, np.where(spline.fixed, x, scale * x))
        local = spline.coefficients(x)
        loss = losses(activity, local, grid.length)
        if loss.sum() < _LOSS or refinement == _REFINEMENTS:
            break
        grid = grid.divided(np.clip(np.ceil(loss / loss.mean()), 1, _PIECES).astype(int))
    return Retimed(plan, _law(plan, parts, grid, local))


def problem_of(grid: Grid, spline: Spline, rows: Rows) -> Problem:
    """Duration by quadrature, and inequalities, for the coefficients of a spline."""
    degree = len(spline.index) - 1
    values = np.repeat(bernstein(_NODES, degree)[:, None], grid.length.size, axis=1)
    weights = _WEIGHTS[:, None] * grid.length
    # 1/sqrt(b) is integrated by the square root of the distance from a point at which b is 0.
    root = 2.0 * _NODES[:, None]
    first, last = grid.ends(moving=False)
    values[:, first], weights[:, first] = bernstein(_NODES**2, degree)[:, None], weights[:, first] * root
    values[:, last], weights[:, last] = bernstein(1.0 - _NODES**2, degree)[:, None], weights[:, last] * root
    return Problem(spline, spline.rows(values), weights, spline.rows(rows.factors), rows.upper, rows.lower)


def losses(activity: Activity, local: Array, lengths: Array) -> Array:
    """Distance of each cell from the nearest limit, weighted by its part of the duration."""
    points, degree = activity.points, len(local) - 1
    weights = bernstein(points, points.size - 1)
    means = np.linalg.solve(weights.T, np.full(points.size, 1.0 / points.size))  # exact quadrature of polynomials
    durations = lengths / np.sqrt(means @ (bernstein(points, degree) @ local))
    distance = means @ np.maximum(1.0 - activity.worst(local, lengths), 0.0)
    return distance * durations / durations.sum()


def _law(plan: Trajectory, parts: Sequence[Part], grid: Grid, local: Array) -> TimeLaw:
    """Time law from the Bernstein coefficients (3, ncells) of the moving parts; dwells keep their duration."""
    dwells = [span for part in parts if not part.moves for span in part.spans]
    own = [plan.breakpoints[span.segment] + span.start for span in dwells]
    places = np.append(plan.breakpoints[grid.segment] + grid.start, own)
    rates = np.append(local, np.ones((3, len(own))), axis=1)
    order = np.argsort(places)
    return TimeLaw(np.append(places[order], plan.end), rates[:, order], plan.start)
