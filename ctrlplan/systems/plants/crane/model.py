"""Nonlinear model of the crane: equations of motion (13) and (14).

z points down. The rope leaves a drum of radius b on the trolley; R is its length
from the point of tangency, theta its angle from the vertical. Formulas accept
numbers, arrays, Taylor series and symbols.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_finite
from ctrlplan._types import Array
from ctrlplan.systems.plants.crane.parameters import CraneParameters, Numbers
from ctrlplan.systems.series import Quantity
from ctrlplan.traits import declare

Params = Mapping[str, float] | None

STATES = ("D", "R", "theta", "D_d1", "R_d1", "theta_d1")
OUTPUTS = ("x", "z", "D", "R", "theta", "x_d1", "z_d1", "D_d1", "R_d1", "theta_d1", "T")


def iosystem(crane: CraneParameters, name: str = "crane", *, wind: bool = False) -> ct.NonlinearIOSystem:
    """Nonlinear model of the crane, equations (13) and (14).

    States: D, R [m], theta [rad] and their derivatives D_d1, R_d1, theta_d1.
    Inputs: F [N] on the trolley, C [N m] on the drum; with `wind` also wind [N],
    the horizontal force on the load along x. Outputs: x, z, D, R, theta, x_d1,
    z_d1, D_d1, R_d1, theta_d1 and the tension T [N]. Parameters given to a
    simulation (``params={"load_mass": 1000.0}``) override those of the model
    only, as for a payload that is unknown to the controller.

    Parameters
    ----------
    name : str, optional
        Name of the block.
    wind : bool, optional
        Whether the block has the input wind.

    Returns
    -------
    control.NonlinearIOSystem
        In continuous time.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> crane = cp.plants.Crane()
    >>> plant, start = crane.iosystem(), crane.equilibrium(0.0, 10.0)[0]
    >>> pids = [crane.trolley_pid(), crane.hoist_pid()]
    >>> loop = ct.interconnect([*pids, plant], inputs=["D_ref", "R_ref"], outputs=plant.output_labels)
    >>> response = cp.simulate(loop, [0.0, 1.0], [-0.25, 10.0], [0.0, 0.0, 0.0, 0.0, *start])
    >>> response.outputs["z"].round(6).tolist()
    [10.0, 10.0]
    """
    block = ct.nlsys(
        partial(update, crane),
        partial(output, crane),
        states=list(STATES),
        inputs=["F", "C", "wind"] if wind else ["F", "C"],
        outputs=list(OUTPUTS),
        name=name,
    )
    return declare(block, feedthrough=feedthrough(2 + wind))


def equilibrium(crane: CraneParameters, x: float, z: float) -> tuple[Array, Array]:
    """Equilibrium: state and inputs (F, C) with the load at (x, z).

    Parameters
    ----------
    x, z : float
        Position of the load [m].

    Returns
    -------
    state : ndarray, shape (6,)
        D, R, theta and their derivatives.
    inputs : ndarray, shape (2,)
        F [N] and C [N m].

    Raises
    ------
    ValueError
        If z is not positive: the load hangs below the trolley.
    """
    x, z = checked_finite(x, "x"), checked_finite(z, "z", above=0.0)
    state = np.array([x - crane.drum_radius, z, 0.0, 0.0, 0.0, 0.0])
    return state, np.array([0.0, -crane.drum_radius * crane.load_mass * crane.gravity])


def accelerations(
    crane: CraneParameters, state: Quantity, force: Quantity, torque: Quantity, wind: Quantity = 0.0
) -> tuple[Quantity, Quantity, Quantity, Quantity]:
    """D'', R'', theta'' and the tension T, solved from (13) and (14).

    Parameters
    ----------
    state : array_like, shape (6, ...)
        D, R [m], theta [rad] and their derivatives.
    force, torque, wind : array_like, shape (...)
        F [N], C [N m], and the horizontal force on the load [N].

    Returns
    -------
    tuple of four ndarray, shape (...)
        In m/s^2, m/s^2, rad/s^2 and N.
    """
    return solved(crane.numbers(), crane.rope_wrap, state, force, torque, wind)


def energy(crane: CraneParameters, state: ArrayLike) -> Array:
    """Mechanical energy [J] of states (6, ...).

    The potential energy is 0 at z = 0. The speed of the drum is R'/b, with `rope_wrap` R'/b - theta'.

    Parameters
    ----------
    state : array_like, shape (6, ...)
        D, R [m], theta [rad] and their derivatives.

    Returns
    -------
    ndarray, shape (...)
        Kinetic and potential energy [J].
    """
    values = np.asarray(state, dtype=float)
    m, trolley, inertia, b, _, _, g = crane.numbers()
    _, z, x_rate, z_rate = load(b, values)
    drum = values[4] / b - (values[5] if crane.rope_wrap else 0.0)
    kinetic = 0.5 * (m * (x_rate**2 + z_rate**2) + trolley * values[3] ** 2 + inertia * drum**2)
    return kinetic - m * g * z


def update(crane: CraneParameters, t: float, state: Array, inputs: Array, params: Params) -> Array:
    """Derivatives of the states, in the form of `control.nlsys`."""
    d2, r2, theta2, _ = solved(crane.numbers(params), crane.rope_wrap, state, *_forces(inputs))
    return np.array([state[3], state[4], state[5], d2, r2, theta2])


def output(crane: CraneParameters, t: float, state: Array, inputs: Array, params: Params) -> Array:
    """`OUTPUTS`, in the form of `control.nlsys`."""
    numbers = crane.numbers(params)
    x, z, x_rate, z_rate = load(numbers[3], state)
    tension = solved(numbers, crane.rope_wrap, state, *_forces(inputs))[3]
    return np.array([x, z, state[0], state[1], state[2], x_rate, z_rate, state[3], state[4], state[5], tension])


def feedthrough(ninputs: int) -> NDArray[np.bool_]:
    """Direct feedthrough (noutputs, ninputs): from forces and torque to the tension only."""
    found = np.zeros((len(OUTPUTS), ninputs), dtype=bool)
    found[OUTPUTS.index("T")] = True
    return found


def solved(
    numbers: Numbers, rope_wrap: bool, state: Quantity, force: Quantity, torque: Quantity, wind: Quantity
) -> tuple[Quantity, Quantity, Quantity, Quantity]:
    """D'', R'', theta'' and T for given parameters."""
    m, trolley, inertia, b, f1, f2, g = numbers
    _, r, theta, d_rate, r_rate, rate = (state[i] for i in range(6))
    s, c = np.sin(theta), np.cos(theta)
    # Each acceleration is linear in T; the first equation of motion then gives T.
    d0, d1 = (force - f1 * d_rate) / trolley, s / trolley
    push = wind / m
    swing = push * c - g * s - 2.0 * r_rate * rate + b * rate * rate
    t0, t1 = (swing - c * d0) / r, -c * d1 / r
    along = push * s + g * c + r * rate * rate
    if rope_wrap:
        r0, r1 = b / inertia * (torque - f2 * (r_rate / b - rate)), b * b / inertia
        tension = (along - s * d0 - r0) / (s * d1 + r1 + 1.0 / m)
        turning = t0 + t1 * tension
        return d0 + d1 * tension, r0 + r1 * tension + b * turning, turning, tension
    r0, r1 = b / inertia * (torque - f2 * r_rate / b), b * b / inertia
    tension = (along - s * d0 - r0 + b * t0) / (s * d1 + r1 + 1.0 / m - b * t1)
    return d0 + d1 * tension, r0 + r1 * tension, t0 + t1 * tension, tension


def load(b: float, state: Quantity) -> tuple[Quantity, Quantity, Quantity, Quantity]:
    """x, z and their derivatives for a state, with the drum radius b."""
    d, r, theta, d_rate, r_rate, rate = (state[i] for i in range(6))
    s, c = np.sin(theta), np.cos(theta)
    x, z = r * s + d + b * c, r * c - b * s
    x_rate = r_rate * s + r * rate * c + d_rate - b * rate * s
    z_rate = r_rate * c - r * rate * s - b * rate * c
    return x, z, x_rate, z_rate


def _forces(inputs: Array) -> tuple[float, float, float]:
    """F, C and the wind, 0 if it is not an input."""
    return inputs[0], inputs[1], inputs[2] if inputs.shape[0] > 2 else 0.0
