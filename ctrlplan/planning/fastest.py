"""Minimum duration of a plan under limits over its whole interval."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, NoReturn, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ctrlplan._checks import checked_finite, checked_pair
from ctrlplan._display import Displayed, Facts, Figure, Part, time_text
from ctrlplan._renamed import FormerAttribute, outside_stacklevel
from ctrlplan.planning.bounds import Bound
from ctrlplan.planning.durations import PlansByDuration, ReplannedPlans
from ctrlplan.planning.limits import Limited, Margin, Margins
from ctrlplan.planning.loop_fastest import LoopProblem, bounds_of_values
from ctrlplan.planning.path_law import Rates, corner_times, fastest_law, fastest_smooth_law
from ctrlplan.planning.path_law.positions import required_rate
from ctrlplan.planning.path_law.signals import HIGHEST, fast_laws_of_signals, law_with_given_ends
from ctrlplan.planning.path_law.stopping import stopping
from ctrlplan.planning.path_law.vehicle import fastest_segment_law, orders_on_path
from ctrlplan.planning.peaks import excess_at_peaks
from ctrlplan.planning.quantities import System, shapes_given, system_given
from ctrlplan.planning.scalar_search import bisected, bottom, scan
from ctrlplan.planning.time_law import with_fast_time_law
from ctrlplan.trajectories import PathPlan, PolySpline, Retimed, Trajectory, Waypoint, WaypointSpline
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.continuity import constant_axes
from ctrlplan.trajectories.extrema import search_extrema

if TYPE_CHECKING:
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike

_COARSE = 1e-4
"""Resolution of local minima of the violation by simulated responses, relative to the duration."""

_DOUBLINGS_IN_LOOP = 6
"""Maximum number of times by which the duration of a plan is doubled where its responses are slow."""

_EDGE = 1e-7
"""Resolution of a minimum duration by simulated responses, relative to the duration."""

_ROUNDING = 1e-14
"""The same by exact responses."""

_FALLS = 0.99
"""Ratio of the violations of durations that differ by an octave below which a longer one may be feasible."""

_STEPS = 5
"""Maximum number of steps to the boundary of the feasible durations."""

_NEAR = 1e-8
"""Change of a duration, relative to it, whose square is below rounding."""

_INWARDS = 4.0 * float(np.finfo(float).eps)
"""Distance from a boundary of the feasible durations, relative to it, within which a signal may exceed by rounding."""

_SAME = 16.0 * _INWARDS
"""Change of a boundary of the feasible durations, relative to it, that is rounding."""

_WIDTHS = 1e-7 * 8.0 ** np.arange(6.0)
"""Changes of a duration within which its excess at one time is searched for a root, relative to it."""

_NARROWINGS = 60
"""Maximum number of parts of an interval with a change of sign, each at most half of the one before."""

_ABOUT = np.array([-0.1, -1e-3, -1e-5, -1e-7, -1e-9, 0.0, 1e-9, 1e-7, 1e-5, 1e-3, 0.1])
"""Points about the root of a chord, relative to its length."""

_RESOLVED = 1e-10
"""Increase of a duration by which limits that are violated by rounding are satisfied, relative to it."""

_ABOVE = 1.0 + 1e-14
"""Duration on a path relative to that by its extrema, which are known up to rounding."""

_RESERVES = (1e-4, 3e-4, 1e-3, 3e-3)
"""Distances from the limits with given speeds at the ends, relative to them, one after the other until limits hold."""

_AT_ENDS = 1e-12
"""Excess that is the rounding of a given speed at a limit."""

_EVALUATIONS, _ACTIVE = 6, 1e-9
"""Number of evaluations of a plan near its limits, and margin of the active limit that ends them."""

_SLOWED = 1.002
"""Maximum duration with which a law is slowed until it satisfies the limits, relative to its own."""

_NEARBY = 1e-7 * 4.0 ** np.arange(11)
"""Distances of factors from 1 at which an excess over a limit is evaluated."""

_PLACES, _NARROW, _ZERO = 8, 1.01, 1e-10
"""Maximum number of places at which limits over time require finer cells, the factor by which a law may be slowed
without them, and a limit that is 0, relative to the largest one."""

_ABOUT_NARROW = 4.0 ** -np.arange(2.0, 10.0)
"""Distances of edges of these cells from such a place, relative to the duration."""

_ROUNDED, _UNRESOLVED = 1e-6, 1.0
"""Maximum increase of a duration by which limits are satisfied, relative to it: of rounding, and where limits over time
change too fast for their extrema to be resolved."""

_LOCAL = "not searched; a local minimum of the time law"

_GIVEN = "not found: the time law is that of the given plan"

Ends = Literal["free", "given"]
"""Speeds at the ends of a plan with another time law."""

Hold = Literal["shape", "waypoints", "path"]
"""Property of a plan that `fastest` preserves."""


@dataclass(frozen=True, repr=False)
class Fastest(Displayed):
    """Plan of minimum duration under limits; returned by `fastest`.

    Attributes
    ----------
    plan : Trajectory
        Plan of minimum duration.
    margins : Margins
        Margins of all limits over the whole plan, the active one first.
    feasible : tuple of (float, float)
        Intervals of feasible durations [s], increasing. The last end is inf if
        every longer duration is feasible, otherwise the end of the search. With
        `statement`, as for limits of quantities with fixed path, only the minimum
        duration.
    hold : str
        Property that was preserved: "shape", "waypoints" or "path".
    limited : Limited
        The limits, for the evaluation of other plans.
    rejection : str
        Reason for which shorter plans are infeasible for the plant, if no limit
        is active; otherwise empty.
    searched : (float, float)
        Interval of durations [s] of the search.
    statement : str
        What is known of shorter durations, for limits on signals of a loop, and of
        quantities with fixed path; otherwise empty.
    stops : tuple of float
        With hold="path": times [s] of the given plan at which its path has corners,
        where the plan stops, those at which it is at rest included.
    """

    plan: Trajectory
    margins: Margins
    feasible: tuple[tuple[float, float], ...]
    hold: Hold
    limited: Limited
    rejection: str = ""
    searched: tuple[float, float] = (0.0, math.inf)
    statement: str = ""
    stops: tuple[float, ...] = ()

    @property
    def duration(self) -> float:
        """Duration of the plan [s]."""
        return self.plan.duration

    @property
    def active(self) -> Margin:
        """The smallest margin, of the active limit without `rejection`."""
        return self.margins.active

    refusal = FormerAttribute("rejection")

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
                ("active limit", f"{active} {self.active.bound.range}, {self.active.when}" if active else ""),
                ("feasible durations", "" if self.statement else f"{sets}, the end of the search" if cut else sets),
                ("shorter durations", self.statement),
                (
                    "stops at corners of the path",
                    ", ".join(f"at {time_text(time)} s of the given plan" for time in self.stops),
                ),
                ("shorter plans rejected", self.rejection),
                ("signals of the loop", self.margins.note),
                ("ranges of parameters", self.margins.coverage),
            ]
        )
        yield self.margins.table()
        yield Figure("Position and velocity of the plan over time.", 2, lambda axes: self.plan.plot(ax=axes))

    def plot(self, units: Mapping[str, str] | None = None, *, ax: AxesLike | None = None) -> ControlPlot:
        """Plot all limited signals over time with their limits.

        Parameters
        ----------
        units : mapping of str to str, optional
            Units of the signals by name.
        ax : array of Axes, shape (number of limits,), optional
            Axes to plot in, in the order of the limits; default: the current
            figure if it is empty, otherwise a new one.

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
    tail: float | None = None,
    resolution: float = 1e-3,
    params: Mapping[str, object] | None = None,
    ends: Ends = "free",
    quantities: System | None = None,
) -> Fastest:
    """Plan of minimum duration under limits.

    The limits are satisfied over the whole interval. The duration may be shorter
    or longer than that of the given plan.

    Parameters
    ----------
    plan : Trajectory
        Plan to be retimed, with a duration.
    limits, system
        Limits of derivatives, and of quantities of a system (a flat system, a
        `Crane`, or a function of the jet) or of signals of a loop, as for
        `margins`.
    hold : {"shape", "waypoints", "path"}, optional
        Property that is preserved. "shape": time is scaled uniformly, and the
        derivatives with it, including those at the ends. "waypoints": the times
        of the waypoints are scaled, their prescribed derivatives are preserved,
        and the spline is rebuilt. "path": the geometric path; the time law of the
        returned `Retimed` is optimised. An end at rest remains at rest; if the plan
        starts or ends in motion, the speed there is that of `ends`. A plan that is
        closed and in motion at its ends remains closed. Limits over time (`Limits`
        with during, along or functions) apply at the positions of the given plan at
        these times. Stops and dwells remain, dwells with
        their duration. If accelerations, jerks or quantities that depend on them are
        limited, the plan stops at corners of the path, a cyclic plan also at one
        between its end and its start. The segments of a `PathPlan` get a time law
        each.
    durations : (float, float), optional
        Interval of durations [s] of the search. Default: from 1/64 of the minimum
        that was found (of the plan's duration for "waypoints") to 64 times the
        plan's duration, and to longer ones while the violation falls.
    tail : float, optional
        Time after the plan [s] for which a loop is simulated, as for `margins`.
    resolution : float, optional
        Margin relative to the range of a limit, for limits on signals of a linear
        loop: shorter feasible durations may be missed if none has a larger one.
    params : mapping of str to float or (float, float), optional
        Values or ranges of parameters of `system`, as for `margins`: limits are
        satisfied for the worst ones.
    ends : {"free", "given"}, optional
        With hold="path", and limits that depend on at most five derivatives: speeds
        where the plan starts or ends in motion, free, or those of the given plan.
    quantities : optional
        Deprecated name of `system`.

    Returns
    -------
    Fastest
        With the attributes plan, duration, margins, active (the active limit),
        feasible, hold, limited, rejection and searched.

    Raises
    ------
    ValueError
        If no duration is feasible: the message states the violated limit, the
        value and the time. If limits are wrong, the plan does not move, or a
        limited signal is infinite at a jump of a lower derivative. If the plan is
        shaped (`Shaper`), since another duration would change the delays. If limits
        of a loop are violated in its steady state. If `hold` is "path" and the plan
        jumps, limits are not local in time, or do not bound the speed; or if a
        limit depends on derivatives of order 6 or higher and the plan is closed and in
        motion at its ends.
    RuntimeError
        If a quantity is not resolved because it is noisy or oscillates.

    Warns
    -----
    UserWarning
        If the plan is slower than its time law, because limits over time change
        within too short a part of the path.

    Notes
    -----
    With fixed shape, limits on derivatives have the closed-form solution
    T = T_0 max_k (peak_k/limit_k)^(1/k). All other cases require a search, since
    feasibility may not be monotone in the duration (a quintic from 0 to 1 with end
    speeds 1 has no acceleration in 1 s, but has some in 0.8 s and in 2 s). Limits
    are evaluated on samples at 24 durations per octave, local minima of the
    violation are refined, and the ends of all feasible intervals are computed
    with the extrema over the whole plan. The returned plan satisfies every limit:
    of derivatives exactly, of quantities to the tolerance of `margins`, and up to
    rounding where a limit is attained at rest. Inside the intervals of
    `Fastest.feasible` limits were evaluated at samples only.

    Limits on signals of a linear continuous loop, with fixed shape, are evaluated
    with the exact response over all times, from rest at the first position of the
    plan. At a fixed fraction of the plan, and at a fixed time after it, a signal
    is a smooth function of the logarithm of the duration, and moments of the
    loop's impulse responses bound its curvature. Between two durations the excess
    over a limit is at least the chord minus this bound; intervals in which that is
    positive are excluded, others are halved. No shorter duration of the search
    satisfies every limit with a margin above `resolution`, as
    `Fastest.statement` says; longer durations are not searched.

    With hold="waypoints", and for other loops, limits on signals of a loop are
    evaluated by its response at 12 durations per octave, and local minima of the
    violation are refined, up to the first feasible duration. A feasible interval
    that is shorter than these, and is not preceded by a decrease of the violation,
    may be missed.

    With fixed path and limits of velocities and accelerations, the squared rate b(s)
    of the time law is a quadratic spline, for which these limits are linear and
    the duration is convex [1]_. Its cells are refined until the signals are on
    average within 0.5 % of a limit, so that the duration is at most about 0.3 %
    above the time-optimal one; the acceleration is continuous. No cell of the path
    violates a limit. With limits of jerks, b is a quartic spline, found by a sequence
    of convex problems: a local minimum; the jerk is continuous between stops where
    that of the path is.

    The states and inputs of a vehicle along a `PathPlan` are evaluated through the path
    parameter s. There a limited signal is c(s) + g(s) s', as the speed, the steering
    rate and the rate of the heading, or c(s) + A(s) s'^2 + B(s) s'', as the rate of the
    speed. Limits of the first kind bound b and those of the second one are linear in
    b, so that the time laws are the fastest ones up to the same 0.3 %, or 0.5 % without
    limits of the second kind.

    With fixed path and other limits (quantities, derivatives of order 4, accelerations
    of one sign) that depend on at most five derivatives of the plan, the quartic spline is found by a sequence of
    linearised problems: a local minimum. Its cells are divided while that shortens
    the duration by more than 0.1 %. For a crane it was within 0.5 % of nonlinear
    programs whose laws satisfy the limits between their points as well. The law has
    four continuous derivatives between stops. With limits that depend on a sixth one or higher the rate
    is a spline with 16 knots in the time of the given plan, and the duration depends
    on the timing of that plan.

    References
    ----------
    .. [1] D. Verscheure, B. Demeulenaere, J. Swevers, J. De Schutter, M. Diehl:
       Time-optimal path tracking for robots: a convex optimization approach. IEEE
       Transactions on Automatic Control 54 (2009) 2318-2327.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> found = cp.fastest(move, {"y_d1": 0.5, "y_d2": 2.0})
    >>> round(found.duration, 9), found.active.bound.name
    (3.75, 'y_d1')

    One revolution of a motor in minimum time with 120 V:

    >>> turn = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(2, 6.28, 0, 0, 0)])
    >>> found = cp.fastest(turn, {"voltage": 120.0}, cp.plants.dc_motor())
    >>> round(found.duration, 3), found.active.bound.name
    (1.863, 'voltage')
    """
    if hold not in get_args(Hold):
        raise ValueError(f"hold must be one of {', '.join(get_args(Hold))}, got {hold!r}")
    span = None if durations is None else checked_pair(durations, "durations")
    if span is not None and not (span[0] > 0.0 and math.isfinite(span[1])):
        raise ValueError(f"durations must be above 0 and finite, got {span[0]:g} to {span[1]:g}")
    if ends not in get_args(Ends):
        raise ValueError(f"ends must be one of {', '.join(get_args(Ends))}, got {ends!r}")
    if ends != "free" and (hold != "path" or params):
        raise ValueError(f'ends must be "free" unless hold is "path", without params, got {ends!r} with hold {hold!r}')
    spare, chosen = checked_finite(resolution, "resolution", above=0.0), system_given(system, quantities)
    if not params:
        limited = Limited(plan, limits, chosen, tail)
        with limited.naming_plants():
            return fastest_under(plan, limited, hold, span, spare, ends)
    from ctrlplan.planning.parameters import Family
    from ctrlplan.planning.robust import fastest_over

    family = Family.of(chosen, params)
    if not family.ranges:
        return fastest_under(plan, family.limited(plan, limits, (), tail), hold, span, spare)
    if hold == "path":
        raise ValueError('hold must be "shape" or "waypoints" with ranges of parameters, got "path"')
    return fastest_over(plan, limits, family, hold, span, tail, spare)


def fastest_under(
    plan: Trajectory,
    limited: Limited,
    hold: Hold,
    span: tuple[float, float] | None,
    resolution: float,
    ends: Ends = "free",
) -> Fastest:
    """Plan of minimum duration, for precomputed limits; arguments as for `fastest`."""
    if hold != "path":
        limited.check_smooth(plan)
    if not _moves(plan):
        raise ValueError(f"plan must move, got constant axes: {plan!r}")
    if hold == "waypoints" and isinstance(plan, WaypointSpline):
        _check_waypoints(plan, limited)
    found = _fastest(plan, limited, hold, span, resolution, ends)
    _check_not_vanishing(plan, found)
    return found


def _fastest(
    plan: Trajectory,
    limited: Limited,
    hold: Hold,
    span: tuple[float, float] | None,
    resolution: float,
    ends: Ends,
) -> Fastest:
    if limited.loop_bounds:
        return _fastest_in_loop(plan, limited, hold, span, resolution)
    if hold == "waypoints":
        return _searched(ReplannedPlans(plan, limited), span, hold, endless=False)
    if hold == "path":
        return _fastest_on_path(plan, limited, span, ends)
    return fastest_within(plan, limited, span)


def _fastest_on_path(plan: Trajectory, limited: Limited, span: tuple[float, float] | None, ends: Ends) -> Fastest:
    """Plan of minimum duration on its path."""
    signed = any(_is_signed(bound) for bound in limited.bounds)
    if isinstance(plan, PathPlan):  # at rest at its ends as well
        limited.check_constant('limits with hold="path"')
        limited.check_smooth(plan)
        return _fastest_between_stops(plan, limited, span)
    by_derivatives = limited.derivatives_only and limited.order <= 3 and not signed
    passing = not any(_is_signed(bound) and not bound.is_constant for bound in limited.bounds)
    limited.check_constant('limits with hold="path"', over_time=passing)
    if by_derivatives and limited.order <= 2:
        found = _fastest_by_derivatives(plan, limited, span, ends)
        return replace(found, stops=_stops(plan, limited, ends))
    own = _with_smooth_stops(plan, limited, lap=ends == "free")
    if by_derivatives:
        found = _fastest_by_derivatives(own, limited, span, ends)
    else:
        found = (_with_given_speeds if ends == "given" else _fastest_by_signals)(own, limited, span)
    if own is not plan:
        late = found.plan.shift(plan.start)
        found = replace(found, plan=late, margins=limited.margins(late))
    return replace(found, stops=_stops(plan, limited, ends))


def _stops(plan: Trajectory, limited: Limited, ends: Ends) -> tuple[float, ...]:
    """Times [s] at which a plan stops at corners of its path, with limits that require it."""
    return corner_times(plan, lap=ends == "free") if limited.order > 1 else ()


def _with_smooth_stops(plan: Trajectory, limited: Limited, lap: bool) -> Trajectory:
    """Plan with finite limited signals where its path requires a stop, from time 0 on.

    The plan itself if its signals are finite.
    """
    try:
        limited.check_smooth(plan)
    except ValueError as error:
        if plan.jumps(0):
            raise
        if not limited.is_constant:
            raise ValueError(f"{error}; a plan stops at corners with constant limits only") from None
        own = stopping(plan, limited.order, lap)
        with suppress(ValueError):
            limited.check_smooth(own)
            return own
        raise ValueError(
            f"{error}; the path may have corners, where the plan stops, but not jumps of its derivatives in motion: "
            "give a spline on it with velocities and accelerations at its waypoints"
        ) from None
    return plan


def _fastest_by_signals(plan: Trajectory, limited: Limited, span: tuple[float, float] | None) -> Fastest:
    """Plan of short duration on its path, under limits of any signals."""
    # The values of the time law are times: relative to the start they have full precision.
    start, law = plan.start, None
    on_path = limited if limited.is_constant else limited.at_positions()
    if limited.order <= HIGHEST:
        _check_rest(plan, limited)
        _check_signs(plan, limited, given=False)
        _closed_form(plan, limited, 1)  # raises for a direction in which no velocity is allowed
        for other in fast_laws_of_signals(plan.shift(-start), limited, start):
            try:
                found = _at_its_limit(other.shift(start), on_path) if span is None else None
            except RuntimeError:  # a quantity is not resolved where derivatives of the law multiply rounding
                continue
            if found is not None:
                return found
            law = other if law is None else law
            if span is not None:
                break
        signed = [bound for bound in limited.bounds if _is_signed(bound)]
        if signed:
            raise ValueError(
                f"limits of {signed[0].name} must allow both signs unless a time law on the path has one sign "
                f"throughout, got {signed[0].range}, and no such law is found; give a small limit instead of 0"
            )
    else:
        _check_open(plan)
    uniform = fastest_within(plan, limited, span)
    if limited.order > HIGHEST:
        law = with_fast_time_law(uniform.plan.shift(-start), limited)
    retimed = uniform if law is None else fastest_within(law.shift(start), on_path, span)
    if retimed is uniform and limited.order <= HIGHEST:
        return replace(uniform, hold="path", statement=_GIVEN)
    return replace(min(retimed, uniform, key=lambda found: found.duration), hold="path")


def _with_given_speeds(plan: Trajectory, limited: Limited, span: tuple[float, float] | None) -> Fastest:
    """Plan of short duration on its path with its speeds at the ends, under limits of any signals."""
    if limited.order > HIGHEST:
        raise ValueError(
            f'ends must be "free" with limits that depend on derivatives of order {HIGHEST + 1} and higher, got '
            f'"given" with those of order {limited.order}; limit lower derivatives, or use hold="waypoints"'
        )
    _check_rest(plan, limited)
    _check_signs(plan, limited, given=True)
    begun = plan.shift(-plan.start)  # the values of the time law are times
    statements: list[str] = []

    def law(reserve: float) -> Trajectory:
        found = law_with_given_ends(begun, limited, plan.start, reserve)
        statements.append(_GIVEN if found is begun else _LOCAL)
        if found is begun and not limited.is_constant:  # limits apply at values of a law
            found = Retimed(begun, PolySpline([Waypoint(0.0, 0.0), Waypoint(begun.end, begun.end)]))
        return found.shift(plan.start)

    on_path = limited if limited.is_constant else limited.at_positions()
    found, margins = _with_reserves(plan, on_path, span, law)
    return Fastest(found, margins, ((found.duration, found.duration),), "path", on_path, statement=statements[-1])


def _check_waypoints(plan: WaypointSpline, limited: Limited) -> None:
    """Raise for derivatives that waypoints prescribe, at every duration, and that violate a limit."""
    for bound in limited.bounds:
        if bound.axis is None or not bound.is_constant:
            continue
        for point in plan.waypoints:
            value = float(point.jet[bound.order, bound.axis]) if bound.order < len(point.jet) else math.nan
            if bound.excess(np.array([value]))[0] > _AT_ENDS:
                further = '; or use hold="shape", which scales the derivatives' if bound.order else ""
                raise ValueError(
                    f"limits must be satisfied at the waypoints, at any duration, got {bound.name} "
                    f"= {value:.6g} of the waypoint at {point.time:.6g} s, where it must be {bound.range}{further}"
                )


def _check_not_vanishing(plan: Trajectory, found: Fastest) -> None:
    """Raise an error if a violation passes for rounding only because the plan is slow.

    A signal with a limit of 0 that it has at rest may pass it by rounding. If it passes
    the limit at every duration, its violation tends to 0 with its speed, and falls
    below any rounding; at a duration that satisfies the limit, that of a slower
    plan is far smaller.
    """
    row, limited = found.active, found.limited
    slack = row.bound.slack
    if slack - row.fraction <= 0.5 * slack:
        return
    longer = 1.01 * found.plan.duration
    slower = ReplannedPlans(plan, limited).plan(longer) if found.hold == "waypoints" else found.plan.retime(longer)
    if any(slack - other.fraction > 0.5 * slack for other in limited.margins(slower).rows if other.of(row.bound)):
        with suppress(ValueError):  # infeasible for the plant in its own duration
            row = next(own for own in limited.margins(plan) if own.of(row.bound))
        raise ValueError(
            "limits must be satisfied for some duration, got a violation that tends to 0 only with the speed of the "
            f"plan: {row}; give a small limit instead of 0, or another shape of the plan"
        )


def _fastest_between_stops(plan: PathPlan, limited: Limited, span: tuple[float, float] | None) -> Fastest:
    """Plan with a time law of minimum duration for each segment; the stops make them independent."""
    _check_rest(plan, limited)
    orders = orders_on_path(plan, limited)
    if orders is not None and not any(orders):
        raise ValueError("limits must include one that a shorter plan would violate, got none")
    scaled = plan if orders is not None else plan.retime(fastest_within(plan, limited, span).duration)
    laws: list[Trajectory] = []
    for curve, direction, law in zip(plan.segments, plan.directions, scaled.laws, strict=True):
        # The values of the time law are times: relative to the start they have full precision.
        part = PathPlan([curve], [direction], law.shift(-law.start), labels=plan.labels)
        own = limited.of(part)
        if orders is not None:
            laws.append(fastest_segment_law(part, own, orders))
        else:
            seen = own.seen(part)
            if own.order <= HIGHEST:
                fast_part = next(fast_laws_of_signals(seen, own, 0.0), None)
            else:
                fast_part = with_fast_time_law(seen, own)
            laws.append(part.laws[0] if fast_part is None else Retimed(part.laws[0], fast_part.law))
    fast = plan.with_laws(laws).shift(plan.start - laws[0].start)
    if orders is None:
        return replace(fastest_within(fast, limited, span), hold="path")
    return _scaled_by_orders(fast, limited, orders, span)


def _scaled_by_orders(
    plan: PathPlan, limited: Limited, orders: Sequence[int], span: tuple[float, float] | None
) -> Fastest:
    """Plan of minimum duration with fixed shape, for signals that are proportional to powers of the pace."""
    order_of = list(zip(limited.bounds, orders, strict=True))
    rows = [(row, order) for row in limited.margins(plan) for bound, order in order_of if row.of(bound) and order]
    searched = span or (0.0, math.inf)
    duration = plan.duration * max((1.0 - row.fraction) ** (1.0 / order) for row, order in rows) * _ABOVE
    duration = max(duration, searched[0])
    found = limited.margins(plan.retime(duration))
    while found.active.fraction < 0.0:  # by rounding, or of a signal with a constant part
        duration *= 1.0 + min(-found.active.fraction, 1.0) + _RESOLVED
        found = limited.margins(plan.retime(duration))
    if duration > searched[1]:
        raise ValueError(
            f"limits must be satisfied for some duration from {searched[0]:.4g} to {searched[1]:.4g} s, got a minimum "
            f"of {duration:.6g} s"
        )
    fast = plan.retime(duration)
    return Fastest(fast, found, ((fast.duration, searched[1]),), "path", limited, searched=searched)


def _moves(plan: Trajectory) -> bool:
    """Whether a position changes by more than rounding: from start to end, otherwise over the whole plan."""
    if (np.abs(plan.final - plan.initial) > 1e-12 * np.maximum(np.abs(plan.initial), np.abs(plan.final))).any():
        return True
    positions = np.concatenate([plan(plan.breakpoints), plan(0.5 * (plan.breakpoints[1:] + plan.breakpoints[:-1]))], -1)
    if (np.ptp(positions, axis=-1) > 1e-12 * np.abs(positions).max(axis=-1)).any():
        return True
    extrema = plan.extrema()
    return bool((extrema.maximum - extrema.minimum > 1e-14 * plan.peak()).any())


def _fastest_in_loop(
    plan: Trajectory, limited: Limited, hold: Hold, span: tuple[float, float] | None, resolution: float
) -> Fastest:
    """Plan of minimum duration under limits on signals of a loop."""
    if hold == "path":
        limited.check_constant('limits with hold="path"')
    _check_rest(plan, limited)
    minimum = _closed_form(plan, limited) if hold == "shape" else 0.0
    limited.check_ends(plan)
    shapes = shapes_given(limited.loop)
    if shapes is None or hold == "waypoints" or not bounds_of_values(limited):
        family = _InLoop(PlansByDuration(plan, limited) if hold == "shape" else ReplannedPlans(plan, limited))
        return _first_feasible(family, span or _span(family, plan.duration, minimum), hold)
    problem = LoopProblem(plan, limited, shapes, resolution)
    shortest, searched = problem.shortest(span, minimum)
    found, margins = _satisfying(limited, plan.retime, shortest)
    feasible = ((found.duration, found.duration),)
    statement = problem.statement(*searched, minimum)
    return Fastest(found, margins, feasible, "shape", limited, "", searched, statement)


def _fastest_by_derivatives(
    plan: Trajectory, limited: Limited, span: tuple[float, float] | None, ends: Ends
) -> Fastest:
    """Plan of minimum duration on its path, under limits of velocities, accelerations and jerks."""
    limited.check_constant('limits with hold="path"', over_time=True)
    for jump in plan.jumps(0):
        raise ValueError(
            f"plan must be continuous, got {jump.label} that jumps by {jump.size:.4g} at {time_text(jump.time)} s"
        )
    _check_rest(plan, limited)
    if not limited.order:
        raise ValueError("limits must include one that a shorter plan would violate, got none")
    _closed_form(plan, limited)  # raises for a direction in which no velocity is allowed
    _check_velocities_at_rest(plan, limited)
    on_path = limited if limited.is_constant else limited.at_positions()
    find = _with_given_ends if ends == "given" else _with_free_ends
    found, margins = find(plan, on_path, span)
    searched = span or (0.0, math.inf)
    feasible = ((found.duration, found.duration if ends == "given" else searched[1]),)
    return Fastest(found, margins, feasible, "path", on_path, searched=searched)


def _with_free_ends(plan: Trajectory, limited: Limited, span: tuple[float, float] | None) -> tuple[Trajectory, Margins]:
    """Fastest plan on a path with any speeds at its ends, and its margins."""
    found, slower = _law_under_narrow_limits(plan, limited)
    shortest = max(_closed_form(found, limited), found.duration * slower) * _ABOVE
    if span is not None and max(shortest, span[0]) > span[1]:
        raise ValueError(
            f"limits must be satisfied for some duration from {span[0]:.4g} to {span[1]:.4g} s, got a minimum of "
            f"{shortest:.6g} s"
        )
    most = _UNRESOLVED if slower else _ROUNDED
    fast, margins = _satisfying(limited, found.retime, shortest if span is None else max(shortest, span[0]), most)
    if slower and span is None and fast.duration > _NARROW * found.duration:
        warnings.warn(
            f"the plan is slowed by the factor {fast.duration / found.duration:.3g}, since limits over time change "
            f"within a short part of the path, {margins.active.when}; let them change within a longer part",
            UserWarning,
            stacklevel=outside_stacklevel(),
        )
    return fast, margins


def _law_under_narrow_limits(
    plan: Trajectory, limited: Limited, given: Rates = (None, None), reserve: float = 0.0
) -> tuple[Retimed, float]:
    """Plan with a fast law and the factor by which it must be slower; finer cells where limits over time need them."""
    law, narrow = _law_on_path(plan, limited, given, reserve), list[float]()
    bounds = [bound for bound in limited.bounds if _is_over_time(bound)]
    if not bounds:
        return law, 0.0
    for _ in range(_PLACES):
        slower, time, bound = _slowest(plan, law, bounds)
        if slower <= _NARROW:
            return law, slower
        _check_passable(plan, bound, time)
        narrow += (time + plan.duration * np.concatenate([[0.0], _ABOUT_NARROW, -_ABOUT_NARROW])).tolist()
        try:
            law = _law_on_path(plan, limited, given, reserve, narrow)
        except ValueError:  # cells too different for their linear equations
            break
    return law, _slowest(plan, law, bounds)[0]


def _slowest(plan: Trajectory, fast: Retimed, bounds: Sequence[Bound]) -> tuple[float, float, Bound]:
    """Largest factor by which a plan must be slower, the time [s] of the given plan, and the limit over time."""
    found = [(*required_rate(bound, fast, plan.start), bound) for bound in bounds]
    return max(found, key=lambda own: own[0])


def _check_passable(plan: Trajectory, bound: Bound, time: float) -> None:
    """Raise for a limit of a velocity that is 0 where the path moves, which no time law passes."""
    low, high = bound.sides(np.append(np.linspace(plan.start, plan.end, 65), time))
    limit = min(abs(float(high[-1])), abs(float(low[-1])))
    if bound.order == 1 and limit <= _ZERO * max(
        np.abs(side[np.isfinite(side)]).max(initial=0.0) for side in (low, high)
    ):
        raise ValueError(
            f"limits of {bound.name} must not be 0 where the path moves, got from {low[-1]:.4g} to {high[-1]:.4g} at "
            f"{time_text(time)} s of the given plan; give a limit above 0 there, or stop the plan there"
        )


def _with_given_ends(
    plan: Trajectory, limited: Limited, span: tuple[float, float] | None
) -> tuple[Trajectory, Margins]:
    """The same with the speeds of the plan at its ends."""

    def law(reserve: float) -> Trajectory:
        return _law_under_narrow_limits(plan, limited, (1.0, 1.0), reserve)[0]

    return _with_reserves(plan, limited, span, law)


def _with_reserves(
    plan: Trajectory,
    limited: Limited,
    span: tuple[float, float] | None,
    law_with_reserve: Callable[[float], Trajectory],
) -> tuple[Trajectory, Margins]:
    """Plan with given speeds at its ends, with which it cannot be retimed, and its margins.

    `law_with_reserve` returns a plan with a distance from the limits, relative to
    them; the smallest distance is taken with which the limits are satisfied.
    """
    if span is not None:
        raise ValueError(
            f'durations must not be given with ends="given", got {span[0]:g} to {span[1]:g} s: at other durations the '
            "speeds at the ends are others"
        )
    _check_given_speeds(plan, limited)
    for reserve in _RESERVES:
        found = law_with_reserve(reserve)
        margins = limited.margins(found)
        if margins.active.fraction >= -_AT_ENDS:
            return found, margins
    raise ValueError(
        f"limits must be satisfied with the speeds at the ends, got {margins.active}; raise this limit, lower the "
        "speeds, or choose free ends"
    )


def _check_given_speeds(plan: Trajectory, limited: Limited) -> None:
    """Raise for limits of speeds that those at the ends violate."""
    for time in (plan.start, plan.end):
        jet = limited.seen(plan).jet([time], limited.order, left=time > plan.start)
        for bound, value in zip(limited.bounds, limited.values(jet)[:, 0].tolist(), strict=True):
            low, high = (float(side[0]) for side in bound.sides(np.array([time])))
            if bound.order <= 1 and max(low - value, value - high) > 1e-9 * bound.scale:
                raise ValueError(
                    f"limits must be satisfied with the speeds at the ends, got {bound.name} = {value:.6g} at {time:g} "
                    f"s where it must be from {low:.6g} to {high:.6g}; raise this limit, lower the speed, or choose "
                    "free ends"
                )


def _law_on_path(
    plan: Trajectory,
    limited: Limited,
    given: Rates = (None, None),
    reserve: float = 0.0,
    narrow: Sequence[float] = (),
) -> Retimed:
    """Plan with a fast time law; positions in the path have full precision relative to its start."""
    begun = plan.shift(-plan.start) if plan.start else plan
    fast_law = fastest_smooth_law if limited.order == 3 else fastest_law
    found = fast_law(begun, limited.bounds, plan.start, given, reserve, narrow)
    return found.shift(plan.start) if plan.start else found


def _check_signs(plan: Trajectory, limited: Limited, given: bool) -> None:
    """Raise for accelerations of one sign where every time law has the other one."""
    for bound in (own for own in limited.bounds if _is_signed(own) and own.order == 2):
        forbidden = 1.0 if bound.high == 0.0 else -1.0
        times, velocities = _velocities(plan, bound.axis or 0)
        still = np.flatnonzero(velocities == 0.0)
        # From rest in a direction with an acceleration in it, to rest with one against it.
        wrong = [k for k in still if (forbidden * np.append(velocities[k:], -velocities[:k]) > 0.0).any()]
        change = forbidden * float(np.diff(velocities[[0, -1]])[0])
        if wrong or (given and change > 0.0):
            where = f"is at rest at {times[wrong[0]]:.6g} s" if wrong else "changes its speed from the start to the end"
            raise ValueError(
                f'limits of {bound.name} must allow both signs with hold="path", got {bound.range}: every time law has '
                f"the other one, since {plan.labels[bound.axis or 0]} {where} of the plan; give a small limit "
                "instead of 0"
            )


def _is_signed(bound: Bound) -> bool:
    """Whether a limit of a higher derivative of an axis forbids a sign."""
    return bound.axis is not None and bound.order > 1 and 0.0 in (bound.low, bound.high)


def _velocities(plan: Trajectory, axis: int) -> tuple[Array, Array]:
    """Times [s] and velocities of an axis at samples, those of rest 0, and at changes of the direction between."""
    inside = plan.breakpoints[:-1, None] + np.diff(plan.breakpoints)[:, None] * np.linspace(0.0, 1.0, 65)[1:-1]
    times = np.unique(np.concatenate([plan.breakpoints, inside.ravel(), [point.time for point in plan.waypoints]]))
    velocities = plan.jet(times, 1, left=True)[1, axis]
    velocities[0] = plan.jet(times[0], 1)[1, axis]
    velocities[np.abs(velocities) <= 1e-9 * np.abs(velocities).max()] = 0.0
    turns = 1 + np.flatnonzero(velocities[1:] * velocities[:-1] < 0.0)
    return np.insert(times, turns, times[turns]), np.insert(velocities, turns, 0.0)


def _is_over_time(bound: Bound) -> bool:
    return not bound.is_constant and bound.order > 0


def _at_its_limit(plan: Trajectory, limited: Limited) -> Fastest | None:
    """Plan of fixed shape near a duration at which its active limit is attained; None if not found in a few steps.

    The duration is that at which the highest of the signals' peaks attains its limit,
    then that at which the extremum of the whole plan does. If there is none nearby,
    the shortest plan found that satisfies the limits.
    """
    best, longest = None, _SLOWED * plan.duration
    at_peaks = excess_at_peaks(plan, limited)
    factor = _nearest_root(lambda factor: at_peaks(factor) + 0.5 * _ACTIVE)
    if factor is None:
        factor = 1.0
        if at_peaks(factor) > 0.0:
            return None
    if factor > _SLOWED:
        return None
    plan = plan.retime(factor * plan.duration)
    for _ in range(_EVALUATIONS):
        margins = limited.margins(plan)
        active = margins.active
        if active.fraction >= 0.0 and (best is None or plan.duration < best.duration):
            best = Fastest(plan, margins, ((plan.duration, plan.duration),), "path", limited, statement=_LOCAL)
        if 0.0 <= active.fraction <= _ACTIVE:
            break
        row = next(k for k, bound in enumerate(limited.bounds) if active.of(bound))
        jet = np.stack([plan.jet(active.time, limited.order, left=left) for left in (True, False)], axis=-1)
        powers = -np.arange(float(len(jet)))[:, None, None]

        def excess(
            factor: float, jet: Array = jet, powers: Array = powers, row: int = row, own: Bound = active.bound
        ) -> float:
            return float(own.excess(limited.values(jet * factor**powers)[row]).max())

        factor = _nearest_root(excess)
        if factor is None or factor * plan.duration > longest:
            break
        plan = plan.retime(plan.duration * factor * (1.0 + 0.1 * _ACTIVE))
    return best


def _nearest_root(excess: Callable[[float], float]) -> float | None:
    """Factor of a duration near 1 at which an excess vanishes, above 1 if it is violated there; None if none is near.

    The excess of a signal that depends on differences of large terms is no monotone function of the duration.
    """
    try:
        beyond = excess(1.0) > 0.0
        factors = 1.0 + (1.0 if beyond else -1.0) * np.append(0.0, _NEARBY)
        for near, far in pairwise(factors.tolist()):
            if (excess(far) > 0.0) != beyond:
                return float(brentq(excess, near, far, xtol=1e-15))
    except ValueError:  # infeasible for the plant
        pass
    return None


def _check_open(plan: Trajectory) -> None:
    """Raise for a plan that is closed and in motion at its ends, for which a time law has different end velocities."""
    first, last = plan.jet(plan.start, 2), plan.jet(plan.end, 2, left=True)
    size, extrema = np.stack([plan.peak(nu) for nu in range(3)]), plan.extrema()
    slack = 1e-9 * size
    slack[0] = 1e-9 * (extrema.maximum - extrema.minimum) + 1e-14 * size[0]
    slack[:, constant_axes(extrema.minimum, extrema.maximum)] = np.inf
    same = [bool(row.all()) for row in np.abs(last - first) <= slack]
    moves = [bool(row.any()) for row in np.abs(first) > slack]
    if same[0] and same[1] and (moves[1] or (same[2] and moves[2])):
        raise ValueError(
            f"hold must be 'shape' or 'waypoints' for a closed plan, got 'path': from {plan.start:g} s to {plan.end:g} "
            f"s the plan returns to its position and velocity, and a time law with free ends would make them differ"
        )


def fastest_within(plan: Trajectory, limited: Limited, span: tuple[float, float] | None = None) -> Fastest:
    """Plan of minimum duration with fixed shape, for precomputed limits."""
    scaled = PlansByDuration(plan, limited)
    _check_rest(plan, limited)
    minimum = _closed_form(plan, limited)
    if limited.derivatives_only and limited.is_constant and span is None:
        if not minimum:
            raise ValueError("limits must include one that a shorter plan would violate, got none")
        found, margins = _satisfying(limited, plan.retime, minimum * (1.0 + 2.0 * np.finfo(float).eps))
        return Fastest(found, margins, ((found.duration, math.inf),), "shape", limited)
    if limited.may_end:
        return _searched(scaled, span, "shape", endless=False)
    return _searched(scaled, span or _span(scaled, plan.duration, minimum), "shape", endless=True)


class _InLoop:
    """Plans under limits that include those of signals of a loop."""

    per_octave = 12

    def __init__(self, family: PlansByDuration) -> None:
        self.plan, self.limited, self._own = family.plan, family.limited, family.excess
        self.excess = cache(self._excess)

    def exact_excess(self, duration: float) -> float:
        """Maximum excess over the whole plan."""
        return self.limited.exact_excess(self.plan(duration))

    def _excess(self, duration: float) -> float:
        own = self._own(duration)
        return own if math.isinf(own) and own > 0.0 else max(own, self.limited.loop_excess(self.plan(duration)))


def _first_feasible(family: _InLoop, span: tuple[float, float], hold: Hold) -> Fastest:
    """Plan of minimum duration under limits of a loop whose runs are slow: the search ends at the first duration."""
    limited = family.limited
    resolution = _EDGE if shapes_given(limited.loop) is None else _ROUNDING
    exact = cache(lambda duration: limited.exact_excess(family.plan(duration)))
    count = max(9, math.ceil(family.per_octave * math.log2(span[1] / span[0])))
    grid, known = np.geomspace(*span, count), 0
    for k, duration in enumerate(grid.tolist()):
        if family.excess(duration) > 0.0 and k + 1 < count:
            continue
        durations, excess = scan(family.excess, grid[known : k + 1], 0.0, _COARSE)
        for inside in np.flatnonzero(excess <= 0.0).tolist():
            outside = float(durations[inside - 1]) if inside else 0.0
            found = _exact_edge(exact, family.excess, float(durations[inside]), outside, resolution)
            if found is not None:
                statement = (
                    f"violate a limit at {family.per_octave} durations per octave from {span[0]:.4g} s on, and "
                    "at the local minima of the violation between them"
                )
                plan, feasible = family.plan(found), ((found, found),)
                return Fastest(plan, limited.margins(plan), feasible, hold, limited, "", (span[0], found), statement)
        known = k
    excess = np.array([family.excess(duration) for duration in grid.tolist()])
    return _reject(family, grid, excess)


def _exact_edge(
    exact: Callable[[float], float],
    sampled: Callable[[float], float],
    inside: float,
    outside: float,
    resolution: float,
) -> float | None:
    """Shortest feasible duration near one that is feasible at samples; None if none is near it."""
    if outside > 0.0 and sampled(outside) > 0.0:
        inside, outside = bisected(lambda duration: sampled(duration) <= 0.0, inside, outside, 0.0, 1e-4)
    good, step = inside, 1e-6 * inside
    while exact(good) > 0.0:  # violated between samples, or by less than these resolve
        outside, good, step = good, good + step, 8.0 * step
        if step > 0.1 * inside:
            return None
    if outside <= 0.0 or exact(outside) <= 0.0:
        return good
    return bisected(lambda duration: exact(duration) <= 0.0, good, outside, 0.0, resolution)[0]


def _check_rest(plan: Trajectory, limited: Limited) -> None:
    """Raise for limits of positions and quantities that are violated at every duration."""
    for bound, value, position in limited.violated_at_rest(plan):
        places = zip(plan.labels, position.tolist(), strict=True)
        where = ", ".join(f"{label} = {place:.4g}" for label, place in places)
        raise ValueError(
            f"limits must be satisfied at rest, at any duration, got {bound.name} = {value:.6g} at rest "
            f"at {where}, where it must be {bound.range}"
        )


def _check_velocities_at_rest(plan: Trajectory, limited: Limited) -> None:
    """Raise for limits of velocities over time that exclude 0 where the plan is at rest, with any time law."""
    for bound in limited.bounds:
        if bound.axis is None or bound.order != 1 or bound.is_constant:
            continue
        still = (
            np.abs(plan(plan.breakpoints, 1)).reshape(plan.naxes, -1)[bound.axis] <= _ZERO * plan.peak(1)[bound.axis]
        )
        times = plan.breakpoints[still]
        low, high = bound.sides(times)
        for k in np.flatnonzero((low > 0.0) | (high < 0.0))[:1].tolist():
            raise ValueError(
                f"limits of {bound.name} must include 0, the value at rest, got from {low[k]:.4g} to {high[k]:.4g} at "
                f"{time_text(times[k])} s of the given plan, where it is at rest"
            )


def _closed_form(plan: Trajectory, limited: Limited, highest: float = math.inf) -> float:
    """Minimum duration for limits of derivatives up to an order, T_0 max_k (peak_k/limit_k)^(1/k)."""
    minimum, seen = 0.0, limited.seen(plan)
    bounds = [b for b in limited.bounds if b.axis is not None and 0 < b.order <= highest and b.is_constant]
    search_extrema(seen, {bound.order for bound in bounds})
    for bound in bounds:
        extrema = seen.extrema(bound.order)
        sides = (
            (float(extrema.maximum[bound.axis]), bound.high, float(extrema.time_max[bound.axis])),
            (-float(extrema.minimum[bound.axis]), -bound.low, float(extrema.time_min[bound.axis])),
        )
        rounding = 1e-12 * max(abs(value) for value, _, _ in sides)
        for value, side, time in sides:
            if side > 0.0:
                minimum = max(minimum, plan.duration * (max(value, 0.0) / side) ** (1.0 / bound.order))
            elif value > rounding:  # a sign that violates the limit at any duration
                raise ValueError(
                    f"limits must be satisfied for some duration, got {bound.name} of both signs where it must be "
                    f"{bound.range}: its sign at {time_text(time)} s is the same at every duration"
                )
    return minimum


def _around(duration: float) -> tuple[float, float]:
    return duration / 64.0, 64.0 * duration


def _span(scaled: PlansByDuration | _InLoop, duration: float, minimum: float) -> tuple[float, float]:
    """Interval of durations of the search, from violated to satisfied limits."""
    excess, high = scaled.excess, max(duration, minimum)
    for _ in range(_DOUBLINGS_IN_LOOP if isinstance(scaled, _InLoop) else 60):
        if excess(high) <= 0.0 and scaled.exact_excess(1.01 * high) <= 0.0:
            break
        high *= 2.0
    else:
        if math.isinf(excess(high)):
            # Raises the reason. The longest durations are no use in the message about a plant.
            scaled.limited.margins(scaled.plan(high if isinstance(scaled, _InLoop) else max(duration, minimum)))
        raise ValueError(
            f"limits must be satisfied for some duration, got none up to {high:.3g} s; for a wider search pass "
            "durations=(low, high)"
        )
    low = high / 64.0
    while low > minimum and excess(low) <= 0.0:
        low /= 64.0
        if low < 1e-12 * high:
            further = (
                f": a plan of {low:.3g} s satisfies all of them; pass durations=(low, high) for a search between two "
                "durations"
                if isinstance(scaled, _InLoop)
                else ""
            )
            raise ValueError(f"limits must include one that a shorter plan would violate, got none{further}")
    return max(low, 0.999 * minimum), 1.01 * high


def _searched(family: PlansByDuration, span: tuple[float, float] | None, hold: Hold, endless: bool) -> Fastest:
    """Plan of minimum duration, and all feasible durations; `endless` if every slower plan is feasible."""
    limited = family.limited
    durations, excess = _scanned(family, span)
    feasible = []
    for low, high in _runs(excess <= 0.0):
        middle = _feasible_inside(family, durations, excess, low, high)
        if middle is None:
            continue
        ends = [
            float(durations[inner])
            if not 0 <= outer < durations.size
            else _edge(family, middle, float(durations[inner]), float(durations[outer]))
            for inner, outer in ((low, low - 1), (high, high + 1))
        ]
        feasible.append((ends[0], ends[1]))
    if not feasible:
        _reject(family, durations, excess)
    if endless and feasible[-1][1] == durations[-1]:
        feasible[-1] = (feasible[-1][0], math.inf)
    shortest = feasible[0][0]
    known = family.margins(shortest) if family.is_known(shortest) else None
    if known is not None and known.satisfied:
        plan, found = family.plan(shortest), known
    else:
        plan, found = _satisfying(limited, family.plan, shortest)
    # If no limit is active, shorter plans are infeasible for the plant.
    rejection = limited.rejection(family.plan(0.99 * plan.duration)) if found.active.fraction > 1e-6 else ""
    searched = (float(durations[0]), math.inf if math.isinf(feasible[-1][1]) else float(durations[-1]))
    return Fastest(plan, found, tuple(feasible), hold, limited, rejection, searched)


def _runs(inside: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of true."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]])))
    return [(int(a), int(b) - 1) for a, b in change.reshape(-1, 2)]


def _scanned(family: PlansByDuration, span: tuple[float, float] | None) -> tuple[Array, Array]:
    """Durations of a search, increasing, and their excess; without a span the search goes on while the excess falls."""
    low, high = span or _around(family.given.duration)
    durations, excess = _scan(family, low, high)
    while span is None and excess.min() > 0.0 and excess[-1] < _FALLS * family.excess(0.5 * high):
        low, high = high, 64.0 * high
        more, values = _scan(family, low, high)
        durations, excess = np.append(durations, more[1:]), np.append(excess, values[1:])
    return durations, excess


def _scan(family: PlansByDuration, low: float, high: float) -> tuple[Array, Array]:
    """Durations in an interval, increasing, and their excess."""
    grid = np.geomspace(low, high, max(9, math.ceil(family.per_octave * math.log2(high / low))))
    if isinstance(family, ReplannedPlans) and low < family.given.duration < high:
        # Far from it the given plan may be the only one that satisfies the limits.
        grid = np.insert(grid, np.searchsorted(grid, family.given.duration), family.given.duration)
    return scan(family.excess, grid, 0.0, values=family.excesses(grid))


def _feasible_inside(family: PlansByDuration, durations: Array, excess: Array, low: int, high: int) -> float | None:
    """Feasible duration among those that are feasible at samples, which may miss extrema."""
    inside = durations[low + np.argsort(excess[low : high + 1])[:8]].tolist()
    known = [duration for duration in (durations[low], durations[high]) if family.is_known(float(duration))]
    for duration in [*known, *inside]:
        if family.exact_excess(float(duration)) <= 0.0:
            return float(duration)
    lowest = low + int(excess[low : high + 1].argmin())
    duration, _ = bottom(family.excess, durations, lowest, 1e-7)
    return duration if family.exact_excess(duration) <= 0.0 else None


def _edge(family: PlansByDuration, middle: float, inside: float, outside: float) -> float:
    """Boundary of the feasible durations near one that is feasible at samples, before an infeasible one.

    At the time of the active extremum the excess is a function of the duration
    alone. Its root differs from the boundary by the square of the distance from
    the duration at which that time was found.
    """
    edge, inwards = _sampled_root(family, inside, outside), 1.0 + math.copysign(_INWARDS, inside - outside)
    peak = None if edge is None else family.peak(edge)
    if edge is not None and peak is not None:
        edge = (_root_at(family, edge, *peak) or edge) * inwards
    for _ in range(_STEPS if edge is not None else 0):
        root = None if edge is None else _root_at_extremum(family, edge)
        if root is None or edge is None or not min(inside, outside) <= root <= max(inside, outside):
            break
        if abs(root - edge) <= _NEAR * edge:
            root *= inwards
            # The margins of the former are known.
            return edge if abs(root - edge) <= _SAME * edge and family.exact_excess(edge) <= 0.0 else root
        edge = root
    return _feasible_edge(family.exact_excess, family.excess, middle, outside)


def _sampled_root(family: PlansByDuration, inside: float, outside: float) -> float | None:
    """Duration at which the excess at samples vanishes; None if it jumps."""
    wall = 1e3

    def excess(duration: float) -> float:
        return min(family.excess(duration), wall)

    if not (excess(inside) < 0.0 < excess(outside)):
        return None
    root = float(brentq(excess, inside, outside, xtol=1e-9 * inside, rtol=1e-9))
    return root if abs(family.excess(root)) < 1e-6 else None


def _root_at_extremum(family: PlansByDuration, duration: float) -> float | None:
    """Duration at which the excess vanishes at the time of the active extremum; None if there is none."""
    margins = family.margins(duration)
    if margins is None:
        return None
    bounds, row = family.limited.bounds, margins.active
    chosen = [k for k, bound in enumerate(bounds) if bound == row.bound and bound.is_constant and bound.kind == "value"]
    return _root_at(family, duration, chosen[0], (row.time - family.given.start) / duration) if chosen else None


def _root_at(family: PlansByDuration, duration: float, bound: int, fraction: float) -> float | None:
    """Duration near another at which the excess over a limit vanishes at a relative time; None if there is none."""
    excesses = family.excesses_at(bound, fraction)
    if excesses is None:
        return None
    ends = duration * (1.0 + _WIDTHS[:, None] * np.array([-1.0, 1.0]))
    found = excesses(ends.ravel()).reshape(ends.shape)
    crossed = np.flatnonzero((found[:, 0] > 0.0) != (found[:, 1] > 0.0))
    if not crossed.size or not np.isfinite(found[crossed[0]]).all():
        return None

    k = int(crossed[0])
    return _narrowed(excesses, ends[k], found[k])


def _narrowed(function: Callable[[Array], Array], ends: Array, values: Array) -> float:
    """Point with a value of at most 0 at a change of sign between two ends (2,), by parts about the chord's root."""
    for _ in range(_NARROWINGS):
        width, middle = ends[1] - ends[0], 0.5 * (ends[0] + ends[1])
        if width <= 4.0 * np.finfo(float).eps * ends[1]:
            break
        chord = values[1] - values[0]
        root = ends[0] - values[0] * width / chord if math.isfinite(chord) else middle
        inner = np.sort(np.append(np.clip(root + width * _ABOUT, *ends), middle))
        points, rows = np.concatenate([ends[:1], inner, ends[1:]]), function(inner)
        rows = np.concatenate([values[:1], rows, values[1:]])
        k = int(np.flatnonzero((rows[1:] > 0.0) != (rows[:-1] > 0.0))[0])
        ends, values = points[k : k + 2], rows[k : k + 2]
    return float(ends[0] if values[0] <= 0.0 else ends[1])


def _feasible_edge(
    exact: Callable[[float], float], sampled: Callable[[float], float], inside: float, outside: float
) -> float:
    """Boundary of the feasible durations between a feasible and an infeasible one."""
    # Samples are fast, and give an approximate boundary.
    good, bad = bisected(lambda duration: sampled(duration) <= 0.0, inside, outside, 0.0, 1e-6)
    step = good - bad
    while exact(good) > 0.0:  # violated between samples: move inwards
        good, bad, step = good + step, good, 8.0 * step
        if (good - inside) * step > 0.0:
            good = inside
    step = bad - good
    while (
        exact(bad) <= 0.0 and (outside - bad) * step > 0.0
    ):  # a root mean square of samples may be above the exact one
        good, bad, step = bad, bad + step, 8.0 * step
        if (outside - bad) * step < 0.0:
            bad = outside
    while math.isinf(exact(bad)) and abs(bad - good) > 1e-13 * good:  # infeasible for the plant: there is no root
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if exact(middle) <= 0.0 else (good, middle)
    if math.isinf(exact(bad)):
        return good
    return float(brentq(exact, good, bad, xtol=1e-14 * good, rtol=1e-14)) if exact(bad) > 0.0 else bad


def _satisfying(
    limited: Limited, plan_of: Callable[[float], Trajectory], duration: float, most: float = _ROUNDED
) -> tuple[Trajectory, Margins]:
    """Plan of a duration, which is increased by roundings until the limits are satisfied, and its margins."""
    step = float(np.spacing(duration))
    while step < most * duration:
        plan = plan_of(duration)
        try:
            margins = limited.margins(plan)
        except ValueError:
            margins = None
        if margins is not None and margins.satisfied:
            return plan, margins
        duration, step = duration + step, 2.0 * step
    raise ValueError(f"limits must be satisfied near {duration:.6g} s, got {limited.margins(plan).active}")


def _reject(family: PlansByDuration | _InLoop, durations: Array, excess: Array) -> NoReturn:
    span = f"from {durations[0]:.4g} to {durations[-1]:.4g} s"
    if math.isinf(excess.min()):
        try:
            family.limited.margins(family.plan(float(durations[-1])))
        except ValueError as reason:
            if family.limited.loop_bounds:
                raise
            raise ValueError(
                f"the plan must be feasible for the plant for some duration {span}, got none; "
                f"at {durations[-1]:.4g} s: {reason}"
            ) from reason
        raise ValueError(f"the plan must be feasible for the plant for some duration {span}, got none")
    nearest = float(durations[int(excess.argmin())])
    worst = family.limited.margins(family.plan(nearest)).active
    further = "; for a wider search pass durations=(low, high)" if nearest in (durations[0], durations[-1]) else ""
    raise ValueError(
        f"limits must be satisfied for some duration {span}, got none; nearest at {nearest:.4g} s: {worst}{further}"
    )
