"""Parameters of a plant in a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def overruled(own: Mapping[str, Any], params: Mapping[str, Any] | None) -> tuple[Any, ...]:
    """A plant's own parameters in order, each overruled by the parameter of a run of its name."""
    given = params or {}
    return tuple(given.get(name, value) for name, value in own.items())
