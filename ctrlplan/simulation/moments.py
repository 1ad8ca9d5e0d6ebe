"""Exact response at evenly spaced times by moments of the input, for many states or many segments.

In a step of length h with norm(a) h <= 1 the response to an input w is the series
of a^i b h^(i + 1) times the moments of w over the step, integrals of
sigma^i w/i!, where h sigma is the time to the end of the step. The moments do not
depend on the number of states; they are computed for all steps together, in parts
where a breakpoint lies inside of a step.

Longer steps are halved until they are that short, but only where a breakpoint lies inside
of them, or the input is not resolved. Over the others the response to the Legendre series of the
input is that of the two halves, so that it follows from the shortest steps by doubling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, log2

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.exact import spacing, state_scale
from ctrlplan.simulation.exponential import cancels, doubled, short_change
from ctrlplan.simulation.flow_kernel import gauss_nodes, to_legendre
from ctrlplan.simulation.recurrences import repeated

_MOMENTS = 22
"""Number of moments: 1/22! is below rounding."""

_NODES = 16
"""Number of Gauss nodes of a part of a step."""

_STEPS = 50_000
"""Maximum number of steps."""

_LEVELS = 40
"""Maximum number of halvings of a step."""

_RESOLVED, _NOISE = 1e-15, 1e-10
"""Last Legendre coefficients of an input, relative to the largest value, at which it is resolved, or its rounding."""

Values = Callable[[Array], Array]
"""Maps times (n,) that are no breakpoints to the input (ninputs, n)."""


def moment_states(a: Array, b: Array, values: Values, marks: Array, timepts: Array, initial: Array) -> Array | None:
    """States of x' = a x + b w at evenly spaced sample times.

    Parameters
    ----------
    a, b : ndarray, shapes (nstates, nstates) and (nstates, ninputs)
        The system.
    values : callable
        Maps times (n,) that are no breakpoints to the input (ninputs, n).
    marks : ndarray
        Times [s], increasing, between which the input is analytic.
    timepts : ndarray, shape (ntime,)
        Sample times [s], increasing.
    initial : ndarray, shape (nstates,)
        State at the first of them.

    Returns
    -------
    ndarray, shape (nstates, ntime), or None
        None if times are not evenly spaced, a step would be too short, an input is not
        resolved in a step, or a state overflows.
    """
    first, last = float(timepts[0]), float(timepts[-1])
    sample = spacing(timepts - first, last - first)
    scale = state_scale(a)
    a, b, state = a * (scale / scale[:, None]), b / scale[:, None], initial / scale
    norm = float(np.abs(a).sum(axis=0).max(initial=0.0))
    if not sample or not np.isfinite(norm):
        return None
    levels = max(0, ceil(log2(max(norm * sample, 1e-300))))
    if levels > _LEVELS or timepts.size > _STEPS:
        return None
    step = sample * 0.5**levels
    with np.errstate(all="ignore"):
        changes = _changes(step * a, levels)
        responses = _responses(step * a, step * b)
        cells = _cells(values, marks, first, sample, timepts.size - 1, levels)
        if changes is None or cells is None:
            return None
        forced = _forced(cells, changes, responses)
        found = repeated(state, changes[0], forced, timepts.size - 1)
    states = np.concatenate([initial[:, None], scale[:, None] * found.T], axis=1)
    return states if np.isfinite(states).all() else None


def _changes(a: Array, levels: int) -> list[Array] | None:
    """Changes of states over 2^levels, ..., 2, 1 times a time with a norm of at most 1; None if squares cancel."""
    found = [short_change(a)]
    for _ in range(levels):
        found.append(doubled(found[-1]))
        if cancels(found[-2], found[-2], found[-1]):
            return None
    return found[::-1]


@dataclass(frozen=True)
class _Level:
    """Steps of one length.

    Attributes
    ----------
    whole : ndarray of bool, shape (nsteps,)
        Whether a step is not halved.
    inputs : ndarray, shape (nwhole, nodes * ninputs) or (nwhole, nmoments * ninputs)
        Legendre coefficients of the inputs in those; at the last level their moments.
    """

    whole: NDArray[np.bool_]
    inputs: Array


def _cells(values: Values, marks: Array, first: float, sample: float, count: int, levels: int) -> list[_Level] | None:
    """Steps of each level, from samples to the shortest; None if they are too many, or inputs are not resolved."""
    end = first + sample * count
    tolerance = 4.0 * np.finfo(float).eps * max(abs(first), abs(end))
    marks = marks[(marks > first + tolerance) & (marks < end - tolerance)]
    which, size, found = np.arange(count), None, []
    for level in range(levels):
        step = sample * 0.5**level
        starts, ends = first + step * which, first + step * (which + 1)
        inside = np.searchsorted(marks, ends - tolerance) > np.searchsorted(marks, starts + tolerance, side="right")
        some = ~inside if found else np.ones(which.size, dtype=bool)  # the size of inputs from all steps
        w = values((starts[some, None] + step * gauss_nodes(_NODES)).ravel())
        w = w.reshape(len(w), np.count_nonzero(some), _NODES)
        size = np.abs(w).max(axis=(1, 2), initial=0.0) if size is None else size
        coefficients = w @ to_legendre(_NODES).T
        resolved = _resolved(coefficients, size) & ~inside[some]
        whole = some.copy()
        whole[some] = resolved
        own = coefficients[:, resolved].transpose(1, 2, 0)
        found.append(_Level(whole, own.reshape(len(own), _NODES * len(w))))
        which = (2 * which[~whole, None] + [0, 1]).ravel()
        if which.size > _STEPS or step < 1e3 * tolerance:
            return None
    if size is not None and not which.size:
        return [*found, _Level(np.ones(0, dtype=bool), np.zeros((0, _MOMENTS * size.size)))]
    moments = _moments(values, marks, first, sample * 0.5**levels, which, tolerance, size)
    return None if moments is None else [*found, _Level(np.ones(which.size, dtype=bool), moments)]


def _forced(cells: list[_Level], changes: list[Array], responses: Array) -> Array:
    """Responses (nsteps, n) to the inputs over each sample step, from the shortest steps upwards."""
    n = len(changes[0])
    forced = cells[-1].inputs @ responses
    # Responses (nodes, ninputs * n) to Legendre polynomials over a step, and those over its halves.
    kernel = (_moments_of_legendre() @ responses.reshape(_MOMENTS, -1)) if len(cells) > 1 else np.empty(0)
    early, late = _halves()
    for level, change in zip(cells[-2::-1], changes[:0:-1], strict=True):
        first = kernel.reshape(-1, n)
        first = first + first @ change.T
        kernel = early @ first.reshape(_NODES, -1) + late @ kernel
        both = np.empty((level.whole.size, n))
        both[level.whole] = level.inputs @ kernel.reshape(-1, n)
        left, right = forced[0::2], forced[1::2]
        both[~level.whole] = left + left @ change.T + right
        forced = both
    return forced


@lru_cache(maxsize=1)
def _moments_of_legendre() -> Array:
    """Moments of Legendre polynomials over a step, shape (nodes, nmoments)."""
    weights = 0.5 * legendre.leggauss(_NODES)[1]
    nodes = gauss_nodes(_NODES)
    powers = np.cumprod(
        np.concatenate([np.ones((1, _NODES)), (1.0 - nodes) / np.arange(1.0, _MOMENTS)[:, None]]), axis=0
    )
    return np.asarray((legendre.legvander(2.0 * nodes - 1.0, _NODES - 1) * weights[:, None]).T @ powers.T)


@lru_cache(maxsize=1)
def _halves() -> tuple[Array, Array]:
    """Legendre coefficients of Legendre polynomials on the first and on the second half of a step, transposed."""
    nodes = gauss_nodes(_NODES)
    early, late = (to_legendre(_NODES) @ legendre.legvander(x, _NODES - 1) for x in (nodes - 1.0, nodes))
    return early.T.copy(), late.T.copy()


def _responses(a: Array, b: Array) -> Array:
    """Responses (nmoments * ninputs, n) to the moments of the inputs over a step."""
    terms = [b]
    while len(terms) < _MOMENTS:
        terms.append(a @ terms[-1])
    return np.concatenate([term.T for term in terms])


def _moments(
    values: Values,
    marks: Array,
    first: float,
    step: float,
    which: NDArray[np.intp],
    tolerance: float,
    size: Array | None,
) -> Array | None:
    """Moments (nsteps, nmoments * ninputs) of the inputs over steps; None if they are not resolved."""
    begins, stops = first + step * which, first + step * (which + 1)
    near = np.searchsorted(begins, marks, side="right") - 1
    off = (near >= 0) & (marks > begins[near] + tolerance) & (marks < stops[near] - tolerance)
    starts, owner = np.concatenate([begins, marks[off]]), np.concatenate([np.arange(which.size), near[off]])
    order = np.lexsort((starts, owner))
    starts, owner = starts[order], owner[order]
    ends = np.where(np.append(owner[1:] != owner[:-1], True), stops[owner], np.append(starts[1:], 0.0))
    nodes, weights = gauss_nodes(_NODES), 0.5 * legendre.leggauss(_NODES)[1]
    times = starts[:, None] + (ends - starts)[:, None] * nodes
    w = values(times.ravel())
    w = w.reshape(len(w), *times.shape)
    size = np.abs(w).max(axis=(1, 2), initial=0.0) if size is None else size
    coefficients = np.abs(w @ to_legendre(_NODES).T)
    if not _resolved(coefficients.max(axis=1, keepdims=True, initial=0.0), size).all():
        return None
    sigma = (stops[owner][:, None] - times) / step
    factor = (ends - starts)[:, None] / step * weights
    found = np.empty((starts.size, _MOMENTS, len(w)))
    for i in range(_MOMENTS):
        found[:, i] = np.einsum("kf,mkf->km", factor, w)
        factor = factor * sigma / (i + 1.0)
    total = np.add.reduceat(found, np.searchsorted(owner, np.arange(which.size)), axis=0)
    return total.reshape(which.size, -1)


def _resolved(coefficients: Array, size: Array) -> NDArray[np.bool_]:
    """Whether inputs (nparts,) are resolved by Legendre coefficients (ninputs, nparts, nodes), to rounding."""
    high = np.abs(coefficients[:, :, _NODES // 2 :])
    last, middle = high[:, :, -2:].max(axis=2), high[:, :, :-2].max(axis=2)
    limit = size[:, None]
    return np.asarray(((last <= _RESOLVED * limit) | ((last <= _NOISE * limit) & (last > 0.01 * middle))).all(axis=0))
