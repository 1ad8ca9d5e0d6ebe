"""Exact states of a linear loop with delays between continuous blocks, by the method of steps with collocation.

Time is divided into cells of a length that divides every delay: what a delay returns
in a cell is what it stored in an earlier one, at the same nodes. Breakpoints of the
functions of time, which return after each delay, divide every cell at the same
places. The states at the nodes of a cell satisfy the integrated equations at these
nodes, a linear system that is solved once for each part of a cell. Discrete blocks
are sampled at the starts of parts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.polynomial import chebyshev as series

from ctrlplan._types import Array
from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.exact import state_scale
from ctrlplan.simulation.instants import instants_of
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.sampled_form import DelayedForm
from ctrlplan.simulation.segments import as_fraction, time_tolerance, values_after
from ctrlplan.simulation.signals import TimeSignal, breakpoints_of, signal_values
from ctrlplan.trajectories.chebyshev import points, transform

_NODES = 16
"""Number of nodes of a part of a cell."""

_REACH = 2.0
"""Norm of the equations times the length of a cell up to which the nodes resolve the states."""

_PARTS = 100_000
"""Maximum number of parts of cells of a run."""

_RESOLVED, _NOISE = 1e-15, 1e-11
"""Last coefficients of a function of time, relative to the largest, at which it is resolved, or its rounding errors."""

_HALVINGS = 40
"""Maximum number of times by which a cell is halved."""


@dataclass(frozen=True, eq=False)
class _Part:
    """Maps of a part of a cell from (state at its start, delayed values and functions of time at its nodes).

    Attributes
    ----------
    states : ndarray, shape (nodes * n, ...)
        States at the nodes.
    end : ndarray, shape (n, ...)
        State at the end.
    stored : ndarray, shape (nodes * nstored, ...)
        Inputs of the delays at the nodes.
    """

    states: Array
    end: Array
    stored: Array


class DelayedMotion:
    """States and delayed signals of a loop over a run.

    Parameters
    ----------
    form : DelayedForm
        The loop.
    signals : sequence of TimeSignal
        Functions of time: inputs, then the outputs of sources and delays; those of delays are not evaluated.
    first, last : float
        Start and end of the run [s].
    state : ndarray, shape (n,)
        State at the start.

    Attributes
    ----------
    instants : ndarray
        Start of the run and sample times of the discrete blocks [s].

    Raises
    ------
    NotApplicableError
        If the delays and periods have no common divisor that is long enough.
    SolverError
        If a state overflows.
    """

    def __init__(
        self, form: DelayedForm, signals: Sequence[TimeSignal], first: float, last: float, state: Array
    ) -> None:
        self._form, self._first = form, first
        self._tolerance = time_tolerance(first, last)
        delayed = np.concatenate([np.arange(late.columns.start, late.columns.stop) for late in form.lates])
        self._delayed, self._given = delayed, np.setdiff1d(np.arange(form.b.shape[1]), delayed)
        begins = np.cumsum([0, *(signal.width for signal in signals)]).tolist()
        self._signals = [s for s, begin in zip(signals, begins, strict=False) if begin not in set(delayed.tolist())]
        timings = form.base.timings
        found = instants_of(timings, first, last, self._tolerance)
        self._due, self.instants = found.due, found.times
        self._cell, self._edges, count, values = self._divided(last)
        self._starts = np.add.outer(self._cell * np.arange(count), self._edges[:-1])
        self._run(values, state, last)

    def at(self, times: Array) -> tuple[Array, Array]:
        """States (n, ntime), and functions of time (nw, ntime) with the delayed ones, at times [s] of the run."""
        since = times - self._first
        x = self._evaluated(self._states, since)
        w = np.empty((self._form.b.shape[1], times.size))
        w[self._given] = signal_values(self._signals, times)
        begin = 0
        for late in self._form.lates:
            width = late.initial.size
            past = since - late.delay
            known = self._evaluated(self._stored[..., begin : begin + width], np.maximum(past, 0.0))
            w[late.columns] = np.where(past >= -self._tolerance, known, late.initial[:, None])
            begin += width
        return x, w

    def _divided(self, last: float) -> tuple[float, Array, int, Array]:
        """Length of a cell [s], edges of its parts, number of cells, and functions of time at all nodes."""
        form, span = self._form, last - self._first
        repeating = [as_fraction(late.delay) for late in form.lates] + [period for period, _ in form.base.timings]
        den = math.lcm(*(time.denominator for time in repeating))
        common = Fraction(math.gcd(*(int(time * den) for time in repeating)), den)
        end = last + float(common)  # the run ends within the last cell
        marks = np.array([t for t in breakpoints_of(self._signals, self._first, end) if self._first < t < end])
        marks = np.append(marks - self._first, [float(offset) for _, offset in form.base.timings])
        for halving in range(_HALVINGS):
            cell = float(common / 2**halving)
            count = math.floor((span + self._tolerance) / cell) + 1
            if count > _PARTS:
                break
            edges = self._edges_of(marks, cell)
            if count * (edges.size - 1) > _PARTS:
                break
            if form.norm * cell > _REACH:
                continue
            values = self._values(cell, edges, count)
            # Times are rounded: relative to the change of a signal over a cell by this much.
            noise = _NOISE + 64.0 * np.finfo(float).eps * max(abs(self._first), abs(last)) / cell
            if _resolved(values, noise):
                return cell, edges, count, values
        text = ", ".join(f"{late.delay:g}" for late in form.lates)
        raise NotApplicableError(
            f"delays of {text} s, sample times and breakpoints of functions of time divide the run of {span:g} s into "
            f"more than {_PARTS} parts"
        )

    def _edges_of(self, marks: Array, cell: float) -> Array:
        """Edges of the parts of a cell."""
        inside = np.sort(marks - cell * np.round(marks / cell))
        inside = np.where(inside < 0.0, inside + cell, inside)
        inside = np.sort(inside[(inside > self._tolerance) & (inside < cell - self._tolerance)])
        apart = np.append(True, np.diff(inside) > self._tolerance)[: inside.size]
        return np.concatenate([[0.0], inside[apart], [cell]])

    def _values(self, cell: float, edges: Array, count: int) -> Array:
        """Functions of time (ncells, nparts, nodes, ncolumns) at the nodes."""
        nodes = np.array([points(_NODES - 1, left, right) for left, right in pairwise(edges.tolist())])
        times = self._first + cell * np.arange(count)[:, None, None] + nodes
        found = signal_values(self._signals, times.ravel())
        return np.asarray(found.T.reshape(*times.shape, self._given.size))

    def _run(self, values: Array, state: Array, last: float) -> None:
        form, nparts = self._form, self._edges.size - 1
        parts = [self._part(length) for length in np.diff(self._edges).tolist()]
        count, n, width = len(values), form.a.shape[0], self._delayed.size
        known = n + _NODES * width
        hops = [round(late.delay / self._cell) for late in form.lates]
        before = np.concatenate([np.zeros(0), *(late.initial for late in form.lates)])
        ends = np.cumsum([0, *(late.initial.size for late in form.lates)]).tolist()
        stored = np.empty((count, nparts, _NODES, width))
        inputs = np.empty((count, nparts, known))
        steps = [np.concatenate([part.end, part.stored]) for part in parts]
        given = values.reshape(count, nparts, _NODES * self._given.size)
        forced = np.stack([given[:, j] @ step[:, known:].T for j, step in enumerate(steps)], axis=1)
        maps = [np.ascontiguousarray(step[:, :known]) for step in steps]
        jumps, left = self._jumps(), _start()
        with np.errstate(all="ignore"):
            for k in range(count):
                for j in range(nparts):
                    own = inputs[k, j]
                    own[:n] = state
                    back = own[n:].reshape(_NODES, width)
                    for hop, begin, end in zip(hops, ends[:-1], ends[1:], strict=True):
                        back[:, begin:end] = stored[k - hop, j, :, begin:end] if k >= hop else before[begin:end]
                    jump = jumps.get(k * nparts + j)
                    if jump is not None:
                        own[:n] = jump[0] @ state + (jump[1] @ (left @ back) + jump[2])
                    after = maps[j].dot(own)
                    after += forced[k, j]
                    state = after[:n]
                    stored[k, j] = after[n:].reshape(_NODES, width)
            states = np.stack(
                [
                    inputs[:, j] @ part.states[:, :known].T + given[:, j] @ part.states[:, known:].T
                    for j, part in enumerate(parts)
                ],
                axis=1,
            ).reshape(count, nparts, _NODES, n)
        if not (np.isfinite(states).all() and np.isfinite(stored).all()):
            bad = ~np.isfinite(states).all(axis=(1, 2, 3)) | ~np.isfinite(stored).all(axis=(1, 2, 3))
            at = self._first + self._cell * int(bad.argmax())
            raise SolverError(
                f"states of {form.base.name} must stay finite up to {last:g} s, got an overflow at {at:g} s"
            )
        self._states, self._stored = _to_series(states), _to_series(stored)

    def _jumps(self) -> dict[int, tuple[Array, Array, Array]]:
        """Jumps at the starts of parts: matrices from states and delayed values, and a constant."""
        form, found = self._form, dict[int, tuple[Array, Array, Array]]()
        due = np.flatnonzero(self._due)
        values = values_after(self._signals, self.instants[due], self._tolerance)
        places = np.searchsorted(self._starts.ravel(), self.instants[due] - self._first + self._tolerance) - 1
        for place, k, w in zip(places.tolist(), due.tolist(), values.T, strict=True):
            jump, given = form.base.jump(int(self._due[k]))
            found[place] = jump, given[:, self._delayed], given[:, self._given] @ w
        return found

    def _part(self, length: float) -> _Part:
        """Maps of a part of a length [s]."""
        form, n = self._form, self._form.a.shape[0]
        integrals, whole = _integrals()
        scale = state_scale(form.a)
        a, b = form.a * (scale / scale[:, None]), form.b / scale[:, None]
        columns = np.concatenate([self._delayed, self._given])
        total = n + _NODES * columns.size
        inputs = np.zeros((_NODES, n, total))
        fed = np.zeros((_NODES, n, _NODES, columns.size))
        fed[np.arange(_NODES), :, np.arange(_NODES)] = b[:, columns]
        # Delayed values of all nodes come first, then functions of time of all nodes.
        width = self._delayed.size
        order = np.arange(_NODES * columns.size).reshape(_NODES, columns.size)
        order = n + np.concatenate([order[:, :width].ravel(), order[:, width:].ravel()])
        inputs[:, :, n:] = fed.reshape(_NODES, n, total - n)
        forced = length * np.einsum("ij,jnc->inc", integrals, inputs)
        forced[:, :, :n] += np.diag(1.0 / scale)
        closing = np.eye(_NODES * n) - length * np.kron(integrals, a)
        states = np.linalg.solve(closing, forced.reshape(_NODES * n, total)).reshape(_NODES, n, total)
        end = length * np.einsum("j,jnc->nc", whole, a @ states + inputs)
        end[:, :n] += np.diag(1.0 / scale)
        states *= scale[:, None]
        from_x = np.concatenate([late.from_z for late in form.lates])
        from_w = np.concatenate([late.from_w for late in form.lates])[:, columns]
        stored = from_x @ states
        direct = np.zeros((_NODES, len(from_w), _NODES, columns.size))
        direct[np.arange(_NODES), :, np.arange(_NODES)] = from_w
        stored[:, :, n:] += direct.reshape(_NODES, len(from_w), total - n)
        found = (
            matrix.reshape(math.prod(matrix.shape[:-1]), total) for matrix in (states, scale[:, None] * end, stored)
        )
        keep = np.concatenate([np.arange(n), order])
        return _Part(*(matrix[:, keep] for matrix in found))

    def _evaluated(self, coefficients: Array, since: Array) -> Array:
        """Values (nrows, ntime) of series (ncells, nparts, nodes, nrows) at times [s] since the start."""
        count, nparts = coefficients.shape[:2]
        place = np.clip(np.searchsorted(self._starts.ravel(), since + self._tolerance, side="right") - 1, 0, None)
        place = np.minimum(place, count * nparts - 1)
        lengths = np.diff(self._edges)[place % nparts]
        x = np.clip(2.0 * (since - self._starts.ravel()[place]) / lengths - 1.0, -1.0, 1.0)
        basis = np.cos(np.arange(_NODES) * np.arccos(x)[:, None])
        chosen = coefficients.reshape(count * nparts, _NODES, coefficients.shape[-1])[place]
        return np.asarray(np.einsum("tjn,tj->nt", chosen, basis))


@lru_cache(maxsize=1)
def _start() -> Array:
    """Value of the interpolant at the start of a part, from those at its nodes."""
    return np.where(np.arange(_NODES) % 2, -1.0, 1.0) @ transform(np.eye(_NODES)).T


@lru_cache(maxsize=1)
def _integrals() -> tuple[Array, Array]:
    """Integrals of the interpolant from the start of a part of unit length to its nodes, and over all of it."""
    coefficients = 0.5 * series.chebint(transform(np.eye(_NODES)).T, lbnd=-1.0, axis=0)
    nodes = points(_NODES - 1, -1.0, 1.0)
    return series.chebvander(nodes, _NODES) @ coefficients, np.asarray(coefficients.sum(axis=0))


def _resolved(values: Array, noise: float) -> bool:
    """Whether the functions of time are resolved by their values at the nodes, to rounding errors of a given size."""
    found = np.abs(np.einsum("fj,kpfm->jkpm", transform(np.eye(_NODES)), values)).max(axis=(1, 2), initial=0.0)
    size = np.where(found.max(axis=0, initial=0.0) > 0.0, found.max(axis=0, initial=0.0), 1.0)
    last, middle = (found[part] / size for part in (slice(-2, None), slice(_NODES // 2, -2)))
    flat = last.max(axis=0, initial=0.0) > 0.1 * middle.max(axis=0, initial=0.0)
    small = last.max(axis=0, initial=0.0)
    return bool(np.all((small <= _RESOLVED) | (flat & (small <= noise))))


def _to_series(values: Array) -> Array:
    """Chebyshev series of values (..., nodes, nrows)."""
    return np.einsum("fj,kpfm->kpjm", transform(np.eye(_NODES)), values)
