"""Input shaping: delayed copies of a reference whose residual vibrations cancel."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import comb

from ctrlplan._checks import check_kind, checked_count, checked_finite, finite_vector, new_numbers
from ctrlplan._display import Displayed, Facts, Part, Table, counted, number, shortened
from ctrlplan.trajectories.combined import Sum
from ctrlplan.trajectories.common import Array, readonly
from ctrlplan.trajectories.fields import Fields
from ctrlplan.trajectories.trajectory import Trajectory


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
        self._set_fields(delays=readonly(times), weights=readonly(parts / total))

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
        omega = checked_finite(frequency, "frequency", above=0.0)
        zeta, count = float(_checked_damping(damping)), checked_count(derivatives, "derivatives") + 1
        root = math.sqrt(1.0 - zeta**2)
        decay = math.exp(-zeta * math.pi / root)
        orders = np.arange(count + 1)
        weights = comb(count, orders) * decay**orders / (1.0 + decay) ** count
        return cls(orders * (math.pi / (omega * root)), weights)

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
        return Sum((weight * part for part, weight in zip(parts, self.weights.tolist(), strict=True)), shaped=True)

    def then(self, other: Shaper) -> Shaper:
        """Convolution of two shapers, for two modes."""
        check_kind(other, "other", Shaper)
        delays = np.add.outer(self.delays, other.delays).ravel()
        order = np.argsort(delays, kind="stable")
        delays, weights = delays[order], np.outer(self.weights, other.weights).ravel()[order]
        # Delays that differ by the rounding of sums are one impulse.
        first = np.flatnonzero(np.diff(delays, prepend=-1.0) > 8.0 * np.finfo(float).eps * delays[-1])
        return Shaper(delays[first], np.add.reduceat(weights, first))

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
        omega, zeta = new_numbers(frequency, "frequency"), _checked_damping(damping)
        if not np.all((omega >= 0.0) & (omega < math.inf)):
            raise ValueError(f"frequency must be at least 0 and finite, got {frequency!r}")
        mode = omega * (zeta + 1j * np.sqrt(1.0 - zeta**2))
        left: Array = np.abs(np.exp(mode[..., None] * (self.delays - self.delays[-1])) @ self.weights)
        return left

    def _describe(self) -> Iterator[Part]:
        yield f"Shaper of {counted(self.delays.size, 'impulse')} over {self.duration:g} s"
        yield Facts([("added to the duration", f"{self.duration:.6g} s")])
        impulses = zip(self.delays.tolist(), self.weights.tolist(), strict=True)
        rows = [(str(k + 1), f"{delay:.6g}", number(weight)) for k, (delay, weight) in enumerate(impulses)]
        yield Table("Impulses", ("", "delay [s]", "weight"), shortened(rows))


def _checked_damping(damping: ArrayLike) -> Array:
    """Damping ratios in [0, 1), checked."""
    zeta = new_numbers(damping, "damping")
    if not np.all((zeta >= 0.0) & (zeta < 1.0)):
        raise ValueError(f"damping must lie in [0, 1), got {damping!r}")
    return zeta
