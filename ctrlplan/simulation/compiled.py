"""Network compiled by CasADi, and its solution by CVODES (SUNDIALS) with the exact Jacobian."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import Enum
from functools import cached_property
from typing import NamedTuple, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._lru import Lru
from ctrlplan._types import Array, Params, Value
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.interruptions import passing_interruptions
from ctrlplan.simulation.network import Block, Network, Step, known_feedthrough
from ctrlplan.simulation.one_step import EVALUATIONS, LONGEST, OneStep, has_step
from ctrlplan.simulation.scales import Scales, Tolerances
from ctrlplan.simulation.signals import Series, within
from ctrlplan.symbolic.comparison import Compared
from ctrlplan.symbolic.many_points import ManyPoints, many_points
from ctrlplan.symbolic.switches import changes_of_side, switch_arguments
from ctrlplan.symbolic.tracing import NotTraceableError, Trace, agrees

_CACHE_SIZE = 64
"""Number of cached integrators (0.1 MB), one a pattern of output times, and of cached functions of many times."""

_DIGITS, _NEAR, _EVEN = 12, 1e-9, 1e-4
"""Digits of output times in units of a segment. They are rounded to these digits if their smallest interval is above
the second number, and the first one, where transients are fast, above the third in units of the largest."""

_CLOSEST, _EQUAL = 1e-8, 64.0
"""Interval between output times, in units of a segment, below which the segment is divided there (CasADi returns the
state before an interval of less than 1e-9), unless they are equal up to so many units in the last place."""

_AT_ONCE = 64
"""Number of times up to which the memory of a function of many times is kept."""

_MANY = 256
"""Number of times from which on numpy evaluates a function faster, operation by operation."""

_FEW_STEPS = 2_000
"""Maximum number of steps between outputs in the first attempt."""

_CLOSE = 129
"""Number of output times in the second attempt."""

_FAILURES = {
    "CV_TOO_MUCH_WORK": "too many steps are required",
    "CV_ERR_FAILURE": "the error test fails at the minimum step size",
    "CV_CONV_FAILURE": "the nonlinear iteration does not converge at the minimum step size",
    "CV_FIRST_RHSFUNC_ERR": "the derivatives of the states are not finite at its start",
}

_STIFF, _SHORT = 3000.0, 0.5
"""Segment length in units of the fastest time constant above which BDF requires fewer steps than Adams; and, in units
of the inverse norm of the Jacobian, below which each step is found by iteration without linear systems."""

_KIND_KEPT = 32
"""Number of segments after which the kind of integration is chosen again."""

_PATTERNS, _APART = 16, 12
"""Number of patterns of output times for which a run builds integrators; further patterns of up to so many times are
integrated to each time from the start of the segment."""

_FEW_SHORT = 4
"""Number of short segments of a run that CVODES passes, as one step must be built: further ones are passed by that."""

_EDGE = 100.0
"""Neighbourhood of a state, in tolerances of a step, in which the equations must be defined."""


class Kind(Enum):
    """Kind of integration: options of CVODES."""

    ADAMS = "adams", "newton"
    BDF = "bdf", "newton"
    FIXED_POINT = "adams", "functional"


class Motion:
    """Rates of motion of linearised equations.

    Attributes
    ----------
    norm : float
        Norm of the Jacobian [1/s]; infinite if that is not finite.
    """

    def __init__(self, jacobian: Array) -> None:
        self._jacobian = jacobian
        self.norm = float(np.linalg.norm(jacobian)) if np.isfinite(jacobian).all() else np.inf

    @cached_property
    def decay(self) -> float:
        """Fastest decay rate [1/s], at most the norm."""
        return -float(np.linalg.eigvals(self._jacobian).real.min()) if self.norm < np.inf else np.inf

    def kind(self, length: float) -> Kind:
        """Kind of integration for a segment of given length [s]."""
        if self.norm * length < _SHORT:
            return Kind.FIXED_POINT
        return Kind.BDF if self.norm * length > _STIFF and self.decay * length > _STIFF else Kind.ADAMS


class Compiled:
    """Equations of a network as CasADi functions of (t, x, time_values, p).

    Parameters
    ----------
    network : Network
        The network.
    traces : list of Trace or None
        Of every block that is neither linear nor a function of time.

    Raises
    ------
    NotTraceableError
        If the network has an algebraic loop that is not linear.
    """

    def __init__(self, network: Network, traces: list[Trace | None]) -> None:
        feeds = [_feedthrough(block, trace) for block, trace in zip(network.blocks, traces, strict=True)]
        self._traces = traces
        self._places = [(i, key) for i, trace in enumerate(traces) if trace is not None for key in trace.symbols]
        self.symbols = frozenset(key for _, key in self._places)
        self._defaults = [(key, network.blocks[i].params.get(key)) for i, key in self._places]
        n, nd = network.nstates, network.time_rows.size
        self.moving = network.moving
        t, x, d, p = (ca.SX.sym(name, size) for name, size in (("t", 1), ("x", n), ("d", nd), ("p", len(self._places))))
        own = self._own_parameters(p)
        every = np.ones(network.nsignals, dtype=bool)
        w = _signals(network, traces, own, network.schedule(feeds, network.signals_of_inputs()), t, x, d)
        rates = _rates(network, traces, own, t, x, w)
        self._rates = ca.Function("rates", [t, x, d, p], [rates])
        self._functions = {"rates": self._rates}
        moving = self.moving.tolist()
        slopes = ca.jacobian(rates[moving], x)[:, moving] if moving else ca.SX(0, 0)
        self._jacobian = ca.Function("jacobian", [t, x, d, p], [ca.densify(slopes)])
        self._functions["jacobian"] = self._jacobian
        steps = network.schedule(feeds, every)
        self.has_loops = any(step.unknown is not None for step in steps)
        w = _signals(network, traces, own, steps, t, x, d)
        self._functions["signals"] = ca.Function("signals", [t, x, d, p], [ca.densify(w)])
        self._functions["outputs"] = ca.Function("outputs", [t, x, d, p], [ca.densify(_sparse(network.read) @ w)])
        whole = ca.Function("all", [t, x, d, p], [ca.vertcat(w, rates)])
        self._functions["switches"] = switches = switch_arguments(whole)
        self.nswitches = self._functions["switches"].numel_out(0)
        self.compared = Compared(self.nswitches)
        self._timed: list[str] = []
        self._add_timed("switches", switches, _switch_with(switches, network, 0))
        if _switch_with(switches, network, 2).any():
            jumps = switch_arguments(whole, bends=False)
            self._add_timed("jumps", jumps, _switch_with(jumps, network, 2))
        self.depends_on_time = any(
            trace is not None and block.changes_unseen and trace.depends_on_time()
            for block, trace in zip(network.blocks, traces, strict=True)
        )
        self._integrators: Lru[tuple[object, ...], Segment] = Lru(_CACHE_SIZE)
        self._maps: Lru[tuple[str, int], ca.Function] = Lru(_CACHE_SIZE)
        self._small: Lru[tuple[int, str, int], _AtMany] = Lru(_CACHE_SIZE)
        self._by_numpy: Lru[str, ManyPoints | None] = Lru(_CACHE_SIZE)
        self._patterns: Lru[tuple[float, ...], tuple[Array, Pattern]] = Lru(_CACHE_SIZE)
        self._steps: Lru[tuple[int, int, bool, bool], OneStep | None] = Lru(_CACHE_SIZE)
        self._equations: dict[tuple[int, bool, bool], dict[str, ca.SX]] = {}
        self._functions_of_segments: dict[tuple[int, bool, bool], ca.Function] = {}
        self._derived: Lru[tuple[int, int, bool, bool], dict[str, ca.Function]] = Lru(_CACHE_SIZE)

    def __getstate__(self) -> dict[str, object]:
        """State without what can be rebuilt."""
        return self.__dict__ | {"_traces": [], "_equations": {}, "_functions_of_segments": {}}

    def parameters(self, params: Params) -> Array:
        """Vector p for the parameters of a run."""
        return np.array([float(params.get(key, default)) for key, default in self._defaults])

    def outputs(self, t: Array, x: Array, time_values: Array, p: Array) -> Array:
        """Outputs of the network at many times, (noutputs, ntime)."""
        return self._at_many("outputs", t, x, time_values, p)

    def rates(self, t: Array, x: Array, time_values: Array, p: Array) -> Array:
        """Derivatives of all states at many times, (nstates, ntime)."""
        return self._at_many("rates", t, x, time_values, p)

    def slopes(self, t: Array, x: Array, time_values: Array, p: Array) -> Array:
        """Jacobian of the integrated states at many times, column by column, (nmoving**2, ntime)."""
        return self._at_many("jacobian", t, x, time_values, p)

    def signals(self, t: Array, x: Array, time_values: Array, p: Array) -> Array:
        """All signals at many times, (nsignals, ntime)."""
        return self._at_many("signals", t, x, time_values, p)

    def instants(self, first: float, last: float, time_values: Callable[[Array], Array], p: Array) -> list[float]:
        """Times of a run at which the equations switch depending on time and functions of time only.

        Parameters
        ----------
        first, last : float
            Beginning and end of the run [s].
        time_values : callable
            Maps times (n,) to the values of the functions of time (nd, n).
        p : ndarray
            Parameters of the run.
        """
        found: list[float] = []
        for name in self._timed:

            def sides(t: Array, name: str = name) -> Array:
                return np.sign(self._at_many(name, t, np.zeros((self._rates.numel_in(1), t.size)), time_values(t), p))

            found += changes_of_side(sides, first, last)
        return sorted(set(found))

    def _add_timed(self, name: str, switches: ca.Function, rows: NDArray[np.bool_]) -> None:
        """Function of some switches, if there are any, for `instants`."""
        if rows.any():
            inputs = [ca.SX.sym(switches.name_in(k), switches.sparsity_in(k)) for k in range(switches.n_in())]
            chosen = switches(*inputs)[np.flatnonzero(rows).tolist()]
            function = ca.Function("timed", inputs, [ca.densify(chosen)])
            self._functions[f"timed {name}"] = function
            self._timed.append(f"timed {name}")

    def sides(self, t: Array, x: Array, time_values: Array, p: Array) -> Array:
        """Signs of the switching functions at many times, (nswitches, ntime)."""
        return np.sign(self._at_many("switches", t, x, time_values, p))

    def disagreement(self, network: Network, params: Params, t: Array, x: Array, w: Array) -> str:
        """Disagreement of a trace with Python at visited times, states and signals; empty if there is none."""
        for block, trace, states, fed in zip(network.blocks, self._traces, network.states, network.fed, strict=True):
            if trace is not None:
                wrong = agrees(block, trace, params, t, x[states], fed(w))
                if wrong:
                    return f"block {block.name} cannot be traced ({wrong})"
        return ""

    def motion(self, t: float, x: Array, time_values: Array, p: Array) -> Motion:
        """Rates of motion by the equations linearised at a state."""
        n = self.moving.size
        return Motion(self.slopes(np.array([t]), x[:, None], time_values[:, None], p).reshape(n, n, order="F"))

    def integrator(self, settings: Settings) -> Segment:
        """CVODES over a segment scaled to length 1, with outputs at given times."""
        # CasADi releases the global interpreter lock: each thread has its own integrators.
        found = self._integrators.get((threading.get_ident(), settings), lambda: self._made(settings))
        return self._made(settings) if found.is_running else found  # a handler of a signal may simulate

    def one_step(self, settings: Settings) -> OneStep | None:
        """One step over a segment scaled to length 1; None if the equations are too long."""
        equations = self._segment_equations(settings.width, settings.harmonic, settings.scaled)
        key = threading.get_ident(), settings.width, settings.harmonic, settings.scaled
        found = self._steps.get(key, lambda: OneStep(equations) if has_step(equations) else None)
        return OneStep(equations) if found is not None and found.is_running else found

    def pattern(self, left: float, grid: Array) -> Pattern:
        """Output times of a segment from `left` in units of it, found once for many of them."""
        if grid.size == 1:
            return _END
        if grid.size <= _APART:
            return Pattern.of(left, grid)
        key = left, grid.size, *grid[[0, grid.size // 2, -1]].tolist()
        times, found = self._patterns.get(key, lambda: (grid.copy(), Pattern.of(left, grid)))
        return found if np.array_equal(times, grid) else Pattern.of(left, grid)

    def has_integrator(self, settings: Settings) -> bool:
        """Whether an integrator has been built."""
        return (threading.get_ident(), settings) in self._integrators

    def _made(self, settings: Settings) -> Segment:
        multistep, iteration = settings.kind.value
        options: dict[str, Value] = {
            "linear_multistep_method": multistep,
            "nonlinear_solver_iteration": iteration,
            "reltol": settings.rtol,
            "abstol": settings.atol,
            "max_num_steps": settings.max_steps,
            "max_step_size": settings.longest,
            "show_eval_warnings": False,
            "disable_internal_warnings": True,
        }
        what, grid = settings[:3], np.frombuffer(settings.grid).tolist()
        # CasADi derives the Jacobian for each integrator, unless it is given those functions of another one.
        derived = self._derived.get((threading.get_ident(), *what), dict)
        with passing_interruptions():
            equations = self._function_of_segments(*what)
            made = ca.integrator("segment", "cvodes", equations, 0.0, grid, {**options, "cache": derived})
            if not derived:
                named = {name: made.get_function(name) for name in made.get_function()}
                derived |= {name: function for name, function in named.items() if function.name() == name}
        return Segment(made, self.moving.size)

    def _function_of_segments(self, width: int, harmonic: bool, scaled: bool) -> ca.Function:
        """The equations of a segment as a function."""
        key = width, harmonic, scaled
        if key not in self._functions_of_segments:
            equations = self._segment_equations(width, harmonic, scaled)
            inputs = [equations.get(name, ca.SX(0, 1)) for name in ca.dyn_in()]
            results = [equations.get(name, ca.SX(0, 1)) for name in ca.dyn_out()]
            self._functions_of_segments[key] = ca.Function("segment", inputs, results, ca.dyn_in(), ca.dyn_out())
        return self._functions_of_segments[key]

    def _at_many(self, name: str, t: Array, x: Array, time_values: Array, p: Array) -> Array:
        function = self._functions[name]
        if not function.numel_out(0):  # no signals without inputs and outputs
            return np.zeros((0, t.size))
        if t.size >= _MANY:
            by_numpy = self._by_numpy.get(name, lambda: many_points(function))
            if by_numpy is not None:
                return by_numpy((t[None], x, time_values, p))

        def made() -> _AtMany:
            return _AtMany(self._maps.get((name, t.size), lambda: function.map(t.size)), t.size)

        at_all = made() if t.size > _AT_ONCE else self._small.get((threading.get_ident(), name, t.size), made)
        if at_all.is_running:  # a handler of a signal may simulate
            at_all = made()
        return at_all.values(t, x, time_values, p)

    def _segment_equations(self, width: int, harmonic: bool, scaled: bool) -> dict[str, ca.SX]:
        """Equations of scaled states over s in [0, 1], with functions of time as sums of a number of terms.

        The states of sampled blocks, which are constant, are among the parameters. Terms are Chebyshev polynomials, or
        harmonics; the fourth number of `span` is then their rate instead of the end of the series.
        """
        if (width, harmonic, scaled) not in self._equations:
            nx, nd, np_ = (self._rates.numel_in(k) for k in (1, 2, 3))
            moving = self.moving.tolist()
            shapes = {"s": (1,), "z": (len(moving),), "p": (np_,), "c": (nd, width), "bounds": (nd, 2)}
            shapes |= {"span": (6,), "shift": (len(moving),), "scale": (len(moving),), "start": (nx,)}
            s, z, p, c, bounds, span, shift, scale, start = (ca.SX.sym(name, *shape) for name, shape in shapes.items())
            x = ca.SX(start)
            x[moving] = shift + scale * z if scaled else z
            left, length, first, last, earliest, latest = (span[k] for k in range(6))
            t = ca.fmin(ca.fmax(left + s * length, earliest), latest)
            terms = (
                _harmonics(last * (t - first), width)
                if harmonic
                else _chebyshev(2.0 * t - first - last, last - first, width)
            )
            time_values = c @ terms
            if width > 1:  # the bounds of a signal that is nan are nan
                time_values = ca.fmin(ca.fmax(time_values, bounds[:, 0]), bounds[:, 1])
            rates = length * self._rates(t, x, time_values, p)[moving]
            self._equations[width, harmonic, scaled] = {
                "t": s,
                "x": z,
                "p": ca.vertcat(p, ca.vec(c), ca.vec(bounds), shift, scale, span, start),
                "ode": rates / scale if scaled else rates,
            }
        return self._equations[width, harmonic, scaled]

    def _own_parameters(self, p: ca.SX) -> list[ca.SX]:
        """Entries of p for each block."""
        return [
            ca.vertcat(*[p[k] for k, (j, _) in enumerate(self._places) if j == i]) for i in range(len(self._traces))
        ]


class Pattern(NamedTuple):
    """Output times of a segment.

    Attributes
    ----------
    resolved : int
        Number of times that CVODES distinguishes, from the first one.
    relative : ndarray, shape (ntime,)
        Times in units of the segment, rounded.
    grid : bytes
        The same.
    longest : float
        Longest interval between them.
    """

    resolved: int
    relative: Array
    grid: bytes
    longest: float

    @classmethod
    def of(cls, left: float, grid: Array) -> Pattern:
        """Pattern of times of a segment, the last its end."""
        relative = _rounded((grid - left) / (grid[-1] - left))
        longest = round(float(np.diff(relative, prepend=0.0).max()), 6)
        return cls(_resolved(left, grid), relative, relative.tobytes(), longest)


class Settings(NamedTuple):
    """What an integrator of a segment is built for: terms of the functions of time, states, output times, CVODES."""

    width: int
    harmonic: bool
    scaled: bool
    grid: bytes
    kind: Kind
    rtol: float
    atol: float
    max_steps: int
    longest: float


Arguments: TypeAlias = tuple[Array, Array, Sequence[float], Array]
"""Arguments of `Segment.states`."""


class Segment:
    """Integrator of a segment with memory for its arguments and results, for one thread."""

    def __init__(self, integrator: ca.Function, nstates: int) -> None:
        self._start, self._p = np.empty(nstates), np.empty(integrator.numel_in("p"))
        self._found = np.empty((integrator.numel_out("xf") // nstates, nstates))
        given: tuple[Value, Callable[[], None]] = integrator.buffer()  # not in the type stubs of CasADi
        self._buffer, self._evaluate = given
        self.is_running = False
        self._buffer.set_arg(integrator.index_in("x0"), self._start.data)
        self._buffer.set_arg(integrator.index_in("p"), self._p.data)
        self._buffer.set_res(integrator.index_out("xf"), self._found.data)

    def states(self, start: Array, known: Array, span: Sequence[float], held: Array) -> Array:
        """States (nstates, ntime), valid until the next call.

        Parameters
        ----------
        start : ndarray, shape (nstates,)
            Scaled states at the start.
        known, span, held : ndarray or sequence of float
            Parameters, in this order: those that remain, the times of the segment, and all states at its start.
        """
        self._start[:] = start
        end = known.size + len(span)
        self._p[: known.size], self._p[known.size : end], self._p[end:] = known, span, held
        self.is_running = True
        try:
            self._evaluate()
        finally:
            self.is_running = False
        return self._found.T

    def evaluations(self) -> int:
        """Evaluations of the right-hand side in the last call."""
        stats: dict[str, Value] = getattr(self._buffer, "stats", dict)()
        return int(stats.get("nfevals", 0))


class CompiledSolver:
    """CVODES for a compiled network, segment by segment.

    Attributes
    ----------
    form : Compiled
        The compiled equations.
    evaluations : int
        Evaluations of the right-hand side so far, counted if a comparison with
        Python is expected.
    """

    calls_blocks = relative_by_state = False

    def __init__(
        self,
        equations: Compiled,
        params: Params,
        tolerances: Tolerances,
        scales: Scales,
        max_steps: int = 20_000,
    ) -> None:
        self.form, self._p = equations, equations.parameters(params)
        self._scales, self._max_steps = scales, max_steps
        self._shift, self._scale = scales.shift[self.moving], scales.scale[self.moving]
        self._scaled = bool(np.any(self._shift != 0.0) or np.any(self._scale != 1.0))
        self._tolerances = float(tolerances.rtol.min(initial=1.0)), tolerances.atol
        self._longest, self._kind, self._segments, self._patterns = 0.0, Kind.ADAMS, 0, 0
        self._motion, self._short = Motion(np.zeros((0, 0))), 0
        self._counts = equations.compared.is_expected
        self._series: Series | None = None
        self._known = np.empty(0)
        self.evaluations = 0
        self.switches: list[float] = []

    @property
    def moving(self) -> NDArray[np.intp]:
        """Indices of the states that are integrated."""
        return self.form.moving

    def perturbed(self, states: Array) -> Array:
        """States (nstates, ntime) moved by the tolerance of a step, up and down in turn."""
        return self._scales.perturbed(states, *self._tolerances)

    def signals(self, times: Array, states: Array, time_values: Array) -> Array:
        """All signals (nsignals, ntime) of the network."""
        return self.form.signals(times, states, time_values, self._p)

    def outputs(self, times: Array, states: Array, time_values: Array) -> Array:
        """Outputs (noutputs, ntime) of the network."""
        return self.form.outputs(times, states, time_values, self._p)

    def slopes(self, times: Array, states: Array, time_values: Array) -> Array:
        """Jacobian of the integrated states, (ntime, nmoving, nmoving)."""
        n = self.form.moving.size
        return self.form.slopes(times, states, time_values, self._p).reshape(n, n, times.size).transpose(2, 1, 0)

    def rates(self, times: Array, states: Array, time_values: Array) -> Array:
        """Derivatives (nstates, ntime) of the states."""
        return self.form.rates(times, states, time_values, self._p)

    def near_undefined(self, times: Array, states: Array, time_values: Array) -> bool:
        """Whether the equations are undefined within the tolerances of computed states.

        CVODES may otherwise not terminate where the solution ends: next to an
        infinite slope its Newton steps become arbitrarily small.
        """
        rtol, atol = self._tolerances
        reach = (rtol * np.abs(states) + (atol * self._scales.scale)[:, None]) * _EDGE
        near = np.concatenate([states - reach, states, states + reach], axis=1)
        places = np.concatenate([times] * 3), near, np.concatenate([time_values] * 3, axis=1)
        return not np.isfinite(self.form.rates(*places, self._p)).all()

    def instants(self, first: float, last: float, time_values: Callable[[Array], Array]) -> list[float]:
        """Times of a run at which the equations switch depending on functions of time only."""
        return self.form.instants(first, last, time_values, self._p)

    def advance(self, series: Series, left: float, grid: Array, state: Array) -> Array:
        """States (nstates, ngrid) at times of a segment; the last is its end."""
        pattern = self.form.pattern(left, grid)
        if pattern.resolved == grid.size:
            return self._advanced(series, left, grid, state, pattern)
        parts = list[Array]()
        while grid.size:
            some = grid[: self.form.pattern(left, grid).resolved]
            parts.append(self._advanced(series, left, some, state, self.form.pattern(left, some)))
            left, state, grid = float(some[-1]), parts[-1][:, -1], grid[some.size :]
        return np.concatenate(parts, axis=1)

    def _advanced(self, series: Series, left: float, grid: Array, state: Array, pattern: Pattern) -> Array:
        """The same for times that are not too close together."""
        moving = self.form.moving
        if not moving.size:
            return np.repeat(state[:, None], grid.size, axis=1)
        right = float(grid[-1])
        if self._segments % _KIND_KEPT == 0:
            self._motion = self.form.motion(left, state, series(left), self._p)
        if right - left > self._longest or self._segments % _KIND_KEPT == 0:
            self._longest = max(self._longest, right - left)
            self._kind = self._motion.kind(self._longest)
        self._segments += 1
        settings = self._settings(series, pattern)
        if self._is_rare(settings, grid.size):
            each = [self._advanced(series, left, grid[k : k + 1], state, _END) for k in range(grid.size)]
            return np.concatenate(each, axis=1)
        if series is not self._series:
            self._known, self._series = np.concatenate([self._p, series.flat, self._shift, self._scale]), series
        last = series.right if series.harmonics is None else series.harmonics.rate
        span = (left, right - left, series.left, last, *within(left, right, self.switches))
        start = (state[moving] - self._shift) / self._scale
        try:
            found = self._solved(settings, (start, self._known, span, state), pattern.relative)
        except _SegmentError as error:
            why = f"the solver must reach {right:g} s from {left:g} s, but the segment fails: {error}"
            raise SolverError(why) from None
        found = np.array(found, order="C")  # each state contiguous: reductions over time are then fast
        if self._scaled:
            found *= self._scale[:, None]
            found += self._shift[:, None]
        if moving.size == state.size:
            return found
        out = np.repeat(state[:, None], grid.size, axis=1)
        out[moving] = found
        return out

    def count(self) -> None:
        """Start counting evaluations."""
        self._counts = True

    def _settings(self, series: Series, pattern: Pattern) -> Settings:
        # Equations that depend on time are evaluated at least once per sample, so that no pulse is skipped.
        longest = pattern.longest if self.form.depends_on_time else 0.0
        allowed = min(_FEW_STEPS, self._max_steps)
        what = series.terms.shape[1], series.harmonics is not None, self._scaled
        return Settings(*what, pattern.grid, self._kind, *self._tolerances, allowed, longest)

    def _is_rare(self, settings: Settings, count: int) -> bool:
        """Whether a pattern of some output times is integrated to each of them, without an integrator of its own."""
        if not 1 < count <= _APART or settings.longest or self.form.has_integrator(settings):
            return False
        self._patterns += 1
        return self._patterns > _PATTERNS

    def _solved(self, settings: Settings, arguments: Arguments, relative: Array) -> Array:
        """Scaled states at the relative times; a diverging solution exhausts the steps."""
        if relative.size == 1 and not settings.longest and self._motion.norm * arguments[2][1] <= LONGEST:
            self._short += 1
            found = self._in_one_step(settings, arguments) if self._short > _FEW_SHORT else None
            if found is not None:
                return found
        if settings.kind is Kind.FIXED_POINT:
            with suppress(_SegmentError):  # the equations may have become stiff
                return self._tried(settings, arguments)
            settings = settings._replace(kind=Kind.ADAMS)
        try:
            return self._tried(settings, arguments)
        except _SegmentError as error:
            if not error.too_long or settings.max_steps == self._max_steps:
                raise
        # More steps, with closer outputs.
        close = np.union1d(relative, np.linspace(0.0, 1.0, _CLOSE)[1:])
        found = self._tried(settings._replace(grid=close.tobytes(), max_steps=self._max_steps), arguments)
        return found[:, np.searchsorted(close, relative)]

    def _in_one_step(self, settings: Settings, arguments: Arguments) -> Array | None:
        """Scaled states at the end of a segment by one step; None if it is not accurate enough."""
        step = self.form.one_step(settings)
        if step is None:
            return None
        start, known, span, held = arguments
        found = step.state(start, (known, span, held), settings.rtol, settings.atol)
        self.evaluations += EVALUATIONS * self._counts
        return None if found is None else found[:, None]

    def _tried(self, settings: Settings, arguments: Arguments) -> Array:
        integrator = self.form.integrator(settings)
        try:
            with passing_interruptions():
                found = integrator.states(*arguments)
        except RuntimeError as error:
            code = re.search(r"CV_\w+", str(error))
            raise _SegmentError(code.group() if code else "") from None
        if self._counts:
            self.evaluations += integrator.evaluations()
        return found


_END = Pattern(1, np.ones(1), np.ones(1).tobytes(), 1.0)
"""Pattern of the end of a segment only."""


class _SegmentError(Exception):
    """CVODES failed over a segment."""

    def __init__(self, flag: str) -> None:
        super().__init__(_FAILURES.get(flag, "the equations could not be evaluated"))
        self.too_long = flag == "CV_TOO_MUCH_WORK"


class _AtMany:
    """Function of (t, x, time_values, p) mapped over some times, with memory for its arguments, for one thread."""

    def __init__(self, function: ca.Function, count: int) -> None:
        given: tuple[Value, Callable[[], None]] = function.buffer()  # not in the type stubs of CasADi
        self._buffer, self._evaluate = given
        self._arguments = [np.empty((count, function.numel_in(k) // count)) for k in range(function.n_in())]
        self._found = np.empty((count, function.numel_out(0) // count))
        self.is_running = False
        for k, values in enumerate(self._arguments):
            if values.size:
                self._buffer.set_arg(k, values.data)
        self._buffer.set_res(0, self._found.data)

    def values(self, t: Array, x: Array, time_values: Array, p: Array) -> Array:
        """First result (nrows, ntime)."""
        self.is_running = True
        try:
            for place, values in zip(self._arguments, (t[:, None], x.T, time_values.T, p), strict=True):
                if place.size:
                    place[...] = values
            self._evaluate()
            return np.array(self._found.T, order="C")
        finally:
            self.is_running = False


def _rounded(relative: Array) -> Array:
    """Relative output times of a segment; rounded, as rounding errors of time must not require a new integrator."""
    rounded = np.round(relative, _DIGITS)
    gaps = np.diff(rounded)
    first = rounded[np.flatnonzero(rounded)[0]]  # an output time may equal the start to rounding
    return rounded if gaps.min() > _NEAR and first > _EVEN * gaps.max() else relative


def _resolved(left: float, grid: Array) -> int:
    """Number of output times of a segment from `left` to the last of them that CVODES distinguishes."""
    if grid.size < 2:
        return grid.size
    gaps = np.diff(grid, prepend=left)
    gaps[gaps <= _EQUAL * np.spacing(np.abs(grid))] = np.inf
    if gaps.min() >= _CLOSEST * (grid[-1] - left):
        return grid.size
    close = np.minimum.accumulate(gaps) < _CLOSEST * (grid - left)
    return max(1, int(close.argmax()))


def _switch_with(switches: ca.Function, network: Network, argument: int) -> NDArray[np.bool_]:
    """Which switches depend on time (argument 0) or functions of time (2) but on no state."""
    delayed = np.zeros(network.nsignals, dtype=bool)
    for i in network.blocks_with("delay"):
        delayed[network.outputs[i]] = True
    depends = {k: np.asarray(ca.DM(switches.jac_sparsity(0, k)).full(), dtype=bool) for k in {argument, 1, 2}}
    undecided = depends[1].any(axis=1) | depends[2][:, delayed[network.time_rows]].any(axis=1)
    return np.asarray(depends[argument].any(axis=1) & ~undecided)


def _feedthrough(block: Block, trace: Trace | None) -> NDArray[np.bool_]:
    if trace is not None:
        return trace.feedthrough()
    known = known_feedthrough(block)
    return np.ones((block.system.noutputs, block.system.ninputs or 0), dtype=bool) if known is None else known


def _signals(
    network: Network,
    traces: list[Trace | None],
    own: list[ca.SX],
    steps: list[Step],
    t: ca.SX,
    x: ca.SX,
    time_values: ca.SX,
) -> ca.SX:
    """Column of all signals."""
    known = [ca.SX(0)] * network.nsignals
    for k, row in enumerate(network.time_rows):
        known[row] = time_values[k]
    for step in steps:
        if step.unknown is None:
            _evaluate(network, traces, own, step.blocks[0], t, x, known)
            continue
        # Unknown signals z with z = f(z): for linear f the solution of a small linear system.
        z = ca.SX.sym("z", step.unknown.size)
        trial = list(known)
        for k, row in enumerate(step.unknown):
            trial[row] = z[k]
        after = list(trial)
        for i in step.blocks:
            fed = list(trial)
            _evaluate(network, traces, own, i, t, x, fed)
            for row in range(network.outputs[i].start, network.outputs[i].stop):
                after[row] = fed[row]
        left_over = ca.vertcat(*[after[row] for row in step.unknown]) - z
        slope = ca.jacobian(left_over, z)
        if any(ca.which_depends(slope, z, 1, True)) if slope.nnz() else False:
            raise NotTraceableError(f"the algebraic loop of the blocks {network.names(step.blocks)} is not linear")
        found = -ca.solve(ca.densify(slope), ca.substitute(left_over, z, ca.SX.zeros(z.numel())))
        for k, row in enumerate(step.unknown):
            known[row] = found[k]
    return ca.vertcat(*known)


def _evaluate(
    network: Network, traces: list[Trace | None], own: list[ca.SX], i: int, t: ca.SX, x: ca.SX, known: list[ca.SX]
) -> None:
    """Store the outputs of a block in the known signals."""
    block, states, outs = network.blocks[i], network.states[i], network.outputs[i]
    fed = _sparse(network.wire[network.inputs[i]]) @ ca.vertcat(*known)
    trace = traces[i]
    if trace is None:
        column = _linear(block.system.C, block.system.D, _part(x, states), fed)
    else:
        column = trace.output(t, _part(x, states), fed, own[i])
    for k in range(outs.stop - outs.start):
        known[outs.start + k] = column[k]


def _rates(network: Network, traces: list[Trace | None], own: list[ca.SX], t: ca.SX, x: ca.SX, w: ca.SX) -> ca.SX:
    rows = []
    for block, trace, states, inputs, p in zip(
        network.blocks, traces, network.states, network.inputs, own, strict=True
    ):
        if states.stop == states.start:
            continue
        fed = _sparse(network.wire[inputs]) @ w
        rows.append(
            _linear(block.system.A, block.system.B, _part(x, states), fed)
            if trace is None
            else trace.update(t, _part(x, states), fed, p)
        )
    return ca.densify(ca.vertcat(*rows))


def _part(x: ca.SX, rows: slice) -> ca.SX:
    """Rows of a column; an empty column without rows."""
    return x[rows] if rows.stop > rows.start else ca.SX(0, 1)


def _linear(a: ArrayLike, b: ArrayLike, x: ca.SX, u: ca.SX) -> ca.SX:
    """Sum a x + b u."""
    return _sparse(a) @ x + _sparse(b) @ u


def _sparse(matrix: ArrayLike) -> ca.DM:
    """Sparse matrix: 0 times nan is then 0, and the equations are shorter."""
    return ca.sparsify(ca.DM(np.asarray(matrix, dtype=float)))


def _chebyshev(numerator: ca.SX, length: ca.SX, width: int) -> ca.SX:
    """Chebyshev polynomials (width,) at numerator / length."""
    u = numerator / length
    twice = 2.0 * u
    values = [ca.SX(1), u]
    while len(values) < width:
        values.append(twice * values[-1] - values[-2])
    return ca.vertcat(*values[:width])


def _harmonics(angle: ca.SX, width: int) -> ca.SX:
    """Terms (width,) of `Harmonics` at an angle."""
    c1, s1 = ca.cos(angle), ca.sin(angle)
    c, s, values = c1, s1, [ca.SX(1)]
    while len(values) < width:
        values += [c, s]
        c, s = c * c1 - s * s1, s * c1 + c * s1
    return ca.vertcat(*values)
