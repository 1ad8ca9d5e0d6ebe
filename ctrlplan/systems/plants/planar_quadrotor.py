"""Planar quadrotor: a rigid body in a vertical plane with two rotors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from ctrlplan._types import Value
from ctrlplan.systems.plants.parameters import parameter
from ctrlplan.systems.plants.plant import Signals, StateSpacePlant


@dataclass(frozen=True, kw_only=True, repr=False)
class PlanarQuadrotor(StateSpacePlant):
    r"""Planar quadrotor, with a thrust on each side.

    .. math::
        m \ddot x = -(F_l + F_r) \sin\theta, \qquad m \ddot z = (F_l + F_r) \cos\theta - m g, \qquad
        J \ddot\theta = d\,(F_r - F_l)

    States: position x, z of the centre of mass [m], z upwards, roll angle theta
    [rad], positive counter-clockwise, and their derivatives x_d1, z_d1, theta_d1. Inputs:
    thrusts left and right [N], each of the rotors of one side. Flat outputs: x and
    z, of orders (4, 4), with an extension of two states. The maps are singular
    without thrust, in free fall.

    Parameters
    ----------
    mass : float
        m [kg].
    inertia : float
        J about the centre of mass [kg m^2].
    arm : float
        d, distance of the rotors from the centre of mass [m].
    gravity : float
        g [m/s^2].

    Raises
    ------
    ValueError
        If a parameter is not finite and above 0.

    Notes
    -----
    Source: D. Mellinger, V. Kumar, "Minimum snap trajectory generation and control for
    quadrotors", ICRA 2011, in a plane.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> rest = [0.0] * 4
    >>> plan = cp.PolySpline([
    ...     cp.Waypoint.from_jets(0.0, x=[0.0, *rest], z=[1.0, *rest]),
    ...     cp.Waypoint.from_jets(2.0, x=[3.0, *rest], z=[2.0, *rest]),
    ... ])
    >>> quadrotor = cp.plants.PlanarQuadrotor(mass=1.0)
    >>> states, thrusts = quadrotor.flat_system().states_and_inputs(plan, [0.0, 1.0, 2.0])
    >>> thrusts[:, 0].tolist()
    [4.905, 4.905]
    """

    mass: float = parameter(1.0, "kg")
    inertia: float = parameter(0.01, "kg m^2")
    arm: float = parameter(0.2, "m")
    gravity: float = parameter(9.81, "m/s^2")

    title, name = "Planar quadrotor", "planar_quadrotor"
    signals = Signals(
        states={"x": "m", "z": "m", "theta": "rad", "x_d1": "m/s", "z_d1": "m/s", "theta_d1": "rad/s"},
        inputs={"left": "N", "right": "N"},
        flat_outputs=("x", "z"),
        orders=(4, 4),
        angles=("theta",),
        at={"theta": 0.0},
    )

    def rates(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Derivatives of the states."""
        lift = (u[0] + u[1]) / p.mass
        return [
            *(x[3], x[4], x[5]),
            -lift * np.sin(x[2]),
            lift * np.cos(x[2]) - p.gravity,
            p.arm * (u[1] - u[0]) / p.inertia,
        ]

    def reverse(
        self, jet: Value, p: SimpleNamespace, at: Mapping[str, float]
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """States and inputs from the jets of x and z; the thrust is along (x'', z'' + g)."""
        x, z = jet
        across, up = -x[2], z[2] + p.gravity
        squares = across * across + up * up
        turning = up * -x[3] - across * z[3]
        rate = turning / squares
        stretching = 2.0 * (across * -x[3] + up * z[3])
        second = (up * -x[4] - across * z[4] - rate * stretching) / squares
        thrust, couple = p.mass * np.sqrt(squares), p.inertia * second / p.arm
        state = [x[0], z[0], np.arctan2(across, up), x[1], z[1], rate]
        return state, [(thrust - couple) / 2.0, (thrust + couple) / 2.0]

    def conditions(self, jet: Value, p: SimpleNamespace) -> dict[str, Value]:
        """The squared thrust."""
        x, z = jet
        up = z[2] + p.gravity
        return {"the squared thrust": p.mass * p.mass * (x[2] * x[2] + up * up)}
