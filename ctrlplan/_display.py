"""Descriptions of objects, rendered as text for print and as HTML for Jupyter."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import TypeAlias

WIDTH = 99
"""Maximum width of a text in columns."""

ROWS = 8
"""Maximum number of rows of a long table."""

MISSING = "n/a"
"""Text of nan."""

_INFINITE = {"s": "never"}
"""Text of infinity by unit, where it is not inf."""

_LONGEST = 46
"""Maximum width of a cell in columns."""


@dataclass(frozen=True)
class Facts:
    """Names with their values, units included.

    Attributes
    ----------
    rows : sequence of (str, str)
        Name and value; a row without a value is omitted.
    """

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Table:
    """A table whose first column names the rows.

    Attributes
    ----------
    caption : str
        Caption of the table.
    heads : sequence of str
        Headings of the columns.
    rows : sequence of sequence of str
        Cells, one for each heading.
    best : collection of (int, int)
        Row and column of the cells that are marked as the best of their rows.
    """

    caption: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    best: Collection[tuple[int, int]] = ()


@dataclass(frozen=True)
class Figure:
    """A small figure, shown in HTML only.

    Attributes
    ----------
    caption : str
        Caption of the figure.
    nrows : int
        Number of axes, one above the other.
    draw : callable
        Function that draws in an array of axes (nrows,).
    """

    caption: str
    nrows: int
    draw: Callable[..., object]


Part: TypeAlias = str | Facts | Table | Figure
"""A string is a paragraph."""


class Displayed:
    """Base class of objects with a description.

    A class must define `_describe`, which yields a title in one line and then the
    parts of the description. ``repr`` is the title with the name of the class,
    ``print`` shows all parts, Jupyter the same as HTML.
    """

    __slots__ = ()

    def _describe(self) -> Iterator[Part]:
        raise NotImplementedError(f"{type(self).__name__} must define _describe")

    def __repr__(self) -> str:
        kind, title = type(self).__name__, title_of(self)
        return f"<{title}>" if title.startswith(kind) else f"<{kind}: {title}>"

    def __str__(self) -> str:
        return to_text(self._describe())

    def _repr_html_(self) -> str:
        from ctrlplan.reports.inline import to_inline_svg

        return to_html(self._describe(), to_inline_svg)


def title_of(shown: Displayed) -> str:
    """Title of an object, in one line."""
    return _line(str(next(shown._describe())))


def in_line(value: object) -> str:
    """Value of any type as text, without tables."""
    return repr(value) if isinstance(value, Displayed) else str(value)


def number(value: float, unit: str = "") -> str:
    """Four significant digits in ASCII, without the unit.

    Parameters
    ----------
    value : float
        nan is "n/a", infinity "inf", or "never" for times.
    unit : str, optional
        Unit of the value.
    """
    if math.isnan(value):
        return MISSING
    if math.isinf(value):
        return _INFINITE.get(unit, "inf") if value > 0.0 else "-inf"
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e6 else f"{value + 0.0:.4g}"


def time_text(time: float) -> str:
    """A time [s] without its unit: six significant digits, and from 1e4 s on microseconds."""
    return f"{time:.6f}".rstrip("0").rstrip(".") if 1e4 <= abs(time) < 1e12 else f"{time:.6g}"


def counted(count: int, word: str) -> str:
    """A number with its noun in the singular or plural."""
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


def shortened(rows: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Rows of a table, with dots instead of middle ones if there are many."""
    if len(rows) <= ROWS:
        return list(rows)
    return [*rows[: ROWS - 2], ["..."] * len(rows[0]), rows[-1]]


# Control characters, direction overrides, lone surrogates (of file names), noncharacters.
_UNREADABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


def readable(text: str) -> str:
    """Text with unprintable characters replaced."""
    return _UNREADABLE.sub("\N{REPLACEMENT CHARACTER}", text)


# As text


def to_text(parts: Iterable[Part]) -> str:
    """Description as text of at most 99 columns."""
    lines: list[str] = []
    for part in parts:
        if isinstance(part, str):
            lines += [*([""] if lines else []), *_wrapped(_line(part).split(" "), WIDTH)]
        elif isinstance(part, Facts):
            lines += _facts_lines(part)
        elif isinstance(part, Table):
            lines += ["", *_table_lines(part)]
    return "\n".join(lines)


def _facts_lines(facts: Facts) -> list[str]:
    rows = [(_cell(name), _line(value)) for name, value in facts.rows if value]
    wide = max((_width(name) for name, _ in rows), default=0)
    lines = []
    for name, value in rows:
        first, *more = _wrapped(value.split(" "), WIDTH - wide - 4)
        lines += [f"  {_padded(name, wide)}  {first}", *(f"{'':{wide + 4}}{line}" for line in more)]
    return lines


def _table_lines(table: Table) -> list[str]:
    """Lines of a table; columns that do not fit follow below with the same first column."""
    marked = {j for _, j in table.best}
    grid = [[_cell(head) for head in table.heads]]
    for i, row in enumerate(table.rows):
        grid.append(
            [_cell(cell) + ("*" if (i, j) in table.best else " ") * (j in marked) for j, cell in enumerate(row)]
        )
    widths = [max(map(_width, column)) for column in zip(*grid, strict=True)]
    starts, used = [1], widths[0]
    for j, wide in enumerate(widths[1:], 1):
        used += wide + 2
        if used + 2 > WIDTH and j > starts[-1]:
            starts.append(j)
            used = widths[0] + wide + 2
    lines = [*_wrapped(_line(table.caption).split(" "), WIDTH - 2)]
    for first, last in pairwise([*starts, len(widths)]):
        for row in grid:
            cells = [_padded(row[0], widths[0]), *(_padded(row[j], widths[j], right=True) for j in range(first, last))]
            lines.append("  ".join(cells).rstrip())
    return [f"  {line}" for line in lines]


def _wrapped(words: Sequence[str], width: int) -> list[str]:
    """Lines of words; words that are too long are broken."""
    lines = [""]
    for word in words:
        joined = f"{lines[-1]} {word}" if lines[-1] else word
        if _width(joined) <= width:
            lines[-1] = joined
            continue
        for letter in f"\n{word}" if lines[-1] else word:
            if letter == "\n" or _width(lines[-1] + letter) > width:
                lines.append("")
            lines[-1] += letter.strip("\n")
    return lines


def _line(text: str) -> str:
    """Printable text in one line."""
    return " ".join(readable(text).split())


def _cell(text: str) -> str:
    """Text of a cell, without the middle of a very long one."""
    line = _line(text)
    if _width(line) <= _LONGEST:
        return line
    last = _wrapped([line[::-1]], 9)[0][::-1].lstrip()
    return f"{_wrapped([line], _LONGEST - 14)[0].rstrip()} ... {last}"


def _width(text: str) -> int:
    """Width of a text in columns: two for a wide letter, none for an accent."""
    if text.isascii():
        return len(text)
    return sum(
        0 if unicodedata.combining(letter) else 1 + (unicodedata.east_asian_width(letter) in "WF") for letter in text
    )


def _padded(text: str, width: int, *, right: bool = False) -> str:
    blank = " " * (width - _width(text))
    return blank + text if right else text + blank


# As HTML

# No colours: those of the page around it are inherited, light or dark.
_STYLE = (
    ".ctrlplan-shown p{margin:.3em 0;max-width:60em;overflow-wrap:anywhere}"
    ".ctrlplan-shown dl{display:grid;grid-template-columns:fit-content(45%) 1fr;gap:.1em 1em;margin:.3em 0}"
    ".ctrlplan-shown dt{font-weight:normal;opacity:.8}.ctrlplan-shown dd{margin:0;overflow-wrap:anywhere}"
    ".ctrlplan-shown div{overflow-x:auto}"
    ".ctrlplan-shown table{border-collapse:collapse;margin:.5em 0}"
    ".ctrlplan-shown caption{caption-side:top;text-align:left;padding:.2em 0;color:inherit;white-space:nowrap}"
    ".ctrlplan-shown td,.ctrlplan-shown th{text-align:right;padding:.15em .6em;color:inherit;background:none}"
    ".ctrlplan-shown td,.ctrlplan-shown th{white-space:nowrap}.ctrlplan-shown tbody th{font-weight:normal}"
    ".ctrlplan-shown th:first-child{text-align:left;padding-left:0;white-space:normal;min-width:6em}"
    ".ctrlplan-shown thead th{border-bottom:1px solid currentColor}"
    ".ctrlplan-shown figure{margin:.5em 0}.ctrlplan-shown svg{max-width:100%;height:auto}"
)


def to_html(parts: Iterable[Part], svg_of: Callable[[Figure], str]) -> str:
    """Description as HTML.

    Parameters
    ----------
    parts : iterable of Part
        The description, its title first.
    svg_of : callable
        Draws a figure as an SVG element.
    """
    title, *rest = parts
    blocks = [f"<style>{_STYLE}</style>", f"<p><strong>{_escaped(str(title))}</strong></p>"]
    for part in rest:
        if isinstance(part, str):
            blocks.append(f"<p>{_escaped(part)}</p>")
        elif isinstance(part, Facts):
            rows = [f"<dt>{_text(name)}</dt><dd>{_escaped(value)}</dd>" for name, value in part.rows if value]
            blocks.append(f"<dl>{''.join(rows)}</dl>" if rows else "")
        elif isinstance(part, Table):
            blocks.append(_table_html(part))
        else:
            caption = _escaped(part.caption)
            drawing = f'<div role="img" aria-label="{caption}">{svg_of(part)}</div>'
            blocks.append(f"<figure>{drawing}<figcaption>{caption}</figcaption></figure>")
    return f'<div class="ctrlplan-shown">{"".join(blocks)}</div>'


def _table_html(table: Table) -> str:
    caption = _escaped(table.caption)
    heads = "".join(f'<th scope="col">{_text(head)}</th>' for head in table.heads)
    rows = []
    for i, (name, *cells) in enumerate(table.rows):
        found = [
            f"<td><strong>{_text(cell)}</strong>*</td>" if (i, j) in table.best else f"<td>{_text(cell)}</td>"
            for j, cell in enumerate(cells, 1)
        ]
        rows.append(f'<tr><th scope="row">{_text(name)}</th>{"".join(found)}</tr>')
    inner = f"<caption>{caption}</caption><thead><tr>{heads}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div tabindex="0" role="region" aria-label="{caption}"><table>{inner}</table></div>'


def _escaped(text: str) -> str:
    return escape(_line(text))


def _text(text: str) -> str:
    return escape(_cell(text))
