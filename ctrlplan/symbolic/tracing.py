"""A block's equations as CasADi functions, found by calling them with symbols.

A trace counts only after it has agreed with Python.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array, BlockMap, Params, Value
from ctrlplan.symbolic.fingerprint import roots_of
from ctrlplan.symbolic.isolation import same_answer, tried, untouched
from ctrlplan.symbolic.keeper import Keeper
from ctrlplan.symbolic.references import References
from ctrlplan.symbolic.symbols import Symbol, column_of, symbol_array

Point = tuple[float, Array, Array, Params]
"""Time, state and input of a block, and parameters."""
Answer = tuple[Array, Array]
"""Outputs and rates of a block."""

_SAME = 1e-8
"""Relative difference up to which a trace and Python agree."""

_AGAIN = 3
"""Every third point is tried a second time."""

_FEWEST = 8
"""Points at which a block must be finite to be checked."""


class NotTraceableError(ValueError):
    """A block that CasADi's symbols cannot go through; it is named."""


class Traceable(Protocol):
    """Block that can be traced: a python-control system and the parameters that reach it."""

    @property
    def name(self) -> str:
        """Name in messages."""

    @property
    def system(self) -> ct.NonlinearIOSystem:
        """The system itself."""

    @property
    def params(self) -> Params:
        """Its parameters, before those of a run."""

    def output(self, params: Params) -> BlockMap:
        """Outputs, at the parameters of a run."""

    def update(self, params: Params) -> BlockMap:
        """Rates of the states, at the parameters of a run."""


@dataclass(frozen=True, eq=False)
class Trace:
    """Outputs and rates of a block as functions of (t, x, u, p).

    Attributes
    ----------
    output, update : casadi.Function
        Columns of outputs, and of rates.
    symbols : tuple of str
        Parameters that are the entries of p; the others are constants in the functions.
    """

    output: ca.Function
    update: ca.Function
    symbols: tuple[str, ...]

    def depends_on_time(self) -> bool:
        """Whether outputs or rates depend on t itself."""
        return any(function.jac_sparsity(0, 0).nnz() > 0 for function in (self.output, self.update))

    def feedthrough(self) -> NDArray[np.bool_]:
        """Which outputs have direct feedthrough of which inputs, (noutputs, ninputs): by structure, at every state."""
        found = np.zeros((self.output.numel_out(0), self.output.numel_in(2)), dtype=bool)
        if found.size:
            rows, columns = self.output.jac_sparsity(0, 2).get_triplet()
            found[rows, columns] = True
        return found


def traced(block: Traceable, params: Params, t: float, x: Array, u: Array) -> Trace:
    """Trace a block and compare with Python about a time, a state and an input.

    What the block's functions refer to is left as it was; a block that cannot
    be put back is not called.

    Raises
    ------
    NotTraceableError
        If no way of calling it with symbols gives what Python gives, or the
        block is random or has memory.
    """
    values = {**block.params, **params}
    keeper = Keeper(callable_references([block], params))
    try:
        with untouched():
            known = _known(block, list(_points(values, t, x, u)))
            trace = _agreed(block, values, known)
            changes = keeper.changes()
            if changes and not _is_log_only(block, values, trace, known, keeper):
                raise NotTraceableError(f"block {block.name} has memory: what it refers to changes when it is called")
    finally:
        keeper.restore()
    keeper.ignore(changes)
    return trace


def _is_log_only(
    block: Traceable, values: Params, trace: Trace, known: list[tuple[Point, Answer]], keeper: Keeper
) -> bool:
    """Whether what a block writes, such as a log or a counter of its calls, has no influence on its values.

    They are the same before it was written and after. A second trace after the
    first would depend on symbols of the first that were kept.
    """
    for point, values_then in known[::_AGAIN]:
        keeper.restore()
        if not same_answer(_finite(block, point), values_then):
            return False
    keeper.restore()
    traces = [tried(lambda: _trace(block, values, trace.symbols), None) for _ in range(2)]
    return traces[1] is not None and not _disagreement(traces[1], known)


def callable_references(blocks: Iterable[Traceable], params: Params) -> References:
    """What blocks refer to that can be called and put back as they were.

    Raises
    ------
    NotTraceableError
        If one of them cannot.
    """
    roots = []
    for block in blocks:
        values = {**block.params, **params}
        own = [*roots_of(block.system), *((f"params[{key!r}]", value) for key, value in values.items())]
        found = References(own)
        if found.opaque:
            raise NotTraceableError(f"block {block.name} refers to {found.opaque}, which can change without notice")
        roots += own
    return References(roots)


def agrees(block: Traceable, trace: Trace, params: Params, t: Array, x: Array, u: Array) -> str:
    """What is wrong with a trace at times (n,), states (nstates, n) and inputs (ninputs, n); empty where nothing."""
    values = {**block.params, **params}
    points: list[Point] = [(t[k], x[:, k], u[:, k], values) for k in range(t.size)]
    with untouched():
        known = [(point, found) for point in points if (found := _finite(block, point)) is not None]
    return _disagreement(trace, known)


def _known(block: Traceable, points: list[Point]) -> list[tuple[Point, Answer]]:
    """Points inside the block's domain with Python's values, which are the same in a second call."""
    first = [_finite(block, point) for point in points]
    again = [_finite(block, point) for point in points[::_AGAIN]]
    if not all(same_answer(a, b) for a, b in zip(first[::_AGAIN], again, strict=True)):
        raise NotTraceableError(
            f"block {block.name} returns different values for equal arguments: it is random or has memory"
        )
    known = [(point, found) for point, found in zip(points, first, strict=True) if found is not None]
    if len(known) < _FEWEST:
        raise NotTraceableError(f"block {block.name} cannot be checked: it is finite at too few states")
    return known


def _agreed(block: Traceable, values: Params, known: list[tuple[Point, Answer]]) -> Trace:
    """Trace that agrees with Python, numbers among the parameters as symbols if that can be."""
    numbers = tuple(
        key for key, value in values.items() if np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"
    )
    why = ""
    for symbols in dict.fromkeys((numbers, ())):
        try:
            trace = _trace(block, values, symbols)
        except (Exception, SystemExit) as error:  # whatever a block does when it meets a symbol
            lines = str(error).strip().splitlines() or [""]
            why = why or f"{type(error).__name__}: {lines[-1]:.120}"
            continue
        wrong = _disagreement(trace, known)
        if not wrong:
            return trace
        why = wrong
    raise NotTraceableError(
        f"block {block.name} cannot be traced ({why}); functions of numpy can be, as np.sin, np.maximum and np.where, "
        "and lists of values, but not functions of math, branches on a state, or arrays that are filled"
    )


def _points(values: Params, t: float, x: Array, u: Array) -> Iterator[Point]:
    """Times, states, inputs and parameters near the given ones and far from them."""
    rng = np.random.default_rng(0)
    for scale in (0.0, 1e-3, 0.1, 1.0):
        for _ in range(6):
            near = (a + scale * rng.standard_normal(a.size) * (1.0 + np.abs(a)) for a in (x, u))
            other = {
                key: float(value * (1.0 + 0.1 * scale * rng.standard_normal()))
                if isinstance(value, float | np.floating)
                else value
                for key, value in values.items()
            }
            x_near, u_near = near
            yield t + 10.0 * scale * rng.random(), x_near, u_near, other
    for _ in range(6):
        yield t, rng.standard_normal(x.size), rng.standard_normal(u.size), values


def _finite(block: Traceable, point: Point) -> Answer | None:
    """Outputs and rates by Python, or None outside of the block's domain."""
    t, x, u, values = point

    def answer() -> Answer | None:
        output, update = (
            _real(function(t, x.copy(), u.copy())) for function in (block.output(values), block.update(values))
        )
        return (output, update) if np.isfinite(output).all() and np.isfinite(update).all() else None

    return tried(answer, None)


def _real(values: Value) -> Array:
    found = np.ravel(values)
    if found.dtype.kind == "c":
        raise TypeError("values must be real")
    return np.array(found, dtype=float)


def _trace(block: Traceable, values: Params, symbols: tuple[str, ...]) -> Trace:
    nx, nu = block.system.nstates or 0, block.system.ninputs or 0
    t, x, u, p = (ca.SX.sym(name, n) for name, n in (("t", 1), ("x", nx), ("u", nu), ("p", len(symbols))))
    given = {**values, **{key: Symbol(p[k]) for k, key in enumerate(symbols)}}
    functions = []
    parts: tuple[tuple[str, BlockMap, int], ...] = (
        ("output", block.output(given), block.system.noutputs),
        ("update", block.update(given), nx),
    )
    for name, function, count in parts:
        column = column_of(function(Symbol(t), symbol_array(x), symbol_array(u))) if count else ca.SX(0, 1)
        if column.numel() != count:
            raise ValueError(f"{column.numel()} values for {count}")
        functions.append(ca.Function(name, [t, x, u, p], [ca.densify(column)]))
    return Trace(functions[0], functions[1], symbols)


def _disagreement(trace: Trace, known: list[tuple[Point, Answer]]) -> str:
    if not known:
        return ""
    t, x, u = (np.array([point[k] for point, _ in known]).T.reshape(-1, len(known)) for k in range(3))
    p = np.array([[point[3][key] for key in trace.symbols] for point, _ in known], dtype=float).T
    p = p.reshape(-1, len(known))
    traced_values = np.concatenate([f(t, x, u, p).full() for f in (trace.output, trace.update)])
    found = np.array([np.concatenate(values) for _, values in known]).T
    # Where a value is small by cancellation, the size of the same value elsewhere is what counts.
    size = np.maximum(np.abs(found), 1e-3 * np.abs(found).max(axis=1, keepdims=True))
    wrong = ~(np.abs(traced_values - found) <= _SAME * size)
    if not wrong.any():
        return ""
    i, k = (int(n) for n in np.argwhere(wrong)[0])
    return f"its trace gives {traced_values[i, k]:.6g} where Python gives {found[i, k]:.6g}"
