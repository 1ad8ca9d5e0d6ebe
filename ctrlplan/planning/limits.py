"""Limits of plans: on derivatives, and on states and inputs of a flat plant along the plan."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from ctrlplan._checks import check_kind, checked_limits
from ctrlplan._display import Displayed, Part, Table, counted
from ctrlplan._renamed import FormerAttribute
from ctrlplan.planning.quantities import Quantities, System, quantities_of, system_given
from ctrlplan.trajectories import Trajectory, derivative_name
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.extrema import function_extrema
from ctrlplan.trajectories.waypoint import ENTRIES

if TYPE_CHECKING:
    import pandas as pd

_SAMPLES = 193
_ROUNDING = 1e-9  # fraction of a limit below which a margin is printed as 0
_HIGHEST = 8
"""Maximum order of the derivatives with limits."""


@dataclass(frozen=True)
class Limits:
    """Limits of one signal, for `fastest` and `margins`.

    Short forms are a number above 0, 5.0 for ``Limits(-5.0, 5.0)``, and a pair
    (minimum, maximum), with None for a side without limit.

    Parameters
    ----------
    low, high : float, optional
        Minimum and maximum, in the unit of the signal; None or infinite for no
        limit.

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
        low, high, _ = checked_limits(_sides(self.low, self.high), "Limits")
        object.__setattr__(self, "low", None if math.isinf(low) else low)
        object.__setattr__(self, "high", None if math.isinf(high) else high)

    @classmethod
    def of(cls, limit: object, name: str) -> Limits:
        """Limits from an object of this class or a short form.

        Parameters
        ----------
        limit : Limits, float or (float, float)
            Limits or short form.
        name : str
            Name of the signal, for messages.

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
            limit = _sides(*limit)
        elif isinstance(limit, bool) or not isinstance(limit, Real | np.ndarray):
            raise TypeError(f"limits of {name} must be a number or a pair, got {limit!r}")
        return cls(*checked_limits(limit, f"limits of {name}")[:2])

    def bound(self, name: str, order: int, axis: int | None) -> Bound:
        """Limits of a signal that depends on derivatives up to an order."""
        low, high, scale = checked_limits(_sides(self.low, self.high), f"limits of {name}")
        return Bound(name, low, high, scale, order, axis)


@dataclass(frozen=True)
class Bound:
    """Limits of one signal of a plan.

    Attributes
    ----------
    name : str
        Derivative of an axis (x_d1), or a quantity of the plant.
    low, high : float
        Minimum and maximum; one may be infinite.
    scale : float
        Scale of margins: half the distance of the limits, or the magnitude of a
        single limit.
    order : int
        Highest derivative that the signal depends on.
    axis : int or None
        Axis of a derivative; None for a quantity.
    slack : float
        Tolerance of the excess for rounding; above 0 if the limit is attained
        at rest, and thus at every duration.
    """

    name: str
    low: float
    high: float
    scale: float
    order: int
    axis: int | None = None
    slack: float = 0.0

    def excess(self, values: Array) -> Array:
        """Violation by values, relative to the scale; negative inside."""
        return np.maximum(values - self.high, self.low - values) / self.scale - self.slack

    @property
    def range(self) -> str:
        """The limits in words."""
        return _range(self.low, self.high)


def limit_words(limit: object, name: str = "velocity") -> str:
    """Description of a limit in any form that `margins` accepts, by axis for names of all axes, such as velocity."""
    if isinstance(limit, Limits):
        return _range(*_sides(limit.low, limit.high))
    given = np.array(limit, dtype=object)
    if given.ndim == 0:
        return _range(-float(given), float(given))
    if given.shape == (2,) and (isinstance(limit, tuple) or name not in ENTRIES):
        return _range(*map(float, _sides(*given)))
    return "; ".join(limit_words(tuple(row) if np.ndim(row) else row) for row in given)


def _range(low: float, high: float) -> str:
    if math.isinf(low):
        return f"at most {high:g}"
    if math.isinf(high):
        return f"at least {low:g}"
    return f"within ±{high:g}" if low == -high else f"from {low:g} to {high:g}"


@dataclass(frozen=True)
class Margin:
    """Margin of a signal to its limits over a whole plan.

    Attributes
    ----------
    bound : Bound
        The limits.
    value, time : float
        Value nearest to a limit, or of maximum violation, and its time [s].
    fraction : float
        Distance to the limit as a fraction of the scale; negative if the limit
        is violated.
    """

    bound: Bound
    value: float
    time: float
    fraction: float

    def __str__(self) -> str:
        return f"{self.bound.name} {self.bound.range}: {self.value:.6g} at {self.time:.6g} s, {self.room}"

    @property
    def room(self) -> str:
        """Margin or violation as text."""
        return f"{self.share} {'left' if self.fraction >= 0.0 else 'beyond'}"

    @property
    def share(self) -> str:
        """Absolute margin as text: in percent, or in the signal's unit."""
        size = abs(self.fraction) if abs(self.fraction) >= _ROUNDING else 0.0
        lone_zero = math.isinf(self.bound.high - self.bound.low) and self.bound.scale == 1.0
        return f"{size:.4g}" if lone_zero else f"{100.0 * size:.3g} %"


@dataclass(frozen=True, repr=False)
class Margins(Displayed):
    """Margins of all limits over a whole plan, the smallest first.

    Attributes
    ----------
    rows : tuple of Margin
        One per limit.
    """

    rows: tuple[Margin, ...]

    @property
    def active(self) -> Margin:
        """The smallest margin."""
        return self.rows[0]

    @property
    def satisfied(self) -> bool:
        """Whether all limits are satisfied over the whole plan."""
        return self.active.fraction >= 0.0

    hold = FormerAttribute("satisfied")

    def __iter__(self) -> Iterator[Margin]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def _describe(self) -> Iterator[Part]:
        yield f"Margins of {counted(len(self), 'limit')}: {self.active}"
        yield self.table()

    def table(self) -> Table:
        """Table with one row per limit, as print shows it."""
        rows = [
            (
                row.bound.name,
                row.bound.range,
                f"{row.value:.6g}",
                f"{row.time:.6g}",
                row.share if row.fraction > -_ROUNDING else f"-{row.share}",
            )
            for row in self.rows
        ]
        return Table(
            "Margins over the whole plan, the smallest first", ("signal", "limits", "value", "time [s]", "margin"), rows
        )

    def to_pandas(self) -> pd.DataFrame:
        """Table with one row per limit: low, high, value, time, margin."""
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
    """Margins of a plan to limits over its whole interval.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration.
    limits : mapping of str to float, (float, float), Limits or array_like
        Limits by the name of a derivative (x, x_d1, x_d2, ...) or of a quantity:
        a number above 0 for the magnitude, a pair (minimum, maximum) with None
        for no limit, or `Limits`. The names velocity, acceleration, jerk and
        snap stand for the derivatives of every axis: with a number or a tuple
        (minimum, maximum) for all axes, or with a list or array of naxes numbers
        or of shape (naxes, 2) by axis. Limits of a derivative must include 0.
    system : flat system, Crane or callable, optional
        System of the limited quantities: a `control.flatsys.FlatSystem` (states
        and inputs), a `Crane`, a plant with a method ``quantities``, or a
        function that maps a jet (order + 1, naxes, ntime) to a mapping of names
        to signals (ntime,). Quantities that the plan does not determine at rest
        (heading and steering angle of a car) are nan there and rejected.
    quantities : optional
        Deprecated name of `system`.

    Returns
    -------
    Margins
        With the attributes rows (a `Margin` per limit, the smallest first),
        active (the smallest margin) and satisfied. Extrema of derivatives are
        exact up to rounding, those of quantities (`Trajectory.extrema_of`) have
        an error below 1e-9 of the larger of magnitude and limit.

    Raises
    ------
    ValueError
        If a limit is not positive or does not increase, a name is unknown, or a
        limited signal is infinite at a jump of a lower derivative.
    RuntimeError
        If a quantity is not resolved because it is noisy or oscillates.

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
    """A signal is not determined by the plan because the plant's maps are singular."""


class Limited:
    """Limits for the evaluation of many plans with the same axes.

    Parameters are those of `margins`, for one of the plans.
    """

    def __init__(self, plan: Trajectory, limits: Mapping[str, object], system: System | None = None) -> None:
        if not isinstance(plan, Trajectory):
            raise TypeError(f"plan must be a Trajectory (the attribute plan of a result), got {plan!r:.60}")
        if not plan.duration:
            raise ValueError("a plan under limits must have a duration, got a step")
        check_kind(limits, "limits", Mapping, "a mapping of names to limits")
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
        if not jet[1:].any():  # at rest, which is no statement about plans that move
            return rows
        for row, b in zip(rows, self.bounds, strict=True):
            if np.isnan(row).any():
                still = not jet[1:, :, int(np.isnan(row).argmax())].any()
                raise UndeterminedError(
                    f"{b.name} must be determined by the plan, got nan{' where the plan is at rest' if still else ''}: "
                    "the maps of the plant are singular there, as those of a car are at rest; limit it for plans "
                    "that do not stop, or limit another signal"
                )
        return rows

    def _rows(self, jet: Array) -> Array:
        """Limited signals, nan where the plan does not determine them."""
        found = {} if self.derivatives_only or self._quantities is None else self._quantities(jet)
        rows = np.empty((len(self.bounds), jet.shape[2]))
        for row, b in zip(rows, self.bounds, strict=True):
            row[:] = jet[b.order, b.axis] if b.axis is not None else _signal(b.name, found[b.name], row.shape)
        return rows

    def excess(self, jet: Array) -> float:
        """Maximum excess over a sampled jet; inf if the plan is infeasible for the plant."""
        try:
            values = self.values(jet)
        except ValueError:  # infeasible for the plant, such as a rope under compression
            return math.inf
        worst = max(float(b.excess(row).max()) for b, row in zip(self.bounds, values, strict=True))
        return math.inf if math.isnan(worst) else worst

    def rejection(self, plan: Trajectory) -> str:
        """Reason for which a plan is infeasible for the plant; empty if it is feasible."""
        try:
            self.values(self.sampled(plan))
        except ValueError as rejection:
            return str(rejection)
        return ""

    def exact_excess(self, plan: Trajectory) -> float:
        """Maximum excess over a whole plan."""
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
            scales = [self.bounds[k].scale for k in others]  # no relative tolerance for a quantity near 0
            found = function_extrema(plan, lambda jet: self.values(jet)[others], self.order, scales)
            columns = zip(found.minimum, found.maximum, found.time_min, found.time_max, strict=True)
            rows += [_margin(self.bounds[k], *column) for k, column in zip(others, columns, strict=True)]
        return Margins(tuple(sorted(rows, key=lambda row: row.fraction)))

    def check_smooth(self, plan: Trajectory) -> None:
        """Raise for a jump of a derivative that makes a limited signal infinite.

        The plan is at rest before its start and after its end, except if its speed
        there is not 0: then it is the continuation of a motion.
        """
        moving = {t for t in (plan.start, plan.end) if plan.jet(t, 1, left=t > plan.start)[1].any()}
        for bound in self.bounds:
            for jump in plan.jumps(bound.order - 1) if bound.order else ():
                if jump.time not in moving and (bound.axis is None or plan.labels[bound.axis] == jump.label):
                    what = "position" if jump.order == 0 else derivative_name(jump.label, jump.order)
                    raise ValueError(
                        f"limits of {bound.name} require a plan that is continuous up to derivative {bound.order - 1} "
                        f"(and at rest before and after), got {what} that jumps by {jump.size:.4g} at {jump.time:g} s"
                    )

    def at_rest(self, plan: Trajectory) -> Array:
        """Jet at samples of the plan with zero derivatives."""
        return self.sampled(plan) * (np.arange(self.order + 1) == 0)[:, None, None]

    def _slackened(self, plan: Trajectory) -> Iterator[Bound]:
        """The bounds, with slack where they are attained at rest."""
        try:
            self.values(self.sampled(plan))
        except UndeterminedError:  # as at any other duration
            raise
        except ValueError:  # infeasible for the plant, but possibly feasible more slowly
            pass
        for bound, values in zip(self.bounds, self.values(self.at_rest(plan)), strict=True):
            if np.isnan(values).any():  # a signal that is singular at rest attains no limit there
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
                known = (
                    f", or quantities ({', '.join(plain)}, ...)"
                    if orders
                    else "; other names require system, and no system was given"
                )
                axes = ", ".join(derivative_name(label, 1) for label in plan.labels)
                raise ValueError(
                    f"limits must name derivatives of an axis ({axes}, ...), or velocity, acceleration, jerk or snap "
                    f"for all axes{known}, got {name!r}"
                )


_FORMS = "a tuple (minimum, maximum) applies to every axis, a list of one number per axis gives magnitudes"


def _by_axis(name: str, limit: object, naxes: int) -> list[object]:
    """Limits of each axis from those of all axes."""
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


def _sides(low: float | None, high: float | None) -> tuple[float, float]:
    """Both limits as numbers, infinite for None."""
    return -math.inf if low is None else low, math.inf if high is None else high


def _is_listed(limit: object) -> TypeGuard[Sequence[float | None]]:
    """Whether limits are a list or array."""
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
            f"limits of {name} must include 0, the value at rest, got from {bound.low:g} to {bound.high:g}; {_FORMS}"
        )
    return bound


def _orders(quantities: Quantities, plan: Trajectory) -> dict[str, int]:
    """Lowest order of the jet that each quantity depends on, at rest at the start."""
    still = np.zeros((_HIGHEST + 1, plan.naxes, 1))
    still[0] = plan.initial[:, None]
    orders: dict[str, int] = {}
    rejection: Exception | None = None
    for order in range(_HIGHEST + 1):
        try:
            with np.errstate(all="ignore"):
                found = quantities(still[: order + 1])
        except (ValueError, IndexError, KeyError) as reason:  # it depends on higher orders
            rejection = reason
            continue
        if not isinstance(found, Mapping):
            raise TypeError(f"quantities must return a mapping of names to signals, got {type(found).__name__}")
        for name in found:
            orders.setdefault(name, order)
    if not orders:
        raise ValueError(
            f"quantities must accept jets (order + 1, {plan.naxes}, ntime) of up to {_HIGHEST} derivatives, got "
            f"{type(rejection).__name__}: {rejection}"
        )
    return orders


def _signal(name: str, values: Array, shape: tuple[int, ...]) -> Array:
    """Values of a quantity over time, checked."""
    found = np.asarray(values, dtype=float)
    if found.shape != shape:
        raise TypeError(
            f"quantities must be signals of shape (ntime,), got {name} of shape {found.shape}; derivative k of axis i "
            "is jet[k, i]"
        )
    return found


def _margin(bound: Bound, minimum: float, maximum: float, time_min: float, time_max: float) -> Margin:
    """Margin to the nearer of both limits."""
    low, high = ((side / bound.scale + bound.slack) for side in (minimum - bound.low, bound.high - maximum))
    value, time, fraction = (minimum, time_min, low) if low < high else (maximum, time_max, high)
    return Margin(bound, float(value), float(time), float(fraction))
