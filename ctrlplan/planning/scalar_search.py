"""Search over one number: a grid whose valleys are solved for, and bisection."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from ctrlplan.trajectories.common import Array


def scan(function: Callable[[float], float], grid: Array, target: float | None = None) -> tuple[Array, Array]:
    """Points of a function that include the bottom of every valley that matters.

    Parameters
    ----------
    function : callable
        Of one number; inf where it has no value.
    grid : ndarray, shape (npoints,)
        Where to look first, increasing; as fine as the function's features.
    target : float, optional
        Valleys that cannot reach down to it are left alone; the least value on
        the grid unless given.

    Returns
    -------
    (ndarray, ndarray)
        Points, increasing, and values.
    """
    values = np.array([function(x) for x in grid.tolist()])
    finite = values[np.isfinite(values)]
    # A search between a value and none must compare numbers.
    wall = float(finite.max() + np.ptp(finite) + 1.0) if finite.size else math.inf
    found = [
        _bottom(lambda x: min(function(x), wall), grid, k)
        for k in _valleys(values, values.min() if target is None else target)
    ]
    found = [(x, v) for x, v in found if v < wall]
    points = np.concatenate([grid, [x for x, _ in found]])
    points, first = np.unique(points, return_index=True)
    return points, np.concatenate([values, [v for _, v in found]])[first]


def bisected(
    holds: Callable[[float], bool], inside: float, outside: float, atol: float, rtol: float = 0.0
) -> tuple[float, float]:
    """Two near points between which a condition ceases to hold.

    Parameters
    ----------
    holds : callable
        The condition, of one number: true at `inside`.
    inside, outside : float
        Points between which it ceases to hold, in any order.
    atol, rtol : float
        Distance at the end, and as a fraction of the point inside.

    Returns
    -------
    (float, float)
        A point at which the condition holds, and one at which it does not.
    """
    while abs(outside - inside) > atol + rtol * inside:
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if holds(middle) else (inside, middle)
    return inside, outside


def _valleys(values: Array, target: float) -> list[int]:
    """Grid points below both neighbours, beside which the target can be reached."""
    padded = np.concatenate([[math.inf], values, [math.inf]])
    left, here, right = padded[:-2], padded[1:-1], padded[2:]
    low = np.isfinite(here) & (here <= left) & (here <= right)
    # Between three points a parabola falls by at most an eighth of what the ends rise; ten times that is allowed for.
    with np.errstate(invalid="ignore"):
        rise = np.where(np.isfinite(left), left, here) + np.where(np.isfinite(right), right, here) - 2.0 * here
        return np.flatnonzero(low & ~(here - 1.25 * rise > target)).tolist()


def _bottom(function: Callable[[float], float], grid: Array, k: int) -> tuple[float, float]:
    """Least value between the neighbours of a grid point."""
    low, high = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, grid.size - 1)])
    found = minimize_scalar(function, bounds=(low, high), method="bounded", options={"xatol": 1e-7 * (high + low)})
    return float(found.x), float(found.fun)
