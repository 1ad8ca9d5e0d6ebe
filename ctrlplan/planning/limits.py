"""Limits of plans: on derivatives, and on states and inputs of a flat plant along the plan."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ctrlplan._checks import check_kind, checked_finite
from ctrlplan._display import Displayed, Facts, Part, Table, counted, time_text
from ctrlplan._renamed import FormerAttribute
from ctrlplan.planning.bounds import Bound, changes
from ctrlplan.planning.naming import Naming, check_times
from ctrlplan.planning.path_law.positions import maximum_excess
from ctrlplan.planning.quantities import (
    Response,
    System,
    feasible_quantities_of,
    loop_of,
    path_quantities,
    quantities_of,
    system_given,
)
from ctrlplan.planning.window import mean_square, window
from ctrlplan.trajectories import PathPlan, Retimed, Trajectory, derivative_name
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.extrema import Extrema, function_extrema, search_extrema
from ctrlplan.trajectories.trajectory import check_end

if TYPE_CHECKING:
    import pandas as pd

_SAMPLES = 193
_ROUNDING = 1e-9  # fraction of a limit below which a margin is printed as 0
_EQUAL = 1e-12  # difference of the margins to both limits below which the upper one is given
_FAR = 100.0
"""Distance from limits over time, in their scale, beyond which it is not resolved."""
_RATE_STEP = 0.02
"""Step of the differences for rates, relative to the time in which a jet changes."""


@dataclass(frozen=True)
class Margin:
    """Margin of a signal to its limits over a whole plan.

    Attributes
    ----------
    bound : Bound
        The limits.
    value, time : float
        Value nearest to a limit, or of maximum violation, and its time [s]; inf for
        the steady state of a loop.
    fraction : float
        Distance to the limit as a fraction of the scale; negative if the limit
        is violated.
    parameters : mapping of str to float
        Worst parameters within their ranges; empty without ranges.
    coverage : str
        How the worst parameters were found: "proved", "sampled, 312 points, corners
        and interior", or empty without ranges.
    """

    bound: Bound
    value: float
    time: float
    fraction: float
    parameters: Mapping[str, float] = field(default_factory=dict)
    coverage: str = ""

    def __str__(self) -> str:
        at = "" if self.bound.kind == "rms" else f" {self.when}"
        where = f" with {_listed(self.parameters)}" if self.parameters else ""
        return f"{self.bound.name} {self.bound.range}: {self.value:.6g}{at}{where}, {self.room}"

    @property
    def when(self) -> str:
        """Time as text."""
        return "in steady state" if math.isinf(self.time) else f"at {time_text(self.time)} s"

    def of(self, bound: Bound) -> bool:
        """Whether it is the margin of a bound."""
        return replace(self.bound, low=bound.low, high=bound.high) == bound

    @property
    def room(self) -> str:
        """Margin or violation as text."""
        return f"{self.share} {'left' if self.fraction >= 0.0 else 'beyond'}"

    @property
    def share(self) -> str:
        """Absolute margin as text: in percent, or in the signal's unit."""
        size = abs(self.fraction) if abs(self.fraction) >= _ROUNDING else 0.0
        lone_zero = math.isinf(self.bound.high - self.bound.low) and self.bound.scale == 1.0
        return f"{size:.4g}" if lone_zero else f"{100.0 * size:.3g} %"


@dataclass(frozen=True, repr=False)
class Margins(Displayed):
    """Margins of all limits over a whole plan, the smallest first.

    Attributes
    ----------
    rows : tuple of Margin
        One per limit.
    note : str
        How signals of a loop were computed; empty without a loop.
    coverage : str
        How ranges of parameters were covered: "proved", if all worst cases are
        certain, otherwise "sampled, 312 points, corners and interior"; empty
        without ranges.
    """

    rows: tuple[Margin, ...]
    note: str = ""
    coverage: str = ""

    @property
    def active(self) -> Margin:
        """The smallest margin."""
        return self.rows[0]

    @property
    def satisfied(self) -> bool:
        """Whether all limits are satisfied over the whole plan."""
        return self.active.fraction >= 0.0

    hold = FormerAttribute("satisfied")

    def __iter__(self) -> Iterator[Margin]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def _describe(self) -> Iterator[Part]:
        yield f"Margins of {counted(len(self), 'limit')}: {self.active}"
        yield Facts(
            [
                ("signals of the loop", self.note),
                ("ranges of parameters", self.coverage),
                ("worst parameters", _listed(self.active.parameters)),
            ]
        )
        yield self.table()

    def table(self) -> Table:
        """Table with one row per limit, as print shows it."""
        rows: list[tuple[str, ...]] = [
            (
                row.bound.name,
                row.bound.range,
                f"{row.value:.6g}",
                "steady" if math.isinf(row.time) else time_text(row.time),
                row.share if row.fraction > -_ROUNDING else f"-{row.share}",
            )
            for row in self.rows
        ]
        heads: tuple[str, ...] = ("signal", "limits", "value", "time [s]", "margin")
        if self.coverage:
            heads += ("worst parameters",)
            rows = [(*cells, _listed(row.parameters)) for cells, row in zip(rows, self.rows, strict=True)]
        return Table("Margins over the whole plan, the smallest first", heads, rows)

    def to_pandas(self) -> pd.DataFrame:
        """Table with one row per limit: low, high, value, time, margin."""
        import pandas as pd

        table = [(row.bound.low, row.bound.high, row.value, row.time, row.fraction) for row in self.rows]
        names = pd.Index([row.bound.name for row in self.rows], name="limit")
        return pd.DataFrame(table, names, ["low", "high", "value", "time", "margin"])


def margins(
    plan: Trajectory,
    limits: Mapping[str, object],
    system: System | None = None,
    *,
    tail: float | None = None,
    params: Mapping[str, object] | None = None,
    quantities: System | None = None,
) -> Margins:
    """Margins of a plan to limits over its whole interval.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    limits : mapping of str to float, (float, float), Limits, Region or array_like
        Limits by the name of a derivative (x, x_d1, x_d2, ...), of a quantity, or
        of a signal of a loop: a number above 0 for the magnitude, a pair (minimum,
        maximum) with None for no limit, or `Limits`. The names velocity,
        acceleration, jerk and snap stand for the derivatives of every axis: with a
        number or a tuple (minimum, maximum) for all axes, or with a list or array
        of naxes numbers or of shape (naxes, 2) by axis. Limits of a derivative
        must include 0. A `Region` of two signals has any name. With a loop, a name
        means the loop's signal; ``{"plan": {...}, "loop": {...}}`` says whose a
        name is, which is required where an axis was given the name of another
        signal of the loop by ``labels=``.
    system : flat system, Crane, loop or callable, optional
        System of the limited signals: a `control.flatsys.FlatSystem` (states and
        inputs), a `Crane`, a plant with a method ``quantities``, a function that
        maps a jet (order + 1, naxes, ntime) to a mapping of names to signals
        (ntime,), or a loop (outputs and inputs; see `loop_quantities`).
        Quantities that the plan does not determine at rest (heading and steering
        angle of a car) are nan there and rejected; along a `PathPlan` they are
        determined.
    tail : float, optional
        Time after the plan [s] for which a loop is simulated that is nonlinear,
        continuous with a delay, or sampled without an exact response (see
        `loop_quantities`); default: the duration of the plan. Signals of other loops
        are exact, at all times.
    params : mapping of str to float or (float, float), optional
        Values, or ranges (minimum, maximum), of parameters of `system`, which must
        then be a plant that has them by name (`Crane`), or a function that takes
        them by keyword and returns a loop or a flat system.
    quantities : optional
        Deprecated name of `system`.

    Returns
    -------
    Margins
        With the attributes rows (a `Margin` per limit, the smallest first),
        active (the smallest margin), satisfied and note. Extrema of derivatives
        are exact up to rounding, those of quantities (`Trajectory.extrema_of`)
        have an error below 1e-9 of the larger of magnitude and limit, and those
        of signals of a simulated loop below 1e-6 of their range. With ranges of
        parameters each row is that of the worst parameters, with the attributes
        parameters and coverage.

    Raises
    ------
    ValueError
        If a limit is not positive or does not increase, a name is unknown, or a
        limited signal is infinite at a jump of a lower derivative. If a parameter
        is unknown, or its range does not increase.
    TypeError
        If `system` has no parameters, or returns neither a loop nor a flat system.
    RuntimeError
        If a quantity is not resolved because it is noisy or oscillates.

    Notes
    -----
    A signal that is affine or linear fractional in each parameter, with the others
    fixed and no pole in the range, has its worst value at a corner of the ranges.
    Where the operations that compute a quantity show this, its margin is that of
    the worst corner, and "proved". Otherwise it is "sampled": at the corners, the
    centre and a Latin hypercube, 256 points in all, and from the worst six by a
    pattern search. Signals of closed loops are always sampled.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)])
    >>> cp.margins(move, {"y_d1": 1.0})
    <Margins of 1 limit: y_d1 within ±1: 0.9375 at 1 s, 6.25 % left>

    A load that is known to 20 %:

    >>> rest = [0.0] * 4
    >>> start = cp.Waypoint.from_jets(0, x=[0, *rest], z=[10, *rest])
    >>> goal = cp.Waypoint.from_jets(15, x=[20, *rest], z=[8, *rest])
    >>> lift = cp.PolySpline([start, goal])
    >>> found = cp.margins(lift, {"F": 5e3}, cp.plants.Crane(), params={"load_mass": (400, 600)})
    >>> found.active.parameters, found.coverage
    ({'load_mass': 600.0}, 'proved')
    """
    if params:
        from ctrlplan.planning.parameters import Family, margins_over

        return margins_over(plan, limits, Family.of(system_given(system, quantities), params), tail)
    limited = Limited(plan, limits, system_given(system, quantities), tail)
    limited.check_smooth(plan)
    with limited.naming_plants():
        return limited.margins(plan)


def _listed(parameters: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in parameters.items())


class UndeterminedError(ValueError):
    """A signal is not determined by the plan because the plant's maps are singular."""


@dataclass(frozen=True)
class Sampled:
    """Samples of a plan, for the search of a duration.

    Attributes
    ----------
    jet : ndarray, shape (order + 1, naxes, ntime)
        Jet at the samples.
    fractions : ndarray, shape (ntime,)
        Times relative to the duration, 0 at the start.
    moments : ndarray, shape (ntime,)
        Times [s] of the plan for which limits are given.
    weights : ndarray, shape (ntime,)
        Weights of a mean over the plan.
    duration : float
        Duration [s].
    """

    jet: Array
    fractions: Array
    moments: Array
    weights: Array
    duration: float

    def retimed(self, duration: float) -> Sampled:
        """Samples of the same shape with another duration."""
        powers = np.arange(len(self.jet))[:, None, None]
        return replace(self, jet=self.jet * (self.duration / duration) ** powers, duration=duration)


class Limited:
    """Limits for the evaluation of many plans with the same axes.

    Parameters are those of `margins`, for one of the plans.
    """

    def __init__(
        self, plan: Trajectory, limits: Mapping[str, object], system: System | None = None, tail: float | None = None
    ) -> None:
        if not isinstance(plan, Trajectory):
            raise TypeError(f"plan must be a Trajectory (the attribute plan of a result), got {plan!r:.60}")
        check_end(plan)
        if not plan.duration:
            raise ValueError("a plan under limits must have a duration, got a step")
        check_kind(limits, "limits", Mapping, "a mapping of names to limits")
        if tail is not None:
            checked_finite(tail, "tail", minimum=0.0)
        self._start, self._duration = plan.start, plan.duration
        self._given = limits, system, tail
        self.loop = loop_of(system, tail)
        self._at_positions = False
        self._on_path = path_quantities(system, plan)
        self._quantities = self._on_path or (None if self.loop is not None else quantities_of(system))
        self._together = None if self._on_path is not None else feasible_quantities_of(system)
        self.bounds = tuple(Naming(self.seen(plan), self._quantities, self.loop, plan.naxes).bounds(limits))
        if not self.bounds:
            raise ValueError("limits must name at least one signal, got none")
        check_limits = getattr(system, "check_limits", None)
        if check_limits is not None and self._on_path is None:
            check_limits(plan, {signal.name for bound in self.bounds for signal, _ in bound.terms})
        self._local = [k for k, bound in enumerate(self.bounds) if not bound.in_loop]
        self.order = max((self.bounds[k].order for k in self._local), default=0)
        self.derivatives_only = all(bound.axis is not None for bound in self.bounds)
        if self._quantities is not None and self._quantities is system and not self.derivatives_only:
            check_times(self._quantities, plan, self.order)
        self.is_constant = all(bound.is_constant and not bound.in_loop for bound in self.bounds)
        self.bounds = tuple(self._scaled(bound) for bound in self.bounds)
        self.bounds = tuple(self._slackened(plan))

    @contextmanager
    def naming_plants(self) -> Iterator[None]:
        """Errors that say how to pass a plant, if an input of what was taken for a loop is limited."""
        try:
            yield
        except ValueError as error:
            inputs = set() if self.loop is None else set(self.loop.inputs)
            limited = [name for bound in self.loop_bounds for name in bound.weights if name in inputs]
            if not limited:
                raise
            raise ValueError(
                f"{error}; system was taken for a loop with the plan as input {limited[0]}: for limits on the inputs "
                "and states of a plant whose outputs are planned, pass its flat system, as system=cp.flat_system("
                "plant, flat_outputs)"
            ) from error

    def of(self, plan: Trajectory) -> Limited:
        """The same limits for plans of another path."""
        limits, system, tail = self._given
        return Limited(plan, limits, system, tail)

    def at_positions(self) -> Limited:
        """The same limits, those over time at positions of the given plan instead of parts of its duration."""
        found = copy(self)
        found._at_positions = True
        return found

    @property
    def on_path(self) -> bool:
        """Whether signals are evaluated through the path parameter."""
        return self._on_path is not None

    def seen(self, plan: Trajectory) -> Trajectory:
        """Plan whose jet determines the limited signals: with its path parameter for a vehicle on a path."""
        return plan.with_coordinate if self.on_path and isinstance(plan, PathPlan) else plan

    @property
    def loop_bounds(self) -> tuple[Bound, ...]:
        """Limits of signals of a loop."""
        return tuple(bound for bound in self.bounds if bound.in_loop)

    @property
    def may_end(self) -> bool:
        """Whether a limit may be violated at long durations although it is satisfied at rest."""
        return any(b.period is not None or (not b.is_constant and _of_motion(b)) for b in self.bounds)

    def check_constant(self, what: str, *, over_time: bool = False) -> None:
        """Raise for limits that are not the same at every time of a plan, or, with `over_time`, not those of a time."""
        for bound in self.bounds:
            if bound.in_loop or not (bound.is_constant or (over_time and bound.kind != "rms")):
                kind = (
                    "a signal of a loop"
                    if bound.in_loop
                    else "an rms"
                    if bound.kind == "rms"
                    else "an interval of time"
                )
                raise ValueError(f"{what} must be local in time, got those of {bound.name}, of {kind}")

    def sampled(self, plan: Trajectory) -> Sampled:
        """Samples of every segment, its ends included."""
        plan = self.seen(plan)
        edges, inside = plan.breakpoints, np.linspace(0.0, 1.0, _SAMPLES)[1:-1]
        lengths = np.diff(edges)
        times = (edges[:-1, None] + lengths[:, None] * inside).ravel()
        jet = [
            plan.jet(edges[1:], self.order, left=True),
            plan.jet(edges[:-1], self.order),
            plan.jet(times, self.order),
        ]
        simpson = np.where(np.arange(1, _SAMPLES - 1) % 2, 4.0, 2.0) / (3.0 * (_SAMPLES - 1))
        ends = lengths / (3.0 * (_SAMPLES - 1))
        weights = np.concatenate([ends, ends, (lengths[:, None] * simpson).ravel()]) / plan.duration
        times = np.concatenate([edges[1:], edges[:-1], times])
        fractions = (times - plan.start) / plan.duration
        return Sampled(np.concatenate(jet, axis=2), fractions, self.moments(plan, times), weights, plan.duration)

    def values(self, jet: Array, chosen: Sequence[int] | None = None) -> Array:
        """Limited signals (nbounds, ntime) of a jet (order + 1, naxes, ntime); 0 for those not chosen or of a loop."""
        rows = self._rows(jet, self._local if chosen is None else chosen)
        if not jet[1:].any():  # at rest, which is no statement about plans that move
            return rows
        for row, b in zip(rows, self.bounds, strict=True):
            if np.isnan(row).any():
                first = int(np.isnan(row).argmax())
                still = not jet[1:, :, first].any()
                where = ", ".join(f"{value:.6g}" for value in jet[0, :, first].tolist())
                raise UndeterminedError(
                    f"{b.name} must be determined by the plan, got nan{' where the plan is at rest,' if still else ''} "
                    f"at the position ({where}): the maps of the plant are singular there, as those of a car are at "
                    "rest, or the function returns nan; give a PathPlan, or limit another signal"
                )
        return rows

    def _values_of_plans(self, jets: Array) -> Array:
        """Limited signals (nbounds, nplans, ntime) of jets (order + 1, naxes, nplans, ntime).

        Of a plan that is infeasible for the plant nan, or an error.
        """
        jet = jets.reshape(*jets.shape[:2], -1)
        if self._together is None or any(self.bounds[k].kind == "rate" for k in self._local):
            rows = self.values(jet)
        else:
            signals = {} if self.derivatives_only else self._together(jets)
            rows = self._rows(jet, self._local, {name: values.ravel() for name, values in signals.items()})
        return rows.reshape(len(self.bounds), *jets.shape[2:])

    def _rows(self, jet: Array, chosen: Sequence[int], known: Mapping[str, Array] | None = None) -> Array:
        """Limited signals, nan where the plan does not determine them; of `known` quantities if they are given."""
        rows = np.zeros((len(self.bounds), jet.shape[2]))
        kinds = {self.bounds[k].kind == "rate" and self.bounds[k].axis is None for k in chosen}
        signals = known if known is not None else self._signals(jet) if False in kinds else {}
        rates = self._rates(jet) if True in kinds else {}
        for k in chosen:
            b = self.bounds[k]
            found = rates if b.kind == "rate" else signals
            for signal, factor in b.terms:
                row = jet[signal.order, signal.axis] if signal.axis is not None else found[signal.name]
                rows[k] += factor * _signal(signal.name, row, rows.shape[1:])
        return rows

    def _signals(self, jet: Array) -> Mapping[str, Array]:
        return {} if self.derivatives_only or self._quantities is None else self._quantities(jet)

    def _rates(self, jet: Array) -> Mapping[str, Array]:
        """Time derivatives of the quantities: known ones, or central differences of order 8 along the jet's tangent."""
        if self._on_path is not None:
            return self._on_path.rates(jet)
        low, up = jet[:-1], jet[1:]
        step = _RATE_STEP * _time_scale(jet)
        found: dict[str, Array] = {}
        for k, weight in enumerate((4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0), 1):
            ahead, behind = (self._signals(low + sign * k * step * up) for sign in (1.0, -1.0))
            for name in ahead:
                change = weight * (np.asarray(ahead[name]) - np.asarray(behind[name])) / step
                found[name] = found.get(name, 0.0) + change
        return found

    def excesses(self, plan: Trajectory, samples: Sampled) -> Array:
        """Excess (nbounds,) over each limit: over samples, and of signals of a loop by its response."""
        values, times = self.values(samples.jet), samples.moments
        found = np.empty(len(self.bounds))
        for k in self._local:
            found[k] = self._excess_of(self.bounds[k], values[k], times, samples)
        rows = list(self._loop_margins(plan, refined=False))
        for k, row in zip([k for k, b in enumerate(self.bounds) if b.in_loop], rows, strict=True):
            found[k] = -row.fraction
        return found

    def excess(self, samples: Sampled) -> float:
        """Maximum excess over samples, without limits of a loop; inf if the plan is infeasible for the plant."""
        return float(self.excesses_of(samples.jet[:, :, None], samples, np.array([samples.duration]))[0])

    def excesses_of(
        self, jets: Array, samples: Sampled, durations: Array, chosen: Sequence[int] | None = None
    ) -> Array:
        """As `excess`, for several durations.

        Parameters
        ----------
        jets : ndarray, shape (order + 1, naxes, ndurations, ntime)
            Jets at the samples.
        samples : Sampled
            Relative times and weights of the samples.
        durations : ndarray, shape (ndurations,)
            Durations [s].
        chosen : sequence of int, optional
            Numbers of the limits; default all but those of a loop.

        Returns
        -------
        ndarray, shape (ndurations,)
        """
        chosen = self._local if chosen is None else chosen
        if not chosen:
            return np.full(durations.size, -np.inf)
        # Rates of quantities use a step that depends on all samples of one plan.
        together = durations.size == 1 or all(self.bounds[k].kind != "rate" or self.derivatives_only for k in chosen)
        try:
            if not together:
                raise ValueError("one duration after the other")
            values = self._values_of_plans(jets)
        except ValueError:  # infeasible for the plant at one of the durations, such as a rope under compression
            if durations.size == 1:
                return np.full(1, math.inf)
            half = durations.size // 2
            parts = ((jets[:, :, k], durations[k]) for k in (slice(0, half), slice(half, None)))
            return np.concatenate([self.excesses_of(part, samples, own, chosen) for part, own in parts])
        times = samples.moments
        found = [
            [
                self._excess_of(
                    self.bounds[k], values[k, n], times, replace(samples, jet=jets[:, :, n], duration=duration)
                )
                for n, duration in enumerate(durations.tolist())
            ]
            if self.bounds[k].kind == "rms"
            else self.bounds[k].excess(values[k], times).max(axis=1)
            for k in chosen
        ]
        worst = np.max(found, axis=0)
        return np.where(np.isnan(worst), math.inf, worst)

    def _excess_of(self, bound: Bound, row: Array, times: Array, samples: Sampled) -> float:
        if bound.kind != "rms":
            return float(bound.excess(row, times).max())
        mean = float(samples.weights @ row**2)
        if bound.period is not None:
            if samples.duration > bound.period:
                return math.inf
            last = (
                samples.jet[:, :, [int(samples.fractions.argmax())]] * (np.arange(len(samples.jet)) == 0)[:, None, None]
            )
            after = float(self._rows(last, [self.bounds.index(bound)]).max()) ** 2
            mean = after + (mean - after) * samples.duration / bound.period
        return float(bound.excess(np.sqrt([mean])).max())

    def shown(self, plan: Trajectory, times: Array) -> Array:
        """Limited signals (nbounds, ntime) over a plan for a figure; of a root mean square that up to each time."""
        rows = self.values(self.seen(plan).jet(times, self.order)).copy()
        response = None if self.loop is None or not self.loop_bounds else self.loop.quantities_of(plan)
        for row, b in zip(rows, self.bounds, strict=True):
            if b.in_loop and response is not None:
                row[:] = response.values(b.weights, times, rate=b.kind == "rate")
            if b.kind == "rms":
                steps = np.diff(times, prepend=times[0])
                steps[times > plan.start + (b.period or plan.duration)] = 0.0
                row[:] = np.sqrt(np.cumsum(steps * row**2) / (b.period or plan.duration))
        return rows

    def sides(self, bound: Bound, plan: Trajectory, times: Array) -> tuple[Array, Array]:
        """Minimum and maximum (ntime,) of a signal at times of a plan; infinite where no limit applies."""
        return bound.sides(self.moments(plan, times))

    def moments(self, plan: Trajectory, times: Array) -> Array:
        """Times (ntime,) [s] of the given plan, at which its limits apply, by those of another plan."""
        if self._at_positions and isinstance(plan, Retimed):
            own, times = plan.plan, np.clip(plan.law(times), plan.plan.start, plan.plan.end)
        else:
            own = plan
        found: Array = self._start + (times - own.start) * (self._duration / own.duration)
        return found

    def changes(self, plan: Trajectory) -> list[float]:
        """Times [s] of a plan of the given time law at which limits begin, end or have a kink."""
        rate = plan.duration / self._duration
        return [plan.start + (time - self._start) * rate for bound in self.bounds for time in changes(bound)]

    def rejection(self, plan: Trajectory) -> str:
        """Reason for which a plan is infeasible for the plant; empty if it is feasible."""
        try:
            self.values(self.sampled(plan).jet)
        except ValueError as rejection:
            return str(rejection)
        return ""

    def exact_excess(self, plan: Trajectory) -> float:
        """Maximum excess over a whole plan."""
        try:
            return -self.margins(plan).active.fraction
        except ValueError:
            return math.inf
        except RuntimeError:
            if not self.loop_bounds:
                raise
            return math.inf  # a loop that cannot be simulated, such as one that diverges

    def loop_excess(self, plan: Trajectory) -> float:
        """Maximum excess of signals of a loop, for a simulated one by samples."""
        try:
            return -min(row.fraction for row in self._loop_margins(plan, refined=False))
        except (ValueError, RuntimeError):
            return math.inf

    def check_ends(self, plan: Trajectory) -> None:
        """Raise for limits of a loop that are violated before the plan or in steady state, whatever its duration."""
        if self.loop is None:
            return
        self.loop.quantities_of(plan.retime(1.25 * plan.duration))  # raises for a source inside, at its own times
        response = self.loop.quantities_of(plan)
        for b in self.loop_bounds:
            if b.kind != "value" or not b.is_constant:
                continue
            try:
                ends = response.ends(b.weights)
            except RuntimeError:  # a loop that cannot be simulated at this duration
                return
            pairs = zip(("at the start", "in steady state"), ends, strict=True)
            for when, value in pairs:
                if b.excess(np.array([value]))[0] > 1e-9:
                    raise ValueError(
                        f"limits must be satisfied {when}, at any duration, got {b.name} = {value:.6g} where it must "
                        f"be {b.range}"
                    )

    def margins(self, plan: Trajectory) -> Margins:
        """Margins over a whole plan."""
        rows = [*self._local_margins(self.seen(plan)), *self._loop_margins(plan)]
        note = "" if self.loop is None or not self.loop_bounds else self.loop.note
        return Margins(tuple(sorted(rows, key=lambda row: row.fraction)), note)

    def _local_margins(self, plan: Trajectory) -> Iterator[Margin]:
        """Margins of derivatives and quantities."""
        constant = [k for k in self._local if self.bounds[k].is_constant]
        derived = [self.bounds[k] for k in constant if self.bounds[k].axis is not None]
        search_extrema(plan, {b.order for b in derived})
        extrema = {order: plan.extrema(order) for order in {b.order for b in derived}}
        for b in derived:
            yield _axis_margin(b, extrema[b.order])
        others = [k for k in constant if self.bounds[k].axis is None]
        if others:
            scales = [self.bounds[k].scale for k in others]  # no relative tolerance for a quantity near 0
            order = max(self.bounds[k].order for k in others)
            found = function_extrema(plan, lambda jet: self.values(jet, others)[others], order, scales)
            columns = zip(found.minimum, found.maximum, found.time_min, found.time_max, strict=True)
            for k, column in zip(others, columns, strict=True):
                yield _margin(self.bounds[k], *column)
        for k in self._local:
            if self.bounds[k].kind == "rms":
                yield self._rms_margin(plan, k)
            elif not self.bounds[k].is_constant:
                yield self._margin_over_time(plan, k)

    def _margin_over_time(self, plan: Trajectory, k: int) -> Margin:
        """Margin to limits that apply in an interval or change with time."""
        b = self.bounds[k]
        if self._at_positions and isinstance(plan, Retimed):
            return self._margin_at_positions(plan, k)
        rate = self._duration / plan.duration
        span = self._interval(b, plan)
        own = (self._start + (span[0] - plan.start) * rate, rate)
        table = [] if b.profile is None else [plan.start + (t - self._start) / rate for t in b.profile.times]
        part = window(plan, span, own, table)
        if b.profile is None and b.axis is not None:
            return _axis_margin(b, part.extrema(b.order))
        return self._margin_in_window(part, k)

    def _margin_at_positions(self, plan: Retimed, k: int) -> Margin:
        """The same at positions of the given plan, for a plan with another time law."""
        b, given = self.bounds[k], plan.plan
        rate = self._duration / given.duration
        if b.axis is not None:
            sizes, times = maximum_excess(b, plan, self._start, rate)
            side = int(sizes.argmax())
            time = float(times[side])
            return _margin_at(b, float(self.moments(plan, np.array([time]))[0]), time, side, float(sizes[side]))
        first, last = b.interval or (self._start, self._start + self._duration)
        marks = [first, last, *(b.profile.times if b.profile is not None else ())]
        places = np.clip(given.start + (np.array(marks) - self._start) / rate, given.start, given.end)
        begin, end, *table = plan.times_at(places).tolist()
        clock = (self._start - given.start * rate, rate)
        return self._margin_in_window(window(plan, (begin, end), clock, table, plan.law), k)

    def _margin_in_window(self, part: Trajectory, k: int) -> Margin:
        """Margin of a part of a plan whose last axis is the time of the given plan."""
        b = self.bounds[k]

        def excess(jet: Array) -> Array:
            row = self._rows(jet[:, :-1], [k])[k]
            low, high = b.sides(np.clip(jet[0, -1], *(b.interval or (-math.inf, math.inf))))
            return np.maximum(np.stack([low - row, row - high]) / b.scale, -_FAR)

        found = function_extrema(part, excess, self.order, 1.0)
        worst = int(found.maximum.argmax())
        time = float(found.time_max[worst])
        moment = float(part.jet(time, 0, left=time > part.start)[0, -1])
        return _margin_at(b, moment, time, worst, float(found.maximum[worst]))

    def _interval(self, bound: Bound, plan: Trajectory) -> tuple[float, float]:
        """Interval [s] of a plan in which limits apply, in the plan's time."""
        given = bound.interval
        if given is None:
            return plan.start, plan.end
        first, last = (plan.start + (t - self._start) * plan.duration / self._duration for t in given)
        if not bound.in_loop:
            first, last = max(first, plan.start), min(last, plan.end)
        if not first < last:
            raise ValueError(
                f"limits of {bound.name} must apply in an interval that overlaps the plan, from {self._start:g} to "
                f"{time_text(self._start + self._duration)} s, got {time_text(given[0])} to {time_text(given[1])} s"
            )
        return first, last

    def _rms_margin(self, plan: Trajectory, k: int) -> Margin:
        """Margin of a root mean square of a derivative or quantity."""
        b = self.bounds[k]
        square = mean_square(plan, lambda jet: self._rows(jet, [k])[k], self.order)
        if b.period is not None:
            _check_period(b, plan)
            held = np.zeros((self.order + 1, plan.naxes, 1))
            held[0] = plan.final[:, None]
            after = float(self._rows(held, [k])[k, 0]) ** 2
            square = after + (square - after) * plan.duration / b.period
        return _rms_margin(b, math.sqrt(square), plan)

    def _loop_margins(self, plan: Trajectory, refined: bool = True) -> Iterator[Margin]:
        """Margins of signals of a loop."""
        if self.loop is None or not self.loop_bounds:
            return
        response = self.loop.quantities_of(plan, refined=refined)
        for b in self.loop_bounds:
            if b.kind == "rms":
                if b.period is not None:
                    _check_period(b, plan)
                yield _rms_margin(b, response.rms(b.terms[0][0].name, b.period), plan)
                continue
            if b.profile is not None:
                yield self._loop_margin_over_time(plan, b, response)
                continue
            during = None if b.interval is None else self._interval(b, plan)
            e = response.extremes(b.weights, during=during, rate=b.kind == "rate")
            yield _margin(b, e.low, e.high, e.time_low, e.time_high)

    def _loop_margin_over_time(self, plan: Trajectory, bound: Bound, response: Response) -> Margin:
        """Margin of a signal of a loop to limits that are linear between times."""
        if bound.profile is None:
            raise TypeError("limits must be given over time")
        rate = self._duration / plan.duration
        first, last = bound.interval or (-math.inf, math.inf)
        times = np.union1d([first, last], bound.profile.times)
        found = []
        for own in pairwise(times[(times >= first) & (times <= last)].tolist()):
            low, high = bound.profile.sides(np.array(own))
            during = (plan.start + (own[0] - self._start) / rate, plan.start + (own[1] - self._start) / rate)
            for sign, side in ((-1.0, low), (1.0, high)):
                if np.isfinite(side).all():
                    e = response.extremes(bound.weights, during=during, line=(float(side[0]), float(side[1])))
                    beyond, at = (e.high, e.time_high) if sign > 0.0 else (-e.low, e.time_low)
                    found.append((beyond, at, sign))
        beyond, at, sign = max(found)
        there = bound.at(min(max(self._start + (at - plan.start) * rate, first), last))
        value = (there.high if sign > 0.0 else there.low) + sign * beyond
        return Margin(there, value, at, bound.slack - beyond / bound.scale)

    def check_smooth(self, plan: Trajectory) -> None:
        """Raise for a jump of a derivative that makes a limited signal infinite.

        The plan is at rest before its start and after its end, except if its speed
        there is not 0, up to rounding: then it is the continuation of a motion.
        """
        plan = self.seen(plan)
        highest = max((self.bounds[k].order for k in self._local), default=0)
        jumps = plan.jumps(max(1, highest - 1)) if highest else ()
        moving = {jump.time for jump in jumps if jump.order == 1} & {plan.start, plan.end}
        for k in self._local if jumps else ():
            bound = self.bounds[k]
            axes = {plan.labels[signal.axis] for signal, _ in bound.terms if signal.axis is not None}
            first, last = (-math.inf, math.inf) if bound.interval is None else self._interval(bound, plan)
            for jump in jumps:
                inside = jump.order < bound.order and jump.time not in moving and first <= jump.time <= last
                if inside and (len(axes) < len(bound.terms) or jump.label in axes):
                    what = "position" if jump.order == 0 else derivative_name(jump.label, jump.order)
                    raise ValueError(
                        f"limits of {bound.name} require a plan that is continuous up to derivative {bound.order - 1} "
                        f"(and at rest before and after), got {what} that jumps by {jump.size:.4g} at {jump.time:g} s"
                    )
        if self.on_path:
            self._check_continuous(plan)

    def _check_continuous(self, plan: Trajectory) -> None:
        """Raise for a signal with a limited rate that jumps where curves or their pieces join."""
        rated = [k for k in self._local if self.bounds[k].kind == "rate" and self.bounds[k].axis is None]
        inner = plan.breakpoints[1:-1]
        if not (rated and inner.size):
            return
        before, after = (self._signals(plan.jet(inner, self.order, left=left)) for left in (True, False))
        for k in rated:
            name, bound = self.bounds[k].terms[0][0].name, self.bounds[k]
            jump = np.abs(after[name] - before[name])
            if (wrong := jump > 1e-6 * np.maximum(1.0, np.abs(before[name]))).any():
                at = int(wrong.argmax())
                raise ValueError(
                    f"limits of {bound.name} require a path on which {name} is continuous, got {before[name][at]:.6g} "
                    f"before and {after[name][at]:.6g} after {inner[at]:.6g} s; give curves of equal curvature there"
                )

    def at_rest(self, plan: Trajectory) -> Sampled:
        """Samples of the plan with zero derivatives; one sample if no limit depends on position or time."""
        if self.is_constant and all(b.axis is not None and b.order for b in self.bounds):
            start = np.array([self._start])
            return Sampled(np.zeros((self.order + 1, plan.naxes, 1)), np.zeros(1), start, np.ones(1), plan.duration)
        samples = self.sampled(plan)
        return replace(samples, jet=samples.jet * (np.arange(self.order + 1) == 0)[:, None, None])

    def violated_at_rest(self, plan: Trajectory) -> Iterator[tuple[Bound, float, Array]]:
        """Limits of positions and quantities that are violated at every duration, with the value and the position."""
        if all(bound.in_loop or bound.kind == "rms" or _of_motion(bound) for bound in self.bounds):
            return
        still = self.at_rest(plan)
        times = still.moments
        for k, values in enumerate(self.values(still.jet)):
            bound = self.bounds[k]
            if bound.in_loop or bound.kind == "rms" or _of_motion(bound):
                continue
            excess = bound.excess(values, times)
            worst = int(excess.argmax())
            if excess[worst] > 0.0:
                yield bound.at(float(times[worst])), float(values[worst]), still.jet[0, : plan.naxes, worst]

    def _scaled(self, bound: Bound) -> Bound:
        """Bound with the scale of limits over time."""
        if bound.in_loop and bound.interval is not None and bound.interval[1] <= self._start:
            first, last = bound.interval
            raise ValueError(
                f"limits of {bound.name} must apply after the start of the plan at {self._start:.10g} s, got an "
                f"interval from {first:.10g} to {last:.10g} s; give times of the plan"
            )
        if bound.interval is not None and not bound.in_loop:
            first, last = bound.interval
            if last <= self._start or first >= self._start + self._duration:
                what = "during" if bound.profile is None else "along"
                raise ValueError(
                    f"{what} of {bound.name} must overlap the plan, from {time_text(self._start)} to "
                    f"{time_text(self._start + self._duration)} s, got {time_text(first)} to {time_text(last)} s"
                )
        if bound.profile is None:
            return bound
        if bound.in_loop and not bound.profile.times:
            raise ValueError(
                f"limits of {bound.name}, a signal of a loop, must be numbers, or values at times by along=, got a "
                "function of time"
            )
        first, last = bound.interval or (self._start, self._start + self._duration)
        times = np.union1d(np.linspace(first, last, 2001), bound.profile.times)
        low, high = bound.profile.sides(times[(times >= first) & (times <= last)])
        size = 0.5 * (high - low)
        if not np.isfinite(size).any():
            size = np.abs(np.concatenate([low, high]))
        size = size[np.isfinite(size)]
        if not size.size:
            raise ValueError(
                f"limits of {bound.name} must contain a finite one, got none from {time_text(first)} to "
                f"{time_text(last)} s"
            )
        return replace(bound, scale=float(size.max()) or 1.0)

    def _slackened(self, plan: Trajectory) -> Iterator[Bound]:
        """The bounds, with slack where they are attained at rest."""
        if all(bound.axis is not None and bound.order and bound.is_constant for bound in self.bounds):  # 0 at rest
            for bound in self.bounds:
                yield replace(bound, slack=1e-12 if 0.0 in (bound.low, bound.high) else 0.0)
            return
        try:
            if not self.derivatives_only:
                self.values(self.sampled(plan).jet)
        except UndeterminedError:  # as at any other duration
            raise
        except ValueError:  # infeasible for the plant, but possibly feasible more slowly
            pass
        still = self.at_rest(plan)
        times = still.moments
        for bound, values in zip(self.bounds, self.values(still.jet), strict=True):
            if bound.in_loop:
                sides = [abs(side) for side in (bound.low, bound.high) if math.isfinite(side)]
                yield replace(bound, slack=1e-12 + 16.0 * np.finfo(float).eps * max(sides, default=0.0) / bound.scale)
                continue
            if bound.kind == "rms" or np.isnan(values).any():
                yield replace(bound, slack=0.0)  # a signal that is singular at rest attains no limit there
                continue
            rounding = 1e-12 * (1.0 + float(np.abs(values).max()) / bound.scale)
            touched = abs(float(bound.excess(values, times).max())) <= rounding
            yield replace(bound, slack=rounding if touched else 0.0)


def _of_motion(bound: Bound) -> bool:
    """Whether a signal is 0 at rest: a derivative, or a rate."""
    return bound.kind == "rate" or all(signal.axis is not None and signal.order for signal, _ in bound.terms)


def _time_scale(jet: Array) -> float:
    """Time [s] in which the entries of a jet change, by the peaks of consecutive derivatives."""
    peaks = np.abs(jet[1:]).max(axis=(1, 2))
    ratios = [a / b for a, b in pairwise(peaks.tolist()) if a and b]
    return min(ratios, default=1.0)


def _signal(name: str, values: Array, shape: tuple[int, ...]) -> Array:
    """Values of a quantity over time, checked."""
    found = np.asarray(values, dtype=float)
    if found.shape != shape:
        raise TypeError(
            f"quantities must be signals of shape (ntime,), got {name} of shape {found.shape}; derivative k of axis i "
            "is jet[k, i]"
        )
    return found


def _check_period(bound: Bound, plan: Trajectory) -> None:
    if bound.period is not None and plan.duration > bound.period * (1.0 + 1e-12):
        raise ValueError(
            f"period of {bound.name} must be at least the duration of the plan, {plan.duration:g} s, got "
            f"{bound.period:g} s"
        )


def _rms_margin(bound: Bound, value: float, plan: Trajectory) -> Margin:
    fraction = (bound.high - value) / bound.scale
    return Margin(bound, value, plan.start + (bound.period or plan.duration), fraction)


def _margin_at(bound: Bound, moment: float, time: float, side: int, excess: float) -> Margin:
    """Margin to limits over time, by the excess over the lower (0) or upper one (1) at a moment of the plan."""
    there = bound.at(float(np.clip(moment, *(bound.interval or (-math.inf, math.inf)))))
    value = (there.low, there.high)[side] + (-1.0, 1.0)[side] * excess * bound.scale
    return Margin(there, value, time, bound.slack - excess)


def _axis_margin(bound: Bound, extrema: Extrema) -> Margin:
    """Margin of a derivative of one axis."""
    axis = 0 if bound.axis is None else bound.axis
    columns = (extrema.minimum, extrema.maximum, extrema.time_min, extrema.time_max)
    low, high, time_low, time_high = (float(column[axis]) for column in columns)
    return _margin(bound, low, high, time_low, time_high)


def _margin(bound: Bound, minimum: float, maximum: float, time_min: float, time_max: float) -> Margin:
    """Margin to the nearer of both limits."""
    low, high = ((side / bound.scale + bound.slack) for side in (minimum - bound.low, bound.high - maximum))
    # Equal but for rounding, they count as equal: the result does not depend on the processor.
    value, time, fraction = (minimum, time_min, low) if low < high - _EQUAL else (maximum, time_max, high)
    return Margin(bound, float(value), float(time), float(fraction))
