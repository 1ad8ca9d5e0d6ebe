"""Outcomes of many runs: results and failures."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from ctrlplan.simulation.budget import time_limit
from ctrlplan.studies.interruption import raise_if_pressed

T = TypeVar("T")
R = TypeVar("R")
T_contra = TypeVar("T_contra", contravariant=True)
R_co = TypeVar("R_co", covariant=True)


class Runs(Protocol[T_contra, R_co]):
    """Runs of many values, in this process or in others."""

    def outcomes(
        self, values: Sequence[T_contra], timeout: float | None
    ) -> Generator[tuple[int, R_co | Failed], None, None]:
        """Index and outcome of each value, with a time limit of each [s].

        After a KeyboardInterrupt it may yield further finished outcomes, and
        raises it again.
        """


@dataclass(frozen=True)
class Failed:
    """Failure of a run.

    Attributes
    ----------
    message : str
        Message of the exception, with its type.
    error : Exception
        The exception. From another process, a RuntimeError in place of one
        that cannot be pickled.
    by_executor : bool
        Whether the executor raised it; the run may not have begun at all.
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


def tried(run: Callable[[T], R], value: T, timeout: float | None = None) -> R | Failed:
    """Result of a run, or its failure; only KeyboardInterrupt is raised."""
    raise_if_pressed()
    outcome: R | Failed
    try:
        with time_limit(timeout):
            outcome = run(value)
    except (Exception, SystemExit) as error:  # of a user's function
        outcome = Failed.of(error)
    raise_if_pressed()  # a solver or a block may have caught the KeyboardInterrupt
    return outcome


@dataclass(frozen=True)
class OneByOne(Generic[T, R]):
    """Runs of values one after the other.

    Attributes
    ----------
    run : callable
        Maps a value to its result.
    """

    run: Callable[[T], R]

    def outcomes(self, values: Sequence[T], timeout: float | None) -> Generator[tuple[int, R | Failed], None, None]:
        """Index and outcome of each value."""
        for k, value in enumerate(values):
            yield k, tried(self.run, value, timeout)


def ready(outcomes: Generator[tuple[int, R], None, None]) -> Iterator[tuple[int, R]]:
    """Outcomes that a generator yields after an interruption."""
    try:
        yield outcomes.throw(KeyboardInterrupt)
        yield from outcomes
    except (KeyboardInterrupt, StopIteration):
        return
