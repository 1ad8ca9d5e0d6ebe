"""Least squares along a chain: equations of each segment in the unknowns of its two ends, in linear time."""

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.common import Array

_SURE = 1e-8
"""Smallest ratio of a diagonal entry to its column with which a solution is surely unique."""

_LARGE = 1e8
"""Largest effect of right sides of the size of the equations with which a solution is surely unique."""


def chain_least_squares(
    equations: Array, right: Array, shared: NDArray[np.bool_], apart: NDArray[np.bool_]
) -> tuple[Array, Array] | None:
    """Unknowns at the points of a chain that minimise the sum of squared residuals of its segments.

    Every second point is eliminated by one orthogonal factorisation of the
    equations of the segments on both of its sides, which leaves equations of
    one longer segment in their place, and so on until one segment is left
    (odd-even reduction). No normal equations, whose condition is squared.

    Parameters
    ----------
    equations : array, shape (nsegments, nrows, 2 nunknowns)
        Coefficients of the unknowns at the first end, then of those at the second.
    right : array, shape (nsegments, nrows, naxes)
    shared, apart : array of bool, shape (nsegments + 1, nunknowns)
        Unknowns that are the same on both sides of a point, and those that
        differ; what is neither is 0.

    Returns
    -------
    tuple of two arrays, shape (nsegments + 1, nunknowns, naxes), or None
        Unknowns to the left and to the right of each point; None where they may
        not be unique.
    """
    nsegments, nrows, columns = equations.shape
    count = columns // 2
    own = np.concatenate([apart[:-1], apart[1:]], axis=1)
    joint = np.concatenate([shared[:-1], shared[1:]], axis=1)
    size = np.linalg.norm(equations, axis=(1, 2), keepdims=True)
    probe = size * np.cos(np.arange(nsegments * nrows)).reshape(nsegments, nrows, 1)
    rows = np.concatenate([equations * own[:, None, :], equations * joint[:, None, :], right, probe], axis=2)
    # Equations in the unknowns of a segment alone come first, the others remain.
    upper = _triangular([rows], ~own)
    rest = upper[:, columns : 2 * columns]
    rest = np.concatenate([rest, np.zeros((nsegments, columns - rest.shape[1], rest.shape[2]))], axis=1)
    lengths = np.linalg.norm(equations, axis=1)
    if not _are_unique(upper, np.where(own, lengths, 1.0)):
        return None
    least = np.zeros(shared.shape)
    least[:-1] = lengths[:, :count]
    least[1:] = np.maximum(least[1:], lengths[:, count:])
    found = _chained(rest[:, :, columns:], ~shared, np.where(shared, least, 1.0))
    if found is None:
        return None
    both = np.concatenate([found[:-1], found[1:]], axis=1)
    alone = _solved(upper, columns, both)
    sides = np.stack([found, found])
    sides[1, :-1] += alone[:, :count]
    sides[0, 1:] += alone[:, count:]
    ends = np.concatenate([sides[1, :-1], sides[0, 1:]], axis=1)
    if not (np.abs(ends[..., -1]) * lengths <= _LARGE * size[..., 0]).all():
        return None
    return sides[0, ..., :-1], sides[1, ..., :-1]


def _chained(rows: Array, fixed: NDArray[np.bool_], lengths: Array) -> Array | None:
    """Unknowns (npoints, nunknowns, naxes) from rows (coefficients of both ends, right side) of each segment.

    The lengths (npoints, nunknowns) are those of the columns before anything was eliminated.
    """
    nsegments, count = len(rows), fixed.shape[1]
    if nsegments == 1:
        upper = _triangular([rows], fixed.reshape(1, -1))
        if not _are_unique(upper, lengths.reshape(1, -1)):
            return None
        return _solved(upper, 2 * count).reshape(2, count, -1)
    pairs, odd = divmod(nsegments, 2)
    first, second = rows[: 2 * pairs : 2], rows[1 : 2 * pairs : 2]
    before, after, right = slice(0, count), slice(count, 2 * count), slice(2 * count, None)
    none = np.zeros((*first.shape[:2], count))
    parts = np.stack(
        [
            np.concatenate([first[..., after], first[..., before], none, first[..., right]], axis=2),
            np.concatenate([second[..., before], none, second[..., after], second[..., right]], axis=2),
        ]
    )
    # Larger rows first: then small ones keep their digits, however much the segments differ.
    size = np.abs(parts[..., : 3 * count]).max(axis=(2, 3))
    parts = np.take_along_axis(parts, np.argsort(-size, axis=0)[:, :, None, None], axis=0)
    upper = _triangular(list(parts), fixed[1 : 2 * pairs : 2])
    if not _are_unique(upper, lengths[1 : 2 * pairs : 2]):
        return None
    kept = np.concatenate([upper[:, count : 3 * count, count:], rows[2 * pairs :]])
    places = [*range(0, 2 * pairs + 1, 2), *[nsegments] * odd]
    known = _chained(kept, fixed[places], lengths[places])
    if known is None:
        return None
    found = np.empty((nsegments + 1, count, known.shape[2]))
    found[places] = known
    found[1 : 2 * pairs : 2] = _solved(upper, count, np.concatenate([known[:pairs], known[1 : pairs + 1]], axis=1))
    return found


def _triangular(parts: list[Array], fixed: NDArray[np.bool_]) -> Array:
    """Triangular factors of stacked equations, with equations of their own for the first unknowns where these are 0."""
    held = np.zeros((*fixed.shape, parts[0].shape[2]))
    unknowns = np.arange(fixed.shape[1])
    held[:, unknowns, unknowns] = fixed
    return np.asarray(np.linalg.qr(np.concatenate([held, *parts], axis=1), mode="r"))


def _are_unique(upper: Array, lengths: Array) -> bool:
    """Whether the first unknowns of triangular equations are unique: no diagonal entry is small, by their columns."""
    diagonal = np.abs(np.diagonal(upper, axis1=1, axis2=2))[:, : lengths.shape[1]]
    return bool((diagonal > _SURE * lengths).all())


def _solved(upper: Array, count: int, others: Array | None = None) -> Array:
    """First unknowns of triangular equations, given those after them."""
    right = upper[:, :count, count:]
    if others is not None:
        right = right[..., others.shape[1] :] - right[..., : others.shape[1]] @ others
    return np.asarray(np.linalg.solve(upper[:, :count, :count], right))
