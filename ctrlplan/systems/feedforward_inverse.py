"""Inverse of a linear system: its normal form, with the zeros as poles of the internal dynamics.

Each output is differentiated until an input appears: y^(r) = c A^r x + e u. For a
discrete system the derivatives are samples ahead, y[k + r], and all else is equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import control as ct
import numpy as np
from scipy.linalg import null_space

from ctrlplan._types import Array

_SMALL = 1e-9
"""Relative size up to which numbers count as 0."""


@dataclass(frozen=True, eq=False)
class Inverse:
    r"""Inverse of x' = A x + B u, y = C x + D u.

    .. math:: \eta' = Z \eta + K Y, \quad u = C_\eta \eta + D_Y Y

    Y contains y, y', ..., y^(r) of each output, one output after the other.

    Attributes
    ----------
    orders : list of int
        Relative degree r of each output.
    z : ndarray, shape (nzeros, nzeros)
        Internal dynamics, whose eigenvalues are the invariant zeros.
    k, c, d : ndarray
        The other matrices of the inverse.
    states : ndarray, shape (nstates, nzeros)
        States of the system with all outputs 0.
    """

    orders: list[int]
    z: Array
    k: Array
    c: Array
    d: Array
    states: Array

    def held(self, matrix: Array, shift: float) -> Array:
        """Columns of `k` or `d` for constant outputs, one each.

        With differential equations (shift 0) their derivatives are 0, with difference
        equations (shift 1) their later samples are equal.
        """
        first = first_columns(self.orders)
        if not shift:
            return matrix[:, first]
        return np.add.reduceat(matrix, first, axis=1)


def first_columns(orders: Sequence[int]) -> list[int]:
    """First of the r + 1 columns of each output, for the order r of each."""
    return [sum(r + 1 for r in orders[:j]) for j in range(len(orders))]


def loop_inverse(loop: ct.StateSpace) -> Inverse:
    """Inverse of a loop with as many inputs as outputs.

    If the highest derivatives depend on fewer combinations of the inputs than there
    are outputs, these combinations are replaced by their derivatives, which become
    further states, until they do.

    Raises
    ------
    ValueError
        If the transfer function of an output is 0, or the system has no inverse.
    """
    a, b, c, d = (np.asarray(matrix, dtype=float) for matrix in (loop.A, loop.B, loop.C, loop.D))
    (n, m), names = b.shape, loop.output_labels
    from_states, from_inputs = np.zeros((m, n)), np.eye(m)
    while True:
        chains = _chains(a, b, c, d, names)
        influence = np.array([chain.influence for chain in chains])
        turn, count = _dependent(influence, names)
        if not count:
            break
        if len(a) + count > 2 * n:
            _raise_singular(names)
        through = d @ turn
        through[np.abs(through) <= _SMALL * np.abs(d).max()] = 0.0
        a, b, c, d = _extended(a, b @ turn, c, through, count)
        given = from_inputs @ turn
        from_states = np.hstack([from_states, given[:, :count]])
        from_inputs = np.hstack([np.zeros((m, count)), given[:, count:]])
    return _normal_form(a, b, chains, from_states, from_inputs, n)


class _Chain(NamedTuple):
    """Rows of an output and its derivatives below the order at which an input appears, and that order's rows."""

    rows: list[Array]
    last: Array
    influence: Array


def _chains(a: Array, b: Array, c: Array, d: Array, names: Sequence[str]) -> list[_Chain]:
    chains = [_chain(a, b, row, through) for row, through in zip(c, d, strict=True)]
    for chain, name in zip(chains, names, strict=True):
        if chain is None:
            what = "" if len(names) == 1 else f" to {name}"
            raise ValueError(f"the transfer function of loop{what} must not be 0, got 0")
    return [chain for chain in chains if chain is not None]


def _chain(a: Array, b: Array, row: Array, through: Array) -> _Chain | None:
    """Chain of one output; None if no input has an effect on it."""
    if np.any(through != 0.0):
        return _Chain([], row, through)
    rows = [row]
    for _ in range(len(a)):
        influence = rows[-1] @ b
        sizes = np.linalg.norm(rows[-1]) * np.linalg.norm(b, axis=0)
        if (np.abs(influence) > _SMALL * sizes).any():
            return _Chain(rows, rows[-1] @ a, influence)
        rows.append(rows[-1] @ a)
    return None


def _dependent(influence: Array, names: Sequence[str]) -> tuple[Array, int]:
    """Orthogonal combinations of the inputs, and how many, the first ones, outputs with dependent rows depend on.

    The number is 0 if the influence of the inputs is regular.
    """
    scaled = influence / np.abs(influence).max(axis=1, keepdims=True)
    sizes = np.abs(scaled).max(axis=0)
    scaled = scaled / np.where(sizes > 0.0, sizes, 1.0)
    left, values, _ = np.linalg.svd(scaled)
    rank = int(np.count_nonzero(values >= _SMALL))
    if rank == len(names):
        return np.eye(len(names)), 0
    rows = np.abs(left[:, rank:]).max(axis=1) > _SMALL
    _, values, right = np.linalg.svd(influence[rows])
    return np.asarray(right.T), int(np.count_nonzero(values >= _SMALL * values[0]))


def _extended(a: Array, b: Array, c: Array, d: Array, count: int) -> tuple[Array, Array, Array, Array]:
    """The same system with the derivatives of the first inputs as inputs, and these inputs as further states."""
    n, m = b.shape
    wide = np.block([[a, b[:, :count]], [np.zeros((count, n + count))]])
    inputs = np.block([[np.zeros((n, count)), b[:, count:]], [np.eye(count), np.zeros((count, m - count))]])
    return wide, inputs, np.hstack([c, d[:, :count]]), np.hstack([np.zeros((len(c), count)), d[:, count:]])


def _raise_singular(names: Sequence[str]) -> None:
    raise ValueError(
        f"the outputs of loop, {', '.join(names)}, must depend on its inputs independently, got a singular transfer "
        "matrix: no inputs give these outputs different plans; choose other outputs"
    )


def _normal_form(
    a: Array, b: Array, chains: Sequence[_Chain], from_states: Array, from_inputs: Array, count: int
) -> Inverse:
    """Inverse from chains with a regular influence; the inputs are from_states x + from_inputs u."""
    orders = [len(chain.rows) for chain in chains]
    last, influence = np.array([chain.last for chain in chains]), np.array([chain.influence for chain in chains])
    solve = np.linalg.inv(influence) if len(chains) > 1 else 1.0 / influence
    rows = np.reshape([row for chain in chains for row in chain.rows], (sum(orders), len(a)))
    norms = np.linalg.norm(rows, axis=1)
    basis = rows / norms[:, None]
    c, d = from_states - from_inputs @ solve @ last, from_inputs @ solve
    parts = np.linalg.lstsq(basis.T, c.T, rcond=None)[0].T
    rest = np.linalg.norm(c - parts @ basis, axis=1)
    if (rest <= _SMALL * (np.linalg.norm(c, axis=1) + np.abs(parts).sum(axis=1))).all():
        # The inputs depend on the outputs and their derivatives only: there are no zeros.
        gains = _columns(parts / norms, d, orders) + 0.0  # no -0
        nothing, width = np.zeros((0, 0)), gains.shape[1]
        return Inverse(orders, nothing, np.zeros((0, width)), np.zeros((len(d), 0)), gains, np.zeros((count, 0)))
    hidden = null_space(basis) if sum(orders) else np.eye(len(a))
    motion = a - b @ solve @ last
    from_rows = np.linalg.pinv(basis)  # x from the derivatives of the outputs, in norms, and from the hidden states
    return Inverse(
        orders,
        hidden.T @ motion @ hidden,
        _columns(hidden.T @ motion @ from_rows / norms, hidden.T @ b @ solve, orders),
        c @ hidden,
        _columns(c @ from_rows / norms, d, orders),
        hidden[:count],
    )


def _columns(below: Array, highest: Array, orders: Sequence[int]) -> Array:
    """Columns for y, y', ..., y^(r) of each output from those of derivatives below r, and of the highest ones."""
    parts, first = [], 0
    for j, r in enumerate(orders):
        parts += [below[:, first : first + r], highest[:, j : j + 1]]
        first += r
    return np.hstack(parts)
