"""Runs of many draws, one after the other; their metrics are computed together."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from ctrlplan._types import Array
from ctrlplan.studies.draw_results import Outcome
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.measures import Run
from ctrlplan.studies.outcomes import Failed, tried

T = TypeVar("T")

_RUNS = 96
"""Maximum number of runs whose metrics are computed together."""

_SAMPLES = 2**18
"""Maximum number of samples of a signal over these runs."""


@dataclass(frozen=True)
class MeasuredTogether(Generic[T]):
    """Runs of values, with the metrics of several runs computed together.

    Attributes
    ----------
    experiment : Experiment
        Plans, times and measures; without measures of the user.
    simulate : callable
        Maps a value to the run with each plan, or its failure.
    curves : callable
        Maps a run to the signals that are stored.
    """

    experiment: Experiment
    simulate: Callable[[T], Mapping[str, Run | Failed]]
    curves: Callable[[Run], dict[str, Array]]

    def outcomes(
        self, values: Sequence[T], timeout: float | None
    ) -> Generator[tuple[int, Outcome | Failed], None, None]:
        """Index and outcome of each value.

        Metrics of the first run are computed separately, then those of two, four and more runs together. After a
        KeyboardInterrupt, outcomes of the finished runs follow.
        """
        waiting: dict[int, Mapping[str, Run | Failed]] = {}
        done: deque[tuple[int, Outcome]] = deque()
        size, largest = 1, min(_RUNS, max(1, _SAMPLES // self.experiment.timepts.size))

        def together() -> Iterator[tuple[int, Outcome]]:
            if waiting:
                done.extend(zip(waiting, self._measured(list(waiting.values())), strict=True))
                waiting.clear()
            while done:  # each leaves before the generator may be interrupted
                yield done.popleft()

        try:
            for k, value in enumerate(values):
                runs = tried(self.simulate, value, timeout)
                if isinstance(runs, Failed):
                    yield k, runs
                    continue
                waiting[k] = runs
                if len(waiting) >= size:
                    yield from together()
                    size = min(2 * size, largest)
            yield from together()
        except KeyboardInterrupt:
            yield from together()
            raise

    def _measured(self, draws: Sequence[Mapping[str, Run | Failed]]) -> list[Outcome]:
        """Outcomes of several values, whose runs are replaced by metrics and stored signals."""
        outcomes: list[Outcome] = [{} for _ in draws]
        for plan in draws[0]:
            runs = {i: run for i, draw in enumerate(draws) if isinstance(run := draw[plan], Run)}
            metrics = dict(zip(runs, self._metrics(list(runs.values())), strict=True))
            for i, (outcome, draw) in enumerate(zip(outcomes, draws, strict=True)):
                run = draw[plan]
                if isinstance(run, Failed):
                    outcome[plan] = run
                    continue
                found = metrics[i]
                outcome[plan] = found if isinstance(found, Failed) else (found, self.curves(run))
        return outcomes

    def _metrics(self, runs: list[Run]) -> list[dict[str, float] | Failed]:
        """Metrics of runs with one plan; separately if those of one cannot be computed."""
        measure = self.experiment.metrics_of_runs
        found = tried(measure, runs) if len(runs) > 1 else None
        if found is not None and not isinstance(found, Failed):
            return list(found)
        each = [tried(measure, [run]) for run in runs]
        return [one if isinstance(one, Failed) else one[0] for one in each]
