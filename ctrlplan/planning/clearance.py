"""Certified clearance of a plan from obstacles over its whole interval."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import checked_finite, checked_number
from ctrlplan._display import Displayed, Facts, Part, number, time_text
from ctrlplan._renamed import FormerAttribute
from ctrlplan.planning.obstacles import Obstacle
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.batches import segment_bounds
from ctrlplan.trajectories.common import FACTORIALS, Array
from ctrlplan.trajectories.repeated import one_pass

_TIGHT = 1e-6  # relative gap between the bound and the attained minimum, unless a clearance is required
_TOGETHER = 512  # cells up to which their number does not matter for the time of one refinement
_FEWEST = 4  # cells of each segment at first
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
            ("at", f"{time_text(self.time)} s, position ({number(x)}, {number(z)})"),
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
    In a cell the load stays near the tangent at its centre, up to the further terms
    of the Taylor polynomial and a bound of its remainder; the ends of the rope move
    by at most the sum of these terms. The refinement ends when `required` is
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
    >>> found.certified, found.lower >= 1.4, found.part
    (True, True, 'load')
    >>> round(clearance(plan, [Disc((2.0, 3.0), 1.0)], load=0.5).minimum, 5)
    1.5
    """
    return clearance_within(_TIGHT, plan, obstacles, load, rope, required, max_cells)


def clearance_within(
    gap: float,
    plan: Trajectory,
    obstacles: Iterable[Obstacle],
    load: float,
    rope: Rope | None,
    required: float | None,
    max_cells: int = 200_000,
) -> Clearance:
    """Clearance as by `clearance`, within another gap between `lower` and `minimum`, relative to a minimum above 1."""
    things = checked_obstacles(obstacles)
    radius = checked_finite(load, "load", minimum=0.0)
    goal = None if required is None else checked_number(required, "required")
    checked_rope(rope)
    if plan.naxes != 2:
        raise ValueError(f"a plan among obstacles must have two axes, got {plan.naxes}")
    plan = one_pass(plan)
    if not plan.duration:
        raise ValueError("a trajectory must have a duration for its clearance, got a step")
    search = _Search(plan, things, radius, rope)
    slack = _ROUNDING * max(search.size, abs(goal or 0.0))
    cells = search.cells(max(_TOGETHER // (8 * search.durations.size), _FEWEST))
    lower, spent = np.inf, 0
    while cells.centre.size:
        spent += cells.centre.size
        bound = search.bound(cells)
        minimum = search.minimum
        target = minimum - gap * max(1.0, abs(minimum)) if goal is None or minimum < goal - slack else goal - slack
        open_ = bound < target
        if spent + 2 * np.count_nonzero(open_) > max_cells:
            if goal is not None and minimum >= goal - slack:
                raise ValueError(
                    f"the clearance must be decided within {max_cells} cells, got a bound of {bound.min():.6g} and a "
                    f"minimum of {minimum:.6g} where {goal:g} is required; increase max_cells or reduce required"
                )
            open_[:] = False
        lower = min(lower, float(bound[~open_].min(initial=np.inf)))
        cells = cells.divided(open_, min(_TOGETHER, max_cells - spent))
    return search.result(lower, goal, None if goal is None else lower >= goal - slack)


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


class _Cells(NamedTuple):
    """Cells of segments.

    Attributes
    ----------
    segment : ndarray of int, shape (ncells,)
        Segment of each cell.
    centre, half : ndarray, shape (ncells,)
        Time [s] of the centre since the start of the segment, and half of the duration.
    """

    segment: NDArray[np.intp]
    centre: Array
    half: Array

    def divided(self, chosen: NDArray[np.bool_], maximum: int) -> _Cells:
        """Chosen cells divided in two, or in eight or 64 if these are not more than a maximum."""
        segment, centre, half = self.segment[chosen], self.centre[chosen], self.half[chosen]
        parts = next((own for own in (64, 8) if own * segment.size <= maximum), 2)
        own = np.repeat(half / parts, parts)
        shares = np.arange(1 - parts, parts, 2)
        return _Cells(np.repeat(segment, parts), (np.repeat(centre, parts) + own * np.tile(shares, segment.size)), own)


class _Search:
    """Bounds on cells of a plan's segments, and the minimum clearance so far."""

    def __init__(self, plan: Trajectory, obstacles: tuple[Obstacle, ...], load: float, rope: Rope | None) -> None:
        self.plan, self.obstacles, self.load, self.rope = plan, obstacles, load, rope
        self.order = 2 if rope is None else max(2, rope.order + 1)
        self.durations = np.diff(plan.breakpoints)
        self.minimum = np.inf
        every = np.arange(self.durations.size)
        ends = np.concatenate([0.0 * self.durations, self.durations])
        points = plan.segments_jet(np.concatenate([every, every]), ends, 0)[0]
        scale = np.abs(points).max(axis=1)
        self._top = segment_bounds(plan, self.order + 1, scale / plan.duration ** (self.order + 1))
        if not np.isfinite(self._top).all():
            raise ValueError(f"derivatives must be finite to order {self.order + 1}, got inf or nan over the plan")
        self.size = float(scale.max())
        times = np.concatenate([plan.breakpoints[:-1], plan.breakpoints[1:]])
        self._meet(times, points, np.stack([thing.distance(points) for thing in obstacles]) - load, "load")
        if rope is not None:
            slopes = np.asarray(rope.slopes(plan), dtype=float)
            if slopes.shape != (rope.order + 1, 2) or not (np.isfinite(slopes).all() and np.all(slopes >= 0.0)):
                raise ValueError(
                    f"slopes of the rope must be finite, at least 0 and of shape ({rope.order + 1}, 2), got {slopes}"
                )
            self._slopes = slopes[:, :, None]

    def cells(self, parts: int) -> _Cells:
        """As many cells of each segment."""
        half = np.repeat(self.durations / (2 * parts), parts)
        count = self.durations.size
        return _Cells(np.repeat(np.arange(count), parts), half * np.tile(np.arange(1, 2 * parts, 2), count), half)

    def bound(self, cells: _Cells) -> Array:
        """Lower bound (ncells,) of the clearance in each cell."""
        segment, centre, half = cells
        jet = self.plan.segments_jet(segment, centre, self.order)
        times = self.plan.breakpoints[segment] + centre
        self.size = max(self.size, float(np.abs(jet[0]).max()))
        # Terms of the Taylor polynomials at the end of the cell, the last of them a bound of the remainder.
        sizes = np.concatenate([np.abs(jet), self._top[None, :, segment]])
        powers = half ** np.arange(self.order + 2)[:, None] / FACTORIALS[: self.order + 2, None]
        reach = half * jet[1]
        along = [thing.segment_distance(jet[0] - reach, jet[0] + reach) for thing in self.obstacles]
        bent = np.einsum("kat,kt->at", sizes[2:], powers[2:])
        bound: Array = np.min(along, axis=0) - (self.load + np.hypot(*bent))
        self._meet(times, jet[0], np.stack([thing.distance(jet[0]) for thing in self.obstacles]) - self.load, "load")
        if self.rope is not None:
            order = self.rope.order
            changes = np.stack(
                [np.einsum("kat,kt->at", sizes[nu + 1 :], powers[1 : len(sizes) - nu]) for nu in range(order + 1)]
            )
            moves = np.maximum(np.hypot(*changes[0]), np.sum(self._slopes * changes, axis=(0, 1)))
            top = self.rope.top(jet[: order + 1])
            values = np.stack([thing.segment_distance(top, jet[0]) for thing in self.obstacles])
            self._meet(times, jet[0], values, "rope")
            bound = np.minimum(bound, values.min(axis=0) - moves)
        return bound

    def _meet(self, times: Array, points: Array, values: Array, part: Literal["load", "rope"]) -> None:
        """Update the minimum with values (nobstacles, ntime) at positions (2, ntime)."""
        if not np.isfinite(values).all():
            raise ValueError("distances must be finite over the plan, got nan or inf")
        obstacle, at = divmod(int(np.argmin(values)), times.size)
        if values[obstacle, at] < self.minimum:
            self.minimum = float(values[obstacle, at])
            x, z = points[:, at].tolist()
            self._where = (float(times[at]), (x, z), obstacle, part)

    def result(self, lower: float, required: float | None, certified: bool | None) -> Clearance:
        """Clearance with a lower bound, which is rounded down."""
        # Coordinates and distances are rounded.
        safe = min(lower, self.minimum) - 32.0 * float(np.finfo(float).eps) * max(self.size, abs(self.minimum))
        return Clearance(safe, self.minimum, *self._where, required, certified)
