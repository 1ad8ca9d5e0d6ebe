"""States after many linear steps, in blocks of them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array

PATTERN = 8
"""Minimum number of repetitions of a pattern of steps that are computed together."""

_LARGE = 64
"""Number of states above which single steps are as fast as blocks of equal ones."""

_TRIED = 64
"""Maximum number of lengths of a pattern that are tried."""

_FEW = 16
"""Number of states up to which blocks of different steps side by side are faster than single steps."""

_TOGETHER = 2**15
"""Number of different steps whose products are stored together."""


def repeated(state: Array, change: Array, forced: Array | None, count: int) -> Array:
    """States (count, nstates, ...) after each of many equal steps x + change x + forced.

    In about sqrt(count) blocks: the responses of all blocks from zero are computed
    together, then the state from block to block.
    """
    n = len(change)
    if n > _LARGE and forced is not None:
        found = np.empty((count, *state.shape))
        for given, after in zip(forced, found, strict=True):
            change.dot(state, out=after)
            after += given
            after += state
            state = after
        return found
    per = min(math.isqrt(count - 1) + 1, max(2, count // max(1, n)))  # powers must not cost more than the steps
    nblocks = -(-count // per)
    inner = np.zeros((nblocks, per, *state.shape))
    powers = np.empty((per, n, n))
    powers[0] = change
    for j in range(1, per):
        powers[j] = powers[j - 1] + change + change @ powers[j - 1]
    if forced is not None:
        steps = np.zeros_like(inner)
        steps.reshape(-1, *state.shape)[:count] = forced
        inner[:, 0] = steps[:, 0]
        for j in range(1, per):
            inner[:, j] = inner[:, j - 1] + inner[:, j - 1] @ change.T + steps[:, j]
    starts = np.empty((nblocks, *state.shape))
    for k in range(nblocks):
        starts[k] = state
        state = state + (powers[-1] @ state + inner[k, -1])
    columns = np.moveaxis(starts, 0, 1).reshape(n, -1)
    inner += np.moveaxis((powers.reshape(per * n, n) @ columns).reshape(per, n, nblocks, *state.shape[1:]), 2, 0)
    inner += starts[:, None]
    return inner.reshape(-1, *state.shape)[:count]


def marched(state: Array, matrices: Array, kinds: NDArray[np.intp], forced: Array, pattern: tuple[int, int]) -> Array:
    """States (nsteps + 1, nstates): the first, and those after each of the steps matrices[kind] x + forced.

    Parameters
    ----------
    state : ndarray, shape (nstates,)
        First state.
    matrices : ndarray, shape (nkinds, nstates, nstates)
        Matrices of the kinds of steps.
    kinds : ndarray of int, shape (nsteps,)
        Kind of each step.
    forced : ndarray, shape (nsteps, nstates)
        What is added after each step.
    pattern : (int, int)
        `pattern_of` the kinds.
    """
    first, length = pattern
    if length:
        return _in_pattern(state, matrices, kinds, forced, first, length)
    if state.size > _FEW or kinds.size < _FEW**2:
        return _one_by_one(state, matrices, kinds, forced)
    found = np.empty((kinds.size + 1, state.size))
    found[0] = state
    for begin in range(0, kinds.size, _TOGETHER):
        some = slice(begin, begin + _TOGETHER)
        after = _in_blocks(found[begin], matrices, kinds[some], forced[some])
        found[begin + 1 : begin + 1 + len(after)] = after
    return found if np.isfinite(found).all() else _one_by_one(state, matrices, kinds, forced)


def pattern_of(kinds: NDArray[np.intp]) -> tuple[int, int]:
    """Step from which a pattern of kinds repeats, and its length; length 0 if it repeats too rarely."""
    for length in _periods(kinds):
        differs = np.flatnonzero(kinds[length:] != kinds[:-length])
        first = int(differs[-1]) + 1 if differs.size else 0
        if kinds.size - first >= PATTERN * length:
            return first, length
    return 0, 0


def _periods(kinds: NDArray[np.intp]) -> list[int]:
    """Distances between the last step and earlier ones of its kind, where the step before is equal as well."""
    if kinds.size < PATTERN:
        return []
    same = (kinds == kinds[-1])[1:] & (kinds[:-1] == kinds[-2])
    places = np.flatnonzero(same) + 1
    found = kinds.size - 1 - places[:-1][::-1]
    return [int(length) for length in found[:_TRIED] if length * PATTERN <= kinds.size]


def _in_pattern(
    state: Array, matrices: Array, kinds: NDArray[np.intp], forced: Array, first: int, length: int
) -> Array:
    """The same for kinds that repeat from step `first` on, by one matrix for a whole pattern."""
    nsteps, n = forced.shape
    count = (nsteps - first) // length
    last = first + count * length
    found = np.empty((nsteps + 1, n))
    found[: first + 1] = _one_by_one(state, matrices, kinds[:first], forced[:first])
    own = matrices[kinds[first : first + length]]
    given = forced[first:last].reshape(count, length, n)
    whole, total = own[0], given[:, 0]
    for j in range(1, length):
        whole, total = own[j] @ whole, total @ own[j].T + given[:, j]
    starts = repeated(found[first], whole - np.eye(n), total, count)
    if length == 1:
        found[first + 1 : last + 1] = starts
    else:
        inside = found[first + 1 : last + 1].reshape(count, length, n)
        now = np.concatenate([found[first : first + 1], starts[:-1]])
        for j in range(length):
            now = now @ own[j].T + given[:, j]
            inside[:, j] = now
    found[last:] = _one_by_one(found[last], matrices, kinds[last:], forced[last:])
    return found


def _in_blocks(state: Array, matrices: Array, kinds: NDArray[np.intp], forced: Array) -> Array:
    """States (nsteps, nstates) after each of many different steps, in about sqrt(nsteps) blocks side by side."""
    nsteps, n = forced.shape
    per = math.isqrt(nsteps - 1) + 1
    nblocks = -(-nsteps // per)
    rest = nblocks * per - nsteps
    which = np.pad(kinds, (0, rest), mode="edge").reshape(nblocks, per)
    given = np.pad(forced, ((0, rest), (0, 0))).reshape(nblocks, per, n)
    products, inner = np.empty((per, nblocks, n, n)), np.empty((per, nblocks, n))
    products[0], inner[0] = matrices[which[:, 0]], given[:, 0]
    for j in range(1, per):
        own = matrices[which[:, j]]
        np.matmul(own, products[j - 1], out=products[j])
        inner[j] = np.matmul(own, inner[j - 1, :, :, None])[..., 0] + given[:, j]
    starts = np.empty((nblocks, n, 1))
    for k in range(nblocks):
        starts[k, :, 0] = state
        state = products[-1, k] @ state + inner[-1, k]
    found = np.matmul(products, starts)[..., 0] + inner
    return found.swapaxes(0, 1).reshape(-1, n)[:nsteps]


def _one_by_one(state: Array, matrices: Array, kinds: NDArray[np.intp], forced: Array) -> Array:
    """The same, one step after the other."""
    found = np.empty((len(forced) + 1, state.size))
    found[0] = state
    each = list(matrices)
    for k, kind in enumerate(kinds.tolist()):
        after = found[k + 1]
        each[kind].dot(found[k], out=after)
        after += forced[k]
    return found
