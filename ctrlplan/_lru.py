"""What was made lately, kept so that it need not be made again."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

BUILDING = threading.RLock()
"""Held by a thread that builds what others may use as well: one lock for all, so that none waits for another."""


def recent(store: OrderedDict[K, V], key: K, most: int, make: Callable[[], V]) -> V:
    """What is kept under a key, made if it is not; of more than `most` the one longest unused goes."""
    with BUILDING:
        if key not in store:
            made = make()
            if len(store) >= most:
                store.popitem(last=False)
            store[key] = made
        store.move_to_end(key)
        return store[key]
