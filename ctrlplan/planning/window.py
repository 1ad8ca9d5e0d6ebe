"""A plan on an interval of time, with the time of the given plan as an axis; mean squares."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.internal import InternalTrajectory
from ctrlplan.trajectories.quadrature import gauss

_NODES = 16
_TOLERANCE = 1e-13
"""Relative change of a mean square by bisection of all cells below which it is accepted."""
_LEVELS = 14


class _Window(InternalTrajectory):
    """Part of a plan, constant outside of the plan, whose last axis is the time of another plan.

    Parameters
    ----------
    plan : Trajectory
        The plan.
    interval : (float, float)
        First and last time [s], of the plan.
    own_time : (float, float)
        Time of the other plan at the first time, and its rate; with a law: at 0 of the law.
    times : sequence of float
        Further breakpoints, of the plan.
    law : Trajectory or None
        Time law of the plan.
    """

    what = "a part of a plan"
    plan: Trajectory
    own_time: tuple[float, float]
    law: Trajectory | None

    def __init__(
        self,
        plan: Trajectory,
        interval: tuple[float, float],
        own_time: tuple[float, float],
        times: Sequence[float] = (),
        law: Trajectory | None = None,
    ) -> None:
        first, last = interval
        inner = np.union1d(plan.breakpoints, times)
        inner = inner[(inner > first) & (inner < last)]
        self._set_fields(
            labels=(*plan.labels, "time of the given plan"),
            breakpoints=np.concatenate([[first], inner, [last]]),
            plan=plan,
            own_time=own_time,
            law=law,
        )

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        left, right = self.breakpoints[segment : segment + 2].tolist()
        jet = self.plan.segment_jet_at(0.5 * (left + right), left, s, order)
        first, rate = self.own_time
        if self.law is None:
            clock = np.zeros((order + 1, 1, s.size))
            clock[0] = first + rate * (left - self.start + s)
            clock[1:2] = rate
        else:
            clock = rate * self.law.segment_jet_at(0.5 * (left + right), left, s, order)
            clock[0] += first
        return np.concatenate([jet, clock], axis=1)


def window(
    plan: Trajectory,
    interval: tuple[float, float],
    own_time: tuple[float, float],
    times: Sequence[float] = (),
    law: Trajectory | None = None,
) -> Trajectory:
    """Part of a plan on an interval, with a further axis: the time of the given plan.

    Parameters
    ----------
    plan : Trajectory
        The plan; it is constant outside of its own interval.
    interval : (float, float)
        First and last time [s], of the plan.
    own_time : (float, float)
        Time of the given plan at the first time, and its rate; with a law: at 0 of the law.
    times : sequence of float, optional
        Further breakpoints.
    law : Trajectory, optional
        Time law of the plan, proportional to the time of the given plan; default: the time itself.
    """
    return _Window(plan, interval, own_time, times, law)


def mean_square(plan: Trajectory, function: Callable[[Array], Array], order: int) -> float:
    """Mean square of a function of the jet over a plan, to 1e-12.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    function : callable
        Maps a jet (order + 1, naxes, ntime) to (ntime,).
    order : int
        Highest derivative that `function` uses.

    Raises
    ------
    RuntimeError
        If the integral is not resolved by 2^14 cells of a segment.
    """
    total = 0.0
    nodes, weights = gauss(_NODES)
    for segment, (left, right) in enumerate(pairwise(plan.breakpoints.tolist())):
        before = math.nan
        for level in range(2, _LEVELS + 1):
            cells = np.arange(2**level)[:, None]
            s = (right - left) * (cells + nodes) / 2**level
            values = np.asarray(function(plan.segment_jet(segment, s.ravel(), order)), dtype=float)
            found = float((values.reshape(s.shape) ** 2 @ weights).mean())
            if abs(found - before) <= _TOLERANCE * found:
                break
            before = found
        else:
            raise RuntimeError(
                f"a mean square must be resolved by {2**_LEVELS} cells, got a relative change of "
                f"{abs(found - before) / found:.1g} between {left:g} and {right:g} s; the signal is noisy or not smooth"
            )
        total += (right - left) * found
    return total / plan.duration
