"""Several plans through one loop, side by side."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import real_array
from ctrlplan._files import write_text
from ctrlplan.simulation import (
    Event,
    Occurrence,
    rest_at,
    simulate,
    state_space,
    unstable_poles,
    what_happened,
)
from ctrlplan.studies.connections import check_reached
from ctrlplan.studies.limits import limits_of
from ctrlplan.studies.measures import (
    MEASURES,
    Measure,
    checked_names,
    control_metrics,
    path_metrics,
    response_metrics,
)
from ctrlplan.studies.units import Signals, checked_units, listed_measures, scales_of
from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Step, Trajectory, TrigSpline, Waypoint

if TYPE_CHECKING:
    import pandas as pd
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike
    from ctrlplan.studies.worth import Worth

Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class Comparison:
    """What each plan made of a loop; made by `compare`.

    Attributes
    ----------
    plans : dict of str to Trajectory
        The references by name.
    responses : dict of str to control.TimeResponseData
        What the loop did with each.
    metrics : dict of str to dict of str to float
        Plan, metric, value: see `ctrlplan.studies.MEASURES`; inf where never
        reached, nan where undefined.
    outputs, controls : tuple of str
        Outputs of the loop that follow the plan, and that are its controls.
    waypoints : tuple of Waypoint
        What the plans were asked to meet, where known.
    units : dict of str to str
        Units of axes and controls by label.
    title : str
        Heading of figures and report.
    parameters : dict of str to object
        What the report says about how it was made.
    notes : tuple of str
        What a reader must know of the loop: that it is unstable, or never settles.
    marks : dict of str to str
        Plans whose metrics come with a reservation, and that reservation.
    measures : dict of str to Measure
        How the metrics are called, in the order in which they are shown.
    scales : dict of str to float
        Size of each metric in this comparison, by the range of the plans, the
        peak of the controls and the length of the run: a difference of less
        than 1e-6 of it is rounding. Without an entry where it is not known.
    stopped : dict of str to float
        Plans whose run was ended by an event, and when [s]. Their metrics are
        those up to then, and are not ranked.
    worth : Worth or None
        The planned reference beside its rivals, where that was asked for.
    failures : dict of str to str
        Plans that could not be run, and why: they are in no other entry.
    limits : dict of str to dict of str to (float, float)
        Plan, output, (minimum, maximum): what actuators of its loop declare.
    """

    plans: dict[str, Trajectory]
    responses: dict[str, Any]
    metrics: dict[str, dict[str, float]]
    outputs: tuple[str, ...]
    controls: tuple[str, ...] = ()
    waypoints: tuple[Waypoint, ...] = ()
    units: dict[str, str] = field(default_factory=dict)
    title: str = "Step versus planned"
    parameters: dict[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    marks: dict[str, str] = field(default_factory=dict)
    measures: dict[str, Measure] = field(default_factory=lambda: dict(MEASURES))
    worth: Worth | None = None
    failures: dict[str, str] = field(default_factory=dict)
    limits: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    scales: dict[str, float] = field(default_factory=dict)
    stopped: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        failed = f" ({', '.join(self.failures)} failed)" if self.failures else ""
        return f"<Comparison of {', '.join(self.plans)}{failed}: {self.title}>"

    def to_pandas(self) -> pd.DataFrame:
        """Metrics as a table, one row a metric, one column a plan."""
        import pandas as pd

        return pd.DataFrame(self.metrics).rename_axis(index="metric", columns="plan")

    def results(self) -> dict[str, Any]:
        """Plain data for JSON: plans with their metrics, null where infinite or undefined."""
        plans = {
            plan: {"metrics": {name: finite_or_none(value) for name, value in found.items()}}
            for plan, found in self.metrics.items()
        }
        failed = {"failures": dict(self.failures)} if self.failures else {}
        return {"plans": plans} | failed | ({"worth": self.worth.results()} if self.worth is not None else {})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write metrics, plans and parameters as JSON, whole or not at all."""
        data = self.results()
        for name, plan in self.plans.items():
            data["plans"][name]["trajectory"] = plan.to_dict()
        data |= {"title": self.title, "parameters": {k: str(v) for k, v in self.parameters.items()}}
        write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")

    def marked(self, marks: Mapping[str, str]) -> Comparison:
        """Same comparison with further reservations about some plans."""
        both = {name: "; ".join(filter(None, (self.marks.get(name), mark))) for name, mark in marks.items()}
        return replace(self, marks=self.marks | both)

    def plot(self, ax: AxesLike | None = None) -> ControlPlot:
        """Responses, errors and controls over time.

        Parameters
        ----------
        ax : array of Axes, optional
            Where to draw: for each output one axes for it and one for its
            error, then one for each control. None: an empty current figure, or
            a new one.

        Returns
        -------
        control.ControlPlot
            Of shape (2 noutputs + ncontrols, 1).
        """
        from ctrlplan.reports.figures import plot_responses

        return plot_responses(self, ax=ax)

    def report(self, path: str | os.PathLike[str]) -> Path:
        """Write one self-contained HTML page and return its path.

        Parameters
        ----------
        path : str or path
            The file, or a folder for ``index.html`` in it.
        """
        from ctrlplan.reports import write_page
        from ctrlplan.studies.study import Study

        return write_page([Study("comparison", self.title, self, notes=self.notes)], path, title=self.title)

    def _repr_html_(self) -> str:
        from ctrlplan.reports import comparison_fragment

        return comparison_fragment(self)


def compare(
    loop: Any,
    plans: Mapping[str, Trajectory] | Iterable[Waypoint],
    timepts: ArrayLike,
    *,
    alpha: float = 1.0,
    outputs: Sequence[str] | None = None,
    controls: Sequence[str] | None = None,
    waypoints: Iterable[Waypoint] = (),
    initial_state: ArrayLike | None = None,
    band: float = 0.02,
    start: float | None = None,
    only: Collection[str] | None = None,
    params: Mapping[str, Any] | None = None,
    events: Sequence[Event] | None = None,
    measure: Callable[[Trajectory, Any], Mapping[str, float]] | None = None,
    measures: Mapping[str, Measure] | None = None,
    units: Mapping[str, str] | None = None,
    title: str = "Step versus planned",
    parameters: Mapping[str, object] | None = None,
    worth: bool | Mapping[str, Any] = False,
) -> Comparison:
    """Run several plans through a loop and measure each response.

    Parameters
    ----------
    loop : control system or callable
        As many inputs (the reference) as the plans have axes; or a function
        that maps a plan's name and the plan to a loop, which may have the plan
        as a block inside and no inputs. A plan that reaches none of the outputs
        that follow it is an error.
    plans : mapping of str to Trajectory, or iterable of Waypoint
        The references by name; waypoints stand for the standard set of
        `standard_plans`: step, polynomial, trigonometric, piecewise.
    timepts : array_like, shape (ntime,)
        Sample times [s]; metrics are refined between them.
    alpha : float, optional
        Shape parameter of the standard trigonometric plan.
    outputs : sequence of str, optional
        Outputs that follow the plan: those named like its axes, else the first
        ones, unless given.
    controls : sequence of str, optional
        Outputs that are controls: those whose names begin with u unless given.
    waypoints : iterable of Waypoint, optional
        What the plans were asked to meet, for the metrics of wandering.
    initial_state : array_like, optional
        State at the first sample time. Unless given, the attribute
        ``initial_state`` of a loop or of a block is where it starts, and all
        other states are at equilibrium with every plan held at its first
        position; a warning and a note say where no equilibrium is found.
    band : float, optional
        Half width of the settling band relative to the range of the plan.
    start : float, optional
        Time [s] from which metrics count: the earliest start of a plan unless given.
    only : collection of str, optional
        Names of the metrics wanted, of `MEASURES` or `measures`; all unless given.
    params, events : optional
        As for `simulate`. A plan whose run is ended by an event is measured up
        to then, which its mark and a note say.
    measure : callable, optional
        Maps a plan and its response to further metrics, by names of their own.
    measures : mapping of str to Measure, optional
        Further metrics, with a function each, or what those of `measure` are
        called; they are shown before the others.
    units : mapping of str to str, optional
        Units of axes, outputs and controls by label. Where controls differ in
        unit, each has its own metrics alone; so have axes.
    title : str, optional
        Heading.
    parameters : mapping, optional
        What the report should say about how it was made.
    worth : bool or mapping, optional
        Whether the report should ask if planning is worth it: a trigonometric
        plan through the waypoints beside step, trapezoid, S-curve, shaped step,
        quintic and minimum jerk, in the same time and under the same limits. A
        mapping gives limits, quantities, mode and whatever else the function
        `ctrlplan.studies.worth.worth` takes.

    Returns
    -------
    Comparison

    Raises
    ------
    ValueError
        If there is no plan, plans differ in axes, a plan reaches no output that
        follows it, `start` or `band` is out of range, or a name in `outputs`,
        `controls`, `only`, `measures` or `units` is unknown.
    TypeError
        If a plan is not a trajectory, or an argument is of a wrong kind.
    Exception
        What the first plan's run raised, where no plan can be run. Where others
        can be, it is recorded in `Comparison.failures`, and they are kept.

    Warns
    -----
    UserWarning
        If a run does not start at equilibrium, since none was found.

    Notes
    -----
    Metrics in percent, and the settling band, are relative to the range of the
    plan, maximum less minimum, axis by axis: for a move without reversals, the
    planned change.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> loop = cp.plants.integrator_lag_loop(100, outputs=("y", "u"))
    >>> result = cp.compare(loop, move, np.linspace(0, 10, 2001))
    >>> round(result.metrics["step"]["overshoot_error"], 1)
    85.4
    """
    points = tuple(waypoints)
    if not isinstance(plans, Mapping):
        plans = points = waypoints_given(plans)
    if not isinstance(worth, bool | Mapping):
        raise TypeError(f"worth must be True, False or a mapping of choices, got {worth!r}")
    if worth is not False and not points:
        raise ValueError("worth needs waypoints, in the place of plans or as waypoints, got none")
    references = references_of(plans, alpha)
    times = real_array(timepts, "timepts")
    since = checked_start(start, references.values(), times)
    checked_band(band)
    wanted = _Wanted(_checked_only(only, measure, measures), measure, _checked_measures(measures, measure))
    if not is_builder(loop):
        check_has_inputs(loop)
    axes = next(iter(references.values())).labels

    def measured(name: str, plan: Trajectory) -> tuple[_Run, dict[str, float]]:
        run = _run(loop, (name, plan, axes), times, (outputs, controls), initial_state, params, events)
        values = _metrics_of(run, plan, axes, since, band, wanted)
        return run, values | path_metrics(plan, points, wanted.only, wanted.measures)

    results, failures = _each(measured, references)
    references = {name: references[name] for name in results}
    runs = {name: run for name, (run, _) in results.items()}
    found = {name: values for name, (_, values) in results.items()}
    last = list(runs.values())[-1]
    systems = [run.system for run in runs.values()]
    shown = _shown(found, wanted)
    if not isinstance(worth, bool) or worth:
        shared: dict[str, Any] = {"outputs": outputs, "controls": controls, "initial_state": initial_state}
        shared |= {"band": band, "start": start, "params": params, "events": events}
        shared |= {"measures": measures, "units": units}
        beside = _benefit(loop, points, times, references, alpha, measure, shared, worth)
    else:
        beside = None
    signals = _signals_of(references, runs, checked_units(units, references.values(), systems), since)
    listed = listed_measures(found, shown, signals)
    return Comparison(
        plans=references,
        responses={name: run.response for name, run in runs.items()},
        metrics=found,
        outputs=last.outputs,
        controls=last.controls,
        waypoints=points,
        units=dict(units or {}),
        title=title,
        parameters=dict(parameters or {}) | ({} if wanted.only == () else _how_measured(signals, band)),
        notes=(*_notes(runs, found), *_notes_of_events(runs), *_notes_of_failures(failures)),
        marks={name: _mark_of(run.stop) for name, run in runs.items() if run.stop is not None},
        measures=listed,
        worth=beside,
        scales=scales_of(shown, signals),
        stopped={name: run.stop.time for name, run in runs.items() if run.stop is not None},
        failures=failures,
        limits={name: limits_of(run.system) for name, run in runs.items()},
    )


def all_run(found: Comparison) -> Comparison:
    """The same comparison, where every plan could be run.

    Raises
    ------
    RuntimeError
        If one could not, with its reason.
    """
    if found.failures:
        raise RuntimeError("; ".join(f"{plan} could not be run: {reason}" for plan, reason in found.failures.items()))
    return found


def references_of(plans: Mapping[str, Trajectory] | Iterable[Waypoint], alpha: float = 1.0) -> dict[str, Trajectory]:
    """The references by name: those given, or the standard set through waypoints.

    Raises
    ------
    ValueError
        If there is none, or they differ in axes.
    TypeError
        If one is not a trajectory.
    """
    return _checked_plans(plans if isinstance(plans, Mapping) else standard_plans(plans, alpha))


def is_builder(loop: Any) -> bool:
    """Whether something is a function of name and plan that returns a loop; systems can be called as well."""
    return callable(loop) and not hasattr(loop, "output_labels")


def check_has_inputs(loop: Any) -> Any:
    """Refuse a loop that no plan can drive."""
    if not loop.ninputs:
        raise ValueError(
            "loop must have inputs for the plans, got one without; give a function of name and plan that returns "
            "a loop where the plan is a block inside"
        )
    return loop


def waypoints_given(plans: Any) -> tuple[Waypoint, ...]:
    """Waypoints in the place of plans.

    Raises
    ------
    TypeError
        If they are plans without names, or nothing of the kind.
    """
    points = tuple(plans) if np.iterable(plans) else (plans,)
    for point in points:
        if not isinstance(point, Waypoint):
            kinds = "a mapping of names to trajectories, or waypoints"
            raise TypeError(f"plans must be {kinds}, got {type(point).__name__}")
    return points


def standard_plans(waypoints: Iterable[Waypoint], alpha: float = 1.0) -> dict[str, Trajectory]:
    """Plans that a designer would compare through the same waypoints.

    Parameters
    ----------
    waypoints : iterable of Waypoint
        Two or more.
    alpha : float, optional
        Shape parameter of the trigonometric one [rad].

    Returns
    -------
    dict of str to Trajectory
        step (from the first position to the last, at the start), polynomial,
        trigonometric, piecewise.
    """
    points = tuple(waypoints)
    polynomial = PolySpline(points, warn=False)  # one of the baselines, however it swings
    return {
        "step": Step(polynomial.final, polynomial.initial, polynomial.start, polynomial.labels),
        "polynomial": polynomial,
        "trigonometric": TrigSpline(points, alpha=alpha),
        "piecewise": PiecewiseSpline(points),
    }


@dataclass(frozen=True)
class _Run:
    """One plan through its loop.

    Attributes
    ----------
    system : control system or Prepared
        The loop.
    response : control.TimeResponseData
        What it did.
    outputs, controls : tuple of str
        Outputs that follow the plan, and that are controls.
    unstable : ndarray of complex
        Poles in the right half plane.
    doubt : str
        Why the run may not start at equilibrium; empty where it does.
    stop : Occurrence or None
        What ended it before its time.
    """

    system: Any
    response: Any
    outputs: tuple[str, ...]
    controls: tuple[str, ...]
    unstable: NDArray[np.complex128]
    doubt: str = ""
    stop: Occurrence | None = None


@dataclass(frozen=True)
class _Wanted:
    """Metrics that a comparison takes: names or None for all, the user's function, and every `Measure`."""

    only: tuple[str, ...] | None
    measure: Callable[[Trajectory, Any], Mapping[str, float]] | None
    measures: dict[str, Measure]


def _run(
    loop: Any,
    reference: tuple[str, Trajectory, tuple[str, ...]],
    times: Array,
    names: tuple[Sequence[str] | None, Sequence[str] | None],
    initial_state: ArrayLike | None,
    params: Mapping[str, Any] | None,
    events: Sequence[Event] | None,
) -> _Run:
    """Simulate a plan (its name, itself, labels of the axes) with outputs and controls as given."""
    name, plan, axes = reference
    system = state_space(loop(name, plan) if is_builder(loop) else loop)
    tracked, acting = _tracked(system, names[0], axes), acting_outputs(system, names[1])
    check_reached(system, tracked, plan)
    state, doubt = initial_state, ""
    if state is None and times.ndim == 1 and times.size and np.isfinite(times).all():  # otherwise simulate says so
        rows = [system.output_labels.index(label) for label in tracked]
        state, why = rest_at(system, plan, float(times[0]), rows, params)
        doubt = f"With {name}, {_doubt(plan, times, state, why)}." if why else ""
    inputs, start = (plan if system.ninputs else None), (0.0 if state is None else state)
    try:
        response = simulate(system, times, inputs, initial_state=start, params=params, events=events)
    except Exception as error:
        if doubt:
            error.add_note(doubt)
        raise
    if doubt:
        warnings.warn(doubt, UserWarning, stacklevel=3)
    early = response.time[-1] < times[-1]
    stop = next(event for event in response.events if event.stop) if early else None
    return _Run(system, response, tracked, acting, unstable_poles(system), doubt, stop)


def _doubt(plan: Trajectory, times: Array, state: Array, why: str) -> str:
    held = ", ".join(f"{value:.4g}" for value in plan.jet(times[:1], 0, left=True)[0, :, 0])
    where = "the start that blocks state" if np.any(state) else "the zero state"
    return (
        f"no equilibrium of the loop is known with the plan held at its first position {held}: {why}. The run starts "
        f"at {where}; give initial_state= where it should start elsewhere"
    )


def _metrics_of(
    run: _Run, plan: Trajectory, axes: tuple[str, ...], since: float, band: float, wanted: _Wanted
) -> dict[str, float]:
    """Metrics of a run, up to where it was ended."""
    times = np.asarray(run.response.time)
    signals = np.asarray(run.response.outputs).reshape(-1, times.size)
    labels = list(run.response.output_labels)
    values = _own_metrics(wanted, plan, run.response)
    if np.count_nonzero(times >= since) < 2:  # ended before there was anything to measure
        return values
    rows, acting = ([labels.index(name) for name in names] for names in (run.outputs, run.controls))
    values |= response_metrics(times, signals[rows], plan, since, band, axes, wanted.only, wanted.measures)
    if run.unstable.size:
        values |= {key: np.inf for key in values if "settling_time" in key}
    if acting:
        values |= control_metrics(times, signals[acting], since, run.controls, wanted.only, wanted.measures)
    return values


def _own_metrics(wanted: _Wanted, plan: Trajectory, response: Any) -> dict[str, float]:
    """Metrics by the user's function."""
    if wanted.measure is None:
        return {}
    found = wanted.measure(plan, response)
    if not isinstance(found, Mapping):
        raise TypeError(f"measure must return a mapping of names to numbers, got {type(found).__name__}")
    for name in found:
        if wanted.measures.get(name, Measure("")).of:
            raise ValueError(
                f"measure must return metrics by names of their own, got {name!r}, which is one of measures"
            )
    return {name: float(value) for name, value in found.items()}


def _shown(found: Mapping[str, Mapping[str, float]], wanted: _Wanted) -> dict[str, Measure]:
    """Every measure of a comparison, those of the user first; a name that is not described is its own title."""
    own = {name: measure for name, measure in wanted.measures.items() if name not in MEASURES}
    returned = dict.fromkeys(name for values in found.values() for name in values)
    described = set(wanted.measures)
    plain = {
        name: Measure(name) for name in returned if name not in described and not name.startswith(tuple(described))
    }
    shown = own | plain | MEASURES
    if wanted.only is not None:
        checked_names(wanted.only, shown, "only")
    return shown


def _checked_only(only: Any, measure: Any, measures: Any) -> tuple[str, ...] | None:
    """Metrics wanted; where a function of the user gives some, they are checked against what it returns later."""
    if only is None:
        return None
    known = dict(measures or {}) | MEASURES
    return checked_names(only, known if measure is None or isinstance(only, str) else [*known, *only], "only")


def _checked_measures(measures: Any, measure: Any) -> dict[str, Measure]:
    """Measures of the user, then those of every comparison."""
    if not isinstance(measures, Mapping | None):
        raise TypeError(f"measures must be a mapping of names to Measure, got {type(measures).__name__}")
    for name, value in (measures or {}).items():
        if not isinstance(value, Measure):
            raise TypeError(f"measures[{name!r}] must be a Measure, got {type(value).__name__}")
        if MEASURES.get(name, value) is not value:
            raise ValueError(f"measures must have names of their own, got {name!r}, which every comparison has")
        if not value.of and measure is None:
            raise ValueError(f"measures[{name!r}] must have a function, or come from measure, got neither")
    return dict(measures or {}) | MEASURES


def checked_start(start: Any, plans: Iterable[Trajectory], times: Array) -> float:
    """Time from which metrics count: as given, or the earliest start of a plan.

    Raises
    ------
    TypeError
        If it is no number.
    ValueError
        If it is not finite, or leaves fewer than two sample times.
    """
    since = min(plan.start for plan in plans)
    if start is not None:
        since = _number(start, "start")
        if not math.isfinite(since):
            raise ValueError(f"start must be a finite time [s], got {start!r}")
    usable = times.ndim == 1 and times.size > 1 and np.isfinite(times).all()  # otherwise simulate says so
    if usable and np.count_nonzero(times >= since) < 2:
        end = float(times[-1])
        if start is None:
            raise ValueError(
                f"timepts must reach beyond the start of the plans at {since:g} s, got {end:g} s as the last"
            )
        raise ValueError(f"start must leave two of timepts or more, which end at {end:g} s, got {start!r}")
    return since


def _number(value: Any, name: str) -> float:
    """One real number, without a unit."""
    number = real_array(value, name)
    if number.ndim or isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be a number, got {value!r:.80}")
    return float(number)


def checked_band(band: Any) -> None:
    """Reject a settling band that is none."""
    if not 0.0 < _number(band, "band") < math.inf:
        raise ValueError(f"band must be a finite number above 0, relative to the range of the plan, got {band!r}")


def _signals_of(
    plans: Mapping[str, Trajectory], runs: Mapping[str, _Run], units: dict[str, str], since: float
) -> Signals:
    """The signals measured, with their units and sizes."""
    axes = next(iter(plans.values())).labels
    last = list(runs.values())[-1]
    extrema = [plan.extrema() for plan in plans.values()]
    spans = np.max([found.maximum - found.minimum for found in extrema], axis=0)
    return Signals(
        dict(zip(axes, last.outputs, strict=True)),
        last.controls,
        units,
        dict(zip(axes, spans.tolist(), strict=True)),
        {name: max(_peak_of(run, name) for run in runs.values()) for name in last.controls},
        max(float(run.response.time[-1]) for run in runs.values()) - since,
        max(plan.duration for plan in plans.values()),
    )


def _peak_of(run: _Run, name: str) -> float:
    """Largest finite magnitude of a control."""
    signals = np.asarray(run.response.outputs).reshape(len(run.response.output_labels), -1)
    row = signals[list(run.response.output_labels).index(name)]
    return float(np.abs(row[np.isfinite(row)]).max(initial=0.0))


def _how_measured(signals: Signals, band: float) -> dict[str, object]:
    """What the report says of the metrics."""
    several = [
        f"of {what} the worst of {', '.join(names)}"
        for what, names in (("outputs", signals.axes), ("controls", signals.controls))
        if len(names) > 1
    ]
    how: dict[str, object] = {"settling band": f"{100 * band:g} %"}
    if several:
        how["figures"] = f"{', '.join(several)}; where these differ in unit, each by itself"
    return how


def _mark_of(stop: Occurrence) -> str:
    return f"the run was ended: {stop}; measured up to then, and not ranked"


def _benefit(
    loop: Any,
    points: tuple[Waypoint, ...],
    times: Array,
    references: Mapping[str, Trajectory],
    alpha: float,
    measure: Callable[[Trajectory, Any], Mapping[str, float]] | None,
    shared: dict[str, Any],
    choices: bool | Mapping[str, Any],
) -> Worth:
    """The planned reference compared with its baselines."""
    from ctrlplan.studies.worth import worth

    shared["alpha"] = next((plan.alpha for plan in references.values() if isinstance(plan, TrigSpline)), alpha)
    if measure is not None:
        shared["measure"] = lambda plan, response, last: measure(plan, response)
    return worth(loop, points, times, **shared | (dict(choices) if isinstance(choices, Mapping) else {}))


def _notes(runs: Mapping[str, _Run], found: Mapping[str, Mapping[str, float]]) -> tuple[str, ...]:
    """What a reader must know of the loops: that they are unstable, start elsewhere, or never settle."""
    notes = [run.doubt for run in runs.values() if run.doubt]
    unstable = [name for name, run in runs.items() if run.unstable.size]
    if unstable:
        poles = np.concatenate([run.unstable for run in runs.values()])
        worst = poles[poles.real.argmax()]
        pole = f"{worst.real:.4g}" + (f" ± {abs(worst.imag):.4g}j" if worst.imag else "")
        whose = "The loop" if len(unstable) == len(runs) else f"With {', '.join(unstable)}, the loop"
        return (f"{whose} is unstable: it has a pole at {pole} 1/s. No reference makes it settle.", *notes)
    never = [
        name for name, values in found.items() if values.get("settling_time") == np.inf and runs[name].stop is None
    ]
    if never:
        notes.append(
            f"With {', '.join(never)} the output does not settle within the run: the run is too short, or the loop "
            "keeps an error."
        )
    return tuple(notes)


def _notes_of_events(runs: Mapping[str, _Run]) -> tuple[str, ...]:
    """What happened on the way, plan by plan."""
    notes = []
    for plan, run in runs.items():
        events = [event for event in run.response.events if event.kind != "inside"]
        happened = []
        for name in dict.fromkeys(event.name for event in events):
            at = [event.time for event in events if event.name == name]
            happened.append(f"{what_happened(name)} {len(at)} times, first at {at[0]:.4g} s")
        stop = run.stop
        ended = "" if stop is None else f"; the run was ended at {stop.time:.4g} s, and is measured up to then"
        if happened:
            notes.append(f"With {plan}, {', '.join(happened)}{ended}.")
    return tuple(notes)


def _notes_of_failures(failures: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(f"With {plan} the run failed, and it is left out: {reason}" for plan, reason in failures.items())


def _each(
    measured: Callable[[str, Trajectory], tuple[_Run, dict[str, float]]], references: Mapping[str, Trajectory]
) -> tuple[dict[str, tuple[_Run, dict[str, float]]], dict[str, str]]:
    """Results of all plans; and of those that fail, why. An error that meets all of them is raised."""
    results: dict[str, tuple[_Run, dict[str, float]]] = {}
    errors: dict[str, Exception] = {}
    for name, plan in references.items():
        try:
            results[name] = measured(name, plan)
        except Exception as error:  # whatever a loop does with this plan
            errors[name] = error
    if len(errors) == len(references):
        raise next(iter(errors.values()))
    return results, {name: _reason(error) for name, error in errors.items()}


def _reason(error: Exception) -> str:
    """Message of an error in one line; with its type where the message alone says little."""
    told = " ".join(str(error).split())
    speaks = told and isinstance(error, ValueError | TypeError | RuntimeError)
    return told if speaks else f"{type(error).__name__}: {told}".rstrip(": ")


def finite_or_none(value: float) -> float | None:
    """Same number, or None where it is infinite or undefined: JSON has neither."""
    return value if math.isfinite(value) else None


def _checked_plans(plans: Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    references = dict(plans)
    if not references:
        raise ValueError("plans must hold at least one trajectory, got none")
    naxes = None
    for name, plan in references.items():
        if not isinstance(plan, Trajectory):
            raise TypeError(f"plans[{name!r}] must be a Trajectory, got {type(plan).__name__}")
        if naxes is not None and plan.naxes != naxes:
            raise ValueError(f"plans must have the same axes, got {plan.naxes} in {name!r} after {naxes}")
        naxes = plan.naxes
    return references


def tracked_outputs(loop: Any, outputs: Sequence[str] | None, plan: Trajectory) -> tuple[str, ...]:
    """Outputs that follow a plan: as given, those named like its axes, or the first ones.

    Raises
    ------
    ValueError
        If they are not as many as the axes, one is unknown, or an input of the
        loop reaches none of them.
    TypeError
        If they are a string.
    """
    names = _tracked(loop, outputs, plan.labels)
    check_reached(loop, names)
    return names


def acting_outputs(loop: Any, controls: Sequence[str] | None) -> tuple[str, ...]:
    """Outputs that are controls: as given, or those whose names begin with u."""
    if controls is None:
        return tuple(name for name in loop.output_labels if name.startswith("u"))
    return _known(loop, controls, "controls")


def _tracked(loop: Any, outputs: Sequence[str] | None, axes: tuple[str, ...]) -> tuple[str, ...]:
    labels = list(loop.output_labels)
    if outputs is not None:
        names = _known(loop, outputs, "outputs")
    elif all(label in labels for label in axes):
        names = axes
    else:
        names = tuple(labels[: len(axes)])
    if len(names) != len(axes):
        raise ValueError(f"outputs must be as many as the plan's axes, {len(axes)}, got {', '.join(names) or 'none'}")
    return names


def _known(loop: Any, names: Sequence[str], what: str) -> tuple[str, ...]:
    if isinstance(names, str):
        checked_names(names, loop.output_labels, what)
    return checked_names(names, loop.output_labels, "outputs and controls")
