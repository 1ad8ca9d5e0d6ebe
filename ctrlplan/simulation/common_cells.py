"""Loops with delays in cells of a length that divides every delay.

What a delay returns in a cell is what it stored in an earlier one, at the same nodes.
Breakpoints of the functions of time, which return after each delay, divide every cell
at the same places. Discrete blocks are sampled at the starts of parts of cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.collocation import NODES, REACH, is_resolved, value_at_start
from ctrlplan.simulation.delayed_run import PARTS, DelayedRun, Parts
from ctrlplan.simulation.segments import as_fraction
from ctrlplan.simulation.signals import breakpoints_of
from ctrlplan.trajectories.chebyshev import points

_HALVINGS = 40
"""Maximum number of times by which a cell is halved."""


@dataclass(frozen=True, eq=False)
class CommonCells:
    """Cells of a run.

    Attributes
    ----------
    cell : float
        Length of a cell [s].
    edges : ndarray, shape (nparts + 1,)
        Edges of the parts of a cell [s].
    ncells : int
        Number of cells.
    """

    cell: float
    edges: Array
    ncells: int

    @classmethod
    def of(cls, run: DelayedRun) -> Iterator[CommonCells]:
        """Cells that resolve the states of a run, each half as long as those before; at most `PARTS` parts."""
        form = run.form
        repeating = [as_fraction(late.delay) for late in form.lates] + [period for period, _ in form.base.timings]
        den = math.lcm(*(time.denominator for time in repeating))
        common = Fraction(math.gcd(*(int(time * den) for time in repeating)), den)
        end = run.last + float(common)  # the run ends within the last cell
        marks = np.array([t for t in breakpoints_of(run.signals, run.first, end) if run.first < t < end])
        marks = np.append(marks - run.first, [float(offset) for _, offset in form.base.timings])
        for halving in range(_HALVINGS):
            cell = float(common / 2**halving)
            if not run.span + run.tolerance < cell * PARTS:
                return
            count = math.floor((run.span + run.tolerance) / cell) + 1
            found = cls(cell, _edges_of(marks, cell, run.tolerance), count)
            if found.count > PARTS:
                return
            if form.norm * cell <= REACH:
                yield found

    @property
    def count(self) -> int:
        """Number of parts of all cells."""
        return self.ncells * (self.edges.size - 1)

    def values(self, run: DelayedRun) -> Array | None:
        """Functions of time (ncells, nparts, nodes, ngiven) at the nodes; None if they are not resolved."""
        nodes = np.array([points(NODES - 1, left, right) for left, right in pairwise(self.edges.tolist())])
        found = run.values(self.cell * np.arange(self.ncells)[:, None, None] + nodes)
        return found if is_resolved(found, run.noise(self.cell)) else None

    def solved(self, run: DelayedRun, values: Array) -> Parts:
        """States and inputs of the delays, for values of the functions of time.

        Raises
        ------
        SolverError
            If a state overflows.
        """
        count, nparts, n, width = self.ncells, self.edges.size - 1, run.state.size, run.form.delayed.size
        starts = np.add.outer(self.cell * np.arange(count), self.edges[:-1]).ravel()
        lengths, known = np.diff(self.edges), run.form.collocation.known
        maps = run.form.collocation.maps(lengths, self.cell)
        given = values.reshape(count, nparts, -1)
        forced = np.stack([given[:, j] @ step[:, known:].T for j, step in enumerate(maps.steps)], axis=1)
        steps = [np.ascontiguousarray(step[:, :known]) for step in maps.steps]
        returns = [
            (round(late.delay / self.cell), late.initial, rows)
            for late, rows in zip(run.form.lates, run.form.rows, strict=True)
        ]
        stored, inputs = np.empty((count, nparts, NODES, width)), np.empty((count, nparts, known))
        jumps, left, state = run.jumps(starts), value_at_start(), run.state
        with np.errstate(all="ignore"):
            for k in range(count):
                for j in range(nparts):
                    own = inputs[k, j]
                    own[:n] = state
                    back = own[n:].reshape(NODES, width)
                    for hop, initial, rows in returns:
                        back[:, rows] = stored[k - hop, j, :, rows] if k >= hop else initial
                    jump = jumps.get(k * nparts + j)
                    if jump is not None:
                        own[:n] = jump[0] @ state + (jump[1] @ (left @ back) + jump[2])
                    after = steps[j].dot(own)
                    after += forced[k, j]
                    state = own[:n] + after[:n]
                    stored[k, j] = after[n:].reshape(NODES, width)
            states = np.stack(
                [inputs[:, j] @ own[:, :known].T + given[:, j] @ own[:, known:].T for j, own in enumerate(maps.states)],
                axis=1,
            )
        return Parts.of(
            run,
            starts,
            np.tile(lengths, count),
            states.reshape(count * nparts, NODES, n),
            stored.reshape(count * nparts, NODES, width),
        )


def _edges_of(marks: Array, cell: float, tolerance: float) -> Array:
    """Edges of the parts of a cell."""
    inside = np.sort(marks - cell * np.round(marks / cell))
    inside = np.where(inside < 0.0, inside + cell, inside)
    inside = np.sort(inside[(inside > tolerance) & (inside < cell - tolerance)])
    apart = np.append(True, np.diff(inside) > tolerance)[: inside.size]
    return np.concatenate([[0.0], inside[apart], [cell]])
