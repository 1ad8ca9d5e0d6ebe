"""Bounds of the impulse responses of a loop, and of the response as a function of the duration of a plan."""

from __future__ import annotations

from math import factorial

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.cell_extrema import envelope
from ctrlplan.simulation.exact_response import free_cells
from ctrlplan.simulation.loop_form import LoopForm, Rows
from ctrlplan.simulation.plan_cells import PlanCells

_PARTS = 32
"""Number of intervals of a cell in which an impulse response is bounded by a constant."""

_CELLS = 4000
"""Number of cells after which an impulse response is bounded by a constant."""

_NEGLIGIBLE = 1e-12
"""Magnitude of an impulse response, relative to its bound at 0, from which on it is bounded by a constant."""


class Envelope:
    """Bounds of the magnitudes of impulse responses c e^(A s) b, and moments of them.

    The part of the modes that decay is bounded by a function that does not
    increase, constant in each of many intervals, and that of the integrators by a
    polynomial.

    Parameters
    ----------
    form : LoopForm
        The loop.
    c : ndarray, shape (nrows, nstates)
        Output matrix.
    b : ndarray, shape (nstates, ncolumns)
        Input matrix.
    """

    def __init__(self, form: LoopForm, c: Array, b: Array) -> None:
        right, left, stable, stable_left = form.split
        self._shape = (len(c), b.shape[1])
        chain, powers = left @ b, []
        for _ in range(form.integrators):
            powers.append(np.abs(c @ right @ chain))
            chain = form.nilpotent @ chain
        self._polynomial = powers
        columns = stable @ (stable_left @ b)
        initial = rest = form.decay_bounds(c, columns).ravel()
        values, edges, count = [], [np.zeros(1)], 0
        ends = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, _PARTS + 1) / _PARTS)
        for cells, later in free_cells(form, c, columns):
            by = np.argsort(cells.starts)
            values.append(envelope(cells, _PARTS)[::-1][:, :, by].transpose(2, 0, 1).reshape(-1, rest.size))
            edges.append((cells.starts[by, None] + cells.lengths[by, None] * ends).ravel())
            rest, count = later, count + by.size
            if count >= _CELLS or np.all(rest <= _NEGLIGIBLE * initial):
                break
        table = np.concatenate([*values, rest[None]])
        self._values: Array = np.maximum.accumulate(table[::-1])[::-1]
        self._edges: Array = np.concatenate(edges)

    def moment(self, power: int, until: Array) -> Array:
        """Integrals (ntime, nrows, ncolumns) of the bound times s^power from 0 to times."""
        grown = self._edges ** (power + 1) / (power + 1)
        whole = np.concatenate([np.zeros((1, self._values.shape[1])), np.diff(grown)[:, None] * self._values[:-1]])
        which = np.searchsorted(self._edges, until, side="right") - 1
        own = until ** (power + 1) / (power + 1)
        found = np.cumsum(whole, axis=0)[which] + (own - grown[which])[:, None] * self._values[which]
        total = found.reshape(-1, *self._shape)
        for i, factor in enumerate(self._polynomial):
            own = until ** (i + power + 1) / (factorial(i) * (i + power + 1))
            total = total + own[:, None, None] * factor
        return np.asarray(total)

    def largest(self, power: int, until: Array) -> Array:
        """Bounds (ntime, nrows, ncolumns) of the bound times s^power up to times."""
        ends = np.append(self._edges[1:], np.inf)
        which = np.searchsorted(self._edges, until, side="right") - 1
        whole = self._values[:-1] * (ends[:-1] ** power)[:, None]
        before = np.maximum.accumulate(np.concatenate([np.zeros((1, whole.shape[1])), whole]), axis=0)
        found = np.maximum(before[which], self._values[which] * (until**power)[:, None])
        total = found.reshape(-1, *self._shape)
        for i, factor in enumerate(self._polynomial):
            total = total + (until ** (i + power) / factorial(i))[:, None, None] * factor
        return np.asarray(total)


class Curvature:
    """Bounds of the second derivative of a response by the logarithm of the duration of a plan.

    At a fixed fraction of the duration, and at a fixed time after the plan, an
    output is the convolution of an impulse response h with T^-k p^(k)(tau - s/T),
    whose second derivative by log T is
    T^-k (k^2 p^(k) + (2 k + 1) (s/T) p^(k+1) + (s/T)^2 p^(k+2)). Where a
    derivative of the plan jumps, the impulse in the next one gives the value of h
    instead of an integral.

    Parameters
    ----------
    form : LoopForm
        The loop.
    rows : Rows
        Outputs.
    plan : PlanCells
        The plan in units of its duration, accurate up to two derivatives more
        than the inputs.
    """

    def __init__(self, form: LoopForm, rows: Rows, plan: PlanCells) -> None:
        self._rows, self._orders, self._axes = rows, form.order + 1, form.naxes
        self._decays = not form.integrators
        columns = np.moveaxis(form.b, 0, 1).reshape(form.nstates, self._orders * self._axes)
        self.envelope = Envelope(form, rows.c, columns)
        self._peaks = np.array([plan.peak(k) for k in range(max(self._orders + 2, rows.order + 1))])
        self._jumps = np.array([np.abs(plan.jump(k)).sum(axis=1) for k in range(self._orders + 1)])
        jumps = self._jumps[: self._orders].any()
        self._rates = Envelope(form, rows.c @ form.a, columns) if jumps else None

    def __call__(self, low: Array, high: Array) -> Array:
        """Bounds (nintervals, nrows) for durations from low to high, shapes (nintervals,)."""
        shape = (low.size, len(self._rows.c), self._orders, self._axes)
        m0, m1, m2 = (self.envelope.moment(j, high).reshape(shape) for j in range(3))
        e1, e2 = (self.envelope.largest(j, high).reshape(shape) for j in (1, 2))
        r2 = None if self._rates is None else self._rates.largest(2, high).reshape(shape)
        found = np.zeros(shape[:2])
        for k in range(self._orders):
            t = low[:, None, None]
            terms = k**2 * self._peaks[k] * m0[:, :, k]
            terms = terms + (2 * k + 1) * self._peaks[k + 1] * m1[:, :, k] / t
            terms = terms + self._peaks[k + 2] * m2[:, :, k] / t**2
            terms = terms + self._jumps[k + 1] * e2[:, :, k] / t
            if r2 is not None:
                terms = terms + self._jumps[k] * ((2 * k + 3) * e1[:, :, k] + r2[:, :, k])
            found += (terms / t**k).sum(axis=2)
        for k in range(1, self._rows.order + 1):
            found += (k**2 * np.abs(self._rows.d[:, k]) @ self._peaks[k]) / low[:, None] ** k
        return found

    def from_static(self, durations: Array) -> Array:
        """Bounds (ndurations, nrows) of the distance from the static response to the plan; inf if there is none.

        The convolution of h with p(tau - s/T) - p(tau) is at most the first moment of h times the largest p'/T.
        """
        if not self._decays or self._jumps[0].any():
            return np.full((durations.size, len(self._rows.c)), np.inf)
        shape = (durations.size, len(self._rows.c), self._orders, self._axes)
        m0, m1 = (self.envelope.moment(j, durations).reshape(shape) for j in (0, 1))
        found = m1[:, :, 0] @ self._peaks[1] / durations[:, None]
        for k in range(1, max(self._orders, self._rows.order + 1)):
            size = np.abs(self._rows.d[:, k]) if k <= self._rows.order else np.zeros((shape[1], self._axes))
            if k < self._orders:
                size = size + m0[:, :, k]
            found = found + (size @ self._peaks[k]) / durations[:, None] ** k
        return np.asarray(found)
