"""Contents of a section on the page: figures, text and tables, in order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
        Id of the figure within its study; one that is there already gets a
        number.
    plot : control.ControlPlot
        As plotting functions return it.
    caption : str
        What is seen, in a sentence or two.
    """

    key: str
    plot: ControlPlot
    caption: str


@dataclass(frozen=True)
class Svg:
    """A figure that is an SVG element already, with its caption.

    Attributes
    ----------
    key : str
        As of `Picture`.
    svg : Markup
        The element, which is put into the page as it is.
    caption : str
        What is seen, in a sentence or two.
    """

    macro: ClassVar[str] = "picture"
    key: str
    svg: Markup
    caption: str


@dataclass(frozen=True)
class Text:
    """A paragraph.

    Attributes
    ----------
    words : str
        The text.
    hint : bool
        Whether it says how to read what follows: printed small, and not on
        paper.
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
class Animation:
    """Animation of a crane.

    Attributes
    ----------
    data : Markup
        As `ctrlplan.reports.crane_figures.animation_data` returns it.
    caption : str
        What is seen.
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
        Whether the column has sentences: aligned to the left, and broken.
    unit : bool
        Whether the column has units: aligned to the left, and grey.
    """

    text: str
    words: bool = False
    unit: bool = False


@dataclass(frozen=True)
class Cell:
    """Cell of a table.

    Attributes
    ----------
    text : str
        What stands in it.
    mark : {"", "better", "worse", "reference"}
        Whether it is better or worse than the others, or the one that the
        others are compared with.
    meaning : str
        What the mark means, for readers who do not see it.
    order : str or None
        Number by which a column that can be sorted is sorted: empty for none,
        "1e999" for infinite.
    """

    text: str
    mark: str = ""
    meaning: str = ""
    order: str | None = None


@dataclass(frozen=True)
class Table:
    """A table: a heading a column, the first of which names the rows.

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
                raise ValueError(f"rows[{place}] must have {len(self.heads)} cells, one a heading, got {len(row)}")

    @property
    def columns(self) -> list[Head]:
        """Headings, all as such."""
        return [head if isinstance(head, Head) else Head(head) for head in self.heads]

    @property
    def lines(self) -> list[list[Cell]]:
        """Cells, all as such."""
        return [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in self.rows]


@dataclass(frozen=True)
class Plan:
    """Column of a table of metrics: the plan, its colour in the figures, and a sign beside its name."""

    name: str
    colour: str
    mark: str = ""


@dataclass(frozen=True)
class MetricRow:
    """Row of a table of metrics: a cell a plan."""

    title: str
    unit: str
    cells: Sequence[Cell]


@dataclass(frozen=True)
class MetricsTable:
    """Metrics by plan, sorted by a column where its heading is clicked.

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


Block: TypeAlias = Picture | Svg | Text | Items | Animation | Table | MetricsTable


@dataclass(frozen=True)
class Part:
    """What a section becomes on a page.

    Attributes
    ----------
    blocks : iterable of Picture, Svg, Text, Items, Table, MetricsTable or Animation
        In order.
    heading : str
        Heading above them.
    below : bool
        Whether it stands below the metrics of the study, not above them.
    nominal : bool
        Whether it shows the spread of what the metrics of the study are the
        nominal values of.
    """

    blocks: Iterable[Block]
    heading: str = ""
    below: bool = False
    nominal: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "blocks", tuple(self.blocks))
