"""Path length of plans with several axes.

The velocity is smooth between breakpoints: evaluations at few times determine its
interpolant on each segment. The speed is not smooth where the path nearly stops.
There it is integrated on finer panels, from the interpolant.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array, readonly
from ctrlplan.trajectories.quadrature import gauss

_COUNT, _RESOLVED, _DIVISIONS = 48, 1e-11, 5
"""Number of nodes of the interpolant of the velocity on a segment, the last Legendre coefficients, relative to the
length of the segment, above which the segment is divided in quarters, and how often."""

_NODES, _PANELS = 16, 32
"""Number of nodes of a panel, and number of panels of an interpolant."""

_TOGETHER = 128
"""Number of segments that are integrated together, for less memory."""

_ROUGH, _PASSES = 3e-8, 6
"""Last Legendre coefficients of the speed, relative to the length of the segment, above which a panel is divided, and
how often."""

_GRADED = np.array([0.0, *0.1 ** np.arange(4.0)[::-1]])
"""Ends of the finer panels on one side of a minimum of the speed, as parts of the distance to the end of the panel."""
_BEFORE = 1.0 - _GRADED[:0:-1]


def arc_lengths(plans: Sequence[Trajectory]) -> Array:
    """Path lengths (nplans,) of plans with the same number of axes, by quadrature of the speed of all together."""
    nodes, weights = gauss(_COUNT)
    velocity = np.concatenate([plan.at_fractions(nodes, 1) for plan in plans], axis=1)
    low = np.concatenate([plan.breakpoints[:-1] for plan in plans])
    width = np.concatenate([plan.breakpoints[1:] for plan in plans]) - low
    owner = np.arange(len(plans)).repeat([plan.breakpoints.size - 1 for plan in plans])
    lengths = width * (_speed(velocity) @ weights)
    means = _sums(lengths, owner, len(plans)) / np.maximum(np.bincount(owner, minlength=len(plans)), 1)
    found, whole = np.zeros(len(plans)), np.maximum(lengths, means[owner])
    for _ in range(_DIVISIONS):
        rough = width * np.abs(velocity @ _LAST_OF_VELOCITY).max(axis=(0, 2)) > _RESOLVED * whole
        if not rough.any():
            break
        ready = ~rough
        found += _sums(_lengths(velocity[:, ready], width[ready], whole[ready]), owner[ready], len(plans))
        low = (low[rough, None] + width[rough, None] * np.arange(0.0, 1.0, 0.25)).ravel()
        width, whole, owner = (0.25 * width[rough]).repeat(4), whole[rough].repeat(4), owner[rough].repeat(4)
        times = low[:, None] + width[:, None] * nodes
        velocity = np.concatenate([plans[k](times[owner == k], 1) for k in np.unique(owner).tolist()], axis=1)
    return found + _sums(_lengths(velocity, width, whole), owner, len(plans))


def _sums(values: Array, places: NDArray[np.intp], count: int) -> Array:
    """Sums (count,) of values by their place."""
    return np.asarray(np.bincount(places, values, count), dtype=float)


def _lengths(velocity: Array, width: Array, whole: Array) -> Array:
    """Path lengths (nsegments,) on segments or parts of them, few at a time; as `_lengths_of_few`."""
    found = np.empty(width.size)
    for begin in range(0, width.size, _TOGETHER):
        part = slice(begin, begin + _TOGETHER)
        found[part] = _lengths_of_few(velocity[:, part], width[part], whole[part])
    return found


def _lengths_of_few(velocity: Array, width: Array, whole: Array) -> Array:
    """Path lengths (nsegments,) on segments or parts of them.

    Parameters
    ----------
    velocity : ndarray, shape (naxes, nsegments, 48)
        At the nodes of each.
    width, whole : ndarray, shape (nsegments,)
        Duration of each, and length of the whole segment.
    """
    nodes, weights = gauss(_NODES)
    velocity = (velocity @ _ON_PANELS).reshape(len(velocity), -1, _NODES)
    least = (_ROUGH * whole).repeat(_PANELS)
    speed, own = _speed(velocity), (width / _PANELS).repeat(_PANELS)
    # Panel of each part, and its begin and width relative to that panel.
    panel, low, part = np.arange(least.size), np.zeros(least.size), np.ones(least.size)
    found = np.zeros(width.size)
    for division in range(_PASSES + 1):
        lengths = part * own[panel] * (speed @ weights)
        rough = (part * own[panel] * np.abs(speed @ _LAST).max(axis=1) > least[panel]).nonzero()[0]
        if division == _PASSES or not rough.size:
            break
        lengths[rough] = 0.0
        found += _sums(lengths, panel // _PANELS, width.size)
        edges = low[rough, None] + part[rough, None] * _graded(speed[rough])
        panel, low = panel[rough].repeat(edges.shape[1] - 1), edges[:, :-1].ravel()
        part = edges[:, 1:].ravel() - low
        speed = _speed(_interpolated(velocity, panel, low[:, None] + part[:, None] * nodes))
    return found + _sums(lengths, panel // _PANELS, width.size)


def _speed(velocity: Array) -> Array:
    """Magnitude (npanels, ntime) of velocities (naxes, npanels, ntime)."""
    return np.asarray(np.sqrt(np.einsum("apt,apt->pt", velocity, velocity)))


def _graded(speed: Array) -> Array:
    """Ends (npanels, 9) of finer panels, graded towards the minimum of the speed (npanels, 16)."""
    squares = speed * speed
    slopes = (squares[:, 1:] - squares[:, :-1]) * _GAPS
    row, middle = np.arange(len(speed)), np.minimum(np.maximum(squares.argmin(axis=1), 1), _NODES - 2)
    fall = slopes[row, middle - 1]
    curve = (slopes[row, middle] - fall) * _SPREADS[middle - 1]
    # The vertex of the parabola through three values; the middle one for straight lines.
    bent = curve > 0.0
    vertex = np.where(bent, _MIDDLES[middle - 1] - 0.5 * fall / np.where(bent, curve, 1.0), gauss(_NODES)[0][middle])
    minimum = np.minimum(np.maximum(vertex, 0.0), 1.0)[:, None]
    return np.concatenate([minimum * _BEFORE, minimum + (1.0 - minimum) * _GRADED], axis=1)


def _interpolated(velocity: Array, panel: NDArray[np.intp], x: Array) -> Array:
    """Velocity (naxes, nparts, ntime) at relative times (nparts, ntime) in some panels."""
    return np.asarray((_cardinal(x, _NODES) @ velocity[:, panel].transpose(1, 2, 0)).transpose(2, 0, 1))


def _cardinal(x: Array, count: int) -> Array:
    """Matrices (..., ntime, count) from values at the nodes to those of interpolants at relative times (..., ntime)."""
    nodes, _ = gauss(count)
    beyond = x[..., None] - nodes
    beyond[beyond == 0.0] = np.finfo(float).tiny  # at a node its own weight is all that counts
    shares = _barycentric(count) / beyond
    shares /= shares.sum(axis=-1, keepdims=True)
    return np.asarray(shares)


@lru_cache(maxsize=4)
def _barycentric(count: int) -> Array:
    """Barycentric weights of the nodes."""
    nodes, weights = gauss(count)
    found = np.sqrt(nodes * (1.0 - nodes) * weights)
    found[1::2] *= -1.0
    return found


def _last_legendre(count: int) -> Array:
    """Matrix (count, 2) from values at the nodes to the last two Legendre coefficients."""
    nodes, weights = gauss(count)
    functions = np.polynomial.legendre.legvander(2.0 * nodes - 1.0, count - 1)[:, -2:]
    return readonly(functions * weights[:, None] * (2.0 * np.arange(count - 2, count) + 1.0))


_GAPS = readonly(1.0 / np.diff(gauss(_NODES)[0]))
_SPREADS = readonly(1.0 / (gauss(_NODES)[0][2:] - gauss(_NODES)[0][:-2]))
_MIDDLES = readonly(0.5 * (gauss(_NODES)[0][1:-1] + gauss(_NODES)[0][:-2]))
"""Of neighbouring nodes: inverse of the distance of two, of the outer ones of three, and the middle of two."""
_LAST, _LAST_OF_VELOCITY = _last_legendre(_NODES), _last_legendre(_COUNT)
_ON_PANELS = readonly(_cardinal((np.arange(_PANELS)[:, None] + gauss(_NODES)[0]).ravel() / _PANELS, _COUNT).T.copy())
"""Matrix (48, 256) from values at the nodes of a segment to those at the nodes of its panels."""
