"""One comparison for each value of a parameter."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from ctrlplan.studies.comparison import compare, finite_or_none
from ctrlplan.trajectories import Trajectory, Waypoint

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sweep:
    """Metrics of every plan over a parameter; made by `sweep`.

    Attributes
    ----------
    parameter : str
        Name of what was varied.
    values : ndarray, shape (nvalues,)
        Its values, increasing.
    metrics : dict of str to dict of str to ndarray
        Plan, metric, (nvalues,).
    """

    parameter: str
    values: Array
    metrics: dict[str, dict[str, Array]]

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
        return Sweep(self.parameter, values[order], rows)

    def plot(self, names: Sequence[str] = ("settling_time", "overshoot_error")) -> Figure:
        """Metrics over the parameter."""
        from ctrlplan.reports.figures import plot_sweep

        return plot_sweep(self, names)


def sweep(
    build: Callable[[float], Any],
    values: ArrayLike,
    plans: Mapping[str, Trajectory] | Iterable[Waypoint],
    timepts: ArrayLike,
    executor: Any = None,
    progress: bool = True,
    *,
    parameter: str = "value",
    **options: Any,
) -> Sweep:
    """Compare plans in a loop for each value of a parameter.

    Parameters
    ----------
    build : callable
        Maps a value to a loop.
    values : array_like, shape (nvalues,)
        Values of the parameter, increasing.
    plans, timepts, **options
        As for `compare`.
    executor : concurrent.futures.Executor or alike, optional
        Where the comparisons run: anything with ``submit`` whose result has
        ``result``. A process pool needs a `build` that can be pickled.
    progress : bool, optional
        Show a bar on stderr.
    parameter : str, optional
        Name of what is varied.

    Returns
    -------
    Sweep

    Raises
    ------
    ValueError
        If the values are not finite or do not increase.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> found = cp.sweep(cp.plants.integrator_lag_loop, [1, 100], move, np.linspace(0, 20, 2001), progress=False)
    >>> found.metrics["step"]["overshoot_error"].round(1)
    array([16.3, 85.4])
    """
    points = np.atleast_1d(np.asarray(values, dtype=float))
    if points.ndim != 1 or not points.size or not np.isfinite(points).all() or np.any(np.diff(points) <= 0.0):
        raise ValueError(f"values must be finite and increase strictly, got {points.tolist()!s:.80}")
    references = plans if isinstance(plans, Mapping) else tuple(plans)
    one = partial(_metrics, build, plans=references, timepts=np.asarray(timepts, dtype=float), options=options)
    bar = partial(tqdm, total=points.size, desc=parameter, disable=not progress, leave=False)
    if executor is None:
        found = [one(value) for value in bar(points.tolist())]
    else:
        futures = [executor.submit(one, value) for value in points.tolist()]
        found = [future.result() for future in bar(futures)]
    rows = {plan: {name: np.array([f[plan][name] for f in found]) for name in found[0][plan]} for plan in found[0]}
    return Sweep(parameter, points, rows)


def _metrics(
    build: Callable[[float], Any], value: float, plans: Any, timepts: Array, options: dict[str, Any]
) -> dict[str, dict[str, float]]:
    return compare(build(value), plans, timepts, **options).metrics
