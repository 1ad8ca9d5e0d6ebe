"""Cache of the most recently used objects."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

BUILDING = threading.RLock()
"""Lock of a thread that builds an entry: one for all caches, which excludes deadlocks."""


class Lru(Generic[K, V]):
    """Bounded mapping that builds missing entries and drops the least recently used one; thread-safe.

    Copies and pickles are empty.

    Parameters
    ----------
    size : int
        Maximum number of entries.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._entries: OrderedDict[K, V] = OrderedDict()

    def __len__(self) -> int:
        return len(self._entries)

    def __reduce__(self) -> tuple[type[Lru[K, V]], tuple[int]]:
        return type(self), (self.size,)

    def __contains__(self, key: K) -> bool:
        return key in self._entries

    def get(self, key: K, make: Callable[[], V]) -> V:
        """Entry of a key, built if missing."""
        with BUILDING:
            if key not in self._entries:
                made = make()
                if len(self._entries) >= self.size:
                    self._entries.popitem(last=False)
                self._entries[key] = made
            self._entries.move_to_end(key)
            return self._entries[key]

    def clear(self) -> None:
        """Remove all entries."""
        with BUILDING:
            self._entries.clear()
