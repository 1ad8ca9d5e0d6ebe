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
        Active limit, or why there is no duration.
    satisfied : str
        Whether it satisfies the limits in the time of the waypoints.
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
        What it is called.
    plan : Trajectory
        The plan in the time of the waypoints.
    fast : Trajectory
        The same where limits alone decide its duration; otherwise `plan` itself.
    limited : Limited
        The limits.
    """
    if plan.jumps(0):
        return RequiredDuration(name, math.nan, "jumps: no limit on a derivative holds", "broken")
    try:
        limited.check_smooth(plan)
        worst = limited.margins(plan).active
        satisfied = "all kept" if worst.fraction >= -SAME else f"{worst.bound.name} {worst.share} beyond"
        shortest = limited.margins(fast)
        duration = fast.duration
        if fast is plan or not shortest.hold:
            found = fastest_within(fast, limited)
            duration, shortest = found.duration, found.margins
    except ValueError as refusal:
        return RequiredDuration(name, math.nan, str(refusal), "broken")
    active = shortest.active
    return RequiredDuration(
        name, duration, f"{active.bound.name} {active.bound.range}, at {active.time:.3g} s", satisfied
    )


def sentence_of(required: Sequence[RequiredDuration]) -> str:
    """The plan with the minimum duration, and the others, in a sentence."""
    possible = [one for one in required if not math.isnan(one.duration)]
    if not possible:
        return "Under these limits no plan is possible."
    first = min(possible, key=lambda one: one.duration)
    others = ", ".join(f"{one.name} {one.duration:.4g} s" for one in possible if one is not first)
    never = [one.name for one in required if math.isnan(one.duration)]
    without = f"; {', '.join(never)} cannot keep them at any" if never else ""
    return f"Under the same limits {first.name} is the fastest with {first.duration:.4g} s ({others}{without})."
