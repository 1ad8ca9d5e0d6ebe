"""Checks of arguments; the parameters are always (value, name)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._types import Array

Range = float | Sequence[float]
"""Limits of a signal for `checked_range`: (low, high), or a number a for (-a, a)."""

MAXIMUM = 100
"""Maximum order of a derivative, and maximum degree."""

_NO_NUMBERS = (bool, np.bool_, str, bytes, complex, np.complexfloating, np.datetime64, np.timedelta64)
"""Types that Python or numpy would convert to numbers although they are not."""


def real_array(values: ArrayLike, name: str) -> Array:
    """Real numbers as an array of floats, of any shape.

    Parameters
    ----------
    values : array_like
        Numbers of any real type.
    name : str
        Name of the argument, for messages.

    Returns
    -------
    ndarray of float
        The same array if it is one of floats already.

    Raises
    ------
    TypeError
        If the values are strings, complex, dates or time differences, or have
        a physical unit, as the required unit is not known.
    ValueError
        If a value is masked or overflows, or rows differ in length.
    """
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values
    given: Any = values
    if _has_mask(given):
        raise ValueError(f"{name} must have no masked values, got some; fill or drop them first")
    try:
        array = np.asarray(given)
    except ValueError:
        raise ValueError(f"{name} must be an array, got rows of different lengths") from None
    unit = _unit(given)
    if array.dtype.kind in "mM" or unit:
        what = f"values in {unit}" if array.dtype.kind not in "mM" else f"values of type {array.dtype}"
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


def array_of_numbers(values: ArrayLike, name: str) -> Array:
    """Real numbers as an array, as by `real_array`, but no truth values."""
    array = real_array(values, name)
    if array is not values and np.asarray(values).dtype.kind == "b":
        raise TypeError(f"{name} must be numbers, got truth values {values!r:.60}; apply a mask to the {name} first")
    return array


@lru_cache(maxsize=128)
def default_labels(naxes: int) -> tuple[str, ...]:
    """Names y, or y1, y2, ... for more than one axis."""
    return ("y",) if naxes == 1 else tuple(f"y{i + 1}" for i in range(naxes))


def checked_labels(labels: Sequence[str] | str | None, naxes: int) -> tuple[str, ...]:
    """Labels as a tuple, checked to be unique, one per axis, and without dots."""
    if labels is None:
        return default_labels(naxes)
    names = (labels,) if isinstance(labels, str) else tuple(labels)
    if len(names) != naxes:
        raise ValueError(f"labels must be one per axis, {naxes}, got {len(names)}: {names}")
    for name in names:
        if not isinstance(name, str):
            raise TypeError(f"labels must be strings, got {name!r}")
        if not name or "." in name:
            raise ValueError(f"labels must not be empty or contain a dot, got {name!r}")
    if len(set(names)) < naxes:
        raise ValueError(f"labels must be unique, got {names}")
    return names


def checked_finite(value: object, name: str, *, above: float | None = None, minimum: float | None = None) -> float:
    """Finite number, strictly above a bound, or at least a minimum."""
    number = one_number(value, name)
    if math.isfinite(number) and (above is None or number > above) and (minimum is None or number >= minimum):
        return number
    bound = "" if above is None else f" and above {above:g}"
    bound += "" if minimum is None else f" and at least {minimum:g}"
    raise ValueError(f"{name} must be finite{bound}, got {number}")


def one_number(value: object, name: str, rule: str = "a number") -> float:
    """One real number: not a truth value, string, complex number, date, or quantity with a unit."""
    if type(value) is float:
        return value
    given: Any = value
    try:
        if type(value) not in _PLAIN and _is_no_number(given):
            raise TypeError
        return float(given)
    except OverflowError:
        raise ValueError(f"{name} must be within floating point, got {value!r:.80}") from None
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be {rule}, got {value!r:.80}") from None


_PLAIN = frozenset({int, np.float64})


def _is_no_number(value: Any) -> bool:
    """Whether a value is of a kind that `float` would convert although it is not one number without a unit."""
    if isinstance(value, _NO_NUMBERS) or bool(getattr(value, "ndim", False)) or np.ma.is_masked(value):
        return True
    return getattr(getattr(value, "dtype", None), "kind", "f") not in "iufO" or bool(_unit(value))


def new_numbers(values: object, name: str) -> Array:
    """Numbers as a new array of floats; None is nan. Rejects the same types as `one_number`."""
    _check_kinds(values, name)
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be numbers, got {values!r:.200}") from None


def checked_timepts(t: ArrayLike, name: str = "times") -> Array:
    """Times as an array of any shape, without nan."""
    times = array_of_numbers(t, name)
    # The minimum is nan if any time is nan; argmin is much faster than min for few times.
    if times.size and math.isnan(times.item(times.argmin())):
        raise ValueError(f"{name} must not be nan, got nan at index {int(np.isnan(times).argmax())}")
    return times


def checked_number(value: object, name: str) -> float:
    """Real number that is not nan."""
    if not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r}")
    number = one_number(value, name)
    if math.isnan(number):
        raise ValueError(f"{name} must be a number, got nan")
    return number


def checked_pair(pair: object, name: str) -> tuple[float, float]:
    """Two increasing numbers."""
    if not isinstance(pair, Sequence | np.ndarray) or isinstance(pair, str) or len(pair) != 2:
        raise ValueError(f"{name} must be two numbers, got {pair!r}")
    low, high = checked_number(pair[0], name), checked_number(pair[1], name)
    if not low < high:
        raise ValueError(f"{name} must increase, got {low:g} and {high:g}")
    return low, high


def checked_range(limits: object, name: str) -> tuple[float, float]:
    """Lower and upper limit, each of which may be infinite; a number a above 0 is short for (-a, a)."""
    if isinstance(limits, Real) or (isinstance(limits, np.ndarray) and not limits.ndim):
        size = checked_finite(limits, name, above=0.0)
        return -size, size
    return checked_pair(limits, name)


def checked_limits(limits: object, name: str) -> tuple[float, float, float]:
    """Lower and upper limit, at least one finite, and a scale: half their distance, or the size of a single one."""
    low, high = checked_range(limits, name)
    if math.isinf(low) and math.isinf(high):
        raise ValueError(f"{name} must contain a finite one, got {low:g} and {high:g}")
    if math.isfinite(low) and math.isfinite(high):
        return low, high, 0.5 * (high - low)
    return low, high, abs(low if math.isfinite(low) else high) or 1.0


def checked_count(value: float | Real, name: str, minimum: int = 0, maximum: int = MAXIMUM) -> int:
    """Integer between a minimum and a maximum."""
    if type(value) is int and minimum <= value <= maximum:
        return value
    if not isinstance(value, Real):
        raise TypeError(f"{name} must be an integer of at least {minimum}, got {value!r}")
    number = one_number(value, name, f"an integer of at least {minimum}")
    if not math.isfinite(number) or number != int(number) or number < minimum:
        raise ValueError(f"{name} must be an integer of at least {minimum}, got {value}")
    if number > maximum:
        raise ValueError(f"{name} must be at most {maximum}, got {value}")
    return int(number)


def finite_vector(values: ArrayLike, name: str, size: str, scalar: bool = False) -> Array:
    """One or more finite numbers as a new vector; `size` names its length in messages, `scalar` allows a scalar."""
    found = new_numbers(values, name)
    if found.ndim > 1 or (found.ndim == 0 and not scalar) or not found.size:
        forms = f"a scalar or of shape ({size},)" if scalar else f"of shape ({size},)"
        raise ValueError(f"{name} must be {forms}, got shape {found.shape}")
    if not np.isfinite(found).all():
        wrong = int((~np.isfinite(found)).argmax())
        entry = f"[{wrong}] = {found[wrong]}" if found.ndim else f" = {found}"
        raise ValueError(f"{name} must be finite, got {name}{entry}")
    return np.atleast_1d(found)


def checked_vector(values: ArrayLike, name: str, count: int) -> Array:
    """New array (count,) of finite numbers, from as many numbers or one for all."""
    given = real_array(values, name)
    if given.shape not in ((), (count,)) or not np.isfinite(given).all():
        raise ValueError(f"{name} must be a finite number or {count} of them, got {values!r:.80}")
    return np.broadcast_to(given, (count,)).copy()


def checked_names(names: Sequence[str] | str, name: str, count: int | None = None) -> list[str]:
    """Names of signals as a list, checked to be different strings; one string is one name."""
    given = [names] if isinstance(names, str) else list(names) if isinstance(names, Iterable) else [names]
    for entry in given:
        if not isinstance(entry, str) or not entry:
            raise TypeError(f"{name} must be names of signals, got {names!r:.80}")
    if count is not None and len(given) != count:
        raise ValueError(f"{name} must be {count} {'names' if count > 1 else 'name'}, got {len(given)}: {given!r:.80}")
    if len(set(given)) < len(given):
        raise ValueError(f"{name} must differ from each other, got {', '.join(given)}")
    return given


def check_signals(value: Sequence[str], name: str, known: Sequence[str], kind: str) -> None:
    """Raise unless a value has different names among the known inputs or outputs (the kind), at least one."""
    if not value:
        raise ValueError(f"{name} must name at least one {kind}, got none")
    for label in value:
        if label not in known:
            raise ValueError(f"{name} must be among the {kind}s {', '.join(known) or '(none)'}, got {label!r}")
    if len(set(value)) < len(value):
        raise ValueError(f"{name} must not name an {kind} twice, got {', '.join(value)}")


def check_kind(value: object, name: str, kind: type, what: str = "") -> None:
    """Raise unless a value is an object of a class, described as `what` in messages."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {what or f'a {kind.__name__}'}, got {type(value).__name__}")


def checked_params(params: object) -> dict[str, Any]:
    """Parameters of blocks by name, none for None."""
    if params is None:
        return {}
    check_kind(params, "params", Mapping, "a mapping of names to values, such as {'mass': 2.0}")
    given: Mapping[Any, Any] = params  # type: ignore[assignment]
    for name in given:
        if not isinstance(name, str):
            raise TypeError(f"params must have names as keys, such as 'mass', got {name!r:.80}")
    return dict(given)


def _has_mask(values: Any) -> bool:
    """Whether an array, or an array in a list, has masked values."""
    if isinstance(values, list | tuple):
        return any(_has_mask(value) for value in values if isinstance(value, list | tuple | np.ma.MaskedArray))
    return bool(np.ma.is_masked(values))


def _unit(value: Any) -> str:
    """Unit of a quantity of pint or astropy; empty if it has none or is dimensionless."""
    unit = str(getattr(value, "units", None) or getattr(value, "unit", None) or "")
    return "" if unit in _NO_UNIT else unit


_NO_UNIT = frozenset({"dimensionless"})


def _check_kinds(values: Any, name: str) -> None:
    """Raise for values that numpy would convert to numbers although they are not."""
    if type(values) in (float, int) or values is None or (type(values) is np.ndarray and values.dtype.kind in "iuf"):
        return
    if isinstance(values, list | tuple):
        for value in values:
            if type(value) is not float and not (type(value) is np.ndarray and value.dtype.kind in "iuf"):
                _check_kinds(value, name)
        return
    kind = getattr(getattr(values, "dtype", None), "kind", None)
    if isinstance(values, bool | str | bytes | complex) or (kind is not None and kind in "bcSU"):
        raise ValueError(f"{name} must be numbers, got {values!r:.80}")
    if kind == "O" and isinstance(values, np.ndarray):
        _check_kinds(values.tolist(), name)
    elif type(values) is not np.ndarray or kind not in ("i", "u", "f"):
        real_array(values, name)  # rejects units, dates and masks
