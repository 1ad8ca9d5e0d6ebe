"""Tracking control of flat plants: linearisation by the flag of the flat output, then pole placement.

Equations (9)-(11) of the paper, (11) corrected: the sum starts at 0 and is subtracted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import control as ct
import control.flatsys as fs
import numpy as np

from ctrlplan._renamed import former_signature
from ctrlplan._types import Params, Value
from ctrlplan.flatness.verify import (
    check_linearises,
    checked_plant,
    finite_rows,
    flat_labels,
    planned_probes,
    random_probes,
    warn_of_output,
)
from ctrlplan.trajectories import derivative_name


@former_signature("name", renamed={"flat_system": "flat"})
def create_flat_iosystem(
    flat: fs.FlatSystem,
    poles: Sequence[Value],
    *,
    labels: Sequence[str] | str | None = None,
    suffix: str = "_ref",
    name: str = "flat_law",
) -> ct.NonlinearIOSystem:
    r"""Tracking controller of a flat plant, (9)-(11) corrected.

    With y_1, ..., y_1^(r_1), y_2, ... the flag of the flat outputs,

    .. math:: v_j = y_{d,j}^{(r_j)} - \sum_{k=0}^{r_j - 1} \sigma_{j,k}\,(y_j^{(k)} - y_{d,j}^{(k)}),
        \qquad s^{r_j} + \sum_k \sigma_{j,k} s^k = \prod_k (s - p_{j,k}),

    and u is computed by `flat.reverse` from the flag with v_j in place of
    y_j^(r_j). The closed loop consists of chains of r_j integrators, in which
    the tracking errors satisfy the linear equation with the poles p_j.

    No states. Inputs: for each flat output its references, y_ref, y_ref_d1, ...
    up to order r_j for one called y, as `create_source_iosystem` names its
    outputs with ``suffix="_ref"``; then the states of the plant by name.
    Outputs: the inputs of the plant by name, such as u.

    Parameters
    ----------
    flat : control.flatsys.FlatSystem
        Continuous-time plant that is linearisable by static feedback. The flag of
        flat output j has r_j + 1 entries, of which y_j, ..., y_j^(r_j - 1) are
        functions of the state only; the sum of all r_j is the number of states.
    poles : sequence of sequences of complex
        r_j poles [rad/s] for each flat output, closed under conjugation, with
        negative real parts; a single sequence for a single flat output.
    labels : sequence of str or str, optional
        Names of the flat outputs. Default: the names of the plant's outputs if
        these are the flat outputs and have names, otherwise y, or y1, y2, ...
    suffix : str, optional
        Appended to each label in the names of the references.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.NonlinearIOSystem
        Static, of any time base.

    Raises
    ------
    TypeError
        If `flat` is not a `control.flatsys.FlatSystem`, or poles or labels have
        the wrong type.
    ValueError
        If `flat` is not linearisable by static feedback: a derivative below the
        last depends on an input (the message says which), the decoupling matrix
        is singular, or the flags are too short; if `forward`, `reverse` and the
        equations of the plant are inconsistent; or if poles or labels are
        wrong.

    Warns
    -----
    UserWarning
        If `flat` is a `LinearFlatSystem` whose output is not the flat output that
        python-control has chosen, but a multiple of it, or a sum of its
        derivatives if the plant has zeros, and `labels` is not given.

    Notes
    -----
    The maps are checked at a few states (random ones from a fixed seed, some
    from `reverse`, and the zero state unless it is singular); flatness elsewhere
    is not verified.

    The plant in the loop must have its states as outputs under their names, as
    the plants of `ctrlplan.plants` have. References belong to the flat outputs:
    the flat output of a `LinearFlatSystem` is chosen by python-control and need
    not be its output; its maps are computed here from its matrices in exact
    arithmetic.

    The controller uses the parameters that `flat` has when it is constructed; a
    simulation of the loop with other parameters shows the effect of model errors.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> from ctrlplan.systems.plants.integrator_chain import integrator_chain
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> chain = integrator_chain(2)
    >>> law = create_flat_iosystem(chain, poles=[-3, -4])
    >>> law.input_labels
    ['y_ref', 'y_ref_d1', 'y_ref_d2', 'y', 'y_d1']
    >>> loop = ct.interconnect(
    ...     [cp.create_source_iosystem(plan, 2, suffix="_ref"), law, chain], inputs=0, outputs=["y"]
    ... )
    >>> found = cp.simulate(loop, [0.0, 0.5, 1.0])
    >>> bool(abs(found.outputs - plan(found.time)).max() < 1e-7)
    True
    """
    plant = checked_plant(flat, "flat")
    if labels is None:
        warn_of_output(flat)
    probes = random_probes(plant)
    names = flat_labels(plant, probes, labels)
    check_linearises(plant, probes, names)
    planned = planned_probes(plant, probes[0].orders)
    check_linearises(plant, planned, names)
    orders = probes[0].orders
    gains = _gains(poles, orders)
    references = [
        derivative_name(label + suffix, k) for label, r in zip(names, orders, strict=True) for k in range(r + 1)
    ]
    states = list(plant.system.state_labels)
    if shared := sorted(set(references) & set(states)):
        raise ValueError(f"labels and suffix must not give references the names of states, got {', '.join(shared)}")
    idle = np.zeros(plant.ninputs)

    def law(t: float, x: Value, u: Value, params: Params) -> Value:
        # Entries of the flag below the last derivative do not depend on the input.
        measured = plant.forward(u[len(references) :], idle)
        flag, first = [], 0
        for row, sigma in zip(measured, gains, strict=True):
            r = len(sigma)
            desired = u[first : first + r + 1]
            v = desired[r] - sum(sigma[k] * (row[k] - desired[k]) for k in range(r))
            flag.append(np.array([*row[:r], v]))
            first += r + 1
        return plant.reverse(flag)[1]

    regular = np.concatenate([*planned[0].flag, planned[0].x])

    def law_off_zero(t: float, x: Value, u: Value, params: Params) -> Value:
        # Blocks are first evaluated with all inputs zero, where this plant is singular: the law is evaluated
        # at a regular state instead and multiplied by 0. Without a branch, so that it can be traced.
        idles = math.prod(value == 0.0 for value in u)
        moved = np.empty(regular.size, dtype=u.dtype)
        for i, at in enumerate(regular.tolist()):
            moved[i] = u[i] + idles * at
        return [value * (1.0 - idles) for value in law(t, x, moved, params)]

    zero = np.zeros(len(references) + plant.nstates)
    return ct.nlsys(
        None,
        law_off_zero if finite_rows(law, 0.0, None, zero, {}) is None else law,
        inputs=[*references, *states],
        outputs=list(plant.system.input_labels),
        dt=None,
        name=name,
    )


def hurwitz_coefficients(poles: Sequence[complex], count: int, where: str = "") -> tuple[float, ...]:
    """Coefficients of a monic polynomial with given stable roots.

    Parameters
    ----------
    poles : sequence of complex
        Roots [rad/s], closed under conjugation, with negative real parts.
    count : int
        Required number of poles.
    where : str, optional
        Place of the poles, appended to error messages: `` in poles[1]``.

    Returns
    -------
    tuple of float
        sigma_0, ..., sigma_(count - 1) of s^count + sum of sigma_k s^k, lowest
        order first.

    Raises
    ------
    TypeError
        If poles are not numbers.
    ValueError
        If their number is not `count`, or they are not closed under conjugation,
        not finite or not stable.

    Examples
    --------
    >>> hurwitz_coefficients([-1, -2 + 1j, -2 - 1j], 3)
    (5.0, 9.0, 5.0)
    """
    given = np.asarray(poles)
    if given.dtype.kind not in "iufc":
        raise TypeError(f"poles must be numbers, got {poles!r}{where}")
    if given.shape != (count,):
        raise ValueError(f"poles must be as many as the order of the flat output, {count}, got {given.tolist()}{where}")
    if not np.isfinite(given).all() or not (given.real < 0.0).all():
        raise ValueError(f"poles must be finite with negative real parts, got {given.tolist()}{where}")
    # A polynomial is real exactly where its roots are closed under conjugation.
    coefficients = np.atleast_1d(np.poly(given))
    if (np.abs(coefficients.imag) > 1e-9 * np.poly(-np.abs(given))).any():
        raise ValueError(f"poles must be closed under conjugation, got {given.tolist()}{where}")
    return tuple(coefficients.real[:0:-1].tolist())


def _gains(poles: Value, orders: Sequence[int]) -> list[tuple[float, ...]]:
    """Coefficients of each flat output's polynomial."""
    if not np.iterable(poles):
        raise TypeError(f"poles must be one sequence for each flat output, got {poles!r}")
    rows = list(poles)
    if len(orders) == 1 and all(np.ndim(row) == 0 for row in rows):
        return [hurwitz_coefficients(rows, orders[0])]
    if len(rows) != len(orders):
        raise ValueError(f"poles must be one sequence for each of {len(orders)} flat outputs, got {len(rows)}")
    return [hurwitz_coefficients(p, r, f" in poles[{j}]") for j, (p, r) in enumerate(zip(rows, orders, strict=True))]
