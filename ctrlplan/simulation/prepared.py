"""The built form of a system, kept for many runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._lru import BUILDING, Lru
from ctrlplan.simulation.interpreted import Interpreted
from ctrlplan.simulation.linear import LinearForm, NotLinearError, linear_form
from ctrlplan.simulation.network import Network, UnsupportedError
from ctrlplan.simulation.segments import DelayedSignal
from ctrlplan.simulation.signals import PlanSignal, TimeSignal, signal_values
from ctrlplan.symbolic import missing_casadi
from ctrlplan.symbolic.fingerprint import fingerprint, value_token
from ctrlplan.symbolic.isolation import tried, untouched
from ctrlplan.symbolic.keeper import Keeper
from ctrlplan.symbolic.references import References
from ctrlplan.symbolic.trials import reads
from ctrlplan.traits import traits_of

if TYPE_CHECKING:
    from ctrlplan.simulation.compiled import Compiled
    from ctrlplan.symbolic.tracing import Trace

Array = NDArray[np.float64]

_KEPT = 16
"""Systems that `simulate` keeps by itself."""

_PARAMS = 3
"""Position of the parameters among the arguments of a block's function."""


class NotApplicableError(ValueError):
    """A method of simulation that does not apply to a system, and why."""


class NotCompiledError(NotApplicableError):
    """A system that cannot be compiled, and why."""


class DisagreementError(NotCompiledError):
    """A compiled system that is not what Python says at states that a run visited."""


class Prepared:
    """Built form of a system; made by `prepare`.

    Attributes
    ----------
    name : str
        Of the system.
    input_labels, output_labels, state_labels : list of str
        Its signals, in python-control's order.
    nstates : int
        Number of states.
    """

    def __init__(self, system: Any) -> None:
        self.original = system
        self._stated: Array | None = None
        self.fingerprint = fingerprint(system)
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
        for block in self._blocks():
            if block.delay is not None or block.period is not None:
                what = "puts out the past" if block.delay is not None else "takes samples"
                self.not_linear = f"block {block.name} {what}"
        self._sources = [PlanSignal(b.plan, b.traits.derivatives) for b in self._blocks() if b.plan is not None]
        self.trusted = True
        self._read: dict[str, bool] = {}
        self._compiled: list[tuple[frozenset[str], dict[str, Any], Compiled | NotCompiledError]] = []

    def __repr__(self) -> str:
        return f"<Prepared form of {self.name}: {self.nstates} states>"

    @property
    def initial_state(self) -> Any:
        """Where the system says that it starts, or None."""
        return _filled(self.stated)

    @property
    def stated(self) -> Array | None:
        """States at which the system or its blocks say that they start, nan for the others; None where none does."""
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
        """Whether python-control's blocks are at hand: not in a form from another process."""
        return self.network is not None and bool(self.network.blocks)

    def time_signals(self, inputs: list[TimeSignal], first: float) -> list[TimeSignal]:
        """Given inputs, then the driven blocks in order."""
        sources, found = iter(self._sources), list(inputs)
        for block in self._blocks():
            if block.plan is not None:
                found.append(next(sources))
            elif block.delay is not None:
                initial = np.broadcast_to(np.asarray(block.traits.initial, dtype=float), (block.system.ninputs,))
                found.append(DelayedSignal(block.delay, initial, first))
        return [*found, *sources]

    def compiled(
        self, params: Mapping[str, Any], time_signals: list[TimeSignal], first: float, state: Array, trials: bool = True
    ) -> Compiled:
        """Compiled form for some parameters, built once for all their values.

        Raises
        ------
        NotCompiledError
            If CasADi is missing, or a block cannot be traced; it is named.
        """
        form = self._known(params)
        if form is None:
            with BUILDING:
                form = self._known(params)
                if form is None:
                    form, baked = self._build(params, time_signals, first, state, trials)
                    if self.original is not None:  # what blocks only write has turned out meanwhile
                        self.fingerprint = fingerprint(self.original)
                    self._compiled = [*self._compiled[-7:], (frozenset(params), baked, form)]
        if isinstance(form, NotCompiledError):
            raise NotCompiledError(str(form))
        return form

    def _known(self, params: Mapping[str, Any]) -> Compiled | NotCompiledError | None:
        """Form built before, in which the parameters that are no symbols have the same values."""
        for names, baked, form in self._compiled:
            numbers = isinstance(form, NotCompiledError) or all(np.ndim(params.get(k, 0.0)) == 0 for k in form.symbols)
            if names == frozenset(params) and numbers and all(value_token(params[k]) == v for k, v in baked.items()):
                return form
        return None

    def distrust(self, form: Compiled, why: str) -> DisagreementError:
        """Drop a compiled form that was found wrong: once, for what it was made of may have changed; then for good."""
        with BUILDING:
            again, self.trusted = not self.trusted, False
            self._compiled = [
                (names, baked, NotCompiledError(why) if known is form else known)
                for names, baked, known in self._compiled
                if again or known is not form
            ]
        return DisagreementError(why)

    def detached(self, names: Iterable[str] = ()) -> Prepared:
        """Same form without python-control's blocks, for other processes and for many runs with some parameters.

        Nothing is compared with Python any more.

        Raises
        ------
        TypeError
            If it is neither linear nor compiled for any values of these
            parameters, or has delays or discrete blocks.
        """
        other = object.__new__(Prepared)
        other.__dict__.update(self.__getstate__())
        if self.linear is None:
            other._compiled = [entry for entry in other._compiled if entry[0] == frozenset(names) and not entry[1]]
            if not other._compiled:
                raise TypeError(f"{self.name} is not compiled for any values of {', '.join(names) or 'no parameters'}")
        return other

    def reads(self, name: str, value: Any, initial_state: Any = None) -> bool:
        """Whether a block has a parameter, or reads one of that name where a run begins or near it."""
        network = self.network
        if network is None or not network.blocks or any(name in block.params for block in network.blocks):
            return True
        if name in self._read:
            return self._read[name]
        self._read[name] = self._is_read(network, name, value, initial_state)
        return self._read[name]

    def _is_read(self, network: Network, name: str, value: Any, initial_state: Any) -> bool:
        blocks = [i for i, block in enumerate(network.blocks) if not (block.linear or block.driven)]
        functions = {i: [*_functions(network.blocks[i].system)] for i in blocks}
        # A call may take minutes, as that of an estimator which runs an optimiser: only what can tell is called.
        tellers = {i: [f for f in functions[i] if reads(f, _PARAMS)] for i in blocks}
        if not any(tellers.values()):
            return False
        given = self.initial_state if initial_state is None else initial_state
        start = np.zeros(self.nstates) + (0.0 if given is None else np.asarray(given, dtype=float))
        w = np.zeros(network.nsignals)
        found = References((f"block {network.blocks[i].name}", f) for i in blocks for f in functions[i])
        if found.opaque:  # a call might leave something behind: what the code names counts
            return name in found.names or not found.names.isdisjoint(("keys", "values", "items"))
        keeper = Keeper(found)

        def starting() -> Array:
            equations = Interpreted(network, {name: value}, (0.0, start))
            return equations.signals(0.0, start, signal_values(self.time_signals([], 0.0), np.zeros(1))[:, 0])

        read: set[str] = set()
        rng = np.random.default_rng(0)
        with untouched():
            w = tried(starting, np.zeros(network.nsignals))
            for i in blocks:
                noticing = _Noticing({**network.blocks[i].params, name: value}, read)
                for scale in (0.0, 0.1, 1.0):
                    x, u = start[network.states[i]], network.fed[i](w)
                    x, u = (v + scale * rng.standard_normal(v.size) * (1.0 + np.abs(v)) for v in (x, u))
                    for function in tellers[i]:
                        tried(partial(function, 10.0 * scale, x.copy(), u.copy(), noticing), None)
        keeper.restore()
        return name in read or _Noticing.ALL in read

    def _build(
        self, params: Mapping[str, Any], time_signals: list[TimeSignal], first: float, state: Array, trials: bool
    ) -> tuple[Compiled | NotCompiledError, dict[str, Any]]:
        if missing := missing_casadi():
            return NotCompiledError(missing), {}
        from ctrlplan.simulation.compiled import Compiled
        from ctrlplan.symbolic.tracing import NotTraceableError, callable_references, traced

        network = self.network
        if network is None:
            return NotCompiledError(self.unsupported), {}
        if not network.blocks:
            return NotCompiledError(f"{self.name} is without its blocks, compiled for other parameters"), {}
        traces: list[Trace | None] = []
        baked: dict[str, Any] = {}
        try:
            others = [block for block in network.blocks if not (block.linear or block.driven)]
            keeper = Keeper(callable_references(others, params))
            try:
                equations = Interpreted(network.for_trials(), params, (first, state), trials)
                w = equations.signals(first, state, signal_values(time_signals, np.array([first]))[:, 0])
            finally:
                keeper.restore()
            for block, states, fed in zip(network.blocks, network.states, network.fed, strict=True):
                if block.linear or block.driven:
                    traces.append(None)
                    continue
                trace = traced(block, params, first, state[states], fed(w))
                traces.append(trace)
                # What is a constant in the trace must be so in every run of it.
                baked |= {key: value_token(params[key]) for key in params if key not in trace.symbols}
            return Compiled(network, traces), baked
        except NotTraceableError as error:
            return NotCompiledError(str(error)), {key: value_token(value) for key, value in params.items()}

    def _blocks(self) -> tuple[Any, ...]:
        return self.network.blocks if self.network is not None else ()

    def __getstate__(self) -> dict[str, Any]:
        """Without python-control's objects, whose functions cannot be sent to another process."""
        usable = [entry for entry in self._compiled if not isinstance(entry[2], NotCompiledError)]
        if self.linear is None:
            special = any(block.delay is not None or block.period is not None for block in self._blocks())
            if not usable or special:
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
            "_compiled": usable,
            "_stated": self.stated,
        }


class _Noticing(dict[str, Any]):
    """Parameters that notice which of them are read."""

    ALL = ""

    def __init__(self, values: Mapping[str, Any], read: set[str]) -> None:
        super().__init__(values)
        self.read = read

    def __getitem__(self, key: str) -> Any:
        self.read.add(key)
        return super().__getitem__(key)

    def __contains__(self, key: object) -> bool:
        self.read.add(str(key))
        return super().__contains__(key)

    def get(self, key: str, default: Any = None) -> Any:
        self.read.add(key)
        return super().get(key, default)

    def __iter__(self) -> Iterator[str]:
        self.read.add(self.ALL)
        return super().__iter__()

    def keys(self) -> Any:
        self.read.add(self.ALL)
        return super().keys()

    def items(self) -> Any:
        self.read.add(self.ALL)
        return super().items()

    def values(self) -> Any:
        self.read.add(self.ALL)
        return super().values()


def prepare(system: Any) -> Prepared:
    """Built form of a system, for many runs.

    `simulate` takes it in the system's place; what it builds on the way
    (the linear form, the compiled one) is built once, whatever the values of
    parameters, plans on inputs and initial states.

    Parameters
    ----------
    system : control system
        As for `simulate`.

    Returns
    -------
    Prepared

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


def prepared_form(system: Any) -> Prepared:
    """Form built before of the same system, or a new one where its maps, parameters or blocks have changed."""
    if isinstance(system, Prepared):
        if system.original is None or fingerprint(system.original) == system.fingerprint:
            return system
        system = system.original
    _checked_system(system)
    key = fingerprint(system)
    return _FORMS.get(key, lambda: Prepared(system))


def stated_start(system: Any) -> Array | None:
    """State at which a system says that it starts, or its blocks do, the rest of them at 0; None where none does."""
    return _filled(stated_states(system))


def stated_states(system: Any) -> Array | None:
    """State at which a system or its blocks declare that they start, nan for those of other blocks."""
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


def state_space(system: Any) -> Any:
    """Same system with states, where it is a transfer function."""
    if not isinstance(system, ct.TransferFunction):
        return system
    return ct.ss(system, name=system.name, inputs=system.input_labels, outputs=system.output_labels)


def _filled(stated: Array | None) -> Array | None:
    """A stated start with 0 where nothing is stated."""
    return None if stated is None else np.where(np.isnan(stated), 0.0, stated)


def _checked_system(system: Any) -> Any:
    if not isinstance(system, ct.InputOutputSystem):
        raise TypeError(f"system must be a control system, got {type(system).__name__}")
    states = 0 if isinstance(system, ct.TransferFunction) else system.nstates
    sizes = {"states": states, "inputs": system.ninputs, "outputs": system.noutputs}
    unknown = [name for name, size in sizes.items() if size is None]
    if unknown:
        numbers = ", ".join(f"{name}=..." for name in unknown)
        raise ValueError(f"system must have a number of {unknown[0]}, got {system.name} without; give it {numbers}")
    return system


_FORMS: Lru[tuple[object, ...], Prepared] = Lru(_KEPT)


def _functions(system: Any) -> Iterator[Any]:
    """Functions of a block that are called with its parameters."""
    return filter(None, (system.outfcn, system.updfcn, traits_of(system).sample))
