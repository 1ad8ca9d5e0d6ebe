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
from scipy.linalg import matrix_balance, null_space

from ctrlplan._types import Array

_SMALL = 1e-9
"""Relative singular value up to which rows depend on each other."""

_ROUNDING = 1e-12
"""Size of a sum relative to the magnitudes of its terms up to which it counts as 0."""


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


def loop_inverse(loop: ct.StateSpace, order: int | None = None) -> Inverse:
    """Inverse of a loop with as many inputs as outputs.

    If the highest derivatives depend on fewer combinations of the inputs than there
    are outputs, these combinations are replaced by their derivatives, which become
    further states, until they do.

    Parameters
    ----------
    loop : control.StateSpace
        The loop.
    order : int, optional
        Relative degree of the output of a loop with one input, where it is known.
        Otherwise it is found from the matrices, in which an influence of the input
        that rounding errors leave cannot be distinguished from a small one.

    Raises
    ------
    ValueError
        If the transfer function of an output is 0, or the system has no inverse.
    """
    a, b, c, d = (np.asarray(matrix, dtype=float) for matrix in (loop.A, loop.B, loop.C, loop.D))
    scale, (n, m), names = _scale(a, b, c, d), b.shape, loop.output_labels
    a, b, c = a * (scale / scale[:, None]), b / scale[:, None], c * scale
    from_states, from_inputs = np.zeros((m, n)), np.eye(m)
    while True:
        if order is None:
            orders, influence = _relative_degrees(a, b, c, d, names)
        else:
            orders, influence = [order], c @ np.linalg.matrix_power(a, order - 1) @ b if order else d
        turn, count = _dependent(influence)
        if not count:
            break
        if len(a) + count > 2 * n:
            raise ValueError(
                f"the outputs of loop, {', '.join(names)}, must depend on its inputs independently, got a singular "
                "transfer matrix: no inputs give these outputs different plans; choose other outputs"
            )
        through = d @ turn
        through[np.abs(through) <= _SMALL * np.abs(d).max()] = 0.0
        a, b, c, d = _extended(a, b @ turn, c, through, count)
        given = from_inputs @ turn
        from_states = np.hstack([from_states, given[:, :count]])
        from_inputs = np.hstack([np.zeros((m, count)), given[:, count:]])
    found = _normal_form(a, b, c, d, orders)
    u = from_inputs @ found.c + from_states @ found.states
    y = from_inputs @ found.d + from_states @ found.states_of_y
    if _is_negligible(u, from_inputs @ found.c_terms + np.abs(from_states) @ np.abs(found.states)):
        # The inputs depend on the outputs and their derivatives only: there are no zeros.
        width = sum(orders) + m
        nothing = np.zeros((0, 0)), np.zeros((0, width)), np.zeros((m, 0))
        return Inverse(orders, *nothing, y + 0.0, np.zeros((n, 0)))  # no -0
    return Inverse(orders, found.z, found.k, u, y, scale[:, None] * found.states[:n])


def _scale(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Balancing scale (nstates,) of the states of a system, powers of two."""
    if not a.size:
        return np.ones(0)
    with np.errstate(invalid="ignore"):  # scipy also converts the scale to an index, which is not used
        scale = matrix_balance(np.block([[a, b], [c, d]]), permute=False, separate=True)[1][0]
    return np.asarray(scale[: len(a)])


def _relative_degrees(a: Array, b: Array, c: Array, d: Array, names: Sequence[str]) -> tuple[list[int], Array]:
    """Order of each output's derivative on which the inputs have an influence, and this influence."""
    found = [_relative_degree(a, b, row, through) for row, through in zip(c, d, strict=True)]
    for (order, _), name in zip(found, names, strict=True):
        if order < 0:
            what = "" if len(names) == 1 else f" to {name}"
            raise ValueError(f"the transfer function of loop{what} must not be 0, got 0")
    return [order for order, _ in found], np.array([influence for _, influence in found])


def _relative_degree(a: Array, b: Array, row: Array, through: Array) -> tuple[int, Array]:
    """Order and influence for one output; order -1 if no input has an effect on it."""
    if np.any(through != 0.0):
        return 0, through
    sizes, steps = np.abs(row), np.abs(a)
    for order in range(1, len(a) + 1):
        influence = row @ b
        # Relative to the sum of the magnitudes of all products, which does not depend on the scale of states.
        influence[np.abs(influence) <= _ROUNDING * (sizes @ np.abs(b))] = 0.0
        if influence.any():
            return order, influence
        row, sizes = row @ a, sizes @ steps
        size = sizes.max(initial=0.0)
        if not size:
            break
        row, sizes = row / size, sizes / size
    return -1, through


def _dependent(influence: Array) -> tuple[Array, int]:
    """Orthogonal combinations of the inputs, and how many, the first ones, outputs with dependent rows depend on.

    The number is 0 if the influence of the inputs is regular.
    """
    scaled = influence / np.abs(influence).max(axis=1, keepdims=True)
    sizes = np.abs(scaled).max(axis=0)
    scaled = scaled / np.where(sizes > 0.0, sizes, 1.0)
    left, values, _ = np.linalg.svd(scaled)
    rank = int(np.count_nonzero(values >= _SMALL))
    if rank == len(influence):
        return np.eye(rank), 0
    rows = np.abs(left[:, rank:]).max(axis=1) > _SMALL
    _, values, right = np.linalg.svd(influence[rows])
    return np.asarray(right.T), int(np.count_nonzero(values >= _SMALL * values[0]))


def _extended(a: Array, b: Array, c: Array, d: Array, count: int) -> tuple[Array, Array, Array, Array]:
    """The same system with the derivatives of the first inputs as inputs, and these inputs as further states."""
    n, m = b.shape
    wide = np.block([[a, b[:, :count]], [np.zeros((count, n + count))]])
    inputs = np.block([[np.zeros((n, count)), b[:, count:]], [np.eye(count), np.zeros((count, m - count))]])
    return wide, inputs, np.hstack([c, d[:, :count]]), np.hstack([np.zeros((len(c), count)), d[:, count:]])


class _NormalForm(NamedTuple):
    """Inverse of a system with a regular influence of the inputs, in orthonormal coordinates.

    Matrices as of `Inverse`, with the states x = states eta + states_of_y Y, and the
    magnitudes of the terms of c.
    """

    z: Array
    k: Array
    c: Array
    d: Array
    states: Array
    states_of_y: Array
    c_terms: Array


def _normal_form(a: Array, b: Array, c: Array, d: Array, orders: list[int]) -> _NormalForm:
    """Normal form of a system whose outputs have given orders.

    The derivatives of the outputs below these orders are combinations of the states.
    They are made orthonormal one after the other, those that are farthest from the
    inputs first: w = q x with w = T Y. A new row is q a of an earlier one without
    its components along all earlier rows. The rest of the states is eta.
    """
    n, width = len(a), sum(orders) + len(orders)
    rows, courses = np.zeros((0, n)), np.zeros((0, width))
    place: dict[int, int] = {}
    for distance in range(max(orders), 0, -1):
        for j, order in enumerate(orders):
            if order < distance:
                continue
            if order == distance:
                new, course = c[j], np.eye(1, width, first_columns(orders)[j])[0]
            else:
                new, course = rows[place[j]] @ a, _derivative(courses[place[j]])
            for _ in range(2):  # twice is enough for orthogonality to rounding
                parts = new @ rows.T
                new, course = new - parts @ rows, course - parts @ courses
            size = float(np.linalg.norm(new))
            place[j] = len(rows)
            rows, courses = np.vstack([rows, new / size]), np.vstack([courses, course / size])
    # For order 0: y = c x + d u; otherwise w' = q a x + q b u of the last row.
    last = np.array([rows[place[j]] @ a if r else c[j] for j, r in enumerate(orders)])
    influence = np.array([rows[place[j]] @ b if r else d[j] for j, r in enumerate(orders)])
    known = [
        _derivative(courses[place[j]]) if r else np.eye(1, width, first_columns(orders)[j])[0]
        for j, r in enumerate(orders)
    ]
    solve = np.linalg.inv(influence)
    hidden = null_space(rows) if len(rows) else np.eye(n)
    gain, direct = solve @ last, solve @ np.array(known)
    forward = a - b @ gain
    return _NormalForm(
        hidden.T @ forward @ hidden,
        hidden.T @ (forward @ rows.T @ courses + b @ direct),
        -gain @ hidden,
        direct - gain @ rows.T @ courses,
        hidden,
        rows.T @ courses,
        np.abs(gain) @ np.abs(hidden),
    )


def _derivative(course: Array) -> Array:
    """Combination of y, y', ... with each derivative replaced by the next one."""
    return np.concatenate([[0.0], course[:-1]])


def _is_negligible(values: Array, terms: Array) -> bool:
    """Whether sums are 0 up to the rounding of their terms."""
    return bool((np.abs(values) <= _ROUNDING * terms).all())
