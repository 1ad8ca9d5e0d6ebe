"""Figures of the crane: the paper's 2 to 6, its motion, and an animation that plays offline."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, FancyArrowPatch, FancyBboxPatch, Rectangle
from numpy.typing import NDArray

from ctrlplan.reports.style import house_style, legend_above, line_styles, new_figure, stacked_axes
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.crane_setup import CRANE, FORCE_LIMITS, TORQUE_LIMITS, nominal_waypoints
from ctrlplan.studies.measures import signals_of
from ctrlplan.studies.study import Study
from ctrlplan.systems.plants import crane_loop
from ctrlplan.trajectories import PolySpline

Array = NDArray[np.float64]

Wall = tuple[tuple[float, float], tuple[float, float]] | None
MAIN = ("step", "polynomial", "trigonometric", "piecewise")
"""Plans that figures over time show; more would hide one another."""


@house_style
def plot_sketch() -> Figure:
    """Figure 2: the crane and its variables."""
    figure = new_figure(5.6, 4.4)
    ((axes,),) = stacked_axes(figure, 1)
    axes.axis("off")
    axes.set_aspect("equal")
    d, b, r, theta = 2.4, 0.45, 3.6, 0.38
    tangent = np.array([d + b * np.cos(theta), -b * np.sin(theta)])
    load = tangent + r * np.array([np.sin(theta), np.cos(theta)])
    axes.plot([-0.3, 6.6], [b + 0.28, b + 0.28], color="#999999", linewidth=3)
    axes.add_patch(Rectangle((d - 0.8, b + 0.02), 1.6, 0.2, color="#333333"))
    axes.add_patch(Circle((d, 0.0), b, fill=False, color="#333333", linewidth=1.6))
    axes.plot([tangent[0], load[0]], [-tangent[1], -load[1]], color="#0072B2", linewidth=1.6)
    axes.add_patch(Circle((load[0], -load[1]), 0.22, color="#D55E00"))
    axes.plot([tangent[0], tangent[0]], [-tangent[1], -3.0], color="#666666", linewidth=0.8, linestyle="--")
    axes.add_patch(
        Arc((tangent[0], -tangent[1]), 3.2, 3.2, theta1=270, theta2=270 + np.degrees(theta), color="#666666")
    )

    def arrow(start: tuple[float, float], end: tuple[float, float], text: str, offset: tuple[float, float]) -> None:
        axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=12, color="#333333"))
        axes.annotate(text, end, xytext=offset, textcoords="offset points", fontsize=11)

    arrow((-0.2, 0.0), (1.0, 0.0), "x", (2, 4))
    arrow((-0.2, 0.0), (-0.2, -1.2), "z (down)", (5, -2))
    arrow((-0.2, 1.15), (d, 1.15), "D", (-38, 5))
    arrow((d + 0.8, b + 0.12), (d + 1.7, b + 0.12), "F", (3, -3))
    arrow((float(load[0]), -float(load[1])), (float(load[0]), -float(load[1]) - 0.95), "m g", (5, 0))
    axes.add_patch(Arc((d, 0.0), 1.5, 1.5, theta1=120, theta2=240, color="#333333"))
    for text, place in (
        ("C", (d - 1.05, 0.0)),
        ("b", (d + 0.08, -0.32)),
        ("R, T", tuple(0.5 * (tangent + load) * [1, -1] + [0.15, 0.1])),
        (r"$\theta$", (tangent[0] + 0.2, -tangent[1] - 2.0)),
        ("m", (load[0] + 0.3, -load[1] - 0.08)),
        (r"$M_c$, $f_1$", (d - 2.1, b + 0.05)),
        (r"J, $f_2$", (d + 0.5, 0.05)),
    ):
        axes.text(float(place[0]), float(place[1]), text, fontsize=11)
    axes.set_xlim(-0.6, 6.8)
    axes.set_ylim(-4.9, 1.6)
    return figure


@house_style
def plot_blocks() -> Figure:
    """Figure 3: the controller, drawn from the blocks and connections of the model itself."""
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
    figure = new_figure(8.4, 3.2)
    ((axes,),) = stacked_axes(figure, 1)
    axes.axis("off")
    for name, (x, y) in place.items():
        box = FancyBboxPatch((x - 0.75, y - 0.35), 1.5, 0.7, boxstyle="round,pad=0.02", fc="#f3f7f9", ec="#333333")
        axes.add_patch(box)
        axes.text(x, y, titles.get(name, name), ha="center", va="center", fontsize=9)
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
            FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color="#333333", connectionstyle=style)
        )
        axes.text(*at, text, ha="center", va="center", fontsize=8, color="#0072B2")
    axes.set_xlim(-0.9, 8.7)
    axes.set_ylim(-2.1, 2.1)
    return figure


@house_style
def plot_time(comparison: Comparison) -> Figure:
    """Load, error, sway and controls over time, as the paper's figures 4 and 5 lay them out."""
    names = [n for n in comparison.plans if n != "step"]
    styles = line_styles(comparison.plans)
    figure = new_figure(7.4, 9.4)
    rows = [row[0] for row in stacked_axes(figure, 6)]
    for name in names:
        signals = _signals(comparison, name)
        t, plan = signals["t"], comparison.plans[name]
        reference = plan.jet(t, 0)[0]
        error = np.hypot(signals["x"] - reference[0], signals["z"] - reference[1])
        for axes, values in zip(
            rows,
            (signals["x"], signals["z"], 1e3 * error, signals["theta"], signals["F"] / 1e3, signals["C"] / 1e3),
            strict=True,
        ):
            axes.plot(t, values, **styles[name])
    for axes, label in zip(rows, ("x [m]", "z [m]", "error [mm]", "sway [rad]", "F [kN]", "C [kN m]"), strict=True):
        axes.set_ylabel(label)
    rows[1].invert_yaxis()
    rows[2].set_yscale("symlog", linthresh=1.0)
    rows[2].set_ylim(bottom=0.0)
    rows[-1].set_xlabel("time [s]")
    legend_above(figure, rows[0])
    return figure


@house_style
def plot_step(comparison: Comparison) -> Figure:
    """What a step asks of the drives, and the rope it leaves slack."""
    signals = _signals(comparison, "step")
    t, colour = signals["t"], line_styles(comparison.plans)["step"]["color"]
    figure = new_figure(7.0, 6.4)
    rows = [row[0] for row in stacked_axes(figure, 4)]
    scales = (("F", 1e3, "F [kN]", FORCE_LIMITS), ("C", 1e3, "C [kN m]", TORQUE_LIMITS), ("T", 1e3, "T [kN]", (0.0,)))
    for axes, (name, scale, label, limits) in zip(rows, scales, strict=False):
        axes.plot(t, signals[name] / scale, color=colour, linewidth=1.0, label="step")
        for k, limit in enumerate(limits):
            axes.axhline(limit / scale, color="#D55E00", linewidth=1.0, linestyle="--", label="" if k else "limit")
        axes.set_ylabel(label)
    rows[2].fill_between(t, signals["T"] / 1e3, 0.0, where=signals["T"] < 0.0, color="#D55E00", alpha=0.4)
    rows[3].plot(t, signals["theta"], color=colour, linewidth=1.0)
    rows[3].set_ylabel("sway [rad]")
    rows[3].set_xlabel("time [s]")
    legend_above(figure, rows[0])
    return figure


@house_style
def plot_plane(comparison: Comparison, wall: Wall) -> Figure:
    """Paths of the load in the plane, z down, with the obstacle (figure 6)."""
    styles = line_styles(comparison.plans)
    figure = new_figure(7.4, 4.6)
    ((axes,),) = stacked_axes(figure, 1)
    if wall:
        (left, right), (top, ground) = wall
        axes.add_patch(Rectangle((left, top), right - left, ground - top, color="#bbbbbb", zorder=0))
        axes.text(0.5 * (left + right), 0.5 * (top + ground), "wall", ha="center", fontsize=9)
    last = comparison.waypoints[-1].time
    for name, plan in comparison.plans.items():
        if plan.jumps(0):  # steps take no path
            continue
        signals = _signals(comparison, name)
        way = signals["t"] <= last
        planned = plan.jet(signals["t"][way], 0)[0]
        axes.plot(planned[0], planned[1], color=styles[name]["color"], linewidth=0.7, alpha=0.6)
        axes.plot(signals["x"][way], signals["z"][way], **styles[name])
    for i, point in enumerate(comparison.waypoints):
        axes.plot(*point.position, "o", color="#444444", mfc="white", zorder=5)
        text = "start" if i == 0 else "goal" if point.time == last else "AB"[i - 1]
        axes.annotate(text, tuple(point.position.tolist()), xytext=(6, -10), textcoords="offset points", fontsize=9)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("z [m], down")
    axes.invert_yaxis()
    legend_above(figure, axes)
    return figure


@house_style
def plot_motion(comparison: Comparison, wall: Wall, steps: int = 13) -> Figure:
    """Trolley, rope and load at equal time steps along each plan."""
    names = [n for n in ("polynomial", "trigonometric") if n in comparison.plans]
    figure = new_figure(7.4, 6.8)
    rows = [row[0] for row in stacked_axes(figure, len(names))]
    last = comparison.waypoints[-1].time
    colours = line_styles(comparison.plans)
    for name, axes in zip(names, rows, strict=True):
        signals = _signals(comparison, name)
        if wall:
            (left, right), (top, ground) = wall
            axes.add_patch(Rectangle((left, top), right - left, ground - top, color="#cccccc", zorder=0))
        axes.axhline(0.0, color="#999999", linewidth=2)
        colour = colours[name]["color"]
        axes.plot(signals["x"], signals["z"], color=colour, linewidth=0.8)
        for t in np.linspace(0.0, min(last, signals["t"][-1]), steps):
            d, r, theta = (float(np.interp(t, signals["t"], signals[k])) for k in ("D", "R", "theta"))
            _draw_crane(axes, d, r, theta, colour)
        axes.set_title(f"{name}: every {min(last, signals['t'][-1]) / (steps - 1):.3g} s", loc="left", fontsize=9)
        axes.set_ylabel("z [m], down")
        axes.invert_yaxis()
        axes.set_aspect("equal")
    rows[-1].set_xlabel("x [m]")
    return figure


@house_style
def plot_curves(study: Study) -> Figure:
    """The curves that a study computed for itself."""
    curves = study.curves[0]
    figure = new_figure(7.0, 3.8)
    ((axes,),) = stacked_axes(figure, 1)
    palette = ("#0072B2", "#D55E00", "#009E73", "#000000", "#CC79A7", "#E69F00")
    for i, (name, row) in enumerate(curves.rows.items()):
        style = "-" if i % 2 == 0 else (0, (5, 1.5))
        axes.plot(curves.x, row, color=palette[(i // 2 if curves.log else i) % 6], linestyle=style, label=name)
    if curves.log:
        axes.set_yscale("log")
    axes.set_xlabel(curves.x_label)
    axes.set_ylabel(curves.y_label)
    legend_above(figure, axes)
    return figure


@house_style
def plot_online(comparison: Comparison) -> Figure:
    """Load, reference in force, distance from the goal, sway and force of each way to run one plan."""
    styles = line_styles(comparison.plans)
    figure = new_figure(7.4, 8.2)
    rows = [row[0] for row in stacked_axes(figure, 4)]
    for name, plan in comparison.plans.items():
        signals = _signals(comparison, name)
        distance = np.hypot(signals["x"] - plan.final[0], signals["z"] - plan.final[1])
        rows[0].plot(signals["t"], signals["x_ref"], color=styles[name]["color"], linewidth=0.7, alpha=0.6)
        for axes, values in zip(rows, (signals["x"], distance, signals["theta"], signals["F"] / 1e3), strict=True):
            axes.plot(signals["t"], values, **styles[name])
    for axes, label in zip(rows, ("x [m]", "distance from goal [m]", "sway [rad]", "F [kN]"), strict=True):
        axes.set_ylabel(label)
    rows[1].set_yscale("log")
    rows[1].set_ylim(bottom=1e-3)
    rows[-1].set_xlabel("time [s]")
    legend_above(figure, rows[0])
    return figure


def animation_data(comparison: Comparison, wall: Wall = None, rate: float = 12.0) -> str:
    """JSON for the animation: trolley, rope and angle of each plan at equal time steps."""
    frames: dict[str, Any] = {"b": CRANE.drum_radius, "rate": rate, "plans": {}}
    for name in comparison.plans:
        signals = _signals(comparison, name)
        t = np.arange(0.0, signals["t"][-1], 1.0 / rate)
        columns = [np.interp(t, signals["t"], signals[k]) for k in ("D", "R", "theta")]
        frames["plans"][name] = [np.round(column, 3).tolist() for column in columns]
    frames["wall"] = wall
    return json.dumps(frames)


def is_crane(comparison: Comparison) -> bool:
    """Whether a comparison is of a crane, so that it can be drawn as one."""
    first = next(iter(comparison.responses.values()))
    return {"x", "z", "D", "R", "theta"} <= set(first.output_labels or ())


def _signals(comparison: Comparison, name: str) -> dict[str, Array]:
    response = comparison.responses[name]
    return signals_of(response) | {"t": np.asarray(response.time)}


def _draw_crane(axes: Axes, d: float, r: float, theta: float, colour: str) -> None:
    b = CRANE.drum_radius
    tangent = (d + b * np.cos(theta), -b * np.sin(theta))
    load = (tangent[0] + r * np.sin(theta), tangent[1] + r * np.cos(theta))
    axes.add_patch(Rectangle((d - 0.4, -0.25), 0.8, 0.25, color="#333333", zorder=3))
    axes.plot([tangent[0], load[0]], [tangent[1], load[1]], color="#888888", linewidth=0.7)
    axes.plot(*load, "o", color=colour, markersize=4.5, zorder=4)


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
