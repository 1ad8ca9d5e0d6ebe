"""Peaks of the excess over limits along a plan, for durations near its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ctrlplan.planning.limits import Limited
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array, readonly

_SHARES = readonly(np.asarray(0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 25)), dtype=float))
"""Relative times in a segment at which peaks are searched."""

_WITHIN = 2e-3
"""Distance from the maximum excess within which another peak may be the maximum at a duration nearby."""

_FAR = 1e3
"""Distance from limits, in their scale, where none applies."""

_PARTS, _ROUNDS = 16, 3
"""Number of parts of an interval about a peak, and how often the parts next to the highest value are divided."""


def excess_at_peaks(plan: Trajectory, limited: Limited) -> Callable[[float], float]:
    """Maximum excess at the times of the highest peaks of a plan, as a function of a factor of its duration.

    Peaks are known to about 1e-9. For limits that are local in time.

    Parameters
    ----------
    plan : Trajectory
        The plan.
    limited : Limited
        The limits.

    Raises
    ------
    ValueError
        If the plan is infeasible for the plant; by the function as well.
    """
    bounds, segments, times = _peaks(plan, limited)
    jet, moments = plan.segments_jet(segments, times, limited.order), _moments(plan, limited, segments, times)
    powers = -np.arange(float(len(jet)))[:, None, None]
    chosen = [(limited.bounds[k], k, bounds == k) for k in np.unique(bounds).tolist()]

    def excess(factor: float) -> float:
        values = limited.values(jet * factor**powers)
        return max(float(bound.excess(values[k, own], moments[own]).max()) for bound, k, own in chosen)

    return excess


def _moments(plan: Trajectory, limited: Limited, segments: NDArray[np.intp], times: Array) -> Array:
    """Times (ntime,) [s] of the given plan; not evaluated for limits that do not depend on them."""
    return times if limited.is_constant else limited.moments(plan, plan.breakpoints[segments] + times)


def _peaks(plan: Trajectory, limited: Limited) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Limits and segments of the highest peaks, and times [s] since the starts of the segments, all (npeaks,)."""

    def excesses(segments: NDArray[np.intp], times: Array) -> Array:
        """Excess (nbounds, nrows, ntimes) at times (nrows, ntimes) in segments (nrows,)."""
        own = segments.repeat(times.shape[1])
        values = limited.values(plan.segments_jet(own, times.ravel(), limited.order))
        moments = _moments(plan, limited, own, times.ravel())
        rows = [bound.excess(row, moments) for bound, row in zip(limited.bounds, values, strict=True)]
        found: Array = np.maximum(rows, -_FAR).reshape(-1, *times.shape)
        return found

    times = np.diff(plan.breakpoints)[:, None] * _SHARES
    values = excesses(np.arange(len(times)), times)
    about = np.pad(values, ((0, 0), (0, 0), (1, 1)), constant_values=-np.inf)
    high = (values >= np.maximum(about[..., :-2], about[..., 2:])) & (values > values.max() - _WITHIN)
    bounds, segments, places = high.nonzero()
    first, last = np.maximum(places - 1, 0), np.minimum(places + 1, _SHARES.size - 1)
    left, right = times[segments, first], times[segments, last]
    peaks, vertices = np.arange(bounds.size), left
    for _ in range(_ROUNDS):
        inner = left[:, None] + (right - left)[:, None] * np.linspace(0.0, 1.0, _PARTS + 1)
        own = excesses(segments, inner)[bounds, peaks]
        k = np.clip(own.argmax(axis=1), 1, _PARTS - 1)
        left, right = inner[peaks, k - 1], inner[peaks, k + 1]
        below, here, above = (own[peaks, k + i] for i in (-1, 0, 1))
        curve = np.minimum(below - 2.0 * here + above, -np.finfo(float).tiny)
        with np.errstate(over="ignore"):
            move = np.clip(0.5 * (below - above) / curve, -1.0, 1.0)  # to the vertex of a parabola
        vertices = inner[peaks, k] + 0.5 * move * (right - left)
    return bounds, segments, vertices
