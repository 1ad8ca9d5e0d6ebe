"""Flatness of the crane: states, tension and inputs from the jet of the load, (15a-d).

The angle of (15c) is computed as theta = atan2(-x'', g - z'').
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._types import Array
from ctrlplan.systems import series
from ctrlplan.systems.plants.closed_form import ClosedFormFlatSystem
from ctrlplan.systems.plants.crane import model
from ctrlplan.systems.plants.crane.parameters import CraneParameters, Numbers
from ctrlplan.systems.plants.crane.rope import check_below, check_taut
from ctrlplan.systems.plants.parameters import defaults_of
from ctrlplan.systems.series import Taylor
from ctrlplan.traits import declare
from ctrlplan.trajectories import Extrema, Trajectory

if TYPE_CHECKING:
    from ctrlplan.systems.plants.crane.crane import Crane

FLAT_LABELS = model.SIGNALS.flat_outputs
ORDERS = model.SIGNALS.orders


def closed_form(crane: Crane, name: str, at: Mapping[str, float]) -> ClosedFormFlatSystem:
    """Crane as a flat system with the flat outputs x and z, by (15a-d).

    States: D, R, theta, D_d1, R_d1, theta_d1. Inputs: F and C. Outputs: x, z, D,
    R, theta, x_d1, z_d1, D_d1, R_d1, theta_d1, T. The orders are (4, 4), with an
    extension of two states, the tension and its derivative. The maps are those
    of `quantities`; parameters given to `forward` and `reverse` override those
    of the crane.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> flat = cp.plants.Crane().flat_system()
    >>> x, u = flat.reverse([[2.0, 0.0, 0.0, 0.0, 0.0], [10.0, 0.0, 0.0, 0.0, 0.0]])
    >>> x[:2].tolist(), u.tolist()
    ([1.75, 10.0], [0.0, -1226.25])
    """
    system = ClosedFormFlatSystem(
        crane,
        partial(forward, crane),
        partial(reverse, crane),
        partial(model.update, crane),
        partial(model.output, crane),
        orders=ORDERS,
        flat_labels=FLAT_LABELS,
        states=model.STATES,
        inputs=("F", "C"),
        outputs=model.OUTPUTS,
        name=name,
        at=at,
        params=defaults_of(crane),
        quantities=partial(quantities, crane),
    )
    return declare(system, feedthrough=model.feedthrough(model.OUTPUTS, 2))


def quantities(crane: CraneParameters, jet: ArrayLike) -> dict[str, Array]:
    """States, tension and inputs from the jet of the load, (15a-d).

    Parameters
    ----------
    jet : array_like, shape (order + 1, 2, ...)
        Derivatives of x and z. Order 2 gives positions and tension, order 3
        also their first derivatives, order 4 also the inputs.

    Returns
    -------
    dict of str to ndarray
        D, R, theta, T; with order 3 also D_d1, R_d1, theta_d1, T_d1; with
        order 4 also D_d2, R_d2, theta_d2, T_d2, F, C. In m, rad, N, N m and s.

    Raises
    ------
    ValueError
        If the order is below 2; if g - z'' is not positive everywhere, since the rope
        cannot push, or the rope length R is not, since the load must hang below the
        trolley.
    """
    values = np.asarray(jet, dtype=float)
    if values.ndim < 2 or values.shape[1] != 2 or len(values) < 3:
        raise ValueError(f"jet must have shape (order + 1, 2, ...) with order at least 2, got {values.shape}")
    return checked_formulas(crane.numbers(), crane.rope_wrap, values)


def forward(
    crane: CraneParameters, x: Sequence[Array], u: Sequence[Array], params: Mapping[str, float] | None = None
) -> list[Array]:
    """Flag of a state and constant inputs: x and z with four derivatives."""
    numbers = crane.numbers(params)
    given = [np.asarray(value, dtype=float) for value in x]
    state = [Taylor(value[None]) for value in given]
    force, torque = (np.asarray(value, dtype=float) for value in u)
    for _ in range(3):  # each iteration gives one more derivative of the accelerations
        trolley = model.by_force(numbers, state, force)
        second = model.solved(numbers, crane.rope_wrap, state, trolley, torque, 0.0)[:3]
        rates = [Taylor.integral(start, rate) for start, rate in zip(given[3:], second, strict=True)]
        state = [Taylor.integral(start, rate) for start, rate in zip(given[:3], rates, strict=True)] + rates
    return [series.to_jet(position.terms) for position in model.load(numbers[3], state)[:2]]


def reverse(
    crane: CraneParameters, flag: Sequence[ArrayLike], params: Mapping[str, float] | None = None
) -> tuple[Array, Array]:
    """State (6, ...) and inputs (2, ...) from the flags of x and z, each (5, ...)."""
    jet = np.stack([np.asarray(row)[: order + 1] for row, order in zip(flag, ORDERS, strict=True)], axis=1)
    found = checked_formulas(crane.numbers(params), crane.rope_wrap, jet)
    return np.stack([found[name] for name in model.STATES]), np.stack([found["F"], found["C"]])


def checked_formulas(numbers: Numbers, rope_wrap: bool, jet: Array) -> dict[str, Array]:
    """`formulas`, for numbers with the checks of a taut rope and of its length."""
    if jet.dtype == object:
        return formulas(numbers, rope_wrap, jet)
    check_taut(numbers[6] - jet[2, 1])
    found = formulas(numbers, rope_wrap, jet)
    if jet.any():  # blocks are evaluated at zero signals, where R = 0
        check_below(found["R"])
    return found


def formulas(numbers: Numbers, rope_wrap: bool, jet: Array) -> dict[str, Array]:
    """(15a-d) and their derivatives as far as the jet determines them, numeric or symbolic."""
    m, trolley, inertia, b, f1, f2, g = numbers
    x, z = series.from_jet(jet[:, 0]), series.from_jet(jet[:, 1])
    across, fall = series.derivative(x, 2), series.derivative(z, 2)
    hanging = -fall
    hanging[0] += g
    squares = series.multiply(across, across) + series.multiply(hanging, hanging)
    pull, theta = series.sqrt(squares), series.arctan2(-across, hanging, squares)
    r = series.divide(series.multiply(z, pull) - b * across, hanging)
    d = x[: len(pull)] - series.divide(b * pull - series.multiply(z, across), hanging)
    jets = {
        "D": series.to_jet(d),
        "R": series.to_jet(r),
        "theta": series.to_jet(theta),
        "T": m * series.to_jet(pull),
    }
    out = {name: values[0] for name, values in jets.items()}
    for nu in range(1, len(pull)):
        out |= {f"{name}_d{nu}": values[nu] for name, values in jets.items()}
    if len(pull) > 2:
        drum, drum_rate = out["R_d2"] / b, out["R_d1"] / b
        if rope_wrap:
            drum, drum_rate = drum - out["theta_d2"], drum_rate - out["theta_d1"]
        out["F"] = trolley * out["D_d2"] + f1 * out["D_d1"] + m * jet[2, 0]
        out["C"] = inertia * drum + f2 * drum_rate - b * out["T"]
    return out


def check(crane: CraneParameters, plan: Trajectory) -> None:
    """Raise for a plan of the load that the crane cannot follow.

    g - z'', the tension T and the rope length R must be positive over the whole
    interval, also between samples: the first two by the exact extrema of z'',
    R by certified bounds.

    Parameters
    ----------
    plan : Trajectory
        Plan of x and z.

    Raises
    ------
    ValueError
        If one of them is not; with its limit, its minimum and the time.
    """
    check_axes(plan)
    fall = plan.extrema(2)
    check_taut(crane.gravity - float(fall.maximum[1]), f" at {fall.time_max[1]:.4g} s (tension T <= 0)")
    if not plan.duration:
        shortest, time = float(min(plan.initial[1], plan.final[1])), plan.start
    else:
        shortest, time = _shortest_rope(crane, plan, fall)
    check_below(shortest, f" at {time:.4g} s")


def check_axes(plan: Trajectory) -> None:
    """Raise unless a plan has two axes, x and z of the load."""
    if plan.naxes != len(FLAT_LABELS):
        raise ValueError(f"a plan of the load must have the axes x and z, got {plan.naxes} axes")


def _shortest_rope(crane: CraneParameters, plan: Trajectory, acceleration: Extrema) -> tuple[float, float]:
    """Lower bound of R over a plan and a time; the minimum itself if it is not positive or not bounded."""
    g, b = crane.gravity, crane.drum_radius
    across = float(max(-acceleration.minimum[0], acceleration.maximum[0]))
    low, high = g - float(acceleration.maximum[1]), g - float(acceleration.minimum[1])
    lowest = plan.extrema()
    # R = z hypot(x'', g - z'')/(g - z'') - b x''/(g - z''), whose first quotient is at least 1.
    if (simple := float(lowest.minimum[1]) - b * across / low) > 0.0:
        return simple, float(lowest.time_min[1])

    def length(jet: Array) -> Array:
        across, hanging = jet[2, 0], g - jet[2, 1]
        return (jet[0, 1] * np.hypot(across, hanging) - b * across) / hanging

    depth = float(plan.peak()[1])
    pull = math.hypot(across, high)
    # Bounds of dR/dz, dR/dx'' and dR/dz'' over the ranges of the plan.
    slopes = np.zeros((3, 2))
    slopes[0, 1] = pull / low
    slopes[2] = (depth + b) / low, depth / low + (depth * pull + b * across) / low**2
    try:
        found = plan.bounds(length, 2, slopes, max_cells=200_000)
    except ValueError:  # too close to a limit for any number of cells
        resolved = plan.extrema_of(length, 2)
        return float(resolved.minimum[0]), float(resolved.time_min[0])
    return (found.lower, found.time_min) if found.minimum > 0.0 else (found.minimum, found.time_min)
