"""Extrema of a derivative over many segments, all together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ctrlplan.trajectories.chebyshev import points, transform
from ctrlplan.trajectories.common import Array, readonly

_DEGREE = 16
"""Degree of the interpolant on a piece of a segment."""

_HALVINGS, _ANYWHERE, _AT_KINKS = 40, 8, 64
"""Maximum number of times by which a segment is halved until interpolants resolve a derivative: about kinks, and
anywhere, that is in more than so many pieces."""

_FEW = 16
"""Number of pieces up to which these are divided in eight: the time of an evaluation hardly depends on their number."""

_QUARTERINGS = 26
"""Maximum number of times by which a piece is divided in four: to the resolution of its length."""

_RESOLVED = 1e-11
"""Error of an interpolant relative to the maximum of the derivative."""

_ROUNDING = 64.0 * float(np.finfo(float).eps)


class Segmented(Protocol):
    """Functions of time that are analytic between breakpoints; as `Trajectory`."""

    @property
    def breakpoints(self) -> Array:
        """Times [s]."""

    @property
    def naxes(self) -> int:
        """Number of functions."""

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives (order + 1, naxes, ntime), each time in its own segment."""


@dataclass(frozen=True)
class _Pieces:
    """Interpolants of a derivative.

    Attributes
    ----------
    series : ndarray, shape (naxes, npieces, size)
        Chebyshev coefficients.
    slack : ndarray, shape (naxes, npieces)
        Bound of the error of the interpolants, and of rounding.
    segment : ndarray of int, shape (npieces,)
        Segment of each piece.
    first, width : ndarray, shape (npieces,)
        Beginning and length, relative to the segment.
    """

    series: Array
    slack: Array
    segment: NDArray[np.intp]
    first: Array
    width: Array


def inner_extrema(plan: Segmented, nu: int, low: Array, high: Array) -> tuple[NDArray[np.intp], Array]:
    """Segments, and times [s] since their starts, of extrema of a derivative beyond given values.

    The sum of the magnitudes of its coefficients bounds an interpolant. Pieces
    are divided until no bound exceeds the extrema found so far, up to rounding.

    Parameters
    ----------
    plan : Segmented
        Plan whose segments are evaluated together.
    nu : int
        Order of the derivative.
    low, high : ndarray, shape (naxes,)
        Minimum and maximum at the ends of the segments.
    """
    pieces = _interpolated(plan, nu, np.maximum(np.abs(low), np.abs(high)))
    series, slack = (np.concatenate([rows, sign * rows]) for rows, sign in ((pieces.series, -1.0), (pieces.slack, 1.0)))
    chosen, parts = _highest(series, np.concatenate([high, -low]), slack)
    chosen, parts = chosen[chosen >= 0], parts[chosen >= 0]
    segments = pieces.segment[chosen]
    return segments, (pieces.first[chosen] + pieces.width[chosen] * parts) * np.diff(plan.breakpoints)[segments]


def segment_bounds(plan: Segmented, nu: int, size: Array) -> Array:
    """Bounds (naxes, nsegments) of the magnitude of a derivative on each segment.

    The sum of the magnitudes of the coefficients of interpolants, which is usually
    little above the maximum.

    Parameters
    ----------
    plan : Segmented
        Plan whose segments are evaluated together.
    nu : int
        Order of the derivative.
    size : ndarray, shape (naxes,)
        Magnitudes relative to which rounding is judged.
    """
    pieces = _interpolated(plan, nu, size)
    found = np.zeros((plan.breakpoints.size - 1, plan.naxes))
    np.maximum.at(found, pieces.segment, (np.abs(pieces.series).sum(axis=2) + pieces.slack).T)
    return found.T


def _interpolated(plan: Segmented, nu: int, size: Array) -> _Pieces:
    """Interpolants of a derivative, whose magnitude is at least `size` (naxes,)."""
    durations = np.diff(plan.breakpoints)
    segment, first, width = np.arange(durations.size), np.zeros(durations.size), 1.0
    found: list[_Pieces] = []
    halvings = 0
    while segment.size:
        times = (first[:, None] + width * points(_DEGREE, 0.0, 1.0)) * durations[segment, None]
        jets = plan.segments_jet(np.repeat(segment, times.shape[1]), times.ravel(), nu)
        values = jets[nu].reshape(plan.naxes, *times.shape)
        size = np.maximum(size, np.abs(values).max(axis=(1, 2)))
        series = transform(values)
        missed = np.abs(series[..., -3:]).max(axis=2)
        ready = (missed <= _RESOLVED * size[:, None]).all(axis=0)
        left = ready.size - np.count_nonzero(ready)
        if halvings >= _HALVINGS or (halvings >= _ANYWHERE and left > _AT_KINKS):
            ready[:] = True
        slack = missed[:, ready] + _ROUNDING * size[:, None]
        own = np.full(np.count_nonzero(ready), width)
        found.append(_Pieces(series[:, ready], slack, segment[ready], first[ready], own))
        times_halved = 3 if left <= _FEW else 1
        halvings, width, parts = halvings + times_halved, width / 2**times_halved, 2**times_halved
        segment = np.repeat(segment[~ready], parts)
        first = (first[~ready, None] + width * np.arange(parts)).ravel()
    return _Pieces(
        np.concatenate([own.series for own in found], axis=1),
        np.concatenate([own.slack for own in found], axis=1),
        *(np.concatenate([getattr(own, name) for own in found]) for name in ("segment", "first", "width")),
    )


def _highest(series: Array, best: Array, slack: Array) -> tuple[NDArray[np.intp], Array]:
    """Piece and place in it, from 0 to 1, of the maximum of each function.

    Parameters
    ----------
    series : ndarray, shape (nfunctions, npieces, size)
        Chebyshev coefficients on each piece.
    best : ndarray, shape (nfunctions,)
        Values that are attained elsewhere; where none is above, the piece is -1.
    slack : ndarray, shape (nfunctions, npieces)
        Excess over these that does not matter.
    """
    best, found, places = best.copy(), np.full(best.size, -1), np.zeros(best.size)
    row, piece = (index.ravel() for index in np.indices(series.shape[:2]))
    own, first, width = series.reshape(row.size, -1), np.zeros(row.size), 1.0
    for _ in range(_QUARTERINGS):
        near = own[:, 0] + np.abs(own[:, 1:]).sum(axis=1) > best[row] + slack[row, piece]
        if not near.any():
            break
        own, row, piece, first = own[near], row[near], piece[near], first[near]
        values = own @ _AT_QUARTERS
        top = values.argmax(axis=1)
        peak = values[np.arange(top.size), top]
        order = np.argsort(peak, kind="stable")
        highest = np.full(best.size, -1)
        highest[row[order]] = order  # of equal indices the last one counts
        for k in highest[highest >= 0].tolist():
            if peak[k] > best[row[k]]:
                best[row[k]], found[row[k]] = peak[k], piece[k]
                places[row[k]] = first[k] + 0.25 * width * top[k]
        own = (own @ _QUARTERS).reshape(-1, own.shape[1])
        row, piece, width = np.repeat(row, 4), np.repeat(piece, 4), 0.25 * width
        first = (first[:, None] + width * np.arange(4)).ravel()
    return found, places


def _polynomials(x: Array) -> Array:
    """Chebyshev polynomials (degree + 1, npoints)."""
    return np.asarray(chebyshev.chebvander(x, _DEGREE).T, dtype=float)


_AT_QUARTERS = readonly(_polynomials(np.linspace(-1.0, 1.0, 5)))
"""Values at the ends of the quarters of an interval, by the coefficients."""

_QUARTERS = readonly(
    np.concatenate([transform(_polynomials(points(_DEGREE, x, x + 0.5))) for x in (-1.0, -0.5, 0.0, 0.5)], axis=1)
)
"""Coefficients on the quarters of an interval, by those on the interval."""
