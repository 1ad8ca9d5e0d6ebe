"""Feasible squared rates by two passes over the cells, with rates that are linear in each cell."""

from __future__ import annotations

import numpy as np

from ctrlplan.planning.path_law.grid import Grid, Spline
from ctrlplan.planning.path_law.rows import Rows
from ctrlplan.trajectories.common import Array

_ROUNDS = 4
"""Rounds over a closed part, until its end is consistent with its start."""

_FAR = 1e30
"""Squared rate without a limit."""


def swept(grid: Grid, spline: Spline, rows: Rows) -> Array:
    """Coefficients of a feasible spline, near the fastest one.

    Backwards each cell limits the squared rate at its start to the largest one from
    which some feasible rate at its end is reached; forwards each cell is passed
    with the largest rate at its end.
    """
    cells = _Cells.of(rows)
    x = np.empty(spline.size)
    firsts = np.flatnonzero(np.diff(grid.part, prepend=-1)).tolist()
    for part, begin, end in zip(grid.parts, firsts, [*firsts[1:], grid.part.size], strict=True):
        nodes = cells.closed(begin, end) if part.closed else cells.open(begin, end, part.halts)
        middles = 0.5 * (nodes[:-1] + nodes[1:])
        if not nodes.max() < 1e-3 * _FAR:
            raise ValueError(
                "limits must bound the speed along the whole path, got a part of it with limits of accelerations only "
                "that starts and ends in motion; limit the velocities"
            )
        index = spline.index[:, begin:end]
        if not part.closed:
            x[index[0, 0]], x[index[2, -1]] = nodes[0], nodes[-1]
        x[index[1]] = middles
    return x


class _Cells:
    """Feasible pairs (y, z) of the squared rates at both ends of each cell: a y + c z <= 1 for all rows."""

    def __init__(self, start: Array, end: Array) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            backward, forward = start > 1e-14 * np.abs(end), end > 1e-14 * np.abs(start)
            self._start = np.where(backward, 1.0 / start, _FAR), np.where(backward, end / start, 0.0)
            self._end = np.where(forward, 1.0 / end, _FAR), np.where(forward, start / end, 0.0)
        self._peak = self._peaks()

    @classmethod
    def of(cls, rows: Rows) -> _Cells:
        start = rows.factors[..., 0] + 0.5 * rows.factors[..., 1]
        end = rows.factors[..., 2] + 0.5 * rows.factors[..., 1]
        two = len(rows.lower)
        pairs = [np.concatenate([own / rows.upper, own[:two] / rows.lower]).T.copy() for own in (start, end)]
        return cls(*pairs)

    def _peaks(self) -> tuple[Array, Array]:
        """Rates z at the ends for which the rates y at the starts are largest, and these, for all cells."""
        low, high = np.zeros(len(self._start[0])), np.full(len(self._start[0]), _FAR)
        offset, slope = self._start
        cell = np.arange(low.size)
        # The minimum of lines is concave: intersect the active line of positive slope with that of negative slope.
        for _ in range(30):
            values_low = offset - slope * low[:, None]
            values_high = offset - slope * high[:, None]
            i, j = values_low.argmin(axis=1), values_high.argmin(axis=1)
            rise, fall = -slope[cell, i], -slope[cell, j]
            moving = (rise > 0.0) & (fall < 0.0)
            if not moving.any():
                break
            with np.errstate(divide="ignore", invalid="ignore"):
                z = (offset[cell, i] - offset[cell, j]) / (fall - rise)
            z = np.where(moving, np.clip(z, low, high), low)
            k = (offset - slope * z[:, None]).argmin(axis=1)
            up = moving & (-slope[cell, k] > 0.0)
            done = moving & ((k == i) | (k == j))
            low, high = np.where(up | done, z, low), np.where((moving & ~up) | done, z, high)
        best = np.where(-slope[cell, (offset - slope * low[:, None]).argmin(axis=1)] > 0.0, high, low)
        return best, (offset - slope * best[:, None]).min(axis=1)

    def _back(self, k: int, z: float) -> float:
        """Largest rate at the start of a cell from which a rate of at most z at its end is reached."""
        if z >= self._peak[0][k]:
            return float(self._peak[1][k])
        return float((self._start[0][k] - self._start[1][k] * z).min())

    def _on(self, k: int, y: float) -> float:
        """Largest rate at the end of a cell with rate y at its start."""
        return float((self._end[0][k] - self._end[1][k] * y).min())

    def open(self, begin: int, end: int, halts: tuple[bool, bool]) -> Array:
        """Rates at the ends of the cells of an open part."""
        limit = np.empty(end - begin + 1)
        limit[-1] = 0.0 if halts[1] else min(_FAR, self._largest_end(end - 1))
        self._backward(limit, begin)
        if halts[0]:
            limit[0] = 0.0
        return self._forward(limit, begin)

    def _largest_end(self, k: int) -> float:
        """Largest rate at the end of a cell, over all rates at its start."""
        mirrored = _Cells.__new__(_Cells)
        mirrored._start = self._end[0][k : k + 1], self._end[1][k : k + 1]
        return float(mirrored._peaks()[1][0])

    def _backward(self, limit: Array, begin: int) -> None:
        for k in range(limit.size - 2, -1, -1):
            limit[k] = self._back(begin + k, limit[k + 1])

    def _forward(self, limit: Array, begin: int) -> Array:
        nodes = limit.copy()
        for k in range(limit.size - 1):
            nodes[k + 1] = min(limit[k + 1], self._on(begin + k, nodes[k]))
        return nodes

    def closed(self, begin: int, end: int) -> Array:
        """Rates at the ends of the cells of a closed part."""
        limit = np.full(end - begin + 1, self._largest_end(end - 1))
        for _ in range(_ROUNDS):
            self._backward(limit, begin)
            limit[-1] = limit[0]
        for _ in range(_ROUNDS):
            nodes = self._forward(limit, begin)
            limit[0] = nodes[-1]
        nodes[0] = nodes[-1]
        return nodes
