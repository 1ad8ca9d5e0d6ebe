"""Cells of the parts of a path, and the spline of the squared rate on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ctrlplan.planning.path_law.bernstein import bernstein
from ctrlplan.planning.path_law.spans import Part
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array, readonly

_SHORT, _GROWTH = 1e-5, 0.35
"""Duration of the cell at a point of rest relative to its span, and the increase of lengths per length."""

_REGULAR, _SHORT_SMOOTH = 0.03, 3e-3
"""The same with limits of the jerk, where the squared rate is regular at a point of rest, and elsewhere."""

_BEND = 0.25
"""Length of a cell relative to the time in which the plan's speed changes by its acceleration."""

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
    def of(cls, plan: Trajectory, parts: Sequence[Part], smooth: bool = False) -> Grid:
        """Initial cells, short at points of rest, for laws whose acceleration or, if `smooth`, jerk is limited."""
        spans = [(k, span) for k, part in enumerate(parts) for span in part.spans]
        count = max(_PER_SPAN, -(-_CELLS // len(spans)))
        shortest = np.concatenate([_shortest(part, count, smooth) for part in parts]).tolist()
        edges = [
            span.start + span.length * _fractions(count, *pair) for (_, span), pair in zip(spans, shortest, strict=True)
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
    def joints(self) -> tuple[Array, Array]:
        """Ratios and bends of the plan from each cell to the next one."""
        last = np.diff(self.span, append=-1) != 0
        ratios, bends = np.ones(self.span.size), np.zeros(self.span.size)
        ratios[last] = [ratio for part in self.parts for ratio in part.ratios]
        bends[last] = [bend for part in self.parts for bend in part.bends]
        return ratios, bends

    @cached_property
    def rests(self) -> NDArray[np.bool_]:
        """Whether cells begin and end (2, ncells) at points of rest."""
        found = np.zeros((2, self.length.size), dtype=bool)
        first = np.flatnonzero(np.diff(self.part, prepend=-1))
        last = np.append(first[1:], self.part.size) - 1
        found[0, first] = [part.spans[0].rests[0] > 0.0 for part in self.parts]
        found[1, last] = [part.spans[-1].rests[1] > 0.0 for part in self.parts]
        return found

    @property
    def prescribed(self) -> Array:
        """Prescribed squared rates of all open parts, at the start and at the end of each."""
        return np.array([rate for part in self.parts for rate in part.rates if rate is not None], dtype=float)

    def ends(self, moving: bool) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Cells that begin, and those that end, with a prescribed rate, in motion or at rest."""
        first = np.flatnonzero(np.diff(self.part, prepend=-1))
        last = np.append(first[1:], self.part.size) - 1
        chosen = np.array([[rate is not None and (rate > 0.0) == moving for rate in part.rates] for part in self.parts])
        return first[chosen[:, 0]], last[chosen[:, 1]]

    def jets(self, fractions: Array, order: int) -> Array:
        """Derivatives 1 to an order of the plan (order, naxes, npoints, ncells) at points of each cell."""
        times = self.start[:, None] + self.length[:, None] * fractions
        found = self.plan.segments_jet(np.repeat(self.segment, fractions.size), times.ravel(), order)[1:]
        return found.reshape(order, self.plan.naxes, self.start.size, fractions.size).transpose(0, 1, 3, 2)

    def times(self, fractions: Array) -> Array:
        """Times of the plan [s] (npoints, ncells)."""
        return self.plan.breakpoints[self.segment] + self.start + self.length * fractions[:, None]


def _shortest(part: Part, count: int, smooth: bool) -> Array:
    """Lengths (nspans, 2) of the first and last cell of each span, relative to the span."""
    lengths = np.array([span.length for span in part.spans])
    powers = np.array([span.rests for span in part.spans])
    # With constant acceleration or jerk from rest, plan times are times to the power 2/(power + 1) or 3/(power + 1).
    if smooth:
        found = np.where(np.rint(powers) == 2.0, _REGULAR, _SHORT_SMOOTH ** (3.0 / (np.maximum(powers, 2.0) + 1.0)))
    else:
        found = _SHORT ** (2.0 / (np.maximum(powers, 2.0) + 1.0))
    found = np.where(powers > 0.0, np.minimum(found, 1.0 / count), 1.0 / count)
    with np.errstate(divide="ignore", over="ignore"):
        bends = _BEND / np.abs(part.bends)
        found[:, 1] = np.minimum(found[:, 1], bends / lengths)
        following = np.roll(bends / np.array(part.ratios), 1)  # in the time of the next span
        found[:, 0] = np.minimum(found[:, 0], following / lengths)
    return 2.0 ** (0.5 * np.floor(2.0 * np.log2(np.maximum(found, _SHORT))))


@lru_cache(maxsize=64)
def _fractions(count: int, first: float, last: float) -> Array:
    """Edges of the cells of a span, from 0 to 1, for the lengths of the first and last cell."""
    fine = np.geomspace(1e-4, 0.5, 200)
    u = np.concatenate([[0.0], fine, 1.0 - fine[-2::-1], [1.0]])
    size = np.minimum(1.0 / count, np.minimum(first + _GROWTH * u, last + _GROWTH * (1.0 - u)))
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
    index : ndarray of int, shape (degree + 1, ncells)
        Coefficients of each cell.
    bernstein : ndarray, shape (degree + 1, degree + 1, ncells)
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
    def quartic(cls, grid: Grid) -> Spline:
        """Spline with three continuous derivatives in each part, by the coefficients of B-splines."""
        index, knots = np.empty((5, grid.length.size), dtype=np.intp), np.empty((8, grid.length.size))
        size, bandwidth, fixed = 0, 4, []
        firsts = np.flatnonzero(np.diff(grid.part, prepend=-1)).tolist()
        for part, begin, end in zip(grid.parts, firsts, [*firsts[1:], grid.length.size], strict=True):
            cells, count, own = np.arange(end - begin), end - begin, slice(begin, end)
            steps = grid.length[own]
            beyond = np.resize(steps, 4) if part.closed else np.zeros(4)
            before = np.resize(steps[::-1], 4)[::-1] if part.closed else np.zeros(4)
            of_part = np.cumsum(np.concatenate([[0.0], before, steps, beyond])) - before.sum()
            knots[:, own] = of_part[1 + cells + np.arange(8)[:, None]]
            index[:, own] = cells + np.arange(5)[:, None]
            if part.closed:
                index[:, own], bandwidth = _interleaved(count)[(index[:, own] - 2) % count], 8
            index[:, own] += size
            size += count if part.closed else count + 4
            prescribed = [rate is not None for rate in part.rates]
            fixed += [False] * count if part.closed else [prescribed[0], *[False] * (count + 2), prescribed[1]]
        return cls(index, _extraction(knots), size, bandwidth, np.array(fixed))

    @classmethod
    def of(cls, grid: Grid) -> Spline:
        """Quadratic spline with a continuous derivative in each part."""
        h, ratios, bends = grid.length, *grid.joints
        index, extraction = np.empty((3, h.size), dtype=np.intp), np.zeros((3, 3, h.size))
        extraction[1, 1] = 1.0
        size, bandwidth, fixed = 0, 2, []
        firsts = np.flatnonzero(np.diff(grid.part, prepend=-1)).tolist()
        for part, begin, end in zip(grid.parts, firsts, [*firsts[1:], h.size], strict=True):
            cells, count, own = np.arange(end - begin), end - begin, slice(begin, end)
            # b and its slope along the path, 2 (x - b)/h on both sides, are continuous, with the speed of the plan.
            before, after = 1.0 / h[own], ratios[own] / np.roll(h[own], -1)
            total = before + after - np.minimum(bends[own], 0.5 * (before + after))
            extraction[2, 1, own], extraction[2, 2, own] = before / total, after / ratios[own] ** 2 / total
            extraction[0, 0, own] = np.roll(extraction[2, 1, own] * ratios[own] ** 2, 1)
            extraction[0, 1, own] = np.roll(extraction[2, 2, own] * ratios[own] ** 2, 1)
            if part.closed:
                index[:, own] = size + _interleaved(count)[(cells + np.arange(-1, 2)[:, None]) % count]
                size, bandwidth = size + count, 4
                fixed += [False] * count
                continue
            index[:, own] = size + cells + np.arange(3)[:, None]
            extraction[0, :2, begin] = 1.0, 0.0
            extraction[2, 1:, end - 1] = 0.0, 1.0
            size += count + 2
            fixed += [part.rates[0] is not None, *[False] * count, part.rates[1] is not None]
        return cls(index, extraction, size, bandwidth, np.array(fixed))

    def coefficients(self, x: Array) -> Array:
        """Bernstein coefficients (degree + 1, ncells) of each cell."""
        return np.einsum("bmc,mc->bc", self.bernstein, x[self.index])

    def near(self, local: Array) -> Array:
        """Coefficients of a spline near given Bernstein coefficients: least squares in each cell, and their means."""
        own = np.linalg.solve(self.bernstein.transpose(2, 0, 1), local.T[:, :, None])[:, :, 0].T
        counts = np.bincount(self.index.ravel(), minlength=self.size)
        return np.bincount(self.index.ravel(), own.ravel(), self.size) / counts

    def rows(self, local: Array) -> Array:
        """Rows (size, nrows, ncells) of the spline, from those (nrows, ncells, size) for Bernstein coefficients."""
        return np.einsum("rcb,bmc->mrc", local, self.bernstein)


def _extraction(knots: Array) -> Array:
    """Bernstein coefficients (degree + 1, degree + 1, ncells) of the B-splines on each cell, in this order of axes.

    Parameters
    ----------
    knots : ndarray, shape (2 degree, ncells)
        Those of the B-splines on a cell; the two in the middle are its ends.
    """
    degree = len(knots) // 2
    points = np.linspace(0.0, 1.0, degree + 1)
    x = knots[degree - 1] + points[:, None] * (knots[degree] - knots[degree - 1])
    values = np.zeros((degree + 1, *x.shape))  # by B-spline and point
    values[0] = 1.0
    for order in range(1, degree + 1):  # the recursion of Cox and de Boor
        carried = np.zeros_like(x)
        for k in range(order):
            left, right = knots[degree + k - order], knots[degree + k]
            share = values[k] / (right - left)
            values[k] = carried + (right - x) * share
            carried = (x - left) * share
        values[order] = carried
    own: Array = np.einsum("bp,mpc->bmc", np.linalg.inv(bernstein(points, degree)), values)
    return own


def _interleaved(count: int) -> NDArray[np.intp]:
    """Positions of the unknowns of a closed part, 0, N - 1, 1, N - 2, ..., with which equations are banded."""
    order = np.empty(count, dtype=np.intp)
    half = (count + 1) // 2
    order[0::2] = np.arange(half)
    order[1::2] = np.arange(count - 1, half - 1, -1)
    position = np.empty(count, dtype=np.intp)
    position[order] = np.arange(count)
    return position
