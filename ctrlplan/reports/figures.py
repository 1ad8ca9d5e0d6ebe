"""Figures of plans, responses and sweeps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from control import ControlPlot
from matplotlib.axes import Axes
from numpy.typing import NDArray

from ctrlplan.reports.crane_figures import CRANE_FIGURES
from ctrlplan.reports.style import (
    AxesLike,
    Drawing,
    add_title,
    as_text,
    axis_styles,
    font_size,
    given_axes,
    label_y,
    line_width,
    marker_size,
    plan_styles,
    shade,
    with_unit,
)
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.linear import STEP_LIMIT, jumps
from ctrlplan.studies.measures import MEASURES
from ctrlplan.studies.study import Study
from ctrlplan.studies.sweep import Sweep
from ctrlplan.studies.units import in_units
from ctrlplan.trajectories import Trajectory

Array = NDArray[np.float64]

DERIVATIVES = ("position", "velocity", "acceleration", "jerk", "snap")

_DERIVATIVES = 2
"""Highest derivative drawn where a user states none and gives no axes."""


def plot_trajectory(
    plan: Trajectory, derivatives: int = 2, *, ax: AxesLike | None = None, units: Sequence[str] | None = None
) -> ControlPlot:
    """Position and derivatives of one trajectory stacked, waypoints marked.

    Parameters
    ----------
    plan : Trajectory
        What is drawn, from a little before its start to a little after its end.
    derivatives : int, optional
        Highest derivative drawn.
    ax : Axes or array of Axes, optional
        Where to draw: an array of n axes gets the derivatives 0 to n - 1, one
        axes the position only. None: an empty current figure, or a new one.
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
        If `ax` has not one axes for each of the `derivatives` stated.
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
    """References side by side: a column an axis, a row a derivative.

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
    size = min(6.4 + 2.0 * (first.naxes - 1), 9.0), 1.4 + 1.6 * rows
    drawing = Drawing(ax, (rows, first.naxes), size, rows=map(_derivative_word, range(rows)))
    styles = plan_styles(comparison.plans, drawing.column[0])
    start = min(p.start for p in comparison.plans.values())
    end = max(p.end for p in comparison.plans.values())
    t = np.unique(np.concatenate([_times(p, start, end) for p in comparison.plans.values()]))
    for name, plan in comparison.plans.items():
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
            label_y(axes, _derivative_label(comparison.units.get(first.labels[a], ""), k, first.labels[a]))
    drawing.label_x("time [s]")
    return drawing.finish()


def plot_responses(comparison: Comparison, *, ax: AxesLike | None = None) -> ControlPlot:
    """Outputs with their references, errors, and controls over time.

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
    styles = plan_styles(comparison.plans, rows[0])
    for name, plan in comparison.plans.items():
        response = comparison.responses[name]
        t = np.asarray(response.time)
        signals = np.asarray(response.outputs).reshape(-1, t.size)
        labels = list(response.output_labels)
        reference = plan.jet(t, 0)[0]
        for a, output in enumerate(outputs):
            y = signals[labels.index(output)]
            rows[2 * a].plot(t, reference[a], color=styles[name]["color"], linewidth=line_width(0.45), alpha=0.6)
            rows[2 * a].plot(t, y, **styles[name])
            rows[2 * a + 1].plot(t, reference[a] - y, **styles[name])
        for c, control in enumerate(controls):
            rows[2 * len(outputs) + c].plot(t, signals[labels.index(control)], **styles[name])
    first = next(iter(comparison.plans.values()))
    for a, output in enumerate(outputs):
        unit = comparison.units.get(first.labels[a], comparison.units.get(output, ""))
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
    """Metrics over the parameter, lines broken where a settling time jumps.

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
    styles = plan_styles(sweep.metrics, drawing.column[0])
    for name, axes in zip(names, drawing.column, strict=True):
        for plan, rows in sweep.metrics.items():
            x, y = sweep.values, rows[name]
            if name.endswith("settling_time"):
                x, y = _with_gaps(x, y)
            axes.plot(x, y, **styles[plan])
        measure = MEASURES.get(name)
        label_y(
            axes, with_unit(measure.title, "" if "{" in measure.unit else measure.unit) if measure else as_text(name)
        )
        finite = np.concatenate([r[name][np.isfinite(r[name])] for r in sweep.metrics.values()])
        if finite.size and finite.min() > 0.0 and finite.max() > 100.0 * finite.min():
            axes.set_yscale("log")
        if sweep.values[0] > 0.0 and sweep.values[-1] > 20.0 * sweep.values[0]:
            axes.set_xscale("log")
    drawing.label_x(as_text(sweep.parameter))
    return drawing.finish()


def plot_bands(ensemble: Ensemble, *, ax: AxesLike | None = None) -> ControlPlot:
    """Quantiles over the draws of outputs, errors and controls: 5 to 95 %, 25 to 75 %, and the median.

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
    styles = {  # a column a plan: told apart from what that has
        plan: plan_styles(nominal.plans, axes)[plan] for plan, axes in zip(nominal.plans, drawing.axes[0], strict=True)
    }
    for row, (signal, error) in zip(drawing.axes, shown, strict=True):
        _plot_bands_of(ensemble, row, signal, error, styles)
        label = signal
        if signal in nominal.outputs:
            label = next(iter(nominal.plans.values())).labels[nominal.outputs.index(signal)]
        unit = nominal.units.get(signal, nominal.units.get(label, ""))
        for axes in row:
            label_y(axes, with_unit(f"error of {signal}" if error else signal, unit))
    for axes, plan in zip(drawing.axes[0], nominal.plans, strict=True):
        if not axes.get_title():
            axes.set_title(as_text(plan), fontsize=font_size(9))
    drawing.label_x("time [s]")
    return drawing.finish()


def _plot_bands_of(
    ensemble: Ensemble, row: NDArray[np.object_], signal: str, error: bool, styles: dict[str, dict[str, Any]]
) -> None:
    """Bands of one signal, or of its error, an axes a plan."""
    nominal, t = ensemble.nominal, ensemble.timepts
    extent = [np.array(axes.get_ylim()) for axes in row if axes.lines]  # of bands that were drawn before
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
        extent.append(band[np.isfinite(band)])
    # One scale a row, so that the plans can be compared.
    if extent and np.concatenate(extent).size:
        low, high = np.min(np.concatenate(extent)), np.max(np.concatenate(extent))
        margin = 0.05 * (high - low) or 0.5
        for axes in row:
            axes.set_ylim(low - margin, high + margin)


def plot_plane(sweep: Sweep, *, ax: AxesLike | None = None) -> ControlPlot:
    """Figure 1: the settling-time/overshoot plane, each point a gain.

    Parameters
    ----------
    sweep : Sweep
        What is drawn.
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    drawing = Drawing(ax, (1, 1), (6.8, 5.2))
    (axes,) = drawing.column
    styles = plan_styles(sweep.metrics, axes)
    numbered = _NUMBERED if _of_the_paper(sweep) else {}
    for plan, rows in sweep.metrics.items():
        ts, overshoot = rows["settling_time"], rows["overshoot_error"]
        x, gap = _with_gaps(sweep.values, ts)
        colour = styles[plan]["color"]
        whole = styles[plan] | {"linestyle": "-", "linewidth": line_width(0.65)}
        axes.plot(gap, np.interp(x, sweep.values, overshoot), **whole)
        axes.plot(ts, overshoot, ".", color=colour, markersize=marker_size(2.5))
        # Only a few plans are numbered, or the numbers would overprint.
        for gain, offset in numbered.get(plan, {}).items():
            at = int(np.argmin(np.abs(sweep.values - gain)))
            circle: dict[str, Any] = {"mfc": axes.get_facecolor(), "markersize": marker_size(5), "zorder": 4}
            axes.plot(ts[at], overshoot[at], "o", color=colour, **circle)
            axes.annotate(
                f"{sweep.values[at]:.4g}",
                (ts[at], overshoot[at]),
                xytext=offset,
                textcoords="offset points",
                fontsize=font_size(8),
                color=colour,
                ha="center",
                va="center",
                arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 1, "shrinkB": 3},
            )
    if numbered:
        star: dict[str, Any] = {"color": "#E69F00", "markersize": marker_size(13), "zorder": 5}
        axes.plot(*STEP_LIMIT, "*", label="limit of the step, k → ∞", **star)
        add_title(axes, "numbers at the circles: gain k")
    drawing.label_x("settling time ±2 % [s]")
    label_y(axes, "overshoot on the error [%]")
    axes.set_xlim(left=0.0)
    axes.set_ylim(-4.0, 108.0)
    return drawing.finish()


def _of_the_paper(sweep: Sweep) -> bool:
    """Whether a sweep is of the paper's loop, k/(s (s + 1)) in unity feedback, of which gains and limit are known."""
    found = sweep.metrics.get("step", {}).get("overshoot_error")
    swings = sweep.values > 0.25
    if found is None or not swings.any():
        return False
    known = 100.0 * np.exp(-np.pi / np.sqrt(4.0 * sweep.values[swings] - 1.0))
    return bool(np.all(np.abs(found[swings] - known) < 0.1))


# Where the gains of the table stand beside their circles, in points.
_NUMBERED = {
    "step": {1.0: (-26, -4), 5.0: (-34, 12), 20.0: (-34, 0), 100.0: (-34, 0), 1000.0: (-36, 2)},
    "trigonometric": {1.0: (26, 4), 5.0: (30, 0), 20.0: (44, 22), 100.0: (-14, 12), 1000.0: (24, 9)},
}


FIGURES: dict[str, tuple[Callable[[Study], ControlPlot], str]] = {
    "plane": (
        lambda study: plot_plane(_sweep(study)),
        "Settling time against overshoot on the error as the gain runs from 0.25 to 1000 (figure 1 of the paper). "
        "Curves are broken where the settling time jumps.",
    ),
    "gain": (
        lambda study: plot_sweep(_sweep(study), ("settling_time", "overshoot_error", "control_peak", "control_effort")),
        "The same over the gain, with what each reference asks of the control: its peak and its effort ∫u² dt.",
    ),
    "bands": (
        lambda study: plot_bands(_ensemble(study)),
        "Spread over the draws: the median, and the bands that hold half and nine tenths of them.",
    ),
    "plans": (
        lambda study: plot_plans(study.comparison),
        "The references and their derivatives; circles are prescribed values.",
    ),
    "responses": (
        lambda study: plot_responses(study.comparison),
        "What the loop does with each reference: output, error and control.",
    ),
}
"""Figures that a study may ask for: how they are drawn, and their caption."""


FIGURES |= CRANE_FIGURES


def _sweep(study: Study) -> Sweep:
    if study.sweep is None:
        raise ValueError(f"study {study.name} must have a sweep for this figure, got none")
    return study.sweep


def _ensemble(study: Study) -> Ensemble:
    if study.ensemble is None:
        raise ValueError(f"study {study.name} must have draws for this figure, got none")
    return study.ensemble


def _times(plan: Trajectory, start: float | None = None, end: float | None = None) -> Array:
    """Times that show a trajectory: close, beyond its ends, and on both sides of every breakpoint."""
    first, last = plan.start if start is None else start, plan.end if end is None else end
    margin = 0.06 * (last - first) or 0.5
    t = np.linspace(first - margin, last + margin, 1001)
    beside = [np.nextafter(plan.breakpoints, side) for side in (-np.inf, np.inf)]
    return np.unique(np.concatenate([t, plan.breakpoints, *beside]))


def _broken(t: Array, values: Array, plan: Trajectory) -> Array:
    """Values with a gap where a derivative jumps, so that no line is drawn through the jump."""
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
    """Curve with a nan where a settling time jumps."""
    where = np.flatnonzero(jumps(x, y)) + 1
    return np.insert(x, where, 0.5 * (x[where - 1] + x[where])), np.insert(y, where, np.nan)


def _circles(axes: Axes, points: Sequence[tuple[float, float]], colour: str, marker: str = "o") -> None:
    """Prescribed values, which ``legend([...])`` and python-control's own plots do not count among the curves."""
    if points:
        t, values = np.transpose(points)
        size, face = marker_size(5) ** 2, axes.get_facecolor()
        circles = axes.scatter(t, values, s=size, marker=marker, edgecolors=colour, facecolors=face, zorder=5)
        circles.set_label("_nolegend_")


def _derivative_word(order: int) -> str:
    return DERIVATIVES[order] if order < len(DERIVATIVES) else f"derivative {order}"


def _derivative_label(unit: str, order: int, name: str = "") -> str:
    word = _derivative_word(order)
    suffix = ("" if order == 0 else "/s" if order == 1 else f"/s$^{order}$") if unit or order else ""
    label = f"{name} {word}".strip() if name not in ("", "y") else word
    if not suffix:
        return with_unit(label, unit)
    return with_unit(label, in_units("{y}/", unit or "1", "").removesuffix("/"), suffix)


def _common(units: Any) -> str:
    found = set(units)
    return found.pop() if len(found) == 1 else ""
