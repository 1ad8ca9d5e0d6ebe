"""Interconnection as a flat list of blocks, each called once per step.

python-control calls every block several times to resolve static connections, at
every level of nesting. Here the connections of all levels are combined into one
matrix between the innermost blocks, and the order of evaluation follows from
their direct feedthrough. All signals form one vector: first the external inputs,
then the outputs of the blocks.
"""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import methodcaller

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ctrlplan._types import Array, BlockMap, Params, System, Value
from ctrlplan.symbolic.fingerprint import array_token, roots_of
from ctrlplan.symbolic.isolation import untouched
from ctrlplan.symbolic.references import References
from ctrlplan.symbolic.trials import can_remember, of_library, reads, trial_copy, values_of
from ctrlplan.traits import BlockFunction, BlockTraits, traits_of
from ctrlplan.trajectories import Trajectory

_TIME, _INPUT = 0, 2
"""Positions of time and input among the arguments (t, x, u, params) of a block's functions."""


class UnsupportedError(ValueError):
    """Only python-control can run a block; the message names it."""


@dataclass(frozen=True, eq=False)
class Block:
    """Innermost block, and its parameters before those of a run."""

    system: System
    params: Params

    @property
    def name(self) -> str:
        """Name of the block."""
        return str(self.system.name)

    @cached_property
    def traits(self) -> BlockTraits:
        """Declared traits of the block."""
        return traits_of(self.system)

    @property
    def linear(self) -> bool:
        """Whether the block is linear and time-invariant, a state-space model."""
        return isinstance(self.system, ct.StateSpace)

    @property
    def plan(self) -> Trajectory | None:
        """Plan of a source block; None for other blocks."""
        plan = self.traits.plan
        return plan if isinstance(plan, Trajectory) else None

    @property
    def delay(self) -> float | None:
        """Delay [s] of a delay block; None for other blocks."""
        return self.traits.delay

    @property
    def period(self) -> float | None:
        """Time between the samples of a discrete block in a continuous loop [s]."""
        return self.traits.period

    @property
    def changes_unseen(self) -> bool:
        """Whether the equations may switch at undeclared times, if they depend on time."""
        named = self.traits.breakpoints is not None or self.period is not None
        functions = (
            (self.system.outfcn, self.system.updfcn) if not (self.linear or self.is_time_function or named) else ()
        )
        return any(function is not None and not of_library(function) for function in functions)

    @property
    def depends_on_time(self) -> bool:
        """Whether a function of the block can read t, according to its code."""
        return any(f is not None and reads(f, _TIME) for f in (self.system.outfcn, self.system.updfcn))

    @property
    def held(self) -> System | None:
        """Discrete system whose held outputs are those of a sampled block; None for other blocks."""
        inner = self.traits.block if self.period is not None else None
        return inner if inner is not None and inner.noutputs == self.system.noutputs else None

    @property
    def holds(self) -> bool:
        """Whether the outputs of a discrete block in a continuous loop are constant between its sample times."""
        if self.period is None:
            return False
        if self.held is not None or self.system.outfcn is None:
            return True
        return not (can_remember(self.system) or reads(self.system.outfcn, _TIME) or reads(self.system.outfcn, _INPUT))

    @property
    def passes_steps(self) -> bool:
        """Whether the outputs are constant while the inputs are: delays, and blocks without states and time."""
        if self.delay is not None:
            return True
        plain = not (self.system.nstates or self.period is not None or self.plan is not None)
        return plain and (self.linear or not (self.depends_on_time or can_remember(self.system)))

    @property
    def is_time_function(self) -> bool:
        """Whether the outputs are functions of time only over a segment."""
        return self.plan is not None or self.delay is not None

    def output(self, params: Params) -> BlockMap:
        """Output function with the parameters of a run."""
        if self.linear:
            c, d = np.asarray(self.system.C, dtype=float), np.asarray(self.system.D, dtype=float)
            return lambda t, x, u: c @ x + d @ u
        out, own = self.system.outfcn, {**self.params, **params}
        if out is None:
            return lambda t, x, u: x
        return lambda t, x, u: out(t, x, u, own)

    def update(self, params: Params) -> BlockMap:
        """State derivatives of a continuous block, next states of a discrete one."""
        if self.linear:
            a, b = np.asarray(self.system.A, dtype=float), np.asarray(self.system.B, dtype=float)
            return lambda t, x, u: a @ x + b @ u
        update, own = self.system.updfcn, {**self.params, **params}
        if self.period is not None:
            return lambda t, x, u: np.zeros(len(x))
        return lambda t, x, u: update(t, x, u, own)

    def sampled(self, params: Params) -> tuple[BlockMap, BlockMap]:
        """Output and update functions of a discrete block in a continuous loop at a sample time.

        For a held system, the update returns its states only; the held outputs
        are appended to them.
        """
        sample, own = self.traits.sample, {**self.params, **params}
        inner = self.held
        if inner is not None:
            count = inner.nstates or 0
            if isinstance(inner, ct.StateSpace):
                a, b, c, d = (np.asarray(matrix, dtype=float) for matrix in (inner.A, inner.B, inner.C, inner.D))
                return lambda t, x, u: c @ x[:count] + d @ u, lambda t, x, u: a @ x[:count] + b @ u
            return (
                lambda t, x, u: np.ravel(inner.output(t, x[:count], u, own)),
                lambda t, x, u: np.ravel(inner.dynamics(t, x[:count], u, own)) if count else np.empty(0),
            )
        if sample is None:
            raise TypeError(f"block {self.name} must declare sample, the function evaluated at its sample times")
        sampled_once = _once(lambda t, x, u: sample(t, x, u, own))
        output = self.output(params)
        return (lambda t, x, u: output(t, sampled_once(t, x, u), u)), sampled_once


@dataclass(frozen=True)
class Step:
    """Blocks whose outputs are evaluated together.

    Attributes
    ----------
    blocks : tuple of int
        One block, or those of an algebraic loop.
    unknown : ndarray or None
        Indices of the signals of an algebraic loop.
    """

    blocks: tuple[int, ...]
    unknown: NDArray[np.intp] | None = None


@dataclass(frozen=True, eq=False)
class WatchedSignal:
    """Signal with limits that a block declares: a function of its (t, x, u, params), time last."""

    name: str
    function: BlockFunction
    low: float
    high: float
    states: slice
    fed: Callable[[Array], Array]
    params: Params


@dataclass(frozen=True, eq=False)
class Network:
    """Innermost blocks and their connections.

    Attributes
    ----------
    name : str
        Name of the system.
    blocks : tuple of Block
        In the order of the states in python-control.
    wire : ndarray, shape (inputs of all blocks, nsignals)
        Matrix from all signals to the inputs of the blocks.
    read : ndarray, shape (noutputs, nsignals)
        Matrix from all signals to the outputs of the system.
    ninputs : int
        Number of external inputs, the first of the signals.
    breakpoints : tuple of float
        Declared times [s] at which the equations of blocks change.
    watched : tuple of WatchedSignal
        Signals with limits that blocks declare.
    """

    name: str
    blocks: tuple[Block, ...]
    wire: Array
    read: Array
    ninputs: int
    breakpoints: tuple[float, ...] = ()
    watched: tuple[WatchedSignal, ...] = ()

    @classmethod
    def of(cls, system: System) -> Network:
        """Network of a system with any nesting.

        Raises
        ------
        UnsupportedError
            If a block overrides the equations of its class.
        """
        part = _flattened(system, {})
        _warn_of_shared_parameters(system)
        network = cls(
            str(system.name),
            tuple(part.blocks),
            np.hstack([part.outer, part.inner]),
            np.hstack([part.through, part.read]),
            system.ninputs or 0,
            tuple(t for b in part.blocks for t in b.traits.breakpoints or ()),
        )
        return replace(network, watched=tuple(network._watched_signals()))

    def for_trials(self) -> Network:
        """Same network for trial calls, with copies of blocks that have memory."""
        if not any(self.remember):
            return self
        pairs = zip(self.blocks, self.remember, strict=True)
        return replace(self, blocks=tuple(replace(b, system=trial_copy(b.system)) if r else b for b, r in pairs))

    def without_blocks(self) -> Network:
        """Network for runs of a compiled form, without functions that cannot be pickled."""
        watched = tuple(w for w in self.watched if _can_be_sent(w))
        return Network(self.name, (), self.wire[:0], self.read, self.ninputs, self.breakpoints, watched)

    @cached_property
    def remember(self) -> list[bool]:
        """Whether each block may have memory in addition to its state."""
        return [not block.linear and can_remember(block.system) for block in self.blocks]

    @cached_property
    def states(self) -> list[slice]:
        """Indices of the states of each block."""
        return _slices([b.system.nstates or 0 for b in self.blocks], 0)

    @cached_property
    def moving(self) -> NDArray[np.intp]:
        """Indices of the states that are integrated: those of blocks that are not sampled."""
        parts = [
            np.arange(place.start, place.stop)
            for block, place in zip(self.blocks, self.states, strict=True)
            if block.period is None
        ]
        return np.concatenate([np.zeros(0, dtype=np.intp), *parts])

    @cached_property
    def inputs(self) -> list[slice]:
        """Indices of the inputs of each block among the rows of `wire`."""
        return _slices([b.system.ninputs or 0 for b in self.blocks], 0)

    @cached_property
    def outputs(self) -> list[slice]:
        """Indices of the outputs of each block among the signals."""
        return _slices([b.system.noutputs for b in self.blocks], self.ninputs)

    @cached_property
    def fed(self) -> list[Callable[[Array], Array]]:
        """Maps of all signals, time last, to the inputs of each block."""
        return [_product(self.wire[rows]) for rows in self.inputs]

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """Which signals are constant between the sample times of discrete blocks, and these times after delays.

        They depend on what these blocks hold only, through blocks without states and delays if there are any.
        """
        if not any(block.holds for block in self.blocks):
            return np.zeros(self.nsignals, dtype=np.bool_)
        return self._steady

    @cached_property
    def _steady(self) -> NDArray[np.bool_]:
        """The same, and constants of blocks without inputs in a loop without discrete blocks."""
        held = np.zeros(self.nsignals, dtype=np.bool_)
        for block, place in zip(self.blocks, self.outputs, strict=True):
            held[place] = block.holds
        changed = True
        while changed:
            changed = False
            for block, rows, place in zip(self.blocks, self.inputs, self.outputs, strict=True):
                if block.passes_steps and not held[place].all() and not self.wire[rows][:, ~held].any():
                    held[place], changed = True, True
        return held

    @cached_property
    def held_outputs(self) -> NDArray[np.intp]:
        """Indices of the outputs of the system that depend on held signals only."""
        return np.flatnonzero(~self.read[:, ~self.held].any(axis=1) & self.read.any(axis=1))

    def is_held(self, i: int) -> bool:
        """Whether all inputs of a block are held signals or constants."""
        return not self.wire[self.inputs[i]][:, ~self._steady].any()

    @cached_property
    def to_outputs(self) -> Callable[[Array], Array]:
        """Map of all signals, time last, to the outputs of the system."""
        return _product(self.read)

    @property
    def nstates(self) -> int:
        """Number of states of all blocks."""
        return self.states[-1].stop

    @property
    def nsignals(self) -> int:
        """Number of signals: external inputs and outputs of all blocks."""
        return self.wire.shape[1]

    @cached_property
    def time_rows(self) -> NDArray[np.intp]:
        """Indices of signals that are functions of time only over a segment: inputs, plans, delayed signals."""
        rows = [np.arange(self.ninputs)]
        rows += [
            np.arange(place.start, place.stop)
            for block, place in zip(self.blocks, self.outputs, strict=True)
            if block.is_time_function
        ]
        return np.concatenate(rows)

    def blocks_with(self, kind: str) -> list[int]:
        """Indices of the blocks of a kind: those with a period, a delay, ..."""
        return [i for i, block in enumerate(self.blocks) if getattr(block, kind) is not None]

    def schedule(self, feeds: Sequence[NDArray[np.bool_]], needed: NDArray[np.bool_]) -> list[Step]:
        """Order in which the required signals are evaluated.

        Parameters
        ----------
        feeds : sequence of ndarray of bool, shape (noutputs, ninputs)
            Direct feedthrough of each block.
        needed : ndarray of bool, shape (nsignals,)
            Required signals.

        Returns
        -------
        list of Step
            A block may appear twice. The signals of an algebraic loop are one
            step.
        """
        known = np.zeros(self.nsignals, dtype=bool)
        known[self.time_rows] = True
        feeds_on = _dependencies(self, feeds)
        required = _reached(feeds_on, needed)
        steps: list[Step] = []
        while not known[required].all():
            ready = ~known & required & np.all(~feeds_on | known, axis=1)
            if ready.any():
                for i, place in enumerate(self.outputs):
                    if ready[place].any():
                        steps.append(Step((i,)))
                known |= ready
                continue
            rows = _first_loop(feeds_on, ~known & required)
            steps.append(Step(self._owners(rows), rows))
            known[rows] = True
        return steps

    def delays_feed_delays(self, feeds: Sequence[NDArray[np.bool_]]) -> bool:
        """Whether the output of a delay reaches a delay by direct feedthrough: jumps then recur without end."""
        depends, delays = _dependencies(self, feeds), self.blocks_with("delay")
        if not delays:
            return False
        needed = np.any([np.any(self.wire[self.inputs[i]] != 0.0, axis=0) for i in delays], axis=0)
        reached = _reached(depends, needed)
        return any(reached[self.outputs[i]].any() for i in delays)

    def signals_of_inputs(self) -> NDArray[np.bool_]:
        """Which signals are inputs of a block."""
        return np.any(self.wire != 0.0, axis=0)

    def names(self, blocks: Sequence[int]) -> str:
        """Names of blocks, separated by commas."""
        return ", ".join(self.blocks[i].name for i in blocks)

    def _watched_signals(self) -> Iterator[WatchedSignal]:
        for block, states, fed in zip(self.blocks, self.states, self.fed, strict=True):
            for name, (function, low, high) in (block.traits.watched or {}).items():
                yield WatchedSignal(name, function, low, high, states, fed, block.params)

    def _owners(self, rows: NDArray[np.intp]) -> tuple[int, ...]:
        return tuple(i for i, place in enumerate(self.outputs) if np.any((rows >= place.start) & (rows < place.stop)))


def structure(block: Block, params: Params) -> tuple[object, ...] | None:
    """What the compiled equations of a block depend on, by value; None if that is unknown.

    Parameters
    ----------
    block : Block
        The block.
    params : mapping
        Parameters of a run.
    """
    system = block.system
    sizes = system.nstates or 0, system.ninputs or 0, system.noutputs
    if block.linear:
        return sizes, *(array_token(matrix) for matrix in (system.A, system.B, system.C, system.D))
    if block.is_time_function:
        return sizes, "delay" if block.delay is not None else "plan"
    found = References([*roots_of(system), ("params", {**block.params, **params})])
    unknown = found.opaque or block.period is not None or block.traits.block is not None
    return None if unknown else (sizes, block.changes_unseen, found.tokens, found.cached)


def known_feedthrough(block: Block) -> NDArray[np.bool_] | None:
    """Direct feedthrough (noutputs, ninputs) of a block; None if it is not known.

    It is known for linear blocks by their matrix D, and for others that declare
    it, output their states, or do not read their input in the output function.
    """
    shape = (block.system.noutputs, block.system.ninputs or 0)
    if block.linear:
        return np.asarray(block.system.D) != 0.0
    if block.is_time_function or block.system.outfcn is None:
        return np.zeros(shape, dtype=bool)
    declared = block.traits.feedthrough
    if declared is None:
        return None if reads(block.system.outfcn, _INPUT) else np.zeros(shape, dtype=bool)
    return np.broadcast_to(np.asarray(declared, dtype=bool), shape)


def sampled_feedthrough(block: Block) -> NDArray[np.bool_] | None:
    """The same for a sampled block at a sample time."""
    inner = block.held
    if inner is None or isinstance(inner, ct.InterconnectedSystem):
        return None
    return known_feedthrough(Block(inner, block.params))


def tried_feedthrough(output: BlockMap, noutputs: int, nin: int, t: float, x: Array) -> NDArray[np.bool_]:
    """Direct feedthrough by trial calls near a time and a state; True for inputs without a valid trial."""
    found = np.zeros((noutputs, nin), dtype=bool)
    known = np.zeros(nin, dtype=bool)
    rng = np.random.default_rng(1)
    with untouched():
        for scale in (0.0, 1.0, 1e3):
            u = scale * rng.standard_normal(nin)
            state = x + (0.1 * rng.standard_normal(x.size) if scale else 0.0)
            before = values_of(output, t, state, u)
            if before is None:
                continue
            for j in range(nin):
                for step in (1e-3, 1.0, 1e3):
                    moved = u.copy()
                    moved[j] += step
                    after = values_of(output, t, state.copy(), moved)
                    if after is not None and after.shape == before.shape == (noutputs,):
                        known[j] = True
                        found[:, j] |= (after != before) & ~(np.isnan(after) & np.isnan(before))
    return found | ~known


def _once(sample: BlockMap) -> BlockMap:
    """Sample function that is evaluated once for equal arguments, for the states and for the outputs after it."""
    last: tuple[object, Array] = (None, np.empty(0))

    def sampled_once(t: float, x: Array, u: Array) -> Array:
        nonlocal last
        arguments = t, x.tobytes(), u.tobytes()
        if arguments != last[0]:
            last = arguments, np.ravel(sample(t, x, u))
        return last[1].copy()

    return sampled_once


@dataclass(frozen=True)
class _Part:
    """Blocks of one level; their inputs are inner @ their outputs + outer @ inputs of the level."""

    blocks: list[Block]
    inner: Array
    outer: Array
    read: Array  # outputs of the level from the blocks' outputs
    through: Array  # outputs of the level from inputs of the level


def _flattened(system: System, above: Params) -> _Part:
    if not isinstance(system, ct.InterconnectedSystem):
        return _innermost(system, above)
    # In python-control the parameters of a level override those inside it.
    params = {**system.params, **above}
    parts = [_flattened(block, params) for block in system.syslist]
    inner, outer, read, through = (
        _block_diagonal([getattr(p, name) for p in parts]) for name in ("inner", "outer", "read", "through")
    )
    connect = np.asarray(system.connect_map, dtype=float)
    external = np.asarray(system.input_map, dtype=float).reshape(len(connect), system.ninputs or 0)
    outputs = np.asarray(system.output_map, dtype=float)
    from_out, from_in = outputs[:, : len(read)], outputs[:, len(read) :]
    # Inputs of the parts: v = connect @ (read @ y + through @ v) + external @ r.
    wires = np.eye(len(connect)) - connect @ through
    if wires.size and np.linalg.matrix_rank(wires) < len(wires):  # numpy 1.26 has no rank of an empty matrix
        raise ValueError(f"connections must not form a loop without a block, got one in {system.name}")
    v_y, v_r = np.linalg.solve(wires, connect @ read), np.linalg.solve(wires, external)
    passed = from_out @ through + from_in
    return _Part(
        [block for part in parts for block in part.blocks],
        inner + outer @ v_y,
        outer @ v_r,
        from_out @ read + passed @ v_y,
        passed @ v_r,
    )


def _block_diagonal(matrices: Sequence[Array]) -> Array:
    """Block-diagonal matrix; that of scipy takes most of the time of a network of small blocks."""
    found = np.zeros((sum(len(m) for m in matrices), sum(m.shape[1] for m in matrices)))
    row = column = 0
    for m in matrices:
        found[row : row + len(m), column : column + m.shape[1]] = m
        row, column = row + len(m), column + m.shape[1]
    return found


def _innermost(system: System, above: Params) -> _Part:
    if isinstance(system, ct.TransferFunction):
        system = ct.ss(system)
    plain = isinstance(system, ct.NonlinearIOSystem) and all(
        getattr(type(system), name) is getattr(ct.NonlinearIOSystem, name) for name in ("_rhs", "_out")
    )
    if not (plain or isinstance(system, ct.StateSpace)):
        raise UnsupportedError(f"block {system.name} ({type(system).__name__}) overrides the equations of its class")
    nin, nout = system.ninputs or 0, system.noutputs
    block = Block(system, {**system.params, **above})
    return _Part([block], np.zeros((nin, nout)), np.eye(nin), np.eye(nout), np.zeros((nout, nin)))


def _warn_of_shared_parameters(system: System) -> None:
    """Warn of blocks with a common key: python-control uses the value of the last for all, and so does this package."""
    if not isinstance(system, ct.InterconnectedSystem):
        return
    seen: dict[str, tuple[str, Value]] = {}
    for block in system.syslist:
        _warn_of_shared_parameters(block)
        for key, value in block.params.items():
            name, before = seen.setdefault(key, (block.name, value))
            if not np.array_equal(before, value):
                warnings.warn(
                    f"blocks {name} and {block.name} both have a parameter {key!r}, {before!r} and {value!r}: "
                    f"inside {system.name} python-control gives both {system.params.get(key, value)!r}; "
                    "use different keys",
                    UserWarning,
                    stacklevel=2,
                )


def _product(matrix: Array) -> Callable[[Array], Array]:
    """Product with a matrix in which 0 times nan is 0: a nan affects only what depends on it."""
    rows, columns = np.nonzero(matrix)
    if np.array_equal(rows, np.arange(len(matrix))) and np.all(matrix[rows, columns] == 1.0):
        return methodcaller("take", columns, 0)
    return partial(_multiplied, csr_array(matrix))


def _multiplied(matrix: csr_array, signals: Array) -> Array:
    return np.asarray(matrix @ signals)


def _slices(counts: Sequence[int], first: int) -> list[slice]:
    ends = (first + np.cumsum(counts)).tolist()
    return [slice(end - n, end) for n, end in zip(counts, ends, strict=True)]


def _dependencies(network: Network, feeds: Sequence[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Direct feedthrough between signals, (nsignals, nsignals)."""
    depends = np.zeros((network.nsignals, network.nsignals), dtype=bool)
    for feed, rows, columns in zip(feeds, network.outputs, network.inputs, strict=True):
        depends[rows] = feed.astype(int) @ (network.wire[columns] != 0.0).astype(int) > 0
    return depends


def _reached(depends: NDArray[np.bool_], needed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Required signals, and those they depend on."""
    required = needed.copy()
    while True:
        more = required | depends[required].any(axis=0)
        if (more == required).all():
            return required
        required = more


def _first_loop(depends: NDArray[np.bool_], open_: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Strongly connected open signals that depend on no other open signal."""
    rows = np.flatnonzero(open_)
    among = depends[np.ix_(rows, rows)]
    count, group = connected_components(among, directed=True, connection="strong")
    for k in range(count):
        members = group == k
        if not among[np.ix_(members, ~members)].any():
            return rows[members]
    raise AssertionError("a finite graph has a strongly connected component that depends on no other")


def _can_be_sent(what: object) -> bool:
    try:
        pickle.dumps(what)
    except Exception:  # any error of pickle with a user's function
        return False
    return True
