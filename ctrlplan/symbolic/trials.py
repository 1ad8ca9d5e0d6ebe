"""Trial calls of blocks on copies of their functions.

Direct feedthrough and reproducibility of a block can only be found by calls of its
functions. Such trial calls are made on copies of the functions, with copies of the
objects that they refer to, so that they have no effect on a block with memory.

A `Keeper` in contrast calls the functions themselves and restores all contents.
Both are required: two memories at one time, of a run and of a second attempt,
require copies, as do random generators, whose state cannot be compared. Only a
`Keeper` guarantees that *nothing* is stored anywhere, and detects whether a call
has changed anything.
"""

from __future__ import annotations

import copy
import dis
import functools
import inspect
from collections.abc import Callable, Iterator
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._types import Array, System, Value
from ctrlplan.symbolic.isolation import tried
from ctrlplan.traits import declare, traits_of

_DEPTH = 6
"""Maximum depth of the copied function calls."""

_LIBRARIES = frozenset({"casadi", "control", "ctrlplan", "math", "matplotlib", "numpy", "pandas", "scipy", "sympy"})
"""Packages whose functions do not store data of a block."""

_STORES = frozenset({"STORE_DEREF", "STORE_GLOBAL", "DELETE_DEREF", "DELETE_GLOBAL", "STORE_ATTR", "IMPORT_NAME"})
"""Instructions by which a function may store data."""

_CODES = 1024
"""Results for code objects, to read their instructions once."""

_PLAIN = (
    type(None),
    bool,
    int,
    float,
    complex,
    str,
    bytes,
    type,
    ModuleType,
    BuiltinFunctionType,
    np.ufunc,
    np.generic,
)


def trial_copy(system: System) -> System:
    """Copy of a block whose functions share no data with those of the block.

    Parameters
    ----------
    system : control.NonlinearIOSystem
        Block; the inner system of a sampled one is copied as well.
    """
    made, memo = copy.copy(system), {id(system): system}
    for name in ("updfcn", "outfcn"):
        function = getattr(system, name, None)
        if function is not None:
            setattr(made, name, _function(function, memo, _DEPTH))
    traits = traits_of(system)
    if traits.block is not None and not isinstance(traits.block, ct.StateSpace):
        declare(made, block=copy.deepcopy(traits.block) if _levels(traits.block) else trial_copy(traits.block))
    elif traits.sample is not None:
        declare(made, sample=_function(traits.sample, memo, _DEPTH))
    return made


def can_remember(system: System) -> bool:
    """Whether a block may have memory in addition to its state: False is certain, True is not."""
    traits = traits_of(system)
    inner = traits.block
    if inner is not None:
        return _levels(inner) or (not isinstance(inner, ct.StateSpace) and can_remember(inner))
    functions = (getattr(system, "updfcn", None), getattr(system, "outfcn", None), traits.sample)
    return any(function is not None and _has_memory(function, set(), _DEPTH) for function in functions)


def values_of(function: Callable[..., ArrayLike], *arguments: object) -> Array | None:
    """Values of a trial call as an array (n,); None if the arguments are outside of the function's domain."""
    return tried(lambda: np.array(np.ravel(function(*arguments)), dtype=float), None)


def reads(function: Callable[..., Value], position: int) -> bool:
    """Whether the code of a function may use an argument: False is certain, True is not.

    Parameters
    ----------
    function : callable
        Function of (t, x, u, params).
    position : int
        Position of the argument.
    """
    if isinstance(function, functools.partial):
        return bool(function.keywords) or reads(function.func, position + len(function.args))
    if isinstance(function, MethodType):
        return reads(function.__func__, position + 1)
    if not isinstance(function, FunctionType):
        call = next((vars(kind)["__call__"] for kind in type(function).__mro__ if "__call__" in vars(kind)), None)
        return not isinstance(call, FunctionType) or reads(call, position + 1)
    code = inspect.unwrap(function).__code__
    return function.__code__ is not code or position >= code.co_argcount or _reads(code, position)


@functools.lru_cache(_CODES)
def _reads(code: CodeType, position: int) -> bool:
    """Whether a code object may use an argument."""
    name = code.co_varnames[position]
    if name in code.co_cellvars or any(i.opname in ("IMPORT_NAME", "IMPORT_STAR") for i in dis.get_instructions(code)):
        return True
    called = {*code.co_names} & {"locals", "vars", "eval", "exec"}
    loaded = any(i.argval == name or (isinstance(i.argval, tuple) and name in i.argval) for i in _loads(code))
    return bool(called) or loaded


def _loads(code: CodeType) -> Iterator[dis.Instruction]:
    return (i for i in dis.get_instructions(code) if i.opname.startswith("LOAD_") or "FAST" in i.opname)


def _function(function: Value, memo: dict[int, object], depth: int) -> Value:
    """Copy of a callable."""
    if isinstance(function, functools.partial):
        arguments = [_value(entry, memo, depth) for entry in function.args]
        keywords = {key: _value(entry, memo, depth) for key, entry in function.keywords.items()}
        return functools.partial(_function(function.func, memo, depth), *arguments, **keywords)
    if isinstance(function, MethodType) and not of_library(function.__func__):
        return MethodType(_function(function.__func__, memo, depth), _value(function.__self__, memo, depth))
    if not isinstance(function, FunctionType):
        return function if isinstance(function, MethodType) else _value(function, memo, depth)
    if id(function) in memo:
        return memo[id(function)]
    if depth == 0 or of_library(function):
        return function
    space = dict(function.__globals__)
    cells = tuple(CellType() for _ in function.__closure__ or ())
    made = FunctionType(function.__code__, space, function.__name__, None, cells or None)
    memo[id(function)] = made
    made.__dict__.update(function.__dict__)
    made.__defaults__ = _value(function.__defaults__, memo, depth)
    made.__kwdefaults__ = _value(function.__kwdefaults__, memo, depth)
    for cell, own in zip(cells, function.__closure__ or (), strict=True):
        try:
            cell.cell_contents = _value(own.cell_contents, memo, depth - 1)
        except ValueError:  # an empty cell
            continue
    for name in _names(function.__code__):
        if name in space:
            space[name] = _value(space[name], memo, depth - 1)
    return made


def _value(value: Value, memo: dict[int, object], depth: int) -> Value:
    """Copy of an object that a function refers to."""
    if isinstance(value, _PLAIN) or value is None:
        return value
    if isinstance(value, FunctionType | MethodType | functools.partial):
        return _function(value, memo, depth)
    if isinstance(value, ct.NonlinearIOSystem) and not isinstance(value, ct.InterconnectedSystem | ct.StateSpace):
        return trial_copy(value)
    try:
        return copy.deepcopy(value, memo)
    except Exception:  # an object that cannot be copied is shared
        return value


def _has_memory(value: object, seen: set[int], depth: int) -> bool:
    """Whether a function, or an object that it refers to, may store data between calls."""
    if isinstance(value, _PLAIN) or id(value) in seen:
        return False
    seen.add(id(value))
    if isinstance(value, functools.partial):
        parts: tuple[object, ...] = (value.func, *value.args, *value.keywords.values())
    elif isinstance(value, tuple | frozenset):
        parts = tuple(value)
    elif isinstance(value, np.ndarray):
        return value.flags.writeable
    elif isinstance(value, MethodType):
        return not of_library(value.__func__)
    elif isinstance(value, ct.InterconnectedSystem):
        parts = tuple(value.syslist)
    elif isinstance(value, ct.NonlinearIOSystem):
        return not isinstance(value, ct.StateSpace) and can_remember(value)
    elif isinstance(value, np.random.Generator | np.random.RandomState | np.random.BitGenerator):
        return True
    elif isinstance(value, FunctionType):
        if of_library(value):
            return False
        code = value.__code__
        if "random" in _names(code):  # the generators of numpy, or of Python
            return True
        if depth == 0 or _stores(code):
            return True
        named = [value.__globals__[name] for name in _names(code) if name in value.__globals__]
        parts = (*_contents(value), *(value.__defaults__ or ()), *(value.__kwdefaults__ or {}).values(), *named)
    else:
        return not of_library(type(value)) or hasattr(type(value), "step")  # a `Stepper`, or a solver of scipy
    return any(_has_memory(part, seen, depth - 1) for part in parts)


@functools.lru_cache(_CODES)
def _stores(code: CodeType) -> bool:
    """Whether a code object may store data."""
    return any(i.opname in _STORES for i in dis.get_instructions(code))


def _contents(function: FunctionType) -> Iterator[object]:
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # an empty cell
            continue


def of_library(thing: object) -> bool:
    """Whether a function or class is of a library whose objects, except arrays, are not changed by calls."""
    if isinstance(thing, functools.partial):
        return of_library(thing.func)
    return str(getattr(thing, "__module__", "")).partition(".")[0] in _LIBRARIES


def _levels(system: System) -> bool:
    return isinstance(system, ct.InterconnectedSystem) and not isinstance(system, ct.StateSpace)


def _names(code: CodeType) -> set[str]:
    """Global names in a function's code and in nested functions."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))
