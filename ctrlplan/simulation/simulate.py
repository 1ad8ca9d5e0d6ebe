"""One function that runs any loop."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from numbers import Real
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import real_array
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array, System
from ctrlplan.simulation import methods
from ctrlplan.simulation.budget import begin_run
from ctrlplan.simulation.events import Events, Occurrence, Watched, crossings
from ctrlplan.simulation.interpreted import FeedthroughError
from ctrlplan.simulation.job import Job, Record, fresh_job
from ctrlplan.simulation.methods import Method
from ctrlplan.simulation.prepared import Prepared, prepared_form
from ctrlplan.simulation.response import SimulationResponse
from ctrlplan.simulation.signals import Inputs, input_signals

MethodName = Literal["auto", "exact", "compiled", "python"]
"""Methods of the package, and the choice among them."""

_LONGEST = 1e15
"""Seconds after which a double cannot tell one microsecond from the next, by far."""

_NO_TIMEBASE = (
    "{} has states and no timebase (dt = None): it is simulated as continuous-time, as by "
    "control.input_output_response (control.forced_response takes one step per sample); set dt = 0 or dt = True"
)


def simulate(
    system: System | Prepared,
    timepts: ArrayLike,
    inputs: Inputs = None,
    initial_state: ArrayLike | None = None,
    *,
    method: MethodName = "auto",
    rtol: float = 1e-8,
    atol: float | None = None,
    params: Mapping[str, object] | None = None,
    events: Events = None,
) -> SimulationResponse:
    """Response of a system to plans.

    A continuous linear system, interconnections and plan sources included, is
    solved exactly: the error is that of rounding whatever the sample spacing.
    Others are flattened, each block called once a step, and integrated from
    breakpoint to breakpoint, so that no plan is skipped: compiled by CasADi
    under CVODES where every block can be traced, by Python and LSODA otherwise.

    Parameters
    ----------
    system : control system or Prepared
        With whatever inputs; unmodified python-control objects, or what
        `prepare` made of one. The built form is kept, and rebuilt where maps,
        parameters, blocks or what their functions refer to have changed. A system with states and without a
        timebase (dt = None) is simulated as continuous-time, with a warning.
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing, two or more. Of a discrete system
        multiples of its sampling time from the first on; where that is
        unspecified (dt = True), evenly spaced, one step of the system each.
    inputs : Trajectory, array_like, mapping or None, optional
        For all inputs in order: a trajectory with as many axes, a number, an
        array (ninputs, ntime) of samples taken for linear in between, or a list
        of one of these for each input; or by name, ``{"r": plan, "d": 0.1}``,
        each for one input, 0 where unnamed.
    initial_state : array_like, shape (nstates,), float or None, optional
        State at the first sample time, a number for all states. None: the
        initial state that the system or its blocks declare (see `declare`; as
        `crane_loop` does), and 0 where none does.
    method : {"auto", "exact", "compiled", "python"}, optional
        "auto" takes the first of the others that applies; these raise where
        they do not apply.
    rtol : float, optional
        Relative tolerance of a numerical solver; "exact" needs none.
    atol : float, optional
        Absolute tolerance for all states. None, the default, is 1e-10 of each
        state's own scale, its largest displacement from its start: a run in
        which a state moves less than 1e-3, or less than a hundredth of its
        size, is repeated in the scales that it found (four runs at most). A
        run is also repeated, with a thousandth of `rtol`, where other states
        depend on the sine of a huge angle, or on the like.
    params : mapping, optional
        Parameters of the blocks.
    events : sequence of Event or None, optional
        Limits of signals whose crossings are recorded, and may end the run, in
        addition to those that blocks declare, as a PID does. None, the default:
        the declared ones alone. An empty sequence: none at all, not even those.
        Signals are evaluated at the sample times and at sixteen instants in a
        period of the loop's fastest oscillation: closer crossings need closer
        sample times.

    Returns
    -------
    SimulationResponse
        A `control.TimeResponseData` with the fields ``method`` and ``reason``,
        what ran and why, and ``events``, a list of `Occurrence` in order of
        time. Where an event ended the run its time is the last. Where an output
        is not accurate to 1e-6 of its range, ``reason`` gives the estimate and
        the tolerance that suffices.

    Raises
    ------
    TypeError
        If `system` is no system, or times, inputs or states are no real
        numbers: strings, complex numbers, dates, values with units.
    ValueError
        If times do not increase or are no sampling instants of a discrete
        system, inputs do not fit, values are masked, or a method is asked for
        that the system does not allow; the reason is in the message.
    RuntimeError
        If an integrator fails, or an algebraic loop has no solution that is
        found; time and block are in the message.

    Warns
    -----
    UserWarning
        If a parameter is read by no block; if a system with states has no
        timebase; if a linear response depends on digits that rounding takes
        from the system's matrices; or if a block has equations of a kind that
        only python-control runs: its `control.input_output_response` is then
        used, with the same tolerances.

    Notes
    -----
    Inputs reach the blocks exactly: constants to the bit, samples and plans
    within their own range.

    Switches in t: breakpoints that a block declares are stopped at. In compiled
    blocks undeclared ones are found in the equations. A block that is run by
    Python and reads t is evaluated at least once between two sample times: a
    pulse that is shorter than the sample spacing must be declared.

    Discrete blocks are evaluated in the order of the signal flow, first the
    outputs, then the updates, each once a sample, so that they may have a
    memory besides their states. The functions of a continuous block must return
    equal values for equal arguments.

    A run by Python that makes no progress ends with an error: after 2,000
    evaluations of the equations about one instant, and where 60,000 evaluations
    (and 300 for each segment between breakpoints and samples) have been spent
    and a block jumps, has an infinite slope or is random at that time.
    """
    job = checked_job(system, timepts, inputs, initial_state, rtol, atol, params, events)
    chosen = methods.named(methods.METHODS, method)
    if method != "auto":
        job = replace(job, reason=f'method "{method}" was requested')
    _warn_of_unread(job)
    if job.prepared.dt is None and job.prepared.nstates:
        warnings.warn(_NO_TIMEBASE.format(job.prepared.name), UserWarning, stacklevel=outside_stacklevel())
    return response_to(job, chosen)


def checked_job(
    system: System | Prepared,
    timepts: ArrayLike,
    inputs: Inputs = None,
    initial_state: ArrayLike | None = None,
    rtol: float = 1e-8,
    atol: float | None = None,
    params: Mapping[str, object] | None = None,
    events: Events = None,
) -> Job:
    """Arguments of `simulate`, checked."""
    begin_run()
    times = real_array(timepts, "timepts")
    if times.ndim != 1 or times.size < 2 or not np.isfinite(times).all() or not np.all(np.diff(times) > 0):
        raise ValueError(f"timepts must be two or more finite times that increase strictly, got {timepts!r:.80}")
    if times[-1] - times[0] > _LONGEST:
        raise ValueError(f"timepts must span {_LONGEST:g} s at most, got {times[-1] - times[0]:g} s")
    tolerances: dict[str, object] = {"rtol": rtol}
    if atol is not None:
        tolerances["atol"] = atol
    for label, value in tolerances.items():
        if isinstance(value, bool) or not isinstance(value, Real) or not 0.0 < float(value) < math.inf:
            raise ValueError(f"{label} must be a finite number above 0, got {value!r}")
    prepared = prepared_form(system)
    signals = input_signals(prepared.input_labels, inputs, times)
    state = _checked_state(prepared, initial_state)
    return Job(prepared, times, signals, state, dict(params or {}), rtol, atol, events, prepared.network)


def response_to(job: Job, chosen: Sequence[Method]) -> SimulationResponse:
    """Response by the first of some methods that applies."""
    fresh = fresh_job(job)
    try:
        return _response(job, methods.recorded(job, chosen))
    except FeedthroughError:  # no algebraic loop at the start, but later: solved as one from the start on
        return _response(fresh, methods.recorded(replace(fresh, trials=False), chosen))


def _warn_of_unread(job: Job) -> None:
    """Warn of parameters that no block reads: they are misspelt."""
    for name, value in job.params.items():
        if np.ndim(value) == 0 and not job.prepared.reads(name, value):
            warnings.warn(
                f"params {name!r} is read by no block of {job.prepared.name}",
                UserWarning,
                stacklevel=outside_stacklevel(),
            )


def _response(job: Job, record: Record) -> SimulationResponse:
    """Response at the times asked for, up to the event that ends it."""
    prepared = job.prepared
    found = _occurrences(record)
    places = np.searchsorted(record.times, job.times[job.times <= record.times[-1]])
    times, states = record.times[places], record.states[:, places]
    last = next((occurrence.time for occurrence in found if occurrence.stop), None)
    if last is not None:
        end = record.state_at(int(np.searchsorted(record.times, last, side="right")) - 1, last)
        times, states = np.append(times[times < last], last), np.column_stack([states[:, times < last], end])
        found = [occurrence for occurrence in found if occurrence.time <= last]
    seen = record.snapshot(times, states)
    return SimulationResponse(
        times,
        seen.y.reshape(len(prepared.output_labels), times.size),
        states,
        seen.u,
        params=job.params or None,
        issiso=prepared.issiso,
        output_labels=prepared.output_labels,
        state_labels=prepared.state_labels,
        input_labels=prepared.input_labels,
        sysname=prepared.name,
        title=f"Response of {prepared.name}",
        plot_inputs=bool(len(seen.u)),
        method=record.method,
        reason=record.reason,
        events=found,
    )


def _occurrences(record: Record) -> list[Occurrence]:
    """Every crossing of what was watched, in order of time."""
    if not record.watched:
        return []
    seen, found = record.snapshot(record.times, record.states), []
    for entry in record.watched:
        found += crossings(entry, record.times, entry.value(seen), partial(_value_at, record, entry))
    return sorted(found, key=lambda occurrence: occurrence.time)


def _value_at(record: Record, entry: Watched, k: int, t: float) -> float:
    """Watched signal at a time from times[k] of a record to the next."""
    return float(entry.value(record.snapshot(np.array([t]), record.state_at(k, t)[:, None]))[0])


def _checked_state(prepared: Prepared, initial_state: ArrayLike | None) -> Array:
    if initial_state is None:
        initial_state = 0.0 if prepared.initial_state is None else prepared.initial_state
    state = real_array(initial_state, "initial_state")
    count = prepared.nstates
    if state.ndim and state.shape != (count,):
        raise ValueError(f"initial_state must be a scalar or have {count} entries, got shape {state.shape}")
    if not np.isfinite(state).all():
        raise ValueError(f"initial_state must be finite, got {initial_state!r}")
    return np.broadcast_to(state, (count,)).copy()
