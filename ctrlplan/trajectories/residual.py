"""Vibration that a plan leaves in a mode, over the frequency of the mode."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_kind, finite_vector
from ctrlplan.trajectories.common import Array, ComplexArray
from ctrlplan.trajectories.quadrature import gauss
from ctrlplan.trajectories.shaper_factor import checked_damping
from ctrlplan.trajectories.trajectory import Trajectory, check_end

_TURNS = 1024.0
"""Phase |p| h [rad] of a mode over a part of a segment, above which it is divided."""

_MAXIMUM = 256
"""Degree of the velocity of a segment, above which it is divided."""

_LARGEST = 1024
"""Degree at which a velocity is considered resolved: what remains is its rounding."""

_LONGEST = 1e8
"""Largest phase |p| T [rad] of a mode over a plan: 1e5 parts, about ten seconds for one mode."""

_ENTRIES = 1 << 20
"""Numbers in a table of exponentials: 16 MB."""


def residual_spectrum(plan: Trajectory, frequencies: ArrayLike, damping: ArrayLike = 0.0) -> Array:
    r"""Amplitude of the vibration left in a mode by a plan.

    A mode :math:`y'' + 2\zeta\omega y' + \omega^2 y = \omega^2 r` follows the plan
    r from rest. At the end T of the plan it is left with a free oscillation about
    the final position, of the amplitude

    .. math:: \frac{1}{\sqrt{1 - \zeta^2}}\left|\int r'(t)\,e^{-p\,(T - t)}\,dt\right|,
        \qquad p = \omega\,(\zeta + i\sqrt{1 - \zeta^2}),

    jumps of the position included. It is the maximum of the deviation without
    damping; at frequency 0 it is the distance from the first to the last position
    over that root.

    Parameters
    ----------
    plan : Trajectory
        The plan, also shaped.
    frequencies : array_like, shape (nfrequencies,)
        Undamped natural frequencies [rad/s], at least 0; a number for one.
    damping : float or array_like, shape (nfrequencies,), optional
        Damping ratio in [0, 1), the same for all frequencies or one for each.

    Returns
    -------
    ndarray, shape (nfrequencies,) for one axis, otherwise (naxes, nfrequencies)
        In the unit of the plan; the error is rounding, below 1e-12 of the path.

    Raises
    ------
    TypeError
        If `plan` is not a trajectory.
    ValueError
        If a frequency is negative, not finite, or above 1e8 rad over the duration
        of the plan, or a damping ratio is out of range.

    References
    ----------
    The residual shock spectrum of Harris, Shock and Vibration Handbook, of a
    motion of the base.

    Examples
    --------
    A quintic and a ZV-shaped step, of the same duration, at a mode of 10 rad/s:

    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> shaped = cp.Shaper.zv(10.0)(cp.Step(1.0))
    >>> quintic = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(np.pi / 10.0, 1, 0, 0)])
    >>> cp.residual_spectrum(shaped, [0.0, 9.0, 10.0, 11.0]).round(3)
    array([1.   , 0.156, 0.   , 0.156])
    >>> cp.residual_spectrum(quintic, [0.0, 9.0, 10.0, 11.0]).round(3)
    array([1.   , 0.865, 0.835, 0.804])
    """
    check_kind(plan, "plan", Trajectory)
    check_end(plan)
    omega, zeta = checked_modes(frequencies, damping)
    highest = float(omega.max())
    if highest * plan.duration > _LONGEST:
        raise ValueError(
            f"frequencies must be at most {_LONGEST / plan.duration:.3g} rad/s for a plan of {plan.duration:.6g} s, "
            f"got {highest:.3g}; give frequencies in rad/s and times in s"
        )
    modes = omega * (zeta + 1j * np.sqrt(1.0 - zeta**2))
    total = np.zeros((plan.naxes, omega.size), dtype=complex)
    cuts = plan.breakpoints
    after, before = plan.jet(cuts, 0)[0], plan.jet(cuts, 0, left=True)[0]
    after[:, -1] = plan.final
    for time, jump in zip(cuts.tolist(), (after - before).T, strict=True):
        if jump.any():
            total += np.multiply.outer(jump, np.exp(-modes * (plan.end - time)))
    for segment, (begin, end) in enumerate(pairwise(cuts.tolist())):
        total += np.exp(-modes * (plan.end - end)) * _integral(plan, segment, 0.0, end - begin, modes)
    found: Array = np.abs(total) / np.sqrt(1.0 - zeta**2)
    return found[0] if plan.naxes == 1 else found


def checked_modes(frequencies: ArrayLike, damping: ArrayLike) -> tuple[Array, Array]:
    """Frequencies (nfrequencies,) and damping ratios that broadcast with them."""
    omega = finite_vector(frequencies, "frequencies", "nfrequencies", scalar=True)
    for i in np.flatnonzero(omega < 0.0).tolist():
        raise ValueError(f"frequencies must be at least 0, got frequencies[{i}] = {omega[i]}")
    zeta = checked_damping(damping)
    if zeta.shape not in ((), omega.shape):
        raise ValueError(
            f"damping must be a number or one for each of the {omega.size} frequencies, got shape {zeta.shape}"
        )
    return omega, np.broadcast_to(zeta, omega.shape)


def _integral(plan: Trajectory, segment: int, begin: float, end: float, modes: ComplexArray) -> ComplexArray:
    """Integral (naxes, nmodes) of r'(s) e^(-p (end - s)) over a part of a segment; times since its start."""
    length = end - begin
    turns = np.abs(modes) * length
    degree = _velocity_degree(plan, segment, begin, end)
    parts = max(degree / _MAXIMUM, float(turns.max()) / _TURNS)
    if parts > 1.0:
        cuts = np.linspace(begin, end, math.ceil(parts) + 1).tolist()
        total = np.zeros((plan.naxes, modes.size), dtype=complex)
        for first, last in pairwise(cuts):
            total += np.exp(-modes * (end - last)) * _part(plan, segment, first, last, modes, min(degree, _MAXIMUM))
        return total
    return _part(plan, segment, begin, end, modes, degree)


def _part(plan: Trajectory, segment: int, begin: float, end: float, modes: ComplexArray, degree: int) -> ComplexArray:
    """The same of a part over which the velocity has a known degree and modes advance by few turns."""
    length = end - begin
    # 24 + 0.6 m nodes resolve e^(-p s) at |p| h <= m; each two degrees of the velocity require one node more.
    levels = np.ceil(np.log2(np.maximum(np.abs(modes) * length / 16.0, 1.0))).astype(int)
    out = np.empty((plan.naxes, modes.size), dtype=complex)
    for level in np.unique(levels).tolist():
        count = 24 + math.ceil(9.6 * 2.0**level) + degree // 2
        nodes, weights = gauss(count)
        velocity = plan.segment_jet(segment, begin + length * nodes, 1)[1] * (length * weights)
        chosen = np.flatnonzero(levels == level)
        for some in np.array_split(chosen, -(-chosen.size * count // _ENTRIES)):
            out[:, some] = velocity @ np.exp(np.multiply.outer(length * (nodes - 1.0), modes[some]))
    return out


def _velocity_degree(plan: Trajectory, segment: int, begin: float, end: float) -> int:
    """Degree, rounded up to a power of two, at which the velocity of a segment is resolved."""
    count = 16
    while count < _LARGEST:
        nodes, weights = gauss(count)
        velocity = plan.segment_jet(segment, begin + (end - begin) * nodes, 1)[1]
        legendre = np.polynomial.legendre.legvander(2.0 * nodes - 1.0, count - 1)
        size = np.abs((velocity * weights) @ legendre) * (2.0 * np.arange(count) + 1.0)
        # The coefficients of a resolved velocity end in their own rounding.
        if (size[:, -4:] <= 4.0 * count * np.finfo(float).eps * size.max(axis=1, keepdims=True)).all():
            break
        count *= 2
    return count
