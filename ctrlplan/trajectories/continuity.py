"""Jumps of the derivatives of a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ctrlplan.trajectories.trajectory import Trajectory


@dataclass(frozen=True)
class Jump:
    """One jump of one derivative of one axis.

    Attributes
    ----------
    order : int
        Order of the derivative, 0 the position.
    time : float
        Time of the jump [s].
    label : str
        Name of the axis.
    size : float
        Value after the jump minus value before.
    """

    order: int
    time: float
    label: str
    size: float


def find_jumps(plan: Trajectory, order: int) -> tuple[Jump, ...]:
    """Jumps of the derivatives up to an order, lowest order first, then in time.

    The plan is at rest before its start and after its end: a plan that starts
    at nonzero velocity jumps there. Differences below 1e-9 of a derivative's peak, or of the
    range of the position, are rounding.
    """
    before = plan.jet(plan.breakpoints, order, left=True)
    after = plan.jet(plan.breakpoints, order)
    after[:, :, -1] = 0.0
    after[0, :, -1] = plan.final
    size = after - before
    position, eps = plan.extrema(), float(np.finfo(float).eps)
    # Relative to the range: a distant origin of the positions hides no jump.
    farthest = np.maximum(np.abs(position.minimum), np.abs(position.maximum))
    slack = [1e-9 * (position.maximum - position.minimum) + 8.0 * eps * farthest]
    slack += [1e-9 * plan.peak(k) for k in range(1, order + 1)]
    found = np.argwhere(np.abs(size) > np.maximum(slack, np.finfo(float).tiny)[:, :, None])
    return tuple(
        Jump(int(k), float(plan.breakpoints[i]), plan.labels[a], float(size[k, a, i]))
        for k, a, i in sorted(found.tolist(), key=lambda entry: (entry[0], entry[2], entry[1]))
    )
