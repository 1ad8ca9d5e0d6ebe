"""Extrema and certified bounds over whole intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import lru_cache
from threading import RLock
from typing import TYPE_CHECKING, NoReturn
from weakref import finalize

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from ctrlplan.trajectories.batches import inner_extrema
from ctrlplan.trajectories.chebyshev import chebyshev_proxy, fit, points, roots_of_rows, transform
from ctrlplan.trajectories.common import Array, readonly
from ctrlplan.trajectories.piecewise_extrema import Places

if TYPE_CHECKING:
    from ctrlplan.trajectories.continuity import Jump
    from ctrlplan.trajectories.trajectory import Trajectory

TOLERANCE = 1e-9
"""Error of an extremum of a function of the jet, relative to the function's largest magnitude."""

_SAMPLES = 8192  # minimum number of times at which such a function is evaluated

_MAX_PIECES = 20_000
_CHUNK = 256  # pieces that are evaluated together
_DEEPEST = 50  # number of halvings of a segment to the resolution of floating-point times
_FIT = 32  # degree of an interpolant
_CHECKS = 8  # minimum number of check points of a piece, none of them a node of its interpolant
_ROUNDING = 8.0 * float(np.finfo(float).eps)
_NEGLIGIBLE = (
    1e-4 * TOLERANCE
)  # sum of terms of an interpolant, relative to the magnitude, without which extrema are sought
_PROPORTIONAL = 1e-13  # difference of intervals of two plans of the same shape, relative to them
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class Extrema:
    """Minimum and maximum values and the times of both.

    Attributes
    ----------
    minimum, maximum : ndarray, shape (naxes,)
        Values.
    time_min, time_max : ndarray, shape (naxes,)
        Earliest times [s] at which they are attained.
    """

    minimum: Array
    maximum: Array
    time_min: Array
    time_max: Array


@dataclass(frozen=True)
class Bounds:
    """Certified bounds of a function over a plan.

    Attributes
    ----------
    lower, upper : float
        Bounds of every value over the whole interval.
    minimum, maximum : float
        Attained values, within the bounds.
    time_min, time_max : float
        Times [s] of `minimum` and `maximum`.
    """

    lower: float
    upper: float
    minimum: float
    maximum: float
    time_min: float
    time_max: float


@dataclass(frozen=True)
class Known:
    """Results of searches for a plan, which is immutable.

    Attributes
    ----------
    extrema : dict
        Extrema of derivatives by order.
    places : dict
        Candidates for extrema by order and segment, relative to the duration of the
        segment.
    exact : set
        Orders and segments whose candidates need no Newton step.
    together : dict
        Segments and candidates in them by order, of all segments, relative as well.
    jumps : dict
        Jumps of derivatives by the highest order considered.
    lock : context manager
        Held by the thread that searches extrema of the plan.
    """

    extrema: dict[int, Extrema] = field(default_factory=dict)
    places: dict[tuple[int, int], Array] = field(default_factory=dict)
    exact: set[tuple[int, int]] = field(default_factory=set)
    together: dict[int, Places] = field(default_factory=dict)
    jumps: dict[int, tuple[Jump, ...]] = field(default_factory=dict)
    lock: AbstractContextManager[object] = field(default_factory=RLock)


_KNOWN: dict[int, Known] = {}
"""Known results by the identity of a plan, as long as it exists."""


def known_results(plan: Trajectory) -> Known:
    """Known results of a plan."""
    key = id(plan)
    if key not in _KNOWN:
        finalize(plan, _KNOWN.pop, key, None).atexit = False
    return _KNOWN.setdefault(key, Known())


def keep_places(plan: Trajectory, moved: Trajectory, times: Array, moved_times: Array) -> None:
    """Keep the places of extrema of a plan for the same path at other times, where values are computed again.

    Parameters
    ----------
    plan, moved : Trajectory
        The plan, and the same at other times.
    times, moved_times : ndarray, shape (ntimes,)
        Times [s] that determine the shape of either: waypoints or breakpoints. With
        equal proportions the places are the same up to rounding.
    """
    known, own = known_results(plan), known_results(moved)
    own.places.update(known.places)
    if times.size < 2:
        return
    lengths, moved_lengths = np.diff(times), np.diff(moved_times)
    rate = (moved_times[-1] - moved_times[0]) / (times[-1] - times[0])
    if (np.abs(moved_lengths - rate * lengths) <= _PROPORTIONAL * moved_lengths).all():
        own.exact.update(known.places)
        own.together.update(known.together)


def derivative_extrema(plan: Trajectory, nu: int) -> Extrema:
    """Extrema of the nu-th derivative, axis by axis; computed once for a plan, returned as the caller's own."""
    known = known_results(plan)
    if nu not in known.extrema:
        with known.lock:  # places that another thread has just found would be taken for those of a similar plan
            if nu not in known.extrema:
                known.extrema[nu] = _derivative_extrema(plan, nu)
    own = known.extrema[nu]
    return Extrema(own.minimum.copy(), own.maximum.copy(), own.time_min.copy(), own.time_max.copy())


def carry_extrema(plan: Trajectory, moved: Trajectory, rate: float) -> None:
    """Keep the known extrema of a plan for the same plan at other times, whose rate is `rate`."""
    known = known_results(moved).extrema
    for nu, own in known_results(plan).extrema.items():
        with np.errstate(over="ignore", under="ignore"):
            low, high = own.minimum * rate**nu, own.maximum * rate**nu
        sizes = np.abs(np.concatenate([low, high]))
        if np.isfinite(sizes).all() and (sizes[sizes > 0.0] > _TINY).all():
            earliest, latest = (
                np.where(
                    t == plan.end, moved.end, np.clip(moved.start + (t - plan.start) / rate, moved.start, moved.end)
                )
                for t in (own.time_min, own.time_max)
            )
            known[nu] = Extrema(low, high, earliest, latest)


def search_extrema(plan: Trajectory, orders: Iterable[int]) -> None:
    """Search extrema of several derivatives together, for `derivative_extrema`, if places of all segments are known.

    All of them are evaluated at the stationary points of each.
    """
    known = known_results(plan)
    with known.lock:
        missing = [nu for nu in orders if nu and nu not in known.extrema]
        places = [] if plan.in_batches else [_stationary_places(plan, nu) for nu in missing]
        found = [own for own in places if own is not None]
        if missing and len(found) == len(missing):
            segments, s = (np.concatenate(rows) for rows in zip(*found, strict=True))
            values = _Candidates()
            _add_at_places(plan, missing, (segments, s), values)
            both = values.extrema()
            columns = (both.minimum, both.maximum, both.time_min, both.time_max)
            for nu, *rows in zip(missing, *(column.reshape(len(missing), -1) for column in columns), strict=True):
                known.extrema[nu] = Extrema(*rows)


def _derivative_extrema(plan: Trajectory, nu: int) -> Extrema:
    found = _Candidates()
    if nu == 0 or plan.breakpoints.size == 1:
        held = np.zeros((2, plan.naxes)) if nu else np.stack([plan.initial, plan.final])
        found.add(np.array([plan.start, plan.end]), held.T, (plan.start, plan.end))
    places = None if plan.in_batches else _stationary_places(plan, nu)
    if places is not None:
        _add_at_places(plan, [nu], places, found)
    elif plan.in_batches:
        _search_together(plan, nu, found)
    else:
        for segment in range(plan.breakpoints.size - 1):
            _search(plan, nu, segment, found)
    return found.extrema()


def _stationary_places(plan: Trajectory, nu: int) -> Places | None:
    """Stationary points of all segments, as `Trajectory.stationary_places`, or kept ones."""
    known = known_results(plan).together
    if nu in known:
        segments, shares = known[nu]
        return segments, shares * (plan.breakpoints[1:] - plan.breakpoints[:-1])[segments]
    places = plan.stationary_places(nu)
    if places is not None:
        known[nu] = (places[0], places[1] / (plan.breakpoints[1:] - plan.breakpoints[:-1])[places[0]])
    return places


def _search(plan: Trajectory, nu: int, segment: int, found: _Candidates) -> None:
    """Add the candidates of a segment."""

    def jet(t: Array, order: int) -> Array:
        return plan.segment_jet(segment, t, order)

    duration = float(plan.breakpoints[segment + 1] - plan.breakpoints[segment])
    known, key = known_results(plan), (nu, segment)
    places = known.places
    if key in known.exact:
        t = places[key] * duration
    elif key in places:
        t = places[key] * duration
        t = _in_order(np.append(t, _polished(jet, t, nu, duration)), duration)
    else:
        t = stationary_times(jet, duration, nu)
        places[key] = t / duration
    times, ends = _placed(plan, segment, t)
    found.add(times, jet(t, nu)[nu], ends)


def _add_at_places(plan: Trajectory, orders: Sequence[int], places: Places, found: _Candidates) -> None:
    """Add derivatives of some orders at the ends of all segments, and at places in them."""
    (segments, s), times = places, plan.breakpoints
    count = times.size - 1
    every = np.concatenate([np.arange(count), np.arange(count), segments])
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        jets = plan.segments_jet(every, np.concatenate([np.zeros(count), times[1:] - times[:-1], s]), max(orders))
    values = (jets[orders[0]] if len(orders) == 1 else jets[orders]).reshape(-1, every.size)
    starts, ends = times[segments], times[segments + 1]
    found.add_ends(np.concatenate([times[:-1], times[1:]]), values[:, : 2 * count])
    found.add_inner(np.minimum(starts + s, np.nextafter(ends, starts)), values[:, 2 * count :])


def _search_together(plan: Trajectory, nu: int, found: _Candidates) -> None:
    """Add the ends of all segments, and extrema of interpolants, whose places depend on the values at the ends."""
    times, count = plan.breakpoints, plan.breakpoints.size - 1
    every, lengths = np.tile(np.arange(count), 2), np.append(np.zeros(count), np.diff(times))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        values = plan.segments_jet(every, lengths, nu)[nu]
        found.add_ends(np.append(times[:-1], times[1:]), values)
        segments, s = _with_polished(plan, nu, *inner_extrema(plan, nu, values.min(axis=1), values.max(axis=1)))
        values = plan.segments_jet(segments, s, nu)[nu]
    starts, ends = times[segments], times[segments + 1]
    found.add_inner(np.clip(starts + s, starts, np.nextafter(ends, starts)), values)


def _with_polished(plan: Trajectory, nu: int, segments: NDArray[np.intp], s: Array) -> Places:
    """Places, and those after a Newton step; as `_polished`."""
    slope, curve = plan.segments_jet(segments, s, nu + 2)[nu + 1 :]
    moved, duration = s - slope / curve, np.diff(plan.breakpoints)[segments]
    near = np.isfinite(moved) & (np.abs(moved - s) < 1e-6 * duration) & (moved >= 0.0) & (moved <= duration)
    return np.concatenate([segments, *(segments[row] for row in near)]), np.concatenate([s, moved[near]])


def stationary_times(jet: Callable[[Array, int], Array], duration: float, nu: int) -> Array:
    """Candidate times in [0, duration] for extrema of a derivative of an analytic function.

    Parameters
    ----------
    jet : callable
        Maps times (ntime,) and an order to (order + 1, naxes, ntime).
    duration : float
        Length of the interval [s].
    nu : int
        Order of the derivative.

    Returns
    -------
    ndarray, shape (ncandidates,)
        Both ends and, for every axis, the stationary points; increasing.
    """
    times = [np.array([0.0, duration])]
    for left, right, slopes in _pieces(jet, 0.0, duration, nu + 1):
        times.append(0.5 * (left + right) + 0.5 * (right - left) * roots_of_rows(slopes)[1])
    return _in_order(np.concatenate(times), duration)


def _in_order(t: Array, duration: float) -> Array:
    """Candidate times, increasing; those within rounding of an end are that end."""
    t[t < 1e-12 * duration] = 0.0
    t[t > (1.0 - 1e-12) * duration] = duration
    return np.unique(t)


def function_extrema(
    plan: Trajectory, function: Callable[[Array], Array], order: int, scale: ArrayLike = 0.0
) -> Extrema:
    """Extrema of a function of the jet, to `TOLERANCE` of its largest magnitude or of a scale.

    The function is evaluated at 8192 times of the plan: 8192/n, and at least 64,
    for each of n segments. A feature between these times, such as a shorter
    pulse, is missed.

    Parameters
    ----------
    plan : Trajectory
        A plan with a duration.
    function : callable
        Maps a jet (order + 1, naxes, ntime) to (ntime,) or (m, ntime).
    order : int
        Highest derivative that `function` uses.
    scale : array_like, broadcasts to (m,), optional
        Minimum scale of the relative tolerance.

    Returns
    -------
    Extrema
        Each entry of shape (m,).

    Raises
    ------
    ValueError
        If the function is not finite over the plan, or does not return one
        value for each time.
    RuntimeError
        If the function is not resolved with `_MAX_PIECES` pieces.
    """
    search = _Search(plan, function, order, np.asarray(scale, dtype=float))
    for samples in search.samples:
        search.bisect(samples)
    return search.found.extrema()


@dataclass(frozen=True)
class _Samples:
    """Values of a function at times in segments that have the same number of them.

    Attributes
    ----------
    segments : ndarray of int, shape (nsegments,)
        Numbers of the segments.
    count : int
        Number of times in each segment.
    values : ndarray, shape (nrows, nsegments, count)
        Values.
    """

    segments: NDArray[np.intp]
    count: int
    values: Array


class _Search:
    """Bisection of segments until a function of the jet is resolved near its extrema.

    A piece is resolved where the Chebyshev interpolant agrees with the function
    at check points; where the function varies by less than the tolerance (about a
    kink); or at the resolution of floating-point times (at a jump). A piece is
    skipped if its values differ from the extrema found so far by more than
    their own range. Pieces of many segments are evaluated together.
    """

    def __init__(self, plan: Trajectory, function: Callable[[Array], Array], order: int, scale: Array) -> None:
        self.found = _Candidates()
        self._plan, self._function, self._order, self._scale = plan, function, order, scale
        self._starts, self._durations = _searchable_segments(plan)
        self._spent = 0
        self._low, self._high = np.array(np.inf), np.array(-np.inf)
        self._best: dict[tuple[int, float], tuple[int, float, float]] = {}  # segment, time and value by row and sign
        shares = np.maximum(self._durations / plan.duration, 1.0 / self._durations.size)
        counts = 2 ** np.ceil(np.log2(np.maximum(_SAMPLES * shares, 64.0))).astype(int)
        self.samples = [self._sampled(np.flatnonzero(counts == count), count) for count in np.unique(counts).tolist()]

    def _sampled(self, segments: NDArray[np.intp], count: int) -> _Samples:
        """Samples of segments, whose ends are evaluated as well."""
        durations = self._durations[segments, None]
        times = np.concatenate([durations * _between(count), 0.0 * durations, durations], axis=1)
        every, t = np.repeat(segments, count + 2), times.ravel()
        chunks = -(-t.size // 4096)  # fit into the cache
        pairs = zip(np.array_split(every, chunks), np.array_split(t, chunks), strict=True)
        rows = np.concatenate([self._values(*pair) for pair in pairs], axis=1)
        self._keep_best(every, t, rows)
        self._low, self._high = np.minimum(self._low, rows.min(axis=1)), np.maximum(self._high, rows.max(axis=1))
        return _Samples(segments, count, rows.reshape(len(rows), segments.size, -1)[..., :-2])

    def bisect(self, samples: _Samples) -> None:
        """Add the candidate times of segments to the results."""
        place = np.arange(samples.segments.size)
        index = np.zeros(place.size, dtype=np.int64)
        level = 0
        while index.size:
            self._spent += index.size
            chunks = [slice(k, k + _CHUNK) for k in range(0, index.size, _CHUNK)]
            parts = [self._pieces(samples, level, place[chunk], index[chunk]) for chunk in chunks]
            again = np.concatenate([split for split, _ in parts])
            if again.any() and self._spent + 2 * int(again.sum()) > _MAX_PIECES:
                own = samples.segments[place[again]]
                first = own == own[0]
                self._raise_unresolved(int(own[0]), level, index[again][first], max(rest for _, rest in parts))
            place = np.repeat(place[again], 2)
            index = (2 * index[again, None] + np.arange(2)).ravel()
            level += 1

    def _pieces(
        self, samples: _Samples, level: int, place: NDArray[np.intp], index: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], float]:
        """Which pieces of a level, of segments at places in `samples`, must be bisected; maximum unresolved error."""
        segments, count = samples.segments[place], samples.count >> level
        durations = self._durations[segments]
        widths = np.ldexp(durations, -level)
        own = _SHARES if count >= _CHECKS else np.append(_SHARES, _between(_CHECKS))
        times = np.minimum(widths[:, None] * (index[:, None] + own), durations[:, None])
        every = np.repeat(segments, own.size)
        found = self._values(every, times.ravel())
        self._keep_best(every, times.ravel(), found)
        values = found.reshape(len(found), *times.shape)
        series = transform(values[..., : _FIT + 1])
        missed = np.abs(series @ _ENDS - values[..., _FIT + 1 : _FIT + 3]).max(axis=2)
        missed = np.maximum(missed, np.abs(series[..., -8:]).max(axis=2))
        checks = values[..., _SHARES.size :]
        if checks.size:
            missed = np.maximum(missed, np.abs(series @ _basis(_CHECKS) - checks).max(axis=2))
        if count:  # samples of the piece, which may show features that its check points miss
            seen = samples.values.reshape(*samples.values.shape[:2], -1, count)[:, place, index]
            missed = np.maximum(missed, np.abs(series @ _basis(count) - seen).max(axis=2))
            checks = np.concatenate([checks, seen], axis=2)

        low = np.minimum(values.min(axis=2), checks.min(axis=2))
        high = np.maximum(values.max(axis=2), checks.max(axis=2))
        for (row, _), (segment, instant, value) in self._best.items():  # a piece too short for a sample
            (near,) = np.nonzero((segments == segment) & (index >= np.floor(instant / widths)))
            k = int(near[0]) if near.size else -1
            if k >= 0 and 0.0 <= (part := instant / widths[k] - index[k]) <= 1.0:
                miss = abs(float(chebyshev.chebval(2.0 * part - 1.0, series[row, k])) - value)
                missed[row, k] = max(missed[row, k], miss)
                low[row, k], high[row, k] = min(low[row, k], value), max(high[row, k], value)
        self._low, self._high = np.minimum(self._low, low.min(axis=1)), np.maximum(self._high, high.max(axis=1))
        magnitude = np.maximum(np.maximum(np.abs(self._low), np.abs(self._high)), self._scale)
        scale = np.maximum(magnitude, _TINY)[:, None]
        reach = high - low + 4.0 * missed + _ROUNDING * scale
        matters = (high + reach >= self._high[:, None]) | (low - reach <= self._low[:, None])

        # For a smooth function the error of its value at a root of the interpolant's slope is the square of this.
        rest = missed / scale
        smooth = rest <= 0.1 * TOLERANCE
        flat = high - low <= 0.1 * TOLERANCE * scale
        short = level >= _DEEPEST
        split = (matters & ~(smooth | flat | short)).any(axis=0)
        self._add(segments, times, series, matters & ~split, smooth, scale)
        return split, float(rest[:, split].max(initial=0.0))

    def _add(
        self,
        segments: NDArray[np.intp],
        times: Array,
        series: Array,
        chosen: NDArray[np.bool_],
        smooth: NDArray[np.bool_],
        scale: Array,
    ) -> None:
        """Add the candidates of pieces, at `times`, for the rows `chosen`: their ends and the roots of the slopes."""
        pieces = np.flatnonzero(chosen.any(axis=0))
        rows, of_smooth = np.nonzero(chosen & smooth)
        which, roots = roots_of_rows(_slopes(series[rows, of_smooth], scale[rows]))
        at_roots = of_smooth[which]
        first, last = times[:, _FIT + 1], times[:, _FIT + 2]
        whole = np.flatnonzero((chosen & ~smooth).any(axis=0))
        every = np.concatenate([pieces, pieces, at_roots, np.repeat(whole, times.shape[1])])
        inner = first[at_roots] + 0.5 * (1.0 + roots) * (last - first)[at_roots]
        t = np.concatenate([first[pieces], last[pieces], inner, times[whole].ravel()])
        if t.size:
            self._add_at(segments[every], t, self._values(segments[every], t))

    def _add_at(self, segments: NDArray[np.intp], t: Array, values: Array) -> None:
        """Add values (nrows, ntime) at times from the beginnings of segments."""
        left, right = self._plan.breakpoints[segments], self._plan.breakpoints[segments + 1]
        times = np.where(t < right - left, np.minimum(left + t, np.nextafter(right, left)), right)
        self.found.add(times, values, (left, right))

    def _keep_best(self, segments: NDArray[np.intp], t: Array, values: Array) -> None:
        """Add times at which a row exceeds all previous values as candidates: the roots nearby may not reach it."""
        for sign, seen in ((-1.0, self._low), (1.0, self._high)):
            best = (sign * values).argmax(axis=1)
            for row in np.flatnonzero((sign * values).max(axis=1) > sign * seen).tolist():
                at = best[row : row + 1]
                self._best[row, sign] = (int(segments[at[0]]), float(t[at[0]]), float(values[row, at[0]]))
                self._add_at(segments[at], t[at], values[:, at])

    def _values(self, segments: NDArray[np.intp], t: Array) -> Array:
        """Values (nrows, ntime) of the function at times from the beginnings of segments."""
        one = self._durations.size == 1
        jet = self._plan.segment_jet(0, t, self._order) if one else self._plan.segments_jet(segments, t, self._order)
        values = np.atleast_2d(np.asarray(self._function(jet), dtype=float))
        if values.ndim != 2 or values.shape[1] != t.size:
            raise ValueError(f"function must return values of shape (ntime,) or (m, ntime), got shape {values.shape}")
        if not np.isfinite(values).all():
            bad = int((~np.isfinite(values).all(axis=0)).argmax())
            origin, duration = self._starts[segments[bad]], self._durations[segments[bad]]
            where = f"between {origin:g} and {origin + duration:g} s, such as at {origin + t[bad]:g} s"
            raise ValueError(f"function must be finite over the plan, got nan or inf {where}")
        return values

    def _raise_unresolved(self, segment: int, level: int, index: NDArray[np.int64], rest: float) -> NoReturn:
        origin, duration = float(self._starts[segment]), float(self._durations[segment])
        left, right = (origin + math.ldexp(duration, -level) * (k + i) for i, k in enumerate((index[0], index[-1])))
        raise RuntimeError(
            f"function must be resolved to {TOLERANCE:g} of its largest magnitude, got {rest:.2g} "
            f"between {left:g} and {right:g} s after {_MAX_PIECES} pieces: it is noisy or oscillates there; "
            f"smooth it, or use `bounds`, which requires a Lipschitz constant"
        )


def certified_bounds(
    plan: Trajectory,
    function: Callable[[Array], Array],
    order: int,
    lipschitz: ArrayLike,
    rtol: float,
    max_cells: int,
) -> Bounds:
    """Bounds by refinement of cells until the Lipschitz bound reaches the tolerance."""
    durations = _searchable_segments(plan)[1].tolist()
    weights = _weights(lipschitz, order + 1, plan.naxes)
    if not rtol > 0.0:
        raise ValueError(f"rtol must be above 0, got {rtol}")
    first, second = (np.stack([plan.peak(k + nu) for k in range(order + 1)])[:, :, None] for nu in (1, 2))
    found, lower, upper = _Candidates(), np.inf, -np.inf
    minimum, maximum = np.inf, -np.inf
    for segment, duration in enumerate(durations):
        s = np.linspace(0.0, duration, 129)
        values = _evaluated(function, plan.segment_jet(segment, s, order))
        found.add(_placed(plan, segment, s)[0], values[None])
        minimum, maximum = min(minimum, float(values.min())), max(maximum, float(values.max()))
    for segment, duration in enumerate(durations):
        radius, spent = duration / 256, 0
        centres = duration * (np.arange(128) + 0.5) / 128
        while centres.size:
            spent += centres.size
            if spent > max_cells:
                raise ValueError(f"rtol = {rtol:g} must be reached within {max_cells} cells; raise either of them")
            jet = plan.segment_jet(segment, centres, order + 1)
            values = _evaluated(function, jet[:-1])
            # Within a cell the change of a derivative is bounded by the next one's value at the centre and its slope.
            slope = np.minimum(first, np.abs(jet[1:]) + radius * second)
            reach = radius * np.sum(weights * slope, axis=(0, 1))
            found.add(_placed(plan, segment, centres)[0], values[None])
            minimum, maximum = min(minimum, float(values.min())), max(maximum, float(values.max()))
            gap = rtol * (maximum - minimum)
            undecided = (values - reach < minimum - gap) | (values + reach > maximum + gap)
            undecided &= reach > gap
            if not undecided.all():
                lower = min(lower, float((values - reach)[~undecided].min()))
                upper = max(upper, float((values + reach)[~undecided].max()))
            radius *= 0.5
            centres = (centres[undecided, None] + np.array([-radius, radius])).ravel()
    best = found.extrema()
    # The terms of the function are rounded, and may cancel in its values.
    terms = float(np.sum(weights[:, :, 0] * np.stack([plan.peak(k) for k in range(order + 1)])))
    rounding = _ROUNDING * (max(abs(minimum), abs(maximum)) + terms)
    return Bounds(
        lower - rounding,
        upper + rounding,
        *(float(v[0]) for v in (best.minimum, best.maximum, best.time_min, best.time_max)),
    )


def _weights(lipschitz: ArrayLike, norders: int, naxes: int) -> Array:
    """Lipschitz constants (norders, naxes, 1) by derivative and axis."""
    try:
        weights = np.broadcast_to(np.asarray(lipschitz, dtype=float), (norders, naxes))[:, :, None]
    except ValueError:
        shape = f"({norders}, {naxes})"
        raise ValueError(f"lipschitz must broadcast to shape {shape}, got shape {np.shape(lipschitz)}") from None
    if not (np.isfinite(weights).all() and np.all(weights >= 0.0)):
        raise ValueError(f"lipschitz must be finite and at least 0, got {lipschitz!r}")
    return weights


def _evaluated(function: Callable[[Array], Array], jet: Array) -> Array:
    """Values (ntime,) of a function of the jet."""
    values = np.asarray(function(jet), dtype=float)
    if values.shape != jet.shape[2:]:
        raise ValueError(f"function must return one value per time, shape {jet.shape[2:]}, got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError("function must be finite over the plan, got nan or inf")
    return values


def _slopes(series: Array, scale: Array) -> Array:
    """Derivatives of Chebyshev series (nrows, size) without the last terms, if negligible next to scales (nrows, 1).

    Only the value at a root matters, and the time for the roots grows with the cube of the degree.
    """
    last = np.abs(series[:, ::-1]).cumsum(axis=1)[:, ::-1]
    return np.asarray(chebyshev.chebder(np.where(last > _NEGLIGIBLE * scale, series, 0.0), axis=1))


_SHARES = readonly(np.append(points(_FIT, 0.0, 1.0), [0.0, 1.0]))
_ENDS = chebyshev.chebvander(np.array([-1.0, 1.0]), _FIT).T


@lru_cache(maxsize=16)
def _between(count: int) -> Array:
    """Relative positions in an interval: even spacing that coincides with no other grid."""
    return readonly(np.asarray((np.arange(count) + 0.5 * (math.sqrt(5.0) - 1.0)) / count))


@lru_cache(maxsize=16)
def _basis(count: int) -> Array:
    """Chebyshev polynomials (degree + 1, ntime) at the points of `_between`."""
    return readonly(np.asarray(chebyshev.chebvander(2.0 * _between(count) - 1.0, _FIT).T, dtype=float))


class _Candidates:
    """Minimum and maximum of the values so far, one row per axis."""

    def __init__(self) -> None:
        self.times: list[Array] = []
        self.values: list[Array] = []
        self.ends: list[Array] = []

    def add(self, t: Array, values: Array, ends: tuple[float, float] | tuple[Array, Array] = (np.nan, np.nan)) -> None:
        """Add values (naxes, ntime); the `ends` of a segment take precedence in a tie."""
        self.times.append(t)
        self.values.append(values)
        self.ends.append(np.where((t == ends[0]) | (t == ends[1]), 1.0, 0.0))

    def add_ends(self, t: Array, values: Array) -> None:
        """Add values (naxes, ntime) at ends of segments."""
        self.times.append(t)
        self.values.append(values)
        self.ends.append(np.ones(t.size))

    def add_inner(self, t: Array, values: Array) -> None:
        """Add values (naxes, ntime) between the ends of segments."""
        self.times.append(t)
        self.values.append(values)
        self.ends.append(np.zeros(t.size))

    def extrema(self) -> Extrema:
        """The extrema, up to rounding: preferably at an end, then the earliest."""
        t, values, ends = np.concatenate(self.times), np.concatenate(self.values, axis=1), np.concatenate(self.ends)
        by_time = t.argsort(kind="stable")
        t, values, rank = t[by_time], values[:, by_time], 1.0 + ends[by_time]
        both = np.stack([values, -values])  # the minimum of each is sought
        lowest = both.min(axis=2)
        slack = _ROUNDING * np.abs(lowest).max(axis=0)
        low, high = ((both <= (lowest + slack)[:, :, None]) * rank).argmax(axis=2)
        rows = np.arange(len(values))
        return Extrema(values[rows, low], values[rows, high], t[low], t[high])


def _placed(plan: Trajectory, segment: int, t: Array) -> tuple[Array, tuple[float, float]]:
    """Times of a plan from those of a segment, clipped to the ends of the segment, and these ends."""
    left, right = plan.breakpoints[segment : segment + 2].tolist()
    times = np.where(t < right - left, np.minimum(left + t, math.nextafter(right, left)), right)
    return times, (left, right)


def _searchable_segments(plan: Trajectory) -> tuple[Array, Array]:
    """Starts and durations [s] (nsegments,) of the segments."""
    if plan.breakpoints.size < 2:
        raise ValueError("a trajectory must have a duration to be searched for extrema, got a step")
    return plan.breakpoints[:-1], np.diff(plan.breakpoints)


def _pieces(
    jet: Callable[[Array, int], Array], a: float, b: float, nu: int, depth: int = 6
) -> list[tuple[float, float, Array]]:
    """Intervals with Chebyshev coefficients (naxes, size) of the nu-th derivative."""
    proxy = chebyshev_proxy(jet, (a, b), nu, nu)
    if proxy is not None:
        return [(a, b, proxy[0])]
    if not depth:  # at this depth the remaining error is rounding
        return [(a, b, fit(lambda t: jet(t, nu)[nu], (a, b), 32))]
    middle = 0.5 * (a + b)
    return _pieces(jet, a, middle, nu, depth - 1) + _pieces(jet, middle, b, nu, depth - 1)


def _polished(jet: Callable[[Array, int], Array], t: Array, nu: int, duration: float) -> Array:
    """One Newton step on y^(nu + 1) for every axis from every candidate, accepted if it is small."""
    slope, curve = jet(t, nu + 2)[nu + 1 :]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        moved = t - slope / curve
    near = np.isfinite(moved) & (np.abs(moved - t) < 1e-6 * duration) & (moved >= 0.0) & (moved <= duration)
    return moved[near]
