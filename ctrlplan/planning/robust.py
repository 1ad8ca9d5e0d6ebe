"""Minimum duration of a plan under limits over ranges of parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ctrlplan.planning.durations import replanned
from ctrlplan.planning.fastest import Fastest, Hold, fastest_under
from ctrlplan.planning.limits import Limited, Margins
from ctrlplan.planning.parameters import Family, Point, margins_over
from ctrlplan.trajectories import Trajectory

_ROUNDS = 40
"""Maximum number of searches for worse parameters."""

_TOLERANCE = 1e-9
"""Violation of a limit, relative to its scale, that counts as rounding."""

_SHORTER = "violate a limit for some parameters within the ranges"
"""Statement on shorter durations."""

_FURTHER = (4.0, 64.0)
"""Ends of the search of a longer duration, relative to its beginning."""


def fastest_over(
    plan: Trajectory,
    limits: Mapping[str, object],
    family: Family,
    hold: Hold,
    span: tuple[float, float] | None,
    tail: float | None,
    resolution: float,
) -> Fastest:
    """Plan of minimum duration whose limits are satisfied over ranges of parameters.

    The shortest duration for some parameters is a lower bound of that for all.
    The worst parameters at that duration are added, until there is no violation.

    Parameters
    ----------
    plan, limits, hold, tail, resolution
        As for `fastest`.
    family : Family
        The systems.
    span : (float, float) or None
        Interval of durations [s] of the search.
    """
    search = _Durations(plan, limits, family, hold, span, tail, resolution)
    duration, lengthening = search.shortest(None), 1e-9
    for _ in range(_ROUNDS):
        tried = search.plan(duration)
        found = margins_over(tried, limits, family, tail, given=plan)
        if found.active.fraction >= -_TOLERANCE:
            limited = search.limited(family.point(found.active.parameters))
            searched = span or (duration, math.inf)
            return Fastest(tried, found, ((duration, duration),), hold, limited, "", searched, _SHORTER)
        before = duration
        search.add_worst(found)
        duration = search.shortest(duration)
        if duration <= before * (1.0 + 1e-9):  # the worst parameters move by less than the search resolves
            duration, lengthening = before * (1.0 + lengthening), 2.0 * lengthening
    raise RuntimeError(
        f"limits must be satisfied over the ranges of parameters after {_ROUNDS} searches for the worst ones, got "
        f"{found.active} at a duration of {duration:.6g} s; narrow the ranges, or give durations="
    )


class _Durations:
    """Shortest durations for a growing set of parameters."""

    def __init__(
        self,
        plan: Trajectory,
        limits: Mapping[str, object],
        family: Family,
        hold: Hold,
        span: tuple[float, float] | None,
        tail: float | None,
        resolution: float,
    ) -> None:
        self._given, self._limits, self._family, self._hold = plan, limits, family, hold
        self._span, self._tail, self._resolution = span, tail, resolution
        self._members: dict[Point, Limited] = {}
        self.limited(family.centre)

    def plan(self, duration: float) -> Trajectory:
        """Plan of a duration."""
        return replanned(self._given, duration) if self._hold == "waypoints" else self._given.retime(duration)

    def limited(self, point: Point) -> Limited:
        """Limits with the system at a point, which is added to the set."""
        found = self._members.get(point)
        if found is None:
            found = self._members[point] = self._family.limited(self._given, self._limits, point, self._tail)
        return found

    def add_worst(self, margins: Margins) -> None:
        """Add the worst parameters of each limit that is violated."""
        for row in margins:
            if row.fraction < 0.0 and row.parameters:
                self.limited(self._family.point(row.parameters))

    def shortest(self, duration: float | None) -> float:
        """Shortest duration that satisfies the limits for all members, not below another one."""
        while True:
            before = duration
            for limited in self._members.values():
                if duration is None or limited.exact_excess(self.plan(duration)) > 0.0:
                    duration = self._next(limited, duration)
            if duration is not None and duration == before:
                return duration

    def _next(self, limited: Limited, duration: float | None) -> float:
        """Shortest duration for one member, not below another one."""
        if duration is None or self._span is not None:
            span = self._span if duration is None else (duration, max(duration, (self._span or (0.0, 0.0))[1]))
            return fastest_under(self._given, limited, self._hold, span, self._resolution).duration
        for factor in _FURTHER[:-1]:
            try:
                span = (duration, factor * duration)
                return fastest_under(self._given, limited, self._hold, span, self._resolution).duration
            except ValueError:  # no duration within the interval
                continue
        span = (duration, _FURTHER[-1] * duration)
        return fastest_under(self._given, limited, self._hold, span, self._resolution).duration
