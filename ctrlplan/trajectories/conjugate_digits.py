"""Free entries of a piecewise spline in multiple-precision arithmetic.

Where segments are of very different durations, the equations of the free
entries contain powers of those durations and are ill-conditioned in floating
point. Here the same equations are set up and solved in decimal arithmetic.
"""

from __future__ import annotations

import decimal
import itertools
import math
import operator
from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.digits import basis_series

Ends = tuple[tuple[int, ...], tuple[int, ...]]
"""Orders of the derivatives that determine a segment, at its start and at its end."""
_Row = tuple[dict[int, Decimal], list[Decimal]]
"""An equation: its coefficients by unknown, and its right sides."""

_ABOVE = 15
"""Digits by which a pivot of singular equations may exceed rounding; 40 more are used than the times require."""


def conjugate_digits(
    alpha: float, durations: Sequence[Fraction], ends: Sequence[Ends], free: Sequence[tuple[int, int]], table: Array
) -> NDArray[np.object_] | None:
    """Free entries for continuous conjugate derivatives, correct to rounding.

    Parameters
    ----------
    alpha : float
        Shape parameter [rad] of each segment; 0 gives polynomials.
    durations : sequence of Fraction, of length nsegments
        Exact durations of the segments [s]; of a closed plan as many as waypoints.
    ends : sequence of Ends, of length nsegments
        Orders that determine each segment, free entries included.
    free : sequence of (int, int)
        Waypoint and order of each free entry, sorted by waypoint.
    table : ndarray, shape (nwaypoints, size, naxes)
        Prescribed derivatives; values of free entries are ignored.

    Returns
    -------
    ndarray of Decimal, shape (nfree, naxes), or None
        None where the equations are singular.
    """
    size = table.shape[1]
    # Equations contain powers of the durations up to 2 size - 1, elimination the products of two of them; ends that
    # nearly coincide on the circle lead to divisions by powers of their distance.
    spread = max(float(max(durations) / min(durations)), 10.0)
    digits = 40 + math.ceil(2 * size * (2.0 * math.log10(spread) + math.log10(2.0 * math.pi / (2.0 * math.pi - alpha))))
    with decimal.localcontext(decimal.Context(digits, Emin=decimal.MIN_EMIN, Emax=decimal.MAX_EMAX)):
        steps = [Decimal(h.numerator) / Decimal(h.denominator) for h in durations]
        place = {entry: n for n, entry in enumerate(free)}
        weights = [_derivatives(alpha, pair, size, digits) for pair in ends]
        equations = [_jump(entry, place, steps, weights, ends, table) for entry in free]
        solution = _solved(equations, rounding=Decimal(10) ** (_ABOVE - digits))
    return None if solution is None else np.array(solution, dtype=object)


def _jump(
    entry: tuple[int, int],
    place: dict[tuple[int, int], int],
    steps: list[Decimal],
    weights: list[list[list[list[Decimal]]]],
    ends: Sequence[Ends],
    table: Array,
) -> _Row:
    """Equation of a free entry: continuity of its conjugate derivative."""
    i, k = entry  # segment -1 is the last one of a closed plan
    order = 2 * table.shape[1] - 1 - k
    unknown, known = dict[int, Decimal](), [Decimal(0)] * table.shape[2]
    for segment, side in ((i - 1, 1), (i, 0)):
        data = [((segment + end) % len(table), given) for end in (0, 1) for given in ends[segment][end]]
        for (waypoint, given), weight in zip(data, weights[segment][side][order], strict=True):
            factor = weight * steps[segment] ** (given - order) * (1 - 2 * side)
            n = place.get((waypoint, given))
            if n is None:
                values = table[waypoint, given].tolist()
                known = [a - factor * Decimal(value) for a, value in zip(known, values, strict=True)]
            else:
                unknown[n] = unknown.get(n, Decimal(0)) + factor
    return unknown, known


@lru_cache(maxsize=64)
def _derivatives(alpha: float, ends: Ends, size: int, digits: int) -> list[list[list[Decimal]]]:
    """Derivatives 0, ..., 2 size - 1 at both ends of the unit segment, as weights of its prescribed entries."""
    with decimal.localcontext(decimal.Context(digits, Emin=decimal.MIN_EMIN, Emax=decimal.MAX_EMAX)):
        nodes = [Decimal(end) for end in (0, 1) for _ in ends[end]]
        taylor = [basis_series(Decimal(alpha), Decimal(end), nodes, 2 * size - 1, Decimal(0)) for end in (0, 1)]
        values = [[[row[k] * math.factorial(k) for row in rows] for k in range(2 * size)] for rows in taylor]
        rows: list[_Row] = []
        for end, k in [(side, k) for side in (0, 1) for k in ends[side]]:
            unit = [Decimal(int(n == len(rows))) for n in range(len(nodes))]
            rows.append((dict(enumerate(values[end][k])), unit))
        inverse = _solved(rows, rounding=Decimal(0))
        if inverse is None:
            raise ValueError("the entries prescribed at the ends of a segment must determine it, got a singular system")
        columns = list(zip(*inverse, strict=True))
        return [
            [[sum(map(operator.mul, row, column), Decimal(0)) for column in columns] for row in side] for side in values
        ]


def _solved(rows: list[_Row], rounding: Decimal) -> list[list[Decimal]] | None:
    """Solution by Gaussian elimination with pivoting; None if a pivot is 0 or rounding: the equations are singular."""
    left = []
    for coefficients, right in rows:
        size = max(map(abs, coefficients.values()), default=Decimal(0)) or Decimal(1)
        left.append(({n: v / size for n, v in coefficients.items() if v}, [v / size for v in right]))
    # Rows are sorted by waypoint. `first`: lowest unknown of a row and of all later rows, which limits the search.
    starts = [min(coefficients, default=0) for coefficients, _ in left]
    first = list(itertools.accumulate(starts[::-1], min))[::-1]
    pivots: list[_Row] = []
    for n in range(len(rows)):
        held = [m for m in range(next((m for m, f in enumerate(first) if f > n), len(left))) if n in left[m][0]]
        if not held:
            return None
        chosen = max(held, key=lambda m: abs(left[m][0][n]))
        pivot, right = left[chosen]
        if abs(pivot[n]) <= rounding:
            return None
        for m in held:
            coefficients, other = left[m]
            if m != chosen:
                factor = coefficients.pop(n) / pivot[n]
                for q, value in pivot.items():
                    if q != n:
                        coefficients[q] = coefficients.get(q, Decimal(0)) - factor * value
                left[m] = coefficients, [a - factor * b for a, b in zip(other, right, strict=True)]
        pivots.append((pivot, right))
        del left[chosen], first[chosen]
    found: list[list[Decimal]] = [[]] * len(rows)
    for n in range(len(rows) - 1, -1, -1):
        coefficients, right = pivots[n]
        for q, value in coefficients.items():
            if q != n:
                right = [a - value * b for a, b in zip(right, found[q], strict=True)]
        found[n] = [value / coefficients[n] for value in right]
    return found
