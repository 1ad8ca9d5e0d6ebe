"""One self-contained HTML page, and its data as JSON."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import os
import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import metadata
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape
from markupsafe import Markup

import ctrlplan
from ctrlplan import _files
from ctrlplan._display import in_line, readable
from ctrlplan.reports.crane_figures import animation_data
from ctrlplan.reports.parts import Animation, MetricsTable, Part, Picture, Svg
from ctrlplan.reports.sections import draw
from ctrlplan.reports.style import page_style, slug, to_svg
from ctrlplan.reports.tables import metrics_of
from ctrlplan.studies.benefit import Benefit
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.sections import Section, Wall
from ctrlplan.studies.study import Study
from ctrlplan.studies.verdicts import summary, verdicts


def write_page(studies: Sequence[Study], path: str | os.PathLike[str], title: str) -> Path:
    """Write studies as one self-contained HTML page.

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
        If it cannot be written; no partial output remains.
    """
    target = Path(path)
    if target.suffix not in (".html", ".htm"):
        target = target / "index.html"
    return write_all({target: render_page(studies, title)})[0]


def write_report(studies: Sequence[Study], folder: str | os.PathLike[str], title: str) -> list[Path]:
    """Write ``index.html`` and ``results.json`` into a folder, which is created if necessary.

    Raises
    ------
    OSError
        If the folder cannot be written; no partial output remains.
    """
    target = Path(folder)
    results = {"studies": {study.name: study.results() for study in studies}}
    return write_all(
        {
            target / "index.html": render_page(studies, title),
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


def render_page(studies: Sequence[Study], title: str) -> str:
    """The page as text."""
    shown: list[_Shown] = []
    with page_style():
        for study in studies:
            shown.append(_shown(study, [name for one in shown for name in one.ids]))
    script = _script("sort.js.html")
    if any(isinstance(block, Animation) for one in shown for part in one.parts for block in part.blocks):
        script += _script("animation.js.html")
    return _template("page.html").render(
        title=title,
        studies=shown,
        versions=_versions(),
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


@dataclass(frozen=True)
class _Shown:
    """A study as the page shows it.

    Attributes
    ----------
    study : Study
        The study.
    id : str
        Id of its section, derived from the name of the study.
    ids : tuple of str
        All ids of the section.
    parts : tuple of Part
        Its sections, with the benefit of planning if the comparison has one;
        figures as SVG elements, with their ids as keys.
    """

    study: Study
    id: str
    ids: tuple[str, ...]
    parts: tuple[Part, ...]

    @property
    def above(self) -> list[Part]:
        """Parts above the metrics."""
        return [part for part in self.parts if not part.below]

    @property
    def below(self) -> list[Part]:
        """Parts below the metrics."""
        return [part for part in self.parts if part.below]

    @property
    def nominal(self) -> bool:
        """Whether the metrics are those at nominal parameters."""
        return any(part.nominal for part in self.parts)

    @property
    def summary(self) -> str:
        """Number of metrics in which each plan is best and worst."""
        return summary(self.study.comparison)

    @property
    def verdicts(self) -> list[str]:
        """Best and worst plan of each metric, in sentences."""
        return [verdict.sentence for verdict in verdicts(self.study.comparison)]

    @property
    def parameters(self) -> dict[str, str]:
        """Parameters of the comparison."""
        return {name: in_line(value) for name, value in self.study.comparison.parameters.items()}

    @property
    def table(self) -> MetricsTable:
        """The metrics."""
        return metrics_of(self.study.comparison)


def _shown(study: Study, taken: Collection[str]) -> _Shown:
    """A study with its figures drawn, with ids that are unique on the page."""
    sections: list[Section | Benefit] = list(study.sections)
    if study.comparison.benefit is not None:
        sections.append(study.comparison.benefit)
    parts = [draw(section, study) for section in sections]
    keys: list[str] = []
    for block in (block for part in parts for block in part.blocks if isinstance(block, _Keyed)):
        keys.append(_numbered(slug(block.key), lambda key: key in keys))
    name = _numbered(slug(study.name), lambda name: not {name, *(f"{name}-{key}" for key in keys)}.isdisjoint(taken))
    left = iter(keys)
    drawn = [
        replace(
            part,
            blocks=[_drawn(block, name, next(left)) if isinstance(block, _Keyed) else block for block in part.blocks],
        )
        for part in parts
    ]
    return _Shown(study, name, (name, *(f"{name}-{key}" for key in keys)), tuple(drawn))


_Keyed = (Picture, Svg, Animation)


def _drawn(block: Picture | Svg | Animation, name: str, key: str) -> Svg | Animation:
    """A figure with its id as key, and a plot as an SVG element."""
    if isinstance(block, Picture):
        svg = Markup(to_svg(block.plot.figure, f"{name}.{key}"))  # noqa: S704 (our own drawing)
        return Svg(f"{name}-{key}", svg, block.caption)
    return replace(block, key=f"{name}-{key}")


def _numbered(stem: str, taken: Callable[[str], bool]) -> str:
    """A name, with a number added if it is taken."""
    name, count = stem, 1
    while taken(name):
        count += 1
        name = f"{stem}-{count}"
    return name


def _versions() -> dict[str, str]:
    packages = ("control", "numpy", "scipy", "matplotlib")
    found = {"ctrlplan": ctrlplan.__version__, "Python": platform.python_version()}
    return found | {name: metadata.version(name) for name in packages}
