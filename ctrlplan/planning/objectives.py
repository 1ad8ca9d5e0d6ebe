"""Objectives: functions of a plan to be minimised.

Those of this module take a fraction of a millisecond, for searches over
hundreds of plans.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, TypeVar

import numpy as np

from ctrlplan._checks import checked_count
from ctrlplan.planning.arc_length import arc_lengths
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.quadrature import gauss

F = TypeVar("F")

Objective = Callable[[Trajectory], float]

ObjectiveName = Literal[
    "path",
    "wandering",
    "peak_velocity",
    "peak_acceleration",
    "peak_jerk",
    "peak_snap",
    "squared_velocity",
    "squared_acceleration",
    "squared_jerk",
    "squared_snap",
]
"""Names of `OBJECTIVES`."""

_SIZE = "_ctrlplan_size"


def of_size(size: float) -> Callable[[F], F]:
    """Declare the scale of an objective whose minimum may be 0, such as 1 for a fraction.

    Tolerances are relative to this scale; default: the magnitude of the minimum.
    """

    def declare(objective: F) -> F:
        vars(objective)[_SIZE] = size
        return objective

    return declare


def declared_size(objective: Objective) -> float | None:
    """Declared scale of an objective; None if there is none."""
    size: float | None = getattr(objective, _SIZE, None)
    return size


def plan_length(plan: Trajectory) -> float:
    r"""Path length of a plan, from its derivatives.

    .. math:: \int \Bigl(\sum_i \dot y_i(t)^2\Bigr)^{1/2} dt

    Parameters
    ----------
    plan : Trajectory
        Axes in the same unit.

    Returns
    -------
    float
        In the unit of the axes, with a relative error of 1e-8, also if a path of
        several axes nearly stops; 0 for a step.

    See Also
    --------
    ctrlplan.metrics.path_length : Path length from samples.
    """
    return float(plan_lengths([plan])[0])


def plan_lengths(plans: Sequence[Trajectory]) -> Array:
    """Path lengths (nplans,) of plans with the same axes, faster than each by itself; as `plan_length`."""
    if plans and plans[0].naxes > 1:
        return arc_lengths(plans)
    return np.array(
        [sum(_variation(plan, left, right) for left, right in pairwise(plan.breakpoints.tolist())) for plan in plans],
        dtype=float,
    )


@of_size(1.0)
def plan_excess_length(plan: Trajectory) -> float:
    """Path length over the length of the waypoint polyline, minus 1.

    Parameters
    ----------
    plan : Trajectory
        Plan with waypoints whose positions are all prescribed.

    Returns
    -------
    float
        Relative excess length; nan if the polyline has length 0.
    """
    points = np.array([point.position for point in plan.waypoints]).reshape(-1, plan.naxes)
    shortest = float(np.sqrt(np.square(np.diff(points, axis=0)).sum(axis=1)).sum())
    return plan_length(plan) / shortest - 1.0 if shortest > 0.0 else math.nan


@dataclass(frozen=True)
class PeakDerivative:
    """Maximum magnitude of a derivative over all axes.

    For use in searches: extrema are bracketed by samples and refined, whereas
    `Trajectory.peak` guarantees that none is missed.

    Parameters
    ----------
    nu : int
        Order of the derivative.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> round(PeakDerivative(1)(move), 12)
    1.875
    """

    nu: int

    def __post_init__(self) -> None:
        checked_count(self.nu, "nu")

    def __call__(self, plan: Trajectory) -> float:
        """Maximum magnitude over the whole plan, in units of the axes per s^nu."""
        count = 64 + 16 * max((point.jet.shape[0] for point in plan.waypoints), default=0)
        return max(
            (_peak(plan, left, right, self.nu, count) for left, right in pairwise(plan.breakpoints.tolist())),
            default=0.0,
        )


@dataclass(frozen=True)
class SquaredDerivative:
    r"""Integral of a squared derivative, summed over the axes.

    .. math:: \int \sum_i y_i^{(\nu)}(t)^2\,dt

    between breakpoints, without impulses at jumps.

    Parameters
    ----------
    nu : int
        Order of the derivative: 3 is the jerk.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> round(SquaredDerivative(3)(move), 9)
    720.0
    """

    nu: int

    def __post_init__(self) -> None:
        checked_count(self.nu, "nu")

    def __call__(self, plan: Trajectory) -> float:
        """Integral over the whole plan."""
        nodes, weights = gauss(64)
        squares = np.square(plan.at_fractions(nodes, self.nu)).sum(axis=0)
        return float((squares @ weights) @ (plan.breakpoints[1:] - plan.breakpoints[:-1]))


OBJECTIVES: dict[ObjectiveName, Objective] = {
    "path": plan_length,
    "wandering": plan_excess_length,
    "peak_velocity": PeakDerivative(1),
    "peak_acceleration": PeakDerivative(2),
    "peak_jerk": PeakDerivative(3),
    "peak_snap": PeakDerivative(4),
    "squared_velocity": SquaredDerivative(1),
    "squared_acceleration": SquaredDerivative(2),
    "squared_jerk": SquaredDerivative(3),
    "squared_snap": SquaredDerivative(4),
}
"""Objectives by name."""


def objective_values(objective: Objective, plans: Sequence[Trajectory]) -> Iterator[Any]:
    """Values of an objective for plans with the same axes, as it returns them."""
    return iter(plan_lengths(plans).tolist()) if objective is plan_length else map(objective, plans)


def checked_objective(objective: ObjectiveName | Objective) -> Objective:
    """Objective from its name or function, checked."""
    if isinstance(objective, str):
        if objective not in OBJECTIVES:
            raise ValueError(f"objective must be one of {', '.join(OBJECTIVES)} or a function, got {objective!r}")
        return OBJECTIVES[objective]
    if not callable(objective):
        raise TypeError(f"objective must be a name or a function of a plan, got {type(objective).__name__}")
    return objective


def _variation(plan: Trajectory, left: float, right: float) -> float:
    """Length of one segment of one axis, summed between reversals."""
    t = left + (right - left) * gauss(128)[0]
    # Between points of inflection the slope is monotone: no two reversals can lie between samples.
    t = np.sort(np.concatenate([t, _crossings(plan, t, 2)]))
    ends = plan.jet([left], 0)[0, 0], plan.jet([right], 0, left=True)[0, 0]
    turned = plan.jet(_crossings(plan, t, 1), 0)[0, 0]
    return float(np.abs(np.diff(np.concatenate([ends[0], turned, ends[1]]))).sum())


def _crossings(plan: Trajectory, t: Array, nu: int) -> Array:
    """Times of the sign changes of the nu-th derivative of a single axis between increasing times."""
    values = plan.jet(t, nu)[nu, 0]
    cell = np.flatnonzero(values[1:] * values[:-1] < 0.0)
    low, high = t[cell], t[cell + 1]
    found = low + (high - low) * values[cell] / (values[cell] - values[cell + 1])
    for _ in range(2):
        value, slope = plan.jet(found, nu + 1)[nu:, 0]
        found = np.clip(found - value / np.where(slope != 0.0, slope, np.inf), low, high)
    return found


def _peak(plan: Trajectory, left: float, right: float, nu: int, count: int) -> float:
    """Maximum magnitude on one segment from samples, refined by parabolas where the slope changes its sign."""
    inside = np.linspace(left, right, count)
    # The ends belong to this segment, not to the next.
    inside[0], inside[-1] = np.nextafter(left, right), np.nextafter(right, left)
    value, slope, curve = plan.jet(inside, nu + 2)[nu:]
    best = float(np.abs(value).max())
    axis, cell = np.nonzero(slope[:, 1:] * slope[:, :-1] < 0.0)
    if not cell.size:
        return best
    # Start at the zeros of the chords of the slope; only cells that may contain the maximum are refined.
    width = inside[cell + 1] - inside[cell]
    start = inside[cell] + width * slope[axis, cell] / (slope[axis, cell] - slope[axis, cell + 1])
    bound = np.abs(value[axis, cell]) + 0.5 * width**2 * np.maximum(*np.abs(curve[axis, [cell, cell + 1]]))
    near = bound >= best
    axis, t = axis[near], start[near]
    value, slope, curve = plan.jet(t, nu + 2)[nu:, axis, np.arange(axis.size)]
    with np.errstate(divide="ignore", invalid="ignore"):
        top = value - 0.5 * slope**2 / curve
    return max(best, float(np.abs(top[np.isfinite(top)]).max(initial=0.0)))
