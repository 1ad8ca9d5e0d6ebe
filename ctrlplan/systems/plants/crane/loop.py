"""Closed loops of the crane: source, control law, PIDs, crane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import Range, check_kind, checked_range
from ctrlplan.systems.plants.crane import linear, model
from ctrlplan.systems.plants.crane.flatness import FLAT_LABELS, check, check_axes
from ctrlplan.systems.plants.crane.laws import Law, LawName, as_law
from ctrlplan.systems.plants.crane.parameters import CraneParameters
from ctrlplan.systems.source import create_source_iosystem
from ctrlplan.traits import declare, traits_of
from ctrlplan.trajectories import Trajectory, stack


def crane_loop(
    crane: CraneParameters,
    plan: Trajectory,
    law: Law | LawName = "generator",
    *,
    load_bandwidth: float | None = None,
    damping: float | None = None,
    poles: Sequence[complex] | None = None,
    bandwidth: float = 5.0,
    tf: float = 0.02,
    force_limits: Range | None = None,
    torque_limits: Range | None = None,
    reference: Sequence[ct.InputOutputSystem] | None = None,
    wind: Trajectory | None = None,
    drive: model.Drive = "force",
    drive_lag: float = 0.1,
    inputs: Sequence[str] = (),
    name: str = "crane_loop",
) -> ct.InterconnectedSystem:
    """Closed loop of figure 3: source, control law, two PIDs, crane.

    With ``drive="velocity"`` the trolley is commanded by its speed, as by an
    operator: the input v_cmd [m/s] replaces the PID of the trolley, the speed
    follows it with a first-order lag, and only the hoist follows the plan.

    States: those of source, law and PIDs, then those of the crane. Inputs: none,
    or those in `inputs`; with velocity drive v_cmd as well. Outputs: those of the
    crane (x, z, D, R, theta, x_d1, z_d1, D_d1, R_d1, theta_d1, T), F, C, x_ref and
    z_ref; with velocity drive also sway_frequency, sqrt(g/R) [rad/s], and v_cmd if
    it is the output of a block.

    Parameters
    ----------
    crane : Crane
        The plant.
    plan : Trajectory
        Plan of the load's x and z (down) [m].
    law : Law or {"setpoint", "generator", "load_feedback", "dynamic", "feedforward"}, optional
        A law, or its name in `LAWS`: set-point law, for steps; reference
        generator of figure 3; generator with load feedback; dynamic feedback
        linearisation; flat feedforward. The outputs of the first three are the
        references of the PIDs, those of the others force and torque, without
        PIDs.
    load_bandwidth, damping, poles : optional
        Options of a law given by its name; see `LoadFeedbackLaw` and
        `DynamicLaw`.
    bandwidth : float, optional
        Triple pole of the PIDs [rad/s].
    tf : float, optional
        Time constant of their derivative filter [s].
    force_limits, torque_limits : (float, float) or float, optional
        Limits of F [N] and C [N m], with anti-windup; a number a for (-a, a).
    reference : sequence of control systems, optional
        Blocks in place of the source of the plan: a replanner, a time scaling or
        a command filter, with the blocks that supply their inputs. (A governor,
        which reads the states of the whole loop, is connected outside.) Their
        outputs must include the inputs of the law, x_ref, x_ref_d1, ..., z_ref,
        .... A block whose initial state is not 0 declares it as
        ``initial_state``.
    wind : Trajectory, optional
        Horizontal force on the load [N], along x.
    drive : {"force", "velocity"}, optional
        What commands the trolley.
    drive_lag : float, optional
        Time constant of the velocity drive [s], above 0.
    inputs : sequence of str, optional
        Inputs of the loop: inputs of blocks of `reference`, and wind, if it is
        not a trajectory. v_cmd is an input of a loop with velocity drive unless
        it is an output of a block of `reference`.
    name : str, optional
        Name of the loop.

    Returns
    -------
    control.InterconnectedSystem
        Its attribute ``initial_state`` is the equilibrium at the first position
        of the plan, where `simulate` starts by default.

    Raises
    ------
    TypeError
        If `plan`, `law`, `inputs` or `reference` has the wrong type.
    ValueError
        If the law is unknown or has no such option, the crane cannot follow the
        plan, or a derivative that must be continuous for the law jumps; the
        message gives the derivative and the time. With velocity drive, if the
        law's outputs are force and torque or it feeds back the load, force limits
        are given, or the lag is not above 0.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline([
    ...     cp.Waypoint.from_jets(0.0, x=[0, 0, 0], z=[10, 0, 0]),
    ...     cp.Waypoint.from_jets(15.0, x=[20, 0, 0], z=[11, 0, 0]),
    ... ])
    >>> loop = cp.plants.crane_loop(cp.plants.Crane(), plan)
    >>> loop.output_labels[:3]
    ['x', 'z', 'D']
    >>> law = cp.plants.LoadFeedbackLaw(load_bandwidth=0.5)
    >>> loop = cp.plants.crane_loop(cp.plants.Crane(), plan, law, force_limits=(-30e3, 30e3))

    A trolley with a velocity drive under a rope of 10 m:

    >>> rest = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    >>> loop = cp.plants.crane_loop(cp.plants.Crane(), rest, drive="velocity", drive_lag=0.1)
    >>> loop.input_labels
    ['v_cmd']
    >>> cp.simulate(loop, [0.0, 5.0], cp.Step(0.5)).outputs["D_d1"].round(6).tolist()
    [0.0, 0.5]
    """
    chosen = _with_options(law, {"load_bandwidth": load_bandwidth, "damping": damping, "poles": poles})
    plan = _named(plan)
    for label, limits in (("force_limits", force_limits), ("torque_limits", torque_limits)):
        if limits is not None:
            checked_range(limits, label)
    _check_smooth(plan, chosen)
    check(crane, plan)
    _check_signals(reference, wind, inputs)
    sources = [create_source_iosystem(plan, chosen.order, suffix="_ref")] if reference is None else list(reference)
    if wind is not None:
        sources.append(create_source_iosystem(stack([wind], labels=["wind"]), name="gust"))
    law_block = _block(chosen, crane)
    blocks = [*sources, law_block]
    by_velocity = model.checked_drive(drive, drive_lag) is not None
    _check_limits(chosen, by_velocity, force_limits, torque_limits)
    measured = [label for label in law_block.input_labels if label in model.OUTPUTS]
    if by_velocity and measured:
        raise ValueError(
            f"law must not feed back the load with drive='velocity', where the plan does not command the trolley, got "
            f"{chosen.name!r}, which reads {', '.join(measured)}; use 'generator' or 'setpoint'"
        )
    if chosen.outputs != _ACTUATED:
        if not by_velocity:
            blocks.append(linear.trolley_pid(crane, bandwidth, tf, limits=force_limits))
        blocks.append(linear.hoist_pid(crane, bandwidth, tf, limits=torque_limits))
    blocks.append(model.iosystem(crane, wind=wind is not None or "wind" in inputs, drive=drive, drive_lag=drive_lag))
    outer = list(inputs)
    if by_velocity and _COMMAND not in outer and not any(_COMMAND in block.output_labels for block in blocks):
        outer.append(_COMMAND)
    _check_fed(reference or (), blocks, outer)
    outputs = [*model.OUTPUTS, *_ACTUATED, *(label + "_ref" for label in FLAT_LABELS)]
    outputs += ["sway_frequency", *([] if _COMMAND in outer else [_COMMAND])] if by_velocity else []
    # With a velocity drive, the trolley's reference is not used.
    unused = {"ignore_outputs": [f"{law_block.name}.D_ref"]} if by_velocity else {}
    loop = ct.interconnect(blocks, inputs=outer or 0, outputs=outputs, name=name, **unused)
    equilibrium = model.equilibrium(crane, float(plan.initial[0]), float(plan.initial[1]))[0]
    # The crane is the last block; the states of law and PIDs are 0 at equilibrium.
    before = [_start(block) for block in blocks[:-1]]
    loop.initial_state = np.concatenate([*before, equilibrium])
    return declare(loop, initial_state=loop.initial_state)


_REFERENCES = ("D_ref", "R_ref")
_ACTUATED = ("F", "C")
_COMMAND = "v_cmd"


def _with_options(law: Law | str, options: dict[str, float | Sequence[complex] | None]) -> Law:
    """Law with the options that are given with its name."""
    found = as_law(law)
    given = {name: value for name, value in options.items() if value is not None}
    if given and isinstance(law, Law):
        raise TypeError(f"options of a law must be given to the law itself, got {', '.join(given)} with {law!r}")
    known = [entry.name for entry in fields(found)]
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ValueError(
            f"options of the law {found.name!r} must be among {', '.join(known) or 'none'}, got {', '.join(unknown)}"
        )
    return replace(found, **given) if given else found


def _block(law: Law, crane: CraneParameters) -> ct.NonlinearIOSystem:
    """Block of a law, checked for the outputs that the law declares."""
    if law.outputs not in (_REFERENCES, _ACTUATED):
        raise ValueError(
            f"outputs of a law must be {_REFERENCES} or {_ACTUATED}, got {law.outputs} of the law {law.name!r}"
        )
    block = law.build(crane)
    missing = set(law.outputs) - set(getattr(block, "output_labels", ()))
    if missing:
        raise ValueError(
            f"the law {law.name!r} must build a block with the outputs {' and '.join(law.outputs)}, got one without "
            f"{' and '.join(sorted(missing))}"
        )
    return block


def _check_limits(law: Law, by_velocity: bool, force_limits: Range | None, torque_limits: Range | None) -> None:
    """Raise for limits without the PID that they limit, and for a law without the hoist's reference."""
    if law.outputs == _ACTUATED:
        if by_velocity:
            raise ValueError(
                f"law must have the outputs D_ref and R_ref with drive='velocity', got {law.name!r}, whose outputs are "
                "force and torque; use 'generator' or 'setpoint'"
            )
        if force_limits is not None or torque_limits is not None:
            raise ValueError(
                f"force_limits and torque_limits must be given with a law that uses the PIDs, got {law.name!r}"
            )
    elif by_velocity and force_limits is not None:
        raise ValueError(
            f"force_limits must be given with drive='force', got {force_limits!r} with drive='velocity'; limit v_cmd "
            "by create_saturation_iosystem instead"
        )


def _check_signals(
    reference: Sequence[ct.InputOutputSystem] | None, wind: Trajectory | None, inputs: Sequence[str]
) -> None:
    """Raise for blocks, wind or inputs of the wrong type."""
    for label, values in (("inputs", inputs), ("reference", reference)):
        if isinstance(values, str | ct.InputOutputSystem):
            raise TypeError(f"{label} must be a sequence, got {values!r:.60}")
    if len(set(inputs)) < len(inputs):
        raise ValueError(f"inputs must not name a signal twice, got {', '.join(inputs)}")
    for block in reference or ():
        if not isinstance(block, ct.InputOutputSystem):
            raise TypeError(f"reference must contain control systems, got {type(block).__name__}")
    if wind is not None and not (isinstance(wind, Trajectory) and wind.naxes == 1 and "wind" not in inputs):
        got = "wind among inputs as well" if "wind" in inputs else repr(wind)
        raise ValueError(f"wind must be a trajectory of one axis, or one of inputs, got {got:.60}")


def _check_fed(
    reference: Sequence[ct.InputOutputSystem], blocks: Sequence[ct.InputOutputSystem], inputs: Sequence[str]
) -> None:
    """Raise for an unconnected input of a block of the reference: it would be 0."""
    known = {*inputs, *(label for block in blocks for label in block.output_labels)}
    for block in reference:
        missing = [label for label in block.input_labels or () if label not in known]
        if missing:
            raise ValueError(
                f"inputs of {block.name} must be outputs of other blocks or among inputs, got none for "
                f"{', '.join(missing)}"
            )


def _start(block: ct.InputOutputSystem) -> NDArray[np.float64]:
    """Initial state of a block: the declared one, or 0."""
    start = traits_of(block).initial_state
    return np.zeros(block.nstates or 0) if start is None else start


def _named(plan: Trajectory) -> Trajectory:
    """Plan of x and z: by name if its axes have these labels, otherwise in order."""
    check_kind(plan, "plan", Trajectory)
    check_axes(plan)
    if plan.labels == FLAT_LABELS:
        return plan
    return plan.select(FLAT_LABELS) if set(plan.labels) == set(FLAT_LABELS) else stack([plan], labels=FLAT_LABELS)


def _check_smooth(plan: Trajectory, law: Law) -> None:
    """Raise for a plan with a jump in a derivative that must be continuous for the law."""
    smooth = law.continuity
    for jump in plan.jumps(smooth) if smooth >= 0 else ():
        what = "position" if jump.order == 0 else f"derivative {jump.order}"
        raise ValueError(
            f"the law {law.name!r} must be given a plan continuous up to derivative {smooth}, got one whose {what} of "
            f"{jump.label} jumps by {jump.size:.4g} at {jump.time:g} s"
        )
