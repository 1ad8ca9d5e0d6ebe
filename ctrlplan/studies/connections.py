"""Check that references are connected to the outputs that follow them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import partial

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._lru import Lru
from ctrlplan._types import System
from ctrlplan.simulation import Prepared, prepared_form
from ctrlplan.simulation.network import Block, Network
from ctrlplan.trajectories import Trajectory

_FRACTIONS = np.array([0.0, 0.0312, 0.1234, 0.25, 0.3456, 0.5, 0.6543, 0.75, 0.8765, 1.0])
"""Times at which two plans are compared, as fractions of the duration."""


def check_reached(system: System, outputs: Sequence[str], plan: Trajectory | None = None) -> None:
    """Raise if a reference has no effect on the outputs that follow it.

    Dependence is determined from the connections and from the matrices of
    linear blocks; every output of a nonlinear block depends on every input.

    Parameters
    ----------
    system : control system or Prepared
        A loop.
    outputs : sequence of str
        Outputs that follow the plan.
    plan : Trajectory, optional
        The reference, if a block inside the loop may be its source.

    Raises
    ------
    ValueError
        If an input of the loop, or an axis of a plan inside, affects none of
        `outputs`, another source inside affects no output at all, or an input
        for a derivative of a source is not connected.
    """
    original = system.original if isinstance(system, Prepared) else system
    structure = None if original is None else _structure(original)
    if structure is None:
        _check_network(system, outputs, plan)
    else:  # many loops of a sweep differ in numbers only
        _REACHED.get((tuple(outputs), structure), partial(_check_network, system, outputs, plan))


_REACHED: Lru[tuple[object, ...], None] = Lru(16)
"""Outputs and structures of linear loops in which references reach these outputs."""


def _structure(system: System) -> tuple[object, ...] | None:
    """Labels, connections and nonzero entries of a loop of linear blocks; None for others."""
    labels = tuple(system.input_labels or ()), tuple(system.output_labels or ())
    if isinstance(system, ct.InterconnectedSystem):
        parts = [_structure(block) for block in system.syslist]
        maps = [np.asarray(found) for found in (system.connect_map, system.input_map, system.output_map)]
        tokens = tuple((entries.shape, entries.tobytes()) for entries in maps)
        return None if None in parts else (labels, tokens, *parts)
    if not isinstance(system, ct.StateSpace):
        return None
    matrices = [np.asarray(matrix) for matrix in (system.A, system.B, system.C, system.D)]
    return labels, tuple((entries.shape, (entries != 0.0).tobytes()) for entries in matrices)


def _check_network(system: System, outputs: Sequence[str], plan: Trajectory | None) -> None:
    """Raise as `check_reached`."""
    network = prepared_form(system).network
    if network is None or not network.blocks:
        return
    tracked = [list(system.output_labels).index(name) for name in outputs]
    followed = _reaching(network, np.any(network.read[tracked] != 0.0, axis=0))
    seen = _reaching(network, np.any(network.read != 0.0, axis=0))
    idle = [label for label, reaches in zip(system.input_labels or (), followed, strict=False) if not reaches]
    if idle:
        raise _unconnected(system, network, f"input {', '.join(idle)} that affects none of {', '.join(outputs)}")
    carried = np.zeros(0 if plan is None else plan.naxes, dtype=bool)
    used, sources = carried.copy(), []
    for block, place in zip(network.blocks, network.outputs, strict=True):
        source = block.plan
        if source is None:
            continue
        width = (place.stop - place.start) // source.naxes
        for axis in range(source.naxes):
            signals = slice(place.start + axis * width, place.start + (axis + 1) * width)
            same = np.zeros(0, dtype=bool) if plan is None else _same_axes(plan, source, axis)
            carried |= same
            used |= same & followed[signals].any()
            if same.any():
                sources.append(block.name)
            elif not seen[signals].any():
                names = ", ".join(block.system.output_labels[axis * width : (axis + 1) * width])
                raise _unconnected(system, network, f"{names} of block {block.name} that affect no output")
    _check_derivatives(system, network)
    if plan is not None and np.any(carried & ~used):
        axes = ", ".join(np.array(plan.labels)[carried & ~used])
        what = f"{axes} of block {', '.join(dict.fromkeys(sources))} that affects none of {', '.join(outputs)}"
        raise _unconnected(system, network, what)


def _check_derivatives(system: System, network: Network) -> None:
    """Raise if an input for a derivative of a reference is not connected: it would be 0."""
    known = {
        _plain(label) for block in network.blocks if block.plan is not None for label in block.system.output_labels
    }
    for block, label in _open_inputs(network):
        if _plain(label) in known:
            what = f"{block}.{label} unconnected; give the source more derivatives"
            raise ValueError(f"references must be connected in the loop {system.name}, got {what}")


def _plain(label: str) -> str:
    """Label of a signal without the suffix of a derivative."""
    return re.sub(r"_d[0-9]+$", "", label)


def _unconnected(system: System, network: Network, what: str) -> ValueError:
    left = [f"{block}.{label}" for block, label in _open_inputs(network)]
    to_do = f"; unconnected inputs of blocks: {', '.join(left)}" if left else ""
    return ValueError(f"references must be connected in the loop {system.name}, got {what}{to_do}")


def _open_inputs(network: Network) -> Iterator[tuple[str, str]]:
    """Unconnected inputs of blocks (block, label), which are 0."""
    for block, place in zip(network.blocks, network.inputs, strict=True):
        for label, row in zip(block.system.input_labels or (), network.wire[place], strict=True):
            if not row.any():
                yield block.name, label


def _reaching(network: Network, wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Signals on which others depend, directly or through states."""
    found = wanted.copy()
    depends = [_depends(block) for block in network.blocks]
    while True:
        before = np.count_nonzero(found)
        for block, outs, ins in zip(depends, network.outputs, network.inputs, strict=True):
            required = block[found[outs]].any(axis=0)
            found |= np.any(network.wire[ins][required] != 0.0, axis=0)
        if np.count_nonzero(found) == before:
            return found


def _depends(block: Block) -> NDArray[np.bool_]:
    """Dependence of outputs on inputs of a block, directly or through states, (noutputs, ninputs)."""
    if block.delay is not None:  # signal by signal
        return np.eye(block.system.noutputs, dtype=bool)
    if not block.linear:
        return np.ones((block.system.noutputs, block.system.ninputs or 0), dtype=bool)
    a, b, c, d = (np.asarray(getattr(block.system, name)) != 0.0 for name in "ABCD")
    if not len(a) and not d.any():  # a connected gain that is 0
        return np.ones(d.shape, dtype=bool)
    moved = b
    for _ in range(len(a)):
        moved = moved | (a @ moved)
    return np.asarray(d | (c @ moved))


def _same_axes(plan: Trajectory, source: Trajectory, axis: int) -> NDArray[np.bool_]:
    """Axes of a plan that are equal to an axis of a source."""
    if source is plan:
        return np.arange(plan.naxes) == axis
    t = plan.start + _FRACTIONS * (plan.duration or 1.0)
    mine, other = plan.jet(t, 0)[0], source.jet(t, 0)[0, axis]
    size = np.abs(mine).max(axis=1)
    return np.asarray(np.all(np.abs(mine - other) <= 1e-12 * size[:, None], axis=1) & (np.ptp(mine, axis=1) > 0.0))
