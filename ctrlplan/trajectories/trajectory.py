"""The interface of every planned reference."""

from __future__ import annotations

import itertools
import math
import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._renamed import warn_renamed
from ctrlplan.trajectories import extrema as _extrema
from ctrlplan.trajectories import sampling as _sampling
from ctrlplan.trajectories.common import (
    FACTORIALS,
    Array,
    Frozen,
    checked_count,
    checked_time,
    checked_timepts,
    one_number,
    readonly,
)
from ctrlplan.trajectories.continuity import Jump, find_jumps

if TYPE_CHECKING:
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike
    from ctrlplan.trajectories.waypoint import Waypoint


class Trajectory(Frozen, ABC):
    """Function of time with exact derivatives.

    Between breakpoints it is analytic. Before the start it holds its first
    position, after the end its last, with every derivative zero there. At a
    breakpoint it takes the value and derivatives of what follows, at the end
    its own. A new kind sets `labels` and `breakpoints` and gives the jet of
    each of its legs; everything else is derived here.

    Attributes
    ----------
    labels : tuple of str
        Names of the axes: y, or y1, y2, ... unless given.
    breakpoints : ndarray, shape (nlegs + 1,)
        Times [s] of the start, of every join, and of the end.
    """

    labels: tuple[str, ...]
    breakpoints: Array
    waypoints: tuple[Waypoint, ...] = ()

    kinds: ClassVar[dict[str, type[Trajectory]]] = {}

    __array_ufunc__ = None  # numpy's numbers leave products to this class, and its arrays are no factors

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if not (cls.__name__.startswith("_") or getattr(cls._from_dict, "__isabstractmethod__", False)):
            Trajectory.kinds[cls.__name__] = cls

    @abstractmethod
    def _leg_jet(self, leg: int, s: Array, order: int) -> Array:
        """Jet (order + 1, naxes, ntime) of the analytic function that the leg is a part of.

        Times s are counted from the leg's own beginning: what a clock that
        started long ago has lost to rounding is lost once, in the subtraction.
        """

    @abstractmethod
    def _map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path with time t moved to target + (t - origin)/rate."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Plain data (numbers, strings, lists) that `trajectory_from_dict` reads."""

    @classmethod
    @abstractmethod
    def _from_dict(cls, data: dict[str, Any]) -> Trajectory:
        """Trajectory from the plain data of `to_dict`."""

    def _leg_series(self, leg: int, s: Any, order: int) -> list[list[Any]]:
        """Taylor series axis by axis of a leg at a symbol of a tracer."""
        raise TypeError(f"the time of a {type(self).__name__} must be a number, got {type(s).__name__}")

    @property
    def start(self) -> float:
        """Time of the first waypoint [s]."""
        return float(self.breakpoints[0])

    @property
    def end(self) -> float:
        """Time of the last waypoint [s]."""
        return float(self.breakpoints[-1])

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.end - self.start

    @property
    def naxes(self) -> int:
        """Number of axes."""
        return len(self.labels)

    @cached_property
    def initial(self) -> Array:
        """Position held before the start, shape (naxes,)."""
        return readonly(self._leg_jet(0, np.zeros(1), 0)[0, :, 0].copy())

    @cached_property
    def final(self) -> Array:
        """Position held after the end, shape (naxes,)."""
        return readonly(self._leg_jet(-1, self.breakpoints[-1:] - self.breakpoints[-2], 0)[0, :, 0].copy())

    def __call__(self, t: ArrayLike, nu: int = 0) -> Array:
        """Value, or the nu-th derivative.

        Parameters
        ----------
        t : array_like, any shape
            Times [s], in any order.
        nu : int, optional
            Order of the derivative.

        Returns
        -------
        ndarray, shape t.shape for one axis, (naxes, *t.shape) for more
            In units of the axis per s^nu.

        Raises
        ------
        ValueError
            If a time is nan or nu is negative.
        """
        times = checked_timepts(t)
        derivative = checked_count(nu, "nu")
        values = self._sample(times.ravel(), derivative, derivative, False)[0]
        return values.reshape(times.shape if self.naxes == 1 else (self.naxes, *times.shape))

    def jet(self, t: ArrayLike, order: int, left: bool = False) -> Array:
        """Value and derivatives up to an order.

        Parameters
        ----------
        t : array_like, any shape
            Times [s], in any order.
        order : int
            Highest derivative.
        left : bool, optional
            Take the limit from the left at breakpoints (an integrator that
            arrives at one needs it).

        Returns
        -------
        ndarray, shape (order + 1, naxes, *t.shape)

        Raises
        ------
        ValueError
            If a time is nan or the order is negative.
        """
        times = checked_timepts(t)
        highest = checked_count(order, "order")
        values = self._sample(times.ravel(), 0, highest, left)
        return values.reshape(highest + 1, self.naxes, *times.shape)

    def series(self, t: Any, order: int) -> list[list[Any]]:
        """Taylor series about one time, which may be a symbol of a tracer (CasADi's).

        Parameters
        ----------
        t : float or symbol
            Time [s].
        order : int
            Highest coefficient.

        Returns
        -------
        list of list, naxes by (order + 1)
            Coefficient k is the k-th derivative / k!.

        Raises
        ------
        TypeError
            If `t` is neither.
        """
        order = checked_count(order, "order")
        if isinstance(t, Real):
            return (self.jet(np.asarray(t), order).T / FACTORIALS[: order + 1]).tolist()
        if t is None or isinstance(t, str | complex | list | tuple | np.ndarray | np.datetime64 | np.bool_):
            raise TypeError(f"t must be one number or a symbol, got {t!r:.80}")
        # Each leg counts where it holds; elsewhere it is taken at its ends, where it is finite.
        found = [[value * (t < self.start), *[0.0] * order] for value in self.initial.tolist()]
        for leg, (left, right) in enumerate(itertools.pairwise(self.breakpoints.tolist())):
            holds = (t >= left) * (t < right)
            rows = self._leg_series(leg, np.fmin(np.fmax(t - left, 0.0), right - left), order)
            found = [[a + holds * b for a, b in zip(*pair, strict=True)] for pair in zip(found, rows, strict=True)]
        for row, value in zip(found, self.final.tolist(), strict=True):
            row[0] = row[0] + value * (t > self.end)
        last = (self.jet(self.end, order).T / FACTORIALS[: order + 1]).tolist()
        return [[a + (t == self.end) * b for a, b in zip(*pair, strict=True)] for pair in zip(found, last, strict=True)]

    def extrema(self, nu: int = 0) -> _extrema.Extrema:
        """Least and greatest value of the nu-th derivative, true over the whole interval.

        Where a derivative jumps at a join, both of its limits count.

        Parameters
        ----------
        nu : int, optional
            Order of the derivative.

        Returns
        -------
        Extrema
            minimum, maximum, time_min, time_max, each of shape (naxes,).
        """
        return _extrema.derivative_extrema(self, checked_count(nu, "nu"))

    def peak(self, nu: int = 0) -> Array:
        """Greatest magnitude of the nu-th derivative, shape (naxes,)."""
        found = self.extrema(nu)
        return np.maximum(np.abs(found.minimum), np.abs(found.maximum))

    def extrema_of(self, function: Callable[[Array], Array], order: int) -> _extrema.Extrema:
        """Minimum and maximum of a function of the jet.

        Both are right to 1e-9 of the largest magnitude of the function. Between
        breakpoints the function is interpolated by Chebyshev polynomials, whose
        stationary points are solved for. Pieces are bisected until interpolant
        and function agree at times that the interpolant was not made from;
        kinks and jumps are enclosed. The function is evaluated at 8192 times
        spread over the plan (of each of n segments at 8192/n and at 64 at least)
        before it is taken for smooth: what shows at none of them, such as a pulse shorter than their
        distance, is missed. `bounds` proves its result.

        Parameters
        ----------
        function : callable
            Maps a jet (order + 1, naxes, ntime) to (ntime,) or (m, ntime).
        order : int
            Highest derivative that it needs.

        Returns
        -------
        Extrema
            Each entry of shape (m,), m = 1 for a function with one value. The
            limits from both sides of a jump count.

        Raises
        ------
        ValueError
            If the function is not finite over the plan, or does not return one
            value for each time; if the plan has no duration.
        RuntimeError
            If the function is not resolved to 1e-9 within 20,000 pieces: it is
            noisy, or oscillates too fast. The message gives the size of what
            is left, and where.
        """
        return _extrema.function_extrema(self, function, checked_count(order, "order"))

    def bounds(
        self,
        function: Callable[[Array], Array],
        order: int,
        lipschitz: ArrayLike,
        rtol: float = 1e-3,
        max_cells: int = 1_000_000,
    ) -> _extrema.Bounds:
        """Certified bounds of a function of the jet.

        Cells of the interval are refined until the value at their centre minus
        a Lipschitz bound from the jet's own peaks decides: between `lower` and
        `upper` lies every value, not only every sample.

        Parameters
        ----------
        function : callable
            Maps a jet (order + 1, naxes, ntime) to (ntime,).
        order : int
            Highest derivative that it needs.
        lipschitz : array_like, broadcasts to (order + 1, naxes)
            Bounds of its partial derivatives over the jets of this plan.
        rtol : float, optional
            Gap allowed between a bound and an attained value, relative to the
            range of the function.
        max_cells : int, optional
            Cells at most.

        Returns
        -------
        Bounds
            lower, upper, and the attained minimum, maximum with their times.

        Raises
        ------
        ValueError
            If `rtol` is not reached with `max_cells` cells.
        """
        return _extrema.certified_bounds(self, function, checked_count(order, "order"), lipschitz, rtol, max_cells)

    def jumps(self, order: int) -> tuple[Jump, ...]:
        """Where derivatives up to an order jump, the ends at rest included.

        Parameters
        ----------
        order : int
            Highest derivative looked at.

        Returns
        -------
        tuple of Jump
            Each with order, time, label and size; lowest order first.
        """
        return find_jumps(self, checked_count(order, "order"))

    def retime(self, duration: float) -> Self:
        """Same path from the same start, in another duration [s].

        The nu-th derivative is multiplied by (old duration/new)^nu.

        Raises
        ------
        ValueError
            If the duration is not above 0, a derivative leaves floating point,
            or rounding changes an interval of the plan by more than 1e-3 of its
            length; above 1e-6 it warns.
        """
        if not self.duration:
            raise ValueError("a trajectory without duration cannot be retimed, got a step")
        wanted = checked_time(duration, "duration", positive=True)
        return self._moved(self.start, self.start, self.duration / wanted)

    def shift(self, dt: float) -> Self:
        """Same path, dt seconds later.

        Raises
        ------
        ValueError
            If the rounding of so late a time changes an interval of the plan by
            more than 1e-3 of its length; above 1e-6 it warns.
        """
        return self._moved(self.start, self.start + checked_time(dt, "dt"), 1.0)

    def then(self, other: Trajectory) -> Trajectory:
        """This trajectory, then the other from this one's end on.

        Raises
        ------
        ValueError
            If the other's first position differs from this one's last by more
            than 1e-9 of their range, or the axes differ in number.
        """
        from ctrlplan.trajectories.combined import Joined

        return Joined((self, other))

    def select(self, labels: Sequence[str]) -> Trajectory:
        """Some axes by name, in the order given."""
        from ctrlplan.trajectories.combined import Selected

        return Selected(self, (labels,) if isinstance(labels, str) else labels)

    def to_csv(self, path: str | os.PathLike[str], timepts: ArrayLike | None = None, order: int = 2) -> None:
        """Write times and jets as a table with one line of names."""
        from ctrlplan.trajectories.files import write_csv

        write_csv(self, path, timepts, order)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write as JSON, from which `load_trajectory` restores every bit."""
        from ctrlplan.trajectories.files import save_trajectory

        save_trajectory(self, path)

    def plot(
        self,
        derivatives: int = 2,
        *,
        ax: AxesLike | None = None,
        units: Sequence[str] | None = None,
        order: int | None = None,
    ) -> ControlPlot:
        """Position and derivatives stacked, waypoints marked.

        The figure is registered with pyplot, so that ``plt.show()`` shows it and
        ``plt.savefig`` writes it, and obeys the user's rcParams. To compare plans,
        draw the second in the axes of the first.

        Parameters
        ----------
        derivatives : int, optional
            Highest derivative drawn.
        ax : Axes or array of Axes, optional
            Where to draw: an array of n axes gets the derivatives 0 to n - 1, one
            axes the position only. None: an empty current figure, or a new one.
        units : sequence of str, optional
            Units of the plan's axes.
        order : int, optional
            Old name of `derivatives`.

        Returns
        -------
        control.ControlPlot
            With `figure`, `axes` and `lines`, both of shape (derivatives + 1, 1).

        Raises
        ------
        TypeError
            If `ax` is neither axes nor an array of them.
        ValueError
            If `ax` has not one axes for each of the `derivatives` stated.

        Examples
        --------
        >>> import ctrlplan as cp
        >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
        >>> drawn = cp.PolySpline(move).plot(1)
        >>> both = cp.TrigSpline(move, alpha=3.0).plot(ax=drawn.axes)
        >>> both.figure is drawn.figure, both.axes.shape
        (True, (2, 1))
        """
        from ctrlplan.reports.figures import plot_trajectory

        if order is not None:
            warn_renamed("order=", "derivatives=")
            derivatives = order
        return plot_trajectory(self, checked_count(derivatives, "derivatives"), ax=ax, units=units)

    def __add__(self, other: Trajectory) -> Trajectory:
        from ctrlplan.trajectories.combined import Sum

        return Sum((self, other)) if isinstance(other, Trajectory) else NotImplemented

    def __sub__(self, other: Trajectory) -> Trajectory:
        return self + (-1.0) * other if isinstance(other, Trajectory) else NotImplemented

    def __mul__(self, factor: float) -> Trajectory:
        from ctrlplan.trajectories.combined import Scaled

        return Scaled(self, factor) if _is_factor(factor) else NotImplemented

    __rmul__ = __mul__

    def __truediv__(self, factor: float) -> Trajectory:
        return self * (1.0 / one_number(factor, "factor")) if _is_factor(factor) else NotImplemented

    def __neg__(self) -> Trajectory:
        return self * -1.0

    def __repr__(self) -> str:
        axes = ", ".join(self.labels)
        when = f"from {self.start:g} s to {self.end:g} s" if self.duration else f"at {self.start:g} s"
        return f"<{type(self).__name__} of {axes} {when}>"

    def _moved(self, origin: float, target: float, rate: float) -> Self:
        """As `_map_time`, with what the rounding of times costs the intervals between them stated."""
        try:
            with np.errstate(over="raise", invalid="raise"):
                moved = self._map_time(origin, target, rate)
        except FloatingPointError as lost:
            raise ValueError(f"times must stay within floating point, got a rate of {rate:g}: {lost}") from None
        before, after = (np.union1d(p.breakpoints, [w.time for w in p.waypoints]) for p in (self, moved))
        if before.size < 2:
            return moved
        if before.size != after.size:  # a profile leaves out segments shorter than its clock resolves
            before, after = before[[0, -1]], after[[0, -1]]
        loss = float(np.abs(np.diff(after) * rate / np.diff(before) - 1.0).max())
        if loss > 1e-6:
            said = (
                f"times must keep the intervals of the plan, got a loss of {loss:.1g} of an interval by rounding "
                f"between {after[0]:.17g} s and {after[-1]:.17g} s; count time from an origin nearer to the plan"
            )
            if loss > 1e-3:
                raise ValueError(said)
            warnings.warn(said, stacklevel=3)
        return moved

    def _sample(self, t: Array, low: int, high: int, left: bool) -> Array:
        """Derivatives low to high, shape (high - low + 1, naxes, ntime)."""
        nlegs = self.breakpoints.size - 1
        if nlegs == 1 and not left and t.size and t.min() >= self.breakpoints[0] and t.max() <= self.breakpoints[1]:
            origin = self.breakpoints[0]
            return self._sample_leg(0, t - origin if origin else t, low, high)
        legs = np.searchsorted(self.breakpoints, t, side="left" if left else "right") - 1
        if nlegs and not left:
            legs[t == self.breakpoints[-1]] = nlegs - 1
        out = np.zeros((high - low + 1, self.naxes, t.size))
        in_order = bool(np.all(legs[1:] >= legs[:-1]))
        for leg in range(-1, nlegs + 1):
            where: slice | NDArray[np.intp]
            if in_order:
                begin, end = np.searchsorted(legs, [leg, leg + 1]).tolist()
                where = slice(begin, end)
            else:
                where = np.flatnonzero(legs == leg)
            if not t[where].size:
                continue
            if 0 <= leg < nlegs:
                out[:, :, where] = self._sample_leg(leg, t[where] - self.breakpoints[leg], low, high)
            elif low == 0:
                out[0][:, where] = (self.initial if leg < 0 else self.final)[:, None]
        return out

    def _sample_leg(self, leg: int, s: Array, low: int, high: int) -> Array:
        duration = float(self.breakpoints[leg + 1] - self.breakpoints[leg])
        if abs(math.log10(duration)) * high > 200.0:
            return self._extreme_jet(leg, s, low, high)
        with np.errstate(over="ignore", invalid="ignore"):
            if s.size <= _sampling.FEW:
                found = self._leg_jet(leg, s, high)[low:]
            else:
                found = _sampling.sample(lambda u, order: self._leg_jet(leg, u, order), duration, s, low, high)
            suspect = not np.isfinite(found.sum())
        if suspect:
            self._check_finite(found, leg, high)
        return found

    def _extreme_jet(self, leg: int, s: Array, low: int, high: int) -> Array:
        """Derivatives low to high of a segment whose duration, to the power of their order, leaves floating point."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = self._leg_jet(leg, s, high)[low:]
        self._check_finite(found, leg, high)
        return found

    def _check_finite(self, jet: Array, leg: int, high: int) -> None:
        if not np.isfinite(jet).all():
            duration = self.breakpoints[leg + 1] - self.breakpoints[leg]
            raise ValueError(
                f"derivative {high} must stay within floating point, got a duration of {duration:g} s and a position "
                f"of {np.abs(self._leg_jet(leg, np.zeros(1), 0)).max():g}"
            )

    def _jet_beside(self, moment: float, origin: float, s: Array, order: int) -> Array:
        """Jet at origin + s of the analytic function that holds at `moment`, which is no breakpoint."""
        leg = int(np.searchsorted(self.breakpoints, moment)) - 1
        if 0 <= leg < self.breakpoints.size - 1:
            return self._leg_jet(leg, s + (origin - self.breakpoints[leg]), order)
        held = np.zeros((order + 1, self.naxes, s.size))
        held[0] = (self.initial if leg < 0 else self.final)[:, None]
        return held

    def _series_beside(self, moment: float, origin: float, s: Any, order: int) -> list[list[Any]]:
        """The same as Taylor series, of numbers or of symbols."""
        leg = int(np.searchsorted(self.breakpoints, moment)) - 1
        if 0 <= leg < self.breakpoints.size - 1:
            return self._leg_series(leg, s + (origin - float(self.breakpoints[leg])), order)
        return [[value, *[0.0] * order] for value in (self.initial if leg < 0 else self.final).tolist()]


def _is_factor(value: object) -> bool:
    """Whether a plan may be multiplied by a value: numpy counts a time difference among the real numbers."""
    return isinstance(value, Real) and not isinstance(value, bool | np.timedelta64)
