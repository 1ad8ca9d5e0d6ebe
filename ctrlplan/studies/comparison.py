"""Several plans through one loop, side by side."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._files import write_text
from ctrlplan.simulation import Event, Occurrence, rest_state, simulate, state_space, stated_start, unstable_poles
from ctrlplan.studies.limits import limits_of
from ctrlplan.studies.measures import MEASURES, Measure, control_metrics, path_metrics, response_metrics
from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Step, Trajectory, TrigSpline, Waypoint

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

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
        """Same comparison with reservations about some plans."""
        return replace(self, marks=dict(marks))

    def plot(self) -> Figure:
        """Responses, errors and controls over time."""
        from ctrlplan.reports.figures import plot_responses

        return plot_responses(self)

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
        as a block inside and no inputs. An
        attribute ``initial_state`` of a loop or a block is where it starts.
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
        State at the first sample time: at rest at the first position unless
        given.
    band : float, optional
        Half width of the settling band relative to the planned change.
    start : float, optional
        Time [s] from which metrics count: the earliest start of a plan unless given.
    only : collection of str, optional
        Metrics wanted, by their keys in `MEASURES`; all unless given.
    params, events : optional
        As for `simulate`.
    measure : callable, optional
        Maps a plan and its response to further metrics.
    measures : mapping of str to Measure, optional
        What those are called; they are shown before the others.
    units : mapping of str to str, optional
        Units of axes and controls by label.
    title : str, optional
        Heading.
    parameters : mapping, optional
        What the report should say about how it was made.
    worth : bool or mapping, optional
        Whether the report should ask if planning is worth it: a trigonometric
        plan through the waypoints beside step, trapezoid, S-curve, shaped step,
        quintic and minimum jerk, in the same time and under the same limits. A
        mapping gives limits, quantities, mode and whatever else
        `ctrlplan.studies.worth` takes.

    Returns
    -------
    Comparison

    Raises
    ------
    ValueError
        If there is no plan, plans differ in axes, or an output is unknown.
    TypeError
        If a plan is not a trajectory.
    Exception
        What the first plan's run raised, where no plan can be run. Where others
        can be, it is recorded in `Comparison.failures`, and they are kept.

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
    references = references_of(plans, alpha)
    first = next(iter(references.values()))
    times = np.asarray(timepts, dtype=float)
    start = min(plan.start for plan in references.values()) if start is None else start
    responses: dict[str, Any] = {}
    found: dict[str, dict[str, float]] = {}
    tracked: tuple[str, ...] = ()
    acting: tuple[str, ...] = ()
    unstable = np.empty(0, dtype=complex)
    stopped: dict[str, Occurrence] = {}
    limits: dict[str, dict[str, tuple[float, float]]] = {}
    builds = is_builder(loop)
    if not builds:
        check_has_inputs(loop)

    def run(name: str, plan: Trajectory) -> None:
        nonlocal tracked, acting, unstable
        system = state_space(loop(name, plan) if builds else loop)
        tracked, acting = tracked_outputs(system, outputs, first), acting_outputs(system, controls)
        response = simulate(
            system,
            times,
            plan if system.ninputs else None,
            initial_state=_initial_state(system, plan, times, initial_state),
            params=params,
            events=events,
        )
        rows, acting_rows = ([system.output_labels.index(n) for n in names] for names in (tracked, acting))
        values, unstable = {}, unstable_poles(system)
        if response.time[-1] < times[-1]:
            stopped[name] = next(event for event in response.events if event.stop)
        else:  # what an event has ended cannot be measured beside what went on
            signals = np.asarray(response.outputs).reshape(-1, times.size)
            values = dict(measure(plan, response)) if measure is not None else {}
            values |= response_metrics(times, signals[rows], plan, start, band, first.labels, only)
            if unstable.size:
                values |= {key: np.inf for key in values if "settling_time" in key}
            if acting:
                values |= control_metrics(times, signals[acting_rows], start, acting, only)
        found[name] = values | (path_metrics(plan, points) if only is None else {})
        responses[name], limits[name] = response, limits_of(system)

    failures = _each(run, references)
    references = {name: plan for name, plan in references.items() if name not in failures}
    stopped = {name: event for name, event in stopped.items() if name not in failures}
    beside = None
    if not isinstance(worth, bool | Mapping):
        raise TypeError(f"worth must be True, False or a mapping of choices, got {worth!r}")
    if worth is not False:
        from ctrlplan.studies.worth import worth as judged

        if not points:
            raise ValueError("worth needs waypoints, in the place of plans or as waypoints, got none")
        shared: dict[str, Any] = {
            "alpha": next((plan.alpha for plan in references.values() if isinstance(plan, TrigSpline)), alpha),
            "outputs": outputs,
            "controls": controls,
            "initial_state": initial_state,
            "band": band,
            "start": start,
            "params": params,
            "events": events,
            "measures": measures,
            "units": units,
        }
        if measure is not None:
            shared["measure"] = lambda plan, response, last: measure(plan, response)
        beside = judged(loop, points, times, **shared | (dict(worth) if isinstance(worth, Mapping) else {}))
    return Comparison(
        plans=references,
        responses=responses,
        metrics=found,
        outputs=tracked,
        controls=acting,
        waypoints=points,
        units=dict(units or {}),
        title=title,
        parameters=dict(parameters or {})
        | ({} if only is not None and not only else {"settling band": f"{100 * band:g} %"}),
        notes=(*_notes(unstable, found), *_notes_of_events(responses, stopped), *_notes_of_failures(failures)),
        marks={name: f"the run was ended: {event}" for name, event in stopped.items()},
        measures=dict(measures or {}) | MEASURES,
        worth=beside,
        failures=failures,
        limits=limits,
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


def _notes(unstable: NDArray[np.complex128], found: dict[str, dict[str, float]]) -> tuple[str, ...]:
    if unstable.size:
        worst = unstable[unstable.real.argmax()]
        pole = f"{worst.real:.4g}" + (f" ± {abs(worst.imag):.4g}j" if worst.imag else "")
        return (f"The loop is unstable: it has a pole at {pole} 1/s. No reference makes it settle.",)
    never = [name for name, values in found.items() if values.get("settling_time") == np.inf]
    if never:
        return (
            f"With {', '.join(never)} the output does not settle within the run: the run is too short, or the loop "
            "keeps an error.",
        )
    return ()


def _notes_of_events(responses: Mapping[str, Any], stopped: Mapping[str, Occurrence]) -> tuple[str, ...]:
    """What happened on the way, plan by plan."""
    notes = []
    for plan, response in responses.items():
        names = dict.fromkeys(event.name for event in response.events if event.kind != "inside")
        left = []
        for name in names:
            at = [event.time for event in response.events if event.name == name and event.kind != "inside"]
            what = name if ":" in name else f"{name} left its limits"
            left.append(f"{what} {len(at)} times, first at {at[0]:.4g} s")
        ended = f"; the run was ended at {stopped[plan].time:.4g} s, and is not measured" if plan in stopped else ""
        if left:
            notes.append(f"With {plan}, {', '.join(left)}{ended}.")
    return tuple(notes)


def _notes_of_failures(failures: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(f"With {plan} the run failed, and it is left out: {reason}" for plan, reason in failures.items())


def _each(run: Callable[[str, Trajectory], None], references: Mapping[str, Trajectory]) -> dict[str, str]:
    """Run every plan; those that fail, and why. An error that meets all of them is raised."""
    errors: dict[str, Exception] = {}
    for name, plan in references.items():
        try:
            run(name, plan)
        except Exception as error:  # whatever a loop does with this plan
            errors[name] = error
    if len(errors) == len(references):
        raise next(iter(errors.values()))
    return {name: _reason(error) for name, error in errors.items()}


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
    """Outputs that follow a plan: as given, those named like its axes, or the first ones."""
    labels = list(loop.output_labels)
    if outputs is not None:
        names = tuple(outputs)
    elif all(label in labels for label in plan.labels):
        names = plan.labels
    else:
        names = tuple(labels[: plan.naxes])
    if len(names) != plan.naxes:
        raise ValueError(f"outputs must be as many as the plan's axes, {plan.naxes}, got {', '.join(names) or 'none'}")
    for name in names:
        _known(loop, name)
    return names


def acting_outputs(loop: Any, controls: Sequence[str] | None) -> tuple[str, ...]:
    """Outputs that are controls: as given, or those whose names begin with u."""
    if controls is None:
        return tuple(name for name in loop.output_labels if name.startswith("u"))
    names = tuple(controls)
    for name in names:
        _known(loop, name)
    return names


def _initial_state(loop: Any, plan: Trajectory, times: Array, given: ArrayLike | None) -> ArrayLike:
    """State given, or the loop's own, or rest at the plan's first position."""
    if given is not None:
        return given
    stated = stated_start(loop)
    if stated is not None:
        return stated
    return rest_state(loop, plan.jet(times[:1], 0, left=True)[0, :, 0])


def _known(loop: Any, name: str) -> None:
    if name not in loop.output_labels:
        raise ValueError(f"outputs and controls must be among {', '.join(loop.output_labels)}, got {name!r}")
