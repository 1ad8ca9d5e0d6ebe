"""What planning chooses for a trajectory: its shape parameter, its duration in cycles, its stop under limits.

The only module of this folder that imports from a later step, where planning is required.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_finite, one_number
from ctrlplan._display import time_text
from ctrlplan.trajectories.combined import Joined
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.cycle import knots_of, moved
from ctrlplan.trajectories.repeated import Repeated
from ctrlplan.trajectories.trajectory import Trajectory
from ctrlplan.trajectories.waypoint import Waypoint
from ctrlplan.trajectories.waypoint_spline import WaypointSpline


def chosen_alpha(
    alpha: float | Literal["auto"], points: tuple[Waypoint, ...], family: Callable[..., Any], **options: Any
) -> float:
    """Shape parameter in [0, 2 pi); "auto" is that of the shortest path."""
    if not isinstance(alpha, str):
        return checked_alpha(alpha)
    if alpha != "auto":
        raise ValueError(f'alpha must lie in [0, 2 pi) or be "auto", got {alpha!r}')
    from ctrlplan.planning.alpha import choose_alpha

    return choose_alpha(points, family=family, warn=False, **options).alpha


def checked_alpha(alpha: float | str) -> float:
    """Shape parameter in [0, 2 pi)."""
    if isinstance(alpha, str):
        raise ValueError(f"alpha must be a number in [0, 2 pi) here, got {alpha!r}")
    value = one_number(alpha, "alpha", "a number in [0, 2 pi)")
    if not 0.0 <= value < 2.0 * math.pi:
        raise ValueError(f"alpha must lie in [0, 2 pi), got {value}")
    return value


def on_cycle(plan: Trajectory, dt: float, limits: Mapping[str, object] | None = None) -> Trajectory:
    """Plan whose duration and waypoints are on a cycle; as `Trajectory.on_cycle`."""
    dt = checked_finite(dt, "dt", above=0.0)
    if isinstance(plan, Joined) and not _joined_in_motion(plan):
        parts: list[Trajectory] = []
        for k, part in enumerate(plan.parts):
            try:
                parts.append(on_cycle(part, dt, limits))
            except ValueError as error:
                raise ValueError(f"parts[{k}] of a joined plan: {error}") from None
        same = all(part is before for part, before in zip(parts, plan.parts, strict=True))
        return plan if same else Joined(parts)
    if isinstance(plan, Repeated):
        return _repeated_on_cycle(plan, dt, limits)
    if not plan.duration:
        return plan
    knots = knots_of(plan)
    rounding = 4.0 * np.spacing(np.abs(knots).max()) / dt
    counts = np.ceil(np.diff(knots) / dt * (1.0 - 4.0 * np.finfo(float).eps) - rounding).clip(min=1.0)
    if counts.sum() > 2.0**53:
        raise ValueError(f"dt must divide the plan into fewer than 2^53 cycles, got {dt:g} s in {plan.duration:g} s")
    if limits is None:
        return moved(plan, dt, counts)
    from ctrlplan.planning.cycle import lengthened

    return lengthened(plan, dt, counts, limits)


def _repeated_on_cycle(plan: Repeated, dt: float, limits: Mapping[str, object] | None) -> Trajectory:
    """The same with the period on a cycle."""
    if plan.since != plan.start:
        raise ValueError(
            f"a plan must be put on the cycle before it repeats, got one that repeats from {plan.since:g} s on after "
            f"its start at {time_text(plan.start)} s"
        )
    period = on_cycle(plan.plan, dt, limits)
    return plan if period is plan.plan else Repeated(period, plan.count)


def _joined_in_motion(plan: Joined) -> bool:
    """Whether parts join in motion of which one has no waypoints: retimed apart, their velocities would differ."""
    for before, after in pairwise(plan.parts):
        if not (isinstance(before, WaypointSpline) and isinstance(after, WaypointSpline)) and before.duration:
            velocity = before.jet(before.end, 1, left=True)[1]
            if (np.abs(velocity) > 1e-9 * before.peak(1)).any():
                return True
    return False


def stopped(plan: Trajectory, time: float, limits: Mapping[str, object], synchronize: Any) -> Trajectory:
    """Plan until a time, then to rest; as `Trajectory.stop`."""
    from ctrlplan.planning import stop

    return stop.stopped(plan, time, limits, synchronize)


def at_velocity(
    plan: Trajectory, time: float, velocity: ArrayLike, limits: Mapping[str, object], hold: float, synchronize: Any
) -> Trajectory:
    """Plan until a time, then to a constant velocity; as `Trajectory.to_velocity`."""
    from ctrlplan.planning import stop

    return stop.at_velocity(plan, time, velocity, limits, hold, synchronize)


def stop_limits(plan: Trajectory, limits: Mapping[str, object]) -> tuple[Array, Array]:
    """Limits of acceleration (naxes, 2) and jerk (naxes,) of a stop, without others; a plan may be a step."""
    from ctrlplan.planning import stop

    found = stop.stop_limits(plan, limits)
    for bound in found.bounds:
        if bound.order < 2:
            raise ValueError(
                f"stop_limits must be those of acceleration and jerk, got {bound.name}: during a stop neither position "
                "nor velocity can be limited"
            )
    return found.acceleration, found.jerk
