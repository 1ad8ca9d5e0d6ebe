"""Built objects that are kept for further use, the most recently used ones."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

BUILDING = threading.RLock()
"""Held by a thread that builds what others may use as well: one lock for all, so that no two wait for each other."""


class Lru(Generic[K, V]):
    """Bounded mapping that builds missing entries and drops the least recently used one; safe in threads.

    A copy, or what another process receives, is empty.

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

    def get(self, key: K, make: Callable[[], V]) -> V:
        """Entry of a key, built if it is missing."""
        with BUILDING:
            if key not in self._entries:
                made = make()
                if len(self._entries) >= self.size:
                    self._entries.popitem(last=False)
                self._entries[key] = made
            self._entries.move_to_end(key)
            return self._entries[key]

    def clear(self) -> None:
        """Drop all entries."""
        with BUILDING:
            self._entries.clear()
