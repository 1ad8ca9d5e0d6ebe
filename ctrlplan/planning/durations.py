"""Plans as a function of their duration, and how far they violate limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctrlplan.planning.limits import Limited, Margins, Sampled
from ctrlplan.trajectories import Trajectory, WaypointSpline
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.waypoint import Waypoint

_TOGETHER = 2**15
"""Number of samples that are evaluated together."""

_ABOUT_PEAK = 33
"""Number of samples between the neighbours of the sample of the maximum excess."""


class Part(NamedTuple):
    """Part of a plan that depends on the duration by a power.

    Attributes
    ----------
    plan : Trajectory
        The part at the duration of the given plan; its nth derivative is
        proportional to the duration to the power `order` - n.
    order : int
        Order of the prescribed derivatives that it contains; 0 for a whole shape.
    """

    plan: Trajectory
    order: int


class PlansByDuration:
    """Plans of every duration with the same shape, and their excess over limits.

    Parameters
    ----------
    plan : Trajectory
        Plan of one duration.
    limited : Limited
        The limits.
    """

    per_octave = 24
    """Number of durations per octave that resolve the excess."""

    def __init__(self, plan: Trajectory, limited: Limited) -> None:
        self.given, self.limited = plan, limited
        self._known: dict[float, Margins | None] = {}

    def plan(self, duration: float) -> Trajectory:
        """Plan of a duration."""
        return self.given.retime(duration)

    def parts(self) -> Sequence[Part]:
        """Parts whose sum is the plan; empty if it does not depend on the duration by powers."""
        return (Part(self.given, 0),)

    def excess(self, duration: float) -> float:
        """Maximum excess over samples; inf if the plan is infeasible for the plant."""
        return float(self.excesses(np.array([duration]))[0])

    def excesses(self, durations: Array) -> Array:
        """Maximum excess (ndurations,) over samples."""
        if not self._parts:
            limited = self.limited
            return np.array([limited.excess(limited.sampled(self.plan(duration))) for duration in durations.tolist()])
        count = max(1, _TOGETHER // self._samples[0].fractions.size)
        return np.concatenate([self._excesses(self._samples, part) for part in _split(durations, count)])

    def margins(self, duration: float) -> Margins | None:
        """Margins over the whole plan; None if it is infeasible for the plant."""
        if duration not in self._known:
            plan = self.plan(duration)
            try:
                self._known[duration] = self.limited.margins(plan)
            except ValueError:
                self._known[duration] = None
        return self._known[duration]

    def is_known(self, duration: float) -> bool:
        """Whether the margins of a duration are computed already."""
        return duration in self._known

    def exact_excess(self, duration: float) -> float:
        """Maximum excess over the whole plan; inf if it is infeasible for the plant."""
        margins = self.margins(duration)
        return math.inf if margins is None else -margins.active.fraction

    def peak(self, duration: float) -> tuple[int, float] | None:
        """Constant limit with the maximum excess of a duration, and its relative time, by samples and those about it.

        None if the plan does not depend on the duration by powers or is infeasible for the plant, or if a limit of
        another kind has the maximum.
        """
        if not self._parts:
            return None
        fractions = self._samples[0].fractions
        try:
            rows = self._excesses_over_time(self._samples, duration)
            bound, at = np.unravel_index(int(rows.argmax()), rows.shape)
            left = fractions[fractions < fractions[at]].max(initial=0.0)
            right = fractions[fractions > fractions[at]].min(initial=1.0)
            near = np.linspace(left, right, _ABOUT_PEAK)
            row = self._excesses_over_time(self._sampled_at(near), duration)[bound]
        except ValueError:
            return None
        limit = self.limited.bounds[bound]
        if not (limit.is_constant and limit.kind == "value"):
            return None
        k = min(max(int(row.argmax()), 1), near.size - 2)
        below, here, above = row[k - 1 : k + 2].tolist()
        curve = below - 2.0 * here + above
        move = 0.5 * (below - above) / curve if curve < 0.0 else 0.0  # to the vertex of a parabola
        return int(bound), float(near[k] + min(max(move, -1.0), 1.0) * (near[1] - near[0]))

    def _sampled_at(self, fractions: Array) -> list[Sampled]:
        """Samples of each part at relative times."""
        found = []
        for part in self._parts:
            times = part.plan.start + fractions * part.plan.duration
            jet = self.limited.seen(part.plan).jet(times, self.limited.order)
            moments, weights = self.limited.moments(part.plan, times), np.full(fractions.size, 1.0 / fractions.size)
            found.append(Sampled(jet, fractions, moments, weights, part.plan.duration))
        return found

    def _excesses_over_time(self, samples: list[Sampled], duration: float) -> Array:
        """Excess (nbounds, ntime) over each limit at samples of a feasible duration."""
        values = self.limited.values(self._jets(samples, np.array([duration]))[:, :, 0])
        rows = [bound.excess(row) for bound, row in zip(self.limited.bounds, values, strict=True)]
        return np.nan_to_num(np.array(rows), nan=-math.inf)

    def excesses_at(self, bound: int, fraction: float) -> Callable[[Array], Array] | None:
        """Excess over one limit at one relative time, from both sides, as a function of durations (ndurations,).

        None if the plan does not depend on the duration by powers.
        """
        if not self._parts:
            return None
        samples = []
        for part in self._parts:
            t = part.plan.start + fraction * part.plan.duration
            seen = self.limited.seen(part.plan)
            jet = np.stack([seen.jet(t, self.limited.order, left) for left in (False, True)], axis=-1)
            moments = self.limited.moments(part.plan, np.full(2, t))
            samples.append(Sampled(jet, np.full(2, fraction), moments, np.full(2, 0.5), part.plan.duration))
        return lambda durations: self._excesses(samples, durations, [bound])

    @cached_property
    def _parts(self) -> Sequence[Part]:
        return self.parts()

    @cached_property
    def _samples(self) -> list[Sampled]:
        """Samples of each part, at the same relative times."""
        return [self.limited.sampled(part.plan) for part in self._parts]

    def _excesses(self, samples: list[Sampled], durations: Array, bounds: Sequence[int] | None = None) -> Array:
        """Maximum excess (ndurations,) from samples of each part."""
        return self.limited.excesses_of(self._jets(samples, durations), samples[0], durations, bounds)

    def _jets(self, samples: list[Sampled], durations: Array) -> Array:
        """Jets (order + 1, naxes, ndurations, ntime) from samples of each part."""
        orders = np.arange(self.limited.order + 1)[:, None]
        jets: Array = np.zeros(())
        with np.errstate(over="ignore", invalid="ignore"):  # extreme durations are rejected when a plan is made
            for part, own in zip(self._parts, samples, strict=True):
                powers = (durations / own.duration) ** (part.order - orders)
                jets = jets + own.jet[:, :, None] * powers[:, None, :, None]
        return jets


class ReplannedPlans(PlansByDuration):
    """Plans with fixed derivatives at the waypoints.

    If positions depend linearly on the entries of the waypoints, a plan is a sum of
    one part for each order of derivatives.
    """

    def __init__(self, plan: Trajectory, limited: Limited) -> None:
        super().__init__(plan.quiet() if isinstance(plan, WaypointSpline) else plan, limited)

    def plan(self, duration: float) -> Trajectory:
        """Plan of a duration."""
        return replanned(self.given, duration)

    def parts(self) -> Sequence[Part]:
        """Parts with the entries of one order each; as `PlansByDuration.parts`."""
        plan = self.given
        if not (isinstance(plan, WaypointSpline) and plan.is_linear):
            return ()
        highest = max(len(point.jet) for point in plan.waypoints)
        return [Part(plan.through(_only(point, k) for point in plan.waypoints), k) for k in range(highest)]


def replanned(plan: Trajectory, duration: float) -> Trajectory:
    """Plan of another duration with the derivatives of the waypoints preserved."""
    if not isinstance(plan, WaypointSpline):
        raise TypeError(
            f'plan must be a WaypointSpline, such as PolySpline, for hold="waypoints", got a {type(plan).__name__}; '
            'use hold="shape" or "path"'
        )
    retimed = plan.retime(duration)
    pairs = zip(plan.waypoints, retimed.waypoints, strict=True)
    return retimed.through(given.scaled(moved.time, 1.0) for given, moved in pairs)


def _only(point: Waypoint, order: int) -> Waypoint:
    """Waypoint with all prescribed entries 0 except those of one order."""
    jet = np.where(np.isnan(point.jet), np.nan, 0.0)
    jet[order : order + 1] = point.jet[order : order + 1]
    return Waypoint.from_array(point.time, jet, point.labels)


def _split(durations: Array, count: int) -> list[Array]:
    """Parts of at most `count` durations."""
    return [durations[k : k + count] for k in range(0, durations.size, count)]
