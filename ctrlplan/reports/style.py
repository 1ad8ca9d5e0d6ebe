"""Style of figures: colours for colour-blind readers, and line styles in addition.

Figures use the rcParams of the user and are registered with pyplot, like those
of python-control. Figures of a page are drawn inside `page_style`: with fixed
settings, so that equal results give equal pages, and not registered with
pyplot.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from itertools import cycle, islice
from typing import Any, TypeAlias

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from control import ControlPlot
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure, SubFigure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.roles import Role, role_of
from ctrlplan.studies.sweep import Sweep

AxesLike: TypeAlias = Axes | Sequence[Axes] | NDArray[np.object_]
"""One axes, or several in a sequence or an array."""

Style: TypeAlias = dict[str, Any]
"""Keywords of ``Axes.plot`` for one curve: colour, line style, label and zorder."""

Dashes: TypeAlias = str | tuple[int, tuple[float, ...]]

# Okabe and Ito's colours.
_STEP: tuple[str, Dashes] = ("#000000", (0, (1, 1)))
_PLANS: tuple[tuple[str, Dashes], ...] = (
    ("#0072B2", (0, (5, 1.5))),
    ("#D55E00", "-"),
    ("#009E73", (0, (5, 1.5, 1, 1.5))),
)
_OTHERS = ("#CC79A7", "#E69F00", "#56B4E9")
_PALETTE = (*(colour for colour, _ in _PLANS), *_OTHERS, _STEP[0])
_OTHER_DASHES: tuple[Dashes, ...] = ((0, (3, 1, 1, 1)), (0, (7, 2)), (0, (2, 2)), (0, (9, 1.5, 1, 1.5, 1, 1.5)))

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

_FOR_PAGE: ContextVar[bool] = ContextVar("for_page", default=False)


@contextmanager
def page_style() -> Iterator[None]:
    """Context for figures of a page: fixed settings, not registered with pyplot."""
    token = _FOR_PAGE.set(True)
    try:
        with _house_settings():
            yield
    finally:
        _FOR_PAGE.reset(token)


@contextmanager
def _house_settings(**more: object) -> Iterator[None]:
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_RC | more)
        yield


class Drawing:
    """Axes of a plotting function: new ones, or those of the user.

    Parameters
    ----------
    ax : Axes, sequence or array of Axes, or None
        Axes of the user; None for new ones, in the current figure where that is
        empty, else in a new figure.
    shape : (int, int)
        Rows and columns. Where one of them is 1, axes of the user may be
        arranged in any way; a grid must have this shape.
    size : (float, float)
        Width and height of a new figure [in], unless the user has set the
        rcParam ``figure.figsize``.
    rows : iterable of str
        What each axes of one row or column, or each row of a grid, shows, for
        the message of an error.
    wrap : int, optional
        Columns in which new axes of a shape (n, 1) are laid out.
    sharex : bool, optional
        Whether new axes share the x axis down the columns.

    Attributes
    ----------
    axes : ndarray of Axes, shape (rows, columns)
        Where to draw.

    Raises
    ------
    TypeError
        If `ax` is neither axes nor several of them.
    ValueError
        If there are too many or too few, or a grid has another shape.
    """

    def __init__(
        self,
        ax: AxesLike | None,
        shape: tuple[int, int],
        size: tuple[float, float],
        *,
        rows: Iterable[str] = (),
        wrap: int = 1,
        sharex: bool = True,
    ) -> None:
        self._wrap, self._own = wrap, ax is None
        if ax is None:
            figure = _empty_figure(*size)
            lines = -(-shape[0] // wrap)
            grid = figure.subplots(lines, max(shape[1], wrap), sharex="col" if sharex else False, squeeze=False)
            for spare in grid.flat[shape[0] * shape[1] :]:
                spare.remove()
            self.axes = grid.flatten()[: shape[0] * shape[1]].reshape(shape)
        else:
            self.axes = _reshaped(given_axes(ax), shape, list(rows))
        self.figure: Figure | SubFigure = self.axes[0, 0].figure
        self._before = [len(axes.lines) for axes in self.axes.flat]

    @property
    def column(self) -> list[Axes]:
        """All axes, row by row."""
        return list(self.axes.flat)

    def label_x(self, text: str) -> None:
        """Label the x axis of the lowest axes of each column that have no label yet."""
        lowest = set(self.column[-self._wrap :]) | set(self.axes[-1])
        for axes in self.column:
            spec = axes.get_subplotspec()
            if axes in lowest or spec is None or spec.is_last_row():
                if self._own:
                    axes.xaxis.set_tick_params(labelbottom=True)  # also above an empty place
                # Tick labels turned off by the user are below other axes, and so is the label.
                if not axes.get_xlabel() and axes.xaxis.get_tick_params().get("labelbottom", True):
                    axes.set_xlabel(text)

    def finish(self, legend: bool = True) -> Plot:
        """Return value of a plotting function, with one legend for all axes, from the labels of the first."""
        made = self._legend() if legend else None
        lines = np.empty(self.axes.shape, dtype=object)
        for index, axes, before in zip(np.ndindex(lines.shape), self.axes.flat, self._before, strict=True):
            lines[index] = list(axes.lines[before:])
        return Plot(lines, self.axes, self.figure, made)

    def _legend(self) -> Legend | None:
        """Legend above all axes; inside the first axes if the figure has other axes as well."""
        axes = self.axes[0, 0]
        handles, labels = axes.get_legend_handles_labels()
        if not handles:
            return None
        names = [letters(label.removeprefix(_HIDDEN)) for label in labels]
        outside = isinstance(self.figure.get_layout_engine(), ConstrainedLayoutEngine)
        if outside and set(self.figure.axes) == set(self.axes.flat):
            for old in [legend for legend in self.figure.legends if legend.get_label() == _LEGEND]:
                old.remove()
            size = FontProperties(size=mpl.rcParams["legend.fontsize"]).get_size_in_points()
            # At 9 points there are about eleven letters an inch.
            fit = int(99.0 / size * self.figure.bbox.width / self.figure.get_dpi() / (max(map(len, names)) + 6))
            legend = self.figure.legend(
                handles, labels, loc="outside upper center", ncols=max(1, min(len(names), 5, fit))
            )
            legend.set_label(_LEGEND)
            _set_below_title(self.figure, legend)
        else:
            legend = axes.legend(handles, labels)
        for text, name in zip(legend.get_texts(), names, strict=True):
            text.set_parse_math(False)
            text.set_text(as_text(name) if mpl.rcParams["text.usetex"] else name)
        return legend


class Plot(ControlPlot):  # type: ignore[misc]
    """`control.ControlPlot` whose title does not change the layout of its figure.

    Attributes
    ----------
    figure : matplotlib.figure.Figure
    axes : ndarray of matplotlib.axes.Axes, shape (rows, columns)
    lines : ndarray of list of matplotlib.lines.Line2D, shape (rows, columns)
        Lines that were added to each axes.
    legend : matplotlib.legend.Legend or None
    """

    def set_plot_title(self, title: str, frame: str = "axes") -> None:
        """Set the title above all axes.

        Parameters
        ----------
        title : str
            Title, a user's text.
        frame : {"axes", "figure"}, optional
            Centred on the axes, or on the figure; always the latter where the
            figure has a constrained layout.
        """
        # python-control would apply a tight layout to the current figure instead of this one.
        constrained = isinstance(self.figure.get_layout_engine(), ConstrainedLayoutEngine)
        super().set_plot_title(title, frame="figure" if constrained else frame)
        for legend in self.figure.legends:
            if legend.get_label() == _LEGEND:
                _set_below_title(self.figure, legend)


def _set_below_title(figure: Figure | SubFigure, legend: Legend) -> None:
    """Move a legend outside the axes, and the axes, below the title of the figure."""
    words = figure.get_suptitle()
    title = next((text for text in figure.texts if words and text.get_text() == words), None)
    engine = figure.get_layout_engine() if isinstance(figure, Figure) else None  # a subfigure has none
    if title is not None and isinstance(engine, ConstrainedLayoutEngine):
        below = 1.0 - title.get_window_extent().height / figure.bbox.height
        legend.set_bbox_to_anchor((0.0, 0.0, 1.0, below - 0.005), transform=figure.transSubfigure)
        engine.set(rect=(0.0, 0.0, 1.0, below - 0.025))


def given_axes(ax: AxesLike) -> NDArray[np.object_]:
    """Axes of a user as an array of at least one dimension.

    Raises
    ------
    TypeError
        If there is anything else.
    """
    several = isinstance(ax, Sequence | np.ndarray | np.flatiter) and not isinstance(ax, str)
    array = np.empty(1, dtype=object)
    if several:
        array = np.array(ax, dtype=object)
    else:
        array[0] = ax
    for one in array.flat:
        if not isinstance(one, Axes):
            hint = "; give its .axes" if isinstance(one, Figure | ControlPlot) else ""
            raise TypeError(f"ax must be matplotlib axes or an array of them, got {type(one).__name__}{hint}")
    return array


def _reshaped(array: NDArray[np.object_], shape: tuple[int, int], rows: Sequence[str]) -> NDArray[np.object_]:
    if 1 in shape:
        if array.size == max(shape):
            return array.reshape(shape)
        wanted = "one axes" if shape == (1, 1) else f"axes of shape ({max(shape)},)"
    else:
        if array.shape == shape:
            return array
        wanted = f"axes of shape {shape}"
    shown = f"; from the top they show {', '.join(rows)}" if rows and shape != (1, 1) else ""
    raise ValueError(f"ax must be {wanted}, got shape {array.shape}{shown}")


def _empty_figure(width: float, height: float) -> Figure:
    """Figure to draw in: the current one if it is empty, otherwise a new one."""
    if _FOR_PAGE.get():
        return Figure(figsize=(width, height), layout="constrained")
    tight = mpl.rcParams["figure.autolayout"]
    if plt.get_fignums() and plt.gcf().get_children() == [plt.gcf().patch]:
        figure = plt.gcf()
        if figure.get_layout_engine() is None and not tight:
            figure.set_layout_engine("constrained")
        return figure
    sized = not _as_by_default("figure.figsize")
    return plt.figure(figsize=None if sized else (width, height), layout=None if tight else "constrained")


def _as_by_default(name: str) -> bool:
    """Whether an rcParam has the default value of matplotlib."""
    given, default = mpl.rcParams[name], mpl.rcParamsDefault[name]  # type: ignore[index]
    return list(given) == list(default)


# Colours and dashes


def line_styles(roles: Mapping[str, Role], known: Mapping[str, Style] | None = None) -> dict[str, Style]:
    """Default colour and dashes of each plan.

    The first step is black and dotted, and the first planned references have
    the main colours in order; baselines and all others have the other colours.

    Parameters
    ----------
    roles : mapping of str to Role
        What each plan is.
    known : mapping of str to dict, optional
        Styles of plans that are drawn elsewhere on the page, which they keep.
    """
    main = {name: (style["color"], style["linestyle"]) for name, style in (known or {}).items() if name in roles}
    used = {colour for colour, _ in main.values()}
    free = {Role.STEP: [_STEP], Role.PLANNED: [*_PLANS], Role.BASELINE: []}
    free = {role: [look for look in looks if look[0] not in used] for role, looks in free.items()}
    for name, role in roles.items():
        if name not in main and free[role]:
            main[name] = free[role].pop(0)
    spare, dashed = cycle([*_OTHERS, *(colour for looks in free.values() for colour, _ in looks)]), cycle(_OTHER_DASHES)
    styles: dict[str, Style] = {}
    for name in roles:
        colour, dashes = main[name] if name in main else (next(spare), next(dashed))
        # Dashes over solid lines, so that coinciding curves are both visible.
        zorder = 2.0 if dashes == "-" else 2.5
        styles[name] = {"color": colour, "linestyle": dashes, "label": legend_label(name), "zorder": zorder}
    return styles


def roles_of(shown: Comparison | Sweep) -> dict[str, Role]:
    """Role of each plan; if it is unknown, a step for a plan that jumps, otherwise planned."""
    if isinstance(shown, Sweep):
        return {name: shown.roles.get(name, Role.PLANNED) for name in shown.metrics}
    return {name: shown.roles.get(name) or role_of(plan) for name, plan in shown.plans.items()}


def plan_styles(shown: Comparison | Sweep, axes: Axes, known: Mapping[str, Style] | None = None) -> dict[str, Style]:
    """Colour, dashes and label of each plan to be drawn in an axes.

    Those of `line_styles`; in the colours of the user's cycle where one is set,
    and unlike the curves that the axes have already.
    """
    return _told_apart(line_styles(roles_of(shown), known), axes)


def axis_styles(labels: Iterable[str], axes: Axes) -> dict[str, Style]:
    """Colour, dashes and label of each axis of one plan to be drawn in an axes."""
    pairs = zip(labels, cycle(_PALETTE))
    return _told_apart(
        {name: {"color": c, "linestyle": "-", "label": legend_label(name), "zorder": 2.0} for name, c in pairs}, axes
    )


def _told_apart(styles: dict[str, Style], axes: Axes) -> dict[str, Style]:
    """Styles with colours and dashes of the user that the curves of the axes do not have."""
    drawn = [line for line in axes.lines if line.get_linestyle() != "None"]
    chosen = _users_cycle()
    used = [to_hex(line.get_color()) for line in drawn]
    colours = [props["color"] for props in chosen if "color" in props] or [*_PALETTE]
    own = not any("color" in props for props in chosen)
    # Different dashes from the second plot on.
    dashes = islice(cycle(_OTHER_DASHES), max(len(drawn) - 1, 0), None)
    for i, style in enumerate(styles.values()):
        if own and style["color"] == "#000000":
            style["color"] = shade(1.0)
        if not own or (drawn and _is_like(style["color"], used)):
            distance = _ALIKE if own else 0.02
            style["color"] = next((c for c in colours if not _is_like(c, used, distance)), colours[i % len(colours)])
        if chosen and "linestyle" in chosen[0]:
            style["linestyle"] = chosen[(len(drawn) + i) % len(chosen)]["linestyle"]
        elif drawn:
            style["linestyle"] = next(dashes)
            style["zorder"] = 2.5
        elif mpl.rcParams["lines.linestyle"] != "-":
            style["linestyle"] = mpl.rcParams["lines.linestyle"]
        used.append(to_hex(style["color"]))
        style["label"] = _another(style["label"], drawn)
    return styles


_ALIKE = 0.25
"""Distance of colours in the unit cube of RGB below which they are hard to distinguish: Okabe and Ito's are 0.26
apart, and matplotlib's own blue and orange within 0.22 of theirs."""


def _is_like(colour: str, others: Iterable[str], distance: float = _ALIKE) -> bool:
    return any(np.linalg.norm(np.subtract(to_rgb(colour), to_rgb(other))) < distance for other in others)


def _another(label: str, drawn: Sequence[Line2D]) -> str:
    """Label, with a number if a curve has the same one."""
    known = {line.get_label() for line in drawn}
    number = 1
    numbered = label
    while numbered in known:
        number += 1
        numbered = f"{label} ({number})"
    return numbered


def _users_cycle() -> list[Style]:
    """Property cycle of the user; empty if it is the default of matplotlib."""
    chosen = mpl.rcParams["axes.prop_cycle"]
    return [] if chosen == mpl.rcParamsDefault["axes.prop_cycle"] else list(chosen)


def shade(weight: float) -> str:
    """Grey between the background (0) and the text (1) of the user's settings."""
    text, ground = (np.array(to_rgb(mpl.rcParams[name])) for name in ("text.color", "axes.facecolor"))
    return to_hex(ground + weight * (text - ground))


def line_width(factor: float) -> float:
    """Fraction of the line width of curves [pt]."""
    return float(factor * mpl.rcParams["lines.linewidth"])


def marker_size(points: float) -> float:
    """Size of a marker [pt], relative to the default of 6 points."""
    return float(points / 6.0 * mpl.rcParams["lines.markersize"])


def font_size(points: float) -> float:
    """Size of a text [pt], relative to the 9 points of a page."""
    return float(points / 9.0 * mpl.rcParams["font.size"])


# Texts

_HIDDEN = "\N{WORD JOINER}"
_LEGEND = "one legend for all axes"
_LONGEST = 60


def legend_label(name: str) -> str:
    """Label of a curve for the legend: matplotlib omits empty labels and those with a leading underscore."""
    return _HIDDEN + name if not name or name.startswith("_") else name


def label_y(axes: Axes, text: str) -> None:
    """Label the y axis, unless it is labelled."""
    if not axes.get_ylabel():
        axes.set_ylabel(text)


def add_title(axes: Axes, text: str) -> None:
    """Small title on the left, below an existing one with another text."""
    old = axes.get_title(loc="left")
    if text not in old.split("\n"):
        axes.set_title(f"{old}\n{text}" if old else text, loc="left", fontsize=font_size(8))


def letters(text: str) -> str:
    """Text of a user with characters that the font of the figures has.

    Line breaks become blanks; control characters, and letters that the font
    lacks, become their code points; the middle of a very long text is left out.
    """
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} … {text[-_LONGEST // 3 :]}"
    known = [_glyphs(font) for font in _fonts()]
    return "".join(
        c if any(ord(c) in font for font in known) else " " if c.isspace() else f"<U+{ord(c):04X}>" for c in text
    )


def as_text(text: str) -> str:
    """Text of a user for a label or a title, escaped for matplotlib and TeX."""
    if mpl.rcParams["text.usetex"]:
        return "".join(_TEX.get(c, c) for c in letters(text))
    return letters(text).replace("$", r"\$")


_TEX = {c: f"\\{c}" for c in "{}$&#%_"} | {"\\": r"\textbackslash{}", "^": r"\^{}", "~": r"\~{}"}


def _fonts() -> list[str]:
    """Files of the fonts in which matplotlib searches a character, in order."""
    found: list[str] = []
    for family in FontProperties().get_family():
        with suppress(ValueError):
            found.append(findfont(FontProperties(family=[family]), fallback_to_default=False))
    return found or [findfont(FontProperties())]


@cache
def _glyphs(font: str) -> frozenset[int]:
    """Code points that a font has."""
    return frozenset(get_font(font).get_charmap())


def with_unit(name: str, unit: str | None, power: str = "") -> str:
    """Label of an axis: name [unit], both texts of the user; `power` may be a formula."""
    return f"{as_text(name)} [{as_text(unit or '')}{power}]" if unit or power else as_text(name)


def to_svg(figure: Figure, key: str) -> str:
    """Figure as an SVG element for a page; `key` makes its ids unique."""
    salt = re.sub(r"[^\w.-]+", "-", key)
    buffer = io.StringIO()
    with _house_settings(**{"svg.hashsalt": salt}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    # Ids must be unique on a page with several drawings.
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{salt}-", text[text.index("<svg") :])


def slug(name: str) -> str:
    """Name as part of an id: only letters, digits, hyphens and underscores."""
    return re.sub(r"[^\w-]+", "-", name) or "study"
