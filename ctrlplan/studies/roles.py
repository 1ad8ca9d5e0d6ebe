"""Role of a plan in a comparison, and stability of its loop."""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum

from ctrlplan.studies.measures import Run
from ctrlplan.trajectories import Trajectory


class Role(Enum):
    """Role of a plan in a comparison.

    Attributes
    ----------
    STEP
        A reference with a discontinuous position: a step, shaped or not. It
        violates every limit on a derivative.
    BASELINE
        A plan with which the planned references are compared.
    PLANNED
        A planned reference.
    """

    STEP = "step"
    BASELINE = "baseline"
    PLANNED = "planned"


class Stability(Enum):
    """Stability of the loops of a comparison, as far as it is known.

    Attributes
    ----------
    STABLE
        No loop has a pole in the right half plane.
    UNSTABLE
        The loop of every plan has one, and no output settles.
    MIXED
        The loops of some plans have one, and others do not.
    UNKNOWN
        No loop is known to be unstable, and one or more are not linear and
        continuous.
    """

    STABLE = "stable"
    UNSTABLE = "unstable"
    MIXED = "mixed"
    UNKNOWN = "unknown"


def role_of(plan: Trajectory) -> Role:
    """Role of a plan without a comparison: step or planned."""
    return Role.STEP if plan.jumps(0) else Role.PLANNED


def stability_of(runs: Collection[Run]) -> Stability:
    """Stability of the loops of several runs."""
    unstable = [run.is_unstable for run in runs]
    if any(unstable):
        return Stability.UNSTABLE if all(unstable) else Stability.MIXED
    return Stability.UNKNOWN if any(run.unstable is None for run in runs) else Stability.STABLE
