r"""States and inputs of vehicles along a path with stops.

If the inputs of a plant x' = f(x, u) set the pace of its motion,

.. math:: f(x, \lambda^{d_1} u_1, \lambda^{d_2} u_2) = \lambda f(x, u_1, u_2), \qquad d_j \in \{0, 1\},

(a car: d = 1 for its speed and its steering rate, d = 0 for its steering angle), then
x(s), U(s) that follow a curve p(s) with ds/dt = 1 follow it with any time law: the
states are x(s(t)), the inputs U_j(s(t)) (ds/dt)^d_j. The maps are evaluated at unit
pace, where they are regular, also at the stops. Backward travel is forward travel
along the reversed curve, with the pace -ds/dt.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.trajectories import PathPlan, Trajectory
from ctrlplan.trajectories.chebyshev import fit
from ctrlplan.trajectories.path_coordinate import Pieces

CurveMap = Callable[[Array, Array], tuple[Array, Array]]
"""Maps a jet of a curve (order + 1, 2, n) at parameters (n,) to states and inputs at unit pace."""

FORWARD = (0.0, 0.5, 2.0)
"""Factors of the pace at which the rates of a plant are compared."""

_SAME = 1e-9
"""Difference of rates, relative to their maximum, that is rounding."""

_DEGREE = 24
"""Degree of the interpolants."""

_DEEPEST = 12
"""Number of halvings of a piece."""

_CONTINUOUS = 1e-6
"""Difference of states at a stop, relative to their maximum, that counts as none."""


def pace_degrees(
    rates: Callable[[Array, Array], Array], points: Sequence[tuple[Array, Array]], paces: Sequence[float] = FORWARD
) -> tuple[int, ...]:
    """Degrees d_j of the inputs of a plant; empty if its inputs do not set the pace.

    Parameters
    ----------
    rates : callable
        f(x, u).
    points : sequence of (x, u)
        Where the rates are compared.
    paces : sequence of float
        Factors of the pace.
    """

    def finite(x: Array, u: Array) -> Array | None:
        with np.errstate(all="ignore"):
            found = np.asarray(rates(x, u), dtype=float)
        return found if np.isfinite(found).all() else None

    known = [(x, u, f) for x, u in points if (f := finite(x, u)) is not None]
    if not known:
        return ()
    size = np.max([np.abs(f) for _, _, f in known], axis=0)
    for degrees in product((1, 0), repeat=known[0][1].size):
        pairs = ((finite(x, np.where(degrees, pace * u, u)), pace * f) for x, u, f in known for pace in paces)
        if all(f is not None and (np.abs(f - wanted) <= _SAME * size).all() for f, wanted in pairs):
            return degrees
    return ()


class PathMaps:
    """States and inputs of a plant along the curves of a path.

    Parameters
    ----------
    plan : PathPlan
        The path; its time laws are not used.
    curve_map : callable
        ``curve_map(curve, direction, start)`` returns the map along a curve and the
        pace ds/dt, 1 or -1, to which its inputs belong. `start` is the state at the
        beginning, None for the first curve.
    degrees : sequence of int
        Degrees of the inputs.
    orders : sequence of int
        Highest derivative of each flat output.
    states : sequence of str
        Names of the states.
    start : ndarray, shape (nstates,), optional
        State at the beginning of the path.

    Raises
    ------
    ValueError
        If a curve is not smooth enough, or the states differ where curves join.
    """

    def __init__(
        self,
        plan: PathPlan,
        curve_map: Callable[[Trajectory, int, Array | None], tuple[CurveMap, int]],
        degrees: Sequence[int],
        orders: Sequence[int],
        states: Sequence[str],
        start: Array | None = None,
    ) -> None:
        self._pieces, self._order = plan.pieces, max(orders)
        self._degrees = np.array(degrees)[:, None]
        self._nstates = len(states)
        self._maps: list[tuple[CurveMap, int]] = []
        end = start
        for k, (curve, direction) in enumerate(zip(plan.segments, plan.directions, strict=True)):
            _check_smooth(curve, orders, k)
            try:
                self._maps.append(curve_map(curve, direction, end))
                first, last = (self._at_end(k, side) for side in (0, -1))
            except ValueError as error:
                raise ValueError(f"segments[{k}] of the plan, with its parameter as the time: {error}") from None
            if k:
                _check_continuous(end, first, states, plan.stops[k], k)
            end = last

    def at(self, numbers: NDArray[np.intp], s: Array, rate: Array) -> tuple[Array, Array]:
        """States (nstates, n) and inputs (ninputs, n).

        Parameters
        ----------
        numbers : ndarray of int, shape (n,)
            Numbers of the pieces of the curves.
        s, rate : ndarray, shape (n,)
            Parameters of the curves, and ds/dt.
        """
        if not s.size:
            return np.empty((self._nstates, 0)), np.empty((self._degrees.size, 0))
        jet = self._pieces.jet(numbers, s, self._order)
        curves = self._pieces.curve[numbers]
        found: list[tuple[NDArray[np.intp], Array, Array]] = []
        for k in np.unique(curves).tolist():
            own = np.flatnonzero(curves == k)
            along, pace = self._maps[k]
            x, u = along(jet[:, :, own], s[own])
            found.append((own, np.asarray(x), np.where(self._degrees, pace * rate[own] * u, u) + 0.0))
        order = np.argsort(np.concatenate([own for own, _, _ in found]))
        x, u = (np.concatenate([rows[which] for rows in found], axis=1)[:, order] for which in (1, 2))
        return x, u

    def _at_end(self, k: int, side: int) -> Array:
        """State at the first or last parameter of a curve."""
        curve = self._pieces.curves[k]
        number = self._pieces.number(k, 0 if side == 0 else curve.breakpoints.size - 2)
        s = curve.breakpoints[[side]]
        return np.asarray(self._maps[k][0](self._pieces.jet(np.array([number]), s, self._order), s)[0])[:, 0]


class PathTable:
    """States and inputs at ds/dt = 1 and their derivatives by s, by Chebyshev interpolants on parts of the pieces.

    Parameters
    ----------
    maps : PathMaps
        The maps.
    pieces : Pieces
        Pieces of the curves.

    Raises
    ------
    RuntimeError
        If they are not resolved.
    """

    def __init__(self, maps: PathMaps, pieces: Pieces) -> None:
        parts: list[tuple[float, float, Array]] = []
        for number, (first, last) in enumerate(pieces.intervals):
            parts += _resolved(partial(_at_unit_pace, maps, number), first, last, float(pieces.offsets[number]))
        self._begins, self._ends = (np.array([part[side] for part in parts]) for side in (0, 1))
        self._coefficients = np.stack([found for _, _, found in parts], axis=-1)  # (rows, _DEGREE + 1, nparts)

    def at(self, coordinate: Array) -> tuple[Array, Array]:
        """Values and derivatives, both (nstates + ninputs, n), at values (n,) of the path coordinate."""
        # The nearer part in a gap between two pieces.
        part = np.searchsorted(0.5 * (self._ends[:-1] + self._begins[1:]), coordinate, side="right")
        a, b = self._begins[part], self._ends[part]
        u = (2.0 * coordinate - a - b) / (b - a)
        basis, slopes = np.ones((2, _DEGREE + 1, u.size))
        slopes[0], basis[1] = 0.0, u
        for k in range(1, _DEGREE):
            basis[k + 1] = 2.0 * u * basis[k] - basis[k - 1]
            slopes[k + 1] = 2.0 * basis[k] + 2.0 * u * slopes[k] - slopes[k - 1]
        own = self._coefficients[:, :, part]
        values, rates = (np.einsum("rkn,kn->rn", own, rows) for rows in (basis, slopes * (2.0 / (b - a))))
        return values, rates


def _at_unit_pace(maps: PathMaps, number: int, s: Array) -> Array:
    """States and inputs (nstates + ninputs, n) on a piece at ds/dt = 1."""
    return np.concatenate(maps.at(np.full(s.size, number), s, np.ones(s.size)))


def _resolved(
    function: Callable[[Array], Array], first: float, last: float, offset: float, depth: int = 0
) -> list[tuple[float, float, Array]]:
    """Parts of an interval on which a function is resolved: their ends, shifted by an offset, and coefficients."""
    found = fit(function, (first, last), _DEGREE)
    size = np.abs(found)
    if (size[:, -_DEGREE // 4 :].max(axis=1) <= 1e-12 * size.max(axis=1) + 1e-14).all():
        return [(first + offset, last + offset, found)]
    if depth == _DEEPEST:
        raise RuntimeError(
            f"states and inputs must be resolved along the path, but they change too fast at s = {first:.6g}"
        )
    middle = 0.5 * (first + last)
    return [
        part for ends in ((first, middle), (middle, last)) for part in _resolved(function, *ends, offset, depth + 1)
    ]


def states_on_path(maps: PathMaps, plan: PathPlan, times: Array) -> tuple[Array, Array]:
    """States (nstates, n) and inputs (ninputs, n) at times (n,) of a plan."""
    coordinate, rate = plan.coordinate.jet(times, 1)[:, 0]
    return maps.at(*plan.pieces.located(coordinate), rate)


def reject_path(plan: PathPlan, name: str) -> None:
    """Raise for a plant whose inputs do not set the pace."""
    stops = ", ".join(f"{time:.6g} s" for time in plan.stops)
    raise ValueError(
        f"flat must be a vehicle whose inputs set its pace for a PathPlan, got {name}, whose rates are not "
        f"proportional to some of its inputs: the path does not determine its states at the stops, at {stops}; give a "
        "plan in time, for each segment ctrlplan.Retimed(segment, law)"
    )


def along_formulas(
    reverse: Callable[[list[Array]], tuple[Array, Array]], orders: Sequence[int], direction: int
) -> tuple[CurveMap, int]:
    """Map along a curve by formulas, and its pace: backward travel is forward travel on the reversed curve."""
    signs = float(direction) ** np.arange(max(orders) + 1)[:, None]

    def along(jet: Array, s: Array) -> tuple[Array, Array]:
        return reverse([jet[: r + 1, j] * signs[: r + 1] for j, r in enumerate(orders)])

    return along, direction


def _check_smooth(curve: Trajectory, orders: Sequence[int], k: int) -> None:
    """Raise for a derivative of a curve that jumps, on which the states depend."""
    for jump in curve.jumps(max(orders) - 1):
        r = orders[curve.labels.index(jump.label)]
        if curve.start < jump.time < curve.end and jump.order < r:
            raise ValueError(
                f"segments[{k}] must be continuous up to derivative {r - 1} by its parameter, got a jump of derivative "
                f"{jump.order} by {jump.size:.4g} at s = {jump.time:.6g}; split the path there or take a smoother curve"
            )


def _check_continuous(before: Array | None, after: Array, states: Sequence[str], time: float, k: int) -> None:
    """Raise for states that differ at a stop by more than whole turns."""
    if before is None:
        return
    change = after - before
    change -= math.tau * np.round(change / math.tau)
    wrong = np.abs(change) > _CONTINUOUS * np.maximum(1.0, np.maximum(np.abs(before), np.abs(after)))
    if wrong.any():
        i = int(wrong.argmax())
        raise ValueError(
            f"states must be continuous at the stop at {time:.6g} s, got {states[i]} = {before[i]:.6g} at the end of "
            f"segments[{k - 1}] and {after[i]:.6g} at the start of segments[{k}]; give curves of equal curvature there"
        )
