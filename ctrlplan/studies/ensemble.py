"""One comparison for each of many draws of a loop's parameters."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from ctrlplan.simulation import Prepared, prepare
from ctrlplan.studies.comparison import (
    Comparison,
    all_run,
    check_has_inputs,
    compare,
    finite_or_none,
    is_builder,
    references_of,
    waypoints_given,
)
from ctrlplan.trajectories import Trajectory, Waypoint

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Distribution = Any
"""Two numbers, the ends of a uniform distribution, or whatever has scipy's ``rvs``."""

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)

_CHUNK = 20
"""Draws that an executor is handed at a time."""

_SAMPLES = 1001
"""Times at which bands are kept, at most."""


@dataclass(frozen=True)
class Failure:
    """A draw that could not be run.

    Attributes
    ----------
    draw : int
        Which.
    params : dict of str to float
        Its parameters.
    message : str
        What went wrong.
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

    def plot(self) -> Figure:
        """Bands of outputs and controls over time."""
        from ctrlplan.reports.figures import plot_bands

        return plot_bands(self)

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
) -> Ensemble:
    """Compare plans in a loop for each draw of its parameters; see `sweep`."""
    table = _checked_draws(params)
    count = next(iter(table.values())).size
    times = np.asarray(timepts, dtype=float)
    settings: dict[str, Any] = {"events": (), **(options or {})}
    points = settings.pop("waypoints", ())
    if not isinstance(plans, Mapping):
        plans = points = waypoints_given(plans)
    references = references_of(plans, settings.pop("alpha", 1.0))
    settings.setdefault("start", min(plan.start for plan in references.values()))
    builds = is_builder(loop)
    shared = None if builds else prepare(check_has_inputs(loop))
    forms = {name: shared or prepare(loop(name, plan)) for name, plan in references.items()}
    for name, values in table.items():
        start = settings.get("initial_state")
        if not any(form.reads(name, float(values[0]), start) for form in forms.values()):
            raise ValueError(f"params must be parameters of a block, got {name!r}, which none reads")
    nominal, nominal_draw = _nominal(forms, references, times, table, {"waypoints": points, **settings})
    # Compiled for these parameters, and compared with Python, here and once.
    _one(forms, references, times, settings, _draw(table, 0))
    try:
        light: Any = {name: form.detached(table) for name, form in forms.items()}
    except TypeError as error:
        light = forms if executor is None else _sendable(loop, builds, error)

    def again(k: int, found: Outcome) -> Outcome:
        """Plans of a draw that failed, by the loop itself: what is compiled may fail where Python does not."""
        failed = {plan: references[plan] for plan, one in found.items() if isinstance(one, str)}
        return {**found, **_one(forms, failed, times, settings, _draw(table, k))} if failed else found

    kept = _Kept(count, times)
    bar = tqdm(total=count, desc="draws", disable=not progress, leave=False)
    futures: list[Any] = []
    try:
        if executor is None:
            for k in range(count):
                found = _one(light, references, times, settings, _draw(table, k))
                kept.add(k, _draw(table, k), again(k, found) if light is not forms else found)
                bar.update()
        else:
            size = max(1, min(_CHUNK, -(-count // 8)))
            tasks = [range(k, min(k + size, count)) for k in range(0, count, size)]
            run = partial(_several, light, references, times, settings)
            futures = [executor.submit(run, [_draw(table, k) for k in task]) for task in tasks]
            for task, future in zip(tasks, futures, strict=True):
                try:
                    outcomes = future.result()
                except Exception as error:  # a worker that died; where none works at all, that is what to say
                    if not kept.finished:
                        raise
                    outcomes = [dict.fromkeys(references, f"{type(error).__name__}: {error}")] * len(task)
                for k, found in zip(task, outcomes, strict=True):
                    kept.add(k, _draw(table, k), again(k, found))
                bar.update(len(task))
    except KeyboardInterrupt:
        for future in futures:
            getattr(future, "cancel", bool)()
    finally:
        bar.close()
    return Ensemble(
        nominal,
        table,
        kept.metrics,
        kept.timepts,
        kept.bands(),
        failures=tuple(kept.failures),
        finished=kept.finished,
        nominal_draw=nominal_draw,
    )


Outcome = dict[str, tuple[dict[str, float], dict[str, Array]] | str]
"""By plan: metrics, and signals at the times of the bands; or what went wrong."""


def _nominal(
    forms: Mapping[str, Prepared],
    references: dict[str, Trajectory],
    times: Array,
    table: dict[str, Array],
    settings: dict[str, Any],
) -> tuple[Comparison, int | None]:
    """The loop with its own parameters; or, where that does not run, with those of the first draw that does."""
    try:
        return all_run(compare(_given(forms), references, times, **settings)), None
    except (ArithmeticError, RuntimeError, TypeError, KeyError) as error:
        for k in range(min(20, next(iter(table.values())).size)):
            with suppress(Exception):
                params = _draw(table, k)
                found = all_run(compare(_given(forms), references, times, params=params, **settings))
                values = ", ".join(f"{name} = {value:.4g}" for name, value in params.items())
                note = f"Nominal is draw {k} ({values}): the loop's own parameters do not run."
                return replace(found, notes=(*found.notes, note)), k
        error.add_note("with the loop's own parameters, and with the first draws")
        raise


class _Kept:
    """What of all draws is kept."""

    def __init__(self, count: int, times: Array) -> None:
        self.timepts = times[_some(times)]
        self.metrics: dict[str, dict[str, Array]] = {}
        self.failures: list[Failure] = []
        self.finished = 0
        self._signals: dict[str, dict[str, Array]] = {}
        self._count = count

    def add(self, k: int, params: dict[str, float], outcome: Outcome) -> None:
        """One draw, or what went wrong with it."""
        self.finished += 1
        wrong = [found for found in outcome.values() if isinstance(found, str)]
        if len(wrong) == len(outcome) and len(set(wrong)) == 1:
            self.failures.append(Failure(k, params, wrong[0]))
            return
        for plan, found in outcome.items():
            if isinstance(found, str):
                self.failures.append(Failure(k, params, found, plan))
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


def _several(
    forms: Any,
    references: dict[str, Trajectory],
    times: Array,
    settings: dict[str, Any],
    draws: list[dict[str, float]],
) -> list[Outcome]:
    """Some draws, in another process."""
    if not isinstance(forms, Mapping):  # a function that builds the loops
        build = forms
        forms = {name: prepare(build(name, plan)) for name, plan in references.items()}
    return [_one(forms, references, times, settings, params) for params in draws]


def _one(
    forms: Mapping[str, Prepared],
    references: dict[str, Trajectory],
    times: Array,
    settings: dict[str, Any],
    params: dict[str, float],
) -> Outcome:
    """One draw, plan by plan: one may get through where another does not."""
    wanted = times[_some(times)]
    outcome: Outcome = {}
    for plan, reference in references.items():
        try:
            result = compare(_given(forms), {plan: reference}, times, params=params, **settings)
        except Exception as error:  # whatever a block does at these parameters
            outcome[plan] = f"{type(error).__name__}: {error}"
            continue
        response = result.responses[plan]
        rows = np.asarray(response.outputs).reshape(len(response.output_labels), -1)
        kept = np.isin(np.asarray(response.time), wanted)
        names = dict.fromkeys((*result.outputs, *result.controls))
        signals = {name: rows[list(response.output_labels).index(name)][kept] for name in names}
        outcome[plan] = (result.metrics[plan], signals)
    return outcome


def _given(forms: Mapping[str, Prepared]) -> Callable[[str, Trajectory], Prepared]:
    return lambda name, plan: forms[name]


def _draw(table: dict[str, Array], k: int) -> dict[str, float]:
    return {name: float(values[k]) for name, values in table.items()}


def _checked_draws(params: Mapping[str, ArrayLike]) -> dict[str, Array]:
    table = {name: np.atleast_1d(np.asarray(values, dtype=float)) for name, values in params.items()}
    sizes = {name: values.shape for name, values in table.items()}
    if not table or len(set(sizes.values())) != 1 or any(len(shape) != 1 or not shape[0] for shape in sizes.values()):
        raise ValueError(f"params must hold as many draws of each parameter, at least one, got shapes {sizes}")
    for name, values in table.items():
        if not np.isfinite(values).all():
            raise ValueError(f"params must be finite, got {values[~np.isfinite(values)][0]} of {name!r}")
    return table


def _sendable(loop: Any, builds: bool, error: TypeError) -> Any:
    """A function that builds the loops, where the loops themselves cannot be sent to another process."""
    try:
        if builds and pickle.dumps(loop):
            return loop
    except Exception as why:  # whatever pickle meets in a user's object
        raise ValueError(f"the loop must go to other processes, but {error} ({why})") from None
    raise ValueError(f"the loop must go to other processes, but {error}")
