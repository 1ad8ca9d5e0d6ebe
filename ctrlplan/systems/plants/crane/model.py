"""Nonlinear model of the crane: equations of motion (13) and (14).

z points down. The rope leaves a drum of radius b on the trolley; R is its length
from the point of tangency, theta its angle from the vertical. Formulas accept
numbers, arrays, Taylor series and symbols.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_finite
from ctrlplan._types import Array
from ctrlplan.systems.plants.crane.parameters import CraneParameters, Numbers
from ctrlplan.systems.plants.parameters import defaults_of, overridden
from ctrlplan.systems.plants.plant import Signals
from ctrlplan.systems.series import Quantity
from ctrlplan.traits import declare

Params = Mapping[str, float] | None
Drive = Literal["force", "velocity"]
"""What the trolley is commanded by."""

STATES = ("D", "R", "theta", "D_d1", "R_d1", "theta_d1")
OUTPUTS = ("x", "z", "D", "R", "theta", "x_d1", "z_d1", "D_d1", "R_d1", "theta_d1", "T")
SIGNALS = Signals(
    states=dict(zip(STATES, ("m", "m", "rad", "m/s", "m/s", "rad/s"), strict=True)),
    inputs={"F": "N", "C": "N m"},
    outputs={"x": "m", "z": "m", "x_d1": "m/s", "z_d1": "m/s", "T": "N"},
    flat_outputs=("x", "z"),
    orders=(4, 4),
    at={"R": 10.0},
)
OF_VELOCITY_DRIVE = ("F", "sway_frequency")
"""Outputs of a crane with velocity drive in addition."""


def iosystem(
    crane: CraneParameters, name: str = "crane", *, wind: bool = False, drive: Drive = "force", drive_lag: float = 0.1
) -> ct.NonlinearIOSystem:
    """Nonlinear model of the crane, equations (13) and (14).

    States: D, R [m], theta [rad] and their derivatives D_d1, R_d1, theta_d1.
    Inputs: F [N] on the trolley, C [N m] on the drum; with `wind` also wind [N],
    the horizontal force on the load along x. Outputs: x, z, D, R, theta, x_d1,
    z_d1, D_d1, R_d1, theta_d1 and the tension T [N]. Parameters given to a
    simulation (``params={"load_mass": 1000.0}``) override those of the model
    only, as for a payload that is unknown to the controller.

    With a velocity drive, as a frequency converter, the input v_cmd [m/s] takes the
    place of F: the speed of the trolley follows it with a first-order lag,
    D'' = (v_cmd - D')/lag, whatever the load. The force F [N] that this takes and
    the natural frequency sway_frequency = sqrt(g/R) [rad/s] are outputs.

    Parameters
    ----------
    name : str, optional
        Name of the block.
    wind : bool, optional
        Whether the block has the input wind.
    drive : {"force", "velocity"}, optional
        What commands the trolley.
    drive_lag : float, optional
        Time constant of the velocity drive [s], above 0; a simulation parameter
        of that name overrides it.

    Returns
    -------
    control.NonlinearIOSystem
        In continuous time.

    Raises
    ------
    ValueError
        If `drive` is unknown, or `drive_lag` is not above 0.

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
    lag = checked_drive(drive, drive_lag)
    outputs = OUTPUTS if lag is None else (*OUTPUTS, *OF_VELOCITY_DRIVE)
    block = ct.nlsys(
        partial(update, crane, lag=lag),
        partial(output, crane, lag=lag),
        states=list(STATES),
        inputs=["F" if lag is None else "v_cmd", "C", *(["wind"] if wind else [])],
        outputs=list(outputs),
        name=name,
        params=defaults_of(crane),
    )
    return declare(block, feedthrough=feedthrough(outputs, 2 + wind))


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
    numbers = crane.numbers()
    return solved(numbers, crane.rope_wrap, state, by_force(numbers, state, force), torque, wind)


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


def checked_drive(drive: Drive, drive_lag: float) -> float | None:
    """Time constant of a velocity drive [s]; None for a force."""
    if drive not in ("force", "velocity"):
        raise ValueError(f"drive must be 'force' or 'velocity', got {drive!r}")
    lag = checked_finite(drive_lag, "drive_lag", above=0.0)
    return lag if drive == "velocity" else None


def update(
    crane: CraneParameters, t: float, state: Array, inputs: Array, params: Params, lag: float | None = None
) -> Array:
    """Derivatives of the states, in the form of `control.nlsys`."""
    d2, r2, theta2, _ = _driven(crane, crane.numbers(params), lag, state, inputs, params)
    return np.array([state[3], state[4], state[5], d2, r2, theta2])


def output(
    crane: CraneParameters, t: float, state: Array, inputs: Array, params: Params, lag: float | None = None
) -> Array:
    """`OUTPUTS`, and those of a velocity drive, in the form of `control.nlsys`."""
    numbers = crane.numbers(params)
    x, z, x_rate, z_rate = load(numbers[3], state)
    d2, _, _, tension = _driven(crane, numbers, lag, state, inputs, params)
    rows = [x, z, state[0], state[1], state[2], x_rate, z_rate, state[3], state[4], state[5], tension]
    if lag is not None:
        _, trolley, _, _, friction, _, gravity = numbers
        force = trolley * d2 + friction * state[3] - tension * np.sin(state[2])
        rows += [force, np.sqrt(gravity / state[1])]
    return np.array(rows)


def feedthrough(outputs: tuple[str, ...], ninputs: int) -> NDArray[np.bool_]:
    """Direct feedthrough (noutputs, ninputs): from all inputs to the tension and the force of a velocity drive."""
    found = np.zeros((len(outputs), ninputs), dtype=bool)
    found[[row for row, name in enumerate(outputs) if name in ("T", "F")]] = True
    return found


def by_force(numbers: Numbers, state: Quantity, force: Quantity) -> tuple[Quantity, Quantity]:
    """Acceleration of a trolley with the input force, as a + b T of the tension T."""
    _, trolley, _, _, friction, _, _ = numbers
    return (force - friction * state[3]) / trolley, np.sin(state[2]) / trolley


def solved(
    numbers: Numbers,
    rope_wrap: bool,
    state: Quantity,
    trolley: tuple[Quantity, Quantity],
    torque: Quantity,
    wind: Quantity,
) -> tuple[Quantity, Quantity, Quantity, Quantity]:
    """D'', R'', theta'' and T for given parameters; the trolley's acceleration is a + b T."""
    m, _, inertia, b, _, f2, g = numbers
    _, r, theta, _, r_rate, rate = (state[i] for i in range(6))
    s, c = np.sin(theta), np.cos(theta)
    # Each acceleration is linear in T; the first equation of motion then gives T.
    d0, d1 = trolley
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


def _driven(
    crane: CraneParameters, numbers: Numbers, lag: float | None, state: Array, inputs: Array, params: Params
) -> tuple[Quantity, Quantity, Quantity, Quantity]:
    """D'', R'', theta'' and T for inputs of the block; the wind is 0 if it is not an input."""
    if lag is None:
        trolley = by_force(numbers, state, inputs[0])
    else:
        (lag,) = overridden({"drive_lag": lag}, params)
        trolley = (inputs[0] - state[3]) / lag, 0.0
    wind = inputs[2] if inputs.shape[0] > 2 else 0.0
    return solved(numbers, crane.rope_wrap, state, trolley, inputs[1], wind)
