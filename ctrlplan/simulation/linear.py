"""State-space form of a linear interconnection of python-control."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import real_array
from ctrlplan._types import Array, System
from ctrlplan.simulation.exact import largest_change, matrix_product, state_scale
from ctrlplan.traits import traits_of
from ctrlplan.trajectories import Trajectory

_FAST, _GROWING = 1e9, 20.0
"""Durations relative to the fastest pole, and to the fastest growth, up to which rounding stays below `_UNCERTAIN`."""

_UNCERTAIN = 1e-6


class NotLinearError(ValueError):
    """A block is not linear, time-invariant and continuous."""


@dataclass(frozen=True)
class LinearForm:
    """Loop x' = A x + B w, y = C x + D w; or several, along one axis in front of the matrices.

    Attributes
    ----------
    a, b, c, d : ndarray
        The matrices; w contains the external inputs, then the outputs of sources.
    sources : tuple of (Trajectory, int)
        Plan and highest derivative of each source; its outputs are ordered axis
        by axis.
    """

    a: Array
    b: Array
    c: Array
    d: Array
    sources: tuple[tuple[Trajectory, int], ...]

    def outputs(self, states: Array, inputs: Array) -> Array:
        """Outputs (noutputs, ntime); an overflowed state affects only those that depend on it."""
        with np.errstate(over="ignore", invalid="ignore"):
            found: Array = matrix_product(self.c, states) + self.d @ inputs
        found[np.isnan(found)] = np.inf
        return found

    @cached_property
    def poles(self) -> NDArray[np.inexact]:
        """Poles of the loop."""
        return np.asarray(np.linalg.eigvals(self.a))

    def sensitivity(self, duration: float) -> tuple[bool, bool, bool]:
        """Whether growth, fast poles or nonnormality amplify rounding errors above 1e-6 over a duration [s].

        A perturbation of the matrix changes its
        exponential by at most duration * norm(perturbation) * max(norm(exp(A t)))^2.
        """
        if not self.a.size:
            return False, False, False
        poles = self.poles
        growing, fast = duration * poles.real.max() > _GROWING, duration * np.abs(poles).max() > _FAST
        if growing or fast:
            return bool(growing), bool(fast), False
        rounding = duration * self._rounding
        bound = np.exp(np.clip(duration * self._growth, 0.0, 700.0))
        nonnormal = rounding * bound > _UNCERTAIN and (
            rounding * largest_change(duration * self._balanced, 1.0) ** 2 > _UNCERTAIN
        )
        return False, False, bool(nonnormal)

    def is_sensitive(self, duration: float) -> NDArray[np.bool_]:
        """Whether any of these amplifies rounding errors in each of several loops, shape (nloops,)."""
        if not self.a.size:
            return np.zeros(len(self.a), dtype=bool)
        scale = state_scale(np.abs(self.a).max(axis=0))
        a = duration * self.a * (scale / scale[:, None])
        poles, vectors = np.linalg.eig(a)
        found = np.asarray((poles.real.max(axis=1) > _GROWING) | (np.abs(poles).max(axis=1) > _FAST))
        with np.errstate(all="ignore"):  # a defective matrix has no bound
            bound = np.exp(np.maximum(poles.real.max(axis=1), 0.0)) * np.linalg.cond(vectors)
            uncertain = ~(_rounding(a) * (1.0 + bound) ** 2 <= _UNCERTAIN)
        for i in np.flatnonzero(~found & uncertain):
            found[i] = any(LinearForm(self.a[i], self.b[i], self.c[i], self.d[i], self.sources).sensitivity(duration))
        return found

    def rounding(self, states: Array, inputs: Array) -> Array:
        """Rounding errors of the outputs for states and inputs of given size, shape (noutputs,)."""
        scale = self.scale
        largest = np.abs(states / scale[:, None]).max(initial=0.0)
        fed = np.abs(self.c) @ scale * largest + np.abs(self.d) @ np.abs(inputs).max(axis=1, initial=0.0)
        return np.asarray(64.0 * np.finfo(float).eps * fed)

    @cached_property
    def scale(self) -> Array:
        """Balancing scale (nstates,) of one loop."""
        return state_scale(self.a)

    @cached_property
    def _balanced(self) -> Array:
        """Matrix A of one loop in balanced states."""
        return np.asarray(self.a * (self.scale / self.scale[:, None]))

    @cached_property
    def _rounding(self) -> float:
        """Relative rounding errors of A in balanced states."""
        return float(_rounding(self._balanced))

    @cached_property
    def _growth(self) -> float:
        """Rate [1/s] so that norm(exp(A t))^2 <= exp(rate t) in balanced states, which is usually sufficient."""
        return float(np.linalg.eigvalsh(self._balanced + self._balanced.T).max())


def _rounding(a: Array) -> Array:
    """Relative rounding errors of matrices (..., n, n)."""
    return np.asarray(np.finfo(float).eps * np.abs(a).sum(axis=-2).max(axis=-1))


def linear_form(system: System) -> LinearForm:
    """Linear form of a system, nested interconnections and plan sources included.

    States, inputs and outputs are in the order of python-control.

    Raises
    ------
    NotLinearError
        If a block is nonlinear or discrete; the message names it.
    ValueError
        If blocks form an algebraic loop without a unique solution, or a matrix
        is not finite.
    """
    form = linear_forms([system])
    return LinearForm(form.a[0], form.b[0], form.c[0], form.d[0], form.sources)


def linear_forms(systems: Sequence[System], discrete: bool = False) -> LinearForm:
    """Linear forms of systems with equal connections, stacked.

    Parameters
    ----------
    systems : sequence of control systems
        The systems.
    discrete : bool, optional
        Whether discrete blocks are linear too: A then gives the next states.

    Raises
    ------
    NotLinearError
        If a block is nonlinear, or discrete unless these are allowed.
    ValueError
        If an algebraic loop has no unique solution, or the systems differ in more
        than numerical values.
    """
    return stacked_form([linear_parts(system, discrete) for system in systems])


@dataclass(frozen=True, eq=False)
class LinearParts:
    """Numbers of a linear system, copied.

    Attributes
    ----------
    name : str
        Name of the system.
    ninputs : int
        Number of inputs.
    matrices : tuple of ndarray
        A, B, C and D; of an interconnection, its maps of connections, inputs and outputs.
    blocks : tuple of LinearParts or None
        Blocks of an interconnection.
    source : (Trajectory, int) or None
        Plan and highest derivative of a source, which has no matrices.
    width : int
        Number of outputs of a source.
    """

    name: str
    ninputs: int
    matrices: tuple[Array, ...]
    blocks: tuple[LinearParts, ...] | None = None
    source: tuple[Trajectory, int] | None = None
    width: int = 0

    @property
    def has_sources(self) -> bool:
        """Whether there are sources in the system."""
        return self.source is not None or any(block.has_sources for block in self.blocks or ())

    @cached_property
    def structure(self) -> tuple[object, ...]:
        """All of it except the numerical values of its blocks."""
        shapes = tuple(matrix.shape for matrix in self.matrices)
        if self.blocks is None:
            return self.source, shapes
        maps = tuple(tuple(matrix.ravel().tolist()) for matrix in self.matrices)
        return self.source, shapes, maps, *(block.structure for block in self.blocks)

    def fits(self, other: LinearParts) -> bool:
        """Whether two systems differ only in the numerical values of their blocks."""
        return self.structure == other.structure

    def equals(self, other: LinearParts) -> bool:
        """Whether two systems have the same numbers."""
        pairs = zip(self.matrices, other.matrices, strict=True)
        blocks = zip(self.blocks or (), other.blocks or (), strict=True)
        return (
            self.fits(other)
            and all(np.array_equal(one, two) for one, two in pairs)
            and all(one.equals(two) for one, two in blocks)
        )


def linear_parts(system: System, discrete: bool = False) -> LinearParts:
    """Numbers of a linear system; arguments and errors as for `linear_forms`."""
    kind, name, count = _kind(system, discrete), str(system.name), system.ninputs or 0
    if kind is ct.InterconnectedSystem:
        blocks = tuple(linear_parts(block, discrete) for block in system.syslist)
        maps = tuple(np.array(getattr(system, f"{one}_map"), dtype=float) for one in ("connect", "input", "output"))
        return LinearParts(name, count, maps, blocks)
    traits = traits_of(system)
    if kind is Trajectory and traits.plan is not None:
        return LinearParts(name, 0, (), None, (traits.plan, traits.derivatives), system.noutputs or 0)
    system = ct.ss(system) if kind is ct.TransferFunction else system
    return LinearParts(name, count, tuple(_matrix(system, one).copy() for one in "ABCD"))


def stacked_form(systems: Sequence[LinearParts]) -> LinearForm:
    """Linear forms of systems that fit each other, stacked; errors as for `linear_forms`."""
    first = systems[0]
    if not all(first.fits(system) for system in systems[1:]):
        raise ValueError(
            f"systems must differ only in numerical values, got other blocks or connections in one named {first.name}"
        )
    if first.source is not None:
        count, n = len(systems), first.width
        a, b, c = map(np.zeros, ((count, 0, 0), (count, 0, n), (count, n, 0)))
        return LinearForm(a, b, c, np.tile(np.eye(n), (count, 1, 1)), (first.source,))
    if first.blocks is None:
        a, b, c, d = (np.stack([system.matrices[k] for system in systems]) for k in range(4))
        return LinearForm(a, b, c, d, ())
    forms = [stacked_form(blocks) for blocks in zip(*(system.blocks or () for system in systems), strict=True)]
    counts = [block.ninputs for block in first.blocks]
    names = [block.name for block in first.blocks]
    connect, external, outputs = first.matrices
    return closed(forms, counts, names, connect, external.reshape(sum(counts), first.ninputs), outputs, first.name)


def in_right_half(poles: NDArray[np.inexact]) -> NDArray[np.bool_]:
    """Which poles lie in the right half plane by more than rounding."""
    return np.asarray(poles.real > 1e-9 * np.maximum(1e-300, np.abs(poles)))


def _matrix(system: System, name: str) -> Array:
    matrix = real_array(getattr(system, name), f"{name} of {system.name}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name} of {system.name} must be finite, got nan or inf")
    return matrix


def _kind(system: System, discrete: bool) -> type:
    if not discrete and system.dt not in (None, 0):
        raise NotLinearError(f"block {system.name} is discrete (dt = {system.dt})")
    for kind in (ct.InterconnectedSystem, ct.StateSpace, ct.TransferFunction):
        if isinstance(system, kind):
            return kind
    if isinstance(traits_of(system).plan, Trajectory):
        return Trajectory
    raise NotLinearError(f"block {system.name} ({type(system).__name__}) is not linear")


def closed(
    forms: Sequence[LinearForm],
    counts: Sequence[int],
    names: Sequence[str],
    connect: Array,
    external: Array,
    outputs: Array,
    name: str,
) -> LinearForm:
    """Linear form of connected blocks: u = connect y + external r for their outputs y and external inputs r.

    Parameters
    ----------
    forms : sequence of LinearForm
        The blocks, stacked; their inputs, then the outputs of sources inside of them.
    counts : sequence of int
        Number of inputs of each block, without those sources.
    names : sequence of str
        Names of the blocks.
    connect, external : ndarray, shapes (ninputs, noutputs) and (ninputs, nexternal)
        Connections, where the inputs and outputs are those of all blocks.
    outputs : ndarray, shape (noutputs of the result, noutputs + ninputs)
        Outputs of the result, from the outputs and the inputs of all blocks.
    name : str
        Name of the result.

    Raises
    ------
    ValueError
        If an algebraic loop has no unique solution, or products of gains overflow.
    """
    a, c = (_diagonal([getattr(form, name) for form in forms]) for name in "ac")
    b, d = (_diagonal([getattr(form, name)[..., :k] for form, k in zip(forms, counts, strict=True)]) for name in "bd")
    e, f = (_diagonal([getattr(form, name)[..., k:] for form, k in zip(forms, counts, strict=True)]) for name in "bd")
    # u = connect y + external r and y = c x + d u + f s, solved for y.
    closing = np.eye(d.shape[1]) - d @ connect
    singular = singular_loop(closing)
    if singular.size:
        owners = np.repeat(names, [form.c.shape[1] for form in forms])
        blocks = ", ".join(dict.fromkeys(owners[singular].tolist()))
        raise ValueError(f"blocks must not form an algebraic loop without a solution, got one of {blocks}")
    y_x, y_r, y_s = np.split(
        np.linalg.solve(closing, np.concatenate([c, d @ external, f], axis=2)),
        np.cumsum([a.shape[1], external.shape[1]]),
        axis=2,
    )
    u_x, u_r, u_s = connect @ y_x, connect @ y_r + external, connect @ y_s
    from_y, from_u = outputs[:, : d.shape[1]], outputs[:, d.shape[1] :]
    with np.errstate(over="ignore", invalid="ignore"):
        form = LinearForm(
            a + b @ u_x,
            np.concatenate([b @ u_r, b @ u_s + e], axis=2),
            from_y @ y_x + from_u @ u_x,
            np.concatenate([from_y @ y_r + from_u @ u_r, from_y @ y_s + from_u @ u_s], axis=2),
            tuple(source for form in forms for source in form.sources),
        )
    if not all(np.isfinite(matrix).all() for matrix in (form.a, form.b, form.c, form.d)):
        raise ValueError(f"gains of the blocks in {name} must have finite products, got an overflow")
    return form


def _diagonal(blocks: list[Array]) -> Array:
    """Block-diagonal matrices of stacks (nsystems, ., .)."""
    height, width = (sum(block.shape[axis] for block in blocks) for axis in (1, 2))
    out = np.zeros((len(blocks[0]), height, width))
    row = column = 0
    for block in blocks:
        height, width = block.shape[1:]
        out[:, row : row + height, column : column + width] = block
        row, column = row + height, column + width
    return out


def singular_loop(closing: Array) -> NDArray[np.intp]:
    """Signals of an algebraic loop without a unique solution in one of the systems; empty if there is none.

    Only strongly connected signals are tested: large gains in series are not a loop.
    """
    size = closing.shape[1]
    if not size:
        return np.empty(0, dtype=np.intp)
    reach = (closing != 0.0) | np.eye(size, dtype=bool)
    for _ in range(size.bit_length()):
        reach = reach @ reach
    group = reach & reach.swapaxes(1, 2)  # [system, signal, signals in one loop with it]
    isolated = np.argwhere((closing[:, range(size), range(size)] == 0.0) & (group.sum(axis=2) == 1))
    if isolated.size:
        return isolated[0, 1:]
    for system, signal in np.argwhere((group.sum(axis=2) > 1) & (group.argmax(axis=2) == np.arange(size))):
        members = np.flatnonzero(group[system, signal])
        block = closing[system][np.ix_(members, members)]
        largest = np.abs(block).max(axis=1, keepdims=True)
        if largest.min() == 0.0 or np.linalg.cond(block / largest) > 1e13:
            return members
    return np.empty(0, dtype=np.intp)
