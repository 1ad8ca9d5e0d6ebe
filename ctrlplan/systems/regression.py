"""Least squares with correlated residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import t as student

from ctrlplan._types import Array

_HIGHEST = 0.999
"""Maximum of the estimated correlation of successive residuals."""


@dataclass(frozen=True)
class LeastSquares:
    """Coefficients of a linear model, with their covariance.

    Attributes
    ----------
    coefficients : ndarray, shape (ncolumns,)
        The estimates.
    covariance : ndarray, shape (ncolumns, ncolumns)
        Covariance of the estimates, for residuals that are an autoregressive
        process of first order.
    deviation : float
        Standard deviation of the residuals.
    correlation : float
        Correlation of successive residuals.
    degrees : float
        Effective number of independent residuals, less the number of columns.
    condition : float
        Condition number of the columns, each scaled to norm 1.
    directions : ndarray, shape (ncolumns, ncolumns)
        Right singular vectors of the scaled columns, smallest singular value
        last: the combination that the data determine worst is the last row.
    """

    coefficients: Array
    covariance: Array
    deviation: float
    correlation: float
    degrees: float
    condition: float
    directions: Array

    @property
    def standard_errors(self) -> Array:
        """Standard error of each coefficient."""
        return np.sqrt(np.diag(self.covariance))

    def half_widths(self, level: float = 0.95) -> Array:
        """Half widths of the confidence intervals, by Student's distribution."""
        return self.standard_errors * float(student.ppf(0.5 + 0.5 * level, max(self.degrees, 1.0)))


def least_squares(columns: Array, target: Array, used: NDArray[np.bool_] | None = None) -> LeastSquares:
    r"""Ordinary least squares, with the covariance for residuals of an AR(1) process.

    The correlation :math:`\rho` of successive residuals is estimated from the
    residuals and corrected for its bias, :math:`(1 + 3\rho)/n`. With the
    correlation matrix R, :math:`R_{ij} = \rho^{|i - j|}`, and S = X'RX, the
    covariance is :math:`s^2 (X'X)^{-1} S (X'X)^{-1}`, where
    :math:`s^2 = e'e/(n - \mathrm{tr}((X'X)^{-1} S))`.

    Parameters
    ----------
    columns : ndarray, shape (n, ncolumns)
        Regressors at even sample times.
    target : ndarray, shape (n,)
        Values to be explained.
    used : ndarray of bool, shape (n,), optional
        Samples that count; default: all. Samples between two gaps keep their
        distance in time.
    """
    counts = np.ones(len(target), dtype=bool) if used is None else used
    scale = np.linalg.norm(columns[counts], axis=0)
    scale[scale == 0.0] = 1.0
    x = np.where(counts[:, None], columns / scale, 0.0)
    y = np.where(counts, target, 0.0)
    left, singular, directions = np.linalg.svd(x, full_matrices=False)
    smallest = singular[-1] if singular.size else 0.0
    condition = float(singular[0] / smallest) if smallest > np.finfo(float).eps * singular[0] * len(y) else np.inf
    inverse = np.where(singular > np.finfo(float).eps * singular[0] * len(y), 1.0 / np.maximum(singular, 1e-300), 0.0)
    found = directions.T @ (inverse * (left.T @ y))
    residual = y - x @ found
    n = int(np.count_nonzero(counts))
    rho = _correlation(residual, counts, n)
    spread = directions.T @ (inverse[:, None] ** 2 * directions)  # (X'X)^-1
    correlated = _filtered(x, rho).T @ x  # X'RX
    degrees = max(n - float(np.trace(spread @ correlated)), 1.0)
    variance = float(residual @ residual) / degrees
    return LeastSquares(
        found / scale,
        variance * spread @ correlated @ spread / np.outer(scale, scale),
        float(np.sqrt(variance)),
        rho,
        max(n * (1.0 - rho) / (1.0 + rho) - x.shape[1], 1.0),
        condition,
        directions,
    )


def _correlation(residual: Array, used: NDArray[np.bool_], n: int) -> float:
    """Correlation of successive residuals, corrected for its bias."""
    pairs = used[1:] & used[:-1]
    power = float(residual @ residual)
    if power == 0.0 or not pairs.any():
        return 0.0
    first, second = residual[:-1][pairs], residual[1:][pairs]
    rho = float(first @ second) / (0.5 * float(first @ first + second @ second) or 1.0)
    return float(np.clip(rho + (1.0 + 3.0 * rho) / n, 0.0, _HIGHEST))


def _filtered(x: Array, rho: float) -> Array:
    """Columns times the correlation matrix of an AR(1) process, by filtering forward and backward."""
    ahead = lfilter([1.0], [1.0, -rho], x, axis=0)
    behind = lfilter([1.0], [1.0, -rho], x[::-1], axis=0)[::-1]
    return np.asarray(ahead + behind - x)
