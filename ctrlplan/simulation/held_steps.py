"""Steps of a system with inputs that are held over each step: linear, discrete and numerical."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Protocol

import control as ct
import numpy as np

from ctrlplan._lru import Lru
from ctrlplan._types import Array, Params
from ctrlplan.simulation.built_forms import NotCompiledError
from ctrlplan.simulation.exact import exact_states, held_change, state_scale
from ctrlplan.simulation.interpreted import FeedthroughError, Interpreted, InterpretedSolver, SolverError
from ctrlplan.simulation.methods.exact import jet_of
from ctrlplan.simulation.network import Network
from ctrlplan.simulation.numerical import NumericalSolver
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.scales import PASSES, Scales, Tolerances, rounding_of
from ctrlplan.simulation.segments import (
    Course,
    SampleTimes,
    as_fraction,
    check_periods,
    integrate,
    known_before,
    time_tolerance,
    values_after,
)
from ctrlplan.simulation.signals import PlanSignal, Series, breakpoints_of, signal_values
from ctrlplan.symbolic.trials import can_remember

if TYPE_CHECKING:
    from ctrlplan.simulation.compiled import Compiled

_AHEAD, _GROWTH = 64, 16.0
"""Number of steps whose response to plans is computed in one call, and the maximum growth of states over them."""

_LARGEST = 1e150
"""Largest state and output of a linear system, so that products do not overflow."""

_LENGTHS = 256
"""Number of cached exponentials, one for each time between two samples."""

_STEPS = 250
"""Number of steps over which the errors of a numerical solver may accumulate within the tolerance."""

_HOPS = 6
"""Number of delays after which a jump of an input has become smooth enough to be ignored."""

_SAME = 1e-14
"""Relative difference of the times of two jumps that is rounding."""


class Grid:
    """Times start + k dt as fractions, so that 3 times 0.1 s is 0.3 s."""

    def __init__(self, start: Fraction, dt: Fraction) -> None:
        self.start, self.dt = start, dt

    def exact(self, k: int) -> Fraction:
        """Time after k steps."""
        return self.start + k * self.dt

    def time(self, k: int) -> float:
        """The same as a float."""
        return float(self.start + k * self.dt)


class Steps(Protocol):
    """Steps of a system.

    Attributes
    ----------
    count : int
        Number of steps so far.
    state : ndarray, shape (nstates,)
        State after them.
    finds_nan : bool
        Whether inputs that are not finite raise an error of their own accord.
    """

    count: int
    finds_nan: bool

    @property
    def state(self) -> Array:
        """State after the steps so far."""

    def step(self, u: Array) -> Array:
        """Outputs after another step with inputs u (ninputs,); an error leaves state and time unchanged."""

    def outputs(self, u: Array) -> Array:
        """Outputs (noutputs,) at the present time with given inputs."""


def steps_of(prepared: Prepared, grid: Grid, state: Array, params: Params, rtol: float) -> Steps:
    """Steps by the first kind that applies.

    Raises
    ------
    TypeError
        If only python-control can evaluate a block.
    ValueError
        If the step is no multiple of the period of a discrete system.
    """
    form, network = prepared.linear, prepared.network
    if form is not None:
        time_signals = [PlanSignal(plan, high) for plan, high in form.sources]
        return LinearSteps(Flow(form.a, form.b, form.c, form.d), time_signals, grid, state)
    if network is None:
        raise TypeError(
            f"a system must be evaluated block by block to be stepped, but {prepared.unsupported}; "
            "rewrite the block with control.nlsys"
        )
    if prepared.is_discrete:
        return DiscreteSteps(prepared, network, grid, state, params)
    check_periods([network.blocks[i] for i in network.blocks_with("period")], grid.time(0), grid.time(1))
    if network.blocks and all(b.linear or b.plan is not None or b.held is not None for b in network.blocks):
        return SampledSteps(prepared, network, grid, state, params)
    return NumericalSteps(prepared, network, grid, state, params, rtol)


class Flow:
    """Loop x' = a x + b w, y = c x + d w; w contains the inputs, then the outputs of sources."""

    def __init__(self, a: Array, b: Array, c: Array, d: Array) -> None:
        self.a, self.b, self.c, self.d = a, b, c, d

    @classmethod
    def of(cls, equations: Interpreted, t: float) -> Flow:
        """Matrices of equations that are linear in states and inputs."""
        n, nw = equations.network.nstates, equations.network.time_rows.size
        rates, outputs = [], []
        for unit in np.eye(n + nw):
            w = equations.signals(t, unit[:n], unit[n:])
            rates.append(equations.rates_of(t, unit[:n], w))
            outputs.append(equations.network.to_outputs(w))
        both, read = np.array(rates).T.reshape(n, n + nw), np.array(outputs).T.reshape(-1, n + nw)
        return cls(both[:, :n], both[:, n:], read[:, :n], read[:, n:])


class LinearSteps:
    """Steps of a continuous linear system by one matrix product each.

    The change of the state is computed, not the state itself: next to a fast mode
    a slow one would otherwise lose digits.
    """

    finds_nan = True

    def __init__(self, flow: Flow, time_signals: Sequence[PlanSignal], grid: Grid, state: Array) -> None:
        self.count, self._flow, self._grid = 0, flow, grid
        self._n, self._m = state.size, flow.b.shape[1] - sum(signal.width for signal in time_signals)
        self._signals = time_signals
        self._plans = [(signal.plan, signal.derivatives) for signal in time_signals]
        self._change = held_change(flow.a, flow.b[:, : self._m], float(grid.dt))
        to_outputs = flow.c @ self._change
        to_outputs[:, : self._n] += flow.c
        to_outputs[:, self._n :] += flow.d[:, : self._m]
        self._matrix = np.concatenate([self._change, to_outputs])
        self._both = np.concatenate([state, np.zeros(self._m)])
        self._ahead, self._first = np.empty((0, len(self._matrix))), 0

    @property
    def state(self) -> Array:
        """State after the steps so far."""
        return self._both[: self._n].copy()

    def step(self, u: Array) -> Array:
        """Outputs after another step with inputs u (ninputs,)."""
        n, both = self._n, self._both
        both[n:] = u
        found: Array = self._matrix.dot(both)
        if self._plans:
            found += self._forced()
        found[:n] += both[:n]
        total = sum(found.tolist())  # faster than a function of numpy, and nan if an entry is
        if not -_LARGEST < total < _LARGEST and not np.abs(found).max() < _LARGEST:
            raise _not_finite(self._grid.time(self.count + 1))
        both[:n] = found[:n]
        self.count += 1
        return found[n:]

    def outputs(self, u: Array) -> Array:
        """Outputs (noutputs,) at the present time with given inputs."""
        t = np.array([self._grid.time(self.count)])
        w = np.concatenate([u, signal_values(self._signals, t)[:, 0]])
        return np.asarray(self._flow.c @ self._both[: self._n] + self._flow.d @ w)

    def _forced(self) -> Array:
        """Change of the state by the plans over the next step, and their part of the outputs after it."""
        k = self.count - self._first
        if k >= len(self._ahead):
            self._ahead, self._first, k = self._computed(), self.count, 0
        return np.asarray(self._ahead[k])

    def _computed(self) -> Array:
        """The same for many steps, from their response that starts at zero."""
        flow, n = self._flow, self._n
        times = np.array([self._grid.time(self.count + k) for k in range(self._length + 1)])
        breakpoints = [t for plan, _ in self._plans for t in plan.breakpoints_between(times[0], times[-1])]
        states = exact_states(flow.a, flow.b[:, self._m :], jet_of(self._plans), breakpoints, times, np.zeros(n))
        change = states[:, 1:] - states[:, :-1] - self._change[:, :n] @ states[:, :-1]
        outputs = flow.c @ change + flow.d[:, self._m :] @ signal_values(self._signals, times[1:])
        return np.concatenate([change, outputs]).T

    @property
    def _length(self) -> int:
        """Number of steps over which states do not grow much, so that responses from zero have all digits."""
        scale = state_scale(self._flow.a)
        power, length = np.eye(self._n) + self._change[:, : self._n] * (scale / scale[:, None]), 1
        with np.errstate(all="ignore"):
            while length < _AHEAD and np.abs(power @ power).max(initial=0.0) < _GROWTH:
                power, length = power @ power, 2 * length
        return length


class SampledSteps:
    """Steps of linear continuous blocks with discrete ones, from sample to sample by matrix exponentials."""

    finds_nan = False

    def __init__(self, prepared: Prepared, network: Network, grid: Grid, state: Array, params: Params) -> None:
        self.count, self._grid, self._state = 0, grid, state
        self._network, self._params = network, params
        self._equations = Interpreted(network, params, (grid.time(0), state))
        self._flow = Flow.of(self._equations, grid.time(0))
        self._signals = [signal for signal in prepared.time_signals([], grid.time(0)) if isinstance(signal, PlanSignal)]
        self._plans = [(signal.plan, signal.derivatives) for signal in self._signals]
        self._m = network.ninputs
        self._samples = SampleTimes(network, grid.time(0))
        self._changes: Lru[Fraction, Array] = Lru(_LENGTHS)
        self._jumps: dict[tuple[int, ...], Array | None] = {}

    @property
    def state(self) -> Array:
        """State after the steps so far."""
        return self._state.copy()

    def step(self, u: Array) -> Array:
        """Outputs after another step with inputs u (ninputs,)."""
        samples, x = self._samples.copy(), self._state
        left, end = self._grid.exact(self.count), self._grid.exact(self.count + 1)
        tolerance = time_tolerance(float(left), float(end))
        while left < end:
            x = self._sampled(samples, float(left), x, u, self._equations)
            right = samples.next
            right = right if isinstance(right, Fraction) and float(right) < float(end) - tolerance else end
            x = self._advanced(left, right, x, u)
            left = right
        found = self._read(float(end), x, u)
        if not (np.isfinite(x).all() and np.isfinite(found).all()):
            raise _not_finite(float(end))
        self._samples, self._state, self.count = samples, x, self.count + 1
        return found

    def outputs(self, u: Array) -> Array:
        """Outputs (noutputs,) at the present time with given inputs, after the samples that are due."""
        t, network = self._grid.time(self.count), self._network
        equations = self._equations
        if any(can_remember(block.system) for block in network.blocks if block.period is not None):
            equations = Interpreted(network.for_trials(), self._params, (t, self._state))
        return self._read(t, self._sampled(self._samples.copy(), t, self._state, u, equations), u)

    def _sampled(self, samples: SampleTimes, t: float, x: Array, u: Array, equations: Interpreted) -> Array:
        """State after the samples that are due at a time."""
        tolerance = time_tolerance(self._grid.time(0), t)
        due = samples.due(t + tolerance)
        if not due:
            return x
        w = np.concatenate([u, values_after(self._signals, np.array([t]), tolerance)[:, 0]])
        if due not in self._jumps:
            self._jumps[due] = self._jump(due, t)
        jump = self._jumps[due]
        return equations.sampled(due, t, x, w) if jump is None else np.asarray(jump @ np.concatenate([x, w]))

    def _jump(self, due: tuple[int, ...], t: float) -> Array | None:
        """Matrix from states and signals to the states after a sample; None if it is not linear."""
        if not all(isinstance(self._network.blocks[i].held, ct.StateSpace) for i in due):
            return None
        n, nw = self._flow.b.shape
        return np.array([self._equations.sampled(due, t, unit[:n], unit[n:]) for unit in np.eye(n + nw)]).T

    def _advanced(self, left: Fraction, right: Fraction, x: Array, u: Array) -> Array:
        """State after a time without samples."""
        flow, length = self._flow, right - left
        b = flow.b[:, : self._m]
        change = self._changes.get(length, lambda: held_change(flow.a, b, float(length)))
        moved = x + change @ np.concatenate([x, u])
        if self._plans:
            times = np.array([float(left), float(right)])
            marks = [t for plan, _ in self._plans for t in plan.breakpoints_between(times[0], times[1])]
            start = np.zeros(x.size)
            moved += exact_states(flow.a, flow.b[:, self._m :], jet_of(self._plans), marks, times, start)[:, 1]
        return np.asarray(moved)

    def _read(self, t: float, x: Array, u: Array) -> Array:
        w = np.concatenate([u, signal_values(self._signals, np.array([t]))[:, 0]])
        return np.asarray(self._flow.c @ x + self._flow.d @ w)


class DiscreteSteps:
    """Steps of a discrete system, each of one or more of its periods."""

    finds_nan = False

    def __init__(self, prepared: Prepared, network: Network, grid: Grid, state: Array, params: Params) -> None:
        self.count, self._grid, self._state, self._params = 0, grid, state, params
        self._network, self._periods = network, _periods(prepared, grid.dt)
        self._equations = Interpreted(network, params, (grid.time(0), state))
        self._signals = prepared.time_signals([], grid.time(0))
        self._remembers = any(can_remember(block.system) for block in network.blocks if not block.linear)
        linear = all(block.linear or block.plan is not None for block in network.blocks)
        self._flow = Flow.of(self._equations, grid.time(0)) if linear else None

    @property
    def state(self) -> Array:
        """State after the steps so far."""
        return self._state.copy()

    def step(self, u: Array) -> Array:
        """Outputs after another step with inputs u (ninputs,)."""
        x, part = self._state, self._grid.dt / self._periods
        start = self._grid.exact(self.count)
        for k in range(self._periods):
            t = float(start + k * part)
            w = self._values(t, u)
            if self._flow is not None:
                x = self._flow.a @ x + self._flow.b @ w
            else:
                x = self._equations.rates_of(t, x, self._equations.signals(t, x, w))
        found = self._read(self._grid.time(self.count + 1), x, u)
        if not (np.isfinite(x).all() and np.isfinite(found).all()):
            raise _not_finite(self._grid.time(self.count + 1))
        self._state, self.count = x, self.count + 1
        return found

    def outputs(self, u: Array) -> Array:
        """Outputs (noutputs,) at the present time with given inputs."""
        return self._read(self._grid.time(self.count), self._state, u)

    def _read(self, t: float, x: Array, u: Array) -> Array:
        w = self._values(t, u)
        if self._flow is not None:
            return np.asarray(self._flow.c @ x + self._flow.d @ w)
        equations = self._equations
        if self._remembers:  # the outputs are evaluated again when the next step begins
            equations = Interpreted(self._network.for_trials(), self._params, (t, x))
        return self._network.to_outputs(equations.signals(t, x, w))

    def _values(self, t: float, u: Array) -> Array:
        tolerance = time_tolerance(self._grid.time(0), t)
        return np.concatenate([u, values_after(self._signals, np.array([t]), tolerance)[:, 0]])


class NumericalSteps:
    """Steps of other systems by a numerical solver, compiled where possible."""

    finds_nan = False

    def __init__(
        self, prepared: Prepared, network: Network, grid: Grid, state: Array, params: Params, rtol: float
    ) -> None:
        self.count, self._grid, self._state = 0, grid, state
        self._prepared, self._network, self._params, self._rtol = prepared, network, params, rtol
        self._held, self._trials = HeldSignal(np.zeros(network.ninputs)), True
        self._signals = prepared.time_signals([self._held], grid.time(0))
        self._equations = self._python()
        self._form = self._compiled()
        self._solver = ScaledSolver(self._made, state)
        self._course = Course(network, self._solver, self._signals, (grid.time(0), grid.time(1)), 10.0 * rtol)
        plans = [signal.plan.breakpoints for signal in self._signals if isinstance(signal, PlanSignal)]
        if plans:  # of a plan that repeats for all future times, one period
            times = np.unique(np.concatenate(plans))
            self._course.add_rounding(np.union1d(np.linspace(times[0], times[-1], 257), times))
        endless = self._equations is not None and network.delays_feed_delays(self._equations.feeds)
        self._jumps = Jumps(self._course.memory.delays, math.inf if endless else _HOPS)
        self._jumps.add([t for t in (grid.time(0), *network.breakpoints) if t >= grid.time(0)])

    @property
    def state(self) -> Array:
        """State after the steps so far."""
        return self._state.copy()

    def step(self, u: Array) -> Array:
        """Outputs after another step with inputs u (ninputs,)."""
        before = self._course.state(), self._held.value, self._jumps.copy()
        while True:
            try:
                return self._stepped(u)
            except BaseException as error:
                self._course.restore(before[0])
                self._held.value, self._jumps = before[1], before[2].copy()
                if not self._improved(error):
                    raise

    def outputs(self, u: Array) -> Array:
        """Outputs (noutputs,) at the present time with given inputs, after the samples that are due."""
        t, x, equations, before = self._grid.time(self.count), self._state, self._equations, self._held.value
        self._held.value = u
        try:
            if equations is not None and self._network.blocks_with("period"):
                if any(can_remember(block.system) for block in self._network.blocks if block.period is not None):
                    equations = Interpreted(self._network.for_trials(), self._params, (t, x), self._trials)
                tolerance = time_tolerance(self._grid.time(0), t)
                due = self._course.state()[0].due(t + tolerance)
                values = values_after(self._signals, np.array([t]), tolerance)[:, 0]
                x = equations.sampled(due, t, x, values) if due else x
            return self._read(t, x)
        finally:
            self._held.value = before

    def _stepped(self, u: Array) -> Array:
        left, right = self._grid.time(self.count), self._grid.time(self.count + 1)
        if not np.array_equal(u, self._held.value):
            self._held.value = u
            self._jumps.add([left])
        self._jumps.add(breakpoints_of(self._signals, left, right))
        self._solver.begin(left, right, lambda t: known_before(self._signals, t), self._network.breakpoints)
        marks = [t for t in self._jumps.until(right) if t > left] + self._solver.instants
        run = integrate(
            self._network,
            self._equations,
            self._solver,
            self._signals,
            np.array([left, right]),
            self._state,
            10.0 * self._rtol,
            sorted(marks),
            course=self._course,
        )
        self._check(run.times, run.states)
        state = run.states[:, -1].copy()
        found = self._read(right, state)
        if not np.isfinite(found).all():
            raise _not_finite(right)
        self._course.memory.forget(right)
        self._state, self.count = state, self.count + 1
        return found

    def _read(self, t: float, x: Array) -> Array:
        times = np.array([t])
        return np.asarray(self._solver.outputs(times, x[:, None], signal_values(self._signals, times))[:, 0])

    def _check(self, times: Array, states: Array) -> None:
        """Raise if the compiled form disagrees with Python at states of the step."""
        form, p = self._form, self._params
        if form is None or self._equations is None:
            return
        vector, values = form.parameters(p), signal_values(self._signals, times)
        if not form.compared.is_due(form.sides(times, states, values, vector)):
            return
        w = form.signals(times, states, values, vector)
        wrong = form.disagreement(self._network.for_trials(), p, times, states, w)
        if wrong:
            raise self._prepared.discard(form, wrong)

    def _improved(self, error: BaseException) -> bool:
        """Whether the step is repeated: with algebraic loops solved as such, or by Python."""
        if isinstance(error, FeedthroughError) and self._trials:
            self._trials = False
            self._equations = self._python()
        elif isinstance(error, SolverError | NotCompiledError) and self._form is not None and self._network.blocks:
            self._form = None
        else:
            return False
        self._solver.renew()
        return True

    def _python(self) -> Interpreted | None:
        probe = self._grid.time(self.count), self._state
        return Interpreted(self._network, self._params, probe, self._trials) if self._network.blocks else None

    def _compiled(self) -> Compiled | None:
        try:
            return self._compiled_form()
        except NotCompiledError:
            if self._equations is None:
                raise
            return None

    def _compiled_form(self) -> Compiled:
        return self._prepared.compiled(self._params, self._signals, self._grid.time(0), self._state)

    def _made(self, scales: Scales) -> NumericalSolver:
        """Solver with given scales of the states."""
        tolerances = Tolerances.of_run(self._rtol, scales, _STEPS)
        if self._equations is not None and self._form is None:
            return InterpretedSolver(self._equations, tolerances, scales)
        from ctrlplan.simulation.compiled import CompiledSolver

        return CompiledSolver(self._form or self._compiled_form(), self._params, tolerances, scales)


class ScaledSolver:
    """Solver whose scales are those of the displacements of the states so far.

    Attributes
    ----------
    instants : list of float
        Times of the present step at which the equations switch.
    """

    def __init__(self, make: Callable[[Scales], NumericalSolver], state: Array) -> None:
        self._make, self._scales = make, Scales.plain(state.size, None)
        self._seen = np.stack([state, state, state], axis=1)  # first, smallest and largest values
        self.instants: list[float] = []
        self.renew()

    def renew(self) -> None:
        """Construct the solver again."""
        self._solver = self._make(self._scales)

    def begin(self, left: float, right: float, values: Callable[[Array], Array], breakpoints: Sequence[float]) -> None:
        """Begin a step."""
        self.instants = [t for t in self._solver.instants(left, right, values) if left < t < right]
        self._solver.switches = sorted([*breakpoints, *self.instants])

    def advance(self, series: Series, left: float, grid: Array, state: Array) -> Array:
        """States (nstates, ngrid) at times of a segment, repeated until the scales fit."""
        for _ in range(PASSES):
            found = self._solver.advance(series, left, grid, state)
            if not np.isfinite(found).all():
                break
            seen = np.column_stack([self._seen, state, found])

            def noise(found: Array = found) -> Array:
                rates = self._solver.rates
                with np.errstate(all="ignore"):
                    return float(grid[-1] - left) * rounding_of(lambda x: rates(grid, x, series.at(grid)), found)

            # A step is too short to pass errors on.
            renewed = self._scales.renewed(seen, self._solver.moving, noise, np.zeros_like)
            self._seen[:, 1:] = np.stack([seen.min(axis=1), seen.max(axis=1)], axis=1)
            if renewed is None:
                break
            switches, self._scales = self._solver.switches, renewed
            self.renew()
            self._solver.switches = switches
        return found

    def perturbed(self, states: Array) -> Array:
        """States (nstates, ntime) moved by the tolerance of a step."""
        return self._solver.perturbed(states)

    def signals(self, times: Array, states: Array, time_values: Array) -> Array:
        """All signals (nsignals, ntime)."""
        return self._solver.signals(times, states, time_values)

    def outputs(self, times: Array, states: Array, time_values: Array) -> Array:
        """Outputs (noutputs, ntime)."""
        return self._solver.outputs(times, states, time_values)


class HeldSignal:
    """Inputs that are constant over a step."""

    def __init__(self, value: Array) -> None:
        self.value, self.width = value, value.size

    def breakpoints_between(self, t0: float, t1: float) -> Array:
        """None."""
        return np.empty(0)

    def analytic_at(self, moment: float, origin: float, s: Array) -> Array:
        """Values (ninputs, ntime)."""
        return self.at(s)

    def bounds(self, moment: float, left: float, right: float) -> tuple[Array, Array]:
        """The value itself."""
        return self.value, self.value

    def ends(self, left: float, right: float) -> tuple[Array, Array]:
        """The value itself."""
        return self.value, self.value

    def at(self, times: Array) -> Array:
        """Values (ninputs, ntime)."""
        return np.repeat(self.value[:, None], times.size, axis=1)


class Jumps:
    """Times at which functions of time jump, and at which the jumps arrive after delays."""

    def __init__(self, delays: Sequence[float], hops: float) -> None:
        self._delays, self._hops = tuple(delays), hops
        self._heap: list[tuple[float, float]] = []

    def add(self, times: Sequence[float]) -> None:
        """Add jumps."""
        for t in times:
            heapq.heappush(self._heap, (t, self._hops))

    def until(self, end: float) -> list[float]:
        """Times of jumps before the end of a step, which are then past."""
        found: list[float] = []
        while self._heap and self._heap[0][0] < end:
            t, hops = heapq.heappop(self._heap)
            while self._heap and self._heap[0][0] - t <= _SAME * abs(t):  # the same by other delays
                hops = max(hops, heapq.heappop(self._heap)[1])
            found.append(t)
            for delay in self._delays if hops > 0 else ():
                heapq.heappush(self._heap, (t + delay, hops - 1))
        return found

    def copy(self) -> Jumps:
        """Same jumps, which pass separately."""
        other = Jumps(self._delays, self._hops)
        other._heap = list(self._heap)
        return other


def _periods(prepared: Prepared, dt: Fraction) -> int:
    """Number of periods of a discrete system in a step."""
    if isinstance(prepared.dt, bool):
        return 1
    period = as_fraction(float(prepared.dt))
    count = round(dt / period)
    if count < 1 or abs(float(dt - count * period)) > 1e-9 * float(period):
        raise ValueError(
            f"dt must be a multiple of the sampling period {float(period):g} s of {prepared.name}, got {float(dt):g} s"
        )
    return count


def _not_finite(t: float) -> SolverError:
    return SolverError(
        f"states and outputs must stay finite, got an overflow at {t:g} s: the loop is unstable with these inputs"
    )
