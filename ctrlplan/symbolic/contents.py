"""What an object holds at one time, what has changed of it since, and how to put it back."""

from __future__ import annotations

import types
from collections import deque
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Frozen
from ctrlplan.symbolic.libraries import written_in_python

MISSING = object()
"""In the place of a value that is not there."""

_FEW = 256
"""Entries of an array up to which those that have changed are named one by one."""


class Slots:
    """Attributes of an object that its classes keep in slots."""

    def __init__(self, value: object) -> None:
        self.value = value
        self.places = {
            name: member
            for base in type(value).__mro__
            for name, member in vars(base).items()
            if isinstance(member, types.MemberDescriptorType) and written_in_python(base)
        }

    def values(self) -> dict[str, object]:
        """Those that are set, by name."""
        found = {}
        for name, member in self.places.items():
            try:
                found[name] = member.__get__(self.value)
            except AttributeError:
                continue
        return found


def contents_of(value: object) -> object:
    """Copy of what an object holds itself, or None where it cannot change."""
    if isinstance(value, np.ndarray):
        return value.copy() if value.flags.writeable else None
    if isinstance(value, list | dict | set | bytearray | deque):
        return value.copy()
    if isinstance(value, Slots):
        return value.values()
    own = getattr(value, "__dict__", None) if not isinstance(value, Frozen) else None
    return dict(own) if isinstance(own, dict) and not isinstance(value, types.ModuleType | type) else None


def changed_keys(value: object, before: object) -> list[object]:
    """Keys of an object under which it holds something else than before; None stands for all."""
    if isinstance(value, np.ndarray) and isinstance(before, np.ndarray):
        return list(_changed_entries(value, before))
    now = contents_of(value)
    if isinstance(now, list | deque | bytearray) and isinstance(before, list | deque | bytearray):
        if len(now) == len(before):
            return [k for k, (a, b) in enumerate(zip(now, before, strict=True)) if a is not b]
    elif isinstance(now, dict) and isinstance(before, dict):
        return [key for key in {**before, **now} if now.get(key, MISSING) is not before.get(key, MISSING)]
    return [] if now == before else [None]


def put_back(value: object, before: object) -> None:
    """Let an object hold again what it held before."""
    if before is None:
        return
    if isinstance(value, np.ndarray):
        value[...] = before
    elif isinstance(value, list | bytearray) and isinstance(before, list | bytearray):
        value[:] = before
    elif isinstance(value, dict | set) and isinstance(before, dict | set):
        value.clear()
        value.update(before)
    elif isinstance(value, deque) and isinstance(before, deque):
        value.clear()
        value.extend(before)
    elif isinstance(value, Slots) and isinstance(before, dict):
        for name, entry in before.items():
            with suppress(AttributeError):  # one that cannot be set has not changed
                value.places[name].__set__(value.value, entry)
    elif isinstance(before, dict):
        own = value.__dict__
        own.clear()
        own.update(before)


def bound(holder: object, key: str) -> object:
    """What a name of a module, class or dictionary stands for, or a cell holds; MISSING where there is nothing."""
    if isinstance(holder, types.CellType):
        try:
            return holder.cell_contents
        except ValueError:
            return MISSING
    return (holder if isinstance(holder, dict) else vars(holder)).get(key, MISSING)


def bind(holder: object, key: str, value: object) -> None:
    """Let a name stand for a value again."""
    if not isinstance(holder, dict):
        setattr(holder, key, value)
    elif value is MISSING:
        holder.pop(key, None)
    else:
        holder[key] = value


def _changed_entries(value: NDArray[np.generic], before: NDArray[np.generic]) -> Iterator[int | None]:
    """Places of an array whose entries differ; None for all of a long one."""
    if not value.dtype.hasobject and value.tobytes() == before.tobytes():
        return
    if not value.dtype.hasobject and value.size > _FEW:
        yield None
        return
    for k, (a, b) in enumerate(zip(value.flat, before.flat, strict=True)):
        if (a is not b) if value.dtype.hasobject else (a != b):
            yield k
