"""Plans of vehicles that stop: plane curves, each with a direction of travel and a time law."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_count, checked_finite, checked_labels, checked_timepts, one_number
from ctrlplan._display import time_text
from ctrlplan._types import Data
from ctrlplan.trajectories.clipped import Clipped
from ctrlplan.trajectories.combined import Joined, check_join
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.files import trajectory_from_dict
from ctrlplan.trajectories.path_coordinate import Pieces, path_coordinate, with_coordinate
from ctrlplan.trajectories.retimed import Retimed
from ctrlplan.trajectories.trajectory import Trajectory

_SMALL = 1e-9
"""Rate at the end of a time law, relative to its peak, that counts as rest."""

_SLOWEST = 1e-6
"""Minimum of abs(dp/ds) relative to its maximum on a segment."""

_TURN = 1e-6
"""Difference of headings [rad] that counts as none."""


class PathPlan(Joined):
    """Path of a vehicle with stops: plane curves with time laws.

    The position is p(s(t)) with a curve p(s) and a time law s(t) on each segment.

    The heading of a vehicle, the direction of its velocity, is not determined by
    x(t) and y(t) where it stops. Here it is that of the curve p(s), so that states
    and inputs of cars and other vehicles are finite at the stops, where they may
    change between forward and backward travel (cusps).
    `ctrlplan.FlatSystem.states_and_inputs`, `ctrlplan.flat_loop` and
    `ctrlplan.fastest` evaluate such a plan by the maps of the vehicle at unit speed
    along p(s). Everything else is inherited from `Trajectory`.

    Parameters
    ----------
    segments : sequence of Trajectory
        Plane curves p(s): trajectories of two axes [m] whose "time" is the
        parameter s, of any unit, with abs(dp/ds) above 0. Each begins where the
        previous one ends.
    directions : sequence of int
        Direction of travel on each segment: 1 forward, -1 backward. The heading is
        that of dp/ds times the direction, and continuous from segment to segment.
    law : sequence of Trajectory, or Trajectory
        Time law s(t) of each segment, one axis, increasing from the first to the
        last parameter of the segment, at rest at both ends. Each is shifted in time
        to begin where the previous one ends. A single trajectory is the time law
        of every segment or, if the parameter of each segment begins where that of
        the previous one ends, the time law of all of them one after the other.
    labels : sequence of str, optional
        Names of the axes, by default x and y.

    Attributes
    ----------
    segments : tuple of Trajectory
        The curves.
    directions : tuple of int
        The directions of travel.
    laws : tuple of Trajectory
        The time laws, at the times of the plan.
    stops : tuple of float
        Times [s] at which the plan is at rest: its start, the ends of inner
        segments, its end.

    Raises
    ------
    TypeError
        If a segment or a time law is not a trajectory.
    ValueError
        If a segment has not two axes, stands still or has a corner; a direction is
        neither 1 nor -1; numbers of arguments differ; a time law does not
        lead from rest to rest over its segment; positions or headings differ where
        segments join.

    See Also
    --------
    Retimed : one curve with a time law, for plants that are determined at rest.

    Examples
    --------
    A parking manoeuvre: forward and to the left, then backward into a bay at 90
    degrees to the lane.

    >>> import ctrlplan as cp
    >>> forward = cp.PolySpline([
    ...     cp.Waypoint.from_jets(0, x=[0, 8, 0], y=[0, 0, 0]),
    ...     cp.Waypoint.from_jets(1, x=[6, 5, 0], y=[2, 5, 0]),
    ... ])
    >>> backward = cp.PolySpline([
    ...     cp.Waypoint.from_jets(0, x=[6, -5, 0], y=[2, -5, 0]),
    ...     cp.Waypoint.from_jets(1, x=[2, 0, 0], y=[-4, -9, 0]),
    ... ])
    >>> law = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(5, 1, 0, 0)])
    >>> plan = cp.PathPlan([forward, backward], [1, -1], law)
    >>> plan.stops, plan(5.0)
    ((0.0, 5.0, 10.0), array([6., 2.]))
    >>> s, p = plan.path_jet([5.0, 7.5], 1)
    >>> s[1].round(3), p[1, :, 0]
    (array([0.   , 0.375]), array([-5., -5.]))
    """

    directions: tuple[int, ...]
    parts: tuple[Retimed, ...]

    def __init__(
        self,
        segments: Iterable[Trajectory],
        directions: Iterable[float],
        law: Iterable[Trajectory] | Trajectory,
        *,
        labels: Sequence[str] = ("x", "y"),
    ) -> None:
        curves = _checked_curves(segments)
        self._set_fields(directions=_checked_directions(directions, len(curves)))
        super().__init__(_timed(curves, law, labels))
        self._check_headings()

    @property
    def segments(self) -> tuple[Trajectory, ...]:
        """The curves."""
        return tuple(part.plan for part in self.parts)

    @property
    def laws(self) -> tuple[Trajectory, ...]:
        """The time laws, at the times of the plan."""
        return tuple(part.law for part in self.parts)

    @property
    def stops(self) -> tuple[float, ...]:
        """Times [s] of the start and of the end of each segment."""
        return (self.start, *(part.end for part in self.parts))

    @cached_property
    def pieces(self) -> Pieces:
        """The analytic pieces of all segments."""
        return Pieces(self.segments)

    @cached_property
    def coordinate(self) -> Trajectory:
        """Path parameter over time, shifted as `Pieces` says."""
        return path_coordinate(self.parts, self.pieces)

    @cached_property
    def with_coordinate(self) -> Trajectory:
        """The plan with `coordinate` as a third axis."""
        return with_coordinate(self, self.coordinate)

    def path_jet(self, t: ArrayLike, order: int, left: bool = False) -> tuple[Array, Array]:
        """Path parameter and position, with their derivatives.

        Parameters
        ----------
        t : array_like, any shape
            Times [s], in any order.
        order : int
            Highest derivative.
        left : bool, optional
            Return the limit from the left at breakpoints.

        Returns
        -------
        s : ndarray, shape (order + 1, *t.shape)
            Parameter of the segment at each time, and its derivatives by time.
        p : ndarray, shape (order + 1, 2, *t.shape)
            Position, and its derivatives by the parameter.

        Raises
        ------
        ValueError
            If a time is nan or the order is negative.
        """
        times, highest = checked_timepts(t), checked_count(order, "order")
        jet = self.coordinate.jet(times.ravel(), highest, left)[:, 0]
        numbers, jet[0] = self.pieces.located(jet[0])
        p = self.pieces.jet(numbers, jet[0], highest)
        return jet.reshape(highest + 1, *times.shape), p.reshape(highest + 1, self.naxes, *times.shape)

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {
            "type": "PathPlan",
            "segments": [curve.to_dict() for curve in self.segments],
            "directions": list(self.directions),
            "laws": [law.to_dict() for law in self.laws],
            "labels": list(self.labels),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        curves = _checked_curves(trajectory_from_dict(curve) for curve in data["segments"])
        parts = _timed(curves, [trajectory_from_dict(law) for law in data["laws"]], tuple(data["labels"]))
        for before, after in pairwise(parts):
            check_join(before, after)
        found = cls._through(parts, _checked_directions(data["directions"], len(curves)))
        found._check_headings()
        return found

    @classmethod
    def _through(cls, parts: Sequence[Retimed], directions: tuple[int, ...]) -> Self:
        """Plan of parts at their own times, without checks."""
        found = cls.__new__(cls)
        found._set_fields(directions=directions)
        found._set(tuple(parts), parts[0].labels)
        return found

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        return self._through([part.map_time(origin, target, rate) for part in self.parts], self.directions)

    def then(self, other: Trajectory) -> Trajectory:
        """This trajectory followed by another; as `Trajectory.then`.

        The sequence of two path plans is a path plan, with a stop between them.
        """
        if not isinstance(other, PathPlan):
            return super().then(other)
        return PathPlan(
            [*self.segments, *other.segments],
            [*self.directions, *other.directions],
            [*self.laws, *other.laws],
            labels=self.labels,
        )

    def select(self, labels: Sequence[str]) -> Trajectory:
        """Trajectory of some axes by name; of both axes, a path plan."""
        if sorted(labels) != sorted(self.labels):
            return super().select(labels)
        order = [self.labels.index(label) for label in labels]
        curves = [curve.select([curve.labels[axis] for axis in order]) for curve in self.segments]
        return self._through(
            [Retimed(curve, law, labels) for curve, law in zip(curves, self.laws, strict=True)], self.directions
        )

    def on_cycle(self, dt: float, limits: Mapping[str, object] | None = None) -> Trajectory:
        """Plan whose segments last whole cycles of a drive; as `Trajectory.on_cycle`."""
        found = super().on_cycle(dt, limits)
        parts = [part for part in getattr(found, "parts", ()) if isinstance(part, Retimed)]
        return self if found is self else self._through(parts, self.directions)

    def stop(
        self,
        time: float,
        limits: Mapping[str, object],
        *,
        synchronize: Literal["time", "path"] | None = "path",
    ) -> Trajectory:
        """Plan until a time, then to rest in minimum time; as `Trajectory.stop`.

        By default, ``synchronize="path"``, a path plan that ends on its path, at the
        end of the present segment at the latest. "time" and None leave the path,
        so that a vehicle with a heading cannot follow them.
        """
        moment = checked_finite(time, "time")
        if synchronize != "path" or not self.start <= moment <= self.end:
            return super().stop(moment, limits, synchronize=synchronize)
        count = 1 + int(np.searchsorted(self.stops[1:-1], moment))
        begun = self._through(self.parts[:count], self.directions[:count])
        stopped = super(PathPlan, begun).stop(moment, limits, synchronize="path")
        tail = stopped.parts[-1] if isinstance(stopped, Joined) else stopped
        if isinstance(stopped, PathPlan) or not isinstance(tail, Retimed):
            return stopped
        return begun._braked(moment, tail)

    def _braked(self, time: float, tail: Retimed) -> Self:
        """Plan whose last segment is followed from a time on by another time law, that of its time."""
        *parts, last = self.parts
        curve, law = last.plan, last.law
        braking = Retimed(Clipped(law, time, min(tail.plan.end, law.end)), tail.law)
        whole = braking if time <= law.start else Joined.without_shift([Clipped(law, law.start, time), braking])
        end = min(float(whole.final[0]), curve.end)
        passed = curve if end == curve.end else Clipped(curve, curve.start, end)
        return self._through([*parts, Retimed(passed, whole, self.labels)], self.directions)

    def with_laws(self, laws: Sequence[Trajectory]) -> Self:
        """Same path with other time laws."""
        return type(self)(self.segments, self.directions, laws, labels=self.labels)

    def _has_quick_peaks(self) -> bool:
        return False

    def _facts(self) -> list[tuple[str, str]]:
        names = {1: "forward", -1: "backward"}
        known = [fact for fact in super()._facts() if fact[0] != "segments"]  # of the curves, not of the time laws
        return [
            *known,
            ("segments", ", ".join(names[direction] for direction in self.directions)),
            ("stops at", ", ".join(f"{time_text(time)} s" for time in self.stops)),
        ]

    def _check_headings(self) -> None:
        """Raise for a heading that differs where segments join."""
        for k, (before, after) in enumerate(pairwise(self.segments)):
            ends = (before.jet(before.end, 1, left=True)[1], after.jet(after.start, 1)[1])
            last, first = (
                math.atan2(*(direction * tangent[::-1] + 0.0).tolist())
                for direction, tangent in zip(self.directions[k : k + 2], ends, strict=True)
            )
            turn = abs(math.remainder(first - last, math.tau))
            if turn > _TURN:
                other = -self.directions[k + 1]
                hint = f"; with directions[{k + 1}] = {other} it is continuous" if math.pi - turn < _TURN else ""
                raise ValueError(
                    f"heading must be continuous at the stop at {self.stops[k + 1]:.6g} s, got {last:.6g} rad "
                    f"({math.degrees(last):.4g} degrees) at the end of segments[{k}] and {first:.6g} rad "
                    f"({math.degrees(first):.4g} degrees) at the start of segments[{k + 1}]{hint}"
                )


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is rejected
def _checked_curves(segments: Iterable[Trajectory]) -> tuple[Trajectory, ...]:
    """Curves, checked to be plane, regular and without corners."""
    if isinstance(segments, Trajectory) or not isinstance(segments, Iterable):
        raise TypeError(f"segments must be a sequence of trajectories, got {type(segments).__name__}")
    curves = tuple(segments)
    if not curves:
        raise ValueError("segments must contain at least one curve, got none")
    for k, curve in enumerate(curves):
        name = f"segments[{k}]"
        if not isinstance(curve, Trajectory):
            raise TypeError(f"{name} must be a Trajectory, got {type(curve).__name__}")
        if curve.naxes != 2:
            raise ValueError(f"{name} must have two axes, got {curve.naxes}: {', '.join(curve.labels)}")
        if not curve.duration:
            raise ValueError(f"{name} must be a curve over an interval of its parameter, got a step")
        for jump in curve.jumps(1):
            if curve.start < jump.time < curve.end:
                what = f"derivative of {jump.label}" if jump.order else jump.label
                raise ValueError(
                    f"{name} must be continuously differentiable, got a jump of the {what} by {jump.size:.4g} at "
                    f"s = {jump.time:.6g}; split the path there"
                )
        speed = curve.extrema_of(_tangent_length, 1)
        if not speed.minimum[0] > _SLOWEST * speed.maximum[0]:
            raise ValueError(
                f"{name} must have abs(dp/ds) above 0, got {speed.minimum[0]:.3g} at s = {speed.time_min[0]:.6g} and "
                f"up to {speed.maximum[0]:.3g}; prescribe the first derivative of the curve there"
            )
    return curves


def _tangent_length(jet: Array) -> Array:
    return np.hypot(jet[1, 0], jet[1, 1])


def _checked_directions(directions: Iterable[float], count: int) -> tuple[int, ...]:
    """Directions of travel as integers."""
    given = list(directions) if isinstance(directions, Iterable) else [directions]
    if len(given) != count:
        raise ValueError(f"directions must be one for each of {count} segments, got {len(given)}")
    numbers = [one_number(value, f"directions[{k}]", "1 or -1") for k, value in enumerate(given)]
    for k, value in enumerate(numbers):
        if value not in (1.0, -1.0):
            raise ValueError(f"directions[{k}] must be 1 (forward) or -1 (backward), got {value:g}")
    return tuple(map(int, numbers))


def _shared(law: Trajectory, curves: tuple[Trajectory, ...]) -> list[Trajectory]:
    """Time law of each curve from one for all: the same one, or its parts between the breakpoints at its stops."""
    ends = [curve.end for curve in curves]
    consecutive = all(curve.start == end for curve, end in zip(curves[1:], ends[:-1], strict=True))
    slack = 1e-12 * max(map(abs, [curves[0].start, *ends]))
    if len(curves) == 1 or not consecutive or law.naxes > 1 or abs(float(law.final[0]) - ends[-1]) > slack:
        return [law] * len(curves)
    times = [law.start]
    for end in ends[:-1]:
        distance = np.abs(law(law.breakpoints) - end)
        if distance.min() > slack:
            raise ValueError(
                f"law must be at rest at a breakpoint at the end of each segment, got no breakpoint at s = {end:.6g}; "
                "join a time law for each segment by then(), or give a sequence of them"
            )
        times.append(float(law.breakpoints[distance.argmin()]))
    return [Clipped(law, begin, end) for begin, end in pairwise([*times, law.end])]


@np.errstate(over="ignore", invalid="ignore")
def _timed(
    curves: tuple[Trajectory, ...], law: Iterable[Trajectory] | Trajectory, labels: Sequence[str]
) -> list[Retimed]:
    """Curves with their time laws, which lead from rest to rest."""
    names = checked_labels(labels, 2)
    if not isinstance(law, Iterable | Trajectory):
        raise TypeError(f"law must be a Trajectory or one for each segment, got {type(law).__name__}")
    laws = _shared(law, curves) if isinstance(law, Trajectory) else list(law)
    if len(laws) != len(curves):
        raise ValueError(f"law must be one trajectory for each of {len(curves)} segments, got {len(laws)}")
    parts = []
    for k, (curve, own) in enumerate(zip(curves, laws, strict=True)):
        if not isinstance(own, Trajectory):
            raise TypeError(f"law[{k}] must be a Trajectory, got {type(own).__name__}")
        try:
            part = Retimed(curve, own, names)
        except ValueError as error:
            raise ValueError(f"law[{k}] must be a time law of segments[{k}], its plan: {error}") from None
        rates = np.abs([own.jet(own.start, 1)[1, 0], own.jet(own.end, 1, left=True)[1, 0]])
        if (moving := rates > _SMALL * own.peak(1)).any():
            end = int(moving.argmax())
            time = (own.start, own.end)[end]
            raise ValueError(
                f"law[{k}] must be at rest at its ends, got the rate {rates[end]:.4g} at {time_text(time)} s"
            )
        parts.append(part)
    return parts
