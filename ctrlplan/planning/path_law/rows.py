"""Limits of velocities and accelerations as linear inequalities for the squared rate of a time law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctrlplan.planning.bounds import Bound
from ctrlplan.planning.path_law.grid import Grid
from ctrlplan.trajectories.common import Array, readonly

_POINTS = readonly(np.array([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0]))
"""Points of a cell at which limits are evaluated."""

_CONTROL = readonly(
    np.linalg.inv(np.stack([(1, 3, 3, 1)[k] * (1.0 - _POINTS) ** (3 - k) * _POINTS**k for k in range(4)], axis=1))
)
"""Bernstein coefficients of a cubic polynomial by its values at these points."""

_FAR = 1e4
"""Magnitude of a missing limit, relative to that on the other side."""


@dataclass(frozen=True)
class Rows:
    """Inequalities lower <= factors @ Bernstein coefficients <= upper for each cell.

    Attributes
    ----------
    factors : ndarray, shape (nrows, ncells, 3)
        Of the Bernstein coefficients of a cell.
    upper : ndarray, shape (nrows, ncells)
        Upper limits, above 0.
    lower : ndarray, shape (ntwo, ncells)
        Lower limits, below 0, of the first rows.
    """

    factors: Array
    upper: Array
    lower: Array

    def with_reserve(self, reserve: float, first: NDArray[np.intp], last: NDArray[np.intp]) -> Rows:
        """Rows at a distance from the limits, without those of the given speeds where cells begin or end."""
        if not (reserve or first.size or last.size):
            return self
        upper = (1.0 - reserve) * self.upper
        upper[-_POINTS.size, first] = upper[-1, last] = _FAR
        return Rows(self.factors, upper, (1.0 - reserve) * self.lower)


def basis(u: Array) -> tuple[Array, Array]:
    """Quadratic Bernstein polynomials (npoints, 3) and their derivatives."""
    v = 1.0 - u
    return np.stack([v * v, 2.0 * u * v, u * u], axis=1), np.stack([-2.0 * v, 2.0 - 4.0 * u, 2.0 * u], axis=1)


@dataclass(frozen=True)
class Activity:
    """Limited signals at points of each cell, by the squared rate b and its slope.

    Attributes
    ----------
    speeds : ndarray, shape (npoints, ncells)
        Maximum of (velocity/limit)^2/b.
    tangent, curvature : ndarray, shape (nbounds, npoints, ncells)
        Acceleration over half the distance of its limits, by b'/2 and by b.
    centre : ndarray, shape (nbounds, npoints, ncells)
        Mean of the limits in this scale.
    """

    speeds: Array
    tangent: Array
    curvature: Array
    centre: Array

    @classmethod
    def of(cls, grid: Grid, bounds: Sequence[Bound], points: Array, start: float) -> Activity:
        """Limits at points of a grid; `start` is that of the plan for which they are given."""
        first, second = grid.jets(points)
        inner = np.clip(points, 1e-9, 1.0 - 1e-9)
        times = start + grid.times(inner) - grid.plan.start
        speeds, rows = np.zeros(times.shape), []
        for bound in bounds:
            low, high = bound.sides(times)
            if bound.order == 1:
                with np.errstate(divide="ignore", invalid="ignore"):
                    share = first[bound.axis] / np.where(first[bound.axis] > 0.0, high, low)
                # A limit of 0 applies to a direction in which the plan does not move, up to rounding.
                speeds = np.maximum(speeds, np.where(np.isfinite(share), share, 0.0) ** 2)
            elif bound.order == 2:
                low, high = np.maximum(low, -_FAR * high), np.minimum(high, -_FAR * low)
                half = 0.5 * (high - low)
                applies = np.isfinite(half)
                half, mean = np.where(applies, half, np.inf), np.where(applies, 0.5 * (high + low), 0.0)
                rows.append((first[bound.axis] / half, second[bound.axis] / half, mean / half))
        tangent, curvature, centre = np.array(rows).swapaxes(0, 1) if rows else np.empty((3, 0, *times.shape))
        return cls(speeds, tangent, curvature, centre)

    def rows(self, length: Array) -> Rows:
        """Inequalities for the control points of both signals in each cell."""
        values, slopes = basis(_POINTS)
        shape = (-1, length.size, 3)
        speeds = np.einsum("ab,bc,bm->acm", _CONTROL, self.speeds, values)
        slope = 0.5 * np.einsum("ab,kbc,bm->kacm", _CONTROL, self.tangent / length, slopes)
        factors = slope + np.einsum("ab,kbc,bm->kacm", _CONTROL, self.curvature, values)
        shift = np.einsum("ab,kbc->kac", _CONTROL, self.centre).reshape(-1, length.size)
        upper = np.concatenate([1.0 + shift, np.ones(self.speeds.shape)])
        return Rows(np.concatenate([factors.reshape(shape), speeds]), upper, shift - 1.0)

    def worst(self, points: Array, local: Array, length: Array) -> Array:
        """Signals relative to their limits (npoints, ncells), 1 at a limit, by Bernstein coefficients (3, ncells)."""
        values, slopes = basis(points)
        b, half_slope = values @ local, 0.5 * (slopes @ local) / length
        found = np.sqrt(np.maximum(self.speeds * b, 0.0))
        for tangent, curvature, centre in zip(self.tangent, self.curvature, self.centre, strict=True):
            value = tangent * half_slope + curvature * b
            found = np.maximum(found, np.maximum(value / (1.0 + centre), value / (centre - 1.0)))
        return found


POINTS = _POINTS
