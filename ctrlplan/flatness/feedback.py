"""Expressions of tracking laws of flat plants: with the states of the extension, or without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np

from ctrlplan._types import Array
from ctrlplan.flatness.analysis import Analysis
from ctrlplan.flatness.limited import limited_controls
from ctrlplan.flatness.structure import Round, nearby, steadiness
from ctrlplan.symbolic.tape import Tape
from ctrlplan.symbolic.taping import tape_of

_REGULAR = 0.1
"""Variation of a matrix near the operating point below which a law without states is rejected."""

_QUICK = 10.0
"""Rate at which limits are approached, relative to the fastest pole."""


@dataclass(frozen=True, eq=False)
class LawExpressions:
    """Controls and rates of a law as functions of references, states and its own states.

    Attributes
    ----------
    control : Tape
        Controls of the plant, of (references, x, own states, p).
    rates : Tape
        Rates of the law's states, of the same arguments.
    counts : tuple of int
        Number of poles of each flat output, integral action not counted.
    extension : int
        Number of states of the extension among the law's states, the first.
    """

    control: Tape
    rates: Tape
    counts: tuple[int, ...]
    extension: int


class _Reference:
    """Symbols of the references of all flat outputs, and of the law's own states."""

    def __init__(self, analysis: Analysis, extension: int, integral: bool) -> None:
        orders = analysis.structure.orders
        self.rows = [ca.SX.sym(f"r{j}", r + 1) for j, r in enumerate(orders)]
        self.integrals = ca.SX.sym("xi", len(orders) if integral else 0)
        self.w = ca.SX.sym("w", extension)

    @property
    def column(self) -> ca.SX:
        """All references, output by output."""
        return ca.vertcat(*self.rows)

    @property
    def own(self) -> ca.SX:
        """The law's states."""
        return ca.vertcat(self.w, self.integrals)


def pole_counts(analysis: Analysis, quasi_static: bool, name: str) -> tuple[int, ...]:
    """Number of poles of each flat output."""
    if not quasi_static:
        return analysis.structure.orders
    return _closed(analysis, name)[0]


def law_with_states(
    analysis: Analysis,
    gains: Sequence[Sequence[float]],
    integral: bool,
    limits: tuple[Array, Array] | None = None,
) -> LawExpressions:
    """Law whose states are those of the extension.

    With limits the states of the extension and the integrals are those of the
    controls that are applied: the integrals tend to the values at which the error
    equations demand what the limits permit, with the largest time constant of each.

    Parameters
    ----------
    analysis : Analysis
        The plant.
    gains : sequence of sequence of float
        Coefficients of the error polynomial of each flat output, lowest order first.
    integral : bool
        Whether each polynomial has one more coefficient, of the integral of the error.
    limits : tuple of ndarray, shape (ncontrols,), optional
        Lower and upper limits of the controls.
    """
    structure = analysis.structure
    reference = _Reference(analysis, structure.extension, integral)
    z = ca.vertcat(analysis.equations.x, reference.w)
    wanted = []
    for j, flag in enumerate(structure.flags):
        measured = ca.substitute(flag, structure.z, z)
        wanted.append(_closing(reference, j, measured, list(gains[j]), integral))
    last = ca.vertcat(*wanted)
    mu = _controls(analysis, z, last)
    errors = _errors(analysis, reference)
    if limits is not None:
        roots = [np.abs(np.roots([1.0, *row[::-1]])) for row in gains]
        mu = limited_controls(analysis, z, mu, limits, _QUICK * max(float(row.max()) for row in roots))
        if integral:
            missing = last - _at(structure.last, analysis, z, mu)
            errors += ca.vertcat(*(row.min() / gain[0] for row, gain in zip(roots, gains, strict=True))) * missing
    u = _at(structure.controls, analysis, z, mu)
    if limits is not None:
        u = ca.fmin(ca.fmax(u, ca.DM(limits[0])), ca.DM(limits[1]))
    rates = _at(structure.rates, analysis, z, mu)[structure.nstates :]
    return _tapes(analysis, reference, u, ca.vertcat(rates, errors), structure.orders, structure.extension)


def law_without_states(
    analysis: Analysis, gains: Sequence[Sequence[float]], integral: bool, name: str
) -> LawExpressions:
    """Law that computes the states of the extension from the references and the states of the plant."""
    structure = analysis.structure
    counts, chosen = _closed(analysis, name)
    reference = _Reference(analysis, 0, integral)
    known = analysis.equations.x
    symbols = structure.z[: structure.nstates]
    closed: dict[int, list[ca.SX]] = {}

    def derivative(j: int, order: int) -> ca.SX:
        """Derivative of a closed output as its error equation demands it."""
        rows = closed[j]
        while len(rows) <= order:
            rows.append(_later(reference, j, rows, list(gains[j]), integral, counts[j]))
        return rows[order]

    for entry, rows in zip(structure.rounds, chosen, strict=True):
        for i in rows:
            j = entry.rows[i]
            if j not in closed:
                closed[j] = ca.vertsplit(ca.substitute(structure.flags[j][: counts[j]], symbols, known))
        wanted = ca.vertcat(*(derivative(entry.rows[i], entry.orders[entry.rows[i]]) for i in rows))
        matrix, drift = (ca.substitute(part, symbols, known) for part in (entry.matrix[rows, :], entry.drift[rows]))
        w = ca.inv_minor(matrix) @ (wanted - drift)
        known = ca.vertcat(known, w)
        symbols = ca.vertcat(symbols, entry.states)
    for j, flag in enumerate(structure.flags):
        if j not in closed:
            closed[j] = ca.vertsplit(ca.substitute(flag, symbols, known))
    v = ca.vertcat(*(derivative(j, r) for j, r in enumerate(structure.orders)))
    mu = _controls(analysis, known, v)
    u = _at(structure.controls, analysis, known, mu)
    return _tapes(analysis, reference, u, _errors(analysis, reference), counts, 0)


def _errors(analysis: Analysis, reference: _Reference) -> ca.SX:
    """Rates of the integrals: the errors of the flat outputs."""
    if not reference.integrals.numel():
        return ca.SX(0, 1)
    return analysis.equations.flat - ca.vertcat(*(row[0] for row in reference.rows))


def check_law_along(analysis: Analysis, z: Array, times: Array, name: str) -> None:
    """Raise if a law without states is nearly singular at states (nz, n) of the extended plant along a plan.

    Raises
    ------
    ValueError
        With the time at which the influence of the extension on the outputs that
        determine it is below 0.1 of its maximum, or has another sign.
    """
    structure = analysis.structure
    for entry, rows in zip(structure.rounds, _closed(analysis, name)[1], strict=True):
        tape = tape_of((structure.z, structure.p), entry.matrix[rows, :], matrix=True)
        matrices = np.broadcast_to(tape(z, analysis.equations.values[:, None]), (len(rows), len(rows), times.size))
        found = np.linalg.det(np.moveaxis(matrices, -1, 0))
        share = found / found[np.argmax(np.abs(found))]
        k = int(np.argmin(share))
        if share[k] < _REGULAR:
            raise ValueError(
                f"quasi_static must be False for this plan of {name}: the states of its extension are determined too "
                f"weakly at {times[k]:.6g} s, by {share[k]:.3g} of the maximum along the plan instead of at least "
                f"{_REGULAR:g}; use the law with states, or at= with a state of the plan in flat_system"
            )


def _tapes(
    analysis: Analysis, reference: _Reference, u: ca.SX, rates: ca.SX, counts: tuple[int, ...], extension: int
) -> LawExpressions:
    equations = analysis.equations
    arguments = (reference.column, equations.x, reference.own, equations.p)
    return LawExpressions(tape_of(arguments, u), tape_of(arguments, rates), counts, extension)


def _closing(reference: _Reference, j: int, measured: ca.SX, gains: list[float], integral: bool) -> ca.SX:
    """Highest derivative that the error equation demands, from all lower ones."""
    rows = ca.vertsplit(measured)
    return _later(reference, j, rows, gains, integral, len(rows))


def _later(reference: _Reference, j: int, rows: list[ca.SX], gains: list[float], integral: bool, count: int) -> ca.SX:
    """Next derivative of an output whose error satisfies its equation of order `count`."""
    order = len(rows)
    shift = order - count
    desired = reference.rows[j]
    value = desired[order]
    for k, gain in enumerate(gains):
        i = k - int(integral) + shift
        if i < 0:
            value -= gain * reference.integrals[j]
        else:
            value -= gain * (rows[i] - desired[i])
    return value


def _at(expression: ca.SX, analysis: Analysis, z: ca.SX, mu: ca.SX) -> ca.SX:
    structure = analysis.structure
    return ca.substitute(expression, ca.vertcat(structure.z, structure.mu), ca.vertcat(z, mu))


def _controls(analysis: Analysis, z: ca.SX, last: ca.SX) -> ca.SX:
    """Controls of the extended plant for the highest derivatives."""
    structure = analysis.structure
    influence = ca.jacobian(structure.last, structure.mu)
    if ca.depends_on(influence, structure.mu):
        raise ValueError(
            f"{analysis.equations.name} must have highest derivatives that are affine in its controls, or in a "
            "function of each, for a FlatLaw; use TVLQR, or states_and_inputs with a law of your own"
        )
    idle = ca.substitute(structure.last, structure.mu, ca.SX.zeros(structure.mu.numel()))
    matrix, drift = (ca.substitute(part, structure.z, z) for part in (influence, idle))
    return ca.inv_minor(matrix) @ (last - drift)


def _closed(analysis: Analysis, name: str) -> tuple[tuple[int, ...], list[list[int]]]:
    """Order at which each output is closed, and the rows of each extension that determine its states.

    Raises
    ------
    ValueError
        If a control was prolonged, or a matrix is nearly singular near the
        operating point.
    """
    structure = analysis.structure
    if structure.prolonged:
        raise ValueError(
            f"quasi_static must be False for {name}: a control enters its flat outputs in a way that is not affine"
        )
    counts: dict[int, int] = {}
    chosen = []
    for entry in structure.rounds:
        rows = _regular_rows(analysis, entry, counts, name)
        for i in rows:
            counts.setdefault(entry.rows[i], entry.orders[entry.rows[i]])
        chosen.append(rows)
    return tuple(counts.get(j, r) for j, r in enumerate(structure.orders)), chosen


def _regular_rows(analysis: Analysis, entry: Round, closed: dict[int, int], name: str) -> list[int]:
    """Rows of an extension that determine its states, those of closed outputs among them."""
    structure = analysis.structure
    rank = entry.states.numel()
    fixed = [i for i, j in enumerate(entry.rows) if j in closed]
    free = [i for i in range(len(entry.rows)) if i not in fixed]
    tape = tape_of((structure.z, structure.p), entry.matrix)
    nz = structure.z.numel()
    centre, scales = structure.point[:nz], structure.scales[:nz]
    best: list[tuple[float, list[int]]] = []
    for region in (0.5, 0.15, 0.05, 0.005):
        points = np.column_stack(list(nearby(centre, scales, region)))
        values = tape(points, analysis.equations.values[:, None]).reshape(len(entry.rows), rank, -1)
        best = []
        for extra in combinations(free, rank - len(fixed)):
            rows = sorted([*fixed, *extra])
            best.append((steadiness(values[rows]), rows))
        if max(best)[0] > _REGULAR:
            return max(best)[1]
    raise ValueError(
        f"quasi_static must be False for {name}: the states of its extension are not determined by the errors near the "
        "operating point"
    )
