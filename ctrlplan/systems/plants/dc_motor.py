"""DC motor with armature inductance and a rotating load."""

from __future__ import annotations

import numpy as np

from ctrlplan._checks import checked_finite
from ctrlplan._types import Params, Value
from ctrlplan.flatness import FlatSystem
from ctrlplan.systems.plants.parameters import overridden


def dc_motor(
    *,
    resistance: float = 1.0,
    inductance: float = 0.5,
    motor_constant: float = 0.01,
    inertia: float = 0.01,
    friction: float = 0.1,
    name: str = "dc_motor",
) -> FlatSystem:
    r"""DC motor with armature inductance, a flat system of order 3.

    .. math:: J \ddot\varphi + b \dot\varphi = K i, \qquad L \dot i + R i + K \dot\varphi = V

    The states are also the outputs: angle [rad], speed [rad/s], current
    [A]. Input: voltage [V]. Flat output: the angle.

    Parameters given to a simulation under these names override those of the
    plant, but not those of its flat maps.

    Parameters
    ----------
    resistance : float, optional
        R of the armature [ohm].
    inductance : float, optional
        L of the armature [H].
    motor_constant : float, optional
        K, the torque and back-EMF constant [N m/A = V s/rad].
    inertia : float, optional
        J of rotor and load [kg m^2].
    friction : float, optional
        b, the viscous friction coefficient [N m s].
    name : str, optional
        Name of the block.

    Returns
    -------
    ctrlplan.flatness.FlatSystem
        A `control.flatsys.FlatSystem`.

    Raises
    ------
    ValueError
        If a parameter is not finite and positive (friction: non-negative).

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> motor = cp.plants.dc_motor()
    >>> source = cp.create_source_iosystem(cp.Step(1.0), labels="voltage")
    >>> loop = ct.interconnect([source, motor], inputs=0, outputs=["angle", "speed", "current"])
    >>> response = cp.simulate(loop, [0.0, 5.0])
    >>> round(float(response.outputs[1, -1]), 4)  # K/(R b + K^2)
    0.0999
    """
    parameters = {
        "resistance": resistance,
        "inductance": inductance,
        "motor_constant": motor_constant,
        "inertia": inertia,
    }
    for label, value in parameters.items():
        checked_finite(value, label, above=0.0)
    checked_finite(friction, "friction", minimum=0.0)
    R, L, K, J, b = resistance, inductance, motor_constant, inertia, friction
    own = {**parameters, "friction": friction}

    def update(t: float, x: Value, u: Value, params: Params) -> Value:
        R, L, K, J, b = overridden(own, params)
        return np.array([x[1], (K * x[2] - b * x[1]) / J, (u[0] - R * x[2] - K * x[1]) / L])

    def forward(x: Value, u: Value, params: Params | None = None) -> list[Value]:
        _, second, current_rate = update(0.0, x, u, {})
        return [np.array([x[0], x[1], second, (K * current_rate - b * second) / J])]

    def reverse(flag: Value, params: Params | None = None) -> tuple[Value, Value]:
        angle, speed, second, third = flag[0]
        current = (J * second + b * speed) / K
        voltage = L * (J * third + b * second) / K + R * current + K * speed
        return np.array([angle, speed, current]), np.array([voltage])

    states = ["angle", "speed", "current"]
    return FlatSystem(
        forward,
        reverse,
        update,
        lambda t, x, u, params: x,
        orders=(3,),
        flat_labels=("angle",),
        states=states,
        inputs=["voltage"],
        outputs=states,
        name=name,
    )
