"""Samples of a plan for a discrete loop, and signals that are held between samples."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.systems.feedforward.zeros import ComplexArray
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.internal import InternalTrajectory

MAXIMUM = 5_000_000
"""Maximum number of samples of a plan, or of a preview."""

_ENERGY = 0.999
"""Part of the energy of a plan's velocity below its highest frequency."""

_EARLY = 1e-6
"""Fraction of a sample by which a time may precede the sample."""


class Reference:
    """Samples of a plan, filtered for zeros that are not cancelled.

    With B(z) of these zeros the reference is B(1/z)/B(1) y_d. The loop then gives
    B(z) B(1/z)/B(1)^2 y_d: without phase error, of gain 1 at frequency 0.

    Parameters
    ----------
    plan : Trajectory
        The plan.
    dt : float
        Time between samples [s]; sample 0 is the start of the plan.
    zeros : ndarray of complex
        Zeros that are not cancelled.

    Attributes
    ----------
    last : int
        Sample from which on the reference is constant.
    """

    def __init__(self, plan: Trajectory, dt: float, zeros: ComplexArray) -> None:
        self._plan, self._dt = plan, dt
        self._factor = np.atleast_1d(np.real(np.poly(zeros))) / np.prod(1.0 - zeros).real
        self._filtered = self._factor.size > 1
        if plan.duration > MAXIMUM * dt:
            raise ValueError(
                f"plan must have at most {MAXIMUM} samples, got {plan.duration:g} s with a sampling time of {dt:g} s"
            )
        self.last = math.ceil(plan.duration / dt - _EARLY) + self._factor.size - 1

    def rows(self, first: int, orders: Sequence[int]) -> Array:
        """Samples k, ..., k + r of each axis (sum(r + 1), nsamples), for k from `first` to `last`."""
        count = self.last - first + 1
        values = self._values(first, count + max(orders))
        return np.vstack([values[axis, i : i + count] for axis, r in enumerate(orders) for i in range(r + 1)])

    def error(self) -> float:
        """Maximum deviation of the output from the plan at samples, relative to the range of the plan."""
        if not self._filtered:
            return 0.0
        degree = self._factor.size - 1
        wanted = self._sampled(-degree, self.last + 2 * degree)[0]
        found = np.convolve(self._values(-degree, self.last + 3 * degree)[0], self._factor, "valid")
        return float(np.abs(found - wanted[: found.size]).max() / (np.ptp(wanted) or 1.0))

    def gain(self) -> tuple[float, float]:
        """Frequency [rad/s] below which nearly all energy of the plan's velocity lies, and the gain there."""
        steps = np.diff(self._sampled(-1, self.last + 2)[0])
        energy = np.abs(np.fft.rfft(steps, 8 * steps.size)) ** 2
        share = np.cumsum(energy)
        angle = np.pi * float(np.searchsorted(share, _ENERGY * share[-1])) / (energy.size - 1) if share[-1] else 0.0
        return angle / self._dt, float(np.abs(np.polyval(self._factor, np.exp(1j * angle))) ** 2)

    def _values(self, first: int, count: int) -> Array:
        degree = self._factor.size - 1
        wanted = self._sampled(first - degree, count + degree)
        return np.array([np.convolve(row, self._factor[::-1], "valid") for row in wanted])

    def _sampled(self, first: int, count: int) -> Array:
        """Positions (naxes, count) at samples."""
        times = self._plan.start + self._dt * np.arange(first, first + count).astype(float)
        return np.asarray(self._plan.jet(_on_breakpoints(times, self._plan.breakpoints, self._dt), 0)[0])


def held_samples(start: float, dt: float, values: Array, before: Array) -> Trajectory:
    """Signals (nsignals, nsamples) that are constant from sample to sample, and equal to `before` at first."""
    return _Samples(start, dt, values, before)


class _Samples(InternalTrajectory):
    """Signals that are constant between samples.

    Parameters
    ----------
    start, dt : float
        Time of the first sample, and between samples [s].
    values : ndarray, shape (nsignals, nsamples)
        Values from each sample on.
    before : ndarray, shape (nsignals,)
        Values before the first sample.
    """

    what = "the samples of a command"
    values: Array
    initial: Array
    final: Array
    dt: float

    def __init__(self, start: float, dt: float, values: Array, before: Array) -> None:
        self._set_fields(
            labels=tuple(f"sample{row}" for row in range(len(values))),
            breakpoints=start + dt * np.arange(values.shape[1]),
            values=values,
            initial=before,
            final=values[:, -1].copy(),
            dt=dt,
        )

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        found = np.zeros((order + 1, self.naxes, s.size))
        found[0] = self.values[:, segment, None]
        return found

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        # Times of samples, computed by others in another way, differ by rounding.
        place = (t - self.start) / self.dt
        row = np.ceil(place - _EARLY) - 1.0 if left else np.floor(place + _EARLY)
        known = np.column_stack([self.initial, self.values])
        found = np.zeros((high - low + 1, self.naxes, t.size))
        if low == 0:
            found[0] = known[:, np.clip(row, -1.0, self.values.shape[1] - 1.0).astype(np.intp) + 1]
        return found


def _on_breakpoints(times: Array, breakpoints: Array, dt: float) -> Array:
    """Times, replaced by a breakpoint that they equal up to rounding."""
    nearest: NDArray[np.intp] = np.clip(np.searchsorted(breakpoints, times - _EARLY * dt), 0, breakpoints.size - 1)
    close = np.abs(breakpoints[nearest] - times) <= _EARLY * dt
    return np.where(close, breakpoints[nearest], times)
