"""Coefficients of the Newton form in multiple-precision arithmetic.

Where waypoints nearly coincide, as both ends do near alpha = 2 pi, rounding
errors are divided by high powers of their distance. If the loss of accuracy
is significant, the same triangular system is set up and solved here in
decimal arithmetic, from the given times and entries.
"""

from __future__ import annotations

import decimal
import math
from collections.abc import Sequence
from decimal import Decimal
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.common import Array

Series = list[Decimal]


def many_digits(
    alpha: float,
    times: Sequence[float],
    duration: float,
    constraints: tuple[NDArray[np.intp], NDArray[np.intp]],
    values: NDArray[Any],
    fold: float,
    digits: int,
) -> Array:
    """Solution of the triangular system, every entry correct to rounding.

    Parameters
    ----------
    alpha : float
        Shape parameter [rad]; 0 is the polynomial.
    times : sequence of float
        Times of the waypoints [s].
    duration : float
        Duration [s].
    constraints : pair of ndarray of int, shape (nconstraints,)
        Waypoint and order of each, in the order of the nodes.
    values : ndarray of float or Decimal, shape (nconstraints, naxes)
        Prescribed derivatives.
    fold : float
        Weight of the next function that is added to the last one.
    digits : int
        Number of decimal digits lost to rounding.

    Returns
    -------
    ndarray, shape (nconstraints, naxes)
    """
    where, orders = (index.tolist() for index in constraints)
    with decimal.localcontext(decimal.Context(digits + 40, Emin=decimal.MIN_EMIN, Emax=decimal.MAX_EMAX)):
        span = Decimal(duration)
        u = [(Decimal(t) - Decimal(times[0])) / span for t in times]
        nodes = tuple(u[i] for i in where)
        highest = {i: max(k for j, k in zip(where, orders, strict=True) if j == i) for i in set(where)}
        given = Decimal(alpha), nodes, Decimal(fold), digits
        bases = {i: _known_series(u[i], order, *given) for i, order in highest.items()}
        columns: list[list[Decimal]] = [[] for _ in range(values.shape[1])]
        for row, (i, k) in enumerate(zip(where, orders, strict=True)):
            line = [series[k] for series in bases[i][: row + 1]]
            scale = span**k / math.factorial(k)
            for column, value in zip(columns, values[row].tolist(), strict=True):
                known = sum((a * b for a, b in zip(line, column, strict=False)), Decimal(0))
                column.append((Decimal(value) * scale - known) / line[row])
        return np.array([[float(value) for value in column] for column in columns]).T


@lru_cache(maxsize=256)
def _known_series(
    u: Decimal, order: int, alpha: Decimal, nodes: tuple[Decimal, ...], fold: Decimal, digits: int
) -> list[Series]:
    """Series of the basis, computed once for segments of equal relative times; `digits` are those of the context."""
    return basis_series(alpha, u, nodes, order, fold)


def basis_series(alpha: Decimal, u: Decimal, nodes: Sequence[Decimal], order: int, fold: Decimal) -> list[Series]:
    """Taylor series about u of the functions of `newton`, pair by pair of nodes, in the context's digits."""
    found = [[Decimal(1), *[Decimal(0)] * order]]
    for first, second in zip(nodes[::2], nodes[1::2], strict=False):
        both, one = _pair(alpha, u - first, u - second, order)
        found += [_product(found[-1], one), _product(found[-1], both)]
    if fold:
        found[-2] = [a + fold * b for a, b in zip(found[-2], found[-1], strict=True)]
    if len(nodes) % 2:  # unpaired last node: its function vanishes at all previous nodes
        return found
    return found[: len(nodes)]


def _pair(alpha: Decimal, left: Decimal, right: Decimal, order: int) -> tuple[Series, Series]:
    """Series of q q and of q c at distances `left` and `right` from a pair of nodes."""
    rest = [Decimal(0)] * order
    if not alpha:
        return [left * right, left + right, Decimal(1), *rest][: order + 1], [left, Decimal(1), *rest][: order + 1]
    half, middle = alpha / 2, (left + right) / 2
    (sin_left, _), (sin_right, cos_right) = _sin_cos(half * left), _sin_cos(half * right)
    sigma, kappa = _sin_cos(alpha * middle)
    both, one = [sin_left * sin_right / half**2], [sin_left * cos_right / half]
    for k in range(1, order + 1):
        sign = (-1) ** (k // 2)
        weight = sign * (alpha ** (k - 1) if k % 2 else -2 * alpha ** (k - 2)) / math.factorial(k)
        both.append((2 * sigma / alpha if k % 2 else kappa) * weight)
        one.append((kappa if k % 2 else -half * sigma) * weight)
    return both, one


def _product(a: Series, b: Series) -> Series:
    return [sum((a[i] * b[k - i] for i in range(k + 1)), Decimal(0)) for k in range(len(a))]


def _sin_cos(x: Decimal) -> tuple[Decimal, Decimal]:
    """Sine and cosine by their series, for angles up to 2 pi."""
    digits = decimal.getcontext().prec
    minimum = Decimal(10) ** -(digits + 5)
    sums, term, k = [Decimal(0), Decimal(1)], Decimal(1), 0
    while abs(term) > minimum:
        k += 1
        term *= x / k
        sums[(k + 1) % 2] += term if k % 4 in (0, 1) else -term
    return sums[0], sums[1]
