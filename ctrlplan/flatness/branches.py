"""Equations of a plant near an operating point: one branch of abs, min, where, ..., and inputs replaced by functions.

Differential flatness is a property of smooth equations. Operations that are not
smooth are replaced by their branch at the operating point. An input that enters
through one function of itself only, such as tan or a square, is replaced by the
value of that function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NoReturn

import casadi as ca
import numpy as np

from ctrlplan._types import Array
from ctrlplan.symbolic.taping import operations_of

Inverse = Callable[[ca.SX], ca.SX]
"""Inverse of a function of one variable."""


@dataclass(frozen=True, eq=False)
class Branch:
    """Smooth equations, valid while all `sides` are positive.

    Attributes
    ----------
    expressions : tuple of casadi.SX
        Equations of the branch.
    sides : casadi.SX
        Column of functions that are positive on the branch.
    notes : tuple of str
        Operation and argument of each side.
    """

    expressions: tuple[ca.SX, ...]
    sides: ca.SX
    notes: tuple[str, ...]


def branch_at(expressions: Sequence[ca.SX], variables: Sequence[ca.SX], point: Sequence[Array], name: str) -> Branch:
    """Branch of equations at an operating point.

    Raises
    ------
    ValueError
        If the operating point is on the edge of two branches, or an operation is
        a remainder, or is not smooth on any branch.
    """
    function = ca.Function("equations", list(variables), [ca.densify(ca.vertcat(*expressions))])
    tracer = _Tracer(variables, point, name)
    column = tracer.run(function)
    return Branch(tuple(_parts(column, expressions)), ca.vertcat(ca.SX(0, 1), *tracer.sides), tuple(tracer.notes))


class _Tracer:
    """Instruction list evaluated with expressions and, at the operating point, with numbers."""

    def __init__(self, variables: Sequence[ca.SX], point: Sequence[Array], name: str) -> None:
        self._entries = [ca.vertsplit(column) if column.numel() else [] for column in variables]
        self._point, self.name = point, name
        self.sides: list[ca.SX] = []
        self.notes: list[str] = []
        self._variables = variables

    def number(self, expression: ca.SX) -> float:
        """Value of an expression at the operating point."""
        return float(ca.Function("value", list(self._variables), [expression])(*self._point))

    def run(self, function: ca.Function) -> ca.SX:
        """Result of a function with its branches replaced."""
        work: dict[int, ca.SX] = {}
        out = ca.SX(function.numel_out(0), 1)
        for k, kind, given, target in operations_of(function):
            if kind == ca.OP_OUTPUT:
                out[target[1]] = work[given[0]]
            elif kind == ca.OP_INPUT:
                work[target[0]] = self._entries[given[0]][given[1]]
            elif kind == ca.OP_CONST:
                work[target[0]] = ca.SX(function.instruction_constant(k))
            else:
                values = [work[place] for place in given]
                work[target[0]] = self._of(kind, values)
        return out

    def _of(self, kind: int, values: list[ca.SX]) -> ca.SX:
        if kind not in _NOT_SMOOTH or all(value.is_constant() for value in values):
            return ca.SX.unary(kind, *values) if len(values) == 1 else ca.SX.binary(kind, *values)
        if kind == ca.OP_FMOD:
            raise ValueError(
                f"equations of {self.name} must be smooth near the operating point, got a remainder of "
                f"{_short(values[0])}; write them without it"
            )
        return _NOT_SMOOTH[kind](self, values)

    def side(self, argument: ca.SX, operation: str, shown: ca.SX) -> bool:
        """Whether an argument is positive at the operating point, noted as a condition of the branch."""
        value = self.number(argument)
        if argument.is_constant():
            return value > 0.0
        if not abs(value) > 0.0:  # also nan
            raise ValueError(
                f"operating point of {self.name} must be on one side of each operation that is not smooth, got "
                f"{operation} of {_short(shown)} at {value:g}; give values of states or inputs by at= or, for plans on "
                "both sides, equations with a smooth function in its place, such as np.sqrt(x**2 + d**2) for abs(x)"
            )
        self.sides.append(argument if value > 0.0 else -argument)
        self.notes.append(f"{operation} of {_short(shown)}, {'positive' if value > 0.0 else 'negative'}")
        return value > 0.0


def _absolute(tracer: _Tracer, values: list[ca.SX]) -> ca.SX:
    return values[0] if tracer.side(values[0], "abs", values[0]) else -values[0]


def _sign(tracer: _Tracer, values: list[ca.SX]) -> ca.SX:
    return ca.SX(1.0) if tracer.side(values[0], "sign", values[0]) else ca.SX(-1.0)


def _chosen(smaller: bool) -> Callable[[_Tracer, list[ca.SX]], ca.SX]:
    def choice(tracer: _Tracer, values: list[ca.SX]) -> ca.SX:
        first, second = values
        name = "min" if smaller else "max"
        positive = tracer.side(first - second, name, ca.vertcat(first, second))
        return second if positive == smaller else first

    return choice


def _compared(name: str, equal: float | None = None) -> Callable[[_Tracer, list[ca.SX]], ca.SX]:
    def comparison(tracer: _Tracer, values: list[ca.SX]) -> ca.SX:
        difference = values[1] - values[0]
        greater = tracer.side(difference, name, ca.vertcat(*values))
        return ca.SX(float(greater) if equal is None else equal)

    return comparison


def _whole(tracer: _Tracer, values: list[ca.SX], up: bool) -> ca.SX:
    value = tracer.number(values[0])
    low = np.floor(value)
    tracer.side(values[0] - low, "floor", values[0])
    tracer.side(low + 1.0 - values[0], "floor", values[0])
    return ca.SX(float(low + up))


def _copied(tracer: _Tracer, values: list[ca.SX]) -> ca.SX:
    size = _absolute(tracer, values[:1])
    return size if tracer.side(values[1], "copysign", values[1]) else -size


def _logical(tracer: _Tracer, values: list[ca.SX]) -> NoReturn:
    raise ValueError(f"equations of {tracer.name} must have conditions of comparisons, got {_short(values[0])}")


def _selected(tracer: _Tracer, values: list[ca.SX]) -> ca.SX:
    condition, value = values
    if not condition.is_constant():
        return _logical(tracer, values)
    return value if float(condition) else ca.SX(0)


_NOT_SMOOTH: dict[int, Callable[[_Tracer, list[ca.SX]], ca.SX]] = {
    ca.OP_FABS: _absolute,
    ca.OP_SIGN: _sign,
    ca.OP_FMIN: _chosen(smaller=True),
    ca.OP_FMAX: _chosen(smaller=False),
    ca.OP_LT: _compared("comparison"),
    ca.OP_LE: _compared("comparison"),
    ca.OP_EQ: _compared("comparison", 0.0),
    ca.OP_NE: _compared("comparison", 1.0),
    ca.OP_FLOOR: lambda tracer, values: _whole(tracer, values, False),
    ca.OP_CEIL: lambda tracer, values: _whole(tracer, values, True),
    ca.OP_COPYSIGN: _copied,
    ca.OP_NOT: _logical,
    ca.OP_AND: _logical,
    ca.OP_OR: _logical,
    ca.OP_IF_ELSE_ZERO: _selected,
    ca.OP_FMOD: _logical,
}
"""Operations that are not smooth; conditions of them are constants once their comparisons are replaced."""


def _short(expression: ca.SX) -> str:
    text = str(expression).removeprefix("SX(").removesuffix(")")
    return text if len(text) <= 60 else text[:57] + "..."


def _parts(column: ca.SX, expressions: Sequence[ca.SX]) -> list[ca.SX]:
    """A column divided as the expressions that it was made of."""
    ends = np.cumsum([0, *(expression.numel() for expression in expressions)]).tolist()
    return [column[a:b] for a, b in pairwise(ends)]


@dataclass(frozen=True, eq=False)
class Replacement:
    """Input replaced by the value of the one function of it in the equations.

    Attributes
    ----------
    symbol : casadi.SX
        The new input.
    value : casadi.SX
        The function, of the old input.
    inverse : casadi.SX
        The old input as a function of `symbol`, on the branch of the operating point.
    """

    symbol: ca.SX
    value: ca.SX
    inverse: ca.SX


def replaced_input(
    expressions: Sequence[ca.SX], variables: Sequence[ca.SX], given: ca.SX, at: float
) -> tuple[list[ca.SX], Replacement] | None:
    """Equations with an input replaced by the function through which alone it enters, or None.

    Parameters
    ----------
    expressions : sequence of casadi.SX
        Equations.
    variables : sequence of casadi.SX
        Symbols of the equations, without the input.
    given : casadi.SX
        The input.
    at : float
        Its value at the operating point.
    """
    function = ca.Function(
        "equations", [*variables, given], [ca.densify(ca.cse(ca.vertcat(ca.SX(0, 1), *expressions)))]
    )
    position = len(variables)
    work: dict[int, ca.SX] = {}
    uses: dict[int, list[tuple[int, tuple[int, ...]]]] = {}
    place: dict[int, int] = {}  # work register -> instruction
    steps: list[tuple[int, tuple[int, ...], float]] = []
    outputs: list[tuple[int, int]] = []
    for k, kind, arguments, target in operations_of(function):
        if kind == ca.OP_OUTPUT:
            outputs.append((target[1], place[arguments[0]]))
            uses.setdefault(place[arguments[0]], []).append((-1, ()))
            continue
        sources = arguments if kind == ca.OP_INPUT else tuple(place[a] for a in arguments)
        constant = float(function.instruction_constant(k)) if kind == ca.OP_CONST else 0.0
        steps.append((kind, sources, constant))
        place[target[0]] = len(steps) - 1
        if kind != ca.OP_INPUT:
            for source in set(sources):
                uses.setdefault(source, []).append((len(steps) - 1, sources))
    found = _chain(steps, uses, position, at)
    if found is None:
        return None
    node, chain = found
    symbol = ca.SX.sym(f"{given.name()}_function")
    entries = [ca.vertsplit(column) if column.numel() else [] for column in [*variables, given]]
    for k, (kind, sources, constant) in enumerate(steps):
        if k == node:
            work[k] = symbol
        elif kind == ca.OP_INPUT:
            work[k] = entries[sources[0]][sources[1]]
        elif kind == ca.OP_CONST:
            work[k] = ca.SX(constant)
        else:
            values = [work[s] for s in sources]
            work[k] = ca.SX.unary(kind, *values) if len(values) == 1 else ca.SX.binary(kind, *values)
    column = ca.SX(function.numel_out(0), 1)
    for row, source in outputs:
        column[row] = work[source]
    value, inverse = given, symbol
    for step in chain:
        value = step.forward(value)
    for step in reversed(chain):
        inverse = step.backward(inverse)
    return _parts(column, expressions), Replacement(symbol, value, inverse)


@dataclass(frozen=True, eq=False)
class _Link:
    """One invertible operation of a chain."""

    forward: Callable[[ca.SX], ca.SX]
    backward: Callable[[ca.SX], ca.SX]
    linear: bool


def _chain(
    steps: list[tuple[int, tuple[int, ...], float]],
    uses: dict[int, list[tuple[int, tuple[int, ...]]]],
    position: int,
    at: float,
) -> tuple[int, list[_Link]] | None:
    """Last instruction and operations of the function through which alone an input enters."""
    node = next((k for k, step in enumerate(steps) if step[0] == ca.OP_INPUT and step[1][0] == position), None)
    links: list[_Link] = []
    found: tuple[int, list[_Link]] | None = None
    value = at
    while node is not None and len(following := uses.get(node, [])) == 1:
        after, sources = following[0]
        if after < 0:
            break
        others = [s for s in sources if s != node]
        if any(steps[s][0] != ca.OP_CONST for s in others):
            break
        link = _link(steps[after][0], [steps[s][2] for s in others], sources.index(node), value)
        if link is None:
            break
        links.append(link)
        value = float(link.forward(ca.SX(value)))
        node = after
        if not link.linear:
            found = (node, list(links))
    return found


def _link(kind: int, constants: list[float], position: int, value: float) -> _Link | None:
    """Operation on a scalar with its inverse near a value, or None."""
    if constants:
        make = _WITH_CONSTANTS.get(kind)
        inverse = None if make is None else make(constants[0], position == 0, value)
        linear = kind in _LINEAR and not (kind == ca.OP_DIV and position == 1)
        return None if inverse is None else _Link(_binary(kind, constants[0], position), inverse, linear)
    known = _INVERSES.get(kind)
    if known is None or (kind == ca.OP_SQ and value == 0.0):
        return None
    return _Link(lambda x: ca.SX.unary(kind, x), known(value), kind in _LINEAR)


def _divided(c: float, first: bool, value: float) -> Inverse | None:
    """Inverse of x/c, or of c/x."""
    if first:
        return lambda y: y * c
    return (lambda y: c / y) if c and value else None


def _raised(c: float, first: bool, value: float) -> Inverse | None:
    """Inverse of x to the power of c."""
    return (lambda y: ca.power(y, 1.0 / c)) if first and c and value > 0.0 else None


_WITH_CONSTANTS: dict[int, Callable[[float, bool, float], Inverse | None]] = {
    ca.OP_ADD: lambda c, first, value: lambda y: y - c,
    ca.OP_SUB: lambda c, first, value: (lambda y: y + c) if first else (lambda y: c - y),
    ca.OP_MUL: lambda c, first, value: (lambda y: y / c) if c else None,
    ca.OP_DIV: _divided,
    ca.OP_POW: _raised,
    ca.OP_CONSTPOW: _raised,
}
"""Inverse of an operation with a constant c, which is the second argument if `first`, near a value."""


def _binary(kind: int, constant: float, position: int) -> Callable[[ca.SX], ca.SX]:
    if position == 0:
        return lambda x: ca.SX.binary(kind, x, ca.SX(constant))
    return lambda x: ca.SX.binary(kind, ca.SX(constant), x)


_LINEAR = (ca.OP_NEG, ca.OP_TWICE, ca.OP_ASSIGN, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV)

_INVERSES: dict[int, Callable[[float], Inverse]] = {
    ca.OP_NEG: lambda value: lambda y: -y,
    ca.OP_TWICE: lambda value: lambda y: 0.5 * y,
    ca.OP_ASSIGN: lambda value: lambda y: y,
    ca.OP_SQ: lambda value: (lambda y: ca.sqrt(y)) if value > 0.0 else (lambda y: -ca.sqrt(y)),
    ca.OP_SQRT: lambda value: lambda y: y * y,
    ca.OP_EXP: lambda value: ca.log,
    ca.OP_LOG: lambda value: ca.exp,
    ca.OP_SINH: lambda value: ca.asinh,
    ca.OP_TANH: lambda value: ca.atanh,
    ca.OP_ATAN: lambda value: ca.tan,
    ca.OP_ASINH: lambda value: ca.sinh,
    ca.OP_EXPM1: lambda value: ca.log1p,
    ca.OP_LOG1P: lambda value: ca.expm1,
    ca.OP_TAN: lambda value: lambda y: ca.atan(y) + np.pi * np.round(value / np.pi),
    ca.OP_INV: lambda value: lambda y: 1.0 / y,
}
"""Inverse of each operation on the branch of a value."""
