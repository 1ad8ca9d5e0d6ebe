"""Limits that the actuators of a loop declare, and how far its runs use them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ctrlplan._types import System
from ctrlplan.studies.measures import signals_of
from ctrlplan.traits import traits_of

if TYPE_CHECKING:  # comparisons show their limits
    from ctrlplan.studies.comparison import Comparison

_AT_LIMIT = 1e-9
"""Distance from a limit, relative to its magnitude, within which a signal is at the limit."""


@dataclass(frozen=True)
class LimitUse:
    """How far one run uses one limit.

    Attributes
    ----------
    plan, signal : str
        The run and the output.
    low, high : float
        The limits; one may be infinite.
    value, time : float
        Value nearest to a limit, and its time [s].
    margin : float
        Distance from that limit, negative beyond it.
    at_limit : float
        Share of the run in which the signal is at a limit or beyond.
    """

    plan: str
    signal: str
    low: float
    high: float
    value: float
    time: float
    margin: float
    at_limit: float

    @property
    def limit(self) -> float:
        """The limit that `value` is nearest to."""
        return self.high if abs(self.high - self.value) <= abs(self.value - self.low) else self.low

    @property
    def share(self) -> float:
        """Margin relative to the magnitude of the limit; nan where that is 0."""
        return self.margin / abs(self.limit) if self.limit else math.nan


def limits_used(comparison: Comparison) -> list[LimitUse]:
    """Use of every declared limit by each run of a comparison, the active limit of each plan first."""
    found = []
    for plan, response in comparison.responses.items():
        limits, signals, t = comparison.limits.get(plan, {}), signals_of(response), np.asarray(response.time)
        uses = []
        for signal, (low, high) in limits.items():
            row = signals[signal]
            room = np.minimum(high - row, row - low)
            if not np.isfinite(room).any():
                continue
            at = int(np.nanargmin(room))
            size = max((abs(limit) for limit in (low, high) if math.isfinite(limit)), default=0.0)
            near = np.interp(0.5 * (t[1:] + t[:-1]), t, room) <= _AT_LIMIT * size
            share = float(np.diff(t)[near].sum() / np.ptp(t)) if t.size > 1 else 0.0
            use = LimitUse(plan, signal, low, high, float(row[at]), float(t[at]), float(room[at]), share)
            uses.append(use)
        found += sorted(uses, key=lambda use: use.share if math.isfinite(use.share) else math.inf)
    return found


def limits_sentence(comparison: Comparison) -> str:
    """Whether the declared limits of actuators are satisfied, in a sentence."""
    uses = limits_used(comparison)
    if not uses:
        return "No actuator limits are declared."
    violated = [use for use in uses if use.share < -_AT_LIMIT]
    if violated:
        return f"Actuator limits: violated by {', '.join(f'{use.signal} ({use.plan})' for use in violated)}."
    reached = [f"{use.signal} ({use.plan})" for use in uses if use.at_limit > 0.0]
    said = f"; reached: {', '.join(reached)}" if reached else ""
    plans = list(dict.fromkeys(use.plan for use in uses))
    only = f" (declared for {', '.join(plans)} only)" if len(plans) < len(comparison.plans) else ""
    return f"Actuator limits{only}: satisfied{said}."


def limits_of(loop: System) -> dict[str, tuple[float, float]]:
    """Limits of a loop's outputs by their labels.

    Parameters
    ----------
    loop : control system
        Loop with PID controllers and saturations, also inside nested networks,
        that declare their limits.

    Returns
    -------
    dict of str to (float, float)
        Minimum and maximum in the unit of the output; one may be infinite.
        Outputs without limits are omitted.
    """
    found: dict[str, tuple[float, float]] = {}
    blocks = getattr(loop, "syslist", None) or ()
    for block in blocks:
        found |= limits_of(block)
    for name, (_, low, high) in (traits_of(loop).watched or {}).items():
        found[name] = (float(low), float(high))
    # A plant may declare limits of its inputs, which are outputs of the network around it.
    known = [*(loop.output_labels or ()), *(() if blocks else loop.input_labels or ())]
    return {name: pair for name, pair in found.items() if name in known}
