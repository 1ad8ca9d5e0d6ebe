"""References of a comparison: given by name, or the standard set through waypoints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Step, Trajectory, TrigSpline, Waypoint


def waypoints_given(
    points: object, name: str = "plans", kinds: str = "a mapping of names to trajectories, or waypoints"
) -> tuple[Waypoint, ...]:
    """Waypoints, given as such or in place of plans; `name` and `kinds` are for messages.

    Raises
    ------
    TypeError
        If they are neither waypoints nor named plans.
    """
    found: list[Waypoint] = []
    for point in points if isinstance(points, Iterable) else (points,):
        if not isinstance(point, Waypoint):
            raise TypeError(f"{name} must be {kinds}, got {type(point).__name__}")
        found.append(point)
    return tuple(found)


def standard_plans(waypoints: Iterable[Waypoint], alpha: float = 1.0) -> dict[str, Trajectory]:
    """Standard set of plans through the same waypoints.

    Parameters
    ----------
    waypoints : iterable of Waypoint
        Two or more.
    alpha : float, optional
        Shape parameter of the trigonometric plan [rad].

    Returns
    -------
    dict of str to Trajectory
        step (from the first to the last position, at the start), polynomial,
        trigonometric, piecewise.
    """
    points = tuple(waypoints)
    polynomial = PolySpline(points, warn=False)  # a baseline, even if it oscillates between the waypoints
    return {
        "step": Step(polynomial.final, polynomial.initial, polynomial.start, polynomial.labels),
        "polynomial": polynomial,
        "trigonometric": TrigSpline(points, alpha=alpha),
        "piecewise": PiecewiseSpline(points),
    }


def references_of(plans: Mapping[str, Trajectory] | Iterable[Waypoint], alpha: float = 1.0) -> dict[str, Trajectory]:
    """References by name: the given plans, or the standard set through waypoints.

    Raises
    ------
    ValueError
        If there is none, or they differ in axes.
    TypeError
        If one is not a trajectory.
    """
    return _checked_plans(plans if isinstance(plans, Mapping) else standard_plans(plans, alpha))


def _checked_plans(plans: Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    references = dict(plans)
    if not references:
        raise ValueError("plans must contain at least one trajectory, got none")
    naxes = None
    for name, plan in references.items():
        if not isinstance(plan, Trajectory):
            raise TypeError(f"plans[{name!r}] must be a Trajectory, got {type(plan).__name__}")
        if naxes is not None and plan.naxes != naxes:
            raise ValueError(f"plans must have the same axes, got {plan.naxes} in {name!r} after {naxes}")
        naxes = plan.naxes
    return references
