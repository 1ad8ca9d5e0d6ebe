"""One function that runs any loop."""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import real_array
from ctrlplan.simulation.budget import begin_run
from ctrlplan.simulation.events import Event, Occurrence, crossings
from ctrlplan.simulation.interpreted import FeedthroughError
from ctrlplan.simulation.job import Job, Record
from ctrlplan.simulation.prepared import Prepared, prepared_form
from ctrlplan.simulation.runs import METHODS, recorded
from ctrlplan.simulation.scales import RELATIVE
from ctrlplan.simulation.signals import Inputs, input_signals, signal_values

Array = NDArray[np.float64]

DELEGATED = threading.RLock()
"""One run by python-control at a time: it keeps the parameters of a run in the system."""

_LONGEST = 1e15
"""Seconds after which a double cannot tell one microsecond from the next, by far."""

_NO_TIMEBASE = (
    "{} has states and no timebase (dt = None): it is simulated as continuous-time, as by "
    "control.input_output_response (control.forced_response takes one step per sample); set dt = 0 or dt = True"
)


def simulate(
    system: Any,
    timepts: ArrayLike,
    inputs: Inputs = None,
    initial_state: ArrayLike | None = None,
    method: str = "auto",
    rtol: float = 1e-8,
    atol: float | None = None,
    params: Mapping[str, Any] | None = None,
    events: Sequence[Event] | None = None,
) -> ct.TimeResponseData:
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
    events : sequence of Event, optional
        Limits of signals whose crossings are recorded, and may end the run.
        Signals are evaluated at the sample times and at sixteen instants in a
        period of the loop's fastest oscillation: closer crossings need closer
        sample times. Limits that blocks declare, as a PID does, are watched as
        well, unless an empty sequence is given.

    Returns
    -------
    control.TimeResponseData
        Labelled and ordered as python-control does, with the attributes
        ``method`` and ``reason`` saying what ran and why, and ``events``, a
        list of `Occurrence` in order of time. Where an event ended the run its
        time is the last. Where an output is not accurate to 1e-6 of its range,
        ``reason`` gives the estimate and the tolerance that would do.

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
    begin_run()
    times = real_array(timepts, "timepts")
    if times.ndim != 1 or times.size < 2 or not np.isfinite(times).all() or not np.all(np.diff(times) > 0):
        raise ValueError(f"timepts must be two or more finite times that increase strictly, got {timepts!r:.80}")
    if times[-1] - times[0] > _LONGEST:
        raise ValueError(f"timepts must span {_LONGEST:g} s at most, got {times[-1] - times[0]:g} s")
    for label, value in (("rtol", rtol), ("atol", atol)):
        number: Any = value
        if value is None and label == "atol":
            continue
        if isinstance(number, bool) or not isinstance(number, Real) or not 0.0 < float(number) < math.inf:
            raise ValueError(f"{label} must be a finite number above 0, got {value!r}")
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    prepared = prepared_form(system)
    time_signals = input_signals(prepared.input_labels, inputs, times)
    state = _checked_state(prepared, initial_state)
    _warn_of_idle(prepared, params or {})
    if prepared.dt is None and prepared.nstates:
        warnings.warn(_NO_TIMEBASE.format(prepared.name), UserWarning, stacklevel=2)
    job = Job(prepared, times, time_signals, state, dict(params or {}), rtol, atol, events, prepared.network)
    if prepared.network is None and prepared.linear is None and method in ("auto", "python"):
        return _delegated(job)
    try:
        return _response(job, recorded(job, method))
    except FeedthroughError:  # a loop that is none at the start: solved as one from now on
        prepared.trials = False
        return _response(job, recorded(job, method))


def _warn_of_idle(prepared: Prepared, params: Mapping[str, Any]) -> None:
    """Say which parameters are read by no block: they are misspelt."""
    for name, value in params.items():
        if np.ndim(value) == 0 and not prepared.reads(name, value):
            warnings.warn(f"params {name!r} is read by no block of {prepared.name}", UserWarning, stacklevel=3)


def _response(job: Job, record: Record) -> ct.TimeResponseData:
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
    seen = record.see(times, states)
    response = ct.TimeResponseData(
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
    )
    response.method, response.reason, response.events = record.method, record.reason, found
    return response


def _occurrences(record: Record) -> list[Occurrence]:
    """Every crossing of what was watched, in order of time."""
    if not record.watched:
        return []
    seen, found = record.see(record.times, record.states), []
    for entry in record.watched:

        def value_at(k: int, t: float, entry: Any = entry) -> float:
            state = record.state_at(k, t)
            return float(entry.value(record.see(np.array([t]), state[:, None]))[0])

        found += crossings(entry, record.times, entry.value(seen), value_at)
    return sorted(found, key=lambda occurrence: occurrence.time)


def _delegated(job: Job) -> ct.TimeResponseData:
    """Response by python-control, of what only it runs."""
    prepared = job.prepared
    warnings.warn(
        f"{prepared.unsupported}: run by control.input_output_response, without events", UserWarning, stacklevel=3
    )
    with DELEGATED:
        response = ct.input_output_response(
            prepared.system,
            job.times,
            signal_values(job.inputs, job.times) if job.inputs else 0,
            job.state,
            params=job.params or None,
            solve_ivp_method="LSODA",
            solve_ivp_kwargs={"rtol": job.rtol, "atol": RELATIVE if job.atol is None else job.atol},
        )
    response.method, response.reason, response.events = "python", prepared.unsupported, []
    return response


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
