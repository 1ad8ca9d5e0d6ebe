"""Numerical runs of a network: from segment to segment, in scales that fit the states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid

from ctrlplan._types import Array
from ctrlplan.simulation.budget import TimeLimitError
from ctrlplan.simulation.events import Snapshot, Watched
from ctrlplan.simulation.interpreted import Interpreted, SolverError
from ctrlplan.simulation.job import Job, Record, fresh_job, with_event_times
from ctrlplan.simulation.network import Network
from ctrlplan.simulation.scales import PASSES, Scales, Tolerances, effects, output_uncertainty, remaining
from ctrlplan.simulation.segments import Run, Solver, integrate, known_before
from ctrlplan.simulation.signals import TimeSignal, breakpoints_of, signal_values
from ctrlplan.symbolic.isolation import untouched

VISITED = 12
"""Visited states at which equations must be defined; and of a comparison where evaluations were not counted."""

_PERTURBATION = 1e-6
"""Distance, in the scales of the states, at which a neighbouring run starts."""

_DISPLACED, _JITTER = 4, 1e-3
"""Visited states that are displaced at random to see slopes elsewhere, and by which part of their size."""

_STEEP = 30.0
"""Change of a rate by a whole state, as its slope has it, over the largest rate, above which it bends on the way."""

_GROWTH, _TIGHTEST = 30.0, 1e4
"""Growth of a distance along a run above which steps are made with smaller tolerances, and how much smaller at most."""

_UNCERTAIN = 1e-6
"""Uncertainty of an output, relative to its range, above which the response says so."""


class NumericalSolver(Solver, Protocol):
    """Solver of a network's equations, and the equations themselves at many times."""

    switches: list[float]
    """Times of the run [s] at which the equations jump, set before it: no evaluation lies on one."""

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side so far, where they are counted."""

    @property
    def calls_blocks(self) -> bool:
        """Whether the blocks' own functions are called, which may raise outside of their domain."""

    @property
    def relative_by_state(self) -> bool:
        """Whether each state has a relative tolerance of its own."""

    def count(self) -> None:
        """Count evaluations from now on."""

    def instants(self, first: float, last: float, values: Callable[[Array], Array]) -> list[float]:
        """Times of a run at which the equations switch, where functions of time (n,) -> (nsignals, n) alone decide."""

    def rates(self, times: Array, states: Array, time_values: Array) -> Array:
        """Rates (nstates, ntime) of the states."""

    def slopes(self, times: Array, states: Array, time_values: Array) -> Array:
        """Derivatives of the rates by the states, (ntime, nstates, nstates)."""


S = TypeVar("S", bound=NumericalSolver)


class NumericalMethod(Protocol[S]):
    """Method that solves differential equations from segment to segment."""

    @property
    def name(self) -> str:
        """Name by which `simulate` takes it."""

    def solver(self, attempt: Attempt[S]) -> S:
        """Solver of one attempt, built before it runs."""

    def check(self, attempt: Attempt[S]) -> None:
        """Raise where what an attempt has found does not hold."""


def numerical(job: Job, method: NumericalMethod[S]) -> Record:
    """Run from segment to segment, repeated where the scales of the states were not known."""
    scales, fresh = Scales.plain(job.state.size, job.atol), fresh_job(job)
    attempt = Attempt(job, method, scales)
    attempt.go()
    for _ in range(PASSES - 1 if job.atol is None else 0):
        found = scales.renewed(attempt.run.states, attempt.noise)
        if found is None:
            break
        following = Attempt(fresh, method, found)
        try:
            following.go()
        except SolverError:  # the run before stands, with what is said of its accuracy
            break
        scales, attempt = found, following
    if job.atol is None and attempt.expands():
        attempt = _tightened(attempt, fresh)
    if attempt.tighter == 1.0:
        attempt = _with_closer_states(attempt, fresh)
    return attempt.record()


def _tightened(attempt: Attempt[S], fresh: Job) -> Attempt[S]:
    """Run whose errors of steps grow: measured by a run from beside, and made again with smaller ones."""
    scales, perturbation = attempt.scales, _PERTURBATION * attempt.scales.scale
    perturbation = perturbation * np.where(np.arange(perturbation.size) % 2, -1.0, 1.0)
    try:
        near = Attempt(replace(fresh, state=fresh.state + perturbation), attempt.method, scales)
        near.go()
    except SolverError:
        return attempt
    common, mine, others = np.intersect1d(attempt.run.times, near.run.times, return_indices=True)
    apart = np.abs(attempt.run.states[:, mine] - near.run.states[:, others]).max(axis=1, initial=0.0)
    growth = float((apart / np.abs(perturbation)).max(initial=1.0)) if common.size else 1.0
    attempt.growth = growth
    if growth <= _GROWTH:
        return attempt
    tighter = min(growth / _GROWTH, _TIGHTEST)
    try:
        again = Attempt(fresh, attempt.method, scales, tighter)
        again.go()
    except SolverError:
        return attempt
    again.growth = growth
    return again


def _with_closer_states(attempt: Attempt[S], fresh: Job) -> Attempt[S]:
    """Run again, with large states integrated more closely where others depend on them absolutely, as on an angle."""
    loose = attempt.loose()
    if not loose.any():
        return attempt
    try:
        scales = attempt.scales.with_closer_states(
            attempt.run.states, loose, attempt.noise(), attempt.solver.relative_by_state
        )
        again = Attempt(fresh, attempt.method, scales)
        again.solver.count()
        again.go()
    except SolverError:
        attempt.drift = attempt.scales.uncertainty(attempt.run.states, attempt.job.rtol) @ attempt.effects.T
        return attempt
    _, first, second = np.intersect1d(attempt.run.times, again.run.times, return_indices=True)
    apart = np.abs(attempt.run.states[:, first] - again.run.states[:, second]).max(axis=1, initial=0.0)
    again.drift = apart * remaining(apart, again.run.states, loose, again.solver.evaluations)
    return again


@dataclass(eq=False)
class Attempt(Generic[S]):
    """One run with some scales of the states.

    Attributes
    ----------
    job, method, scales
        What is run, how, and in which coordinates.
    tighter : float
        Factor by which the tolerances of a step are smaller than usual.
    growth : float
        Measured growth of the distance of neighbouring solutions.
    time_signals : list of TimeSignal
        Inputs, then the outputs of blocks that are functions of time.
    copies : Network
        Same network, with blocks whose memory is not that of the run: for trial calls.
    equations : Interpreted or None
        By Python; None without blocks.
    """

    job: Job
    method: NumericalMethod[S]
    scales: Scales
    tighter: float = 1.0
    growth: float = 1.0
    drift: Array | float = 0.0
    time_signals: list[TimeSignal] = field(init=False)
    watched: tuple[Watched, ...] = field(init=False)
    equations: Interpreted | None = field(init=False)
    copies: Network = field(init=False)
    solver: S = field(init=False)
    run: Run = field(init=False)

    def __post_init__(self) -> None:
        job, network = self.job, self.job.blocks
        self.time_signals, self.watched = job.prepared.time_signals(job.inputs, job.first), job.watched()
        self.equations, self.copies = equations_of(job, network), network.for_trials()
        self.solver = self.method.solver(self)

    @property
    def stops(self) -> bool:
        """Whether an event may end the run."""
        return any(entry.stop for entry in self.watched)

    def go(self) -> None:
        """Run, and check what was found."""
        job = self.job
        marks = self.solver.instants(job.first, float(job.times[-1]), lambda t: known_before(self.time_signals, t))
        self.solver.switches = sorted([*job.blocks.breakpoints, *marks])
        self.run = integrate(
            job.blocks,
            self.equations,
            self.solver,
            self.time_signals,
            with_event_times(job.times, self.watched, self._slope),
            job.state,
            resolution=10.0 * job.rtol,
            marks=marks,
            stops_after=self._stops_after if self.stops else None,
        )
        self.method.check(self)

    def loose(self) -> NDArray[np.bool_]:
        """States (nstates,) whose tolerated error is too large for other states."""
        states, scales = self.run.states, self.scales
        if len(states) < 2 or not np.isfinite(states).all():
            return np.zeros(len(states), dtype=bool)
        error = scales.uncertainty(states, self.job.rtol)
        allowed = max(_UNCERTAIN, 100.0 * self.job.rtol) * np.ptp(states, axis=1) + 10.0 * scales.atol * scales.scale
        found = self.effects * error > allowed[:, None]
        if found.any() and self.job.blocks.blocks_with("period"):
            # What feeds back from sample to sample is in no slope: only what others depend on absolutely counts.
            t, x, time_values = self.visited()
            size, rates = np.abs(states - scales.shift[:, None]).max(axis=1), self.solver.rates(t, x, time_values)
            found &= np.abs(self._slopes[: t.size]).max(axis=0) * size > _STEEP * np.abs(rates).max(
                axis=1, keepdims=True
            )
        return np.asarray(found.any(axis=0))

    @cached_property
    def effects(self) -> Array:
        """Largest displacement of each state by a lasting one of another, of size 1, shape (nstates, nstates)."""
        return effects(self._slopes, float(self.run.times[-1] - self.run.times[0]))

    @cached_property
    def _slopes(self) -> Array:
        """Derivatives of the rates by the states, (nplaces, nstates, nstates), first at the visited times."""
        t, x, time_values = self.visited()
        some = slice(None, None, VISITED // _DISPLACED)
        # Samples that are a turn of an angle apart see one slope of its sine, which may be 0.
        displaced = x[:, some] * (1.0 + _JITTER * np.random.default_rng(0).uniform(-1.0, 1.0, x[:, some].shape))
        places = (
            np.append(t, t[some]),
            np.append(x, displaced, axis=1),
            np.append(time_values, time_values[:, some], axis=1),
        )
        return self.on_trial(self.solver.slopes, *places, (-1, len(x), len(x)))

    def on_trial(
        self,
        function: Callable[[Array, Array, Array], Array],
        t: Array,
        x: Array,
        time_values: Array,
        shape: tuple[int, ...],
    ) -> Array:
        """What a function of many times finds at states that a run need not have reached; nan where blocks raise.

        Its result has a shape, in which -1 stands for the times.
        """
        if not self.solver.calls_blocks:
            return function(t, x, time_values)
        axis, empty = shape.index(-1), np.full([abs(size) for size in shape], np.nan)

        def at(some: slice) -> Array | None:
            try:
                return function(t[some], x[:, some], time_values[:, some])
            except (KeyboardInterrupt, TimeLimitError):
                raise
            except BaseException:  # outside of a block's domain, which a made-up argument may leave
                return None

        with untouched():
            whole = at(slice(None))
            if whole is not None:
                return whole
            found = [at(slice(k, k + 1)) for k in range(t.size)]
        return np.concatenate([empty if part is None else part for part in found], axis=axis)

    def record(self) -> Record:
        """What the run left, and how accurate it is where that is worse than usual."""
        said = _accuracy_note(self)
        reason = f"{self.job.reason}; {said}" if said else self.job.reason
        return Record(
            self.run.times, self.run.states, self._snapshot, self._state_at, self.watched, self.method.name, reason
        )

    def expands(self) -> bool:
        """Whether neighbouring solutions may part, by the fastest growing motion along the run."""
        t = self.visited()[0]
        slopes = self._slopes[: t.size]
        if t.size < 2 or not slopes.size or not np.isfinite(slopes).all():
            return False
        rates = np.maximum(np.linalg.eigvals(slopes).real.max(axis=1), 0.0)
        return float(trapezoid(rates, t)) > math.log(_GROWTH)

    @property
    def tolerances(self) -> Tolerances:
        """Tolerances of a step, so that the errors of all segments stay within those of the run."""
        job, network = self.job, self.job.blocks
        first, last = job.first, float(job.times[-1])
        marks = {t for t in (*breakpoints_of(self.time_signals), *network.breakpoints) if first < t < last}
        samples = sum((last - first) / float(network.blocks[i].period or 1.0) for i in network.blocks_with("period"))
        return Tolerances.of_run(job.rtol, self.scales, len(marks) + int(samples), self.tighter)

    def noise(self) -> Array:
        """Rounding noise of the rates along the run, times its duration."""
        t, x, time_values = self.visited()
        rng = np.random.default_rng(0)
        plain, found = self.on_trial(self.solver.rates, t, x, time_values, (len(x), -1)), np.zeros(len(x))
        for _ in range(3):
            near = x * (1.0 + np.finfo(float).eps * rng.choice([-1.0, 1.0], x.shape))
            apart = np.abs(self.on_trial(self.solver.rates, t, near, time_values, (len(x), -1)) - plain)
            found = np.maximum(found, np.where(np.isfinite(apart), apart, 0.0).max(axis=1, initial=0.0))
        return found * float(self.run.times[-1] - self.run.times[0])

    def visited(self) -> tuple[Array, Array, Array]:
        """Some times and states of the run, and the functions of time there."""
        some = np.unique(np.linspace(0, self.run.times.size - 1, VISITED).astype(int))
        t = self.run.times[some]
        return t, self.run.states[:, some], signal_values(self.time_signals, t)

    def _snapshot(self, t: Array, x: Array) -> Snapshot:
        time_values = signal_values(self.time_signals, t)
        y = self.solver.outputs(t, x, time_values)
        return Snapshot(
            t, x, time_values[: self.job.prepared.ninputs], y, lambda: self.solver.signals(t, x, time_values)
        )

    def _state_at(self, k: int, t: float) -> Array:
        start = float(self.run.times[k])
        found: Array = self.solver.advance(self.run.series(start), start, np.array([t]), self.run.states[:, k])
        return found[:, -1]

    def _stops_after(self, t: Array, x: Array) -> bool:
        seen = self._snapshot(t, x)
        return any(entry.side(entry.value(seen)).any() for entry in self.watched if entry.stop)

    def _slope(self) -> Array:
        equations, job = self.equations, self.job
        if equations is None:
            return np.zeros((0, 0))
        time_values = signal_values(self.time_signals, job.times[:1])[:, 0]
        return _slope(lambda x: equations.rates(job.first, x, time_values), job.state)


def equations_of(job: Job, network: Network) -> Interpreted | None:
    """Equations by Python, where there are blocks."""
    return Interpreted(network, job.params, (job.first, job.state), job.trials) if network.blocks else None


def _accuracy_note(attempt: Attempt[S]) -> str:
    """What is uncertain in the outputs, and the tolerance that would do, in words; empty where nothing is."""
    job, run, solver, scales = attempt.job, attempt.run, attempt.solver, attempt.scales
    some = np.unique(np.linspace(0, run.times.size - 1, VISITED).astype(int))
    t, x = run.times[some], run.states[:, some]
    if not x.size or not np.isfinite(x).all():
        return ""
    time_values = signal_values(attempt.time_signals, t)
    own = scales.uncertainty(run.states, job.rtol) * attempt.growth / attempt.tighter
    uncertainty, count = own + attempt.drift, len(job.prepared.output_labels)
    worst, ranges = output_uncertainty(
        lambda near: attempt.on_trial(solver.outputs, t, near, time_values, (count, -1)), x, uncertainty
    )
    allowed = max(_UNCERTAIN, 100.0 * job.rtol) * ranges
    uncertain = (ranges > 0.0) & (worst > allowed)
    if not uncertain.any():
        return ""
    part = np.where(uncertain, worst / np.where(uncertain, ranges, 1.0), 0.0)
    names = ", ".join(np.array(job.prepared.output_labels)[uncertain])
    needed = job.rtol * _UNCERTAIN / float(part.max())
    what = "are differences of larger terms" if attempt.growth <= _GROWTH else "diverge from neighbouring solutions"
    if np.any(attempt.drift > own):
        what = "depend on small fractions of large states"
    advice = f"rtol = {needed:.0e} suffices" if needed > 1e-12 / scales.relative.min() else "no tolerance suffices"
    return f"outputs {names} {what} and are uncertain by about {float(part.max()):.1g} of their range: {advice}"


def _slope(rates: Callable[[Array], Array], state: Array) -> Array:
    """Derivatives of rates by the states, by differences."""
    steps = 1e-6 * (1.0 + np.abs(state))
    with np.errstate(all="ignore"):
        before = rates(state)
        columns = [
            (rates(state + step * unit) - before) / step for step, unit in zip(steps, np.eye(state.size), strict=True)
        ]
    return np.array(columns).T.reshape(state.size, state.size)
