"""Instruction lists of CasADi functions, evaluated by numpy for arrays of points, or by mpmath.

A tape needs no CasADi to be evaluated, and can be pickled.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._types import Array, Value

Operations = Mapping[str, Callable[..., Value]]
"""Functions of numbers by the name of an operation of CasADi."""


@dataclass(frozen=True)
class Instruction:
    """Operation, places of its arguments, its constant, and the places that no later instruction reads."""

    operation: str
    arguments: tuple[int, ...]
    constant: float = 0.0
    last_reads: tuple[int, ...] = ()


@dataclass(frozen=True)
class Tape:
    """Instruction list of a function with one dense column or matrix as result.

    Attributes
    ----------
    sizes : tuple of int
        Number of entries of each argument.
    instructions : tuple of Instruction
        In the order of evaluation; places of arguments are positions in this
        list, for inputs argument and entry.
    results : tuple of int
        Position of each entry of the result, column by column; -1 for 0.
    shape : tuple of int
        Rows and columns of the result.
    matrix : bool
        Whether a result of one column keeps its second axis.
    """

    sizes: tuple[int, ...]
    instructions: tuple[Instruction, ...]
    results: tuple[int, ...]
    shape: tuple[int, int]
    matrix: bool = False

    def __call__(self, *arguments: ArrayLike) -> Array:
        """Result for arguments (entries, ...): shape (rows, columns, ...), or (rows, ...) of a column."""
        given = [np.asarray(value, dtype=float) for value in arguments]
        trailing = np.broadcast_shapes(*(value.shape[1:] for value in given))
        out = np.zeros((len(self.results), *trailing))
        values = self._of_one_point(given) if not trailing else None
        if values is None:
            with np.errstate(all="ignore"):
                values = self.evaluated(given, NUMPY)
        for k, place in enumerate(self.results):
            if place >= 0:
                out[k] = values[place]
        if self.shape[1] == 1 and not self.matrix:
            return out
        return out.reshape(self.shape[1], self.shape[0], *trailing).swapaxes(0, 1)

    def _of_one_point(self, arguments: list[Array]) -> list[Value] | None:
        """Values by Python's own arithmetic, which is faster for one point; None outside of the domain."""
        try:
            return self.evaluated([value.tolist() for value in arguments], _PYTHON)
        except (ArithmeticError, ValueError, KeyError):
            return None

    def evaluated(
        self,
        arguments: Sequence[Value],
        operations: Operations,
        constant: Callable[[float], Value] = lambda value: value,
    ) -> list[Value]:
        """Value of each instruction with given operations on numbers; None for values that are read no more.

        Parameters
        ----------
        arguments : sequence of sequences or arrays
            Entries of each argument.
        operations : mapping
            Function of each operation.
        constant : callable, optional
            Number of a constant.
        """
        values: list[Value] = []
        for step in self.instructions:
            if step.operation == "INPUT":
                argument, entry = step.arguments
                values.append(arguments[argument][entry])
            elif step.operation == "CONST":
                values.append(constant(step.constant))
            else:
                values.append(operations[step.operation](*[values[place] for place in step.arguments]))
                for place in step.last_reads:  # their memory is used again
                    values[place] = None
        return values


NUMPY: Operations = {
    "ASSIGN": lambda x: x,
    "ADD": np.add,
    "SUB": np.subtract,
    "MUL": np.multiply,
    "DIV": np.divide,
    "NEG": np.negative,
    "EXP": np.exp,
    "LOG": np.log,
    "POW": np.power,
    "CONSTPOW": np.power,
    "SQRT": np.sqrt,
    "SQ": np.square,
    "TWICE": lambda x: x + x,
    "INV": lambda x: 1.0 / x,
    "SIN": np.sin,
    "COS": np.cos,
    "TAN": np.tan,
    "ASIN": np.arcsin,
    "ACOS": np.arccos,
    "ATAN": np.arctan,
    "SINH": np.sinh,
    "COSH": np.cosh,
    "TANH": np.tanh,
    "ASINH": np.arcsinh,
    "ACOSH": np.arccosh,
    "ATANH": np.arctanh,
    "ATAN2": np.arctan2,
    "HYPOT": np.hypot,
    "LOG1P": np.log1p,
    "EXPM1": np.expm1,
    "FABS": np.fabs,
    "SIGN": np.sign,
    "COPYSIGN": np.copysign,
    "FMIN": np.fmin,
    "FMAX": np.fmax,
    "FMOD": np.fmod,
    "FLOOR": np.floor,
    "CEIL": np.ceil,
    "LT": lambda x, y: np.where(x < y, 1.0, 0.0),
    "LE": lambda x, y: np.where(x <= y, 1.0, 0.0),
    "EQ": lambda x, y: np.where(x == y, 1.0, 0.0),
    "NE": lambda x, y: np.where(x != y, 1.0, 0.0),
    "NOT": lambda x: np.where(x == 0.0, 1.0, 0.0),
    "AND": lambda x, y: np.where((x != 0.0) & (y != 0.0), 1.0, 0.0),
    "OR": lambda x, y: np.where((x != 0.0) | (y != 0.0), 1.0, 0.0),
    "IF_ELSE_ZERO": lambda condition, value: np.where(condition != 0.0, value, 0.0),
}
"""Operations on numbers and arrays."""

_PYTHON: Operations = {
    "ASSIGN": lambda x: x,
    "ADD": operator.add,
    "SUB": operator.sub,
    "MUL": operator.mul,
    "DIV": operator.truediv,
    "NEG": operator.neg,
    "POW": math.pow,
    "CONSTPOW": math.pow,
    "SQ": lambda x: x * x,
    "TWICE": lambda x: x + x,
    "INV": lambda x: 1.0 / x,
    **{name.upper(): getattr(math, name) for name in str.split("exp log sqrt sin cos tan asin acos atan atan2 hypot")},
    **{name.upper(): getattr(math, name) for name in str.split("sinh cosh tanh asinh acosh atanh log1p expm1 fabs")},
}
"""Smooth operations on Python's numbers, which raise outside of their domain."""
