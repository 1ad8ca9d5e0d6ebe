"""Contents of objects: copies, changes, and restoration."""

from __future__ import annotations

import types
from array import array
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Frozen
from ctrlplan.symbolic.libraries import written_in_python

MISSING = object()
"""Placeholder of a missing value."""

_FEW = 256
"""Maximum size of an array of which changed entries are listed."""


class Slots:
    """Attributes of an object in slots of its classes."""

    def __init__(self, value: object) -> None:
        self.value = value
        self.places = _slots_of(type(value))  # type: ignore[arg-type] # classes are hashable

    def values(self) -> dict[str, object]:
        """Values of the slots that are set, by name."""
        found = {}
        for name, member in self.places.items():
            try:
                found[name] = member.__get__(self.value)
            except AttributeError:
                continue
        return found


@lru_cache(maxsize=1024)
def _slots_of(kind: type) -> dict[str, types.MemberDescriptorType]:
    """Slots of the objects of a class, which are known once it is created."""
    return {
        name: member
        for base in kind.__mro__
        for name, member in vars(base).items()
        if isinstance(member, types.MemberDescriptorType) and written_in_python(base)
    }


def contents_of(value: object) -> object:
    """Copy of the contents of an object, or None if it is immutable."""
    if isinstance(value, np.ndarray):
        return value.copy() if value.flags.writeable else None
    if isinstance(value, list | dict | set | bytearray | deque):
        return value.copy()
    if isinstance(value, array):
        return value[:]
    if isinstance(value, Slots):
        return value.values()
    own = getattr(value, "__dict__", None) if not isinstance(value, Frozen) else None
    return dict(own) if isinstance(own, dict) and not isinstance(value, types.ModuleType | type) else None


def changed_keys(value: object, before: object) -> list[object]:
    """Keys of an object with changed values; None stands for all."""
    if isinstance(value, np.ndarray) and isinstance(before, np.ndarray):
        return list(_changed_entries(value, before))
    now = contents_of(value)
    if isinstance(now, list | deque | bytearray) and isinstance(before, list | deque | bytearray):
        if len(now) == len(before):
            return [k for k, (a, b) in enumerate(zip(now, before, strict=True)) if a is not b]
    elif isinstance(now, dict) and isinstance(before, dict):
        return [key for key in {**before, **now} if now.get(key, MISSING) is not before.get(key, MISSING)]
    return [] if now == before else [None]


def restore(value: object, before: object) -> None:
    """Restore the contents of an object."""
    if before is None:
        return
    if isinstance(value, np.ndarray):
        value[...] = before
    elif isinstance(value, list | bytearray) and isinstance(before, list | bytearray):
        value[:] = before
    elif isinstance(value, dict | set) and isinstance(before, dict | set):
        value.clear()
        value.update(before)
    elif isinstance(value, array) and isinstance(before, array):
        value[:] = before
    elif isinstance(value, deque) and isinstance(before, deque):
        value.clear()
        value.extend(before)
    elif isinstance(value, Slots) and isinstance(before, dict):
        for name, entry in before.items():
            with suppress(AttributeError):  # an attribute that cannot be set has not changed
                value.places[name].__set__(value.value, entry)
    elif isinstance(before, dict):
        own = value.__dict__
        own.clear()
        own.update(before)


def bound(holder: object, key: str) -> object:
    """Value of a name of a module, class or dictionary, or of a cell; MISSING if there is none."""
    if isinstance(holder, types.CellType):
        try:
            return holder.cell_contents
        except ValueError:
            return MISSING
    return (holder if isinstance(holder, dict) else vars(holder)).get(key, MISSING)


def bind(holder: object, key: str, value: object) -> None:
    """Restore the value of a name."""
    if not isinstance(holder, dict):
        setattr(holder, key, value)
    elif value is MISSING:
        holder.pop(key, None)
    else:
        holder[key] = value


def _changed_entries(value: NDArray[np.generic], before: NDArray[np.generic]) -> Iterator[int | None]:
    """Indices of changed entries of an array; None for all entries of a large one."""
    if not value.dtype.hasobject and value.tobytes() == before.tobytes():
        return
    if not value.dtype.hasobject and value.size > _FEW:
        yield None
        return
    for k, (a, b) in enumerate(zip(value.flat, before.flat, strict=True)):
        if (a is not b) if value.dtype.hasobject else (a != b):
            yield k
