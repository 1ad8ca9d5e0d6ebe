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
        states = np.zeros((0, times.size)) if response.x is None else np.asarray(response.states)
        return np.reshape(response.outputs, (-1, times.size)), states.reshape(-1, times.size), inputs(times)
    first, last = float(times[0]), float(times[-1])
    marks = [t for drive in drives if isinstance(drive, Trajectory) for t in drive.breakpoints]
    marks += [t for block in blocks_of(system) for t in getattr(block, "breakpoints", ())]
    corners, longest = _corners(drives, times)
    inner = _apart([first, *sorted(float(t) for t in [*marks, *corners] if first < t < last), last])[1:-1]
    dynamics, output = _maps(system, params, (first, initial, inputs(times[:1])[:, 0]))
    states = np.empty((initial.size, times.size))
    state = initial
    for left, right in zip([first, *inner], [*inner, last], strict=True):
        begin, end = np.searchsorted(times, [left, right])
        end += right == last
        asked = np.union1d(times[begin:end], [left, right])
        if initial.size:
            found = solve_ivp(
                _advancing(lambda t, x: dynamics(t, x, inputs(np.array([t]))[:, 0]), left, right),
                (left, right),
                state,
                method="LSODA",
                t_eval=asked,
                rtol=rtol,
                atol=atol,
                max_step=longest,
            )
            if not found.success:
                raise RuntimeError(f"the solver must reach {right:g} s, got to {found.t[-1]:g} s: {found.message}")
            states[:, begin:end] = found.y[:, np.searchsorted(asked, times[begin:end])]
            state = found.y[:, -1]
    driven = inputs(times)
    columns = [output(t, states[:, i], driven[:, i]) for i, t in enumerate(times.tolist())]
    return np.array(columns).T.reshape(-1, times.size), states, driven


def _corners(drives: Sequence[Trajectory | Array], times: Array) -> tuple[list[float], float]:
    """Where sampled inputs, straight lines in between, bend; or the longest step that passes no bend by."""
    bends = np.zeros(times.size, dtype=bool)
    for drive in drives:
        if not isinstance(drive, Trajectory):
            slope = np.diff(drive) / np.diff(times)
            bends[1:-1] |= slope[1:] != slope[:-1]
    if bends.sum() > 1000:
        return [], float(np.diff(times).min())
    return times[bends].tolist(), np.inf


def _advancing(rate: Callable[[float, Array], Array], left: float, right: float) -> Callable[[float, Array], Array]:
    """Right-hand side that refuses to be asked for ever about one instant: the solution ends there."""
    farthest, asked = left, 0

    def checked(t: float, x: Array) -> Array:
        nonlocal farthest, asked
        asked += 1
        if t > farthest + 1e-9 * (right - left):
            farthest, asked = t, 0
        elif asked > 5000:
            raise RuntimeError(f"the solver must reach {right:g} s, got to {farthest:g} s: the solution ends there")
        return rate(t, x)

    return checked


def _apart(times: list[float]) -> list[float]:
    """Increasing times without those that are the same but for rounding; first and last stay."""
    kept = [times[0]]
    for t in times[1:-1]:
        if t - kept[-1] > 1e-14 * max(abs(t), times[-1] - times[0]) < times[-1] - t:
            kept.append(t)
    return [*kept, times[-1]]


def _maps(system: Any, params: dict[str, Any], probe: tuple[float, Array, Array]) -> tuple[Map, Map]:
    """Right-hand side and outputs: flattened where the system can be, else python-control's own."""
    if isinstance(system, ct.InterconnectedSystem):
        maps = flattened(system, params, probe)
        if maps is not None:
            return maps
    own = None if isinstance(system, ct.StateSpace) else params or None
    return lambda t, x, u: system.dynamics(t, x, u, own), lambda t, x, u: system.output(t, x, u, own)


def _signals(drives: Sequence[Trajectory | Array], times: Array) -> Callable[[Array], Array]:
    def signals(t: Array) -> Array:
        rows = [
            drive.jet(t, 0)[0] if isinstance(drive, Trajectory) else np.interp(t, times, drive)[None]
            for drive in drives
        ]
        return np.concatenate(rows) if rows else np.zeros((0, t.size))

    return signals
