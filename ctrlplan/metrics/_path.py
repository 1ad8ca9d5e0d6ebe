"""Metrics of paths, alone and relative to their waypoints."""

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan.metrics._control import variation
from ctrlplan.metrics._error import squared
from ctrlplan.metrics._evaluation import Evaluation
from ctrlplan.metrics._pieces import Pieces, cubics
from ctrlplan.metrics._records import Array, axes, diverged, each, times, waypoints

_SWING = 1e-6  # of the waypoints' bounding box: smaller reversals are rounding


def path_length(timepts: ArrayLike, path: ArrayLike) -> float:
    r"""Length of a path.

    .. math:: \int_{t_0}^{t_f} \Bigl(\sum_i \dot p_i(t)^2\Bigr)^{1/2} dt

    Each axis is interpolated by cubics: for a smooth path the error is of fourth order in the sample spacing. A jump is
    a straight line.

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    path : array_like, shape (ntime,) or (naxes, ntime)
        Positions, in the same unit on every axis.

    Returns
    -------
    float
        In the unit of `path`; inf where `path` contains inf.

    Raises
    ------
    ValueError
        If the last axis of `path` differs from ``len(timepts)``, it has more than two axes, `timepts` does not
        increase or `path` contains nan.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import path_length
    >>> t = np.linspace(0, np.pi, 101)
    >>> round(path_length(t, [np.cos(t), np.sin(t)]), 6)
    3.141593
    """
    t = times(timepts)
    positions = axes(path, "path", t)
    return float(each(lambda p: _length(t, p), (), positions))


def wandering(timepts: ArrayLike, path: ArrayLike, points: ArrayLike) -> float:
    r"""Path length relative to the waypoint polyline, minus 1.

    .. math:: L / L_0 - 1, \qquad L_0 = \sum_j |w_{j+1} - w_j|

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    path : array_like, shape (ntime,) or (naxes, ntime)
        Positions, in the same unit on every axis.
    points : array_like, shape (npoints,) or (naxes, npoints)
        Positions of the waypoints, in the unit of `path`.

    Returns
    -------
    float
        Excess length as a fraction of the polyline's length; negative for a path that cuts corners, nan if the polyline
        has length 0.

    Raises
    ------
    ValueError
        As `path_length`, and if `points` has other axes than `path` or is not finite.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import wandering
    >>> t = np.linspace(0, np.pi, 101)
    >>> round(wandering(t, [np.cos(t), np.sin(t)], [[1, -1], [0, 0]]), 6)
    0.570796
    """
    t = times(timepts)
    positions = axes(path, "path", t)
    polyline = waypoints(points, positions)

    def excess(positions: Array) -> float:
        shortest = float(np.sqrt((np.diff(polyline) ** 2).sum(axis=0)).sum())
        return _length(t, positions) / shortest - 1 if shortest > 0 else np.nan

    return float(each(excess, (), positions))


def excess_variation(timepts: ArrayLike, path: ArrayLike, points: ArrayLike) -> float:
    r"""Relative excess of a path's total variation over its waypoints.

    .. math:: \sum_i \max(0, V(p_i) - V(w_i)) \Big/ \sum_i V(w_i)

    with V(p_i) the total variation of an axis. An axis with less variation than its waypoints contributes zero.

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    path : array_like, shape (ntime,) or (naxes, ntime)
        Positions, in the same unit on every axis.
    points : array_like, shape (npoints,) or (naxes, npoints)
        Positions of the waypoints, in the unit of `path`.

    Returns
    -------
    float
        Excess as a fraction of the variation of the waypoints; nan if that is zero.

    Raises
    ------
    ValueError
        As `wandering`.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import excess_variation
    >>> t = np.linspace(0, np.pi, 101)
    >>> round(excess_variation(t, [np.cos(t), np.sin(t)], [[1, -1], [0, 0]]), 6)
    1.0
    """
    t = times(timepts)
    positions = axes(path, "path", t)
    polyline = waypoints(points, positions)

    def excess(positions: Array) -> float:
        forced = np.abs(np.diff(polyline)).sum(axis=1)
        beyond = sum(max(variation(t, p) - float(v), 0.0) for p, v in zip(positions, forced, strict=True))
        return beyond / float(forced.sum()) if forced.any() else np.nan

    return float(each(excess, (), positions))


def turning_points(timepts: ArrayLike, path: ArrayLike, points: ArrayLike) -> int:
    """Number of reversals of a path beyond those of its waypoints.

    A reversal is a change of direction of one axis. The reversals of each axis beyond those of its waypoints are
    counted, and summed over the axes. Reversals of up to 1e-6 of the longest side of the waypoints' bounding box (or
    of the path's, if the waypoints coincide) are ignored as rounding.

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    path : array_like, shape (ntime,) or (naxes, ntime)
        Positions, any unit.
    points : array_like, shape (npoints,) or (naxes, npoints)
        Positions of the waypoints, in the unit of `path`.

    Returns
    -------
    int
        Zero or more. Reversals are found from samples: two between the same two samples are missed.

    Raises
    ------
    ValueError
        As `wandering`.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import turning_points
    >>> t = np.linspace(0, 10, 101)
    >>> turning_points(t, np.sin(t), [0, 1, np.sin(10)])
    2
    """
    t = times(timepts)
    positions = axes(path, "path", t)
    polyline = waypoints(points, positions)
    size = float(np.ptp(polyline, axis=1).max())
    if size == 0:
        finite = np.where(np.isfinite(positions), positions, polyline[:, :1])
        size = float(np.ptp(finite, axis=1).max())
    swing = _SWING * size
    return sum(max(_turns(p, swing) - _turns(w, swing), 0) for p, w in zip(positions, polyline, strict=True))


def outside_box(timepts: ArrayLike, path: ArrayLike, points: ArrayLike) -> float:
    """Maximum distance of a path from its waypoints' bounding box.

    The bounding box of the waypoints has sides parallel to the axes; the distance is Euclidean.

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    path : array_like, shape (ntime,) or (naxes, ntime)
        Positions, in the same unit on every axis.
    points : array_like, shape (npoints,) or (naxes, npoints)
        Positions of the waypoints, in the unit of `path`.

    Returns
    -------
    float
        In the unit of `path`; 0 for a path inside the box.

    Raises
    ------
    ValueError
        As `wandering`.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from ctrlplan.metrics import outside_box
    >>> t = np.linspace(0, np.pi, 101)
    >>> round(outside_box(t, [np.cos(t), np.sin(t)], [[1, -1], [0, 0]]), 6)
    1.0
    """
    t = times(timepts)
    positions = axes(path, "path", t)
    polyline = waypoints(points, positions)

    def distance(positions: Array) -> float:
        low, high = polyline.min(axis=1, keepdims=True), polyline.max(axis=1, keepdims=True)
        beyond = np.maximum(low - positions, positions - high)
        # The distance is not smooth where the path enters the box; those of single axes are.
        corner = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=0, keepdims=True))
        evaluation, sides = Evaluation(t), np.concatenate([corner, low - positions, positions - high])
        return float(evaluation.maxima(evaluation.add(sides, "path"), np.ones(len(sides)))().max(initial=0.0))

    return float(each(distance, (), positions))


def jerk_cost(timepts: ArrayLike, jerk: ArrayLike) -> float:
    r"""Integral of the squared jerk, summed over the axes.

    .. math:: \int_{t_0}^{t_f} \sum_i \dddot p_i(t)^2\,dt

    Parameters
    ----------
    timepts : array_like, shape (ntime,)
        Sample times [s], strictly increasing; need not be even.
    jerk : array_like, shape (ntime,) or (naxes, ntime)
        Third derivatives of the positions, in the same unit on every axis.

    Returns
    -------
    float
        In the unit of `jerk` squared times s; inf where `jerk` contains inf or its square overflows.

    Raises
    ------
    ValueError
        If the last axis of `jerk` differs from ``len(timepts)``, it has more than two axes, `timepts` does not
        increase or `jerk` contains nan.
    TypeError
        If an argument is not made of real numbers.

    Examples
    --------
    The quintic rest-to-rest move over unit distance and time:

    >>> import numpy as np
    >>> from ctrlplan.metrics import jerk_cost
    >>> t = np.linspace(0, 1, 11)
    >>> round(jerk_cost(t, 60 - 360 * t + 360 * t**2), 6)
    720.0
    """
    t = times(timepts)
    jerks = axes(jerk, "jerk", t)
    return float(np.sum(squared(t, jerks, "jerk")))


def _length(t: Array, path: Array) -> float:
    if diverged(path):
        return np.inf
    curves = [cubics(t, p) for p in path]
    cuts = np.sort(np.concatenate([p.cuts for p in curves]), axis=0)
    turns = np.asarray(((cuts > 0) & (cuts < 1)).any(axis=0))
    return _arc([p[~turns] for p in curves], None) + _arc([p[turns] for p in curves], cuts[:, turns])


def _arc(curves: list[Pieces], cuts: Array | None) -> float:
    """Return the path length of the curves; intervals are split at reversals, where the speed may not be smooth."""

    def speed(s: Array) -> Array:
        return np.asarray(np.sqrt(np.sum([(p.slope(s) / p.step) ** 2 for p in curves], axis=0)))

    return curves[0].integral(curves[0].whole() if cuts is None else cuts, speed)


def _turns(f: Array, swing: float) -> int:
    """Return the number of reversals of a signal (ntime,) by more than `swing`."""
    way = (f[1:] > f[:-1]).astype(int) - (f[1:] < f[:-1])
    moves = np.flatnonzero(way)
    ends = moves[1:][way[moves[1:]] != way[moves[:-1]]]
    extremes = [float(x) for x in f[[0, *ends, -1]]]
    low = high = last = extremes[0]
    turns = direction = 0
    for x in extremes[1:]:
        if direction == 0:
            direction = int(x - low > swing) - int(high - x > swing)
            low, high, last = min(low, x), max(high, x), x
        elif (x - last) * direction > 0:
            last = x
        elif (last - x) * direction > swing:
            turns, direction, last = turns + 1, -direction, x
    return turns
