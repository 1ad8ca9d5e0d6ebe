"""Comparisons over many draws of the parameters of a loop."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import real_array
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array, Params
from ctrlplan.simulation import Event, Prepared, SolverError, prepare
from ctrlplan.simulation.built_forms import NotCompiledError
from ctrlplan.simulation.methods.delegated import DELEGATED
from ctrlplan.studies.comparison import Comparison, comparison_of
from ctrlplan.studies.draw_results import DrawResults, Outcome, band_samples
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.executing import (
    Account,
    Executor,
    Failed,
    Shared,
    checked_executor,
    checked_timeout,
    executed,
    tried,
)
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.measures import Measure, shown_measures
from ctrlplan.studies.running import Builder, System, check_has_inputs, is_builder
from ctrlplan.trajectories import Trajectory, Waypoint

Forms: TypeAlias = Mapping[str, System]
"""The loop of each plan."""

Draw: TypeAlias = dict[str, float]
"""Parameters of one draw by name."""

_Task: TypeAlias = tuple[Callable[[Draw], Outcome], "Forms | None"]

_STAND_INS = 20
"""Number of draws tried in place of a nominal loop that does not run."""


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
    progress: bool = True,
    timeout: float | None = None,
) -> Ensemble:
    """Compare plans in a loop for many draws of its parameters.

    Failures and interruptions are treated as in `sweep`: failed draws are
    recorded in `Ensemble.failures`.

    Parameters
    ----------
    loop : control system or callable
        A loop with the drawn parameters in the ``params`` of its blocks; it is
        prepared once for all draws. Or a function whose arguments have the
        names of the draws: it is called with a value of each by keyword and
        returns a loop. Any other callable maps the name of a plan and the plan
        to a loop, as in `compare`, with the parameters in its blocks.
    draws : mapping of str to array_like, shape (ndraws,)
        Values of each parameter, as the function `draws` makes them.
    plans, timepts
        As for `compare`.
    waypoints, start, band, outputs, controls, initial_state, params, events, measures : optional
        As in `Experiment`; a drawn parameter overrides that of `params`.
    units, executor, progress, timeout : optional
        As for `sweep`. Other processes require a loop that can be compiled, or a
        function that the executor can pickle.

    Returns
    -------
    Ensemble

    Raises
    ------
    TypeError
        If `executor` has no ``submit``.
    ValueError
        If the numbers of draws differ, a draw is not finite, or no block reads
        a parameter. An exception of the nominal loop is raised if an argument
        causes it, or if no draw runs.

    Warns
    -----
    UserWarning
        If Ctrl-C ended the runs.

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
    executor, timeout = checked_executor(executor), checked_timeout(timeout)
    table = _checked_draws(draws)
    experiment = Experiment.from_arguments(locals())
    drawn_loop: _Drawn = _Built(loop) if _is_of_draws(loop, table) else _Prepared.of(loop, experiment, table)
    nominal, nominal_draw = _nominal(drawn_loop, experiment, table, units, timeout)
    drawn = [_draw(table, k) for k in range(_count(table))]
    task, again = drawn_loop.task(experiment, drawn, executor is not None, timeout)
    account = executed(task, drawn, executor, timeout, "draws", progress)
    account.raise_if_none_ran("the loop")
    if again is not None:
        account = _by_python(account, again, experiment, drawn, timeout, progress)
    shown = shown_measures(experiment.measures, list(nominal.metrics.values()))
    results = DrawResults(_count(table), experiment.timepts, shown.keys() - nominal.measures.keys())
    for k, outcome in account.in_order().items():
        results.add(k, drawn[k], outcome)
    if account.interrupted:
        text = f"monte_carlo was interrupted: {results.finished} of {_count(table)} draws are returned"
        warnings.warn(text, UserWarning, stacklevel=outside_stacklevel())
    return Ensemble(
        nominal,
        table,
        results.metrics,
        results.timepts,
        results.bands(),
        failures=tuple(results.failures),
        finished=results.finished,
        nominal_draw=nominal_draw,
        interrupted=account.interrupted,
    )


def _checked_draws(draws: Mapping[str, ArrayLike]) -> dict[str, Array]:
    table = {name: np.atleast_1d(real_array(values, f"draws[{name!r}]")) for name, values in draws.items()}
    sizes = {name: values.shape for name, values in table.items()}
    if not table or len(set(sizes.values())) != 1 or any(len(shape) != 1 or not shape[0] for shape in sizes.values()):
        raise ValueError(f"draws must have equally many values of each parameter, at least one, got shapes {sizes}")
    for name, values in table.items():
        if not np.isfinite(values).all():
            raise ValueError(f"draws must be finite, got {values[~np.isfinite(values)][0]} of {name!r}")
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
    if set(table) <= named and _binds(signature, **dict.fromkeys(table, 0.0)):
        return True
    if not _binds(signature, "", None) or set(list(signature.parameters)[:2]) & set(table):
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
    forms: Callable[[str], System | Builder], experiment: Experiment, plans: Iterable[str], params: Params | None
) -> Outcome:
    """Outcome of one draw, by plan."""
    wanted = experiment.timepts[band_samples(experiment.timepts)]

    def measured(plan: str) -> tuple[dict[str, float], dict[str, Array]]:
        form = forms(plan)
        with DELEGATED if isinstance(form, Prepared) and form.network is None else nullcontext():
            run, metrics = experiment.run_plan(form, plan, params)
        stored = np.isin(run.t, wanted)
        names = dict.fromkeys((*run.outputs, *run.controls))
        return metrics, {name: run.signals[name][stored] for name in names}

    return {plan: tried(measured, plan) for plan in plans}


class _Drawn(Protocol):
    """A loop whose parameters are drawn."""

    @property
    def complete(self) -> bool:
        """Whether it can be run without a draw."""

    def nominal(self, params: Draw | None) -> tuple[System | Builder, Draw | None]:
        """Loop for its nominal parameters or those of a draw, and parameters of its blocks."""

    def task(self, experiment: Experiment, drawn: list[Draw], elsewhere: bool, timeout: float | None) -> _Task:
        """Function of a draw, for this process or for others; and forms that run it again if the solver fails."""


@dataclass(frozen=True)
class _Built:
    """A function of the parameters, which builds a loop for each draw."""

    build: Callable[..., System]

    @property
    def complete(self) -> bool:
        return _binds(inspect.signature(self.build))

    def nominal(self, params: Draw | None) -> tuple[System | Builder, Draw | None]:
        return self.build(**(params or {})), None

    def task(self, experiment: Experiment, drawn: list[Draw], elsewhere: bool, timeout: float | None) -> _Task:
        return partial(_of_build, self.build, experiment), None


def _of_build(build: Callable[..., System], experiment: Experiment, params: Draw) -> Outcome:
    loop = build(**params)
    return _outcome(lambda name: loop, experiment, experiment.plans, None)


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
            forms = tried(lambda _: {n: prepare(build(n, plan)) for n, plan in experiment.plans.items()}, None)
            if isinstance(forms, Failed):
                raise forms.error
        else:
            forms = dict.fromkeys(experiment.plans, prepare(check_has_inputs(loop)))
        _check_read(forms, table, experiment.initial_state)
        return cls(loop, forms)

    def nominal(self, params: Draw | None) -> tuple[System | Builder, Draw | None]:
        return (lambda name, plan: self.forms[name]), params

    def task(self, experiment: Experiment, drawn: list[Draw], elsewhere: bool, timeout: float | None) -> _Task:
        # Compiled and compared with Python in this process, for the first draw and a random one.
        here = partial(_of_forms, self.forms, experiment)
        for k in sorted({0, int(np.random.default_rng(0).integers(len(drawn)))}):
            tried(here, drawn[k], timeout)
        light = _light(self.forms, drawn[0])
        again = None if light is None else self.forms
        if not elsewhere:
            return partial(_of_forms, light or self.forms, experiment), again
        sent: Forms | Builder = light or (self.loop if is_builder(self.loop) else self.forms)
        return partial(_elsewhere, Shared(sent), experiment), again


def _of_forms(forms: Forms, experiment: Experiment, params: Draw) -> Outcome:
    return _outcome(lambda name: forms[name], experiment, experiment.plans, params)


def _elsewhere(shared: Shared[Forms | Builder], experiment: Experiment, params: Draw) -> Outcome:
    """Outcome of one draw in another process or thread."""

    def forms(given: Forms | Builder) -> Forms:
        if isinstance(given, Mapping):
            return given
        return {name: prepare(given(name, plan)) for name, plan in experiment.plans.items()}

    return _of_forms(shared.made(forms), experiment, params)


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


def _by_python(
    account: Account[Outcome],
    forms: Forms,
    experiment: Experiment,
    drawn: list[Draw],
    timeout: float | None,
    progress: bool,
) -> Account[Outcome]:
    """Outcomes, with plans and draws for which CVODES failed run again in this process, if necessary in Python."""
    failed = {
        k: [plan for plan, one in outcome.items() if _of_solver(one)]
        for k, outcome in account.in_order().items()
        if not isinstance(outcome, Failed) and any(map(_of_solver, outcome.values()))
    }
    if not failed:
        return account
    found = {k: outcome for k, outcome in account.found.items() if k not in failed}
    if account.interrupted:
        return Account(found, True)

    def run(k: int) -> Outcome:
        return _outcome(lambda name: forms[name], experiment, failed[k], drawn[k])

    again = executed(run, list(failed), None, timeout, "draws by Python", progress)
    for i, outcome in again.found.items():
        k = list(failed)[i]
        known = account.found[k]
        found[k] = known | outcome if isinstance(known, dict) and isinstance(outcome, dict) else outcome
    return Account(found, again.interrupted)


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
