"""Functions of CasADi at many points by numpy: each operation at all points, in place of all operations at each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from ctrlplan._types import Array, Value

_MEMORY, _FEWEST = 2**17, 256
"""Number of intermediate values in a block of points, which fit into the cache, and minimum number of its points."""


class ManyPoints:
    """Function of dense SX symbols at many points; its first result must be a dense column.

    Parameters
    ----------
    function : casadi.Function
        The function.

    Raises
    ------
    NotImplementedError
        If an operation has no counterpart in numpy.
    """

    def __init__(self, function: ca.Function) -> None:
        self._count, self._nresults = function.sz_w(), function.numel_out(0)
        self._constants: list[Array | float] = [0.0] * function.n_instructions()
        self._inputs: list[tuple[int, int, int]] = []
        self._steps: list[tuple[Callable[..., Value], int, int, list[int]]] = []
        value_at: dict[int, int] = {}  # instruction whose result is in a place
        for k in range(function.n_instructions()):
            kind, given = function.instruction_id(k), function.instruction_input(k)
            places = function.instruction_output(k)
            if kind == ca.OP_OUTPUT:
                self._steps.append((np.positive, k, self._count + places[1], [value_at[given[0]]]))
                continue
            if kind == ca.OP_INPUT:
                self._inputs.append((k, given[0], given[1]))
            elif kind == ca.OP_CONST:
                self._constants[k] = float(function.instruction_constant(k))
            elif kind in _OPERATIONS:
                self._steps.append((_OPERATIONS[kind], k, places[0], [value_at[place] for place in given]))
            else:
                raise NotImplementedError(f"operation {kind} of CasADi has no counterpart in numpy")
            value_at[places[0]] = k

    def __call__(self, arguments: Sequence[Array]) -> Array:
        """First result (nrows, npoints), for arguments (nrows, npoints), or (nrows,) if equal at all points."""
        npoints = next(given.shape[1] for given in arguments if given.ndim == 2)
        found = np.empty((self._nresults, npoints))
        size = min(npoints, max(_FEWEST, _MEMORY // max(1, self._count)))
        work = np.empty((self._count, size))
        with np.errstate(all="ignore"):
            for first in range(0, npoints, size):
                part = slice(first, first + size)
                results = found[:, part]
                places = [*work[:, : results.shape[1]], *results]
                values = list(self._constants)
                for k, i, row in self._inputs:
                    given = arguments[i][row]
                    values[k] = given[part] if given.ndim else given
                for operation, k, place, operands in self._steps:
                    values[k] = places[place]
                    operation(*[values[j] for j in operands], out=places[place])
        return found


def many_points(function: ca.Function) -> ManyPoints | None:
    """Function at many points; None if an operation has no counterpart in numpy."""
    try:
        return ManyPoints(function)
    except NotImplementedError:
        return None


def _twice(x: Array, out: Array) -> None:
    np.add(x, x, out=out)


def _inverse(x: Array, out: Array) -> None:
    np.divide(1.0, x, out=out)


def _not(x: Array, out: Array) -> None:
    np.equal(x, 0.0, out=out)


def _if_else_zero(x: Array, y: Array, out: Array) -> None:
    out[...] = np.where(np.not_equal(x, 0.0), y, 0.0)


_OPERATIONS: dict[int, Callable[..., Value]] = {
    ca.OP_ASSIGN: np.positive,
    ca.OP_NEG: np.negative,
    ca.OP_TWICE: _twice,
    ca.OP_INV: _inverse,
    ca.OP_SQ: np.square,
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_SQRT: np.sqrt,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_HYPOT: np.hypot,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_EXPM1: np.expm1,
    ca.OP_LOG1P: np.log1p,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_ASINH: np.arcsinh,
    ca.OP_ACOSH: np.arccosh,
    ca.OP_ATANH: np.arctanh,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_NOT: _not,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_IF_ELSE_ZERO: _if_else_zero,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_FABS: np.fabs,
    ca.OP_SIGN: np.sign,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_FMOD: np.fmod,
}
