"""Certified clearance of a plan from obstacles over its whole interval."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from ctrlplan._checks import checked_finite, checked_number
from ctrlplan._display import Displayed, Facts, Part, number
from ctrlplan._renamed import FormerAttribute
from ctrlplan.planning.obstacles import Obstacle
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.repeated import one_pass

_TIGHT = 1e-6  # relative gap between the bound and the attained minimum, unless a clearance is required
_TOGETHER = 512  # cells up to which their number does not matter for the time of one refinement
_ROUNDING = 1e-9  # of the coordinates: a plan at rest at exactly the required clearance is certified


@runtime_checkable
class Rope(Protocol):
    """Straight rope from the load up to a point `top`."""

    @property
    def order(self) -> int:
        """Highest derivative of the load that `top` uses."""

    def top(self, jet: Array) -> Array:
        """Upper end (2, ntime) from the load's jet (order + 1, 2, ntime)."""

    def slopes(self, plan: Trajectory) -> Array:
        """Bounds (order + 1, 2) of the partial derivatives of `top`.

        Norms, over the jets of a plan.
        """


@dataclass(frozen=True, repr=False)
class Clearance(Displayed):
    """Certified clearance of a plan.

    Attributes
    ----------
    lower : float
        Lower bound of the clearance over the whole interval, including the
        rounding of coordinates.
    minimum : float
        Minimum clearance, which is attained.
    time : float
        Time of the minimum [s].
    position : tuple of float
        Position of the load at that time.
    obstacle : int
        Index of the nearest obstacle at that time.
    part : "load" or "rope"
        Part that is nearest to the obstacle.
    required : float or None
        Required clearance.
    certified : bool or None
        Whether `lower` is at least `required`, up to rounding (1e-9 of the size
        of the coordinates); None if no clearance was required.
    """

    lower: float
    minimum: float
    time: float
    position: tuple[float, float]
    obstacle: int
    part: Literal["load", "rope"]
    required: float | None
    certified: bool | None

    least = FormerAttribute("minimum")

    def _describe(self) -> Iterator[Part]:
        verdict = {True: "satisfied", False: "violated", None: ""}[self.certified]
        wanted = f", {number(self.required)} required: {verdict}" if self.required is not None else ""
        yield f"Clearance of at least {self.lower:.6g} over the whole plan{wanted}"
        yield Facts(self.facts())

    def facts(self) -> list[tuple[str, str]]:
        """Values with their names, as print shows them."""
        x, z = self.position
        rope = "from the rope " if self.part == "rope" else ""
        return [
            ("certified lower bound", f"{self.lower:.6g}"),
            ("minimum found", f"{self.minimum:.6g}, {rope}to obstacles[{self.obstacle}]"),
            ("at", f"{self.time:.6g} s, position ({number(x)}, {number(z)})"),
            ("required", "" if self.required is None else f"{self.required:.6g}"),
        ]


def clearance(
    plan: Trajectory,
    obstacles: Iterable[Obstacle],
    *,
    load: float = 0.0,
    rope: Rope | None = None,
    required: float | None = None,
    max_cells: int = 200_000,
) -> Clearance:
    """Certified clearance of a plan in the plane from obstacles.

    Cells of each segment are refined until a bound, not a sample, is sufficient.
    In a cell of duration h the distance of the load from its chord is at most
    h^2/8 times the bound of its acceleration; the ends of the rope move by at
    most h/2 times the bounds of their speeds. Both bounds come from the jet at the
    centre and the peaks of the plan. The refinement ends when `required` is
    certified; without it, or if it is violated, when the gap between `lower` and
    `minimum` is below 1e-6, relative to a minimum above 1.

    Parameters
    ----------
    plan : Trajectory
        Plan of the load, two axes.
    obstacles : iterable of Obstacle
        One or more.
    load : float, optional
        Radius of the load.
    rope : Rope, optional
        Straight rope, such as `Crane.rope()`, which is considered as well.
    required : float, optional
        Required clearance.
    max_cells : int, optional
        Maximum number of cells.

    Returns
    -------
    Clearance
        With the attributes lower, minimum, time, position, obstacle, part,
        required and certified.

    Raises
    ------
    ValueError
        If the plan has no duration or not two axes, there is no obstacle, the
        load's radius is negative, or `max_cells` is reached.
    TypeError
        If an object is not an obstacle.

    Examples
    --------
    >>> from ctrlplan.planning.obstacles import Disc
    >>> from ctrlplan.trajectories import PolySpline, Waypoint
    >>> plan = PolySpline([Waypoint(0, [0, 0], 0, 0), Waypoint(1, [4, 0], 0, 0)])
    >>> found = clearance(plan, [Disc((2.0, 3.0), 1.0)], load=0.5, required=1.4)
    >>> found.certified, round(found.minimum, 6), found.part
    (True, 1.5, 'load')
    """
    things = checked_obstacles(obstacles)
    radius = checked_finite(load, "load", minimum=0.0)
    goal = None if required is None else checked_number(required, "required")
    checked_rope(rope)
    if plan.naxes != 2:
        raise ValueError(f"a plan among obstacles must have two axes, got {plan.naxes}")
    plan = one_pass(plan)
    if not plan.duration:
        raise ValueError("a trajectory must have a duration for its clearance, got a step")
    cells = _Cells(plan, things, radius, rope)
    slack = _ROUNDING * float(plan.peak().max(initial=abs(goal or 0.0)))
    times = np.concatenate([np.linspace(a, b, 65)[:-1] for a, b in itertools.pairwise(plan.breakpoints.tolist())])
    left, right = times, np.append(times[1:], plan.end)
    lower, spent = np.inf, 0
    while left.size:
        spent += left.size
        bound = cells.bound(left, right)
        minimum = cells.minimum
        target = minimum - _TIGHT * max(1.0, abs(minimum)) if goal is None or minimum < goal - slack else goal - slack
        open_ = bound < target
        if spent + 2 * np.count_nonzero(open_) > max_cells:
            if goal is not None and minimum >= goal - slack:
                raise ValueError(
                    f"the clearance must be decided within {max_cells} cells, got a bound of {bound.min():.6g} and a "
                    f"minimum of {minimum:.6g} where {goal:g} is required; increase max_cells or reduce required"
                )
            open_[:] = False
        lower = min(lower, float(bound[~open_].min(initial=np.inf)))
        left, right = _divided(left[open_], right[open_], min(_TOGETHER, max_cells - spent))
    return cells.result(lower, goal, None if goal is None else lower >= goal - slack)


def checked_obstacles(obstacles: Iterable[Obstacle]) -> tuple[Obstacle, ...]:
    """Obstacles as a tuple of at least one."""
    if isinstance(obstacles, Obstacle) or not isinstance(obstacles, Iterable):
        raise TypeError(f"obstacles must be a sequence of obstacles, got {obstacles!r}")
    things = tuple(obstacles)
    if not things:
        raise ValueError("there must be at least one obstacle, got none")
    for i, thing in enumerate(things):
        if not isinstance(thing, Obstacle):
            raise TypeError(f"obstacles[{i}] must be an obstacle, got {thing!r}")
    return things


def checked_rope(rope: Rope | None) -> Rope | None:
    """Rope, checked, or None."""
    if rope is not None and not isinstance(rope, Rope):
        raise TypeError(f"rope must be a rope such as crane.rope(), got {rope!r:.60}")
    return rope


def _divided(left: Array, right: Array, maximum: int) -> tuple[Array, Array]:
    """Cells divided in two, or in eight if these are not more than a maximum."""
    parts = 8 if 8 * left.size <= maximum else 2
    edges = left[:, None] + (right - left)[:, None] * (np.arange(parts + 1) / parts)
    edges[:, -1] = right
    return edges[:, :-1].ravel(), edges[:, 1:].ravel()


class _Cells:
    """Bounds on cells of a plan's interval, and the minimum clearance so far."""

    def __init__(self, plan: Trajectory, obstacles: tuple[Obstacle, ...], load: float, rope: Rope | None) -> None:
        self.plan, self.obstacles, self.load, self.rope = plan, obstacles, load, rope
        self.order = 2 if rope is None else max(2, rope.order + 1)
        self.peaks = np.stack([plan.peak(nu) for nu in range(self.order + 2)])[:, :, None]
        self.minimum, self.where = np.inf, (0.0, 0, False)
        if rope is not None:
            slopes = np.asarray(rope.slopes(plan), dtype=float)
            if slopes.shape != (rope.order + 1, 2) or not (np.isfinite(slopes).all() and np.all(slopes >= 0.0)):
                raise ValueError(
                    f"slopes of the rope must be finite, at least 0 and of shape ({rope.order + 1}, 2), got {slopes}"
                )
            self.slopes = slopes[:, :, None]

    def bound(self, left: Array, right: Array) -> Array:
        """Lower bound (ncells,) of the clearance in each cell."""
        centre, half = 0.5 * (left + right), 0.5 * (right - left)
        jet = self.plan.jet(centre, self.order)
        # Within a cell the change of a derivative is bounded by the next one's value at the centre and its slope.
        bounds = np.minimum(self.peaks[:-1], np.abs(jet) + half * self.peaks[1:])
        speed, acceleration = np.hypot(*bounds[1]), np.hypot(*bounds[2])
        ends = self.plan.jet(left, 0)[0], self.plan.jet(right, 0, left=True)[0]
        away = self.load + 0.5 * half**2 * acceleration
        chords = np.stack([thing.segment_distance(*ends) for thing in self.obstacles])
        bound: Array = chords.min(axis=0) - away
        for t, points in zip((left, right, centre), (*ends, jet[0]), strict=True):
            self._meet(t, np.stack([thing.distance(points) for thing in self.obstacles]) - self.load, False)
        if self.rope is not None:
            order = self.rope.order
            top = self.rope.top(jet[: order + 1])
            moves = half * np.maximum(speed, np.sum(self.slopes * bounds[1 : order + 2], axis=(0, 1)))
            values = np.stack([thing.segment_distance(top, jet[0]) for thing in self.obstacles])
            self._meet(centre, values, True)
            bound = np.minimum(bound, values.min(axis=0) - moves)
        return bound

    def _meet(self, t: Array, values: Array, rope: bool) -> None:
        """Update the minimum with values (nobstacles, ntime)."""
        if not np.isfinite(values).all():
            raise ValueError("distances must be finite over the plan, got nan or inf")
        obstacle, at = np.unravel_index(np.argmin(values), values.shape)
        if values[obstacle, at] < self.minimum:
            self.minimum, self.where = float(values[obstacle, at]), (float(t[at]), int(obstacle), rope)

    def result(self, lower: float, required: float | None, certified: bool | None) -> Clearance:
        time, obstacle, rope = self.where
        x, z = self.plan(time).tolist()
        # Coordinates and distances are rounded; the bound is rounded down.
        safe = min(lower, self.minimum) - 32.0 * float(np.finfo(float).eps) * max(
            self.peaks[0].max(), abs(self.minimum)
        )
        return Clearance(safe, self.minimum, time, (x, z), obstacle, "rope" if rope else "load", required, certified)
