"""Preview: how long before a plan the command must start for a given tracking error.

A command that starts at a time T before the plan, from rest, omits the earlier part of
the motion that leads to the state at the start of the plan. The tracking error is the
free response of the loop to this omitted state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import control as ct
import numpy as np
from scipy.linalg import expm

from ctrlplan._types import Array
from ctrlplan.systems.feedforward.zeros import ComplexArray, eigenvalues, zero_list
from ctrlplan.trajectories import Trajectory

_STEP = 0.02
"""Product of a pole and the spacing of the times at which a free response is evaluated."""

_MOST = 8192
"""Maximum number of such times in an octave of time."""

_DECAYED = 25.0
"""Exponent after which a mode is not resolved any more."""

_SCANNED = 256
"""Number of previews at which the error is evaluated before the last one above the limit is refined."""


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """Motion of a loop by the part of the internal states that a preview omits.

    Attributes
    ----------
    responses : ndarray, shape (ntime, noutputs, nunstable)
        Responses of the outputs to each internal state, relative to the move.
    state : callable
        Internal states (nunstable,) at a time, or number of samples, before the plan.
    rate : float
        Decay of the slowest of them, by unit of that time.
    whole : bool
        Whether times are numbers of samples.
    """

    responses: Array
    state: Callable[[float], Array]
    rate: float
    whole: bool = False

    def error(self, preview: float) -> float:
        """Maximum tracking error with a preview, relative to the move."""
        return float(np.abs(self.responses @ self.state(preview)).max(initial=0.0))


def continuous_motion(
    loop: ct.StateSpace, stable: bool, z: Array, shape: Array, departure: Array, plan: Trajectory
) -> FreeMotion:
    """Free motion of a continuous loop from states shape @ x, x' = z x, with x = departure at the start of the plan.

    Responses of an unstable loop are not computed.
    """
    rows = loop.C / _ranges(plan)[:, None]
    found = [rows @ shape]
    for time, step, count in _octaves(eigenvalues(loop.A)) if stable else ():
        state, change = expm(time * loop.A) @ shape, expm(step * loop.A)
        for _ in range(count):
            found.append(rows @ state)
            state = change @ state
    rate = float(np.linalg.eigvals(z).real.min())
    return FreeMotion(np.array(found), lambda preview: np.asarray(expm(-preview * z) @ departure), rate)


def discrete_motion(
    loop: ct.StateSpace, stable: bool, z: Array, shape: Array, departure: Array, plan: Trajectory
) -> FreeMotion:
    """The same for a discrete loop, whose time is the number of samples."""
    rows = loop.C / _ranges(plan)[:, None]
    found, state, change, stride, time = [rows @ shape], shape, np.asarray(loop.A), 1, 0
    end = 2 * loop.nstates + _longest(np.log(eigenvalues(loop.A) + 1e-15)) if stable else 0.0
    while time < end:
        for _ in range(min(_MOST, math.ceil((end - time) / stride))):
            state, time = change @ state, time + stride
            found.append(rows @ state)
        change, stride = change @ change, 2 * stride
    back = np.linalg.inv(z)
    rate = float(np.log(np.abs(np.linalg.eigvals(z))).min())
    return FreeMotion(
        np.array(found), lambda count: np.linalg.matrix_power(back, round(count)) @ departure, rate, whole=True
    )


def preview_of(
    motion: FreeMotion, error: float, given: float | None, poles: ComplexArray, stable: bool
) -> tuple[float, float]:
    """Shortest preview for an error relative to the move, or the given one; and the error with it."""
    if given is not None:
        return given, motion.error(given) if stable else np.inf
    if not stable:
        raise ValueError(
            f"loop must be stable for a preview to be computed, got poles {zero_list(poles)}: the error by any finite "
            "preview grows. Stabilise it first, or give preview= and start from the attribute loop_state of the block"
        )
    shortest = _shortest(motion, error)
    return shortest, motion.error(shortest)


def _ranges(plan: Trajectory) -> Array:
    """Range of each axis; the largest one for axes that do not move."""
    extrema = plan.extrema()
    found = extrema.maximum - extrema.minimum
    return np.where(found > 0.0, found, found.max() or 1.0)


def _octaves(poles: ComplexArray) -> list[tuple[float, float, int]]:
    """Start, spacing and number of times, denser where fast modes have not decayed."""
    sizes, decays = np.abs(poles), -poles.real
    damped = decays > 1e-9 * sizes.max(initial=0.0)
    if not sizes.any():
        return [(0.0, 0.0, 1)]
    end, time, length = _longest(poles), 0.0, 1.0 / sizes.max()
    found = []
    while time < end:
        alive = sizes[~damped | (decays * time < _DECAYED)].max(initial=0.0)
        count = int(min(max(np.ceil(length * alive / _STEP), 16), _MOST))
        found.append((time, length / count, count))
        time, length = time + length, time + length
    return found


def _longest(poles: ComplexArray) -> float:
    """Time after which damped modes have decayed and others have had two periods."""
    sizes, decays = np.abs(poles), -poles.real
    limit = 1e-9 * sizes.max(initial=0.0)
    slowest, smallest = decays[decays > limit].min(initial=np.inf), sizes[sizes > limit].min(initial=np.inf)
    return float(max(_DECAYED / slowest, 4.0 * np.pi / smallest))


def _shortest(motion: FreeMotion, error: float) -> float:
    """Shortest preview from which on the error stays below a limit."""
    end = max(1.0 / motion.rate, 1.0 if motion.whole else 0.0)
    while max(motion.error(end * part) for part in np.linspace(1.0, 2.0, 16)) > error:
        end *= 2.0
    scan = np.linspace(0.0, end, _SCANNED)
    scan = np.unique(np.ceil(scan)) if motion.whole else scan
    above = np.flatnonzero([motion.error(time) > error for time in scan])
    if not above.size:
        return 0.0
    low, high = scan[above[-1]], scan[min(above[-1] + 1, scan.size - 1)]
    while high - low > (1.0 if motion.whole else 1e-9 * high):
        middle = 0.5 * (low + high)
        middle = np.floor(middle) if motion.whole else middle
        low, high = (middle, high) if motion.error(middle) > error else (low, middle)
    return float(high)
