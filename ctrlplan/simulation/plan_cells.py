"""Taylor polynomials of a plan in units of its duration.

A plan of fixed shape and any duration is one function of tau = (t - start)/duration.
Responses for many durations evaluate its derivatives at many times; from stored
polynomials this is a matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import binom

from ctrlplan._types import Array
from ctrlplan.simulation.analytic_segments import taylor_cells
from ctrlplan.trajectories import Trajectory

_TERMS = 26
"""Number of Taylor terms that are stored, in addition to the highest derivative."""

_FACTORIALS = np.cumprod(np.concatenate([[1.0], np.arange(1.0, 80.0)]))


@dataclass(frozen=True, eq=False)
class Segment:
    """Taylor polynomials of one analytic segment of a plan.

    Attributes
    ----------
    left, length : float
        Start and length in units of the duration of the plan.
    terms : ndarray, shape (nterms, naxes, ncells)
        Taylor terms at the starts of equal cells, in units of the length of a
        cell; they are accurate up to the end of the following cell.
    """

    left: float
    length: float
    terms: Array

    @property
    def cell(self) -> float:
        """Length of a cell in units of the duration of the plan."""
        return self.length / self.terms.shape[2]

    def series(self, s: Array, unit: float, nterms: int) -> Array:
        """Taylor terms (nterms, naxes, ntime) at times s since the start, in a unit of time."""
        count, _, ncells = self.terms.shape
        where = np.clip((s / self.cell).astype(np.intp), 0, ncells - 1)
        sigma, which = np.unique(s / self.cell - where, return_inverse=True)
        high = min(count, nterms)
        later = np.arange(count) - np.arange(high)[:, None]
        powers = np.where(later >= 0, sigma[:, None, None] ** np.maximum(later, 0), 0.0)
        shift = binom(np.arange(count), np.arange(high)[:, None]) * powers
        found = np.zeros((nterms, self.terms.shape[1], s.size))
        ratio = (unit / self.cell) ** np.arange(high)
        moved = np.matmul(shift[which], self.terms[:, :, where].transpose(2, 0, 1))  # (ntime, high, naxes)
        found[:high] = moved.transpose(1, 2, 0) * ratio[:, None, None]
        return found

    def jet(self, s: Array, order: int, derivatives: int) -> Array:
        """Jets (order + 1, naxes (derivatives + 1), ntime) of the position, then of each derivative."""
        found = self.series(s, 1.0, order + derivatives + 1)
        found *= _FACTORIALS[: order + derivatives + 1, None, None]
        return np.concatenate([found[k : k + order + 1] for k in range(derivatives + 1)], axis=1)


class PlanCells:
    """Taylor polynomials of a plan in units of its duration, segment by segment.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    order : int
        Highest derivative for which the polynomials are accurate.

    Attributes
    ----------
    segments : list of Segment
        The segments, in order.
    edges : ndarray, shape (nsegments + 1,)
        Their ends, from 0 to 1.
    initial, final : ndarray, shape (naxes,)
        Positions before the start and after the end.
    """

    def __init__(self, plan: Trajectory, order: int) -> None:
        self.order, self.naxes = order, plan.naxes
        self.initial, self.final = plan.initial, plan.final
        self.edges: Array = (plan.breakpoints - plan.start) / plan.duration
        self.edges[-1] = 1.0
        self.segments = [self._segment(plan, k) for k in range(self.edges.size - 1)]

    def _segment(self, plan: Trajectory, segment: int) -> Segment:
        left, right = self.edges[segment : segment + 2].tolist()
        length = right - left
        count = _TERMS + self.order

        def jet(s: Array, order: int) -> Array:
            found = plan.segment_jet(segment, s * plan.duration, order)
            return np.asarray(found * plan.duration ** np.arange(order + 1)[:, None, None])

        def jets(s: Array, order: int) -> Array:
            found = jet(s, order + self.order)
            return np.concatenate([found[k : k + order + 1] for k in range(self.order + 1)], axis=1)

        ncells = 2 * taylor_cells(jets, length)[0]  # the next cell is included in the range of each polynomial
        cell = length / ncells
        found = jet(cell * np.arange(ncells), count - 1)
        terms = found * (cell ** np.arange(count) / _FACTORIALS[:count])[:, None, None]
        used = int(np.flatnonzero(np.abs(terms).reshape(count, -1).any(axis=1)).max(initial=0)) + 1
        return Segment(left, length, terms[:used])

    def jump(self, order: int) -> Array:
        """Jumps (naxes, nsegments + 1) of a derivative at the ends of the segments, rounding removed."""
        before = [np.zeros(self.naxes) if order else self.initial]
        after = []
        for segment in self.segments:
            ends = segment.series(np.array([0.0, segment.length]), 1.0, order + 1)[order] * _FACTORIALS[order]
            after.append(ends[:, 0])
            before.append(ends[:, 1])
        after.append(np.zeros(self.naxes) if order else self.final)
        found = np.array(after) - np.array(before)
        size = self.peak(order) if order else np.maximum(np.ptp(np.array(after + before), axis=0), self.peak(0) * 1e-7)
        found[np.abs(found) <= 1e-9 * size] = 0.0
        return found.T

    def peak(self, order: int) -> Array:
        """Bound (naxes,) of the magnitude of a derivative over the plan, tight to a few percent."""
        fractions = np.linspace(0.0, 1.0, 65)
        found = np.zeros(self.naxes)
        for segment in self.segments:
            count = segment.terms.shape[0]
            if order >= count:
                continue
            j = np.arange(order, count)
            factor = _FACTORIALS[j] / _FACTORIALS[j - order] / segment.cell**order
            own = segment.terms[order:] * factor[:, None, None]
            i = np.arange(len(own))
            values = np.abs(np.tensordot(fractions[:, None] ** i, own, axes=1)).max(axis=(0, 2))
            bend = np.abs(own * (i * (i - 1.0))[:, None, None]).sum(axis=0).max(axis=1)
            found = np.maximum(found, values + bend / (8.0 * 64.0**2))
        return found
