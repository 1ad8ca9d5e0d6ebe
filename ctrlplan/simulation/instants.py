"""Sample times of the discrete blocks of a loop, exact as fractions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.segments import as_fraction

_EXACT = 2**53
"""Whole numbers below which are exact as floats."""


@dataclass(frozen=True, eq=False)
class Instants:
    """Times at which discrete blocks are sampled.

    Attributes
    ----------
    times : ndarray, shape (n,)
        Increasing times [s]; the first is the start of the run.
    due : ndarray of int, shape (n,)
        Bits of the timings that are due at each of them.
    lengths : ndarray, shape (nlengths,)
        Different distances of two neighbours [s].
    which : ndarray of int, shape (n - 1,)
        Index of the distance after each time but the last.
    """

    times: Array
    due: NDArray[np.int64]
    lengths: Array
    which: NDArray[np.intp]

    def divided(self, parts: int) -> Instants:
        """The same, with each distance divided into equal parts by further times at which nothing is due."""
        steps = np.arange(parts) / parts
        inner = self.times[:-1, None] + self.lengths[self.which][:, None] * steps
        inner[:, 0] = self.times[:-1]
        due = np.zeros(inner.shape, dtype=np.int64)
        due[:, 0] = self.due[:-1]
        return Instants(
            np.append(inner.ravel(), self.times[-1]),
            np.append(due.ravel(), self.due[-1]),
            self.lengths / parts,
            np.repeat(self.which, parts),
        )


def instants_of(timings: Sequence[tuple[Fraction, Fraction]], first: float, last: float, tolerance: float) -> Instants:
    """Instants of a run; one for times that differ by less than a tolerance [s].

    Parameters
    ----------
    timings : sequence of (Fraction, Fraction)
        Periods and offsets [s], at most 62 of them.
    first, last : float
        Start and end of the run [s].
    tolerance : float
        Difference of times that counts as rounding [s].
    """
    start, end = as_fraction(first), Fraction(last) + Fraction(tolerance)
    den = math.lcm(start.denominator, *(value.denominator for timing in timings for value in timing))
    origin = int(start * den)
    small = max(den, abs(origin) + int((end - start) * den)) < _EXACT
    ticks, bits = [np.zeros(1, dtype=np.int64 if small else object)], [np.zeros(1, dtype=np.int64)]
    for bit, (period, offset) in enumerate(timings):
        count = math.floor((end - start - offset) / period) + 1
        if count <= 0:
            continue
        steps: NDArray[np.generic] = np.arange(count) if small else np.arange(count, dtype=object)
        ticks.append(int(offset * den) + int(period * den) * steps)
        bits.append(np.full(count, 1 << bit))
    every = np.concatenate(ticks)
    which = np.argsort(every, kind="stable")
    every, bit_of = every[which], np.concatenate(bits)[which]
    times = np.array((origin + every) / den, dtype=float)
    new = np.append(True, np.diff(times) > tolerance)
    places = np.flatnonzero(new)
    due = np.bitwise_or.reduceat(bit_of, places)
    lengths, number = np.unique(np.diff(every[places]), return_inverse=True)
    return Instants(times[places], due, np.array(lengths / den, dtype=float), number.astype(np.intp))
