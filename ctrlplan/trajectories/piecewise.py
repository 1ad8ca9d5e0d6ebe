"""One spline a segment: the paper's first approach to via points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import checked_labels
from ctrlplan._renamed import warn_renamed
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import FACTORIALS, Array, mapped_time, readonly, times_powers
from ctrlplan.trajectories.conjugate_digits import Ends, conjugate_digits
from ctrlplan.trajectories.newton import NEARLY_CLOSED, NewtonSystem
from ctrlplan.trajectories.newton_spline import NewtonSpline, given_entries
from ctrlplan.trajectories.polynomial import PolySpline
from ctrlplan.trajectories.swing import warn_of_swing
from ctrlplan.trajectories.trigonometric import TrigSpline, chosen_alpha
from ctrlplan.trajectories.waypoint import Waypoint
from ctrlplan.trajectories.waypoint_spline import WaypointSpline, checked_waypoints, same_axes, same_times

_KEPT = 1e-12
"""Relative error of the free entries, as estimated, up to which floating point solves for them."""

_SINGULAR = 1e13
"""Condition of their equations, with segments of one duration, from which they are not determined."""

_SHORT = 0.02
"""Part of the longest segment below which a segment needs its entries in more digits than floating point has."""

_WITHIN = np.linspace(0.0, 1.0, 13)
"""Parts of a segment at which its swing is measured."""


class PiecewiseSpline(WaypointSpline):
    """One spline for each segment between waypoints.

    With K - 1 the highest order that an axis prescribes anywhere, an entry of
    order j < K left free at an inner waypoint is continuous there, and so is
    its conjugate, the derivative of order 2K - 1 - j, which determines it. With
    alpha = 0 that is the interpolant of least int (y^(K))^2: the cubic spline
    where velocities are free between given ones, the minimum-jerk spline where
    velocities and accelerations are. Entries left free at the ends lower the
    degree of the first and last segment. What no waypoint prescribes may jump.

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
        Whether to warn where the plan swings over more than 3 times the range
        of its waypoints (their positions, and where their derivatives lead
        within half a segment), on any axis.

    Attributes
    ----------
    segments : tuple of TrigSpline or PolySpline
        The splines, with the free entries of inner waypoints filled in.

    Raises
    ------
    ValueError
        If alpha is outside [0, 2 pi), times do not increase, axes differ, or
        the entries left free are not determined.

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

    @property
    def legs(self) -> tuple[NewtonSpline, ...]:
        """Deprecated name of `segments`."""
        warn_renamed("PiecewiseSpline.legs", "segments")
        return self.segments

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
        return plan._with_fields(_warn=True)  # of what is made from it

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        moved = [w.scaled(mapped_time(w.time, origin, target, rate), rate) for w in self.waypoints]
        return self._again(moved, self._warn)

    def _again(self, points: Iterable[Waypoint], warn: bool) -> Self:
        """Plan of the same shape through other waypoints, without a warning now."""
        plan = type(self)(points, alpha=self.alpha, labels=self.labels, warn=False)
        return plan._with_fields(_warn=warn)

    def quiet(self) -> Self:
        """The same plan, which no longer warns where `through` or `with_values` swings."""
        return self._again(self.waypoints, False)

    def _check_swing(self) -> None:
        """Warn, where it was not declined, of a plan that swings far beyond its waypoints."""
        if self._warn:
            values = [segment.segment_jet(0, segment.duration * _WITHIN, 0)[0] for segment in self.segments]
            way_on = f"lower alpha from {self.alpha:.6g}" if self.alpha else "prescribe velocities at inner waypoints"
            warn_of_swing(np.concatenate(values, axis=1), self.waypoints, self.end, self.labels, way_on)

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        return self.segments[segment].segment_jet(0, s, order)

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        return self.segments[segment].segment_series(0, s, order)


def _filled(points: tuple[Waypoint, ...], alpha: float) -> tuple[list[Waypoint], NDArray[np.object_] | None]:
    """Waypoints whose inner ones have no free entry below the axis's highest order; and as decimals, where needed."""
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
    """Replace short segments, whose higher derivatives rounding of the entries at their ends would change."""
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
    """Free entries (nfree, naxes) that leave no jump of the conjugate derivatives: floats, or decimals."""
    last = len(points) - 1
    ends: list[Ends] = []
    for segment in range(last):
        start, end = (pattern[i] if i in (0, last) else tuple(range(size)) for i in (segment, segment + 1))
        if not (start or end):
            raise ValueError(
                f"waypoints must prescribe something on every segment, got none from {segment} to {segment + 1}"
            )
        ends.append((start, end))
    times = np.array([p.time for p in points])
    unit = float(times[-1] - times[0]) / last
    durations = np.diff(times)
    orders = np.array([k for _, k in free])
    equations = None
    if durations.min() >= _SHORT * durations.max():
        equations = _jumps(durations / unit, ends, free, times_powers(table, unit, np.arange(size)[:, None]), alpha)
    if equations is not None and equations.loss <= _KEPT:
        entries: NDArray[Any] = np.linalg.solve(equations.matrix, -equations.known)
        return times_powers(entries, 1.0 / unit, orders[:, None])
    # Whether the data determine the entries does not depend on the times, which may be far from even.
    even = _jumps(np.ones(last), ends, free, table, alpha)
    solution = None
    if even is None or even.condition <= _SINGULAR or alpha > NEARLY_CLOSED:
        solution = conjugate_digits(alpha, times.tolist(), ends, free, table)
    if solution is None:
        raise ValueError("the entries left free at inner waypoints must be determined by the others; prescribe more")
    finite = np.isfinite(solution.astype(float))
    if not finite.all():
        i, k = free[int(np.argwhere(~finite)[0, 0])]
        raise ValueError(
            f"derivatives at inner waypoints must stay within floating point, got a larger derivative {k} at "
            f"waypoints[{i}]; move waypoints apart that are so near in time"
        )
    return solution


class _Equations(NamedTuple):
    """Equations of the free entries, matrix (nfree, nfree) by known sides (nfree, naxes)."""

    matrix: Array
    known: Array
    condition: float
    loss: float  # estimated relative error of their solution


def _jumps(
    durations: Array, ends: list[Ends], free: list[tuple[int, int]], table: Array, alpha: float
) -> _Equations | None:
    """Jumps of the conjugate derivatives, scaled by rows; None where they are beyond floating point.

    The segments are linear in their data, so each free entry is tried as an axis of
    its own after those given; times are in units of the mean segment.
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
    # Columns scaled, so that the units of the entries do not count.
    size_of = size_of[:, 0] * np.abs(matrix).max(axis=0)
    condition = float(np.linalg.cond(matrix / np.abs(matrix).max(axis=0))) if size_of.min() > 0.0 else np.inf
    return _Equations(matrix, rows[:, :naxes], condition, np.finfo(float).eps * condition * amplification)
