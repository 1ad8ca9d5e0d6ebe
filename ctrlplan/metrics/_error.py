"""Integrals of a tracking error."""

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan.metrics._pieces import NOWHERE, Pieces, joined, pieces, squares
from ctrlplan.metrics._records import QUIET, Array, Value, diverged, instant, plain, signal, times


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
    values, near, others = np.full(len(rows), np.inf), [NOWHERE], list[Pieces]()
    begin = -np.inf if since is None else since
    with np.errstate(**QUIET):
        for i, row in enumerate(rows):
            if diverged(row):
                continue
            p = pieces(t, row)
            direct = p.keeps_sign & (p.begin >= begin)
            areas = p.mean if since is None else (p.begin - since) * p.mean + p.step * p.moment
            values[i] = np.sum((p.step * np.abs(areas))[direct])
            others.append(p[~direct])
            near.append(np.full(others[-1].a.size, i))
        if others:
            np.add.at(values, np.concatenate(near), _areas(joined(others), since))
    return plain(values, f.shape[:-1])


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
