"""Extrema and integrals of signals given by Chebyshev series in cells of time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.trajectories.chebyshev import real_roots

_POINTS = 33
"""Number of points of a cell at which values are compared before roots are computed."""

_TOLERANCE = 1e-13
"""Distance from an extremum, relative to the range of a signal, below which cells are not searched."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Signals as Chebyshev series, cell by cell.

    Attributes
    ----------
    starts, lengths : ndarray, shape (ncells,)
        Starts and lengths [s].
    series : ndarray, shape (nterms, nrows, ncells)
        Coefficients.
    low, high : ndarray, shape (ncells,)
        Part of the cell that belongs to the signals, in -1 to 1.
    """

    starts: Array
    lengths: Array
    series: Array
    low: Array
    high: Array

    def during(self, first: float, last: float) -> Cells:
        """Cells restricted to an interval of time."""
        low = np.maximum(self.low, 2.0 * (first - self.starts) / self.lengths - 1.0)
        high = np.minimum(self.high, 2.0 * (last - self.starts) / self.lengths - 1.0)
        used = low <= high
        return Cells(self.starts[used], self.lengths[used], self.series[..., used], low[used], high[used])

    def values(self, x: Array) -> Array:
        """Values (nrows, ncells) at one point x (ncells,) of each cell."""
        if x.size and np.all(x == x[0]):
            basis = np.cos(np.arange(len(self.series)) * np.arccos(min(1.0, max(-1.0, float(x[0])))))
            return np.asarray(np.tensordot(basis, self.series, axes=1))
        basis = np.cos(np.arange(len(self.series))[:, None] * np.arccos(np.clip(x, -1.0, 1.0)))
        return np.asarray(np.einsum("jrk,jk->rk", self.series, basis))

    def at(self, times: Array) -> Array:
        """Values (nrows, ntime) at times [s] within the cells."""
        by = np.argsort(self.starts, kind="stable")
        own = by[np.maximum(np.searchsorted(self.starts[by], times, side="right") - 1, 0)]
        found = Cells(self.starts[own], self.lengths[own], self.series[..., own], self.low[own], self.high[own])
        return found.values(2.0 * (times - found.starts) / found.lengths - 1.0)

    def without_line(self, start: float, slope: float) -> Cells:
        """Signals minus start + slope t."""
        series = self.series.copy()
        series[0] -= start + slope * (self.starts + 0.5 * self.lengths)
        series[1] -= 0.5 * slope * self.lengths
        return replace(self, series=series)

    def times(self, x: Array) -> Array:
        """Times [s] of points x (ncells,)."""
        return np.asarray(self.starts + 0.5 * (1.0 + x) * self.lengths)


def joined(parts: list[Cells]) -> Cells:
    """Cells of several parts together."""
    return Cells(
        *(np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in Cells.__dataclass_fields__)
    )


def extrema_of_cells(cells: Cells, values: Array, times: Array) -> tuple[Array, Array, Array, Array]:
    """Minima and maxima of signals over cells and at further candidates.

    Parameters
    ----------
    cells : Cells
        Signals.
    values : ndarray, shape (nrows, ncandidates)
        Further values.
    times : ndarray, shape (ncandidates,)
        Their times [s].

    Returns
    -------
    tuple of ndarray, shape (nrows,)
        Minima, maxima, and the times of both.
    """
    ends = [cells.values(x) for x in (cells.low, cells.high)]
    every = np.concatenate([*ends, values], axis=1)
    moments = np.concatenate([cells.times(cells.low), cells.times(cells.high), times])
    floor = _TOLERANCE * np.ptp(every, axis=1) + 4e-16 * np.abs(every).max(axis=1, initial=0.0)
    spread = np.abs(cells.series[1:]).sum(axis=0)
    found = []
    for sign in (-1.0, 1.0):
        best = (sign * every).argmax(axis=1)
        peaks, places = (sign * every)[np.arange(len(every)), best], moments[best]
        rows, columns = np.nonzero(sign * cells.series[0] + spread > (peaks + floor)[:, None])
        series = sign * cells.series[:, rows, columns]
        orders = np.arange(len(series))
        bound = (_DENSE[:, : len(series)] @ series).max(axis=0, initial=-np.inf) + _BEND * (orders**2 @ np.abs(series))
        for k in np.argsort(-bound).tolist():
            row, cell = rows[k], columns[k]
            if bound[k] <= peaks[row] + floor[row]:
                continue
            x, value = _maximum(series[:, k], float(cells.low[cell]), float(cells.high[cell]))
            if value > peaks[row] + floor[row]:
                peaks[row] = value
                places[row] = cells.starts[cell] + 0.5 * (1.0 + x) * cells.lengths[cell]
        found.append((sign * peaks, places))
    (low, time_low), (high, time_high) = found
    return low, high, time_low, time_high


def _maximum(series: Array, low: float, high: float) -> tuple[float, float]:
    """Largest stationary value of a series in an interval, and its place; -inf without a stationary point."""
    roots = real_roots(np.asarray(chebyshev.chebder(series), dtype=float))
    inside = roots[(roots >= low) & (roots <= high)]
    if not inside.size:
        return low, -np.inf
    values = chebyshev.chebval(inside, series)
    k = int(values.argmax())
    return float(inside[k]), float(values[k])


def mean_square(cells: Cells, row: int) -> float:
    """Integral of the square of a signal over its cells."""
    points, weights = _GAUSS
    middle, half = 0.5 * (cells.low + cells.high), 0.5 * (cells.high - cells.low)
    x = np.clip(middle + half * points[:, None], -1.0, 1.0)
    angles = np.arccos(x)
    series = cells.series[:, row]
    values = np.zeros_like(x)
    for j, terms in enumerate(series):
        values += terms * np.cos(j * angles)
    return float(np.sum(weights @ values**2 * half * 0.5 * cells.lengths))


def envelope(cells: Cells, parts: int) -> Array:
    """Bounds (parts, nrows, ncells) of magnitudes in equal angles of each cell, from its end to its start."""
    angles = np.pi * np.arange(parts + 1) / parts
    basis = np.cos(angles[:, None] * np.arange(len(cells.series)))
    values = np.abs(np.tensordot(basis, cells.series, axes=1))
    bend = np.tensordot(np.arange(len(cells.series)) ** 2.0, np.abs(cells.series), axes=1) * (np.pi / parts) ** 2 / 8.0
    return np.asarray(np.maximum(values[1:], values[:-1]) + bend)


_DENSE = np.cos(np.pi * np.arange(_POINTS)[:, None] / (_POINTS - 1) * np.arange(64))
"""Chebyshev polynomials at points evenly spaced in angle."""
_BEND = (np.pi / (_POINTS - 1)) ** 2 / 8.0
"""Difference of a function of the angle from the larger of two neighbouring values, over its second derivative."""
_GAUSS: tuple[NDArray[np.float64], NDArray[np.float64]] = leggauss(24)
