"""Time law of a short duration under limits of any signals along a plan, by a sequence of linearised problems.

Signals are functions of the derivatives of the plan in time, and these of b and its
derivatives by the path parameter: s'^2 = b, s'' = b'/2, s''' = b'' s'/2,
s'''' = (b''' b + b'' b'/2)/2, and so on. They are linearised about the last solution, within a trust
region; of each solution the largest multiple is taken that satisfies the limits at
points of all cells.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ctrlplan.planning.path_law.bernstein import bernstein
from ctrlplan.planning.path_law.grid import Grid, Spline
from ctrlplan.planning.path_law.interior_point import minimum
from ctrlplan.planning.path_law.jerk import smooth_law
from ctrlplan.planning.path_law.law import problem_of
from ctrlplan.planning.path_law.rows import Rows
from ctrlplan.planning.path_law.spans import Rates, parts_of
from ctrlplan.trajectories import Retimed, Trajectory
from ctrlplan.trajectories.common import FACTORIALS, Array
from ctrlplan.trajectories.retimed import composed

if TYPE_CHECKING:
    from ctrlplan.planning.limits import Limited

_POINTS: Array = np.asarray(0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 10)), dtype=float)
"""Points of a cell at which limits hold."""

_ROUNDS, _GAIN = 30, 5e-4
"""Maximum number of problems, and the decrease of the duration, relative to it, that ends them."""

_NEAR, _WORSE = 0.5, 0.05
"""Solutions are linearised about that need to be slowed down in b, or in their duration, by no more than that."""

_FARTHEST = 1e4
"""Largest trust region, in which a first solution is found for a plan that violates the limits."""

_SETTLED = 1.2
"""Trust region with which a solution that does not change is a local minimum."""

_START = 0.95
"""Squared rate of the start relative to the largest constant one."""

_STEP = 1e-6
"""Step of the differences by which signals are linearised, relative to the size of b."""

_RESERVE = 1e-4
"""Distance from limits, relative to their scale, for points between those of the cells."""

_TIGHTENINGS, _BETWEEN = 6, 3e-4
"""Maximum number of times by which limits are tightened in cells that violate them by so much between the points."""

_INFEASIBLE = 0.05
"""Violation attributed to a plan that is infeasible for the plant between the points."""

_CHECKS: Array = np.asarray((np.arange(24) + 0.5) / 24.0, dtype=float)
"""Points at which that is evaluated."""

_SLOWEST = 1e-12
"""Smallest multiple of a squared rate that is tried, and reciprocal of the largest one."""

_PENALTY = 10.0
"""Increase of a duration relative to the maximum violation, where a law cannot be slowed down."""

_SCALE, _BEYOND = 1e-4, 10.0
"""Resolution of multiples of b, and the violation attributed to one that is infeasible for the plant."""

_FAR = 1e6
"""Magnitude of a missing limit, in the scale of the other one."""

HIGHEST = 5
"""Highest derivative of the plan on which signals may depend: the law has four continuous ones, the fifth jumps."""


def fast_law_of_signals(plan: Trajectory, limited: Limited, origin: float) -> Retimed | None:
    """Plan with a fast time law; limits may be slightly violated between points of the cells.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    limited : Limited
        The limits, of signals that depend on at most `HIGHEST` derivatives.
    origin : float
        Start [s] of the plan before it was moved to 0.

    Returns
    -------
    Retimed, or None
        None if no multiple of the plan's rate satisfies the limits, or every one, or if
        no other rate makes it shorter.
    """
    problems = _Problems(plan, limited, origin, (None, None))
    scale = problems.feasible_scale()
    if not 0.0 < scale < 1.0 / _SLOWEST:
        return None
    law = problems.law(_START * scale, _RESERVE, 0.0 if problems.signed else _BETWEEN)
    faster = law.duration < (1.0 - _RESERVE) * plan.duration / scale**0.5
    return Retimed(plan, law) if faster or problems.signed else None


def law_with_given_ends(plan: Trajectory, limited: Limited, origin: float, reserve: float) -> Trajectory:
    """Plan with a fast time law and its own speeds at the ends; limits may be violated if none is found.

    Parameters
    ----------
    plan, limited, origin
        As for `fast_law_of_signals`.
    reserve : float
        Distance from the limits at points of the cells, relative to their scale.
    """
    return Retimed(plan, _Problems(plan, limited, origin, (1.0, 1.0)).law(1.0, reserve, 0.0))


class _Problems:
    """Linearised problems for the time law of a plan, with squared rates at its ends that may be given."""

    def __init__(self, plan: Trajectory, limited: Limited, origin: float, given: Rates) -> None:
        self._parts = parts_of(plan, True, (), given, origin)
        self._grid = Grid.of(plan, [part for part in self._parts if part.moves])
        self._spline = Spline.quartic(self._grid)
        self._signals, self._between = (_Signals(self._grid, limited, points) for points in (_POINTS, _CHECKS))

    @property
    def signed(self) -> bool:
        """Whether a limit forbids a sign of a derivative."""
        return bool(self._signals.strict.any())

    def feasible_scale(self) -> float:
        """Largest squared rate, the same along the plan, that satisfies the limits at the points."""
        return self._signals.feasible_scale(np.ones((5, self._grid.length.size)), 1.0 / _SLOWEST)

    def law(self, rate: float, reserve: float, between: float) -> Trajectory:
        """Time law near a local minimum.

        Parameters
        ----------
        rate : float
            Squared rate of the start.
        reserve : float
            Distance from the limits at the points.
        between : float
            Violation between them below which limits are not tightened.
        """
        x = np.where(self._spline.fixed, 1.0, rate)
        x[self._spline.fixed] = self._grid.prescribed
        reserves = np.full(self._grid.length.size, reserve)
        for _ in range(_TIGHTENINGS + 1):
            x = self._converged(x, reserves)
            excess = self._between.excess(self._spline.coefficients(x))
            if excess.max() <= between:
                break
            reserves += 1.5 * np.maximum(excess, 0.0)
        return smooth_law(self._grid.plan, self._parts, self._grid, self._spline.coefficients(x))

    def _converged(self, x: Array, reserves: Array) -> Array:
        """Coefficients near a local minimum, with a distance (ncells,) from the limits in each cell."""
        best, duration, trust = x, np.inf, 2.0
        for _ in range(_ROUNDS):
            try:
                rows = self._signals.rows(self._spline.coefficients(x), reserves)
                problem = replace(problem_of(self._grid, self._spline, rows), trust=trust)
                tried = minimum(problem, x)
            except ValueError:  # the linearised limits cannot be satisfied near this solution
                x, trust = best, trust**0.4 if math.isfinite(duration) else 4.0 * trust
                if not 1.001 < trust < _FARTHEST:
                    break
                continue
            scale, feasible = self._slowed(tried)
            promised = 1.0 - problem.duration(tried) / duration
            gain = 1.0 - problem.duration(tried) / scale**0.5 / duration
            if gain > 0.0:
                best, duration = feasible, problem.duration(tried) / scale**0.5
            if (scale > 1.0 - _GAIN and abs(gain) < _GAIN and trust > _SETTLED) or trust < 1.001:
                break
            x = tried if scale > _NEAR and gain > -_WORSE else best
            trust = min(2.0 * trust, 4.0) if gain > 0.75 * promised else trust if gain > 0.25 * promised else trust**0.5
        return best

    def _slowed(self, x: Array) -> tuple[float, Array]:
        """Factor of a squared rate with which it satisfies the limits, and the product.

        With given rates at the ends, and with limits that forbid a sign, there is no such
        factor; that of the duration is a penalty.
        """
        local = self._spline.coefficients(x)
        if self._spline.fixed.any() or self._signals.strict.any():
            return (1.0 + _PENALTY * max(self._signals.beyond(local), 0.0)) ** -2.0, x
        scale = self._signals.feasible_scale(local)
        return scale, scale * x


class _Signals:
    """Limited signals at points of the cells of a grid."""

    def __init__(self, grid: Grid, limited: Limited, points: Array) -> None:
        self._grid, self._limited, self._points = grid, limited, points
        self._order = max(limited.order, 1)
        times = (grid.start[:, None] + grid.length[:, None] * points).ravel()
        jet = grid.plan.segments_jet(np.repeat(grid.segment, points.size), times, self._order)
        self._path = list(jet / FACTORIALS[: self._order + 1, None, None])
        # Limits of positions do not depend on the time law.
        self._moving = [k for k, bound in enumerate(limited.bounds) if bound.axis is None or bound.order > 0]
        bounds = [limited.bounds[k] for k in self._moving]
        self._scales = np.array([bound.scale for bound in bounds])[:, None]
        # A limit that is attained at rest has no reserve there; of a derivative, one that increases from there.
        strict = np.array([bound.axis is not None and bound.slack > 0.0 for bound in bounds])[:, None]
        slack = np.array([bound.slack + 2.0 * _RESERVE if bound.slack else 0.0 for bound in bounds])[:, None]
        slack = np.where(strict, np.where(self._at_rest(), _FAR, 0.0), slack)
        low, high = (np.array([[getattr(bound, side)] for bound in bounds]) for side in ("low", "high"))
        ramp = (grid.length / grid.length.max()).repeat(points.size)
        self._low_share, self._high_share = (np.where(strict & (side == 0.0), ramp, 1.0) for side in (low, high))
        self.strict = strict
        speeds = np.array([bound.order <= 1 for bound in bounds])[:, None] & self._at_given_speeds()
        self._low = np.where(speeds, -_FAR, np.maximum(low / self._scales, -_FAR) - slack)
        self._high = np.where(speeds, _FAR, np.minimum(high / self._scales, _FAR) + slack)

    def _at_rest(self) -> NDArray[np.bool_]:
        """Points (npoints,) at which the plan is at rest."""
        found = np.zeros((self._grid.length.size, self._points.size), dtype=bool)
        firsts = np.flatnonzero(np.diff(self._grid.part, prepend=-1))
        for part, begin, end in zip(self._grid.parts, firsts, [*firsts[1:], len(found)], strict=True):
            found[begin, 0] = part.spans[0].rests[0] > 0.0
            found[end - 1, -1] = part.spans[-1].rests[1] > 0.0
        return found.ravel()

    def _at_given_speeds(self) -> NDArray[np.bool_]:
        """Points (npoints,) at which the rate is given."""
        found = np.zeros((self._grid.length.size, self._points.size), dtype=bool)
        first, last = self._grid.ends(moving=True)
        found[first, 0], found[last, -1] = self._points[0] == 0.0, self._points[-1] == 1.0
        return found.ravel()

    def feasible_scale(self, local: Array, largest: float = 1.0) -> float:
        """Largest multiple of a squared rate that satisfies the limits at the points, to `_SCALE`; 0 for none.

        Limits that forbid a sign of a derivative do not depend on it.
        """
        derivatives = self._derivatives(local)

        def beyond(scale: float) -> float:
            return self._beyond(scale * derivatives, signed=False)

        low = high = 1.0
        while high < largest and beyond(high) <= 0.0:
            low, high = high, 4.0 * high
        if high >= largest and beyond(largest) <= 0.0:
            return largest
        while beyond(low) > 0.0:
            low, high = 0.25 * low, low
            if low < _SLOWEST:
                return 0.0
        scale = float(brentq(beyond, low, high, xtol=_SCALE * low, rtol=_SCALE))
        while beyond(scale) > 0.0:
            scale *= 1.0 - 2.0 * _SCALE
        return scale

    def beyond(self, local: Array) -> float:
        """Maximum violation at the points with half the reserve, in the scale of the limits."""
        return self._beyond(self._derivatives(local))

    def excess(self, local: Array) -> Array:
        """Maximum violation in each cell (ncells,), in the scale of the limits."""
        try:
            values = self._values(self._derivatives(local))
        except ValueError:  # infeasible for the plant
            return np.full(self._grid.length.size, _INFEASIBLE)
        beyond = np.maximum(values - self._high, self._low - values)
        return beyond.reshape(len(values), -1, self._points.size).max(axis=(0, 2))

    def rows(self, local: Array, reserve: Array) -> Rows:
        """Inequalities of the linearised signals for the Bernstein coefficients of the cells."""
        derivatives, length = self._derivatives(local), self._grid.length
        steps = _STEP * np.abs(derivatives[0]) / length.repeat(self._points.size) ** np.arange(self._order)[:, None]
        moved = np.repeat(derivatives[:, None], self._order + 1, axis=1)
        moved[np.arange(self._order), np.arange(1, self._order + 1)] += steps
        values, *ahead = self._values(moved).swapaxes(0, 1)
        slopes = (np.stack(ahead) - values) / steps[:, None]
        constant = values - (slopes * derivatives[:, None]).sum(axis=0)
        shape = (len(values), length.size, self._points.size)
        factors = sum(
            slope.reshape(shape)[..., None] * bernstein(self._points, len(local) - 1, nu) / length[:, None, None] ** nu
            for nu, slope in enumerate(slopes)
        )
        order = (0, 2, 1)
        upper, lower = (
            (side - constant - sign * reserve.repeat(self._points.size) * share)
            .reshape(shape)
            .transpose(order)
            .reshape(-1, length.size)
            for side, sign, share in ((self._high, 1.0, self._high_share), (self._low, -1.0, self._low_share))
        )
        rows = np.asarray(factors).transpose(0, 2, 1, 3).reshape(len(upper), length.size, -1)
        return Rows(rows, upper, lower)

    def _derivatives(self, local: Array) -> Array:
        """B and its derivatives (order, npoints) at the points of all cells, by Bernstein coefficients."""
        degree, h = len(local) - 1, self._grid.length
        found = [(bernstein(self._points, degree, nu) @ local / h**nu).T.ravel() for nu in range(self._order)]
        return np.stack(found)

    def _values(self, derivatives: Array) -> Array:
        """Signals (nbounds, ..., npoints) in the scale of their limits, by derivatives (order, ..., npoints) of b."""
        shape = derivatives.shape[1:]
        b, slope, bend, third, fourth = np.concatenate([derivatives, np.zeros((HIGHEST - self._order, *shape))])
        rate = np.sqrt(np.maximum(b, 1e-300))
        series = [
            rate,
            slope / 4.0,
            bend * rate / 12.0,
            (third * b + 0.5 * bend * slope) / 48.0,
            (fourth * b + 1.5 * third * slope + 0.5 * bend**2) * rate / 240.0,
        ][: self._order]
        path = [row.reshape(len(row), *np.ones(len(shape) - 1, dtype=int), -1) for row in self._path]
        rows = [np.broadcast_to(row, (len(row), *shape)) for row in composed(path, series)]
        jet = np.stack(rows).reshape(len(rows), len(path[0]), -1) * FACTORIALS[: self._order + 1, None, None]
        return (self._limited.values(jet)[self._moving] / self._scales).reshape(-1, *shape)

    def _beyond(self, derivatives: Array, signed: bool = True) -> float:
        """Maximum violation with half the reserve, up to `_BEYOND`; also, if `signed`, of limits that forbid a sign."""
        try:
            values = self._values(derivatives)
        except ValueError:  # infeasible for the plant
            return _BEYOND
        reserve = 0.5 * _RESERVE
        excess = np.maximum(
            values - self._high + reserve * self._high_share, self._low - values + reserve * self._low_share
        )
        return min(float(excess[signed | ~self.strict[:, 0]].max(initial=-_BEYOND)), _BEYOND)
