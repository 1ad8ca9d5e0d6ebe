"""Splines with one function through all waypoints, in Newton form."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import checked_count, checked_labels
from ctrlplan._display import number
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import (
    Array,
    are_finite,
    by_orders,
    derivative_scale,
    mapped_time,
    readonly,
    scales_of_orders,
)
from ctrlplan.trajectories.extrema import keep_places
from ctrlplan.trajectories.newton import NEARLY_CLOSED, NewtonSystem, shared_system
from ctrlplan.trajectories.one_time import derivatives, effective, is_moderate
from ctrlplan.trajectories.sampling import FEW, Extent, Interpolant
from ctrlplan.trajectories.swing import warn_of_swing, within
from ctrlplan.trajectories.waypoint import Waypoint, joined
from ctrlplan.trajectories.waypoint_spline import WaypointSpline, checked_waypoints, increasing, same_axes, same_times

_SHARED = 24
"""Number of coefficients up to which systems are shared by plans, so that few kilobytes are kept for each."""

Given = tuple[tuple[int, ...], ...]
Kind = tuple[Given, float | None, bool]
"""Entries prescribed at each waypoint, gamma, and whether the ends coincide."""


class SplineOptions(NamedTuple):
    """Options of a spline in addition to its waypoints and alpha."""

    labels: Sequence[str] | None = None
    gamma: float | list[float | None] | None = None
    degree: int | None = None
    smooth: int = 3
    period: float | None = None
    warn: bool = True

    def given(self) -> Data:
        """Options that determine the plan and differ from their defaults."""
        values = self._asdict()
        del values["warn"]
        return {k: v for k, v in values.items() if v != self._field_defaults[k]}


class NewtonSpline(WaypointSpline):
    """Base class of the trigonometric and the polynomial spline.

    Attributes
    ----------
    waypoints : tuple of Waypoint
        Prescribed positions and derivatives.
    alpha : float
        Shape parameter [rad], the angle of the plan on the circle; 0 is the polynomial.
    """

    is_linear = True

    alpha: float
    _moments: list[float]
    _options: SplineOptions
    _times: list[float]
    _relative: tuple[float, ...]
    _apart: Array | None
    _duration: float
    _systems: dict[Kind, NewtonSystem]
    _parts: list[tuple[tuple[int, ...], NewtonSystem, Array]]  # axes, their system and coefficients

    def with_values(self, waypoints: Iterable[Waypoint]) -> Self:
        """Plan with the same times and shape through new values.

        The factorised system is reused, which is fast for many plans of one
        pattern.

        Parameters
        ----------
        waypoints : iterable of Waypoint
            As many as before and at the same times.

        Raises
        ------
        ValueError
            If a time differs.
        """
        plan, near = self._fitted_again(same_times(waypoints, self.waypoints), self._options)
        if not near:
            plan._check_swing()
        return plan

    def through(self, waypoints: Iterable[Waypoint]) -> Self:
        """Plan of the same class and shape through other waypoints.

        Raises
        ------
        ValueError
            As the constructor of this kind.
        """
        points = same_axes(checked_waypoints(waypoints, 2 if self._options.period is None else 1), self.naxes)
        plan, near = self._fitted_again(points, self._options)
        if not near:
            plan._check_swing()
        return plan

    @property
    def is_cyclic(self) -> bool:
        """Whether it was made by `cyclic`."""
        return self._options.period is not None

    @property
    def degree(self) -> tuple[int, ...]:
        """Degree of each axis: m, or that of the polynomial if alpha is 0."""
        return tuple(s.size // 2 if self.alpha else s.size - 1 for s, _ in self._per_axis())

    def _fit(
        self,
        waypoints: tuple[Waypoint, ...],
        alpha: float,
        options: SplineOptions,
        donor: NewtonSpline | None = None,
    ) -> bool:
        """Set all attributes; the factorised systems of a `donor` of the same pattern are reused.

        Returns whether no swing has to be measured: it is excluded, or no warning is wanted.
        """
        times = [w.time for w in waypoints]
        start, period = times[0], options.period
        duration = times[-1] - start if period is None else period
        if period is not None and times[-1] >= start + period:
            raise ValueError(
                f"waypoints of a cyclic plan must lie within one period of {period:g} s from the first, "
                f"got waypoints[{len(times) - 1}].time = {times[-1]}"
            )
        if not 0.0 < duration < np.inf:
            raise ValueError(f"duration must be finite and above 0, got {times[-1]} s after {start} s")
        same_times = donor is not None and donor._times == times and donor._duration == duration
        relative = donor._relative if donor and same_times else tuple([(t - start) / duration for t in times])
        apart = donor._apart if donor and same_times else _apart(times, relative, duration)
        lent = donor._systems if donor and (same_times or _same_pattern(donor, relative, apart)) else {}
        table, patterns = given_entries(waypoints)
        systems: dict[Kind, NewtonSystem] = {}
        parts, near = [], options.warn
        for kind, axes in _groups(patterns, options.gamma, table, alpha).items():
            system = (lent and lent.get(kind)) or _system(alpha, relative, apart, kind, options)
            systems[kind] = system
            data = system.entries(table)
            if len(axes) < table.shape[2]:
                data = data[:, axes]
            found, near = _fitted(system, data, times, duration, near)
            parts.append((axes, system, found))
        if donor is not None and len(donor.labels) == table.shape[2]:
            labels = donor.labels
        else:
            labels = checked_labels(options.labels or waypoints[0].labels, table.shape[2])
        moments = [start, times[-1] if period is None else start + period]
        breakpoints = donor.breakpoints if donor is not None and same_times else readonly(np.array(moments))
        self._fill(
            waypoints=waypoints,
            alpha=alpha,
            labels=labels,
            breakpoints=breakpoints,
            _moments=moments,
            _options=options,
            _times=times,
            _relative=relative,
            _apart=apart,
            _duration=duration,
            _systems=systems,
            _parts=parts,
        )
        return near or not options.warn

    def _again(self, waypoints: tuple[Waypoint, ...], options: SplineOptions) -> Self:
        """Plan of this kind through other waypoints, without a warning; reuses the factorised systems."""
        return self._fitted_again(waypoints, options)[0]

    def _fitted_again(self, waypoints: tuple[Waypoint, ...], options: SplineOptions) -> tuple[Self, bool]:
        """The same, and whether no swing has to be measured."""
        plan = type(self).__new__(type(self))
        return plan, plan._fit(increasing(waypoints), self.alpha, options, self)

    def _check_swing(self) -> None:
        """Warn if the plan swings far beyond its waypoints."""
        if len(self._parts) == 1:
            _, system, coefficients = self._parts[0]
            values = coefficients.T @ system.functions
        else:
            values = np.empty((self.naxes, 2 * max([s.size for _, s, _ in self._parts]) + 1))
            for axes, system, coefficients in self._parts:
                found = coefficients.T @ system.functions
                values[list(axes), : found.shape[1]] = found
                values[list(axes), found.shape[1] :] = found[:, :1]
        if within(values, [w.jet[0].tolist() for w in self.waypoints]):
            return  # the usual case, before derivatives are evaluated
        remedy = "use PiecewiseSpline, one polynomial per segment, or fit for samples"
        if self.alpha:
            remedy = f"lower alpha from {self.alpha:.6g} (choose_alpha finds the best one) or {remedy}"
        table, _ = given_entries(self.waypoints)
        warn_of_swing(values, np.array(self._times), table, self.end, self.labels, remedy)

    def resolved(self, table: NDArray[Any], digits: int) -> Self:
        """Plan with coefficients from decimal entries, where possible.

        The table has the shape (nwaypoints, order + 1, naxes).
        """
        parts = []
        for axes, system, coefficients in self._parts:
            values = system.entries(table)[:, list(axes)]
            if system.hermite:
                coefficients = system.resolved(values, self._times, self._duration, digits)
            parts.append((axes, system, coefficients))
        return self._with_fields(_parts=parts)

    def quiet(self) -> Self:
        """The same plan without warnings of `through` and `with_values`."""
        return self._again(self.waypoints, self._options._replace(warn=False))

    def _loaded(self) -> Self:
        """The plan as it was saved: loading does not warn, `through` does."""
        return self._with_fields(_options=self._options._replace(warn=True))

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        moved = tuple(w.scaled(mapped_time(w.time, origin, target, rate), rate) for w in self.waypoints)
        options = self._options
        if options.period is not None:
            options = options._replace(period=options.period / rate)
        plan = self._again(moved, options)
        keep_places(self, plan, np.array(self._times), np.array(plan._times))
        return plan

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        if s.size == 1:
            rows = self.segment_rows(segment, float(s[0]), order)
            if rows is not None:
                return np.array(rows).T[:, :, None]
        if s.size > FEW and is_moderate(self._duration, order):
            extent = Extent.of(s)
            if extent.first >= 0.0 and extent.last <= self._moments[1] - self._moments[0]:
                found = np.empty((order + 1, self.naxes, s.size))
                self._sample_many(segment, s, 0, found, extent)
                return found
        found = self._jet(s, order)
        self._place_ends(segment, s, 0, found)
        return found

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives of the only segment; as `Trajectory.segments_jet`."""
        return self.segment_jet(0, s, order)

    def at_fractions(self, fractions: Array, nu: int) -> Array:
        """Derivative at relative times; as `Trajectory.at_fractions`."""
        if is_moderate(self._duration, nu):
            with np.errstate(over="ignore", invalid="ignore"):
                found = self._jet(fractions * self._duration, nu)[nu]
                if are_finite(found):
                    return found[:, None]
        return super().at_fractions(fractions, nu)

    def _jet(self, s: Array, order: int) -> Array:
        """Derivatives (order + 1, naxes, ntime) at times since the start."""
        u = s / self._duration
        scale = derivative_scale(self._duration, order)
        out = np.empty((order + 1, self.naxes, u.size))
        for axes, system, coefficients in self._parts:
            values = by_orders(system.jet(coefficients, u, order), scale[:, None, None])
            if len(axes) == self.naxes:
                return values
            out[:, list(axes)] = values
        return out

    def _new_interpolant(self, segment: int, low: int, high: int) -> Interpolant | None:
        found = [(axes, system.interpolant(coefficients.T, low, high)) for axes, system, coefficients in self._parts]
        rows = found[0][1]
        if len(found) > 1:
            rows = np.zeros((high - low + 1, self.naxes, max([own.shape[2] for _, own in found])))
            for axes, own in found:
                rows[:, list(axes), : own.shape[2]] = own
        return Interpolant.of(rows * scales_of_orders(self._duration, low, high), effective(self.alpha))

    def _end_jet(self, segment: int, s: float, order: int) -> Array:
        # What a waypoint prescribes is not computed.
        point = self.waypoints[-1 if s and self._options.period is None else 0]
        given = point.jet[: order + 1]
        if len(given) > order and point.complete:
            return given
        known, key = self._end_jets, (segment, s, order)
        if key not in known:
            rows = self._rows_inside(s, order)
            with np.errstate(over="ignore", invalid="ignore"):
                found = np.array(rows).T if rows else self._jet(np.array([s]), order)[:, :, 0]
            found[: len(given)] = np.where(np.isnan(given), found[: len(given)], given)
            known[key] = readonly(found)
        return known[key]

    def segment_rows(self, segment: int, s: float, order: int) -> list[list[float]] | None:
        """Derivatives of a segment at one time; as `Trajectory.segment_rows`."""
        if s == 0.0 or s == self._moments[1] - self._moments[0]:
            ends: list[list[float]] = self._end_jet(segment, s, order).T.tolist()
            return ends
        return self._rows_inside(s, order)

    def _rows_inside(self, s: float, order: int) -> list[list[float]] | None:
        """The same, without the entries at the ends."""
        if not is_moderate(self._duration, order):
            return None
        parts, u = self._columns, s / self._duration
        if len(parts) == 1:
            _, system, columns = parts[0]
            return derivatives(system.series_at(columns, u, order), self._duration)
        found: list[list[float]] = [[]] * self.naxes
        for axes, system, columns in parts:
            for axis, row in zip(axes, derivatives(system.series_at(columns, u, order), self._duration), strict=True):
                found[axis] = row
        return found

    @cached_property
    def _columns(self) -> list[tuple[tuple[int, ...], NewtonSystem, list[list[float]]]]:
        """Axes, their system, and the coefficients of each axis."""
        return [(axes, system, coefficients.T.tolist()) for axes, system, coefficients in self._parts]

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        found: list[list[Value]] = [[]] * self.naxes
        for axes, system, coefficients in self._parts:
            for axis, row in zip(axes, system.series(coefficients, s / self._duration, order), strict=True):
                found[axis] = [value / self._duration**k for k, value in enumerate(row)]
        return found

    @classmethod
    @abstractmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""

    def _per_axis(self) -> list[tuple[NewtonSystem, Array]]:
        """System and coefficients (size,) of each axis."""
        found = {a: (s, c[:, i]) for axes, s, c in self._parts for i, a in enumerate(axes)}
        return [found[a] for a in range(self.naxes)]

    def to_dict(self) -> Data:
        """Plain data: type, waypoints, labels and options."""
        data: Data = {
            "type": type(self).__name__,
            "waypoints": [w.to_dict() for w in self.waypoints],
            "labels": list(self.labels),
        }
        options = self._options.given()
        options.pop("labels", None)
        return data | options

    def _facts(self) -> list[tuple[str, str]]:
        return [*super()._facts(), ("alpha", f"{number(self.alpha)} rad" if self.alpha else "")]


def _system(
    alpha: float, relative: tuple[float, ...], apart: Array | None, kind: Kind, options: SplineOptions
) -> NewtonSystem:
    """System for a pattern of entries; of few entries that of earlier plans with the same relative times."""
    given, gamma, meet = kind
    count = sum(map(len, given))
    size = None if options.degree is None else _size(alpha, count, options.degree)
    if apart is None and (size or count) <= _SHARED:
        return shared_system(alpha, relative, given, gamma, size, options.smooth, meet)
    return NewtonSystem(alpha, np.array(relative), given, gamma, size, options.smooth, meet, apart)


@np.errstate(over="ignore", invalid="ignore")
def _fitted(system: NewtonSystem, data: Array, times: list[float], duration: float, check: bool) -> tuple[Array, bool]:
    """Coefficients from prescribed derivatives (nconstraints, naxes), and whether a check excludes a swing.

    Raises
    ------
    ValueError
        If a coefficient overflows, or is too inaccurate.
    """
    found = system.fitted(data, times, duration, data * system.taylor_scale(duration, data.shape[1]))
    near = check and system.stays_near(found, data)
    if not near and not (are_finite(found.T) or np.isfinite(found).all()):
        raise ValueError(
            "coefficients must stay within floating point, got an overflow from "
            f"waypoint entries of up to {np.abs(data).max():g} over {duration:g} s"
        )
    return found, near


def _apart(times: list[float], relative: tuple[float, ...], duration: float) -> Array | None:
    """Differences of the normalised times, if those of the rounded times would lose digits."""
    for before, after in pairwise(relative):
        if after - before <= 1e-4:
            return np.subtract.outer(times, times) / duration
    return None


def _same_pattern(donor: NewtonSpline, relative: tuple[float, ...], apart: Array | None) -> bool:
    """Whether the systems of another plan are valid for these times."""
    if donor._relative != relative:
        return False
    return apart is None or (donor._apart is not None and np.array_equal(donor._apart, apart))


def _size(alpha: float, count: int, degree: int) -> int:
    """Number of coefficients at a degree."""
    minimum = count // 2 if alpha else count - 1
    if degree < minimum:
        raise ValueError(f"degree must be at least {minimum} for {count} constraints per axis, got {degree}")
    return max(2 * degree if alpha else degree + 1, count)


def given_entries(waypoints: Sequence[Waypoint]) -> tuple[Array, list[Given]]:
    """Entries (waypoint, order, axis), and the orders prescribed at each waypoint for each axis."""
    naxes, jets = waypoints[0].naxes, [w.jet for w in waypoints if w.complete]
    sizes = set(map(len, jets))
    if len(sizes) == 1 and len(jets) == len(waypoints):
        (size,) = sizes
        return joined(jets).reshape(len(jets), size, naxes), [_complete(len(jets), size)] * naxes
    jets = [w.jet for w in waypoints]
    sizes = set(map(len, jets))
    table = np.full((len(jets), max(sizes), naxes), np.nan)
    for row, jet in zip(table, jets, strict=True):
        row[: len(jet)] = jet
    known = ~np.isnan(table)
    patterns = [tuple(tuple(np.flatnonzero(k).tolist()) for k in known[:, :, a]) for a in range(known.shape[2])]
    return table, patterns


@lru_cache(maxsize=128)
def _complete(count: int, size: int) -> Given:
    """Orders of waypoints that all prescribe the same number of them."""
    return (tuple(range(size)),) * count


def _meeting(table: Array) -> list[bool]:
    """Whether the first and last position of each axis agree."""
    found = []
    for positions in table[:, 0].T:
        known = positions[~np.isnan(positions)]
        found.append(known.size > 1 and bool(abs(known[-1] - known[0]) <= 0.1 * np.ptp(known)))
    return found


def _groups(
    patterns: list[Given], gamma: float | list[float | None] | None, table: Array, alpha: float
) -> dict[Kind, tuple[int, ...]]:
    """Axes with the same pattern of prescribed entries, gamma and coinciding ends, which only exist near 2 pi."""
    if alpha < NEARLY_CLOSED:
        if gamma is None and patterns.count(patterns[0]) == len(patterns):
            return {(patterns[0], None, False): tuple(range(len(patterns)))}
        meeting = [False] * len(patterns)
    else:
        meeting = _meeting(table)
    gammas = gamma if isinstance(gamma, list) else [gamma] * len(patterns)
    groups: dict[Kind, tuple[int, ...]] = {}
    for axis, kind in enumerate(zip(patterns, gammas, meeting, strict=True)):
        groups[kind] = (*groups.get(kind, ()), axis)
    return groups


def checked_degree(degree: int | None, smooth: int) -> tuple[int | None, int]:
    """Degree and order of smoothness as integers of at least 1."""
    return None if degree is None else checked_count(degree, "degree", 1), checked_count(smooth, "smooth", 1)
