r"""Interpolation of a signal between its samples: one cubic per interval.

On the interval from :math:`t_k` to :math:`t_{k+1}`, with :math:`d_k` the second divided difference about sample k and
:math:`c_k` the third one of samples k - 1 to k + 2, the cubic through these four samples is

.. math:: p(t) = \text{chord}(t) + (t - t_k)(t - t_{k+1}) [d_k + (t - t_{k-1}) c_k],

whose bracket is between :math:`d_k` and :math:`d_{k+1}`. For smooth signals its error is of fourth order. A jump or a
kink makes one of the two curvatures large, and the cubic would then oscillate by 6 % of the jump on either side. As in
essentially non-oscillatory schemes (Harten et al., 1987, doi 10.1016/0021-9991(87)90031-3) the smoother side is
used: :math:`c_k` is limited to a multiple of its neighbours, with the smaller curvature. For smooth signals the effect
of the limit is of fourth order too, so that the order of the metrics is preserved.

At the start of a record and after a jump or a kink, the curvature is known from later samples only. A response begins
there, with dynamics that samples as far apart as its time constants do not show. An extremum before monotone samples,
from the extrapolated curvature alone, is therefore no overshoot of a response.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar, cast

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ctrlplan._lru import Lru
from ctrlplan.metrics._records import Array

G = TypeVar("G", bound=np.generic)
K = TypeVar("K")
Near = tuple[NDArray[Any], ...]
Places = tuple[NDArray[np.intp], ...]

_NEIGHBOURS = 4.0  # multiple of a neighbouring third difference above which there is a kink
_CURVATURES = 0.5  # difference relative to the smaller curvature up to which two curvatures are smooth
_ASIDE = 0.25  # of the larger curvature: a smaller one of opposite sign is the smooth side of a kink
_JUMP = 2.0  # multiple of both neighbouring slopes above which there is a jump
_UNEVEN = 4.0  # ratio of adjacent intervals up to which few digits are lost in products of samples
_ROUNDING = np.finfo(float).eps / 2  # of the terms of a cubic, up to which it is at a level
_BLOCK = 2**14  # samples
_STRETCH, _WINDOWS = 2**7, 2**7  # samples of a stretch of a signal; stretches that are evaluated together
LONG = 2**9  # samples, from which on one row costs more than the calls for it
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


NOWHERE = np.empty(0, dtype=np.intp)

_known: ContextVar["dict[Hashable, list[tuple[Array, Array, object]]] | None"] = ContextVar("_known", default=None)


@dataclass(frozen=True)
class Pieces:
    """Cubics :math:`a + b s + c s^2 + d s^3`, 0 <= s <= 1, of m intervals, each array of shape (m,).

    `jump` marks intervals with a jump, `begins` those before monotone samples from which they are extrapolated.
    """

    begin: Array
    step: Array
    a: Array
    b: Array
    c: Array
    d: Array
    end: Array
    jump: NDArray[np.bool_]
    begins: NDArray[np.bool_]

    def __getitem__(self, chosen: NDArray[np.generic] | tuple[NDArray[np.generic] | slice, ...]) -> "Pieces":
        """Return the pieces of some of the intervals."""
        return Pieces(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def __call__(self, s: float | Array) -> Array:
        """Return the values at s, shape (..., m)."""
        return np.asarray(self.a + s * (self.b + s * (self.c + s * self.d)))

    def slope(self, s: float | Array) -> Array:
        """Return the derivatives by s, shape (..., m)."""
        return np.asarray(self.b + s * (2 * self.c + s * 3 * self.d))

    def time(self, s: float | Array) -> Array:
        """Return the times at s, shape (..., m)."""
        return np.asarray(self.begin + s * self.step)

    def held(self, s: float | Array) -> Array:
        """Return the values at s with each jump in the middle of its interval, as in the trapezoidal rule."""
        values = self(s)
        if self.jump.any():
            values = np.where(self.jump, np.where(s < 0.5, self.a, self.end), values)
        return values

    def whole(self) -> Array:
        """Return the two ends of each interval, shape (2, m)."""
        return np.stack([np.zeros_like(self.a), np.ones_like(self.a)])

    @cached_property
    def cuts(self) -> Array:
        """Return 0, the stationary points and 1, shape (4, m): monotone in between."""
        inner = np.sqrt(self.c**2 - 3 * self.d * self.b)
        q = -(self.c + np.copysign(inner, self.c))
        one, other = (np.clip(np.where(np.isfinite(s), s, 0.0), 0.0, 1.0) for s in (q / (3 * self.d), self.b / q))
        return np.stack([np.zeros_like(q), np.minimum(one, other), np.maximum(one, other), np.ones_like(q)])

    @cached_property
    def values(self) -> Array:
        """Return the values at the cuts, those of the samples at either end."""
        values = self(self.cuts)
        values[0], values[-1] = self.a, self.end
        return values

    @cached_property
    def keeps_sign(self) -> NDArray[np.bool_]:
        """Return which intervals are known to be of one sign by their Bernstein coefficients; none with a jump."""
        third = self.b / 3
        early, late = self.a + third, self.a + 2 * third + self.c / 3
        low = np.minimum(np.minimum(self.a, self.end), np.minimum(early, late))
        high = np.maximum(np.maximum(self.a, self.end), np.maximum(early, late))
        return ((low >= 0) | (high <= 0)) & ~self.jump

    @cached_property
    def mean(self) -> Array:
        """Return the integrals over s, shape (m,)."""
        return self.a + self.b / 2 + self.c / 3 + self.d / 4

    @property
    def moment(self) -> Array:
        """Return the integrals of s times the cubics over s, shape (m,)."""
        return self.a / 2 + self.b / 3 + self.c / 4 + self.d / 5

    @cached_property
    def mixed(self) -> NDArray[np.bool_]:
        """Return which intervals have values of both signs; none with a jump."""
        return (self.values.min(axis=0) < 0) & (self.values.max(axis=0) > 0) & ~self.jump

    @cached_property
    def splits(self) -> Array:
        """Return cuts and the zeros between them, shape (7, m): of constant sign in between."""
        cuts, values = self.cuts, self.values
        low, high = cuts[:-1], cuts[1:]
        zeros, at = low.copy(), np.nonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
        zeros[at] = self[at[1]].crossing(0.0, low[at], high[at])
        return np.concatenate([np.stack([low, zeros], axis=1).reshape(6, -1), cuts[-1:]])

    def crossing(self, level: float | Array, low: Array, high: Array) -> Array:
        """Return s where p = level, for p monotone from low to high and on either side of the level there."""
        low, high = np.broadcast_arrays(low, high)
        rising = self(high) > self(low)
        rounding = _ROUNDING * (np.abs(level) + np.abs(self.a) + np.abs(self.b) + np.abs(self.c) + np.abs(self.d))
        s = (low + high) / 2
        found = np.zeros(s.shape, dtype=np.bool_)
        for _ in range(60):  # Newton's method with bisection, which alone would converge in as many
            rest = self(s) - level
            above = (rest > 0) == rising
            low, high = np.where(above, low, s), np.where(above, s, high)
            newton = s - rest / self.slope(s)
            new = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
            found |= (np.abs(new - s) <= 1e-15) | (np.abs(rest) <= rounding)
            if found.all():
                break
            s = np.where(found, s, new)  # a root is the same with others in the same call
        return s

    def square(self) -> Array:
        """Return the integrals over time of the squares (...)."""
        return np.sum(self.squares, axis=-1)

    @property
    def squares(self) -> Array:
        """Return the same for each interval, (..., m)."""
        squares = _mean_square(self.a, self.end, self.c, self.d)
        if self.jump.any():
            squares = np.where(self.jump, (self.a**2 + self.end**2) / 2, squares)
        return self.step * squares

    def integral(self, cuts: Array, integrand: Callable[[Array], Array]) -> float:
        """Return the integral over time of a function of s, between successive cuts, shape (ncuts, m)."""
        return float(self.integrals(cuts, integrand).sum())

    def integrals(self, cuts: Array, integrand: Callable[[Array], Array]) -> Array:
        """Return the same for each interval, shape (m,)."""
        width = np.diff(cuts, axis=0)
        total = np.zeros(width.shape)
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            total += weight * integrand(cuts[:-1] + node * width)
        return np.sum(self.step * width * total, axis=0)


def _legendre(a: Array, end: Array, c: Array, d: Array) -> list[tuple[float, Array]]:
    """Return the coefficients of Legendre series of cubics with the given ends, and the mean squares of their terms."""
    bend = (c + 1.5 * d) / 6
    return [(1.0, (a + end) / 2 - bend), (1 / 12, end - a - d / 10), (1 / 5, bend), (1 / 2800, d)]


def _mean_square(a: Array, end: Array, c: Array, d: Array) -> Array:
    """Return the mean squares of cubics a + b s + c s^2 + d s^3 with the given ends."""
    return np.asarray(sum(weight * term * term for weight, term in _legendre(a, end, c, d)))


@contextmanager
def shared() -> Iterator[None]:
    """Compute what metrics of a block have in common once for each signal."""
    token = _known.set({})
    try:
        yield
    finally:
        _known.reset(token)


def pieces(t: Array, f: Array, chosen: NDArray[np.intp] | None = None, rows: NDArray[np.intp] | None = None) -> Pieces:
    """Return the cubics of a signal (ntime,) on all or some intervals; for several signals, each of its row."""
    if chosen is None:
        return once(_cubics, t, f)
    if rows is None:
        return _cubics(t, f)[chosen]
    # A cubic depends on the samples up to four intervals away: a few windows are faster than whole signals.
    width = min(t.size, 10)
    first = np.clip(chosen - 4, 0, t.size - width)
    window = first[:, None] + np.arange(width)
    return _cubics(t[window], f[rows[:, None], window])[np.arange(chosen.size), chosen - first]


class Bulges:
    """Bound on the distance of the cubics of signals from their chords."""

    def __init__(self, t: Array) -> None:
        step = np.diff(t)
        self._pace, self._width, self._share = 1.0 / step, 1.0 / (t[2:] - t[:-2]), step[1:-1] ** 2 / 4
        self._starts = np.arange(0, t.size, _STRETCH)
        # Of four samples in a range of 1: both curvatures are at most 1 / (product of the adjacent steps).
        self._farthest = float((step[1:-1] / (4 * np.minimum(step[:-2], step[2:]))).max(initial=0.0))

    def extrema(self, f: Array) -> tuple[Array, Array]:
        """Return the minima and maxima of the samples of signals (nrows, ntime) by stretch, (nrows, nstretches)."""
        return np.minimum.reduceat(f, self._starts, axis=1), np.maximum.reduceat(f, self._starts, axis=1)

    def last_beyond(self, f: Array, level: Array, peaks: Array) -> NDArray[np.intp]:
        """Return the last sample of each signal (nrows, ntime) whose magnitude exceeds a level, 0 if none does.

        `peaks` are the magnitudes by stretch, (nrows, nstretches).
        """
        beyond = peaks > level[:, None]
        stretch = self._starts.size - 1 - beyond[:, ::-1].argmax(axis=1)
        at = np.minimum(self._starts[stretch, None] + np.arange(_STRETCH)[::-1], f.shape[1] - 1)
        rows = np.arange(len(f))
        place = (np.abs(f[rows[:, None], at]) > level[:, None]).argmax(axis=1)
        return np.where(beyond.any(axis=1), at[rows, place], 0)

    def beyond(
        self,
        f: Array,
        size: Callable[[Array], Array],
        level: Array,
        extrema: tuple[Array, Array],
        first: NDArray[np.intp] | None = None,
    ) -> Places:
        """Return the intervals in which the cubics of signals, or their magnitudes, may exceed a level.

        Parameters
        ----------
        f : ndarray, shape (nrows, ntime)
            The signals.
        size : callable
            Returns signals, or their magnitudes: what is compared with the level.
        level : ndarray, shape (nrows,)
            The level of each signal; none of its intervals are returned if it is nan.
        extrema : tuple of ndarray, shapes (nrows, nstretches)
            Minima and maxima of the signals by stretch.
        first : ndarray, shape (nrows,), optional
            First interval of each signal; default: 0. It and the last one, with no bound, are included.

        Returns
        -------
        rows, intervals : ndarray
            In order.
        """
        ntime, first = f.shape[1], np.zeros(len(f), dtype=np.intp) if first is None else first
        usable = np.flatnonzero(~np.isnan(level))
        found = [usable * ntime + first[usable], usable * ntime + ntime - 2]
        # Stretches of smaller samples are far below the level, also between samples; nan cannot be excluded.
        large = ~(self._reach(size, extrema) <= level[:, None]) & (self._starts + _STRETCH >= first[:, None])
        rows, stretch = places(large & (~np.isnan(level) & (ntime > 3))[:, None])
        windows = self._windows(f) if rows.size else ()
        for begin in range(0, rows.size, _WINDOWS):
            own = rows[begin : begin + _WINDOWS]
            window, interval = self._inside(windows, size, level, own, stretch[begin : begin + _WINDOWS])
            late = interval > first[own[window]]
            found.append(own[window[late]] * ntime + interval[late])
        return tuple(np.divmod(np.unique(np.concatenate(found)), ntime))

    def _reach(self, size: Callable[[Array], Array], extrema: tuple[Array, Array]) -> Array:
        """Return bounds of signals, or of their magnitudes, by stretch, also between samples, (nrows, nstretches)."""
        # The cubics of a stretch depend on samples of its neighbours.
        low, high = (bound.copy() for bound in extrema)
        for bound, given, nearer in ((low, extrema[0], np.minimum), (high, extrema[1], np.maximum)):
            nearer(bound[:, 1:], given[:, :-1], out=bound[:, 1:])
            nearer(bound[:, :-1], given[:, 1:], out=bound[:, :-1])
        top = np.maximum(size(low), size(high))
        return np.asarray(top + self._farthest * (high - low) + 1e-9 * np.maximum(-low, high))

    def _windows(self, f: Array) -> tuple[Array, ...]:
        """Return signals (nrows, nwindows, nsamples) and factors of their differences (nwindows, ...) in windows."""
        count = min(f.shape[1], _STRETCH + 6)
        factors = self._pace, self._width, self._share
        return sliding_window_view(f, count, axis=1), *(
            sliding_window_view(row, count - k) for k, row in enumerate(factors, 1)
        )

    def _inside(
        self,
        windows: tuple[Array, ...],
        size: Callable[[Array], Array],
        level: Array,
        rows: NDArray[np.intp],
        stretch: NDArray[np.intp],
    ) -> Places:
        """Return those of the inner intervals with samples of some stretches, with the number of the stretch first."""
        first = np.clip(self._starts[stretch] - 3, 0, len(windows[1]) - 1)
        samples, pace, width, share = windows[0][rows, first], *(factor[first] for factor in windows[1:])
        slope = samples[:, 1:] - samples[:, :-1]
        slope *= pace
        d = slope[:, 1:] - slope[:, :-1]
        d *= width
        np.abs(d, out=d)
        reach, sized = np.maximum(d[:, :-1], d[:, 1:]), size(samples)
        reach *= share
        reach += np.maximum(sized[:, 1:-2], sized[:, 2:-1])
        window, k = places(~(reach <= level[rows, None]))
        return window, first[window] + k + 1


def places(chosen: NDArray[np.bool_]) -> Places:
    """Return the rows and columns of the true entries of a matrix; faster than `numpy.nonzero` where they are few."""
    return tuple(np.divmod(np.flatnonzero(chosen), max(1, chosen.shape[1])))


def blocks(f: Array) -> Iterator[slice]:
    """Yield rows (nrows, ntime) in blocks that fit into the cache; long rows one by one, whose cubics may be shared."""
    count = max(1, _BLOCK // f.shape[1]) if f.shape[1] < LONG else 1
    return (slice(begin, begin + count) for begin in range(0, len(f), count))


def row_blocks(f: Array) -> Iterator[slice]:
    """Yield rows (nrows, ntime) in blocks that fit into the cache."""
    count = max(1, _BLOCK // f.shape[1])
    return (slice(begin, begin + count) for begin in range(0, len(f), count))


def maximum(t: Array, f: Array) -> float:
    """Return the maximum of a signal (ntime,), also between samples."""
    return float(maxima(t, f[None])[0])


def maxima(t: Array, f: Array, extrapolated: bool = True) -> Array:
    """Return the maximum of each of several signals (nrows, ntime), of all intervals or without those that begin."""
    return _largest(t, f, lambda values: values, extrapolated)


def peaks(t: Array, f: Array) -> Array:
    """Return the peak magnitude of each of several signals (nrows, ntime)."""
    return _largest(t, f, np.abs, True)


def _largest(t: Array, f: Array, size: Callable[[Array], Array], extrapolated: bool) -> Array:
    """Return the maximum of the signals or of their magnitudes."""
    bulges = Bulges(t)
    low, high = bulges.extrema(f)
    top = np.maximum(size(low), size(high)).max(axis=1)
    level = np.where(np.isfinite(top), top, np.nan)
    rows, chosen = bulges.beyond(f, size, level, (low, high))
    p = pieces(t, f, chosen, rows)
    inner = np.fmax.reduce(size(p(p.cuts)), axis=0)
    np.fmax.at(top, rows, inner if extrapolated else np.where(p.begins, -np.inf, inner))
    return top


def squares(t: Array, f: Array) -> Array:
    """Return the integrals over time of the squares of several signals (nrows, ntime)."""
    if f.shape[1] < LONG or not _is_even(t):
        return np.concatenate([_cubics(t, f[some]).square() for some in blocks(f)] or [np.empty(0)])
    found = _FORMS.get(t.tobytes(), lambda: _SquareForm(t))(f)
    for i in np.flatnonzero(~np.isfinite(found)):  # terms may overflow where the squares of the signal do not
        found[i] = _cubics(t, f[i]).square()
    return found


def _is_even(t: Array) -> bool:
    """Return whether adjacent intervals differ little, so that the terms of the quadratic form do not cancel."""
    step = np.diff(t)
    return bool(np.all(np.maximum(step[1:], step[:-1]) <= _UNEVEN * np.minimum(step[1:], step[:-1])))


class Smooth:
    """Cubics of signals on inner intervals with smooth curvature, where they are linear in four samples."""

    def __init__(self, t: Array) -> None:
        self.times, self.step, self.width, self.span = t, np.diff(t), t[2:] - t[:-2], t[3:] - t[:-3]
        self._quarter = self.step[1:-1] ** 2 / 4

    def differences(self, f: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Return slopes, curvatures and third differences of signals (nrows, ntime), and which of these are smooth.

        Shapes (nrows, ntime - 1), (nrows, ntime - 2) and twice (nrows, ntime - 3).
        """
        slope = f[:, 1:] - f[:, :-1]
        slope /= self.step
        d = slope[:, 1:] - slope[:, :-1]
        d /= self.width
        third, size = d[:, 1:] - d[:, :-1], np.abs(d)
        smaller = np.minimum(size[:, :-1], size[:, 1:])
        smaller *= _CURVATURES
        smooth = np.abs(third, out=size[:, 1:]) <= smaller
        third /= self.span
        return slope, d, third, smooth

    def keeps_sign(self, f: Array, d: Array) -> NDArray[np.bool_]:
        """Return on which inner intervals signals with curvatures d are known to be of one sign, if they are smooth."""
        size, bend = np.abs(f), np.abs(d)
        bulge = np.maximum(bend[:, :-1], bend[:, 1:])
        bulge *= self._quarter
        return np.asarray((f[:, 1:-2] * f[:, 2:-1] >= 0) & (bulge <= np.minimum(size[:, 1:-2], size[:, 2:-1])))

    def near(self, f: Array, found: tuple[Array, Array, Array, NDArray[np.bool_]], at: Places, begin: int) -> Near:
        """Return what determines the cubics of signals at some inner intervals, with the `differences` of the signals.

        The first row has the index `begin` among all signals.
        """
        slope, d, third, smooth = found
        rows, k = at
        here, inner, outer = (rows * values.shape[1] + k for values in (third, d, slope))
        before, flat, after = (np.abs(slope.take(outer + shift)) for shift in range(3))
        steep = flat > _JUMP * np.maximum(before, after)
        samples = f[rows, k + 1], f[rows, k + 2], f[rows, k + 3]
        thirds = third.take(here), *_neighbours(third, at)
        return begin + rows, k, smooth.take(here), *thirds, d.take(inner), d.take(inner + 1), *samples, steep

    def pieces(self, near: Near) -> Pieces:
        """Return the cubics of signals on their inner intervals."""
        _, k, smooth, c, before, after, one, other, a, end, later, steep = near
        base, twist, broken, begins = _sided(c, before, after, one, other, self.span[k])
        base, twist = np.where(smooth, one, base), np.where(smooth, c, twist)
        step, rise = self.step[k + 1], end - a
        square = step * step
        bow, twist = (base + self.step[k] * twist) * square, twist * (square * step)
        jump, begins = broken & steep & ~smooth, begins & ~smooth & (rise * (later - end) > 0)
        return Pieces(self.times[k + 1], step, a, rise - bow, bow - twist, twist, end, jump, begins)


class _SquareForm(Smooth):
    """Integral of the square of a signal as a quadratic form of its samples.

    Where the curvature is smooth, the form has four bands. Other intervals are corrected.
    """

    def __init__(self, t: Array) -> None:
        super().__init__(t)
        early, step, late = self.step[:-2], self.step[1:-1], self.step[2:]
        none, one = np.zeros_like(step), np.ones_like(step)
        # Factors of the samples k - 1 to k + 2, shape (4, m), for the interval from k to k + 1.
        left = np.array([1 / early, -1 / early - 1 / step, 1 / step, none]) / self.width[:-1]
        right = np.array([none, 1 / step, -1 / step - 1 / late, 1 / late]) / self.width[1:]
        third = (right - left) / self.span
        ends = np.array([none, one, none, none]), np.array([none, none, one, none])
        terms = _legendre(*ends, *_bent(left, third, early, step))
        self._bands = [np.zeros(t.size - j) for j in range(4)]
        for i in range(4):
            for j in range(4 - i):
                products = sum(weight * term[i] * term[i + j] for weight, term in terms)
                self._bands[j][i : i + step.size] += (1 if j == 0 else 2) * step * products

    def __call__(self, f: Array) -> Array:
        """Return the integrals of signals (nrows, ntime), shape (nrows,)."""
        found, near = np.empty(len(f)), list[Near]()
        for some in row_blocks(f):
            differences = self.differences(f[some])
            near.append(self.near(f[some], differences, places(~differences[3]), some.start))
        for i, row in enumerate(f):  # a row has the same sum with others in the same call
            found[i] = sum(band @ (row[: band.size] * row[row.size - band.size :]) for band in self._bands)
        columns = together(near)
        np.add.at(found, columns[0], self._corrections(columns))
        rows = np.arange(len(f)).repeat(2)
        ends = np.tile([0, f.shape[1] - 2], len(f))
        np.add.at(found, rows, pieces(self.times, f, ends, rows).squares)
        return found

    def _corrections(self, near: Near) -> Array:
        """Return what the cubics of inner intervals without smooth curvature add to the form."""
        p, k, c, one = self.pieces(near), near[1], near[3], near[6]
        return p.squares - p.step * _mean_square(p.a, p.end, *_bent(one, c, self.step[k], p.step))


_FORMS: Lru[bytes, _SquareForm] = Lru(4)


def _bent(base: Array, third: Array, early: Array, step: Array) -> tuple[Array, Array]:
    """Return c and d of cubics from their brackets at the start of the interval before, as in `_shapes`."""
    square = step * step
    d = third * (square * step)
    return (base + early * third) * square - d, d


def together(near: Sequence[Near]) -> Near:
    """Return the columns of all blocks of signals."""
    return tuple(np.concatenate(column) for column in zip(*near, strict=True))


def gathered(chosen: list[NDArray[np.intp]]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the chosen intervals of all rows in one array, and their rows."""
    return np.concatenate([NOWHERE, *chosen]), np.repeat(np.arange(len(chosen)), [k.size for k in chosen])


def once(make: Callable[[Array, Array], K], t: Array, f: Array) -> K:
    """Return what is computed of a signal, or of several; that known if it is shared."""
    known = _known.get()
    if known is None:
        return make(t, f)
    # Signals are known by their values, as a measure may use an array for one signal after the other.
    same = known.setdefault((make, f.shape, *f.flat[[0, f.size // 2, -1]].tolist()), [])
    for times, signal, found in same:
        if np.array_equal(signal, f) and np.array_equal(times, t):
            return cast(K, found)
    times, signal = t.copy(), f.copy()
    made = make(times, signal)
    same.append((times, signal, made))
    return made


def _cubics(t: Array, f: Array) -> Pieces:
    """Return the cubics on all intervals, in arrays (..., ntime - 1)."""
    step, rise = np.diff(t), np.diff(f)
    slope = rise / step
    curvature = _finite(np.diff(slope) / (t[..., 2:] - t[..., :-2]))
    if t.shape[-1] > 3:
        bow, twist, jump, begins = _shapes(t, curvature)
        if jump.any():
            jump &= _steep(slope)
    else:
        bow = np.repeat(curvature, 2, axis=-1) if t.shape[-1] == 3 else np.zeros_like(rise)
        twist, jump = np.zeros_like(rise), np.zeros(rise.shape, dtype=np.bool_)
        begins = np.zeros_like(jump)
    square = step * step
    bow *= square
    twist *= square * step
    begins[..., :-1] &= rise[..., :-1] * rise[..., 1:] > 0
    return Pieces(t[..., :-1], step, f[..., :-1], rise - bow, bow - twist, twist, f[..., 1:], jump, begins)


def _shapes(t: Array, d: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the bracket of each cubic at its start, its slope, whether it was mainly cut, and whether it begins.

    A cubic begins if its curvature is that of the samples after the interval only.
    """
    span = t[..., 3:] - t[..., :-3]
    change, left, right, size = np.diff(d), d[..., :-1], d[..., 1:], np.abs(d)
    third = _finite(change / span)
    steady = np.abs(change) <= _CURVATURES * np.minimum(size[..., :-1], size[..., 1:])

    # Where the curvature is smooth, all four samples are used.
    base, twist, broken, begins = left.copy(), third.copy(), np.zeros_like(steady), np.zeros_like(steady)
    at = np.nonzero(~steady)
    wide = np.broadcast_to(span, third.shape)[at]
    base[at], twist[at], broken[at], begins[at] = _sided(third[at], *_neighbours(third, at), left[at], right[at], wide)
    bow = base + (t[..., 1:-2] - t[..., :-3]) * twist

    # An outer interval has the four samples of its neighbour and one side only: its curvature is reduced by what was
    # cut there and next to it.
    count = third.shape[-1]
    outer = []
    for end, inner, far in ((0, min(1, count - 1), min(2, count - 1)), (-1, max(count - 2, 0), max(count - 3, 0))):
        c, wide = third[..., end], span[..., end]
        change = np.abs(third[..., inner] - twist[..., inner]) * span[..., inner]
        cut = _cut(c, third[..., inner], third[..., far])
        slope = np.where(steady[..., end] & (change == 0), c, cut)
        rough = np.abs(c - slope) * wide + change
        outer.append((_shrunk(d[..., end], rough), slope, rough > np.abs(c) * wide / 2))
    (first, begin, jump), (last, ending, drop) = outer
    first = first - (t[..., 2] - t[..., 0]) * begin
    last = last + (t[..., -2] - t[..., -3]) * ending
    first_begins = np.ones_like(jump)
    return (
        _between(first, bow, last),
        _between(begin, twist, ending),
        _between(jump, broken, drop),
        _between(first_begins, begins, ~first_begins),
    )


def _sided(
    c: Array, before: Array, after: Array, one: Array, other: Array, span: Array
) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the same for intervals without smooth curvature, from the third differences and both curvatures.

    The third difference is limited to a multiple of its neighbours, with the curvature of the smoother side.
    """
    cut = _cut(c, before, after)
    size, far = np.abs(one), np.abs(other)
    nearer = np.where(size <= far, one, other - span * cut)
    across = (np.sign(one) * np.sign(other) <= 0) & (np.minimum(size, far) > _ASIDE * np.maximum(size, far))
    share = np.divide(cut, c, out=np.ones_like(c), where=c != 0)
    return np.where(across, share * one, nearer), cut, np.abs(c - cut) > np.abs(c) / 2, ~across & (size > far)


def _neighbours(third: Array, at: tuple[NDArray[np.intp], ...]) -> tuple[Array, Array]:
    """Return the third differences before and after some; for the outer ones, two from one side."""
    *rows, k = at
    last = third.shape[-1] - 1
    before, after = np.where(k > 0, k - 1, min(2, last)), np.where(k < last, k + 1, max(last - 2, 0))
    if len(rows) == 1 and third.flags.c_contiguous:
        first = rows[0] * (last + 1)
        return third.take(first + before), third.take(first + after)
    return third[*rows, before], third[*rows, after]


def _cut(c: Array, before: Array, after: Array) -> Array:
    """Return third differences limited to a multiple of their neighbours."""
    low = _NEIGHBOURS * np.minimum(np.maximum(before, after), 0.0)
    high = _NEIGHBOURS * np.maximum(np.minimum(before, after), 0.0)
    return np.minimum(np.maximum(c, low), high)


def _between(first: NDArray[G], inner: NDArray[G], last: NDArray[G]) -> NDArray[G]:
    return np.concatenate([first[..., None], inner, last[..., None]], axis=-1)


def _shrunk(value: Array, by: Array) -> Array:
    return np.sign(value) * np.maximum(np.abs(value) - by, 0.0)


def _steep(slope: Array) -> NDArray[np.bool_]:
    """Return which intervals are much steeper than their neighbours: jumps, or stationary points of smooth signals."""
    steep = np.abs(slope)
    neighbours = np.empty_like(steep)
    neighbours[..., 1:-1] = np.maximum(steep[..., :-2], steep[..., 2:])
    neighbours[..., 0], neighbours[..., -1] = steep[..., 1:4].max(axis=-1), steep[..., -4:-1].max(axis=-1)
    return steep > _JUMP * neighbours


def _finite(d: Array) -> Array:
    """Return divided differences with 0 for those that overflow."""
    known = np.isfinite(d)
    return d if known.all() else np.where(known, d, 0.0)
