"""One comparison for each value of a parameter."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import real_array
from ctrlplan.studies.alike import Alike, Metrics
from ctrlplan.studies.comparison import all_run, compare, finite_or_none, is_builder, references_of, waypoints_given
from ctrlplan.studies.ensemble import Ensemble, Failure, ensemble
from ctrlplan.studies.executing import Account, Failed, checked_executor, checked_timeout, executed, gathered, tried
from ctrlplan.trajectories import Trajectory, Waypoint

if TYPE_CHECKING:
    import pandas as pd
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike

Array = NDArray[np.float64]


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
        Values that could not be run, and why; `Failure.draw` is the value's index.
    interrupted : bool
        Whether Ctrl-C ended the sweep: values that it did not reach are then missing.
    """

    parameter: str
    values: Array
    metrics: dict[str, dict[str, Array]]
    failures: tuple[Failure, ...] = ()
    interrupted: bool = False

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
        """Both sweeps in one, in order of the values; nan where one has not a metric of the other."""
        values = np.concatenate([self.values, other.values])
        order = np.argsort(values, kind="stable")
        place = np.argsort(order)
        names = {
            plan: dict.fromkeys((*self.metrics.get(plan, {}), *other.metrics.get(plan, {})))
            for plan in dict.fromkeys((*self.metrics, *other.metrics))
        }
        rows = {
            plan: {name: np.concatenate([one._column(plan, name) for one in (self, other)])[order] for name in found}
            for plan, found in names.items()
        }
        moved = [replace(failure, draw=int(place[failure.draw])) for failure in self.failures]
        moved += [replace(failure, draw=int(place[failure.draw + self.values.size])) for failure in other.failures]
        failures = tuple(sorted(moved, key=lambda failure: failure.draw))
        return Sweep(self.parameter, values[order], rows, failures, self.interrupted or other.interrupted)

    def _column(self, plan: str, name: str) -> Array:
        return self.metrics.get(plan, {}).get(name, np.full(self.values.size, np.nan))

    def plot(
        self, names: Sequence[str] = ("settling_time", "overshoot_error"), *, ax: AxesLike | None = None
    ) -> ControlPlot:
        """Metrics over the parameter.

        Parameters
        ----------
        names : sequence of str, optional
            Metrics, an axes each.
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
    build: Any,
    values: ArrayLike | None = None,
    plans: Mapping[str, Trajectory] | Iterable[Waypoint] = (),
    timepts: ArrayLike = (),
    executor: Any = None,
    progress: bool = True,
    *,
    params: Mapping[str, ArrayLike] | None = None,
    parameter: str = "value",
    timeout: float | None = None,
    **options: Any,
) -> Sweep | Ensemble:
    """Compare plans in a loop for each value of a parameter, or for each of many draws.

    A value or draw that cannot be run, whose worker process dies, that takes
    too long, or that calls ``sys.exit`` is recorded in `failures` with the
    reason; the others are kept. Ctrl-C ends the sweep: what is finished is
    returned with a warning, and tasks that have not begun are cancelled; an
    executor finishes those that have. A second Ctrl-C, or one before the first
    draw, raises KeyboardInterrupt.

    Parameters
    ----------
    build : callable or control system
        Maps a value to a loop; with `params`, a loop as `compare` takes it.
    values : array_like, shape (nvalues,), optional
        Values of the parameter, increasing.
    plans, timepts, **options
        As for `compare`; ``worth`` with `params` only, for the nominal loop.
    executor : concurrent.futures.Executor or alike, optional
        Where the comparisons run: anything with ``submit`` whose result has
        ``result``, as of `dask.distributed`, `loky` or `mpi4py.futures`; not a
        `multiprocessing.Pool`. Results are taken as they complete. Other
        processes need a `build` that the executor can send, or with `params` a
        loop that can be compiled. Without an executor, linear loops that differ
        in numbers alone are solved and measured together, which is faster by far.
    progress : bool, optional
        Show a bar on stderr.
    params : mapping of str to array_like, shape (ndraws,), optional
        In place of `values`: draws of the blocks' parameters, as `draws` makes
        them. The loop is built once for all.
    parameter : str, optional
        Name of what is varied.
    timeout : float, optional
        Time limit of one run, one plan in one loop [s]. It is checked between
        evaluations of the loop's equations, of a compiled loop between the
        segments of a run (from breakpoint to breakpoint): a function of yours
        that never returns is not stopped, and a compiled segment is finished.
        Linear loops are solved in closed form, and have no limit.

    Returns
    -------
    Sweep or Ensemble
        An `Ensemble` with `params`.

    Raises
    ------
    TypeError
        If `executor` has no ``submit``, or an option is none of `compare`.
    ValueError
        If the values are not finite or do not increase, draws are not as many
        of each parameter, or a parameter is none of a block. What a comparison
        raises at every value is raised, SystemExit as a RuntimeError.

    Warns
    -----
    UserWarning
        If Ctrl-C ended it.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> found = cp.sweep(cp.plants.integrator_lag_loop, [1, 100], move, np.linspace(0, 20, 2001), progress=False)
    >>> found.metrics["step"]["overshoot_error"].round(1)
    array([16.3, 85.4])
    """
    executor, timeout = checked_executor(executor), checked_timeout(timeout)
    # An iterator would be used up by the first of the comparisons.
    options = {name: tuple(value) if isinstance(value, Iterator) else value for name, value in options.items()}
    inspect.signature(compare).bind(None, plans, timepts, **options)
    found: Sweep | Ensemble
    if params is not None:
        if values is not None:
            raise ValueError("values must not be given beside params, got both")
        found = ensemble(build, plans, timepts, params, executor, progress, options, timeout)
        done, count, what = found.finished, found.ndraws, "draws"
    else:
        points = _checked_values(values)
        if not is_builder(build):
            raise TypeError(f"build must be a function from a value to a loop, got {type(build).__name__}")
        given = _given(plans, timepts, options)
        if executor is None:
            account = gathered(_outcomes(build, points.tolist(), given, timeout), points.size, parameter, progress)
        else:
            run = partial(_compared, build, given)
            account = executed(run, points.tolist(), executor, timeout, parameter, progress)
            account.raise_if_all_lost("build")
        found = _swept(parameter, points, account)
        done, count, what = found.values.size, points.size, "values"
    if found.interrupted:
        warnings.warn(f"the sweep was interrupted: {done} of {count} {what} are kept", UserWarning, stacklevel=2)
    return found


def _checked_values(values: ArrayLike | None) -> Array:
    if values is None:
        raise ValueError("values, or draws as params, must be given, got neither")
    points = np.atleast_1d(real_array(values, "values"))
    if points.ndim != 1 or not points.size or not np.isfinite(points).all() or np.any(np.diff(points) <= 0.0):
        raise ValueError(f"values must be finite and increase strictly, got {points.tolist()!s:.80}")
    return points


def _given(plans: Any, timepts: ArrayLike, options: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `compare` for every value."""
    given = dict(options)
    worth: Any = given.get("worth", False)
    if worth is not False:
        raise (ValueError if isinstance(worth, bool | Mapping) else TypeError)(
            "worth must be False in a sweep over values, which has no place for it, got "
            f"{worth!r:.80}; give it to compare at the value of interest"
        )
    given["waypoints"] = tuple(given.get("waypoints", ())) if isinstance(plans, Mapping) else waypoints_given(plans)
    given["plans"] = references_of(plans if isinstance(plans, Mapping) else given["waypoints"], given.get("alpha", 1.0))
    return given | {"timepts": real_array(timepts, "timepts")}


def _swept(parameter: str, points: Array, account: Account[Metrics]) -> Sweep:
    found = account.in_order()
    errors = [(i, outcome) for i, outcome in enumerate(found.values()) if isinstance(outcome, Failed)]
    if errors and len(errors) == len(found) and not account.interrupted:
        raise errors[0][1].error
    reached = points[list(found)]
    rows: dict[str, dict[str, Array]] = {}
    for i, metrics in enumerate(found.values()):
        for plan, values in metrics.items() if not isinstance(metrics, Failed) else ():
            row = rows.setdefault(plan, {})
            for name, value in values.items():
                row.setdefault(name, np.full(reached.size, np.nan))[i] = value
    failures = tuple(Failure(i, {parameter: float(reached[i])}, failed.message) for i, failed in errors)
    return Sweep(parameter, reached, rows, failures, account.interrupted)


def _metrics(given: dict[str, Any], loop: Any) -> Metrics:
    """Metrics of one loop."""
    return all_run(compare(loop, **given)).metrics


def _compared(build: Callable[[float], Any], given: dict[str, Any], value: float) -> Metrics:
    """Metrics for one value."""
    return _metrics(given, build(value))


def _outcomes(
    build: Callable[[float], Any], values: list[float], given: dict[str, Any], timeout: float | None
) -> Generator[tuple[int, Metrics | Failed], None, None]:
    """Outcome of each value, of many at once where their loops are linear and differ in numbers alone.

    The first of these is compared by itself, so that `compare` checks the options.
    """
    alike, checked = Alike(given), False

    def together() -> Iterator[tuple[int, Metrics | Failed]]:
        try:
            yield from alike.metrics().items()
        except Exception:  # one of them, which is found so
            for k in alike.waiting:
                yield k, tried(partial(_compared, build, given), values[k], timeout)
        alike.clear()

    try:
        for k, value in enumerate(values):
            loop = tried(build, value, timeout)
            linear = None if isinstance(loop, Failed) else alike.linear(loop)
            if linear is None or not checked:
                outcome = loop if isinstance(loop, Failed) else tried(partial(_metrics, given), loop, timeout)
                checked = checked or (linear is not None and not isinstance(outcome, Failed))
                yield k, outcome
                continue
            if not alike.fits(linear):
                yield from together()
            alike.waiting[k] = linear
            if alike.full:
                yield from together()
        yield from together()
    except KeyboardInterrupt:  # what has been built is soon measured
        yield from together()
        raise
