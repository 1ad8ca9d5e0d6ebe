"""Warning for plans that swing far beyond their waypoints."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from ctrlplan.trajectories.common import FACTORIALS, Array

MAXIMUM_SWING = 3.0
"""Range of a plan relative to that of its data above which a warning is issued.

Rest-to-rest moves and those of the paper stay below 1.4 up to alpha = 4; from
alpha = 4.5 on, and between many waypoints, one polynomial or trigonometric
spline swings by powers of ten.
"""


def warn_of_swing(values: Array, times: Array, table: Array, end: float, labels: Sequence[str], remedy: str) -> None:
    """Warn of the axis with the largest relative range, at the line of the caller's caller.

    Parameters
    ----------
    values : ndarray, shape (naxes, ntime)
        Positions of the plan on a grid that resolves it.
    times : ndarray, shape (nwaypoints,)
        Times of the waypoints [s].
    table : ndarray, shape (nwaypoints, order + 1, naxes)
        Their prescribed derivatives, nan where free.
    end : float
        End of the plan [s], which may lie beyond the last waypoint.
    labels : sequence of str
        Names of the axes.
    remedy : str
        Advice at the end of the message.
    """
    if within(values, table[:, 0].tolist()):
        return
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        plan = values.max(axis=1) - values.min(axis=1)
        low, high = _data_range(times, table, end)
        # If the range is only rounding of the positions, the ratio has no meaning.
        counts = plan > 1e-9 * np.abs(values).max(axis=1)
        swing = np.where(counts, plan / (high - low), 0.0)
    axis = int(swing.argmax())
    if swing[axis] > MAXIMUM_SWING:
        warnings.warn(
            f"the plan swings over {swing[axis]:.3g} times the range of its waypoints: {labels[axis]} from "
            f"{values[axis].min():.6g} to {values[axis].max():.6g}, where positions and derivatives of the waypoints "
            f"stay from {low[axis]:.6g} to {high[axis]:.6g}; {remedy}, or pass warn=False if this is intended",
            stacklevel=4,
        )


def within(values: Array, positions: Sequence[Sequence[float]]) -> bool:
    """Whether the ranges of a plan (naxes, ntime) exclude a swing by positions (nwaypoints, naxes) alone."""
    highest, lowest = np.maximum.reduce(values, axis=1).tolist(), np.minimum.reduce(values, axis=1).tolist()
    ranges = zip(highest, lowest, zip(*positions, strict=True), strict=True)
    return all([high - low <= MAXIMUM_SWING * (max(own) - min(own)) for high, low, own in ranges])


def _data_range(times: Array, table: Array, end: float) -> tuple[Array, Array]:
    """Minimum and maximum (naxes,) of positions and of the extrapolated derivatives over half a segment."""
    gaps = np.diff(times, append=max(end, float(times[-1])))
    if not gaps[-1]:
        gaps = gaps[:-1]
        reach = 0.5 * np.maximum(np.append(gaps, 0.0), np.append(0.0, gaps))
    else:  # a cyclic plan returns to the first waypoint
        reach = 0.5 * np.maximum(gaps, np.roll(gaps, 1))
    orders = np.arange(table.shape[1])
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.abs(np.nan_to_num(table)) * (reach[:, None] ** orders / FACTORIALS[orders])[:, :, None]
    away = size[:, 1:].sum(axis=1)
    known = ~np.isnan(table[:, 0])
    low = np.where(known, table[:, 0] - away, math.inf).min(axis=0)
    high = np.where(known, table[:, 0] + away, -math.inf).max(axis=0)
    free = np.where(known, 0.0, away).sum(axis=0)  # derivatives where the position is free
    return low - free, high + free
