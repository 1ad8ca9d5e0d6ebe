"""One comparison for each of many draws of a loop's parameters."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import real_array
from ctrlplan.simulation import Prepared, SolverError, prepare
from ctrlplan.simulation.learned import NotCompiledError
from ctrlplan.simulation.methods.delegated import DELEGATED
from ctrlplan.studies.comparison import (
    Comparison,
    all_run,
    check_has_inputs,
    compare,
    finite_or_none,
    is_builder,
    references_of,
    tracked_outputs,
    waypoints_given,
)
from ctrlplan.studies.executing import Account, Failed, Shared, checked_executor, executed, tried
from ctrlplan.trajectories import Trajectory, Waypoint

if TYPE_CHECKING:
    import pandas as pd
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike

Array = NDArray[np.float64]
Distribution = Any
"""Two numbers, the ends of a uniform distribution, or whatever has scipy's ``rvs``."""

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)

_STAND_INS = 20
"""Draws of which the first that runs stands for a nominal loop that does not."""

_SAMPLES = 1001
"""Times at which bands are kept, at most."""


@dataclass(frozen=True)
class Failure:
    """A draw that could not be run, or a value.

    Attributes
    ----------
    draw : int
        Which; of a sweep over values, the index of the value.
    params : dict of str to float
        Its parameters.
    message : str
        What went wrong: what was raised, or how it was lost.
    plan : str
        With which plan; empty where with all.
    """

    draw: int
    params: dict[str, float]
    message: str
    plan: str = ""


@dataclass(frozen=True, repr=False)
class Ensemble:
    """What plans made of a loop over draws of its parameters; made by `sweep` with ``params``.

    Attributes
    ----------
    nominal : Comparison
        The loop with its own parameters.
    params : dict of str to ndarray, shape (ndraws,)
        The draws.
    metrics : dict of str to dict of str to ndarray, shape (ndraws,)
        Plan, metric; nan where a draw failed or was not reached.
    timepts : ndarray, shape (ntime,)
        Times of the bands [s].
    bands : dict of str to dict of str to ndarray, shape (nlevels, ntime)
        Plan, signal: quantiles over the draws, at `levels`.
    levels : tuple of float
        Of the quantiles.
    failures : tuple of Failure
        Draws that could not be run, with their parameters.
    finished : int
        Draws run or failed; fewer than asked for where the run was interrupted.
    nominal_draw : int or None
        The draw that stands for the nominal loop, where its own parameters do not run.
    interrupted : bool
        Whether Ctrl-C ended the run.
    """

    nominal: Comparison
    params: dict[str, Array]
    metrics: dict[str, dict[str, Array]]
    timepts: Array
    bands: dict[str, dict[str, Array]]
    levels: tuple[float, ...] = LEVELS
    failures: tuple[Failure, ...] = ()
    finished: int = 0
    nominal_draw: int | None = None
    interrupted: bool = False

    def __repr__(self) -> str:
        return (
            f"<Ensemble of {', '.join(self.nominal.plans)} over {self.finished} draws of {', '.join(self.params)}; "
            f"{len(self.failures)} failures>"
        )

    @property
    def ndraws(self) -> int:
        """Draws asked for."""
        return next(iter(self.params.values())).size

    def quantiles(self, name: str) -> dict[str, Array]:
        """Quantiles at `levels` of a metric, by plan; draws that failed do not count."""
        found = {}
        for plan, rows in self.metrics.items():
            values = rows.get(name, np.empty(0))
            known = values[~np.isnan(values)]
            nothing = np.full(len(self.levels), np.nan)
            found[plan] = np.quantile(known, self.levels, method="inverted_cdf") if known.size else nothing
        return found

    def to_pandas(self) -> pd.DataFrame:
        """Table of one row a draw; columns the parameters, then plan and metric."""
        import pandas as pd

        columns = {("params", name): values for name, values in self.params.items()}
        columns |= {(plan, name): row for plan, rows in self.metrics.items() for name, row in rows.items()}
        return pd.DataFrame(columns).rename_axis(index="draw", columns=["plan", "metric"])

    def results(self) -> dict[str, Any]:
        """Plain data for JSON: draws, metrics, failures; null where infinite or undefined."""
        return {
            "params": {name: values.tolist() for name, values in self.params.items()},
            "finished": self.finished,
            "plans": {
                plan: {name: [finite_or_none(value) for value in row.tolist()] for name, row in rows.items()}
                for plan, rows in self.metrics.items()
            },
            "failures": [
                {"draw": f.draw, "params": f.params, "message": f.message, "plan": f.plan} for f in self.failures
            ],
        }

    def plot(self, *, ax: AxesLike | None = None) -> ControlPlot:
        """Bands of outputs, errors and controls over time.

        Parameters
        ----------
        ax : array of Axes, shape (2 noutputs + ncontrols, nplans), optional
            Where to draw: a column for each plan, a row for each output, its
            error and each control. None: an empty current figure, or a new one.

        Returns
        -------
        control.ControlPlot
            Of the shape of `ax`.
        """
        from ctrlplan.reports.figures import plot_bands

        return plot_bands(self, ax=ax)

    def report(self, path: str | os.PathLike[str], title: str = "Spread over draws") -> Path:
        """Write one self-contained HTML page and return its path.

        Parameters
        ----------
        path : str or path
            The file, or a folder for ``index.html`` in it.
        title : str, optional
            Heading.
        """
        from ctrlplan.reports import write_page
        from ctrlplan.studies.study import Study

        notes = (*self.nominal.notes, *self.notes())
        study = Study("draws", title, self.nominal, notes=notes, figures=("bands", "responses"), ensemble=self)
        return write_page([study], path, title=title)

    def notes(self) -> Iterator[str]:
        """What a reader must know of the draws."""
        ranges = ", ".join(f"{k} {v.min():.4g} to {v.max():.4g}" for k, v in self.params.items())
        whose = "the loop's own parameters" if self.nominal_draw is None else f"draw {self.nominal_draw}"
        yield f"{self.finished} draws of {ranges}; the responses below are those of {whose}."
        if self.finished < self.ndraws:
            yield f"The run was interrupted: {self.ndraws - self.finished} draws were not reached."
        if self.failures:
            first = self.failures[0]
            where = ", ".join(f"{key} = {value:.4g}" for key, value in first.params.items())
            with_plan = f" and the plan {first.plan}" if first.plan else ""
            count = len({failure.draw for failure in self.failures})
            yield f"{count} draws failed; the first, with {where}{with_plan}: {first.message}"
            yield "A draw that failed is in no band and no quantile."
        yield from self._wins()

    def best(self, name: str) -> dict[str, float]:
        """Share of the draws, of those in which a plan has the metric, in which it is the best; ties count for each."""
        rows = {plan: found[name] for plan, found in self.metrics.items() if name in found}
        table = np.array(list(rows.values()))
        with np.errstate(invalid="ignore"):
            least = np.fmin.reduce(table)
            won = table <= least + 1e-3 * np.abs(least)
        known = ~np.isnan(least)
        return {plan: float(row[known].mean()) if known.any() else np.nan for plan, row in zip(rows, won, strict=True)}

    def _wins(self) -> Iterator[str]:
        plans = list(self.metrics)
        names = dict.fromkeys(name for found in self.metrics.values() for name in found)
        if len(plans) < 2:
            return
        for name in list(names)[:3]:
            shares = self.best(name)
            title = self.nominal.measures[name].title.lower() if name in self.nominal.measures else name
            yield (
                f"Best in {title}: "
                + ", ".join(f"{p} in {100 * s:.0f} % of the draws" for p, s in shares.items())
                + "."
            )


def draws(count: int, seed: int = 0, **distributions: Distribution) -> dict[str, Array]:
    """Random parameters, the same for the same seed.

    Parameters
    ----------
    count : int
        Number of draws.
    seed : int, optional
        Of the generator; each parameter has a stream of its own, so that
        another parameter changes none of the others.
    **distributions
        By the parameter's name: (low, high) of a uniform distribution, or a
        frozen distribution of `scipy.stats`.

    Returns
    -------
    dict of str to ndarray, shape (count,)
        For the ``params`` of `sweep`.

    Raises
    ------
    ValueError
        If `count` is not above 0, or low is above high.
    TypeError
        If something is no distribution.

    Examples
    --------
    >>> found = draws(3, seed=1, load_mass=(400.0, 600.0))
    >>> bool(400.0 <= found["load_mass"].min() <= found["load_mass"].max() <= 600.0)
    True
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ValueError(f"count must be a whole number from 1, got {count!r}")
    found = {}
    for name, distribution in distributions.items():
        rng = np.random.default_rng([seed, *name.encode()])
        if hasattr(distribution, "rvs"):
            values = distribution.rvs(size=count, random_state=rng)
        elif np.shape(distribution) == (2,):
            low, high = (float(end) for end in distribution)
            if not -np.inf < low <= high < np.inf:
                raise ValueError(f"{name} must be drawn from low to high, both finite, got {low} and {high}")
            values = rng.uniform(low, high, count)
        else:
            raise TypeError(f"{name} must be (low, high) or a distribution of scipy.stats, got {distribution!r}")
        found[name] = np.asarray(values, dtype=float)
    return found


def ensemble(
    loop: Any,
    plans: Mapping[str, Trajectory] | Iterable[Waypoint],
    timepts: ArrayLike,
    params: Mapping[str, ArrayLike],
    executor: Any = None,
    progress: bool = True,
    options: Mapping[str, Any] | None = None,
    timeout: float | None = None,
) -> Ensemble:
    """Compare plans in a loop for each draw of its parameters; see `sweep`."""
    checked_executor(executor)
    table, times = _checked_draws(params), real_array(timepts, "timepts")
    settings = dict(options or {})
    points = settings.pop("waypoints", ())
    if not isinstance(plans, Mapping):
        plans = points = waypoints_given(plans)
    references = references_of(plans, settings.pop("alpha", 1.0))
    if settings.get("start") is None:
        settings["start"] = min(plan.start for plan in references.values())
    forms = _forms(loop, references, table)
    _check_read(forms, table, settings.get("initial_state"))
    nominal, nominal_draw = _nominal(forms, references, times, table, {"waypoints": points, **settings}, timeout)
    first = next(iter(references.values()))
    outputs = {name: tracked_outputs(form, settings.get("outputs"), first) for name, form in forms.items()}
    settings = {"events": (), **settings, "worth": False, "outputs": outputs}
    drawn = [_draw(table, k) for k in range(next(iter(table.values())).size)]
    # Compiled for these parameters, and compared with Python, here: the first draw, and a random one.
    for k in sorted({0, int(np.random.default_rng(0).integers(len(drawn)))}):
        tried(partial(_one, forms, references, times, settings), drawn[k], timeout)
    light: Any = _light(forms, table)
    if light is None:
        light = loop if is_builder(loop) and executor is not None else forms
    run = partial(_one, light, references, times, settings)
    if executor is not None:
        run = partial(_elsewhere, Shared(light), references, times, settings)
    account = executed(run, drawn, executor, timeout, "draws", progress)
    account.raise_if_all_lost("the loop")
    if light is not forms and light is not loop:

        def by_python(some: dict[str, Trajectory], params: dict[str, float]) -> Outcome:
            return _one(forms, some, times, settings, params)

        account = _by_python(account, by_python, references, drawn, timeout, progress)
    kept = _Kept(len(drawn), times)
    for k, outcome in account.in_order().items():
        kept.add(k, drawn[k], outcome)
    return Ensemble(
        nominal,
        table,
        kept.metrics,
        kept.timepts,
        kept.bands(),
        failures=tuple(kept.failures),
        finished=kept.finished,
        nominal_draw=nominal_draw,
        interrupted=account.interrupted,
    )


Outcome = dict[str, tuple[dict[str, float], dict[str, Array]] | Failed]
"""By plan: metrics, and signals at the times of the bands; or what went wrong."""


def _forms(loop: Any, references: dict[str, Trajectory], table: dict[str, Array]) -> dict[str, Prepared]:
    """The loop's built form by plan: one for all, or one of each loop that a function builds."""
    if not is_builder(loop):
        return dict.fromkeys(references, prepare(check_has_inputs(loop)))
    _check_builder(loop, table)
    built = tried(lambda _: {name: prepare(loop(name, plan)) for name, plan in references.items()}, None)
    if isinstance(built, Failed):
        raise built.error
    return built


def _check_builder(loop: Any, table: dict[str, Array]) -> None:
    """Reject a function of the parameters, which would be called with a plan's name and the plan."""
    try:
        signature = inspect.signature(loop)
        first = list(signature.parameters)[:2]
    except (TypeError, ValueError):  # of some built-in functions nothing is known
        return
    try:
        signature.bind("", None)
    except TypeError:
        first = list(table)
    if set(first) & set(table):
        raise ValueError(
            "build must be, with params, a loop whose blocks read the parameters, or a function of a plan's name and "
            f"the plan that returns one, got {loop!r:.80}; give a function of the parameter with values="
        )


def _check_read(forms: Mapping[str, Prepared], table: dict[str, Array], start: Any) -> None:
    """Reject a parameter that no block has or reads."""
    for name, values in table.items():

        def reads(form: Prepared, name: str = name, value: float = float(values[0])) -> bool:
            return form.reads(name, value, start)

        found = [tried(reads, form) for form in forms.values()]
        if any(isinstance(one, Failed) or one for one in found):  # what ends in an error of a block may be its own
            continue
        form = next(iter(forms.values()))
        way = (
            f"{form.name} is linear, and its matrices have no parameters: give sweep a function from a value of "
            f"{name!r} to a loop, with values="
            if form.linear is not None
            else "a linear block has none, and others have those of python-control's params="
        )
        raise ValueError(f"params must be parameters of a block, got {name!r}, which none reads; {way}")


def _light(forms: Mapping[str, Prepared], table: dict[str, Array]) -> dict[str, Prepared] | None:
    """Forms without python-control's blocks, for many runs and for other processes; None where there are none."""
    try:
        return {name: form.detached(table) for name, form in forms.items()}
    except TypeError:
        return None


def _nominal(
    forms: Mapping[str, Prepared],
    references: dict[str, Trajectory],
    times: Array,
    table: dict[str, Array],
    settings: dict[str, Any],
    timeout: float | None,
) -> tuple[Comparison, int | None]:
    """The loop with its own parameters; or, where that does not run, with those of the first draw that does."""

    def compared(params: dict[str, float] | None) -> Comparison:
        return all_run(compare(_given(forms), references, times, params=params, **settings))

    own = tried(compared, None, timeout)
    if not isinstance(own, Failed):
        return own, None
    if not isinstance(own.error, ArithmeticError | RuntimeError | TypeError | KeyError):
        raise own.error
    for k in range(min(_STAND_INS, next(iter(table.values())).size)):
        params = _draw(table, k)
        found = tried(compared, params, timeout)
        if not isinstance(found, Failed):
            values = ", ".join(f"{name} = {value:.4g}" for name, value in params.items())
            note = f"Nominal is draw {k} ({values}): the loop's own parameters do not run."
            return replace(found, notes=(*found.notes, note)), k
    own.error.add_note("with the loop's own parameters, and with the first draws")
    raise own.error


def _by_python(
    account: Account[Outcome],
    run: Callable[[dict[str, Trajectory], dict[str, float]], Outcome],
    references: dict[str, Trajectory],
    drawn: list[dict[str, float]],
    timeout: float | None,
    progress: bool,
) -> Account[Outcome]:
    """Plans and draws with which CVODES failed, run by the loop itself in this process: Python may get through."""
    failed = {
        k: {plan: references[plan] for plan, one in outcome.items() if _of_solver(one)}
        for k, outcome in account.in_order().items()
        if not isinstance(outcome, Failed) and any(map(_of_solver, outcome.values()))
    }
    if not failed:
        return account
    found = {k: outcome for k, outcome in account.found.items() if k not in failed}
    if account.interrupted:
        return Account(found, True)
    again = executed(lambda k: run(failed[k], drawn[k]), list(failed), None, timeout, "draws by Python", progress)
    for i, outcome in again.found.items():
        k = list(failed)[i]
        known = account.found[k]
        found[k] = known | outcome if isinstance(known, dict) and isinstance(outcome, dict) else outcome
    return Account(found, again.interrupted)


def _of_solver(outcome: Any) -> bool:
    return isinstance(outcome, Failed) and isinstance(outcome.error, SolverError | NotCompiledError)


class _Kept:
    """What of all draws is kept."""

    def __init__(self, count: int, times: Array) -> None:
        self.timepts = times[_some(times)]
        self.metrics: dict[str, dict[str, Array]] = {}
        self.failures: list[Failure] = []
        self.finished = 0
        self._signals: dict[str, dict[str, Array]] = {}
        self._count = count

    def add(self, k: int, params: dict[str, float], outcome: Outcome | Failed) -> None:
        """One draw, or what went wrong with it."""
        self.finished += 1
        if isinstance(outcome, Failed):
            self.failures.append(Failure(k, params, outcome.message))
            return
        wrong = [found.message for found in outcome.values() if isinstance(found, Failed)]
        if len(wrong) == len(outcome) and len(set(wrong)) == 1:
            self.failures.append(Failure(k, params, wrong[0]))
            return
        for plan, found in outcome.items():
            if isinstance(found, Failed):
                self.failures.append(Failure(k, params, found.message, plan))
                continue
            metrics, signals = found
            for name, value in metrics.items():
                column = self.metrics.setdefault(plan, {}).setdefault(name, np.full(self._count, np.nan))
                column[k] = value
            for name, curve in signals.items():
                known = self._signals.setdefault(plan, {})
                if name not in known:
                    known[name] = np.full((self._count, self.timepts.size), np.nan)
                known[name][k, : curve.size] = curve

    def bands(self) -> dict[str, dict[str, Array]]:
        """Quantiles over the draws that were run."""
        return {plan: {name: _quantiles(rows) for name, rows in found.items()} for plan, found in self._signals.items()}


def _quantiles(rows: Array) -> Array:
    """Quantiles (nlevels, ntime) over rows, of which those that an event ended are nan from there on."""
    out = np.full((len(LEVELS), rows.shape[1]), np.nan)
    known = ~np.isnan(rows)
    for full in (True, False):
        columns = known.all(axis=0) if full else known.any(axis=0) & ~known.all(axis=0)
        if columns.any():
            quantile = np.quantile if full else np.nanquantile
            out[:, columns] = quantile(rows[:, columns], LEVELS, axis=0)
    return out


def _some(times: Array) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, times.size - 1, min(times.size, _SAMPLES)).round().astype(np.intp))


def _elsewhere(
    shared: Shared[Any],
    references: dict[str, Trajectory],
    times: Array,
    settings: dict[str, Any],
    params: dict[str, float],
) -> Outcome:
    """One draw, in another process or thread."""

    def forms(given: Any) -> Mapping[str, Prepared]:
        if isinstance(given, Mapping):
            return given
        return {name: prepare(given(name, plan)) for name, plan in references.items()}

    return _one(shared.made(forms), references, times, settings, params)


def _one(
    forms: Mapping[str, Prepared],
    references: dict[str, Trajectory],
    times: Array,
    settings: dict[str, Any],
    params: dict[str, float],
) -> Outcome:
    """One draw, plan by plan: one may get through where another does not.

    Among the settings are the outputs that follow the plans, by plan.
    """
    wanted = times[_some(times)]

    def measured(plan: str) -> tuple[dict[str, float], dict[str, Array]]:
        own = {**settings, "outputs": settings["outputs"][plan]}
        with DELEGATED if forms[plan].network is None else nullcontext():
            result = compare(_given(forms), {plan: references[plan]}, times, params=params, **own)
        response = result.responses[plan]
        rows = np.asarray(response.outputs).reshape(len(response.output_labels), -1)
        kept = np.isin(np.asarray(response.time), wanted)
        names = dict.fromkeys((*result.outputs, *result.controls))
        signals = {name: rows[list(response.output_labels).index(name)][kept] for name in names}
        return result.metrics[plan], signals

    return {plan: tried(measured, plan) for plan in references}


def _given(forms: Mapping[str, Prepared]) -> Callable[[str, Trajectory], Prepared]:
    return lambda name, plan: forms[name]


def _draw(table: dict[str, Array], k: int) -> dict[str, float]:
    return {name: float(values[k]) for name, values in table.items()}


def _checked_draws(params: Mapping[str, ArrayLike]) -> dict[str, Array]:
    table = {name: np.atleast_1d(real_array(values, f"params[{name!r}]")) for name, values in params.items()}
    sizes = {name: values.shape for name, values in table.items()}
    if not table or len(set(sizes.values())) != 1 or any(len(shape) != 1 or not shape[0] for shape in sizes.values()):
        raise ValueError(f"params must hold as many draws of each parameter, at least one, got shapes {sizes}")
    for name, values in table.items():
        if not np.isfinite(values).all():
            raise ValueError(f"params must be finite, got {values[~np.isfinite(values)][0]} of {name!r}")
    return table
