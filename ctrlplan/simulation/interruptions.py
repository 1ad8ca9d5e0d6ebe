"""Exceptions of signal handlers, as on Ctrl-C, while CVODES runs."""

from __future__ import annotations

import signal
import threading

# The function of the module `signal` converts to members of an enumeration, which takes forty times as long.
from _signal import getsignal  # type: ignore[import-not-found]
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

_RAISED: ContextVar[list[BaseException] | None] = ContextVar("raised", default=None)
"""Exceptions that handlers have raised in the outermost context of this thread; None outside of it."""

_SIGNALS = tuple(map(int, signal.valid_signals()))
"""Numbers of the signals that can have handlers."""


@contextmanager
def passing_interruptions() -> Iterator[None]:
    """Propagate exceptions of signal handlers to the caller, as on Ctrl-C.

    CVODES treats an exception that a handler raises during a run as a failure of
    the equations; one raised while a solver is constructed becomes a SystemError.
    Handlers run in the main thread only; there they are wrapped and afterwards
    restored, by the outermost of nested contexts.
    """
    raised = _RAISED.get()
    if raised is None:
        with _wrapped_handlers():
            yield
        return
    try:
        yield
    except (RuntimeError, SystemError):
        if raised:
            raise raised[0] from None
        raise
    if raised:
        raise raised[0]


@contextmanager
def _wrapped_handlers() -> Iterator[None]:
    raised: list[BaseException] = []
    handlers: dict[int, Callable[[int, FrameType | None], object]] = {}
    inside = False  # while handlers are exchanged, their exceptions are deferred

    def accompanied(number: int, frame: FrameType | None) -> None:
        try:
            handlers[number](number, frame)
        except BaseException as error:
            raised.append(error)
            if inside:
                raise

    token = _RAISED.set(raised)
    try:
        for number in _SIGNALS if threading.current_thread() is threading.main_thread() else ():
            handler = getsignal(number)
            if callable(handler):
                handlers[number] = handler
                signal.signal(number, accompanied)
        inside = True
        if not raised:
            yield
    except (RuntimeError, SystemError):
        if raised:
            raise raised[0] from None
        raise
    finally:
        inside = False
        _RAISED.reset(token)
        for key, handler in handlers.items():
            if getsignal(key) is accompanied:
                signal.signal(key, handler)
    if raised:
        raise raised[0]
