"""Minimum duration for linear inequalities of the squared rate, by a primal-dual interior-point method."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dpbtrf, dpbtrs

from ctrlplan.planning.path_law.grid import Spline
from ctrlplan.trajectories.common import Array

UNBOUNDED = (
    "limits must bound the speed along the whole path, got a part of it where they do not and the plan does not come "
    "to rest, or limits of accelerations and jerks far below those of the velocities; lower those of the velocities"
)

_GAP = 1e-3
"""Duality gap relative to the duration."""

_ROUNDS = 60

_FAR = 1e6
"""Largest ratio of a coefficient to that of the start without a trust region."""

_NEAREST = 0.02
"""Minimum of the slacks at the start, relative to the limits."""

_MISSED = 1e-6
"""Distance from inequalities, relative to the limits, that is no rounding."""

_ROUNDING = 16.0 * float(np.finfo(float).eps)
"""Rounding of the sum of a row relative to its terms."""

_BEND = 100.0
"""Increase of the price of an excess by one of the size of the limit."""

_STEP = 0.98
"""Step relative to the longest one within the inequalities."""


@dataclass(frozen=True)
class Problem:
    """Minimise sum of weights/sqrt(points @ x) for lower <= rows @ x <= upper and x >= 0.

    Attributes
    ----------
    spline : Spline
        Unknowns of each cell.
    points : ndarray, shape (size, npoints, ncells)
        Squared rates at the points of a quadrature, by the coefficients of a cell.
    weights : ndarray, shape (npoints, ncells)
        Weights of the quadrature [s].
    rows : ndarray, shape (size, nrows, ncells)
        Rows of the inequalities, by the coefficients of a cell.
    upper, lower : ndarray, shape (nrows, ncells), (ntwo, ncells)
        Limits; lower ones of the first rows.
    trust : float, optional
        Largest ratio of a coefficient to that of the start, and of its reciprocal.
    accuracy : float, optional
        Distance from the inequalities, relative to the limits, up to which they hold.
    price : float, optional
        Of the sum of the excesses over the limits of all rows [s]; inf, the default, where
        they hold.
    """

    spline: Spline
    points: Array
    weights: Array
    rows: Array
    upper: Array
    lower: Array
    trust: float = math.inf
    accuracy: float = 1e-9
    price: float = math.inf

    def duration(self, x: Array) -> float:
        """Duration [s] with given coefficients."""
        return float((self.weights / np.sqrt(_applied(self.points, x[self.spline.index]))).sum())

    def excess(self, x: Array) -> Array:
        """Maximum violation of the limits in each cell (ncells,), below 0 inside of them."""
        values = _applied(self.rows, x[self.spline.index])
        beyond = np.concatenate([values - self.upper, self.lower - values[: len(self.lower)]])
        largest: Array = beyond.max(axis=0)
        return largest

    def near_limits(self, x: Array, share: float) -> Problem:
        """Problem without the rows below a share of their limits with given coefficients, with as many in each cell."""
        values, two = _applied(self.rows, x[self.spline.index]), len(self.lower)
        beyond = values - share * self.upper
        beyond[:two] = np.maximum(beyond[:two], share * self.lower - values[:two])
        counts = [int((own > 0.0).sum(axis=0).max(initial=0)) for own in (beyond[:two], beyond[two:])]
        both, single = (
            np.argsort(-own, axis=0)[:count] for own, count in zip((beyond[:two], beyond[two:]), counts, strict=True)
        )
        index = np.concatenate([both, single + two])
        rows = np.take_along_axis(self.rows, index[None], axis=1)
        upper, lower = np.take_along_axis(self.upper, index, axis=0), np.take_along_axis(self.lower, both, axis=0)
        return replace(self, rows=rows, upper=upper, lower=lower)

    def feasible_scale(self, x: Array) -> float:
        """Largest factor of coefficients for which the inequalities hold."""
        values = _applied(self.rows, x[self.spline.index])
        pairs = ((values, self.upper, self.upper > 0.0), (values[: len(self.lower)], self.lower, self.lower < 0.0))
        shares = [float((own[chosen] / side[chosen]).max(initial=0.0)) for own, side, chosen in pairs]
        return 1.0 / max(shares)


def minimum(problem: Problem, start: Array) -> Array:
    """Coefficients of minimum duration.

    By Mehrotra's predictor-corrector method; the matrices of its equations are
    banded.

    Parameters
    ----------
    problem : Problem
        Objective and inequalities.
    start : ndarray, shape (size,)
        Coefficients, positive where not prescribed, that satisfy all inequalities or
        nearly so.

    Raises
    ------
    ValueError
        If no coefficients that satisfy the inequalities are found.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # without a solution multipliers may overflow
        search = _Search if math.isinf(problem.price) else _SoftSearch
        return search(problem, start).minimum()


class _Search:
    """Iteration of coefficients x relative to the start, slacks w of all inequalities, and multipliers y."""

    def __init__(self, problem: Problem, start: Array) -> None:
        spline = problem.spline
        self._index, self._size, self._bandwidth = spline.index.T.copy(), spline.size, spline.bandwidth
        self._fixed, self._scale = spline.fixed, np.where(spline.fixed, 1.0, start)
        self._floor, self._ceiling = 1.0 / problem.trust, min(problem.trust, _FAR)
        self._accuracy = problem.accuracy
        self._start = np.where(spline.fixed, start, 1.0)
        # By cells, for which products of matrices are fast.
        both = np.concatenate([problem.points, problem.rows], axis=1).transpose(2, 0, 1)
        self._both = np.multiply(both, self._scale[self._index][:, :, None], order="C")
        self._points, self._rows = np.split(self._both, [problem.points.shape[1]], axis=2)
        self._weights, self._upper, self._lower = (
            np.ascontiguousarray(own.T) for own in (problem.weights, problem.upper, problem.lower)
        )
        self._two = self._lower.shape[1]
        size = self._index.shape[1]
        first, second = self._pairs = np.triu_indices(size)
        ends = np.sort(np.stack([self._index[:, first], self._index[:, second]]), axis=0)
        self._place = (ends[1] - ends[0]) * self._size + ends[0]  # in the lower bands
        self._free = np.where(spline.fixed, 0.0, 1.0)
        self._active: Array = np.concatenate([np.ones(self._upper.size + self._lower.size), self._free, self._free])

    def minimum(self) -> Array:
        """Coefficients at the optimum."""
        x, w, y = self._begun()
        free, active = self._free, self._active
        step = np.ones(x.size)
        for _ in range(_ROUNDS):
            gradient, curvature = self._objective(x)
            missed = self._slacks(x) - w
            gap, tolerance = float(y @ w), _GAP * self._duration(x)
            # Without a duality gap the duration decreases at most by the residual times the remaining step.
            residual = free * step * (gradient - self._pulled(y))
            if gap < tolerance and np.abs(residual).sum() < tolerance and self._is_feasible(x, missed):
                return self._scale * x[: self._size]
            try:
                solve = self._solver(curvature, y / w)
            except LinAlgError:
                if self._fixed.any() and missed.min() < -_MISSED:  # with free ends slow laws are feasible
                    self._raise_infeasible()
                raise ValueError(UNBOUNDED) from None  # rates without bound, or equations without digits
            dx = solve(-gradient - self._pulled(y * missed / w))
            dw = self._changes(dx) + missed
            dy = -y - y * dw / w
            reached = float((w + _longest(w, dw) * dw) @ (y + _longest(y, dy) * dy))
            target = active * (gap / active.sum() * (reached / gap) ** 3 - dw * dy)
            dx = solve(self._pulled((target - y * missed) / w) - gradient)
            dw = self._changes(dx) + missed
            dy = (target - y * dw) / w - y
            primal, dual = (min(1.0, _STEP * _longest(own, change, 2.0)) for own, change in ((w, dw), (y, dy)))
            step = np.abs(dx)
            x, w, y = x + primal * dx, w + primal * dw, y + dual * dy
        if not self._is_feasible(x, missed):
            self._raise_infeasible()
        return self._scale * x[: self._size]

    def _begun(self) -> tuple[Array, Array, Array]:
        """Coefficients, slacks and multipliers at the start."""
        w = np.maximum(self._slacks(self._start), _NEAREST * self._sizes())
        # At the optimum the sum of the multipliers of normalised limits is half the duration.
        y = self._active * 0.5 * self._duration(self._start) / (self._active / w).sum() / w
        return self._start, w, y

    def _is_feasible(self, x: Array, missed: Array) -> bool:
        """Whether all limits hold, up to the accuracy and rounding of the rows, whose terms may be far above them."""
        if missed.min() > -self._accuracy:
            return True
        terms = _by_cells(np.abs(self._rows), np.abs(x)[self._index])
        rounding = np.zeros(missed.size)
        rounding[: self._upper.size] = terms.ravel()
        rounding[self._upper.size : self._upper.size + self._lower.size] = terms[:, : self._two].ravel()
        return bool((missed + _ROUNDING * rounding).min() > -self._accuracy)

    def _raise_infeasible(self) -> NoReturn:
        if self._fixed.any():
            raise ValueError(
                "limits must be satisfied with the speeds at the ends of the plan and at corners, but no such time law "
                "is found; lower these speeds, raise the limits, or choose free ends"
            )
        raise ValueError(
            "limits must be satisfied by some time law on the path, got none that does; raise the limits, or use "
            'hold="shape"'
        )

    def _duration(self, x: Array) -> float:
        return float((self._weights / np.sqrt(_by_cells(self._points, x[self._index]))).sum())

    def _objective(self, x: Array) -> tuple[Array, Array]:
        """Gradient of the duration, and second derivatives by the squared rates at the points."""
        b = _by_cells(self._points, x[self._index])
        first = -0.5 * self._weights / (b * np.sqrt(b))
        return self._gathered(self._points, first), -1.5 * first / b

    def _slacks(self, x: Array) -> Array:
        """Distances from all limits; 1 for a prescribed coefficient."""
        values = _by_cells(self._rows, x[self._index])
        below = values[:, : self._two] - self._lower
        ends = (np.where(self._fixed, 1.0, own) for own in (x - self._floor, self._ceiling - x))
        return np.concatenate([(self._upper - values).ravel(), below.ravel(), *ends])

    def _sizes(self) -> Array:
        """Magnitudes of all limits, 1 for those that forbid a sign, in the order of the slacks."""
        sides = (self._upper.ravel(), -self._lower.ravel())
        return np.concatenate([*(np.where(side > 0.0, side, 1.0) for side in sides), np.ones(2 * self._size)])

    def _changes(self, dx: Array) -> Array:
        """Changes of the slacks with coefficients."""
        values = _by_cells(self._rows, dx[self._index])
        return np.concatenate([-values.ravel(), values[:, : self._two].ravel(), dx, -dx])

    def _by_row(self, values: Array, sign: float) -> tuple[Array, Array]:
        """Values of the slacks of both limits of each row, with a sign of the upper one; those of coefficients."""
        count, two = self._upper.size, self._lower.size
        rows = sign * values[:count].reshape(self._upper.shape)
        rows[:, : self._two] += values[count : count + two].reshape(self._lower.shape)
        low, high = values[count + two :].reshape(2, -1)
        return rows, low + sign * high

    def _pulled(self, values: Array) -> Array:
        """Transposed changes of the slacks."""
        rows, own = self._by_row(values, -1.0)
        return self._gathered(self._rows, rows) + own

    def _gathered(self, rows: Array, values: Array) -> Array:
        """Transposed products of rows (ncells, size, nrows) with values (ncells, nrows)."""
        return _summed(self._index, rows @ values[:, :, None], self._size)

    def _solver(self, curvature: Array, stiffness: Array) -> Callable[[Array], Array]:
        """Solution of the equations of a step."""
        of_rows, own = self._by_row(stiffness, 1.0)
        weights = np.concatenate([curvature, of_rows], axis=1)
        first, second = self._pairs
        terms = ((self._both * weights[:, None]) @ self._both.transpose(0, 2, 1))[:, first, second]
        if self._fixed.any():
            fixed = self._fixed[self._index]
            terms[fixed[:, first] | fixed[:, second]] = 0.0
        bands = _summed(self._place, terms, (self._bandwidth + 1) * self._size).reshape(self._bandwidth + 1, self._size)
        bands[0] += np.where(self._fixed, 1.0, own)
        factor, failed = dpbtrf(bands, lower=1)
        if failed:
            raise LinAlgError(f"minor {failed} must be positive")
        free = ~self._fixed
        return lambda right: free * dpbtrs(factor, free * right, lower=1)[0]


class _SoftSearch(_Search):
    """The same with limits of rows that may be exceeded: the excesses are unknowns that follow the coefficients.

    The price p of an excess e is p e (1 + c e/2): without the second term excesses may remain large at a few places.
    """

    def __init__(self, problem: Problem, start: Array) -> None:
        super().__init__(problem, start)
        self._price, self._count = problem.price, self._upper.size + self._lower.size
        ones = np.ones(self._count)
        self._start = np.append(self._start, 0.0 * ones)
        self._free, self._active = np.append(self._free, ones), np.append(self._active, ones)

    def _begun(self) -> tuple[Array, Array, Array]:
        x, w, y = super()._begun()
        slack, products = self._slacks(x)[: self._count], w[0] * y[0]
        # Excesses e for which the slacks, s + e and e, have the same products with their multipliers.
        linear, root = self._price * slack - 2.0 * products, np.hypot(self._price * slack, 2.0 * products)
        with np.errstate(divide="ignore", invalid="ignore"):
            excess = np.where(
                linear > 0.0, 2.0 * products * slack / (linear + root), 0.5 * (root - linear) / self._price
            )
        w[: self._count] = slack + excess
        y[: self._count] = products / w[: self._count]
        x[self._size :] = w[-self._count :] = excess
        y[-self._count :] = products / excess
        return x, w, y

    def _objective(self, x: Array) -> tuple[Array, Array]:
        gradient, curvature = super()._objective(x)
        return np.append(gradient, self._price * (1.0 + _BEND * x[self._size :])), curvature

    def _slacks(self, x: Array) -> Array:
        return self._with_excess(super()._slacks(x[: self._size]), x[self._size :])

    def _changes(self, dx: Array) -> Array:
        return self._with_excess(super()._changes(dx[: self._size]), dx[self._size :])

    def _with_excess(self, slacks: Array, excess: Array) -> Array:
        slacks[: self._count] += excess
        return np.append(slacks, excess)

    def _sizes(self) -> Array:
        return np.append(super()._sizes(), np.ones(self._count))

    def _pulled(self, values: Array) -> Array:
        own = values[: -self._count]
        return np.append(super()._pulled(own), own[: self._count] + values[-self._count :])

    def _solver(self, curvature: Array, stiffness: Array) -> Callable[[Array], Array]:
        of_rows, of_excess = stiffness[: self._count], stiffness[-self._count :] + _BEND * self._price
        total, reduced = of_rows + of_excess, stiffness[: -self._count].copy()
        reduced[: self._count] *= of_excess / total  # the excesses are eliminated
        solve = super()._solver(curvature, reduced)

        def solution(right: Array) -> Array:
            own, others = right[: self._size], right[self._size :]
            pulled = np.zeros(reduced.size)
            pulled[: self._count] = of_rows / total * others
            dx = solve(own - _Search._pulled(self, pulled))
            return np.append(dx, (others - of_rows * _Search._changes(self, dx)[: self._count]) / total)

        return solution


def _applied(rows: Array, x: Array) -> Array:
    """Products (nrows, ncells) of rows (size, nrows, ncells) with coefficients (size, ncells)."""
    found = rows[0] * x[0]
    for row, own in zip(rows[1:], x[1:], strict=True):
        found += row * own
    return found


def _by_cells(rows: Array, x: Array) -> Array:
    """Products (ncells, nrows) of rows (ncells, size, nrows) with coefficients (ncells, size)."""
    return np.asarray((x[:, None] @ rows)[:, 0])


def _summed(index: NDArray[np.intp], values: Array, size: int) -> Array:
    """Sums of values with the same index."""
    return np.bincount(index.ravel(), values.ravel(), size).astype(float, copy=False)


def _longest(values: Array, changes: Array, cap: float = 1.0) -> float:
    """Longest step, up to `cap`, for which values of at least 0 remain so."""
    ratio = float(np.fmax.reduce(-changes / values))
    return min(cap, 1.0 / ratio) if ratio > 0.0 else cap
