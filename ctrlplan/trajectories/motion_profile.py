"""Motion with piecewise constant jerk, acceleration or another derivative."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_labels, new_numbers
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import FACTORIALS, Array, mapped_time, readonly, times_powers
from ctrlplan.trajectories.trajectory import Trajectory

_MISMATCH = 1e-6
"""Deviation from the end state, relative to the motion, that is an error; below, it is corrected."""


class MotionProfile(Trajectory):
    """Motion with a piecewise constant highest derivative.

    The highest derivative is the jerk for states of position, velocity and
    acceleration, and the acceleration for states of position and velocity.
    The state at both ends is exact: each axis is integrated forwards from the
    start, and backwards from the end where its highest derivative is not 0 for
    the last time.

    Parameters
    ----------
    breakpoints : array_like, shape (nsegments + 1,)
        Times [s] between which the highest derivative is constant, increasing.
    values : array_like, shape (naxes, nsegments)
        Values of the highest derivative [unit of the axis per s^order].
    start_state : array_like, shape (order, naxes)
        Position and derivatives below the highest at the start.
    end_state : array_like, shape (order, naxes), optional
        The same at the end. It may differ from the integral of `values` by their
        rounding, which is then corrected in the values. Default: that integral.
    labels : sequence of str, optional
        Names of the axes.

    Attributes
    ----------
    values, start_state, end_state : ndarray
        The arguments.

    Raises
    ------
    ValueError
        If shapes differ, a number is not finite, times do not increase, or the
        values do not lead from the start state to the end state.

    Examples
    --------
    A stop from 1 m/s with a deceleration of 0.5 m/s^2:

    >>> stop = MotionProfile([0.0, 2.0], [[-0.5]], [[3.0], [1.0]], labels="x")
    >>> stop.final, stop.end_state.tolist(), stop(1.0)
    (array([4.]), [[4.0], [0.0]], array(3.75))
    """

    values: Array
    start_state: Array
    end_state: Array
    initial: Array
    final: Array
    _jets: Array  # (order + 1, naxes, nsegments), at the anchor of each segment
    _anchors: Array  # (naxes, nsegments), from the start of the segment [s]

    def __init__(
        self,
        breakpoints: ArrayLike,
        values: ArrayLike,
        start_state: ArrayLike,
        end_state: ArrayLike | None = None,
        *,
        labels: Sequence[str] | str | None = None,
    ) -> None:
        times, rows = _finite(breakpoints, "breakpoints", 1), _finite(values, "values", 2)
        first = _finite(start_state, "start_state", 2)
        naxes = first.shape[1]
        if times.size < 2 or not (np.diff(times) > 0.0).all():
            raise ValueError(f"breakpoints must be two or more and increase strictly, got {times.tolist()}")
        if rows.shape != (naxes, times.size - 1):
            raise ValueError(
                f"values must have shape (naxes, nsegments), ({naxes}, {times.size - 1}), got shape {rows.shape}"
            )
        names = checked_labels(labels, naxes)
        if end_state is None:
            last = _states(first, rows, np.diff(times))[:, :, -1]
        else:
            last = _finite(end_state, "end_state", 2)
            if last.shape != first.shape:
                raise ValueError(f"end_state must have the shape of start_state, {first.shape}, got {last.shape}")
            rows = _checked_correction(rows, np.diff(times), first, last, names)
        self._set(times, rows, first, last, names)

    def _set(self, times: Array, values: Array, first: Array, last: Array, labels: Sequence[str]) -> None:
        durations = np.diff(times)
        order, (naxes, count) = len(first), values.shape
        jets = np.empty((order + 1, naxes, count))
        jets[order] = values
        jets[:order] = _states(first, values, durations)[:, :, :-1]
        from_end = _states(last, values[:, ::-1], -durations[::-1])[:, :, -2::-1]
        anchors = np.zeros((naxes, count))
        for axis, row in enumerate(values):
            split = int(np.flatnonzero(row)[-1]) if row.any() else count - 1
            jets[:order, axis, split:] = from_end[:, axis, split:]
            anchors[axis, split:] = durations[split:]
        self._set_fields(
            values=values,
            start_state=first,
            end_state=last,
            labels=tuple(labels),
            breakpoints=readonly(times),
            initial=readonly(first[0].copy()),
            final=readonly(last[0].copy()),
            _jets=jets,
            _anchors=anchors,
        )

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        names = ("breakpoints", "values", "start_state", "end_state")
        return {
            "type": "MotionProfile",
            **{name: getattr(self, name).tolist() for name in names},
            "labels": list(self.labels),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        states = [data[name] for name in ("start_state", "end_state")]
        checked = cls(data["breakpoints"], data["values"], *states, labels=data["labels"])
        self = cls.__new__(cls)  # with the values as they are: another correction would change their last digits
        values = np.array(data["values"], dtype=float)
        self._set(checked.breakpoints, values, checked.start_state, checked.end_state, checked.labels)
        return self

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        times = [mapped_time(time, origin, target, rate) for time in self.breakpoints.tolist()]
        orders = np.arange(len(self.start_state))[:, None]
        first, last = (times_powers(state, rate, orders) for state in (self.start_state, self.end_state))
        values = times_powers(self.values, rate, np.array(len(self.start_state)))
        return type(self)(times, values, first, last, labels=self.labels)

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        x = s - self._anchors[:, segment, None]
        found = np.zeros((order + 1, *x.shape))
        rows = shifted(self._jets[:, :, segment, None], x)[: order + 1]
        found[: len(rows)] = rows
        return found

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        found = []
        for jet, anchor in zip(self._jets[:, :, segment].T.tolist(), self._anchors[:, segment].tolist(), strict=True):
            rows: list[Value] = [value / FACTORIALS[k] for k, value in enumerate(shifted(jet, s - anchor))]
            found.append([*rows, *[0.0] * order][: order + 1])
        return found


def shifted(jet: Value, x: Value, order: int | None = None) -> list[Value]:
    """Derivatives at x, all or up to an order, of the polynomial with given derivatives at 0."""
    rows = []
    for low in range(len(jet) if order is None else min(order + 1, len(jet))):
        value = jet[-1]
        for k in range(len(jet) - 2, low - 1, -1):
            value = jet[k] + value * x / (k - low + 1)
        rows.append(value + 0.0 * x if low == len(jet) - 1 else value)
    return rows


def _states(first: Array, values: Array, durations: Array) -> Array:
    """States (order, naxes, nsegments + 1) at the ends of segments with given highest derivatives."""
    states = [first]
    for value, duration in zip(values.T, durations.tolist(), strict=True):
        states.append(np.array(shifted([*states[-1], value], duration)[:-1]))
    return np.stack(states, axis=2)


def corrected(values: Array, durations: Array, first: Array, last: Array, orders: Sequence[int]) -> tuple[Array, Array]:
    """Values of the highest derivative of one axis, corrected such that the end state is reached.

    The correction is that of minimum norm, the same for neighbouring equal
    values; values of 0 remain.

    Parameters
    ----------
    values, durations : ndarray, shape (nsegments,)
        Highest derivative, and durations of the segments [s].
    first, last : ndarray, shape (order,)
        State at both ends.
    orders : sequence of int
        Entries of the end state that are to be reached.

    Returns
    -------
    values : ndarray, shape (nsegments,)
        Corrected values.
    residual : ndarray, shape (len(orders),)
        Deviation of the end state before the correction.
    """
    order = len(first)
    reached = _states(first[:, None], values[None], durations)[:, 0, -1]
    residual = (last - reached)[list(orders)]
    phases = np.cumsum(np.append(True, values[1:] != values[:-1])) - 1
    moved = [k for k in range(phases[-1] + 1) if values[np.argmax(phases == k)]]
    if not moved or not residual.any():
        return values, residual
    after = np.append(np.cumsum(durations[::-1])[::-1][1:], 0.0)  # time from the end of each segment to the end
    powers = order - np.array(orders)[:, None]
    effects = ((after + durations) ** powers - after**powers) / FACTORIALS[powers]
    matrix = np.stack([effects[:, phases == k].sum(axis=1) for k in moved], axis=1)
    scale = float(durations.sum()) ** powers
    change = np.linalg.lstsq(matrix / scale, residual / scale[:, 0], rcond=1e-12)[0]
    found = values.copy()
    for k, value in zip(moved, change.tolist(), strict=True):
        found[phases == k] += value
    return found, residual


def _checked_correction(values: Array, durations: Array, first: Array, last: Array, labels: Sequence[str]) -> Array:
    """Values corrected for rounding, axis by axis, after a check that they lead to the end state."""
    total, order = float(durations.sum()), len(first)
    rows = []
    for axis, label in enumerate(labels):
        row, residual = corrected(values[axis], durations, first[:, axis], last[:, axis], range(order))
        rows.append(row)
        units = total ** np.arange(order)
        size = np.abs(values[axis]).max() * total**order
        size = max(float(size), *(np.abs(state[1:, axis] * units[1:]).max(initial=0.0) for state in (first, last)))
        rounding = 1e-12 * max(abs(first[0, axis]), abs(last[0, axis]))
        if (np.abs(residual) * units > _MISMATCH * size + rounding).any():
            raise ValueError(
                f"values must lead from start_state to end_state, got {label} off by "
                f"{', '.join(f'{value:.3g}' for value in residual.tolist())} in the entries of end_state"
            )
    return np.array(rows)


def _finite(values: ArrayLike, name: str, ndim: int) -> Array:
    found = new_numbers(values, name)
    if found.ndim != ndim or not found.size:
        raise ValueError(f"{name} must be an array of {ndim} dimensions, got shape {found.shape}")
    if not np.isfinite(found).all():
        raise ValueError(f"{name} must be finite, got {found.tolist()}")
    return found


def profile_of_phases(
    time: float,
    phases: Sequence[tuple[Sequence[float], Sequence[float]]],
    start_state: Array,
    end_state: Array,
    labels: Sequence[str],
) -> MotionProfile | None:
    """Profile of axes with phases of their own.

    Parameters
    ----------
    time : float
        Start [s].
    phases : sequence of (durations, values)
        For each axis the durations of its phases [s] and the values of its highest
        derivative, which is 0 afterwards.
    start_state, end_state : ndarray, shape (order, naxes)
        States at both ends; a position of nan at the end is free.
    labels : sequence of str
        Names of the axes.

    Returns
    -------
    MotionProfile or None
        None if floating-point times do not resolve the motion.
    """
    edges = [time + np.append(0.0, np.cumsum(durations)) for durations, _ in phases]
    every = np.sort(np.concatenate(edges))
    near = 8.0 * float(np.spacing(np.abs(every).max()))
    times = every[np.append(True, np.diff(every) > near)]
    if times.size < 2:
        return None
    middles, durations = 0.5 * (times[:-1] + times[1:]), np.diff(times)
    values, last = np.zeros((len(phases), middles.size)), end_state.copy()
    for axis, (own, (_, given)) in enumerate(zip(edges, phases, strict=True)):
        number = np.searchsorted(own, middles, side="right") - 1
        row = np.append(given, 0.0)[number]
        first = start_state[:, axis]
        if np.isnan(last[0, axis]):
            row, _ = corrected(row, durations, first, last[:, axis], range(1, len(first)))
            last[0, axis] = _states(first[:, None], row[None], durations)[0, 0, -1]
        values[axis] = row
    return MotionProfile(times, values, start_state, last, labels=labels)
