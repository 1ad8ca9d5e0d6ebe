"""Execution of many runs, in this process or on an executor: progress, interruption, failures."""

from __future__ import annotations

import math
import pickle
import signal
import threading
from asyncio import CancelledError
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from numbers import Real
from queue import Empty, SimpleQueue
from types import FrameType
from typing import Any, Generic, Protocol, TypeVar
from uuid import uuid4

from ctrlplan._lru import Lru
from ctrlplan.simulation.budget import time_limit
from ctrlplan.studies.progress import bar

T = TypeVar("T")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)

_POLL = 0.02
"""Polling interval of futures without callbacks [s]."""

_POLL_WITH_CALLBACKS = 0.5
"""Polling interval of futures with callbacks [s]; a callback may not arrive if a connection fails."""

_CACHED = 2
"""Number of shared values that a thread caches."""


class Future(Protocol[R_co]):
    """Pending result of a call; further methods of a future are used if present."""

    def result(self) -> R_co:
        """Return the result of the call, or raise its exception."""


class Executor(Protocol):
    """Object that runs tasks, such as `concurrent.futures.Executor`."""

    def submit(self, function: Callable[[T], R], argument: T, /) -> Future[R]:
        """Submit a call and return its future."""


@dataclass(frozen=True)
class Failed:
    """Failure of a task.

    Attributes
    ----------
    message : str
        Message of the exception, with its type.
    error : Exception
        The exception. From another process, a RuntimeError in place of one
        that cannot be pickled.
    by_executor : bool
        Whether the executor raised it; the task may not have run at all.
    """

    message: str
    error: Exception
    by_executor: bool = False

    @classmethod
    def of(cls, error: BaseException, by_executor: bool = False) -> Failed:
        """Failure with an exception; SystemExit becomes a RuntimeError."""
        message = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        return cls(message, error if isinstance(error, Exception) else RuntimeError(message), by_executor)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle without an exception that cannot be pickled, which would break a whole pool."""
        error = self.error
        try:
            picklable = type(pickle.loads(pickle.dumps(error))) is type(error)  # noqa: S301 (pickled here)
        except Exception:  # of the constructor of an exception
            picklable = False
        return Failed, (self.message, error if picklable else RuntimeError(self.message), self.by_executor)


@dataclass
class Account(Generic[R]):
    """Results and failures by the number of the task.

    Attributes
    ----------
    found : dict of int to result or Failed
        In the order of completion.
    interrupted : bool
        Whether Ctrl-C ended the execution; tasks that did not run are missing.
    """

    found: dict[int, R | Failed] = field(default_factory=dict)
    interrupted: bool = False

    def in_order(self) -> dict[int, R | Failed]:
        """Results and failures, in the order of the tasks."""
        return dict(sorted(self.found.items()))

    def raise_if_none_ran(self, what: str) -> None:
        """Raise the exception of the executor if it ran no task.

        Parameters
        ----------
        what : str
            What was sent to the executor, for the message.

        Raises
        ------
        ValueError
            If it cannot be sent to other processes.
        Exception
            Any other exception of the executor.
        """
        errors = [found.error for found in self.found.values() if isinstance(found, Failed) and found.by_executor]
        if self.interrupted or not errors or len(errors) < len(self.found):
            return
        if isinstance(errors[0], pickle.PicklingError | TypeError | AttributeError):
            raise ValueError(
                f"{what} must be picklable for other processes, got {errors[0]}; give a function that builds it at "
                "the top level of a module, or an executor that pickles any function (dask, loky) or uses threads"
            ) from errors[0]
        raise errors[0]


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


def checked_timeout(timeout: object) -> float | None:
    """Time limit of a run [s], or None.

    Raises
    ------
    ValueError
        If it is not a finite number above 0.
    """
    if timeout is None:
        return None
    if isinstance(timeout, bool) or not isinstance(timeout, Real) or not 0.0 < float(timeout) < math.inf:
        raise ValueError(f"timeout must be a finite number of seconds above 0, or None, got {timeout!r}")
    return float(timeout)


def tried(run: Callable[[T], R], task: T, timeout: float | None = None) -> R | Failed:
    """Result of a task, or its failure; only KeyboardInterrupt is raised."""
    _raise_if_pressed()
    outcome: R | Failed
    try:
        with time_limit(timeout):
            outcome = run(task)
    except (Exception, SystemExit) as error:  # of a user's function
        outcome = Failed.of(error)
    _raise_if_pressed()  # a solver or a block may have caught the KeyboardInterrupt
    return outcome


def gathered(
    outcomes: Generator[tuple[int, R | Failed], None, None], count: int, label: str, progress: bool
) -> Account[R]:
    """Outcomes of tasks in this process, until the last or until Ctrl-C.

    Parameters
    ----------
    outcomes : generator of (int, result or Failed)
        Runs the tasks, and yields the number and outcome of each. After an
        interruption it may yield further finished outcomes.
    count : int
        Number of tasks.
    label : str
        Label of the progress bar.
    progress : bool
        Whether a progress bar is shown on stderr.
    """
    account: Account[R] = Account()
    with _counting_interruptions() as pressed, bar(count, label, progress) as advance:
        try:
            for k, outcome in outcomes:
                account.found[k] = outcome
                advance()
        except KeyboardInterrupt:
            account.interrupted = True
            account.found |= dict(_ready(outcomes))
            if len(pressed) > 1:
                raise
    return account


def _ready(outcomes: Generator[tuple[int, R], None, None]) -> Iterator[tuple[int, R]]:
    """Outcomes that a generator yields after an interruption."""
    try:
        yield outcomes.throw(KeyboardInterrupt)
        yield from outcomes
    except (KeyboardInterrupt, StopIteration):
        return


def executed(
    run: Callable[[T], R],
    tasks: Sequence[T],
    executor: Executor | None,
    timeout: float | None,
    label: str,
    progress: bool,
) -> Account[R]:
    """Outcomes of tasks, taken as they complete, until the last or until Ctrl-C.

    Parameters
    ----------
    run : callable
        Maps a task to its result.
    tasks : sequence
        Arguments of `run`.
    executor : object with ``submit``, or None
        Where the tasks run; None for this process.
    timeout : float or None
        Time limit of a run [s].
    label : str
        Label of the progress bar.
    progress : bool
        Whether a progress bar is shown on stderr.

    Notes
    -----
    Futures are taken as they complete where they have ``add_done_callback`` or
    ``done``, and in the order of submission where they have ``result`` alone.
    Tasks that an executor does not finish are not run again. On Ctrl-C, and
    whenever this function raises, tasks that have not begun are cancelled; the
    executor finishes the others.
    """
    if executor is None:
        here = ((k, tried(run, task, timeout)) for k, task in enumerate(tasks))
        return gathered(here, len(tasks), label, progress)
    account: Account[R] = Account()
    futures: dict[int, Future[R | Failed]] = {}
    try:
        with _counting_interruptions() as pressed, bar(len(tasks), label, progress) as advance:
            try:
                rejected = _submit(partial(tried, run, timeout=timeout), tasks, executor, futures)
                for k, outcome in _completed(futures):
                    account.found[k] = outcome
                    advance()
                account.found |= rejected
            except KeyboardInterrupt:
                if len(pressed) > 1:
                    raise
                account.interrupted = True
        if account.interrupted:
            done = {k: future for k, future in futures.items() if _is_done(future)}
            _cancel({k: future for k, future in futures.items() if k not in done})
            account.found |= _results({k: future for k, future in done.items() if k not in account.found})
    finally:
        _cancel(futures)
        futures.clear()  # an executor keeps results that are still referenced
    return account


class Shared(Generic[T]):
    """Value shared by many tasks, unpickled once per thread.

    Parameters
    ----------
    value : object
        Pickled once if possible; otherwise by the executor for each task.
    """

    def __init__(self, value: T) -> None:
        self._value, self._key = value, uuid4().hex
        try:
            data = pickle.dumps(value)
        except Exception:  # of a user's object; the executor may be able to pickle it
            data = b""
        # pickle refers to objects of __main__ by name, which another process may not have.
        self._data = b"" if b"__main__" in data else data

    def __reduce__(self) -> tuple[object, ...]:
        return _received, (self._key, self._data, None if self._data else self._value)

    def made(self, make: Callable[[T], R]) -> R:
        """Result of `make` for the value, cached per thread."""
        return _cache().get(self._key, lambda: make(self._own()))

    def _own(self) -> T:
        return pickle.loads(self._data) if self._data else self._value  # noqa: S301 (pickled here)


def _received(key: str, data: bytes, value: T) -> Shared[T]:
    shared: Shared[T] = object.__new__(Shared)
    shared._key, shared._data, shared._value = key, data, value
    return shared


_HERE = threading.local()


def _cache() -> Lru[str, Any]:
    """Cache of this thread."""
    if not hasattr(_HERE, "cache"):
        _HERE.cache = Lru(_CACHED)
    cache: Lru[str, Any] = _HERE.cache
    return cache


_PRESSED: ContextVar[Sequence[int]] = ContextVar("pressed", default=())
"""Signals of Ctrl-C since the runs began."""


@contextmanager
def _counting_interruptions() -> Iterator[Sequence[int]]:
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
        signal.default_int_handler(number, frame)

    token = _PRESSED.set(pressed)
    signal.signal(signal.SIGINT, record)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _PRESSED.reset(token)


def _raise_if_pressed() -> None:
    if _PRESSED.get():
        raise KeyboardInterrupt


def _submit(
    run: Callable[[T], R], tasks: Sequence[T], executor: Executor, futures: dict[int, Future[R]]
) -> dict[int, Failed]:
    """Submit all tasks; return those that the executor rejects, with the reason."""
    for k, task in enumerate(tasks):
        try:
            futures[k] = executor.submit(run, task)
        except (Exception, SystemExit) as error:  # of the executor: it is broken, or cannot send the task
            return dict.fromkeys(range(k, len(tasks)), Failed.of(error, by_executor=True))
    return {}


def _completed(futures: dict[int, Future[R]]) -> Iterator[tuple[int, R | Failed]]:
    """Outcomes as they complete; each future is then released, so that its result can be freed."""
    done: SimpleQueue[int] = SimpleQueue()
    notifies = all(hasattr(future, "add_done_callback") for future in futures.values())
    if not notifies and not all(hasattr(future, "done") for future in futures.values()):
        for k in list(futures):
            yield k, _outcome(futures[k])
            del futures[k]
        return
    for k, future in futures.items():
        if notifies and hasattr(future, "add_done_callback"):
            future.add_done_callback(lambda _, k=k: done.put(k))
    while futures:
        try:
            ready = [done.get(timeout=_POLL_WITH_CALLBACKS if notifies else _POLL)]
        except Empty:
            ready = [k for k, future in futures.items() if _is_done(future)]
        _raise_if_pressed()
        for k in ready:
            if k in futures:
                yield k, _outcome(futures[k])
                del futures[k]


def _outcome(future: Future[R]) -> R | Failed:
    """Result of a future, or the failure of the executor."""
    try:
        return future.result()
    except (Exception, SystemExit, CancelledError) as error:  # a worker died, or the result cannot be read
        _raise_if_pressed()  # which the workers receive as well
        return Failed.of(error.with_traceback(None), by_executor=True)  # a traceback would keep the future alive


def _results(futures: dict[int, Future[R]]) -> dict[int, R]:
    """Results of finished futures; exceptions after an interruption are not failures of tasks."""
    found = {}
    for k, future in futures.items():
        with suppress(Exception, CancelledError):
            if hasattr(future, "exception") and future.exception() is None:
                found[k] = future.result()
    return found


def _cancel(futures: Mapping[int, Future[object]]) -> None:
    for future in futures.values():
        if not _is_done(future) and hasattr(future, "cancel"):
            with suppress(Exception):  # the other tasks must still be cancelled
                future.cancel()


def _is_done(future: Future[object]) -> bool:
    return bool(future.done()) if hasattr(future, "done") else False
