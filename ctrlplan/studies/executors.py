"""Executors: what they have in common, how many workers they have, and when their tasks are done."""

from __future__ import annotations

import inspect
import pickle
from asyncio import CancelledError
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Generic, Protocol, TypeVar

from ctrlplan.studies.interruption import holding_back, raise_if_pressed
from ctrlplan.studies.outcomes import Failed

T = TypeVar("T")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)

_POLL = 0.02
"""Polling interval of futures without callbacks [s]."""

_POLL_WITH_CALLBACKS = 0.5
"""Polling interval of futures with callbacks [s]; a callback may not arrive if a connection fails."""

CANNOT_BE_SENT = (pickle.PicklingError, TypeError, AttributeError, ImportError)
"""Exceptions of an executor that cannot send a task, or of a worker that cannot read it."""


class Future(Protocol[R_co]):
    """Pending result of a call; further methods of a future are used if present."""

    def result(self) -> R_co:
        """Return the result of the call, or raise its exception."""


class Executor(Protocol):
    """Object that runs tasks, such as `concurrent.futures.Executor`."""

    def submit(self, function: Callable[[T], R], argument: T, /) -> Future[R]:
        """Submit a call and return its future."""


def checked_executor(executor: Executor | None) -> Executor | None:
    """Executor, or None for this process.

    Raises
    ------
    TypeError
        If it has no method ``submit``.
    """
    if executor is None or (callable(getattr(executor, "submit", None)) and not isinstance(executor, type)):
        return executor
    kind = f"{type(executor).__module__}.{type(executor).__qualname__}"
    if hasattr(executor, "apply_async"):
        raise TypeError(
            f"executor must have submit, got {kind}, which does not report a worker that dies; "
            "use concurrent.futures.ProcessPoolExecutor or ThreadPoolExecutor"
        )
    given = f"the class {executor.__qualname__} itself" if isinstance(executor, type) else f"{executor!r:.80}"
    raise TypeError(f"executor must be an object with submit, as those of concurrent.futures, got {given}")


def worker_count(executor: Executor) -> int | None:
    """Number of tasks that an executor runs at the same time; None if it is not known."""
    for name in ("_max_workers", "num_workers"):
        count = getattr(executor, name, None)
        if isinstance(count, int) and count > 0:
            return count
    # Of a Client of dask.distributed, or of the executor that it returns.
    threads = getattr(getattr(executor, "_client", executor), "nthreads", None)
    if callable(threads):
        with suppress(Exception):  # of a cluster that is not there; submit will say so
            found = threads()
            if isinstance(found, Mapping):
                return sum(found.values()) or None
    return None


def new_pool(broken: Executor) -> Executor | None:
    """Process pool of the same kind, size and start method; None if the executor is no process pool.

    Of `concurrent.futures` or loky, which keep the arguments of a pool under their names.
    """
    kind = next((kind for kind in type(broken).__mro__ if kind.__name__ == "ProcessPoolExecutor"), None)
    if kind is None:
        return None
    names = [name for name in inspect.signature(kind).parameters if hasattr(broken, f"_{name}")]
    found: Executor = kind(**{name: getattr(broken, f"_{name}") for name in names})
    return found


def is_broken(error: Exception) -> bool:
    """Whether an exception says that an executor takes no more tasks."""
    return isinstance(error, BrokenExecutor)


class Futures(Generic[R]):
    """Futures by number, taken as they complete.

    In order of completion where they have ``add_done_callback`` or ``done``, and
    in the order of submission where they have ``result`` alone.
    """

    def __init__(self) -> None:
        self._futures: dict[int, Future[R]] = {}
        self._watched: set[int] = set()
        self._done: SimpleQueue[int] = SimpleQueue()

    def __len__(self) -> int:
        return len(self._futures)

    def add(self, number: int, future: Future[R]) -> None:
        """Add a future."""
        self._futures[number] = future

    def next(self) -> tuple[int, R | Failed]:
        """Wait for a future, and return its number with its result or the failure of the executor."""
        number = self._wait()
        future = self._futures[number]
        with holding_back(number in self._watched or _is_done(future)):
            found = _outcome(future)
        self._drop(number)  # so that its result can be freed
        return number, found

    def finished(self) -> dict[int, R]:
        """Results of finished futures after an interruption; the others are cancelled and dropped."""
        done = {number: future for number, future in self._futures.items() if _is_done(future)}
        for number in [number for number in self._futures if number not in done]:
            _cancel(self._futures[number])
            self._drop(number)
        found = {}
        for number, future in done.items():
            with suppress(Exception, CancelledError):  # these are not failures of tasks
                if hasattr(future, "exception") and future.exception() is None:
                    found[number] = future.result()
            self._drop(number)
        return found

    def cancel(self) -> None:
        """Cancel all futures that are not done, and drop all."""
        for future in list(self._futures.values()):
            _cancel(future)
        self._futures.clear()
        self._watched.clear()

    def _wait(self) -> int:
        for number, future in self._futures.items():
            if number not in self._watched and hasattr(future, "add_done_callback"):
                self._watched.add(number)
                future.add_done_callback(lambda _, number=number: self._done.put(number))
        if not any(hasattr(future, "done") or number in self._watched for number, future in self._futures.items()):
            return next(iter(self._futures))
        while True:
            raise_if_pressed()
            told = len(self._watched) == len(self._futures)
            found = None if told else self._first_done()
            if found is None:
                try:
                    found = self._done.get(timeout=_POLL_WITH_CALLBACKS if told else _POLL)
                except Empty:
                    found = self._first_done()
            if found is not None and found in self._futures:
                raise_if_pressed()
                return found

    def _first_done(self) -> int | None:
        return next((number for number, future in self._futures.items() if _is_done(future)), None)

    def _drop(self, number: int) -> None:
        del self._futures[number]
        self._watched.discard(number)


def _outcome(future: Future[R]) -> R | Failed:
    """Result of a future, or the failure of the executor."""
    try:
        return future.result()
    except (Exception, SystemExit, CancelledError) as error:  # a worker died, or the result cannot be read
        raise_if_pressed()  # which the workers receive as well
        return Failed.of(error.with_traceback(None), by_executor=True)  # a traceback would keep the future alive


def _cancel(future: Future[object]) -> None:
    if not _is_done(future) and hasattr(future, "cancel"):
        with suppress(Exception):  # the other tasks must still be cancelled
            future.cancel()


def _is_done(future: Future[object]) -> bool:
    return bool(future.done()) if hasattr(future, "done") else False
