"""Atomic writing of files."""

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
    r"""Write a text file as UTF-8, atomically.

    Parameters
    ----------
    path : str or path
        The file, in an existing folder.
    text : str
        Contents; lines end in ``\n`` on every system.

    Raises
    ------
    OSError
        If it cannot be written; an existing file is then unchanged.
    """
    write_all({path: text})


def write_bytes(path: PathLike, data: bytes) -> None:
    """Write a binary file, atomically.

    Parameters
    ----------
    path : str or path
        The file, in an existing folder.
    data : bytes
        Contents.

    Raises
    ------
    OSError
        If it cannot be written; an existing file is then unchanged.
    """
    write_all({path: data})


def write_all(contents: Mapping[PathLike, str | bytes]) -> None:
    """Write several files; none is replaced before all are on the disk.

    Each is written to a temporary file in the same folder, flushed to the disk and
    then renamed, so that neither a full disk nor an interruption leaves a partial
    file. The target of a symbolic link is replaced. A special file (a terminal, a
    pipe) cannot be replaced and is written to directly.

    Parameters
    ----------
    contents : mapping of path to str or bytes
        Contents by path; text is written as UTF-8.

    Raises
    ------
    OSError
        If one cannot be written; existing files are then unchanged.
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
            except OSError as error:  # names the temporary file, or none
                raise OSError(error.errno, error.strerror, os.fspath(place)) from None
        for place, data in streams:
            place.write_bytes(data)
        while staged:
            os.replace(*staged[0])
            del staged[0]
    finally:
        for temporary, _ in staged:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


def _mode(place: Path) -> int | None:
    """Type and permissions of an existing file, otherwise None."""
    try:
        return place.stat().st_mode
    except FileNotFoundError:
        return None


def _stage(temporary: str, target: str, data: bytes, mode: int | None) -> None:
    """Write a temporary file with the permissions of a file written by `open`."""
    if mode is not None and not os.access(target, os.W_OK):
        # A file can be replaced without permission to write to it, but not opened.
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), target)
    # The system applies the umask, which cannot be read without a change.
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
    with os.fdopen(handle, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(handle)
    if mode is not None:
        os.chmod(temporary, stat.S_IMODE(mode))
