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
from ctrlplan.trajectories.common import Array

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
        self.bounds = [b for b in limited.loop_bounds if b.kind != "rms" and b.profile is None]
        self._others = len(self.bounds) < len(limited.bounds)
        signals = [(_weights(b), b.kind == "rate", _during(b, plan)) for b in self.bounds]
        self._family = shapes.shapes_of(plan, signals)
        self.sides = _sides(self.bounds)
        _check_ends(plan, self.bounds, self._family.before, "before the plan")
        _check_ends(plan, self.bounds, self._family.final, "after the plan")
        also = self._excess_of_others if self._others else None
        self.search = DurationSearch(self._family, self.sides, resolution, also)

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
        found = self.search.shortest(low, high) if low < high else (high if self.search.worst(high) <= 0.0 else None)
        if found is None:
            self._reject(low, high)
        return found, (low, found)

    def _span(self, minimum: float) -> tuple[float, float]:
        """Durations between which the shortest feasible one lies."""
        least = max(self._excluded(), minimum)
        high = max(self._plan.duration, least)
        feasible = self.search.worst(high) <= 0.0
        while feasible and 0.5 * high > least and self.search.worst(0.5 * high) <= 0.0:
            high *= 0.5
            self._check_not_instant(high)
        for _ in range(_DOUBLINGS):
            if feasible or self._is_too_slow(high):
                break
            high *= 2.0
            feasible = self.search.worst(high) <= 0.0
        else:
            self._reject(least, high)
        low = least or high
        while not least and (low == high or self.search.worst(low) <= 0.0):
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
            found = self.sides.worst(low, high) * self.sides.scale / rates[self.sides.signal]
        return float(np.where(np.isfinite(found), found, 0.0).max(initial=0.0))

    def _is_too_slow(self, duration: float) -> bool:
        """Whether no longer plan is feasible, since the static response to the plan violates a limit."""
        excess = self.sides.worst(*self._family.static()) * self.sides.scale
        distance = self._family.from_static(np.array([duration]))[0, self.sides.signal]
        return bool(np.any(excess > distance))

    def _excess_of_others(self, duration: float) -> float:
        return self._limited.exact_excess(self._plan.retime(duration))

    def _reject(self, low: float, high: float) -> NoReturn:
        nearest = self.search.nearest(low, high)
        worst = self._limited.margins(self._plan.retime(nearest)).active
        further = "for a wider search pass durations=(low, high)"
        if self._is_too_slow(high):
            further = "longer plans violate the limits as well, since the static response to the path does"
        raise ValueError(
            f"limits must be satisfied for some duration from {low:.4g} to {high:.4g} s, got none; nearest at "
            f"{nearest:.4g} s: {worst}; {further}"
        )


def _weights(bound: Bound) -> dict[str, float]:
    return {signal.name: factor for signal, factor in bound.terms}


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


def _check_ends(plan: Trajectory, bounds: Sequence[Bound], values: Array, when: str) -> None:
    """Raise if a limit is violated at rest, whatever the duration."""
    for bound, value in zip(bounds, values.tolist(), strict=True):
        if bound.interval is None and math.isfinite(value) and float(bound.excess(np.array([value]))[0]) > 0.0:
            position = plan.initial if when.startswith("before") else plan.final
            place = ", ".join(f"{label} = {x:.4g}" for label, x in zip(plan.labels, position.tolist(), strict=True))
            raise ValueError(
                f"limits must be satisfied at rest, at any duration, got {bound.name} = {value:.6g} in steady state "
                f"{when}, at {place}, where it must be {bound.range}"
            )
