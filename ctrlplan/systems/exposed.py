"""Systems with their states among their outputs."""

from __future__ import annotations

import copy
import re
from collections.abc import Collection, Sequence
from functools import partial

import control as ct
import numpy as np

from ctrlplan._types import Params, System, Value
from ctrlplan.traits import declare, traits_of


def expose_states(system: System, name: str | None = None) -> System:
    """System with its states as additional outputs.

    Interconnections are rebuilt from blocks with state outputs, so that
    `ctrlplan.simulate` still has access to every block, sampled ones included.

    States and inputs: those of `system`. Outputs: its own, then its states,
    with names by `state_signals`.

    Parameters
    ----------
    system : control system
        A `control.StateSpace`, `control.TransferFunction`,
        `control.NonlinearIOSystem` or `control.InterconnectedSystem`.
    name : str, optional
        Name of the new system, by default that of `system`.

    Returns
    -------
    control system
        Of the type of `system`; a `control.StateSpace` for a transfer function.

    Raises
    ------
    TypeError
        If `system` has another type, or a block overrides the equations of its
        class.
    ValueError
        If an output already has the name of a state output.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> cp.expose_states(cp.plants.integrator_lag_loop(5.0)).output_labels
    ['y', 'plant_x_0_state', 'plant_x_1_state']
    """
    if isinstance(system, ct.TransferFunction):
        system = ct.ss(system, name=system.name, inputs=system.input_labels, outputs=system.output_labels)
    names = state_signals(getattr(system, "state_labels", None) or ())
    twice = set(names) & set(getattr(system, "output_labels", None) or ())
    if twice:
        raise ValueError(f"outputs of {system.name} must not have the name of a state output, got {min(twice)!r}")
    found = _exposed(system, names)
    if found is system:
        found = copy.copy(system)
    found.name = name or system.name
    return found


def state_signals(labels: Sequence[str]) -> list[str]:
    """Names of the state outputs of `expose_states`.

    Letters, digits and underscores of the state label, followed by ``_state``,
    so that `control.interconnect` connects no signal unintentionally.

    Parameters
    ----------
    labels : sequence of str
        State labels of a system, in order.

    Returns
    -------
    list of str
        As many names, all different.

    Examples
    --------
    >>> state_signals(["speed", "plant_x[0]"])
    ['speed_state', 'plant_x_0_state']
    """
    found: list[str] = []
    for label in labels:
        name = re.sub(r"\W+", "_", label, flags=re.ASCII).strip("_")
        found.append(_free(f"{name}_state", found))
    return found


def _exposed(system: System, names: Sequence[str]) -> System:
    """System with state outputs of given names; the same object if it has no states."""
    if not isinstance(system, ct.StateSpace | ct.NonlinearIOSystem):
        raise TypeError(f"system must be a control system with states, got {type(system).__name__}")
    if not names:
        return system
    if isinstance(system, ct.InterconnectedSystem):
        return _interconnection(system, names)
    if isinstance(system, ct.StateSpace):
        return _state_space(system, names)
    return _block(system, names)


def _state_space(system: ct.StateSpace, names: Sequence[str]) -> ct.StateSpace:
    return ct.StateSpace(
        system.A,
        system.B,
        np.vstack([system.C, np.eye(len(names))]),
        np.vstack([system.D, np.zeros((len(names), system.ninputs))]),
        system.dt,
        inputs=system.input_labels,
        outputs=[*system.output_labels, *names],
        states=system.state_labels,
        name=system.name,
    )


def _block(system: ct.NonlinearIOSystem, names: Sequence[str]) -> ct.NonlinearIOSystem:
    """Copy of a block with its declared traits and additional outputs."""
    if any(getattr(type(system), name) is not getattr(ct.NonlinearIOSystem, name) for name in ("_rhs", "_out")):
        raise TypeError(
            f"block {system.name} must have updfcn and outfcn, got a {type(system).__name__} that overrides them"
        )
    block = copy.copy(system)
    block.outfcn = partial(_with_states, system.outfcn)
    block.set_outputs([*system.output_labels, *names])
    declared = False if system.outfcn is None else traits_of(system).feedthrough
    if declared is not None:
        own = np.broadcast_to(np.asarray(declared, dtype=bool), (system.noutputs, system.ninputs))
        declare(block, feedthrough=np.vstack([own, np.zeros((len(names), system.ninputs), dtype=bool)]))
    return block


def _interconnection(system: ct.InterconnectedSystem, names: Sequence[str]) -> ct.InterconnectedSystem:
    blocks: list[System] = []
    own_rows: list[int] = []
    states: list[int] = []
    first = 0
    for block in system.syslist:
        own = state_signals(block.state_labels)
        blocks.append(_exposed(block, [_free(name, block.output_labels) for name in own]))
        own_rows += range(first, first + block.noutputs)
        states += range(first + block.noutputs, first + block.noutputs + block.nstates)
        first += block.noutputs + block.nstates
    connect = np.zeros((system.connect_map.shape[0], first))
    connect[:, own_rows] = system.connect_map
    own_outputs = np.hstack([np.zeros((system.noutputs, first)), system.output_map[:, len(own_rows) :]])
    own_outputs[:, own_rows] = system.output_map[:, : len(own_rows)]
    state_outputs = np.eye(own_outputs.shape[1])[states]
    found = ct.InterconnectedSystem(
        blocks,
        inputs=system.input_labels,
        outputs=[*system.output_labels, *names],
        states=system.state_labels,
        params=system.params,
        dt=system.dt,
        name=system.name,
        warn_duplicate=False,
        connection_type=system.connection_type,
    )
    found.set_connect_map(connect)
    found.set_input_map(np.array(system.input_map))
    found.set_output_map(np.vstack([own_outputs, state_outputs]))
    if isinstance(system, ct.StateSpace):  # a linear interconnection of python-control stores its matrices as well
        found = ct.LinearICSystem(found, _state_space(system, names), system.connection_type)
    return declare(found, initial_state=traits_of(system).initial_state)


def _with_states(outputs: Value, t: Value, x: Value, u: Value, params: Params) -> Value:
    """Outputs of a block, then its states; numeric or symbolic."""
    own = x if outputs is None else outputs(t, x, u, params)
    if isinstance(own, np.ndarray) and isinstance(x, np.ndarray):
        return np.concatenate([own.ravel(), x])
    return [*_entries(own), *_entries(x)]


def _entries(values: Value) -> list[Value]:
    """Entries of a list, an array or a column of CasADi symbols."""
    count = getattr(values, "numel", None)
    return [values[k] for k in range(count())] if count is not None else list(np.ravel(values))


def _free(name: str, taken: Collection[str]) -> str:
    """Name with underscores appended until it is unused."""
    while name in taken:
        name += "_"
    return name
