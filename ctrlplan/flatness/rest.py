"""Plans at rest, where the heading of a vehicle is not determined."""

from __future__ import annotations

import numpy as np

from ctrlplan.trajectories import Clipped, PathPlan, Trajectory

AT_REST = 1e-6
"""Speed relative to the peak below which a quotient of derivatives is one of rounding errors."""

_NEAR = 1e-3
"""The same for the time at which a search ends near a singular point."""

ADVICE = "a plan of a vehicle that stops must be a ctrlplan.PathPlan"


def time_of_rest(plan: Trajectory, first: float, last: float) -> float | None:
    """Time between two others at which a plan is at rest; None if it moves."""
    for time in (first, last):
        if is_at_rest(plan, time, AT_REST):
            return time
    if not first < last:
        return None
    speed = Clipped(plan, first, last).extrema_of(lambda jet: np.hypot.reduce(jet[1]), 1)
    time = float(speed.time_min[0])
    return time if is_at_rest(plan, time, AT_REST) else None


def is_at_rest(plan: Trajectory, time: float, tolerance: float = _NEAR) -> bool:
    """Whether the speed at a time is below a fraction of the peak."""
    if not plan.start <= time <= plan.end or not plan.duration:
        return True
    limits = (False,) if time == plan.start else (False, True)  # from the left of the start it is at rest
    sides = [plan.jet(time, 1, left=left)[1] for left in limits]
    return bool(np.hypot.reduce(sides, axis=1).min() <= tolerance * np.hypot.reduce(plan.peak(1)))


def note_of_rest(plan: Trajectory, time: float) -> str:
    """End of a message about a plan that is not determined at a time: what to do if it is at rest there."""
    known = isinstance(plan, PathPlan) or not is_at_rest(plan, time)
    return "" if known else f"; the plan is at rest there, and {ADVICE}"
