"""Many linear steps of different kinds, with values that return to the states some steps later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.recurrences import PATTERN, marched, pattern_of

_TABLE = 4_000_000
"""Maximum number of entries of the matrix of a part with delay lines."""

_KEPT = 2**18
"""Maximum number of entries of such a matrix that is kept for further runs."""

_STEPS, _PASSES = 512, 4
"""Minimum number of steps from which growth is estimated where there is no pattern, and that of passes of a line."""


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
    into : ndarray, shape (nkinds, nstates, width)
        Changes of the states by what returns.
    kinds : ndarray of int, shape (nplaces,)
        Which of them applies at each place.
    """

    count: int
    places: NDArray[np.intp]
    initial: Array
    out: Array
    into: Array
    kinds: NDArray[np.intp]

    @property
    def width(self) -> int:
        """Number of values of a sample."""
        return self.initial.size

    @property
    def reach(self) -> int:
        """Number of steps after which a value returns, at most about; 0 if none does."""
        return int(np.diff(self.places[[0, self.count]])[0]) if self.places.size > self.count else 0

    def unforced(self, nsteps: int) -> DelayLine:
        """The same over the first steps, from zero."""
        count = int(np.searchsorted(self.places, nsteps, side="right"))
        return replace(self, places=self.places[:count], initial=0.0 * self.initial, kinds=self.kinds[:count])

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


@dataclass(frozen=True, eq=False)
class Steps:
    """Linear steps of different kinds, in order, with delay lines.

    Attributes
    ----------
    matrices : ndarray, shape (nkinds, nstates, nstates)
        Matrices of the kinds of steps.
    kinds : ndarray of int, shape (nsteps,)
        Kind of each step.
    lines : tuple of DelayLine
        Delay lines.
    """

    matrices: Array
    kinds: NDArray[np.intp]
    lines: tuple[DelayLine, ...] = ()
    _tables: dict[tuple[int, int], _Table] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def pattern(self) -> tuple[int, int]:
        """Step from which a pattern of kinds repeats, and its length; length 0 if it repeats too rarely."""
        return pattern_of(self.kinds)

    def growth(self) -> float:
        """Growth of a perturbation of the states over the steps, about; infinite if it overflows."""
        first, length = self.pattern
        n, kinds, lines = self.matrices.shape[1], self.kinds, self.lines
        with np.errstate(all="ignore"):
            if length and not lines:
                whole = np.eye(n)
                for kind in kinds[first : first + length].tolist():
                    whole = self.matrices[kind] @ whole
                found = np.linalg.matrix_power(whole, (kinds.size - first) // length)
                return float(np.nan_to_num(np.abs(found), nan=np.inf).max(initial=0.0))
            count = min(kinds.size, max([_STEPS, *(_PASSES * line.reach for line in lines)]))
            some = kinds[:count] if lines else kinds[-count:]
            free = Steps(self.matrices, some, tuple(line.unforced(count) for line in lines))
            zero = [np.zeros((line.places.size, line.width)) for line in free.lines]
            start = np.asarray(np.random.default_rng(0).standard_normal(n))
            states = np.abs(free.marched(start, np.zeros((count, n)), zero))
            half = count // 2
            ratio = states[half:].max(initial=0.0) / max(float(states[: half + 1].max(initial=0.0)), 1e-300)
            return float(ratio ** (kinds.size / max(1, half)))

    def marched(self, state: Array, forced: Array, given: Sequence[Array] = ()) -> Array:
        """States (nsteps + 1, nstates): the first, and those after each of the steps matrices[kind] x + forced.

        Parameters
        ----------
        state : ndarray, shape (nstates,)
            First state; it already has what the lines return there.
        forced : ndarray, shape (nsteps, nstates)
            What is added after each step.
        given : sequence of ndarray, shapes (nplaces, width)
            What is added to the values of each line.
        """
        if not self.lines:
            return marched(state, self.matrices, self.kinds, forced, self.pattern)
        nsteps, n = forced.shape
        found = np.empty((nsteps + 1, n))
        found[0] = state
        values = [np.empty_like(own) for own in given]
        for line, own, add in zip(self.lines, values, given, strict=True):
            if line.at_start:
                own[0] = line.out @ state + add[0]
        begin = 0
        while begin < nsteps:
            end, count = self._part(begin)
            if count:
                begin = self._by_table(found, values, forced, given, begin, end - begin, count)
            else:
                self._at_once(found, values, forced, given, slice(begin, end))
                begin = end
        return found

    def _part(self, begin: int) -> tuple[int, int]:
        """End of a part in which nothing returns that was taken in it; number of equal parts for a table, or 0."""
        (first, length), nsteps, n = self.pattern, self.kinds.size, self.matrices.shape[1]
        ends = [line.places[line.between(-1, begin).stop + line.count :][:1] for line in self.lines]
        end = min([nsteps, *(int(own[0]) - 1 for own in ends if own.size)])
        if not length or begin < first or end - begin < length:
            return end, 0
        end = begin + (end - begin) // length * length
        count = (nsteps - begin) // (end - begin)
        small = (end - begin) * n * (n + sum(line.count for line in self.lines)) < _TABLE
        return end, count if count >= PATTERN and small else 0

    def _at_once(self, found: Array, values: list[Array], forced: Array, given: Sequence[Array], part: slice) -> None:
        """Compute the states of a part."""
        begin, end = part.start, part.stop
        every, kinds = forced[part].copy(), self.kinds[part]
        which = [line.between(begin, end) for line in self.lines]
        for line, own, some in zip(self.lines, values, which, strict=True):
            back = line.returning(own, some)[..., None]
            every[line.places[some] - 1 - begin] += np.matmul(line.into[line.kinds[some]], back)[..., 0]
        found[begin + 1 : end + 1] = marched(found[begin], self.matrices, kinds, every, pattern_of(kinds))[1:]
        for line, own, add, some in zip(self.lines, values, given, which, strict=True):
            own[some] = found[line.places[some]] @ line.out.T + add[some]

    def _by_table(
        self,
        found: Array,
        values: list[Array],
        forced: Array,
        given: Sequence[Array],
        begin: int,
        size: int,
        count: int,
    ) -> int:
        """Compute `count` equal parts of `size` steps; one matrix maps a start to the end and what is taken.

        The states inside of all parts follow together from their starts.
        """
        n, last = found.shape[1], begin + size * count
        table = self._table(begin, size)
        every = forced[begin:last].reshape(count, size, n).transpose(1, 0, 2).copy()
        inside = np.empty_like(every)
        _all_parts(table.matrices, None, every, inside)  # the parts from zero
        total = [inside[-1]]
        for line, add, at, some in zip(self.lines, given, table.at, table.which, strict=True):
            taken = (inside[at] @ line.out.T).transpose(1, 0, 2).reshape(count, -1)
            total.append(taken + add[some.start : some.start + at.size * count].reshape(count, -1))
        starts = self._starts(table, found[begin], values, np.concatenate(total, axis=1))
        for line, at, some, own in zip(self.lines, table.at, table.which, table.columns, strict=True):
            back = starts[:, own].reshape(count, at.size, -1).transpose(1, 2, 0)
            every[at] += np.matmul(line.into[line.kinds[some]], back).transpose(0, 2, 1)
        _all_parts(table.matrices, starts[:, :n], every, inside)
        found[begin + 1 : last + 1].reshape(count, size, n)[:] = inside.transpose(1, 0, 2)
        return last

    def _starts(self, table: _Table, state: Array, values: list[Array], total: Array) -> Array:
        """States at the starts of equal parts and what returns in them (count, ncolumns); fill what is taken."""
        n, starts = state.size, np.empty_like(total)
        places = list(zip(self.lines, values, table.which, table.at, table.columns, strict=True))
        for part, start in enumerate(starts):
            start[:n] = state
            for line, earlier, some, at, own in places:
                shift = part * at.size
                start[own] = line.returning(earlier, slice(some.start + shift, some.stop + shift)).ravel()
            after = table.whole @ start + total[part]
            state = after[:n]
            for _, earlier, some, at, own in places:
                shift = part * at.size
                earlier[some.start + shift : some.stop + shift] = after[own].reshape(at.size, -1)
        return starts

    def _table(self, begin: int, size: int) -> _Table:
        found = self._tables.get((begin, size))
        if found is None:
            found = _table(self, begin, size)
            if found.whole.size <= _KEPT:
                self._tables[begin, size] = found
        return found


@dataclass(frozen=True, eq=False)
class _Table:
    """Equal parts of many steps.

    Attributes
    ----------
    matrices : ndarray, shape (size, nstates, nstates)
        Steps of a part.
    which : list of slice
        For each line, the numbers of its places in the first part.
    at : list of ndarray of int
        The steps at which they are.
    columns : list of slice
        Places of what returns from each line, after the state.
    whole : ndarray, shape (ncolumns, ncolumns)
        Matrix from a state and what returns in a part to the state after it and what is taken.
    """

    matrices: Array
    which: list[slice]
    at: list[NDArray[np.intp]]
    columns: list[slice]
    whole: Array


def _table(steps: Steps, begin: int, size: int) -> _Table:
    matrices, lines = steps.matrices[steps.kinds[begin : begin + size]], steps.lines
    which = [line.between(begin, begin + size) for line in lines]
    at = [line.places[some] - 1 - begin for line, some in zip(lines, which, strict=True)]
    n = matrices.shape[1]
    ends = np.cumsum([n, *(own.size * line.width for own, line in zip(at, lines, strict=True))]).tolist()
    taken = [np.empty((own.size, line.width, ends[-1])) for own, line in zip(at, lines, strict=True)]
    due = [{step: k for k, step in enumerate(own.tolist())} for own in at]
    known = np.eye(n, ends[-1])
    for j, matrix in enumerate(matrices):
        known = matrix @ known
        now = [(i, own[j]) for i, own in enumerate(due) if j in own]
        for i, k in now:
            width = lines[i].width
            known[:, ends[i] + k * width : ends[i] + (k + 1) * width] += lines[i].into[
                lines[i].kinds[which[i].start + k]
            ]
        for i, k in now:
            np.matmul(lines[i].out, known, out=taken[i][k])
    whole = np.concatenate([known, *(rows.reshape(-1, ends[-1]) for rows in taken)])
    columns = [slice(first, last) for first, last in pairwise(ends)]
    return _Table(matrices, which, at, columns, whole)


def _all_parts(matrices: Array, states: Array | None, forced: Array, inside: Array) -> None:
    """States (size, count, nstates) after each step of many parts, from those at their starts; None for zero."""
    for matrix, add, after in zip(matrices.transpose(0, 2, 1), forced, inside, strict=True):
        if states is None:
            after[:] = add
        else:
            np.matmul(states, matrix, out=after)
            after += add
        states = after
