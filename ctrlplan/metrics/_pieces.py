r"""What a signal does between its samples: one cubic an interval.

On the interval from :math:`t_k` to :math:`t_{k+1}`, with :math:`d_k` the second divided difference about sample k and
:math:`c_k` the third one of samples k - 1 to k + 2, the cubic through these four samples is

.. math:: p(t) = \text{chord}(t) + (t - t_k)(t - t_{k+1}) [d_k + (t - t_{k-1}) c_k],

whose bracket runs between :math:`d_k` and :math:`d_{k+1}`. On smooth signals its error is of fourth order. A jump or a
kink makes one of the two curvatures large, and the cubic would then swing by 6 % of the jump on either side. As in
essentially non-oscillatory schemes (Harten et al., 1987, doi 10.1016/0021-9991(87)90031-3) the smoother side is
trusted: :math:`c_k` is cut to a multiple of its neighbours and the smaller curvature kept. Where a signal is smooth the
cut is of fourth order too, so that the order of every metric stays.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan.metrics._records import Array

_NEIGHBOURS = 4.0  # times a neighbouring third difference: more is a kink
_CURVATURES = 0.5  # of the smaller curvature: two curvatures as close as this are smooth
_ASIDE = 0.25  # of the greater curvature: a lesser one of the other sign is the smooth side of a kink
_JUMP = 2.0  # times either neighbouring slope: more is a jump
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


@dataclass(frozen=True)
class Pieces:
    """Cubics :math:`a + b s + c s^2 + d s^3`, 0 <= s <= 1, of m intervals, each array of shape (m,)."""

    begin: Array
    step: Array
    a: Array
    b: Array
    c: Array
    d: Array
    end: Array
    jump: NDArray[np.bool_]

    def __getitem__(self, chosen: NDArray[np.bool_] | slice) -> "Pieces":
        """Return the pieces of some of the intervals."""
        return Pieces(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def __call__(self, s: Any) -> Array:
        """Return the values at s, shape (..., m)."""
        return np.asarray(self.a + s * (self.b + s * (self.c + s * self.d)))

    def slope(self, s: Any) -> Array:
        """Return the derivatives by s, shape (..., m)."""
        return np.asarray(self.b + s * (2 * self.c + s * 3 * self.d))

    def time(self, s: Any) -> Array:
        """Return the times at s, shape (..., m)."""
        return np.asarray(self.begin + s * self.step)

    def held(self, s: Any) -> Array:
        """Return the values at s with each jump in the middle of its interval, as the trapezoidal rule has it."""
        return np.where(self.jump, np.where(s < 0.5, self.a, self.end), self(s))

    def whole(self) -> Array:
        """Return the two ends of each interval, shape (2, m)."""
        return np.stack([np.zeros_like(self.a), np.ones_like(self.a)])

    def cuts(self) -> Array:
        """Return 0, the places where the direction turns, and 1, shape (4, m): monotone in between."""
        inner = np.sqrt(self.c**2 - 3 * self.d * self.b)
        q = -(self.c + np.copysign(inner, self.c))
        turns = np.stack([np.zeros_like(q), q / (3 * self.d), self.b / q, np.ones_like(q)])
        turns[~np.isfinite(turns)] = 0.0
        return np.sort(np.clip(turns, 0.0, 1.0), axis=0)

    def at_cuts(self, cuts: Array) -> Array:
        """Return the values at cuts, the samples' own at either end."""
        values = self(cuts)
        values[0], values[-1] = self.a, self.end
        return values

    def splits(self) -> Array:
        """Return cuts with the zeros between them, shape (7, m): of one sign in between."""
        cuts = self.cuts()
        values = self.at_cuts(cuts)
        low, high = cuts[:-1], cuts[1:]
        zeros = np.where(np.sign(values[:-1]) * np.sign(values[1:]) < 0, self.crossing(0.0, low, high), low)
        return np.concatenate([np.stack([low, zeros], axis=1).reshape(6, -1), cuts[-1:]])

    def crossing(self, level: Any, low: Array, high: Array) -> Array:
        """Return s where p = level, for p monotone from low to high and on either side of the level there."""
        low, high = np.broadcast_arrays(low, high)
        rising = self(high) > self(low)
        s = (low + high) / 2
        for _ in range(60):  # Newton within a bracket; bisection alone would end in as many
            above = (self(s) > level) == rising
            low, high = np.where(above, low, s), np.where(above, s, high)
            newton = s - (self(s) - level) / self.slope(s)
            new = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
            if (np.abs(new - s) <= 1e-15).all():
                break
            s = new
        return s

    def integral(self, cuts: Array, integrand: Callable[[Array], Array]) -> float:
        """Return the integral over time of a function of s, between successive cuts, shape (ncuts, m)."""
        width = np.diff(cuts, axis=0)
        total = 0.0
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            total += weight * float(np.sum(self.step * width * integrand(cuts[:-1] + node * width)))
        return total


def pieces(t: Array, f: Array, chosen: NDArray[np.intp] | None = None) -> Pieces:
    """Return the cubics of a signal (ntime,), on all intervals or on those chosen."""
    k = np.arange(t.size - 1) if chosen is None else chosen
    step = t[k + 1] - t[k]
    rise = f[k + 1] - f[k]
    curvature = curvatures(t, f)
    if t.size > 3:
        bow, twist, broken = _shapes(t, curvature, k)
        jump = broken & _steep(t, f)[k]
    else:
        bow, twist = np.full(k.shape, curvature[0] if t.size == 3 else 0.0), np.zeros(k.shape)
        jump = np.zeros(k.shape, dtype=np.bool_)
    bow, twist = step**2 * bow, step**3 * twist
    return Pieces(t[k], step, f[k], rise - bow, bow - twist, twist, f[k + 1], jump)


def curvatures(t: Array, f: Array) -> Array:
    """Return the second divided differences about the inner samples, shape (ntime - 2,)."""
    d = np.diff(np.diff(f) / np.diff(t)) / (t[2:] - t[:-2])
    d[~np.isfinite(d)] = 0.0
    return d


def bulges(t: Array, f: Array) -> Array:
    """Return a bound on how far a cubic leaves its chord, shape (ntime - 1,); none is known for the outer two."""
    d = np.abs(curvatures(t, f))
    bound = np.full(t.size - 1, np.inf)
    bound[1:-1] = np.diff(t[1:-1]) ** 2 / 4 * np.maximum(d[:-1], d[1:])
    return bound


def maximum(t: Array, f: Array) -> float:
    """Return the greatest value of a signal (ntime,), between samples too."""
    top = float(f.max())
    if not np.isfinite(top):
        return top
    near = np.flatnonzero(np.maximum(f[:-1], f[1:]) + bulges(t, f) > top)
    p = pieces(t, f, near)
    return float(np.fmax.reduce(p(p.cuts()), axis=None, initial=top))


def _shapes(t: Array, d: Array, k: NDArray[np.intp]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the bracket of the cubic at the interval's begin, its slope, and whether most of that was cut."""
    last = t.size - 2
    third = np.diff(d) / (t[3:] - t[:-3])
    third[~np.isfinite(third)] = 0.0
    j = np.clip(k, 1, last - 1)  # the first and the last interval share their neighbour's four samples
    outer = j != k
    left, right, c, span = d[j - 1], d[j], third[j - 1], t[j + 2] - t[j - 1]

    # An outer interval sees one side only: what is cut there and next to it counts against the curvature itself.
    inner = np.where(k == 0, min(2, last - 1), max(last - 2, 1))
    beside = np.abs(third[inner - 1] - _cut(third, d, inner - 1)) * (t[inner + 2] - t[inner - 1]) * outer
    cut = _cut(third, d, j - 1, beside == 0)
    rough = np.abs(c - cut) * span + beside
    first = _shrunk(left, rough) - (t[2] - t[0]) * cut

    lesser, greater = np.minimum(np.abs(left), np.abs(right)), np.maximum(np.abs(left), np.abs(right))
    across = (np.sign(left) * np.sign(right) <= 0) & (lesser > _ASIDE * greater)
    share = np.divide(cut, c, out=np.ones_like(c), where=c != 0)
    nearer = np.where(np.abs(left) <= np.abs(right), left, right - span * cut)
    base = np.where(k == last, _shrunk(right, rough), np.where(across, share * left, nearer))
    bow = np.where(k == 0, first, base + (t[k] - t[np.maximum(k - 1, 0)]) * cut)
    return bow, cut, rough > np.abs(c) * span / 2


def _cut(third: Array, d: Array, i: NDArray[np.intp], trusted: NDArray[np.bool_] | bool = True) -> Array:
    """Return third differences cut to a multiple of those beside them, or whole where a trusted curvature is steady."""
    c, left, right = third[i], d[i], d[i + 1]
    sign = np.sign(c)
    beside = np.minimum(sign * third[_before(i, third.size)], sign * third[_after(i, third.size)])
    cut = sign * np.minimum(np.abs(c), _NEIGHBOURS * np.maximum(beside, 0.0))
    lesser = np.minimum(np.abs(left), np.abs(right))
    steady = (np.sign(left) * np.sign(right) > 0) & (np.abs(right - left) <= _CURVATURES * lesser)
    return np.where(steady & trusted, c, cut)


def _before(i: NDArray[np.intp], size: int) -> NDArray[np.intp]:
    """Return the index before each, or at the beginning the second one after it."""
    return np.where(i > 0, i - 1, min(2, size - 1))


def _after(i: NDArray[np.intp], size: int) -> NDArray[np.intp]:
    """Return the index after each, or at the end the second one before it."""
    return np.where(i < size - 1, i + 1, max(size - 3, 0))


def _shrunk(value: Array, by: Array) -> Array:
    return np.sign(value) * np.maximum(np.abs(value) - by, 0.0)


def _steep(t: Array, f: Array) -> NDArray[np.bool_]:
    """Return which intervals are much steeper than those beside them: jumps, or flat places of a smooth signal."""
    steep = np.abs(np.diff(f) / np.diff(t))
    beside = np.empty_like(steep)
    beside[1:-1] = np.maximum(steep[:-2], steep[2:])
    beside[0], beside[-1] = steep[1:4].max(), steep[-4:-1].max()
    return steep > _JUMP * beside
