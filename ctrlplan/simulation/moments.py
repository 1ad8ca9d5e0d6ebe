"""Exact response at evenly spaced times by moments of the input, for many states or many segments.

In a step of length h with norm(a) h <= 1 the response to an input w is the series
of a^i b h^(i + 1) times the moments of w over the step, integrals of
sigma^i w/i!, where h sigma is the time to the end of the step. The moments do not
depend on the number of states; they are computed for all steps together, in parts
where a breakpoint lies inside of a step.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, log2

import numpy as np
from numpy.polynomial.legendre import leggauss

from ctrlplan._types import Array
from ctrlplan.simulation.exact import spacing, state_scale
from ctrlplan.simulation.flow_kernel import to_legendre
from ctrlplan.simulation.recurrences import repeated

_MOMENTS = 22
"""Number of moments: 1/22! is below rounding."""

_NODES = 16
"""Number of Gauss nodes of a part of a step."""

_STEPS = 50_000
"""Maximum number of steps."""

_RESOLVED, _NOISE = 1e-15, 1e-10
"""Last Legendre coefficients of an input, relative to the largest value, at which it is resolved, or its rounding."""


def moment_states(
    a: Array, b: Array, values: Callable[[Array], Array], marks: Array, timepts: Array, initial: Array
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
    per = 2 ** max(0, ceil(log2(max(norm * sample, 1e-300))))
    count = per * (timepts.size - 1)
    if count > _STEPS:
        return None
    step = sample / per
    moments = _moments(values, marks, first + step * np.arange(count + 1), step)
    if moments is None:
        return None
    with np.errstate(all="ignore"):
        forced = moments @ _responses(step * a, step * b)
        found = repeated(state, _change(step * a), forced, count)[per - 1 :: per]
    states = np.concatenate([initial[:, None], scale[:, None] * found.T], axis=1)
    return states if np.isfinite(states).all() else None


def _change(a: Array) -> Array:
    """exp(a) - 1 for a norm of at most 1, by the Taylor series as a polynomial in a cube."""
    norm, factors = float(np.abs(a).sum(axis=0).max(initial=0.0)), [1.0]
    while factors[-1] > 1e-18 or len(factors) % 3 != 1:
        factors.append(factors[-1] * norm / len(factors))
    terms = 1.0 / np.cumprod(np.arange(1.0, len(factors)))  # of a, a^2, ...
    powers = [a, a @ a]
    powers.append(powers[1] @ a)
    found = np.zeros_like(a)
    for k in range(len(terms) - 3, -1, -3):
        found = terms[k] * a + terms[k + 1] * powers[1] + powers[2] @ (terms[k + 2] * np.eye(len(a)) + found)
    return found


def _responses(a: Array, b: Array) -> Array:
    """Responses (nmoments * ninputs, n) to the moments of the inputs over a step."""
    terms = [b]
    while len(terms) < _MOMENTS:
        terms.append(a @ terms[-1])
    return np.concatenate([term.T for term in terms])


def _moments(values: Callable[[Array], Array], marks: Array, edges: Array, step: float) -> Array | None:
    """Moments (nsteps, nmoments * ninputs) of the inputs over steps between edges; None if they are not resolved."""
    inside = marks[(marks > edges[0]) & (marks < edges[-1])]
    tolerance = 4.0 * np.finfo(float).eps * float(np.abs(edges[[0, -1]]).max())
    near = np.minimum(np.searchsorted(edges, inside), edges.size - 1)
    off = np.minimum(np.abs(edges[near] - inside), np.abs(edges[near - 1] - inside)) > tolerance
    starts = np.sort(np.concatenate([edges[:-1], inside[off]]))
    ends = np.append(starts[1:], edges[-1])
    nodes, weights = leggauss(_NODES)
    times = 0.5 * (starts + ends)[:, None] + 0.5 * (ends - starts)[:, None] * nodes
    w = values(times.ravel())
    w = w.reshape(len(w), *times.shape)
    if not _resolved(w):
        return None
    which = np.searchsorted(edges, 0.5 * (starts + ends), side="right") - 1
    sigma = (edges[which + 1][:, None] - times) / step
    own = 0.5 * (ends - starts)[:, None] / step * weights
    found = np.empty((starts.size, _MOMENTS, len(w)))
    for i in range(_MOMENTS):
        found[:, i] = np.einsum("kf,mkf->km", own, w)
        own = own * sigma / (i + 1.0)
    total = np.add.reduceat(found, np.searchsorted(which, np.arange(edges.size - 1)), axis=0)
    return total.reshape(edges.size - 1, -1)


def _resolved(values: Array) -> bool:
    """Whether inputs are resolved by values (ninputs, nparts, nodes) at Gauss nodes, to rounding."""
    found = np.abs(np.tensordot(values, to_legendre(_NODES)[_NODES // 2 :].T, axes=1)).max(axis=1, initial=0.0)
    size = np.abs(values).max(axis=(1, 2), initial=0.0)
    last, middle = found[:, -2:].max(axis=1), found[:, :-2].max(axis=1)
    return bool(np.all((last <= _RESOLVED * size) | ((last <= _NOISE * size) & (last > 0.1 * middle))))
