"""Figures of plans, responses and sweeps."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import control as ct
import numpy as np
from control import ControlPlot
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from numpy.typing import NDArray

from ctrlplan.reports.style import (
    AxesLike,
    Drawing,
    Style,
    add_title,
    as_text,
    axis_styles,
    clip_steps,
    clipped_note,
    font_size,
    given_axes,
    label_y,
    legend_label,
    line_width,
    marker_size,
    plan_styles,
    roles_of,
    shade,
    thin_style,
    with_unit,
)
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.measures import SETTLING_TIMES
from ctrlplan.studies.roles import Role
from ctrlplan.studies.sections import Curves, Place
from ctrlplan.studies.sweep import Sweep, settling_jumps
from ctrlplan.studies.units import in_units, output_unit, superscript
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.repeated import one_pass

Array = NDArray[np.float64]

DERIVATIVES = ("position", "velocity", "acceleration", "jerk", "snap")

_DERIVATIVES = 2
"""Default of the highest derivative drawn."""


def plot_trajectory(
    plan: Trajectory, derivatives: int = 2, *, ax: AxesLike | None = None, units: Sequence[str] | None = None
) -> ControlPlot:
    """Position and derivatives of a trajectory, one axes each, with its waypoints.

    Parameters
    ----------
    plan : Trajectory
        The trajectory, drawn slightly beyond its start and end.
    derivatives : int, optional
        Highest derivative drawn.
    ax : Axes or array of Axes, optional
        Where to draw: an array of n axes for the derivatives 0 to n - 1, one
        axes for the position only. None: an empty current figure, or a new one.
    units : sequence of str, optional
        Units of the plan's axes.

    Returns
    -------
    control.ControlPlot
        Of shape (number of derivatives + 1, 1).

    Raises
    ------
    TypeError
        If `ax` is neither axes nor an array of them.
    ValueError
        If the number of axes in `ax` is not that of `derivatives` plus one.
    """
    names = dict(zip(plan.labels, units, strict=True)) if units is not None else {}
    rows = derivatives + 1
    if ax is not None:
        given = given_axes(ax)
        rows = given.size if derivatives == _DERIVATIVES and given.size else rows
    drawing = Drawing(ax, (rows, 1), (6.4, 1.2 + 1.5 * rows), rows=map(_derivative_word, range(rows)))
    styles = axis_styles(plan.labels, drawing.column[0])
    t = _times(plan)
    jet = plan.jet(t, rows - 1)
    for k, axes in enumerate(drawing.column):
        for a, label in enumerate(plan.labels):
            axes.plot(t, _broken(t, jet[k, a], plan), **styles[label])
            points = [(w.time, w.jet[k, a]) for w in plan.waypoints if k < len(w.jet) and not np.isnan(w.jet[k, a])]
            _circles(axes, points, styles[label]["color"], "osD^v"[a % 5])
        label_y(axes, _derivative_label(_common(names.values()), k))
    drawing.label_x("time [s]")
    several = len(drawing.column[0].get_legend_handles_labels()[0]) > 1
    return drawing.finish(legend=several)


def plot_plans(comparison: Comparison, derivatives: int = 2, *, ax: AxesLike | None = None) -> ControlPlot:
    """References and their derivatives, one column per axis and one row per derivative.

    Parameters
    ----------
    comparison : Comparison
        Whose plans are drawn.
    derivatives : int, optional
        Highest derivative drawn.
    ax : array of Axes, shape (derivatives + 1, number of axes of the plans), optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of the shape of `ax`.
    """
    first = next(iter(comparison.plans.values()))
    rows = derivatives + 1
    size = min(6.4 + 2.0 * (first.naxes - 1), 9.0), 1.4 + 1.7 * rows
    drawing = Drawing(ax, (rows, first.naxes), size, rows=map(_derivative_word, range(rows)))
    styles = plan_styles(comparison, drawing.column[0])
    start = min(p.start for p in comparison.plans.values())
    end = max(p.end for p in comparison.plans.values())
    t = np.unique(np.concatenate([_times(p, start, end) for p in comparison.plans.values()]))
    for name in comparison.simulated:
        plan = comparison.plans[name]
        jet = plan.jet(t, derivatives)
        for k, row in enumerate(drawing.axes):
            if k and not plan.duration:
                continue  # a step has no derivative to draw
            for a, axes in enumerate(row):
                axes.plot(t, _broken(t, jet[k, a], plan) if k else jet[k, a], **styles[name])
    for k, row in enumerate(drawing.axes):
        for a, axes in enumerate(row):
            given = [(w.time, w.jet[k, a]) for w in comparison.waypoints if k < len(w.jet)]
            _circles(axes, given, shade(0.73))
            unit = output_unit(comparison, comparison.outputs[a]) if a < len(comparison.outputs) else ""
            label_y(axes, _derivative_label(unit, k, first.labels[a]))
    drawing.label_x("time [s]")
    return drawing.finish()


def plot_responses(comparison: Comparison, *, ax: AxesLike | None = None) -> ControlPlot:
    """Outputs with their references, errors, and controls versus time.

    Parameters
    ----------
    comparison : Comparison
        Whose responses are drawn.
    ax : array of Axes, optional
        Where to draw: for each output one axes for it and one for its error,
        then one for each control. None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (2 noutputs + ncontrols, 1).
    """
    outputs, controls = comparison.outputs, comparison.controls
    shown = [text for output in outputs for text in (output, f"error of {output}")] + list(controls)
    drawing = Drawing(ax, (len(shown), 1), (7.0, 1.4 + 1.9 * len(shown)), rows=shown)
    rows = drawing.column
    styles = plan_styles(comparison, rows[0])
    for name, plan in comparison.plans.items():
        t, signals = np.asarray(comparison.responses[name].time), comparison.signals(name)
        reference = plan.jet(t, 0)[0]
        for a, output in enumerate(outputs):
            y = signals[output]
            if name not in comparison.measured:
                rows[2 * a].plot(t, reference[a], **thin_style(styles[name]))
            rows[2 * a].plot(t, y, **styles[name])
            rows[2 * a + 1].plot(t, reference[a] - y, **styles[name])
        for c, control in enumerate(controls):
            rows[2 * len(outputs) + c].plot(t, signals[control], **styles[name])
    for axes in rows:
        clip_steps(axes, roles_of(comparison))
    for a, output in enumerate(outputs):
        unit = output_unit(comparison, output)
        label_y(rows[2 * a], with_unit(output, unit))
        add_title(rows[2 * a], "output (thin: reference)")
        label_y(rows[2 * a + 1], with_unit(f"error of {output}", unit))
    for c, control in enumerate(controls):
        label_y(rows[2 * len(outputs) + c], with_unit(control, comparison.units.get(control, "")))
    drawing.label_x("time [s]")
    return drawing.finish()


def plot_sweep(
    sweep: Sweep, names: Sequence[str] = ("settling_time", "overshoot_error"), *, ax: AxesLike | None = None
) -> ControlPlot:
    """Metrics versus the parameter, with gaps where a settling time is discontinuous.

    Parameters
    ----------
    sweep : Sweep
        What is drawn.
    names : sequence of str, optional
        Metrics, an axes each.
    ax : array of Axes, shape (number of metrics,), optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (number of metrics, 1).
    """
    columns = 2 if len(names) > 1 else 1
    size = 4.0 * columns + 0.4, 0.8 + 2.5 * -(-len(names) // columns)
    drawing = Drawing(ax, (len(names), 1), size, rows=names, wrap=columns)
    styles = plan_styles(sweep, drawing.column[0])
    for name, axes in zip(names, drawing.column, strict=True):
        columns_of = {plan: sweep.column(plan, name) for plan in sweep.metrics}
        for plan, row in columns_of.items():
            x, y = sweep.values, row
            if name in SETTLING_TIMES:
                x, y = _with_gaps(x, y)
            axes.plot(x, y, **styles[plan])
        label_y(axes, with_unit(sweep.title_of(name), sweep.unit_of(name)))
        finite = np.concatenate([row[np.isfinite(row)] for row in columns_of.values()])
        if finite.size and finite.min() > 0.0 and finite.max() > 100.0 * finite.min():
            axes.set_yscale("log")
        if sweep.values[0] > 0.0 and sweep.values[-1] > 20.0 * sweep.values[0]:
            axes.set_xscale("log")
        clip_steps(axes, roles_of(sweep))
    drawing.label_x(as_text(sweep.parameter))
    return drawing.finish()


def plot_bands(ensemble: Ensemble, *, ax: AxesLike | None = None) -> ControlPlot:
    """Quantiles of outputs, errors and controls over draws: 5 to 95 %, 25 to 75 %, and the median.

    Parameters
    ----------
    ensemble : Ensemble
        What is drawn.
    ax : array of Axes, shape (2 noutputs + ncontrols, nplans), optional
        Where to draw: a column for each plan, a row for each output, its error
        and each control. None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of the shape of `ax`.
    """
    nominal = ensemble.nominal
    shown = [(signal, error) for signal in nominal.outputs for error in (False, True)]
    shown += [(signal, False) for signal in nominal.controls if signal not in nominal.outputs]
    size = max(4.4, 2.9 * len(nominal.plans) + 0.6), 1.2 + 1.7 * len(shown)
    titles = [f"error of {signal}" if error else signal for signal, error in shown]
    drawing = Drawing(ax, (len(shown), len(nominal.plans)), size, rows=titles)
    styles = {  # by plan: different from the curves of its axes
        plan: plan_styles(nominal, axes)[plan] for plan, axes in zip(nominal.plans, drawing.axes[0], strict=True)
    }
    for row, (signal, error) in zip(drawing.axes, shown, strict=True):
        _plot_bands_of(ensemble, row, signal, error, styles)
        unit = output_unit(nominal, signal) if signal in nominal.outputs else nominal.units.get(signal, "")
        for axes in row:
            label_y(axes, with_unit(f"error of {signal}" if error else signal, unit))
    for axes, plan in zip(drawing.axes[0], nominal.plans, strict=True):
        if not axes.get_title():
            axes.set_title(as_text(plan), fontsize=font_size(9))
    drawing.label_x("time [s]")
    return drawing.finish()


def _plot_bands_of(
    ensemble: Ensemble, row: NDArray[np.object_], signal: str, error: bool, styles: dict[str, Style]
) -> None:
    """Bands of one signal or its error, one axes per plan."""
    nominal, t = ensemble.nominal, ensemble.timepts
    extent = [np.array(axes.get_ylim()) for axes in row if axes.lines]  # of bands that were drawn before
    ranges: dict[str, Array] = {}
    roles = roles_of(nominal)
    for axes, (plan, reference) in zip(row, nominal.plans.items(), strict=True):
        band = ensemble.bands.get(plan, {}).get(signal)
        target = reference.jet(t, 0)[0, nominal.outputs.index(signal)] if signal in nominal.outputs else None
        if target is not None and not error:
            axes.plot(t, target, color=shade(0.73), linewidth=line_width(0.5), linestyle=(0, (4, 2)), label="reference")
        if band is None:
            continue
        if error and target is not None:
            band = target - band[::-1]
        colour = styles[plan]["color"]
        axes.fill_between(t, band[0], band[4], color=colour, alpha=0.2, linewidth=0, label="5 to 95 %")
        axes.fill_between(t, band[1], band[3], color=colour, alpha=0.35, linewidth=0, label="25 to 75 %")
        axes.plot(t, band[2], color=colour, linewidth=line_width(0.7), label="median")
        ranges[plan] = band[np.isfinite(band)]
    # One scale a row, so that the plans can be compared, set by those that are no steps.
    planned = [values for plan, values in ranges.items() if roles[plan] is not Role.STEP]
    extent += planned or list(ranges.values())
    if extent and np.concatenate(extent).size:
        low, high = np.min(np.concatenate(extent)), np.max(np.concatenate(extent))
        margin = 0.05 * (high - low) or 0.5
        for axes, plan in zip(row, nominal.plans, strict=True):
            axes.set_ylim(low - margin, high + margin)
            values = ranges.get(plan, np.empty(0))
            if values.size and max(low - values.min(), values.max() - high) > margin:
                add_title(axes, clipped_note(values[np.abs(values).argmax()]))


def plot_plane(
    sweep: Sweep,
    *,
    numbered: Mapping[str, Mapping[float, Place]] | None = None,
    limit: tuple[float, float] | None = None,
    limit_label: str = "limit",
    further: Mapping[str, tuple[float, float]] | None = None,
    ax: AxesLike | None = None,
) -> ControlPlot:
    """Settling time versus overshoot on the tracking error, one point per value.

    Parameters
    ----------
    sweep : Sweep
        With the metrics "settling_time" and "overshoot_error".
    numbered : mapping of str to mapping of float to (float, float), optional
        Plan, value of the parameter, offset: values that are written next to
        their points, so far to the right and up [pt].
    limit : (float, float), optional
        Settling time [s] and overshoot [%] of a point to be marked.
    limit_label : str, optional
        What that point is.
    further : mapping of str to (float, float), optional
        Further points to be marked, by what they are.
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).

    Raises
    ------
    ValueError
        If a plan or a value to be numbered is not in the sweep.
    """
    drawing = Drawing(ax, (1, 1), (6.8, 5.2))
    (axes,) = drawing.column
    styles = plan_styles(sweep, axes)
    for plan, rows in sweep.metrics.items():
        ts, overshoot = rows["settling_time"], rows["overshoot_error"]
        x, gap = _with_gaps(sweep.values, ts)
        whole = styles[plan] | {"linestyle": "-", "linewidth": line_width(0.65)}
        axes.plot(gap, np.interp(x, sweep.values, overshoot), **whole)
        dots = {"color": styles[plan]["color"], "markersize": marker_size(2.5), "markevery": 0.006}
        axes.plot(ts, overshoot, ".", **dots)  # values that are closer than a dot are one on a screen
    for plan, places in (numbered or {}).items():
        if plan not in sweep.metrics:
            raise ValueError(f"numbered must be of plans of the sweep ({', '.join(sweep.metrics)}), got {plan!r}")
        for value, place in places.items():
            _number_point(axes, sweep, plan, value, place, styles[plan]["color"])
    if limit is not None:
        _mark_point(axes, limit, limit_label)
    for label, point in (further or {}).items():
        _mark_point(axes, point, label)
    if numbered:
        add_title(axes, as_text(f"numbers at the circles: {sweep.parameter}"))
    drawing.label_x(f"settling time ±{100.0 * sweep.band:g} % [s]")
    label_y(axes, "overshoot on the tracking error [%]")
    axes.set_xlim(left=0.0)
    axes.set_ylim(-6.0, 108.0)
    return drawing.finish()


_LIMIT_POINT = "#E69F00"


def _mark_point(axes: Axes, point: tuple[float, float], label: str) -> None:
    """Star at a limit point, and what it is to the right of it."""
    axes.plot(*point, "*", color=_LIMIT_POINT, markersize=marker_size(12), zorder=5)
    text = axes.annotate(as_text(label), point, xytext=(9, -2), textcoords="offset points", fontsize=font_size(8))
    text.set_bbox({"facecolor": axes.get_facecolor(), "edgecolor": "none", "alpha": 0.75, "pad": 1.0})


def _number_point(axes: Axes, sweep: Sweep, plan: str, value: float, place: Place, colour: str) -> None:
    """Circle at the point of a value, with the value as label."""
    at = int(np.argmin(np.abs(sweep.values - value)))
    if not np.isclose(sweep.values[at], value, rtol=1e-9, atol=0.0):
        near = f"{sweep.values[at]:g} is the nearest"
        raise ValueError(f"numbered must be of values of the sweep, got {value:g} for {plan}; {near}")
    point = float(sweep.metrics[plan]["settling_time"][at]), float(sweep.metrics[plan]["overshoot_error"][at])
    axes.plot(*point, "o", color=colour, mfc=axes.get_facecolor(), markersize=marker_size(5), zorder=4)
    axes.annotate(
        f"{value:.4g}",
        point,
        xytext=place,
        textcoords="offset points",
        fontsize=font_size(8),
        color=colour,
        ha="center",
        va="center",
        arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 1, "shrinkB": 3},
    )


def plot_curves(curves: Curves, *, ax: AxesLike | None = None) -> ControlPlot:
    """Curves versus one variable.

    Parameters
    ----------
    curves : Curves
        What is drawn.
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    drawing = Drawing(ax, (1, 1), (7.0, 3.8))
    (axes,) = drawing.column
    names = list(curves.rows)
    each = 2 if curves.paired else 1
    colours = [style["color"] for style in axis_styles(names[::each], axes).values()]
    for i, (name, row) in enumerate(curves.rows.items()):
        style = "-" if i % 2 == 0 else (0, (5, 1.5))
        axes.plot(curves.x, row, color=colours[i // each], linestyle=style, label=legend_label(name))
    if curves.log:
        axes.set_yscale("log")
    drawing.label_x(as_text(curves.x_label))
    label_y(axes, as_text(curves.y_label))
    return drawing.finish()


def plot_blocks(
    loop: ct.InterconnectedSystem, titles: Mapping[str, str] | None = None, *, ax: AxesLike | None = None
) -> ControlPlot:
    """Block diagram of a loop, with each block to the right of its predecessors.

    Parameters
    ----------
    loop : control.InterconnectedSystem
        Whose blocks are in the order of the signal path; a connection to an
        earlier block is feedback, and is drawn around the others.
    titles : mapping of str to str, optional
        What is written in place of a block's name.
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    joined = _connections(loop)
    place = _places([block.name for block in loop.syslist], list(joined))
    drawing = Drawing(ax, (1, 1), (8.4, 3.2))
    (axes,) = drawing.column
    edge = shade(0.8)
    axes.axis("off")
    for name, (x, y) in place.items():
        box = FancyBboxPatch((x - 0.75, y - 0.35), 1.5, 0.7, boxstyle="round,pad=0.02", fc=shade(0.045), ec=edge)
        axes.add_patch(box)
        axes.text(x, y, as_text((titles or {}).get(name, name)), ha="center", va="center", fontsize=font_size(9))
    for (source, sink), signals in joined.items():
        text = ", ".join(signals) if len(signals) < 3 else f"{signals[0]} … {signals[-1]}"
        _arrow(axes, place[source], place[sink], as_text(text))
    corners = np.array(list(place.values()))
    axes.set_xlim(-0.9, corners[:, 0].max() + 0.9)
    axes.set_ylim(corners[:, 1].min() - 1.3, corners[:, 1].max() + 1.3)
    return drawing.finish(legend=False)


def _connections(loop: ct.InterconnectedSystem) -> dict[tuple[str, str], list[str]]:
    """Signals of a loop by the blocks that they connect."""
    joined: dict[tuple[str, str], list[str]] = {}
    into = [block for block in loop.syslist for _ in block.input_labels]
    out = [(block, label) for block in loop.syslist for label in block.output_labels]
    for row, column in np.argwhere(np.asarray(loop.connect_map) != 0.0):
        source, signal = out[column]
        joined.setdefault((source.name, into[row].name), []).append(signal)
    return joined


def _places(names: Sequence[str], joined: Collection[tuple[str, str]]) -> dict[str, tuple[float, float]]:
    """Centres of blocks, each one column to the right of its last predecessor."""
    columns: dict[str, int] = {}
    for name in names:
        before = [columns[source] for source, sink in joined if sink == name and source in columns]
        columns[name] = max(before, default=-1) + 1
    place = {}
    for column in sorted(set(columns.values())):
        stacked = [name for name in names if columns[name] == column]
        for row, name in enumerate(stacked):
            place[name] = (2.6 * column, 0.8 * (len(stacked) - 1 - 2 * row))
    return place


def _arrow(axes: Axes, source: tuple[float, float], sink: tuple[float, float], text: str) -> None:
    """Arrow from block to block with its signals; feedback passes around the blocks between."""
    (x0, y0), (x1, y1) = source, sink
    if x1 > x0:
        start, end = (x0 + 0.78, y0 + 0.15 * np.sign(y1 - y0)), (x1 - 0.78, y1 + 0.15 * np.sign(y0 - y1))
        style, at = "arc3", (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]) + 0.14)
    else:
        side = 1.0 if y1 > 0.0 else -1.0
        if source == sink:
            x0, x1 = x0 + 0.5, x1 - 0.5
        start, end, style = (x0, y0 + 0.38 * side), (x1, y1 + 0.38 * side), f"arc3,rad={0.5 * side}"
        at = (0.5 * (x0 + x1), y1 + 0.98 * side)
    edge = shade(0.8)
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=edge, connectionstyle=style))
    axes.text(*at, text, ha="center", va="center", fontsize=font_size(8), color=shade(0.6))


def _times(plan: Trajectory, start: float | None = None, end: float | None = None) -> Array:
    """Times to draw a trajectory: dense, beyond its ends, and on both sides of every breakpoint."""
    plan = one_pass(plan)
    first, last = plan.start if start is None else start, plan.end if end is None else end
    margin = 0.06 * (last - first) or 0.5
    t = np.linspace(first - margin, last + margin, 1001)
    near = [np.nextafter(plan.breakpoints, side) for side in (-np.inf, np.inf)]
    return np.unique(np.concatenate([t, plan.breakpoints, *near]))


def _broken(t: Array, values: Array, plan: Trajectory) -> Array:
    """Values with nan where a derivative jumps, so that the jump is not connected by a line."""
    out = values.copy()
    span = np.ptp(values) or 1.0
    for moment in plan.breakpoints:
        at = int(np.searchsorted(t, moment))
        if 0 < at < t.size and abs(values[at] - values[at - 1]) > 1e-3 * span:
            out[at - 1] = np.nan
        if at + 1 < t.size and abs(values[at + 1] - values[at]) > 1e-3 * span:
            out[at + 1] = np.nan
    return out


def _with_gaps(x: Array, y: Array) -> tuple[Array, Array]:
    """Curve with nan where a settling time is discontinuous."""
    where = np.flatnonzero(settling_jumps(x, y)) + 1
    return np.insert(x, where, 0.5 * (x[where - 1] + x[where])), np.insert(y, where, np.nan)


def _circles(axes: Axes, points: Sequence[tuple[float, float]], colour: str, marker: str = "o") -> None:
    """Prescribed values, which ``legend([...])`` and the plots of python-control do not treat as curves."""
    if points:
        t, values = np.transpose(points)
        size, face = marker_size(5) ** 2, axes.get_facecolor()
        circles = axes.scatter(t, values, s=size, marker=marker, edgecolors=colour, facecolors=face, zorder=5)
        circles.set_label("_nolegend_")


def _derivative_word(order: int) -> str:
    return DERIVATIVES[order] if order < len(DERIVATIVES) else f"derivative {order}"


def _derivative_label(unit: str, order: int, name: str = "") -> str:
    word = _derivative_word(order)
    suffix = ("" if order == 0 else "/s" if order == 1 else f"/s{superscript(order)}") if unit or order else ""
    label = f"{name} {word}".strip()
    if not suffix:
        return with_unit(label, unit)
    return with_unit(label, in_units("{y}/", unit or "1", "").removesuffix("/"), suffix)


def _common(units: Iterable[str]) -> str:
    found = set(units)
    return found.pop() if len(found) == 1 else ""
