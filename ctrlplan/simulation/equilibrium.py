"""Equilibrium of a loop with constant references, and its unstable poles."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import null_space
from scipy.optimize import least_squares

from ctrlplan._checks import real_array
from ctrlplan._types import Array, Params, System
from ctrlplan.simulation.interpreted import FeedthroughError, Interpreted
from ctrlplan.simulation.linear import LinearForm, NotLinearError, in_right_half, linear_form
from ctrlplan.simulation.prepared import Prepared, prepared_form
from ctrlplan.simulation.signals import PlanSignal, TimeSignal, input_signals
from ctrlplan.trajectories import Trajectory

Vector = Callable[[Array], Array]

_LINEAR_RESIDUAL = 1e-9
"""Residual of an equilibrium of a linear loop, relative to the terms of the derivative."""

_RESIDUAL = 1e-8
"""The same for an equilibrium found by iteration."""

_EVALUATIONS = 10_000
"""Number of evaluations after which no further initial guess is tried."""

_ITERATIONS = 40
"""Maximum number of Newton steps."""


def equilibrium_at(
    system: System | Prepared,
    plan: Trajectory,
    time: float,
    outputs: Sequence[int],
    params: Params | None = None,
    *,
    held: Sequence[float] | None = None,
) -> tuple[Array, str]:
    """Equilibrium of a loop at the first position of a plan.

    References, disturbances and other plans in the loop are constant at their
    values at `time`, with zero derivatives. States that a block declares
    (``initial_state``) are not changed.

    Parameters
    ----------
    system : control system or Prepared
        The loop; the plan is its input or a block inside.
    plan : Trajectory
        Reference.
    time : float
        Start of the run [s].
    outputs : sequence of int
        Indices of the outputs that track the plan. Of several equilibria the one
        with these outputs closest to the position of the plan is returned.
    params : mapping, optional
        Parameters of the blocks.
    held : sequence of float, optional
        Values of the inputs; default: the position of the plan.

    Returns
    -------
    state : ndarray, shape (nstates,)
        The equilibrium; if none is found, the declared initial state, 0 for
        states without one.
    doubt : str
        Why the state is not known to be an equilibrium; empty if it is one.
    """
    prepared = prepared_form(system)
    stated = prepared.stated
    start = np.zeros(prepared.nstates) if stated is None else np.where(np.isnan(stated), 0.0, stated)
    free = np.ones(prepared.nstates, dtype=bool) if stated is None else np.isnan(stated)
    if not free.any():
        return start, ""
    inputs = (plan if held is None else list(held)) if prepared.ninputs else None
    given = input_signals(prepared.input_labels, inputs, np.array([time, time + 1.0]))
    target = plan.jet(np.array([time]), 0, left=True)[0, :, 0]
    rows = list(outputs)
    values = np.concatenate([np.zeros(0), *(_held(signal, time) for signal in prepared.time_signals(given, time))])
    if prepared.linear is not None:
        form = prepared.linear
        state = linear_equilibrium(form.a, form.b @ values, form.c[rows], form.d[rows] @ values, target, start, free)
        return (start, "the loop has none") if state is None else (state, "")
    try:
        try:
            return _found(_Equations(prepared, values, time, params or {}, start), rows, target, start, free)
        except FeedthroughError:  # no algebraic loop at the start, but elsewhere
            again = _Equations(prepared, values, time, params or {}, start, trials=False)
            return _found(again, rows, target, start, free)
    except Exception as error:  # outside the domain of a block; a run that fails there raises the error
        return start, f"the equations cannot be evaluated ({type(error).__name__}: {error})"


def equilibrium_state(system: System | Prepared, position: ArrayLike) -> Array:
    """Equilibrium of a linear loop with constant inputs.

    Parameters
    ----------
    system : control system
        Linear and continuous; for others the zero state is returned.
    position : array_like, shape (ninputs,)
        Constant values of the inputs.

    Returns
    -------
    ndarray, shape (nstates,)
        A solution of A x + B w = 0, with outputs as close as possible to w; zero
        if there is none.
    """
    held = np.atleast_1d(real_array(position, "position"))
    try:
        return equilibrium_of(_form(system), held)
    except NotLinearError:
        return np.zeros(system.nstates or 0)


def equilibrium_of(form: LinearForm, held: Array) -> Array:
    """Equilibrium (nstates,) of a linear loop, as `equilibrium_state`, for inputs (ninputs,)."""
    if form.b.shape[1] != held.size or not held.any():
        return np.zeros(len(form.a))
    c, d, free = form.c[: held.size], form.d[: held.size], np.ones(len(form.a), dtype=bool)
    state = linear_equilibrium(form.a, form.b @ held, c, d @ held, held, np.zeros(len(form.a)), free)
    return np.zeros(len(form.a)) if state is None else state


def unstable_poles(system: System | Prepared) -> NDArray[np.complex128]:
    """Poles of a linear continuous system in the right half plane.

    Empty for other systems.
    """
    try:
        poles = np.linalg.eigvals(_form(system).a).astype(complex)
    except NotLinearError:
        return np.empty(0, dtype=complex)
    return poles[in_right_half(poles)]


def _form(system: System | Prepared) -> LinearForm:
    if not isinstance(system, Prepared):
        return linear_form(system)
    if system.linear is None:
        raise NotLinearError(system.not_linear)
    return system.linear


def _held(signal: TimeSignal, time: float) -> Array:
    """Values of a signal just before `time`, with zero derivatives."""
    if not isinstance(signal, PlanSignal):
        return signal.at(np.array([time]))[:, 0]
    jet = np.zeros((signal.plan.naxes, signal.derivatives + 1))
    jet[:, 0] = signal.plan.jet(np.array([time]), 0, left=True)[0, :, 0]
    return jet.ravel()


def linear_equilibrium(
    a: Array, supplied: Array, c: Array, passed: Array, target: Array, start: Array, free: NDArray[np.bool_]
) -> Array | None:
    """State at which the free rows of A x + supplied are 0; None if there is none.

    If it is not unique, as with integrators, outputs C x + passed are as close as possible to `target`.
    """
    state = np.where(free, 0.0, start)
    inner = a[np.ix_(free, free)]
    right_side = -(supplied + a @ state)[free]
    found, left = _scaled_solution(inner, right_side)
    if left > _LINEAR_RESIDUAL:
        return None
    idle = null_space(inner)
    if idle.size and len(c) == target.size:
        missing = target - c[:, free] @ found - c @ state - passed
        found = found + idle @ np.linalg.lstsq(c[:, free] @ idle, missing, rcond=None)[0]
    state[free] = found
    return state


def _scaled_solution(matrix: Array, right: Array) -> tuple[Array, float]:
    """Least-squares solution with rows and columns scaled to unit size, and its relative residual."""
    rows = np.maximum(np.abs(matrix).max(axis=1, initial=0.0), np.abs(right))
    rows = 1.0 / np.where(rows > 0.0, rows, 1.0)
    columns = np.abs(rows[:, None] * matrix).max(axis=0, initial=0.0)
    columns = 1.0 / np.where(columns > 0.0, columns, 1.0)
    scaled, right_side = rows[:, None] * matrix * columns, rows * right
    found = np.linalg.lstsq(scaled, right_side, rcond=None)[0]
    size = max(float(np.abs(found).max(initial=0.0)), float(np.abs(right_side).max(initial=0.0)))
    left = float(np.abs(scaled @ found - right_side).max(initial=0.0))
    return columns * found, left / size if size else 0.0


class _Equations:
    """Derivatives of the states of a loop with constant references, and its outputs.

    The entry of a discrete state is its change by a sample. Nonlinear discrete blocks are not called,
    since calls may change their memory: they are `unknown`, and their states `fixed`.
    """

    def __init__(
        self,
        prepared: Prepared,
        held: Array,
        time: float,
        params: Params,
        start: Array,
        trials: bool = True,
    ) -> None:
        self.discrete, self._trials = prepared.is_discrete, trials
        self.unknown: tuple[str, ...] = ()
        self.fixed = np.zeros(prepared.nstates, dtype=bool)
        self.delays: Callable[[Array], str] = lambda x: ""
        self.delay_mismatch: Callable[[Array], str] = lambda x: ""
        self._rates: Vector
        self._outputs: Vector
        self._gaps: Vector = lambda x: np.zeros(0)
        if prepared.network is None:
            self._by_control(prepared, held, time, params)
        elif not prepared.network.blocks:
            self._compiled(prepared, held, time, params, start)
        else:
            self._network(prepared, held, time, params, start)

    def _by_control(self, prepared: Prepared, held: Array, time: float, params: Params) -> None:
        """Equations of a system that only python-control can run."""
        system, u = prepared.system, held[: prepared.ninputs]
        if self.discrete:
            self.unknown = (prepared.name,)
        self._rates = lambda x: np.ravel(system.dynamics(time, x, u, dict(params)))
        self._outputs = lambda x: np.ravel(system.output(time, x, u, dict(params)))

    def _compiled(self, prepared: Prepared, held: Array, time: float, params: Params, start: Array) -> None:
        """Equations of a form that was compiled for another process."""
        time_signals = prepared.time_signals(
            input_signals(prepared.input_labels, 0.0, np.array([time, time + 1.0])), time
        )
        form = prepared.compiled(params, time_signals, time, start)
        p, t, d = form.parameters(params), np.array([time]), held[:, None]
        self._rates = lambda x: form.rates(t, x[:, None], d, p)[:, 0]
        self._outputs = lambda x: form.outputs(t, x[:, None], d, p)[:, 0]

    def _network(self, prepared: Prepared, held: Array, time: float, params: Params, start: Array) -> None:
        """Equations of a network of blocks."""
        if prepared.network is None:
            raise TypeError(prepared.unsupported)
        network = prepared.network.for_trials()
        sampled, unknown = [], []
        for i, (block, place) in enumerate(zip(network.blocks, network.states, strict=True)):
            linear = block.linear or block.is_time_function or isinstance(block.traits.block, ct.StateSpace)
            if not linear and (self.discrete or block.period is not None):
                unknown.append(block.name)
                self.fixed[place] = True
            elif block.period is not None:
                sampled.append((i, place))
        self.unknown = tuple(unknown)
        equations = Interpreted(network, params, (time, start), self._trials)

        def rates(x: Array) -> Array:
            moved = equations.rates(time, x, held)
            if self.discrete:
                return np.asarray(moved - x)
            for i, place in sampled:
                moved[place] = equations.sampled((i,), time, x, held)[place] - x[place]
            return moved

        def delays(x: Array) -> str:
            signals = equations.signals(time, x, held)
            found = [
                f"{network.blocks[i].name} at initial = {_listed(signals[network.outputs[i]])}"
                for i in network.blocks_with("delay")
            ]
            return ", ".join(found)

        def delay_mismatch(x: Array) -> str:
            signals = equations.signals(time, x, held)
            for i in network.blocks_with("delay"):
                before, now = signals[network.outputs[i]], network.fed[i](signals)
                if np.any(np.abs(now - before) > _RESIDUAL * max(np.abs(held).max(), np.abs(before).max())):
                    start = f"the output of the delay {network.blocks[i].name} starts at initial = {_listed(before)}"
                    return f"{start}, but its input starts at {_listed(now)}"
            return ""

        def gaps(x: Array) -> Array:
            signals = equations.signals(time, x, held)
            found = [network.fed[i](signals) - signals[network.outputs[i]] for i in network.blocks_with("delay")]
            return np.concatenate([np.zeros(0), *found])

        self._rates, self._gaps = rates, gaps
        self.delays, self.delay_mismatch = delays, delay_mismatch
        self._outputs = lambda x: network.to_outputs(equations.signals(time, x, held))

    def rates(self, x: Array) -> Array:
        """Derivatives, nan outside the domain of a block."""
        return self._tried(self._rates, x)

    def outputs(self, x: Array) -> Array:
        """Outputs of the loop, nan outside the domain of a block."""
        return self._tried(self._outputs, x)

    def gaps(self, x: Array) -> Array:
        """Inputs of the delays minus their outputs."""
        return self._tried(self._gaps, x)

    def _tried(self, function: Vector, x: Array) -> Array:
        try:
            with np.errstate(all="ignore"):
                return np.asarray(function(x), dtype=float)
        except FeedthroughError:
            raise
        except Exception:  # a trial call: the block may be undefined here
            return np.full(x.size, np.nan)


def _found(
    equations: _Equations, rows: list[int], target: Array, start: Array, free: NDArray[np.bool_]
) -> tuple[Array, str]:
    """Equilibrium of a network from several initial guesses; the one with outputs closest to `target`."""
    free = free & ~equations.fixed
    if equations.unknown and equations.discrete:
        return start, "" if not target.any() else _of_samples(equations)

    def whole(z: Array) -> Array:
        state = start.copy()
        state[free] = z
        return state

    evaluations = itertools.count(1)

    def rates(z: Array) -> Array:
        next(evaluations)
        return equations.rates(whole(z))[free] if z.size else np.zeros(0)

    def missing(z: Array) -> Array:
        found = equations.outputs(whole(z))
        found = found[rows] - target if found.size > max(rows, default=-1) else np.full(target.size, np.nan)
        return np.concatenate([found, equations.gaps(whole(z))])

    size = float(np.abs(target).max(initial=0.0)) or 1.0
    if not rates(start[free]).any() and not missing(start[free]).any():
        return start, equations.delay_mismatch(start)
    guesses = [guess for guess in _guesses(start[free], target) if _finite(rates(guess)) and _finite(missing(guess))]
    moves = np.max([np.abs(rates(guess)) for guess in guesses], axis=0, initial=0.0) if guesses else np.zeros(0)
    nearest: tuple[float, Array] | None = None
    for guess in guesses:
        if next(evaluations) > _EVALUATIONS:
            break
        z = _equilibrium(rates, missing, guess, moves, size)
        if z is None:
            continue
        distance = float(np.abs(missing(z)).max(initial=0.0))
        if nearest is None or distance < nearest[0]:
            nearest = distance, z
        if distance <= _RESIDUAL * size:
            break
    if nearest is None:
        return start, _of_samples(equations) if equations.unknown else _not_found(equations, start)
    state = whole(nearest[1])
    if equations.unknown and nearest[0] > _RESIDUAL * size:
        return state, _of_samples(equations)
    return state, equations.delay_mismatch(state)


def _not_found(equations: _Equations, start: Array) -> str:
    why = "none was found by iteration"
    if delays := equations.delays(start):
        why += f" with the outputs of delays that start as declared ({delays}): give their values at rest there"
    return equations.delay_mismatch(start) or why


def _of_samples(equations: _Equations) -> str:
    return f"the states of {', '.join(equations.unknown)}, a sampled block, cannot be computed"


def _guesses(start: Array, target: Array) -> Iterator[Array]:
    """Initial guesses: the declared initial state, and states of the size of the position."""
    yield start
    values = np.unique(np.concatenate([target, [1.0]]))
    for value in values[values != 0.0]:
        yield np.full(start.size, value)
    rng = np.random.default_rng(0)
    size = float(np.abs(values).max())
    for _ in range(6):
        yield size * rng.uniform(-1.0, 1.0, start.size)
        yield size * rng.uniform(0.0, 2.0, start.size)


def _equilibrium(rates: Vector, missing: Vector, guess: Array, moves: Array, size: float) -> Array | None:
    """Equilibrium from an initial guess; None if none is found."""
    z = guess
    if z.size and (not _is_equilibrium(rates, z, moves) or np.abs(missing(z)).max(initial=0.0) > _RESIDUAL * size):
        weight = 1.0 / np.where(moves > 0.0, moves, 1.0)
        near = least_squares(
            lambda v: np.concatenate([weight * rates(v), missing(v) / size]),
            z,
            x_scale="jac",
            ftol=1e-15,
            xtol=1e-15,
            gtol=1e-15,
            max_nfev=max(10, min(200, _EVALUATIONS // (z.size + 1))),
        )
        z = _newton(rates, near.x)
    return z if _is_equilibrium(rates, z, moves) else None


def _newton(rates: Vector, z: Array) -> Array:
    """Newton's iteration on the derivatives, with steps of minimum norm."""
    f = rates(z)
    for _ in range(_ITERATIONS):
        if not _finite(f) or not f.any():
            break
        slope = _jacobian(rates, z, f)
        if not _finite(slope):
            break
        step = _scaled_solution(slope, -f)[0]
        for _ in range(8):
            following = rates(z + step)
            if _finite(following) and np.abs(following).max() < np.abs(f).max():
                break
            step = 0.5 * step
        else:
            break
        z, f = z + step, following
    return z


def _is_equilibrium(rates: Vector, z: Array, moves: Array) -> bool:
    """Whether the derivatives are of the size of rounding errors of their terms, or of derivatives elsewhere."""
    f = rates(z)
    if not _finite(f):
        return False
    if not f.any():
        return True
    terms = np.abs(_jacobian(rates, z, f)) @ np.abs(z)
    return bool(np.all(np.abs(f) <= _RESIDUAL * np.fmax(terms, moves)))


def _jacobian(rates: Vector, z: Array, f: Array) -> Array:
    steps = 1e-7 * np.maximum(np.abs(z), 1e-3 * np.abs(z).max(initial=0.0))
    steps = np.where(steps > 0.0, steps, 1e-7)
    columns = [(rates(z + step * unit) - f) / step for step, unit in zip(steps, np.eye(z.size), strict=True)]
    return np.array(columns).T.reshape(f.size, z.size)


def _listed(values: Array) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _finite(values: Array) -> bool:
    return bool(np.isfinite(values).all())
