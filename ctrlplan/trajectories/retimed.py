"""Time reparametrisation of a plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import checked_labels
from ctrlplan._display import time_text
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.combined import is_shaped, is_unit_rate
from ctrlplan.trajectories.common import FACTORIALS, Array, readonly
from ctrlplan.trajectories.files import trajectory_from_dict
from ctrlplan.trajectories.time_law import TimeLaw
from ctrlplan.trajectories.trajectory import Trajectory, check_end

_MANY = 16
"""Number of segments above which they are evaluated together."""

_ROUNDING = 1e-12
"""Relative rounding error allowed in times and rates."""


class Retimed(Trajectory):
    """Plan with another time law: plan(law(t)).

    Parameters
    ----------
    plan : Trajectory
        Plan to be reparametrised, with a duration.
    law : Trajectory
        Time law: time of the plan [s] as a function of time [s], on one axis,
        continuous and strictly increasing from the plan's start to its end.
    labels : sequence of str, optional
        Names of the axes; default: those of the plan.

    Attributes
    ----------
    plan, law
        The arguments.

    Raises
    ------
    TypeError
        If an argument is not a trajectory.
    ValueError
        If the plan has no duration, or the time law has several axes, other
        ends, a jump, or does not increase; if the plan is shaped (`Shaper`) and
        the rate of the law is not 1, which would change the delays of the shaper.

    Examples
    --------
    A straight line with a trapezoidal velocity profile:

    >>> from ctrlplan.trajectories import PolySpline, Trapezoid, Waypoint
    >>> line = PolySpline([Waypoint(0, 0), Waypoint(4, 8)])
    >>> move = Retimed(line, Trapezoid(4.0, velocity=1.0, acceleration=1.0))
    >>> move.duration, move([0.0, 1.0, 2.5, 5.0], 1)
    (5.0, array([0., 2., 2., 0.]))
    """

    plan: Trajectory
    law: Trajectory
    initial: Array
    final: Array
    _of_segments: NDArray[np.intp]  # (2, nsegments), segments of the law and of the plan

    def __init__(self, plan: Trajectory, law: Trajectory, labels: Sequence[str] | None = None) -> None:
        for name, value in (("plan", plan), ("law", law)):
            if not isinstance(value, Trajectory):
                raise TypeError(f"{name} must be a Trajectory, got {type(value).__name__}")
        names = checked_labels(plan.labels if labels is None else labels, plan.naxes)
        slack = _ROUNDING * max(abs(plan.start), abs(plan.end))
        # Times of the law are rounded, by more than those of the plan if it starts late.
        slack += 16.0 * float(np.spacing(max(abs(law.start), abs(law.end)))) * _end_rate(law)
        values = _checked_law(plan, law, slack)
        passed = np.array([_passing(law, values, float(b), slack) for b in plan.breakpoints[1:-1]])
        breakpoints = np.union1d(law.breakpoints, passed)
        segments = [np.searchsorted(times, breakpoints[:-1], side="right") for times in (law.breakpoints[1:], passed)]
        self._set_fields(
            plan=plan,
            law=law,
            labels=names,
            breakpoints=readonly(breakpoints),
            initial=plan.initial,
            final=plan.final,
            _of_segments=np.stack(segments),
        )

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {
            "type": "Retimed",
            "plan": self.plan.to_dict(),
            "law": self.law.to_dict(),
            "labels": list(self.labels),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        return cls(trajectory_from_dict(data["plan"]), trajectory_from_dict(data["law"]), data["labels"])

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        return type(self)(self.plan, self.law.map_time(origin, target, rate), self.labels)

    def _has_quick_peaks(self) -> bool:
        return False

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        out = super()._sample(t, low, high, left)
        at_end = t == self.end
        if not left and at_end.any():  # the plan defines its own value at the end
            jets = self.plan.jet([self.plan.end], high), self.law.jet([self.end], high)
            out[:, :, at_end] = _composed_jets(*jets)[low:]
        return out

    def times_at(self, places: Array) -> Array:
        """Times [s] at which the law reaches given times of the plan.

        Parameters
        ----------
        places : ndarray, shape (ntimes,)
            Times [s] of the plan; its ends stand for those outside of it.
        """
        values = self.law(self.law.breakpoints)
        inside, slack = np.clip(places, values[0], values[-1]), _ROUNDING * float(values[-1] - values[0])
        return np.array([_passing(self.law, values, place, slack) for place in inside.tolist()])

    @property
    def in_batches(self) -> bool:
        """Whether segments are evaluated together: many, or those of a law that are."""
        return self.law.in_batches or self.breakpoints.size > _MANY

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        inner, of_plan = self.laws_jet(segments, s, order)
        return _composed_jets(self.plan.segments_jet(of_plan, self._elapsed(inner[0, 0], of_plan), order), inner)

    def law_jet(self, segment: int, s: Array, order: int) -> tuple[Array, int]:
        """Derivatives of the law in a segment, and the plan's segment."""
        of_law, of_plan = self._of_segments[:, segment].tolist()
        return self.law.segment_jet(of_law, s + self._since(segment), order), of_plan

    def laws_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> tuple[Array, NDArray[np.intp]]:
        """As `law_jet`, each time in its own segment."""
        of_law, of_plan = self._of_segments[:, segments]
        since = self.breakpoints[segments] - self.law.breakpoints[of_law]
        return self.law.segments_jet(of_law, s + since, order), of_plan

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        inner, of_plan = self.law_jet(segment, s, order)
        return _composed_jets(self.plan.segment_jet(of_plan, self._elapsed(inner[0, 0], of_plan), order), inner)

    def _elapsed(self, time: Array, of_plan: NDArray[np.intp] | int) -> Array:
        """Times since the starts of segments of the plan, within them up to more than rounding.

        Beyond its end a plan that is at rest there would move back, by rounding times the rate.
        """
        begins, ends = self.plan.breakpoints[of_plan], self.plan.breakpoints[np.asarray(of_plan) + 1]
        elapsed = time - begins
        inside = np.clip(elapsed, 0.0, ends - begins)
        return np.where(np.abs(elapsed - inside) <= _ROUNDING * (ends - begins), inside, elapsed)

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        of_law, of_plan = self._of_segments[:, segment].tolist()
        ((time, *rates),) = self.law.segment_series(of_law, s + self._since(segment), order)
        elapsed = time - float(self.plan.breakpoints[of_plan])
        return [composed(row, rates) for row in self.plan.segment_series(of_plan, elapsed, order)]

    def _since(self, segment: int) -> float:
        """Time [s] from the start of the law's segment to the start of a segment of this plan."""
        return float(self.breakpoints[segment] - self.law.breakpoints[self._of_segments[0, segment]])


def composed(outer: Sequence[Value], inner: Sequence[Value]) -> list[Value]:
    """Taylor series of a composition of functions.

    Coefficients may be numbers, arrays that broadcast, or symbols.

    Parameters
    ----------
    outer : sequence of length order + 1
        Coefficients of the outer function about the value of the inner one.
    inner : sequence of length order
        Coefficients 1, 2, ... of the inner function, without its value.

    Returns
    -------
    list of length order + 1
    """
    found = [outer[len(inner)]]
    for value in reversed(outer[: len(inner)]):
        found = [value, *(sum(inner[i] * found[k - i] for i in range(k + 1)) for k in range(len(found)))]
    return found


def _composed_jets(outer: Array, inner: Array) -> Array:
    """Jet of the composition of a plan (order + 1, naxes, ntime) with a time law (order + 1, 1, ntime)."""
    factorials = FACTORIALS[: len(outer), None, None]
    rows = composed(list(outer / factorials), list(inner / factorials)[1:])
    return np.array(rows) * factorials


def _checked_law(plan: Trajectory, law: Trajectory, slack: float) -> Array:
    """Values of a time law at its breakpoints, after a check that it runs through the plan."""
    check_end(plan)
    check_end(law, "law")
    if not plan.duration:
        raise ValueError("plan must have a duration, got a step")
    if law.naxes != 1:
        raise ValueError(f"law must have one axis, got {law.naxes}: {', '.join(law.labels)}")
    values = law.positions if isinstance(law, TimeLaw) else law(law.breakpoints)
    first, last = float(law.initial[0]), float(law.final[0])
    if max(abs(first - plan.start), abs(last - plan.end)) > slack:
        raise ValueError(
            f"law must lead from the plan's start {plan.start} s to its end {plan.end} s, got {first} to {last}"
        )
    if isinstance(law, TimeLaw) and not is_shaped(plan):  # continuous and increasing
        return values
    for jump in law.jumps(0):
        raise ValueError(f"law must be continuous, got a jump by {jump.size:g} at {time_text(jump.time)} s")
    rate = law.extrema(1)
    if rate.minimum[0] < -_ROUNDING * rate.maximum[0]:
        raise ValueError(f"law must increase, got the rate {rate.minimum[0]:g} at {time_text(rate.time_min[0])} s")
    if is_shaped(plan) and not (is_unit_rate(float(rate.minimum[0])) and is_unit_rate(float(rate.maximum[0]))):
        raise ValueError(
            f"law must have the rate 1 where the plan is shaped, got {rate.minimum[0]:g} to {rate.maximum[0]:g}: the "
            f"delays of the shaper would change with it; retime the plan before it is shaped, then shape the result"
        )
    for segment in np.flatnonzero(np.diff(values) <= 0.0).tolist():
        raise ValueError(
            f"law must increase strictly, got {values[segment]:g} from {time_text(law.breakpoints[segment])} s on"
        )
    return values


def _end_rate(law: Trajectory) -> float:
    """Maximum of the mean rate of a law and those at its ends."""
    if not law.duration:
        return 0.0
    mean = float(np.abs(law.final - law.initial).max()) / law.duration
    return max(mean, *(float(np.abs(law.jet([t], 1, left=t > law.start)[1]).max()) for t in (law.start, law.end)))


def _passing(law: Trajectory, values: Array, target: float, slack: float) -> float:
    """Time at which an increasing law, with given values at its breakpoints, reaches a target."""
    from scipy.optimize import brentq  # takes a fifth of the time of importing all trajectories

    following = int(np.searchsorted(values, target))
    nearest = min(max(following - 1, 0), values.size - 1)
    if following < values.size and abs(values[following] - target) < abs(values[nearest] - target):
        nearest = following
    # At a rate of 0 the error of a root would be the square root of the rounding.
    if abs(values[nearest] - target) <= slack:
        return float(law.breakpoints[nearest])
    segment = following - 1
    origin, end = law.breakpoints[segment : segment + 2].tolist()

    def excess(s: float) -> float:
        return float(law.segment_jet(segment, np.array([s]), 0)[0, 0, 0]) - target

    eps = np.finfo(float).eps
    return origin + float(brentq(excess, 0.0, end - origin, xtol=eps * (end - origin), rtol=4.0 * eps))
