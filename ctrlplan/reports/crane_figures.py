"""Figures of cranes: sketch, signals, paths, motion, animation."""

from __future__ import annotations

import math

import numpy as np
from control import ControlPlot
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle, FancyArrowPatch, Rectangle
from numpy.typing import NDArray

from ctrlplan.reports.path_figure import draw_paths, mark_waypoints, moving_plans, rows_of
from ctrlplan.reports.style import (
    AxesLike,
    Drawing,
    add_title,
    as_text,
    clip_steps,
    font_size,
    label_y,
    line_width,
    marker_size,
    plan_styles,
    roles_of,
    shade,
    thin_style,
)
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.sections import AnimatedCrane, Place, Wall
from ctrlplan.studies.units import superscript
from ctrlplan.trajectories import TrigSpline

Array = NDArray[np.float64]

_PLANE = ("x", "z")
"""Outputs of a crane in the plane, z down."""


def plot_sketch(*, ax: AxesLike | None = None) -> ControlPlot:
    """A crane and its variables.

    Parameters
    ----------
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    drawing = Drawing(ax, (1, 1), (5.6, 4.4))
    (axes,) = drawing.column
    dark, middle, light = shade(0.8), shade(0.6), shade(0.4)
    axes.axis("off")
    axes.set_aspect("equal")
    d, b, r, theta = 2.4, 0.45, 3.6, 0.38
    tangent = np.array([d + b * np.cos(theta), -b * np.sin(theta)])
    load = tangent + r * np.array([np.sin(theta), np.cos(theta)])
    axes.plot([-0.3, 6.6], [b + 0.28, b + 0.28], color=light, linewidth=line_width(1.9))
    axes.add_patch(Rectangle((d - 0.8, b + 0.02), 1.6, 0.2, color=dark))
    axes.add_patch(Circle((d, 0.0), b, fill=False, color=dark, linewidth=line_width(1.0)))
    axes.plot([tangent[0], load[0]], [-tangent[1], -load[1]], color="#0072B2", linewidth=line_width(1.0))
    axes.add_patch(Circle((load[0], -load[1]), 0.22, color="#D55E00"))
    axes.plot([tangent[0], tangent[0]], [-tangent[1], -3.0], color=middle, linewidth=line_width(0.5), linestyle="--")
    axes.add_patch(Arc((tangent[0], -tangent[1]), 3.2, 3.2, theta1=270, theta2=270 + np.degrees(theta), color=middle))

    def arrow(start: tuple[float, float], end: tuple[float, float], text: str, offset: tuple[float, float]) -> None:
        axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=12, color=dark))
        axes.annotate(text, end, xytext=offset, textcoords="offset points", fontsize=font_size(11))

    arrow((-0.2, 0.0), (1.0, 0.0), "x", (2, 4))
    arrow((-0.2, 0.0), (-0.2, -1.2), "z (down)", (5, -2))
    arrow((-0.2, 1.15), (d, 1.15), "D", (-38, 5))
    arrow((d + 0.8, b + 0.12), (d + 1.7, b + 0.12), "F", (3, -3))
    arrow((float(load[0]), -float(load[1])), (float(load[0]), -float(load[1]) - 0.95), "m g", (5, 0))
    turn = np.radians(np.linspace(120.0, 240.0, 41))
    way = np.stack([d + 0.75 * np.cos(turn), 0.75 * np.sin(turn)])
    axes.plot(*way, color=dark, linewidth=line_width(0.65))
    last, end = ((float(x), float(y)) for x, y in way.T[-2:])
    axes.add_patch(FancyArrowPatch(last, end, arrowstyle="-|>", mutation_scale=12, color=dark))
    for text, place in (
        ("C", (d - 1.05, 0.0)),
        ("b", (d + 0.08, -0.32)),
        ("R, T", tuple(0.5 * (tangent + load) * [1, -1] + [0.15, 0.1])),
        (r"$\theta$", (tangent[0] + 0.2, -tangent[1] - 2.0)),
        ("m", (load[0] + 0.3, -load[1] - 0.08)),
        (r"$M_c$, $f_1$", (d - 2.1, b + 0.05)),
        (r"J, $f_2$", (d + 0.5, 0.05)),
    ):
        axes.text(float(place[0]), float(place[1]), text, fontsize=font_size(11))
    axes.set_xlim(-0.6, 6.8)
    axes.set_ylim(-4.9, 1.6)
    return drawing.finish(legend=False)


def plot_time(comparison: Comparison, *, ax: AxesLike | None = None) -> ControlPlot:
    """Load, tracking error, sway and controls versus time.

    Parameters
    ----------
    comparison : Comparison
        Of cranes.
    ax : array of Axes, shape (6,), optional
        Where to draw x, z, error, sway, F and C; None: an empty current figure, or
        a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (6, 1).
    """
    labels = ("x [m]", "z [m]", "error [mm]", "sway [rad]", "F [kN]", "C [kN m]")
    drawing = Drawing(ax, (6, 1), (7.4, 9.4), rows=labels)
    rows = drawing.column
    styles = plan_styles(comparison, rows[0])
    for name in comparison.plans:
        signals = _signals(comparison, name)
        t = signals["t"]
        error = np.hypot(*(np.stack([signals["x"], signals["z"]]) - _planned(comparison, name, t)))
        for axes, values in zip(
            rows,
            (signals["x"], signals["z"], 1e3 * error, signals["theta"], signals["F"] / 1e3, signals["C"] / 1e3),
            strict=True,
        ):
            axes.plot(t, values, **styles[name])
    for axes, label in zip(rows, labels, strict=True):
        label_y(axes, label)
        if axes is not rows[2]:
            clip_steps(axes, roles_of(comparison))
    rows[1].yaxis.set_inverted(True)
    _scale_error(rows[2])
    drawing.label_x("time [s]")
    return drawing.finish()


def _scale_error(axes: Axes) -> None:
    """Scale that is linear up to 1 mm and logarithmic above, with powers of ten in plain numbers."""
    axes.set_yscale("symlog", linthresh=1.0, linscale=0.6)
    top = max((float(np.nanmax(line.get_ydata(), initial=0.0)) for line in axes.lines), default=0.0)
    decades = max(1, math.ceil(math.log10(max(min(top, 1e9), 1.0))))
    every = 1 + decades // 6
    ticks = [0.0, *(10.0**k for k in range(0, decades + 1, every))]
    names = [f"{tick:g}" if tick < 1e4 else f"10{superscript(round(math.log10(tick)))}" for tick in ticks]
    axes.set_yticks(ticks, names)
    axes.set_yticks([], minor=True)
    axes.set_ylim(0.0, 10.0**decades)


def plot_step(comparison: Comparison, *, ax: AxesLike | None = None) -> ControlPlot:
    """Controls, rope tension and sway of a step, with the limits of its loop.

    Parameters
    ----------
    comparison : Comparison
        Of cranes.
    ax : array of Axes, shape (4,), optional
        Where to draw F, C, the tension T and the sway; None: an empty current
        figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (4, 1).

    Raises
    ------
    ValueError
        If all plans are without jumps.
    """
    moving = moving_plans(comparison)
    name = next((name for name in comparison.plans if name not in moving), None)
    if name is None:
        raise ValueError("a comparison must have a step for this figure, got plans without jumps alone")
    signals = _signals(comparison, name)
    drawing = Drawing(ax, (4, 1), (7.0, 6.4), rows=("F", "C", "T", "sway"))
    rows = drawing.column
    style = plan_styles(comparison, rows[0])[name]
    t, colour = signals["t"], style["color"]
    limits = comparison.limits.get(name, {}) | {"T": (0.0, np.inf)}
    drawn = "limit"
    for axes, (signal, label) in zip(rows, (("F", "F [kN]"), ("C", "C [kN m]"), ("T", "T [kN]")), strict=False):
        axes.plot(t, signals[signal] / 1e3, color=colour, linewidth=line_width(0.65), label=style["label"])
        for limit in limits.get(signal, ()):
            if np.isfinite(limit):
                axes.axhline(limit / 1e3, color="#D55E00", linewidth=line_width(0.65), linestyle="--", label=drawn)
                drawn = ""
        label_y(axes, label)
    rows[2].fill_between(t, signals["T"] / 1e3, 0.0, where=signals["T"] < 0.0, color="#D55E00", alpha=0.4)
    rows[3].plot(t, signals["theta"], color=colour, linewidth=line_width(0.65))
    label_y(rows[3], "sway [rad]")
    drawing.label_x("time [s]")
    return drawing.finish()


def plot_paths(comparison: Comparison, wall: Wall = None, *, ax: AxesLike | None = None) -> ControlPlot:
    """Paths of the load in the plane (z down), with an obstacle.

    Parameters
    ----------
    comparison : Comparison
        Of cranes.
    wall : ((float, float), (float, float)) or None
        Obstacle to draw: limits in x and in z [m].
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    drawing = Drawing(ax, (1, 1), (7.4, 4.6))
    (axes,) = drawing.column
    if wall:
        axes.text(*_draw_wall(axes, wall, 0.267), "wall", ha="center", fontsize=font_size(9))
    draw_paths(axes, comparison, _PLANE)
    axes.yaxis.set_inverted(True)
    mark_waypoints(axes, comparison, _PLANE)
    drawing.label_x("x [m]")
    label_y(axes, "z [m], down")
    return drawing.finish()


def _draw_wall(axes: Axes, wall: tuple[Place, Place], grey: float) -> Place:
    """Draw an obstacle, and return its centre."""
    (left, right), (top, ground) = wall
    axes.add_patch(Rectangle((left, top), right - left, ground - top, color=shade(grey), zorder=0))
    return 0.5 * (left + right), 0.5 * (top + ground)


def plot_motion(
    comparison: Comparison, wall: Wall = None, steps: int = 13, *, ax: AxesLike | None = None
) -> ControlPlot:
    """Trolley, rope and load at equal time intervals, for the first two plans without jumps.

    Parameters
    ----------
    comparison : Comparison
        Of cranes.
    wall : ((float, float), (float, float)) or None
        Obstacle to draw: limits in x and in z [m].
    steps : int, optional
        Number of times.
    ax : array of Axes, shape (nplans,), optional
        Where to draw, two plans at most; None: an empty current figure, or a new
        one.

    Returns
    -------
    control.ControlPlot
        Of shape (nplans, 1).
    """
    names = [name for name in moving_plans(comparison) or comparison.plans if name not in comparison.measured][:2]
    drawing = Drawing(ax, (len(names), 1), (7.4, 3.4 * len(names)), rows=names)
    first, last = _ends(comparison)
    for name, axes in zip(names, drawing.column, strict=True):
        signals = _signals(comparison, name)
        if wall:
            _draw_wall(axes, wall, 0.2)
        axes.axhline(0.0, color=shade(0.4), linewidth=line_width(1.25))
        colour = plan_styles(comparison, axes)[name]["color"]
        axes.plot(signals["x"], signals["z"], color=colour, linewidth=line_width(0.5))
        end = min(last, float(signals["t"][-1]))  # an event can have ended the run
        for t in np.linspace(first, end, steps):
            _crane_at(axes, signals, t, colour)
        add_title(axes, f"{as_text(name)}: every {(end - first) / (steps - 1):.3g} s")
        label_y(axes, "z [m], down")
        axes.yaxis.set_inverted(True)
        axes.set_aspect("equal")
    drawing.label_x("x [m]")
    return drawing.finish(legend=False)


def _crane_at(axes: Axes, signals: dict[str, Array], t: float, colour: str) -> None:
    """Trolley, drum, rope and load at one time."""
    size, drum = max(np.ptp(signals["x"]), np.ptp(signals["z"])) / 25.0, abs(_drum_radius(signals))
    rows = [signals["D"], signals["x"], signals["z"], *_rope_top(signals)]
    trolley, x, z, top_x, top_z = (float(np.interp(t, signals["t"], row)) for row in rows)
    dark = shade(0.8)
    axes.add_patch(Rectangle((trolley - 0.5 * size, -0.3 * size), size, 0.3 * size, color=dark, zorder=3))
    axes.add_patch(Circle((trolley, 0.0), drum, fill=False, color=dark, linewidth=line_width(0.4), zorder=3))
    axes.plot([top_x, x], [top_z, z], color=shade(0.467), linewidth=line_width(0.45))
    axes.plot(x, z, "o", color=colour, markersize=marker_size(4.5), zorder=4)


def plot_online(comparison: Comparison, *, ax: AxesLike | None = None) -> ControlPlot:
    """Load, reference, distance from the goal, sway and force of each control scheme.

    Parameters
    ----------
    comparison : Comparison
        Of cranes.
    ax : array of Axes, shape (4,), optional
        Where to draw x, distance, sway and F; None: an empty current figure, or a
        new one.

    Returns
    -------
    control.ControlPlot
        Of shape (4, 1).
    """
    labels = ("x [m]", "distance from goal [m]", "sway [rad]", "F [kN]")
    drawing = Drawing(ax, (4, 1), (7.4, 8.2), rows=labels)
    rows = drawing.column
    styles = plan_styles(comparison, rows[0])
    for name, plan in comparison.plans.items():
        signals = _signals(comparison, name)
        x, z = rows_of(comparison, plan.labels, plan.final, _PLANE)
        distance = np.hypot(signals["x"] - x, signals["z"] - z)
        rows[0].plot(signals["t"], signals["x_ref"], **thin_style(styles[name]))
        for axes, values in zip(rows, (signals["x"], distance, signals["theta"], signals["F"] / 1e3), strict=True):
            axes.plot(signals["t"], values, **styles[name])
    for axes, label in zip(rows, labels, strict=True):
        label_y(axes, label)
    rows[1].set_yscale("log")
    rows[1].set_ylim(bottom=1e-3)
    drawing.label_x("time [s]")
    return drawing.finish()


_FRAMES = 20_000
"""Maximum number of frames of an animation; longer runs have a lower frame rate."""


def animation_data(comparison: Comparison, wall: Wall = None, shown: str = "", rate: float = 8.0) -> Markup:
    """JSON for the animation, safe inside HTML: each plan at equal time steps, up to where it is finite.

    Entries: plans {name: [D, R, theta]}, the radius b of the drum (by plan where
    cranes differ), frames per second, wall, the view: left, top, width, height,
    and the number of the plan shown first.

    Parameters
    ----------
    comparison : Comparison
        Of cranes.
    wall : ((float, float), (float, float)) or None, optional
        Obstacle to draw: limits in x and in z [m].
    shown : str, optional
        Plan shown first; unless given, the first trigonometric plan, or else
        the first plan that is not a step.
    rate : float, optional
        Frames per second; lower for runs of more than half an hour.

    Raises
    ------
    ValueError
        If the comparison is not of cranes, or has no plan `shown`.
    """
    labels = [set(comparison.responses[name].output_labels) for name in comparison.simulated]
    lacking = [label for label in AnimatedCrane.signals if not all(label in known for known in labels)]
    if lacking:
        raise ValueError(f"an animation must be of a comparison of cranes, got one without {', '.join(lacking)}")
    if shown and shown not in comparison.plans:
        raise ValueError(f"shown must be one of the plans ({', '.join(comparison.plans)}), got {shown!r}")
    plans: dict[str, list[list[float]]] = {}
    drums: dict[str, float] = {}
    corners = [] if not wall else [np.array(wall)]
    longest = max(float(np.ptp(response.time)) for response in comparison.responses.values())
    rate = min(rate, _FRAMES / max(longest, 1.0))
    for name in comparison.plans:
        signals = _signals(comparison, name)
        finite = np.isfinite([signals[k] for k in AnimatedCrane.signals]).all(axis=0)
        end = finite.size if finite.all() else int(np.argmin(finite))
        if not end:
            continue
        t = signals["t"][:end]
        at = np.arange(t[0], t[-1], 1.0 / rate) if end > 1 else t
        plans[name] = [_rounded(np.interp(at, t, signals[k][:end])) for k in ("D", "R", "theta")]
        drums[name] = _drum_radius({k: row[:end] for k, row in signals.items()})
        corners.append(np.stack([signals["x"][:end], signals["z"][:end]]))
    one = len(set(drums.values())) == 1
    drum = next(iter(drums.values())) if one else drums
    view = _view(comparison, corners)
    trigonometric = [name for name, plan in comparison.plans.items() if isinstance(plan, TrigSpline)]
    first = next((name for name in (shown, *trigonometric, *moving_plans(comparison)) if name in plans), None)
    data = {
        "b": drum,
        "rate": rate,
        "plans": plans,
        "wall": wall,
        "view": view,
        "first": 0 if first is None else list(plans).index(first),
    }
    return htmlsafe_json_dumps(data, allow_nan=False)


def _rounded(values: Array) -> list[float]:
    """Values rounded to five digits of the largest one."""
    size = float(np.max(np.abs(values), initial=0.0))
    found: list[float] = np.round(values, 4 - math.floor(math.log10(size)) if size > 0.0 else 0).tolist()
    return found


def _view(comparison: Comparison, corners: list[Array]) -> list[float]:
    """Left, top, width and height of the view of an animation: waypoints and paths, within bounds."""
    first, last = _ends(comparison)
    paths = [_planned(comparison, name, np.linspace(first, last, 201)) for name in comparison.plans]
    low, high = (
        np.min([np.nanmin(path, axis=1, initial=np.inf) for path in paths], axis=0),
        np.max([np.nanmax(path, axis=1, initial=-np.inf) for path in paths], axis=0),
    )
    low[1], high[1] = min(low[1], 0.0), max(high[1], 0.0)  # the trolley runs at z = 0
    span = float(np.max(high - low)) or 1.0
    for box in corners:
        low = np.maximum(np.minimum(low, box.min(axis=1)), low - 0.5 * span)
        high = np.minimum(np.maximum(high, box.max(axis=1)), high + 0.5 * span)
    room = 0.1 * float(np.max(high - low))
    left, top = (low - room).tolist()
    width, height = (high - low + 2.0 * room).tolist()
    # Limit the aspect ratio: the figure has the width of the page.
    height = max(height, 0.6 * width)
    left, width = left - max(0.0, 0.4 * height - 0.5 * width), max(width, 0.8 * height)
    return _rounded(np.array([left, top, width, height]))


def _signals(comparison: Comparison, name: str) -> dict[str, Array]:
    return comparison.signals(name) | {"t": np.asarray(comparison.responses[name].time)}


def _rope_top(signals: dict[str, Array]) -> Array:
    """Point (2, ntime) at which the rope leaves the drum, from the signals of the simulated crane."""
    across, down = np.sin(signals["theta"]), np.cos(signals["theta"])
    return np.stack([signals["x"] - signals["R"] * across, signals["z"] - signals["R"] * down])


def _drum_radius(signals: dict[str, Array]) -> float:
    """Radius b of the drum: the rope leaves it at (D + b cos theta, -b sin theta)."""
    x, z = _rope_top(signals)
    theta = signals["theta"]
    radius = float(np.median((x - signals["D"]) * np.cos(theta) - z * np.sin(theta)))
    return float(f"{radius:.6g}")


def _ends(comparison: Comparison) -> tuple[float, float]:
    """Times of the first and the last waypoint, or start and end of the plans without waypoints."""
    if comparison.waypoints:
        return comparison.waypoints[0].time, comparison.waypoints[-1].time
    plans = comparison.plans.values()
    return min(plan.start for plan in plans), max(plan.end for plan in plans)


def _planned(comparison: Comparison, name: str, t: Array) -> Array:
    """Planned x and z of the load, (2, ntime)."""
    plan = comparison.plans[name]
    return rows_of(comparison, plan.labels, plan.jet(t, 0)[0], _PLANE)
