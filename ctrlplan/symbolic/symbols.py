"""CasADi symbols that support numpy's functions.

`float` of a symbol of CasADi itself returns nan, it has a hash, and it depends on
CasADi's numpy mode. Symbols of this module have no numeric value, no hash and no
truth value, so that a branch on one raises; CasADi is not changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NoReturn, TypeAlias

import casadi as ca
import numpy as np

from ctrlplan._types import Value

Operation: TypeAlias = Callable[..., Value]
"""Function of numbers and symbols."""

_LN2 = math.log(2.0)


class _Traced:
    """What numpy's functions call instead of themselves."""

    __slots__ = ()

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Value, **kwargs: Value) -> Value:
        return _by_elements(ufunc, method, inputs, kwargs)

    def __array_function__(
        self, function: Value, types: Value, args: Iterable[Value], kwargs: Mapping[str, Value]
    ) -> Value:
        return _by_function(function, args, kwargs)


class Symbol(_Traced):
    """Scalar CasADi expression with the operators and functions of a numpy scalar.

    Attributes
    ----------
    sx : casadi.SX
        The expression, 1 by 1.
    truth : bool
        Whether it is the result of a comparison, 1 if true and 0 if false.
    """

    __slots__ = ("sx", "truth")
    __hash__ = None  # type: ignore[assignment]
    __array_priority__ = 2000.0  # CasADi delegates operations to the operand of higher priority

    def __init__(self, sx: ca.SX, truth: bool = False) -> None:
        self.sx, self.truth = sx, truth

    def __repr__(self) -> str:
        return f"Symbol({self.sx})"

    def __bool__(self) -> NoReturn:
        raise TypeError("a branch on a signal or parameter cannot be traced; use np.where")

    def clip(self, low: Value = None, high: Value = None) -> Value:
        """Value clipped to limits."""
        return _clip(self, low, high)


class SymbolArray(_Traced, np.ndarray[tuple[int, ...], np.dtype[np.object_]]):
    """Array of symbols and numbers."""

    __array_priority__ = 2000.0


def symbol_array(column: ca.SX) -> SymbolArray:
    """Entries of a CasADi column as an array of symbols."""
    out = np.empty(column.numel(), dtype=object)
    for k in range(out.size):
        out[k] = Symbol(column[k])
    return out.view(SymbolArray)


def column_of(values: object) -> ca.SX:
    """CasADi column from the result of a block: a symbol, a number, a list or an array of them.

    Raises
    ------
    TypeError
        If an entry is neither a symbol nor a real number.
    """
    flat = np.ravel(np.asarray(values, dtype=object))
    return ca.vertcat(*[value.sx if isinstance(value, Symbol) else ca.SX(float(value)) for value in flat])


# Scalar operations


def _sx(value: Value) -> ca.SX:
    return value.sx if isinstance(value, Symbol) else ca.SX(float(value))


def _of(function: Operation, truth: bool = False) -> Operation:
    """Operation on symbols and numbers from one on CasADi expressions."""
    return lambda *values: Symbol(function(*map(_sx, values)), truth)


def _no_truths(function: Operation) -> Operation:
    """Operation on numbers only, as numpy defines it differently for conditions."""

    def checked(*values: Value) -> Value:
        if all(isinstance(value, bool | np.bool_) or getattr(value, "truth", False) for value in values):
            raise TypeError("sums and signs of conditions cannot be traced: numpy adds conditions by 'or'")
        return _of(function)(*values)

    return checked


def _truths(function: Operation) -> Operation:
    """Operation on conditions only, as it is bitwise for numbers."""

    def checked(*values: Value) -> Value:
        if not all(isinstance(value, bool | np.bool_) or getattr(value, "truth", False) for value in values):
            raise TypeError("operations on bits cannot be traced")
        return _of(function, truth=True)(*values)

    return checked


def _remainder(x: ca.SX, y: ca.SX) -> ca.SX:
    """Remainder with the sign of y, exact as in Python."""
    rest = ca.fmod(x, y)
    return rest + ca.if_else(rest * y < 0, y, 0.0)


def _floor_divide(x: ca.SX, y: ca.SX) -> ca.SX:
    """Quotient as in Python: (x - remainder)/y, rounded to the nearest integer."""
    exact = (x - _remainder(x, y)) / y
    return ca.floor(exact + 0.5)


def _rint(x: ca.SX) -> ca.SX:
    """Nearest integer, halves to even."""
    low = ca.floor(x)
    rest = x - low
    up = ca.logic_or(rest > 0.5, ca.logic_and(ca.eq(rest, 0.5), ca.ne(ca.fmod(low, 2.0), 0.0)))
    return low + up


def _xor(x: ca.SX, y: ca.SX) -> ca.SX:
    return ca.ne(ca.ne(x, 0.0), ca.ne(y, 0.0))


def _heaviside(x: ca.SX, at_zero: ca.SX) -> ca.SX:
    return ca.if_else(ca.eq(x, 0.0), at_zero, x > 0.0)


def _logaddexp(x: ca.SX, y: ca.SX) -> ca.SX:
    return ca.fmax(x, y) + ca.log1p(ca.exp(-ca.fabs(x - y)))


_OPERATIONS: dict[str, Operation] = {
    **{
        name: _of(getattr(ca, name))
        for name in str.split("sqrt exp expm1 log log1p log10 sin cos tan sinh cosh tanh floor ceil sign")
    },
    **{name: _of(getattr(ca, name)) for name in str.split("fabs fmin fmax fmod hypot copysign power erf")},
    **{f"arc{name}": _of(getattr(ca, f"a{name}")) for name in str.split("sin cos tan sinh cosh tanh")},
    "arctan2": _of(ca.atan2),
    "absolute": _of(ca.fabs),
    "minimum": _of(ca.fmin),
    "maximum": _of(ca.fmax),
    "float_power": _of(ca.power),
    "positive": _of(lambda x: x),
    "conjugate": _of(lambda x: x),
    "negative": _no_truths(lambda x: -x),
    "add": _no_truths(lambda x, y: x + y),
    "subtract": _no_truths(lambda x, y: x - y),
    "multiply": lambda x, y: Symbol(_sx(x) * _sx(y), getattr(x, "truth", False) and getattr(y, "truth", False)),
    "divide": _of(lambda x, y: x / y),
    "square": _of(lambda x: x * x),
    "reciprocal": _of(lambda x: 1.0 / x),
    "cbrt": _of(lambda x: ca.sign(x) * ca.power(ca.fabs(x), 1.0 / 3.0)),
    "exp2": _of(lambda x: ca.power(2.0, x)),
    "log2": _of(lambda x: ca.log(x) / _LN2),
    "trunc": _of(lambda x: ca.sign(x) * ca.floor(ca.fabs(x))),
    "rint": _of(_rint),
    "remainder": _of(_remainder),
    "floor_divide": _of(_floor_divide),
    "deg2rad": _of(lambda x: x * (math.pi / 180.0)),
    "radians": _of(lambda x: x * (math.pi / 180.0)),
    "rad2deg": _of(lambda x: x * (180.0 / math.pi)),
    "degrees": _of(lambda x: x * (180.0 / math.pi)),
    "heaviside": _of(_heaviside),
    "logaddexp": _of(_logaddexp),
    "expit": _of(lambda x: 1.0 / (1.0 + ca.exp(-x))),
    "less": _of(lambda x, y: x < y, truth=True),
    "less_equal": _of(lambda x, y: x <= y, truth=True),
    "greater": _of(lambda x, y: y < x, truth=True),
    "greater_equal": _of(lambda x, y: y <= x, truth=True),
    "equal": _of(ca.eq, truth=True),
    "not_equal": _of(ca.ne, truth=True),
    "logical_not": _of(ca.logic_not, truth=True),
    "logical_and": _of(ca.logic_and, truth=True),
    "logical_or": _of(ca.logic_or, truth=True),
    "logical_xor": _of(_xor, truth=True),
    "invert": _truths(ca.logic_not),
    "bitwise_and": _truths(ca.logic_and),
    "bitwise_or": _truths(ca.logic_or),
    "bitwise_xor": _truths(_xor),
}
"""numpy's elementwise functions, by name, on symbols and numbers."""


def _clip(x: Value, low: Value = None, high: Value = None) -> Value:
    above = x if low is None else _OPERATIONS["maximum"](x, low)
    return above if high is None else _OPERATIONS["minimum"](above, high)


_OPERATIONS["clip"] = _clip


def _choice(condition: Value, x: Value, y: Value) -> Value:
    if not isinstance(condition, Symbol):
        return x if condition else y
    truth = all(getattr(value, "truth", isinstance(value, bool | np.bool_)) for value in (x, y))
    return Symbol(ca.if_else(condition.sx, _sx(x), _sx(y)), truth)


# numpy's protocols


def _by_elements(ufunc: np.ufunc, method: str, inputs: Sequence[Value], kwargs: dict[str, Value]) -> Value:
    """Result of an elementwise function of numpy."""
    plain = [_plain(value) for value in inputs]
    out = kwargs.pop("out", None)
    options = {key: kwargs[key] for key in ("axis", "keepdims", "axes") if kwargs.get(key) is not None}
    if ufunc.__name__ == "matmul" and method == "__call__":
        found = ufunc(*plain, **options)
    else:
        operation = _OPERATIONS.get(ufunc.__name__)
        if operation is None or method not in ("__call__", "reduce", "accumulate", "outer"):
            raise TypeError(f"np.{ufunc.__name__} of a signal or parameter cannot be traced")
        kind = kwargs.get("dtype")
        other = kind is not None and np.dtype(kind).kind not in "fO"
        if kwargs.get("where", True) is not True or "initial" in kwargs or other:
            raise TypeError(f"options of np.{ufunc.__name__} cannot be traced")
        if method == "reduce" and "axis" not in options:
            options["axis"] = kwargs.get("axis", 0)
        vectorized = np.frompyfunc(operation, len(inputs) if method == "__call__" else 2, 1)
        with np.errstate(all="ignore"):  # numpy 1 warns of floating-point flags that are set by the way
            found = getattr(vectorized, method)(*plain, **options)
    if out is None:
        return _wrapped(found)
    out[0][...] = _plain(found)
    return out[0]


def _by_function(function: Value, args: Iterable[Value], kwargs: Mapping[str, Value]) -> Value:
    """Result of a function of numpy, from the table or by numpy's implementation."""
    known = _FUNCTIONS.get(function)
    if known is not None:
        return known(*args, **kwargs)
    proxy = np.empty((), dtype=object).view(SymbolArray)
    given = tuple(map(_arrays, args)), {key: _arrays(value) for key, value in kwargs.items()}
    return _wrapped(np.ndarray.__array_function__(proxy, function, (SymbolArray,), *given))


def _where(condition: Value, x: Value, y: Value) -> Value:
    return _wrapped(np.frompyfunc(_choice, 3, 1)(*map(_plain, (condition, x, y))))


def _select(conditions: Sequence[Value], choices: Sequence[Value], default: Value = 0) -> Value:
    found = default
    for condition, choice in zip(reversed(list(conditions)), reversed(list(choices)), strict=True):
        found = _where(condition, choice, found)
    return found


def _clipped(a: Value, a_min: Value = None, a_max: Value = None, **kwargs: Value) -> Value:
    low, high = kwargs.pop("min", a_min), kwargs.pop("max", a_max)
    if any(value is not None for value in kwargs.values()):
        raise TypeError("options of np.clip cannot be traced")
    return _wrapped(np.frompyfunc(_clip, 3, 1)(*map(_plain, (a, low, high))))


def _of_nan(*_: Value, **__: Value) -> NoReturn:
    raise TypeError("functions of nan cannot be traced")


_FUNCTIONS: dict[Value, Operation] = {
    np.where: _where,
    np.select: _select,
    np.clip: _clipped,
    np.nan_to_num: _of_nan,
}
"""Functions of numpy that are not implemented by elementwise ones."""


def _plain(value: Value) -> Value:
    """Plain array of objects, or the number itself."""
    if isinstance(value, Symbol):
        out = np.empty((), dtype=object)
        out[()] = value
        return out
    return value.view(np.ndarray) if isinstance(value, SymbolArray) else value


def _wrapped(value: Value) -> Value:
    if type(value) is np.ndarray and value.dtype == object:
        return value.view(SymbolArray) if value.ndim else value[()]
    return value


def _arrays(value: Value) -> Value:
    """Arguments with symbols replaced by arrays, also in lists."""
    if isinstance(value, Symbol):
        return _plain(value).view(SymbolArray)
    return type(value)(map(_arrays, value)) if type(value) in (list, tuple) else value


def _operator(name: str, reflected: bool) -> Callable[[Symbol, Value], Value]:
    ufunc = getattr(np, name)

    def operation(self: Symbol, other: Value) -> Value:
        if not isinstance(other, Symbol | int | float | np.generic | np.ndarray):
            return NotImplemented
        return ufunc(other, self) if reflected else ufunc(self, other)

    return operation


def _equip() -> None:
    """Add Python's operators to `Symbol`, and the methods that numpy calls for entries of arrays of objects."""
    pairs = {"sub": "subtract", "mul": "multiply", "truediv": "divide", "pow": "power", "mod": "remainder"}
    pairs |= {"add": "add", "floordiv": "floor_divide", "and": "bitwise_and", "or": "bitwise_or", "xor": "bitwise_xor"}
    for name, ufunc in pairs.items():
        setattr(Symbol, f"__{name}__", _operator(ufunc, False))
        setattr(Symbol, f"__r{name}__", _operator(ufunc, True))
    compared = {"lt": "less", "le": "less_equal", "gt": "greater", "ge": "greater_equal", "eq": "equal"}
    for name, ufunc in {**compared, "ne": "not_equal"}.items():
        setattr(Symbol, f"__{name}__", _operator(ufunc, False))
    for name, ufunc in {"neg": "negative", "pos": "positive", "abs": "absolute", "invert": "invert"}.items():
        setattr(Symbol, f"__{name}__", lambda self, operation=_OPERATIONS[ufunc]: operation(self))
    for name, operation in _OPERATIONS.items():
        if not hasattr(Symbol, name):
            setattr(Symbol, name, lambda self, *others, operation=operation: operation(self, *others))


_equip()
