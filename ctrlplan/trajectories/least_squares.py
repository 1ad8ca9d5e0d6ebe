"""Least-squares splines through samples, for many choices of their knots."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from ctrlplan.trajectories.common import Array

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_CORRECTIONS = 4
"""Maximum number of corrections of a solution of the normal equations; one or two are usual."""

_EPS = float(np.finfo(float).eps)

_TOGETHER = 2**15
"""Number of samples whose products are in memory at a time."""

_NEARLY = 0.9
"""Part of the intervals with samples apart from any polynomial from which on all are divided at first."""


class LeastSquares:
    """Samples of all axes, through which splines with knots at some of the sample times are fitted.

    Parameters
    ----------
    times : ndarray, shape (nsamples,)
        Sample times, increasing.
    rows : ndarray, shape (naxes, nsamples)
        Samples.
    degree : int
        Degree of the splines, odd.

    Attributes
    ----------
    places : ndarray of int
        Samples at which there may be knots, all of which the interpolating spline has
        (the condition not-a-knot): others near an end would make the equations ill-conditioned.
    """

    def __init__(self, times: Array, rows: Array, degree: int) -> None:
        self.times, self.rows, self.degree = times, rows, degree
        self._precise = False
        half, last = (degree + 1) // 2, times.size - 1
        self.places = np.concatenate([[0], np.arange(half, times.size - half), [last]])
        # Products of a B-spline, its number in an interval, and one after it or a row of samples.
        orders, count = range(degree + 1), degree + 1 + len(rows)
        pairs = [(a, d) for a in orders for d in (*range(degree + 1 - a), *range(degree + 1, count))]
        self.first, self.second = np.array(pairs).T[:, :, None]
        self.starts = np.cumsum([0, *[count - a for a in orders]]).tolist()

    def knots(self, chosen: NDArray[np.intp]) -> Array:
        """Knots at the chosen samples, those at both ends repeated."""
        ends = [0] * self.degree, [self.times.size - 1] * self.degree
        return self.times[np.concatenate([ends[0], chosen, ends[1]])]

    def solve(self, chosen: NDArray[np.intp]) -> Solution:
        """Spline with knots at the chosen samples.

        By the normal equations, whose solution has half of the digits before its
        correction; by scipy's QR decomposition, which takes up to fifty times as long,
        for times that are spaced too unevenly for them.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the samples do not determine the spline.
        """
        if not self._precise:
            try:
                return Solution(self, chosen)
            except np.linalg.LinAlgError:
                self._precise = True
        return QRSolution(self, chosen)

    def corrected(self, solution: Solution) -> Solution:
        """The same spline with all digits."""
        if solution.correct():
            return solution
        self._precise = True
        return QRSolution(self, solution.chosen)

    def first_knots(self, limits: Array) -> NDArray[np.intp]:
        """Places at even intervals that are still too long for limits (naxes,), nearly certainly.

        The divided difference of degree + 2 samples of a polynomial is 0, and that of
        independent errors is about as large as the root of the sum of its weights'
        squares. Where it exceeds that of errors as large as the limits, and the next one
        has the other sign, as smooth signals have not, a sample is apart. If nearly all
        intervals have one, all are divided in two, as the first solutions
        would do, one step each.
        """
        count, last = 1, self.places.size - 1
        chosen = even = np.array([0, last])
        size, number = self.degree + 2, self.times.size - self.degree - 1
        if number < 2:
            return chosen
        apart = np.zeros(number - 1, dtype=np.bool_)
        with np.errstate(all="ignore"):
            moments = (self.times - self.times[0]) * ((self.times.size - 1) / (self.times[-1] - self.times[0]))
            windows = [slice(j, j + number) for j in range(size)]
            weights = np.ones((size, number))
            for j in range(size):
                for i in range(j):
                    gap = moments[windows[j]] - moments[windows[i]]
                    weights[j] *= gap
                    weights[i] *= -gap
            weights = 1.0 / weights
            scale = np.sqrt((weights**2).sum(axis=0))
            for row, limit in zip(self.rows, limits.tolist(), strict=True):
                difference = sum([weight * row[window] for weight, window in zip(weights, windows, strict=True)])
                difference = difference / scale
                apart |= (np.abs(difference[1:]) > limit) & (difference[1:] * difference[:-1] < 0.0)
        before = np.zeros(self.places.size, dtype=np.intp)
        np.cumsum(apart, out=before[-apart.size :])
        while np.count_nonzero(before[even[1:]] > before[even[:-1]]) >= _NEARLY * count:
            chosen, count = even, 2 * count
            even = np.arange(count + 1) * last // count
        return chosen


class Solution:
    """Least-squares spline by the normal equations.

    Attributes
    ----------
    chosen : ndarray of int
        Samples at its knots.
    coefficients : ndarray, shape (naxes, ncoefficients)
        Of its B-splines.
    deviations : ndarray, shape (naxes, nsamples)
        Samples minus values.
    is_correct : bool
        Whether it has all digits.
    """

    is_correct = False

    def __init__(self, problem: LeastSquares, chosen: NDArray[np.intp]) -> None:
        self.chosen, self._problem = chosen, problem
        degree, rows = problem.degree, problem.rows
        count = chosen.size - 1
        lengths = chosen[1:] - chosen[:-1]
        lengths[-1] += 1
        self._intervals = np.repeat(np.arange(count), lengths)
        self._knots = problem.knots(chosen)
        self._values = _basis(problem.times, self._knots, self._intervals, degree)
        self._size = size = count + degree
        values = self._values
        total = np.zeros((degree + 1 + len(rows)) * size)
        # Row d of the matrix is its diagonal d below the main one, as in LAPACK; the right sides follow.
        place, starts = problem.second * size + problem.first, problem.starts
        for part in self._parts:
            own, index = values[:, part], place + self._intervals[part]
            others, products = np.concatenate([own, rows[:, part]]), np.empty(index.shape)
            for a, value in enumerate(own):
                np.multiply(value, others[a:], out=products[starts[a] : starts[a + 1]])
            total += np.bincount(index.ravel(), products.ravel(), total.size)
        bands, sides = np.split(total.reshape(-1, size), [degree + 1])
        self._factor, info = lapack.dpbtrf(bands, lower=1)
        if info:
            raise np.linalg.LinAlgError("the normal equations are singular")
        self.coefficients = self._solved(sides)
        self.deviations = self._deviations()

    @property
    def _parts(self) -> list[slice]:
        return [slice(k, k + _TOGETHER) for k in range(0, self._problem.times.size, _TOGETHER)]

    def _solved(self, sides: Array) -> Array:
        found, _ = lapack.dpbtrs(self._factor, sides.T, lower=1)
        return np.ascontiguousarray(found.T)

    def _deviations(self) -> Array:
        found = self._problem.rows.copy()
        for a, values in enumerate(self._values):
            found -= values * self.coefficients.take(self._intervals + a, axis=1)
        return found

    def correct(self) -> bool:
        """Correct it by its deviations, whose own spline is 0; whether it has all digits then.

        The errors decrease by one factor with each correction, the ratio of the last two.
        """
        size = before = np.abs(self.coefficients).max(axis=1)
        for _ in range(_CORRECTIONS):
            sides = [
                sum(np.bincount(self._intervals + a, values * row, self._size) for a, values in enumerate(self._values))
                for row in self.deviations
            ]
            change = self._solved(np.array(sides))
            self.coefficients += change
            self.deviations = self._deviations()
            after = np.abs(change).max(axis=1)
            if (after <= _EPS**0.5 * np.sqrt(size) * np.sqrt(before)).all():  # products may underflow
                self.is_correct = True
                return True
            before = after
        return False

    def spline(self) -> BSpline:
        """The spline of scipy."""
        from scipy.interpolate import BSpline

        return BSpline(self._knots, self.coefficients.T, self._problem.degree)


class QRSolution(Solution):
    """The same by the QR decomposition of scipy."""

    is_correct = True

    def __init__(self, problem: LeastSquares, chosen: NDArray[np.intp]) -> None:
        from scipy.interpolate import make_lsq_spline

        self.chosen = chosen
        knots = problem.knots(chosen)
        try:
            self._spline = make_lsq_spline(problem.times, problem.rows.T, knots, k=problem.degree)
        except ValueError as error:  # scipy 1.14, which solves normal equations here, of an overflow
            raise np.linalg.LinAlgError(str(error)) from error
        with np.errstate(over="ignore", invalid="ignore"):
            self.deviations = problem.rows - self._spline(problem.times).T

    def correct(self) -> bool:
        """Nothing is left to be corrected."""
        return True

    def spline(self) -> BSpline:
        """The spline of scipy."""
        return self._spline


def divided(chosen: NDArray[np.intp], parts: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers of the samples at knots, with each interval divided into parts, but not between samples."""
    lengths = chosen[1:] - chosen[:-1]
    parts = np.minimum(parts, lengths)
    count = int(parts.sum())
    own = np.repeat(np.arange(parts.size), parts)
    number = np.arange(count) - (np.cumsum(parts) - parts)[own]
    inner = chosen[own] + number * lengths[own] // parts[own]
    return np.append(inner, chosen[-1])


def _basis(times: Array, knots: Array, intervals: NDArray[np.intp], degree: int) -> Array:
    """Values (degree + 1, nsamples) of the B-splines that are not 0 in the interval of each sample.

    By the recursion of Cox and de Boor, of all samples together.
    """
    found = np.empty((degree + 1, times.size))
    found[0] = 1.0
    steps = np.arange(degree)[:, None]
    after = knots.take(intervals + (degree + 1 + steps))
    after -= times
    before = times - knots.take(intervals + (degree - steps))
    for d in range(1, degree + 1):
        high, low = after[:d], before[d - 1 :: -1]
        share = found[:d] / (high + low)
        np.multiply(high, share, out=found[:d])
        found[d] = 0.0
        found[1 : d + 1] += low * share
    return found
