r"""Maps of linear flat systems, in exact arithmetic.

With the characteristic polynomial s^n + a_(n-1) s^(n-1) + ... + a_0 of A and
the flat output z of the reachable form,

.. math:: z^{(k)} = q A^k x \ (k < n), \quad z^{(n)} = u - \sum_k a_k z^{(k)}, \quad
    x = \sum_k w_k z^{(k)}, \quad w_{n-1} = B, \ w_{k-1} = A w_k + a_k B

where q is the row with q w_k = 0 except for q w_0 = 1. Floating-point numbers are
fractions, so all of this is computed without rounding. python-control's
`LinearFlatSystem` inverts the reachability matrix, which is inaccurate if time
constants differ by orders of magnitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import control.flatsys as fs
import numpy as np

from ctrlplan._types import Array, System, Value

Matrix = list[list[Fraction]]

_NOTHING = 1e-9
"""Magnitude relative to its terms below which a coefficient is 0."""


class LinearMaps(NamedTuple):
    """Maps between flag and state of a linear flat system, and its output as a function of the flag."""

    flag: Array  # (n + 1, n + 1), z, ..., z^(n) as functions of state and input
    states: Array  # (n, n), as functions of z, ..., z^(n - 1)
    inputs: Array  # (1, n + 1), as functions of z, ..., z^(n): a_0, ..., a_(n - 1), 1
    output: Array  # (n + 1,), as a function of z, ..., z^(n)

    @property
    def has_zeros(self) -> bool:
        """Whether the output depends on derivatives of the flat output."""
        return bool(self.output[1:].any())

    def of_output(self) -> LinearMaps:
        """Maps with the output in place of the flat output, of which it is a multiple."""
        gain = float(self.output[0])
        return LinearMaps(gain * self.flag, self.states / gain, self.inputs / gain, self.output / gain)

    def forward(self, x: Value, u: Value) -> list[Value]:
        """Flag of a state and an input."""
        return [self.flag @ np.concatenate([x, u])]

    def reverse(self, flag: list[Value]) -> list[Value]:
        """State and input of a flag."""
        return [self.states @ flag[0][:-1], self.inputs @ flag[0]]


def is_linear(flat_system: fs.FlatSystem) -> bool:
    """Whether the maps of a flat system are those of python-control's `LinearFlatSystem`."""
    own, kind = type(flat_system), fs.LinearFlatSystem
    return isinstance(flat_system, kind) and own.forward is kind.forward and own.reverse is kind.reverse


def linear_maps(system: fs.LinearFlatSystem) -> LinearMaps:
    """Maps of a linear flat system, every coefficient correct to rounding.

    Parameters
    ----------
    system : control.flatsys.LinearFlatSystem
        With one input and one output.

    Returns
    -------
    LinearMaps

    Raises
    ------
    ValueError
        If the system is not controllable, or a coefficient overflows.
    """
    a, b, c = (_fractions(matrix) for matrix in (system.A, system.B, system.C))
    n, through = len(a), Fraction(float(system.D[0, 0]))
    polynomial = _characteristic(a)
    column = [row[0] for row in b]
    columns = [column]
    for k in range(n - 1, 0, -1):
        moved = _product(a, [[value] for value in columns[0]])
        columns.insert(0, [row[0] + polynomial[k] * value for row, value in zip(moved, column, strict=True)])
    rows = [_solution(columns, [Fraction(int(k == 0)) for k in range(n)], system.name)]
    for _ in range(n):
        rows.append(_product([rows[-1]], a)[0])
    flag = [[*row, Fraction(int(k == n))] for k, row in enumerate(rows)]
    output = [_dot(c[0], w) + through * p for w, p in zip(columns, polynomial, strict=True)]
    terms = [_dot(map(abs, c[0]), map(abs, w)) + abs(through * p) for w, p in zip(columns, polynomial, strict=True)]
    output = [value if abs(value) > _NOTHING * size else Fraction(0) for value, size in zip(output, terms, strict=True)]
    try:
        return LinearMaps(
            _floats(flag), _floats(columns).T, _floats([[*polynomial, Fraction(1)]]), _floats([[*output, through]])[0]
        )
    except OverflowError:
        raise ValueError(
            f"coefficients of the flat maps of {system.name} must stay within floating point, got an overflow; "
            "choose a time unit nearer to its time constants"
        ) from None


def _characteristic(a: Matrix) -> list[Fraction]:
    """Coefficients of the characteristic polynomial, lowest first and without the leading 1 (Faddeev, LeVerrier)."""
    n = len(a)
    found = [Fraction(0)] * n
    power = [[Fraction(0)] * n for _ in range(n)]
    last = Fraction(1)
    for k in range(1, n + 1):
        power = _product(a, power)
        for i in range(n):
            power[i][i] += last
        last = -sum(map(_dot, a, zip(*power, strict=True)), Fraction()) / k
        found[n - k] = last
    return found


def _solution(matrix: Matrix, right: list[Fraction], name: str) -> list[Fraction]:
    """Solution of a square system by Gaussian elimination."""
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    n = len(rows)
    for k in range(n):
        pivot = next((i for i in range(k, n) if rows[i][k]), None)
        if pivot is None:
            raise ValueError(f"a linear flat system must be controllable, got {name}, which is not")
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [value / rows[k][k] for value in rows[k]]
        for i in range(n):
            if i != k and rows[i][k]:
                factor = rows[i][k]
                rows[i] = [value - factor * other for value, other in zip(rows[i], rows[k], strict=True)]
    return [row[-1] for row in rows]


def _product(left: Matrix, right: Matrix) -> Matrix:
    columns = list(zip(*right, strict=True))
    return [[_dot(row, column) for column in columns] for row in left]


def _dot(left: Value, right: Value) -> Fraction:
    return sum((x * y for x, y in zip(left, right, strict=True) if x and y), Fraction())


def _fractions(matrix: Value) -> Matrix:
    return [[Fraction(value) for value in row] for row in np.asarray(matrix, dtype=float).tolist()]


def _floats(rows: Matrix) -> Array:
    return np.array([[float(value) for value in row] for row in rows])


def brunovsky_outputs(system: System, columns: Sequence[int]) -> Array:
    """Flat outputs of a linear system.

    Parameters
    ----------
    system : control.StateSpace
        In continuous time.
    columns : sequence of int
        The inputs that are controls.

    Returns
    -------
    rows : ndarray, shape (ncontrols, nstates)
        Flat outputs as functions of the states, from the controllability indices.

    Raises
    ------
    ValueError
        If the system is not controllable with these inputs.
    """
    a, b = _fractions(system.A), _fractions(np.asarray(system.B)[:, list(columns)])
    n, m = len(a), len(columns)
    blocks: list[list[list[Fraction]]] = [[] for _ in range(m)]
    basis: list[list[Fraction]] = []
    latest = [[row[j] for row in b] for j in range(m)]
    active = list(range(m))
    while active:
        for j in list(active):
            if _rank([*basis, latest[j]]) > len(basis):
                basis.append(latest[j])
                blocks[j].append(latest[j])
                latest[j] = [_dot(row, latest[j]) for row in a]
            else:
                active.remove(j)
    if len(basis) < n:
        raise ValueError(
            f"a linear system must be controllable to be flat, got {system.name} with {n - len(basis)} states on which "
            f"its inputs have no effect"
        )
    if any(not block for block in blocks):
        raise ValueError(f"inputs of {system.name} must be independent, got columns of B that are not")
    ordered = [vector for block in blocks for vector in block]
    rows, last = [], -1
    for block in blocks:
        last += len(block)
        right = [Fraction(int(k == last)) for k in range(n)]
        rows.append(_solution(ordered, right, str(system.name)))
    return _floats(rows)


def _rank(vectors: Matrix) -> int:
    rows = [list(vector) for vector in vectors]
    rank = 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(rank, len(rows)) if rows[i][column]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for i in range(rank + 1, len(rows)):
            if rows[i][column]:
                factor = rows[i][column] / rows[rank][column]
                rows[i] = [value - factor * other for value, other in zip(rows[i], rows[rank], strict=True)]
        rank += 1
    return rank
