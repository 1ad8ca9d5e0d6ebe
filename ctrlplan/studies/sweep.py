"""Comparisons over the values of a parameter."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import real_array
from ctrlplan._display import Displayed, Facts, Part, Table, counted, number
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Params
from ctrlplan.simulation import Event
from ctrlplan.studies.alike import Linear
from ctrlplan.studies.batches import FIRST, FIRST_OF_TASK, Batches
from ctrlplan.studies.checkpoint import digest
from ctrlplan.studies.comparison import finite_or_none, shown_in_units
from ctrlplan.studies.ensemble import Failure, numbers_shown
from ctrlplan.studies.executing import Executed, Execution, executed
from ctrlplan.studies.executors import Executor
from ctrlplan.studies.experiment import Experiment, Measured, Metrics
from ctrlplan.studies.measures import MEASURES, Measure, leading_metrics, shown_measures, wanted_measures
from ctrlplan.studies.outcomes import Failed
from ctrlplan.studies.roles import Role, role_of
from ctrlplan.studies.running import CONTROL, Builder, System, is_builder
from ctrlplan.studies.units import (
    Signals,
    in_units,
    listed_measures,
    own_scale,
    with_superscripts,
    without_rounding,
)
from ctrlplan.trajectories import Trajectory, Waypoint

if TYPE_CHECKING:
    import pandas as pd
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike

Array = NDArray[np.float64]
_Outcome: TypeAlias = dict[str, tuple[dict[str, float], tuple[str, ...]]]
"""Metrics, and labels of outputs and controls, by plan."""


@dataclass(frozen=True, repr=False)
class Sweep(Displayed):
    """Metrics of all plans over a parameter, as returned by `sweep`.

    Attributes
    ----------
    parameter : str
        Name of the parameter.
    values : ndarray, shape (nvalues,)
        Its values, increasing.
    metrics : dict of str to dict of str to ndarray
        Values of each metric by plan, shape (nvalues,); nan for failed values.
    failures : tuple of Failure
        Failed values, with the reason; `Failure.draw` is the index of the value.
    interrupted : bool
        Whether Ctrl-C ended the sweep; values that did not run are not in `values`.
    roles : dict of str to Role
        Role of each plan, if known.
    band : float
        Half width of the settling band, relative to the range of the plan.
    units : dict of str to str
        Units of axes, outputs and controls by label.
    axes, controls : tuple of str
        Labels of the axes of the plans, and of the controls.
    measures : dict of str to Measure
        Titles and units of the metrics.
    sent_again : tuple of float
        Values that were sent to an executor again because their worker ended.
    missing : tuple of float
        Values that no worker finished, which are in `failures` too, or that did
        not run before an interruption.
    """

    parameter: str
    values: Array
    metrics: dict[str, dict[str, Array]]
    failures: tuple[Failure, ...] = ()
    interrupted: bool = False
    roles: dict[str, Role] = field(default_factory=dict)
    band: float = 0.02
    units: dict[str, str] = field(default_factory=dict)
    axes: tuple[str, ...] = ()
    controls: tuple[str, ...] = ()
    measures: dict[str, Measure] = field(default_factory=lambda: dict(MEASURES))
    sent_again: tuple[float, ...] = ()
    missing: tuple[float, ...] = ()

    def title_of(self, name: str) -> str:
        """Title of a metric."""
        return self.measures[name].title if name in self.measures else name

    def unit_of(self, name: str) -> str:
        """Unit of a metric in the units of the sweep; empty where it is not known."""
        if name not in self.measures:
            return ""
        known = [{self.units.get(label, "") for label in labels} for labels in (self.axes, self.controls)]
        y, u = (found.pop() if len(found) == 1 else "" for found in known)
        return in_units(with_superscripts(self.measures[name].unit), y, u)

    def _describe(self) -> Iterator[Part]:
        yield f"Sweep of {', '.join(self.metrics)} over {counted(self.values.size, 'value')} of {self.parameter}"
        ends = f"{number(float(self.values.min()))} to {number(float(self.values.max()))}" if self.values.size else ""
        yield Facts(
            [
                (self.parameter, ends),
                ("failures", str(len(self.failures)) if self.failures else ""),
                ("interrupted", "yes: some values were not run" if self.interrupted else ""),
                ("sent again", numbers_shown(self.sent_again)),
                ("missing", numbers_shown(self.missing)),
            ]
        )
        yield self.metric_table()
        if self.failures:
            first = self.failures[0]
            yield f"First failure: {self.parameter} = {number(float(self.values[first.draw]))}: {first.message}"

    def key_metrics(self) -> dict[str, list[str]]:
        """Rows of the key metrics by name, eight at most: those that print and pages show."""
        listed = {name: one for name, one in self.measures.items() if any(name in row for row in self.metrics.values())}
        return leading_metrics(listed, self._cells)

    def metric_table(self) -> Table:
        """Minimum and maximum of the key metrics over the values, as print shows them."""
        rows = list(self.key_metrics().values())
        return Table("Metrics over all values, minimum to maximum", ("metric", "unit", *self.metrics), rows)

    def _cells(self, name: str, measure: Measure) -> list[str]:
        """Unit of a metric if it is known, and its range for each plan."""
        cells, scale = [self.unit_of(name)], own_scale(measure)
        for plan in self.metrics:
            column = self.column(plan, name)
            known = column[~np.isnan(column)]
            ends = [without_rounding(float(f(known)), scale) for f in (np.min, np.max)] if known.size else [np.nan] * 2
            low, high = (number(end, measure.unit) for end in ends)
            cells.append(low if low == high else f"{low} to {high}")
        return cells

    def to_pandas(self) -> pd.DataFrame:
        """Table with one row per value, and columns by plan and metric."""
        import pandas as pd

        columns = {(plan, name): row for plan, rows in self.metrics.items() for name, row in rows.items()}
        return pd.DataFrame(columns, index=pd.Index(self.values, name=self.parameter)).rename_axis(
            columns=["plan", "metric"]
        )

    def results(self, names: Sequence[str]) -> dict[str, object]:
        """Plain data for JSON: the values, and some metrics of each plan, null where it has none."""
        rows = {
            plan: {name: [finite_or_none(value) for value in self.column(plan, name).tolist()] for name in names}
            for plan in self.metrics
        }
        return {self.parameter: self.values.tolist()} | rows

    def merged(self, other: Sweep) -> Sweep:
        """Union of two sweeps, in order of the values; nan if one lacks a metric of the other."""
        values = np.concatenate([self.values, other.values])
        order = np.argsort(values, kind="stable")
        place = np.argsort(order)
        names = {
            plan: dict.fromkeys((*self.metrics.get(plan, {}), *other.metrics.get(plan, {})))
            for plan in dict.fromkeys((*self.metrics, *other.metrics))
        }
        rows = {
            plan: {name: np.concatenate([one.column(plan, name) for one in (self, other)])[order] for name in found}
            for plan, found in names.items()
        }
        moved = [replace(failure, draw=int(place[failure.draw])) for failure in self.failures]
        moved += [replace(failure, draw=int(place[failure.draw + self.values.size])) for failure in other.failures]
        failures = tuple(sorted(moved, key=lambda failure: failure.draw))
        failed = values[order][[failure.draw for failure in failures]]
        interrupted = self.interrupted or other.interrupted
        again, missing = (
            tuple(sorted({*getattr(self, name), *getattr(other, name)})) for name in ("sent_again", "missing")
        )
        return replace(
            self,
            values=values[order],
            metrics=rows,
            failures=failures,
            interrupted=interrupted,
            roles=self.roles | other.roles,
            sent_again=again,
            missing=tuple(value for value in missing if value not in values or value in failed),
        )

    def column(self, plan: str, name: str) -> Array:
        """Values of a metric of a plan, shape (nvalues,); nan if it has none."""
        return self.metrics.get(plan, {}).get(name, np.full(self.values.size, np.nan))

    def report(self, path: str | os.PathLike[str], title: str = "") -> Path:
        """Write one self-contained HTML page and return its path.

        It has the extrema of the metrics, their curves over the parameter, all
        values in a table, and the values that failed.

        Parameters
        ----------
        path : str or path
            The file, or a folder for ``index.html`` in it.
        title : str, optional
            Heading; "Sweep over" the parameter unless given.

        Returns
        -------
        pathlib.Path

        Raises
        ------
        ValueError
            If no value could be run.
        OSError
            If the page cannot be written; nothing is left behind.
        """
        from ctrlplan.reports import write_page

        if not self.metrics or len(self.failures) == self.values.size:
            early = self.interrupted and not self.failures
            why = "interrupted before any value" if early else "in which every value failed; see .failures"
            raise ValueError(f"a report must have metrics, got a sweep {why}")
        return write_page([self], path, title or f"Sweep over {self.parameter}")

    def plot(
        self, names: Sequence[str] = ("settling_time", "overshoot_error"), *, ax: AxesLike | None = None
    ) -> ControlPlot:
        """Plot metrics versus the parameter.

        Parameters
        ----------
        names : sequence of str, optional
            Metrics, one axes each.
        ax : array of Axes, shape (number of metrics,), optional
            Where to draw; None: an empty current figure, or a new one.

        Returns
        -------
        control.ControlPlot
            Of shape (number of metrics, 1).
        """
        from ctrlplan.reports.figures import plot_sweep

        return plot_sweep(self, names, ax=ax)


def sweep(
    build: Callable[[float], System | Builder],
    values: ArrayLike,
    plans: Mapping[str, Trajectory] | Iterable[Waypoint],
    timepts: ArrayLike,
    *,
    parameter: str = "value",
    waypoints: Iterable[Waypoint] = (),
    start: float | None = None,
    band: float = 0.02,
    outputs: Sequence[str] | None = None,
    controls: Sequence[str] | None = None,
    initial_state: ArrayLike | None = None,
    params: Params | None = None,
    events: Sequence[Event] | None = None,
    measures: Collection[str | Measure] | Mapping[str, Measure] | None = None,
    units: Mapping[str, str] | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    chunk: int | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = True,
    timeout: float | None = None,
) -> Sweep:
    """Compare plans in a loop for each value of a parameter.

    A value is recorded in `Sweep.failures` with the reason if its run raises an
    exception, calls ``sys.exit`` or exceeds the time limit; the sweep continues.
    Ctrl-C ends the sweep: finished results are returned with a warning, and tasks
    that have not begun are cancelled; an executor finishes those that have. A
    second Ctrl-C, or one before the first result of `monte_carlo`, raises
    KeyboardInterrupt.

    Parameters
    ----------
    build : callable
        Maps a value to a loop, as for `compare`.
    values : array_like, shape (nvalues,)
        Values of the parameter, increasing.
    plans, timepts
        As for `compare`.
    parameter : str, optional
        Name of the parameter.
    waypoints, start, band, outputs, controls, initial_state, params, events, measures : optional
        As in `Experiment`.
    units : mapping of str to str, optional
        Units by label, as for `compare`. A maximum over signals in different
        units is not defined and becomes nan.
    executor : concurrent.futures.Executor or alike, optional
        Where the comparisons run: an object with ``submit`` whose result has
        ``result``, as of `dask.distributed`, `loky` or `mpi4py.futures`; not a
        `multiprocessing.Pool`. Other processes require a `build` that the
        executor can pickle. Linear loops of the same structure are solved and
        measured together, which is much faster than one by one.
    workers : int, optional
        Number of workers of the executor, if it does not state one: at most twice
        as many tasks are in flight. If the number is not known, all tasks are
        submitted at the beginning.
    chunk : int, optional
        Number of values of a task; by default at most 250, fewer if a worker
        would have less than four tasks. A task returns after a second what it has
        not run, unless `build` or a run does not return.
    checkpoint : path, optional
        Folder of finished values, which is made if needed. A second call with the
        same values and options runs only what is missing. Failures are run again.
        `build` is not compared: use a new folder after a change of the loop.
    progress : bool, optional
        Whether a progress bar is shown on stderr.
    timeout : float, optional
        Time limit of one value [s]. It is checked between evaluations of the
        equations of the loop, and in a compiled loop between breakpoints. A
        user's function that does not return is not stopped. Linear loops are
        solved in closed form, without a time limit.

    Returns
    -------
    Sweep

    Raises
    ------
    TypeError
        If `executor` has no ``submit``, or `build` is not a function.
    ValueError
        If the values are not finite or do not increase, `build` returns loops with
        different outputs or controls or cannot be sent to other processes, or the
        checkpoint is that of another study. If all values fail, the first exception
        is raised, SystemExit as a RuntimeError.
    RuntimeError
        If a worker has other versions of ctrlplan or casadi.
    OSError
        If the folder of the checkpoint cannot be made, read or written to.

    Warns
    -----
    UserWarning
        If Ctrl-C ended the sweep; or if finished values cannot be written to the
        checkpoint, as on a full disk. They are kept in memory and in the result,
        and written later if that becomes possible.

    See Also
    --------
    monte_carlo : Random draws of several parameters.

    Notes
    -----
    The loop is sent to each worker once, a task has its values only. Values of a
    task whose worker ends are sent again, twice at most, one at a time, so that
    only the value that ends its worker has no result: see `Sweep.sent_again` and
    `Sweep.missing`. A broken process pool of `concurrent.futures` or loky is
    replaced by one of the same size and start method. Nothing runs in this process
    instead. Results differ from those without an executor by rounding errors,
    1e-14 of the largest value.

    On a dask cluster, with `build` and `values` in a module ``study``::

        from dask.distributed import Client
        import ctrlplan as cp, study
        if __name__ == "__main__":
            with Client("tcp://scheduler:8786") as client:
                cp.sweep(study.build, study.values, study.plans, study.timepts, executor=client)

    With MPI, the script takes ``executor=mpi4py.futures.MPIPoolExecutor()`` and is
    started with one process for itself and one for each worker::

        mpiexec -n 65 python -m mpi4py.futures study.py

    With ray, the executor is an object of the class::

        class Ray:
            def submit(self, function, task):
                return ray.remote(function).remote(task).future()

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> found = cp.sweep(cp.plants.integrator_lag_loop, [1, 100], move, np.linspace(0, 20, 2001), progress=False)
    >>> found.metrics["step"]["overshoot_error"].round(1)
    array([16.3, 85.4])
    """
    execution = Execution.from_arguments(locals())
    points = _checked_values(values)
    if not is_builder(build):
        raise TypeError(f"build must be a function of a value that returns a loop, got {type(build).__name__}")
    experiment = Experiment.from_arguments(locals())
    outcomes = _Outcomes(points)
    alike = None if units is not None else partial(_outcomes_alike, experiment)
    first = FIRST if executor is None else FIRST_OF_TASK
    runs = Batches(experiment, build, partial(_outcome, experiment, units), alike, first)

    def identity() -> dict[str, object]:
        return {"kind": "sweep", "values": digest(points), "units": dict(units or {}), **experiment.identity()}

    done = executed(runs, points.tolist(), outcomes.add, execution, parameter, identity)
    done.raise_if_none_ran("build")
    found = _swept(parameter, points, outcomes.metrics, done, experiment)
    found = _described(found, experiment, dict(units or {}))
    if found.interrupted:
        text = f"the sweep was interrupted: {found.values.size} of {points.size} values are returned"
        warnings.warn(text, UserWarning, stacklevel=outside_stacklevel())
    return found


class _Outcomes:
    """Metrics of each value as they arrive, of loops with the same outputs and controls.

    Attributes
    ----------
    metrics : dict of int to Metrics or Failed
        Metrics by the number of the value.
    """

    def __init__(self, points: Array) -> None:
        self.metrics: dict[int, Metrics | Failed] = {}
        self._points = points
        self._first: dict[str, tuple[int, tuple[str, ...]]] = {}

    def add(self, k: int, outcome: _Outcome | Failed) -> None:
        """Add the outcome of one value, in any order.

        Raises
        ------
        ValueError
            If its loop has other outputs or controls than those before it.
        """
        if isinstance(outcome, Failed):
            self.metrics[k] = outcome
            return
        for plan, (_, labels) in outcome.items():
            first, known = self._first.setdefault(plan, (k, labels))
            if labels != known:
                own, other = (
                    f"{', '.join(names)} for {self._points[i]:g}" for i, names in ((k, labels), (first, known))
                )
                raise ValueError(
                    f"build must return loops with the same outputs and controls for all values, "
                    f"got {own} and {other}, with the plan {plan}; give outputs= and controls="
                )
        self.metrics[k] = {plan: metrics for plan, (metrics, _) in outcome.items()}


def _checked_values(values: ArrayLike) -> Array:
    points = np.atleast_1d(real_array(values, "values"))
    if points.ndim != 1 or not points.size or not np.isfinite(points).all() or np.any(np.diff(points) <= 0.0):
        raise ValueError(f"values must be finite and increase strictly, got {points.tolist()!s:.80}")
    return points


def _swept(
    parameter: str, points: Array, outcomes: Mapping[int, Metrics | Failed], done: Executed, experiment: Experiment
) -> Sweep:
    found = dict(sorted(outcomes.items()))
    errors = [(i, outcome) for i, outcome in enumerate(found.values()) if isinstance(outcome, Failed)]
    if errors and len(errors) == len(found) and not done.interrupted:
        raise errors[0][1].error
    reached = points[list(found)]
    rows: dict[str, dict[str, Array]] = {}
    for i, metrics in enumerate(found.values()):
        for plan, values in metrics.items() if not isinstance(metrics, Failed) else ():
            row = rows.setdefault(plan, {})
            for name, value in values.items():
                if name not in row:
                    row[name] = np.full(reached.size, np.nan)
                row[name][i] = value
    if not rows:  # interrupted before a value was finished
        names = wanted_measures(experiment.measures)
        rows = {plan: {name: np.full(reached.size, np.nan) for name in names} for plan in experiment.plans}
    failures = tuple(Failure(i, {parameter: float(reached[i])}, failed.message) for i, failed in errors)
    again, missing = (tuple(points[list(numbers)].tolist()) for numbers in (done.sent_again, done.missing))
    return Sweep(parameter, reached, rows, failures, done.interrupted, sent_again=again, missing=missing)


def _described(found: Sweep, experiment: Experiment, units: dict[str, str]) -> Sweep:
    """Sweep with the roles of its plans, and with titles and units of its metrics as a comparison lists them."""
    names = [dict.fromkeys(row, 0.0) for row in found.metrics.values()]
    acting = experiment.controls or _controls_in(names, experiment) or tuple(filter(CONTROL.match, units))
    labels = experiment.axes
    axes = labels if set(labels) & set(units) else tuple(name for name in units if name not in acting)
    outputs = axes if len(axes) == len(labels) else labels
    signals = Signals(dict(zip(labels, outputs, strict=True)), acting, units)
    return replace(
        found,
        roles={name: role_of(experiment.plans[name]) for name in found.metrics},
        band=experiment.band,
        units=units,
        axes=outputs,
        controls=acting,
        measures=listed_measures({}, shown_measures(experiment.measures, names), signals),
    )


def _controls_in(names: Iterable[Iterable[str]], experiment: Experiment) -> tuple[str, ...]:
    """Controls by the names of their metrics, which several controls have each; empty for fewer."""
    stems = [f"{name}_" for name, one in wanted_measures(experiment.measures).items() if one.of == "control"]
    found = (key.removeprefix(stem) for row in names for key in row for stem in stems if key.startswith(stem))
    return tuple(dict.fromkeys(found))


def _outcome(experiment: Experiment, units: Mapping[str, str] | None, loop: System | Builder) -> _Outcome:
    """Outcome of one loop."""
    found = experiment.run(loop).whole()
    if units is not None:
        shown_in_units(experiment, found, units)
    return _of(found)


def _outcomes_alike(experiment: Experiment, loops: Sequence[Linear]) -> list[_Outcome | None]:
    """Outcomes of linear loops of the same structure; None for those that must be run separately."""
    return [None if one is None else _of(one) for one in experiment.run_alike(loops) or ()]


def _of(found: Measured) -> _Outcome:
    return {plan: (metrics, found.labels[plan]) for plan, metrics in found.metrics.items()}


def settling_jumps(values: Array, settling: Array, slope: float = 3.0) -> NDArray[np.bool_]:
    """Whether a settling time jumps between neighbouring values of a gain, shape (nvalues - 1,).

    Between jumps the settling time varies like the period of the oscillation,
    with the power -1/2 of the gain. A jump is a change of more than 0.5 % with a
    power of more than `slope`.
    """
    found = np.zeros(values.size - 1, dtype=bool)
    usable = np.isfinite(settling) & (settling > 0.0) & (values > 0.0)
    pairs = usable[1:] & usable[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        change, width = np.abs(np.diff(np.log(settling))), np.diff(np.log(values))
    found[pairs] = (change[pairs] > 0.005) & (change[pairs] > slope * width[pairs])
    return found
