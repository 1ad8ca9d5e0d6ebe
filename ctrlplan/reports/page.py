"""One self-contained HTML page, and its data as JSON."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import math
import os
import platform
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

import ctrlplan
from ctrlplan import _files
from ctrlplan.planning import Fastest
from ctrlplan.reports.crane_figures import Wall, animation_data, is_crane, plot_curves
from ctrlplan.reports.figures import FIGURES
from ctrlplan.reports.planning_figures import plot_rivals
from ctrlplan.reports.style import line_styles, page_style, slug, to_svg
from ctrlplan.reports.words import number, summary, unit_in, unit_of, verdicts
from ctrlplan.studies.benefit import Benefit
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.grids import SAME, Grid
from ctrlplan.studies.study import Study


def write_page(studies: Sequence[Study], path: str | os.PathLike[str], title: str) -> Path:
    """Write studies as one HTML page that opens offline.

    Parameters
    ----------
    studies : sequence of Study
        Sections of the page.
    path : str or path
        The file, or a folder for ``index.html`` in it.
    title : str
        Heading.

    Returns
    -------
    pathlib.Path
        The file written.

    Raises
    ------
    OSError
        If it cannot be written; nothing is left behind.
    """
    target = Path(path)
    if target.suffix not in (".html", ".htm"):
        target = target / "index.html"
    return write_all({target: render_page(studies, title)})[0]


def write_report(studies: Sequence[Study], folder: str | os.PathLike[str], title: str) -> list[Path]:
    """Write ``index.html`` and ``results.json`` into a folder, which is made if need be.

    Raises
    ------
    OSError
        If the folder cannot be written; nothing is left behind.
    """
    target = Path(folder)
    results = {"studies": {study.name: study.results() for study in studies}}
    return write_all(
        {
            target / "index.html": render_page(studies, title),
            target / "results.json": json.dumps(results, indent=1, allow_nan=False) + "\n",
        }
    )


def write_all(texts: Mapping[Path, str]) -> list[Path]:
    """Write files, of which none is replaced before all are on the disk; their folders are made if need be.

    Raises
    ------
    OSError
        If one cannot be written; nothing is left behind.
    """
    contents: dict[_files.PathLike, str | bytes] = dict(texts.items())
    made: list[Path] = []
    try:
        for path in texts:
            missing = [folder for folder in path.parents if not folder.exists()]
            for folder in reversed(missing):
                folder.mkdir(exist_ok=True)
                made.append(folder)
        _files.write_all(contents)
    except BaseException:  # an interruption as well
        for folder in reversed(made):
            with contextlib.suppress(OSError):  # somebody else has written there
                folder.rmdir()
        raise
    return list(texts)


def render_page(studies: Sequence[Study], title: str) -> str:
    """The page as text."""
    with page_style():
        sections = [_section(study, key) for study, key in zip(studies, _keys(studies), strict=True)]
    script = _script("sort.js.html")
    if any(section["animation"] for section in sections):
        script += _script("animation.js.html")
    return _template("page.html").render(
        title=title,
        sections=sections,
        versions=_versions(),
        script=script,
        policy=_policy(script),
    )


class CraneAnimation:
    """Animation of a crane's comparison that a notebook plays, offline as well.

    Parameters
    ----------
    comparison : Comparison
        Of loops made by `crane_loop`.
    wall : ((float, float), (float, float)), optional
        An obstacle to draw: its sides in x and in z [m].

    Raises
    ------
    ValueError
        If the comparison is not of a crane.
    """

    def __init__(self, comparison: Comparison, wall: Wall = None) -> None:
        if not is_crane(comparison):
            raise ValueError("an animation must be of a comparison of cranes, got one without D, R and theta")
        self._data = animation_data(comparison, wall)
        self._name = f"crane{abs(hash(self._data)):x}"

    def _repr_html_(self) -> str:
        drawing = _template("animation.html").module.crane_animation(self._name, self._data)
        return f"{drawing}<script>{_script('animation.js.html')}</script>"


def comparison_fragment(comparison: Comparison) -> str:
    """Metrics table and verdict for a notebook cell."""
    table = _table(comparison)
    return _template("fragment.html").render(
        title=comparison.title, table=table, summary=summary(comparison), notes=comparison.notes
    )


def _template(name: str) -> Any:
    return _environment().get_template(name)


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("ctrlplan.reports", "templates"),
        autoescape=select_autoescape(),
        finalize=_readable,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


# Control characters, overrides of the direction of writing, halves of surrogate pairs (of file names), no characters.
_UNREADABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


def _readable(value: Any) -> Any:
    """What is put into the page: of a text every character that can be seen and written."""
    return _UNREADABLE.sub("\N{REPLACEMENT CHARACTER}", value) if type(value) is str else value


def _script(name: str) -> Markup:
    """A script of the page, which has no names in it: what it works on stands in the elements as text."""
    loader = _environment().loader
    assert loader is not None  # noqa: S101 (for the type)
    return Markup(loader.get_source(_environment(), name)[0])  # noqa: S704 (our own script)


def _policy(script: str) -> str:
    """Content security policy of the page: its own script and styles, and nothing from outside."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _keys(studies: Sequence[Study]) -> list[str]:
    """Ids of the sections: the studies' names as far as an id can hold them; no id of the page stands twice."""
    keys: list[str] = []
    taken: set[str] = set()
    for study in studies:
        stem = key = slug(study.name)
        count = 1
        while not taken.isdisjoint(_ids(key, study)):
            count += 1
            key = f"{stem}-{count}"
        keys.append(key)
        taken.update(_ids(key, study))
    return keys


def _ids(name: str, study: Study) -> list[str]:
    """Ids of a section, its own the first, and of the figures in it."""
    return [name, *(f"{name}-{key}" for key in study.figures)]


def _section(study: Study, name: str) -> dict[str, Any]:
    comparison = study.comparison
    figures = []
    for key in study.figures:
        draw, caption = FIGURES[key]
        svg = to_svg(draw(study).figure, f"{name}.{key}")
        if draw is plot_curves:
            caption = study.curves[0].caption
        figures.append({"key": key, "svg": Markup(svg), "caption": caption})  # noqa: S704 (our own drawing)
    return {
        "name": name,
        "title": study.title,
        "summary": study.summary,
        "notes": study.notes,
        "verdict": summary(comparison),
        "verdicts": [v.sentence for v in verdicts(comparison)],
        "table": _table(comparison),
        "spread": _spread(study.ensemble),
        "figures": figures,
        "animation": animation_data(comparison, study.wall) if is_crane(comparison) else "",
        "marks": comparison.marks,
        "failures": comparison.failures,
        "parameters": {k: str(v) for k, v in comparison.parameters.items()},
        "worth": None if comparison.benefit is None else _worth(comparison.benefit, name),
        "claim": study.claim,
        "grids": [_grid(grid, grid.unit) for grid in study.grids],
        "fastest": None if study.fastest is None else _fastest(study.fastest, study, name),
    }


def _fastest(found: Fastest, study: Study, name: str) -> dict[str, Any]:
    """The section on a plan as fast as limits allow."""
    units = study.comparison.units
    return {
        "duration": number(found.duration),
        "limit": found.active.bound.name,
        "time": number(found.active.time),
        "rows": [
            {
                "name": row.bound.name,
                "unit": units.get(row.bound.name, ""),
                "range": row.bound.range,
                "value": number(row.value),
                "time": number(row.time),
                "left": row.share,
            }
            for row in found.margins
        ],
        "svg": Markup(to_svg(found.plot(units).figure, f"{name}.fastest")),  # noqa: S704 (our own drawing)
        "caption": "Every limited signal of the fastest plan, and where it comes nearest to its limits (dashed).",
    }


def _worth(worth: Benefit, name: str) -> dict[str, Any]:
    """The section on whether planning is worth it."""
    least = min((need.duration for need in worth.needs if math.isfinite(need.duration)), default=math.nan)
    return {
        "verdicts": worth.verdicts,
        "alpha": f"{worth.alpha:.4g}",
        "note": worth.note,
        "svg": Markup(to_svg(plot_rivals(worth.comparison).figure, f"{name}.worth")),  # noqa: S704 (our own drawing)
        "caption": "References through the same waypoints in the same time, what the loop makes of them, and what "
        "that asks of its controls.",
        "table": _table(worth.comparison),
        "limits": "; ".join(f"{limit} {_limit_words(value)}" for limit, value in worth.limits.items()),
        "needs": [
            {
                "name": need.name,
                "text": number(need.duration),
                "mark": "win" if need.duration <= least * (1.0 + SAME) else "",
                "limit": need.limit,
                "kept": need.kept,
            }
            for need in worth.needs
        ],
        "grids": [_grid(grid, unit_in(worth.comparison, grid.unit)) for grid in worth.grids],
    }


def _limit_words(value: Any) -> str:
    """A limit as it was given, to four digits."""
    if np.ndim(value):
        low, high = ("any" if side is None else f"{side:.4g}" for side in value)
        return f"from {low} to {high}"
    return f"within ±{value:.4g}"


def _grid(grid: Grid, unit: str) -> dict[str, Any]:
    """Rows of a number over duration and alpha, the rivals behind it."""
    rows = []
    for i, (duration, marks) in enumerate(zip(grid.durations.tolist(), grid.marks(), strict=True)):
        best, _ = grid.best(i)
        own = zip(grid.values[i].tolist(), marks, strict=True)
        cells = [{"text": number(value, unit), "mark": mark} for value, mark in own]
        cells += [
            {"text": number(float(values[i]), unit), "mark": "best" if name == best else ""}
            for name, values in grid.rivals.items()
        ]
        rows.append({"duration": f"{duration:.4g}", "cells": cells})
    heads = [f"alpha {a:.3g}" if a else "alpha 0 (polynomial)" for a in grid.alphas.tolist()]
    return {"title": grid.title, "unit": unit, "heads": [*heads, *grid.rivals], "rows": rows}


def _table(comparison: Comparison) -> dict[str, Any]:
    """Rows of the metrics: cells with a number to sort by, a text, and whether it wins or loses."""
    decided = {v.key: v for v in verdicts(comparison)}
    rows = []
    for key, measure in comparison.measures.items():
        if not any(key in found for found in comparison.metrics.values()):
            continue
        verdict = decided.get(key)
        cells = []
        for plan, found in comparison.metrics.items():
            value = found.get(key, math.nan)
            mark = "" if verdict is None else "win" if plan in verdict.winners else ""
            if verdict is not None and plan in verdict.losers:
                mark = "lose"
            order = "" if math.isnan(value) else "1e999" if math.isinf(value) else repr(value)
            cells.append({"text": number(value, measure.unit), "order": order, "mark": mark})
        rows.append({"title": measure.title, "unit": unit_of(comparison, key) or "", "cells": cells})
    styles = line_styles(comparison.metrics)
    plans = [
        {"name": plan, "colour": styles[plan]["color"], "mark": "†" if plan in comparison.marks else ""}
        for plan in comparison.metrics
    ]
    return {"plans": plans, "rows": rows}


def _spread(ensemble: Ensemble | None) -> dict[str, Any] | None:
    """Rows of metrics over draws: the median, and where nine tenths of them lie."""
    if ensemble is None:
        return None
    nominal, rows = ensemble.nominal, []
    for key, measure in nominal.measures.items():
        if not any(key in found for found in ensemble.metrics.values()):
            continue
        cells = []
        for plan in nominal.metrics:
            low, _, middle, _, high = ensemble.quantiles(key)[plan] if key in ensemble.metrics.get(plan, {}) else _NONE
            text = f"{number(middle, measure.unit)} ({number(low, measure.unit)} to {number(high, measure.unit)})"
            order = "" if math.isnan(middle) else "1e999" if math.isinf(middle) else repr(float(middle))
            cells.append({"text": text, "order": order, "mark": ""})
        rows.append({"title": measure.title, "unit": unit_of(nominal, key) or "", "cells": cells})
    styles = line_styles(nominal.metrics)
    plans = [{"name": plan, "colour": styles[plan]["color"], "mark": ""} for plan in nominal.metrics]
    return {"plans": plans, "rows": rows}


_NONE = (math.nan,) * 5


def _versions() -> dict[str, str]:
    packages = ("control", "numpy", "scipy", "matplotlib")
    found = {"ctrlplan": ctrlplan.__version__, "Python": platform.python_version()}
    return found | {name: metadata.version(name) for name in packages}
