"""Limits at positions of a path, for a plan with another time law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctrlplan.planning.bounds import Bound
from ctrlplan.trajectories import Retimed
from ctrlplan.trajectories.batches import inner_extrema
from ctrlplan.trajectories.common import Array

_FAR = 100.0
"""Distance from limits, in their scale, beyond which it is not resolved."""

SHARE_INSIDE = 1e-9
"""Distance from the ends of a cell, relative to it, at which limits that jump there are evaluated."""


def maximum_excess(bound: Bound, plan: Retimed, start: float, rate: float = 1.0) -> tuple[Array, Array]:
    """Maximum excess over the lower and the upper limit (2,) of a derivative, in their scale, and its times [s].

    Parameters
    ----------
    bound : Bound
        Limits by the time of the given plan.
    plan : Retimed
        The given plan, possibly shifted, with another time law.
    start : float
        Start [s] of the given plan.
    rate : float, optional
        Duration of the given plan relative to that of `plan` without the law.
    """

    def excess(values: Array, low: Array, high: Array) -> Array:
        return np.maximum(np.stack([low - values, values - high]) / bound.scale, -_FAR)

    return _maxima(bound, plan, start, excess, rate)


def required_rate(bound: Bound, plan: Retimed, start: float) -> tuple[float, float]:
    """Factor by which a plan must be slower for a limit of a derivative to be satisfied, and where it must be.

    The place is a time [s] of the given plan.
    """

    def share(values: Array, low: Array, high: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.stack([values / high, values / low])
        return np.where(np.isfinite(shares), np.maximum(shares, 0.0), 0.0)

    shares, times = _maxima(bound, plan, start, share)
    worst = int(shares.argmax())
    return float(shares[worst]) ** (1.0 / bound.order), start + float(plan.law(times[worst])) - plan.plan.start


@dataclass(frozen=True)
class _Rows:
    """Two functions of a derivative and its limits, with the interface that `inner_extrema` reads."""

    bound: Bound
    plan: Retimed
    start: float
    function: Callable[[Array, Array, Array], Array]
    rate: float
    naxes: int = 2

    @property
    def breakpoints(self) -> Array:
        return self.plan.breakpoints

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Values (1, 2, ntime)."""
        first, last = self.breakpoints[segments], self.breakpoints[segments + 1]
        inside = first + np.clip(s / (last - first), SHARE_INSIDE, 1.0 - SHARE_INSIDE) * (last - first)
        low, high = self.bound.sides(self.start + self.rate * (self.plan.law(inside) - self.plan.plan.start))
        values = self.plan.segments_jet(segments, s, self.bound.order)[self.bound.order, self.bound.axis or 0]
        return self.function(values, low, high)[None]


def _maxima(
    bound: Bound, plan: Retimed, start: float, function: Callable[[Array, Array, Array], Array], rate: float = 1.0
) -> tuple[Array, Array]:
    """Maxima of two functions over a plan, and their times [s]."""
    rows, durations = _Rows(bound, plan, start, function, rate), np.diff(plan.breakpoints)
    segments = np.arange(durations.size)
    ends = np.concatenate([rows.segments_jet(segments, share * durations, 0)[0] for share in (0.0, 1.0)], axis=1)
    inner, s = inner_extrema(rows, 0, ends.min(axis=1), ends.max(axis=1))
    values = np.concatenate([ends, rows.segments_jet(inner, s, 0)[0]], axis=1)
    times = np.concatenate([plan.breakpoints[:-1], plan.breakpoints[1:], plan.breakpoints[inner] + s])
    best = values.argmax(axis=1)
    return values[[0, 1], best], times[best]
