"""Instruction lists of CasADi functions, evaluated by numpy for arrays of points, or by mpmath.

A tape needs no CasADi to be evaluated, and can be pickled.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._types import Array, Value

Operations = Mapping[str, Callable[..., Value]]
"""Functions of numbers by the name of an operation of CasADi."""


INPUT, CONSTANT = "INPUT", "CONST"
"""Instructions that are no operation: an entry of an argument, a constant."""


@dataclass(frozen=True)
class Instruction:
    """Operation, places of its arguments, and its constant."""

    operation: str
    arguments: tuple[int, ...]
    constant: float = 0.0


@dataclass(frozen=True, eq=False)
class Tape:
    """Instruction list of a function with one dense column or matrix as result.

    Stored as arrays, so that it is small for what reads all data of a block.

    Attributes
    ----------
    operations : tuple of str
        Names of the operations.
    code : ndarray of int, shape (n, 3)
        Of each instruction the operation, and the places of its arguments: positions
        in this list, for inputs argument and entry; -1 for none.
    constants : ndarray, shape (n,)
        Constants.
    results : ndarray of int
        Position of each entry of the result, column by column; -1 for 0.
    shape : tuple of int
        Rows and columns of the result.
    matrix : bool
        Whether a result of one column keeps its second axis.
    """

    operations: tuple[str, ...]
    code: NDArray[np.int32]
    constants: Array
    results: NDArray[np.int32]
    shape: tuple[int, int]
    matrix: bool = False

    @classmethod
    def of(
        cls, instructions: Sequence[Instruction], results: Sequence[int], shape: tuple[int, int], matrix: bool
    ) -> Tape:
        """Tape of a list of instructions."""
        names = tuple(dict.fromkeys(step.operation for step in instructions))
        code = np.full((len(instructions), 3), -1, dtype=np.int32)
        for k, step in enumerate(instructions):
            code[k, 0] = names.index(step.operation)
            code[k, 1 : 1 + len(step.arguments)] = step.arguments
        constants = np.array([step.constant for step in instructions])
        for array in (code, constants, found := np.array(results, dtype=np.int32)):
            array.flags.writeable = False
        return cls(names, code, constants, found, shape, matrix)

    def __call__(self, *arguments: ArrayLike) -> Array:
        """Result for arguments (entries, ...): shape (rows, columns, ...), or (rows, ...) of a column."""
        given = [np.asarray(value, dtype=float) for value in arguments]
        trailing = np.broadcast_shapes(*(value.shape[1:] for value in given))
        out = np.zeros((self.results.size, *trailing))
        rows = self.at(given) if trailing else self.at([value.tolist() for value in given])
        for k, row in enumerate(rows):
            out[k] = row
        if self.shape[1] == 1 and not self.matrix:
            return out
        return out.reshape(self.shape[1], self.shape[0], *trailing).swapaxes(0, 1)

    def at(self, arguments: Sequence[Value]) -> list[Value]:
        """Entries of the result, column by column, for arguments of numbers, symbols or arrays."""
        values: list[Value] | None = None
        if all(type(entry) is float for argument in arguments for entry in argument):
            with suppress(ArithmeticError, ValueError, KeyError):  # outside of the domain numpy gives nan
                values = self.evaluated(arguments, _PYTHON)
        if values is None:
            with np.errstate(all="ignore"):
                values = self.evaluated(arguments, NUMPY)
        return [values[k] if k >= 0 else 0.0 for k in self.results.tolist()]

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
        program = _program_of(self)
        functions = [_not_evaluated if name in (INPUT, CONSTANT) else operations[name] for name in self.operations]
        values: list[Value] = [None] * len(self.code)
        for place, argument, entry in program.inputs:
            values[place] = arguments[argument][entry]
        for place, number in program.constants:
            values[place] = constant(number)
        for place, operation, first, second, last_reads in program.steps:
            function = functions[operation]
            values[place] = function(values[first]) if second < 0 else function(values[first], values[second])
            for read in last_reads:  # their memory is used again
                values[read] = None
        return values


def _not_evaluated(*values: Value) -> Value:
    """In place of the function of an input or a constant."""
    raise TypeError("inputs and constants are no operations")


class _Program(NamedTuple):
    """Instructions of a tape: inputs (place, argument, entry), constants, and operations.

    Of an operation the place of its result, its number, the places of its arguments,
    the second -1 for none, and those that are read no more.
    """

    inputs: tuple[tuple[int, int, int], ...]
    constants: tuple[tuple[int, float], ...]
    steps: tuple[tuple[int, int, int, int, tuple[int, ...]], ...]


@lru_cache(maxsize=512)
def _program_of(tape: Tape) -> _Program:
    """Instructions of a tape, with the places that each reads last."""
    seen = set(tape.results.tolist())
    inputs, constants, steps = [], [], []
    for place, (operation, first, second) in reversed(list(enumerate(tape.code.tolist()))):
        name = tape.operations[operation]
        if name == INPUT:
            inputs.append((place, first, second))
        elif name == CONSTANT:
            constants.append((place, float(tape.constants[place])))
        else:
            new = tuple(sorted({first, second} - seen - {-1}))
            seen.update(new)
            steps.append((place, operation, first, second, new))
    return _Program(tuple(inputs), tuple(constants), tuple(reversed(steps)))


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
    "INV": lambda x: np.divide(1.0, x),
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
    "FMIN": lambda x, y: y if y < x or x != x else x,
    "FMAX": lambda x, y: y if y > x or x != x else x,
    **{name.upper(): getattr(math, name) for name in str.split("exp log sqrt sin cos tan asin acos atan atan2 hypot")},
    **{name.upper(): getattr(math, name) for name in str.split("sinh cosh tanh asinh acosh atanh log1p expm1 fabs")},
}
"""Operations on Python's numbers, which raise outside of their domain."""
