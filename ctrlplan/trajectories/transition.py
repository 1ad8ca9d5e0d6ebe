"""Transitions between jets over a fixed horizon, for on-line replanning."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_count, checked_finite, real_array
from ctrlplan._display import Displayed, Facts, Part, number
from ctrlplan._types import Value
from ctrlplan.trajectories.chosen import checked_alpha
from ctrlplan.trajectories.common import FACTORIALS, Array, derivative_scale, readonly
from ctrlplan.trajectories.fields import Fields
from ctrlplan.trajectories.newton import NEARLY_CLOSED, NewtonSystem
from ctrlplan.trajectories.one_time import newton_series, pair_series
from ctrlplan.trajectories.piecewise_extrema import bernstein

_AMPLIFIED = 1e4
"""Amplification of rounding errors above which the coefficients are found by a triangular solution."""

_DECADES = 290.0
"""Maximum magnitude of the powers of a horizon, as a decimal logarithm."""


class Transition(Displayed, Fields):
    r"""Splines between two jets over a fixed horizon.

    The linear system of the coefficients is factorised once. Continuous
    replanning towards 0 with a constant horizon is the linear feedback law

    .. math:: y^{(b+1)} = -\sum_{j=0}^{b} k_j\,y^{(j)}, \qquad
        k_b = (b + 1)^2\,\tfrac{\alpha}{2}\cot\tfrac{\alpha}{2}\,/\,H

    with the gains of `gains`; periodic replanning has the spectral radius of
    `radius`.

    Parameters
    ----------
    order : int
        Highest derivative b that is prescribed at both ends.
    horizon : float
        Duration H [s], above 0.
    alpha : float, optional
        Shape parameter in [0, 2 pi) [rad]; 0 is the polynomial of degree 2b + 1.

    Attributes
    ----------
    order, horizon, alpha
        The arguments.
    rate : float
        Angular frequency alpha/H [rad/s].

    Raises
    ------
    ValueError
        If an argument is out of range.

    Examples
    --------
    The feedback gains of minimum-jerk replanning with a horizon of 1 s:

    >>> Transition(2, 1.0).gains().round(9).tolist()
    [60.0, 36.0, 9.0]
    """

    order: int
    horizon: float
    alpha: float
    rate: float
    _family: _Family
    _matrix: Array | None  # as `transition_matrix`

    def __init__(self, order: int, horizon: float, alpha: float = 0.0) -> None:
        order = checked_count(order, "order")
        horizon = checked_finite(horizon, "horizon", above=0.0)
        alpha = checked_alpha(alpha)
        self._set_fields(
            order=order,
            horizon=horizon,
            alpha=alpha,
            rate=alpha / horizon,
            _family=_family(order, alpha),
            _matrix=transition_matrix(order, horizon, alpha),
        )

    def _describe(self) -> Iterator[Part]:
        degree = 2 * self.order + 1
        kind = f"trigonometric, alpha = {self.alpha:.6g} rad" if self.alpha else f"polynomial of degree {degree}"
        yield f"Transition of order {self.order} over {self.horizon:.6g} s"
        gains = [f"k_{j} = {number(k)}" for j, k in enumerate(self.gains().tolist())]
        yield Facts(
            [
                ("spline", kind),
                ("derivatives joined", f"0 to {self.order}"),
                ("horizon", f"{self.horizon:.6g} s"),
                ("gains of continuous replanning", ", ".join(gains)),
            ]
        )

    def coefficients(self, jets: Array) -> Array:
        """Coefficients of the Newton form, for `jet` and `series`.

        Parameters
        ----------
        jets : ndarray, shape (2 (order + 1), naxes)
            Derivatives 0 to `order` at the start, then those at the end.

        Returns
        -------
        ndarray, shape (2 (order + 1), naxes)
        """
        return self.coefficients_of_row(jets.ravel().tolist())

    def coefficients_of_row(self, jets: Sequence[float]) -> Array:
        """Coefficients of jets in one sequence, as `coefficients`.

        Parameters
        ----------
        jets : sequence of float, length 2 (order + 1) naxes
            All axes of one derivative after another, at the start, then at the end.
        """
        naxes = len(jets) // (2 * self.order + 2)
        if self._matrix is None:
            return self._carefully(np.array(jets).reshape(-1, naxes)[self._family.rows])
        return coefficients_by(self._matrix, jets, naxes)

    def _carefully(self, data: Array) -> Array:
        """Coefficients with a check of their accuracy, from jets in the order of the system."""
        system = self._family.system
        scale = self.horizon**system.order_index / FACTORIALS[system.order_index]
        return system.fitted(data, (0.0, self.horizon), self.horizon, data * scale[:, None]) * self._time_scale

    @property
    def _time_scale(self) -> Array:
        """Inverse powers of the horizon, shape (2 (order + 1), 1)."""
        return np.asarray((1.0 / self.horizon ** np.arange(2.0 * self.order + 2.0))[:, None])

    def jet(self, coefficients: Array, s: Array, order: int) -> Array:
        """Jet (order + 1, naxes, ntime) at times s [s] after the start."""
        taylor = self._family.system.taylor(np.asarray(s, dtype=float) / self.horizon, order)
        values = np.einsum("mkt,ma->kat", taylor, coefficients / self._time_scale)
        return values * derivative_scale(self.horizon, order)[:, None, None]

    def enclosure(self, nu: int) -> Array | None:
        """Matrix from coefficients to bounds of the nu-th derivative.

        Of shape (nvalues, 2 (order + 1)): Bernstein coefficients on parts of the
        horizon. None if `alpha` is not 0.
        """
        if self.alpha:
            return None
        matrix = bernstein(self._family.system, nu)
        return np.asarray(matrix.reshape(-1, matrix.shape[-1]) * (self.horizon**-nu / self._time_scale[:, 0]))

    def evaluation(self, s: float, order: int) -> Array:
        """Matrix from coefficients to derivatives at one time s [s].

        Of shape (order + 1, 2 (self.order + 1)).
        """
        rows = series(self.rate, np.eye(2 * self.order + 2).tolist(), s, s - self.horizon, order)
        return np.array(rows).T * FACTORIALS[: order + 1, None]

    def gains(self) -> Array:
        """Gains k_j [1/s^(b + 1 - j)] of continuous replanning, j = 0..b."""
        return -self._from_units_to_zero(0.0, self.order + 1)[-1]

    def radius(self, period: float) -> float:
        """Spectral radius of replanning every `period` [s]."""
        found = self._from_units_to_zero(checked_finite(period, "period", above=0.0), self.order)
        return float(np.abs(np.linalg.eigvals(found)).max())

    def _from_units_to_zero(self, s: float, order: int) -> Array:
        """Derivatives (order + 1, self.order + 1) after s seconds of plans from unit derivatives to 0."""
        first = np.eye(self.order + 1)
        return self.evaluation(s, order) @ self.coefficients(np.concatenate([first, np.zeros_like(first)]))


class _Family(NamedTuple):
    """Data of the transitions of one order and alpha, independent of the horizon."""

    system: NewtonSystem
    rows: NDArray[np.intp]  # of the jets at both ends, in the order of the system
    matrix: Array | None  # from jets to coefficients over a horizon of 1; None if that loses digits
    exponents: Array  # of the horizon in the entries of the matrix


@lru_cache(maxsize=4096)
def _family(order: int, alpha: float) -> _Family:
    """Factorised collocation in normalised time, independent of the horizon for polynomials."""
    given = tuple(range(order + 1))
    system = NewtonSystem(alpha, np.array([0.0, 1.0]), (given, given))
    rows = system.waypoint_index * (order + 1) + system.order_index
    matrix, orders = None, np.arange(2 * order + 2) % (order + 1)
    if system.amplification < _AMPLIFIED and alpha < NEARLY_CLOSED:
        matrix = system.coefficients(np.eye(len(rows)))[:, np.argsort(rows)].copy()
        # A position at both ends is that of a constant.
        matrix[:, 0] = np.eye(len(rows))[0]
        matrix /= FACTORIALS[orders]
    return _Family(system, rows, matrix, orders - np.arange(2.0 * order + 2.0)[:, None])


@lru_cache(maxsize=4096)
def transition(order: int, horizon: float, alpha: float) -> Transition:
    """Cached transition: with a constant period the same horizons recur."""
    return Transition(order, horizon, alpha)


@lru_cache(maxsize=4096)
def transition_matrix(order: int, horizon: float, alpha: float) -> Array | None:
    """Matrix from jets to coefficients of a transition, for `coefficients_by`; None if it loses digits.

    Of shape (2 (order + 1), 2 (order + 1)). A matrix alone takes less time than a `Transition` where the horizon is new
    in every fit.

    Raises
    ------
    ValueError
        If powers of the horizon exceed the range of floating-point numbers.
    """
    highest = 2.0 * order + 1.0
    if not abs(highest * math.log10(horizon)) < _DECADES:
        raise ValueError(
            f"powers of the horizon must stay within floating point, got {horizon:g} s to the power {highest:g}"
        )
    family = _family(order, alpha)
    return None if family.matrix is None else readonly(family.matrix * horizon**family.exponents)


@lru_cache(maxsize=4096)
def homing_matrix(order: int, horizon: float, alpha: float) -> Array | None:
    """Matrix (2 (order + 1), order + 1) from jets at the start to coefficients of a transition to 0; None as above."""
    matrix = transition_matrix(order, horizon, alpha)
    if matrix is None:
        return None
    found = matrix[:, : order + 1].copy()
    found[:, 0] -= matrix[:, order + 1]  # a position relative to that at the start
    return readonly(found)


def coefficients_by(matrix: Array, jets: Sequence[float], naxes: int) -> Array:
    """Coefficients of a transition with a `transition_matrix`; as `Transition.coefficients_of_row`."""
    # Positions relative to the start, as in `NewtonSystem.coefficients`.
    own, first = list(jets), len(jets) // 2
    for axis in range(naxes):
        own[first + axis] -= own[axis]
    return matrix.dot(np.array(own).reshape(-1, naxes))


def series(rate: float, columns: Sequence[Sequence[Value]], past: Value, ahead: Value, order: int) -> list[list[Value]]:
    """Taylor series of each axis of transitions at one time; all arguments but the rate may be symbols.

    Parameters
    ----------
    rate : float
        Angular frequency [rad/s].
    columns : sequence of sequence
        Coefficients of each axis.
    past, ahead : float
        Time since the start, and since the end [s].
    order : int
        Highest coefficient; coefficient k is the k-th derivative / k!.
    """
    factors = [pair_series(rate, past, ahead, order)] * (len(columns[0]) // 2)
    return [newton_series(factors, column, order) for column in columns]


def extrapolated(jet: ArrayLike, time: float) -> Array:
    """Jet (order + 1, naxes) of the Taylor polynomial after `time` seconds."""
    values = real_array(jet, "jet")
    return np.array([taylor_value(values[k:], time) for k in range(len(values))]) if len(values) > 1 else values


def taylor_value(jet: Value, s: Value) -> Value:
    """Value of a Taylor polynomial after s seconds; derivatives and time may be symbols."""
    total = jet[-1]
    for k in range(len(jet) - 1, 0, -1):
        total = jet[k - 1] + total * s / k
    return total
