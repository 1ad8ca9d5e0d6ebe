"""Comparison of several plans in one loop."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._display import Displayed, Facts, Part, Table, in_line, number
from ctrlplan._files import write_text
from ctrlplan._renamed import FormerAttribute
from ctrlplan._types import Array, Params
from ctrlplan.simulation import Event, SimulationResponse, signal_table
from ctrlplan.studies.experiment import Experiment, Measured
from ctrlplan.studies.limits import limits_of
from ctrlplan.studies.measured import MeasuredRun, with_measured
from ctrlplan.studies.measures import MEASURES, Measure, leading_metrics, shown_measures, signals_of
from ctrlplan.studies.notes import how_measured, mark_of, notes_of
from ctrlplan.studies.plans import references_of, waypoints_given
from ctrlplan.studies.roles import Role, Stability, role_of, stability_of
from ctrlplan.studies.running import Builder, System
from ctrlplan.studies.sections import AnimatedCrane, CranePaths, Paths, PlanCurves, Responses, Section
from ctrlplan.studies.study import Study
from ctrlplan.studies.units import Signals, checked_units, listed_measures, output_unit, scales_of, signals_of_runs
from ctrlplan.studies.verdicts import summary, unit_of, verdicts
from ctrlplan.trajectories import Trajectory, Waypoint
from ctrlplan.trajectories.export import SampledTable, export_table

if TYPE_CHECKING:
    import pandas as pd
    from control import ControlPlot, TimeResponseData

    from ctrlplan.planning import Obstacle
    from ctrlplan.reports.style import AxesLike
    from ctrlplan.studies.benefit import Benefit


@dataclass(frozen=True, repr=False)
class Comparison(Displayed):
    """Responses of a loop to several plans, with metrics, as returned by `compare`.

    Attributes
    ----------
    plans : dict of str to Trajectory
        The references by name.
    responses : dict of str to SimulationResponse
        Responses of the loop by plan.
    metrics : dict of str to dict of str to float
        Value of each metric by plan, see `ctrlplan.studies.MEASURES`; inf if
        never reached, nan if undefined.
    outputs, controls : tuple of str
        Outputs of the loop that follow the plan, and outputs that are controls.
    waypoints : tuple of Waypoint
        Waypoints of the plans, if known.
    units : dict of str to str
        Units of axes and controls by label.
    title : str
        Heading of figures and report.
    parameters : dict of str to object
        Parameters shown in the report.
    notes : tuple of str
        Notes on stability, settling, events and failures.
    marks : dict of str to str
        Notes on the metrics of single plans.
    measures : dict of str to Measure
        Titles and units of the metrics, in the order of the tables.
    scales : dict of str to float
        Scale of each metric, from the range of the plans, the peak of the
        controls and the simulated time; a difference below 1e-6 of it counts as
        rounding. Without an entry if it is unknown.
    stopped : dict of str to float
        Times [s] at which an event ended the run of a plan. Its metrics cover
        the time before and are not ranked.
    benefit : Benefit or None
        Benefit of planning, to be shown on the page: see `with_benefit`.
    failures : dict of str to str
        Reasons of plans whose run failed; these have no other entries.
    limits : dict of str to dict of str to (float, float)
        Limits (minimum, maximum) of outputs by plan, as declared by actuators.
    roles : dict of str to Role
        Role of each plan.
    stability : Stability
        Stability of the loops, as far as it is known.
    experiment : Experiment or None
        Plans, times and measures of the comparison.
    measured : dict of str to MeasuredRun
        Measured runs by name, which are entries of the other attributes too: see
        `with_measured`.
    """

    plans: dict[str, Trajectory]
    responses: dict[str, SimulationResponse]
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
    benefit: Benefit | None = None
    failures: dict[str, str] = field(default_factory=dict)
    limits: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    scales: dict[str, float] = field(default_factory=dict)
    stopped: dict[str, float] = field(default_factory=dict)
    roles: dict[str, Role] = field(default_factory=dict)
    stability: Stability = Stability.UNKNOWN
    experiment: Experiment | None = None
    measured: dict[str, MeasuredRun] = field(default_factory=dict)

    worth = FormerAttribute("benefit")

    def _describe(self) -> Iterator[Part]:
        failed = f" ({', '.join(self.failures)} failed)" if self.failures else ""
        yield f"Comparison of {', '.join(self.plans)}{failed}: {self.title}"
        times = [response.time for response in self.responses.values() if len(response.time)]
        span = f"{min(t[0] for t in times):.6g} to {max(t[-1] for t in times):.6g} s" if times else ""
        yield Facts(
            [
                ("outputs", ", ".join(self.outputs)),
                ("controls", ", ".join(self.controls)),
                ("time", span),
                ("loop", "" if self.stability is Stability.UNKNOWN else self.stability.value),
            ]
        )
        yield self.metric_table()
        yield summary(self)
        yield from (note for note in self.notes if note != summary(self))
        for verb, reasons in (("", self.marks), ("failed: ", self.failures)):
            for plan, reason in reasons.items():
                yield f"{plan}: {verb}{reason}"

    def key_metrics(self) -> dict[str, list[str]]:
        """Rows of the key metrics by name, eight at most: those that print and pages show."""
        listed = {name: one for name, one in self.measures.items() if any(name in row for row in self.metrics.values())}
        return leading_metrics(listed, self._cells)

    def metric_table(self) -> Table:
        """Key metrics as print shows them, the best value of each marked."""
        rows = self.key_metrics()
        first = {verdict.key: verdict.best for verdict in verdicts(self)}
        best = [
            (i, j)
            for i, name in enumerate(rows)
            for j, plan in enumerate(self.metrics, 2)
            if plan in first.get(name, ())
        ]
        left = sum(any(name in row for row in self.metrics.values()) for name in self.measures) - len(rows)
        more = f"; {left} more in .metrics" if left else ""
        caption = f"Metrics{' (* best)' if best else ''}{more}"
        return Table(caption, ("metric", "unit", *self.metrics), list(rows.values()), frozenset(best))

    def _cells(self, name: str, measure: Measure) -> list[str]:
        """Unit and values of a metric; a value that differs from 0 by rounding is 0."""
        rounding = 1e-9 * self.scales.get(name, 0.0)
        values = [row.get(name, math.nan) for row in self.metrics.values()]
        values = [0.0 if abs(value) <= rounding else value for value in values]
        return [unit_of(self, name), *(number(value, measure.unit) for value in values)]

    def to_pandas(self) -> pd.DataFrame:
        """Table of metrics with one row per metric and one column per plan."""
        import pandas as pd

        return pd.DataFrame(self.metrics).rename_axis(index="metric", columns="plan")

    def results(self) -> dict[str, object]:
        """Plain data for JSON: metrics by plan, null if infinite or undefined."""
        data: dict[str, object] = {"plans": self._plans()}
        if self.failures:
            data["failures"] = dict(self.failures)
        return data if self.benefit is None else data | {"worth": self.benefit.results()}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write metrics, plans and parameters as JSON; on an error no file remains."""
        plans = {name: found | {"trajectory": self.plans[name].to_dict()} for name, found in self._plans().items()}
        stated = {"title": self.title, "parameters": {k: in_line(v) for k, v in self.parameters.items()}}
        data = self.results() | {"plans": plans} | stated
        write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")

    def export(self, path: str | os.PathLike[str]) -> Path:
        """Write the responses, in the format of the path's ending: .csv, .mat or .npz.

        Columns are plan.signal, with the signals of `SimulationResponse.export`;
        nan after an event has stopped a run.

        Parameters
        ----------
        path : str or path
            File to be written, in an existing folder.

        Returns
        -------
        Path
            File written.

        Raises
        ------
        ValueError
            If the ending is unknown, or names are not unique in the format.
        OSError
            If the file cannot be written; an existing file is then unchanged.
        """
        tables = {plan: signal_table(response) for plan, response in self.responses.items()}
        times = np.unique(np.concatenate([table.times for table in tables.values()]))
        names, rows = [], []
        for plan, table in tables.items():
            values = np.full((len(table.names), times.size), np.nan)
            values[:, np.searchsorted(times, table.times)] = table.rows
            names += [f"{plan}.{name}" for name in table.names]
            rows.append(values)
        return export_table(SampledTable(times, tuple(names), np.concatenate(rows)), path)

    def _plans(self) -> dict[str, dict[str, object]]:
        return {
            plan: {"metrics": {name: finite_or_none(value) for name, value in found.items()}}
            for plan, found in self.metrics.items()
        }

    def marked(self, marks: Mapping[str, str]) -> Comparison:
        """Comparison with further notes on single plans."""
        both = {name: "; ".join(filter(None, (self.marks.get(name), mark))) for name, mark in marks.items()}
        return replace(self, marks=self.marks | both)

    def with_benefit(self, benefit: Benefit) -> Comparison:
        """Comparison with a benefit, shown on its page and in its results."""
        return replace(self, benefit=benefit)

    def with_measured(
        self, logs: Mapping[str, TimeResponseData], *, align: Literal["auto"] | str | float | None = "auto"
    ) -> Comparison:
        """Comparison with measured runs next to the simulated ones.

        A measured run has the same metrics and is drawn in the same figures;
        its name is that of its plan followed by "(measured)". Its samples are used
        from the start to the end of the simulation, with linear interpolation at the
        times of the simulation. Metrics of signals that the log does not contain
        are omitted; settling times, overshoot and lag are nan if it ends before the
        move. Measured runs are not ranked.

        Parameters
        ----------
        logs : mapping of str to TimeResponseData
            Log of the machine by name of the plan that it followed, as `read_log`
            returns it: signals have the labels of the loop's outputs, as far as
            they are measured, and may include the command.
        align : "auto", str, float or None, optional
            How the time of the log is aligned with that of the plan:

            - "auto": by the command where the log contains it, under the label of
              the loop's input or of the plan's axis with _ref or _cmd; otherwise by
              the outputs that follow the plan, compared with the simulated ones or
              the plan, whichever fits better. Offset and plant delay cannot then be
              told apart.
            - name of a signal: by this signal, a command or an output of the loop.
            - number: time of the log minus time of the plan [s].
            - None: both times are the same.

        Returns
        -------
        Comparison
            With the runs in `measured`, where the offsets are with their standard
            errors.

        Raises
        ------
        ValueError
            If a plan is unknown, a log has no signal of the comparison or does not
            overlap the simulated time, or the offset cannot be found.
        TypeError
            If `logs` is no mapping, or an entry is no response.

        Examples
        --------
        >>> import numpy as np
        >>> import ctrlplan as cp
        >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
        >>> t = np.linspace(0, 2, 2001)
        >>> loop = cp.plants.integrator_lag_loop(100.0)
        >>> run = cp.simulate(loop, t, plan)
        >>> log = cp.read_log({"time": t + 7.3e-3, "y": run.outputs, "r": plan(t)})
        >>> found = cp.compare(loop, {"quintic": plan}, t).with_measured({"quintic": log})
        >>> list(found.metrics), round(found.measured["quintic (measured)"].offset, 6)
        (['quintic', 'quintic (measured)'], 0.0073)
        """
        return with_measured(self, logs, align)

    def signals(self, name: str) -> dict[str, Array]:
        """Outputs of a run by label, with nan for those of other runs that it does not have."""
        response = self.responses[name]
        known = dict.fromkeys(label for one in self.responses.values() for label in one.output_labels or ())
        return {label: np.full(np.size(response.time), np.nan) for label in known} | signals_of(response)

    @property
    def simulated(self) -> list[str]:
        """Names of the runs that are not measured."""
        return [name for name in self.plans if name not in self.measured]

    @property
    def ranked(self) -> list[str]:
        """Names of the runs that are compared in the verdicts: neither measured nor ended by an event."""
        return [name for name in self.metrics if name not in self.stopped and name not in self.measured]

    def plot(self, ax: AxesLike | None = None) -> ControlPlot:
        """Plot responses, errors and controls versus time.

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

    def sections(self, obstacles: Iterable[Obstacle] = ()) -> tuple[Section, ...]:
        """Sections of its page: planar paths, plans and responses, and an animation if all loops are cranes."""
        labels = [set(self.responses[name].output_labels or ()) for name in self.simulated]
        cranes = all(known >= set(AnimatedCrane.signals) for known in labels)
        planar = len(self.outputs) == 2 and len({output_unit(self, output) for output in self.outputs}) == 1
        paths = [CranePaths()] if cranes else [Paths(obstacles=tuple(obstacles))] if planar else []
        return (*paths, PlanCurves(), Responses(), *([AnimatedCrane()] if cranes else []))

    def report(
        self, path: str | os.PathLike[str], *, author: str = "", text: str = "", obstacles: Iterable[Obstacle] = ()
    ) -> Path:
        """Write one self-contained HTML page and return its path.

        Parameters
        ----------
        path : str or path
            The file, or a folder for ``index.html`` in it.
        author : str, optional
            Author, written below the title.
        text : str, optional
            Paragraph of the page.
        obstacles : iterable of Obstacle, optional
            Obstacles in the figure of the paths of planar plans.
        """
        from ctrlplan.reports import write_page

        sections, words = self.sections(obstacles), (text,) if text else ()
        study = Study("comparison", self.title, self, notes=self.notes, sections=sections, text=words)
        return write_page([study], path, title=self.title, author=author)


def compare(
    loop: System | Builder,
    plans: Mapping[str, Trajectory] | Iterable[Waypoint],
    timepts: ArrayLike,
    *,
    waypoints: Iterable[Waypoint] = (),
    start: float | None = None,
    band: float = 0.02,
    outputs: Sequence[str] | None = None,
    controls: Sequence[str] | None = None,
    initial_state: ArrayLike | None = None,
    params: Params | None = None,
    events: Sequence[Event] | None = None,
    measures: Collection[str | Measure] | Mapping[str, Measure] | None = None,
    alpha: float = 1.0,
    units: Mapping[str, str] | None = None,
    parameters: Mapping[str, object] | None = None,
    title: str = "Step versus planned",
) -> Comparison:
    """Compare the responses of a loop to several plans.

    Parameters
    ----------
    loop : control system or callable
        Loop with one input (the reference) per axis of the plans; or a function
        that maps the name of a plan and the plan to a loop, which may contain
        the plan as a block and have no inputs. A plan that affects none of the
        outputs that follow it is an error.
    plans : mapping of str to Trajectory, or iterable of Waypoint
        The references by name; waypoints stand for the standard set of
        `ctrlplan.studies.standard_plans`: step, polynomial, trigonometric,
        piecewise.
    timepts : array_like, shape (ntime,)
        Sample times [s]; metrics are refined between them.
    waypoints, start, band, outputs, controls, initial_state, params, events, measures : optional
        As in `Experiment`.
    alpha : float, optional
        Shape parameter of the standard trigonometric plan [rad].
    units : mapping of str to str, optional
        Units of axes, outputs and controls by label. Controls in different
        units, or of which some have none, have separate metrics, and so have
        axes.
    parameters : mapping, optional
        Parameters shown in the report.
    title : str, optional
        Heading.

    Returns
    -------
    Comparison

    Raises
    ------
    ValueError
        If there is no plan, waypoints are given twice, plans differ in axes, a plan
        affects no output that follows it, `start` or `band` is out of range, or a name in `outputs`,
        `controls`, `measures` or `units` is unknown.
    TypeError
        If a plan is not a trajectory, or an argument has a wrong type.
    Exception
        The exception of the first plan, if the runs of all plans fail. If some
        fail, the reasons are in `Comparison.failures`.

    Warns
    -----
    UserWarning
        If no equilibrium was found for the start of a run.

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
    waypoints = waypoints_given(waypoints, "waypoints", "Waypoints")
    if not isinstance(plans, Mapping):
        if waypoints:
            raise ValueError("waypoints must be given once, got them as plans and as waypoints; omit waypoints=")
        waypoints = waypoints_given(plans)
        plans = references_of(waypoints, alpha)
    experiment = Experiment.from_arguments(locals())
    return comparison_of(experiment, experiment.run(loop), units, parameters, title)


def comparison_of(
    experiment: Experiment,
    found: Measured,
    units: Mapping[str, str] | None = None,
    parameters: Mapping[str, object] | None = None,
    title: str = "Step versus planned",
) -> Comparison:
    """Comparison from the results of an experiment.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    found : Measured
        Its runs; metrics over signals in different units become nan.
    units, parameters, title : optional
        As for `compare`.
    """
    runs, plans = found.runs, {name: experiment.plans[name] for name in found.runs}
    listed, signals = shown_in_units(experiment, found, units)
    last = next(reversed(runs.values()))
    chosen = experiment.measures
    measured = chosen is None or any(isinstance(one, str) or one.of in ("response", "control") for one in chosen)
    stopped = {name: run.stop for name, run in runs.items() if run.stop is not None}
    return Comparison(
        plans=plans,
        responses={name: run.response for name, run in runs.items()},
        metrics=found.metrics,
        outputs=last.outputs,
        controls=last.controls,
        waypoints=experiment.waypoints,
        units=dict(units or {}),
        title=title,
        parameters=dict(parameters or {}) | (how_measured(signals, experiment.band) if measured else {}),
        notes=notes_of(found),
        marks={name: mark_of(stop) for name, stop in stopped.items()},
        measures=listed,
        scales=scales_of(shown_measures(experiment.measures, list(found.metrics.values())), signals),
        stopped={name: stop.time for name, stop in stopped.items()},
        failures=found.failures,
        limits={name: limits_of(run.system) for name, run in runs.items() if run.system is not None},
        roles={name: role_of(plan) for name, plan in plans.items()},
        stability=stability_of(runs.values()),
        experiment=experiment,
    )


def shown_in_units(
    experiment: Experiment, found: Measured, units: Mapping[str, str] | None
) -> tuple[dict[str, Measure], Signals]:
    """Measures as shown in tables, and signals measured; metrics without a common unit become nan.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    found : Measured
        Its runs and metrics.
    units : mapping or None
        As for `compare`.
    """
    plans = {name: experiment.plans[name] for name in found.runs}
    systems = [run.system for run in found.runs.values() if run.system is not None]
    known = checked_units(units, plans.values(), systems)
    signals = signals_of_runs(plans, found.runs, known, experiment.since)
    shown = shown_measures(experiment.measures, list(found.metrics.values()))
    return listed_measures(found.metrics, shown, signals), signals


def finite_or_none(value: float) -> float | None:
    """Same number, or None where it is infinite or undefined: JSON has neither."""
    return value if math.isfinite(value) else None
