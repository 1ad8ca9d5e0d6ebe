"""Search for the intervals in which signals may exceed levels; peaks and entries into a band from their cubics."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctrlplan.metrics._grid import STRETCH, Grid
from ctrlplan.metrics._pieces import Pieces
from ctrlplan.metrics._records import Array

Places = tuple[NDArray[np.intp], NDArray[np.intp]]

_WINDOWS = 2**7  # stretches that are searched together


class Sought(NamedTuple):
    """What is sought: where signals times their sides, 1 or -1, or magnitudes for the side 0, exceed levels.

    Numbers of the signals, sides, levels (nan if nothing is sought) and first intervals, each of shape (n,).
    """

    rows: NDArray[np.intp]
    sides: Array
    levels: Array
    first: NDArray[np.intp]


def bounds(grid: Grid, f: Array) -> Array:
    """Return the maxima by stretch of signals (nrows, ntime) and of their negatives, (2, nrows, nstretches)."""
    high, low = (of.reduceat(f, grid.starts, axis=1) for of in (np.maximum, np.minimum))
    return np.array([high, -low])


def search(grid: Grid, f: Array, limits: Array, sought: Sought) -> Places:
    """Return the intervals in which cubics may exceed a level, as numbers of `sought` and of intervals, in order.

    Parameters
    ----------
    grid, f : Grid and ndarray, shape (nrows, ntime)
        Sample times and signals.
    limits : ndarray, shape (2, nrows, nstretches)
        The `bounds` of the signals.
    sought : Sought
        Levels of some of the signals.
    """
    ntime, usable = grid.t.size, ~np.isnan(sought.levels)
    at_ends = _at_ends(grid, f, sought) if ntime > 3 else np.ones((2, usable.size), dtype=np.bool_)
    at_ends[0] |= sought.first > 0
    early, late = (np.flatnonzero(usable & one) for one in at_ends)
    found = [early * ntime + sought.first[early], late * ntime + (ntime - 2)]
    if ntime > 3:
        # Stretches of smaller samples are far below the level, also between samples; nan cannot be excluded.
        large = ~(_reach(grid, limits)[:, sought.rows] <= sought.levels[:, None])
        large &= grid.starts + STRETCH >= sought.first[:, None]
        large &= (np.array([sought.sides >= 0, sought.sides <= 0]) & usable)[:, :, None]
        places, stretch = np.divmod(np.flatnonzero(large), large.shape[2])
        below, number = np.divmod(places, max(1, large.shape[1]))
        for begin in range(0, stretch.size, _WINDOWS):
            own = slice(begin, begin + _WINDOWS)
            found.append(_inside(grid, f, sought, 1.0 - 2.0 * below[own], number[own], stretch[own]))
    return np.divmod(np.sort(np.concatenate(found)), ntime)


def may_reach(grid: Grid, f: Array, level: float) -> bool:
    """Return whether the cubics of one signal (ntime,) may reach a level."""
    row = f[None]
    below = np.nextafter(level, -np.inf)
    sought = Sought(np.zeros(1, dtype=np.intp), np.ones(1), np.full(1, below), np.zeros(1, dtype=np.intp))
    return bool(search(grid, row, bounds(grid, row), sought)[0].size)


def _at_ends(grid: Grid, f: Array, sought: Sought) -> NDArray[np.bool_]:
    """Return in which first and last intervals, (2, n), cubics may exceed a level; at least four samples."""
    near = grid.ends
    samples = f[sought.rows, near.samples]
    d = np.diff(np.diff(samples, axis=0) / near.step, axis=0) / near.width
    bow = np.abs(d[0]) + near.reach * np.abs((d[1] - d[0]) / near.span)
    outer = samples[:2]
    top = np.where(sought.sides == 0.0, np.abs(outer), sought.sides * outer).max(axis=0)
    return np.asarray(~(top + near.quarter * bow <= sought.levels))


def _reach(grid: Grid, limits: Array) -> Array:
    """Return bounds of signals and of their negatives by stretch, also between samples."""
    # The cubics of a stretch depend on samples of its neighbours.
    wide = limits.copy()
    np.maximum(wide[..., 1:], limits[..., :-1], out=wide[..., 1:])
    np.maximum(wide[..., :-1], limits[..., 1:], out=wide[..., :-1])
    return np.asarray(wide + (grid.farthest * (wide[0] + wide[1]) + 1e-9 * np.maximum(wide[0], wide[1])))


def _inside(
    grid: Grid, f: Array, sought: Sought, sign: Array, number: NDArray[np.intp], stretch: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return the same inner intervals of some stretches of signals times signs, as number * ntime + interval."""
    ntime, windows = grid.t.size, grid.windows
    at = windows.samples.take(stretch, axis=0)
    samples = f.take(at + (sought.rows[number] * ntime)[:, None])
    samples *= sign[:, None]
    slope = samples[:, 1:] - samples[:, :-1]
    slope *= windows.pace.take(stretch, axis=0)
    d = slope[:, 1:] - slope[:, :-1]
    d *= windows.narrow.take(stretch, axis=0)
    np.abs(d, out=d)
    reach = np.maximum(d[:, :-1], d[:, 1:])
    reach *= windows.share.take(stretch, axis=0)
    reach += np.maximum(samples[:, 1:-2], samples[:, 2:-1])
    large = np.flatnonzero(~(reach <= sought.levels[number, None]))
    window, column = np.divmod(large, reach.shape[1])
    number, k = number[window], at[window, column] + 1
    return np.asarray((number * ntime + k)[k > sought.first[number]])


def last_beyond(grid: Grid, f: Array, rows: NDArray[np.intp], level: Array, peaks: Array) -> NDArray[np.intp]:
    """Return the last sample of some signals whose magnitude exceeds a level, 0 if none does.

    `peaks` are their magnitudes by stretch, (n, nstretches).
    """
    beyond = peaks > level[:, None]
    stretch = grid.starts.size - 1 - beyond[:, ::-1].argmax(axis=1)
    at = np.minimum(grid.starts[stretch, None] + np.arange(STRETCH)[::-1], grid.t.size - 1)
    place = (np.abs(f[rows[:, None], at]) > level[:, None]).argmax(axis=1)
    return np.where(beyond.any(axis=1), at[np.arange(rows.size), place], 0)


def largest(top: Array, sides: Array, number: NDArray[np.intp], values: Array, begins: NDArray[np.bool_]) -> Array:
    """Return maxima by samples, or by the values (..., m) of cubics without those that are not wanted as they begin."""
    side = sides[number]
    size = np.fmax.reduce(np.where(side == 0.0, np.abs(values), side * values), axis=0)
    np.fmax.at(top, number, np.where(begins, -np.inf, size))
    return top


def last_entries(grid: Grid, edges: Array, number: NDArray[np.intp], k: NDArray[np.intp], p: Pieces) -> Array:
    """Return the times from which on magnitudes are at most edges (n,), by the first of the cubics p, on intervals k.

    -inf if always, inf if a signal is outside after the last sample but one.
    """
    found = np.full(edges.size, -np.inf)
    if not number.size:
        return found
    cuts, values = p.cuts[:, : k.size], p.values[:, : k.size]
    beyond = np.abs(values) > edges[number]
    leaving = np.flatnonzero(beyond.any(axis=0))
    last = leaving[np.append(np.diff(number[leaving]) > 0, True)[: leaving.size]]
    cut, own = 3 - beyond[::-1, last].argmax(axis=0), number[last]
    here, level = p[last], np.copysign(edges[own], values[cut, last])
    entered = here.time(here.crossing(level, cuts[cut, last], cuts[np.minimum(cut + 1, 3), last]))
    found[own] = np.where(k[last] == grid.t.size - 2, np.inf, entered)
    return found
