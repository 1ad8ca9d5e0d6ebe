"""Time laws of a path that are given by their squared rate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_finite, checked_labels, new_numbers
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import FACTORIALS, Array, mapped_time, readonly
from ctrlplan.trajectories.trajectory import Trajectory

_SERIES = 12
"""Number of terms of the series of sinh(x)/x, which has all digits for x^2 of at most 4."""

_LARGEST = 1e100
"""Largest number of which squares and products are within floating point."""


class TimeLaw(Trajectory):
    r"""Time law with a piecewise quadratic squared rate.

    The path parameter s(t), the time of a plan, satisfies (ds/dt)^2 = b(s), where b
    is quadratic in each cell of s. In a cell s'' = b'/2 is linear in s, so that s is a
    sum of exponential or trigonometric functions of t. `fastest` returns plans
    with such a law for ``hold="path"``.

    Parameters
    ----------
    positions : array_like, shape (ncells + 1,)
        Path parameter [s of the plan] at the ends of the cells, increasing.
    squared_rates : array_like, shape (3, ncells)
        Bernstein coefficients of b in each cell: the values at both ends, and
        between them the value at which the tangents in both ends meet.
    start : float, optional
        Start time [s].
    labels : sequence of str, optional
        Name of the axis; default "s".

    Attributes
    ----------
    positions, squared_rates : ndarray
        The arguments.

    Raises
    ------
    ValueError
        If shapes differ, a number is not finite, positions do not increase, or the
        squared rate is not positive within a cell.

    Notes
    -----
    With the rates v_0 and v_1 at the ends of a cell of length h, and
    b = b_0 + b_1 r + b_2 r^2,

    .. math:: r(t) = v_0 S(t) + b_1 S(t/2)^2, \quad S(t) = \sinh(w t)/w, \quad w^2 = b_2,

    and the duration of the cell is 2 h/(v_0 + v_1) artanh(x)/x with
    x = w h/(v_0 + v_1).

    Examples
    --------
    A plan of 1 s that is passed from rest with constant acceleration 2/s, then with the
    rate 2:

    >>> law = TimeLaw([0.0, 1.0, 3.0], [[0.0, 4.0], [2.0, 4.0], [4.0, 4.0]])
    >>> law.breakpoints, law([0.5, 1.0, 1.5]), law(1.0, 1)
    (array([0., 1., 2.]), array([0.25, 1.  , 2.  ]), array(2.))
    """

    positions: Array
    squared_rates: Array
    _powers: Array  # (3, ncells), of b by the distance from the start of a cell

    def __init__(
        self,
        positions: ArrayLike,
        squared_rates: ArrayLike,
        start: float = 0.0,
        *,
        labels: Sequence[str] | str | None = None,
    ) -> None:
        places, table = new_numbers(positions, "positions"), new_numbers(squared_rates, "squared_rates")
        if places.ndim != 1 or places.size < 2 or not (np.isfinite(places).all() and (np.diff(places) > 0.0).all()):
            raise ValueError(
                f"positions must be two or more finite numbers that increase strictly, got {places.tolist()!r:.200}"
            )
        if table.shape != (3, places.size - 1) or not np.isfinite(table).all():
            raise ValueError(
                f"squared_rates must be finite numbers of shape (3, {places.size - 1}), got shape {table.shape}"
            )
        if max(np.abs(places).max(), np.abs(table).max()) > _LARGEST:
            raise ValueError(f"positions and squared_rates must be at most {_LARGEST:g}, within floating point")
        smallest = _smallest(table)
        if not ((table[[0, 2]] >= 0.0).all() and (smallest > 0.0).all()):
            cell = int(np.minimum(smallest, table[[0, 2]].min(axis=0)).argmin())
            raise ValueError(
                f"squared_rates must be at least 0 at the ends of cells and positive within them, got "
                f"{table[:, cell].tolist()} in the cell from {places[cell]:g}"
            )
        lengths = np.diff(places)
        powers = np.stack(
            [
                table[0],
                2.0 * (table[1] - table[0]) / lengths,
                (table[0] - 2.0 * table[1] + table[2]) / lengths**2,
            ]
        )
        moments = checked_finite(start, "start") + np.append(0.0, np.cumsum(_durations(table, lengths)))
        if not (np.diff(moments) > 0.0).all() or not np.isfinite(moments[-1]):
            raise ValueError(
                f"durations of the cells must be above the resolution of times, got {np.diff(moments).min():g} s "
                f"near {moments[int(np.diff(moments).argmin())]:g} s"
            )
        self._set_fields(
            breakpoints=readonly(moments),
            positions=readonly(places),
            squared_rates=readonly(table),
            labels=checked_labels(["s"] if labels is None else labels, 1),
            _powers=readonly(powers),
        )

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {
            "type": "TimeLaw",
            "positions": self.positions.tolist(),
            "squared_rates": self.squared_rates.tolist(),
            "start": self.start,
            "labels": list(self.labels),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        return cls(data["positions"], data["squared_rates"], data["start"], labels=data["labels"])

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        start = mapped_time(self.start, origin, target, rate)
        return type(self)(self.positions, self.squared_rates * rate**2, start, labels=self.labels)

    @cached_property
    def final(self) -> Array:
        """Position from the end on, shape (1,)."""
        return readonly(self.positions[-1:].copy())

    def moments(self, positions: Array) -> Array:
        """Times [s] at which positions are reached."""
        cells = np.clip(np.searchsorted(self.positions, positions, side="right") - 1, 0, self.positions.size - 2)
        u = (positions - self.positions[cells]) / (self.positions[cells + 1] - self.positions[cells])
        first, middle, last = self.squared_rates[:, cells]
        part = np.stack(
            [first, first + u * (middle - first), (1 - u) ** 2 * first + 2 * u * (1 - u) * middle + u**2 * last]
        )
        found = np.zeros(u.shape)
        inside = u > 0.0
        lengths = positions - self.positions[cells]
        found[inside] = _durations(part[:, inside], lengths[inside])
        return self.breakpoints[cells] + found

    in_batches = True

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        return self.segments_jet(np.full(s.shape, segment), s, order)

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        b0, b1, b2 = self._powers[:, segments]
        out = np.empty((order + 1, 1, s.size))
        rows = _motion(np.sqrt(b0), b1, b2, s, _sinh_ratio)
        out[0, 0] = self.positions[segments] + rows[0]
        for k in range(1, order + 1):
            out[k, 0] = rows[k] if k < 3 else b2 * out[k - 2, 0]
        return out

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        b0, b1, b2 = self._powers[:, segment].tolist()
        longest = b2 * float(self.breakpoints[segment + 1] - self.breakpoints[segment]) ** 2
        rows: list[Value] = list(_motion(b0**0.5, b1, b2, s, lambda z: _ratio_of_symbol(z, longest)))
        while len(rows) <= order:
            rows.append(b2 * rows[-2])
        found: list[Value] = [float(self.positions[segment]) + rows[0]]
        return [[*found, *(rows[k] / FACTORIALS[k] for k in range(1, order + 1))]]

    def _has_quick_peaks(self) -> bool:
        return True


def _motion(v0: Value, b1: Value, b2: Value, t: Value, ratio: Callable[[Value], Value]) -> tuple[Value, Value, Value]:
    """Distance, rate and its derivative at a time in a cell."""
    half = 0.5 * t * ratio(0.25 * b2 * t * t)  # sinh(w t/2)/w
    lift = 2.0 * half * half  # (cosh(w t) - 1)/w^2
    whole = t * ratio(b2 * t * t)
    distance = v0 * whole + 0.5 * b1 * lift
    return distance, v0 * (1.0 + b2 * lift) + 0.5 * b1 * whole, 0.5 * b1 + b2 * distance


def _series(z: Value) -> Value:
    """sinh(x)/x by x^2, for small ones."""
    found = 1.0
    for k in range(_SERIES, 0, -1):
        found = 1.0 + z / (2.0 * k * (2.0 * k + 1.0)) * found
    return found


def _sinh_ratio(z: Array) -> Array:
    """sinh(x)/x by x^2; sin(x)/x for negative ones."""
    found = _series(z)
    far = np.abs(z) > 4.0
    if far.any():
        root = np.sqrt(np.abs(z[far]))
        with np.errstate(over="ignore"):
            found[far] = np.where(z[far] > 0.0, np.sinh(root), np.sin(root)) / root
    return found


def _ratio_of_symbol(z: Value, longest: float) -> Value:
    """The same for a symbol, by the value at the end of the cell."""
    if abs(longest) <= 4.0:
        return _series(z)
    root = (z * np.sign(longest) + 1e-300) ** 0.5
    return (np.sinh(root) if longest > 0.0 else np.sin(root)) / root


def _smallest(table: Array) -> Array:
    """Minimum of the squared rate within each cell, without its ends."""
    first, middle, last = table
    bend = first - 2.0 * middle + last
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (first - middle) / bend
        vertex = first - (first - middle) ** 2 / bend
    inside = (bend > 0.0) & (u > 0.0) & (u < 1.0)
    return np.where(inside, vertex, np.maximum(np.maximum(first, last), middle))


def _durations(table: Array, lengths: Array) -> Array:
    """Durations [s] of cells."""
    first, middle, last = table
    rates = np.sqrt(first) + np.sqrt(last)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (first - 2.0 * middle + last) / rates**2
        return np.where(rates > 0.0, 2.0 * lengths / rates * _artanh_ratio(z), np.pi * lengths / np.sqrt(2.0 * middle))


def _artanh_ratio(z: Array) -> Array:
    """artanh(x)/x by x^2; arctan(x)/x for negative ones."""
    root = np.sqrt(np.abs(z))
    found = 1.0 + z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0 + z * (1.0 / 11.0 + z / 13.0)))))
    far = np.abs(z) > 1e-3
    if far.any():
        found[far] = np.where(z[far] > 0.0, np.arctanh(np.minimum(root[far], 1.0)), np.arctan(root[far])) / root[far]
    return found
