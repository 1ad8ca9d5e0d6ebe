"""Time limit of a run, checked between evaluations of its right-hand side."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_LIMIT: ContextVar[tuple[float, float] | None] = ContextVar("limit", default=None)
"""Deadline on the monotonic clock and the limit [s], of the present thread or task."""


class TimeLimitError(RuntimeError):
    """A run did not end within its time limit."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Context with a time limit for each run.

    `check` raises once the limit is exceeded. The time is counted from entry,
    and again from each call of `begin_run`.

    Parameters
    ----------
    seconds : float or None
        Wall-clock time for a run [s]; None: the limit of the enclosing context
        stays in force.

    Notes
    -----
    The limit applies to the thread that entered the context. Nothing is
    interrupted: code that never calls `check` is not stopped.
    """
    if seconds is None:
        yield
        return
    token = _LIMIT.set((time.monotonic() + seconds, seconds))
    try:
        yield
    finally:
        _LIMIT.reset(token)


def begin_run() -> None:
    """Restart the time limit of the present context, at the start of a run."""
    limit = _LIMIT.get()
    if limit is not None:
        _LIMIT.set((time.monotonic() + limit[1], limit[1]))


def check(t: float | None = None) -> None:
    """Raise if the time limit of the present context is exceeded.

    Parameters
    ----------
    t : float, optional
        Time reached by the simulation [s], for the message.

    Raises
    ------
    TimeLimitError
        If the limit is exceeded.
    """
    limit = _LIMIT.get()
    if limit is not None and time.monotonic() > limit[0]:
        reached = ", got a longer one" if t is None else f", got to t = {t:g} s in that time"
        raise TimeLimitError(f"a run must end within timeout = {limit[1]:g} s{reached}")
