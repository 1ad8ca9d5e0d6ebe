"""Plan of minimum duration, with its shape fixed, under limits on signals of a loop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NoReturn

import numpy as np

from ctrlplan.planning.bounds import Bound
from ctrlplan.planning.limits import Limited
from ctrlplan.planning.loop_search import DurationSearch, Sides
from ctrlplan.planning.quantities import Shapes
from ctrlplan.trajectories import Trajectory

_DOUBLINGS = 40
"""Maximum number of times by which the duration is doubled until all limits are satisfied."""

_OCTAVES = 6
"""Number of octaves below a feasible duration that are searched where no shorter one is excluded otherwise."""


class LoopProblem:
    """Limits of a plan and of signals of a loop, as functions of the duration of the plan.

    Parameters
    ----------
    plan : Trajectory
        Plan whose shape is fixed.
    limited : Limited
        Limits, some of them of signals of a loop.
    shapes : Shapes
        Signals of the loop for plans of a fixed shape.
    resolution : float
        As for `fastest`.
    """

    def __init__(self, plan: Trajectory, limited: Limited, shapes: Shapes, resolution: float) -> None:
        self._plan, self._limited = plan, limited
        bounds = bounds_of_values(limited)
        self._family = shapes.shapes_of(plan, [(b.weights, b.kind == "rate", _during(b, plan)) for b in bounds])
        self._sides = _sides(bounds)
        # Limits of derivatives and positions at all times are satisfied from a minimum duration on.
        others = [b for b in limited.bounds if b not in bounds and not (b.is_constant and b.axis is not None)]
        self._others = ", ".join(b.name for b in others)
        self._search = DurationSearch(self._family, self._sides, resolution, self._excess_of_others if others else None)
        self._resolution = resolution

    def statement(self, low: float, shortest: float, minimum: float) -> str:
        """What is known of durations below the shortest one that was found; `minimum` as for `shortest`."""
        if shortest <= (1.0 + 1e-9) * low:
            return "every shorter one violates a limit of the plan" if low <= minimum else "shorter ones not searched"
        found = (
            f"no duration from {low:.4g} s to {shortest:.6g} s satisfies every limit with a margin above "
            f"{self._resolution:g} of its range"
        )
        if self._search.widest:
            found += f"; {self._others} evaluated at durations at most {100.0 * self._search.widest:.2g} % apart"
        return found

    def shortest(self, span: tuple[float, float] | None, minimum: float) -> tuple[float, tuple[float, float]]:
        """Minimum duration, and the interval of durations in which no shorter one was found.

        Parameters
        ----------
        span : (float, float) or None
            Interval of durations [s] of the search.
        minimum : float
            Duration [s] below which another limit is violated.
        """
        low, high = span or self._span(minimum)
        low = max(low, min(minimum, high))
        found = self._search.shortest(low, high) if low < high else (high if self._search.worst(high) <= 0.0 else None)
        if found is None:
            self._reject(low, high)
        return found, (low, found)

    def _span(self, minimum: float) -> tuple[float, float]:
        """Durations between which the shortest feasible one lies."""
        least = max(self._excluded(), minimum)
        high = max(self._plan.duration, least)
        feasible = self._search.worst(high) <= 0.0
        while feasible and 0.5 * high > least and self._search.worst(0.5 * high) <= 0.0:
            high *= 0.5
            self._check_not_instant(high)
        for _ in range(_DOUBLINGS):
            if feasible or self._is_too_slow(high):
                break
            high *= 2.0
            feasible = self._search.worst(high) <= 0.0
        else:
            self._reject(least, high)
        low = least or high
        while not least and (low == high or self._search.worst(low) <= 0.0):
            low /= 2.0**_OCTAVES
            self._check_not_instant(low)
        return low, high

    def _check_not_instant(self, duration: float) -> None:
        if duration < 1e-12 * self._plan.duration:
            raise ValueError(
                f"limits must include one that a shorter plan would violate, got none: a plan of {duration:.3g} s "
                "satisfies all of them; pass durations=(low, high) for a search between two durations"
            )

    def _excluded(self) -> float:
        """Duration [s] below which a limit is violated, since the response differs too little from that to a step."""
        low, high, rates = self._family.step()
        with np.errstate(divide="ignore", invalid="ignore"):
            found = self._sides.worst(low, high) * self._sides.scale / rates[self._sides.signal]
        return float(np.where(np.isfinite(found), found, 0.0).max(initial=0.0))

    def _is_too_slow(self, duration: float) -> bool:
        """Whether no longer plan is feasible, since the static response to the plan violates a limit."""
        excess = self._sides.worst(*self._family.static()) * self._sides.scale
        distance = self._family.from_static(np.array([duration]))[0, self._sides.signal]
        return bool(np.any(excess > distance))

    def _excess_of_others(self, duration: float) -> float:
        return self._limited.exact_excess(self._plan.retime(duration))

    def _reject(self, low: float, high: float) -> NoReturn:
        nearest = self._search.nearest(low, high)
        worst = self._limited.margins(self._plan.retime(nearest)).active
        further = "for a wider search pass durations=(low, high)"
        if self._is_too_slow(high):
            further = "longer plans violate the limits as well, since the static response to the path does"
        raise ValueError(
            f"limits must be satisfied for some duration from {low:.4g} to {high:.4g} s, got none; nearest at "
            f"{nearest:.4g} s: {worst}; {further}"
        )


def bounds_of_values(limited: Limited) -> list[Bound]:
    """Constant limits of signals of a loop and of their rates, whose extrema are functions of the duration."""
    return [b for b in limited.loop_bounds if b.kind != "rms" and b.profile is None]


def _during(bound: Bound, plan: Trajectory) -> tuple[float, float] | None:
    """Interval of a bound in fractions of the plan."""
    if bound.interval is None:
        return None
    first, last = ((t - plan.start) / plan.duration for t in bound.interval)
    return first, last


def _sides(bounds: Sequence[Bound]) -> Sides:
    """Limits of signals, one for each side."""
    rows = []
    for k, b in enumerate(bounds):
        scale = b.high - b.low if math.isfinite(b.high - b.low) else b.scale
        for sign, limit in ((1.0, b.high), (-1.0, b.low)):
            if math.isfinite(limit):
                rows.append((float(k), sign, limit, scale, b.slack * b.scale / scale))
    table = np.array(rows).reshape(-1, 5)
    return Sides(table[:, 0].astype(np.intp), table[:, 1], table[:, 2], table[:, 3], table[:, 4])
