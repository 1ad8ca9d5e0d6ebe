r"""Optimisation of free entries of waypoints by least squares.

A plan is linear in its data, so its cost is a sum of squares of samples,

.. math:: J = \int (y^{(k)})^2\,dt = |A d|^2, \qquad
    d_{free} = -A_{free}^{+} A_{fixed}\,d_{fixed}

with samples at the nodes of a Gauss-Legendre rule that is exact to rounding.
Times are relative to the duration and derivatives scaled accordingly, so that
the accuracy does not depend on the duration. The cost of one segment of relative duration h is
:math:`h^{1-2k} |R H d|^2` with the matrix R of the unit segment and H the powers of h
that scale derivatives: segments share one factorised system.

Times are optimised over the optimum at given times. There the cost is stationary
in the free entries, so that its gradient depends on the prescribed ones only.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import blas, qr
from scipy.optimize import OptimizeResult, minimize

from ctrlplan._checks import checked_count, checked_finite, checked_labels
from ctrlplan._display import Displayed, Facts, Figure, Part, counted, number, title_of
from ctrlplan.trajectories import Joined, PiecewiseSpline, PolySpline, Trajectory, TrigSpline, Waypoint
from ctrlplan.trajectories.chosen import checked_alpha
from ctrlplan.trajectories.common import FACTORIALS, Array, readonly, times_powers
from ctrlplan.trajectories.conjugate import FreeEntries, FreePattern
from ctrlplan.trajectories.newton import NewtonSystem
from ctrlplan.trajectories.piecewise_fit import alike
from ctrlplan.trajectories.quadrature import gauss
from ctrlplan.trajectories.waypoint import Entries, entry_name, waypoint_table
from ctrlplan.trajectories.waypoint_spline import checked_waypoints

from .chain import chain_least_squares

_EPS = float(np.finfo(float).eps)
_LIMITED_MEMORY = {"maxcor": 30, "gtol": 1e-7, "ftol": 1e-14, "maxiter": 10_000, "maxfun": 20_000}
"""Options of the minimisation over times."""

_NEAR = 0.1
"""Relative difference of the durations below which a search that costs more has reached a known minimum."""

_FEW, _NONE = 1e-6, 1e-2  # estimated relative error of the cost above which a warning, an error is raised


@dataclass(frozen=True, repr=False)
class Optimum(Displayed):
    """Optimum waypoints, and the plan through them.

    Iteration gives the waypoints.

    Attributes
    ----------
    waypoints : tuple of Waypoint
        Complete up to the order of the plan; nan for an entry that was free on
        each side separately.
    plan : Trajectory
        A spline for `single`; a `PiecewiseSpline` if all entries up to the
        order are continuous; otherwise a sequence of segments (`Joined`).
    cost : float
        Weighted sum over the axes of int (y^(derivative))^2 dt within the segments.
    unique : bool
        Whether the optimum is unique.
    derivative : int
        Order of the derivative in the cost.
    """

    waypoints: tuple[Waypoint, ...]
    plan: Trajectory
    cost: float
    unique: bool
    derivative: int

    def __iter__(self) -> Iterator[Waypoint]:
        return iter(self.waypoints)

    def __len__(self) -> int:
        return len(self.waypoints)

    def _describe(self) -> Iterator[Part]:
        note = "" if self.unique else ", not unique"
        cost = f"integral of the squared {entry_name(self.derivative)}"
        yield f"Optimum of {counted(len(self), 'waypoint')}: {cost} {self.cost:.6g}{note}"
        yield Facts(
            [
                (cost, number(self.cost)),
                ("unique", "yes" if self.unique else "no"),
                ("plan", title_of(self.plan)),
            ]
        )
        yield waypoint_table(self.waypoints, self.plan.labels)
        yield Figure("Position and velocity of the plan over time.", 2, lambda axes: self.plan.plot(ax=axes))


def optimize_waypoints(
    waypoints: Iterable[Waypoint],
    derivative: int = 3,
    *,
    order: int | None = None,
    single: bool = False,
    alpha: float = 0.0,
    continuity: int | None = None,
    free_times: bool = False,
    weights: ArrayLike | None = None,
    labels: Sequence[str] | None = None,
) -> Optimum:
    """Free entries and times that minimise a squared derivative.

    Free entries of the waypoints up to `order` are computed in closed form to
    minimise the integral of the squared derivative: minimum jerk, minimum snap.
    If the optimum is not unique (two positions alone leave a quadratic free
    under minimum jerk), it is that of minimum norm, of entries in units of the
    plan's duration, and `Optimum.unique` is False.

    Parameters
    ----------
    waypoints : iterable of Waypoint
        Two or more, times increasing; entries that are missing or nan are free,
        including positions.
    derivative : int, optional
        Order of the derivative in the cost, from 1: 3 is minimum jerk, 4
        minimum snap.
    order : int, optional
        Highest order of the entries; default: derivative - 1, or the
        continuity if higher. Prescribed entries above it increase it.
    single : bool, optional
        One spline through all waypoints instead of one per segment.
    alpha : float, optional
        Shape parameter in [0, 2 pi) [rad] of the spline or of every segment; 0 gives
        polynomials.
    continuity : int, optional
        Highest derivative that is continuous at inner waypoints; default:
        `order`. Above it free entries are free on each side separately and may
        jump, without a contribution to the cost; prescribed ones apply to both
        sides.
    free_times : bool, optional
        Optimise the times of inner waypoints as well. Prescribed derivatives are
        preserved, and no segment becomes shorter than 1e-4 of the mean duration
        or half the shortest given one, or so short that the cost is not resolved
        in double precision. The result is the best of several local
        minima, at least as good as the given times.
    weights : array_like, shape (naxes,), optional
        Weights of the axes in the cost, above 0.
    labels : sequence of str, optional
        Names of the axes.

    Returns
    -------
    Optimum
        With the attributes waypoints, plan, cost, unique and derivative.

    Raises
    ------
    ValueError
        If an argument is out of range, times do not increase, axes differ, the
        order is below the continuity, or an axis has no prescribed entry; if the
        estimated relative error of the cost is above 1e-2, because waypoints are
        too near in time or too far from the origin.

    Warns
    -----
    UserWarning
        If the estimated relative error of the cost is above 1e-6. It grows with
        the power 2 `derivative` - 1 of the ratio between the mean and the
        shortest segment.

    Examples
    --------
    A rest-to-rest move through a point, with optimum velocity and acceleration there:

    >>> best = optimize_waypoints([Waypoint(0, 0, 0, 0), Waypoint(1, 1), Waypoint(2, 0, 0, 0)])
    >>> best.waypoints[1].acceleration.round(6).tolist(), round(best.cost, 6)
    ([-6.666667], 640.0)

    The optimum time of a waypoint in the middle of a move is the middle of its duration:

    >>> points = [Waypoint(0, 0, 0, 0), Waypoint(0.5, 1), Waypoint(4, 2, 0, 0)]
    >>> round(optimize_waypoints(points, free_times=True).waypoints[1].time, 6)
    2.0
    """
    points = checked_waypoints(waypoints)
    given = Entries.of(points)
    derivative = checked_count(derivative, "derivative", 1)
    alpha = checked_alpha(alpha)
    naxes = points[0].naxes
    names = points[0].labels if labels is None else checked_labels(labels, naxes)
    order, continuity = _checked_orders(given.table, derivative, order, continuity, single)
    factors = _checked_weights(weights, naxes)

    times = given.times
    start, duration = points[0].time, checked_finite(points[-1].time - points[0].time, "duration", above=0.0)
    relative = np.diff(times) / duration
    table = np.full((len(points), order + 1, naxes), np.nan)
    rows = min(order + 1, given.table.shape[1])
    table[:, :rows] = given.table[:, :rows]
    if np.isnan(table).all(axis=(0, 1)).any():
        raise ValueError("every axis must have a prescribed entry, got an axis with none")
    unit = times_powers(np.ones((order + 1, 1)), duration, np.arange(order + 1)[:, None])
    problem = _Problem(table * unit, continuity, alpha, derivative, single)
    found = problem.solve(relative)
    cost = _cost(found, factors, duration, derivative)
    if free_times and len(points) > 2:
        chosen = start + duration * _times(_resolved_durations(problem, relative, found, factors))
        chosen[[0, -1]] = times[[0, -1]]
        better = problem.solve(np.diff(chosen) / duration)
        if better.cost @ factors < found.cost @ factors:
            found, times = better, chosen
            cost = _cost(found, factors, duration, derivative)
    error = _relative_error(problem, np.diff(times) / duration, found)
    if error > _FEW and problem.is_minimal() and problem.has_digits(np.diff(times) / duration):
        return _resolved(Entries(times, readonly(table), np.full(len(points), order + 1), names), derivative, factors)
    _check_digits(problem, error, times)

    # Prescribed entries are exact.
    sides = np.where(np.isnan(table), np.stack([side.T for side in found.sides]) / unit, table)
    split, count = problem.split(), np.full(len(points), order + 1)
    before, after = (Entries(readonly(times), readonly(side), count, names) for side in sides)
    plan: Trajectory
    if single or split.any():
        left, right = before.waypoints(), after.waypoints()
        parts = [right] if single else list(zip(right[:-1], left[1:], strict=True))
        # The range of joined segments was compared with their own ends only.
        splines = [TrigSpline(p, alpha=alpha, warn=single) if alpha else PolySpline(p, warn=single) for p in parts]
        plan = splines[0] if single else Joined.without_shift(splines)
    else:
        plan = PiecewiseSpline.of_entries(after, alpha)
    shared = readonly(np.where(split, np.nan, sides[1]))
    chosen_points = Entries(times, shared, count, names).waypoints()
    return Optimum(chosen_points, plan, cost, found.unique, derivative)


def _resolved(entries: Entries, derivative: int, factors: Array) -> Optimum:
    """Optimum with short segments: the spline with continuous conjugates, which has all digits of its entries."""
    plan = PiecewiseSpline.of_entries(entries)
    nodes, weights = gauss(derivative + 1)
    costs = [
        duration * (plan.segment_jet(k, duration * nodes, derivative)[derivative] ** 2 @ weights)
        for k, duration in enumerate(np.diff(plan.breakpoints).tolist())
    ]
    size = entries.table.shape[1]
    jets = plan.jet(entries.times, size - 1).transpose(2, 0, 1)
    filled = np.where(np.isnan(entries.table), jets, entries.table)
    points = Entries(entries.times, readonly(filled), entries.counts, entries.labels).waypoints()
    return Optimum(points, plan, float(np.sum(costs, axis=0) @ factors), True, derivative)


def _cost(found: _Solution, factors: Array, duration: float, derivative: int) -> float:
    """Cost in the units of the plan."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        cost = float(found.cost @ factors * np.float64(duration) ** (1 - 2 * derivative))
    if not math.isfinite(cost):
        raise ValueError(
            f"the cost must stay within floating point, got an overflow for entries over {duration:g} s; "
            "choose other units"
        )
    return cost


def _relative_error(problem: _Problem, durations: Array, found: _Solution) -> float:
    """Estimated relative error of the cost by rounding of the data."""
    position, higher = problem.table[:, 0], np.nan_to_num(problem.table[:, 1:])
    size = np.nanmax(np.abs(position), axis=0, initial=0.0)
    ranges = np.nanmax(position, axis=0, initial=-np.inf) - np.nanmin(position, axis=0, initial=np.inf)
    ranges[ranges <= 4.0 * _EPS * size] = 0.0  # equal up to rounding
    data = ranges**2 + (higher**2).sum(axis=(0, 1))
    # A cost of 0 is attained up to rounding, relative to that of other plans through similar data.
    floor = np.maximum(found.cost, 1e-6 * data)
    return float(np.divide(problem.rounding(durations, found), floor, where=data > 0.0, out=0.0 * data).max())


def _check_digits(problem: _Problem, error: float, times: Array) -> None:
    """Warn or raise if rounding of the data causes a large error of the cost."""
    if not error > _FEW:
        return
    size = np.nanmax(np.abs(problem.table[:, 0]), axis=0, initial=0.0)
    steps = np.diff(times)
    k = int(steps.argmin())
    several = problem.family is _Segments
    way = "merge waypoints, or use an origin nearer to the positions"
    why = (
        f"an estimated relative error of {error:.1g}: positions up to {size.max():.3g} have 16 digits, "
        f"{'' if several else f'one spline has all {len(times)} waypoints, '}and "
        f"the time from waypoints[{k}] to [{k + 1}] is {steps[k] / steps.mean():.2g} of the mean segment; "
        f"{way if several else f'use one spline for each segment (single=False), {way}'}"
    )
    if error > _NONE:
        raise ValueError(f"the cost must be resolved in double precision, got {why}")
    warnings.warn(f"the optimum is inaccurate, with {why}", stacklevel=3)


class _Solution(NamedTuple):
    """Optimum at given times, in units of the duration."""

    sides: tuple[Array, Array]  # entries (naxes, order + 1, nwaypoints) to the left and right of each waypoint
    cost: Array  # (naxes,)
    slope: Array  # of the cost along the durations, shape (naxes, nsegments)
    unique: bool


class _Group(NamedTuple):
    """Axes with the same prescribed entries."""

    axes: NDArray[np.intp]
    known: NDArray[np.bool_]  # (nwaypoints, order + 1)
    rows: Array  # entries (naxes, order + 1, nwaypoints)
    loose: NDArray[np.bool_]  # need not be continuous if free, (nwaypoints, order + 1)
    pattern: FreePattern | None  # of equations in linear time, where these exist


class _Problem:
    """Data of the optimisation that do not depend on the times."""

    def __init__(self, table: Array, continuity: int, alpha: float, derivative: int, single: bool) -> None:
        self.table, self.rows = table, np.ascontiguousarray(table.T)
        self.family = _Whole if single else _Segments
        self.shape = (alpha, table.shape[1] - 1, derivative)
        self.loose = np.zeros(table.shape[:2], dtype=bool)  # need not be continuous if free
        self.loose[1:-1, continuity + 1 :] = not single
        known = ~np.isnan(table)
        self.groups = [self._group(np.array(axes), known[:, :, axes[0]], self.rows) for axes in alike(known)]

    def _group(self, axes: NDArray[np.intp], known: NDArray[np.bool_], rows: Array) -> _Group:
        pattern = None
        if self.has_conjugates() and not known.all() and not (self.loose & ~known).any():
            pattern = FreePattern(0.0, known, False, natural=True)
        return _Group(axes, known, rows[axes], self.loose, pattern)

    def has_conjugates(self) -> bool:
        """Whether an optimum with continuous entries is a spline of continuous conjugates."""
        alpha, order, derivative = self.shape
        return order == derivative - 1 and not alpha and self.family is _Segments

    def is_minimal(self) -> bool:
        """Whether the optimum is a spline of continuous conjugates with complete entries at both ends."""
        return self.has_conjugates() and not np.isnan(self.table[[0, -1]]).any() and not self.split().any()

    def has_digits(self, durations: Array) -> bool:
        """Whether rounding of the positions changes no slope over a segment much, relative to that over the plan."""
        position = self.table[:, 0]
        ranges = np.nanmax(position, axis=0, initial=-np.inf) - np.nanmin(position, axis=0, initial=np.inf)
        rounding = _EPS * np.nanmax(np.abs(position), axis=0, initial=0.0)
        return bool((rounding <= _FEW * float(durations.min()) * ranges).all())

    def split(self) -> NDArray[np.bool_]:
        """Entries that are free on each side separately, shape (nwaypoints, order + 1, naxes)."""
        return np.isnan(self.table) & self.loose[:, :, None]

    def solve(self, durations: Array, estimate: bool = False) -> _Solution:
        """Minimum cost at relative durations; an estimate for a search has about nine digits."""
        with np.errstate(over="ignore", invalid="ignore"):
            family = self.family(durations, *self.shape)
            found = [family.solve(group, estimate) for group in self.groups]
        if len(found) == 1:
            return found[0]
        naxes, _, count = self.rows.shape
        sides, cost, slope = np.empty((2, *self.rows.shape)), np.empty(naxes), np.empty((naxes, count - 1))
        for group, part in zip(self.groups, found, strict=True):
            sides[:, group.axes], cost[group.axes], slope[group.axes] = part.sides, part.cost, part.slope
        return _Solution((sides[0], sides[1]), cost, slope, all(part.unique for part in found))

    def rounding(self, durations: Array, found: _Solution) -> Array:
        """Estimate (naxes,) of the error of the cost."""
        return self.family(durations, *self.shape).rounding(found)

    def scale(self, durations: Array) -> Array:
        """Cost (naxes,) of entries of these magnitudes without cancellation: free ones 0, alternating signs."""
        entries = np.abs(np.nan_to_num(self.rows))
        entries[:, :, 1::2] *= -1.0
        group = self._group(np.arange(len(entries)), np.ones(self.table.shape[:2], dtype=bool), entries)
        return self.family(durations, *self.shape).solve(group).cost


class _Segments:
    """One spline per segment."""

    def __init__(self, durations: Array, alpha: float, order: int, derivative: int) -> None:
        self.root, self.changing = _segment_roots(alpha, order, derivative)
        self.derivative = derivative
        self.durations = durations
        powers = np.ones((2, order + 1, self.durations.size))
        for k in range(order):
            np.multiply(powers[0, k], self.durations, out=powers[0, k + 1])
        powers[1] = powers[0]
        self.powers = powers.reshape(-1, self.durations.size)  # (nentries, nsegments)

    def solve(self, group: _Group, estimate: bool = False) -> _Solution:
        """Optimum of axes with the same pattern of prescribed entries."""
        filled = self._banded(group, estimate)
        if filled is not None:
            left, right, unique = filled, filled, True
        else:
            left, right, unique = self._chained(group) or self._dense(group)
        data = self._data(left, right)
        value, change = self.root @ data, self.changing @ data
        power = 1 - 2 * self.derivative
        square, both = (value * value).sum(axis=1), (value * change).sum(axis=1)
        weight = self.durations**power
        slope = (weight / self.durations) * (power * square + 2.0 * both)
        return _Solution((left, right), square @ weight, slope, unique)

    def rounding(self, found: _Solution) -> Array:
        """Estimate (naxes,) of the error of the cost."""
        data, weight = self._data(*found.sides), self.durations ** (1 - 2 * self.derivative)
        value = self.root @ data
        ofcost = _rounding(value, np.abs(self.root) @ np.abs(data)).sum(axis=1) @ weight
        oftimes = 16.0 * _EPS * np.abs(found.slope).sum(axis=1)
        # The cost by the distances of the positions, and so by each position.
        pull = 2.0 * weight * (self.root[:, data.shape[1] // 2] @ value)
        change = np.abs(np.diff(pull, axis=1, prepend=0.0, append=0.0))
        ofpositions = _EPS * (change * np.abs(found.sides[0][:, 0])).sum(axis=1)
        return np.asarray(ofcost + oftimes + ofpositions)

    def _data(self, left: Array, right: Array) -> Array:
        """Entries (naxes, nentries, nsegments) of both ends of each segment in relative time."""
        ends = np.concatenate([right[:, :, :-1], left[:, :, 1:]], axis=1)
        _shift(ends.transpose(2, 1, 0))
        return ends * self.powers

    def _banded(self, group: _Group, estimate: bool) -> Array | None:
        """All entries in linear time; None where the free ones are not unique."""
        if group.known.all():
            return group.rows
        if group.pattern is None:
            return None
        free = FreeEntries.of_durations(group.pattern, self.durations)
        try:
            found = free.estimate(group.rows) if estimate else free.solve(group.rows)
        except ValueError:  # a minimum-norm solution is found by the dense equations
            return None
        filled = group.rows.copy()
        filled.reshape(len(filled), -1)[:, group.pattern.places] = found
        return filled

    def _chained(self, group: _Group) -> tuple[Array, Array, bool] | None:
        """Entries to the left and to the right of all waypoints in linear time; None where they may not be unique."""
        table, free = np.nan_to_num(group.rows).transpose(2, 1, 0), ~group.known
        weight = self.durations ** (0.5 - self.derivative)
        equations = self.root * (self.powers * weight).T[:, None, :]
        right = -equations @ self._known_ends(group)
        found = chain_least_squares(equations, right, free & ~group.loose, free & group.loose)
        if found is None:
            return None
        left, right = (np.where(free[:, :, None], side, table).transpose(2, 1, 0) for side in found)
        return left, right, True

    def _dense(self, group: _Group) -> tuple[Array, Array, bool]:
        """Entries to the left and to the right of all waypoints by least squares, and whether they are unique."""
        known = group.known
        # Columns of the entries to the right of each waypoint; those to the left are the same, or additional ones.
        right = np.arange(known.size).reshape(known.shape)
        left = right.copy()
        apart = group.loose & ~known
        left[apart] = known.size + np.arange(apart.sum())
        fixed = np.append(known, np.zeros(apart.sum(), dtype=bool))
        entries = np.zeros((fixed.size, len(group.rows)))
        entries[fixed] = group.rows.T[known]

        ends = np.concatenate([right[:-1], left[1:]], axis=1)
        samples = np.zeros((len(ends), len(self.root), fixed.size))
        np.put_along_axis(samples, ends[:, None, :], self.root * self.powers.T[:, None, :], axis=2)
        matrix = samples.reshape(-1, fixed.size)
        weight = np.repeat(self.durations ** (0.5 - self.derivative), len(self.root))
        sides = -self.root @ (self.powers.T[:, :, None] * self._known_ends(group))
        entries[~fixed], unique = _least_squares(matrix[:, ~fixed], sides.reshape(len(matrix), -1), weight)
        return entries[left].T, entries[right].T, unique

    def _known_ends(self, group: _Group) -> Array:
        """Prescribed entries (nsegments, nentries, naxes) of both ends of each segment, 0 for free ones."""
        table = np.nan_to_num(group.rows).transpose(2, 1, 0)
        ends = np.concatenate([table[:-1], table[1:]], axis=1)
        position = group.known[:, 0]
        _shift(ends, position[:-1] & position[1:])
        return ends


class _Whole:
    """One spline through all waypoints."""

    def __init__(self, durations: Array, alpha: float, order: int, derivative: int) -> None:
        times = _times(durations)
        given = (tuple(range(order + 1)),) * times.size
        self.system = NewtonSystem(alpha, times, given)
        self.samples = self.system.squared_samples(derivative)
        self.jets = (self.system.taylor(times, order + 1) * FACTORIALS[: order + 2, None]).transpose(2, 1, 0)
        # The component of the top harmonic that changes its phase, from a system with another gamma.
        self.turn = None
        if self.system.gamma is not None:
            m = self.system.size // 2
            turned = NewtonSystem(alpha, times, given, self.system.gamma + 0.25 * np.pi / m)
            self.turn = 2.0 * alpha * m / times.size * (turned.squared_samples(derivative) - self.samples)[:, -1]

    def solve(self, group: _Group, estimate: bool = False) -> _Solution:
        """Optimum of axes with the same pattern of prescribed entries."""
        fixed, table = group.known.ravel(), group.rows.T
        entries = np.nan_to_num(table).reshape(fixed.size, -1)
        matrix = self._matrix()
        right = -self.samples @ _fitted(self.system, entries)
        entries[~fixed], unique = _least_squares(matrix[:, ~fixed], right, np.ones(len(matrix)))

        coefficients = _fitted(self.system, entries)
        value = self.samples @ coefficients
        # Sensitivity to a prescribed entry. When a waypoint moves in time, its entries are constant, and differ from
        # those of the plan by Taylor's theorem.
        scale = _norms(self.samples)
        basis, upper = np.linalg.qr((self.jets[:, :-1][group.known] / scale).T)
        price = np.zeros_like(table)
        price[group.known] = blas.dtrsm(1.0, upper, basis.T @ (self.samples.T @ value / scale[:, None]))
        slope = -2.0 * (price * (self.jets[:, 1:] @ coefficients)).sum(axis=1)
        if self.turn is not None:  # the mean moves as well, and with it gamma
            slope += (self.turn @ value) * coefficients[-1]
        slope[-1] = 0.0  # the last time is fixed
        side = entries.reshape(table.shape).T
        along = np.cumsum(slope[:0:-1], axis=0)[::-1]
        return _Solution((side, side), (value**2).sum(axis=0), along.T, unique)

    def rounding(self, found: _Solution) -> Array:
        """Estimate (naxes,) of the error of the cost."""
        entries = found.sides[1].T.reshape(self.system.size, -1)
        value = self.samples @ _fitted(self.system, entries)
        return np.asarray(_rounding(value, np.abs(self._matrix()) @ np.abs(entries)).sum(axis=0))

    def _matrix(self) -> Array:
        """Samples by the entries of all waypoints."""
        return np.asarray(self.samples @ _fitted(self.system, np.eye(self.system.size)))


@lru_cache(maxsize=256)
def _segment_roots(alpha: float, order: int, derivative: int) -> tuple[Array, Array]:
    """Matrix R with int_0^1 (y^(derivative))^2 = |R d|^2, d the jet at 0, then that at 1; R times the orders of d."""
    given = tuple(range(order + 1))
    system = NewtonSystem(alpha, np.array([0.0, 1.0]), (given, given))
    root = np.linalg.qr(system.squared_samples(derivative) @ _fitted(system, np.eye(system.size))).R
    return readonly(root), readonly(root * np.array([*given, *given]))


def _shift(ends: Array, where: NDArray[np.bool_] | bool = True) -> None:
    """Shift segments, with entries (nsegments, nentries, naxes) of both ends, to start at 0.

    Derivatives do not depend on the origin, and the difference of two near positions has all of their digits.
    """
    ends[:, [0, ends.shape[1] // 2]] -= (ends[:, 0] * np.reshape(where, (-1, 1)))[:, None]


def _fitted(system: NewtonSystem, entries: Array) -> Array:
    """Coefficients (size, naxes) from complete entries (size, naxes), sorted by waypoint."""
    orders = system.order_index
    rows = system.waypoint_index * (orders.max() + 1) + orders
    return system.coefficients(entries[rows] / FACTORIALS[orders, None])


def _least_squares(matrix: Array, right: Array, weight: Array) -> tuple[Array, bool]:
    """Minimum-norm solution of weighted equations, and whether it is unique.

    The rank does not depend on the weights of rows, and is determined without
    them, as they may differ by orders of magnitude. Rows in decreasing order of
    weight and pivoted columns preserve the accuracy of each row.
    """
    count = matrix.shape[1]
    scale = _norms(matrix)
    singular = np.linalg.svd(matrix / scale, compute_uv=False)
    rank = int(np.sum(singular > 1e-14 * singular.max(initial=0.0)))
    falling = np.argsort(-weight, kind="stable")
    rows, right = (matrix * weight[:, None])[falling], (right * weight[:, None])[falling]
    size = _norms(rows)
    basis, upper, pivots = qr(rows / size, mode="economic", pivoting=True)
    found = np.zeros((count, right.shape[1]))
    if rank:  # not by LAPACK's dtrtrs, whose threads are slow for small systems
        found[pivots[:rank]] = blas.dtrsm(1.0, upper[:rank, :rank], basis.T[:rank] @ right)
    found /= size[:, None]
    if rank < count:
        null, _ = np.linalg.qr(np.linalg.svd(matrix / scale)[2][rank:].T / scale[:, None])
        found -= null @ (null.T @ found)
    return found, rank == count


def _rounding(value: Array, size: Array) -> Array:
    """Rounding errors of squared samples that are sums of terms of given magnitudes."""
    error = 16.0 * _EPS * size
    return 2.0 * np.abs(value) * error + error**2


def _norms(matrix: Array) -> Array:
    """Norms of the columns, 1 for a zero column."""
    norms = np.linalg.norm(matrix, axis=0)
    return np.where(norms > 0.0, norms, 1.0)


def _resolved_durations(problem: _Problem, given: Array, first: _Solution, weights: Array) -> Array:
    """Relative durations of minimum cost, of those whose cost is resolved: the given ones, or longer segments."""
    allowed = min(max(_FEW, _relative_error(problem, given, first)), _NONE)
    longest = 0.5 * float(given.min())
    minimum = min(1e-4 / given.size, longest)
    while True:
        found = _best_durations(problem, given, first, weights, minimum)
        if problem.is_minimal() and problem.has_digits(found):
            return found
        if _relative_error(problem, found, problem.solve(found)) <= allowed:
            return found
        if minimum >= longest:
            return given
        minimum = min(2.0 * float(found.min()), longest)


def _best_durations(problem: _Problem, given: Array, first: _Solution, weights: Array, minimum: float) -> Array:
    """Relative durations of minimum cost from several starts, none below a minimum."""
    # Costs below this are rounding, of which the logarithm has no meaning.
    floor = 1e-26 * float(problem.scale(given) @ weights)
    if first.cost @ weights <= floor:
        return given
    room = 1.0 - given.size * minimum
    chord = np.sqrt(weights @ np.diff(first.sides[1][:, 0]) ** 2)
    chord = chord / chord.max() if chord.any() else np.ones(given.size)
    best: list[tuple[float, Array]] = []  # cost and logarithms of the durations of minima

    def shares(x: Array) -> Array:
        share: Array = np.exp(x - x.max())
        return share / share.sum()

    def objective(x: Array) -> tuple[float, Array]:
        share = shares(x)
        found = problem.solve(minimum + room * share, estimate=True)
        cost, slope = float(found.cost @ weights) + floor, room * share * (weights @ found.slope)
        return math.log(cost), (slope - share * slope.sum()) / cost

    def stop_near_known(intermediate_result: OptimizeResult) -> None:
        """End the search where it leads to a minimum that is known."""
        logarithms = np.log(shares(intermediate_result.x))
        for cost, known in best:
            if intermediate_result.fun >= cost and np.abs(logarithms - known).max() < _NEAR:
                raise StopIteration

    starts = [given, *(chord**power for power in (1.0, 0.5, 1.0 / 3.0, 0.0))]
    shorts = [np.maximum(start / start.sum(), 2.0 * minimum) for start in starts]
    logs = [np.log(h / h.sum() - minimum) for h in shorts]
    at_start = {x.tobytes(): objective(x) for x in logs}

    def known_at_start(x: Array) -> tuple[float, Array]:
        return at_start.pop(x.tobytes(), None) or objective(x)

    for x in sorted(logs, key=lambda x: at_start[x.tobytes()][0]):
        # Without a matrix of the size of the problem, whose products in threads would take most of the time.
        stop = stop_near_known if best else None
        result = minimize(known_at_start, x, jac=True, method="L-BFGS-B", callback=stop, options=_LIMITED_MEMORY)
        best.append((float(result.fun), np.log(shares(result.x))))
    chosen = min(best, key=lambda pair: pair[0])[1]
    return minimum + room * np.exp(chosen)


def _times(durations: Array) -> Array:
    """Relative times from durations that sum to 1."""
    return np.concatenate([[0.0], np.cumsum(durations[:-1]), [1.0]])


def _checked_orders(
    table: Array, derivative: int, order: int | None, continuity: int | None, single: bool
) -> tuple[int, int]:
    """Highest order of the entries, and of the continuous ones."""
    if single and continuity is not None:
        raise ValueError(f"continuity must not be given for a single plan, which is smooth, got {continuity}")
    shared = 0 if continuity is None else checked_count(continuity, "continuity")
    highest_order = max(derivative - 1, shared) if order is None else checked_count(order, "order")
    highest = max(highest_order, int(np.flatnonzero(~np.isnan(table).all(axis=(0, 2))).max(initial=0)))
    if shared > highest:
        raise ValueError(f"order must be at least the continuity {shared}, got {highest}")
    return highest, highest if continuity is None else shared


def _checked_weights(weights: ArrayLike | None, naxes: int) -> Array:
    """Weights of the axes, above 0."""
    if weights is None:
        return np.ones(naxes)
    factors = np.array([checked_finite(w, f"weights[{i}]", above=0.0) for i, w in enumerate(np.ravel(weights))])
    if factors.size != naxes:
        raise ValueError(f"weights must be one number per axis, {naxes}, got {factors.size}")
    return factors
