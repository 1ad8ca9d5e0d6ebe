"""Linear loops with discrete blocks and delays: flow between sample times, and jumps at them.

The states z are those of the loop in the order of python-control, then those of
the registers that replace delays; x are the states of continuous blocks among them,
w the functions of time (inputs, sources, delayed inputs and sources):

x' = A z + B w between instants,  z+ = J z + K w at an instant,  s = S z + R w (all signals)

An instant is a time at which discrete blocks are sampled; J and K depend on the
blocks that are due. A delay of what discrete blocks hold is a shift register with
their period. A delay of a continuous signal that only discrete blocks read is a
register that samples the signal the delay before they do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from math import floor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ctrlplan._lru import Lru
from ctrlplan._types import Array
from ctrlplan.simulation.exact import state_scale
from ctrlplan.simulation.linear import LinearForm, NotLinearError, closed, linear_forms, singular_loop
from ctrlplan.simulation.network import Block, Network
from ctrlplan.simulation.segments import as_fraction

if TYPE_CHECKING:
    from ctrlplan.simulation.collocation import Collocation
    from ctrlplan.simulation.hop_cells import HopCells
    from ctrlplan.simulation.schedule import Schedule

Timing = tuple[Fraction, Fraction]
"""Period and offset [s]: sample times are offset, offset + period, ... after the start of a run."""

_SHORT = 16
"""Number of samples up to which a register is part of the states."""

_TIMINGS = 62
"""Maximum number of different periods and offsets, one bit each."""

_SCHEDULES = 2
"""Number of runs of different start or end whose steps are kept."""

_SAME = 1e-14
"""Difference of a delay from whole periods, relative to both, that is rounding."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """Discrete part of a loop: xi+ = a xi + b u, held h+ = c xi + d u, with inputs u = from_z z + from_w w.

    Attributes
    ----------
    name : str
        Name of the block.
    timing : (Fraction, Fraction)
        Period and offset.
    a, b, c, d : ndarray
        The matrices.
    states, held : ndarray of int
        Places of xi and h among z.
    from_z, from_w : ndarray
        Inputs from z, with the new values of what is sampled at the same time, and from w.
    """

    name: str
    timing: Timing
    a: Array
    b: Array
    c: Array
    d: Array
    states: NDArray[np.intp]
    held: NDArray[np.intp]
    from_z: Array
    from_w: Array


@dataclass(frozen=True, eq=False)
class Line:
    """Register of many samples, outside of the states.

    Attributes
    ----------
    columns : slice
        Places of what it returns among w, after the functions of time.
    timing : (Fraction, Fraction)
        Period and offset.
    count : int
        Number of samples.
    initial : ndarray, shape (width,)
        What it returns before the first sample.
    from_z, from_w : ndarray
        Its inputs.
    """

    columns: slice
    timing: Timing
    count: int
    initial: Array
    from_z: Array
    from_w: Array


@dataclass(frozen=True, eq=False)
class Late:
    """Delay of a loop.

    Attributes
    ----------
    columns : slice
        Its outputs among w, without what registers hold.
    delay : float
        Delay [s].
    initial : ndarray, shape (width,)
        Outputs until the first input has passed.
    from_z, from_w : ndarray, shapes (width, nz) and (width, nw)
        Its inputs.
    follows : bool
        Whether its inputs depend on states of continuous blocks: its outputs are then evaluated after the run.
    firsts : list of (Fraction, ndarray)
        Offset of each sampled part that feeds it, and the inputs (width, nz) from what that holds.
    """

    columns: slice
    delay: float
    initial: Array
    from_z: Array
    from_w: Array
    follows: bool
    firsts: tuple[tuple[Fraction, Array], ...]


@dataclass(frozen=True, eq=False)
class SampledForm:
    """Flow, jumps and signals of a linear loop with discrete blocks and delays.

    Attributes
    ----------
    name : str
        Name of the loop.
    nstates : int
        Number of states of the loop, the first of z.
    moving : ndarray of int
        Places of x among z.
    a, b : ndarray, shapes (nx, nz) and (nx, nw)
        The flow.
    signals_z, signals_w : ndarray, shapes (nsignals, nz) and (nsignals, nw)
        All signals of the network.
    read : ndarray, shape (noutputs, nsignals)
        Outputs of the loop from its signals.
    parts : tuple of Sampled
        Discrete blocks and registers.
    lates : tuple of Late
        Delays.
    registers : ndarray, shape (nz - nstates,)
        Initial states of the registers.
    lines : tuple of Line
        Registers of many samples. What they return follows the functions of time in w at an instant.
    schedules : Lru
        Steps of the last runs, by their start and end [s].
    """

    name: str
    nstates: int
    moving: NDArray[np.intp]
    a: Array
    b: Array
    signals_z: Array
    signals_w: Array
    read: Array
    parts: tuple[Sampled, ...]
    lates: tuple[Late, ...]
    registers: Array
    lines: tuple[Line, ...] = ()
    schedules: Lru[tuple[float, float], Schedule] = field(default_factory=lambda: Lru(_SCHEDULES), init=False)
    _jumps: dict[int, tuple[Array, Array]] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def timings(self) -> list[Timing]:
        """Different timings of the sampled parts."""
        return sorted({part.timing for part in self.parts})

    @cached_property
    def c(self) -> Array:
        """Outputs (noutputs, nz) of the loop from z."""
        return np.asarray(self.read @ self.signals_z)

    @cached_property
    def d(self) -> Array:
        """Outputs (noutputs, nw) of the loop from w."""
        return np.asarray(self.read @ self.signals_w)

    def perturbed(self, amount: float) -> SampledForm:
        """Form with the entries of its matrices changed by a relative amount, with random signs."""
        rng = np.random.default_rng(0)

        def near(matrix: Array) -> Array:
            return matrix * (1.0 + amount * rng.choice([-1.0, 1.0], matrix.shape))

        parts = [replace(p, a=near(p.a), b=near(p.b), c=near(p.c), d=near(p.d)) for p in self.parts]
        return replace(self, a=near(self.a), b=near(self.b), parts=tuple(parts))

    def jump(self, due: int) -> tuple[Array, Array]:
        """Matrices J and K of an instant at which the timings with these bits are due.

        Raises
        ------
        ValueError
            If the parts that are due form an algebraic loop without a solution.
        """
        if due not in self._jumps:
            self._jumps[due] = self._new_jump(due)
        return self._jumps[due]

    def _new_jump(self, due: int) -> tuple[Array, Array]:
        size = self.signals_z.shape[1]
        nw = max([self.signals_w.shape[1], *(line.columns.stop for line in self.lines)])
        chosen = [part for part in self.parts if due >> self.timings.index(part.timing) & 1]
        held = np.concatenate([np.zeros(0, dtype=np.intp), *(part.held for part in chosen)])
        # h+ = C xi + D (from_z z+ + from_w w), where z+ has the new h of all parts that are due.
        through = np.concatenate([np.zeros((0, size)), *(part.d @ part.from_z for part in chosen)])
        known = np.zeros((held.size, size + nw))
        known[:, :size] = through
        known[:, held] = 0.0
        known[:, size:] = np.concatenate([np.zeros((0, nw)), *(part.d @ part.from_w for part in chosen)])
        ends = np.cumsum([part.held.size for part in chosen], dtype=int)
        for part, end in zip(chosen, ends.tolist(), strict=True):
            known[end - part.held.size : end, part.states] += part.c
        closing = np.eye(held.size) - through[:, held]
        singular = singular_loop(closing[None])
        if singular.size:
            owners = np.repeat([part.name for part in chosen], [part.held.size for part in chosen])
            blocks = ", ".join(dict.fromkeys(owners[singular].tolist()))
            raise ValueError(
                f"blocks must not form an algebraic loop without a solution, got one of {blocks} at their common "
                "sample times; give one of them another offset, or a state between input and output"
            )
        after = np.eye(size, size + nw)
        after[held] = np.linalg.solve(closing, known)
        jump = after.copy()
        for part in chosen:
            inputs = part.from_z @ after
            inputs[:, size:] += part.from_w
            jump[part.states] = part.b @ inputs
            jump[np.ix_(part.states, part.states)] += part.a
        return jump[:, :size], jump[:, size:]


def sampled_form(network: Network) -> SampledForm:
    """Sampled form of a network.

    Raises
    ------
    NotLinearError
        If a block is nonlinear, or a delay feeds back continuously; the message names it.
    ValueError
        If blocks form an algebraic loop without a solution.
    """
    found = _Delays(network, *_without_delays(network)).replaced()
    if len(found.timings) > _TIMINGS:
        raise NotLinearError(f"its blocks have more than {_TIMINGS} different periods and offsets")
    return found


def _without_delays(network: Network) -> tuple[SampledForm, Array, Array]:
    """Form with delayed signals as functions of time, and the inputs of all blocks from z and from w."""
    inner = [_inner(block) for block in network.blocks]
    flow = _flow(network, inner)
    n, ny, moving = network.nstates, network.nsignals - network.ninputs, network.moving
    form = SampledForm(
        network.name,
        n,
        moving,
        flow.a[moving],
        flow.b[moving],
        np.concatenate([np.zeros((network.ninputs, n)), flow.c[:ny]]),
        np.concatenate([np.eye(network.ninputs, flow.b.shape[1]), flow.d[:ny]]),
        network.read,
        tuple(_network_parts(network, inner, flow.c[ny:], flow.d[ny:])),
        (),
        np.zeros(0),
    )
    return form, flow.c[ny:], flow.d[ny:]


@dataclass(frozen=True, eq=False)
class DelayedForm:
    """Linear loop with delays between continuous blocks: x' = a x + b w; w: inputs, sources and delayed signals.

    Attributes
    ----------
    base : SampledForm
        The loop with delayed signals as functions of time.
    a, b : ndarray, shapes (n, n) and (n, nw)
        The flow of all states.
    lates : tuple of Late
        Delays; at least one.
    marks, cells : Lru
        Times at which the signals of the last runs are not smooth, and cells between them.
    """

    base: SampledForm
    a: Array
    b: Array
    lates: tuple[Late, ...]
    marks: Lru[tuple[object, ...], Array | None] = field(default_factory=lambda: Lru(_SCHEDULES), init=False)
    cells: Lru[tuple[object, ...], HopCells] = field(default_factory=lambda: Lru(_SCHEDULES), init=False)

    @cached_property
    def delayed(self) -> NDArray[np.intp]:
        """Places of the outputs of delays among w."""
        return np.concatenate([np.arange(late.columns.start, late.columns.stop) for late in self.lates])

    @cached_property
    def given(self) -> NDArray[np.intp]:
        """Places of the other functions of time among w."""
        return np.setdiff1d(np.arange(self.b.shape[1]), self.delayed)

    @cached_property
    def rows(self) -> list[slice]:
        """Places of each delay among the outputs of delays."""
        ends = np.cumsum([0, *(late.initial.size for late in self.lates)]).tolist()
        return [slice(begin, end) for begin, end in pairwise(ends)]

    @cached_property
    def collocation(self) -> Collocation:
        """Maps of parts of a run."""
        from ctrlplan.simulation.collocation import Collocation

        columns = np.concatenate([self.delayed, self.given])
        from_z, from_w = (
            np.concatenate(rows) for rows in zip(*((x.from_z, x.from_w) for x in self.lates), strict=True)
        )
        return Collocation(self.a, self.b[:, columns], from_z, from_w[:, columns])

    @cached_property
    def norm(self) -> float:
        """Bound of the rate of the loop [1/s], with the gains of its delays."""
        moving = self.base.moving
        inner, scale = self.a[np.ix_(moving, moving)], state_scale(self.a[np.ix_(moving, moving)])
        total = np.abs(inner) * (scale / scale[:, None])
        for late in self.lates:
            gains = np.abs(self.b[moving][:, late.columns]) @ np.abs(late.from_z[:, moving])
            total = total + gains * (scale / scale[:, None])
        return float(total.sum(axis=0).max(initial=0.0))


def delayed_form(network: Network) -> DelayedForm:
    """Form of a linear network with delays between continuous blocks.

    Raises
    ------
    NotLinearError
        If a block is nonlinear; the message names it.
    ValueError
        If blocks form an algebraic loop without a solution.
    """
    base, from_z, from_w = _without_delays(network)
    columns, lates = dict(_time_columns(network)), []
    for i in network.blocks_with("delay"):
        block, rows = network.blocks[i], network.inputs[i]
        initial = np.broadcast_to(np.asarray(block.traits.initial, dtype=float), (rows.stop - rows.start,))
        lates.append(Late(columns[i], float(block.delay or 0.0), initial, from_z[rows], from_w[rows], True, ()))
    n = base.nstates
    a, b = np.zeros((n, n)), np.zeros((n, base.b.shape[1]))
    a[base.moving], b[base.moving] = base.a, base.b
    return DelayedForm(base, a, b, tuple(lates))


def _inner(block: Block) -> LinearForm | None:
    """Matrices of a discrete block; None for other blocks."""
    if block.linear or block.is_time_function:
        return None
    if block.held is None:
        what = ", which is sampled," if block.period is not None else f" ({type(block.system).__name__})"
        raise NotLinearError(f"block {block.name}{what} is not linear")
    if block.traits.samples_first:
        raise NotLinearError(f"block {block.name} is sampled before others with the same sample time")
    try:
        found = linear_forms([block.held], discrete=True)
    except NotLinearError:
        raise NotLinearError(f"block {block.name}, which is sampled, is not linear") from None
    if found.sources:
        raise NotLinearError(f"block {block.name}, which is sampled, has a plan inside")
    return LinearForm(found.a[0], found.b[0], found.c[0], found.d[0], ())


def _flow(network: Network, inner: Sequence[LinearForm | None]) -> LinearForm:
    """Flow between instants; its outputs are the outputs, then the inputs of all blocks."""
    forms, counts = [], [block.system.ninputs or 0 for block in network.blocks]
    for block, own in zip(network.blocks, inner, strict=True):
        nout, nin = block.system.noutputs, block.system.ninputs or 0
        if block.linear:
            forms.append(linear_forms([block.system], discrete=True))
        elif own is None:  # a function of time, as an input of its own; a delay does not read its input in the flow
            none = np.zeros((1, 0, 0)), np.zeros((1, 0, nin + nout)), np.zeros((1, nout, 0))
            forms.append(LinearForm(*none, np.eye(nout, nin + nout, nin)[None], ()))
        else:  # what is held is the last of the states
            n = len(own.a) + nout
            forms.append(
                LinearForm(
                    np.zeros((1, n, n)),
                    np.zeros((1, n, nin)),
                    np.eye(nout, n, len(own.a))[None],
                    np.zeros((1, nout, nin)),
                    (),
                )
            )
    connect, external = network.wire[:, network.ninputs :], network.wire[:, : network.ninputs]
    names = [block.name for block in network.blocks]
    found = closed(forms, counts, names, connect, external, np.eye(sum(connect.shape)), network.name)
    return LinearForm(found.a[0], found.b[0], found.c[0], found.d[0], ())


def _network_parts(
    network: Network, inner: Sequence[LinearForm | None], from_z: Array, from_w: Array
) -> Iterator[Sampled]:
    """Discrete blocks of a network."""
    for block, own, place, rows in zip(network.blocks, inner, network.states, network.inputs, strict=True):
        if own is None:
            continue
        timing = as_fraction(block.period or 0.0), as_fraction(block.traits.offset)
        split = place.start + len(own.a)
        states, held = np.arange(place.start, split), np.arange(split, place.stop)
        yield Sampled(block.name, timing, own.a, own.b, own.c, own.d, states, held, from_z[rows], from_w[rows])


class _Delays:
    """Delays of a loop, replaced by registers one after the other."""

    def __init__(self, network: Network, form: SampledForm, from_z: Array, from_w: Array) -> None:
        self._network, self._form = network, form
        self._blocks = network.blocks_with("delay")
        self._from = {i: (from_z[network.inputs[i]], from_w[network.inputs[i]]) for i in self._blocks}
        self._columns = dict(_time_columns(network))
        self._parts, self._lates = list(form.parts), list[Late]()
        self._initial: list[Array] = []
        self._size, self._returned, self._lines = form.nstates, 0, list[Line]()
        self._held: dict[int, Array] = {}  # outputs of a delay from what its registers hold

    def replaced(self) -> SampledForm:
        """Form with registers in place of the delays."""
        for i in self._in_order():
            self._replace(i)
        form, size, nw = self._form, self._size, self._form.signals_w.shape[1] + self._returned
        parts = [replace(p, from_z=_wide(p.from_z, size), from_w=_wide(p.from_w, nw)) for p in self._parts]
        lines = [replace(line, from_z=_wide(line.from_z, size)) for line in self._lines]
        a, signals = _wide(form.a, size), _wide(form.signals_z, size)
        for i, held in self._held.items():
            columns, own = self._columns[i], _wide(held, size)
            a = a + form.b[:, columns] @ own
            signals = signals + form.signals_w[:, columns] @ own
            for k, part in enumerate(parts):
                parts[k] = replace(part, from_z=part.from_z + part.from_w[:, columns] @ own)
            for k, line in enumerate(lines):
                lines[k] = replace(line, from_z=line.from_z + line.from_w[:, columns] @ own)
        lates = [
            replace(
                late,
                from_z=_wide(late.from_z, size),
                firsts=tuple((offset, _wide(own, size)) for offset, own in late.firsts),
            )
            for late in self._lates
        ]
        return replace(
            form,
            a=a,
            signals_z=signals,
            parts=tuple(parts),
            lates=tuple(lates),
            lines=tuple(lines),
            registers=np.concatenate([np.zeros(0), *self._initial]),
        )

    def _in_order(self) -> list[int]:
        """Delays, each after those whose outputs it reads by direct feedthrough."""
        left, found = list(self._blocks), list[int]()
        while left:
            ready = [i for i in left if not any(self._from[i][1][:, self._columns[j]].any() for j in left)]
            if not ready:
                raise NotLinearError(f"delays {self._network.names(left)} feed back without a sampled block in between")
            found += ready
            left = [i for i in left if i not in ready]
        return found

    def _replace(self, i: int) -> None:
        block, columns = self._network.blocks[i], self._columns[i]
        from_z, from_w = self._from[i]
        from_z = _wide(from_z, self._size)
        for j, held in self._held.items():
            from_z = from_z + from_w[:, self._columns[j]] @ _wide(held, self._size)
        width = len(from_z)
        initial = np.broadcast_to(np.asarray(block.traits.initial, dtype=float), (width,))
        follows = bool(from_z[:, self._form.moving].any())
        firsts: list[tuple[Fraction, Array]] = []
        if follows:
            self._latches(i, _wide(self._from[i][0], self._size), from_w, initial)
        else:
            held, feeding = np.zeros((width, self._size)), tuple(self._parts)  # without the registers of this delay
            for timing in sorted({part.timing for part in feeding}):
                places = np.concatenate([part.held for part in feeding if part.timing == timing])
                own = np.zeros_like(from_z)
                own[:, places] = from_z[:, places]
                if own.any():
                    firsts.append((timing[1], own))
                    whole, rest = _split(block.delay or 0.0, timing[0])
                    made = self._register(
                        i, (timing[0], timing[1] + rest), whole, own, np.zeros_like(from_w), 0.0 * initial
                    )
                    held = _wide(held, self._size)
                    held[:, made] += np.eye(width)
            self._held[i] = held
        self._lates.append(Late(columns, float(block.delay or 0.0), initial, from_z, from_w, follows, tuple(firsts)))

    def _latches(self, i: int, from_z: Array, from_w: Array, initial: Array) -> None:
        """Registers that sample a continuous signal a delay before the discrete blocks that read it."""
        block, columns = self._network.blocks[i], self._columns[i]
        others = [own[1][:, columns] for j, own in self._from.items() if j != i]
        if self._form.b[:, columns].any() or any(own.any() for own in others):
            raise NotLinearError(f"block {block.name} is a delay of a continuous signal for continuous blocks")
        readers = [part for part in self._parts if part.from_w[:, columns].any()]
        for timing in sorted({part.timing for part in readers}):
            period, offset = timing
            whole, rest = _split(block.delay or 0.0, period)
            made = self._register(i, (period, (offset - rest) % period), whole, from_z, from_w, initial)
            for k, part in enumerate(self._parts):
                if part.timing == timing and part in readers:
                    wide, narrow = _wide(part.from_z, self._size), part.from_w.copy()
                    wide[:, made] += narrow[:, columns]
                    narrow[:, columns] = 0.0
                    self._parts[k] = replace(part, from_z=wide, from_w=narrow)

    def _register(
        self, i: int, timing: Timing, count: int, from_z: Array, from_w: Array, initial: Array
    ) -> NDArray[np.intp]:
        """Add a register of some samples; return the places of what it holds."""
        width = initial.size
        name = self._network.blocks[i].name
        if count > _SHORT:
            return self._line(name, timing, count, from_z, from_w, initial)
        n = count * width
        states = self._size + np.arange(n)
        held = self._size + n + np.arange(width)
        a, b = np.eye(n, k=-width), np.eye(n, width)
        c, d = np.eye(width, n, n - width), np.zeros((width, width))
        if not count:
            c, d = np.zeros((width, 0)), np.eye(width)
        self._size += n + width
        self._initial.append(np.tile(initial, count + 1))
        self._parts.append(Sampled(name, timing, a, b, c, d, states, held, from_z, from_w))
        return held

    def _line(
        self, name: str, timing: Timing, count: int, from_z: Array, from_w: Array, initial: Array
    ) -> NDArray[np.intp]:
        """Add a register of many samples; return the places of what it holds."""
        width, nw, before = initial.size, self._form.signals_w.shape[1], self._returned
        held = self._size + np.arange(width)
        nothing, none = np.zeros((0, width)), np.zeros((width, self._size))
        returned = np.eye(width, nw + before + width, nw + before)
        self._lines.append(Line(slice(nw + before, nw + before + width), timing, count, initial, from_z, from_w))
        self._parts.append(
            Sampled(name, timing, np.zeros((0, 0)), nothing, nothing.T, np.eye(width), held[:0], held, none, returned)
        )
        self._size, self._returned = self._size + width, before + width
        self._initial.append(initial)
        return held


def _time_columns(network: Network) -> Iterator[tuple[int, slice]]:
    """Places among w of the blocks that are functions of time."""
    end = network.ninputs
    for i, block in enumerate(network.blocks):
        if block.is_time_function:
            yield i, slice(end, end + block.system.noutputs)
            end += block.system.noutputs


def _split(delay: float, period: Fraction) -> tuple[int, Fraction]:
    """Whole periods of a delay, and the rest of it; a rest that is rounding is 0."""
    whole = floor(as_fraction(delay) / period)
    rest = as_fraction(delay) - whole * period
    small = Fraction(_SAME) * (as_fraction(delay) + period)
    if rest >= period - small:
        whole, rest = whole + 1, Fraction(0)
    return whole, rest if rest > small else Fraction(0)


def _wide(matrix: Array, size: int) -> Array:
    """Matrix with zero columns added."""
    return np.pad(matrix, ((0, 0), (0, size - matrix.shape[1])))
