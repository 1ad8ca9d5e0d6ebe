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

from ctrlplan.trajectories.common import FACTORIALS, Array
from ctrlplan.trajectories.conjugate_digits import Ends, conjugate_digits
from ctrlplan.trajectories.newton import NEARLY_CLOSED, NewtonSystem

_ACCURATE = 1e-12
"""Estimated relative error of the free entries above which more digits are used."""

_ACCEPTED = 1e-9
"""The same for many entries, for which decimal arithmetic is slow, and for closed plans, for which there is none."""

_SINGULAR = 1e13
"""Condition number of their equations, for equal durations, above which they are not determined."""

_UNEVEN = 1e3
"""Ratio of durations, to the power of the number of orders, above which rounding of the entries matters."""

_ALIKE = 10.0
"""Ratio of durations up to which they are of one size."""

_SUSPECT = 1e8
"""Condition number above which equations may not determine the entries."""

SHORT = 0.02
"""Duration relative to the longest segment below which entries and coefficients are computed with more digits."""

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
    if closed:
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


class FreeEntries:
    """Equations of the free entries of inner waypoints, for one pattern of prescribed entries.

    Parameters
    ----------
    alpha : float
        Shape parameter [rad] of each segment; 0 gives polynomials.
    times : ndarray, shape (nwaypoints,)
        Times of the waypoints [s].
    period : float or None
        Period of a closed plan, whose last segment leads back to the first
        waypoint.
    given : ndarray of bool, shape (nwaypoints, size)
        Prescribed entries by order.
    natural : bool, optional
        Whether the free entries of both ends are unknown as well, with conjugate
        derivatives of 0; otherwise they lower the degree of the first and last
        segment.
    """

    def __init__(
        self,
        alpha: float,
        times: Array,
        period: float | None,
        given: NDArray[np.bool_],
        natural: bool = False,
    ) -> None:
        self._alpha, self._times, self._period, self._given = alpha, times, period, given
        self._open = period is None and not natural
        self._moments = np.append(times, [] if period is None else times[0] + period)
        self._count, self._size = given.shape
        self.kinds = kinds_of(np.ones_like(given) if natural else given, period is not None)
        free = ~given
        if self._open:
            free[[0, -1]] = False
        self._number = np.full(given.shape, -1, dtype=np.intp)  # of each unknown, in the order of the equations
        rank = np.argsort(_folded(self._count)) if period is not None else np.arange(self._count)
        ordered = np.argsort(rank, kind="stable")
        nodes, self.orders = np.nonzero(free[ordered])
        self.nodes = ordered[nodes]
        self._number[self.nodes, self.orders] = np.arange(self.nodes.size)
        self._free_orders = np.flatnonzero(free.any(axis=0))
        self._row = np.searchsorted(self._free_orders, self.orders)
        self._durations = np.diff(self._moments)
        before = np.append(np.inf, self._durations) if period is None else np.roll(self._durations, 1)
        self._units = np.minimum(before, np.append(self._durations, [np.inf] * (period is None)))

    def solve(self, table: Array) -> NDArray[Any]:
        """Free entries (nfree, naxes) from a table (nwaypoints, size, naxes): double, extended or decimal numbers.

        Raises
        ------
        ValueError
            If the prescribed entries do not determine them, or they overflow.
        """
        ratio = float(self._durations.max() / self._durations.min())
        uneven = math.log(ratio) * self._size > math.log(_UNEVEN)
        open_, few = self._open, self.nodes.size <= _DECIMALS
        if open_ and few and ratio * SHORT > 1.0:
            return self._decimal(table)
        equations = self._equations
        if equations is not None:
            extended = _EXTENDED and not self._alpha
            if equations.loss <= _ACCURATE and not (uneven and extended):
                return self._checked(self._plain(equations, table))
            if extended and self._determined(equations):
                # With durations of one size all entries have one scale.
                found = self._refined(equations, table, 1e-13 if ratio <= _ALIKE and not (open_ and few) else 1e-15)
                if found is not None:
                    return self._checked(found)
            elif not extended and equations.loss <= _ACCEPTED and not (open_ and few):
                return self._checked(self._plain(equations, table))
        if open_:
            return self._decimal(table)
        raise ValueError("free entries at waypoints must be determined by the prescribed ones; prescribe more")

    def _determined(self, equations: _Banded) -> bool:
        """Whether the prescribed entries determine the free ones."""
        even = self._even if equations.condition > _SUSPECT else equations
        return even is None or even.condition <= _SINGULAR

    @cached_property
    def _even(self) -> _Banded | None:
        """Equations for equal durations: whether entries are determined does not depend on the times."""
        return self._assembled(np.ones_like(self._durations), np.ones(self._count))

    @cached_property
    def _equations(self) -> _Banded | None:
        """Factorised equations; None on overflow."""
        return self._assembled(self._durations, self._units)

    def _plain(self, equations: _Banded, table: Array) -> Array:
        offset = self._offset(table)
        shifted = table.copy()
        shifted[:, 0] -= offset
        with np.errstate(all="ignore"):
            found = equations.solve(-self._jumps(self._data(shifted), self._terms))
            return self._restored(found, offset)

    def _refined(self, equations: _Banded, table: Array, tolerance: float) -> NDArray[np.longdouble] | None:
        """Solution with residuals in extended precision; None if it does not converge to a relative tolerance."""
        long = np.longdouble
        offset = self._offset(table)
        shifted = table.astype(long)
        shifted[:, 0] -= offset
        durations, units = np.diff(self._moments.astype(long)), self._units.astype(long)
        with np.errstate(all="ignore"):
            data, terms = self._data(shifted), self._terms_of(durations, units)
            found = np.zeros((self.nodes.size, table.shape[2]), dtype=long)
            for _ in range(_REFINEMENTS):
                change = equations.solve(-self._jumps(data, terms).astype(float))
                found += change
                data[self.nodes, self.orders] = found
                size = np.abs(found)
                peaks = np.array([size[self.orders == k].max(axis=0, initial=0.0) for k in range(self._size)])
                if (np.abs(change) <= 1e-17 * size + 1e-20 * peaks[self.orders]).all():
                    return self._restored(found, offset)
            small = (np.abs(change) <= tolerance * (size + 1e-2 * peaks[self.orders])).all()
            return self._restored(found, offset) if small else None

    def _decimal(self, table: Array) -> NDArray[np.object_]:
        """Solution in decimal arithmetic."""
        even = self._even
        solution = None
        if even is None or even.condition <= _SINGULAR or self._alpha > NEARLY_CLOSED:
            ends = [kind.ends for kind in self.kinds for _ in range(kind.first, kind.last)]
            free = list(zip(self.nodes.tolist(), self.orders.tolist(), strict=True))
            solution = conjugate_digits(self._alpha, self._times.tolist(), ends, free, table)
        if solution is None:
            raise ValueError(
                "free entries at inner waypoints must be determined by the prescribed ones; prescribe more"
            )
        return self._checked(solution)

    def _checked(self, found: NDArray[Any]) -> NDArray[Any]:
        finite = np.isfinite(found.astype(float))
        if not finite.all():
            worst = int(np.argwhere(~finite)[0, 0])
            raise ValueError(
                "derivatives at inner waypoints must stay within floating point, got an overflow of derivative "
                f"{self.orders[worst]} at waypoints[{self.nodes[worst]}]; increase the time between neighbouring "
                "waypoints"
            )
        return found

    def _offset(self, table: Array) -> Array:
        """First prescribed position of each axis: an offset of all positions costs no digits."""
        given = np.flatnonzero(self._given[:, 0])
        return np.asarray(table[given[0], 0] if given.size else np.zeros(table.shape[2]))

    def _data(self, table: NDArray[Any]) -> NDArray[Any]:
        """Prescribed entries in the units of the waypoints, 0 where free."""
        scale = _powers(self._units.astype(table.dtype), self._size - 1) * self._sizes[:, None]
        return np.asarray(np.where(self._given[:, :, None], table, 0.0) * scale.T[:, :, None])

    def _restored(self, found: NDArray[Any], offset: Array) -> NDArray[Any]:
        """Entries from those in the units of the waypoints."""
        scale = _powers(self._units.astype(found.dtype), self._size - 1) * self._sizes[:, None]
        entries = found / scale[self.orders, self.nodes, None]
        entries[self.orders == 0] += offset
        return np.asarray(entries)

    @cached_property
    def _sizes(self) -> Array:
        """Scales (size,) of the entries and equations by order, for which the matrix has entries near 1."""
        every, orders = tuple(range(self._size)), np.arange(self._size)
        own = segment_weights(self._alpha, (every, every), self._size)[0, 2 * self._size - 1 - orders, orders]
        return np.sqrt(np.where(own == 0.0, 1.0, np.abs(own)).astype(float))

    def _weights(self, kind: Kind, dtype: Any) -> NDArray[Any]:
        """Conjugate derivatives (2, nrows, nentries) at both ends of a segment, with the signs of a jump, scaled."""
        conjugate = 2 * self._size - 1 - self._free_orders
        weights = segment_weights(self._alpha, kind.ends, self._size)[:, conjugate]
        weights = weights / self._sizes[self._free_orders, None] / self._sizes[kind.orders]
        return np.asarray(weights * np.array([1.0, -1.0])[:, None, None], dtype=dtype)

    @cached_property
    def _terms(self) -> list[tuple[NDArray[Any], ...]]:
        """Weights and factors of each kind of segment."""
        with np.errstate(all="ignore"):
            return self._terms_of(self._durations, self._units)

    def _terms_of(self, durations: NDArray[Any], units: NDArray[Any]) -> list[tuple[NDArray[Any], ...]]:
        return [(self._weights(kind, durations.dtype), *self._factors(kind, durations, units)) for kind in self.kinds]

    def _factors(self, kind: Kind, durations: NDArray[Any], units: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Factors of rows (2, nrows, nsegments) and entries (nentries, nsegments): jumps are in units of waypoints."""
        h = durations[kind.segments]
        at = np.stack([units[end] for end in self._ends_of(kind)])
        conjugate = 2 * self._size - 1 - self._free_orders
        rows, columns = _powers(at / h, 2 * self._size - 1), _powers(h / at, self._size - 1)
        return rows[conjugate].swapaxes(0, 1), columns[kind.orders, kind.sides]

    def _ends_of(self, kind: Kind) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Waypoints at both ends of the segments of a kind."""
        first = np.arange(kind.first, kind.last)
        return first, (first + 1) % self._count

    def _jumps(self, data: NDArray[Any], terms_of: list[tuple[NDArray[Any], ...]]) -> NDArray[Any]:
        """Jumps (nfree, naxes) of the conjugate derivatives of piecewise functions with given entries."""
        naxes = data.shape[2]
        jumps = np.zeros((self._free_orders.size, self._count, naxes), dtype=data.dtype)
        for kind, (weights, rows, columns) in zip(self.kinds, terms_of, strict=True):
            ends = self._ends_of(kind)
            entries = np.stack([data[ends[side], k] for side, k in zip(kind.sides, kind.orders, strict=True)])
            # Positions relative to the start of each segment, whose functions include the constants.
            places = np.flatnonzero(kind.orders == 0)
            if places.size == 2:
                entries[places[1]] -= entries[places[0]]
                entries[places[0]] = 0.0
            entries *= columns[..., None]
            terms = weights.reshape(-1, len(entries)) @ entries.reshape(len(entries), -1)
            terms = terms.reshape(2, -1, len(ends[0]), naxes) * rows[..., None]
            jumps[:, ends[0]] += terms[0]
            jumps[:, ends[1]] += terms[1]
        return np.asarray(jumps[self._row, self.nodes])

    def _assembled(self, durations: Array, units: Array) -> _Banded | None:
        """Band matrix of the equations, factorised; None on overflow."""
        found: list[tuple[Array, ...]] = []
        with np.errstate(all="ignore"):
            terms = self._terms if durations is self._durations else self._terms_of(durations, units)
        for kind, (weights, rows, columns) in zip(self.kinds, terms, strict=True):
            ends = self._ends_of(kind)
            number = [self._number[end[:, None], self._free_orders].T for end in ends]
            for side, r in itertools.product((0, 1), range(self._free_orders.size)):
                for entry, (other, order) in enumerate(zip(kind.sides, kind.orders, strict=True)):
                    column = self._number[ends[other], order]
                    used = (number[side][r] >= 0) & (column >= 0)
                    with np.errstate(all="ignore"):
                        value = weights[side, r, entry] * rows[side, r] * columns[entry]
                    found.append((number[side][r][used], column[used], value[used]))
        row, column, value = (np.concatenate(part) for part in zip(*found, strict=True))
        if not np.isfinite(value).all():
            return None
        # The weights of polynomials are exact.
        amplification = (
            max(_amplification(self._alpha, kind.ends) for kind in self.kinds) if self._alpha else _POLYNOMIAL
        )
        return _Banded(self.nodes.size, row, column, value, amplification)


class _Banded:
    """Factorised band matrix.

    Attributes
    ----------
    condition, loss : float
        Condition number, and the estimated relative error of a solution.
    """

    def __init__(
        self, n: int, row: NDArray[np.intp], column: NDArray[np.intp], value: Array, amplification: float
    ) -> None:
        self._width = width = int(np.abs(row - column).max(initial=0))
        place = (2 * width + row - column) + (3 * width + 1) * column  # LAPACK requires space for the fill-in above
        band = np.bincount(place, value, minlength=(3 * width + 1) * n).reshape(n, -1).T
        norm = float(np.bincount(row, np.abs(value)).max(initial=0.0))
        self._lu, self._pivots, info = lapack.dgbtrf(band, width, width, overwrite_ab=True)
        self.condition = np.inf
        if not info:
            # Solutions for some right sides of size 1 bound the inverse from below, and nearly reach it.
            signs = np.random.default_rng(0).choice([-1.0, 1.0], (n, _RIGHT_SIDES))
            with np.errstate(all="ignore"):
                largest = float(np.abs(self.solve(signs)).max(initial=0.0))
            self.condition = norm * largest if np.isfinite(largest) else np.inf
        self.loss = float(np.finfo(float).eps) * self.condition * amplification

    def solve(self, right: Array) -> Array:
        """Solution (n, naxes)."""
        found, _ = lapack.dgbtrs(self._lu, self._width, self._width, np.asfortranarray(right), self._pivots)
        return np.asarray(found)


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


def _amplification(alpha: float, ends: Ends) -> float:
    return max(1.0, segment_system(alpha, ends).amplification)


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
