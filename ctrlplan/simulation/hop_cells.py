"""Loops with delays whose run is divided at the sums of events and multiples of the delays.

An event is the start of the run, a breakpoint of a function of time or a sample time.
It returns after each delay, and after each sum of delays. A delay that reads the
states returns it one derivative smoother, so that it is left out after some delays; a
delay that reads a delayed signal directly returns it as it is. What a delay returns in
a cell is read from the series of earlier cells.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.collocation import NODES, REACH, PartMaps, basis_at, is_resolved, value_at_start
from ctrlplan.simulation.delayed_run import DelayedRun, Jump, Parts
from ctrlplan.simulation.sampled_form import Late
from ctrlplan.simulation.signals import breakpoints_of
from ctrlplan.trajectories.chebyshev import points, transform

MARKS = 20_000
"""Maximum number of sums of events and delays in a run."""

_HOPS = (6, 12, 24, 48)
"""Numbers of derivatives up to which events are followed, until the states are resolved."""

_HALVINGS = 12
"""Maximum number of times by which cells are halved to resolve the functions of time."""

_NOISE = 1e-13
"""Last coefficients of a state that are rounding errors."""

_ENTRIES = 2**21
"""Maximum number of entries of the maps of the cells that are treated together."""

_SEVERAL = -2
"""Instead of a cell that a delay reads: several cells."""


def solved_by_hops(run: DelayedRun, limit: int) -> Parts | None:
    """States and inputs of the delays in cells between sums of delays; None if there are more cells than a limit.

    Raises
    ------
    SolverError
        If a state overflows.
    """
    for hops in _HOPS:
        marks = _marks(run, hops, min(MARKS, limit))
        cells = None if marks is None else _HopCells.of(run, marks, limit)
        if cells is None:
            return None
        parts, resolved = cells.solved(run)
        if resolved:
            return parts
    return None


def _marks(run: DelayedRun, hops: int, limit: int) -> Array | None:
    """Times [s] since the start at which signals are not smooth, increasing; None if there are more than a limit."""
    lates, tolerance = run.form.lates, run.tolerance
    delays = [late.delay for late in lates]
    direct = [bool(late.from_w[:, run.form.given].any() or _from_held(run, late)) for late in lates]
    among = [[bool(late.from_w[:, other.columns].any()) for late in lates] for other in lates]
    events = np.append(breakpoints_of(run.signals, run.first, run.last), run.instants.times[run.instants.due > 0])
    # Each entry: time, the delay that returns it or -1, and the lowest derivative that jumps.
    queue = [(float(t), -1, 0) for t in events - run.first if t > tolerance]
    queue += [(0.0, -1, 0), (run.span, -1, hops)]
    heapq.heapify(queue)
    found = list[float]()
    while queue:
        now = queue[0][0]
        orders = dict[int, int]()
        while queue and queue[0][0] <= now + tolerance:
            _, source, order = heapq.heappop(queue)
            orders[source] = min(order, orders.get(source, order))
        if len(found) == limit:
            return None
        found.append(now)
        for source, order in orders.items():
            for k, delay in enumerate(delays):
                same = len(found) == 1 or (direct[k] if source < 0 else among[source][k])
                later = order if same else order + 1
                if later <= hops and now + delay < run.span + tolerance:
                    heapq.heappush(queue, (now + delay, k, later))
    return np.array(found)


def _from_held(run: DelayedRun, late: Late) -> bool:
    """Whether a delay reads what discrete blocks hold."""
    own = late.from_z.copy()
    own[:, run.form.base.moving] = 0.0
    return bool(own.any())


@dataclass(frozen=True, eq=False)
class _HopCells:
    """Cells of a run.

    Attributes
    ----------
    starts, lengths : ndarray, shape (ncells,)
        Starts and lengths [s].
    longest : float
        Bound of the lengths [s].
    values : ndarray, shape (ncells, nodes, ngiven)
        Functions of time at the nodes.
    """

    starts: Array
    lengths: Array
    longest: float
    values: Array

    @classmethod
    def of(cls, run: DelayedRun, marks: Array, limit: int) -> _HopCells | None:
        """Cells between marks; None if there are more than a limit."""
        longest = min([late.delay for late in run.form.lates])
        longest = min(longest, REACH / max(run.form.norm, 1e-300))
        # What is sampled at the end of the run is seen in a cell after it.
        edges = np.append(marks, marks[-1] + 1e-3 * min(longest, run.span))
        for _ in range(_HALVINGS):
            counts = np.ceil(np.diff(edges) / longest * (1.0 - 1e-12)).astype(int)
            if counts.sum() > limit:
                return None
            within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            starts = np.repeat(edges[:-1], counts) + within * np.repeat(np.diff(edges) / counts, counts)
            lengths = np.append(starts[1:], edges[-1]) - starts
            values = run.values(starts[:, None] + lengths[:, None] * points(NODES - 1, 0.0, 1.0))
            if is_resolved(values, run.noise(float(lengths.max()))):
                return cls(starts, lengths, longest, values)
            longest *= 0.5
        return None

    def solved(self, run: DelayedRun) -> tuple[Parts, bool]:
        """States and inputs of the delays, and whether they are resolved."""
        n, width, count = run.state.size, run.form.delayed.size, self.starts.size
        march = _March(run, count)
        together = max(1, _ENTRIES // ((n + NODES * (n + width)) * (n + NODES * run.form.b.shape[1])))
        # What the delays return in cells up to here was stored before the first of them.
        until = self.starts + min(late.delay for late in run.form.lates) + run.tolerance
        ends = np.maximum(np.searchsorted(self.starts + self.lengths, until, side="right"), np.arange(count) + 1)
        jumps = run.jumps(self.starts)
        with np.errstate(all="ignore"):
            for begin in range(0, count, together):
                some = slice(begin, min(begin + together, count))
                maps = run.form.collocation.maps(self.lengths[some], self.longest)
                reads = [self._read(run, late, some) for late in run.form.lates]
                first = begin
                while first < some.stop:
                    last = min(int(ends[first]), some.stop)
                    march.advance(maps, reads, self.values, jumps, slice(first, last), begin)
                    first = last
                march.fill(maps, self.values, some)
        noise = max(_NOISE, run.noise(self.longest)) if run.form.given.size else _NOISE
        resolved = is_resolved(march.states, noise) and is_resolved(march.stored, noise)
        return Parts.of(run, self.starts, self.lengths, march.states, march.stored), resolved

    def _read(self, run: DelayedRun, late: Late, some: slice) -> _Read:
        """What a delay reads in some cells."""
        starts, lengths, tolerance = self.starts[some], self.lengths[some], run.tolerance
        nodes = lengths[:, None] * points(NODES - 1, 0.0, 1.0)
        since = starts - late.delay
        middle = self._cells_at(since + 0.5 * lengths)
        inside = np.maximum(middle, 0)
        ends = self.starts[inside] + self.lengths[inside]
        one = (since >= self.starts[inside] - tolerance) & (since + lengths <= ends + tolerance)
        one |= (middle < 0) & (since + lengths <= tolerance)
        which = np.where(one[:, None], middle[:, None], self._cells_at(since[:, None] + nodes))
        place = np.maximum(which, 0)
        x = 2.0 * (since[:, None] - self.starts[place] + nodes) / self.lengths[place] - 1.0
        table = basis_at(np.clip(x, -1.0, 1.0)) @ transform(np.eye(NODES)).T
        passed = int(np.count_nonzero(which.min(axis=1) < 0))
        return _Read(which, np.where(one, middle, _SEVERAL).tolist(), table, late.initial, passed)

    def _cells_at(self, since: Array) -> NDArray[np.intp]:
        """Cells that contain times [s]; -1 before the start."""
        return np.searchsorted(self.starts, since, side="right") - 1


@dataclass(frozen=True, eq=False)
class _Read:
    """What a delay reads in some cells.

    Attributes
    ----------
    which : ndarray of int, shape (ncells, nodes)
        Cells that contain the nodes, a delay before; -1 before the run.
    only : list of int
        Cell that contains all nodes, -1 before the run, -2 where there are several.
    table : ndarray, shape (ncells, nodes, nodes)
        Values at the nodes from those at the nodes of the cells.
    initial : ndarray, shape (width,)
        Values before the run.
    passed : int
        Number of the first cell all of whose nodes are in the run, a delay before.
    """

    which: NDArray[np.intp]
    only: list[int]
    table: Array
    initial: Array
    passed: int

    def values(self, stored: Array, first: int, last: int) -> Array:
        """Values (nodes, width) in a cell, or (ncells, nodes, width) in several."""
        if last == first + 1 and self.only[first] >= 0:
            return np.asarray(self.table[first] @ stored[self.only[first]])
        which = self.which[first:last]
        if first >= self.passed:
            return np.einsum("kjf,kjfw->kjw", self.table[first:last], stored[which])
        found = np.einsum("kjf,kjfw->kjw", self.table[first:last], stored[np.maximum(which, 0)])
        return np.where((which >= 0)[..., None], found, self.initial)


class _March:
    """States of a run from cell to cell.

    Attributes
    ----------
    states, stored : ndarray, shapes (ncells, nodes, n) and (ncells, nodes, ndelayed)
        States and inputs of the delays at the nodes, so far.
    """

    def __init__(self, run: DelayedRun, count: int) -> None:
        self._rows, self._state, width = run.form.rows, run.state, run.form.delayed.size
        self.states, self.stored = np.empty((count, NODES, run.state.size)), np.empty((count, NODES, width))
        self._starts, self._back = np.empty((count, run.state.size)), np.empty((count, NODES, width))

    def advance(
        self, maps: PartMaps, reads: list[_Read], given: Array, jumps: dict[int, Jump], cells: slice, begin: int
    ) -> None:
        """Compute cells whose delayed values are known; `begin`: the cell of the first map."""
        n, back = self._state.size, self._back[cells]
        own = slice(cells.start - begin, cells.stop - begin)
        for rows, read in zip(self._rows, reads, strict=True):
            back[..., rows] = read.values(self.stored[..., rows], own.start, own.stop)
        steps = maps.steps[own]
        inputs = np.concatenate([back.reshape(len(back), -1), given[cells].reshape(len(back), -1)], axis=1)
        forced = np.matmul(steps[..., n:], inputs[..., None])[..., 0]
        state, starts = self._state, self._starts
        for k in range(cells.start, cells.stop):
            if k in jumps:
                jump, of_back, constant = jumps[k]
                state = jump @ state + (of_back @ (value_at_start() @ self._back[k]) + constant)
            starts[k] = state
            state = state + (steps[k - cells.start, :n, :n] @ state + forced[k - cells.start, :n])
        self._state = state
        found = np.matmul(steps[:, n:, :n], starts[cells, :, None])[..., 0] + forced[:, n:]
        self.stored[cells] = found.reshape(back.shape)

    def fill(self, maps: PartMaps, given: Array, cells: slice) -> None:
        """Compute the states at the nodes of cells."""
        count = cells.stop - cells.start
        known = [x[cells].reshape(count, -1) for x in (self._starts, self._back, given)]
        found = np.matmul(maps.states, np.concatenate(known, axis=1)[..., None])
        self.states[cells] = found.reshape(count, NODES, -1)
