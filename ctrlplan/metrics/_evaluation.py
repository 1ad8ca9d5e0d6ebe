"""Metrics of several signals at the same times, evaluated together.

What takes time is the number of passes over the samples and, for few signals, the number of calls. Extrema by stretch
exclude nearly all samples from the search for peaks and for entries into a band. Integrals are sums over samples where
the curvature is smooth, and the cubics of all other intervals, whichever metric needs them, are found in one call.
"""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan.metrics._extremes import Sought, bounds, largest, last_beyond, last_entries, search
from ctrlplan.metrics._grid import LONG, Grid
from ctrlplan.metrics._held import Held, Stepped
from ctrlplan.metrics._integrals import areas, rough, squares
from ctrlplan.metrics._pieces import cubics_of_rows
from ctrlplan.metrics._records import HUGE, QUIET, Array, Value, plain, real

Later = Callable[[], Array]

_SAMPLES = 2**19  # of a signal over the rows that are evaluated together, for memory
_SAMPLES_OF_SHORT = 2**16  # the same for short records, whose integrals need the cubics of all intervals


class _Wanted:
    """Rows and levels of extremes, in the order in which they were added."""

    def __init__(self) -> None:
        self._parts, self._size = [(np.empty(0, dtype=np.intp), np.empty(0), np.empty(0, dtype=np.bool_))], 0

    def add(self, rows: slice, levels: Array, flag: bool) -> slice:
        own = np.arange(rows.start, rows.stop)
        self._parts.append((own, np.broadcast_to(levels, own.shape), np.full(own.size, flag)))
        self._size += own.size
        return slice(self._size - own.size, self._size)

    def columns(self) -> tuple[NDArray[np.intp], Array, NDArray[np.bool_]]:
        rows, levels, flags = (np.concatenate(column) for column in zip(*self._parts, strict=True))
        return rows, levels, flags


class Evaluation:
    """Signals at the same times, and what is wanted of them.

    The first value that is read evaluates everything; nothing can be added later.
    """

    def __init__(self, timepts: ArrayLike) -> None:
        self.grid = Grid.of(timepts)
        self._signals, self._count = list[tuple[Array, str, slice]](), 0
        self._held = dict[int, Held]()
        self._edges, self._sides = _Wanted(), _Wanted()
        self._integrals = dict[tuple[Callable[..., Array], int], slice]()

    def add(self, f: Array, name: str, held: Sequence[Held | None] = ()) -> slice:
        """Return the rows of signals (nrows, ntime) without nan; messages call them `name`.

        `held` are the parts of the signals that are held between known times.
        """
        for signal, _, rows in self._signals:
            if signal is f:
                return rows
        rows = slice(self._count, self._count + len(f))
        self._signals.append((f, name, rows))
        for i, part in enumerate(held):
            if part is not None and part.jumps(f[i]):
                self._held[rows.start + i] = part
        self._count = rows.stop
        return rows

    def signals(self, rows: slice) -> Array:
        """Return the signals of some rows that were added together, (nrows, ntime)."""
        return next(real(signal, name) for signal, name, own in self._signals if own == rows)

    def stepped(self, rows: slice) -> dict[int, Stepped]:
        """Return those of the signals that have a held part, by their index among the rows."""
        return {row - rows.start: self._stepped[row] for row in self._held if rows.start <= row < rows.stop}

    def entries(self, rows: slice, edges: Array) -> Later:
        """Return the times from which on the magnitudes of signals are at most their edges, (nrows,).

        -inf if always, inf if a signal is outside after the last sample but one.
        """
        own = self._edges.add(rows, edges, True)
        return lambda: self._with_held(self._found[0][own], rows, lambda f, i: f.entry(float(edges[i])))

    def maxima(self, rows: slice, sides: Array, extrapolated: bool = True) -> Later:
        """Return the maxima of signals times their sides, 1 or -1, or of their magnitudes where the side is 0.

        They are those of all intervals, or of all without those that begin.
        """
        own = self._sides.add(rows, sides, extrapolated)
        return lambda: self._with_held(self._found[1][own], rows, lambda f, i: f.maximum(float(sides[i]), extrapolated))

    def areas(self, rows: slice) -> Later:
        """Return the integrals of magnitudes, and of these times the time since the first sample, (2, nrows)."""
        self._integrals[areas, rows.start] = rows
        return lambda: self._with_held(self._found[2][areas, rows.start], rows, lambda f, _: f.areas())

    def squares(self, rows: slice) -> Later:
        """Return the integrals of squares, (nrows,)."""
        self._integrals[squares, rows.start] = rows
        return lambda: self._with_held(self._found[2][squares, rows.start], rows, lambda f, _: f.square())

    def _with_held(self, found: Array, rows: slice, value: Callable[[Stepped, int], float | Array]) -> Array:
        """Return values (..., nrows) of signals, with those of signals that have a held part in their places."""
        stepped = self.stepped(rows)
        found = found.copy() if stepped else found
        with np.errstate(**QUIET):
            for i, signal in stepped.items():
                found[..., i] = value(signal, i)
        return found

    @cached_property
    def _stepped(self) -> dict[int, Stepped]:
        """Return the signals that have a held part, by row."""
        found = dict[int, Stepped]()
        for f, _, rows in self._signals:
            for i in range(len(f)):
                part = self._held.get(rows.start + i)
                if part is not None:
                    found[rows.start + i] = Stepped.of(self.grid.t, f[i], part)
        return found

    @cached_property
    def _found(self) -> tuple[Array, Array, dict[tuple[Callable[..., Array], int], Array]]:
        """Return entries and maxima in the order in which they were added, and integrals."""
        signals = [signal for signal, _, _ in self._signals]
        f = np.ascontiguousarray(signals[0]) if len(signals) == 1 else np.concatenate(signals)
        if self._held:  # these have cubics of their own
            f = f.copy()
            f[list(self._held)] = 0.0
        with np.errstate(**QUIET):
            limits = bounds(self.grid, f)
            if np.isnan(limits).any():
                for signal, name, _ in self._signals:
                    real(signal, name)
            return self._evaluated(f, limits)

    def _evaluated(self, f: Array, limits: Array) -> tuple[Array, Array, dict[tuple[Callable[..., Array], int], Array]]:
        grid, magnitudes = self.grid, limits.max(axis=0)
        finite = magnitudes.max(axis=1) < HUGE
        rows, edges, _ = self._edges.columns()
        never = (np.abs(f[rows, -1]) > edges) | ~finite[rows]
        first = np.minimum(last_beyond(grid, f, rows, edges, magnitudes[rows]), grid.t.size - 2)
        others, sides, extrapolated = self._sides.columns()
        tops = limits[:, others].max(axis=2, initial=-np.inf)
        top = np.where(sides > 0, tops[0], np.where(sides < 0, tops[1], tops.max(axis=0)))
        sought = Sought(
            np.concatenate([rows, others]),
            np.concatenate([np.zeros(rows.size), sides]),
            np.concatenate([np.where(never, np.nan, edges), np.where(np.isfinite(top), top, np.nan)]),
            np.concatenate([first, np.zeros_like(others)]),
        )
        number, k = search(grid, f, limits, sought) if sought.rows.size else (sought.rows, sought.rows)
        places = [(sought.rows[number], k)]
        for (kind, start), part in self._integrals.items():
            row, at = rough(grid, f[part], finite[part], kind is areas)
            places.append((row + start, at))
        p = cubics_of_rows(grid, f, *(np.concatenate(column) for column in zip(*places, strict=True)))

        middle, end = np.searchsorted(number, rows.size), number.size
        of_extremes, own = p[:end], number[middle:] - rows.size
        entries = last_entries(grid, edges, number[:middle], k[:middle], of_extremes)
        begins = of_extremes.begins[middle:] & ~extrapolated[own]
        maxima = largest(top, sides, own, of_extremes.values[:, middle:], begins)
        integrals = {}
        for ((kind, start), part), (row, at) in zip(self._integrals.items(), places[1:], strict=True):
            begin, end = end, end + at.size
            value = kind(grid, f[part], (row - start, at), p[begin:end])
            integrals[kind, start] = np.where(finite[part], value, np.inf)
        return np.where(never, np.inf, entries), maxima, integrals


def rows_together(ntime: int) -> int:
    """Return how many rows of signals with ntime samples are evaluated together."""
    return max(1, (_SAMPLES if ntime >= LONG else _SAMPLES_OF_SHORT) // ntime)


def evaluated(want: Callable[..., Later], timepts: ArrayLike, signals: Array, name: str, *levels: Array) -> Value:
    """Return a metric of signals (..., ntime): `want` is called with an evaluation, rows and levels (...).

    Rows are evaluated in several parts if they are many.
    """
    lead = signals.shape[:-1]
    rows, own = signals.reshape(-1, signals.shape[-1]), [np.broadcast_to(level, lead).ravel() for level in levels]
    count, values = rows_together(signals.shape[-1]), np.empty(len(rows))
    for begin in range(0, len(rows), count):
        some, evaluation = slice(begin, begin + count), Evaluation(timepts)
        wanted = want(evaluation, evaluation.add(rows[some], name), *(level[some] for level in own))
        values[some] = wanted()
    return plain(values, lead)
