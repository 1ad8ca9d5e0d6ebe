"""Exact states of a linear loop with discrete blocks: at its sample times by a recursion, in between by series.

From instant to instant z+ = J (Phi z + gam) + K w, where gam is the response to the
functions of time over the interval. These are evaluated at the Gauss nodes of all
intervals together; where a breakpoint lies inside of an interval, at those of its
parts. Whatever the position of a breakpoint, each side is read where it is valid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.cell_extrema import Cells, joined
from ctrlplan.simulation.flow_kernel import REACH, FlowKernel, gauss_nodes, to_legendre
from ctrlplan.simulation.instants import Instants
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.sampled_form import Late, Line, SampledForm
from ctrlplan.simulation.schedule import Schedule, schedule_of
from ctrlplan.simulation.segments import time_tolerance, values_after
from ctrlplan.simulation.signals import TimeSignal, signal_values
from ctrlplan.trajectories.chebyshev import points, transform

_ORDERS = (3, 4, 6, 8, 12, 16)
"""Numbers of Gauss nodes of an interval, until the functions of time are resolved."""

_RESOLVED = 4e-16
"""Last Legendre coefficients, relative to a signal, at which it counts as resolved."""

_ALMOST = 1e-14
"""The same with the largest number of nodes, where it may be rounding, to which halves of an interval would not add."""

_PROBES = 64
"""Number of intervals of each kind (longest, shortest, any) in which the number of nodes is chosen first."""

_PARTS = 2**12
"""Maximum number of parts into which an interval is divided to resolve the functions of time."""

_FEW = 256
"""Maximum number of spans that are halved by themselves where functions of time are not resolved."""

_HALVINGS = 12
"""Maximum number of times."""

_NOISE, _FALLING = 1e-11, 4.0
"""Size of the last coefficients below which they are rounding, unless more nodes decrease them by this factor."""

_KINDS = 64
"""Number of different lengths of intervals up to which each is treated by itself."""

_TOGETHER = 2**12
"""Number of times whose matrices are computed together."""

_AT_ONCE = 2**14
"""Number of times whose states are computed together: memory that is used again is faster than fresh one."""

_PIECE = 24
"""Number of Chebyshev terms of a signal in a part of an interval."""

_NEGLIGIBLE = 1e-18
"""Terms of a series relative to the largest that are left out."""


class LateSignal:
    """Functions of time that have passed a delay.

    Parameters
    ----------
    late : Late
        The delay.
    signals : sequence of TimeSignal
        All functions of time of the loop; those of later delays have no effect.
    z : ndarray
        States at the start of the run, before samples.
    first : float
        Start of the run [s].
    tolerance : float
        Difference of times that counts as rounding [s].
    """

    def __init__(self, late: Late, signals: Sequence[TimeSignal], z: Array, first: float, tolerance: float) -> None:
        self.width, self._late, self._first, self._tolerance = late.initial.size, late, first, tolerance
        ends = np.cumsum([signal.width for signal in signals], dtype=int).tolist()
        columns = [slice(end - signal.width, end) for signal, end in zip(signals, ends, strict=True)]
        used = [k for k, own in enumerate(columns) if late.from_w[:, own].any()]
        self._signals = [signals[k] for k in used]
        self._weights = np.concatenate([np.zeros((self.width, 0)), *(late.from_w[:, columns[k]] for k in used)], axis=1)
        self._firsts = [(float(first + offset), own @ z) for offset, own in late.firsts if (own @ z).any()]
        self._marks = [first, *(end for end, _ in self._firsts)]
        self.motion: SampledMotion | None = None

    @property
    def vanishes(self) -> bool:
        """Whether it is always 0, as where registers hold all that has passed the delay."""
        return not (self._late.initial.any() or self._signals or self._firsts or self._late.follows)

    @property
    def is_constant(self) -> bool:
        """Whether it is constant between its breakpoints, as what discrete blocks hold."""
        return not (self._signals or self._late.follows)

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """Start of the delayed signals, and their breakpoints after it."""
        begin, end = (max(t - self._late.delay, self._first) for t in (t0, t1))
        later = (t for signal in self._signals for t in signal.breakpoints_between(begin, end) if t > self._first)
        marks = np.unique([*self._marks, *later]) + self._late.delay
        return marks[slice(*np.searchsorted(marks, [t0, t1]).tolist())]

    def at(self, times: Array) -> Array:
        """Values (width, ntime), right-continuous."""
        out = np.repeat(self._late.initial[:, None], times.size, axis=1)
        past = times - self._late.delay
        passed = past >= self._first - self._tolerance
        past = np.maximum(past[passed], self._first)
        found = self._weights @ values_after(self._signals, past, self._tolerance)
        for end, value in self._firsts:
            found += value[:, None] * (past < end - self._tolerance)
        if self._late.follows and self.motion is not None:
            found += self._late.from_z @ self.motion.at(past)
        out[:, passed] = found
        return out

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values at origin + s, which lie between two breakpoints."""
        return self.at(origin + s)

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """No bounds are known."""
        free = np.full(self.width, np.inf)
        return -free, free

    def ends(self, left: float, right: float) -> None:
        """None: the values are not known to be straight lines."""


def moved_signals(
    form: SampledForm,
    signals: Sequence[TimeSignal],
    first: float,
    last: float,
    state: Array,
    used: NDArray[np.bool_] | None = None,
) -> tuple[list[TimeSignal], SampledMotion]:
    """Functions of time of a loop, those of delays in place of given ones, and the motion of the loop.

    Parameters
    ----------
    form : SampledForm
        The loop.
    signals : sequence of TimeSignal
        Inputs, then the outputs of sources and delays.
    first, last : float
        Start and end of the run [s].
    state : ndarray, shape (nstates,)
        State at the start, before samples.
    used : ndarray of bool, shape (nw,), optional
        As for `SampledMotion`.
    """
    z, found, lates = np.concatenate([state, form.registers]), list(signals), list[LateSignal]()
    tolerance = time_tolerance(first, last)
    begins = np.cumsum([0, *(signal.width for signal in signals)]).tolist()
    for late in form.lates:
        lates.append(LateSignal(late, found, z, first, tolerance))
        found[begins.index(late.columns.start)] = lates[-1]
    motion = SampledMotion(form, found, first, last, z, used)
    for signal in lates:
        signal.motion = motion
    return found, motion


class SampledMotion:
    """States of a loop over a run.

    Parameters
    ----------
    form : SampledForm
        The loop.
    signals : sequence of TimeSignal
        Functions of time w, in the order of the form.
    first, last : float
        Start and end of the run [s].
    z : ndarray, shape (nz,)
        States at the start, before samples.
    used : ndarray of bool, shape (nw,), optional
        Functions of time that `cells` requires, in addition to the inputs of the flow.

    Attributes
    ----------
    instants : Instants
        Sample times of the discrete blocks, and further times at which nothing is due.
    states : ndarray, shape (ninstants, nz)
        States at the instants, after samples.
    tolerance : float
        Difference of times that counts as rounding [s].
    """

    def __init__(
        self,
        form: SampledForm,
        signals: Sequence[TimeSignal],
        first: float,
        last: float,
        z: Array,
        used: NDArray[np.bool_] | None = None,
    ) -> None:
        self.form, self.tolerance = form, time_tolerance(first, last)
        self._signals = signals
        schedule = schedule_of(form, first, last, self.tolerance)
        needed = form.b.any(axis=0) if used is None else form.b.any(axis=0) | used
        fed = np.flatnonzero(needed & ~_vanishing(signals))
        self._fed = _Chosen(signals, fed)
        self._spans, self._values = _resolved(_Spans(schedule.instants, last, self._fed, self.tolerance), self._fed)
        self.instants = self._spans.instants
        self._schedule = schedule if self.instants is schedule.instants else Schedule(form, self.instants)
        self._steps = self._schedule.steps()
        self._held = schedule.held
        order = self._values.shape[1] // max(1, fed.size)
        self._kernel = FlowKernel(form.a[:, form.moving], form.a[:, self._held], form.b[:, fed], order)
        self._tables: dict[tuple[int, int], Array] = {}
        with np.errstate(all="ignore"):
            self.states = self._run(z)

    def at(self, times: Array) -> Array:
        """States (nz, ntime) at times [s] of the run, after the samples of those times."""
        if times.size <= _AT_ONCE:
            return self._at(times)
        z = np.empty((self.states.shape[1], times.size))
        for begin in range(0, times.size, _AT_ONCE):
            z[:, begin : begin + _AT_ONCE] = self._at(times[begin : begin + _AT_ONCE])
        return z

    def _at(self, times: Array) -> Array:
        """The same for some of the times."""
        spans, moving = self._spans, self.form.moving
        which = self._spans_at(times)
        z: Array = np.take(self.states.T, spans.interval[which], axis=1)
        if not moving.size:
            return z
        since = times - spans.starts[which]
        inside = since > self.tolerance
        if not spans.broken.size and not inside.any():
            return z
        whole = inside & spans.whole[which]
        if np.count_nonzero(np.bincount(spans.kinds[which[whole]], minlength=1)) > _KINDS:
            whole[:] = False
        x = np.take(self._starts.T, which, axis=1)
        for some, states in ((whole, self._by_series), (inside & ~whole, self._by_nodes)):
            if some.all():
                x = states(which, since).T
            elif some.any():
                own = np.flatnonzero(some)
                for row, found in zip(x, states(which[own], since[own]).T, strict=True):
                    row[own] = found
        z[moving] = x
        return z

    @property
    def growth(self) -> float:
        """Growth of a perturbation of the states over the run, about."""
        return self._schedule.growth(self._steps)

    def registers_at(self, times: Array) -> Array:
        """States (nz - nstates, ntime) of the registers."""
        if not self.form.registers.size:
            return np.zeros((0, times.size))
        return np.take(self.states[:, self.form.nstates :].T, self._spans.interval[self._spans_at(times)], axis=1)

    def _spans_at(self, times: Array) -> NDArray[np.intp]:
        """Spans that contain times [s], the later one at their ends."""
        return np.maximum(np.searchsorted(self._spans.starts, times + self.tolerance, side="right") - 1, 0)

    def _run(self, z: Array) -> Array:
        """States (ninstants, nz) at the instants."""
        form, schedule, times, moving = self.form, self._schedule, self.instants.times, self.form.moving
        read = _Chosen(self._signals, schedule.read)
        values = read.after(times, self.tolerance).T
        forced, moved = np.empty((times.size, z.size)), self._forced()
        for own, (jump, given) in zip(schedule.places, schedule.jumps, strict=True):
            forced[own] = values[own] @ given[:, read.columns].T
            if moved is not None:
                later = own[own > 0]
                forced[later] += moved[later - 1] @ jump[:, moving].T
        start = schedule.jumps[schedule.due[0]][0] @ z + forced[0]
        for line in self._steps.lines:
            if line.at_start:
                start += line.into[line.kinds[0]] @ line.initial
        found = self._steps.marched(start, forced[1:], [self._given(*pair) for pair in schedule.lines])
        if not np.isfinite(found).all():
            at = times[int(np.argmin(np.isfinite(found).all(axis=1)))]
            raise SolverError(
                f"states of {form.name} must stay finite up to {times[-1]:g} s, got an overflow at {at:g} s"
            )
        return found

    def _given(self, line: Line, places: NDArray[np.intp]) -> Array:
        """What functions of time add to the values (nplaces, width) of a register of many samples."""
        read = _Chosen(self._signals, np.flatnonzero(line.from_w.any(axis=0)))
        return read.after(self.instants.times[places], self.tolerance).T @ line.from_w[:, read.columns].T

    def _forced(self) -> Array | None:
        """Responses (nintervals, nx) of the flow to functions of time over each interval, from zero; None if all 0."""
        spans, n = self._spans, self.form.moving.size + self._held.size
        if not self._fed.columns.size:
            return None
        found = np.zeros((self.instants.times.size, self.form.moving.size))
        whole = np.flatnonzero(spans.whole)
        if spans.different.size <= _KINDS:
            for k, change in enumerate(self._kernel.over(spans.different)):
                own = whole[spans.kinds[whole] == k]
                found[spans.interval[own]] = self._values[own] @ change[:, n:].T
        else:
            changes = self._kernel.over(spans.different)
            for own in np.array_split(whole, 1 + whole.size // _TOGETHER):
                change = changes[spans.kinds[own], :, n:]
                found[spans.interval[own]] = np.matmul(change, self._values[own, :, None])[..., 0]
        found[spans.broken] = self._chained(np.zeros((spans.broken.size, n)))[1]
        return found

    @cached_property
    def _starts(self) -> Array:
        """States of the flow (nspans, nx) at the starts of all spans."""
        spans = self._spans
        found = self.states[spans.interval][:, self.form.moving]
        known = self.states[spans.broken]
        held = np.concatenate([known[:, self.form.moving], known[:, self._held]], axis=1)
        found[~spans.whole] = self._chained(held)[0]
        return found

    def _chained(self, known: Array) -> tuple[Array, Array]:
        """States at the starts of the parts of broken intervals, and at their ends, from states and held values."""
        spans, nx = self._spans, self.form.moving.size
        parts = np.flatnonzero(~spans.whole)
        changes = self._kernel.over(spans.lengths[parts])
        place = np.searchsorted(spans.broken, spans.interval[parts])
        rank = np.arange(parts.size) - np.searchsorted(place, place)
        state, held = known[:, :nx].copy(), known[:, nx:]
        starts = np.empty((parts.size, nx))
        for k in range(int(rank.max(initial=-1)) + 1):
            own = np.flatnonzero(rank == k)
            at = place[own]
            starts[own] = state[at]
            given = np.concatenate([state[at], held[at], self._values[parts[own]]], axis=1)
            state[at] += np.matmul(changes[own], given[..., None])[..., 0]
        return starts, state

    def _known(self, which: NDArray[np.intp]) -> Array:
        """States, held values and values at the nodes (n, width) of some spans."""
        held = self.states[self._spans.interval[which]][:, self._held]
        return np.concatenate([self._starts[which], held, self._values[which]], axis=1)

    def series(self, which: NDArray[np.intp], kind: int, cell: int) -> Array:
        """Chebyshev series (nspans, nterms, nx) of the flow in one cell of some intervals of equal length."""
        length = float(self._spans.different[kind])
        cells = self.cells(kind)
        table = self._tables.get((kind, cell))
        if table is None:
            count = self._kernel.terms(length / cells)
            if len(self._tables) >= _KINDS:
                self._tables.clear()
            table = self._tables[kind, cell] = self._kernel.within(length, cell / cells, (cell + 1) / cells, count)
        count, nx = table.shape[:2]
        found: Array = (self._known(which) @ table.reshape(count * nx, -1).T).reshape(-1, count, nx)
        found[:, 0] += self._starts[which]
        size = _largest(found)
        used = np.flatnonzero(np.any(size > _NEGLIGIBLE * size.max(axis=0), axis=1))
        return found[:, : int(used.max(initial=0)) + 1]

    def cells(self, kind: int) -> int:
        """Number of cells of an interval in which the flow is resolved by one series each."""
        reach = self._kernel.norm * float(self._spans.different[kind])
        return max(1, int(np.ceil(reach / REACH)))

    def _by_series(self, which: NDArray[np.intp], since: Array) -> Array:
        """States of the flow (ntime, nx) in whole intervals, times [s] after their starts."""

        def of_one_kind(kind: int, own: NDArray[np.intp] | slice) -> Array:
            cells = self.cells(kind)
            place, inside = since[own] * (cells / self._spans.different[kind]), which[own]
            cell = np.minimum(place.astype(np.intp), cells - 1) if cells > 1 else None
            return _part_by_part(cell, place.size, lambda k, some: in_cell(kind, k, inside[some], place[some] - k))

        def in_cell(kind: int, cell: int, inside: NDArray[np.intp], place: Array) -> Array:
            new = np.append(True, inside[1:] != inside[:-1])
            return _evaluated(self.series(inside[new], kind, cell), np.cumsum(new) - 1, 2.0 * place - 1.0)

        kinds = self._spans.kinds[which] if self._spans.different.size > 1 else None
        return _part_by_part(kinds, since.size, of_one_kind)

    def _by_nodes(self, which: NDArray[np.intp], since: Array) -> Array:
        """The same in any spans, from values of the functions of time between their starts and each time."""
        found = np.empty((since.size, self.form.moving.size))
        nodes, nvalues = gauss_nodes(self._kernel.order), self._values.shape[1]
        for own in np.array_split(np.arange(since.size), 1 + since.size // _TOGETHER):
            spans, tau = which[own], since[own]
            given = self._known(spans)
            if nvalues:
                times = self._spans.starts[spans, None] + tau[:, None] * nodes
                given[:, -nvalues:] = self._fed.at(times)
            found[own] = self._starts[spans] + np.matmul(self._kernel.over(tau), given[..., None])[..., 0]
        return found

    def signal_cells(self, c: Array, d: Array, until: float = np.inf) -> Cells:
        """Signals c z + d w (nrows) as series in cells of time; d is 0 but for the `used` functions of time.

        Of the intervals that begin before a time.
        """
        spans, order, rows = self._spans, self._kernel.order, len(c)
        parts: list[tuple[Array, Array | float, NDArray[np.intp], Array]] = []
        direct = d[:, self._fed.columns]
        lasting = (spans.lengths > self.tolerance) & (spans.starts < until)
        whole = np.flatnonzero(spans.whole & lasting)
        pieces = np.flatnonzero(~spans.whole & lasting)
        if np.count_nonzero(np.bincount(spans.kinds[whole], minlength=1)) > _KINDS:
            whole, pieces = whole[:0], np.flatnonzero(lasting)
        held = c.copy()
        held[:, self.form.moving] = 0.0
        for kind in np.flatnonzero(np.bincount(spans.kinds[whole], minlength=1)).tolist():
            own = whole[spans.kinds[whole] == kind]
            cells, length = self.cells(kind), float(spans.different[kind])
            for k in range(cells):
                flow = self.series(own, kind, k) @ c[:, self.form.moving].T
                count = max(flow.shape[1], order)
                series = np.zeros((own.size, count, rows))
                series[:, : flow.shape[1]] = flow
                if direct.any():
                    series += self._direct(own, direct, points(count - 1, k / cells, (k + 1) / cells))
                parts.append((spans.starts[own] + k * length / cells, length / cells, own, series))
        count = max(_PIECE, order)
        for own in np.array_split(pieces, 1 + pieces.size // _TOGETHER):
            fractions = points(count - 1, 0.0, 1.0)
            which, since = np.repeat(own, count), (spans.lengths[own, None] * fractions).ravel()
            nodes = (self._by_nodes(which, since) @ c[:, self.form.moving].T).reshape(own.size, count, rows)
            series = np.einsum("jq,kqr->kjr", transform(np.eye(count)).T, nodes)
            if direct.any():
                series += self._direct(own, direct, fractions)
            parts.append((spans.starts[own], spans.lengths[own], own, series))
        size = max(series.shape[1] for *_, series in parts)
        return joined(
            [
                _of_series(starts, lengths, self.states[spans.interval[own]] @ held.T, series, size)
                for starts, lengths, own, series in parts
            ]
        )

    def _direct(self, which: NDArray[np.intp], d: Array, fractions: Array) -> Array:
        """Chebyshev series (nspans, nterms, nrows) of combinations of the functions of time at fractions of spans."""
        order = self._kernel.order
        values = self._values[which].reshape(which.size, order, d.shape[1]) @ d.T
        table = legendre.legvander(2.0 * fractions - 1.0, order - 1) @ to_legendre(order)
        return np.einsum("jp,kpr->kjr", transform(np.eye(fractions.size)).T @ table, values)


def _of_series(starts: Array, lengths: Array | float, held: Array, series: Array, size: int) -> Cells:
    """Cells with `size` terms of series (ncells, nterms, nrows) and constants (ncells, nrows)."""
    found = np.zeros((size, series.shape[2], starts.size))
    found[: series.shape[1]] = series.transpose(1, 2, 0)
    found[0] += held.T
    edge = np.ones(starts.size)
    return Cells(starts, lengths * edge, found, -edge, edge)


def _vanishing(signals: Sequence[TimeSignal]) -> NDArray[np.bool_]:
    """Which of the functions of time are always 0."""
    flags = [np.full(signal.width, isinstance(signal, LateSignal) and signal.vanishes) for signal in signals]
    return np.concatenate([np.zeros(0, dtype=np.bool_), *flags])


class _Chosen:
    """Some of the functions of time of a loop.

    Attributes
    ----------
    columns : ndarray of int
        Their places among all of them.
    signals : list of TimeSignal
        Signals that contain them.
    """

    def __init__(self, signals: Sequence[TimeSignal], columns: NDArray[np.intp]) -> None:
        self.columns, self.signals = columns, list[TimeSignal]()
        rows, width, begin = [np.zeros(0, dtype=np.intp)], 0, 0
        for signal in signals:
            own = columns[(columns >= begin) & (columns < begin + signal.width)]
            if own.size:
                self.signals.append(signal)
                rows.append(own - begin + width)
                width += signal.width
            begin += signal.width
        self._rows = np.concatenate(rows)

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """Times [s] between which they are analytic."""
        return np.unique(np.concatenate([np.zeros(0), *(s.breakpoints_between(t0, t1) for s in self.signals)]))

    def at(self, times: Array) -> Array:
        """Values (nspans, ntime * ncolumns) at times (nspans, ntime), none of which is a breakpoint."""
        found = signal_values(self.signals, times.ravel())[self._rows]
        return found.T.reshape(len(times), times.shape[1] * self.columns.size)

    def after(self, times: Array, tolerance: float) -> Array:
        """Values (ncolumns, ntime) after breakpoints that follow within a tolerance."""
        return values_after(self.signals, times, tolerance)[self._rows]


class _Spans:
    """Intervals between instants, in parts where a function of time is not analytic inside of one.

    Attributes
    ----------
    instants : Instants
        The instants; after the last one there is an interval up to the end of the run.
    different : ndarray
        Different lengths [s] of intervals.
    length_of : ndarray of int, shape (ninstants,)
        Index of the length of each interval.
    interval, starts, lengths, whole : ndarray, shape (nspans,)
        Interval, start [s] and length [s] of each span, and whether it is a whole interval.
    kinds : ndarray of int, shape (nspans,)
        Index of the length of the interval of each span.
    broken : ndarray of int
        Intervals that have parts.
    """

    def __init__(
        self, instants: Instants, last: float, fed: _Chosen, tolerance: float, further: Array | None = None
    ) -> None:
        self.instants, self._last, self._fed, self.tolerance = instants, last, fed, tolerance
        self._further = np.zeros(0) if further is None else further
        begin, end = instants.times, np.append(instants.times[1:], max(last, float(instants.times[-1])))
        self.different = np.append(instants.lengths, end[-1] - begin[-1])
        self.length_of = np.append(instants.which, instants.lengths.size)
        marks = np.union1d(fed.breakpoints_between(float(begin[0]), float(end[-1])), self._further)
        marks = marks[(marks > begin[0] + tolerance) & (marks < end[-1] - tolerance)]
        marks = marks[np.append(True, np.diff(marks) > tolerance)[: marks.size]]
        where = np.searchsorted(begin, marks, side="right") - 1
        inside = (marks - begin[where] > tolerance) & (end[where] - marks > tolerance)
        marks, where = marks[inside], where[inside]
        self.broken = np.unique(where)
        self.interval = np.concatenate([np.arange(begin.size), where])
        self.starts = np.concatenate([begin, marks])
        by = np.argsort(self.starts, kind="stable")
        self.interval, self.starts = self.interval[by], self.starts[by]
        self.lengths = np.append(self.starts[1:], end[-1]) - self.starts
        self.whole = ~np.isin(self.interval, self.broken)
        self.kinds = self.length_of[self.interval]
        self.lengths[self.whole] = self.different[self.kinds[self.whole]]

    def divided(self, parts: int) -> _Spans:
        """The same with each interval divided into equal ones."""
        return _Spans(self.instants.divided(parts), self._last, self._fed, self.tolerance)

    def halved(self, chosen: NDArray[np.intp]) -> _Spans:
        """The same with some spans halved."""
        middle = self.starts[chosen] + 0.5 * self.lengths[chosen]
        further = np.union1d(self._further, middle)
        return _Spans(self.instants, self._last, self._fed, self.tolerance, further)


def _resolved(spans: _Spans, fed: _Chosen) -> tuple[_Spans, Array]:
    """Spans, divided if necessary, and values (nspans, order * ncolumns) at Gauss nodes that resolve the signals."""
    if not fed.columns.size:
        return spans, np.zeros((spans.starts.size, 0))
    parts, divided, halvings = 1, spans, 0
    while True:
        used = np.flatnonzero(divided.lengths > divided.tolerance)
        some = used[np.unique(np.linspace(0, used.size - 1, min(_PROBES, used.size)).astype(int))]
        by_length = used[np.argsort(divided.lengths[used], kind="stable")]
        longest, shortest = by_length[-_PROBES:], by_length[:_PROBES]
        # Times are rounded: relative to the change of a signal over a span by this much.
        largest = float(np.abs(divided.starts).max() / divided.lengths.max(initial=1e-300))
        noise = _NOISE + 64.0 * np.finfo(float).eps * largest
        for order, limit in _orders(divided, fed, np.unique(np.concatenate([some, longest, shortest])), noise):
            values = fed.at(divided.starts[:, None] + divided.lengths[:, None] * gauss_nodes(order))
            if _tail(values, order) <= limit:
                return divided, values
        few = _unresolved(divided, fed)
        if few.size <= _FEW and parts == 1 and halvings < _HALVINGS:
            divided, halvings = divided.halved(few), halvings + 1
            continue
        if parts >= _PARTS:
            raise NotApplicableError("a function of time is not resolved between the sample times of the loop")
        parts *= 2
        divided = spans.divided(parts)


def _unresolved(spans: _Spans, fed: _Chosen) -> NDArray[np.intp]:
    """Spans in which the largest number of nodes does not resolve the signals."""
    order = _ORDERS[-1]
    values = fed.at(spans.starts[:, None] + spans.lengths[:, None] * gauss_nodes(order))
    width = values.shape[1] // order
    size = _largest(values).reshape(-1, width).max(axis=0)
    last = np.abs(values @ np.kron(to_legendre(order)[-2:].T, np.eye(width))).reshape(len(values), -1, width)
    wrong = (last > _RESOLVED * np.where(size > 0.0, size, 1.0)).any(axis=(1, 2))
    return np.flatnonzero(wrong & (spans.lengths > spans.tolerance))


def _orders(spans: _Spans, fed: _Chosen, some: NDArray[np.intp], noise: float) -> list[tuple[int, float]]:
    """Numbers of nodes from the first that resolves the signals in some spans on, and limits of their tails."""
    before, starts, lengths = np.inf, spans.starts[some, None], spans.lengths[some, None]
    for k, order in enumerate(_ORDERS):
        tail = _tail(fed.at(starts + lengths * gauss_nodes(order)), order)
        if tail <= _RESOLVED:
            return [(p, _RESOLVED) for p in _ORDERS[k:]]
        if before <= noise and tail > before / _FALLING:  # more nodes do not reduce rounding errors of the signals
            return [(_ORDERS[k - 1], noise)]
        before = tail
    return [(_ORDERS[-1], _ALMOST)] if before <= _ALMOST else []


def _tail(values: Array, order: int) -> float:
    """Last two Legendre coefficients relative to the largest value of each signal, at most."""
    width = values.shape[1] // order
    to_last = np.kron(to_legendre(order)[-2:].T, np.eye(width))
    last, size = (_largest(found).reshape(-1, width).max(axis=0, initial=0.0) for found in (values @ to_last, values))
    return float((last / np.where(size > 0.0, size, 1.0)).max(initial=0.0))


def _largest(values: Array) -> Array:
    """Largest magnitudes of columns."""
    return np.maximum(values.max(axis=0, initial=0.0), -values.min(axis=0, initial=0.0))


def _part_by_part(
    parts: NDArray[np.intp] | None, count: int, rows: Callable[[int, NDArray[np.intp] | slice], Array]
) -> Array:
    """Rows (count, nx) of a function of a part and of the indices of its rows; None for one part 0."""
    present = [0] if parts is None else np.flatnonzero(np.bincount(parts)).tolist()
    if len(present) == 1:
        return rows(present[0], slice(None))
    places = [np.flatnonzero(parts == part) for part in present]
    values = [rows(part, own) for part, own in zip(present, places, strict=True)]
    found = np.empty((count, values[0].shape[1]))
    for own, some in zip(places, values, strict=True):
        found[own] = some
    return found


def _evaluated(series: Array, row: NDArray[np.intp], x: Array) -> Array:
    """Values (ntime, nx) of Chebyshev series (nspans, nterms, nx) in some rows at places from -1 to 1."""
    count, nx = series.shape[1:]
    terms = series.transpose(2, 1, 0).copy()  # states side by side: rows in one piece are read faster
    found = np.empty((nx, x.size))
    for begin in range(0, x.size, _TOGETHER):
        some = slice(begin, begin + _TOGETHER)
        place, own = x[some], row[some]
        basis, term = np.empty((count, place.size)), np.empty(place.size)
        basis[:1], basis[1:2] = 1.0, place
        for j in range(2, count):
            np.multiply(2.0 * place, basis[j - 1], out=basis[j])
            basis[j] -= basis[j - 2]
        for n in range(nx):
            total = found[n, some]
            np.take(terms[n, 0], own, out=total, mode="clip")
            for j in range(1, count):
                np.take(terms[n, j], own, out=term, mode="clip")
                term *= basis[j]
                total += term
    return found.T
