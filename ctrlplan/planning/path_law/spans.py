"""Division of a plan into spans between stops, corners and waypoints, and of spans into cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.continuity import constant_axes

_STILL = 1e-9
"""Velocity below which a plan is at rest, relative to its peak."""

_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Duration of a segment, relative to the times of the plan, that is rounding."""

_ANGLE = 1e-6
"""Difference of directions on both sides of a stop that is rounding."""

_NEAR = 0.01
"""Distance from the end of a span at which its velocity is compared with that at twice the distance."""


Rates = tuple[float | None, float | None]
"""Squared rates at both ends of a part, relative to those of the plan; None for free ones."""


@dataclass(frozen=True)
class Span:
    """Part of a plan that is analytic.

    Attributes
    ----------
    segment : int
        Segment of the plan.
    start, end : float
        Times [s] since the start of the segment.
    moves : bool
        Whether the plan moves; otherwise it dwells.
    rests : (float, float)
        Power of the distance from each end with which the velocity increases from
        there; 0 where it is not 0.
    """

    segment: int
    start: float
    end: float
    moves: bool
    rests: tuple[float, float]

    @property
    def length(self) -> float:
        """Duration [s] in the plan."""
        return self.end - self.start


@dataclass(frozen=True)
class Part:
    """Consecutive spans through which the path is followed without a stop.

    Attributes
    ----------
    spans : tuple of Span
        The spans.
    ratios : tuple of float
        Speed of the plan at the end of each span relative to that at the start of the
        next one.
    bends : tuple of float
        Acceleration of the plan along its velocity, relative to it [1/s]: increase
        from the end of each span to the start of the next one, with its speed there.
    rates : (float or None, float or None)
        Prescribed squared rates at both ends: 0 at a corner of the path, at which it
        must be at rest; None for free ones.
    closed : bool
        Whether the end is continued by the start.
    """

    spans: tuple[Span, ...]
    ratios: tuple[float, ...]
    bends: tuple[float, ...]
    rates: Rates
    closed: bool = False

    @property
    def moves(self) -> bool:
        """Whether the plan moves; otherwise it dwells."""
        return self.spans[0].moves


def parts_of(
    plan: Trajectory,
    stops: bool,
    edges: Sequence[float] = (),
    given: Rates = (None, None),
    origin: float = 0.0,
) -> list[Part]:
    """Parts of a plan, dwells included.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration and without jumps of the position.
    stops : bool
        Whether the plan stops at corners of the path.
    edges : sequence of float, optional
        Times [s] at which limits change.
    given : (float or None, float or None), optional
        Squared rates at both ends; None for free ones.
    origin : float, optional
        Start [s] of the plan before it was moved to 0, of which its times have the rounding.
    """
    spans, joints = spans_of(plan, stops, edges, origin)
    free = spans[0].moves and spans[-1].moves and given == (None, None)
    closing = closing_joint(plan) if free else None
    if closing is not None and closing.stops:
        given = (0.0, 0.0) if closing.corner and stops and plan.is_cyclic else given
        closing = None
    ends = [0, *(k + 1 for k, joint in enumerate(joints) if joint.stops), len(spans)]
    parts = []
    for first, last in pairwise(ends):
        inner = [*joints[first : last - 1], Joint(True, False)]
        start = given[0] if first == 0 else 0.0 if joints[first - 1].corner else None
        stop = given[1] if last == len(spans) else 0.0 if joints[last - 1].corner else None
        rates = None if spans[first].rests[0] else start, None if spans[last - 1].rests[1] else stop
        ratios, bends = tuple(joint.ratio for joint in inner), tuple(joint.bend for joint in inner)
        parts.append(Part(tuple(spans[first:last]), ratios, bends, rates))
    if closing is None:
        return parts
    begin, end = parts[0], parts[-1]
    ratios, bends = (*end.ratios[:-1], closing.ratio), (*end.bends[:-1], closing.bend)
    if len(parts) == 1:
        return [replace(begin, ratios=ratios, bends=bends, closed=True)]
    # The last part leads into the first.
    parts[0] = Part(
        parts.pop().spans + begin.spans,
        ratios + begin.ratios,
        bends + begin.bends,
        (end.rates[0], begin.rates[1]),
    )
    return parts


@dataclass(frozen=True)
class Joint:
    """Point between two spans.

    Attributes
    ----------
    stops : bool
        Whether the plan is at rest or must stop there.
    corner : bool
        Whether it must stop because the direction changes.
    ratio : float
        Speed before the point relative to that after it.
    bend : float
        Increase of the acceleration along the velocity, relative to it [1/s].
    """

    stops: bool
    corner: bool
    ratio: float = 1.0
    bend: float = 0.0


def _joint(before: Array, after: Array, still: Array, stops: bool = True) -> Joint:
    """Kind of a point, by the jets (3, naxes) on both sides, and velocities and accelerations that are 0."""
    rests = [bool((np.abs(jet[1]) <= still[0]).all()) for jet in (before, after)]
    if all(rests):
        # A reversal with acceleration is passed without a break.
        passes = (np.abs(after[2] - before[2]) <= 1e3 * still[1]).all() and (np.abs(after[2]) > 1e3 * still[1]).any()
        return Joint(not passes, False)
    moving = still[0] > 0.0
    tangents = [jet[1, moving] / still[0, moving] for jet in (before, after)]
    sizes = [float(np.linalg.norm(tangent)) for tangent in tangents]
    if any(rests) or (np.abs(tangents[0] / sizes[0] - tangents[1] / sizes[1]) > 1e-7).any():
        return Joint(stops, stops)
    ratio = sizes[0] / sizes[1] if abs(sizes[0] / sizes[1] - 1.0) > 1e-12 else 1.0
    jump = (ratio**2 * after[2, moving] - before[2, moving]) / still[0, moving]
    bend = float(jump @ tangents[0]) / sizes[0] ** 2
    return Joint(False, False, ratio, bend)


def _still(peaks: Array, constant: NDArray[np.bool_]) -> Array:
    """Velocities and accelerations (2, naxes) that are 0: all of them on axes that are constant up to rounding."""
    return np.where(constant, np.inf, _STILL * peaks)


def spans_of(plan: Trajectory, stops: bool, edges: Sequence[float], origin: float) -> tuple[list[Span], list[Joint]]:
    """Spans between breakpoints and waypoints, and the points between them."""
    segments, starts, ends = [], [], []
    inner = np.unique([*(waypoint.time for waypoint in plan.waypoints), *edges])
    shortest = _ROUNDING * max(abs(plan.start), abs(plan.end), abs(origin))
    for segment, (left, right) in enumerate(pairwise(plan.breakpoints.tolist())):
        if right - left <= shortest:  # between breakpoints of axes that are the same up to rounding
            continue
        slack = 1e-9 * (right - left)
        own = inner[(inner > left + slack) & (inner < right - slack)] - left
        own = own[np.diff(own, prepend=0.0) > slack]
        for first, last in pairwise([0.0, *own.tolist(), right - left]):
            segments.append(segment)
            starts.append(first)
            ends.append(last)
    fractions = np.array([0.0, _NEAR, 2.0 * _NEAR, 0.21, 0.5, 0.79, 1.0 - 2.0 * _NEAR, 1.0 - _NEAR, 1.0])
    times = np.array(starts)[:, None] + (np.array(ends) - np.array(starts))[:, None] * fractions
    jets = plan.segments_jet(np.repeat(segments, fractions.size), times.ravel(), 2)
    jets = jets.reshape(3, plan.naxes, len(segments), fractions.size)
    low, high = jets[0].min(axis=(1, 2)), jets[0].max(axis=(1, 2))
    still = _still(np.abs(jets[1:]).max(axis=(2, 3)), constant_axes(low, high))
    moves = (np.abs(jets[1]) > still[0, :, None, None]).any(axis=(0, 2))
    rests = _powers(jets[1] / np.where(still[0] > 0.0, still[0], 1.0)[:, None, None])
    spans = [
        Span(segment, first, last, bool(moving), (own[0], own[1]))
        for segment, first, last, moving, own in zip(segments, starts, ends, moves, rests, strict=True)
    ]
    joints = [
        _joint(jets[:, :, k, -1], jets[:, :, k + 1, 0], still, stops)
        if spans[k].moves and spans[k + 1].moves
        else Joint(True, stops)
        for k in range(len(spans) - 1)
    ]
    return spans, joints


def corner_times(plan: Trajectory, lap: bool) -> tuple[float, ...]:
    """Times [s] at which a plan is at rest or must stop because its direction changes.

    If `lap`, with those of a corner between the end and the start of a cyclic plan.
    """
    start = plan.start
    own = plan.shift(-start)  # so that times have full precision
    spans, joints = spans_of(own, True, (), start)
    corners = [k for k, joint in enumerate(joints, 1) if joint.stops and _is_corner(own, spans[:k], spans[k:])]
    closing = closing_joint(own) if lap and own.is_cyclic else None
    if closing is not None and closing.corner:
        corners = [0, *corners, len(spans)]
    times = [float(own.breakpoints[span.segment] + span.start) for span in spans] + [own.end]
    return tuple(start + times[k] for k in corners)


def _is_corner(plan: Trajectory, before: Sequence[Span], after: Sequence[Span]) -> bool:
    """Whether a plan stops between spans from motion, or at rest, also for a dwell, before another direction."""
    if any(span.moves and not span.rests[side] for span, side in ((before[-1], 1), (after[0], 0))):
        return True
    last = next((span for span in reversed(before) if span.moves), None)
    first = next((span for span in after if span.moves), None)
    if last is None or first is None:
        return False
    peaks = plan.peak(1)
    extrema = plan.extrema()
    moving = (peaks > 0.0) & ~constant_axes(extrema.minimum, extrema.maximum)
    tangents = [_direction(plan, *end)[moving] / peaks[moving] for end in ((last, 1), (first, 0))]
    sizes = [float(np.linalg.norm(tangent)) for tangent in tangents]
    if not all(0.0 < size < np.inf for size in sizes):
        return False
    return bool((np.abs(tangents[0] / sizes[0] - tangents[1] / sizes[1]) > _ANGLE).any())


def _direction(plan: Trajectory, span: Span, side: int) -> Array:
    """Direction (naxes,) in which a plan moves at an end of a span, by the lowest derivative that is not 0 there."""
    power = round(span.rests[side])
    s = np.array([span.end if side else span.start])
    found: Array = plan.segments_jet(np.array([span.segment]), s, power + 1)[power + 1, :, 0]
    return -found if side and power % 2 else found


def _powers(velocities: Array) -> list[list[float]]:
    """Powers (nspans, 2) with which velocities (naxes, nspans, npoints), of 1 at rest, grow from both ends."""
    sizes = np.linalg.norm(velocities, axis=0)
    rests = (np.abs(velocities[:, :, [0, -1]]) <= 1.0).all(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        powers = np.log2(sizes[:, [2, -3]] / sizes[:, [1, -2]])
    return np.where(rests & np.isfinite(powers), np.clip(powers, 1.0, None), 0.0).tolist()


def closing_joint(plan: Trajectory) -> Joint | None:
    """Joint of the end of a closed plan with its start; None if it is not closed, or its speed is not the same."""
    first, last = plan.jet(plan.start, 2), plan.jet(plan.end, 2, left=True)
    extrema = plan.extrema()
    slack = 1e-9 * (extrema.maximum - extrema.minimum) + 1e-14 * np.abs(first[0])
    if (np.abs(last[0] - first[0]) > slack).any():
        return None
    constant = constant_axes(extrema.minimum, extrema.maximum)
    peaks = np.stack([plan.peak(1), plan.peak(2)])
    joint = _joint(last, first, _still(peaks, constant))
    return joint if abs(joint.ratio - 1.0) <= 1e-7 else None
