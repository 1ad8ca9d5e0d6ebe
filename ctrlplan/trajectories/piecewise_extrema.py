"""Places of the extrema of piecewise polynomials, of all segments in one batch.

The Bernstein coefficients of a derivative on parts of each segment bound it. Only
the segments whose bounds exceed the values at the ends of these parts can contain
an extremum inside; the stationary points of those are computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ctrlplan.trajectories.chebyshev import roots_of_rows
from ctrlplan.trajectories.common import FACTORIALS, Array, bernstein_of_powers, readonly

_LOW = 7
"""Maximum degree of polynomials about their start that are as accurate on the whole segment."""

_PARTS = 4
"""Number of parts of a segment with their own bounds."""

_ROUNDING = 8.0 * float(np.finfo(float).eps)
_TIED = 1e-12  # above the change of a derivative by the rounding of times
_TINY = float(np.finfo(float).tiny)


class Basis(Protocol):
    """Basis of polynomials on the unit interval."""

    def __hash__(self) -> int:
        """Hash, for the cache of matrices."""

    @property
    def size(self) -> int:
        """Number of functions, of which one has the degree ``size - 1``."""

    def taylor(self, u: Array, order: int) -> Array:
        """Taylor coefficients (size, order + 1, ntime) of the functions."""


class Polynomials(NamedTuple):
    """Polynomials of some axes on consecutive segments.

    Attributes
    ----------
    basis : Basis
        Basis by the relative time in a segment.
    first : int
        First segment.
    coefficients : ndarray, shape (size, naxes, nsegments)
        Coefficients in the basis.
    """

    basis: Basis
    first: int
    coefficients: Array

    @property
    def last(self) -> int:
        """The segment after the last."""
        return self.first + int(self.coefficients.shape[2])


@dataclass(frozen=True)
class Powers:
    """Powers of the relative time.

    Attributes
    ----------
    size : int
        Number of powers.
    """

    size: int

    def taylor(self, u: Array, order: int) -> Array:
        """Taylor coefficients; as `Basis.taylor`."""
        found = np.zeros((self.size, order + 1, u.size))
        for power in range(self.size):
            for k in range(min(power, order) + 1):
                found[power, k] = math.comb(power, k) * u ** (power - k)
        return found


Places = tuple[NDArray[np.intp], Array]
"""Numbers of segments, and times [s] since their starts."""


def stationary_places(groups: Iterable[Sequence[Polynomials]], durations: Array, nu: int) -> Places | None:
    """Inner stationary points of the nu-th derivative of polynomials that may be extrema of the plan.

    Parameters
    ----------
    groups : iterable of sequence of Polynomials
        For each group of axes the polynomials of all segments, in runs of the same
        basis.
    durations : ndarray, shape (nsegments,)
        Durations of the segments [s].
    nu : int
        Order of the derivative.

    Returns
    -------
    Places or None
        None if the bounds are beyond floating point.
    """
    segments, times = [np.empty(0, dtype=np.intp)], [np.empty(0)]
    for runs in groups:
        with np.errstate(all="ignore"):
            beyond = _beyond_ends(runs, durations, nu)
        if beyond is None:
            return None
        for run in runs:
            axes, own = beyond[:, run.first : run.last].nonzero()
            if own.size:
                series = _slope_series(run.basis, nu) @ run.coefficients[:, axes, own]
                rows, roots = roots_of_rows(series.T)
                segments.append(run.first + own[rows])
                times.append(0.5 + 0.5 * roots)
    chosen = np.concatenate(segments)
    return chosen, np.concatenate(times) * durations[chosen]


def places_of_low_degree(
    segments_jet: Callable[[NDArray[np.intp], Array, int], Array], durations: Array, degree: int, nu: int
) -> Places | None:
    """The same of polynomials that are known by their jets, as `Trajectory.segments_jet`; None at high degrees."""
    if degree > _LOW or not durations.size:
        return None
    count, orders = durations.size, np.arange(degree + 1)
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        jets = segments_jet(np.arange(count), np.zeros(count), degree)
        powers = durations ** orders[:, None] / FACTORIALS[orders, None]
        own = Polynomials(Powers(degree + 1), 0, jets * powers[:, None])
    return stationary_places([[own]], durations, nu)


def _beyond_ends(runs: Sequence[Polynomials], durations: Array, nu: int) -> NDArray[np.bool_] | None:
    """Whether axes in segments (naxes, nsegments) may have extrema of the plan inside; None if bounds overflow."""
    if durations.size == 1:  # its stationary points cost less than its bounds
        sizes = np.abs(runs[0].coefficients).sum(axis=0) * durations**-nu
        return np.ones(sizes.shape, dtype=bool) if np.isfinite(sizes).all() else None
    bounds = [_bounds(run, durations[run.first : run.last], nu) for run in runs]
    low, high, minimum, maximum = (np.concatenate(rows, axis=1) for rows in zip(*bounds, strict=True))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    size = np.maximum(np.abs(minimum), np.abs(maximum)).max(axis=1, keepdims=True)
    slack = _TIED * np.maximum(size, _TINY)
    # Ties with other segments as well, of which the earliest counts, also of the same shape at other times.
    above = (high > maximum) & (high >= maximum.max(axis=1, keepdims=True) - slack)
    below = (low < minimum) & (low <= minimum.min(axis=1, keepdims=True) + slack)
    return np.asarray(above | below)


@lru_cache(maxsize=128)
def bernstein(basis: Basis, nu: int, parts: int = _PARTS) -> Array:
    """Bernstein coefficients (nparts, degree + 1, size) of a derivative of the basis by relative time."""
    degree = max(basis.size - 1 - nu, 0)
    powers = _powers(basis, np.arange(parts) / parts, nu, 1.0 / parts)
    return readonly(bernstein_of_powers(degree) @ powers)


def _bounds(run: Polynomials, durations: Array, nu: int) -> tuple[Array, Array, Array, Array]:
    """Bounds of a derivative, and its extrema at the ends of the parts, each of shape (naxes, nsegments)."""
    matrix, scale = bernstein(run.basis, nu), durations**-nu
    values = np.tensordot(matrix, run.coefficients, 1) * scale
    rounding = _ROUNDING * scale * np.tensordot(np.abs(matrix), np.abs(run.coefficients), 1).max(axis=(0, 1))
    ends = values[:, [0, -1]]
    return (
        values.min(axis=(0, 1)) - rounding,
        values.max(axis=(0, 1)) + rounding,
        ends.min(axis=(0, 1)),
        ends.max(axis=(0, 1)),
    )


@lru_cache(maxsize=128)
def _slope_series(basis: Basis, nu: int) -> Array:
    """Chebyshev coefficients (size', size) on the segment of the next derivative of the basis."""
    powers = _powers(basis, np.array([0.5]), nu + 1, 0.5)[0]
    size = len(powers)
    to_series = np.array([np.resize(np.append(chebyshev.poly2cheb(row), np.zeros(size)), size) for row in np.eye(size)])
    return readonly(np.ascontiguousarray(to_series.T @ powers))


def _powers(basis: Basis, origins: Array, nu: int, unit: float) -> Array:
    """Power coefficients (norigins, degree + 1, size) of a derivative of the basis, by (u - origin)/unit."""
    order = basis.size - 1
    degree = max(order - nu, 0)
    taylor = basis.taylor(origins, max(order, nu))[:, nu:].transpose(2, 1, 0)[:, : degree + 1]
    factors = FACTORIALS[nu : nu + degree + 1] / FACTORIALS[: degree + 1] * unit ** np.arange(degree + 1)
    return np.asarray(taylor * factors[:, None])
