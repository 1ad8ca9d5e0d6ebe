"""Tracking law of flat plants: linearise by the flat output's flag, then place the poles of the error.

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
    r"""Law under which flat outputs follow their plan, (9)-(11) corrected.

    With y_1, ..., y_1^(r_1), y_2, ... the flag of the flat outputs,

    .. math:: v_j = y_{d,j}^{(r_j)} - \sum_{k=0}^{r_j - 1} \sigma_{j,k}\,(y_j^{(k)} - y_{d,j}^{(k)}),
        \qquad s^{r_j} + \sum_k \sigma_{j,k} s^k = \prod_k (s - p_{j,k}),

    and u is what `flat.reverse` gives for the flag with v_j in the place
    of y_j^(r_j). Plant and law together are chains of r_j integrators, on which
    the errors obey the linear equation with the poles p_j.

    No states. Inputs: of each flat output in turn the references, y_ref,
    y_ref_d1, ... up to order r_j for one called y, as `create_source_iosystem`
    names its outputs with ``suffix="_ref"``; then the plant's states by name.
    Outputs: the plant's inputs by name, u of a plant whose input is u.

    Parameters
    ----------
    flat : control.flatsys.FlatSystem
        Plant that static feedback linearises, in continuous time. The flag of
        flat output j has r_j + 1 entries, of which y_j, ..., y_j^(r_j - 1) are
        functions of the state alone, and the r_j add up to the number of states.
    poles : sequence of sequences of complex
        For each flat output r_j poles [rad/s], closed under conjugation and
        with negative real parts; one flat sequence where there is one flat output.
    labels : sequence of str or str, optional
        Names of the flat outputs: unless given, those of the plant's outputs
        where these are the flat outputs and are named, else y, or y1, y2, ...
    suffix : str, optional
        Appended to each label in the names of the references.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.NonlinearIOSystem
        Without states and of any time base.

    Raises
    ------
    TypeError
        If `flat` is no `control.flatsys.FlatSystem`, or poles or labels are of
        a wrong kind.
    ValueError
        If static feedback does not linearise `flat`: a derivative below
        the last depends on an input (the message says which), the decoupling
        matrix is singular, or the flags are too short; if `forward`, `reverse`
        and the plant's equations do not belong together; or if poles or labels
        are wrong.

    Warns
    -----
    UserWarning
        If `flat` is a `LinearFlatSystem` whose output is not its flat output,
        which python-control chose, and `labels` does not name it: a multiple of it,
        or, where the plant has zeros, a sum of its derivatives.

    Notes
    -----
    The plant's maps are looked at in a few states, drawn at random from a fixed
    seed and from `reverse`, and in the zero state where it is not singular: a
    plant is refused for what is seen there, and otherwise taken at its word.

    The plant of the loop must put out its states by their names, as those of
    `ctrlplan.plants` do. References are of the flat outputs: that of a
    `LinearFlatSystem` is chosen by python-control and need not be its output; its
    maps are computed here from its matrices, without rounding.

    The law keeps the parameters `flat` has now: a loop simulated with
    others shows what an inexact model does.

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
        # Below the last derivative the flag does not depend on the input.
        measured = plant.forward(u[len(references) :], idle)
        flag, first = [], 0
        for row, sigma in zip(measured, gains, strict=True):
            r = len(sigma)
            wanted = u[first : first + r + 1]
            v = wanted[r] - sum(sigma[k] * (row[k] - wanted[k]) for k in range(r))
            flag.append(np.array([*row[:r], v]))
            first += r + 1
        return plant.reverse(flag)[1]

    regular = np.concatenate([*planned[0].flag, planned[0].x])

    def law_off_zero(t: float, x: Value, u: Value, params: Params) -> Value:
        # Blocks are first evaluated with all inputs zero, where this plant is singular: there the law is taken
        # elsewhere, and is 0. Without a condition, so that it can be traced.
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
    """Coefficients of the monic polynomial with these roots, lowest first.

    Parameters
    ----------
    poles : sequence of complex
        Roots [rad/s], closed under conjugation, with negative real parts.
    count : int
        How many there must be.
    where : str, optional
        Put behind what was given in an error's message: `` in poles[1]``.

    Returns
    -------
    tuple of float
        sigma_0, ..., sigma_(count - 1) of s^count + sum of sigma_k s^k.

    Raises
    ------
    TypeError
        If poles are not numbers.
    ValueError
        If they are not `count`, not closed under conjugation, not finite, or
        not stable.

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
