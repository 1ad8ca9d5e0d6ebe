"""Signals that are functions of time only, as Chebyshev series by segments.

A plan is analytic between its breakpoints. A solver evaluates it and its
derivatives thousands of times, which the series makes fast. Values at the sample
times are those of the plan itself.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import real_array
from ctrlplan._lru import Lru
from ctrlplan._types import Array
from ctrlplan.trajectories import Step, Trajectory, TrigSpline, chebyshev
from ctrlplan.trajectories.files import signal_rows

Inputs = Trajectory | ArrayLike | Mapping[str, Trajectory | ArrayLike] | None

WIDTHS = (1, 8, 16, 24, 32, 40, 48, 64)
"""Numbers of terms of a series; a segment that requires more is halved."""

RESOLVED = 4e-15
"""Magnitude of the last terms, relative to the largest, at which a signal counts as resolved."""


_FLAT = 1e-7
"""Relative magnitude up to which terms that no longer decrease count as rounding errors."""

_DENSE = np.cos(np.linspace(0.0, np.pi, 4 * WIDTHS[-1]))
"""Points at which a series is compared with its bounds."""

_ROUNDING = 1e-13
"""Violation of the bounds, relative to the terms of a series, that counts as rounding."""

_VALUES, _SHARED, _SEGMENTS = 8, 200_000, 64
"""Number of arrays of times of which values are shared by runs, maximum size of such values, and number of segments."""

_CANCELLED = 16.0
"""Maximum sum of the coefficients of a trigonometric sum relative to its largest value; more would cancel."""

_NOISE = 1e-11
"""Relative magnitude up to which the later half of the longest series counts as rounding errors."""


class Harmonics(NamedTuple):
    """Sum over 1, cos(a), sin(a), cos(2 a), ..., a = rate (t - left), with coefficients (nsignals, 2 n + 1)."""

    rate: float
    coefficients: Array

    def __call__(self, s: float) -> Array:
        """All signals at one time after `left`, shape (nsignals,)."""
        c1, s1 = math.cos(self.rate * s), math.sin(self.rate * s)
        cosine, sine, terms = c1, s1, [1.0]
        for _ in range(self.coefficients.shape[1] // 2):
            terms += (cosine, sine)
            cosine, sine = cosine * c1 - sine * s1, sine * c1 + cosine * s1
        return np.asarray(self.coefficients.dot(terms))

    @classmethod
    def fitted(
        cls, series: Series, rate: float, count: int, accuracy: float, rounding: Array | float
    ) -> Harmonics | None:
        """Sum with `count` harmonics that is equal to a series up to rounding; None if there is none."""
        nodes = chebyshev_times(series.left, series.right, 4 * count + 2)
        between = 0.5 * (nodes[1:] + nodes[:-1])
        values, terms = _unclipped(series, nodes), harmonic_terms(rate * (nodes - series.left), count)
        found: Array = np.linalg.lstsq(terms.T, values.T, rcond=1e-12)[0].T.astype(float)
        size = np.abs(values).max(axis=1, keepdims=True)
        if np.any(np.abs(found).sum(axis=1, keepdims=True) > _CANCELLED * size):
            return None
        apart = np.abs(found @ harmonic_terms(rate * (between - series.left), count) - _unclipped(series, between))
        return cls(rate, found) if np.all(apart <= np.maximum(accuracy * size, np.reshape(rounding, (-1, 1)))) else None


@dataclass(frozen=True, eq=False)
class Series:
    """Signals over one segment: Chebyshev coefficients (nsignals, width) from left to right.

    Attributes
    ----------
    low, high : ndarray, shape (nsignals,)
        Bounds to which values are clipped, since rounding may violate them;
        infinite if they are not known.
    harmonics : Harmonics or None
        The same signals as a trigonometric sum, if they are one with fewer terms.
    """

    left: float
    right: float
    coefficients: Array
    low: Array
    high: Array
    harmonics: Harmonics | None = None

    def __call__(self, t: float) -> Array:
        """All signals at one time, shape (nsignals,)."""
        width = self.coefficients.shape[1]
        if width == 1:
            return self.coefficients[:, 0]
        # A trial step of a solver may end slightly beyond the segment.
        t = min(self.right, max(self.left, t))
        if self.harmonics is not None:
            values = self.harmonics(t - self.left)
        else:
            u = (2.0 * t - self.left - self.right) / (self.right - self.left)
            values = self.coefficients @ np.cos(math.acos(min(1.0, max(-1.0, u))) * _counts(width))
        return np.asarray(np.minimum(np.maximum(values, self.low), self.high))

    def at(self, times: Array) -> Array:
        """All signals at many times, shape (nsignals, ntime)."""
        u = np.clip((2.0 * times - self.left - self.right) / (self.right - self.left), -1.0, 1.0)
        values = self.coefficients @ np.cos(_counts(self.coefficients.shape[1])[:, None] * np.arccos(u))
        return np.asarray(np.clip(values, self.low[:, None], self.high[:, None]))

    @property
    def terms(self) -> Array:
        """Coefficients (nsignals, width) for a compiled form: of the harmonics if they are known."""
        return self.coefficients if self.harmonics is None else self.harmonics.coefficients

    @cached_property
    def flat(self) -> Array:
        """These, column by column, and the bounds; nan for a signal whose coefficients are not finite."""
        terms, low, high = self.terms, self.low, self.high
        defined = np.isfinite(terms)
        if not defined.all():
            undefined = np.where(defined.all(axis=1), 0.0, np.nan)
            low, high = low + undefined, high + undefined
        return np.concatenate([terms.ravel(order="F"), low, high])

    def with_harmonics(self, known: tuple[float, int] | None, accuracy: float, rounding: Array | float) -> Series:
        """Same signals with their trigonometric sum of known rate and number of harmonics, if it has fewer terms."""
        if known is None or self.coefficients.shape[1] <= 2 * known[1] + 1:
            return self
        return replace(self, harmonics=Harmonics.fitted(self, *known, accuracy, rounding))

    def bounded(self, low: Array, high: Array) -> Series:
        """Same signals with bounds, unless they violate these by more than rounding."""
        dense = np.polynomial.chebyshev.chebval(_DENSE, self.coefficients.T)
        slack = _ROUNDING * np.abs(self.coefficients).sum(axis=1)
        return replace(
            self,
            low=np.where(dense.min(axis=1) < low - slack, -np.inf, low),
            high=np.where(dense.max(axis=1) > high + slack, np.inf, high),
        )


class TimeSignal(Protocol):
    """Signals that are functions of time, analytic between breakpoints."""

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """Times [s] in [t0, t1) at which they are not analytic."""

    @property
    def width(self) -> int:
        """Number of signals."""

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values (nsignals, ntime) at origin + s of the analytic functions that are valid at `moment`."""

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """Minima and maxima (nsignals,) between two times without a breakpoint in between; infinite if unknown.

        Bounds that a signal exceeds between the ends are ignored.
        """

    def ends(self, left: float, right: float) -> tuple[Array, Array] | None:
        """Values (nsignals,) at both ends of a segment if they are known to be straight lines; None otherwise."""

    def at(self, times: Array) -> Array:
        """Values (nsignals, ntime), right-continuous."""


@dataclass(frozen=True, eq=False)
class PlanSignal:
    """A plan and its derivatives, axis by axis."""

    plan: Trajectory
    derivatives: int = 0

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """Breakpoints of the plan."""
        return self.plan.breakpoints_between(t0, t1)

    @property
    def width(self) -> int:
        """Number of signals of all axes."""
        return self.plan.naxes * (self.derivatives + 1)

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values of the segment that contains `moment`."""
        jet = self.plan.segment_jet_at(moment, origin, s, self.derivatives)
        return jet.transpose(1, 0, 2).reshape(-1, s.size)

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """Bounds by the values of the plan at both ends."""
        return _ordered(self.analytic_at(moment, left, np.array([0.0, right - left])))

    def ends(self, left: float, right: float) -> tuple[Array, Array] | None:
        """Constant values of steps; other plans are not known to be straight lines."""
        if not isinstance(self.plan, Step):
            return None
        value = self.analytic_at(0.5 * (left + right), left, np.zeros(1))[:, 0]
        return value, value

    @property
    def harmonics(self) -> tuple[float, int] | None:
        """Rate [rad/s] and number of harmonics of a trigonometric spline; None for other plans."""
        if not isinstance(self.plan, TrigSpline) or not self.plan.alpha:
            return None
        return self.plan.alpha / self.plan.duration, max(self.plan.degree)

    def at(self, times: Array) -> Array:
        """Values of the plan."""
        return signal_rows(self.plan, times, self.derivatives)


class SampledSignal:
    """Signal given by samples, linear in between; its breakpoints are changes of slope beyond rounding."""

    width = 1

    def __init__(self, times: Array, values: Array) -> None:
        self.times, self.values = times, values

    @cached_property
    def _ends(self) -> NDArray[np.intp]:
        """Indices of the samples at the ends of lines, which a linear loop does not need."""
        return _ends_of_lines(self.times, self.values)

    @cached_property
    def _knots(self) -> Array:
        return self.times[self._ends]

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """Samples at which the slope changes."""
        inner = self._knots[1:-1]
        return inner[slice(*np.searchsorted(inner, [t0, t1]).tolist())]

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values of the straight line that contains `moment`."""
        line = self._line(moment)
        (t0, t1), (v0, v1) = self.times[line], self.values[line]
        return (v0 + (v1 - v0) * ((origin - t0 + s) / (t1 - t0)))[None]

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """Bounds by the samples at both ends of a straight line."""
        return _ordered(self.values[None, self._line(moment)])

    def ends(self, left: float, right: float) -> tuple[Array, Array] | None:
        """Values at both ends of the line that contains the middle of a segment."""
        line = self._line(0.5 * (left + right))
        (t0, t1), (v0, v1) = self.times[line].tolist(), self.values[line].tolist()
        first, last = (v0 + (v1 - v0) * ((left - t0 + s) / (t1 - t0)) for s in (0.0, right - left))
        return np.array([first]), np.array([last])

    def at(self, times: Array) -> Array:
        """Interpolated values."""
        if times is self.times:
            return self.values[None]
        after = np.clip(np.searchsorted(self.times, times, side="right"), 1, self.times.size - 1)
        first, second = self.values[after - 1], self.values[after]
        found = np.interp(times, self.times, self.values)
        return np.clip(found, np.minimum(first, second), np.maximum(first, second))[None]

    def _line(self, moment: float) -> NDArray[np.intp]:
        """Indices of the samples at both ends of the line that contains `moment`."""
        left = min(max(int(np.searchsorted(self._knots, moment)) - 1, 0), self._knots.size - 2)
        return self._ends[left : left + 2]


class TimeSignals(tuple[TimeSignal, ...]):
    """Functions of time of a run in order; their values and series are shared by runs if all of them are plans."""

    def __init__(self, signals: Iterable[TimeSignal]) -> None:
        self._values: Lru[bytes, Array] = Lru(_VALUES)
        self._series: Lru[tuple[float, float, float, bytes], list[Series]] = Lru(_SEGMENTS)
        self._marks: Lru[tuple[object, ...], tuple[list[float], Array]] = Lru(_VALUES)
        self._fixed = all(isinstance(signal, PlanSignal) for signal in self)

    def at(self, times: Array) -> Array:
        """Values (nsignals, ntime), right-continuous; read-only if they are shared."""
        if not self._fixed or times.size * self.width > _SHARED:
            return signal_values(self, times)
        return self._values.get(times.tobytes(), lambda: _read_only(signal_values(self, times)))

    def marks(
        self, key: tuple[object, ...], find: Callable[[], tuple[list[float], Array]]
    ) -> tuple[list[float], Array]:
        """Breakpoints of a run and rounding errors of the signals, found once for what else they depend on."""
        return self._marks.get(key, find) if self._fixed else find()

    @property
    def width(self) -> int:
        """Number of all signals."""
        return sum(signal.width for signal in self)

    def series(self, moment: float, left: float, until: float, accuracy: float, rounding: Array) -> list[Series]:
        """Series and bounds of the signals over a segment.

        Parameters
        ----------
        moment : float
            A time inside [s].
        left, until : float
            The segment [s], without a breakpoint inside.
        accuracy : float
            Maximum truncation error, relative to each signal.
        rounding : ndarray, shape (nsignals,)
            Rounding errors of the signals.
        """
        if not self._fixed:
            return self._resolved(moment, left, until, accuracy, rounding)
        key = left, until, accuracy, rounding.tobytes()
        return self._series.get(key, lambda: self._resolved(moment, left, until, accuracy, rounding))

    def _resolved(self, moment: float, left: float, until: float, accuracy: float, rounding: Array) -> list[Series]:
        lines = [signal.ends(left, until) for signal in self]
        known = [line for line in lines if line is not None]
        if known and len(known) == len(lines):
            return [straight(left, until, *(np.concatenate(values) for values in zip(*known, strict=True)))]
        sums = {signal.harmonics for signal in self if isinstance(signal, PlanSignal)} - {None}
        harmonics = sums.pop() if self._fixed and len(sums) == 1 else None
        return [
            series.bounded(*self._bounds(moment, series.left, series.right)).with_harmonics(
                harmonics, accuracy, rounding
            )
            for series in resolved(partial(self._analytic_at, moment, left), left, until, accuracy, rounding)
        ]

    def _analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        return np.concatenate([np.zeros((0, s.size)), *(signal.analytic_at(moment, origin, s) for signal in self)])

    def _bounds(self, moment: float, left: float, right: float) -> list[Array]:
        found = [signal.bounds(moment, left, right) for signal in self]
        return [np.concatenate([np.zeros(0), *(pair[side] for pair in found)]) for side in (0, 1)]


def harmonic_terms(angle: Array, count: int) -> Array:
    """Terms (2 count + 1, n) of `Harmonics` at angles (n,)."""
    multiples = np.arange(1.0, count + 1.0)[:, None] * angle
    pairs = np.stack([np.cos(multiples), np.sin(multiples)], axis=1).reshape(2 * count, -1)
    return np.concatenate([np.ones((1, angle.size)), pairs])


def input_signals(labels: Sequence[str], inputs: Inputs, times: Array) -> list[TimeSignal]:
    """Input signals of a system, in order.

    Raises
    ------
    ValueError
        If an input is unknown, or signals do not fit the inputs or the times.
    """
    given: list[Trajectory | ArrayLike]
    if isinstance(inputs, Mapping):
        for name in inputs:
            if name not in labels:
                raise ValueError(f"inputs must be among {', '.join(labels) or 'none'}, got {name!r}")
        given = [inputs.get(name, 0.0) for name in labels]
    elif isinstance(inputs, Trajectory):
        if inputs.naxes != len(labels):
            known = f"({', '.join(labels)})" if labels else "(the system has no inputs)"
            raise ValueError(f"inputs must have {len(labels)} axes {known}, got {inputs.naxes}")
        # By name if the names are the same, in any order.
        crossed = set(inputs.labels) == set(labels) and inputs.labels != tuple(labels)
        return [PlanSignal(inputs.select(labels) if crossed else inputs)]
    elif inputs is None or (not isinstance(inputs, list | tuple) and np.ndim(inputs) == 0 and not callable(inputs)):
        given = [0.0 if inputs is None else inputs] * len(labels)
    elif (
        isinstance(inputs, list | tuple)
        and len(inputs) == len(labels)
        and (len(inputs) != times.size or any(isinstance(value, Trajectory) for value in inputs))
    ):
        given = list(inputs)
    else:
        rows = _numbers(inputs, "inputs")
        rows = rows[None] if rows.ndim == 1 and len(labels) == 1 else rows
        if rows.shape not in ((len(labels), times.size), (len(labels),)):
            raise ValueError(f"inputs must have shape ({len(labels)}, {times.size}), got {rows.shape}")
        if rows.ndim == 2 and np.isfinite(rows).all():
            return [SampledSignal(times, row) for row in rows]
        given = list(rows)
    return [_time_signal(value, name, times) for value, name in zip(given, labels, strict=True)]


def signal_values(time_signals: Sequence[TimeSignal], times: Array) -> Array:
    """Values (nsignals, ntime) of functions of time, right-continuous."""
    return np.concatenate([np.zeros((0, times.size)), *(signal.at(times) for signal in time_signals)])


def resolved(
    signals: Callable[[Array], Array],
    left: float,
    right: float,
    tolerance: float = RESOLVED,
    rounding: Array | float = 0.0,
) -> list[Series]:
    """Series of analytic signals over a segment, which is halved as required.

    Parameters
    ----------
    signals : callable
        Maps times since `left` (ntime,) to values (nsignals, ntime).
    left, right : float
        The segment [s].
    tolerance : float, optional
        Maximum truncation error, relative to each signal.
    rounding : ndarray, shape (nsignals,), or float, optional
        Rounding errors of the signals, which halving does not reduce.
    """
    # Not at the ends, where an adjacent segment might be evaluated.
    duration = right - left
    values = signals(duration * _PROBES)
    if np.all(values == values[:, :1]):
        return [_unbounded(left, right, values[:, :1])]
    for width in WIDTHS[1:]:
        coefficients = chebyshev_coefficients(signals(chebyshev_times(0.0, duration, width)))
        size = np.abs(coefficients)
        allowed = size.max(axis=1, keepdims=True)
        if np.all(size[:, -3:] <= np.maximum(tolerance * allowed, np.reshape(rounding, (-1, 1)))):
            return [_unbounded(left, right, coefficients)]
    # Terms that no longer decrease are rounding errors of the signal, which shorter segments do not reduce: where a
    # plan is constant, its derivatives are negligible.
    half, end = size[:, width // 2 : -width // 4], size[:, -width // 4 :]
    noise = np.maximum(half.max(axis=1), end.max(axis=1))
    flat = half.max(axis=1) <= 10.0 * end.max(axis=1)
    if np.all(noise <= np.maximum(np.where(flat, _FLAT, max(_NOISE, 10.0 * tolerance)) * allowed[:, 0], rounding)):
        return [_unbounded(left, right, coefficients)]
    middle = 0.5 * (left + right)
    if not left < middle < right or duration < 1e-12 * max(abs(left), abs(right)):
        return [_unbounded(left, right, coefficients)]
    first = resolved(signals, left, middle, tolerance, rounding)
    return first + resolved(lambda s: signals(s + (middle - left)), middle, right, tolerance, rounding)


def chebyshev_times(left: float, right: float, width: int) -> Array:
    """Increasing times of a segment for the values of `chebyshev_coefficients`."""
    return chebyshev.points(width - 1, left, right)[::-1]


def chebyshev_coefficients(values: Array) -> Array:
    """Coefficients (nsignals, width) from values (nsignals, width) at `chebyshev_times`; exact for constants."""
    coefficients = chebyshev.transform(values[:, ::-1])
    constant = np.all(values == values[:, :1], axis=1)
    coefficients[constant] = 0.0
    coefficients[constant, 0] = values[constant, 0]
    return np.asarray(coefficients)


def _ends_of_lines(times: Array, values: Array) -> NDArray[np.intp]:
    """Indices of the samples at the ends of straight lines through all others, up to rounding.

    Samples that are a change of slope larger than the rounding of the largest value
    are ends. If the samples between two of them deviate from their line by more than
    its own rounding, each change of slope between them is an end as well.
    """
    slope = np.diff(values) / np.diff(times)
    bend = np.abs(np.diff(slope)) * np.minimum(np.diff(times)[1:], np.diff(times)[:-1])
    certain = np.flatnonzero(bend > _rounding_of_lines(times, np.abs(values).max(), np.abs(slope).max())) + 1
    ends = np.concatenate([[0], certain, [times.size - 1]])
    line = np.repeat(np.arange(ends.size - 1), np.diff(ends))  # of each sample but the last
    steepness = np.abs(np.diff(values[ends]) / np.diff(times[ends]))
    size = np.maximum(np.abs(values[ends[:-1]]), np.abs(values[ends[1:]]))
    deviation = np.abs(values - np.interp(times, times[ends], values[ends]))[:-1]
    bent = np.unique(line[deviation > _rounding_of_lines(times, size, steepness)[line]])
    inside = np.flatnonzero(slope[1:] != slope[:-1]) + 1
    return np.union1d(ends, inside[np.isin(line[inside], bent)])


def _rounding_of_lines(times: Array, size: Array | float, steepness: Array | float) -> Array:
    """Rounding errors of samples of lines, by their values and by those of their times."""
    return 4.0 * np.finfo(float).eps * (size + steepness * np.abs(times[[0, -1]]).max())


def straight(left: float, right: float, first: Array, last: Array) -> Series:
    """Series of straight lines with values (nsignals,) at both ends, which are their bounds."""
    coefficients = first[:, None]
    if (first != last).any():
        coefficients = np.array([0.5 * (first + last), 0.5 * (last - first)]).T
    return Series(left, right, coefficients, np.minimum(first, last), np.maximum(first, last))


def _unbounded(left: float, right: float, coefficients: Array) -> Series:
    free = np.full(len(coefficients), np.inf)
    return Series(left, right, coefficients, -free, free)


def _unclipped(series: Series, times: Array) -> Array:
    """Values (nsignals, ntime) of a series, not clipped to its bounds."""
    u = (2.0 * times - series.left - series.right) / (series.right - series.left)
    return np.asarray(np.polynomial.chebyshev.chebval(u, series.coefficients.T))


def _read_only(values: Array) -> Array:
    values.flags.writeable = False
    return values


def _ordered(ends: Array) -> tuple[Array, Array]:
    """Smaller and larger of two values (nsignals, 2)."""
    return ends.min(axis=1), ends.max(axis=1)


def _numbers(value: Trajectory | ArrayLike, what: str) -> Array:
    if callable(value):
        raise TypeError(f"{what} must be a trajectory, a number or samples, got {value!r:.80}")
    return real_array(value, what)


def _time_signal(value: Trajectory | ArrayLike, name: str, times: Array) -> TimeSignal:
    if isinstance(value, Trajectory):
        if value.naxes != 1:
            raise ValueError(f"input {name} must be a trajectory of one axis, got {value.naxes}")
        return PlanSignal(value)
    signal = _numbers(value, f"input {name}")
    if not np.isfinite(signal).all():
        raise ValueError(f"input {name} must be finite, got nan or inf at index {int((~np.isfinite(signal)).argmax())}")
    if signal.ndim == 0:
        return PlanSignal(Step(signal, initial=signal, time=times[0]))
    if signal.shape != times.shape:
        kinds = f"a trajectory, a number or {times.size} samples"
        raise ValueError(f"input {name} must be {kinds}, got shape {signal.shape}")
    return SampledSignal(times, signal)


def after_marks(marks: Array, times: Array, tolerance: float) -> Array:
    """Times, replaced by a breakpoint that follows within a tolerance."""
    if not len(marks):
        return times
    following = np.asarray(marks)[np.minimum(np.searchsorted(marks, times), len(marks) - 1)]
    return np.where((following >= times) & (following - times <= tolerance), following, times)


def within(left: float, right: float, switches: Sequence[float]) -> tuple[float, float]:
    """First and last time of a segment at which its equations are evaluated.

    At a switch of the equations they are shifted inside by a few rounding errors,
    since at the switch a block may already be on the other side.
    """
    if not switches:
        return left, right
    inset = min(4.0 * float(np.spacing(max(abs(left), abs(right)))), 0.25 * (right - left))
    at_left, at_right = (
        any(abs(t - end) <= 4.0 * inset for t in switches[max(0, bisect_left(switches, end) - 1) :][:2])
        for end in (left, right)
    )
    return left + inset * at_left, right - inset * at_right


def breakpoints_of(time_signals: Iterable[TimeSignal], t0: float, t1: float) -> list[float]:
    """Times in [t0, t1) at which a function of time is not analytic."""
    return [float(t) for signal in time_signals for t in signal.breakpoints_between(t0, t1)]


_PROBES = np.array([0.0312345, 0.1234567, 0.25, 0.3456789, 0.5, 0.6543217, 0.75, 0.8765431, 0.9712345])
"""Fractions of a segment at which values are compared to detect a constant signal."""


@lru_cache(maxsize=32)
def _counts(width: int) -> Array:
    return np.arange(width, dtype=float)
