"""Analytic segments of an input, and the cells into which they are divided."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ctrlplan._types import Array

TERMS = 18
"""Number of Taylor terms of the input in a cell."""

Jet = Callable[[float, float, Array, int], Array]
"""(moment, origin, s, order) -> derivatives (order + 1, ninputs, ntime) at origin + s
of the analytic functions that are valid at `moment`."""


@dataclass(frozen=True)
class AnalyticSegment:
    """Analytic segment of the input, and the samples in it.

    Attributes
    ----------
    jet : callable
        Jets of the input, (s, order) -> derivatives at times since the beginning [s].
    duration : float
        Its duration [s].
    samples : ndarray, shape (nsamples,)
        Sample times since the beginning [s].
    nterms : int
        Number of Taylor terms of the input in a cell.
    h : float
        Length of a cell [s].
    per : int
        Number of evenly spaced samples per cell, a power of two; 0 if they are uneven or too few.
    fewest : int
        Minimum of this number.
    """

    jet: Callable[[Array, int], Array]
    duration: float
    samples: Array
    nterms: int
    h: float
    per: int
    fewest: int

    @classmethod
    def of(cls, jet: Jet, left: float, right: float, samples: Array, fewest: int) -> AnalyticSegment:
        """Segment between two times, with the samples since the first."""
        own, duration = partial(jet, 0.5 * (left + right), left), right - left
        ncells, nterms = taylor_cells(own, duration)
        h, per = duration / ncells, _samples_per_cell(samples, duration, duration / ncells, fewest)
        if per:
            h = per * float(samples[-1] - samples[0]) / (samples.size - 1)
        return cls(own, duration, samples, nterms, h, per, fewest)

    @property
    def first(self) -> float:
        """Time of the first sample, in cells."""
        return float(self.samples[0]) / self.h

    @property
    def last(self) -> int:
        """Number of the cell in which the segment ends."""
        return int(self.duration // self.h)

    @property
    def rest(self) -> float | None:
        """Time in this cell up to the end of the segment, in cells; None if the last sample is there."""
        return None if self.samples[-1] == self.duration else self.duration / self.h - self.last

    def shorter(self) -> AnalyticSegment:
        """The same with cells of half the length; without even samples if they are too few in a cell."""
        if self.per // 2 >= self.fewest:
            return replace(self, h=0.5 * self.h, per=self.per // 2)
        ncells, _ = taylor_cells(self.jet, self.duration)
        return replace(self, h=self.duration / ncells, per=0)

    def series(self, ncells: int) -> Array:
        """Taylor terms (nterms, ninputs, ncells) at the starts of the cells, in units of a cell."""
        factor = self.h ** np.arange(self.nterms, dtype=float) / _FACTORIALS[: self.nterms]
        return self.jet(self.h * np.arange(ncells, dtype=float), self.nterms - 1) * factor[:, None, None]


def taylor_cells(jet: Callable[[Array, int], Array], duration: float) -> tuple[int, int]:
    """Number of cells in which the Taylor series of the input converges, and of its terms."""
    order = TERMS + 7
    size = np.abs(jet(np.linspace(0.0, duration, 9), order)).max(axis=2)  # (order + 1, ninputs)
    if not np.isfinite(size[:TERMS]).all():
        raise ValueError(
            f"derivatives of inputs up to order {TERMS - 1} must not overflow, got an overflow on a segment of "
            f"{duration:g} s; use other units for times or values"
        )
    ncells = 1
    while ncells < 4096:
        terms = size * ((duration / ncells) ** np.arange(order + 1) / _LONG_FACTORIALS)[:, None]
        # Terms larger than the input itself would cancel with loss of digits.
        if np.all(terms[TERMS:] <= 1e-17 * terms.max(axis=0)) and np.all(terms.sum(axis=0) <= 8.0 * terms[0]):
            break
        ncells *= 2
    return ncells, min(TERMS, int(np.flatnonzero(size.any(axis=1)).max(initial=0)) + 1)


def _samples_per_cell(samples: Array, duration: float, longest: float, fewest: int) -> int:
    """Number of evenly spaced samples per cell, a power of two; 0 if they are uneven or too few."""
    step = spacing(samples, duration) if samples.size >= 32 else 0.0
    if not step or max(samples[0], duration - samples[-1]) > 1.001 * step:  # a whole step, up to rounding
        return 0
    # Above the square root of the number of samples the table is more expensive than the propagation.
    maximum = min(longest / step - 1.0, 2.0 * samples.size**0.5)
    return 2 ** int(np.log2(maximum)) if maximum >= fewest else 0


def spacing(samples: Array, duration: float) -> float:
    """Spacing of evenly spaced samples, up to rounding of times in the segment; 0 if they are uneven."""
    if samples.size < 2:
        return 0.0
    step = float(samples[-1] - samples[0]) / (samples.size - 1)
    deviation = np.abs(samples - (samples[0] + step * np.arange(samples.size)))
    return step if deviation.max() <= 4.0 * np.finfo(float).eps * duration else 0.0


_FACTORIALS = np.cumprod(np.concatenate([[1.0], np.arange(1.0, TERMS)]))
_LONG_FACTORIALS = np.cumprod(np.concatenate([[1.0], np.arange(1.0, TERMS + 8)]))
