"""Control laws of the crane as blocks: from a plan of the load to PID references, or to force and torque.

`control.interconnect` connects each of them by name to a source with the suffix
``_ref`` and to the crane. All are finite at zero inputs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import control as ct
import numpy as np

from ctrlplan._checks import checked_finite, checked_labels, checked_names
from ctrlplan._renamed import former_signature, warn_renamed
from ctrlplan._types import Array, Value
from ctrlplan.systems.plants.crane.flatness import checked_formulas
from ctrlplan.systems.plants.crane.parameters import CraneParameters
from ctrlplan.systems.poles import hurwitz_coefficients
from ctrlplan.systems.series import Quantity
from ctrlplan.trajectories.files import signal_names

Params = Mapping[str, float]
F = TypeVar("F", bound=Callable[..., ct.NonlinearIOSystem])

_ARGUMENTS = """labels : sequence of str, optional
    Names of the plan's axes, by default x and z.
suffix : str, optional
    Appended to each label in the names of the references.
name : str, optional
    Name of the block.

Returns
-------
control.NonlinearIOSystem
    {}

Raises
------
ValueError
    If there are not two labels, or a reference has the name of another input."""
"""Arguments that the factories share, in their docstrings."""


def _documented(factory: F) -> F:
    """Factory with the shared arguments in its docstring."""
    static, dynamic = _ARGUMENTS.format("Static, of any time base."), _ARGUMENTS.format("In continuous time.")
    doc = inspect.cleandoc(factory.__doc__ or "")
    factory.__doc__ = doc.replace("%(static)s", static).replace("%(dynamic)s", dynamic)
    return factory


@former_signature("name")
@_documented
def create_setpoint_iosystem(
    crane: CraneParameters,
    *,
    labels: Sequence[str] | None = None,
    suffix: str = "_ref",
    name: str = "setpoint",
) -> ct.NonlinearIOSystem:
    """Set-point law: trolley and rope references for a load at rest.

    No states. Inputs: x_ref and z_ref. Outputs: D_ref = x - b and R_ref = z [m].

    Parameters
    ----------
    crane : Crane
        The plant.
    %(static)s

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> crane = cp.plants.Crane()
    >>> step = cp.Step([1.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    >>> source = cp.create_source_iosystem(step, suffix="_ref")
    >>> law = cp.plants.create_setpoint_iosystem(crane)
    >>> references = ct.interconnect([source, law], inputs=0, outputs=["D_ref", "R_ref"])
    >>> cp.simulate(references, [0.0, 1.0]).outputs[:, -1].tolist()
    [0.75, 10.0]
    """
    b = crane.drum_radius

    def out(t: float, state: Array, u: Array, params: Params) -> Array:
        return np.array([u[0] - b, u[1]])

    inputs = _input_names(0, labels, suffix)
    return ct.nlsys(None, out, inputs=inputs, outputs=["D_ref", "R_ref"], dt=None, name=name)


def create_still_iosystem(crane: CraneParameters, *args: str, **options: Value) -> ct.NonlinearIOSystem:
    """Old name of `create_setpoint_iosystem`.

    Warns
    -----
    FutureWarning
        Always.
    """
    warn_renamed("create_still_iosystem", "create_setpoint_iosystem")
    return create_setpoint_iosystem(crane, *args, **options)


@former_signature("name")
@_documented
def create_generator_iosystem(
    crane: CraneParameters,
    *,
    labels: Sequence[str] | None = None,
    suffix: str = "_ref",
    name: str = "generator",
) -> ct.NonlinearIOSystem:
    """Reference generator of figure 3: (15a,b) with the planned jets.

    No states. Inputs: x_ref, x_ref_d1, x_ref_d2 and the same of z_ref. Outputs:
    D_ref and R_ref [m]. Without feedback from the load, sway is not damped.

    Parameters
    ----------
    crane : Crane
        The plant.
    %(static)s

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> crane = cp.plants.Crane()
    >>> plan = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    >>> source = cp.create_source_iosystem(plan, 2, suffix="_ref")
    >>> law = cp.plants.create_generator_iosystem(crane)
    >>> references = ct.interconnect([source, law], inputs=0, outputs=["D_ref", "R_ref"])
    >>> cp.simulate(references, [0.0, 1.0]).outputs[:, -1].tolist()
    [-0.25, 10.0]
    """

    def out(t: float, state: Array, u: Array, params: Params) -> Array:
        return np.array(_pid_references(crane, u[0], u[2], u[3], u[5]))

    inputs = _input_names(2, labels, suffix)
    return ct.nlsys(None, out, inputs=inputs, outputs=["D_ref", "R_ref"], dt=None, name=name)


@former_signature("name", renamed={"bandwidth": "load_bandwidth"})
@_documented
def create_load_feedback_iosystem(
    crane: CraneParameters,
    load_bandwidth: float = 1.0,
    damping: float = 1.0,
    *,
    labels: Sequence[str] | None = None,
    suffix: str = "_ref",
    name: str = "load_feedback",
) -> ct.NonlinearIOSystem:
    """Reference generator with load feedback, which damps sway.

    In (15a,b) x is measured, and x'' is replaced by
    v = x_d'' - 2 zeta w (x' - x_d') - w^2 (x - x_d). z is the planned one, because
    feedback of z leaves a double eigenvalue at 0.

    No states. Inputs: x_ref, x_ref_d1, x_ref_d2, the same of z_ref, and the
    measured x and x_d1. Outputs: D_ref and R_ref [m].

    Parameters
    ----------
    crane : Crane
        The plant.
    load_bandwidth : float, optional
        w [rad/s], above 0; the loop with the PIDs of the study is stable from
        0.1 to 3.
    damping : float, optional
        zeta, above 0; 0.7 to 1.
    %(static)s
        Also if `load_bandwidth` or `damping` is not above 0.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> crane = cp.plants.Crane()
    >>> plan = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    >>> source = cp.create_source_iosystem(plan, 2, suffix="_ref")
    >>> law = cp.plants.create_load_feedback_iosystem(crane, 0.5)
    >>> plant, pids = crane.iosystem(), [crane.trolley_pid(), crane.hoist_pid()]
    >>> loop = ct.interconnect([source, law, *pids, plant], inputs=0, outputs=plant.output_labels)
    >>> loop.nstates
    10
    """
    w, zeta = checked_finite(load_bandwidth, "load_bandwidth", above=0.0), checked_finite(damping, "damping", above=0.0)
    s0, s1 = w**2, 2.0 * zeta * w

    def out(t: float, state: Array, u: Array, params: Params) -> Array:
        x2 = u[2] - s1 * (u[7] - u[1]) - s0 * (u[6] - u[0])
        return np.array(_pid_references(crane, u[6], x2, u[3], u[5]))

    inputs = _input_names(2, labels, suffix, ["x", "x_d1"])
    return ct.nlsys(None, out, inputs=inputs, outputs=["D_ref", "R_ref"], dt=None, name=name)


@former_signature("name")
@_documented
def create_dynamic_law_iosystem(
    crane: CraneParameters,
    poles: Sequence[complex] = (-1.0, -1.2, -1.4, -1.6),
    *,
    labels: Sequence[str] | None = None,
    suffix: str = "_ref",
    name: str = "dynamic_law",
) -> ct.NonlinearIOSystem:
    """Dynamic feedback linearisation of the crane, (9)-(11).

    The closed loop consists of two chains of four integrators.

    States: tension_offset [N], the tension minus the weight of the load, so that
    the zero state is the equilibrium, and tension_rate [N/s]. Inputs: x_ref,
    x_ref_d1, ... up to order 4, the same of z_ref, then x, z, x_d1, z_d1, R,
    theta, D_d1, R_d1, theta_d1 of the crane. Outputs: F [N] and C [N m].

    Parameters
    ----------
    crane : Crane
        The plant, with either value of `rope_wrap`.
    poles : sequence of complex, optional
        Four poles [rad/s] of the error of x; the error of z has the same.
    %(dynamic)s
        Also if the poles are not four, not conjugate pairs, or not stable.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> crane = cp.plants.Crane()
    >>> plan = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    >>> source = cp.create_source_iosystem(plan, 4, suffix="_ref")
    >>> law = cp.plants.create_dynamic_law_iosystem(crane)
    >>> plant = crane.iosystem()
    >>> loop = ct.interconnect([source, law, plant], inputs=0, outputs=plant.output_labels)
    >>> loop.state_labels[:2]
    ['dynamic_law_tension_offset', 'dynamic_law_tension_rate']
    """
    sigma = hurwitz_coefficients(poles, 4)
    m, g, b = crane.load_mass, crane.gravity, crane.drum_radius

    def second(state: Array, u: Array) -> tuple[float, float]:
        """T'' and theta''."""
        tension, rate = m * g + state[0], state[1]
        x, z, x1, z1, _, theta, _, _, theta1 = (u[10 + i] for i in range(9))
        s, c = np.sin(theta), np.cos(theta)
        jet_x = (x, x1, -tension * s / m, -(rate * s + tension * theta1 * c) / m)
        jet_z = (z, z1, g - tension * c / m, -(rate * c - tension * theta1 * s) / m)
        v_x, v_z = (
            u[5 * a + 4] - sum(sigma[k] * (jet[k] - u[5 * a + k]) for k in range(4))
            for a, jet in enumerate((jet_x, jet_z))
        )
        p = -m * v_x - (2.0 * rate * theta1 * c - tension * theta1 * theta1 * s)
        q = -m * v_z - (-2.0 * rate * theta1 * s - tension * theta1 * theta1 * c)
        # [s, T c; c, -T s] [T''; theta''] = [p; q]
        return s * p + c * q, (c * p - s * q) / tension

    def update(t: float, state: Array, u: Array, params: Params) -> Array:
        return np.array([state[1], second(state, u)[0]])

    def out(t: float, state: Array, u: Array, params: Params) -> Array:
        tension, theta2 = m * g + state[0], second(state, u)[1]
        _, _, _, _, r, theta, d1, r1, theta1 = (u[10 + i] for i in range(9))
        s, c = np.sin(theta), np.cos(theta)
        d2 = -(r * theta2 + g * s + 2.0 * r1 * theta1 - b * theta1 * theta1) / c
        r2 = g * c + r * theta1 * theta1 + b * theta2 - d2 * s - tension / m
        return np.array(_inputs(crane, tension, s, d1, d2, r1, r2, theta1, theta2))

    measured = ["x", "z", "x_d1", "z_d1", "R", "theta", "D_d1", "R_d1", "theta_d1"]
    return ct.nlsys(
        update,
        out,
        states=["tension_offset", "tension_rate"],
        inputs=_input_names(4, labels, suffix, measured),
        outputs=["F", "C"],
        name=name,
    )


@former_signature("name")
@_documented
def create_crane_feedforward_iosystem(
    crane: CraneParameters,
    *,
    labels: Sequence[str] | None = None,
    suffix: str = "_ref",
    name: str = "feedforward",
) -> ct.NonlinearIOSystem:
    """Flat feedforward of the crane: force and torque from the plan.

    No states. Inputs: x_ref, x_ref_d1, ... up to order 4 and the same of z_ref.
    Outputs: F [N] and C [N m], exact for the model, without feedback.

    Parameters
    ----------
    crane : Crane
        The plant.
    %(static)s

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> crane = cp.plants.Crane()
    >>> plan = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    >>> source = cp.create_source_iosystem(plan, 4, suffix="_ref")
    >>> law = cp.plants.create_crane_feedforward_iosystem(crane)
    >>> plant, start = crane.iosystem(), crane.equilibrium(0.0, 10.0)[0]
    >>> loop = ct.interconnect([source, law, plant], inputs=0, outputs=[*plant.output_labels, "C"])
    >>> cp.simulate(loop, [0.0, 1.0], initial_state=start).outputs[-1].tolist()
    [-1226.25, -1226.25]
    """

    def out(t: float, state: Array, u: Array, params: Params) -> Array:
        jet = np.stack([np.asarray(u[:5]), np.asarray(u[5:10])], axis=1)
        # Symbols cannot be checked; `crane_loop` has checked the whole plan.
        found = checked_formulas(crane.numbers(), crane.rope_wrap, jet)
        return np.array([found["F"], found["C"]])

    return ct.nlsys(None, out, inputs=_input_names(4, labels, suffix), outputs=["F", "C"], dt=None, name=name)


def _input_names(order: int, labels: Sequence[str] | None, suffix: str, measured: Sequence[str] = ()) -> list[str]:
    """Names of the references axis by axis, then of the measurements."""
    axes = [label + suffix for label in checked_labels(("x", "z") if labels is None else labels, 2)]
    return checked_names([*signal_names(axes, order), *measured], "inputs")


def _pid_references(crane: CraneParameters, x: Quantity, x2: Quantity, z: Quantity, z2: Quantity) -> list[Quantity]:
    """D and R of (15a,b)."""
    b, hanging = crane.drum_radius, crane.gravity - z2
    pull = np.sqrt(x2 * x2 + hanging * hanging)
    return [x - (b * pull - z * x2) / hanging, (z * pull - b * x2) / hanging]


def _inputs(
    crane: CraneParameters,
    tension: Quantity,
    sine: Quantity,
    d1: Quantity,
    d2: Quantity,
    r1: Quantity,
    r2: Quantity,
    theta1: Quantity,
    theta2: Quantity,
) -> list[Quantity]:
    """F and C from (14)."""
    b = crane.drum_radius
    drum1, drum2 = r1 / b, r2 / b
    if crane.rope_wrap:
        drum1, drum2 = drum1 - theta1, drum2 - theta2
    return [
        crane.trolley_mass * d2 + crane.trolley_friction * d1 - tension * sine,
        crane.drum_inertia * drum2 + crane.drum_friction * drum1 - b * tension,
    ]
