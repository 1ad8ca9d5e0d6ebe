"""Maximum length of the segments of a numerical run, and a warning where delays make it very short."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from ctrlplan._renamed import outside_stacklevel
from ctrlplan.simulation.delayed_signals import DelayedSignal, HeldDelaySignal
from ctrlplan.simulation.known_delays import KnownDelaySignal
from ctrlplan.simulation.network import Network
from ctrlplan.simulation.signals import TimeSignal

_SHORTEST_DELAY, _SHORT_DELAY = 1e-5, 1e-4
"""Minimum delay, relative to the run, of a signal that is found in the run, and the one below which it is reported."""

_INSTEAD = (
    "use a longer delay, a Pade approximation of it (ct.tf(*ct.pade(delay, n))) or a shorter run, or leave out "
    "the delay"
)
"""Ways to a run in fewer segments, for messages."""

_SEGMENTS = 2_000
"""Maximum number of segments that the declared `longest` step of blocks may cause."""


def longest_segment(network: Network, delays: list[float], duration: float) -> float:
    """Maximum length of a segment [s], from the delays and the declarations of the blocks."""
    longest = min([duration, *delays])
    if longest < _SHORTEST_DELAY * duration:
        raise ValueError(
            f"a delay must be at least {_SHORTEST_DELAY:g} of the run of {duration:g} s, got {longest:g} s: the signal "
            f"before it is found during the run, which ends a segment after each delay; {_INSTEAD}"
        )
    declared = min((block.traits.longest for block in network.blocks), default=np.inf)
    return min(longest, max(declared, duration / _SEGMENTS))


def warn_of_short_delays(network: Network, time_signals: Sequence[TimeSignal], duration: float) -> None:
    """Warn of a delay that divides a run into very many segments."""
    late = [signal for signal in time_signals if isinstance(signal, DelayedSignal | KnownDelaySignal)]
    lengths = [
        (signal.delay, network.blocks[i].name)
        for signal, i in zip(late, network.blocks_with("delay"), strict=True)
        if isinstance(signal, DelayedSignal) and not isinstance(signal, HeldDelaySignal)
    ]
    delay, name = min(lengths, default=(math.inf, ""))
    if _SHORTEST_DELAY * duration <= delay < _SHORT_DELAY * duration:
        warnings.warn(
            f"the delay {name} of {delay:g} s divides the run of {duration:g} s into {math.ceil(duration / delay)} "
            f"segments, since the signal before it is found during the run, which takes long; {_INSTEAD}",
            UserWarning,
            stacklevel=outside_stacklevel(),
        )
