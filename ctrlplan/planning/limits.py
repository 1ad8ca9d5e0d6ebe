"""What must hold along a plan: limits on derivatives, and on whatever a flat plant makes of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from ctrlplan._checks import checked_limits, real_array
from ctrlplan._display import Displayed, Part, Table, counted
from ctrlplan.planning.quantities import Quantities, System, quantities_of, system_given
from ctrlplan.trajectories import Trajectory, derivative_name
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.extrema import function_extrema
from ctrlplan.trajectories.waypoint import ENTRIES

if TYPE_CHECKING:
    import pandas as pd

_SAMPLES = 193
_HIGHEST = 8
"""Derivatives up to which limits are looked for."""


@dataclass(frozen=True)
class Limits:
    """Limits of one signal, for `fastest` and `margins`.

    A number above 0 is the short form of limits of the magnitude, ``Limits(-5.0,
    5.0)``; a pair is that of both sides, with None where there is none.

    Parameters
    ----------
    low, high : float, optional
        Minimum and maximum, in the unit of the signal; None or an infinite one
        where there is none.

    Raises
    ------
    ValueError
        If neither is finite, one is nan, or `high` is not above `low`.
    TypeError
        If one is not a number.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)])
    >>> cp.margins(move, {"y_d1": cp.Limits(high=1.0)})
    <Margins of 1 limit: y_d1 at most 1: 0.9375 at 1 s, 0.0625 left>
    """

    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        self._check("Limits")

    @classmethod
    def of(cls, limit: object, name: str) -> Limits:
        """Limits from themselves or from a short form.

        Parameters
        ----------
        limit : Limits, float or (float, float)
            What was given.
        name : str
            Signal, for messages.

        Raises
        ------
        ValueError, TypeError
            As the constructor; if a lone number is not above 0 and finite.
        """
        if isinstance(limit, Limits):
            return limit
        if _is_listed(limit):
            if len(limit) != 2:
                raise ValueError(f"limits of {name} must be a number or a pair, got {limit!r}")
            found = cls.__new__(cls)
            for side, value in zip(("low", "high"), limit, strict=True):
                object.__setattr__(found, side, value)
            found._check(f"limits of {name}")
            return found
        if isinstance(limit, bool) or not isinstance(limit, Real | np.ndarray):
            raise TypeError(f"limits of {name} must be a number or a pair, got {limit!r}")
        magnitude = float(real_array(np.asarray(limit), f"limits of {name}"))
        if not 0.0 < magnitude < math.inf:
            raise ValueError(f"limits must be above 0 and finite, got {name} = {magnitude:g}")
        return cls(-magnitude, magnitude)

    def _check(self, name: str) -> None:
        """Make the sides numbers, once they are found to be limits; messages call them by a name."""
        low, high, _ = checked_limits(self._sides(), name)
        object.__setattr__(self, "low", None if math.isinf(low) else low)
        object.__setattr__(self, "high", None if math.isinf(high) else high)

    def _sides(self) -> tuple[float, float]:
        return -math.inf if self.low is None else self.low, math.inf if self.high is None else self.high

    def bound(self, name: str, order: int, axis: int | None) -> Bound:
        """Limits of a signal that is made of derivatives up to an order."""
        low, high, scale = checked_limits(self._sides(), f"limits of {name}")
        return Bound(name, low, high, scale, order, axis)


@dataclass(frozen=True)
class Bound:
    """Limits of one signal of a plan.

    Attributes
    ----------
    name : str
        Derivative of an axis (x_d1), or a quantity of the plant.
    low, high : float
        Between which it must stay; one may be infinite.
    scale : float
        What margins are fractions of: half their distance, or the size of the
        only one.
    order : int
        Highest derivative that the signal is made of.
    axis : int or None
        Axis of a derivative; None for a quantity.
    slack : float
        What rounding may add to the excess: above 0 where the limit is touched at
        rest, so that no duration can keep away from it.
    """

    name: str
    low: float
    high: float
    scale: float
    order: int
    axis: int | None = None
    slack: float = 0.0

    def excess(self, values: Array) -> Array:
        """By how much values are beyond the limits, as a fraction of the scale; negative inside."""
        return np.maximum(values - self.high, self.low - values) / self.scale - self.slack

    @property
    def range(self) -> str:
        """The limits in words."""
        return _range(self.low, self.high)


def limit_words(limit: object) -> str:
    """A limit in words, in any of the forms that `margins` accepts; of several axes one after the other."""
    if isinstance(limit, Limits):
        return _range(*limit._sides())
    given = np.array(limit, dtype=object)
    if given.ndim == 0:
        return _range(-float(given), float(given))
    if isinstance(limit, tuple) and given.shape == (2,):
        low, high = (side if value is None else float(value) for value, side in zip(limit, _NO_SIDES, strict=True))
        return _range(low, high)
    return "; ".join(limit_words(tuple(row) if np.ndim(row) else row) for row in given)


_NO_SIDES = (-math.inf, math.inf)


def _range(low: float, high: float) -> str:
    if math.isinf(low):
        return f"at most {high:g}"
    if math.isinf(high):
        return f"at least {low:g}"
    return f"within ±{high:g}" if low == -high else f"from {low:g} to {high:g}"


@dataclass(frozen=True)
class Margin:
    """How near a signal comes to its limits over a whole plan.

    Attributes
    ----------
    bound : Bound
        The limits.
    value, time : float
        Where it comes nearest, or is farthest beyond, and when [s].
    fraction : float
        Distance left there as a fraction of the bound's scale; negative where
        the limit does not hold.
    """

    bound: Bound
    value: float
    time: float
    fraction: float

    def __str__(self) -> str:
        return f"{self.bound.name} {self.bound.range}: {self.value:.6g} at {self.time:.6g} s, {self.room}"

    @property
    def room(self) -> str:
        """What is left of the room inside the limits, or by how much they are broken."""
        return f"{self.share} {'left' if self.fraction >= 0.0 else 'beyond'}"

    @property
    def share(self) -> str:
        """Margin in words: in percent, or as it is where the limit is a lone 0."""
        size = abs(self.fraction)
        if size < 1e-9:
            return "nothing"
        lone_zero = math.isinf(self.bound.high - self.bound.low) and self.bound.scale == 1.0
        return f"{size:.4g}" if lone_zero else f"{100.0 * size:.3g} %"


@dataclass(frozen=True, repr=False)
class Margins(Displayed):
    """Margins of all limits over a whole plan, the smallest first.

    Attributes
    ----------
    rows : tuple of Margin
        One a limit.
    """

    rows: tuple[Margin, ...]

    @property
    def active(self) -> Margin:
        """The smallest margin: the limit that holds the plan back, or is broken."""
        return self.rows[0]

    @property
    def hold(self) -> bool:
        """Whether every limit holds over the whole plan."""
        return self.active.fraction >= 0.0

    def __iter__(self) -> Iterator[Margin]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def _describe(self) -> Iterator[Part]:
        yield f"Margins of {counted(len(self), 'limit')}: {self.active}"
        yield self.table()

    def table(self) -> Table:
        """Table with a row a limit, as print shows it."""
        rows = [
            (
                row.bound.name,
                row.bound.range,
                f"{row.value:.6g}",
                f"{row.time:.6g}",
                row.share if row.fraction >= 0.0 or row.share == "nothing" else f"-{row.share}",
            )
            for row in self.rows
        ]
        return Table(
            "Margins over the whole plan, the smallest first", ("signal", "limits", "value", "time [s]", "margin"), rows
        )

    def to_pandas(self) -> pd.DataFrame:
        """Table with a row a limit: low, high, value, time, margin."""
        import pandas as pd

        table = {
            row.bound.name: {
                "low": row.bound.low,
                "high": row.bound.high,
                "value": row.value,
                "time": row.time,
                "margin": row.fraction,
            }
            for row in self.rows
        }
        return pd.DataFrame(table).T.rename_axis(index="limit")


def margins(
    plan: Trajectory, limits: Mapping[str, object], system: System | None = None, *, quantities: System | None = None
) -> Margins:
    """How near a plan comes to limits, over its whole interval.

    Parameters
    ----------
    plan : Trajectory
        Of any duration above 0.
    limits : mapping of str to float, (float, float), Limits or array_like
        By the name of a derivative (x, x_d1, x_d2, ...) or of a quantity: a
        number above 0 for a magnitude, or minimum and maximum, None where there
        is none; or `Limits`. By velocity, acceleration, jerk or snap for those of every
        axis: a number, or a tuple (minimum, maximum), for all axes; a list or
        array of naxes numbers, or of shape (naxes, 2), by axis. A derivative
        must be allowed to be 0.
    system : flat system, Crane or callable, optional
        Whose quantities are limited by name: a `control.flatsys.FlatSystem`
        (states and inputs), a `Crane`, any plant with a method ``quantities``,
        or a function that maps a jet (order + 1, naxes, ntime) to a mapping of
        names to signals (ntime,). What the plan does not determine at rest
        (heading and steering angle of a car) is nan there and rejected.
    quantities : optional
        Old name of `system`, with a FutureWarning.

    Returns
    -------
    Margins
        From the extrema of derivatives, which are exact to rounding, and from
        those of quantities by `Trajectory.extrema_of`, to 1e-9 of the larger of
        magnitude and limit.

    Raises
    ------
    ValueError
        If a limit is not positive or does not increase, a name is unknown, or
        a derivative jumps that a limited signal is the derivative of.
    RuntimeError
        If a quantity is not resolved, since it is noisy or oscillates.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)])
    >>> cp.margins(move, {"y_d1": 1.0})
    <Margins of 1 limit: y_d1 within ±1: 0.9375 at 1 s, 6.25 % left>
    """
    limited = Limited(plan, limits, system_given(system, quantities))
    limited.check_smooth(plan)
    return limited.margins(plan)


class UndeterminedError(ValueError):
    """A signal that the plan does not determine: the plant's maps are singular on it."""


class Limited:
    """Limits of a kind of plan, ready to be looked at for many plans of that kind.

    Parameters are those of `margins`; the plan stands for others of its axes.
    """

    def __init__(self, plan: Trajectory, limits: Mapping[str, object], system: System | None = None) -> None:
        if not isinstance(plan, Trajectory):
            raise TypeError(f"plan must be a Trajectory (the attribute plan of what was chosen), got {plan!r:.60}")
        if not plan.duration:
            raise ValueError("a plan that is limited must have a duration, got a step")
        if not isinstance(limits, Mapping):
            raise TypeError(f"limits must be a mapping of names to limits, got {type(limits).__name__}")
        self._quantities = quantities_of(system)
        self.bounds = tuple(self._bounds(plan, limits))
        if not self.bounds:
            raise ValueError("limits must name at least one signal, got none")
        self.order = max(bound.order for bound in self.bounds)
        self.derivatives_only = all(bound.axis is not None for bound in self.bounds)
        self.bounds = tuple(self._slackened(plan))

    def sampled(self, plan: Trajectory) -> Array:
        """Jet (order + 1, naxes, ntime) at samples of every segment, its ends included."""
        edges, inside = plan.breakpoints, np.linspace(0.0, 1.0, _SAMPLES)[1:-1]
        times = (edges[:-1, None] + np.diff(edges)[:, None] * inside).ravel()
        return np.concatenate(
            [plan.jet(edges[1:], self.order, left=True), plan.jet(edges[:-1], self.order), plan.jet(times, self.order)],
            axis=2,
        )

    def values(self, jet: Array) -> Array:
        """Limited signals (nbounds, ntime) of a jet (order + 1, naxes, ntime)."""
        rows = self._rows(jet)
        if not jet[1:].any():  # infinitely slow, so that nothing is said of plans that move
            return rows
        for row, b in zip(rows, self.bounds, strict=True):
            if np.isnan(row).any():
                still = not jet[1:, :, int(np.isnan(row).argmax())].any()
                raise UndeterminedError(
                    f"{b.name} must be determined by the plan, got nan{' where the plan is at rest' if still else ''}: "
                    "the maps of the plant are singular there, as those of a car are at rest; limit it along plans "
                    "that keep moving, by margins, or limit what is determined"
                )
        return rows

    def _rows(self, jet: Array) -> Array:
        """The same with nan where the plan does not determine a signal."""
        found = {} if self.derivatives_only or self._quantities is None else self._quantities(jet)
        rows = np.empty((len(self.bounds), jet.shape[2]))
        for row, b in zip(rows, self.bounds, strict=True):
            row[:] = jet[b.order, b.axis] if b.axis is not None else _signal(b.name, found[b.name], row.shape)
        return rows

    def excess(self, jet: Array) -> float:
        """Greatest excess over a sampled jet, inf where the plant cannot follow at all."""
        try:
            values = self.values(jet)
        except ValueError:  # the plant cannot follow: a rope that would have to push
            return math.inf
        worst = max(float(b.excess(row).max()) for b, row in zip(self.bounds, values, strict=True))
        return math.inf if math.isnan(worst) else worst

    def rejection(self, plan: Trajectory) -> str:
        """Why the plant cannot follow a plan, empty where it can."""
        try:
            self.values(self.sampled(plan))
        except ValueError as rejection:
            return str(rejection)
        return ""

    def exact_excess(self, plan: Trajectory) -> float:
        """Greatest excess over a whole plan."""
        try:
            return -self.margins(plan).active.fraction
        except ValueError:
            return math.inf

    def margins(self, plan: Trajectory) -> Margins:
        """Margins over a whole plan."""
        derived = [(b, b.axis) for b in self.bounds if b.axis is not None]
        extrema = {order: plan.extrema(order) for order in {b.order for b, _ in derived}}
        rows = [
            _margin(b, e.minimum[axis], e.maximum[axis], e.time_min[axis], e.time_max[axis])
            for b, axis in derived
            for e in [extrema[b.order]]
        ]
        others = [k for k, b in enumerate(self.bounds) if b.axis is None]
        if others:
            scales = [self.bounds[k].scale for k in others]  # a quantity of 0 is not resolved to its rounding
            found = function_extrema(plan, lambda jet: self.values(jet)[others], self.order, scales)
            columns = zip(found.minimum, found.maximum, found.time_min, found.time_max, strict=True)
            rows += [_margin(self.bounds[k], *column) for k, column in zip(others, columns, strict=True)]
        return Margins(tuple(sorted(rows, key=lambda row: row.fraction)))

    def check_smooth(self, plan: Trajectory) -> None:
        """Refuse a plan of which a derivative jumps where a limited signal would be infinite.

        Rest before the start and after the end counts, except where the plan
        has speed there: it is the continuation of a motion.
        """
        moving = {t for t in (plan.start, plan.end) if plan.jet(t, 1, left=t > plan.start)[1].any()}
        for bound in self.bounds:
            for jump in plan.jumps(bound.order - 1) if bound.order else ():
                if jump.time not in moving and (bound.axis is None or plan.labels[bound.axis] == jump.label):
                    what = "position" if jump.order == 0 else derivative_name(jump.label, jump.order)
                    raise ValueError(
                        f"{bound.name} is limited, which needs a plan continuous up to derivative {bound.order - 1} "
                        f"(rest before and after counts), got {what} that jumps by {jump.size:.4g} at {jump.time:g} s"
                    )

    def at_rest(self, plan: Trajectory) -> Array:
        """Jet at samples of a plan that is infinitely slow."""
        return self.sampled(plan) * (np.arange(self.order + 1) == 0)[:, None, None]

    def _slackened(self, plan: Trajectory) -> Iterator[Bound]:
        """The bounds, with slack where they are touched at rest."""
        try:
            self.values(self.sampled(plan))
        except UndeterminedError:  # as it is at any other duration
            raise
        except ValueError:  # what the plant cannot follow, it may follow more slowly
            pass
        for bound, values in zip(self.bounds, self.values(self.at_rest(plan)), strict=True):
            if np.isnan(values).any():  # what is singular at rest touches nothing there
                yield replace(bound, slack=0.0)
                continue
            rounding = 1e-12 * (1.0 + float(np.abs(values).max()) / bound.scale)
            touched = abs(float(bound.excess(values).max())) <= rounding
            yield replace(bound, slack=rounding if touched else 0.0)

    def _bounds(self, plan: Trajectory, limits: Mapping[str, object]) -> Iterator[Bound]:
        derivatives = {
            derivative_name(label, k): (k, axis) for k in range(_HIGHEST + 1) for axis, label in enumerate(plan.labels)
        }
        orders: dict[str, int] | None = None
        for name, limit in limits.items():
            if name in derivatives:
                yield _bound(name, limit, *derivatives[name])
                continue
            if orders is None:
                orders = {} if self._quantities is None else _orders(self._quantities, plan)
            if name in orders:
                yield _bound(name, limit, orders[name], None)
            elif name in ENTRIES:
                order = ENTRIES.index(name)
                for axis, own in enumerate(_by_axis(name, limit, plan.naxes)):
                    named = derivative_name(plan.labels[axis], order)
                    yield replace(_bound(name, own, order, axis), name=named)
            else:
                plain = [quantity for quantity in orders if "_d" not in quantity]
                known = f", or quantities ({', '.join(plain)}, ...)" if orders else "; a system was not given"
                axes = ", ".join(derivative_name(label, 1) for label in plan.labels)
                raise ValueError(
                    f"limits must name derivatives of the axes ({axes}, ...), velocity, acceleration, jerk or snap of "
                    f"them all{known}, got {name!r}"
                )


_FORMS = "a tuple (minimum, maximum) holds for every axis, a list of one number an axis gives magnitudes"


def _by_axis(name: str, limit: object, naxes: int) -> list[object]:
    """Limits of each axis, from those of all of them."""
    if isinstance(limit, str | Mapping) or not np.iterable(limit):
        return [limit] * naxes
    rows, given = list(limit), isinstance(limit, tuple)
    flat = not any(map(np.iterable, rows))
    if flat and len(rows) == 2 and (given or naxes == 1):
        return [tuple(rows)] * naxes
    if len(rows) == naxes and (not given if flat else [np.size(row) for row in rows] == [2] * naxes):
        return rows
    raise ValueError(
        f"limits of {name} must be a number, a pair, or {naxes} numbers or pairs by axis, got {limit!r}; {_FORMS}"
    )


def _is_listed(limit: object) -> TypeGuard[Sequence[float | None]]:
    """Whether limits are several numbers."""
    given: Any = limit
    return bool(np.ndim(given))


def _bound(name: str, limit: object, order: int, axis: int | None) -> Bound:
    try:
        bound = Limits.of(limit, name).bound(name, order, axis)
    except ValueError as error:
        forms = f"; {_FORMS}" if axis is not None and not isinstance(limit, Limits) and not _is_listed(limit) else ""
        raise ValueError(f"{error}{forms}") from None
    if axis is not None and order and not bound.low <= 0.0 <= bound.high:
        raise ValueError(
            f"limits of {name} must allow 0, which every plan has at rest, got from {bound.low:g} to {bound.high:g}; "
            f"{_FORMS}"
        )
    return bound


def _orders(quantities: Quantities, plan: Trajectory) -> dict[str, int]:
    """Lowest order of the jet from which each quantity is made, seen at rest at the start."""
    still = np.zeros((_HIGHEST + 1, plan.naxes, 1))
    still[0] = plan.initial[:, None]
    orders: dict[str, int] = {}
    rejection: Exception | None = None
    for order in range(_HIGHEST + 1):
        try:
            with np.errstate(all="ignore"):
                found = quantities(still[: order + 1])
        except (ValueError, IndexError, KeyError) as reason:  # it reads more than this
            rejection = reason
            continue
        if not isinstance(found, Mapping):
            raise TypeError(f"quantities must return a mapping of names to signals, got {type(found).__name__}")
        for name in found:
            orders.setdefault(name, order)
    if not orders:
        raise ValueError(
            f"quantities must take jets (order + 1, {plan.naxes}, ntime) of up to {_HIGHEST} derivatives, got "
            f"{type(rejection).__name__}: {rejection}"
        )
    return orders


def _signal(name: str, values: Array, shape: tuple[int, ...]) -> Array:
    """Values of a quantity over time."""
    found = np.asarray(values, dtype=float)
    if found.shape != shape:
        raise TypeError(f"quantities must be signals of shape (ntime,), got {name} of shape {found.shape}")
    return found


def _margin(bound: Bound, minimum: float, maximum: float, time_min: float, time_max: float) -> Margin:
    """The nearer of both sides."""
    low, high = ((side / bound.scale + bound.slack) for side in (minimum - bound.low, bound.high - maximum))
    value, time, fraction = (minimum, time_min, low) if low < high else (maximum, time_max, high)
    return Margin(bound, float(value), float(time), float(fraction))
