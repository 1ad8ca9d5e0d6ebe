"""Figures of plans, responses and sweeps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ctrlplan.reports.crane_figures import CRANE_FIGURES
from ctrlplan.reports.style import (
    as_text,
    house_style,
    legend_above,
    legend_label,
    line_styles,
    new_figure,
    stacked_axes,
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


@house_style
def plot_trajectory(plan: Trajectory, order: int = 2, units: Sequence[str] | None = None) -> Figure:
    """Value and derivatives of one trajectory stacked, waypoints marked.

    Parameters
    ----------
    plan : Trajectory
        What is drawn, from a little before its start to a little after its end.
    order : int, optional
        Highest derivative.
    units : sequence of str, optional
        Units of the axes.
    """
    names = dict(zip(plan.labels, units, strict=True)) if units is not None else {}
    figure = new_figure(6.4, 1.2 + 1.5 * (order + 1))
    rows = stacked_axes(figure, order + 1)
    t = _times(plan)
    jet = plan.jet(t, order)
    markers = "osD^v"
    for k, (axes,) in enumerate(rows):
        for a, label in enumerate(plan.labels):
            axes.plot(t, _broken(t, jet[k, a], plan), color=f"C{a}", label=legend_label(label))
            points = [(w.time, w.jet[k, a]) for w in plan.waypoints if k < len(w.jet) and not np.isnan(w.jet[k, a])]
            if points:
                axes.plot(*zip(*points, strict=True), markers[a % 5], color=f"C{a}", markersize=5, mfc="white")
        axes.set_ylabel(_derivative_label(_common(names.values()), k))
    rows[-1][0].set_xlabel("time [s]")
    if plan.naxes > 1:
        legend_above(figure, rows[0][0])
    return figure


@house_style
def plot_plans(comparison: Comparison, order: int = 2) -> Figure:
    """References side by side: a column an axis, a row a derivative."""
    first = next(iter(comparison.plans.values()))
    figure = new_figure(min(6.4 + 2.0 * (first.naxes - 1), 9.0), 1.4 + 1.6 * (order + 1))
    rows = stacked_axes(figure, order + 1, first.naxes)
    styles = line_styles(comparison.plans)
    start = min(p.start for p in comparison.plans.values())
    end = max(p.end for p in comparison.plans.values())
    t = np.unique(np.concatenate([_times(p, start, end) for p in comparison.plans.values()]))
    for name, plan in comparison.plans.items():
        jet = plan.jet(t, order)
        for k, row in enumerate(rows):
            if k and not plan.duration:
                continue  # a step has no derivative to draw
            for a, axes in enumerate(row):
                axes.plot(t, _broken(t, jet[k, a], plan) if k else jet[k, a], **styles[name])
    for k, row in enumerate(rows):
        for a, axes in enumerate(row):
            given = [(w.time, w.jet[k, a]) for w in comparison.waypoints if k < len(w.jet)]
            if given:
                axes.plot(*zip(*given, strict=True), "o", color="#444444", mfc="white", markersize=5, zorder=5)
            axes.set_ylabel(_derivative_label(comparison.units.get(first.labels[a], ""), k, first.labels[a]))
    for axes in rows[-1]:
        axes.set_xlabel("time [s]")
    legend_above(figure, rows[0][0])
    return figure


@house_style
def plot_responses(comparison: Comparison) -> Figure:
    """Outputs with their references, errors, and controls over time."""
    styles = line_styles(comparison.plans)
    outputs, controls = comparison.outputs, comparison.controls
    figure = new_figure(7.0, 1.4 + 1.9 * (2 * len(outputs) + len(controls)))
    rows = [axes for (axes,) in stacked_axes(figure, 2 * len(outputs) + len(controls))]
    for name, plan in comparison.plans.items():
        response = comparison.responses[name]
        t = np.asarray(response.time)
        signals = np.asarray(response.outputs).reshape(-1, t.size)
        labels = list(response.output_labels)
        reference = plan.jet(t, 0)[0]
        for a, output in enumerate(outputs):
            y = signals[labels.index(output)]
            rows[2 * a].plot(t, reference[a], color=styles[name]["color"], linewidth=0.7, alpha=0.6)
            rows[2 * a].plot(t, y, **styles[name])
            rows[2 * a + 1].plot(t, reference[a] - y, **styles[name])
        for c, control in enumerate(controls):
            rows[2 * len(outputs) + c].plot(t, signals[labels.index(control)], **styles[name])
    first = next(iter(comparison.plans.values()))
    for a, output in enumerate(outputs):
        unit = comparison.units.get(first.labels[a], comparison.units.get(output, ""))
        rows[2 * a].set_ylabel(with_unit(output, unit))
        rows[2 * a].set_title("output (thin: reference)", loc="left", fontsize=8)
        rows[2 * a + 1].set_ylabel(with_unit(f"error of {output}", unit))
    for c, control in enumerate(controls):
        rows[2 * len(outputs) + c].set_ylabel(with_unit(control, comparison.units.get(control, "")))
    rows[-1].set_xlabel("time [s]")
    legend_above(figure, rows[0])
    return figure


@house_style
def plot_sweep(sweep: Sweep, names: Sequence[str] = ("settling_time", "overshoot_error")) -> Figure:
    """Metrics over the parameter, lines broken where a settling time jumps."""
    styles = line_styles(sweep.metrics)
    columns = 2 if len(names) > 1 else 1
    figure = new_figure(4.0 * columns + 0.4, 0.8 + 2.5 * -(-len(names) // columns))
    grid = [a for row in stacked_axes(figure, -(-len(names) // columns), columns) for a in row]
    for name, axes in zip(names, grid, strict=False):
        for plan, rows in sweep.metrics.items():
            x, y = sweep.values, rows[name]
            if name.endswith("settling_time"):
                x, y = _with_gaps(x, y)
            axes.plot(x, y, **styles[plan])
        measure = MEASURES.get(name)
        axes.set_ylabel(
            with_unit(measure.title, "" if "{" in measure.unit else measure.unit) if measure else as_text(name)
        )
        finite = np.concatenate([r[name][np.isfinite(r[name])] for r in sweep.metrics.values()])
        if finite.size and finite.min() > 0.0 and finite.max() > 100.0 * finite.min():
            axes.set_yscale("log")
        if sweep.values[0] > 0.0 and sweep.values[-1] > 20.0 * sweep.values[0]:
            axes.set_xscale("log")
    for axes in grid[-columns:]:
        axes.set_xlabel(as_text(sweep.parameter))
    for axes in grid[len(names) :]:
        axes.set_visible(False)
    legend_above(figure, grid[0])
    return figure


@house_style
def plot_bands(ensemble: Ensemble) -> Figure:
    """Quantiles over the draws of outputs, errors and controls: 5 to 95 %, 25 to 75 %, and the median."""
    nominal = ensemble.nominal
    styles = line_styles(nominal.plans)
    shown = [(signal, error) for signal in nominal.outputs for error in (False, True)]
    shown += [(signal, False) for signal in nominal.controls if signal not in nominal.outputs]
    figure = new_figure(max(4.4, 2.9 * len(nominal.plans) + 0.6), 1.2 + 1.7 * len(shown))
    rows = stacked_axes(figure, len(shown), len(nominal.plans))
    t = ensemble.timepts
    for row, (signal, error) in zip(rows, shown, strict=True):
        bands = [ensemble.bands.get(plan, {}).get(signal) for plan in nominal.plans]
        extent = []
        for axes, (plan, reference), band in zip(row, nominal.plans.items(), bands, strict=True):
            target = reference.jet(t, 0)[0, nominal.outputs.index(signal)] if signal in nominal.outputs else None
            if target is not None and not error:
                axes.plot(t, target, color="#444444", linewidth=0.8, linestyle=(0, (4, 2)), label="reference")
            if band is None:
                continue
            if error and target is not None:
                band = target - band[::-1]
            colour = styles[plan]["color"]
            axes.fill_between(t, band[0], band[4], color=colour, alpha=0.2, linewidth=0, label="5 to 95 %")
            axes.fill_between(t, band[1], band[3], color=colour, alpha=0.35, linewidth=0, label="25 to 75 %")
            axes.plot(t, band[2], color=colour, linewidth=1.1, label="median")
            extent.append(band[np.isfinite(band)])
        # One scale a row, so that the plans can be compared.
        if extent and np.concatenate(extent).size:
            low, high = np.min(np.concatenate(extent)), np.max(np.concatenate(extent))
            margin = 0.05 * (high - low) or 0.5
            for axes in row:
                axes.set_ylim(low - margin, high + margin)
        label = signal
        if signal in nominal.outputs:
            label = next(iter(nominal.plans.values())).labels[nominal.outputs.index(signal)]
        unit = nominal.units.get(signal, nominal.units.get(label, ""))
        for axes in row:
            axes.set_ylabel(with_unit(f"error of {signal}" if error else signal, unit))
    for axes, plan in zip(rows[0], nominal.plans, strict=True):
        axes.set_title(as_text(plan), fontsize=9)
    for axes in rows[-1]:
        axes.set_xlabel("time [s]")
    legend_above(figure, rows[0][0])
    return figure


@house_style
def plot_plane(sweep: Sweep) -> Figure:
    """Figure 1: the settling-time/overshoot plane, each point a gain."""
    styles = line_styles(sweep.metrics)
    figure = new_figure(6.8, 5.2)
    ((axes,),) = stacked_axes(figure, 1)
    numbered = _NUMBERED if _of_the_paper(sweep) else {}
    for plan, rows in sweep.metrics.items():
        ts, overshoot = rows["settling_time"], rows["overshoot_error"]
        x, gap = _with_gaps(sweep.values, ts)
        colour = styles[plan]["color"]
        axes.plot(gap, np.interp(x, sweep.values, overshoot), linewidth=1.0, **{**styles[plan], "linestyle": "-"})
        axes.plot(ts, overshoot, ".", color=colour, markersize=2.5)
        # Only a few plans are numbered, or the numbers would overprint.
        for gain, offset in numbered.get(plan, {}).items():
            at = int(np.argmin(np.abs(sweep.values - gain)))
            axes.plot(ts[at], overshoot[at], "o", color=colour, mfc="white", markersize=5, zorder=4)
            axes.annotate(
                f"{sweep.values[at]:.4g}",
                (ts[at], overshoot[at]),
                xytext=offset,
                textcoords="offset points",
                fontsize=8,
                color=colour,
                ha="center",
                va="center",
                arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 1, "shrinkB": 3},
            )
    if numbered:
        axes.plot(*STEP_LIMIT, "*", color="#E69F00", markersize=13, label="limit of the step, k → ∞", zorder=5)
        axes.set_title("numbers at the circles: gain k", loc="left", fontsize=8)
    axes.set_xlabel("settling time ±2 % [s]")
    axes.set_ylabel("overshoot on the error [%]")
    axes.set_xlim(left=0.0)
    axes.set_ylim(-4.0, 108.0)
    legend_above(figure, axes)
    return figure


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


FIGURES: dict[str, tuple[Callable[[Study], Figure], str]] = {
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


def _derivative_label(unit: str, order: int, name: str = "") -> str:
    word = DERIVATIVES[order] if order < len(DERIVATIVES) else f"derivative {order}"
    suffix = ("" if order == 0 else "/s" if order == 1 else f"/s$^{order}$") if unit or order else ""
    label = f"{name} {word}".strip() if name not in ("", "y") else word
    if not suffix:
        return with_unit(label, unit)
    return with_unit(label, in_units("{y}/", unit or "1", "").removesuffix("/"), suffix)


def _common(units: Any) -> str:
    found = set(units)
    return found.pop() if len(found) == 1 else ""
