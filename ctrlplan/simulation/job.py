"""Arguments of a run, and its result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ctrlplan._types import Array, Params
from ctrlplan.simulation.built_forms import NotCompiledError
from ctrlplan.simulation.events import Events, Snapshot, Watched, watched_events
from ctrlplan.simulation.network import Network
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.signals import TimeSignal
from ctrlplan.symbolic.trials import can_remember
from ctrlplan.traits import BlockFunction

_EVENT_TIMES = 400, 20_000
"""Minimum and maximum number of times, in addition to the sample times, at which signals of events are evaluated."""

_EVENT_TIMES_A_PERIOD = 16
"""Such times in a period of the fastest oscillation about the state where a run begins."""


@dataclass(frozen=True, eq=False)
class Job:
    """What one call of `simulate` is to run.

    Attributes
    ----------
    prepared : Prepared
        Built form of the system.
    times : ndarray, shape (ntime,)
        Sample times [s].
    inputs : list of TimeSignal
        Signals at the inputs, in order.
    state : ndarray, shape (nstates,)
        Initial state.
    params : dict
        Parameters of the blocks.
    rtol, atol : float, float or None
        Tolerances of a numerical solver.
    events : sequence of Event or None
        See `simulate`.
    network : Network or None
        Blocks that are run; of another attempt copies, which have the memory that the blocks had before.
    reason : str
        Why the method was chosen that runs the job.
    trials : bool
        Whether trial calls at the start may rule out an algebraic loop.
    """

    prepared: Prepared
    times: Array
    inputs: list[TimeSignal]
    state: Array
    params: Params
    rtol: float
    atol: float | None
    events: Events
    network: Network | None
    reason: str = ""
    trials: bool = True

    @property
    def blocks(self) -> Network:
        """Network that is run."""
        if self.network is None:
            raise NotCompiledError(self.prepared.unsupported)
        return self.network

    @property
    def first(self) -> float:
        """Where the run begins [s]."""
        return float(self.times[0])

    def watched(self) -> tuple[Watched, ...]:
        """Events of the call, and those that blocks declare unless an empty sequence was given."""
        prepared = self.prepared
        # An output hides an input or a state of the same name.
        kinds = (("u", prepared.input_labels), ("x", prepared.state_labels), ("y", prepared.output_labels))
        labels = {label: (kind, row) for kind, names in kinds for row, label in enumerate(names)}
        given = watched_events(self.events or (), labels)
        if self.events is not None and not self.events:
            return ()
        known = prepared.network.watched if prepared.network is not None else ()
        declared = [
            Watched(w.name, partial(_of_block, w.function, w.states, w.fed, {**w.params, **self.params}), w.low, w.high)
            for w in known
        ]
        return (*declared, *given)


@dataclass(frozen=True, eq=False)
class Record:
    """States at the times of a run, and how to evaluate it elsewhere.

    Attributes
    ----------
    times, states : ndarray, shapes (ntime,) and (nstates, ntime)
        As far as the run went.
    snapshot : callable
        Maps times and states to all signals.
    interpolate : callable
        Maps k and a time between times[k] and the next to the state there.
    watched : tuple of Watched
        Signals whose limits count as events.
    method, reason : str
        What ran, and why.
    """

    times: Array
    states: Array
    snapshot: Callable[[Array, Array], Snapshot]
    interpolate: Callable[[int, float], Array]
    watched: tuple[Watched, ...]
    method: str
    reason: str

    def state_at(self, k: int, t: float) -> Array:
        """State at a time from times[k] to the next."""
        return self.interpolate(k, t) if t > self.times[k] else self.states[:, k]


def with_event_times(times: Array, watched: Sequence[Watched], slope: Callable[[], Array]) -> Array:
    """Sample times, and more where events are watched, so that no crossing is missed between two."""
    if not watched:
        return times
    matrix = slope()
    fastest = float(np.abs(np.linalg.eigvals(matrix).imag).max(initial=0.0)) if np.isfinite(matrix).all() else 0.0
    periods = fastest * float(times[-1] - times[0]) / (2.0 * np.pi)
    count = int(min(max(_EVENT_TIMES[0], _EVENT_TIMES_A_PERIOD * periods), _EVENT_TIMES[1]))
    return np.union1d(times, np.linspace(times[0], times[-1], count))


def _of_block(
    function: BlockFunction, states: slice, fed: Callable[[Array], Array], params: Params, seen: Snapshot
) -> Array:
    """Signal that a block declares, from its states and inputs."""
    return np.asarray(function(seen.t, seen.x[states], fed(seen.w), params))


def fresh_job(job: Job) -> Job:
    """Same job for another attempt, its sampled blocks with the memory that they have now."""
    network = job.network
    if network is None or not any(can_remember(network.blocks[i].system) for i in network.blocks_with("period")):
        return job
    return replace(job, network=network.for_trials())
