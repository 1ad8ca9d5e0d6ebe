"""Stops of a plan, and changes to a constant velocity, in minimum time."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_kind, checked_finite, checked_vector
from ctrlplan._display import time_text
from ctrlplan._renamed import outside_stacklevel
from ctrlplan.planning.bounds import Bound
from ctrlplan.planning.naming import Naming
from ctrlplan.planning.path_stop import stopped_on_path
from ctrlplan.trajectories import Clipped, Joined, MotionProfile, Step, Trajectory
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.motion_profile import profile_of_phases
from ctrlplan.trajectories.repeated import covering
from ctrlplan.trajectories.velocity_change import velocity_changes
from ctrlplan.trajectories.waypoint import ENTRIES

Synchronize = Literal["time", "path"]
"""Relation of the axes during a stop."""

_EXCESS, _UNRESOLVED = 1e-9, 1e-6
"""Excess over a limit, as a fraction of its scale, that is reported; of a jerk by the rounding of times."""

_ROUNDING = 1e-13
"""Velocities and accelerations below this fraction of those of the plan are rounding errors."""


class StopLimits(NamedTuple):
    """Limits of a stop, by axis.

    Attributes
    ----------
    acceleration : ndarray, shape (naxes, 2)
        Minimum, below 0, and maximum, above 0.
    jerk : ndarray, shape (naxes,)
        Maximum magnitude.
    bounds : tuple of Bound
        All limits, including those of positions and velocities.
    """

    acceleration: Array
    jerk: Array
    bounds: tuple[Bound, ...]


def stopped(
    plan: Trajectory, time: float, limits: Mapping[str, object], synchronize: Synchronize | None = "time"
) -> Trajectory:
    """Plan that is stopped; as `Trajectory.stop`."""
    if synchronize not in (*get_args(Synchronize), None):
        raise ValueError(f'synchronize must be "time", "path" or None, got {synchronize!r}')
    moment = checked_moment(plan, time)
    plan = covering(plan, moment)
    within = stop_limits(plan, limits)
    state = state_at(plan, moment)
    if not state[1:].any():
        return _until(plan, moment)
    if synchronize == "path":
        tail: Trajectory | None = stopped_on_path(plan, moment, within.bounds)
    else:
        rest = np.zeros_like(state)
        tail = _changed(moment, state, rest, within, synchronize == "time", plan.labels)
    return _followed(plan, moment, tail, within)


def at_velocity(
    plan: Trajectory,
    time: float,
    velocity: ArrayLike,
    limits: Mapping[str, object],
    hold: float = 0.0,
    synchronize: Synchronize | None = "time",
) -> Trajectory:
    """Plan that changes to a constant velocity; as `Trajectory.to_velocity`."""
    if synchronize not in ("time", None):
        raise ValueError(f'synchronize must be "time" or None for a change to a velocity, got {synchronize!r}')
    moment = checked_moment(plan, time)
    plan = covering(plan, moment)
    within = stop_limits(plan, limits)
    state, final = state_at(plan, moment), np.zeros((3, plan.naxes))
    final[1] = checked_vector(velocity, "velocity", plan.naxes)
    held = checked_finite(hold, "hold", minimum=0.0)
    for bound in within.bounds:
        if bound.order == 1 and bound.axis is not None and bound.excess(final[1, bound.axis, None])[0] > 1e-12:
            raise ValueError(
                f"velocity must satisfy the limits, got {final[1, bound.axis]:g} of {plan.labels[bound.axis]}, where "
                f"{bound.name} must be {bound.range}"
            )
    tail = _changed(moment, state, final, within, synchronize == "time", plan.labels, held)
    return _followed(plan, moment, tail, within)


def checked_moment(plan: Trajectory, time: float) -> float:
    """Time within a plan that has a duration."""
    if not plan.duration:
        raise ValueError(f"plan must have a duration to be stopped, got a step at {time_text(plan.start)} s")
    moment = checked_finite(time, "time")
    if not plan.start <= moment <= plan.end:
        when = "before its start" if moment < plan.start else "after its end"
        raise ValueError(
            f"time must lie within the plan, from {plan.start:.9g} s to {plan.end:.9g} s, got {moment:.9g} s, {when}, "
            "where it is at rest"
        )
    return moment


def stop_limits(plan: Trajectory, limits: Mapping[str, object]) -> StopLimits:
    """Limits of a stop, checked.

    Parameters
    ----------
    plan : Trajectory
        Plan with these axes.
    limits : mapping
        Limits on derivatives, as for `fastest`: acceleration and jerk of every axis,
        and optionally velocities and positions.

    Raises
    ------
    ValueError
        If a limit is missing or of another kind.
    """
    check_kind(limits, "limits", Mapping, "a mapping of names to limits")
    bounds = tuple(Naming(plan).bounds(limits))
    acceleration = np.full((plan.naxes, 2), np.nan)
    jerk = np.full(plan.naxes, np.nan)
    for bound in bounds:
        axis = bound.axis
        if axis is None or bound.kind != "value" or not bound.is_constant:
            raise ValueError(
                f"limits of a stop must be constant ones of acceleration and jerk, velocity or position, got "
                f"{bound.name} {bound.range}"
            )
        if bound.order > 3:
            raise ValueError(
                f"limits must be those of position, velocity, acceleration and jerk, got {bound.name}, which is "
                "infinite where the jerk jumps"
            )
        if bound.order == 2:
            if not bound.low < 0.0 < bound.high:
                raise ValueError(f"limits of {bound.name} must be below and above 0, got {bound.range}")
            # Of several limits of an axis all apply.
            acceleration[axis] = np.fmax(acceleration[axis, 0], bound.low), np.fmin(acceleration[axis, 1], bound.high)
        if bound.order == 3:
            if bound.low != -bound.high:
                raise ValueError(f"limits of {bound.name} must be one number, its maximum magnitude, got {bound.range}")
            jerk[axis] = np.fmin(jerk[axis], bound.high)
    for name, rows in (("acceleration", acceleration[:, 0]), ("jerk", jerk)):
        for label, value in zip(plan.labels, rows.tolist(), strict=True):
            if math.isnan(value):
                own = f"{label}_d{ENTRIES.index(name)}"
                raise ValueError(
                    f"limits must contain acceleration and jerk, got no {name} of {label}; add {name!r} for all axes, "
                    f"or {own!r}"
                )
    return StopLimits(acceleration, jerk, bounds)


def state_at(plan: Trajectory, time: float) -> Array:
    """Position, velocity and acceleration (3, naxes) with which a plan arrives at a time.

    The limits from the left, since a jump at that time is not part of the plan
    before it; at the start the plan's own state if it starts in motion. Values of
    the size of rounding errors, and accelerations where the plan comes to rest, are 0.
    """
    state = plan.jet(time, 2, left=True)
    after = plan.jet(time, 2)
    if time == plan.start and after[1].any():
        state = after
    if time == plan.end:
        after[1:] = 0.0
    inside = plan.jet(np.linspace(plan.start, plan.end, 130), 2)
    size = np.maximum(np.abs(inside).max(axis=2), np.abs(plan.jet(plan.breakpoints, 2, left=True)).max(axis=2))
    small = _ROUNDING * size[1:]
    state[1:][np.abs(state[1:]) <= small] = 0.0
    if not state[1].any() and (np.abs(after[1:]) <= small).all():
        state[2] = 0.0
    return state


def _changed(
    time: float,
    state: Array,
    final: Array,
    limits: StopLimits,
    together: bool,
    labels: tuple[str, ...],
    hold: float = 0.0,
) -> MotionProfile | None:
    """Motion of all axes to constant velocities in minimum time.

    Parameters
    ----------
    time : float
        Start [s].
    state, final : ndarray, shape (3, naxes)
        State at the start; velocities at the end, with any position.
    limits : StopLimits
        Limits of acceleration and jerk.
    together : bool
        Whether all axes reach their final velocity at the same time, that of the
        slowest one.
    labels : tuple of str
        Names of the axes.
    hold : float, optional
        Time [s] for which the final velocity is held.

    Returns
    -------
    MotionProfile or None
        None if its duration is 0.
    """
    own = velocity_changes(final[1] - state[1], state[2], limits.acceleration, limits.jerk, together=together)
    longest = max(change.duration for change in own)
    # All end together, each with zero jerk after its own change.
    phases = [([*c.durations, longest - c.duration + hold], [*c.jerks, 0.0]) for c in own]
    free = final.copy()
    free[0] = np.nan
    return profile_of_phases(time, phases, state, free, labels)


def _until(plan: Trajectory, time: float) -> Trajectory:
    """Plan up to a time."""
    if time == plan.start:
        return Step(plan.initial, plan.initial, time, plan.labels)
    if time == plan.end and (plan.final == plan.jet(time, 0, left=True)[0]).all():
        return plan
    return Clipped(plan, plan.start, time)


def _followed(plan: Trajectory, time: float, tail: Trajectory | None, limits: StopLimits) -> Trajectory:
    """Plan up to a time, then another one; warns of limits that it exceeds."""
    if tail is None:
        return _until(plan, time)
    for text in _excesses(tail, limits.bounds):
        warnings.warn(text, stacklevel=outside_stacklevel())
    if time == plan.start:
        return tail
    return Joined.without_shift([Clipped(plan, plan.start, time), tail])


def _excesses(tail: Trajectory, bounds: tuple[Bound, ...]) -> Iterator[str]:
    """Descriptions of the limits that a motion exceeds."""
    extrema = {order: tail.extrema(order) for order in {bound.order for bound in bounds}}
    for bound in bounds:
        found, axis = extrema[bound.order], bound.axis
        sides = [
            (float(values[axis]), float(times[axis]))
            for values, times in ((found.minimum, found.time_min), (found.maximum, found.time_max))
        ]
        value, time = max(sides, key=lambda side: float(bound.excess(np.array([side[0]]))[0]))
        rounded = isinstance(tail, MotionProfile) and (
            bound.order == 3 or (bound.order == 2 and value != tail.start_state[2, axis])
        )
        if bound.excess(np.array([value]))[0] > (_UNRESOLVED if rounded else _EXCESS):
            limit = bound.high if value > bound.high else bound.low
            reason = f"from the state at {time_text(tail.start)} s this is unavoidable"
            if rounded:
                reason = "floating-point times do not resolve its phases; use a time origin nearer to the plan"
            yield (
                f"the limits of the stop are exceeded: {bound.name} must be {bound.range}, got {value:.6g} at "
                f"{time_text(time)} s, {abs(value - limit):.3g} beyond; {reason}"
            )
