"""Modules and classes whose functions depend only on their arguments."""

from __future__ import annotations

_IMPURE = frozenset(
    str.split(
        "time datetime random secrets uuid os sys io socket threading subprocess multiprocessing asyncio pathlib "
        "tempfile inspect gc weakref ctypes signal select shelve sqlite3 logging urllib http platform shutil glob"
    )
)
"""Modules of the standard library whose functions do not depend only on their arguments."""

_PURE = frozenset(
    str.split(
        "numpy scipy control casadi ctrlplan builtins math cmath operator functools itertools collections copy numbers "
        "fractions decimal statistics typing types dataclasses enum abc contextlib warnings array bisect heapq string "
        "re _abc _collections _collections_abc _functools _operator _bisect _heapq _decimal _statistics _weakrefset"
    )
)
"""Modules whose functions depend only on their arguments and closures."""

_RANDOM = "numpy.random"
"""Module among them whose functions do not."""

HIDDEN = frozenset(str.split("open input eval exec globals locals __import__ compile id breakpoint"))
"""Built-in functions whose results are not functions of their arguments."""


def is_pure(module: object) -> bool:
    """Whether functions of a module depend only on their arguments and closures."""
    return isinstance(module, str) and module.partition(".")[0] in _PURE and not module.startswith(_RANDOM)


def inherits_from_library(kind: type) -> bool:
    """Whether functions of a library may use attributes of an object by any name."""
    return any(
        is_pure(base.__module__) and base.__module__ not in ("builtins", "abc", "typing") for base in kind.__mro__
    )


def is_impure(kind: type) -> bool:
    """Whether a class belongs to a module of `is_impure_module`."""
    return is_impure_module(str(kind.__module__))


def is_impure_module(module: str) -> bool:
    """Whether functions of a module do not depend only on their arguments."""
    return module.partition(".")[0] in _IMPURE or module.startswith(_RANDOM)


def written_in_python(kind: type) -> bool:
    """Whether the state of objects of a class is in attributes only."""
    own = vars(kind)
    return "__dict__" in own or "__slots__" in own or "__weakref__" in own or kind is object or _plain_child(kind)


def _plain_child(kind: type) -> bool:
    """Whether a Python class adds no attributes to those of its bases."""
    return "__module__" in vars(kind) and bool(kind.__flags__ & (1 << 9)) and kind.__base__ is not object
