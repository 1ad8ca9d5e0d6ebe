"""Benefit of planning: a planned reference compared with baselines under the same limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_kind, real_array
from ctrlplan._display import Displayed, Facts, Part, Table, counted, number
from ctrlplan._renamed import FormerAttribute
from ctrlplan._types import Array
from ctrlplan.planning.bounds import limit_words
from ctrlplan.planning.limits import Limited
from ctrlplan.planning.quantities import System as Quantified
from ctrlplan.simulation import Prepared, state_space
from ctrlplan.simulation.analytic_segments import spacing
from ctrlplan.simulation.built_forms import shared_forms
from ctrlplan.studies.baselines import are_equal, baseline_plans, derivative_limits, peak_limits, profiles
from ctrlplan.studies.comparison import Comparison, comparison_of, finite_or_none
from ctrlplan.studies.experiment import Experiment, Measured
from ctrlplan.studies.grids import Grid
from ctrlplan.studies.measures import MEASURES, Chosen, Measure, Run
from ctrlplan.studies.required_durations import RequiredDuration, required_duration, sentence_of
from ctrlplan.studies.roles import Role, role_of
from ctrlplan.studies.running import Builder, System, is_builder
from ctrlplan.trajectories import PolySpline, Shaper, Trajectory, TrigSpline, Waypoint

ALPHAS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
FACTORS = (0.75, 1.0, 1.5, 2.0)
DECISIVE = ("settling_time", "control_peak")
PLANNED = "trigonometric"
"""Name of the planned reference."""

OWN_LIMITS = (
    "The limits are not those of a plant: they are the peak velocity, acceleration and jerk of the polynomial through "
    "these waypoints, whose minimum duration is therefore that of the waypoints. Other limits give other durations."
)
"""Note for limits that are the peaks of the polynomial."""


@dataclass(frozen=True, repr=False)
class Benefit(Displayed):
    """A planned reference compared with its baselines, as returned by `benefit`.

    Attributes
    ----------
    comparison : Comparison
        Comparison of all plans, through the same waypoints at the same times.
    limits : dict of str to object
        Limits of all plans.
    required_durations : tuple of RequiredDuration
        Minimum duration of each plan under these limits.
    grids : tuple of Grid
        Metrics of trigonometric plans and baselines over alpha and duration.
    alpha : float
        Shape parameter of the trigonometric plan [rad].
    note : str
        Note on the method, for the report.
    """

    comparison: Comparison
    limits: dict[str, object]
    required_durations: tuple[RequiredDuration, ...]
    grids: tuple[Grid, ...]
    alpha: float = 0.0
    note: str = ""

    needs = FormerAttribute("required_durations")

    def _describe(self) -> Iterator[Part]:
        baselines = counted(len(self.comparison.plans) - 1, "other reference")
        yield f"Benefit of a trigonometric plan, alpha = {number(self.alpha)} rad, compared with {baselines}"
        yield Facts([(f"limit of {name}", limit_words(limit, name)) for name, limit in self.limits.items()])
        yield from self.verdicts
        without = [plan for plan in self.required_durations if math.isnan(plan.duration)]
        rows = [
            (plan.name, number(plan.duration), "" if plan in without else plan.limit)
            for plan in self.required_durations
        ]
        yield Table("Minimum durations under these limits", ("plan", "duration [s]", "active limit"), rows)
        yield from (f"{plan.name}: {plan.limit}" for plan in without)
        yield self.comparison.metric_table()
        if self.note:
            yield self.note

    @property
    def verdicts(self) -> tuple[str, ...]:
        """Findings, one sentence each."""
        return (
            *([sentence_of(self.required_durations)] if self.required_durations else []),
            *(grid.verdict for grid in self.grids),
        )

    def results(self) -> dict[str, object]:
        """Plain data for ``results.json``."""
        return {
            "plans": self.comparison.results()["plans"],
            "needs": {one.name: finite_or_none(one.duration) for one in self.required_durations},
            "grids": [
                {
                    "title": grid.title,
                    "durations": grid.durations.tolist(),
                    "alphas": grid.alphas.tolist(),
                    "values": [[finite_or_none(v) for v in row] for row in grid.values.tolist()],
                    "rivals": {name: [finite_or_none(v) for v in row.tolist()] for name, row in grid.baselines.items()},
                }
                for grid in self.grids
            ],
        }


@dataclass(frozen=True, kw_only=True)
class Choices:
    """Options of a benefit report.

    Attributes
    ----------
    alpha : float or "auto"
        Shape parameter of the planned reference [rad].
    limits, quantities
        As for `fastest`; by default, the peak velocity, acceleration and jerk
        of the polynomial, by axis.
    mode : (float, float) or None
        Frequency [rad/s] and damping ratio of the mode for the input shapers;
        by default, of the slowest complex poles of a linear loop.
    alphas : tuple of float
        Shape parameters of the tables [rad].
    factors : tuple of float
        Durations of the tables, as multiples of that of the waypoints.
    decisive : tuple of str or None
        Metrics of the tables; by default, settling time and peak control, as
        far as they are measured.
    baselines : callable or None
        Maps waypoints to further plans by name, as `smoother_polynomials` does.
    note : str
        Note on the method, for the report.
    """

    alpha: float | Literal["auto"] = 1.0
    limits: Mapping[str, object] | None = None
    quantities: Quantified | None = None
    mode: tuple[float, float] | None = None
    alphas: Sequence[float] = ALPHAS
    factors: Sequence[float] = FACTORS
    decisive: Sequence[str] | None = None
    baselines: Callable[[tuple[Waypoint, ...]], Mapping[str, Trajectory]] | None = None
    note: str = ""


def benefit(
    comparison: Comparison,
    loop: System | Builder,
    *,
    limits: Mapping[str, object] | None = None,
    alphas: ArrayLike | None = None,
    durations: ArrayLike | None = None,
) -> Benefit:
    """Compare a planned reference with baselines.

    A trigonometric plan through the waypoints of a comparison is compared with
    a step, a trapezoid, an S-curve, a shaped step, the quintic and the minimum
    jerk plan: at the same duration, and under the same limits. The metrics are
    those of the comparison.

    Parameters
    ----------
    comparison : Comparison
        Returned by `compare`, with waypoints. The planned reference has the
        alpha of its first trigonometric plan; alpha = 1 if there is none.
    loop : control system or callable
        As for `compare`.
    limits : mapping, optional
        As for `fastest`; by default, the peak velocity, acceleration and jerk
        of the polynomial through the waypoints, by axis.
    alphas : array_like, optional
        Shape parameters of the tables [rad]; 0 to 5 by default.
    durations : array_like, optional
        Durations of the tables [s]; by default 0.75, 1, 1.5 and 2 times that of
        the waypoints.

    Returns
    -------
    Benefit
        To be shown on the page of the comparison: `Comparison.with_benefit`.

    Raises
    ------
    ValueError
        If the comparison has no waypoints or was not returned by `compare`, if
        a duration is not above 0, or as for `compare` and `fastest`.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> loop = cp.plants.integrator_lag_loop(100)
    >>> found = cp.benefit(cp.compare(loop, move, np.linspace(0, 10, 1001)), loop, alphas=[1.0], durations=[1.0])
    >>> settles = {plan: values["settling_time"] for plan, values in found.comparison.metrics.items()}
    >>> settles["shaped step"] < settles["trigonometric"] < settles["step"]
    True
    """
    check_kind(comparison, "comparison", Comparison)
    if comparison.experiment is None:
        raise ValueError("comparison must be returned by compare, got one without an experiment")
    if not comparison.waypoints:
        raise ValueError("comparison must have waypoints, given to compare as plans or waypoints=, got none")
    choices = Choices(
        alpha=next((plan.alpha for plan in comparison.plans.values() if isinstance(plan, TrigSpline)), 1.0),
        limits=limits,
        alphas=ALPHAS if alphas is None else tuple(_numbers(alphas, "alphas").tolist()),
    )
    if durations is not None:
        times = _numbers(durations, "durations")
        if np.any(times <= 0.0):
            raise ValueError(f"durations must be above 0, got {times.min():g} s")
        points = comparison.waypoints
        choices = replace(choices, factors=tuple((times / (points[-1].time - points[0].time)).tolist()))
    return benefit_of(comparison.experiment, loop, choices, units=comparison.units)


@shared_forms()
def benefit_of(
    experiment: Experiment,
    loop: System | Builder,
    choices: Choices,
    *,
    units: Mapping[str, str] | None = None,
    title: str = "Step versus planned",
) -> Benefit:
    """Compare a planned reference with its baselines, with all options.

    Parameters
    ----------
    experiment : Experiment
        Experiment with waypoints, whose plans are replaced.
    loop : control system or callable
        As for `compare`.
    choices : Choices
        Options of the report.
    units, title : optional
        As for `compare`.
    """
    points = experiment.waypoints
    reference = PolySpline(points, warn=False)
    held: dict[str, object] = dict(peak_limits(reference) if choices.limits is None else choices.limits)
    limited = Limited(reference, held, choices.quantities)
    planned = TrigSpline(points, alpha=choices.alpha)
    setting = _Setting(experiment, loop, choices, held, _shaper(loop, choices.mode), reference, planned.alpha)
    plans: dict[str, Trajectory] = {PLANNED: planned} | setting.baselines(points)
    own, ran = setting.run(points, plans, experiment.measures)
    found = comparison_of(own, ran, units, title=title)
    roles = {name: Role.BASELINE if role is Role.PLANNED else role for name, role in found.roles.items()}
    found = replace(found, roles=roles | {PLANNED: Role.PLANNED})
    grids = _grids(setting, found, _decisive(choices.decisive, found), ran)
    note = choices.note if choices.limits is not None else " ".join(filter(None, (choices.note, OWN_LIMITS)))
    return Benefit(found, held, _required_durations(setting, plans, planned, limited), grids, planned.alpha, note)


@dataclass(frozen=True)
class _Setting:
    """A loop and the settings common to all plans.

    Attributes
    ----------
    experiment, loop, choices
        As for `benefit_of`.
    limits : mapping
        Limits of all plans.
    shaper : Shaper or None
        Input shaper for step and S-curve.
    reference : PolySpline
        The polynomial through the waypoints.
    alpha : float
        Shape parameter of the planned reference [rad].
    done : dict of Prepared to Run
        Runs at the times of the experiment by their loop.
    """

    experiment: Experiment
    loop: System | Builder
    choices: Choices
    limits: Mapping[str, object]
    shaper: Shaper | None
    reference: PolySpline
    alpha: float
    done: dict[Prepared, Run] = field(default_factory=dict)

    def baselines(self, points: tuple[Waypoint, ...]) -> dict[str, Trajectory]:
        """Baselines of the planned reference."""
        further = self.choices.baselines
        return baseline_plans(points, self.limits, self.shaper) | dict(further(points) if further is not None else {})

    def run(
        self, points: tuple[Waypoint, ...], plans: dict[str, Trajectory], measures: Chosen
    ) -> tuple[Experiment, Measured]:
        """Run plans through waypoints."""
        experiment, loop = self._experiment(points, plans, measures)
        return experiment, self._run(experiment, loop)

    def measured(self, points: tuple[Waypoint, ...], plans: dict[str, Trajectory], measures: Chosen) -> Measured:
        """Metrics of the same, without runs where a linear loop is solved with all plans."""
        experiment, loop = self._experiment(points, plans, measures)
        alike = None if is_builder(loop) else experiment.run_alike([loop])
        solved = alike[0] if alike else None
        return self._run(experiment, loop) if solved is None else solved

    def _run(self, experiment: Experiment, loop: System | Builder) -> Measured:
        """Runs of an experiment; those of loops that ran at the same times are known."""
        same = np.array_equal(experiment.timepts, self.experiment.timepts)
        return experiment.run(loop, self.done if same else None)

    def _experiment(
        self, points: tuple[Waypoint, ...], plans: dict[str, Trajectory], measures: Chosen
    ) -> tuple[Experiment, System | Builder]:
        """Experiment and loop for plans through waypoints; the simulated time is extended for longer plans."""
        times, late = self.experiment.timepts, points[-1].time - self.reference.end
        # Evenly spaced times remain so, up to rounding.
        step = spacing(times, float(np.ptp(times))) or float(np.median(np.diff(times)))
        more = times[-1] + step * np.arange(1, math.ceil(late / step - 1e-6) + 1)
        loop, followed = _followable(self.loop, plans)
        experiment = replace(
            self.experiment,
            plans=followed,
            timepts=np.concatenate([times, more]),
            waypoints=points,
            measures=measures,
        )
        return experiment, loop

    def rows(
        self, factor: float, decisive: Sequence[str], own: Measured
    ) -> tuple[dict[str, dict[str, float]], list[str]]:
        """Metrics of trigonometric plans, by alpha, and of baselines at another duration; names of the latter.

        A plan whose loop cannot be built, or whose run is ended by an event,
        is ranked last; a baseline in this case has no value. `own` are the runs
        at the duration of the waypoints.
        """
        scaled = _scaled(self.experiment.waypoints, factor)
        shapes: dict[str, Trajectory] = {f"{a:g}": TrigSpline(scaled, alpha=a, warn=False) for a in self.choices.alphas}
        baselines = self.baselines(scaled)
        equal = _equal_baselines(shapes, baselines)
        plans = {name: plan for name, plan in (shapes | baselines).items() if name not in equal}
        same = {f"{a:g}": PLANNED for a in self.choices.alphas if a == self.alpha} | {name: name for name in baselines}
        known = {name: same[name] for name in plans if factor == 1.0 and same.get(name) in own.runs}
        ran = self._completed(scaled, plans, decisive, known, own)
        worst, none = dict.fromkeys(decisive, np.inf), dict.fromkeys(decisive, np.nan)
        run_of = {name: equal.get(name, name) for name in (*shapes, *baselines)}
        rows = {name: worst | ran.metrics.get(run, {}) for name, run in run_of.items()}
        stopped = [name for name, run in run_of.items() if run in ran.runs and ran.runs[run].stop is not None]
        return rows | {name: worst if name in shapes else none for name in stopped}, list(baselines)

    def _completed(
        self,
        points: tuple[Waypoint, ...],
        plans: dict[str, Trajectory],
        decisive: Sequence[str],
        known: Mapping[str, str],
        own: Measured,
    ) -> Measured:
        """Runs of plans; those known have other names in `own`."""
        measures, others = _only(self.experiment.measures, decisive), {**plans}
        for name in known:
            del others[name]
        try:
            ran = self.measured(points, others, measures) if others else Measured({})
        except Exception:  # each of these plans fails: they are run with those that do not
            if not known:
                raise
            return self.measured(points, plans, measures)
        return Measured(
            {name: own.metrics[run] for name, run in known.items()} | ran.metrics,
            {name: own.runs[run] for name, run in known.items()} | ran.runs,
        )


def _equal_baselines(shapes: Mapping[str, Trajectory], baselines: Mapping[str, Trajectory]) -> dict[str, str]:
    """Trigonometric plans that a baseline is equal to, with its name: with alpha = 0 they are polynomials."""
    polynomials = {shape: plan for shape, plan in shapes.items() if not float(shape)}
    return {
        shape: name
        for shape, plan in polynomials.items()
        for name, baseline in baselines.items()
        if are_equal(plan, baseline)
    }


def _grids(setting: _Setting, found: Comparison, decisive: Sequence[str], own: Measured) -> tuple[Grid, ...]:
    """Tables over alpha and duration, one per decisive metric."""
    alphas, factors = setting.choices.alphas, setting.choices.factors
    tables = [setting.rows(factor, decisive, own) for factor in factors] if decisive else []
    names = dict.fromkeys(name for _, baselines in tables for name in baselines)  # a short move has no shaped baseline
    steps = [name for name, role in found.roles.items() if role is Role.STEP]
    steps += [name for name, plan in setting.baselines(setting.experiment.waypoints).items() if _is_step(plan)]
    return tuple(
        Grid(
            title=found.measures[key].title,
            unit=found.measures[key].unit,
            scale=found.scales.get(key, 0.0),
            durations=setting.reference.duration * np.array(factors),
            alphas=np.array(alphas, dtype=float),
            values=np.array([[rows[f"{a:g}"][key] for a in alphas] for rows, _ in tables]),
            baselines={name: np.array([rows.get(name, {}).get(key, np.nan) for rows, _ in tables]) for name in names},
            not_ranked=tuple(name for name in names if name in steps),
        )
        for key in decisive
    )


def _is_step(plan: Trajectory) -> bool:
    return role_of(plan) is Role.STEP


def _decisive(wanted: Sequence[str] | None, found: Comparison) -> list[str]:
    """Metrics of the tables that exist for the loop."""
    if wanted is None:
        wanted = [key for key in DECISIVE if key in found.measures]
    for key in wanted:
        if key not in found.measures:
            raise ValueError(f"decisive must be metrics ({', '.join(found.measures)}), got {key!r}")
    return [key for key in wanted if any(key in rows for rows in found.metrics.values())]


def _only(chosen: Chosen, decisive: Sequence[str]) -> Chosen:
    """Metrics required for the tables, with the measures of runs that may return them."""
    own = [one for one in chosen or () if isinstance(one, Measure)]
    alone = {*MEASURES, *(one.name for one in own if one.of)}
    returned = any(name not in alone for name in decisive)
    wanted = [one for one in own if one.name in decisive or (returned and one.of in ("", "run"))]
    return (*wanted, *(name for name in decisive if name in MEASURES))


def _followable(loop: System | Builder, plans: dict[str, Trajectory]) -> tuple[System | Builder, dict[str, Trajectory]]:
    """Loop, built for each plan, and the plans for which it can be built."""
    if not is_builder(loop):
        return loop, plans
    built: dict[str, System] = {}
    error = None
    for name, plan in plans.items():
        try:
            built[name] = loop(name, plan)
        except ValueError as reason:
            error = error or reason
    if error is not None and not built:
        raise error
    return lambda name, _: built[name], {name: plans[name] for name in built}


def _scaled(points: Sequence[Waypoint], factor: float) -> tuple[Waypoint, ...]:
    """Waypoints scaled to another duration, with their derivatives."""
    start = points[0].time
    return tuple(point.scaled(start + factor * (point.time - start), 1.0 / factor) for point in points)


def _shaper(loop: System | Builder, mode: tuple[float, float] | None) -> Shaper | None:
    """ZVD shaper for a given mode, or for that of a linear loop."""
    if mode is None:
        if is_builder(loop) or not hasattr(loop, "poles"):
            return None
        system = state_space(loop)
        poles = np.asarray(system.poles(), dtype=complex)
        if system.dt:
            poles = np.log(poles[poles != 0.0]) / float(system.dt)
        oscillating = poles[(poles.imag > 0.0) & (poles.real < 0.0)]
        if not oscillating.size:
            return None
        slowest = oscillating[oscillating.real.argmax()]
        mode = float(abs(slowest)), float(-slowest.real / abs(slowest))
    return Shaper.zvd(*mode)


def _numbers(values: ArrayLike, name: str) -> Array:
    """One or more finite numbers."""
    numbers = np.atleast_1d(real_array(values, name))
    if numbers.ndim != 1 or not numbers.size or not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be finite numbers, one or more, got {values!r:.80}")
    return numbers


def _required_durations(
    setting: _Setting, timed: dict[str, Trajectory], planned: Trajectory, limited: Limited
) -> tuple[RequiredDuration, ...]:
    """Minimum duration of each plan under the same limits."""
    bounds = derivative_limits(planned, setting.limits)
    # Profiles are as fast as possible in each segment; a shaper extends each segment.
    fast = profiles(setting.experiment.waypoints, planned.labels, bounds, setting.shaper, timed=False)
    return tuple(required_duration(name, plan, fast.get(name, plan), limited) for name, plan in timed.items())
