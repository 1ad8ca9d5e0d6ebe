"""Signals with a part that is held between known times, such as the outputs of discrete controllers.

Such a signal jumps at these times and is smooth in between. Its cubics are those of the rest, each divided at the
times of jumps inside of its interval: metrics of a held signal are exact, whatever the sample times.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctrlplan.metrics._pieces import Pieces, cubics
from ctrlplan.metrics._records import HUGE, QUIET, Array

_ROUNDING = 4 * np.finfo(np.float64).eps  # of a signal: a rest that changes by less is constant


class Held(NamedTuple):
    """Part of a signal that is constant from each of some times to the next.

    Attributes
    ----------
    times : ndarray, shape (n,)
        Strictly increasing times [s], the first not after the first sample.
    values : ndarray, shape (n,)
        Value from each of these times on, up to and without the next one.
    """

    times: Array
    values: Array

    def at(self, t: Array) -> Array:
        """Return the values at times, shape (ntime,)."""
        return self.values.take(np.maximum(np.searchsorted(self.times, t, side="right") - 1, 0))

    def jumps(self, f: Array) -> bool:
        """Return whether it has jumps that are more than rounding errors of a finite signal that contains it."""
        return bool(_ROUNDING * np.abs(f).max() < np.ptp(self.values) < HUGE > np.abs(f).max())

    def negative(self) -> "Held":
        """Return the same part with the other sign."""
        return Held(self.times, -self.values)

    def changes(self, first: float, last: float) -> Array:
        """Return the times after `first` and before `last` at which the value changes."""
        times = self.times[1:][self.values[1:] != self.values[:-1]]
        return times[(times > first) & (times < last)]


@dataclass(frozen=True)
class Stepped:
    """Signal with a held part: cubics between samples and jumps.

    Attributes
    ----------
    pieces : Pieces
        Cubics without jumps inside; the last one is the last sample, with the length 0.
    latest : float
        Last sample time but one [s].
    """

    pieces: Pieces
    latest: float

    @classmethod
    def of(cls, t: Array, f: Array, held: Held) -> "Stepped":
        """Return a finite signal (ntime,) with its cubics."""
        with np.errstate(**QUIET):
            steps = held.at(t)
            largest = float(max(np.abs(f).max(), np.abs(steps).max()))
            return cls(_divided(*_rest(t, f - steps, _ROUNDING * largest), held), float(t[-2]))

    def entry(self, edge: float) -> float:
        """Return the time from which on the magnitude is at most an edge; -inf if always, inf if unknown."""
        p = self.pieces
        beyond = np.abs(p.values) > edge
        if np.isnan(edge) or beyond[:, -1].any():
            return np.inf
        if not beyond.any():
            return -np.inf
        last = int(np.flatnonzero(beyond.any(axis=0))[-1])
        cut = int(np.flatnonzero(beyond[:, last])[-1])
        if cut == 3:  # it jumps into the band
            return float(p.begin[last + 1]) if last + 2 < p.begin.size else np.inf
        here, level = p[np.array([last])], np.copysign(edge, p.values[cut, last : last + 1])
        entered = here.time(here.crossing(level, here.cuts[cut], here.cuts[cut + 1]))
        return float(entered[0]) if here.begin[0] < self.latest else np.inf

    def maximum(self, side: float, extrapolated: bool) -> float:
        """Return the maximum of the signal times the side, 1 or -1, or of its magnitude for the side 0.

        Extrema in pieces that begin count if they are `extrapolated`.
        """
        values = np.abs(self.pieces.values) if side == 0.0 else side * self.pieces.values
        inner = values[1:3] if extrapolated else values[1:3, ~self.pieces.begins]
        return float(np.fmax.reduce(np.concatenate([values[0], values[-1], inner.ravel()])))

    def areas(self) -> Array:
        """Return the integrals of the magnitude, and of this times the time since the first sample, (2,)."""
        p = self.pieces
        area, moment = p.areas() * p.step
        return np.array([area.sum(), ((p.begin - p.begin[0]) * area + p.step * moment).sum()])

    def square(self) -> float:
        """Return the integral of the square."""
        return float(self.pieces.squares().sum())

    def variation(self) -> float:
        """Return the total variation, with the heights of the jumps."""
        p = self.pieces
        return float(np.abs(np.diff(p.values, axis=0)).sum() + np.abs(p.a[1:] - p.end[:-1]).sum())


def _rest(t: Array, f: Array, rounding: float) -> tuple[Array, Array]:
    """Return times and samples of the rest of a signal; two of them if it is constant but for rounding errors."""
    if not np.ptp(f) <= rounding:
        return t, f
    return t[[0, -1]], np.full(2, f[0] if abs(f[0]) > rounding else 0.0)


def _divided(t: Array, f: Array, held: Held) -> Pieces:
    """Return the cubics of a signal plus its held part; a jump of the signal is in the middle of its interval."""
    whole = cubics(t, f)
    middle = whole.time(0.5)
    marks = (t, held.changes(t[0], t[-1]), middle[whole.jump])
    edges = np.unique(np.concatenate(marks))
    own = np.searchsorted(t, edges[:-1], side="right") - 1
    p, steps = whole[own], held.at(edges)
    start = (edges[:-1] - p.begin) / p.step
    stop = np.where(edges[1:] == t[own + 1], 1.0, (edges[1:] - p.begin) / p.step)
    length = stop - start
    a, b, c, d = p(start), length * p.slope(start), length**2 * (p.c + 3 * start * p.d), length**3 * p.d
    end = np.where(stop == 1.0, p.end, p(stop))
    if whole.jump.any():
        side = np.where(edges[:-1] >= middle[own], p.end, p.a)
        a, end = np.where(p.jump, side, a), np.where(p.jump, side, end)
        b, c, d = (np.where(p.jump, 0.0, term) for term in (b, c, d))
    none, no = np.zeros(1), np.zeros(own.size + 1, dtype=np.bool_)
    a, end = np.append(a, f[-1]) + steps, np.append(end + steps[:-1], f[-1] + steps[-1])
    step, b, c, d = (np.concatenate([term, none]) for term in (np.diff(edges), b, c, d))
    return Pieces(edges, step, a, b, c, d, end, no, np.append(p.begins, False))
