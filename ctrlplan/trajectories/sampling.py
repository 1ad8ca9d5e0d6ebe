r"""Evaluation of analytic functions at many times from exact jets at few.

A Chebyshev interpolant of each derivative is built from exact jets, once for a
segment. It is evaluated by matrix products, in a basis whose functions are
products of few of them:

.. math:: V_{2^k}(x) = V_{2^{k-1}}(x)^2 - 2, \qquad V_n = 2 T_n(x/2)

and each function is the product of the :math:`V_{2^k}` of the binary digits of its
number, so that one multiplication per function and time is required. By
:math:`V_{m+n} = V_m V_n - V_{m-n}` the coefficients of one basis are sums of few
coefficients of the other.

Very many sorted times are divided into cells. In each cell the Taylor series about
its centre, from the exact jet there, gives the values: by one matrix product for all
cells if the times are evenly spaced, otherwise by one per cell. All are as accurate
as the jets: series are truncated below rounding.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.chebyshev import transform
from ctrlplan.trajectories.common import FACTORIALS, Array, readonly

if TYPE_CHECKING:
    from ctrlplan.trajectories.trajectory import Trajectory

FEW = 256
"""Number of times up to which the jets themselves are evaluated."""

_CELLS = 30_000
"""Number of sorted times from which cells are faster than an interpolant with many terms."""

_SHORT = 14
"""Number of terms of an interpolant that is faster than cells."""

_MAX_TERMS = 24
_PRODUCT = 2**18  # maximum multiplications of a matrix product in one thread
_CHUNK = 4104  # the functions stay in the second cache; no power of two, to avoid conflicts between rows
_SPARSE = 48  # number of times per segment from which a matrix product for each segment is faster
_COMPARED = 18  # number of breakpoints up to which comparisons with each are faster than searches
_BLOCK = 16 * _CHUNK  # number of times that are grouped together
_LARGEST = 2.0**20  # bound of all functions of the bases


@dataclass(frozen=True, eq=False)
class Interpolant:
    """Interpolants of derivatives on one segment.

    Attributes
    ----------
    rows : ndarray, shape (norders * naxes, size)
        Coefficients of the products of Chebyshev polynomials.
    is_finite : bool
        Whether all values on the segment are finite.
    """

    rows: Array
    is_finite: bool

    @classmethod
    def of(cls, coefficients: Array) -> Interpolant:
        """Interpolants from coefficients of products (norders, naxes, size)."""
        rows = coefficients.reshape(-1, coefficients.shape[2])
        return cls(readonly(rows), are_finite(rows))


class Part(NamedTuple):
    """Consecutive times of one segment.

    Attributes
    ----------
    rows : ndarray, shape (norders * naxes, size)
        Interpolants on the segment.
    first, last : int
        First time, and the one after the last.
    start, duration : float
        Of the segment [s].
    """

    rows: Array
    first: int
    last: int
    start: float
    duration: float


def sample(
    jet: Callable[[Array, int], Array],
    interpolant: Interpolant | None,
    duration: float,
    t: Array,
    orders: tuple[int, int],
    out: Array,
) -> bool:
    """Derivatives at many times; whether they are certainly finite.

    Parameters
    ----------
    jet : callable
        Maps times (ntime,) and an order to (order + 1, naxes, ntime).
    interpolant : Interpolant or None
        Of these derivatives; None if they are not resolved.
    duration : float
        Length [s] of the segment, from 0, in which the function is analytic.
    t : ndarray, shape (ntime,)
        Times [s] in that segment.
    orders : (int, int)
        Lowest and highest order of the derivatives.
    out : ndarray, shape (norders, naxes, ntime)
        Place of the result.
    """
    if interpolant is None or t.size > (_CELLS if interpolant.rows.shape[1] > _SHORT else 10 * _CELLS):
        finite = _sample_cells(jet, duration, t, orders, out)
        if finite is not None:
            return finite
    if interpolant is None:
        _sample_chunks(jet, t, orders, out)
        return False
    evaluate([Part(interpolant.rows, 0, t.size, 0.0, duration)], t, out)
    return interpolant.is_finite


def sample_segments(
    times: Array,
    rows_of: Callable[[NDArray[np.intp]], tuple[Array, bool]],
    entries: Array,
    t: Array,
    is_sorted: bool,
    left: bool,
    out: Array,
) -> bool:
    """Derivatives at many times of several segments, by interpolants; whether they are certainly finite.

    Parameters
    ----------
    times : ndarray, shape (nsegments + 1,)
        Breakpoints [s].
    rows_of : callable
        Maps increasing numbers of segments (n,) to the rows (n, norders * naxes, size) of their
        interpolants, and to whether these are certainly finite.
    entries : ndarray, shape (nsegments + 1, k, naxes)
        Lowest derivatives at the breakpoints, as far as they are prescribed there;
        others are nan. At most `norders`.
    t : ndarray, shape (ntime,)
        Times [s], from the first breakpoint to the last.
    is_sorted : bool
        Whether no time is below the one before.
    left : bool
        Whether breakpoints belong to the segment that ends there.
    out : ndarray, shape (norders, naxes, ntime)
        Place of the result.
    """
    finite = True
    for begin in range(0, t.size, _BLOCK):
        part, place = t[begin : begin + _BLOCK], out[:, :, begin : begin + _BLOCK]
        if is_sorted:
            finite &= _sample_sorted_block(times, rows_of, entries, part, left, place)
        else:
            segments = _segments_of_unsorted(times, part, left)
            order = segments.argsort(kind="stable")
            counts = np.bincount(segments)
            used = counts.nonzero()[0]
            found = np.empty(place.shape)
            finite &= _sample_grouped(times, rows_of, entries, part[order], left, used, counts[used], found)
            back = np.empty_like(order)
            back[order] = np.arange(order.size)
            for values, target in zip(found.reshape(-1, part.size), out.reshape(-1, t.size), strict=True):
                values.take(back, out=target[begin : begin + part.size], mode="clip")  # without a copy
    return finite


def _segments_of(times: Array, t: Array, left: bool) -> NDArray[np.intp]:
    """Segment of each time."""
    found = times[1:-1].searchsorted(t, side="left" if left else "right")
    return np.asarray(found)


def _segments_of_unsorted(times: Array, t: Array, left: bool) -> NDArray[np.integer[Any]]:
    """The same, of a type with few bytes, which is sorted fast."""
    if times.size > _COMPARED:
        return _segments_of(times, t, left).astype(np.uint16 if times.size < 2**16 else np.intp)
    found = np.zeros(t.size, dtype=np.uint8)
    for moment in times[1:-1].tolist():
        found += (t > moment if left else t >= moment).view(np.uint8)
    return found


def _sample_sorted_block(
    times: Array,
    rows_of: Callable[[NDArray[np.intp]], tuple[Array, bool]],
    entries: Array,
    t: Array,
    left: bool,
    out: Array,
) -> bool:
    """As `sample_segments`, at sorted times."""
    first, last = _segments_of(times, t[[0, -1]], left).tolist()
    moments = times[first : last + 2]
    low, high = t.searchsorted(moments, side="left"), t.searchsorted(moments, side="right")
    equal = [(i, k) for k, own in enumerate(zip(low.tolist(), high.tolist(), strict=True), first) for i in range(*own)]
    bounds = high if left else low
    bounds[0], bounds[-1] = 0, t.size
    if t.size < _SPARSE * (last + 1 - first):
        counts = bounds[1:] - bounds[:-1]
        used = counts.nonzero()[0]
        return _sample_grouped(times, rows_of, entries, t, left, used + first, counts[used], out)
    rows, finite = rows_of(np.arange(first, last + 1))
    ends, starts = bounds.tolist(), moments.tolist()
    spans = zip(rows, ends, ends[1:], starts, starts[1:], strict=False)
    evaluate(
        [Part(own, begin, end, start, stop - start) for own, begin, end, start, stop in spans if begin < end], t, out
    )
    if equal:
        where, at = np.array(equal).T
        place_entries(entries[at], where, out)
    return finite


def _sample_grouped(
    times: Array,
    rows_of: Callable[[NDArray[np.intp]], tuple[Array, bool]],
    entries: Array,
    t: Array,
    left: bool,
    segments: NDArray[np.intp],
    counts: NDArray[np.intp],
    out: Array,
) -> bool:
    """As `sample_segments`, at times that are grouped by segment."""
    rows, finite = rows_of(segments)
    starts, ends = times[segments], times[segments + 1]
    durations = ends - starts
    if t.size < _SPARSE * segments.size:
        index = np.arange(segments.size).repeat(counts)
        _evaluate_each(rows, index, t - starts[index], durations[index], out)
    else:
        bounds = [0, *counts.cumsum().tolist()]
        evaluate(list(map(Part, rows, bounds, bounds[1:], starts.tolist(), durations.tolist())), t, out)
    where = (t == (ends if left else starts).repeat(counts)).nonzero()[0]
    at = segments.repeat(counts)[where] + left
    if segments[-1] == times.size - 2 and not left:  # the end belongs to the last segment
        more = (t[-counts[-1] :] == ends[-1]).nonzero()[0] + (t.size - counts[-1])
        where, at = np.append(where, more), np.append(at, np.full(more.size, times.size - 1))
    if where.size:
        place_entries(entries[at], where, out)
    return finite


def place_entries(known: Array, where: NDArray[np.intp], out: Array) -> None:
    """Replace the lowest derivatives at some times by those that are known, (ntimes, k, naxes)."""
    rows, place = known.transpose(1, 2, 0), out[: known.shape[1]]
    place[:, :, where] = np.where(np.isnan(rows), place[:, :, where], rows) if np.isnan(known).any() else rows


def are_finite(coefficients: Array) -> bool:
    """Whether coefficients exclude values that are not finite."""
    return math.isfinite(_LARGEST * float(np.add.reduce(np.abs(coefficients), axis=None)))


def in_products(coefficients: Array) -> Array:
    """Coefficients of products from Chebyshev coefficients (..., size)."""
    return np.asarray(coefficients @ _products_of_chebyshev(coefficients.shape[-1]))


@lru_cache(maxsize=64)
def products_of_values(count: int, terms: int) -> Array:
    """Matrix (count, terms) from values at Chebyshev points to the coefficients of the first products."""
    return readonly(in_products(transform(np.eye(count))[:, :terms]))


def evaluate(parts: Sequence[Part], t: Array, out: Array) -> None:
    """Values of interpolants.

    Parameters
    ----------
    parts : sequence of Part
        All times in turn.
    t : ndarray, shape (ntime,)
        Times [s].
    out : ndarray, shape (norders, naxes, ntime)
        Place of the result.
    """
    target = out.reshape(-1, t.size)  # a view
    basis = np.empty((max([2, *[part.rows.shape[1] for part in parts]]), min(_CHUNK, t.size)))
    basis[0] = 1.0
    place = 0
    for begin in range(0, t.size, _CHUNK):
        end = min(begin + _CHUNK, t.size)
        functions = basis[:, : end - begin]
        inside = []
        while place < len(parts) and parts[place].first < end:
            rows, first, last, start, duration = parts[place]
            low, high = max(first, begin), min(last, end)
            _scale(t[low:high], start, 0.25 * duration, functions[1, low - begin : high - begin])
            inside.append((rows, low, high))
            if last > end:
                break
            place += 1
        _fill(functions)
        for rows, first, last in inside:
            step = max(1, _PRODUCT // rows.size)
            for low in range(first, last, step):
                high = min(low + step, last)
                np.matmul(rows, functions[: rows.shape[1], low - begin : high - begin], out=target[:, low:high])


def _evaluate_each(rows: Array, index: NDArray[np.intp], t: Array, duration: Array, out: Array) -> None:
    """As `evaluate`, each time with its own rows, for few times of many segments.

    Parameters
    ----------
    rows : ndarray, shape (nsegments, norders * naxes, size)
        Rows of the interpolants.
    index : ndarray of int, shape (ntime,)
        Place of the rows of each time among them.
    """
    target = out.reshape(-1, t.size)  # a view
    basis = np.empty((max(rows.shape[2], 2), min(_CHUNK, t.size)))
    basis[0] = 1.0
    for begin in range(0, t.size, _CHUNK):
        end = min(begin + _CHUNK, t.size)
        functions = basis[:, : end - begin]
        _scale(t[begin:end], 0.0, 0.25 * duration[begin:end], functions[1])
        _fill(functions)
        used = functions[: rows.shape[2]].T[:, :, None]
        target[:, begin:end] = (rows[index[begin:end]] @ used)[:, :, 0].T


def _scale(t: Array, start: float, quarter: Array | float, out: Array) -> None:
    """Replace by times relative to the middle of their segments, from -2 to 2."""
    if start:
        t = np.subtract(t, start, out)
    np.subtract(t, 2.0 * quarter, out)
    np.divide(out, quarter, out)


def _fill(functions: Array) -> None:
    """Fill the basis (size, ntime) from its first two functions, 1 and the scaled time."""
    top, size = 1, len(functions)
    while 2 * top < size:
        square = functions[2 * top]
        np.multiply(functions[top], functions[top], out=square)
        square -= 2.0
        more = min(2 * top, size - 2 * top)
        np.multiply(functions[1:more], square, out=functions[2 * top + 1 : 2 * top + more])
        top *= 2


@lru_cache(maxsize=256)
def _products_of_chebyshev(size: int) -> Array:
    """Matrix (size, size) from Chebyshev coefficients, as a row, to those of the products."""
    found = np.zeros((size, size))  # V_n as a row, first
    found[0, 0] = 2.0
    top = 1
    while top < size:
        found[top, top] = 1.0
        for k in range(1, min(top, size - top)):
            found[top + k, top : 2 * top] = found[k, : size - top][:top]
            found[top + k] -= found[top - k]
        top *= 2
    return readonly(0.5 * found)


def _sample_cells(
    jet: Callable[[Array, int], Array], duration: float, t: Array, orders: tuple[int, int], out: Array
) -> bool | None:
    """As `sample`, at sorted times by Taylor series in cells; None if times are not sorted, or series too long."""
    low, high = orders
    size = np.abs(jet(np.linspace(0.0, duration, 9), high + _MAX_TERMS + 2)).max(axis=2)
    if _is_uniform(t, duration):
        step = float(t[-1] - t[0]) / (t.size - 1)
        for cell in (2048, 1024, 512, 256, 128, 64):
            terms = _taylor_terms(size, 0.5 * cell * step, low, high)
            if terms is not None:
                return _sample_uniform(jet, float(t[0]), step, cell, terms, low, out)
    elif t[-1] > t[0] and bool(np.all(t[1:] >= t[:-1])):
        for cell in (4096, 2048, 1024, 512, 256):
            ncells = -(-t.size // cell)
            terms = _taylor_terms(size, 0.5 * float(t[-1] - t[0]) / ncells, low, high)
            if terms is not None:
                return _sample_sorted(jet, t, ncells, terms, low, out)
    return None


def sample_in_batches(plan: Trajectory, t: Array, low: int, high: int, left: bool) -> Array:
    """Derivatives low to high (high - low + 1, naxes, ntime) of a trajectory whose segments are evaluated together."""
    times, last = plan.breakpoints, plan.breakpoints.size - 2
    segments = np.searchsorted(times, t, side="left" if left else "right") - 1
    if not left:
        segments[t == times[-1]] = last
    inside = np.flatnonzero((segments >= 0) & (segments <= last))
    found = plan.segments_jet(segments[inside], t[inside] - times[segments[inside]], high)[low:]
    if inside.size == t.size:
        return found
    out = np.zeros((high - low + 1, plan.naxes, t.size))
    out[:, :, inside] = found
    if low == 0:
        out[0] += np.where(segments < 0, plan.initial[:, None], 0.0) + np.where(
            segments > last, plan.final[:, None], 0.0
        )
    return out


def _is_uniform(t: Array, duration: float) -> bool:
    """Whether the times are evenly spaced up to rounding of times within the segment."""
    step = (t[-1] - t[0]) / (t.size - 1)
    slack = 4.0 * np.finfo(float).eps * duration
    if not step > 0.0 or abs(t[1] - t[0] - step) > slack:
        return False
    ramp = step * np.arange(min(t.size, 2 * _CHUNK))
    beyond = np.empty_like(ramp)
    for first in range(0, t.size, ramp.size):
        part = t[first : first + ramp.size]
        excess = np.subtract(part, ramp[: part.size], out=beyond[: part.size])
        base = t[0] + first * step
        if excess.max() - base > slack or base - excess.min() > slack:
            return False
    return True


def _taylor_terms(size: Array, radius: float, low: int, high: int) -> int | None:
    """Number of significant terms of the series, from the magnitudes (order, naxes) of the derivatives."""
    powers = radius ** np.arange(_MAX_TERMS + 3) / FACTORIALS[: _MAX_TERMS + 3]
    tails = np.stack([size[nu : nu + _MAX_TERMS + 3] * powers[:, None] for nu in range(low, high + 1)])
    small = tails <= 0.25 * np.finfo(float).eps * tails.max(axis=1, keepdims=True)
    # Terms larger than the value would cancel and lose digits.
    if np.any(tails.sum(axis=1) > 4.0 * tails[:, 0]):
        return None
    # Two terms in a row, so that an odd or even function does not end its series early.
    done = (small[:, 1:-1] & small[:, 2:]).all(axis=(0, 2))
    return int(done.argmax()) + 1 if done.any() else None


def _sample_uniform(
    jet: Callable[[Array, int], Array], first: float, step: float, cell: int, terms: int, low: int, out: Array
) -> bool:
    norders, naxes, count = out.shape
    ncells = count // cell
    centres = first + step * (0.5 * (cell - 1) + cell * np.arange(ncells + 1, dtype=float))
    jets = jet(centres, low + norders + terms - 2)
    radius = 0.5 * cell * step
    powers = np.linspace(-1.0 + 1.0 / cell, 1.0 - 1.0 / cell, cell) ** np.arange(terms)[:, None]
    scale = radius ** np.arange(terms) / FACTORIALS[:terms]
    main = ncells * cell
    block = max(1, _PRODUCT // (terms * cell))
    finite = True
    for row in range(norders):
        table = np.ascontiguousarray(np.moveaxis(jets[low + row : low + row + terms], 0, -1) * scale)
        finite &= are_finite(table)
        for axis in range(naxes):
            whole = out[row, axis, :main].reshape(ncells, cell)
            for begin in range(0, ncells, block):
                np.matmul(table[axis, begin : min(begin + block, ncells)], powers, out=whole[begin : begin + block])
            if main < count:
                np.matmul(table[axis, ncells], powers[:, : count - main], out=out[row, axis, main:])
    return finite


def _sample_sorted(jet: Callable[[Array, int], Array], t: Array, ncells: int, terms: int, low: int, out: Array) -> bool:
    norders, naxes, _ = out.shape
    edges: Array = np.linspace(t[0], t[-1], ncells + 1)
    centres, radius = 0.5 * (edges[:-1] + edges[1:]), 0.5 * float(t[-1] - t[0]) / ncells
    jets = jet(centres, low + norders + terms - 2)
    scale = radius ** np.arange(terms) / FACTORIALS[:terms]
    table = np.stack([np.moveaxis(jets[nu : nu + terms], 0, -1) for nu in range(low, low + norders)]) * scale
    table = np.moveaxis(table, 2, 0).reshape(ncells, -1, terms)
    flat = out.reshape(norders * naxes, t.size)  # a view
    bounds = [0, *np.searchsorted(t, edges[1:-1]).tolist(), t.size]
    widest = max(1, min(_CHUNK, _PRODUCT // table[0].size))
    basis = np.empty((max(terms, 2), widest))
    basis[0] = 1.0
    for k, (first, last) in enumerate(itertools.pairwise(bounds)):
        for begin in range(first, last, widest):
            end = min(begin + widest, last)
            powers = basis[:, : end - begin]
            np.subtract(t[begin:end], centres[k], out=powers[1])
            powers[1] /= radius
            _powers(powers)
            np.matmul(table[k], powers[:terms], out=flat[:, begin:end])
    return are_finite(table)


def _powers(functions: Array) -> None:
    """Powers (size, ntime) from the first two, 1 and x."""
    top, size = 1, len(functions)
    while top + 1 < size:  # x^(top + k) = x^top x^k doubles the number in each pass
        more = min(top, size - 1 - top)
        np.multiply(functions[1 : more + 1], functions[top], out=functions[top + 1 : top + more + 1])
        top += more


def _sample_chunks(jet: Callable[[Array, int], Array], t: Array, orders: tuple[int, int], out: Array) -> None:
    for begin in range(0, t.size, _CHUNK):
        out[:, :, begin : begin + _CHUNK] = jet(t[begin : begin + _CHUNK], orders[1])[orders[0] :]
