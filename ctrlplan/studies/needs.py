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
class Need:
    """Minimum duration of a plan under the same limits.

    Attributes
    ----------
    name : str
        The plan.
    duration : float
        Minimum duration [s], nan where there is none.
    limit : str
        Active limit, or why there is no duration.
    kept : str
        Whether it satisfies the limits in the time of the waypoints.
    """

    name: str
    duration: float
    limit: str
    kept: str = ""


def need_of(name: str, plan: Trajectory, fast: Trajectory, limited: Limited) -> Need:
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
        return Need(name, math.nan, "jumps: no limit on a derivative holds", "broken")
    try:
        limited.check_smooth(plan)
        worst = limited.margins(plan).active
        kept = "all kept" if worst.fraction >= -SAME else f"{worst.bound.name} {worst.share} beyond"
        shortest = limited.margins(fast)
        duration = fast.duration
        if fast is plan or not shortest.hold:
            found = fastest_within(fast, limited)
            duration, shortest = found.duration, found.margins
    except ValueError as refusal:
        return Need(name, math.nan, str(refusal), "broken")
    active = shortest.active
    return Need(name, duration, f"{active.bound.name} {active.bound.range}, at {active.time:.3g} s", kept)


def sentence_of(needs: Sequence[Need]) -> str:
    """The plan with the minimum duration, and the others, in a sentence."""
    possible = [need for need in needs if not math.isnan(need.duration)]
    if not possible:
        return "Under these limits no plan is possible."
    first = min(possible, key=lambda need: need.duration)
    others = ", ".join(f"{need.name} {need.duration:.4g} s" for need in possible if need is not first)
    never = [need.name for need in needs if math.isnan(need.duration)]
    without = f"; {', '.join(never)} cannot keep them at any" if never else ""
    return f"Under the same limits {first.name} is the fastest with {first.duration:.4g} s ({others}{without})."
