"""Matrix exponential of many states, in few matrix products.

A polynomial of degree 16 takes four products of matrices, with a norm of up to 0.65, and
the rest is squared. It has no constant term: like the sums of `changes_over`, it gives the
change exp(a) - 1, so that a slow mode next to a fast one keeps its digits.

References
----------
Sastre, Ibanez and Defez, Boosting the computation of the matrix exponential, Applied
Mathematics and Computation 340 (2019), 206-220: the polynomial, exact in the terms of the
exponential up to degree 15.
"""

from __future__ import annotations

from math import ceil, log2

import numpy as np

from ctrlplan._types import Array

MANY_STATES = 32
"""Number of states above which it is faster than sums of all powers."""

_REACH = 0.65
"""Root of the norm of a^2 up to which the polynomial is accurate: 0.454 0.65^14/16! is below half an ulp of 1/2."""

_UNEVEN = 4.0
"""Largest norm of a relative to that root: products of a then have no terms that are much larger."""

_CANCELLED = 16.0
"""Ratio of the terms of a square to its result above which digits are lost."""

_LEFT = (-8.709066576837676e-3, 4.017568440673568e-1, 2.381070373870987e-1, 2.224209172496374e0)
_RIGHT = (3.230762888122312e-2, -5.792361707073261e0, -4.130276365929783e-2)
_FIRST = (4.018761610201035e-4, 2.945531440279683e-3)
_ADDED = (5.768988513026145e0, 2.338576034271299e-2)
_LAST = (1.040801735231354e1, -6.331712455883371e1, 3.484665863364574e-1)
"""Coefficients of the polynomial."""


def changes_of_many(a: Array, b: Array, nterms: int) -> list[Array] | None:
    """Change of many states over ..., 1/4, 1/2, 1 units of time; see `changes_over`.

    Parameters
    ----------
    a, b : ndarray, shapes (n, n) and (n, ninputs)
        The system.
    nterms : int
        Number of Taylor terms of the input: 1 or 2.

    Returns
    -------
    list of ndarray, shapes (n, n + nterms * ninputs), or None
        None if the norms of powers are much smaller than the powers of the norm, squares
        have cancellation, or numbers overflow.
    """
    with np.errstate(all="ignore"):
        return _of_many(a, b, nterms)


def _of_many(a: Array, b: Array, nterms: int) -> list[Array] | None:
    """The same, for numbers that may overflow."""
    n, m = b.shape
    norm, square = _norm(a), a @ a
    root = _norm(square) ** 0.5
    if not root < np.inf or norm > _UNEVEN * max(root, _REACH):
        return None
    halvings = max(0, ceil(log2(max(root / _REACH, 1.0))), ceil(log2(max(norm / (_UNEVEN * _REACH), 1.0))))
    changes = [_short(np.concatenate([a, b, np.zeros((n, (nterms - 1) * m))], axis=1) * 0.5**halvings, n, m)]
    for _ in range(halvings):
        before = changes[-1]
        after = doubled(before)
        if nterms == 2:  # the second term of the input begins at its value in the middle
            after[:, n + m :] += before[:, n : n + m]
            after[:, n + m :] *= 0.5
        own = before[:, :n]
        if cancels(own, own, after[:, :n]):
            return None
        changes.append(after)
    return changes if np.isfinite(changes[-1]).all() else None


def short_change(a: Array) -> Array:
    """exp(a) - 1 for a norm of at most 1, by the polynomial and at most one square."""
    halvings = int(_norm(a) > _REACH)
    found = _short(a * 0.5**halvings, len(a), 0)
    return doubled(found) if halvings else found


def doubled(change: Array) -> Array:
    """Twice a change (n, n + ...) and its product with itself, in one product of matrices."""
    left = change[:, : len(change)].copy()  # aligned rows are faster
    np.einsum("ii->i", left)[:] += 2.0
    return np.asarray(left @ change)


def _short(a: Array, n: int, m: int) -> Array:
    """Change of states over a short time, from upper rows [a, b, 0] of a matrix with the input as further states."""

    def product(left: Array, right: Array, slope: float) -> Array:
        """Upper rows of the product with a polynomial that begins with slope * a."""
        found: Array = left[:, :n] @ right
        if slope and left.shape[1] > n + m:
            found[:, n + m :] += slope * left[:, n : n + m]
        return found

    square = product(a, a, 1.0)
    fourth = product(square, _FIRST[0] * square + _FIRST[1] * a, _FIRST[1])
    left, right = fourth + _LEFT[0] * square + _LEFT[1] * a, fourth + _RIGHT[0] * square
    eighth = product(left, right, 0.0) + _ADDED[0] * fourth + _ADDED[1] * square
    left = eighth + _LEFT[2] * square + _LEFT[3] * a
    right = eighth + _RIGHT[1] * fourth + _RIGHT[2] * a
    found = product(left, right, _RIGHT[2]) + _LAST[0] * eighth
    found += _LAST[1] * fourth
    found += _LAST[2] * square
    found += a
    return found


def cancels(left: Array, right: Array, result: Array) -> bool:
    """Whether a product of matrices has terms much larger than factors and result, and than 1."""
    # By the inequality of Cauchy and Schwarz, before the product of magnitudes.
    squares = left * left
    rows = squares.sum(axis=1).max(initial=0.0)
    columns = (squares if right is left else right * right).sum(axis=0).max(initial=0.0)
    if rows * columns <= _CANCELLED**2:
        return False
    size = _CANCELLED * max(float(np.abs(matrix).max(initial=1.0)) for matrix in (left, right, result))
    return not rows * columns <= size * size and not (np.abs(left) @ np.abs(right)).max() <= size


def _norm(a: Array) -> float:
    """The smaller of two norms: the largest sum of magnitudes in a column, and the root of the sum of squares."""
    return min(float(np.abs(a).sum(axis=0).max(initial=0.0)), float(np.vdot(a, a)) ** 0.5)
