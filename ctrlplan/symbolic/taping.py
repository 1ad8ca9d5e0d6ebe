"""Instruction lists of CasADi functions: read, and made into tapes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import casadi as ca

from ctrlplan.symbolic.tape import Instruction, Tape


def tape_of(arguments: Sequence[ca.SX], result: ca.SX, *, matrix: bool = False) -> Tape:
    """Tape of an expression as a function of columns of symbols, common subexpressions evaluated once.

    The result of one column has the shape (rows, ...), or with `matrix` (rows, 1, ...).
    """
    function = ca.Function("tape", list(arguments), [ca.densify(ca.cse(result))])
    place: dict[int, int] = {}
    instructions: list[Instruction] = []
    results = [-1] * function.numel_out(0)
    for k, operation, given, target in operations_of(function):
        if operation == "OUTPUT":
            results[target[1]] = place[given[0]]
            continue
        if operation == "CONST":
            found = Instruction(operation, (), float(function.instruction_constant(k)))
        else:
            found = Instruction(operation, given if operation == "INPUT" else tuple(place[g] for g in given))
        instructions.append(found)
        place[target[0]] = len(instructions) - 1
    return Tape.of(instructions, results, function.size_out(0), matrix)


def operations_of(function: ca.Function) -> Iterator[tuple[int, str, tuple[int, ...], tuple[int, ...]]]:
    """Number, name, arguments and places of the result of each instruction of a function of SX symbols."""
    names = _operation_names()
    for k in range(function.n_instructions()):
        name = names[function.instruction_id(k)]
        yield k, name, tuple(function.instruction_input(k)), tuple(function.instruction_output(k))


@cache
def _operation_names() -> dict[int, str]:
    """Names of CasADi's operations by their numbers."""
    return {getattr(ca, name): name[3:] for name in dir(ca) if name.startswith("OP_")}
