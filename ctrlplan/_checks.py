"""Checks of what a user gives, on the ground floor: always (value, name)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def real_array(values: ArrayLike, name: str) -> Array:
    """Real numbers as an array of floats, of any shape.

    Parameters
    ----------
    values : array_like
        Numbers of any real type.
    name : str
        What they are called in messages.

    Returns
    -------
    ndarray of float
        The same array where it is one already.

    Raises
    ------
    TypeError
        If the values are strings, complex, dates or time differences, or carry
        a physical unit: which unit is meant would be a guess.
    ValueError
        If a value is masked or beyond floating point, or rows differ in length.
    """
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values
    given: Any = values
    if _has_mask(given):
        raise ValueError(f"{name} must have no masked values, got some; fill or drop them first")
    units = getattr(given, "units", None) or getattr(given, "unit", None)
    try:
        array = np.asarray(given)
    except ValueError:
        raise ValueError(f"{name} must be an array, got rows of different lengths") from None
    if array.dtype.kind in "mM" or (units is not None and str(units) not in ("", "dimensionless")):
        what = f"values in {units}" if array.dtype.kind not in "mM" else f"values of type {array.dtype}"
        raise TypeError(f"{name} must be plain numbers (times in seconds), got {what}; convert them first")
    if array.dtype.kind == "O":
        try:
            return array.astype(float)
        except OverflowError:
            raise ValueError(f"{name} must be within floating point, got {given!r:.80}") from None
        except (TypeError, ValueError):
            raise TypeError(f"{name} must be real numbers, got {given!r:.80}") from None
    if array.dtype.kind not in "buif":
        kind = "complex numbers" if array.dtype.kind == "c" else f"{given!r:.80}"
        raise TypeError(f"{name} must be real numbers, got {kind}")
    return array.astype(float, copy=False)


def _has_mask(values: Any) -> bool:
    """Whether an array, or one inside a list, has masked values."""
    if isinstance(values, list | tuple):
        return any(_has_mask(value) for value in values if isinstance(value, list | tuple | np.ma.MaskedArray))
    return bool(np.ma.is_masked(values))
