"""Arithmetic of truncated Taylor series: derivatives of a formula from derivatives of its arguments.

A series is an array (order + 1, ...) whose entry k is the k-th derivative
over k!. The flat maps of plants are formulas in derivatives of flat outputs;
with these few operations their own derivatives cost no derivation by hand.
Entries may be arrays, numbers, or the symbols of a tracer.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.common import FACTORIALS

Array = NDArray[np.float64]


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
    """Product, as long as the shorter factor."""
    n = min(len(a), len(b))
    return _stacked([_total(a[i] * b[k - i] for i in range(k + 1)) for k in range(n)])


def divide(a: Array, b: Array) -> Array:
    """Quotient, as long as the shorter of both; b must not be 0."""
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


def arctan2(y: Array, x: Array) -> Array:
    """Angle of (x, y), by integrating (y' x - y x')/(x^2 + y^2)."""
    n = min(len(x), len(y))
    x, y = x[:n], y[:n]
    first = _stacked([np.arctan2(y[0], x[0])])
    if n == 1:
        return first
    turning = multiply(derivative(y), x) - multiply(y, derivative(x))
    rate = divide(turning, multiply(x, x) + multiply(y, y))
    steps = np.arange(1, len(rate) + 1).reshape(-1, *[1] * (rate.ndim - 1))
    return np.concatenate([first, rate / steps])


def _total(terms: Iterable[Any]) -> Any:
    return sum(terms, 0.0)


def _stacked(terms: list[Any]) -> Array:
    if isinstance(terms[0], np.ndarray | np.generic | float):
        return np.stack(terms)
    out = np.empty(len(terms), dtype=object)
    for k, term in enumerate(terms):
        out[k] = term
    return out


def _factorials(values: Array) -> Array:
    return FACTORIALS[: len(values)].reshape(-1, *[1] * (values.ndim - 1))
