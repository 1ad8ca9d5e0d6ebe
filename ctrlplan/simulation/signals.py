"""Signals that are functions of time alone, as one short Chebyshev series a segment.

A plan is analytic between its breakpoints. A solver evaluates it,
with all its derivatives, thousands of times: it does so by the series. Values at
the sample times are the plan's own jets.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import real_array
from ctrlplan._types import Array
from ctrlplan.trajectories import Step, Trajectory, chebyshev
from ctrlplan.trajectories.files import signal_rows

Inputs = Trajectory | ArrayLike | Mapping[str, Trajectory | ArrayLike] | None

WIDTHS = (1, 8, 16, 24, 32, 40, 48, 64)
"""Numbers of terms of a series; a segment that needs more is halved."""

RESOLVED = 4e-15
"""Size of the last terms, relative to the largest, at which a signal counts as resolved."""


_FLAT = 1e-7
"""Relative size of terms that no longer fall, up to which they are taken for rounding errors."""

_DENSE = np.cos(np.linspace(0.0, np.pi, 4 * WIDTHS[-1]))
"""Where a series is compared with its bounds."""

_ROUNDING = 1e-13
"""Size, relative to the terms of a series, up to which it leaves its bounds by rounding."""

_NOISE = 1e-11
"""Size of the later half of the longest series up to which it is taken for noise."""


@dataclass(frozen=True, eq=False)
class Series:
    """Signals over one segment: Chebyshev coefficients (nsignals, width) from left to right.

    Attributes
    ----------
    low, high : ndarray, shape (nsignals,)
        Bounds that no value may leave, as it would by rounding; infinite where
        none is known.
    """

    left: float
    right: float
    coefficients: Array
    low: Array
    high: Array

    def __call__(self, t: float) -> Array:
        """All signals at one time, shape (nsignals,)."""
        width = self.coefficients.shape[1]
        if width == 1:
            return self.coefficients[:, 0]
        u = (2.0 * t - self.left - self.right) / (self.right - self.left)
        # A solver's trial step may look a little beyond the segment.
        angle = math.acos(min(1.0, max(-1.0, u)))
        values = self.coefficients @ np.cos(angle * _counts(width))
        return np.asarray(np.minimum(np.maximum(values, self.low), self.high))

    def at(self, times: Array) -> Array:
        """All signals at many times, shape (nsignals, ntime)."""
        u = np.clip((2.0 * times - self.left - self.right) / (self.right - self.left), -1.0, 1.0)
        values = self.coefficients @ np.cos(_counts(self.coefficients.shape[1])[:, None] * np.arccos(u))
        return np.asarray(np.clip(values, self.low[:, None], self.high[:, None]))

    def bounded(self, low: Array, high: Array) -> Series:
        """Same signals with bounds, where they leave these by rounding alone."""
        dense = np.polynomial.chebyshev.chebval(_DENSE, self.coefficients.T)
        slack = _ROUNDING * np.abs(self.coefficients).sum(axis=1)
        return replace(
            self,
            low=np.where(dense.min(axis=1) < low - slack, -np.inf, low),
            high=np.where(dense.max(axis=1) > high + slack, np.inf, high),
        )


class TimeSignal(Protocol):
    """Some signals that are functions of time, analytic between breakpoints."""

    @property
    def breakpoints(self) -> Array:
        """Times at which they are not analytic [s]."""

    @property
    def width(self) -> int:
        """How many signals."""

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values (nsignals, ntime) at origin + s of the analytic functions that hold at `moment`."""

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """Minima and maxima (nsignals,) between two times that no breakpoint parts; infinite where not known.

        Where a signal exceeds them between the ends, they are ignored.
        """

    def at(self, times: Array) -> Array:
        """Values (nsignals, ntime), right-continuous."""


@dataclass(frozen=True, eq=False)
class PlanSignal:
    """A plan and its derivatives, axis by axis."""

    plan: Trajectory
    derivatives: int = 0

    @property
    def breakpoints(self) -> Array:
        """Those of the plan."""
        return self.plan.breakpoints

    @property
    def width(self) -> int:
        """Signals of all axes."""
        return self.plan.naxes * (self.derivatives + 1)

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values of the segment that holds at `moment`."""
        jet = self.plan.segment_jet_at(moment, origin, s, self.derivatives)
        return jet.transpose(1, 0, 2).reshape(-1, s.size)

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """The plan's own values at both ends."""
        return _ordered(self.analytic_at(moment, left, np.array([0.0, right - left])))

    def at(self, times: Array) -> Array:
        """Values of the plan."""
        return signal_rows(self.plan, times, self.derivatives)


class SampledSignal:
    """One signal given by samples, straight in between; it breaks where it bends."""

    width = 1

    def __init__(self, times: Array, values: Array) -> None:
        line = np.interp(times, times[[0, -1]], values[[0, -1]])
        if np.abs(values - line).max() <= 4.0 * np.finfo(float).eps * np.abs(values).max():
            times, values = times[[0, -1]], values[[0, -1]]  # one line but for rounding
        self.times, self.values = times, values
        slope = np.diff(values) / np.diff(times)
        self.breakpoints = times[1:-1][slope[1:] != slope[:-1]]

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values of the straight line that holds at `moment`."""
        left = min(max(int(np.searchsorted(self.times, moment)) - 1, 0), self.times.size - 2)
        (t0, t1), (v0, v1) = self.times[left : left + 2], self.values[left : left + 2]
        return (v0 + (v1 - v0) * ((origin - t0 + s) / (t1 - t0)))[None]

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """The samples between which a straight line runs."""
        start = min(max(int(np.searchsorted(self.times, moment)) - 1, 0), self.times.size - 2)
        return _ordered(self.values[None, start : start + 2])

    def at(self, times: Array) -> Array:
        """Values between the samples."""
        after = np.clip(np.searchsorted(self.times, times, side="right"), 1, self.times.size - 1)
        first, second = self.values[after - 1], self.values[after]
        found = np.interp(times, self.times, self.values)
        return np.clip(found, np.minimum(first, second), np.maximum(first, second))[None]


def input_signals(labels: Sequence[str], inputs: Inputs, times: Array) -> list[TimeSignal]:
    """Signals at the inputs of a system, in order.

    Raises
    ------
    ValueError
        If an input is unknown, or what is given does not fit the inputs or the times.
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
        # By name where the names are the same, whatever their order.
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
        given = list(rows)
    return [_time_signal(value, name, times) for value, name in zip(given, labels, strict=True)]


def signal_values(time_signals: Sequence[TimeSignal], times: Array) -> Array:
    """All signals of some time_signals (nsignals, ntime), right-continuous."""
    return np.concatenate([np.zeros((0, times.size)), *(signal.at(times) for signal in time_signals)])


def resolved(
    signals: Callable[[Array], Array],
    left: float,
    right: float,
    tolerance: float = RESOLVED,
    rounding: Array | float = 0.0,
) -> list[Series]:
    """Series of analytic signals over a segment, as many as it takes.

    Parameters
    ----------
    signals : callable
        Maps times since `left` (ntime,) to values (nsignals, ntime).
    left, right : float
        The segment [s].
    tolerance : float, optional
        Maximum size of what is cut off, relative to each signal.
    rounding : ndarray, shape (nsignals,), or float, optional
        Rounding errors of the signals, which no halving makes smaller.
    """
    # Never at the ends, where a neighbouring segment might be evaluated.
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
    # Terms that no longer fall are rounding errors of the signal itself, which shorter segments make no smaller: where
    # a plan is at rest, its derivatives are next to nothing compared with it.
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
    """Increasing times of a segment at which `chebyshev_coefficients` wants values."""
    return chebyshev.points(width - 1, left, right)[::-1]


def chebyshev_coefficients(values: Array) -> Array:
    """Coefficients (nsignals, width) from values (nsignals, width) at `chebyshev_times`; of a constant, itself."""
    coefficients = chebyshev.transform(values[:, ::-1])
    constant = np.all(values == values[:, :1], axis=1)
    coefficients[constant] = 0.0
    coefficients[constant, 0] = values[constant, 0]
    return np.asarray(coefficients)


def _unbounded(left: float, right: float, coefficients: Array) -> Series:
    free = np.full(len(coefficients), np.inf)
    return Series(left, right, coefficients, -free, free)


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


def within(left: float, right: float, switches: Sequence[float]) -> tuple[float, float]:
    """First and last time of a segment at which its equations are evaluated.

    At a switch of the equations these are inside, by rounding of the times: at
    the switch itself a block may already be on the other side.
    """
    if not switches:
        return left, right
    inset = min(4.0 * float(np.spacing(max(abs(left), abs(right)))), 0.25 * (right - left))
    at_left, at_right = (
        any(abs(t - end) <= 4.0 * inset for t in switches[max(0, bisect_left(switches, end) - 1) :][:2])
        for end in (left, right)
    )
    return left + inset * at_left, right - inset * at_right


def breakpoints_of(time_signals: Iterable[TimeSignal]) -> list[float]:
    """Times at which one of the time_signals is not analytic."""
    return [float(t) for signal in time_signals for t in signal.breakpoints]


_PROBES = np.array([0.0312345, 0.1234567, 0.25, 0.3456789, 0.5, 0.6543217, 0.75, 0.8765431, 0.9712345])
"""Parts of a segment at which a signal is compared, to find whether it is constant."""


@lru_cache(maxsize=32)
def _counts(width: int) -> Array:
    return np.arange(width, dtype=float)
