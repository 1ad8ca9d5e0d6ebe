"""Figures of what was chosen: alpha, durations under limits, plans beside their rivals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ctrlplan.planning import AlphaChoice
from ctrlplan.planning.limits import Limited
from ctrlplan.reports.style import as_text, house_style, legend_above, line_styles, new_figure, stacked_axes, with_unit
from ctrlplan.studies.comparison import Comparison
from ctrlplan.trajectories import Trajectory

Array = NDArray[np.float64]

_LIMIT = "#8a3c00"


@house_style
def plot_alpha_choice(choice: AlphaChoice) -> Figure:
    """Objective over alpha up to where it blows up, the choice marked."""
    figure = new_figure(6.4, 3.4)
    ((axes,),) = stacked_axes(figure, 1)
    shown = np.isfinite(choice.values) & (choice.alphas < choice.blow_up)
    axes.plot(choice.alphas[shown], choice.values[shown], color="#0072B2")
    axes.plot(choice.alpha, choice.value, "o", color="#D55E00", markersize=7, label=f"alpha = {choice.alpha:.4g} rad")
    values = choice.values[shown]
    if values.min() > 0.0 and values.max() > 30.0 * values.min():
        axes.set_yscale("log")
    axes.set_xlim(0.0, 2.0 * np.pi)
    if choice.blow_up < 2.0 * np.pi:
        axes.axvspan(choice.blow_up, 2.0 * np.pi, color="#dddddd", label="blows up")
    axes.set_xlabel("alpha [rad] (0: polynomial)")
    axes.set_ylabel(as_text(choice.objective.replace("_", " ")))
    legend_above(figure, axes)
    return figure


@house_style
def plot_limits(plan: Trajectory, limited: Limited, units: Mapping[str, str] | None = None) -> Figure:
    """Every limited signal of a plan over time, with its limits and where it comes nearest to them."""
    bounds = limited.bounds
    figure = new_figure(6.4, 0.9 + 1.5 * len(bounds))
    rows = [axes for (axes,) in stacked_axes(figure, len(bounds))]
    t = np.linspace(plan.start, plan.end, 2001)
    values = limited.values(plan.jet(t, limited.order))
    nearest = {row.bound.name: row for row in limited.margins(plan)}
    for axes, bound, row in zip(rows, bounds, values, strict=True):
        axes.plot(t, row, color="#0072B2")
        margin = nearest[bound.name]
        axes.plot(margin.time, margin.value, "o", color=_LIMIT, markersize=5)
        span = float(np.ptp(row)) or abs(float(row[0])) or 1.0
        for side in (bound.low, bound.high):
            # A limit far away would flatten the curve: it is named in the title instead.
            if np.isfinite(side) and min(abs(side - row.min()), abs(side - row.max())) < 1.5 * span:
                axes.axhline(side, color=_LIMIT, linestyle=(0, (4, 2)), linewidth=1.0)
        axes.set_ylabel(with_unit(bound.name, (units or {}).get(bound.name)))
        axes.set_title(as_text(f"{bound.range}; {margin.room}"), loc="left", fontsize=8)
    rows[-1].set_xlabel("time [s]")
    return figure


@house_style
def plot_rivals(comparison: Comparison) -> Figure:
    """References above what the loop makes of them, an axis a column, and the controls below."""
    styles = line_styles(comparison.plans)
    outputs, controls = comparison.outputs, comparison.controls
    columns = max(len(outputs), 1)
    figure = new_figure(min(6.4 + 2.4 * (columns - 1), 9.0), 1.4 + 2.0 * (2 + len(controls)))
    grid = stacked_axes(figure, 2 + len(controls), columns)
    for name, plan in comparison.plans.items():
        response = comparison.responses[name]
        t = np.asarray(response.time)
        signals = dict(zip(response.output_labels, np.asarray(response.outputs).reshape(-1, t.size), strict=True))
        reference = plan.jet(t, 0)[0]
        for a, output in enumerate(outputs):
            grid[0][a].plot(t, reference[a], **styles[name])
            grid[1][a].plot(t, signals[output], **styles[name])
        for c, control in enumerate(controls):
            grid[2 + c][0].plot(t, signals[control], **styles[name])
    for a, output in enumerate(outputs):
        unit = comparison.units.get(output, "")
        grid[0][a].set_ylabel(with_unit(f"reference of {output}", unit))
        grid[1][a].set_ylabel(with_unit(output, unit))
    for c, control in enumerate(controls):
        grid[2 + c][0].set_ylabel(with_unit(control, comparison.units.get(control, "")))
        _clip(grid[2 + c][0], comparison, control)
        for axes in grid[2 + c][1:]:
            axes.set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    legend_above(figure, grid[0][0])
    return figure


def _clip(axes: object, comparison: Comparison, control: str) -> None:
    """Leave out what a step asks for where it is far beyond the others: they would be flat lines."""
    peaks = {
        name: float(np.abs(np.asarray(response.outputs)[list(response.output_labels).index(control)]).max())
        for name, response in comparison.responses.items()
    }
    step, rest = peaks.pop("step", 0.0), max(peaks.values(), default=0.0)
    if rest and step > 4.0 * rest:
        axes.set_ylim(-1.3 * rest, 1.3 * rest)  # type: ignore[attr-defined]
        axes.set_title(f"the step asks for {step:.3g}", loc="left", fontsize=8)  # type: ignore[attr-defined]
