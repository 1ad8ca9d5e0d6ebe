"""Time limit of a run, checked between evaluations of its right-hand side."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_LIMIT: ContextVar[tuple[float, float] | None] = ContextVar("limit", default=None)
"""Deadline on the monotonic clock, and the seconds that were allowed; of this thread or task alone."""


class TimeLimitError(RuntimeError):
    """A run did not end within its time limit."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Context in which `check` raises once a run has taken some time.

    The time counts from here, and again from each call of `begin_run`.

    Parameters
    ----------
    seconds : float or None
        Time allowed for a run [s], by the computer's clock; None for what
        holds outside.

    Notes
    -----
    The limit holds in the thread that entered the context; others have their
    own. Nothing is interrupted: code that never calls `check` is not stopped.
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
    """Allow a run that begins the whole time, whatever the one before it took."""
    limit = _LIMIT.get()
    if limit is not None:
        _LIMIT.set((time.monotonic() + limit[1], limit[1]))


def check(t: float | None = None) -> None:
    """Raise where the time limit of the present context is over.

    Parameters
    ----------
    t : float, optional
        Time that the simulation has reached [s], for the message.

    Raises
    ------
    TimeLimitError
        If the limit is over.
    """
    limit = _LIMIT.get()
    if limit is not None and time.monotonic() > limit[0]:
        reached = "" if t is None else f" at t = {t:g} s"
        raise TimeLimitError(f"a run must end within timeout = {limit[1]:g} s, got no further{reached}")
