"""Reading a study file: tables checked entry by entry, with file and place in every error."""

from __future__ import annotations

import importlib
import importlib.util
import math
import re
import sys
from collections.abc import Collection
from functools import partial
from pathlib import Path
from types import ModuleType

from ctrlplan._types import Data


class StudyError(ValueError):
    """A study file is wrong: one line says what must hold, what was given and where."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


class Reader:
    """Checks of the entries of one file, with the place in every error.

    Parameters
    ----------
    path : pathlib.Path
        The file, for messages.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def error(self, place: str, message: object) -> StudyError:
        """The error of an entry."""
        return StudyError(f"{self.path}: {place}: {message}")

    def known(self, table: Data, names: Collection[str], place: str) -> None:
        """Raise where a table has an entry that is not among some names."""
        for key in table:
            if key not in names:
                raise self.error(place, f"entries must be among {', '.join(names)}, got {key!r}")

    def table(self, data: Data, key: str, needed: bool = True) -> Data:
        """Table of an entry; an empty one where it is missing and not needed."""
        found = data.get(key)
        if found is None and not needed:
            return {}
        if not isinstance(found, dict):
            raise self.error(key, f"must be a table [{key}], got {'none' if found is None else got(found)}")
        return found

    def tables(self, data: Data, key: str) -> list[Data]:
        """Tables of an entry, none where it is missing."""
        found = data.get(key, [])
        if not isinstance(found, list) or not all(isinstance(t, dict) for t in found):
            raise self.error(key, f"must be tables [[{key}]], got {got(found)}")
        return found

    def number(self, table: Data, key: str, place: str, default: float | None) -> float:
        """Finite number of an entry; the default where it is missing and there is one."""
        value = table.get(key, default)
        if value is None or not is_number(value):
            raise self.error(place, f"must be a finite number, got {'none' if value is None else got(value)}")
        return float(value)

    def numbers(self, table: Data, key: str, place: str, finite: bool = True) -> list[float]:
        """List of numbers of an entry."""
        value = table.get(key)
        if not isinstance(value, list) or not all(is_number(v, finite) for v in value):
            kind = "finite numbers" if finite else "numbers"
            raise self.error(place, f"must be a list of {kind}, got {'none' if value is None else got(value)}")
        return [float(v) for v in value]

    def choice(self, table: Data, key: str, place: str) -> float | str | list[float]:
        """Option of a plan: a number, "auto", or a list with one entry an axis."""
        if table[key] == "auto":
            return "auto"
        return (self.numbers if isinstance(table[key], list) else partial(self.number, default=None))(table, key, place)


def reference(text: object) -> tuple[str, str] | None:
    """Module and name of "python:module:name"; None for every other value."""
    found = _REFERENCE.fullmatch(text) if isinstance(text, str) else None
    return (found[1], found[2]) if found else None


_REFERENCE = re.compile(r"python:([^:]*):([^:]*)", re.DOTALL)


def named_in_module(text: str, folder: Path) -> object:
    """What a reference "python:module:name" names, in a module next to the study file or an installed one.

    The module runs; whatever it raises reaches the caller.
    """
    found = reference(text)
    if found is None or not all(part.isidentifier() for part in (*found[0].split("."), found[1])):
        raise ValueError("module and what it defines must be names, with dots between packages")
    return getattr(module_of(found[0], folder), found[1])


def module_of(name: str, folder: Path) -> ModuleType:
    """Module next to the study file, never one of the same name from elsewhere; or an installed one."""
    source = folder.joinpath(*name.split(".")).with_suffix(".py")
    spec = importlib.util.spec_from_file_location(name, source) if source.is_file() else None
    if spec is None or spec.loader is None:
        return importlib.import_module(name)
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(folder))  # for what it imports itself
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
    return module


def got(value: object) -> str:
    """A value in a message."""
    try:
        return one_line(repr(value), 300)
    except ValueError:  # of a whole number beyond all that Python prints
        return f"a {type(value).__name__} too long to print"


def one_line(text: str, longest: int = 1500) -> str:
    """Text in one line without control characters, its middle left out where it is long."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    return line if len(line) <= longest else f"{line[: longest - 100]} … {line[-100:]}"


def is_number(value: object, finite: bool = True) -> bool:
    """Whether a TOML value is a number; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value) or not finite
    except OverflowError:  # a whole number beyond all floating-point ones
        return False
