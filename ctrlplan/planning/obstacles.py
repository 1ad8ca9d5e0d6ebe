"""Obstacles in the plane: rectangles, discs and half-planes."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_number, checked_pair
from ctrlplan.trajectories.common import Array, readonly


@runtime_checkable
class Obstacle(Protocol):
    """Protocol of obstacles: closed sets of the plane.

    Any object with these three methods is an obstacle, such as `Rectangle`,
    `Disc` and `HalfPlane`.
    """

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance to points.

        Parameters
        ----------
        points : array_like, shape (2, ...)
            Positions.

        Returns
        -------
        ndarray, shape (...)
            Euclidean distance to the set; in the set at most 0, minus a depth.
            The function must have the Lipschitz constant 1.
        """

    def segment_distance(self, p: ArrayLike, q: ArrayLike) -> Array:
        """Signed distance to the segments from p to q.

        Parameters
        ----------
        p, q : array_like, shape (2, ...)
            Ends of the segments.

        Returns
        -------
        ndarray, shape (...)
            Minimum distance over the segment; at most 0 if the segment meets the
            set. The function must have the Lipschitz constant 1 in either end.
        """

    def corners(self, margin: float) -> Array:
        """Corners of a polygon around the set, for paths around it.

        Parameters
        ----------
        margin : float
            Minimum distance of the polygon from the set.

        Returns
        -------
        ndarray, shape (2, ncorners)
            With ncorners = 0 for a set without a path around it.
        """


@dataclass(frozen=True)
class Rectangle:
    """Rectangle with sides parallel to the axes.

    Parameters
    ----------
    x, z : tuple of float
        Minimum and maximum on the first and on the second axis; either may be
        infinite, for walls and corridors.

    Raises
    ------
    ValueError
        If a pair does not increase, or no side is finite.

    Examples
    --------
    >>> Rectangle((7.0, 13.0), (6.5, 12.0)).distance([4.0, 2.5])
    array(5.)
    """

    x: tuple[float, float]
    z: tuple[float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", checked_pair(self.x, "x"))
        object.__setattr__(self, "z", checked_pair(self.z, "z"))
        if math.inf in (self.x[0], self.z[0]) or -math.inf in (self.x[1], self.z[1]):
            raise ValueError(f"the lower side must be below inf and the upper above -inf, got x {self.x}, z {self.z}")
        if not any(map(math.isfinite, (*self.x, *self.z))):
            raise ValueError("a rectangle must have a finite side, got none")

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance (...) to points (2, ...), negative inside."""
        x, z = _plane(points, "points")
        across = np.maximum(self.x[0] - x, x - self.x[1])
        above = np.maximum(self.z[0] - z, z - self.z[1])
        outside = np.hypot(np.maximum(across, 0.0), np.maximum(above, 0.0))
        return np.where(outside > 0.0, outside, np.maximum(across, above))

    def segment_distance(self, p: ArrayLike, q: ArrayLike) -> Array:
        """Minimum signed distance (...) on segments from p (2, ...) to q."""
        a, b = _ends(p, q)
        axes, signs, sides = self._sides
        signs, sides = (own.reshape(-1, *[1] * (a.ndim - 1)) for own in (signs, sides))
        first, last = signs * (a[axes] - sides), signs * (b[axes] - sides)
        outside = np.asarray(np.minimum(self.distance(a), self.distance(b)))
        if self._corners.size:
            outside = np.asarray(np.minimum(outside, _to_segments(self._corners, a, b).min(axis=0)))
        near = np.minimum(first, last).max(axis=0) <= 0.0  # not beyond one of the sides as a whole
        if near.any():
            depth = _lowest(first[:, near], last[:, near])
            outside[near] = np.where(depth > 0.0, outside[near], depth)
        return outside

    @cached_property
    def _corners(self) -> Array:
        """Finite corners (ncorners, 2)."""
        finite = [list(filter(math.isfinite, sides)) for sides in (self.x, self.z)]
        return readonly(np.array(list(itertools.product(*finite)), dtype=float).reshape(-1, 2))

    @cached_property
    def _sides(self) -> tuple[NDArray[np.intp], Array, Array]:
        """Axes, outward directions and positions (nsides,) of the finite sides."""
        found = [
            (axis, sign, side)
            for axis, sides in enumerate((self.x, self.z))
            for sign, side in zip((-1.0, 1.0), sides, strict=True)
            if math.isfinite(side)
        ]
        axes, signs, sides = zip(*found, strict=True)
        return np.array(axes), readonly(np.array(signs)), readonly(np.array(sides))

    def corners(self, margin: float) -> Array:
        """Corners of the enlarged rectangle, two for each corner."""
        turns = np.pi / 8 * np.array([1.0, 3.0])
        step = margin / math.cos(np.pi / 8) * np.stack([np.cos(turns), np.sin(turns)])
        found = [
            np.array([[x], [z]]) + np.array([[left], [up]]) * step
            for x, left in zip(self.x, (-1.0, 1.0), strict=True)
            for z, up in zip(self.z, (-1.0, 1.0), strict=True)
            if math.isfinite(x) and math.isfinite(z)
        ]
        return np.concatenate([np.empty((2, 0)), *found], axis=1)


@dataclass(frozen=True)
class Disc:
    """Disc.

    Parameters
    ----------
    centre : tuple of float
        Position of the centre.
    radius : float
        Radius, above 0.

    Raises
    ------
    ValueError
        If the centre is not two finite numbers or the radius not above 0.

    Examples
    --------
    >>> Disc((0.0, 0.0), 2.0).segment_distance([-1.0, 3.0], [1.0, 3.0])
    array(1.)
    """

    centre: tuple[float, float]
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", _finite_pair(self.centre, "centre"))
        object.__setattr__(self, "radius", checked_number(self.radius, "radius"))
        if not 0.0 < self.radius < math.inf:
            raise ValueError(f"radius must be finite and above 0, got {self.radius:g}")

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance (...) to points (2, ...), negative inside."""
        x, z = _plane(points, "points")
        return np.asarray(np.hypot(x - self.centre[0], z - self.centre[1]) - self.radius)

    def segment_distance(self, p: ArrayLike, q: ArrayLike) -> Array:
        """Minimum signed distance (...) on segments from p (2, ...) to q."""
        a, b = _ends(p, q)
        return np.asarray(_to_segments(np.array([self.centre]), a, b)[0] - self.radius)

    def corners(self, margin: float) -> Array:
        """Corners of a polygon of 16 sides around the enlarged disc."""
        turns = 2.0 * np.pi / 16 * np.arange(16)
        reach = (self.radius + margin) / math.cos(np.pi / 16)
        return np.array(self.centre)[:, None] + reach * np.stack([np.cos(turns), np.sin(turns)])


@dataclass(frozen=True)
class HalfPlane:
    """Half-plane of the points p with normal . p at least an offset.

    Parameters
    ----------
    normal : tuple of float
        Normal vector into the set, of any length above 0; stored with length 1.
    offset : float
        Offset for the given normal; both are divided by the length of the normal.

    Raises
    ------
    ValueError
        If a number is not finite or the normal 0.

    Examples
    --------
    The ground 12 m below the trolley of a crane, with z downwards:

    >>> HalfPlane((0.0, 1.0), 12.0).distance([3.0, 10.0])
    array(2.)
    """

    normal: tuple[float, float]
    offset: float

    def __post_init__(self) -> None:
        normal, offset = _finite_pair(self.normal, "normal"), checked_number(self.offset, "offset")
        length = math.hypot(*normal)
        if not 0.0 < length < math.inf:
            raise ValueError(f"normal must have a length above 0, got {normal}")
        if not math.isfinite(offset):
            raise ValueError(f"offset must be finite, got {offset:g}")
        object.__setattr__(self, "normal", (normal[0] / length, normal[1] / length))
        object.__setattr__(self, "offset", offset / length)

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance (...) to points (2, ...), negative inside."""
        x, z = _plane(points, "points")
        return np.asarray(self.offset - self.normal[0] * x - self.normal[1] * z)

    def segment_distance(self, p: ArrayLike, q: ArrayLike) -> Array:
        """Minimum signed distance (...) on segments from p (2, ...) to q."""
        return np.asarray(np.minimum(self.distance(p), self.distance(q)))

    def corners(self, margin: float) -> Array:
        """No corners, shape (2, 0): there is no path around a half-plane."""
        return np.empty((2, 0))


def _ends(p: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    """Ends (2, ...) of segments, of the same shape."""
    a, b = _plane(p, "p"), _plane(q, "q")
    if a.shape == b.shape:
        return a, b
    a, b = np.broadcast_arrays(a, b)
    return a, b


def _plane(points: ArrayLike, name: str) -> Array:
    values = np.asarray(points, dtype=float)
    if values.ndim == 0 or len(values) != 2:
        raise ValueError(f"{name} must have shape (2, ...), got {values.shape}")
    return values


def _finite_pair(pair: object, name: str) -> tuple[float, float]:
    values = tuple(pair) if isinstance(pair, tuple | list | np.ndarray) else ()
    if len(values) != 2:
        raise ValueError(f"{name} must be two numbers, got {pair!r}")
    first, second = (checked_number(value, name) for value in values)
    if not (math.isfinite(first) and math.isfinite(second)):
        raise ValueError(f"{name} must be finite, got {first:g} and {second:g}")
    return first, second


def _lowest(first: Array, last: Array) -> Array:
    """Minimum (nsegments,) along segments of the maximum of affine functions (nfunctions, nsegments).

    From values at the ends: it is attained there or where two functions are equal.
    """
    i, j = _pairs(len(first))
    gap, other = first[i] - first[j], last[j] - last[i]
    total = gap + other
    share = np.divide(gap, total, out=np.zeros_like(gap), where=total != 0.0)
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    equal = (first + share[:, None] * (last - first)).max(axis=1)
    return np.minimum(np.minimum(first.max(axis=0), last.max(axis=0)), equal.min(axis=0, initial=math.inf))


@lru_cache(maxsize=16)
def _pairs(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices (npairs,) of both members of all pairs."""
    return np.triu_indices(count, 1)


def _to_segments(points: Array, p: Array, q: Array) -> Array:
    """Distances (npoints, ...) of points (npoints, 2) from the segments p-q."""
    x, z = points.T.reshape(2, -1, *[1] * (p.ndim - 1)) - p[:, None]
    along = q - p
    square = along[0] * along[0] + along[1] * along[1]
    share = np.divide(x * along[0] + z * along[1], square, out=np.zeros_like(x), where=square > 0.0)
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    return np.asarray(np.hypot(x - share * along[0], z - share * along[1]))
