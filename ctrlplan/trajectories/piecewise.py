"""Splines with one function per segment: the paper's first approach to via points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import checked_labels
from ctrlplan._display import number
from ctrlplan._renamed import FormerAttribute
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.chosen import chosen_alpha
from ctrlplan.trajectories.common import FACTORIALS, Array, mapped_time, readonly, times_powers
from ctrlplan.trajectories.conjugate_digits import Ends, conjugate_digits
from ctrlplan.trajectories.newton import NEARLY_CLOSED, NewtonSystem
from ctrlplan.trajectories.newton_spline import NewtonSpline, given_entries
from ctrlplan.trajectories.polynomial import PolySpline
from ctrlplan.trajectories.swing import warn_of_swing
from ctrlplan.trajectories.trigonometric import TrigSpline
from ctrlplan.trajectories.waypoint import Waypoint
from ctrlplan.trajectories.waypoint_spline import WaypointSpline, checked_waypoints, same_axes, same_times

_ACCURATE = 1e-12
"""Estimated relative error of the free entries above which decimal arithmetic is used."""

_SINGULAR = 1e13
"""Condition number of their equations, for equal durations, above which they are not determined."""

_SHORT = 0.02
"""Duration relative to the longest segment below which entries are computed in decimal arithmetic."""

_WITHIN = np.linspace(0.0, 1.0, 13)
"""Relative times in a segment at which its range is measured."""


class PiecewiseSpline(WaypointSpline):
    """Piecewise spline, one function per segment between waypoints.

    Let K - 1 be the highest order that is prescribed for an axis. An entry of
    order j < K that is free at an inner waypoint is continuous there, and so is its
    conjugate, the derivative of order 2K - 1 - j, which determines it. For alpha = 0
    this is the interpolant that minimises int (y^(K))^2: the cubic spline if velocities are
    free between prescribed ones, the minimum-jerk spline if velocities and
    accelerations are. Free entries at the ends lower the degree of the first and
    last segment. Derivatives that no waypoint prescribes may jump.

    Parameters
    ----------
    waypoints : iterable of Waypoint
        Two or more, times increasing.
    alpha : float or "auto", optional
        Shape parameter of every segment in [0, 2 pi) [rad]; 0 gives polynomials,
        "auto" the shortest path.
    labels : sequence of str, optional
        Names of the axes.
    warn : bool, optional
        Whether to warn if the range of the plan on any axis exceeds 3 times that
        of its waypoints (their positions, and the extrapolation of their
        derivatives over half a segment).

    Attributes
    ----------
    segments : tuple of TrigSpline or PolySpline
        The splines, with the free entries of inner waypoints filled in.

    Raises
    ------
    ValueError
        If alpha is outside [0, 2 pi), times do not increase, axes differ, or
        free entries are not determined.

    Warns
    -----
    UserWarning
        If the plan swings far beyond its waypoints (`warn`).
    """

    family = "piecewise"
    options = ("alpha",)

    alpha: float
    segments: tuple[NewtonSpline, ...]
    _warn: bool

    def __init__(
        self,
        waypoints: Iterable[Waypoint],
        *,
        alpha: float | Literal["auto"] = 0.0,
        labels: Sequence[str] | None = None,
        warn: bool = True,
    ) -> None:
        points = checked_waypoints(waypoints)
        shape = chosen_alpha(alpha, points, type(self), labels=labels)
        names = checked_labels(labels or points[0].labels, points[0].naxes)
        filled, decimals = _filled(points, shape)
        segments: list[NewtonSpline] = [
            TrigSpline(pair, alpha=shape, labels=names, warn=False)
            if shape
            else PolySpline(pair, labels=names, warn=False)
            for pair in itertools.pairwise(filled)
        ]
        if decimals is not None:
            _resolve(segments, decimals)
        self._set_fields(
            waypoints=points,
            alpha=shape,
            labels=names,
            segments=tuple(segments),
            breakpoints=readonly(np.array([p.time for p in points])),
            _warn=warn,
        )
        self._check_swing()

    legs = FormerAttribute("segments")

    def with_values(self, waypoints: Iterable[Waypoint]) -> Self:
        """Plan with the same times and shape through new values.

        Raises
        ------
        ValueError
            If a time differs.
        """
        plan = self._again(same_times(waypoints, self.waypoints), self._warn)
        plan._check_swing()
        return plan

    def through(self, waypoints: Iterable[Waypoint]) -> Self:
        """Plan of the same shape through any waypoints of as many axes.

        Raises
        ------
        ValueError
            As the constructor.
        """
        plan = self._again(same_axes(checked_waypoints(waypoints), self.naxes), self._warn)
        plan._check_swing()
        return plan

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {
            "type": "PiecewiseSpline",
            "waypoints": [w.to_dict() for w in self.waypoints],
            "alpha": self.alpha,
            "labels": list(self.labels),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        points = [Waypoint.from_dict(w) for w in data["waypoints"]]
        plan = cls(points, alpha=data["alpha"], labels=data["labels"], warn=False)
        return plan._with_fields(_warn=True)  # for plans that are derived from it

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        moved = [w.scaled(mapped_time(w.time, origin, target, rate), rate) for w in self.waypoints]
        return self._again(moved, self._warn)

    def _again(self, points: Iterable[Waypoint], warn: bool) -> Self:
        """Plan of the same shape through other waypoints, without a warning."""
        plan = type(self)(points, alpha=self.alpha, labels=self.labels, warn=False)
        return plan._with_fields(_warn=warn)

    def quiet(self) -> Self:
        """The same plan without warnings of `through` and `with_values`."""
        return self._again(self.waypoints, False)

    def _check_swing(self) -> None:
        """Warn, unless disabled, if the plan swings far beyond its waypoints."""
        if self._warn:
            values = [segment.segment_jet(0, segment.duration * _WITHIN, 0)[0] for segment in self.segments]
            remedy = f"lower alpha from {self.alpha:.6g}" if self.alpha else "prescribe velocities at inner waypoints"
            warn_of_swing(np.concatenate(values, axis=1), self.waypoints, self.end, self.labels, remedy)

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        return self.segments[segment].segment_jet(0, s, order)

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        return self.segments[segment].segment_series(0, s, order)

    def _facts(self) -> list[tuple[str, str]]:
        return [*super()._facts(), ("alpha", f"{number(self.alpha)} rad" if self.alpha else "")]


def _filled(points: tuple[Waypoint, ...], alpha: float) -> tuple[list[Waypoint], NDArray[np.object_] | None]:
    """Waypoints with all free entries of inner ones filled in; and as decimals, where needed."""
    table, patterns = given_entries(points)
    filled = table.copy()
    decimals: NDArray[np.object_] | None = None
    for pattern in dict.fromkeys(patterns):
        axes = [a for a, p in enumerate(patterns) if p == pattern]
        size = 1 + max((k for given in pattern for k in given), default=0)
        free = [(i, k) for i, g in enumerate(pattern[1:-1], 1) for k in range(size) if k not in g]
        if free:
            where = tuple(np.array(free).T)
            found = _conjugate(points, pattern, size, free, table[:, :size, axes], alpha)
            filled[where[0][:, None], where[1][:, None], axes] = found.astype(float)
            if found.dtype == object:
                decimals = filled.astype(object) if decimals is None else decimals
                decimals[where[0][:, None], where[1][:, None], axes] = found
            elif decimals is not None:
                decimals[where[0][:, None], where[1][:, None], axes] = found
    return [Waypoint.from_array(p.time, jet, None) for p, jet in zip(points, filled, strict=True)], decimals


def _resolve(segments: list[NewtonSpline], decimals: NDArray[np.object_]) -> None:
    """Replace short segments, whose higher derivatives are sensitive to rounding of the entries at their ends."""
    durations = [segment.duration for segment in segments]
    longest = max(durations)
    for k, duration in enumerate(durations):
        if duration < _SHORT * longest:
            digits = math.ceil(2 * decimals.shape[1] * math.log10(longest / duration))
            segments[k] = segments[k].resolved(decimals[k : k + 2], digits)


def _conjugate(
    points: tuple[Waypoint, ...],
    pattern: tuple[tuple[int, ...], ...],
    size: int,
    free: list[tuple[int, int]],
    table: Array,
    alpha: float,
) -> NDArray[Any]:
    """Free entries (nfree, naxes) for continuous conjugate derivatives: floats, or decimals."""
    last = len(points) - 1
    ends: list[Ends] = []
    for segment in range(last):
        start, end = (pattern[i] if i in (0, last) else tuple(range(size)) for i in (segment, segment + 1))
        if not (start or end):
            raise ValueError(
                f"waypoints must prescribe an entry of every segment, got none from {segment} to {segment + 1}"
            )
        ends.append((start, end))
    times = np.array([p.time for p in points])
    unit = float(times[-1] - times[0]) / last
    durations = np.diff(times)
    orders = np.array([k for _, k in free])
    equations = None
    if durations.min() >= _SHORT * durations.max():
        equations = _jumps(durations / unit, ends, free, times_powers(table, unit, np.arange(size)[:, None]), alpha)
    if equations is not None and equations.loss <= _ACCURATE:
        entries: NDArray[Any] = np.linalg.solve(equations.matrix, -equations.known)
        return times_powers(entries, 1.0 / unit, orders[:, None])
    # Whether the data determine the entries does not depend on the times, which may be uneven.
    even = _jumps(np.ones(last), ends, free, table, alpha)
    solution = None
    if even is None or even.condition <= _SINGULAR or alpha > NEARLY_CLOSED:
        solution = conjugate_digits(alpha, times.tolist(), ends, free, table)
    if solution is None:
        raise ValueError("free entries at inner waypoints must be determined by the prescribed ones; prescribe more")
    finite = np.isfinite(solution.astype(float))
    if not finite.all():
        i, k = free[int(np.argwhere(~finite)[0, 0])]
        raise ValueError(
            f"derivatives at inner waypoints must stay within floating point, got an overflow of derivative {k} at "
            f"waypoints[{i}]; increase the time between neighbouring waypoints"
        )
    return solution


class _Equations(NamedTuple):
    """Equations of the free entries: matrix (nfree, nfree), right-hand sides (nfree, naxes)."""

    matrix: Array
    known: Array
    condition: float
    loss: float  # estimated relative error of their solution


def _jumps(
    durations: Array, ends: list[Ends], free: list[tuple[int, int]], table: Array, alpha: float
) -> _Equations | None:
    """Jumps of the conjugate derivatives, scaled by rows; None on overflow.

    The segments are linear in their data: each free entry is an additional axis
    with a unit value. Times are in units of the mean segment.
    """
    last, size, naxes = durations.size, table.shape[1], table.shape[2]
    columns = np.concatenate([np.nan_to_num(table), np.zeros((last + 1, size, len(free)))], axis=2)
    for n, (i, k) in enumerate(free):
        columns[i, k, naxes + n] = 1.0
    jump = np.zeros((last + 1, 2 * size, columns.shape[2]))  # right limit minus left, at each waypoint
    amplification = 1.0
    for segment, duration in enumerate(durations.tolist()):
        system = NewtonSystem(alpha, np.array([0.0, 1.0]), ends[segment])
        amplification = max(amplification, system.amplification)
        orders = system.order_index
        with np.errstate(all="ignore"):
            scale = duration**orders / FACTORIALS[orders]
            coefficients = system.coefficients(columns[segment + system.waypoint_index, orders] * scale[:, None])
            taylor = system.taylor(np.array([0.0, 1.0]), 2 * size - 1)
            jets = np.einsum("mkt,ma->tka", taylor, coefficients)
            jets *= (FACTORIALS[: 2 * size] / duration ** np.arange(2 * size))[:, None]
        jump[segment] += jets[0]
        jump[segment + 1] -= jets[1]
    rows = np.array([jump[i, 2 * size - 1 - k] for i, k in free])
    if not np.isfinite(rows).all():
        return None
    size_of = np.abs(rows[:, naxes:]).max(axis=1, keepdims=True)
    rows /= np.where(size_of > 0.0, size_of, 1.0)
    matrix = rows[:, naxes:]
    # Columns are scaled, so that the units of the entries do not matter.
    size_of = size_of[:, 0] * np.abs(matrix).max(axis=0)
    condition = float(np.linalg.cond(matrix / np.abs(matrix).max(axis=0))) if size_of.min() > 0.0 else np.inf
    return _Equations(matrix, rows[:, :naxes], condition, np.finfo(float).eps * condition * amplification)
