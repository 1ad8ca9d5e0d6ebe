"""Exact response of a stable linear loop along one plan, with certified extrema over all times."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.cell_extrema import Cells, extrema_of_cells, joined, mean_square
from ctrlplan.simulation.exact import changes_over
from ctrlplan.simulation.loop_form import NODES, NTERMS, SIGMA, LoopForm, Rows
from ctrlplan.simulation.loop_inputs import is_cyclic
from ctrlplan.simulation.loop_response import Extremes, LoopResponse
from ctrlplan.simulation.plan_cells import PlanCells
from ctrlplan.simulation.recurrences import repeated
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.chebyshev import transform

_REST = 1e-12
"""Bound of what follows the evaluated part of the tail, relative to the range of a signal."""

_FEW = 32
"""Number of equal steps below which they are computed one after the other."""

_FIRST = 16
"""Number of cells of the tail that are evaluated first; then twice as many, and so on."""

_FACTORIALS = np.cumprod(np.concatenate([[1.0], np.arange(1.0, 64.0)]))


@dataclass(frozen=True, eq=False)
class _Part:
    """Cells of one length.

    Starts [s] since the start of the plan, states (nstates, ncells) there, Taylor terms (nterms, naxes, ncells) of the
    plan, and the interval of time to which the cells belong.
    """

    level: int
    starts: Array
    states: Array
    terms: Array
    first: float
    last: float


class Motion:
    """States of a loop along a plan of a given duration; times are since its start.

    Parameters
    ----------
    form : LoopForm
        The loop.
    plan : PlanCells
        The plan in units of its duration.
    duration : float
        Duration [s].
    state : ndarray, shape (nstates,)
        State at the start, in balanced coordinates.

    Attributes
    ----------
    settled : ndarray, shape (nstates,)
        State that the loop approaches after the plan.
    """

    def __init__(self, form: LoopForm, plan: PlanCells, duration: float, state: Array) -> None:
        self.form, self.plan, self.duration, self.start = form, plan, duration, state
        self._parts: list[_Part] = []
        for k in range(len(plan.segments)):
            state = self._segment(k, state)
        size = max(float(np.abs(part.states).max(initial=0.0)) for part in self._parts)
        self.settled = form.settled(state, plan.final, size)
        self.end = state

    def cells(self, rows: Rows) -> Cells:
        """Outputs along the plan as series."""
        return joined([_cells(self.form, rows, part) for part in self._parts])

    def tail(self, rows: Rows) -> Iterator[tuple[Cells, Array]]:
        """Outputs after the plan, with bounds (nrows,) of their distance from the final values after each part."""
        final = rows.static(self.plan.final, self.settled)
        for cells, bounds in free_cells(self.form, rows.c, (self.end - self.settled)[:, None]):
            cells.series[0] += final[:, None]
            yield replace(cells, starts=self.duration + cells.starts), bounds

    def _segment(self, k: int, state: Array) -> Array:
        """Add the cells of a segment of the plan; return the state at its end."""
        form, segment, n = self.form, self.plan.segments[k], self.form.nstates
        left, length = self.duration * segment.left, self.duration * segment.length
        starts, levels = form.schedule(length, segment.cell * self.duration)
        terms = np.empty((NTERMS + self.plan.order, form.naxes, starts.size))
        changes: dict[int, Array] = {}
        forced = np.empty((starts.size, n))
        for level in np.unique(levels).tolist():
            own, end = levels == level, form.kernel(level).end
            terms[:, :, own] = segment.series(starts[own] / self.duration, 2.0**level / self.duration, len(terms))
            changes[level] = end[:, :n]
            forced[own] = (end[:, n:] @ terms[: NTERMS + form.order, :, own].reshape(-1, np.count_nonzero(own))).T
        states = _marched(state, changes, levels, forced).T
        for level in changes:
            own = levels == level
            begin = left + starts[own]
            self._parts.append(_Part(level, begin, states[:, :-1][:, own], terms[:, :, own], left, left + length))
        rest = (length - float(starts[-1])) / 2.0 ** int(levels[-1])
        if abs(rest - 1.0) < 1e-14:
            return states[:, -1]
        last = _Part(int(levels[-1]), starts[-1:], states[:, -2:-1], terms[:, :, -1:], 0.0, length)
        nodes = _states_at_nodes(form, np.eye(n), last)[:, :, 0]
        basis = np.cos(np.arange(NODES) * math.acos(min(1.0, max(-1.0, 2.0 * rest - 1.0))))
        return np.asarray(basis @ _series(nodes))


def free_cells(form: LoopForm, c: Array, states: Array) -> Iterator[tuple[Cells, Array]]:
    """Outputs c e^(A s) x of a loop without input, in more and more cells.

    Parameters
    ----------
    form : LoopForm
        The loop.
    c : ndarray, shape (nrows, nstates)
        Output matrix.
    states : ndarray, shape (nstates, ncolumns)
        Initial states x, without a part of the integrators.

    Yields
    ------
    Cells
        Of nrows * ncolumns signals, the columns of a row together.
    ndarray, shape (nrows * ncolumns,)
        Bounds of their magnitudes at all later times.
    """
    (nrows, n), m = c.shape, states.shape[1]
    starts, levels = form.tail_schedule
    first, count = 0, _FIRST
    while first < levels.size:
        own = levels[first : first + count]
        kernels = {level: form.kernel(level) for level in np.unique(own).tolist()}
        marched = _marched(states, {level: kernel.end[:, :n] for level, kernel in kernels.items()}, own)
        parts = []
        for level, kernel in kernels.items():
            of_level, size = np.flatnonzero(own == level), 2.0**level
            known = marched[of_level].transpose(1, 2, 0).reshape(n, -1)
            nodes = (np.matmul(c @ kernel.nodes[:, :, :n], known) + c @ known).reshape(NODES, nrows * m, -1)
            edge = np.ones(of_level.size)
            parts.append(Cells(starts[first + of_level], size * edge, _series(nodes), -edge, edge))
        states, first, count = marched[-1], first + count, 2 * count
        yield joined(parts), form.decay_bounds(c, states).ravel()


class ExactResponse(LoopResponse):
    """Exact response of a linear loop along one plan.

    Parameters
    ----------
    motion : Motion
        States of the loop along the plan.
    signals : mapping of str to Rows
        Outputs by name, one row each.
    plan : Trajectory
        The plan.
    """

    note = "exact"

    def __init__(self, motion: Motion, signals: Mapping[str, Rows], plan: Trajectory) -> None:
        self.names = tuple(signals)
        self._motion, self._signals, self._plan, self._start = motion, dict(signals), plan, plan.start

    def extremes(
        self,
        weights: Mapping[str, float],
        *,
        during: tuple[float, float] | None = None,
        rate: bool = False,
        line: tuple[float, float] | None = None,
    ) -> Extremes:
        """Minimum and maximum of a weighted sum of signals; see `LoopResponse`."""
        rows = self._sum(weights)
        if rate:
            rows = rate_rows(self._motion.form, rows, self._motion.plan, " + ".join(weights))
        shifted = None if during is None else (during[0] - self._start, during[1] - self._start)
        low, high, time_low, time_high = (
            float(row[0]) for row in extremes_of(self._motion, rows, during=shifted, line=line)
        )
        return Extremes(low, high, self._start + time_low, self._start + time_high)

    def rms(self, name: str, period: float | None = None) -> float:
        """Root of the mean square of a signal; see `LoopResponse`."""
        rows, duration = self._sum({name: 1.0}), self._motion.duration
        length = duration if period is None else float(period)
        if not 0.0 < length < math.inf:
            raise ValueError(f"period must be above 0 and finite, got {length:g} s")
        if period is None and is_cyclic(self._plan):
            return math.sqrt(mean_square(self._periodic.cells(rows), 0) / length)
        total = mean_square(self._motion.cells(rows).during(0.0, length), 0)
        reached = duration
        if length > duration:
            final = float(rows.static(self._motion.plan.final, self._motion.settled)[0])
            for cells, bounds in self._motion.tail(rows):
                total += mean_square(cells.during(duration, length), 0)
                reached = float((cells.starts + cells.lengths).max())
                if reached >= length or bounds[0] <= 1e-16 * abs(final):
                    break
            total += max(0.0, length - reached) * final**2
        return math.sqrt(total / length)

    def values(self, weights: Mapping[str, float], times: Array, *, rate: bool = False) -> Array:
        """Weighted sum of signals; see `LoopResponse`."""
        rows, motion, since = self._sum(weights), self._motion, times - self._start
        if rate:
            rows = rate_rows(motion.form, rows, motion.plan, " + ".join(weights))
        found = np.full(times.shape, float(rows.static(motion.plan.final, motion.settled)[0]))
        along = since <= motion.duration
        found[along] = motion.cells(rows).at(since[along])[0]
        for cells, _ in motion.tail(rows) if not along.all() else ():
            inside = (since > motion.duration) & (since >= cells.starts.min())
            inside &= since <= float((cells.starts + cells.lengths).max())
            found[inside] = cells.at(since[inside])[0]
            if not np.any(since > float((cells.starts + cells.lengths).max())):
                break
        return found

    def ends(self, weights: Mapping[str, float]) -> tuple[float, float]:
        """Values before the plan and in steady state after it; see `LoopResponse`."""
        rows, motion = self._sum(weights), self._motion
        before, after = rows.static(motion.plan.initial, motion.start), rows.static(motion.plan.final, motion.settled)
        return float(before[0]), math.nan if motion.form.integrators else float(after[0])

    @cached_property
    def _periodic(self) -> Motion:
        """Motion in the periodic steady state: the state at the end of the plan is that at its start."""
        form, motion = self._motion.form, self._motion
        if form.integrators:
            raise ValueError(
                f"the loop must have a periodic steady state for the root mean square along a cyclic plan, got "
                f"{form.name} with a pole at 0; give the period of the root mean square"
            )
        change = changes_over(motion.duration * form.a, np.zeros((form.nstates, 0)), 1)[-1]
        state = motion.start + np.linalg.solve(-change, motion.end - motion.start)
        return Motion(form, motion.plan, motion.duration, state)

    def _sum(self, weights: Mapping[str, float]) -> Rows:
        for name in weights:
            if name not in self._signals:
                raise ValueError(f"signals of the loop must be among {', '.join(self.names)}, got {name!r}")
        return weighted(self._signals, weights)


def weighted(signals: Mapping[str, Rows], weights: Mapping[str, float]) -> Rows:
    """Weighted sum of signals, as one row."""
    factors = [(float(factor), signals[name]) for name, factor in weights.items()]
    size = max(len(rows.d[0]) for _, rows in factors)
    d = [factor * np.pad(rows.d, ((0, 0), (0, size - rows.d.shape[1]), (0, 0))) for factor, rows in factors]
    return Rows(np.sum([factor * rows.c for factor, rows in factors], axis=0), np.sum(d, axis=0))


def rate_rows(form: LoopForm, rows: Rows, plan: PlanCells, name: str) -> Rows:
    """Time derivatives of outputs.

    Raises
    ------
    ValueError
        If an output jumps.
    """
    for k in range(rows.order + 1):
        jumps = rows.d[:, k] @ plan.jump(k)
        if np.abs(jumps).max() > 1e-9 * float(np.abs(rows.d[:, k]).max() * plan.peak(k).max()):
            at = plan.edges[int(np.abs(jumps).max(axis=0).argmax())]
            what = "position" if k == 0 else f"derivative {k}"
            raise ValueError(
                f"a signal with a limited rate must be continuous, got {name} that jumps with {what} of the plan, at "
                f"{100.0 * at:.4g} % of its duration; use a plan that is smoother, and at rest at its ends"
            )
    d = np.zeros((len(rows.c), max(len(form.b), rows.order + 2), form.naxes))
    d[:, : len(form.b)] = np.einsum("rn,kna->rka", rows.c, form.b)
    d[:, 1 : rows.order + 2] += rows.d[:, : rows.order + 1]
    return Rows(rows.c @ form.a, d)


def extremes_of(
    motion: Motion,
    rows: Rows,
    scale: Array | float = 0.0,
    during: tuple[float, float] | None = None,
    line: tuple[float, float] | None = None,
) -> tuple[Array, Array, Array, Array]:
    """Minima, maxima (nrows,) and their times [s] since the start of the plan.

    Parameters
    ----------
    motion : Motion
        States along the plan.
    rows : Rows
        Outputs.
    scale : ndarray, shape (nrows,), or float, optional
        Ranges of the outputs: what follows the evaluated part of the tail is
        bounded to 1e-12 of these, or of the range of the output itself.
    during : (float, float), optional
        Interval of time [s] since the start of the plan; default: all times.
    line : (float, float), optional
        Values at the times of `during` of a linear function that is subtracted.
    """
    before, final = rows.static(motion.plan.initial, motion.start), rows.static(motion.plan.final, motion.settled)
    first, last = (-math.inf, math.inf) if during is None else during
    values, times = [], []
    for value, time, seen in ((before, 0.0, first < 0.0), (final, math.inf, math.isinf(last))):
        if seen:
            values.append(value)
            times.append(time)
    parts = [motion.cells(rows).during(first, last)]
    whole = math.isinf(first) and math.isinf(last)
    if last > motion.duration:
        low, high = _seen(parts[0], np.array([*values, final]))
        for cells, bounds in motion.tail(rows):
            parts.append(cells.during(first, last))
            more = _seen(cells, np.array([low, high]))
            low, high = more if whole else (low, high)
            small = _REST * np.maximum(scale, more[1] - more[0])
            if float(cells.starts.max()) > last or np.all(
                bounds <= (np.maximum(np.minimum(high - final, final - low), small) if whole else small)
            ):
                break
        else:
            motion.form.check_settled()
            cells = parts[-1]
        if not whole and float(cells.starts.max(initial=0.0)) <= last:
            values.append(final)
            times.append(last)
    cells, rest = joined(parts), np.array(values).reshape(-1, len(rows.c)).T
    if line is not None:
        slope = (line[1] - line[0]) / (last - first)
        times = [first if time == 0.0 else time for time in times]
        rest = rest - (line[0] + slope * (np.array(times) - first))
        cells = cells.without_line(line[0] - slope * first, slope)
    return extrema_of_cells(cells, rest, np.array(times))


def _seen(cells: Cells, values: Array) -> tuple[Array, Array]:
    """Minima and maxima (nrows,) of values (ncandidates, nrows), and of signals at points of their cells."""
    if cells.starts.size:
        whole = (cells.low == -1.0) & (cells.high == 1.0)
        inside = np.tensordot(_POINTS[:, : len(cells.series)], cells.series[..., whole], axes=1)
        values = np.concatenate(
            [values, cells.values(cells.low).T, inside.transpose(0, 2, 1).reshape(-1, len(values.T))]
        )
    return values.min(axis=0), values.max(axis=0)


_POINTS = np.cos(np.pi * np.arange(17)[:, None] / 16 * np.arange(NODES))
"""Chebyshev polynomials at points of a cell, both ends included."""


def _marched(
    state: Array, changes: Mapping[int, Array], levels: NDArray[np.intp], forced: Array | None = None
) -> Array:
    """States (ncells + 1, nstates, ...) at the starts of cells and at the end of the last."""
    found = np.empty((levels.size + 1, *state.shape))
    found[0] = state
    first = 0
    for last in [*(np.flatnonzero(np.diff(levels)) + 1).tolist(), levels.size]:
        change, own = changes[int(levels[first])], None if forced is None else forced[first:last]
        if last - first < _FEW:
            for k in range(first, last):
                moved = change @ found[k]
                found[k + 1] = found[k] + (moved if forced is None else moved + forced[k])
        else:
            found[first + 1 : last + 1] = repeated(found[first], change, own, last - first)
        first = last
    return found


def _states_at_nodes(form: LoopForm, c: Array, part: _Part) -> Array:
    """Combinations c of states (NODES, nrows, ncells) at the nodes of cells."""
    kernel, n = form.kernel(part.level).nodes, form.nstates
    nodes: Array = np.matmul(c @ kernel[:, :, :n], part.states) + c @ part.states
    nodes += np.matmul(c @ kernel[:, :, n:], part.terms[: NTERMS + form.order].reshape(-1, part.starts.size))
    return nodes


def _cells(form: LoopForm, rows: Rows, part: _Part) -> Cells:
    """Outputs in cells of one length as series."""
    nodes, length = _states_at_nodes(form, rows.c, part), 2.0**part.level
    for k in range(rows.order + 1):
        if rows.d[:, k].any():
            j = np.arange(len(part.terms) - k)
            factor = _FACTORIALS[j + k] / _FACTORIALS[j] / length**k
            nodes += np.matmul(rows.d[:, k], np.tensordot(SIGMA[:, None] ** j * factor, part.terms[k:], axes=1))
    low = np.maximum(-1.0, 2.0 * (part.first - part.starts) / length - 1.0)
    high = np.minimum(1.0, 2.0 * (part.last - part.starts) / length - 1.0)
    return Cells(part.starts, np.full(part.starts.size, length), _series(nodes), low, high)


def _series(nodes: Array) -> Array:
    """Chebyshev series of values (NODES, ...) at nodes."""
    return np.asarray(np.tensordot(_TO_SERIES, nodes, axes=1))


_TO_SERIES = transform(np.eye(NODES)).T
