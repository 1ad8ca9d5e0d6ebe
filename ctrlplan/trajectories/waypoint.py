"""Waypoints: prescribed positions and derivatives at one time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_finite, default_labels, new_numbers
from ctrlplan._display import Displayed, Part, Table, counted, number, shortened, time_text
from ctrlplan._types import Data
from ctrlplan.trajectories.common import Array, readonly, times_powers
from ctrlplan.trajectories.fields import Fields

ENTRIES = ("position", "velocity", "acceleration", "jerk", "snap")


class Waypoint(Displayed, Fields):
    """Prescribed position and derivatives at one time.

    Parameters
    ----------
    time : float
        Time [s], finite.
    position : array_like, scalar or shape (naxes,)
        Value of every axis; nan is a free entry.
    velocity, acceleration, jerk, snap : array_like or None, optional
        Derivatives 1 to 4 in units of the position per s, s^2, ...; scalar
        for one axis, shape (naxes,) for more. A scalar 0 applies to every
        axis; None is free on all axes, nan on one.

    Attributes
    ----------
    jet : ndarray, shape (nentries, naxes)
        The prescribed derivatives from order 0, nan if free.
    labels : tuple of str or None
        Names of the axes; None unless made by `from_jets`, or by
        `PiecewiseSpline.from_arrays` with names.
    naxes : int
        Number of axes.
    complete : bool
        Whether all entries of the jet are prescribed.

    Raises
    ------
    ValueError
        If the time is not finite, an entry is infinite, or the numbers of axes
        of the entries differ.

    Notes
    -----
    Waypoints are equal if their times, labels and prescribed entries are equal.

    Examples
    --------
    >>> Waypoint(6.0, [5.0, 5.0], [1.0, -1.0], 0).jet
    array([[ 5.,  5.],
           [ 1., -1.],
           [ 0.,  0.]])
    """

    time: float
    jet: Array
    labels: tuple[str, ...] | None
    complete: bool
    naxes: int

    def __init__(
        self,
        time: float,
        position: ArrayLike,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        jerk: ArrayLike | None = None,
        snap: ArrayLike | None = None,
    ) -> None:
        entries = [position, velocity, acceleration, jerk, snap]
        while len(entries) > 1 and entries[-1] is None:
            entries.pop()
        jet = _rows(entries)
        if jet is None:
            jet = _plain(entries)
        if type(time) is not float or not math.isfinite(time):
            time = checked_finite(time, "time")
        self._set(time, _jet(entries) if jet is None else jet, None)

    @classmethod
    def from_jets(cls, time: float, /, **jets: Sequence[float | None]) -> Waypoint:
        """Waypoint with named axes from the jet of each.

        Parameters
        ----------
        time : float
            Time [s], finite.
        **jets : sequence of float or None
            Position, velocity, ... of each axis, up to any order; None or nan is
            a free entry.

        Raises
        ------
        ValueError
            If no axis is given, a jet is not a sequence of numbers, or an
            entry is infinite.

        Examples
        --------
        >>> Waypoint.from_jets(0.0, x=[0.0, 0.0, 0.0], z=[10.0]).labels
        ('x', 'z')
        """
        if not jets:
            raise ValueError("from_jets requires at least one axis, such as x=[0.0, 0.0], got none")
        columns = {}
        for label, jet in jets.items():
            column = new_numbers(jet, f"jet of axis {label}")
            if column.ndim != 1:
                raise ValueError(f"jet of axis {label} must be a sequence of numbers, got {jet!r}")
            columns[label] = column
        table = np.full((max(1, *(c.size for c in columns.values())), len(columns)), np.nan)
        for axis, column in enumerate(columns.values()):
            table[: column.size, axis] = column
        return cls.from_array(checked_finite(time, "time"), table, tuple(columns))

    @classmethod
    def from_array(cls, time: float, jet: Array, labels: tuple[str, ...] | None) -> Waypoint:
        """Waypoint from an array of derivatives, which is made read-only.

        Parameters
        ----------
        time : float
            Time [s], finite.
        jet : ndarray, shape (order + 1, naxes)
            Row k contains the k-th derivatives; nan is a free entry.
        labels : tuple of str, or None
            Names of the axes, if known.

        Raises
        ------
        ValueError
            If a value is infinite.
        """
        self = cls.__new__(cls)
        self._set(time, jet, labels)
        return self

    @classmethod
    def _of_checked(cls, time: float, jet: Array, labels: tuple[str, ...] | None, complete: bool) -> Waypoint:
        """Waypoint from a read-only array without infinite values; as `from_array`, without checks."""
        self = cls.__new__(cls)
        self._fill(time=time, jet=jet, labels=labels, complete=complete, naxes=jet.shape[1])
        return self

    def _set(self, time: float, jet: Array, labels: tuple[str, ...] | None) -> None:
        # The sum of a few numbers is faster than a call of numpy; it is finite only if all are.
        complete = math.isfinite(sum(jet.ravel().tolist())) or bool(np.isfinite(jet).all())
        if not complete and np.isinf(jet).any():
            order, axis = np.argwhere(np.isinf(jet))[0]
            name = ENTRIES[order] if order < len(ENTRIES) else f"derivative {order}"
            raise ValueError(f"{name} must be finite or nan (free), got {jet[order, axis]} at time {time:g}")
        if jet.flags.writeable:
            jet.setflags(write=False)
        self._fill(time=time, jet=jet, labels=labels, complete=complete, naxes=jet.shape[1])

    @property
    def position(self) -> Array:
        """Value of every axis, shape (naxes,), nan if free."""
        return self._entry(0)

    @property
    def velocity(self) -> Array:
        """First derivative of every axis, shape (naxes,), nan if free."""
        return self._entry(1)

    @property
    def acceleration(self) -> Array:
        """Second derivative of every axis, shape (naxes,), nan if free."""
        return self._entry(2)

    @property
    def jerk(self) -> Array:
        """Third derivative of every axis, shape (naxes,), nan if free."""
        return self._entry(3)

    @property
    def snap(self) -> Array:
        """Fourth derivative of every axis, shape (naxes,), nan if free."""
        return self._entry(4)

    def _entry(self, order: int) -> Array:
        return self.jet[order] if order < len(self.jet) else np.full(self.naxes, np.nan)

    @property
    def _shortest_jet(self) -> Array:
        """The jet without the orders above the highest one that is prescribed: these are free whether given or not."""
        if self.complete:
            return self.jet
        known = np.flatnonzero(~np.isnan(self.jet).all(axis=1))
        return self.jet[: 1 + int(known[-1]) if known.size else 1]

    def scaled(self, time: float, rate: float) -> Waypoint:
        """Same point at another time, with scaled derivatives."""
        moved = self.jet if rate == 1.0 else times_powers(self.jet, rate, np.arange(len(self.jet))[:, None])
        return Waypoint.from_array(checked_finite(time, "time"), moved, self.labels)

    def truncated(self, order: int) -> Waypoint:
        """Same point without the entries above an order."""
        return Waypoint.from_array(self.time, self.jet[: order + 1], self.labels)

    def to_dict(self) -> Data:
        """Plain data: time, and jet by order and axis (None if free)."""
        jet = [[None if v != v else v for v in row] for row in self.jet.tolist()]
        while len(jet) > 1 and jet[-1].count(None) == self.naxes:  # as `_shortest_jet`
            jet.pop()
        data: Data = {"time": self.time, "jet": jet}
        if self.labels is not None:
            data["labels"] = list(self.labels)
        return data

    @classmethod
    def from_dict(cls, data: Data) -> Waypoint:
        """Waypoint from the plain data of `to_dict`."""
        labels = tuple(data["labels"]) if "labels" in data else None
        rows = [[np.nan if v is None else v for v in row] for row in data["jet"]]
        if len({len(row) for row in rows}) > 1:
            raise ValueError(f"jet must have rows of equal length, got {data['jet']!r}")
        jet = new_numbers(rows, "jet")
        if jet.ndim != 2 or jet.size == 0 or (labels is not None and len(labels) != jet.shape[1]):
            raise ValueError(f"jet must be a table of entries by order and axis, got {data['jet']!r}")
        return cls.from_array(checked_finite(data["time"], "time"), jet, labels)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Waypoint):
            return NotImplemented
        same = self.time == other.time and self.labels == other.labels
        return same and np.array_equal(self._shortest_jet, other._shortest_jet, equal_nan=True)

    def __hash__(self) -> int:
        return hash((self.time, self.labels, str((self._shortest_jet + 0.0).tolist())))  # -0.0 equals 0.0

    def __repr__(self) -> str:
        if self.labels is not None:
            axes = zip(self.labels, self.jet.T.tolist(), strict=True)
            return f"Waypoint.from_jets({self.time!r}, {', '.join(f'{k}={v}' for k, v in axes)})"
        values = self.jet[:, 0] if self.naxes == 1 else self.jet
        named = ", ".join(f"{n}={v.tolist()}" for n, v in zip(ENTRIES, values, strict=False))
        return f"Waypoint({self.time!r}, {named})"

    def _describe(self) -> Iterator[Part]:
        yield f"Waypoint at {time_text(self.time)} s"
        rows = [[entry_name(k), *map(_prescribed, row)] for k, row in enumerate(self.jet.tolist())]
        yield Table("Prescribed values", ("", *(self.labels or default_labels(self.naxes))), rows)


@dataclass(frozen=True, eq=False)
class Entries:
    """Waypoints as arrays.

    Attributes
    ----------
    times : ndarray, shape (nwaypoints,)
        Times [s], increasing.
    table : ndarray, shape (nwaypoints, order + 1, naxes)
        Prescribed derivatives, nan where free.
    counts : ndarray of int, shape (nwaypoints,)
        Number of orders of each waypoint, at most order + 1.
    labels : tuple of str or None
        Names of the axes.
    """

    times: Array
    table: Array
    counts: NDArray[np.intp]
    labels: tuple[str, ...] | None

    @classmethod
    def of(cls, waypoints: Sequence[Waypoint]) -> Entries:
        """Entries of waypoints with equal axes."""
        jets = [point.jet for point in waypoints]
        sizes = list(map(len, jets))
        rows, naxes = max(sizes), jets[0].shape[1]
        counts, entries = np.array(sizes), joined(jets)
        if min(sizes) == rows:
            table = entries.reshape(-1, rows, naxes)
        else:
            table = np.full((len(jets), rows, naxes), np.nan)
            table[np.arange(rows) < counts[:, None]] = entries.reshape(-1, naxes)
        times = readonly(np.fromiter([point.time for point in waypoints], float, len(jets)))
        return cls(times, readonly(table), counts, waypoints[0].labels)

    @classmethod
    def of_rows(cls, times: Array, rows: Array) -> Entries:
        """Entries from those by axis, (naxes, order + 1, nwaypoints), which are made read-only."""
        found = cls(times, readonly(rows).T, np.full(times.size, rows.shape[1]), None)
        found.__dict__["rows"] = rows  # the cached property needs no copy
        return found

    def named(self, labels: tuple[str, ...] | None) -> Entries:
        """The same entries with other names of the axes."""
        if labels == self.labels:
            return self
        found = replace(self, labels=labels)
        found.__dict__["rows"] = self.rows
        return found

    @cached_property
    def rows(self) -> Array:
        """The entries by axis, (naxes, order + 1, nwaypoints), as used in computations."""
        return readonly(np.ascontiguousarray(self.table.T))

    def scaled(self, times: Array, rate: float) -> Entries:
        """Same points at other times, with scaled derivatives.

        Raises
        ------
        ValueError
            If a time or a derivative overflows, or times do not increase.
        """
        if not np.isfinite(times).all():
            raise ValueError(f"time must be finite, got {times[~np.isfinite(times)][0]}")
        wrong = np.flatnonzero(~(np.diff(times) > 0.0))
        if wrong.size:
            i = int(wrong[0]) + 1
            raise ValueError(
                f"times must increase strictly, got waypoints[{i}].time = {times[i]} "
                f"after waypoints[{i - 1}].time = {times[i - 1]}"
            )
        table = times_powers(self.table, rate, np.arange(self.table.shape[1])[:, None])
        return Entries(readonly(times), readonly(table), self.counts, self.labels)

    def waypoints(self) -> tuple[Waypoint, ...]:
        """The waypoints as objects, which share the memory of the table.

        Raises
        ------
        ValueError
            If an entry is infinite.
        """
        counts, rows = self.counts.tolist(), self.table.shape[1]
        finite = np.isfinite(self.table)
        jets: Sequence[Array] = list(self.table)
        if min(counts) < rows:
            jets = [jet[:count] for jet, count in zip(jets, counts, strict=True)]
            finite |= (np.arange(rows) >= self.counts[:, None])[:, :, None]
        cells = zip(self.times.tolist(), jets, np.ravel(finite.all(axis=(1, 2))).tolist(), strict=True)
        if np.isinf(self.table).any():
            return tuple(Waypoint.from_array(time, jet, self.labels) for time, jet, _ in cells)
        return tuple(Waypoint._of_checked(time, jet, self.labels, whole) for time, jet, whole in cells)


def joined(jets: Sequence[Array]) -> Array:
    """Entries of all jets, one after the other, in one row."""
    try:
        # A quarter of the time of np.concatenate.
        buffers: Any = jets
        return np.frombuffer(b"".join(buffers))
    except TypeError:  # not contiguous: parts of a larger table
        return np.concatenate([jet.ravel() for jet in jets])


def waypoint_table(waypoints: Sequence[Waypoint], labels: Sequence[str]) -> Table:
    """Waypoints by time: what each prescribes of every axis, from the position on."""
    count = max(len(point.jet) for point in waypoints)
    rows = []
    for point in waypoints:
        cells = []
        for jet in point.jet.T.tolist():
            given = max((k + 1 for k, value in enumerate(jet) if value == value), default=1)
            cells.append(", ".join(map(_prescribed, jet[:given])))
        rows.append([time_text(point.time), *cells])
    names = ", ".join(map(entry_name, range(count)))
    return Table(f"{counted(len(waypoints), 'waypoint')}: {names}", ("time [s]", *labels), shortened(rows))


def entry_name(order: int) -> str:
    """Name of a derivative: position, velocity, ..., derivative 5."""
    return ENTRIES[order] if order < len(ENTRIES) else f"derivative {order}"


def _prescribed(value: float) -> str:
    return "free" if value != value else number(value)


def _rows(entries: list[Any]) -> Array | None:
    """Table (order, axis) of arrays of floats of one length, read-only; None for all other entries."""
    naxes = len(entries[0]) if type(entries[0]) is np.ndarray and entries[0].ndim else 0
    if not naxes:
        return None
    for entry in entries:
        if type(entry) is not np.ndarray or entry.dtype is not _DOUBLE or entry.ndim != 1 or len(entry) != naxes:
            return None
    try:
        return np.ndarray((len(entries), naxes), _DOUBLE, b"".join(entries))  # a quarter of the time of np.array
    except TypeError:  # not contiguous
        return np.array(entries)


_DOUBLE = np.dtype(float)


def _plain(entries: list[Any]) -> Array | None:
    """The same of numbers, and of lists and arrays of as many; None for all other entries."""
    kinds = set(map(type, entries))
    if kinds <= _NUMBERS:
        return _array(entries, 1)
    if np.ndarray in kinds:
        entries = [
            entry.tolist() if type(entry) is np.ndarray and entry.dtype is _DOUBLE else entry for entry in entries
        ]
    sizes = {len(entry) for entry in entries if type(entry) in _ROWS}
    if len(sizes) != 1 or 0 in sizes:
        return None
    (naxes,) = sizes
    flat: list[Any] = []
    for cell in entries:
        kind = type(cell)
        if kind in _ROWS:
            flat += cell
        elif kind in _NUMBERS and (naxes == 1 or not cell or cell != cell):
            flat += [cell] * naxes
        else:
            return None
    return _array(flat, naxes) if _NUMBERS.issuperset(map(type, flat)) else None


def _array(flat: list[Any], naxes: int) -> Array | None:
    """Table (order, axis) of numbers, None as nan; None if one of them overflows."""
    try:
        return np.array(flat, dtype=float).reshape(-1, naxes)
    except OverflowError:
        return None


_ROWS = frozenset({list, tuple})
_NUMBERS = frozenset({float, int, type(None), np.float64})


def _jet(entries: list[ArrayLike | None]) -> Array:
    """Table (order, axis) of the entries; scalars that apply to every axis are repeated."""
    try:
        table = new_numbers(entries, "position")  # the common case: equal shapes and no free entries
    except (TypeError, ValueError):
        table = np.empty(())  # the wrong entry is found below
    if table.ndim == 2 and table.shape[1]:
        return table
    if table.ndim == 1:
        return table[:, None]
    rows = [new_numbers(np.nan if e is None else e, ENTRIES[k]) for k, e in enumerate(entries)]
    naxes = max((r.size for r in rows), default=1)
    out = np.empty((len(rows), naxes))
    for k, row in enumerate(rows):
        spread = row.ndim == 0 and (naxes == 1 or row == 0 or np.isnan(row))
        if not spread and row.shape != (naxes,):
            given = f"scalar {row:g}" if row.ndim == 0 else f"shape {row.shape}"
            raise ValueError(f"{ENTRIES[k]} must have shape ({naxes},) as the other entries, or be 0, got {given}")
        out[k] = row
    if naxes == 0:
        raise ValueError("position must have at least one axis, got none")
    return out
