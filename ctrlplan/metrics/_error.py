"""Integrals of a tracking error."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan.metrics._pieces import LONG, NOWHERE, Pieces, Smooth, gathered, pieces, squares
from ctrlplan.metrics._records import QUIET, Array, Value, diverged, instant, plain, signal, times

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
    values, left = np.full(len(rows), np.inf), list[NDArray[np.intp]]()
    begin = None if since is None else t[:-1] - since
    smooth = Smooth(t) if t.size >= LONG else None
    with np.errstate(**QUIET):
        for i, row in enumerate(rows):
            others = NOWHERE
            if not diverged(row):
                values[i], others = _known_areas(t, row, begin) if smooth is None else _smooth_areas(smooth, row, begin)
            if others.size > _MANY * t.size:  # whole signals are then faster than windows about the intervals
                values[i] += np.sum(_areas(pieces(t, row)[others], since))
                others = NOWHERE
            left.append(others)
        chosen, of = gathered(left)
        np.add.at(values, of, _areas(pieces(t, rows, chosen, of), since))
    return plain(values, f.shape[:-1])


def _known_areas(t: Array, f: Array, begin: Array | None) -> tuple[float, NDArray[np.intp]]:
    """Return the integral over the intervals in which a signal is known to be of one sign, and the other intervals."""
    p = pieces(t, f)
    direct = p.keeps_sign if begin is None else p.keeps_sign & (begin >= 0)
    areas = p.mean if begin is None else begin * p.mean + p.step * p.moment
    return float(np.sum((p.step * np.abs(areas))[direct])), np.flatnonzero(~direct)


def _smooth_areas(smooth: Smooth, f: Array, begin: Array | None) -> tuple[float, NDArray[np.intp]]:
    """Return the same for a long signal, with sign and smooth curvature known."""
    areas, known = smooth.areas(f, begin)
    return float(np.abs(areas[known]).sum()), np.concatenate([[0], np.flatnonzero(~known) + 1, [f.size - 2]])


def _areas(p: Pieces, since: float | None) -> Array:
    """Return the same integrals of each interval, shape (m,), by quadrature between its zeros."""
    mixed, areas = p.mixed, np.empty(p.a.size)
    crossed, others = p[mixed], p[~mixed]
    areas[~mixed] = _weighted(others, others.whole(), since)
    areas[mixed] = _weighted(crossed, crossed.splits, since)
    return areas


def _weighted(p: Pieces, cuts: Array, since: float | None) -> Array:
    if since is None:
        return p.integrals(cuts, lambda s: np.abs(p.held(s)))
    cuts = np.maximum(cuts, np.clip((since - p.begin) / p.step, 0.0, 1.0))
    return p.integrals(cuts, lambda s: (p.time(s) - since) * np.abs(p.held(s)))
