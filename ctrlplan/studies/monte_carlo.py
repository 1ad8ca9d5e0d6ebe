"""Comparisons over many draws of the parameters of a loop."""

from __future__ import annotations

import inspect
import os
import threading
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import array_of_numbers, check_kind
from ctrlplan._lru import Lru
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array, Params
from ctrlplan.simulation import Event, Prepared, SolverError, prepare
from ctrlplan.simulation.built_forms import NotCompiledError
from ctrlplan.simulation.methods.delegated import DELEGATED
from ctrlplan.studies.alike import Linear
from ctrlplan.studies.batches import FIRST, FIRST_OF_TASK, Batches
from ctrlplan.studies.checkpoint import digest
from ctrlplan.studies.comparison import Comparison, comparison_of
from ctrlplan.studies.draw_results import DrawResults, Outcome, band_samples
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.executing import Execution, executed
from ctrlplan.studies.executors import Executor
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.measured_together import MeasuredTogether
from ctrlplan.studies.measures import Measure, Run, shown_measures
from ctrlplan.studies.outcomes import Failed, OneByOne, Runs, tried
from ctrlplan.studies.running import Builder, System, check_has_inputs, check_has_outputs, check_returned, is_builder
from ctrlplan.trajectories import Trajectory, Waypoint

Forms: TypeAlias = Mapping[str, System]
"""The loop of each plan."""

Draw: TypeAlias = dict[str, float]
"""Parameters of one draw by name."""

Samples: TypeAlias = NDArray[np.intp]
"""Indices of the samples of the bands."""

_STAND_INS = 20
"""Number of draws tried in place of a nominal loop that does not run."""

_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
"""Kinds of arguments that can be given by position."""

_THREADS = 32
"""Number of threads for which the loops of a function are prepared separately."""


def monte_carlo(
    loop: System | Builder | Callable[..., System],
    draws: Mapping[str, ArrayLike],
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
    units: Mapping[str, str] | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    chunk: int | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = True,
    timeout: float | None = None,
) -> Ensemble:
    """Compare plans in a loop for many draws of its parameters.

    Failures, interruptions and executors are treated as in `sweep`: failed draws
    are recorded in `Ensemble.failures`.

    Parameters
    ----------
    loop : control system or callable
        A loop with the drawn parameters in the ``params`` of its blocks; it is
        prepared once for all draws. Or a function whose arguments have the
        names of the draws, or which takes any keyword: it is called with a value
        of each by keyword and returns a loop; linear loops of the same structure
        are solved together in closed form. Any other callable maps the name of a
        plan and the plan to a loop, as in `compare`, with the parameters in its
        blocks.
    draws : mapping of str to array_like, shape (ndraws,)
        Values of each parameter, as the function `draws` makes them.
    plans, timepts
        As for `compare`.
    waypoints, start, band, outputs, controls, initial_state, params, events, measures : optional
        As in `Experiment`; a drawn parameter overrides that of `params`.
    units, executor, workers, chunk, checkpoint, progress, timeout : optional
        As for `sweep`. Other processes require a loop that can be compiled, or a
        function that the executor can pickle. A checkpoint of a loop with other
        nominal metrics is rejected.

    Returns
    -------
    Ensemble
        The bands have at most 1001 times, fewer for very many draws or signals.

    Raises
    ------
    TypeError
        If `executor` has no ``submit``, or `draws` is no mapping.
    RuntimeError
        If a worker has other versions of ctrlplan or casadi.
    ValueError
        If the numbers of draws differ, a draw is not finite, no block reads a
        parameter, a function returns loops with different outputs, the loop
        cannot be sent to other processes, or the checkpoint is that of another
        study. An exception of the nominal loop is raised if an argument causes
        it, or if no draw runs.
    OSError
        If the folder of the checkpoint cannot be made, read or written to.

    Warns
    -----
    UserWarning
        If Ctrl-C ended the runs; or if finished draws cannot be written to the
        checkpoint, see `sweep`.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> gains = cp.draws(5, seed=1, gain=(50, 200))
    >>> found = cp.monte_carlo(
    ...     cp.plants.integrator_lag_loop, gains, {"step": cp.Step(1.0)}, np.linspace(0, 10, 1001), progress=False
    ... )
    >>> bool((found.metrics["step"]["overshoot_error"] > 80.0).all())
    True
    """
    execution = Execution.from_arguments(locals())
    table = _checked_draws(draws)
    experiment = Experiment.from_arguments(locals())
    drawn_loop: _Drawn = _Built(loop) if _is_of_draws(loop, table) else _Prepared.of(loop, experiment, table)
    nominal, nominal_draw = _nominal(drawn_loop, experiment, table, units, timeout)
    drawn = [_draw(table, k) for k in range(_count(table))]
    curves = len(experiment.plans) * len({*nominal.outputs, *nominal.controls})
    samples = band_samples(experiment.timepts, len(drawn), curves)
    runs, again = drawn_loop.runs(experiment, samples, drawn, executor is not None, timeout)
    shown = shown_measures(experiment.measures, list(nominal.metrics.values()))
    results = DrawResults(len(drawn), experiment.timepts[samples], shown.keys() - nominal.measures.keys())
    collected = _Collected(drawn, results, again is not None)

    def identity() -> dict[str, object]:
        own = {"kind": "monte_carlo", "draws": {name: digest(values) for name, values in table.items()}}
        return own | {"loop": nominal.metrics, "units": dict(units or {})} | experiment.identity()

    done = executed(runs, drawn, collected.add, execution, "draws", identity)
    done.raise_if_none_ran("the loop")
    interrupted = done.interrupted
    if again is not None and collected.aside and not interrupted:
        here = replace(execution, executor=None, workers=None, checkpoint=None)
        interrupted = collected.run_again(partial(_outcome, again, experiment, samples), here)
    if interrupted:
        text = f"monte_carlo was interrupted: {results.finished} of {_count(table)} draws are returned"
        warnings.warn(text, UserWarning, stacklevel=outside_stacklevel())
    return Ensemble(
        nominal,
        table,
        results.metrics({plan: nominal.metrics.get(plan, {}) for plan in experiment.plans}),
        results.timepts,
        results.bands(experiment.plans),
        failures=results.failures(),
        finished=results.finished,
        nominal_draw=nominal_draw,
        interrupted=interrupted,
        sent_again=done.sent_again,
        missing=tuple(sorted({*done.missing, *collected.aside})),
    )


def _checked_draws(draws: Mapping[str, ArrayLike]) -> dict[str, Array]:
    check_kind(draws, "draws", Mapping, "a mapping of names to values, as the function draws returns it")
    for name in draws:
        if not isinstance(name, str):
            raise TypeError(f"draws must have names of parameters as keys, got {name!r}")
    table = {name: np.atleast_1d(array_of_numbers(values, f"draws[{name!r}]")) for name, values in draws.items()}
    sizes = {name: values.shape for name, values in table.items()}
    if not table or len(set(sizes.values())) != 1 or any(len(shape) != 1 or not shape[0] for shape in sizes.values()):
        raise ValueError(f"draws must have equally many values of each parameter, at least one, got shapes {sizes}")
    for name, values in table.items():
        lacking = np.flatnonzero(~np.isfinite(values))
        if lacking.size:
            rest = f"; {lacking.size} of {values.size} draws have no value of it" if lacking.size > 1 else ""
            raise ValueError(f"draws must be finite, got draws[{name!r}][{lacking[0]}] = {values[lacking[0]]}{rest}")
    return table


def _count(table: dict[str, Array]) -> int:
    return next(iter(table.values())).size


def _draw(table: dict[str, Array], k: int) -> Draw:
    return {name: float(values[k]) for name, values in table.items()}


def _is_of_draws(loop: object, table: dict[str, Array]) -> TypeGuard[Callable[..., System]]:
    """Whether a function takes the draws by keyword; ValueError if it takes neither these nor a plan."""
    if not is_builder(loop):
        return False
    try:
        signature = inspect.signature(loop)
    except (TypeError, ValueError):  # of some built-in functions
        return False
    named = set(signature.parameters)
    further = {one.kind for name, one in signature.parameters.items() if name not in table}
    takes_any = inspect.Parameter.VAR_KEYWORD in further  # **values, or a wrapper's *arguments, **values
    takes_any &= further <= {inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD}
    if (set(table) <= named or takes_any) and _binds(signature, **dict.fromkeys(table, 0.0)):
        return True
    first = list(signature.parameters)[:2]
    required = [one for one in signature.parameters.values() if one.kind in _POSITIONAL and one.default is one.empty]
    of_plan = (len(required) == 2 or first == ["name", "plan"]) and _binds(signature, "", None)
    if not of_plan or set(first) & set(table):
        raise ValueError(
            "loop must be a control system whose blocks read the parameters, a function whose arguments have the names "
            f"of the draws ({', '.join(table)}), or a function of a plan's name and the plan, got {loop!r:.80} with "
            f"the arguments {', '.join(signature.parameters) or 'none'}"
        )
    return False


def _binds(signature: inspect.Signature, *arguments: object, **named: object) -> bool:
    try:
        signature.bind(*arguments, **named)
    except TypeError:
        return False
    return True


def _outcome(
    forms: Mapping[str, System | Builder],
    experiment: Experiment,
    samples: Samples,
    plans: Iterable[str],
    params: Params | None,
) -> Outcome:
    """Outcome of one draw, by plan."""

    def measured(plan: str) -> tuple[dict[str, float], dict[str, Array]]:
        run = _run(forms[plan], experiment, plan, params)
        (metrics,) = experiment.metrics_of_runs([run])
        return metrics, _curves(experiment, samples, run)

    return {plan: tried(measured, plan) for plan in plans}


def _run(form: System | Builder, experiment: Experiment, plan: str, params: Params | None) -> Run:
    with DELEGATED if isinstance(form, Prepared) and form.network is None else nullcontext():
        return experiment.simulated(form, plan, params)


def _curves(experiment: Experiment, samples: Samples, run: Run) -> dict[str, Array]:
    """Outputs and controls of a run at the samples of the bands."""
    stored = np.isin(run.t, experiment.timepts[samples])
    return {name: run.signals[name][stored] for name in dict.fromkeys((*run.outputs, *run.controls))}


@dataclass(frozen=True)
class _Collected:
    """Outcomes of draws as they arrive.

    Attributes
    ----------
    drawn : list of dict
        The draws.
    results : DrawResults
        Results of all draws.
    compiled : bool
        Whether draws whose solver failed are to be run again by another method.
    aside : dict of int to Outcome
        Outcomes of these draws.
    """

    drawn: list[Draw]
    results: DrawResults
    compiled: bool
    aside: dict[int, Outcome] = field(default_factory=dict)

    def add(self, k: int, outcome: Outcome | Failed) -> None:
        """Add the outcome of a draw."""
        if self.compiled and not isinstance(outcome, Failed) and any(map(_of_solver, outcome.values())):
            self.aside[k] = outcome
        else:
            self.results.add(k, self.drawn[k], outcome)

    def run_again(self, run: Callable[[Iterable[str], Draw], Outcome], execution: Execution) -> bool:
        """Run plans for which CVODES failed in this process, if necessary in Python; return whether interrupted."""
        numbers = sorted(self.aside)

        def again(k: int) -> Outcome:
            return run([plan for plan, one in self.aside[k].items() if _of_solver(one)], self.drawn[k])

        def collect(i: int, outcome: Outcome | Failed) -> None:
            known = self.aside.pop(numbers[i])
            whole = outcome if isinstance(outcome, Failed) else known | outcome
            self.results.add(numbers[i], self.drawn[numbers[i]], whole)

        return executed(OneByOne(again), numbers, collect, execution, "draws by Python").interrupted


class _Drawn(Protocol):
    """A loop whose parameters are drawn."""

    @property
    def complete(self) -> bool:
        """Whether it can be run without a draw."""

    def nominal(self, params: Draw | None) -> tuple[System | Builder, Draw | None]:
        """Loop for its nominal parameters or those of a draw, and parameters of its blocks."""

    def runs(
        self, experiment: Experiment, samples: Samples, drawn: list[Draw], elsewhere: bool, timeout: float | None
    ) -> tuple[Runs[Draw, Outcome], Forms | None]:
        """Runs of the draws, for this process or for others; and forms that run them again if the solver fails."""


@dataclass(frozen=True)
class _Built:
    """A function of the parameters, which builds a loop for each draw."""

    build: Callable[..., System]

    @property
    def complete(self) -> bool:
        return _binds(inspect.signature(self.build))

    def nominal(self, params: Draw | None) -> tuple[System | Builder, Draw | None]:
        return check_returned(self.build(**(params or {}))), None

    def runs(
        self, experiment: Experiment, samples: Samples, drawn: list[Draw], elsewhere: bool, timeout: float | None
    ) -> tuple[Runs[Draw, Outcome], Forms | None]:
        build, alone = partial(_with_draw, self.build), partial(_of_loop, experiment, samples)
        first = FIRST_OF_TASK if elsewhere else FIRST
        return Batches(experiment, build, alone, partial(_alike, experiment, samples), first), None


def _with_draw(build: Callable[..., System], params: Draw) -> System | Builder:
    return check_returned(build(**params))


def _of_loop(experiment: Experiment, samples: Samples, loop: System | Builder) -> Outcome:
    return _outcome(dict.fromkeys(experiment.plans, loop), experiment, samples, experiment.plans, None)


def _alike(experiment: Experiment, samples: Samples, loops: Sequence[Linear]) -> list[Outcome | None]:
    """Outcomes of linear loops of the same structure; None for those that must be run separately."""
    found = experiment.run_alike(loops, samples) or ()
    return [
        None if one is None else {plan: (metrics, one.signals[plan]) for plan, metrics in one.metrics.items()}
        for one in found
    ]


@dataclass(frozen=True)
class _Prepared:
    """A loop that is prepared once, with the parameters in its blocks.

    Attributes
    ----------
    loop : control system or callable
        The loop as given.
    forms : dict of str to Prepared
        Prepared loop by plan: the same for all, or one for each loop of a function.
    """

    loop: System | Builder
    forms: dict[str, Prepared]
    complete = True

    @classmethod
    def of(cls, loop: System | Builder, experiment: Experiment, table: dict[str, Array]) -> _Prepared:
        """Prepare a loop, and check that its blocks read the parameters."""
        if is_builder(loop):
            build = loop
            forms = tried(lambda _: _forms_of(build, experiment.plans), None)
            if isinstance(forms, Failed):
                raise forms.error
        else:
            forms = dict.fromkeys(experiment.plans, prepare(check_has_inputs(loop)))
        _check_read(forms, table, experiment.initial_state)
        return cls(loop, forms)

    def nominal(self, params: Draw | None) -> tuple[System | Builder, Draw | None]:
        return (lambda name, plan: self.forms[name]), params

    def runs(
        self, experiment: Experiment, samples: Samples, drawn: list[Draw], elsewhere: bool, timeout: float | None
    ) -> tuple[Runs[Draw, Outcome], Forms | None]:
        # Compiled and compared with Python in this process, for the first draw and a random one.
        here = partial(_of_forms, self.forms, experiment, samples)
        for k in sorted({0, int(np.random.default_rng(0).integers(len(drawn)))}):
            tried(here, drawn[k], timeout)
        light = _light(self.forms, drawn[0])
        again = None if light is None else self.forms
        if not elsewhere:
            return _draws_of(light or self.forms, experiment, samples), again
        sent = _Sent(light or (self.loop if is_builder(self.loop) else self.forms))
        return OneByOne(partial(_elsewhere, sent, experiment, samples)), again


def _draws_of(forms: Forms, experiment: Experiment, samples: Samples) -> Runs[Draw, Outcome]:
    """Runs of draws in this process."""
    if experiment.has_own_measures:
        return OneByOne(partial(_of_forms, forms, experiment, samples))
    return MeasuredTogether(experiment, partial(_runs_of, forms, experiment), partial(_curves, experiment, samples))


def _runs_of(forms: Forms, experiment: Experiment, params: Draw) -> dict[str, Run | Failed]:
    return {plan: tried(lambda name: _run(forms[name], experiment, name, params), plan) for plan in experiment.plans}


def _of_forms(forms: Forms, experiment: Experiment, samples: Samples, params: Draw) -> Outcome:
    return _outcome(forms, experiment, samples, experiment.plans, params)


@dataclass(frozen=True)
class _Sent:
    """Loops for other processes and threads: prepared forms, or a function that builds them."""

    given: Forms | Builder
    made: Lru[int, Forms] = field(default_factory=lambda: Lru(_THREADS))

    def forms(self, plans: Mapping[str, Trajectory]) -> Forms:
        """Forms for this thread."""
        if isinstance(self.given, Mapping):
            return self.given
        build = self.given
        return self.made.get(threading.get_ident(), lambda: _forms_of(build, plans))


def _forms_of(build: Builder, plans: Mapping[str, Trajectory]) -> dict[str, Prepared]:
    """Prepared loop of each plan, from a function of its name and the plan."""
    return {name: prepare(check_has_outputs(build(name, plan))) for name, plan in plans.items()}


def _elsewhere(sent: _Sent, experiment: Experiment, samples: Samples, params: Draw) -> Outcome:
    """Outcome of one draw in another process or thread."""
    return _of_forms(sent.forms(experiment.plans), experiment, samples, params)


def _nominal(
    loop: _Drawn,
    experiment: Experiment,
    table: dict[str, Array],
    units: Mapping[str, str] | None,
    timeout: float | None,
) -> tuple[Comparison, int | None]:
    """Comparison at the nominal parameters or, if these do not run, at those of the first draw that does."""

    def compared(params: Draw | None) -> Comparison:
        form, of_blocks = loop.nominal(params)
        own = (
            experiment if of_blocks is None else replace(experiment, params={**(experiment.params or {}), **of_blocks})
        )
        return replace(comparison_of(own, own.run(form).whole(), units), experiment=experiment)

    own = tried(compared, None, timeout) if loop.complete else None
    if own is not None and not isinstance(own, Failed):
        return own, None
    if own is not None and not isinstance(own.error, ArithmeticError | RuntimeError | TypeError | KeyError):
        raise own.error
    why = (
        "the loop does not run with its nominal parameters"
        if own is not None
        else "the loop has no nominal parameters (default values of its function)"
    )
    for k in range(min(_STAND_INS, _count(table))):
        params = _draw(table, k)
        found = tried(compared, params, timeout)
        if not isinstance(found, Failed):
            values = ", ".join(f"{name} = {value:.4g}" for name, value in params.items())
            return replace(found, notes=(*found.notes, f"The nominal loop is draw {k} ({values}), because {why}.")), k
        own = own or found
    assert own is not None  # noqa: S101 (there is a draw, and it failed)
    own.error.add_note("with the nominal parameters of the loop, and with the first draws")
    raise own.error


def _check_read(forms: Mapping[str, Prepared], table: dict[str, Array], start: ArrayLike | None) -> None:
    """Raise if a parameter is not read by any block."""
    for name, values in table.items():

        def reads(form: Prepared, name: str = name, value: float = float(values[0])) -> bool:
            return form.reads(name, value, start)

        found = [tried(reads, form) for form in forms.values()]
        if any(isinstance(one, Failed) or one for one in found):  # an error in a block is reported by its run
            continue
        form = next(iter(forms.values()))
        way = (
            f"{form.name} is linear, with constant matrices; give a function of {', '.join(table)} that returns a loop "
            "in its place"
            if form.linear is not None
            else "linear blocks have no parameters; those of nonlinear blocks are given by params= of python-control"
        )
        raise ValueError(f"draws must be of parameters of a block, got {name!r}, which no block reads; {way}")


def _light(forms: Mapping[str, Prepared], params: Collection[str]) -> dict[str, Prepared] | None:
    """Forms without python-control's blocks, for many runs and for other processes; None if there are none."""
    try:
        return {name: form.detached(params) for name, form in forms.items()}
    except TypeError:
        return None


def _of_solver(outcome: object) -> bool:
    return isinstance(outcome, Failed) and isinstance(outcome.error, SolverError | NotCompiledError)
