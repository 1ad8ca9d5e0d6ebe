"""Integrals of a tracking error."""

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan.metrics._evaluation import Evaluation, Later, evaluated
from ctrlplan.metrics._pieces import cubics
from ctrlplan.metrics._records import HUGE, QUIET, Array, Value, instant, plain, signal, times


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
    return evaluated(absolute, t, e, "error")


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
    if since > t[0]:
        return _areas_after(t, e, since)
    return evaluated(lambda evaluation, rows: absolute(evaluation, rows, since), t, e, "error")


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
    return squared(t, signal(error, "error", t), "error")


def squared(t: Array, f: Array, name: str) -> Value:
    """Return the integrals of f^2, shape (...); messages call the signal `name`."""
    return evaluated(Evaluation.squares, t, f, name)


def absolute(evaluation: Evaluation, rows: slice, since: float | None = None) -> Later:
    """Return the integrals of magnitudes, weighted by the time after `since`, before the first sample, if given."""
    found = evaluation.areas(rows)
    if since is None:
        return lambda: found()[0]
    before = float(evaluation.grid.t[0]) - since
    return lambda: found()[1] + before * found()[0] if before else found()[1]


def _areas_after(t: Array, f: Array, since: float) -> Value:
    """Return the integrals of abs(f) times the time after `since`, (...), from the cubics of all intervals."""
    rows, first = f.reshape(-1, t.size), min(int(np.searchsorted(t, since, "right")) - 1, t.size - 2)
    values = np.full(len(rows), np.inf)
    with np.errstate(**QUIET):
        for i in np.flatnonzero(np.abs(rows).max(axis=1) < HUGE):
            p = cubics(t, rows[i])[first:]
            area, moment = np.hstack([p[:1].areas_from((since - p.begin[0]) / p.step[0]), p[1:].areas()])
            values[i] = np.sum(p.step * ((p.begin - since) * area + p.step * moment))
    return plain(values, f.shape[:-1])
