"""Time law of a short duration under limits of any signals along a plan, by a sequence of linearised problems.

Signals are functions of the derivatives of the plan in time, and these of b and its
derivatives by the path parameter: s'^2 = b, s'' = b'/2, s''' = b'' s'/2,
s'''' = (b''' b + b'' b'/2)/2, and so on. They are linearised about the last solution, within a trust
region; of each solution the largest multiple is taken that satisfies the limits at
points of all cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ctrlplan.planning.path_law.bernstein import bernstein
from ctrlplan.planning.path_law.grid import Grid, Spline
from ctrlplan.planning.path_law.interior_point import Problem, minimum
from ctrlplan.planning.path_law.jerk import on_pieces, smooth_law
from ctrlplan.planning.path_law.law import problem_of
from ctrlplan.planning.path_law.positions import SHARE_INSIDE
from ctrlplan.planning.path_law.rows import Rows
from ctrlplan.planning.path_law.spans import Part, Rates, parts_of
from ctrlplan.trajectories import PiecewisePolynomial, Retimed, Trajectory
from ctrlplan.trajectories.common import FACTORIALS, Array
from ctrlplan.trajectories.retimed import composed

if TYPE_CHECKING:
    from ctrlplan.planning.limits import Limited

_POINTS: Array = np.asarray(0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 10)), dtype=float)
"""Points of a cell at which limits hold."""

_ROUNDS, _GAIN = 30, 5e-4
"""Maximum number of problems, and the decrease of the duration, relative to it, that ends them."""

_FIRST_ROUNDS = 10
"""Maximum number of problems on the first cells, whose local minimum is only the start on finer ones."""

_LOSS, _REFINEMENTS, _PIECES = 5e-3, 3, 3
"""As for limits of the acceleration; signals are at no limit while a derivative of the rate changes."""

_FINER = 1e-3
"""Decrease of the duration by finer cells, relative to it, below which they are not divided any more."""

_TRUST, _WIDEST = 2.0, 4.0
"""Trust region of the first problem, and largest one."""

_NEAR, _WORSE = 1.5, 0.05
"""Solutions are linearised about with no larger penalty, and with no larger increase of the duration."""

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

_ACCURACY = 0.1 * _RESERVE
"""Distance from the linearised limits up to which they hold."""

_TIGHTENINGS = 6
"""Maximum number of times by which limits are tightened in cells that violate them between the points."""

_ALLOWED = (1e-4, -5e-5, -1e-3)
"""Violations between the points of laws, one after the other until one satisfies the limits or is slowed to do so."""

_ROUNDING = 1e-12
"""Violation that is rounding."""

_INFEASIBLE = 0.05
"""Violation attributed to a plan that is infeasible for the plant between the points."""

_CHECKS: Array = np.linspace(0.0, 1.0, 25)
"""Points of a cell, in time, at which that is evaluated."""

_SLOWEST, _SMALL = 1e-40, 1e-6
"""Smallest multiple of a squared rate that is tried, and reciprocal of the largest one; those that are not small."""

_PENALTY = 10.0
"""Penalty of a duration, relative to it, per violation relative to the scale of a limit."""

_TINY = 1e-300
"""Smallest squared rate."""

_SCALE, _BEYOND = 1e-4, 10.0
"""Resolution of multiples of b, and the violation attributed to one that is infeasible for the plant."""

_FAR = 1e6
"""Magnitude of a missing limit, in the scale of the other one."""

HIGHEST = 5
"""Highest derivative of the plan on which signals may depend: the law has four continuous ones, the fifth jumps."""


def fast_laws_of_signals(plan: Trajectory, limited: Limited, origin: float) -> Iterator[Retimed]:
    """Plans with fast time laws, at larger and larger distances from the limits, which may be slightly violated.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    limited : Limited
        The limits, of signals that depend on at most `HIGHEST` derivatives.
    origin : float
        Start [s] of the plan before it was moved to 0.

    Yields
    ------
    Retimed
        Nothing if no multiple of the plan's rate satisfies the limits, or every one, or if
        no other rate makes it shorter.
    """
    problems = _Problems.of(plan, limited, origin, (None, None))
    scale = problems.feasible_scale()
    if not 0.0 < scale < 1.0 / _SLOWEST:
        return
    if not _SMALL < scale < 1.0 / _SMALL:  # as a plan whose rates are about 1
        pace, scale = scale**0.5, 1.0
        plan = plan.retime(plan.duration / pace)
        problems = _Problems.of(plan, limited, origin / pace, (None, None))
    allowed = (0.0,) if problems.signed else _ALLOWED
    for law in problems.laws(_START * scale, _RESERVE, allowed):
        if law.duration < (1.0 - _RESERVE) * plan.duration / scale**0.5 or problems.signed:
            yield Retimed(plan, law)


def law_with_given_ends(plan: Trajectory, limited: Limited, origin: float, reserve: float) -> Trajectory:
    """Plan with a fast time law and its own speeds at the ends; the plan itself if none is found.

    Parameters
    ----------
    plan, limited, origin
        As for `fast_laws_of_signals`.
    reserve : float
        Distance from the limits at points of the cells, relative to their scale.
    """
    problems = _Problems.of(plan, limited, origin, (1.0, 1.0))
    law = next(problems.laws(1.0, reserve, (0.0,)), None)
    return plan if law is None else Retimed(plan, law)


class _Solution(NamedTuple):
    """Coefficients of a law, and its duration [s] with a penalty of violations of the limits."""

    x: Array
    duration: float


class _Problems:
    """Linearised problems for the time law of a plan, with squared rates at its ends that may be given."""

    def __init__(self, parts: Sequence[Part], grid: Grid, limited: Limited) -> None:
        self._parts, self._grid, self._limited = parts, grid, limited
        self._spline = Spline.quartic(grid)
        self._signals, self._between = (_Signals(grid, limited, points) for points in (_POINTS, _CHECKS))

    @classmethod
    def of(cls, plan: Trajectory, limited: Limited, origin: float, given: Rates) -> _Problems:
        """Problems on the initial cells of a plan."""
        parts = parts_of(plan, True, limited.changes(plan), given, origin)
        return cls(parts, Grid.of(plan, [part for part in parts if part.moves]), limited)

    @property
    def signed(self) -> bool:
        """Whether a limit forbids a sign of a derivative."""
        return bool(self._signals.strict.any())

    def feasible_scale(self) -> float:
        """Largest squared rate, the same along the plan, that satisfies the limits at the points."""
        return self._signals.feasible_scale(np.ones((5, self._grid.length.size)), 1.0 / _SLOWEST)

    def laws(self, rate: float, reserve: float, allowed: Sequence[float]) -> Iterator[PiecewisePolynomial]:
        """Time laws near a local minimum, the finest first.

        Parameters
        ----------
        rate : float
            Squared rate of the start.
        reserve : float
            Distance from the limits at the points.
        allowed : sequence of float
            Violations between the points with which laws are returned, decreasing;
            distances from the limits are negative.
        """
        x = np.where(self._spline.fixed, 1.0, rate)
        x[self._spline.fixed] = self._grid.prescribed
        for problems, found in reversed(list(self._refined(x, reserve))):
            yield from problems._tightened(found, reserve, allowed)

    def _refined(self, x: Array, reserve: float) -> Iterator[tuple[_Problems, Array]]:
        """Local minima on finer and finer cells, with their problems."""
        problems, found, former = self, self._converged(x, self._reserves(reserve), _FIRST_ROUNDS), math.inf
        yield self, found.x
        for _ in range(_REFINEMENTS):
            local = problems._spline.coefficients(found.x)
            loss = problems._signals.losses(local)
            if loss.sum() < _LOSS or found.duration > (1.0 - _FINER) * former:
                if problems is self:  # the first cells are the last ones
                    yield self, self._converged(found.x, self._reserves(reserve)).x
                return
            counts = np.clip(np.ceil(loss / loss.mean()), 1, _PIECES).astype(int)
            counts[problems._grid.rests.any(axis=0)] = 1  # there derivatives of the law multiply rounding of the plan
            problems, former = _Problems(self._parts, problems._grid.divided(counts), self._limited), found.duration
            found = problems._converged(problems._near(on_pieces(local, counts)), problems._reserves(reserve))
            if found.duration > (1.0 + _WORSE) * former:  # not found again
                return
            yield problems, found.x

    def _reserves(self, reserve: float) -> Array:
        """The same distance from the limits in every cell."""
        return np.full(self._grid.length.size, reserve)

    def _near(self, local: Array) -> Array:
        """Coefficients of given Bernstein coefficients."""
        x = self._spline.near(local)
        x[self._spline.fixed] = self._grid.prescribed
        return x

    def _tightened(self, x: Array, reserve: float, allowed: Sequence[float]) -> Iterator[PiecewisePolynomial]:
        """Time laws near coefficients that satisfy the limits between the points as well, up to allowed violations.

        The last one, which is to be slowed, is that of the smallest violation, if tightening has failed.
        """
        reserves, nearest, least = self._reserves(reserve), None, math.inf
        for most in allowed:
            for _ in range(_TIGHTENINGS):
                law = self._time_law(x)
                excess = self._excess(law)
                if excess.max() < least:
                    nearest, least = law, float(excess.max())
                if excess.max() <= most + _ROUNDING:
                    yield law
                    break
                duration = math.inf
                if excess.min() < _INFEASIBLE:
                    reserves += 1.5 * np.maximum(excess - min(most, 0.0), 0.0)
                    x, duration = self._converged(x, reserves)
                if not math.isfinite(duration):
                    if nearest is not None and allowed[0] > 0.0 and least < _INFEASIBLE:
                        yield nearest
                    return

    def _time_law(self, x: Array) -> PiecewisePolynomial:
        return smooth_law(self._grid.plan, self._parts, self._grid, self._spline.coefficients(x))

    def _excess(self, law: PiecewisePolynomial) -> Array:
        """Maximum violation in each cell (ncells,) of a law, in the scale of the limits."""
        edges = np.searchsorted(law(law.breakpoints), self._grid.times(np.array([0.5]))[0]) - 1
        starts, durations = law.breakpoints[edges, None], np.diff(law.breakpoints)[edges, None]
        times = (starts + durations * _CHECKS).ravel()
        try:
            retimed = Retimed(self._grid.plan, law)
        except ValueError:  # a law that does not increase between the ends of a cell
            return np.full(self._grid.length.size, _INFEASIBLE)
        return self._between.excess(retimed.jet(times, self._limited.order), law(times).reshape(-1, _CHECKS.size))

    def _converged(self, x: Array, reserves: Array, rounds: int = _ROUNDS) -> _Solution:
        """Local minimum near coefficients, with a distance (ncells,) from the limits in each cell.

        Solutions are compared by their durations with a penalty of violations of the limits.
        """
        best, duration, trust, solved = x, math.inf, _TRUST, False
        for _ in range(rounds):
            try:
                rows = self._signals.rows(self._spline.coefficients(x), reserves)
                problem = replace(problem_of(self._grid, self._spline, rows), trust=trust, accuracy=_ACCURACY)
                tried = self._minimum(problem, x)
            except ValueError:  # the linearised limits cannot be satisfied near this solution
                x, trust = best, trust**0.4 if solved else 4.0 * trust
                if not 1.001 < trust < _FARTHEST:
                    break
                continue
            beyond, own, solved = self._signals.beyond(self._spline.coefficients(tried)), problem.duration(tried), True
            if math.isinf(beyond) and math.isinf(duration):  # infeasible for the plant
                trust **= 0.5
                continue
            penalty = 1.0 + _PENALTY * max(beyond, 0.0)
            promised, gain = 1.0 - own / duration, 1.0 - own * penalty / duration
            changed = abs(own / problem.duration(x) - 1.0)
            if gain > 0.0:
                best, duration = tried, own * penalty
            if (penalty < 1.0 + _GAIN and changed < _GAIN and trust > _SETTLED) or trust < 1.001:
                break
            x = tried if penalty < _NEAR and gain > -_WORSE else best
            trust = (
                min(trust**2, _WIDEST) if gain > 0.75 * promised else trust if gain > 0.25 * promised else trust**0.5
            )
        return _Solution(best, duration)

    def _minimum(self, problem: Problem, x: Array) -> Array:
        """Solution of a linearised problem.

        With given ends and a start that violates the limits, one with small excesses if there is none.
        """
        try:
            return minimum(problem, x)
        except ValueError:
            if not (self._grid.prescribed.any() and self._signals.beyond(self._spline.coefficients(x)) > 0.0):
                raise
        return minimum(replace(problem, price=problem.duration(x)), x)


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
        self._speeds = np.array([bound.order <= 1 for bound in bounds])[:, None] & self._at_given_speeds()
        self.strict, self._slack = strict, slack
        sides = self._given_sides(grid.times(points).T)
        self._low, self._high = self._finite(*sides)
        ramp = (grid.length / grid.length.max()).repeat(points.size)
        self._low_share, self._high_share = (np.where(strict & (side == 0.0), ramp, 1.0) for side in sides)

    def _given_sides(self, places: Array) -> tuple[Array, Array]:
        """Limits (nbounds, npoints), in their scale, at times (ncells, npoints) [s] of the plan in all cells."""
        grid = self._grid
        begin, length = (grid.plan.breakpoints[grid.segment] + grid.start)[:, None], grid.length[:, None]
        inside = np.clip(places, begin + SHARE_INSIDE * length, begin + (1.0 - SHARE_INSIDE) * length).ravel()
        bounds = [self._limited.bounds[k] for k in self._moving]
        low, high = np.array([self._limited.sides(bound, grid.plan, inside) for bound in bounds]).swapaxes(0, 1)
        return low / self._scales, high / self._scales

    def _finite(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Such limits, finite and with slack where they are attained at rest."""
        return (
            np.where(self._speeds, -_FAR, np.maximum(low, -_FAR) - self._slack),
            np.where(self._speeds, _FAR, np.minimum(high, _FAR) + self._slack),
        )

    def _at_rest(self) -> NDArray[np.bool_]:
        """Points (npoints,) at which the plan is at rest."""
        found = np.zeros((self._grid.length.size, self._points.size), dtype=bool)
        found[:, 0], found[:, -1] = self._grid.rests
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
            return min(self._beyond(scale * derivatives, signed=False), _BEYOND)

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

    def excess(self, jet: Array, places: Array) -> Array:
        """Maximum violation in each cell (ncells,), in the scale of the limits, by the jets of a law at its points.

        `places` (ncells, npoints) are the times [s] of the plan at which limits apply.
        """
        try:
            values = self._limited.values(jet)[self._moving] / self._scales
        except ValueError:  # infeasible for the plant
            return np.full(self._grid.length.size, _INFEASIBLE)
        low, high = (self._low, self._high) if self._limited.is_constant else self._finite(*self._given_sides(places))
        beyond = np.concatenate([values - high, low - values])
        return _peaks(beyond.reshape(len(beyond), -1, self._points.size)).max(axis=0)

    def losses(self, local: Array) -> Array:
        """Distance of each cell (ncells,) from the nearest limit, weighted by its part of the duration."""
        derivatives, shape = self._derivatives(local), (self._grid.length.size, self._points.size)
        values = self._values(derivatives)
        distance = np.clip(np.minimum(self._high - values, values - self._low).min(axis=0), 0.0, 1.0).reshape(shape)
        durations = (1.0 / np.sqrt(np.maximum(derivatives[0], _TINY))).reshape(shape) * self._grid.length[:, None]
        return (distance * durations).mean(axis=1) / durations.mean(axis=1).sum()

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
        rate = np.sqrt(np.maximum(b, _TINY))
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
        """Maximum violation with half the reserve, of limits that forbid a sign if `signed`; inf if infeasible."""
        try:
            values = self._values(derivatives)
        except ValueError:  # infeasible for the plant
            return math.inf
        reserve = 0.5 * _RESERVE
        excess = np.maximum(
            values - self._high + reserve * self._high_share, self._low - values + reserve * self._low_share
        )
        return float(excess[signed | ~self.strict[:, 0]].max(initial=-_BEYOND))


def _peaks(values: Array) -> Array:
    """Maxima (...) of evenly spaced samples (..., npoints) and of the parabolas through three of them."""
    before, inner, after = values[..., :-2], values[..., 1:-1], values[..., 2:]
    bend, slope = before - 2.0 * inner + after, after - before
    # Without a limit at one of them they are no parabola.
    inside = (np.abs(slope) < -2.0 * bend) & (np.minimum(before, after) > -1.0)
    vertices = np.where(inside, inner - slope**2 / np.where(inside, 8.0 * bend, 1.0), inner)
    peaks: Array = np.maximum(vertices.max(axis=-1), values.max(axis=-1))
    return peaks
