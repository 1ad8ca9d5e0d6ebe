"""The polynomial spline of equation (12)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Self

import numpy as np

from ctrlplan._types import Data
from ctrlplan.trajectories.newton_spline import NewtonSpline, SplineOptions, checked_degree
from ctrlplan.trajectories.piecewise_extrema import Places, Polynomials, stationary_places
from ctrlplan.trajectories.waypoint import Waypoint
from ctrlplan.trajectories.waypoint_spline import checked_waypoints

_MODERATE = 12
"""Number of coefficients up to which power series have enough digits for stationary points."""


class PolySpline(NewtonSpline):
    """Polynomial of minimum degree through waypoints.

    Equation (12) for any number of waypoints: the limit alpha = 0 of the
    trigonometric family, computed in the same Newton form.

    Parameters
    ----------
    waypoints : iterable of Waypoint
        Two or more, times increasing; the free entries may differ between axes.
    labels : sequence of str, optional
        Names of the axes.
    degree : int, optional
        Degree, at least the default, the number of constraints minus 1. The
        additional coefficients minimise the integral of the squared derivative
        of order `smooth`.
    smooth : int, optional
        Order of that derivative; default 3 (jerk).
    warn : bool, optional
        Whether to warn if the range of the plan on any axis exceeds 3 times that
        of its waypoints (their positions, and the extrapolation of their
        derivatives over half a segment).

    Raises
    ------
    ValueError
        If times do not increase, axes differ, the free entries make the system
        singular, or the degree is too low; if rounding could change the plan by
        more than 1e-6 of its range.

    Warns
    -----
    UserWarning
        If the plan swings far beyond its waypoints (`warn`).

    Examples
    --------
    The minimum-jerk move, whose peak velocity is 15/8:

    >>> plan = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
    >>> plan.degree, round(float(plan.peak(1)[0]), 12)
    ((5,), 1.875)
    """

    family = "polynomial"
    options = ("degree", "smooth")

    def __init__(
        self,
        waypoints: Iterable[Waypoint],
        *,
        labels: Sequence[str] | None = None,
        degree: int | None = None,
        smooth: int = 3,
        warn: bool = True,
    ) -> None:
        chosen = SplineOptions(labels, None, *checked_degree(degree, smooth), warn=warn)
        if not self._fit(checked_waypoints(waypoints), 0.0, chosen):
            self._check_swing()

    @property
    def polynomial_degree(self) -> int:
        """Maximum degree of the axes; as `Trajectory.polynomial_degree`."""
        return max(self.degree)

    def stationary_places(self, nu: int) -> Places | None:
        """Places of the stationary points at moderate degrees; as `Trajectory.stationary_places`."""
        if any(system.size > _MODERATE for _, system, _ in self._parts):
            return None
        groups = ([Polynomials(system, 0, coefficients[:, :, None])] for _, system, coefficients in self._parts)
        return stationary_places(groups, np.array([self._duration]), nu)

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        points = [Waypoint.from_dict(w) for w in data["waypoints"]]
        return cls(points, warn=False, **{k: data[k] for k in ("labels", "degree", "smooth") if k in data})._loaded()
