"""Minimum durations of plans under the same limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ctrlplan.planning.fastest import fastest_within
from ctrlplan.planning.limits import Limited
from ctrlplan.studies.grids import SAME
from ctrlplan.trajectories import Trajectory


@dataclass(frozen=True)
class RequiredDuration:
    """Minimum duration of a plan under the same limits.

    Attributes
    ----------
    name : str
        The plan.
    duration : float
        Minimum duration [s], nan where there is none.
    limit : str
        Active limit, or the reason why no duration satisfies the limits.
    satisfied : str
        Whether the plan satisfies the limits at the times of the waypoints.
    """

    name: str
    duration: float
    limit: str
    satisfied: str = ""


def required_duration(name: str, plan: Trajectory, fast: Trajectory, limited: Limited) -> RequiredDuration:
    """Minimum duration of a plan under limits.

    Parameters
    ----------
    name : str
        Name of the plan.
    plan : Trajectory
        The plan with the times of the waypoints.
    fast : Trajectory
        The plan as fast as its own limits allow, for a profile; otherwise
        `plan` itself.
    limited : Limited
        The limits.
    """
    if plan.jumps(0):
        return RequiredDuration(name, math.nan, "position jumps: no limit on a derivative can hold", "violated")
    try:
        limited.check_smooth(plan)
        margins = limited.margins(plan)
        worst = margins.active
        satisfied = "satisfied" if worst.fraction >= -SAME else f"{worst.bound.name} exceeded by {worst.share}"
        shortest = margins if fast is plan else limited.margins(fast)
        duration = fast.duration
        if fast is plan or not shortest.satisfied:
            found = fastest_within(fast, limited)
            duration, shortest = found.duration, found.margins
    except ValueError as reason:
        return RequiredDuration(name, math.nan, str(reason), "violated")
    active = shortest.active
    return RequiredDuration(
        name, duration, f"{active.bound.name} {active.bound.range} at {active.time:.3g} s", satisfied
    )


def sentence_of(required: Sequence[RequiredDuration]) -> str:
    """The minimum durations of all plans, in a sentence."""
    feasible = [one for one in required if not math.isnan(one.duration)]
    if not feasible:
        return "No plan satisfies these limits at any duration."
    first = min(feasible, key=lambda one: one.duration)
    others = ", ".join(f"{one.name} {one.duration:.4g} s" for one in feasible if one is not first)
    never = [one.name for one in required if math.isnan(one.duration)]
    without = f"; no duration satisfies them for {', '.join(never)}" if never else ""
    return (
        f"Under the same limits, {first.name} has the shortest minimum duration, {first.duration:.4g} s"
        f"{f' ({others})' if others else ''}{without}."
    )
