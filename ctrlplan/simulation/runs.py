"""The ways to run a loop: exact, compiled, by Python, from sample to sample."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ctrlplan.simulation.budget import check
from ctrlplan.simulation.events import Snapshot
from ctrlplan.simulation.exact import exact_states, sampled_states
from ctrlplan.simulation.interpreted import Interpreted, SolverError
from ctrlplan.simulation.job import Job, Record, unused, with_looks
from ctrlplan.simulation.linear import LinearForm
from ctrlplan.simulation.numerical import numerical
from ctrlplan.simulation.prepared import DisagreementError, NotCompiledError
from ctrlplan.simulation.signals import PlanSignal, SampledSignal, breakpoints_of, signal_values

if TYPE_CHECKING:
    pass

Array = NDArray[np.float64]

METHODS = ("auto", "exact", "compiled", "python")

_LOST = 1e-6
"""Part of an output's size from which on a doubt about it is said."""

_MOST_STEPS = 1e8
"""Steps of a discrete system in a run."""

_OFF_CLOCK = 1e-5
"""Part of a sampling time by which a time may miss an instant, besides rounding of the times."""


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
        return numerical(job, "python", 'method "python" was asked for')
    reason = reason or 'method "compiled" was asked for'
    again = unused(job)
    try:
        try:
            return numerical(job, "compiled", reason)
        except DisagreementError:  # what a function refers to may have changed since it was traced
            job, again = again, unused(again)
            return numerical(job, "compiled", reason)
    except NotCompiledError as error:
        if method == "compiled":
            raise ValueError(f'method "compiled" must be given blocks that can be traced, but {error}') from None
        return numerical(again, "python", str(error))
    except SolverError as error:
        if method == "compiled":
            raise
        return numerical(again, "python", f"CVODES failed: {error}")


def _exact(job: Job, form: LinearForm) -> Record:
    """Linear loop: one matrix exponential a segment, and one for each spacing of samples."""
    time_signals = [*job.inputs, *(PlanSignal(plan, high) for plan, high in form.sources)]
    plans = [(signal.plan, signal.derivatives) for signal in time_signals if isinstance(signal, PlanSignal)]
    sampled = (
        np.concatenate(
            [np.full(signal.width, isinstance(signal, SampledSignal)) for signal in time_signals] or [np.zeros(0)]
        )
        > 0
    )
    breakpoints = [t for plan, _ in plans for t in plan.breakpoints]
    watched = job.watched()
    times = with_looks(job.times, watched, lambda: form.a)

    def jet(moment: float, origin: float, s: Array, order: int) -> Array:
        rows = [plan._jet_beside(moment, origin, s, order + high) for plan, high in plans]
        signals = [_derivatives(row, high, order) for row, (_, high) in zip(rows, plans, strict=True)]
        return np.concatenate(signals, axis=1) if signals else np.zeros((order + 1, 0, s.size))

    def see(t: Array, x: Array) -> Snapshot:
        driven = signal_values(time_signals, t)
        return Snapshot(t, x, driven[: job.prepared.ninputs], form.outputs(x, driven))

    def states_at(t: Array, state: Array, a: Array = form.a) -> Array:
        found = exact_states(a, form.b[:, ~sampled], jet, breakpoints, t, state)
        if sampled.any():  # what plans and samples make of a linear loop adds up
            samples = signal_values(time_signals, t)[sampled]
            found = found + sampled_states(a, form.b[:, sampled], samples, t, np.zeros_like(state))
        return _finite(found)

    def carry(k: int, t: float) -> Array:
        return states_at(np.array([times[k], t]), states[:, k])[:, 1]

    states = states_at(times, job.state)
    growing, fast = form.sensitivity(float(times[-1] - times[0]))
    if growing or fast:
        driven, nearly = signal_values(time_signals, times), states_at(times, job.state, form.a * (1.0 + 2.0**-50))
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


def _discrete(job: Job, reason: str) -> Record:
    """Discrete system, from sample to sample: first the outputs, in the order of the signal flow, then the updates.

    Each function of a block is called once a sample, so that a block may remember.
    """
    prepared, network = job.prepared, job.blocks
    clock = _clock(job.times, prepared.dt)
    time_signals = prepared.time_signals(job.inputs, job.first)
    equations = Interpreted(network, job.params, (job.first, job.state), prepared.trials)
    breakpoints = np.array(sorted(breakpoints_of(time_signals)))
    driven = signal_values(time_signals, _on_breakpoints(clock, breakpoints))
    states = np.empty((job.state.size, clock.size))
    signals = np.empty((network.nsignals, clock.size))
    states[:, 0] = job.state
    for k, t in enumerate(clock.tolist()):
        check(t)
        signals[:, k] = equations.signals(t, states[:, k], driven[:, k])
        following = equations.rates_of(t, states[:, k], signals[:, k])
        if k + 1 < clock.size:
            states[:, k + 1] = following

    def see(t: Array, x: Array) -> Snapshot:
        now = signal_values(time_signals, _on_breakpoints(t, breakpoints))
        w = signals[:, np.searchsorted(clock, t, side="right") - 1]
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


def _derivatives(jet: Array, high: int, order: int) -> Array:
    """Jets (order + 1, naxes (high + 1), ntime) of a plan and its derivatives, axis by axis."""
    shifted = np.stack([jet[k : k + order + 1] for k in range(high + 1)], axis=2)
    return shifted.reshape(order + 1, -1, jet.shape[2])


def _finite(values: Array) -> Array:
    """An unstable loop that has left the range of numbers is infinite, not undefined."""
    values[np.isnan(values)] = np.inf
    return values
