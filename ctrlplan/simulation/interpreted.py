"""Network evaluated by Python, and its solution by LSODA."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import NoReturn

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.integrate import BDF, LSODA, RK45, OdeSolver
from scipy.linalg import block_diag

from ctrlplan._types import Array, BlockMap, Params
from ctrlplan.simulation.budget import check
from ctrlplan.simulation.network import (
    Network,
    Step,
    known_feedthrough,
    sampled_feedthrough,
    tried_feedthrough,
)
from ctrlplan.simulation.scales import Scales, Tolerances
from ctrlplan.simulation.signals import Series, within
from ctrlplan.simulation.stalled import cause
from ctrlplan.symbolic.isolation import untouched
from ctrlplan.symbolic.trials import can_remember, trial_copy, values_of

Call = Callable[[float, Array, Array], None]
"""(t, state of the network, its signals): stores the outputs of a block in the signals."""

_MIN_RTOL = 2.3e-14
"""Minimum relative tolerance of the solvers of scipy."""

_SHARED = tuple(int(part) for part in scipy.__version__.split(".")[:2]) < (1, 17)
"""Whether all threads share the state of scipy's LSODA, as in its former Fortran version."""

_LSODA_LOCK = threading.Lock()
"""Lock of the run that uses LSODA, if its state is shared."""

_CALLS, _INSTANT = 2000, 1e-9
"""Number of calls about one time (width relative to the segment) after which a solver counts as stalled."""

_PASSING, _PASSED = 3000, 1e-7
"""The same for an explicit solver, and the fraction of a segment after which it has passed that time."""

_PASSES = 100
"""Maximum number of such times in a segment."""

_EVALUATIONS, _A_SEGMENT, _REVIEWED = 60_000, 300, 20_000
"""Evaluations of a run, plus those per segment, after which the cause is searched for, and how often."""


class LoopError(RuntimeError):
    """No solution found of an algebraic loop."""


class SolverError(RuntimeError):
    """The integrator failed; the message gives the time."""


class FeedthroughError(RuntimeError):
    """The pattern of direct feedthrough has changed during a run."""


class Interpreted:
    """Equations of a network with given parameters, one call of each block.

    Parameters
    ----------
    network : Network
        The network.
    params : mapping
        Parameters of the run, which override those of the blocks.
    probe : (float, ndarray)
        Time and state at which direct feedthrough is tested by trial calls.
    trials : bool, optional
        Whether trial calls may exclude a possible algebraic loop; if not, it is
        solved as an algebraic loop.
    """

    def __init__(self, network: Network, params: Params, probe: tuple[float, Array], trials: bool = True) -> None:
        self.network = network
        self.params = dict(params)
        self._probe = probe
        self._nsignals, self._time_rows = network.nsignals, _as_slice(network.time_rows)
        self._outputs = [block.output(params) for block in network.blocks]
        self._updates = [block.update(params) for block in network.blocks]
        self._samples = {i: network.blocks[i].sampled(params) for i in network.blocks_with("period")}
        self._trials, self.evaluations = trials, 0
        self.feeds, doubtful = self._feeds()
        self._doubtful = [(i, can_remember(network.blocks[i].system)) for i in doubtful]
        self._for_rates = self._steps(self._outputs, network.signals_of_inputs(), self.feeds)
        self._for_all = self._steps(self._outputs, np.ones(network.nsignals, dtype=bool), self.feeds)
        self._for_samples: dict[tuple[int, ...], list[Call]] = {}
        self._a, self._b, linear, self._linear_columns, others = _merged_linear(network)
        self._linear_states = _as_slice(linear) if linear.size else None
        self._moving = [(i, self._updates[i], network.states[i], network.fed[i]) for i in others]

    def rates(self, t: float, x: Array, time_values: Array) -> Array:
        """Derivatives of all states, from the values of the functions of time."""
        check(t)
        self.evaluations += 1
        w = self._signals(self._for_all if self._doubtful else self._for_rates, t, x, time_values)
        return self.rates_of(t, x, w)

    def rates_of(self, t: float, x: Array, w: Array) -> Array:
        """The same from all signals; for a discrete system the next states."""
        dx = np.zeros(x.size)
        if self._linear_states is not None:
            dx[self._linear_states] = self._a.dot(x[self._linear_states]) + self._b.dot(w.take(self._linear_columns))
        for i, update, place, fed in self._moving:
            try:
                found = update(t, x[place], fed(w))
                if type(found) is not np.ndarray or found.ndim != 1:
                    found = np.ravel(found)
            except BaseException as error:
                _locate(error, self.network.blocks[i].name, t)
                raise
            if found.size != place.stop - place.start:
                raise ValueError(
                    f"block {self.network.blocks[i].name} must return the derivatives of "
                    f"{place.stop - place.start} states, got {found.size}"
                )
            dx[place] = found
        return dx

    def signals(self, t: float, x: Array, time_values: Array) -> Array:
        """All signals of the network."""
        return self._signals(self._for_all, t, x, time_values)

    def all_signals(self, times: Array, states: Array, time_values: Array) -> Array:
        """All signals (nsignals, ntime) at many times."""
        x, values = np.ascontiguousarray(states.T), np.ascontiguousarray(time_values.T)
        rows = [self.signals(t, x[k], values[k]) for k, t in enumerate(times.tolist())]
        return np.array(rows).T.reshape(-1, times.size)

    def sampled(self, blocks: tuple[int, ...], t: float, x: Array, time_values: Array) -> Array:
        """State after a sample of some discrete blocks, which read each other's new outputs.

        Blocks that declare `samples_first` are sampled before the others and read
        the signals with their own previous outputs, even if these are fed back
        directly.
        """
        first = tuple(i for i in blocks if self.network.blocks[i].traits.samples_first)
        others = tuple(i for i in blocks if i not in first)
        if first:
            w = self._seen(others, t, x, time_values) if others else self.signals(t, x, time_values)
            x = self._after(first, t, x, w)
        return self._after(others, t, x, self._seen(others, t, x, time_values)) if others else x

    def _after(self, blocks: tuple[int, ...], t: float, x: Array, w: Array) -> Array:
        """State after some blocks have sampled given signals."""
        network, after = self.network, x.copy()
        for i in blocks:
            place = network.states[i]
            try:
                following = self._samples[i][1](t, x[place], network.fed[i](w))
            except BaseException as error:
                _locate(error, network.blocks[i].name, t)
                raise
            if network.blocks[i].held is not None:  # the held outputs are among the signals
                following = np.concatenate([following, w[network.outputs[i]]])
            after[place] = following
        return after

    def _seen(self, blocks: tuple[int, ...], t: float, x: Array, time_values: Array) -> Array:
        """Signals at a time, with the outputs of some blocks after a sample."""
        if blocks not in self._for_samples:
            self._for_samples[blocks] = self._sampling(blocks)
        return self._signals(self._for_samples[blocks], t, x, time_values)

    def _sampling(self, blocks: tuple[int, ...]) -> list[Call]:
        """Steps to all signals at a sample time."""
        outputs = list(self._outputs)
        for i in blocks:
            outputs[i] = self._samples[i][0]
        # All outputs of sampled blocks are held, whether another block reads them or not.
        needed = self.network.signals_of_inputs()
        for i in blocks:
            needed[self.network.outputs[i]] = True
        return self._steps(outputs, needed, self._feeds(blocks)[0])

    def _feeds(self, sampled: Sequence[int] = ()) -> tuple[list[NDArray[np.bool_]], list[int]]:
        """Direct feedthrough of every block, and the blocks for which trial calls were made.

        Unknown feedthrough is assumed; trial calls are made only for a possible algebraic loop.
        """
        network, (t, x) = self.network, self._probe
        sizes = [(block.system.noutputs, block.system.ninputs or 0) for block in network.blocks]
        known = [(sampled_feedthrough if i in sampled else known_feedthrough)(b) for i, b in enumerate(network.blocks)]
        feeds = [np.ones(size, dtype=bool) if k is None else k for size, k in zip(sizes, known, strict=True)]
        every = np.ones(network.nsignals, dtype=bool)
        unknown = [i for i, k in enumerate(known) if k is None]
        doubtful: list[int] = []
        # Sample functions are tried last, since they may be slow.
        for group in ([i for i in unknown if i not in sampled], [i for i in unknown if i in sampled]):
            if not (self._trials and any(step.unknown is not None for step in network.schedule(feeds, every))):
                break
            copies = network.for_trials().blocks if group else ()
            for i in group:
                block = copies[i]
                function = block.sampled(self.params)[0] if i in sampled else block.output(self.params)
                feeds[i] = tried_feedthrough(function, *sizes[i], t, x[network.states[i]])
                doubtful.append(i)
        return feeds, doubtful

    def _check(self, t: float, x: Array, w: Array) -> None:
        """Raise if the outputs of a block at all signals differ: it has more feedthrough than the trials found."""
        for i, remembers in self._doubtful:
            block, outs = self.network.blocks[i], self.network.outputs[i]
            place, fed = self.network.states[i], self.network.fed[i](w)
            if remembers:  # a further call would change its memory
                block = replace(block, system=trial_copy(block.system))
            with untouched() if remembers else nullcontext():
                found = values_of(block.output(self.params), t, x[place], fed)
            size = np.abs(w).max(initial=0.0, where=np.isfinite(w))
            if found is not None and not np.allclose(found, w[outs], rtol=1e-9, atol=1e-9 * size, equal_nan=True):
                raise FeedthroughError(f"the direct feedthrough of block {block.name} has changed at {t:g} s")

    def _signals(self, steps: list[Call], t: float, x: Array, time_values: Array) -> Array:
        w = np.zeros(self._nsignals)
        w[self._time_rows] = time_values
        for step in steps:
            step(t, x, w)
        if self._doubtful and steps is self._for_all:
            self._check(t, x, w)
        return w

    def _steps(
        self, outputs: list[BlockMap], needed: NDArray[np.bool_], feeds: Sequence[NDArray[np.bool_]]
    ) -> list[Call]:
        return [self._step(step, outputs) for step in self.network.schedule(feeds, needed)]

    def _step(self, step: Step, outputs: list[BlockMap]) -> Call:
        calls = [self._call(i, outputs[i]) for i in step.blocks]
        if step.unknown is None:
            return calls[0]
        unknown, names, outs = step.unknown, self.network.names(step.blocks), self.network.outputs

        owned = [np.intersect1d(unknown, np.arange(p.start, p.stop)) for p in map(outs.__getitem__, step.blocks)]

        settles = True

        def solve(t: float, x: Array, w: Array) -> None:
            nonlocal settles

            def image(z: Array) -> Array:
                self.evaluations += 1
                w[unknown] = z
                after = w.copy()
                for call, rows in zip(calls, owned, strict=True):
                    fed = w.copy()  # every block reads the trial values, not new outputs of other blocks
                    call(t, x, fed)
                    after[rows] = fed[rows]
                return np.asarray(after[unknown])

            start = w[unknown]
            if settles:
                # A loop that is not algebraic is resolved by substitution from block to block, as in python-control.
                found = _passed_on(image, start, len(calls) + 1)
                if found is not None:
                    w[unknown] = found
                    return
                settles = False
            w[unknown] = _root(lambda z: image(z) - z, start, names, t)

        return solve

    def _call(self, i: int, output: BlockMap) -> Call:
        network = self.network
        states, outs = network.states[i], network.outputs[i]
        fed = network.fed[i]
        block, count = network.blocks[i], outs.stop - outs.start
        if block.linear and output is self._outputs[i]:
            c = np.asarray(block.system.C, dtype=float)
            d, columns = _used(np.asarray(block.system.D, dtype=float) @ network.wire[network.inputs[i]])

            def linear(t: float, x: Array, w: Array) -> None:
                w[outs] = c.dot(x[states]) + d.dot(w.take(columns))

            return linear

        def call(t: float, x: Array, w: Array) -> None:
            try:
                found = output(t, x[states], fed(w))
                if type(found) is not np.ndarray or found.ndim != 1:
                    found = np.ravel(found)
            except BaseException as error:
                _locate(error, block.name, t)
                raise
            if found.size != count:
                raise ValueError(f"block {block.name} must return {count} outputs, got {found.size}")
            w[outs] = found

        return call


class InterpretedSolver:
    """LSODA for a network, segment by segment.

    Attributes
    ----------
    equations : Interpreted
        The equations.
    plain : bool
        Whether the scaled integrated states are all states as they are.
    switches : list of float
        Times at which the equations switch, inside of a segment.
    """

    calls_blocks = relative_by_state = True

    def __init__(self, equations: Interpreted, tolerances: Tolerances, scales: Scales) -> None:
        self.equations, self._scales = equations, scales
        self._rtol, self._atol = np.maximum(tolerances.rtol, _MIN_RTOL), tolerances.atol
        self._moving = equations.network.moving
        self._shift, self._scale = scales.shift[self._moving], scales.scale[self._moving]
        everything = self._moving.size == scales.scale.size
        self.plain = everything and bool(np.all(scales.scale == 1.0) and np.all(scales.shift == 0.0))
        self._bounded = any(b.changes_unseen and b.depends_on_time for b in equations.network.blocks)
        self._segments, self._next = 0, 0
        self.switches: list[float] = []

    @property
    def moving(self) -> NDArray[np.intp]:
        """Indices of the states that are integrated."""
        return self._moving

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side so far."""
        return self.equations.evaluations

    def count(self) -> None:
        """Start counting evaluations; here they are always counted."""

    def scaled_rates(self, t: float, z: Array, time_values: Array, start: Array) -> Array:
        """Derivatives of the scaled integrated states; the others are those at the start of the segment."""
        found = self.equations.rates(t, self.states_of(z, start), time_values)
        return found if self.plain else np.asarray(found[self._moving] / self._scale)

    def states_of(self, z: Array, start: Array) -> Array:
        """All states for scaled integrated states."""
        if self.plain:
            return z.copy()
        x = start.copy()
        x[self._moving] = self._shift + self._scale * z
        return x

    def perturbed(self, states: Array) -> Array:
        """States (nstates, ntime) moved by the tolerance of a step, up and down in turn."""
        return self._scales.perturbed(states, self._rtol, self._atol)

    def signals(self, times: Array, states: Array, time_values: Array) -> Array:
        """All signals (nsignals, ntime) of the network."""
        return self.equations.all_signals(times, states, time_values)

    def outputs(self, times: Array, states: Array, time_values: Array) -> Array:
        """Outputs (noutputs, ntime) of the network."""
        return self.equations.network.to_outputs(self.signals(times, states, time_values))

    def slopes(self, times: Array, states: Array, time_values: Array) -> Array:
        """Jacobian of the integrated states, by finite differences, (ntime, nmoving, nmoving)."""
        n = self._moving.size
        steps = 1e-7 * np.maximum(self._scales.scale, np.abs(states).max(axis=1, initial=0.0))
        plain = self.rates(times, states, time_values)
        found = np.empty((times.size, n, n))
        for j, row in enumerate(self._moving.tolist()):
            near = states.copy()
            near[row] += steps[row]
            found[:, :, j] = ((self.rates(times, near, time_values) - plain)[self._moving] / steps[row]).T
        return found

    def rates(self, times: Array, states: Array, time_values: Array) -> Array:
        """Derivatives (nstates, ntime) of the states."""
        rows = [self.equations.rates(t, states[:, k], time_values[:, k]) for k, t in enumerate(times.tolist())]
        return np.array(rows).T.reshape(-1, times.size)

    def advance(self, series: Series, left: float, grid: Array, state: Array) -> Array:
        """States (nstates, ngrid) at times of a segment; the last is its end."""
        moving, all_states = self._moving, np.repeat(state[:, None], grid.size, axis=1)
        if not moving.size:
            return all_states
        shift, scale = self._scales.shift[moving], self._scales.scale[moving]
        right = float(grid[-1])
        self._segments += 1
        rates = _Watched(self, series, left, right, state)
        out = np.empty((moving.size, grid.size))
        t, z = left, (state[moving] - shift) / scale
        with np.errstate(over="ignore", invalid="ignore"):  # infinite states end the run with an error
            for _ in range(_PASSES):
                with _implicit() as kind:
                    t, z, why = self._marched(kind, rates, t, z, grid, out)
                if t >= right:
                    all_states[moving] = shift[:, None] + scale[:, None] * out
                    return all_states
                # An explicit step may pass where an implicit one fails: a state that stops at a discontinuity.
                passed, z, _ = self._marched(RK45, rates, t, z, grid, out)
                if passed - t < _PASSED * (right - left):
                    break
                t = passed
        raise self._ended(rates, t, z, why)

    def instants(self, first: float, last: float, time_values: Callable[[Array], Array]) -> list[float]:
        """Times at which the equations switch: for Python functions only the declared ones are known."""
        return []

    @property
    def reviewed(self) -> int:
        """Number of evaluations from which on `review` is called."""
        return max(self._next, _EVALUATIONS + _A_SEGMENT * self._segments)

    def review(self, rates: _Watched, t: float, z: Array) -> None:
        """Raise if a block is the cause of too many evaluations.

        Raises
        ------
        SolverError
            If more than 60,000 evaluations, plus 300 per segment, have been made
            and a block is discontinuous, has an infinite slope or is random
            there; checked every 20,000 evaluations.
        """
        self._next = self.equations.evaluations + _REVIEWED
        found = self._cause(rates, t, z)
        if found:
            raise self._message(rates, found)

    def _marched(
        self, kind: type[OdeSolver], rates: _Watched, t: float, z: Array, grid: Array, out: Array
    ) -> tuple[float, Array, str]:
        """Time and scaled state reached towards the end of the segment, and the reason of a failure.

        An explicit solver is used only until its steps are long again.
        """
        right = float(grid[-1])
        rates.begin(_PASSING if kind is RK45 else _CALLS)
        # Equations that depend on time are evaluated at least once per sample: no longer pulse is skipped.
        longest = float(np.diff(grid, prepend=rates.left).max()) if self._bounded else math.inf
        rtol = self._rtol[self._moving]
        # BDF takes one relative tolerance for all states.
        own = float(rtol.min()) if kind is BDF else rtol
        solver = kind(rates, t, z, right, rtol=own, atol=self._atol, max_step=longest)
        if isinstance(solver, LSODA):
            _raise_failures(solver)
        while solver.status == "running":
            before, z = float(solver.t), np.asarray(solver.y)
            try:
                why = solver.step() or ""
            except _StalledError as stalled:
                return before, z, str(stalled)
            if solver.status == "failed":
                return before, z, f"{why} Discontinuous equations, as with floor or sign, may chatter there"
            if not np.isfinite(solver.y).all():
                return before, z, "a state is not finite after that"
            now = float(solver.t)
            inside = slice(*np.searchsorted(grid, [before, now], side="right"))
            if inside.stop > inside.start:
                out[:, inside] = np.reshape(solver.dense_output()(grid[inside]), (len(z), -1))
            if kind is RK45 and now - before > _PASSED * (right - rates.left) and now < right:
                break
        return float(solver.t), np.asarray(solver.y), ""

    def _cause(self, rates: _Watched, t: float, z: Array) -> str:
        equations, x = self.equations, self.states_of(z, rates.start)
        time_values = rates.series(t)
        try:
            w = equations.signals(t, x, time_values)
        except Exception:  # outside the domain of a block
            return ""
        return cause(equations.network, equations.params, t, x, w, rates.right - rates.left)

    def _ended(self, rates: _Watched, t: float, z: Array, why: str) -> SolverError:
        return self._message(rates, self._cause(rates, t, z) or why)

    def _message(self, rates: _Watched, why: str) -> SolverError:
        return SolverError(f"the solver must reach {rates.right:g} s, got to {rates.defined:g} s: {why}")


@contextmanager
def _implicit() -> Iterator[type[OdeSolver]]:
    """LSODA; BDF while another run, in a thread or inside a block, uses an LSODA with shared state."""
    if not _SHARED:
        yield LSODA
    elif _LSODA_LOCK.acquire(blocking=False):
        try:
            yield LSODA
        finally:
            _LSODA_LOCK.release()
    else:
        yield BDF


def _as_slice(rows: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """Slice for consecutive indices."""
    if not rows.size or np.any(np.diff(rows) != 1):
        return rows
    return slice(int(rows[0]), int(rows[-1]) + 1)


def _locate(error: BaseException, name: str, t: float) -> None:
    """Add block and time to an error."""
    error.add_note(f"in block {name} at {t:g} s")


def _merged_linear(network: Network) -> tuple[Array, Array, NDArray[np.intp], NDArray[np.intp], list[int]]:
    """All linear blocks as one, a x + b w, with the indices of its states x and signals w; and the other blocks.

    The other blocks are those with states that are not sampled.
    """
    linear = [i for i, block in enumerate(network.blocks) if block.linear]
    states = np.concatenate([np.zeros(0, dtype=np.intp), *(np.r_[network.states[i]] for i in linear)]).astype(np.intp)
    a = block_diag(*(np.asarray(network.blocks[i].system.A, dtype=float) for i in linear))[: states.size, : states.size]
    b = np.zeros((states.size, network.nsignals))
    if linear:
        inputs = [np.asarray(network.blocks[i].system.B) @ network.wire[network.inputs[i]] for i in linear]
        b = np.concatenate(inputs).reshape(states.size, network.nsignals)  # also without states or signals
    others = [
        i
        for i, (block, rows) in enumerate(zip(network.blocks, network.states, strict=True))
        if not block.linear and block.period is None and rows.stop > rows.start
    ]
    used, columns = _used(b)
    return a, used, states, columns, others


def _used(matrix: Array) -> tuple[Array, NDArray[np.intp]]:
    """Nonzero columns and their indices."""
    columns = np.flatnonzero(matrix.any(axis=0))
    return matrix[:, columns], columns


def _passed_on(image: Callable[[Array], Array], start: Array, times: int) -> Array | None:
    """Fixed point of repeated substitution of signals; None if it is not reached."""
    z = image(start)
    for _ in range(times):
        try:
            following = image(z)
        except Exception:  # intermediate signals may be outside the domain of a block
            return None
        if np.array_equal(following, z, equal_nan=True):
            return z
        z = following
    return None


def _root(residual_of: Callable[[Array], Array], guess: Array, names: str, t: float) -> Array:
    """Solution of an algebraic loop by Newton's iteration; one step if it is linear.

    Tolerances and steps are relative to the signals of the loop, in any unit.
    """
    z = guess.copy()
    residual = residual_of(z)

    def trial_residual(z: Array) -> Array:
        try:
            return residual_of(z)
        except Exception:  # outside the domain of a block
            return np.full(z.size, np.nan)

    size = _sizes(trial_residual, z, residual)
    for _ in range(50):
        size = np.where((now := np.maximum(np.abs(z), np.abs(z + residual))) > 0.0, now, size)
        if np.all(np.abs(residual) <= 1e-13 * now):
            return z
        slope = np.empty((z.size, z.size))
        for j in range(z.size):
            step = np.zeros(z.size)
            step[j] = 1e-7 * size[j]
            slope[:, j] = (trial_residual(z + step) - residual) / step[j]
            if not np.isfinite(slope[:, j]).all():
                slope[:, j] = (residual - trial_residual(z - step)) / step[j]
        if not np.isfinite(slope).all():
            break
        change = size * np.linalg.lstsq(slope * size, -residual, rcond=1e-14)[0]
        before = np.abs(residual).max()
        following = trial_residual(z + change)
        if not np.abs(following).max() < 0.5 * before and _is_solved(residual, size):
            return z  # up to rounding errors of the blocks
        for _ in range(30):
            if np.abs(following).max() < before:
                break
            change = 0.5 * change
            following = trial_residual(z + change)
        else:
            break
        z, residual = z + change, following
    if _is_solved(residual, size):
        return z
    raise LoopError(
        f"the algebraic loop of the blocks {names} must have a solution that Newton's iteration finds, "
        f"got a residual of {np.abs(residual).max():.3g} at {t:g} s"
    )


def _sizes(residual_of: Callable[[Array], Array], z: Array, residual: Array) -> Array:
    """Magnitudes of the signals of an algebraic loop, from block to block where they start at 0; 1 if all are 0."""
    size = np.maximum(np.abs(z), np.abs(z + residual))
    for _ in range(z.size - 1):
        if size.all() or not np.isfinite(residual).all():
            break
        z = z + residual
        residual = residual_of(z)
        size = np.where(size > 0.0, size, np.nan_to_num(np.abs(z + residual)))
    return np.where(size > 0.0, size, 1.0)


def _is_solved(residual: Array, size: Array) -> bool:
    """Whether the residual of an algebraic loop is one of rounding errors, if Newton's iteration does not reduce it."""
    largest = float(size.max())
    rounding = 64.0 * np.finfo(float).eps * largest + 1e-13
    return bool(np.all(np.abs(residual) <= 1e-9 * np.minimum(largest, 1.0 + size) + rounding))


class _StalledError(Exception):
    """A solver has stalled at one time."""


class _Failures(dict[int, str]):
    """Messages of LSODA, raised as errors instead of warnings."""

    def get(self, key: int, default: object = None) -> NoReturn:
        raise _StalledError(f"LSODA: {super().get(key, default)}")


def _raise_failures(solver: LSODA) -> None:
    integrator = getattr(getattr(solver, "_lsoda_solver", None), "_integrator", None)
    if integrator is not None and isinstance(getattr(integrator, "messages", None), dict):
        integrator.messages = _Failures(integrator.messages)


class _Watched:
    """Right-hand side of scaled states over a segment, which raises if a solver stalls."""

    def __init__(self, solver: InterpretedSolver, series: Series, left: float, right: float, start: Array) -> None:
        self._solver, self.series, self.left, self.right, self.start = solver, series, left, right, start
        self.defined, self._within = left, within(left, right, solver.switches)
        self._ones, self._near = np.ones(solver.moving.size), _INSTANT * (right - left)
        self._equations, self._review = solver.equations, solver.reviewed
        self.begin(_CALLS)

    def begin(self, calls: int) -> None:
        """Reset the counter, with a maximum number of calls about one time."""
        self._calls, self._about, self._count = calls, -math.inf, 0

    def __call__(self, t: float, z: Array) -> Array:
        self._count += 1
        if abs(t - self._about) > self._near:
            self._about, self._count = t, 0
        elif self._count > self._calls:
            raise _StalledError("the solution cannot be continued")
        if self._equations.evaluations >= self._review:
            self._solver.review(self, t, z)
            self._review = self._solver.reviewed
        low, high = self._within
        inside = low if t < low else min(t, high)
        if self._solver.plain:
            rates = self._equations.rates(inside, z.copy(), self.series(inside))
        else:
            rates = self._solver.scaled_rates(inside, z, self.series(inside), self.start)
        if t > self.defined and math.isfinite(rates.dot(self._ones)):
            self.defined = t
        return rates
