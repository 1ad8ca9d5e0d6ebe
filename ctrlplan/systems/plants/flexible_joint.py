"""Robot link with an elastic joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from ctrlplan._types import Value
from ctrlplan.flatness import FlatSystem
from ctrlplan.systems.plants.parameters import parameter
from ctrlplan.systems.plants.plant import Signals, StateSpacePlant


@dataclass(frozen=True, kw_only=True, repr=False)
class FlexibleJoint(StateSpacePlant):
    r"""Robot link with an elastic joint.

    .. math:: I \ddot q_1 + m g l \sin q_1 + k (q_1 - q_2) = 0, \qquad J \ddot q_2 + k (q_2 - q_1) = u

    States: q1 and q2 [rad], the angles of link (0 hanging down) and motor, and
    their velocities q1_d1 and q2_d1 [rad/s]. Input: the motor torque u [N m]. Flat
    output: q1, of order 4.

    Parameters
    ----------
    link_inertia : float
        I about the joint [kg m^2].
    motor_inertia : float
        J [kg m^2].
    stiffness : float
        k [N m/rad].
    mass : float
        m of the link [kg].
    length : float
        l from the joint to the link's centre of mass [m].
    gravity : float
        g [m/s^2]; 0 for a link in a horizontal plane.

    Raises
    ------
    ValueError
        If a parameter is not finite and positive (gravity: non-negative).

    Notes
    -----
    Source: M. W. Spong, "Modeling and control of elastic joint robots", ASME J. Dyn.
    Syst. Meas. Control 109, 1987.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0, 0, 0)], labels="q1")
    >>> joint = cp.plants.FlexibleJoint(stiffness=20.0)
    >>> loop = cp.flat_loop(joint.flat_system(), plan, poles=[-9, -10, -11, -12])
    >>> bool(abs(cp.simulate(loop, [0.0, 0.5, 1.0]).outputs["q1"] - plan([0.0, 0.5, 1.0])).max() < 1e-6)
    True
    """

    link_inertia: float = parameter(0.03, "kg m^2")
    motor_inertia: float = parameter(0.004, "kg m^2")
    stiffness: float = parameter(31.0, "N m/rad")
    mass: float = parameter(0.4, "kg")
    length: float = parameter(0.2, "m")
    gravity: float = parameter(9.81, "m/s^2", zero=True)

    title, name = "Flexible joint", "flexible_joint"
    signals = Signals(
        states={"q1": "rad", "q2": "rad", "q1_d1": "rad/s", "q2_d1": "rad/s"},
        inputs={"u": "N m"},
        flat_outputs=("q1",),
        orders=(4,),
    )

    def rates(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Derivatives of the states."""
        weight = p.mass * p.gravity * p.length
        spring = p.stiffness * (x[1] - x[0])
        return [x[2], x[3], (spring - weight * np.sin(x[0])) / p.link_inertia, (u[0] - spring) / p.motor_inertia]

    def forward(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Angle q1 with four derivatives."""
        inertia, k, weight = p.link_inertia, p.stiffness, p.mass * p.gravity * p.length
        rate, motor_rate, second, motor_second = self.rates(x, u, p)
        s, c = np.sin(x[0]), np.cos(x[0])
        third = (k * (motor_rate - rate) - weight * c * rate) / inertia
        fourth = (k * (motor_second - second) - weight * (c * second - s * rate * rate)) / inertia
        return [[x[0], rate, second, third, fourth]]

    def reverse(
        self, jet: Value, p: SimpleNamespace, at: Mapping[str, float]
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """States and input from the jet of q1."""
        ((angle, rate, second, third, fourth),) = jet
        inertia, k, weight = p.link_inertia, p.stiffness, p.mass * p.gravity * p.length
        s, c = np.sin(angle), np.cos(angle)
        motor = angle + (inertia * second + weight * s) / k
        motor_rate = rate + (inertia * third + weight * c * rate) / k
        motor_second = second + (inertia * fourth + weight * (c * second - s * rate * rate)) / k
        return [angle, motor, rate, motor_rate], [p.motor_inertia * motor_second + k * (motor - angle)]


def flexible_joint(*, name: str = "flexible_joint", **parameters: float) -> FlatSystem:
    """Robot link with an elastic joint, short for ``FlexibleJoint(...).flat_system()``.

    Parameters
    ----------
    name : str, optional
        Name of the system.
    **parameters : float
        Parameters of `FlexibleJoint`: link_inertia, motor_inertia, stiffness, mass,
        length, gravity.

    Returns
    -------
    FlatSystem
        A `control.flatsys.FlatSystem`.

    Raises
    ------
    TypeError, ValueError
        If a parameter is unknown, or not finite and positive (gravity:
        non-negative).

    Examples
    --------
    >>> import ctrlplan as cp
    >>> cp.plants.flexible_joint(stiffness=20.0).orders
    (4,)
    """
    return FlexibleJoint(**parameters).flat_system(name)
