"""Simulation of one plan in one loop."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias, TypeGuard

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array, Params
from ctrlplan.metrics._held import Held
from ctrlplan.simulation import (
    Event,
    Prepared,
    check_begin,
    equilibrium_at,
    state_space,
    unchanged,
    unstable_poles,
)
from ctrlplan.simulation.held_outputs import HeldOutputs
from ctrlplan.simulation.simulate import simulate_for_metrics
from ctrlplan.studies.connections import check_reached
from ctrlplan.studies.measures import Run, checked_names
from ctrlplan.trajectories import Trajectory

System: TypeAlias = "ct.InputOutputSystem | Prepared"
"""A loop."""
Builder: TypeAlias = Callable[[str, Trajectory], System]
"""Function of a plan's name and the plan that returns a loop."""

CONTROL = re.compile("u")
"""Labels of controls unless they are given: python-control calls the inputs of a plant u."""


def run_plan(
    loop: System | Builder,
    name: str,
    plan: Trajectory,
    times: Array,
    *,
    axes: tuple[str, ...],
    last: float,
    outputs: Sequence[str] | None = None,
    controls: Sequence[str] | None = None,
    initial_state: ArrayLike | None = None,
    params: Params | None = None,
    events: Sequence[Event] | None = None,
    done: dict[Prepared, Run] | None = None,
) -> Run:
    """Simulate a loop with a plan.

    Parameters
    ----------
    loop, outputs, controls, initial_state, params, events
        As for `compare`.
    name : str
        Name of the plan.
    plan : Trajectory
        The plan.
    times : ndarray, shape (ntime,)
        Sample times [s].
    axes : tuple of str
        Labels of the outputs that follow the plan, if the loop has them.
    last : float
        Time of the last waypoint [s].
    done : dict of Prepared to Run, optional
        Runs at these times by their loop, to which this one is added. A loop without
        inputs that a builder returns again, unchanged, is not simulated again.

    Warns
    -----
    UserWarning
        If the run does not start at equilibrium.
    """
    system = state_space(check_has_outputs(loop(name, plan)) if is_builder(loop) else loop)
    tracked, acting = _tracked(system, outputs, axes), acting_outputs(system, controls)
    with unchanged(system) as ready:
        check_reached(ready, tracked, plan)
        known = done.get(ready) if done else None
        if known is not None and not known.doubt:
            return replace(known, plan=plan, last=last)
        state, doubt = initial_state, ""
        if state is None and times.ndim == 1 and times.size and np.isfinite(times).all():  # otherwise simulate raises
            check_begin(ready.starts, float(times[0]), True)
            rows = [system.output_labels.index(label) for label in tracked]
            state, why = equilibrium_at(ready, plan, float(times[0]), rows, params)
            doubt = f"{name}: {_doubt(plan, times, state, why)}." if why else ""
        inputs, start = (plan if ready.ninputs else None), (0.0 if state is None else state)
        try:
            response, stop, held = simulate_for_metrics(ready, times, inputs, start, params=params, events=events)
        except Exception as error:
            if doubt:
                error.add_note(doubt)
            raise
    if doubt:
        warnings.warn(doubt, UserWarning, stacklevel=outside_stacklevel())
    stop = stop if response.time[-1] < times[-1] else None
    run = Run(plan, system, response, tracked, acting, last, _unstable(ready), doubt, stop, _held(system, held))
    if done is not None and not ready.ninputs:
        done[ready] = run
    return run


def _held(system: Prepared, held: HeldOutputs | None) -> dict[str, Held]:
    """Held parts of outputs by label."""
    if held is None:
        return {}
    parts = zip(held.rows.tolist(), held.values, strict=True)
    return {system.output_labels[row]: Held(held.times, values) for row, values in parts}


def _unstable(system: Prepared) -> NDArray[np.complex128] | None:
    """Poles in the right half plane; None if the loop is nonlinear."""
    return unstable_poles(system) if system.linear is not None else None


def _doubt(plan: Trajectory, times: Array, state: Array, why: str) -> str:
    held = ", ".join(f"{value:.4g}" for value in plan.jet(times[:1], 0, left=True)[0, :, 0])
    where = "the initial state of its blocks" if np.any(state) else "the zero state"
    return (
        f"no equilibrium of the loop was found with the plan held at its first position {held}: {why}. The run starts "
        f"at {where}; give initial_state= for another one"
    )


def is_builder(loop: object) -> TypeGuard[Callable[..., System]]:
    """Whether an object is a function that returns a loop; systems are callable as well."""
    return callable(loop) and not hasattr(loop, "output_labels")


def check_returned(loop: System | Builder) -> System | Builder:
    """Raise if a function has returned neither a loop nor a function of a plan that returns one."""
    return loop if is_builder(loop) else check_has_outputs(loop)


def check_has_outputs(loop: System) -> System:
    """Raise if a function has returned no loop."""
    if not hasattr(loop, "output_labels"):
        raise TypeError(f"loop must return a control system, got {'None' if loop is None else type(loop).__name__}")
    return loop


def check_has_inputs(loop: System) -> System:
    """Raise if an object is no loop, or a loop without an input for a plan."""
    if not hasattr(loop, "ninputs"):
        raise TypeError(
            f"loop must be a control system, or a function of name and plan that returns one, got {type(loop).__name__}"
        )
    if not loop.ninputs:
        raise ValueError(
            "loop must have inputs for the plans, got none; for a loop that contains the plan as a block, give a "
            "function of name and plan that returns it"
        )
    return loop


def tracked_outputs(loop: System, outputs: Sequence[str] | None, plan: Trajectory) -> tuple[str, ...]:
    """Outputs that follow a plan: those given, those named like its axes, or the first ones.

    Raises
    ------
    ValueError
        If their number differs from that of the axes, one is unknown, or an
        input of the loop affects none of them.
    TypeError
        If they are a string.
    """
    names = _tracked(loop, outputs, plan.labels)
    check_reached(loop, names)
    return names


def acting_outputs(loop: System, controls: Sequence[str] | None) -> tuple[str, ...]:
    """Outputs that are controls: those given, or those whose names begin with u."""
    if controls is None:
        return tuple(filter(CONTROL.match, loop.output_labels))
    return _known(loop, controls, "controls")


def _tracked(loop: System, outputs: Sequence[str] | None, axes: tuple[str, ...]) -> tuple[str, ...]:
    labels = list(loop.output_labels)
    if outputs is not None:
        names = _known(loop, outputs, "outputs")
    elif all(label in labels for label in axes):
        names = axes
    else:
        names = tuple(labels[: len(axes)])
    if len(names) != len(axes):
        raise ValueError(f"outputs must be as many as the plan's axes, {len(axes)}, got {', '.join(names) or 'none'}")
    return names


def _known(loop: System, names: Sequence[str], what: str) -> tuple[str, ...]:
    if isinstance(names, str):
        checked_names(names, loop.output_labels, what)
    return checked_names(names, loop.output_labels, "outputs and controls")
