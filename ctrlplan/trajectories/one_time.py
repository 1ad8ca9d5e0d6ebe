"""The Newton form of `newton` at one time, in the arithmetic of Python.

The time may be a symbol of a tracer. For numbers and the orders of a controller
(up to the jerk) the recurrences are written out, which is several times as fast
as loops or arrays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate
from operator import mul

import numpy as np

from ctrlplan._types import Value

_FEW = 8
"""Highest order for which this is faster than arrays."""

Pair = tuple[list[Value], list[Value]]
"""Taylor series of q q and of q c, the factors of one pair of nodes."""


def pair_series(alpha: float, left: Value, right: Value, order: int) -> Pair:
    """Series of the factors of a pair about a point at distances `left` and `right` from its nodes."""
    alpha = effective(alpha)
    if not alpha:
        rest = [0.0] * order
        return [left * right, left + right, 1.0, *rest][: order + 1], [left, 1.0, *rest][: order + 1]
    half, middle = 0.5 * alpha, 0.5 * (left + right)
    sin, cos = (math.sin, math.cos) if isinstance(middle, float) else (np.sin, np.cos)
    q, sigma, kappa = sin(half * left) / half, sin(alpha * middle), cos(alpha * middle)
    second = half * right
    odd, even = (2.0 / alpha) * sigma, -half * sigma
    if order == 3:  # as below
        third = -alpha * alpha / 6.0
        return [q * sin(second) / half, odd, kappa, odd * third], [q * cos(second), kappa, even, kappa * third]
    qq, qc = [q * sin(second) / half], [q * cos(second)]
    for k, weight in enumerate(kernel_weights(alpha, order), 1):
        qq.append((odd if k % 2 else kappa) * weight)
        qc.append((kappa if k % 2 else even) * weight)
    return qq, qc


def newton_series(factors: Sequence[Pair], column: Sequence[Value], order: int) -> list[Value]:
    """Series of a linear combination of the basis functions, evaluated from the last pair of factors to the first."""
    orders = range(order + 1)
    last = 2 * len(factors)
    found = [column[last] if len(column) > last else 0.0, *[0.0] * order]
    for j in range(len(factors) - 1, -1, -1):
        (qq, qc), weight = factors[j], column[2 * j + 1]
        found = [sum(map(mul, qq, found[k::-1]), weight * qc[k]) for k in orders]
        found[0] = found[0] + column[2 * j]
    return found


@lru_cache(maxsize=256)
def kernel_weights(alpha: float, order: int) -> tuple[float, ...]:
    """Coefficients 1, 2, ...: odd ones of S(h), even ones of V(h)."""
    return tuple(
        (-1.0) ** (k // 2) * (alpha ** (k - 1) if k % 2 else -2.0 * alpha ** (k - 2)) / math.factorial(k)
        for k in range(1, order + 1)
    )


def effective(alpha: float) -> float:
    """Alpha of the formulas: 0 where they would underflow, which is the limit to full precision."""
    return alpha if alpha > 1e-100 else 0.0


def polynomial_series(gaps: Sequence[float], column: Sequence[float], order: int) -> list[float]:
    """Taylor series of a polynomial in Newton form, at distances `gaps` from its nodes, the last one first."""
    coefficients = reversed(column)
    value, first, second, third = next(coefficients), 0.0, 0.0, 0.0
    if order > 3:
        found = [value, *[0.0] * order]
        for gap, coefficient in zip(gaps, coefficients, strict=True):
            for k in range(order, 0, -1):
                found[k] = found[k] * gap + found[k - 1]
            found[0] = found[0] * gap + coefficient
        return found
    for gap, coefficient in zip(gaps, coefficients, strict=True):
        third = third * gap + second
        second = second * gap + first
        first = first * gap + value
        value = value * gap + coefficient
    return [value, first, second, third][: order + 1]


def trigonometric_series(factors: Sequence[Pair], column: Sequence[float], order: int) -> list[Value]:
    """Same as `newton_series` for numbers; the factors are those of the last pair first, up to order 3 or higher."""
    if order > 3:
        return newton_series(factors[::-1], column, order)
    k = 2 * len(factors)
    value, first, second, third = column[k] if len(column) > k else 0.0, 0.0, 0.0, 0.0
    for (a, b, c, d), (p, q, r, s) in factors:
        weight, k = column[k - 1], k - 2
        third = weight * s + a * third + b * second + c * first + d * value
        second = weight * r + a * second + b * first + c * value
        first = weight * q + a * first + b * value
        value = weight * p + a * value + column[k]
    return [value, first, second, third][: order + 1]


def derivatives(series: list[list[float]], duration: float) -> list[list[float]]:
    """Derivatives by time from the Taylor series in relative time of each axis."""
    square = duration * duration
    cube = square * duration
    if len(series[0]) == 4:  # as below
        return [[a, b / duration, 2.0 * c / square, 6.0 * d / cube] for a, b, c, d in series]
    powers = list(accumulate([1.0, *[duration] * (len(series[0]) - 1)], mul))
    return [
        [math.factorial(k) * value / power for k, (value, power) in enumerate(zip(row, powers, strict=True))]
        for row in series
    ]


def is_moderate(duration: float, order: int) -> bool:
    """Whether a few derivatives are required, with powers of the duration far from the limits of floating point."""
    return order <= _FEW and 1e-25 < duration < 1e25
