"""Controls of an extended plant that keep the controls of the plant within limits.

A control in place of which the extension has a state w is kept within its limits by
limits of w': with w' <= lambda (w_max - w), w stays below w_max. If w' is a state as
well, or depends on others, the same is done with its limit. So the states of the
extension are those of the controls that are applied.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import casadi as ca
import numpy as np

from ctrlplan._types import Array
from ctrlplan.flatness.analysis import Analysis
from ctrlplan.flatness.structure import nearby, steadiness
from ctrlplan.symbolic.taping import tape_of

_SINGULAR, _REGULAR = 0.1, 0.3
"""Share of the influence of controls that is on the outputs paired with them: without and with full correction."""

_SAMPLES = 65
"""Values of a control between the operating point and a limit."""


def limited_controls(analysis: Analysis, z: ca.SX, mu: ca.SX, limits: tuple[Array, Array], rate: float) -> ca.SX:
    """Controls of the extended plant that keep those of the plant within limits.

    Where a limit of the extension is active, the other controls are changed so that
    the outputs paired with them keep their highest derivatives.

    Parameters
    ----------
    analysis : Analysis
        The plant.
    z : casadi.SX
        States of the extended plant.
    mu : casadi.SX
        Its controls without limits.
    limits : tuple of ndarray, shape (ncontrols,)
        Lower and upper limits of the controls of the plant, infinite where there are none.
    rate : float
        Rate lambda [1/s] at which a control may approach its limit.
    """
    extended = sorted({k for extension in analysis.structure.extensions for k in extension.pivots})
    free = [k for k in range(mu.numel()) if k not in extended]
    low, high = _entering(analysis, limits)
    if not extended:
        return _clipped(mu, low, high)
    found = ca.SX(mu)
    correction = _correction(analysis, z, extended, free)

    def free_controls(slowed: ca.SX) -> ca.SX:
        """Controls that are not extended, for given ones of the extension."""
        return _clipped(mu[free] - correction @ (slowed - mu[extended]), low[free], high[free])

    # The limits of the extension depend on the other controls: those with which it rests.
    within = ca.SX(mu)
    within[free] = free_controls(ca.SX.zeros(len(extended)))
    lower, upper = (_propagated(analysis, z, within, side, rate) for side in (low, high))
    found[extended] = _clipped(mu[extended], lower[extended], upper[extended])
    found[free] = free_controls(found[extended])
    return found


def _clipped(values: ca.SX, low: ca.SX, high: ca.SX) -> ca.SX:
    return ca.fmin(ca.fmax(values, low), high)


def _propagated(analysis: Analysis, z: ca.SX, mu: ca.SX, limits: ca.SX, rate: float) -> ca.SX:
    """Limits of the controls of the extended plant from those of the plant's."""
    structure = analysis.structure
    known = (structure.z, z)
    before, mixtures = ca.SX(mu), []
    for extension in reversed(structure.extensions):
        mixed = _at(extension.mixed, known, (extension.controls, before))
        before[list(extension.pivots)] = _at(extension.states, known) - mixed
        mixtures.append(mixed)
    found = ca.SX(limits)
    for extension, mixed in zip(structure.extensions, reversed(mixtures), strict=True):
        places = list(extension.pivots)
        found[places] = rate * (found[places] + mixed - _at(extension.states, known))
    return found


def _at(expression: ca.SX, *values: tuple[ca.SX, ca.SX]) -> ca.SX:
    """Expression with symbols replaced by values."""
    return ca.substitute(expression, *(ca.vertcat(*column) for column in zip(*values, strict=True)))


def _entering(analysis: Analysis, limits: tuple[Array, Array]) -> tuple[ca.SX, ca.SX]:
    """Limits of the functions by which the controls enter; none beyond the branch of the operating point."""
    u = analysis.equations.u
    centre = analysis.point.u
    values = tape_of((u,), analysis.entering)
    rising = tape_of((u,), ca.sum2(ca.jacobian(analysis.entering, u)))(centre) > 0.0
    found = np.array([[-np.inf] * centre.size, [np.inf] * centre.size])
    for number, side in enumerate(limits):
        for k in np.flatnonzero(np.isfinite(side)).tolist():
            points = np.tile(centre[:, None], _SAMPLES)
            points[k] = np.linspace(centre[k], side[k], _SAMPLES)
            along = values(points)[k]
            if (np.diff(along) * (side[k] - centre[k]) * (1.0 if rising[k] else -1.0) >= 0.0).all():
                found[number if rising[k] else 1 - number, k] = along[-1]
    return ca.SX(found[0]), ca.SX(found[1])


def _correction(analysis: Analysis, z: ca.SX, extended: Sequence[int], free: Sequence[int]) -> ca.SX:
    """Change of the free controls for a change of the others at which the outputs paired with them do not change.

    It tends to 0 where the free controls have little influence on these outputs.
    """
    structure = analysis.structure
    if not free:
        return ca.SX(0, len(extended))
    nz = structure.z.numel()
    influence = ca.jacobian(structure.last, structure.mu)
    columns = structure.scales[nz:]
    tape = tape_of((structure.z, structure.mu, structure.p), influence)
    points = np.column_stack(list(nearby(structure.point, structure.scales, 0.15)))
    values = tape(points[:nz], points[nz:], analysis.equations.values[:, None]).reshape(*influence.shape, -1)
    sizes = np.abs(values * columns[:, None]).max(axis=(1, 2))
    scaled = values[:, free] / sizes[:, None, None]
    rows = max(combinations(range(len(sizes)), len(free)), key=lambda chosen: steadiness(scaled[list(chosen)]))
    weights = ca.diag(ca.DM(1.0 / sizes))
    matrix = weights @ ca.substitute(influence, structure.z, z) @ ca.diag(ca.DM(columns))
    own, other = matrix[list(rows), list(free)], matrix[list(rows), list(extended)]
    found = ca.det(own)
    whole = ca.SX(1.0)
    for k in free:
        whole *= ca.norm_2(matrix[:, k])
    share = ca.fmin(ca.fmax((ca.fabs(found) / whole - _SINGULAR) / (_REGULAR - _SINGULAR), 0.0), 1.0)
    inverse = ca.adj(own) * found / ca.fmax(found**2, (0.5 * _SINGULAR * whole) ** 2)
    return ca.diag(ca.DM(columns[free])) @ (share * inverse) @ other @ ca.diag(ca.DM(1.0 / columns[extended]))
