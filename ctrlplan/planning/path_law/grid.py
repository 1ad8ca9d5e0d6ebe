"""Cells of the parts of a path, and the spline of the squared rate on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ctrlplan.planning.path_law.spans import Part
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array, readonly

_SHORT, _GROWTH = 1e-5, 0.35
"""Duration of the cell at a point of rest relative to its span, and the increase of lengths per length."""

_CELLS, _PER_SPAN = 64, 8
"""Minimum number of cells of a plan, and of a span, without those at points of rest."""


@dataclass(frozen=True)
class Grid:
    """Cells of all moving parts.

    The squared rate b = (ds/dt)^2 is quadratic in the path parameter s in each cell
    and has a continuous derivative in each part. The unknowns are the middle
    Bernstein coefficient of each cell, and both ends of an open part.

    Attributes
    ----------
    plan : Trajectory
        The plan.
    parts : tuple of Part
        Parts that move.
    part, span : ndarray of int, shape (ncells,)
        Part of each cell, and span, counted through all parts.
    start, length : ndarray, shape (ncells,)
        Beginning since the start of the segment, and length [s], in time of the plan.
    """

    plan: Trajectory
    parts: tuple[Part, ...]
    part: NDArray[np.intp]
    span: NDArray[np.intp]
    start: Array
    length: Array

    @classmethod
    def of(cls, plan: Trajectory, parts: Sequence[Part]) -> Grid:
        """Initial cells, short at points of rest."""
        spans = [(k, span) for k, part in enumerate(parts) for span in part.spans]
        count = max(_PER_SPAN, -(-_CELLS // len(spans)))
        edges = [
            span.start + span.length * _fractions(count, *(round(power, 1) for power in span.rests))
            for _, span in spans
        ]
        sizes = [own.size - 1 for own in edges]
        return cls(
            plan,
            tuple(parts),
            np.repeat([k for k, _ in spans], sizes),
            np.repeat(np.arange(len(spans)), sizes),
            np.concatenate([own[:-1] for own in edges]),
            np.concatenate([np.diff(own) for own in edges]),
        )

    def divided(self, counts: NDArray[np.intp]) -> Grid:
        """Grid with each cell divided in a number of equal ones."""
        cell = np.repeat(np.arange(counts.size), counts)
        length = (self.length / counts)[cell]
        since = np.arange(cell.size) - (np.cumsum(counts) - counts)[cell]
        return Grid(self.plan, self.parts, self.part[cell], self.span[cell], self.start[cell] + since * length, length)

    @cached_property
    def segment(self) -> NDArray[np.intp]:
        """Segment of the plan of each cell."""
        return np.array([span.segment for part in self.parts for span in part.spans])[self.span]

    @cached_property
    def sizes(self) -> Array:
        """Lengths of the cells by their unit of time."""
        return self.length / self.units

    @cached_property
    def halts(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Cells that begin, and those that end, at a corner at which the law stops."""
        first = np.flatnonzero(np.diff(self.part, prepend=-1))
        last = np.append(first[1:], self.part.size) - 1
        chosen = np.array([part.halts for part in self.parts])
        return first[chosen[:, 0]], last[chosen[:, 1]]

    @cached_property
    def units(self) -> Array:
        """Unit of time of each cell; lengths and derivatives by the unit join without jumps of the velocity."""
        return np.array([unit for part in self.parts for unit in part.units])[self.span]

    def jets(self, fractions: Array) -> Array:
        """Derivatives 1 and 2 of the plan (2, naxes, npoints, ncells), by the unit of time, at points of each cell."""
        times = self.start[:, None] + self.length[:, None] * fractions
        found = self.plan.segments_jet(np.repeat(self.segment, fractions.size), times.ravel(), 2)[1:]
        found = found.reshape(2, self.plan.naxes, self.start.size, fractions.size).transpose(0, 1, 3, 2)
        return np.stack([found[0] * self.units, found[1] * self.units**2])

    def times(self, fractions: Array) -> Array:
        """Times of the plan [s] (npoints, ncells)."""
        return self.plan.breakpoints[self.segment] + self.start + self.length * fractions[:, None]


@lru_cache(maxsize=64)
def _fractions(count: int, first: float, last: float) -> Array:
    """Edges of the cells of a span, from 0 to 1, for powers of the velocity at both ends."""
    fine = np.geomspace(1e-4, 0.5, 200)
    u = np.concatenate([[0.0], fine, 1.0 - fine[-2::-1], [1.0]])
    size = np.full(u.shape, 1.0 / count)
    for power, distance in ((first, u), (last, 1.0 - u)):
        if power:
            # With constant acceleration the distance is the time to the power 2/(power + 1).
            size = np.minimum(size, _SHORT ** (2.0 / (max(power, 2.0) + 1.0)) + _GROWTH * distance)
    passed = np.concatenate([[0.0], np.cumsum(np.diff(u) * 0.5 * (1.0 / size[1:] + 1.0 / size[:-1]))])
    cells = int(np.ceil(passed[-1]))
    edges = np.interp(np.linspace(0.0, passed[-1], cells + 1), passed, u)
    edges[0], edges[-1] = 0.0, 1.0
    return readonly(edges)


@dataclass(frozen=True)
class Spline:
    """Squared rates on a grid, as linear functions of their coefficients.

    Attributes
    ----------
    index : ndarray of int, shape (3, ncells)
        Coefficients of each cell.
    bernstein : ndarray, shape (3, 3, ncells)
        Bernstein coefficients of a cell (first axis) by these coefficients.
    size, bandwidth : int
        Number of coefficients, and bandwidth of their normal equations.
    fixed : ndarray of bool, shape (size,)
        Coefficients that are prescribed.
    """

    index: NDArray[np.intp]
    bernstein: Array
    size: int
    bandwidth: int
    fixed: NDArray[np.bool_]

    @classmethod
    def of(cls, grid: Grid) -> Spline:
        """Spline on a grid."""
        h = grid.sizes
        index, extraction = np.empty((3, h.size), dtype=np.intp), np.zeros((3, 3, h.size))
        extraction[1, 1] = 1.0
        size, bandwidth, fixed = 0, 2, []
        firsts = np.flatnonzero(np.diff(grid.part, prepend=-1)).tolist()
        for part, begin, end in zip(grid.parts, firsts, [*firsts[1:], h.size], strict=True):
            own, cells = h[begin:end], np.arange(end - begin)
            count = own.size
            before, after = np.roll(own, 1), np.roll(own, -1)
            extraction[0, 0, begin:end], extraction[0, 1, begin:end] = own / (before + own), before / (before + own)
            extraction[2, 1, begin:end], extraction[2, 2, begin:end] = after / (own + after), own / (own + after)
            if part.closed:
                index[:, begin:end] = size + _interleaved(count)[(cells + np.arange(-1, 2)[:, None]) % count]
                size, bandwidth = size + count, 4
                fixed += [False] * count
                continue
            index[:, begin:end] = size + cells + np.arange(3)[:, None]
            extraction[0, :2, begin] = 1.0, 0.0
            extraction[2, 1:, end - 1] = 0.0, 1.0
            size += count + 2
            fixed += [part.halts[0], *[False] * count, part.halts[1]]
        return cls(index, extraction, size, bandwidth, np.array(fixed))

    def coefficients(self, x: Array) -> Array:
        """Bernstein coefficients (3, ncells) of each cell."""
        return np.einsum("bmc,mc->bc", self.bernstein, x[self.index])

    def rows(self, local: Array) -> Array:
        """Rows (3, nrows, ncells) of the spline, from those (nrows, ncells, 3) for Bernstein coefficients."""
        return np.einsum("rcb,bmc->mrc", local, self.bernstein)


def _interleaved(count: int) -> NDArray[np.intp]:
    """Positions of the unknowns of a closed part, 0, N - 1, 1, N - 2, ..., with which equations are banded."""
    order = np.empty(count, dtype=np.intp)
    half = (count + 1) // 2
    order[0::2] = np.arange(half)
    order[1::2] = np.arange(count - 1, half - 1, -1)
    position = np.empty(count, dtype=np.intp)
    position[order] = np.arange(count)
    return position
