"""Feasible squared rates by two passes over the cells, with rates that are linear in each cell."""

from __future__ import annotations

import numpy as np

from ctrlplan.planning.path_law.grid import Grid, Spline
from ctrlplan.planning.path_law.interior_point import UNBOUNDED
from ctrlplan.planning.path_law.rows import Rows
from ctrlplan.planning.path_law.spans import Part, Rates
from ctrlplan.trajectories.common import Array

_ROUNDS = 4
"""Rounds over a closed part, until its end is consistent with its start."""

_FAR = 1e100
"""Squared rate without a limit."""


def swept(grid: Grid, spline: Spline, rows: Rows) -> Array:
    """Coefficients of a spline near the fastest one, feasible up to a factor.

    Backwards each cell limits the squared rate at its start to the largest one from
    which some feasible rate at its end is reached; forwards each cell is passed
    with the largest rate at its end.

    Raises
    ------
    ValueError
        If the rate is not limited.
    """
    cells, x = _Cells(rows, grid.joints[0] ** 2), np.empty(spline.size)
    for part, begin, end in _cells_of_parts(grid):
        starts = cells.closed(begin, end) if part.closed else cells.open(begin, end, part.rates)
        if not starts.max() < 1e-3 * _FAR:
            raise ValueError(UNBOUNDED)
        index, ends = spline.index[:, begin:end], starts[1:] / cells.gains[begin:end]
        if not part.closed:
            x[index[0, 0]], x[index[2, -1]] = starts[0], ends[-1]
        x[index[1]] = 0.5 * (starts[:-1] + ends)
    return x


def check_ends(grid: Grid, rows: Rows) -> None:
    """Raise for prescribed rates that are infeasible, with the largest feasible ones."""
    cells = _Cells(rows, grid.joints[0] ** 2)
    for part, begin, end in _cells_of_parts(grid):
        if not part.closed:
            cells.open(begin, end, part.rates)


def _cells_of_parts(grid: Grid) -> list[tuple[Part, int, int]]:
    """Parts, the first cell of each, and the one after its last."""
    firsts = np.flatnonzero(np.diff(grid.part, prepend=-1)).tolist()
    return list(zip(grid.parts, firsts, [*firsts[1:], grid.part.size], strict=True))


class _Cells:
    """Feasible pairs (y, z) of the squared rates at both ends of each cell: a y + c z <= 1 for all rows.

    Attributes
    ----------
    gains : ndarray, shape (ncells,)
        Factors of the squared rate from the end of each cell to the start of the next one.
    """

    def __init__(self, rows: Rows, gains: Array) -> None:
        start = rows.factors[..., 0] + 0.5 * rows.factors[..., 1]
        end = rows.factors[..., 2] + 0.5 * rows.factors[..., 1]
        two = len(rows.lower)
        start, end = (np.concatenate([own / rows.upper, own[:two] / rows.lower]).T.copy() for own in (start, end))
        self.gains = gains
        self._of_end, self._of_start = _lines(start, end), _lines(end, start)
        self._best_end, self._largest_start = _peaks(*self._of_end)

    def open(self, begin: int, end: int, rates: Rates) -> Array:
        """Rates at the starts of the cells of an open part, and at its end, some of which may be prescribed."""
        limit = np.empty(end - begin + 1)
        limit[-1] = self._largest_end(end - 1)
        if rates[1] is not None:
            _check_speed("end", rates[1], limit[-1])
            limit[-1] = rates[1]
        self._backward(limit, begin)
        if rates[0] is not None:
            _check_speed("start", rates[0], limit[0])
            limit[0] = rates[0]
        if rates[1] is not None:  # the last cell reaches it
            offset, slope = self._of_end
            limit[-2] = min(limit[-2], (offset[end - 1] + slope[end - 1] * rates[1]).min())
        nodes = self._forward(limit, begin)
        if rates[1] is not None:
            _check_speed("end", rates[1], nodes[-1])
        return nodes

    def closed(self, begin: int, end: int) -> Array:
        """The same for a closed part."""
        limit = np.full(end - begin + 1, self._largest_end(end - 1))
        for _ in range(_ROUNDS):
            self._backward(limit, begin)
            limit[-1] = limit[0]
        for _ in range(_ROUNDS):
            nodes = self._forward(limit, begin)
            limit[0] = nodes[-1]
        nodes[0] = nodes[-1]
        return nodes

    def _largest_end(self, cell: int) -> float:
        """Largest rate after the end of a cell, over all rates at its start."""
        offset, slope = self._of_start
        return float(_peaks(offset[cell : cell + 1], slope[cell : cell + 1])[1][0] * self.gains[cell])

    def _backward(self, limit: Array, begin: int) -> None:
        offset, slope = self._of_end
        for k in range(limit.size - 2, -1, -1):
            cell = begin + k
            z = limit[k + 1] / self.gains[cell]
            beyond = z >= self._best_end[cell]
            limit[k] = self._largest_start[cell] if beyond else (offset[cell] + slope[cell] * z).min()

    def _forward(self, limit: Array, begin: int) -> Array:
        offset, slope = self._of_start
        nodes = limit.copy()
        for k in range(limit.size - 1):
            cell = begin + k
            nodes[k + 1] = min(limit[k + 1], self.gains[cell] * (offset[cell] + slope[cell] * nodes[k]).min())
        return nodes


def _check_speed(where: str, rate: float, largest: float) -> None:
    if rate > largest * (1.0 + 1e-9):
        raise ValueError(
            f"the speed at the {where} must be feasible within the limits, got {rate**0.5:.6g} times that of the plan, "
            f"where at most {max(largest, 0.0) ** 0.5:.6g} times it is"
        )


def _lines(one: Array, other: Array) -> tuple[Array, Array]:
    """Offsets and slopes (ncells, nrows) of the upper limits of a rate by the rate at the other end."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # of the slowest plans
        limits = one > 1e-14 * np.abs(other)
        return np.where(limits, 1.0 / one, _FAR), np.where(limits, -other / one, 0.0)


def _peaks(offset: Array, slope: Array) -> tuple[Array, Array]:
    """Place of at least 0 and value of the maximum of the minimum of lines, for each cell."""
    cell = np.arange(len(offset))
    low, high = np.zeros(cell.size), np.full(cell.size, _FAR)
    for _ in range(30):
        i, j = (offset + slope * low[:, None]).argmin(axis=1), (offset + slope * high[:, None]).argmin(axis=1)
        rise, fall = slope[cell, i], slope[cell, j]
        moving = (rise > 0.0) & (fall < 0.0)
        if not moving.any():
            break
        # The minimum is concave: intersect the line that is active on the left with that on the right.
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (offset[cell, j] - offset[cell, i]) / (rise - fall)
        z = np.where(moving, np.clip(z, low, high), low)
        k = (offset + slope * z[:, None]).argmin(axis=1)
        done = (k == i) | (k == j)
        increases = slope[cell, k] > 0.0
        low = np.where(moving & (increases | done), z, low)
        high = np.where(moving & (~increases | done), z, high)
    rises = slope[cell, (offset + slope * low[:, None]).argmin(axis=1)] > 0.0
    best = np.where(rises, high, low)
    return best, (offset + slope * best[:, None]).min(axis=1)
