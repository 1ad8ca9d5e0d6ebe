"""DC motor with armature inductance and a rotating load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

from ctrlplan._types import Value
from ctrlplan.flatness import FlatSystem
from ctrlplan.systems.plants.parameters import parameter
from ctrlplan.systems.plants.plant import Signals, StateSpacePlant


@dataclass(frozen=True, kw_only=True, repr=False)
class DCMotor(StateSpacePlant):
    r"""DC motor with armature inductance.

    .. math:: J \ddot\varphi + b \dot\varphi = K i, \qquad L \dot i + R i + K \dot\varphi = V

    States: angle [rad], speed [rad/s], current [A]. Input: voltage [V]. Flat output:
    the angle, of order 3.

    Parameters
    ----------
    resistance : float
        R of the armature [ohm].
    inductance : float
        L of the armature [H].
    motor_constant : float
        K, the torque and back-EMF constant [N m/A = V s/rad].
    inertia : float
        J of rotor and load [kg m^2].
    friction : float
        b, the viscous friction coefficient [N m s].

    Raises
    ------
    ValueError
        If a parameter is not finite and positive (friction: non-negative).

    Notes
    -----
    Source: the values are those of the Control Tutorials for MATLAB and Simulink,
    University of Michigan, "DC motor position".

    Examples
    --------
    >>> import ctrlplan as cp
    >>> turn = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(1, 2, 0, 0, 0)], labels="angle")
    >>> loop = cp.flat_loop(cp.plants.DCMotor().flat_system(), turn, poles=[-20, -25, -30])
    >>> cp.simulate(loop, [0.0, 0.5, 1.0]).outputs["angle"].round(6).tolist()
    [0.0, 1.0, 2.0]
    """

    resistance: float = parameter(1.0, "ohm")
    inductance: float = parameter(0.5, "H")
    motor_constant: float = parameter(0.01, "N m/A")
    inertia: float = parameter(0.01, "kg m^2")
    friction: float = parameter(0.1, "N m s", zero=True)

    title, name = "DC motor", "dc_motor"
    signals = Signals(
        states={"angle": "rad", "speed": "rad/s", "current": "A"},
        inputs={"voltage": "V"},
        flat_outputs=("angle",),
        orders=(3,),
    )

    def rates(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Derivatives of the states."""
        return [
            x[1],
            (p.motor_constant * x[2] - p.friction * x[1]) / p.inertia,
            (u[0] - p.resistance * x[2] - p.motor_constant * x[1]) / p.inductance,
        ]

    def forward(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Angle with three derivatives."""
        _, second, current_rate = self.rates(x, u, p)
        return [[x[0], x[1], second, (p.motor_constant * current_rate - p.friction * second) / p.inertia]]

    def reverse(
        self, jet: Value, p: SimpleNamespace, at: Mapping[str, float]
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """States and input from the jet of the angle."""
        ((angle, speed, second, third),) = jet
        current = (p.inertia * second + p.friction * speed) / p.motor_constant
        changing = p.inductance * (p.inertia * third + p.friction * second) / p.motor_constant
        return [angle, speed, current], [changing + p.resistance * current + p.motor_constant * speed]


def dc_motor(*, name: str = "dc_motor", **parameters: float) -> FlatSystem:
    """DC motor as a flat system, short for ``DCMotor(...).flat_system()``.

    Parameters
    ----------
    name : str, optional
        Name of the system.
    **parameters : float
        Parameters of `DCMotor`: resistance, inductance, motor_constant, inertia,
        friction.

    Returns
    -------
    FlatSystem
        A `control.flatsys.FlatSystem`.

    Raises
    ------
    TypeError, ValueError
        If a parameter is unknown, or not finite and positive (friction:
        non-negative).

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
    return DCMotor(**parameters).flat_system(name)
