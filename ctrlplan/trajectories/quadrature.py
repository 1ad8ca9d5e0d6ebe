"""Gauss-Legendre rules."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ctrlplan.trajectories.common import Array, readonly


@lru_cache(maxsize=256)
def gauss(count: int) -> tuple[Array, Array]:
    """Nodes and weights of the Gauss-Legendre rule on [0, 1], exact to degree 2 count - 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return readonly(0.5 * (nodes + 1.0)), readonly(0.5 * weights)
