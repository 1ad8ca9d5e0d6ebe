"""What every module of this folder uses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FACTORIALS: Array = np.array([float(math.factorial(k)) for k in range(171)])
FACTORIALS.flags.writeable = False


def readonly(values: Array) -> Array:
    """Same array, which can no longer be written to."""
    values.flags.writeable = False
    return values


def times_powers(values: Array, base: float, orders: NDArray[np.integer[Any]]) -> Array:
    """Derivatives (order, ...) times powers of a time or rate: exact 0 stays 0, and nothing leaves floating point."""
    with np.errstate(all="ignore"):
        found = np.where(values == 0.0, 0.0, values * base**orders)
        size = np.abs(found)
        shrunk = (size < _TINY) & (np.abs(values) > 1e-290)  # what was nearly 0 may become it
        lost = (values != 0.0) & np.isfinite(values) & (shrunk | ~(size < np.inf))
    if lost.any():
        place = tuple(np.argwhere(lost)[0])
        raise ValueError(
            f"derivatives must stay within floating point, got {values[place]:g} times {base:g} to the power "
            f"{np.broadcast_to(orders, values.shape)[place]:g}; choose a time unit nearer to the plan's"
        )
    return found


def derivative_scale(duration: float, order: int) -> Array:
    """Factors (order + 1,) that make derivatives of Taylor coefficients in parts of a duration; inf beyond floats."""
    with np.errstate(over="ignore", divide="ignore", under="ignore"):
        scale: Array = FACTORIALS[: order + 1] / duration ** np.arange(order + 1)
    return scale


_TINY = float(np.finfo(float).tiny)


def mapped_time(time: float, origin: float, target: float, rate: float) -> float:
    """Time moved to target + (time - origin)/rate: exact at the origin."""
    return target + (time - origin) / rate
