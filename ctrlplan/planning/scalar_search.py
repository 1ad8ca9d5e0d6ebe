"""Scalar search: local minima from a grid, and bisection."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from ctrlplan.trajectories.common import Array

_ROUNDING = 16.0 * np.finfo(float).eps
"""Rise to both neighbours, relative to a value, up to which there is no valley but rounding errors."""


def scan(
    function: Callable[[float], float],
    grid: Array,
    target: float | None = None,
    rtol: float = 1e-7,
    values: Array | None = None,
) -> tuple[Array, Array]:
    """Samples of a function that include its relevant local minima.

    Parameters
    ----------
    function : callable
        Function of one number; inf where it is undefined.
    grid : ndarray, shape (npoints,)
        Initial points, increasing; as fine as the features of the function.
    target : float, optional
        Local minima that cannot be below it are not refined, nor are those whose
        grid point is below it; default: the minimum on the grid is refined.
    rtol : float, optional
        Tolerance of the places of local minima, relative to them.
    values : ndarray, shape (npoints,), optional
        Values on the grid, if they are known.

    Returns
    -------
    (ndarray, ndarray)
        Points, increasing, and values.
    """
    if values is None:
        values = np.array([function(x) for x in grid.tolist()])
    finite = values[np.isfinite(values)]
    # Between a value and inf the search compares finite numbers.
    wall = float(finite.max() + np.ptp(finite) + 1.0) if finite.size else math.inf
    found = [
        bottom(lambda x: min(function(x), wall), grid, k, rtol)
        for k in _valleys(values, values.min() if target is None else target)
        if target is None or values[k] > target
    ]
    found = [(x, v) for x, v in found if v < wall]
    points = np.concatenate([grid, [x for x, _ in found]])
    points, first = np.unique(points, return_index=True)
    return points, np.concatenate([values, [v for _, v in found]])[first]


def bisected(
    holds: Callable[[float], bool], inside: float, outside: float, atol: float, rtol: float = 0.0
) -> tuple[float, float]:
    """Two neighbouring points between which a condition changes.

    Parameters
    ----------
    holds : callable
        The condition, of one number: true at `inside`.
    inside, outside : float
        Points at which the condition is true and false, in any order.
    atol, rtol : float
        Final distance, absolute and relative to the point inside.

    Returns
    -------
    (float, float)
        A point at which the condition holds, and one at which it does not.
    """
    while abs(outside - inside) > atol + rtol * inside:
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if holds(middle) else (inside, middle)
    return inside, outside


def bottom(function: Callable[[float], float], grid: Array, k: int, rtol: float) -> tuple[float, float]:
    """Minimum between the neighbours of a grid point, and its place first."""
    low, high = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, grid.size - 1)])
    found = minimize_scalar(function, bounds=(low, high), method="bounded", options={"xatol": rtol * (high + low)})
    return float(found.x), float(found.fun)


def _valleys(values: Array, target: float) -> list[int]:
    """Grid points below both neighbours, near which the target can be reached."""
    padded = np.concatenate([[math.inf], values, [math.inf]])
    left, here, right = padded[:-2], padded[1:-1], padded[2:]
    low = np.isfinite(here) & (here <= left) & (here <= right)
    # A parabola falls below the middle of three points by at most an eighth of the rise of the ends; allow ten times.
    with np.errstate(invalid="ignore"):
        rise = np.where(np.isfinite(left), left, here) + np.where(np.isfinite(right), right, here) - 2.0 * here
        level = np.maximum(left, right) - here <= _ROUNDING * np.abs(here)
        return np.flatnonzero(low & ~level & ~(here - 1.25 * rise > target)).tolist()
