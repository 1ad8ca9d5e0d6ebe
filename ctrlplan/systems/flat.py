"""Tracking law of flat plants: linearise by the flat output's flag, then place the poles of the error.

Equations (9)-(11) of the paper, (11) corrected: the sum starts at 0 and is subtracted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import control.flatsys as fs
import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories import derivative_name
from ctrlplan.trajectories.common import checked_labels

Array = NDArray[np.float64]

_PROBES = 8
"""Points of each kind at which the maps are looked at."""

_SAME = 1e-6
"""Relative difference up to which numbers count as equal, and singular values as 0."""


def create_flat_iosystem(
    flat_system: fs.FlatSystem,
    poles: Sequence[Any],
    name: str = "flat_law",
    *,
    labels: Sequence[str] | str | None = None,
) -> ct.NonlinearIOSystem:
    r"""Law under which flat outputs follow their plan, (9)-(11) corrected.

    With y_1, ..., y_1^(r_1), y_2, ... the flag of the flat outputs,

    .. math:: v_j = y_{d,j}^{(r_j)} - \sum_{k=0}^{r_j - 1} \sigma_{j,k}\,(y_j^{(k)} - y_{d,j}^{(k)}),
        \qquad s^{r_j} + \sum_k \sigma_{j,k} s^k = \prod_k (s - p_{j,k}),

    and u is what `flat_system.reverse` gives for the flag with v_j in the place
    of y_j^(r_j). Plant and law together are chains of r_j integrators, on which
    the errors obey the linear equation with the poles p_j.

    No states. Inputs: of each flat output in turn the references {label}_ref,
    {label}_ref_d1, ... up to order r_j, as `create_source_iosystem` puts them
    out with ``suffix="_ref"``; then the plant's states by name. Outputs: the
    plant's inputs by name.

    Parameters
    ----------
    flat_system : control.flatsys.FlatSystem
        Plant that static feedback linearises, in continuous time. The flag of
        flat output j has r_j + 1 entries, of which y_j, ..., y_j^(r_j - 1) are
        functions of the state alone, and the r_j add up to the number of states.
    poles : sequence of sequences of complex
        For each flat output r_j poles [rad/s], closed under conjugation and
        with negative real parts; one flat sequence where there is one flat output.
    name : str, optional
        Name of the block.
    labels : sequence of str, optional
        Names of the flat outputs: unless given, those of the plant's outputs
        where these are the flat outputs and are named, else y, or y1, y2, ...

    Returns
    -------
    control.NonlinearIOSystem
        Without states and of any time base.

    Raises
    ------
    TypeError
        If `flat_system` is no `control.flatsys.FlatSystem`, or poles or labels are of
        a wrong kind.
    ValueError
        If static feedback does not linearise `flat_system`: a derivative below
        the last depends on an input (the message says which), the decoupling
        matrix is singular, or the flags are too short; if `forward`, `reverse`
        and the plant's equations do not belong together; or if poles or labels
        are wrong.

    Notes
    -----
    The plant's maps are looked at in a few states, drawn at random from a fixed
    seed and from `reverse`, and in the zero state where it is not singular: a
    plant is refused for what is seen there, and otherwise taken at its word.

    References are of the flat outputs. Those of a `LinearFlatSystem` are chosen
    by python-control and are its outputs only up to a factor or worse.

    The law keeps the parameters `flat_system` has now: a loop simulated with
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
    >>> abs(found.outputs.ravel() - plan([0.0, 0.5, 1.0])).max() < 1e-7
    True
    """
    plant = _checked_plant(flat_system)
    probes = _probes(plant)
    names = _flat_labels(plant, probes, labels)
    _check_linearises(plant, probes, names)
    orders = probes[0].orders
    gains = _gains(poles, orders)
    states, nstates = list(plant.system.state_labels), plant.nstates
    references = [
        derivative_name(f"{label}_ref", k) for label, r in zip(names, orders, strict=True) for k in range(r + 1)
    ]
    if shared := sorted(set(references) & set(states)):
        raise ValueError(f"labels must not give references the names of states, got {', '.join(shared)}")

    def out(t: float, x: Any, u: Any, params: dict[str, Any]) -> Array:
        measured = plant.forward(u[len(references) : len(references) + nstates], plant.idle)
        flag, first = [], 0
        for row, sigma in zip(measured, gains, strict=True):
            r = len(sigma)
            planned = u[first : first + r + 1]
            v = planned[r] - sum(sigma[k] * (row[k] - planned[k]) for k in range(r))
            flag.append(np.array([*row[:r], v]))
            first += r + 1
        return plant.reverse(flag)[1]

    def out_but_at_zero(t: float, x: Any, u: Any, params: dict[str, Any]) -> Array:
        # Blocks are first evaluated with all inputs zero, where this plant is singular.
        return out(t, x, u, params) if any(u) else np.zeros(plant.ninputs)

    at_zero = _attempt(lambda: out(0.0, np.zeros(0), np.zeros(len(references) + nstates), {}))
    return ct.nlsys(
        None,
        out_but_at_zero if at_zero is None else out,
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
        raise ValueError(f"poles must be {count} for {count} derivatives, got {given.tolist()}{where}")
    if not np.isfinite(given).all() or not (given.real < 0.0).all():
        raise ValueError(f"poles must be finite with negative real parts, got {given.tolist()}{where}")
    # A polynomial is real exactly where its roots are closed under conjugation.
    coefficients = np.poly(given)
    if (np.abs(coefficients.imag) > 1e-9 * np.poly(-np.abs(given))).any():
        raise ValueError(f"poles must be closed under conjugation, got {given.tolist()}{where}")
    return tuple(coefficients.real[:0:-1].tolist())


def _gains(poles: Sequence[Any], orders: Sequence[int]) -> list[tuple[float, ...]]:
    """Coefficients of each flat output's polynomial."""
    if np.ndim(poles[0]) == 0 if len(orders) == 1 and len(poles) else False:
        return [hurwitz_coefficients(poles, orders[0])]
    if len(poles) != len(orders):
        raise ValueError(f"poles must be one sequence for each of {len(orders)} flat outputs, got {poles!r}")
    return [hurwitz_coefficients(p, r, f" in poles[{j}]") for j, (p, r) in enumerate(zip(poles, orders, strict=True))]
