"""One comparison for each value of a parameter."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from ctrlplan.simulation import rest_state, state_space, stated_start
from ctrlplan.simulation.exact import exact_states
from ctrlplan.simulation.linear import LinearForm, in_right_half, linear_forms
from ctrlplan.studies.comparison import (
    acting_outputs,
    compare,
    finite_or_none,
    is_builder,
    references_of,
    tracked_outputs,
    waypoints_given,
)
from ctrlplan.studies.ensemble import Ensemble, Failure, ensemble
from ctrlplan.studies.measures import MEASURES, checked_names, control_metrics, path_metrics, response_metrics
from ctrlplan.studies.units import Signals, checked_units
from ctrlplan.trajectories import Trajectory, Waypoint

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Metrics = dict[str, dict[str, float]]
"""Plan, metric, value."""

_SAMPLES = 2**19
"""Samples of a signal of all the loops that are taken together."""


@dataclass(frozen=True, repr=False)
class Sweep:
    """Metrics of every plan over a parameter; made by `sweep`.

    Attributes
    ----------
    parameter : str
        Name of what was varied.
    values : ndarray, shape (nvalues,)
        Its values, increasing.
    metrics : dict of str to dict of str to ndarray
        Plan, metric, (nvalues,); nan where a value failed.
    failures : tuple of Failure
        Values that could not be run, and why.
    """

    parameter: str
    values: Array
    metrics: dict[str, dict[str, Array]]
    failures: tuple[Failure, ...] = ()

    def __repr__(self) -> str:
        return f"<Sweep of {', '.join(self.metrics)} over {self.values.size} values of {self.parameter}>"

    def to_pandas(self) -> pd.DataFrame:
        """Table of one row a value; columns plan and metric."""
        import pandas as pd

        columns = {(plan, name): row for plan, rows in self.metrics.items() for name, row in rows.items()}
        return pd.DataFrame(columns, index=pd.Index(self.values, name=self.parameter)).rename_axis(
            columns=["plan", "metric"]
        )

    def results(self, names: Sequence[str]) -> dict[str, Any]:
        """Plain data for JSON: the values, and some metrics of each plan."""
        rows = {
            plan: {name: [finite_or_none(value) for value in found[name].tolist()] for name in names}
            for plan, found in self.metrics.items()
        }
        return {self.parameter: self.values.tolist()} | rows

    def merged(self, other: Sweep) -> Sweep:
        """Both sweeps in one, in order of the values."""
        values = np.concatenate([self.values, other.values])
        order = np.argsort(values, kind="stable")
        rows = {
            plan: {name: np.concatenate([row, other.metrics[plan][name]])[order] for name, row in found.items()}
            for plan, found in self.metrics.items()
        }
        return Sweep(self.parameter, values[order], rows, (*self.failures, *other.failures))

    def plot(self, names: Sequence[str] = ("settling_time", "overshoot_error")) -> Figure:
        """Metrics over the parameter."""
        from ctrlplan.reports.figures import plot_sweep

        return plot_sweep(self, names)


def sweep(
    build: Any,
    values: ArrayLike | None = None,
    plans: Mapping[str, Trajectory] | Iterable[Waypoint] = (),
    timepts: ArrayLike = (),
    executor: Any = None,
    progress: bool = True,
    *,
    params: Mapping[str, ArrayLike] | None = None,
    parameter: str = "value",
    **options: Any,
) -> Sweep | Ensemble:
    """Compare plans in a loop for each value of a parameter, or for each of many draws.

    A value or draw that cannot be run is recorded, and ends nothing; what is
    finished when the run is interrupted is kept.

    Parameters
    ----------
    build : callable or control system
        Maps a value to a loop; with `params`, a loop as `compare` takes it.
    values : array_like, shape (nvalues,), optional
        Values of the parameter, increasing.
    plans, timepts, **options
        As for `compare`.
    executor : concurrent.futures.Executor or alike, optional
        Where the comparisons run: anything with ``submit`` whose result has
        ``result``, as of `dask.distributed` or `mpi4py.futures`. A process pool
        needs a `build` that can be pickled, or with `params` a loop that can be
        compiled. Without one, linear loops that differ in numbers alone are
        solved and measured together, which is faster by far.
    progress : bool, optional
        Show a bar on stderr.
    params : mapping of str to array_like, shape (ndraws,), optional
        In place of `values`: draws of the blocks' parameters, as `draws` makes
        them. The loop is built once for all.
    parameter : str, optional
        Name of what is varied.

    Returns
    -------
    Sweep or Ensemble
        An `Ensemble` with `params`.

    Raises
    ------
    ValueError
        If the values are not finite or do not increase, draws are not as many
        of each parameter, or a parameter is none of a block. What a comparison
        raises at every value is raised.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> found = cp.sweep(cp.plants.integrator_lag_loop, [1, 100], move, np.linspace(0, 20, 2001), progress=False)
    >>> found.metrics["step"]["overshoot_error"].round(1)
    array([16.3, 85.4])
    """
    if params is not None:
        if values is not None:
            raise ValueError("values must not be given beside params, got both")
        return ensemble(build, plans, timepts, params, executor, progress, options)
    if values is None:
        raise ValueError("values, or draws as params, must be given, got neither")
    points = np.atleast_1d(np.asarray(values, dtype=float))
    if points.ndim != 1 or not points.size or not np.isfinite(points).all() or np.any(np.diff(points) <= 0.0):
        raise ValueError(f"values must be finite and increase strictly, got {points.tolist()!s:.80}")
    if not is_builder(build):
        raise TypeError(f"build must be a function from a value to a loop, got {type(build).__name__}")
    options["waypoints"] = tuple(options.get("waypoints", ())) if isinstance(plans, Mapping) else waypoints_given(plans)
    references = references_of(plans if isinstance(plans, Mapping) else options["waypoints"], options.get("alpha", 1.0))
    given: dict[str, Any] = {"plans": references, "timepts": np.asarray(timepts, dtype=float)} | options
    bar = tqdm(total=points.size, desc=parameter, disable=not progress, leave=False)
    found: list[Metrics | Exception] = []
    futures: list[Any] = []
    try:
        if executor is not None:
            futures = [executor.submit(_tried, build, value, given) for value in points.tolist()]
        outcomes = (future.result() for future in futures) if futures else _outcomes(build, points.tolist(), given)
        for outcome in outcomes:
            found.append(outcome)
            bar.update()
    except KeyboardInterrupt:
        for future in futures:
            getattr(future, "cancel", bool)()
    finally:
        bar.close()
    return _swept(parameter, points[: len(found)], found)


def _swept(parameter: str, points: Array, found: list[Metrics | Exception]) -> Sweep:
    errors = [(k, error) for k, error in enumerate(found) if isinstance(error, Exception)]
    if errors and len(errors) == len(found):
        raise errors[0][1]
    known = [(k, metrics) for k, metrics in enumerate(found) if not isinstance(metrics, Exception)]
    rows: dict[str, dict[str, Array]] = {}
    for k, metrics in known:
        for plan, values in metrics.items():
            for name, value in values.items():
                rows.setdefault(plan, {}).setdefault(name, np.full(points.size, np.nan))[k] = value
    failures = [Failure(k, {parameter: float(points[k])}, f"{type(e).__name__}: {e}") for k, e in errors]
    return Sweep(parameter, points, rows, tuple(failures))


def _tried(build: Callable[[float], Any], value: float, given: dict[str, Any]) -> Metrics | Exception:
    """Metrics for one value, or what went wrong."""
    try:
        return compare(build(value), **given).metrics
    except Exception as error:  # whatever a loop does at this value
        return error


def _outcomes(
    build: Callable[[float], Any], values: list[float], given: dict[str, Any]
) -> Iterator[Metrics | Exception]:
    """Metrics for each value, of many at once where their loops are linear and differ in numbers alone."""
    count = max(2, _SAMPLES // max(1, given["timepts"].size))
    for begin in range(0, len(values), count):
        some = values[begin : begin + count]
        try:
            together = _together([build(value) for value in some], given)
        except Exception:  # one of them, which is found below
            together = None
        yield from (_tried(build, value, given) for value in some) if together is None else together


def _together(loops: list[Any], given: dict[str, Any]) -> list[Metrics] | None:
    """What `compare` finds of each loop; None where they are not alike, or it has more to say."""
    bound = inspect.signature(compare).bind(None, **given)
    bound.apply_defaults()
    asked = SimpleNamespace(**bound.arguments)
    plans, times = asked.plans, asked.timepts
    first = next(iter(plans.values()))
    systems = [state_space(loop) for loop in loops]
    form = _form(systems)
    if form is None or form.b.shape[2] != first.naxes or not _ordered(times):
        return None
    if asked.measure is not None or asked.measures or asked.params or asked.events:
        return None
    if asked.initial_state is not None and np.shape(asked.initial_state) not in ((), form.a.shape[2:]):
        return None
    tracked, acting = tracked_outputs(systems[0], asked.outputs, first), acting_outputs(systems[0], asked.controls)
    if asked.only is not None:
        checked_names(asked.only, MEASURES, "only")
    units = checked_units(asked.units, plans.values(), systems)
    named = Signals(dict(zip(first.labels, tracked, strict=True)), acting, units)
    if any(named.separate(unit) for unit in ("{y}", "{u}")):  # signals without a worst
        return None
    if asked.only is not None and not any(name.startswith("control") for name in asked.only):
        acting = ()
    rows = [systems[0].output_labels.index(name) for name in (*tracked, *acting)]
    start = min(plan.start for plan in plans.values())
    unstable = in_right_half(np.linalg.eigvals(form.a)).any(axis=1)
    each = tuple(map(str, range(len(loops))))
    found: list[Metrics] = [{} for _ in loops]
    for name, plan in plans.items():
        initial = _starts(systems, plan, times, asked.initial_state)
        if asked.initial_state is None and not _at_rest(form, plan, times, initial):
            return None  # which is to be said of the loop concerned
        signals = _outputs(form, rows, plan, times, initial).swapaxes(0, 1)
        axes = [plan] if plan.naxes == 1 else [plan.select([label]) for label in plan.labels]
        # One axis of all loops is measured like the axes of one.
        responses = [
            response_metrics(times, y, axis, start, asked.band, each, asked.only)
            for y, axis in zip(signals[: len(axes)], axes, strict=True)
        ]
        controls = [control_metrics(times, u, start, each, asked.only) for u in signals[len(axes) :]]
        values = _of_loops(responses, first.labels, each)
        values |= {key: np.where(unstable, np.inf, row) for key, row in values.items() if "settling_time" in key}
        values |= _of_loops(controls, acting, each)
        of_plan = path_metrics(plan, asked.waypoints, asked.only)
        for i, metrics in enumerate(found):
            metrics[name] = {key: float(row[i]) for key, row in values.items()} | of_plan
    return found


def _form(systems: list[Any]) -> LinearForm | None:
    """Linear form of loops driven by their inputs alone; None unless they differ in numbers alone."""
    labels = getattr(systems[0], "output_labels", None)
    if len(systems) < 2 or any(getattr(s, "output_labels", None) != labels for s in systems):
        return None
    if any(stated_start(s) is not None for s in systems):
        return None
    try:
        form = linear_forms(systems)
    except (AttributeError, ValueError):
        return None
    return None if form.sources else form


def _ordered(times: Array) -> bool:
    return times.ndim == 1 and times.size > 1 and bool(np.isfinite(times).all() and np.all(np.diff(times) > 0.0))


def _starts(systems: list[Any], plan: Trajectory, times: Array, given: ArrayLike | None) -> Array:
    """States (nloops, nstates) at the first sample: as given, or at rest where the plan is."""
    position = plan.jet(times[:1], 0, left=True)[0, :, 0]
    if given is None and position.any():
        return np.stack([rest_state(system, position) for system in systems])
    return np.broadcast_to(0.0 if given is None else np.asarray(given, dtype=float), (len(systems), systems[0].nstates))


def _at_rest(form: LinearForm, plan: Trajectory, times: Array, initial: Array) -> bool:
    """Whether states (nloops, nstates) are equilibria with the plan held at its first position."""
    position = plan.jet(times[:1], 0, left=True)[0, :, 0]
    moved = np.einsum("kij,kj->ki", form.a, initial) + form.b @ position
    terms = np.einsum("kij,kj->ki", np.abs(form.a), np.abs(initial)) + np.abs(form.b) @ np.abs(position)
    return bool(np.all(np.abs(moved) <= 1e-6 * terms.max(axis=1, initial=0.0, keepdims=True)))


def _of_loops(measured: list[dict[str, float]], labels: Sequence[str], each: Sequence[str]) -> dict[str, Array]:
    """Metrics (nloops,) as `compare` names them, from those of each label: the worst, and each where there are more."""
    names = [name for name in measured[0] if name in MEASURES] if measured else []
    rows = {name: np.array([[found[f"{name}_{i}"] for i in each] for found in measured]) for name in names}
    worst = {name: np.fmax.reduce(row) for name, row in rows.items()}
    if len(labels) > 1:
        for name, row in rows.items():
            worst |= {f"{name}_{label}": values for label, values in zip(labels, row, strict=True)}
    return worst


def _outputs(form: LinearForm, rows: list[int], plan: Trajectory, times: Array, initial: Array) -> Array:
    """Some of the outputs, shape (nloops, nrows, ntime), with a plan at the inputs."""
    with np.errstate(over="ignore", invalid="ignore"):
        out = exact_states(form.a, form.b, plan._jet_beside, list(plan.breakpoints), times, initial, form.c[:, rows])
        for k, row in enumerate(rows):
            if form.d[:, row].any():
                out[:, k] += form.d[:, row] @ plan.jet(times, 0)[0]
    if not np.isfinite(out[..., -1]).all():  # what has left the range of numbers does not come back
        out[np.isnan(out)] = np.inf
    return out
