r"""Plans as polynomials in cells of their segments, with a bound of the error.

In a cell of radius r about an anchor the plan is replaced by its Taylor
polynomial of degree n. By Taylor's theorem derivative k of the remainder is at most

.. math:: \max|y^{(n + 1)}|\,\frac{r^{n + 1 - k}}{(n + 1 - k)!},

with the maximum over the segment; it is 0 where the segment is a polynomial of
degree n. Evaluated by Horner's rule in floating point, derivative k adds at most

.. math:: (5 n + 2 k + 6)\,u \sum_{i \ge k} \frac{i!}{(i - k)!}\,\frac{|c_i|}{r^k},

with the coefficients c_i of the powers of the local time divided by r and the
unit roundoff u: 2 n for Horner's rule (Higham, Accuracy and Stability of
Numerical Algorithms, 5.1), 3 n for the local time, the rest for coefficients and
powers of r. The rounding of the plan's own values is not included. Cells are
halved until both are near u times the peak of derivative k.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctrlplan.trajectories.common import FACTORIALS, Array
from ctrlplan.trajectories.extrema import stationary_times
from ctrlplan.trajectories.trajectory import Trajectory

DEGREE = 15
"""Maximum degree of the polynomials."""

HIGHEST = 8
"""Highest derivative for which their error is bounded."""

_CELLS = 4096  # of one segment
_UNIT = 0.5 * float(np.finfo(float).eps)
_GROWTH = 4.0  # magnitude of terms that may cancel, relative to the peak of the derivative


@dataclass(frozen=True)
class Cells:
    """Polynomials of one segment of a plan, by cells.

    Attributes
    ----------
    start : float
        Start of the segment [s].
    edges : ndarray, shape (ncells + 1,)
        Ends of the cells, from the start of the segment [s].
    anchors : ndarray, shape (ncells,)
        Local origin of each cell, from the start of the segment [s].
    radius : float
        Maximum distance from the anchor [s].
    coefficients : ndarray, shape (ncells, naxes, degree + 1)
        Coefficients of the powers of (local time / radius), the lowest first.
    error : ndarray, shape (derivatives + 1, naxes)
        Bound of the error of each derivative, given exact derivatives at the anchors.
    """

    start: float
    edges: Array
    anchors: Array
    radius: float
    coefficients: Array
    error: Array


def segment_peak(plan: Trajectory, segment: int, order: int) -> Array:
    """Peak magnitude (naxes,) of a derivative within a segment."""

    def jet(s: Array, highest: int) -> Array:
        return plan.segment_jet(segment, s, highest)

    times = stationary_times(jet, float(np.diff(plan.breakpoints)[segment]), order)
    return np.abs(jet(times, order)[order]).max(axis=1)


def cells_of(plan: Trajectory, derivatives: int, *, centred: bool) -> list[Cells]:
    """Polynomials for each segment.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    derivatives : int
        Highest derivative with an error bound.
    centred : bool
        Whether cells have their anchor at the centre, or at their start.

    Raises
    ------
    ValueError
        If more than `HIGHEST` derivatives are needed, or they leave floating point.
    """
    if derivatives > HIGHEST:
        raise ValueError(f"derivatives of a plan in polynomials must be at most {HIGHEST}, got {derivatives}")
    peaks = np.stack([plan.peak(k) for k in range(derivatives + 1)])
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = [_cells(plan, segment, peaks, centred) for segment in range(plan.breakpoints.size - 1)]
    for cells in found:
        if not (np.isfinite(cells.coefficients).all() and np.isfinite(cells.error).all()):
            raise ValueError(
                f"derivatives up to {DEGREE + 1} must stay within floating point, got a segment of "
                f"{cells.edges[-1]:g} s; choose a time unit nearer to the plan's"
            )
    return found


def taylor(plan: Trajectory, segment: int, anchors: Array, radius: float, degree: int) -> Array:
    """Coefficients (ncells, naxes, degree + 1) of the powers of (local time / radius)."""
    jets = plan.segment_jet(segment, anchors, degree)
    return jets.transpose(2, 1, 0) * (radius ** np.arange(degree + 1) / FACTORIALS[: degree + 1])


def _cells(plan: Trajectory, segment: int, peaks: Array, centred: bool) -> Cells:
    start, end = plan.breakpoints[segment : segment + 2].tolist()
    highest = segment_peak(plan, segment, DEGREE + 1)
    degree = DEGREE
    if not highest.any():  # a polynomial: its highest derivative is a constant
        used = plan.segment_jet(segment, np.zeros(1), DEGREE).any(axis=(1, 2))
        degree = max(np.flatnonzero(used).tolist(), default=0)
    k = np.arange(len(peaks))
    count = 1
    while True:
        # Times are rounded as in the use of the cells.
        edges = start + (end - start) * (np.arange(count + 1) / count) - start
        edges[-1] = end - start
        anchors = 0.5 * (edges[:-1] + edges[1:]) if centred else edges[:-1]
        radius = float(np.maximum(edges[1:] - anchors, anchors - edges[:-1]).max())
        coefficients = taylor(plan, segment, anchors, radius, degree)
        left = highest * (radius ** (DEGREE + 1 - k) / FACTORIALS[DEGREE + 1 - k])[:, None]
        terms = _terms(np.abs(coefficients), len(peaks)) / radius ** k[:, None]
        fine = (left <= _UNIT * peaks).all() and (terms <= _GROWTH * peaks).all()
        shortest = np.diff(edges).min()
        if fine or count >= _CELLS or shortest <= 16.0 * np.spacing(max(abs(start), abs(end))):
            rounding = (5 * degree + 2 * k[:, None] + 6) * _UNIT
            return Cells(start, edges, anchors, radius, coefficients, left + rounding * terms)
        count *= 2


def _terms(sizes: Array, count: int) -> Array:
    """Maximum sums (count, naxes) of the terms of each derivative."""
    rows = []
    for k in range(count):
        i = np.arange(sizes.shape[2])
        factors = np.where(i >= k, FACTORIALS[i] / FACTORIALS[np.maximum(i - k, 0)], 0.0)
        rows.append((sizes @ factors).max(axis=0))
    return np.array(rows)
