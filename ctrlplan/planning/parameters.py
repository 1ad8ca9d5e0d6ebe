"""Limits over ranges of parameters of a plant, or of a function that returns a loop or a flat system."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctrlplan._checks import check_kind, checked_finite, checked_pair
from ctrlplan.planning.bounds import Bound
from ctrlplan.planning.limits import Limited, Margin, Margins
from ctrlplan.planning.quantities import Quantities, quantities_of
from ctrlplan.planning.structure import Rational, as_rational, values_at
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import Array

_POINTS = 256
"""Number of points that are sampled: corners, centre and a Latin hypercube."""

_STARTS = 6
"""Number of points from which a pattern search begins, for each limit."""

_STEPS = (0.15, 0.075, 0.0375, 0.01875, 0.009375, 0.005)
"""Steps of the pattern search, relative to the ranges."""

_PROVED = "proved"
"""Coverage of ranges whose worst case is at a corner, by the operations of the quantity."""

_EXACT = 3
"""Number of points at which the margin of a limit is evaluated exactly."""

_MOST_CORNERS = 8
"""Maximum number of ranges whose corners are all evaluated."""

_AGREEMENT = 1e-8
"""Relative difference up to which a traced dependence agrees with the system."""

Point = tuple[float, ...]
"""Values of the parameters with ranges, in 0 to 1 of each."""


@dataclass(frozen=True)
class Family:
    """Systems over ranges of parameters.

    Attributes
    ----------
    build : callable
        Returns a system from parameters by keyword.
    ranges : mapping of str to (float, float)
        Parameters with a range.
    fixed : mapping of str to float
        Parameters with a value.
    """

    build: Callable[..., Any]
    ranges: Mapping[str, tuple[float, float]]
    fixed: Mapping[str, float]

    @classmethod
    def of(cls, system: Any, params: Mapping[str, object]) -> Family:
        """Systems from the arguments ``system`` and ``params`` of `margins`.

        Raises
        ------
        TypeError
            If the system has no parameters by name.
        ValueError
            If a parameter is unknown, or a range is not one.
        """
        check_kind(params, "params", Mapping, "a mapping of names to numbers or pairs")
        build, known, required, anything = _builder(system)
        for name in params:
            if not isinstance(name, str) or (name not in known and not anything):
                names = ", ".join(known) or "none"
                raise ValueError(f"params must be among the parameters of {_name(system)} ({names}), got {name!r}")
        missing = [name for name in required if name not in params]
        if missing:
            raise ValueError(f"params must give {', '.join(missing)}, which {_name(system)} requires, got none")
        ranges, fixed = {}, {}
        for name, given in params.items():
            if isinstance(given, tuple | list | np.ndarray):
                low, high = checked_pair(given, f"params[{name!r}]")
                if not math.isfinite(high - low):
                    raise ValueError(f"params[{name!r}] must be finite, got {low:g} to {high:g}")
                ranges[name] = (low, high)
            else:
                fixed[name] = checked_finite(given, f"params[{name!r}]")
        return cls(build, ranges, fixed)

    def values(self, point: Point) -> dict[str, float]:
        """Values of all parameters at a point."""
        own = {name: low + x * (high - low) for x, (name, (low, high)) in zip(point, self.ranges.items(), strict=True)}
        return {**self.fixed, **own}

    def system(self, values: Mapping[str, Any]) -> Any:
        """System with parameters by name."""
        found = self.build(**values)
        kinds = ("quantities", "quantities_of", "forward", "ninputs")
        if not any(hasattr(found, kind) for kind in kinds) and not callable(found):
            raise TypeError(f"system must return a loop or a flat system, got {type(found).__name__}")
        return found

    def limited(self, plan: Trajectory, limits: Mapping[str, object], point: Point, tail: float | None) -> Limited:
        """Limits of a plan with the system at a point."""
        values = self.values(point)
        return _told(values, lambda: Limited(plan, limits, self.system(values), tail))

    def point(self, values: Mapping[str, float]) -> Point:
        """Point of values of the parameters with ranges; the centre for a limit that does not depend on them."""
        if not values:
            return self.centre
        return tuple((values[name] - low) / (high - low) for name, (low, high) in self.ranges.items())

    @property
    def corners(self) -> list[Point]:
        """Corners of the ranges."""
        return list(itertools.product((0.0, 1.0), repeat=len(self.ranges)))

    @property
    def centre(self) -> Point:
        """Middle of the ranges."""
        return (0.5,) * len(self.ranges)


def _told(values: Mapping[str, float], function: Callable[[], Any]) -> Any:
    """Result of a function; its errors state the parameters."""
    try:
        return function()
    except (ValueError, RuntimeError) as error:
        said = ", ".join(f"{name} = {value:g}" for name, value in values.items())
        raise type(error)(f"{error} (at {said})") from error


def _builder(system: Any) -> tuple[Callable[..., Any], list[str], list[str], bool]:
    """Function from parameters to a system, its known and required parameters, and whether it takes any."""
    if dataclasses.is_dataclass(system) and not isinstance(system, type):
        names = [field.name for field in dataclasses.fields(system) if field.init]
        return (lambda **values: replace(system, **values)), names, [], False
    if not isinstance(system, type) and hasattr(system, "with_params"):
        return (lambda **values: system.with_params(values)), list(system.params), [], False
    made = any(hasattr(system, kind) for kind in ("quantities_of", "ninputs"))
    if isinstance(system, type) or (callable(system) and not made):
        try:
            parameters = inspect.signature(system).parameters.values()
        except (TypeError, ValueError):
            raise TypeError(f"system must have parameters by name, got {_name(system)} without a signature") from None
        named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        for p in parameters:
            if p.kind is p.POSITIONAL_ONLY and p.default is p.empty:
                raise TypeError(f"parameters of {_name(system)} must be accepted by keyword, got {p.name} by position")
        required = [p.name for p in named if p.default is p.empty]
        return system, [p.name for p in named], required, any(p.kind is p.VAR_KEYWORD for p in parameters)
    raise TypeError(
        "with params, system must be a plant with parameters by name (as Crane has), a flat system from equations, or "
        f"a function that takes them by keyword and returns a loop or a flat system, got {_name(system)}"
    )


def _name(system: Any) -> str:
    return str(getattr(system, "__name__", type(system).__name__))


def margins_over(
    plan: Trajectory,
    limits: Mapping[str, object],
    family: Family,
    tail: float | None = None,
    given: Trajectory | None = None,
) -> Margins:
    """Margins of a plan over ranges of parameters, with the worst parameters of each limit.

    Parameters
    ----------
    plan, limits
        As for `margins`.
    family : Family
        The systems.
    tail : float, optional
        As for `margins`.
    given : Trajectory, optional
        Plan for which limits over time are given; default: `plan`.
    """
    given = plan if given is None else given
    nominal = family.limited(given, limits, family.centre, tail)
    nominal.check_smooth(plan)
    if not family.ranges:
        return _told(family.fixed, lambda: nominal.margins(plan))
    return _Search(plan, given, limits, family, nominal, tail).margins()


class _Search:
    """Worst margins of each limit over ranges of parameters."""

    def __init__(
        self,
        plan: Trajectory,
        given: Trajectory,
        limits: Mapping[str, object],
        family: Family,
        nominal: Limited,
        tail: float | None,
    ) -> None:
        self._plan, self._given, self._limits, self._family = plan, given, limits, family
        self._nominal, self._tail = nominal, tail
        self._samples = nominal.sampled(plan)
        self._known: dict[Point, Array] = {}
        self._rows: dict[Point, tuple[Margin, ...]] = {}

    def margins(self) -> Margins:
        """Worst margins, labelled as proved or sampled."""
        bounds = self._nominal.bounds
        proved = proved_bounds(self._plan, self._family, self._nominal)
        open_ones = [k for k, sure in enumerate(proved) if not sure]
        rows = []
        for k, bound in enumerate(bounds):
            if _of_plan(bound):
                rows.append(replace(self._exact(self._family.centre)[k], parameters={}, coverage=_PROVED))
            elif proved[k]:
                found = min((self._exact(point)[k] for point in self._family.corners), key=lambda row: row.fraction)
                rows.append(replace(found, coverage=_PROVED))
        if open_ones:
            self._sample()
        for k in open_ones:
            self._descend(k)
        count = len(self._known)
        for k in open_ones:
            by = sorted(self._known, key=lambda point: -self._known[point][k])[:_EXACT]
            found = min((self._exact(point)[k] for point in by), key=lambda row: row.fraction)
            rows.append(replace(found, coverage=f"sampled, {count} points, corners and interior"))
        own = {row.coverage for row in rows}
        coverage = next(iter(own - {_PROVED}), _PROVED)
        note = (
            "" if not any(bound.in_loop for bound in bounds) or self._nominal.loop is None else self._nominal.loop.note
        )
        return Margins(tuple(sorted(rows, key=lambda row: row.fraction)), note, coverage)

    def _sample(self) -> None:
        """Evaluate corners, centre and a Latin hypercube."""
        count = len(self._family.ranges)
        points = self._family.corners if count <= 7 else self._some_corners(128)
        points = [*points, self._family.centre]
        more = max(0, _POINTS - len(points))
        points += _latin_hypercube(more, count)
        for point in points:
            self._excess(point)

    def _some_corners(self, number: int) -> list[Point]:
        rng = np.random.default_rng(1)
        return [tuple(row) for row in rng.integers(0, 2, (number, len(self._family.ranges))).astype(float).tolist()]

    def _descend(self, k: int) -> None:
        """Pattern search of the worst point of a limit from the worst samples."""
        starts = sorted(self._known, key=lambda point: -self._known[point][k])[:_STARTS]
        for point in starts:
            worst = self._excess(point)[k]
            for step in _STEPS:
                moved = True
                while moved:
                    tried = [_moved(point, axis, sign * step) for axis in range(len(point)) for sign in (1.0, -1.0)]
                    best = max(tried, key=lambda other: self._excess(other)[k])
                    moved = self._excess(best)[k] > worst
                    if moved:
                        point, worst = best, self._excess(best)[k]

    def _limited(self, point: Point) -> Limited:
        return self._family.limited(self._given, self._limits, point, self._tail)

    def _excess(self, point: Point) -> Array:
        """Excess of each limit at a point, by samples."""
        found = self._known.get(point)
        if found is None:
            limited, values = self._limited(point), self._family.values(point)
            found = _told(values, lambda: limited.excesses(self._plan, self._samples))
            self._known[point] = found
        return found

    def _exact(self, point: Point) -> tuple[Margin, ...]:
        """Margins at a point in the order of the limits."""
        rows = self._rows.get(point)
        if rows is None:
            limited, values = self._limited(point), self._family.values(point)
            found = _told(values, lambda: limited.margins(self._plan))
            own = {name: value for name, value in values.items() if name in self._family.ranges}
            rows = tuple(
                replace(next(row for row in found if row.of(bound)), parameters=own) for bound in limited.bounds
            )
            self._rows[point] = rows
        return rows


def _latin_hypercube(number: int, dimensions: int) -> list[Point]:
    """Points of which each coordinate has one value in each of as many equal intervals."""
    rng = np.random.default_rng(0)
    cells = rng.permuted(np.tile(np.arange(number), (dimensions, 1)), axis=1).T
    return [tuple(row) for row in ((cells + rng.random(cells.shape)) / max(number, 1)).tolist()]


def _moved(point: Point, axis: int, step: float) -> Point:
    """Point moved along an axis, within the ranges."""
    return (*point[:axis], min(1.0, max(0.0, point[axis] + step)), *point[axis + 1 :])


def proved_bounds(plan: Trajectory, family: Family, limited: Limited) -> list[bool]:
    """Whether the worst value of each limit is at a corner of the ranges.

    It is where the signal is, at each time and in each parameter with the others
    fixed, affine or linear fractional without a pole in its range: it is then
    monotone in each parameter. A root mean square is convex where its signal is
    affine. Derivatives of the plan do not depend on parameters.
    """
    of_plan = [_of_plan(bound) for bound in limited.bounds]
    if len(family.ranges) > _MOST_CORNERS or limited.loop is not None or limited.on_path or all(of_plan):
        return of_plan
    times = plan.start + plan.duration * np.array([0.0, 0.21, 0.5, 0.74, 1.0])
    jets = [plan.jet(times, limited.order), plan.jet(plan.start, limited.order)[..., None]]
    found = list(of_plan)
    for k, bound in enumerate(limited.bounds):
        found[k] = of_plan[k] or all(_monotone(family, name, bound, jets) for name in family.ranges)
    return found


def _of_plan(bound: Bound) -> bool:
    """Whether derivatives of the plan are limited, which depend on no parameter."""
    return all(signal.axis is not None for signal, _ in bound.terms)


def _monotone(family: Family, name: str, bound: Bound, jets: Sequence[Array]) -> bool:
    """Whether a limited signal is monotone in a parameter, with the others at each of their corners."""
    low, high = family.ranges[name]
    place = list(family.ranges).index(name)
    nominal = 0.5 * (low + high)
    for corner in family.corners:
        if corner[place]:
            continue
        values = family.values(corner)
        try:
            traced = [
                _traced(family.system(values | {name: Rational.parameter(nominal)}), bound, jet, nominal)
                for jet in jets
            ]
        except Exception:  # the system does not accept the traced parameter
            return False
        if len({tuple(sorted(part.atoms.items())) for signal in traced for part in signal if part.atoms}) > 1:
            return False  # a denominator that depends on time
        for signal, jet in zip(traced, jets, strict=True):
            for part in signal:
                allowed = part.is_affine if bound.kind == "rms" else part.is_monotone
                if not allowed or part.has_pole(low, high):
                    return False
            if not _agrees(family, values, name, bound, jet, signal):
                return False
    return True


def _traced(system: Any, bound: Bound, jet: Array, nominal: float) -> list[Rational]:
    """The limited signal as a rational function of the parameter."""
    total: list[Rational] = []
    quantities: Quantities | None = quantities_of(system)
    signals = {} if quantities is None else quantities(jet)
    for signal, factor in bound.terms:
        row = jet[signal.order, signal.axis] if signal.axis is not None else signals[signal.name]
        parts = [factor * part for part in as_rational(row, nominal)]
        total = parts if not total else [a + b for a, b in zip(total, parts, strict=True)]
    return total


def _agrees(
    family: Family, values: dict[str, float], name: str, bound: Bound, jet: Array, signal: Sequence[Rational]
) -> bool:
    """Whether a traced signal is that of the system, at values of the parameter between its ends."""
    low, high = family.ranges[name]
    for share in (0.0, 0.137, 0.618, 1.0):
        p = low + share * (high - low)
        try:
            own = values_at(_traced(family.system(values | {name: p}), bound, jet, p), p)
        except ValueError:  # infeasible at this point, which the corners would report
            continue
        if np.abs(values_at(signal, p) - own).max() > _AGREEMENT * np.abs(own).max() + 1e-300:
            return False
    return True
