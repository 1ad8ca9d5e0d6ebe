"""The crane of the paper's section 5: trolley, hoist and a load on a rope.

z points down. The rope leaves a drum of radius b on the trolley and hangs with
length R from the point of tangency, at the angle theta from the vertical;
equation numbers are the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan.systems import series
from ctrlplan.systems.pid import create_pid_iosystem
from ctrlplan.systems.plants.parameters import check_parameters, overruled
from ctrlplan.traits import declare
from ctrlplan.trajectories import Extrema, Trajectory

Array = NDArray[np.float64]

STATES = ("D", "R", "theta", "D_d1", "R_d1", "theta_d1")
_NUMBERS = (
    "load_mass",
    "trolley_mass",
    "drum_inertia",
    "drum_radius",
    "trolley_friction",
    "drum_friction",
    "gravity",
)
OUTPUTS = ("x", "z", "D", "R", "theta", "x_d1", "z_d1", "D_d1", "R_d1", "theta_d1", "T")


@dataclass(frozen=True, kw_only=True)
class Crane:
    """Crane with a trolley, a drum and a load; its equations, flat maps and loops.

    Parameters
    ----------
    load_mass : float
        m [kg].
    trolley_mass : float
        M_c [kg].
    drum_inertia : float
        J [kg m^2].
    drum_radius : float
        b [m].
    trolley_friction : float
        f1 [N s/m].
    drum_friction : float
        f2 [N m s].
    gravity : float
        g [m/s^2].
    rope_wrap : bool
        False is the paper's (14b), which neglects that the rope winds on the
        drum as theta turns; True keeps that term, and with it the energy.

    Raises
    ------
    ValueError
        If a mass, the inertia, the radius or gravity is not above 0, or a
        friction is negative.

    Examples
    --------
    >>> crane = Crane(load_mass=500.0)
    >>> state, inputs = crane.equilibrium(x=0.0, z=10.0)
    >>> inputs.tolist()
    [0.0, -1226.25]
    """

    load_mass: float = 500.0
    trolley_mass: float = 5000.0
    drum_inertia: float = 50.0
    drum_radius: float = 0.25
    trolley_friction: float = 20.0
    drum_friction: float = 20.0
    gravity: float = 9.81
    rope_wrap: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.rope_wrap, bool):
            raise TypeError(f"rope_wrap must be True or False, got {self.rope_wrap!r}")
        numbers = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "rope_wrap"}
        frictions = {name: numbers.pop(name) for name in ("trolley_friction", "drum_friction")}
        check_parameters(numbers, frictions)

    # The nonlinear plant

    def iosystem(self, name: str = "crane", *, wind: bool = False) -> ct.NonlinearIOSystem:
        """Nonlinear plant, equations (13) and (14).

        States D, R, theta and their rates; inputs F [N] on the trolley, C [N m]
        on the drum, and with `wind` the horizontal force wind [N] on the load,
        along x; outputs x, z, D, R, theta, the rates x_d1, z_d1,
        D_d1, R_d1, theta_d1, and the tension T [N]. Parameters of a run named
        as this crane's own (``params={"load_mass": 1000.0}``) overrule them in
        the plant alone: a payload that the controller does not know of.
        """
        block = ct.nlsys(
            self._update,
            self._output,
            states=list(STATES),
            inputs=["F", "C", "wind"] if wind else ["F", "C"],
            outputs=list(OUTPUTS),
            name=name,
        )
        # At once, forces and torque act on the tension alone.
        declare(block, feedthrough=np.array([[output == "T"] * (2 + wind) for output in OUTPUTS]))
        return block

    def equilibrium(self, x: float, z: float) -> tuple[Array, Array]:
        """State and inputs (F, C) at which the load rests at (x, z).

        Raises
        ------
        ValueError
            If z is not above 0: the load hangs below the trolley.
        """
        if not z > 0.0:
            raise ValueError(f"z must be above 0 (down), got {z:g}")
        if not math.isfinite(x + z):
            raise ValueError(f"x and z must be finite, got {x:g} and {z:g}")
        state = np.array([x - self.drum_radius, z, 0.0, 0.0, 0.0, 0.0])
        return state, np.array([0.0, -self.drum_radius * self.load_mass * self.gravity])

    def accelerations(self, state: Any, force: Any, torque: Any, wind: Any = 0.0) -> tuple[Any, Any, Any, Any]:
        """D'', R'', theta'' and the tension T, solved from (13) and (14)."""
        return self._accelerations(self._numbers(), state, force, torque, wind)

    def _accelerations(
        self, numbers: tuple[Any, ...], state: Any, force: Any, torque: Any, wind: Any
    ) -> tuple[Any, Any, Any, Any]:
        m, trolley, inertia, b, f1, f2, g = numbers
        _, r, theta, d_rate, r_rate, rate = (state[i] for i in range(6))
        s, c = np.sin(theta), np.cos(theta)
        # Each acceleration is linear in T; the first equation of motion then gives T.
        d0, d1 = (force - f1 * d_rate) / trolley, s / trolley
        push = wind / m
        swing = push * c - g * s - 2.0 * r_rate * rate + b * rate * rate
        t0, t1 = (swing - c * d0) / r, -c * d1 / r
        along = push * s + g * c + r * rate * rate
        if self.rope_wrap:
            r0, r1 = b / inertia * (torque - f2 * (r_rate / b - rate)), b * b / inertia
            tension = (along - s * d0 - r0) / (s * d1 + r1 + 1.0 / m)
            turning = t0 + t1 * tension
            return d0 + d1 * tension, r0 + r1 * tension + b * turning, turning, tension
        r0, r1 = b / inertia * (torque - f2 * r_rate / b), b * b / inertia
        tension = (along - s * d0 - r0 + b * t0) / (s * d1 + r1 + 1.0 / m - b * t1)
        return d0 + d1 * tension, r0 + r1 * tension, t0 + t1 * tension, tension

    def energy(self, state: ArrayLike) -> Array:
        """Mechanical energy [J] of states (6, ...); zero potential at z = 0.

        The drum turns at R'/b, or with `rope_wrap` at R'/b - theta'.
        """
        values = np.asarray(state, dtype=float)
        m, trolley, inertia, b, _, _, g = self._numbers()
        _, z, x_rate, z_rate = _load(self.drum_radius, values)
        drum = values[4] / b - (values[5] if self.rope_wrap else 0.0)
        kinetic = 0.5 * (m * (x_rate**2 + z_rate**2) + trolley * values[3] ** 2 + inertia * drum**2)
        return kinetic - m * g * z

    # The flat maps

    def quantities(self, jet: ArrayLike) -> dict[str, Array]:
        """States, tension and inputs from the jet of the load, (15a-d), in (15c) with the quadrant.

        Parameters
        ----------
        jet : array_like, shape (order + 1, 2, ...)
            Derivatives of x and z; order 2 gives positions and tension, 3
            their rates, 4 the inputs as well.

        Returns
        -------
        dict of str to ndarray
            D, R, theta, T; from order 3 on D_d1, R_d1, theta_d1, T_d1; from
            order 4 on D_d2, R_d2, theta_d2, T_d2, F, C.

        Raises
        ------
        ValueError
            If the order is below 2, or g - z'' is not above 0 somewhere: the
            rope cannot push.
        """
        values = np.asarray(jet, dtype=float)
        if values.ndim < 2 or values.shape[1] != 2 or len(values) < 3:
            raise ValueError(f"jet must have shape (order + 1, 2, ...) with order at least 2, got {values.shape}")
        lowest = float(np.min(self.gravity - values[2, 1], initial=np.inf))
        if not lowest > 0.0:
            raise ValueError(f"g - z'' must be above 0 for a taut rope, got {lowest:.4g} m/s^2")
        return self._quantities(values)

    def _quantities(self, values: Any) -> dict[str, Any]:
        """The same, unchecked: of symbols as well."""
        m, trolley, inertia, b, f1, f2, g = self._numbers()
        x, z = series.from_jet(values[:, 0]), series.from_jet(values[:, 1])
        across, fall = series.derivative(x, 2), series.derivative(z, 2)
        hanging = -fall
        hanging[0] += g
        pull = series.sqrt(series.multiply(across, across) + series.multiply(hanging, hanging))
        theta = series.arctan2(-across, hanging)
        r = series.divide(series.multiply(z, pull) - b * across, hanging)
        d = x[: len(pull)] - series.divide(b * pull - series.multiply(z, across), hanging)
        jets = {
            "D": series.to_jet(d),
            "R": series.to_jet(r),
            "theta": series.to_jet(theta),
            "T": m * series.to_jet(pull),
        }
        out = {name: values[0] for name, values in jets.items()}
        for nu in range(1, len(pull)):
            out |= {f"{name}_d{nu}": values[nu] for name, values in jets.items()}
        if len(pull) > 2:
            drum, drum_rate = out["R_d2"] / b, out["R_d1"] / b
            if self.rope_wrap:
                drum, drum_rate = drum - out["theta_d2"], drum_rate - out["theta_d1"]
            out["F"] = trolley * out["D_d2"] + f1 * out["D_d1"] + m * values[2, 0]
            out["C"] = inertia * drum + f2 * drum_rate - b * out["T"]
        return out

    def check(self, plan: Trajectory) -> None:
        """Refuse a plan of the load that the crane cannot follow.

        Over the whole interval, not at samples: g - z'' and T must be above 0
        (from the exact extrema of z''), and so must R (from certified bounds of
        a function of the jet).

        Parameters
        ----------
        plan : Trajectory
            Plan of x and z.

        Raises
        ------
        ValueError
            With the quantity, its limit, the worst value and its time.
        """
        if plan.naxes != 2:
            raise ValueError(f"a plan of the load must have the axes x and z, got {plan.naxes} axes")
        g = self.gravity
        fall = plan.extrema(2)
        if not g - fall.maximum[1] > 0.0:
            raise ValueError(
                f"the rope can only pull: g - z'' must be above 0, got {g - fall.maximum[1]:.4g} m/s^2 "
                f"at {fall.time_max[1]:.4g} s (tension T <= 0)"
            )
        if not plan.duration:
            least, time = float(min(plan.initial[1], plan.final[1])), plan.start
        else:
            least, time = self._shortest_rope(plan, fall)
        if not least > 0.0:
            raise ValueError(f"the rope length R must be above 0, got {least:.4g} m at {time:.4g} s")

    def rope(self) -> CraneRope:
        """Rope of this crane, from the load up to the drum, as `planning.clearance` asks for one."""
        return CraneRope(self.drum_radius, self.gravity)

    def _shortest_rope(self, plan: Trajectory, acceleration: Extrema) -> tuple[float, float]:
        """Certified lower bound of R over a plan, or its least value where that decides or no bound does."""
        g, b = self.gravity, self.drum_radius

        def length(jet: Array) -> Array:
            across, hanging = jet[2, 0], g - jet[2, 1]
            return (jet[0, 1] * np.hypot(across, hanging) - b * across) / hanging

        depth, across = float(plan.peak()[1]), float(max(-acceleration.minimum[0], acceleration.maximum[0]))
        least, most = g - float(acceleration.maximum[1]), g - float(acceleration.minimum[1])
        pull = math.hypot(across, most)
        # Bounds of dR/dz, dR/dx'' and dR/dz'' over the ranges of the plan.
        slopes = np.zeros((3, 2))
        slopes[0, 1] = pull / least
        slopes[2] = (depth + b) / least, depth / least + (depth * pull + b * across) / least**2
        try:
            found = plan.bounds(length, 2, slopes, max_cells=200_000)
        except ValueError:  # so near to a limit that no number of cells decides
            resolved = plan.extrema_of(length, 2)
            return float(resolved.minimum[0]), float(resolved.time_min[0])
        return (found.lower, found.time_min) if found.minimum > 0.0 else (found.minimum, found.time_min)

    # Linear models

    def linear_trolley(self, name: str = "trolley") -> ct.StateSpace:
        """D/F = 1/(s (M_c s + f1)): trolley alone, the tension a disturbance."""
        return _double(1.0 / self.trolley_mass, self.trolley_friction / self.trolley_mass, "F", "D", name)

    def linear_hoist(self, name: str = "hoist", *, with_load: bool = False) -> ct.StateSpace:
        """R/C = b/(s (J s + f2)): drum alone, the tension a disturbance.

        With the load, whose weight is balanced, J + m b^2 stands for J: the
        nonlinear crane linearised at rest.
        """
        inertia = self.drum_inertia + (self.load_mass * self.drum_radius**2 if with_load else 0.0)
        return _double(self.drum_radius / inertia, self.drum_friction / inertia, "C", "R", name)

    def linear_coupled(self, rope_length: float, name: str = "crane") -> ct.InterconnectedSystem:
        """Trolley and swing about rest at a rope length, coupled by the tension.

        An interconnection of the trolley and the pendulum; input F, outputs D
        and theta: D/F = (R s^2 + g)/(s [(M_c s + f1)(R s^2 + g) + m g s]).
        """
        if not 0.0 < rope_length < math.inf:
            raise ValueError(f"rope_length must be above 0 and finite, got {rope_length:g}")
        g = self.gravity
        trolley = ct.ss(
            [[0.0, 1.0], [0.0, -self.trolley_friction / self.trolley_mass]],
            [[0.0, 0.0], [1.0 / self.trolley_mass, self.load_mass * g / self.trolley_mass]],
            [[1.0, 0.0], [0.0, -self.trolley_friction / self.trolley_mass]],
            [[0.0, 0.0], [1.0 / self.trolley_mass, self.load_mass * g / self.trolley_mass]],
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

    # The controllers of the study

    def trolley_pid(self, bandwidth: float = 5.0, tf: float = 0.02, **options: Any) -> ct.NonlinearIOSystem:
        """PID on D with a triple pole at -bandwidth [rad/s] on the trolley alone; inputs D_ref and D, output F."""
        gains = _triple_pole(self.trolley_mass, self.trolley_friction, bandwidth)
        return create_pid_iosystem(*gains, tf, inputs=("D_ref", "D"), output="F", name="trolley_pid", **options)

    def hoist_pid(self, bandwidth: float = 5.0, tf: float = 0.02, **options: Any) -> ct.NonlinearIOSystem:
        """PID on R, the load's inertia included and its weight as the bias; inputs R_ref and R, output C."""
        b = self.drum_radius
        gains = _triple_pole(self.drum_inertia / b + self.load_mass * b, self.drum_friction / b, bandwidth)
        bias = -b * self.load_mass * self.gravity
        return create_pid_iosystem(
            *gains, tf, bias=bias, inputs=("R_ref", "R"), output="C", name="hoist_pid", **options
        )

    def linear_trolley_loop(self, bandwidth: float = 5.0, tf: float = 0.02) -> ct.InterconnectedSystem:
        """Trolley alone with its PID: input D_ref, output D."""
        blocks = [self.trolley_pid(bandwidth, tf), self.linear_trolley()]
        return ct.interconnect(blocks, inputs=["D_ref"], outputs=["D"], name="trolley_loop")

    def linear_hoist_loop(self, bandwidth: float = 5.0, tf: float = 0.02) -> ct.InterconnectedSystem:
        """Drum and load with their PID, about the weight of the load: input R_ref, output R."""
        b = self.drum_radius
        gains = _triple_pole(self.drum_inertia / b + self.load_mass * b, self.drum_friction / b, bandwidth)
        pid = create_pid_iosystem(*gains, tf, inputs=("R_ref", "R"), output="C", name="hoist_pid")
        return ct.interconnect(
            [pid, self.linear_hoist(with_load=True)], inputs=["R_ref"], outputs=["R"], name="hoist_loop"
        )

    def _numbers(self, params: dict[str, Any] | None = None) -> tuple[Any, ...]:
        """m, M_c, J, b, f1, f2, g, each overruled by a parameter of a run."""
        return overruled({name: getattr(self, name) for name in _NUMBERS}, params)

    def _update(self, t: float, state: Any, inputs: Any, params: dict[str, Any]) -> Array:
        d2, r2, theta2, _ = self._accelerations(self._numbers(params), state, *_forces(inputs))
        return np.array([state[3], state[4], state[5], d2, r2, theta2])

    def _output(self, t: float, state: Any, inputs: Any, params: dict[str, Any]) -> Array:
        numbers = self._numbers(params)
        x, z, x_rate, z_rate = _load(numbers[3], state)
        tension = self._accelerations(numbers, state, *_forces(inputs))[3]
        return np.array([x, z, state[0], state[1], state[2], x_rate, z_rate, state[3], state[4], state[5], tension])


@dataclass(frozen=True)
class CraneRope:
    """Straight rope from the load to the point where it leaves the drum.

    Attributes
    ----------
    drum_radius : float
        b [m].
    gravity : float
        g [m/s^2].
    order : int
        Highest derivative of the load that is read: 2.
    """

    drum_radius: float
    gravity: float
    order: ClassVar[int] = 2

    def top(self, jet: Array) -> Array:
        """Point (D + b cos theta, -b sin theta) at which the rope leaves the drum.

        Parameters
        ----------
        jet : ndarray, shape (order + 1, 2, ...)
            Derivatives of x and z, to order 2 at least.

        Returns
        -------
        ndarray, shape (2, ...)

        Raises
        ------
        ValueError
            If g - z'' is not above 0 somewhere: the rope cannot push.
        """
        across, hanging = jet[2, 0], self.gravity - jet[2, 1]
        if not np.min(hanging, initial=np.inf) > 0.0:
            raise ValueError(f"g - z'' must be above 0 for a taut rope, got {np.min(hanging):.4g} m/s^2")
        lean = across / np.hypot(across, hanging)
        over = jet[0, 0] + across / hanging * (jet[0, 1] - self.drum_radius * lean)
        return np.stack([over, self.drum_radius * lean])

    def slopes(self, plan: Trajectory) -> Array:
        """Bounds of |d top/d entry| over the jets of a plan.

        Parameters
        ----------
        plan : Trajectory
            Plan of x and z.

        Returns
        -------
        ndarray, shape (3, 2)
            Row nu, column axis: of the nu-th derivative of that axis.

        Raises
        ------
        ValueError
            If g - z'' is not above 0 over the whole plan.
        """
        b, fall = self.drum_radius, plan.extrema(2)
        least = self.gravity - float(fall.maximum[1])
        if not least > 0.0:
            raise ValueError(
                f"the rope can only pull: g - z'' must be above 0, got {least:.4g} m/s^2 "
                f"at {fall.time_max[1]:.4g} s (tension T <= 0)"
            )
        depth, across = float(plan.peak()[1]), float(max(-fall.minimum[0], fall.maximum[0]))
        lean = across / math.hypot(across, least)
        # With h = g - z'': top = (x + z x''/h - b x''^2/(h S), b x''/S), term by term.
        return np.array(
            [
                [1.0, across / least],
                [0.0, 0.0],
                [
                    math.hypot((depth + 2.0 * b * lean) / least, b / least),
                    math.hypot(across * (depth + 2.0 * b * lean) / least**2, b * lean / least),
                ],
            ]
        )


def _forces(inputs: Any) -> tuple[Any, Any, Any]:
    """F, C and the wind, 0 where none comes in."""
    return inputs[0], inputs[1], inputs[2] if inputs.shape[0] > 2 else 0.0


def _load(b: Any, state: Any) -> tuple[Any, Any, Any, Any]:
    """x, z and their rates of a state, b the radius of the drum."""
    d, r, theta, d_rate, r_rate, rate = (state[i] for i in range(6))
    s, c = np.sin(theta), np.cos(theta)
    x, z = r * s + d + b * c, r * c - b * s
    x_rate = r_rate * s + r * rate * c + d_rate - b * rate * s
    z_rate = r_rate * c - r * rate * s - b * rate * c
    return x, z, x_rate, z_rate


def _double(gain: float, damping: float, source: str, sink: str, name: str) -> ct.StateSpace:
    """gain/(s (s + damping))."""
    return ct.ss(
        [[0.0, 1.0], [0.0, -damping]], [[0.0], [gain]], [[1.0, 0.0]], [[0.0]], inputs=source, outputs=sink, name=name
    )


def _triple_pole(mass: float, friction: float, bandwidth: float) -> tuple[float, float, float]:
    """Kp, Ki, Kd that put three poles at -bandwidth on 1/(s (mass s + friction))."""
    if not (math.isfinite(bandwidth) and bandwidth > 0.0):
        raise ValueError(f"bandwidth must be finite and above 0, got {bandwidth:g}")
    return 3.0 * mass * bandwidth**2, mass * bandwidth**3, 3.0 * mass * bandwidth - friction
