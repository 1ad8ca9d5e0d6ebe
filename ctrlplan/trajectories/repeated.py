"""Plans that repeat, a number of times or for all future times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import check_kind, checked_finite, one_number
from ctrlplan._display import number, time_text
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.clipped import Clipped
from ctrlplan.trajectories.combined import Joined, join_slack
from ctrlplan.trajectories.common import Array, mapped_time, readonly
from ctrlplan.trajectories.continuity import Jump
from ctrlplan.trajectories.extrema import Bounds, Extrema
from ctrlplan.trajectories.files import trajectory_from_dict
from ctrlplan.trajectories.trajectory import Trajectory, check_end
from ctrlplan.trajectories.waypoint import Waypoint

if TYPE_CHECKING:
    from typing_extensions import TypeIs

_SEGMENTS = 10_000_000
"""Maximum number of segments in an array."""

_PASSES = 1000
"""Maximum number of periods of a part in the common period of a combination."""

_RESOLVED = 1e-3
"""Maximum spacing of floating-point times, relative to the shortest segment."""

_FEW = 64
"""Number of breakpoints up to which each segment is evaluated by itself."""

_SAME = 1e-12
"""Relative difference of periods that is attributed to rounding."""


class Repeated(Trajectory):
    """Plan that is repeated, such as a cam; returned by `repeat`.

    The plan runs once from its start to its end. Then its part from `since` on is
    repeated. The times of repetition k are shifted by ``k period``, so that rounding
    errors do not accumulate.

    Parameters
    ----------
    plan : Trajectory
        Plan whose positions at `since` and at its end agree.
    count : int or None
        Number of passes through the repeated part, including the first; None: for all
        future times. `end` and `duration` are then infinite, `breakpoints` and
        `waypoints` are those of the first pass, `breakpoints_between` finds the others,
        and there is no final position.
    since : float, optional
        Beginning of the repeated part [s], a breakpoint. Default: the start.

    Attributes
    ----------
    plan, count, since
        The arguments.
    period : float
        Duration of the repeated part [s].

    Raises
    ------
    TypeError
        If `plan` is not a trajectory, or `count` not a number.
    ValueError
        If the plan has no duration or no end, its positions differ, `since` is not one
        of its breakpoints before the end, or the count is not an integer above 0.

    Examples
    --------
    >>> from ctrlplan.trajectories import PolySpline, Waypoint
    >>> bump = PolySpline([Waypoint(0, 0, 0), Waypoint(1, 1, 0), Waypoint(2, 0, 0)])
    >>> twice, always = Repeated(bump, 2), Repeated(bump, None)
    >>> twice.end, twice([1.0, 3.0, 5.0]), always.end, always([1.0, 3.0, 5.0])
    (4.0, array([1., 1., 0.]), inf, array([1., 1., 1.]))
    """

    plan: Trajectory
    count: int | None
    since: float
    period: float
    initial: Array
    _lead: int  # number of segments before the repeated part

    def __init__(self, plan: Trajectory, count: int | None, since: float | None = None) -> None:
        check_kind(plan, "plan", Trajectory)
        check_end(plan)
        if not plan.duration:
            raise ValueError(f"plan must have a duration to be repeated, got a step at {time_text(plan.start)} s")
        begin = plan.start if since is None else checked_finite(since, "since")
        if begin not in plan.breakpoints[:-1]:
            raise ValueError(
                f"since must be a breakpoint of the plan before its end at {plan.end:g} s, got {begin:.17g} s"
            )
        first = plan.jet(begin, 0)[0]
        if (np.abs(first - plan.final) > join_slack(plan)).any():
            raise ValueError(
                f"positions must agree where a plan repeats, got {plan.final.tolist()} at its end at {plan.end:g} s "
                f"and {first.tolist()} at {begin:g} s; add a way back, or use the constructor `cyclic` of the spline"
            )
        self._set(plan, None if count is None else _checked_passes(count), begin)

    def _set(self, plan: Trajectory, count: int | None, since: float) -> None:
        """Set the fields."""
        lead = int(np.searchsorted(plan.breakpoints, since))
        self._set_fields(
            plan=plan,
            count=count,
            since=since,
            period=plan.end - since,
            labels=plan.labels,
            initial=plan.initial,
            _lead=lead,
        )
        total = plan.breakpoints.size - 1 + ((count or 1) - 1) * self._turn
        if total > _SEGMENTS:
            raise ValueError(
                f"count must give at most {_SEGMENTS} segments, got {total}; None repeats a plan for all future times"
            )
        times = plan.breakpoints if count is None else readonly(self._times(np.arange(total + 1)))
        self._set_fields(breakpoints=times)

    @classmethod
    def _of(cls, plan: Trajectory, count: int | None, since: float) -> Self:
        """As the constructor, without its checks."""
        self = cls.__new__(cls)
        self._set(plan, count, since)
        return self

    @property
    def end(self) -> float:
        """Time of the last breakpoint [s]; infinite without a count."""
        return math.inf if self.count is None else float(self.breakpoints[-1])

    @cached_property
    def final(self) -> Array:
        """Position from the end on, shape (naxes,)."""
        check_end(self)
        return self.plan.final

    @cached_property
    def waypoints(self) -> tuple[Waypoint, ...]:  # type: ignore[override]  # a field of the base class
        """Waypoints of all passes, without a count those of the first."""
        first = self.plan.waypoints
        again = [w for w in first if w.time >= self.since]
        if again and again[0].time == self.since and again[-1].time == self.plan.end:
            again = again[1:]
        turns = range(1, self.count or 1)
        return (*first, *(w.scaled(w.time + k * self.period, 1.0) for k in turns for w in again))

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {"type": "Repeated", "plan": self.plan.to_dict(), "count": self.count, "since": self.since}

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        return cls(trajectory_from_dict(data["plan"]), data["count"], data["since"])

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        moved = self.plan.map_time(origin, target, rate)
        begin = mapped_time(self.since, origin, target, rate)
        nearest = moved.breakpoints[np.abs(moved.breakpoints[:-1] - begin).argmin()]
        return self._of(moved, self.count, float(nearest))

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        return self.plan.segment_jet(int(self._own(segment)), s, order)

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        return self.plan.segments_jet(self._own(segments), s, order)

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        return self.plan.segment_series(int(self._own(segment)), s, order)

    def segment_jet_at(self, moment: float, origin: float, s: Array, order: int) -> Array:
        """Jet of the function of a segment; as `Trajectory.segment_jet_at`."""
        if self.count is not None or moment < self.start:
            return super().segment_jet_at(moment, origin, s, order)
        segment = int(self._segments_of(np.array([moment]), False)[0])
        return self.segment_jet(segment, s + (origin - float(self._times(segment))), order)

    def segment_series_at(self, moment: float, origin: float, s: Value, order: int) -> list[list[Value]]:
        """Taylor series at a number or symbol s; as `Trajectory.segment_series_at`."""
        if self.count is not None or moment < self.start:
            return super().segment_series_at(moment, origin, s, order)
        segment = int(self._segments_of(np.array([moment]), False)[0])
        return self.segment_series(segment, s + (origin - float(self._times(segment))), order)

    def _intervals_at(self, t: Value) -> Iterator[tuple[int, Value, Value]]:
        # The number of periods is rounded: the sums with which times of segments are computed decide.
        turn = np.fmax(np.floor((t - self.since) / self.period), 0.0)
        turn = turn + (t >= self.since + (turn + 1.0) * self.period)
        turn = np.fmax(turn - (t < self.since + turn * self.period), 0.0)
        if self.count is not None:
            turn = np.fmin(turn, self.count - 1.0)
        later = turn * self.period
        times, last = self.plan.breakpoints.tolist(), self.plan.breakpoints.size - 2
        for segment, (left, right) in enumerate(pairwise(times)):
            if segment < self._lead:
                yield segment, left, right
            elif segment < last:
                yield segment, left + later, right + later
            else:
                yield segment, left + later, self.since + (turn + 1.0) * self.period

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """Breakpoints in the half-open interval [t0, t1); as `Trajectory.breakpoints_between`.

        Without a count, `t1` must be finite.
        """
        if self.count is not None:
            return super().breakpoints_between(t0, t1)
        first, last = self._checked_interval(t0, t1)
        if math.isinf(last):
            raise ValueError(
                f"t1 must be finite for a plan that repeats for all future times with a period of {self.period:g} s, "
                f"got {last}"
            )
        begin, end = (
            0 if t <= self.start else int(self._segments_of(np.array([t]), True)[0]) + 1 for t in (first, last)
        )
        if end - begin > _SEGMENTS:
            raise ValueError(
                f"t0 and t1 must include at most {_SEGMENTS} breakpoints, got {end - begin} from {first:g} s to "
                f"{time_text(last)} s"
            )
        return np.unique(self._times(np.arange(begin, end)))

    def extrema(self, nu: int = 0) -> Extrema:
        """Extrema of a derivative, those of one pass; as `Trajectory.extrema`."""
        return self.plan.extrema(nu)

    def extrema_of(self, function: Callable[[Array], Array], order: int) -> Extrema:
        """Extrema of a function of the jet, those of one pass; as `Trajectory.extrema_of`."""
        return self.plan.extrema_of(function, order)

    def bounds(
        self,
        function: Callable[[Array], Array],
        order: int,
        lipschitz: ArrayLike,
        rtol: float = 1e-3,
        max_cells: int = 1_000_000,
    ) -> Bounds:
        """Certified bounds of a function of the jet, those of one pass; as `Trajectory.bounds`."""
        return self.plan.bounds(function, order, lipschitz, rtol, max_cells)

    def jumps(self, order: int) -> tuple[Jump, ...]:
        """Jumps of the derivatives up to an order; as `Trajectory.jumps`.

        Without a count, those of the first pass and of the beginning of the second.
        """
        if self.count is not None:
            return super().jumps(order)
        twice = self._of(self.plan, 2, self.since)
        again = float(twice.breakpoints[self.plan.breakpoints.size - 1])
        return tuple(jump for jump in twice.jumps(order) if jump.time <= again)

    def covering(self, time: float) -> Trajectory:
        """The plan with as many passes as end after a time [s].

        The plan itself if it has a count.
        """
        if self.count is not None:
            return self
        passes = max(1, math.floor((checked_finite(time, "time") - self.since) / self.period) + 2)
        return self.plan if passes == 1 else self._of(self.plan, passes, self.since)

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        if self.count is None and t.size and not t.max() < np.inf:
            raise ValueError("times must be finite for a plan that repeats for all future times, got inf")
        if self.count is not None and self.breakpoints.size <= _FEW:
            return super()._sample(t, low, high, left)
        inside = (t > self.start) & (t <= self.end) if left else (t >= self.start) & (t < self.end)
        # Outside the plan holds its first and last position; at the end it has its own values.
        u = np.where(t < self.end, self.plan.start - 1.0, np.nextafter(self.plan.end, np.inf))
        u[t == self.start], u[t == self.end] = self.plan.start, self.plan.end
        u[inside] = self.first_pass(t[inside], left)
        return self.plan._sample(u, low, high, left)

    def first_pass(self, t: Array, left: bool = False) -> Array:
        """Times of the first pass with the same jets.

        Parameters
        ----------
        t : ndarray, shape (ntime,)
            Times [s] before the end.
        left : bool, optional
            Whether the jets are limits from the left.
        """
        segments = self._segments_of(t, left)
        own, last = self._own(segments), self.plan.breakpoints.size - 2
        begin, end = self.plan.breakpoints[own.clip(0)], self.plan.breakpoints[own.clip(0) + 1]
        u = np.where(segments <= last, t, begin + (t - self._times(segments.clip(0))))
        low, high = (np.nextafter(begin, end), end) if left else (begin, np.nextafter(end, begin))
        return np.where(segments < 0, t, np.clip(u, low, high))

    @property
    def _turn(self) -> int:
        """Number of segments of the repeated part."""
        return self.plan.breakpoints.size - 1 - self._lead

    def _own(self, segments: ArrayLike) -> NDArray[np.intp]:
        """Numbers of the plan's segments that are passed as segments of this one."""
        given = np.asarray(segments)
        return np.where(given < self._lead, given, self._lead + (given - self._lead) % self._turn)

    def _times(self, segments: ArrayLike) -> Array:
        """Times [s] at which segments begin."""
        turn = np.maximum((np.asarray(segments) - self._lead) // self._turn, 0)
        return np.asarray(self.plan.breakpoints[self._own(segments)] + turn * self.period)

    def _segments_of(self, t: Array, left: bool) -> NDArray[np.intp]:
        """Numbers of the segments that contain times, or end at them (`left`); -1 before the start."""
        lengths = np.diff(self.plan.breakpoints)
        shortest = lengths[lengths > _SAME * self.period].min()  # others are differences of sums by rounding
        if t.size and t.max() > self.since and np.spacing(t.max()) > _RESOLVED * shortest:
            raise ValueError(
                f"times must resolve the segments of a plan that repeats with a period of {self.period:g} s, got "
                f"{t.max():g} s; use a time origin nearer to the plan"
            )
        turn = np.floor((t - self.since) / self.period).clip(0.0)
        inside = t - turn * self.period
        place = np.searchsorted(self.plan.breakpoints, inside, side="left" if left else "right") - 1
        found = place + turn.astype(np.intp) * self._turn
        while True:  # the number of periods is rounded
            begins, ends = self._times(found.clip(0)), self._times(found + 1)
            early = (found >= 0) & (begins >= t if left else begins > t)
            late = ends < t if left else ends <= t
            if not (early | late).any():
                return found
            found += late.astype(np.intp) - early

    def _has_quick_peaks(self) -> bool:
        return self.plan._has_quick_peaks() and self.breakpoints.size <= 60

    def _facts(self) -> list[tuple[str, str]]:
        often = "for all future times" if self.count is None else f"{self.count} passes"
        since = f", from {number(self.since)} s on" if self._lead else ""
        return [*super()._facts(), ("period", f"{number(self.period)} s, {often}{since}")]


def one_pass(plan: Trajectory) -> Trajectory:
    """A plan; of one that repeats for all future times, its first pass."""
    return plan.plan if _is_endless(plan) else plan


def jumps_until(plan: Trajectory, order: int, first: float, last: float) -> tuple[Jump, ...]:
    """Jumps of a plan; of one that repeats for all future times, all between two times and some others."""
    found = plan.jumps(order)
    if not _is_endless(plan):
        return found
    turn = max(0, math.floor((first - plan.since) / plan.period))
    again = [jump for jump in found if jump.time > plan.since] if last > plan.since else []
    return (*found, *(replace(jump, time=jump.time + k * plan.period) for k in (turn, turn + 1) for jump in again))


def covering(plan: Trajectory, time: float) -> Trajectory:
    """A plan; of one that repeats for all future times, as many passes as end after a time [s]."""
    return plan.covering(time) if isinstance(plan, Repeated) else plan


def followed(first: Trajectory, second: Trajectory) -> Trajectory:
    """A trajectory followed by another; as `Trajectory.then`."""
    if not _is_endless(second):
        return Joined((first, second))
    joined = Joined((first, second.plan))
    begin = joined.breakpoints[joined.breakpoints.size - 1 - second._turn]
    return Repeated(joined, None, float(begin))


def combined(combine: Callable[[Sequence[Trajectory]], Trajectory], parts: Sequence[Trajectory]) -> Trajectory:
    """Combination of trajectories at the same time, of which some may repeat for all future times.

    The combination then repeats with the common period of these parts, from the time on
    at which all of them have begun to repeat and the others have ended.

    Raises
    ------
    ValueError
        If the common period contains more than 1000 periods of a part.
    """
    endless = [part for part in parts if _is_endless(part)]
    if not endless:
        return combine(parts)
    since = max(part.since if _is_endless(part) else part.end for part in parts)
    end = since + _common_period([part.period for part in endless])
    whole = combine([_until(part, end) if _is_endless(part) else part for part in parts])
    inner = whole.breakpoints[:-1]
    return Repeated(whole, None, float(inner[np.abs(inner - since).argmin()]))


def _is_endless(plan: Trajectory) -> TypeIs[Repeated]:
    """Whether a plan repeats for all future times."""
    return isinstance(plan, Repeated) and plan.count is None


def _until(plan: Repeated, end: float) -> Trajectory:
    """Part of a plan from its start to a time in its repeated part."""
    passes = max(1, round((end - plan.since) / plan.period))
    near = _SAME * passes * plan.period
    if abs(plan.since + passes * plan.period - end) <= near:
        return plan.covering(end - 1.5 * plan.period)
    return Clipped(plan.covering(end), plan.start, end)


def _common_period(periods: Sequence[float]) -> float:
    """Smallest common multiple of periods, up to rounding."""
    first = periods[0]
    ratios = [Fraction(period / first).limit_denominator(_PASSES) for period in periods]
    common = Fraction(math.lcm(*(r.numerator for r in ratios)), math.gcd(*(r.denominator for r in ratios)))
    for period, ratio in zip(periods, ratios, strict=True):
        if not abs(period - first * float(ratio)) <= _SAME * period or common / ratio > _PASSES:
            raise ValueError(
                f"periods of plans that repeat for all future times must have a common multiple of at most {_PASSES} "
                f"periods, got {time_text(first)} s and {period:.9g} s; repeat one of them a number of times"
            )
    return first * float(common)


def _checked_passes(count: object) -> int:
    """Integer above 0."""
    passes = one_number(count, "count", "an integer of at least 1, or None for all future times")
    if not (math.isfinite(passes) and passes == int(passes) and passes >= 1.0):
        raise ValueError(f"count must be an integer of at least 1, or None for all future times, got {count}")
    return int(passes)
