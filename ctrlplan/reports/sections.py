"""How each type of section is drawn."""

from __future__ import annotations

from functools import singledispatch

from ctrlplan.planning.limits import limit_words
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
    LoopBlocks,
    PlanCurves,
    Plane,
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
        What is drawn. A new type is registered with a function of the same
        arguments: ``@draw.register``, see `ctrlplan.studies.sections.Section`.
    study : Study
        Whose section it is; sections of a comparison are of ``study.comparison``.

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
    caption = section.caption or "The references and their derivatives; circles are prescribed values."
    return Part([Picture("plans", plot_plans(study.comparison, section.derivatives), caption)])


@draw.register
def _(section: Responses, study: Study) -> Part:
    caption = section.caption or "What the loop does with each reference: output, error and control."
    return Part([Picture("responses", plot_responses(study.comparison), caption)])


@draw.register
def _(section: Curves, study: Study) -> Part:
    caption = section.caption or f"{section.y_label} over {section.x_label}."
    return Part([Picture(section.key, plot_curves(section), caption)])


# Sweeps and draws


@draw.register
def _(section: Plane, study: Study) -> Part:
    sweep = section.sweep
    caption = section.caption or (
        f"Settling time against overshoot on the error as {sweep.parameter} runs from {sweep.values[0]:g} to "
        f"{sweep.values[-1]:g}. Curves are broken where the settling time jumps."
    )
    plot = plot_plane(sweep, numbered=section.numbered, limit=section.limit, limit_label=section.limit_label)
    return Part([Picture("plane", plot, caption)])


@draw.register
def _(section: SweepCurves, study: Study) -> Part:
    caption = section.caption or f"Metrics over {section.sweep.parameter}."
    return Part([Picture("gain", plot_sweep(section.sweep, section.metrics), caption)])


@draw.register
def _(section: Bands, study: Study) -> Part:
    caption = (
        section.caption or "Spread over the draws: the median, and the bands that hold half and nine tenths of them."
    )
    return Part([Picture("bands", plot_bands(section.ensemble), caption)])


@draw.register
def _(section: DrawTable, study: Study) -> Part:
    hint = "The median, and in brackets where nine tenths of the draws lie; less is better in every row."
    table = spread_of(section.ensemble)
    return Part([Text(hint, hint=True), table], heading="Metrics over the draws", nominal=True)


# Planning


@draw.register
def _(section: FastestMove, study: Study) -> Part:
    found, units = section.fastest, study.comparison.units
    name, time = found.active.bound.name, number(found.active.time)
    heads = [
        Head("limit"),
        Head("unit", unit=True),
        Head("must stay", words=True),
        Head("comes to"),
        Head("at [s]"),
        Head("left"),
    ]
    rows = []
    for row in found.margins:
        unit = units.get(row.bound.name, "")
        rows.append([row.bound.name, unit, row.bound.range, number(row.value), number(row.time), row.share])
    caption = section.caption or (
        "Every limited signal of the fastest plan, and where it comes nearest to its limits (dashed)."
    )
    words = (
        f"{number(found.duration)} s is the shortest duration; {name} is at its limit at {time} s. Limits hold over "
        "the whole interval, not at samples."
    )
    blocks: list[Block] = [Text(words), Table(heads, rows, "margins"), Picture("fastest", found.plot(units), caption)]
    return Part(blocks, heading="As fast as limits allow", below=True)


@draw.register
def _(section: ClaimTable, study: Study) -> Part:
    hint = Text("▲ better than every rival that counts, ▽ worse than the best of them (underlined).", hint=True)
    blocks: list[Block] = [Items(section.claim), hint, *_grids([(grid, grid.unit) for grid in section.grids])]
    return Part(blocks, heading="Is the trigonometric path optimal?", below=True)


@draw.register
def _(section: Benefit, study: Study) -> Part:
    compared, known = section.comparison, line_styles(roles_of(study.comparison))
    words = (
        f"A trigonometric plan (alpha = {section.alpha:.4g} rad) beside what else could be sent through the same "
        "waypoints in the same time. Profiles stop at every waypoint; the step goes to the goal at once. Steps, shaped "
        "or not, keep no limit and do not count as rivals in the tables over alpha and duration."
    )
    caption = (
        "References through the same waypoints in the same time, what the loop makes of them, and what that asks of "
        "its controls."
    )
    limits = "; ".join(f"{limit} {limit_words(value)}" for limit, value in section.limits.items())
    over = "Over duration and alpha: ▲ better than every rival that counts, ▽ worse than the best of them (underlined)."
    blocks: list[Block] = [
        Text(f"{words} {section.note}" if section.note else words),
        Items(section.verdicts),
        Picture("worth", plot_baselines(compared, known=known), caption),
        Text("In the same time:", hint=True),
        metrics_of(compared, "baselines", known),
        Text(f"Under the same limits ({limits}), the shortest duration of each:", hint=True),
        durations_of(section.required_durations),
        Text(over, hint=True),
        *_grids([(grid, unit_in(compared, grid.unit)) for grid in section.grids]),
    ]
    return Part(blocks, heading="Is it worth it?", below=True)


def _grids(grids: list[tuple[Grid, str]]) -> list[Block]:
    """Tables over alpha and duration, each with what it shows."""
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
    caption = section.caption or "Structure of the loop, drawn from the blocks and connections of the model itself."
    return Part([Picture("crane-blocks", plot_blocks(section.loop, section.titles), caption)])


@draw.register
def _(section: CraneTime, study: Study) -> Part:
    caption = section.caption or (
        f"Load, error, sway and controls over time{_without_steps(study.comparison, ', ')}. The error's axis is linear "
        "up to 1 mm, logarithmic above."
    )
    return Part([Picture("crane-time", plot_time(study.comparison), caption)])


@draw.register
def _(section: CraneStep, study: Study) -> Part:
    caption = section.caption or "The step: force, torque, tension of the rope and sway, with their limits (dashed)."
    return Part([Picture("crane-step", plot_step(study.comparison), caption)])


@draw.register
def _(section: CranePaths, study: Study) -> Part:
    caption = section.caption or (
        "Paths of the load in the plane (thin: planned), up to the time of the last waypoint"
        f"{_without_steps(study.comparison, '; ')}."
    )
    return Part([Picture("crane-plane", plot_paths(study.comparison, section.wall), caption)])


@draw.register
def _(section: CraneMotion, study: Study) -> Part:
    caption = section.caption or "Trolley, rope and load at equal time steps."
    return Part([Picture("crane-motion", plot_motion(study.comparison, section.wall), caption)])


@draw.register
def _(section: CraneOnline, study: Study) -> Part:
    caption = section.caption or (
        "The load's x with the reference in force (thin), its distance from the goal (millimetres and less cut off), "
        "sway and force."
    )
    return Part([Picture("crane-online", plot_online(study.comparison), caption)])


@draw.register
def _(section: AnimatedCrane, study: Study) -> Part:
    data = animation_data(study.comparison, section.wall, section.shown)
    return Part([Animation(data, section.caption) if section.caption else Animation(data)])


def _without_steps(comparison: Comparison, joint: str) -> str:
    """That steps are not drawn, where there are any beside other plans."""
    steps = [name for name, role in roles_of(comparison).items() if role is Role.STEP]
    if not steps or len(steps) == len(comparison.plans):
        return ""
    return f"{joint}the step left out" if len(steps) == 1 else f"{joint}steps left out"
