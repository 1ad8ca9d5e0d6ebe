"""Plans whose segments last a whole number of cycles of a drive."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ctrlplan.trajectories.combined import is_shaped
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.trajectory import Trajectory
from ctrlplan.trajectories.waypoint import Waypoint
from ctrlplan.trajectories.waypoint_spline import WaypointSpline


def knots_of(plan: Trajectory) -> Array:
    """Times (nsegments + 1,) between which the duration of a plan can be chosen."""
    if isinstance(plan, WaypointSpline):
        return np.unique([*(w.time for w in plan.waypoints), plan.end])
    return np.unique([plan.start, plan.end])


def moved(plan: Trajectory, dt: float, counts: Array) -> Trajectory:
    """Plan whose segments last so many cycles; the same object if they do already."""
    times = plan.start + dt * np.concatenate([[0.0], np.cumsum(counts)])
    near = 4.0 * np.spacing(np.abs(times).max())
    if np.abs(times - knots_of(plan)).max() > near:
        if isinstance(plan, WaypointSpline):
            if plan.waypoints[-1].time < plan.end:  # one period of a cyclic plan
                plan = plan.retime(times[-1] - plan.start)
            pairs = zip(plan.waypoints, times.tolist(), strict=False)
            plan = plan.through(Waypoint.from_array(t, w.jet, w.labels) for w, t in pairs)
        else:
            plan = plan.retime(times[-1] - plan.start)
    for time in () if is_shaped(plan) else _inner_times(plan):
        cycles = (time - plan.start) / dt
        if abs(cycles - round(cycles)) * dt > 2.0 * near:
            raise ValueError(
                f"waypoints of a {type(plan).__name__} must be on the cycle after its duration is rounded up, got one "
                f"at {time:.9g} s, {cycles:.6g} cycles of {dt:g} s after the start; put its parts on the cycle first"
            )
    return plan


def _inner_times(plan: Trajectory) -> Iterator[float]:
    """Times of the waypoints of a plan and of its parts."""
    yield from (w.time for w in plan.waypoints)
    for part in getattr(plan, "parts", ()):
        yield from _inner_times(part)
