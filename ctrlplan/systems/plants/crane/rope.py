"""Rope of the crane, for `ctrlplan.clearance`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctrlplan._types import Array
from ctrlplan.systems.plants.crane.parameters import CraneParameters
from ctrlplan.trajectories import Trajectory


def rope(crane: CraneParameters) -> CraneRope:
    """Rope from the load to the drum, for `ctrlplan.clearance`."""
    return CraneRope(crane.drum_radius, crane.gravity)


def check_taut(hanging: Array | float, place: str = "") -> None:
    """Raise unless g - z'' [m/s^2] is positive: the rope cannot push."""
    lowest = float(np.min(hanging, initial=np.inf))
    if not lowest > 0.0:
        raise ValueError(f"g - z'' must be above 0 for a taut rope, got {lowest:.4g} m/s^2{place}")


def check_below(lengths: Array | float, place: str = "") -> None:
    """Raise unless the rope length R [m] is positive: the load hangs below the trolley."""
    shortest = float(np.min(lengths, initial=np.inf))
    if not shortest > 0.0:
        raise ValueError(
            f"the rope length R must be above 0, got {shortest:.4g} m{place}: z points down, and the load must stay "
            "below the trolley"
        )


@dataclass(frozen=True)
class CraneRope:
    """Straight rope from the load to its point of tangency at the drum.

    Attributes
    ----------
    drum_radius : float
        b [m].
    gravity : float
        g [m/s^2].
    order : int
        Highest derivative of the load that is used: 2.
    """

    drum_radius: float
    gravity: float
    order: ClassVar[int] = 2

    def top(self, jet: Array) -> Array:
        """Point of tangency (D + b cos theta, -b sin theta) at the drum.

        Parameters
        ----------
        jet : ndarray, shape (order + 1, 2, ...)
            Derivatives of x and z, at least up to order 2.

        Returns
        -------
        ndarray, shape (2, ...)

        Raises
        ------
        ValueError
            If g - z'' is not above 0 somewhere: the rope cannot push.
        """
        across, hanging = jet[2, 0], self.gravity - jet[2, 1]
        check_taut(hanging)
        lean = across / np.hypot(across, hanging)
        over = jet[0, 0] + across / hanging * (jet[0, 1] - self.drum_radius * lean)
        return np.stack([over, self.drum_radius * lean])

    def slopes(self, plan: Trajectory) -> Array:
        """Bounds of the partial derivatives of `top` over a plan.

        Parameters
        ----------
        plan : Trajectory
            Plan of x and z.

        Returns
        -------
        ndarray, shape (3, 2)
            Entry (nu, axis): with respect to the nu-th derivative of that axis.

        Raises
        ------
        ValueError
            If g - z'' is not above 0 over the whole plan.
        """
        b, fall = self.drum_radius, plan.extrema(2)
        low = self.gravity - float(fall.maximum[1])
        check_taut(low, f" at {fall.time_max[1]:.4g} s (tension T <= 0)")
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
