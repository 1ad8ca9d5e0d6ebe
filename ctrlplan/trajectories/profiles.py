"""Time-optimal rest-to-rest moves: trapezoidal and S-curve profiles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import new_numbers
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import FACTORIALS, Array, mapped_time, readonly, times_powers
from ctrlplan.trajectories.step import Step
from ctrlplan.trajectories.trajectory import Trajectory
from ctrlplan.trajectories.waypoint import Waypoint
from ctrlplan.trajectories.waypoint_spline import FromWaypoints, checked_waypoints


class _Profile(Trajectory, FromWaypoints):
    """Line initial + (final - initial) s(t) from rest to rest, with acceleration, cruise and mirrored deceleration.

    The acceleration phase is evaluated from the start, the deceleration phase
    backwards from the end, so that both positions are exact. s is computed from
    the differences of the rounded breakpoints: for any start time continuity
    and limits hold to the last digits.
    """

    velocity: Array
    acceleration: Array
    initial: Array
    final: Array
    _change: Array
    _lasts: list[float]
    _taylor: list[list[float]]
    _nfall: int

    _names: ClassVar[tuple[str, ...]]
    _ramp: ClassVar[Array]  # relative highest continuous derivative at both ends of each segment of the rise

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {
            "type": type(self).__name__,
            "final": self.final.tolist(),
            "initial": self.initial.tolist(),
            **{name: getattr(self, name).tolist() for name in self._names},
            "time": self.start,
            "labels": list(self.labels),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        ends = Step(data["final"], data["initial"], data["time"], data["labels"])
        return cls._of(ends, [data[name] for name in cls._names])

    @classmethod
    def from_waypoints(cls, waypoints: Iterable[Waypoint], **options: Any) -> Self:
        """Time-optimal move between two waypoints at rest.

        It starts at the time of the first waypoint and is at rest from its end
        on, which is not after the second. At both ends the derivatives that
        jump, such as the acceleration of a trapezoid, are 0 outside.

        Raises
        ------
        ValueError
            If there are more than two waypoints, a position is free, a derivative
            is not 0, or the limits do not allow the move in the time between
            them.
        """
        start, end = _rest_to_rest(checked_waypoints(waypoints), cls.__name__)
        found = cls._of(
            Step(end.position, start.position, start.time, start.labels), [options[name] for name in cls._names]
        )
        if found.duration > (end.time - start.time) * (1.0 + 1e-9):
            raise ValueError(
                f"limits must allow the move within the {end.time - start.time:g} s between its waypoints, "
                f"got {found.duration:.6g} s"
            )
        return found

    @classmethod
    def _of(cls, ends: Step, limits: list[ArrayLike]) -> Self:
        self = cls.__new__(cls)
        self._set(ends, *limits)
        return self

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        ends = Step(self.final, self.initial, mapped_time(self.start, origin, target, rate), self.labels)
        limits = np.array([getattr(self, name) for name in self._names])
        return self._of(ends, list(times_powers(limits, rate, np.arange(1, len(limits) + 1)[:, None])))

    def _set(self, ends: Step, *limits: ArrayLike) -> None:
        with np.errstate(over="ignore"):
            change = ends.final - ends.initial
        if not (np.isfinite(change).all() and change.any()):
            raise ValueError(
                "final must differ from initial by a finite length, "
                f"got {ends.final.tolist()} after {ends.initial.tolist()}"
            )
        given = [_checked_limit(*pair, ends.labels) for pair in zip(limits, self._names, strict=True)]
        moves = change != 0.0
        with np.errstate(all="ignore"):
            durations = _fastest(*((limit[moves] / np.abs(change[moves])).min() for limit in given))
        if not np.isfinite(durations).all():
            raise ValueError(f"limits must give segments of finite durations, got {durations.tolist()} s")
        minimum = 8.0 * np.finfo(float).eps * (abs(ends.start) + durations.sum())
        present = durations > minimum  # shorter ones are the rounding of a segment of zero duration
        nrise = len(self._ramp)
        if not present[:nrise].any():
            raise ValueError(
                f"limits must give an acceleration phase of more than {minimum:.3g} s at time = {ends.start:g} s, "
                f"got {durations[:nrise].sum():.3g} s"
            )
        times = [ends.start]
        # If durations were rounded down, or omitted segments not compensated, the others would exceed their limits.
        for duration in (durations[present] + durations[~present].clip(min=0.0).sum()).tolist():
            time = times[-1] + duration
            times.append(time if time - times[-1] >= duration else math.nextafter(time, math.inf))
        lasts, ramp = np.diff(times), self._ramp[present[:nrise]]
        rise, before = _rise(lasts[: len(ramp)], ramp, len(given))
        fall, after = _rise(lasts[::-1][: len(ramp)], ramp, len(given))
        cruise = np.zeros((int(present[nrise]), rise.shape[1]))
        cruise[:, :2] = before, 1.0
        if not np.isfinite(cruise).all():
            raise ValueError(f"limits must give segments within floating point, got durations {durations.tolist()} s")
        whole = before + float(lasts[len(ramp) : -len(ramp)].sum()) + after
        self._set_fields(
            **dict(zip(self._names, given, strict=True)),
            initial=ends.initial,
            final=ends.final,
            labels=ends.labels,
            breakpoints=readonly(np.array(times)),
            _change=change,
            _lasts=lasts.tolist(),
            _taylor=(np.concatenate([rise, cruise, fall[::-1]]) / whole).tolist(),
            _nfall=len(ramp),
        )

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        anchor, series = self._law(segment, s, order)
        law = np.array([np.broadcast_to(row, s.shape) for row in series]) * FACTORIALS[: order + 1, None]
        out: Array = self._change[:, None] * law[:, None]
        out[0] += anchor[:, None]
        return out

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        anchor, (first, *rest) = self._law(segment, s, order)
        axes = zip(anchor.tolist(), self._change.tolist(), strict=True)
        return [[position + change * first, *(change * value for value in rest)] for position, change in axes]

    def _law(self, segment: int, s: Value, order: int) -> tuple[Array, list[Value]]:
        """Reference position of a segment, and the Taylor series of s relative to it."""
        if segment < len(self._lasts) - self._nfall:
            return self.initial, _shifted(self._taylor[segment], s, order)
        mirrored = _shifted(self._taylor[segment], self._lasts[segment] - s, order)
        return self.final, [value if k % 2 else -value for k, value in enumerate(mirrored)]


class Trapezoid(_Profile):
    """Time-optimal rest-to-rest move with limited acceleration.

    With limits on velocity and acceleration the velocity profile is a trapezoid,
    or a triangle if the distance is too short to reach the velocity limit.
    Several axes are synchronised on the straight line from `initial` to `final`
    in the minimum time under all limits. The acceleration jumps at every
    breakpoint.

    Parameters
    ----------
    final : array_like, scalar or shape (naxes,)
        Position at the end.
    initial : array_like, optional
        Position at the start.
    velocity, acceleration : array_like, scalar or shape (naxes,)
        Maximum magnitudes, above 0 [unit of the axis per s, per s^2].
    time : float, optional
        Start [s].
    labels : sequence of str, optional
        Names of the axes.

    Attributes
    ----------
    velocity, acceleration : ndarray, shape (naxes,)
        The limits.

    Raises
    ------
    ValueError
        If a limit is not above 0 and finite, no axis moves, a position is not
        finite, shapes differ, or floating-point times do not resolve the
        acceleration phase.

    Examples
    --------
    The duration is d/v + v/a if v^2/a < d, otherwise 2 sqrt(d/a):

    >>> Trapezoid(3.0, velocity=1.0, acceleration=0.5).duration
    5.0
    >>> Trapezoid(1.0, velocity=9.0, acceleration=1.0).breakpoints
    array([0., 1., 2.])
    """

    family = "trapezoid"
    options = ("velocity", "acceleration")
    _names = options
    _ramp = readonly(np.array([[0.0, 1.0]]))

    def __init__(
        self,
        final: ArrayLike,
        initial: ArrayLike = 0.0,
        *,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        time: float = 0.0,
        labels: Sequence[str] | None = None,
    ) -> None:
        self._set(Step(final, initial, time, labels), velocity, acceleration)


class SCurve(_Profile):
    """Time-optimal rest-to-rest move with limited jerk.

    With limits on velocity, acceleration and jerk the move has seven segments of
    constant jerk, or fewer if the velocity or acceleration limit is not reached.
    Several axes are synchronised on the straight line from `initial` to `final`
    in the minimum time under all limits. The jerk jumps at every breakpoint.

    Parameters
    ----------
    final : array_like, scalar or shape (naxes,)
        Position at the end.
    initial : array_like, optional
        Position at the start.
    velocity, acceleration, jerk : array_like, scalar or shape (naxes,)
        Maximum magnitudes, above 0 [unit of the axis per s, per s^2, per s^3].
    time : float, optional
        Start [s].
    labels : sequence of str, optional
        Names of the axes.

    Attributes
    ----------
    velocity, acceleration, jerk : ndarray, shape (naxes,)
        The limits.

    Raises
    ------
    ValueError
        If a limit is not above 0 and finite, no axis moves, a position is not
        finite, shapes differ, or floating-point times do not resolve the
        acceleration phase.

    Examples
    --------
    If every limit is reached, the duration is d/v + v/a + a/j:

    >>> SCurve(4.0, velocity=1.0, acceleration=0.5, jerk=0.5).duration
    7.0
    """

    jerk: Array

    family = "s_curve"
    options = ("velocity", "acceleration", "jerk")
    _names = options
    _ramp = readonly(np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]))

    def __init__(
        self,
        final: ArrayLike,
        initial: ArrayLike = 0.0,
        *,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        jerk: ArrayLike,
        time: float = 0.0,
        labels: Sequence[str] | None = None,
    ) -> None:
        self._set(Step(final, initial, time, labels), velocity, acceleration, jerk)


def _rest_to_rest(points: tuple[Waypoint, ...], kind: str) -> tuple[Waypoint, Waypoint]:
    """Start and end of a rest-to-rest move, checked."""
    if len(points) != 2:
        raise ValueError(f"a {kind} must have exactly two waypoints, got {len(points)} waypoints")
    for i, point in enumerate(points):
        if np.isnan(point.position).any():
            raise ValueError(f"a {kind} must have its positions prescribed, got waypoints[{i}] = {point}")
        if np.nan_to_num(point.jet[1:]).any():
            raise ValueError(f"a {kind} must be at rest at its waypoints, got waypoints[{i}] = {point}")
    return points[0], points[1]


def _fastest(velocity: float, acceleration: float, jerk: float = math.inf) -> Array:
    """Segment durations of the time-optimal unit move; without a jerk limit the acceleration phase is one segment."""
    ramp = min(acceleration / jerk, np.sqrt(velocity / jerk), np.cbrt(0.5 / jerk))
    peak = acceleration if ramp == acceleration / jerk else jerk * ramp
    to_limit = velocity / peak + ramp
    halfway = 0.5 * (ramp + np.hypot(ramp, 2.0 / np.sqrt(peak)))  # acceleration over half of the distance
    rises = min(to_limit, halfway)
    cruise = 1.0 / velocity - to_limit if to_limit < halfway else 0.0
    rise = [rises] if jerk == math.inf else [ramp, rises - 2.0 * ramp, ramp]
    return np.array([*rise, cruise, *rise])


def _rise(lasts: Array, ramp: Array, order: int) -> tuple[Array, float]:
    """Acceleration to unit velocity: Taylor coefficients (nsegments, order + 1) by segment; distance."""
    rows, end = [(ramp[:, 1] - ramp[:, 0]) / lasts, ramp[:, 0]], [float(ramp[-1, 1])]
    for _ in range(order - 1):
        grown = np.cumsum(sum(row * lasts**k / FACTORIALS[k] for k, row in enumerate(reversed(rows), 1)))
        rows.append(np.append(0.0, grown[:-1]))
        end.append(float(grown[-1]))
    velocity, length = end[-2:]
    return np.array(rows[::-1]).T / (velocity * FACTORIALS[: order + 1]), length / velocity


def _shifted(taylor: list[float], s: Value, order: int) -> list[Value]:
    """Coefficients of a polynomial about s, from those about 0."""
    found: list[Value] = list(taylor)
    for k in range(len(found) - 1):
        for m in range(len(found) - 2, k - 1, -1):
            found[m] = found[m] + s * found[m + 1]
    return [*found, *[0.0] * order][: order + 1]


def _checked_limit(limit: ArrayLike, name: str, labels: tuple[str, ...]) -> Array:
    """Limit of each axis, checked."""
    values = new_numbers(limit, name)
    if values.shape not in ((), (len(labels),)):
        raise ValueError(f"{name} must be a scalar or of shape ({len(labels)},), got shape {values.shape}")
    for label, value in zip(labels, np.broadcast_to(values, len(labels)).tolist(), strict=True):
        if not 0.0 < value < math.inf:
            raise ValueError(f"{name} must be above 0 and finite, got {value}{f' of {label}' if values.ndim else ''}")
    return readonly(np.broadcast_to(values, len(labels)).copy())
