"""Operating point of a plant, given in part, and the scales of its states and controls there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_finite, real_array
from ctrlplan._types import Array
from ctrlplan.flatness.equations import Equations
from ctrlplan.symbolic.taping import tape_of

At = Mapping[str, float] | tuple[ArrayLike, ArrayLike] | None
"""Values of states and inputs by name, or (x, u)."""

_ITERATIONS = 200
_SAME = 1e-9
"""Magnitude in scales below which an entry of an equilibrium is 0; relative tolerance of its residual."""


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """States and controls at which the branches of the equations are chosen.

    Attributes
    ----------
    x, u : ndarray
        States and controls.
    equilibrium : bool
        Whether the rates are 0 there.
    """

    x: Array
    u: Array
    equilibrium: bool


def given_values(at: At, states: Sequence[str], inputs: Sequence[str], name: str) -> dict[str, float]:
    """Values by name of an operating point, checked.

    Raises
    ------
    TypeError, ValueError
        If a name is unknown, a value is not finite, or the shapes of (x, u) are wrong.
    """
    if at is None:
        return {}
    names = [*states, *inputs]
    if isinstance(at, Mapping):
        for key in at:
            if key not in names:
                raise ValueError(f"at must have names of states and inputs of {name}, {', '.join(names)}, got {key!r}")
        return {key: checked_finite(value, f"at[{key!r}]") for key, value in at.items()}
    if not isinstance(at, tuple) or len(at) != 2:
        raise TypeError(f"at must be a dict of values by name or a pair (x, u), got {type(at).__name__}")
    x, u = real_array(at[0], "at[0]"), real_array(at[1], "at[1]")
    if x.shape != (len(states),) or np.atleast_1d(u).shape != (len(inputs),):
        raise ValueError(
            f"at must be (x, u) of shapes ({len(states)},) and ({len(inputs)},), got {x.shape} and {u.shape}"
        )
    values = [*x.tolist(), *np.atleast_1d(u).tolist()]
    return {key: checked_finite(value, f"at of {key}") for key, value in zip(names, values, strict=True)}


def found_point(equations: Equations, known: Mapping[str, float], scales: Mapping[str, float]) -> OperatingPoint:
    """Equilibrium with the known values, or the known values themselves if they are complete.

    Raises
    ------
    ValueError
        If there is no equilibrium, or the equations are infinite at the point.
    """
    names = equations.names
    n = len(equations.states)
    free = np.array([name not in known for name in names])
    start = np.array([known.get(name, 0.0) for name in names])
    unit = np.array([scales.get(name, 1.0) for name in names])
    jacobian = ca.jacobian(equations.rates, ca.vertcat(equations.x, equations.u))
    rates, slopes = tape_of(equations.variables, equations.rates), tape_of(equations.variables, jacobian, matrix=True)

    def at(values: Array) -> tuple[Array, Array] | None:
        found = rates(values[:n], values[n:], equations.values), slopes(values[:n], values[n:], equations.values)
        return found if all(np.isfinite(part).all() for part in found) else None

    if not free.any():
        found = at(start)
        if found is None:
            raise ValueError(f"equations of {equations.name} must be finite at the operating point, got at = {known}")
        balanced = bool((np.abs(found[0]) <= _SAME * (np.abs(found[1]) @ (np.abs(start) + 0.1 * unit))).all())
        return OperatingPoint(start[:n], start[n:], balanced)
    nearest: Array | None = None
    smallest = np.inf
    for trial in _starts(start, free, unit):
        solved, size = _equilibrium(at, trial, free, unit)
        if solved is not None and size == 0.0:
            return OperatingPoint(solved[:n], solved[n:], True)
        if solved is not None and size < 0.01 * smallest:
            nearest, smallest = solved, size
    if known and nearest is not None:  # in motion, as a car at a given speed
        return OperatingPoint(nearest[:n], nearest[n:], False)
    raise ValueError(
        f"{equations.name} must have an equilibrium unless values are given, got none; give values of states and "
        "inputs by at="
    )


def _starts(start: Array, free: NDArray[np.bool_], unit: Array) -> Iterator[Array]:
    """Zeros, ones, and random entries in place of the unknown ones."""
    yield start
    yield np.where(free, unit, start)
    rng = np.random.default_rng(0)
    for _ in range(12):
        size = unit * 10.0 ** rng.uniform(-1.0, 1.0, start.size) * rng.choice([-1.0, 1.0], start.size)
        yield np.where(free, size, start)


def _equilibrium(
    at: Callable[[Array], tuple[Array, Array] | None], values: Array, free: NDArray[np.bool_], unit: Array
) -> tuple[Array | None, float]:
    """Point of smallest rates by Newton steps of minimum norm from a start, and their size, 0 for an equilibrium."""
    found = at(values)
    if found is None:
        return None, np.inf
    for _ in range(_ITERATIONS):
        residual, slopes = found
        weight = np.abs(slopes) @ (np.abs(values) + 0.1 * unit)
        weight = np.where(weight > 0.0, weight, 1.0)
        size = _size(residual / weight)
        if size <= 1e-14:
            return _tidied(at, values, free, unit), 0.0
        step = np.zeros(values.size)
        scaled = (slopes / weight[:, None])[:, free] * unit[free]
        step[free] = -unit[free] * (np.linalg.pinv(scaled) @ (residual / weight))
        step /= max(1.0, float(np.max(np.abs(step) / (0.5 * np.abs(values) + 0.2 * unit))))
        nearer = _shortened(at, values, step, weight, size)
        if nearer is None:
            return (_tidied(at, values, free, unit), 0.0) if size <= _SAME else (values, size)
        values, found = nearer
    return values, size


def _shortened(
    at: Callable[[Array], tuple[Array, Array] | None], values: Array, step: Array, weight: Array, size: float
) -> tuple[Array, tuple[Array, Array]] | None:
    """First of the halved steps that makes the rates smaller."""
    for _ in range(30):
        nearer = at(values + step)
        if nearer is not None and _size(nearer[0] / weight) < size:
            return values + step, nearer
        step = 0.5 * step
    return None


def _size(rows: Array) -> float:
    return float(np.linalg.norm(rows))


def _tidied(
    at: Callable[[Array], tuple[Array, Array] | None], values: Array, free: NDArray[np.bool_], unit: Array
) -> Array:
    """Equilibrium with rounding errors of 0 replaced by 0, where the residual stays small."""
    for k in np.flatnonzero(free & (np.abs(values) < _SAME * unit)):
        changed = values.copy()
        changed[k] = 0.0
        found = at(changed)
        if found is not None:
            weight = np.abs(found[1]) @ (np.abs(changed) + 0.1 * unit)
            if (np.abs(found[0]) <= 1e-13 * weight).all():
                values = changed
    return values


def scales_at(
    equations: Equations, expressions: ca.SX, point: Array, given: Mapping[str, float]
) -> tuple[Array, float]:
    """Scale of each state and control, and the rate of the dynamics [1/s].

    The scale of an entry is the distance over which the expressions stop being
    linear in it, from their Taylor coefficients along the entry; the magnitude
    at the point where that is smaller; otherwise the one that balances the linear
    terms of the rates.

    Parameters
    ----------
    equations : Equations
        The plant.
    expressions : casadi.SX
        Column of rates and flat outputs.
    point : ndarray, shape (nstates + ninputs,)
        The operating point.
    given : mapping of str to float
        Scales chosen by the user.
    """
    names = equations.names
    variables = ca.vertcat(equations.x, equations.u)
    size = np.full(len(names), np.nan)
    for k, name in enumerate(names):
        magnitude = abs(point[k])
        if name in given:
            size[k] = checked_finite(given[name], f"scales[{name!r}]", above=0.0)
            continue
        radius = _radius(expressions, variables, equations.p, k, point, equations.values)
        if not np.isfinite(radius):
            size[k] = magnitude if magnitude > 0.0 else np.nan
        else:
            size[k] = magnitude if 1e-3 * radius < magnitude < radius else radius
    return _balanced(equations, variables, point, size)


def _radius(expressions: ca.SX, variables: ca.SX, p: ca.SX, k: int, point: Array, values: Array) -> float:
    """Distance along one entry over which the nonlinear terms reach the linear ones."""
    along = ca.SX.sym("along")
    moved = ca.substitute(expressions, variables[k], variables[k] + along)
    coefficients = []
    for order in range(1, 5):
        moved = ca.jacobian(moved, along) / order
        if moved.nnz() == 0:
            break
        coefficients.append(tape_of((along, variables, p), moved)([0.0], point, values))
    if len(coefficients) < 2:
        return np.inf
    rows = np.abs(np.array(coefficients))
    rows[~np.isfinite(rows)] = 0.0
    best = np.inf
    for b in range(min(3, len(rows)), min(4, len(rows)) + 1):
        for row in rows.T:
            if row[b - 1] > 1e-14 * row.max():
                ratios = [(row[a - 1] / row[b - 1]) ** (1.0 / (b - a)) for a in range(1, b) if row[a - 1] > 0.0]
                best = min(best, max(ratios, default=np.inf))
    if len(rows) == 2:
        for row in rows.T:
            if row[1] > 0.0 and row[0] > 0.0:
                best = min(best, row[0] / row[1])
    return float(best)


def _balanced(equations: Equations, variables: ca.SX, point: Array, size: Array) -> tuple[Array, float]:
    """Missing scales, and the rate, from the linear terms of the rates."""
    slopes = tape_of((variables, equations.p), ca.jacobian(equations.rates, variables), matrix=True)(
        point, equations.values
    )
    rows, columns = np.nonzero(np.isfinite(slopes) & (slopes != 0.0))
    count = size.size
    unknown = np.flatnonzero(~np.isfinite(size))
    column_of = {int(k): i for i, k in enumerate(unknown)}
    matrix = np.zeros((rows.size, unknown.size + 1))
    right = np.zeros(rows.size)
    for e, (i, j) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
        right[e] = -np.log(abs(slopes[i, j]))
        for k, sign in ((j, 1.0), (i, -1.0)):
            if k in column_of:
                matrix[e, column_of[k]] += sign
            else:
                right[e] -= sign * np.log(size[k])
        matrix[e, -1] -= 1.0
    # Underdetermined entries stay near 1.
    solved = np.linalg.lstsq(matrix, right, rcond=1e-10)[0] if rows.size else np.zeros(unknown.size + 1)
    size = size.copy()
    size[unknown] = np.exp(solved[:-1])
    return size[:count], float(np.exp(solved[-1]))
