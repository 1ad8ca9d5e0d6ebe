"""How figures look: colours that a colour-blind reader tells apart, and line styles besides."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from itertools import cycle
from typing import Any, ParamSpec

import matplotlib as mpl
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

P = ParamSpec("P")

# Okabe and Ito's colours; a plan keeps its own in every figure.
COLOURS = {"step": "#000000", "polynomial": "#0072B2", "trigonometric": "#D55E00", "piecewise": "#009E73"}
_OTHERS = ("#CC79A7", "#E69F00", "#56B4E9")
DASHES = {"step": (0, (1, 1)), "polynomial": (0, (5, 1.5)), "trigonometric": "-", "piecewise": (0, (5, 1.5, 1, 1.5))}

_OTHER_DASHES = ((0, (3, 1, 1, 1)), (0, (7, 2)), (0, (2, 2)), (0, (9, 1.5, 1, 1.5, 1, 1.5)))

_WITHOUT_WINDOW = ("agg", "backend_inline", "cairo", "inline", "pdf", "pgf", "ps", "svg", "template")

_RC: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "svg.fonttype": "path",
}


class ShownFigure(Figure):
    """Figure that a notebook shows where it stands last in a cell, whatever its backend."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with _house_settings():
            self.savefig(buffer, format="png", dpi=110)
        return buffer.getvalue()


def line_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Colour and dashes of each plan."""
    names = list(names)
    spare = cycle([*_OTHERS, *(colour for name, colour in COLOURS.items() if name not in names)])
    dashed = cycle(_OTHER_DASHES)
    styles: dict[str, dict[str, Any]] = {}
    for name in names:
        dashes = DASHES.get(name) or next(dashed)
        # Dashes over solid lines: where curves coincide both are seen.
        styles[name] = {
            "color": COLOURS.get(name) or next(spare),
            "linestyle": dashes,
            "label": legend_label(name),
            "zorder": 2.0 if dashes == "-" else 2.5,
        }
    return styles


def house_style(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Let a function draw with the settings of the house, whatever the user's are."""

    @wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _house_settings():
            return draw(*args, **kwargs)

    return styled


@contextmanager
def _house_settings(**more: object) -> Iterator[None]:
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_RC | more)
        yield


def new_figure(width: float, height: float) -> Figure:
    """Figure that a notebook shows once and a script with a window shows by ``plt.show()``."""
    if mpl.get_backend().lower().rpartition(".")[2] in _WITHOUT_WINDOW:
        return ShownFigure(figsize=(width, height), layout="constrained")
    return plt.figure(figsize=(width, height), layout="constrained")


def stacked_axes(figure: Figure, rows: int, columns: int = 1, sharex: bool = True) -> list[list[Axes]]:
    """Grid of axes, time shared down the columns."""
    grid = figure.subplots(rows, columns, sharex="col" if sharex else False, squeeze=False)
    return [list(row) for row in grid]


def legend_above(figure: Figure, axes: Axes) -> None:
    """One legend above all axes, where it hides no curve; labels are those of `legend_label`."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        names = [letters(label.removeprefix(_HIDDEN)) for label in labels]
        fit = int(11 * figure.get_figwidth() / (max(map(len, names)) + 6))  # of about eleven letters an inch
        legend = figure.legend(
            handles, labels, loc="outside upper center", ncols=max(1, min(len(names), 5, fit)), frameon=False
        )
        for text, name in zip(legend.get_texts(), names, strict=True):
            text.set_parse_math(False)
            text.set_text(name)


_HIDDEN = "\N{WORD JOINER}"


def legend_label(name: str) -> str:
    """Label of a curve for the legend: matplotlib leaves out empty ones, and those that begin with an underscore."""
    return _HIDDEN + name if not name or name.startswith("_") else name


_LONGEST = 60


def letters(text: str) -> str:
    """Text of a user as the font of the figures can write it.

    Line breaks become blanks; control characters, and letters that the font
    lacks, become their code points; the middle of a very long text is left out.
    """
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} … {text[-_LONGEST // 3 :]}"
    return "".join(c if ord(c) in _glyphs() else " " if c.isspace() else f"<U+{ord(c):04X}>" for c in text)


def as_text(text: str) -> str:
    """Text of a user for a label or a title, in which matplotlib finds no formula."""
    return letters(text).replace("$", r"\$")


@cache
def _glyphs() -> frozenset[int]:
    """Code points that the font of the figures has."""
    with _house_settings():
        return frozenset(get_font(findfont(FontProperties())).get_charmap())


def with_unit(name: str, unit: str | None, power: str = "") -> str:
    """Label of an axis: name [unit], both a user's text; `power` is ours and may be a formula."""
    return f"{as_text(name)} [{as_text(unit or '')}{power}]" if unit or power else as_text(name)


def to_svg(figure: Figure, key: str) -> str:
    """Figure as an SVG element to stand in a page; `key` keeps its ids apart from others'."""
    salt = re.sub(r"[^\w.-]+", "-", key)
    buffer = io.StringIO()
    with _house_settings(**{"svg.hashsalt": salt}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = buffer.getvalue()
    # Several drawings stand in one page: what they define must be their own.
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{salt}-", text[text.index("<svg") :])


def slug(name: str) -> str:
    """Name as a part of an id: letters, digits, hyphens and underscores alone."""
    return re.sub(r"[^\w-]+", "-", name) or "study"
