"""Delays of signals that are known before a run: plans, samples and constants, and linear combinations of them.

Their outputs are plain functions of time. A numerical run does not have to stop
after each delay for them, as it does for a signal that depends on its states.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.delayed_signals import DelayedSignal, DelayOutput, HeldDelaySignal
from ctrlplan.simulation.network import Network
from ctrlplan.simulation.signals import PlanSignal, SampledSignal, TimeSignal, after_marks


class KnownDelaySignal(DelayOutput):
    """Delayed linear combinations of functions of time.

    Parameters
    ----------
    delay : float
        Delay [s].
    initial : ndarray, shape (width,)
        Values until the first input has passed.
    first : float
        Start of the run [s].
    sources : sequence of TimeSignal
        Functions of time before the delay.
    weights : sequence of ndarray, shapes (width, width of the source)
        Weights of each of them.
    """

    def __init__(
        self, delay: float, initial: Array, first: float, sources: Sequence[TimeSignal], weights: Sequence[Array]
    ) -> None:
        super().__init__(delay, initial, first)
        self._parts = [(source, w) for source, w in zip(sources, weights, strict=True) if w.any()]

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """Arrival of the first input, and of the breakpoints after it."""
        begin, end = (max(t - self.delay, self._first) for t in (t0 - self.tolerance, t1 + self.tolerance))
        later = [source.breakpoints_between(begin, end) for source, _ in self._parts]
        marks = np.unique(np.concatenate([[self._first], *later])) + self.delay
        return np.asarray(marks[(marks >= t0) & (marks < t1)])

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values of the segments before the delay that contain `moment` minus the delay."""
        if moment - self.delay < self._first:
            return np.repeat(self._initial[:, None], s.size, axis=1)
        past = (source.analytic_at(moment - self.delay, origin - self.delay, s) for source, _ in self._parts)
        return self._combined(past, s.size)

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """Sums of the bounds of the functions of time."""
        if moment - self.delay < self._first:
            return self._initial, self._initial
        low, high = np.zeros(self.width), np.zeros(self.width)
        for source, weights in self._parts:
            for bound in _products(weights, source.bounds(moment - self.delay, left - self.delay, right - self.delay)):
                low, high = low + bound.min(axis=0), high + bound.max(axis=0)
        return low, high

    def ends(self, left: float, right: float) -> tuple[Array, Array] | None:
        """Values at both ends of a segment if all functions of time are straight lines there."""
        if 0.5 * (left + right) - self.delay < self._first:
            return self._initial, self._initial
        known = [source.ends(left - self.delay, right - self.delay) for source, _ in self._parts]
        lines = [line for line in known if line is not None]
        if len(lines) < len(known):
            return None
        first, last = (self._combined((line[k][:, None] for line in lines), 1)[:, 0] for k in (0, 1))
        return first, last

    def at(self, times: Array) -> Array:
        """Values, right-continuous; what arrives at a time is included, whatever the rounding of the times."""
        out = np.repeat(self._initial[:, None], times.size, axis=1)
        past = times - self.delay
        passed = past >= self._first - self.tolerance
        past = np.maximum(past[passed], self._first)
        if past.size:
            ends = float(past.min()), float(np.nextafter(past.max() + self.tolerance, np.inf))
            values = (
                source.at(after_marks(source.breakpoints_between(*ends), past, self.tolerance))
                for source, _ in self._parts
            )
            out[:, passed] = self._combined(values, past.size)
        return out

    def _combined(self, values: Iterator[Array], count: int) -> Array:
        """Weighted sum (width, count) of values of the functions of time; a single one without rounding."""
        total = np.zeros((self.width, count))
        for (_, weights), rows in zip(self._parts, values, strict=True):
            for k, j in zip(*np.nonzero(weights), strict=True):
                total[k] += weights[k, j] * rows[j]
        return total


def with_known_delays(network: Network, signals: Sequence[TimeSignal], first: float) -> list[TimeSignal]:
    """Functions of time of a run with the delays of known signals as functions of time.

    Parameters
    ----------
    network : Network
        The blocks.
    signals : sequence of TimeSignal
        Inputs, then the outputs of sources and delays in the order of the blocks.
    first : float
        Start of the run [s].
    """
    found, delays = list(signals), network.blocks_with("delay")
    late = [k for k, signal in enumerate(found) if isinstance(signal, DelayedSignal)]
    waiting = [(k, i) for k, i in zip(late, delays, strict=True) if not isinstance(found[k], HeldDelaySignal)]
    if not waiting or sum(signal.width for signal in found) != network.time_rows.size:
        return found
    ends = np.cumsum([signal.width for signal in found], dtype=int).tolist()
    columns = [slice(end - signal.width, end) for signal, end in zip(found, ends, strict=True)]
    gains = np.full((network.nsignals, ends[-1]), np.nan)  # of each signal from the functions of time; nan: unknown

    def know(k: int) -> None:
        gains[network.time_rows[columns[k]]] = np.eye(ends[-1])[columns[k]]

    for k, signal in enumerate(found):
        if isinstance(signal, PlanSignal | SampledSignal):
            know(k)
    changed = True
    while changed:
        changed = _through_gains(network, gains)
        for k, i in waiting:
            weights, block = _weights(network.wire[network.inputs[i]], gains), network.blocks[i]
            if weights is not None and np.isnan(gains[network.outputs[i]]).any():
                initial = np.broadcast_to(np.asarray(block.traits.initial, dtype=float), (found[k].width,))
                parts = [weights[:, own] for own in columns]
                found[k] = KnownDelaySignal(float(block.delay or 0.0), initial, first, found, parts)
                know(k)
                changed = True
    return found


def _through_gains(network: Network, gains: Array) -> bool:
    """Fill in the outputs of constant gains, sums included, whose inputs are known; return whether there were any."""
    changed = False
    for block, rows, place in zip(network.blocks, network.inputs, network.outputs, strict=True):
        if block.linear and not block.system.nstates and np.isnan(gains[place]).any():
            weights = _weights(np.asarray(block.system.D, dtype=float) @ network.wire[rows], gains)
            if weights is not None:
                gains[place], changed = weights, True
    return changed


def _weights(wire: Array, gains: Array) -> Array | None:
    """Gains of sums of signals; None if one of these is unknown."""
    used = np.flatnonzero(wire.any(axis=0))
    found = wire[:, used] @ gains[used]
    return None if np.isnan(found).any() else found


def _products(weights: Array, ends: tuple[Array, Array]) -> Iterator[Array]:
    """Both ends (2, width) of each term of weighted sums, from those of the signals; the smaller may be either."""
    for j in np.flatnonzero(weights.any(axis=0)).tolist():
        used = weights[:, j] != 0.0
        yield np.stack([np.where(used, np.where(used, weights[:, j], 1.0) * end[j], 0.0) for end in ends])
