"""Figures of the crane: the paper's 2 to 6, its motion, and an animation that plays offline."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from control import ControlPlot
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle, FancyArrowPatch, FancyBboxPatch, Rectangle
from numpy.typing import NDArray

from ctrlplan.reports.style import (
    AxesLike,
    Drawing,
    add_title,
    as_text,
    axis_styles,
    font_size,
    label_y,
    legend_label,
    line_width,
    marker_size,
    plan_styles,
    shade,
)
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.crane_setup import CRANE, nominal_waypoints
from ctrlplan.studies.measures import signals_of
from ctrlplan.studies.study import Study
from ctrlplan.systems.plants import crane_loop
from ctrlplan.trajectories import PolySpline

Array = NDArray[np.float64]

Wall = tuple[tuple[float, float], tuple[float, float]] | None


def plot_sketch(*, ax: AxesLike | None = None) -> ControlPlot:
    """Figure 2: the crane and its variables.

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
    axes.add_patch(Arc((d, 0.0), 1.5, 1.5, theta1=120, theta2=240, color=dark))
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


def plot_blocks(*, ax: AxesLike | None = None) -> ControlPlot:
    """Figure 3: the controller, drawn from the blocks and connections of the model itself.

    Parameters
    ----------
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    loop = crane_loop(CRANE, PolySpline(nominal_waypoints()))
    names = [block.name for block in loop.syslist]
    place = {
        names[0]: (0.0, 0.0),
        names[1]: (2.6, 0.0),
        names[2]: (5.2, 0.8),
        names[3]: (5.2, -0.8),
        names[4]: (7.8, 0.0),
    }
    titles = {"plan": "path generator", "generator": "flat law (15a,b)", "trolley_pid": "PID", "hoist_pid": "PID"}
    joined: dict[tuple[str, str], list[str]] = {}
    into = [(block, label) for block in loop.syslist for label in block.input_labels]
    out = [(block, label) for block in loop.syslist for label in block.output_labels]
    for row, column in np.argwhere(np.asarray(loop.connect_map) != 0.0):
        source, signal = out[column]
        joined.setdefault((source.name, into[row][0].name), []).append(signal)
    drawing = Drawing(ax, (1, 1), (8.4, 3.2))
    (axes,) = drawing.column
    edge = shade(0.8)
    axes.axis("off")
    for name, (x, y) in place.items():
        box = FancyBboxPatch((x - 0.75, y - 0.35), 1.5, 0.7, boxstyle="round,pad=0.02", fc=shade(0.045), ec=edge)
        axes.add_patch(box)
        axes.text(x, y, titles.get(name, name), ha="center", va="center", fontsize=font_size(9))
    for (source, sink), signals in joined.items():
        (x0, y0), (x1, y1) = place[source], place[sink]
        text = ", ".join(signals) if len(signals) < 3 else f"{signals[0]} … {signals[-1]}"
        if x1 > x0:
            start, end, style = (
                (x0 + 0.78, y0 + 0.15 * np.sign(y1 - y0)),
                (x1 - 0.78, y1 + 0.15 * np.sign(y0 - y1)),
                "arc3",
            )
            at = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]) + 0.14)
        else:  # what is measured comes back around the drives
            side = 1.0 if y1 > 0.0 else -1.0
            start, end, style = (x0, y0 + 0.38 * side), (x1, y1 + 0.38 * side), f"arc3,rad={0.5 * side}"
            at = (0.5 * (x0 + x1), y1 + 0.98 * side)
        axes.add_patch(
            FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=edge, connectionstyle=style)
        )
        axes.text(*at, text, ha="center", va="center", fontsize=font_size(8), color="#0072B2")
    axes.set_xlim(-0.9, 8.7)
    axes.set_ylim(-2.1, 2.1)
    return drawing.finish(legend=False)


def plot_time(comparison: Comparison, *, ax: AxesLike | None = None) -> ControlPlot:
    """Load, error, sway and controls over time, as the paper's figures 4 and 5 lay them out.

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
    names = _moving(comparison) or list(comparison.plans)
    labels = ("x [m]", "z [m]", "error [mm]", "sway [rad]", "F [kN]", "C [kN m]")
    drawing = Drawing(ax, (6, 1), (7.4, 9.4), rows=labels)
    rows = drawing.column
    styles = plan_styles(comparison.plans, rows[0])
    for name in names:
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
    rows[1].yaxis.set_inverted(True)
    rows[2].set_yscale("symlog", linthresh=1.0)
    rows[2].set_ylim(bottom=0.0)
    drawing.label_x("time [s]")
    return drawing.finish()


def plot_step(comparison: Comparison, *, ax: AxesLike | None = None) -> ControlPlot:
    """Controls of a step with the limits of its own loop, and the rope it leaves slack.

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
    moving = _moving(comparison)
    name = next((name for name in comparison.plans if name not in moving), None)
    if name is None:
        raise ValueError("a comparison must have a step for this figure, got plans without jumps alone")
    signals = _signals(comparison, name)
    drawing = Drawing(ax, (4, 1), (7.0, 6.4), rows=("F", "C", "T", "sway"))
    rows = drawing.column
    style = plan_styles(comparison.plans, rows[0])[name]
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


def plot_plane(comparison: Comparison, wall: Wall, *, ax: AxesLike | None = None) -> ControlPlot:
    """Paths of the load in the plane, z down, with the obstacle (figure 6).

    Parameters
    ----------
    comparison : Comparison
        Of cranes.
    wall : ((float, float), (float, float)) or None
        An obstacle to draw: its sides in x and in z [m].
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    drawing = Drawing(ax, (1, 1), (7.4, 4.6))
    (axes,) = drawing.column
    styles = plan_styles(comparison.plans, axes)
    if wall:
        (left, right), (top, ground) = wall
        axes.add_patch(Rectangle((left, top), right - left, ground - top, color=shade(0.267), zorder=0))
        axes.text(0.5 * (left + right), 0.5 * (top + ground), "wall", ha="center", fontsize=font_size(9))
    last = _ends(comparison)[1]
    for name in _moving(comparison):  # steps take no path
        signals = _signals(comparison, name)
        way = signals["t"] <= last
        thin = {"color": styles[name]["color"], "linewidth": line_width(0.45), "alpha": 0.6}
        axes.plot(*_planned(comparison, name, signals["t"][way]), **thin)
        axes.plot(signals["x"][way], signals["z"][way], **styles[name])
    for text, place in _named_places(comparison).items():
        axes.plot(*place, "o", color=shade(0.73), mfc=axes.get_facecolor(), zorder=5)
        axes.annotate(text, place, xytext=(6, -10), textcoords="offset points", fontsize=font_size(9))
    drawing.label_x("x [m]")
    label_y(axes, "z [m], down")
    axes.yaxis.set_inverted(True)
    return drawing.finish()


def plot_motion(comparison: Comparison, wall: Wall, steps: int = 13, *, ax: AxesLike | None = None) -> ControlPlot:
    """Trolley, rope and load at equal time steps along each plan.

    Parameters
    ----------
    comparison : Comparison
        Of cranes.
    wall : ((float, float), (float, float)) or None
        An obstacle to draw: its sides in x and in z [m].
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
    known = [n for n in ("polynomial", "trigonometric") if n in comparison.plans]
    names = known or (_moving(comparison) or list(comparison.plans))[:2]
    drawing = Drawing(ax, (len(names), 1), (7.4, 3.4 * len(names)), rows=names)
    first, last = _ends(comparison)
    for name, axes in zip(names, drawing.column, strict=True):
        signals = _signals(comparison, name)
        if wall:
            (left, right), (top, ground) = wall
            axes.add_patch(Rectangle((left, top), right - left, ground - top, color=shade(0.2), zorder=0))
        axes.axhline(0.0, color=shade(0.4), linewidth=line_width(1.25))
        colour = plan_styles(comparison.plans, axes)[name]["color"]
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


def plot_curves(study: Study, *, ax: AxesLike | None = None) -> ControlPlot:
    """The curves that a study computed for itself.

    Parameters
    ----------
    study : Study
        With curves, of which the first are drawn.
    ax : Axes, optional
        Where to draw; None: an empty current figure, or a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1).
    """
    curves = study.curves[0]
    drawing = Drawing(ax, (1, 1), (7.0, 3.8))
    (axes,) = drawing.column
    names = list(curves.rows)
    # Curves of a logarithmic axis come in pairs: a colour a pair, and dashes for the second.
    told = axis_styles(names[::2] if curves.log else names, axes)
    colours = [style["color"] for style in told.values()]
    for i, (name, row) in enumerate(curves.rows.items()):
        style = "-" if i % 2 == 0 else (0, (5, 1.5))
        colour = colours[i // 2 if curves.log else i]
        axes.plot(curves.x, row, color=colour, linestyle=style, label=legend_label(name))
    if curves.log:
        axes.set_yscale("log")
    drawing.label_x(as_text(curves.x_label))
    label_y(axes, as_text(curves.y_label))
    return drawing.finish()


def plot_online(comparison: Comparison, *, ax: AxesLike | None = None) -> ControlPlot:
    """Load, reference in force, distance from the goal, sway and force of each way to run one plan.

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
    styles = plan_styles(comparison.plans, rows[0])
    for name, plan in comparison.plans.items():
        signals = _signals(comparison, name)
        x, z = _across_and_down(comparison, plan.labels, plan.final)
        distance = np.hypot(signals["x"] - x, signals["z"] - z)
        thin = {"color": styles[name]["color"], "linewidth": line_width(0.45), "alpha": 0.6}
        rows[0].plot(signals["t"], signals["x_ref"], **thin)
        for axes, values in zip(rows, (signals["x"], distance, signals["theta"], signals["F"] / 1e3), strict=True):
            axes.plot(signals["t"], values, **styles[name])
    for axes, label in zip(rows, labels, strict=True):
        label_y(axes, label)
    rows[1].set_yscale("log")
    rows[1].set_ylim(bottom=1e-3)
    drawing.label_x("time [s]")
    return drawing.finish()


_FRAMES = 20_000
"""Frames of an animation at most; longer runs have fewer a second."""


def animation_data(comparison: Comparison, wall: Wall = None, rate: float = 12.0) -> Markup:
    """JSON for the animation, safe inside HTML: each plan at equal time steps, up to where it is finite.

    Entries: plans {name: [D, R, theta]}, the radius b of the drum (by plan where
    cranes differ), frames per second, wall, and the view: left, top, width, height.
    """
    plans: dict[str, list[list[float]]] = {}
    drums: dict[str, float] = {}
    corners = [] if not wall else [np.array(wall)]
    longest = max(float(np.ptp(response.time)) for response in comparison.responses.values())
    rate = min(rate, _FRAMES / max(longest, 1.0))
    for name in comparison.plans:
        signals = _signals(comparison, name)
        sound = np.isfinite([signals[k] for k in ("x", "z", "D", "R", "theta")]).all(axis=0)
        end = sound.size if sound.all() else int(np.argmin(sound))
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
    return htmlsafe_json_dumps({"b": drum, "rate": rate, "plans": plans, "wall": wall, "view": view}, allow_nan=False)


def _rounded(values: Array) -> list[float]:
    """Values to five digits of the largest one."""
    size = float(np.max(np.abs(values), initial=0.0))
    found: list[float] = np.round(values, 4 - math.floor(math.log10(size)) if size > 0.0 else 0).tolist()
    return found


def _view(comparison: Comparison, corners: list[Array]) -> list[float]:
    """Left, top, width and height of what an animation shows: every waypoint, and loads that do not fly away."""
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
    # Neither a strip nor a tower: the figure has the width of the page.
    height = max(height, 0.6 * width)
    left, width = left - max(0.0, 0.4 * height - 0.5 * width), max(width, 0.8 * height)
    return _rounded(np.array([left, top, width, height]))


def is_crane(comparison: Comparison) -> bool:
    """Whether a comparison is of a crane, so that it can be drawn as one."""
    first = next(iter(comparison.responses.values()))
    return {"x", "z", "D", "R", "theta"} <= set(first.output_labels or ())


def _signals(comparison: Comparison, name: str) -> dict[str, Array]:
    response = comparison.responses[name]
    return signals_of(response) | {"t": np.asarray(response.time)}


def _rope_top(signals: dict[str, Array]) -> Array:
    """Point (2, ntime) at which the rope leaves the drum: of the crane that was simulated, whatever its drum."""
    across, down = np.sin(signals["theta"]), np.cos(signals["theta"])
    return np.stack([signals["x"] - signals["R"] * across, signals["z"] - signals["R"] * down])


def _drum_radius(signals: dict[str, Array]) -> float:
    """Radius b of the drum: the rope leaves it at (D + b cos theta, -b sin theta)."""
    x, z = _rope_top(signals)
    theta = signals["theta"]
    radius = float(np.median((x - signals["D"]) * np.cos(theta) - z * np.sin(theta)))
    return float(f"{radius:.6g}")


def _moving(comparison: Comparison) -> list[str]:
    """Plans whose position does not jump."""
    return [name for name, plan in comparison.plans.items() if not plan.jumps(0)]


def _ends(comparison: Comparison) -> tuple[float, float]:
    """Times of the first and the last waypoint, or of the plans where none are known."""
    if comparison.waypoints:
        return comparison.waypoints[0].time, comparison.waypoints[-1].time
    plans = comparison.plans.values()
    return min(plan.start for plan in plans), max(plan.end for plan in plans)


def _planned(comparison: Comparison, name: str, t: Array) -> Array:
    """Planned x and z of the load, (2, ntime)."""
    plan = comparison.plans[name]
    return _across_and_down(comparison, plan.labels, plan.jet(t, 0)[0])


def _across_and_down(comparison: Comparison, labels: Sequence[str], rows: Array) -> Array:
    """Rows called x and z, or followed by the outputs x and z, in this order; nan where there are none."""
    named = dict(zip(comparison.outputs, rows, strict=False)) | dict(zip(labels, rows, strict=True))
    return np.stack([named.get(label, np.full(rows.shape[1:], np.nan)) for label in ("x", "z")])


def _named_places(comparison: Comparison) -> dict[str, tuple[float, float]]:
    """Positions of the waypoints: start, A, B, ..., goal; those given in part are left out."""
    points = comparison.waypoints
    names = ["start", *map(_letters_of, range(len(points) - 2)), "goal"][: len(points)]
    found = {}
    for name, point in zip(names, points, strict=True):
        x, z = _across_and_down(comparison, point.labels or comparison.outputs, point.position).tolist()
        if np.isfinite(x + z):
            found[name] = (x, z)
    return found


def _letters_of(count: int) -> str:
    """A, B, ..., Z, AA, AB, ..."""
    head, last = divmod(count, 26)
    return (_letters_of(head - 1) if head else "") + chr(ord("A") + last)


CRANE_FIGURES = {
    "crane-sketch": (lambda study: plot_sketch(), "The crane and its variables (figure 2), z down."),
    "crane-blocks": (
        lambda study: plot_blocks(),
        "Structure of the controller (figure 3), drawn from the blocks and connections of the model itself.",
    ),
    "crane-time": (
        lambda study: plot_time(study.comparison),
        "Load, error, sway and controls over time, the step left out. The error's axis is linear up to 1 mm, "
        "logarithmic above.",
    ),
    "crane-step": (
        lambda study: plot_step(study.comparison),
        "The step: force and torque at their limits (dashed), up to the slack rope: where the tension comes to 0 the "
        "model ends, and so does the run.",
    ),
    "crane-plane": (
        lambda study: plot_plane(study.comparison, study.wall),
        "Paths of the load in the plane (thin: planned), up to the time of the last waypoint; the step left out.",
    ),
    "crane-motion": (
        lambda study: plot_motion(study.comparison, study.wall),
        "Trolley, rope and load at equal time steps.",
    ),
    "crane-online": (
        lambda study: plot_online(study.comparison),
        "The load's x with the reference in force (thin), its distance from the goal (millimetres and less cut off), "
        "sway and force.",
    ),
    "crane-sway": (plot_curves, "Sway after a push, with figure 3's generator and with feedback from the load."),
    "crane-curves": (plot_curves, "Where the claim holds: the study's quantity over alpha."),
}
"""Figures of the crane's studies: how they are drawn, and their caption."""
