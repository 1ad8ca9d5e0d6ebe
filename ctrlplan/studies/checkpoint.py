"""Checkpoints: finished outcomes of many runs in the files of a folder."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from uuid import uuid4

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._display import counted
from ctrlplan._files import write_bytes, write_text
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array
from ctrlplan.studies.outcomes import Failed

_STUDY, _OUTCOMES = "study.json", "outcomes-*.npz"
_SECONDS = 10.0
"""Time [s] after which finished outcomes are written, even if they are few."""

_ROUNDING = 1e-6
"""Relative difference of numbers that identify the same study on different machines."""

Keep: TypeAlias = Callable[[int, Any], None]
"""Receives the number and outcome of a value."""


@dataclass(frozen=True)
class Checkpoint:
    """Folder with the outcomes of the values of a study.

    ``study.json`` identifies the study; each other file has outcomes of some
    values. Files are written whole: a file that is there is complete. Failures are
    not stored.

    Attributes
    ----------
    folder : Path
        The folder.
    """

    folder: Path

    @classmethod
    def opened(cls, folder: str | os.PathLike[str], study: Mapping[str, object]) -> Checkpoint:
        """Checkpoint of a study in a folder, which is made if it does not exist.

        Raises
        ------
        ValueError
            If the path is an empty text, or the folder has the checkpoint of another
            study, or outcomes without the file that identifies theirs.
        OSError
            If it is a file, or the folder cannot be made or written to.
        """
        if folder == "":  # as of a variable that is not set; Path("") is the current folder
            raise ValueError('checkpoint must be a folder, got an empty text; give "." for the current folder')
        path = Path(folder)
        if path.exists() and not path.is_dir():
            raise FileExistsError(f"checkpoint must be a folder, got {path}, which is a file; give another path")
        known = path / _STUDY
        with _used(path):
            path.mkdir(parents=True, exist_ok=True)
            text = known.read_text(encoding="utf-8") if known.exists() else None
            unknown = text is None and any(path.glob(_OUTCOMES))
            if text is None and not unknown:
                write_text(known, json.dumps(study, indent=1))
        if unknown:
            raise ValueError(
                f"checkpoint must have the file {_STUDY} that identifies its study, got outcomes without it in {path}; "
                "give a new folder, or delete this one"
            )
        if text is not None:
            found = _json(known, text)
            differ = [name for name in dict.fromkeys((*study, *found)) if not _same(study.get(name), found.get(name))]
            if differ:
                raise ValueError(
                    f"checkpoint must be a folder of the same study, got {path}, which has another in "
                    f"{', '.join(differ)}; give a new folder, or delete this one"
                )
        return cls(path)

    def check_writable(self) -> None:
        """Raise an OSError if no file can be made in the folder."""
        with _used(self.folder), tempfile.TemporaryFile(dir=self.folder):
            pass

    def read(self) -> Iterator[tuple[int, Any]]:
        """Number and outcome of each value that is stored.

        Raises
        ------
        ValueError
            If a file is damaged.
        """
        seen: set[int] = set()
        for path in sorted(self.folder.glob(_OUTCOMES)):
            try:
                with np.load(io.BytesIO(path.read_bytes())) as file:
                    found, data = json.loads(file["outcomes"].tobytes()), file["data"]
                    stored, names = found["outcomes"], found["names"]
            except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
                raise ValueError(f"checkpoint must have complete files, got {path}: {error}; delete it") from error
            for number, outcome in stored:
                if number not in seen:
                    seen.add(number)
                    yield number, _restored(outcome, names, data)

    def keeping(self, size: int) -> Keeping:
        """Context with a function that stores outcomes, in files of a number of values or of ten seconds."""
        return Keeping(self, size)

    def write(self, outcomes: Mapping[int, Any]) -> None:
        """Write outcomes by number to a new file."""
        arrays = _Arrays()
        stored = [(number, _plain(outcome, arrays)) for number, outcome in outcomes.items()]
        # As bytes: a text of numpy has four of them for each character.
        text = json.dumps({"names": list(arrays.names), "outcomes": stored}).encode()
        file = io.BytesIO()
        np.savez(file, outcomes=np.frombuffer(text, np.uint8), data=np.concatenate([np.empty(0), *arrays.pieces]))
        write_bytes(self.folder / f"outcomes-{min(outcomes):08d}-{uuid4().hex}.npz", file.getvalue())


class Keeping:
    """Context whose value is a function that stores outcomes.

    Outcomes that cannot be written, as on a full disk, remain in memory, with a
    warning, and are written later if that becomes possible.

    Parameters
    ----------
    checkpoint : Checkpoint
        Where they are stored.
    size : int
        Number of values of a file, unless ten seconds have passed.
    """

    def __init__(self, checkpoint: Checkpoint, size: int) -> None:
        self._checkpoint, self._size = checkpoint, size
        self._kept: dict[int, Any] = {}
        self._since = time.monotonic()
        self._refused = False

    def __enter__(self) -> Keep:
        return self._keep

    def __exit__(self, *_: object) -> None:
        if self._kept and (error := self._write()) is not None:
            self._warn(error, "are not stored; they are run again by a second call")

    def _keep(self, number: int, outcome: Any) -> None:
        if _has_failed(outcome):
            return
        self._kept[number] = outcome
        late = time.monotonic() - self._since > _SECONDS
        if late or (len(self._kept) >= self._size and not self._refused):
            known, error = self._refused, self._write()
            if error is not None and not known:
                self._warn(error, "so far are kept in memory; the runs go on, and writing is tried again")

    def _write(self) -> OSError | None:
        """Write what has not been written; return the error if that fails."""
        self._since = time.monotonic()
        try:
            self._checkpoint.write(self._kept)
        except OSError as error:
            self._refused = True
            return error
        self._kept.clear()
        self._refused = False
        return None

    def _warn(self, error: OSError, rest: str) -> None:
        values, why = counted(len(self._kept), "finished value"), error.strerror or error
        text = f"checkpoint {self._checkpoint.folder} cannot be written ({why}): {values} {rest}"
        warnings.warn(text, UserWarning, stacklevel=outside_stacklevel())


@contextmanager
def _used(folder: Path) -> Iterator[None]:
    """Context in which an error of the file system names the argument and what to do."""
    try:
        yield
    except OSError as error:
        why = error.strerror or str(error)
        clear = type(error)(
            f"checkpoint must be a folder that can be made, read and written to, got {folder}: {why}; give another path"
        )
        clear.errno = error.errno
        raise clear from error


def digest(values: ArrayLike) -> str:
    """Shape and hash of an array, which identify its values."""
    array = np.ascontiguousarray(values, dtype=float)
    return f"{array.shape} {hashlib.sha256(array.tobytes()).hexdigest()[:16]}"


def _has_failed(outcome: Any) -> bool:
    """Whether a value, or one of its plans, has failed."""
    return isinstance(outcome, Failed) or any(isinstance(one, Failed) for one in outcome.values())


class _Arrays:
    """Arrays that are stored as one, and the names of their elements."""

    def __init__(self) -> None:
        self.pieces: list[Array] = []
        self.names: dict[tuple[str, ...], int] = {}
        self._size = 0

    def add(self, array: Array) -> list[int]:
        """First and last index of an array in all."""
        self.pieces.append(array)
        begin, self._size = self._size, self._size + array.size
        return [begin, self._size]

    def add_numbers(self, numbers: Mapping[str, float]) -> list[int]:
        """Index of the names of some numbers, and first and last index of their values."""
        return [self.names.setdefault(tuple(numbers), len(self.names)), *self.add(np.array(list(numbers.values())))]


def _plain(value: Any, arrays: _Arrays) -> object:
    """Value for JSON, in which arrays, of one axis, and named numbers are slices of one array."""
    if isinstance(value, Mapping):
        if value and all(type(one) is float for one in value.values()):
            return {"numbers": arrays.add_numbers(value)}
        return {"of": {name: _plain(one, arrays) for name, one in value.items()}}
    if isinstance(value, tuple):
        return [_plain(one, arrays) for one in value]
    return {"array": arrays.add(value)} if isinstance(value, np.ndarray) else value


def _restored(value: Any, names: list[list[str]], data: Array) -> Any:
    """Value of `_plain`."""
    if isinstance(value, list):
        return tuple(_restored(one, names, data) for one in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return data[slice(*value["array"])].copy()
    if "numbers" in value:
        which, begin, end = value["numbers"]
        return dict(zip(names[which], data[begin:end].tolist(), strict=True))
    return {name: _restored(one, names, data) for name, one in value["of"].items()}


def _same(own: object, other: object) -> bool:
    """Whether two values are equal, numbers to rounding errors."""
    if isinstance(own, Mapping) and isinstance(other, Mapping):
        return own.keys() == other.keys() and all(_same(one, other[name]) for name, one in own.items())
    if isinstance(own, float) and isinstance(other, float):
        return math.isclose(own, other, rel_tol=_ROUNDING, abs_tol=1e-9) or (math.isnan(own) and math.isnan(other))
    return own == other


def _json(path: Path, text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise ValueError(
            f"checkpoint must have a complete {path.name}, got {path}: {error}; delete the folder"
        ) from error
    return dict(found)
