"""Bernstein polynomials."""

from __future__ import annotations

import math

import numpy as np

from ctrlplan.trajectories.common import Array


def bernstein(u: Array, degree: int, nu: int = 0) -> Array:
    """Bernstein polynomials (npoints, degree + 1) on the unit interval, or their nu-th derivatives."""
    if nu:
        differences = np.eye(degree, degree + 1, 1) - np.eye(degree, degree + 1)
        return degree * (bernstein(u, degree - 1, nu - 1) @ differences)
    return np.stack([math.comb(degree, k) * u**k * (1.0 - u) ** (degree - k) for k in range(degree + 1)], axis=1)
