"""Robot link with an elastic joint."""

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
    r"""Robot link with an elastic joint, a flat system of order 4.

    .. math:: I \ddot q_1 + m g l \sin q_1 + k (q_1 - q_2) = 0, \qquad J \ddot q_2 + k (q_2 - q_1) = u

    The states are also the outputs: q1 and q2 [rad], the angles of link
    (0 hanging down) and motor, and their velocities q1_d1 and q2_d1 [rad/s].
    Input: the motor torque u [N m]. Flat output: q1.

    Parameters given to a simulation under these names override those of the
    plant, but not those of its flat maps.

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
        g [m/s^2]; 0 for a link in a horizontal plane.
    name : str, optional
        Name of the block.

    Returns
    -------
    ctrlplan.flatness.FlatSystem
        A `control.flatsys.FlatSystem`.

    Raises
    ------
    ValueError
        If a parameter is not finite and positive (gravity: non-negative).

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0, 0, 0)], labels=["q1"])
    >>> joint = cp.plants.flexible_joint()
    >>> law = cp.create_flat_iosystem(joint, poles=[-9, -10, -11, -12], labels="q1")
    >>> source = cp.create_source_iosystem(plan, 4, suffix="_ref")
    >>> loop = ct.interconnect([source, law, joint], inputs=0, outputs=["q1"])
    >>> bool(abs(cp.simulate(loop, [0.0, 0.5, 1.0]).outputs - plan([0.0, 0.5, 1.0])).max() < 1e-6)
    True
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
