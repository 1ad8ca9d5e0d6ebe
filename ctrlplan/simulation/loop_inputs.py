"""Which axis of a plan, or derivative of it, is each input of a loop."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ctrlplan.trajectories import Trajectory

_FRACTIONS = np.array([0.0, 0.0312, 0.1234, 0.25, 0.3456, 0.5, 0.6543, 0.75, 0.8765, 1.0])
"""Times at which two plans are compared, as fractions of the duration."""

Fed = tuple[int, int]
"""Axis of a plan, and order of its derivative."""


def fed_signals(labels: Sequence[str], plan: Trajectory, name: str) -> list[Fed | None]:
    """Axis of a plan and derivative at each input of a loop; None for an input that is 0.

    Raises
    ------
    ValueError
        If the plan does not fit.
    """
    if not labels:
        return []
    if len(labels) == plan.naxes:
        order = plan.labels if set(plan.labels) == set(labels) else tuple(labels)
        return [(order.index(label), 0) for label in labels]
    parts = [re.fullmatch(r"(.*?)(?:_d([1-9][0-9]*))?", label, re.DOTALL) for label in labels]
    found = [(part[1], int(part[2] or 0)) for part in parts if part]
    bases = list(dict.fromkeys(base for base, _ in found))
    if set(plan.labels) <= set(bases):
        axes = {label: axis for axis, label in enumerate(plan.labels)}
        return [(axes[base], k) if base in axes else None for base, k in found]
    if len(bases) == plan.naxes:
        return [(bases.index(base), k) for base, k in found]
    raise ValueError(
        f"inputs of {name} must be as many as the axes of the plan, or be named after them, such as "
        f"{plan.labels[0]}, {plan.labels[0]}_d1 for its derivative; got the inputs {', '.join(labels)} for the "
        f"axes {', '.join(plan.labels)}; name the axes by labels="
    )


def same_axis(plan: Trajectory, source: Trajectory, axis: int) -> int | None:
    """Axis of a plan that equals an axis of a source up to the duration."""
    if source is plan:
        return axis
    mine = plan.jet(plan.start + _FRACTIONS * plan.duration, 0, left=True)[0]
    other = source.jet(source.start + _FRACTIONS * source.duration, 0, left=True)[0, axis]
    size = np.abs(mine).max(axis=1)
    equal = np.flatnonzero(np.all(np.abs(mine - other) <= 1e-12 * size[:, None], axis=1))
    return int(equal[0]) if equal.size else None


def tracked(outputs: Sequence[str], labels: Sequence[str]) -> list[int]:
    """Indices of the outputs that follow a plan: those named like its axes, otherwise the first ones."""
    names = labels if all(label in outputs for label in labels) else outputs[: len(labels)]
    return [list(outputs).index(name) for name in names]


def is_cyclic(plan: Trajectory) -> bool:
    """Whether a plan is closed and in motion at its ends, with equal velocities there: one period of a motion."""
    first, last = plan.jet(plan.start, 1), plan.jet(plan.end, 1, left=True)
    size = np.stack([np.ptp([plan.extrema().minimum, plan.extrema().maximum], axis=0), plan.peak(1)])
    return bool(np.all(np.abs(last - first) <= 1e-9 * size) and np.any(np.abs(first[1]) > 1e-9 * size[1]))
