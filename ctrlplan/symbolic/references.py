"""All objects that functions refer to, and their fingerprint.

A compiled form contains the numbers that a block's functions used when they were
traced: globals, closures, defaults, attributes, entries of arrays. All of them
are part of the fingerprint. A block that refers to an object without a
fingerprint is not compiled, and the object is reported.
"""

from __future__ import annotations

import builtins
import enum
import functools
import hashlib
import io
import random
import types
from array import array
from collections import defaultdict, deque, namedtuple
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Frozen
from ctrlplan.symbolic.code import Code, code_of, codes_of, imported_modules
from ctrlplan.symbolic.contents import MISSING, Slots
from ctrlplan.symbolic.libraries import (
    HIDDEN,
    inherits_from_library,
    is_impure,
    is_impure_module,
    is_pure,
    written_in_python,
)
from ctrlplan.symbolic.logs import LOGS

_MAXIMUM = 20_000
"""Maximum number of objects of a fingerprint."""

_BYTES = 1 << 26
"""Maximum size of the arrays of a fingerprint in bytes."""

_LONG = 256
"""Size in bytes above which an array is represented by a digest."""

_ALL = frozenset(str.split("getattr vars __dict__ attrgetter astuple asdict copy deepcopy replace"))
"""Names in code that may access any attribute."""

_DULL = frozenset(
    str.split(
        "__slotnames__ __dict__ __weakref__ __module__ __doc__ __annotations__ __qualname__ __slots__ "
        "__repr__ __str__ __format__ "
        "__hash__ __reduce__ __reduce_ex__ __getstate__ __setstate__ __copy__ __deepcopy__ __del__ __init_subclass__ "
        "__match_args__ __replace__ __dataclass_fields__ __dataclass_params__ __parameters__ __orig_bases__ "
        "__abstractmethods__ _abc_impl __static_attributes__ __firstlineno__ __annotate__ __annotate_func__ "
        "__annotations_cache__ __subclasshook__ __class_getitem__ __classcell__ __type_params__"
    )
)
"""Attributes of a class without effect on the results of its objects."""

_MAKERS = frozenset(("__init__", "__post_init__", "__new__", "__set_name__"))
"""Methods that set attributes of new objects."""


class References:
    """All objects that some objects refer to, and their fingerprint.

    Parameters
    ----------
    roots : iterable of (str, object)
        Functions and other objects, with their names for messages.

    Attributes
    ----------
    tokens : tuple
        Fingerprint, equal if nothing has changed; it contains all objects that are
        compared by identity.
    cached : tuple
        Fingerprint of cached properties, which a first call adds to an object.
    opaque : str
        Description of the first object without a fingerprint; empty if there is
        none.
    names : set of str
        Names and strings in the code of the functions.
    objects : list
        All objects found.
    hidden : list
        Those with a state that cannot be read, such as generators.
    complete : bool
        Whether all objects were found; otherwise there are too many.
    bindings : list of (object, str, object)
        Names of modules, classes and closures, and their values.
    """

    def __init__(self, roots: Iterable[tuple[str, object]]) -> None:
        self.opaque = ""
        self.names: set[str] = set()
        self._tokens: list[object] = []
        self._seen: dict[int, int] = {}
        self.objects: list[object] = []  # references, so that no address is reused
        self.hidden: list[object] = []
        self.complete = True
        self._queue: deque[tuple[object, str]] = deque()
        self._named: list[tuple[object, str, set[str]]] = []  # objects of which the named attributes matter
        self.bindings: list[tuple[object, str, object]] = []
        self._cached: dict[str, object] = {}
        self._made: set[type] = set()  # classes that may be instantiated
        self._bytes = 0
        self.roots = tuple(roots)
        self._codes = codes_of(root for _, root in self.roots)
        try:
            self._walk()
        except Exception as error:  # any exception of an object during inspection
            self._hide(f"which cannot be inspected: {type(error).__name__}", "an object")
            self.complete = False
        self.tokens = tuple(self._tokens)
        self.cached = References(self._cached.items()).tokens if self._cached else ()

    def _walk(self) -> None:
        for where, root in self.roots:
            self._add(root, where)
        while self._queue:
            self._visit(*self._queue.popleft())
            if len(self.objects) > _MAXIMUM or self._bytes > _BYTES:
                self._hide("too large to be compared in every run", "objects and arrays")
                self.complete = False
                return
            if not self._queue:
                self._add_named()

    def _is_log(self, holder: object, key: object) -> bool:
        """Whether a location is known to be written by the functions without an effect on them."""
        return (holder, key, self._codes) in LOGS

    def _logs_of(self, holder: object) -> set[object]:
        """Such locations of an object."""
        return LOGS.keys_of(holder, self._codes)

    def _hide(self, what: str, where: str) -> None:
        self.opaque = self.opaque or f"{where} ({what})"

    def _add(self, value: object, where: str) -> None:
        """Add the token of a value, or its number among the objects, which are visited later."""
        kind = type(value)
        if kind in _ATOMS:
            self._tokens += (kind, value.hex() if type(value) is float else value)
            return
        if isinstance(value, type):
            self._made.update(value.__mro__)
        self._refer(value, where)

    def _refer(self, value: object, where: str) -> None:
        number = self._seen.get(id(value))
        if number is None:
            self._seen[id(value)] = number = len(self.objects)
            self.objects.append(value)
            self._queue.append((value, where))
        self._tokens += ("object", number)

    def _visit(self, value: object, where: str) -> None:
        kind = type(value)
        self._tokens.append(Same(kind))
        _visit_of(kind)(self, value, where)  # type: ignore[arg-type] # classes are hashable

    def _add_named(self) -> None:
        """Add attributes with names that occur in the code found so far."""
        every = not self.names.isdisjoint(_ALL)
        for holder, where, done in list(self._named):
            found = vars(holder) if not isinstance(holder, Slots) else holder.values()
            among: Iterable[str] = self.names.intersection(found) if isinstance(holder, types.ModuleType) else found
            fresh = [name for name in among if name not in done and self._counts(holder, name, every)]
            for name in sorted(fresh):
                done.add(name)
                if not self._is_log(holder, name):
                    self._tokens.append(name)
                    self._attribute(holder, name, found[name], f"{where}.{name}")

    def _counts(self, holder: object, name: str, every: bool) -> bool:
        """Whether an attribute may have an effect."""
        if isinstance(holder, types.ModuleType):
            return name in self.names
        if not isinstance(holder, type):
            cached = not isinstance(holder, Slots) and self._is_cached(holder, name, vars(holder)[name])
            return not cached and (name in self.names or every)
        if name in _MAKERS:
            return holder in self._made or not self.names.isdisjoint(("type", "__class__"))
        return name not in _DULL and (name in self.names or name.startswith("__") or inherits_from_library(holder))

    def _attribute(self, holder: object, name: str, value: object, where: str) -> None:
        if isinstance(holder, types.ModuleType) and is_pure(holder.__name__):
            if not isinstance(value, types.ModuleType | np.ndarray | list | dict | set) and type(value) not in _ATOMS:
                self._tokens.append(Same(value))  # functions and classes of a library: by identity
                return
        elif isinstance(holder, type):
            value = _unbound(value)
            self.bindings.append((holder, name, vars(holder)[name]))
        elif isinstance(holder, types.ModuleType):
            self.bindings.append((holder, name, value))
        self._add(value, where)

    # Types of objects

    def _function(self, value: types.FunctionType, where: str) -> None:
        code = code_of(value.__code__)
        self._tokens.append(code)
        self._add(value.__defaults__, f"{where}'s defaults")
        self._add(value.__kwdefaults__, f"{where}'s defaults")
        if value.__dict__:
            self._add(value.__dict__, f"{where}'s attributes")
        for name, cell in zip(value.__code__.co_freevars, value.__closure__ or (), strict=True):
            try:
                content = cell.cell_contents
            except ValueError:
                self._tokens.append("empty")
                continue
            self.bindings.append((cell, "cell_contents", content))
            if not self._is_log(cell, "cell_contents"):
                self._add(content, name)
        if is_pure(value.__globals__.get("__name__")):
            return
        self.names |= code.names
        self._globals(value.__globals__, code)

    def _globals(self, known: dict[str, object], code: Code) -> None:
        for name in code.imports:
            for module in imported_modules(name, str(known.get("__package__") or "")):
                self._add(module, name)
        for name in code.globals:
            self.bindings.append((known, name, known.get(name, MISSING)))
            if self._is_log(known, name):
                continue
            if name in known:
                self._add(known[name], name)
            elif name in HIDDEN:
                self._hide("not a function of its arguments", f"{name}()")
            else:
                self._tokens.append(Same(getattr(builtins, name, None)))

    def _method(self, value: types.MethodType, where: str) -> None:
        self._add(value.__func__, where)
        self._add(value.__self__, where.rpartition(".")[0] or f"the object of {where}")

    def _builtin(self, value: types.BuiltinFunctionType, where: str) -> None:
        owner = value.__self__
        if isinstance(owner, types.ModuleType) or owner is None:
            module = owner.__name__ if owner is not None else value.__module__
            if not is_pure(module):
                self._hide(f"a function of {module}", where)
            self._tokens.append(Same(value))
        else:
            self._tokens.append(value.__name__)
            self._add(owner, where)

    def _partial(self, value: functools.partial[object], where: str) -> None:
        for part in (value.func, value.args, value.keywords):
            self._add(part, where)
        self._dictionary(value.__dict__, where)

    def _module(self, value: types.ModuleType, where: str) -> None:
        self._tokens.append(Same(value))
        if is_impure_module(value.__name__):
            self._hide(f"module {value.__name__}", where)
        else:
            self._named.append((value, where, set()))

    def _class(self, value: type, where: str) -> None:
        self._tokens.append(Same(value))
        if is_impure(value):
            self._hide(f"class {value.__module__}.{value.__qualname__}", where)
        elif not is_pure(value.__module__):
            self._named.append((value, where, set()))
            for base in (type(value), *value.__mro__[1:-1]):
                self._refer(base, where)

    def _array(self, value: NDArray[np.generic], where: str) -> None:
        self._tokens += (value.shape, value.dtype.str)
        self._bytes += value.nbytes
        if value.dtype.hasobject:
            self._sequence(value, value.ravel().tolist(), where)
        elif self._bytes <= _BYTES:
            logs, content = self._logs_of(value), value
            if logs:
                content = value.copy()
                content.flat[slice(None) if None in logs else sorted(logs)] = 0
            self._tokens.append(_digest(content.tobytes()))
        if type(value) is not np.ndarray:
            self._attributes(value, where)
            if isinstance(value, np.ma.MaskedArray):
                self._add(np.ma.getmaskarray(value), where)

    def _sequence(self, holder: object, values: list[object], where: str) -> None:
        logs = self._logs_of(holder)
        if None in logs:
            return
        values = [None if k in logs else entry for k, entry in enumerate(values)] if logs else values
        numbers = [entry for entry in values if type(entry) is float]
        if values and len(numbers) == len(values):
            self._tokens += (len(values), _digest(array("d", numbers).tobytes()))
            return
        self._tokens.append(len(values))
        for k, entry in enumerate(values):
            self._add(entry, f"{where}[{k}]")

    def _container(self, value: list[object] | tuple[object, ...] | deque[object], where: str) -> None:
        self._sequence(value, list(value), where)
        self._attributes(value, where)

    def _dictionary(self, value: Mapping[Any, object], where: str) -> None:
        for key, entry in list(value.items()):
            if self._is_log(value, key):
                continue
            self._add(key, f"a key of {where}")
            self._add(entry, f"{where}[{key!r:.20}]")
        self._tokens.append("end")
        if type(value) not in (dict, types.MappingProxyType):
            self._attributes(value, where)
        if isinstance(value, defaultdict):
            self._add(value.default_factory, where)

    def _set(self, value: set[object] | frozenset[object], where: str) -> None:
        if all(type(entry) in _ATOMS for entry in value):
            self._tokens.append(frozenset((type(entry), entry) for entry in value))
        else:
            self._sequence(value, list(value), where)
        self._attributes(value, where)

    def _fixed(self, value: object, where: str) -> None:
        """Immutable values: numbers, strings, names of an enumeration."""
        if isinstance(value, np.generic):
            self._tokens += (value.dtype.str, value.tobytes())
        else:
            self._tokens.append(Same(value))
            self._attributes(value, where)

    def _identity(self, value: object, where: str) -> None:
        """Immutable objects, compared by identity."""
        if isinstance(value, np.ufunc) and "vectorized" in value.__name__:
            self._hide("made by numpy.frompyfunc", where)
        self._tokens.append(Same(value))

    def _member(self, value: enum.Enum, where: str) -> None:
        """Member of an enumeration, whose value and attributes may be mutable."""
        self._tokens.append(Same(value))
        self._add(value.__dict__, where)

    def _frozen(self, value: Frozen, where: str) -> None:
        """Immutable objects of this package, by identity except for parts of other classes."""
        if not is_pure(type(value).__module__):
            self._attributes(value, where)
            return
        self._tokens.append(Same(value))
        for entry in vars(value).values():
            for part in entry if isinstance(entry, tuple | list) else (entry,):
                if isinstance(part, Frozen):
                    self._refer(part, where)

    def _property(self, value: property, where: str) -> None:
        for part in (value.fget, value.fset):
            self._add(part, where)

    def _nothing(self, value: object, where: str) -> None:
        """Objects with a hidden state."""
        self._hide(_KINDS.get(type(value).__name__, f"an object of {type(value).__module__}"), where)
        self.hidden.append(value)
        self._tokens.append(Same(value))

    def _instance(self, value: object, where: str) -> None:
        kind = type(value)
        if is_impure(kind) or not all(written_in_python(base) for base in kind.__mro__[:-1]):
            self._hide(_KINDS.get(kind.__name__, f"an object of {kind.__module__}.{kind.__qualname__}"), where)
            self.hidden.append(value)
            self._tokens.append(Same(value))
            return
        self._attributes(value, where)

    def _attributes(self, value: object, where: str) -> None:
        """Class and attributes of an object: named ones if all its methods are known, otherwise all."""
        kind = type(value)
        self._refer(kind, f"class {kind.__name__}")
        known = not is_dataclass(kind) and not inherits_from_library(kind)
        for holder in (value, Slots(value)):
            own = holder.values() if isinstance(holder, Slots) else getattr(holder, "__dict__", None)
            if not own:
                continue
            if holder is not value:
                self.objects.append(holder)
            if known:
                self._named.append((holder, where, set()))
            else:
                for name, entry in list(own.items()):
                    if not self._is_cached(value, name, entry) and not self._is_log(value, name):
                        self._tokens.append(name)
                        self._add(entry, f"{where}.{name}")

    def _is_cached(self, value: object, name: str, entry: object) -> bool:
        """Whether an attribute is the value of a cached property, which is stored separately."""
        if not isinstance(getattr(type(value), name, None), functools.cached_property):
            return False
        self._cached[f"{name} of {id(value)}"] = entry
        return True


class Same:
    """Token of an object that is equal for the same object only, and references it."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


_ATOMS = frozenset((type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented)))

_KINDS = {
    "Generator": "random numbers",
    "RandomState": "random numbers",
    "Random": "random numbers",
    "SystemRandom": "random numbers",
    "generator": "a generator",
    "_lru_cache_wrapper": "a cache, functools.lru_cache",
}

_Fields = type(vars(namedtuple("_", "field"))["field"])

_READERS = (io.IOBase, random.Random, np.random.Generator, np.random.RandomState, np.random.BitGenerator)

_VISITS: tuple[tuple[type | tuple[type, ...], Callable[[References, Any, str], None]], ...] = (
    (types.FunctionType, References._function),
    (types.MethodType, References._method),
    (types.BuiltinFunctionType, References._builtin),
    (functools.partial, References._partial),
    (_READERS, References._nothing),
    (np.ndarray, References._array),
    ((list, tuple, deque), References._container),
    ((dict, types.MappingProxyType), References._dictionary),
    ((set, frozenset), References._set),
    (types.ModuleType, References._module),
    (enum.Enum, References._member),
    (type, References._class),
    ((np.ufunc, np.dtype, type(np.where), types.CodeType, range, slice), References._identity),
    ((types.MethodDescriptorType, types.WrapperDescriptorType), References._identity),
    ((types.GetSetDescriptorType, types.MemberDescriptorType, _Fields), References._identity),
    ((types.MethodWrapperType, types.ClassMethodDescriptorType), References._identity),
    (property, References._property),
    (Frozen, References._frozen),
    ((int, float, complex, str, bytes, np.generic), References._fixed),
    ((Iterator, types.CoroutineType, functools._lru_cache_wrapper), References._nothing),
)
"""Methods by type of object; the first match applies."""


@functools.lru_cache(maxsize=1024)
def _visit_of(kind: type) -> Callable[[References, Any, str], None]:
    """Method for the objects of a type."""
    return next((visit for kinds, visit in _VISITS if issubclass(kind, kinds)), References._instance)


def _unbound(value: object) -> object:
    """Function of an entry of a class."""
    if isinstance(value, staticmethod | classmethod):
        return value.__func__
    return value.func if isinstance(value, functools.cached_property) else value


def _digest(content: bytes) -> bytes:
    return content if len(content) <= _LONG else hashlib.blake2b(content, digest_size=16).digest()
