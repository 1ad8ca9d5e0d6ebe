"""Parameters of plants: fields with units and ranges, and their values in a simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, field, fields
from types import SimpleNamespace
from typing import Any

from ctrlplan._checks import checked_finite
from ctrlplan._types import Params, Value


def parameter(default: float, unit: str, *, zero: bool = False) -> Any:  # type of a field
    """Field of a plant: a number above 0, or at least 0 where it may be `zero`."""
    return field(default=default, metadata={"unit": unit, "zero": zero})


def parameters_of(plant: Value) -> Iterator[Field[float]]:
    """Fields of a plant that are made by `parameter`."""
    return (entry for entry in fields(plant) if "unit" in entry.metadata)


def check_parameters(plant: Value) -> None:
    """Raise if a parameter is not a finite number in its range."""
    for entry in parameters_of(plant):
        zero = entry.metadata["zero"]
        value = getattr(plant, entry.name)
        checked_finite(value, entry.name, above=None if zero else 0.0, minimum=0.0 if zero else None)


def defaults_of(plant: Value) -> dict[str, Value]:
    """Parameters of a plant by name."""
    return {entry.name: getattr(plant, entry.name) for entry in parameters_of(plant)}


def values_of(plant: Value, params: Params | None) -> SimpleNamespace:
    """Parameters of a plant as attributes, each overridden by a simulation parameter of its name."""
    own = defaults_of(plant)
    return SimpleNamespace(**dict(zip(own, overridden(own, params), strict=True)))


def overridden(own: Params, params: Params | None) -> tuple[Value, ...]:
    """A plant's own parameters in order, each overridden by a simulation parameter of its name."""
    given = params or {}
    return tuple(given.get(name, value) for name, value in own.items())
