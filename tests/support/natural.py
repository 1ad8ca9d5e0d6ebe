"""A user's own spline: the natural cubic one of scipy, written as the docstring of `WaypointSpline` says."""

import numpy as np
from scipy.interpolate import CubicSpline

import ctrlplan as cp


class NaturalCubic(cp.WaypointSpline):
    """Natural cubic spline through positions, whose time is stretched by nothing but its waypoints."""

    options = ("weight",)

    weight: float
    _spline: CubicSpline

    def __init__(self, waypoints, *, labels=None, weight=1.0):
        points = tuple(waypoints)
        times = np.array([point.time for point in points])
        names = labels or points[0].labels or [f"y{i + 1}" for i in range(points[0].naxes)]
        spline = CubicSpline(times, weight * np.array([point.position for point in points]), bc_type="natural")
        self._set_fields(waypoints=points, labels=tuple(names), breakpoints=times, weight=float(weight), _spline=spline)

    def segment_jet(self, segment, s, order):
        """Derivatives of the cubic of a segment."""
        polynomials = [np.polynomial.Polynomial(c[::-1]) for c in self._spline.c[:, segment].T]
        rows = [[(p.deriv(k) if k else p)(s) + 0.0 * s for p in polynomials] for k in range(order + 1)]
        return np.array(rows)
