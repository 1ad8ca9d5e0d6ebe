"""Magnetic levitation with the dynamics of its coil."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from ctrlplan._types import Value
from ctrlplan.systems.plants.parameters import parameter
from ctrlplan.systems.plants.plant import Signals, StateSpacePlant


@dataclass(frozen=True, kw_only=True, repr=False)
class MagneticLevitation(StateSpacePlant):
    r"""Magnetic levitation of a ball below a coil.

    .. math::
        m \ddot y = m g - c \frac{i^2}{y^2}, \qquad \frac{d}{dt}\bigl(L(y)\,i\bigr) + R\,i = u, \qquad
        L(y) = L_\infty + \frac{2 c}{y}

    States: gap y [m], downwards from the coil, its rate gap_d1 [m/s], and current
    [A]. Input: voltage [V]. Flat output: the gap, of order 3. The maps are singular
    where the gap or the magnetic force is 0, at gap'' = g.

    Parameters
    ----------
    mass : float
        m of the ball [kg].
    force_constant : float
        c [N m^2/A^2].
    resistance : float
        R of the coil [ohm].
    inductance : float
        L at infinite gap [H].
    gravity : float
        g [m/s^2].

    Raises
    ------
    ValueError
        If a parameter is not finite and above 0 (inductance: non-negative).

    Notes
    -----
    Source: H. Sira-Ramirez, S. K. Agrawal, "Differentially flat systems", 2004, with
    the inductance that belongs to the force, F = -(i^2/2) dL/dy. The current is positive, or
    negative with ``flat_system(at={"current": -1.0})``.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline(
    ...     [cp.Waypoint(0, 0.010, 0, 0, 0), cp.Waypoint(0.4, 0.006, 0, 0, 0)], labels="gap"
    ... )
    >>> ball = cp.plants.MagneticLevitation()
    >>> (gap, rate, current), voltage = ball.flat_system().states_and_inputs(plan, [0.0, 0.2, 0.4])
    >>> current.round(3).tolist()
    [1.011, 0.809, 0.606]
    """

    mass: float = parameter(0.068, "kg")
    force_constant: float = parameter(6.53e-5, "N m^2/A^2")
    resistance: float = parameter(11.0, "ohm")
    inductance: float = parameter(0.4, "H", zero=True)
    gravity: float = parameter(9.81, "m/s^2")

    title, name = "Magnetic levitation", "magnetic_levitation"
    signals = Signals(
        states={"gap": "m", "gap_d1": "m/s", "current": "A"},
        inputs={"voltage": "V"},
        flat_outputs=("gap",),
        orders=(3,),
        at={"gap": 0.01},
        signs=("current",),
    )

    def rates(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Derivatives of the states."""
        gap, speed, current = x[0], x[1], x[2]
        pull = p.force_constant * current / (gap * gap)  # the force is this times the current
        inductance = p.inductance + 2.0 * p.force_constant / gap
        return [
            speed,
            p.gravity - pull * current / p.mass,
            (u[0] - p.resistance * current + 2.0 * pull * speed) / inductance,
        ]

    def forward(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Gap with three derivatives."""
        speed, second, current_rate = self.rates(x, u, p)
        pull = p.force_constant * x[2] / (x[0] * x[0])
        third = -2.0 * pull / p.mass * (current_rate - x[2] * speed / x[0])
        return [[x[0], speed, second, third]]

    def reverse(
        self, jet: Value, p: SimpleNamespace, at: Mapping[str, float]
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """States and input from the jet of the gap."""
        ((gap, speed, second, third),) = jet
        lifted = p.gravity - second
        sign = -1.0 if at.get("current", 1.0) < 0.0 else 1.0
        current = sign * gap * np.sqrt(p.mass * lifted / p.force_constant)
        rate = current * (speed / gap - third / (2.0 * lifted))
        inductance = p.inductance + 2.0 * p.force_constant / gap
        motional = 2.0 * p.force_constant * current * speed / (gap * gap)
        return [gap, speed, current], [inductance * rate - motional + p.resistance * current]

    def conditions(self, jet: Value, p: SimpleNamespace) -> dict[str, Value]:
        """The gap and the magnetic force."""
        ((gap, _, second, _),) = jet
        return {"the gap": gap, "the magnetic force": p.mass * (p.gravity - second)}
