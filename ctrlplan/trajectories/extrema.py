"""Extrema and bounds that are facts about an interval, not about samples of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from ctrlplan.trajectories.chebyshev import chebyshev_proxy, fit, real_roots
from ctrlplan.trajectories.common import Array

if TYPE_CHECKING:
    from ctrlplan.trajectories.trajectory import Trajectory

_MAX_PIECES = 4000
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class Extrema:
    """Least and greatest values and where they are attained.

    Attributes
    ----------
    minimum, maximum : ndarray, shape (naxes,)
        Values.
    time_min, time_max : ndarray, shape (naxes,)
        Earliest times [s] at which they are attained.
    """

    minimum: Array
    maximum: Array
    time_min: Array
    time_max: Array


@dataclass(frozen=True)
class Bounds:
    """Certified bounds of a function over a plan.

    Attributes
    ----------
    lower, upper : float
        Every value over the whole interval lies between them.
    minimum, maximum : float
        Values that are attained.
    time_min, time_max : float
        Where [s].
    """

    lower: float
    upper: float
    minimum: float
    maximum: float
    time_min: float
    time_max: float


def derivative_extrema(plan: Trajectory, nu: int) -> Extrema:
    """Extrema of the nu-th derivative, axis by axis."""
    found = _Candidates()
    if nu == 0 or plan.breakpoints.size == 1:
        held = np.zeros((2, plan.naxes)) if nu else np.stack([plan.initial, plan.final])
        found.add(np.array([plan.start, plan.end]), held.T, (plan.start, plan.end))
    for leg, (origin, duration) in enumerate(_legs(plan)):

        def jet(t: Array, order: int, leg: int = leg) -> Array:
            return plan._leg_jet(leg, t, order)

        t = stationary_times(jet, duration, nu)
        found.add(origin + t, jet(t, nu)[nu], (origin, origin + duration))
    return found.extrema()


def stationary_times(jet: Callable[[Array, int], Array], duration: float, nu: int) -> Array:
    """Times in [0, duration] at which the nu-th derivative of an analytic function can be greatest or least.

    Parameters
    ----------
    jet : callable
        Maps times (ntime,) and an order to (order + 1, naxes, ntime).
    duration : float
        Length of the interval [s].
    nu : int
        Order of the derivative.

    Returns
    -------
    ndarray, shape (ncandidates,)
        Both ends and, for every axis, the stationary points; increasing.
    """
    times = [np.array([0.0, duration])]
    for left, right, slopes in _pieces(jet, 0.0, duration, nu + 1):
        times += [0.5 * (left + right) + 0.5 * (right - left) * real_roots(series) for series in slopes]
    t = np.concatenate(times)
    t = np.concatenate([t, _polished(jet, t, nu, duration)])
    # What rounding moved off an end belongs to it.
    t[t < 1e-12 * duration] = 0.0
    t[t > (1.0 - 1e-12) * duration] = duration
    return np.unique(t)


def function_extrema(plan: Trajectory, function: Callable[[Array], Array], order: int) -> Extrema:
    """Extrema of a function of the jet, resolved by Chebyshev proxies."""
    found = _Candidates()
    for leg, (origin, duration) in enumerate(_searchable_legs(plan)):

        def value(t: Array, leg: int = leg) -> Array:
            return np.atleast_2d(np.asarray(function(plan._leg_jet(leg, t, order)), dtype=float))

        scale = np.abs(value(np.linspace(0.0, duration, 65))).max(axis=1)
        todo, pieces = [(0.0, duration, np.inf)], 0
        while todo:
            left, right, before = todo.pop()
            pieces += 1
            series = fit(value, (left, right), 32)
            ends = value(np.array([left, right]))
            if not np.isfinite(series).all() or not np.isfinite(ends).all():
                where = f"between {origin + left:g} and {origin + right:g} s"
                raise ValueError(f"function must be finite over the plan, got nan or inf {where}")
            # The points are inside: a kink beside an end shows only in the value there.
            missed = np.abs(chebyshev.chebval(np.array([-1.0, 1.0]), series.T) - ends).max(axis=1)
            scale = np.maximum(scale, np.abs(ends).max(axis=1))
            unresolved = float(
                (np.maximum(missed, np.abs(series[:, -8:]).max(axis=1)) / np.maximum(scale, _TINY)).max()
            )
            # What bisection no longer makes smaller is the rounding of the function; a kink would be halved.
            resolved = unresolved <= 1e-13 or 0.7 * before < unresolved <= 1e-9
            if not resolved and pieces < _MAX_PIECES and right - left > 1e-9 * duration:
                middle = 0.5 * (left + right)
                todo += [(left, middle, unresolved), (middle, right, unresolved)]
                continue
            roots = [real_roots(chebyshev.chebder(row)) for row in series]
            t = np.concatenate([[left, right], *(0.5 * (left + right) + 0.5 * (right - left) * r for r in roots)])
            found.add(origin + t, value(t), (origin, origin + duration))
    return found.extrema()


def certified_bounds(
    plan: Trajectory,
    function: Callable[[Array], Array],
    order: int,
    lipschitz: ArrayLike,
    rtol: float,
    max_cells: int,
) -> Bounds:
    """Bounds by refining cells until a Lipschitz bound decides."""
    legs = _searchable_legs(plan)
    try:
        weights = np.broadcast_to(np.asarray(lipschitz, dtype=float), (order + 1, plan.naxes))[:, :, None]
    except ValueError:
        shape = f"({order + 1}, {plan.naxes})"
        raise ValueError(f"lipschitz must broadcast to shape {shape}, got shape {np.shape(lipschitz)}") from None
    if not (np.isfinite(weights).all() and np.all(weights >= 0.0)):
        raise ValueError(f"lipschitz must be finite and at least 0, got {lipschitz!r}")
    if not rtol > 0.0:
        raise ValueError(f"rtol must be above 0, got {rtol}")

    def evaluated(jet: Array) -> Array:
        values = np.asarray(function(jet), dtype=float)
        if values.shape != jet.shape[2:]:
            raise ValueError(f"function must return one value a time, shape {jet.shape[2:]}, got {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError("function must be finite over the plan, got nan or inf")
        return values

    first, second = (np.stack([plan.peak(k + nu) for k in range(order + 1)])[:, :, None] for nu in (1, 2))
    found, lower, upper = _Candidates(), np.inf, -np.inf
    least, greatest = np.inf, -np.inf
    for leg, (origin, duration) in enumerate(legs):
        s = np.linspace(0.0, duration, 129)
        values = evaluated(plan._leg_jet(leg, s, order))
        found.add(origin + s, values[None])
        least, greatest = min(least, float(values.min())), max(greatest, float(values.max()))
    for leg, (origin, duration) in enumerate(legs):
        radius, spent = duration / 256, 0
        centres = duration * (np.arange(128) + 0.5) / 128
        while centres.size:
            spent += centres.size
            if spent > max_cells:
                raise ValueError(f"rtol = {rtol:g} must be reached within {max_cells} cells; raise either of them")
            jet = plan._leg_jet(leg, centres, order + 1)
            values = evaluated(jet[:-1])
            # In its cell a derivative moves by no more than the next one's value at the centre and slope allow.
            slope = np.minimum(first, np.abs(jet[1:]) + radius * second)
            reach = radius * np.sum(weights * slope, axis=(0, 1))
            found.add(origin + centres, values[None])
            least, greatest = min(least, float(values.min())), max(greatest, float(values.max()))
            gap = rtol * (greatest - least)
            undecided = (values - reach < least - gap) | (values + reach > greatest + gap)
            undecided &= reach > gap
            if not undecided.all():
                lower = min(lower, float((values - reach)[~undecided].min()))
                upper = max(upper, float((values + reach)[~undecided].max()))
            radius *= 0.5
            centres = (centres[undecided, None] + np.array([-radius, radius])).ravel()
    best = found.extrema()
    return Bounds(
        lower,
        upper,
        *(float(v[0]) for v in (best.minimum, best.maximum, best.time_min, best.time_max)),
    )


class _Candidates:
    """Least and greatest of the values seen, one row an axis."""

    def __init__(self) -> None:
        self.times: list[Array] = []
        self.values: list[Array] = []
        self.ends: list[Array] = []

    def add(self, t: Array, values: Array, ends: tuple[float, float] = (np.nan, np.nan)) -> None:
        """Values (naxes, ntime) at some times, of which those of the `ends` of a leg go first in a tie."""
        self.times.append(t)
        self.values.append(values)
        self.ends.append(np.where((t == ends[0]) | (t == ends[1]), 1.0, 0.0))

    def extrema(self) -> Extrema:
        t, values, ends = np.concatenate(self.times), np.concatenate(self.values, axis=1), np.concatenate(self.ends)
        by_time = np.argsort(t, kind="stable")
        t, values, ends = t[by_time], values[:, by_time], ends[by_time]
        low, high = (self._first(sign * values, ends) for sign in (1.0, -1.0))
        rows = np.arange(len(values))
        return Extrema(values[rows, low], values[rows, high], t[low], t[high])

    @staticmethod
    def _first(values: Array, ends: Array) -> NDArray[np.intp]:
        """Where each row is least: to rounding, at an end if it can be, and as early as it can be."""
        slack = 8.0 * np.finfo(float).eps * np.abs(values).max(axis=1, keepdims=True)
        tied = values <= values.min(axis=1, keepdims=True) + slack
        return np.argmax(tied * (1.0 + ends), axis=1)


def _legs(plan: Trajectory) -> list[tuple[float, float]]:
    """Beginning and duration [s] of each leg."""
    return list(zip(plan.breakpoints[:-1].tolist(), np.diff(plan.breakpoints).tolist(), strict=True))


def _searchable_legs(plan: Trajectory) -> list[tuple[float, float]]:
    legs = _legs(plan)
    if not legs:
        raise ValueError("a trajectory without duration has no interval to search, got a step")
    return legs


def _pieces(
    jet: Callable[[Array, int], Array], a: float, b: float, nu: int, depth: int = 6
) -> list[tuple[float, float, Array]]:
    """Intervals with Chebyshev coefficients (naxes, size) of the nu-th derivative."""
    proxy = chebyshev_proxy(jet, (a, b), nu, nu)
    if proxy is not None:
        return [(a, b, proxy[0])]
    if not depth:  # what is not resolved by now is rounding
        return [(a, b, fit(lambda t: jet(t, nu)[nu], (a, b), 32))]
    middle = 0.5 * (a + b)
    return _pieces(jet, a, middle, nu, depth - 1) + _pieces(jet, middle, b, nu, depth - 1)


def _polished(jet: Callable[[Array, int], Array], t: Array, nu: int, duration: float) -> Array:
    """One Newton step on y^(nu + 1) for every axis from every candidate, kept if it stays near."""
    slope, curve = jet(t, nu + 2)[nu + 1 :]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        moved = t - slope / curve
    near = np.isfinite(moved) & (np.abs(moved - t) < 1e-6 * duration) & (moved >= 0.0) & (moved <= duration)
    return moved[near]
