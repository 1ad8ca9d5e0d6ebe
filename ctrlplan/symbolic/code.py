"""Names in the code of functions."""

from __future__ import annotations

import dis
import functools
import sys
import types
from collections.abc import Iterable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class Code:
    """Names in a code object and in nested ones: globals, attributes and strings, imported modules."""

    globals: tuple[str, ...]
    names: frozenset[str]
    imports: tuple[str, ...]


@functools.lru_cache(maxsize=4096)
def code_of(code: types.CodeType) -> Code:
    """Names in a code object and in nested ones."""
    globals_: dict[str, None] = {}
    imports: dict[str, None] = {}
    names: set[str] = set()
    for step in dis.get_instructions(code):
        name = step.argval if isinstance(step.argval, str) else ""
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME", "STORE_GLOBAL"):
            globals_[name] = None
        elif step.opname == "IMPORT_NAME":
            imports[name] = None
        if "ATTR" in step.opname or "METHOD" in step.opname or step.opname == "IMPORT_FROM":
            names.add(name)
    for constant in code.co_consts:
        names |= _strings(constant)
        if isinstance(constant, types.CodeType):
            inner = code_of(constant)
            globals_ |= dict.fromkeys(inner.globals)
            imports |= dict.fromkeys(inner.imports)
            names |= inner.names
    return Code(tuple(globals_), frozenset(names.union(code.co_varnames, globals_)), tuple(imports))


def imported_modules(name: str, package: str) -> Iterator[types.ModuleType]:
    """Modules that an import inside a function may refer to, in its package or a level above."""
    parts = package.split(".") if package else []
    for n in range(len(parts) + 1):
        module = sys.modules.get(".".join([*parts[:n], name]).strip("."))
        if module is not None:
            yield module


def _strings(constant: object) -> set[str]:
    if isinstance(constant, str):
        return {constant}
    return set().union(*map(_strings, constant)) if isinstance(constant, tuple | frozenset) else set()


def codes_of(roots: Iterable[object]) -> frozenset[types.CodeType]:
    """Code objects of the functions among some objects."""
    functions = (getattr(root, "__func__", root) for root in roots)
    return frozenset(function.__code__ for function in functions if isinstance(function, types.FunctionType))
