"""Motion as a function of time with derivatives: of a plan, or of measured positions."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.signal import butter, sosfiltfilt

from ctrlplan._types import Array
from ctrlplan.trajectories import Trajectory

_ORDER = 4
"""Order of the filter, which acts forward and backward."""

_NOISE = 1e-3
"""Permitted variance of the noise in the highest derivative, relative to that of the derivative."""


class Motion(ABC):
    """Position and derivatives at any time.

    Attributes
    ----------
    start, end : float
        Interval in which the motion is known [s].
    """

    start: float
    end: float

    @abstractmethod
    def jet(self, t: Array) -> Array:
        """Position and derivatives (order + 1, ntime)."""

    def smooth(self, values: Array) -> Array:
        """Signal at the sample times, treated as the position was."""
        return values


class PlannedMotion(Motion):
    """One axis of a plan."""

    def __init__(self, plan: Trajectory, axis: int, order: int) -> None:
        self._plan, self._axis, self._order = plan, axis, order
        self.start, self.end = -math.inf, math.inf

    def jet(self, t: Array) -> Array:
        """Position and derivatives (order + 1, ntime)."""
        return self._plan.jet(t, self._order)[:, self._axis]


class SampledMotion(Motion):
    """Measured positions after a low-pass filter without phase shift.

    The filter is a Butterworth filter of order 4 that is applied forward and
    backward. Its cutoff frequency is the highest at which the variance of the noise
    in the highest derivative is below 0.1 % of that of the derivative.

    Parameters
    ----------
    t : ndarray, shape (ntime,)
        Evenly spaced times [s].
    position : ndarray, shape (ntime,)
        Measured positions.
    order : int
        Highest derivative.

    Attributes
    ----------
    cutoff : float
        Cutoff frequency [Hz].
    velocity_noise : float
        Standard deviation of the noise of the velocity.
    """

    def __init__(self, t: Array, position: Array, order: int) -> None:
        self._rate = 1.0 / float(np.median(np.diff(t)))
        self.cutoff = _cutoff(position, self._rate, order)
        self.velocity_noise = math.sqrt(_noise(position, self._rate, self.cutoff, 1))
        margin = 0.5 / self.cutoff  # of samples that the ends affect
        self.start, self.end = float(t[0]) + margin, float(t[-1]) - margin
        curve = make_interp_spline(t, self.smooth(position), k=5)
        self._curves = [curve.derivative(k) if k else curve for k in range(order + 1)]

    def jet(self, t: Array) -> Array:
        """Position and derivatives (order + 1, ntime)."""
        return np.stack([curve(t) for curve in self._curves])

    def smooth(self, values: Array) -> Array:
        """Signal at the sample times after the same filter."""
        return _low_passed(values, self.cutoff, self._rate)


class FilteredColumn:
    """Function of the motion at the sample times, filtered as the position, between them by cubics."""

    def __init__(self, t: Array, values: Array, motion: Motion) -> None:
        self._curve = CubicSpline(t, motion.smooth(values))

    def __call__(self, t: Array) -> Array:
        """Values at other times."""
        return np.asarray(self._curve(t))


def _cutoff(position: Array, rate: float, order: int) -> float:
    """Highest cutoff frequency [Hz] with which the highest derivative is above the noise."""
    frequencies = np.geomspace(max(2.0 * rate / position.size, 1e-3 * rate), 0.2 * rate, 32)[::-1]
    for cutoff in frequencies.tolist():
        derivative = _low_passed(position, cutoff, rate)
        for _ in range(order):
            derivative = np.gradient(derivative, 1.0 / rate)
        power = float(np.var(derivative))
        if _noise(position, rate, cutoff, order) <= _NOISE * power:
            return cutoff
    return float(frequencies[-1])


def _noise(position: Array, rate: float, cutoff: float, order: int) -> float:
    """Variance of the noise in a derivative after the filter, for white noise of the position."""
    variance = float(np.mean(np.diff(position, 4) ** 2)) / 70.0  # 70: the sum of squares of 1, 4, 6, 4, 1
    return variance * (2.0 / rate) * (2.0 * np.pi * cutoff) ** (2 * order) * cutoff / (2 * order + 1)


def _low_passed(values: Array, cutoff: float, rate: float) -> Array:
    sections = butter(_ORDER, cutoff, fs=rate, output="sos")
    return np.asarray(sosfiltfilt(sections, values, padlen=min(int(3.0 * rate / cutoff), values.size - 1)))
