"""A block's equations as CasADi functions, found by calling them with symbols.

A trace counts only after it has agreed with Python: some ways of writing numpy
end without an error in nan or in a constant.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ctrlplan.simulation.network import Block

Array = NDArray[np.float64]

_SAME = 1e-8
"""Relative difference up to which a trace and Python agree."""


class NotTraceableError(ValueError):
    """A block that CasADi's symbols cannot go through; it is named."""


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

    output: Any
    update: Any
    symbols: tuple[str, ...]

    def feedthrough(self) -> NDArray[np.bool_]:
        """Which outputs depend on which inputs at once, (noutputs, ninputs): by structure, at every time and state."""
        found = np.zeros((self.output.numel_out(0), self.output.numel_in(2)), dtype=bool)
        if found.size:
            rows, columns = self.output.jac_sparsity(0, 2).get_triplet()
            found[rows, columns] = True
        return found


def traced(block: Block, params: Mapping[str, Any], t: float, x: Array, u: Array) -> Trace:
    """Trace a block and compare with Python about a time, a state and an input.

    Raises
    ------
    NotTraceableError
        If no way of calling it with symbols gives what Python gives.
    """
    values = {**block.params, **params}
    points = list(_points(block, values, t, x, u))
    if sum(_finite(block, point) is not None for point in points) < 8:
        raise NotTraceableError(f"block {block.name} cannot be checked: it is finite at too few states")
    numbers = tuple(
        key for key, value in values.items() if np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"
    )
    why = ""
    for symbols in dict.fromkeys((numbers, ())):
        for as_objects in (True, False):
            try:
                with warnings.catch_warnings(), _no_number_is_a_symbol():
                    warnings.simplefilter("ignore")
                    trace = _trace(block, values, symbols, as_objects)
            except Exception as error:  # whatever a block does when it meets a symbol
                why = why or f"{type(error).__name__}: {str(error).strip().splitlines()[-1]:.120}"
                continue
            wrong = _disagreement(block, trace, points)
            if not wrong:
                return trace
            why = wrong
    raise NotTraceableError(
        f"block {block.name} cannot be traced ({why}); functions of numpy can be, as np.sin, np.maximum and np.where, "
        "and lists of values, but not functions of math, branches on a state, or arrays that are filled"
    )


@contextmanager
def _no_number_is_a_symbol() -> Iterator[None]:
    """Let a symbol that is asked for its number, or looked up, raise: CasADi answers nan, and a branch is lost."""

    def refuse(symbol: Any) -> Any:
        raise TypeError("a symbol has no number")

    names = ("__float__", "__int__", "__hash__")
    before = {name: getattr(ca.SX, name) for name in names if hasattr(ca.SX, name)}
    for name in names:
        setattr(ca.SX, name, refuse)
    try:
        yield
    finally:
        for name in names:
            if name in before:
                setattr(ca.SX, name, before[name])
            else:
                delattr(ca.SX, name)


def agrees(block: Block, trace: Trace, params: Mapping[str, Any], t: Array, x: Array, u: Array) -> str:
    """What is wrong with a trace at times (n,), states (nstates, n) and inputs (ninputs, n); empty where nothing."""
    values = {**block.params, **params}
    return _disagreement(block, trace, [(t[k], x[:, k], u[:, k], values) for k in range(t.size)])


def _points(block: Block, values: dict[str, Any], t: float, x: Array, u: Array) -> Iterator[tuple[Any, ...]]:
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
            yield (t + 10.0 * scale * rng.random(), *near, other)
    for _ in range(6):
        yield t, rng.standard_normal(x.size), rng.standard_normal(u.size), values


def _finite(block: Block, point: tuple[Any, ...]) -> tuple[Array, Array] | None:
    """Outputs and rates by Python, or None outside the block's domain."""
    t, x, u, values = point
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = tuple(
                np.array(np.ravel(f(t, x.copy(), u.copy())), dtype=float)
                for f in (block.output(values), block.update(values))
            )
        except (ArithmeticError, ValueError, np.linalg.LinAlgError):
            return None
    return (found[0], found[1]) if all(np.isfinite(values).all() for values in found) else None


def _trace(block: Block, values: dict[str, Any], symbols: tuple[str, ...], as_objects: bool) -> Trace:
    nx, nu = block.system.nstates or 0, block.system.ninputs or 0
    t, x, u, p = (ca.SX.sym(name, n) for name, n in (("t", 1), ("x", nx), ("u", nu), ("p", len(symbols))))
    given = {**values, **{key: p[k] for k, key in enumerate(symbols)}}
    state, fed = (_objects(x), _objects(u)) if as_objects else (x, u)
    functions = []
    for name, function, count in (
        ("output", block.output(given), block.system.noutputs),
        ("update", block.update(given), nx),
    ):
        column = _column(function(t, state, fed)) if count else ca.SX(0, 1)
        if column.numel() != count:
            raise ValueError(f"{column.numel()} values for {count}")
        functions.append(ca.Function(name, [t, x, u, p], [ca.densify(column)]))
    return Trace(functions[0], functions[1], symbols)


def _objects(column: Any) -> Any:
    """Symbols as a numpy array of objects, which takes whatever numpy takes."""
    out = np.empty(column.numel(), dtype=object)
    for k in range(out.size):
        out[k] = column[k]
    return out


def _column(values: Any) -> Any:
    if isinstance(values, ca.SX):
        return ca.vec(values)
    flat = [values] if not isinstance(values, list | tuple | np.ndarray) else list(np.ravel(np.asarray(values, object)))
    return ca.vertcat(*[value if isinstance(value, ca.SX) else ca.SX(float(value)) for value in flat])


def _disagreement(block: Block, trace: Trace, points: list[tuple[Any, ...]]) -> str:
    known = [(point, expected) for point in points if (expected := _finite(block, point)) is not None]
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
