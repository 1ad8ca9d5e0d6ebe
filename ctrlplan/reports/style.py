"""Style of figures: colours for colour-blind readers, and line styles in addition.

Figures use the rcParams of the user and are registered with pyplot, like those
of python-control. Figures of a page are drawn inside `page_style`: with fixed
settings, so that equal results give equal pages, and not registered with
pyplot.
"""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from itertools import cycle, islice
from textwrap import wrap
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
from matplotlib.transforms import Transform
from numpy.typing import NDArray

from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.roles import Role, role_of
from ctrlplan.studies.sweep import Sweep
from ctrlplan.studies.units import scientific, superscript

AxesLike: TypeAlias = Axes | Sequence[Axes] | NDArray[np.object_]
"""One axes, or several in a sequence or an array."""

Style: TypeAlias = dict[str, Any]
"""Keywords of ``Axes.plot`` for one curve: colour, line style, label and zorder."""

Dashes: TypeAlias = str | tuple[int, tuple[float, ...]]

# Okabe and Ito's colours.
_BLACK = "#000000"
_STEP: tuple[str, Dashes] = (_BLACK, (0, (1, 1)))
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
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],
    "path.simplify_threshold": 0.25,
    "svg.fonttype": "none",
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
        """What a plotting function returns, with one legend for all axes, of the labels of the first.

        On a page, plans whose curves coincide in all axes become one curve.
        """
        if legend and self._own and _FOR_PAGE.get():
            merge_coincident(self.column)
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


_APART = 2e-3
"""Distance of two curves, relative to the height of their axes, up to which they are one on a screen."""


def merge_coincident(axes: Sequence[Axes]) -> dict[str, list[str]]:
    """Draw plans whose curves coincide in all axes as one curve with all their names.

    Parameters
    ----------
    axes : sequence of Axes
        Whose curves with equal labels belong together.

    Returns
    -------
    dict of str to list of str
        Labels of the plans that a curve stands for, by the label of the one
        that stays.
    """
    rows = [{str(line.get_label()): line for line in one.lines if line.get_linestyle() != "None"} for one in axes]
    rows = [{label: line for label, line in row.items() if not label.startswith("_")} for row in rows]
    scales = [one.yaxis.get_transform() for one in axes]
    heights = [float(np.ptp(scale.transform(one.get_ylim()))) for scale, one in zip(scales, axes, strict=True)]
    names: dict[str, list[str]] = {}
    for label in dict.fromkeys(label for row in rows for label in row):
        for kept in names:
            pairs = [(row.get(kept), row.get(label)) for row in rows]
            if all(_coincide(*pair, scale, size) for pair, scale, size in zip(pairs, scales, heights, strict=True)):
                names[kept].append(label)
                for _, line in pairs:
                    if line is not None:
                        line.remove()
                break
        else:
            names[label] = [label]
    found = {kept: labels for kept, labels in names.items() if len(labels) > 1}
    renamed = {label: joined_labels(labels) for labels in found.values() for label in labels}
    for line in (line for one in axes for line in one.lines):
        label = str(line.get_label())
        thin = THIN * label.startswith(THIN)
        line.set_label(thin + renamed.get(label.removeprefix(thin), label.removeprefix(thin)))
    return found


def joined_labels(labels: Iterable[str]) -> str:
    """Label of a curve that stands for several plans."""
    return " = ".join(labels)


def _coincide(one: Line2D | None, other: Line2D | None, scale: Transform, height: float) -> bool:
    """Whether two curves cannot be told apart on a screen; neither being there counts as well."""
    if one is None or other is None:
        return one is other
    (x, a), (u, b) = one.get_data(), other.get_data()
    if np.shape(x) != np.shape(u) or not np.array_equal(x, u):
        return False
    with np.errstate(all="ignore"):
        apart = np.abs(scale.transform(np.asarray(a, dtype=float)) - scale.transform(np.asarray(b, dtype=float)))
    differs = np.max(apart, initial=0.0, where=~np.isnan(apart))
    return bool(np.array_equal(np.isnan(a), np.isnan(b)) and differs <= _APART * height)


_BEYOND = 0.5
"""Part of the range of the other curves by which a step may exceed it without being clipped."""

_NEGLIGIBLE = 1e-8
"""Range of the other curves, relative to that of a step, below which they show errors of a simulation only."""


def clip_steps(axes: Axes, roles: Mapping[str, Role]) -> None:
    """Scale the y axis by the curves that are no steps; the peak of a step beyond them is written above the axes.

    Parameters
    ----------
    axes : Axes
        Where the curves of plans have the labels of `line_styles`.
    roles : mapping of str to Role
        What each plan is.
    """
    steps = {legend_label(name): name for name, role in roles.items() if role is Role.STEP}
    curves = [line for line in axes.lines if line.get_linestyle() != "None" and np.size(line.get_xdata()) > 2]
    others = [line for line in curves if str(line.get_label()) not in steps]
    scale = axes.yaxis.get_transform()
    low, high = _range_of(others, scale)
    span = high - low
    if not 0.0 < span < np.inf:
        return
    beyond = []
    for line in curves:
        first, last = _range_of([line], scale)
        if span < _NEGLIGIBLE * (last - first):
            return
        if str(line.get_label()) in steps and (first < low - _BEYOND * span or last > high + _BEYOND * span):
            values = np.asarray(line.get_ydata(), dtype=float)
            peak = values[np.nanargmax(np.where(np.isfinite(values), np.abs(values), -1.0))]
            beyond.append(f"{as_text(steps[str(line.get_label())])}: {clipped_note(peak)}")
    if beyond:
        bottom, top = scale.inverted().transform([low - 0.08 * span, high + 0.08 * span]).tolist()
        axes.set_ylim(bottom, top)
        for note in beyond:
            add_title(axes, "\n".join(wrap(note, _TITLE)))


def clipped_note(peak: float) -> str:
    """Note on a curve that is drawn only in part, with the peak that is not drawn."""
    shown = f"{float(f'{peak:.3g}'):g}"
    return f"peak {scientific(peak, 3) if 'e' in shown else shown}, clipped".replace("-", "−")


_TITLE = 44
"""Letters of a line of a title, which fits above one of two axes side by side."""


def _range_of(curves: Iterable[Line2D], scale: Transform) -> tuple[float, float]:
    """Finite extent of curves on a scale; (inf, -inf) of none."""
    with np.errstate(all="ignore"):
        values = [scale.transform(np.asarray(line.get_ydata(), dtype=float)) for line in curves]
    finite = [row[np.isfinite(row)] for row in values]
    return (
        min((float(row.min()) for row in finite if row.size), default=np.inf),
        max((float(row.max()) for row in finite if row.size), default=-np.inf),
    )


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


def line_styles(
    roles: Mapping[str, Role], known: Mapping[str, Style] | None = None, measured: Collection[str] = ()
) -> dict[str, Style]:
    """Default colour and dashes of each plan.

    The first step is black and dotted, and the first planned references have
    the main colours in order; baselines and all others have the other colours.
    Measured runs have solid lines below all others, in the other colours.

    Parameters
    ----------
    roles : mapping of str to Role
        What each plan is.
    known : mapping of str to dict, optional
        Styles of plans that are drawn elsewhere on the page, which they keep.
    measured : collection of str, optional
        Names of measured runs.
    """
    main = {name: (style["color"], style["linestyle"]) for name, style in (known or {}).items() if name in roles}
    used = {colour for colour, _ in main.values()}
    free = {Role.STEP: [_STEP], Role.PLANNED: [*_PLANS], Role.BASELINE: []}
    free = {role: [look for look in looks if look[0] not in used] for role, looks in free.items()}
    for name, role in roles.items():
        if name not in main and name not in measured and free[role]:
            main[name] = free[role].pop(0)
    spare, dashed = cycle([*_OTHERS, *(colour for looks in free.values() for colour, _ in looks)]), cycle(_OTHER_DASHES)
    styles: dict[str, Style] = {}
    for name in roles:
        colour, dashes = main[name] if name in main else (next(spare), "-" if name in measured else next(dashed))
        # Dashes over solid lines, so that coinciding curves are both visible.
        zorder = 1.5 if name in measured else 2.0 if dashes == "-" else 2.5
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
    measured = () if isinstance(shown, Sweep) else shown.measured
    return _told_apart(line_styles(roles_of(shown), known, measured), axes)


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
        if own and style["color"] == _BLACK:
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


def shown_label(label: str) -> str:
    """Name of a curve by its label."""
    return label.removeprefix(_HIDDEN)


def thin_style(style: Style) -> Style:
    """Style of the reference of a plan that is drawn with its response."""
    width = line_width(0.45)
    return {"color": style["color"], "linewidth": width, "alpha": 0.6, "label": f"{THIN}{style['label']}"}


THIN = "_reference of "
"""Labels of thin references begin so: matplotlib leaves labels that begin with an underscore out of legends."""


def salt_of(key: str) -> str:
    """Beginning of the ids of a drawing on a page."""
    return re.sub(r"[^\w.-]+", "-", key)


def to_svg(figure: Figure, key: str) -> str:
    """Figure as an SVG element to stand in a page; `key` keeps its ids apart from others'.

    Its greys are CSS variables, --g00 for black to --gff for white, which a
    dark page sets.
    """
    salt = salt_of(key)
    buffer = io.StringIO()
    with _house_settings(**{"svg.hashsalt": salt}):
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = buffer.getvalue()
    text = _compact(text[text.index("<svg") :])
    text = _GREY.sub(lambda grey: f"var(--g{grey[1]}, {grey[0]})", text)
    # Several drawings stand in one page: what they define must be their own.
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{salt}-", text)


def _compact(svg: str) -> str:
    """Drawing without what is not seen: digits below a hundredth of a point, blanks, and ids that nothing refers to."""
    # Nothing that a label says is an attribute.
    svg = re.sub(r">([^<>]+)<", lambda text: f">{text[1].translate(_IN_TEXT)}<", svg)
    used = {name for pair in re.findall(r'url\(#([^)]*)\)|href="#([^"]*)"', svg) for name in pair}
    short = {name: f"d{k}" for k, name in enumerate(sorted(used - {""}))}

    def renamed(found: re.Match[str]) -> str:
        name = found[2] if _MARKED.match(found[2]) else short.get(found[2], "")
        return f"{found[1]}{name}{found[3]}" if name else ""

    svg = re.sub(r'( id=")([^"]*)(")', renamed, svg)
    svg = re.sub(r"(url\(#)([^)]*)(\))", renamed, svg)
    svg = re.sub(r'(href="#)([^"]*)(")', renamed, svg)
    svg = re.sub(r'\b(?:d|x|y)="[^"]*"', lambda path: _LONG_NUMBER.sub(r"\1", path[0]), svg)
    svg = re.sub(r'\bd="[^"]*"', lambda path: re.sub(r"\s*([MLCQz])\s*", r"\1", path[0]), svg)
    svg = re.sub(r"\s*\n\s*", " ", re.sub(r">\s+<", "><", svg))
    for _ in range(2):
        svg = re.sub(r"<g>(<(?:use|path) [^>]*/>)</g>", r"\1", svg)
    svg = svg.replace("; stroke-linecap: square", "")
    svg = re.sub(r">1e[-−]?\d+<", lambda power: f">×10{superscript(power[0][3:-1].replace('−', '-'))}<", svg)
    return _EQUAL_MARKS.sub(lambda run: f'<g style="{run[1]}">{run[0].replace(_style(run[1]), "")}</g>', svg)


def _style(text: str) -> str:
    return f' style="{text}"'


_IN_TEXT = str.maketrans({'"': "&quot;", "#": "&#35;"})
_EQUAL_MARKS = re.compile(r'<use [^>]*? style="([^"]*)"/>(?:<use [^>]*? style="\1"/>)+')
_MARKED = re.compile(r"(?:curve|entry|key)-")
_LONG_NUMBER = re.compile(r"(\.\d\d)\d+")
_GREY = re.compile(r"#([0-9a-f]{2})\1\1\b")


def grey_levels(svgs: Iterable[str]) -> list[int]:
    """Grey levels (0 to 255) of the variables in drawings of `to_svg`."""
    return sorted({int(level, 16) for svg in svgs for level in re.findall(r"var\(--g([0-9a-f]{2}),", svg)})


def slug(name: str) -> str:
    """Name as part of an id: only letters, digits, hyphens and underscores."""
    return re.sub(r"[^\w-]+", "-", name) or "study"
