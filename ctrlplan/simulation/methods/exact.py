"""Linear continuous systems, solved exactly."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial

import numpy as np

from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array
from ctrlplan.simulation.analytic_segments import Jet
from ctrlplan.simulation.events import Snapshot
from ctrlplan.simulation.exact import exact_states, sampled_states
from ctrlplan.simulation.held_outputs import of_delayed, of_sampled
from ctrlplan.simulation.job import Job, Record, with_event_times
from ctrlplan.simulation.linear import LinearForm
from ctrlplan.simulation.moments import moment_states
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.sampled_form import DelayedForm, SampledForm
from ctrlplan.simulation.sampled_motion import moved_signals
from ctrlplan.simulation.segments import check_periods, time_tolerance
from ctrlplan.simulation.signals import PlanSignal, SampledSignal, signal_values
from ctrlplan.trajectories import Trajectory

_UNCERTAIN = 1e-6
"""Uncertainty of an output, relative to its magnitude, above which it is reported."""


_MANY_STATES, _MANY_SEGMENTS = 32, 16
"""Numbers of states and of breakpoints above which the response is computed by moments of the plans."""

_GROWTH = 1e6
"""Growth of a perturbation over a run of a loop with discrete blocks above which its uncertainty is determined."""


class Exact:
    """Matrix exponentials: one per segment between breakpoints, and one for each spacing of samples."""

    name = "exact"

    def why_not(self, prepared: Prepared) -> str:
        """Block that is not linear; empty if there is none."""
        forms = prepared.linear, prepared.sampled, prepared.delayed
        return prepared.not_sampled if all(form is None for form in forms) else ""

    def run(self, job: Job) -> Record:
        """States at the times of a job, to rounding errors.

        Raises
        ------
        SolverError
            If the states of a loop with discrete blocks overflow.
        """
        prepared = job.prepared
        if prepared.linear is not None:
            return _run(job, prepared.linear)
        if prepared.sampled is not None:
            return _run_sampled(job, prepared.sampled)
        if prepared.delayed is not None:
            return _run_delayed(job, prepared.delayed)
        raise TypeError(f"{prepared.name} must be linear, but {prepared.not_sampled}")


def _run_sampled(job: Job, form: SampledForm) -> Record:
    """Record of a linear loop with discrete blocks."""
    last, n = float(job.times[-1]), form.nstates
    check_periods([job.blocks.blocks[i] for i in job.blocks.blocks_with("period")], job.first, last)
    given = job.prepared.time_signals(job.inputs, job.first)
    time_signals, motion = moved_signals(form, given, job.first, last, job.state)
    watched = job.watched()
    times = job.times
    if watched:
        times = with_event_times(times, watched, lambda: form.a[:, form.moving])
        times = np.union1d(times, motion.instants.times)

    def snapshot(t: Array, x: Array) -> Snapshot:
        z = known if t is times else np.concatenate([x, motion.registers_at(t)])
        w = signal_values(time_signals, t)

        def signals() -> Array:
            return np.asarray(form.signals_z @ z + form.signals_w @ w)

        return Snapshot(t, x, w[: job.prepared.ninputs], lambda: form.c @ z + form.d @ w, signals)

    def interpolate(k: int, t: float) -> Array:
        return motion.at(np.array([t]))[:n, 0]

    known = z = motion.at(times)
    if motion.growth > _GROWTH:
        nearly = moved_signals(form.perturbed(2.0**-50), given, job.first, last, job.state)[1].at(times)
        w = signal_values(time_signals, times)
        floor = 64.0 * np.finfo(float).eps * (np.abs(form.c) @ np.abs(z) + np.abs(form.d) @ np.abs(w)).max(axis=1)
        _warn_of_uncertainty(job, form.c @ z + form.d @ w, form.c @ nearly + form.d @ w, floor)
    return Record(
        times,
        z[:n],
        snapshot,
        interpolate,
        watched,
        Exact.name,
        "linear, with discrete blocks or delays",
        held=lambda: of_sampled(form, time_signals, motion.instants.times, last, motion.tolerance, motion.at),
    )


def _run_delayed(job: Job, form: DelayedForm) -> Record:
    """Record of a linear loop with delays between continuous blocks."""
    from ctrlplan.simulation.delayed_motion import DelayedMotion  # few loops have delays

    check_periods([job.blocks.blocks[i] for i in job.blocks.blocks_with("period")], job.first, float(job.times[-1]))
    given = job.prepared.time_signals(job.inputs, job.first)
    motion = DelayedMotion(form, given, job.first, float(job.times[-1]), job.state)
    watched = job.watched()
    times = with_event_times(job.times, watched, lambda: form.a)
    times = np.union1d(times, motion.instants) if watched else times

    def snapshot(t: Array, x: Array) -> Snapshot:
        w = motion.at(t)[1]
        signals = form.base.signals_z @ x + form.base.signals_w @ w
        return Snapshot(t, x, w[: job.prepared.ninputs], lambda: form.base.read @ signals, lambda: signals)

    def interpolate(k: int, t: float) -> Array:
        return motion.at(np.array([t]))[0][:, 0]

    last = float(times[-1])
    tolerance = time_tolerance(job.first, last)
    return Record(
        times,
        motion.at(times)[0],
        snapshot,
        interpolate,
        watched,
        Exact.name,
        "linear, with delays",
        held=lambda: of_delayed(form, motion.instants, last, tolerance, motion.at),
    )


def _run(job: Job, form: LinearForm) -> Record:
    time_signals = [*job.inputs, *(PlanSignal(plan, high) for plan, high in form.sources)]
    planned = [signal for signal in time_signals if isinstance(signal, PlanSignal)]
    plans = [(signal.plan, signal.derivatives) for signal in planned]
    kinds, widths = [isinstance(signal, SampledSignal) for signal in time_signals], [s.width for s in time_signals]
    sampled = np.repeat(np.array(kinds, dtype=bool), widths)
    first, last = float(job.times[0]), float(job.times[-1])
    breakpoints = sorted({t for plan, _ in plans for t in plan.breakpoints_between(first, last).tolist() if t > first})
    watched = job.watched()
    times = with_event_times(job.times, watched, lambda: form.a)

    jet = jet_of(plans)

    def snapshot(t: Array, x: Array) -> Snapshot:
        values = signal_values(time_signals, t)
        return Snapshot(t, x, values[: job.prepared.ninputs], lambda: form.outputs(x, values))

    def states_at(t: Array, state: Array, a: Array = form.a) -> Array:
        if sampled.size and sampled.all():
            return _finite(sampled_states(a, form.b, signal_values(time_signals, t), t, state, form.scale))
        found = None
        if len(a) > _MANY_STATES or (len(a) and len(breakpoints) > _MANY_SEGMENTS):
            values = partial(signal_values, planned)
            found = moment_states(a, form.b[:, ~sampled], values, np.array(breakpoints), t, state, form.scale)
        if found is None:
            found = exact_states(a, form.b[:, ~sampled], jet, breakpoints, t, state)
        if sampled.any():  # superposition of the responses to plans and to samples
            samples = signal_values(time_signals, t)[sampled]
            found = found + sampled_states(a, form.b[:, sampled], samples, t, np.zeros_like(state), form.scale)
        return _finite(found)

    def interpolate(k: int, t: float) -> Array:
        return states_at(np.array([times[k], t]), states[:, k])[:, 1]

    states = states_at(times, job.state)
    growing, fast, nonnormal = form.sensitivity(float(times[-1] - times[0]))
    if growing or fast or nonnormal:
        # A common factor of all entries mainly changes phases; for a nonnormal matrix the entries change independently.
        signs = np.random.default_rng(0).choice([-1.0, 1.0], form.a.shape) if nonnormal else np.ones_like(form.a)
        nearly = states_at(times, job.state, form.a * (1.0 + 2.0**-50 * signs))
        values = signal_values(time_signals, times)
        floor = form.rounding(states[:, :1] if growing else states, values)
        _warn_of_uncertainty(job, form.outputs(states, values), form.outputs(nearly, values), floor)
    _warn_of_undefined(job, form, times, states)
    return Record(times, states, snapshot, interpolate, watched, Exact.name, "linear and continuous")


def jet_of(plans: Sequence[tuple[Trajectory, int]]) -> Jet:
    """Jets of plans with their derivatives up to given orders, as inputs of `exact_states`."""

    def jet(moment: float, origin: float, s: Array, order: int) -> Array:
        rows = [plan.segment_jet_at(moment, origin, s, order + high) for plan, high in plans]
        if len(plans) == 1 and not plans[0][1]:
            return rows[0]
        signals = [_derivatives(row, high, order) for row, (_, high) in zip(rows, plans, strict=True)]
        return np.concatenate(signals, axis=1) if signals else np.zeros((order + 1, 0, s.size))

    return jet


def _warn_of_uncertainty(job: Job, outputs: Array, others: Array, floor: Array) -> None:
    """Warn of outputs that change by more than a floor with the last digits of the system matrix."""
    known = np.isfinite(outputs) & np.isfinite(others)
    with np.errstate(all="ignore"):
        apart = np.where(known, np.abs(outputs - others), 0.0).max(axis=1)
    size = np.where(known, np.abs(outputs), 0.0).max(axis=1)
    uncertain = apart > np.maximum(_UNCERTAIN * size, floor)
    if uncertain.any():
        percent = 100.0 * float((apart[uncertain] / np.maximum(size[uncertain], 0.5 * apart[uncertain])).max())
        span = float(job.times[-1] - job.times[0])
        names = ", ".join(np.array(job.prepared.output_labels)[uncertain])
        warnings.warn(
            f"outputs {names} of {job.prepared.name} are uncertain by {percent:.3g} % of their size: "
            f"rounding errors in the system's matrices change them by that much over {span:g} s; "
            "shorten the run, remove very fast or very unstable modes, or choose states (a modal or balanced "
            "realization) for which the matrix is closer to normal",
            UserWarning,
            stacklevel=outside_stacklevel(),
        )


def _warn_of_undefined(job: Job, form: LinearForm, times: Array, states: Array) -> None:
    """Warn of outputs that are differences of overflowed states."""
    if np.isfinite(states).all():
        return
    up, down = (states == np.inf).astype(float), (states == -np.inf).astype(float)
    added = (form.c > 0.0) @ up + (form.c < 0.0) @ down > 0.0
    subtracted = (form.c > 0.0) @ down + (form.c < 0.0) @ up > 0.0
    undefined = added & subtracted
    if undefined.any():
        names = ", ".join(np.array(job.prepared.output_labels)[undefined.any(axis=1)])
        begin = times[undefined.any(axis=0).argmax()]
        warnings.warn(
            f"outputs {names} of {job.prepared.name} are undefined from {begin:g} s on: they are differences of states "
            "that have overflowed, and are given as infinite",
            UserWarning,
            stacklevel=outside_stacklevel(),
        )


def _derivatives(jet: Array, high: int, order: int) -> Array:
    """Jets (order + 1, naxes (high + 1), ntime) of a plan and its derivatives, axis by axis."""
    shifted = np.stack([jet[k : k + order + 1] for k in range(high + 1)], axis=2)
    return shifted.reshape(order + 1, -1, jet.shape[2])


def _finite(values: Array) -> Array:
    """Values with nan replaced by inf: an unstable loop that has overflowed is infinite."""
    values[np.isnan(values)] = np.inf
    return values
