"""Paths in the plane: plans of two axes of one unit, with obstacles and waypoints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from control import ControlPlot
from matplotlib.axes import Axes

from ctrlplan._types import Array
from ctrlplan.planning import Obstacle
from ctrlplan.reports.style import (
    AxesLike,
    Drawing,
    font_size,
    label_y,
    plan_styles,
    roles_of,
    shade,
    thin_style,
)
from ctrlplan.reports.style import with_unit as labelled
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.roles import Role
from ctrlplan.studies.units import output_unit

_GRID, _REACH = 601, 1.5
"""Points along each side on which an obstacle is evaluated, and the distance from the paths relative to their size."""


def is_planar(comparison: Comparison) -> bool:
    """Whether the plans have two axes of the same unit."""
    units = [output_unit(comparison, output) for output in comparison.outputs]
    return len(comparison.outputs) == 2 and units[0] == units[1]


def plot_path(comparison: Comparison, obstacles: Iterable[Obstacle] = (), *, ax: AxesLike | None = None) -> ControlPlot:
    """Second output against the first up to the last waypoint, with the planned paths, obstacles and waypoints.

    Steps, which take no path, are left out where there are other plans.

    Parameters
    ----------
    comparison : Comparison
        Of plans with two axes.
    obstacles : iterable of Obstacle, optional
        What the plans must keep clear of.
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    drawing = Drawing(ax, (1, 1), (7.0, 5.0))
    (axes,) = drawing.column
    across, up = comparison.outputs
    draw_paths(axes, comparison, (across, up))
    axes.set_aspect("equal", adjustable="datalim")
    for obstacle in obstacles:
        _draw_obstacle(axes, obstacle)
    mark_waypoints(axes, comparison, (across, up))
    drawing.label_x(labelled(across, output_unit(comparison, across)))
    label_y(axes, labelled(up, output_unit(comparison, up)))
    return drawing.finish()


def draw_paths(axes: Axes, comparison: Comparison, outputs: tuple[str, str]) -> None:
    """Paths of two outputs up to the last waypoint, and thin the planned ones; steps only where nothing else is."""
    styles, last = plan_styles(comparison, axes), end_of_move(comparison)
    for name in moving_plans(comparison) or list(comparison.plans):
        response, plan = comparison.responses[name], comparison.plans[name]
        t = np.asarray(response.time)
        way = t <= last
        signals = comparison.signals(name)
        if name not in comparison.measured:
            axes.plot(*rows_of(comparison, plan.labels, plan.jet(t[way], 0)[0], outputs), **thin_style(styles[name]))
        axes.plot(*(signals[output][way] for output in outputs), **styles[name])


_GOAL = "goal"
_SIDES = {_GOAL: (-6.0, "right")}
"""Offset to the right [pt] and alignment of a name where they are not those of the others."""

_LOW = 14.0
"""Height [pt] of a point over the lower edge up to which its name is above it."""


def mark_waypoints(axes: Axes, comparison: Comparison, outputs: tuple[str, str]) -> None:
    """Waypoints with their names, which do not cross the lower edge."""
    named = named_places(comparison, outputs)
    for place in named.values():
        axes.plot(*place, "o", color=shade(0.73), mfc=axes.get_facecolor(), zorder=5)
    bottom, top = axes.get_ylim()
    points = axes.bbox.height * 72.0 / axes.figure.dpi
    for text, place in named.items():
        height = points * (place[1] - bottom) / (top - bottom)
        across, side = _SIDES.get(text, (6.0, "left"))
        offset = (across, -10.0 if height > _LOW else 5.0)
        axes.annotate(text, place, xytext=offset, textcoords="offset points", ha=side, fontsize=font_size(9))


def moving_plans(comparison: Comparison) -> list[str]:
    """Plans that are no steps."""
    return [name for name, role in roles_of(comparison).items() if role is not Role.STEP]


def end_of_move(comparison: Comparison) -> float:
    """Time of the last waypoint, or the end of the plans where none are known."""
    if comparison.waypoints:
        return comparison.waypoints[-1].time
    return max(plan.end for plan in comparison.plans.values())


def rows_of(comparison: Comparison, labels: Sequence[str], rows: Array, outputs: tuple[str, str]) -> Array:
    """Rows with two labels, or followed by two outputs, in this order; nan where there are none."""
    named = dict(zip(comparison.outputs, rows, strict=False)) | dict(zip(labels, rows, strict=True))
    return np.stack([named.get(label, np.full(rows.shape[1:], np.nan)) for label in outputs])


def named_places(comparison: Comparison, outputs: tuple[str, str]) -> dict[str, tuple[float, float]]:
    """Positions of the waypoints: start, A, B, ..., goal; those given in part are left out."""
    points = comparison.waypoints
    names = ["start", *map(_letters_of, range(len(points) - 2)), _GOAL][: len(points)]
    found = {}
    for name, point in zip(names, points, strict=True):
        x, z = rows_of(comparison, point.labels or comparison.outputs, point.position, outputs).tolist()
        if np.isfinite(x + z):
            found[name] = (x, z)
    return found


def _letters_of(count: int) -> str:
    """A, B, ..., Z, AA, AB, ..."""
    head, last = divmod(count, 26)
    return (_letters_of(head - 1) if head else "") + chr(ord("A") + last)


def _draw_obstacle(axes: Axes, obstacle: Obstacle) -> None:
    """Obstacle as the set where its distance is not positive; it does not set the limits of the axes."""
    before = axes.dataLim.frozen()
    (left, bottom), (right, top) = before.get_points().tolist()
    reach = _REACH * max(right - left, top - bottom)
    ends = (left - reach, right + reach), (bottom - reach, top + reach)
    grid = np.stack(np.meshgrid(*(np.linspace(*pair, _GRID) for pair in ends)))
    distance = obstacle.distance(grid)
    lowest = float(distance.min())
    if lowest < 0.0:
        axes.contourf(*grid, distance, levels=[2.0 * lowest, 0.0], colors=[shade(0.267)], zorder=0)
    axes.dataLim.set(before)
    axes.autoscale()
