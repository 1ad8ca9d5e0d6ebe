"""States after many linear steps, in blocks of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array

_PATTERN = 8
"""Minimum number of repetitions of a pattern of steps that are computed together."""

_LARGE = 100
"""Number of states above which single steps are as fast as blocks of equal ones."""

_TRIED = 64
"""Maximum number of lengths of a pattern that are tried."""

_FEW = 16
"""Number of states up to which blocks of different steps side by side are faster than single steps."""

_TOGETHER = 2**15
"""Number of different steps whose products are stored together."""

_TABLE = 4_000_000
"""Maximum number of entries of the matrix of a part with delay lines."""

_STEPS, _PASSES = 512, 4
"""Minimum number of steps from which growth is estimated where there is no pattern, and that of passes of a line."""


def repeated(state: Array, change: Array, forced: Array | None, count: int) -> Array:
    """States (count, nstates, ...) after each of many equal steps x + change x + forced.

    In about sqrt(count) blocks: the responses of all blocks from zero are computed
    together, then the state from block to block.
    """
    n = len(change)
    if n > _LARGE and forced is not None:
        found = np.empty((count, *state.shape))
        for k in range(count):
            state = state + (change @ state + forced[k])
            found[k] = state
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


def marched(state: Array, matrices: Array, kinds: NDArray[np.intp], forced: Array) -> Array:
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
    """
    first, length = _pattern(kinds)
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


@dataclass(frozen=True, eq=False)
class DelayLine:
    """Values that return to the states some samples later.

    Attributes
    ----------
    count : int
        Number of samples after which a value returns.
    places : ndarray of int
        Indices of the states after which values are taken, and at which earlier ones return.
    initial : ndarray, shape (width,)
        What returns before the first value.
    out : ndarray, shape (width, nstates)
        Values from the states.
    given : ndarray, shape (nplaces, width)
        What is added to the values.
    into : ndarray, shape (nplaces, nstates, width)
        Change of the states by what returns; a broadcast view if it is the same for all.
    """

    count: int
    places: NDArray[np.intp]
    initial: Array
    out: Array
    given: Array
    into: Array

    @property
    def reach(self) -> int:
        """Number of steps after which a value returns, at most about; 0 if none does."""
        return int(np.diff(self.places[[0, self.count]])[0]) if self.places.size > self.count else 0

    def unforced(self, nsteps: int) -> DelayLine:
        """The same over the first steps, without what is added to the values, and from zero."""
        count = int(np.searchsorted(self.places, nsteps, side="right"))
        zero = np.zeros_like(self.given[:count])
        return replace(self, places=self.places[:count], initial=0.0 * self.initial, given=zero, into=self.into[:count])

    @property
    def at_start(self) -> bool:
        """Whether a value is taken from the first state."""
        return bool(self.places.size and self.places[0] == 0)

    def returning(self, values: Array, some: slice) -> Array:
        """What returns (n, width) at some places."""
        begin, end = some.start - self.count, some.stop - self.count
        if begin >= 0:
            return values[begin:end]
        initial = np.broadcast_to(self.initial, (min(-begin, end - begin), self.initial.size))
        return np.concatenate([initial, values[: max(0, end)]])

    def between(self, begin: int, end: int) -> slice:
        """Numbers of the places after one state and up to another."""
        return slice(*np.searchsorted(self.places, [begin, end], side="right").tolist())


def marched_with_lines(
    state: Array, matrices: Array, kinds: NDArray[np.intp], forced: Array, lines: Sequence[DelayLine]
) -> Array:
    """The same as `marched` with delay lines, of which the first state already has what returns there."""
    if not lines:
        return marched(state, matrices, kinds, forced)
    nsteps, n = forced.shape
    found = np.empty((nsteps + 1, n))
    found[0] = state
    values = [np.empty_like(line.given) for line in lines]
    for line, own in zip(lines, values, strict=True):
        if line.at_start:
            own[0] = line.out @ state + line.given[0]
    first, length = _pattern(kinds)
    begin = 0
    while begin < nsteps:
        # What returns within a part was taken before it.
        ends = [line.places[line.between(-1, begin).stop + line.count :][:1] for line in lines]
        end = min([nsteps, *(int(own[0]) - 1 for own in ends if own.size)])
        if length and begin >= first and end - begin >= length:
            end = begin + (end - begin) // length * length
            count = (nsteps - begin) // (end - begin)
            if count >= _PATTERN and (end - begin) * n * (n + sum(line.count for line in lines)) < _TABLE:
                begin = _by_table(found, values, matrices, kinds, forced, lines, begin, end - begin, count)
                continue
        given = forced[begin:end].copy()
        which = [line.between(begin, end) for line in lines]
        for line, own, some in zip(lines, values, which, strict=True):
            given[line.places[some] - 1 - begin] += np.matmul(line.into[some], line.returning(own, some)[..., None])[
                ..., 0
            ]
        found[begin + 1 : end + 1] = marched(found[begin], matrices, kinds[begin:end], given)[1:]
        for line, own, some in zip(lines, values, which, strict=True):
            own[some] = found[line.places[some]] @ line.out.T + line.given[some]
        begin = end
    return found


def _by_table(
    found: Array,
    values: list[Array],
    matrices: Array,
    kinds: NDArray[np.intp],
    forced: Array,
    lines: Sequence[DelayLine],
    begin: int,
    size: int,
    count: int,
) -> int:
    """Compute `count` equal parts of `size` steps: one matrix maps the start of a part to its end and what is taken.

    The states inside of all parts follow together from their starts.
    """
    n, last = found.shape[1], begin + size * count
    own, which = matrices[kinds[begin : begin + size]], [line.between(begin, begin + size) for line in lines]
    given = forced[begin:last].reshape(count, size, n).transpose(1, 0, 2).copy()
    sizes = [some.stop - some.start for some in which]
    columns = np.cumsum([n, *(m * line.given.shape[1] for m, line in zip(sizes, lines, strict=True))]).tolist()
    places = list(zip(lines, values, which, sizes, columns[:-1], columns[1:], strict=True))
    whole, total = _lifted(own, given, lines, which, columns, begin)
    state, starts = found[begin], np.empty((count, columns[-1]))
    for part, start in enumerate(starts):
        parts = [slice(some.start + part * m, some.stop + part * m) for some, m in zip(which, sizes, strict=True)]
        start[:n] = state
        for (line, earlier, *_, column, end), now in zip(places, parts, strict=True):
            start[column:end] = line.returning(earlier, now).ravel()
        after = whole @ start + total[part]
        state = after[:n]
        for (_, earlier, _, m, column, end), now in zip(places, parts, strict=True):
            earlier[now] = after[column:end].reshape(m, -1)
    for line, _, some, m, column, end in places:
        back = starts[:, column:end].reshape(count, m, -1).transpose(1, 2, 0)
        given[line.places[some] - 1 - begin] += np.matmul(line.into[some], back).transpose(0, 2, 1)
    states, inside = starts[:, :n], np.empty_like(given)
    for matrix, add, after in zip(own.transpose(0, 2, 1), given, inside, strict=True):
        np.matmul(states, matrix, out=after)
        after += add
        states = after
    found[begin + 1 : last + 1].reshape(count, size, n)[:] = inside.transpose(1, 0, 2)
    return last


def _lifted(
    matrices: Array,
    given: Array,
    lines: Sequence[DelayLine],
    which: Sequence[slice],
    columns: Sequence[int],
    begin: int,
) -> tuple[Array, Array]:
    """Matrix from a state and what returns in a part to the state after it and what is taken, and what is added.

    Parameters
    ----------
    matrices, given : ndarray, shapes (size, n, n) and (size, count, n)
        Steps of a part, and what is added after each step of all parts.
    lines, which : sequences of DelayLine and of slice
        Lines, and the numbers of their places in the first part.
    columns : sequence of int
        First column of what returns from each line.
    begin : int
        Step before the first part.

    Returns
    -------
    (ndarray, ndarray), shapes (ncolumns, ncolumns) and (count, ncolumns)
    """
    count, n = given.shape[1:]
    known, inner = np.eye(n, columns[-1]), np.zeros((count, n))
    taken, added, due = list[Array](), list[Array](), list[dict[int, int]]()
    for line, some in zip(lines, which, strict=True):
        width, m = line.given.shape[1], some.stop - some.start
        taken.append(np.empty((m, width, columns[-1])))
        added.append(line.given[some.start : some.start + m * count].reshape(count, m, width).copy())
        due.append({step: k for k, step in enumerate((line.places[some] - 1 - begin).tolist())})
    for j, (matrix, add) in enumerate(zip(matrices, given, strict=True)):
        known, inner = matrix @ known, inner @ matrix.T
        inner += add
        now = [(i, steps[j]) for i, steps in enumerate(due) if j in steps]
        for i, k in now:
            width = lines[i].given.shape[1]
            known[:, columns[i] + k * width : columns[i] + (k + 1) * width] += lines[i].into[which[i].start + k]
        for i, k in now:
            np.matmul(lines[i].out, known, out=taken[i][k])
            added[i][:, k] += inner @ lines[i].out.T
    whole = np.concatenate([known, *(rows.reshape(-1, columns[-1]) for rows in taken)])
    return whole, np.concatenate([inner, *(rows.reshape(count, -1) for rows in added)], axis=1)


def growth(matrices: Array, kinds: NDArray[np.intp], lines: Sequence[DelayLine] = ()) -> float:
    """Growth of a perturbation of the states over the steps of given kinds, about; infinite if it overflows."""
    first, length = _pattern(kinds)
    n = matrices.shape[1]
    with np.errstate(all="ignore"):
        if length and not lines:
            whole = np.eye(n)
            for kind in kinds[first : first + length].tolist():
                whole = matrices[kind] @ whole
            found = np.linalg.matrix_power(whole, (kinds.size - first) // length)
            return float(np.nan_to_num(np.abs(found), nan=np.inf).max(initial=0.0))
        count = min(kinds.size, max([_STEPS, *(_PASSES * line.reach for line in lines)]))
        some = kinds[:count] if lines else kinds[-count:]
        start = np.asarray(np.random.default_rng(0).standard_normal(n))
        zero = np.zeros((count, n))
        free = np.abs(marched_with_lines(start, matrices, some, zero, [line.unforced(count) for line in lines]))
        half = count // 2
        ratio = free[half:].max(initial=0.0) / max(float(free[: half + 1].max(initial=0.0)), 1e-300)
        return float(ratio ** (kinds.size / max(1, half)))


def _pattern(kinds: NDArray[np.intp]) -> tuple[int, int]:
    """Step from which a pattern of kinds repeats, and its length; length 0 if it repeats too rarely."""
    for length in _periods(kinds):
        differs = np.flatnonzero(kinds[length:] != kinds[:-length])
        first = int(differs[-1]) + 1 if differs.size else 0
        if kinds.size - first >= _PATTERN * length:
            return first, length
    return 0, 0


def _periods(kinds: NDArray[np.intp]) -> list[int]:
    """Distances between the last step and earlier ones of its kind, where the step before is equal as well."""
    if kinds.size < _PATTERN:
        return []
    same = (kinds == kinds[-1])[1:] & (kinds[:-1] == kinds[-2])
    places = np.flatnonzero(same) + 1
    found = kinds.size - 1 - places[:-1][::-1]
    return [int(length) for length in found[:_TRIED] if length * _PATTERN <= kinds.size]


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
