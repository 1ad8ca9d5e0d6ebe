"""The trigonometric spline of equation (2)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np

from ctrlplan._checks import checked_finite, one_number
from ctrlplan._types import Data
from ctrlplan.trajectories.chosen import chosen_alpha
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.newton import NewtonSystem
from ctrlplan.trajectories.newton_spline import NewtonSpline, SplineOptions, checked_degree
from ctrlplan.trajectories.waypoint import Waypoint
from ctrlplan.trajectories.waypoint_spline import checked_waypoints


class TrigSpline(NewtonSpline):
    r"""Trigonometric spline through waypoints.

    .. math::
        y = a_0 + \sum_{k=1}^{m-1} (a_k \cos k\tau + b_k \sin k\tau)
            + a_m \sin m(\tau - \gamma), \quad \tau = \alpha (t - t_1)/(t_n - t_1)

    Equation (2) for an even number 2m of constraints per axis, with gamma the
    mean of their abscissae; for an odd number 2m + 1 the full trigonometric
    polynomial of degree m. It is computed in the Newton form of
    `ctrlplan.trajectories.newton`, not by solving (3).

    Parameters
    ----------
    waypoints : iterable of Waypoint
        Two or more, times increasing; the free entries may differ between axes.
    alpha : float or "auto"
        Shape parameter in [0, 2 pi) [rad]; 0 gives the polynomial spline, "auto"
        the shortest path (see `ctrlplan.choose_alpha` for other objectives).
    gamma : float or sequence of float or None, optional
        Phase of the top harmonic [rad of tau], for all axes or one per axis
        (None for the mean). Requires an even number of coefficients.
    labels : sequence of str, optional
        Names of the axes.
    degree : int, optional
        Degree m, at least the default that the constraints require. The
        additional coefficients minimise the integral of the squared derivative
        of order `smooth`.
    smooth : int, optional
        Order of that derivative; default 3 (jerk).
    warn : bool, optional
        Whether to warn if the range of the plan on any axis exceeds 3 times that
        of its waypoints (their positions, and the extrapolation of their
        derivatives over half a segment).

    Raises
    ------
    ValueError
        If alpha is outside [0, 2 pi), times do not increase, axes differ, the
        free entries or gamma make the system singular, or the degree is too low;
        if rounding could change the plan by more than 1e-6 of its range, as near
        alpha = 2 pi, where both ends nearly coincide on the circle.

    Warns
    -----
    UserWarning
        If the plan swings far beyond its waypoints (`warn`).

    Examples
    --------
    >>> plan = TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)], alpha=1.0)
    >>> round(float(plan(0.5)), 12), plan.degree, round(plan.gamma[0], 12)
    (0.5, (3,), 0.5)
    """

    family = "trigonometric"
    options = ("alpha", "gamma", "degree", "smooth")

    def __init__(
        self,
        waypoints: Iterable[Waypoint],
        *,
        alpha: float | Literal["auto"],
        gamma: float | Sequence[float | None] | None = None,
        labels: Sequence[str] | None = None,
        degree: int | None = None,
        smooth: int = 3,
        warn: bool = True,
    ) -> None:
        points = checked_waypoints(waypoints)
        chosen = SplineOptions(
            labels, _checked_gamma(gamma, points[0].naxes), *checked_degree(degree, smooth), warn=warn
        )
        options = chosen.given() if isinstance(alpha, str) else {}
        if not self._fit(points, chosen_alpha(alpha, points, type(self), **options), chosen):
            self._check_swing()

    @classmethod
    def cyclic(
        cls,
        waypoints: Iterable[Waypoint],
        period: float,
        *,
        gamma: float | Sequence[float | None] | None = None,
        labels: Sequence[str] | None = None,
        degree: int | None = None,
        smooth: int = 3,
        warn: bool = True,
    ) -> Self:
        """Periodic plan with alpha = 2 pi (remark 2 of the paper).

        The plan starts at the first waypoint, lasts one period and ends with the
        initial position and derivatives of all orders. `then` appends further
        periods.

        Parameters
        ----------
        waypoints : iterable of Waypoint
            One or more, all within one period, without the return to the first.
        period : float
            Period [s].
        gamma, labels, degree, smooth, warn
            As for `TrigSpline`.

        Raises
        ------
        ValueError
            If the waypoints do not fit into one period; otherwise as `TrigSpline`.
        """
        points = checked_waypoints(waypoints, minimum=1)
        duration = checked_finite(period, "period", above=0.0)
        chosen = SplineOptions(
            labels, _checked_gamma(gamma, points[0].naxes), *checked_degree(degree, smooth), duration, warn
        )
        plan = cls.__new__(cls)
        if not plan._fit(points, 2.0 * math.pi, chosen):
            plan._check_swing()
        return plan

    @property
    def gamma(self) -> tuple[float | None, ...]:
        """Phase of the top harmonic of each axis [rad of tau], or None."""
        return tuple(s.gamma for s, _ in self._per_axis())

    def fourier(self) -> FourierCoefficients:
        """Coefficients a0, a_k, b_k, a_m of equation (2).

        For comparison with the paper. At small alpha the coefficients are large
        and cancel, so the plan itself is not evaluated from them.

        Raises
        ------
        ValueError
            If alpha is 0, as a polynomial has none, or so small that they overflow.
        """
        if not self.alpha:
            raise ValueError("alpha must be above 0 for Fourier coefficients, got 0 (a polynomial)")
        with np.errstate(over="ignore", invalid="ignore"):
            found = FourierCoefficients.of([_fourier(self.alpha, s, c) for s, c in self._per_axis()])
        if not all(np.isfinite(values).all() for values in (found.a0, found.a, found.b, found.am)):
            raise ValueError(f"alpha must be large enough for finite Fourier coefficients, got {self.alpha:g}")
        return found

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return super().to_dict() | {"alpha": self.alpha}

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        points = [Waypoint.from_dict(w) for w in data["waypoints"]]
        chosen = {k: data[k] for k in ("gamma", "labels", "degree", "smooth") if k in data}
        if "period" in data:
            return cls.cyclic(points, data["period"], warn=False, **chosen)._loaded()
        return cls(points, alpha=data["alpha"], warn=False, **chosen)._loaded()


AxisCoefficients = tuple[float, Array, Array, float, int, float]
"""a0, a, b, am, m and gamma of one axis."""


@dataclass(frozen=True)
class FourierCoefficients:
    """Fourier coefficients of equation (2), axis first.

    Indexing by an axis gives the coefficients of that axis, a0 and am as scalars.

    Attributes
    ----------
    a0 : ndarray, shape (naxes,)
        Constant.
    a, b : ndarray, shape (naxes, nharmonics)
        Cosine and sine coefficients of harmonics 1, 2, ...: up to m - 1 if
        the top one is sin m(tau - gamma), up to m for an odd number of
        constraints. Padded with zeros for axes with fewer.
    am : ndarray, shape (naxes,)
        Coefficient of sin m(tau - gamma), 0 if there is none.
    m : ndarray of int, shape (naxes,)
        Degree.
    gamma : ndarray, shape (naxes,)
        Phase [rad of tau], nan if there is none.
    """

    a0: Array
    a: Array
    b: Array
    am: Array
    m: np.ndarray[Any, np.dtype[np.intp]]
    gamma: Array

    @classmethod
    def of(cls, axes: list[AxisCoefficients]) -> FourierCoefficients:
        """Coefficients of several axes, padded to the longest."""
        longest = max(len(a) for _, a, _, _, _, _ in axes)
        a, b = np.zeros((2, len(axes), longest))
        for i, (_, cosines, sines, _, _, _) in enumerate(axes):
            a[i, : len(cosines)], b[i, : len(sines)] = cosines, sines
        a0, _, _, am, m, gamma = zip(*axes, strict=True)
        return cls(np.array(a0), a, b, np.array(am), np.array(m, dtype=np.intp), np.array(gamma))

    def __len__(self) -> int:
        return len(self.a0)

    def __getitem__(self, axis: int) -> FourierCoefficients:
        return FourierCoefficients(*(getattr(self, name)[axis] for name in self.__dataclass_fields__))

    def __iter__(self) -> Iterator[FourierCoefficients]:
        return (self[axis] for axis in range(len(self)))


def _checked_gamma(gamma: float | Sequence[float | None] | None, naxes: int) -> float | list[float | None] | None:
    """One phase for all axes, or one per axis, as floats."""
    if gamma is None:
        return None
    if np.ma.is_masked(gamma):
        raise TypeError(f"gamma must be a number, or one per axis, got {gamma!r:.80}")
    given: Any = np.asarray(gamma, dtype=object)
    values = [None if v is None else one_number(v, "gamma", "a number, or one per axis") for v in given.ravel()]
    for value in values:
        if value is not None and not math.isfinite(value):
            raise ValueError(f"gamma must be finite, got {value}")
    if not given.ndim:
        return values[0]
    if len(values) != naxes:
        raise ValueError(f"gamma must be one number or one per axis, {naxes}, got {len(values)}")
    return values


def _fourier(alpha: float, system: NewtonSystem, coefficients: Array) -> AxisCoefficients:
    """Fourier coefficients by the discrete transform of exact values over one turn."""
    m = system.size // 2
    count = 2 * m + 2
    turn = 2.0 * np.pi * np.arange(count) / count
    spectrum = np.fft.rfft(coefficients @ system.taylor(turn / alpha, 0)[:, 0]) / count
    cosines, sines = 2.0 * spectrum.real[1 : m + 1], -2.0 * spectrum.imag[1 : m + 1]
    if system.gamma is None:
        return float(spectrum[0].real), cosines, sines, 0.0, m, math.nan
    phase = m * system.gamma
    top = float(sines[m - 1] * math.cos(phase) - cosines[m - 1] * math.sin(phase))
    return float(spectrum[0].real), cosines[: m - 1], sines[: m - 1], top, m, system.gamma
