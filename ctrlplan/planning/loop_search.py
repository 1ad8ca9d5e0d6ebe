"""Minimum duration under limits on signals of a loop, where feasibility is not monotone in the duration.

At a fixed fraction of the duration, and at a fixed time after the plan, a signal is
a smooth function of the logarithm of the duration, with a known bound of its second
derivative. Between two durations its excess over a limit is therefore at least the
chord minus a known amount. If the largest of these bounds over all samples is positive,
no duration in between satisfies all limits; otherwise the interval is halved.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ctrlplan.planning.quantities import ShapesOf
from ctrlplan.trajectories.common import Array

_PER_OCTAVE = 12
"""Number of durations per octave at which the search begins."""

_BLOCK = 36
"""Number of durations whose responses are computed together first."""

_TESTS = 3
"""Maximum number of durations of a level whose exact extrema are computed."""

_EXCHANGES = 12
"""Maximum number of times at which the samples of an interval are completed by those of an exact extremum."""

_CHECKS = 6
"""Number of durations below a root whose exact extrema are computed where samples do not exclude them."""

_NARROWEST = 1e-9
"""Relative width of an interval of durations that is not halved further."""

_ROUNDING = 1e-13
"""Relative amount by which a minimum duration is increased, so that rounding violates no limit."""

_MOST = 20_000
"""Maximum number of durations whose samples are computed."""

_NONE = -1e6
"""Excess of a sample without limit."""


@dataclass(frozen=True, eq=False)
class Sides:
    """Limits of signals: of each one its maximum and its minimum.

    Attributes
    ----------
    signal : ndarray, shape (nsides,)
        Signal of each side.
    sign : ndarray, shape (nsides,)
        1 for a maximum, -1 for a minimum.
    limit, scale : ndarray, shape (nsides,)
        Limit, and range by which the excess is divided.
    slack : ndarray, shape (nsides,)
        Tolerance of the excess for rounding.
    """

    signal: NDArray[np.intp]
    sign: Array
    limit: Array
    scale: Array
    slack: Array

    def excess(self, values: Array) -> Array:
        """Excess (..., nsides, n) of values (..., nsignals, n)."""
        chosen = values[..., self.signal, :]
        found = self.sign[:, None] * (chosen - self.limit[:, None]) / self.scale[:, None] - self.slack[:, None]
        return np.where(np.isnan(found), _NONE, found)

    def worst(self, low: Array, high: Array) -> Array:
        """Excess (nsides,) of signals with minima and maxima (nsignals,)."""
        values = np.where(self.sign > 0.0, high[self.signal], low[self.signal])
        return np.asarray(self.sign * (values - self.limit) / self.scale - self.slack)


class DurationSearch:
    """Search of the minimum duration with fixed shape.

    Parameters
    ----------
    family : ShapesOf
        Signals as functions of the duration.
    sides : Sides
        Their limits.
    resolution : float
        Margin, relative to the range of a limit: intervals of feasible durations in
        which no duration has a larger one to all limits may be missed.
    others : callable, optional
        Maps a duration to the excess over further limits, which are evaluated where
        those of the signals are satisfied.

    Attributes
    ----------
    evaluated : int
        Number of durations whose samples were computed.
    widest : float
        Largest relative width of an interval in which the further limits were
        evaluated at one duration only.
    """

    def __init__(
        self, family: ShapesOf, sides: Sides, resolution: float, others: Callable[[float], float] | None = None
    ) -> None:
        self._family, self._sides, self._resolution, self._others = family, sides, resolution, others
        self._exact: dict[float, tuple[Array, Array, float]] = {}
        self.evaluated, self.widest = 0, 0.0

    def worst(self, duration: float) -> float:
        """Maximum excess at a duration, from exact extrema."""
        excess, _, others = self._excesses(duration)
        return max(float(excess.max(initial=-math.inf)), others)

    def nearest(self, low: float, high: float) -> float:
        """Duration between two with the smallest excess, of those with exact extrema."""
        return min(((self.worst(d), d) for d in self._exact if low <= d <= high), default=(0.0, high))[1]

    def shortest(self, low: float, high: float) -> float | None:
        """Minimum feasible duration between two; None if there is none."""
        count = max(1, math.ceil(_PER_OCTAVE * math.log2(high / low)))
        grid = np.geomspace(low, high, count + 1)
        for k in range(0, count, _BLOCK):
            found = self._in_block(grid[k : k + _BLOCK + 1])
            if found is not None:
                return found
        return None

    def _excesses(self, duration: float) -> tuple[Array, Array, float]:
        """Excess of each side (nsides,) and its time [s] since the start; excess over the other limits."""
        if duration not in self._exact:
            low, high, time_low, time_high = self._family.extremes(duration)
            times = np.where(self._sides.sign > 0.0, time_high[self._sides.signal], time_low[self._sides.signal])
            excess = self._sides.worst(low, high)
            others = -math.inf if self._others is None else self._others(duration)
            self._exact[duration] = excess, times, others
        return self._exact[duration]

    def _in_block(self, durations: Array) -> float | None:
        """Minimum feasible duration between the first and the last of some durations; None if there is none."""
        block = _Block(durations, self._lines(durations))
        pending, best = np.arange(durations.size - 1), math.inf
        while pending.size:
            left, right = block.durations[pending], block.durations[pending + 1]
            bends = self._bends(left, right)
            open_ = (_lowest(*block.pairs(pending, bends))[0] <= 0.0) & (left < best)
            best = min(best, self._first_feasible(block, np.unique([pending[open_], pending[open_] + 1])))
            fine, again = bends.max(axis=1) <= 0.25 * self._resolution, []
            for k in np.flatnonzero(open_).tolist():
                if left[k] >= best:
                    break
                found = self._in_interval(block, int(pending[k])) if fine[k] else None
                if found is None and right[k] > (1.0 + _NARROWEST) * left[k]:
                    again.append(k)
                else:
                    best = min(best, found or math.inf)
            pending = self._halved(block, pending[[k for k in again if left[k] < best]])
        return None if math.isinf(best) else self._edge(block, best)

    def _lines(self, durations: Array) -> Array:
        """Excesses (ndurations, nsides * nsamples) at samples."""
        self.evaluated += durations.size
        if self.evaluated > _MOST:
            raise RuntimeError(
                f"the minimum duration must be found with {_MOST} durations, got none up to {durations[0]:.6g} s: "
                "limits are nearly attained at many durations; pass a larger resolution, or durations=(low, high)"
            )
        found = self._sides.excess(self._family.samples(durations))
        return np.asarray(found.reshape(durations.size, -1))

    def _bends(self, left: Array, right: Array) -> Array:
        """Maximum distances (nintervals, nsides) of the excesses from their chords."""
        bound = self._family.curvature(left, right)[:, self._sides.signal] / self._sides.scale
        return np.asarray(bound * np.log(right / left)[:, None] ** 2 / 8.0)

    def _first_feasible(self, block: _Block, places: NDArray[np.intp]) -> float:
        """Smallest of some durations whose samples and exact extrema satisfy all limits; inf if there is none."""
        seen = [d for d in block.durations[places][block.tops[places] <= 0.0].tolist() if d not in self._exact]
        known = [d for d in self._exact if self.worst(d) <= 0.0]
        for duration in sorted(seen)[:_TESTS]:
            if duration < min(known, default=math.inf) and self.worst(duration) <= 0.0:
                known.append(duration)
                break
        return min((d for d in known if block.durations[0] <= d <= block.durations[-1]), default=math.inf)

    def _halved(self, block: _Block, pending: NDArray[np.intp]) -> NDArray[np.intp]:
        """Intervals from the halves of given ones."""
        if not pending.size:
            return pending
        middle = np.sqrt(block.durations[pending] * block.durations[pending + 1])
        block.insert(middle, self._lines(middle))
        first = np.searchsorted(block.durations, middle)
        return np.sort(np.concatenate([first - 1, first]))

    def _in_interval(self, block: _Block, left: int) -> float | None:
        """A feasible duration between two neighbours; inf if none has a larger margin than the resolution.

        None if that is not known. Exact extrema at the minimum of the chords complete the samples.
        """
        ends = block.durations[left : left + 2]
        first, last = block.pairs(np.array([left]), None)
        for exchange in range(_EXCHANGES):
            least, place = _lowest(first, last)
            if least[0] > 0.0 or (exchange and least[0] > -0.75 * self._resolution):
                return math.inf
            duration = float(ends[0] * (ends[1] / ends[0]) ** place[0])
            if self.worst(duration) <= 0.0:
                return duration
            excess, times, _ = self._excesses(duration)
            if excess.max() <= 0.0:  # another limit is violated
                self.widest = max(self.widest, float(ends[1] / ends[0]) - 1.0)
                return math.inf
            for side in np.flatnonzero(excess > 0.0).tolist():
                own = [self._excess_at(float(end), side, float(times[side]), duration) for end in ends]
                first, last = np.append(first, [[own[0]]], axis=1), np.append(last, [[own[1]]], axis=1)
        return None

    def _excess_at(self, duration: float, side: int, time: float, other: float) -> float:
        """Excess of a side at the place in the plan, or the time after it, of a time at another duration."""
        if math.isinf(time):
            return _NONE
        same = time * duration / other if time <= other else duration + (time - other)
        low, high = self._family.value(duration, int(self._sides.signal[side]), same)
        value = high if self._sides.sign[side] > 0.0 else low
        found = self._sides.sign[side] * (value - self._sides.limit[side]) / self._sides.scale[side]
        return float(found - self._sides.slack[side])

    def _edge(self, block: _Block, feasible: float) -> float:
        """End of the interval of feasible durations below a feasible one."""
        while True:
            outside = block.durations[(block.durations < feasible) & (block.tops > 0.0)].tolist()
            outside += [d for d in self._exact if block.durations[0] <= d < feasible and self.worst(d) > 0.0]
            low = max(outside, default=feasible)
            if low == feasible or self.worst(low) <= 0.0:
                return min(low, feasible)
            ends = math.log(low), math.log(feasible)
            root = math.exp(brentq(lambda ell: self.worst(math.exp(ell)), *ends, xtol=1e-14, rtol=1e-14))
            root *= 1.0 + _ROUNDING
            # A root of an odd number of them: between the samples an earlier one may be missed.
            between = np.geomspace(low, root, _CHECKS + 2)[1:-1]
            pairs = _Block(np.array([low, root]), self._lines(np.array([low, root]))).pairs(np.zeros(1, np.intp), None)
            if _lowest(*pairs)[0][0] > -0.75 * self._resolution:
                return root
            feasible = next((d for d in between.tolist() if self.worst(d) <= 0.0), math.inf)
            if math.isinf(feasible):
                return root


class _Block:
    """Durations in increasing order with the excesses at samples."""

    def __init__(self, durations: Array, lines: Array) -> None:
        self.durations, self._lines = durations, lines
        self.tops: Array = lines.max(axis=1)

    def insert(self, durations: Array, lines: Array) -> None:
        """Insert further durations."""
        places = np.searchsorted(self.durations, durations)
        self.durations = np.insert(self.durations, places, durations)
        self._lines = np.insert(self._lines, places, lines, axis=0)
        self.tops = self._lines.max(axis=1)

    def pairs(self, left: NDArray[np.intp], bends: Array | None) -> tuple[Array, Array]:
        """Excesses (nintervals, nsamples) at both ends of intervals, lowered by the distance from the chord."""
        first, last = self._lines[left], self._lines[left + 1]
        if bends is not None:
            lower = np.repeat(bends, first.shape[1] // bends.shape[1], axis=1)
            first, last = first - lower, last - lower
        none = (first <= 0.5 * _NONE) | (last <= 0.5 * _NONE)
        first[none], last[none] = _NONE, _NONE
        return first, last


def _lowest(first: Array, last: Array) -> tuple[Array, Array]:
    """Lower bounds of the minimum over an interval of the largest of many chords, and the places of the minima.

    Parameters
    ----------
    first, last : ndarray, shape (nintervals, nlines)
        Values at both ends.

    Returns
    -------
    (ndarray, ndarray), shape (nintervals,)
        Bounds, and places from 0 to 1.
    """
    rows = np.arange(len(first))
    falling, rising = first.argmax(axis=1), last.argmax(axis=1)
    for _ in range(12):
        p0, p1 = first[rows, falling], last[rows, falling]
        q0, q1 = first[rows, rising], last[rows, rising]
        with np.errstate(all="ignore"):
            crossing = (p0 - q0) / ((p0 - q0) + (q1 - p1))
        place = np.where(p1 >= p0, 0.0, np.where(q1 <= q0, 1.0, np.clip(np.nan_to_num(crossing), 0.0, 1.0)))
        value = np.maximum(p0 + place * (p1 - p0), q0 + place * (q1 - q0))
        at = first + place[:, None] * (last - first)
        top = at.argmax(axis=1)
        more = at[rows, top] > value + 1e-12
        if not more.any():
            break
        down = last[rows, top] < first[rows, top]
        falling = np.where(more & down, top, falling)
        rising = np.where(more & ~down, top, rising)
    return value, place
