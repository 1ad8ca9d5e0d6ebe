"""Experiment: plans, times and measures, checked in one place, and applied to loops."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

import ctrlplan
from ctrlplan._checks import checked_params, real_array
from ctrlplan._display import Displayed, Facts, Part, counted, time_text, title_of
from ctrlplan._types import Array, Params
from ctrlplan.simulation import Event, Prepared
from ctrlplan.simulation.built_forms import shared_forms
from ctrlplan.studies.alike import Linear, Together, numbers_of
from ctrlplan.studies.checkpoint import digest
from ctrlplan.studies.measures import (
    Chosen,
    Measure,
    Run,
    SignalRecord,
    checked_measures,
    move_end,
    path_metrics,
    run_metrics,
    signal_metrics,
    wanted_measures,
)
from ctrlplan.studies.plans import references_of, waypoints_given
from ctrlplan.studies.progress import each_plan
from ctrlplan.studies.running import Builder, System, check_has_inputs, is_builder, run_plan
from ctrlplan.trajectories import Trajectory, Waypoint
from ctrlplan.trajectories.repeated import covering

T = TypeVar("T")

Metrics = dict[str, dict[str, float]]
"""Plan, metric, value."""


@dataclass(frozen=True)
class Measured:
    """Results of an experiment with one loop.

    Attributes
    ----------
    metrics : dict of str to dict of str to float
        Value of each metric by plan.
    runs : dict of str to Run
        Runs by plan; empty for loops that were solved together.
    failures : dict of str to str
        Reasons of plans whose run failed; these have no other entries.
    signals : dict of str to dict of str to ndarray
        Outputs and controls by plan and label, at the samples that were given to
        `Experiment.run_alike`.
    labels : dict of str to tuple of str
        Labels of all outputs and controls by plan.
    """

    metrics: Metrics
    runs: dict[str, Run] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    signals: dict[str, dict[str, Array]] = field(default_factory=dict)
    labels: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def whole(self) -> Measured:
        """Return the same results if the runs of all plans succeeded.

        Raises
        ------
        RuntimeError
            If one failed, with its reason.
        """
        if self.failures:
            reasons = (f"the run of {plan} failed: {reason}" for plan, reason in self.failures.items())
            raise RuntimeError("; ".join(reasons))
        return self


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Experiment(Displayed):
    """Plans, sample times and measures of a comparison.

    `compare`, `sweep`, `monte_carlo`, `benefit` and study files construct an
    experiment from their arguments, which are checked here and have the same
    meaning in all of them.

    Attributes
    ----------
    plans : dict of str to Trajectory
        The references by name; waypoints stand for the standard set of
        `ctrlplan.studies.standard_plans`: step, polynomial, trigonometric,
        piecewise. A plan that repeats for all future times is repeated until after the
        last sample time.
    timepts : ndarray, shape (ntime,)
        Sample times [s]; metrics are refined between them, and those of signals
        that discrete controllers hold take the held values from their instants on.
    waypoints : tuple of Waypoint
        Waypoints of the plans, for the metrics of the path.
    start : float or None
        Start [s] of the interval of the metrics; by default, the earliest start
        of a plan.
    band : float
        Half width of the settling band relative to the range of the plan.
    outputs : tuple of str or None
        Outputs of the loop that follow the plan; by default, those named like
        its axes, otherwise the first ones.
    controls : tuple of str or None
        Outputs that are controls; by default, those whose names begin with u.
    initial_state : array_like or None
        State at the first sample time. By default, the attribute
        ``initial_state`` of a loop or of a block, and for all other states the
        equilibrium with the plan held at its first position, with a warning if
        no equilibrium is found.
    params : mapping or None
        Parameters of the loop's blocks, as for `simulate`.
    events : tuple of Event or None
        As for `simulate`; by default, those declared by blocks. If an event
        ends the run of a plan, its metrics cover the time before it.
    measures : tuple of str and Measure, or None
        Names of `ctrlplan.studies.MEASURES`, and measures of the user; by
        default, all of `MEASURES`. A mapping of names to measures adds these to
        all of `MEASURES`.

    Raises
    ------
    ValueError
        If there is no plan, plans differ in axes, `start` or `band` is out of
        range, or a measure is unknown.
    TypeError
        If a plan is not a trajectory, or an argument has a wrong type.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> experiment = cp.Experiment(move, np.linspace(0, 10, 2001), measures=["overshoot_error"])
    >>> found = experiment.run(cp.plants.integrator_lag_loop(100))
    >>> round(found.metrics["step"]["overshoot_error"], 1)
    85.4
    """

    plans: dict[str, Trajectory]
    timepts: Array
    _: KW_ONLY
    waypoints: tuple[Waypoint, ...] = ()
    start: float | None = None
    band: float = 0.02
    outputs: tuple[str, ...] | None = None
    controls: tuple[str, ...] | None = None
    initial_state: ArrayLike | None = None
    params: Params | None = None
    events: tuple[Event, ...] | None = None
    measures: Chosen = None

    def __init__(
        self,
        plans: Mapping[str, Trajectory] | Iterable[Waypoint],
        timepts: ArrayLike,
        *,
        waypoints: Iterable[Waypoint] = (),
        start: float | None = None,
        band: float = 0.02,
        outputs: Iterable[str] | None = None,
        controls: Iterable[str] | None = None,
        initial_state: ArrayLike | None = None,
        params: Params | None = None,
        events: Iterable[Event] | None = None,
        measures: Collection[str | Measure] | Mapping[str, Measure] | None = None,
    ) -> None:
        points = waypoints_given(waypoints, "waypoints", "Waypoints")
        if not isinstance(plans, Mapping):
            plans = points = waypoints_given(plans)
        references = references_of(plans)
        times = real_array(timepts, "timepts")
        _check_start(start, references.values(), times)
        last = float(times.max(initial=-math.inf))
        if math.isfinite(last):
            references = {name: covering(plan, last) for name, plan in references.items()}
        _check_band(band)
        checked = {
            "plans": references,
            "timepts": times,
            "waypoints": points,
            "start": start,
            "band": band,
            "outputs": _once(outputs),
            "controls": _once(controls),
            "initial_state": initial_state,
            "params": None if params is None else checked_params(params),
            "events": _once(events),
            "measures": checked_measures(measures),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def _describe(self) -> Iterator[Part]:
        times = f"{self.timepts.size} times from {self.timepts[0]:.6g} to {self.timepts[-1]:.6g} s"
        yield f"Experiment of {counted(len(self.plans), 'plan')} at {times}"
        names = [one.name or one.title if isinstance(one, Measure) else one for one in self.measures or ()]
        yield Facts(
            [
                *((f"plan {name}", title_of(plan)) for name, plan in self.plans.items()),
                ("waypoints", str(len(self.waypoints)) if self.waypoints else ""),
                ("metrics count from", f"{self.since:.6g} s"),
                ("settling band", f"{100.0 * self.band:.4g} % of the range of the plan"),
                ("outputs", ", ".join(self.outputs or ())),
                ("controls", ", ".join(self.controls or ())),
                ("events", "" if self.events is None else ", ".join(event.name for event in self.events) or "none"),
                ("measures", ", ".join(names) if self.measures is not None else "all of MEASURES"),
            ]
        )

    @classmethod
    def from_arguments(cls, given: Mapping[str, Any]) -> Experiment:
        """Experiment from the arguments of a function that has all its fields, by name."""
        return cls(**{entry.name: given[entry.name] for entry in fields(cls)})

    @property
    def axes(self) -> tuple[str, ...]:
        """Labels of the axes of the first plan."""
        return next(iter(self.plans.values())).labels

    @property
    def since(self) -> float:
        """Start of the interval of the metrics [s]."""
        return min(plan.start for plan in self.plans.values()) if self.start is None else float(self.start)

    def identity(self) -> dict[str, object]:
        """Plain data that identify the experiment in a checkpoint."""
        state, measures = self.initial_state, wanted_measures(self.measures)
        return {
            "version of ctrlplan": ctrlplan.__version__,
            "plans": {name: _plan_token(plan) for name, plan in self.plans.items()},
            "timepts": digest(self.timepts),
            "waypoints": [digest([w.time, *w.position]) for w in self.waypoints],
            "start": self.since,
            "band": float(self.band),
            "outputs": list(self.outputs or ()),
            "controls": None if self.controls is None else list(self.controls),
            "initial_state": None if state is None else digest(state),
            "params": {name: _token(value) for name, value in (self.params or {}).items()},
            "events": None if self.events is None else [event.name for event in self.events],
            "measures": list(measures),
        }

    def run(self, loop: System | Builder, done: dict[Prepared, Run] | None = None) -> Measured:
        """Simulate a loop with every plan, and compute the metrics.

        Parameters
        ----------
        loop : control system or callable
            As for `compare`.
        done : dict of Prepared to Run, optional
            As for `run_plan`, if other runs have the same times.

        Returns
        -------
        Measured

        Raises
        ------
        Exception
            The exception of the first plan, if the runs of all plans fail. If
            some fail, the reasons are in `Measured.failures`.
        """
        if not is_builder(loop):
            check_has_inputs(loop)
        with shared_forms():  # loops built for the plans differ in their sources only
            known = {} if done is None else done
            simulated, errors = _each(lambda name: self.simulated(loop, name, done=known), each_plan(list(self.plans)))
            try:
                metrics = dict(zip(simulated, self.metrics_of_runs(list(simulated.values())), strict=True))
            except Exception:  # of some of the plans
                metrics, unmeasured = _each(lambda name: self._metrics(simulated[name]), simulated)
                errors |= unmeasured
        failed = [name for name in self.plans if name in errors]
        if len(failed) == len(self.plans):
            raise errors[failed[0]]
        runs = {name: simulated[name] for name in metrics}
        labels = {name: (*run.outputs, *run.controls) for name, run in runs.items()}
        return Measured(metrics, runs, {name: _reason(errors[name]) for name in failed}, labels=labels)

    def run_plan(self, loop: System | Builder, name: str, params: Params | None = None) -> tuple[Run, dict[str, float]]:
        """Simulate a loop with one of the plans, and compute its metrics.

        Parameters
        ----------
        loop : control system or callable
            As for `compare`.
        name : str
            Name of the plan.
        params : mapping, optional
            Parameters of the loop's blocks in addition to those of the experiment.
        """
        run = self.simulated(loop, name, params)
        return run, self._metrics(run)

    def simulated(
        self, loop: System | Builder, name: str, params: Params | None = None, done: dict[Prepared, Run] | None = None
    ) -> Run:
        """Simulate a loop with one of the plans; arguments as for `run_plan`."""
        plan = self.plans[name]
        merged = self.params if params is None else {**(self.params or {}), **checked_params(params)}
        return run_plan(
            loop,
            name,
            plan,
            self.timepts,
            axes=self.axes,
            last=move_end(plan, self.waypoints),
            outputs=self.outputs,
            controls=self.controls,
            initial_state=self.initial_state,
            params=merged,
            events=self.events,
            done=done,
        )

    def numbers_of(self, loop: System | Builder) -> Linear | None:
        """Numbers of a linear loop, for `run_alike`.

        Returns
        -------
        Linear or None
            None if the loop must be run separately: it is nonlinear, there are
            events or parameters, or a measure of the user.
        """
        if is_builder(loop) or self._held is None:
            return None
        return numbers_of(loop, next(iter(self.plans.values())), self.outputs, self.controls)

    @cached_property
    def _held(self) -> dict[str, Array] | None:
        """First positions of the plans, for the equilibria of linear loops; None if loops cannot be run together."""
        times = self.timepts
        ordered = times.ndim == 1 and times.size > 1 and np.isfinite(times).all() and np.all(np.diff(times) > 0.0)
        if not ordered or self.events or self.params or self.has_own_measures:
            return None
        return {name: plan.jet(times[:1], 0, left=True)[0, :, 0] for name, plan in self.plans.items()}

    def run_alike(
        self, loops: Sequence[System | Linear], samples: NDArray[np.intp] | None = None
    ) -> list[Measured | None] | None:
        """Solve linear loops together with every plan, with the same metrics as `run`.

        Parameters
        ----------
        loops : sequence of control systems or Linear
            Loops of the same structure.
        samples : ndarray of int, shape (nsamples,), optional
            Samples at which outputs and controls are stored; none by default.

        Returns
        -------
        list of Measured or None, or None
            Without runs; None for each loop that must be run separately, as it does
            not start at equilibrium or amplifies rounding errors. None in place of
            the list if one of the loops has no numbers, or another structure.
        """
        numbers = [loop if isinstance(loop, Linear) else self.numbers_of(loop) for loop in loops]
        alike = [loop for loop in numbers if loop is not None]
        held = self._held
        if held is None or not alike or len(alike) < len(numbers) or not all(loop.fits(alike[0]) for loop in alike):
            return None
        duration = float(self.timepts[-1] - self.timepts[0])
        together, usable = Together.of(alike, held, duration, self.initial_state)
        tracked = alike[0].tracked
        acting = alike[0].acting if samples is not None or self._listed("control") else ()
        unstable = together.is_unstable()
        found: list[Metrics] = [{} for _ in usable]
        stored: list[dict[str, dict[str, Array]]] = [{} for _ in usable]
        for name, plan in self.plans.items() if usable.size else ():
            rows = together.outputs((*tracked, *acting), name, plan, self.timepts)
            for i, curves in enumerate(stored) if samples is not None else ():
                curves[name] = dict(zip((*tracked, *acting), rows[i][:, samples], strict=True))
            y, u = np.split(rows, [len(tracked)], axis=1)
            values = self._metrics_of_rows(SignalRecord(self.timepts, y, u, self.axes, acting, unstable), [plan])
            for metrics, own in zip(found, values, strict=True):
                metrics[name] = own
        results: list[Measured | None] = [None] * len(alike)
        for i, metrics, curves in zip(usable, found, stored, strict=True):
            labels = dict.fromkeys(metrics, (*tracked, *alike[0].acting))
            results[i] = Measured(metrics, signals=curves, labels=labels)
        return results

    def metrics_of_runs(self, runs: Sequence[Run]) -> list[dict[str, float]]:
        """Metrics of runs of one loop, with different plans or parameters."""
        if len(runs) < 2 or self.has_own_measures or not self._alike(runs):
            return [self._metrics(run) for run in runs]
        y = np.stack([run.rows(run.outputs) for run in runs])
        u = np.stack([run.rows(run.controls) for run in runs])
        unstable = np.array([run.is_unstable for run in runs])
        held = tuple(run.held_parts for run in runs)
        record = SignalRecord(runs[0].t, y, u, self.axes, runs[0].controls, unstable, held)
        plans = [run.plan for run in runs]
        return self._metrics_of_rows(record, plans if any(plan is not plans[0] for plan in plans) else plans[:1])

    def _alike(self, runs: Sequence[Run]) -> bool:
        """Whether runs have all samples, and the same signals."""
        return bool(np.count_nonzero(self.timepts >= self.since) > 1) and all(
            run.plan.naxes == len(self.axes)
            and run.controls == runs[0].controls
            and np.array_equal(run.t, self.timepts)
            for run in runs
        )

    def _metrics_of_rows(self, record: SignalRecord, plans: Sequence[Trajectory]) -> list[dict[str, float]]:
        """Metrics of each loop of a record, and of the path of its plan; all have the same if one is given."""
        wanted = wanted_measures(self.measures)
        values = signal_metrics(record, plans, self.since, self.band, wanted)
        of_path = [path_metrics(plan, self.waypoints, wanted) for plan in plans]
        each = zip(range(len(record.y)), of_path * (len(record.y) if len(plans) == 1 else 1), strict=True)
        return [{key: float(row[i]) for key, row in values.items()} | own for i, own in each]

    @property
    def has_own_measures(self) -> bool:
        """Whether there are measures of the user, or measures of runs."""
        return any(isinstance(measure, Measure) for measure in self.measures or ()) or self._listed("run")

    def _metrics(self, run: Run) -> dict[str, float]:
        """Metrics of a run, up to its end."""
        return run_metrics(run, wanted_measures(self.measures)) | self.metrics_of_signals(run, self.axes, run.controls)

    def metrics_of_signals(self, run: Run, axes: tuple[str, ...], controls: tuple[str, ...]) -> dict[str, float]:
        """Metrics of responses, controls and path of a run, up to its end.

        Parameters
        ----------
        run : Run
            The run; ``run.outputs`` and ``run.controls`` may be some of those of
            the loop.
        axes : tuple of str
            Axes of the plan that ``run.outputs`` follow.
        controls : tuple of str
            All controls of the loop. Metrics that are a maximum over signals of
            which the run lacks one are omitted.
        """
        wanted = wanted_measures(self.measures)
        values: dict[str, float] = {}
        if np.count_nonzero(run.t >= self.since) >= 2:  # otherwise it ended before the interval of the metrics
            unstable = np.array([run.is_unstable])
            y, u = run.rows(run.outputs)[None], run.rows(run.controls)[None]
            record = SignalRecord(run.t, y, u, axes, run.controls, unstable, (run.held_parts,))
            # Of all axes, which another plan may name otherwise, or of those that a log holds.
            plan = run.plan if len(axes) in (0, run.plan.naxes) else run.plan.select(axes)
            found = signal_metrics(record, [plan], self.since, self.band, wanted)
            for kind, held, every in (("response", axes, self.axes), ("control", run.controls, controls)):
                if len(held) < len(every):
                    found = _of_each(found, [name for name, one in wanted.items() if one.of == kind], held)
            values = {key: float(row[0]) for key, row in found.items()}
        return values | path_metrics(run.plan, self.waypoints, wanted)

    def _listed(self, kind: str) -> bool:
        """Whether there is a measure of a kind."""
        return any(measure.of == kind for measure in wanted_measures(self.measures).values())


def _of_each(found: Mapping[str, Array], names: Sequence[str], held: Sequence[str]) -> dict[str, Array]:
    """Metrics without those over all signals: of the only signal held under its label, of several one each."""
    alone = {name: f"{name}_{held[0]}" for name in names} if len(held) == 1 else {}
    return {alone.get(key, key): row for key, row in found.items() if key in alone or key not in names}


def _each(function: Callable[[str], T], names: Iterable[str]) -> tuple[dict[str, T], dict[str, Exception]]:
    """Results by plan, and the exceptions of the others."""
    results: dict[str, T] = {}
    errors: dict[str, Exception] = {}
    for name in names:
        try:
            results[name] = function(name)
        except Exception as error:  # of the loop with this plan
            errors[name] = error
    return results, errors


def _reason(error: Exception) -> str:
    """Message of an exception in one line, with its type if the message is not one of ours."""
    text = " ".join(str(error).split())
    known = text and isinstance(error, ValueError | TypeError | RuntimeError)
    return text if known else f"{type(error).__name__}: {text}".rstrip(": ")


def _once(values: object) -> object:
    """Values of an iterator as a tuple; any other value unchanged."""
    return values if values is None or isinstance(values, str) or not isinstance(values, Iterable) else tuple(values)


def _check_start(start: float | None, plans: Iterable[Trajectory], times: Array) -> None:
    """Raise if a start is not finite, or leaves fewer than two sample times."""
    since = min(plan.start for plan in plans)
    if start is not None:
        since = _number(start, "start")
        if not math.isfinite(since):
            raise ValueError(f"start must be a finite time [s], got {start!r}")
    usable = times.ndim == 1 and times.size > 1 and np.isfinite(times).all()  # otherwise simulate raises
    if usable and np.count_nonzero(times >= since) < 2:
        end = float(times[-1])
        if start is None:
            raise ValueError(
                f"timepts must extend beyond the start of the plans at {since:g} s, got {end:g} s as the last"
            )
        raise ValueError(f"start must leave at least two of timepts, which end at {time_text(end)} s, got {start!r}")


def _check_band(band: float) -> None:
    """Raise if a settling band is not a finite number above 0."""
    if not 0.0 < _number(band, "band") < math.inf:
        raise ValueError(f"band must be a finite number above 0, relative to the range of the plan, got {band!r}")


def _plan_token(plan: Trajectory) -> str:
    """Labels of a plan, and a hash of its motion and its ends."""
    t = np.linspace(plan.start, plan.end, 101)
    return f"{', '.join(plan.labels)}: {digest([plan.start, plan.end, *plan.initial, *plan.jet(t, 2).ravel()])}"


def _token(value: object) -> str:
    """Value of a parameter if it is a number or an array of numbers, otherwise its type."""
    try:
        return digest(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return type(value).__name__


def _number(value: ArrayLike, name: str) -> float:
    """One real number, without a unit."""
    number = real_array(value, name)
    if number.ndim or isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be a number, got {value!r:.80}")
    return float(number)
