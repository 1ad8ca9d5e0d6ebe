"""An interconnection as one list of blocks, each called once a step in order.

python-control calls every block several times to settle static connections,
at every level of nesting. Here the connections of all levels become one matrix
between the innermost blocks, and a schedule made from their true feedthrough
says in which order their outputs are known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

Array = NDArray[np.float64]
Map = Callable[[float, Array, Array], Array]


def blocks_of(system: Any) -> Iterator[Any]:
    """The system and every block inside it, at any depth."""
    yield system
    for block in getattr(system, "syslist", ()):
        yield from blocks_of(block)


def flattened(system: Any, params: dict[str, Any], probe: tuple[float, Array, Array]) -> tuple[Map, Map] | None:
    """Fast right-hand side and outputs (t, x, u) of an interconnection.

    Parameters
    ----------
    system : control.InterconnectedSystem
        Continuous, nested at will.
    params : dict
        Parameters of the blocks.
    probe : (float, ndarray, ndarray)
        Time, state and input of the start, about which feedthrough is probed.

    Returns
    -------
    (callable, callable) or None
        None where blocks form an algebraic loop, or where these maps do not
        agree with python-control's own about the probe.
    """
    wiring = _wiring(system)
    slices = _Slices.of(wiring.blocks)
    t, x, u = probe
    feeds = [
        _feedthrough(block, params, t, x[place]) for block, place in zip(wiring.blocks, slices.states, strict=True)
    ]
    needed = np.any(wiring.inner != 0.0, axis=0)
    order = _schedule(wiring, slices, feeds, needed)
    every = _schedule(wiring, slices, feeds, np.ones_like(needed))
    if order is None or every is None:
        return None
    outputs = [_output(block, params) for block in wiring.blocks]
    updates = [_update(block, params) for block in wiring.blocks]
    states, ins, outs = slices.states, slices.inputs, slices.outputs
    moving = [i for i, s in enumerate(states) if s.stop > s.start]

    def signals(schedule: list[int], t: float, x: Array, u: Array) -> Array:
        y = np.zeros(slices.noutputs)
        for i in schedule:
            y[outs[i]] = outputs[i](t, x[states[i]], wiring.inner[ins[i]] @ y + wiring.outer[ins[i]] @ u)
        return y

    def dynamics(t: float, x: Array, u: Array) -> Array:
        fed = wiring.inner @ signals(order, t, x, u) + wiring.outer @ u
        dx = np.empty(slices.nstates)
        for i in moving:
            dx[states[i]] = updates[i](t, x[states[i]], fed[ins[i]])
        return dx

    def output(t: float, x: Array, u: Array) -> Array:
        y = signals(every, t, x, u)
        return wiring.read @ y + wiring.passed @ (wiring.inner @ y + wiring.outer @ u)

    own = None if isinstance(system, ct.StateSpace) else params or None
    rng = np.random.default_rng(0)
    for shift in (0.0, 1e-3, 1e-2, 0.1):
        state = x + shift * rng.standard_normal(x.size) * np.maximum(1.0, np.abs(x))
        try:
            with np.errstate(all="ignore"):
                pairs = [
                    (dynamics(t, state, u), system.dynamics(t, state, u, own)),
                    (output(t, state, u), system.output(t, state, u, own)),
                ]
        except (RuntimeError, ValueError):
            return None
        for found, expected in pairs:
            if not np.allclose(found, expected, rtol=1e-9, atol=1e-9 * (1.0 + np.abs(expected).max(initial=0.0))):
                return None
    return dynamics, output


@dataclass(frozen=True)
class _Wiring:
    """Innermost blocks; their inputs are inner @ outputs + outer @ external inputs."""

    blocks: list[Any]
    inner: Array
    outer: Array
    read: Array  # outputs of the whole from the blocks' outputs
    passed: Array  # and from their inputs


def _wiring(system: Any) -> _Wiring:
    if not isinstance(system, ct.InterconnectedSystem):
        nin, nout = system.ninputs or 0, system.noutputs
        return _Wiring([system], np.zeros((nin, nout)), np.eye(nin), np.eye(nout), np.zeros((nout, nin)))
    parts = [_wiring(block) for block in system.syslist]
    inner, outer, read, passed = (
        block_diag(*(getattr(p, name) for p in parts)) for name in ("inner", "outer", "read", "passed")
    )
    connect = np.asarray(system.connect_map, dtype=float)
    external = np.asarray(system.input_map, dtype=float).reshape(len(connect), -1)
    # Parts take connect @ their outputs + external @ r, and their outputs are read @ y + passed @ u.
    closing = np.linalg.inv(np.eye(len(outer)) - outer @ connect @ passed)
    u_y, u_r = closing @ (inner + outer @ connect @ read), closing @ outer @ external
    outputs = np.asarray(system.output_map, dtype=float)
    from_out, from_in = outputs[:, : len(read)], outputs[:, len(read) :]
    of_part = from_out + from_in @ connect
    return _Wiring(
        [block for part in parts for block in part.blocks],
        u_y,
        u_r,
        of_part @ read,
        of_part @ passed,
    )


@dataclass(frozen=True)
class _Slices:
    """Where each block's states, inputs and outputs stand among all."""

    states: list[slice]
    inputs: list[slice]
    outputs: list[slice]
    nstates: int
    noutputs: int

    @classmethod
    def of(cls, blocks: list[Any]) -> _Slices:
        places = []
        for counts in zip(*((b.nstates or 0, b.ninputs or 0, b.noutputs) for b in blocks), strict=True):
            ends = np.cumsum(counts).tolist()
            places.append([slice(end - n, end) for n, end in zip(counts, ends, strict=True)])
        states, inputs, outputs = places
        return cls(states, inputs, outputs, states[-1].stop, outputs[-1].stop)


def _schedule(
    wiring: _Wiring, slices: _Slices, feeds: list[NDArray[np.bool_]], needed: NDArray[np.bool_]
) -> list[int] | None:
    """Blocks in the order in which the outputs needed can be known; one may stand twice."""
    known = np.zeros(slices.noutputs, dtype=bool)
    order: list[int] = []
    while not known[needed].all():
        progress = False
        for i, feed in enumerate(feeds):
            rows = np.arange(slices.outputs[i].start, slices.outputs[i].stop)
            ready = np.all((wiring.inner[slices.inputs[i]] == 0.0) | known, axis=1)
            new = rows[np.all(~feed | ready, axis=1) & ~known[rows]]
            if np.any(needed[new]):
                order.append(i)
                known[new] = True
                progress = True
        if not progress:
            return None
    return order


def _feedthrough(block: Any, params: dict[str, Any], t: float, x: Array) -> NDArray[np.bool_]:
    """Which outputs depend on which inputs at once, (noutputs, ninputs)."""
    nin = block.ninputs or 0
    if isinstance(block, ct.StateSpace):
        return np.asarray(block.D) != 0.0
    found = np.zeros((block.noutputs, nin), dtype=bool)
    if not block.nstates:
        found[:] = True
        return found
    rng = np.random.default_rng(1)
    output = _output(block, params)
    with np.errstate(all="ignore"):
        for scale in (0.0, 1.0, 1e3):
            u = scale * rng.standard_normal(nin)
            state = x + 0.1 * rng.standard_normal(x.size)
            before = output(t, state, u)
            for j in range(nin):
                for step in (1e-3, 1.0, 1e3):
                    moved = u.copy()
                    moved[j] += step
                    found[:, j] |= np.asarray(output(t, state, moved)) != before
    return found


def _output(block: Any, params: dict[str, Any]) -> Callable[[float, Array, Array], Array]:
    if isinstance(block, ct.StateSpace):
        c, d = np.asarray(block.C), np.asarray(block.D)
        return lambda t, x, u: c @ x + d @ u
    out, own = block.outfcn, {**block.params, **params}
    if out is None:
        return lambda t, x, u: x
    return lambda t, x, u: out(t, x, u, own)


def _update(block: Any, params: dict[str, Any]) -> Callable[[float, Array, Array], Array]:
    if isinstance(block, ct.StateSpace):
        a, b = np.asarray(block.A), np.asarray(block.B)
        return lambda t, x, u: a @ x + b @ u
    update, own = block.updfcn, {**block.params, **params}
    return lambda t, x, u: update(t, x, u, own)
