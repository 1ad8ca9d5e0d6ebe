"""Kinematic car: rear axle, heading and steering angle, without slip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Literal, get_args

import numpy as np

from ctrlplan._types import Value
from ctrlplan.systems.plants.parameters import parameter
from ctrlplan.systems.plants.plant import Signals, StateSpacePlant

Steering = Literal["angle", "rate"]
"""Input of the steering: its angle, or the rate of its angle."""

_POSE = {"x": "m", "y": "m", "theta": "rad"}


@dataclass(frozen=True, kw_only=True, repr=False)
class KinematicCar(StateSpacePlant):
    r"""Kinematic car, without slip of the wheels.

    .. math:: \dot x = v \cos\theta, \qquad \dot y = v \sin\theta, \qquad \dot\theta = \frac{v}{l}\tan\delta

    States: position x, y of the middle of the rear axle [m] and heading theta
    [rad]. Inputs: speed v [m/s], negative in reverse, and steering angle delta [rad];
    with ``steering="rate"`` delta is a state and its rate delta_d1 [rad/s] the input.
    Flat outputs: x and y. The maps are singular at rest, where the
    heading does not follow from the position: a car that stops requires a
    `ctrlplan.PathPlan`.

    Parameters
    ----------
    wheelbase : float
        l, distance of the axles [m].
    steering : {"angle", "rate"}
        Input of the steering.

    Raises
    ------
    ValueError
        If the wheelbase is not finite and above 0, or `steering` is unknown.

    Notes
    -----
    Source: M. Fliess, J. Levine, P. Martin, P. Rouchon, "Flatness and defect of
    non-linear systems", Int. J. Control 61, 1995; with the sign of the speed in reverse,
    which ``flat_system(at={"v": -1.0})`` selects.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> lane = cp.PolySpline([
    ...     cp.Waypoint.from_jets(0.0, x=[0, 20, 0], y=[0, 0, 0]),
    ...     cp.Waypoint.from_jets(3.0, x=[60, 20, 0], y=[3.5, 0, 0]),
    ... ])
    >>> car = cp.plants.KinematicCar(wheelbase=2.7).flat_system()
    >>> states, (speed, steering) = car.states_and_inputs(lane, [0.0, 1.5, 3.0])
    >>> speed.round(2).tolist()
    [20.0, 20.12, 20.0]
    """

    wheelbase: float = parameter(2.7, "m")
    steering: Steering = "angle"

    title, name = "Kinematic car", "kinematic_car"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steering not in get_args(Steering):
            raise ValueError(f"steering must be one of {', '.join(get_args(Steering))}, got {self.steering!r}")

    @property
    def signals(self) -> Signals:
        """States, inputs and flat outputs."""
        rate = self.steering == "rate"
        return Signals(
            states=_POSE | ({"delta": "rad"} if rate else {}),
            inputs={"v": "m/s"} | ({"delta_d1": "rad/s"} if rate else {"delta": "rad"}),
            flat_outputs=("x", "y"),
            orders=(3, 3) if rate else (2, 2),
            angles=("theta",),
            at={"v": 1.0},
            signs=("v",),
        )

    def rates(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Derivatives of the states."""
        steering = self.steering == "rate"
        turning = np.tan(x[3] if steering else u[1]) / p.wheelbase
        pose = [u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[0] * turning]
        return [*pose, u[1]] if steering else pose

    def reverse(
        self, jet: Value, p: SimpleNamespace, at: Mapping[str, float]
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """States and inputs from the jets of x and y."""
        x, y = jet
        forward = -1.0 if at["v"] < 0.0 else 1.0
        v = forward * np.sqrt(x[1] * x[1] + y[1] * y[1])
        bent = x[1] * y[2] - y[1] * x[2]
        slope = p.wheelbase * bent / (v * v * v)  # of the steering angle
        pose, delta = [x[0], y[0], np.arctan2(forward * y[1], forward * x[1])], np.arctan(slope)
        if self.steering == "angle":
            return pose, [v, delta]
        speeding = (x[1] * x[2] + y[1] * y[2]) / v
        changing = p.wheelbase * (x[1] * y[3] - y[1] * x[3]) / (v * v * v) - 3.0 * slope * speeding / v
        return [*pose, delta], [v, changing / (1.0 + slope * slope)]

    def conditions(self, jet: Value, p: SimpleNamespace) -> dict[str, Value]:
        """The squared speed."""
        x, y = jet
        return {"the squared speed": x[1] * x[1] + y[1] * y[1]}
