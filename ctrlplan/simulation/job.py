"""Arguments of a run, and its result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ctrlplan._types import Array, Params
from ctrlplan.simulation.built_forms import NotCompiledError
from ctrlplan.simulation.events import Events, Snapshot, Watched, watched_events
from ctrlplan.simulation.held_outputs import HeldOutputs
from ctrlplan.simulation.network import Network
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.signals import TimeSignal
from ctrlplan.symbolic.trials import can_remember
from ctrlplan.traits import BlockFunction

_EVENT_TIMES = 400, 20_000
"""Minimum and maximum number of evenly spaced times whose distance is the longest between evaluations of events."""

_EVENT_TIMES_A_PERIOD = 16
"""Number of such times per period of the fastest oscillation about the initial state."""


@dataclass(frozen=True, eq=False)
class Job:
    """Simulation to be run: the checked arguments of `simulate`.

    Attributes
    ----------
    prepared : Prepared
        Internal form of the system.
    times : ndarray, shape (ntime,)
        Sample times [s].
    inputs : list of TimeSignal
        Input signals, in order.
    state : ndarray, shape (nstates,)
        Initial state.
    params : dict
        Parameters of the blocks.
    rtol, atol : float, float or None
        Tolerances of a numerical solver.
    events : sequence of Event or None
        See `simulate`.
    network : Network or None
        Blocks that are run. For another attempt they are copies, with the memory
        that the blocks had before the first.
    reason : str
        Why the method that runs the job was chosen.
    trials : bool
        Whether trial calls at the start may exclude an algebraic loop.
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
        """Network of blocks; raises if there is none."""
        if self.network is None:
            raise NotCompiledError(self.prepared.unsupported)
        return self.network

    @property
    def first(self) -> float:
        """Start of the run [s]."""
        return float(self.times[0])

    def watched(self) -> tuple[Watched, ...]:
        """Events given by the user and declared by blocks; none if an empty sequence was given."""
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
    """States at the times of a run, with functions that evaluate it at other times.

    Attributes
    ----------
    times, states : ndarray, shapes (ntime,) and (nstates, ntime)
        Up to the end of the run.
    snapshot : callable
        Maps times and states to all signals.
    interpolate : callable
        Maps k and a time between times[k] and the next to the state there.
    watched : tuple of Watched
        Signals with limits that are events.
    method : str
        Name of the method used.
    reason : str or callable
        Why it was chosen; a function without arguments returns it when it is first
        read.
    is_pure : bool
        Whether signals can be evaluated later, as they do not call functions of
        blocks.
    inside : callable or None
        The same as `snapshot` to rounding, faster at one time.
    held : callable or None
        Returns the parts of the outputs that discrete blocks hold, or None if there
        are none; their times may be sample times but for rounding.
    """

    times: Array
    states: Array
    snapshot: Callable[[Array, Array], Snapshot]
    interpolate: Callable[[int, float], Array]
    watched: tuple[Watched, ...]
    method: str
    reason: str | Callable[[], str]
    is_pure: bool = False
    inside: Callable[[Array, Array], Snapshot] | None = None
    held: Callable[[], HeldOutputs | None] | None = None

    def snapshot_at(self, k: int, t: float) -> Snapshot:
        """All signals at a time between times[k] and times[k + 1], for crossings of limits."""
        return (self.inside or self.snapshot)(np.array([t]), self.state_at(k, t)[:, None])

    def state_at(self, k: int, t: float) -> Array:
        """State at a time between times[k] and times[k + 1]."""
        return self.interpolate(k, t) if t > self.times[k] else self.states[:, k]


def with_event_times(times: Array, watched: Sequence[Watched], slope: Callable[[], Array]) -> Array:
    """Sample times, with further ones if there are events, so that crossings between samples are detected.

    Intervals that are too long are divided evenly, so that equal intervals have equal times: a compiled solver is
    built for each pattern of times.
    """
    if not watched:
        return times
    matrix = slope()
    fastest = float(np.abs(np.linalg.eigvals(matrix).imag).max(initial=0.0)) if np.isfinite(matrix).all() else 0.0
    periods = fastest * float(times[-1] - times[0]) / (2.0 * np.pi)
    count = int(min(max(_EVENT_TIMES[0], _EVENT_TIMES_A_PERIOD * periods), _EVENT_TIMES[1]))
    gaps = np.diff(times)
    parts = np.ceil(gaps * ((count - 1) / (times[-1] - times[0])) * (1.0 - 1e-9)).astype(int)
    if parts.max() == 1:
        return times
    within = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    inner = np.repeat(times[:-1], parts) + np.repeat(gaps / parts, parts) * within
    inner[within == 0] = times[:-1]
    return np.append(inner, times[-1])


def _of_block(
    function: BlockFunction, states: slice, fed: Callable[[Array], Array], params: Params, seen: Snapshot
) -> Array:
    """Signal declared by a block, from its states and inputs."""
    return np.asarray(function(seen.t, seen.x[states], fed(seen.w), params))


def fresh_job(job: Job) -> Job:
    """Same job for another attempt, with copies of the sampled blocks and their present memory."""
    network = job.network
    if network is None or not any(can_remember(network.blocks[i].system) for i in network.blocks_with("period")):
        return job
    return replace(job, network=network.for_trials())
