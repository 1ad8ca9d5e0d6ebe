"""What a plan is in a comparison, and whether its loop is stable: values, which no name and no sentence carries."""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum

from ctrlplan.studies.measures import Run
from ctrlplan.trajectories import Trajectory


class Role(Enum):
    """What a plan is in a comparison.

    Attributes
    ----------
    STEP
        A reference whose position jumps: a step, shaped or not. It satisfies no
        limit on a derivative.
    BASELINE
        A plan with which the planned references are compared.
    PLANNED
        A planned reference.
    """

    STEP = "step"
    BASELINE = "baseline"
    PLANNED = "planned"


class Stability(Enum):
    """What is known of the stability of the loops of a comparison.

    Attributes
    ----------
    STABLE
        No loop has a pole in the right half plane.
    UNSTABLE
        The loop of every plan has one: nothing settles.
    MIXED
        The loops of some plans have one.
    UNKNOWN
        No loop is known to be unstable, and one or more are not linear and
        continuous.
    """

    STABLE = "stable"
    UNSTABLE = "unstable"
    MIXED = "mixed"
    UNKNOWN = "unknown"


def role_of(plan: Trajectory) -> Role:
    """Role of a plan by itself: a step, or planned."""
    return Role.STEP if plan.jumps(0) else Role.PLANNED


def stability_of(runs: Collection[Run]) -> Stability:
    """Stability of the loops of some runs."""
    unstable = [run.is_unstable for run in runs]
    if any(unstable):
        return Stability.UNSTABLE if all(unstable) else Stability.MIXED
    return Stability.UNKNOWN if any(run.unstable is None for run in runs) else Stability.STABLE
