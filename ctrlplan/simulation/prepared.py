"""Internal form of a system, reused for many runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import TYPE_CHECKING

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_kind
from ctrlplan._display import Displayed, Facts, Part, counted
from ctrlplan._lru import BUILDING, Lru
from ctrlplan._types import Array, Params, System, Value
from ctrlplan.simulation.built_forms import (
    BuiltForm,
    BuiltForms,
    DisagreementError,
    NotCompiledError,
    built_once,
    traced_once,
)
from ctrlplan.simulation.delayed_signals import DelayedSignal, HeldDelaySignal
from ctrlplan.simulation.interpreted import Interpreted
from ctrlplan.simulation.known_delays import with_known_delays
from ctrlplan.simulation.linear import LinearForm, NotLinearError, linear_form
from ctrlplan.simulation.network import Block, Network, UnsupportedError, structure
from ctrlplan.simulation.sampled_form import DelayedForm, SampledForm, delayed_form, sampled_form
from ctrlplan.simulation.signals import PlanSignal, TimeSignal, TimeSignals, signal_values
from ctrlplan.simulation.starts import command_starts
from ctrlplan.simulation.unread import is_read
from ctrlplan.symbolic import missing_casadi
from ctrlplan.symbolic.fingerprint import array_token, fingerprint, value_token
from ctrlplan.symbolic.keeper import Keeper
from ctrlplan.symbolic.references import Same
from ctrlplan.traits import traits_of

if TYPE_CHECKING:
    from ctrlplan.simulation.compiled import Compiled
    from ctrlplan.simulation.stepper import Stepper
    from ctrlplan.symbolic.tracing import Trace

_CACHE_SIZE = 16
"""Number of systems whose forms `simulate` caches, and of plans of each whose values are shared by runs."""


class Prepared(Displayed):
    """System prepared for simulation; returned by `prepare`.

    Attributes
    ----------
    name : str
        Name of the system.
    input_labels, output_labels, state_labels : list of str
        Labels of its signals, in the order of python-control.
    nstates : int
        Number of states.
    """

    def __init__(self, system: System, known: tuple[object, ...] | None = None) -> None:
        self.original = system
        self._stated: Array | None = None
        self.fingerprint = fingerprint(system) if known is None else known
        self.system = state_space(system)
        self.name = str(self.system.name)
        self.input_labels = list(self.system.input_labels or [])
        self.output_labels = list(self.system.output_labels or [])
        self.state_labels = list(self.system.state_labels or [])
        self.nstates = len(self.state_labels)
        self.dt = self.system.dt
        self.issiso = bool(self.system.issiso())
        self.linear: LinearForm | None = None
        self.not_linear = ""
        self.network: Network | None = None
        self.unsupported = ""
        try:
            self.linear = linear_form(self.system)
        except NotLinearError as error:
            self.not_linear = str(error)
        try:
            self.network = Network.of(self.system)
        except UnsupportedError as error:
            self.unsupported = str(error)
        self.sampled: SampledForm | None = None
        self.delayed: DelayedForm | None = None
        self.not_sampled = self.not_linear
        for block in self._blocks():
            if block.delay is not None or block.period is not None:
                what = "is a delay" if block.delay is not None else "is sampled"
                self.not_linear = f"block {block.name} {what}"
        if self.linear is None and self.network is not None and not self.is_discrete:
            try:
                self.sampled = sampled_form(self.network)
            except NotLinearError as error:
                self.not_sampled = str(error)
                self._use_delays(self.network)
        self._sources = [PlanSignal(b.plan, b.traits.derivatives) for b in self._blocks() if b.plan is not None]
        self._planned: Lru[tuple[tuple[Same, int], ...], TimeSignals] = Lru(_CACHE_SIZE)
        self._built_forms = BuiltForms()
        self.starts = command_starts(self._blocks())

    def _use_delays(self, network: Network) -> None:
        """Use the form of a continuous loop with delays, if it is one."""
        if not network.blocks_with("delay"):
            return
        try:
            self.delayed = delayed_form(network)
        except NotLinearError as error:
            self.not_sampled = str(error)

    def _describe(self) -> Iterator[Part]:
        yield f"Prepared form of {self.name}: {counted(self.nstates, 'state')}"
        yield Facts(
            [
                ("inputs", ", ".join(self.input_labels)),
                ("outputs", ", ".join(self.output_labels)),
                ("states", ", ".join(self.state_labels)),
                ("time", f"discrete, dt = {self.dt}" if self.is_discrete else "continuous"),
                ("linear", f"no: {self.not_linear}" if self.not_linear else "yes"),
            ]
        )

    @property
    def initial_state(self) -> Array | None:
        """Declared initial state, or None."""
        return _filled(self.stated)

    @property
    def stated(self) -> Array | None:
        """Declared initial state.

        nan for states of blocks that declare none; None if no block does.
        """
        return self._stated if self.system is None else stated_states(self.system)

    @property
    def ninputs(self) -> int:
        """Number of inputs."""
        return len(self.input_labels)

    @property
    def is_discrete(self) -> bool:
        """Whether the system is in discrete time."""
        return self.dt not in (None, 0)

    @property
    def has_blocks(self) -> bool:
        """Whether the blocks are available.

        They are not in a form that was sent from another process.
        """
        return self.network is not None and bool(self.network.blocks)

    def time_signals(self, inputs: Sequence[TimeSignal], first: float) -> TimeSignals:
        """Input signals, then outputs of blocks that are functions of time; the same object for the same plans."""
        delays = any(block.delay is not None for block in self._blocks())
        if delays or not all(isinstance(signal, PlanSignal) for signal in inputs):
            return TimeSignals(self._signals_in_order(inputs, first))
        key = tuple((Same(signal.plan), signal.derivatives) for signal in inputs if isinstance(signal, PlanSignal))
        return self._planned.get(key, lambda: TimeSignals(self._signals_in_order(inputs, first)))

    def _signals_in_order(self, inputs: Sequence[TimeSignal], first: float) -> list[TimeSignal]:
        sources, found = iter(self._sources), list(inputs)
        for i, block in enumerate(self._blocks()):
            if block.plan is not None:
                found.append(next(sources))
            elif block.delay is not None and self.network is not None:
                kind = HeldDelaySignal if self.network.is_held(i) else DelayedSignal
                initial = np.broadcast_to(np.asarray(block.traits.initial, dtype=float), (block.system.ninputs,))
                found.append(kind(block.delay, initial, first))
        found += sources
        return found if self.network is None else with_known_delays(self.network, found, first)

    def compiled(
        self, params: Params, time_signals: Sequence[TimeSignal], first: float, state: Array, trials: bool = True
    ) -> Compiled:
        """Compiled form, built once for all values of the parameters.

        Raises
        ------
        NotCompiledError
            If CasADi is missing, or a block cannot be traced; the message names it.
        """

        def traced() -> BuiltForm:
            built = self._build(params, time_signals, first, state, trials)
            if self.original is not None:  # the trace has shown which objects the blocks only write
                self.fingerprint = fingerprint(self.original)
                _FORMS.get(self.fingerprint, lambda: self)
            return built

        def build() -> BuiltForm:
            return built_once(lambda: self._structure(params), traced)

        return self._built_forms.form(params, build)

    def discard(self, form: Compiled, why: str) -> DisagreementError:
        """Error to raise for a compiled form that is wrong; it is discarded."""
        return self._built_forms.discard(form, why)

    def start(
        self,
        dt: float,
        initial_state: ArrayLike | None = None,
        *,
        time: float = 0.0,
        params: Mapping[str, object] | None = None,
        rtol: float = 1e-8,
    ) -> Stepper:
        """Stepper: simulation one step at a time, with inputs that are held over each step.

        Parameters
        ----------
        dt : float
            Length of a step [s]; for a discrete system a multiple of its period.
            If that is unspecified (dt = True), a step is one sample.
        initial_state : array_like, shape (nstates,), float or None, optional
            As for `simulate`: None is the declared initial state, 0 where none is.
        time : float, optional
            Start time [s], from which plans and samples of discrete blocks run.
        params : mapping, optional
            Parameters of the blocks.
        rtol : float, optional
            Relative tolerance of the numerical solvers, as for `simulate`.

        Returns
        -------
        Stepper
            With ``step(inputs)``, ``outputs(inputs)``, ``time`` and ``state``.

        Raises
        ------
        TypeError
            If a number is of the wrong type, or only python-control can evaluate a
            block.
        ValueError
            If `dt` is not above 0, too small for the times, or no multiple of the
            period of a discrete system; or if the state does not fit.

        Warns
        -----
        UserWarning
            If a system with states has no timebase (dt = None): it is stepped as
            continuous-time.

        Examples
        --------
        >>> import control as ct
        >>> import ctrlplan as cp
        >>> stepper = cp.prepare(ct.tf([1], [1, 1])).start(0.1)
        >>> float(stepper.step(1.0)[0].round(6))  # 1 - exp(-0.1)
        0.095163
        """
        from ctrlplan.simulation.stepper import started  # it imports this module

        return started(prepared_form(self), dt, initial_state, time, params, rtol)

    def detached(self, names: Iterable[str] = ()) -> Prepared:
        """Same form without the blocks of python-control.

        For other processes and for many runs; the compiled form is no longer
        compared with Python.

        Raises
        ------
        TypeError
            If it is neither linear nor compiled for all values of these
            parameters, or has delays or discrete blocks.
        """
        other = object.__new__(Prepared)
        other.__dict__.update(self.__getstate__())
        if self.linear is None:
            other._built_forms = other._built_forms.for_any(names)
            if not other._built_forms.forms:
                raise TypeError(f"{self.name} is not compiled for any values of {', '.join(names) or 'no parameters'}")
        return other

    def reads(self, name: str, value: Value, initial_state: ArrayLike | None = None) -> bool:
        """Whether a block has or reads a parameter.

        Reading is determined by calls near the initial state.
        """
        network = self.network
        if network is None or not network.blocks or any(name in block.params for block in network.blocks):
            return True
        given = self.initial_state if initial_state is None else initial_state
        start = np.zeros(self.nstates) + (0.0 if given is None else np.asarray(given, dtype=float))

        def at_start() -> Array:
            return signal_values(self.time_signals([], 0.0), np.zeros(1))[:, 0]

        return self._built_forms.reads(name, partial(is_read, network, name, value, start, at_start))

    def _build(
        self, params: Params, time_signals: Sequence[TimeSignal], first: float, state: Array, trials: bool
    ) -> BuiltForm:
        """Compiled form of all blocks, or the reason why there is none."""
        names, network = frozenset(params), self.network
        if missing := missing_casadi():
            return BuiltForm(names, {}, NotCompiledError(missing))
        from ctrlplan.simulation.compiled import Compiled
        from ctrlplan.symbolic.tracing import NotTraceableError, traced

        if network is None:
            return BuiltForm(names, {}, NotCompiledError(self.unsupported))
        if not network.blocks:
            why = f"{self.name} has come without its blocks, compiled for other parameters"
            return BuiltForm(names, {}, NotCompiledError(why))
        traces: list[Trace | None] = []
        constants: dict[str, tuple[object, ...]] = {}
        try:
            w = self._signals_at_start(network, params, time_signals, first, state, trials)
            for block, states, fed in zip(network.blocks, network.states, network.fed, strict=True):
                if block.linear or block.is_time_function:
                    traces.append(None)
                    continue
                trace = traced_once(
                    partial(structure, block, params), partial(traced, block, params, first, state[states], fed(w))
                )
                traces.append(trace)
                # A parameter that is a constant in the trace must have this value in every run of it.
                constants |= {key: value_token(params[key]) for key in params if key not in trace.symbols}
            return BuiltForm(names, constants, Compiled(network, traces))
        except NotTraceableError as error:
            every = {key: value_token(value) for key, value in params.items()}
            return BuiltForm(names, every, NotCompiledError(str(error)))

    def _structure(self, params: Params) -> tuple[object, ...] | None:
        """What the compiled form depends on, by value; None if it cannot be shared with other systems."""
        network = self.network
        parts = None if network is None else [structure(block, params) for block in network.blocks]
        if network is None or not parts or None in parts:
            return None
        return network.ninputs, array_token(network.wire), array_token(network.read), *parts

    def _signals_at_start(
        self,
        network: Network,
        params: Params,
        time_signals: Sequence[TimeSignal],
        first: float,
        state: Array,
        trials: bool,
    ) -> Array:
        """Signals at the start of a run, by trial calls without side effects."""
        from ctrlplan.symbolic.tracing import callable_references

        others = [block for block in network.blocks if not (block.linear or block.is_time_function)]
        keeper = Keeper(callable_references(others, params))
        try:
            equations = Interpreted(network.for_trials(), params, (first, state), trials)
            return equations.signals(first, state, signal_values(time_signals, np.array([first]))[:, 0])
        finally:
            keeper.restore()

    def _blocks(self) -> tuple[Block, ...]:
        return self.network.blocks if self.network is not None else ()

    def __getstate__(self) -> dict[str, object]:
        """State without the objects of python-control, whose functions cannot be pickled."""
        usable = self._built_forms.usable()
        if self.linear is None:
            special = any(block.delay is not None or block.period is not None for block in self._blocks())
            if not usable.forms or special:
                raise TypeError(
                    f"{self.name} must be linear or compiled, without delays and samples, to be sent to another "
                    "process; give a function that builds it"
                )
        network = self.network
        if network is not None:
            network = network.without_blocks()
        return self.__dict__ | {
            "original": None,
            "system": None,
            "fingerprint": None,
            "network": network,
            "_built_forms": usable,
            "_stated": self.stated,
        }


def prepare(system: System | Prepared) -> Prepared:
    """System prepared for many simulations.

    `simulate` accepts it in place of the system. Its linear or compiled form is
    built once, for all values of parameters, plans at inputs and initial states.

    Parameters
    ----------
    system : control system
        As for `simulate`.

    Returns
    -------
    Prepared
        With the attributes ``name``, ``input_labels``, ``output_labels``,
        ``state_labels``, ``nstates`` and ``initial_state``, the declared one.

    Raises
    ------
    TypeError
        If `system` is not a control system.
    ValueError
        If it has no number of states, inputs or outputs.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> ready = cp.prepare(cp.plants.integrator_lag_loop(5.0))
    >>> [round(float(cp.simulate(ready, [0.0, 20.0], final).outputs[-1]), 3) for final in (1.0, 2.0)]
    [1.0, 2.0]
    """
    if isinstance(system, Prepared):
        return system
    return Prepared(_checked_system(system))


def prepared_form(system: System | Prepared) -> Prepared:
    """Cached form of a system, rebuilt if it has changed.

    Changes are those of connections, parameters and blocks.
    """
    if isinstance(system, Prepared) and (system.original is None or system is _UNCHANGED.get()):
        return system
    with BUILDING:  # no other thread makes trial calls of a block
        if isinstance(system, Prepared):
            if fingerprint(system.original) == system.fingerprint:
                return system
            system = system.original
        _checked_system(system)
        found = fingerprint(system)
        return _FORMS.get(found, partial(Prepared, system, found))


@contextmanager
def unchanged(system: System | Prepared) -> Iterator[Prepared]:
    """Prepared form of a system that does not change in the block, in which it is compared with the system once."""
    prepared = prepared_form(system)
    token = _UNCHANGED.set(prepared)
    try:
        yield prepared
    finally:
        _UNCHANGED.reset(token)


def stated_start(system: System | Prepared) -> Array | None:
    """Declared initial state of a system.

    0 for states of blocks that declare none; None if no block does.
    """
    return _filled(stated_states(system))


def stated_states(system: System | Prepared) -> Array | None:
    """Declared initial state of a system.

    nan for states of blocks that declare none; None if no block does.
    """
    if isinstance(system, Prepared):
        return system.stated
    own = traits_of(system).initial_state
    if own is not None:
        return own
    if not isinstance(system, ct.InterconnectedSystem):
        return None
    parts = [(stated_states(block), block.nstates or 0) for block in system.syslist]
    if all(start is None for start, _ in parts):
        return None
    return np.concatenate([np.full(count, np.nan) if start is None else start for start, count in parts])


def state_space(system: System) -> System:
    """State-space form of a transfer function, or the same system."""
    if not isinstance(system, ct.TransferFunction):
        return system
    return ct.ss(system, name=system.name, inputs=system.input_labels, outputs=system.output_labels)


def _filled(stated: Array | None) -> Array | None:
    """Declared initial state with 0 where none is declared."""
    return None if stated is None else np.where(np.isnan(stated), 0.0, stated)


def _checked_system(system: System) -> System:
    check_kind(system, "system", ct.InputOutputSystem, "a control system")
    states = 0 if isinstance(system, ct.TransferFunction) else system.nstates
    sizes = {"states": states, "inputs": system.ninputs, "outputs": system.noutputs}
    unknown = [name for name, size in sizes.items() if size is None]
    if unknown:
        numbers = ", ".join(f"{name}=..." for name in unknown)
        raise ValueError(
            f"system must declare its number of {unknown[0]}, got {system.name} without; construct it with {numbers}"
        )
    return system


_FORMS: Lru[tuple[object, ...], Prepared] = Lru(_CACHE_SIZE)

_UNCHANGED: ContextVar[Prepared | None] = ContextVar("_UNCHANGED", default=None)
"""Form that need not be compared with its system."""
