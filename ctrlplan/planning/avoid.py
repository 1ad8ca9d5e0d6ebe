"""Obstacle avoidance by automatically inserted via points."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import trapezoid
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ctrlplan._checks import check_kind, checked_count, checked_finite
from ctrlplan._display import Displayed, Facts, Figure, Part, time_text, title_of
from ctrlplan._renamed import warn_renamed
from ctrlplan.planning.clearance import Clearance, Rope, checked_obstacles, checked_rope, clearance_within
from ctrlplan.planning.clearance import clearance as certified_clearance
from ctrlplan.planning.inequalities import minimised
from ctrlplan.planning.objectives import plan_length
from ctrlplan.planning.obstacles import Obstacle
from ctrlplan.trajectories import PiecewiseSpline, Trajectory, Waypoint, WaypointSpline
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.trajectory import check_end
from ctrlplan.trajectories.waypoint import waypoint_table

Build = Callable[[Iterable[Waypoint]], WaypointSpline]
Pairs = NDArray[np.intp]
Mask = NDArray[np.bool_]

_MAXIMUM_CLASSES = 3  # maximum number of homotopy classes that are tried,
_DETOUR = 1.5  # with lengths up to this multiple of the shortest path
_LONG = 2.0  # length relative to the shortest path above which a warning is issued
_GIVEN = 1e-4  # gap between the bounds of the clearance of a given plan that violates the required one
_SAMPLES = 257
_WINDOW = 8  # samples per constraint, which is on their minimum,
_FINE = 4  # with finer ones in between
_POINTS = 4  # maximum number of via points, or one more than there are corners
_TRIES = 8  # optimisations with the same via points and further samples
_WIDER = 0.01  # extra clearance of a second path, relative to the path length
_NARROW = 0.1, 0.5  # parts of the clearance without which paths through narrow gaps are tried,
_SHORTER = 0.95  # if they are shorter than this multiple of the others
_NEARLY = 0.01  # part of the clearance that may be missing in a gap of which a warning is issued
_STEP = 1e-7  # step of finite differences, for unknowns of magnitude 1


@dataclass(frozen=True, eq=False, repr=False)
class Avoidance(Displayed):
    """Plan with certified clearance from obstacles, see `avoid`.

    For one release it can be used as the plan itself, with a FutureWarning.

    Attributes
    ----------
    plan : Trajectory
        The plan.
    clearance : Clearance
        Certified clearance over the whole plan.
    """

    plan: Trajectory
    clearance: Clearance

    __array_ufunc__ = None

    def _describe(self) -> Iterator[Part]:
        yield f"{title_of(self.plan)}, clearance at least {self.clearance.lower:.6g}"
        yield Facts(self.clearance.facts())
        if self.plan.waypoints:
            yield waypoint_table(self.plan.waypoints, self.plan.labels)
        yield Figure("Position and velocity of the plan over time.", 2, lambda axes: self.plan.plot(ax=axes))

    def _as_plan(self) -> Trajectory:
        warn_renamed("avoid(...) used as a plan", "avoid(...).plan")
        return self.plan

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or not hasattr(self.plan, name):
            raise AttributeError(f"an Avoidance has the attributes plan and clearance, got {name!r}")
        return getattr(self._as_plan(), name)

    def __call__(self, t: ArrayLike, nu: int = 0) -> Array:
        """Value of the plan, or its nu-th derivative; as ``avoid(...).plan``."""
        return self._as_plan()(t, nu)

    def __add__(self, other: Trajectory) -> Trajectory:
        return self._as_plan() + other

    def __sub__(self, other: Trajectory) -> Trajectory:
        return self._as_plan() - other

    def __mul__(self, factor: float) -> Trajectory:
        return self._as_plan() * factor

    __rmul__ = __mul__

    def __truediv__(self, factor: float) -> Trajectory:
        return self._as_plan() / factor

    def __neg__(self) -> Trajectory:
        return -self._as_plan()


WaypointSpline.register(Avoidance)


def avoid(
    plan: Trajectory,
    obstacles: Iterable[Obstacle],
    *,
    clearance: float = 0.0,
    load: float = 0.0,
    rope: Rope | None = None,
    max_points: int | None = None,
) -> Avoidance:
    r"""Plan through the same waypoints that avoids obstacles.

    The shortest polyline of each homotopy class of paths around the obstacles
    gives initial via points. Their positions and times are optimised for minimum
    roughness, and further via points are inserted where the plan is too near to
    an obstacle. Of the plans with certified clearance over the whole interval,
    that of minimum roughness is returned: one of the class of the given plan, or
    otherwise a `PiecewiseSpline`. With T the duration and L the path length of
    the given plan, the roughness is

    .. math:: \frac{T^5}{720 L^2} \int |p'''|^2 dt + \frac{1}{L} \int |p'| dt

    Other constraints of a plant (`Crane.check`) are not considered. To keep a
    load below its trolley, add a half-plane above it.

    Parameters
    ----------
    plan : Trajectory
        Plan of two axes, which is returned if it has the clearance. Otherwise it
        must be a `WaypointSpline`, such as `PolySpline`, with independent axes;
        the times and entries of its waypoints are preserved.
    obstacles : iterable of Obstacle
        One or more.
    clearance : float, optional
        Required clearance, at least 0.
    load : float, optional
        Radius of the load.
    rope : Rope, optional
        Straight rope, such as `Crane.rope()`, which must have the clearance as
        well.
    max_points : int, optional
        Maximum number of inserted via points. Default: one more than the shortest
        path has corners, and at least 4.

    Returns
    -------
    Avoidance
        With the attributes plan and clearance, a `Clearance`.

    Raises
    ------
    ValueError
        If a waypoint, or its rope if the waypoint determines it, is too near to
        an obstacle; or if no plan is found, with the maximum clearance found and
        its position, time and obstacle.
    TypeError
        If the plan is too near to an obstacle and is not a `WaypointSpline` (an
        S-curve, a shaped plan, a sum of plans), or if an object is not an
        obstacle.

    Warns
    -----
    UserWarning
        If the path is more than twice as long as the shortest path around the
        obstacles, or if a shorter one leads through a gap whose width is that
        required up to 1 % of the clearance, but no plan is found in it.

    Examples
    --------
    >>> from ctrlplan.planning.obstacles import Disc
    >>> from ctrlplan.trajectories import PolySpline
    >>> start, goal = Waypoint(0, [0, 0], 0, 0), Waypoint(4, [10, 0], 0, 0)
    >>> found = avoid(PolySpline([start, goal]), [Disc((5.0, 1.0), 2.0)], clearance=0.5)
    >>> type(found.plan).__name__, len(found.plan.waypoints), bool(found.plan(2.0)[1] < -1.49)
    ('PolySpline', 3, True)
    >>> found.clearance.certified
    True
    """
    task = _Task(
        _checked_plan(plan),
        checked_obstacles(obstacles),
        checked_finite(clearance, "clearance", minimum=0.0),
        checked_finite(load, "load", minimum=0.0),
        checked_rope(rope),
        None if max_points is None else checked_count(max_points, "max_points", 1),
    )
    task.check_waypoints()
    if task.given.certified:
        return Avoidance(plan, task.given)
    best = task.given
    spline = _rebuildable(task)
    for build in _kinds(spline):
        # After a near miss again from paths with more clearance.
        for extra in (0.0, _WIDER * task.size):
            if extra and task.required - best.minimum > extra:
                break
            polylines, found = _polylines(task, extra), []
            for polyline in polylines:
                reached, certificate = _search(task, build, polyline)
                if certificate.certified:
                    found.append(Avoidance(reached, certificate))
                elif certificate.lower > best.minimum:  # beyond rounding; in a tie the earlier plan is retained
                    best = certificate
            if found:
                shortest = sum(map(_length, polylines[0]))
                found += _through_gap(task, build, shortest)
                smoothest = min(found, key=lambda avoidance: task.roughness(avoidance.plan))
                _check_length(smoothest.plan, shortest)
                return smoothest
    if best is task.given:
        best = task.certificate(plan)
    x, z = best.position
    points = "with " if task.max_points is None else f"with {task.max_points} via points or fewer and "
    raise ValueError(
        f"no plan {points}a clearance of {task.required:g} was found: "
        f"the maximum clearance is {best.minimum:.4g}, of the {best.part} from obstacles[{best.obstacle}] "
        f"with the load at ({x:.4g}, {z:.4g}) at {best.time:.4g} s; the search does not find every plan: "
        f"add waypoints, increase max_points or reduce the clearance"
    )


def _through_gap(task: _Task, build: Build, shortest: float) -> list[Avoidance]:
    """Plan through a gap about as wide as required, if that is a shorter way; warns if none is found in it.

    Polygons around obstacles block gaps that are slightly wider than required.
    """
    distance = task.load + task.required
    for part in _NARROW:
        polyline = _polylines(task, -part * distance)[0]
        length = sum(map(_length, polyline))
        if length < _SHORTER * shortest:
            break
    else:
        return []
    plan, certificate = _search(task, build, polyline)
    if certificate.certified:
        return [Avoidance(plan, certificate)]
    nearly = sum(map(_length, _polylines(task, -_NEARLY * distance)[0])) < _SHORTER * shortest
    if nearly or task.required - certificate.minimum < _NEARLY * distance:
        warnings.warn(
            f"a path of length {length:.4g} leads through a gap that is about as wide as the required clearance of "
            f"{task.required:g}, but no plan with this clearance was found in it, so that another path is taken, of "
            f"length {shortest:.4g}; reduce the clearance slightly, or add a waypoint in the gap",
            stacklevel=3,
        )
    return []


def _check_length(plan: Trajectory, shortest: float) -> None:
    length = plan_length(plan)
    if length > _LONG * shortest:
        warnings.warn(
            f"the path found is {length:.4g} long, {length / shortest:.2g} times the shortest path around obstacles: "
            f"a local optimum; add waypoints, or prescribe fewer derivatives",
            stacklevel=3,
        )


@dataclass(frozen=True)
class _Task:
    """Requirements, and the evaluation of candidates."""

    plan: Trajectory
    obstacles: tuple[Obstacle, ...]
    required: float
    load: float
    rope: Rope | None
    max_points: int | None

    @cached_property
    def points(self) -> Array:
        """Positions of the waypoints, shape (2, npoints)."""
        return np.stack([w.position for w in self.plan.waypoints], axis=1)

    @cached_property
    def times(self) -> Array:
        """Their times, shape (npoints,)."""
        return np.array([w.time for w in self.plan.waypoints])

    @cached_property
    def given(self) -> Clearance:
        """Clearance of the given plan; where it violates the required one, for comparisons only."""
        return clearance_within(_GIVEN, self.plan, self.obstacles, self.load, self.rope, self.required)

    @cached_property
    def size(self) -> float:
        """Path length of the given plan."""
        path = self.plan(np.linspace(self.plan.start, self.plan.end, _SAMPLES))
        return float(np.hypot(*np.diff(path)).sum()) or 1.0

    def check_waypoints(self) -> None:
        """Raise for waypoints that are too near to an obstacle."""
        if not self.plan.waypoints:
            return
        slack = 1e-9 * float(np.abs(self.points).max())
        for i, point in enumerate(self.plan.waypoints):
            jet = point.jet[:, :, None]
            for j, thing in enumerate(self.obstacles):
                gap = float(thing.distance(jet[0])[0])
                if gap - self.load < self.required - slack:
                    what = f"lies {-gap:.4g} inside" if gap < 0.0 else f"is {gap - self.load:.4g} from"
                    raise ValueError(
                        f"the load must have a clearance of {self.required:g} at each waypoint, "
                        f"got waypoints[{i}] that {what} obstacles[{j}]"
                    )
                if self.rope is None or len(jet) <= self.rope.order:
                    continue
                jet = jet[: self.rope.order + 1]
                if not np.isfinite(jet).all():
                    continue
                gap = float(thing.segment_distance(self.rope.top(jet), jet[0])[0])
                if gap < self.required - slack:
                    raise ValueError(
                        f"the rope must have a clearance of {self.required:g} at each waypoint, "
                        f"got {gap:.4g} from obstacles[{j}] at waypoints[{i}]"
                    )

    def certificate(self, plan: Trajectory) -> Clearance:
        return certified_clearance(plan, self.obstacles, load=self.load, rope=self.rope, required=self.required)

    def clearances(self, jet: Array) -> Array:
        """Clearances (nvalues, ...) of the load, then of the rope, from jets (order + 1, 2, ...)."""
        found = [thing.distance(jet[0]) - self.load for thing in self.obstacles]
        if self.rope is not None:
            top = self.rope.top(jet[: self.rope.order + 1])
            found += [thing.segment_distance(top, jet[0]) for thing in self.obstacles]
        return np.stack(found)

    def roughness(self, plan: Trajectory) -> float:
        t = np.linspace(self.plan.start, self.plan.end, _SAMPLES)
        return float(_roughness(t, plan.jet(t, 3), self.size))


def _roughness(t: Array, jet: Array, size: float) -> Array:
    """Roughness as in the docstring of `avoid`, by the trapezoidal rule, from jets (order + 1, 2, ..., ntime)."""
    duration = t[-1] - t[0]
    jerk = trapezoid(np.sum(jet[3] ** 2, axis=0), t)
    return np.asarray(duration**5 / (720.0 * size**2) * jerk + trapezoid(np.hypot(*jet[1]), t) / size)


def _checked_plan(plan: Trajectory) -> Trajectory:
    check_kind(plan, "plan", Trajectory)
    check_end(plan)
    if plan.naxes != 2:
        raise ValueError(f"a plan among obstacles must have two axes, got {plan.naxes}")
    if not plan.duration:
        raise TypeError(f"plan must be a spline through waypoints with a duration, got a {type(plan).__name__}")
    if isinstance(plan, WaypointSpline):
        if plan.end != plan.waypoints[-1].time:
            last = plan.waypoints[-1].time
            raise ValueError(f"plan must end at its last waypoint, at {time_text(last)} s, got {time_text(plan.end)} s")
        for i, point in enumerate(plan.waypoints):
            if np.isnan(point.position).any():
                place = f"waypoints[{i}] with {point.position}"
                raise ValueError(f"positions must be prescribed on both axes, got {place}")
    return plan


def _rebuildable(task: _Task) -> WaypointSpline:
    """The given plan, checked to be a spline that can be rebuilt through further waypoints."""
    plan = task.plan
    if not isinstance(plan, WaypointSpline):
        given = task.certificate(plan)
        raise TypeError(
            f"plan must be a WaypointSpline, such as PolySpline, to be led around obstacles, "
            f"got a {type(plan).__name__} with a clearance of {given.minimum:.4g} from obstacles[{given.obstacle}] at "
            f"{given.time:.4g} s; use a spline through the same waypoints, and shape or combine the result"
        )
    return plan


def _kinds(plan: WaypointSpline) -> Iterator[Build]:
    """Functions that build plans through other waypoints: of the same class, then with minimum-jerk segments."""
    yield plan.quiet().through
    if not (isinstance(plan, PiecewiseSpline) and plan.alpha == 0.0):
        yield lambda points: PiecewiseSpline(points, labels=plan.labels, warn=False)


# Polylines around the obstacles


def _polylines(task: _Task, extra: float = 0.0) -> list[list[Array]]:
    """Shortest polyline of each homotopy class as corners (2, n) by segment, with waypoints; the shortest first.

    With the clearance and an extra distance, or without both if there is none.
    """
    for margin in ((1.0 + 1e-3) * (task.load + task.required) + extra, 0.0):
        # If the required clearance is impossible, the maximum clearance found is still reported.
        nodes, edges = _visible(task, margin)
        found = {}
        for barred in _barred(task, nodes, edges, margin):
            polyline = _shortest(nodes, edges[:, ~barred], task.times.size)
            if polyline:
                found[np.concatenate(polyline, axis=1).tobytes()] = sum(map(_length, polyline)), polyline
        if found:
            polylines = sorted(found.values(), key=lambda pair: pair[0])
            longest = _DETOUR * polylines[0][0]
            return [polyline for length, polyline in polylines[:_MAXIMUM_CLASSES] if length <= longest]
    return [[task.points[:, k : k + 2] for k in range(task.times.size - 1)]]


def _length(line: Array) -> float:
    return float(np.hypot(*np.diff(line)).sum())


def _visible(task: _Task, margin: float) -> tuple[Array, Pairs]:
    """Nodes of the visibility graph, the waypoints first, and its edges."""
    nodes = np.concatenate([task.points, *(thing.corners(margin) for thing in task.obstacles)], axis=1)
    reach = margin - 1e-9 * float(np.abs(nodes).max())
    clear = np.all([thing.distance(nodes) >= reach for thing in task.obstacles], axis=0)
    clear[: task.times.size] = True
    nodes = nodes[:, clear]
    pairs = np.stack(np.triu_indices(nodes.shape[1], 1))
    # A waypoint may be nearer to an obstacle than the corners by their rounding.
    reach -= 2e-3 * margin
    seen = [thing.segment_distance(*(nodes[:, end] for end in pairs)) >= reach for thing in task.obstacles]
    pairs = pairs[:, np.all(seen, axis=0)]
    if task.rope is None:
        return nodes, pairs
    p, q = (nodes[:, end, None] for end in pairs)
    jet = np.zeros((task.rope.order + 1, 2, p.shape[1], 33))
    jet[0] = p + np.linspace(0.0, 1.0, 33) * (q - p)
    hanging = task.clearances(jet)[len(task.obstacles) :].min(axis=(0, 2))
    return nodes, pairs[:, hanging >= min(task.required, reach)]


def _barred(task: _Task, nodes: Array, edges: Pairs, margin: float) -> Iterator[Mask]:
    """Barred edges of each homotopy class: those that cross a ray from inside an obstacle to one side or the other."""
    none = np.zeros(edges.shape[1], dtype=bool)
    x, z = task.points[:, -1] - task.points[:, 0]
    across = np.array([-z, x]) if x or z else np.array([0.0, 1.0])
    rays = []
    for thing in task.obstacles:
        corners = thing.corners(margin)
        if not corners.size or not thing.distance(corners.mean(axis=1)) < 0.0:
            continue
        p, q = (nodes[:, end] - corners.mean(axis=1)[:, None] for end in edges)
        left, right = (across[0] * v[1] - across[1] * v[0] for v in (p, q))
        cut = (left < 0.0) != (right < 0.0)
        share = np.divide(left, left - right, out=np.zeros_like(left), where=cut)
        ahead = across @ (p + share * (q - p)) > 0.0
        rays.append((cut & ahead, cut & ~ahead))
    choices = itertools.product(*rays) if len(rays) <= 5 else ((ray,) for pair in rays for ray in pair)
    yield none
    yield from (np.any([none, *choice], axis=0) for choice in choices)


def _shortest(nodes: Array, edges: Pairs, npoints: int) -> list[Array]:
    """Shortest polyline from each waypoint to the next; empty if one cannot be reached."""
    lengths = np.hypot(*(nodes[:, edges[1]] - nodes[:, edges[0]]))
    # csgraph of scipy 1.14 accepts 32-bit indices only.
    graph = csr_array((lengths, tuple(edges.astype(np.int32))), shape=(nodes.shape[1],) * 2)
    far, before = dijkstra(graph, directed=False, indices=range(npoints - 1), return_predecessors=True)
    polyline = []
    for segment in range(npoints - 1):
        passed = [segment + 1]
        while passed[-1] != segment:
            if not np.isfinite(far[segment, segment + 1]):
                return []
            passed.append(before[segment, passed[-1]])
        polyline.append(nodes[:, passed[::-1]])
    return polyline


# Via points: from the corners of a polyline to a certified plan


@dataclass(frozen=True)
class _Vias:
    """Via points in order of time, with their segments and positions."""

    segments: NDArray[np.intp]
    times: Array
    positions: Array

    def inserted(self, task: _Task, time: float, position: Array) -> _Vias:
        at, segment = int(np.searchsorted(self.times, time)), int(np.searchsorted(task.times, time)) - 1
        return _Vias(
            np.insert(self.segments, at, segment),
            np.insert(self.times, at, time),
            np.insert(self.positions, at, position, axis=1),
        )


def _search(task: _Task, build: Build, polyline: list[Array]) -> tuple[Trajectory, Clearance]:
    """Certified plan along a polyline, or the plan of maximum clearance."""
    vias = _timed(task, build, _first(task, polyline))
    limit = max(_POINTS, vias.times.size + 1) if task.max_points is None else task.max_points
    best: Trajectory = task.plan
    nearest, idle = task.given, 0
    while True:
        plan: Trajectory = task.plan
        found, before = task.given, nearest.minimum
        margin = fine = 3e-4 * task.size
        extra: list[float] = []
        for _ in range(_TRIES):
            try:
                vias, violation = _moved(task, build, vias, margin, extra)
                plan = _through(task, build, vias)
                found = task.certificate(plan)
            except ValueError:  # no plan of this class through these points, or a slack rope
                break
            if found.certified:
                return plan, found
            if found.minimum > nearest.minimum:
                best, nearest = plan, found
            if violation > margin:  # at the samples themselves
                break
            # Between the samples: at a corner the error is of the size of their distance.
            extra.append(found.time)
            margin += min(0.3 * max(task.required - found.minimum, 0.0), fine)
        # Two further via points may be required before the clearance increases.
        idle = idle + 1 if found is not task.given and nearest.minimum < before + fine else 0
        if idle > 1 or vias.times.size >= limit:
            return best, nearest
        time = _apart(task, vias, found.time)
        vias = vias.inserted(task, time, plan(time))


def _first(task: _Task, polyline: list[Array]) -> _Vias:
    """Sharpest corners of a polyline, at times in proportion to its length; without corners, its worst point."""
    vias = _Vias(np.empty(0, dtype=np.intp), np.empty(0), np.empty((2, 0)))
    lines = list(polyline)
    while True:
        bends: dict[tuple[int, int], float] = {}
        for segment, line in enumerate(lines):
            steps, chords = np.hypot(*np.diff(line)), np.hypot(*(line[:, 2:] - line[:, :-2]))
            bends |= {(segment, k): bend for k, bend in enumerate((steps[1:] + steps[:-1] - chords).tolist(), 1)}
        minimum = min(bends.values(), default=0.0)
        if len(bends) < 2 or (len(bends) <= (task.max_points or len(bends)) and minimum > 0.01 * task.size):
            break
        segment, k = min(bends, key=lambda corner: bends[corner])
        lines[segment] = np.delete(lines[segment], k, axis=1)
    for segment, k in bends:
        run = np.cumsum(np.hypot(*np.diff(lines[segment])))
        begin, end = task.times[segment : segment + 2]
        time = _apart(task, vias, begin + (end - begin) * run[k - 1] / run[-1])
        vias = vias.inserted(task, time, lines[segment][:, k])
    if not bends:
        time = _apart(task, vias, task.given.time)
        segment = int(np.searchsorted(task.times, time)) - 1
        begin, end = task.times[segment : segment + 2]
        vias = vias.inserted(task, time, lines[segment] @ np.array([end - time, time - begin]) / (end - begin))
    return vias


def _apart(task: _Task, vias: _Vias, time: float) -> float:
    """Time moved away from the neighbouring waypoints and via points."""
    knots = np.sort(np.concatenate([task.times, vias.times]))
    after = int(np.clip(np.searchsorted(knots, time), 1, knots.size - 1))
    a, b = knots[after - 1 : after + 1].tolist()
    return float(np.clip(time, 0.9 * a + 0.1 * b, 0.1 * a + 0.9 * b))


def _through(task: _Task, build: Build, vias: _Vias) -> WaypointSpline:
    return build(_points(task, vias))


def _points(task: _Task, vias: _Vias) -> list[Waypoint]:
    """Waypoints with via points, in order of time."""
    added = [Waypoint(t, p) for t, p in zip(vias.times.tolist(), vias.positions.T, strict=True)]
    labels = task.plan.waypoints[0].labels
    if labels is not None:
        added = [Waypoint.from_jets(w.time, **{n: [v] for n, v in zip(labels, w.position, strict=True)}) for w in added]
    return sorted([*task.plan.waypoints, *added], key=lambda w: w.time)


def _moved(task: _Task, build: Build, vias: _Vias, margin: float, extra: Sequence[float]) -> tuple[_Vias, float]:
    """Via points of minimum roughness subject to the clearance at samples, and the largest violation there.

    The unknowns are the positions in units of the size, and the logarithms of the
    relative durations within a segment (0 for the last one). `extra` are further
    samples.
    """
    x, missed = minimised(_Scene(task, build, vias, margin, extra), _encoded(task, vias))
    return _decoded(task, vias, x), missed * task.size


def _timed(task: _Task, build: Build, vias: _Vias) -> _Vias:
    """Via points at the times of minimum roughness: between corners at other times a spline of high degree swings."""
    scene, x = _Scene(task, build, vias, 0.0, ()), _encoded(task, vias)
    places = 2 * vias.times.size
    try:
        x[places:], _ = minimised(_Times(scene, x[:places]), x[places:], accuracy=1e-2)
    except ValueError:  # no plan of this class through these points
        return vias
    return _decoded(task, vias, x)


class _Scene:
    """Roughness as a sum of squares, and clearances at samples, as functions of the unknowns of `_moved`."""

    def __init__(self, task: _Task, build: Build, vias: _Vias, margin: float, extra: Sequence[float]) -> None:
        self._task, self._build, self._vias = task, build, vias
        fine = np.linspace(task.plan.start, task.plan.end, _FINE * (_SAMPLES - 1) + 1)
        self._times = np.append(fine, extra)
        self._order = 3 if task.rope is None else max(3, task.rope.order)
        self._windows = np.append(np.arange(0, fine.size, _FINE * _WINDOW), np.arange(fine.size, self._times.size))
        # At the waypoints themselves the clearance may be just the required one.
        room = np.abs(self._times - task.times[:, None]).min(axis=0) / (0.05 * task.plan.duration)
        self._required = task.required + margin * np.minimum(1.0, room)

    def values(self, x: Array) -> tuple[Array, Array]:
        """Terms whose squares add up to the roughness, and excess clearances by window, relative to the size.

        Raises
        ------
        ValueError
            If there is no plan through these points.
        """
        return self._valued(self._jet(self._plan(x)))

    def slopes(self, x: Array, positions: bool = True) -> tuple[Array, Array]:
        """Derivatives (nvalues, nunknowns) of both, if wanted by positions also."""
        count = self._vias.segments.size
        plan, steps = self._plan(x), _STEP * np.eye(x.size)
        here = self._jet(plan)
        moved = []
        if positions:
            # The axes of a plan are independent: one plan gives the derivatives along both.
            both = np.stack(
                [self._jet(self._plan(x + steps[i] + steps[count + i], plan)) for i in range(count)], axis=2
            )
            moved.append(np.repeat(here[:, :, None], 2 * count, axis=2))
            moved[0][:, 0, :count], moved[0][:, 1, count:] = both[:, 0], both[:, 1]
        moved.append(np.stack([self._jet(self._plan(x + steps[2 * count + i])) for i in range(count)], axis=2))
        before, after = self._valued(here), self._valued(np.concatenate(moved, axis=2))
        return (after[0] - before[0][:, None]) / _STEP, (after[1] - before[1][:, None]) / _STEP

    def _plan(self, x: Array, same_times: WaypointSpline | None = None) -> WaypointSpline:
        """Plan of some unknowns; another one with the same times makes it faster."""
        points = _points(self._task, _decoded(self._task, self._vias, x))
        return self._build(points) if same_times is None else same_times.with_values(points)

    def _jet(self, plan: Trajectory) -> Array:
        return plan.jet(self._times, self._order)

    def _valued(self, jet: Array) -> tuple[Array, Array]:
        """As `values`, from jets (order + 1, 2, ..., ntime), with the trailing axis first."""
        size, duration = self._task.size, self._task.plan.duration
        weights = np.full(_SAMPLES, duration / (_SAMPLES - 1))
        weights[[0, -1]] *= 0.5
        on_grid = jet[..., : _FINE * (_SAMPLES - 1) + 1 : _FINE]
        speed = np.hypot(on_grid[1, 0], on_grid[1, 1])
        # Not differentiable at rest: rounded at a small fraction of the mean speed.
        path = np.sqrt(weights / size * np.hypot(speed, 1e-3 * size / duration))
        jerk = np.sqrt(weights * duration**5 / (720.0 * size**2)) * on_grid[3]
        terms = np.moveaxis(np.concatenate([jerk, path[None]]), -1, 1)
        rooms = np.minimum.reduceat(self._task.clearances(jet) - self._required, self._windows, axis=-1) / size
        return tuple(rows.reshape(-1, *jet.shape[2:-1]) for rows in (terms, np.moveaxis(rooms, -1, 1)))  # type: ignore[return-value]


@dataclass(frozen=True)
class _Times:
    """Roughness as a function of the logarithms of the relative durations, without obstacles."""

    scene: _Scene
    places: Array

    def values(self, x: Array) -> tuple[Array, Array]:
        """Terms of the roughness."""
        return self.scene.values(np.append(self.places, x))[0], np.ones(1)

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Derivatives of the terms."""
        return self.scene.slopes(np.append(self.places, x), positions=False)[0], np.zeros((1, x.size))


def _decoded(task: _Task, vias: _Vias, x: Array) -> _Vias:
    """Via points from the unknowns of `_moved`."""
    count, times = vias.segments.size, vias.times.copy()
    for segment in np.unique(vias.segments):
        here = vias.segments == segment
        shares = np.exp(np.append(x[2 * count : 3 * count][here], 0.0))
        begin, end = task.times[segment : segment + 2]
        times[here] = begin + (end - begin) * np.cumsum(shares)[:-1] / shares.sum()
    return _Vias(vias.segments, times, task.size * x[: 2 * count].reshape(2, count))


def _encoded(task: _Task, vias: _Vias) -> Array:
    """Unknowns of `_moved`."""
    logarithms = [_logarithms(task, vias, segment) for segment in np.unique(vias.segments)]
    return np.concatenate([vias.positions.ravel() / task.size, *logarithms])


def _logarithms(task: _Task, vias: _Vias, segment: int) -> Array:
    """Logarithms of the relative durations within a segment, relative to the last one."""
    shares = np.log(np.diff([task.times[segment], *vias.times[vias.segments == segment], task.times[segment + 1]]))
    return shares[:-1] - shares[-1]
