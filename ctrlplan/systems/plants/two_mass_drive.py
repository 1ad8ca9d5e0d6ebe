"""Two-mass drive: motor and load on an elastic shaft."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

from ctrlplan._types import Value
from ctrlplan.systems.plants.parameters import parameter
from ctrlplan.systems.plants.plant import Signals, StateSpacePlant


@dataclass(frozen=True, kw_only=True, repr=False)
class TwoMassDrive(StateSpacePlant):
    r"""Two-mass drive with an elastic shaft.

    .. math::
        J_1 \ddot\varphi_1 = u - M, \qquad J_2 \ddot\varphi_2 = M, \qquad
        M = k (\varphi_1 - \varphi_2) + d (\dot\varphi_1 - \dot\varphi_2)

    States: motor_angle [rad], motor_speed [rad/s], load_angle, load_speed. Input:
    torque u of the motor [N m]. Without damping of the shaft the flat output is the load
    angle, of order 4. With damping the load angle is not flat, since the motor torque acts
    on it through a zero at -k/d; the flat output is

    .. math:: y = \varphi_2 + \frac{d^2}{k J_2} (\varphi_1 - \varphi_2) - \frac{d}{k} \dot\varphi_2,
        \qquad \varphi_2 = y + \frac{d}{k} \dot y,

    an output of the block, which equals the load angle at rest.

    Parameters
    ----------
    motor_inertia, load_inertia : float
        J1 and J2 [kg m^2].
    stiffness : float
        k of the shaft [N m/rad].
    damping : float
        d of the shaft [N m s/rad].

    Raises
    ------
    ValueError
        If a parameter is not finite and above 0 (damping: non-negative).

    Notes
    -----
    Source: for d = 0, H. Sira-Ramirez, S. K. Agrawal, "Differentially flat systems",
    2004; for d > 0 the flat output of the controllability form, divided by its gain.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> cp.plants.TwoMassDrive(damping=0.0).flat_system().flat_labels
    ('load_angle',)
    >>> cp.plants.TwoMassDrive(damping=0.05).flat_system().flat_labels
    ('y',)
    """

    motor_inertia: float = parameter(1e-3, "kg m^2")
    load_inertia: float = parameter(2e-3, "kg m^2")
    stiffness: float = parameter(50.0, "N m/rad")
    damping: float = parameter(0.0, "N m s/rad", zero=True)

    title, name = "Two-mass drive", "two_mass_drive"

    @property
    def signals(self) -> Signals:
        """States, inputs and flat output."""
        return Signals(
            states={"motor_angle": "rad", "motor_speed": "rad/s", "load_angle": "rad", "load_speed": "rad/s"},
            inputs={"torque": "N m"},
            outputs={"y": "rad"} if self.damping else {},
            flat_outputs=("y",) if self.damping else ("load_angle",),
            orders=(4,),
        )

    def rates(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Derivatives of the states."""
        shaft = p.stiffness * (x[0] - x[2]) + p.damping * (x[1] - x[3])
        return [x[1], (u[0] - shaft) / p.motor_inertia, x[3], shaft / p.load_inertia]

    def flat_outputs(self, x: Value, p: SimpleNamespace) -> Sequence[Value]:
        """The flat output y; the load angle without damping."""
        lag = p.damping / p.stiffness
        return [x[2] + lag * (p.damping / p.load_inertia * (x[0] - x[2]) - x[3])]

    def forward(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Flat output with four derivatives, of which the last three are those of the twist of the shaft."""
        motor_speed, motor_rate, load_speed, load_rate = self.rates(x, u, p)
        twist, elastic = x[0] - x[2], p.stiffness / p.load_inertia
        (y,) = self.flat_outputs(x, p)
        first = load_speed - p.damping / p.load_inertia * twist
        twisting = [twist, motor_speed - load_speed, motor_rate - load_rate]
        return [[y, first, *(elastic * value for value in twisting)]]

    def reverse(
        self, jet: Value, p: SimpleNamespace, at: Mapping[str, float]
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """States and input from the jet of the flat output."""
        ((y, first, second, third, fourth),) = jet
        lag, slow = p.damping / p.stiffness, p.load_inertia / p.stiffness
        load, speed = y + lag * first, first + lag * second
        state = [load + slow * second, speed + slow * third, load, speed]
        both = p.motor_inertia + p.load_inertia
        return state, [p.motor_inertia * slow * fourth + both * (second + lag * third)]
