"""Write-only locations of functions, such as logs and counters of calls, without effect on their values."""

from __future__ import annotations

import threading
import types
from collections import OrderedDict

_SIZE = 256
"""Maximum number of stored locations."""


class Logs:
    """Locations (object, key or attribute, None for all), and the functions on which they have no effect.

    Thread-safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._places: OrderedDict[tuple[int, object], tuple[object, frozenset[types.CodeType]]] = OrderedDict()

    def __contains__(self, place: tuple[object, object, frozenset[types.CodeType]]) -> bool:
        holder, key, codes = place
        with self._lock:
            known = self._places.get((id(holder), key))
        return known is not None and known[0] is holder and codes <= known[1]

    def keys_of(self, holder: object, codes: frozenset[types.CodeType]) -> set[object]:
        """Keys of an object that are such locations for some functions."""
        with self._lock:
            keys = [key for number, key in self._places if number == id(holder)]
        return {key for key in keys if (holder, key, codes) in self}

    def add(self, places: list[tuple[object, object]], codes: frozenset[types.CodeType]) -> None:
        """Add locations that some functions write but do not depend on."""
        with self._lock:
            for holder, key in places:
                _, known = self._places.pop((id(holder), key), (holder, frozenset()))
                self._places[id(holder), key] = holder, known | codes
            while len(self._places) > _SIZE:
                self._places.popitem(last=False)


LOGS = Logs()
"""Locations found so far, in all blocks."""
