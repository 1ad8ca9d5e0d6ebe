"""One function that runs any loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import null_space

from ctrlplan.simulation.exact import exact_states
from ctrlplan.simulation.linear import LinearForm, NotLinearError, linear_form
from ctrlplan.simulation.numerical import numerical_response
from ctrlplan.trajectories import Step, Trajectory
from ctrlplan.trajectories.files import signal_rows

Array = NDArray[np.float64]
Inputs = Trajectory | ArrayLike | Mapping[str, Trajectory | ArrayLike] | None

METHODS = ("auto", "exact", "python")


def simulate(
    system: Any,
    timepts: ArrayLike,
    inputs: Inputs = None,
    initial_state: ArrayLike = 0.0,
    method: str = "auto",
    rtol: float = 1e-8,
    atol: float = 1e-10,
    params: Mapping[str, Any] | None = None,
) -> ct.TimeResponseData:
    """Response of a system to plans.

    A continuous linear system, interconnections and plan sources included, is
    solved exactly: the error is that of rounding whatever the sample spacing.
    Anything else is integrated numerically from breakpoint to breakpoint, so
    that no plan is skipped.

    Parameters
    ----------
    system : control system
        With whatever inputs; unmodified python-control objects.
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing, two or more.
    inputs : Trajectory, array_like, mapping or None, optional
        For all inputs in order: a trajectory with as many axes, a number, an
        array (ninputs, ntime) of samples taken for linear in between; or by
        name, ``{"r": plan, "d": 0.1}``, each for one input, 0 where unnamed.
    initial_state : array_like, optional
        State at the first sample time, a scalar for all; where it is 0 and the
        system has an attribute ``initial_state`` (as `crane_loop` sets), that.
    method : {"auto", "exact", "python"}, optional
        "exact" insists on the exact solution.
    rtol, atol : float, optional
        Tolerances of a numerical solver; "exact" needs none.
    params : mapping, optional
        Parameters of the blocks.

    Returns
    -------
    control.TimeResponseData
        Labelled and ordered as python-control does, with the attributes
        ``method`` and ``reason`` saying what ran and why.

    Raises
    ------
    ValueError
        If times do not increase, inputs do not fit, or ``method="exact"`` is
        asked of a system that is not linear.
    """
    times = np.asarray(timepts, dtype=float)
    if times.ndim != 1 or times.size < 2 or not np.isfinite(times).all() or not np.all(np.diff(times) > 0):
        raise ValueError(f"timepts must be two or more finite times that increase strictly, got {timepts!r:.80}")
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    system = state_space(system)
    sources = _sources(system, inputs, times)
    form, reason = _exact_form(system, sources, params)
    if method == "exact" and form is None:
        raise ValueError(f'method "exact" must be given a linear continuous system and trajectories, but {reason}')
    state = _initial_state(system, initial_state)
    if form is not None and method != "python":
        return _exact(system, form, [s for s in sources if isinstance(s, Trajectory)], times, state, reason)
    outputs, states, driven = numerical_response(system, sources, times, state, rtol, atol, dict(params or {}))
    why = reason if form is None else 'method "python" was asked for'
    return _response(system, times, outputs, states, driven, "python", why)


def _sources(system: Any, inputs: Inputs, times: Array) -> list[Trajectory | Array]:
    """What drives the inputs, in order: trajectories, or samples (ntime,) of one input."""
    names = list(system.input_labels or [])
    given: list[Any]
    if isinstance(inputs, Mapping):
        for name in inputs:
            if name not in names:
                raise ValueError(f"inputs must be among {', '.join(names) or 'none'}, got {name!r}")
        given = [inputs.get(name, 0.0) for name in names]
    elif isinstance(inputs, Trajectory):
        if inputs.naxes != len(names):
            known = f"({', '.join(names)})" if names else "(the system has no inputs)"
            raise ValueError(f"inputs must have {len(names)} axes {known}, got {inputs.naxes}")
        return [inputs]
    elif inputs is None or np.ndim(inputs) == 0:
        given = [0.0 if inputs is None else inputs] * len(names)
    else:
        rows = np.asarray(inputs, dtype=float)
        rows = rows[None] if rows.ndim == 1 and len(names) == 1 else rows
        if rows.shape not in ((len(names), times.size), (len(names),)):
            raise ValueError(f"inputs must have shape ({len(names)}, {times.size}), got {rows.shape}")
        given = list(rows)
    return [_source(value, name, times) for value, name in zip(given, names, strict=True)]


def _source(value: Any, name: str, times: Array) -> Trajectory | Array:
    if isinstance(value, Trajectory):
        if value.naxes != 1:
            raise ValueError(f"input {name} must be driven by one axis, got {value.naxes}")
        return value
    signal = np.asarray(value, dtype=float)
    if not np.isfinite(signal).all():
        raise ValueError(f"input {name} must be finite, got nan or inf at index {int((~np.isfinite(signal)).argmax())}")
    if signal.ndim == 0:
        return Step(signal, initial=signal, time=times[0])
    if signal.shape != times.shape:
        kinds = f"a trajectory, a number or {times.size} samples"
        raise ValueError(f"input {name} must be {kinds}, got shape {signal.shape}")
    return signal


def _initial_state(system: Any, initial_state: ArrayLike) -> Array:
    if np.ndim(initial_state) == 0 and initial_state == 0 and hasattr(system, "initial_state"):
        initial_state = system.initial_state
    state = np.asarray(initial_state, dtype=float)
    count = system.nstates or 0
    if state.ndim and state.shape != (count,):
        raise ValueError(f"initial_state must be a scalar or have {count} entries, got shape {state.shape}")
    if not np.isfinite(state).all():
        raise ValueError(f"initial_state must be finite, got {initial_state!r}")
    return np.broadcast_to(state, (count,)).copy()


def _exact_form(
    system: Any, sources: list[Trajectory | Array], params: Mapping[str, Any] | None
) -> tuple[LinearForm | None, str]:
    """Linear form where the exact method holds, and why it does or not."""
    if params:
        return None, "params may change the blocks"
    if not all(isinstance(s, Trajectory) for s in sources):
        return None, "an input is given by samples"
    try:
        return linear_form(system), "linear, continuous, driven by trajectories"
    except NotLinearError as error:
        return None, str(error)


def _exact(
    system: Any, form: LinearForm, drives: list[Trajectory], times: Array, state: Array, reason: str
) -> ct.TimeResponseData:
    plans = [(drive, 0) for drive in drives] + list(form.sources)

    def jet(moment: float, origin: float, s: Array, order: int) -> Array:
        rows = [plan._jet_beside(moment, origin, s, order + high) for plan, high in plans]
        signals = [_derivatives(row, high, order) for row, (_, high) in zip(rows, plans, strict=True)]
        return np.concatenate(signals, axis=1) if signals else np.zeros((order + 1, 0, s.size))

    breakpoints = [t for plan, _ in plans for t in plan.breakpoints]
    with np.errstate(over="ignore", invalid="ignore"):
        states = exact_states(form.a, form.b, jet, breakpoints, times, state)
        signals = [signal_rows(plan, times, high) for plan, high in plans]
        driven = np.concatenate(signals) if signals else np.zeros((0, times.size))
        outputs = form.c @ states + form.d @ driven
    return _response(system, times, _finite(outputs), _finite(states), driven[: system.ninputs or 0], "exact", reason)


def _derivatives(jet: Array, high: int, order: int) -> Array:
    """Jets (order + 1, naxes (high + 1), ntime) of a plan and its derivatives, axis by axis."""
    shifted = np.stack([jet[k : k + order + 1] for k in range(high + 1)], axis=2)
    return shifted.reshape(order + 1, -1, jet.shape[2])


def _finite(values: Array) -> Array:
    """An unstable loop that has left the range of numbers is infinite, not undefined."""
    values[np.isnan(values)] = np.inf
    return values


def _response(
    system: Any, times: Array, outputs: Array, states: Array, inputs: Array, method: str, reason: str
) -> ct.TimeResponseData:
    response = ct.TimeResponseData(
        times,
        outputs,
        states,
        inputs if len(inputs) else None,
        issiso=system.issiso(),
        output_labels=system.output_labels,
        state_labels=system.state_labels,
        input_labels=system.input_labels if len(inputs) else None,
        sysname=system.name,
        title=f"Response of {system.name}",
        plot_inputs=bool(len(inputs)),
    )
    response.method, response.reason, response.events = method, reason, []
    return response


def state_space(system: Any) -> Any:
    """Same system with states, where it is a transfer function."""
    if not isinstance(system, ct.TransferFunction):
        return system
    return ct.ss(system, name=system.name, inputs=system.input_labels, outputs=system.output_labels)


def rest_state(system: Any, position: ArrayLike) -> Array:
    """State at which a linear loop rests when its inputs are held.

    Parameters
    ----------
    system : control system
        Linear and continuous; of others the zero state is returned.
    position : array_like, shape (ninputs,)
        What the inputs are held at.

    Returns
    -------
    ndarray, shape (nstates,)
        A solution of A x + B w = 0, with outputs as near w as it allows; zero
        where there is none.
    """
    held = np.atleast_1d(np.asarray(position, dtype=float))
    if not held.any():
        return np.zeros(system.nstates or 0)
    try:
        form = linear_form(system)
    except NotLinearError:
        return np.zeros(system.nstates or 0)
    if form.b.shape[1] != held.size:
        return np.zeros(len(form.a))
    supplied = form.b @ held
    state: Array = np.linalg.lstsq(form.a, -supplied, rcond=None)[0]
    if np.abs(form.a @ state + supplied).max(initial=0.0) > 1e-9 * np.abs(supplied).max(initial=0.0):
        return np.zeros(len(form.a))
    # Where integrators leave a choice, the outputs should be what is asked for.
    idle, tracked = null_space(form.a), form.c[: held.size]
    if idle.size and len(tracked) == held.size:
        missing = held - tracked @ state - form.d[: held.size] @ held
        state = state + idle @ np.linalg.lstsq(tracked @ idle, missing, rcond=None)[0]
    return state


def unstable_poles(system: Any) -> NDArray[np.complex128]:
    """Poles in the right half plane of a linear continuous system; of others none are known."""
    try:
        poles = np.linalg.eigvals(linear_form(system).a).astype(complex)
    except NotLinearError:
        return np.empty(0, dtype=complex)
    return poles[poles.real > 1e-9 * np.maximum(1e-300, np.abs(poles))]
