"""The crane's rope as `planning.clearance` evaluates it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctrlplan._types import Array
from ctrlplan.systems.plants.crane.parameters import CraneParameters
from ctrlplan.trajectories import Trajectory


def rope(crane: CraneParameters) -> CraneRope:
    """Rope of this crane, from the load up to the drum, for `ctrlplan.clearance`."""
    return CraneRope(crane.drum_radius, crane.gravity)


@dataclass(frozen=True)
class CraneRope:
    """Straight rope from the load to the point where it leaves the drum.

    Attributes
    ----------
    drum_radius : float
        b [m].
    gravity : float
        g [m/s^2].
    order : int
        Highest derivative of the load that is read: 2.
    """

    drum_radius: float
    gravity: float
    order: ClassVar[int] = 2

    def top(self, jet: Array) -> Array:
        """Point (D + b cos theta, -b sin theta) at which the rope leaves the drum.

        Parameters
        ----------
        jet : ndarray, shape (order + 1, 2, ...)
            Derivatives of x and z, to order 2 at least.

        Returns
        -------
        ndarray, shape (2, ...)

        Raises
        ------
        ValueError
            If g - z'' is not above 0 somewhere: the rope cannot push.
        """
        across, hanging = jet[2, 0], self.gravity - jet[2, 1]
        if not np.min(hanging, initial=np.inf) > 0.0:
            raise ValueError(f"g - z'' must be above 0 for a taut rope, got {np.min(hanging):.4g} m/s^2")
        lean = across / np.hypot(across, hanging)
        over = jet[0, 0] + across / hanging * (jet[0, 1] - self.drum_radius * lean)
        return np.stack([over, self.drum_radius * lean])

    def slopes(self, plan: Trajectory) -> Array:
        """Bounds of |d top/d entry| over the jets of a plan.

        Parameters
        ----------
        plan : Trajectory
            Plan of x and z.

        Returns
        -------
        ndarray, shape (3, 2)
            Row nu, column axis: of the nu-th derivative of that axis.

        Raises
        ------
        ValueError
            If g - z'' is not above 0 over the whole plan.
        """
        b, fall = self.drum_radius, plan.extrema(2)
        low = self.gravity - float(fall.maximum[1])
        if not low > 0.0:
            raise ValueError(
                f"g - z'' must be above 0 for a taut rope, got {low:.4g} m/s^2 "
                f"at {fall.time_max[1]:.4g} s (tension T <= 0)"
            )
        depth, across = float(plan.peak()[1]), float(max(-fall.minimum[0], fall.maximum[0]))
        lean = across / math.hypot(across, low)
        # With h = g - z'': top = (x + z x''/h - b x''^2/(h S), b x''/S), term by term.
        return np.array(
            [
                [1.0, across / low],
                [0.0, 0.0],
                [
                    math.hypot((depth + 2.0 * b * lean) / low, b / low),
                    math.hypot(across * (depth + 2.0 * b * lean) / low**2, b * lean / low),
                ],
            ]
        )
