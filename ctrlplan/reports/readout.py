"""What the script of a page must know of a figure: where its axes are, on which scale, and which curves they have."""

from __future__ import annotations

import numpy as np
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.scale import SymmetricalLogTransform

from ctrlplan.reports.style import THIN, salt_of, shown_label


def mark_curves(figure: Figure) -> None:
    """Give the curves and the entries of the legend of a figure ids, by which they are found in its drawing."""
    for a, axes in enumerate(figure.axes):
        for c, line in enumerate(_curves(axes)):
            line.set_gid(f"curve-{a}-{c}")
    for legend in figure.legends:
        for e, (text, handle) in enumerate(zip(legend.get_texts(), legend.legend_handles, strict=True)):
            text.set_gid(f"entry-{e}")
            if handle is not None:
                handle.set_gid(f"key-{e}")


def readout_data(figure: Figure, key: str) -> Markup:
    """JSON, safe inside HTML, for the read-out of a figure that `to_svg` has drawn; empty where there is no curve.

    Entries: axes with their box in the drawing [pt] from its upper left corner,
    limits and scales, label, and curves by id; entries of the legend by id.

    Parameters
    ----------
    figure : Figure
        What is drawn, with the marks of `mark_curves`.
    key : str
        As of `to_svg`.
    """
    salt = salt_of(key)
    width, height = (72.0 * size for size in figure.get_size_inches())
    found = []
    for axes in figure.axes:
        curves = {f"{salt}-{line.get_gid()}": _entry(line) for line in _curves(axes)}
        if not curves or not axes.get_visible() or not axes.axison:
            continue
        box = axes.get_position()
        found.append(
            {
                "box": [
                    round(float(value), 3)
                    for value in (box.x0 * width, (1.0 - box.y1) * height, box.width * width, box.height * height)
                ],
                "x": _scale(axes.xaxis),
                "y": _scale(axes.yaxis),
                "label": [_words(axes.get_xlabel() or "time [s]"), _words(axes.get_ylabel())],
                "path": any(_turns(line) for line in _curves(axes)),
                "curves": curves,
            }
        )
    entries = [
        [f"{salt}-entry-{e}", f"{salt}-key-{e}", shown_label(str(handle.get_label()))]
        for legend in figure.legends
        for e, handle in enumerate(legend.legend_handles)
        if handle is not None
    ]
    return htmlsafe_json_dumps({"axes": found, "entries": entries}) if found else Markup("")


def _curves(axes: Axes) -> list[Line2D]:
    """Curves of an axes that have a name, and the thin references of plans."""
    named = [line for line in axes.lines if line.get_linestyle() != "None" and np.size(line.get_xdata()) > 2]
    return [line for line in named if not str(line.get_label()).startswith("_") or _is_thin(line)]


def _is_thin(line: Line2D) -> bool:
    return str(line.get_label()).startswith(THIN)


def _entry(line: Line2D) -> list[object]:
    """Name of a curve, and whether it is a thin reference."""
    return [shown_label(str(line.get_label()).removeprefix(THIN)), _is_thin(line)]


def _turns(line: Line2D) -> bool:
    """Whether a curve is a path, which has several points at one value of x."""
    x = np.asarray(line.get_xdata(), dtype=float)
    return bool(np.any(np.diff(x[np.isfinite(x)]) < 0.0))


def _words(label: str) -> str:
    return label.replace(r"\$", "$").replace("\n", " ")


def _scale(axis: Axis) -> list[object]:
    """Limits at the lower left and the upper right, kind of scale, and its parameters."""
    first, last = (float(limit) for limit in axis.get_view_interval())
    transform = axis.get_transform()
    if isinstance(transform, SymmetricalLogTransform):
        return [first, last, "symlog", float(transform.linthresh), float(transform.linscale)]
    return [first, last, axis.get_scale()]
