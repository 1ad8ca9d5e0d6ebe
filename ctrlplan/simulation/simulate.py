"""Simulation of a system: checks, choice of the method, response."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from numbers import Real
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_params, real_array
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array, Params, System
from ctrlplan.simulation import methods
from ctrlplan.simulation.budget import begin_run
from ctrlplan.simulation.events import (
    Departures,
    Events,
    LaterEvents,
    Occurrence,
    Snapshot,
    Watched,
    crossings,
    departures_of,
)
from ctrlplan.simulation.held_outputs import HeldOutputs
from ctrlplan.simulation.interpreted import FeedthroughError
from ctrlplan.simulation.interruptions import passing_interruptions
from ctrlplan.simulation.job import Job, Record, fresh_job
from ctrlplan.simulation.memory import kept_memory
from ctrlplan.simulation.methods import Method
from ctrlplan.simulation.prepared import Prepared, prepared_form
from ctrlplan.simulation.response import SimulationResponse
from ctrlplan.simulation.segments import time_tolerance
from ctrlplan.simulation.signals import Inputs, input_signals
from ctrlplan.simulation.starts import check_begin

MethodName = Literal["auto", "exact", "compiled", "python"]
"""Names of the methods; "auto" chooses among them."""

_LONGEST = 1e15
"""Longest run [s]: far beyond the times at which doubles resolve a microsecond."""

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
    """Time response of a system to plans and other inputs.

    A continuous linear system, interconnections and plan sources included, is
    solved exactly: the error is rounding, whatever the sample spacing. So is a
    linear loop with discrete controllers (`sample_hold`) of one or more rates, and
    with delays of what they hold or measure, and a linear loop with other delays,
    unless more than 20,000 sums of delays matter that have no common divisor.
    Other systems are flattened, with one call of each block per step, and
    integrated from breakpoint to breakpoint: compiled by CasADi and solved by
    CVODES where every block can be traced, otherwise by Python and LSODA.

    Parameters
    ----------
    system : control system or Prepared
        Any python-control system, unmodified, or the result of `prepare`. Its
        internal form is cached, and rebuilt when connections, parameters,
        blocks or the objects that their functions refer to have changed. A
        system with states and without a timebase (dt = None) is simulated as
        continuous-time, with a warning.
    timepts : array_like, shape (ntime,)
        Sample times [s], two or more, strictly increasing. For a discrete
        system: whole sampling periods apart; with unspecified sampling time
        (dt = True) evenly spaced, one step of the system each.
    inputs : Trajectory, array_like, mapping or None, optional
        For all inputs in order: a trajectory with as many axes, a number, an
        array (ninputs, ntime) of samples, linear in between, or a list with one
        of these for each input. By name: ``{"r": plan, "d": 0.1}``; inputs
        without an entry are 0.
    initial_state : array_like, shape (nstates,), float or None, optional
        State at the first sample time, a number for all states. None: the
        initial state that the system or its blocks declare (see `declare`; as
        `crane_loop` does), and 0 where none does.
    method : {"auto", "exact", "compiled", "python"}, optional
        "auto" uses the first of the others that applies. The others raise an
        error if they do not apply.
    rtol : float, optional
        Relative tolerance of the numerical solvers; not used by "exact".
    atol : float, optional
        Absolute tolerance of all states. None, the default: 1e-10 of each
        state's scale, which is its largest displacement from its initial value.
        A run in which a state moves by less than 1e-3, or by less than 1 % of
        its size, is repeated with the scales found (at most four runs). A run
        is also repeated, with a thousandth of `rtol`, where small relative
        errors of a large state matter, as with the sine of a large angle.
    params : mapping, optional
        Parameters of the blocks.
    events : sequence of Event or None, optional
        Limits of signals whose crossings are recorded and may end the run, in
        addition to those that blocks declare, as a PID does. None, the default:
        the declared ones only. An empty sequence: no events, declared ones
        included. Signals are evaluated at the sample times and, where these are
        farther apart, sixteen times per period of the loop's fastest oscillation;
        crossings closer together require closer sample times.

    Returns
    -------
    SimulationResponse
        A `control.TimeResponseData` with three further attributes: ``method``,
        the method used; ``reason``, why it was chosen; ``events``, a list of
        `Occurrence` in order of time. If an event ends the run, its time is the
        last. If an output is not accurate to 1e-6 of its range, ``reason``
        gives the estimated error and the tolerance that suffices.

    Raises
    ------
    TypeError
        If `system` is not a control system, or times, inputs or states are not
        real numbers (strings, complex numbers, dates, values with units).
    ValueError
        If times do not increase or are not sample times of a discrete system,
        inputs do not fit, values are masked, or the requested method does not
        apply; the message gives the reason.
    RuntimeError
        If the integrator fails, or no solution of an algebraic loop is found;
        the message gives time and block.

    Warns
    -----
    UserWarning
        If a parameter is read by no block; if a system with states has no
        timebase; if rounding errors of the system matrices change a linear
        response noticeably; or if a block overrides the equations of its class:
        `control.input_output_response` is then used, with the same tolerances.

    See Also
    --------
    ctrlplan.simulation : The methods, and what a run guarantees and requires.
    ctrlplan.prepare : The built form of a system, for many runs.

    Notes
    -----
    Constant inputs reach the blocks to the last bit; samples and plans stay
    within their own range.

    Equations that switch with time: the integrator stops at breakpoints that a
    block declares. In compiled blocks undeclared ones are found in the
    equations. A block run by Python that reads t is evaluated at least once
    between two sample times: a pulse shorter than the sample spacing must be
    declared.

    Discrete blocks are evaluated in the order of the signal flow, first the
    outputs, then the updates, each once per sample; they may therefore have
    memory other than their states, as an attribute or a variable of a closure.
    What they remember after a run can be read, and the next `simulate` goes on
    from it: reset it, or build a new loop, for equal runs. `compare`, `sweep`,
    `monte_carlo`, `margins` and `fastest` begin each run with the memory that the
    blocks had before, and leave it as it was. The functions of a continuous block
    must return equal values for equal arguments.

    A run by Python that makes no progress ends with an error: after 2,000
    evaluations of the equations about one time, or when 60,000 evaluations
    (plus 300 for each segment between breakpoints and samples) are exceeded
    and a block is discontinuous, has an infinite slope or is random there.
    """
    job = checked_job(system, timepts, inputs, initial_state, rtol, atol, params, events)
    chosen = methods.named(methods.METHODS, method)
    if method != "auto":
        job = replace(job, reason=f'method "{method}" was requested')
    warn_of_unread(job.prepared, job.params)
    warn_of_timebase(job.prepared)
    return response_to(job, chosen)


def simulate_for_metrics(
    system: System | Prepared,
    timepts: ArrayLike,
    inputs: Inputs = None,
    initial_state: ArrayLike | None = None,
    *,
    params: Mapping[str, object] | None = None,
    events: Events = None,
) -> tuple[SimulationResponse, Occurrence | None, HeldOutputs | None]:
    """Time response as by `simulate`, the event that ends it, and the held parts of its outputs; None without any.

    Other events are located when they are first read, if that calls no functions of
    the user: many runs are wanted for their metrics only. The blocks have the same
    memory after the run as before it.
    """
    job = checked_job(system, timepts, inputs, initial_state, params=params, events=events)
    warn_of_unread(job.prepared, job.params)
    warn_of_timebase(job.prepared)
    with kept_memory(job.network, job.prepared.is_discrete):
        response, stop, record = _response_and_end(job, methods.METHODS, later=True)
        held = record.held() if record.held is not None else None
    if held is not None:
        held = held.on(response.t, time_tolerance(job.first, float(job.times[-1])))
    return response, stop, held


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
    """Job from the arguments of `simulate`, which are checked."""
    begin_run()
    times = real_array(timepts, "timepts")
    if times.ndim != 1 or times.size < 2 or not np.isfinite(times).all() or not np.all(np.diff(times) > 0):
        raise ValueError(f"timepts must be two or more finite times that increase strictly, got {timepts!r:.80}")
    if times[-1] - times[0] > _LONGEST:
        raise ValueError(f"timepts must span at most {_LONGEST:g} s, got {times[-1] - times[0]:g} s")
    tolerances: dict[str, object] = {"rtol": rtol}
    if atol is not None:
        tolerances["atol"] = atol
    for label, value in tolerances.items():
        if isinstance(value, bool) or not isinstance(value, Real) or not 0.0 < float(value) < math.inf:
            raise ValueError(f"{label} must be a finite number above 0, got {value!r}")
    given = checked_params(params)
    prepared = prepared_form(system)
    signals = input_signals(prepared.input_labels, inputs, times)
    state = checked_state(prepared, initial_state)
    check_begin(prepared.starts, float(times[0]), initial_state is None)
    return Job(prepared, times, signals, state, given, rtol, atol, events, prepared.network)


def response_to(job: Job, chosen: Sequence[Method]) -> SimulationResponse:
    """Response by the first method that applies."""
    return _response_and_end(job, chosen, later=False)[0]


def _response_and_end(
    job: Job, chosen: Sequence[Method], later: bool
) -> tuple[SimulationResponse, Occurrence | None, Record]:
    """Response by the first method that applies, the event that ends it, and the record of the run.

    Other events are located later, if possible.
    """
    fresh = fresh_job(job)
    try:
        return _response(job, methods.recorded(job, chosen), later)
    except FeedthroughError:  # no algebraic loop at the start, but later: repeat with the loop solved from the start
        return _response(fresh, methods.recorded(replace(fresh, trials=False), chosen), later)


def checked_state(prepared: Prepared, initial_state: ArrayLike | None) -> Array:
    """Initial state (nstates,) as given, declared or 0."""
    if initial_state is None:
        initial_state = 0.0 if prepared.initial_state is None else prepared.initial_state
    state = real_array(initial_state, "initial_state")
    count = prepared.nstates
    if state.ndim and state.shape != (count,):
        raise ValueError(f"initial_state must be a scalar or have {count} entries, got shape {state.shape}")
    if not np.isfinite(state).all():
        raise ValueError(f"initial_state must be finite, got {initial_state!r}")
    return np.broadcast_to(state, (count,)).copy()


def warn_of_unread(prepared: Prepared, params: Params) -> None:
    """Warn of parameters that no block reads, probably misspelt."""
    for name, value in params.items():
        if np.ndim(value) == 0 and not prepared.reads(name, value):
            warnings.warn(
                f"params {name!r} is read by no block of {prepared.name}",
                UserWarning,
                stacklevel=outside_stacklevel(),
            )


def warn_of_timebase(prepared: Prepared) -> None:
    """Warn of a system with states and without a timebase."""
    if prepared.dt is None and prepared.nstates:
        warnings.warn(_NO_TIMEBASE.format(prepared.name), UserWarning, stacklevel=outside_stacklevel())


def _response(job: Job, record: Record, later: bool) -> tuple[SimulationResponse, Occurrence | None, Record]:
    """Response at the times of a job, up to the event that ends it, that event, and the record."""
    prepared = job.prepared
    found = _Occurrences(record)
    times, states = record.times, record.states
    places = np.arange(times.size)
    if times is not job.times and not np.array_equal(times, job.times):
        places = np.searchsorted(times, job.times[job.times <= times[-1]])
        times, states = times[places], states[:, places]
    stop = found.stop()
    if stop is not None:
        last = stop.time
        end = record.state_at(int(np.searchsorted(record.times, last, side="right")) - 1, last)
        times, states = np.append(times[times < last], last), np.column_stack([states[:, times < last], end])
    if record.watched and record.is_pure and stop is None:
        seen = found.seen.at(places)  # events require signals at all times of the record
    else:
        seen = record.snapshot(times, states)

    def outputs() -> Array:
        return seen.y.reshape(len(prepared.output_labels), times.size)

    later = later and record.is_pure and not any(callable(event.signal) for event in job.events or ())
    response = SimulationResponse(
        times,
        outputs if record.is_pure else outputs(),
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
        events=found if later else found(),
    )
    return response, stop, record


class _Occurrences(LaterEvents):
    """Crossings of the limits of the events of a record."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self._found: dict[int, list[Occurrence]] = {}

    def stop(self) -> Occurrence | None:
        """Event that ends the run; None if none does."""
        self._locate([k for k, entry in enumerate(self._record.watched) if entry.stop])
        ends = [one for found in self._found.values() for one in found if one.stop]
        return min(ends, key=lambda one: one.time, default=None)

    def __call__(self) -> list[Occurrence]:
        """All crossings up to the end, in order of time."""
        stop = self.stop()
        self._locate(range(len(self._record.watched)))
        last = math.inf if stop is None else stop.time
        every = [one for k in range(len(self._found)) for one in self._found[k] if one.time <= last]
        return sorted(every, key=lambda one: one.time)

    def departures(self) -> list[Departures]:
        """Number and first time of the crossings by which signals left their limits; others are not located."""
        record = self._record
        if self.stop() is not None:  # those in its interval of time may be after it
            return Departures.of(self())
        with passing_interruptions():
            found = [
                one
                for entry in record.watched
                for one in departures_of(entry, record.times, entry.value(self.seen), partial(_value_at, record, entry))
            ]
        return Departures.by_name(found)

    @cached_property
    def seen(self) -> Snapshot:
        """Signals at all times of the record."""
        return self._record.snapshot(self._record.times, self._record.states)

    def _locate(self, wanted: Sequence[int]) -> None:
        record, missing = self._record, [k for k in wanted if k not in self._found]
        if not missing:
            return
        with passing_interruptions():
            for k in missing:
                entry = record.watched[k]
                values = entry.value(self.seen)
                self._found[k] = list(crossings(entry, record.times, values, partial(_value_at, record, entry)))


def _value_at(record: Record, entry: Watched, k: int, t: float) -> float:
    """Signal of an event at a time between times[k] and times[k + 1] of a record."""
    return float(entry.value(record.snapshot_at(k, t))[0])
