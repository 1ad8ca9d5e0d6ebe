"""Limits by name: which signal of a plan, plant or loop a name means."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from ctrlplan._checks import check_kind, default_labels
from ctrlplan._types import Array
from ctrlplan.planning.bounds import Bound, Limits, Region, Signal, is_listed
from ctrlplan.planning.quantities import Quantities
from ctrlplan.trajectories import Trajectory, derivative_name
from ctrlplan.trajectories.waypoint import ENTRIES

_HIGHEST = 8
"""Maximum order of the derivatives with limits."""

_FORMS = "a tuple (minimum, maximum) applies to every axis, a list of one number per axis gives magnitudes"

_ARRAYS = (
    "compute with arrays (ntime,), such as np.where(a > 0, a, b) instead of if, or np.sin(a) instead of math.sin(a)"
)

_BOTH = 'write {"plan": {...}, "loop": {...}}'


class LoopNames(Protocol):
    """Names of the signals of a loop, and of its inputs in order."""

    @property
    def names(self) -> Sequence[str]:
        """Inputs, outputs and exposed states."""

    @property
    def inputs(self) -> Sequence[str]:
        """Inputs in order."""


@dataclass(frozen=True)
class Naming:
    """Meaning of names: signals of a plan, of a plant along it, and of a loop.

    Attributes
    ----------
    plan : Trajectory
        The plan.
    quantities : callable or None
        Maps a jet to signals of a plant.
    loop : LoopNames or None
        Names of the signals of a loop.
    naxes : int or None
        Number of the first axes to which names of derivatives of all axes refer;
        None for all.
    """

    plan: Trajectory
    quantities: Quantities | None = None
    loop: LoopNames | None = None
    naxes: int | None = None

    def bounds(self, limits: Mapping[str, object]) -> Iterator[Bound]:
        """Bounds from limits by name."""
        if not any(isinstance(limits.get(whose), Mapping) for whose in ("plan", "loop")):
            return self._bounds(limits, self._named)
        return self._of_both(limits)

    def _of_both(self, limits: Mapping[str, object]) -> Iterator[Bound]:
        """Bounds from limits of plan and loop apart."""
        others = [name for name in limits if name not in ("plan", "loop")]
        if others:
            raise ValueError(
                f'limits must be by name, or {{"plan": limits by name, "loop": limits by name}}, got {others[0]!r}'
            )
        if "loop" in limits and self.loop is None:
            raise ValueError('limits of "loop" must be given with a loop as system, got none')
        for name, find in (("plan", self._of_plan), ("loop", self._of_loop)):
            own = limits.get(name, {})
            check_kind(own, f"limits of {name}", Mapping, "a mapping of names to limits")
            yield from self._bounds(own, find)  # type: ignore[arg-type]

    def _bounds(self, limits: Mapping[str, object], find: Callable[[str], Signal | None]) -> Iterator[Bound]:
        for name, limit in limits.items():
            if isinstance(limit, Region):
                pair = [self._known(own, find) for own in limit.signals]
                inside = [signal.loop for signal in pair]
                if len(set(inside)) > 1:
                    outer = pair[inside.index(False)].name
                    raise ValueError(
                        f"signals of the region {name} must both be of the loop or both of the plan, got "
                        f"{pair[inside.index(True)].name} of the loop and {outer} of the plan; make {outer} an output "
                        "of the loop"
                    )
                yield from limit.bounds(name, pair)
                continue
            if name in ENTRIES and find(name) is None and find != self._of_loop:
                order = ENTRIES.index(name)
                rows = _by_axis(name, limit, self.naxes or self.plan.naxes)
                for axis, own in enumerate(rows):
                    if not axis or own is not rows[axis - 1]:  # the same limit of several axes is read once
                        given = _read(name, own, True)
                    signal = Signal(derivative_name(self.plan.labels[axis], order), order, axis)
                    yield from _of_signal(name, given, signal)
                continue
            signal = self._known(name, find)
            several = isinstance(limit, list | tuple) and len(limit) and all(isinstance(own, Limits) for own in limit)
            for own in limit if several else [limit]:  # type: ignore[attr-defined]
                yield from _of_signal(name, _read(name, own, signal.axis is not None), signal)

    def _known(self, name: str, find: Callable[[str], Signal | None]) -> Signal:
        found = find(name)
        if found is not None:
            return found
        axes = ", ".join(derivative_name(label, 1) for label in self.plan.labels)
        derivatives = f"derivatives of an axis ({axes}, ...), or velocity, acceleration, jerk or snap for all axes"
        if self.loop is not None:
            signals = f"signals of the loop ({', '.join(self.loop.names)})"
            if find == self._of_loop:
                raise ValueError(f"limits must name {signals}, got {name!r}")
            default = f"; for the axis of the plan {_BOTH}" if name in self.plan.labels else ""
            raise ValueError(f"limits must name {signals}, {derivatives}, got {name!r}{default}")
        plain = [quantity for quantity in self._orders if "_d" not in quantity]
        known = (
            f", or quantities ({', '.join(plain)}, ...)"
            if self._orders
            else "; other names require system, and no system was given"
        )
        raise ValueError(f"limits must name {derivatives}{known}, got {name!r}")

    def _named(self, name: str) -> Signal | None:
        """Signal of a name: of the loop if there is one with that name."""
        if self.loop is None:
            return self._of_plan(name)
        meant, unnamed = self._derivative(name), self.plan.labels == default_labels(self.plan.naxes)
        if name not in self.loop.names:  # such as y, the default label, with a loop whose output is y[0]
            return None if unnamed and meant is not None and not meant.order else self._of_plan(name)
        if meant is not None and not unnamed:
            inputs = list(self.loop.inputs)
            in_order = len(inputs) == self.plan.naxes and set(inputs) != set(self.plan.labels)
            fed = name in inputs and (not in_order or (not meant.order and inputs[meant.axis or 0] == name))
            if not fed:
                raise ValueError(
                    f"limits must say whose signal {name} is, got a name of the plan (its labels are "
                    f"{', '.join(self.plan.labels)}) and of the loop; {_BOTH}"
                )
        return self._of_loop(name)

    def _of_loop(self, name: str) -> Signal | None:
        return Signal(name, loop=True) if self.loop is not None and name in self.loop.names else None

    def _of_plan(self, name: str) -> Signal | None:
        derivative = self._derivative(name)
        if derivative is not None:
            return derivative
        if name in ENTRIES:
            return None
        return Signal(name, self._orders[name]) if name in self._orders else None

    def _derivative(self, name: str) -> Signal | None:
        """Derivative of an axis of a name; None if it is not one."""
        place = self._derivatives.get(name)
        return None if place is None else Signal(name, *place)

    @cached_property
    def _derivatives(self) -> dict[str, tuple[int, int]]:
        """Orders and axes of derivatives by name."""
        return {
            derivative_name(label, k): (k, axis)
            for k in range(_HIGHEST + 1)
            for axis, label in enumerate(self.plan.labels)
        }

    @cached_property
    def _orders(self) -> dict[str, int]:
        return {} if self.quantities is None else _orders(self.quantities, self.plan)


def _read(name: str, limit: object, of_axis: bool) -> Limits:
    """Limits of one signal in any form; messages about those of a derivative of an axis name the forms."""
    try:
        return Limits.of(limit, name)
    except ValueError as error:
        lone = of_axis and not isinstance(limit, Limits) and not is_listed(limit)
        raise ValueError(f"{error}{f'; {_FORMS}' if lone else ''}") from None


def _of_signal(name: str, given: Limits, signal: Signal) -> Iterator[Bound]:
    """Bounds of one signal from its limits."""
    for bound in given.bounds(signal.name, signal):
        moving = signal.axis is not None and signal.order and bound.kind == "value" and bound.is_constant
        if moving and not bound.low <= 0.0 <= bound.high:
            raise ValueError(
                f"limits of {name} must include 0, the value at rest, got from {bound.low:g} to {bound.high:g}; "
                f"{_FORMS}"
            )
        if bound.kind == "rate" and signal.axis is not None:  # that of a derivative is the next one, with exact extrema
            following = replace(signal, order=signal.order + 1)
            yield replace(bound, terms=((following, 1.0),), kind="value")
        else:
            yield bound


def _by_axis(name: str, limit: object, naxes: int) -> list[object]:
    """Limits of each axis from those of all axes."""
    if isinstance(limit, str | Mapping) or not np.iterable(limit):
        return [limit] * naxes
    rows, given = list(limit), isinstance(limit, tuple)
    flat = not any(map(np.iterable, rows))
    if flat and len(rows) == 2 and (given or naxes == 1):
        return [tuple(rows)] * naxes
    if len(rows) == naxes and (not given if flat else [np.size(row) for row in rows] == [2] * naxes):
        return rows
    mixed = len(rows) == naxes and not flat and not all(map(np.iterable, rows))
    further = "; give a pair for every axis, (-a, a) instead of the number a" if mixed else f"; {_FORMS}"
    raise ValueError(
        f"limits of {name} must be a number, a pair, or {naxes} numbers or pairs by axis, got {limit!r}{further}"
    )


def _orders(quantities: Quantities, plan: Trajectory) -> dict[str, int]:
    """Lowest order of the jet that each quantity depends on: at rest at the start, or within a plan in motion."""
    still = np.zeros((_HIGHEST + 1, plan.naxes, 1))
    still[0] = plan.initial[:, None]
    orders, rejection = _accepted(quantities, still)
    if not orders:  # as those of a vehicle, whose heading is not determined at rest
        moving = plan.jet(np.array([0.5 * (plan.breakpoints[0] + plan.breakpoints[1])]), _HIGHEST)
        orders, rejection = _accepted(quantities, moving)
    if not orders:
        raise ValueError(
            f"quantities must accept jets (order + 1, {plan.naxes}, ntime) of up to {_HIGHEST} derivatives, got "
            f"{type(rejection).__name__}: {rejection}{f'; {_ARRAYS}' if isinstance(rejection, TypeError) else ''}"
        ) from rejection
    return orders


def check_times(quantities: Quantities, plan: Trajectory, order: int) -> None:
    """Raise for quantities that accept a jet of one time of a plan, but not one of the same time twice."""
    jet = plan.jet(np.array([0.5 * (plan.breakpoints[0] + plan.breakpoints[1])]), order)
    with np.errstate(all="ignore"):
        try:
            quantities(jet)
        except ValueError:  # infeasible there
            return
        try:
            quantities(np.repeat(jet, 2, axis=2))
        except (ValueError, TypeError) as reason:
            raise ValueError(
                f"quantities must accept jets ({order + 1}, {plan.naxes}, ntime) of several times, got "
                f"{type(reason).__name__}: {reason}; {_ARRAYS}"
            ) from reason


def _accepted(quantities: Quantities, jet: Array) -> tuple[dict[str, int], Exception | None]:
    """Lowest order of a jet with which quantities are defined, and why those of other orders are not."""
    orders: dict[str, int] = {}
    rejection: Exception | None = None
    for order in range(len(jet)):
        try:
            with np.errstate(all="ignore"):
                found = quantities(jet[: order + 1])
        except (ValueError, IndexError, KeyError, TypeError) as reason:  # it depends on higher orders
            rejection = reason
            continue
        if not isinstance(found, Mapping):
            raise TypeError(f"quantities must return a mapping of names to signals, got {type(found).__name__}")
        for name in found:
            orders.setdefault(name, order)
    return orders, rejection
