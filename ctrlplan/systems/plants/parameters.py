"""Parameters of a plant in a simulation."""

from __future__ import annotations

from ctrlplan._types import Params, Value


def overridden(own: Params, params: Params | None) -> tuple[Value, ...]:
    """A plant's own parameters in order, each overridden by a simulation parameter of its name."""
    given = params or {}
    return tuple(given.get(name, value) for name, value in own.items())
