"""The crane's closed loops: source, law, drives, crane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan.systems.plants.crane import OUTPUTS, Crane
from ctrlplan.systems.plants.crane_laws import (
    create_crane_feedforward_iosystem,
    create_dynamic_law_iosystem,
    create_generator_iosystem,
    create_load_feedback_iosystem,
    create_still_iosystem,
)
from ctrlplan.systems.source import create_source_iosystem
from ctrlplan.traits import declare, traits_of
from ctrlplan.trajectories import Trajectory, stack

# What each law asks of the plan: the highest derivative it reads, and the highest that must not jump.
_NEEDS = {"still": (0, -1), "generator": (2, 0), "load_feedback": (2, 0), "dynamic": (4, 3), "feedforward": (4, 3)}
_OPTIONS = {"load_feedback": ("load_bandwidth", "damping"), "dynamic": ("poles",)} | dict.fromkeys(
    ("still", "generator", "feedforward"), ()
)
LAWS = tuple(_NEEDS)


def crane_loop(
    crane: Crane,
    plan: Trajectory,
    law: str = "generator",
    *,
    bandwidth: float = 5.0,
    tf: float = 0.02,
    force_limits: Sequence[float] | None = None,
    torque_limits: Sequence[float] | None = None,
    reference: Sequence[Any] | None = None,
    wind: Trajectory | None = None,
    inputs: Sequence[str] = (),
    name: str = "crane_loop",
    **options: Any,
) -> ct.InterconnectedSystem:
    """Closed loop of figure 3: source, law, two PIDs, crane.

    Parameters
    ----------
    crane : Crane
        The plant.
    plan : Trajectory
        Plan of the load's x and z (down) [m].
    law : {"generator", "load_feedback", "dynamic", "feedforward", "still"}, optional
        Figure 3's generator; with feedback from the load; the whole law by
        dynamic extension; its open-loop half; or the references of a load at
        rest, for steps. The first two and the last drive the PIDs, the others
        force and torque themselves.
    bandwidth : float, optional
        Triple pole of the PIDs [rad/s].
    tf : float, optional
        Their derivative filter [s].
    force_limits, torque_limits : (float, float), optional
        Limits of F [N] and C [N m], with anti-windup.
    reference : sequence of control systems, optional
        Blocks in the place of the plan's source: a replanner, a slowed clock,
        a command filter, with whatever they are fed by. (A governor, which reads
        the states of the whole loop, stands outside.) What nothing else reads of
        their outputs must be the jets that the law reads, x_ref, x_ref_d1, ...,
        z_ref, .... Where one starts elsewhere than at 0, its attribute
        ``initial_state`` says so.
    wind : Trajectory, optional
        Horizontal force on the load [N], along x.
    inputs : sequence of str, optional
        Signals that come from outside: what blocks of `reference` read, and
        wind, where it is no trajectory.
    name : str, optional
        Name of the loop.
    **options
        For the law: ``bandwidth`` and ``damping`` as ``load_bandwidth`` and
        ``damping``, or ``poles``.

    Returns
    -------
    control.InterconnectedSystem
        Without inputs unless given; outputs those of the crane, F and C, x_ref and z_ref.
        Its attribute ``initial_state`` is rest at the plan's first position.

    Raises
    ------
    ValueError
        If the law is unknown, the crane cannot follow the plan, or a
        derivative that the law needs jumps: the message says which and when.

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
    """
    if law not in _NEEDS:
        raise ValueError(f"law must be one of {', '.join(LAWS)}, got {law!r}")
    unknown = set(options) - set(_OPTIONS[law])
    if unknown:
        known = ", ".join(_OPTIONS[law]) or "none"
        raise ValueError(f"options of the law {law!r} must be among {known}, got {', '.join(sorted(unknown))}")
    order, smooth = _NEEDS[law]
    plan = _named(plan)
    _check_smooth(plan, smooth, law)
    crane.check(plan)
    for label, values in (("inputs", inputs), ("reference", reference)):
        if isinstance(values, str | ct.InputOutputSystem):
            raise TypeError(f"{label} must be a sequence, got {values!r:.60}")
    if len(set(inputs)) < len(inputs):
        raise ValueError(f"inputs must not name a signal twice, got {', '.join(inputs)}")
    for block in reference or ():
        if not isinstance(block, ct.InputOutputSystem):
            raise TypeError(f"reference must hold control systems, got {type(block).__name__}")
    if wind is not None and not (isinstance(wind, Trajectory) and wind.naxes == 1 and "wind" not in inputs):
        got = "wind among inputs as well" if "wind" in inputs else repr(wind)
        raise ValueError(f"wind must be a trajectory of one axis, or one of inputs, got {got:.60}")
    sources = [create_source_iosystem(plan, order, suffix="_ref")] if reference is None else list(reference)
    plant = crane.iosystem(wind=wind is not None or "wind" in inputs)
    if wind is not None:
        sources.append(create_source_iosystem(stack([wind], labels=["wind"]), name="gust"))
    if law in ("dynamic", "feedforward"):
        if force_limits is not None or torque_limits is not None:
            raise ValueError(f"limits must go with a law that drives the PIDs, got law {law!r}")
        block = (
            create_dynamic_law_iosystem(crane, **options)
            if law == "dynamic"
            else create_crane_feedforward_iosystem(crane)
        )
        blocks = [*sources, block, plant]
    else:
        if law == "still":
            block = create_still_iosystem(crane)
        elif law == "generator":
            block = create_generator_iosystem(crane)
        else:
            block = create_load_feedback_iosystem(
                crane, options.get("load_bandwidth", 1.0), options.get("damping", 1.0)
            )
        pids = [
            crane.trolley_pid(bandwidth, tf, limits=force_limits),
            crane.hoist_pid(bandwidth, tf, limits=torque_limits),
        ]
        blocks = [*sources, block, *pids, plant]
    _check_fed(reference or (), blocks, inputs)
    loop = ct.interconnect(blocks, inputs=list(inputs) or 0, outputs=[*OUTPUTS, "F", "C", "x_ref", "z_ref"], name=name)
    rest = crane.equilibrium(float(plan.initial[0]), float(plan.initial[1]))[0]
    # The crane comes last; the states of law and drives are 0 at rest.
    before = [_start(block) for block in blocks[:-1]]
    loop.initial_state = np.concatenate([*before, rest])
    return declare(loop, initial_state=loop.initial_state)


def _check_fed(reference: Sequence[Any], blocks: Sequence[Any], inputs: Sequence[str]) -> None:
    """Refuse blocks of the reference that read what nobody puts out: it would be 0."""
    known = {*inputs, *(label for block in blocks for label in block.output_labels)}
    for block in reference:
        missing = [label for label in block.input_labels or () if label not in known]
        if missing:
            raise ValueError(
                f"inputs of {block.name} must be outputs of other blocks or among inputs, got none for "
                f"{', '.join(missing)}"
            )


def _start(block: Any) -> NDArray[np.float64]:
    """Where a block starts: where it says so, or at 0."""
    start = traits_of(block).initial_state
    return np.zeros(block.nstates or 0) if start is None else start


def _named(plan: Trajectory) -> Trajectory:
    """Plan of x and z: by name where its axes are called so, else in order."""
    if not isinstance(plan, Trajectory):
        raise TypeError(f"plan must be a Trajectory, got {type(plan).__name__}")
    if plan.naxes != 2:
        raise ValueError(f"a plan of the load must have the axes x and z, got {plan.naxes} axes")
    if plan.labels == ("x", "z"):
        return plan
    if set(plan.labels) == {"x", "z"}:
        return plan.select(["x", "z"])
    return stack([plan], labels=["x", "z"])


def _check_smooth(plan: Trajectory, smooth: int, law: str) -> None:
    """Refuse a plan of which a derivative up to `smooth` jumps."""
    for jump in plan.jumps(smooth) if smooth >= 0 else ():
        what = "position" if jump.order == 0 else f"derivative {jump.order}"
        raise ValueError(
            f"the law {law!r} must be given a plan continuous up to derivative {smooth}, got one whose {what} of "
            f"{jump.label} jumps by {jump.size:.4g} at {jump.time:g} s"
        )
