"""Sample times, and what depends on them alone."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._lru import Lru
from ctrlplan.metrics._records import Array, times

LONG = 2**9  # samples, from which on integrals of smooth signals are sums over samples
STRETCH = 2**7  # samples of a stretch of a signal
_UNEVEN = 4.0  # ratio of adjacent intervals up to which few digits are lost in sums over samples
_KEPT = 2**16  # samples, up to which times are kept


class Windows(NamedTuple):
    """Samples of each stretch with three neighbours on either side, and factors of their differences.

    Shapes (nstretches, nsamples), and up to three columns less.
    """

    samples: NDArray[np.intp]
    pace: Array
    narrow: Array
    share: Array


class Ends(NamedTuple):
    """Four samples from either end inwards, shape (4, 2, 1), and factors of their differences.

    Bounds on the curvature of the cubics there are the second difference and `reach` times the third.
    """

    samples: NDArray[np.intp]
    step: Array
    width: Array
    span: Array
    reach: Array
    quarter: Array


class Forms(NamedTuple):
    """Integrals of a signal over inner intervals with smooth curvature, where its cubics are linear in four samples.

    `linear` has the factors of the integral and of the integral of the signal times the time since the first sample,
    shape (2, 4, m), `square` those of four terms, whose squares add up to the integral of the square. `weights`,
    shape (2, ntime), and the four bands `products` are the sums over all intervals.
    """

    linear: Array
    square: Array
    weights: Array
    products: list[Array]


class Grid:
    """Strictly increasing sample times (ntime,)."""

    def __init__(self, t: Array) -> None:
        self.t = t
        self.step, self.width, self.span = t[1:] - t[:-1], t[2:] - t[:-2], t[3:] - t[:-3]
        self.pace, self.narrow, self.spread = 1.0 / self.step, 1.0 / self.width, 1.0 / self.span
        self.quarter = self.step[1:-1] ** 2 / 4  # of the larger curvature: bound on the distance from the chord
        self.starts = np.arange(0, t.size, STRETCH)
        # Of four samples in a range of 1: both curvatures are at most 1 / (product of the adjacent steps).
        inner = self.step[1:-1] / (4 * np.minimum(self.step[:-2], self.step[2:]))
        self.farthest = float(inner.max(initial=0.0))

    @classmethod
    def of(cls, timepts: ArrayLike) -> "Grid":
        """Return checked sample times; those used last are kept."""
        t = times(timepts)
        return _RECENT.get(t.tobytes(), lambda: cls(t.copy())) if t.size <= _KEPT else cls(t)

    @cached_property
    def windows(self) -> Windows:
        """Return the windows about all stretches; at least four samples."""
        count = min(self.t.size, STRETCH + 6)
        inside = np.clip(self.starts - 3, 0, self.t.size - count)[:, None] + np.arange(count)
        factors = (self.pace, self.narrow, self.quarter)
        return Windows(inside, *(factor[inside[:, :-k]] for k, factor in enumerate(factors, 1)))

    @cached_property
    def ends(self) -> Ends:
        """Return the samples at both ends; at least four samples."""
        samples = np.array([[0, 1, 2, 3], [-1, -2, -3, -4]]).T[:, :, None]
        t = np.abs(self.t[samples] - self.t[samples[:1]])
        step = np.diff(t, axis=0)
        return Ends(samples, step, t[2:] - t[:-2], t[3], t[2] + t[1], step[0] ** 2 / 4)

    @cached_property
    def formed(self) -> NDArray[np.bool_]:
        """Return on which inner intervals there are `forms`: not in short records, or next to much longer ones."""
        step = self.step
        shortest = np.minimum(np.minimum(step[:-2], step[1:-1]), step[2:])
        longest = np.maximum(np.maximum(step[:-2], step[1:-1]), step[2:])
        return np.asarray((longest <= _UNEVEN * shortest) & (self.t.size >= LONG))

    @cached_property
    def forms(self) -> Forms:
        """Return the integrals over inner intervals as functions of the samples; 0 where they are not `formed`."""
        early, step, late = self.step[:-2], self.step[1:-1], self.step[2:]
        none, one, cube = np.zeros_like(step), np.ones_like(step), step**3
        # Factors of the samples k - 1 to k + 2, shape (4, m), for the interval from k to k + 1.
        left = np.array([1 / early, -1 / early - 1 / step, 1 / step, none]) / self.width[:-1]
        right = np.array([none, 1 / step, -1 / step - 1 / late, 1 / late]) / self.width[1:]
        third = (right - left) / self.span
        start, end = np.array([none, one, none, none]), np.array([none, none, one, none])
        area = step / 2 * (start + end) - cube / 6 * left - (2 * early + step) * cube / 12 * third
        middle = self.t[1:-2] + step / 2 - self.t[0]
        moment = middle * area + cube / 12 * (end - start) / step - cube * step**2 / 120 * third
        # Coefficients of Legendre series, times the roots of the integrals of the squares of their terms.
        d = third * cube
        bend = ((left + early * third) * step**2 + d / 2) / 6
        series = np.array([(start + end) / 2 - bend, end - start - d / 10, bend, d])
        roots = np.sqrt(step / np.array([1.0, 12.0, 5.0, 2800.0])[:, None])
        linear, square = np.where(self.formed, [area, moment], 0.0), np.where(self.formed, roots[:, None] * series, 0.0)
        weights, products = np.zeros((2, self.t.size)), [np.zeros(self.t.size - j) for j in range(4)]
        for i in range(4):
            weights[:, i : i + step.size] += linear[:, i]
            for j in range(4 - i):
                products[j][i : i + step.size] += (1 if j == 0 else 2) * (square[:, i] * square[:, i + j]).sum(axis=0)
        return Forms(linear, square, weights, products)


_RECENT: Lru[bytes, Grid] = Lru(4)
