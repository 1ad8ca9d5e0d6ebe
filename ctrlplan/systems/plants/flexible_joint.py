"""Robot's link driven through a spring."""

from __future__ import annotations

import numpy as np

from ctrlplan._checks import checked_finite
from ctrlplan._types import Params, Value
from ctrlplan.flatness import FlatSystem
from ctrlplan.systems.plants.parameters import overridden


def flexible_joint(
    *,
    link_inertia: float = 0.03,
    motor_inertia: float = 0.004,
    stiffness: float = 31.0,
    mass: float = 0.4,
    length: float = 0.2,
    gravity: float = 9.81,
    name: str = "flexible_joint",
) -> FlatSystem:
    r"""Link behind an elastic joint, from the motor's torque, of order 4.

    .. math:: I \ddot q_1 + m g l \sin q_1 + k (q_1 - q_2) = 0, \qquad J \ddot q_2 + k (q_2 - q_1) = u

    States, which are the outputs as well: q1 and q2 [rad], the angles of link
    (0 hanging down) and motor, and their rates q1_d1 and q2_d1 [rad/s]. Input:
    u [N m]. Flat output: q1.

    Parameters of a run of the same names overrule those below in the plant
    alone, not in its flat maps.

    Parameters
    ----------
    link_inertia : float, optional
        I about the joint [kg m^2].
    motor_inertia : float, optional
        J [kg m^2].
    stiffness : float, optional
        k [N m/rad].
    mass : float, optional
        m of the link [kg].
    length : float, optional
        l from the joint to the link's centre of mass [m].
    gravity : float, optional
        g [m/s^2]; 0 for a link that turns in a horizontal plane.
    name : str, optional
        Name of the block.

    Returns
    -------
    ctrlplan.flatness.FlatSystem
        A `control.flatsys.FlatSystem`.

    Raises
    ------
    ValueError
        If a parameter is not finite and above 0 (gravity: at least 0).

    Examples
    --------
    >>> joint = flexible_joint(gravity=0.0)
    >>> [float(value) for value in joint.dynamics(0.0, [0.0, 0.0, 1.0, 2.0], [0.004])]
    [1.0, 2.0, 0.0, 1.0]
    """
    parameters = {
        "link_inertia": link_inertia,
        "motor_inertia": motor_inertia,
        "stiffness": stiffness,
        "mass": mass,
        "length": length,
    }
    for label, value in parameters.items():
        checked_finite(value, label, above=0.0)
    checked_finite(gravity, "gravity", minimum=0.0)
    I, J, k, weight = link_inertia, motor_inertia, stiffness, mass * gravity * length  # noqa: E741

    own = {**parameters, "gravity": gravity}

    def update(t: float, x: Value, u: Value, params: Params) -> Value:
        I, J, k, m, l, g = overridden(own, params)  # noqa: E741
        weight = m * g * l
        spring = k * (x[1] - x[0])
        return np.array([x[2], x[3], (spring - weight * np.sin(x[0])) / I, (u[0] - spring) / J])

    def forward(x: Value, u: Value, params: Params | None = None) -> list[Value]:
        rate, motor_rate, second, motor_second = update(0.0, x, u, {})
        s, c = np.sin(x[0]), np.cos(x[0])
        third = (k * (motor_rate - rate) - weight * c * rate) / I
        fourth = (k * (motor_second - second) - weight * (c * second - s * rate * rate)) / I
        return [np.array([x[0], rate, second, third, fourth])]

    def reverse(flag: Value, params: Params | None = None) -> tuple[Value, Value]:
        angle, rate, second, third, fourth = flag[0]
        s, c = np.sin(angle), np.cos(angle)
        motor = angle + (I * second + weight * s) / k
        motor_rate = rate + (I * third + weight * c * rate) / k
        motor_second = second + (I * fourth + weight * (c * second - s * rate * rate)) / k
        torque = J * motor_second + k * (motor - angle)
        return np.array([angle, motor, rate, motor_rate]), np.array([torque])

    states = ["q1", "q2", "q1_d1", "q2_d1"]
    return FlatSystem(
        forward,
        reverse,
        update,
        lambda t, x, u, params: x,
        orders=(4,),
        flat_labels=("q1",),
        states=states,
        inputs=["u"],
        outputs=states,
        name=name,
    )
