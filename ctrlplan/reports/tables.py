"""Tables of a page: metrics, their quantiles over draws, and metrics over alpha and duration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ctrlplan.reports.parts import Cell, Head, MetricRow, MetricsTable, Plan, Table, Text
from ctrlplan.reports.style import Style, line_styles, roles_of, shown_label
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.grids import SAME, Grid
from ctrlplan.studies.limits import limits_used
from ctrlplan.studies.required_durations import RequiredDuration
from ctrlplan.studies.sweep import Sweep
from ctrlplan.studies.units import own_scale, without_rounding
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
            shown = number(without_rounding(value, comparison.scales.get(key, 0.0)), measure.unit)
            cells.append(Cell(shown, mark, meaning, _order(value)))
        difference = "" if verdict is None else verdict.difference
        rows.append(MetricRow(measure.title, unit_of(comparison, key), cells, difference))
    styles = line_styles(roles_of(comparison), known, comparison.measured)
    plans = [plan_of(plan, styles[plan], "†" if plan in comparison.marks else "") for plan in comparison.metrics]
    return MetricsTable(plans, rows, kind)


_MANY = 4
"""Plans up to which each has a column of a table, not a row."""


def key_table_of(comparison: Comparison) -> Table:
    """Key metrics of a comparison, with marks on the best and the worst; many plans stand in rows."""
    whole = metrics_of(comparison)
    listed = {row.title: row for row in whole.rows}
    rows = []
    for key, (title, *_) in comparison.key_metrics().items():
        rows.append(replace(listed[comparison.measures[key].title], title=title))
    return by_plan(whole.plans, rows)


def by_plan(plans: Sequence[Plan], rows: Sequence[MetricRow]) -> Table:
    """Table of a few metrics: metrics in rows, or plans in rows where there are many."""
    titles = [f"{row.title} [{row.unit}]" if row.unit else row.title for row in rows]
    told = any(row.difference for row in rows)
    if len(plans) <= _MANY:
        heads = [Head("metric"), *(Head(plan.name + plan.mark, colour=plan.colour) for plan in plans)]
        lines = [[Cell(title), *row.cells] for title, row in zip(titles, rows, strict=True)]
        if told:
            heads.append(Head("worst to best", note=True))
            lines = [[*line, Cell(row.difference)] for line, row in zip(lines, rows, strict=True)]
        return Table(heads, lines, "leading")
    lines = [
        [Cell(plan.name + plan.mark, colour=plan.colour), *(row.cells[place] for row in rows)]
        for place, plan in enumerate(plans)
    ]
    if told:
        lines.append([Cell("worst to best"), *(Cell(row.difference, "note") for row in rows)])
    return Table([Head("plan"), *map(Head, titles)], lines, "leading")


def plan_of(name: str, style: Style, mark: str = "") -> Plan:
    """Plan of a table or a legend in a style of `line_styles`."""
    dashes = style["linestyle"]
    pattern = "" if isinstance(dashes, str) else " ".join(f"{1.6 * part:g}" for part in dashes[1])
    return Plan(shown_label(name), style["color"], mark, pattern)


def extrema_of(sweep: Sweep) -> str:
    """Range of the leading metrics of each plan over a sweep, in a sentence."""
    leading = list(sweep.key_metrics().items())[:3]
    ends = f"{number(float(sweep.values[0]))} to {number(float(sweep.values[-1]))}"
    said = []
    for column, plan in enumerate(sweep.metrics, 2):
        rows = [row for name, row in leading if not np.isnan(sweep.column(plan, name)).all()]
        values = [f"{row[0][0].lower()}{row[0][1:]} {row[column]}{f' {row[1]}' if row[1] else ''}" for row in rows]
        said.append(f"{plan}: {', '.join(values)}.")
    failed = [f"{sweep.values[one.draw]:.6g}" for one in sweep.failures]
    if failed:
        said.append(f"Failed, without values: {len(failed)} of {sweep.values.size}, first at {failed[0]}.")
    return f"{sweep.parameter} from {ends}. {' '.join(said)}".replace("-", "−")


_LISTED = 200
"""Values of a sweep up to which a page lists them."""


def values_of(sweep: Sweep) -> list[Text | Table]:
    """Leading metrics of each plan at every value of a sweep; at some of very many values."""
    names = sweep.key_metrics()
    at = np.unique(np.linspace(0, sweep.values.size - 1, min(sweep.values.size, _LISTED)).round().astype(int))
    blocks: list[Text | Table] = []
    if at.size < sweep.values.size:
        blocks.append(Text(f"{at.size} of {sweep.values.size} values, evenly spaced in their order.", hint=True))
    heads, units = [sweep.parameter], {name: sweep.unit_of(name) for name in names}
    for name, unit in units.items():
        heads.append(f"{sweep.title_of(name)} [{unit}]" if unit else sweep.title_of(name))
    scales = {name: own_scale(sweep.measures[name]) for name in names}
    for plan, found in sweep.metrics.items():
        cells = [
            [number(without_rounding(value, scale)) for value in found[name][at].tolist()]
            if name in found
            else ["–"] * at.size
            for name, scale in scales.items()
        ]
        rows = [[f"{sweep.values[k]:.6g}", *row] for k, row in zip(at, zip(*cells, strict=True), strict=True)]
        blocks += [Text(f"{plan}:"), Table(heads, rows, "values")]
    return blocks


def limits_of_runs(comparison: Comparison) -> Table | None:
    """Declared limits of each run with their margins, the active limit of each plan first; None without limits."""
    uses = limits_used(comparison)
    if not uses:
        return None
    heads = ["plan", "signal", "permitted range", "value nearest to the limit", "time [s]", "margin", "time at limit"]
    rows, seen = [], set[str]()
    for use in uses:
        active = "" if use.plan in seen else " (active)"
        seen.add(use.plan)
        unit = comparison.units.get(use.signal, "")
        rows.append(
            [
                use.plan,
                use.signal + active,
                f"{number(use.low)} to {number(use.high)}{f' {unit}' if unit else ''}",
                number(use.value),
                number(use.time),
                "–" if math.isnan(use.share) else f"{100.0 * use.share:.3g} %".replace("-", "−"),
                f"{100.0 * use.at_limit:.3g} %",
            ]
        )
    return Table(heads, rows, "limits")


def spread_of(ensemble: Ensemble) -> MetricsTable:
    """Metrics over draws: median, 5 % and 95 % quantile."""
    nominal, rows = ensemble.nominal, []
    for key, measure in nominal.measures.items():
        if not any(key in found for found in ensemble.metrics.values()):
            continue
        cells = []
        for plan in nominal.metrics:
            found = ensemble.quantiles(key)[plan] if key in ensemble.metrics.get(plan, {}) else _NONE
            shown = [number(without_rounding(value, nominal.scales.get(key, 0.0)), measure.unit) for value in found]
            low, _, middle, _, high = shown
            cells.append(Cell(f"{middle} ({low} to {high})", order=_order(float(found[2]))))
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
