"""What a page shows of a study or of a sweep: a headline, a table, a figure, and folds with everything else."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import singledispatch
from importlib import metadata
from typing import overload

from markupsafe import Markup

import ctrlplan
from ctrlplan._display import in_line
from ctrlplan.reports.main_figure import main_figure, main_figure_of_sweep
from ctrlplan.reports.parts import (
    Animation,
    Block,
    Cell,
    Head,
    Items,
    MetricRow,
    Pairs,
    Panels,
    Picture,
    Svg,
    Table,
    Text,
)
from ctrlplan.reports.readout import mark_curves, readout_data
from ctrlplan.reports.sections import draw
from ctrlplan.reports.style import line_styles, roles_of, slug, to_svg
from ctrlplan.reports.tables import by_plan, extrema_of, key_table_of, limits_of_runs, metrics_of, plan_of, values_of
from ctrlplan.studies.benefit import Benefit
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.sections import DrawTable, Section
from ctrlplan.studies.study import Study
from ctrlplan.studies.sweep import Sweep
from ctrlplan.studies.verdicts import headline

_SIGNS = "▲ best, ▽ worst; smaller is better for every metric. Values within 1 % of the better one count as equal."


@dataclass(frozen=True)
class Fold:
    """Part of a page that is closed at first.

    Attributes
    ----------
    heading : str
        What it contains.
    blocks : tuple of Block
        Contents, in order.
    """

    heading: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Shown:
    """A study or a sweep on the page.

    Attributes
    ----------
    id : str
        Id of its section.
    title, headline : str
        Heading, and the numbers that matter, in a sentence or two.
    text : tuple of str
        Free text, a paragraph each.
    table : Table
        Key metrics.
    notes : tuple of str
        What a reader must know of the table.
    figure : Panels
        The main figure.
    folds : tuple of Fold
        Everything else.
    """

    id: str
    title: str
    headline: str
    text: tuple[str, ...]
    table: Table
    notes: tuple[str, ...]
    figure: Panels
    folds: tuple[Fold, ...]

    @property
    def blocks(self) -> list[Block]:
        """All blocks, in order."""
        return [self.table, self.figure, *(block for fold in self.folds for block in fold.blocks)]

    @property
    def figures(self) -> list[Picture | Svg | Animation]:
        """All figures, in order."""
        return list(_figures(self.blocks))

    @property
    def ids(self) -> list[str]:
        """Every id of the section, its own included."""
        return [self.id, *(figure.key for figure in self.figures)]


@singledispatch
def shown(subject: Study | Sweep, taken: Sequence[str]) -> Shown:
    """What a page shows of a study or of a sweep, figures drawn.

    Parameters
    ----------
    subject : Study or Sweep
        What is shown.
    taken : sequence of str
        Ids that the page has already.

    Raises
    ------
    TypeError
        If it is neither.
    """
    raise TypeError(f"a page must be of studies or sweeps, got {type(subject).__name__}")


@shown.register
def _(study: Study, taken: Sequence[str]) -> Shown:
    comparison = study.comparison
    sections: list[Section | Benefit] = list(study.sections)
    if comparison.benefit is not None:
        sections.append(comparison.benefit)
    parts = [draw(section, study) for section in sections]
    marks = [f"† {plan}: {mark}." for plan, mark in comparison.marks.items()]
    drawn = [part for part in parts if part.nominal]
    nominal, title = (
        ("At the nominal parameters. ", "Metrics at the nominal parameters") if drawn else ("", "All metrics")
    )
    folds = [
        Fold("Findings", _words(study)),
        *(Fold(part.heading, tuple(part.blocks)) for part in parts if part.heading and not part.below),
        Fold(
            title,
            (
                Text(f"{_SIGNS} Click a column heading to sort.", hint=True),
                metrics_of(comparison),
                *_definitions(comparison),
            ),
        ),
        Fold("All figures", tuple(block for part in parts if not part.heading for block in part.blocks)),
        *(Fold(part.heading, tuple(part.blocks)) for part in parts if part.heading and part.below),
        Fold("Limits", _limits(comparison)),
        Fold("Failed plans", _failures("plan", comparison.failures)),
        Fold("Parameters and versions", _parameters(comparison.parameters)),
    ]
    return _drawn(
        Shown(
            study.name,
            study.title,
            f"{nominal}{headline(comparison)}{_failed_draws(sections)}",
            study.text,
            key_table_of(comparison),
            (_SIGNS, *marks),
            main_figure(study),
            tuple(fold for fold in folds if fold.blocks),
        ),
        taken,
    )


@shown.register
def _(sweep: Sweep, taken: Sequence[str]) -> Shown:
    styles = line_styles(roles_of(sweep))
    plans = [plan_of(name, styles[name]) for name in sweep.metrics]
    table = sweep.metric_table()
    names = list(sweep.key_metrics())
    rows = [MetricRow(row[0], row[1], [*map(_cell, row[2:])]) for row in table.rows]
    failures = {f"{sweep.parameter} = {sweep.values[one.draw]:.6g}": one.message for one in sweep.failures}
    every = Picture("curves", sweep.plot(names), f"Metrics versus {sweep.parameter}.")
    folds = [
        Fold("All figures", (every,)),
        Fold("All values", tuple(values_of(sweep))),
        Fold("Failed values", _failures(sweep.parameter, failures)),
        Fold("Versions", _parameters({})),
    ]
    return _drawn(
        Shown(
            "sweep",
            f"Sweep over {sweep.parameter}",
            extrema_of(sweep),
            (),
            by_plan(plans, rows),
            (f"Minimum to maximum over {sweep.values.size} values of {sweep.parameter}.",),
            main_figure_of_sweep(sweep, names),
            tuple(fold for fold in folds if fold.blocks),
        ),
        taken,
    )


def _failed_draws(sections: Iterable[Section | Benefit]) -> str:
    """Number of failed draws of a study, in a sentence."""
    for section in sections:
        if isinstance(section, DrawTable) and section.ensemble.failures:
            failed = len({one.draw for one in section.ensemble.failures})
            return f" Of {section.ensemble.finished} draws, {failed} failed."
    return ""


def _definitions(comparison: Comparison) -> tuple[Block, ...]:
    """Definitions of the metrics that a comparison has, each once."""
    known = {name for row in comparison.metrics.values() for name in row}
    said = dict.fromkeys(one.definition for name, one in comparison.measures.items() if name in known)
    found = [definition for definition in said if definition]
    return (Items(found),) if found else ()


def _words(study: Study) -> tuple[Block, ...]:
    """What a study is, and what was found."""
    found: list[Block] = [Text(study.summary)] if study.summary else []
    if study.notes:
        found.append(Items(study.notes))
    return tuple(found)


def _limits(comparison: Comparison) -> tuple[Block, ...]:
    table = limits_of_runs(comparison)
    hint = "Limits of the actuators of each loop, with the value nearest to the limit and its margin."
    return () if table is None else (Text(hint, hint=True), table)


def _parameters(given: Mapping[str, object]) -> tuple[Block, ...]:
    """Parameters of a study, and the versions of the packages that computed it."""
    packages = ("control", "numpy", "scipy", "matplotlib", "casadi")
    versions = {"ctrlplan": ctrlplan.__version__, "Python": platform.python_version()}
    for name in packages:
        with suppress(metadata.PackageNotFoundError):  # an extra
            versions[name] = metadata.version(name)
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    return (Pairs({name: in_line(value) for name, value in given.items()} | {"versions": listed}),)


def _failures(what: str, reasons: Mapping[str, str]) -> tuple[Block, ...]:
    """Runs that failed, with their reasons."""
    rows = [[name, reason] for name, reason in reasons.items()]
    return (Table([what, Head("reason", words=True)], rows, "failures"),) if rows else ()


def _cell(text: str) -> Cell:
    return Cell(text.replace("-", "−"))


# Figures


def _figures(blocks: Iterable[Block]) -> Iterable[Picture | Svg | Animation]:
    for block in blocks:
        if isinstance(block, Panels):
            yield from block.pictures
        elif isinstance(block, Picture | Svg | Animation):
            yield block


def _drawn(given: Shown, taken: Sequence[str]) -> Shown:
    """The same with figures as SVG elements, under ids that no other on the page has."""
    keys: list[str] = []
    for block in _figures(given.blocks):
        keys.append(_numbered(slug(block.key), lambda key: key in keys))
    name = _numbered(slug(given.id), lambda name: not {name, *(f"{name}-{key}" for key in keys)}.isdisjoint(taken))
    left = iter(keys)

    def panels(block: Panels) -> Panels:
        return replace(block, pictures=[_svg(one, name, next(left)) for one in block.pictures])

    def as_svg(block: Block) -> Block:
        if isinstance(block, Panels):
            return panels(block)
        return _svg(block, name, next(left)) if isinstance(block, Picture | Svg | Animation) else block

    figure = panels(given.figure)
    folds = tuple(replace(fold, blocks=tuple(map(as_svg, fold.blocks))) for fold in given.folds)
    return replace(given, id=name, figure=figure, folds=folds)


@overload
def _svg(block: Picture | Svg, name: str, key: str) -> Svg: ...
@overload
def _svg(block: Animation, name: str, key: str) -> Animation: ...
def _svg(block: Picture | Svg | Animation, name: str, key: str) -> Svg | Animation:
    """A figure with its id on the page for a key, a plot as an SVG element."""
    if isinstance(block, Picture):
        figure, salt = block.plot.figure, f"{name}.{key}"
        mark_curves(figure)
        svg = Markup(to_svg(figure, salt))  # noqa: S704 (our own drawing)
        return Svg(f"{name}-{key}", svg, block.caption, readout_data(figure, salt))
    return replace(block, key=f"{name}-{key}")


def _numbered(stem: str, taken: Callable[[str], bool]) -> str:
    """A name, with the first number at which it is free where it is taken."""
    name, count = stem, 1
    while taken(name):
        count += 1
        name = f"{stem}-{count}"
    return name
