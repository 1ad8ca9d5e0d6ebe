"""Double-double matrices with 106 binary digits.

A pair consists of two arrays of equal shape, the numbers and their rounding
errors. Matrix products are computed from products of leading digits, which are so
few that floating-point sums of them are exact.

References
----------
Ozaki, Ogita, Oishi and Rump, Error-free transformations of matrix
multiplication by using fast routines of matrix multiplication and its
applications, Numerical Algorithms 59 (2012), 95-118. Dekker, A floating-point
technique for extending the available precision, Numerische Mathematik 18
(1971), 224-242.
"""

from __future__ import annotations

import numpy as np

from ctrlplan._types import Array

Pair = tuple[Array, Array]


def pair_sum(*pairs: Pair) -> Pair:
    """Sum of pairs of equal shape."""
    total, error = pairs[0]
    for value, more in pairs[1:]:
        before, total = total, total + value
        part = total - before
        error = error + more + ((before - (total - part)) + (value - part))
    found = total + error
    return found, error - (found - total)


def pair_product(left: Pair, right: Pair, groups: int = 1) -> Pair:
    """Matrix product of pairs, (..., n, k) and (..., k, m).

    The error is at most 8 k^2 2^-105 times the product of the largest magnitudes
    in a row of `left` and a column of `right`, plus rounding of the products.

    Parameters
    ----------
    left, right : tuple of two ndarray
        The pairs.
    groups : int
        Columns of `left` whose indices differ by multiples of this number have a
        common scale.
    """
    height, k = left[0].shape[-2:]
    size = np.abs(left[0]).reshape(*left[0].shape[:-2], height, -1, groups).max(axis=-2)
    digits = (53 - (k - 1).bit_length()) // 2
    one, two, three = _split(left, np.tile(size, k // groups), digits)
    first, second, third = _split(right, np.abs(right[0]).max(axis=-2, keepdims=True), digits)
    none = np.zeros(())
    small = one @ third + two @ (second + third) + three @ right[0]
    return pair_sum((one @ first, small), (one @ second, none), (two @ first, none))


def _split(values: Pair, size: Array, digits: int) -> tuple[Array, Array, Array]:
    """Leading binary digits of values relative to a size, the next as many digits, and the remainder."""
    unit = np.ldexp(1.5, np.frexp(size)[1] + 52 - digits)
    first = (values[0] + unit) - unit
    error, unit = values[0] - first, np.ldexp(unit, -digits)
    second = (error + unit) - unit
    return first, second, (error - second) + values[1]
