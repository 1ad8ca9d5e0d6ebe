"""Responses of linear systems in closed form and 250 digits: no integration, no series, no matrix exponential.

A signal is, between its breaks, a sum of terms c s^k/k! exp(rate s), s counted from an origin: a polynomial or the
harmonics of equation (2), their coefficients from plain linear algebra. In Schur form the states follow one after the
other by variation of constants, and each is again such a sum.
"""

from itertools import pairwise

import mpmath as mp
import numpy as np

import ctrlplan as cp

DIGITS = 250
"""Plain linear algebra at alpha = 1e-9 loses most of them."""


def precise(function):
    def with_digits(*args, **kwargs):
        with mp.workdps(DIGITS):
            return function(*args, **kwargs)

    return with_digits


def added(*sums):
    """Sum of (factor, terms)."""
    out = {}
    for factor, terms in sums:
        for key, c in terms.items():
            out[key] = out.get(key, mp.mpf(0)) + factor * c
    return out


def differentiated(terms):
    out = {}
    for (k, rate, origin), c in terms.items():
        out[k, rate, origin] = out.get((k, rate, origin), mp.mpf(0)) + rate * c
        if k:
            out[k - 1, rate, origin] = out.get((k - 1, rate, origin), mp.mpf(0)) + c
    return out


def value(terms, t, shared=None):
    """Sum of the terms at a time; `shared` keeps what several sums at that time have in common."""
    shared = {} if shared is None else shared
    total = mp.mpf(0)
    for key, c in terms.items():
        if c:
            if key not in shared:
                k, rate, origin = key
                shared[key] = (t - origin) ** k / mp.factorial(k) * (mp.exp(rate * (t - origin)) if rate else 1)
            total += c * shared[key]
    return total


class Signal:
    """Scalar function of time: terms before, between and after its breaks."""

    def __init__(self, breaks, pieces):
        self.breaks, self.pieces = breaks, pieces

    def terms(self, moment):
        return self.pieces[sum(b <= moment for b in self.breaks)]

    @precise
    def __call__(self, times):
        """Values, right-continuous but at the end, where it is the leg's own."""
        out = []
        for t in map(mp.mpf, np.asarray(times, dtype=float)):
            i = sum(b <= t for b in self.breaks)
            last = len(self.breaks) > 1 and t == self.breaks[-1]
            out.append(float(mp.re(value(self.pieces[i - last], t))))
        return np.array(out)

    @precise
    def derivative(self):
        return Signal(self.breaks, [differentiated(piece) for piece in self.pieces])

    @precise
    def __add__(self, other):
        breaks = sorted({*self.breaks, *other.breaks})
        moments = [breaks[0] - 1, *breaks]
        return Signal(breaks, [added((1, self.terms(m)), (1, other.terms(m))) for m in moments])

    @precise
    def __rmul__(self, factor):
        return Signal(self.breaks, [added((mp.mpf(factor), piece)) for piece in self.pieces])

    @precise
    def shift(self, dt):
        dt = mp.mpf(dt)
        moved = [{(k, rate, origin + dt): c for (k, rate, origin), c in piece.items()} for piece in self.pieces]
        return Signal([b + dt for b in self.breaks], moved)

    @precise
    def then(self, other):
        other = other.shift(self.breaks[-1] - other.breaks[0])
        return Signal([*self.breaks, *other.breaks[1:]], [*self.pieces[:-1], *other.pieces[1:]])


def held(level):
    return {(0, mp.mpf(0), mp.mpf(0)): mp.mpf(level)}


def constant(level):
    return step(level, level)


@precise
def step(final, initial=0.0, time=0.0):
    return Signal([mp.mpf(time)], [held(initial), held(final)])


@precise
def spline(times, jets, alpha=0.0):
    """Equation (2), or the polynomial (12) where alpha is 0, through jets [y, y', ...] at the times."""
    t = [mp.mpf(float(x)) for x in times]
    start, duration = t[0], t[-1] - t[0]
    omega, zero = mp.mpf(alpha) / duration, mp.mpf(0)
    given = [(x, nu, mp.mpf(float(v))) for x, jet in zip(t, jets, strict=True) for nu, v in enumerate(jet)]
    size = len(given)

    def wave(k, phase):
        """sin(k omega (t - start) + phase)."""
        turn = mp.expj(phase) / 2j
        return {(0, mp.mpc(0, k * omega), start): turn, (0, mp.mpc(0, -k * omega), start): mp.conj(turn)}

    if alpha:
        m = size // 2
        even = size % 2 == 0
        basis = [{(0, zero, start): mp.mpf(1)}]
        for k in range(1, m + (not even)):
            basis += [wave(k, mp.pi / 2), wave(k, zero)]
        if even:
            basis.append(wave(m, -m * omega * mp.fsum(x - start for x, _, _ in given) / size))
    else:
        basis = [{(k, zero, start): mp.mpf(1)} for k in range(size)]
    orders = [basis]
    for _ in range(max(nu for _, nu, _ in given)):
        orders.append([differentiated(f) for f in orders[-1]])
    matrix = mp.matrix([[mp.re(value(f, x)) for f in orders[nu]] for x, nu, _ in given])
    found = mp.lu_solve(matrix, mp.matrix([v for _, _, v in given]))
    segment = added(*zip(found, basis, strict=True))
    ends = (held(mp.re(value(segment, x))) for x in (t[0], t[-1]))
    return Signal([t[0], t[-1]], [next(ends), segment, next(ends)])


def polygon(times, values):
    """Signal that is linear between samples."""
    t, u = [mp.mpf(float(x)) for x in times], [mp.mpf(float(x)) for x in values]
    zero = mp.mpf(0)
    pieces = [
        {(0, zero, t[k]): u[k], (1, zero, t[k]): (u[k + 1] - u[k]) / (t[k + 1] - t[k])} for k in range(len(t) - 1)
    ]
    return Signal(t, [{(0, zero, t[0]): u[0]}, *pieces, {(0, zero, t[0]): u[-1]}])


def piecewise(times, jets, alpha=0.0):
    segments = [spline(times[i : i + 2], jets[i : i + 2], alpha) for i in range(len(times) - 1)]
    whole = segments[0]
    for segment in segments[1:]:
        whole = whole.then(segment)
    return whole


def both(times, axes, alpha=0.0, each_segment=False, labels=None):
    """Plan of the library and the same in closed form, axis by axis; axes[a][i] is the jet at times[i]."""
    names = labels or [f"axis{a}" for a in range(len(axes))]
    points = [
        cp.Waypoint.from_jets(float(t), **{name: list(axis[i]) for name, axis in zip(names, axes, strict=True)})
        for i, t in enumerate(times)
    ]
    if each_segment:
        return cp.PiecewiseSpline(points, alpha=alpha, warn=False), [piecewise(times, axis, alpha) for axis in axes]
    plan = cp.TrigSpline(points, alpha=alpha, warn=False) if alpha else cp.PolySpline(points, warn=False)
    return plan, [spline(times, axis, alpha) for axis in axes]


def _schur(a):
    return mp.schur(a.apply(mp.mpc)) if a.rows > 1 else (mp.matrix([[mp.mpf(1)]]), a)


def _mode(rate, start, level, forcing):
    """Terms of x in x' = rate x + forcing with x(start) = level."""
    out = {}
    for (k, own, origin), c in forcing.items():
        gap = own - rate
        if abs(gap) < mp.mpf(10) ** (-0.6 * DIGITS):
            out[k + 1, rate, origin] = out.get((k + 1, rate, origin), mp.mpf(0)) + c
        else:
            for j in range(k + 1):
                key = (k - j, own, origin)
                out[key] = out.get(key, mp.mpf(0)) + (-1) ** j * c / gap ** (j + 1)
    out[0, rate, start] = out.get((0, rate, start), mp.mpf(0)) + level - value(out, start)
    return out


@precise
def response(a, b, c, d, signals, times, initial=None):
    """Outputs and states, each (n, ntime), of x' = a x + b w, y = c x + d w at the times.

    The state is `initial` (0 unless given) at the first time. Floats are taken exactly.
    """
    a, b, c, d = (mp.matrix(np.atleast_2d(m).tolist()) for m in (a, b, c, d))
    times = [mp.mpf(float(t)) for t in times]
    state = mp.matrix([mp.mpf(float(v)) for v in (np.zeros(a.rows) if initial is None else initial)])
    q, r = _schur(a)
    inwards = q.H * b
    xi = q.H * state
    edges = [times[0], *sorted({x for s in signals for x in s.breaks if times[0] < x < times[-1]}), times[-1]]
    states = []
    for left, right in pairwise(edges):
        inputs = [s.terms(left) for s in signals]
        modes = [None] * a.rows
        for i in reversed(range(a.rows)):
            parts = [(inwards[i, j], w) for j, w in enumerate(inputs)]
            parts += [(r[i, j], modes[j]) for j in range(i + 1, a.rows)]
            modes[i] = _mode(r[i, i], left, xi[i], added(*parts))
        for t in times:
            if left <= t < right or t == right == times[-1]:
                shared = {}
                states.append(q * mp.matrix([value(mode, t, shared) for mode in modes]))
        xi = mp.matrix([value(mode, right) for mode in modes])
    x = np.array([[mp.re(v) for v in column] for column in states], dtype=object).T
    w = np.array([[mp.mpf(v) for v in _at(s, times)] for s in signals], dtype=object).reshape(len(signals), len(times))
    outputs = np.array(c.tolist(), dtype=object) @ x + np.array(d.tolist(), dtype=object) @ w
    # By numpy 1.26 a cast of what is beyond floating point warns.
    return tuple(np.array([float(v) for v in values.flat]).reshape(values.shape) for values in (outputs, x))


def _at(signal, times):
    end = signal.breaks[-1] if len(signal.breaks) > 1 else None
    pieces = [signal.pieces[sum(b <= t for b in signal.breaks) - (t == end)] for t in times]
    return [mp.re(value(piece, t)) for piece, t in zip(pieces, times, strict=True)]


def gap(found, exact):
    """Greatest difference, each row relative to its own greatest value."""
    found, exact = np.atleast_2d(np.asarray(found)), np.atleast_2d(exact)
    assert found.shape == exact.shape
    return float((np.abs(found - exact).max(axis=1) / np.abs(exact).max(axis=1)).max())


def lag_loop(gain):
    """State-space form of k/(s^2 + s) in unity feedback, by hand: states y' and y; outputs y, u, e."""
    k = float(gain)
    return np.array([[-1.0, -k], [1.0, 0.0]]), [[k], [0.0]], [[0.0, 1.0], [0.0, -k], [0.0, -1.0]], [[0.0], [k], [1.0]]
