"""Responses of a loop to a plan of fixed shape, as functions of its duration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.cell_extrema import extrema_of_cells, joined
from ctrlplan.simulation.exact import exact_states
from ctrlplan.simulation.exact_response import Motion, extremes_of, free_cells, rate_rows, weighted
from ctrlplan.simulation.impulse_envelope import Curvature
from ctrlplan.simulation.loop_form import LoopForm, Rows
from ctrlplan.simulation.plan_cells import PlanCells, Segment

_SAMPLES = 256
"""Number of samples along a plan."""

_PER_SEGMENT = 36
"""Minimum number of samples of a segment: fewer are not propagated together for all durations."""

_PHASE = 0.35
"""Distance of samples after the plan, in the phase of a mode [rad]."""

_PER_MODE = 250
"""Maximum number of samples for a mode."""

_DECAYED = 12.0
"""Exponent from which on a mode is not sampled."""

_STEP_PARTS = 4
"""Maximum number of parts of the response to a step that are evaluated."""

_STACK = 64
"""Number of durations that are propagated together."""


@dataclass(frozen=True)
class LoopSignal:
    """Weighted sum of signals of a loop, or its time derivative, within a part of the plan.

    Attributes
    ----------
    weights : mapping of str to float
        Factors by the name of a signal.
    rate : bool
        Whether its time derivative is meant.
    during : (float, float) or None
        First and last time as fractions of the duration, 0 at the start of the
        plan; None for all times.
    """

    weights: Mapping[str, float]
    rate: bool = False
    during: tuple[float, float] | None = None


class ShapeFamily:
    """Signals of a loop along a plan of fixed shape, as functions of its duration.

    Parameters
    ----------
    form : LoopForm
        The loop.
    signals : mapping of str to Rows
        Signals of the loop by name.
    plan : PlanCells
        The plan in units of its duration.
    state : ndarray, shape (nstates,)
        State at rest at the start of the plan.
    chosen : sequence of LoopSignal
        The signals that are considered.

    Attributes
    ----------
    before : ndarray, shape (nsignals,)
        Values at rest before the plan.
    """

    def __init__(
        self,
        form: LoopForm,
        signals: Mapping[str, Rows],
        plan: PlanCells,
        state: Array,
        chosen: Sequence[LoopSignal],
    ) -> None:
        self.form, self.plan, self.state, self.chosen = form, plan, state, tuple(chosen)
        each = []
        for one in chosen:
            row = weighted(signals, one.weights)
            each.append(rate_rows(form, row, plan, " + ".join(one.weights)) if one.rate else row)
        self.rows = _stacked(each)
        self.before = self.rows.static(plan.initial, state)

    def curvature(self, low: Array, high: Array) -> Array:
        """Bounds (nintervals, nsignals) of the second derivative by the logarithm of the duration, for intervals."""
        return self._curvature(low, high)

    @cached_property
    def _curvature(self) -> Curvature:
        return Curvature(self.form, self.rows, self.plan)

    def extremes(self, duration: float) -> tuple[Array, Array, Array, Array]:
        """Minima, maxima (nsignals,) and their times [s] since the start, over all times, for a duration."""
        motion = Motion(self.form, self.plan, duration, self.state)
        found = np.empty((4, len(self.chosen)))
        for during in {one.during for one in self.chosen}:
            own = [i for i, one in enumerate(self.chosen) if one.during == during]
            rows = Rows(self.rows.c[own], self.rows.d[own])
            span = None if during is None else (during[0] * duration, during[1] * duration)
            found[:, own] = extremes_of(motion, rows, during=span)
        return found[0], found[1], found[2], found[3]

    def value(self, duration: float, signal: int, time: float) -> tuple[float, float]:
        """Values just before and after a time [s] since the start; after the plan the time is absolute."""
        motion = Motion(self.form, self.plan, duration, self.state)
        row = Rows(self.rows.c[signal : signal + 1], self.rows.d[signal : signal + 1])
        low, high, *_ = extremes_of(motion, row, during=(time, time))
        return float(low[0]), float(high[0])

    def step(self) -> tuple[Array, Array, Array]:
        """Attained minima and maxima (nsignals,) for a step, and by how much per second of duration a plan may differ.

        The rates are infinite for signals to which derivatives of the plan contribute.
        """
        form, plan, rows = self.form, self.plan, self.rows
        constant, projection = form.settling(plan.final)
        final = constant + projection @ self.state
        values = np.stack([self.before, rows.static(plan.final, final)], axis=1)
        parts = []
        for cells, bounds in free_cells(form, rows.c, (self.state - final)[:, None]):
            cells.series[0] += values[:, 1:]
            parts.append(cells)
            # Values that are attained, not all extrema, exclude short plans.
            if len(parts) == _STEP_PARTS or np.all(bounds <= 1e-6 * np.ptp(values, axis=1)):
                break
        low, high = values.min(axis=1), values.max(axis=1)
        if parts:
            low, high, *_ = extrema_of_cells(joined(parts), values, np.array([0.0, math.inf]))
        whole = form.order > 0 or rows.order > 0 or form.integrators > 0 or any(one.during for one in self.chosen)
        if whole:
            return low, high, np.full(len(rows.c), math.inf)
        sizes = self._curvature.envelope.largest(0, np.zeros(1))[0]
        return low, high, np.asarray(sizes @ (2.0 * plan.peak(1)))

    def static(self) -> tuple[Array, Array]:
        """Minima and maxima (nsignals,) that the signals approach for long durations."""
        form = self.form
        if form.integrators:
            nothing = np.full(len(self.rows.c), math.nan)
            return nothing, nothing
        gain = self.rows.d[:, 0] - self.rows.c @ np.linalg.solve(form.a, form.b[0])
        values = np.concatenate([gain @ segment.jet(s, 0, 0)[0] for segment, s in self._segments], axis=1)
        for i, one in enumerate(self.chosen):
            if one.during is not None:
                values[i] = np.where(
                    (self._grid.fractions < one.during[0]) | (self._grid.fractions > one.during[1]), math.nan, values[i]
                )
        with np.errstate(all="ignore"):
            low, high = np.fmin.reduce(values, axis=1), np.fmax.reduce(values, axis=1)
        return np.asarray(low), np.asarray(high)

    def from_static(self, durations: Array) -> Array:
        """Bounds (ndurations, nsignals) of the distance from the signals that are approached for long durations."""
        return self._curvature.from_static(durations)

    @property
    def _segments(self) -> list[tuple[Segment, Array]]:
        """Segments of the plan with the times of their samples."""
        return list(zip(self.plan.segments, self._grid.times, strict=True))

    def samples(self, durations: Array) -> Array:
        """Values (ndurations, nsignals, nsamples) at fixed fractions of the plan, and at fixed times after it.

        nan outside of the part of the plan that is considered.
        """
        parts = [self._samples(durations[k : k + _STACK]) for k in range(0, durations.size, _STACK)]
        return np.concatenate(parts)

    def _samples(self, durations: Array) -> Array:
        form, plan = self.form, self.plan
        grid, t = self._grid, durations[:, None, None]
        b = np.concatenate([t ** (1 - k) * form.b[k] for k in range(form.order + 1)], axis=2)

        state = np.broadcast_to(self.state, (durations.size, form.nstates))
        parts = []
        for segment, s in self._segments:

            def jet(moment: float, origin: float, s: Array, order: int, segment: Segment = segment) -> Array:
                return segment.jet(origin + s, order, form.order)

            states = exact_states(t * form.a, b, jet, (), s, state)
            state = states[:, :, -1]
            parts.append(self.rows.c @ states)
        along = np.concatenate(parts, axis=2)
        for k, values in enumerate(grid.direct):
            along += values / t**k
        end = state
        constant, projection = form.settling(plan.final)
        settled = constant + end @ projection.T
        offset = (settled @ self.rows.c.T + self.rows.d[:, 0] @ plan.final)[:, :, None]
        moments, table = self._tail
        after = ((end - settled) @ table.T).reshape(durations.size, len(self.chosen), -1) + offset
        found = np.concatenate([along, after, offset], axis=2)
        for i, one in enumerate(self.chosen):
            if one.during is not None:
                tau = np.empty((durations.size, found.shape[2]))
                tau[:, : grid.fractions.size], tau[:, -1] = grid.fractions, math.inf
                tau[:, grid.fractions.size : -1] = 1.0 + moments / durations[:, None]
                found[:, i][(tau < one.during[0]) | (tau > one.during[1])] = math.nan
        return found

    @cached_property
    def _grid(self) -> _Grid:
        """Samples along the plan: evenly spaced in each segment, both ends included."""
        rows, times, fractions, direct = self.rows, [], [], []
        factors = np.array([math.factorial(k) for k in range(rows.order + 1)])[:, None, None]
        for segment in self.plan.segments:
            count = max(_PER_SEGMENT, 5 * segment.terms.shape[2], round(_SAMPLES * segment.length))
            s = segment.length * np.arange(count + 1) / count
            times.append(s)
            fractions.append(segment.left + s)
            jet = segment.series(s, 1.0, rows.order + 1) * factors
            direct.append([rows.d[:, k] @ jet[k] for k in range(rows.order + 1)])
        return _Grid(times, np.concatenate(fractions), np.concatenate(direct, axis=2))

    @cached_property
    def _tail(self) -> tuple[Array, Array]:
        """Times after the plan of samples, and the matrix (nsignals * nsamples, nstates) of their deviations."""
        n, times = self.form.nstates, self._moments
        tables, done = [np.zeros((len(self.chosen), 0, n))], 0
        for cells, _ in free_cells(self.form, self.rows.c, np.eye(n)):
            by = np.argsort(cells.starts)
            starts, lengths, series = cells.starts[by], cells.lengths[by], cells.series[:, :, by]
            count = int(np.searchsorted(times, starts[-1] + lengths[-1], side="right"))
            own, done = times[done:count], count
            where = np.searchsorted(starts, own, side="right") - 1
            angles = np.arccos(np.clip(2.0 * (own - starts[where]) / lengths[where] - 1.0, -1.0, 1.0))
            basis = np.cos(np.arange(len(series))[:, None] * angles)
            values = np.einsum("jrk,jk->rk", series[:, :, where], basis)
            tables.append(values.reshape(len(self.chosen), n, -1).transpose(0, 2, 1))
            if count == times.size:
                break
        table = np.concatenate(tables, axis=1)
        return times[: table.shape[1]], table.reshape(-1, n) if n else np.zeros((0, 0))

    @property
    def _moments(self) -> Array:
        """Times after the plan of samples: several in each oscillation of each mode, until it has decayed."""
        found = [np.zeros(1)]
        for pole in self.form.poles[np.abs(self.form.poles.real) > 0.0]:
            step = _PHASE / abs(pole)
            count = min(_PER_MODE, math.ceil(_DECAYED / abs(pole.real) / step))
            found.append(step * np.arange(1, count + 1))
        return np.unique(np.concatenate(found)) if self.form.nstates > self.form.integrators else np.zeros(0)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Samples along a plan.

    Times since the start of each segment, fractions (nsamples,) of the plan, and direct contributions (order + 1,
    nsignals, nsamples) of each derivative of the plan, in units of its duration.
    """

    times: list[Array]
    fractions: Array
    direct: Array


def _stacked(parts: Sequence[Rows]) -> Rows:
    """Rows of several parts together."""
    order = max(rows.d.shape[1] for rows in parts)
    d = [np.pad(rows.d, ((0, 0), (0, order - rows.d.shape[1]), (0, 0))) for rows in parts]
    return Rows(np.concatenate([rows.c for rows in parts]), np.concatenate(d))
