"""Functions of all segments of a piecewise spline, in one batch."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Value
from ctrlplan.trajectories.common import FACTORIALS, Array, derivative_scale, readonly
from ctrlplan.trajectories.conjugate import SHORT, Kind, segment_system
from ctrlplan.trajectories.fields import Fields
from ctrlplan.trajectories.newton import NEARLY_CLOSED, NewtonSystem

_AMPLIFIED = 1e4
"""Amplification of rounding errors above which each segment is fitted with a check of its accuracy."""

_SMALLEST = 1e-290
"""Smallest power of a duration."""

_CHUNK = 4104
"""Number of times that are evaluated together."""


class Run(Fields):
    """Consecutive segments in the same Newton form.

    Attributes
    ----------
    system : NewtonSystem
        Collocation on the unit segment.
    first, last : int
        First segment, and the one after the last.
    coefficients : ndarray, shape (size, naxes, nsegments)
        Of the segments of this run.
    """

    system: NewtonSystem
    first: int
    last: int
    coefficients: Array

    def __init__(self, system: NewtonSystem, first: int, coefficients: Array) -> None:
        last = first + coefficients.shape[2]
        self._fill(system=system, first=first, last=last, coefficients=readonly(coefficients))


class Pieces(Fields):
    """Functions of some axes on all segments.

    Attributes
    ----------
    axes : tuple of int
        The axes.
    runs : tuple of Run
        Their segments: one run, or the first, the inner and the last.
    """

    axes: tuple[int, ...]
    runs: tuple[Run, ...]

    def __init__(self, axes: Sequence[int], runs: Sequence[Run]) -> None:
        self._fill(axes=tuple(axes), runs=tuple(runs))

    def run(self, segment: int) -> Run:
        """Run that contains a segment."""
        return next(run for run in self.runs if segment < run.last)

    def of_segment(self, segment: int) -> tuple[NewtonSystem, Array]:
        """Newton form of a segment, and its coefficients (size, naxes)."""
        run = self.run(segment)
        return run.system, np.asfortranarray(run.coefficients[:, :, segment - run.first])

    def jet(self, segment: int, u: Array, order: int) -> Array:
        """Derivatives (order + 1, naxes, ntime) by the relative time in a segment."""
        system, coefficients = self.of_segment(segment)
        return system.jet(coefficients, u, order)

    def at_fractions(self, u: Array, order: int) -> Array:
        """Taylor coefficient (naxes, nsegments, ntime) of an order at the same relative times of all segments."""
        found = [_on_segments(run, run.system.taylor_between(u, order)[order]) for run in self.runs]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=1)

    def jets(self, segments: NDArray[np.intp], u: Array, order: int) -> Array:
        """Taylor coefficients (order + 1, naxes, ntime) by the relative time, each time in its own segment."""
        out = np.empty((order + 1, len(self.axes), u.size))
        for begin in range(0, u.size, _CHUNK):
            part = slice(begin, begin + _CHUNK)
            inside, own = segments[part], u[part]
            for run in self.runs:
                if len(self.runs) == 1:
                    out[..., part] = _gathered(run, inside, own, order)
                    break
                where = np.flatnonzero((inside >= run.first) & (inside < run.last))
                if where.size:
                    out[..., begin + where] = _gathered(run, inside[where], own[where], order)
        return out

    def series_at(self, segment: int, u: float, order: int) -> list[list[float]]:
        """Taylor series by axis at one relative time, a number."""
        run = self.runs[0] if len(self.runs) == 1 else self.run(segment)
        return run.system.series_at(run.coefficients[:, :, segment - run.first].T.tolist(), u, order)

    def rows(self, segments: NDArray[np.intp], low: int, high: int) -> Array:
        """Interpolants (nsegments, high - low + 1, naxes, nterms) of Taylor coefficients by the relative time.

        Numbers of segments must increase.
        """
        found = [(run, run.system.interpolants(low, high)) for run in self.runs]
        if len(found) == 1:
            return _rows(*found[0], segments)
        out = np.zeros((segments.size, high - low + 1, len(self.axes), max(basis.shape[2] for _, basis in found)))
        for run, basis in found:
            own = (segments >= run.first) & (segments < run.last)
            out[own, :, :, : basis.shape[2]] = _rows(run, basis, segments[own])
        return out

    def at(self, segment: int, u: Value, order: int) -> list[list[Value]]:
        """Taylor series by axis at one relative time, a number or a symbol."""
        system, coefficients = self.of_segment(segment)
        return system.series(coefficients, u, order)


class Form:
    """Newton form of consecutive segments of one kind, without the values of their entries.

    Parameters
    ----------
    alpha : float
        Shape parameter [rad] of each segment.
    kind : Kind
        The segments, and the orders of the entries that determine each.
    times : ndarray, shape (nsegments + 1,)
        Ends of all segments of the plan [s].
    """

    def __init__(self, alpha: float, kind: Kind, times: Array) -> None:
        self.kind, self.times = kind, times
        self.system = segment_system(alpha, kind.ends)
        self.is_careful = alpha > NEARLY_CLOSED or self.system.amplification > _AMPLIFIED
        """Whether each segment is fitted with a check of its accuracy."""

    def coefficients(self, rows: NDArray[Any]) -> Array:
        """Coefficients (size, naxes, nsegments) from entries (naxes, size, nwaypoints)."""
        system = self.system
        with np.errstate(over="ignore", invalid="ignore"):
            if self.is_careful:
                data = self._taylor_data(rows).astype(float, copy=False)
                found = self._carefully_solved(rows.astype(float, copy=False), data)
            elif self._in_turn and system.inverse is not None and rows.dtype == float:
                found = self._multiplied(rows, system.inverse)
            else:
                data = self._taylor_data(rows)
                found = system.coefficients_of_many(data.reshape(len(data), -1))
                found = np.ascontiguousarray(found).reshape(system.size, *data.shape[1:])
            if not math.isfinite(np.add.reduce(found, axis=None)) and not np.isfinite(found).all():
                wrong = self.kind.first + int(np.flatnonzero(~np.isfinite(found).all(axis=(0, 1)))[0])
                raise ValueError(
                    "coefficients must stay within floating point, got an overflow from waypoint entries of up to "
                    f"{np.abs(rows[:, :, wrong : wrong + 2]).max():g} over {self.durations[wrong - self.kind.first]:g} "
                    f"s from waypoints[{wrong}]"
                )
        return found

    def resolve(self, found: Array, decimals: NDArray[np.object_]) -> None:
        """Replace the coefficients of short segments, which are sensitive to rounding of the entries at their ends."""
        system, times, first = self.system, self.times, self.kind.first
        longest = float(np.diff(times).max())
        for k in range(first, self.kind.last):
            duration = float(times[k + 1] - times[k])
            if duration < SHORT * longest:
                digits = math.ceil(2 * decimals.shape[1] * math.log10(longest / duration))
                values = decimals[:, system.order_index, k + system.waypoint_index].T
                found[:, :, k - first] = system.resolved(values, times[k : k + 2].tolist(), duration, digits)

    @cached_property
    def durations(self) -> Array:
        """Durations of the segments [s]."""
        return self._durations(float)

    def _durations(self, dtype: Any) -> NDArray[Any]:
        first, last = self.kind.first, self.kind.last
        times = self.times[first : last + 1].astype(dtype, copy=False)
        return np.asarray(times[1:] - times[:-1])

    @cached_property
    def _factors(self) -> NDArray[Any]:
        return self._factors_of(self.durations)

    def _factors_of(self, durations: NDArray[Any]) -> NDArray[Any]:
        """Factors (norders, nsegments) from derivatives to Taylor coefficients in relative time."""
        powers = np.ones((1 + int(self.system.order_index.max()), durations.size), dtype=durations.dtype)
        with np.errstate(over="ignore", under="ignore"):
            for before, power in itertools.pairwise(powers):
                np.multiply(before, durations, out=power)
        if not (powers[-1].min() > _SMALLEST and powers[-1].max() < np.inf):
            wrong = durations[~((powers[-1] > _SMALLEST) & (powers[-1] < np.inf))]
            raise ValueError(
                f"powers of the duration must stay within floating point, got {wrong[0]:g} s to the power "
                f"{len(powers) - 1}; choose another unit of time"
            )
        powers /= FACTORIALS[: len(powers), None]
        return powers

    def _taylor_data(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Taylor data (nentries, naxes, nsegments) in relative time, in the order of the system."""
        system, first = self.system, self.kind.first
        factors = self._factors if rows.dtype == float else self._factors_of(self._durations(rows.dtype))
        count = self.kind.last - first
        data = np.empty((system.order_index.size, len(rows), count), dtype=rows.dtype)
        for row, waypoint, order in zip(data, system.waypoint_index.tolist(), system.order_index.tolist(), strict=True):
            np.multiply(rows[:, order, first + waypoint : first + waypoint + count], factors[order], out=row)
        return data

    def _multiplied(self, rows: Array, inverse: Array) -> Array:
        """Coefficients from entries in turn: the position at the start, and a product with all that differs from it."""
        first, last = self.kind.first, self.kind.last
        positions = rows[:, 0]
        data = np.empty((len(inverse) - 1, len(rows), last - first))
        np.subtract(positions[:, first + 1 : last + 1], positions[:, first:last], out=data[0])
        by_order = data[1:].reshape(-1, 2, *data.shape[1:])
        factors = self._factors[1 : 1 + len(by_order), None]
        for end in (0, 1):
            own = rows[:, 1 : 1 + len(by_order), first + end : last + end]
            np.multiply(own.swapaxes(0, 1), factors, out=by_order[:, end])
        found = np.empty((len(inverse), *data.shape[1:]))
        found[0] = positions[:, first:last]
        np.matmul(inverse[1:, 1:], data.reshape(len(data), -1), out=found[1:].reshape(len(data), -1))
        return found

    @cached_property
    def _in_turn(self) -> bool:
        """Whether entries are ordered by their order, those of both ends in turn."""
        every = range(len(self.kind.ends[0]))
        places = zip(self.system.waypoint_index.tolist(), self.system.order_index.tolist(), strict=True)
        return list(places) == [(end, order) for order in every for end in (0, 1)]

    def _carefully_solved(self, rows: Array, data: Array) -> Array:
        """Coefficients (size, naxes, nsegments), each segment with a check of the rounding errors."""
        system, first, found = self.system, self.kind.first, []
        for k in range(first, self.kind.last):
            values = rows[:, system.order_index, k + system.waypoint_index].T
            moments = self.times[k : k + 2].tolist()
            found.append(system.fitted(values, moments, moments[1] - moments[0], data[:, :, k - first]))
        return np.stack(found, axis=2)


def fitted(
    axes: Sequence[int], forms: Sequence[Form], rows: NDArray[Any], decimals: NDArray[np.object_] | None = None
) -> Pieces:
    """Functions through complete entries (naxes, size, nsegments + 1), of doubles or extended numbers.

    Segments much shorter than the longest get all digits of entries in decimals.
    """
    runs = []
    for form in forms:
        found = form.coefficients(rows)
        if decimals is not None and form.system.hermite:
            form.resolve(found, decimals)
        runs.append(Run(form.system, form.kind.first, found))
    return Pieces(axes, runs)


def _rows(run: Run, basis: Array, segments: NDArray[np.intp]) -> Array:
    """Interpolants of segments of a run, from those of the basis (norders, size, nterms)."""
    coefficients = run.coefficients.T
    if segments.size < len(coefficients):
        coefficients = coefficients[segments - run.first]
    return np.asarray(coefficients[:, None] @ basis)


def _on_segments(run: Run, functions: Array) -> Array:
    """Values (naxes, nsegments, ntime) from those of the basis (size, ntime)."""
    size, naxes, nsegments = run.coefficients.shape
    values = run.coefficients.reshape(size, -1).T @ functions  # one product of matrices
    return np.asarray(values.reshape(naxes, nsegments, -1))


def _gathered(run: Run, segments: NDArray[np.intp], u: Array, order: int) -> Array:
    taylor = run.system.taylor(u, order)
    return np.asarray(np.einsum("mkt,mat->kat", taylor, run.coefficients[:, :, segments - run.first]))


def scales(durations: Array, order: int) -> Array:
    """Factors (order + 1, ntime) from Taylor coefficients in relative time to derivatives."""
    if durations.size == 1:
        return derivative_scale(float(durations[0]), order)[:, None]
    with np.errstate(over="ignore", divide="ignore", under="ignore"):
        found: Array = FACTORIALS[: order + 1, None] / durations ** np.arange(order + 1)[:, None]
    return found
