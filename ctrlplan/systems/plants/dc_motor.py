"""Direct-current motor with armature inductance, turning a load."""

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
    r"""Motor from the armature's voltage to the angle, of order 3.

    .. math:: J \ddot\varphi + b \dot\varphi = K i, \qquad L \dot i + R i + K \dot\varphi = V

    States, which are the outputs as well: angle [rad], speed [rad/s], current
    [A]. Input: voltage [V]. Flat output: the angle.

    Parameters of a run of the same names overrule those below in the plant
    alone, not in its flat maps.

    Parameters
    ----------
    resistance : float, optional
        R of the armature [ohm].
    inductance : float, optional
        L of the armature [H].
    motor_constant : float, optional
        K, torque by current and voltage by speed [N m/A = V s/rad].
    inertia : float, optional
        J of rotor and load [kg m^2].
    friction : float, optional
        b, viscous [N m s].
    name : str, optional
        Name of the block.

    Returns
    -------
    ctrlplan.flatness.FlatSystem
        A `control.flatsys.FlatSystem`.

    Raises
    ------
    ValueError
        If a parameter is not finite and above 0 (friction: at least 0).

    Examples
    --------
    >>> motor = dc_motor(friction=0.0)
    >>> [float(round(value, 6)) for value in motor.dynamics(0.0, [0.0, 2.0, 1.0], [1.0])]
    [2.0, 1.0, -0.04]
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
