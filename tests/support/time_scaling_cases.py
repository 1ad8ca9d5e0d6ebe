"""Plans and loops behind a time scaling that several files use."""

import math

from numpy.polynomial import Polynomial

import ctrlplan as cp

METHODS = ("compiled", "python")
RISE = Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
"""From 0 to 1 on [0, 1], at rest at both ends up to the fourth derivative."""


def rest(*points, order=4, labels=None):
    """From rest to rest through positions, or jets."""
    return cp.PolySpline([cp.Waypoint(t, p, *[0.0] * order) for t, p in points], labels=labels)


ONE = rest((0, 0), (1, 1), labels=["x"])
INF = math.inf
