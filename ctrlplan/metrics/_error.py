"""Integrals of a tracking error."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan.metrics._pieces import (
    LONG,
    NOWHERE,
    Near,
    Pieces,
    Smooth,
    gathered,
    once,
    pieces,
    places,
    row_blocks,
    squares,
    together,
)
from ctrlplan.metrics._records import HUGE, QUIET, Array, Value, diverged, instant, plain, signal, times

_MANY = 0.1  # share of the intervals above which all cubics of a signal are computed


def iae(timepts: ArrayLike, error: ArrayLike) -> Value:
    r"""Integral of the absolute error.

    .. math:: \int_{t_0}^{t_f} |e(t)|\,dt

    The interpolating cubics are integrated between their zeros: for a smooth signal the error is of fourth order in the
    sample spacing. A jump is placed in the middle of its interval.

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    error : array_like, shape (..., ntime)
        Tracking error, any unit.

    Returns
    -------
    float or ndarray, shape (...)
        In the unit of `error` times s; inf where `error` contains inf.

    Raises
    ------
    ValueError
        If the last axis of `error` differs from ``len(timepts)``, `timepts` does not increase or `error` contains nan.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import iae
    >>> t = np.linspace(0, 2 * np.pi, 201)
    >>> round(iae(t, np.sin(t)), 6)
    4.0
    """
    t = times(timepts)
    e = signal(error, "error", t)
    return _absolute(t, e)


def itae(timepts: ArrayLike, error: ArrayLike, start: float | None = None) -> Value:
    r"""Integral of the absolute error weighted by time.

    .. math:: \int_{t_0}^{t_f} (t - t_0)\,|e(t)|\,dt

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    error : array_like, shape (..., ntime)
        Tracking error, any unit.
    start : float, optional
        The time :math:`t_0` [s]; default: the first sample. Earlier samples are ignored.

    Returns
    -------
    float or ndarray, shape (...)
        In the unit of `error` times s^2; inf where `error` contains inf.

    Raises
    ------
    ValueError
        If the last axis of `error` differs from ``len(timepts)``, `timepts` does not increase, `error` contains nan or
        `start` is after the record.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import itae
    >>> t = np.linspace(0, 2, 21)
    >>> round(itae(t, 1 - t), 6)
    1.0
    """
    t = times(timepts)
    e = signal(error, "error", t)
    since = instant(start, t)
    return _absolute(t, e, since)


def ise(timepts: ArrayLike, error: ArrayLike) -> Value:
    r"""Integral of the squared error.

    .. math:: \int_{t_0}^{t_f} e(t)^2\,dt

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    error : array_like, shape (..., ntime)
        Tracking error, any unit.

    Returns
    -------
    float or ndarray, shape (...)
        In the unit of `error` squared times s; inf where `error` contains inf or its square overflows.

    Raises
    ------
    ValueError
        If the last axis of `error` differs from ``len(timepts)``, `timepts` does not increase or `error` contains nan.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import ise
    >>> t = np.linspace(0, 3, 31)
    >>> round(ise(t, t), 6)
    9.0
    """
    t = times(timepts)
    e = signal(error, "error", t)
    return squared(t, e)


def squared(t: Array, f: Array) -> Value:
    """Return the integrals of f^2, shape (...)."""
    rows = f.reshape(-1, t.size)
    with np.errstate(**QUIET):
        values = squares(t, rows)
        values[[diverged(row) for row in rows]] = np.inf
    return plain(values, f.shape[:-1])


def _absolute(t: Array, f: Array, since: float | None = None) -> Value:
    """Return the integrals of abs(f), shape (...), weighted by the time after `since` if given."""
    rows = f.reshape(-1, t.size)
    with np.errstate(**QUIET):
        if t.size >= LONG and (since is None or since <= t[0]):
            values = once(_LongAreas, t, rows).integrals(since)
            for i in np.flatnonzero(~np.isfinite(values)):  # divided differences may overflow where the signal does not
                values[i : i + 1] = _each_area(t, rows[i : i + 1], since)
        else:
            values = _each_area(t, rows, since)
    return plain(values, f.shape[:-1])


def _each_area(t: Array, rows: Array, since: float | None) -> Array:
    """Return the integrals of several signals (nrows, ntime) from all their cubics."""
    values, left = np.full(len(rows), np.inf), list[NDArray[np.intp]]()
    begin = None if since is None else t[:-1] - since
    for i, row in enumerate(rows):
        others = NOWHERE
        if not diverged(row):
            values[i], others = _known_areas(t, row, begin)
        if others.size > _MANY * t.size:  # whole signals are then faster than windows about the intervals
            values[i] += np.sum(_areas(pieces(t, row)[others], since))
            others = NOWHERE
        left.append(others)
    chosen, of = gathered(left)
    np.add.at(values, of, _areas(pieces(t, rows, chosen, of), since))
    return values


def _known_areas(t: Array, f: Array, begin: Array | None) -> tuple[float, NDArray[np.intp]]:
    """Return the integral over the intervals in which a signal is known to be of one sign, and the other intervals."""
    p = pieces(t, f)
    direct = p.keeps_sign if begin is None else p.keeps_sign & (begin >= 0)
    areas = p.mean if begin is None else begin * p.mean + p.step * p.moment
    return float(np.sum((p.step * np.abs(areas))[direct])), np.flatnonzero(~direct)


class _LongAreas:
    """Integrals of the magnitudes of several long signals (nrows, ntime).

    Inner intervals with smooth curvature that are known to be of one sign are linear in four samples: the integral and
    the first moment are sums. The others are integrated between their zeros.
    """

    def __init__(self, t: Array, f: Array) -> None:
        self._first, self._sums = float(t[0]), np.full((2, len(f)), np.inf)
        smooth, near = Smooth(t), list[Near]()
        early, step = smooth.step[:-2], smooth.step[1:-1]
        cube = step**3
        # Weights of the sum of both ends, of the curvature and of the third difference in the integral, and of the
        # integral, the slope and the third difference in the first moment.
        weights = step / 2, cube / 6, (2 * early + step) * cube / 12
        levers = t[1:-2] + step / 2 - t[0], cube / 12, cube * step**2 / 120
        for some in row_blocks(f):
            infinite = ~(np.abs(f[some]).max(axis=1) < HUGE)
            rows = np.where(infinite[:, None], 0.0, f[some]) if infinite.any() else f[some]
            slope, d, third, known = found = smooth.differences(rows)
            others = places(~(known & smooth.keeps_sign(rows, d)))
            near.append(smooth.near(rows, found, others, some.start))
            areas = weights[0] * (rows[:, 1:-2] + rows[:, 2:-1]) - weights[1] * d[:, :-1] - weights[2] * third
            moments = levers[0] * areas + levers[1] * slope[:, 1:-1] - levers[2] * third
            areas[others] = moments[others] = 0.0
            sums = np.abs(areas).sum(axis=1), np.abs(moments).sum(axis=1)
            self._sums[:, some] = np.where(infinite, np.inf, sums)
        inner = together(near)
        ends, rows = np.tile([0, t.size - 2], len(f)), np.arange(len(f)).repeat(2)
        self._others = [(inner[0], *_split(smooth.pieces(inner))), (rows, *_split(pieces(t, f, ends, rows)))]

    def integrals(self, since: float | None) -> Array:
        """Return the integrals, weighted by the time after `since`, not after the first sample, if given."""
        areas, moments = self._sums
        found = areas.copy() if since is None else moments + (self._first - since) * areas
        for rows, mixed, parts in self._others:
            more = np.empty(rows.size)
            for chosen, (p, cuts) in zip((mixed, ~mixed), parts, strict=True):
                more[chosen] = _weighted(p, cuts, since)
            np.add.at(found, rows, more)
        return found


def _split(p: Pieces) -> tuple[NDArray[np.bool_], list[tuple[Pieces, Array]]]:
    """Return which cubics have values of both signs, and these and the others with cuts between which they have one."""
    crossed, others = p[p.mixed], p[~p.mixed]
    return p.mixed, [(crossed, crossed.splits), (others, others.whole())]


def _areas(p: Pieces, since: float | None) -> Array:
    """Return the same integrals of each interval, shape (m,), by quadrature between its zeros."""
    mixed, parts = _split(p)
    areas = np.empty(mixed.size)
    for chosen, (some, cuts) in zip((mixed, ~mixed), parts, strict=True):
        areas[chosen] = _weighted(some, cuts, since)
    return areas


def _weighted(p: Pieces, cuts: Array, since: float | None) -> Array:
    if since is None:
        return p.integrals(cuts, lambda s: np.abs(p.held(s)))
    cuts = np.maximum(cuts, np.clip((since - p.begin) / p.step, 0.0, 1.0))
    return p.integrals(cuts, lambda s: (p.time(s) - since) * np.abs(p.held(s)))
