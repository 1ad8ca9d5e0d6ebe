"""Trial calls of functions that leave behind what they found.

For calls with symbols, which must not stay anywhere, and to tell whether calls
have changed anything: what cannot be put back is not called. Calls with numbers
are made on copies, see `ctrlplan.symbolic.trials`.
"""

from __future__ import annotations

from ctrlplan.symbolic.code import codes_of
from ctrlplan.symbolic.contents import bind, bound, changed_keys, contents_of, put_back
from ctrlplan.symbolic.logs import LOGS
from ctrlplan.symbolic.references import References


class Keeper:
    """Contents of all that some functions refer to, to be put back after trial calls.

    Parameters
    ----------
    references : References
        What is kept, as it is now; nothing of it may be opaque.
    """

    def __init__(self, references: References) -> None:
        self._roots, self._tokens = references.roots, references.tokens
        self._bindings = list(references.bindings)
        self._contents = [(value, found) for value in references.objects if (found := contents_of(value)) is not None]

    def changes(self) -> list[tuple[object, object]]:
        """Places (object, key or attribute, None for all) whose contents differ; none where it has no effect."""
        if References(self._roots).tokens == self._tokens:
            return []
        found: list[tuple[object, object]] = [
            (value, key) for value, before in self._contents for key in changed_keys(value, before)
        ]
        return found + [(holder, key) for holder, key, value in self._bindings if bound(holder, key) is not value]

    def restore(self) -> None:
        """Put everything back."""
        for value, before in self._contents:
            if changed_keys(value, before):
                put_back(value, before)
        for holder, key, value in self._bindings:
            if bound(holder, key) is not value:
                bind(holder, key, value)

    def ignore(self, changes: list[tuple[object, object]]) -> None:
        """Take some places for logs, which the functions write and do not depend on."""
        LOGS.add(changes, codes_of(root for _, root in self._roots))
