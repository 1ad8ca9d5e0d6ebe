"""Part of a plan between two times."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import check_kind, checked_finite
from ctrlplan._display import time_text
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import Array, mapped_time, readonly
from ctrlplan.trajectories.files import trajectory_from_dict
from ctrlplan.trajectories.trajectory import Trajectory


class Clipped(Trajectory):
    """Part of a plan between two times.

    Values and derivatives are those of the plan in every bit. Before its start
    and after its end the part holds its first and last position.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    start, end : float
        First and last time [s], within the plan. A jump of the plan at `end` is not
        part of it.

    Attributes
    ----------
    plan : Trajectory
        The argument; a number of its periods if it repeats for all future times.

    Raises
    ------
    TypeError
        If `plan` is not a trajectory.
    ValueError
        If the times do not increase or are outside of the plan.

    Examples
    --------
    >>> from ctrlplan.trajectories import PolySpline, Waypoint
    >>> half = Clipped(PolySpline([Waypoint(0, 0, 0), Waypoint(2, 4, 0)]), 0.0, 1.0)
    >>> half.duration, half([1.0, 1.5]), half(1.0, 1)
    (1.0, array([2., 2.]), array(3.))
    """

    plan: Trajectory
    initial: Array
    final: Array
    _first: int  # number of the plan's segment that contains the start
    _shifts: Array  # from the start of the plan's segment to that of the own one [s]

    def __init__(self, plan: Trajectory, start: float, end: float) -> None:
        from ctrlplan.trajectories.repeated import covering  # which cuts by this class

        check_kind(plan, "plan", Trajectory)
        first, last = checked_finite(start, "start"), checked_finite(end, "end")
        if not plan.start <= first < last <= plan.end:
            raise ValueError(
                f"start and end must increase and lie within the plan, from {time_text(plan.start)} s to "
                f"{time_text(plan.end)} s, got {time_text(first)} s and {time_text(last)} s"
            )
        plan = covering(plan, last)
        inner = plan.breakpoints[(plan.breakpoints > first) & (plan.breakpoints < last)]
        number = int(np.searchsorted(plan.breakpoints, first, side="right")) - 1
        begins = np.array([first, *inner])
        self._set_fields(
            plan=plan,
            labels=plan.labels,
            breakpoints=readonly(np.array([first, *inner, last])),
            waypoints=tuple(w for w in plan.waypoints if first <= w.time <= last),
            initial=plan.initial if first == plan.start else plan.jet(first, 0)[0],
            final=plan.jet(last, 0, left=True)[0],
            _first=number,
            _shifts=begins - plan.breakpoints[number : number + begins.size],
        )

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {"type": "Clipped", "plan": self.plan.to_dict(), "start": self.start, "end": self.end}

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        return cls(trajectory_from_dict(data["plan"]), data["start"], data["end"])

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        moved = self.plan.map_time(origin, target, rate)
        times = [mapped_time(time, origin, target, rate) for time in (self.start, self.end)]
        # Breakpoints of some plans are rounded differently: an end on one of them stays there.
        near = 8.0 * float(np.spacing(np.abs([*times, moved.start, moved.end]).max()))
        nearest = [float(moved.breakpoints[np.abs(moved.breakpoints - time).argmin()]) for time in times]
        ends = [known if abs(known - time) <= near else time for known, time in zip(nearest, times, strict=True)]
        return type(self)(moved, *ends)

    @property
    def deviation(self) -> Array:
        """Maximum deviation from signals that the plan interpolates."""
        found = getattr(self.plan, "deviation", None)
        if found is None:
            raise AttributeError(
                f"a part of a {type(self.plan).__name__}, which interpolates no signals, has no deviation"
            )
        return np.asarray(found)

    def _facts(self) -> list[tuple[str, str]]:
        errors = getattr(self.plan, "deviation", [0.0] * self.naxes)
        known = [(f"deviation of {name}", f"{e:.3g}") for name, e in zip(self.labels, errors, strict=True) if e]
        return [*super()._facts(), *known]

    def _has_quick_peaks(self) -> bool:
        return super()._has_quick_peaks() and self.plan._has_quick_peaks()

    def segment_rows(self, segment: int, s: float, order: int) -> list[list[float]] | None:
        """Derivatives of a segment at one time; as `Trajectory.segment_rows`."""
        return self.plan.segment_rows(self._first + segment, s + float(self._shifts[segment]), order)

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        return self.plan.segment_jet(self._first + segment, s + self._shifts[segment], order)

    @property
    def in_batches(self) -> bool:
        """Whether segments are evaluated together, as those of the plan are."""
        return self.plan.in_batches

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        return self.plan.segments_jet(self._first + segments, s + self._shifts[segments], order)

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        return self.plan.segment_series(self._first + segment, s + float(self._shifts[segment]), order)
