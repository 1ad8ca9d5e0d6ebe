"""Metrics and bands over many draws of the parameters of a loop."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ctrlplan._display import Displayed, Facts, Part, Table, counted, number
from ctrlplan.studies.comparison import Comparison, finite_or_none
from ctrlplan.studies.measures import Measure, leading_metrics
from ctrlplan.studies.sections import Bands, DrawTable, PlanCurves
from ctrlplan.studies.study import Study
from ctrlplan.studies.units import ROUNDING, without_rounding
from ctrlplan.studies.verdicts import unit_of

if TYPE_CHECKING:
    import pandas as pd
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike

Array = NDArray[np.float64]

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Levels of the quantiles."""

_SHOWN = 8
"""Maximum number of draws or values in a list."""


@dataclass(frozen=True)
class Failure:
    """Failure of a draw, or of a value of a sweep.

    Attributes
    ----------
    draw : int
        Index of the draw, or of the value of a sweep.
    params : dict of str to float
        Parameters of the draw.
    message : str
        Message of the exception.
    plan : str
        Plan that failed; empty if all failed.
    """

    draw: int
    params: dict[str, float]
    message: str
    plan: str = ""


def numbers_shown(numbers: Sequence[float]) -> str:
    """The first of some numbers, and how many there are; empty for none."""
    shown = ", ".join(number(value) for value in numbers[:_SHOWN])
    return shown if len(numbers) <= _SHOWN else f"{shown}, ... ({len(numbers)} in all)"


@dataclass(frozen=True, repr=False)
class Ensemble(Displayed):
    """Responses of a loop to plans over draws of its parameters, as returned by `monte_carlo`.

    Attributes
    ----------
    nominal : Comparison
        Comparison at the nominal parameters.
    params : dict of str to ndarray, shape (ndraws,)
        The draws.
    metrics : dict of str to dict of str to ndarray, shape (ndraws,)
        Values of each metric by plan; nan for draws that failed or did not run.
    timepts : ndarray, shape (ntime,)
        Times of the bands [s].
    bands : dict of str to dict of str to ndarray, shape (nlevels, ntime)
        Quantiles of each signal by plan, at `levels`.
    levels : tuple of float
        Levels of the quantiles.
    failures : tuple of Failure
        Failed draws, with their parameters.
    finished : int
        Number of draws that ran or failed; smaller than `ndraws` after an interruption.
    nominal_draw : int or None
        Draw in place of the nominal loop, if that does not run.
    interrupted : bool
        Whether Ctrl-C ended the runs.
    sent_again : tuple of int
        Draws that were sent to an executor again because their worker ended.
    missing : tuple of int
        Draws that no worker finished, which are in `failures` too, or that did
        not run before an interruption.
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
    sent_again: tuple[int, ...] = ()
    missing: tuple[int, ...] = ()

    def _describe(self) -> Iterator[Part]:
        failed = counted(len(self.failures), "failure")
        draws = f"{counted(self.finished, 'draw')} of {', '.join(self.params)}"
        yield f"Ensemble of {', '.join(self.nominal.plans)} over {draws}; {failed}"
        ranges = {name: (float(values.min()), float(values.max())) for name, values in self.params.items()}
        rows = [(name, f"{number(low)} to {number(high)}") for name, (low, high) in ranges.items()]
        yield Facts(
            [
                *rows,
                ("interrupted", f"{self.finished} of {self.ndraws} draws run" if self.interrupted else ""),
                ("sent again", numbers_shown(self.sent_again)),
                ("missing", numbers_shown(self.missing)),
            ]
        )
        yield self.metric_table()
        if self.failures:
            yield f"First failure: draw {self.failures[0].draw}: {self.failures[0].message}"

    def metric_table(self) -> Table:
        """Median and 5 to 95 % range of the metrics over the draws, as print shows them, eight at most."""
        measures = self.nominal.measures.items()
        known = {name: one for name, one in measures if any(name in row for row in self.metrics.values())}
        rows = list(leading_metrics(known, self._cells).values())
        return Table("Median of each metric (5 % to 95 % of the draws)", ("metric", "unit", *self.metrics), rows)

    def _cells(self, name: str, measure: Measure) -> list[str]:
        """Unit of a metric, and its median and range for each plan."""
        cells, scale = [unit_of(self.nominal, name)], self.nominal.scales.get(name, 0.0)
        for quantiles in self.quantiles(name).values():
            shown = [number(without_rounding(value, scale), measure.unit) for value in quantiles.tolist()]
            low, _, middle, _, high = shown
            cells.append(middle if low == high else f"{middle} ({low} to {high})")
        return cells

    @property
    def ndraws(self) -> int:
        """Number of draws."""
        return next(iter(self.params.values())).size

    def quantiles(self, name: str) -> dict[str, Array]:
        """Quantiles at `levels` of a metric, by plan, without failed draws."""
        found = {}
        for plan, rows in self.metrics.items():
            values = rows.get(name, np.empty(0))
            known = values[~np.isnan(values)]
            nothing = np.full(len(self.levels), np.nan)
            found[plan] = np.quantile(known, self.levels, method="inverted_cdf") if known.size else nothing
        return found

    def to_pandas(self) -> pd.DataFrame:
        """Table with one row per draw, and columns for the parameters and for metrics by plan."""
        import pandas as pd

        columns = {("params", name): values for name, values in self.params.items()}
        columns |= {(plan, name): row for plan, rows in self.metrics.items() for name, row in rows.items()}
        return pd.DataFrame(columns).rename_axis(index="draw", columns=["plan", "metric"])

    def results(self) -> dict[str, object]:
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
        """Plot bands of outputs, errors and controls versus time.

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

    def report(self, path: str | os.PathLike[str], title: str = "Monte Carlo simulation") -> Path:
        """Write one self-contained HTML page and return its path.

        Parameters
        ----------
        path : str or path
            The file, or a folder for ``index.html`` in it.
        title : str, optional
            Heading.
        """
        from ctrlplan.reports import write_page

        notes = (*self.nominal.notes, *self.notes())
        shown = [section for section in self.nominal.sections() if not isinstance(section, PlanCurves)]
        study = Study("draws", title, self.nominal, notes=notes, sections=(Bands(self), *shown, DrawTable(self)))
        return write_page([study], path, title=title)

    def notes(self) -> Iterator[str]:
        """Notes on the draws: ranges, failures, and the best plan by metric."""
        ranges = ", ".join(f"{k} {v.min():.4g} to {v.max():.4g}" for k, v in self.params.items())
        whose = "the nominal loop" if self.nominal_draw is None else f"draw {self.nominal_draw}"
        yield f"{self.finished} draws: {ranges}. The responses below are those of {whose}."
        if self.finished < self.ndraws:
            yield f"The run was interrupted; {self.ndraws - self.finished} draws were not run."
        if self.sent_again:
            yield f"Draws sent again because their worker ended: {numbers_shown(self.sent_again)}."
        if self.failures:
            first = self.failures[0]
            where = ", ".join(f"{key} = {value:.4g}" for key, value in first.params.items())
            with_plan = f" and the plan {first.plan}" if first.plan else ""
            count = len({failure.draw for failure in self.failures})
            yield f"{count} of {self.finished} draws failed. The first, with {where}{with_plan}: {first.message}"
            yield "Failed draws are excluded from bands and quantiles."
        yield from self._best_shares()

    def best(self, name: str) -> dict[str, float]:
        """Share of the draws in which each plan has the smallest value of a metric.

        Values that differ by less than 1e-6 of the scale of the metric in the
        nominal loop count as equal, and each of these plans is counted.
        """
        rows = {plan: found[name] for plan, found in self.metrics.items() if name in found}
        table = np.array(list(rows.values()))
        with np.errstate(invalid="ignore"):
            smallest = np.fmin.reduce(table)
            best = table <= smallest + ROUNDING * self.nominal.scales.get(name, 0.0)
        known = ~np.isnan(smallest)
        return {plan: float(row[known].mean()) if known.any() else np.nan for plan, row in zip(rows, best, strict=True)}

    def _best_shares(self) -> Iterator[str]:
        plans = list(self.metrics)
        names = dict.fromkeys(name for found in self.metrics.values() for name in found)
        if len(plans) < 2:
            return
        for name in list(names)[:3]:
            shares = self.best(name)
            title = self.nominal.measures[name].title if name in self.nominal.measures else name
            yield (
                f"{title}, share of the draws in which each plan is best, ties included: "
                + ", ".join(f"{p} {100 * s:.0f} %" for p, s in shares.items())
                + "."
            )
