"""Time-optimal moves: trapezoidal and S-curve profiles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar, Self, get_args

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_vector, new_numbers
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import FACTORIALS, Array, mapped_time, readonly, times_powers
from ctrlplan.trajectories.motion_profile import MotionProfile
from ctrlplan.trajectories.moving import Problem, Ranges, Synchronize, fastest_motion, unit_move
from ctrlplan.trajectories.step import Step
from ctrlplan.trajectories.trajectory import Trajectory
from ctrlplan.trajectories.waypoint import Waypoint
from ctrlplan.trajectories.waypoint_spline import FromWaypoints, checked_waypoints


class _Profile(Trajectory, FromWaypoints):
    """Time-optimal move: a line from rest to rest, or a `MotionProfile`.

    From rest to rest with symmetric limits it is initial + (final - initial) s(t), with
    acceleration, cruise and mirrored deceleration. The acceleration phase is
    evaluated from the start, the deceleration phase backwards from the end, so that
    both positions are exact. s is computed from the differences of the rounded
    breakpoints: for any start time continuity and limits hold to the last digits.
    """

    velocity: Array
    acceleration: Array
    start_velocity: Array
    end_velocity: Array
    synchronize: Synchronize | None
    initial: Array
    final: Array
    _motion: MotionProfile | None = None
    _change: Array
    _lasts: list[float]
    _taylor: list[list[float]]
    _nfall: int

    _names: ClassVar[tuple[str, ...]]
    _state_names: ClassVar[tuple[str, ...]]  # velocities, then accelerations, first at the start, then at the end
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
            **({} if self._motion is None else {"synchronize": self.synchronize, "motion": self._motion.to_dict()}),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        if "motion" in data:
            self = cls.__new__(cls)
            motion = MotionProfile.from_dict(data["motion"])
            limits = self._checked_limits([data[name] for name in cls._names], motion.labels)
            self._set_motion(motion, limits, data["synchronize"])
            return self
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
        limits = {name: options[name] for name in cls._names}
        profile: Callable[..., Self] = cls
        found = profile(end.position, start.position, time=start.time, labels=start.labels, **limits)
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
        if self._motion is not None:
            self_moved = type(self).__new__(type(self))
            rows = [times_powers(getattr(self, name), rate, np.array(k)) for k, name in enumerate(self._names, 1)]
            self_moved._set_motion(self._motion.map_time(origin, target, rate), rows, self.synchronize)
            return self_moved
        ends = Step(self.final, self.initial, mapped_time(self.start, origin, target, rate), self.labels)
        limits = np.array([getattr(self, name) for name in self._names])
        return self._of(ends, list(times_powers(limits, rate, np.arange(1, len(limits) + 1)[:, None])))

    @classmethod
    def _checked_limits(cls, limits: Sequence[ArrayLike], labels: tuple[str, ...]) -> list[Array]:
        """Limits by axis; the highest one has no pairs."""
        return [
            _checked_limit(limit, name, labels, name != "jerk") for limit, name in zip(limits, cls._names, strict=True)
        ]

    def _begin(
        self, ends: Step, limits: Sequence[ArrayLike], states: Sequence[ArrayLike], synchronize: Synchronize | None
    ) -> None:
        """Set the fields: from rest to rest on a line with symmetric limits, otherwise as a motion profile."""
        if synchronize not in (*get_args(Synchronize), None):
            raise ValueError(f'synchronize must be "phase", "time" or None, got {synchronize!r}')
        naxes = ends.final.size
        rows = [checked_vector(value, name, naxes) for value, name in zip(states, self._state_names, strict=True)]
        given = self._checked_limits(limits, ends.labels)
        on_line = synchronize == "phase" or naxes == 1
        if on_line and not np.any(rows) and all(limit.ndim == 1 for limit in given):
            self._set(ends, *given)
            return
        ranges = Ranges(*(np.array([side(limit) for limit in given]) for side in (_low, _high)))
        states_at = [np.array([position, *rows[k::2]]) for k, position in enumerate((ends.initial, ends.final))]
        problem = Problem(states_at[0], states_at[1], ranges, ends.labels)
        self._set_motion(fastest_motion(problem, ends.start, synchronize), given, synchronize)

    def _set_motion(self, motion: MotionProfile, limits: Sequence[Array], synchronize: Synchronize | None) -> None:
        states = [state for pair in zip(motion.start_state[1:], motion.end_state[1:], strict=True) for state in pair]
        self._set_fields(
            **dict(zip(self._names, limits, strict=True)),
            **dict(zip(self._state_names, states, strict=True)),
            synchronize=synchronize,
            initial=motion.initial,
            final=motion.final,
            labels=motion.labels,
            breakpoints=motion.breakpoints,
            _motion=motion,
        )

    def _set(self, ends: Step, *limits: ArrayLike) -> None:
        with np.errstate(over="ignore"):
            change = ends.final - ends.initial
        if not (np.isfinite(change).all() and change.any()):
            raise ValueError(
                "final must differ from initial by a finite length, "
                f"got {ends.final.tolist()} after {ends.initial.tolist()}"
            )
        given = self._checked_limits(limits, ends.labels)
        moves = change != 0.0
        with np.errstate(all="ignore"):
            durations = unit_move(*((limit[moves] / np.abs(change[moves])).min() for limit in given))
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
            **dict.fromkeys(self._state_names, 0.0 * ends.initial),
            synchronize="phase",
            initial=ends.initial,
            final=ends.final,
            labels=ends.labels,
            breakpoints=readonly(np.array(times)),
            _change=change,
            _lasts=lasts.tolist(),
            _taylor=(np.concatenate([rise, cruise, fall[::-1]]) / whole).tolist(),
            _nfall=len(ramp),
        )

    @property
    def polynomial_degree(self) -> int:
        """Order of the highest limited derivative; as `Trajectory.polynomial_degree`."""
        return len(self._names)

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        if self._motion is not None:
            return self._motion.segment_jet(segment, s, order)
        anchor, series = self._law(segment, s, order)
        law = np.empty((order + 1, s.size))
        for row, coefficient in zip(law, series, strict=True):
            row[:] = coefficient
        law *= FACTORIALS[: order + 1, None]
        out: Array = self._change[:, None] * law[:, None]
        out[0] += anchor[:, None]
        return out

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        if self._motion is not None:
            return self._motion.segment_series(segment, s, order)
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
    """Time-optimal move with limited acceleration.

    With limits on velocity and acceleration the velocity profile is a trapezoid,
    or a triangle if the distance is too short to reach the velocity limit.
    Several axes are synchronised on the straight line from `initial` to `final`
    in the minimum time under all limits. The acceleration jumps at every
    breakpoint. Both ends may be in motion.

    Parameters
    ----------
    final : array_like, scalar or shape (naxes,)
        Position at the end.
    initial : array_like, optional
        Position at the start.
    velocity, acceleration : array_like, scalar or shape (naxes,)
        Maximum magnitudes, above 0 [unit of the axis per s, per s^2]; or pairs
        (minimum, maximum) of shape (naxes, 2), on one axis a tuple.
    start_velocity, end_velocity : array_like, scalar or shape (naxes,), optional
        Velocities at both ends; by default 0.
    synchronize : {"phase", "time"} or None, optional
        Relation of several axes. "phase": on the straight line from `initial` to
        `final`, which velocities and accelerations at the ends must follow. "time":
        all axes end together, in minimum time. None: each axis in its own minimum
        time; those that end earlier must end at rest.
    time : float, optional
        Start [s].
    labels : sequence of str, optional
        Names of the axes.

    Attributes
    ----------
    velocity, acceleration : ndarray, shape (naxes,) or (naxes, 2)
        The limits.
    start_velocity, end_velocity : ndarray, shape (naxes,)
        Velocities at both ends.
    synchronize : str or None
        The argument.

    Raises
    ------
    ValueError
        If a limit is not above 0 and finite, no axis moves, a number is not
        finite, shapes differ, or floating-point times do not resolve the
        acceleration phase; if a velocity at an end is beyond its limits; with "phase",
        if it is off the straight line.
    ImportError
        If an end is in motion or limits differ by direction, and ruckig is not
        installed (``pip install "ctrlplan[otg]"``).
    RuntimeError
        If no profile within the limits is found.

    Examples
    --------
    The duration is d/v + v/a if v^2/a < d, otherwise 2 sqrt(d/a):

    >>> Trapezoid(3.0, velocity=1.0, acceleration=0.5).duration
    5.0
    >>> Trapezoid(1.0, velocity=9.0, acceleration=1.0).breakpoints
    array([0., 1., 2.])

    Continued from 1 m/s, with stronger brakes:

    >>> Trapezoid(3.5, velocity=2.0, acceleration=(-4.0, 1.0), start_velocity=1.0).breakpoints
    array([0.  , 1.  , 1.75, 2.25])
    """

    family = "trapezoid"
    options = ("velocity", "acceleration")
    _names = options
    _state_names = ("start_velocity", "end_velocity")
    _ramp = readonly(np.array([[0.0, 1.0]]))

    def __init__(
        self,
        final: ArrayLike,
        initial: ArrayLike = 0.0,
        *,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        start_velocity: ArrayLike = 0.0,
        end_velocity: ArrayLike = 0.0,
        synchronize: Synchronize | None = "phase",
        time: float = 0.0,
        labels: Sequence[str] | None = None,
    ) -> None:
        states = (start_velocity, end_velocity)
        self._begin(Step(final, initial, time, labels), (velocity, acceleration), states, synchronize)


class SCurve(_Profile):
    """Time-optimal move with limited jerk.

    With limits on velocity, acceleration and jerk the move has seven segments of
    constant jerk, or fewer if the velocity or acceleration limit is not reached.
    Several axes are synchronised on the straight line from `initial` to `final`
    in the minimum time under all limits. The jerk jumps at every breakpoint. Both
    ends may be in motion.

    Parameters
    ----------
    final : array_like, scalar or shape (naxes,)
        Position at the end.
    initial : array_like, optional
        Position at the start.
    velocity, acceleration : array_like, scalar or shape (naxes,)
        Maximum magnitudes, above 0 [unit of the axis per s, per s^2]; or pairs
        (minimum, maximum) of shape (naxes, 2), on one axis a tuple.
    jerk : array_like, scalar or shape (naxes,)
        Maximum magnitude, above 0 [unit of the axis per s^3].
    start_velocity, start_acceleration : array_like, optional
        State at the start, scalar or of shape (naxes,); by default 0.
    end_velocity, end_acceleration : array_like, optional
        State at the end, scalar or of shape (naxes,); by default 0.
    synchronize : {"phase", "time"} or None, optional
        Relation of several axes. "phase": on the straight line from `initial` to
        `final`, which velocities and accelerations at the ends must follow. "time":
        all axes end together, in minimum time. None: each axis in its own minimum
        time; those that end earlier must end at rest.
    time : float, optional
        Start [s].
    labels : sequence of str, optional
        Names of the axes.

    Attributes
    ----------
    velocity, acceleration : ndarray, shape (naxes,) or (naxes, 2)
        The limits.
    jerk : ndarray, shape (naxes,)
        The limit.
    start_velocity, start_acceleration : ndarray, shape (naxes,)
        State at the start.
    end_velocity, end_acceleration : ndarray, shape (naxes,)
        State at the end.
    synchronize : str or None
        The argument.

    Raises
    ------
    ValueError
        If a limit is not above 0 and finite, no axis moves, a number is not
        finite, shapes differ, or floating-point times do not resolve the
        acceleration phase; if a state at an end makes an excess over the limits
        unavoidable, with the maximum jerk; with "phase", if it is off the straight
        line.
    ImportError
        If an end is in motion or limits differ by direction, and ruckig is not
        installed (``pip install "ctrlplan[otg]"``).
    RuntimeError
        If no profile within the limits is found.

    Examples
    --------
    If every limit is reached, the duration is d/v + v/a + a/j:

    >>> SCurve(4.0, velocity=1.0, acceleration=0.5, jerk=0.5).duration
    7.0

    From motion at the velocity limit to rest, with v/a + a/j for the stop:

    >>> round(SCurve(4.0, velocity=1.0, acceleration=0.5, jerk=0.5, start_velocity=1.0).duration, 12)
    5.5
    """

    jerk: Array
    start_acceleration: Array
    end_acceleration: Array

    family = "s_curve"
    options = ("velocity", "acceleration", "jerk")
    _names = options
    _state_names = ("start_velocity", "end_velocity", "start_acceleration", "end_acceleration")
    _ramp = readonly(np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]))

    def __init__(
        self,
        final: ArrayLike,
        initial: ArrayLike = 0.0,
        *,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        jerk: ArrayLike,
        start_velocity: ArrayLike = 0.0,
        start_acceleration: ArrayLike = 0.0,
        end_velocity: ArrayLike = 0.0,
        end_acceleration: ArrayLike = 0.0,
        synchronize: Synchronize | None = "phase",
        time: float = 0.0,
        labels: Sequence[str] | None = None,
    ) -> None:
        states = (start_velocity, end_velocity, start_acceleration, end_acceleration)
        self._begin(Step(final, initial, time, labels), (velocity, acceleration, jerk), states, synchronize)


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


def _low(limit: Array) -> Array:
    return -limit if limit.ndim == 1 else limit[:, 0]


def _high(limit: Array) -> Array:
    return limit if limit.ndim == 1 else limit[:, 1]


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


def _checked_limit(limit: ArrayLike, name: str, labels: tuple[str, ...], pairs: bool) -> Array:
    """Limit of each axis, checked: shape (naxes,), or (naxes, 2) for pairs (minimum, maximum)."""
    values, naxes = new_numbers(limit, name), len(labels)
    if pairs and naxes == 1 and isinstance(limit, tuple) and values.shape == (2,):
        values = values[None]
    if values.ndim == 2 and values.shape == (naxes, 2) and pairs:
        for label, (low, high) in zip(labels, values.tolist(), strict=True):
            if not -math.inf < low < 0.0 < high < math.inf:
                raise ValueError(
                    f"{name} must be pairs of a finite minimum below 0 and a finite maximum above 0, got {low} and "
                    f"{high} of {label}"
                )
        return readonly(-values[:, 0] if (values[:, 0] == -values[:, 1]).all() else values)
    if values.shape not in ((), (naxes,)):
        also = f", or pairs of shape ({naxes}, 2)" if pairs else ""
        raise ValueError(f"{name} must be a scalar or of shape ({naxes},){also}, got shape {values.shape}")
    for label, value in zip(labels, np.broadcast_to(values, naxes).tolist(), strict=True):
        if not 0.0 < value < math.inf:
            raise ValueError(f"{name} must be above 0 and finite, got {value}{f' of {label}' if values.ndim else ''}")
    return readonly(np.broadcast_to(values, naxes).copy())
