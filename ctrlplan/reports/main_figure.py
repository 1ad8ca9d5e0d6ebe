"""The main figure of a study: panels of one axes each, side by side or one above the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from textwrap import wrap

import numpy as np
from control import ControlPlot
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctrlplan.reports.crane_figures import plot_paths
from ctrlplan.reports.figures import plot_plane, plot_sweep
from ctrlplan.reports.parts import Panels, Picture, Plan
from ctrlplan.reports.path_figure import is_planar, plot_path
from ctrlplan.reports.style import (
    Drawing,
    Style,
    clip_steps,
    joined_labels,
    label_y,
    line_styles,
    merge_coincident,
    plan_styles,
    roles_of,
    thin_style,
    with_unit,
)
from ctrlplan.reports.tables import plan_of
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.sections import Bands, CraneOnline, CranePaths, CraneTime, Paths, Plane
from ctrlplan.studies.study import Study
from ctrlplan.studies.sweep import Sweep
from ctrlplan.studies.units import output_unit

_SIZE = (4.1, 2.5)
_LETTERS = 28
"""Letters of a label along the height of a panel."""
_COUNT = 3
"""Panels at most."""


def main_figure(study: Study) -> Panels:
    """Panels of a study: settling time against overshoot of its sweep, the path of a planar plan, error and control."""
    comparison = study.comparison
    pictures = [_panel(key, draw, caption) for key, draw, caption in islice(_panels_of(study), _COUNT)]
    caption = f"{'; '.join(picture.caption for picture in pictures)}."
    return _with_legend(
        pictures, line_styles(roles_of(comparison), measured=comparison.measured), caption[0].upper() + caption[1:]
    )


def main_figure_of_sweep(sweep: Sweep, names: Sequence[str]) -> Panels:
    """Panels of a sweep: a metric each."""
    pictures = [_panel(name, partial(_plot_metric, sweep, name), "") for name in names[:_COUNT]]
    return _with_legend(pictures, line_styles(roles_of(sweep)), f"Metrics versus {sweep.parameter}.")


def _with_legend(pictures: Sequence[Picture], styles: dict[str, Style], caption: str) -> Panels:
    """Panels with a legend of the plans; plans whose curves coincide in every panel have one entry."""
    merged = merge_coincident([axes for picture in pictures for axes in picture.plot.axes.flat])
    legend: list[Plan] = []
    for style in styles.values():
        if style["label"] in merged:
            legend.append(plan_of(joined_labels(merged[style["label"]]), style))
        elif not any(style["label"] in labels for labels in merged.values()):
            legend.append(plan_of(style["label"], style))
    return Panels(pictures, legend, caption)


def _panels_of(study: Study) -> Iterator[tuple[str, Callable[[Axes], ControlPlot], str]]:
    """Key, drawing and caption of each panel, the most important first."""
    comparison, sections = study.comparison, study.sections
    for section in sections:
        if isinstance(section, Plane):
            caption = f"overshoot versus settling time, {section.sweep.parameter} varied"
            yield "plane", partial(_plot_plane, section), caption
    crane = next((section for section in sections if isinstance(section, CranePaths)), None)
    if crane is not None or any(isinstance(section, CraneTime | CraneOnline) for section in sections):
        wall = None if crane is None else crane.wall
        yield "path", lambda axes: plot_paths(comparison, wall, ax=axes), "path of the load (thin: planned)"
    elif is_planar(comparison):
        obstacles = next((section.obstacles for section in sections if isinstance(section, Paths)), ())
        yield "path", lambda axes: plot_path(comparison, obstacles, ax=axes), "path of the outputs (thin: planned)"
    else:
        yield "output", lambda axes: _plot_output(comparison, axes), "output (thin: reference)"
    bands = next((section.ensemble for section in sections if isinstance(section, Bands)), None)
    if bands is not None:
        yield "draws", partial(_plot_draws, bands), "tracking error over the draws: median, and 5 to 95 % (band)"
    yield "error", lambda axes: _plot_error(comparison, axes), "tracking error"
    if comparison.controls:
        yield "control", lambda axes: _plot_control(comparison, axes), "control"


def _plot_metric(sweep: Sweep, name: str, axes: Axes) -> ControlPlot:
    return plot_sweep(sweep, [name], ax=axes)


def _plot_plane(section: Plane, axes: Axes) -> ControlPlot:
    limit, label, further = section.limit, section.limit_label, section.further
    return plot_plane(section.sweep, limit=limit, limit_label=label, further=further, ax=axes)


def _panel(key: str, draw: Callable[[Axes], ControlPlot], caption: str) -> Picture:
    """One panel, whose legend is that of all."""
    figure = Figure(figsize=_SIZE, layout="constrained")
    plot = draw(figure.subplots())
    for axes in plot.axes.flat:
        axes.set_ylabel("\n".join(wrap(axes.get_ylabel(), _LETTERS)))
    if plot.legend is not None:
        plot.legend.remove()
    return Picture(f"main-{key}", plot, caption)


def _plot_output(comparison: Comparison, ax: Axes) -> ControlPlot:
    drawing, styles = _axes_of(comparison, ax)
    for name, plan in comparison.plans.items():
        signals, t = comparison.signals(name), np.asarray(comparison.responses[name].time)
        if name not in comparison.measured:
            ax.plot(t, plan.jet(t, 0)[0][0], **thin_style(styles[name]))
        ax.plot(t, signals[comparison.outputs[0]], **styles[name])
    output = comparison.outputs[0]
    return _finished(drawing, comparison, with_unit(output, output_unit(comparison, output)))


def _plot_error(comparison: Comparison, ax: Axes) -> ControlPlot:
    """Error of the first output, or the distance from the reference of a planar plan."""
    drawing, styles = _axes_of(comparison, ax)
    planar = is_planar(comparison)
    for name, plan in comparison.plans.items():
        signals, t = comparison.signals(name), np.asarray(comparison.responses[name].time)
        error = plan.jet(t, 0)[0] - np.array([signals[output] for output in comparison.outputs])
        ax.plot(t, np.hypot(*error) if planar else error[0], **styles[name])
    output = comparison.outputs[0]
    label = "distance from reference" if planar else f"error of {output}"
    return _finished(drawing, comparison, with_unit(label, output_unit(comparison, output)))


def _plot_draws(ensemble: Ensemble, ax: Axes) -> ControlPlot:
    """Median and 5 to 95 % band of the error of the first output over the draws."""
    comparison, t = ensemble.nominal, ensemble.timepts
    drawing, styles = _axes_of(comparison, ax)
    output = comparison.outputs[0]
    for name, plan in comparison.plans.items():
        band = ensemble.bands.get(name, {}).get(output)
        if band is not None:
            low, _, middle, _, high = plan.jet(t, 0)[0][0] - band[::-1]
            ax.fill_between(t, low, high, color=styles[name]["color"], alpha=0.2, linewidth=0)
            ax.plot(t, middle, **styles[name])
    return _finished(drawing, comparison, with_unit(f"error of {output}", output_unit(comparison, output)))


def _plot_control(comparison: Comparison, ax: Axes) -> ControlPlot:
    drawing, styles = _axes_of(comparison, ax)
    control = comparison.controls[0]
    for name, response in comparison.responses.items():
        ax.plot(np.asarray(response.time), comparison.signals(name)[control], **styles[name])
    return _finished(drawing, comparison, with_unit(control, comparison.units.get(control, "")))


def _axes_of(comparison: Comparison, ax: Axes) -> tuple[Drawing, dict[str, Style]]:
    return Drawing(ax, (1, 1), _SIZE), plan_styles(comparison, ax)


def _finished(drawing: Drawing, comparison: Comparison, label: str) -> ControlPlot:
    (axes,) = drawing.column
    clip_steps(axes, roles_of(comparison))
    drawing.label_x("time [s]")
    label_y(axes, label)
    return drawing.finish(legend=False)
