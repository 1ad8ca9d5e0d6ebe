"""Names of a package whose modules are loaded when a name is first read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def loaded_later(package: str, home: Mapping[str, str]) -> Callable[[str], Any]:
    """Function `__getattr__` of a package, from the module of each name."""

    def found(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{home[name]}"), name)

    return found
