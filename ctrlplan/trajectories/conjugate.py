"""Free entries of a piecewise spline: continuity of their conjugate derivatives, as banded equations.

Each waypoint has its own unit of time, the shorter of its neighbouring segments,
so that short segments do not make the equations ill-conditioned. Assembly and
solution take time and memory proportional to the number of waypoints. Where
rounding still matters, the solution is refined with residuals in extended
precision, or the equations are solved in decimal arithmetic.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from ctrlplan.trajectories.common import FACTORIALS, Array, readonly
from ctrlplan.trajectories.conjugate_digits import Ends, conjugate_digits
from ctrlplan.trajectories.newton import NEARLY_CLOSED, NewtonSystem

_ACCURATE = 1e-12
"""Estimated relative error of the free entries above which more digits are used."""

_ACCEPTED = 1e-9
"""The same for many entries, for which decimal arithmetic is slow."""

_SEARCHED = 1e-10
"""Estimated relative error of costs above which a search over times uses more digits."""

_SINGULAR = 1e13
"""Condition number of their equations, for equal durations, above which they are not determined."""

_UNEVEN = 1e3
"""Ratio of durations, to the power of the number of orders, above which rounding of the entries matters."""

_SUSPECT = 1e8
"""Condition number above which equations may not determine the entries."""

SHORT = 0.02
"""Duration relative to the longest segment below which entries and coefficients are computed with more digits."""

_ALIKE = 1.0 / SHORT
"""Ratio of durations up to which they are of one size, so that 13 digits of many entries suffice."""

_DECIMALS = 400
"""Number of free entries up to which decimal arithmetic is preferred to extended precision."""

_REFINEMENTS = 8
"""Maximum number of refinements of a solution."""

_POLYNOMIAL = 0.02
"""Error of entries of polynomials relative to rounding times the condition number; at most 0.01 is observed."""

_RIGHT_SIDES = 3
"""Number of random right sides from which the condition number is estimated."""

_EXTENDED = bool(np.finfo(np.longdouble).eps < 1e-18)
"""Whether the platform has numbers with more digits than a double."""


@dataclass(frozen=True, eq=False)
class Kind:
    """Consecutive segments that are determined by entries of the same orders.

    Attributes
    ----------
    ends : (tuple of int, tuple of int)
        Orders at the start and at the end.
    first, last : int
        First segment, and the one after the last.
    """

    ends: Ends
    first: int
    last: int

    @property
    def segments(self) -> slice:
        """Segments of this kind."""
        return slice(self.first, self.last)

    @cached_property
    def entries(self) -> list[tuple[int, int]]:
        """End and order of each entry."""
        return [(end, order) for end, orders in enumerate(self.ends) for order in orders]

    @cached_property
    def is_relative(self) -> bool:
        """Whether positions are relative to the start of a segment: its functions include the constants."""
        return 0 in self.ends[0] and 0 in self.ends[1]

    @cached_property
    def sides(self) -> NDArray[np.intp]:
        """End of each entry, 0 or 1."""
        return np.repeat([0, 1], [len(orders) for orders in self.ends])

    @cached_property
    def orders(self) -> NDArray[np.intp]:
        """Order of each entry."""
        return np.array([k for orders in self.ends for k in orders], dtype=np.intp)


def kinds_of(given: NDArray[np.bool_], closed: bool) -> list[Kind]:
    """Kinds of the segments between waypoints that prescribe given entries (nwaypoints, size)."""
    count, size = given.shape
    every, last = tuple(range(size)), count if closed else count - 1
    if closed or given.all():
        return [Kind((every, every), 0, last)]
    start, end = (tuple(np.flatnonzero(given[i]).tolist()) for i in (0, count - 1))
    if not (start or end or last > 1):
        raise ValueError("an axis must have at least one prescribed entry, got none")
    if last == 1:
        return [Kind((start, end), 0, 1)]
    if start == end == every:
        return [Kind((every, every), 0, last)]
    parts = [Kind((start, every), 0, 1), Kind((every, every), 1, last - 1), Kind((every, end), last - 1, last)]
    return [part for part in parts if part.first < part.last]


class FreePattern:
    """Free entries of waypoints and the places of their equations: all that does not depend on times.

    Arrays by entry have the shape (naxes, size, nwaypoints), unknowns the shape (naxes, nfree).

    Parameters
    ----------
    alpha : float
        Shape parameter [rad] of each segment; 0 gives polynomials.
    given : ndarray of bool, shape (nwaypoints, size)
        Prescribed entries by order.
    closed : bool
        Whether a last segment leads back to the first waypoint.
    natural : bool, optional
        Whether the free entries of both ends are unknown as well, with conjugate
        derivatives of 0; otherwise they lower the degree of the first and last
        segment.

    Attributes
    ----------
    nodes, orders : ndarray of int, shape (nfree,)
        Waypoint and order of each unknown, in the order of the equations.
    """

    def __init__(self, alpha: float, given: NDArray[np.bool_], closed: bool, natural: bool = False) -> None:
        self.alpha, self.given, self.closed = alpha, given, closed
        self.natural = natural
        self.count, self.size = given.shape
        self.kinds = kinds_of(np.ones_like(given) if natural else given, closed)
        free = ~given
        if not closed and not natural:
            free[[0, -1]] = False
        rank = np.argsort(_folded(self.count)) if closed else np.arange(self.count)
        ordered = np.argsort(rank, kind="stable")
        nodes, self.orders = np.nonzero(free[ordered])
        self.nodes = ordered[nodes]
        self.free_orders = np.flatnonzero(free.any(axis=0))
        self.mask = np.ascontiguousarray(given.T)
        self.conjugate = 2 * self.size - 1 - self.free_orders
        self.places = self.orders * self.count + self.nodes
        """Place of each unknown among the entries of an axis."""
        self.lowest = self._lowest(free)
        """Lowest free order, if all inner waypoints and no others have all orders from it on free; None otherwise."""
        self.ends_only = self.lowest if self.lowest and given[:, : self.lowest].all() else 0
        """The same if all lower orders are prescribed; otherwise, and for closed plans, 0."""
        self.rows = np.searchsorted(self.free_orders, self.orders) * (self.count + closed) + self.nodes
        """Place of each equation among the jumps of an axis."""
        self.prescribed = [self._prescribed(kind) for kind in self.kinds]
        self.first_position = int(given[:, 0].argmax()) if given[:, 0].any() else None

    def _lowest(self, free: NDArray[np.bool_]) -> int | None:
        inner = free[1:-1]
        if self.closed or self.natural or not inner.any():
            return None
        lowest = int(self.free_orders[0])
        return lowest if inner[:, lowest:].all() else None

    @property
    def undetermined(self) -> str:
        """Message for entries that are not determined."""
        where = "waypoints" if self.closed else "inner waypoints"
        got = "" if self.given[:, 0].any() else ", got an axis without any prescribed position"
        ends = "" if self.closed else ", such as derivatives at the first and last waypoint"
        return f"free entries at {where} must be determined by the prescribed ones; prescribe more{ends}{got}"

    def _prescribed(self, kind: Kind) -> list[tuple[int, slice]]:
        """Entries of a kind of segments, and the segments from the first to the last in which each is prescribed."""
        given = np.concatenate([self.given, self.given[: self.closed]])
        pairs = zip(kind.sides.tolist(), kind.orders.tolist(), strict=True)
        used = [given[kind.first + side : kind.last + side, k] for side, k in pairs]
        positions = np.flatnonzero(kind.orders == 0)
        if positions.size == 2:  # one is relative to the other
            used[positions[1]] = used[positions[1]] | used[positions[0]]
            used[positions[0]] = np.zeros(kind.last - kind.first, dtype=bool)
        found = [(n, np.flatnonzero(own)) for n, own in enumerate(used)]
        return [(n, slice(int(own[0]), int(own[-1]) + 1)) for n, own in found if own.size]

    @cached_property
    def amplification(self) -> float:
        """Error of the entries relative to rounding times the condition number."""
        if not self.alpha:  # the weights of polynomials are exact
            return _POLYNOMIAL
        return max(max(1.0, segment_system(self.alpha, kind.ends).amplification) for kind in self.kinds)

    @cached_property
    def sizes(self) -> Array:
        """Scales (size,) of the entries and equations by order, for which the matrix has entries near 1."""
        every, orders = tuple(range(self.size)), np.arange(self.size)
        own = segment_weights(self.alpha, (every, every), self.size)[0, 2 * self.size - 1 - orders, orders]
        return np.sqrt(np.where(own == 0.0, 1.0, np.abs(own)).astype(float))

    @cached_property
    def weights(self) -> list[NDArray[Any]]:
        """Conjugate derivatives (2, nrows, nentries, 1) at both ends of segments, with the signs of a jump, scaled."""
        found = []
        for kind in self.kinds:
            weights = segment_weights(self.alpha, kind.ends, self.size)[:, self.conjugate]
            weights = weights / self.sizes[self.free_orders, None] / self.sizes[kind.orders]
            found.append((weights * np.array([1.0, -1.0])[:, None, None])[..., None])
        return found

    @cached_property
    def matrix(self) -> _Places:
        """Places of the weights of all segments in the band matrix."""
        number = np.full((self.size, self.count), -1, dtype=np.intp)
        number[self.orders, self.nodes] = np.arange(self.nodes.size)
        number = np.concatenate([number, number[:, : self.closed]], axis=1)
        taken, rows, columns, shift = [], [], [], 0
        for kind in self.kinds:
            first, last = kind.first, kind.last
            row = np.stack([number[self.free_orders, first + side : last + side] for side in (0, 1)])[:, :, None]
            pairs = zip(kind.sides.tolist(), kind.orders.tolist(), strict=True)
            column = np.array([number[k, first + side : last + side] for side, k in pairs])
            row, column = np.broadcast_arrays(row, column.reshape(-1, last - first))
            used = np.flatnonzero((row >= 0) & (column >= 0))
            taken.append(used + shift)
            rows.append(row.ravel()[used])
            columns.append(column.ravel()[used])
            shift += row.size
        return _Places(self.nodes.size, *map(np.concatenate, (taken, rows, columns)))


class _Places:
    """Places in a band matrix of the entries of a vector.

    Parameters
    ----------
    n : int
        Number of equations.
    taken : ndarray of int, shape (nused,)
        Entries of the vector that are used.
    row, column : ndarray of int, shape (nused,)
        Where they are added.
    """

    def __init__(self, n: int, taken: NDArray[np.intp], row: NDArray[np.intp], column: NDArray[np.intp]) -> None:
        self.n, self.taken, self.row = n, taken, row
        self.width = int(np.abs(row - column).max(initial=0))
        self.height = 3 * self.width + 1  # LAPACK requires space for the fill-in
        self.place = (2 * self.width + row - column) + self.height * column


class FreeEntries:
    """Equations of the free entries of waypoints at given times.

    Parameters
    ----------
    pattern : FreePattern
        Prescribed entries.
    times : ndarray, shape (nwaypoints,)
        Times of the waypoints [s].
    period : float or None
        Period of a closed plan.
    """

    _moments: Array | None  # ends of the segments; None for durations that are exact

    def __init__(self, pattern: FreePattern, times: Array, period: float | None = None) -> None:
        self._moments = moments = times if period is None else np.append(times, times[0] + period)
        self._set(pattern, moments[1:] - moments[:-1])

    @classmethod
    def of_durations(cls, pattern: FreePattern, durations: Array) -> FreeEntries:
        """Equations for exact durations (nsegments,) [s], of a plan that is not closed."""
        self = cls.__new__(cls)
        self._moments = None
        self._set(pattern, durations)
        return self

    def _set(self, pattern: FreePattern, durations: Array) -> None:
        self.pattern, self._durations = pattern, durations
        self._units = np.empty(pattern.count)
        np.minimum(durations[:-1], durations[1:], out=self._units[1 : durations.size])
        self._units[0] = min(durations[0], durations[-1]) if pattern.closed else durations[0]
        if not pattern.closed:
            self._units[-1] = durations[-1]
        self._ratio = float(durations.max() / durations.min())

    def solve(self, rows: Array) -> NDArray[Any]:
        """Free entries (naxes, nfree) from entries (naxes, size, nwaypoints): double, extended or decimal numbers.

        Raises
        ------
        ValueError
            If the prescribed entries do not determine them, or they overflow.
        """
        pattern = self.pattern
        few = pattern.nodes.size <= _DECIMALS and not pattern.natural
        if few and self._ratio * SHORT > 1.0:
            return self._decimal(rows)
        equations = self._equations
        if equations is not None:
            extended = _EXTENDED and not pattern.alpha
            if equations.loss <= _ACCURATE and not (self._uneven and extended):
                return self._checked(self._plain(equations, rows))
            if extended and self._determined(equations):
                loose = self._ratio <= _ALIKE and not few
                found = self._refined(equations, rows, 1e-13 if loose else 1e-15)
                if found is not None:
                    return self._checked(found)
            elif not extended and equations.loss <= _ACCEPTED and not few:
                return self._checked(self._plain(equations, rows))
        if not pattern.natural:
            return self._decimal(rows)
        raise ValueError(pattern.undetermined)

    def estimate(self, rows: Array) -> Array:
        """The same for a search over times, without the digits that only the coefficients of short segments need."""
        equations = self._equations
        if equations is not None:
            # Costs of a short segment are differences of its entries.
            if equations.loss * self._ratio**self.pattern.size <= _SEARCHED:
                return self._checked(self._plain(equations, rows))
            if _EXTENDED and not self.pattern.alpha and self._determined(equations):
                found = self._refined(equations, rows, 1e-15)
                if found is not None:
                    return self._checked(found.astype(float))
        return self.solve(rows).astype(float)

    @property
    def _uneven(self) -> bool:
        """Whether rounding of the entries matters."""
        return math.log(self._ratio) * self.pattern.size > math.log(_UNEVEN)

    def _determined(self, equations: _Banded) -> bool:
        """Whether the prescribed entries determine the free ones."""
        even = self._even if equations.condition > _SUSPECT else equations
        return even is None or even.condition <= _SINGULAR

    @cached_property
    def _even(self) -> _Banded | None:
        """Equations for equal durations: whether entries are determined does not depend on the times."""
        return self._assembled(self._terms_of(np.ones_like(self._durations), np.ones_like(self._units)))

    @cached_property
    def _equations(self) -> _Banded | None:
        """Factorised equations; None on overflow."""
        return self._assembled(self._terms)

    def _plain(self, equations: _Banded, rows: Array) -> Array:
        with np.errstate(all="ignore"):
            if self.pattern.ends_only:
                found = equations.solve(self._inner_sides(rows))
                found /= self._unknown_scale
                return found
            offset, shifted = self._shifted(rows)
            jumps = self._jumps(self._data(shifted, self._scale), self._terms, self.pattern.prescribed)
            return self._restored(equations.solve(-jumps), self._unknown_scale, offset)

    def _refined(self, equations: _Banded, rows: Array, tolerance: float) -> NDArray[np.longdouble] | None:
        """Solution with residuals in extended precision; None if it does not converge to a relative tolerance."""
        long, orders = np.longdouble, self.pattern.orders
        offset, shifted = self._shifted(rows.astype(long))
        durations = self._durations.astype(long) if self._moments is None else np.diff(self._moments.astype(long))
        units = self._units.astype(long)
        every = [
            [(n, slice(0, kind.last - kind.first)) for n in range(kind.orders.size)] for kind in self.pattern.kinds
        ]
        with np.errstate(all="ignore"):
            terms, scale = self._terms_of(durations, units), self._scale_of(units)
            data = self._data(shifted, scale)
            unknown = scale[orders, self.pattern.nodes]
            found = np.zeros((rows.shape[0], orders.size), dtype=long)
            for _ in range(_REFINEMENTS):
                change = equations.solve(-self._jumps(data, terms, every).astype(float))
                found += change
                data.reshape(len(data), -1)[:, self.pattern.places] = found
                size = np.abs(found)
                peaks = np.array([size[:, orders == k].max(axis=1, initial=0.0) for k in range(self.pattern.size)]).T
                if (np.abs(change) <= 1e-17 * size + 1e-20 * peaks[:, orders]).all():
                    return self._restored(found, unknown, offset)
            small = (np.abs(change) <= tolerance * (size + 1e-2 * peaks[:, orders])).all()
            return self._restored(found, unknown, offset) if small else None

    def _decimal(self, rows: Array) -> NDArray[np.object_]:
        """Solution in decimal arithmetic."""
        pattern, even = self.pattern, self._even
        solution = None
        apart = pattern.alpha > NEARLY_CLOSED and not pattern.closed
        if even is None or even.condition <= _SINGULAR or apart:
            ends = [kind.ends for kind in pattern.kinds for _ in range(kind.first, kind.last)]
            free = list(zip(pattern.nodes.tolist(), pattern.orders.tolist(), strict=True))
            solution = conjugate_digits(pattern.alpha, self._exact_durations(), ends, free, rows.T)
        if solution is None:
            raise ValueError(pattern.undetermined)
        return self._checked(solution.T)

    def _exact_durations(self) -> list[Fraction]:
        if self._moments is None:
            return [Fraction(h) for h in self._durations.tolist()]
        return [Fraction(end) - Fraction(start) for start, end in itertools.pairwise(self._moments.tolist())]

    def _checked(self, found: NDArray[Any]) -> NDArray[Any]:
        finite = np.isfinite(found.astype(float, copy=False))
        if not finite.all():
            worst = int(np.argwhere(~finite)[0, 1])
            raise ValueError(
                "derivatives at inner waypoints must stay within floating point, got an overflow of derivative "
                f"{self.pattern.orders[worst]} at waypoints[{self.pattern.nodes[worst]}]; increase the time between "
                "neighbouring waypoints, or choose other units"
            )
        return found

    def _shifted(self, rows: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """First prescribed position of each axis, and entries relative to it: an offset costs no digits."""
        first = self.pattern.first_position
        if first is None:
            return np.zeros(len(rows), dtype=rows.dtype), rows
        offset = rows[:, 0, first].copy()
        shifted = rows.copy()
        shifted[:, 0] -= offset[:, None]
        return offset, shifted

    def _data(self, rows: NDArray[Any], scale: NDArray[Any]) -> NDArray[Any]:
        """Prescribed entries in the units of the waypoints, 0 where free."""
        return np.where(self.pattern.mask, rows, 0.0) * scale

    def _restored(self, found: NDArray[Any], scale: NDArray[Any], offset: NDArray[Any]) -> NDArray[Any]:
        """Entries from those in the units of the waypoints."""
        entries = found / scale
        if not self.pattern.free_orders[0]:
            entries[:, self.pattern.orders == 0] += offset[:, None]
        return np.asarray(entries)

    @cached_property
    def _scale(self) -> NDArray[Any]:
        return self._scale_of(self._units)

    @cached_property
    def _unknown_scale(self) -> NDArray[Any]:
        return np.asarray(self._scale[self.pattern.orders, self.pattern.nodes])

    def _scale_of(self, units: NDArray[Any]) -> NDArray[Any]:
        """Factors (size, nwaypoints) from entries to those in the units of the waypoints."""
        return _powers(units, self.pattern.size - 1) * self.pattern.sizes[:, None]

    @cached_property
    def _terms(self) -> list[NDArray[Any]]:
        with np.errstate(all="ignore"):
            return self._terms_of(self._durations, self._units)

    def _terms_of(self, durations: NDArray[Any], units: NDArray[Any]) -> list[NDArray[Any]]:
        """Jumps (2, nrows, nentries, nsegments) at both ends of each segment by its entries, by kind."""
        pattern, found = self.pattern, []
        wrapped = np.append(units, units[:1]) if pattern.closed else units
        for kind, weights in zip(pattern.kinds, pattern.weights, strict=True):
            h = durations[kind.segments]
            at = np.stack([wrapped[kind.first + side : kind.last + side] for side in (0, 1)])
            rows = _powers(at / h, 2 * pattern.size - 1)[pattern.conjugate].swapaxes(0, 1)
            columns = _powers(h / at, pattern.size - 1)[kind.orders, kind.sides]
            found.append(np.asarray(weights.astype(durations.dtype, copy=False) * rows[:, :, None] * columns))
        return found

    def _jumps(
        self, data: NDArray[Any], terms: list[NDArray[Any]], entries: list[list[tuple[int, slice]]]
    ) -> NDArray[Any]:
        """Jumps (naxes, nfree) of the conjugate derivatives, for given entries of each kind in some segments."""
        pattern, naxes = self.pattern, len(data)
        if pattern.closed:
            data = np.concatenate([data, data[:, :, :1]], axis=2)
        jumps = np.zeros((naxes, pattern.free_orders.size, data.shape[2]), dtype=data.dtype)
        moving = data[:, 1:].any()
        for kind, factors, used in zip(pattern.kinds, terms, entries, strict=True):
            for n, inside in used:
                side, order = kind.entries[n]
                if order and not moving:
                    continue
                left, right = kind.first + inside.start, kind.first + inside.stop
                values = data[:, order, left + side : right + side]
                if kind.is_relative and not order:
                    if not side:
                        continue
                    values = values - data[:, 0, left:right]
                if not values.any():
                    continue
                for end, at in enumerate(factors[:, :, n, inside]):
                    jumps[:, :, left + end : right + end] += at * values[:, None]
        if pattern.closed:
            jumps[:, :, 0] += jumps[:, :, -1]
        return np.asarray(jumps.reshape(naxes, -1).take(pattern.rows, axis=1))

    def _inner_sides(self, rows: Array) -> Array:
        """Right sides (naxes, nfree) if inner waypoints prescribe all orders below one, and none from it on."""
        first, lower, ends = self._inner_weights
        right = np.empty((len(rows), *first.shape[:0:-1]))  # by waypoint
        by_order = right.transpose(2, 0, 1)
        steps = rows[:, 0, 1:] - rows[:, 0, :-1]
        np.multiply(first[0][:, None], steps[:, :-1], out=by_order)
        by_order += first[1][:, None] * steps[:, 1:]
        for order, around in enumerate(lower, 1):
            for shift, own in enumerate(around):
                by_order += own[:, None] * rows[:, order, shift : shift + first.shape[2]]
        for side, orders, weights in ends:
            right[:, -side] += rows[:, orders, -side].dot(weights)
        return right.reshape(len(rows), -1)

    @cached_property
    def _inner_weights(self) -> tuple[Array, list[list[Array]], list[tuple[int, slice | list[int], Array]]]:
        """Weights of the entries in the right sides of the inner waypoints, with the opposite sign of the jumps.

        Those (2, norders, ninner) of the steps of the position before and after a waypoint;
        for each further order that all waypoints prescribe those of the entries before, at
        and after it; for the last and the first waypoint, the orders prescribed there alone
        and their weights (norders, nfree).
        """
        pattern, scale = self.pattern, self._scale
        every = np.zeros((2, pattern.free_orders.size, 2, pattern.size, self._durations.size))
        for kind, terms in zip(pattern.kinds, self._terms, strict=True):
            for n, (side, order) in enumerate(kind.entries):
                nodes = slice(kind.first + side, kind.last + side)
                every[:, :, side, order, kind.segments] = -terms[:, :, n] * scale[order, nodes]
        after, before = every[0, ..., 1:], every[1, ..., :-1]  # of the segments at each inner waypoint
        lower = [
            [before[:, 0, k], before[:, 1, k] + after[:, 0, k], after[:, 1, k]] for k in range(1, pattern.ends_only)
        ]
        ends: list[tuple[int, slice | list[int], Array]] = []
        for side, own in ((1, after[:, 1, :, -1]), (0, before[:, 0, :, 0])):
            orders = [k for k in range(pattern.ends_only, pattern.size) if pattern.given[-side, k]]
            if orders:
                together = len(orders) == orders[-1] + 1 - orders[0]
                where = slice(orders[0], orders[-1] + 1) if together else orders  # a slice is faster
                ends.append((side, where, own[:, orders].T))
        return np.array([before[:, 1, 0], after[:, 1, 0]]), lower, ends

    def _assembled(self, terms: list[NDArray[Any]]) -> _Banded | None:
        """Band matrix of the equations, factorised; None on overflow."""
        places = self.pattern.matrix
        joined = terms[0].ravel() if len(terms) == 1 else np.concatenate([own.ravel() for own in terms])
        value = joined.take(places.taken)
        return _Banded(places, value, self.pattern.amplification) if np.isfinite(value).all() else None


class _Banded:
    """Factorised band matrix.

    Attributes
    ----------
    condition, loss : float
        Condition number, and the estimated relative error of a solution.
    """

    def __init__(self, places: _Places, value: Array, amplification: float) -> None:
        n, self._width = places.n, places.width
        band = np.bincount(places.place, value, minlength=places.height * n).reshape(n, -1).T
        norm = float(np.bincount(places.row, np.abs(value)).max(initial=0.0))
        self._lu, self._pivots, info = lapack.dgbtrf(band, self._width, self._width, overwrite_ab=True)
        self.condition = np.inf
        if not info:
            # Solutions for some right sides of size 1 bound the inverse from below, and nearly reach it.
            with np.errstate(all="ignore"):
                largest = float(np.abs(self.solve(_right_sides(n).copy())).max(initial=0.0))
            self.condition = norm * largest if np.isfinite(largest) else np.inf
        self.loss = float(np.finfo(float).eps) * self.condition * amplification

    def solve(self, right: Array) -> Array:
        """Solution (naxes, n); right sides in the order of rows are overwritten."""
        found, _ = lapack.dgbtrs(self._lu, self._width, self._width, right.T, self._pivots, overwrite_b=True)
        return np.asarray(found.T)


@lru_cache(maxsize=8)
def _right_sides(n: int) -> Array:
    """Random right sides of size 1 from which the condition number is estimated.

    Of different magnitudes: the signs alone are orthogonal to simple combinations of rows, with which a singular
    matrix is not found.
    """
    random = np.random.default_rng(0)
    return readonly(
        (random.choice([-1.0, 1.0], (n, _RIGHT_SIDES)) * random.uniform(0.5, 1.0, (n, _RIGHT_SIDES))).T.copy()
    )


@lru_cache(maxsize=256)
def segment_weights(alpha: float, ends: Ends, size: int) -> NDArray[Any]:
    """Derivatives 0, ..., 2 size - 1 at both ends of the unit segment, (2, 2 size, nentries), by its entries.

    For polynomials with all digits of an extended number.
    """
    if alpha:
        system = segment_system(alpha, ends)
        given = [(side, k) for side in (0, 1) for k in ends[side]]
        place = {entry: n for n, entry in enumerate(given)}
        order = [place[int(i), int(k)] for i, k in zip(system.waypoint_index, system.order_index, strict=True)]
        unit = np.eye(len(given))[order] / FACTORIALS[system.order_index, None]
        taylor = system.taylor(np.array([0.0, 1.0]), 2 * size - 1)
        found: NDArray[Any] = np.einsum("mkt,ma->tka", taylor, system.coefficients(unit))
        found *= FACTORIALS[: 2 * size, None]
    else:
        exact = _exact_weights(ends, size)
        found = np.array([[[_long(value) for value in row] for row in side] for side in exact])
    found.flags.writeable = False
    return found


def _exact_weights(ends: Ends, size: int) -> list[list[list[Fraction]]]:
    """The same for polynomials, as fractions."""
    entries = [(side, k) for side in (0, 1) for k in ends[side]]
    count = len(entries)

    def derivatives(side: int, order: int) -> list[int]:
        """Derivative of each power at an end of the unit segment."""
        return [math.perm(m, order) if m == order or (side and m > order) else 0 for m in range(count)]

    rows = [[Fraction(v) for v in derivatives(*entry)] for entry in entries]
    for i, row in enumerate(rows):
        row += [Fraction(int(i == j)) for j in range(count)]
    for n in range(count):
        pivot = next((m for m in range(n, count) if rows[m][n]), None)
        if pivot is None:
            raise ValueError("the entries prescribed at the ends of a segment must determine it, got a singular system")
        rows[n], rows[pivot] = rows[pivot], rows[n]
        rows[n] = [value / rows[n][n] for value in rows[n]]
        for m in range(count):
            if m != n and rows[m][n]:
                factor = rows[m][n]
                rows[m] = [a - factor * b for a, b in zip(rows[m], rows[n], strict=True)]
    powers = [row[count:] for row in rows]  # coefficient of each power by entry
    return [
        [
            [sum((f * row[n] for f, row in zip(values, powers, strict=True) if f), Fraction(0)) for n in range(count)]
            for values in (derivatives(side, order) for order in range(2 * size))
        ]
        for side in (0, 1)
    ]


def rounded(values: NDArray[np.object_], alpha: float) -> NDArray[Any]:
    """Decimal numbers as extended ones where these make a difference, otherwise as doubles."""
    if not _EXTENDED or alpha:
        return values.astype(float)
    return np.array([np.longdouble(str(value)) for value in values.ravel()]).reshape(values.shape)


def _long(value: Fraction) -> np.longdouble:
    return np.longdouble(value.numerator) / np.longdouble(value.denominator)


@lru_cache(maxsize=256)
def segment_system(alpha: float, ends: Ends) -> NewtonSystem:
    """Collocation on the unit segment."""
    return NewtonSystem(alpha, np.array([0.0, 1.0]), ends)


def _powers(base: NDArray[Any], highest: int) -> NDArray[Any]:
    """Powers 0, ..., highest, along a new first axis."""
    found = np.ones((highest + 1, *base.shape), dtype=base.dtype)
    for k in range(highest):
        np.multiply(found[k], base, out=found[k + 1])
    return found


def _folded(count: int) -> NDArray[np.intp]:
    """Order 0, 1, n - 1, 2, n - 2, ... of the waypoints of a closed plan, in which neighbours are near each other."""
    back = np.arange(count - 1, count // 2, -1)
    front = np.arange(1, count // 2 + 1)
    order: Sequence[int] = [0]
    pairs = np.full(2 * max(front.size, back.size), -1)
    pairs[: 2 * front.size : 2], pairs[1 : 2 * back.size : 2] = front, back
    return np.append(order, pairs[pairs >= 0]).astype(np.intp)
