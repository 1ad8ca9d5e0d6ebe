"""Cache of the compiled forms of a system, and of which parameters are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ctrlplan._lru import BUILDING, Lru
from ctrlplan._types import Params
from ctrlplan.symbolic.fingerprint import value_token

if TYPE_CHECKING:
    from ctrlplan.simulation.compiled import Compiled
    from ctrlplan.symbolic.tracing import Trace

_CACHE_SIZE = 8
"""Maximum number of compiled forms of a system."""

_TRACES = 64
"""Maximum number of traces of blocks that a context of `shared_forms` keeps."""


class NotApplicableError(ValueError):
    """A method of simulation does not apply to a system; the message gives the reason."""


class NotCompiledError(NotApplicableError):
    """A system cannot be compiled; the message gives the reason."""


class DisagreementError(NotCompiledError):
    """A compiled system disagrees with Python at states of a run."""


@dataclass(frozen=True, eq=False)
class BuiltForm:
    """Compiled form for given names of parameters, or the reason why there is none.

    Attributes
    ----------
    names : frozenset of str
        Names of the parameters for which it was built.
    constants : dict
        Parameters that are constants in it, with their fingerprints.
    form : Compiled or NotCompiledError
        The compiled form, or the error.
    """

    names: frozenset[str]
    constants: dict[str, tuple[object, ...]]
    form: Compiled | NotCompiledError

    def fits(self, params: Params) -> bool:
        """Whether the form is valid for given parameters."""
        scalars = isinstance(self.form, NotCompiledError) or all(
            np.ndim(params.get(name, 0.0)) == 0 for name in self.form.symbols
        )
        constants = self.constants.items()
        return (
            self.names == frozenset(params) and scalars and all(value_token(params[key]) == v for key, v in constants)
        )


@contextmanager
def shared_forms() -> Iterator[None]:
    """Compile loops with equal blocks and connections once in a context, as those of several plans.

    A loop that differs in its sources and in the times, states and parameters of
    its runs has the same equations. Equal blocks of different loops, as the plant
    under several laws, are traced once. If a run of them has to be repeated with closer
    tolerances, later ones begin with these. Contexts inside another one share its forms.
    """
    if _SHARED.get() is not None:
        yield
        return
    token = _SHARED.set(_Shared())
    try:
        yield
    finally:
        _SHARED.reset(token)


class _Shared:
    """What a context of `shared_forms` keeps.

    Attributes
    ----------
    forms : Lru
        Compiled forms by structure.
    traces : Lru
        Traces of blocks by structure.
    close : set of (Compiled, float)
        Forms and relative tolerances of runs that were repeated with closer states.
    """

    def __init__(self) -> None:
        self.forms: Lru[tuple[object, ...], BuiltForm] = Lru(_CACHE_SIZE)
        self.traces: Lru[tuple[object, ...], Trace] = Lru(_TRACES)
        self.close: set[tuple[Compiled, float]] = set()


_SHARED: ContextVar[_Shared | None] = ContextVar("shared", default=None)


def expects_closer_states(form: Compiled, rtol: float) -> bool:
    """Whether a run of a form was repeated with closer states before, in this context of `shared_forms`."""
    shared = _SHARED.get()
    return shared is not None and (form, rtol) in shared.close


def expect_closer_states(form: Compiled, rtol: float) -> None:
    """Let later runs of a form begin with closer states, in a context of `shared_forms`."""
    shared = _SHARED.get()
    if shared is not None:
        shared.close.add((form, rtol))


def built_once(structure: Callable[[], tuple[object, ...] | None], build: Callable[[], BuiltForm]) -> BuiltForm:
    """Form of a structure, built once in a context of `shared_forms`; every time for the structure None."""
    shared = _SHARED.get()
    key = None if shared is None else structure()
    if shared is None or key is None:
        return build()
    try:
        return shared.forms.get(key, lambda: _compiled(build()))
    except _NotBuiltError as error:
        return error.form


def traced_once(structure: Callable[[], tuple[object, ...] | None], trace: Callable[[], Trace]) -> Trace:
    """Trace of a block of a structure, made once in a context of `shared_forms`; every time for the structure None."""
    shared = _SHARED.get()
    key = None if shared is None else structure()
    return trace() if shared is None or key is None else shared.traces.get(key, trace)


class _NotBuiltError(Exception):
    """There is no compiled form; the reason may depend on the run."""

    def __init__(self, form: BuiltForm) -> None:
        super().__init__(str(form.form))
        self.form = form


def _compiled(built: BuiltForm) -> BuiltForm:
    if isinstance(built.form, NotCompiledError):
        raise _NotBuiltError(built)
    return built


class BuiltForms:
    """Compiled forms of one system and results of trial calls; thread-safe.

    Each is computed once, so that equal calls give equal results. A form that
    disagrees with Python is not used again.
    """

    def __init__(self, forms: Iterable[BuiltForm] = ()) -> None:
        self.forms: tuple[BuiltForm, ...] = tuple(forms)
        self._rebuilt: tuple[BuiltForm, ...] = ()
        self._read: dict[str, bool] = {}

    def form(self, params: Params, build: Callable[[], BuiltForm]) -> Compiled:
        """Form for given parameters, built once for all their values.

        Raises
        ------
        NotCompiledError
            If there is none; the message gives the reason.
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
        """Discard a wrong form; it may be rebuilt once, since its functions may have changed."""
        shared = _SHARED.get()
        if shared is not None:
            shared.forms.clear()
            shared.traces.clear()
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
        """Whether a parameter is read by a block; determined once."""
        with BUILDING:  # trial calls restore what they change: one thread at a time
            if name not in self._read:
                self._read[name] = find()
            return self._read[name]

    def usable(self) -> BuiltForms:
        """Forms that can be used by another process."""
        return BuiltForms(entry for entry in self.forms if not isinstance(entry.form, NotCompiledError))

    def for_any(self, names: Iterable[str]) -> BuiltForms:
        """Forms that are valid for all values of given parameters."""
        requested = frozenset(names)
        return BuiltForms(entry for entry in self.forms if entry.names == requested and not entry.constants)

    def _known(self, params: Params) -> BuiltForm | None:
        return next((entry for entry in self.forms if entry.fits(params)), None)
