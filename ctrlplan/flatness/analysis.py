"""From a python-control system and its flat outputs to the structure of the flat plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ctrlplan._checks import check_signals
from ctrlplan._types import Array, Params, System
from ctrlplan.flatness.branches import Replacement, branch_at, replaced_input
from ctrlplan.flatness.equations import Equations, FlatOutputs, equations_of
from ctrlplan.flatness.operating_point import At, OperatingPoint, found_point, given_values, scales_at
from ctrlplan.flatness.structure import Plant, Structure, structure_of


@dataclass(frozen=True, eq=False)
class Analysis:
    """Equations of a plant on one branch, and their structure.

    Attributes
    ----------
    equations : Equations
        Equations on the branch of the operating point.
    point : OperatingPoint
        The operating point.
    sides : casadi.SX
        Functions of (x, u, p) that are positive on the branch.
    notes : tuple of str
        Operation of each side.
    entering : casadi.SX
        Functions of the controls by which they enter, which are the controls of the
        structure: of each control itself or, such as tan or a square, of a function.
    structure : Structure
        Orders, extension, derivatives of the flat outputs.
    scales : ndarray
        Scales of states and controls.
    rate : float
        Rate of the dynamics [1/s].
    """

    equations: Equations
    point: OperatingPoint
    sides: ca.SX
    notes: tuple[str, ...]
    entering: ca.SX
    structure: Structure
    scales: Array
    rate: float


def analysed(
    system: System,
    flat_outputs: FlatOutputs,
    *,
    inputs: Sequence[str] | str | None,
    at: At,
    params: Params,
    scales: Mapping[str, float],
) -> tuple[Analysis, Equations]:
    """Structure of a system for given flat outputs, and its equations before the choice of a branch.

    Raises
    ------
    ValueError
        If the equations cannot be analysed, or the system is not flat for these
        outputs (`NotFlatError`).
    """
    known = given_values(at, system.state_labels or (), system.input_labels or (), str(system.name))
    equations = equations_of(system, flat_outputs, inputs, params, known)
    if scales:
        check_signals(tuple(scales), "scales", equations.names, "state or control")
    point = found_point(equations, {k: v for k, v in known.items() if k in equations.names}, scales)
    branch = branch_at(
        (equations.rates, equations.outputs, equations.flat),
        equations.variables,
        (point.x, point.u, equations.values),
        equations.name,
    )
    rates, outputs, flat = branch.expressions
    smooth = replace(equations, rates=rates, outputs=outputs, flat=flat)
    sizes, rate = scales_at(smooth, ca.vertcat(rates, flat), np.concatenate([point.x, point.u]), scales)
    plant, entering = _with_functions(smooth, point, sizes, rate)
    found = Analysis(smooth, point, branch.sides, branch.notes, entering, structure_of(plant), sizes, rate)
    return found, equations


def _with_functions(equations: Equations, point: OperatingPoint, sizes: Array, rate: float) -> tuple[Plant, ca.SX]:
    """Plant with each input that enters through one function of it replaced by that function, and the functions."""
    rates, flat = equations.rates, equations.flat
    mu, controls = (list(ca.vertsplit(equations.u)) for _ in range(2))
    entering = list(ca.vertsplit(equations.u))
    n = len(equations.states)
    centre, sizes = np.concatenate([point.x, point.u]), sizes.copy()
    for k in range(len(equations.inputs)):
        others = ca.vertcat(ca.SX(0, 1), *(mu[i] for i in range(len(mu)) if i != k))
        found = replaced_input((rates, flat), (equations.x, others, equations.p), mu[k], float(point.u[k]))
        if found is not None:
            (rates, flat), replacement = found
            _replace(replacement, k, n, mu, controls, centre, sizes)
            entering[k] = replacement.value
    plant = Plant(
        name=equations.name,
        z=equations.x,
        mu=ca.vertcat(*mu),
        p=equations.p,
        rates=rates,
        flat=flat,
        controls=ca.vertcat(*controls),
        labels=equations.flat_labels,
        point=centre,
        scales=sizes,
        rate=rate,
        values=equations.values,
        equilibrium=point.equilibrium,
    )
    return plant, ca.vertcat(*entering)


def _replace(
    replacement: Replacement, k: int, n: int, mu: list[ca.SX], controls: list[ca.SX], centre: Array, sizes: Array
) -> None:
    """Enter the new input with its value and scale at the operating point."""
    value = ca.Function("value", [mu[k]], [replacement.value, ca.jacobian(replacement.value, mu[k])])
    at, slope = (float(entry) for entry in value(centre[n + k]))
    mu[k], controls[k] = replacement.symbol, replacement.inverse
    size = abs(slope) * sizes[n + k]
    centre[n + k], sizes[n + k] = at, size if size > 0.0 else max(abs(at), 1.0)
