"""Limits of one signal: as given (`Limits`, `Region`), and as evaluated (`Bound`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, fields, replace
from numbers import Real
from typing import Any, Literal, TypeGuard

import numpy as np

from ctrlplan._checks import checked_finite, checked_limits, checked_pair, real_array
from ctrlplan._display import time_text
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.waypoint import ENTRIES

Side = float | Sequence[float] | Callable[[Array], Array] | None
"""Limit on one side: a number, values at the times of `Limits.along`, or a function of time."""

Pair = tuple[float | None, float | None]

Kind = Literal["value", "rate", "rms"]
"""What a `Bound` limits: the signal, its time derivative, or its root mean square."""


@dataclass(frozen=True, repr=False)
class Limits:
    """Limits of one signal, for `fastest` and `margins`.

    Short forms are a number above 0, 5.0 for ``Limits(-5.0, 5.0)``, and a pair
    (minimum, maximum), with None for a side without limit. A list of Limits
    applies all of them to a signal.

    Parameters
    ----------
    low, high : float, sequence of float or callable, optional
        Minimum and maximum, in the unit of the signal; None or infinite for no
        limit. With `along`: values at its times. A function maps times [s]
        (ntime,) of the given plan to values (ntime,); values within less than 1e-4
        of the duration may be missed.
    rate : float or (float, float), optional
        Maximum magnitude of the time derivative, or its minimum and maximum, in
        the unit of the signal per second. For a held signal of a loop: its change
        from sample to sample over the sampling period.
    rms : float, optional
        Maximum root mean square, over the duration of the plan. For a cyclic plan
        in a loop: in the periodic steady state.
    period : float, optional
        Period [s] of the root mean square, from the start of the plan, with the
        dwell after its end included; not scaled with the plan.
    during : (float, float), optional
        Interval of time [s] of the given plan outside of which `low`, `high` and
        `rate` do not apply; it is scaled with the plan.
    along : array_like, shape (n,), optional
        Times [s] of the given plan, between which `low` and `high` are linear; no
        limit applies before the first and after the last. They are scaled with
        the plan.

    Raises
    ------
    ValueError
        If there is no limit, one is nan, `high` is not above `low`, `rate` does
        not include 0, `rms` or `period` is not positive, times do not increase,
        or arguments contradict each other.
    TypeError
        If one is not a number.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)])
    >>> cp.margins(move, {"y_d1": cp.Limits(high=1.0)})
    <Margins of 1 limit: y_d1 at most 1: 0.9375 at 1 s, 0.0625 left>

    In the second half of the move, and the root mean square over a cycle of 3 s:

    >>> limits = {"y_d1": cp.Limits(-0.5, 0.95, during=(1.0, 2.0)), "y_d2": cp.Limits(rms=1.0, period=3.0)}
    >>> print(cp.margins(move, limits).active)
    y_d1 from -0.5 to 0.95 between 1 and 2 s: 0.9375 at 1 s, 1.72 % left
    """

    low: Side = None
    high: Side = None
    _: KW_ONLY
    rate: float | Pair | None = None
    rms: float | None = None
    period: float | None = None
    during: tuple[float, float] | None = None
    along: Sequence[float] | None = None

    def __post_init__(self) -> None:
        bounded = self.low is not None or self.high is not None
        if self.rate is not None:
            self._set(rate=_checked_rate(self.rate, self.during is not None))
        if self.rms is not None:
            self._set(rms=checked_finite(self.rms, "rms", above=0.0))
        if self.period is not None:
            self._set(period=checked_finite(self.period, "period", above=0.0))
            if self.rms is None:
                raise ValueError(f"period must be that of an rms limit, got period={self.period:g} without rms=")
        if self.during is not None:
            self._set(during=_checked_during(self.during))
            if not bounded and self.rate is None:
                raise ValueError("during must be given with low, high or rate, got none; an rms limit takes period=")
        if self.along is not None or callable(self.low) or callable(self.high):
            self._set_over_time()
        elif bounded or (self.rate is None and self.rms is None):
            for name, side in (("low", self.low), ("high", self.high)):
                if is_listed(side):
                    raise ValueError(
                        f"{name} must be one number unless times are given by along=, got {side!r:.80}; for several "
                        "axes give Limits by name, such as x_d1 and z_d1"
                    )
            low, high, _ = checked_limits(_sides(self.low, self.high), "Limits")
            self._set(low=None if math.isinf(low) else low, high=None if math.isinf(high) else high)

    def __repr__(self) -> str:
        given = {own.name: getattr(self, own.name) for own in fields(self)}
        return f"Limits({', '.join(f'{name}={value!r}' for name, value in given.items() if value is not None)})"

    def _set(self, **values: object) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _set_over_time(self) -> None:
        """Check limits that depend on time, and store values as tuples."""
        sides = {"low": self.low, "high": self.high}
        if self.along is None:
            for name, side in sides.items():
                if side is not None and not callable(side):
                    self._set(**{name: checked_finite(side, name)})
            return
        if any(callable(side) for side in sides.values()):
            raise ValueError("along must be given with values at its times, got a function; leave along out")
        times = np.atleast_1d(real_array(self.along, "along"))
        if times.ndim != 1 or times.size < 2 or not np.isfinite(times).all() or not (np.diff(times) > 0.0).all():
            raise ValueError(f"along must be two or more finite times that increase, got {self.along!r:.80}")
        if all(side is None for side in sides.values()):
            raise ValueError("along must be given with low or high, got neither")
        rows = {name: _at_times(side, name, times) for name, side in sides.items() if side is not None}
        if len(rows) == 2 and not (rows["low"] < rows["high"]).all():
            k = int((rows["low"] >= rows["high"]).argmax())
            raise ValueError(
                f"high must be above low at all times, got {rows['high'][k]:g} and {rows['low'][k]:g} at "
                f"along[{k}] = {time_text(times[k])} s"
            )
        self._set(along=tuple(times.tolist()), **{name: tuple(row.tolist()) for name, row in rows.items()})

    @classmethod
    def of(cls, limit: object, name: str) -> Limits:
        """Limits from an object of this class or a short form.

        Parameters
        ----------
        limit : Limits, float or (float, float)
            Limits or short form.
        name : str
            Name of the signal, for messages.

        Raises
        ------
        ValueError, TypeError
            As the constructor; if a lone number is not above 0 and finite.
        """
        if isinstance(limit, Limits):
            return limit
        if is_listed(limit):
            if len(limit) != 2 or any(is_listed(side) for side in limit):
                raise ValueError(f"limits of {name} must be a number or a pair of numbers, got {limit!r}")
            limit = _sides(*limit)
        elif isinstance(limit, bool) or not isinstance(limit, Real | np.ndarray):
            raise TypeError(f"limits of {name} must be a number or a pair, got {limit!r}")
        return cls(*checked_limits(limit, f"limits of {name}")[:2])

    def bounds(self, name: str, signal: Signal) -> Iterator[Bound]:
        """One `Bound` for each kind of limit of a signal."""
        terms = ((signal, 1.0),)
        if self.low is not None or self.high is not None:
            profile = Profile.of(self)
            low, high, scale = (
                checked_limits(_sides(self.low, self.high), f"limits of {name}")
                if profile is None
                else (-math.inf, math.inf, 1.0)
            )
            yield Bound(name, low, high, scale, terms, during=self.during, profile=profile)
        if isinstance(self.rate, tuple):
            low, high, scale = checked_limits(_sides(*self.rate), f"rate of {name}")
            yield Bound(f"rate of {name}", low, high, scale, terms, kind="rate", during=self.during)
        if self.rms is not None:
            yield Bound(f"RMS of {name}", -math.inf, self.rms, self.rms, terms, kind="rms", period=self.period)


@dataclass(frozen=True)
class Region:
    """Convex region for two signals, such as speed and torque.

    Parameters
    ----------
    signals : (str, str)
        Names of two signals.
    vertices : array_like, shape (n, 2)
        Corners of the region in order, in either direction, n at least 3, in the
        units of the signals; in all four quadrants where the signals have both
        signs.

    Raises
    ------
    ValueError
        If the region is not convex or has no area, or values are not finite.
    TypeError
        If `signals` are not two names.

    Examples
    --------
    A torque up to 3 N m that decreases to 0 at 100 rad/s, in both directions:

    >>> import ctrlplan as cp
    >>> corners = [(0, 3), (100, 0), (0, -3), (-100, 0)]
    >>> cp.margins(
    ...     cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 30, 0, 0)], labels=["angle"]),
    ...     {"motor": cp.Region(("angle_d1", "torque"), corners)},
    ...     lambda jet: {"torque": 0.01 * jet[2, 0] + 0.004 * jet[1, 0]},
    ... )
    <Margins of 4 limits: motor: torque + 0.03 angle_d1 at most 3: 2.86326 at 0.307832 s, 4.56 % left>
    """

    signals: tuple[str, str]
    vertices: Sequence[tuple[float, float]]

    def __post_init__(self) -> None:
        names = tuple(self.signals) if isinstance(self.signals, tuple | list) else ()
        if len(names) != 2 or not all(isinstance(name, str) and name for name in names):
            raise TypeError(f"signals must be two names, got {self.signals!r}")
        if names[0] == names[1]:
            raise ValueError(f"signals must be different, got {names[0]} twice")
        corners = real_array(self.vertices, "vertices")
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise ValueError(f"vertices must have the shape (n, 2) with n of at least 3, got {corners.shape}")
        if not np.isfinite(corners).all():
            raise ValueError(f"vertices must be finite, got {corners.tolist()}")
        _check_convex(corners)
        object.__setattr__(self, "signals", names)
        object.__setattr__(self, "vertices", tuple(map(tuple, corners.tolist())))

    def bounds(self, name: str, signals: Sequence[Signal]) -> Iterator[Bound]:
        """One `Bound` for each edge, a half-plane."""
        corners = np.array(self.vertices)
        edges = np.roll(corners, -1, axis=0) - corners
        turn = math.copysign(1.0, float(_cross(edges, np.roll(edges, -1, axis=0)).sum()))
        for corner, (dx, dy) in zip(corners, turn * edges, strict=True):
            outward = np.array([dy, -dx]) / (abs(dx) or abs(dy))
            values = corners @ outward
            high, low = float(corner @ outward), float(values.min())
            terms = tuple((signal, float(w)) for signal, w in zip(signals, outward, strict=True) if w)
            yield Bound(f"{name}: {_sum_words(terms)}", -math.inf, high, 0.5 * (high - low), terms)


def _check_convex(corners: Array) -> None:
    """Raise unless consecutive corners turn in one direction, once around."""
    scale = np.ptp(corners, axis=0)
    area = abs(float(_cross(corners - corners[0], np.roll(corners, -1, axis=0) - corners[0]).sum()))
    if not area > 1e-9 * scale.prod():
        raise ValueError(f"vertices must enclose an area, got {corners.tolist()}")
    edges = (np.roll(corners, -1, axis=0) - corners) / scale
    following = np.roll(edges, -1, axis=0)
    if not edges.any(axis=1).all():
        k = int((~edges.any(axis=1)).argmax())
        raise ValueError(f"vertices must be different, got {corners[k].tolist()} twice; list each corner once")
    turns = _cross(edges, following)
    angles = np.arctan2(turns, (edges * following).sum(axis=1))
    wrong = turns * math.copysign(1.0, float(turns.sum())) < -1e-12
    if wrong.any():
        k = (int(wrong.argmax()) + 1) % len(corners)
        raise ValueError(
            f"vertices must form a convex region, listed in order, got one turned inwards at vertices[{k}] = "
            f"{corners[k].tolist()}; leave it out, or divide the region into convex ones"
        )
    if not math.isclose(abs(float(angles.sum())), 2.0 * math.pi, rel_tol=1e-6):
        raise ValueError(f"vertices must go around the region once, in order, got {corners.tolist()}")


def _cross(first: Array, second: Array) -> Array:
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def _sum_words(terms: Sequence[tuple[Signal, float]]) -> str:
    """A weighted sum of signals in words, the last one first."""
    said = ""
    for signal, factor in reversed(terms):
        size = "" if abs(factor) == 1.0 else f"{abs(factor):.4g} "
        said += ("-" if factor < 0.0 else "") if not said else (" - " if factor < 0.0 else " + ")
        said += f"{size}{signal.name}"
    return said


@dataclass(frozen=True)
class Signal:
    """A signal with limits.

    Attributes
    ----------
    name : str
        Name of a derivative, a quantity of the plant, or a signal of a loop.
    order : int
        Highest derivative of the plan that it depends on; 0 for a loop's signal.
    axis : int or None
        Axis of a derivative; None otherwise.
    loop : bool
        Whether it is a signal of a loop.
    """

    name: str
    order: int = 0
    axis: int | None = None
    loop: bool = False


@dataclass(frozen=True)
class Profile:
    """Limits as functions of the time of the plan for which they were given.

    Attributes
    ----------
    low, high : callable or None
        Maps times (ntime,) to values (ntime,); None for no limit.
    times : tuple of float
        Times [s] of `Limits.along`, outside of which no limit applies; empty for
        functions.
    """

    low: Callable[[Array], Array] | None
    high: Callable[[Array], Array] | None
    times: tuple[float, ...] = ()

    @classmethod
    def of(cls, limits: Limits) -> Profile | None:
        """Profile of limits; None if they are constant."""
        if limits.along is None and not callable(limits.low) and not callable(limits.high):
            return None
        times = tuple(limits.along or ())
        low, high = (
            _function_of_time(side, times, name) for side, name in ((limits.low, "low"), (limits.high, "high"))
        )
        return cls(low, high, times)

    def sides(self, times: Array) -> tuple[Array, Array]:
        """Minimum and maximum (ntime,) at times; infinite where there is no limit."""
        low, high = np.full(times.shape, -np.inf), np.full(times.shape, np.inf)
        if self.low is not None:
            low = self.low(times)
        if self.high is not None:
            high = self.high(times)
        if (low >= high).any():
            k = int((low >= high).argmax())
            raise ValueError(
                f"high must be above low at all times, got {high[k]:g} and {low[k]:g} at {times[k]:g} s of the given "
                "plan"
            )
        return low, high


def _function_of_time(side: Side, times: tuple[float, ...], name: str) -> Callable[[Array], Array] | None:
    if side is None:
        return None
    if times:
        return lambda t: np.interp(t, times, side)  # type: ignore[arg-type]
    if not callable(side):
        return lambda t: np.full(t.shape, side)

    def checked(t: Array) -> Array:
        values = real_array(side(t), name)
        if values.shape not in ((), t.shape) or np.isnan(values).any():
            raise ValueError(
                f"{name} must map times (ntime,) to numbers (ntime,), got shape {values.shape} for {t.shape} with "
                f"{int(np.isnan(values).sum())} nan"
            )
        return np.broadcast_to(values, t.shape)

    return checked


@dataclass(frozen=True)
class Bound:
    """Limits of one signal of a plan, or of a sum of signals.

    Attributes
    ----------
    name : str
        Derivative of an axis (x_d1), quantity of the plant, signal of a loop; with
        "rate of" or "RMS of" for these kinds; edge of a region.
    low, high : float
        Minimum and maximum; one may be infinite. With `profile`: at the time of a
        margin.
    scale : float
        Scale of margins: half the distance of the limits, or the magnitude of a
        single limit; of an edge half the extent of the region.
    terms : tuple of (Signal, float)
        Signals and their factors.
    slack : float
        Tolerance of the excess for rounding; above 0 if the limit is attained
        at rest, and thus at every duration.
    kind : {"value", "rate", "rms"}
        What is limited.
    during : (float, float) or None
        Interval [s] of the given plan in which the limits apply.
    profile : Profile or None
        Limits over time.
    period : float or None
        Period [s] of a root mean square.
    """

    name: str
    low: float
    high: float
    scale: float
    terms: tuple[tuple[Signal, float], ...]
    slack: float = 0.0
    kind: Kind = "value"
    during: tuple[float, float] | None = None
    profile: Profile | None = None
    period: float | None = None

    @property
    def order(self) -> int:
        """Highest derivative of the plan that is required."""
        return max(signal.order for signal, _ in self.terms) + (self.kind == "rate")

    @property
    def axis(self) -> int | None:
        """Axis of a limited derivative of the plan; otherwise None."""
        (signal, factor), *others = self.terms
        return signal.axis if not others and factor == 1.0 and self.kind != "rms" else None

    @property
    def weights(self) -> dict[str, float]:
        """Factors by the name of a signal."""
        return {signal.name: factor for signal, factor in self.terms}

    @property
    def in_loop(self) -> bool:
        """Whether a signal of a loop is limited."""
        return self.terms[0][0].loop

    @property
    def is_constant(self) -> bool:
        """Whether the same limits apply to values at every time."""
        return self.kind != "rms" and self.during is None and self.profile is None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Interval [s] in which limits apply; None for all times."""
        spans = [span for span in (self.during, self._tabulated()) if span is not None]
        return (max(low for low, _ in spans), min(high for _, high in spans)) if spans else None

    def _tabulated(self) -> tuple[float, float] | None:
        return (self.profile.times[0], self.profile.times[-1]) if self.profile and self.profile.times else None

    def sides(self, times: Array) -> tuple[Array, Array]:
        """Minimum and maximum (ntime,); infinite where none applies."""
        span = self.interval or (-math.inf, math.inf)
        applies = (times >= span[0]) & (times <= span[1])
        low, high = np.full(times.shape, self.low), np.full(times.shape, self.high)
        if self.profile is not None and applies.any():
            low[applies], high[applies] = self.profile.sides(times[applies])
        return np.where(applies, low, -np.inf), np.where(applies, high, np.inf)

    def excess(self, values: Array, times: Array | None = None) -> Array:
        """Violation by values, relative to the scale; negative inside."""
        low, high = (self.low, self.high) if self.is_constant or times is None else self.sides(times)
        return np.maximum(values - high, low - values) / self.scale - self.slack

    @property
    def range(self) -> str:
        """The limits in words."""
        words = "over time" if math.isinf(self.low) and math.isinf(self.high) else _range(self.low, self.high)
        if self.kind == "rms":
            return words + (f" over {self.period:g} s" if self.period else "")
        return words + (f" between {self.during[0]:g} and {self.during[1]:g} s" if self.during else "")

    def at(self, time: float) -> Bound:
        """The same with the limits at a time of the given plan."""
        if self.profile is None:
            return self
        low, high = self.profile.sides(np.array([time]))
        return replace(self, low=float(low[0]), high=float(high[0]))


def changes(bound: Bound) -> tuple[float, ...]:
    """Times [s] of the given plan at which limits begin, end or have a kink."""
    return (*(bound.interval or ()), *(bound.profile.times if bound.profile is not None else ()))


def limit_words(limit: object, name: str = "velocity") -> str:
    """Description of a limit in any form that `margins` accepts, by axis for names of all axes, such as velocity."""
    if isinstance(limit, Region):
        return f"{limit.signals[0]} and {limit.signals[1]} in a region of {len(limit.vertices)} corners"
    if isinstance(limit, Limits):
        own = Signal(name)
        return ", ".join(
            bound.name.removesuffix(name).replace(" of ", " ") + bound.range for bound in limit.bounds(name, own)
        )
    given = np.array(limit, dtype=object)
    if given.ndim == 0:
        return _range(-float(given), float(given))
    if given.shape == (2,) and (isinstance(limit, tuple) or name not in ENTRIES):
        return _range(*map(float, _sides(*given)))
    return "; ".join(limit_words(tuple(row) if np.ndim(row) else row) for row in given)


def _range(low: float, high: float) -> str:
    if math.isinf(low):
        return f"at most {high:g}"
    if math.isinf(high):
        return f"at least {low:g}"
    return f"within ±{high:g}" if low == -high else f"from {low:g} to {high:g}"


def _sides(low: Any, high: Any) -> tuple[float, float]:
    """Both limits as numbers, infinite for None."""
    return -math.inf if low is None else low, math.inf if high is None else high


def is_listed(limit: object) -> TypeGuard[Sequence[float | None]]:
    """Whether limits are a list or array."""
    given: Any = limit
    return isinstance(given, list | tuple) or bool(np.ndim(given))


def _checked_rate(rate: object, during: bool) -> Pair:
    """Limits of a rate as a pair, None for no limit."""
    pair = _sides(*rate) if is_listed(rate) and len(rate) == 2 else rate
    low, high, _ = checked_limits(pair, "rate")
    if not during and not low <= 0.0 <= high:
        raise ValueError(f"rate must include 0, the value at rest, got from {low:g} to {high:g}; or give during=")
    return None if math.isinf(low) else low, None if math.isinf(high) else high


def _checked_during(during: object) -> tuple[float, float]:
    first, last = checked_pair(during, "during")
    if not (math.isfinite(first) and math.isfinite(last)):
        raise ValueError(f"during must be two finite times, got {time_text(first)} and {time_text(last)}")
    return first, last


def _at_times(side: Side, name: str, times: Array) -> Array:
    """Values of a limit at the times of `Limits.along`, from one number for all or one for each."""
    values = real_array(side, name)  # type: ignore[arg-type]
    if values.shape not in ((), times.shape) or not np.isfinite(values).all():
        raise ValueError(
            f"{name} must be a finite number, or {times.size} of them as along has times, got {side!r:.80}"
        )
    return np.broadcast_to(values, times.shape)
