"""Splines with one function per segment: the paper's first approach to via points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import array_of_numbers, checked_count, checked_finite, checked_labels
from ctrlplan._display import number
from ctrlplan._renamed import FormerAttribute
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.chosen import checked_alpha, chosen_alpha
from ctrlplan.trajectories.common import (
    FACTORIALS,
    Array,
    are_finite,
    by_orders,
    derivative_scale,
    mapped_time,
    readonly,
    scales_of_orders,
)
from ctrlplan.trajectories.extrema import keep_places
from ctrlplan.trajectories.newton_spline import NewtonSpline
from ctrlplan.trajectories.one_time import derivatives, effective, is_moderate
from ctrlplan.trajectories.pieces import Pieces, Run, scales
from ctrlplan.trajectories.piecewise_extrema import Polynomials, stationary_places
from ctrlplan.trajectories.piecewise_fit import Frame
from ctrlplan.trajectories.polynomial import PolySpline
from ctrlplan.trajectories.sampling import FEW, Extent, place_entries, sample_segments
from ctrlplan.trajectories.swing import MAXIMUM_SWING, warn_of_swing
from ctrlplan.trajectories.trigonometric import TrigSpline
from ctrlplan.trajectories.waypoint import Entries, Waypoint
from ctrlplan.trajectories.waypoint_spline import (
    WaypointSpline,
    checked_waypoints,
    increasing,
    same_axes,
    same_times,
)

_ROOM = 0.5 * (MAXIMUM_SWING - 1.0)
"""Range of what is added to the way from position to position, relative to theirs, that is no swing."""

_FEW_POSITIONS = 40
"""Number of positions up to which their ranges are faster without arrays."""

_MANY_POSITIONS = 128
"""Number of positions above which the squares of all coefficients bound too little."""

_TINY = 1e-100
"""Root of a sum of squares below which they may have lost digits."""

_EXTREME = 200.0
"""Decimal exponent of powers of a duration above which each segment is evaluated with a check of overflow."""

_FEW = 16
"""Number of segments up to which each is evaluated by itself at few times, and interpolants are kept."""


class PiecewiseSpline(WaypointSpline):
    """Piecewise spline, one function per segment between waypoints.

    Let K - 1 be the highest order that is prescribed for an axis. An entry of
    order j < K that is free at an inner waypoint is continuous there, and so is its
    conjugate, the derivative of order 2K - 1 - j, which determines it. For alpha = 0
    this is the interpolant that minimises int (y^(K))^2: the cubic spline if velocities are
    free between prescribed ones, the minimum-jerk spline if velocities and
    accelerations are. Free entries at the ends lower the degree of the first and
    last segment. Derivatives that no waypoint prescribes may jump.

    A dwell is a pair of waypoints at the same position with zero derivatives up to the
    highest order that is prescribed for the axis: between them the plan is
    constant. With a derivative left free, it overshoots there.

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

    Examples
    --------
    Rise, dwell and return of a cam:

    >>> import ctrlplan as cp
    >>> rest = (0, 0)
    >>> cam = cp.PiecewiseSpline([cp.Waypoint(t, y, *rest) for t, y in [(0, 0), (1, 5), (3, 5), (4, 0)]])
    >>> cam([1.5, 2.0, 2.5]), cam.jumps(2)
    (array([5., 5., 5.]), ())
    """

    family = "piecewise"
    is_linear = True
    options = ("alpha",)

    alpha: float
    _warn: bool
    _period: float | None
    _entries: Entries
    _filled: Array  # entries with the free ones of inner waypoints, of a closed plan with the return to the first
    _frame: Frame  # what new values have in common
    _pieces: tuple[Pieces, ...]

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
        self._fit(Entries.of(points), shape, labels, warn)
        self._set_fields(waypoints=points)
        self._check_swing()

    @classmethod
    def from_arrays(
        cls,
        times: ArrayLike,
        values: ArrayLike,
        *,
        derivatives: Mapping[int, ArrayLike] | None = None,
        alpha: float | Literal["auto"] = 0.0,
        labels: Sequence[str] | None = None,
        warn: bool = True,
    ) -> Self:
        """Piecewise spline through many waypoints, given as arrays.

        Parameters
        ----------
        times : array_like, shape (nwaypoints,)
            Times [s], strictly increasing.
        values : array_like, shape (naxes, nwaypoints), or (nwaypoints,) for one axis
            Positions; nan is a free entry.
        derivatives : mapping of int to array_like, optional
            Derivatives by order, 1 or higher, each of the shape of `values`, or
            (nwaypoints,) or a number for all axes; nan is a free entry.
        alpha, labels, warn
            As for `PiecewiseSpline`.

        Raises
        ------
        TypeError
            If an array does not contain real numbers.
        ValueError
            If shapes differ, times do not increase, an entry is infinite, or an
            order is below 1; otherwise as `PiecewiseSpline`.

        Examples
        --------
        Minimum jerk through a thousand points, from rest to rest:

        >>> import numpy as np
        >>> import ctrlplan as cp
        >>> times = np.linspace(0.0, 10.0, 1000)
        >>> rest = np.full(1000, np.nan)
        >>> rest[[0, -1]] = 0.0
        >>> plan = cp.PiecewiseSpline.from_arrays(times, np.sin(times) ** 3, derivatives={1: rest, 2: rest})
        >>> float(np.abs(plan(times) - np.sin(times) ** 3).max()) < 1e-14, plan.breakpoints.size
        (True, 1000)
        """
        entries = _entries_of(_checked_times(times), values, derivatives)
        if labels is not None:
            entries = entries.named(checked_labels(labels, entries.table.shape[2]))
        points = entries.waypoints() if isinstance(alpha, str) else ()
        plan = cls.__new__(cls)
        plan._fit(entries, chosen_alpha(alpha, points, cls, labels=labels), labels, warn)
        plan._check_swing()
        return plan

    @classmethod
    def of_entries(
        cls, entries: Entries, alpha: float = 0.0, labels: Sequence[str] | None = None, warn: bool = True
    ) -> Self:
        """Piecewise spline through checked entries."""
        plan = cls.__new__(cls)
        plan._fit(entries, alpha, labels, warn)
        plan._check_swing()
        return plan

    @classmethod
    def cyclic(
        cls,
        waypoints: Iterable[Waypoint],
        period: float,
        *,
        alpha: float = 0.0,
        labels: Sequence[str] | None = None,
        warn: bool = True,
    ) -> Self:
        """Periodic plan, which leads back to its first waypoint.

        The plan starts at the first waypoint, lasts one period and ends with the
        initial jet. Free entries of all waypoints, also of the first, are
        continuous together with their conjugates, up to the highest order that a
        waypoint prescribes. With positions only the plan is piecewise linear.
        `then` appends further periods.

        Parameters
        ----------
        waypoints : iterable of Waypoint
            Two or more, all within one period, without the return to the first.
        period : float
            Period [s].
        alpha, labels, warn
            As for `PiecewiseSpline`.

        Raises
        ------
        ValueError
            If the waypoints do not fit into one period; otherwise as
            `PiecewiseSpline`.

        Examples
        --------
        A cam that is at rest for a moment at its first waypoint; velocity and
        acceleration are continuous at all waypoints, and so are jerk and snap where
        they are free:

        >>> import ctrlplan as cp
        >>> cam = cp.PiecewiseSpline.cyclic([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1), cp.Waypoint(3, -1)], 4.0)
        >>> cam.end, cam.jumps(2), bool(abs(cam.jet(4.0, 2) - cam.jet(0.0, 2)).max() < 1e-12)
        (4.0, (), True)
        """
        points = checked_waypoints(waypoints)
        duration = checked_finite(period, "period", above=0.0)
        plan = cls.__new__(cls)
        plan._fit(Entries.of(points), checked_alpha(alpha), labels, warn, period=duration)
        plan._set_fields(waypoints=points)
        plan._check_swing()
        return plan

    def _fit(
        self,
        entries: Entries,
        alpha: float,
        labels: Sequence[str] | None,
        warn: bool,
        period: float | None = None,
        donor: PiecewiseSpline | None = None,
    ) -> None:
        """Set all fields but the waypoints; what does not depend on values is taken from a `donor` at equal times."""
        unknown = np.isnan(entries.rows)
        if donor is not None and donor._frame.has(unknown):
            frame, names = donor._frame, donor.labels
        else:
            frame = Frame(alpha, entries.times, period, unknown)
            names = checked_labels(labels or entries.labels, entries.table.shape[2])
        filled, pieces = frame.fitted(entries.rows)
        self._fill(
            alpha=alpha,
            labels=names,
            breakpoints=frame.breakpoints,
            _warn=warn,
            _period=period,
            _entries=entries,
            _filled=readonly(filled),
            _frame=frame,
            _pieces=pieces,
        )

    @property
    def is_cyclic(self) -> bool:
        """Whether it was made by `cyclic`."""
        return self._period is not None

    @cached_property
    def waypoints(self) -> tuple[Waypoint, ...]:  # type: ignore[override]  # a field of the base class
        """Prescribed positions and derivatives."""
        return self._entries.waypoints()

    @cached_property
    def segments(self) -> tuple[NewtonSpline, ...]:
        """Splines of the segments, with all entries filled in."""
        return tuple(self._segment(k) for k in range(self.breakpoints.size - 1))

    legs = FormerAttribute("segments")

    def with_values(
        self, waypoints: Iterable[Waypoint] | Array, *, derivatives: Mapping[int, ArrayLike] | None = None
    ) -> Self:
        """Plan with the same times and shape through new values.

        The factorised equations of the free entries are reused.

        Parameters
        ----------
        waypoints : iterable of Waypoint, or ndarray
            As many as before and at the same times; or their positions as an array,
            as for `from_arrays`.
        derivatives : mapping of int to array_like, optional
            With an array of positions: derivatives, as for `from_arrays`.

        Raises
        ------
        ValueError
            If a time differs.
        """
        if isinstance(waypoints, np.ndarray):
            entries = _entries_of(self._entries.times, waypoints, derivatives)
            if entries.table.shape[2] != self.naxes:
                raise ValueError(f"values must keep the number of axes, {self.naxes}, got {entries.table.shape[2]}")
            plan = self._again(entries.named(self._entries.labels), self._warn, self)
        else:
            if derivatives is not None:
                raise TypeError(
                    "derivatives must be given with an array of positions, as np.array([...]), "
                    f"got a {type(waypoints).__name__}"
                )
            points = increasing(same_times(waypoints, self.waypoints))
            plan = self._again(Entries.of(points), self._warn, self)._with_fields(waypoints=points)
        plan._check_swing()
        return plan

    def through(self, waypoints: Iterable[Waypoint]) -> Self:
        """Plan of the same shape through any waypoints of as many axes.

        Raises
        ------
        ValueError
            As the constructor.
        """
        points = same_axes(checked_waypoints(waypoints), self.naxes)
        plan = self._again(Entries.of(points), self._warn)._with_fields(waypoints=points)
        plan._check_swing()
        return plan

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        data: Data = {
            "type": "PiecewiseSpline",
            "waypoints": [w.to_dict() for w in self.waypoints],
            "alpha": self.alpha,
            "labels": list(self.labels),
        }
        return data if self._period is None else data | {"period": self._period}

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        points = [Waypoint.from_dict(w) for w in data["waypoints"]]
        options = {"alpha": data["alpha"], "labels": data["labels"], "warn": False}
        plan = cls.cyclic(points, data["period"], **options) if "period" in data else cls(points, **options)
        return plan._with_fields(_warn=True)  # for plans that are derived from it

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        times = np.array([mapped_time(t, origin, target, rate) for t in self._entries.times.tolist()])
        period = None if self._period is None else self._period / rate
        plan = self._again(self._entries.scaled(times, rate), self._warn, period=period)
        keep_places(self, plan, self.breakpoints, plan.breakpoints)
        return plan

    def _marked_times(self) -> Array:
        return self.breakpoints

    def quiet(self) -> Self:
        """The same plan without warnings of `through` and `with_values`."""
        return self._with_fields(_warn=False)

    def _again(
        self, entries: Entries, warn: bool, donor: PiecewiseSpline | None = None, period: float | None = None
    ) -> Self:
        """Plan of the same shape through other waypoints, without a warning."""
        plan = type(self).__new__(type(self))
        plan._fit(entries, self.alpha, self.labels, warn, self._period if period is None else period, donor)
        return plan

    def _check_swing(self) -> None:
        """Warn, unless disabled, if the plan swings far beyond its waypoints."""
        if self._warn and not self._is_small() and not self._stays_near():
            ends = np.full((self.naxes, 2), [np.inf, -np.inf])
            for pieces in self._pieces:
                for run in pieces.runs:
                    for k, axis in enumerate(pieces.axes):
                        low, high = _range(run, k, slice(None))
                        ends[axis] = np.minimum(ends[axis, 0], low), np.maximum(ends[axis, 1], high)
            remedy = f"lower alpha from {self.alpha:.6g}" if self.alpha else "prescribe velocities at inner waypoints"
            remedy += ", or use fit for samples"
            warn_of_swing(ends, self._entries.times, self._entries.table, self.end, self.labels, remedy)

    def _stays_near(self) -> bool:
        """Whether a swing is excluded: by a bound of the coefficients, by the values in segments where that fails.

        Of the functions of a segment the first two lead from position to position, and
        the others add a part of their ranges to it, upwards or downwards.
        """
        if self.alpha > math.pi:
            return False
        positions = self._entries.rows[:, 0]
        spans = _spans(positions)
        for pieces in self._pieces:
            for run in pieces.runs:
                if not run.system.hermite:
                    return False
                weights = run.system.higher_ranges
                if not weights.size:
                    continue
                sizes = np.abs(run.coefficients[2:])
                # The largest coefficients of all segments together bound nearly as much as those of each.
                bounds = weights.dot(np.maximum.reduce(sizes, axis=2)).tolist()
                for k, axis in enumerate(pieces.axes):
                    if not (
                        bounds[k] <= _ROOM * spans[axis] or _is_near(run, k, weights.dot(sizes[:, k]), positions[axis])
                    ):
                        return False
        return True

    def _is_small(self) -> bool:
        """Whether the coefficients of all axes and segments together are small next to the range of each axis.

        Not for many waypoints, of which the values decide as fast.

        What the other functions of a segment add to the way from position to position
        goes up and down by at most the sum of their ranges in all. By Schwarz's
        inequality the root of all squares bounds that of one segment, and with the root
        of 2 that of two segments, one of which may go up and the other one down.
        """
        positions = self._entries.rows[:, 0]
        if self.alpha > math.pi or positions.size > _MANY_POSITIONS:
            return False
        bound = 0.0
        for pieces in self._pieces:
            for run in pieces.runs:
                if not run.system.hermite:
                    return False
                flat = run.coefficients[2:].ravel()
                bound = max(bound, run.system.higher_norm * math.sqrt(flat.dot(flat)))
        if not bound > _TINY:  # squares may have underflowed
            return False
        needed = bound / (2.0 * _ROOM if self.breakpoints.size == 2 else _ROOM * math.sqrt(2.0))
        # The sum is nan if a position is free.
        return all([needed <= max(own) - min(own) and sum(own) < math.inf for own in positions.tolist()])

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        if s.size == 1:
            rows = self.segment_rows(segment, float(s[0]), order)
            if rows is not None:
                return np.array(rows).T[:, :, None]
        duration = float(self.breakpoints[segment + 1] - self.breakpoints[segment])
        u, scale = s / duration, derivative_scale(duration, order)[:, None, None]
        if len(self._pieces) == 1:
            out = by_orders(self._pieces[0].jet(segment, u, order), scale)
        else:
            out = np.empty((order + 1, self.naxes, u.size))
            for pieces in self._pieces:
                out[:, list(pieces.axes)] = by_orders(pieces.jet(segment, u, order), scale)
        self._place_filled(np.array([segment]).repeat(s.size), s, 0, out)
        return out

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        if self._is_extreme(order) or not s.size:
            return super().segments_jet(segments, s, order)
        return self._jets(segments, s, 0, order)

    def _is_extreme(self, order: int) -> bool:
        """Whether powers of the durations may overflow."""
        return self._exponent * order > _EXTREME

    @cached_property
    def _exponent(self) -> float:
        """Maximum magnitude of the decimal exponents of the durations."""
        durations = self._durations
        shortest, longest = durations.item(durations.argmin()), durations.item(durations.argmax())
        return max(abs(math.log10(shortest)), abs(math.log10(longest)))

    def at_fractions(self, fractions: Array, nu: int) -> Array:
        """Derivative at relative times; as `Trajectory.at_fractions`."""
        if not self._is_extreme(nu):
            with np.errstate(over="ignore", invalid="ignore"):
                found = self._at_fractions(fractions, nu)
                if are_finite(found):
                    return found
        return super().at_fractions(fractions, nu)

    def _at_fractions(self, fractions: Array, nu: int) -> Array:
        scale = FACTORIALS[nu] * self._durations[:, None] ** -nu
        if len(self._pieces) == 1:
            return self._pieces[0].at_fractions(fractions, nu) * scale
        out = np.empty((self.naxes, len(scale), fractions.size))
        for pieces in self._pieces:
            out[list(pieces.axes)] = pieces.at_fractions(fractions, nu) * scale
        return out

    def _jets(self, segments: NDArray[np.intp], s: Array, low: int, high: int) -> Array:
        """Derivatives low to high, each time in its own segment."""
        h = self._durations[segments]
        u, scale = s / h, scales(h, high)[low:, None]
        if len(self._pieces) == 1:
            out = self._pieces[0].jets(segments, u, high)[low:] * scale
        else:
            out = np.empty((high - low + 1, self.naxes, s.size))
            for pieces in self._pieces:
                out[:, list(pieces.axes)] = pieces.jets(segments, u, high)[low:] * scale
        self._place_filled(segments, s, low, out)
        return out

    def _place_filled(self, segments: NDArray[np.intp], s: Array, low: int, out: Array) -> None:
        """Replace derivatives, from an order on, at ends of segments: they are the entries there in every bit."""
        entries = self._filled[:, low : low + len(out)].transpose(2, 1, 0)
        for end, moments in enumerate((0.0, self._durations[segments])):
            where = (s == moments).nonzero()[0]
            if where.size:
                place_entries(entries[segments[where] + end], where, out)

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        if t.size == 1:
            rows = self._rows(float(t[0]), high, left)
            if rows is not None:
                return np.array(rows).T[low:, :, None]
        if self._is_extreme(high) or not t.size:
            return super()._sample(t, low, high, left)
        times = self.breakpoints
        extent = Extent.of(t)
        first, last = extent.first, extent.last
        if not (first > times[0] if left else first >= times[0]) or not last <= times[-1]:
            inside = (t > times[0] if left else t >= times[0]) & (t <= times[-1])
            if np.count_nonzero(inside) <= _FEW:
                return super()._sample(t, low, high, left)
            out = np.empty((high - low + 1, self.naxes, t.size))
            out[:, :, inside] = self._sample(t[inside], low, high, left)
            out[:, :, ~inside] = super()._sample(t[~inside], low, high, left)
            return out
        with np.errstate(over="ignore", invalid="ignore"):
            out, finite = self._sample_inside(t, extent.is_sorted, low, high, left)
        return out if finite or np.isfinite(out.sum()) else super()._sample(t, low, high, left)

    def _sample_inside(self, t: Array, is_sorted: bool, low: int, high: int, left: bool) -> tuple[Array, bool]:
        """Derivatives low to high at times of the plan, and whether they are certainly finite."""
        times = self.breakpoints
        if t.size > FEW:
            out = np.empty((high - low + 1, self.naxes, t.size))
            entries = self._filled[:, low : high + 1].transpose(2, 1, 0)

            def rows_of(segments: NDArray[np.intp]) -> tuple[Array, bool]:
                if times.size > _FEW:
                    rows = self._rows_of(segments, low, high)
                    return rows, are_finite(rows)
                rows, finite = self._known_rows(low, high)
                return (rows if segments.size == len(rows) else rows[segments]), finite

            return out, sample_segments(times, rows_of, entries, t, is_sorted, left, effective(self.alpha), out)
        segments = times[1:-1].searchsorted(t, side="left" if left else "right")
        touched = int(np.count_nonzero(segments[1:] != segments[:-1])) + 1
        if touched <= _FEW:
            return super()._sample(t, low, high, left), True
        return self._jets(segments, t - times[segments], low, high), False

    def _known_rows(self, low: int, high: int) -> tuple[Array, bool]:
        """Rows of interpolants of all segments of a plan of few, which are stored, and whether they are finite."""
        if (low, high) not in self._rows_by_orders:
            rows = readonly(self._rows_of(np.arange(self._durations.size), low, high))
            self._rows_by_orders[low, high] = rows, are_finite(rows)
        return self._rows_by_orders[low, high]

    @cached_property
    def _rows_by_orders(self) -> dict[tuple[int, int], tuple[Array, bool]]:
        """The same by lowest and highest order."""
        return {}

    def _rows_of(self, segments: NDArray[np.intp], low: int, high: int) -> Array:
        """Rows (nsegments, norders * naxes, nterms) of interpolants of segments."""
        found = [pieces.rows(segments, low, high) for pieces in self._pieces]
        out = found[0]
        if len(found) > 1:
            out = np.zeros((segments.size, high - low + 1, self.naxes, max(rows.shape[3] for rows in found)))
            for pieces, rows in zip(self._pieces, found, strict=True):
                out[:, :, list(pieces.axes), : rows.shape[3]] = rows
        powers = scales_of_orders(self._durations.take(segments)[:, None, None, None], low, high)
        return (out * powers).reshape(segments.size, -1, out.shape[3])

    _rows = WaypointSpline._rows  # `_sample` calls it

    def segment_rows(self, segment: int, s: float, order: int) -> list[list[float]] | None:
        """Derivatives of a segment at one time; as `Trajectory.segment_rows`."""
        moments = self._moments
        duration = moments[segment + 1] - moments[segment]
        if not is_moderate(duration, order):
            return None
        if len(self._pieces) == 1:
            found = derivatives(self._pieces[0].series_at(segment, s / duration, order), duration)
        else:
            found = [[]] * self.naxes
            for pieces in self._pieces:
                rows = derivatives(pieces.series_at(segment, s / duration, order), duration)
                for axis, row in zip(pieces.axes, rows, strict=True):
                    found[axis] = row
        if s == 0.0 or s == duration:  # what a waypoint prescribes is not computed
            for k, entries in enumerate(self._filled[:, : order + 1, segment + (s == duration)].T.tolist()):
                for row, value in zip(found, entries, strict=True):
                    row[k] = row[k] if math.isnan(value) else value
        return found

    @cached_property
    def _durations(self) -> Array:
        times = self.breakpoints
        return readonly(times[1:] - times[:-1])

    @property
    def polynomial_degree(self) -> int | None:
        """Maximum degree of the segments, if alpha is 0; as `Trajectory.polynomial_degree`."""
        if self.alpha:
            return None
        return max(run.system.size for pieces in self._pieces for run in pieces.runs) - 1

    def stationary_places(self, nu: int) -> tuple[NDArray[np.intp], Array] | None:
        """Places of the stationary points of polynomials; as `Trajectory.stationary_places`."""
        if self.alpha:
            return None
        groups = ([Polynomials(run.system, run.first, run.coefficients) for run in p.runs] for p in self._pieces)
        return stationary_places(groups, self._durations, nu)

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        duration = float(self.breakpoints[segment + 1] - self.breakpoints[segment])
        found: list[list[Value]] = [[]] * self.naxes
        for pieces in self._pieces:
            for axis, row in zip(pieces.axes, pieces.at(segment, s / duration, order), strict=True):
                found[axis] = [value / duration**k for k, value in enumerate(row)]
        return found

    def _segment(self, segment: int) -> NewtonSpline:
        """Spline of one segment."""
        pair = [
            Waypoint.from_array(float(self.breakpoints[k]), self._filled[:, :, k].T.copy(), None)
            for k in (segment, segment + 1)
        ]
        spline: NewtonSpline = (
            TrigSpline(pair, alpha=self.alpha, labels=self.labels, warn=False)
            if self.alpha
            else PolySpline(pair, labels=self.labels, warn=False)
        )
        return spline._with_fields(_parts=[(p.axes, *p.of_segment(segment)) for p in self._pieces])

    def _facts(self) -> list[tuple[str, str]]:
        alpha = ("alpha", f"{number(self.alpha)} rad" if self.alpha else "")
        return [*super()._facts(), alpha, ("period", "" if self._period is None else f"{number(self._period)} s")]


def _spans(positions: Array) -> list[float]:
    """Ranges of positions (naxes, nwaypoints), nan for an axis with a free one."""
    if positions.size > _FEW_POSITIONS:
        found: list[float] = (np.maximum.reduce(positions, axis=1) - np.minimum.reduce(positions, axis=1)).tolist()
        return found
    # The sum is nan if a position is free.
    return [max(own) - min(own) if sum(own) < math.inf else math.nan for own in positions.tolist()]


def _is_near(run: Run, axis: int, bounds: Array, positions: Array) -> bool:
    """Whether one of the axes of a run stays near its positions.

    The bounds (nsegments,) are those of what is added to the way from position to
    position; where they do not suffice, the values decide.
    """
    low, high = float(positions.min()), float(positions.max())
    allowed = _ROOM * (high - low)
    wide = np.flatnonzero(~(bounds <= allowed))
    if not wide.size:
        return True
    lowest, highest = _range(run, axis, wide)
    return lowest >= low - allowed and highest <= high + allowed


def _range(run: Run, axis: int, segments: slice | NDArray[np.intp]) -> tuple[float, float]:
    """Minimum and maximum of one of the axes in some segments of a run, on a grid."""
    values = run.system.functions.T @ run.coefficients[:, axis, segments]
    return float(values.min()), float(values.max())


def _checked_times(times: ArrayLike) -> Array:
    """Two or more finite times that increase, as a new array."""
    moments = array_of_numbers(times, "times")
    if moments.ndim != 1 or moments.size < 2 or not np.isfinite(moments).all():
        raise ValueError(f"times must be two or more finite times, got shape {moments.shape}: {times!r:.60}")
    if not (moments[1:] > moments[:-1]).all():
        i = int((moments[1:] > moments[:-1]).argmin()) + 1
        raise ValueError(
            f"times must increase strictly, got times[{i}] = {moments[i]} after times[{i - 1}] = {moments[i - 1]}"
        )
    return readonly(moments.copy())


def _entries_of(times: Array, values: ArrayLike, derivatives: Mapping[int, ArrayLike] | None) -> Entries:
    """Checked entries from arrays, at checked times."""
    positions = array_of_numbers(values, "values")
    by_axis = positions[None] if positions.ndim == 1 else positions
    if by_axis.ndim != 2 or by_axis.shape[1] != times.size or not len(by_axis):
        raise ValueError(
            f"values must have shape (naxes, {times.size}) or ({times.size},) as times, got {positions.shape}"
        )
    if derivatives is not None and not isinstance(derivatives, Mapping):
        raise TypeError(f"derivatives must be a mapping of orders to arrays, got {derivatives!r:.80}")
    orders = {checked_count(k, "order of derivatives", 1): v for k, v in (derivatives or {}).items()}
    highest = max(orders, default=0)
    rows = np.empty((len(by_axis), 1 + highest, times.size))
    rows[:, 0] = by_axis
    if len(orders) < highest:
        rows[:, 1:] = np.nan
    for order, given in orders.items():
        row = array_of_numbers(given, f"derivatives[{order}]")
        if row.shape not in ((), times.shape, positions.shape):
            raise ValueError(
                f"derivatives[{order}] must be a number or have shape {times.shape} or {positions.shape} as values, "
                f"got {row.shape}"
            )
        rows[:, order] = row
    if np.count_nonzero(np.isinf(rows)):
        i, order, axis = np.argwhere(np.isinf(rows.T))[0].tolist()
        name = f"derivatives[{order}]" if order else "values"
        raise ValueError(f"{name} must be finite or nan (free), got {rows[axis, order, i]} at times[{i}], axis {axis}")
    return Entries.of_rows(times, rows)
