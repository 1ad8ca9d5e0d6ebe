"""One comparison for each of many draws of a loop's parameters."""

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

_STAND_INS = 20
"""Draws of which the first that runs stands for a nominal loop that does not."""


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
    """Compare plans in a loop for each of many draws of its parameters.

    A draw that cannot be run, whose worker process dies, that takes too long,
    or that calls ``sys.exit`` is recorded in `Ensemble.failures` with the
    reason; the others are kept. Ctrl-C ends the runs: what is finished is
    returned with a warning, and tasks that have not begun are cancelled; an
    executor finishes those that have. A second Ctrl-C, or one before the first
    draw, raises KeyboardInterrupt.

    Parameters
    ----------
    loop : control system or callable
        A loop whose blocks read the parameters that are drawn; it is prepared
        once for all draws. Or a function whose parameters are named as the
        draws: it is called with one of each by keyword and returns a loop. Any
        other callable maps a plan's name and the plan to a loop, as in
        `compare`, whose blocks read the parameters.
    draws : mapping of str to array_like, shape (ndraws,)
        Values of each parameter, as the function `draws` makes them.
    plans, timepts
        As for `compare`.
    waypoints, start, band, outputs, controls, initial_state, params, events, measures : optional
        As in `Experiment`; a parameter that is drawn overrides that of `params`.
    units : mapping of str to str, optional
        Units by label, as for `compare`.
    executor : concurrent.futures.Executor or alike, optional
        Where the draws run, as for `sweep`. Other processes need a loop that
        can be compiled, or a function that the executor can send.
    progress : bool, optional
        Show a bar on stderr.
    timeout : float, optional
        Time limit of one draw [s], as for `sweep`.

    Returns
    -------
    Ensemble

    Raises
    ------
    TypeError
        If `executor` has no ``submit``.
    ValueError
        If draws are not as many of each parameter, are not finite, or are of a
        parameter that no block reads. What the nominal loop raises is raised
        where it is an error of the arguments, or where no draw can be run.

    Warns
    -----
    UserWarning
        If Ctrl-C ended it.

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
    experiment = Experiment(
        plans,
        timepts,
        waypoints=waypoints,
        start=start,
        band=band,
        outputs=outputs,
        controls=controls,
        initial_state=initial_state,
        params=params,
        events=events,
        measures=measures,
    )
    drawn_loop: _Drawn = _Built(loop) if _is_of_draws(loop, table) else _Prepared.of(loop, experiment, table)
    nominal, nominal_draw = _nominal(drawn_loop, experiment, table, units, timeout)
    account = drawn_loop.account(experiment, table, executor, timeout, progress)
    shown = shown_measures(experiment.measures, list(nominal.metrics.values()))
    results = DrawResults(_count(table), experiment.timepts, shown.keys() - nominal.measures.keys())
    for k, outcome in account.in_order().items():
        results.add(k, _draw(table, k), outcome)
    if account.interrupted:
        text = f"monte_carlo was interrupted: {results.finished} of {_count(table)} draws are kept"
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
        raise ValueError(f"draws must hold as many values of each parameter, at least one, got shapes {sizes}")
    for name, values in table.items():
        if not np.isfinite(values).all():
            raise ValueError(f"draws must be finite, got {values[~np.isfinite(values)][0]} of {name!r}")
    return table


def _count(table: dict[str, Array]) -> int:
    return next(iter(table.values())).size


def _draw(table: dict[str, Array], k: int) -> dict[str, float]:
    return {name: float(values[k]) for name, values in table.items()}


def _is_of_draws(loop: object, table: dict[str, Array]) -> TypeGuard[Callable[..., System]]:
    """Whether a function takes the draws by keyword; one that takes neither these nor a plan is an error."""
    if not is_builder(loop):
        return False
    try:
        signature = inspect.signature(loop)
    except (TypeError, ValueError):  # of some built-in functions nothing is known
        return False
    named = set(signature.parameters)
    if set(table) <= named and _binds(signature, **dict.fromkeys(table, 0.0)):
        return True
    if not _binds(signature, "", None) or set(list(signature.parameters)[:2]) & set(table):
        raise ValueError(
            "loop must be a control system whose blocks read the parameters, a function whose parameters are named "
            f"as the draws ({', '.join(table)}), or a function of a plan's name and the plan, got {loop!r:.80} with "
            f"the parameters {', '.join(signature.parameters) or 'none'}"
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
    """One draw, plan by plan: one may succeed where another fails."""
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
        """Whether it has parameters of its own."""

    def nominal(self, params: dict[str, float] | None) -> tuple[System | Builder, dict[str, float] | None]:
        """Loop with its own parameters or those of a draw, and parameters for its blocks."""

    def account(
        self,
        experiment: Experiment,
        table: dict[str, Array],
        executor: Executor | None,
        timeout: float | None,
        progress: bool,
    ) -> Account[Outcome]:
        """Outcomes of all draws."""


@dataclass(frozen=True)
class _Built:
    """A function of the parameters, which builds a loop for each draw."""

    build: Callable[..., System]

    @property
    def complete(self) -> bool:
        return _binds(inspect.signature(self.build))

    def nominal(self, params: dict[str, float] | None) -> tuple[System | Builder, dict[str, float] | None]:
        return self.build(**(params or {})), None

    def account(
        self,
        experiment: Experiment,
        table: dict[str, Array],
        executor: Executor | None,
        timeout: float | None,
        progress: bool,
    ) -> Account[Outcome]:
        drawn = [_draw(table, k) for k in range(_count(table))]
        account = executed(partial(_of_build, self.build, experiment), drawn, executor, timeout, "draws", progress)
        account.raise_if_none_ran("the loop")
        return account


def _of_build(build: Callable[..., System], experiment: Experiment, params: dict[str, float]) -> Outcome:
    loop = build(**params)
    return _outcome(lambda name: loop, experiment, experiment.plans, None)


@dataclass(frozen=True)
class _Prepared:
    """A loop that is prepared once, and whose blocks read the parameters.

    Attributes
    ----------
    loop : control system or callable
        As it was given.
    forms : dict of str to Prepared
        Its form by plan: one for all, or one of each loop that a function builds.
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

    def nominal(self, params: dict[str, float] | None) -> tuple[System | Builder, dict[str, float] | None]:
        return (lambda name, plan: self.forms[name]), params

    def account(
        self,
        experiment: Experiment,
        table: dict[str, Array],
        executor: Executor | None,
        timeout: float | None,
        progress: bool,
    ) -> Account[Outcome]:
        drawn = [_draw(table, k) for k in range(_count(table))]
        # Compiled for these parameters, and compared with Python, here: the first draw, and a random one.
        here = partial(_of_forms, self.forms, experiment)
        for k in sorted({0, int(np.random.default_rng(0).integers(len(drawn)))}):
            tried(here, drawn[k], timeout)
        light = _light(self.forms, table)
        sent: Forms | Builder = self.forms if light is None else light
        if light is None and is_builder(self.loop):
            sent = self.loop
        run = partial(_of_forms, light or self.forms, experiment)
        if executor is not None:
            run = partial(_elsewhere, Shared(sent), experiment)
        account = executed(run, drawn, executor, timeout, "draws", progress)
        account.raise_if_none_ran("the loop")
        return account if light is None else _by_python(account, self.forms, experiment, drawn, timeout, progress)


def _of_forms(forms: Forms, experiment: Experiment, params: dict[str, float]) -> Outcome:
    return _outcome(lambda name: forms[name], experiment, experiment.plans, params)


def _elsewhere(shared: Shared[Forms | Builder], experiment: Experiment, params: dict[str, float]) -> Outcome:
    """One draw, in another process or thread."""

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
    """The loop with its own parameters; or, where that does not run, with those of the first draw that does."""

    def compared(params: dict[str, float] | None) -> Comparison:
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
    why = "the loop's own parameters do not run" if own is not None else "the loop has no parameters of its own"
    for k in range(min(_STAND_INS, _count(table))):
        params = _draw(table, k)
        found = tried(compared, params, timeout)
        if not isinstance(found, Failed):
            values = ", ".join(f"{name} = {value:.4g}" for name, value in params.items())
            return replace(found, notes=(*found.notes, f"Nominal is draw {k} ({values}): {why}.")), k
        own = own or found
    assert own is not None  # noqa: S101 (there is a draw, and it failed)
    own.error.add_note("with the loop's own parameters, and with the first draws")
    raise own.error


def _by_python(
    account: Account[Outcome],
    forms: Forms,
    experiment: Experiment,
    drawn: list[dict[str, float]],
    timeout: float | None,
    progress: bool,
) -> Account[Outcome]:
    """Plans and draws with which CVODES failed, run again by the loop itself in this process, in Python if need be."""
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
    """Reject a parameter that no block has or reads."""
    for name, values in table.items():

        def reads(form: Prepared, name: str = name, value: float = float(values[0])) -> bool:
            return form.reads(name, value, start)

        found = [tried(reads, form) for form in forms.values()]
        if any(isinstance(one, Failed) or one for one in found):  # what ends in an error of a block may be its own
            continue
        form = next(iter(forms.values()))
        way = (
            f"{form.name} is linear, and its matrices have no parameters: give a function of {', '.join(table)} that "
            "returns a loop in its place"
            if form.linear is not None
            else "a linear block has none, and others have those of python-control's params="
        )
        raise ValueError(f"draws must be of parameters of a block, got {name!r}, which none reads; {way}")


def _light(forms: Mapping[str, Prepared], table: dict[str, Array]) -> dict[str, Prepared] | None:
    """Forms without python-control's blocks, for many runs and for other processes; None where there are none."""
    try:
        return {name: form.detached(table) for name, form in forms.items()}
    except TypeError:
        return None


def _of_solver(outcome: object) -> bool:
    return isinstance(outcome, Failed) and isinstance(outcome.error, SolverError | NotCompiledError)
