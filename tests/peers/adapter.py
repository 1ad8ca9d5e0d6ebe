"""python-control's `input_output_response` and `forced_response`, computed by `ctrlplan.simulate`.

The two functions accept their arguments in many forms; each form is converted
here to that of `simulate`: sample times, inputs (ninputs, ntime), one initial
state. Only the linear interpolation of samples that python-control documents is
computed here.
"""

from __future__ import annotations

import inspect
import re

import control as ct
import numpy as np

import ctrlplan as cp

ALIASES = {
    "T": "timepts",
    "U": "inputs",
    "u": "inputs",
    "X0": "initial_state",
    "x0": "initial_state",
    "return_x": "return_states",
    "t_eval": "evaluation_times",
}
SOLVER = ("solve_ivp_method", "method")
"""Keywords of `input_output_response` that its signature does not show."""


def options_of(function, args, kwargs):
    """Arguments after the system, by their own names; TypeError where one is unknown or given twice."""
    known = [*inspect.signature(getattr(ct, function)).parameters][1:-1]
    hidden = SOLVER if function == "input_output_response" else ()
    given = [*zip(known, args, strict=False), *((ALIASES.get(key, key), value) for key, value in kwargs.items())]
    options = {}
    for name, value in given:
        if name not in known and name not in hidden:
            raise TypeError(f"unrecognized keyword {name!r}")
        if name in options:
            raise TypeError(f"{name} was given twice")
        options[name] = value
    return options


def response(function, system, options, times=None):
    """Response by ctrlplan to a call of a function of python-control.

    `times` are those of python-control's response, for calls that leave them to its solver.
    """
    if function == "forced_response" and not isinstance(system, (list, tuple, ct.StateSpace, ct.TransferFunction)):
        function = "input_output_response"
        options = {name: value for name, value in options.items() if name != "interpolate"}
    if isinstance(system, (list, tuple)):
        return ct.TimeResponseList([response(function, one, options, times) for one in system])
    squeeze = options.get("squeeze")
    if squeeze not in (None, True, False):
        raise ValueError(f"squeeze must be True, False or None, got {squeeze!r}")
    if not isinstance(system, ct.InputOutputSystem):
        raise TypeError(f"system must be a control system, got {type(system).__name__}")
    _check_solver(options)
    samples, signals = _inputs(function, system, options)
    wanted = _wanted_times(system, options, samples, times)
    timepts, signals = _on_all_times(samples, signals, wanted)
    state, params = _initial_state(function, system, options), options.get("params")
    try:
        ours = cp.simulate(system, timepts, signals, state, params=params)
        stated = re.search(r"rtol = (\S+) suffices", ours.reason)
        if stated:  # an output is not accurate to 1e-6 of its range, and the response says what to do
            ours = cp.simulate(system, timepts, signals, state, params=params, rtol=float(stated[1]))
    except cp.SolverError as error:
        if not options.get("ignore_errors"):
            raise
        return error
    return _as_called(function, ours, np.searchsorted(timepts, wanted), options)


def _check_solver(options):
    """Options of scipy's solver have no meaning here; a contradiction between them is still an error."""
    solver = options.get("solve_ivp_kwargs") or {}
    if options.get("solve_ivp_method") and options.get("method"):
        raise ValueError("the solver's method was given twice")
    if solver.get("t_eval") is not None and not isinstance(options.get("evaluation_times", "T"), str):
        raise ValueError("evaluation times were given twice")


def _inputs(function, system, options):
    """Sample times and inputs in the form of `simulate`."""
    samples, signals = options.get("timepts"), options.get("inputs", 0.0)
    if signals is None:
        signals = 0.0
    if options.get("transpose") and function == "forced_response":
        samples, signals = (value if value is None else np.transpose(value) for value in (samples, signals))
    if samples is None:
        if not ct.isdtime(system) or not np.ndim(signals):
            raise ValueError("sample times must be given")
        samples = (1.0 if system.dt in (None, True) else system.dt) * np.arange(np.shape(signals)[-1])
    samples = np.squeeze(samples) if np.ndim(samples) > 1 else np.asarray(samples)
    if function == "forced_response" and not np.allclose(np.diff(samples), np.ptp(samples) / (len(samples) - 1)):
        raise ValueError("sample times of forced_response must be evenly spaced")
    if isinstance(signals, (list, tuple)) and len(signals) != len(samples):
        signals = np.vstack([_rows(element, samples) for element in signals])
    return samples, signals


def _rows(element, samples):
    """An element of a list of inputs: samples, or numbers for all times."""
    element = np.asarray(element)
    if element.ndim and element.shape[-1] == samples.size:
        return element
    if element.ndim > 1:
        raise ValueError(f"inputs must have {samples.size} samples, got shape {element.shape}")
    return np.outer(element, np.ones(samples.size))


def _wanted_times(system, options, samples, times):
    """Times of the response."""
    wanted = options.get("evaluation_times", "T")
    if isinstance(wanted, str):
        wanted = (options.get("solve_ivp_kwargs") or {}).get("t_eval", samples)
    if options.get("interpolate") and ct.isdtime(system, strict=True) and system.dt is not True:
        count = round(float(samples[-1] - samples[0]) / system.dt)
        return samples[0] + system.dt * np.arange(count + 1)
    return times if wanted is None else np.asarray(wanted)


def _on_all_times(samples, signals, wanted):
    """All times of inputs and response, and the inputs at these times."""
    if np.array_equal(samples, wanted):
        return samples, signals
    timepts = np.union1d(samples, wanted)
    signals = np.asarray(signals, dtype=float)
    if signals.ndim:
        rows = signals.reshape(-1, len(samples))
        signals = np.stack([np.interp(timepts, samples, row) for row in rows])
    return timepts, signals


def _initial_state(function, system, options):
    """One vector: lists of vectors are joined, and short ones padded by zeros, as python-control documents."""
    given = options.get("initial_state", 0.0)
    count = system.nstates
    if given is None or np.isscalar(given):
        return given
    if function == "forced_response" and isinstance(system, (ct.StateSpace, ct.TransferFunction)):
        return np.reshape(given, -1) if np.ndim(given) == 2 and np.shape(given)[1] == 1 else given
    parts = [np.asarray(part).reshape(-1) for part in given] if isinstance(given, (list, tuple)) else [np.ravel(given)]
    state = np.concatenate(parts)
    return np.append(state, np.zeros(max(0, (count or 0) - state.size)))


def _as_called(function, ours, rows, options):
    """Response at the requested times, in the form of the call."""
    # Without states python-control's nonlinear function returns None, its linear one an array without rows.
    hidden = ours.x is not None and ours.x.size == 0 and function == "input_output_response"
    states = None if ours.x is None or hidden else ours.x[:, rows]
    return ct.TimeResponseData(
        ours.t[rows],
        ours.y[:, rows],
        states,
        None if ours.u is None else ours.u[:, rows],
        params=ours.params,
        issiso=ours.issiso,
        output_labels=ours.output_labels,
        state_labels=None if states is None else ours.state_labels,
        input_labels=ours.input_labels,
        sysname=ours.sysname,
        plot_inputs=ours.plot_inputs,
        transpose=options.get("transpose", False),
        return_x=options.get("return_states", False),
        squeeze=options.get("squeeze"),
    )
