"""Exact change of the states of a linear flow over a time, from values of its input at Gauss nodes.

x' = A x + H h + B w with h constant: the input w is the polynomial through its values
at the Gauss nodes of an interval. Its Legendre coefficients, which change linearly as
the origin moves, extend the states to a system without input, whose matrix exponential
gives the change of the states, for any stiffness.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre

from ctrlplan._types import Array
from ctrlplan.simulation.exact import changes_over, state_scale
from ctrlplan.trajectories.chebyshev import points, transform

REACH = 8.0
"""Norm of A times a length up to which Chebyshev series in the length, or in time, are accurate."""

_NUMBERS = 2**21
"""Maximum number of entries of the products for several exponentials at a time."""

_FEW = 64
"""Number of lengths up to which each has an exponential of its own."""


class FlowKernel:
    """Changes of states over given times.

    Parameters
    ----------
    a, h, b : ndarray, shapes (n, n), (n, nheld) and (n, ninputs)
        The flow.
    order : int
        Number of Gauss nodes of an interval.

    Attributes
    ----------
    width : int
        Number of columns of a change: states, held values, inputs at the first node, at the second, ...
    """

    def __init__(self, a: Array, h: Array, b: Array, order: int) -> None:
        self._scale = state_scale(a)
        self._a = a * (self._scale / self._scale[:, None])
        self._h, self._b = h / self._scale[:, None], b / self._scale[:, None]
        self.order = order if b.shape[1] else 0
        self._n, self._rest = len(a), h.shape[1] + self.order * b.shape[1]
        self.width = self._n + self._rest
        self.norm = float(np.abs(self._a).sum(axis=0).max(initial=0.0))

    def over(self, lengths: Array) -> Array:
        """Changes (nlengths, n, width) over lengths [s], the nodes being those of each length."""
        longest = float(lengths.max(initial=0.0))
        if lengths.size <= _FEW or self.norm * longest > REACH:
            return self._each(lengths, np.ones(lengths.size))
        count = self.terms(longest)
        nodes = self._each(points(count - 1, 0.0, longest), np.ones(count)).reshape(count, -1)
        series = transform(np.eye(count)).T @ nodes
        basis = np.cos(np.arange(count) * np.arccos(2.0 * lengths[:, None] / longest - 1.0))
        return np.asarray((basis @ series).reshape(lengths.size, self._n, self.width))

    def within(self, length: float, first: float, last: float, count: int) -> Array:
        """Chebyshev series (count, n, width) of the change between two fractions of a length."""
        fractions = points(count - 1, first, last)
        nodes = self._each(length * fractions, fractions)
        return np.tensordot(transform(np.eye(count)).T, nodes, axes=1)

    def terms(self, length: float) -> int:
        """Number of Chebyshev terms that resolve the states over a length [s]."""
        reach, count, term = 0.25 * self.norm * length, 1, 1.0
        while term > 1e-18:
            term *= reach / count
            count += 1
        return count + self.order

    def _each(self, elapsed: Array, fractions: Array) -> Array:
        """Changes after times [s] that are fractions of the interval of the nodes."""
        n, m, p = self._n, self._b.shape[1], self.order
        nheld = self._h.shape[1]
        size = n + nheld + p * m
        out = np.empty((elapsed.size, n, size))
        if not n:
            return out
        values, at_start, derivative = _legendre(p)
        starts = (at_start[None, :, None] * self._b[:, None, :]).reshape(n, p * m)
        moved = np.kron(derivative, np.eye(m))
        part = max(1, _NUMBERS // (20 * size * size))
        for begin in range(0, elapsed.size, part):
            some = slice(begin, begin + part)
            t, s = elapsed[some, None, None], fractions[some, None, None]
            whole = np.zeros((t.shape[0], size, size))
            whole[:, :n] = t * np.concatenate([self._a, self._h, starts], axis=1)
            whole[:, n + nheld :, n + nheld :] = s * moved
            found = changes_over(whole, np.zeros((len(whole), size, 0)), 1)[-1][:, :n]
            out[some, :, : n + nheld] = found[:, :, : n + nheld]
            coefficients = found[:, :, n + nheld :].reshape(len(found), n, p, m)
            out[some, :, n + nheld :] = np.einsum("knpm,pf->knfm", coefficients, values).reshape(len(found), n, p * m)
        out[..., :n] /= self._scale
        return out * self._scale[:, None]


@lru_cache(maxsize=16)
def gauss_nodes(order: int) -> Array:
    """Gauss nodes of an interval, as fractions of it."""
    return np.asarray(0.5 + 0.5 * legendre.leggauss(max(1, order))[0])


@lru_cache(maxsize=16)
def to_legendre(order: int) -> Array:
    """Legendre coefficients (order, order) of the polynomial through values at the Gauss nodes."""
    nodes, weights = legendre.leggauss(order)
    powers = legendre.legvander(nodes, order - 1)
    return np.asarray((powers * weights[:, None]).T * (np.arange(order) + 0.5)[:, None])


def _legendre(order: int) -> tuple[Array, Array, Array]:
    """Coefficients from values, values of the polynomials at the start, and the derivative of coefficients."""
    if not order:
        return np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0))
    j = np.arange(order)
    higher = (j > j[:, None]) & ((j - j[:, None]) % 2 == 1)
    return to_legendre(order), np.where(j % 2, -1.0, 1.0), np.where(higher, 4.0 * j[:, None] + 2.0, 0.0)
