"""What runs of a system have brought: its compiled forms, and which parameters are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ctrlplan._lru import BUILDING
from ctrlplan._types import Params
from ctrlplan.symbolic.fingerprint import value_token

if TYPE_CHECKING:
    from ctrlplan.simulation.compiled import Compiled

_CACHE_SIZE = 8
"""Maximum number of compiled forms of a system."""


class NotApplicableError(ValueError):
    """A method of simulation that does not apply to a system, and why."""


class NotCompiledError(NotApplicableError):
    """A system that cannot be compiled, and why."""


class DisagreementError(NotCompiledError):
    """A compiled system that is not what Python says at states that a run visited."""


@dataclass(frozen=True, eq=False)
class BuiltForm:
    """Compiled form, or why there is none, for some names of parameters.

    Attributes
    ----------
    names : frozenset of str
        Parameters of the run for which it was built.
    constants : dict
        Those that are constants in it, with their fingerprints.
    form : Compiled or NotCompiledError
        What was built.
    """

    names: frozenset[str]
    constants: dict[str, tuple[object, ...]]
    form: Compiled | NotCompiledError

    def fits(self, params: Params) -> bool:
        """Whether it holds for some parameters."""
        scalars = isinstance(self.form, NotCompiledError) or all(
            np.ndim(params.get(name, 0.0)) == 0 for name in self.form.symbols
        )
        constants = self.constants.items()
        return (
            self.names == frozenset(params) and scalars and all(value_token(params[key]) == v for key, v in constants)
        )


class BuiltForms:
    """Forms and findings of one system; safe in threads.

    A form is built once, and so is a finding made: the same call gets the same
    one again. A form that was found wrong is not used again.
    """

    def __init__(self, forms: Iterable[BuiltForm] = ()) -> None:
        self.forms: tuple[BuiltForm, ...] = tuple(forms)
        self._rebuilt: tuple[BuiltForm, ...] = ()
        self._read: dict[str, bool] = {}

    def form(self, params: Params, build: Callable[[], BuiltForm]) -> Compiled:
        """Form for some parameters, built once for all their values.

        Raises
        ------
        NotCompiledError
            If there is none; the reason is in the message.
        """
        found = self._known(params)
        if found is None:
            with BUILDING:
                found = self._known(params)
                if found is None:
                    found = build()
                    self.forms = (*self.forms[1 - _CACHE_SIZE :], found)
        if isinstance(found.form, NotCompiledError):
            raise NotCompiledError(str(found.form))
        return found.form

    def discard(self, form: Compiled, why: str) -> DisagreementError:
        """Drop a form that was found wrong: the first time it may be built again, as its functions may have changed."""
        with BUILDING:
            retained = []
            for entry in self.forms:
                if entry.form is not form:
                    retained.append(entry)
                elif any(entry.names == e.names and entry.constants == e.constants for e in self._rebuilt):
                    retained.append(replace(entry, form=NotCompiledError(why)))
                else:
                    self._rebuilt = (*self._rebuilt[1 - _CACHE_SIZE :], replace(entry, form=NotCompiledError(why)))
            self.forms = tuple(retained)
        return DisagreementError(why)

    def reads(self, name: str, find: Callable[[], bool]) -> bool:
        """Whether a parameter is read by a block, found out once."""
        with BUILDING:  # trial calls put back what they found: one thread at a time
            if name not in self._read:
                self._read[name] = find()
            return self._read[name]

    def usable(self) -> BuiltForms:
        """Forms that another process can use."""
        return BuiltForms(entry for entry in self.forms if not isinstance(entry.form, NotCompiledError))

    def for_any(self, names: Iterable[str]) -> BuiltForms:
        """Forms that hold for any values of some parameters."""
        wanted = frozenset(names)
        return BuiltForms(entry for entry in self.forms if entry.names == wanted and not entry.constants)

    def _known(self, params: Params) -> BuiltForm | None:
        return next((entry for entry in self.forms if entry.fits(params)), None)
