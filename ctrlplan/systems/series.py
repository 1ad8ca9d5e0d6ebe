"""Arithmetic of truncated Taylor series: derivatives of a formula from derivatives of its arguments.

A series is an array (order + 1, ...) whose entry k is the k-th derivative
over k!. The flat maps of plants are formulas in the derivatives of flat outputs;
these operations give the derivatives of the maps without derivation by hand.
Entries may be arrays, numbers or symbols.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from ctrlplan._types import Array, Value
from ctrlplan.trajectories.common import FACTORIALS

_WHOLE = np.array([math.factorial(k) for k in range(len(FACTORIALS))], dtype=object)
_WHOLE.flags.writeable = False
"""Factorials as whole numbers, which leave symbols exact."""

Quantity = Value
"""Argument of the formulas of plants: a number, an array, a Taylor series or a symbol."""


def from_jet(jet: Array) -> Array:
    """Series of a jet (order + 1, ...) of derivatives."""
    return jet / _factorials(jet)


def to_jet(series: Array) -> Array:
    """Derivatives of a series."""
    return series * _factorials(series)


def derivative(series: Array, nu: int = 1) -> Array:
    """Series of the nu-th derivative, nu orders shorter."""
    jet = to_jet(series)[nu:]
    return from_jet(jet)


def multiply(a: Array, b: Array) -> Array:
    """Product, with the order of the shorter factor."""
    n = min(len(a), len(b))
    return _stacked([_total(a[i] * b[k - i] for i in range(k + 1)) for k in range(n)])


def divide(a: Array, b: Array) -> Array:
    """Quotient, with the order of the shorter operand; b must not be 0."""
    out: list[Array] = []
    for k in range(min(len(a), len(b))):
        out.append((a[k] - _total(out[i] * b[k - i] for i in range(k))) / b[0])
    return _stacked(out)


def sqrt(a: Array) -> Array:
    """Square root; a must be above 0."""
    out: list[Array] = [np.sqrt(a[0])]
    for k in range(1, len(a)):
        inner = _total(out[i] * out[k - i] for i in range(1, k))
        out.append((a[k] - inner) / (2.0 * out[0]))
    return _stacked(out)


def arctan2(y: Array, x: Array, squares: Array | None = None) -> Array:
    """Angle of (x, y), by integrating (y' x - y x')/(x^2 + y^2); `squares` is x^2 + y^2 if known."""
    n = min(len(x), len(y))
    x, y = x[:n], y[:n]
    first = _stacked([np.arctan2(y[0], x[0])])
    if n == 1:
        return first
    turning = multiply(derivative(y), x) - multiply(y, derivative(x))
    rate = divide(turning, multiply(x, x) + multiply(y, y) if squares is None else squares)
    steps = np.arange(1, len(rate) + 1).reshape(-1, *[1] * (rate.ndim - 1))
    return np.concatenate([first, rate / steps])


def sincos(a: Array) -> tuple[Array, Array]:
    """Sine and cosine, by integrating s' = c a', c' = -s a'."""
    sine, cosine = [np.sin(a[0])], [np.cos(a[0])]
    for k in range(1, len(a)):
        slopes = [i * a[i] / k for i in range(1, k + 1)]
        sine.append(_total(slope * cosine[k - i] for i, slope in enumerate(slopes, 1)))
        cosine.append(-_total(slope * sine[k - i] for i, slope in enumerate(slopes, 1)))
    return _stacked(sine), _stacked(cosine)


class Taylor:
    """Truncated Taylor series with arithmetic operators.

    Supports numbers, arrays and other series as operands, and `numpy.sin`,
    `numpy.cos` and `numpy.tan`, so that the equations of a plant also give
    derivatives of their results. A result has the order of its shorter argument.

    Attributes
    ----------
    terms : ndarray, shape (order + 1, ...)
        Derivatives over k!.
    """

    __array_priority__ = 1000.0  # with an array on the left, this class performs the operation

    def __init__(self, terms: Array) -> None:
        self.terms = terms

    @classmethod
    def constant(cls, value: Value) -> Taylor:
        """Series of order 0 of a number, an array or a symbol."""
        return cls(_constant(value, np.shape(value) if _is_numeric(value) else ()))

    @classmethod
    def integral(cls, start: Array, rate: Taylor) -> Taylor:
        """Series of the integral of a rate, with its initial value."""
        counts = np.arange(1, len(rate.terms) + 1).reshape(-1, *[1] * (rate.terms.ndim - 1))
        return cls(np.concatenate([_constant(start, rate.terms.shape[1:]), rate.terms / counts]))

    def __add__(self, other: Operand) -> Taylor:
        n, terms = self._with(other)
        return Taylor(self.terms[:n] + terms)

    def __neg__(self) -> Taylor:
        return Taylor(-self.terms)

    def __sub__(self, other: Operand) -> Taylor:
        n, terms = self._with(other)
        return Taylor(self.terms[:n] - terms)

    def __rsub__(self, other: Operand) -> Taylor:
        return -self + other

    def __mul__(self, other: Operand) -> Taylor:
        return Taylor(multiply(self.terms, other.terms) if isinstance(other, Taylor) else self.terms * other)

    def __truediv__(self, other: Operand) -> Taylor:
        return Taylor(divide(self.terms, other.terms) if isinstance(other, Taylor) else self.terms / other)

    def __rtruediv__(self, other: float | Array) -> Taylor:
        return Taylor(divide(self._with(other)[1], self.terms))

    def sin(self) -> Taylor:
        """Sine; called by `numpy.sin`."""
        return Taylor(sincos(self.terms)[0])

    def cos(self) -> Taylor:
        """Cosine; called by `numpy.cos`."""
        return Taylor(sincos(self.terms)[1])

    def tan(self) -> Taylor:
        """Tangent; called by `numpy.tan`."""
        return Taylor(divide(*sincos(self.terms)))

    __radd__ = __add__
    __rmul__ = __mul__

    def _with(self, other: Operand) -> tuple[int, Array]:
        """Common length, and that many terms of the other operand."""
        if isinstance(other, Taylor):
            n = min(len(self.terms), len(other.terms))
            return n, other.terms[:n]
        constant = np.zeros(self.terms.shape, dtype=float if _is_numeric(other) else object)
        constant[0] = other
        return len(constant), constant


Operand = Taylor | float | Array


def _total(terms: Iterable[Value]) -> Value:
    """Sum of terms; 0 without terms. A single term is not copied."""
    remaining = iter(terms)
    return sum(remaining, next(remaining, 0.0))


def _stacked(terms: list[Value]) -> Array:
    if isinstance(terms[0], np.ndarray | np.generic | float):
        return np.stack(terms)
    out = np.empty(len(terms), dtype=object)
    for k, term in enumerate(terms):
        out[k] = term
    return out


def _constant(value: Value, shape: tuple[int, ...]) -> Array:
    """Series of order 0."""
    return np.broadcast_to(value, shape)[None] if _is_numeric(value) else _stacked([value])


def _is_numeric(value: Value) -> bool:
    return isinstance(value, np.ndarray | np.generic | float | int)


def _factorials(values: Array) -> Array:
    known = FACTORIALS[: len(values)] if values.dtype != object else _WHOLE[: len(values)]
    return known.reshape(-1, *[1] * (values.ndim - 1))
