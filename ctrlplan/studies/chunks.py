"""Tasks of an executor: several values each; the runs are sent to each worker once."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Generic, TypeVar
from uuid import uuid4

import ctrlplan
from ctrlplan._lru import Lru
from ctrlplan.studies.interruption import holding_back
from ctrlplan.studies.outcomes import Failed, Runs, ready

T = TypeVar("T")
R = TypeVar("R")

_SECONDS = 1.0
"""Time [s] after which a task returns the values that it has not run."""

_RECEIVED: Lru[str, Any] = Lru(4)
"""Runs that this process has received, by key."""


@lru_cache(maxsize=1)
def installed_versions() -> dict[str, str]:
    """Versions of the packages on which results depend, in this process."""
    try:
        casadi = version("casadi")
    except PackageNotFoundError:
        casadi = "none"
    return {"ctrlplan": ctrlplan.__version__, "casadi": casadi}


@dataclass(frozen=True)
class Reply(Generic[R]):
    """Result of a task.

    Attributes
    ----------
    found : dict of int to result or Failed
        Outcomes by the index of the value in the task.
    absent : bool
        Whether the worker has not received the runs, so that nothing was run.
    versions : dict of str to str
        Versions of packages of the worker.
    """

    found: dict[int, R | Failed]
    absent: bool = False
    versions: dict[str, str] = field(default_factory=installed_versions)


class Task(Generic[T, R]):
    """Values, and the runs of which they are arguments.

    A pickled task refers to its runs by a key, and contains them only on request;
    a task that is not pickled, as in threads, always has them.

    Parameters
    ----------
    runs : Runs
        The runs.
    key : str
        Key of the runs in the processes that have received them.
    values : sequence
        The values.
    timeout : float or None
        Time limit of each value [s].
    carries : bool
        Whether the pickled task contains the runs.
    """

    def __init__(
        self, runs: Runs[T, R] | None, key: str, values: Sequence[T], timeout: float | None, carries: bool
    ) -> None:
        self._runs, self._key, self._values, self._timeout, self._carries = runs, key, values, timeout, carries

    def __reduce__(self) -> tuple[object, ...]:
        return _received, (self._key, self._values, self._timeout, self._runs if self._carries else None)

    def __dask_tokenize__(self) -> str:
        """Key of the task on a dask cluster, where a task with the key of a former one would not be run."""
        return uuid4().hex

    def run(self) -> Reply[R]:
        """Run the values, or as many as finish within a second."""
        if self._runs is None:
            return Reply({}, absent=True)
        found: dict[int, R | Failed] = {}
        begin, outcomes = time.perf_counter(), self._runs.outcomes(self._values, self._timeout)
        for i, outcome in outcomes:
            found[i] = outcome
            if time.perf_counter() - begin > _SECONDS:
                found |= dict(ready(outcomes))
                break
        return Reply(found)


def run_task(task: Task[T, R]) -> Reply[R]:
    """Run a task, in any process."""
    with holding_back(False):  # an executor may run its tasks in this thread
        return task.run()


def _received(key: str, values: Sequence[T], timeout: float | None, runs: Runs[T, R] | None) -> Task[T, R]:
    """Task that another process has sent."""

    def known() -> Runs[T, R]:
        if runs is None:
            raise KeyError(key)
        return runs

    try:
        own: Runs[T, R] | None = _RECEIVED.get(key, known)
    except KeyError:
        own = None
    return Task(own, key, values, timeout, carries=runs is not None)  # a scheduler pickles what it has received
