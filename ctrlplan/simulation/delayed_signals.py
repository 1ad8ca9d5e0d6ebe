"""Signals that have passed a delay, which become known during a numerical run."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.signals import Series


class DelayOutput:
    """Outputs of a delay as functions of time.

    Parameters
    ----------
    delay : float
        Delay [s].
    initial : ndarray, shape (width,)
        Values until the first input has passed.
    first : float
        Start of the run [s].
    """

    def __init__(self, delay: float, initial: Array, first: float) -> None:
        self.delay, self.width = delay, initial.size
        self.tolerance = 0.0
        self._initial, self._first = initial, first


class DelayedSignal(DelayOutput):
    """Delayed signals that become known during a run, stored as Chebyshev series by segments."""

    def __init__(self, delay: float, initial: Array, first: float) -> None:
        super().__init__(delay, initial, first)
        self._pieces: list[Series] = []
        self._ends: list[float] = []

    def record(self, piece: Series) -> None:
        """Record the inputs of the delay over a segment."""
        self._pieces.append(piece)
        self._ends.append(piece.right)

    @property
    def length(self) -> int:
        """Number of stored pieces."""
        return len(self._pieces)

    def shorten(self, length: int) -> None:
        """Remove all but the first pieces."""
        del self._pieces[length:], self._ends[length:]

    def forget(self, now: float) -> None:
        """Remove the pieces that are not read after a time."""
        old = bisect_right(self._ends, now - self.delay - self.tolerance)
        del self._pieces[:old], self._ends[:old]

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """None: segments end at the breakpoints of what is delayed, after the delay."""
        return np.empty(0)

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Stored values; segments end at their breakpoints."""
        return self.at(origin + s)

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """Bounds of the stored signals."""
        low, high = np.full(self.width, np.inf), np.full(self.width, -np.inf)
        if left - self.delay < self._first:
            low, high = self._initial, self._initial
        for piece in self._pieces:
            if piece.left < right - self.delay and piece.right > left - self.delay:
                low, high = np.minimum(low, piece.low), np.maximum(high, piece.high)
        return low, high

    def ends(self, left: float, right: float) -> None:
        """None: stored signals are not known to be straight lines."""

    def at(self, times: Array) -> Array:
        """Stored values."""
        # A jump that arrives at a time is included, whatever the rounding of the times.
        past = times - self.delay + self.tolerance
        out = np.repeat(self._initial[:, None], times.size, axis=1)
        which = np.array([bisect_right(self._ends, t) for t in past.tolist()])
        for k in np.unique(which[past >= self._first]).tolist():
            piece = self._pieces[min(k, len(self._pieces) - 1)]
            rows = (which == k) & (past >= self._first)
            out[:, rows] = piece.at(np.maximum(past[rows] - self.tolerance, piece.left))
        return out


class HeldDelaySignal(DelayedSignal):
    """Delayed signals that sampled blocks hold, stored by their changes; segments end where these arrive."""

    def __init__(self, delay: float, initial: Array, first: float) -> None:
        super().__init__(delay, initial, first)
        self._starts: list[float] = []
        self._values: list[Array] = []

    def changed(self, t: float, value: Array) -> bool:
        """Whether the inputs of the delay differ from a time on, which is then stored."""
        last = self._values[-1] if self._values else self._initial
        if np.array_equal(last, value, equal_nan=True):
            return False
        self._starts.append(t)
        self._values.append(value)
        return True

    @property
    def length(self) -> int:
        """Number of stored changes."""
        return len(self._starts)

    def shorten(self, length: int) -> None:
        """Remove all but the first changes."""
        del self._starts[length:], self._values[length:]

    def forget(self, now: float) -> None:
        """Remove the values that are not read after a time."""
        old = bisect_right(self._starts, now - self.delay - self.tolerance) - 1
        if old > 0:
            del self._starts[:old], self._values[:old]

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """The constant value of the segment that contains `moment`."""
        return np.repeat(self._value(moment)[:, None], s.size, axis=1)

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """The value between two times without a change."""
        value = self._value(moment)
        return value, value

    def at(self, times: Array) -> Array:
        """Values, right-continuous."""
        return np.array([self._value(t) for t in times.tolist()]).reshape(-1, self.width).T

    def _value(self, t: float) -> Array:
        # A change that arrives at a time is included, whatever the rounding of the times.
        k = bisect_right(self._starts, t - self.delay + self.tolerance)
        return self._values[k - 1] if k else self._initial
