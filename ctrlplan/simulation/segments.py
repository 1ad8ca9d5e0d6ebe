"""Numerical runs from segment to segment, with samples, delays and stops between them."""

from __future__ import annotations

import heapq
import math
from bisect import bisect_right, insort
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.budget import TimeLimitError, check
from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.delayed_signals import DelayedSignal, HeldDelaySignal
from ctrlplan.simulation.interpreted import FeedthroughError, Interpreted, SolverError
from ctrlplan.simulation.known_delays import KnownDelaySignal
from ctrlplan.simulation.network import Block, Network
from ctrlplan.simulation.scales import in_turn
from ctrlplan.simulation.segment_lengths import longest_segment
from ctrlplan.simulation.signals import (
    RESOLVED,
    Series,
    TimeSignal,
    TimeSignals,
    after_marks,
    breakpoints_of,
    chebyshev_coefficients,
    chebyshev_times,
)

_WIDTH = 24
"""Number of Chebyshev terms of a stored signal of a delay."""

_SHORTEST = 1.0 / 64.0
"""Length of a segment relative to the delay below which it is not halved to resolve a signal."""

_HOPS = 6
"""Number of delays after which a jump has become smooth enough to be ignored."""


_TOLERANCE = 1e-12
"""Difference of two times, relative to the run, up to which they are considered equal."""

_AHEAD = 256
"""Number of samples at which functions of time are evaluated in one call."""

_DENOMINATOR = 10**7
"""Maximum denominator of times that are interpreted as fractions, relative to the power of ten above them."""

_JUMP = 1e-9
"""Jump of an input of a delay, relative to its size, at whose arrival a segment ends."""

_ROUNDINGS = 64.0
"""Rounding errors of a plan, in units of the last place of its largest values."""

_FIRST, _LATER = 4.0, 2.0
"""Length of the first segment, and maximum length of others, as fractions of a run that an event may end."""

SAMPLES = 5_000_000
"""Maximum number of sample times of a run: states at all of them are stored, and nonlinear loops take half an hour."""

_MARKS = 20_000
"""Maximum number of times of jumps at which a run stops."""


class Solver(Protocol):
    """Integrator of the states over a segment."""

    def perturbed(self, states: Array) -> Array:
        """States (nstates, ntime) moved by the tolerance of a step, up and down in turn."""

    def advance(self, series: Series, left: float, grid: Array, state: Array) -> Array:
        """States (nstates, ngrid) at times of a segment; the last is its end."""

    def signals(self, times: Array, states: Array, time_values: Array) -> Array:
        """All signals (nsignals, ntime)."""

    def outputs(self, times: Array, states: Array, time_values: Array) -> Array:
        """Outputs (noutputs, ntime) of the network."""


@dataclass(frozen=True, eq=False)
class NetworkRun:
    """Result of a run.

    Attributes
    ----------
    times : ndarray, shape (ntime,)
        Sample times and starts of segments [s], up to the end of the run.
    states : ndarray, shape (nstates, ntime)
        Right-continuous at the samples of discrete blocks.
    segments : list of (float, Series)
        Start of each segment, and the signals that are functions of time over it.
    """

    times: Array
    states: Array
    segments: list[tuple[float, Series]]

    def series(self, t: float) -> Series:
        """Signals that are functions of time, over the segment that contains a time."""
        return self.segments[max(0, bisect_right(self.segments, t, key=lambda segment: segment[0]) - 1)][1]

    def until(self, k: int) -> NetworkRun:
        """The run up to times[k], k > 0."""
        end = float(self.times[k])
        segments = [segment for segment in self.segments if segment[0] < end]
        return NetworkRun(self.times[: k + 1], self.states[:, : k + 1], segments)


class Stops(Protocol):
    """Events that may end a run."""

    def within(self, series: Series, times: Array, states: Array) -> bool:
        """Whether one has occurred at a few of the times of a segment, with its functions of time."""

    def first(self, run: NetworkRun) -> int | None:
        """Index of the first time of a run by which one has occurred, after its start; evaluated at all times."""


def integrate(
    network: Network,
    equations: Interpreted | None,
    solver: Solver,
    time_signals: TimeSignals,
    times: Array,
    state: Array,
    resolution: float,
    marks: Sequence[float] = (),
    stops: Stops | None = None,
    course: Course | None = None,
) -> NetworkRun:
    """Run a network over increasing times.

    Parameters
    ----------
    network, equations, solver
        The network, its equations by Python, and the integrator.
    time_signals : TimeSignals
        Signals at the inputs, then the outputs of each block that are functions of time.
    times : ndarray, shape (ntime,)
        Times of the run, from its start to its end.
    state : ndarray, shape (nstates,)
        Initial state.
    resolution : float
        Relative accuracy of the stored signals of delays.
    marks : sequence of float, optional
        Further times [s] at which equations switch.
    stops : Stops, optional
        Events that may end the run; segments are then shorter. The run goes on after
        one that is missed at the few times of a segment, unless the solver fails.
    course : Course, optional
        Former runs that this one continues. Samples that are due at its end
        belong to the next run.

    Raises
    ------
    SolverError
        If the solver fails or a state is not finite; the message gives the time.
    """
    first, last = float(times[0]), float(times[-1])
    ends = course is None
    if course is None:
        course = _new_course(network, equations, solver, time_signals, (first, last), resolution, marks)
    else:
        course.prolong(apart([first, *marks, last])[1:-1], first, last)
    memory, schedule, rounding = course.memory, course.schedule, course.rounding
    shortest, reach, longest = _lengths(network, memory.delays, last - first, stops is not None)
    found, span, left = _Recorded(), list[Series](), first
    x = schedule.sample(equations, first, state)
    while left < last:
        check(left)  # CVODES is not interrupted within a segment, which has a maximum number of steps
        schedule.add(memory.changes(left, x))
        right = schedule.following(left)
        if right - left <= reach * (1.0 + 1e-9):
            right = schedule.on(times, right)
        else:
            right = left + reach if stops is None else _reached(times, left, reach)
        if memory.has_delays or not (span and span[-1].right >= right):
            until = right if memory.has_delays else schedule.fixed_after(left)
            error = np.maximum(rounding, memory.rounding)
            span = time_signals.series(0.5 * (left + right), left, until, memory.accuracy, error)
        series = next(s for s in span if left < s.right)
        right = min(right, series.right)
        inside = times[times.searchsorted(left) : times.searchsorted(right)]
        grid, requested = memory.grid(left, right, inside[1:] if inside.size and inside[0] <= left else inside)
        try:
            states = _advanced(solver, series, left, grid, x, last)
            stopped = stops is not None and stops.within(series, grid, states)
        except Exception as error:
            if ended := _ended(found.run(left, x), stops):
                return ended
            if right - left < shortest or not _may_be_later(error, stops):
                raise
            reach = 0.5 * (right - left)
            continue
        if not memory.record(left, right, series, grid, states):
            reach = 0.5 * (right - left)
            continue
        schedule.add(memory.jumps)
        found.add(series, left, x, grid[requested], states[:, requested])
        x = states[:, -1]
        if stopped and (ended := _ended(found.run(right, x), stops)):
            return ended
        if ends or right < last:
            x = schedule.sample(equations, right, x)
        left, reach = right, min(longest, 2.0 * reach)
    return found.run(left, x)


class _Recorded:
    """Segments of a run: their series, their start with the state there, and output times inside with the states."""

    def __init__(self) -> None:
        self._segments: list[tuple[float, Series]] = []
        self._times: list[Array] = []
        self._states: list[Array] = []

    def add(self, series: Series, left: float, state: Array, inside: Array, states: Array) -> None:
        """Add a segment."""
        self._segments.append((left, series))
        self._times += [np.array([left]), inside]
        self._states += [state[:, None], states]

    def run(self, end: float, state: Array) -> NetworkRun:
        """The run until an end in the last segment, with the state there."""
        if self._segments:
            count = int(self._times[-1].searchsorted(end))
            self._times[-1], self._states[-1] = self._times[-1][:count], self._states[-1][:, :count]
        t = np.concatenate([*self._times, np.array([end])])
        x = np.concatenate([*self._states, state[:, None]], axis=1)
        return NetworkRun(t, x, self._segments)


class Course:
    """What a run hands on to the next one that continues it.

    Attributes
    ----------
    memory : _Memory
        Stored inputs of the delays.
    schedule : _Schedule
        Breakpoints and sample times.
    rounding : ndarray, shape (nsignals,)
        Rounding errors of the signals that are functions of time.
    """

    def __init__(
        self,
        network: Network,
        solver: Solver,
        time_signals: TimeSignals,
        span: tuple[float, float],
        resolution: float,
    ) -> None:
        self._time_signals = time_signals
        self.memory = _Memory(network, solver, time_signals, resolution)
        self.memory.check_held(time_tolerance(*span))
        self.schedule = _Schedule(network, time_signals, *span)
        self.rounding: Array = np.zeros(time_signals.width)

    def prolong(self, fixed: list[float], first: float, last: float) -> None:
        """Continue to a later end, with the breakpoints before it."""
        self.schedule.prolong(fixed, first, last)

    def add_rounding(self, times: Array) -> None:
        """Include the rounding errors of the signals at given times, of the size of those of their largest values."""
        self.rounding = np.maximum(self.rounding, _rounding_at(self._time_signals, times))

    def state(self) -> tuple[SampleTimes, list[int]]:
        """Sample times and lengths of the stored signals, for `restore`."""
        return self.schedule.samples.copy(), self.memory.lengths()

    def restore(self, state: tuple[SampleTimes, list[int]]) -> None:
        """Return to an earlier state."""
        self.schedule.samples = state[0].copy()
        self.memory.shorten(state[1])


def _new_course(
    network: Network,
    equations: Interpreted | None,
    solver: Solver,
    time_signals: TimeSignals,
    span: tuple[float, float],
    resolution: float,
    marks: Sequence[float],
) -> Course:
    """Course of a run that continues none."""
    course = Course(network, solver, time_signals, span, resolution)
    endless = equations is not None and network.delays_feed_delays(equations.feeds)

    def found() -> tuple[list[float], Array]:
        everything = [*breakpoints_of(time_signals, *span), *network.breakpoints, *marks]
        fixed = _fixed(everything, *span, course.memory.delays, _MARKS if endless else _HOPS)
        return fixed, _rounding_at(time_signals, np.union1d(np.linspace(*span, 257), [*fixed, span[1]]))

    fixed, rounding = time_signals.marks((span, network.breakpoints, tuple(marks)), found)
    course.prolong(fixed, *span)
    course.rounding = rounding
    return course


def _rounding_at(time_signals: TimeSignals, times: Array) -> Array:
    """Rounding errors (nsignals,) of signals, of the size of those of their largest values at given times."""
    largest = np.abs(known_before(time_signals, times)).max(axis=1, initial=0.0)
    return np.asarray(_ROUNDINGS * np.finfo(float).eps * np.where(np.isfinite(largest), largest, 0.0))


def _lengths(network: Network, delays: list[float], duration: float, stops: bool) -> tuple[float, float, float]:
    """Length [s] below which a segment that fails is not halved, length of the first one, and maximum length.

    A run that may stop has shorter segments: there may be no solution after the event.
    """
    longest = longest_segment(network, delays, duration)
    if not stops:
        return np.inf, longest, longest
    return 1e-9 * duration, min(longest, duration / _FIRST), min(longest, duration / _LATER)


def _reached(times: Array, left: float, reach: float) -> float:
    """End of a segment of a given length; the last output time before it, if that is in its second half.

    Segments between evenly spaced output times then share a compiled solver.
    """
    before = float(times[np.searchsorted(times, left + reach * (1.0 + 1e-9), side="right") - 1])
    return before if before > left + 0.5 * reach else left + reach


def _may_be_later(error: Exception, stops: Stops | None) -> bool:
    """Whether an error in a segment may be absent in a shorter one; a block may be undefined after an event."""
    lasting = NotApplicableError, FeedthroughError, TimeLimitError
    return isinstance(error, SolverError) or (stops is not None and not isinstance(error, lasting))


def _ended(run: NetworkRun, stops: Stops | None) -> NetworkRun | None:
    """A run up to the first event that ends it; None if there is none."""
    stop = None if stops is None or run.times.size == 1 else stops.first(run)
    return None if stop is None else run.until(stop)


def _advanced(solver: Solver, series: Series, left: float, grid: Array, state: Array, last: float) -> Array:
    """Finite states (nstates, ngrid) at times of a segment; SolverError if there are none."""
    found = solver.advance(series, left, grid, state)
    if not np.isfinite(found).all():
        raise SolverError(f"the solver must reach {last:g} s, got to {left:g} s: a state is not finite after that")
    return found


class _Memory:
    """Stored inputs of the delays: segment by segment, and change by change of those that sampled blocks hold.

    Attributes
    ----------
    delays : list of float
        Delays [s] of the signals that are stored segment by segment.
    rounding : ndarray, shape (nsignals,)
        Rounding errors of all time signals: so far, of the delayed ones; otherwise 0.
    jumps : list of float
        Times [s] at which jumps at the start of the last stored segment arrive.
    """

    def __init__(self, network: Network, solver: Solver, time_signals: TimeSignals, resolution: float) -> None:
        late = [signal for signal in time_signals if isinstance(signal, DelayedSignal | KnownDelaySignal)]
        pairs = list(zip(late, network.blocks_with("delay"), strict=True))
        self._every = [signal for signal in late if isinstance(signal, DelayedSignal)]
        self._all_time_signals = time_signals
        self._held = [(signal, network.fed[i]) for signal, i in pairs if isinstance(signal, HeldDelaySignal)]
        self._time_signals = [signal for signal in self._every if not isinstance(signal, HeldDelaySignal)]
        blocks = [i for signal, i in pairs if signal in self._time_signals]
        self._fed = [network.fed[i] for i in blocks]
        self._wires, self._time_rows = [network.wire[network.inputs[i]] for i in blocks], network.time_rows
        self._solver, self._resolution = solver, resolution
        self.delays = [signal.delay for signal in self._time_signals]
        ends = np.cumsum([signal.width for signal in time_signals], dtype=int)
        self._rows = [
            slice(end - signal.width, end)
            for signal, end in zip(time_signals, ends.tolist(), strict=True)
            if signal in self._time_signals
        ]
        self.rounding: Array = np.zeros(time_signals.width)
        self._ends: list[Array | None] = [None for _ in self._time_signals]
        self.jumps: list[float] = []

    @property
    def accuracy(self) -> float:
        """Relative accuracy of the series of the functions of time."""
        return self._resolution if self._time_signals else RESOLVED

    @property
    def has_delays(self) -> bool:
        """Whether functions of time become known during the run."""
        return bool(self._every)

    def check_held(self, tolerance: float) -> None:
        """Raise if a delay of a held signal is not distinct from the rounding of times."""
        shortest = min((signal.delay for signal, _ in self._held), default=np.inf)
        if shortest < 4.0 * tolerance:
            raise ValueError(f"a delay must exceed the rounding of times, {4.0 * tolerance:.2g} s, got {shortest:g} s")

    def changes(self, left: float, state: Array) -> list[float]:
        """Store the held inputs of delays after the samples at a time; return when those that changed arrive."""
        if not self._held:
            return []
        t = np.array([left])
        w = self._solver.signals(t, state[:, None], self._all_time_signals.at(t))
        return [left + signal.delay for signal, fed in self._held if signal.changed(left, fed(w)[:, 0])]

    def grid(self, left: float, right: float, inside: Array) -> tuple[Array, NDArray[np.bool_] | slice]:
        """Times of a segment at which states are required, the last its end, and which of them are those inside."""
        if not self._time_signals:
            return np.concatenate([inside, (right,)]), slice(inside.size)
        grid = np.union1d(np.append(self.nodes(left, right), right), inside)
        return grid, np.isin(grid, inside)

    def nodes(self, left: float, right: float) -> Array:
        """Times of a segment at which the inputs of delays are stored."""
        return chebyshev_times(left, right, _WIDTH)

    def lengths(self) -> list[int]:
        """Number of stored pieces of each delay."""
        return [signal.length for signal in self._every]

    def shorten(self, lengths: list[int]) -> None:
        """Remove the pieces that were stored since."""
        for signal, length in zip(self._every, lengths, strict=True):
            signal.shorten(length)

    def forget(self, now: float) -> None:
        """Remove what is not read after a time."""
        for signal in self._every:
            signal.forget(now)

    def record(self, left: float, right: float, series: Series, grid: Array, states: Array) -> bool:
        """Store a segment; False if it must be shorter to resolve its signals."""
        if not self._time_signals:
            return True
        nodes = self.nodes(left, right)
        x, time_values = states[:, np.searchsorted(grid, nodes)], series.at(nodes)
        values = self._values(nodes, x, time_values)
        # A signal that dies away after a jump retains the rounding errors of its terms.
        self._raise_rounding([_ROUNDINGS * np.finfo(float).eps * np.abs(rows).max(axis=1) for rows in values])
        pieces = [chebyshev_coefficients(rows) for rows in values]
        if right - left > _SHORTEST * min(self.delays) and self._unresolved(pieces):
            # Shorter segments do not reduce what the states' tolerances leave.
            try:
                near = self._values(nodes, self._solver.perturbed(x), _rounded(time_values))
            except Exception:  # outside the domain of a block
                return False
            self._raise_rounding([np.abs(b - a).max(axis=1) for a, b in zip(values, near, strict=True)])
            if self._unresolved(pieces):
                return False
        for signal, piece, wire in zip(self._time_signals, pieces, self._wires, strict=True):
            signal.record(Series(left, right, piece, *_combined_bounds(wire, self._time_rows, series)))
        self.jumps = [left + self.delays[k] for k, piece in enumerate(pieces) if self._has_jumped(k, piece)]
        return True

    def _has_jumped(self, k: int, piece: Array) -> bool:
        """Whether an input of a delay has jumped at the start of a segment, as the output of a sampled block does."""
        before, start = self._ends[k], piece @ np.where(np.arange(piece.shape[1]) % 2, -1.0, 1.0)
        self._ends[k] = piece.sum(axis=1)
        size = np.abs(piece).sum(axis=1)
        return before is not None and bool(np.any(np.abs(start - before) > _JUMP * np.maximum(size, np.abs(before))))

    def _values(self, times: Array, states: Array, time_values: Array) -> list[Array]:
        """Inputs (width, ntime) of each delay."""
        w = self._solver.signals(times, states, time_values)
        return [fed(w) for fed in self._fed]

    def _raise_rounding(self, errors: list[Array]) -> None:
        for rows, error in zip(self._rows, errors, strict=True):
            self.rounding[rows] = np.maximum(self.rounding[rows], np.where(np.isfinite(error), error, 0.0))

    def _unresolved(self, pieces: list[Array]) -> bool:
        return any(
            _unresolved(piece, self._resolution, self.rounding[rows])
            for piece, rows in zip(pieces, self._rows, strict=True)
        )


class _Schedule:
    """Times at which a segment must end: breakpoints, and sample times of discrete blocks.

    Sample times offset + k period are computed in rational arithmetic: 3 times
    0.1 s is 0.3 s. A breakpoint that differs from a sample time by rounding is
    considered equal; the sample then reads the values after it.
    """

    def __init__(self, network: Network, time_signals: TimeSignals, first: float, last: float) -> None:
        self._time_signals, self._arrivals = time_signals, list[float]()
        self._ahead: tuple[Array, Array] = np.empty(0), np.empty((0, 0))
        self._tolerance = time_tolerance(first, last)
        self.prolong([], first, last)
        check_periods([network.blocks[i] for i in network.blocks_with("period")], first, last)
        self.samples = SampleTimes(network, first)

    @property
    def marks(self) -> list[float]:
        """Breakpoints, and the end of the run."""
        return self._fixed

    def following(self, t: float) -> float:
        """The next time after t."""
        later = bisect_right(self._arrivals, t + self._tolerance)
        due = min([self.fixed_after(t), *self._arrivals[later : later + 1]])
        sample = self.samples.seconds
        return sample if sample <= min(due + self._tolerance, self._fixed[-1]) else due

    def add(self, times: Sequence[float]) -> None:
        """Add times at which jumps arrive."""
        for t in times:
            insort(self._arrivals, t)

    def fixed_after(self, t: float) -> float:
        """The next breakpoint after t, or the end."""
        return self._fixed[min(bisect_right(self._fixed, t + self._tolerance), len(self._fixed) - 1)]

    def on(self, times: Array, t: float) -> float:
        """Output time that equals a time up to rounding, so that its values are those after it."""
        k = int(times.searchsorted(t - self._tolerance))
        near = float(times[k]) if k < times.size else math.inf
        return near if abs(near - t) <= self._tolerance else t

    def sample(self, equations: Interpreted | None, t: float, x: Array) -> Array:
        """State after the samples of all blocks that are due at t."""
        due = self.samples.due(t + self._tolerance)
        if not due or equations is None:
            return x
        return equations.sampled(due, t, x, self._values(t))

    def _values(self, t: float) -> Array:
        """Functions of time at a sample; for many samples together, unless some are only known during the run."""
        times, values = self._ahead
        k = int(times.searchsorted(t - self._tolerance))
        if k == times.size or times[k] > t + self._tolerance:
            count = 0 if any(isinstance(signal, DelayedSignal) for signal in self._time_signals) else _AHEAD
            times = np.array([t, *self.samples.following(count, self._fixed[-1])])
            values, k = values_after(self._time_signals, times, self._tolerance), 0
            self._ahead = times, values
        return np.asarray(values[:, k])

    def prolong(self, fixed: list[float], first: float, last: float) -> None:
        """Continue to a later end, with the breakpoints up to it."""
        self._fixed, self._ahead = [*fixed, last], (np.empty(0), np.empty((0, 0)))
        self._tolerance = time_tolerance(first, last)
        for signal in self._time_signals:
            if isinstance(signal, DelayedSignal | KnownDelaySignal):
                signal.tolerance = self._tolerance


class SampleTimes:
    """Times offset + k period at which discrete blocks are sampled, as fractions.

    Attributes
    ----------
    next : Fraction or float
        Time of the next sample [s]; infinite if there is none.
    """

    def __init__(self, network: Network, first: float) -> None:
        blocks = network.blocks_with("period")
        traits = {i: network.blocks[i].traits for i in blocks}
        periods = {i: as_fraction(traits[i].period or 0.0) for i in blocks}
        starts = {i: as_fraction(first) + as_fraction(traits[i].offset) for i in blocks}
        # Times and periods are whole numbers of a common unit.
        self._unit = math.lcm(*(value.denominator for value in (*periods.values(), *starts.values())))
        self._periods = {i: int(period * self._unit) for i, period in periods.items()}
        self._times = [(int(start * self._unit), i) for i, start in starts.items()]
        heapq.heapify(self._times)

    @property
    def next(self) -> Fraction | float:
        """Time of the next sample [s]; infinite if there is none."""
        return Fraction(self._times[0][0], self._unit) if self._times else np.inf

    @property
    def seconds(self) -> float:
        """The same as a float."""
        return self._times[0][0] / self._unit if self._times else math.inf

    def due(self, until: float) -> tuple[int, ...]:
        """Blocks with samples up to a time, which are then past."""
        found = []
        while self.seconds <= until:
            instant, i = self._times[0]
            heapq.heapreplace(self._times, (instant + self._periods[i], i))
            found.append(i)
        return tuple(sorted(found))

    def following(self, count: int, last: float) -> list[float]:
        """Times [s] of the next samples up to a time, at most so many."""
        later, found = self.copy(), list[float]()
        while len(found) < count and later.seconds <= last:
            found.append(later.seconds)
            later.due(found[-1])
        return found

    def copy(self) -> SampleTimes:
        """Same times, which advance separately."""
        other = copy(self)
        other._times = list(self._times)
        return other


def values_after(time_signals: Sequence[TimeSignal], times: Array, tolerance: float) -> Array:
    """Signals (nsignals, ntime) at times, after a breakpoint that differs from one by rounding."""
    end = float(np.nextafter(times[-1] + tolerance, np.inf)) if times.size else 0.0
    marks = [signal.breakpoints_between(times[0], end) if times.size else times for signal in time_signals]
    seen = [signal.at(after_marks(near, times, tolerance)) for signal, near in zip(time_signals, marks, strict=True)]
    return np.asarray(np.concatenate([np.zeros((0, times.size)), *seen]))


def check_periods(blocks: Sequence[Block], first: float, last: float) -> None:
    """Raise for sampled blocks with sample times that are not distinct in a run, or far too many."""
    for block in blocks:
        if float(block.period or 0.0) < 4.0 * time_tolerance(first, last):
            raise ValueError(
                f"the period of {block.name} must exceed the rounding of times up to "
                f"{max(abs(first), abs(last)):g} s, got {block.period:g} s"
            )
    counts = [(last - first) / float(block.period or np.inf) for block in blocks]
    if sum(counts) > SAMPLES:
        most = blocks[int(np.argmax(counts))]
        raise ValueError(
            f"a run must have at most {SAMPLES:.0e} sample times, got {sum(counts):.3g} in {last - first:g} s, with "
            f"the period of {most.name} of {most.period:g} s; use a longer period or a shorter run, or a continuous "
            "block in its place"
        )


def time_tolerance(first: float, last: float) -> float:
    """Difference of two times of a run [s] up to which they are considered equal."""
    return max(4.0 * np.finfo(float).eps * max(abs(first), abs(last)), _TOLERANCE * (last - first))


def as_fraction(seconds: float) -> Fraction:
    """Fraction with a small denominator that a number represents; otherwise its exact value."""
    digits = -1 - math.floor(math.log10(abs(seconds))) if seconds else 0
    unit = Fraction(10) ** max(0, digits)  # microseconds have as many digits as seconds
    simple = (unit * Fraction(seconds)).limit_denominator(_DENOMINATOR) / unit
    return simple if abs(float(simple) - seconds) <= 1e-15 * abs(seconds) else Fraction(seconds)


def known_before(time_signals: TimeSignals, times: Array) -> Array:
    """Signals (nsignals, ntime) that are known before a run; 0 for what becomes known during it."""
    if not any(isinstance(signal, DelayedSignal) for signal in time_signals):
        return time_signals.at(times)
    rows = [
        np.zeros((signal.width, times.size)) if isinstance(signal, DelayedSignal) else signal.at(times)
        for signal in time_signals
    ]
    return np.concatenate([np.zeros((0, times.size)), *rows])


def _combined_bounds(wire: Array, time_rows: NDArray[np.intp], series: Series) -> tuple[Array, Array]:
    """Bounds of sums of functions of time; infinite for other sums."""
    others = np.delete(wire, time_rows, axis=1)
    known = ~np.any(others != 0.0, axis=1)
    weights = wire[:, time_rows]
    ends = [
        np.where(weights != 0.0, weights, 0.0) * np.where(weights != 0.0, end, 0.0) for end in (series.low, series.high)
    ]
    low, high = np.minimum(*ends).sum(axis=1), np.maximum(*ends).sum(axis=1)
    return np.where(known, low, -np.inf), np.where(known, high, np.inf)


def _fixed(marks: Sequence[float], first: float, last: float, delays: list[float], hops: int) -> list[float]:
    """Breakpoints inside the run, also after shifts by delays."""
    found = {t for t in marks if first < t < last}
    fresh = {*found, first}
    for _ in range(hops if delays else 0):
        fresh = {t + delay for t in fresh for delay in delays if t + delay < last} - found
        if not fresh or len(found) + len(fresh) > _MARKS:
            break
        found |= fresh
    return apart([first, *sorted(found), last])[1:-1]


def apart(times: list[float]) -> list[float]:
    """Increasing times without those that are equal up to rounding; first and last are preserved."""
    distinct = [times[0]]
    for t in times[1:-1]:
        if t - distinct[-1] > 1e-14 * max(abs(t), times[-1] - times[0]) < times[-1] - t:
            distinct.append(t)
    return [*distinct, times[-1]]


def _rounded(values: Array) -> Array:
    """Values (nrows, ntime) with other last digits, larger and smaller in turn."""
    return np.asarray(values * (1.0 + _ROUNDINGS * np.finfo(float).eps * in_turn(values.shape)))


def _unresolved(coefficients: Array, resolution: float, rounding: Array) -> bool:
    size = np.abs(coefficients)
    allowed = np.maximum(resolution * size.max(axis=1), rounding)
    return bool(np.any(size[:, -3:] > allowed[:, None] + 1e-300))
