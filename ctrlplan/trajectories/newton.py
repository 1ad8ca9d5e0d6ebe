r"""The confluent trigonometric Newton form.

One basis serves the trigonometric spline (equation (2)) and the polynomial
spline (equation (12)), its member at alpha = 0. In normalised time
u = (t - start)/duration, with

.. math:: q(u) = \tfrac{2}{\alpha}\sin\tfrac{\alpha u}{2},\quad c(u) = \cos\tfrac{\alpha u}{2}

and nodes x_1 .. x_M (times repeated by the number of constraints there)

.. math::
    \phi_{2j} = \prod_{i\le 2j} q(u - x_i), \qquad
    \phi_{2j-1} = c(u - x_{2j}) \prod_{i<2j} q(u - x_i).

The cosine is centred on the next node, so that the last function of an even
number is proportional to sin m(tau - gamma) plus lower harmonics, gamma the
mean of the nodes: the span is exactly the space of (2). At alpha = 0, q(u) = u
and c = 1, and this is Newton's polynomial. Hermite collocation is lower
triangular, whatever alpha, where the direct solution of (2) loses all digits.

Taylor jets are carried through the products two factors at a time. With
w = u - (x_{2j-1} + x_{2j})/2, sigma = sin(alpha w)/alpha, kappa = cos(alpha w),

.. math::
    q q\,(u + h) &= q q + 2\sigma S(h) + \kappa V(h)\\
    q c\,(u + h) &= q c + \kappa S(h) - \tfrac{\alpha^2}{2}\sigma V(h)

where S(h) = sin(alpha h)/alpha and V(h) = 2 (1 - cos(alpha h))/alpha^2 do not
depend on u: multiplying by them is one constant matrix for all times. At one
time, which may be a symbol of a tracer, the products are evaluated from the
inside out (`one_time`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from operator import mul
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from ctrlplan._types import Value
from ctrlplan.trajectories.common import FACTORIALS, Array, readonly
from ctrlplan.trajectories.digits import many_digits
from ctrlplan.trajectories.fields import Fields, StoredProperty
from ctrlplan.trajectories.one_time import (
    effective,
    kernel_weights,
    newton_series,
    pair_series,
    polynomial_series,
    trigonometric_series,
)
from ctrlplan.trajectories.quadrature import gauss
from ctrlplan.trajectories.sampling import collocation
from ctrlplan.trajectories.swing import MAXIMUM_SWING

_MEET = 0.25
"""The ends coincide if their distance on the circle is below this fraction of that to all neighbours."""

_PRODUCT = 1e3
"""Amplification of rounding errors up to which the inverse is as accurate as a triangular solution."""

_SUSPECT = 1e5
"""Amplification of rounding errors above which the loss of accuracy is estimated."""

_ACCURATE = 1e-10
"""Error relative to a plan's range above which decimal arithmetic is used."""

_ACROSS = 1e-2
"""Distance across the closed end [fraction of a turn] below which sines of alpha times t lose digits."""

MAXIMUM_LOSS = 1e-6
"""Maximum error relative to a plan's range; a larger one raises."""

_MAXIMUM_DIGITS = 100
"""Maximum number of constraints for decimal arithmetic, which then takes a fraction of a second."""

_INCREASING = 1.5
"""Half of alpha [rad] up to which distances on the circle increase with those in time, by more than rounding."""

_STORED = 64
"""Number of constraints up to which their order is stored for other times."""

_SHORT = 4
"""Maximum number of waypoints whose coefficients bound the range of a plan."""

_ELEMENTARY, _BETWEEN, _APART = 3, 256, 1e-12
"""Highest order of Taylor coefficients from elementary symmetric sums, the number of times up to which these are the
faster ones, and the distance from a node above which their ratios cannot overflow."""

NEARLY_CLOSED = 5.0
"""Alpha [rad] above which both ends may coincide."""


class NewtonSystem(Fields):
    """Factorised collocation for one pattern of times and prescribed entries.

    It depends on alpha, on the relative times and on which entries are
    prescribed, but not on their values or on the duration, and is reused for
    others.

    Parameters
    ----------
    alpha : float
        Shape parameter [rad] over the normalised interval; 0 is the polynomial.
    times : ndarray, shape (nwaypoints,)
        Relative times, increasing from 0.
    given : tuple of tuple of int
        For each waypoint the derivative orders prescribed there, increasing.
    gamma : float or None
        Phase [rad of tau] of the top harmonic; None is the constraints' mean.
    size : int or None
        Number of basis functions, at least the number of constraints; the
        spare coefficients minimise int (y^(smooth))^2 over [0, 1].
    smooth : int
        That derivative order.
    meet : bool
        Whether the data of both ends agree, so that the ends may be one node
        near alpha = 2 pi.
    apart : ndarray, shape (nwaypoints, nwaypoints), or None
        Differences of the relative times, if they are known more accurately than
        the times themselves, as for waypoints close together.

    Raises
    ------
    ValueError
        If free entries or gamma make the (Birkhoff) system singular, so that the
        constraints do not determine the plan.
    """

    alpha: float
    size: int
    pattern: Pattern  # the constraints in the order of the Newton form
    _gamma: float | None  # as given
    _triangle: Array
    _spread: Array | None
    _fold: float
    _nodes: Array
    _moments: list[float]  # nodes, each waypoint once
    _pairs: _Pairs

    def __init__(
        self,
        alpha: float,
        times: Array,
        given: tuple[tuple[int, ...], ...],
        gamma: float | None = None,
        size: int | None = None,
        smooth: int = 3,
        meet: bool = False,
        apart: Array | None = None,
    ) -> None:
        count = sum(map(len, given))
        if count == 0:
            raise ValueError("an axis must have at least one prescribed entry, got none")
        moments = times.tolist()
        ordered, meet = _leja(effective(alpha), moments, given, meet)
        pattern = (_stored_pattern if count <= _STORED else _pattern)(ordered, given, meet)
        nodes, pairs, whole = times.take(pattern.waypoints), pattern.pairs, size or count
        fold = 0.0 if gamma is None else _fold(alpha, whole, pattern.mean(moments), gamma)
        if whole > count:
            spare = _spare_nodes(pattern.mean(moments), whole - count)
            moments = [*moments, *spare.tolist()]
            pairs = _pairs([*pattern.at, *range(len(times), len(moments))])
            nodes = np.concatenate([nodes, spare])
        self._fill(
            alpha=alpha,
            size=whole,
            pattern=pattern,
            _gamma=gamma,
            _fold=fold,
            _nodes=readonly(nodes),
            _moments=moments,
            _pairs=pairs,
        )
        spread = None
        if pattern.places is None or apart is not None or whole > count or fold:
            beyond = times[:, None] - nodes
            if apart is not None:
                beyond[:, :count] = apart.take(pattern.waypoints, axis=1)
            collocation = self._collocation(beyond)
        else:
            collocation = _products_at_nodes(times, 0.5 * effective(alpha), pattern, pattern.places)
        if not pattern.hermite or whole > count:
            roughness = self.squared_samples(smooth) if whole > count else None
            collocation, spread = _factor(collocation, pattern.hermite, roughness, pattern.lead)
        self._fill(_triangle=readonly(np.asfortranarray(collocation)), _spread=spread)
        if not all(collocation.diagonal().tolist()):
            raise ValueError("the constraints must determine the plan, got a singular system")

    @property
    def waypoint_index(self) -> NDArray[np.intp]:
        """Waypoint of each constraint."""
        return self.pattern.waypoints

    @property
    def order_index(self) -> NDArray[np.intp]:
        """Order of each constraint."""
        return self.pattern.orders

    @property
    def hermite(self) -> bool:
        """Whether no order is left out between others at any waypoint."""
        return self.pattern.hermite

    @property
    def gamma(self) -> float | None:
        """Phase [rad of tau] of the top harmonic; None for odd sizes and for polynomials."""
        if self._gamma is not None or self.size % 2 or not self.alpha:
            return self._gamma
        return self.alpha * self.pattern.mean(self._moments)

    def entries(self, table: NDArray[Any]) -> NDArray[Any]:
        """Entries (nconstraints, naxes) of a table (nwaypoints, norders, naxes)."""
        pattern, (_, norders, naxes) = self.pattern, table.shape
        if norders > pattern.order + 1:
            return np.asarray(table[pattern.waypoints, pattern.orders])
        return table.reshape(-1, naxes).take(pattern.rows, axis=0)

    def taylor_scale(self, duration: float, naxes: int = 1) -> Array:
        """Factors (nconstraints, naxes) from prescribed derivatives to normalised Taylor data."""
        return _taylor_scale(duration, self.pattern, naxes)

    def coefficients(self, taylor_data: Array) -> Array:
        """Coefficients (size, naxes) from Taylor data (nconstraints, naxes)."""
        # Positions relative to the first one: a common offset costs no digits of their differences.
        offset, data = self._shifted(taylor_data)
        # Not LAPACK's dtrtrs, whose threads are slow for small systems.
        solved = blas.dtrsm(1.0, self._triangle, data, lower=1)
        found = solved if self._spread is None else self._spread @ solved
        found[0] += offset
        return found

    def _shifted(self, taylor_data: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """First prescribed position of each column, and the data relative to it, as a new array."""
        pattern = self.pattern
        offset = taylor_data[pattern.anchor]
        if not pattern.leading:
            offset = offset * pattern.positions[pattern.anchor]
            return offset, taylor_data - pattern.positions * offset
        data = taylor_data.copy()
        positions = data[: pattern.leading]
        positions -= offset
        return offset, data

    def coefficients_of_many(self, taylor_data: NDArray[Any]) -> Array:
        """The same for many columns, which are overwritten, by one product where that is as accurate."""
        if self.inverse is None or taylor_data.dtype != np.float64:
            return self.coefficients_of(taylor_data)
        offset, leading = taylor_data[self.pattern.anchor].copy(), self.pattern.leading
        taylor_data[slice(leading) if leading else self.order_index == 0] -= offset
        found: Array = self.inverse @ taylor_data
        found[0] += offset
        return found

    @cached_property
    def inverse(self) -> Array | None:
        """Matrix from Taylor data to coefficients; None where it loses digits."""
        if self._spread is not None or 0 not in self.pattern.keys or self.amplification > _PRODUCT:
            return None
        return readonly(np.ascontiguousarray(blas.dtrsm(1.0, self._triangle, np.eye(self.size), lower=1)))

    def coefficients_of(self, taylor_data: NDArray[Any]) -> Array:
        """The same for entries of a complete jet at each waypoint, with the digits of extended numbers."""
        if taylor_data.dtype == np.float64 or self._spread is not None:
            return self.coefficients(taylor_data.astype(float, copy=False))
        offset, found = self._shifted(taylor_data)
        triangle = self._triangle.astype(found.dtype)
        for n in range(len(triangle)):
            found[n] = (found[n] - triangle[n, :n] @ found[:n]) / triangle[n, n]
        found[0] += offset
        return found.astype(float)

    def fitted(self, values: Array, times: Sequence[float], duration: float, taylor_data: Array) -> Array:
        """Coefficients from prescribed derivatives at times [s], with an error below `MAXIMUM_LOSS`.

        Raises
        ------
        ValueError
            If rounding could change the plan by more than 1e-6 of its range.
        """
        if self._is_mild and self.alpha <= NEARLY_CLOSED:  # nearly all
            return self.coefficients(taylor_data)
        loss = self.loss(taylor_data)
        if self._across(times, duration) < _ACROSS and self.hermite and len(values) <= _MAXIMUM_DIGITS:
            loss = 1.0  # the triangle itself is inaccurate
        if loss <= _ACCURATE:
            return self.coefficients(taylor_data)
        if self.hermite and len(values) <= _MAXIMUM_DIGITS:
            return self.resolved(values, times, duration)
        if loss <= MAXIMUM_LOSS:
            return self.coefficients(taylor_data)
        why = "waypoints so close together amplify rounding: move them apart, or use PiecewiseSpline"
        if self.alpha > NEARLY_CLOSED:
            why = "near alpha = 2 pi both ends nearly coincide: lower alpha, or use TrigSpline.cyclic"
        raise ValueError(
            f"waypoints must determine the plan to {MAXIMUM_LOSS:g} of its range in floating point, got an estimated "
            f"loss of {loss:.1g}; {why}"
        )

    def resolved(self, values: NDArray[Any], times: Sequence[float], duration: float, digits: int = 0) -> Array:
        """Coefficients in decimal arithmetic, for the triangle of the Newton form; values may be decimals.

        `digits` is the expected loss of decimal digits in addition to that of the nodes.
        """
        digits += math.ceil(math.log10(min(self.amplification, 1e300)))
        constraints = self.waypoint_index, self.order_index
        solved = many_digits(effective(self.alpha), times, duration, constraints, values, self._fold, digits)
        return solved if self._spread is None else self._spread @ solved

    def taylor(self, u: Array, order: int) -> Array:
        """Taylor coefficients of every basis function.

        Parameters
        ----------
        u : ndarray, shape (ntime,)
            Normalised times.
        order : int
            Highest coefficient; coefficient k is the k-th derivative / k!.

        Returns
        -------
        ndarray, shape (size, order + 1, ntime)
        """
        first, second = self._paired
        return self._taylor(u - first[:, None], u - second[:, None], order)

    @cached_property
    def _paired(self) -> tuple[Array, Array]:
        """Nodes of the first and of the second factor of each pair."""
        return self._nodes[: self.size - self.size % 2 : 2], self._nodes[1::2]

    def _taylor(self, first: Array, second: Array, order: int) -> Array:
        """Taylor coefficients from the distances (npairs, ntime) to the nodes of each pair."""
        alpha = effective(self.alpha)
        half = 0.5 * alpha
        npairs, ntime = len(second), second.shape[1]
        out = np.empty((2 * npairs + 1, order + 1, ntime))
        out[0] = 0.0
        out[0, 0] = 1.0
        if npairs:
            middle = 0.5 * (first + second)
            factor = np.empty((npairs, 2, 3, 1, ntime))  # [q c, q q] by [1, S, V]
            if alpha:
                q = np.sin(half * first) / half
                second = half * second
                sigma, kappa = np.sin(alpha * middle), np.cos(alpha * middle)
                factor[:, 0, 0, 0] = q * np.cos(second)
                factor[:, 1, 0, 0] = q * np.sin(second) / half
                factor[:, 0, 1, 0] = factor[:, 1, 2, 0] = kappa
                factor[:, 0, 2, 0] = -half * sigma
                factor[:, 1, 1, 0] = (2.0 / alpha) * sigma
            else:
                factor[:, 0, 0, 0] = first
                factor[:, 1, 0, 0] = first * second
                factor[:, 0, 1, 0] = factor[:, 1, 2, 0] = 1.0
                factor[:, 0, 2, 0] = 0.0
                factor[:, 1, 1, 0] = 2.0 * middle
            kernel = _kernel(alpha, order)
            for j in range(npairs):
                shifted = (kernel @ out[2 * j]).reshape(3, order + 1, ntime)
                np.add.reduce(factor[j] * shifted, axis=1, out=out[2 * j + 1 : 2 * j + 3])
        if self._fold:
            out[self.size - 1] += self._fold * out[self.size]
        return out[: self.size]

    def _collocation(self, beyond: Array) -> Array:
        """Prescribed Taylor coefficients (nconstraints, size) of every basis function.

        As `_taylor`, by matrices that multiply series by the factors of each pair: fewer
        steps, for few times.

        Parameters
        ----------
        beyond : ndarray, shape (nwaypoints, size)
            Distances of the waypoints to the nodes.
        """
        pattern = self.pattern
        half, n = 0.5 * effective(self.alpha), max(pattern.keys) + 1
        count, npairs = len(beyond), self.size // 2
        angles = np.empty((3, npairs, count))  # of both factors of each pair, and their sum
        np.multiply(beyond[:, : 2 * npairs].T.reshape(npairs, 2, count).swapaxes(0, 1), half or 1.0, out=angles[:2])
        parts = np.empty((2, npairs, count, 3))  # of q c and of q q
        np.add(angles[0], angles[1], out=angles[2])
        if half:
            cosines, angles = np.cos(angles[1:]), np.sin(angles)
            np.multiply(angles[0], cosines[0], out=parts[0, ..., 0])
        else:
            cosines = np.ones((2, 1, 1))
            parts[0, ..., 0] = angles[0]
        np.multiply(angles[0], angles[1], out=parts[1, ..., 0])
        parts[..., 1], parts[..., 2] = cosines[1], angles[2]
        factors = (parts.reshape(2, npairs * count, 3) @ _pair_kernel(self.alpha, n - 1)).reshape(
            2, npairs, count, n, n
        )
        series = np.zeros((npairs + 1, count, n, 1))
        series[0, :, 0] = 1.0
        for j in range(npairs if self._fold or self.size % 2 else npairs - 1):  # the last product may not be used
            np.matmul(factors[1, j], series[j], out=series[j + 1])
        out = np.empty((2 * npairs + 1, count, n))
        out[::2] = series[..., 0]
        out[1::2] = (factors[0] @ series[:-1])[..., 0]
        if self._fold:
            out[self.size - 1] += self._fold * out[self.size]
        return np.asarray(out[: self.size, pattern.waypoints, pattern.orders].T)

    def taylor_between(self, u: Array, order: int) -> Array:
        r"""As `taylor`, faster at few times that are not near a node.

        A factor f with f'' = -2 w f, where w = alpha^2/8, has the series

        .. math:: f(u + h)/f(u) = 1 + r h - w h^2 - \tfrac{1}{3} w r h^3 + \dots, \quad r = f'/f

        and those of all products of factors are accumulated together. Near a node a
        ratio r is large and the product small: errors are those of rounding of their
        product.

        Returns
        -------
        ndarray, shape (order + 1, size, ntime)
        """
        half, count = 0.5 * effective(self.alpha), 2 * (self.size // 2)
        if order > _ELEMENTARY:
            return self.taylor(u, order).transpose(1, 0, 2)
        apart = u - self._nodes[:count, None]
        near = np.flatnonzero((np.abs(apart) <= _APART).any(axis=0))
        apart[:, near] = 0.5
        out = np.zeros((order + 1, count + 1, u.size))
        value, bend = out[0], 0.5 * half * half
        value[0] = 1.0
        if half:
            apart *= half
            cosine = np.cos(apart)
            apart = np.sin(apart, out=apart)
            apart /= half
            ratio = cosine / apart
        else:
            ratio = 1.0 / apart
        np.multiply.accumulate(apart, axis=0, out=value[1:])
        for k in range(1, order + 1):
            np.add.accumulate(_next(ratio, out[:k, :-1], bend), axis=0, out=out[k, 1:])
        if half:
            odd = list(out[:, 1::2])  # views; the last factor is a cosine, whose ratio is -2w/r
            own = (-2.0 * bend) / ratio[1::2]
            for k in range(order, 0, -1):
                odd[k] += _next(own, odd[:k], bend)
            odd[0] *= cosine[1::2]
        derivatives = out[1:]
        derivatives *= value
        if self._fold:
            out[:, self.size - 1] += self._fold * out[:, self.size]
        if near.size:
            out[:, : self.size, near] = self.taylor(u[near], order).transpose(1, 0, 2)
        return out[:, : self.size]

    def jet(self, coefficients: Array, u: Array, order: int) -> Array:
        """Taylor coefficients (order + 1, naxes, ntime) of functions at normalised times.

        Parameters
        ----------
        coefficients : ndarray, shape (size, naxes)
            Of the functions of the basis.
        u : ndarray, shape (ntime,)
            Normalised times.
        order : int
            Highest coefficient.
        """
        if order <= _ELEMENTARY and u.size <= _BETWEEN:
            return np.asarray(coefficients.T @ self.taylor_between(u, order))
        values = coefficients.T @ self.taylor(u, order).reshape(self.size, -1)
        return np.asarray(values.reshape(coefficients.shape[1], order + 1, u.size).transpose(1, 0, 2))

    def interpolant(self, coefficients: Array, low: int, high: int) -> Array:
        """Interpolants (high - low + 1, naxes, nterms) of Taylor coefficients on the unit interval.

        By the products of `sampling`, whose span contains the functions and their derivatives.

        Parameters
        ----------
        coefficients : ndarray, shape (naxes, size)
            Of the functions of the basis.
        low, high : int
            Lowest and highest order.
        """
        points, products = collocation(effective(self.alpha), self.size)
        if high not in self._values:
            self._values[high] = readonly(self.taylor_between(points, high))
        values = coefficients @ self._values[high][low:]
        found = values.reshape(-1, points.size) @ products  # one product of matrices
        return np.asarray(found.reshape(len(values), len(coefficients), -1))

    def interpolants(self, low: int, high: int) -> Array:
        """Interpolants (high - low + 1, size, nterms) of all functions of the basis, which are stored."""
        if (low, high) not in self._interpolants:
            self._interpolants[low, high] = readonly(self.interpolant(_identity(self.size), low, high))
        return self._interpolants[low, high]

    @cached_property
    def _values(self) -> dict[int, Array]:
        """Taylor coefficients at the points of interpolants by highest order."""
        return {}

    @cached_property
    def _interpolants(self) -> dict[tuple[int, int], Array]:
        """Interpolants of the basis by lowest and highest order."""
        return {}

    def series(self, coefficients: Array, u: Value, order: int) -> list[list[Value]]:
        """Taylor series of each axis at one normalised time, a number or a symbol."""
        factors = [
            pair_series(self.alpha, u - first, u - second, order)
            for first, second in zip(*map(np.ndarray.tolist, self._paired), strict=True)
        ]
        columns = coefficients.T.tolist()
        if self._fold:
            columns = [[*column, self._fold * column[-1]] for column in columns]
        return [newton_series(factors, column, order) for column in columns]

    def series_at(self, columns: Sequence[Sequence[float]], u: float, order: int) -> list[list[float]]:
        """Taylor series of each axis at one normalised time, a number, from the coefficients by axis."""
        if not effective(self.alpha):
            gaps = [u - node for node in self._nodes_backwards]
            return [polynomial_series(gaps, column, order) for column in columns]
        moments, (pairs, places) = self._moments, self._pairs
        if self._fold:
            columns = [[*column, self._fold * column[-1]] for column in columns]
        distinct = [pair_series(self.alpha, u - moments[i], u - moments[j], max(order, 3)) for i, j in pairs]
        factors = [distinct[place] for place in places]
        return [trigonometric_series(factors, column, order) for column in columns]

    @cached_property
    def _nodes_backwards(self) -> list[float]:
        """Nodes of the products, the last one first."""
        return self._nodes[self.size - 2 :: -1].tolist() if self.size > 1 else []

    def _across(self, times: Sequence[float], duration: float) -> float:
        """Minimum distance on the circle from a waypoint near the end to one near the start, without the two ends."""
        if self.alpha <= NEARLY_CLOSED:
            return 1.0
        used = [times[i] for i in sorted(set(self.waypoint_index.tolist()))]
        apart = max([times[-1] - t for t in used[1:2]] + [t - times[0] for t in used[-2:-1]], default=0.0)
        return math.sin(0.5 * self.alpha * min(apart / duration, 1.0))

    def loss(self, taylor_data: Array) -> float:
        """Bound of the rounding error of the plan through the data, relative to its range.

        Skeel's componentwise bound to first order: the rounding of each product of
        the triangular solution is propagated to the plan by the inverse.
        """
        if self._is_mild:
            return 0.0
        _, data = self._shifted(taylor_data)
        solved = blas.dtrsm(1.0, self._triangle, data, lower=1)
        rounding = np.finfo(float).eps * (np.abs(self._triangle) @ np.abs(solved))
        functions, cardinal = self._samples
        plan, error = (np.abs(values).max(axis=1) for values in (functions @ solved, np.abs(cardinal) @ rounding))
        # Derivatives are scaled as Taylor coefficients: some differ from 0 by rounding only.
        size = np.maximum(plan, plan[0])
        return float((error / np.where(size > 0.0, size, 1.0)).max())

    @cached_property
    def functions(self) -> Array:
        """Values (size, ntime) of the basis functions on a grid that resolves any plan."""
        u, half, count = _grid(2 * self.size + 1), 0.5 * effective(self.alpha), 2 * (self.size // 2)
        apart = u - self._nodes[:count, None]
        out = np.empty((count + 1, u.size))
        out[0] = 1.0
        if half:
            apart *= half
            np.multiply.accumulate(np.sin(apart) / half, axis=0, out=out[1:])
            out[1::2] *= np.cos(apart[1::2])
        else:
            np.multiply.accumulate(apart, axis=0, out=out[1:])
        if self._fold:
            out[self.size - 1] += self._fold * out[self.size]
        return out[: self.size]

    @cached_property
    def ranges(self) -> list[float]:
        """Bounds of the ranges of the basis functions from the second on, over the unit interval."""
        alpha, moments, (pairs, places) = effective(self.alpha), self._moments, self._pairs
        peaks = [_pair_peaks(alpha, moments[i], moments[j]) for i, j in pairs]
        return _ranges(alpha, self._nodes.tolist(), [peaks[place] for place in reversed(places)])[: self.size - 1]

    @cached_property
    def higher_ranges(self) -> Array:
        """The same from the third function on, as an array."""
        return readonly(np.array(self.ranges[1:]))

    @cached_property
    def higher_norm(self) -> float:
        """Root of the sum of the squares of the same."""
        return math.sqrt(sum([value * value for value in self.ranges[1:]])) * (1.0 + 1e-12)

    @property
    def coarse_ranges(self) -> Array:
        """Bounds of the ranges of all functions from the order of the nodes alone, 0 for the first function."""
        closed = self._moments[self.pattern.nwaypoints - 1] == 1.0
        return _coarse_ranges(self.pattern, self.size, closed, self.alpha > math.pi)

    def stays_near(self, coefficients: Array, values: Array) -> bool:
        """Whether coefficients are finite and exclude a swing far beyond the positions.

        Only for few waypoints; otherwise values of all functions are as fast as their
        ranges, and say more.

        Parameters
        ----------
        coefficients : ndarray, shape (size, naxes)
            Coefficients of some axes.
        values : ndarray, shape (nconstraints, naxes)
            The finite entries from which they are.
        """
        count = self.pattern.is_short
        if not count or self._fold:
            return False
        if count == 2:  # the second coefficient is the difference of the positions
            ranges, columns = self._added_ranges, coefficients.T.tolist()
            return all([-math.inf < sum(map(mul, ranges, map(abs, column))) <= 0.0 for column in columns])
        bounds = self.coarse_ranges.dot(np.abs(coefficients)).tolist()
        allowed = [MAXIMUM_SWING * (max(row) - min(row)) for row in values[:count].T.tolist()]
        return all([bound <= limit < math.inf for bound, limit in zip(bounds, allowed, strict=True)])

    @cached_property
    def _added_ranges(self) -> list[float]:
        """Ranges of the functions of two waypoints, without the range that their positions allow to the second."""
        ranges = [0.0, *self.ranges]
        ranges[1] -= MAXIMUM_SWING * abs(self._triangle.item(1, 1))
        return ranges

    @cached_property
    def amplification(self) -> float:
        """Maximum amplification of rounding errors by the solution."""
        scaled, inverse = self._scaled
        return float((np.abs(inverse) @ np.abs(scaled)).max())

    @StoredProperty
    def _is_mild(self) -> bool:
        """Whether the amplification is below `_SUSPECT`.

        With columns scaled by any weights, no entry of the product of absolute values is
        above the largest entry times the sum of a row of the inverse, which the root of
        its squares bounds. For few waypoints that are not close together nothing more is
        needed.
        """
        weights = None if self._spread is not None else _weights(self.pattern, round(self.alpha))
        if weights is not None:
            scaled = self._triangle * weights
            inverse, _ = lapack.dtrtri(scaled, 1)
            scaled, inverse = scaled.ravel(order="K"), inverse.ravel(order="K")
            largest = abs(scaled[blas.idamax(scaled)])
            if len(weights) ** 0.5 * largest * blas.dnrm2(inverse) < _SUSPECT:
                return True
        return self.amplification < _SUSPECT

    @property
    def _scaled(self) -> tuple[Array, Array]:
        """The triangle with columns of largest entry 1, and its inverse."""
        scaled = self._triangle / np.maximum.reduce(np.abs(self._triangle), axis=0)
        return scaled, blas.dtrsm(1.0, scaled, _identity(len(scaled)), lower=1)

    @cached_property
    def _samples(self) -> tuple[Array, Array]:
        """Taylor coefficients (order + 1, ntime, nconstraints) as functions of the solution, and of the data."""
        u = np.linspace(0.0, 1.0, 2 * self.size + 1)
        functions = self.taylor(u, int(self.order_index.max())).transpose(1, 2, 0)
        functions = functions if self._spread is None else functions @ self._spread
        return functions, functions @ blas.dtrsm(1.0, self._triangle, np.eye(len(self._triangle)), lower=1)

    def squared_samples(self, order: int) -> Array:
        """Weighted samples G with int_0^1 (y^(order))^2 = |G coefficients|^2, to rounding."""
        exact = max(self.size - order, 1)
        nodes, weights = gauss(2 * self.size + int(4.0 * self.alpha) + 8 if self.alpha else exact)
        return (FACTORIALS[order] * np.sqrt(weights) * self.taylor(nodes, order)[:, order]).T


def _products_at_nodes(times: Array, half: float, pattern: Pattern, places: NDArray[np.intp]) -> Array:
    r"""Collocation by elementary symmetric sums: each product without its factors that are 0.

    With the ratios q'/q of its other factors, a product of N factors, z of them 0, is
    about a node its value V without the latter times

    .. math:: \sum_k e_k S(h)^{z+k} C(h)^{N-z-k}

    with S and C as in `NewtonSystem.taylor_between`, to the third order of h

    .. math:: S^p C^{N-p} = h^p (1 - (3 N - 2 p) (\alpha/2)^2 h^2/6)

    A cosine c(h) cos a - S(h) (alpha/2) sin a is one more factor.

    Parameters
    ----------
    times : ndarray, shape (nwaypoints,)
        Relative times.
    half : float
        Half of alpha [rad].
    pattern : Pattern
        The constraints, of which all nodes are.
    places : ndarray
        As of the pattern.
    """
    # Products of arrays of one shape take half the time of those that are spread over a further axis.
    order, own = pattern.order, pattern.own
    pairs = times.take(pattern.between)
    angle = pairs[0]  # of each function and waypoint
    angle -= pairs[1]
    if half:
        angle *= half
        sine, cosine = np.sin(angle), np.cos(angle)
        factors = sine / half
        factors += own
        ratio = cosine - own
        ratio /= factors
    else:
        factors = angle
        factors += own
        ratio = pattern.apart / factors
    sums = pattern.first_sums.copy()  # e_k, then V e_k
    value, *rows = sums[: order + 1]
    np.multiply.accumulate(factors[:-1], 0, None, value[1:])
    terms = ratio = ratio[:-1]
    for k, row in enumerate(rows, 1):
        np.add.accumulate(terms, 0, None, row[1:])
        if k < order:
            terms = ratio * row[:-1]
    if half:
        odd, bends = _odd_functions(pattern, half)
        sine *= odd
        cosine[::2] = 1.0
        _multiply_by_cosine(rows, sine, cosine, bends)
    for row in rows:
        row *= value
    if half:
        value *= cosine
    return sums.take(places).T


def _multiply_by_cosine(rows: Sequence[Array], sine: Array, cosine: Array, bends: Sequence[Array]) -> None:
    """Sums e_1, e_2, ... with one more factor c(h) cosine - S(h) sine, reduced by powers of cosines."""
    less = sine
    for k, row in enumerate(rows):
        following = sine * row if k + 1 < len(rows) else sine
        row *= cosine
        row -= less
        if k:
            row -= bends[k - 1] * (rows[k - 2] if k > 1 else cosine)
        less = following


@lru_cache(maxsize=256)
def _odd_functions(pattern: Pattern, half: float) -> tuple[Array, list[Array]]:
    """Half of alpha for functions with a cosine, else 0, and reductions of sums 2 and 3 by powers of cosines."""
    return readonly(half * pattern.odd), list(readonly((half * half) * pattern.cosines))


def _next(ratio: Array, lower: Array | Sequence[Array], bend: float) -> Array:
    """Change by one factor of the coefficient after the lower ones; the first, the value, is taken for 1."""
    order = len(lower)
    if order == 1:
        return ratio
    found: Array = ratio * lower[-1]
    if bend and order == 2:
        found -= bend
    elif bend:
        found -= bend * lower[1] + (bend / 3.0) * ratio
    return found


@lru_cache(maxsize=128)
def _identity(size: int) -> Array:
    return readonly(np.asfortranarray(np.eye(size)))


@lru_cache(maxsize=64)  # few enough to stay in the second cache of a processor
def shared_system(
    alpha: float,
    times: tuple[float, ...],
    given: tuple[tuple[int, ...], ...],
    gamma: float | None,
    size: int | None,
    smooth: int,
    meet: bool,
) -> NewtonSystem:
    """System that is shared by all plans with these relative times, as by all moves between two waypoints."""
    return NewtonSystem(alpha, np.array(times), given, gamma, size, smooth, meet)


@lru_cache(maxsize=256)
def _taylor_scale(duration: float, pattern: Pattern, naxes: int) -> Array:
    """Powers of a duration over factorials by constraint, repeated for each axis: products of one shape are faster."""
    order = pattern.order
    try:
        powers = [duration**k / math.factorial(k) for k in range(order + 1)]
    except OverflowError:
        powers = [0.0]
    if not 1e-290 < powers[-1] < math.inf:
        raise ValueError(
            f"powers of the duration must stay within floating point, got {duration:g} s to the power "
            f"{order}; choose another unit of time"
        )
    return readonly(np.array(powers).take(pattern.orders)[:, None].repeat(naxes, axis=1))


@lru_cache(maxsize=256)
def _coarse_ranges(pattern: Pattern, size: int, closed: bool, turns: bool) -> Array:
    r"""Bounds of the ranges of functions for any times of waypoints, the last one at the end if `closed`.

    A factor is at most the distance to its node. Of a nodes at the start and b at the
    end the product is at most

    .. math:: \max_u u^a (1 - u)^b = a^a b^b / (a + b)^{a + b}

    and does not change its sign. Of the other factors, squares are at most 1, and so
    are the ranges, with 0, of one other and of a product of two. A cosine is at most 1,
    and changes its sign only if `turns`, for alpha above pi.
    """
    spare = range(pattern.nwaypoints, pattern.nwaypoints + size - len(pattern.at))
    found, first, last = [0.0], 0, pattern.nwaypoints - 1 if closed else -1
    counts = dict.fromkeys((first, last, *pattern.at, *spare), 0)
    for number, node in enumerate((*pattern.at, *spare)[: size - 1], 1):
        counts[node] += 1
        a, b = counts[first], counts[last]
        odd = sum([count % 2 for other, count in counts.items() if other not in (first, last)])
        found.append(a**a * b**b / (a + b) ** (a + b) * (2.0 if odd > 2 or (turns and number % 2) else 1.0))
    return readonly(np.array(found))


def _ranges(alpha: float, nodes: list[float], peaks: list[tuple[float, float]]) -> list[float]:
    """Bounds of the ranges of the basis functions from the second on, from the nodes.

    The peaks of each pair are those of `_pair_peaks`. Functions with nodes at the ends
    only do not change their sign.
    """
    found: list[float] = []
    product, signed, alternate = 1.0, True, True  # signs do not change; each pair before has a node at each end
    few = alpha <= math.pi
    for a, b, (alone, pair) in zip(nodes[::2], nodes[1::2], peaks, strict=False):
        at_end = few and a in _ENDS
        if alternate and at_end:
            found.append(_odd_peak(alpha, len(found) // 2))
            alternate = abs(b - a) == 1.0
        else:
            alternate = False
            found.append(product * alone if signed and at_end else 2.0 * product * alone)
        product *= pair
        signed = signed and a in _ENDS and b in _ENDS
        found.append(product if signed else 2.0 * product)
    return found


_ENDS = (0.0, 1.0)


def _pair_peaks(alpha: float, a: float, b: float) -> tuple[float, float]:
    """Maxima of the first factor of a pair of nodes, and of the product of both.

    Between the nodes the product is largest at their mean, outside at the end that is
    farther from it.
    """
    mean, apart, alone = 0.5 * (a + b), abs(b - a), max(a, 1.0 - a)
    far = max(mean, 1.0 - mean)
    if not alpha:
        return alone, max(0.25 * apart**2, far**2 - 0.25 * apart**2)
    inner = math.cos(0.5 * alpha * apart)
    pair = 2.0 / alpha**2 * max(1.0 - inner, inner - math.cos(min(alpha * far, math.pi)))
    return 2.0 / alpha * math.sin(min(0.5 * alpha * alone, 0.5 * math.pi)), pair


@lru_cache(maxsize=256)
def _odd_peak(alpha: float, pairs: int) -> float:
    r"""Maximum of the product of n pairs with nodes at both ends, and of a single function, for alpha up to pi.

    For w = u - 1/2 this is :math:`(\sin(\alpha/2) + \sin\alpha w)/\alpha` times the power
    n of :math:`2 (\cos\alpha w - \cos(\alpha/2))/\alpha^2`, which has one maximum.
    """
    n = pairs
    if not alpha:
        return float((n + 1) ** (n + 1) * n**n / (2 * n + 1) ** (2 * n + 1))
    s, c = math.sin(0.5 * alpha), math.cos(0.5 * alpha)
    low, high = 0.0, 0.5
    for _ in range(40 if n else 0):  # the root of the derivative of the logarithm
        w = alpha * 0.5 * (low + high)
        rises = math.cos(w) * (math.cos(w) - c) > n * math.sin(w) * (s + math.sin(w))
        low, high = (0.5 * (low + high), high) if rises else (low, 0.5 * (low + high))
    w = alpha * high
    found = (s + math.sin(w)) / alpha * (2.0 * (math.cos(w) - c) / alpha**2) ** n
    return found * (1.0 + 1e-9)


@lru_cache(maxsize=256)
def _grid(count: int) -> Array:
    """Evenly spaced relative times."""
    return readonly(np.linspace(0.0, 1.0, count))


_Pairs = tuple[list[tuple[int, int]], list[int]]
"""Different pairs of nodes, and the place of each pair among them, the last one first."""


def _pairs(nodes: Sequence[int]) -> _Pairs:
    """Pairs of nodes, given by their numbers."""
    pairs: dict[tuple[int, int], int] = {}
    places = [pairs.setdefault(pair, len(pairs)) for pair in zip(nodes[::2], nodes[1::2], strict=False)]
    return list(pairs), places[::-1]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Constraints in the order of the Newton form.

    Attributes
    ----------
    at, keys : tuple of int
        Waypoint and order of each constraint.
    waypoints, orders : ndarray of int, shape (nconstraints,)
        The same as arrays.
    hermite : bool
        Whether no order is left out at any waypoint.
    lead : int
        Number of constraints of ends that coincide.
    nwaypoints : int
        Number of waypoints, with those without constraints.
    """

    at: tuple[int, ...]
    keys: tuple[int, ...]
    waypoints: NDArray[np.intp]
    orders: NDArray[np.intp]
    hermite: bool
    lead: int
    nwaypoints: int

    def mean(self, moments: Sequence[float]) -> float:
        """Mean of the constraints' times."""
        return math.fsum([moments[i] for i in self.at]) / len(self.at)

    @cached_property
    def order(self) -> int:
        """Highest order."""
        return max(self.keys)

    @cached_property
    def rows(self) -> NDArray[np.intp]:
        """Place of each constraint in a table of all orders of each waypoint."""
        found = self.waypoints * (self.order + 1) + self.orders
        found.flags.writeable = False
        return found

    @cached_property
    def positions(self) -> Array:
        """1 for a prescribed position, else 0, (nconstraints, 1)."""
        return readonly((self.orders == 0).astype(float)[:, None])

    @cached_property
    def anchor(self) -> int:
        """First prescribed position; 0 if there is none."""
        return self.keys.index(0) if 0 in self.keys else 0

    @cached_property
    def leading(self) -> int:
        """Number of prescribed positions if these are the first constraints, else 0."""
        count = self.keys.count(0)
        return 0 if any(self.keys[:count]) else count

    @cached_property
    def is_short(self) -> int:
        """Number of waypoints if they are few and begin with their positions, else 0."""
        number = len(set(self.at))
        return number if 2 <= number <= _SHORT and number == self.leading else 0

    @cached_property
    def pairs(self) -> _Pairs:
        """Pairs of waypoints, as nodes."""
        return _pairs(self.at)

    @cached_property
    def own(self) -> Array:
        """1 for the node of a constraint (rows) at the waypoint itself, else 0, (nconstraints, nwaypoints)."""
        return readonly((self.waypoints[:, None] == np.arange(self.nwaypoints)).astype(float))

    @cached_property
    def between(self) -> NDArray[np.intp]:
        """Waypoints, and those of the nodes of constraints (rows), (2, nconstraints, nwaypoints)."""
        found = np.array(np.broadcast_arrays(np.arange(self.nwaypoints), self.waypoints[:, None]))
        found.flags.writeable = False
        return found

    @cached_property
    def first_sums(self) -> Array:
        """Sums of `_products_at_nodes` without factors, (max(order, 1) + 1, nconstraints, nwaypoints)."""
        found = np.zeros((max(self.order, 1) + 1, *self.own.shape))
        found[0, 0] = 1.0
        return readonly(found)

    @cached_property
    def apart(self) -> Array:
        """The opposite, 0 for the node at the waypoint itself, else 1."""
        return readonly(1.0 - self.own)

    @cached_property
    def odd(self) -> Array:
        """1 for functions with a cosine, those of odd numbers, else 0, (nconstraints, nwaypoints)."""
        numbers = np.arange(len(self.at)) % 2.0
        return readonly(np.repeat(numbers[:, None], self.nwaypoints, axis=1))

    @cached_property
    def zeros(self) -> NDArray[np.intp]:
        """Number of sines of each function that are 0 at a waypoint, (nconstraints, nwaypoints)."""
        own = self.waypoints[:, None] == np.arange(self.nwaypoints)
        found = np.zeros(own.shape, dtype=np.intp)
        np.cumsum(own[:-1], axis=0, out=found[1:], dtype=np.intp)
        found.flags.writeable = False
        return found

    @cached_property
    def places(self) -> NDArray[np.intp] | None:
        """Place in the sums of `_products_at_nodes` of each function (rows), by constraint (columns).

        Coefficients below the number of factors that are 0 are 0, as the first sum of
        order 1 is. None for many constraints or high orders.
        """
        count = len(self.at)
        if count > _STORED or self.order > _ELEMENTARY:
            return None
        left = self.orders - self.zeros[:, self.waypoints]
        found = (left * count + np.arange(count)[:, None]) * self.nwaypoints + self.waypoints
        found = np.where(left >= 0, found, self.nwaypoints * count)
        found.flags.writeable = False
        return found

    @cached_property
    def cosines(self) -> Array:
        """Reduction of sums 2 and 3 by powers of cosines for alpha = 2, (order - 1, nconstraints, nwaypoints)."""
        number, orders = np.arange(float(len(self.at))), np.arange(self.order - 1)[:, None, None]
        factors = (number + number % 2.0)[:, None]  # of each function
        return readonly((3.0 * factors - 2.0 * (orders + self.zeros)) / 6.0)


@lru_cache(maxsize=256)
def _weights(pattern: Pattern, alpha: float) -> Array | None:
    """Reciprocals of the largest entry of each column of the triangle for even times, as a matrix.

    None for many constraints or high orders.
    """
    if pattern.places is None:
        return None
    even = np.abs(_products_at_nodes(_grid(pattern.nwaypoints), 0.5 * alpha, pattern, pattern.places))
    return readonly(np.asfortranarray(np.broadcast_to(1.0 / even.max(axis=0), even.shape)))


def _pattern(ordered: tuple[int, ...], given: tuple[tuple[int, ...], ...], meet: bool) -> Pattern:
    """Constraints of waypoints in Leja order; ends that coincide come first with all their entries."""
    first = _sequence(ordered[:2], given) if meet else []
    pairs = first + _sequence(ordered[2:] if meet else ordered, given)
    at, keys = (tuple(column) for column in zip(*pairs, strict=True))
    waypoints, orders = np.array(at, dtype=np.intp), np.array(keys, dtype=np.intp)
    for array in (waypoints, orders):
        array.flags.writeable = False
    hermite = all([own == tuple(range(len(own))) for own in given])
    return Pattern(at, keys, waypoints, orders, hermite, len(first), len(given))


@lru_cache(maxsize=256)
def _stored_pattern(ordered: tuple[int, ...], given: tuple[tuple[int, ...], ...], meet: bool) -> Pattern:
    """The same, stored for other times."""
    return _pattern(ordered, given, meet)


def _leja(
    alpha: float, times: list[float], given: tuple[tuple[int, ...], ...], meet: bool
) -> tuple[tuple[int, ...], bool]:
    """Waypoints in Leja order, and whether the ends coincide on the circle.

    Each maximises the product of its distances to the previous ones. Ends that
    coincide come first: as their data agree, the divided differences between them
    are 0 or small, and no others are divided by their distance.
    """
    used = None if all(given) else [i for i, own in enumerate(given) if own]
    u = times if used is None else [times[i] for i in used]
    half, count, sin = 0.5 * alpha, len(u), math.sin
    if count < 3:
        return tuple(range(count) if used is None else used), False
    first, end, chosen, rest = u[0], u[-1], [0], list(range(1, count))
    whole = abs(sin(half * (end - first))) if half else end - first
    if meet:
        meet = whole < _MEET * min([abs(sin(half * (w - v))) if half else w - v for v, w in pairwise(u)])
    if meet or half <= _INCREASING:  # the end is second
        chosen.append(rest.pop())
        scale = whole or 1.0
        if half:
            product = [abs(sin(half * (u[i] - first))) * (abs(sin(half * (u[i] - end))) / scale) for i in rest]
        else:
            product = [(u[i] - first) * ((end - u[i]) / scale) for i in rest]
    else:
        product = [abs(sin(half * (w - first))) for w in u[1:]]
    while len(rest) > 1:
        place = product.index(max(product))
        # Rescaled, so that the products do not underflow for many waypoints.
        scale, farthest = product.pop(place) or 1.0, rest.pop(place)
        chosen.append(farthest)
        if len(rest) > 1:
            v = u[farthest]
            if half:
                product = [p * (abs(sin(half * (u[i] - v))) / scale) for p, i in zip(product, rest, strict=True)]
            else:
                product = [p * (abs(u[i] - v) / scale) for p, i in zip(product, rest, strict=True)]
    chosen += rest
    return tuple(chosen if used is None else [used[i] for i in chosen]), meet


def _sequence(waypoints: tuple[int, ...], given: tuple[tuple[int, ...], ...]) -> list[tuple[int, int]]:
    """Constraints in rounds through the waypoints, those of each waypoint distributed evenly over all rounds.

    Orders increase at each waypoint, as the triangle requires, and at every stage
    the nodes are distributed like all of them. Otherwise waypoints with few
    entries before long jets elsewhere cost four digits.
    """
    pairs = [
        ((turn + 1) / len(given[i]), rank, i, order)
        for rank, i in enumerate(waypoints)
        for turn, order in enumerate(given[i])
    ]
    return [(i, order) for _, _, i, order in sorted(pairs)]


def _spare_nodes(mean: float, count: int) -> Array:
    """Nodes of additional functions, symmetric about the mean, which preserves gamma."""
    reach = min(mean, 1.0 - mean)
    return mean + reach * np.cos(np.pi * (np.arange(count) + 0.5) / count)


def _fold(alpha: float, size: int, mean: float, gamma: float) -> float:
    """Weight of the next function in the last one for a given phase of the top harmonic.

    The leading parts of phi_M and phi_{M-1} are cos and sin of m(tau - mean) in
    the ratio 2/alpha : -1, M = 2m; the sum must have no component cos m(tau - gamma).
    """
    if size % 2 or not alpha:
        why = f"{size} coefficients" if size % 2 else "alpha = 0"
        raise ValueError(f"gamma requires an even number of coefficients and alpha > 0, got {why}")
    angle = 0.5 * size * (alpha * mean - gamma)
    if abs(math.cos(angle)) < 1e-9:
        raise ValueError(
            "gamma must not make the system singular: m (mean - gamma) must differ from pi/2 modulo pi, "
            f"got {angle:g} with m = {size // 2}"
        )
    return -0.5 * alpha * math.tan(angle)


def _factor(collocation: Array, hermite: bool, roughness: Array | None, lead: int) -> tuple[Array, Array | None]:
    """Lower triangle T and matrix B such that coefficients = B T^-1 data.

    The order of the first `lead` constraints is preserved where they are triangular.
    """
    count, size = collocation.shape
    if hermite:  # additional functions vanish at every constraint
        triangle, basis = collocation[:, :count], np.eye(size)
    else:
        lead = lead if not np.triu(collocation[:lead], 1).any() else 0
        rest = collocation[lead:, lead:]
        # Columns and rows are scaled, so that basis functions and units of the entries do not matter.
        size_of = np.abs(rest).max(axis=0)
        weight = 1.0 / np.where(size_of > 0.0, size_of, 1.0)
        scaled = rest * weight
        lengths = np.linalg.norm(scaled, axis=1, keepdims=True)
        singular = np.linalg.svd(scaled / np.where(lengths > 0.0, lengths, 1.0), compute_uv=False)
        if not singular[-1] > 1e-13 * singular[0]:
            raise ValueError(
                "free entries must not make the system singular: the prescribed entries conflict or leave "
                f"the plan undetermined, got a relative singular value of {singular[-1] / (singular[0] or 1.0):.1g}"
            )
        mixed, upper = np.linalg.qr(scaled.T, mode="complete")
        basis = np.eye(size)
        basis[lead:, lead:] = mixed * weight[:, None]
        triangle = collocation[:, :count].copy()
        triangle[lead:, lead:] = upper[: count - lead].T
    spread = basis[:, :count]
    if roughness is not None:
        cost = roughness @ basis
        free, _, rank, _ = np.linalg.lstsq(cost[:, count:], -cost[:, :count], rcond=None)
        if rank < size - count:
            raise ValueError(
                "the constraints must determine every function of zero cost; prescribe more entries or lower "
                f"smooth, got {count} constraints for {size} coefficients"
            )
        spread = spread + basis[:, count:] @ free
    return np.asfortranarray(triangle), spread


@lru_cache(maxsize=256)
def _pair_kernel(alpha: float, order: int) -> Array:
    """Multiplication of a Taylor jet by the factors of a pair: shape (2, 3, (order + 1)^2), of q c and of q q.

    From sin a cos b and sin a sin b, cos(a + b) and sin(a + b), with the angles a and b
    of both factors; from a and a b, 1 and a + b of a polynomial.
    """
    alpha = effective(alpha)
    one, s, v = _kernel(alpha, order).reshape(3, -1)
    half = 0.5 * alpha or 1.0
    single = [one / half, s, -half * v if alpha else 0.0 * v]
    return readonly(np.array([single, [one / half**2, v, s / half]]))


@lru_cache(maxsize=256)
def _kernel(alpha: float, order: int) -> Array:
    """Multiplication of a Taylor jet by 1, S(h) and V(h): shape (3 (order + 1), order + 1)."""
    n = order + 1
    weights = np.array([0.0, *kernel_weights(alpha, order)])
    s, v = weights.copy(), weights
    s[::2] = v[1::2] = 0.0
    lag = np.subtract.outer(np.arange(n), np.arange(n))
    kernel = np.zeros((3, n, n))
    kernel[0] = np.eye(n)
    kernel[1], kernel[2] = np.where(lag >= 0, s[lag], 0.0), np.where(lag >= 0, v[lag], 0.0)
    return readonly(kernel.reshape(3 * n, n))
