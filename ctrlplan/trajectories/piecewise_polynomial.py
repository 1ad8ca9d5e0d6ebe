"""Piecewise polynomials given by their coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import MAXIMUM, checked_labels, new_numbers
from ctrlplan._types import Data, Value
from ctrlplan.trajectories.common import FACTORIALS, Array, mapped_time, times_powers
from ctrlplan.trajectories.motion_profile import shifted
from ctrlplan.trajectories.piecewise_extrema import Polynomials, Powers, stationary_places
from ctrlplan.trajectories.trajectory import Trajectory

_FEW, _MANY = 16, 1000
"""Number of segments up to which each is evaluated by itself, and number of times in each above which it is."""

_CHUNK = 4104
"""Number of times that are evaluated together."""


class PiecewisePolynomial(Trajectory):
    """Piecewise polynomial given by its coefficients.

    `ctrlplan.as_trajectory` returns it for the splines of scipy.

    Parameters
    ----------
    breakpoints : array_like, shape (nsegments + 1,)
        Times [s], strictly increasing.
    coefficients : array_like, shape (degree + 1, nsegments, naxes)
        Coefficients of the powers of the time since the start of each segment, the
        highest power first, as in `scipy.interpolate.PPoly`.
    labels : sequence of str, optional
        Names of the axes.
    deviation : array_like, shape (naxes,), optional
        Maximum deviation from the signals that the polynomials interpolate, as it
        was measured or estimated [unit of the axis]. Default: zeros.

    Attributes
    ----------
    coefficients, deviation : ndarray
        The arguments.

    Raises
    ------
    ValueError
        If shapes differ, a number is not finite, or times do not increase.

    Examples
    --------
    >>> parabola = PiecewisePolynomial([0.0, 2.0], [[[1.0]], [[0.0]], [[3.0]]])
    >>> parabola([0.0, 1.0, 2.0]), parabola(2.0, 1)
    (array([3., 4., 7.]), array(4.))
    """

    coefficients: Array
    deviation: Array
    _jets: Array  # (degree + 1, naxes, nsegments), at the start of each segment

    def __init__(
        self,
        breakpoints: ArrayLike,
        coefficients: ArrayLike,
        *,
        labels: Sequence[str] | str | None = None,
        deviation: ArrayLike | None = None,
    ) -> None:
        times, table = new_numbers(breakpoints, "breakpoints"), new_numbers(coefficients, "coefficients")
        if times.ndim != 1 or times.size < 2 or not (np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
            raise ValueError(
                f"breakpoints must be two or more finite times that increase strictly, got {times.tolist()!r:.200}"
            )
        if not float(times[-1]) - float(times[0]) < np.inf:
            raise ValueError(f"duration must be finite, got {times[-1]} s after {times[0]} s")
        if table.ndim != 3 or table.shape[1] != times.size - 1 or not table.size or len(table) > MAXIMUM + 1:
            raise ValueError(
                f"coefficients must have shape (degree + 1, {times.size - 1}, naxes) and a degree of at most "
                f"{MAXIMUM}, got shape {table.shape}"
            )
        if not np.isfinite(table).all():
            power, segment, axis = np.argwhere(~np.isfinite(table))[0].tolist()
            raise ValueError(
                f"coefficients must be finite, got {table[power, segment, axis]} for the power "
                f"{len(table) - 1 - power} of axis {axis} in the segment from {times[segment]:g} s"
            )
        naxes = table.shape[2]
        error = np.zeros(naxes) if deviation is None else new_numbers(deviation, "deviation")
        if error.shape != (naxes,) or not (error >= 0.0).all():
            raise ValueError(f"deviation must be {naxes} numbers of at least 0, one per axis, got {error.tolist()}")
        self._set_fields(
            breakpoints=times,
            coefficients=table,
            labels=checked_labels(labels, naxes),
            deviation=error,
            _jets=table[::-1].transpose(0, 2, 1) * FACTORIALS[: len(table), None, None],
        )

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {
            "type": "PiecewisePolynomial",
            **{name: getattr(self, name).tolist() for name in ("breakpoints", "coefficients", "deviation")},
            "labels": list(self.labels),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        return cls(data["breakpoints"], data["coefficients"], labels=data["labels"], deviation=data["deviation"])

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        times = [mapped_time(time, origin, target, rate) for time in self.breakpoints.tolist()]
        orders = np.arange(len(self.coefficients))[::-1, None, None]
        moved = times_powers(self.coefficients, rate, orders)
        return type(self)(times, moved, labels=self.labels, deviation=self.deviation)

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        found = np.zeros((order + 1, self.naxes, s.size))
        rows = shifted(self._jets[:, :, segment, None], s, order)
        found[: len(rows)] = rows
        return found

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        last = self.breakpoints.size - 2
        segments = np.searchsorted(self.breakpoints, t, side="left" if left else "right") - 1
        if not left:
            segments[t == self.breakpoints[-1]] = last
        touched = int(np.count_nonzero(np.diff(segments))) + 1
        if touched <= _FEW or t.size > _MANY * touched:
            return super()._sample(t, low, high, left)
        before, after = segments < 0, segments > last
        out = np.empty((high - low + 1, self.naxes, t.size))
        with np.errstate(over="ignore", invalid="ignore"):
            for begin in range(0, t.size, _CHUNK):
                part = slice(begin, begin + _CHUNK)
                own = np.clip(segments[part], 0, last)
                out[:, :, part] = self.segments_jet(own, t[part] - self.breakpoints[own], high)[low:]
        for outside, held in ((before, self.initial), (after, self.final)):
            if outside.any():
                out[:, :, outside] = 0.0
                if low == 0:
                    out[0][:, outside] = held[:, None]
        return out if np.isfinite(out.sum()) else super()._sample(t, low, high, left)

    @property
    def polynomial_degree(self) -> int:
        """Maximum degree of the segments; as `Trajectory.polynomial_degree`."""
        return len(self._jets) - 1

    def stationary_places(self, nu: int) -> tuple[NDArray[np.intp], Array] | None:
        """Places of the stationary points; as `Trajectory.stationary_places`."""
        durations, size = np.diff(self.breakpoints), len(self._jets)
        with np.errstate(over="ignore", invalid="ignore", under="ignore"):
            powers = (durations ** np.arange(size)[:, None])[:, None] / FACTORIALS[:size, None, None]
            own = Polynomials(Powers(size), 0, self._jets * powers)
        return stationary_places([[own]], durations, nu)

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        found = np.zeros((order + 1, self.naxes, s.size))
        for row, values in zip(found, shifted(self._jets[:, :, segments], s, order), strict=False):
            row[:] = values
        return found

    def segment_series(self, segment: int, s: Value, order: int) -> list[list[Value]]:
        """Taylor series of a segment; as `Trajectory.segment_series`."""
        found = []
        for jet in self._jets[:, :, segment].T.tolist():
            rows: list[Value] = [value / FACTORIALS[k] for k, value in enumerate(shifted(jet, s))]
            found.append([*rows, *[0.0] * order][: order + 1])
        return found

    def _facts(self) -> list[tuple[str, str]]:
        known = [(f"deviation of {name}", f"{e:.3g}") for name, e in zip(self.labels, self.deviation, strict=True) if e]
        return [*super()._facts(), *known]
