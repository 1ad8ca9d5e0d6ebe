"""Instruction lists of CasADi functions: read, and made into tapes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import casadi as ca

from ctrlplan.symbolic.tape import CONSTANT, INPUT, NUMPY, Instruction, Tape


def tape_of(arguments: Sequence[ca.SX], result: ca.SX, *, matrix: bool = False) -> Tape:
    """Tape of an expression as a function of columns of symbols, common subexpressions evaluated once.

    The result of one column has the shape (rows, ...), or with `matrix` (rows, 1, ...).
    """
    function = ca.Function("tape", list(arguments), [ca.densify(ca.cse(result))])
    place: dict[int, int] = {}
    instructions: list[Instruction] = []
    results = [-1] * function.numel_out(0)
    names = _operation_names()
    for k, kind, given, target in operations_of(function):
        if kind == ca.OP_OUTPUT:
            results[target[1]] = place[given[0]]
            continue
        if kind == ca.OP_CONST:
            found = Instruction(CONSTANT, (), float(function.instruction_constant(k)))
        elif kind == ca.OP_INPUT:
            found = Instruction(INPUT, given)
        else:
            found = Instruction(names[kind], tuple(place[g] for g in given))
        instructions.append(found)
        place[target[0]] = len(instructions) - 1
    return Tape.of(instructions, results, function.size_out(0), matrix)


def operations_of(function: ca.Function) -> Iterator[tuple[int, int, tuple[int, ...], tuple[int, ...]]]:
    """Number, kind, arguments and places of the result of each instruction of a function of SX symbols."""
    for k in range(function.n_instructions()):
        kind, given, target = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        yield k, kind, tuple(given), tuple(target)


@cache
def _operation_names() -> dict[int, str]:
    """Names of CasADi's operations by their kinds."""
    return {getattr(ca, f"OP_{name}"): name for name in NUMPY}
