"""Stop of a replanner, as states of its block."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ctrlplan._types import Array, Value
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.chosen import stop_limits
from ctrlplan.trajectories.velocity_change import velocity_changes

_PHASES = 3
_PER_AXIS = 3 + 2 * _PHASES  # position, velocity and acceleration; durations and jerks


class StopStates(NamedTuple):
    """Stop of all axes together, in minimum time, as states of a block.

    The states are 1 during a stop and otherwise 0, its start time, and for each axis
    the state at its start, then durations and jerks of its phases.

    Attributes
    ----------
    acceleration : ndarray, shape (naxes, 2)
        Minimum and maximum acceleration.
    jerk : ndarray, shape (naxes,)
        Maximum jerk.
    """

    acceleration: Array
    jerk: Array

    @classmethod
    def of(cls, plan: Trajectory, limits: Mapping[str, object]) -> StopStates:
        """Stop with limits of acceleration and jerk, as of `Trajectory.stop`."""
        return cls(*stop_limits(plan, limits))

    @property
    def labels(self) -> list[str]:
        """Names of the states."""
        return ["stopped", "stop_start", *(f"stop[{k}]" for k in range(_PER_AXIS * len(self.jerk)))]

    def begun(self, t: float, jet: Array) -> Array:
        """States at the beginning of a stop.

        Parameters
        ----------
        t : float
            Time [s].
        jet : ndarray, shape (3, naxes)
            Position, velocity and acceleration.
        """
        changes = velocity_changes(-jet[1], jet[2], self.acceleration, self.jerk, together=True)
        rows = [[*state, *c.durations, *c.jerks] for state, c in zip(jet.T.tolist(), changes, strict=True)]
        return np.array([1.0, t, *np.ravel(rows).tolist()])

    def jets(self, t: Value, x: Value, order: int) -> list[list[Value]]:
        """Jets axis by axis at a time, numeric or symbolic."""
        begins = range(2, 2 + _PER_AXIS * len(self.jerk), _PER_AXIS)
        return [_stop_jet(t - x[1], [x[k] for k in range(first, first + _PER_AXIS)], order) for first in begins]


def _stop_jet(elapsed: Value, states: list[Value], order: int) -> list[Value]:
    """Jet of one axis some time [s] after the beginning; at rest exactly after the last phase."""
    (p, v, a), durations, jerks = states[:3], states[3 : 3 + _PHASES], states[3 + _PHASES :]
    jerk: Value = 0.0
    for duration, value in zip(durations, jerks, strict=True):
        s = np.fmin(np.fmax(elapsed, 0.0), duration)
        p, v, a = p + s * (v + s * (a / 2.0 + s * value / 6.0)), v + s * (a + s * value / 2.0), a + s * value
        jerk = jerk + value * (elapsed >= 0.0) * (elapsed < duration)
        elapsed = elapsed - duration
    moves = elapsed < 0.0
    return [p, v * moves, a * moves, jerk, *[0.0] * order][: order + 1]
