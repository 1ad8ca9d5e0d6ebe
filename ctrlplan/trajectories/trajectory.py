"""The interface of all trajectories."""

from __future__ import annotations

import itertools
import math
import os
import warnings
from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import MAXIMUM, checked_count, checked_finite, checked_number, checked_timepts, one_number
from ctrlplan._display import MISSING, Displayed, Facts, Figure, Part, Table, number, time_text
from ctrlplan._renamed import warn_renamed
from ctrlplan._types import Data, Value
from ctrlplan.trajectories import extrema as _extrema
from ctrlplan.trajectories import sampling as _sampling
from ctrlplan.trajectories.chebyshev import chebyshev_proxy
from ctrlplan.trajectories.common import FACTORIALS, Array, readonly
from ctrlplan.trajectories.continuity import Jump, find_jumps
from ctrlplan.trajectories.fields import Fields
from ctrlplan.trajectories.piecewise_extrema import places_of_low_degree
from ctrlplan.trajectories.waypoint import ENTRIES, waypoint_table

if TYPE_CHECKING:
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike
    from ctrlplan.trajectories.export import FlatMaps
    from ctrlplan.trajectories.waypoint import Waypoint


_FLOATS = (float, np.float64)
"""Types of one time that requires no check of its kind; subclasses may have a unit."""


class Trajectory(Displayed, Fields, ABC):
    """Function of time with exact derivatives.

    A trajectory is analytic between breakpoints. Before its start it is constant
    at the initial position, after its end at the final one, with zero
    derivatives. At a breakpoint the value and derivatives are those of the
    following segment, at the end those of the last segment.

    Trajectories are equal if their classes and their data (`to_dict`) are equal,
    so that a loaded trajectory is equal to the saved one; they can be entries of a
    set and keys of a dict.

    A new kind of trajectory must define

    - its fields, annotated at the top of the class, and a constructor that sets
      each of them once by ``self._set_fields(...)``, including `labels` (tuple
      of str) and `breakpoints` (ndarray, increasing);
    - `segment_jet`, the derivatives between two breakpoints;
    - `map_time`, the same path at other times, for `retime` and `shift`;
    - `to_dict` and `from_dict`, plain data, for `save` and `load_trajectory`.

    `segment_series` is required only if the time is a CasADi symbol, as with
    time scaling in a compiled simulation. A trajectory through waypoints
    derives from `WaypointSpline`. All other methods are inherited.

    Attributes
    ----------
    labels : tuple of str
        Names of the axes; default y, or y1, y2, ...
    breakpoints : ndarray, shape (nsegments + 1,)
        Times [s] of the start, of the ends of inner segments, and of the end.

    Examples
    --------
    A sine, with the nth derivative A w^n sin(w s + n pi/2):

    >>> import numpy as np
    >>> class Sine(Trajectory):
    ...     amplitude: float
    ...     rate: float
    ...
    ...     def __init__(self, amplitude, rate, start, end, labels=("y",)):
    ...         breakpoints = np.array([start, end], dtype=float)
    ...         self._set_fields(labels=tuple(labels), breakpoints=breakpoints, amplitude=amplitude, rate=rate)
    ...
    ...     def segment_jet(self, segment, s, order):
    ...         n = np.arange(order + 1)[:, None, None]
    ...         return self.amplitude * self.rate**n * np.sin(self.rate * s + 0.5 * np.pi * n)
    ...
    ...     def map_time(self, origin, target, rate):
    ...         start, end = target + (self.breakpoints - origin) / rate
    ...         return Sine(self.amplitude, self.rate * rate, start, end, self.labels)
    ...
    ...     def to_dict(self):
    ...         own = [self.amplitude, self.rate, self.start, self.end, list(self.labels)]
    ...         return {"type": "Sine", "arguments": own}
    ...
    ...     @classmethod
    ...     def from_dict(cls, data):
    ...         return cls(*data["arguments"])
    >>> plan = Sine(2.0, np.pi, 0.0, 0.5)
    >>> plan.jet(0.5, 1).ravel().round(12) + 0.0, plan.peak(1), plan.retime(1.0).peak(1)
    (array([2., 0.]), array([6.28318531]), array([3.14159265]))
    """

    labels: tuple[str, ...]
    breakpoints: Array
    waypoints: tuple[Waypoint, ...] = ()

    kinds: ClassVar[dict[str, type[Trajectory]]] = {}
    can_be_stored: ClassVar[bool] = True
    """Whether a file may have plans of this class."""

    __array_ufunc__ = None  # products with numpy scalars are those of this class; arrays are not factors

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # A method for many times that is overridden holds for one time as well.
        pairs = (("segment_jet", "segment_rows"), ("segment_jet_at", "segment_rows_at"), ("_sample", "_rows"))
        for many, one in pairs:
            if many in cls.__dict__ and one not in cls.__dict__:
                setattr(cls, one, _no_rows)
        abstract = (getattr(f, "__isabstractmethod__", False) for f in (cls.segment_jet, cls.map_time, cls.from_dict))
        if cls.__name__.startswith("_") or any(abstract) or not cls.can_be_stored:
            return
        former = Trajectory.kinds.setdefault(cls.__name__, cls)
        # A class that is defined again, in a notebook cell or by a reload, replaces the previous one.
        if (former.__module__, former.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ValueError(
                f"classes of trajectories must have different names, by which they are saved, got {cls.__name__} "
                f"in {cls.__module__} after that in {former.__module__}; rename the class, or begin its name with _"
            )
        Trajectory.kinds[cls.__name__] = cls

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if not isinstance(other, Trajectory):
            return NotImplemented
        # Plans that cannot be saved are equal to themselves only.
        return (
            type(self) is type(other)
            and self.can_be_stored
            and hash(self) == hash(other)
            and bool(self.to_dict() == other.to_dict())
        )

    def __hash__(self) -> int:
        return hash((type(self), self.labels, float(self.breakpoints[0]), float(self.breakpoints[-1])))

    @abstractmethod
    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of the analytic function of a segment.

        Times are relative to the start of the segment, so that a large start time
        causes rounding only in the subtraction. They may lie slightly outside of
        the segment.

        Parameters
        ----------
        segment : int
            Number of the segment, from 0: between ``breakpoints[segment]`` and
            ``breakpoints[segment + 1]``.
        s : ndarray, shape (ntime,)
            Times [s] since the start of the segment, in any order.
        order : int
            Highest derivative.

        Returns
        -------
        ndarray, shape (order + 1, naxes, ntime)
        """

    @property
    def in_batches(self) -> bool:
        """Whether segments are evaluated together."""
        return False

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives of the analytic functions of many segments.

        Parameters
        ----------
        segments : ndarray of int, shape (ntime,)
            Numbers of the segments, in any order.
        s : ndarray, shape (ntime,)
            Times [s] since the start of each of these segments.
        order : int
            Highest derivative.

        Returns
        -------
        ndarray, shape (order + 1, naxes, ntime)
        """
        out = np.empty((order + 1, self.naxes, s.size))
        by_segment = np.argsort(segments, kind="stable")
        first = np.flatnonzero(np.diff(segments[by_segment], prepend=-1))
        for where in np.split(by_segment, first[1:]) if s.size else ():
            out[:, :, where] = self.segment_jet(int(segments[where[0]]), s[where], order)
        return out

    def at_fractions(self, fractions: Array, nu: int) -> Array:
        """Derivative at the same relative times of all segments.

        Parameters
        ----------
        fractions : ndarray, shape (ntime,)
            Times since the start of each segment, relative to its duration, from 0 to 1.
        nu : int
            Order of the derivative.

        Returns
        -------
        ndarray, shape (naxes, nsegments, ntime)
        """
        times = self.breakpoints[:-1, None] + np.diff(self.breakpoints)[:, None] * fractions
        return self._sample(times.ravel(), nu, nu, False).reshape(self.naxes, *times.shape)

    @abstractmethod
    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path with time t moved to target + (t - origin)/rate.

        Parameters
        ----------
        origin, target : float
            A time [s], and the time to which it is moved.
        rate : float
            Speed factor, above 0: the nth derivative is multiplied by rate^n.
        """

    @abstractmethod
    def to_dict(self) -> Data:
        """Plain data (numbers, strings, lists, dicts) for `from_dict`.

        The entry "type" is the name of the class.
        """

    @classmethod
    @abstractmethod
    def from_dict(cls, data: Data) -> Trajectory:
        """Trajectory from the plain data of `to_dict`, equal in every bit."""

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment at a CasADi symbol.

        Parameters
        ----------
        segment : int
            Number of the segment.
        s : symbol
            Time [s] since the start of the segment.
        order : int
            Highest coefficient.

        Returns
        -------
        list of list, naxes by (order + 1)
            Coefficient k is the k-th derivative / k!.

        Raises
        ------
        TypeError
            If the class does not define it.
        """
        raise TypeError(
            f"the time of a {type(self).__name__} must be a number, got {type(s).__name__}: this class "
            "does not define segment_series"
        )

    def segment_rows(self, segment: int, s: float, order: int) -> list[list[float]] | None:
        """Derivatives of a segment at one time.

        A class may define it in addition to `segment_jet`, which it must equal up to
        rounding, for fast evaluation in a controller.

        Parameters
        ----------
        segment : int
            Number of the segment.
        s : float
            Time [s] since the start of the segment.
        order : int
            Highest derivative.

        Returns
        -------
        list of list of float, naxes by (order + 1), or None
            None if `segment_jet` is to be called.
        """
        return None

    @property
    def start(self) -> float:
        """Time of the first breakpoint [s]."""
        return float(self.breakpoints[0])

    @property
    def end(self) -> float:
        """Time of the last breakpoint [s]."""
        return float(self.breakpoints[-1])

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.end - self.start

    @property
    def is_cyclic(self) -> bool:
        """Whether it is one period, made by `cyclic` of a spline."""
        return False

    @property
    def naxes(self) -> int:
        """Number of axes."""
        return len(self.labels)

    @cached_property
    def initial(self) -> Array:
        """Position up to the start, shape (naxes,)."""
        return readonly(self.segment_jet(0, np.zeros(1), 0)[0, :, 0].copy())

    @cached_property
    def final(self) -> Array:
        """Position from the end on, shape (naxes,)."""
        last = self.breakpoints.size - 2
        return readonly(self.segment_jet(last, np.diff(self.breakpoints[last:]), 0)[0, :, 0].copy())

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """Breakpoints in the half-open interval [t0, t1).

        Of consecutive intervals exactly one contains a given breakpoint, which
        belongs to the segment that follows it.

        Parameters
        ----------
        t0, t1 : float
            Times [s], t0 <= t1; both may be infinite.

        Returns
        -------
        ndarray, shape (nbreakpoints,)
            Increasing, with a breakpoint at t0 and without one at t1.

        Raises
        ------
        ValueError
            If a time is nan or t1 is below t0.

        Examples
        --------
        >>> import ctrlplan as cp
        >>> cp.PiecewiseSpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1), cp.Waypoint(3, 0)]).breakpoints_between(0, 3)
        array([0., 1.])
        """
        first, last = self._checked_interval(t0, t1)
        begin, end = np.searchsorted(self.breakpoints, [first, last]).tolist()
        return self.breakpoints[begin:end].copy()

    def __call__(self, t: ArrayLike, nu: int = 0) -> Array:
        """Value or nu-th derivative.

        Parameters
        ----------
        t : array_like, any shape
            Times [s], in any order.
        nu : int, optional
            Order of the derivative.

        Returns
        -------
        ndarray, shape t.shape for one axis, (naxes, *t.shape) for more
            In units of the axis per s^nu.

        Raises
        ------
        ValueError
            If a time is nan or nu is negative.
        """
        one: Any = t
        if type(one) in _FLOATS and type(nu) is int and 0 <= nu <= MAXIMUM:
            rows = self._rows(float(one), nu, False)
            if rows is not None:
                return np.array(rows[0][nu] if len(rows) == 1 else [row[nu] for row in rows])
        times = checked_timepts(t)
        derivative = checked_count(nu, "nu")
        values = self._sample(times.ravel(), derivative, derivative, False)[0]
        return values.reshape(times.shape if self.naxes == 1 else (self.naxes, *times.shape))

    def jet(self, t: ArrayLike, order: int, left: bool = False) -> Array:
        """Value and derivatives up to an order.

        Parameters
        ----------
        t : array_like, any shape
            Times [s], in any order.
        order : int
            Highest derivative.
        left : bool, optional
            Return the limit from the left at breakpoints, as required at the end
            of an integration interval.

        Returns
        -------
        ndarray, shape (order + 1, naxes, *t.shape)

        Raises
        ------
        ValueError
            If a time is nan or the order is negative.
        """
        one: Any = t
        if type(one) in _FLOATS and type(order) is int and 0 <= order <= MAXIMUM:
            rows = self._rows(float(one), order, left)
            if rows is not None:
                return np.array(rows).T
        times = checked_timepts(t)
        highest = checked_count(order, "order")
        values = self._sample(times.ravel(), 0, highest, left)
        return values.reshape(highest + 1, self.naxes, *times.shape)

    def series(self, t: Value, order: int) -> list[list[Value]]:
        """Taylor series about one time, a number or a CasADi symbol.

        Parameters
        ----------
        t : float or symbol
            Time [s].
        order : int
            Highest coefficient.

        Returns
        -------
        list of list, naxes by (order + 1)
            Coefficient k is the k-th derivative / k!.

        Raises
        ------
        TypeError
            If `t` is neither a number nor a symbol.
        """
        order = checked_count(order, "order")
        if isinstance(t, Real):
            return (self.jet(np.asarray(t), order).T / FACTORIALS[: order + 1]).tolist()
        if t is None or isinstance(t, str | complex | list | tuple | np.ndarray | np.datetime64 | np.bool_):
            raise TypeError(f"t must be one number or a symbol, got {t!r:.80}")
        # Each segment is weighted by 1 in its interval; elsewhere it is evaluated at its ends, where it is finite.
        found = [[value * (t < self.start), *[0.0] * order] for value in self.initial.tolist()]
        for segment, left, right in self._intervals_at(t):
            holds = (t >= left) * (t < right)
            rows = self.segment_series(segment, np.fmin(np.fmax(t - left, 0.0), right - left), order)
            found = [[a + holds * b for a, b in zip(*pair, strict=True)] for pair in zip(found, rows, strict=True)]
        if math.isinf(self.end):
            return found
        for row, value in zip(found, self.final.tolist(), strict=True):
            row[0] = row[0] + value * (t > self.end)
        last = (self.jet(self.end, order).T / FACTORIALS[: order + 1]).tolist()
        return [[a + (t == self.end) * b for a, b in zip(*pair, strict=True)] for pair in zip(found, last, strict=True)]

    def _intervals_at(self, t: Value) -> Iterator[tuple[int, Value, Value]]:
        """Segments with the times [s] between which each of them is passed about a symbol t."""
        for segment, (left, right) in enumerate(itertools.pairwise(self.breakpoints.tolist())):
            yield segment, left, right

    def extrema(self, nu: int = 0) -> _extrema.Extrema:
        """Minimum and maximum of the nu-th derivative over the whole plan.

        If a derivative jumps at a breakpoint, both limits are included.

        Parameters
        ----------
        nu : int, optional
            Order of the derivative.

        Returns
        -------
        Extrema
            With the attributes minimum, maximum, time_min and time_max, each of
            shape (naxes,).
        """
        return _extrema.derivative_extrema(self, checked_count(nu, "nu"))

    def peak(self, nu: int = 0) -> Array:
        """Maximum magnitude of the nu-th derivative, shape (naxes,).

        Within the segments: impulses at jumps of a lower derivative (`jumps`) are
        not included.
        """
        found = self.extrema(nu)
        return np.maximum(np.abs(found.minimum), np.abs(found.maximum))

    def extrema_of(self, function: Callable[[Array], Array], order: int) -> _extrema.Extrema:
        """Minimum and maximum of a function of the jet.

        Both have an error below 1e-9 of the maximum magnitude of the function.
        Between breakpoints the function is interpolated by Chebyshev
        polynomials, of which the stationary points are computed. Pieces are
        bisected until interpolant and function agree at check points; kinks and
        jumps are enclosed. The function is evaluated at 8192 times of the plan or
        more: 8192/n, and at least 64, for each of n segments. A feature between
        these times, such as a shorter pulse, is missed. `bounds` certifies its
        result.

        Parameters
        ----------
        function : callable
            Maps a jet (order + 1, naxes, ntime) to (ntime,) or (m, ntime).
        order : int
            Highest derivative that `function` uses.

        Returns
        -------
        Extrema
            With the attributes minimum, maximum, time_min and time_max, each of
            shape (m,), m = 1 for a function with one value. At a jump the limits
            from both sides are included.

        Raises
        ------
        ValueError
            If the function is not finite over the plan, or does not return one
            value for each time; if the plan has no duration.
        RuntimeError
            If the function is not resolved to 1e-9 within 20,000 pieces, because
            it is noisy or oscillates too fast. The message states the remaining
            error and the interval.
        """
        return _extrema.function_extrema(self, function, checked_count(order, "order"))

    def bounds(
        self,
        function: Callable[[Array], Array],
        order: int,
        lipschitz: ArrayLike,
        rtol: float = 1e-3,
        max_cells: int = 1_000_000,
    ) -> _extrema.Bounds:
        """Certified bounds of a function of the jet.

        Cells of the interval are refined until a Lipschitz bound, from the value at
        the centre of a cell and the peaks of the jet, reaches the tolerance. All
        values, not only samples, lie between `lower` and `upper`.

        Parameters
        ----------
        function : callable
            Maps a jet (order + 1, naxes, ntime) to (ntime,).
        order : int
            Highest derivative that `function` uses.
        lipschitz : array_like, broadcasts to (order + 1, naxes)
            Bounds of the partial derivatives of `function` over the jets of this plan.
        rtol : float, optional
            Maximum gap between a bound and an attained value, relative to the
            range of the function.
        max_cells : int, optional
            Maximum number of cells.

        Returns
        -------
        Bounds
            With the attributes lower and upper, and the attained minimum and
            maximum with their times time_min and time_max.

        Raises
        ------
        ValueError
            If `rtol` is not reached with `max_cells` cells.
        """
        return _extrema.certified_bounds(self, function, checked_count(order, "order"), lipschitz, rtol, max_cells)

    def jumps(self, order: int) -> tuple[Jump, ...]:
        """Jumps of the derivatives up to an order, both ends included.

        Parameters
        ----------
        order : int
            Highest derivative considered.

        Returns
        -------
        tuple of Jump
            Each with the attributes order, time, label and size; lowest order
            first.
        """
        return find_jumps(self, checked_count(order, "order"))

    def retime(self, duration: float) -> Self:
        """Same path from the same start with another duration [s].

        The nu-th derivative is multiplied by (old duration/new)^nu.

        Raises
        ------
        ValueError
            If the duration is not above 0, a derivative overflows, or rounding
            changes an interval of the plan by more than 1e-3 of its length.

        Warns
        -----
        UserWarning
            If rounding changes an interval of the plan by more than 1e-6 of its
            length.
        """
        check_end(self, "a trajectory to be retimed")
        if not self.duration:
            raise ValueError("a trajectory must have a duration to be retimed, got a step")
        wanted = checked_finite(duration, "duration", above=0.0)
        return self._moved(self.start, self.start, self.duration / wanted)

    def on_cycle(self, dt: float, limits: Mapping[str, object] | None = None) -> Trajectory:
        """Plan whose segments last a whole number of cycles of a drive.

        The start and the values and derivatives of waypoints do not change. The
        duration between waypoints is rounded up to whole cycles. A plan without
        waypoints, such as a profile, is retimed as a whole; each part of a joined
        plan is treated separately, except where parts without waypoints join in
        motion, as in a plan that is stopped.

        Parameters
        ----------
        dt : float
            Cycle time [s].
        limits : mapping, optional
            Limits on derivatives, as for `ctrlplan.fastest`. Segments that violate
            a limit are lengthened by further cycles until all limits are satisfied
            over the whole plan.

        Returns
        -------
        Trajectory
            Plan of the same class; the same object if it is on the cycle already.

        Raises
        ------
        ValueError
            If `dt` is not positive; if the waypoints of a sum or another
            combination are not on the cycle after retiming; if the duration of a
            shaped plan would change; if a waypoint prescribes a value beyond a
            limit; if no duration of a segment satisfies the limits.

        Examples
        --------
        >>> import ctrlplan as cp
        >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1.0, 1, 0, 0)])
        >>> move.on_cycle(0.3).end, move.on_cycle(0.3, {"velocity": 1.0}).end
        (1.2, 2.1)
        """
        from ctrlplan.trajectories.chosen import on_cycle

        return on_cycle(self, dt, limits)

    def shift(self, dt: float) -> Self:
        """Same path, dt seconds later.

        Raises
        ------
        ValueError
            If rounding at the new times changes an interval of the plan by more
            than 1e-3 of its length.

        Warns
        -----
        UserWarning
            If rounding changes an interval of the plan by more than 1e-6 of its
            length.
        """
        return self._moved(self.start, self.start + checked_finite(dt, "dt"), 1.0)

    def then(self, other: Trajectory) -> Trajectory:
        """This trajectory followed by another.

        The other is shifted in time to start at the end of this one.

        Raises
        ------
        ValueError
            If the initial position of the other differs from the final position
            of this one by more than 1e-9 of their range, or if the numbers of
            axes differ.
        """
        from ctrlplan.trajectories.repeated import followed

        return followed(self, other)

    def repeat(self, count: int | None) -> Trajectory:
        """This trajectory a number of times, or for all future times.

        Its final position must be the initial one. Derivatives that differ at both ends
        jump where it repeats; `jumps` lists them.

        Parameters
        ----------
        count : int or None
            Number of periods; None: for all future times. The attributes `end` and
            `duration` are then infinite, `breakpoints` and `waypoints` those of one
            period, and `final` is an error. Functions that require an end raise a
            ValueError. `then` leads to such a plan, `Clipped` is a part of it, and sums and
            stacks repeat with the common period of their parts.

        Returns
        -------
        Trajectory
            With the attributes plan (one period), count and period; this trajectory if
            the count is 1.

        Raises
        ------
        ValueError
            If the count is not an integer above 0; if the trajectory has no duration or no
            end, or its ends differ by more than 1e-9 of the range of its position.

        Examples
        --------
        A cam through six waypoints, for all future times:

        >>> import ctrlplan as cp
        >>> points = [(0.4, 2.0), (0.7, 10.0), (1.2, 10.0), (1.5, 5.0), (1.8, 1.0)]
        >>> points = [cp.Waypoint(0, 0, 0, 0), *(cp.Waypoint(time, lift) for time, lift in points)]
        >>> cam = cp.PiecewiseSpline.cyclic(points, 2.0).repeat(None)
        >>> cp.simulate(cp.create_source_iosystem(cam), [0.0, 0.7, 1000.7]).outputs[0].round(9).tolist()
        [0.0, 10.0, 10.0]
        """
        from ctrlplan.trajectories.repeated import Repeated

        return self if count == 1 and not isinstance(count, bool) else Repeated(self, count)

    def stop(
        self,
        time: float,
        limits: Mapping[str, object],
        *,
        synchronize: Literal["time", "path"] | None = "time",
    ) -> Trajectory:
        """Plan until a time, then to rest in minimum time.

        The position of the stop is free. Up to `time` the plan is unchanged; from
        its position, velocity and acceleration at that time it is brought to rest
        with limited acceleration and jerk. At a jump of the plan the state is that
        before the jump.

        Parameters
        ----------
        time : float
            Beginning of the stop [s], within the plan.
        limits : mapping
            Limits of acceleration and jerk, as for `ctrlplan.fastest`:
            ``{"acceleration": (-2.0, 1.0), "jerk": 10.0}`` for all axes, lists by
            axis, or names such as ``x_d2``. The jerk is one number. Limits of
            velocities and positions cannot be enforced; a warning states what
            exceeds them.
        synchronize : {"time", "path"} or None, optional
            "time": all axes come to rest together, at the time of the slowest one.
            None: each axis in its own minimum time. "path": on the path of the plan,
            by a time law with limited jerk, the shortest one of three phases,
            possibly after a delay; if the path ends first, the plan is at rest
            there.

        Returns
        -------
        Trajectory
            The plan itself if it is at rest at its end already.

        Raises
        ------
        ValueError
            If the time is outside of the plan; a limit is missing or wrong; the plan
            has no duration; with "path", if the plan is shaped (`Shaper`), or ends
            in motion before it can be stopped.

        Warns
        -----
        UserWarning
            If the state at `time` exceeds a limit, or will unavoidably. The message
            states the excess. The acceleration is then brought back with maximum
            jerk.

        Examples
        --------
        >>> import ctrlplan as cp
        >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(4, 10, 0, 0)], labels="x")
        >>> stopped = move.stop(2.0, {"acceleration": 5.0, "jerk": 20.0})
        >>> stopped.end, stopped(stopped.end, 1), stopped.final
        (3.1875, array(0.), array([7.78320312]))
        """
        from ctrlplan.trajectories.chosen import stopped

        return stopped(self, time, limits, synchronize)

    def to_velocity(
        self,
        time: float,
        velocity: ArrayLike,
        limits: Mapping[str, object],
        *,
        hold: float = 0.0,
        synchronize: Literal["time"] | None = "time",
    ) -> Trajectory:
        """Plan until a time, then to a constant velocity.

        The change has minimum duration; the position is free. The plan then ends in
        motion, and `then` continues it.

        Parameters
        ----------
        time : float
            Beginning of the change [s], within the plan.
        velocity : array_like, scalar or shape (naxes,)
            Final velocity [unit of the axis per s], within the limits.
        limits : mapping
            Limits of acceleration and jerk, as for `stop`.
        hold : float, optional
            Time [s] for which the velocity is held, at least 0.
        synchronize : {"time"} or None, optional
            Whether all axes reach their velocity at the same time, or each in its
            own minimum time.

        Returns
        -------
        Trajectory

        Raises
        ------
        ValueError
            As `stop`; if the velocity exceeds a limit.

        Warns
        -----
        UserWarning
            As `stop`.

        Examples
        --------
        >>> import ctrlplan as cp
        >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(4, 10, 0, 0)])
        >>> slow = move.to_velocity(2.0, 1.0, {"acceleration": 5.0, "jerk": 20.0}, hold=1.0)
        >>> slow(slow.end, 1)
        array(1.)
        >>> limits = {"velocity": 3.0, "acceleration": 2.0, "jerk": 10.0}
        >>> on = slow.then(cp.SCurve(20.0, slow.final, start_velocity=1.0, **limits))
        >>> on.final, on.jumps(2)
        (array([20.]), ())
        """
        from ctrlplan.trajectories.chosen import at_velocity

        return at_velocity(self, time, velocity, limits, hold, synchronize)

    def select(self, labels: Sequence[str]) -> Trajectory:
        """Trajectory of some axes by name, in the given order."""
        from ctrlplan.trajectories.combined import Selected
        from ctrlplan.trajectories.repeated import combined

        names = (labels,) if isinstance(labels, str) else tuple(labels)
        return combined(lambda parts: Selected(parts[0], names), [self])

    def export(
        self,
        path: str | os.PathLike[str],
        *,
        dt: float | None = None,
        timepts: ArrayLike | None = None,
        derivatives: int = 2,
        flat: FlatMaps | None = None,
    ) -> tuple[Path, ...]:
        """Write for another program, in the format of the path's ending.

        =============== ============================================================
        Ending          Content
        =============== ============================================================
        ``.csv``        samples: time, x, x_d1, x_d2, z, ...
        ``.mat``        samples: one structure with time per signal, for the
                        Simulink block From Workspace
        ``.npz``        samples: one array per signal
        ``.yaml``       samples as trajectory_msgs/JointTrajectory of ROS 2
        ``.cam.csv``    position, velocity and acceleration at master positions
        ``.cam.st``     the same as global variables MC_CAM_REF of CODESYS
        ``.ppoly.json`` coefficients for `scipy.interpolate.PPoly`
        ``.c``          C99 source, and its header
        =============== ============================================================

        The master position of a cam is the time. Cams, polynomials and C state a
        bound of their error. The function of ``move.c`` is ``move_jet(t, jet)``.
        `save` writes the plan itself.

        Parameters
        ----------
        path : str or path
            File to be written, in an existing folder.
        dt : float, optional
            Sampling period [s]. The last sample is the first one at or after the
            end.
        timepts : array_like, shape (ntime,), optional
            Sample times [s]. Default: 1001 from start to end; for cams, as many
            as keep the error of the position below 1e-6 of its range.
        derivatives : int, optional
            Highest derivative.
        flat : flat system, optional
            System whose states and inputs along the plan are added to the samples;
            it must have a method ``states_and_inputs``. In ROS the inputs are the
            effort.

        Returns
        -------
        tuple of Path
            Files written.

        Raises
        ------
        ValueError
            If the ending is unknown, an argument does not apply to it, or the
            format cannot represent the plan.
        OSError
            If a file cannot be written; existing files are then unchanged.

        Examples
        --------
        >>> import ctrlplan as cp
        >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
        >>> move.export("move.txt")
        Traceback (most recent call last):
        ...
        ValueError: path must end in one of .csv, .mat, .npz, .ppoly.json, .yaml, .cam.csv, .cam.st, .c, got move.txt
        """
        from ctrlplan.trajectories.export import Options, export_plan

        return export_plan(self, path, Options(dt, timepts, derivatives, flat))

    def to_csv(self, path: str | os.PathLike[str], timepts: ArrayLike | None = None, order: int = 2) -> None:
        """Write to a CSV file of any name; as `export` for .csv.

        Files named .gz, .bz2 and .xz are compressed.
        """
        from ctrlplan.trajectories.export import Options
        from ctrlplan.trajectories.export.csv_table import write_csv

        write_csv(self, path, Options(timepts=timepts, derivatives=checked_count(order, "order")))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to a JSON file, exact to every bit; see `load_trajectory`."""
        from ctrlplan.trajectories.files import save_trajectory

        save_trajectory(self, path)

    def plot(
        self,
        derivatives: int = 2,
        *,
        ax: AxesLike | None = None,
        units: Sequence[str] | None = None,
        order: int | None = None,
    ) -> ControlPlot:
        """Plot position and derivatives over time, with waypoints.

        The figure is registered with pyplot, as ``plt.show()`` and
        ``plt.savefig`` require, and uses the current rcParams. To compare plans,
        pass the axes of the first plot to the second.

        Parameters
        ----------
        derivatives : int, optional
            Highest derivative plotted.
        ax : Axes or array of Axes, optional
            Axes to plot in: an array of n axes for the derivatives 0 to n - 1, one
            Axes for the position only. Default: the current figure if it is
            empty, otherwise a new one.
        units : sequence of str, optional
            Units of the plan's axes.
        order : int, optional
            Deprecated name of `derivatives`.

        Returns
        -------
        control.ControlPlot
            With `figure`, `axes` and `lines`, both of shape (derivatives + 1, 1).

        Raises
        ------
        TypeError
            If `ax` is neither axes nor an array of them.
        ValueError
            If the number of axes differs from that of the derivatives.

        Examples
        --------
        >>> import ctrlplan as cp
        >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
        >>> first = cp.PolySpline(move).plot(1)
        >>> both = cp.TrigSpline(move, alpha=3.0).plot(ax=first.axes)
        >>> both.figure is first.figure, both.axes.shape
        (True, (2, 1))
        """
        from ctrlplan.reports.figures import plot_trajectory

        if order is not None:
            warn_renamed("order=", "derivatives=")
            derivatives = order
        return plot_trajectory(self, checked_count(derivatives, "derivatives"), ax=ax, units=units)

    def __add__(self, other: Trajectory) -> Trajectory:
        from ctrlplan.trajectories.combined import Sum
        from ctrlplan.trajectories.repeated import combined

        return combined(Sum, [self, other]) if isinstance(other, Trajectory) else NotImplemented

    def __sub__(self, other: Trajectory) -> Trajectory:
        return self + (-1.0) * other if isinstance(other, Trajectory) else NotImplemented

    def __mul__(self, factor: float) -> Trajectory:
        from ctrlplan.trajectories.combined import Scaled
        from ctrlplan.trajectories.repeated import combined

        return combined(lambda parts: Scaled(parts[0], factor), [self]) if _is_factor(factor) else NotImplemented

    __rmul__ = __mul__

    def __truediv__(self, factor: float) -> Trajectory:
        return self * (1.0 / one_number(factor, "factor")) if _is_factor(factor) else NotImplemented

    def __neg__(self) -> Trajectory:
        return self * -1.0

    def _describe(self) -> Iterator[Part]:
        axes = ", ".join(self.labels)
        until = f"to {time_text(self.end)} s" if math.isfinite(self.end) else "on"
        when = f"from {time_text(self.start)} s {until}" if self.duration else f"at {time_text(self.start)} s"
        yield f"{type(self).__name__} of {axes} {when}"
        yield Facts(self._facts())
        if self.waypoints:
            yield waypoint_table(self.waypoints, self.labels)
        ends = [["initial position", *map(number, self.initial.tolist())]]
        if math.isfinite(self.end):
            ends.append(["final position", *map(number, self.final.tolist())])
        quick = self._has_quick_peaks()
        yield Table("Positions and peaks", ("", *self.labels), [*ends, *(self._peaks() if quick else [])])
        if not quick:
            yield "Peaks of derivatives are not computed for this text; call peak(order)."
        yield Figure("Position and velocity over time.", 2, lambda axes: self.plot(ax=axes))

    def _facts(self) -> list[tuple[str, str]]:
        """Values that a description states, by name; kinds add their own."""
        with np.errstate(over="ignore", invalid="ignore"):
            jumps = self.jumps(0) if self._has_quick_peaks() else ()
        times = list(dict.fromkeys(f"{time_text(jump.time)} s" for jump in jumps))
        return [
            ("duration", f"{self.duration:.6g} s" if 0.0 < self.duration < math.inf else ""),
            ("segments", f"{self.breakpoints.size - 1}" if self.breakpoints.size > 2 else ""),
            ("position jumps at", ", ".join(times[:4]) + (f" and {len(times) - 4} more" if len(times) > 4 else "")),
        ]

    def _has_quick_peaks(self) -> bool:
        """Whether peaks are found in a few hundredths of a second."""
        return self.naxes * max(self.breakpoints.size, len(self.waypoints)) <= 60

    def _peaks(self) -> list[list[str]]:
        """Rows of a table: the peak magnitude of each derivative up to the jerk, infinite where a lower one jumps."""
        rows = []
        for nu in range(1, 4 if self.duration else 1):
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    jumped = {jump.label for jump in self.jumps(nu - 1) if self.start < jump.time < self.end}
                    largest = np.where([label in jumped for label in self.labels], np.inf, self.peak(nu))
                    peaks = [number(value) for value in largest.tolist()]
            except (ValueError, RuntimeError):  # beyond floating point, or not resolved
                peaks = [MISSING] * self.naxes
            rows.append([f"peak {ENTRIES[nu]} [1/s{f'^{nu}' if nu > 1 else ''}]", *peaks])
        return rows

    @staticmethod
    def _checked_interval(t0: float, t1: float) -> tuple[float, float]:
        """Two times in order, each of which may be infinite."""
        first, last = checked_number(t0, "t0"), checked_number(t1, "t1")
        if last < first:
            raise ValueError(f"t1 must not be below t0, got {time_text(last)} s after {time_text(first)} s")
        return first, last

    def _marked_times(self) -> Array:
        """Times of breakpoints and waypoints, increasing."""
        return np.union1d(self.breakpoints, [w.time for w in self.waypoints])

    def _moved(self, origin: float, target: float, rate: float) -> Self:
        """As `map_time`, with a check of the rounding of the intervals between times."""
        try:
            with np.errstate(over="raise", invalid="raise"):
                moved = self.map_time(origin, target, rate)
        except FloatingPointError as error:
            raise ValueError(f"times must stay within floating point, got a rate of {rate:g}: {error}") from None
        if self.in_batches:
            _extrema.carry_extrema(self, moved, rate)
        before, after = self._marked_times(), moved._marked_times()
        if before.size < 2:
            return moved
        # A profile omits segments below the resolution of times; the cells of a time law do not depend on it.
        if before.size != after.size or self.in_batches:
            before, after = before[[0, -1]], after[[0, -1]]
        loss = float(np.abs(np.diff(after) * rate / np.diff(before) - 1.0).max())
        if loss > 1e-6:
            said = (
                f"intervals of the plan must be representable, got an error of {loss:.1g} of an interval by rounding "
                f"between {after[0]:.17g} s and {after[-1]:.17g} s; use a time origin nearer to the plan"
            )
            if loss > 1e-3:
                raise ValueError(said)
            warnings.warn(said, stacklevel=3)
        return moved

    @cached_property
    def _moments(self) -> list[float]:
        """The breakpoints as floats."""
        return self.breakpoints.tolist()

    def _rows(self, t: float, order: int, left: bool) -> list[list[float]] | None:
        """Derivatives at one time, a list for each axis; None where `_sample` is to be called."""
        moments = self._moments
        last = len(moments) - 2
        segment = (bisect_left if left else bisect_right)(moments, t) - 1
        if segment > last:
            if t > moments[-1]:
                return [[value, *[0.0] * order] for value in self.final.tolist()]
            if t != moments[-1]:  # nan
                return None
            segment = last
        if segment < 0:
            return [[value, *[0.0] * order] for value in self.initial.tolist()] if t < moments[0] else None
        rows = self.segment_rows(segment, t - moments[segment], order)
        if rows is None:
            return None
        for row in rows:
            if not math.isfinite(sum(row)):
                return None
        return rows

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        """Derivatives low to high, shape (high - low + 1, naxes, ntime)."""
        if self.in_batches:
            return _sampling.sample_in_batches(self, t, low, high, left)
        moments, nsegments = self._moments, self.breakpoints.size - 1
        if nsegments == 1 and not left and t.size:
            start, end = moments
            extent = _sampling.Extent.of(t)
            if extent.first >= start and extent.last <= end:
                if start:
                    t, extent = t - start, extent.since(start)
                return self._sample_segment(0, t, low, high, extent=extent)
        segments = np.searchsorted(self.breakpoints, t, side="left" if left else "right") - 1
        if nsegments and not left:
            segments[t == self.breakpoints[-1]] = nsegments - 1
        out = np.zeros((high - low + 1, self.naxes, t.size))
        if (segments[1:] >= segments[:-1]).all():
            edges = (np.flatnonzero(segments[1:] != segments[:-1]) + 1).tolist()
            parts: list[slice | NDArray[np.intp]] = [
                slice(begin, end) for begin, end in itertools.pairwise([0, *edges, t.size] if t.size else [])
            ]
        else:
            parts = [np.flatnonzero(segments == segment) for segment in np.unique(segments)]
        for where in parts:
            segment = int(segments[where][0])
            if 0 <= segment < nsegments:
                s = t[where] - self.breakpoints[segment]
                if isinstance(where, slice):
                    self._sample_segment(segment, s, low, high, out[:, :, where])
                else:
                    out[:, :, where] = self._sample_segment(segment, s, low, high)
            elif low == 0:
                out[0][:, where] = (self.initial if segment < 0 else self.final)[:, None]
        return out

    def _sample_segment(
        self,
        segment: int,
        s: Array,
        low: int,
        high: int,
        out: Array | None = None,
        extent: _sampling.Extent | None = None,
    ) -> Array:
        """Derivatives low to high of a segment, in a part of the result if it is given."""
        if abs(math.log10(self._length(segment))) * high > 200.0:
            return _placed(self._extreme_jet(segment, s, low, high), out)
        with np.errstate(over="ignore", invalid="ignore"):
            if s.size <= _sampling.FEW or not self.naxes:
                found = _placed(self.segment_jet(segment, s, high)[low:], out)
                finite = False
            else:
                found = np.empty((high - low + 1, self.naxes, s.size)) if out is None else out
                finite = self._sample_many(segment, s, low, found, extent)
            suspect = not finite and not np.isfinite(found.sum())
        if suspect:
            self._check_finite(found, segment, high)
        return found

    def _sample_many(self, segment: int, s: Array, low: int, out: Array, extent: _sampling.Extent | None) -> bool:
        """Derivatives from an order on, as many as `out` has rows, at many times of a segment.

        Whether they are certainly finite is returned.
        """

        def jet(u: Array, order: int) -> Array:
            return self.segment_jet(segment, u, order)

        def interpolants(lowest: int, highest: int) -> _sampling.Interpolant | None:
            return self._interpolant(segment, lowest, highest)

        duration = self._length(segment)
        known = extent or _sampling.Extent.of(s)
        finite = _sampling.sample(jet, interpolants, duration, s, (low, low + len(out) - 1), out, known)
        self._place_ends(segment, s, low, out, known)
        return finite

    def _place_ends(self, segment: int, s: Array, low: int, out: Array, extent: _sampling.Extent | None = None) -> None:
        """Replace derivatives at the ends of a segment: they are the entries of waypoints in every bit."""
        for end in (0.0, self._length(segment)):
            if extent and not extent.first <= end <= extent.last:
                continue
            if extent and extent.is_sorted and s.item(-2 if end else 1) != end:  # only the outermost one
                where = [s.size - 1 if end else 0]
            else:
                where = (s == end).nonzero()[0].tolist()
            if len(where) == 1:
                out[:, :, where[0]] = self._end_jet(segment, end, low + len(out) - 1)[low:]
            elif where:
                out[:, :, where] = self._end_jet(segment, end, low + len(out) - 1)[low:, :, None]

    def _length(self, segment: int) -> float:
        """Duration of a segment [s]."""
        moments = self._moments
        return moments[segment + 1] - moments[segment]

    def _interpolant(self, segment: int, low: int, high: int) -> _sampling.Interpolant | None:
        """Interpolants of derivatives low to high on a segment; None where they are not resolved."""
        known, key = self._interpolants, (segment, low, high)
        if key not in known:
            known[key] = self._new_interpolant(segment, low, high)
        return known[key]

    @cached_property
    def _interpolants(self) -> dict[tuple[int, int, int], _sampling.Interpolant | None]:
        """Interpolants by segment, lowest and highest order."""
        return {}

    def _end_jet(self, segment: int, s: float, order: int) -> Array:
        """Jet (order + 1, naxes) at an end of a segment."""
        if (segment, s, order) not in self._end_jets:
            self._end_jets[segment, s, order] = self.segment_jet(segment, np.array([s]), order)[:, :, 0]
        return self._end_jets[segment, s, order]

    @cached_property
    def _end_jets(self) -> dict[tuple[int, float, int], Array]:
        """Jets at ends of segments, by segment, time from its start and order."""
        return {}

    def _new_interpolant(self, segment: int, low: int, high: int) -> _sampling.Interpolant | None:
        """As `_interpolant`, from values of the segment."""
        interval = 0.0, self._length(segment)
        found = chebyshev_proxy(lambda u, order: self.segment_jet(segment, u, order), interval, low, high)
        return None if found is None else _sampling.Interpolant.of(_sampling.in_products(found))

    def _extreme_jet(self, segment: int, s: Array, low: int, high: int) -> Array:
        """Derivatives low to high of a segment whose duration to the power of their order overflows."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = self.segment_jet(segment, s, high)[low:]
        self._check_finite(found, segment, high)
        return found

    def _check_finite(self, jet: Array, segment: int, high: int) -> None:
        if not np.isfinite(jet).all():
            duration = self.breakpoints[segment + 1] - self.breakpoints[segment]
            raise ValueError(
                f"derivative {high} must stay within floating point, got a duration of {duration:g} s and a position "
                f"of {np.abs(self.segment_jet(segment, np.zeros(1), 0)).max():g}"
            )

    def stationary_places(self, nu: int) -> tuple[NDArray[np.intp], Array] | None:
        """Stationary points of a derivative that may be extrema.

        If a class returns them, `extrema` does not search each segment.

        Returns
        -------
        segments : ndarray of int, shape (npoints,)
            Segment of each point.
        s : ndarray, shape (npoints,)
            Time [s] since its start.
        """
        degree = self.polynomial_degree
        if degree is None:
            return None
        return places_of_low_degree(self.segments_jet, np.diff(self.breakpoints), degree, nu)

    @property
    def polynomial_degree(self) -> int | None:
        """Maximum degree of the segments; None if not polynomials."""
        return None

    def segment_jet_at(self, moment: float, origin: float, s: Array, order: int) -> Array:
        """Jet at origin + s of the function of the segment at `moment`.

        Parameters
        ----------
        moment : float
            Time [s] within a segment, before the start or after the end; not a
            breakpoint.
        origin : float
            Reference time [s] of s, so that s has full precision.
        s : ndarray, shape (ntime,)
            Times [s] after the origin.
        order : int
            Highest derivative.

        Returns
        -------
        ndarray, shape (order + 1, naxes, ntime)
        """
        segment = int(np.searchsorted(self.breakpoints, moment)) - 1
        if 0 <= segment < self.breakpoints.size - 1:
            return self.segment_jet(segment, s + (origin - self.breakpoints[segment]), order)
        held = np.zeros((order + 1, self.naxes, s.size))
        held[0] = (self.initial if segment < 0 else self.final)[:, None]
        return held

    def segments_jet_at(self, moments: Array, origins: Array, s: Array, order: int) -> Array:
        """Jets at many moments, each with its origin; as `segment_jet_at`."""
        segments = np.searchsorted(self.breakpoints, moments) - 1
        inside = (segments >= 0) & (segments < self.breakpoints.size - 1)
        if inside.all():
            return self.segments_jet(segments, s + (origins - self.breakpoints[segments]), order)
        out = np.zeros((order + 1, self.naxes, s.size))
        out[0] = np.where(segments < 0, self.initial[:, None], self.final[:, None])
        own = segments[inside]
        out[:, :, inside] = self.segments_jet(own, s[inside] + (origins[inside] - self.breakpoints[own]), order)
        return out

    def segment_rows_at(self, moment: float, origin: float, s: float, order: int) -> list[list[float]] | None:
        """Derivatives by axis at one time; as `segment_jet_at`."""
        moments = self._moments
        segment = bisect_left(moments, moment) - 1
        if 0 <= segment < len(moments) - 1:
            return self.segment_rows(segment, s + (origin - moments[segment]), order)
        return [[value, *[0.0] * order] for value in (self.initial if segment < 0 else self.final).tolist()]

    def segment_series_at(self, moment: float, origin: float, s: Value, order: int) -> list[list[Value]]:
        """Taylor series at a number or symbol s; as `segment_jet_at`."""
        segment = int(np.searchsorted(self.breakpoints, moment)) - 1
        if 0 <= segment < self.breakpoints.size - 1:
            return self.segment_series(segment, s + (origin - float(self.breakpoints[segment])), order)
        return [[value, *[0.0] * order] for value in (self.initial if segment < 0 else self.final).tolist()]


def check_end(plan: Trajectory, name: str = "plan") -> None:
    """Raise for a plan that repeats for all future times."""
    if plan.end == math.inf:
        raise ValueError(
            f"{name} must have an end, got a plan that repeats for all future times; use the part that repeats (its "
            "attribute `plan`), or a number of repetitions of it by `repeat`"
        )


def _placed(values: Array, out: Array | None) -> Array:
    """Values, copied into a part of a result if it is given."""
    if out is None:
        return values
    out[...] = values
    return out


def _no_rows(*_given: object) -> None:
    """In place of a method for one time that would differ from the one for many times."""


def _is_factor(value: object) -> bool:
    """Whether a value is a real factor; numpy time differences are Real but are not."""
    return isinstance(value, Real) and not isinstance(value, bool | np.timedelta64)
