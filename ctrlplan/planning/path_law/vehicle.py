r"""Fastest time law of a segment of a `PathPlan`, under limits of a vehicle.

With the rate r and the acceleration a of the path parameter, r = ds/dt and
a = d^2s/dt^2, limited signals have one of the forms

.. math:: c(s) + g(s)\,r, \qquad c(s) + A(s)\,r^2 + B(s)\,a

(speeds, steering rates and angles; rates of speeds, accelerations along and across the
path). The first ones limit the rate from above, the second ones are linear in the
squared rate, so that `fastest_law` applies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from ctrlplan.planning.bounds import Bound, Limits, Signal
from ctrlplan.planning.path_law.law import fastest_law
from ctrlplan.trajectories import PathPlan, Trajectory
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.internal import InternalTrajectory

if TYPE_CHECKING:
    from ctrlplan.planning.limits import Limited

_SAME = 1e-9
"""Size of a coefficient, relative to the largest one of a signal, that is rounding."""

_TESTED = (0.7, -0.4)
"""Rate and acceleration at which the forms are compared with the signals."""


def orders_on_path(plan: PathPlan, limited: Limited) -> list[int] | None:
    """Order of each limited signal in time: 1 for the first form, 2 for the second; 0 if it is no function of time.

    Returns
    -------
    list of int, or None
        None if a signal has neither form.
    """
    if limited.order > 2 or limited.loop_bounds:
        return None
    times = np.concatenate([a + (b - a) * np.array([0.13, 0.5, 0.81]) for a, b in _intervals(plan)])
    try:
        forms = _Forms(plan, limited).at(*plan.coordinate.jet(times, 0)[0])
        wanted = _Forms(plan, limited).values(plan.coordinate.jet(times, 0)[0, 0], *_TESTED)
    except ValueError:  # not determined along the path
        return None
    sizes = np.stack([np.abs(form).max(axis=1) for form in forms])
    small = sizes <= _SAME * sizes.max(axis=0)
    r, a = _TESTED
    found = forms[0] + forms[1] * r + forms[2] * r**2 + forms[3] * a
    if not (np.abs(found - wanted).max(axis=1) <= _SAME * (sizes.max(axis=0) + np.abs(wanted).max(axis=1))).all():
        return None
    paced, accelerated = small[2] & small[3], small[1]
    if not (paced | accelerated).all():
        return None
    return [0 if still and one else 1 if one else 2 for one, still in zip(paced, accelerated, strict=True)]


def fastest_segment_law(part: PathPlan, limited: Limited, orders: Sequence[int]) -> Trajectory:
    """Time law of minimum duration of a path of one segment, from rest to rest, at points of its cells.

    Parameters
    ----------
    part : PathPlan
        Path of one segment.
    limited : Limited
        Limits for this path, satisfied at rest.
    orders : sequence of int
        Of the limited signals, from `orders_on_path`.
    """
    forms = _Forms(part, limited)
    _check_signs(forms, orders)
    second = [k for k, order in enumerate(orders) if order == 2]
    virtual = _Signals(forms, second)
    bounds = _over_time(partial(_fastest_rates, forms), 0, 1) if 1 in orders else []
    for axis, k in enumerate(second, 1):
        bounds += _over_time(partial(_differences, forms, k), axis, 2)
    return fastest_law(virtual, bounds, virtual.start, (0.0, 0.0)).law


def _check_signs(forms: _Forms, orders: Sequence[int]) -> None:
    """Raise for signals of one sign that must have both, since the path parameter starts and stops at the ends."""
    (curve,) = forms.plan.segments
    constant, _, _, along = forms.inside(np.array([curve.start, curve.end]))
    size = np.abs(along).max(axis=1, keepdims=True)
    alone = (np.abs(along) > _SAME * size) & (np.abs(constant) <= _SAME * size)
    for bound, order, accelerated in zip(forms.limited.bounds, orders, alone, strict=True):
        if order == 2 and 0.0 in (bound.low, bound.high) and accelerated.any():
            raise ValueError(
                f"limits of {bound.name} must allow both signs, got {bound.range}: the plan is at rest at both ends of "
                "each segment, where it is proportional to the acceleration along the path; give a small limit instead "
                "of 0"
            )


def _intervals(plan: PathPlan) -> Array:
    return np.stack([plan.breakpoints[:-1], plan.breakpoints[1:]], axis=1)


@dataclass(frozen=True, eq=False)
class _Forms:
    """Coefficients of limited signals along a path."""

    plan: PathPlan
    limited: Limited

    def values(self, coordinate: Array, r: float, a: float) -> Array:
        """Limited signals (nbounds, n) for a rate and an acceleration of the path parameter."""
        numbers, s = self.plan.pieces.located(coordinate)
        p = self.plan.pieces.jet(numbers, s, 2)
        jet = np.stack([p[0], r * p[1], r**2 * p[2] + a * p[1]])
        if self.limited.on_path:
            own = np.stack([coordinate, np.full(s.size, r), np.full(s.size, a)])
            jet = np.concatenate([jet, own[:, None]], axis=1)
        return self.limited.values(jet[: self.limited.order + 1])

    def at(self, coordinate: Array) -> tuple[Array, Array, Array, Array]:
        """Coefficients c, g, A and B (nbounds, n) at values of the path coordinate (n,)."""
        constant = self.values(coordinate, 0.0, 0.0)
        once, twice, along = (self.values(coordinate, r, a) - constant for r, a in ((1.0, 0.0), (2.0, 0.0), (0.0, 1.0)))
        square = 0.5 * twice - once
        return constant, once - square, square, along

    def inside(self, s: Array) -> tuple[Array, Array, Array, Array]:
        """The same at parameters (n,) inside of the pieces of a path of one segment."""
        (curve,) = self.plan.segments
        return self.at(s + self.plan.pieces.offsets[np.searchsorted(curve.breakpoints[1:-1], s)])


class _Signals(InternalTrajectory):
    """Path parameter, and axes whose first and second derivatives by it are B and A of signals of the second form."""

    what = "a plan of limited signals"

    _forms: _Forms
    _second: list[int]

    def __init__(self, forms: _Forms, second: Sequence[int]) -> None:
        (curve,) = forms.plan.segments
        labels = ("s", *(f"signal{k}" for k in second))
        self._set_fields(labels=labels, breakpoints=curve.breakpoints, _forms=forms, _second=list(second))

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment up to the second one; as `Trajectory.segment_jet`."""
        found = np.zeros((3, self.naxes, s.size))
        found[0, 0], found[1, 0] = self.breakpoints[segment] + s, 1.0
        _, _, square, along = self._forms.at(found[0, 0] + self._forms.plan.pieces.offsets[segment])
        found[1, 1:], found[2, 1:] = along[self._second], square[self._second]
        return found[: order + 1]


def _over_time(sides: Callable[[Array], tuple[Array, Array]], axis: int, order: int) -> list[Bound]:
    """Limits of a derivative of an axis, as functions of time."""
    signal = Signal(f"signal{axis}", order, axis)
    limits = Limits(low=lambda s: sides(s)[0], high=lambda s: sides(s)[1])
    return list(limits.bounds(signal.name, signal))


def _fastest_rates(forms: _Forms, s: Array) -> tuple[Array, Array]:
    """Limits of ds/dt by the signals of the first form."""
    constant, slope, square, along = forms.inside(s)
    low, high = (np.array([[getattr(b, side)] for b in forms.limited.bounds]) for side in ("low", "high"))
    size = np.abs(slope).max(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(slope > 0.0, high - constant, low - constant) / slope
    matters = (np.abs(slope) > 1e-12 * size) & (np.abs(square) + np.abs(along) <= _SAME * size)
    room = np.where(matters, room, np.inf)
    fastest = room.min(axis=0)
    stuck = np.flatnonzero((fastest[1:] <= 0.0) & (fastest[:-1] <= 0.0))
    if stuck.size:  # at one point alone a signal reaches its limit at rest
        _raise_immobile(forms, int(room[:, stuck[0]].argmin()), float(s[stuck[0]]))
    # Above 0 also where a signal reaches its limit at rest.
    fastest = np.maximum(fastest, _SAME * fastest[np.isfinite(fastest)].max(initial=0.0))
    return -fastest, fastest


def _raise_immobile(forms: _Forms, k: int, s: float) -> NoReturn:
    """Raise the error for a limit that allows no motion in the direction of travel."""
    (curve,), (direction,) = forms.plan.segments, forms.plan.directions
    where = ", ".join(f"{label} = {value:.4g}" for label, value in zip(forms.plan.labels, curve(s), strict=True))
    bound, way = forms.limited.bounds[k], "forward" if direction > 0 else "backward"
    raise ValueError(
        f"limits must allow the plan to move along its path, got {bound.name} {bound.range}, which allows no motion "
        f"{way} at {where}"
    )


def _differences(forms: _Forms, k: int, s: Array) -> tuple[Array, Array]:
    """Limits of a signal of the second form without its constant."""
    constant = forms.inside(s)[0][k]
    bound = forms.limited.bounds[k]
    return bound.low - constant, bound.high - constant
