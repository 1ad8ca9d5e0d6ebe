"""Figures of what was chosen: alpha, durations within limits, plans with their baselines."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from control import ControlPlot
from numpy.typing import NDArray

from ctrlplan.planning import AlphaChoice
from ctrlplan.planning.limits import Limited
from ctrlplan.reports.style import (
    AxesLike,
    Drawing,
    Style,
    add_title,
    as_text,
    axis_styles,
    clip_steps,
    label_y,
    line_width,
    marker_size,
    plan_styles,
    roles_of,
    shade,
    with_unit,
)
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.units import output_unit
from ctrlplan.trajectories import Trajectory

Array = NDArray[np.float64]

_LIMIT = "#8a3c00"

_ROUNDING = 1e-12
"""Range of a signal relative to its magnitude that counts as rounding."""


def plot_alpha_choice(choice: AlphaChoice, *, ax: AxesLike | None = None) -> ControlPlot:
    """Objective versus alpha up to the value where it diverges, with the choice marked.

    Parameters
    ----------
    choice : AlphaChoice
        The choice.
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    drawing = Drawing(ax, (1, 1), (6.4, 3.4))
    (axes,) = drawing.column
    curve, mark = axis_styles(("curve", "mark"), axes).values()
    shown = np.isfinite(choice.values) & (choice.alphas < choice.blow_up)
    axes.plot(choice.alphas[shown], choice.values[shown], **curve | {"label": None})
    label = f"alpha = {choice.alpha:.4g} rad"
    axes.plot(choice.alpha, choice.value, "o", color=mark["color"], markersize=marker_size(7), label=label)
    values = choice.values[shown]
    if values.min() > 0.0 and values.max() > 30.0 * values.min():
        axes.set_yscale("log")
    axes.set_xlim(0.0, 2.0 * np.pi)
    if choice.blow_up < 2.0 * np.pi:
        axes.axvspan(choice.blow_up, 2.0 * np.pi, color=shade(0.133), label="diverges")
    drawing.label_x("alpha [rad] (0: polynomial)")
    label_y(axes, as_text(choice.objective.replace("_", " ")))
    return drawing.finish()


def plot_limits(
    plan: Trajectory, limited: Limited, units: Mapping[str, str] | None = None, *, ax: AxesLike | None = None
) -> ControlPlot:
    """Limited signals of a plan versus time, with their limits and the points of minimum margin.

    Parameters
    ----------
    plan : Trajectory
        The plan, drawn from its start to its end, and further to extrema of
        signals of a loop after it.
    limited : Limited
        Its limits.
    units : mapping of str to str, optional
        Units by the signals' names.
    ax : array of Axes, shape (number of limits,), optional
        Where to draw, in the order of the limits; None: an empty current
        figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (number of limits, 1).
    """
    bounds = limited.bounds
    drawing = Drawing(ax, (len(bounds), 1), (6.4, 0.9 + 1.5 * len(bounds)), rows=[bound.name for bound in bounds])
    rows = list(limited.margins(plan))
    after = [row.time + 0.1 * plan.duration for row in rows if row.bound.in_loop and math.isfinite(row.time)]
    t = np.linspace(plan.start, max([plan.end, *after]), 2001)
    for axes, bound, row in zip(drawing.column, bounds, limited.shown(plan, t), strict=True):
        (style,) = axis_styles((bound.name,), axes).values()
        axes.plot(t, row, **style)
        margin = next(found for found in rows if found.of(bound))
        if margin.time <= t[-1]:
            axes.plot(margin.time, margin.value, "o", color=_LIMIT, markersize=marker_size(5))
        span, size = float(np.ptp(row)), float(np.abs(row).max())
        span = span if span > _ROUNDING * size else size or 1.0
        for side in limited.sides(bound, plan, t):
            # A distant limit would flatten the curve; the title gives its value.
            near = np.minimum(np.abs(side - row.min()), np.abs(side - row.max())) < 1.5 * span
            if (shown := np.isfinite(side) & near).any():
                over = (t, np.where(shown, side, np.nan)) if np.ptp(side) else (t[[0, -1]], side[[0, -1]])
                axes.plot(*over, color=_LIMIT, linestyle=(0, (4, 2)), linewidth=line_width(0.65))
        label_y(axes, with_unit(bound.name, (units or {}).get(bound.name)))
        add_title(axes, as_text(f"{bound.range}; {margin.room}"))
    drawing.label_x("time [s]")
    return drawing.finish(legend=False)


def plot_baselines(
    comparison: Comparison, *, known: Mapping[str, Style] | None = None, ax: AxesLike | None = None
) -> ControlPlot:
    """References, responses of the loop and controls, with one column per axis.

    Parameters
    ----------
    comparison : Comparison
        Of plans through the same waypoints.
    known : mapping of str to dict, optional
        Styles of plans that other figures of the page show, from `line_styles`.
    ax : array of Axes, shape (2 + ncontrols, noutputs), optional
        Where to draw; controls use the first column. None: an empty current
        figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of the shape of `ax`.
    """
    outputs, controls = comparison.outputs, comparison.controls
    columns = max(len(outputs), 1)
    size = min(6.4 + 2.4 * (columns - 1), 9.0), 1.4 + 2.0 * (2 + len(controls))
    drawing = Drawing(ax, (2 + len(controls), columns), size, rows=("references", "outputs", *controls))
    grid = drawing.axes
    styles = plan_styles(comparison, grid[0, 0], known)
    for name, plan in comparison.plans.items():
        response = comparison.responses[name]
        t = np.asarray(response.time)
        signals = dict(zip(response.output_labels, np.asarray(response.outputs).reshape(-1, t.size), strict=True))
        reference = plan.jet(t, 0)[0]
        for a, output in enumerate(outputs):
            grid[0, a].plot(t, reference[a], **styles[name])
            grid[1, a].plot(t, signals[output], **styles[name])
        for c, control in enumerate(controls):
            grid[2 + c, 0].plot(t, signals[control], **styles[name])
    for a, output in enumerate(outputs):
        unit = output_unit(comparison, output)
        clip_steps(grid[1, a], roles_of(comparison))
        label_y(grid[0, a], with_unit(f"reference of {output}", unit))
        label_y(grid[1, a], with_unit(output, unit))
    for c, control in enumerate(controls):
        label_y(grid[2 + c, 0], with_unit(control, comparison.units.get(control, "")))
        clip_steps(grid[2 + c, 0], roles_of(comparison))
        if ax is None:
            for axes in grid[2 + c, 1:]:
                axes.set_visible(False)
    drawing.label_x("time [s]")
    return drawing.finish()
