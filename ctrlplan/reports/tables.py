"""Tables of a page: metrics, their quantiles over draws, and metrics over alpha and duration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ctrlplan.reports.parts import Cell, Head, MetricRow, MetricsTable, Plan, Table
from ctrlplan.reports.style import Style, line_styles, roles_of
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.grids import SAME, Grid
from ctrlplan.studies.required_durations import RequiredDuration
from ctrlplan.studies.verdicts import number, unit_of, verdicts

_NONE = (math.nan,) * 5


def metrics_of(comparison: Comparison, kind: str = "metrics", known: Mapping[str, Style] | None = None) -> MetricsTable:
    """Metrics of a comparison, with marks on the best and the worst.

    Parameters
    ----------
    comparison : Comparison
        What is shown.
    kind : str, optional
        Class of the table in the page's style.
    known : mapping of str to dict, optional
        Styles of plans that other figures of the page show, from `line_styles`.
    """
    decided = {v.key: v for v in verdicts(comparison)}
    rows = []
    for key, measure in comparison.measures.items():
        if not any(key in found for found in comparison.metrics.values()):
            continue
        verdict = decided.get(key)
        best, worst = ((), ()) if verdict is None else (verdict.best, verdict.worst)
        cells = []
        for plan, found in comparison.metrics.items():
            value = found.get(key, math.nan)
            mark, meaning = ("worse", "worst") if plan in worst else ("better", "best") if plan in best else ("", "")
            cells.append(Cell(number(value, measure.unit), mark, meaning, _order(value)))
        rows.append(MetricRow(measure.title, unit_of(comparison, key), cells))
    styles = line_styles(roles_of(comparison), known)
    plans = [Plan(plan, styles[plan]["color"], "†" if plan in comparison.marks else "") for plan in comparison.metrics]
    return MetricsTable(plans, rows, kind)


def spread_of(ensemble: Ensemble) -> MetricsTable:
    """Metrics over draws: median, 5 % and 95 % quantile."""
    nominal, rows = ensemble.nominal, []
    for key, measure in nominal.measures.items():
        if not any(key in found for found in ensemble.metrics.values()):
            continue
        cells = []
        for plan in nominal.metrics:
            low, _, middle, _, high = ensemble.quantiles(key)[plan] if key in ensemble.metrics.get(plan, {}) else _NONE
            text = f"{number(middle, measure.unit)} ({number(low, measure.unit)} to {number(high, measure.unit)})"
            cells.append(Cell(text, order=_order(float(middle))))
        rows.append(MetricRow(measure.title, unit_of(nominal, key), cells))
    styles = line_styles(roles_of(nominal))
    return MetricsTable([Plan(plan, styles[plan]["color"]) for plan in nominal.metrics], rows)


def grid_of(grid: Grid, unit: str) -> Table:
    """A metric over duration and alpha, followed by the baselines.

    Parameters
    ----------
    grid : Grid
        The metric.
    unit : str
        Unit of the metric.
    """
    rows = []
    for i, (duration, marks) in enumerate(zip(grid.durations.tolist(), grid.marks(), strict=True)):
        best, _ = grid.best(i)
        own = zip(grid.values[i].tolist(), marks, strict=True)
        cells = [Cell(number(value, unit), mark, _GRID_MARKS.get(mark, "")) for value, mark in own]
        cells += [
            Cell(number(float(values[i]), unit), "reference" if name == best else "")
            for name, values in grid.baselines.items()
        ]
        rows.append([Cell(f"{duration:.4g}"), *cells])
    shapes = [f"alpha {a:.3g}" if a else "alpha 0 (polynomial)" for a in grid.alphas.tolist()]
    return Table(["duration [s]", *shapes, *grid.baselines], rows, "grid")


_GRID_MARKS = {"better": "better than every baseline", "worse": "worse than the best baseline"}


def durations_of(required: Sequence[RequiredDuration]) -> Table:
    """Minimum durations of plans under the same limits."""
    minimum = min((one.duration for one in required if math.isfinite(one.duration)), default=math.nan)
    rows = []
    for one in required:
        mark, meaning = ("better", "best") if one.duration <= minimum * (1.0 + SAME) else ("", "")
        rows.append([Cell(one.name), Cell(number(one.duration), mark, meaning), Cell(one.limit), Cell(one.satisfied)])
    heads = [
        Head("plan"),
        Head("minimum duration [s]"),
        Head("active limit", words=True),
        Head("limits at the given duration", words=True),
    ]
    return Table(heads, rows, "durations")


def _order(value: float) -> str:
    """Sort key of a cell."""
    return "" if math.isnan(value) else "1e999" if math.isinf(value) else repr(value)
