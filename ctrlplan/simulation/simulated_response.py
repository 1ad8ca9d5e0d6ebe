"""Signals of a sampled, delayed or nonlinear loop along a plan, by simulation over the move and a tail."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property, reduce
from itertools import pairwise

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ctrlplan._checks import check_kind, checked_finite
from ctrlplan._types import Array, System
from ctrlplan.simulation.equilibrium import equilibrium_at
from ctrlplan.simulation.loop_inputs import Fed, fed_signals, is_cyclic, same_axis, tracked
from ctrlplan.simulation.loop_response import Extremes, LoopResponse, LoopSignals, signal_names
from ctrlplan.simulation.memory import kept_memory
from ctrlplan.simulation.network import Block
from ctrlplan.simulation.prepared import Prepared, prepared_form
from ctrlplan.simulation.response import SimulationResponse
from ctrlplan.simulation.signals import Inputs
from ctrlplan.simulation.simulate import simulate
from ctrlplan.trajectories import Step, Trajectory
from ctrlplan.trajectories.internal import InternalTrajectory

_RTOL = 1e-10
"""Relative tolerance of the runs."""

_COARSE = 1e-8
"""Relative tolerance without refinement."""

_SAMPLES = 1000
"""Number of samples over the duration of a plan."""

_LONG = 8
"""Maximum number of samples of an interval, in those of a plan."""

_FINE = 33
"""Number of samples between the neighbours of a sample near an extremum."""

_MOST = 24
"""Maximum number of samples near which an extremum is refined."""

_ASIDE = 1e-9
"""Distance from a jump at which a signal is sampled on both sides, relative to the duration of the plan."""

_PERIODS = (2, 4, 8, 16, 32, 64)
"""Numbers of periods of a cyclic plan, until its last two have the same mean square."""


class SimulatedQuantities(LoopSignals):
    """Signals of a sampled, delayed or nonlinear loop along a plan.

    Parameters
    ----------
    loop : control system or Prepared
        The loop.
    tail : float, optional
        Time [s] after the plan that is simulated; default: the plan's duration.

    Attributes
    ----------
    name : str
        Name of the loop.
    names : tuple of str
        Names of its signals: outputs, then inputs that have other names.
    inputs : tuple of str
        Names of its inputs in order.
    """

    kind = "simulated"

    def __init__(self, loop: System | Prepared, tail: float | None = None) -> None:
        super().__init__(prepared_form(loop))
        self._tail = None if tail is None else checked_finite(tail, "tail", minimum=0.0)
        if self._prepared.dt is True:
            raise ValueError(f"loop must have a sampling time for limits on its signals, got {self.name} with dt=True")
        _check_stable(self._prepared)

    @property
    def note(self) -> str:
        """How signals are computed."""
        tail = "as long as the plan" if self._tail is None else f"of {self._tail:g} s"
        return f"simulated at tolerance {_RTOL:g}, over the move and a tail {tail}"

    def quantities_of(self, plan: Trajectory, *, refined: bool = True) -> SimulatedResponse:
        """Response of the loop to a plan.

        The loop starts at rest at the first position of the plan.

        Parameters
        ----------
        plan : Trajectory
            Plan with a duration.
        refined : bool, optional
            Whether extrema are refined by a further run. Otherwise they are those of
            1000 samples over the plan.

        Raises
        ------
        ValueError
            If the plan does not fit the inputs of the loop, or no equilibrium at its
            first position is found.
        RuntimeError
            If the integrator fails.
        """
        check_kind(plan, "plan", Trajectory)
        return SimulatedResponse(self._prepared, plan, self._tail, refined)


def _check_stable(prepared: Prepared) -> None:
    """Raise for a linear discrete loop with a pole outside of the unit circle, as for a continuous one."""
    if not (prepared.is_discrete and isinstance(prepared.system, ct.StateSpace) and prepared.nstates):
        return
    poles = np.linalg.eigvals(prepared.system.A).astype(complex)
    # Rounding moves the poles of several integrators, at 1.
    unstable = poles[(np.abs(poles) > 1.0 + 1e-9) & (np.abs(poles - 1.0) > 1e-4)]
    if unstable.size:
        worst = complex(unstable[np.abs(unstable).argmax()])
        at = f"{worst.real:.4g}" + (f" ± {abs(worst.imag):.4g}j" if worst.imag else "")
        raise ValueError(
            f"the loop must be stable for limits on its signals, got {prepared.name} with a pole at {at} outside of "
            "the unit circle: its response grows without bound"
        )


class SimulatedResponse(LoopResponse):
    """Simulated response of a loop along one plan.

    Parameters
    ----------
    prepared : Prepared
        The loop.
    plan : Trajectory
        The plan.
    tail : float or None
        Time [s] after the plan.
    refined : bool
        Whether extrema are refined by a further run.
    """

    def __init__(self, prepared: Prepared, plan: Trajectory, tail: float | None, refined: bool = True) -> None:
        self._prepared, self.plan, self._refined = prepared, plan, refined
        self._rtol = _RTOL if refined else _COARSE
        self.names = signal_names(prepared)
        self._last = plan.end + (plan.duration if tail is None else tail)
        self.note = f"simulated at tolerance {_RTOL:g}, until {self._last - plan.end:.4g} s after the plan"
        check_sources(prepared, plan)
        self._inputs = LoopInputs(plan, fed_signals(prepared.input_labels, plan, prepared.name))
        self._start = self._at_rest(plan.start, first=True)

    def extremes(
        self,
        weights: Mapping[str, float],
        *,
        during: tuple[float, float] | None = None,
        rate: bool = False,
        line: tuple[float, float] | None = None,
    ) -> Extremes:
        """Minimum and maximum of a weighted sum of signals; see `LoopResponse`."""
        first, last = (self.plan.start, self._last) if during is None else during
        if first > self._last:
            raise ValueError(
                f"an interval of limits must begin before {self._last:.6g} s, where the simulation ends, got {first:g} "
                "s; give a longer tail="
            )

        def without(times: Array, row: Array) -> Array:
            if line is None:
                return row
            return row - (line[0] + (line[1] - line[0]) * (times - first) / (last - first))

        times, row = self._rate(weights) if rate else (self._samples[0], self._sum(weights, self._samples[1]))
        row, inside = without(times, row), (times >= first) & (times <= last)
        if not rate and self._refined and not self._prepared.is_discrete:
            ends = [t for t in (first, last) if self.plan.start <= t <= self._last]
            more = np.concatenate([ends, *(_near_peak(times, sign * row, inside) for sign in (-1.0, 1.0))])
            fine, values = self._run(np.unique(more))
            times, row = np.concatenate([times, fine]), np.concatenate([row, without(fine, self._sum(weights, values))])
            by = np.argsort(times, kind="stable")
            times, row = times[by], row[by]
            inside = (times >= first) & (times <= last)
        times, row = times[inside], row[inside]
        if not row.size:
            raise ValueError(f"an interval of limits must contain a sample of the loop, got {first:g} to {last:g} s")
        smooth = not self._prepared.is_discrete and not (rate and self._held_blocks(weights))
        low, high = _peak(times, -row, smooth), _peak(times, row, smooth)
        return Extremes(-low[0], high[0], low[1], high[1])

    def rms(self, name: str, period: float | None = None) -> float:
        """Root of the mean square of a signal; see `LoopResponse`."""
        self._sum({name: 1.0}, self._samples[1])
        if period is None and is_cyclic(self.plan):
            return self._cyclic_rms(name)
        return self._rms({name: 1.0}, self.plan.start, self.plan.start + (period or self.plan.duration))

    def values(self, weights: Mapping[str, float], times: Array, *, rate: bool = False) -> Array:
        """Weighted sum of signals during the plan; see `LoopResponse`."""
        t, row = self._rate(weights) if rate else (self._samples[0], self._sum(weights, self._samples[1]))
        return np.asarray(np.interp(times, t, row))

    def ends(self, weights: Mapping[str, float]) -> tuple[float, float]:
        """Values at rest before the plan and in steady state after it; see `LoopResponse`."""
        before = float(self._sum(weights, self._samples[1][:, :1])[0])
        if self._final is None:
            return before, math.nan
        step = float(self._prepared.dt) if self._prepared.is_discrete else 1e-2 * self.plan.duration
        times, held = np.array([self.plan.end, self.plan.end + step]), self._inputs.final
        response = self._simulated(times, held.tolist() or None, self._final)
        return before, float(self._sum(weights, self._signals(response.y[..., :1], held[:, None]))[0])

    @cached_property
    def _final(self) -> Array | None:
        if any(block.plan is not None for block in self._blocks()):
            return None  # a source inside is evaluated at its own time
        try:
            return self._at_rest(self.plan.end, first=False)
        except ValueError:  # such as an integrator, or a sampled block that is not linear
            return None

    def _blocks(self) -> Sequence[Block]:
        return () if self._prepared.network is None else self._prepared.network.blocks

    def _at_rest(self, time: float, *, first: bool) -> Array:
        """Equilibrium at the first or last position of the plan."""
        held = (self._inputs.initial if first else self._inputs.final).tolist()
        place = self.plan.initial if first else self.plan.final
        rows = tracked(self._prepared.output_labels, self.plan.labels)
        state, doubt = equilibrium_at(self._prepared, Step(place, place, time=time), time, rows, held=held)
        if doubt:
            position = ", ".join(f"{a} = {x:.4g}" for a, x in zip(self.plan.labels, place.tolist(), strict=True))
            which = "first" if first else "last"
            raise ValueError(
                f"the loop must be at rest at the {which} position of the plan, got {self._prepared.name} without a "
                f"known equilibrium at {position}: {doubt}; declare the initial state of its blocks (cp.declare)"
            )
        return state

    @cached_property
    def _edges(self) -> Array:
        """Times at which signals may jump: breakpoints, and sample times of discrete blocks."""
        start = self.plan.start
        edges = [self.plan.breakpoints]
        for block in self._blocks():
            if block.period is not None:
                first = start + float(block.traits.offset or 0.0)
                edges.append(np.arange(first, self._last, block.period))
        found = np.unique(np.concatenate(edges))
        apart = np.concatenate([[True], np.diff(found) > 4.0 * _ASIDE * self.plan.duration])
        return found[apart & (found <= self._last)]

    @cached_property
    def _samples(self) -> tuple[Array, Array]:
        """Times and signals (nsignals, ntime)."""
        if self._prepared.is_discrete:
            dt = float(self._prepared.dt)
            count = math.ceil((self._last - self.plan.start) / dt)
            return self._run(np.array(self.plan.start + dt * np.arange(count + 1), dtype=float))
        even = np.linspace(self.plan.start, self.plan.end, _SAMPLES + 1)
        if self._last > self.plan.end:
            even = np.append(even, np.linspace(self.plan.end, self._last, self._count(self._last - self.plan.end))[1:])
        edges, spacing = self._edges, float(even[1] - even[0])
        apart = np.abs(even - edges[np.searchsorted(0.5 * (edges[1:] + edges[:-1]), even)])
        aside = _ASIDE * self.plan.duration
        both = np.concatenate([edges[1:] - aside, edges[edges < self._last] + aside])
        return self._run(np.union1d(even[apart > 0.05 * spacing], np.append(both, [self.plan.start, self._last])))

    @property
    def _pieces(self) -> list[tuple[float, float]]:
        """Intervals without jumps."""
        aside = _ASIDE * self.plan.duration
        ends = np.unique(np.append(self._edges[self._edges < self._last], self._last)).tolist()
        return [(left + aside, right - aside) for left, right in pairwise(ends)]

    def _count(self, length: float) -> int:
        """Number of samples of an interval [s]."""
        return min(8 + math.ceil(_SAMPLES * length / self.plan.duration), _LONG * _SAMPLES)

    def _run(self, times: Array) -> tuple[Array, Array]:
        """Signals (nsignals, ntime) at times, the start included if there are fewer than two."""
        start = self.plan.start
        wanted = times if times[0] <= start and times.size > 1 else np.union1d(times, [start, self._last])
        inputs = self._inputs if self._prepared.ninputs else None
        response = self._simulated(wanted, inputs, self._start)
        return response.t, self._signals(response.y, self._inputs.jet(response.t, 0)[0])

    def _simulated(self, times: Array, inputs: Inputs, start: Array | None) -> SimulationResponse:
        """Response from a start; the blocks have the same memory after it as before."""
        with kept_memory(self._prepared.network, self._prepared.is_discrete):
            return simulate(self._prepared, times, inputs, start, rtol=self._rtol, events=())

    def _signals(self, outputs: Array, inputs: Array) -> Array:
        """Outputs, and inputs that have other names."""
        own = outputs.reshape(len(self._prepared.output_labels), -1)
        further = [label not in self._prepared.output_labels for label in self._prepared.input_labels]
        return np.concatenate([own, inputs[further]])

    def _sum(self, weights: Mapping[str, float], signals: Array) -> Array:
        row = np.zeros(signals.shape[1])
        for name, factor in weights.items():
            if name not in self.names:
                raise ValueError(f"signals of the loop must be among {', '.join(self.names)}, got {name!r}")
            row += factor * signals[self.names.index(name)]
        return row

    def _rate(self, weights: Mapping[str, float]) -> tuple[Array, Array]:
        """Times and time derivative of a sum of signals; of a held one the change over the period."""
        times, row = self._samples[0], self._sum(weights, self._samples[1])
        if self._prepared.is_discrete:
            return times[1:], np.diff(row) / float(self._prepared.dt)
        held = set(self._held_blocks(weights))
        if len(held) == 1:
            ((period, offset),) = held
            instants = np.arange(self.plan.start + offset, self._last, period)
            at = np.searchsorted(times, instants + 0.5 * _ASIDE * self.plan.duration)
            return instants[1:], np.diff(row[at]) / period
        inner = self._edges[(self._edges > self.plan.start) & (self._edges < self._last)]
        at = np.searchsorted(times, inner)
        jumps = row[at] - row[at - 1]
        if at.size and np.abs(jumps).max() > 1e-6 * np.ptp(row):
            k = int(np.abs(jumps).argmax())
            raise ValueError(
                f"a signal with a limited rate must be continuous, got {' + '.join(weights)} that jumps by "
                f"{jumps[k]:.4g} at {inner[k]:.6g} s"
            )
        grids = [np.linspace(left, right, self._count(right - left)) for left, right in self._pieces]
        fine, values = self._run(np.unique(np.concatenate(grids)))
        row = self._sum(weights, values)
        slopes = [
            _slopes(row[np.searchsorted(fine, grid[0]) : np.searchsorted(fine, grid[-1]) + 1], grid[1] - grid[0])
            for grid in grids
        ]
        return np.concatenate(grids), np.concatenate(slopes)

    def _held_blocks(self, weights: Mapping[str, float]) -> list[tuple[float, float]]:
        """Periods and offsets of the discrete blocks of which signals are outputs; empty if one is continuous."""
        network, found = self._prepared.network, list[tuple[float, float]]()
        for name in (name for name, factor in weights.items() if factor):
            if network is None or name not in self._prepared.output_labels:
                return []
            row = network.read[self._prepared.output_labels.index(name)]
            used = set(np.flatnonzero(row).tolist())
            for block, place in zip(network.blocks, network.outputs, strict=True):
                own = used & set(range(place.start, place.stop))
                if own and block.period is not None:
                    found.append((float(block.period), float(block.traits.offset or 0.0)))
                    used -= own
            if used:
                return []
        return found

    def _rms(self, weights: Mapping[str, float], first: float, last: float) -> float:
        """Root of the mean square between two times, with the last value after the simulation."""
        times, row = self._samples[0], self._sum(weights, self._samples[1])
        if self._prepared.is_discrete:
            dt = float(self._prepared.dt)
            held = row[times < last - 1e-9 * dt]
            return float(np.sqrt(np.mean(held[: max(1, round((last - first) / dt))] ** 2)))
        end, total = min(last, self._last), 0.0
        for left, right in self._pieces:
            left, right = max(left, first), min(right, end)
            if left >= right:
                continue
            inside = (times > left) & (times < right)
            own = (times >= left - 1e-12 * self.plan.duration) & (times <= right + 1e-12 * self.plan.duration)
            known = np.interp([left, right], times, row)
            if np.count_nonzero(own) > 3:
                known = CubicSpline(times[own], row[own])([left, right])
            t = np.concatenate([[left], times[inside], [right]])
            total += _integral(t, np.concatenate([known[:1], row[inside], known[1:]]) ** 2)
        total += max(0.0, last - end) * row[-1] ** 2
        return math.sqrt(total / (last - first))

    def _cyclic_rms(self, name: str) -> float:
        """Root of the mean square of a signal in the periodic steady state."""
        before, plan = math.inf, self.plan
        for count in _PERIODS:
            many = reduce(lambda a, b: a.then(b), [plan] * count)
            response = SimulatedResponse(self._prepared, many, 0.0)
            last = response._rms({name: 1.0}, many.end - plan.duration, many.end)
            if abs(last - before) <= 1e-7 * max(last, 1e-300):
                return last
            before = last
        raise ValueError(
            f"the loop must reach a periodic steady state for the root mean square of {name} along a cyclic plan, got "
            f"a change of {abs(last - before):.2g} after {_PERIODS[-1]} periods of {plan.duration:g} s"
        )


class LoopInputs(InternalTrajectory):
    """Inputs of a loop: axes of a plan, their derivatives, and 0."""

    what = "inputs of a loop"
    plan: Trajectory
    fed: tuple[Fed | None, ...]
    initial: Array
    final: Array

    def __init__(self, plan: Trajectory, fed: list[Fed | None]) -> None:
        names = tuple(f"input {k + 1}" for k in range(len(fed)))
        held = [[0.0 if f is None or f[1] else float(end[f[0]]) for f in fed] for end in (plan.initial, plan.final)]
        self._set_fields(
            labels=names,
            breakpoints=plan.breakpoints,
            plan=plan,
            fed=tuple(fed),
            initial=np.array(held[0]),
            final=np.array(held[1]),
        )

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        high = max((f[1] for f in self.fed if f is not None), default=0)
        jet = self.plan.segment_jet(segment, s, order + high)
        found = np.zeros((order + 1, len(self.fed), s.size))
        for row, f in enumerate(self.fed):
            if f is not None:
                found[:, row] = jet[f[1] : f[1] + order + 1, f[0]]
        return found


def check_sources(prepared: Prepared, plan: Trajectory) -> None:
    """Raise for a source inside of the loop that is not the plan."""
    for block in () if prepared.network is None else prepared.network.blocks:
        source = block.plan
        if source is None:
            continue
        near = abs(source.start - plan.start) + abs(source.end - plan.end) <= 1e-9 * plan.duration
        for axis in range(source.naxes):
            if not near or same_axis(plan, source, axis) is None:
                raise ValueError(
                    f"sources in {prepared.name} must be the plan under limits, got another one with the axis "
                    f"{source.labels[axis]} in block {block.name}; for other durations make the plan an input of the "
                    "loop"
                )


def _near_peak(times: Array, values: Array, inside: NDArray[np.bool_]) -> Array:
    """Times between the neighbours of samples near which the maximum may lie."""
    here = np.where(inside, values, values[inside].min() if inside.any() else 0.0)
    padded = np.concatenate([here[:1], here, here[-1:]])
    left, right = padded[:-2], padded[2:]
    local = np.flatnonzero(inside & (here >= left) & (here >= right))
    if not local.size:
        return np.empty(0)
    steps = 2.0 * here - left - right
    likely = local[here[local] + steps[local] >= here[local].max()]
    likely = likely[np.argsort(-here[likely])[:_MOST]]
    spans = [(times[max(k - 1, 0)], times[min(k + 1, times.size - 1)]) for k in likely.tolist()]
    return np.concatenate([np.linspace(low, high, _FINE) for low, high in spans])


def _peak(times: Array, values: Array, smooth: bool) -> tuple[float, float]:
    """Maximum and its time; of a smooth signal between samples, by polynomials through three and five of them."""
    k = int(values.argmax())
    best, at = float(values[k]), float(times[k])
    if not smooth or not 1 < k < values.size - 2:
        return best, at
    own, steps = values[k - 2 : k + 3], np.diff(times[k - 2 : k + 3])
    if np.ptp(steps) > 1e-6 * steps[0]:
        return best, at
    parabola = float(np.max(_BASES[0] @ own[1:4]))
    quartic = _BASES[1] @ own
    j = int(quartic.argmax())
    # At a kink the two differ by as much as they rise.
    if abs(float(quartic[j]) - parabola) > 0.25 * (parabola - best) + 1e-15 * abs(best):
        return best, at
    return max(best, float(quartic[j])), at + float(_BETWEEN[j] * steps[0])


_BETWEEN = np.linspace(-1.0, 1.0, 1025)
"""Times about a sample, in distances of samples."""

_BASES = tuple(
    np.linalg.solve(
        np.vander(np.arange(-n, n + 1.0), increasing=True).T, np.vander(_BETWEEN, 2 * n + 1, increasing=True).T
    ).T
    for n in (1, 2)
)
"""Values there of the polynomials through three and five samples."""


def _slopes(values: Array, step: float) -> Array:
    """Derivative of evenly spaced samples, eight or more, by polynomials of degree 6 through seven of them."""
    found = np.empty_like(values)
    found[3:-3] = np.convolve(values, _DIFFERENCES[3][::-1], "valid")
    found[:3] = _DIFFERENCES[:3] @ values[:7]
    found[-3:] = _DIFFERENCES[4:] @ values[-7:]
    return found / step


_DIFFERENCES = np.linalg.solve(
    np.vander(np.arange(7.0), increasing=True).T,
    np.array([[k * float(x) ** (k - 1) if k else 0.0 for x in range(7)] for k in range(7)]),
).T
"""Derivative at each of seven points of unit distance, of the polynomial through them."""


def _integral(times: Array, values: Array) -> float:
    """Integral of a smooth function by a cubic spline through its samples."""
    if times.size < 4:
        return float(np.sum(0.5 * (values[1:] + values[:-1]) * np.diff(times)))
    return float(CubicSpline(times, values).integrate(times[0], times[-1]))
