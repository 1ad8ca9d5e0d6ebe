"""Outcomes of loops built for many values: linear loops of the same structure are solved together."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, TypeVar

from ctrlplan.studies.alike import Linear
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.measures import Run
from ctrlplan.studies.outcomes import Failed, tried
from ctrlplan.studies.running import Builder, System

T = TypeVar("T")
R = TypeVar("R")

_SAMPLES = 2**19
"""Maximum number of samples of a signal over all loops that are solved together."""

FIRST = 16
"""Number of loops solved together at first; fourfold each time, so that an interruption discards few results."""

FIRST_OF_TASK = 32
"""The same in a task of an executor, which an interruption does not end."""


@dataclass
class Batches(Generic[T, R]):
    """Loops of many values in an experiment.

    Attributes
    ----------
    experiment : Experiment
        Plans, times and measures.
    build : callable
        Maps a value to a loop.
    alone : callable
        Maps a loop to its outcome.
    alike : callable or None
        Maps linear loops of the same structure to the outcome of each, None for
        loops that must be run separately. None if every loop must be.
    first : int
        Number of loops solved together at first.
    """

    experiment: Experiment
    build: Callable[[T], System | Builder]
    alone: Callable[[System | Builder], R]
    alike: Callable[[Sequence[Linear]], Sequence[R | None]] | None
    first: int = FIRST
    _checked: bool = False

    def _checks(self, loop: System | Builder) -> Run:
        """Run with the first plan."""
        return self.experiment.simulated(loop, next(iter(self.experiment.plans)))

    def outcomes(self, values: Sequence[T], timeout: float | None) -> Generator[tuple[int, R | Failed], None, None]:
        """Number and outcome of each value.

        The first linear loop in a process is also simulated with the first plan, which
        checks the arguments for the loop. After a KeyboardInterrupt, outcomes of loops
        already built follow.
        """
        waiting: dict[int, tuple[Linear, System]] = {}
        size = self.first
        largest = max(2, _SAMPLES // max(1, self.experiment.timepts.size))

        def alone(k: int, linear: Linear, loop: System) -> R | Failed:
            if linear.is_of(loop):
                return tried(self.alone, loop, timeout)
            return tried(lambda value: self.alone(self.build(value)), values[k], timeout)  # modified since then

        def together() -> Iterator[tuple[int, R | Failed]]:
            nonlocal size
            found: Sequence[R | None] = [None] * len(waiting)
            with suppress(Exception):  # of one of them, which is raised when it is run separately
                found = self.alike([linear for linear, _ in waiting.values()]) if self.alike and waiting else found
            for (k, (linear, loop)), outcome in zip(waiting.items(), found, strict=True):
                yield k, alone(k, linear, loop) if outcome is None else outcome
            waiting.clear()
            size = min(4 * size, largest)

        try:
            for k, value in enumerate(values):
                loop = tried(self.build, value, timeout)
                linear = None if self.alike is None or isinstance(loop, Failed) else self.experiment.numbers_of(loop)
                if linear is not None and not self._checked:
                    self._checked = not isinstance(tried(self._checks, loop, timeout), Failed)
                if linear is None or not self._checked:
                    yield k, loop if isinstance(loop, Failed) else tried(self.alone, loop, timeout)
                    continue
                if waiting and not linear.fits(next(iter(waiting.values()))[0]):
                    yield from together()
                waiting[k] = linear, loop
                if len(waiting) >= size:
                    yield from together()
            yield from together()
        except KeyboardInterrupt:  # results of the loops already built
            yield from together()
            raise
