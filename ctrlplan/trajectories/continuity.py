"""Jumps of the derivatives of a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ctrlplan.trajectories.extrema import known_results

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ctrlplan._types import Array
    from ctrlplan.trajectories.trajectory import Trajectory


@dataclass(frozen=True)
class Jump:
    """One jump of one derivative of one axis.

    Attributes
    ----------
    order : int
        Order of the derivative, 0 the position.
    time : float
        Time of the jump [s].
    label : str
        Name of the axis.
    size : float
        Value after the jump minus value before.
    """

    order: int
    time: float
    label: str
    size: float


def find_jumps(plan: Trajectory, order: int) -> tuple[Jump, ...]:
    """Jumps of the derivatives up to an order, lowest order first, then in time.

    The plan is at rest before its start and after its end: a plan that starts
    at nonzero velocity jumps there. Differences below 1e-9 of a derivative's peak, or of the
    range of the position, are rounding, as are those that the rounding of late times or of lower
    derivatives (`_by_rounding_of_lower`) explains. Computed once for a plan.
    """
    known = known_results(plan).jumps
    if order not in known:
        known[order] = _found(plan, order)
    return known[order]


def _found(plan: Trajectory, order: int) -> tuple[Jump, ...]:
    """The same, computed."""
    before, after = _sides(plan, order)
    size = after - before
    size[:, :, -1] = -before[:, :, -1]
    size[0, :, -1] = plan.final - before[0, :, -1]
    samples = np.concatenate([before[:, :, 1:], after], axis=-1)
    if not (np.abs(size) > _slacks(samples)[:, :, None]).any():  # further samples could only add to what is rounding
        return ()
    inside = plan.breakpoints[:-1, None] + np.diff(plan.breakpoints)[:, None] * _INSIDE
    samples = np.concatenate([samples, plan.jet(inside.ravel(), order)], axis=-1)
    slack = _slacks(samples)
    beyond = np.abs(size) > _by_rounding_of_lower(np.diff(plan.breakpoints), np.abs(size), samples)
    # Extrema of samples are nearer to 0 than those of the plan, which are computed for orders that may jump alone.
    for k in np.flatnonzero((beyond & (np.abs(size) > slack[:, :, None])).any(axis=(1, 2))).tolist():
        exact = plan.extrema(k)
        slack[k] = _slack(k, exact.minimum, exact.maximum)
    jumps = beyond & (np.abs(size) > slack[:, :, None])
    if jumps.any():
        jumps &= np.abs(size) > _by_rounding_of_times(plan, order)
    found = np.argwhere(jumps)
    return tuple(
        Jump(int(k), float(plan.breakpoints[i]), plan.labels[a], float(size[k, a, i]))
        for k, a, i in sorted(found.tolist(), key=lambda entry: (entry[0], entry[2], entry[1]))
    )


_INSIDE = np.array([0.1, 0.3, 0.45, 0.65, 0.85])
"""Parts of a segment at which a plan is sampled."""

POSITION_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Rounding of positions relative to their peak, with that of the solution for the coefficients of a spline."""

_ROUNDING = 16.0 * float(np.finfo(float).eps)
"""Rounding of a derivative relative to its peak."""

_GROWTH = 72.0
"""Bound 2 n^2 of Markov's inequality for polynomials of degree n = 6 on a segment of length 1."""

_SHORTEST = 1e-6
"""Length relative to the duration below which a segment is not one of a spline, but between breakpoints of axes."""


def constant_axes(minimum: Array, maximum: Array) -> NDArray[np.bool_]:
    """Axes (naxes,) whose positions change by rounding alone, so that all their derivatives are rounding."""
    return np.asarray(maximum - minimum <= POSITION_ROUNDING * np.maximum(np.abs(minimum), np.abs(maximum)))


def _sides(plan: Trajectory, order: int) -> tuple[Array, Array]:
    """Jets (order + 1, naxes, nbreakpoints) before and after every breakpoint, those of all segments together."""
    times = plan.breakpoints
    count = times.size - 1
    if count:
        moments = np.append(np.zeros(count), times[1:] - times[:-1])
        with np.errstate(all="ignore"):
            found = plan.segments_jet(np.tile(np.arange(count), 2), moments, order)
        if np.isfinite(found.sum()):  # otherwise beyond floating point: an error, or evaluated with care
            before, after = np.zeros((2, order + 1, plan.naxes, count + 1))
            before[0, :, 0] = plan.initial
            before[:, :, 1:] = found[:, :, count:]
            after[:, :, :-1], after[:, :, -1] = found[:, :, :count], found[:, :, -1]
            return before, after
    return plan.jet(times, order, left=True), plan.jet(times, order)


def _by_rounding_of_times(plan: Trajectory, order: int) -> Array:
    """Differences (order + 1, naxes, nbreakpoints) between both sides if breakpoints are rounded."""
    sides = [plan.jet(plan.breakpoints, order + 1, left=left)[1:] for left in (True, False)]
    return 4.0 * np.spacing(np.abs(plan.breakpoints)) * np.abs(sides).max(axis=0)


def _by_rounding_of_lower(lengths: Array, sizes: Array, samples: Array) -> Array:
    """Differences (order + 1, naxes, nbreakpoints) that the rounding of the derivative below explains; 0 for positions.

    By Markov's inequality, an error e of a polynomial of degree n on a segment of length h changes
    its derivative by at most 2 n^2 e/h. The error of a derivative is `_ROUNDING` of its peak, or
    its difference here or at the next breakpoints, if that is rounding itself. With differences as
    they are, and not their bounds, the result is of the size eps peak/h^k only where the lower
    derivatives show errors of that size, as the coefficients of a fitted spline do. Those of
    coefficients given exactly do not, and their small jumps remain.

    If a position or velocity is constant up to rounding, all its derivatives are rounding: a velocity
    if it moves the position by less than the rounding of that in the shortest segment.
    """
    if not lengths.size:
        return np.zeros_like(sizes)
    steps = np.maximum(lengths, _SHORTEST * lengths.sum())
    steps = np.minimum(np.append(steps[0], steps), np.append(steps, steps[-1]))
    found = np.zeros_like(sizes)
    low, high, peaks = samples.min(axis=-1), samples.max(axis=-1), np.abs(samples).max(axis=-1)
    bound = POSITION_ROUNDING * peaks[0, :, None]
    for k in range(1, len(sizes)):
        error = np.where(sizes[k - 1] <= bound, sizes[k - 1], 0.0)
        near = error.copy()
        near[:, 1:] = np.maximum(near[:, 1:], error[:, :-1])
        near[:, :-1] = np.maximum(near[:, :-1], error[:, 1:])
        with np.errstate(over="ignore"):
            found[k] = _GROWTH / steps * np.maximum(near, _ROUNDING * peaks[k - 1, :, None])
        bound = found[k]
    found[1:, constant_axes(low[0], high[0])] = np.inf
    if len(sizes) > 2:
        rounding = POSITION_ROUNDING * (peaks[1] + peaks[0] / steps.min())
        found[2:, high[1] - low[1] <= rounding] = np.inf
    return found


def _slacks(samples: Array) -> Array:
    """Sizes of differences that are rounding (order + 1, naxes), for samples of the derivatives."""
    minimum, maximum = samples.min(axis=-1), samples.max(axis=-1)
    found = _slack(1, minimum, maximum)
    found[0] = _slack(0, minimum[0], maximum[0])
    return found


def _slack(order: int, minimum: Array, maximum: Array) -> Array:
    """Size of a difference that is rounding, for the extrema of a derivative, shape (..., naxes)."""
    peak = np.maximum(np.abs(minimum), np.abs(maximum))
    # Relative to the range: a distant origin of the positions hides no jump.
    found = 1e-9 * peak if order else 1e-9 * (maximum - minimum) + POSITION_ROUNDING * peak
    return np.maximum(found, np.finfo(float).tiny)
