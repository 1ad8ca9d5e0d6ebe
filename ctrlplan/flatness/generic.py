"""Generic ranks and zeros of matrices of expressions: what holds at almost every point of a plant.

A matrix is evaluated at a random point in two copies: with 55 digits, and with 40
digits and every constant changed in its 14th digit. An entry or a pivot counts as
0 if the copies differ by more than 1 %: then it is 0 by cancellation of numbers
that are known to no more digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import mpmath
import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array, Value
from ctrlplan.symbolic.tape import Operations
from ctrlplan.symbolic.taping import tape_of

Matrix = list[list[Value]]

_DIGITS, _CHANGED_DIGITS = 55, 40
_SAME = 0.01
"""Relative difference of the copies above which a number is 0."""

_NOTHING = 1e-13
"""Magnitude relative to the largest of a row, in the units of the columns' scales, below which an entry is 0."""


@dataclass(frozen=True, eq=False)
class Copies:
    """Matrix at a point, with exact and with changed constants; zeros by the rule of this module are exact zeros."""

    exact: Matrix
    changed: Matrix
    shape: tuple[int, int]

    def rows(self, chosen: Sequence[int]) -> Copies:
        """The chosen rows."""
        return Copies([self.exact[i] for i in chosen], [self.changed[i] for i in chosen], (len(chosen), self.shape[1]))

    def columns(self, chosen: Sequence[int]) -> Copies:
        """The chosen columns."""
        return Copies(
            [[row[j] for j in chosen] for row in self.exact],
            [[row[j] for j in chosen] for row in self.changed],
            (self.shape[0], len(chosen)),
        )

    @property
    def nonzero(self) -> NDArray[np.bool_]:
        """Entries that are not 0."""
        return np.array([[value != 0 for value in row] for row in self.exact], dtype=bool).reshape(self.shape)

    def numbers(self) -> Array:
        """Entries in double precision."""
        return np.array([[float(value) for value in row] for row in self.exact], dtype=float).reshape(self.shape)

    def rank(self) -> int:
        """Generic rank."""
        return len(self._eliminated()[0])

    def dependent_rows(self) -> list[int]:
        """Rows that are in some linear dependency of rows."""
        return sorted({i for row in self.left_null() for i in row})

    def left_null(self) -> list[set[int]]:
        """Supports of a basis of linear dependencies of the rows."""
        pivots, eliminated = self._eliminated(bordered=True)
        used = {row for row, _ in pivots}
        supports = []
        for i in range(self.shape[0]):
            if i not in used:
                border = eliminated[i][self.shape[1] :]
                supports.append({k for k, value in enumerate(border) if value != 0})
        return supports

    def _eliminated(self, bordered: bool = False) -> tuple[list[tuple[int, int]], Matrix]:
        """Pivots by complete pivoting of the equilibrated matrix, and the rows after elimination."""
        n, m = self.shape
        row_scale, column_scale = _equilibrated(self.exact, n, m)
        with mpmath.workdps(_DIGITS):
            copies = []
            for matrix in (self.exact, self.changed):
                rows = [[matrix[i][j] * row_scale[i] * column_scale[j] for j in range(m)] for i in range(n)]
                if bordered:
                    for i in range(n):
                        rows[i] += [mpmath.mpf(int(i == k)) for k in range(n)]
                copies.append(rows)
            exact, changed = copies
            left = list(range(n))
            free = list(range(m))
            pivots: list[tuple[int, int]] = []
            while left and free:
                i, j = max(((i, j) for i in left for j in free), key=lambda place: abs(exact[place[0]][place[1]]))
                if exact[i][j] == 0:
                    break
                pivots.append((i, j))
                left.remove(i)
                free.remove(j)
                for k in left:
                    factors = [rows[k][j] / rows[i][j] for rows in copies]
                    for c in range(len(exact[k])):
                        terms = [factor * rows[i][c] for factor, rows in zip(factors, copies, strict=True)]
                        exact[k][c] -= terms[0]
                        changed[k][c] -= terms[1]
                        if _is_zero(exact[k][c], changed[k][c]):
                            exact[k][c] = changed[k][c] = mpmath.mpf(0)
                    exact[k][j] = changed[k][j] = mpmath.mpf(0)
        return pivots, exact


class Point:
    """Point at which matrices are evaluated in two copies."""

    def __init__(self, arguments: Sequence[ca.SX], values: Sequence[Array], constants: Sequence[Array]) -> None:
        """Entries of `values` are exact; those of `constants`, parameters, are changed in one copy."""
        self._arguments = list(arguments)
        self._values, self._constants = list(values), list(constants)

    def __call__(self, matrix: ca.SX, scales: Array | None = None) -> Copies:
        """Matrix at the point; columns are weighted with `scales` for the comparison within a row."""
        tape = tape_of(self._arguments, matrix)
        copies = []
        for digits, constant in ((_DIGITS, mpmath.mpf), (_CHANGED_DIGITS, _changed)):
            with mpmath.workdps(digits):
                exact = [[mpmath.mpf(float(v)) for v in column] for column in self._values]
                known = [[constant(float(v)) for v in column] for column in self._constants]
                try:
                    values = tape.evaluated([*exact, *known], MPMATH, constant)
                except (ZeroDivisionError, ValueError) as error:
                    raise ArithmeticError(str(error)) from error
                n, m = tape.shape
                results = [values[k] if k >= 0 else mpmath.mpf(0) for k in tape.results.tolist()]
                copies.append([[results[i + n * j] for j in range(m)] for i in range(n)])
        exact_matrix, changed_matrix = copies
        n, m = tape.shape
        weights = np.ones(m) if scales is None else scales
        with mpmath.workdps(_DIGITS):
            for i in range(n):
                if not all(mpmath.isfinite(v) and mpmath.im(v) == 0 for v in exact_matrix[i]):
                    raise ArithmeticError("a value is not finite and real")
                largest = max((abs(exact_matrix[i][j]) * weights[j] for j in range(m)), default=0)
                for j in range(m):
                    small = abs(exact_matrix[i][j]) * weights[j] < _NOTHING * largest
                    if small or _is_zero(exact_matrix[i][j], changed_matrix[i][j]):
                        exact_matrix[i][j] = changed_matrix[i][j] = mpmath.mpf(0)
        return Copies(exact_matrix, changed_matrix, (n, m))


def _is_zero(exact: Value, changed: Value) -> bool:
    return bool(abs(exact - changed) > _SAME * abs(exact)) or exact == 0


def _changed(value: float) -> Value:
    """Constant changed by a factor within 1e-14 of 1 that its value determines; multiples of 1/2 stay."""
    number = mpmath.mpf(value)
    if (2.0 * value).is_integer() and abs(value) < 1e6:
        return number
    mantissa, exponent = math.frexp(abs(value))
    mixed = math.fmod(mantissa * 9973.0 + exponent * 0.6180339887498949, 1.0)
    factor = mpmath.mpf(0.5 + abs(mixed) / 2.0) * mpmath.mpf("1e-14")
    return number * (1 + factor if math.fmod(mixed * 64.0, 2.0) >= 1.0 else 1 - factor)


def _equilibrated(matrix: Matrix, n: int, m: int) -> tuple[list[Value], list[Value]]:
    """Factors of rows and columns that bring the magnitudes of the entries near 1."""
    size = np.full((n, m), np.nan)
    for i in range(n):
        for j in range(m):
            if matrix[i][j] != 0:
                size[i, j] = float(mpmath.log(abs(matrix[i][j])))
    rows, columns = np.zeros(n), np.zeros(m)
    known = np.isfinite(size)
    for _ in range(20):
        for axis, factors in ((1, rows), (0, columns)):
            left = np.where(known, size + rows[:, None] + columns, 0.0)
            factors -= left.sum(axis=axis) / np.maximum(known.sum(axis=axis), 1)
    return [mpmath.exp(v) for v in rows.tolist()], [mpmath.exp(v) for v in columns.tolist()]


def _power(x: Value, y: Value) -> Value:
    return mpmath.power(x, y)


_UNARY: dict[str, Callable[..., Value]] = {
    "EXP": mpmath.exp,
    "LOG": mpmath.log,
    "SQRT": mpmath.sqrt,
    "SIN": mpmath.sin,
    "COS": mpmath.cos,
    "TAN": mpmath.tan,
    "ASIN": mpmath.asin,
    "ACOS": mpmath.acos,
    "ATAN": mpmath.atan,
    "SINH": mpmath.sinh,
    "COSH": mpmath.cosh,
    "TANH": mpmath.tanh,
    "ASINH": mpmath.asinh,
    "ACOSH": mpmath.acosh,
    "ATANH": mpmath.atanh,
    "LOG1P": mpmath.log1p,
    "EXPM1": mpmath.expm1,
    "ERF": mpmath.erf,
}

MPMATH: Operations = {
    **_UNARY,
    "ASSIGN": lambda x: x,
    "ADD": lambda x, y: x + y,
    "SUB": lambda x, y: x - y,
    "MUL": lambda x, y: x * y,
    "DIV": lambda x, y: x / y,
    "NEG": lambda x: -x,
    "POW": _power,
    "CONSTPOW": _power,
    "SQ": lambda x: x * x,
    "TWICE": lambda x: 2 * x,
    "INV": lambda x: 1 / x,
    "ATAN2": mpmath.atan2,
    "HYPOT": mpmath.hypot,
    "SIGN": mpmath.sign,
    "FABS": abs,
}
"""Smooth operations, and those in their derivatives, on numbers of mpmath."""
