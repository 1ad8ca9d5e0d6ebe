"""The shortest duration for which limits hold over the whole of a plan."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Literal, NoReturn, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ctrlplan._checks import checked_pair
from ctrlplan._display import Displayed, Facts, Figure, Part
from ctrlplan._renamed import warn_renamed
from ctrlplan.planning.limits import Limited, Margin, Margins
from ctrlplan.planning.quantities import System, system_given
from ctrlplan.planning.scalar_search import bisected, scan
from ctrlplan.planning.time_law import with_fastest_law
from ctrlplan.trajectories import Trajectory, WaypointSpline
from ctrlplan.trajectories.common import Array

if TYPE_CHECKING:
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike

Hold = Literal["shape", "waypoints", "path"]
"""What `fastest` keeps of a plan."""
_PER_OCTAVE = 24
"""Durations looked at while one doubles."""


@dataclass(frozen=True, repr=False)
class Fastest(Displayed):
    """Shortest plan under limits; made by `fastest`.

    Attributes
    ----------
    plan : Trajectory
        Shortest plan found.
    margins : Margins
        Of every limit over the whole plan, the active one first.
    feasible : tuple of (float, float)
        Intervals of durations [s] for which the limits hold, increasing; the
        last end is inf where every longer duration will do, else where the
        search ended.
    hold : str
        What was kept.
    limited : Limited
        The limits, to look at other plans with.
    rejection : str
        What the plant says of shorter plans, where that holds the plan back and
        no limit does; else empty.
    searched : (float, float)
        Durations [s] between which was searched.
    """

    plan: Trajectory
    margins: Margins
    feasible: tuple[tuple[float, float], ...]
    hold: Hold
    limited: Limited
    rejection: str = ""
    searched: tuple[float, float] = (0.0, math.inf)

    @property
    def duration(self) -> float:
        """Duration of the plan [s]."""
        return self.plan.duration

    @property
    def active(self) -> Margin:
        """The active limit, which prevents a shorter plan unless `rejection` says what does."""
        return self.margins.active

    @property
    def refusal(self) -> str:
        """Deprecated name of `rejection`."""
        warn_renamed("Fastest.refusal", "rejection")
        return self.rejection

    def _describe(self) -> Iterator[Part]:
        active = "" if self.rejection else self.active.bound.name
        limit = f", active limit {active}" if active else ""
        yield f"Fastest plan at fixed {self.hold}: {self.duration:.6g} s{limit}"
        cut = math.isfinite(self.searched[1]) and self.feasible[-1][1] >= self.searched[1] * (1.0 - 1e-9)
        sets = ", ".join(
            f"from {low:.6g} s" if math.isinf(high) else f"{low:.6g} to {high:.6g} s" for low, high in self.feasible
        )
        yield Facts(
            [
                ("minimum duration", f"{self.duration:.6g} s"),
                ("active limit", f"{active} {self.active.bound.range}, at {self.active.time:.6g} s" if active else ""),
                ("feasible durations", f"{sets}, the end of the search" if cut else sets),
                ("shorter plans rejected", self.rejection),
            ]
        )
        yield self.margins.table()
        yield Figure("Position and velocity of the plan over time.", 2, lambda axes: self.plan.plot(ax=axes))

    def plot(self, units: Mapping[str, str] | None = None, *, ax: AxesLike | None = None) -> ControlPlot:
        """Every limited signal over time with its limits.

        Parameters
        ----------
        units : mapping of str to str, optional
            Units by the signals' names.
        ax : array of Axes, shape (number of limits,), optional
            Where to draw, in the order of the limits; None: an empty current
            figure, or a new one.

        Returns
        -------
        control.ControlPlot
            Of shape (number of limits, 1).
        """
        from ctrlplan.reports.planning_figures import plot_limits

        return plot_limits(self.plan, self.limited, units, ax=ax)


def fastest(
    plan: Trajectory,
    limits: Mapping[str, object],
    system: System | None = None,
    *,
    hold: Hold = "shape",
    durations: tuple[float, float] | None = None,
    quantities: System | None = None,
) -> Fastest:
    """Shortest duration for which limits hold over the whole interval.

    Longer or shorter than the plan's own: what is given is retimed to limits
    either way.

    Parameters
    ----------
    plan : Trajectory
        What is retimed; one without duration has nothing to retime.
    limits, system
        As for `margins`: of derivatives, and of quantities of a system: a flat
        system, a `Crane`, or a function of the jet.
    hold : {"shape", "waypoints", "path"}, optional
        What is kept. "shape": all times move in proportion, derivatives scale
        with them, at the ends as well. "waypoints": their times move in
        proportion, the derivatives given there are kept, and the spline is made
        again through them. "path": the positions in their order; a time law is
        searched that slows down where a limit requires it (`Retimed`). An end
        at rest stays at rest; where the plan starts or ends in motion, the
        speed there is free, and only its direction is kept.
    durations : (float, float), optional
        Durations [s] between which is searched: unless given, from a 64th of
        the shortest that was found (of the plan's duration where waypoints are
        held) to 64 times the plan's.
    quantities : optional
        Old name of `system`, with a FutureWarning.

    Returns
    -------
    Fastest

    Raises
    ------
    ValueError
        If no duration will do: the message says which limit cannot hold, its
        value, and where; if limits are wrong, the plan does not move, or a
        derivative of the plan jumps that a limited signal is the derivative of;
        if the plan is shaped (`Shaper`), since another duration would change
        the delays; if the plan is closed in motion and the path is held, since
        the time law would open it.
    RuntimeError
        If a quantity is not resolved, since it is noisy or oscillates.

    Notes
    -----
    With the shape held, limits on derivatives alone have the closed form
    T = T_0 max_k (peak_k/limit_k)^(1/k). All else is a search: feasibility need
    not be monotone in the duration (a quintic from 0 to 1 with end speeds 1
    needs no acceleration in 1 s, and some in 0.8 s and in 2 s). Durations are
    looked at 24 times an octave on samples, valleys between them are searched,
    and the ends of every feasible interval are solved for with the extrema of
    the whole plan. What is returned satisfies every limit: of derivatives to
    the last bit, of quantities to the tolerance of `margins`; where a limit is
    touched at rest, to rounding. Inside the intervals of `Fastest.feasible`
    limits were evaluated at samples only.

    With the path held the plan is not time-optimal. The rate of the time law is
    a spline with 16 knots in the time of the plan given, not along its path, so
    that the duration depends on the timing of that plan, and a dwell in it
    stays. A straight move through n equally spaced waypoints (velocity 10,
    acceleration 1, length 1: 2 s at best) takes 2.04 s for n = 2 and 2.9 s for
    n = 10; paths through 5 to 50 waypoints took 1.4 times the time-optimal
    duration in the median, and twice at worst.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> found = cp.fastest(move, {"y_d1": 0.5, "y_d2": 2.0})
    >>> round(found.duration, 9), found.active.bound.name
    (3.75, 'y_d1')

    A turn of a motor, as fast as 120 V allow:

    >>> turn = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(2, 6.28, 0, 0, 0)])
    >>> found = cp.fastest(turn, {"voltage": 120.0}, cp.plants.dc_motor())
    >>> round(found.duration, 3), found.active.bound.name
    (1.863, 'voltage')
    """
    if hold not in get_args(Hold):
        raise ValueError(f"hold must be one of {', '.join(get_args(Hold))}, got {hold!r}")
    limited = Limited(plan, limits, system_given(system, quantities))
    limited.check_smooth(plan)
    extrema = plan.extrema()
    if not (extrema.maximum - extrema.minimum > 1e-14 * plan.peak()).any():
        raise ValueError(f"plan must move to be limited by its duration, got none of its axes that does: {plan!r}")
    span = None if durations is None else checked_pair(durations, "durations")
    if span is not None and not (span[0] > 0.0 and math.isfinite(span[1])):
        raise ValueError(f"durations must be above 0 and finite, got {span[0]:g} to {span[1]:g}")
    if hold == "waypoints":
        return _searched(_Replanned(plan, limited), span or _around(plan.duration), hold, endless=False)
    if hold == "path":
        _check_open(plan)
    uniform = fastest_within(plan, limited, span)
    if hold == "shape":
        return uniform
    # The law is made of times: counted from 0 they keep the digits that a late start would cost.
    law = with_fastest_law(uniform.plan.shift(-plan.start), limited).shift(plan.start)
    retimed = fastest_within(law, limited, span)
    return replace(min(retimed, uniform, key=lambda found: found.duration), hold=hold)


def _check_open(plan: Trajectory) -> None:
    """Reject a plan that is closed in motion, which a time law with free ends would open."""
    first, last = plan.jet(plan.start, 2), plan.jet(plan.end, 2, left=True)
    size, extrema = np.stack([plan.peak(nu) for nu in range(3)]), plan.extrema()
    slack = 1e-9 * size
    slack[0] = 1e-9 * (extrema.maximum - extrema.minimum) + 1e-14 * size[0]
    same = [bool(row.all()) for row in np.abs(last - first) <= slack]
    moves = [bool(row.any()) for row in np.abs(first) > slack]
    if same[0] and same[1] and (moves[1] or (same[2] and moves[2])):
        raise ValueError(
            f"hold must be 'shape' or 'waypoints' for a closed plan, got 'path': from {plan.start:g} s to {plan.end:g} "
            f"s the plan returns to its position and velocity, and a time law with free ends would make them differ"
        )


class _Scaled:
    """A plan of any duration, its shape held: jets scale by powers."""

    def __init__(self, plan: Trajectory, limited: Limited) -> None:
        self._plan, self.limited = plan, limited
        self._jet = limited.sampled(plan)
        self._powers = np.arange(limited.order + 1)[:, None, None]

    def plan(self, duration: float) -> Trajectory:
        return self._plan.retime(duration)

    def excess(self, duration: float) -> float:
        return self.limited.excess(self._jet * (self._plan.duration / duration) ** self._powers)


class _Replanned:
    """A plan of any duration, the derivatives at its waypoints held."""

    def __init__(self, plan: Trajectory, limited: Limited) -> None:
        if not isinstance(plan, WaypointSpline):
            raise TypeError(
                f"waypoints are held of a spline made through them (a WaypointSpline, such as PolySpline), "
                f"got a {type(plan).__name__}; hold the shape or the path"
            )
        self._plan, self.limited = plan.quiet(), limited

    def plan(self, duration: float) -> Trajectory:
        retimed = self._plan.retime(duration)
        pairs = zip(self._plan.waypoints, retimed.waypoints, strict=True)
        return retimed.through(given.scaled(moved.time, 1.0) for given, moved in pairs)

    def excess(self, duration: float) -> float:
        return self.limited.excess(self.limited.sampled(self.plan(duration)))


def fastest_within(plan: Trajectory, limited: Limited, span: tuple[float, float] | None = None) -> Fastest:
    """Shortest duration with the shape held, for limits that were made ready before."""
    scaled = _Scaled(plan, limited)
    _check_rest(plan, limited)
    minimum = _closed_form(plan, limited)
    if limited.derivatives_only and span is None:
        if not minimum:
            raise ValueError("limits must name a derivative that the plan has, got none that a shorter one would break")
        found = _holding(limited, plan.retime, minimum)
        return Fastest(found, limited.margins(found), ((found.duration, math.inf),), "shape", limited)
    return _searched(scaled, span or _span(scaled, plan.duration, minimum), "shape", endless=True)


def _check_rest(plan: Trajectory, limited: Limited) -> None:
    """Reject limits of positions and quantities that a plan breaks however slow it is."""
    still = limited.at_rest(plan)
    for bound, values in zip(limited.bounds, limited.values(still), strict=True):
        worst = int(bound.excess(values).argmax())
        if bound.excess(values)[worst] > 0.0:
            place = zip(plan.labels, still[0, :, worst].tolist(), strict=True)
            where = ", ".join(f"{label} = {value:.4g}" for label, value in place)
            raise ValueError(
                f"limits must hold at rest, however slow the plan, got {bound.name} = {values[worst]:.6g} at rest "
                f"at {where}, where it must stay {bound.range}"
            )


def _closed_form(plan: Trajectory, limited: Limited) -> float:
    """Duration below which some derivative breaks its limits, T_0 max_k (peak_k/limit_k)^(1/k)."""
    minimum = 0.0
    for bound in limited.bounds:
        if bound.axis is not None and bound.order:
            extrema = plan.extrema(bound.order)
            sides = (
                (float(extrema.maximum[bound.axis]), bound.high, float(extrema.time_max[bound.axis])),
                (-float(extrema.minimum[bound.axis]), -bound.low, float(extrema.time_min[bound.axis])),
            )
            rounding = 1e-12 * max(abs(value) for value, _, _ in sides)
            for value, side, time in sides:
                if side > 0.0:
                    minimum = max(minimum, plan.duration * (max(value, 0.0) / side) ** (1.0 / bound.order))
                elif value > rounding:  # a sign that must not be, whatever the duration
                    raise ValueError(
                        f"limits must hold for some duration, got {bound.name} of both signs where it must stay "
                        f"{bound.range}: its sign at {time:.6g} s is the same at every duration"
                    )
    return minimum


def _around(duration: float) -> tuple[float, float]:
    return duration / 64.0, 64.0 * duration


def _span(scaled: _Scaled, duration: float, minimum: float) -> tuple[float, float]:
    """Durations between which is searched, from where limits are broken to where they hold."""
    excess, high = scaled.excess, max(duration, minimum)
    for _ in range(60):
        if excess(high) <= 0.0 and scaled.limited.exact_excess(scaled.plan(1.01 * high)) <= 0.0:
            break
        high *= 2.0
    else:
        raise ValueError(f"limits must hold for some duration, got none up to {high:.3g} s")
    low = high / 64.0
    while low > minimum and excess(low) <= 0.0:
        low /= 64.0
        if low < 1e-12 * high:
            raise ValueError("limits must include one that a shorter plan would break, got none")
    return max(low, 0.999 * minimum), 1.01 * high


def _searched(family: _Scaled | _Replanned, span: tuple[float, float], hold: Hold, endless: bool) -> Fastest:
    """Feasible durations within a span, and the plan of the shortest; endless where every slower plan is feasible."""
    limited = family.limited
    exact = cache(lambda duration: limited.exact_excess(family.plan(duration)))
    count = max(9, math.ceil(_PER_OCTAVE * math.log2(span[1] / span[0])))
    durations, excess = scan(family.excess, np.geomspace(*span, count), 0.0)
    feasible = []
    for low, high in _runs(excess <= 0.0):
        inside = low + np.argsort(excess[low : high + 1])[:8]
        # Samples can have seen less than there is.
        middle = next((d for d in durations[inside].tolist() if exact(d) <= 0.0), None)
        if middle is None:
            continue
        ends = [
            float(durations[inner])
            if not 0 <= outer < durations.size
            else _feasible_edge(exact, family.excess, middle, float(durations[outer]))
            for inner, outer in ((low, low - 1), (high, high + 1))
        ]
        feasible.append((ends[0], ends[1]))
    if not feasible:
        _reject(family, durations, excess)
    if endless and feasible[-1][1] == durations[-1]:
        feasible[-1] = (feasible[-1][0], math.inf)
    plan = _holding(limited, family.plan, feasible[0][0])
    found = limited.margins(plan)
    # Where no limit is met, something else holds it back: a plant that cannot follow.
    rejection = limited.rejection(family.plan(0.99 * plan.duration)) if found.active.fraction > 1e-6 else ""
    searched = (span[0], math.inf if math.isinf(feasible[-1][1]) else span[1])
    return Fastest(plan, found, tuple(feasible), hold, limited, rejection, searched)


def _runs(inside: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of true."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]])))
    return [(int(a), int(b) - 1) for a, b in change.reshape(-1, 2)]


def _feasible_edge(
    exact: Callable[[float], float], sampled: Callable[[float], float], inside: float, outside: float
) -> float:
    """Duration between a feasible and an infeasible one at which limits begin to hold."""
    # Samples come cheap, and tell where to look.
    good, bad = bisected(lambda duration: sampled(duration) <= 0.0, inside, outside, 0.0, 1e-6)
    step = good - bad
    while exact(good) > 0.0:  # the whole interval says more than its samples: go inwards
        good, bad, step = good + step, good, 8.0 * step
        if (good - inside) * step > 0.0:
            good = inside
    while math.isinf(exact(bad)) and abs(bad - good) > 1e-13 * good:  # the plant cannot follow: there is no root
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if exact(middle) <= 0.0 else (good, middle)
    if math.isinf(exact(bad)):
        return good
    return float(brentq(exact, good, bad, xtol=1e-14 * good, rtol=1e-14)) if exact(bad) > 0.0 else bad


def _holding(limited: Limited, plan_of: Callable[[float], Trajectory], duration: float) -> Trajectory:
    """Plan of a duration, lengthened by as many roundings as its limits need to hold."""
    step = float(np.spacing(duration))
    while step < 1e-6 * duration:
        plan = plan_of(duration)
        if limited.exact_excess(plan) <= 0.0:
            return plan
        duration, step = duration + step, 2.0 * step
    raise ValueError(f"limits must hold near {duration:.6g} s, got {limited.margins(plan).active}")


def _reject(family: _Scaled | _Replanned, durations: Array, excess: Array) -> NoReturn:
    span = f"from {durations[0]:.4g} to {durations[-1]:.4g} s"
    if math.isinf(excess.min()):
        raise ValueError(f"the plant must be able to follow for some duration {span}, got none")
    nearest = float(durations[int(excess.argmin())])
    worst = family.limited.margins(family.plan(nearest)).active
    further = "; they may hold beyond, give durations=(low, high)" if nearest in (durations[0], durations[-1]) else ""
    raise ValueError(
        f"limits must hold for some duration {span}, got none; nearest at {nearest:.4g} s: {worst}{further}"
    )
