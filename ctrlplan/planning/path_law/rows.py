"""Limits of velocities and accelerations as linear inequalities for the squared rate of a time law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctrlplan.planning.bounds import Bound
from ctrlplan.planning.path_law.bernstein import bernstein
from ctrlplan.planning.path_law.grid import Grid
from ctrlplan.trajectories.common import Array, readonly

POINTS = readonly(np.array([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0]))
"""Points of a cell at which limits are evaluated."""


SMOOTH_POINTS = readonly(0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 6)))
"""The same with limits of the jerk, which vanishes at points of rest."""

_RELAXED = 0.05
"""Distance of limits from 0 with which a first law is found where they forbid a sign, relative to half their range."""

_PARALLEL = 1e-9
"""Difference of rows of two limits in one cell, relative to their size, up to which they are multiples."""

_FAR = 1e4
"""Magnitude of a missing limit, relative to that on the other side."""


@dataclass(frozen=True)
class Rows:
    """Inequalities lower <= factors @ Bernstein coefficients <= upper for each cell.

    Attributes
    ----------
    factors : ndarray, shape (nrows, ncells, degree + 1)
        Of the Bernstein coefficients of a cell.
    upper : ndarray, shape (nrows, ncells)
        Upper limits, above 0, or 0 for one that forbids a sign.
    lower : ndarray, shape (ntwo, ncells)
        Lower limits of the first rows, below 0, or 0.
    """

    factors: Array
    upper: Array
    lower: Array

    def with_reserve(self, npoints: int, reserve: float, first: NDArray[np.intp], last: NDArray[np.intp]) -> Rows:
        """Rows at a distance from the limits, without those of the given speeds where cells begin or end."""
        if not (reserve or first.size or last.size):
            return self
        upper = (1.0 - reserve) * self.upper
        upper[-npoints, first] = upper[-1, last] = _FAR
        return Rows(self.factors, upper, (1.0 - reserve) * self.lower)

    def relaxed(self) -> Rows:
        """Rows whose limits include 0 with a distance."""
        upper, lower = (
            np.where(self.upper > 0.0, self.upper, _RELAXED),
            np.where(self.lower < 0.0, self.lower, -_RELAXED),
        )
        return Rows(self.factors, upper, lower)


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
    jerks : ndarray, shape (nlimits, 3, npoints, ncells)
        Jerk over each limit and sqrt(b), by b''/2, 3 b'/2 and b.
    points : ndarray, shape (npoints,)
        Points of a cell, from 0 to 1.
    """

    speeds: Array
    tangent: Array
    curvature: Array
    centre: Array
    jerks: Array
    points: Array

    @classmethod
    def of(cls, grid: Grid, bounds: Sequence[Bound], points: Array, start: float) -> Activity:
        """Limits at points of a grid; `start` is that of the plan for which they are given."""
        first, second, *third = grid.jets(points, max(2, *(bound.order for bound in bounds)))
        inner = np.clip(points, 1e-9, 1.0 - 1e-9)
        times = start + grid.times(inner) - grid.plan.start
        speeds, rows, jerks = np.zeros(times.shape), [], []
        for bound in bounds:
            low, high = bound.sides(times)
            if bound.order == 1:
                with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                    share = first[bound.axis] / np.where(first[bound.axis] > 0.0, high, low)
                _check_direction(bound, share, times)
                # A limit of 0 applies to a direction in which the plan does not move, up to rounding.
                with np.errstate(over="ignore"):
                    speeds = np.maximum(speeds, np.where(np.isfinite(share), share, 0.0) ** 2)
            elif bound.order == 2:
                low, high = np.where(np.isinf(low), -_FAR * high, low), np.where(np.isinf(high), -_FAR * low, high)
                half = 0.5 * (high - low)
                applies = np.isfinite(half)  # otherwise infinite on both sides
                mean = 0.5 * np.add(low, high, out=np.zeros_like(half), where=applies)
                rows.append((first[bound.axis] / half, second[bound.axis] / half, mean / half))
            elif bound.order == 3:
                own = np.stack([derivative[bound.axis] for derivative in (first, second, *third)])
                jerks += [own / side for side in (high, low) if np.isfinite(side).any()]
        accelerations = np.array(rows).reshape(-1, 3, *times.shape)
        third_rows = np.array(jerks).reshape(-1, 3, *times.shape)
        if all(bound.is_constant for bound in bounds):
            if not accelerations[:, 2].any():
                accelerations = _strictest(accelerations, two_sided=True)
            third_rows = _strictest(third_rows, two_sided=False)
        tangent, curvature, centre = accelerations.swapaxes(0, 1)
        return cls(speeds, tangent, curvature, centre, third_rows, points)

    @property
    def _control(self) -> Array:
        """Bernstein coefficients of a polynomial by its values at the points."""
        own: Array = np.linalg.inv(bernstein(self.points, self.points.size - 1))  # type: ignore[assignment]
        return own

    def rows(self, length: Array, former: Array | None = None, shares: Array | None = None) -> Rows:
        """Inequalities for the control points of all signals in each cell.

        Parameters
        ----------
        length : ndarray, shape (ncells,)
            Lengths of the cells.
        former : ndarray, shape (degree + 1, ncells), optional
            Bernstein coefficients about which limits of the jerk are linear; default:
            none, for a quadratic squared rate.
        shares : ndarray, shape (nlimits, npoints, ncells), optional
            Jerks of that squared rate relative to their limits, 1 where they are lower;
            default: 1.
        """
        degree = 2 if former is None else len(former) - 1
        values, slopes = bernstein(self.points, degree), bernstein(self.points, degree, 1)
        shape = (-1, length.size, degree + 1)
        speeds = np.einsum("ab,bc,bm->acm", self._control, self.speeds, values)
        slope = 0.5 * np.einsum("ab,kbc,bm->kacm", self._control, self.tangent / length, slopes)
        factors = slope + np.einsum("ab,kbc,bm->kacm", self._control, self.curvature, values)
        shift = np.einsum("ab,kbc->kac", self._control, self.centre).reshape(-1, length.size)
        upper = np.concatenate([1.0 + shift, np.ones(self.speeds.shape)])
        blocks = [factors.reshape(shape), speeds]
        if former is not None:
            jerks, limits = self._jerk_rows(length, former, shares)
            blocks.insert(1, jerks.reshape(shape))
            upper = np.concatenate([1.0 + shift, limits.reshape(-1, length.size), upper[len(shift) :]])
        return Rows(np.concatenate(blocks), upper, shift - 1.0)

    def _jerk_rows(self, length: Array, former: Array, shares: Array | None) -> tuple[Array, Array]:
        """Rows (nlimits, npoints, ncells, degree + 1) of the jerk: R <= 1/sqrt(b), whose right side is convex.

        Its tangent at the former squared rate b_0 is 3/(2 sqrt(b_0)) - b/(2 sqrt(b_0)^3). Where the jerk is c times its
        limit there, R sqrt(b) <= 1 is linear instead: R sqrt(b_0) + c (b/b_0 - 1)/2 <= 1.
        """
        degree = len(former) - 1
        values, slopes, bends = (bernstein(self.points, degree, nu) for nu in range(3))
        b = (values @ former)[None, :, :, None]
        first, second, third = (self.jerks[:, k, :, :, None] for k in range(3))
        h = length[None, None, :, None]
        values, slopes, bends = (own[None, :, None] for own in (values, slopes, bends))
        signal = third * values + 1.5 * second * slopes / h + 0.5 * first * bends / h**2
        bent, limits = values / (3.0 * b), np.ones(self.jerks[:, 0].shape)
        if shares is not None:
            bent, limits = bent * shares[..., None], np.einsum("ab,kbc->kac", self._control, (2.0 + shares) / 3.0)
        return np.einsum("ab,kbcm->kacm", self._control, signal * np.sqrt(b) / 1.5 + bent), limits

    def worst(self, local: Array, length: Array) -> Array:
        """Signals relative to their limits (npoints, ncells), by Bernstein coefficients (degree + 1, ncells)."""
        degree, points = len(local) - 1, self.points
        b, slope = bernstein(points, degree) @ local, bernstein(points, degree, 1) @ local / length
        found = np.sqrt(np.maximum(self.speeds * b, 0.0))
        for tangent, curvature, centre in zip(self.tangent, self.curvature, self.centre, strict=True):
            value = tangent * 0.5 * slope + curvature * b
            for side in (1.0 + centre, centre - 1.0):
                found = np.maximum(found, np.divide(value, side, out=np.zeros_like(value), where=side != 0.0))
        return np.maximum(found, self.jerk_shares(local, length).max(axis=0, initial=0.0))

    def jerk_shares(self, local: Array, length: Array) -> Array:
        """Jerks relative to their limits (nlimits, npoints, ncells)."""
        degree, points = len(local) - 1, self.points
        b, slope, bend = (bernstein(points, degree, nu) @ local / length**nu for nu in range(3))
        first, second, third = self.jerks.swapaxes(0, 1)
        shares: Array = (third * b + 1.5 * second * slope + 0.5 * first * bend) * np.sqrt(b)
        return shares


def _strictest(rows: Array, two_sided: bool) -> Array:
    """Rows that imply all others if the path is straight in each cell; otherwise the same rows.

    On a straight line the rows of all axes are multiples of one of them.

    Parameters
    ----------
    rows : ndarray, shape (nrows, nfactors, npoints, ncells)
        Signals, by their factors, of which the first is the velocity.
    two_sided : bool
        Whether signals have limits of both signs, otherwise upper ones only.
    """
    if len(rows) < 3 - two_sided:
        return rows
    _, _, npoints, ncells = rows.shape
    cells = np.arange(ncells)
    row, point = np.divmod(np.abs(rows[:, 0]).reshape(-1, ncells).argmax(axis=0), npoints)
    largest = rows[row, :, :, cells].transpose(1, 2, 0)
    size = largest[0, point, cells]
    shares = rows[:, 0, point, cells] / np.where(size != 0.0, size, 1.0)
    apart = np.abs(rows - shares[:, None, None] * largest).max(axis=(0, 2))
    if (apart > _PARALLEL * np.abs(largest).max(axis=1)).any():
        return rows
    if two_sided:
        return largest[None]
    return np.stack(
        [rows[own, :, :, cells].transpose(1, 2, 0) for own in (shares.argmax(axis=0), shares.argmin(axis=0))]
    )


def _check_direction(bound: Bound, shares: Array, times: Array) -> None:
    """Raise for velocities, relative to their limits, of a sign that these do not allow."""
    if (shares < 0.0).any():
        time = float(times[shares < 0.0][0])
        low, high = (float(side[0]) for side in bound.sides(np.array([time])))
        raise ValueError(
            f"limits of {bound.name} must include 0, the value at rest, got from {low:.6g} to {high:.6g} at "
            f"{time:.6g} s"
        )
