"""Ctrl-C while many runs are executed."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

_PRESSED: ContextVar[Sequence[int]] = ContextVar("pressed", default=())
"""Signals of Ctrl-C since the runs began."""

_HELD_BACK: ContextVar[bool] = ContextVar("held_back", default=False)
"""Whether a first Ctrl-C is recorded only."""


@contextmanager
def counting_interruptions() -> Iterator[Sequence[int]]:
    """Context that records Ctrl-C, since a KeyboardInterrupt raised in a callback may be swallowed.

    Like `asyncio.run`: in the main thread only, and only with the default handler.
    """
    pressed: list[int] = []
    here = threading.current_thread() is threading.main_thread()
    if not here or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield pressed
        return

    def record(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        if len(pressed) > 1 or not _HELD_BACK.get():
            signal.default_int_handler(number, frame)

    token = _PRESSED.set(pressed)
    signal.signal(signal.SIGINT, record)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _PRESSED.reset(token)


@contextmanager
def holding_back(held: bool = True) -> Iterator[None]:
    """Context in which a first Ctrl-C raises at the end; a second one raises within.

    For short calls of an executor that an exception in between would leave half
    done: a client of dask, for example, then receives no further result.
    ``held=False`` is for runs within such a call, if the executor runs its tasks in
    this thread.
    """
    before = len(_PRESSED.get())
    token = _HELD_BACK.set(held)
    try:
        yield
    except Exception as error:
        if len(_PRESSED.get()) > before:
            raise KeyboardInterrupt from error
        raise
    finally:
        _HELD_BACK.reset(token)
    if len(_PRESSED.get()) > before:
        raise KeyboardInterrupt


def raise_if_pressed() -> None:
    """Raise KeyboardInterrupt if there was a signal since the runs began."""
    if _PRESSED.get():
        raise KeyboardInterrupt
