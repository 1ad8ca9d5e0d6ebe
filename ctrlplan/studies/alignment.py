"""Offset between the time of a log and that of a plan."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.signal import correlate

from ctrlplan._types import Array
from ctrlplan.systems.regression import least_squares
from ctrlplan.trajectories import Trajectory

_POINTS = 2**20
"""Maximum number of points of the grid on which offsets are compared."""

_STEPS, _REACH = 20, 10.0
"""Steps of the Gauss-Newton method at most, and the largest one, relative to that of the grid."""

_DEVIATIONS = 6.0
"""Standard deviations of the noise within which two sums of squares are equal."""

_PART = 0.05
"""Part of the range of the known signal that a log must contain."""

_NEAR = 0.1
"""Offset relative to the duration of the known signal up to which the origins of time are taken to agree."""


class Known(ABC):
    """Signal that a logged one is compared with: a function of the plan's time.

    It is constant outside an interval, or not known there (`extends`).

    Attributes
    ----------
    start, end : float
        The interval [s].
    extends : bool, class variable
        Whether it is known to be constant outside.
    """

    start: float
    end: float
    extends: ClassVar[bool] = True

    @abstractmethod
    def jet(self, t: Array) -> tuple[Array, Array]:
        """Values and rates (ntime,)."""


class OfPlan(Known):
    """One axis of a plan."""

    def __init__(self, plan: Trajectory, axis: int) -> None:
        self._plan, self._axis = plan, axis
        self.start, self.end = float(plan.start), float(plan.end)

    def jet(self, t: Array) -> tuple[Array, Array]:
        """Position and velocity."""
        rows = self._plan.jet(t, 1)[:, self._axis]
        return rows[0], rows[1]


class OfSamples(Known):
    """A simulated signal, interpolated by monotone cubics (PCHIP)."""

    extends = False

    def __init__(self, t: Array, values: Array) -> None:
        self._curve = PchipInterpolator(t, values)
        self._rate = self._curve.derivative()
        self.start, self.end = float(t[0]), float(t[-1])

    def jet(self, t: Array) -> tuple[Array, Array]:
        """Values and rates, held at the ends."""
        inside = np.clip(t, self.start, self.end)
        return self._curve(inside), np.where(inside == t, self._rate(inside), 0.0)


@dataclass(frozen=True)
class Pair:
    """A logged signal and the known one.

    Attributes
    ----------
    values : ndarray, shape (ntime,)
        The logged signal.
    known : Known
        What it is compared with.
    scale : float
        Weight: a difference of this size counts as 1.
    """

    values: Array
    known: Known
    scale: float


@dataclass(frozen=True)
class Offset:
    """Time of a log minus time of the plan.

    Attributes
    ----------
    seconds : float
        The offset [s].
    standard_error : float
        Its standard error [s]; infinite where the signals do not determine it.
    residual : float
        Root mean square of the differences that remain, relative to the scales.
    others : int
        Number of other offsets that fit as well up to noise, such as those of a
        plan that repeats.
    """

    seconds: float
    standard_error: float
    residual: float
    others: int = 0


def find_offset(t: Array, pairs: Sequence[Pair]) -> Offset:
    r"""Offset d that minimises the squares of y(t) - r(t - d), with its standard error.

    The offset is searched for on a grid by correlation, then refined by the
    Gauss-Newton method. For white noise of standard deviation sigma the standard
    error is :math:`\sigma \sqrt{\Delta t / \int \dot r^2\,dt}`, the bound of any
    method; correlation of successive residuals is taken into account.

    Parameters
    ----------
    t : ndarray, shape (ntime,)
        Times of the log [s].
    pairs : sequence of Pair
        Signals, at least one.
    """
    step = max(float(np.median(np.diff(t))), 4.0 * float(t[-1] - t[0]) / _POINTS)
    offsets, costs = _costs(t, pairs, step)
    rough = float(offsets[costs.argmin()])
    noise = _relative_noise(_linearised(t, pairs, rough)[1])
    near = _NEAR * (max(pair.known.end for pair in pairs) - min(pair.known.start for pair in pairs))
    offset, others = _best(offsets, costs, noise, near)
    for _ in range(_STEPS):
        rates, residual, _ = _linearised(t, pairs, offset)
        power = float(rates @ rates)
        if power == 0.0:
            break
        change = float(np.clip(-(rates @ residual) / power, -_REACH * step, _REACH * step))
        offset += change
        if abs(change) <= 1e-12 * max(abs(offset), step):
            break
    rates, residual, used = _linearised(t, pairs, offset)
    rms = float(np.sqrt(residual @ residual / max(int(np.count_nonzero(used)), 1)))
    if not any(_moves(t - offset, pair.known) for pair in pairs):
        return Offset(offset, math.inf, math.inf, others)
    if rates.any():
        error = float(least_squares(-rates[:, None], residual, used).standard_errors[0])
        rounding = 8.0 * np.finfo(float).eps * float(np.abs(t).max())
        return Offset(offset, float(max(error, rounding)), rms, others)
    return _between_samples(t, pairs, offset, step, others)


def _costs(t: Array, pairs: Sequence[Pair], step: float) -> tuple[Array, Array]:
    """Offsets on a grid, and the sum of squares of each, from all of the log before the plan to all behind it."""
    count = int(np.ceil((t[-1] - t[0]) / step * (1.0 - 1e-12))) + 1
    grid = t[0] + step * np.arange(count)
    start = min(pair.known.start for pair in pairs)
    end = max(min(pair.known.end, pair.known.start + count * step) for pair in pairs)
    width = min(int(np.ceil((end - start) / step)) + 1, _POINTS)
    known_at: Array = start + step * np.arange(-count, width + count, dtype=float)
    total = np.zeros(width + count + 1)
    for pair in pairs:
        values, known = np.interp(grid, t, pair.values), pair.known.jet(known_at)[0]
        middle = 0.5 * (known.max() + known.min())  # less cancellation
        values, known = (values - middle) / pair.scale, (known - middle) / pair.scale
        squares = np.concatenate([[0.0], np.cumsum(known**2)])
        total += values @ values - 2.0 * correlate(known, values, "valid", "fft") + squares[count:] - squares[:-count]
    return grid[0] - known_at[: total.size], np.maximum(total, 0.0)


def _relative_noise(residual: Array) -> float:
    """Difference of two sums of squares, relative to the smaller, that correlated noise explains."""
    power = float(residual @ residual)
    rho = min(abs(float(residual[1:] @ residual[:-1])) / power, 0.9999) if power else 0.0
    return _DEVIATIONS * math.sqrt((1.0 + rho**2) / (1.0 - rho**2) / residual.size)


def _best(offsets: Array, costs: Array, noise: float, near: float) -> tuple[float, int]:
    """Offset with the minimum cost and number of others that differ from it by noise; of these, one near 0 is taken."""
    inner = np.flatnonzero((costs[1:-1] <= costs[:-2]) & (costs[1:-1] < costs[2:])) + 1
    minimum = float(costs.min())
    equal = offsets[inner[costs[inner] <= minimum * (1.0 + noise) + 1e-9 * float(costs.max())]]
    nearest = float(equal[np.abs(equal).argmin()]) if equal.size else math.inf
    if abs(nearest) <= near:  # the origins of time agree, as far as the signals show
        return nearest, equal.size - 1
    return float(offsets[costs.argmin()]), max(equal.size - 1, 0)


def _linearised(t: Array, pairs: Sequence[Pair], offset: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Rates of the known signals, differences of the logged ones, one pair after the other, and which are known."""
    rates, differences, covered = [], [], []
    own = t - offset
    for pair in pairs:
        values, rate = pair.known.jet(own)
        inside = (own >= pair.known.start) & (own <= pair.known.end) | pair.known.extends
        rates.append(np.where(inside, rate / pair.scale, 0.0))
        differences.append(np.where(inside, (pair.values - values) / pair.scale, 0.0))
        covered.append(inside)
    return np.concatenate(rates), np.concatenate(differences), np.concatenate(covered)


def _moves(t: Array, known: Known) -> bool:
    """Whether a log contains a considerable part of the change of a known signal."""
    whole = np.linspace(known.start, min(known.end, known.start + float(np.ptp(t))), 1001)
    return bool(np.ptp(known.jet(t)[0]) > _PART * np.ptp(known.jet(whole)[0]))


def _between_samples(t: Array, pairs: Sequence[Pair], offset: float, step: float, others: int) -> Offset:
    """Offset of signals that only jump: it is known to the interval between two samples."""
    tried = offset + step * np.linspace(-1.5, 1.5, 301)
    powers = np.array([np.sum(_linearised(t, pairs, float(one))[1] ** 2) for one in tried])
    equal = tried[powers <= powers.min() * (1.0 + 1e-9) + 1e-30]
    if equal.size == tried.size:
        return Offset(offset, math.inf, math.inf, others)
    middle = 0.5 * float(equal[0] + equal[-1])
    rms = float(np.sqrt(powers.min() / (t.size * len(pairs))))
    return Offset(middle, max(float(equal[-1] - equal[0]), step) / math.sqrt(12.0), rms, others)
