"""What functions refer to: whether it has changed, and how to put it back.

A compiled form holds the numbers that a block's functions found when they were
traced: globals, closures, defaults, attributes, entries of arrays. All of them
are in the fingerprint; what cannot be is named, and its block is not compiled.
"""

from __future__ import annotations

import builtins
import dis
import enum
import functools
import hashlib
import io
import random
import sys
import types
from array import array
from collections import OrderedDict, defaultdict, deque, namedtuple
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from typing import Any

import numpy as np

from ctrlplan._types import Frozen
from ctrlplan.traits import traits_of

_MOST = 20_000
"""Objects that a fingerprint covers."""

_BYTES = 1 << 26
"""Bytes of arrays that a fingerprint covers."""

_LONG = 256
"""Bytes above which an array is represented by a digest."""

_IMPURE = frozenset(
    str.split(
        "time datetime random secrets uuid os sys io socket threading subprocess multiprocessing asyncio pathlib "
        "tempfile inspect gc weakref ctypes signal select shelve sqlite3 logging urllib http platform shutil glob"
    )
)
"""Modules of the standard library whose functions depend on more than their arguments."""

_PURE = frozenset(
    str.split(
        "numpy scipy control casadi ctrlplan builtins math cmath operator functools itertools collections copy numbers "
        "fractions decimal statistics typing types dataclasses enum abc contextlib warnings array bisect heapq string "
        "re _abc _collections _collections_abc _functools _operator _bisect _heapq _decimal _statistics _weakrefset"
    )
)
"""Modules whose functions depend on nothing but their arguments and closures."""

_HIDDEN = frozenset(str.split("open input eval exec globals locals __import__ compile id breakpoint"))
"""Built-in functions whose results are not functions of their arguments."""

_ALL = frozenset(str.split("getattr vars __dict__ attrgetter astuple asdict copy deepcopy replace"))
"""Names in a code that may stand for any attribute."""

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
"""Attributes of a class without influence on what its objects return."""

_MAKERS = frozenset(("__init__", "__post_init__", "__new__", "__set_name__"))
"""Methods that set attributes of objects that are new."""


@dataclass(frozen=True, eq=False)
class Code:
    """Names in a code and in those inside it: globals, attributes and strings, imported modules."""

    globals: tuple[str, ...]
    names: frozenset[str]
    imports: tuple[str, ...]


class References:
    """All that some objects refer to.

    Parameters
    ----------
    roots : iterable of (str, object)
        Functions and other objects, with what they are called in messages.

    Attributes
    ----------
    tokens : tuple
        Equal where nothing has changed; it holds on to all that it compares by identity.
    cached : tuple
        The same of cached properties, which a first call adds to an object.
    opaque : str
        First of what cannot be fingerprinted, in words; empty where there is none.
    names : set of str
        Names and strings in the code of the functions.
    """

    def __init__(self, roots: Iterable[tuple[str, Any]]) -> None:
        self.opaque = ""
        self.names: set[str] = set()
        self._tokens: list[object] = []
        self._seen: dict[int, int] = {}
        self._objects: list[Any] = []  # alive, so that no address is given to another
        self._queue: deque[tuple[Any, str]] = deque()
        self._named: list[tuple[Any, str, set[str]]] = []  # of these the attributes that are named count
        self._bindings: list[tuple[Any, str, Any]] = []
        self._cached: dict[str, Any] = {}
        self._made: set[type] = set()  # classes that may be called
        self._bytes = 0
        self._roots = tuple(roots)
        self._codes = _codes(root for _, root in self._roots)
        try:
            self._walk()
        except Exception as error:  # whatever an object does when it is looked at
            self._hide(f"which cannot be looked into: {type(error).__name__}", "an object")
        self.tokens = tuple(self._tokens)
        self.cached = References(self._cached.items()).tokens if self._cached else ()

    def _walk(self) -> None:
        for where, root in self._roots:
            self._add(root, where)
        while self._queue:
            self._visit(*self._queue.popleft())
            if len(self._objects) > _MOST or self._bytes > _BYTES:
                self._hide("too large to be compared in every run", "objects and arrays")
                return
            if not self._queue:
                self._add_named()

    def keeper(self) -> Keeper:
        """Contents of all that was found, to be put back."""
        return Keeper(self._roots, self.tokens, self._objects, self._bindings)

    def _is_log(self, holder: Any, key: Any) -> bool:
        """Whether a place is known to be written by the functions, and to have no influence on them."""
        known = _LOGS.get((id(holder), key))
        return known is not None and known[0] is holder and self._codes <= known[1]

    def _logs_of(self, holder: Any) -> set[Any]:
        """Such places in an object."""
        return {key for number, key in list(_LOGS) if number == id(holder) and self._is_log(holder, key)}

    def _hide(self, what: str, where: str) -> None:
        self.opaque = self.opaque or f"{where} ({what})"

    def _add(self, value: Any, where: str) -> None:
        """Token of a value, or its number among the objects, which are visited later."""
        kind = type(value)
        if kind in _ATOMS:
            self._tokens += (kind, value.hex() if kind is float else value)
            return
        if isinstance(value, type):
            self._made.update(value.__mro__)
        self._refer(value, where)

    def _refer(self, value: Any, where: str) -> None:
        number = self._seen.get(id(value))
        if number is None:
            self._seen[id(value)] = number = len(self._objects)
            self._objects.append(value)
            self._queue.append((value, where))
        self._tokens += ("object", number)

    def _visit(self, value: Any, where: str) -> None:
        kind = type(value)
        self._tokens.append(_Same(kind))
        for kinds, visit in _VISITS:
            if isinstance(value, kinds):
                visit(self, value, where)
                return
        self._instance(value, where)

    def _add_named(self) -> None:
        """Attributes by the names that occur in the code found so far."""
        every = not self.names.isdisjoint(_ALL)
        for holder, where, done in list(self._named):
            found = vars(holder) if not isinstance(holder, _Slots) else holder.values()
            among: Iterable[str] = self.names.intersection(found) if isinstance(holder, types.ModuleType) else found
            fresh = [name for name in among if name not in done and self._counts(holder, name, every)]
            for name in sorted(fresh):
                done.add(name)
                if not self._is_log(holder, name):
                    self._tokens.append(name)
                    self._attribute(holder, name, found[name], f"{where}.{name}")

    def _counts(self, holder: Any, name: str, every: bool) -> bool:
        """Whether an attribute may have an influence."""
        if isinstance(holder, types.ModuleType):
            return name in self.names
        if not isinstance(holder, type):
            cached = not isinstance(holder, _Slots) and self._is_cached(holder, name, vars(holder)[name])
            return not cached and (name in self.names or every)
        if name in _MAKERS:
            return holder in self._made or not self.names.isdisjoint(("type", "__class__"))
        return name not in _DULL and (name in self.names or name.startswith("__") or _of_library(holder))

    def _attribute(self, holder: Any, name: str, value: Any, where: str) -> None:
        if isinstance(holder, types.ModuleType) and _pure(holder.__name__):
            if not isinstance(value, types.ModuleType | np.ndarray | list | dict | set) and type(value) not in _ATOMS:
                self._tokens.append(_Same(value))  # functions and classes of a library: by identity
                return
        elif isinstance(holder, type):
            value = _unbound(value)
            self._bindings.append((holder, name, vars(holder)[name]))
        elif isinstance(holder, types.ModuleType):
            self._bindings.append((holder, name, value))
        self._add(value, where)

    # Kinds of objects

    def _function(self, value: types.FunctionType, where: str) -> None:
        code = _code(value.__code__)
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
            self._bindings.append((cell, "cell_contents", content))
            if not self._is_log(cell, "cell_contents"):
                self._add(content, name)
        if _pure(value.__globals__.get("__name__")):
            return
        self.names |= code.names
        self._globals(value.__globals__, code)

    def _globals(self, known: dict[str, Any], code: Code) -> None:
        for name in code.imports:
            for module in _imported(name, str(known.get("__package__") or "")):
                self._add(module, name)
        for name in code.globals:
            self._bindings.append((known, name, known.get(name, _MISSING)))
            if self._is_log(known, name):
                continue
            if name in known:
                self._add(known[name], name)
            elif name in _HIDDEN:
                self._hide("no function of its arguments", f"{name}()")
            else:
                self._tokens.append(_Same(getattr(builtins, name, None)))

    def _method(self, value: types.MethodType, where: str) -> None:
        self._add(value.__func__, where)
        self._add(value.__self__, where.rpartition(".")[0] or f"the object of {where}")

    def _builtin(self, value: types.BuiltinFunctionType, where: str) -> None:
        owner = value.__self__
        if isinstance(owner, types.ModuleType) or owner is None:
            module = owner.__name__ if owner is not None else value.__module__
            if not _pure(module):
                self._hide(f"a function of {module}", where)
            self._tokens.append(_Same(value))
        else:
            self._tokens.append(value.__name__)
            self._add(owner, where)

    def _partial(self, value: functools.partial[Any], where: str) -> None:
        for part in (value.func, value.args, value.keywords):
            self._add(part, where)
        self._dictionary(value.__dict__, where)

    def _module(self, value: types.ModuleType, where: str) -> None:
        self._tokens.append(_Same(value))
        root = value.__name__.partition(".")[0]
        if root in _IMPURE or value.__name__.startswith("numpy.random"):
            self._hide(f"module {value.__name__}", where)
        else:
            self._named.append((value, where, set()))

    def _class(self, value: type, where: str) -> None:
        self._tokens.append(_Same(value))
        if _impure(value):
            self._hide(f"class {value.__module__}.{value.__qualname__}", where)
        elif not _pure(value.__module__):
            self._named.append((value, where, set()))
            for base in (type(value), *value.__mro__[1:-1]):
                self._refer(base, where)

    def _array(self, value: np.ndarray[Any, Any], where: str) -> None:
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

    def _sequence(self, holder: Any, values: list[Any], where: str) -> None:
        logs = self._logs_of(holder)
        if None in logs:
            return
        values = [None if k in logs else entry for k, entry in enumerate(values)] if logs else values
        if set(map(type, values)) == {float}:
            self._tokens += (len(values), _digest(array("d", values).tobytes()))
            return
        self._tokens.append(len(values))
        for k, entry in enumerate(values):
            self._add(entry, f"{where}[{k}]")

    def _container(self, value: Any, where: str) -> None:
        self._sequence(value, list(value), where)
        self._attributes(value, where)

    def _dictionary(self, value: Any, where: str) -> None:
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

    def _set(self, value: Any, where: str) -> None:
        if all(type(entry) in _ATOMS for entry in value):
            self._tokens.append(frozenset((type(entry), entry) for entry in value))
        else:
            self._sequence(value, list(value), where)
        self._attributes(value, where)

    def _fixed(self, value: Any, where: str) -> None:
        """Values that cannot change: numbers, texts, names of an enumeration."""
        if isinstance(value, np.generic):
            self._tokens += (value.dtype.str, value.tobytes())
        else:
            self._tokens.append(_Same(value))
            self._attributes(value, where)

    def _identity(self, value: Any, where: str) -> None:
        """Objects of which no part can change."""
        if isinstance(value, np.ufunc) and "vectorized" in value.__name__:
            self._hide("made by numpy.frompyfunc", where)
        self._tokens.append(_Same(value))

    def _member(self, value: enum.Enum, where: str) -> None:
        """Member of an enumeration, whose value and attributes may be mutable."""
        self._tokens.append(_Same(value))
        self._add(value.__dict__, where)

    def _frozen(self, value: Frozen, where: str) -> None:
        """Immutable objects of this package: by identity, but for parts that may be a user's."""
        if not _pure(type(value).__module__):
            self._attributes(value, where)
            return
        self._tokens.append(_Same(value))
        for entry in vars(value).values():
            for part in entry if isinstance(entry, tuple | list) else (entry,):
                if isinstance(part, Frozen):
                    self._refer(part, where)

    def _property(self, value: property, where: str) -> None:
        for part in (value.fget, value.fset):
            self._add(part, where)

    def _nothing(self, value: Any, where: str) -> None:
        """Objects with a state that does not show."""
        self._hide(_KINDS.get(type(value).__name__, f"an object of {type(value).__module__}"), where)
        self._tokens.append(_Same(value))

    def _instance(self, value: Any, where: str) -> None:
        kind = type(value)
        if _impure(kind) or not all(_written_in_python(base) for base in kind.__mro__[:-1]):
            self._hide(_KINDS.get(kind.__name__, f"an object of {kind.__module__}.{kind.__qualname__}"), where)
            self._tokens.append(_Same(value))
            return
        self._attributes(value, where)

    def _attributes(self, value: Any, where: str) -> None:
        """Class and attributes of an object: those that are named where all its methods are known, or all."""
        kind = type(value)
        self._refer(kind, f"class {kind.__name__}")
        known = not is_dataclass(kind) and not _of_library(kind)
        for holder in (value, _Slots(value)):
            own = getattr(holder, "__dict__", None) if holder is value else holder.values()
            if not own:
                continue
            if holder is not value:
                self._objects.append(holder)
            if known:
                self._named.append((holder, where, set()))
            else:
                for name, entry in list(own.items()):
                    if not self._is_cached(value, name, entry) and not self._is_log(value, name):
                        self._tokens.append(name)
                        self._add(entry, f"{where}.{name}")

    def _is_cached(self, value: Any, name: str, entry: Any) -> bool:
        """Whether an attribute is that of a cached property, which is kept apart."""
        if not isinstance(getattr(type(value), name, None), functools.cached_property):
            return False
        self._cached[f"{name} of {id(value)}"] = entry
        return True


def roots_of(system: Any) -> Iterator[tuple[str, Any]]:
    """Functions of a block that a compiled form is made of; those of a sampled block are run by Python."""
    for name in ("outfcn",) if traits_of(system).period is not None else ("outfcn", "updfcn"):
        function = getattr(system, name, None)
        if function is not None:
            yield getattr(function, "__name__", name), function


class _Same:
    """Token of an object that is equal to itself alone, and keeps it."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


class _Slots:
    """Attributes of an object that its classes keep in slots."""

    def __init__(self, value: Any) -> None:
        self.value = value
        self.places = {
            name: member
            for base in type(value).__mro__
            for name, member in vars(base).items()
            if isinstance(member, types.MemberDescriptorType) and _written_in_python(base)
        }

    def values(self) -> dict[str, Any]:
        found = {}
        for name, member in self.places.items():
            try:
                found[name] = member.__get__(self.value)
            except AttributeError:
                continue
        return found


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

_VISITS: tuple[tuple[Any, Callable[[References, Any, str], None]], ...] = (
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
"""What is done with objects of some kinds, the first that fits."""


@functools.lru_cache(maxsize=4096)
def _code(code: types.CodeType) -> Code:
    globals_: dict[str, None] = {}
    imports: dict[str, None] = {}
    names: set[str] = set()
    for step in dis.get_instructions(code):
        name = step.argval if isinstance(step.argval, str) else ""
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME", "STORE_GLOBAL"):
            globals_[name] = None
        elif step.opname == "IMPORT_NAME":
            imports[name] = None
        if "ATTR" in step.opname or "METHOD" in step.opname or step.opname == "IMPORT_FROM":
            names.add(name)
    for constant in code.co_consts:
        names |= _strings(constant)
        if isinstance(constant, types.CodeType):
            inner = _code(constant)
            globals_ |= dict.fromkeys(inner.globals)
            imports |= dict.fromkeys(inner.imports)
            names |= inner.names
    return Code(tuple(globals_), frozenset(names.union(code.co_varnames, globals_)), tuple(imports))


def _imported(name: str, package: str) -> Iterator[types.ModuleType]:
    """Modules that an import inside a function may mean, in its package or a level above."""
    parts = package.split(".") if package else []
    for n in range(len(parts) + 1):
        module = sys.modules.get(".".join([*parts[:n], name]).strip("."))
        if module is not None:
            yield module


def _strings(constant: Any) -> set[str]:
    if isinstance(constant, str):
        return {constant}
    return set().union(*map(_strings, constant)) if isinstance(constant, tuple | frozenset) else set()


def _pure(module: Any) -> bool:
    return isinstance(module, str) and module.partition(".")[0] in _PURE and not module.startswith("numpy.random")


def _of_library(kind: type) -> bool:
    """Whether functions of a library may use attributes of an object that no other code names."""
    return any(_pure(base.__module__) and base.__module__ not in ("builtins", "abc", "typing") for base in kind.__mro__)


def _impure(kind: type) -> bool:
    module = str(kind.__module__)
    return module.partition(".")[0] in _IMPURE or module.startswith("numpy.random")


def _written_in_python(kind: type) -> bool:
    """Whether all that an object of a class holds are attributes."""
    own = vars(kind)
    return "__dict__" in own or "__slots__" in own or "__weakref__" in own or kind is object or _plain_child(kind)


def _plain_child(kind: type) -> bool:
    """Class of Python without attributes of its own beyond those of its bases."""
    return "__module__" in vars(kind) and bool(kind.__flags__ & (1 << 9)) and kind.__base__ is not object


def _unbound(value: Any) -> Any:
    """Function behind what stands in a class."""
    if isinstance(value, staticmethod | classmethod):
        return value.__func__
    return value.func if isinstance(value, functools.cached_property) else value


def _digest(content: bytes) -> bytes:
    return content if len(content) <= _LONG else hashlib.blake2b(content, digest_size=16).digest()


class Keeper:
    """Contents of objects at one time, what has changed of them since, and how to put them back."""

    def __init__(
        self,
        roots: tuple[tuple[str, Any], ...],
        tokens: tuple[object, ...],
        objects: list[Any],
        bindings: list[tuple[Any, str, Any]],
    ) -> None:
        self._roots, self._tokens, self._bindings = roots, tokens, list(bindings)
        self._contents = [(value, found) for value in objects if (found := _contents(value)) is not None]

    def changes(self) -> list[tuple[Any, Any]]:
        """Places (object, key or attribute, None for all) whose contents differ; none where it has no effect."""
        if References(self._roots).tokens == self._tokens:
            return []
        found = [(value, key) for value, before in self._contents for key in _changed(value, before)]
        return found + [(holder, key) for holder, key, value in self._bindings if _bound(holder, key) is not value]

    def restore(self) -> None:
        """Put everything back."""
        for value, before in self._contents:
            if _changed(value, before):
                _restore(value, before)
        for holder, key, value in self._bindings:
            if _bound(holder, key) is not value:
                _bind(holder, key, value)

    def ignore(self, changes: list[tuple[Any, Any]]) -> None:
        """Take some places for logs, which the functions write and do not depend on."""
        codes = _codes(root for _, root in self._roots)
        for holder, key in changes:
            _, known = _LOGS.pop((id(holder), key), (holder, frozenset()))
            _LOGS[id(holder), key] = holder, known | codes
        while len(_LOGS) > _FEW:
            _LOGS.popitem(last=False)


_LOGS: OrderedDict[tuple[int, Any], tuple[Any, frozenset[types.CodeType]]] = OrderedDict()
"""Places that are logs or counters, and the functions that they have no influence on."""

_FEW = 256
"""Logs kept in mind; entries of an array of which some may be counters."""

_MISSING = object()


def _codes(roots: Iterable[Any]) -> frozenset[types.CodeType]:
    """Code of the functions among some objects."""
    functions = (getattr(root, "__func__", root) for root in roots)
    return frozenset(function.__code__ for function in functions if isinstance(function, types.FunctionType))


def _bound(holder: Any, key: str) -> Any:
    if isinstance(holder, types.CellType):
        try:
            return holder.cell_contents
        except ValueError:
            return _MISSING
    return (holder if isinstance(holder, dict) else vars(holder)).get(key, _MISSING)


def _bind(holder: Any, key: str, value: Any) -> None:
    if not isinstance(holder, dict):
        setattr(holder, key, value)
    elif value is _MISSING:
        holder.pop(key, None)
    else:
        holder[key] = value


def _changed(value: Any, before: Any) -> list[Any]:
    """Keys of an object under which it holds something else than before; None stands for all."""
    now = _contents(value)
    if isinstance(value, np.ndarray):
        if not value.dtype.hasobject and now.tobytes() == before.tobytes():
            return []
        pairs = zip(now.flat, before.flat, strict=True)
        if value.dtype.hasobject:
            return [k for k, (a, b) in enumerate(pairs) if a is not b]
        return [k for k, (a, b) in enumerate(pairs) if a != b] if value.size <= _FEW else [None]
    if isinstance(before, list | deque | bytearray) and len(now) == len(before):
        return [k for k, (a, b) in enumerate(zip(now, before, strict=True)) if a is not b]
    if isinstance(before, dict):
        return [key for key in {**before, **now} if now.get(key, _MISSING) is not before.get(key, _MISSING)]
    return [] if now == before else [None]


def _contents(value: Any) -> Any:
    """Copy of what an object holds itself, or None where it cannot change."""
    if isinstance(value, np.ndarray):
        return value.copy() if value.flags.writeable else None
    if isinstance(value, list | dict | set | bytearray | deque):
        return value.copy()
    if isinstance(value, _Slots):
        return value.values()
    own = getattr(value, "__dict__", None) if not isinstance(value, Frozen) else None
    return dict(own) if isinstance(own, dict) and not isinstance(value, types.ModuleType | type) else None


def _restore(value: Any, before: Any) -> None:
    if before is None:
        return
    if isinstance(value, np.ndarray):
        value[...] = before
    elif isinstance(value, list | bytearray):
        value[:] = before
    elif isinstance(value, dict | set):
        value.clear()
        value.update(before)
    elif isinstance(value, deque):
        value.clear()
        value.extend(before)
    elif isinstance(value, _Slots):
        for name, entry in before.items():
            with suppress(AttributeError):  # one that cannot be set has not changed
                value.places[name].__set__(value.value, entry)
    else:
        vars(value).clear()
        vars(value).update(before)
