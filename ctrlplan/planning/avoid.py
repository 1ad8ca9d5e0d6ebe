"""A way around obstacles: via points that the designer need not give."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import trapezoid
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ctrlplan._checks import checked_count, checked_finite
from ctrlplan._display import Displayed, Facts, Figure, Part, title_of
from ctrlplan._renamed import warn_renamed
from ctrlplan.planning.clearance import Clearance, Rope, checked_obstacles, checked_rope
from ctrlplan.planning.clearance import clearance as certified_clearance
from ctrlplan.planning.objectives import plan_length
from ctrlplan.planning.obstacles import Obstacle
from ctrlplan.trajectories import PiecewiseSpline, Trajectory, Waypoint, WaypointSpline
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.waypoint import waypoint_table

Build = Callable[[Iterable[Waypoint]], Trajectory]
Pairs = NDArray[np.intp]
Mask = NDArray[np.bool_]

_WAYS = 3  # classes of ways round the obstacles that are tried,
_DETOUR = 1.5  # none longer than this many times the shortest
_LONG = 2.0  # times the shortest way, above which there is a warning
_SAMPLES = 257
_WINDOW = 8  # samples that share one constraint: their least
_TRIES = 3  # at a certificate with the same via points, each with more room
_STEP = 1e-7  # of differences, of unknowns about 1 in size
_PRICE = 3e2  # of a clearance missed by the length of the path, in units of the roughness at first


@dataclass(frozen=True, eq=False, repr=False)
class Avoidance(Displayed):
    """Plan that keeps clear of obstacles; made by `avoid`.

    For one release it can be used as the plan itself, with a FutureWarning.

    Attributes
    ----------
    plan : Trajectory
        The plan.
    clearance : Clearance
        Its certified clearance over the whole interval.
    """

    plan: Trajectory
    clearance: Clearance

    __array_ufunc__ = None

    def _describe(self) -> Iterator[Part]:
        yield f"{title_of(self.plan)}, clearance at least {self.clearance.lower:.6g}"
        yield Facts(self.clearance.facts())
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
    max_points: int = 4,
) -> Avoidance:
    r"""Plan through the same waypoints that keeps clear of obstacles.

    Shortest polylines, one a class of ways round the obstacles, give the first
    via points; positions and times of these are then moved to where the plan is
    least rough, and further ones inserted where it comes too near. Of the plans
    whose clearance is certified over the whole interval, the least rough is
    returned: of the kind given if there is one, otherwise a `PiecewiseSpline`.
    With T the duration and L the length of the given plan's path, the roughness
    is

    .. math:: \frac{T^5}{720 L^2} \int |p'''|^2 dt + \frac{1}{L} \int |p'| dt

    What a plant asks of a plan besides (`Crane.check`) is not looked at: that a
    load stays below its trolley takes a half-plane above.

    Parameters
    ----------
    plan : Trajectory
        Plan of two axes. The result has the plan itself if it keeps clear.
        Otherwise it must be made through waypoints, a `WaypointSpline` such as
        `PolySpline`, whose axes do not depend on each other; its waypoints are
        kept, all entries and times.
    obstacles : iterable of Obstacle
        One or more.
    clearance : float, optional
        Distance to keep, at least 0.
    load : float, optional
        Radius of the load.
    rope : Rope, optional
        Straight rope that must stay clear as well, such as `Crane.rope()`.
    max_points : int, optional
        Via points inserted at most.

    Returns
    -------
    Avoidance
        The plan, and its certified clearance.

    Raises
    ------
    ValueError
        If a waypoint is too near to an obstacle, or its rope where the waypoint
        settles it; or if no plan is found: with the best clearance reached,
        where, when, and to which obstacle.
    TypeError
        If the plan comes too near and is not made through waypoints (an S-curve,
        a shaped plan, a sum of plans), or an obstacle is none.

    Warns
    -----
    UserWarning
        If the path is more than twice as long as the shortest way round the
        obstacles.

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
        checked_count(max_points, "max_points", 1),
    )
    task.check_waypoints()
    if task.given.certified:
        return Avoidance(plan, task.given)
    best = task.given
    spline = _made_through_waypoints(task)
    ways = _ways(task)
    for build in _kinds(spline):
        found = []
        for way in ways:
            reached, certificate = _search(task, build, way)
            if certificate.certified:
                found.append(Avoidance(reached, certificate))
            elif certificate.lower > best.minimum:  # certainly better: rounding is a tie, and the earlier plan stays
                best = certificate
        if found:
            smoothest = min(found, key=lambda avoidance: task.roughness(avoidance.plan))
            _check_length(smoothest.plan, sum(map(_length, ways[0])))
            return smoothest
    x, z = best.position
    raise ValueError(
        f"no plan with {task.max_points} via points or fewer was found that keeps {task.wanted:g} from every obstacle: "
        f"the best keeps {best.minimum:.4g}, the {best.part} from obstacles[{best.obstacle}] "
        f"with the load at ({x:.4g}, {z:.4g}) at {best.time:.4g} s; plans may exist that the search does not find: "
        f"give via waypoints, more of them by max_points, or another clearance"
    )


def _check_length(plan: Trajectory, shortest: float) -> None:
    length = plan_length(plan)
    if length > _LONG * shortest:
        warnings.warn(
            f"the path found is {length:.4g} long, {length / shortest:.2g} times the shortest way round the obstacles: "
            f"a local optimum; give via waypoints, or prescribe fewer derivatives",
            stacklevel=3,
        )


@dataclass(frozen=True)
class _Task:
    """What is asked for, and what every candidate is measured by."""

    plan: Trajectory
    obstacles: tuple[Obstacle, ...]
    wanted: float
    load: float
    rope: Rope | None
    max_points: int

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
        """Clearance of the plan given."""
        return self.certificate(self.plan)

    @property
    def ngaps(self) -> int:
        """Number of clearances: of the load and of the rope, from each obstacle."""
        return len(self.obstacles) * (1 if self.rope is None else 2)

    @cached_property
    def size(self) -> float:
        """Length of the given plan's path."""
        path = self.plan(np.linspace(self.plan.start, self.plan.end, _SAMPLES))
        return float(np.hypot(*np.diff(path)).sum()) or 1.0

    def check_waypoints(self) -> None:
        """Refuse waypoints that are too near to an obstacle, whatever the way between them."""
        if not self.plan.waypoints:
            return
        slack = 1e-9 * float(np.abs(self.points).max())
        for i, point in enumerate(self.plan.waypoints):
            jet = point.jet[:, :, None]
            for j, thing in enumerate(self.obstacles):
                gap = float(thing.distance(jet[0])[0])
                if gap - self.load < self.wanted - slack:
                    what = f"lies {-gap:.4g} inside" if gap < 0.0 else f"keeps {gap - self.load:.4g} from"
                    raise ValueError(
                        f"the load must keep {self.wanted:g} from every obstacle at each waypoint, "
                        f"got waypoints[{i}] that {what} obstacles[{j}]"
                    )
                if self.rope is None or len(jet) <= self.rope.order:
                    continue
                jet = jet[: self.rope.order + 1]
                if not np.isfinite(jet).all():
                    continue
                gap = float(thing.segment_distance(self.rope.top(jet), jet[0])[0])
                if gap < self.wanted - slack:
                    raise ValueError(
                        f"the rope must keep {self.wanted:g} from every obstacle at each waypoint, "
                        f"got {gap:.4g} from obstacles[{j}] at waypoints[{i}]"
                    )

    def certificate(self, plan: Trajectory) -> Clearance:
        return certified_clearance(plan, self.obstacles, load=self.load, rope=self.rope, required=self.wanted)

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
    """What the docstring of `avoid` says, by the trapezoidal rule, from jets (order + 1, 2, ..., ntime)."""
    duration = t[-1] - t[0]
    jerk = trapezoid(np.sum(jet[3] ** 2, axis=0), t)
    return np.asarray(duration**5 / (720.0 * size**2) * jerk + trapezoid(np.hypot(*jet[1]), t) / size)


def _checked_plan(plan: Trajectory) -> Trajectory:
    if not isinstance(plan, Trajectory):
        raise TypeError(f"plan must be a Trajectory, got {type(plan).__name__}")
    if plan.naxes != 2:
        raise ValueError(f"a plan among obstacles must have two axes, got {plan.naxes}")
    if not plan.duration:
        raise TypeError(f"plan must have a duration, made through waypoints, got a {type(plan).__name__}")
    if isinstance(plan, WaypointSpline):
        if plan.end != plan.waypoints[-1].time:
            last = plan.waypoints[-1].time
            raise ValueError(f"plan must end at its last waypoint, at {last:g} s, got {plan.end:g} s")
        for i, point in enumerate(plan.waypoints):
            if np.isnan(point.position).any():
                place = f"waypoints[{i}] with {point.position}"
                raise ValueError(f"positions must be prescribed on both axes, got {place}")
    return plan


def _made_through_waypoints(task: _Task) -> WaypointSpline:
    """The plan given, of which others through further waypoints can be made."""
    plan, given = task.plan, task.given
    if not isinstance(plan, WaypointSpline):
        raise TypeError(
            f"plan must be made through waypoints to be led round obstacles (a WaypointSpline, such as PolySpline), "
            f"got a {type(plan).__name__} that keeps {given.minimum:.4g} from obstacles[{given.obstacle}] at "
            f"{given.time:.4g} s; plan a spline through the same points, and shape or combine the result"
        )
    return plan


def _kinds(plan: WaypointSpline) -> Iterator[Build]:
    """How plans through other waypoints are made: as the given one, then of minimum-jerk segments."""
    yield plan.quiet().through
    if not (isinstance(plan, PiecewiseSpline) and plan.alpha == 0.0):
        yield lambda points: PiecewiseSpline(points, labels=plan.labels, warn=False)


# Ways: polylines round the obstacles


def _ways(task: _Task) -> list[list[Array]]:
    """Shortest polyline of each homotopy class as corners (2, n) by segment, with waypoints; the shortest first."""
    for margin in ((1.0 + 1e-3) * (task.load + task.wanted), 0.0):
        # Where there is no room for what is wanted, how near a plan comes is still worth knowing.
        nodes, edges = _visible(task, margin)
        found = {}
        for barred in _barred(task, nodes, edges, margin):
            way = _shortest(nodes, edges[:, ~barred], task.times.size)
            if way:
                found[np.concatenate(way, axis=1).tobytes()] = sum(map(_length, way)), way
        if found:
            ways = sorted(found.values(), key=lambda pair: pair[0])
            return [way for length, way in ways[:_WAYS] if length <= _DETOUR * ways[0][0]]
    return [[task.points[:, k : k + 2] for k in range(task.times.size - 1)]]


def _length(line: Array) -> float:
    return float(np.hypot(*np.diff(line)).sum())


def _visible(task: _Task, margin: float) -> tuple[Array, Pairs]:
    """Nodes, the waypoints first, and the pairs of them that see each other."""
    nodes = np.concatenate([task.points, *(thing.corners(margin) for thing in task.obstacles)], axis=1)
    reach = margin - 1e-9 * float(np.abs(nodes).max())
    clear = np.all([thing.distance(nodes) >= reach for thing in task.obstacles], axis=0)
    clear[: task.times.size] = True
    nodes = nodes[:, clear]
    pairs = np.stack(np.triu_indices(nodes.shape[1], 1))
    # A waypoint may be nearer than the corners by what rounds them.
    reach -= 2e-3 * margin
    seen = [thing.segment_distance(*(nodes[:, end] for end in pairs)) >= reach for thing in task.obstacles]
    pairs = pairs[:, np.all(seen, axis=0)]
    if task.rope is None:
        return nodes, pairs
    p, q = (nodes[:, end, None] for end in pairs)
    jet = np.zeros((task.rope.order + 1, 2, p.shape[1], 33))
    jet[0] = p + np.linspace(0.0, 1.0, 33) * (q - p)
    hanging = task.clearances(jet)[len(task.obstacles) :].min(axis=(0, 2))
    return nodes, pairs[:, hanging >= min(task.wanted, reach)]


def _barred(task: _Task, nodes: Array, edges: Pairs, margin: float) -> Iterator[Mask]:
    """Edges barred, class by class: those that cross a ray to one side or the other from inside an obstacle."""
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
    """Shortest polyline from each waypoint to the next; none if one cannot be reached."""
    lengths = np.hypot(*(nodes[:, edges[1]] - nodes[:, edges[0]]))
    # csgraph of scipy 1.14 reads indices of 32 bits only.
    graph = csr_array((lengths, tuple(edges.astype(np.int32))), shape=(nodes.shape[1],) * 2)
    far, before = dijkstra(graph, directed=False, indices=range(npoints - 1), return_predecessors=True)
    way = []
    for segment in range(npoints - 1):
        passed = [segment + 1]
        while passed[-1] != segment:
            if not np.isfinite(far[segment, segment + 1]):
                return []
            passed.append(before[segment, passed[-1]])
        way.append(nodes[:, passed[::-1]])
    return way


# Via points: from the corners of a way to a certified plan


@dataclass(frozen=True)
class _Vias:
    """Via points in order: the segment of each, its time and position."""

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


def _search(task: _Task, build: Build, way: list[Array]) -> tuple[Trajectory, Clearance]:
    """Certified plan along a way, or the one that keeps farthest from the obstacles."""
    vias = _first(task, way)
    best: Trajectory = task.plan
    nearest = task.given
    while True:
        plan: Trajectory = task.plan
        found, before = task.given, nearest.minimum
        margin = fine = 3e-4 * task.size
        for _ in range(_TRIES):
            vias = _moved(task, build, vias, margin)
            try:
                plan = _through(task, build, vias)
                found = task.certificate(plan)
            except ValueError:  # no plan of this kind through so many points, or one that the rope cannot follow
                break
            if found.certified:
                return plan, found
            if found.minimum > nearest.minimum:
                best, nearest = plan, found
            missed = task.wanted - found.minimum
            if missed > 3.0 * margin:  # more than what lies between samples
                break
            margin += 1.5 * max(missed, 0.0)
        # One via point more that has brought nothing is followed by no other.
        stuck = found is not task.given and vias.times.size > 1 and nearest.minimum < before + fine
        if stuck or vias.times.size >= task.max_points:
            return best, nearest
        time = _beside(task, vias, found.time)
        vias = vias.inserted(task, time, plan(time))


def _first(task: _Task, way: list[Array]) -> _Vias:
    """Corners that bend a way most, at times in proportion to its length; if it has none, the worst place on it."""
    vias = _Vias(np.empty(0, dtype=np.intp), np.empty(0), np.empty((2, 0)))
    lines = list(way)
    while True:
        bends: dict[tuple[int, int], float] = {}
        for segment, line in enumerate(lines):
            steps, chords = np.hypot(*np.diff(line)), np.hypot(*(line[:, 2:] - line[:, :-2]))
            bends |= {(segment, k): bend for k, bend in enumerate((steps[1:] + steps[:-1] - chords).tolist(), 1)}
        minimum = min(bends.values(), default=0.0)
        if len(bends) < 2 or (len(bends) <= task.max_points and minimum > 0.01 * task.size):
            break
        segment, k = min(bends, key=lambda corner: bends[corner])
        lines[segment] = np.delete(lines[segment], k, axis=1)
    for segment, k in bends:
        run = np.cumsum(np.hypot(*np.diff(lines[segment])))
        begin, end = task.times[segment : segment + 2]
        time = _beside(task, vias, begin + (end - begin) * run[k - 1] / run[-1])
        vias = vias.inserted(task, time, lines[segment][:, k])
    if not bends:
        time = _beside(task, vias, task.given.time)
        segment = int(np.searchsorted(task.times, time)) - 1
        begin, end = task.times[segment : segment + 2]
        vias = vias.inserted(task, time, lines[segment] @ np.array([end - time, time - begin]) / (end - begin))
    return vias


def _beside(task: _Task, vias: _Vias, time: float) -> float:
    """Time kept away from the waypoints and via points about it."""
    knots = np.sort(np.concatenate([task.times, vias.times]))
    after = int(np.clip(np.searchsorted(knots, time), 1, knots.size - 1))
    a, b = knots[after - 1 : after + 1].tolist()
    return float(np.clip(time, 0.9 * a + 0.1 * b, 0.1 * a + 0.9 * b))


def _through(task: _Task, build: Build, vias: _Vias) -> Trajectory:
    added = [Waypoint(t, p) for t, p in zip(vias.times.tolist(), vias.positions.T, strict=True)]
    labels = task.plan.waypoints[0].labels
    if labels is not None:
        added = [Waypoint.from_jets(w.time, **{n: [v] for n, v in zip(labels, w.position, strict=True)}) for w in added]
    return build(sorted([*task.plan.waypoints, *added], key=lambda w: w.time))


def _moved(task: _Task, build: Build, vias: _Vias, margin: float) -> _Vias:
    """Via points where the plan is least rough among those clear at samples, or misses what is wanted by least.

    The unknowns are the positions in units of the size, the logarithms of the
    shares of a segment's duration (the last one's is 0), and by how much the
    clearance may be missed: with it no step of the search is without a solution.
    """
    count = vias.segments.size
    t = np.linspace(task.plan.start, task.plan.end, _SAMPLES)
    order = 3 if task.rope is None else max(3, task.rope.order)
    windows = np.arange(0, t.size, _WINDOW)
    # At the waypoints themselves there may be no more room than wanted.
    room = np.abs(t - task.times[:, None]).min(axis=0) / (0.05 * task.plan.duration)
    wanted = task.wanted + margin * np.minimum(1.0, room)

    def jets(x: Array) -> Array:
        return _through(task, build, _decoded(task, vias, x)).jet(t, order)

    def valued(jet: Array) -> Array:
        """Roughness, then the room in each window: shape (nvalues, ...) from jets (order + 1, 2, ..., ntime)."""
        rooms = np.minimum.reduceat(task.clearances(jet) - wanted, windows, axis=-1) / task.size
        rows = np.moveaxis(rooms, -1, 1).reshape(-1, *jet.shape[2:-1])
        return np.concatenate([_roughness(t, jet, task.size)[None], rows])

    @lru_cache(maxsize=4)
    def measured(key: bytes) -> Array:
        try:
            return valued(jets(np.frombuffer(key)))
        except ValueError:  # far from any plan: the search steps back
            return np.append(1e6, np.full(windows.size * task.ngaps, -1e3))

    @lru_cache(maxsize=1)
    def slopes(key: bytes) -> Array:
        x, steps = np.frombuffer(key), _STEP * np.eye(3 * count + 1)
        try:
            here = jets(x)
            # The axes of a plan are independent: one plan shows what moving a point along either of them does.
            both = np.stack([jets(x + steps[i] + steps[count + i]) for i in range(count)], axis=2)
            along = np.repeat(here[:, :, None], 2 * count, axis=2)
            along[:, 0, :count], along[:, 1, count:] = both[:, 0], both[:, 1]
            later = np.stack([jets(x + steps[2 * count + i]) for i in range(count)], axis=2)
            moved = valued(np.concatenate([along, later], axis=2))
        except ValueError:
            return np.zeros((measured(key).size, 3 * count))
        return (moved - measured(key)[:, None]) / _STEP

    logarithms = [_logarithms(task, vias, segment) for segment in np.unique(vias.segments)]
    start = [vias.positions.ravel() / task.size, *logarithms]
    x0 = np.append(np.concatenate(start), 0.0)
    first = measured(x0.tobytes())
    x0[-1] = max(0.0, -float(first[1:].min()))
    found = minimize(
        lambda x: measured(_key(x))[0] / first[0] + _PRICE * x[-1],
        x0,
        jac=lambda x: np.append(slopes(_key(x))[0] / first[0], _PRICE),
        method="SLSQP",
        bounds=[(None, None)] * (2 * count) + [(-4.0, 4.0)] * count + [(0.0, None)],
        constraints={
            "type": "ineq",
            "fun": lambda x: measured(_key(x))[1:] + x[-1],
            "jac": lambda x: np.column_stack([slopes(_key(x))[1:], np.ones(first.size - 1)]),
        },
        options={"maxiter": 40, "ftol": 1e-5},
    )
    return _decoded(task, vias, found.x)


def _decoded(task: _Task, vias: _Vias, x: Array) -> _Vias:
    """Via points of the unknowns of `_moved`."""
    count, times = vias.segments.size, vias.times.copy()
    for segment in np.unique(vias.segments):
        here = vias.segments == segment
        shares = np.exp(np.append(x[2 * count : 3 * count][here], 0.0))
        begin, end = task.times[segment : segment + 2]
        times[here] = begin + (end - begin) * np.cumsum(shares)[:-1] / shares.sum()
    return _Vias(vias.segments, times, task.size * x[: 2 * count].reshape(2, count))


def _logarithms(task: _Task, vias: _Vias, segment: int) -> Array:
    """Logarithms of the shares of a segment's duration, the last one's subtracted."""
    shares = np.log(np.diff([task.times[segment], *vias.times[vias.segments == segment], task.times[segment + 1]]))
    return shares[:-1] - shares[-1]


def _key(x: Array) -> bytes:
    return np.asarray(x, dtype=float).tobytes()
