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
from ctrlplan.simulation.analytic_segments import spacing
from ctrlplan.simulation.exact import state_scale
from ctrlplan.simulation.exponential import cancels, doubled, short_change
from ctrlplan.simulation.flow_kernel import gauss_nodes, to_legendre
from ctrlplan.simulation.recurrences import repeated

_MOMENTS = 22
"""Number of moments: 1/22! is below rounding."""

_NODES = 16
"""Number of Gauss nodes of a part of a step."""

_STEPS = 50_000
"""Maximum number of steps."""

_LEVELS, _MORE = 40, 7
"""Maximum number of halvings of a step for its length, and number of attempts with one more for the inputs."""

_RESOLVED, _NOISE = 1e-15, 1e-10
"""Last Legendre coefficients of an input, relative to the largest value, at which it is resolved, or its rounding."""

Values = Callable[[Array], Array]
"""Maps times (n,) that are no breakpoints to the input (ninputs, n)."""


def moment_states(
    a: Array,
    b: Array,
    values: Values,
    marks: Array,
    timepts: Array,
    initial: Array,
    scale: Array | None = None,
) -> Array | None:
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
    scale : ndarray, shape (nstates,), optional
        Balancing scale of the system matrix, if it is known.

    Returns
    -------
    ndarray, shape (nstates, ntime), or None
        None if times are not evenly spaced, a step would be too short, an input is not
        resolved in a step, or a state overflows.
    """
    first, last = float(timepts[0]), float(timepts[-1])
    sample = spacing(timepts - first, last - first)
    scale = state_scale(a) if scale is None else scale
    a, b, state = a * (scale / scale[:, None]), b / scale[:, None], initial / scale
    norm = float(np.abs(a).sum(axis=0).max(initial=0.0))
    if not sample or not np.isfinite(norm):
        return None
    levels = max(0, ceil(log2(max(norm * sample, 1e-300))))
    if levels > _LEVELS or timepts.size > _STEPS:
        return None
    with np.errstate(all="ignore"):
        tried = (_cells(values, marks, first, sample, timepts.size - 1, levels + more) for more in range(_MORE))
        cells = next((found for found in tried if found is not None), None)
        if cells is None:
            return None
        step = sample * 0.5 ** (len(cells.levels) - 1)
        changes = _changes(step * a, len(cells.levels) - 1)
        if changes is None:
            return None
        forced = _forced(cells, changes, _responses(step * a, step * b))
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
    inputs : ndarray, shape (nwhole, nnodes * ninputs)
        Legendre coefficients of the inputs in those.
    """

    whole: NDArray[np.bool_]
    inputs: Array


@dataclass(frozen=True)
class _Cells:
    """Steps of all levels, from samples to the shortest.

    Attributes
    ----------
    levels : list of _Level
        The steps.
    moments : ndarray, shape (nsteps, nmoments * ninputs)
        Moments of the inputs over the shortest steps that are not whole.
    """

    levels: list[_Level]
    moments: Array


def _cells(values: Values, marks: Array, first: float, sample: float, count: int, levels: int) -> _Cells | None:
    """Steps of each level; None if they are too many, or inputs are not resolved."""
    end = first + sample * count
    tolerance = 4.0 * np.finfo(float).eps * max(abs(first), abs(end))
    marks = marks[(marks > first + tolerance) & (marks < end - tolerance)]
    if levels and sample * 0.5**levels < 1e3 * tolerance:
        return None
    split = [np.zeros(0, dtype=np.intp) for _ in range(levels)]  # steps in which inputs are not resolved
    while True:
        steps, rest = _halved_steps(marks, (first, sample, tolerance), count, split, levels)
        if max(which.size for which, _ in steps) > _STEPS:
            return None
        ends = [
            (first + s * which[whole], s) for s, (which, whole) in zip(_lengths(sample, levels), steps, strict=True)
        ]
        parts = _Parts.of(marks, rest, (first, sample * 0.5**levels, tolerance))
        starts = np.concatenate([*(start for start, _ in ends), parts.starts])
        spans = np.concatenate([*(np.full(start.size, s) for start, s in ends), parts.ends - parts.starts])
        arranged = np.argsort(starts, kind="stable")  # one call with increasing times is much faster
        w = values((starts[arranged, None] + spans[arranged, None] * gauss_nodes(_NODES)).ravel())
        inputs = np.empty((starts.size, len(w), _NODES))
        inputs[arranged] = w.reshape(len(w), -1, _NODES).transpose(1, 0, 2)
        coefficients = inputs @ to_legendre(_NODES).T
        size = np.abs(inputs).max(axis=(0, 2), initial=0.0)
        places = np.cumsum([start.size for start, _ in ends])
        again = False
        for level, (own, (which, whole)) in enumerate(
            zip(np.split(coefficients, places)[:levels], steps, strict=False)
        ):
            unresolved = which[whole][~_resolved(own, size)]
            split[level], again = np.union1d(split[level], unresolved), again or unresolved.size > 0
        if not again:
            break
    shortest = coefficients[places[levels - 1] if levels else 0 :]
    if not _resolved(np.abs(shortest).max(axis=0, keepdims=True, initial=0.0), size).all():
        return None
    found = [
        _Level(whole, own.transpose(0, 2, 1).reshape(len(own), _NODES * size.size))
        for own, (_, whole) in zip(np.split(coefficients, places)[:-1], steps, strict=True)
    ]
    return _Cells(found, parts.moments(inputs[places[-1] :]))


def _lengths(sample: float, levels: int) -> list[float]:
    """Lengths of the steps of all levels."""
    return [sample * 0.5**level for level in range(levels + 1)]


def _halved_steps(
    marks: Array, grid: tuple[float, float, float], count: int, split: list[NDArray[np.intp]], levels: int
) -> tuple[list[tuple[NDArray[np.intp], NDArray[np.bool_]]], NDArray[np.intp]]:
    """Numbers of the steps of each level and whether they are whole, and the shortest ones with marks inside.

    The grid consists of its first time, the sample spacing and the rounding errors of times.
    """
    first, sample, tolerance = grid
    which, found = np.arange(count), []
    for level, step in enumerate(_lengths(sample, levels)):
        starts, ends = first + step * which, first + step * (which + 1)
        whole = np.searchsorted(marks, ends - tolerance) <= np.searchsorted(marks, starts + tolerance, side="right")
        if level < levels and split[level].size:
            whole &= ~np.isin(which, split[level])
        found.append((which, whole))
        rest = which[~whole]
        which = np.stack([2 * rest, 2 * rest + 1], axis=1).ravel()
    return found, rest


@dataclass(frozen=True)
class _Parts:
    """Parts of the shortest steps between marks.

    Attributes
    ----------
    starts, ends : ndarray, shape (nparts,)
        Their first and last times [s].
    owner : ndarray of int, shape (nparts,)
        Index of the step of each, increasing.
    stops : ndarray, shape (nsteps,)
        Last times [s] of the steps.
    step : float
        Length of a step [s].
    """

    starts: Array
    ends: Array
    owner: NDArray[np.intp]
    stops: Array
    step: float

    @classmethod
    def of(cls, marks: Array, which: NDArray[np.intp], grid: tuple[float, float, float]) -> _Parts:
        """Parts of steps of a grid; it consists of its first time, the length of a step and the errors of times."""
        first, step, tolerance = grid
        begins = np.asarray(first + step * which, dtype=float)
        stops = np.asarray(first + step * (which + 1), dtype=float)
        if not which.size:
            return cls(begins, stops, which, stops, step)
        near = np.searchsorted(begins, marks, side="right") - 1
        off = (near >= 0) & (marks > begins[near] + tolerance) & (marks < stops[near] - tolerance)
        starts, owner = np.concatenate([begins, marks[off]]), np.concatenate([np.arange(which.size), near[off]])
        arranged = np.lexsort((starts, owner))
        starts, owner = starts[arranged], owner[arranged]
        ends = np.where(np.append(owner[1:] != owner[:-1], True), stops[owner], np.append(starts[1:], 0.0))
        return cls(starts, ends, owner, stops, step)

    def moments(self, inputs: Array) -> Array:
        """Moments (nsteps, nmoments * ninputs) over the steps of inputs (nparts, ninputs, nnodes)."""
        count, m = self.starts.size, inputs.shape[1]
        if not count:
            return np.zeros((0, _MOMENTS * m))
        times = self.starts[:, None] + (self.ends - self.starts)[:, None] * gauss_nodes(_NODES)
        sigma = (self.stops[self.owner][:, None] - times) / self.step
        factor = (self.ends - self.starts)[:, None] / self.step * (0.5 * legendre.leggauss(_NODES)[1])
        found = np.empty((count, _MOMENTS, m))
        for i in range(_MOMENTS):
            np.einsum("kf,kmf->km", factor, inputs, out=found[:, i])
            factor *= sigma
            factor /= i + 1.0
        total = np.add.reduceat(found, np.searchsorted(self.owner, np.arange(self.stops.size)), axis=0)
        return total.reshape(self.stops.size, -1)


def _forced(cells: _Cells, changes: list[Array], responses: Array) -> Array:
    """Responses (nsteps, n) to the inputs over each sample step, from the shortest steps upwards."""
    n = responses.shape[1]
    # Responses (nnodes, ninputs * n) to Legendre polynomials over a step, and those over its halves.
    kernel = _moments_of_legendre() @ responses.reshape(_MOMENTS, -1)
    early, late = _halves()
    forced = cells.moments @ responses
    for number in range(len(cells.levels) - 1, -1, -1):
        level = cells.levels[number]
        if number < len(changes) - 1:
            change = changes[number + 1].T
            first = kernel.reshape(-1, n)
            first = first + first @ change
            kernel = early @ first.reshape(_NODES, -1) + late @ kernel
            left, right = forced[0::2], forced[1::2]
            forced = left + left @ change + right
        own = level.inputs @ kernel.reshape(-1, n)
        if forced.size:
            both = np.empty((level.whole.size, n))
            both[level.whole], both[~level.whole] = own, forced
            own = both
        forced = own
    return forced


@lru_cache(maxsize=1)
def _moments_of_legendre() -> Array:
    """Moments of Legendre polynomials over a step, shape (nnodes, nmoments)."""
    nodes, weights = gauss_nodes(_NODES), 0.5 * legendre.leggauss(_NODES)[1]
    factors = (1.0 - nodes) / np.arange(1.0, _MOMENTS)[:, None]
    powers = np.cumprod(np.concatenate([np.ones((1, _NODES)), factors]), axis=0)
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


def _resolved(coefficients: Array, size: Array) -> NDArray[np.bool_]:
    """Whether inputs are resolved in parts (nparts,) by coefficients (nparts, ninputs, nnodes), to rounding."""
    high = np.abs(coefficients[:, :, _NODES // 2 :])
    last, middle = high[:, :, -2:].max(axis=2), high[:, :, :-2].max(axis=2)
    return np.asarray(((last <= _RESOLVED * size) | ((last <= _NOISE * size) & (last > 0.01 * middle))).all(axis=1))
