"""Metrics of a response: settling time, overshoot, lag."""

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan.metrics._evaluation import Evaluation, Later, evaluated
from ctrlplan.metrics._records import QUIET, Array, Value, finite, fitted, instant, signal, times

_ROUNDING = 4 * np.finfo(np.float64).eps  # of the levels: a response on the edge of the band is inside


def settling_time(
    timepts: ArrayLike,
    y: ArrayLike,
    final: ArrayLike,
    initial: ArrayLike,
    band: float = 0.02,
    start: float | None = None,
) -> Value:
    r"""Settling time of a response to its final value.

    .. math:: \inf\{t : |y(s) - y_f| \le \text{band}\,|y_f - y_0| \text{ for all } s \ge t\}

    The entry into the band is a root of the interpolating cubic, and peaks outside the band between two samples are
    considered: for a smooth response the error is of fourth order in the sample spacing.

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    y : array_like, shape (..., ntime)
        Response, any unit; may contain inf, as after divergence.
    final, initial : array_like, broadcast to shape (...)
        Values after and before the planned change, in the unit of `y`.
    band : float, default 0.02
        Half the width of the band, as a fraction of the change.
    start : float, optional
        Reference time [s]; default: the first sample.

    Returns
    -------
    float or ndarray, shape (...)
        Time since `start` [s]; 0 if `y` is never outside the band (or only before `start`), inf if it does not settle
        or enters the band after the last sample but one, nan if `final` equals `initial`.

    Raises
    ------
    ValueError
        If the shapes differ, `timepts` does not increase, a signal contains nan, a level is not finite, `band` is not
        positive or `start` is after the last sample.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    A first-order lag with a time constant of 1 s settles to 2 % in log 50 s:

    >>> import numpy as np
    >>> from ctrlplan.metrics import settling_time
    >>> t = np.linspace(0, 10, 201)
    >>> round(settling_time(t, 1 - np.exp(-t), final=1, initial=0), 5)
    3.91202
    """
    t = times(timepts)
    response = signal(y, "y", t)
    target = fitted(finite(final, "final"), "final", response.shape[:-1])
    return _settling(t, response, target[..., None], target, initial, band, start)


def tracking_settling_time(
    timepts: ArrayLike,
    y: ArrayLike,
    reference: ArrayLike,
    final: ArrayLike,
    initial: ArrayLike,
    band: float = 0.02,
    start: float | None = None,
) -> Value:
    r"""Settling time of a response to its reference.

    .. math:: \inf\{t : |y(s) - r(s)| \le \text{band}\,|y_f - y_0| \text{ for all } s \ge t\}

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    y : array_like, shape (..., ntime)
        Response, any unit; may contain inf, as after divergence.
    reference : array_like, broadcast to shape (..., ntime)
        Reference of `y`, in the unit of `y`.
    final, initial : array_like, broadcast to shape (...)
        Values after and before the planned change, in the unit of `y`; they determine the width of the band.
    band : float, default 0.02
        Half the width of the band, as a fraction of the change.
    start : float, optional
        Reference time [s]; default: the first sample.

    Returns
    -------
    float or ndarray, shape (...)
        Time since `start` [s]; 0, inf and nan as in `settling_time`.

    Raises
    ------
    ValueError
        As `settling_time`, and if `reference` does not broadcast to `y` or is not finite.
    TypeError
        If an argument is not made of real numbers.

    See Also
    --------
    settling_time : Settling time to the final value.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import tracking_settling_time
    >>> t = np.linspace(0, 10, 201)
    >>> round(tracking_settling_time(t, t + np.exp(-t), t, final=1, initial=0), 5)
    3.91202
    """
    t = times(timepts)
    response = signal(y, "y", t)
    target = fitted(finite(final, "final"), "final", response.shape[:-1])
    return _settling(t, response, finite(reference, "reference"), target, initial, band, start)


def overshoot(
    timepts: ArrayLike, y: ArrayLike, final: ArrayLike, initial: ArrayLike, reference: ArrayLike | None = None
) -> Value:
    r"""Overshoot of a response over its final value or reference.

    .. math:: 100\,\max\bigl(0, \max_t \operatorname{sgn}(y_f - y_0)\,(y(t) - r(t))\bigr) / |y_f - y_0|

    With a `reference` r this is the overshoot on the error of section 2 of the paper; without, r is the final value.
    Peaks are those of the interpolating cubics, with an error of fourth order in the sample spacing. Where a response
    begins, at the first sample or after a jump, a peak before monotone samples is not extrapolated.

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    y : array_like, shape (..., ntime)
        Response, any unit; may contain inf, as after divergence.
    final, initial : array_like, broadcast to shape (...)
        Values after and before the planned change, in the unit of `y`.
    reference : array_like, broadcast to shape (..., ntime), optional
        Reference of `y`, in the unit of `y`; default: `final`.

    Returns
    -------
    float or ndarray, shape (...)
        In percent of the change; nan if `final` equals `initial`.

    Raises
    ------
    ValueError
        If the shapes differ, `timepts` does not increase, `y` contains nan, or a level or the reference is not finite.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    A damping ratio of 1/sqrt 2 gives an overshoot of 100 exp(-pi) percent:

    >>> import numpy as np
    >>> from ctrlplan.metrics import overshoot
    >>> t = np.linspace(0, 10, 201)
    >>> round(overshoot(t, 1 - np.exp(-t) * (np.cos(t) + np.sin(t)), final=1, initial=0), 4)
    4.3214
    """
    return _excess(timepts, y, final, initial, reference, 1.0)


def lag(
    timepts: ArrayLike, y: ArrayLike, final: ArrayLike, initial: ArrayLike, reference: ArrayLike | None = None
) -> Value:
    r"""Maximum lag of a response behind its final value or reference.

    .. math:: 100\,\max\bigl(0, \max_t \operatorname{sgn}(y_f - y_0)\,(r(t) - y(t))\bigr) / |y_f - y_0|

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    y : array_like, shape (..., ntime)
        Response, any unit; may contain inf, as after divergence.
    final, initial : array_like, broadcast to shape (...)
        Values after and before the planned change, in the unit of `y`.
    reference : array_like, broadcast to shape (..., ntime), optional
        Reference of `y`, in the unit of `y`; default: `final`.

    Returns
    -------
    float or ndarray, shape (...)
        In percent of the change; nan if `final` equals `initial`.

    Raises
    ------
    ValueError
        As `overshoot`.
    TypeError
        If an argument is not made of real numbers.

    See Also
    --------
    overshoot : Maximum of the opposite sign.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import lag
    >>> t = np.linspace(0, 10, 201)
    >>> round(lag(t, t - 0.25, final=10, initial=0, reference=t), 6)
    2.5
    """
    return _excess(timepts, y, final, initial, reference, -1.0)


def _settling(
    t: Array, y: Array, reference: Array, target: Array, initial: ArrayLike, band: float, start: float | None
) -> Value:
    lead = y.shape[:-1]
    origin = fitted(finite(initial, "initial"), "initial", lead)
    width = finite(band, "band")
    if width.ndim or width <= 0:
        raise ValueError(f"band must be a positive fraction of the change, got {band}")
    e = y - fitted(reference, "reference", y.shape)
    since = instant(start, t)

    def wanted(evaluation: Evaluation, rows: slice, target: Array, origin: Array) -> Later:
        return settled(evaluation, rows, target, origin, float(width), since)

    return evaluated(wanted, t, e, "y", target, origin)


def settled(evaluation: Evaluation, rows: slice, target: Array, origin: Array, band: float, since: float) -> Later:
    """Return the settling times of signals, each the difference of a response from its target or reference."""
    rounding = _ROUNDING * np.maximum(np.abs(target), np.abs(origin))
    entries = evaluation.entries(rows, band * np.abs(target - origin) + rounding)
    return lambda: np.where(target == origin, np.nan, np.maximum(entries() - since, 0.0))


def exceeded(evaluation: Evaluation, rows: slice, change: Array, side: float) -> Later:
    """Return the overshoots, in percent of the change, of signals as above; for the side -1, of their negatives."""
    maxima = evaluation.maxima(rows, side * np.where(change < 0, -1.0, 1.0), extrapolated=False)

    def percent() -> Array:
        with np.errstate(**QUIET):
            return 100 * np.maximum(maxima(), 0.0) / np.where(change == 0, np.nan, np.abs(change))

    return percent


def _excess(
    timepts: ArrayLike, y: ArrayLike, final: ArrayLike, initial: ArrayLike, reference: ArrayLike | None, side: float
) -> Value:
    t = times(timepts)
    response = signal(y, "y", t)
    lead = response.shape[:-1]
    target = fitted(finite(final, "final"), "final", lead)
    origin = fitted(finite(initial, "initial"), "initial", lead)
    followed = target[..., None] if reference is None else finite(reference, "reference")
    e = response - fitted(followed, "reference", response.shape)
    return evaluated(
        lambda evaluation, rows, change: exceeded(evaluation, rows, change, side), t, e, "y", target - origin
    )
