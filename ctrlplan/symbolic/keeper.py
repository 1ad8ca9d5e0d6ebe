"""Restoration of all objects that functions refer to after trial calls.

Used for calls with symbols, which must not be stored anywhere, and to detect
side effects of calls. Functions with contents that cannot be restored are not
called. Calls with numbers use copies, see `ctrlplan.symbolic.trials`.
"""

from __future__ import annotations

from ctrlplan.symbolic.code import codes_of
from ctrlplan.symbolic.contents import bind, bound, changed_keys, contents_of, restore
from ctrlplan.symbolic.logs import LOGS
from ctrlplan.symbolic.references import References


class Keeper:
    """Contents of all objects that functions refer to, for restoration after trial calls.

    Parameters
    ----------
    references : References
        References of the functions, with their present contents; none may be
        opaque.
    """

    def __init__(self, references: References) -> None:
        self._roots, self._tokens = references.roots, references.tokens
        self._bindings = list(references.bindings)
        self._contents = [(value, found) for value in references.objects if (found := contents_of(value)) is not None]

    def changes(self) -> list[tuple[object, object]]:
        """Locations (object, key or attribute, None for all) with changed contents that matter."""
        if References(self._roots).tokens == self._tokens:
            return []
        found: list[tuple[object, object]] = [
            (value, key) for value, before in self._contents for key in changed_keys(value, before)
        ]
        return found + [(holder, key) for holder, key, value in self._bindings if bound(holder, key) is not value]

    def restore(self) -> None:
        """Restore all contents."""
        for value, before in self._contents:
            if changed_keys(value, before):
                restore(value, before)
        for holder, key, value in self._bindings:
            if bound(holder, key) is not value:
                bind(holder, key, value)

    def ignore(self, changes: list[tuple[object, object]]) -> None:
        """Treat locations as logs, which the functions write but do not depend on."""
        LOGS.add(changes, codes_of(root for _, root in self._roots))
