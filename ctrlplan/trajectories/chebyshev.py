"""Chebyshev interpolants of analytic functions, accurate to rounding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.common import Array, readonly

_SMALL = 1e-3  # last coefficient, relative to the largest, by which a series is not divided
DEGREES = (16, 32, 64, 128)
"""Degrees of interpolants that are tried, in turn."""


def chebyshev_proxy(
    jet: Callable[[Array, int], Array],
    interval: tuple[float, float],
    low: int,
    high: int,
    degrees: Sequence[int] = DEGREES,
) -> Array | None:
    """Chebyshev coefficients of derivatives low to high, from exact values, of the first degree that resolves them.

    Returns
    -------
    ndarray, shape (high - low + 1, naxes, size), or None
        None where no degree resolves the function.
    """
    for degree in degrees:
        coefficients = transform(jet(points(degree, *interval), high)[low:])
        used = resolved_size(coefficients)
        if used is not None:
            return coefficients[..., :used]
    return None


def resolved_size(coefficients: Array, rtol: float = 3e-14) -> int | None:
    """Number of significant leading coefficients; None if not resolved.

    A series is resolved if its last quarter lies below `rtol` of its largest
    coefficient. That quarter is the rounding of the values, and so are all
    coefficients of the same size.
    """
    size = np.abs(coefficients).reshape(-1, coefficients.shape[-1])
    largest, last = size.max(axis=1), size[:, -max(4, size.shape[1] // 4) :].max(axis=1)
    if (last > rtol * largest).any():
        return None
    matters = (size > (2.0 * np.maximum(last, 1e-16 * largest))[:, None]).any(axis=0).nonzero()[0]
    return int(matters[-1]) + 1 if matters.size else 1


def fit(function: Callable[[Array], Array], interval: tuple[float, float], degree: int) -> Array:
    """Coefficients (..., degree + 1) of the interpolant at Chebyshev points."""
    return transform(function(points(degree, *interval)))


def real_roots(coefficients: Array) -> Array:
    """Roots of a Chebyshev series in [-1, 1], including double roots split by rounding."""
    return np.sort(roots_of_rows(coefficients[None])[1])


def roots_of_rows(coefficients: Array) -> tuple[NDArray[np.intp], Array]:
    """Rows and roots in [-1, 1] of Chebyshev series (nrows, size), including double roots split by rounding.

    The last coefficients may be rounding: they change the roots by as much as the
    same change of any other coefficient.
    """
    size = np.abs(coefficients)
    largest = size.max(axis=1, keepdims=True)
    matters = size > 1e-15 * largest
    degree = np.where(matters.any(axis=1), size.shape[1] - 1 - matters[:, ::-1].argmax(axis=1), 0)
    rows, roots = [np.empty(0, dtype=np.intp)], [np.empty(0)]
    for n in sorted(set(degree.tolist()) - {0}):
        own = (degree == n).nonzero()[0]
        is_small = size[own, n] < _SMALL * largest[own, 0]
        for chosen, eigenvalues in ((own[~is_small], _eigenvalues), (own[is_small], _shifted_eigenvalues)):
            if chosen.size:
                found = eigenvalues(coefficients[chosen, : n + 1] / largest[chosen])
                near = np.abs(found.real) < 1.0 + 1e-6
                if found.dtype.kind == "c":
                    near &= np.abs(found.imag) < 1e-3
                rows.append(chosen[near.nonzero()[0]])
                roots.append(np.clip(found.real[near], -1.0, 1.0))
    return np.concatenate(rows), np.concatenate(roots)


def _eigenvalues(series: Array) -> Array:
    """Roots (nrows, degree) of series: eigenvalues of the colleague matrices, whose last columns differ."""
    n = series.shape[1] - 1
    matrices = np.empty((len(series), n, n))
    matrices[:] = _colleague(n)
    matrices[:, :, -1] -= _weights(n) * series[:, :n] / series[:, n, None]
    return np.asarray(np.linalg.eigvals(matrices))


def _shifted_eigenvalues(series: Array) -> Array:
    """Roots (nrows, degree) of series whose last coefficient is small.

    The colleague matrix divides by the last coefficient, which amplifies the rounding
    of its eigenvalues. The generalised problem A v = x B v does not divide. Shifted by a
    point s of [-1, 1] where the series is large and inverted, (A - s B)^-1 B has the
    eigenvalues 1/(x - s): roots in the interval are its large, accurate eigenvalues.
    """
    n = series.shape[1] - 1
    places, basis = _extreme_points(n)
    shifts = places[np.abs(series @ basis).argmax(axis=1), None]
    left = _colleague(n) - shifts[:, :, None] * np.eye(n)
    left[:, :, -1] *= series[:, n, None]
    left[:, :, -1] -= _weights(n) * series[:, :n]
    inverse = np.linalg.inv(left)
    inverse[:, :, -1] *= series[:, n, None]
    found = np.linalg.eigvals(inverse)
    found[np.abs(found) < 0.1] = 0.1  # those of roots in the interval are at least 0.5
    return np.asarray(shifts + 1.0 / found)


def points(degree: int, a: float, b: float) -> Array:
    """Chebyshev points of an interval, one more than the degree."""
    return 0.5 * (a + b) + 0.5 * (b - a) * _nodes(degree)


@lru_cache(maxsize=64)
def unit_points(degree: int) -> Array:
    """Chebyshev points of the interval from 0 to 1."""
    return readonly(points(degree, 0.0, 1.0))


def transform(values: Array) -> Array:
    """Coefficients (..., size) of the interpolant of values (..., size) at `points`."""
    return values @ _matrix(values.shape[-1] - 1)


@lru_cache(maxsize=64)
def _colleague(degree: int) -> Array:
    """Symmetric colleague matrix of the Chebyshev polynomial of a degree."""
    off = np.full(degree - 1, 0.5)
    off[:1] = np.sqrt(0.5)
    return np.diag(off, 1) + np.diag(off, -1)


@lru_cache(maxsize=64)
def _weights(degree: int) -> Array:
    """Weights of the coefficients in the last column of a colleague matrix."""
    return readonly(0.5 * np.where(np.arange(degree) > 0, 1.0, np.sqrt(2.0)) if degree > 1 else np.ones(1))


@lru_cache(maxsize=64)
def _extreme_points(degree: int) -> tuple[Array, Array]:
    """Extreme points (degree + 1,) of the Chebyshev polynomial of a degree, and the polynomials up to it there."""
    quarters = np.outer(np.arange(degree + 1), np.arange(degree + 1)) % (2 * degree)
    basis = np.cos((np.pi / degree) * quarters)
    return readonly(basis[1].copy()), readonly(basis)


@lru_cache(maxsize=64)
def _nodes(degree: int) -> Array:
    return np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))


@lru_cache(maxsize=64)
def _matrix(degree: int) -> Array:
    n = degree + 1
    quarters = np.outer(2 * np.arange(n) + 1, np.arange(n)) % (4 * n)  # the angle within one turn: no digits are lost
    matrix = (2.0 / n) * np.cos((0.5 * np.pi / n) * quarters)
    matrix[:, 0] *= 0.5
    return matrix
