"""Drawing of each type of section."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import singledispatch

from ctrlplan.planning.bounds import limit_words
from ctrlplan.planning.limits import Margins
from ctrlplan.reports.crane_figures import (
    animation_data,
    plot_motion,
    plot_online,
    plot_paths,
    plot_sketch,
    plot_step,
    plot_time,
)
from ctrlplan.reports.figures import (
    plot_bands,
    plot_blocks,
    plot_curves,
    plot_plane,
    plot_plans,
    plot_responses,
    plot_sweep,
)
from ctrlplan.reports.parts import Animation, Block, Head, Items, Part, Picture, Table, Text
from ctrlplan.reports.path_figure import plot_path
from ctrlplan.reports.planning_figures import plot_baselines
from ctrlplan.reports.style import line_styles, roles_of
from ctrlplan.reports.tables import durations_of, grid_of, metrics_of, spread_of
from ctrlplan.studies.benefit import Benefit
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.grids import Grid
from ctrlplan.studies.roles import Role
from ctrlplan.studies.sections import (
    AnimatedCrane,
    Bands,
    ClaimTable,
    CraneMotion,
    CraneOnline,
    CranePaths,
    CraneSketch,
    CraneStep,
    CraneTime,
    Curves,
    DrawTable,
    FastestMove,
    FittedGains,
    LoopBlocks,
    Paths,
    PlanCurves,
    Plane,
    PlanMargins,
    Responses,
    Section,
    SweepCurves,
)
from ctrlplan.studies.study import Study
from ctrlplan.studies.verdicts import number, unit_in


@singledispatch
def draw(section: Section | Benefit, study: Study) -> Part:
    """Draw a section of a study, by the type of the section.

    Parameters
    ----------
    section : Section
        The section. A new type is registered with a function of the same
        arguments: ``@draw.register``, see `ctrlplan.studies.sections.Section`.
    study : Study
        The study that contains it; comparisons are taken from ``study.comparison``.

    Returns
    -------
    Part

    Raises
    ------
    TypeError
        If no function is registered for the type.
    """
    kind = type(section).__name__
    raise TypeError(f"sections must be of a type that can be drawn, got {kind}; register a function by draw.register")


# Comparisons


@draw.register
def _(section: PlanCurves, study: Study) -> Part:
    caption = section.caption or "References and their derivatives. Circles: prescribed values."
    return Part([Picture("plans", plot_plans(study.comparison, section.derivatives), caption)])


@draw.register
def _(section: Responses, study: Study) -> Part:
    caption = section.caption or "Closed-loop response to each reference: output, tracking error and control."
    return Part([Picture("responses", plot_responses(study.comparison), caption)])


@draw.register
def _(section: Paths, study: Study) -> Part:
    caption = section.caption or (
        "Paths of the outputs in the plane (thin: planned) up to the last waypoint"
        f"{_without_steps(study.comparison, '; ')}."
    )
    return Part([Picture("paths", plot_path(study.comparison, section.obstacles), caption)])


@draw.register
def _(section: Curves, study: Study) -> Part:
    caption = section.caption or f"{section.y_label} versus {section.x_label}."
    return Part([Picture(section.key, plot_curves(section), caption)])


@draw.register
def _(section: FittedGains, study: Study) -> Part:
    rows = [
        [name, term, *map(number, (gain, fit.standard_errors[term], *fit.intervals[term]))]
        for name, fit in section.fits.items()
        for term, gain in fit.gains.items()
    ]
    rows += [
        [name, "delay [s]", *map(number, (fit.delay, fit.delay_error, math.nan, math.nan))]
        for name, fit in section.fits.items()
    ]
    heads = [Head("log"), Head("term"), Head("gain"), Head("standard error"), Head("95 % from"), Head("to")]
    notes = tuple(f"{name}: {note}" for name, fit in section.fits.items() for note in fit.notes)
    words = section.caption or "Feedforward of the control by least squares; the delay is that from control to motion."
    blocks: list[Block] = [Text(words, hint=True), Table(heads, rows, "gains"), Items(notes)]
    return Part(blocks, heading="Feedforward fitted to the log", below=True)


# Sweeps and draws


@draw.register
def _(section: Plane, study: Study) -> Part:
    sweep = section.sweep
    caption = section.caption or (
        f"Settling time versus overshoot on the tracking error for {sweep.parameter} from {sweep.values[0]:g} to "
        f"{sweep.values[-1]:g}. Curves are interrupted where the settling time is discontinuous."
    )
    plot = plot_plane(
        sweep,
        numbered=section.numbered,
        limit=section.limit,
        limit_label=section.limit_label,
        further=section.further,
    )
    return Part([Picture("plane", plot, caption)])


@draw.register
def _(section: SweepCurves, study: Study) -> Part:
    caption = section.caption or f"Metrics versus {section.sweep.parameter}."
    return Part([Picture("gain", plot_sweep(section.sweep, section.metrics), caption)])


@draw.register
def _(section: Bands, study: Study) -> Part:
    caption = section.caption or "Median over the draws (line), and the central 50 % and 90 % of the draws (bands)."
    return Part([Picture("bands", plot_bands(section.ensemble), caption)])


@draw.register
def _(section: DrawTable, study: Study) -> Part:
    hint = "Median over the draws, with the 5 % and 95 % quantiles in parentheses; smaller is better in every row."
    table = spread_of(section.ensemble)
    return Part([Text(hint, hint=True), table], heading="Metrics over the draws", nominal=True)


# Planning


@draw.register
def _(section: FastestMove, study: Study) -> Part:
    found, units = section.fastest, study.comparison.units
    name, time = found.active.bound.name, number(found.active.time)
    table = Table(_MARGIN_HEADS, _margin_rows(found.margins, units), "margins")
    caption = section.caption or (
        "Limited signals of the fastest plan, their limits (dashed), and the point nearest to a limit (marker)."
    )
    words = (
        f"The minimum duration is {number(found.duration)} s. The active limit is {name}, reached at {time} s. The "
        "limits are satisfied over the whole interval, not only at samples."
    )
    blocks: list[Block] = [Text(words), table, Picture("fastest", found.plot(units), caption)]
    return Part(blocks, heading="Minimum duration within limits", below=True)


@draw.register
def _(section: PlanMargins, study: Study) -> Part:
    units = study.comparison.units
    rows = [
        [plan, *row, "satisfied" if margin.fraction >= 0.0 else "violated"]
        for plan, margins in section.margins.items()
        for margin, row in zip(margins, _margin_rows(margins, units), strict=True)
    ]
    words = "Limits of the plans over the whole interval, not only at samples; the smallest margin of each plan first."
    table = Table([Head("plan"), *_MARGIN_HEADS, Head("verdict", words=True)], rows, "plan-margins")
    return Part([Text(words, hint=True), table], heading="Limits of the plans", below=True)


_MARGIN_HEADS = (
    Head("limit"),
    Head("unit", unit=True),
    Head("permitted range", words=True),
    Head("value nearest to the limit"),
    Head("time [s]"),
    Head("margin"),
)


def _margin_rows(margins: Margins, units: Mapping[str, str]) -> list[list[str]]:
    """A row for each limit, with the cells of `_MARGIN_HEADS`."""
    found = []
    for row in margins:
        unit = units.get(row.bound.name, "")
        found.append([row.bound.name, unit, row.bound.range, number(row.value), number(row.time), row.share])
    return found


@draw.register
def _(section: ClaimTable, study: Study) -> Part:
    hint = Text("▲ better than every ranked baseline, ▽ worse than the best ranked baseline (underlined).", hint=True)
    blocks: list[Block] = [Items(section.claim), hint, *_grids([(grid, grid.unit) for grid in section.grids])]
    return Part(blocks, heading="Is the trigonometric path optimal?", below=True)


@draw.register
def _(section: Benefit, study: Study) -> Part:
    compared, known = section.comparison, line_styles(roles_of(study.comparison), measured=study.comparison.measured)
    words = (
        f"A trigonometric plan (alpha = {section.alpha:.4g} rad) is compared with other references through the same "
        "waypoints in the same time. Trapezoid and S-curve stop at every waypoint; the step jumps to the final "
        "position. Steps, shaped or not, violate every limit on a derivative and are not ranked in the tables over "
        "alpha and duration."
    )
    caption = "References through the same waypoints in the same time, with the outputs and controls of the loop."
    limits = "; ".join(f"{name} {limit_words(value, name)}" for name, value in section.limits.items())
    over = (
        "Metrics over duration and alpha: ▲ better than every ranked baseline, ▽ worse than the best ranked baseline "
        "(underlined)."
    )
    blocks: list[Block] = [
        Text(f"{words} {section.note}" if section.note else words),
        Items(section.verdicts),
        Picture("benefit", plot_baselines(compared, known=known), caption),
        Text("Metrics at the same duration:", hint=True),
        metrics_of(compared, "baselines", known),
        Text(f"Minimum duration of each plan under the same limits ({limits}):", hint=True),
        durations_of(section.required_durations),
        Text(over, hint=True),
        *_grids([(grid, unit_in(compared, grid.unit)) for grid in section.grids]),
    ]
    return Part(blocks, heading="Benefit of planning", below=True)


def _grids(grids: list[tuple[Grid, str]]) -> list[Block]:
    """Tables over alpha and duration, each under its title."""
    blocks: list[Block] = []
    for grid, unit in grids:
        title = f"{grid.title} [{unit}]" if unit else grid.title
        blocks += [Text(f"{title} over duration and alpha:", hint=True), grid_of(grid, unit)]
    return blocks


# Cranes and loops


@draw.register
def _(section: CraneSketch, study: Study) -> Part:
    return Part([Picture("crane-sketch", plot_sketch(), section.caption or "The crane and its variables, z down.")])


@draw.register
def _(section: LoopBlocks, study: Study) -> Part:
    caption = section.caption or "Structure of the loop, drawn from the blocks and connections of the model."
    return Part([Picture("crane-blocks", plot_blocks(section.loop, section.titles), caption)])


@draw.register
def _(section: CraneTime, study: Study) -> Part:
    caption = section.caption or (
        "Load, tracking error, sway and controls versus time. The error axis is linear up to 1 mm and logarithmic "
        "above; the step does not set the other axes."
    )
    return Part([Picture("crane-time", plot_time(study.comparison), caption)])


@draw.register
def _(section: CraneStep, study: Study) -> Part:
    caption = section.caption or "Step: force, torque, rope tension and sway, with limits (dashed)."
    return Part([Picture("crane-step", plot_step(study.comparison), caption)])


@draw.register
def _(section: CranePaths, study: Study) -> Part:
    caption = section.caption or (
        "Paths of the load in the plane (thin: planned) up to the last waypoint"
        f"{_without_steps(study.comparison, '; ')}."
    )
    return Part([Picture("crane-plane", plot_paths(study.comparison, section.wall), caption)])


@draw.register
def _(section: CraneMotion, study: Study) -> Part:
    caption = section.caption or "Trolley, rope and load at equal time intervals."
    return Part([Picture("crane-motion", plot_motion(study.comparison, section.wall), caption)])


@draw.register
def _(section: CraneOnline, study: Study) -> Part:
    caption = section.caption or (
        "Load position x and its reference (thin), distance of the load from the goal (values below 1 mm are not "
        "shown), sway and force."
    )
    return Part([Picture("crane-online", plot_online(study.comparison), caption)])


@draw.register
def _(section: AnimatedCrane, study: Study) -> Part:
    data = animation_data(study.comparison, section.wall, section.shown)
    return Part([Animation(data, section.caption) if section.caption else Animation(data)])


def _without_steps(comparison: Comparison, joint: str) -> str:
    """Note that steps are omitted, if there are steps and other plans."""
    steps = [name for name, role in roles_of(comparison).items() if role is Role.STEP]
    if not steps or len(steps) == len(comparison.plans):
        return ""
    return f"{joint}the step is omitted" if len(steps) == 1 else f"{joint}steps are omitted"
