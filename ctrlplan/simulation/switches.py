"""Where the equations of a compiled form switch: arguments of comparisons, abs, sign, min, max, floor and the like."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np


def switch_arguments(function: Any) -> Any:
    """Arguments whose changes of sign switch the equations of a function.

    Parameters
    ----------
    function : casadi.Function
        Of symbols of kind SX.

    Returns
    -------
    casadi.Function
        Of the same arguments; its one result is a column: x - y of a comparison
        or the larger of x and y, x of abs(x), sin(pi x) of floor(x), ...
    """
    inputs = [ca.SX.sym(function.name_in(i), function.sparsity_in(i)) for i in range(function.n_in())]
    entries = [value.nz for value in inputs]
    work: dict[int, Any] = {}
    found: list[Any] = []
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
            if kind in _SWITCHES:
                found.append(_SWITCHES[kind](*values))
            work[places[0]] = ca.SX.unary(kind, *values) if len(values) == 1 else ca.SX.binary(kind, *values)
    moving = [value for value in found if not value.is_constant()]
    return ca.Function("switches", inputs, [ca.densify(ca.vertcat(ca.SX(0, 1), *moving))])


def _difference(x: Any, y: Any) -> Any:
    return x - y


def _first(x: Any, *_: Any) -> Any:
    return x


def _whole(x: Any, *_: Any) -> Any:
    return ca.sin(np.pi * x)


_SWITCHES = {
    **dict.fromkeys((ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_FMIN, ca.OP_FMAX), _difference),
    **dict.fromkeys((ca.OP_FABS, ca.OP_SIGN, ca.OP_NOT, ca.OP_IF_ELSE_ZERO), _first),
    **dict.fromkeys((ca.OP_FLOOR, ca.OP_CEIL), _whole),
    **dict.fromkeys((ca.OP_AND, ca.OP_OR), lambda x, y: x + y - 1.5),
    ca.OP_FMOD: lambda x, y: ca.sin(np.pi * x / y),
    ca.OP_COPYSIGN: lambda x, y: y,
}
