"""Immutable objects whose fields are declared at the top of the class."""

from __future__ import annotations

from functools import cached_property, lru_cache
from inspect import get_annotations
from typing import Any, Self, TypeVar

import numpy as np

from ctrlplan._types import Frozen


class Fields(Frozen):
    """Immutable object; its fields are the annotated names of its classes."""

    def _set_fields(self, **values: Any) -> None:
        """Set fields, each once; arrays are stored read-only, and copied if they are writable.

        Raises
        ------
        AttributeError
            If a name is not annotated in the class or one of its bases, or is
            set already.
        """
        declared = _declared(type(self).__mro__)
        if not values.keys() <= declared:
            unknown = values.keys() - declared
            raise AttributeError(
                f"fields of {type(self).__name__} must be annotated in the class, as ``{min(unknown)}: float``, "
                f"got {', '.join(sorted(unknown))}"
            )
        if not values.keys().isdisjoint(self.__dict__):
            again = min(values.keys() & self.__dict__.keys())
            raise AttributeError(f"{type(self).__name__} is immutable; {again} is set already")
        for name, value in values.items():
            if isinstance(value, np.ndarray) and value.flags.writeable:
                values[name] = value.copy(order="K")
                values[name].flags.writeable = False
        self.__dict__.update(values)

    def _fill(self, **values: Any) -> None:
        """Set fields as `_set_fields`, without its checks but that each is new; arrays must be read-only."""
        fields = self.__dict__
        if fields and not values.keys().isdisjoint(fields):
            self._set_fields(**values)  # raises
        fields.update(values)

    def _with_fields(self, **values: Any) -> Self:
        """Copy with some fields changed and without cached values."""
        declared = _declared(type(self).__mro__)
        fields = {name: value for name, value in self.__dict__.items() if name in declared}
        found = type(self).__new__(type(self))
        found._set_fields(**(fields | values))
        return found


T = TypeVar("T")


class StoredProperty(cached_property[T]):
    """Cached property without a lock, which costs more than a short computation up to Python 3.11.

    For immutable values: two threads may compute the same one twice.
    """

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self
        value = instance.__dict__[self.attrname] = self.func(instance)
        return value


@lru_cache(maxsize=1024)
def _declared(classes: tuple[type, ...]) -> frozenset[str]:
    """Names annotated in a class and its bases, without class variables."""
    return frozenset(
        name
        for base in classes
        for name, annotation in get_annotations(base).items()
        if not str(annotation).removeprefix("typing.").startswith("ClassVar")
    )
