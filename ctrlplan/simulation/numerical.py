"""Responses of systems that are not linear, by a numerical solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ctrlplan.simulation.flattened import Map, blocks_of, flattened
from ctrlplan.trajectories import Trajectory

Array = NDArray[np.float64]


def numerical_response(
    system: Any,
    drives: Sequence[Trajectory | Array],
    times: Array,
    initial: Array,
    rtol: float,
    atol: float,
    params: dict[str, Any],
) -> tuple[Array, Array, Array]:
    """Outputs, states and inputs at the sample times, each (nsignals, ntime).

    The solver starts anew at every breakpoint of a driving trajectory or of a
    block inside: it steps over none, and no step straddles a jump.

    Raises
    ------
    RuntimeError
        If the solver fails; the time is in the message.
    """
    inputs = _signals(drives, times)
    if system.dt not in (None, 0):
        sampled = inputs(times) if system.ninputs else 0
        response = ct.input_output_response(system, times, sampled, initial, params=params or None)
        shape = (-1, times.size)
        return response.outputs.reshape(shape), response.states.reshape(shape), inputs(times)
    first, last = float(times[0]), float(times[-1])
    marks = [t for drive in drives if isinstance(drive, Trajectory) for t in drive.breakpoints]
    marks += [t for block in blocks_of(system) for t in getattr(block, "breakpoints", ())]
    inner = sorted({float(t) for t in marks if first < t < last})
    dynamics, output = _maps(system, params, (first, initial, inputs(times[:1])[:, 0]))
    states = np.empty((initial.size, times.size))
    state = initial
    for left, right in zip([first, *inner], [*inner, last], strict=True):
        begin, end = np.searchsorted(times, [left, right])
        end += right == last
        asked = np.union1d(times[begin:end], [left, right])
        if initial.size:
            found = solve_ivp(
                lambda t, x: dynamics(t, x, inputs(np.array([t]))[:, 0]),
                (left, right),
                state,
                method="LSODA",
                t_eval=asked,
                rtol=rtol,
                atol=atol,
            )
            if not found.success:
                raise RuntimeError(f"the solver must reach {right:g} s, got to {found.t[-1]:g} s: {found.message}")
            states[:, begin:end] = found.y[:, np.searchsorted(asked, times[begin:end])]
            state = found.y[:, -1]
    driven = inputs(times)
    columns = [output(t, states[:, i], driven[:, i]) for i, t in enumerate(times.tolist())]
    return np.array(columns).T.reshape(-1, times.size), states, driven


def _maps(system: Any, params: dict[str, Any], probe: tuple[float, Array, Array]) -> tuple[Map, Map]:
    """Right-hand side and outputs: flattened where the system can be, else python-control's own."""
    if isinstance(system, ct.InterconnectedSystem):
        maps = flattened(system, params, probe)
        if maps is not None:
            return maps
    own = params or None
    return lambda t, x, u: system.dynamics(t, x, u, own), lambda t, x, u: system.output(t, x, u, own)


def _signals(drives: Sequence[Trajectory | Array], times: Array) -> Callable[[Array], Array]:
    def signals(t: Array) -> Array:
        rows = [
            drive.jet(t, 0)[0] if isinstance(drive, Trajectory) else np.interp(t, times, drive)[None]
            for drive in drives
        ]
        return np.concatenate(rows) if rows else np.zeros((0, t.size))

    return signals
