"""Names of a package whose modules are loaded when a name is first read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def loaded_later(own: dict[str, Any], home: Mapping[str, str]) -> Callable[[str], Any]:
    """Function `__getattr__` of a package, from its globals and the module of each name."""
    package = own["__name__"]

    def found(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        own[name] = value = getattr(import_module(f"{package}.{home[name]}"), name)
        return value  # from now on an attribute of the package

    return found
