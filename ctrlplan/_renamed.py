"""Old names that still work for one release, with a warning at the caller's line."""

from __future__ import annotations

import sys
import warnings
from typing import Any


def warn_renamed(old: str, new: str) -> None:
    """Warn that an old name is used, at the first line outside the package.

    Parameters
    ----------
    old, new : str
        What was written and what to write, as in the caller's code:
        ``"quantities="``, ``"system="``.

    Warns
    -----
    FutureWarning
        Always: unlike a DeprecationWarning it is shown to everyone who runs
        the code, as python-control does it.
    """
    warnings.warn(
        f"{old} is deprecated and will be removed in the next release; use {new}",
        FutureWarning,
        stacklevel=outside_stacklevel(),
    )


def renamed_argument(old: str, old_value: Any, new: str, new_value: Any) -> Any:
    """Value of a keyword argument that may be given under its old name.

    Parameters
    ----------
    old, new : str
        The names, without the equals sign.
    old_value, new_value : object
        What was given under each; None where nothing was.

    Raises
    ------
    TypeError
        If both were given.

    Warns
    -----
    FutureWarning
        If the old name was used.
    """
    if old_value is None:
        return new_value
    if new_value is not None:
        raise TypeError(f"{old}= is the old name of {new}=: only one of them may be given, got both")
    warn_renamed(f"{old}=", f"{new}=")
    return old_value


def outside_stacklevel() -> int:
    """`stacklevel` for a warning of the caller that names the first line outside the package."""
    package, level = __name__.partition(".")[0], 1
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, level = frame.f_back, level + 1
    return level
