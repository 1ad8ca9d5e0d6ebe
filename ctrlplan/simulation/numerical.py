"""Numerical runs of a network from segment to segment, with scaled states and error estimates."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.budget import TimeLimitError
from ctrlplan.simulation.events import Snapshot, Watched, first_stop
from ctrlplan.simulation.held_outputs import HeldOutputs
from ctrlplan.simulation.interpreted import Interpreted, SolverError
from ctrlplan.simulation.job import Job, Record, fresh_job, with_event_times
from ctrlplan.simulation.network import Network
from ctrlplan.simulation.scales import (
    PASSES,
    Scales,
    Tolerances,
    effects,
    growth_rates,
    output_uncertainty,
    remaining,
    rounding_of,
)
from ctrlplan.simulation.segment_lengths import warn_of_short_delays
from ctrlplan.simulation.segments import NetworkRun, Solver, integrate, known_before
from ctrlplan.simulation.signals import Series, TimeSignals, breakpoints_of
from ctrlplan.symbolic.isolation import untouched

VISITED = 12
"""Number of visited states for checks, and for a comparison with Python without counted evaluations."""

_PERTURBATION = 1e-6
"""Perturbation of the initial state of a neighbouring run, relative to the scales of the states."""

_DISPLACED, _JITTER = 4, 1e-3
"""Number of visited states that are displaced at random for further Jacobians, and the relative displacement."""

_STEEP = 30.0
"""Ratio of (slope times state) to the largest derivative above which it counts as strongly nonlinear."""

_GROWTH, _TIGHTEST = 30.0, 1e4
"""Growth of a perturbation along a run above which tolerances are reduced, and the maximum reduction."""

_TIGHT, _COSTLY = 1e2, 10.0
"""Reduction of tolerances after which evaluations are counted, and the factor of their number that ends it: a method
of order 5 makes 2.5 times as many, and a hundred times where it resolves rounding errors of the equations.
"""

_SOME = 16
"""Every such time of a segment is searched for an event that ends the run, and all times after the run."""

_UNCERTAIN = 1e-6
"""Uncertainty of an output, relative to its range, above which it is reported in the response."""


class NumericalSolver(Solver, Protocol):
    """Solver of the equations of a network, and the equations at many times."""

    switches: list[float]
    """Times of the run [s] at which the equations are discontinuous, set before it; they are not evaluated there."""

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side so far, if they are counted."""

    @property
    def moving(self) -> NDArray[np.intp]:
        """Indices of the states that are integrated: those of blocks that are not sampled."""

    @property
    def calls_blocks(self) -> bool:
        """Whether functions of blocks are called, which may raise outside their domain."""

    @property
    def relative_by_state(self) -> bool:
        """Whether each state has a relative tolerance of its own."""

    def count(self) -> None:
        """Start counting evaluations."""

    def instants(self, first: float, last: float, values: Callable[[Array], Array]) -> list[float]:
        """Times at which the equations switch depending on functions of time (n,) -> (nsignals, n) only."""

    def rates(self, times: Array, states: Array, time_values: Array) -> Array:
        """Derivatives (nstates, ntime) of the states."""

    def slopes(self, times: Array, states: Array, time_values: Array) -> Array:
        """Jacobian of the integrated states, (ntime, nmoving, nmoving)."""


S = TypeVar("S", bound=NumericalSolver)


class NumericalMethod(Protocol[S]):
    """Method that solves differential equations from segment to segment."""

    @property
    def name(self) -> str:
        """Name of the method in `simulate`."""

    def solver(self, attempt: Attempt[S]) -> S:
        """Solver of an attempt, constructed before the run."""

    def check(self, attempt: Attempt[S]) -> None:
        """Raise if the result of an attempt is not valid."""


class History(Protocol[S]):
    """What earlier runs of the same equations required."""

    def expects_closer_states(self, attempt: Attempt[S]) -> bool:
        """Whether a run had to be repeated with closer states."""

    def expect_closer_states(self, attempt: Attempt[S]) -> None:
        """Note that an attempt has to be repeated with closer states."""


def numerical(job: Job, method: NumericalMethod[S], history: History[S] | None = None) -> Record:
    """Record of a numerical run, repeated with the scales of the states and if its accuracy requires it."""
    if job.blocks.blocks_with("delay"):
        signals = job.prepared.time_signals(job.inputs, job.first)
        warn_of_short_delays(job.blocks, signals, float(job.times[-1]) - job.first)
    fresh = fresh_job(job)
    attempt = _first(job, method, history)
    scales = attempt.scales
    for _ in range(PASSES - 1 if job.atol is None else 0):
        found = scales.renewed(attempt.hull, attempt.moving, attempt.noise, attempt.passed_on)
        if found is None:
            break
        following = Attempt(fresh, method, found)
        try:
            following.go()
        except SolverError:  # the previous run is returned, with a note on its accuracy
            break
        scales, attempt = found, following
    if job.atol is None and attempt.expands():
        attempt = _tightened(attempt, fresh)
    if attempt.tighter == 1.0:
        attempt = _with_closer_states(attempt, fresh, history)
    return attempt.record()


def _first(job: Job, method: NumericalMethod[S], history: History[S] | None) -> Attempt[S]:
    """First run, with closer states if one of the same equations required them before."""
    attempt = Attempt(job, method, Scales.plain(job.state.size, job.atol))
    if history is not None and history.expects_closer_states(attempt):
        closer = Attempt(fresh_job(job), method, attempt.scales.closer())
        with suppress(SolverError):
            closer.go()
            return closer
    attempt.go()
    return attempt


def _tightened(attempt: Attempt[S], fresh: Job) -> Attempt[S]:
    """Run repeated with smaller tolerances if a perturbation of the initial state grows, as a second run shows."""
    scales, perturbation = attempt.scales, _PERTURBATION * attempt.scales.scale
    perturbation = perturbation * np.where(np.arange(perturbation.size) % 2, -1.0, 1.0)
    try:
        near = Attempt(replace(fresh, state=fresh.state + perturbation), attempt.method, scales)
        near.solver.count()
        near.go()
    except SolverError:
        return attempt
    common, mine, others = np.intersect1d(attempt.run.times, near.run.times, return_indices=True)
    apart = np.abs(attempt.run.states[:, mine] - near.run.states[:, others]).max(axis=1, initial=0.0)
    growth = float((apart / np.abs(perturbation)).max(initial=1.0)) if common.size else 1.0
    attempt.growth = growth
    if growth <= _GROWTH:
        return attempt
    found = attempt
    for tighter in sorted({min(growth / _GROWTH, limit) for limit in (_TIGHT, _TIGHTEST)}):
        again = Attempt(fresh, attempt.method, scales, tighter)
        again.solver.count()
        try:
            again.go()
        except SolverError:
            break
        again.growth, found = growth, again
        if again.solver.evaluations > _COSTLY * near.solver.evaluations:
            break
    return found


def _with_closer_states(attempt: Attempt[S], fresh: Job, history: History[S] | None) -> Attempt[S]:
    """Run repeated with tighter tolerances of large states if others depend on their absolute error, as on an angle."""
    loose = attempt.loose()
    if not loose.any():
        return attempt
    if history is not None:
        history.expect_closer_states(attempt)
    try:
        scales = attempt.scales.with_closer_states(
            attempt.hull,
            loose,
            attempt.noise(),
            attempt.solver.evaluations if attempt.solver.relative_by_state else None,
        )
        again = Attempt(fresh, attempt.method, scales)
        again.solver.count()
        again.go()
    except SolverError:
        own = attempt.scales.uncertainty(attempt.hull, attempt.job.rtol)
        attempt.drift = np.zeros(own.size)
        attempt.drift[attempt.moving] = own[attempt.moving] @ attempt.effects.T
        return attempt
    _, first, second = np.intersect1d(attempt.run.times, again.run.times, return_indices=True)
    apart = np.abs(attempt.run.states[:, first] - again.run.states[:, second]).max(axis=1, initial=0.0)
    again.drift = apart * remaining(apart, again.run.states, loose, again.solver.evaluations)
    return again


@dataclass(eq=False)
class Attempt(Generic[S]):
    """One run with given scales of the states.

    Attributes
    ----------
    job, method, scales
        The job, the method, and the scales of the states.
    tighter : float
        Factor by which the tolerances of a step are reduced.
    growth : float
        Growth of a perturbation of the initial state.
    time_signals : TimeSignals
        Inputs, then outputs of blocks that are functions of time.
    copies : Network
        Network for trial calls, with copies of blocks that have memory.
    """

    job: Job
    method: NumericalMethod[S]
    scales: Scales
    tighter: float = 1.0
    growth: float = 1.0
    drift: Array | float = 0.0
    time_signals: TimeSignals = field(init=False)
    watched: tuple[Watched, ...] = field(init=False)
    copies: Network = field(init=False)
    solver: S = field(init=False)
    run: NetworkRun = field(init=False)
    _last: tuple[Array, Array] | None = field(init=False, default=None)
    _whole: Snapshot | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        job = self.job
        self.time_signals, self.watched = job.prepared.time_signals(job.inputs, job.first), job.watched()
        self.copies = job.blocks.for_trials()
        self.solver = self.method.solver(self)

    @cached_property
    def equations(self) -> Interpreted | None:
        """Equations evaluated by Python; None without blocks."""
        return equations_of(self.job, self.job.blocks)

    @property
    def stops(self) -> bool:
        """Whether an event may end the run."""
        return any(entry.stop for entry in self.watched)

    def go(self) -> None:
        """Run, and check the result."""
        job = self.job
        marks = self.solver.instants(job.first, float(job.times[-1]), lambda t: known_before(self.time_signals, t))
        self.solver.switches = sorted([*job.blocks.breakpoints, *marks])
        by_python = job.blocks.blocks_with("period") or job.blocks.blocks_with("delay")
        run = integrate(
            job.blocks,
            self.equations if by_python else None,
            self.solver,
            self.time_signals,
            with_event_times(job.times, self.watched, self._initial_slope),
            job.state,
            resolution=10.0 * job.rtol,
            marks=marks,
            stops=self if self.stops else None,
        )
        self.run = self._ended(run) if self.stops else run
        self.method.check(self)

    def loose(self) -> NDArray[np.bool_]:
        """States (nstates,) whose tolerances are too large for the accuracy of other states."""
        states, scales, moving = self.hull, self.scales, self.moving
        loose = np.zeros(len(states), dtype=bool)
        if moving.size < 2 or not np.isfinite(states).all():
            return loose
        error = scales.uncertainty(states, self.job.rtol)[moving]
        allowed = max(_UNCERTAIN, 100.0 * self.job.rtol) * np.ptp(states, axis=1) + 10.0 * scales.atol * scales.scale
        allowed = allowed[moving]
        found = self.effects * error > allowed[:, None]
        if found.any() and self.job.blocks.blocks_with("period"):
            # Feedback through samples is not in the Jacobian: only strongly nonlinear dependence counts.
            t, x, time_values = self.visited
            size, rates = np.abs(states - scales.shift[:, None]).max(axis=1), self.solver.rates(t, x, time_values)
            size, rates = size[moving], rates[moving]
            found &= np.abs(self._slopes[: t.size]).max(axis=0) * size > _STEEP * np.abs(rates).max(
                axis=1, keepdims=True
            )
        loose[moving] = found.any(axis=0)
        return loose

    @cached_property
    def hull(self) -> Array:
        """States (nstates, 3): initial ones, minima and maxima of the run, nan where a state is."""
        states = self.run.states
        return np.stack([states[:, 0], states.min(axis=1), states.max(axis=1)], axis=1)

    @property
    def moving(self) -> NDArray[np.intp]:
        """Indices of the states that are integrated."""
        return self.solver.moving

    @cached_property
    def effects(self) -> Array:
        """Largest displacement of each integrated state by a unit error of another, shape (nmoving, nmoving)."""
        return effects(self._slopes, float(self.run.times[-1] - self.run.times[0]), self._growth_rates)

    @cached_property
    def _growth_rates(self) -> Array:
        """Largest growth rates of perturbations at the points of `_slopes`; nan where they are not finite."""
        return growth_rates(self._slopes)

    @cached_property
    def _slopes(self) -> Array:
        """Jacobians of the integrated states, (nplaces, nmoving, nmoving), first at the visited times."""
        t, x, time_values = self.visited
        some = slice(None, None, VISITED // _DISPLACED)
        # At samples that are full turns of an angle apart, the slope of its sine is the same and may be 0.
        displaced = x[:, some] * (1.0 + _JITTER * _random(*x[:, some].shape))
        places = (
            np.append(t, t[some]),
            np.append(x, displaced, axis=1),
            np.append(time_values, time_values[:, some], axis=1),
        )
        return on_trial(self.solver, self.solver.slopes, *places, (-1, self.moving.size, self.moving.size))

    def record(self) -> Record:
        """Record of the run, with a note on its accuracy if that is insufficient."""
        is_pure = not self.solver.calls_blocks
        reason = _reason_of(self)
        return Record(
            self.run.times,
            self.run.states,
            self._snapshot,
            self._state_at,
            self.watched,
            self.method.name,
            reason if is_pure else reason(),
            is_pure,
            self._snapshot_inside,
            self._held,
        )

    def expands(self) -> bool:
        """Whether neighbouring solutions may diverge, by the largest growth rate along the run."""
        t = self.visited[0]
        rates = self._growth_rates[: t.size]
        if t.size < 2 or not self._slopes.size or not np.isfinite(rates).all():
            return False
        return float(0.5 * (t[1:] - t[:-1]) @ (rates[1:] + rates[:-1])) > math.log(_GROWTH)

    @property
    def tolerances(self) -> Tolerances:
        """Tolerances of a step for which the accumulated errors stay within the tolerances of the run."""
        job, network = self.job, self.job.blocks
        first, last = job.first, float(job.times[-1])
        marks = {t for t in (*breakpoints_of(self.time_signals, first, last), *network.breakpoints) if first < t < last}
        samples = sum((last - first) / float(network.blocks[i].period or 1.0) for i in network.blocks_with("period"))
        return Tolerances.of_run(job.rtol, self.scales, len(marks) + int(samples), self.tighter)

    def noise(self) -> Array:
        """Rounding errors of the derivatives along the run, times its duration."""
        t, x, time_values = self.visited
        duration = float(self.run.times[-1] - self.run.times[0])
        shape = (len(x), -1)
        rates = partial(on_trial, self.solver, self.solver.rates)
        return duration * rounding_of(lambda near: rates(t, near, time_values, shape), x)

    def passed_on(self, errors: Array) -> Array:
        """Errors (nstates,) of the integrated states caused by errors of others."""
        found = np.zeros(errors.size)
        found[self.moving] = self.effects @ errors[self.moving]
        return found

    @cached_property
    def visited(self) -> tuple[Array, Array, Array]:
        """Some times and states of the run, and the values of the functions of time."""
        some = _evenly(self.run.times.size)
        t = self.run.times[some]
        return t, self.run.states[:, some], self.time_signals.at(t)

    def time_values(self, t: Array) -> Array:
        """Values (nsignals, ntime) of the functions of time; those of the last call if the times are the same."""
        if self._last is None or not np.array_equal(t, self._last[0]):
            self._last = t, self.time_signals.at(t)
        return self._last[1]

    def _snapshot(self, t: Array, x: Array) -> Snapshot:
        known = self._whole
        return known if known is not None and t is known.t and x is known.x else self._new_snapshot(t, x)

    def _new_snapshot(self, t: Array, x: Array) -> Snapshot:
        ninputs = self.job.prepared.ninputs
        if not ninputs:
            return _seen(self.solver, t, x, np.zeros((0, t.size)), partial(self.time_values, t))
        known = self.time_values(t)  # the caller may change samples later
        return _seen(self.solver, t, x, known[:ninputs], lambda: known)

    def _held(self) -> HeldOutputs | None:
        """Outputs that discrete blocks hold, from the start of each segment: they are sampled at these times only."""
        rows, run = self.job.blocks.held_outputs, self.run
        if not rows.size:
            return None
        times = np.unique([*(start for start, _ in run.segments), float(run.times[-1])])
        seen = self._snapshot(times, run.states[:, np.searchsorted(run.times, times)])
        return HeldOutputs(times, rows, seen.y.reshape(-1, times.size)[rows])

    def _snapshot_inside(self, t: Array, x: Array) -> Snapshot:
        """Snapshot at one time, with the series of the functions of time."""
        known = self.run.series(float(t[0]))(float(t[0]))[:, None]
        return _seen(self.solver, t, x, known[: self.job.prepared.ninputs], lambda: known)

    def _state_at(self, k: int, t: float) -> Array:
        start = float(self.run.times[k])
        found: Array = self.solver.advance(self.run.series(start), start, np.array([t]), self.run.states[:, k])
        return found[:, -1]

    def within(self, series: Series, times: Array, states: Array) -> bool:
        """Whether an event that ends the run has occurred at a few of the times of a segment."""
        some = slice((times.size - 1) % _SOME, None, _SOME)
        t, known = times[some], series.at(times[some])
        seen = _seen(self.solver, t, states[:, some], known[: self.job.prepared.ninputs], lambda: known)
        return self._stop_of(seen) is not None

    def first(self, run: NetworkRun) -> int | None:
        """Index of the first time of a run by which an event that ends it has occurred."""
        return self._stop_of(self._new_snapshot(run.times, run.states))

    def _ended(self, run: NetworkRun) -> NetworkRun:
        """The run up to the first event that ends it; its snapshot is kept."""
        seen = self._new_snapshot(run.times, run.states)
        stop = self._stop_of(seen)
        if stop is not None and stop < run.times.size - 1:
            return run.until(stop)
        self._whole = seen
        return run

    def _stop_of(self, seen: Snapshot) -> int | None:
        """Index of the first time, after that of the start, by which an event that ends a run has occurred."""
        stop = first_stop(self.watched, seen)
        return None if stop is None else max(1, stop)

    def _initial_slope(self) -> Array:
        """Jacobian by the states at the start of the run; nan where blocks raise."""
        t, n = self.job.times[:1], self.job.state.size
        with np.errstate(all="ignore"):
            places = t, self.job.state[:, None], self.time_signals.at(t)
            return np.asarray(on_trial(self.solver, self.solver.slopes, *places, (-1, n, n))[0])


@lru_cache(maxsize=32)
def _evenly(count: int) -> NDArray[np.intp]:
    """Indices of the visited states among those at so many times."""
    found = np.unique(np.linspace(0, count - 1, VISITED).astype(np.intp))
    found.flags.writeable = False
    return found


@lru_cache(maxsize=32)
def _random(nrows: int, ncolumns: int) -> Array:
    """Random numbers between -1 and 1, the same in every run."""
    found = np.random.default_rng(0).uniform(-1.0, 1.0, (nrows, ncolumns))
    found.flags.writeable = False
    return found


def equations_of(job: Job, network: Network) -> Interpreted | None:
    """Equations evaluated by Python; None without blocks."""
    return Interpreted(network, job.params, (job.first, job.state), job.trials) if network.blocks else None


def _seen(solver: NumericalSolver, t: Array, x: Array, u: Array, time_values: Callable[[], Array]) -> Snapshot:
    """Snapshot of a run."""
    return Snapshot(t, x, u, lambda: solver.outputs(t, x, time_values()), lambda: solver.signals(t, x, time_values()))


def on_trial(
    solver: NumericalSolver,
    function: Callable[[Array, Array, Array], Array],
    t: Array,
    x: Array,
    time_values: Array,
    shape: tuple[int, ...],
) -> Array:
    """Values of a function at states that a run may not have reached; nan where blocks raise.

    In `shape`, that of the result, -1 is the axis of the times.
    """
    if not solver.calls_blocks:
        return function(t, x, time_values)
    axis, empty = shape.index(-1), np.full([abs(size) for size in shape], np.nan)

    def at(some: slice) -> Array | None:
        try:
            return function(t[some], x[:, some], time_values[:, some])
        except (KeyboardInterrupt, TimeLimitError):
            raise
        except BaseException:  # outside the domain of a block, as a perturbed argument may be
            return None

    with untouched():
        whole = at(slice(None))
        if whole is not None:
            return whole
        found = [at(slice(k, k + 1)) for k in range(t.size)]
    return np.concatenate([empty if part is None else part for part in found], axis=axis)


def _reason_of(attempt: Attempt[S]) -> Callable[[], str]:
    """Function that returns why the method was chosen, with a note on uncertain outputs if there are any."""
    job, hull, solver, scales = attempt.job, attempt.hull, attempt.solver, attempt.scales
    t, x, time_values = attempt.visited
    reason, labels, moving = job.reason, job.prepared.output_labels, attempt.moving
    if not x.size or not np.isfinite(x).all():
        return lambda: reason
    own = scales.with_sampled(hull, moving).uncertainty(hull, job.rtol) * attempt.growth / attempt.tighter
    drift, rtol, relative, expands = attempt.drift, job.rtol, scales.relative, attempt.growth > _GROWTH

    def outputs(near: Array) -> Array:
        copies = near.shape[1] // t.size
        places = np.tile(t, copies), near, np.tile(time_values, copies)
        return on_trial(solver, solver.outputs, *places, (len(labels), -1))

    def found() -> str:
        worst, ranges = output_uncertainty(outputs, x, own + drift, moving)
        allowed = max(_UNCERTAIN, 100.0 * rtol) * ranges
        uncertain = (ranges > 0.0) & (worst > allowed)
        if not uncertain.any():
            return reason
        part = np.where(uncertain, worst / np.where(uncertain, ranges, 1.0), 0.0)
        names = ", ".join(np.array(labels)[uncertain])
        needed = rtol * _UNCERTAIN / float(part.max())
        what = "diverge from neighbouring solutions" if expands else "are differences of larger terms"
        if np.any(drift > own):
            what = "depend on small fractions of large states"
        advice = (
            f"rtol = {needed:.0e} suffices for {_UNCERTAIN:.0e}"
            if needed > 1e-12 / relative.min()
            else "no tolerance suffices"
        )
        return (
            f"{reason}; outputs {names} {what} and are uncertain by about {float(part.max()):.1g} of their range: "
            f"{advice}"
        )

    return found
