"""Parameters of a plant in a run."""

from __future__ import annotations

from ctrlplan._types import Params, Value


def overridden(own: Params, params: Params | None) -> tuple[Value, ...]:
    """A plant's own parameters in order, each overruled by the parameter of a run of its name."""
    given = params or {}
    return tuple(given.get(name, value) for name, value in own.items())
