"""Irredundant inequalities among many."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ctrlplan._types import Array
from ctrlplan.systems.output_cells import Problem

_PROVEN = 1e-11
"""Relative residual of a proof that a row is redundant."""

_NEAR = 24
"""Rows added to a proof per iteration."""

_ATTEMPTS = 50
"""Maximum number of iterations of a proof."""

_PROOFS = 24
"""Number of stored proofs that are tried on other rows."""

_NEIGHBOURS = 64
"""Number of following rows on which a new proof is tried."""

_Proof: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Rows whose nonnegative combinations prove others redundant, and the pseudoinverse that gives the factors."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Inequalities state @ z + reference @ v <= bound in the deviation z of the state from steady state."""

    state: Array
    reference: Array
    bound: Array


class Polytope:
    """Irredundant rows, each with a bound on z and v; and proofs that other rows are redundant.

    A row is redundant if it is a nonnegative combination of the irredundant
    ones (Farkas' lemma). The factors are found by nonnegative least squares,
    about twenty times faster than by a linear program of this size.
    """

    def __init__(self, problem: Problem, seen: Array, spare: float) -> None:
        self._gain, self._seen, self._spare = problem.gain, seen, spare
        u, s, _ = np.linalg.svd(problem.gain, full_matrices=False)
        self._steady = u[:, s > 1e-12 * s.max(initial=0.0)]  # basis of the steady-state outputs
        # Bounds are measured from the steady-state outputs closest to the midpoint of the limits.
        self._centre = self._steady @ (self._steady.T @ problem.middle)
        self._columns = np.zeros((seen.shape[1] + self._steady.shape[1] + 1, 0))
        self._columns = self._column(np.zeros((1, len(seen))), np.zeros((1, len(self._gain))), np.ones(1))
        self._rows: list[tuple[Array, Array, float, float]] = []
        self._proofs: list[_Proof] = []

    def add(self, rows: Array, low: Array, high: Array, ends: Array) -> None:
        """Add the irredundant inequalities of low <= rows @ z + gain @ v <= high.

        Rows have shape (noutputs, ntime, nstates), limits (noutputs, ntime);
        `ends` are the end times of their cells. Rows of time 0 are not tightened.
        """
        p, count, n = rows.shape
        outputs = np.repeat(np.eye(p), count, axis=0)
        state = np.concatenate([rows, -rows]).reshape(2 * p * count, n)
        output, bound = np.concatenate([outputs, -outputs]), np.concatenate([high, -low]).ravel()
        spared = bound - np.tile(np.where(ends > 0.0, self._spare, 0.0), 2 * p)
        columns, tightened = self._column(state, output, bound), self._column(state, output, spared)
        left = np.arange(bound.size)
        for known in self._proofs:
            left = left[_unproven(known, columns[:, left])]
        self._proofs = []
        while left.size:
            k, left = int(left[0]), left[1:]
            proof = self._proof(columns[:, k])
            if proof is not None:
                self._proofs = [proof, *self._proofs[: _PROOFS - 1]]
                # The next rows belong to the same output and nearly the same time.
                near, far = left[:_NEIGHBOURS], left[_NEIGHBOURS:]
                left = np.concatenate([near[_unproven(proof, columns[:, near])], far])
                continue
            self._rows.append((state[k], output[k], float(spared[k]), float(ends[k % count])))
            self._columns = np.hstack([self._columns, tightened[:, [k]]])

    def reduced(self) -> tuple[Rows, float]:
        """Irredundant rows, and the last time [s] that they constrain."""
        needed = []
        for k, row in enumerate(self._rows):
            column = self._columns[:, k + 1].copy()
            self._columns[:, k + 1] = 0.0
            if self._proof(column) is None:
                self._columns[:, k + 1] = column
                needed.append(row)
        state = np.array([row[0] for row in needed]).reshape(len(needed), len(self._seen))
        output = np.array([row[1] for row in needed]).reshape(len(needed), len(self._gain))
        bound = np.array([row[2] for row in needed])
        return Rows(state, output @ self._gain, bound), max([row[3] for row in needed], default=0.0)

    def _column(self, state: Array, output: Array, bound: Array) -> Array:
        """Rows as columns (coordinates and bound) of unit norm."""
        found = np.vstack([(state @ self._seen).T, (output @ self._steady).T, bound - output @ self._centre])
        return np.asarray(found / np.linalg.norm(found, axis=0))

    def _proof(self, column: Array) -> _Proof | None:
        """Stored columns of which a column is a nonnegative combination; near ones first, more as required."""
        every, missed = self._columns, column
        near = np.empty(0, dtype=np.intp)
        for _ in range(_ATTEMPTS):
            gain = missed @ every
            if gain.max() <= _PROVEN * np.linalg.norm(missed):
                return None
            new = np.argpartition(gain, -_NEAR)[-_NEAR:] if gain.size > _NEAR else np.arange(gain.size)
            near = np.union1d(near, new)
            try:
                factors, residual = nnls(every[:, near], column)
            except (RuntimeError, np.linalg.LinAlgError):
                return None
            used = factors > 0.0
            near, generators = near[used], every[:, near[used]]
            missed = column - generators @ factors[used]
            if residual <= _PROVEN:
                return generators, np.linalg.pinv(generators)
        return None  # not proven: the row counts as irredundant


def _unproven(proof: _Proof, columns: Array) -> NDArray[np.bool_]:
    """Columns that are not a nonnegative combination of those of a proof."""
    generators, inverse = proof
    missed = columns - generators @ np.maximum(inverse @ columns, 0.0)
    return np.einsum("ij,ij->j", missed, missed) > _PROVEN**2
