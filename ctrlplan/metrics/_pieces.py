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

Where neighbouring intervals differ much in length, as next to an event, a jump or a rounding error in the shorter one
is a slope that has no meaning for the longer one. A cubic that is farther from its chord than the samples about it are
apart is therefore replaced by the chord; for intervals of similar length this bound is never reached.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ctrlplan.metrics._grid import Grid
from ctrlplan.metrics._records import Array

G = TypeVar("G", bound=np.generic)

CURVATURES = 0.5  # difference relative to the smaller curvature up to which two curvatures are smooth
_NEIGHBOURS = 4.0  # multiple of a neighbouring third difference above which there is a kink
_ASIDE = 0.25  # of the larger curvature: a smaller one of opposite sign is the smooth side of a kink
_JUMP = 2.0  # multiple of both neighbouring slopes above which there is a jump
_UNEVEN = 4.0  # ratio of adjacent intervals up to which a cubic is near its chord, whatever the samples
_ROUNDING = np.finfo(float).eps / 2  # of the terms of a cubic, up to which it is at a level
_MANY = 0.1  # share of the intervals above which the cubics of all are computed
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


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

    def __getitem__(self, chosen: NDArray[np.generic] | tuple[NDArray[np.generic], ...] | slice) -> "Pieces":
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

    def primitives(self, s: float | Array) -> Array:
        """Return the integrals over s of the cubics and of s times the cubics from 0 to s, shape (2, ..., m)."""
        area = s * (self.a + s * (self.b / 2 + s * (self.c / 3 + s * (self.d / 4))))
        moment = s * s * (self.a / 2 + s * (self.b / 3 + s * (self.c / 4 + s * (self.d / 5))))
        return np.array([area, moment])

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
        # The cubic is about a straight line or, from an end at which it is stationary, a parabola.
        early, late = np.abs(self(low) - level), np.abs(self(high) - level)
        share = early / (early + late)
        start = np.where(low > 0.0, np.sqrt(share), np.where(high < 1.0, 1.0 - np.sqrt(1.0 - share), share))
        s, a, twice, thrice = low + start * (high - low), self.a - level, 2 * self.c, 3 * self.d
        for _ in range(5):
            change = (a + s * (self.b + s * (self.c + s * self.d))) / (self.b + s * (twice + s * thrice))
            s = s - change
        # Newton's method doubles the number of digits; where it did not, its steps are safeguarded.
        lost = np.flatnonzero(~((np.abs(change) <= 1e-9) & (s >= low) & (s <= high)))
        if lost.size:
            level = np.broadcast_to(level, s.shape)[lost]
            s[lost] = self[lost]._safe_crossing(level, low[lost], high[lost])
        return s

    def _safe_crossing(self, level: Array, low: Array, high: Array) -> Array:
        """Return the same by Newton's method with bisection."""
        rising = self(high) > self(low)
        rounding = _ROUNDING * (np.abs(level) + np.abs(self.a) + np.abs(self.b) + np.abs(self.c) + np.abs(self.d))
        s = (low + high) / 2
        found = np.zeros(s.shape, dtype=np.bool_)
        for _ in range(60):  # bisection alone would converge in as many
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

    def areas(self) -> Array:
        """Return the integrals over s of the magnitudes and of s times the magnitudes, shape (2, m)."""
        sums = np.abs(self.primitives(1.0))
        at = np.flatnonzero(~self.keeps_sign)
        sums[:, at] = self[at].areas_from(0.0)
        return sums

    def areas_from(self, s: float | Array) -> Array:
        """Return the same integrals from s to 1, between the zeros; a jump is in the middle of its interval."""
        parts = self.primitives(np.maximum(self.splits, s))
        sums = np.abs(parts[:, 1:] - parts[:, :-1]).sum(axis=1)
        if self.jump.any():
            before, after = np.minimum(s, 0.5), np.maximum(s, 0.5)
            sides = [(0.5 - before, 1.0 - after), ((0.25 - before**2) / 2, (1.0 - after**2) / 2)]
            held = [early * np.abs(self.a) + late * np.abs(self.end) for early, late in sides]
            sums = np.where(self.jump, held, sums)
        return sums

    def squares(self) -> Array:
        """Return the integrals over time of the squares (...), by Legendre series."""
        bend = (self.c + 1.5 * self.d) / 6
        series = ((self.a + self.end) / 2 - bend, self.end - self.a - self.d / 10, bend, self.d)
        squares = sum(weight * term * term for weight, term in zip((1.0, 1 / 12, 1 / 5, 1 / 2800), series, strict=True))
        if self.jump.any():
            squares = np.where(self.jump, (self.a**2 + self.end**2) / 2, squares)
        return np.asarray(self.step * squares)

    def integral(self, cuts: Array, integrand: Callable[[Array], Array]) -> float:
        """Return the integral over time of a function of s, between successive cuts, shape (ncuts, m)."""
        width = np.diff(cuts, axis=0)
        total = np.zeros(width.shape)
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            total += weight * integrand(cuts[:-1] + node * width)
        return float(np.sum(self.step * width * total))


def limited(c: Array, before: Array, after: Array) -> Array:
    """Return third differences limited to a multiple of their neighbours."""
    low = _NEIGHBOURS * np.minimum(np.maximum(before, after), 0.0)
    high = _NEIGHBOURS * np.maximum(np.minimum(before, after), 0.0)
    return np.minimum(np.maximum(c, low), high)


def cubics_of_rows(grid: Grid, f: Array, rows: NDArray[np.intp], chosen: NDArray[np.intp]) -> Pieces:
    """Return the cubics of several signals (nrows, ntime), each on one interval of one row."""
    ntime = grid.t.size
    if rows.size > _MANY * f.size:
        whole, shape = cubics(grid.t, f), (len(f), ntime - 1)
        return Pieces(*(np.broadcast_to(array, shape)[rows, chosen] for array in vars(whole).values()))
    deep = (chosen >= 2) & (chosen <= ntime - 4)
    if deep.all():
        return _inner_cubics(grid, f, rows, chosen)
    inside, outside = np.flatnonzero(deep), np.flatnonzero(~deep)
    # A cubic depends on the samples up to four intervals away.
    k, width = chosen[outside], min(ntime, 10)
    first = np.clip(k - 4, 0, ntime - width)
    window = first[:, None] + np.arange(width)
    outer = cubics(grid.t[window], f[rows[outside, None], window])[np.arange(k.size), k - first]
    if not inside.size:
        return outer
    inner = _inner_cubics(grid, f, rows[inside], chosen[inside])
    place = np.empty_like(chosen)
    place[inside], place[outside] = np.arange(inside.size), np.arange(inside.size, chosen.size)
    found = zip(vars(inner).values(), vars(outer).values(), strict=True)
    return Pieces(*(np.concatenate(both).take(place) for both in found))


def _inner_cubics(grid: Grid, f: Array, rows: NDArray[np.intp], k: NDArray[np.intp]) -> Pieces:
    """Return the same cubics on intervals k with at least two others on either side, from samples k - 2 to k + 3."""
    near = np.arange(-2, 4)[:, None] + k
    samples, step = f.take(near + rows * f.shape[1]), grid.step.take(near[:-1])
    rise = samples[1:] - samples[:-1]
    slope = rise / step
    d = _finite((slope[1:] - slope[:-1]) / grid.width.take(near[:-2]))
    span, change, size = grid.span.take(near[:-3]), d[1:] - d[:-1], np.abs(d)
    third = _finite(change / span)
    steady = np.abs(change[1]) <= CURVATURES * np.minimum(size[1], size[2])
    base, twist, broken, begins = _sided(third[1], third[0], third[2], d[1], d[2], span[1])
    base, twist = np.where(steady, d[1], base), np.where(steady, third[1], twist)
    steep = np.abs(slope)
    jump = broken & ~steady & (steep[2] > _JUMP * np.maximum(steep[1], steep[3]))
    begins &= ~steady & (rise[2] * rise[3] > 0)
    square = step[2] * step[2]
    bow, twist = (base + step[1] * twist) * square, twist * (square * step[2])
    if grid.farthest > 1.0:
        _keep_near(samples.max(axis=0) - samples.min(axis=0), bow, twist)
    return Pieces(grid.t.take(k), step[2], samples[2], rise[2] - bow, bow - twist, twist, samples[3], jump, begins)


def cubics(t: Array, f: Array) -> Pieces:
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
    if np.any(np.maximum(step[..., 1:], step[..., :-1]) > _UNEVEN * np.minimum(step[..., 1:], step[..., :-1])):
        wide = np.pad(f, [(0, 0)] * (f.ndim - 1) + [(2, 2)], mode="edge")
        about = [wide[..., i : i + rise.shape[-1]] for i in range(6)]
        _keep_near(np.maximum.reduce(about) - np.minimum.reduce(about), bow, twist)
    begins[..., :-1] &= rise[..., :-1] * rise[..., 1:] > 0
    return Pieces(t[..., :-1], step, f[..., :-1], rise - bow, bow - twist, twist, f[..., 1:], jump, begins)


def _keep_near(apart: Array, bow: Array, twist: Array) -> None:
    """Replace cubics by their chords where they are farther from these than the samples about them are apart."""
    far = np.maximum(np.abs(bow), np.abs(bow + twist)) > 4 * apart
    if far.any():
        bow[far], twist[far] = 0.0, 0.0


def _shapes(t: Array, d: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the bracket of each cubic at its start, its slope, whether it was mainly cut, and whether it begins.

    A cubic begins if its curvature is that of the samples after the interval only.
    """
    span = t[..., 3:] - t[..., :-3]
    change, left, right, size = np.diff(d), d[..., :-1], d[..., 1:], np.abs(d)
    third = _finite(change / span)
    steady = np.abs(change) <= CURVATURES * np.minimum(size[..., :-1], size[..., 1:])

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
        cut = limited(c, third[..., inner], third[..., far])
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
    cut = limited(c, before, after)
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
