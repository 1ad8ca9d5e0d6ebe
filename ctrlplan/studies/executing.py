"""Execution of many runs, in this process or on an executor: progress, interruption, checkpoints, failures."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from numbers import Real
from operator import index
from typing import Any, Generic, TypeVar

from ctrlplan.studies.checkpoint import Checkpoint
from ctrlplan.studies.dispatch import LARGEST, Dispatch, task_size
from ctrlplan.studies.executors import CANNOT_BE_SENT, Executor, checked_executor
from ctrlplan.studies.interruption import counting_interruptions
from ctrlplan.studies.outcomes import Failed, Runs, ready
from ctrlplan.studies.progress import bar

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Execution:
    """Where and how runs are executed.

    Attributes
    ----------
    executor : Executor or None
        Where they run; None for this process.
    workers, chunk : int or None
        Number of workers of the executor, and number of values of a task; None
        to choose them.
    checkpoint : path or None
        Folder of finished outcomes.
    progress : bool
        Whether a progress bar is shown on stderr.
    timeout : float or None
        Time limit of one value [s].

    Raises
    ------
    TypeError
        If the executor has no method ``submit``.
    ValueError
        If a number is not above 0, or `workers` is given without an executor.
    """

    executor: Executor | None = None
    workers: int | None = None
    chunk: int | None = None
    checkpoint: str | os.PathLike[str] | None = None
    progress: bool = False
    timeout: float | None = None

    def __post_init__(self) -> None:
        checked_executor(self.executor)
        checked_timeout(self.timeout)
        for name in ("workers", "chunk"):
            _check_count(getattr(self, name), name)
        if self.workers is not None and self.executor is None:
            raise ValueError(
                f"workers must be None without an executor, got {self.workers}; for several processes give "
                f"executor=concurrent.futures.ProcessPoolExecutor({self.workers})"
            )
        if self.checkpoint is not None and not isinstance(self.checkpoint, str | os.PathLike):
            raise TypeError(f"checkpoint must be the path of a folder, or None, got {self.checkpoint!r:.80}")

    @classmethod
    def from_arguments(cls, given: Mapping[str, Any]) -> Execution:
        """Execution from the arguments of a function that has all its fields, by name."""
        return cls(**{name: given[name] for name in cls.__dataclass_fields__})


@dataclass(frozen=True)
class Executed:
    """What became of the values that were to be run.

    Attributes
    ----------
    finished : int
        Number of values that ran or failed.
    interrupted : bool
        Whether Ctrl-C ended the execution.
    sent_again : tuple of int
        Values that were sent again because their worker ended.
    missing : tuple of int
        Values that no worker finished, or that did not run.
    errors : tuple of Exception
        Exceptions of the executor, one for each value that no worker finished.
    """

    finished: int
    interrupted: bool
    sent_again: tuple[int, ...]
    missing: tuple[int, ...]
    errors: tuple[Exception, ...]

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
        errors = self.errors
        if self.interrupted or not errors or len(errors) < self.finished:
            return
        advice = (
            "move the builder into a module that the workers can import, or use an executor that pickles any function "
            "(dask, loky) or threads"
        )
        if isinstance(errors[0], CANNOT_BE_SENT):
            raise ValueError(f"{what} must be picklable for other processes, got {errors[0]}; {advice}") from errors[0]
        if isinstance(errors[0], BrokenExecutor):
            errors[0].add_note(
                f"Every worker process ended. If {what} is defined in a notebook or a console: {advice}."
            )
        raise errors[0]


def executed(
    runs: Runs[T, R],
    values: Sequence[T],
    collect: Callable[[int, R | Failed], object],
    execution: Execution,
    label: str,
    identity: Callable[[], Mapping[str, object]] = dict,
) -> Executed:
    """Run all values, until the last or until Ctrl-C.

    Parameters
    ----------
    runs : Runs
        What is run.
    values : sequence
        Arguments of the runs.
    collect : callable
        Receives the number and outcome of each value, in the order of completion.
    execution : Execution
        Where and how the values are run.
    label : str
        Label of the progress bar.
    identity : callable, optional
        Returns plain data that identify the outcomes, for a checkpoint.

    Raises
    ------
    ValueError
        If the checkpoint is that of another study.
    OSError
        If its folder cannot be made, read or written to.

    Warns
    -----
    UserWarning
        If outcomes cannot be written to it later.
    """
    store = None if execution.checkpoint is None else Checkpoint.opened(execution.checkpoint, identity())
    account = _Account(collect)
    for number, outcome in store.read() if store else ():
        account.add(number, outcome)
    numbers = [number for number in range(len(values)) if number not in account.seen]
    if store and numbers:
        store.check_writable()
    size, dispatch, executor = execution.chunk or LARGEST, None, execution.executor
    if executor is None or not numbers:
        outcomes = runs.outcomes([values[number] for number in numbers], execution.timeout)
        account.numbers = numbers
    else:
        size = task_size(len(numbers), executor, execution.workers, execution.chunk)
        dispatch = Dispatch(runs, values, numbers, executor, execution.workers, size, execution.timeout)
        outcomes = dispatch.outcomes()
    with closing(outcomes), store.keeping(size) if store else nullcontext() as account.keep:
        interrupted = _gathered(outcomes, account, len(values), label, execution.progress)
    return Executed(
        len(account.seen),
        interrupted,
        tuple(sorted(dispatch.sent_again)) if dispatch else (),
        tuple(sorted(account.lost.keys() | (set(numbers) - account.seen))),
        tuple(account.lost.values()),
    )


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


@dataclass
class _Account(Generic[R]):
    """Outcomes as they arrive.

    Attributes
    ----------
    collect : callable
        Receives the number and outcome of each value.
    keep : callable or None
        Receives them as well, for a checkpoint.
    numbers : sequence of int or None
        Numbers of the values by the index in which outcomes arrive; None if they
        arrive with their numbers.
    seen : set of int
        Values that ran or failed.
    lost : dict of int to Exception
        Values that no worker finished.
    """

    collect: Callable[[int, R | Failed], object]
    keep: Callable[[int, R | Failed], object] | None = None
    numbers: Sequence[int] | None = None
    seen: set[int] = field(default_factory=set)
    lost: dict[int, Exception] = field(default_factory=dict)

    def add(self, k: int, outcome: R | Failed) -> None:
        """Record an outcome."""
        number = k if self.numbers is None else self.numbers[k]
        self.seen.add(number)
        if isinstance(outcome, Failed) and outcome.by_executor:
            self.lost[number] = outcome.error
        elif self.keep is not None:
            self.keep(number, outcome)
        self.collect(number, outcome)


def _gathered(
    outcomes: Generator[tuple[int, R | Failed], None, None],
    account: _Account[R],
    count: int,
    label: str,
    progress: bool,
) -> bool:
    """Take outcomes until the last or until Ctrl-C; return whether it was Ctrl-C."""
    with counting_interruptions() as pressed, bar(count, label, progress) as advance:
        try:
            for _ in account.seen:
                advance()
            for k, outcome in outcomes:
                account.add(k, outcome)
                advance()
        except KeyboardInterrupt as error:
            for k, outcome in ready(outcomes):
                account.add(k, outcome)
            if len(pressed) > 1 or isinstance(error.__context__, KeyboardInterrupt):
                raise
            return True
    return False


def _check_count(count: object, name: str) -> None:
    """Raise if a number of workers or values is given and not an integer above 0."""
    if count is None:
        return
    try:
        usable = not isinstance(count, bool) and index(count) > 0  # type: ignore[arg-type]
    except TypeError:
        usable = False
    if not usable:
        raise ValueError(f"{name} must be an integer of at least 1, or None, got {count!r:.80}")
