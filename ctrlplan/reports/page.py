"""One self-contained HTML page, and its data as JSON."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape
from markupsafe import Markup

import ctrlplan
from ctrlplan import _files
from ctrlplan._display import readable
from ctrlplan.reports.crane_figures import animation_data
from ctrlplan.reports.parts import WIDTHS, Animation, Svg
from ctrlplan.reports.shown import Shown, shown
from ctrlplan.reports.style import grey_levels, page_style
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.sections import Wall
from ctrlplan.studies.study import Study
from ctrlplan.studies.sweep import Sweep


def write_page(studies: Sequence[Study | Sweep], path: str | os.PathLike[str], title: str, author: str = "") -> Path:
    """Write studies as one HTML page that opens offline.

    Parameters
    ----------
    studies : sequence of Study or Sweep
        Sections of the page.
    path : str or path
        The file, or a folder for ``index.html`` in it.
    title : str
        Heading.
    author : str, optional
        Who made it, written below the heading.

    Returns
    -------
    pathlib.Path
        The file written.

    Raises
    ------
    OSError
        If it cannot be written; no partial output remains.
    """
    target = Path(path)
    if target.suffix not in (".html", ".htm"):
        target = target / "index.html"
    return write_all({target: render_page(studies, title, author)})[0]


def write_report(studies: Sequence[Study], folder: str | os.PathLike[str], title: str, author: str = "") -> list[Path]:
    """Write ``index.html`` and ``results.json`` into a folder, which is made if need be.

    Raises
    ------
    OSError
        If the folder cannot be written; no partial output remains.
    """
    target = Path(folder)
    results = {"studies": {study.name: study.results() for study in studies}}
    return write_all(
        {
            target / "index.html": render_page(studies, title, author),
            target / "results.json": json.dumps(results, indent=1, allow_nan=False) + "\n",
        }
    )


def write_all(texts: Mapping[Path, str | bytes]) -> list[Path]:
    """Write files, replacing none before all are on the disk; folders are created if necessary.

    Raises
    ------
    OSError
        If one cannot be written; no partial output remains.
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
    except BaseException:  # including KeyboardInterrupt
        for folder in reversed(made):
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()
        raise
    return list(texts)


def render_page(studies: Sequence[Study | Sweep], title: str, author: str = "") -> str:
    """The page as text."""
    found: list[Shown] = []
    with page_style():
        for study in studies:
            found.append(shown(study, [name for one in found for name in one.ids]))
    script = _script("sort.js.html") + _script("figures.js.html")
    if any(isinstance(block, Animation) for one in found for block in one.figures):
        script += _script("animation.js.html")
    return _template("page.html").render(
        title=title,
        author=author,
        studies=found,
        version=ctrlplan.__version__,
        greys=_dark_greys(found),
        widths=WIDTHS,
        script=script,
        policy=_policy(script),
    )


class CraneAnimation:
    """Animation of a comparison of cranes for notebooks.

    Parameters
    ----------
    comparison : Comparison
        Of loops made by `crane_loop`.
    wall : ((float, float), (float, float)), optional
        Obstacle to draw: limits in x and in z [m].
    shown : str, optional
        Plan shown first; unless given, the first trigonometric plan, or else
        the first plan that is not a step.

    Raises
    ------
    ValueError
        If the comparison is not of cranes, or has no plan `shown`.
    """

    def __init__(self, comparison: Comparison, wall: Wall = None, shown: str = "") -> None:
        self._data = animation_data(comparison, wall, shown)
        self._name = f"crane{abs(hash(self._data)):x}"

    def _repr_html_(self) -> str:
        caption = Animation(self._data).caption
        drawing = _template("animation.html").render(name=self._name, data=self._data, caption=caption)
        return f"{drawing}<script>{_script('animation.js.html')}</script>"


def comparison_fragment(comparison: Comparison) -> str:
    """A comparison as Jupyter shows it."""
    return comparison._repr_html_()


def _template(name: str) -> Template:
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


def _readable(value: object) -> object:
    """Text for the page, without characters that cannot be displayed or encoded."""
    return readable(value) if type(value) is str else value


def _script(name: str) -> Markup:
    """A script of the page; it contains no user data."""
    loader = _environment().loader
    assert loader is not None  # noqa: S101 (for the type)
    return Markup(loader.get_source(_environment(), name)[0])  # noqa: S704 (our own script)


def _policy(script: str) -> str:
    """Content security policy of the page: its script and styles, no external resources."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


_INK, _GROUND = (230, 234, 235), (20, 24, 26)
"""Text and background of a dark page, RGB."""


def _dark_greys(shown: Sequence[Shown]) -> dict[str, str]:
    """Greys of the drawings on a dark page, by their names: black becomes the text, white the background."""
    svgs = [block.svg for one in shown for block in one.figures if isinstance(block, Svg)]
    greys = {}
    for level in grey_levels(svgs):
        mixed = [round(ink + (ground - ink) * level / 255) for ink, ground in zip(_INK, _GROUND, strict=True)]
        greys[f"g{level:02x}"] = f"#{bytes(mixed).hex()}"
    return greys
