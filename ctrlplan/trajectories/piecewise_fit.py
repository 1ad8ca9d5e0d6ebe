"""Functions of a piecewise spline from its entries, with all that does not depend on their values kept for others."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.common import Array, readonly
from ctrlplan.trajectories.conjugate import FreeEntries, FreePattern, Kind, kinds_of, rounded
from ctrlplan.trajectories.pieces import Form, Pieces, fitted


class Frame:
    """Times and prescribed entries of a piecewise spline, without the values of the latter.

    Parameters
    ----------
    alpha : float
        Shape parameter [rad] of each segment.
    times : ndarray, shape (nwaypoints,)
        Times of the waypoints [s], increasing.
    period : float or None
        Period of a closed plan.
    unknown : ndarray of bool, shape (naxes, size, nwaypoints)
        Free entries.

    Attributes
    ----------
    breakpoints : ndarray, shape (nsegments + 1,)
        Ends of the segments [s].

    Raises
    ------
    ValueError
        If a duration overflows, or the waypoints do not fit into a period.
    """

    def __init__(self, alpha: float, times: Array, period: float | None, unknown: NDArray[np.bool_]) -> None:
        self.alpha, self.times, self.period, self.unknown = alpha, times, period, unknown
        _check_durations(times, period)
        self.breakpoints = times if period is None else readonly(np.append(times, times[0] + period))

    def has(self, unknown: NDArray[np.bool_]) -> bool:
        """Whether entries have the same shape, and the same of them are free."""
        return unknown.shape == self.unknown.shape and unknown.tobytes() == self._unknown_bytes

    @cached_property
    def _unknown_bytes(self) -> bytes:
        return self.unknown.tobytes()

    def fitted(self, rows: Array) -> tuple[Array, tuple[Pieces, ...]]:
        """Entries with the free ones of inner waypoints filled in, and the functions of all segments.

        Parameters
        ----------
        rows : ndarray, shape (naxes, size, nwaypoints)
            Entries, nan where free.

        Returns
        -------
        filled : ndarray, shape (naxes, size, nsegments + 1)
            Entries; of a closed plan with the return to the first waypoint.
        pieces : tuple of Pieces
            The functions, of axes with equal kinds of segments together.
        """
        groups = self._groups
        if len(groups) == 1 and groups[0].whole:
            own, decimals = groups[0].filled(rows)
            return own.astype(float, copy=False), (fitted(groups[0].axes, groups[0].forms, own, decimals),)
        return self._fitted_apart(rows)

    def _fitted_apart(self, rows: Array) -> tuple[Array, tuple[Pieces, ...]]:
        """The same for axes with different prescribed entries."""
        filled = np.concatenate([rows, rows[:, :, :1]], axis=2) if self.period is not None else rows.copy()
        together: dict[tuple[object, ...], list[tuple[_Group, NDArray[Any], NDArray[np.object_] | None]]] = {}
        for group in self._groups:
            own, decimals = group.filled(rows[list(group.axes), : group.size])
            filled[list(group.axes), : group.size] = own
            alone = group.axes if decimals is not None or own.dtype != float else None
            together.setdefault((group.key, alone), []).append((group, own, decimals))
        pieces = []
        for members in together.values():
            tables = [own for _, own, _ in members]
            whole = tables[0] if len(tables) == 1 else np.concatenate(tables)
            axes = np.array([axis for group, _, _ in members for axis in group.axes])
            if len(tables) > 1:  # functions of all axes are in the order of the axes
                order = axes.argsort()
                axes, whole = axes[order], whole[order]
            pieces.append(fitted(axes.tolist(), members[0][0].forms, whole, members[0][2]))
        return filled, tuple(pieces)

    @cached_property
    def _groups(self) -> list[_Group]:
        known = ~self.unknown
        if known.all():
            return [_Group(self, tuple(range(len(known))), known[0])]
        return [_Group(self, axes, known[axes[0]]) for axes in alike(known.T)]


class _Group:
    """Axes with the same prescribed entries, `known` of shape (size, nwaypoints)."""

    def __init__(self, frame: Frame, axes: tuple[int, ...], known: NDArray[np.bool_]) -> None:
        closed = frame.period is not None
        self.axes, self.closed = axes, closed
        self.free: FreeEntries | None = None
        complete = known.all()
        self.size = len(known) if complete else 1 + int(np.flatnonzero(known.any(axis=1)).max(initial=0))
        self.whole = frame.unknown.shape[:2] == (len(axes), self.size)
        given = known[: self.size].T
        if not complete and not given[slice(None) if closed else slice(1, -1)].all():
            self.free = FreeEntries(FreePattern(frame.alpha, given, closed), frame.times, frame.period)
        kinds: list[Kind] = kinds_of(given, closed) if self.free is None else self.free.pattern.kinds
        self.forms = [Form(frame.alpha, kind, frame.breakpoints) for kind in kinds]
        self.key = self.size, tuple((kind.ends, kind.first) for kind in kinds)

    def filled(self, rows: Array) -> tuple[NDArray[Any], NDArray[np.object_] | None]:
        """All entries (naxes, size, nsegments + 1), of doubles or extended numbers, and in decimals if computed so."""
        own: NDArray[Any] = rows
        decimals = None
        if self.free is not None:
            values, pattern = self.free.solve(rows), self.free.pattern
            if values.dtype == object:
                decimals = _placed(rows.astype(object), pattern, values)
                values = rounded(values, pattern.alpha)
            own = _placed(rows.astype(values.dtype), pattern, values)
        if self.closed:
            own = np.concatenate([own, own[:, :, :1]], axis=2)
            decimals = None if decimals is None else np.concatenate([decimals, decimals[:, :, :1]], axis=2)
        return own, decimals


def _placed(rows: NDArray[Any], pattern: FreePattern, values: NDArray[Any]) -> NDArray[Any]:
    """Entries with the free ones of each axis replaced, in place."""
    if pattern.lowest is not None:
        inner = rows[:, pattern.lowest :, 1:-1]
        inner[...] = values.reshape(len(rows), inner.shape[2], inner.shape[1]).swapaxes(1, 2)
        return rows
    rows = np.ascontiguousarray(rows)
    rows.reshape(len(rows), -1)[:, pattern.places] = values
    return rows


def alike(known: NDArray[np.bool_]) -> list[tuple[int, ...]]:
    """Axes with the same prescribed entries (nwaypoints, size, naxes)."""
    naxes = known.shape[2]
    if naxes == 1 or (known == known[:, :, :1]).all():
        return [tuple(range(naxes))]
    patterns: dict[bytes, tuple[int, ...]] = {}
    for axis in range(naxes):
        key = known[:, :, axis].tobytes()
        patterns[key] = (*patterns.get(key, ()), axis)
    return list(patterns.values())


def _check_durations(times: Array, period: float | None) -> None:
    """Raise if a duration overflows, or if waypoints do not fit into a period."""
    start, last = float(times[0]), float(times[-1])
    end = last if period is None else start + period
    if not end - start < np.inf:
        raise ValueError(f"duration must be finite and above 0, got {end} s after {start} s")
    if period is not None and last >= end:
        raise ValueError(
            f"waypoints of a cyclic plan must lie within one period of {period:g} s from the first, "
            f"got waypoints[{times.size - 1}].time = {last}"
        )
