"""Whether a planned reference is worth it: its rivals, the limits that each keeps, where trigonometric plans win."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan.planning import optimize_waypoints
from ctrlplan.planning.fastest import fastest_within
from ctrlplan.planning.limits import Limited
from ctrlplan.simulation import state_space
from ctrlplan.studies.comparison import Comparison, compare, finite_or_none, is_builder, waypoints_given
from ctrlplan.studies.units import ROUNDING
from ctrlplan.trajectories import (
    PiecewiseSpline,
    PolySpline,
    SCurve,
    Shaper,
    Step,
    Trajectory,
    Trapezoid,
    TrigSpline,
    Waypoint,
)

Array = NDArray[np.float64]

ALPHAS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
FACTORS = (0.75, 1.0, 1.5, 2.0)
DECISIVE = ("settling_time", "control_peak")
PLANNED = "trigonometric"
_JUMPING = ("step", "shaped step")
_DEGREES = {1: "straight line", 3: "cubic", 5: "quintic", 7: "septic", 9: "nonic"}
OWN_LIMITS = (
    "The limits are not those of a plant: they are the peak velocity, acceleration and jerk of the polynomial through "
    "these waypoints, which therefore needs exactly the time of the waypoints. Other limits give other durations."
)
"""What must be said where limits are the polynomial's own peaks."""

SAME = 1e-3
"""Relative difference up to which values count as equal."""


@dataclass(frozen=True)
class Grid:
    """One number of trigonometric plans over alpha and duration, beside that of their rivals.

    Attributes
    ----------
    title, unit : str
        What it is; less is better.
    durations : ndarray, shape (ndurations,)
        Of the plans [s].
    alphas : ndarray, shape (nalphas,)
        Shape parameters [rad].
    values : ndarray, shape (ndurations, nalphas)
        Of the trigonometric plans.
    rivals : dict of str to ndarray, shape (ndurations,)
        Of the others by name.
    beside : tuple of str
        Rivals that are shown but do not count: steps, which keep no limit, or
        a bound that no plan can reach.
    scale : float
        Size of the number, of which a millionth is rounding; 0 where it is not
        known.
    """

    title: str
    unit: str
    durations: Array
    alphas: Array
    values: Array
    rivals: dict[str, Array]
    beside: tuple[str, ...] = ()
    scale: float = 0.0

    def best(self, row: int) -> tuple[str, float]:
        """Rival that does best at one of the durations, and its value; nan where none has one."""
        able = {name: values for name, values in self.rivals.items() if name not in self.beside}
        found = {name: float(values[row]) for name, values in able.items() if not math.isnan(values[row])}
        name = min(found, key=lambda rival: found[rival], default="none")
        return name, found.get(name, math.nan)

    def marks(self) -> list[list[str]]:
        """Whether each trigonometric plan wins against its best rival, loses, or neither: "win", "lose", ""."""
        return [
            [_mark(value, self.best(row)[1], ROUNDING * self.scale) for value in values]
            for row, values in enumerate(self.values.tolist())
        ]

    @property
    def verdict(self) -> str:
        """How often trigonometric plans win and lose, in a sentence."""
        if np.isnan([self.best(i)[1] for i in range(self.durations.size)]).all():
            return f"{self.title}: there is nothing to compare."
        marks = self.marks()
        cells = [(i, j) for i in range(len(marks)) for j in range(self.alphas.size) if self.alphas[j] > 0.0]
        wins = [(i, j) for i, j in cells if marks[i][j] == "win"]
        losses = sum(marks[i][j] == "lose" for i, j in cells)
        names = list(dict.fromkeys(self.best(i)[0] for i in range(self.durations.size)))
        found = f"{self.title}: of {len(cells)} trigonometric plans {len(wins)} win and {losses} lose"
        found += f" against the best rival ({', '.join(names)})"
        if wins:
            shapes = ", ".join(f"{self.alphas[j]:.3g}" for j in sorted({j for _, j in wins}))
            times = ", ".join(f"{self.durations[i]:.3g} s" for i in sorted({i for i, _ in wins}))
            found += f"; they win at alpha = {shapes} in {times}"
        return found + "."


@dataclass(frozen=True)
class Need:
    """How long a plan takes under the same limits.

    Attributes
    ----------
    name : str
        The plan.
    duration : float
        Shortest duration [s], nan where there is none.
    limit : str
        What does not let it be shorter, or why there is none.
    kept : str
        What the limits are to it in the time of the waypoints.
    """

    name: str
    duration: float
    limit: str
    kept: str = ""


@dataclass(frozen=True)
class Worth:
    """A planned reference beside its rivals; made by `worth`.

    Attributes
    ----------
    comparison : Comparison
        All through the loop, through the same waypoints in the same time.
    limits : dict of str to object
        Limits that all are held to.
    needs : tuple of Need
        How long each takes under these limits.
    grids : tuple of Grid
        Where trigonometric plans win and lose.
    alpha : float
        Shape parameter of the trigonometric plan [rad].
    note : str
        What a reader must know of how it was made.
    """

    comparison: Comparison
    limits: dict[str, Any]
    needs: tuple[Need, ...]
    grids: tuple[Grid, ...]
    alpha: float = 0.0
    note: str = ""

    @property
    def verdicts(self) -> tuple[str, ...]:
        """What was found, in sentences."""
        return (*([_need_sentence(self.needs)] if self.needs else []), *(grid.verdict for grid in self.grids))

    def results(self) -> dict[str, Any]:
        """Plain data for ``results.json``."""
        return {
            "plans": self.comparison.results()["plans"],
            "needs": {need.name: finite_or_none(need.duration) for need in self.needs},
            "grids": [
                {
                    "title": grid.title,
                    "durations": grid.durations.tolist(),
                    "alphas": grid.alphas.tolist(),
                    "values": [[finite_or_none(v) for v in row] for row in grid.values.tolist()],
                    "rivals": {name: [finite_or_none(v) for v in row.tolist()] for name, row in grid.rivals.items()},
                }
                for grid in self.grids
            ],
        }


def worth(
    loop: Any,
    waypoints: Iterable[Waypoint],
    timepts: ArrayLike,
    *,
    alpha: float | Literal["auto"] = "auto",
    limits: Mapping[str, Any] | None = None,
    quantities: Any = None,
    mode: tuple[float, float] | None = None,
    alphas: Sequence[float] = ALPHAS,
    factors: Sequence[float] = FACTORS,
    decisive: Sequence[str] = DECISIVE,
    measure: Callable[[Trajectory, Any, float], Mapping[str, float]] | None = None,
    baselines: Callable[[tuple[Waypoint, ...]], Mapping[str, Trajectory]] | None = None,
    note: str = "",
    **options: Any,
) -> Worth:
    """Compare a trigonometric plan with what else a designer could send.

    Parameters
    ----------
    loop : control system or callable
        As for `compare`.
    waypoints : iterable of Waypoint
        What every plan meets; profiles stop at each of them.
    timepts : array_like, shape (ntime,)
        Sample times [s]; longer plans are run longer.
    alpha : float or "auto", optional
        Shape parameter of the trigonometric plan.
    limits, quantities : optional
        As for `fastest`; unless given, the velocity, acceleration and jerk that
        the polynomial needs, axis by axis.
    mode : (float, float), optional
        Frequency [rad/s] and damping ratio of the mode that shapers are made
        for: unless given, that of the slowest complex poles where the loop is
        linear.
    alphas : sequence of float, optional
        Shape parameters of the tables [rad].
    factors : sequence of float, optional
        Durations of the tables, as multiples of the waypoints' own.
    decisive : sequence of str, optional
        Metrics of the tables.
    measure : callable, optional
        Maps a plan, its response, and the time of the last waypoint to further metrics.
    baselines : callable, optional
        Maps waypoints to further plans by name, as `smoother_polynomials` does.
    note : str, optional
        What a reader must know of how it was made.
    **options
        As for `compare`.

    Returns
    -------
    Worth

    Raises
    ------
    ValueError
        As `compare` and `fastest`.
    """
    points = waypoints_given(waypoints)
    times = np.asarray(timepts, dtype=float)
    reference = PolySpline(points, warn=False)
    held = dict(limits) if limits is not None else _needed_by(reference)
    limited = Limited(reference, held, quantities)
    shaper = _shaper(loop, reference, mode)
    planned = TrigSpline(points, alpha=alpha)
    if limits is None:
        note = " ".join(filter(None, (note, OWN_LIMITS)))

    def rivals_through(points: tuple[Waypoint, ...]) -> dict[str, Trajectory]:
        return rival_plans(points, held, shaper) | dict(baselines(points) if baselines is not None else {})

    def compared(points: tuple[Waypoint, ...], plans: dict[str, Trajectory], only: Any = None) -> Comparison:
        last, late = points[-1].time, points[-1].time - reference.end
        more = np.arange(times[-1], times[-1] + max(late, 0.0), np.median(np.diff(times)))[1:]
        return compare(
            loop,
            _followable(loop, plans),
            np.concatenate([times, more]),
            waypoints=points,
            only=only,
            measure=None if measure is None else lambda plan, response: measure(plan, response, last),
            **options,
        )

    beside: dict[str, Trajectory] = {PLANNED: planned} | rivals_through(points)
    found = compared(points, beside)
    decisive = _measured(decisive, found)
    tables: list[dict[str, dict[str, float]]] = []
    names: dict[str, None] = {}  # a move can be too short to be shaped
    for factor in factors:
        scaled = _scaled(points, factor)
        shapes = {f"{a:g}": TrigSpline(scaled, alpha=a, warn=False) for a in alphas}
        rivals = rivals_through(scaled)
        ran = compared(scaled, shapes | rivals, set(decisive))
        # What the plant cannot follow loses, and so does a plan that an event has ended; a baseline so ended has no
        # figure.
        lost, none = dict.fromkeys(decisive, np.inf), dict.fromkeys(decisive, np.nan)
        rows = {name: lost | ran.metrics.get(name, {}) for name in (*shapes, *rivals)}
        tables.append(rows | {name: lost if name in shapes else none for name in ran.stopped})
        names |= dict.fromkeys(rivals)
    grids = tuple(
        Grid(
            title=found.measures[key].title,
            unit=found.measures[key].unit,
            scale=found.scales.get(key, 0.0),
            durations=reference.duration * np.array(factors),
            alphas=np.array(alphas, dtype=float),
            values=np.array([[rows[f"{a:g}"][key] for a in alphas] for rows in tables]),
            rivals={name: np.array([rows.get(name, {}).get(key, np.nan) for rows in tables]) for name in names},
            beside=_JUMPING,
        )
        for key in decisive
    )
    return Worth(found, held, _needs(points, beside, limited, held, shaper), grids, planned.alpha, note)


def rival_plans(
    waypoints: Sequence[Waypoint], limits: Mapping[str, Any] | None = None, shaper: Shaper | None = None
) -> dict[str, Trajectory]:
    """What a designer could send in the place of a trigonometric plan, in the same time.

    Parameters
    ----------
    waypoints : sequence of Waypoint
        Two or more, all positions given.
    limits : mapping, optional
        Of velocity, acceleration and jerk, as for `fastest`: profiles have the
        proportions of the fastest ones under them.
    shaper : Shaper, optional
        What step and S-curve are shaped by, for a lightly damped mode.

    Returns
    -------
    dict of str to Trajectory
        step (to the goal at once), trapezoid and S-curve (at rest at every
        waypoint), shaped step and shaped S-curve where there is a shaper,
        quintic a leg (or what the entries given make of it), minimum jerk
        (through the positions); one under both names where they are equal.
    """
    points = tuple(waypoints)
    legs = PiecewiseSpline(points)
    bounds = _derivative_limits(legs, limits if limits is not None else _needed_by(PolySpline(points, warn=False)))
    plans: dict[str, Trajectory] = {
        "step": Step(legs.final, legs.initial, legs.start, legs.labels),
        "trapezoid": _profile(points, legs.labels, Trapezoid, bounds),
        "S-curve": _profile(points, legs.labels, SCurve, bounds),
    }
    if shaper is not None:
        plans["shaped step"] = shaper(plans["step"])
        if shaper.duration < 0.9 * min(np.diff(legs.breakpoints)):
            plans["shaped S-curve"] = _profile(points, legs.labels, SCurve, bounds, shaper=shaper)
    # Entries above the acceleration leave minimum jerk nothing to choose.
    ends = (0, len(points) - 1)
    freed = [point.truncated(2 if i in ends else 0) for i, point in enumerate(points)]
    jerk = optimize_waypoints(freed, 3, labels=legs.labels).plan
    degree = max(max(leg.degree) for leg in legs.legs)
    name = f"{_DEGREES.get(degree, f'degree {degree}')}{' a leg' if len(points) > 2 else ''}"
    t = np.linspace(legs.start, legs.end, 101)
    if np.abs(jerk.jet(t, 0) - legs.jet(t, 0)).max() <= 1e-9 * np.abs(legs.jet(t, 0)).max():
        return plans | {f"{name} (minimum jerk)": legs}
    return plans | {name: legs, "minimum jerk": jerk}


def smoother_polynomials(waypoints: Sequence[Waypoint]) -> dict[str, Trajectory]:
    """Polynomials that are smoother at their ends than what the waypoints prescribe.

    Parameters
    ----------
    waypoints : sequence of Waypoint
        Two or more, all positions given.

    Returns
    -------
    dict of str to Trajectory
        Between two waypoints at rest the septic (jerk 0 at both ends) and the
        nonic (snap 0 as well); through more, the plans of minimum snap and of
        minimum fifth derivative with such ends, of these degrees segment by
        segment. None where an end is not at rest.
    """
    points = tuple(waypoints)
    ends = points[0], points[-1]
    if any(np.nan_to_num(point.jet[1:], nan=1.0).any() for point in ends):
        return {}
    found: dict[str, Trajectory] = {}
    for order, name in ((4, "septic"), (5, "nonic")):
        if max(len(point.jet) for point in ends) > order:
            continue
        first, last = (_at_rest(point, order) for point in ends)
        if len(points) == 2:
            found[name] = PolySpline([first, last])
        else:
            found[f"{name} a segment"] = optimize_waypoints([first, *points[1:-1], last], order).plan
    return found


def _at_rest(point: Waypoint, entries: int) -> Waypoint:
    """Same position, with so many entries, the derivatives 0."""
    still = [0.0] * point.naxes
    return Waypoint.from_dict(point.to_dict() | {"jet": [point.position.tolist(), *[still] * (entries - 1)]})


def _measured(decisive: Sequence[str], found: Comparison) -> list[str]:
    """Those of the metrics asked for that the loop has: without controls, none of them."""
    for key in decisive:
        if key not in found.measures:
            raise ValueError(f"decisive must be metrics ({', '.join(found.measures)}), got {key!r}")
    return [key for key in decisive if any(key in rows for rows in found.metrics.values())]


def _followable(loop: Any, plans: dict[str, Trajectory]) -> dict[str, Trajectory]:
    """Plans that a builder of loops does not refuse."""
    if not is_builder(loop):
        return plans
    found = {}
    refusal = None
    for name, plan in plans.items():
        try:
            loop(name, plan)
        except ValueError as reason:
            refusal = refusal or reason
            continue
        found[name] = plan
    if refusal is not None and not found:
        raise refusal
    return found


def _needed_by(plan: Trajectory) -> dict[str, Any]:
    """Velocity, acceleration and jerk that a plan needs, axis by axis."""
    peaks = {order: plan.peak(order) for order in (1, 2, 3)}
    names = [[label, f"{label}_d1", f"{label}_d2", f"{label}_d3"] for label in plan.labels]
    return {
        names[axis][order]: float(peak)
        for order, values in peaks.items()
        for axis, peak in enumerate(values)
        if peak > 1e-9 * values.max()
    }


def _scaled(points: Sequence[Waypoint], factor: float) -> tuple[Waypoint, ...]:
    """Same waypoints over another duration, passed at speeds in proportion."""
    start = points[0].time
    return tuple(point.scaled(start + factor * (point.time - start), 1.0 / factor) for point in points)


def _shaper(loop: Any, plan: Trajectory, mode: tuple[float, float] | None) -> Shaper | None:
    """Shaper with two zeros at a mode: the one given, or the loop's own where it is linear."""
    if mode is None:
        if is_builder(loop) or not hasattr(loop, "poles"):
            return None
        system = state_space(loop)
        poles = np.asarray(system.poles(), dtype=complex)
        if system.dt:
            poles = np.log(poles[poles != 0.0]) / float(system.dt)
        swinging = poles[(poles.imag > 0.0) & (poles.real < 0.0)]
        if not swinging.size:
            return None
        slowest = swinging[swinging.real.argmax()]
        mode = float(abs(slowest)), float(-slowest.real / abs(slowest))
    return Shaper.zvd(*mode)


Limits = tuple[Array, Array, Array]
"""Velocity, acceleration and jerk, axis by axis; inf where there is none."""


def _derivative_limits(plan: Trajectory, limits: Mapping[str, Any]) -> Limits:
    found = np.full((3, plan.naxes), np.inf)
    known = {name: limit for name, limit in limits.items() if name in _names(plan)}
    for bound in Limited(plan, known).bounds if known else ():
        if bound.axis is not None:
            # Where only one sign is allowed, of that sign.
            sides = [side for side in (bound.high, -bound.low) if side > 0.0]
            found[bound.order - 1, bound.axis] = min(sides, default=np.inf)
    return found[0], found[1], found[2]


def _names(plan: Trajectory) -> set[str]:
    return {"velocity", "acceleration", "jerk"} | {f"{label}_d{k}" for label in plan.labels for k in (1, 2, 3)}


def _profile(
    points: Sequence[Waypoint],
    labels: tuple[str, ...],
    kind: Callable[..., Trajectory],
    limits: Limits,
    timed: bool = True,
    shaper: Shaper | None = None,
) -> Trajectory:
    """Profiles from rest to rest, one after the other: each in the time of its leg, or as fast as it can be."""
    parts: list[Trajectory] = []
    for first, last in pairwise(points):
        duration, way = last.time - first.time, np.abs(last.position - first.position)
        if not way.any():
            parts.append(PolySpline([Waypoint(p.time, p.position, 0, 0) for p in (first, last)], labels=labels))
            continue
        way = np.maximum(way, 1e-9 * way.max())
        # Where there is no limit, that of a move in equal thirds.
        velocity, acceleration, jerk = (
            np.where(np.isfinite(limit), limit, usual * way / duration**order)
            for order, usual, limit in zip((1, 2, 3), (1.5, 4.5, 27.0), limits, strict=True)
        )
        more = {"jerk": jerk} if kind is SCurve else {}
        part: Trajectory = kind(
            last.position,
            first.position,
            velocity=velocity,
            acceleration=acceleration,
            time=first.time,
            labels=labels,
            **more,
        )
        if shaper is not None:
            part = shaper(part.retime(duration - shaper.duration) if timed else part)
        elif timed:
            part = part.retime(duration)
        parts.append(part)
    return reduce(lambda one, other: one.then(other), parts)


def _needs(
    points: tuple[Waypoint, ...],
    timed: dict[str, Trajectory],
    limited: Limited,
    limits: Mapping[str, Any],
    shaper: Shaper | None,
) -> tuple[Need, ...]:
    """Shortest duration, under the same limits, of plans that take the time of the waypoints."""
    labels = timed[PLANNED].labels
    bounds = _derivative_limits(timed[PLANNED], limits)
    # Profiles are as fast as they can be, each leg by itself; shaping adds its own time to each.
    fast: dict[str, Trajectory] = {
        "trapezoid": _profile(points, labels, Trapezoid, bounds, timed=False),
        "S-curve": _profile(points, labels, SCurve, bounds, timed=False),
    }
    if "shaped S-curve" in timed:
        fast["shaped S-curve"] = _profile(points, labels, SCurve, bounds, timed=False, shaper=shaper)
    return tuple(_need(name, plan, fast.get(name, plan), limited) for name, plan in timed.items())


def _need(name: str, plan: Trajectory, fast: Trajectory, limited: Limited) -> Need:
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


def _need_sentence(needs: Sequence[Need]) -> str:
    possible = [need for need in needs if not math.isnan(need.duration)]
    if not possible:
        return "Under these limits no plan is possible."
    first = min(possible, key=lambda need: need.duration)
    others = ", ".join(f"{need.name} {need.duration:.4g} s" for need in possible if need is not first)
    never = [need.name for need in needs if math.isnan(need.duration)]
    without = f"; {', '.join(never)} cannot keep them at any" if never else ""
    return f"Under the same limits {first.name} is the fastest with {first.duration:.4g} s ({others}{without})."


def _mark(value: float, rival: float, rounding: float = 0.0) -> str:
    if math.isnan(value) or math.isnan(rival) or value == rival:
        return ""
    if math.isfinite(value - rival) and abs(value - rival) <= max(SAME * max(abs(value), abs(rival)), rounding):
        return ""
    return "win" if value < rival else "lose"
