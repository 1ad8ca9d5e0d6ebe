"""Kinds of input shapers: polynomials in one delay, designed for one mode."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_count, checked_finite, finite_vector, new_numbers, one_number
from ctrlplan.trajectories.common import Array, readonly

_DROPPED = 4.0 * np.finfo(float).eps
"""Relative rounding of weights and delays on a grid."""

_SAME = 1e-13
"""Relative difference of phases that is rounding: the delay is then a number of samples."""

_HEAVY = 50.0
"""Exponent of a mode per phase [1/rad] above which it is limited, so that powers do not overflow."""

_RESOLUTION = 1e-7
"""Relative resolution of the periods that the fit to a spectrum searches."""

_LONGEST = 4.0
"""Longest period searched, relative to that of the lowest frequency to be attenuated."""


@dataclass(frozen=True)
class ShaperFactor:
    r"""Part of a shaper that is designed for one mode.

    Its impulses are one delay apart: with the operator q of that delay the part
    is the polynomial :math:`\sum_i w_i q^i`.

    Attributes
    ----------
    kind : str
        ZV, ZVD, MZV, EI, ...
    frequency : float
        Undamped natural frequency of the mode [rad/s].
    damping : float
        Its damping ratio.
    angle : float
        Phase [rad] by which the mode advances during one delay.
    weights : tuple of float
        w_i, at least 0, of sum 1.
    """

    kind: str
    frequency: float
    damping: float
    angle: float
    weights: tuple[float, ...]

    @property
    def delay(self) -> float:
        """Distance of two impulses [s]."""
        return self.angle / (self.frequency * math.sqrt(1.0 - self.damping**2))

    @property
    def growth(self) -> complex:
        r"""Exponent of the mode per phase [1/rad].

        .. math:: \frac{\zeta}{\sqrt{1 - \zeta^2}} + i
        """
        # A mode that decays by exp(-100) over a delay is left with no vibration whatever the impulses.
        return complex(min(self.damping / math.sqrt(1.0 - self.damping**2), _HEAVY), 1.0)

    def on_grid(self, dt: float) -> Array:
        """Weights on a grid with the same effect on the mode.

        The delay is replaced by three impulses at 0, k dt and (k + 1) dt that have
        the same effect on the mode, with k dt <= delay < (k + 1) dt.

        Parameters
        ----------
        dt : float
            Period [s].

        Returns
        -------
        ndarray, shape (ntaps,)
            At least 0, of sum 1.

        Raises
        ------
        ValueError
            If the period is longer than the delay, or weights would be negative.
        """
        samples = self.delay / dt
        if samples < 1.0 - _DROPPED:
            raise ValueError(
                f"dt must be at most {self.delay:.6g} s, the delay of the {self.kind} shaper for {self.frequency:g} "
                f"rad/s (half a period of the mode, its Nyquist limit; for MZV three eighths), got {dt:g} s; use a "
                "shorter cycle time"
            )
        k = max(int(samples * (1.0 + _DROPPED)), 1)
        taps = np.zeros(k + 2)
        taps[[0, k, k + 1]] = self.taps(self.angle / samples * np.array([k, k + 1]))
        found = composed_weights(self.weights, taps)
        if found.min() < -1e-13:
            raise ValueError(
                f"dt must be shorter for the {self.kind} shaper for {self.frequency:g} rad/s, got {dt:g} s, "
                f"{samples:.3g} samples for half a period: weights would be negative; use a shorter cycle time or a "
                "smaller tolerance"
            )
        found = np.where(found < _DROPPED * min(self.weights), 0.0, found)
        return found / found.sum()

    def taps(self, phases: Array, amplitudes: ArrayLike = 1.0) -> Array:
        r"""Weights of three commands in place of the delay.

        They are those of the commands now, k and k + 1 samples ago. With :math:`z_k`
        the factor of the mode over k samples, backwards in time, and T that over the
        delay, :math:`\gamma + \alpha + \beta = 1` and
        :math:`\gamma + \alpha z_k + \beta z_{k+1} = T`.

        Parameters
        ----------
        phases : ndarray, shape (2,)
            Phases [rad] by which the mode advances in k and in k + 1 samples.
        amplitudes : array_like, shape (2,), optional
            Vibration that an impulse now excites, relative to one k and k + 1 samples
            ago.

        Returns
        -------
        ndarray, shape (3,)
            gamma, alpha, beta.
        """
        same = np.abs(phases - self.angle) <= _SAME * self.angle
        if same.any() and np.all(np.asarray(amplitudes) == 1.0):
            return np.concatenate([[0.0], same.astype(float)])
        first, second = (np.asarray(amplitudes) * np.exp(self.growth * phases) - 1.0).tolist()
        wanted = complex(np.exp(self.growth * self.angle)) - 1.0
        # Cramer's rule for the real and the imaginary part.
        scale = first.real * second.imag - first.imag * second.real
        alpha = (wanted.real * second.imag - wanted.imag * second.real) / scale
        beta = (first.real * wanted.imag - first.imag * wanted.real) / scale
        return np.array([1.0 - alpha - beta, alpha, beta])


def composed_weights(weights: tuple[float, ...], taps: Array) -> Array:
    """Weights on the grid of a polynomial in a delay that is given by its taps."""
    found = np.array([weights[-1]])
    for weight in weights[-2::-1]:
        found = np.convolve(found, taps)
        found[0] += weight
    return found


def residual_of(delays: Array, weights: Array, omega: Array, zeta: Array) -> Array:
    """Residual vibration of modes, relative to that of one impulse; omega and zeta broadcast."""
    mode = omega * (zeta + 1j * np.sqrt(1.0 - zeta**2))
    left: Array = np.abs(np.exp(mode[..., None] * (delays - delays[-1])) @ weights)
    return left


def checked_damping(damping: ArrayLike) -> Array:
    """Damping ratios in [0, 1), checked."""
    zeta = new_numbers(damping, "damping")
    if not np.all((zeta >= 0.0) & (zeta < 1.0)):
        raise ValueError(f"damping must lie in [0, 1), got {damping!r}")
    return zeta


def checked_ratio(damping: float) -> float:
    """One damping ratio in [0, 1), checked."""
    return float(checked_damping(one_number(damping, "damping")))


def checked_tolerance(tolerance: float) -> float:
    """Residual vibration in (0, 1), checked."""
    value = checked_finite(tolerance, "tolerance", above=0.0)
    if value >= 1.0:
        raise ValueError(f"tolerance must be below 1, the residual vibration without a shaper, got {tolerance}")
    return value


def zvd_factor(frequency: float, damping: float = 0.0, derivatives: int = 1) -> ShaperFactor:
    """Zeros of order ``derivatives + 1`` at the mode: ZV, ZVD, ZVDD, ..."""
    count = checked_count(derivatives, "derivatives") + 1
    names = ("ZV", "ZVD", "ZVDD", "ZVDDD")
    kind = names[count - 1] if count <= len(names) else f"ZVD of order {count - 1}"
    return _factor(kind, frequency, damping, math.pi, [math.comb(count, k) / 2.0**count for k in range(count + 1)])


def mzv_factor(frequency: float, damping: float = 0.0) -> ShaperFactor:
    """Three impulses within three quarters of a period, with one zero at the mode."""
    return _factor("MZV", frequency, damping, 0.75 * math.pi, [1.0, math.sqrt(2.0), 1.0])


def ei_factor(frequency: float, damping: float = 0.0, tolerance: float = 0.05) -> ShaperFactor:
    """One hump of the height of the tolerance, at the mode."""
    v = checked_tolerance(tolerance)
    return _factor("EI", frequency, damping, math.pi, [1.0 + v, 2.0 * (1.0 - v), 1.0 + v])


def two_hump_factor(frequency: float, damping: float = 0.0, tolerance: float = 0.05) -> ShaperFactor:
    """Two humps of the height of the tolerance, with a zero between them at the mode."""
    square = checked_tolerance(tolerance) ** 2
    x = (square * (math.sqrt(1.0 - square) + 1.0)) ** (1.0 / 3.0)
    outer = (3.0 * x**2 + 2.0 * x + 3.0 * square) / (16.0 * x)
    return _factor("two-hump EI", frequency, damping, math.pi, [outer, 0.5 - outer, 0.5 - outer, outer])


def three_hump_factor(frequency: float, damping: float = 0.0, tolerance: float = 0.05) -> ShaperFactor:
    """Three humps of the height of the tolerance, the middle one at the mode."""
    v = checked_tolerance(tolerance)
    outer = (1.0 + 3.0 * v + 2.0 * math.sqrt(2.0 * v * (1.0 + v))) / 16.0
    inner = 0.25 * (1.0 - v)
    middle = 1.0 - 2.0 * (outer + inner)
    return _factor("three-hump EI", frequency, damping, math.pi, [outer, inner, middle, inner, outer])


def fitted_factor(frequencies: ArrayLike, response: ArrayLike, tolerance: float, damping: float) -> ShaperFactor:
    """Shortest of all kinds for a measured spectrum; see `Shaper.fit`.

    Raises
    ------
    ValueError
        If an argument is out of range, or no kind meets the tolerance.
    """
    omega, share = _checked_spectrum(frequencies, response)
    limit = checked_tolerance(tolerance)
    zeta = checked_ratio(damping)
    active = share > limit  # a shaper with positive weights amplifies nothing
    omega, share = omega[active], share[active]
    kinds: list[Callable[[float], ShaperFactor]] = [
        partial(mzv_factor, damping=zeta),
        *(partial(zvd_factor, damping=zeta, derivatives=order) for order in range(3)),
        *(partial(kind, damping=zeta, tolerance=limit) for kind in (ei_factor, two_hump_factor, three_hump_factor)),
    ]
    best, longest = None, math.inf
    for kind in kinds:
        unit = kind(1.0)  # duration 1/frequency times that of 1 rad/s
        span = unit.delay * (len(unit.weights) - 1)
        period = _shortest_period(unit, omega, share, limit, min(_LONGEST / float(omega.min()), longest / span))
        if period is not None:
            best, longest = kind(1.0 / period), period * span
    if best is None:
        raise ValueError(
            f"no shaper for a single mode keeps the spectrum from {omega.min():.4g} to {omega.max():.4g} rad/s below "
            f"{limit:g} of its maximum; use a larger tolerance, one shaper for each peak, joined by then, or a "
            "spectrum without the static response at low frequencies"
        )
    return best


def _shortest_period(unit: ShaperFactor, omega: Array, share: Array, limit: float, longest: float) -> float | None:
    """Smallest 1/frequency [s] of a kind that keeps all shares below the limit; None if there is none.

    The residual of the kind for 1 rad/s at the relative frequency u has a slope of
    at most the sum of w_i (t_n - t_i), so that an excess excludes an interval of
    periods. No feasible interval wider than the resolution is skipped.
    """
    weights: Array = np.array(unit.weights)
    delays: Array = unit.delay * np.arange(weights.size, dtype=float)
    zeta = np.asarray(unit.damping)
    slopes = share * omega * float(weights @ (delays[-1] - delays))

    def excess(period: float) -> Array:
        return share * residual_of(delays, weights, omega * period, zeta) - limit

    below, period = 0.0, 0.0
    while period <= longest:
        over = excess(period)
        if over.max() <= 0.0:
            break
        below = period
        period += max(float((over / slopes).max()), _RESOLUTION * period)
    else:
        return None
    for _ in range(60):  # to the edge of the feasible interval
        middle = 0.5 * (below + period)
        if excess(middle).max() <= 0.0:
            period = middle
        else:
            below = middle
    return period


def _factor(kind: str, frequency: float, damping: float, angle: float, undamped: ArrayLike) -> ShaperFactor:
    """Factor whose weights decay with the mode from impulse to impulse."""
    omega, zeta = checked_finite(frequency, "frequency", above=0.0), checked_ratio(damping)
    decay = math.exp(-zeta * angle / math.sqrt(1.0 - zeta**2))
    weights = np.asarray(undamped, dtype=float)
    weights = weights * decay ** np.arange(weights.size)
    return ShaperFactor(kind, omega, zeta, angle, tuple((weights / math.fsum(weights)).tolist()))


def _checked_spectrum(frequencies: ArrayLike, response: ArrayLike) -> tuple[Array, Array]:
    """Frequencies, and the response relative to its maximum."""
    omega = finite_vector(frequencies, "frequencies", "nfrequencies")
    size = finite_vector(response, "response", "nfrequencies")
    if omega.size != size.size:
        raise ValueError(f"response must be as many numbers as frequencies, {omega.size}, got {size.size}")
    for i in np.flatnonzero(omega <= 0.0).tolist():
        raise ValueError(f"frequencies must be above 0, got frequencies[{i}] = {omega[i]}")
    for i in np.flatnonzero(size < 0.0).tolist():
        raise ValueError(f"response must be magnitudes of at least 0, got response[{i}] = {size[i]}")
    if not size.any():
        raise ValueError("response must have a value above 0, got zeros only")
    return readonly(omega), readonly(size / size.max())
