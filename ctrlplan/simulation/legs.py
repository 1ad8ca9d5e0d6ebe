"""The way of every numerical run: from leg to leg, samples, delays and stops between them."""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ctrlplan.simulation.drives import (
    RESOLVED,
    Drive,
    Series,
    breakpoints_of,
    chebyshev_coefficients,
    chebyshev_times,
    driven_signals,
    resolved,
)
from ctrlplan.simulation.interpreted import Interpreted, SolverError
from ctrlplan.simulation.network import Network

Array = NDArray[np.float64]

_WIDTH = 24
"""Terms with which a signal that will be delayed is kept."""

_SHORTEST = 1.0 / 64.0
"""Legs this much shorter than the delay are not halved for a signal's sake."""

_HOPS = 6
"""Delays after which what was a jump is smooth enough to be passed over."""


class Solver(Protocol):
    """What carries a state over a leg."""

    def advance(self, series: Series, left: float, grid: Array, state: Array) -> Array:
        """States (nstates, ngrid) at times of a leg, of which the last is its end."""

    def signals(self, times: Array, states: Array, driven: Array) -> Array:
        """All signals (nsignals, ntime)."""

    def outputs(self, times: Array, states: Array, driven: Array) -> Array:
        """Outputs (noutputs, ntime) of the whole."""


class DelayedDrive:
    """Signals of the past, kept as series of the legs they were seen on."""

    def __init__(self, delay: float, initial: Array, first: float) -> None:
        self.delay = delay
        self.breakpoints = np.empty(0)
        self._initial, self._first = initial, first
        self._pieces: list[Series] = []
        self._ends: list[float] = []

    def record(self, piece: Series) -> None:
        """Signals of a leg, as they went in."""
        self._pieces.append(piece)
        self._ends.append(piece.right)

    def beside(self, moment: float, origin: float, s: Array) -> Array:
        """Values as they were; legs end where they break."""
        return self.at(origin + s)

    def at(self, times: Array) -> Array:
        """Values as they were."""
        past = times - self.delay
        out = np.repeat(self._initial[:, None], times.size, axis=1)
        which = np.array([bisect_right(self._ends, t) for t in past.tolist()])
        for k in np.unique(which[past >= self._first]).tolist():
            piece = self._pieces[min(k, len(self._pieces) - 1)]
            rows = (which == k) & (past >= self._first)
            out[:, rows] = piece.at(past[rows])
        return out


@dataclass(frozen=True, eq=False)
class Run:
    """What a run left behind, at every time it was asked for.

    Attributes
    ----------
    times : ndarray, shape (ntime,)
        Times asked for [s], as far as the run went.
    states : ndarray, shape (nstates, ntime)
        Right-continuous where a discrete block takes a sample.
    legs : list of (float, Series)
        Where each leg begins, and the driven signals over it.
    """

    times: Array
    states: Array
    legs: list[tuple[float, Series]]

    def series(self, t: float) -> Series:
        """Driven signals over the leg that begins at or before a time."""
        return self.legs[max(0, bisect_right([left for left, _ in self.legs], t) - 1)][1]


def integrate(
    network: Network,
    equations: Interpreted | None,
    solver: Solver,
    drives: Sequence[Drive],
    times: Array,
    state: Array,
    resolution: float,
    pause: Callable[[Array, Array], bool] | None = None,
) -> Run:
    """Run a network over increasing times.

    Parameters
    ----------
    network, equations, solver
        What is run, its equations by Python, and what carries states on.
    drives : sequence of Drive
        One for the external inputs each, then one for each driven block.
    times : ndarray, shape (ntime,)
        Times at which states are wanted; the run goes from the first to the last.
    state : ndarray, shape (nstates,)
        Where it starts.
    resolution : float
        Relative accuracy of signals kept for delays.
    pause : callable, optional
        Maps the times and states of a stretch to whether the run may end
        behind it; stretches are then short.
    """
    first, last = float(times[0]), float(times[-1])
    delayed = [(drive, i) for drive, i in _delayed(network, drives)]
    clock = _Clock(network, _fixed(network, drives, first, last, [d.delay for d, _ in delayed]), first, last)
    longest = min([last - first, *(d.delay for d, _ in delayed)])
    if pause is not None:
        longest = min(longest, (last - first) / 64.0)
    wire = [(drive, network.wire[network.inputs[i]]) for drive, i in delayed]
    states = np.empty((state.size, times.size))
    legs: list[tuple[float, Series]] = []
    span: list[Series] = []
    left, x = first, clock.sample(equations, drives, first, state)
    reach = longest
    while left < last:
        right = min(clock.following(left), left + reach)
        if right > clock.following(left) - 1e-9 * (right - left):
            right = clock.following(left)
        if delayed or not (span and span[0].left <= left and right <= span[-1].right):
            until = right if delayed else clock.fixed_after(left)
            middle = 0.5 * (left + right)
            accuracy = resolution if delayed else RESOLVED
            span = resolved(partial(_beside, drives, middle, left), left, until, accuracy)
        series = next(s for s in span if left < s.right)
        right = min(right, series.right)
        begin, end = np.searchsorted(times, [left, right])
        nodes = chebyshev_times(left, right, _WIDTH) if delayed else np.empty(0)
        inside = times[begin:end][times[begin:end] > left]
        grid = np.union1d(np.append(nodes, right), inside)
        try:
            found = solver.advance(series, left, grid, x)
        except SolverError:
            if pause is None or right - left < 1e-9 * (last - first):
                raise
            reach = 0.5 * (right - left)
            continue
        if not np.isfinite(found).all():
            raise SolverError(f"the solver must reach {last:g} s, got to {left:g} s: a state is infinite beyond")
        if delayed:
            at_nodes = np.searchsorted(grid, nodes)
            w = solver.signals(nodes, found[:, at_nodes], series.at(nodes))
            pieces = [chebyshev_coefficients(rows @ w) for _, rows in wire]
            if any(_unresolved(piece, resolution) for piece in pieces) and right - left > _SHORTEST * longest:
                reach = 0.5 * (right - left)
                continue
            for (drive, _), piece in zip(wire, pieces, strict=True):
                drive.record(Series(left, right, piece))
        states[:, end - inside.size : end] = found[:, np.searchsorted(grid, inside)]
        states[:, begin : end - inside.size] = x[:, None]
        legs.append((left, series))
        before, x = x, clock.sample(equations, drives, right, found[:, -1])
        if pause is not None and pause(np.append(left, grid), np.column_stack([before, found])):
            done = times <= right
            states[:, times == right] = x[:, None]
            return Run(times[done], states[:, done], legs)
        left, reach = right, min(longest, 2.0 * reach)
    states[:, -1] = x
    return Run(times, states, legs)


class _Clock:
    """Instants at which a leg must end: breakpoints, and samples of discrete blocks."""

    def __init__(self, network: Network, fixed: list[float], first: float, last: float) -> None:
        self._fixed = [*fixed, last]
        self._tolerance = 1e-12 * max(abs(first), abs(last), last - first)
        self._samples: list[tuple[float, int, int]] = []
        self._first = first
        self._periods = {}
        for i in network.with_state("period"):
            system = network.blocks[i].system
            self._periods[i] = (float(system.period), float(getattr(system, "offset", 0.0)))
            self._push(i, 0)

    def following(self, t: float) -> float:
        """The next instant after t."""
        due = self.fixed_after(t)
        if self._samples and self._samples[0][0] < due - self._tolerance:
            return self._samples[0][0]
        return due

    def fixed_after(self, t: float) -> float:
        """The next breakpoint after t, or the end."""
        return self._fixed[min(bisect_right(self._fixed, t + self._tolerance), len(self._fixed) - 1)]

    def sample(self, equations: Interpreted | None, drives: Sequence[Drive], t: float, x: Array) -> Array:
        """State after the blocks due at t have taken their samples."""
        due = []
        while self._samples and self._samples[0][0] <= t + self._tolerance:
            _, i, k = heapq.heappop(self._samples)
            due.append(i)
            self._push(i, k + 1)
        if not due or equations is None:
            return x
        return equations.sampled(tuple(sorted(due)), t, x, driven_signals(drives, np.array([t]))[:, 0])

    def _push(self, i: int, k: int) -> None:
        period, offset = self._periods[i]
        heapq.heappush(self._samples, (self._first + offset + k * period, i, k))


def _beside(drives: Sequence[Drive], moment: float, origin: float, s: Array) -> Array:
    return np.concatenate([np.zeros((0, s.size)), *(drive.beside(moment, origin, s) for drive in drives)])


def _delayed(network: Network, drives: Sequence[Drive]) -> Iterator[tuple[DelayedDrive, int]]:
    """The drives of delays, and their blocks."""
    blocks = iter(network.with_state("delay"))
    for drive in drives:
        if isinstance(drive, DelayedDrive):
            yield drive, next(blocks)


def _fixed(network: Network, drives: Sequence[Drive], first: float, last: float, delays: list[float]) -> list[float]:
    """Breakpoints inside the run, and where delays carry them to."""
    marks = breakpoints_of(drives)
    marks += [float(t) for block in network.blocks for t in getattr(block.system, "breakpoints", ())]
    found = {t for t in marks if first < t < last}
    fresh = {*found, first}
    for _ in range(_HOPS if delays else 0):
        fresh = {t + delay for t in fresh for delay in delays if t + delay < last} - found
        if len(found) + len(fresh) > 20_000:
            break
        found |= fresh
    return apart([first, *sorted(found), last])[1:-1]


def apart(times: list[float]) -> list[float]:
    """Increasing times without those that are the same but for rounding; first and last stay."""
    kept = [times[0]]
    for t in times[1:-1]:
        if t - kept[-1] > 1e-14 * max(abs(t), times[-1] - times[0]) < times[-1] - t:
            kept.append(t)
    return [*kept, times[-1]]


def _unresolved(coefficients: Array, resolution: float) -> bool:
    size = np.abs(coefficients)
    return bool(np.any(size[:, -3:] > resolution * size.max(axis=1, keepdims=True) + 1e-300))
