"""Files written whole or not at all, on the ground floor."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Mapping
from pathlib import Path

PathLike = str | os.PathLike[str]


def write_text(path: PathLike, text: str) -> None:
    r"""Write a text file as UTF-8, whole or not at all.

    Parameters
    ----------
    path : str or path
        The file, in a folder that exists.
    text : str
        What it will hold; lines end in ``\n`` on every system.

    Raises
    ------
    OSError
        If it cannot be written: a file of this name is as it was.
    """
    write_all({path: text})


def write_bytes(path: PathLike, data: bytes) -> None:
    """Write a binary file, whole or not at all.

    Parameters
    ----------
    path : str or path
        The file, in a folder that exists.
    data : bytes
        What it will hold.

    Raises
    ------
    OSError
        If it cannot be written: a file of this name is as it was.
    """
    write_all({path: data})


def write_all(contents: Mapping[PathLike, str | bytes]) -> None:
    """Write several files, of which none is replaced before all are on the disk.

    Each is written beside its place, flushed to the disk and then moved there,
    so that neither a full disk nor an interruption leaves a part of a file. A
    symbolic link stays, and what it points to is replaced. What is no regular
    file (a terminal, a pipe) cannot be replaced and is written in place.

    Parameters
    ----------
    contents : mapping of path to str or bytes
        Text is written as UTF-8.

    Raises
    ------
    OSError
        If one cannot be written: files of these names are as they were.
    """
    staged: list[tuple[str, str]] = []
    streams: list[tuple[Path, bytes]] = []
    try:
        for path, content in contents.items():
            place = Path(path)
            data = content.encode() if isinstance(content, str) else content
            mode = _mode(place)
            if mode is not None and not stat.S_ISREG(mode):
                streams.append((place, data))
                continue
            target = os.path.realpath(place)
            staged.append((os.path.join(os.path.dirname(target), f".{secrets.token_hex(8)}.tmp"), target))
            try:
                _stage(*staged[-1], data, mode)
            except OSError as error:  # which may name the file beside, or none
                raise OSError(error.errno, error.strerror, os.fspath(place)) from None
        for place, data in streams:
            place.write_bytes(data)
        while staged:
            os.replace(*staged[0])
            del staged[0]
    finally:
        for beside, _ in staged:
            with contextlib.suppress(OSError):
                os.unlink(beside)


def _mode(place: Path) -> int | None:
    """Kind and permissions of what is there, None where there is nothing."""
    try:
        return place.stat().st_mode
    except FileNotFoundError:
        return None


def _stage(beside: str, target: str, data: bytes, mode: int | None) -> None:
    """Write a new file beside its place, with the permissions that a plain `open` would leave there."""
    if mode is not None and not os.access(target, os.W_OK):
        # Moving a file to this place needs no permission to write to the one there, but `open` does.
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), target)
    # The system applies the umask, which cannot be read without being changed.
    handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
    with os.fdopen(handle, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(handle)
    if mode is not None:
        os.chmod(beside, stat.S_IMODE(mode))
