"""Exact response of a linear loop with discrete blocks along a plan, with extrema between samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from typing import NoReturn

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov, solve_triangular

from ctrlplan._checks import check_kind
from ctrlplan._types import Array
from ctrlplan.simulation.cell_extrema import Cells, extrema_of_cells, mean_square
from ctrlplan.simulation.equilibrium import linear_equilibrium
from ctrlplan.simulation.exact import state_scale
from ctrlplan.simulation.flow_kernel import REACH, FlowKernel
from ctrlplan.simulation.instants import Instants, instants_of
from ctrlplan.simulation.loop_inputs import fed_signals, is_cyclic, tracked
from ctrlplan.simulation.loop_response import Extremes, LoopResponse, LoopSignals, signal_names
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.sampled_form import SampledForm
from ctrlplan.simulation.sampled_motion import SampledMotion, moved_signals
from ctrlplan.simulation.signals import PlanSignal, TimeSignal
from ctrlplan.simulation.simulated_response import LoopInputs, SimulatedResponse, check_sources
from ctrlplan.trajectories import Trajectory

_PATTERN = 20_000
"""Maximum number of sample times of a pattern, after which those of all blocks repeat."""

_CELLS = 1_000_000
"""Maximum number of sample times after the plan until the loop has settled."""

_SETTLED = 1e-15
"""Deviation from the steady state, relative to that at the end of the plan, after which a response is not followed."""

_SMALL = 1e-3
"""Norm of the powers of a transition by which the decay of the loop is measured."""

_INTEGRATOR = 1e-9
"""Difference of a mode from 1 that is rounding: it is an integrator."""

_BOUNDED = 100
"""Maximum number of sample times of a pattern for which signals are bounded after the plan."""

_REST = 1e-12
"""Deviations after the plan, relative to the range of a signal, that are not followed."""

_JUMP = 1e-9
"""Jump of a signal, relative to its range, above which it has no time derivative."""


class SampledQuantities(LoopSignals):
    """Signals of a linear loop with discrete blocks along a plan; returned by `loop_quantities`.

    Parameters
    ----------
    prepared : Prepared
        The loop.
    form : SampledForm
        Its sampled form, which must be stable.

    Attributes
    ----------
    name : str
        Name of the loop.
    names : tuple of str
        Names of its signals: outputs, then inputs that have other names.
    inputs : tuple of str
        Names of its inputs in order.

    Raises
    ------
    ValueError
        If the loop is unstable or undamped.
    """

    kind, note = "exact", "exact, at all times"

    def __init__(self, prepared: Prepared, form: SampledForm) -> None:
        super().__init__(prepared)
        self._form = form
        self._decay = _Decay(form)

    def quantities_of(self, plan: Trajectory, *, refined: bool = True) -> SampledResponse:
        """Response of the loop to a plan.

        The loop starts at rest at the first position of the plan, with its first
        samples at the start of the plan plus their offsets.

        Parameters
        ----------
        plan : Trajectory
            Plan with a duration.
        refined : bool, optional
            No effect: extrema are exact.

        Returns
        -------
        SampledResponse
            With the methods ``extremes`` and ``rms``.

        Raises
        ------
        ValueError
            If the plan does not fit the inputs of the loop, or the loop has no
            equilibrium at its first position.
        """
        check_kind(plan, "plan", Trajectory)
        return SampledResponse(self._prepared, self._form, plan, self._decay)


class SampledResponse(LoopResponse):
    """Exact response of a linear loop with discrete blocks along one plan.

    Parameters
    ----------
    prepared : Prepared
        The loop.
    form : SampledForm
        Its sampled form.
    plan : Trajectory
        The plan.
    decay : _Decay
        Decay of the loop to its steady state.
    """

    note = "exact"

    def __init__(self, prepared: Prepared, form: SampledForm, plan: Trajectory, decay: _Decay) -> None:
        self._prepared, self._form, self._plan = prepared, form, plan
        check_sources(prepared, plan)
        outputs, inputs = prepared.output_labels, prepared.input_labels
        further = [k for k, label in enumerate(inputs) if label not in outputs]
        self.names = signal_names(prepared)
        self._c = np.concatenate([form.c, np.zeros((len(further), form.c.shape[1]))])
        self._d = np.concatenate([form.d, np.eye(len(inputs), form.d.shape[1])[further]])
        fed = LoopInputs(plan, fed_signals(inputs, plan, prepared.name))
        given = prepared.time_signals([PlanSignal(fed)] if inputs else [], plan.start)
        self._w = [np.concatenate([np.zeros(0), *(_held(signal, last) for signal in given)]) for last in (False, True)]
        self._start = self._at_rest()
        self._last, self._decay, self._given = plan.end + decay.time, decay, given
        self._motion = self._moved(np.any(form.d != 0.0, axis=0))

    def _moved(self, used: NDArray[np.bool_]) -> SampledMotion:
        """States over the run, and the `used` functions of time between samples."""
        state = self._start[: self._form.nstates]
        return moved_signals(self._form, self._given, self._plan.start, self._last, state, used)[1]

    @cached_property
    def _motion_with_inputs(self) -> SampledMotion:
        """The same with all functions of time, for limits on inputs, which discrete blocks read at samples only."""
        return self._moved(np.ones(self._d.shape[1], dtype=bool))

    def _motion_of(self, d: Array) -> SampledMotion:
        """Motion with the functions of time that a row d of a signal weighs."""
        return self._motion_with_inputs if (d[~np.any(self._form.d != 0.0, axis=0)] != 0.0).any() else self._motion

    def extremes(
        self,
        weights: Mapping[str, float],
        *,
        during: tuple[float, float] | None = None,
        rate: bool = False,
        line: tuple[float, float] | None = None,
    ) -> Extremes:
        """Minimum and maximum of a weighted sum of signals; see `LoopResponse`."""
        first, last = (-math.inf, math.inf) if during is None else during
        cells = self._cells(weights, rate, math.inf if rate or during is not None else self._decided(weights))
        before, after = (0.0, 0.0) if rate else self._ends(weights)
        values, times = [], []
        for value, time, seen in (
            (before, self._plan.start, first < self._plan.start),
            (after, math.inf if math.isinf(last) else last, last > self._last),
        ):
            if seen:
                values.append(value)
                times.append(time)
        cells = cells.during(first, last)
        rest = np.array(values)
        if line is not None:
            slope = (line[1] - line[0]) / (last - first)
            rest = rest - (line[0] + slope * (np.array(times) - first))
            cells = cells.without_line(line[0] - slope * first, slope)
        low, high, time_low, time_high = extrema_of_cells(cells, rest[None], np.array(times))
        return Extremes(float(low[0]), float(high[0]), float(time_low[0]), float(time_high[0]))

    def rms(self, name: str, period: float | None = None) -> float:
        """Root of the mean square of a signal; see `LoopResponse`."""
        if period is None and is_cyclic(self._plan):
            return SimulatedResponse(self._prepared, self._plan, None).rms(name)
        start, length = self._plan.start, self._plan.duration if period is None else float(period)
        if not 0.0 < length < math.inf:
            raise ValueError(f"period must be above 0 and finite, got {length:g} s")
        total = mean_square(self._cells({name: 1.0}, False).during(start, start + length), 0)
        total += max(0.0, start + length - self._last) * self._ends({name: 1.0})[1] ** 2
        return math.sqrt(total / length)

    def values(self, weights: Mapping[str, float], times: Array, *, rate: bool = False) -> Array:
        """Weighted sum of signals; see `LoopResponse`."""
        cells = self._cells(weights, rate)
        found = cells.at(np.minimum(times, self._last))[0]
        found[times > self._last] = 0.0 if rate else self._ends(weights)[1]
        return found

    def ends(self, weights: Mapping[str, float]) -> tuple[float, float]:
        """Values before the plan and in steady state after it; see `LoopResponse`."""
        return self._ends(weights)

    def _ends(self, weights: Mapping[str, float]) -> tuple[float, float]:
        c, d = self._sum(weights)
        final = self._motion.states[-1]
        return float(c @ self._start + d @ self._w[0]), float(c @ final + d @ self._w[1])

    def _sum(self, weights: Mapping[str, float]) -> tuple[Array, Array]:
        """Rows of a weighted sum of signals, from z and w."""
        c, d = np.zeros(self._c.shape[1]), np.zeros(self._d.shape[1])
        for name, factor in weights.items():
            if name not in self.names:
                raise ValueError(f"signals of the loop must be among {', '.join(self.names)}, got {name!r}")
            c, d = c + factor * self._c[self.names.index(name)], d + factor * self._d[self.names.index(name)]
        return c, d

    def _decided(self, weights: Mapping[str, float]) -> float:
        """Time [s] after which a sum of signals has no extremum, by a bound of its deviation from the final value."""
        c, d = self._sum(weights)
        if d.any():
            return math.inf
        decay, states, tolerance = self._decay, self._motion.states, self._motion.tolerance
        period, longest = float(decay.pattern.times[-1]), max((one.delay for one in self._form.lates), default=0.0)
        phase = self._plan.start + float(max(offset for _, offset in self._form.timings))
        first = math.ceil((self._plan.end + longest + tolerance - phase) / period)
        begins = phase + period * np.arange(max(first, 0), math.floor((self._last - phase) / period))
        at = np.searchsorted(self._motion.instants.times, begins - tolerance)
        known = np.append(states @ c, self._ends(weights))
        low, high, final = float(known.min()), float(known.max()), float(known[-1])
        margin = max(min(high - final, final - low), _REST * (high - low))
        enough = decay.bound(c) * decay.sizes(states[at] - states[-1]) <= margin
        return float(begins[int(enough.argmax())]) if enough.any() else math.inf

    def _cells(self, weights: Mapping[str, float], rate: bool, until: float = math.inf) -> Cells:
        c, d = self._sum(weights)
        if not rate:
            return self._motion_of(d).signal_cells(c[None], d[None], until)
        moving = self._form.moving
        if not c[moving].any() and not d.any():
            return self._held_rate(weights, c)
        motion = self._motion_of(d)
        self._check_continuous(weights, motion.signal_cells(c[None], d[None]))
        found = motion.signal_cells((c[moving] @ self._form.a)[None], (c[moving] @ self._form.b)[None])
        if not d.any():
            return found
        direct = motion.signal_cells(np.zeros((1, c.size)), d[None])
        series = np.zeros((max(len(found.series), len(direct.series)), 1, found.starts.size))
        series[: len(found.series)] = found.series
        slope = chebyshev.chebder(direct.series, axis=0)
        series[: len(slope)] += slope / (0.5 * direct.lengths)
        return replace(found, series=series)

    def _held_rate(self, weights: Mapping[str, float], c: Array) -> Cells:
        """Changes of what discrete blocks of one timing hold, over their period."""
        timings = {part.timing for part in self._form.parts if c[part.held].any()}
        if len(timings) != 1:
            self._raise_jumping(weights, "several blocks")
        timing = timings.pop()
        instants = self._motion.instants
        due = (instants.due >> self._form.timings.index(timing) & 1).astype(bool)
        slopes = np.diff(self._motion.states[due] @ c, prepend=float(c @ self._start)) / float(timing[0])
        edge = np.ones(slopes.size)
        return Cells(instants.times[due], float(timing[0]) * edge, slopes[None, None], -edge, edge)

    def _check_continuous(self, weights: Mapping[str, float], cells: Cells) -> None:
        by = np.argsort(cells.starts, kind="stable")
        left, right = cells.values(cells.low)[0][by], cells.values(cells.high)[0][by]
        jumps = np.abs(left[1:] - right[:-1])
        if jumps.size and jumps.max() > _JUMP * np.ptp(np.append(left, right)):
            self._raise_jumping(weights, f"{cells.starts[by][1 + int(jumps.argmax())]:.6g} s")

    def _raise_jumping(self, weights: Mapping[str, float], where: str) -> NoReturn:
        raise ValueError(
            f"a signal with a limited rate must be continuous, got {' + '.join(weights)} that jumps at {where}; limit "
            "the rate of what one discrete block holds, or of a continuous signal"
        )

    def _at_rest(self) -> Array:
        """States z at rest at the first position of the plan."""
        form, plan, w = self._form, self._plan, self._w[0]
        size = form.signals_z.shape[1]
        a, b = np.zeros((size, size)), np.zeros((size, w.size))
        a[form.moving], b[form.moving] = form.a, form.b
        for part in form.parts:
            for places, own, feed in ((part.states, part.a, part.b), (part.held, part.c, part.d)):
                a[places], b[places] = feed @ part.from_z, feed @ part.from_w
                a[np.ix_(places, part.states)] += own
                a[places, places] -= 1.0
        late = np.zeros_like(w)
        for one in form.lates:
            late[one.columns] = one.from_w @ (w + late)
        w += late
        self._w[1] = self._settled_late(self._w[1])
        stated = self._prepared.stated
        given = np.full(size, np.nan)
        if stated is not None:
            given[: form.nstates] = stated
        rows = tracked(self._prepared.output_labels, plan.labels)
        supplied, free = b @ w, np.isnan(given)
        state = linear_equilibrium(
            a, supplied, form.c[rows], form.d[rows] @ w, plan.initial, np.where(free, 0.0, given), free
        )
        place = ", ".join(f"{label} = {x:.4g}" for label, x in zip(plan.labels, plan.initial.tolist(), strict=True))
        if state is None or np.abs(a @ state + supplied).max(initial=0.0) > 1e-9 * (
            np.abs(a) @ np.abs(state) + np.abs(b) @ np.abs(w)
        ).max(initial=0.0):
            raise ValueError(
                f"the loop must start at rest at the first position of the plan, got {self._prepared.name} without an "
                f"equilibrium at {place}"
            )
        for one in form.lates:
            rest = one.from_z @ state + one.from_w @ w
            if np.abs(rest - one.initial).max(initial=0.0) > 1e-9 * max(float(np.abs(rest).max()), 1e-300):
                raise ValueError(
                    f"the outputs of a delay must start at its inputs for limits on signals of {self._prepared.name}, "
                    f"got initial = {one.initial.tolist()} for inputs {rest.tolist()} at {place}"
                )
        return state

    def _settled_late(self, w: Array) -> Array:
        found = w.copy()
        for one in self._form.lates:
            found[one.columns] = one.from_w @ found
        return found


def has_exact_signals(form: SampledForm) -> bool:
    """Whether signals of a loop have exact extrema.

    Its sample times must repeat, delays be short, and outputs not be delayed continuous signals.
    """
    late = any(one.follows and form.d[:, one.columns].any() for one in form.lates)
    return not late and not form.lines and _pattern(form) is not None


def _pattern(form: SampledForm) -> tuple[Fraction, Instants] | None:
    """Time after which the sample times repeat, and those within it; None if there are too many."""
    if not form.timings:
        return None
    den = math.lcm(*(period.denominator for period, _ in form.timings))
    whole = Fraction(math.lcm(*(int(period * den) for period, _ in form.timings)), den)
    if sum(whole / period for period, _ in form.timings) > _PATTERN:
        return None
    first = max(offset for _, offset in form.timings)
    shifted = [(period, (offset - first) % period) for period, offset in form.timings]
    return whole, instants_of(shifted, 0.0, float(whole), 1e-9 * float(whole) / _PATTERN)


class _Decay:
    """Decay of a loop to its steady state, from one pattern of sample times to the next.

    Attributes
    ----------
    time : float
        Time [s] after which deviations from the steady state are negligible.
    pattern : Instants
        Sample times until they repeat.

    Raises
    ------
    ValueError
        If deviations do not decay.
    """

    def __init__(self, form: SampledForm) -> None:
        found = _pattern(form)
        if found is None:
            raise TypeError(f"sample times of {form.name} must repeat")
        self._form, (whole, self.pattern) = form, found
        self._kernel = FlowKernel(form.a[:, form.moving], form.a[:, self._held], np.zeros((form.moving.size, 0)), 0)
        matrix = self._transitions[-1]
        scale = state_scale(matrix)
        left, sizes, _ = np.linalg.svd(matrix * (scale / scale[:, None]) - np.eye(len(matrix)))
        basis = left[:, sizes > _INTEGRATOR * max(1.0, float(sizes.max(initial=0.0)))]
        self._into, self._out = basis.T / scale, scale[:, None] * basis
        self._moved = self._into @ matrix @ self._out
        self.time = self._settled(float(whole))

    @property
    def _held(self) -> NDArray[np.intp]:
        return np.setdiff1d(np.arange(self._form.signals_z.shape[1]), self._form.moving)

    @cached_property
    def _transitions(self) -> list[Array]:
        """Matrices of the states from the first instant of the pattern to each of them."""
        form, found = self._form, [np.eye(self._form.signals_z.shape[1])]
        changes = self._kernel.over(self.pattern.lengths)
        for which, due in zip(self.pattern.which.tolist(), self.pattern.due[1:].tolist(), strict=True):
            flow, n = np.eye(len(found[0])), form.moving.size
            flow[np.ix_(form.moving, form.moving)] += changes[which][:, :n]
            flow[np.ix_(form.moving, self._held)] += changes[which][:, n:]
            found.append(form.jump(due)[0] @ flow @ found[-1])
        return found

    def _settled(self, whole: float) -> float:
        name, size = self._form.name, self.pattern.times.size
        poles = np.linalg.eigvals(self._moved).astype(complex) if self._moved.size else np.zeros(1, dtype=complex)
        worst = complex(poles[np.abs(poles).argmax()])
        if abs(worst) > 1.0 - _INTEGRATOR:
            kind = "unstable" if abs(worst) > 1.0 + _INTEGRATOR else "undamped"
            at = f"{worst.real:.6g}" + (f" ± {abs(worst.imag):.6g}j" if worst.imag else "")
            raise ValueError(
                f"the loop must be stable for limits on its signals, got {name}, which is {kind}: over {whole:g} s, "
                f"after which its sample times repeat, a mode changes by the factor {at}"
            )
        count, power = 1, self._moved
        while (norm := float(np.linalg.norm(power, 2)) if power.size else 0.0) > _SMALL:
            power, count = power @ power, 2 * count
            if count * size > _CELLS:
                raise ValueError(
                    f"modes of the loop must decay within {_CELLS} sample times, got {name} with a mode that changes "
                    f"by the factor {abs(worst):.9g} over {whole:g} s; give the loop more damping, or leave it out"
                )
        times = math.ceil(math.log(_SETTLED) / math.log(norm)) if norm > 0.0 else 1
        longest = max((late.delay for late in self._form.lates), default=0.0)
        return float(count * times * whole) + longest + whole

    @cached_property
    def _factor(self) -> Array:
        """Factor L of P = L L', where e' P e does not increase from pattern to pattern for deviations e."""
        p = solve_discrete_lyapunov(self._moved.T, np.eye(len(self._moved)))
        return np.linalg.cholesky(0.5 * (p + p.T))

    def sizes(self, deviations: Array) -> Array:
        """Sizes (n,) of deviations (n, nz) from the steady state at the beginning of a pattern."""
        return np.asarray(np.linalg.norm(deviations @ self._into.T @ self._factor, axis=1))

    def bound(self, c: Array) -> float:
        """Bound of c e, relative to the size of the deviation e, at all times after the beginning of a pattern."""
        worst, moving = 0.0, self._form.moving
        if (
            self._kernel.norm * float(self.pattern.lengths.max(initial=0.0)) > REACH
            or len(self._transitions) > _BOUNDED
        ):
            return math.inf
        back = solve_triangular(self._factor, self._out.T, lower=True).T
        for which, start in zip(self.pattern.which.tolist(), self._transitions[:-1], strict=True):
            length = float(self.pattern.lengths[which])
            rows = np.zeros((max(1, self._kernel.terms(length)), len(c)))
            if c[moving].any():
                change = np.tensordot(self._kernel.within(length, 0.0, 1.0, len(rows)), c[moving], axes=(1, 0))
                rows[:, moving], rows[:, self._held] = change[:, : moving.size], change[:, moving.size :]
            rows[0] += c
            worst = max(worst, float(np.linalg.norm(rows @ start @ back, axis=1).sum()))
        return worst


def _held(signal: TimeSignal, last: bool) -> Array:
    """Values of a function of time before or after the plan, with zero derivatives; 0 for a delay."""
    if not isinstance(signal, PlanSignal):
        return np.zeros(signal.width)
    found = np.zeros((signal.plan.naxes, signal.derivatives + 1))
    found[:, 0] = signal.plan.final if last else signal.plan.initial
    return found.ravel()
