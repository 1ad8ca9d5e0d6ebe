"""Checks of the arguments of metrics: times, signals and levels."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import real_array

Array = NDArray[np.float64]
Value = float | Array

QUIET: dict[str, Any] = {"over": "ignore", "invalid": "ignore", "divide": "ignore"}
HUGE = np.finfo(np.float64).max / 1e3


def real(value: ArrayLike, name: str) -> Array:
    """Return an array of floats without nan; messages call it `name`."""
    try:
        kind = np.asarray(value).dtype
    except ValueError:
        raise TypeError(f"{name} must be an array of real numbers, got a ragged sequence") from None
    if kind.kind not in "buifmM":
        raise TypeError(f"{name} must be an array of real numbers, got dtype {kind}")
    array = real_array(value, name)  # rejects units, dates and masks
    _forbid(array, name, np.isnan(array), "contain no nan")
    return array


def finite(value: ArrayLike, name: str) -> Array:
    """Return an array of finite floats; messages call it `name`."""
    array = real(value, name)
    _forbid(array, name, np.isinf(array), "be finite")
    return array


def times(timepts: ArrayLike) -> Array:
    """Return sample times, shape (ntime,), checked to increase strictly."""
    t = finite(timepts, "timepts")
    if t.ndim != 1 or t.size < 2:
        raise ValueError(f"timepts must be 1-D with at least 2 samples, got shape {t.shape}")
    late = np.flatnonzero(t[1:] <= t[:-1])
    if late.size:
        i = int(late[0])
        raise ValueError(f"timepts must increase strictly, got timepts[{i + 1}] = {t[i + 1]} after {t[i]}")
    return t


def signal(value: ArrayLike, name: str, t: Array) -> Array:
    """Return a signal, shape (..., ntime), with time last."""
    array = real(value, name)
    if array.ndim == 0 or array.shape[-1] != t.size:
        raise ValueError(f"{name} must have {t.size} samples on its last axis, as timepts has, got shape {array.shape}")
    # Signals are processed along time.
    return array if array.strides[-1] == array.itemsize else np.ascontiguousarray(array)


def axes(value: ArrayLike, name: str, t: Array) -> Array:
    """Return a signal of one or more axes, shape (naxes, ntime)."""
    array = signal(value, name, t)
    if array.ndim > 2:
        raise ValueError(f"{name} must have shape (ntime,) or (naxes, ntime), got shape {array.shape}")
    return np.atleast_2d(array)


def waypoints(value: ArrayLike, path: Array) -> Array:
    """Return the points of a polyline, shape (naxes, npoints), for a path (naxes, ntime)."""
    points = np.atleast_2d(finite(value, "points"))
    if points.ndim != 2 or points.shape[1] == 0 or points.shape[0] != path.shape[0]:
        raise ValueError(f"points must have shape ({path.shape[0]}, npoints), as path has axes, got {points.shape}")
    return points


def fitted(array: Array, name: str, shape: tuple[int, ...]) -> Array:
    """Broadcast a level or a reference to the shape of a signal."""
    try:
        return np.broadcast_to(array, shape)
    except ValueError as error:
        raise ValueError(f"{name} must broadcast to shape {shape}, got shape {array.shape}") from error


def diverged(f: Array) -> bool:
    """Return whether a signal contains inf, or values whose differences overflow."""
    return not np.abs(f).max() < HUGE


def instant(start: float | None, t: Array) -> float:
    """Return the reference time; default: the first sample."""
    if start is None:
        return float(t[0])
    since = finite(start, "start")
    if since.ndim or since > t[-1]:
        raise ValueError(f"start must be a time not after timepts[-1] = {t[-1]}, got {start}")
    return float(since)


def each(metric: Callable[..., float], lead: tuple[int, ...], *arguments: Array, **options: Any) -> Value:
    """Apply a metric of one signal along the leading axes; a float if there are none.

    Overflow and inf - inf are handled by the metrics, so that a diverged loop gives inf without a warning.
    """
    values = np.empty(lead)
    with np.errstate(**QUIET):
        for row in np.ndindex(lead):
            values[row] = metric(*(argument[row] for argument in arguments), **options)
    return plain(values, lead)


def plain(values: Array, lead: tuple[int, ...]) -> Value:
    """Return values in the shape of the leading axes; a float if there are none."""
    return values.reshape(lead) if lead else float(values.item())


def _forbid(array: Array, name: str, bad: NDArray[np.bool_], rule: str) -> None:
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        where = f"{name}[{', '.join(map(str, place))}]" if place else name
        raise ValueError(f"{name} must {rule}, got {where} = {array[place]}")
