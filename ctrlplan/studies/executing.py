"""Where many runs are made, here or on an executor: one bar, one interruption, one account of what is lost."""

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

from tqdm import tqdm

from ctrlplan._lru import Lru
from ctrlplan.simulation.budget import time_limit

T = TypeVar("T")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)

_POLL = 0.02
"""Time between two looks at futures without callbacks [s]."""

_POLL_BESIDE_CALLBACKS = 0.5
"""The same where callbacks tell of what is done: they may be lost with a connection."""

_CACHED = 2
"""Shared values that a thread keeps."""


class Future(Protocol[R_co]):
    """Result of a call that is not there yet; what else a future has is used where it is found."""

    def result(self) -> R_co:
        """Result of the call, or what it raised."""


class Executor(Protocol):
    """Where tasks run: `concurrent.futures.Executor` and whatever submits as it does."""

    def submit(self, function: Callable[[T], R], argument: T, /) -> Future[R]:
        """Future of a call."""


@dataclass(frozen=True)
class Failed:
    """Why a task has no result.

    Attributes
    ----------
    message : str
        What was raised, with its type.
    error : Exception
        What to raise where nothing else was found. It comes from another
        process as a RuntimeError where it cannot be pickled.
    lost : bool
        Whether the executor raised it: the task may not have run at all.
    """

    message: str
    error: Exception
    lost: bool = False

    @classmethod
    def of(cls, error: BaseException, lost: bool = False) -> Failed:
        """What was raised; SystemExit, which would end the caller, as a RuntimeError."""
        message = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        return cls(message, error if isinstance(error, Exception) else RuntimeError(message), lost)

    def __reduce__(self) -> tuple[object, ...]:
        """Without an error that cannot be sent: it would bring down a whole pool."""
        error = self.error
        try:
            sound = type(pickle.loads(pickle.dumps(error))) is type(error)  # noqa: S301 (made a moment ago)
        except Exception:  # whatever an exception's own constructor makes of it
            sound = False
        return Failed, (self.message, error if sound else RuntimeError(self.message), self.lost)


@dataclass
class Account(Generic[R]):
    """Results found, and what went wrong, by the number of the task.

    Attributes
    ----------
    found : dict of int to result or Failed
        In the order of completion.
    interrupted : bool
        Whether Ctrl-C ended it; tasks that were not reached are then missing.
    """

    found: dict[int, R | Failed] = field(default_factory=dict)
    interrupted: bool = False

    def in_order(self) -> dict[int, R | Failed]:
        """What was found, in the order of the tasks."""
        return dict(sorted(self.found.items()))

    def raise_if_all_lost(self, what: str) -> None:
        """Raise what the executor says, where it has run nothing.

        Parameters
        ----------
        what : str
            What was sent to it, for the message.

        Raises
        ------
        ValueError
            If that cannot be sent to other processes.
        Exception
            What else the executor raised.
        """
        lost = [found.error for found in self.found.values() if isinstance(found, Failed) and found.lost]
        if self.interrupted or not lost or len(lost) < len(self.found):
            return
        if isinstance(lost[0], pickle.PicklingError | TypeError | AttributeError):
            raise ValueError(
                f"{what} must go to other processes, but {lost[0]}; give a function that builds it at the top level "
                "of a module, or an executor that sends any function (dask, loky) or needs none sent (threads)"
            ) from lost[0]
        raise lost[0]


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
            f"executor must have submit, got {kind}, which never tells of a worker that dies; "
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
    """Result of a task, or what went wrong; Ctrl-C alone is raised."""
    _raise_if_pressed()
    outcome: R | Failed
    try:
        with time_limit(timeout):
            outcome = run(task)
    except (Exception, SystemExit) as error:  # whatever a user's function does
        outcome = Failed.of(error)
    _raise_if_pressed()  # a solver or a block may have taken Ctrl-C for an error of its own, and gone on without
    return outcome


def gathered(
    outcomes: Generator[tuple[int, R | Failed], None, None], count: int, label: str, progress: bool
) -> Account[R]:
    """Outcomes of tasks in this process, until the last or until Ctrl-C.

    Parameters
    ----------
    outcomes : generator of (int, result or Failed)
        Number and outcome of each task; it makes the runs. Interrupted, it may
        yield what is ready.
    count : int
        How many there are.
    label : str
        What the bar is called.
    progress : bool
        Whether a bar is shown on stderr.
    """
    account: Account[R] = Account()
    with _counting_interruptions() as pressed, _bar(count, label, progress) as advance:
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
    """What a generator yields when it is interrupted; nothing if that is what ended it."""
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
        What it is called with.
    executor : object with ``submit``, or None
        Where it runs; None is this process.
    timeout : float or None
        Time limit of a run [s].
    label : str
        What the bar is called.
    progress : bool
        Whether a bar is shown on stderr.

    Notes
    -----
    Futures are taken as they complete where they have ``add_done_callback`` or
    ``done``, and in the order of submission where they have ``result`` alone.
    What an executor loses is not run again. On Ctrl-C, and whenever this
    function raises, tasks that have not begun are cancelled; the others are
    finished by the executor.
    """
    if executor is None:
        here = ((k, tried(run, task, timeout)) for k, task in enumerate(tasks))
        return gathered(here, len(tasks), label, progress)
    account: Account[R] = Account()
    futures: dict[int, Future[R | Failed]] = {}
    try:
        with _counting_interruptions() as pressed, _bar(len(tasks), label, progress) as advance:
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
        futures.clear()  # an executor keeps what somebody may still ask for
    return account


class Shared(Generic[T]):
    """Value that many tasks need, made once in each thread that runs some of them.

    Parameters
    ----------
    value : object
        Pickled once, if it can be; by the executor for each task otherwise.
    """

    def __init__(self, value: T) -> None:
        self._value, self._key = value, uuid4().hex
        try:
            data = pickle.dumps(value)
        except Exception:  # whatever pickle meets in a user's object: the executor may know better
            data = b""
        # What stands in __main__ goes by its name in pickle, which another process may not know.
        self._data = b"" if b"__main__" in data else data

    def __reduce__(self) -> tuple[object, ...]:
        return _received, (self._key, self._data, None if self._data else self._value)

    def made(self, make: Callable[[T], R]) -> R:
        """What is made of the value, in this thread: kept, so that no two threads share it."""
        return _cache().get(self._key, lambda: make(self._own()))

    def _own(self) -> T:
        return pickle.loads(self._data) if self._data else self._value  # noqa: S301 (its own)


def _received(key: str, data: bytes, value: T) -> Shared[T]:
    shared: Shared[T] = object.__new__(Shared)
    shared._key, shared._data, shared._value = key, data, value
    return shared


_HERE = threading.local()


def _cache() -> Lru[str, Any]:
    """What this thread has made of shared values."""
    if not hasattr(_HERE, "cache"):
        _HERE.cache = Lru(_CACHED)
    cache: Lru[str, Any] = _HERE.cache
    return cache


_PRESSED: ContextVar[Sequence[int]] = ContextVar("pressed", default=())
"""Signals of Ctrl-C since runs are made."""


@contextmanager
def _counting_interruptions() -> Iterator[Sequence[int]]:
    """Context in which Ctrl-C is remembered: KeyboardInterrupt is lost where it is raised in a callback.

    As `asyncio.run` does, in the main thread and where nobody else handles it.
    """
    pressed: list[int] = []
    here = threading.current_thread() is threading.main_thread()
    if not here or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield pressed
        return

    def remember(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        signal.default_int_handler(number, frame)

    token = _PRESSED.set(pressed)
    signal.signal(signal.SIGINT, remember)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _PRESSED.reset(token)


def _raise_if_pressed() -> None:
    if _PRESSED.get():
        raise KeyboardInterrupt


@contextmanager
def _bar(count: int, label: str, progress: bool) -> Iterator[Callable[[], object]]:
    bar = tqdm(total=count, desc=label, disable=not progress, leave=False)
    try:
        yield bar.update
    finally:
        bar.close()


def _submit(
    run: Callable[[T], R], tasks: Sequence[T], executor: Executor, futures: dict[int, Future[R]]
) -> dict[int, Failed]:
    """Hand out all tasks; those that the executor does not take, and why."""
    for k, task in enumerate(tasks):
        try:
            futures[k] = executor.submit(run, task)
        except (Exception, SystemExit) as error:  # whatever an executor says: it is broken, or cannot send the task
            return dict.fromkeys(range(k, len(tasks)), Failed.of(error, lost=True))
    return {}


def _completed(futures: dict[int, Future[R]]) -> Iterator[tuple[int, R | Failed]]:
    """Outcomes as they complete; a future is dropped then, so that an executor need not keep its result."""
    done: SimpleQueue[int] = SimpleQueue()
    tells = all(hasattr(future, "add_done_callback") for future in futures.values())
    if not tells and not all(hasattr(future, "done") for future in futures.values()):
        for k in list(futures):
            yield k, _outcome(futures[k])
            del futures[k]
        return
    for k, future in futures.items():
        if tells and hasattr(future, "add_done_callback"):
            future.add_done_callback(lambda _, k=k: done.put(k))
    while futures:
        try:
            ready = [done.get(timeout=_POLL_BESIDE_CALLBACKS if tells else _POLL)]
        except Empty:
            ready = [k for k, future in futures.items() if _is_done(future)]
        _raise_if_pressed()
        for k in ready:
            if k in futures:
                yield k, _outcome(futures[k])
                del futures[k]


def _outcome(future: Future[R]) -> R | Failed:
    """Result of a future, or why the executor has none."""
    try:
        return future.result()
    except (Exception, SystemExit, CancelledError) as error:  # a worker died, or the result cannot be read
        _raise_if_pressed()  # which workers may have heard as well
        return Failed.of(error.with_traceback(None), lost=True)  # which would keep the future


def _results(futures: dict[int, Future[R]]) -> dict[int, R]:
    """Results of futures that are done; what went wrong while all was interrupted is no failure of a task."""
    found = {}
    for k, future in futures.items():
        with suppress(Exception, CancelledError):
            if hasattr(future, "exception") and future.exception() is None:
                found[k] = future.result()
    return found


def _cancel(futures: Mapping[int, Future[object]]) -> None:
    for future in futures.values():
        if not _is_done(future) and hasattr(future, "cancel"):
            with suppress(Exception):  # a task that cannot be cancelled must not keep the others
                future.cancel()


def _is_done(future: Future[object]) -> bool:
    return bool(future.done()) if hasattr(future, "done") else False
