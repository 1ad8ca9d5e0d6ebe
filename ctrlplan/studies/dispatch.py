"""Runs on an executor: tasks in flight, tasks lost with their worker, pools that break."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar
from uuid import uuid4

from ctrlplan.studies.chunks import Reply, Task, installed_versions, run_task
from ctrlplan.studies.executors import (
    CANNOT_BE_SENT,
    Executor,
    Future,
    Futures,
    is_broken,
    new_pool,
    worker_count,
)
from ctrlplan.studies.interruption import holding_back
from ctrlplan.studies.outcomes import Failed, Runs

T = TypeVar("T")
R = TypeVar("R")

LARGEST = 250
"""Maximum number of values of a task, unless it is given."""

_TASKS = 4
"""Minimum number of tasks of a worker, if there are enough values."""

_ASSUMED = 16
"""Number of workers for the size of tasks, if it is not known."""

_IN_FLIGHT = 2
"""Number of tasks in flight for each worker: one runs, one waits."""

_AGAIN = 2
"""Number of times that a value is sent again after its worker died."""


def task_size(count: int, executor: Executor, workers: int | None, chunk: int | None) -> int:
    """Number of values of a task."""
    if chunk is not None:
        return chunk
    return max(1, min(LARGEST, math.ceil(count / (_TASKS * (workers or worker_count(executor) or _ASSUMED)))))


@dataclass(frozen=True)
class _Chunk:
    """Numbers of the values of a task.

    Attributes
    ----------
    numbers : tuple of int
        The values.
    carries : bool
        Whether the runs are sent with it.
    pool : int
        Number of the executor that has it: the one given, or a new pool.
    """

    numbers: tuple[int, ...]
    carries: bool = False
    pool: int = 0


@dataclass
class Dispatch(Generic[T, R]):
    """Execution of runs on an executor.

    Tasks lost with their worker are sent again twice at most, one value at a
    time: first when all others have been sent, then with nothing else in flight,
    so that only the value that ends its worker remains without a result. A
    broken process pool is replaced by a new one. A future without the reply of a
    worker counts as a lost task, and an OSError of ``submit`` is retried once.

    Parameters
    ----------
    runs : Runs
        What is run; pickled by the executor.
    values : sequence
        All values.
    numbers : sequence of int
        Indices of the values to be run.
    executor : Executor
        Where they run.
    workers : int or None
        Number of workers; None for that of the executor.
    size : int
        Number of values of a task.
    timeout : float or None
        Time limit of each value [s].

    Attributes
    ----------
    sent_again : set of int
        Values that were sent again.
    """

    runs: Runs[T, R]
    values: Sequence[T]
    numbers: Sequence[int]
    executor: Executor
    workers: int | None
    size: int
    timeout: float | None
    sent_again: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._key = uuid4().hex
        self._workers = self.workers or worker_count(self.executor)
        self._waiting = deque(_parts(self.numbers, self.size))
        self._lost: tuple[deque[_Chunk], ...] = tuple(deque() for _ in range(_AGAIN))
        self._losses: dict[int, int] = {}
        self._futures: Futures[Reply[R]] = Futures()
        self._chunks: dict[int, _Chunk] = {}
        self._arrived: deque[tuple[int, R | Failed]] = deque()
        self._submitted = self._pool = self._carried = self._in_vain = 0
        self._any_finished = self._travelled = self._retried = False

    def outcomes(self) -> Generator[tuple[int, R | Failed], None, None]:
        """Number and outcome of each value, as they arrive; after a KeyboardInterrupt, those that have finished.

        Raises
        ------
        RuntimeError
            If a worker has other versions of packages.
        """
        given = self.executor
        try:
            while True:
                self._submit()
                yield from self._arrivals()
                if not self._futures:
                    return
                self._read(*self._futures.next())
        except KeyboardInterrupt:
            for number, reply in self._futures.finished().items():
                if isinstance(reply, Reply):
                    self._find(self._chunks[number], reply)
            yield from self._arrivals()
            raise
        finally:
            self._futures.cancel()
            if self.executor is not given:
                _end(self.executor)

    def _arrivals(self) -> Iterator[tuple[int, R | Failed]]:
        while self._arrived:
            yield self._arrived.popleft()

    def _submit(self) -> None:
        """Submit tasks up to the number in flight; those that the executor rejects have failed."""
        limit = _IN_FLIGHT * self._workers if self._workers else math.inf
        while len(self._futures) < limit and (chunk := self._next()) is not None:
            carries = chunk.carries or self._carried < (self._workers or 1)
            sent = _Chunk(chunk.numbers, carries, self._pool)
            try:
                with holding_back():  # so that no task is with the executor and not known here
                    self._futures.add(self._submitted, self._sent(sent))
                    self._chunks[self._submitted] = sent
                    self._submitted += 1
                    self._carried += carries
                    self._retried = False
            except (Exception, SystemExit) as error:  # of the executor: it is broken, or cannot send the task
                failed = Failed.of(error, by_executor=True)
                again = isinstance(error, OSError) and not self._retried
                if not (self._renewed(failed.error, self._pool) or again):
                    self._give_up(failed, chunk)
                    return
                self._retried |= again
                self._waiting.appendleft(chunk)

    def _next(self) -> _Chunk | None:
        """Next task; one that was lost twice only when nothing is in flight."""
        first, last = self._lost
        for queue in (self._waiting, first):
            if queue:
                return queue.popleft()
        return last.popleft() if last and not self._futures else None

    def _sent(self, chunk: _Chunk) -> Future[Reply[R]]:
        values = [self.values[number] for number in chunk.numbers]
        task = Task(self.runs, self._key, values, self.timeout, chunk.carries)
        future = self.executor.submit(run_task, task)
        if not callable(getattr(future, "result", None)):
            raise RuntimeError(f"submit of the executor must return a future with result, got {future!r:.80}")
        return future

    def _read(self, number: int, reply: Reply[R] | Failed | object) -> None:
        """Take the outcomes of a task, and send again what it has not run."""
        chunk = self._chunks.pop(number)
        if isinstance(reply, Reply):
            _check_versions(reply)
            self._in_vain = 0
            if reply.absent and chunk.carries:
                error = RuntimeError("a worker has not received the runs that were sent with a task")
                self._give_up(Failed.of(error, by_executor=True), chunk)
                return
            if reply.absent:
                self._waiting.appendleft(_Chunk(chunk.numbers, carries=True))
                return
            self._any_finished = True
            self._travelled |= chunk.carries
            self._find(chunk, reply)
            rest = [number for i, number in enumerate(chunk.numbers) if i not in reply.found]
            self._waiting.extend(_parts(rest, max(1, len(reply.found))))
            return
        if not isinstance(reply, Failed):
            what = f"the executor must return the result of the function submitted, got {reply!r:.80}"
            reply = Failed.of(RuntimeError(what), by_executor=True)
        self._in_vain += 1
        self._renewed(reply.error, chunk.pool)
        if isinstance(reply.error, CANNOT_BE_SENT) and self._travelled:
            self._fail(chunk, reply)
        elif isinstance(reply.error, CANNOT_BE_SENT) and chunk.carries:
            self._give_up(reply, chunk)
            self._give_up_flight(reply)
        elif self._in_vain > self._patience:
            self._give_up(reply, chunk)
        else:
            self._lose(chunk, reply)

    @property
    def _patience(self) -> int:
        """Number of tasks that may be lost one after the other."""
        flight = _IN_FLIGHT * self._workers if self._workers else len(self.numbers)
        return 4 * flight + (100 if self._any_finished else 8)

    def _find(self, chunk: _Chunk, reply: Reply[R]) -> None:
        self._arrived.extend((chunk.numbers[i], outcome) for i, outcome in reply.found.items())

    def _lose(self, chunk: _Chunk, failed: Failed) -> None:
        """Put the values of a lost task in line again, or give them up."""
        self._carried = 0  # new workers have not received the runs
        for number in chunk.numbers:
            losses = self._losses.get(number, 0)
            self._losses[number] = losses + 1
            if losses < _AGAIN:
                self.sent_again.add(number)
                self._lost[losses].append(_Chunk((number,)))
            else:
                self._arrived.append((number, failed))

    def _give_up(self, failed: Failed, chunk: _Chunk) -> None:
        """Record the same failure of a task and of all that are not in flight."""
        self._fail(chunk, failed)
        for queue in (self._waiting, *self._lost):
            while queue:
                self._fail(queue.popleft(), failed)

    def _give_up_flight(self, failed: Failed) -> None:
        """Record the same failure of all tasks in flight."""
        self._futures.cancel()
        for chunk in self._chunks.values():
            self._fail(chunk, failed)
        self._chunks.clear()

    def _fail(self, chunk: _Chunk, failed: Failed) -> None:
        self._arrived.extend((number, failed) for number in chunk.numbers)

    def _renewed(self, error: Exception, pool: int) -> bool:
        """Whether a broken executor has been replaced."""
        if not is_broken(error):
            return False
        if pool < self._pool:
            return True
        new = new_pool(self.executor)
        if new is None:
            return False
        if self._pool:
            _end(self.executor)
        self.executor, self._carried = new, 0
        self._pool += 1
        return True


def _parts(numbers: Sequence[int], size: int) -> Iterator[_Chunk]:
    for k in range(0, len(numbers), size):
        yield _Chunk(tuple(numbers[k : k + size]))


def _check_versions(reply: Reply[R]) -> None:
    """Raise if a worker has other versions of packages than this process."""
    for name, own in installed_versions().items():
        theirs = reply.versions.get(name, "none")
        if theirs != own:
            raise RuntimeError(
                f"workers must have the same version of {name} as this process, {own}, got {theirs} in a worker; "
                "install the same versions on all machines"
            )


def _end(pool: Executor) -> None:
    """End a process pool that was made here."""
    shutdown = getattr(pool, "shutdown", None)
    if shutdown is not None:
        shutdown(wait=False)
