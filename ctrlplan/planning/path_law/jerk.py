"""Time law of minimum duration under limits of the jerk, by a sequence of convex problems.

The jerk is sqrt(b) R with R = p''' b + 3 p'' b'/2 + p' b''/2, so that its limit is
R <= j/sqrt(b). The right side is convex, and its tangent at a feasible b is a stronger
limit, linear in b: solutions of the problems with these limits are feasible, and their
durations decrease. The last one is a local minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctrlplan.planning.bounds import Bound, changes
from ctrlplan.planning.path_law.bernstein import bernstein
from ctrlplan.planning.path_law.grid import Grid, Spline
from ctrlplan.planning.path_law.interior_point import Problem, minimum
from ctrlplan.planning.path_law.law import losses, problem_of
from ctrlplan.planning.path_law.rows import POINTS, SMOOTH_POINTS, Activity
from ctrlplan.planning.path_law.spans import Part, Rates, parts_of
from ctrlplan.planning.path_law.sweep import check_ends
from ctrlplan.trajectories import PiecewisePolynomial, Retimed, Trajectory
from ctrlplan.trajectories.common import FACTORIALS, Array, readonly

_ROUNDS, _GAIN = 25, 1e-3
"""Maximum number of problems on a grid, and the decrease of the duration, relative to it, that ends them."""

_LOSS, _REFINEMENTS, _PIECES = 5e-3, 2, 3
"""As for limits of the acceleration; signals are at no limit while the jerk changes its sign."""

_START = 0.8
"""Squared rate of the start relative to the largest constant one."""

_DIVISIONS, _NEARLY, _FALLS = 2, 1e-5, 0.9
"""Maximum number of divisions of the cells that exceed a limit with given speeds at the ends, the excess relative to
the limit that is small, and the ratio of that of a round to that before below which it is still falling."""

_FAR = 0.5
"""Share of its limit below which a signal of the last law hardly limits the next one."""

INSIDE = 0.95
"""Start of each problem relative to the last solution, which is at its limits."""

_NODES, _WEIGHTS = (readonly(0.5 * own) for own in np.polynomial.legendre.leggauss(24) + np.array([[1.0], [0.0]]))
"""Quadrature of the duration of a cell."""

_ENDS = readonly(np.array([0.0, 1.0]))


def fastest_smooth_law(
    plan: Trajectory,
    bounds: Sequence[Bound],
    start: float,
    given: Rates = (None, None),
    reserve: float = 0.0,
    narrow: Sequence[float] = (),
) -> Retimed:
    """Time law of minimum duration under limits up to the jerk.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration and a continuous acceleration.
    bounds : sequence of Bound
        Limits of derivatives of axes up to order 3.
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
        If no law with given rates at its ends is found.
    """
    edges = [time - start + plan.start for times in (*map(changes, bounds), narrow) for time in times]
    parts = parts_of(plan, True, edges, given, start)
    grid = Grid.of(plan, [part for part in parts if part.moves], smooth=True)
    problems, duration = _Problems(grid, bounds, start, reserve), np.inf
    x = problems.start()
    if problems.prescribed:
        problems, x = _within_limits(problems, x)
    for refinement in range(_REFINEMENTS + 1):
        local, duration = problems.converged(x, duration)
        loss = losses(problems.activity, local, problems.grid.length)
        if loss.sum() < _LOSS or refinement == _REFINEMENTS:
            break
        problems, x = problems.divided(np.clip(np.ceil(loss / loss.mean()), 1, _PIECES).astype(int), local)
    return Retimed(plan, smooth_law(plan, parts, problems.grid, local))


def _within_limits(problems: _Problems, x: Array) -> tuple[_Problems, Array]:
    """Coefficients that satisfy the limits with given speeds at the ends, on cells divided where they would not.

    Raises
    ------
    ValueError
        If none are found.
    """
    for division in range(_DIVISIONS + 1):
        x, excess = problems.nearest(x)
        if excess.max() < _NEARLY:
            return problems, x
        if division < _DIVISIONS:
            problems, x = problems.divided(np.where(excess > _NEARLY, _PIECES, 1), problems.local(x))
    problems.check_ends()
    raise ValueError(
        "limits must be satisfied with the speeds at the ends of the plan and at corners, but no such time law is "
        "found; lower these speeds, raise the limits, or choose free ends"
    )


class _Problems:
    """Problems on a grid, each with the limits of the jerk about a law.

    Attributes
    ----------
    grid, activity
        Cells, and the limited signals at their points.
    """

    def __init__(self, grid: Grid, bounds: Sequence[Bound], start: float, reserve: float) -> None:
        self.grid, self.activity = grid, Activity.of(grid, bounds, SMOOTH_POINTS, start)
        self._bounds, self._origin, self._reserve, self._spline = bounds, start, reserve, Spline.quartic(grid)

    @property
    def prescribed(self) -> bool:
        """Whether rates at ends are prescribed."""
        return bool(self._spline.fixed.any())

    def divided(self, counts: NDArray[np.intp], local: Array) -> tuple[_Problems, Array]:
        """Problems on the pieces of divided cells, and coefficients there near given Bernstein coefficients."""
        problems = _Problems(self.grid.divided(counts), self._bounds, self._origin, self._reserve)
        return problems, problems._with_prescribed(problems._spline.near(on_pieces(local, counts)))

    def start(self) -> Array:
        """Coefficients of the first law: the largest constant one, that of the plan with prescribed rates."""
        rate = 1.0 if self.prescribed else _START * _constant(self.grid, self.activity)
        return self._with_prescribed(np.full(self._spline.size, rate))

    def check_ends(self) -> None:
        """Raise for prescribed rates that limits of velocities and accelerations do not allow."""
        bounds = [bound for bound in self._bounds if bound.order < 3]
        if bounds:
            rows = Activity.of(self.grid, bounds, POINTS, self._origin).rows(self.grid.length)
            check_ends(self.grid, rows.with_reserve(POINTS.size, 0.0, *self.grid.ends(moving=True)).relaxed())

    def local(self, x: Array) -> Array:
        """Bernstein coefficients (degree + 1, ncells)."""
        return self._spline.coefficients(x)

    def nearest(self, x: Array) -> tuple[Array, Array]:
        """Coefficients with small excesses over the limits, and the largest one in each cell (ncells,)."""
        best, least = x, np.full(self.grid.length.size, np.inf)
        for _ in range(_ROUNDS):
            shares = np.maximum(self.activity.jerk_shares(self.local(x), self.grid.length), 1.0)
            problem = self._about(x, shares)
            excess = problem.excess(x)
            if not excess.max() < _FALLS * least.max():
                break
            best, least = x, excess
            if excess.max() < _NEARLY:
                break
            x = minimum(replace(problem, price=problem.duration(x)), x)
        return best, least

    def _with_prescribed(self, x: Array) -> Array:
        x[self._spline.fixed] = self.grid.prescribed
        return x

    def converged(self, x: Array, last: float) -> tuple[Array, float]:
        """Bernstein coefficients (degree + 1, ncells) of a local minimum, and its duration.

        The decreases of the duration vanish faster than their power 3/2.
        """
        for _ in range(_ROUNDS):
            problem = self._about(x)
            x = self._minimum(problem, x, np.isfinite(last))
            duration = problem.duration(x)
            gain, last = 1.0 - duration / last, duration
            if abs(gain) < _GAIN ** (2.0 / 3.0):
                break
        return self.local(x), last

    def _minimum(self, problem: Problem, x: Array, optimal: bool) -> Array:
        """Coefficients at the optimum, from those of a law, which may be the optimum of a similar problem."""
        if self.prescribed:
            with suppress(ValueError):
                return minimum(problem, x)
            return minimum(replace(problem, price=problem.duration(x)), x)  # where limits leave almost no freedom
        if optimal:
            with suppress(ValueError):  # without the other limits there may be no minimum
                found = minimum(problem.near_limits(x, _FAR), INSIDE * x)
                if problem.excess(found).max() <= problem.accuracy:
                    return found
        return minimum(problem, INSIDE * x)

    def _about(self, x: Array, shares: Array | None = None) -> Problem:
        rows = self.activity.rows(self.grid.length, self.local(x), shares)
        ends = self.grid.ends(moving=True)
        return problem_of(self.grid, self._spline, rows.with_reserve(SMOOTH_POINTS.size, self._reserve, *ends))


def _constant(grid: Grid, activity: Activity) -> float:
    """Largest constant squared rate within the limits."""
    ones = np.ones((5, grid.length.size))
    without = replace(activity, jerks=activity.jerks[:0])
    speeds = float(activity.speeds.max())
    others = float(without.worst(ones, grid.length).max())  # of the accelerations, or root of `speeds`
    jerks = float(activity.worst(ones, grid.length).max())
    return 1.0 / max(speeds, others if others > speeds**0.5 else 0.0, (jerks if jerks > others else 0.0) ** (2.0 / 3.0))


def on_pieces(local: Array, counts: NDArray[np.intp]) -> Array:
    """Bernstein coefficients on the pieces of divided cells."""
    degree = len(local) - 1
    points = np.linspace(0.0, 1.0, degree + 1)
    cell = np.repeat(np.arange(counts.size), counts)
    since = np.arange(cell.size) - (np.cumsum(counts) - counts)[cell]
    values = np.empty((degree + 1, cell.size))
    for count in np.unique(counts).tolist():
        for part in range(count):
            chosen = (counts[cell] == count) & (since == part)
            values[:, chosen] = bernstein((part + points) / count, degree) @ local[:, cell[chosen]]
    own: Array = np.linalg.solve(bernstein(points, degree), values)  # type: ignore[assignment]
    return own


def smooth_law(plan: Trajectory, parts: Sequence[Part], grid: Grid, local: Array) -> PiecewisePolynomial:
    """Time law of degree 9 with the rate and three of its derivatives, from the squared rate, at the ends of cells."""
    dwells = [span for part in parts if not part.moves for span in part.spans]
    places = np.append(
        plan.breakpoints[grid.segment] + grid.start, [plan.breakpoints[s.segment] + s.start for s in dwells]
    )
    lengths = np.append(grid.length, [span.length for span in dwells])
    table = np.append(local, np.ones((len(local), len(dwells))), axis=1)
    order = np.argsort(places)
    places, lengths, table = places[order], lengths[order], table[:, order]
    degree = len(table) - 1
    durations = lengths * (_WEIGHTS @ (1.0 / np.sqrt(bernstein(_NODES, degree) @ table)))
    b, slope, bend, third = (bernstein(_ENDS, degree, nu) @ table / lengths**nu for nu in range(4))
    rate = np.sqrt(b)
    ends = np.stack([np.zeros_like(rate), rate, 0.5 * slope, 0.5 * bend * rate, 0.5 * third * b + 0.25 * bend * slope])
    ends[0, 1] = np.diff(np.append(places, plan.end))  # without gaps between cells by rounding
    coefficients = _hermite(ends, durations)
    coefficients[-1] = places
    times = plan.start + np.append(0.0, np.cumsum(durations))
    return PiecewisePolynomial(times, coefficients[:, :, None], labels=["s"])


def _hermite(ends: Array, durations: Array) -> Array:
    """Coefficients (2 n, ncells), highest power first, by n derivatives (n, 2, ncells) at both ends of each cell."""
    count = len(ends)
    factorials = FACTORIALS[:count]
    scaled = ends * durations ** np.arange(count)[:, None, None] / factorials[:, None, None]
    low, high = scaled[:, 0], scaled[:, 1]
    binomials = np.array(
        [[np.prod(np.arange(k - nu + 1, k + 1)) / factorials[nu] for k in range(2 * count)] for nu in range(count)]
    )
    rest = high - binomials[:, :count] @ low
    powers = np.concatenate([low, np.linalg.solve(binomials[:, count:], rest)])
    return (powers / durations ** np.arange(2 * count)[:, None])[::-1].copy()
