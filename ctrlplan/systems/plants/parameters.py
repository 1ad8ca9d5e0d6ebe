"""What the parameters of every plant must be."""

from __future__ import annotations

import math
from numbers import Real

from ctrlplan._types import Params, Value


def check_parameters(positive: Params, not_negative: Params) -> None:
    """Refuse parameters that are no finite numbers above 0, or of the second kind at least 0.

    Raises
    ------
    TypeError
        If one is not a number.
    ValueError
        If one is out of range; its name is in the message.
    """
    for name, value in {**positive, **not_negative}.items():
        if isinstance(value, bool) or not isinstance(value, Real):
            raise TypeError(f"{name} must be a number, got {value!r}")
        number = float(value)
        if not math.isfinite(number) or number < 0.0 or (number == 0.0 and name in positive):
            least = "above 0" if name in positive else "at least 0"
            raise ValueError(f"{name} must be finite and {least}, got {value}")


def overruled(own: Params, params: Params | None) -> tuple[Value, ...]:
    """A plant's own parameters in order, each overruled by the parameter of a run of its name."""
    given = params or {}
    return tuple(given.get(name, value) for name, value in own.items())
