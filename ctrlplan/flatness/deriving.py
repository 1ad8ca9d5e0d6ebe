"""Flat systems from the equations of a plant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from numbers import Real
from typing import TYPE_CHECKING

import control as ct
import numpy as np

from ctrlplan._checks import check_kind, checked_finite, checked_params
from ctrlplan._types import Array, Params, System
from ctrlplan.flatness.derived import DerivedFlatSystem
from ctrlplan.flatness.errors import NotFlatError
from ctrlplan.flatness.linear import brunovsky_outputs
from ctrlplan.symbolic import missing_casadi

if TYPE_CHECKING:
    from ctrlplan.flatness.analysis import Analysis
    from ctrlplan.flatness.equations import Equations, FlatOutputs
    from ctrlplan.flatness.operating_point import At


def flat_system(
    system: System,
    flat_outputs: FlatOutputs | None = None,
    *,
    inputs: Sequence[str] | str | None = None,
    at: At = None,
    params: Params | None = None,
    scales: Mapping[str, float] | None = None,
    name: str | None = None,
) -> DerivedFlatSystem:
    """Flat system derived from the equations of a plant.

    The flat outputs are differentiated along the motion until the inputs appear;
    where these appear in too few independent combinations, a combination becomes
    a state of a dynamic extension. The plant is flat for these outputs if they and
    their derivatives determine all states. The maps are evaluated by Newton's
    method, connected with the operating point. Requires the extra ``fast``.

    Parameters
    ----------
    system : control.NonlinearIOSystem, control.StateSpace or control.TransferFunction
        The plant in continuous time, also an interconnection. Its functions must
        use functions of numpy. Transfer functions must have one input and one output.
    flat_outputs : sequence of str, str or callable, optional
        As many as inputs: names of outputs or states, or a function
        ``h(x, u, params)`` that returns them, named y, or y1, y2, ...; flat_y, ... where
        another signal of the plant has this name. Optional for a linear system: its
        outputs if they are as many as its inputs and flat, otherwise flat outputs of
        its controllability form.
    inputs : sequence of str or str, optional
        The inputs that are controls. The others, such as wind, are constant at
        their values in `at`, or 0. Default: all inputs.
    at : mapping of str to float, or pair (x, u), optional
        Operating point, in part or whole: values of states and inputs. The rest is
        an equilibrium found by Newton's method from 0; give the values that are
        known, since a plant can have several. It selects the branch of the maps
        (the sign of a speed) and of operations that are not smooth (abs, min,
        where). Default: an equilibrium.
    params : mapping of str to float, optional
        Parameters that replace those of the system.
    scales : mapping of str to float, optional
        Typical magnitudes of states and inputs. Default: from the equations.
    name : str, optional
        Name of the system. Default: that of `system`.

    Returns
    -------
    DerivedFlatSystem
        A `control.flatsys.FlatSystem` with the outputs of the plant, its controls
        as inputs, and its scalar parameters, to which the constant inputs are added.

    Raises
    ------
    ImportError
        Without CasADi or mpmath (extra ``fast``).
    TypeError
        If `system` or `flat_outputs` has the wrong type.
    ValueError
        If the plant is not flat for these outputs, with the reason: an output on which
        no input has an effect, outputs that depend on each other, or the dimension of
        the internal dynamics and whether they are stable; if the equations cannot be
        traced, depend on time, contain samples or delays or a nonlinear algebraic
        loop; if names are unknown or numbers differ; or if there is no equilibrium.

    Examples
    --------
    A planar vehicle with two thrusts, with its centre of oscillation as
    flat output:

    >>> import control as ct
    >>> import ctrlplan as cp
    >>> import numpy as np
    >>> def update(t, x, u, params):
    ...     _, _, angle, vx, vy, rate = x
    ...     sine, cosine = np.sin(angle), np.cos(angle)
    ...     return [vx, vy, rate, u[0] * cosine - u[1] * sine, u[0] * sine + u[1] * cosine - 9.81, 2.0 * u[0]]
    >>> states = ["x", "y", "angle", "vx", "vy", "rate"]
    >>> plant = ct.nlsys(update, None, states=states, inputs=["side", "lift"], outputs=states, name="vehicle")
    >>> flat = cp.flat_system(plant, lambda x, u, params: [x[0] - 0.5 * np.sin(x[2]), x[1] + 0.5 * np.cos(x[2])])
    >>> flat.orders, flat.extension
    ((4, 4), 2)
    """
    if missing := missing_casadi():
        raise ImportError(f"flat_system requires CasADi: {missing}")
    from ctrlplan.flatness.analysis import analysed

    plant, own = _state_space(system), checked_params(params)
    for key, value in own.items():
        if isinstance(value, Real):
            checked_finite(value, f"params[{key!r}]")

    def derived(outputs: FlatOutputs) -> DerivedFlatSystem:
        analysis, original = analysed(plant, outputs, inputs=inputs, at=at, params=own, scales=dict(scales or {}))
        return derived_system(analysis, original, name or str(system.name))

    if flat_outputs is not None:
        return derived(flat_outputs)
    rows = _rows(plant, inputs)
    if plant.noutputs == len(rows):
        with suppress(NotFlatError):  # as of a system with zeros
            return derived(list(plant.output_labels))
    return derived(lambda x, u, params: rows @ x)


def derived_system(analysis: Analysis, original: Equations, name: str) -> DerivedFlatSystem:
    """Flat system of an analysed plant."""
    import casadi as ca

    from ctrlplan.flatness.building import maps_of
    from ctrlplan.symbolic.taping import tape_of

    equations = analysis.equations
    maps = maps_of(analysis)
    point = [*analysis.point.x.tolist(), *analysis.point.u.tolist()]
    variables, both = original.variables, ca.vertcat(original.x, original.u)
    tapes = (
        tape_of(variables, original.rates),
        tape_of(variables, original.outputs),
        tape_of(variables, original.flat),
        tape_of(equations.variables, ca.jacobian(equations.rates, both), matrix=True),
    )
    return DerivedFlatSystem(
        maps,
        tapes,
        analysis,
        flat_labels=equations.flat_labels,
        states=equations.states,
        inputs=equations.inputs,
        outputs=original.output_labels,
        operating_point=dict(zip(equations.names, point, strict=True)),
        params=dict(zip(equations.parameters, equations.values.tolist(), strict=True)),
        notes=(*analysis.notes, *_assumptions(analysis, maps.start)),
        name=name,
    )


def _assumptions(analysis: Analysis, start: Array) -> Iterator[str]:
    if not analysis.point.equilibrium:
        yield "the operating point is not an equilibrium"
    if not np.array_equal(start, analysis.structure.point[: start.size]):
        yield "the maps are singular at the operating point and start near it"
    for held in analysis.equations.held:
        yield f"{held} is constant, a parameter"


def _state_space(system: System) -> System:
    """A transfer function as a state-space system."""
    if not isinstance(system, ct.TransferFunction):
        return system
    try:
        return ct.ss(system, name=system.name, inputs=system.input_labels, outputs=system.output_labels)
    except Exception as error:  # python-control converts transfer functions of several inputs with slycot only
        raise TypeError(
            f"system must be a state-space system, as python-control cannot convert {system.name}; use control.ss"
        ) from error


def _rows(system: System, inputs: Sequence[str] | str | None) -> Array:
    """Flat outputs of a linear system as functions of its states, from its controllability form."""
    if not isinstance(system, ct.StateSpace):
        check_kind(system, "system", ct.NonlinearIOSystem, "a python-control system")
        raise TypeError(
            "flat_outputs must be given for a nonlinear system: names of outputs or states, or a function h(x, u, "
            "params); see flat_candidates"
        )
    if not system.nstates:
        raise ValueError(f"system must have states and inputs, got 0 and {system.ninputs} of {system.name}")
    chosen = list(system.input_labels) if inputs is None else [inputs] if isinstance(inputs, str) else list(inputs)
    return brunovsky_outputs(
        system, [list(system.input_labels).index(label) for label in chosen if label in system.input_labels]
    )
