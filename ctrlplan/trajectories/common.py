"""Helpers shared by the modules of this package."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_FEW = 1000
"""Number of values up to which their squares are summed in one call."""

FACTORIALS: Array = np.array([float(math.factorial(k)) for k in range(171)])
FACTORIALS.flags.writeable = False


def readonly(values: Array) -> Array:
    """Same array, made read-only."""
    values.setflags(write=False)
    return values


def are_finite(values: Array) -> bool:
    """Whether values certainly are finite: also their sum, whatever their signs."""
    if values.size <= _FEW:  # for more, a product may run in several threads
        return math.isfinite(np.vdot(values, values))
    return math.isfinite(np.add.reduce(np.abs(values), axis=None))


def times_powers(values: Array, base: float, orders: NDArray[np.integer[Any]]) -> Array:
    """Derivatives (order, ...) times powers of a time or rate; exact zeros remain, overflow raises."""
    with np.errstate(all="ignore"):
        found = np.where(values == 0.0, 0.0, values * base**orders)
        size = np.abs(found)
        shrunk = (size < _TINY) & (np.abs(values) > 1e-290)  # only subnormal values may underflow to 0
        out_of_range = (values != 0.0) & np.isfinite(values) & (shrunk | ~(size < np.inf))
    if out_of_range.any():
        place = tuple(np.argwhere(out_of_range)[0])
        raise ValueError(
            f"derivatives must stay within floating point, got {values[place]:g} times {base:g} to the power "
            f"{np.broadcast_to(orders, values.shape)[place]:g}; choose a time unit nearer to the plan's"
        )
    return found


def derivative_scale(duration: float, order: int) -> Array:
    """Factors (order + 1,) from Taylor coefficients in normalised time to derivatives; inf on overflow."""
    with np.errstate(over="ignore", divide="ignore", under="ignore"):
        scale: Array = FACTORIALS[: order + 1] / duration ** np.arange(order + 1)
    return scale


def by_orders(values: Array, scale: Array) -> Array:
    """Taylor coefficients times factors by order, of which some may be infinite: exact zeros remain."""
    if math.isfinite(float(scale.max())):
        return values * scale
    with np.errstate(invalid="ignore"):
        return np.where(values == 0.0, 0.0, values * scale)


def scales_of_orders(duration: float | Array, low: int, high: int) -> Array:
    """Factors (..., norders, 1, 1) from Taylor coefficients in normalised time to derivatives low to high."""
    return FACTORIALS[low : high + 1, None, None] * duration ** _exponents(low, high)


@lru_cache(maxsize=128)
def _exponents(low: int, high: int) -> Array:
    """Exponents (norders, 1, 1) of durations in derivatives."""
    return readonly(-np.arange(low, high + 1.0)[:, None, None])


_TINY = float(np.finfo(float).tiny)


@lru_cache(maxsize=128)
def bernstein_of_powers(degree: int) -> Array:
    """Matrix (degree + 1, degree + 1) from coefficients of powers to those of Bernstein polynomials on [0, 1].

    The polynomial lies between the smallest and the largest of the latter.
    """
    shares = [
        [math.comb(i, k) / math.comb(degree, k) if k <= i else 0.0 for k in range(degree + 1)]
        for i in range(degree + 1)
    ]
    return readonly(np.array(shares))


def mapped_time(time: float, origin: float, target: float, rate: float) -> float:
    """Time moved to target + (time - origin)/rate: exact at the origin."""
    return target + (time - origin) / rate
