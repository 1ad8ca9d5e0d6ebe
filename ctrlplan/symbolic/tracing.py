"""Equations of blocks as CasADi functions, traced by calls with symbols.

A trace is valid only if it agrees with Python.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
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
Answer = Array
"""Outputs of a block, then its rates."""

_SAME = 1e-8
"""Relative tolerance between a trace and Python."""

_AGAIN = 3
"""Every third point is evaluated twice."""

_FEWEST = 8
"""Minimum number of points with finite values for a comparison."""

_PACKAGES = (
    str(Path(__file__).parents[1] / "flatness"),
    *(str(Path(file).parent) for file in (__file__, ca.__file__, ct.__file__, np.__file__)),
)
"""Folders of the code that calls a block, or that it calls."""


class NotTraceableError(ValueError):
    """A block cannot be traced; the message states its name and the reason."""


class Traceable(Protocol):
    """Protocol of traceable blocks: a python-control system and its parameters."""

    @property
    def name(self) -> str:
        """Name for messages."""

    @property
    def system(self) -> ct.NonlinearIOSystem:
        """The system."""

    @property
    def params(self) -> Params:
        """Parameters of the block, without those of a run."""

    def output(self, params: Params) -> BlockMap:
        """Output map with the parameters of a run."""

    def update(self, params: Params) -> BlockMap:
        """State derivatives with the parameters of a run."""


@dataclass(frozen=True, eq=False)
class Trace:
    """Outputs and rates of a block as functions of (t, x, u, p).

    Attributes
    ----------
    output, update : casadi.Function
        Columns of outputs, and of rates.
    symbols : tuple of str
        Parameters that are the entries of p; the others are constants.
    """

    output: ca.Function
    update: ca.Function
    symbols: tuple[str, ...]

    def depends_on_time(self) -> bool:
        """Whether outputs or rates depend explicitly on t."""
        return any(function.jac_sparsity(0, 0).nnz() > 0 for function in (self.output, self.update))

    def feedthrough(self) -> NDArray[np.bool_]:
        """Structural direct feedthrough from inputs to outputs, (noutputs, ninputs)."""
        found = np.zeros((self.output.numel_out(0), self.output.numel_in(2)), dtype=bool)
        if found.size:
            rows, columns = self.output.jac_sparsity(0, 2).get_triplet()
            found[rows, columns] = True
        return found


def traced(block: Traceable, params: Params, t: float, x: Array, u: Array) -> Trace:
    """Trace of a block, verified against Python near a time, a state and an input.

    All objects that the block's functions refer to are restored; a block for which
    this is impossible is not called.

    Raises
    ------
    NotTraceableError
        If no call with symbols gives a trace that agrees with Python, or the
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
                raise NotTraceableError(f"block {block.name} has memory: its calls change objects that it refers to")
    finally:
        keeper.restore()
    keeper.ignore(changes)
    return trace


def _is_log_only(
    block: Traceable, values: Params, trace: Trace, known: list[tuple[Point, Answer]], keeper: Keeper
) -> bool:
    """Whether data that a block writes, such as a log or a counter of calls, have no effect on its values.

    The values are compared before and after the writing. If the data had an effect,
    a second trace would depend on symbols of the first.
    """
    for point, values_then in known[::_AGAIN]:
        keeper.restore()
        if not _same(_finite(block, point), values_then):
            return False
    keeper.restore()
    traces = [tried(lambda: _trace(block, values, trace.symbols), None) for _ in range(2)]
    return traces[1] is not None and not _disagreement(traces[1], known)


def callable_references(blocks: Iterable[Traceable], params: Params) -> References:
    """References of blocks, checked for calls that can be undone.

    Raises
    ------
    NotTraceableError
        If the objects of a block cannot be restored.
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
    """Disagreement of a trace at times (n,), states (nstates, n) and inputs (ninputs, n); empty if it agrees."""
    values = {**block.params, **params}
    functions = block.output(values), block.update(values)
    with untouched():
        answers = [_answer(functions, t[k], x[:, k], u[:, k]) for k in range(t.size)]
    inside = np.array([k for k, answer in enumerate(answers) if answer is not None], dtype=np.intp)
    if not inside.size:
        return ""
    found = np.array([answers[k] for k in inside]).T
    finite = np.isfinite(found).all(axis=0)
    inside, found = inside[finite], found[:, finite]
    p = np.array([values[key] for key in trace.symbols], dtype=float)
    return _difference(trace, t[inside], x[:, inside], u[:, inside], np.tile(p[:, None], inside.size), found)


def _known(block: Traceable, points: list[Point]) -> list[tuple[Point, Answer]]:
    """Points inside the block's domain with the values of Python, checked to be reproducible."""
    first = [_finite(block, point) for point in points]
    again = [_finite(block, point) for point in points[::_AGAIN]]
    if not all(_same(a, b) for a, b in zip(first[::_AGAIN], again, strict=True)):
        raise NotTraceableError(
            f"block {block.name} returns different values for equal arguments: it is random or has memory"
        )
    known = [(point, found) for point, found in zip(points, first, strict=True) if found is not None]
    if len(known) < _FEWEST:
        why = next((f": {said}" for point in points if (said := _error_of(block, point))), "")
        raise NotTraceableError(f"block {block.name} cannot be checked: it is finite at too few states{why}")
    return known


def _agreed(block: Traceable, values: Params, known: list[tuple[Point, Answer]]) -> Trace:
    """Trace that agrees with Python, with numeric parameters as symbols if possible."""
    numbers = tuple(
        key for key, value in values.items() if np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"
    )
    why = ""
    for symbols in dict.fromkeys((numbers, ())):
        try:
            trace = _trace(block, values, symbols)
        except (Exception, SystemExit) as error:  # any exception of a block for symbols
            why = why or described(error)
            continue
        wrong = _disagreement(trace, known)
        if not wrong:
            return trace
        why = wrong
    raise NotTraceableError(
        f"block {block.name} cannot be traced ({why}); use functions of numpy, as np.sin, np.maximum and np.where, "
        "and lists of values, instead of functions of math, branches on a state, or arrays that are filled"
    )


def _error_of(block: Traceable, point: Point) -> str:
    """Error of a block at a point; empty without one."""
    t, x, u, values = point
    try:
        for function in (block.output(values), block.update(values)):
            function(t, x.copy(), u.copy())
    except (Exception, SystemExit) as error:  # any exception of a block
        return described(error)
    return ""


def described(error: BaseException) -> str:
    """Kind and message of an error, and the line of the user's code from which it comes."""
    lines = str(error).strip().splitlines() or [""]
    said = f"{type(error).__name__}: {lines[-1]:.120}"
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(_PACKAGES)]
    if not own:
        return said
    line = f": {own[-1].line}" if own[-1].line else ""
    return f"{said}, in {Path(own[-1].filename).name}, line {own[-1].lineno}{line}"


def _points(values: Params, t: float, x: Array, u: Array) -> Iterator[Point]:
    """Times, states, inputs and parameters near and far from the given ones."""
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
    functions = tried(lambda: (block.output(values), block.update(values)), None)
    found = None if functions is None else _answer(functions, t, x, u)
    return found if found is not None and np.isfinite(found).all() else None


def _answer(functions: tuple[BlockMap, BlockMap], t: float, x: Array, u: Array) -> Answer | None:
    """Outputs and rates by Python, finite or not; None if a function raises."""
    try:
        return np.concatenate([_real(function(t, x.copy(), u.copy())) for function in functions])
    except (Exception, SystemExit):  # any exception of a block, as in `tried`
        return None


def _real(values: Value) -> Array:
    found = np.array(values).ravel()
    if found.dtype.kind == "c":
        raise TypeError("values must be real")
    return found.astype(float, copy=False)


def _same(a: Answer | None, b: Answer | None) -> bool:
    """Whether two answers are equal, or both missing."""
    return same_answer(None if a is None else (a,), None if b is None else (b,))


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
    return _difference(trace, t, x, u, p.reshape(-1, len(known)), np.array([found for _, found in known]).T)


def _difference(trace: Trace, t: Array, x: Array, u: Array, p: Array, found: Array) -> str:
    """First difference of a trace from values (noutputs + nrates, n) by Python; empty if they agree."""
    if not found.size:
        return ""
    t = t.reshape(1, -1)
    traced_values = np.concatenate([f(t, x, u, p).full() for f in (trace.output, trace.update)])
    # For a value that is small by cancellation the tolerance is relative to its magnitude elsewhere.
    size = np.maximum(np.abs(found), 1e-3 * np.abs(found).max(axis=1, keepdims=True))
    wrong = ~(np.abs(traced_values - found) <= _SAME * size)
    if not wrong.any():
        return ""
    i, k = (int(n) for n in np.argwhere(wrong)[0])
    return f"its trace gives {traced_values[i, k]:.6g} where Python gives {found[i, k]:.6g}"
