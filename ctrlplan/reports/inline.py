"""Small figures in notebook cells, in the user's settings and in the colours of the page around them."""

from __future__ import annotations

import hashlib
import io
import re
from threading import Lock

from matplotlib import figure as mpl_figure
from matplotlib.axes import Axes

from ctrlplan._display import Figure

_INK = "#010203"
"""Stands for the colour of the text around the figure, which an SVG element inherits."""

_DRAWING = Lock()
"""Fonts and formulas of matplotlib are shared by all threads."""


def to_inline_svg(figure: Figure) -> str:
    """Small figure as an SVG element.

    It is drawn outside pyplot, no setting of matplotlib is changed, and equal
    figures give equal elements.

    Parameters
    ----------
    figure : Figure
        What is drawn.
    """
    with _DRAWING:
        drawn = mpl_figure.Figure(figsize=(4.8, 0.7 + 1.2 * figure.nrows), layout="constrained")
        axes = drawn.subplots(figure.nrows, 1, sharex=True, squeeze=False)[:, 0]
        for one in axes:
            one.set_facecolor("none")
        figure.draw(axes)
        drawn.patch.set_visible(False)
        for one in axes:
            _ink(one)
        for legend in (*drawn.legends, *filter(None, (one.get_legend() for one in axes))):
            legend.get_frame().set_visible(False)
            for text in legend.get_texts():
                text.set_color(_INK)
        drawn.align_ylabels(axes)
        buffer = io.StringIO()
        drawn.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return _own_ids(buffer.getvalue())


def _ink(axes: Axes) -> None:
    """Draw everything but the curves in the colour of the text around."""
    axes.tick_params(which="both", colors=_INK)
    axes.spines[["top", "right"]].set_visible(False)
    for spine in axes.spines.values():
        spine.set_edgecolor(_INK)
    for axis in (axes.xaxis, axes.yaxis):
        axis.label.set_color(_INK)
        axis.get_offset_text().set_color(_INK)


def _own_ids(text: str) -> str:
    """SVG element in one line, with ids and a style that concern no other in the page and depend on the drawing."""
    text = re.sub(r"<!--.*?-->|<style.*?</style>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r"\s+", " ", text).replace("> <", "><").replace("<defs></defs>", "")
    text = text.replace("<svg ", '<svg style="stroke-linejoin:round;stroke-linecap:butt" ', 1)
    ids = {name: str(k) for k, name in enumerate(re.findall(r'\bid="([^"]+)"', text))}
    reference = re.compile(r'(\bid="|url\(#|href="#)([^")]+)')
    numbered = reference.sub(lambda found: f"{found[1]}{ids.get(found[2], found[2])}", text)
    key = hashlib.sha256(numbered.encode()).hexdigest()[:10]
    numbered = reference.sub(rf"\g<1>c{key}-\g<2>", numbered)
    return numbered.replace(_INK, "currentColor").replace("#000000", "currentColor").strip()
