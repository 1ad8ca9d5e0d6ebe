"""Segments lengthened by cycles of a drive until limits are satisfied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ctrlplan.planning.bounds import Bound
from ctrlplan.planning.limits import Limited
from ctrlplan.trajectories import Trajectory, Waypoint, WaypointSpline
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.cycle import knots_of, moved
from ctrlplan.trajectories.extrema import stationary_times

_TOLERANCE = 1e-9
"""Excess over a limit, as a fraction of its scale, that counts as none."""

_STEPS = 100
"""Number of times that segments are lengthened."""


def lengthened(plan: Trajectory, dt: float, counts: Array, limits: Mapping[str, object]) -> Trajectory:
    """Plan whose segments are lengthened by cycles until the limits are satisfied.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    dt : float
        Cycle time [s].
    counts : ndarray, shape (nsegments,)
        Minimum number of cycles of each segment.
    limits : mapping
        Limits on derivatives, as for `fastest`.

    Raises
    ------
    ValueError
        If a waypoint prescribes a value beyond a limit, or no duration of a segment
        satisfies the limits.
    """
    limited = Limited(plan, limits)
    limited.check_constant("limits of a plan on a cycle")
    limited.check_smooth(plan)
    bounds = limited.bounds
    _check_waypoints(plan.waypoints, bounds)
    quiet = plan.quiet() if isinstance(plan, WaypointSpline) else plan
    orders = np.array([max(bound.order, 1) for bound in bounds])
    for step in range(_STEPS):
        tried = moved(quiet, dt, counts)
        excess = _excess(tried, bounds)
        violated = (excess > _TOLERANCE).any(axis=0)
        if not violated.any():
            return moved(plan, dt, counts)
        # A derivative of order k is divided by the k-th power of a ratio of durations.
        ratio = ((1.0 + excess.clip(min=0.0)) ** (1.0 / orders[:, None])).max(axis=0)
        ratio = ratio.clip(max=4.0) if step < _STEPS // 2 else ratio.clip(min=1.25)
        counts = np.where(violated, np.maximum(counts + 1.0, np.floor(counts * ratio)), counts)
        if counts.sum() > 2.0**53:
            break
    row, segment = divmod(int(excess.argmax()), counts.size)
    knots = knots_of(tried)
    where = f"segment {segment}"
    if isinstance(plan, WaypointSpline) and segment + 1 < len(plan.waypoints):
        where += f", from waypoints[{segment}] to waypoints[{segment + 1}],"
    raise ValueError(
        f"{where} must keep {bounds[row].name} {bounds[row].range}, got a relative excess of "
        f"{excess[row, segment]:.3g} with a duration of {knots[segment + 1] - knots[segment]:.4g} s; no number of "
        f"cycles of {dt:g} s was found that satisfies the limits"
    )


def _check_waypoints(waypoints: Sequence[Waypoint], bounds: Sequence[Bound]) -> None:
    """Raise for a derivative that a waypoint prescribes beyond a limit."""
    for i, point in enumerate(waypoints):
        for bound in bounds:
            value = point.jet[bound.order : bound.order + 1, bound.axis]  # empty or nan if free
            if (bound.excess(value) > _TOLERANCE).any():
                raise ValueError(
                    f"{bound.name} must stay {bound.range}, got {value.item():g}, which waypoints[{i}] prescribes at "
                    f"{point.time:g} s; no number of cycles changes it"
                )


def _excess(plan: Trajectory, bounds: Sequence[Bound]) -> Array:
    """Largest excess (nbounds, nsegments) over each limit between knots, as a fraction of its scale."""
    knots = knots_of(plan)
    found = np.full((len(bounds), knots.size - 1), -np.inf)
    for segment, (left, right) in enumerate(zip(plan.breakpoints[:-1], plan.breakpoints[1:], strict=True)):

        def jet(s: Array, order: int, segment: int = segment) -> Array:
            return plan.segment_jet(segment, s, order)

        edges = (knots - left).clip(0.0, right - left)
        for order in {bound.order for bound in bounds}:
            s = np.union1d(stationary_times(jet, float(right - left), order), edges)
            values = jet(s, order)[order]
            for row, bound in enumerate(bounds):
                if bound.order != order:
                    continue
                excess = bound.excess(values[bound.axis])
                for k in np.flatnonzero(edges[1:] > edges[:-1]):
                    own = excess[(s >= edges[k]) & (s <= edges[k + 1])].max()
                    found[row, k] = max(found[row, k], own)
    return found
