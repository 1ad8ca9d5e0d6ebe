"""Baselines of a planned reference: steps, motion profiles, polynomials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from itertools import pairwise

import numpy as np

from ctrlplan._types import Array
from ctrlplan.planning import optimize_waypoints
from ctrlplan.planning.limits import Limited
from ctrlplan.trajectories import (
    PiecewiseSpline,
    PolySpline,
    SCurve,
    Shaper,
    Step,
    Trajectory,
    Trapezoid,
    Waypoint,
)

_DEGREES = {1: "straight line", 3: "cubic", 5: "quintic", 7: "septic", 9: "nonic"}


def baseline_plans(
    waypoints: Sequence[Waypoint], limits: Mapping[str, object] | None = None, shaper: Shaper | None = None
) -> dict[str, Trajectory]:
    """Baselines of a trigonometric plan, through the same waypoints at the same times.

    Parameters
    ----------
    waypoints : sequence of Waypoint
        Two or more, all positions given.
    limits : mapping, optional
        Of velocity, acceleration and jerk, as for `fastest`: profiles are
        time-scaled copies of the fastest profiles under these limits.
    shaper : Shaper, optional
        Input shaper for step and S-curve, for a lightly damped mode.

    Returns
    -------
    dict of str to Trajectory
        step (to the final position at the start), trapezoid and S-curve (at
        rest at every waypoint), shaped step and shaped S-curve with a shaper,
        quintic per segment (or the degree that the waypoints imply), minimum
        jerk (through the positions); one plan for the last two if they are
        equal.
    """
    points = tuple(waypoints)
    spline = PiecewiseSpline(points)
    bounds = derivative_limits(spline, limits if limits is not None else peak_limits(PolySpline(points, warn=False)))
    plans: dict[str, Trajectory] = {
        "step": Step(spline.final, spline.initial, spline.start, spline.labels),
    }
    timed = profiles(points, spline.labels, bounds, shaper)
    shaped = {} if shaper is None else {"shaped step": shaper(plans["step"])}
    plans |= {name: timed.pop(name) for name in ("trapezoid", "S-curve")} | shaped | timed
    # With prescribed derivatives above the acceleration, minimum jerk would have no free parameter.
    ends = (0, len(points) - 1)
    freed = [point.truncated(2 if i in ends else 0) for i, point in enumerate(points)]
    jerk = optimize_waypoints(freed, 3, labels=spline.labels).plan
    degree = max(max(piece.degree) for piece in spline.segments)
    name = f"{_DEGREES.get(degree, f'degree {degree}')}{' per segment' if len(points) > 2 else ''}"
    if are_equal(jerk, spline):
        return plans | {f"{name} (minimum jerk)": spline}
    return plans | {name: spline, "minimum jerk": jerk}


def are_equal(one: Trajectory, other: Trajectory) -> bool:
    """Whether two plans have the same motion, to 1e-9 of its largest position."""
    if one.naxes != other.naxes or (one.start, one.end) != (other.start, other.end):
        return False
    t = np.linspace(one.start, one.end, 101)
    motions = [np.column_stack([plan.initial, plan.jet(t, 0)[0], plan.final]) for plan in (one, other)]
    return bool(np.abs(motions[0] - motions[1]).max() <= 1e-9 * np.abs(motions[1]).max())


def profiles(
    waypoints: Sequence[Waypoint],
    labels: tuple[str, ...],
    limits: Limits,
    shaper: Shaper | None = None,
    *,
    timed: bool = True,
) -> dict[str, Trajectory]:
    """Profiles at rest at every waypoint: trapezoid, S-curve, and shaped S-curve if the segments are long enough.

    Parameters
    ----------
    waypoints : sequence of Waypoint
        Two or more, all positions given.
    labels : tuple of str
        Labels of the axes.
    limits : tuple of ndarray
        Velocity, acceleration and jerk by axis; inf for no limit.
    shaper : Shaper, optional
        Input shaper for a lightly damped mode.
    timed : bool, optional
        Whether each segment has the duration between its waypoints; otherwise
        it is as fast as the limits allow.
    """
    found = {
        "trapezoid": _profile(waypoints, labels, Trapezoid, limits, timed),
        "S-curve": _profile(waypoints, labels, SCurve, limits, timed),
    }
    if shaper is not None and shaper.duration < 0.9 * np.diff([point.time for point in waypoints]).min():
        found["shaped S-curve"] = _profile(waypoints, labels, SCurve, limits, timed, shaper)
    return found


def smoother_polynomials(waypoints: Sequence[Waypoint]) -> dict[str, Trajectory]:
    """Polynomials with more zero derivatives at their ends than the waypoints prescribe.

    Parameters
    ----------
    waypoints : sequence of Waypoint
        Two or more, all positions given.

    Returns
    -------
    dict of str to Trajectory
        Between two waypoints at rest the septic (zero jerk at both ends) and
        the nonic (zero snap as well); through more waypoints, the plans of
        minimum snap and of minimum fifth derivative with these ends, of the
        same degrees per segment. Empty if an end is not at rest.
    """
    points = tuple(waypoints)
    ends = points[0], points[-1]
    if any(np.nan_to_num(point.jet[1:], nan=1.0).any() for point in ends):
        return {}
    found: dict[str, Trajectory] = {}
    for order, name in ((4, "septic"), (5, "nonic")):
        if max(len(point.jet) for point in ends) > order:
            continue
        first, last = (_at_rest(point, order) for point in ends)
        if len(points) == 2:
            found[name] = PolySpline([first, last])
        else:
            found[f"{name} per segment"] = optimize_waypoints([first, *points[1:-1], last], order).plan
    return found


def _at_rest(point: Waypoint, entries: int) -> Waypoint:
    """Waypoint with the same position and zero derivatives, `entries` values per axis."""
    zero = [0.0] * point.naxes
    return Waypoint.from_dict(point.to_dict() | {"jet": [point.position.tolist(), *[zero] * (entries - 1)]})


def peak_limits(plan: Trajectory) -> dict[str, float]:
    """Peak velocity, acceleration and jerk of a plan, by axis, as limits."""
    peaks = {order: plan.peak(order) for order in (1, 2, 3)}
    names = [[label, f"{label}_d1", f"{label}_d2", f"{label}_d3"] for label in plan.labels]
    return {
        names[axis][order]: float(peak)
        for order, values in peaks.items()
        for axis, peak in enumerate(values)
        if peak > 1e-9 * values.max()
    }


Limits = tuple[Array, Array, Array]
"""Velocity, acceleration and jerk by axis; inf for no limit."""


def derivative_limits(plan: Trajectory, limits: Mapping[str, object]) -> Limits:
    """Limits of velocity, acceleration and jerk by axis, from a mapping that may contain others."""
    found = np.full((3, plan.naxes), np.inf)
    known = {name: limit for name, limit in limits.items() if name in _names(plan)}
    for bound in Limited(plan, known).bounds if known else ():
        if bound.axis is not None and bound.is_constant and bound.order <= len(found):
            # If only one sign is permitted, the limit of that sign.
            sides = [side for side in (bound.high, -bound.low) if side > 0.0]
            before = found[bound.order - 1, bound.axis]
            found[bound.order - 1, bound.axis] = min(sides, default=before)
    return found[0], found[1], found[2]


def _names(plan: Trajectory) -> set[str]:
    return {"velocity", "acceleration", "jerk"} | {f"{label}_d{k}" for label in plan.labels for k in (1, 2, 3)}


def _profile(
    points: Sequence[Waypoint],
    labels: tuple[str, ...],
    kind: Callable[..., Trajectory],
    limits: Limits,
    timed: bool,
    shaper: Shaper | None = None,
) -> Trajectory:
    """Profiles from rest to rest in sequence, each with the duration of its segment or as fast as possible."""
    parts: list[Trajectory] = []
    for first, last in pairwise(points):
        duration, distance = last.time - first.time, np.abs(last.position - first.position)
        if not distance.any():
            parts.append(PolySpline([Waypoint(p.time, p.position, 0, 0) for p in (first, last)], labels=labels))
            continue
        distance = np.maximum(distance, 1e-9 * distance.max())
        # Without a limit: the value of a move in three phases of equal duration.
        velocity, acceleration, jerk = (
            np.where(np.isfinite(limit), limit, usual * distance / duration**order)
            for order, usual, limit in zip((1, 2, 3), (1.5, 4.5, 27.0), limits, strict=True)
        )
        more = {"jerk": jerk} if kind is SCurve else {}
        part: Trajectory = kind(
            last.position,
            first.position,
            velocity=velocity,
            acceleration=acceleration,
            time=first.time,
            labels=labels,
            **more,
        )
        if shaper is not None:
            part = shaper(part.retime(duration - shaper.duration) if timed else part)
        elif timed:
            part = part.retime(duration)
        parts.append(part)
    return reduce(lambda one, other: one.then(other), parts)
