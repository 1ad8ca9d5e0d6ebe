"""Solution of a linear flow with delays over a part of a run, by collocation at Chebyshev nodes.

The states at the nodes satisfy the integrated equations at these nodes: a linear
system that depends on the length of the part only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev as series

from ctrlplan._lru import Lru
from ctrlplan._types import Array
from ctrlplan.simulation.exact import state_scale
from ctrlplan.trajectories.chebyshev import points, transform

NODES = 16
"""Number of nodes of a part."""

REACH = 2.0
"""Norm of the equations times the length of a part up to which the nodes resolve the states."""

_RESOLVED = 1e-15
"""Last coefficients of a signal, relative to the largest, at which it is resolved."""

_TERMS = 16
"""Number of lengths above which maps are computed from series with as many terms."""

_RECENT = 8
"""Number of sets of maps that are cached."""


@dataclass(frozen=True, eq=False)
class PartMaps:
    """Maps of parts from (state at the start, delayed values and functions of time at the nodes).

    Attributes
    ----------
    steps : ndarray, shape (nparts, n + nodes * ndelayed, ncolumns)
        Change of the state to the end, and inputs of the delays at the nodes.
    states : ndarray, shape (nparts, nodes * n, ncolumns)
        States at the nodes.
    """

    steps: Array
    states: Array


class Collocation:
    """Maps of parts of a flow x' = a x + b w with inputs y = c x + d w of the delays.

    Parameters
    ----------
    a, b, c, d : ndarray
        The flow. The first of w are the outputs of the delays, as many as y.

    Attributes
    ----------
    known : int
        Number of the columns of a map before those of the other functions of time.
    """

    def __init__(self, a: Array, b: Array, c: Array, d: Array) -> None:
        self._scale = state_scale(a)
        self._a, self._b = a * (self._scale / self._scale[:, None]), b / self._scale[:, None]
        self._c, self._d = c * self._scale, d
        n, (width, count) = len(a), d.shape
        self.known = n + NODES * width
        # Delayed values of all nodes come first, then the other functions of time of all nodes.
        order = np.arange(NODES * count).reshape(NODES, count)
        self._order = np.concatenate([np.arange(n), n + order[:, :width].ravel(), n + order[:, width:].ravel()])
        self._recent: Lru[bytes, PartMaps] = Lru(_RECENT)
        self._tables: Lru[float, tuple[Array, Array]] = Lru(_RECENT)

    def maps(self, lengths: Array, longest: float) -> PartMaps:
        """Maps of parts of some lengths [s], none above the longest."""
        if lengths.size <= _TERMS:
            return self._recent.get(lengths.tobytes(), lambda: self._computed(lengths))
        table, start = self._tables.get(longest, lambda: self._series(longest))
        x = np.clip(2.0 * lengths / longest - 1.0, -1.0, 1.0)
        found = np.cos(np.arange(_TERMS) * np.arccos(x)[:, None]) @ table
        found += start
        both = found.reshape(lengths.size, -1, self._order.size)
        split = both.shape[1] - NODES * len(self._a)
        return PartMaps(both[:, :split], both[:, split:])

    def _series(self, longest: float) -> tuple[Array, Array]:
        """Chebyshev series (nterms, nentries) of what the maps change from those of length 0, and these."""
        maps = self._computed(np.append(points(_TERMS - 1, 0.0, longest), 0.0))
        both = np.concatenate([maps.steps, maps.states], axis=1).reshape(_TERMS + 1, -1)
        return transform(np.eye(_TERMS)).T @ (both[:-1] - both[-1]), both[-1]

    def _computed(self, lengths: Array) -> PartMaps:
        """Maps by a linear system for each length."""
        n, scale, h = len(self._a), self._scale, lengths[:, None, None]
        integrals, whole = _integrals()
        begin = np.diag(1.0 / scale)
        forced = np.concatenate(
            [np.repeat(np.tile(begin, (NODES, 1))[None], lengths.size, axis=0), h * np.kron(integrals, self._b)], axis=2
        )
        states = np.linalg.solve(np.eye(NODES * n) - h * np.kron(integrals, self._a), forced)
        end = h * (np.kron(whole, self._a) @ states)
        end[:, :, n:] += h * np.kron(whole, self._b)
        stored = np.kron(np.eye(NODES), self._c) @ states
        stored[:, :, n:] += np.kron(np.eye(NODES), self._d)
        states *= np.tile(scale, NODES)[:, None]
        steps = np.concatenate([scale[:, None] * end, stored], axis=1)
        return PartMaps(steps[:, :, self._order], states[:, :, self._order])


def basis_at(x: Array) -> Array:
    """Chebyshev polynomials (..., nodes) at places from -1 to 1."""
    found = np.empty((NODES, *x.shape))
    found[0], found[1] = 1.0, x
    for j in range(2, NODES):
        found[j] = 2.0 * x * found[j - 1] - found[j - 2]
    return np.moveaxis(found, 0, -1)


@lru_cache(maxsize=1)
def value_at_start() -> Array:
    """Value of the interpolant at the start of a part, from those at its nodes."""
    return np.where(np.arange(NODES) % 2, -1.0, 1.0) @ transform(np.eye(NODES)).T


def is_resolved(values: Array, noise: float) -> bool:
    """Whether signals are resolved by values (..., nodes, nsignals), to rounding errors of a given size."""
    flat = values.reshape(math.prod(values.shape[:-2]), *values.shape[-2:])
    found = np.abs(np.matmul(transform(np.eye(NODES)).T, flat)).max(axis=0, initial=0.0)
    size = np.where(found.max(axis=0, initial=0.0) > 0.0, found.max(axis=0, initial=0.0), 1.0)
    last, middle = (found[part].max(axis=0, initial=0.0) / size for part in (slice(-2, None), slice(NODES // 2, -2)))
    return bool(np.all((last <= _RESOLVED) | ((last > 0.1 * middle) & (last <= noise))))


@lru_cache(maxsize=1)
def _integrals() -> tuple[Array, Array]:
    """Integrals of the interpolant from the start of a part of unit length to its nodes, and over all of it."""
    coefficients = 0.5 * series.chebint(transform(np.eye(NODES)).T, lbnd=-1.0, axis=0)
    nodes = points(NODES - 1, -1.0, 1.0)
    return series.chebvander(nodes, NODES) @ coefficients, np.asarray(coefficients.sum(axis=0))
