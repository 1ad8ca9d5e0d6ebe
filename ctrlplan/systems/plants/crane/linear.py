"""Linear models of trolley and hoist, and PIDs designed for them.

The rope tension is a disturbance of the models.
"""

from __future__ import annotations

import control as ct

from ctrlplan._checks import Range, checked_finite
from ctrlplan.systems.pid import create_pid_iosystem
from ctrlplan.systems.plants.crane.parameters import CraneParameters


def linear_trolley(crane: CraneParameters, name: str = "trolley") -> ct.StateSpace:
    """Linear model of the trolley, D/F = 1/(s (M_c s + f1)).

    Inputs: F [N]. Outputs: D [m]. The rope tension is a disturbance.
    """
    return _double(1.0 / crane.trolley_mass, crane.trolley_friction / crane.trolley_mass, "F", "D", name)


def linear_hoist(crane: CraneParameters, name: str = "hoist", *, with_load: bool = False) -> ct.StateSpace:
    """Linear model of the hoist, R/C = b/(s (J s + f2)).

    Inputs: C [N m]. Outputs: R [m]. The rope tension is a disturbance. With the
    load, J is replaced by J + m b^2: the nonlinear crane linearised at
    equilibrium, where its weight is balanced.
    """
    inertia = crane.drum_inertia + (crane.load_mass * crane.drum_radius**2 if with_load else 0.0)
    return _double(crane.drum_radius / inertia, crane.drum_friction / inertia, "C", "R", name)


def linear_coupled(crane: CraneParameters, rope_length: float, name: str = "crane") -> ct.InterconnectedSystem:
    """Linear model of trolley and pendulum at a given rope length.

    An interconnection of the blocks trolley and pendulum, linearised at
    equilibrium: D/F = (R s^2 + g)/(s [(M_c s + f1)(R s^2 + g) + m g s]).
    Inputs: F [N]. Outputs: D [m] and theta [rad].
    """
    rope_length = checked_finite(rope_length, "rope_length", above=0.0)
    g = crane.gravity
    trolley = ct.ss(
        [[0.0, 1.0], [0.0, -crane.trolley_friction / crane.trolley_mass]],
        [[0.0, 0.0], [1.0 / crane.trolley_mass, crane.load_mass * g / crane.trolley_mass]],
        [[1.0, 0.0], [0.0, -crane.trolley_friction / crane.trolley_mass]],
        [[0.0, 0.0], [1.0 / crane.trolley_mass, crane.load_mass * g / crane.trolley_mass]],
        inputs=["F", "theta"],
        outputs=["D", "D_d2"],
        states=["D", "D_d1"],
        name="trolley",
    )
    pendulum = ct.ss(
        [[0.0, 1.0], [-g / rope_length, 0.0]],
        [[0.0], [-1.0 / rope_length]],
        [[1.0, 0.0]],
        [[0.0]],
        inputs=["D_d2"],
        outputs=["theta"],
        states=["theta", "theta_d1"],
        name="pendulum",
    )
    return ct.interconnect([trolley, pendulum], inputs=["F"], outputs=["D", "theta"], name=name)


def trolley_pid(
    crane: CraneParameters,
    bandwidth: float = 5.0,
    tf: float = 0.02,
    *,
    bias: float = 0.0,
    limits: Range | None = None,
    tracking_time: float | None = None,
) -> ct.StateSpace | ct.NonlinearIOSystem:
    """PID of the trolley, a triple pole at -bandwidth [rad/s].

    Inputs: D_ref and D [m]. Outputs: F [N]. The design model is
    `linear_trolley`; other arguments as in `create_pid_iosystem`.
    """
    return create_pid_iosystem(
        *_triple_pole(crane.trolley_mass, crane.trolley_friction, bandwidth),
        tf,
        bias=bias,
        limits=limits,
        tracking_time=tracking_time,
        inputs=("D_ref", "D"),
        outputs="F",
        name="trolley_pid",
    )


def hoist_pid(
    crane: CraneParameters,
    bandwidth: float = 5.0,
    tf: float = 0.02,
    *,
    limits: Range | None = None,
    tracking_time: float | None = None,
) -> ct.StateSpace | ct.NonlinearIOSystem:
    """PID of the hoist, a triple pole at -bandwidth [rad/s].

    Inputs: R_ref and R [m]. Outputs: C [N m]. The design model is
    `linear_hoist` with the load, whose weight is the bias; other arguments as in
    `create_pid_iosystem`.
    """
    return create_pid_iosystem(
        *_hoist_gains(crane, bandwidth),
        tf,
        bias=-crane.drum_radius * crane.load_mass * crane.gravity,
        limits=limits,
        tracking_time=tracking_time,
        inputs=("R_ref", "R"),
        outputs="C",
        name="hoist_pid",
    )


def linear_trolley_loop(crane: CraneParameters, bandwidth: float = 5.0, tf: float = 0.02) -> ct.InterconnectedSystem:
    """Loop of `linear_trolley` with its PID.

    Inputs: D_ref [m]. Outputs: D [m].
    """
    blocks = [trolley_pid(crane, bandwidth, tf), linear_trolley(crane)]
    return ct.interconnect(blocks, inputs=["D_ref"], outputs=["D"], name="trolley_loop")


def linear_hoist_loop(crane: CraneParameters, bandwidth: float = 5.0, tf: float = 0.02) -> ct.InterconnectedSystem:
    """Loop of `linear_hoist` with the load and its PID.

    Inputs: R_ref [m]. Outputs: R [m]. The weight of the load is balanced.
    """
    pid = create_pid_iosystem(*_hoist_gains(crane, bandwidth), tf, inputs=("R_ref", "R"), outputs="C", name="hoist_pid")
    return ct.interconnect(
        [pid, linear_hoist(crane, with_load=True)], inputs=["R_ref"], outputs=["R"], name="hoist_loop"
    )


def _hoist_gains(crane: CraneParameters, bandwidth: float) -> tuple[float, float, float]:
    b = crane.drum_radius
    return _triple_pole(crane.drum_inertia / b + crane.load_mass * b, crane.drum_friction / b, bandwidth)


def _double(gain: float, damping: float, source: str, sink: str, name: str) -> ct.StateSpace:
    """gain/(s (s + damping))."""
    return ct.ss(
        [[0.0, 1.0], [0.0, -damping]], [[0.0], [gain]], [[1.0, 0.0]], [[0.0]], inputs=source, outputs=sink, name=name
    )


def _triple_pole(mass: float, friction: float, bandwidth: float) -> tuple[float, float, float]:
    """Kp, Ki, Kd for a triple pole at -bandwidth with the plant 1/(s (mass s + friction))."""
    w = checked_finite(bandwidth, "bandwidth", above=0.0)
    return 3.0 * mass * w**2, mass * w**3, 3.0 * mass * w - friction
