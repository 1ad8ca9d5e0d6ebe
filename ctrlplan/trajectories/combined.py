"""Combinations of trajectories: sums, multiples, stacked axes, sequences."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from itertools import pairwise
from operator import add
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import checked_finite, checked_labels, default_labels
from ctrlplan._display import counted, time_text
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import Array, readonly
from ctrlplan.trajectories.continuity import POSITION_ROUNDING
from ctrlplan.trajectories.files import trajectory_from_dict
from ctrlplan.trajectories.trajectory import Trajectory, check_end


class _OfParts(Trajectory):
    """Trajectory of several parts."""

    parts: tuple[Trajectory, ...]
    initial: Array
    final: Array

    def _has_quick_peaks(self) -> bool:
        return super()._has_quick_peaks() and all(part._has_quick_peaks() for part in self.parts)

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {
            "type": type(self).__name__,
            "parts": [part.to_dict() for part in self.parts],
            "labels": list(self.labels),
        }

    @classmethod
    def _of(cls, parts: tuple[Trajectory, ...], labels: tuple[str, ...]) -> Self:
        self = cls.__new__(cls)
        self._set(parts, labels)
        return self

    @abstractmethod
    def _set(self, parts: tuple[Trajectory, ...], labels: tuple[str, ...]) -> None:
        """Set the fields."""

    @property
    def polynomial_degree(self) -> int | None:
        """Maximum degree of the parts; as `Trajectory.polynomial_degree`."""
        degrees = [part.polynomial_degree for part in self.parts]
        known = [degree for degree in degrees if degree is not None]
        return max(known) if len(known) == len(degrees) else None

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        return self._of(tuple(part.map_time(origin, target, rate) for part in self.parts), self.labels)


class _Combined(_OfParts):
    """Trajectory of several parts at the same time; a subclass defines how their jets combine."""

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        parts = _checked_parts(trajectory_from_dict(part) for part in data["parts"])
        return cls._of(parts, tuple(data["labels"]))

    def _set(self, parts: tuple[Trajectory, ...], labels: tuple[str, ...]) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            initial, final = (self._combine([getattr(p, end) for p in parts]) for end in ("initial", "final"))
        if not (np.isfinite(initial).all() and np.isfinite(final).all()):
            raise ValueError(
                f"positions must stay within floating point, got {initial.tolist()} and {final.tolist()} at the ends"
            )
        joined = np.unique(np.concatenate([part.breakpoints for part in parts]))
        self._set_fields(
            parts=parts,
            labels=checked_labels(labels, initial.size),
            breakpoints=readonly(joined),
            initial=readonly(initial),
            final=readonly(final),
        )

    @abstractmethod
    def _combine(self, values: list[Array]) -> Array:
        """Jets, or constant positions, of the combination from those of the parts (axes second to last)."""

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        if all(part.start == self.start and part.end == self.end for part in self.parts):
            with np.errstate(over="ignore", invalid="ignore"):
                found = self._combine([part._sample(t, low, high, left) for part in self.parts])
            if np.isfinite(found.sum()):
                return found
        out = super()._sample(t, low, high, left)
        at_end = t == self.end
        if not left and at_end.any():  # each part defines its own value at the end
            out[:, :, at_end] = self._combine([part._sample(t[at_end], low, high, left) for part in self.parts])
        return out

    def _rows(self, t: float, order: int, left: bool) -> list[list[float]] | None:
        """Derivatives at one time; as `Trajectory._rows`."""
        return None if t == self._moments[-1] else super()._rows(t, order, left)

    def segment_rows(self, segment: int, s: float, order: int) -> list[list[float]] | None:
        """Derivatives of a segment at one time; as `Trajectory.segment_rows`."""
        origin, end = self._moments[segment : segment + 2]
        moment, tables = 0.5 * (origin + end), []
        for part in self.parts:
            rows = part.segment_rows_at(moment, origin, s, order)
            if rows is None:
                return None
            tables.append(rows)
        return self._combine_rows(tables)

    @abstractmethod
    def _combine_rows(self, tables: list[list[list[float]]]) -> list[list[float]]:
        """Derivatives by axis of the combination from those of the parts."""

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        origin, end = self.breakpoints[segment : segment + 2].tolist()
        moment = 0.5 * (origin + end)
        return self._combine([part.segment_jet_at(moment, origin, s, order) for part in self.parts])

    @property
    def in_batches(self) -> bool:
        """Whether segments are evaluated together, as those of a part are."""
        return any(part.in_batches for part in self.parts)

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        origins, ends = self.breakpoints[segments], self.breakpoints[segments + 1]
        return self._combine([part.segments_jet_at(0.5 * (origins + ends), origins, s, order) for part in self.parts])

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        origin, end = self.breakpoints[segment : segment + 2].tolist()
        rows = [part.segment_series_at(0.5 * (origin + end), origin, s, order) for part in self.parts]
        found: list[list[Value]] = self._combine([_objects(row) for row in rows]).T.tolist()
        return found


class Sum(_Combined):
    """Sum of trajectories with the same number of axes.

    Labels are those of the first.

    Parameters
    ----------
    parts : iterable of Trajectory
        One or more. Each is constant outside its own interval.
    shaped : bool, optional
        Whether the parts are the delayed parts of an input shaper (`Shaper`).
        Another duration would change the delays: `retime`, of the sum or of a
        combination that contains it, then raises a ValueError.

    Raises
    ------
    ValueError
        If the numbers of axes differ.
    """

    shaped: bool = False

    def __init__(self, parts: Iterable[Trajectory], *, shaped: bool = False) -> None:
        terms = _checked_parts(parts)
        self._set_fields(shaped=shaped)
        self._set(terms, terms[0].labels)

    def _facts(self) -> list[tuple[str, str]]:
        shaper = [("input shaper", counted(len(self.parts), "impulse"))] if self.shaped else []
        return [*super()._facts(), *shaper]

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return super().to_dict() | ({"shaped": True} if self.shaped else {})

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        return super().from_dict(data)._with_fields(shaped=bool(data.get("shaped", False)))

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        if self.shaped and not is_unit_rate(rate):
            raise ValueError(
                f"a shaped plan must keep its duration of {self.duration:g} s, got {self.duration / rate:g} s: the "
                f"delays of the shaper would change with it; retime the plan first, then shape it, for the cycle of a "
                "controller by shaper.on_grid(dt)"
            )
        return super().map_time(origin, target, rate)._with_fields(shaped=self.shaped)

    def _set(self, parts: tuple[Trajectory, ...], labels: tuple[str, ...]) -> None:
        super()._set(_same_axes(parts), labels)

    def _combine(self, values: list[Array]) -> Array:
        return np.add.reduce(values)

    def _combine_rows(self, tables: list[list[list[float]]]) -> list[list[float]]:
        found = tables[0]
        for table in tables[1:]:
            found = [list(map(add, *rows)) for rows in zip(found, table, strict=True)]
        return found


class Stacked(_Combined):
    """Stacked axes of several trajectories; returned by `stack`."""

    def __init__(self, parts: Iterable[Trajectory], labels: Sequence[str] | None = None) -> None:
        members = _checked_parts(parts)
        names = tuple(name for part in members for name in part.labels)
        if labels is not None:
            names = checked_labels(labels, len(names))
        elif all(part.labels == default_labels(part.naxes) for part in members):
            names = default_labels(len(names))
        self._set(members, checked_labels(names, len(names)))

    def _combine(self, values: list[Array]) -> Array:
        return np.concatenate(values, axis=0 if values[0].ndim == 1 else 1)

    def _combine_rows(self, tables: list[list[list[float]]]) -> list[list[float]]:
        return [row for table in tables for row in table]


class Selected(_Combined):
    """Some axes of a trajectory; returned by `select`."""

    _axes: list[int]

    def __init__(self, part: Trajectory, labels: Iterable[str]) -> None:
        (member,) = _checked_parts([part])
        self._set((member,), tuple(labels))

    def _set(self, parts: tuple[Trajectory, ...], labels: tuple[str, ...]) -> None:
        for label in labels:
            if label not in parts[0].labels:
                raise ValueError(f"labels must be among {', '.join(parts[0].labels)}, got {label!r}")
        self._set_fields(_axes=[parts[0].labels.index(label) for label in labels])
        super()._set(parts, labels)

    def _combine(self, values: list[Array]) -> Array:
        return values[0].take(self._axes, axis=0 if values[0].ndim == 1 else 1)

    def _combine_rows(self, tables: list[list[list[float]]]) -> list[list[float]]:
        return [tables[0][axis] for axis in self._axes]


class Scaled(_Combined):
    """Multiple of a trajectory.

    Parameters
    ----------
    part : Trajectory
        Trajectory to be multiplied.
    factor : float
        Factor, finite.
    """

    factor: float

    def __init__(self, part: Trajectory, factor: float) -> None:
        self._set_fields(factor=checked_finite(factor, "factor"))
        self._set(_checked_parts([part]), part.labels)

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return super().to_dict() | {"factor": self.factor}

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        return cls(trajectory_from_dict(data["parts"][0]), data["factor"])

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        return type(self)(self.parts[0].map_time(origin, target, rate), self.factor)

    def _combine(self, values: list[Array]) -> Array:
        return self.factor * values[0]

    def _combine_rows(self, tables: list[list[list[float]]]) -> list[list[float]]:
        return [[self.factor * value for value in row] for row in tables[0]]


class Joined(_OfParts):
    """Sequence of trajectories; returned by `then`.

    Parameters
    ----------
    parts : iterable of Trajectory
        Each is shifted in time to begin where the previous one ends.

    Raises
    ------
    ValueError
        If the numbers of axes differ, or if an initial position differs from the
        previous final position by more than 1e-9 of the range of either
        trajectory plus the rounding of positions.
    """

    _segments: list[tuple[Trajectory, int]]  # for each segment the part and the part's segment number

    def __init__(self, parts: Iterable[Trajectory]) -> None:
        members = list(_checked_parts(parts))
        for i in range(1, len(members)):
            members[i] = members[i]._moved(members[i].start, members[i - 1].end, 1.0)
        for before, after in pairwise(_same_axes(tuple(members))):
            check_join(before, after)
        self._set(tuple(members), members[0].labels)

    @classmethod
    def without_shift(cls, parts: Sequence[Trajectory]) -> Self:
        """Sequence of trajectories at their own times."""
        return cls._of(tuple(parts), parts[0].labels)

    def _set(self, parts: tuple[Trajectory, ...], labels: tuple[str, ...]) -> None:
        times, segments = [parts[0].start], []
        waypoints = list(parts[0].waypoints)
        for part in parts:
            times += part.breakpoints[1:].tolist()
            segments += [(part, k) for k in range(part.breakpoints.size - 1)]
            if part is not parts[0]:
                waypoints += part.waypoints[1:]
        self._set_fields(
            parts=parts,
            labels=checked_labels(labels, parts[0].naxes),
            waypoints=tuple(waypoints),
            breakpoints=readonly(np.array(times)),
            initial=parts[0].initial,
            final=parts[-1].final,
            _segments=segments,
        )

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        parts = _checked_parts(trajectory_from_dict(part) for part in data["parts"])
        for before, after in pairwise(_same_axes(parts)):
            check_join(before, after)
        return cls._of(parts, tuple(data["labels"]))

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        out = super()._sample(t, low, high, left)
        if low == 0 and not left and self.parts[-1].breakpoints.size == 1:
            out[0][:, t == self.end] = self.final[:, None]  # a step at the very end
        return out

    def _rows(self, t: float, order: int, left: bool) -> list[list[float]] | None:
        """Derivatives at one time; as `Trajectory._rows`."""
        return None if t == self._moments[-1] else super()._rows(t, order, left)

    def segment_rows(self, segment: int, s: float, order: int) -> list[list[float]] | None:
        """Derivatives of a segment at one time; as `Trajectory.segment_rows`."""
        part, own = self._segments[segment]
        return part.segment_rows(own, s, order)

    @property
    def in_batches(self) -> bool:
        """Whether segments are evaluated together, as those of a part are."""
        return any(part.in_batches for part in self.parts)

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        out = np.empty((order + 1, self.naxes, s.size))
        first = 0
        for part in self.parts:
            inside = (segments >= first) & (segments < first + part.breakpoints.size - 1)
            out[:, :, inside] = part.segments_jet(segments[inside] - first, s[inside], order)
            first += part.breakpoints.size - 1
        return out

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        part, own = self._segments[segment]
        return part.segment_jet(own, s, order)

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        part, own = self._segments[segment]
        return part.segment_series(own, s, order)


def is_unit_rate(rate: float) -> bool:
    """Whether a rate is 1, so that it preserves the delays of a shaper, up to the rounding of a duration."""
    return abs(rate - 1.0) <= 1e-9


def is_shaped(plan: Trajectory) -> bool:
    """Whether a plan or one of its parts is shaped."""
    made_of = getattr(plan, "parts", (getattr(plan, "plan", None),))
    return bool(getattr(plan, "shaped", False)) or any(is_shaped(p) for p in made_of if isinstance(p, Trajectory))


def stack(plans: Iterable[Trajectory], labels: Sequence[str] | None = None) -> Trajectory:
    """Trajectory with the axes of several trajectories.

    Parameters
    ----------
    plans : iterable of Trajectory
        One or more, on any intervals: each is constant outside its own.
    labels : sequence of str, optional
        Names of all axes; required if names of the plans coincide.

    Returns
    -------
    Trajectory

    Raises
    ------
    ValueError
        If there is no plan, or labels are not unique.
    """
    from ctrlplan.trajectories.repeated import combined

    return combined(lambda parts: Stacked(parts, labels), _trajectories(plans))


def _objects(rows: list[list[Value]]) -> Any:
    """Table (order + 1, naxes) of numbers or symbols."""
    table = np.empty((len(rows[0]), len(rows)), dtype=object)
    for axis, row in enumerate(rows):
        table[:, axis] = row
    return table


def _checked_parts(parts: Iterable[Trajectory]) -> tuple[Trajectory, ...]:
    members = _trajectories(parts)
    for i, part in enumerate(members):
        check_end(part, f"parts[{i}]")
    return members


def _trajectories(parts: Iterable[Trajectory]) -> tuple[Trajectory, ...]:
    members = tuple(parts)
    if not members:
        raise ValueError("a combination needs at least one trajectory, got none")
    for i, part in enumerate(members):
        if not isinstance(part, Trajectory):
            raise TypeError(f"parts[{i}] must be a Trajectory, got {type(part).__name__}")
    return members


def _same_axes(parts: tuple[Trajectory, ...]) -> tuple[Trajectory, ...]:
    for i, part in enumerate(parts):
        if part.naxes != parts[0].naxes:
            raise ValueError(
                f"parts must have the same number of axes, got {part.naxes} in parts[{i}] after {parts[0].naxes}"
            )
    return parts


def check_join(before: Trajectory, after: Trajectory) -> None:
    """Raise for a jump of position, or for a gap in time beyond the rounding of times."""
    if abs(after.start - before.end) > 1e-9 * (before.duration + after.duration):
        raise ValueError(f"parts must follow one another in time, got {after.start} s after {before.end} s")
    last, first = before.final, after.initial
    if np.any(first != last) and np.any(np.abs(first - last) > join_slack(before, after)):
        raise ValueError(
            f"positions must agree where trajectories join, got {first.tolist()} after {last.tolist()} "
            f"at {time_text(before.end)} s"
        )


def join_slack(*parts: Trajectory) -> Array:
    """Tolerance (naxes,) of position differences, relative to the range, so that a distant origin hides no jump."""
    extrema = [part.extrema() for part in parts]
    ranges = np.max([e.maximum - e.minimum for e in extrema], axis=0)
    size = np.max([np.maximum(np.abs(e.minimum), np.abs(e.maximum)) for e in extrema], axis=0)
    slack: Array = 1e-9 * ranges + 0.5 * POSITION_ROUNDING * size  # ends have fewer errors than inner breakpoints
    return slack
