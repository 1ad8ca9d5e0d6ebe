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
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.collocation import NODES, REACH, PartMaps, basis_at, is_resolved, value_at_start
from ctrlplan.simulation.delayed_run import DelayedRun, Jump, Parts
from ctrlplan.simulation.sampled_form import DelayedForm, Late
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

_KEPT = 5 * 2**17
"""Maximum number of their entries that are kept for further runs."""


def solved_by_hops(run: DelayedRun, limit: int) -> Parts | None:
    """States and inputs of the delays in cells between sums of delays; None if there are more cells than a limit.

    Raises
    ------
    SolverError
        If a state overflows.
    """
    breaks = np.asarray(breakpoints_of(run.signals, run.first, run.last))
    for hops in _HOPS:
        key = run.first, run.last, breaks.tobytes(), hops, min(MARKS, limit)
        marks = run.form.marks.get(key, partial(_marks, run, breaks, hops, min(MARKS, limit)))
        found = None if marks is None else _resolving(run, key, marks, limit)
        if found is None:
            return None
        parts, resolved = _solved(run, *found)
        if resolved:
            return parts
    return None


def _marks(run: DelayedRun, breaks: Array, hops: int, limit: int) -> Array | None:
    """Times [s] since the start at which signals are not smooth, increasing; None if there are more than a limit.

    breaks: breakpoints [s] of the functions of time.
    """
    lates, tolerance = run.form.lates, run.tolerance
    delays = [late.delay for late in lates]
    direct = [bool(late.from_w[:, run.form.given].any() or _from_held(run, late)) for late in lates]
    among = [[bool(late.from_w[:, other.columns].any()) for late in lates] for other in lates]
    events = np.append(breaks, run.instants.times[run.instants.due > 0])
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


def _resolving(run: DelayedRun, key: tuple[object, ...], marks: Array, limit: int) -> tuple[HopCells, Array] | None:
    """Cells between marks, and the functions of time (ncells, nodes, ngiven) that they resolve; None if too many."""
    longest = min([late.delay for late in run.form.lates])
    longest = min(longest, REACH / max(run.form.norm, 1e-300))
    # What is sampled at the end of the run is seen in a cell after it.
    edges = np.append(marks, marks[-1] + 1e-3 * min(longest, run.span))
    for _ in range(_HALVINGS):
        with np.errstate(over="ignore"):
            wanted = np.ceil(np.diff(edges) / longest * (1.0 - 1e-12))
        if not wanted.sum() <= limit:  # before they are integers, which overflow
            return None
        counts = wanted.astype(int)
        cells = run.form.cells.get((key, longest), partial(HopCells, run.form, edges, counts, longest, run.tolerance))
        values = run.values(cells.starts[:, None] + cells.lengths[:, None] * points(NODES - 1, 0.0, 1.0))
        if is_resolved(values, run.noise(float(cells.lengths.max()))):
            return cells, values
        longest *= 0.5
    return None


def _solved(run: DelayedRun, cells: HopCells, values: Array) -> tuple[Parts, bool]:
    """States and inputs of the delays, and whether they are resolved."""
    march, jumps, count = _March(run, cells.starts.size), run.jumps(cells.starts), cells.starts.size
    with np.errstate(all="ignore"):
        for begin in range(0, count, cells.together):
            some = slice(begin, min(begin + cells.together, count))
            maps, reads = cells.equations(some)
            march.begin(maps, values, some)
            first = begin
            while first < some.stop:
                last = min(int(cells.ends[first]), some.stop)
                march.advance(reads, jumps, slice(first, last))
                first = last
            march.fill(maps, values, some)
    noise = max(_NOISE, run.noise(cells.longest)) if run.form.given.size else _NOISE
    resolved = is_resolved(march.states, noise) and is_resolved(march.stored, noise)
    return Parts.of(run, cells.starts, cells.lengths, march.states, march.stored), resolved


class HopCells:
    """Cells of a run, and the equations in them, equal for all functions of time with the same breakpoints.

    Parameters
    ----------
    form : DelayedForm
        The loop.
    edges : ndarray
        Times [s] since the start between which there are cells.
    counts : ndarray of int
        Numbers of equal cells between them.
    longest : float
        Bound of the lengths [s].
    tolerance : float
        Difference of two times that counts as rounding [s].

    Attributes
    ----------
    starts, lengths : ndarray, shape (ncells,)
        Starts and lengths [s].
    ends : ndarray of int, shape (ncells,)
        Cells up to which all that delays return was stored before a cell.
    together : int
        Number of cells that are treated together.
    """

    def __init__(
        self, form: DelayedForm, edges: Array, counts: NDArray[np.intp], longest: float, tolerance: float
    ) -> None:
        self._form, self.longest, self._tolerance = form, longest, tolerance
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        self.starts = np.repeat(edges[:-1], counts) + within * np.repeat(np.diff(edges) / counts, counts)
        self.lengths = np.append(self.starts[1:], edges[-1]) - self.starts
        count, n, width, nw = self.starts.size, len(form.a), form.delayed.size, form.b.shape[1]
        until = self.starts + min(late.delay for late in form.lates) + tolerance
        self.ends = np.maximum(np.searchsorted(self.starts + self.lengths, until, side="right"), np.arange(count) + 1)
        entries = (n + NODES * (n + width)) * (n + NODES * nw)
        self.together = max(1, _ENTRIES // entries)
        self._keeps = count * entries <= _KEPT
        self._kept: tuple[PartMaps, list[_Read]] | None = None

    def equations(self, some: slice) -> tuple[PartMaps, list[_Read]]:
        """Maps of some cells, and what each delay reads in them."""
        if self._kept is not None:
            return self._kept
        maps = self._form.collocation.maps(self.lengths[some], self.longest)
        found = maps, [self._read(late, some) for late in self._form.lates]
        if self._keeps:
            self._kept = found
        return found

    def _read(self, late: Late, some: slice) -> _Read:
        """What a delay reads in some cells."""
        starts, lengths, tolerance = self.starts[some], self.lengths[some], self._tolerance
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
        return _Read(which, table, late.initial, passed)

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
    table : ndarray, shape (ncells, nodes, nodes)
        Values at the nodes from those at the nodes of the cells.
    initial : ndarray, shape (width,)
        Values before the run.
    passed : int
        Number of the first cell all of whose nodes are in the run, a delay before.
    """

    which: NDArray[np.intp]
    table: Array
    initial: Array
    passed: int

    @cached_property
    def alone(self) -> dict[int, tuple[slice, Array]]:
        """Nodes of all cells that one cell reads, and its values from theirs; filled when they are first used."""
        return {}

    def value(self, stored: Array, k: int) -> Array:
        """Values (nodes, width) in one cell that is not read before the run, from those (ncells * nodes, width)."""
        found = self.alone.get(k)
        if found is None:
            which, first = self.which[k], int(self.which[k].min())
            count = int(which.max()) + 1 - first
            matrix = np.zeros((NODES, count, NODES))
            matrix[np.arange(NODES), which - first] = self.table[k]
            nodes = slice(first * NODES, (first + count) * NODES)
            self.alone[k] = found = nodes, matrix.reshape(NODES, -1)
        return np.asarray(found[1] @ stored[found[0]])

    def values(self, stored: Array, first: int, last: int) -> Array:
        """Values (ncells, nodes, width) in some cells."""
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
        self._rows, self._state, self._n = run.form.rows, run.state, run.state.size
        width = run.form.delayed.size
        self.states, self.stored = np.empty((count, NODES, self._n)), np.empty((count, NODES, width))
        self._inputs = np.empty((count, self._n + NODES * width))  # states at the starts, and delayed values
        self._back = self._inputs[:, self._n :].reshape(count, NODES, width)
        self._by_rows = [self.stored.reshape(count * NODES, width)[:, rows] for rows in self._rows]

    def begin(self, maps: PartMaps, given: Array, some: slice) -> None:
        """Begin with cells that are treated together."""
        known, count = self._inputs.shape[1], some.stop - some.start
        self._first, self._steps = some.start, maps.steps[..., :known]
        self._forced = np.matmul(maps.steps[..., known:], given[some].reshape(count, -1, 1))[..., 0]

    def advance(self, reads: list[_Read], jumps: dict[int, Jump], cells: slice) -> None:
        """Compute cells whose delayed values are known."""
        own = slice(cells.start - self._first, cells.stop - self._first)
        if cells.stop == cells.start + 1 and own.start >= max(read.passed for read in reads):
            self._advance_one(reads, jumps, cells.start, own.start)
            return
        n, back = self._n, self._back[cells]
        for rows, read in zip(self._rows, reads, strict=True):
            back[..., rows] = read.values(self.stored[..., rows], own.start, own.stop)
        steps = self._steps[own]
        forced = np.matmul(steps[..., n:], back.reshape(len(back), -1, 1))[..., 0]
        forced += self._forced[own]
        state, starts = self._state, self._inputs[:, :n]
        for k in range(cells.start, cells.stop):
            if k in jumps:
                state = self._jumped(jumps[k], state, k)
            starts[k] = state
            state = state + (steps[k - cells.start, :n, :n] @ state + forced[k - cells.start, :n])
        self._state = state
        found = np.matmul(steps[:, n:, :n], starts[cells, :, None])[..., 0] + forced[:, n:]
        self.stored[cells] = found.reshape(back.shape)

    def _advance_one(self, reads: list[_Read], jumps: dict[int, Jump], k: int, own: int) -> None:
        """The same for one cell, whose delayed values are not from before the run."""
        n, inputs, back = self._n, self._inputs[k], self._back[k]
        for rows, read, stored in zip(self._rows, reads, self._by_rows, strict=True):
            back[:, rows] = read.value(stored, own)
        state = self._jumped(jumps[k], self._state, k) if k in jumps else self._state
        inputs[:n] = state
        after = self._steps[own].dot(inputs)
        after += self._forced[own]
        self._state = state + after[:n]
        self.stored[k] = after[n:].reshape(back.shape)

    def _jumped(self, jump: Jump, state: Array, k: int) -> Array:
        """State after a jump at the start of a cell."""
        matrix, of_back, constant = jump
        return np.asarray(matrix @ state + (of_back @ (value_at_start() @ self._back[k]) + constant))

    def fill(self, maps: PartMaps, given: Array, cells: slice) -> None:
        """Compute the states at the nodes of cells."""
        count = cells.stop - cells.start
        known = np.concatenate([self._inputs[cells], given[cells].reshape(count, -1)], axis=1)
        found = np.matmul(maps.states, known[..., None])
        self.states[cells] = found.reshape(count, NODES, -1)
