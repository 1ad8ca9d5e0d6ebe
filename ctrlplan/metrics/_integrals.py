"""Integrals of magnitudes and of squares of signals: sums over samples, and cubics where the curvature is rough."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ctrlplan.metrics._grid import LONG, Grid
from ctrlplan.metrics._pieces import CURVATURES, Pieces, cubics, limited
from ctrlplan.metrics._records import Array

Places = tuple[NDArray[np.intp], NDArray[np.intp]]

_BLOCK = 2**14  # samples that fit into the cache


def rough(grid: Grid, f: Array, finite: NDArray[np.bool_], signed: bool) -> Places:
    """Return rows and intervals of signals (nrows, ntime), those that are finite, whose integrals are no sums.

    That is where the curvature is not smooth and, if `signed`, also where a cubic may have both signs.
    """
    ntime = grid.t.size
    others = np.ones((len(f), ntime - 1), dtype=np.bool_)
    for some in row_blocks(f) if ntime >= LONG else ():
        others[some, 1:-1] = ~_smooth(grid, f[some], signed)
    if not finite.all():
        others[~finite] = False
    return np.divmod(np.flatnonzero(others), ntime - 1)


def _smooth(grid: Grid, f: Array, signed: bool) -> NDArray[np.bool_]:
    """Return on which inner intervals the curvature is smooth and, if wanted, all four samples have the sign there."""
    slope = f[:, 1:] - f[:, :-1]
    slope *= grid.pace
    d = slope[:, 1:] - slope[:, :-1]
    d *= grid.narrow
    change = np.subtract(d[:, 1:], d[:, :-1], out=slope[:, :-2])
    np.abs(d, out=d)
    smaller = np.minimum(d[:, :-1], d[:, 1:])
    size = np.abs(change, out=d[:, 1:])
    # Both curvatures are reach * step**2 or less.
    reach = smaller + size if signed else None
    smaller *= CURVATURES
    smooth = (size <= smaller) & grid.formed
    rest = np.flatnonzero(~smooth & grid.formed)
    smooth.ravel()[rest] = _uncut(grid, slope, *np.divmod(rest, smooth.shape[1]))
    if reach is not None:
        reach *= grid.quarter
        size, negative = np.abs(f), f < 0
        smooth &= reach <= np.minimum(size[:, 1:-2], size[:, 2:-1], out=smaller)
        turns = negative[:, 1:] != negative[:, :-1]
        smooth &= ~(turns[:, :-2] | turns[:, 1:-1] | turns[:, 2:])
    return np.asarray(smooth)


def _uncut(grid: Grid, change: Array, rows: NDArray[np.intp], i: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return whether the cubics of some inner intervals, as about an inflection point, are those of a smooth curvature.

    Their third differences need no limit. `change` (nrows, m + 2) are the differences of the curvatures, then others.
    """
    near = np.arange(-1, 2)[:, None] + i
    before, third, after = change.take(near + rows * change.shape[1], mode="clip") * grid.spread.take(near, mode="clip")
    return (limited(third, before, after) == third) & (i > 0) & (i < grid.spread.size - 1)


def areas(grid: Grid, f: Array, places: Places, p: Pieces) -> Array:
    """Return the integrals of magnitudes, and of these times the time since the first sample, (2, nrows).

    `places` are the rows and intervals of the `rough` cubics p.
    """
    rows, k = places
    area, moment = p.areas() * p.step
    found = np.array([area, (p.begin - grid.t[0]) * area + p.step * moment])
    sums = np.zeros((2, len(f)))
    if grid.formed.any():
        inner, samples = _inner(grid, f, places)
        found[:, inner] -= (grid.forms.linear.take(k[inner] - 1, axis=2) * np.abs(samples)).sum(axis=1)
        for i, row in enumerate(f):
            sums[:, i] = grid.forms.weights @ np.abs(row)
    return sums + [np.bincount(rows, each, len(f)) for each in found]


def squares(grid: Grid, f: Array, places: Places, p: Pieces) -> Array:
    """Return the integrals of squares, (nrows,); `places` are the rows and intervals of the `rough` cubics p."""
    rows, k = places
    found, sums = p.squares(), np.zeros(len(f))
    if grid.formed.any():
        inner, samples = _inner(grid, f, places)
        terms = (grid.forms.square.take(k[inner] - 1, axis=2) * samples).sum(axis=1)
        found[inner] -= (terms * terms).sum(axis=0)
        for i, row in enumerate(f):  # a row has the same sum with others in the same call
            sums[i] = sum(band @ (row[: band.size] * row[row.size - band.size :]) for band in grid.forms.products)
    sums += np.bincount(rows, found, len(f))
    for large in np.flatnonzero(~np.isfinite(sums)):  # terms may overflow where the squares of the signal do not
        sums[large] = cubics(grid.t, f[large]).squares().sum()
    return sums


def _inner(grid: Grid, f: Array, places: Places) -> tuple[NDArray[np.intp], Array]:
    """Return which of some intervals are inner ones, and the four samples about each of these, (4, n)."""
    rows, k = places
    inner = np.flatnonzero((k > 0) & (k < grid.t.size - 2))
    return inner, f[rows[inner], k[inner] + np.arange(-1, 3)[:, None]]


def row_blocks(f: Array) -> Iterator[slice]:
    """Yield rows (nrows, ntime) in blocks that fit into the cache."""
    count = max(1, _BLOCK // f.shape[1])
    return (slice(begin, begin + count) for begin in range(0, len(f), count))
