"""Switches in the equations of a compiled form: arguments of comparisons, abs, sign, min, max, floor, etc."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from ctrlplan._types import Array

_GRID, _FINEST, _MAXIMUM = 4096, 2**17, 20_000
"""Initial and final number of intervals of the search grid, and maximum number of changes."""

_HALVINGS = 60
"""Number of bisections from the grid spacing to rounding of a time."""


def switch_arguments(function: ca.Function, bends: bool = True) -> ca.Function:
    """Arguments whose sign changes switch the equations of a function.

    Parameters
    ----------
    function : casadi.Function
        Function of SX symbols.
    bends : bool, optional
        Whether to include those of continuous functions, such as abs and max;
        otherwise those of jumps only.

    Returns
    -------
    casadi.Function
        Function of the same arguments with one column as result: x - y for a comparison
        or the maximum of x and y, x for abs(x), sin(pi x) for floor(x), ...
    """
    inputs = [ca.SX.sym(function.name_in(i), function.sparsity_in(i)) for i in range(function.n_in())]
    entries = [value.nz for value in inputs]
    work: dict[int, ca.SX] = {}
    found: list[ca.SX] = []
    for k in range(function.n_instructions()):
        kind, places = function.instruction_id(k), function.instruction_output(k)
        if kind == ca.OP_OUTPUT:
            continue
        given = function.instruction_input(k)
        if kind == ca.OP_INPUT:
            work[places[0]] = entries[given[0]][given[1]]
        elif kind == ca.OP_CONST:
            work[places[0]] = ca.SX(function.instruction_constant(k))
        else:
            values = [work[place] for place in given]
            if kind in _SWITCHES and (bends or kind not in _BENDS):
                found.append(_SWITCHES[kind](*values))
            work[places[0]] = ca.SX.unary(kind, *values) if len(values) == 1 else ca.SX.binary(kind, *values)
    moving = [value for value in found if not value.is_constant()]
    return ca.Function("switches", inputs, [ca.densify(ca.vertcat(ca.SX(0, 1), *moving))])


def changes_of_side(sides: Callable[[Array], Array], first: float, last: float) -> list[float]:
    """Times of sign changes in an interval.

    Parameters
    ----------
    sides : callable
        Maps times (n,) to signs (nswitches, n).
    first, last : float
        Interval.

    Returns
    -------
    list of float
        Accurate to rounding of times. The search grid is refined until doubling
        its size gives no further changes. Empty if there are more than 20,000.
    """
    count, known = _GRID, np.empty(0)
    while True:
        # The times found are added to the grid, for narrow intervals around a kink.
        t = np.union1d(np.linspace(first, last, count + 1), known)
        found = _apart(np.union1d(known, _located(sides, t)), 1e-12 * max(abs(first), abs(last), last - first))
        if found.size == known.size and count > _GRID:
            break
        if found.size > _MAXIMUM or count >= _FINEST:
            break
        known, count = found, 2 * count
    inner = found[(found > first) & (found < last)]
    return inner.tolist() if inner.size <= _MAXIMUM else []


def _apart(times: Array, tolerance: float) -> Array:
    """Increasing times without those within a tolerance of the previous one."""
    return times[np.diff(times, prepend=-np.inf) > tolerance]


def _located(sides: Callable[[Array], Array], t: Array) -> Array:
    """Times of sign changes between neighbouring times, by simultaneous bisection."""
    signs = sides(t)
    switch, before = np.nonzero(signs[:, 1:] != signs[:, :-1])
    if not switch.size or switch.size > _MAXIMUM:
        return np.empty(0)
    left, right, side = t[before], t[before + 1], signs[switch, before]
    for _ in range(_HALVINGS):
        middle = 0.5 * (left + right)
        same = sides(middle)[switch, np.arange(switch.size)] == side
        left, right = np.where(same, middle, left), np.where(same, right, middle)
    return np.unique(right)


def _difference(x: ca.SX, y: ca.SX) -> ca.SX:
    return x - y


def _distance(x: ca.SX, y: ca.SX) -> ca.SX:
    """Positive where x and y differ: a zero crossing of x - y does not switch their equality for any time."""
    return ca.fabs(x - y)


def _first(x: ca.SX, *_: ca.SX) -> ca.SX:
    return x


def _whole(x: ca.SX, *_: ca.SX) -> ca.SX:
    return ca.sin(np.pi * x)


_BENDS = (ca.OP_FMIN, ca.OP_FMAX, ca.OP_FABS)

_SWITCHES = {
    **dict.fromkeys((ca.OP_LT, ca.OP_LE, ca.OP_FMIN, ca.OP_FMAX), _difference),
    **dict.fromkeys((ca.OP_EQ, ca.OP_NE), _distance),
    **dict.fromkeys((ca.OP_FABS, ca.OP_SIGN, ca.OP_NOT, ca.OP_IF_ELSE_ZERO), _first),
    **dict.fromkeys((ca.OP_FLOOR, ca.OP_CEIL), _whole),
    **dict.fromkeys((ca.OP_AND, ca.OP_OR), lambda x, y: x + y - 1.5),
    ca.OP_FMOD: lambda x, y: ca.sin(np.pi * x / y),
    ca.OP_COPYSIGN: lambda x, y: y,
}
