"""The ways to run a loop: exact, compiled, by Python, from sample to sample."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan.simulation.drives import Drive, PlanDrive, SampledDrive, breakpoints_of, driven_signals
from ctrlplan.simulation.events import Event, Snapshot, Watched, watched_events
from ctrlplan.simulation.exact import exact_states, sampled_states
from ctrlplan.simulation.interpreted import Interpreted, InterpretedSolver, SolverError
from ctrlplan.simulation.legs import integrate
from ctrlplan.simulation.linear import LinearForm
from ctrlplan.simulation.prepared import DisagreementError, NotCompiledError, Prepared

Array = NDArray[np.float64]

METHODS = ("auto", "exact", "compiled", "python")

_LOOKS = 400, 20_000
"""Times at least and at most, beside those asked for, at which the signals of events are looked at."""

_LOOKS_A_TURN = 16
"""Such times in a turn of the fastest oscillation about the state where a run begins."""

_VISITED = 12
"""Visited states at which a compiled system is compared with Python."""


_LOST = 1e-6
"""Part of an output's size from which on a doubt about it is said."""

_MOST_STEPS = 1e8
"""Steps of a discrete system in a run."""

_OFF_CLOCK = 1e-5
"""Part of a sampling time by which a time may miss an instant, besides rounding of the times."""


@dataclass(frozen=True, eq=False)
class Job:
    """What one call of `simulate` asks for."""

    prepared: Prepared
    times: Array
    inputs: list[Drive]
    state: Array
    params: dict[str, Any]
    tolerances: tuple[float, float]
    events: Sequence[Event] | None

    @property
    def first(self) -> float:
        """Where the run begins [s]."""
        return float(self.times[0])

    def watched(self) -> tuple[Watched, ...]:
        """Events asked for, and unless none are wanted those that blocks declare."""
        prepared = self.prepared
        # An output hides an input or a state of the same name.
        kinds = (("u", prepared.input_labels), ("x", prepared.state_labels), ("y", prepared.output_labels))
        labels = {label: (kind, row) for kind, names in kinds for row, label in enumerate(names)}
        asked = watched_events(self.events or (), labels)
        if self.events is not None and not self.events:
            return ()
        known = prepared.network.watched if prepared.network is not None else ()
        declared = [
            Watched(w.name, partial(_of_block, w.function, w.states, w.fed, {**w.params, **self.params}), w.low, w.high)
            for w in known
        ]
        return (*declared, *asked)


@dataclass(frozen=True, eq=False)
class Record:
    """States at the times of a run, and how to see more of it.

    Attributes
    ----------
    times, states : ndarray, shapes (ntime,) and (nstates, ntime)
        As far as the run went.
    see : callable
        Maps times and states to all signals.
    carry : callable
        Maps k and a time between times[k] and the next to the state there.
    watched : tuple of Watched
        Signals whose limits count as events.
    method, reason : str
        What ran, and why.
    """

    times: Array
    states: Array
    see: Callable[[Array, Array], Snapshot]
    carry: Callable[[int, float], Array]
    watched: tuple[Watched, ...]
    method: str
    reason: str

    def state_at(self, k: int, t: float) -> Array:
        """State at a time from times[k] to the next."""
        return self.carry(k, t) if t > self.times[k] else self.states[:, k]


def recorded(job: Job, method: str) -> Record:
    """Run by the method asked for, or the first that can be taken.

    Raises
    ------
    ValueError
        If the method asked for cannot be taken; the reason is in the message.
    """
    prepared = job.prepared
    reason = prepared.not_linear
    if method in ("auto", "exact"):
        if prepared.linear is not None:
            return _exact(job, prepared.linear)
        if method == "exact":
            raise ValueError(f'method "exact" must be given a linear continuous system, but {reason}')
    if prepared.dt not in (None, 0):
        if method == "compiled":
            raise ValueError(f'method "compiled" must be given a continuous system, got dt = {prepared.dt}')
        return _discrete(job, reason)
    if method == "python":
        return _numerical(job, "python", 'method "python" was asked for')
    reason = reason or 'method "compiled" was asked for'
    try:
        try:
            return _numerical(job, "compiled", reason)
        except DisagreementError:  # what a function refers to may have changed since it was traced
            return _numerical(job, "compiled", reason)
    except NotCompiledError as error:
        if method == "compiled":
            raise ValueError(f'method "compiled" must be given blocks that can be traced, but {error}') from None
        return _numerical(job, "python", str(error))
    except SolverError as error:
        if method == "compiled":
            raise
        return _numerical(job, "python", f"CVODES failed: {error}")


def _exact(job: Job, form: LinearForm) -> Record:
    """Linear loop: one matrix exponential a leg, and one for each spacing of samples."""
    drives = [*job.inputs, *(PlanDrive(plan, high) for plan, high in form.sources)]
    plans = [(drive.plan, drive.derivatives) for drive in drives if isinstance(drive, PlanDrive)]
    sampled = (
        np.concatenate([np.full(drive.width, isinstance(drive, SampledDrive)) for drive in drives] or [np.zeros(0)]) > 0
    )
    breakpoints = [t for plan, _ in plans for t in plan.breakpoints]
    watched = job.watched()
    times = _with_looks(job.times, watched, lambda: form.a)

    def jet(moment: float, origin: float, s: Array, order: int) -> Array:
        rows = [plan._jet_beside(moment, origin, s, order + high) for plan, high in plans]
        signals = [_derivatives(row, high, order) for row, (_, high) in zip(rows, plans, strict=True)]
        return np.concatenate(signals, axis=1) if signals else np.zeros((order + 1, 0, s.size))

    def see(t: Array, x: Array) -> Snapshot:
        driven = driven_signals(drives, t)
        return Snapshot(t, x, driven[: job.prepared.ninputs], form.outputs(x, driven))

    def states_at(t: Array, state: Array, a: Array = form.a) -> Array:
        found = exact_states(a, form.b[:, ~sampled], jet, breakpoints, t, state)
        if sampled.any():  # what plans and samples make of a linear loop adds up
            samples = driven_signals(drives, t)[sampled]
            found = found + sampled_states(a, form.b[:, sampled], samples, t, np.zeros_like(state))
        return _finite(found)

    def carry(k: int, t: float) -> Array:
        return states_at(np.array([times[k], t]), states[:, k])[:, 1]

    states = states_at(times, job.state)
    growing, fast = form.sensitivity(float(times[-1] - times[0]))
    if growing or fast:
        driven, nearly = driven_signals(drives, times), states_at(times, job.state, form.a * (1.0 + 2.0**-50))
        floor = form.rounding(states[:, :1] if growing else states, driven)
        _warn_of_lost_digits(job, form.outputs(states, driven), form.outputs(nearly, driven), floor)
    _warn_of_undefined(job, form, times, states)
    return Record(times, states, see, carry, watched, "exact", "linear and continuous")


def _warn_of_lost_digits(job: Job, outputs: Array, others: Array, floor: Array) -> None:
    """Warn of outputs that change by more than a floor when all rates change in their last digits."""
    known = np.isfinite(outputs) & np.isfinite(others)
    with np.errstate(all="ignore"):
        apart = np.where(known, np.abs(outputs - others), 0.0).max(axis=1)
    size = np.where(known, np.abs(outputs), 0.0).max(axis=1)
    lost = apart > np.maximum(_LOST * size, floor)
    if lost.any():
        percent = 100.0 * float((apart[lost] / np.maximum(size[lost], 0.5 * apart[lost])).max())
        span = float(job.times[-1] - job.times[0])
        names = ", ".join(np.array(job.prepared.output_labels)[lost])
        warnings.warn(
            f"outputs {names} of {job.prepared.name} are uncertain by {percent:.3g} % of their size: "
            f"rounding errors in the system's matrices change them by that much over {span:g} s; "
            "shorten the run, or remove modes that are so fast or so unstable",
            UserWarning,
            stacklevel=5,
        )


def _warn_of_undefined(job: Job, form: LinearForm, times: Array, states: Array) -> None:
    """Warn of outputs that are differences of states that have overflowed."""
    if np.isfinite(states).all():
        return
    up, down = (states == np.inf).astype(float), (states == -np.inf).astype(float)
    added = (form.c > 0.0) @ up + (form.c < 0.0) @ down > 0.0
    taken = (form.c > 0.0) @ down + (form.c < 0.0) @ up > 0.0
    undefined = added & taken
    if undefined.any():
        names = ", ".join(np.array(job.prepared.output_labels)[undefined.any(axis=1)])
        begin = times[undefined.any(axis=0).argmax()]
        warnings.warn(
            f"outputs {names} of {job.prepared.name} are undefined from {begin:g} s on: they are differences of states "
            "that have overflowed, and are given as infinite",
            UserWarning,
            stacklevel=5,
        )


def _numerical(job: Job, method: str, reason: str) -> Record:
    """Leg by leg, compiled or by Python."""
    prepared, network = job.prepared, _network(job.prepared)
    drives = prepared.drives(job.inputs, job.first)
    equations = Interpreted(network, job.params, (job.first, job.state), prepared.trials) if network.blocks else None
    watched = job.watched()
    stops = any(entry.stop for entry in watched)
    solver: Any
    if method == "compiled":
        if equations is not None:  # an algebraic loop without a solution is better named here
            equations.signals(job.first, job.state, driven_signals(drives, job.times[:1])[:, 0])
        form = prepared.compiled(job.params, drives, job.first, job.state)
        from ctrlplan.simulation.compiled import CompiledSolver  # there is a form: so there is CasADi

        # Beyond a stop there may be no solution: legs are short then, and must fail soon.
        solver = CompiledSolver(form, job.params, *job.tolerances, max_steps=2_000 if stops else 20_000)
    elif equations is not None:
        solver = InterpretedSolver(equations, *job.tolerances)
    else:
        raise NotCompiledError(f"{prepared.name} came from another process without its blocks")

    def see(t: Array, x: Array) -> Snapshot:
        driven = driven_signals(drives, t)
        y = solver.outputs(t, x, driven)
        return Snapshot(t, x, driven[: prepared.ninputs], y, lambda: solver.signals(t, x, driven))

    def carry(k: int, t: float) -> Array:
        start = float(run.times[k])
        return solver.advance(run.series(start), start, np.array([t]), run.states[:, k])[:, -1]

    def pause(t: Array, x: Array) -> bool:
        seen = see(t, x)
        return any(entry.side(entry.value(seen)).any() for entry in watched if entry.stop)

    def slope() -> Array:
        if equations is None:
            return np.zeros((0, 0))
        driven = driven_signals(drives, job.times[:1])[:, 0]
        return _slope(lambda x: equations.rates(job.first, x, driven), job.state)

    run = integrate(
        network,
        equations,
        solver,
        drives,
        _with_looks(job.times, watched, slope),
        job.state,
        resolution=10.0 * job.tolerances[0],
        pause=pause if stops else None,
    )
    if method == "compiled":
        some = np.unique(np.linspace(0, run.times.size - 1, _VISITED).astype(int))
        t, x, driven = run.times[some], run.states[:, some], driven_signals(drives, run.times[some])
        if solver.at_edge(t, x, driven):
            raise SolverError(
                f"the solver must reach {job.times[-1]:g} s, got to the edge of where equations are defined"
            )
        if equations is not None:
            wrong = form.disagreement(network, job.params, t, x, equations.all_signals(t, x, driven))
            if wrong:
                raise prepared.distrust(form, wrong)
            prepared.trusted = True
    return Record(run.times, run.states, see, carry, watched, method, reason)


def _discrete(job: Job, reason: str) -> Record:
    """Discrete system, from sample to sample."""
    prepared, network = job.prepared, _network(job.prepared)
    clock = _clock(job.times, prepared.dt)
    drives = prepared.drives(job.inputs, job.first)
    equations = Interpreted(network, job.params, (job.first, job.state), prepared.trials)
    breakpoints = np.array(sorted(breakpoints_of(drives)))
    driven = driven_signals(drives, _on_breakpoints(clock, breakpoints))
    states = np.empty((job.state.size, clock.size))
    states[:, 0] = job.state
    for k in range(clock.size - 1):
        states[:, k + 1] = equations.rates(float(clock[k]), states[:, k], driven[:, k])

    def see(t: Array, x: Array) -> Snapshot:
        now = driven_signals(drives, _on_breakpoints(t, breakpoints))
        w = equations.all_signals(t, x, now)
        return Snapshot(t, x, now[: prepared.ninputs], network.put_out(w), lambda: w)

    # Between samples nothing happens: what crosses a limit does so at the later one.
    return Record(clock, states, see, lambda k, t: states[:, k], job.watched(), "python", reason)


def _clock(times: Array, dt: float | bool) -> Array:
    """Sampling instants of a discrete system from the first time to the last, the times themselves among them."""
    rounding = 4.0 * np.finfo(float).eps * np.abs(times).max()
    if isinstance(dt, bool):
        spacing = np.diff(times)
        if np.ptp(spacing) > _OFF_CLOCK * spacing.mean() + rounding:
            raise ValueError(
                "timepts must be evenly spaced for a system with unspecified sampling time (dt = True), "
                f"got spacings from {spacing.min():g} to {spacing.max():g} s"
            )
        return times
    period = float(dt)
    if not rounding < 0.1 * period < np.inf:
        raise ValueError(f"timepts must tell instants {period:g} s apart, got times up to {np.abs(times).max():g} s")
    steps = (times - times[0]) / period
    if steps[-1] > _MOST_STEPS:
        raise ValueError(f"timepts must span {_MOST_STEPS:g} periods of a discrete system at most, got {steps[-1]:.3g}")
    wanted = np.round(steps)
    off = np.abs(steps - wanted)
    if off.max() > _OFF_CLOCK + rounding / period:
        at = float(times[off.argmax()])
        raise ValueError(
            f"timepts must be whole periods of {period:g} s apart in a discrete system, got {at:g} s, "
            f"{off.max():.2g} periods off"
        )
    if np.any(np.diff(wanted) < 1.0):
        raise ValueError(f"timepts must be at least a period of {period:g} s apart in a discrete system, got less")
    clock: Array = times[0] + period * np.arange(wanted[-1] + 1.0)
    clock[wanted.astype(int)] = times
    return clock


def _on_breakpoints(times: Array, breakpoints: Array) -> Array:
    """Times, but the breakpoint itself where a time is one but for rounding: 29 times 0.01 s is 0.29 s."""
    if not breakpoints.size:
        return times
    after = np.clip(np.searchsorted(breakpoints, times), 1, max(1, breakpoints.size - 1))
    before, following = breakpoints[after - 1], breakpoints[np.minimum(after, breakpoints.size - 1)]
    nearest = np.where(times - before < following - times, before, following)
    return np.where(np.abs(times - nearest) <= 4.0 * np.finfo(float).eps * np.abs(times).max(), nearest, times)


def _network(prepared: Prepared) -> Any:
    if prepared.network is None:
        raise NotCompiledError(prepared.unsupported)
    return prepared.network


def _of_block(function: Any, states: slice, fed: Any, params: dict[str, Any], seen: Snapshot) -> Array:
    """Signal that a block declares, from its states and inputs."""
    return np.asarray(function(seen.t, seen.x[states], fed(seen.w), params))


def _with_looks(times: Array, watched: Sequence[Watched], slope: Callable[[], Array]) -> Array:
    """Times asked for, and more where events are watched, so that no crossing hides between two."""
    if not watched:
        return times
    matrix = slope()
    fastest = float(np.abs(np.linalg.eigvals(matrix).imag).max(initial=0.0)) if np.isfinite(matrix).all() else 0.0
    turns = fastest * float(times[-1] - times[0]) / (2.0 * np.pi)
    count = int(min(max(_LOOKS[0], _LOOKS_A_TURN * turns), _LOOKS[1]))
    return np.union1d(times, np.linspace(times[0], times[-1], count))


def _slope(rates: Callable[[Array], Array], state: Array) -> Array:
    """Derivatives of rates by the states, by differences."""
    steps = 1e-6 * (1.0 + np.abs(state))
    with np.errstate(all="ignore"):
        before = rates(state)
        columns = [
            (rates(state + step * unit) - before) / step for step, unit in zip(steps, np.eye(state.size), strict=True)
        ]
    return np.array(columns).T.reshape(state.size, state.size)


def _derivatives(jet: Array, high: int, order: int) -> Array:
    """Jets (order + 1, naxes (high + 1), ntime) of a plan and its derivatives, axis by axis."""
    shifted = np.stack([jet[k : k + order + 1] for k in range(high + 1)], axis=2)
    return shifted.reshape(order + 1, -1, jet.shape[2])


def _finite(values: Array) -> Array:
    """An unstable loop that has left the range of numbers is infinite, not undefined."""
    values[np.isnan(values)] = np.inf
    return values
