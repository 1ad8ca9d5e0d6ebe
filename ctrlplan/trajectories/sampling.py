r"""Evaluation of analytic functions at many times from exact jets at few.

A Chebyshev interpolant of each derivative is built from exact jets, once for a
segment. It is evaluated by matrix products, in a basis whose functions are
products of few of them:

.. math:: V_{2^k}(x) = V_{2^{k-1}}(x)^2 - 2, \qquad V_n = 2 T_n(x/2)

and each function is the product of the :math:`V_{2^k}` of the binary digits of its
number, so that one multiplication per function and time is required. By
:math:`V_{m+n} = V_m V_n - V_{m-n}` the coefficients of one basis are sums of few
coefficients of the other.

Trigonometric polynomials of degree m on an arc of alpha radians have the same form,
exactly and with 2m + 1 functions: with the angle w from the middle of the arc,

.. math:: x = 2\,\frac{\sin(w/2)}{\sin(\alpha/4)}, \qquad V_{2k}(x), \quad \sin w\,\frac{V_{2k+1}(x)}{x}

as even ones are polynomials in cos w, and odd ones are sin w times those. These
functions are well conditioned for every alpha.

Very many sorted times are divided into cells of as many times each. In each cell
the Taylor series about its centre gives the values, by few terms: the interpolants
are evaluated at the centres only. The powers are the same in all cells if the times
are evenly spaced. All are as accurate as the jets: series are truncated below
rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.chebyshev import transform, unit_points
from ctrlplan.trajectories.common import FACTORIALS, Array, are_finite, readonly

if TYPE_CHECKING:
    from ctrlplan.trajectories.trajectory import Trajectory

FEW = 256
"""Number of times up to which the jets themselves are evaluated."""

_CELLS = 30_000
"""Number of sorted times from which cells are faster than an interpolant with many terms."""

_MANY = 80_000
"""Number of sorted times from which cells are faster than an interpolant with few terms."""

_SHORT = 24
"""Number of terms that are few."""

_MAX_TERMS = 24
_PRODUCT = 2**18  # maximum multiplications of a matrix product in one thread
_CHUNK = 4104  # the functions stay in the second cache; no power of two, to avoid conflicts between rows
_SPARSE = 48  # number of times per segment from which a matrix product for each segment is faster
_COMPARED = 18  # number of breakpoints up to which comparisons with each are faster than searches
_CELL_SIZES = 1024, 512, 256, 128, 64  # numbers of times per cell: the first with few terms is taken
_EXTREME = 200.0  # decimal exponent of powers of a duration above which series are not evaluated
_BLOCK = 16 * _CHUNK  # number of times that are grouped together


class Interpolant(NamedTuple):
    """Interpolants of derivatives on one segment.

    Attributes
    ----------
    rows : ndarray, shape (norders * naxes, size)
        Coefficients of the products of Chebyshev polynomials.
    is_finite : bool
        Whether all values on the segment are finite.
    alpha : float
        Angle [rad] of the segment of trigonometric polynomials; 0 of polynomials.
    """

    rows: Array
    is_finite: bool
    alpha: float

    @classmethod
    def of(cls, coefficients: Array, alpha: float = 0.0) -> Interpolant:
        """Interpolants from coefficients of products (norders, naxes, size)."""
        rows = coefficients.reshape(-1, coefficients.shape[2])
        return cls(readonly(rows), are_finite(rows), alpha)


class Extent(NamedTuple):
    """What is known of many times of a segment.

    Attributes
    ----------
    first, last : float
        Smallest and largest time [s]; nan if one is nan.
    is_sorted : bool
        Whether no time is below the one before.
    """

    first: float
    last: float
    is_sorted: bool

    @classmethod
    def of(cls, t: Array) -> Extent:
        """Extent of one or more times."""
        if _is_sorted(t):
            return cls(t.item(0), t.item(-1), True)
        return cls(t.item(t.argmin()), t.item(t.argmax()), False)

    def since(self, start: float) -> Extent:
        """Extent of the times since a start."""
        return Extent(self.first - start, self.last - start, self.is_sorted)


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
    interpolants: Callable[[int, int], Interpolant | None],
    duration: float,
    t: Array,
    orders: tuple[int, int],
    out: Array,
    extent: Extent,
) -> bool:
    """Derivatives at many times; whether they are certainly finite.

    Parameters
    ----------
    jet : callable
        Maps times (ntime,) and an order to (order + 1, naxes, ntime).
    interpolants : callable
        Maps a lowest and a highest order to the `Interpolant` of these derivatives; None if they are not resolved.
    duration : float
        Length [s] of the segment, from 0, in which the function is analytic.
    t : ndarray, shape (ntime,)
        Times [s] in that segment.
    orders : (int, int)
        Lowest and highest order of the derivatives.
    out : ndarray, shape (norders, naxes, ntime)
        Place of the result.
    extent : Extent
        Of the times.
    """
    interpolant = interpolants(*orders)
    if extent.is_sorted and (interpolant is None or t.size > (_CELLS if interpolant.rows.shape[1] > _SHORT else _MANY)):
        finite = _sample_cells(jet, interpolants, duration, t, orders, out)
        if finite is not None:
            return finite
    return _sample_each(jet, interpolant, duration, t, orders, out)


def sample_segments(
    times: Array,
    rows_of: Callable[[NDArray[np.intp]], tuple[Array, bool]],
    entries: Array,
    t: Array,
    is_sorted: bool,
    left: bool,
    alpha: float,
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
    alpha : float
        As of `Interpolant`.
    out : ndarray, shape (norders, naxes, ntime)
        Place of the result.
    """
    finite = True
    for begin in range(0, t.size, _BLOCK):
        part, place = t[begin : begin + _BLOCK], out[:, :, begin : begin + _BLOCK]
        if is_sorted:
            finite &= _sample_sorted_block(times, rows_of, entries, part, left, alpha, place)
        else:
            segments = _segments_of_unsorted(times, part, left)
            order = segments.argsort(kind="stable")
            counts = np.bincount(segments)
            used = counts.nonzero()[0]
            found = np.empty(place.shape)
            finite &= _sample_grouped(times, rows_of, entries, part[order], left, alpha, used, counts[used], found)
            back = np.empty_like(order)
            back[order] = np.arange(order.size)
            if part.size == t.size:
                found.take(back, axis=2, out=out, mode="clip")
                continue
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
    alpha: float,
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
        return _sample_grouped(times, rows_of, entries, t, left, alpha, used + first, counts[used], out)
    rows, finite = rows_of(np.arange(first, last + 1))
    ends, starts = bounds.tolist(), moments.tolist()
    spans = zip(rows, ends, ends[1:], starts, starts[1:], strict=False)
    parts = [Part(own, begin, end, start, stop - start) for own, begin, end, start, stop in spans if begin < end]
    evaluate(parts, t, out, alpha)
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
    alpha: float,
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
        _evaluate_each(rows, index, t - starts[index], durations[index], out, alpha)
    else:
        bounds = [0, *counts.cumsum().tolist()]
        evaluate(list(map(Part, rows, bounds, bounds[1:], starts.tolist(), durations.tolist())), t, out, alpha)
    where = (t == (ends if left else starts).repeat(counts)).nonzero()[0]
    if where.size:
        place_entries(entries[segments.repeat(counts)[where] + left], where, out)
    if segments[-1] == times.size - 2 and not left:  # the end belongs to the last segment
        where = (t[-counts[-1] :] == ends[-1]).nonzero()[0] + (t.size - counts[-1])
        if where.size:
            place_entries(entries[np.full(where.size, times.size - 1)], where, out)
    return finite


def place_entries(known: Array, where: NDArray[np.intp], out: Array) -> None:
    """Replace the lowest derivatives at some times by those that are known, (ntimes, k, naxes)."""
    rows, place = known.transpose(1, 2, 0), out[: known.shape[1]]
    place[:, :, where] = rows if are_finite(known) else np.where(np.isnan(rows), place[:, :, where], rows)


def in_products(coefficients: Array) -> Array:
    """Coefficients of products from Chebyshev coefficients (..., size)."""
    return np.asarray(coefficients @ _products_of_chebyshev(coefficients.shape[-1]))


class Collocation(NamedTuple):
    """Points from which functions are interpolated.

    Attributes
    ----------
    points : ndarray, shape (count,)
        Relative times in the segment.
    products : ndarray, shape (count, terms)
        Matrix from values there to the coefficients of products.
    """

    points: Array
    products: Array


@lru_cache(maxsize=256)
def collocation(alpha: float, size: int) -> Collocation:
    """Points for polynomials of `size` coefficients, or for trigonometric polynomials of degree size // 2.

    Their number is even, so that the middle of the segment, where a waypoint often is,
    is none of them.
    """
    terms = size // 2 * 2 + 1 if alpha else size
    count = terms + terms % 2
    nodes = 2.0 * unit_points(count - 1) - 1.0
    products = in_products(transform(np.eye(count))[:, :terms])
    if not alpha:
        return Collocation(unit_points(count - 1), readonly(products))
    angles = np.arcsin(math.sin(0.25 * alpha) * nodes)  # half of those from the middle
    weights = 1.0 / np.cos(angles)[:, None]  # odd functions are divided by the cosine, which leaves polynomials
    products = 0.5 * (products + products[::-1] + weights * products - weights * products[::-1])
    products[:, 1::2] *= 1.0 / math.sin(0.25 * alpha)  # x cos(w/2) is sin w over that
    return Collocation(readonly(0.5 + (2.0 / alpha) * angles), readonly(products))


def evaluate(parts: Sequence[Part], t: Array, out: Array, alpha: float = 0.0) -> None:
    """Values of interpolants.

    Parameters
    ----------
    parts : sequence of Part
        All times in turn.
    t : ndarray, shape (ntime,)
        Times [s].
    out : ndarray, shape (norders, naxes, ntime)
        Place of the result.
    alpha : float
        As of `Interpolant`.
    """
    target = out.reshape(-1, t.size)  # a view
    basis = _new_basis(max([part.rows.shape[1] for part in parts]), t.size, alpha)
    place = 0
    for begin in range(0, t.size, _CHUNK):
        end = min(begin + _CHUNK, t.size)
        functions = basis[:, : end - begin]
        inside = []
        while place < len(parts) and parts[place].first < end:
            rows, first, last, start, duration = parts[place]
            low, high = max(first, begin), min(last, end)
            _scale(t[low:high], start, duration, alpha, functions[1, low - begin : high - begin])
            inside.append((rows, low, high))
            if last > end:
                break
            place += 1
        _fill(functions, alpha)
        for rows, first, last in inside:
            _multiply(rows, functions[: rows.shape[1], first - begin : last - begin], target[:, first:last])


def _evaluate_one(rows: Array, t: Array, duration: float, out: Array, alpha: float) -> None:
    """As `evaluate`, at times since the start of one segment."""
    target = out.reshape(-1, t.size)  # a view
    basis = _new_basis(rows.shape[1], t.size, alpha)
    for begin in range(0, t.size, _CHUNK):
        part = t[begin : begin + _CHUNK]
        functions = basis[:, : part.size]
        _scale(part, 0.0, duration, alpha, functions[1])
        _fill(functions, alpha)
        _multiply(rows, functions[: rows.shape[1]], target[:, begin : begin + part.size])


def _multiply(rows: Array, functions: Array, out: Array) -> None:
    """Matrix products (..., nrows, ntime), each in one thread."""
    if rows.shape[-2] * rows.shape[-1] * out.shape[-1] <= _PRODUCT:
        np.matmul(rows, functions, out=out)
        return
    step = max(1, _PRODUCT // (rows.shape[-2] * rows.shape[-1]))
    for begin in range(0, out.shape[-1], step):
        part = slice(begin, begin + step)
        np.matmul(rows, functions[..., part], out=out[..., part])


def _evaluate_each(rows: Array, index: NDArray[np.intp], t: Array, duration: Array, out: Array, alpha: float) -> None:
    """As `evaluate`, each time with its own rows, for few times of many segments.

    Parameters
    ----------
    rows : ndarray, shape (nsegments, norders * naxes, size)
        Rows of the interpolants.
    index : ndarray of int, shape (ntime,)
        Place of the rows of each time among them.
    """
    target = out.reshape(-1, t.size)  # a view
    basis = _new_basis(rows.shape[2], t.size, alpha)
    for begin in range(0, t.size, _CHUNK):
        end = min(begin + _CHUNK, t.size)
        functions = basis[:, : end - begin]
        _scale(t[begin:end], 0.0, duration[begin:end], alpha, functions[1])
        _fill(functions, alpha)
        used = functions[: rows.shape[2]].T[:, :, None]
        target[:, begin:end] = (rows[index[begin:end]] @ used)[:, :, 0].T


def _new_basis(size: int, ntime: int, alpha: float) -> Array:
    """Memory for the functions at some times."""
    basis = np.empty((max(size, 4 if alpha else 2), min(_CHUNK, ntime)))
    basis[0] = 1.0
    return basis


def _scale(t: Array, start: float, duration: Array | float, alpha: float, out: Array) -> None:
    """Replace by times relative to the middle of their segments, from -2 to 2, or by half of the angle."""
    if start:
        t = np.subtract(t, start, out)
    np.subtract(t, 0.5 * duration, out)
    np.divide(out, 2.0 * duration / alpha if alpha else 0.25 * duration, out)


def _fill(functions: Array, alpha: float) -> None:
    """Fill the basis (size, ntime) from its first two functions, 1 and the scaled time."""
    top, size = 1, len(functions)
    if alpha:
        _change_to_sines(functions, alpha)
        top = 2
    while 2 * top < size:
        square = functions[2 * top]
        np.multiply(functions[top], functions[top], out=square)
        square -= 2.0
        more = min(2 * top, size - 2 * top)
        np.multiply(functions[1:more], square, out=functions[2 * top + 1 : 2 * top + more])
        top *= 2


def _change_to_sines(functions: Array, alpha: float) -> None:
    """Replace half of the angle by the sine of the angle, and set the next two functions.

    They follow from the tangent of the half, whose evaluation is faster than that of a sine and as accurate:
    sin w = 2z/(1 + z^2) and x^2 = 2 z sin w / sin(alpha/4)^2.
    """
    _, sine, second, tangent = functions[:4]
    np.tan(sine, out=tangent)
    np.multiply(tangent, tangent, out=second)
    second += 1.0
    np.divide(2.0, second, out=second)
    np.multiply(tangent, second, out=sine)
    np.multiply(tangent, sine, out=second)
    second *= 2.0 / math.sin(0.25 * alpha) ** 2
    second -= 2.0
    np.multiply(sine, second, out=tangent)


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
    jet: Callable[[Array, int], Array],
    interpolants: Callable[[int, int], Interpolant | None],
    duration: float,
    t: Array,
    orders: tuple[int, int],
    out: Array,
) -> bool | None:
    """As `sample`, at sorted times by Taylor series in cells; None if the series are too long.

    The few cells that are longer than others, where times are far apart, are evaluated as other times.
    """
    low, high = orders
    if not t[-1] > t[0] or abs(math.log10(duration)) * (high + _MAX_TERMS) > _EXTREME:
        return None
    some = duration * np.linspace(1e-6, 1.0 - 1e-6, 9)  # not at the ends, where the entries would be placed
    size = np.abs(jet(some, high + _MAX_TERMS + 2)).max(axis=2)
    for cell in _CELL_SIZES:
        first, last = t[::cell], np.append(t[cell - 1 :: cell], t[-1])[: -(-t.size // cell)]
        radius = 0.625 * float(t[-1] - t[0]) / first.size  # some are longer than the mean
        terms = _taylor_terms(size, radius, low, high)
        if terms is not None:
            break
    else:
        return None
    wide = (last - first > 2.0 * radius).nonzero()[0].tolist()
    if len(wide) > max(1, first.size // 8):
        return None
    centres, exact = 0.5 * (first + last), (low, high + terms - 1)
    derivatives = np.empty((exact[1] - low + 1, out.shape[1], centres.size))
    interpolant = interpolants(*orders)
    finite = _sample_each(jet, interpolant and interpolants(*exact), duration, centres, exact, derivatives)
    _evaluate_series(_series(derivatives, terms), centres, t, cell, _is_uniform(t, duration), out)
    for k in wide:
        part = slice(k * cell, (k + 1) * cell)
        finite &= _sample_each(jet, interpolant, duration, t[part], orders, out[:, :, part])
    return finite and are_finite(_bounds(derivatives, radius, terms))


def _sample_each(
    jet: Callable[[Array, int], Array],
    interpolant: Interpolant | None,
    duration: float,
    t: Array,
    orders: tuple[int, int],
    out: Array,
) -> bool:
    """As `sample`, by an interpolant, or by jets where there is none."""
    if interpolant is None:
        for begin in range(0, t.size, _CHUNK):
            out[:, :, begin : begin + _CHUNK] = jet(t[begin : begin + _CHUNK], orders[1])[orders[0] :]
        return False
    _evaluate_one(interpolant.rows, t, duration, out, interpolant.alpha)
    return interpolant.is_finite


def _series(derivatives: Array, terms: int) -> Array:
    """Taylor coefficients (ncells, norders * naxes, terms) from derivatives (norders + terms - 1, naxes, ncells)."""
    norders = len(derivatives) - terms + 1
    table = np.empty((derivatives.shape[2], norders, derivatives.shape[1], terms))
    for k in range(terms):
        np.divide(derivatives[k : k + norders].transpose(2, 0, 1), FACTORIALS[k], out=table[..., k])
    return table.reshape(len(table), -1, terms)


def _bounds(derivatives: Array, radius: float, terms: int) -> Array:
    """Bounds of the sums of the magnitudes of all terms, for each order."""
    powers = radius ** np.arange(terms) / FACTORIALS[:terms]
    return np.convolve(np.abs(derivatives).max(axis=(1, 2)), powers[::-1], mode="valid")


def _evaluate_series(table: Array, centres: Array, t: Array, cell: int, is_even: bool, out: Array) -> None:
    """Values of Taylor series about the centre of each cell of consecutive times."""
    terms, whole = table.shape[2], t.size // cell
    together = 1 if is_even else max(1, 2 * _CHUNK // cell)
    # The row of memory is longer than its times, to avoid conflicts between rows.
    basis = np.empty((max(terms, 2), together * cell + 8))[:, :-8].reshape(-1, together, cell)
    basis[0] = 1.0
    flat = out.reshape(-1, t.size)  # a view
    times = t[: whole * cell].reshape(whole, cell)
    values = flat[:, : whole * cell].reshape(len(flat), whole, cell).transpose(1, 0, 2)
    if whole < len(table):
        _evaluate_cells(table[whole:], centres[whole:], t[None, whole * cell :], basis, flat[None, :, whole * cell :])
    if is_even and whole:
        powers = _powers(times[:1], centres[:1], basis)
        _multiply(table[:whole], powers[:, :terms], values)
        return
    for begin in range(0, whole, together):
        part = slice(begin, min(begin + together, whole))
        _evaluate_cells(table[part], centres[part], times[part], basis, values[part])


def _evaluate_cells(table: Array, centres: Array, t: Array, basis: Array, out: Array) -> None:
    """Values (ncells, nrows, ntime) of series at times (ncells, ntime)."""
    powers = _powers(t, centres, basis[:, : len(t), : t.shape[1]])
    _multiply(table, powers[:, : table.shape[2]], out)


def _powers(t: Array, centres: Array, out: Array) -> Array:
    """Powers (ncells, size, ntime) of the distances of times (ncells, ntime) from the centres of cells."""
    np.subtract(t, centres[:, None], out=out[1])
    top, size = 1, len(out)
    while top + 1 < size:  # x^(top + k) = x^top x^k doubles the number in each pass
        more = min(top, size - 1 - top)
        np.multiply(out[1 : more + 1], out[top], out=out[top + 1 : top + more + 1])
        top += more
    return out.transpose(1, 0, 2)


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
    """Whether the times are evenly spaced up to rounding of times within the segment, and increase."""
    step = (t[-1] - t[0]) / (t.size - 1)
    slack = 4.0 * np.finfo(float).eps * duration
    if not step > 2.0 * slack or abs(t[1] - t[0] - step) > slack:
        return False
    ramp = step * np.arange(min(t.size, 8 * _CHUNK))
    beyond = np.empty_like(ramp)
    for first in range(0, t.size, ramp.size):
        part = t[first : first + ramp.size]
        excess = np.subtract(part, ramp[: part.size], out=beyond[: part.size])
        base = t[0] + first * step
        if not (np.maximum.reduce(excess) - base <= slack and base - np.minimum.reduce(excess) <= slack):
            return False
    return True


def _is_sorted(t: Array) -> bool:
    """Whether no time is below the one before; of times in any order a few say so."""
    if not t.item(0) <= t.item(t.size // 2) <= t.item(-1):
        return False
    return (t.size <= _CHUNK or _is_sorted(t[:FEW])) and int(np.count_nonzero(t[1:] >= t[:-1])) == t.size - 1


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
