"""Metrics of control signals: effort, peak, total variation, saturation time."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan.metrics._error import squared
from ctrlplan.metrics._evaluation import Evaluation, Later, evaluated
from ctrlplan.metrics._extremes import may_reach
from ctrlplan.metrics._grid import Grid
from ctrlplan.metrics._pieces import cubics
from ctrlplan.metrics._records import QUIET, Array, Value, diverged, each, fitted, real, times
from ctrlplan.metrics._records import signal as checked

_AT_LIMIT = 1e-9  # distance from a limit, relative to the range, that counts as saturation


def effort(timepts: ArrayLike, u: ArrayLike) -> Value:
    r"""Integral of the squared control.

    .. math:: \int_{t_0}^{t_f} u(t)^2\,dt

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    u : array_like, shape (..., ntime)
        Control, any unit.

    Returns
    -------
    float or ndarray, shape (...)
        In the unit of `u` squared times s; inf where `u` contains inf or its square overflows.

    Raises
    ------
    ValueError
        If the last axis of `u` differs from ``len(timepts)``, `timepts` does not increase or `u` contains nan.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import effort
    >>> t = np.linspace(0, 2 * np.pi, 201)
    >>> round(effort(t, np.sin(t)), 6)
    3.141593
    """
    t = times(timepts)
    return squared(t, checked(u, "u", t), "u")


def peak(timepts: ArrayLike, signal: ArrayLike) -> Value:
    r"""Peak magnitude of a signal, also between samples.

    .. math:: \max_t |u(t)|

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    signal : array_like, shape (..., ntime)
        Any signal, any unit.

    Returns
    -------
    float or ndarray, shape (...)
        In the unit of `signal`: the maximum of the interpolating cubic, or the sample at a jump.

    Raises
    ------
    ValueError
        If the last axis of `signal` differs from ``len(timepts)``, `timepts` does not increase or `signal` contains
        nan.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> from ctrlplan.metrics import peak
    >>> peak([0, 1, 2, 3], [0.0, -2.0, -2.0, 0.0])
    2.25
    """
    t = times(timepts)
    return evaluated(magnitude, t, checked(signal, "signal", t), "signal")


def total_variation(timepts: ArrayLike, signal: ArrayLike) -> Value:
    r"""Total variation of a signal.

    .. math:: \int_{t_0}^{t_f} |\dot u(t)|\,dt, \text{ with each jump's height}

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    signal : array_like, shape (..., ntime)
        Any signal, any unit.

    Returns
    -------
    float or ndarray, shape (...)
        In the unit of `signal`; includes extrema between samples, and the height of each jump.

    Raises
    ------
    ValueError
        If the last axis of `signal` differs from ``len(timepts)``, `timepts` does not increase or `signal` contains
        nan.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import total_variation
    >>> t = np.linspace(0, 2 * np.pi, 211)
    >>> round(total_variation(t, np.cos(t) + np.sin(t)), 6)
    5.656854
    """
    t = times(timepts)
    record = checked(signal, "signal", t)
    return each(lambda f: variation(t, f), record.shape[:-1], record)


def saturation_time(timepts: ArrayLike, u: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Value:
    r"""Time during which a control signal is at or beyond its limits.

    .. math:: \int_{t_0}^{t_f} [u(t) \le u_{\min} \text{ or } u(t) \ge u_{\max}]\,dt

    The time at which `u` reaches a limit is extrapolated from the previous samples, the time at which it leaves the
    limit from the following ones. A jump to or from a limit is at the sample that follows it.

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    u : array_like, shape (..., ntime)
        Control, any unit.
    lower, upper : array_like, broadcast to shape (...)
        Limits in the unit of `u`; -inf and inf for none. A distance of 1e-9 of the range counts as saturation.

    Returns
    -------
    float or ndarray, shape (...)
        Time [s].

    Raises
    ------
    ValueError
        If the last axis of `u` differs from ``len(timepts)``, `timepts` does not increase, an argument contains nan, or
        `lower` is not below `upper`.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import saturation_time
    >>> t = np.linspace(0, 10, 15)
    >>> round(saturation_time(t, np.clip(t, 2, 7), lower=2, upper=7), 6)
    5.0
    """
    t = times(timepts)
    control = checked(u, "u", t)
    low = fitted(real(lower, "lower"), "lower", control.shape[:-1])
    high = fitted(real(upper, "upper"), "upper", control.shape[:-1])
    if not (low < high).all():
        raise ValueError(f"lower must be below upper, got lower = {low} and upper = {high}")
    return each(lambda u, low, high: _saturated(t, u, float(low), float(high)), control.shape[:-1], control, low, high)


def magnitude(evaluation: Evaluation, rows: slice) -> Later:
    """Return the peak magnitudes of signals."""
    return evaluation.maxima(rows, np.zeros(rows.stop - rows.start))


def varied(evaluation: Evaluation, rows: slice) -> Later:
    """Return the total variations of signals."""

    def values() -> Array:
        t, signals, stepped = evaluation.grid.t, evaluation.signals(rows), evaluation.stepped(rows)
        with np.errstate(**QUIET):
            found = [stepped[i].variation() if i in stepped else variation(t, f) for i, f in enumerate(signals)]
        return np.array(found)

    return values


def variation(t: Array, f: Array) -> float:
    """Return the total variation of one record (ntime,)."""
    if diverged(f):
        return np.inf
    p = cubics(t, f)
    return float(np.abs(np.diff(p.values, axis=0)).sum())


def _saturated(t: Array, u: Array, low: float, high: float) -> float:
    sides = [side for side in (low, high) if np.isfinite(side)]
    scale = high - low if len(sides) == 2 else max(map(abs, sides), default=0.0)
    bound = 2 * max(np.abs(u[np.isfinite(u)]).max(initial=1.0), *map(abs, sides), 1.0)
    u = np.clip(u, -bound, bound)  # a diverged control is beyond the limit, at whatever value
    total = sum(_beyond(t, g, _AT_LIMIT * scale) for g in (low - u, u - high) if np.isfinite(g).all())
    # The intervals at both limits may overlap.
    return min(total, float(t[-1] - t[0]))


def _beyond(t: Array, g: Array, tolerance: float) -> float:
    """Return the time during which g >= 0, where samples within the tolerance are at the limit."""
    if not may_reach(Grid.of(t), g, -tolerance):
        return 0.0
    at = g >= -tolerance
    resting = at & (g <= tolerance)
    stays = np.flatnonzero(resting[:-1] & resting[1:])
    enters = np.flatnonzero(~at[:-1] & resting[1:])
    leaves = np.flatnonzero(resting[:-1] & ~at[1:])
    free = np.ones(t.size - 1, dtype=np.bool_)
    free[stays] = free[enters] = free[leaves] = False
    p = cubics(t, g)[free]
    values = p.values
    mixed = (values.min(axis=0) < 0) & (values.max(axis=0) > 0)
    crossed = p[mixed]
    cuts = crossed.splits
    above = crossed((cuts[:-1] + cuts[1:]) / 2) > 0
    time = np.sum(p.step[~mixed & (p.end >= -tolerance)]) + np.sum(crossed.step * np.diff(cuts, axis=0) * above)
    time += np.sum(t[stays + 1] - t[stays])
    time += np.sum(t[enters + 1] - _arrivals(t, g, enters, t[enters + 1]))
    back = t.size - 2 - leaves  # the samples with time reversed
    time += np.sum(-_arrivals(-t[::-1], g[::-1], back, -t[leaves + 1]) - t[leaves])
    return float(time)


def _arrivals(t: Array, g: Array, k: NDArray[np.intp], otherwise: Array) -> Array:
    """Return the time at which the parabola through samples k - 2 to k is zero before sample k + 1, or `otherwise`."""
    one, two = np.maximum(k - 1, 0), np.maximum(k - 2, 0)
    known = (k >= 1) & (g[one] < 0)
    curved = known & (k >= 2) & (g[two] < 0)
    slope = np.where(known, (g[k] - g[one]) / (t[k] - t[one]), 0.0)
    bend = np.where(curved, (slope - (g[one] - g[two]) / (t[one] - t[two])) / (t[k] - t[two]), 0.0)
    slope = slope + (t[k] - t[one]) * bend
    q = -(slope + np.copysign(np.sqrt(slope**2 - 4 * bend * g[k]), slope)) / 2
    roots = np.stack([q / bend, g[k] / q])
    ahead = (roots >= 0) & (roots <= t[k + 1] - t[k])
    return np.where(ahead.any(axis=0), t[k] + np.where(ahead, roots, np.inf).min(axis=0), otherwise)
