"""Reading of study files: checked entries, with file and place in every error."""

from __future__ import annotations

import importlib
import importlib.util
import math
import re
import sys
from collections.abc import Collection
from pathlib import Path
from types import ModuleType

from ctrlplan._types import Data


class StudyError(ValueError):
    """Error in a study file, with a message of one line."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


class StructureError(StudyError):
    """Error in the name, the type or the range of an entry, which the JSON Schema finds as well."""


class Reader:
    """Checked access to the entries of one file.

    Parameters
    ----------
    path : pathlib.Path
        Path of the file, for messages.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def error(self, place: str, message: object) -> StudyError:
        """Error at an entry."""
        return StudyError(f"{self.path}: {place}: {message}")

    def structure(self, place: str, message: object) -> StructureError:
        """Error in the name, the type or the range of an entry."""
        return StructureError(f"{self.path}: {place}: {message}")

    def known(self, table: Data, names: Collection[str], place: str) -> None:
        """Raise if a table has an unknown entry."""
        for key in table:
            if key not in names:
                raise self.structure(place, f"entries must be among {', '.join(names)}, got {key!r}")


def reference(text: object) -> tuple[str, str] | None:
    """Module and name of "python:module:name"; None for every other value."""
    found = _REFERENCE.fullmatch(text) if isinstance(text, str) else None
    return (found[1], found[2]) if found else None


_REFERENCE = re.compile(r"python:([^:]*):([^:]*)", re.DOTALL)


def named_in_module(text: str, folder: Path) -> object:
    """Object that "python:module:name" refers to, in a module next to the study file or an installed one.

    The module is executed; its exceptions are not caught.
    """
    found = reference(text)
    if found is None or not all(part.isidentifier() for part in (*found[0].split("."), found[1])):
        raise ValueError("module and object must be identifiers, with dots between packages")
    return getattr(module_of(found[0], folder), found[1])


def module_of(name: str, folder: Path) -> ModuleType:
    """Module next to the study file, in preference to an installed one of the same name."""
    source = folder.joinpath(*name.split(".")).with_suffix(".py")
    spec = importlib.util.spec_from_file_location(name, source) if source.is_file() else None
    if spec is None or spec.loader is None:
        return importlib.import_module(name)
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(folder))  # for its own imports
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
    return module


def got(value: object) -> str:
    """Representation of a value for a message."""
    try:
        return one_line(repr(value), 300)
    except ValueError:  # an integer with too many digits for Python
        return f"a {type(value).__name__} too long to print"


def one_line(text: str, longest: int = 1500) -> str:
    """Text in one line without control characters, shortened in the middle if it is long."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    return line if len(line) <= longest else f"{line[: longest - 100]} … {line[-100:]}"


def is_number(value: object, finite: bool = True) -> bool:
    """Whether a TOML value is a number and not a Boolean."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value) or not finite
    except OverflowError:  # an integer beyond the range of floats
        return False
