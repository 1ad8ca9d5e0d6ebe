"""Commented study files to start from, one for each kind of study."""

from __future__ import annotations

import contextlib
import shlex
from pathlib import Path

from ctrlplan.studies.reading import StudyError, one_line

_FOLDER = Path(__file__).with_name("templates")
_STUDY = "study.toml"
_FIRST = "linear"


def study_kinds() -> tuple[str, ...]:
    """Kinds of study files, by the folders that hold them; the first is that of a linear loop."""
    return tuple(sorted((folder.name for folder in _FOLDER.iterdir()), key=lambda name: (name != _FIRST, name)))


def study_purpose(kind: str) -> str:
    """What a kind is for: the first line of its file."""
    return _text(_FOLDER / kind / _STUDY).partition("\n")[0].removeprefix("# ")


def new_study(path: Path, kind: str) -> list[Path]:
    """Write a commented study file, with the files it refers to next to it.

    Parameters
    ----------
    path : Path
        Study file, in an existing folder.
    kind : str
        One of `study_kinds`.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    StudyError
        If a file exists, or cannot be written; nothing is then written.
    """
    if path.suffix != ".toml":
        raise StudyError(f"a study file must end in .toml, got {path}")
    texts = {path: _text(_FOLDER / kind / _STUDY).replace("FILE", shlex.quote(one_line(path.name)))}
    for source in sorted((_FOLDER / kind).iterdir()):
        if source.name != _STUDY:
            texts[path.with_name(source.name.removesuffix(".in"))] = _text(source)
    written: list[Path] = []
    try:
        for place, text in texts.items():
            with place.open("x", encoding="utf-8", newline="\n") as file:
                written.append(place)
                file.write(text)
    except OSError as error:
        for made in written:
            with contextlib.suppress(OSError):
                made.unlink()
        if isinstance(error, FileExistsError):
            raise StudyError(f"a new file must not exist yet, got {place}; choose another name or folder") from None
        raise StudyError(f"a new file must be writable, got {place}: {error.strerror or error}") from None
    return written


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")
