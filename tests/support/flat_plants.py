"""Plants of textbooks with candidates of flat outputs, and what is known about them.

Sources: Fliess, Levine, Martin, Rouchon, "Flatness and defect of non-linear systems", 1995 (crane, trailers, PVTOL);
Martin, Devasia, Paden, 1996 (PVTOL); Mellinger, Kumar, 2011 (quadrotor); Sira-Ramirez, Agrawal, "Differentially flat
systems", 2004 (magnetic levitation, flexible joint, converters, motors, tanks, chemical reactors).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import control as ct
import numpy as np

import ctrlplan as cp

G = 9.81


@dataclass(frozen=True)
class Case:
    """A plant, candidates of flat outputs, orders and extension; None where it is not flat."""

    plant: ct.InputOutputSystem
    outputs: Sequence[str] | Callable[..., Sequence[object]]
    orders: tuple[int, ...] | None
    extension: int = 0
    internal: int = 0
    at: Mapping[str, float] = field(default_factory=dict)


def system(name: str, states: str, inputs: str, rates: Callable[..., Sequence[object]]) -> ct.NonlinearIOSystem:
    """Plant with all its states as outputs."""
    names = states.split()
    return ct.nlsys(
        lambda t, x, u, params: rates(*x, *u), None, states=names, inputs=inputs.split(), outputs=names, name=name
    )


sin, cos, tan = np.sin, np.cos, np.tan

unicycle = system("unicycle", "x y th", "v w", lambda x, y, th, v, w: [v * cos(th), v * sin(th), w])
car = system("car", "x y th", "v delta", lambda x, y, th, v, delta: [v * cos(th), v * sin(th), v * tan(delta) / 3.0])
car_rate = system(
    "car_rate",
    "x y th delta",
    "v rate",
    lambda x, y, th, delta, v, rate: [v * cos(th), v * sin(th), v * tan(delta) / 3.0, rate],
)


def _trailer(x, y, head, th, v, delta):
    """Car with one trailer of 2 m, hitched on its rear axle; (x, y) is the trailer's axle."""
    speed = v * cos(head - th)
    return [speed * cos(th), speed * sin(th), v * tan(delta) / 3.0, v * sin(head - th) / 2.0]


def _two_trailers(x, y, head, first, th, v, delta):
    speed = v * cos(head - first)
    last = speed * cos(first - th)
    return [
        last * cos(th),
        last * sin(th),
        v * tan(delta) / 3.0,
        v * sin(head - first) / 2.0,
        speed * sin(first - th) / 2.0,
    ]


def _hitched_behind(x, y, head, th, v, delta):
    """The hitch is 0.5 m behind the car's axle; (x, y) is the trailer's axle."""
    turning = v * tan(delta) / 3.0
    speed = v * cos(head - th) + 0.5 * turning * sin(head - th)
    return [
        speed * cos(th),
        speed * sin(th),
        turning,
        (v * sin(head - th) - 0.5 * turning * cos(head - th)) / 2.0,
    ]


trailer = system("trailer", "x y head th", "v delta", _trailer)
two_trailers = system("two_trailers", "x y head first th", "v delta", _two_trailers)
hitched = system("hitched", "x y head th", "v delta", _hitched_behind)

MASS, INERTIA, ARM = 4.0, 0.0475, 0.25


def _pvtol(drag):
    def rates(x, y, th, vx, vy, w, side, lift):
        return [
            vx,
            vy,
            w,
            (side * cos(th) - lift * sin(th) - drag * vx) / MASS,
            (side * sin(th) + lift * cos(th) - drag * vy) / MASS - G,
            ARM * side / INERTIA,
        ]

    return system("pvtol", "x y th vx vy w", "side lift", rates)


pvtol, dragged = _pvtol(0.0), _pvtol(0.05)


def huygens(x, u, params):
    """Centre of oscillation of the PVTOL."""
    a = INERTIA / (MASS * ARM)
    return [x[0] - a * sin(x[2]), x[1] + a * cos(x[2])]


planar_quadrotor = system(
    "planar_quadrotor",
    "x z th vx vz w",
    "left right",
    lambda x, z, th, vx, vz, w, left, right: [
        vx,
        vz,
        w,
        -sin(th) * (left**2 + right**2) / 0.8,
        cos(th) * (left**2 + right**2) / 0.8 - G,
        0.2 * (right**2 - left**2) / 0.01,
    ],
)


def _quadrotor(drag):
    def rates(px, py, pz, vx, vy, vz, roll, pitch, yaw, p, q, r, thrust, tx, ty, tz):
        a = thrust / 1.2
        return [
            vx,
            vy,
            vz,
            a * (cos(roll) * sin(pitch) * cos(yaw) + sin(roll) * sin(yaw)) - drag * vx,
            a * (cos(roll) * sin(pitch) * sin(yaw) - sin(roll) * cos(yaw)) - drag * vy,
            a * cos(roll) * cos(pitch) - G - drag * vz,
            p + sin(roll) * tan(pitch) * q + cos(roll) * tan(pitch) * r,
            cos(roll) * q - sin(roll) * r,
            (sin(roll) * q + cos(roll) * r) / cos(pitch),
            (tx + (0.025 - 0.04) * q * r) / 0.02,
            (ty + (0.04 - 0.02) * p * r) / 0.025,
            (tz + (0.02 - 0.025) * p * q) / 0.04,
        ]

    return system("quadrotor", "px py pz vx vy vz roll pitch yaw p q r", "thrust tx ty tz", rates)


quadrotor, dragged_quadrotor = _quadrotor(0.0), _quadrotor(0.1)


def _slung_load(x, z, phi, th, vx, vz, wphi, wth, thrust, torque):
    """Planar quadrotor at (x, z) with a load on a cable of 1.5 m at angle phi from the vertical."""
    mass, load, length = 1.0, 0.4, 1.5
    along = thrust * cos(th - phi)  # thrust along the cable, upwards
    across = thrust * sin(th - phi)
    tension = load * (along + mass * length * wphi**2) / (mass + load)
    ax = (-thrust * sin(th) + tension * sin(phi)) / mass
    az = (thrust * cos(th) - tension * cos(phi)) / mass - G
    return [vx, vz, wphi, wth, ax, az, across / (mass * length), torque / 0.02]


slung = system("slung", "x z phi th vx vz wphi wth", "thrust torque", _slung_load)


def load_position(x, u, params):
    """Position of the load: from the equations of the quadrotor, x + l sin(phi), z - l cos(phi)."""
    return [x[0] + 1.5 * sin(x[2]), x[1] - 1.5 * cos(x[2])]


levitation_current = system("levitation_current", "gap v", "i", lambda gap, v, i: [v, G - 1e-3 * i**2 / gap**2])
levitation = system(
    "levitation",
    "gap v i",
    "u",
    lambda gap, v, i, u: [v, G - 1e-3 * i**2 / gap**2, (u - 2.0 * i + 2e-3 * v * i / gap**2) * gap / 2e-3],
)
joint = system(
    "joint",
    "q1 w1 q2 w2",
    "u",
    lambda q1, w1, q2, w2, u: [w1, (-9.0 * sin(q1) - 50.0 * (q1 - q2)) / 1.5, w2, (u + 50.0 * (q1 - q2)) / 0.4],
)


def _arm(q1, q2, w1, w2, u1, u2):
    m11, m12, m22 = 2.0 + 0.8 * cos(q2), 0.5 + 0.4 * cos(q2), 0.5
    h = 0.4 * sin(q2)
    b1, b2 = u1 + h * w2 * (2 * w1 + w2) - G * cos(q1), u2 - h * w1**2 - 0.5 * G * cos(q1 + q2)
    det = m11 * m22 - m12 * m12
    return [w1, w2, (m22 * b1 - m12 * b2) / det, (m11 * b2 - m12 * b1) / det]


arm = system("arm", "q1 q2 w1 w2", "u1 u2", _arm)


def two_mass(damping):
    """Motor (1 kg m2) and load (2 kg m2) on a shaft of 50 N m/rad."""

    def rates(x1, v1, x2, v2, u):
        shaft = 50.0 * (x1 - x2) + damping * (v1 - v2)
        return [v1, u - shaft, v2, shaft / 2.0]

    return system("two_mass", "x1 v1 x2 v2", "u", rates)


converter = system(
    "converter", "i v", "u", lambda i, v, u: [(12.0 - (1.0 - u) * v) / 0.02, ((1.0 - u) * i - v / 30.0) / 1e-4]
)
machine = system(
    "machine",
    "th w id iq",
    "ud uq",
    lambda th, w, id_, iq, ud, uq: [
        w,
        (1.5 * 4 * (0.1 * iq + (4e-3 - 6e-3) * id_ * iq) - 0.02 * w) / 0.01,
        (ud - 0.5 * id_ + 4 * w * 6e-3 * iq) / 4e-3,
        (uq - 0.5 * iq - 4 * w * (4e-3 * id_ + 0.1)) / 6e-3,
    ],
)
tank = system(
    "tank",
    "c T",
    "Tj",
    lambda c, T, Tj: [
        0.02 * (1.0 - c) - 5e8 * np.exp(-8000.0 / T) * c,
        0.02 * (350.0 - T) + 200.0 * 5e8 * np.exp(-8000.0 / T) * c + 0.03 * (Tj - T),
    ],
)
two_tanks = system(
    "two_tanks",
    "h1 h2",
    "q",
    lambda h1, h2, q: [q - 0.1 * np.sqrt(h1), 0.1 * np.sqrt(h1) - 0.1 * np.sqrt(h2)],
)
cart = system(
    "cart",
    "s v th w",
    "u",
    lambda s, v, th, w, u: [
        v,
        (u + sin(th) * (w**2 + G * cos(th))) / (1 + sin(th) ** 2),
        w,
        (-u * cos(th) - w**2 * cos(th) * sin(th) - 2 * G * sin(th)) / (1 + sin(th) ** 2),
    ],
)
ball = system("ball", "s v th w", "u", lambda s, v, th, w, u: [v, 0.714 * (s * w**2 - G * sin(th)), w, u])
crane = cp.plants.Crane()

CASES: dict[str, Case] = {
    "crane": Case(crane.iosystem(), ["x", "z"], (4, 4), 2, at={"R": 10.0}),
    "crane, rope wrapped": Case(cp.plants.Crane(rope_wrap=True).iosystem(), ["x", "z"], (4, 4), 2, at={"R": 10.0}),
    "unicycle": Case(unicycle, ["x", "y"], (2, 2), 1, at={"v": 1.0}),
    "unicycle at rest": Case(unicycle, ["x", "y"], (2, 2), 1),
    "car": Case(car, ["x", "y"], (2, 2), 1, at={"v": 1.0}),
    "car, steering rate": Case(car_rate, ["x", "y"], (3, 3), 2, at={"v": 1.0}),
    "trailer": Case(trailer, ["x", "y"], (3, 3), 2, at={"v": 1.0}),
    "two trailers": Case(two_trailers, ["x", "y"], (4, 4), 3, at={"v": 1.0}),
    "hitch behind the axle": Case(hitched, ["x", "y"], None, internal=1, at={"v": 1.0}),
    "pvtol": Case(pvtol, huygens, (4, 4), 2),
    "pvtol, centre of mass": Case(pvtol, ["x", "y"], None, internal=2),
    "pvtol with drag": Case(dragged, huygens, None, internal=1),
    "planar quadrotor": Case(planar_quadrotor, ["x", "z"], (4, 4), 2, at={"th": 0.0}),
    "quadrotor": Case(quadrotor, ["px", "py", "pz", "yaw"], (4, 4, 4, 2), 2),
    "quadrotor with drag": Case(dragged_quadrotor, ["px", "py", "pz", "yaw"], (4, 4, 4, 2), 2),
    "slung load": Case(slung, load_position, (6, 6), 4),
    "levitation, current": Case(levitation_current, ["gap"], (2,), at={"gap": 0.01}),
    "levitation, voltage": Case(levitation, ["gap"], (3,), at={"gap": 0.01}),
    "flexible joint": Case(joint, ["q1"], (4,)),
    "two-link arm": Case(arm, ["q1", "q2"], (2, 2)),
    "two masses": Case(two_mass(0.0), ["x2"], (4,)),
    "two masses, damped": Case(two_mass(2.0), ["x2"], None, internal=1),
    "two masses, damped, Brunovsky": Case(two_mass(2.0), lambda x, u, params: [x[0] / 24.0 + x[2] - x[3] / 24.0], (4,)),
    "converter, energy": Case(
        converter, lambda x, u, params: [0.5 * 0.02 * x[0] ** 2 + 0.5 * 1e-4 * x[1] ** 2], (2,), at={"v": 24.0}
    ),
    "converter, voltage": Case(converter, ["v"], None, internal=1, at={"v": 24.0}),
    "machine": Case(machine, ["th", "id"], (3, 1)),
    "stirred tank": Case(tank, ["c"], (2,), at={"T": 350.0}),
    "stirred tank, temperature": Case(tank, ["T"], None, internal=1, at={"T": 350.0}),
    "two tanks": Case(two_tanks, ["h2"], (2,), at={"h2": 1.0}),
    "cart with pendulum": Case(cart, ["s"], None, internal=2),
    "cart with pendulum, angle": Case(cart, ["th"], None, internal=2),
    "ball and beam": Case(ball, ["s"], None, internal=1),
}
"""Plants by name."""
