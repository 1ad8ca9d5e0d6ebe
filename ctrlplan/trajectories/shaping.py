"""Input shaping: delayed copies of a reference whose residual vibrations cancel."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from functools import partial, reduce
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_kind, checked_finite, finite_vector, new_numbers
from ctrlplan._display import Displayed, Facts, Part, Table, counted, number, shortened
from ctrlplan.trajectories.combined import Sum
from ctrlplan.trajectories.common import Array, readonly
from ctrlplan.trajectories.fields import Fields
from ctrlplan.trajectories.repeated import combined
from ctrlplan.trajectories.shaper_factor import (
    ShaperFactor,
    checked_damping,
    ei_factor,
    fitted_factor,
    mzv_factor,
    residual_of,
    three_hump_factor,
    two_hump_factor,
    zvd_factor,
)
from ctrlplan.trajectories.trajectory import Trajectory

if TYPE_CHECKING:
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike


class Shaper(Displayed, Fields):
    r"""Input shaper, a sequence of impulses.

    The shaped reference is :math:`\sum_i w_i\,r(t - t_i)`. If the response of a
    mode to the impulses is zero after the last impulse, no shaped reference
    leaves residual vibration of that mode. The final position is unchanged.

    Parameters
    ----------
    delays : array_like, shape (nimpulses,)
        Times t_i of the impulses [s], from 0, increasing.
    weights : array_like, shape (nimpulses,)
        Their weights w_i, of sum 1.

    Attributes
    ----------
    delays, weights : ndarray, shape (nimpulses,)
        The arguments; the sum of the weights is 1 up to rounding.
    factors : tuple of ShaperFactor
        Designs for single modes of which the shaper is the convolution; empty if
        its impulses were given.

    Raises
    ------
    ValueError
        If a delay is below 0, delays do not increase strictly, the weights do not
        sum to 1 within 1e-12, a value is not finite, or the numbers of delays
        and weights differ.

    References
    ----------
    Singer and Seering, Preshaping command inputs to reduce system vibration,
    ASME J. Dynamic Systems, Measurement, and Control 112, 1990.

    Examples
    --------
    A ZV shaper for a load with a sway frequency of 2 rad/s:

    >>> import numpy as np
    >>> from ctrlplan.trajectories import Step
    >>> shaper = Shaper.zv(2.0)
    >>> shaper(Step(1.0))(np.array([-1.0, 0.0, 1.0, 2.0]))
    array([0. , 0.5, 0.5, 1. ])
    >>> shaper.residual([2.0, 2.2]).round(3)
    array([0.   , 0.156])
    """

    delays: Array
    weights: Array
    factors: tuple[ShaperFactor, ...]

    def __init__(self, delays: ArrayLike, weights: ArrayLike) -> None:
        times, parts = (
            finite_vector(values, name, "nimpulses") for values, name in ((delays, "delays"), (weights, "weights"))
        )
        if times.size != parts.size:
            raise ValueError(f"weights must be as many as delays, {times.size}, got {parts.size}")
        if times[0] < 0.0:
            raise ValueError(f"delays must be at least 0, got {times[0]}")
        for i in np.flatnonzero(np.diff(times) <= 0.0).tolist():
            raise ValueError(f"delays must increase strictly, got delays[{i + 1}] = {times[i + 1]} after {times[i]}")
        total = math.fsum(parts)
        if abs(total - 1.0) > 1e-12:
            raise ValueError(f"weights must sum to 1, got {total}")
        self._set_fields(delays=readonly(times), weights=readonly(parts / total), factors=())

    @classmethod
    def zv(cls, frequency: float, damping: float = 0.0) -> Self:
        r"""Zero-vibration (ZV) shaper of two impulses for one mode.

        The second impulse comes half a period :math:`\pi/(\omega\sqrt{1 - \zeta^2})`
        after the first, with :math:`K = e^{-\zeta\pi/\sqrt{1 - \zeta^2}}` times
        its weight.

        Parameters
        ----------
        frequency : float
            Undamped natural frequency [rad/s], above 0: 2 pi times that in Hz.
        damping : float, optional
            Damping ratio in [0, 1).

        Raises
        ------
        ValueError
            If an argument is out of range.
        """
        return cls.zvd(frequency, damping, 0)

    @classmethod
    def zvd(cls, frequency: float, damping: float = 0.0, derivatives: int = 1) -> Self:
        """Zero-vibration-and-derivative (ZVD) shaper for one mode.

        Robust to frequency errors: the residual vibration and its derivatives
        with respect to frequency and damping up to an order are 0. The shaper is
        `zv` convolved with itself, with binomial weights. Each order adds half a
        period to the duration.

        Parameters
        ----------
        frequency : float
            Undamped natural frequency [rad/s], above 0: 2 pi times that in Hz.
        damping : float, optional
            Damping ratio in [0, 1).
        derivatives : int, optional
            Order of the highest derivative that is 0: 1 is ZVD, 2 is ZVDD.

        Raises
        ------
        ValueError
            If an argument is out of range.
        """
        return cls._of(zvd_factor(frequency, damping, derivatives))

    @classmethod
    def mzv(cls, frequency: float, damping: float = 0.0) -> Self:
        r"""Modified zero-vibration (MZV) shaper for one mode.

        Three impulses, three eighths of a period apart, with the weights 1,
        :math:`\sqrt 2 k`, :math:`k^2` up to a factor, k the decay of the mode
        over one delay. The residual vibration is 0 at the mode, and the curve is
        flatter than that of `zv` at half the additional duration of `zvd`.

        Parameters
        ----------
        frequency : float
            Undamped natural frequency [rad/s], above 0: 2 pi times that in Hz.
        damping : float, optional
            Damping ratio in [0, 1).

        Raises
        ------
        ValueError
            If an argument is out of range.
        """
        return cls._of(mzv_factor(frequency, damping))

    @classmethod
    def ei(cls, frequency: float, damping: float = 0.0, tolerance: float = 0.05) -> Self:
        r"""Extra-insensitive (EI) shaper for one mode.

        Three impulses whose residual vibration at an undamped mode is the
        tolerance V, for which
        the range of frequencies below V is wider than that of `zvd` of the same
        duration. The weights are (1 + V)/4, (1 - V)/2, (1 + V)/4 times the powers
        1, K, :math:`K^2` of the decay over half a period, normalised: with
        damping the residual vibration is below the tolerance.

        Parameters
        ----------
        frequency : float
            Undamped natural frequency [rad/s], above 0: 2 pi times that in Hz.
        damping : float, optional
            Damping ratio in [0, 1).
        tolerance : float, optional
            V, in (0, 1).

        Raises
        ------
        ValueError
            If an argument is out of range.

        References
        ----------
        Singhose, Seering and Singer, Residual vibration reduction using vector
        diagrams to generate shaped inputs, ASME J. Mechanical Design 116, 1994.
        """
        return cls._of(ei_factor(frequency, damping, tolerance))

    @classmethod
    def two_hump_ei(cls, frequency: float, damping: float = 0.0, tolerance: float = 0.05) -> Self:
        """Two-hump extra-insensitive shaper of four impulses.

        The residual vibration is 0 at the mode and reaches the tolerance on both
        sides of it. The duration is one and a half periods.

        Parameters
        ----------
        frequency : float
            Undamped natural frequency [rad/s], above 0: 2 pi times that in Hz.
        damping : float, optional
            Damping ratio in [0, 1).
        tolerance : float, optional
            Height of the humps without damping, in (0, 1).

        Raises
        ------
        ValueError
            If an argument is out of range.

        References
        ----------
        Singhose, Porter, Tuttle and Singer, Vibration reduction using multi-hump
        input shapers, ASME J. Dynamic Systems, Measurement, and Control 119, 1997.
        """
        return cls._of(two_hump_factor(frequency, damping, tolerance))

    @classmethod
    def three_hump_ei(cls, frequency: float, damping: float = 0.0, tolerance: float = 0.05) -> Self:
        """Three-hump extra-insensitive shaper of five impulses.

        The residual vibration reaches the tolerance at an undamped mode and on
        both sides of it. The duration is two periods.

        Parameters
        ----------
        frequency : float
            Undamped natural frequency [rad/s], above 0: 2 pi times that in Hz.
        damping : float, optional
            Damping ratio in [0, 1).
        tolerance : float, optional
            Height of the humps without damping, in (0, 1).

        Raises
        ------
        ValueError
            If an argument is out of range.

        References
        ----------
        As for `two_hump_ei`.
        """
        return cls._of(three_hump_factor(frequency, damping, tolerance))

    @classmethod
    def fit(cls, frequencies: ArrayLike, response: ArrayLike, *, tolerance: float = 0.05, damping: float = 0.1) -> Self:
        r"""Shortest shaper for a measured spectrum.

        Of all kinds (ZV, MZV, ZVD, ZVDD, EI, two-hump and three-hump EI) the one of
        the shortest duration with

        .. math:: \max_i |G(\omega_i)|\,V(\omega_i) \le \varepsilon \max_i |G(\omega_i)|,

        V the residual vibration. No shaper attenuates frequencies far below the
        mode: the spectrum must be one of vibrations, such as that of a measured
        acceleration, without static part. Intervals of frequencies narrower than
        1e-7 of the frequency are not searched.

        Parameters
        ----------
        frequencies : array_like, shape (nfrequencies,)
            Frequencies of the spectrum [rad/s], above 0.
        response : array_like, shape (nfrequencies,)
            Magnitudes of the spectrum, at least 0, in any unit.
        tolerance : float, optional
            Largest vibration relative to that without a shaper, in (0, 1), also
            the tolerance of the EI shapers.
        damping : float, optional
            Damping ratio of the modes, in [0, 1).

        Raises
        ------
        ValueError
            If an argument is out of range, or no kind meets the tolerance.

        Examples
        --------
        >>> import numpy as np
        >>> omega = np.linspace(20.0, 120.0, 501)
        >>> spectrum = 1.0 / np.abs(60.0**2 - omega**2 + 6j * omega)
        >>> found = Shaper.fit(omega, spectrum)
        >>> bool((found.residual(omega, 0.1) * spectrum).max() <= 0.05 * spectrum.max())
        True
        """
        return cls._of(fitted_factor(frequencies, response, tolerance, damping))

    @property
    def duration(self) -> float:
        """Delay of the last impulse [s], added to a plan's duration."""
        return float(self.delays[-1])

    def __call__(self, plan: Trajectory) -> Trajectory:
        """Shaped reference.

        Parameters
        ----------
        plan : Trajectory
            Any reference, including a `Step`.

        Returns
        -------
        Trajectory
            From the plan's start and initial position to its final position,
            which it reaches `duration` after the plan's end. It can be shifted
            but not retimed, which would change the delays.

        Raises
        ------
        TypeError
            If `plan` is not a trajectory.
        ValueError
            If rounding of times far from 0 changes the delays by more than 1e-3 of
            the duration.

        Warns
        -----
        UserWarning
            If rounding changes the delays by more than 1e-6 of the duration.
        """
        check_kind(plan, "plan", Trajectory)
        parts = [plan.shift(delay) for delay in self.delays.tolist()]
        delayed = np.array([part.start for part in parts]) - plan.start
        loss = float((np.abs(delayed - self.delays) / (self.duration or 1.0)).max())
        if loss > 1e-6:
            said = (
                f"delays must be representable, got an error of {loss:.1g} of the shaper's duration by rounding of "
                f"times near {plan.start:.17g} s; use a time origin nearer to the plan"
            )
            if loss > 1e-3:
                raise ValueError(said)
            warnings.warn(said, stacklevel=2)
        weighted = [weight * part for part, weight in zip(parts, self.weights.tolist(), strict=True)]
        return combined(partial(Sum, shaped=True), weighted)

    def then(self, other: Shaper) -> Shaper:
        """Convolution of two shapers, for two modes."""
        check_kind(other, "other", Shaper)
        delays = np.add.outer(self.delays, other.delays).ravel()
        order = np.argsort(delays, kind="stable")
        delays, weights = delays[order], np.outer(self.weights, other.weights).ravel()[order]
        # Delays that differ by the rounding of sums are one impulse.
        first = np.flatnonzero(np.diff(delays, prepend=-1.0) > 8.0 * np.finfo(float).eps * delays[-1])
        joined = Shaper(delays[first], np.add.reduceat(weights, first))
        # An unknown part leaves the modes unknown.
        known = self.factors and other.factors
        return joined._with_fields(factors=self.factors + other.factors) if known else joined

    def on_grid(self, dt: float) -> Shaper:
        """Shaper with impulses at multiples of a controller's period.

        Each delay of the design is replaced by three impulses at 0, k dt and
        (k + 1) dt with the same effect on the mode, k dt <= delay < (k + 1) dt.
        Every design mode is left with the same vibration as by the shaper, zeros of
        any order remain, and no weight is negative. The duration grows by at most one
        period for each delay; `residual`, the vibration at the last impulse, is
        smaller by the decay of the mode over that time. In a shaper for several
        modes, parts with a tolerance (EI) change as the other parts do at their mode.

        Parameters
        ----------
        dt : float
            Period of the controller [s], at most the shortest delay: half a period
            of the mode (three eighths for MZV).

        Returns
        -------
        Shaper

        Raises
        ------
        ValueError
            If no mode is known, because the impulses were given, or `dt` is not
            above 0 or too long.

        Examples
        --------
        >>> shaper = Shaper.zv(2.0, 0.1).on_grid(0.1)
        >>> (shaper.delays / 0.1).round(12).tolist(), bool(shaper.residual(2.0, 0.1) < 1e-15)
        ([0.0, 15.0, 16.0], True)
        """
        period = checked_finite(dt, "dt", above=0.0)
        self._check_modes_known("on_grid")
        taps = reduce(np.convolve, [factor.on_grid(period) for factor in self.factors])
        kept = np.flatnonzero(taps)
        return Shaper(period * kept, taps[kept])._with_fields(factors=self.factors)

    def residual(self, frequency: ArrayLike, damping: ArrayLike = 0.0) -> Array:
        r"""Residual vibration of a mode, relative to that of one impulse.

        .. math:: V = e^{-\zeta\omega t_n}
            \left|\sum_i w_i\,e^{(\zeta + i\sqrt{1 - \zeta^2})\,\omega t_i}\right|

        The amplitude after the last impulse t_n, relative to the initial amplitude
        after one impulse of weight 1. As a function of frequency this is the
        sensitivity curve.

        Parameters
        ----------
        frequency : array_like
            Undamped natural frequencies [rad/s], at least 0.
        damping : array_like, optional
            Damping ratios in [0, 1); broadcasts with `frequency`.

        Returns
        -------
        ndarray, of the shape that both broadcast to
            Residual vibration: 1 is that of an undamped mode without a shaper.

        Raises
        ------
        ValueError
            If an argument is out of range.
        """
        omega, zeta = new_numbers(frequency, "frequency"), checked_damping(damping)
        if not np.all((omega >= 0.0) & (omega < math.inf)):
            raise ValueError(f"frequency must be at least 0 and finite, got {frequency!r}")
        return residual_of(self.delays, self.weights, omega, zeta)

    def plot(
        self, frequencies: ArrayLike, *, response: ArrayLike | None = None, ax: AxesLike | None = None
    ) -> ControlPlot:
        """Plot the residual vibration over frequency.

        The damping ratio is the lowest of the design modes, 0 if none is known;
        the design frequencies are marked.

        Parameters
        ----------
        frequencies : array_like, shape (nfrequencies,)
            Frequencies [rad/s], at least 0, increasing.
        response : array_like, shape (nfrequencies,), optional
            Magnitudes of a measured spectrum, drawn below, without the shaper and
            multiplied by its residual vibration.
        ax : Axes or array of Axes, optional
            Axes to plot in, two with `response`. Default: the current figure if it
            is empty, otherwise a new one.

        Returns
        -------
        control.ControlPlot
            With `figure`, `axes` and `lines`, of shape (1, 1) or (2, 1).

        Raises
        ------
        TypeError
            If `ax` is neither axes nor an array of them.
        ValueError
            If frequencies do not increase, or the response has another length.

        Examples
        --------
        >>> import numpy as np
        >>> from ctrlplan.trajectories import Shaper
        >>> drawn = Shaper.ei(10.0, 0.05).plot(np.linspace(0.0, 20.0, 201))
        >>> drawn.axes.shape
        (1, 1)
        """
        from ctrlplan.reports.vibration_figures import plot_shaper

        return plot_shaper(self, frequencies, response, ax=ax)

    @classmethod
    def _of(cls, factor: ShaperFactor) -> Self:
        """Shaper of one factor."""
        delays = factor.delay * np.arange(len(factor.weights))
        return cls(delays, factor.weights)._with_fields(factors=(factor,))

    def _check_modes_known(self, method: str) -> None:
        """Raise if the modes for which the shaper is designed are not known."""
        if not self.factors:
            raise ValueError(
                f"{method} must be called on a shaper whose modes are known, got one of given impulses; use Shaper.zv, "
                "zvd, mzv, ei, two_hump_ei, three_hump_ei or fit, joined by then"
            )

    def _describe(self) -> Iterator[Part]:
        yield f"Shaper of {counted(self.delays.size, 'impulse')} over {self.duration:g} s"
        modes = [(f.kind, f"{f.frequency:.6g} rad/s, damping {f.damping:g}") for f in self.factors]
        yield Facts([("added to the duration", f"{self.duration:.6g} s"), *modes])
        impulses = zip(self.delays.tolist(), self.weights.tolist(), strict=True)
        rows = [(str(k + 1), f"{delay:.6g}", number(weight)) for k, (delay, weight) in enumerate(impulses)]
        yield Table("Impulses", ("", "delay [s]", "weight"), shortened(rows))
