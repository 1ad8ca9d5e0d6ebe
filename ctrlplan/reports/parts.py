"""Contents of a section on the page: figures, text and tables, in order."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from control import ControlPlot
from markupsafe import Markup


@dataclass(frozen=True)
class Picture:
    """A figure with its caption.

    Attributes
    ----------
    key : str
        Id of the figure within its study; a number is added to a repeated one.
    plot : control.ControlPlot
        Figure, as returned by the plotting functions.
    caption : str
        Caption, one or two sentences.
    """

    key: str
    plot: ControlPlot
    caption: str


@dataclass(frozen=True)
class Svg:
    """A figure as an SVG element, with its caption.

    Attributes
    ----------
    key : str
        As of `Picture`.
    svg : Markup
        The element.
    caption : str
        What is seen, in a sentence or two.
    data : Markup
        What the read-out of the page must know of it, as of
        `ctrlplan.reports.readout.readout_data`; empty for none.
    """

    macro: ClassVar[str] = "picture"
    key: str
    svg: Markup
    caption: str
    data: str = ""


@dataclass(frozen=True)
class Text:
    """A paragraph.

    Attributes
    ----------
    words : str
        The text.
    hint : bool
        Whether it explains how to read what follows: in small type on the
        screen, omitted in print.
    """

    macro: ClassVar[str] = "text"
    words: str
    hint: bool = False


@dataclass(frozen=True)
class Items:
    """Sentences in a list.

    Attributes
    ----------
    sentences : sequence of str
        The sentences.
    """

    macro: ClassVar[str] = "items"
    sentences: Sequence[str]


@dataclass(frozen=True)
class Pairs:
    """Names with their values.

    Attributes
    ----------
    rows : mapping of str to str
        Name and value.
    """

    macro: ClassVar[str] = "pairs"
    rows: Mapping[str, str]


@dataclass(frozen=True)
class Panels:
    """Small figures side by side, or one above the other where the page is narrow, with one legend.

    Attributes
    ----------
    pictures : sequence of Picture or Svg
        One axes each.
    legend : sequence of Plan
        The curves.
    caption : str
        What is seen, in a sentence or two.
    """

    macro: ClassVar[str] = "panels"
    pictures: Sequence[Picture | Svg]
    legend: Sequence[Plan]
    caption: str


@dataclass(frozen=True)
class Animation:
    """Animation of a crane.

    Attributes
    ----------
    data : Markup
        As `ctrlplan.reports.crane_figures.animation_data` returns it.
    caption : str
        Caption.
    key : str
        As of `Picture`.
    """

    macro: ClassVar[str] = "animation"
    data: Markup
    caption: str = "Animation of the crane for each plan, at three times real speed."
    key: str = "animation"


@dataclass(frozen=True)
class Head:
    """Heading of a column.

    Attributes
    ----------
    text : str
        The heading.
    words : bool
        Whether the column contains text: left-aligned, with line breaks.
    unit : bool
        Whether the column has units: aligned to the left, and grey.
    colour : str
        Colour of a plan's curves, for a column of a plan.
    note : bool
        Whether the column has notes: grey.
    """

    text: str
    words: bool = False
    unit: bool = False
    colour: str = ""
    note: bool = False


@dataclass(frozen=True)
class Cell:
    """Cell of a table.

    Attributes
    ----------
    text : str
        Content.
    mark : {"", "better", "worse", "reference"}
        Whether the value is better or worse than others, or the reference of
        the comparison.
    meaning : str
        Meaning of the mark, for screen readers.
    order : str or None
        Sort key in a sortable column, as a number: empty for none,
        "1e999" for infinite.
    colour : str
        Colour of a plan's curves, for a row of a plan.
    """

    text: str
    mark: str = ""
    meaning: str = ""
    order: str | None = None
    colour: str = ""

    @property
    def marked(self) -> str:
        """Text with the sign of its mark."""
        return self.text + {"better": " ▲", "worse": " ▽"}.get(self.mark, "")


@dataclass(frozen=True)
class Table:
    """A table whose first column names the rows.

    Attributes
    ----------
    heads : sequence of Head or str
        Headings of the columns.
    rows : sequence of sequence of Cell or str
        Cells, one for each heading.
    kind : str
        Class of the table in the page's style.

    Raises
    ------
    ValueError
        If a row has more or fewer cells than there are headings.
    """

    macro: ClassVar[str] = "plain_table"
    heads: Sequence[Head | str]
    rows: Sequence[Sequence[Cell | str]]
    kind: str = "plain"

    def __post_init__(self) -> None:
        for place, row in enumerate(self.rows):
            if len(row) != len(self.heads):
                raise ValueError(f"rows[{place}] must have {len(self.heads)} cells, one per heading, got {len(row)}")

    @property
    def columns(self) -> list[Head]:
        """Headings of the columns."""
        return [head if isinstance(head, Head) else Head(head) for head in self.heads]

    @property
    def lines(self) -> list[list[Cell]]:
        """Rows of cells."""
        return [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in self.rows]

    @property
    def layout(self) -> str:
        """Classes in the page's style: the width below which cells of a row stand below each other, and how."""
        heads, rows = self.columns, self.lines
        cells = [
            [word for line in rows for word in (line[k].text.split() if head.words else [line[k].marked])]
            for k, head in enumerate(heads)
        ]
        return _layout(self.kind, [line[0].text for line in rows], [head.text for head in heads[1:]], cells[1:])


@dataclass(frozen=True)
class Plan:
    """Plan in a table or a legend: its name, its colour and dashes [pt] in the figures, a sign after its name."""

    name: str
    colour: str
    mark: str = ""
    dashes: str = ""


@dataclass(frozen=True)
class MetricRow:
    """Row of a table of metrics: a cell a plan, and the difference of best and worst."""

    title: str
    unit: str
    cells: Sequence[Cell]
    difference: str = ""


@dataclass(frozen=True)
class MetricsTable:
    """Metrics by plan, sortable by column.

    Attributes
    ----------
    plans : sequence of Plan
        Columns.
    rows : sequence of MetricRow
        Rows.
    kind : str
        Class of the table in the page's style.
    """

    macro: ClassVar[str] = "metrics_table"
    plans: Sequence[Plan]
    rows: Sequence[MetricRow]
    kind: str = "metrics"

    @property
    def layout(self) -> str:
        """As of `Table`."""
        heads = ["unit", *(plan.name + plan.mark for plan in self.plans), "worst to best"]
        rows = [[row.unit, *(cell.marked for cell in row.cells), row.difference] for row in self.rows]
        cells = [[row[k] for row in rows] for k in range(len(heads))]
        return _layout(self.kind, [row.title for row in self.rows], heads, cells)


SHORT = 30
"""Letters of the name of a row of a table of key metrics up to which it is not broken into lines."""

_DENSE = frozenset({"grid", "baselines"})
"""Kinds of tables in small type."""

_BOLD = 1.12
"""Width of bold letters, relative to others."""

_STEP = 4
WIDTHS = range(48, 76, _STEP)
"""Widths of a page [rem] below which tables have their cells below each other."""

_PAIR, _MANY = 24, 8
"""Letters of a heading and its value up to which two stand side by side on a phone, and rows of a short table."""


def _layout(kind: str, names: Sequence[str], heads: Sequence[str], columns: Sequence[Sequence[str]]) -> str:
    """Classes of a table: its minimum width [rem] in a wide font, and whether its cells are long.

    Headings, and names of rows, break between words.
    """
    letter, padding = (0.53, 0.65) if kind in _DENSE else (0.56, 1.25)
    whole = [name for name in names if kind == "leading" and len(name) <= SHORT]
    letters = [max([14.0, *map(_letters, whole), *(_letters(word) for name in names for word in name.split())])]
    for head, cells in zip(heads, columns, strict=True):
        words = [_BOLD * _letters(word) for word in head.split()]
        letters.append(max([*words, *map(_letters, cells)], default=0.0))
    steps = math.ceil(sum(letter * count + padding for count in letters) / _STEP)
    width = "stacked" if steps > WIDTHS[-1] // _STEP else f"w{max(_STEP * steps, WIDTHS[0])}"
    pairs = [len(head) + max(map(len, cells), default=0) for head, cells in zip(heads, columns, strict=True)]
    return f"{width}{' listed' * (max(pairs, default=0) > _PAIR)}{' many' * (len(names) > _MANY)}"


def _letters(text: str) -> float:
    """Length of a text, in wide letters."""
    return len(text) - 0.5 * sum(letter in " .,:;'|()[]ijltfr·⁻⁰¹²³⁴⁵⁶⁷⁸⁹" for letter in text)


Block: TypeAlias = Picture | Svg | Text | Items | Pairs | Panels | Animation | Table | MetricsTable


@dataclass(frozen=True)
class Part:
    """Contents of a section on the page.

    Attributes
    ----------
    blocks : iterable of Picture, Svg, Text, Items, Pairs, Panels, Table, MetricsTable or Animation
        In order.
    heading : str
        Heading above them.
    below : bool
        Whether the part is below the metrics of the study instead of above.
    nominal : bool
        Whether the part shows quantiles over draws, for which the metrics of
        the study are the nominal values.
    """

    blocks: Iterable[Block]
    heading: str = ""
    below: bool = False
    nominal: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "blocks", tuple(self.blocks))
