"""Deprecated names, which work for one release with a warning at the caller's line."""

from __future__ import annotations

import functools
import inspect
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def warn_renamed(old: str, new: str) -> None:
    """Warn of a deprecated name, at the first line outside the package.

    Parameters
    ----------
    old, new : str
        Deprecated and new name, as in the caller's code: ``"quantities="``,
        ``"system="``.

    Warns
    -----
    FutureWarning
        Always, as in python-control: unlike a DeprecationWarning it is shown
        to all users.
    """
    warnings.warn(
        f"{old} is deprecated and will be removed in the next release; use {new}",
        FutureWarning,
        stacklevel=outside_stacklevel(),
    )


def renamed_argument(old: str, old_value: Any, new: str, new_value: Any) -> Any:
    """Value of a keyword argument with a deprecated name.

    Parameters
    ----------
    old, new : str
        Names, without the equals sign.
    old_value, new_value : object
        Value given under each; None if not given.

    Raises
    ------
    TypeError
        If both were given.

    Warns
    -----
    FutureWarning
        If the old name was used.
    """
    if old_value is None:
        return new_value
    if new_value is not None:
        raise TypeError(f"{old}= is the deprecated name of {new}=; only one of them may be given, got both")
    warn_renamed(f"{old}=", f"{new}=")
    return old_value


def renamed_members(module: str, renamed: Mapping[str, str]) -> Callable[[str], Any]:
    """`__getattr__` of a module whose members have deprecated names.

    Parameters
    ----------
    module : str
        Name of the module.
    renamed : mapping of str to str
        New name of each deprecated one.
    """

    def member(name: str) -> Any:
        if name not in renamed:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warn_renamed(f"{module}.{name}", f"{module}.{renamed[name]}")
        return getattr(sys.modules[module], renamed[name])

    return member


class FormerAttribute:
    """Attribute of a class under its former name, which warns.

    Parameters
    ----------
    new : str
        Its present name.

    Warns
    -----
    FutureWarning
        Where it is read.

    Examples
    --------
    >>> class Result:
    ...     duration = 2.0
    ...     takes = FormerAttribute("duration")
    >>> import warnings
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     Result().takes
    2.0
    >>> print(caught[0].message)
    Result.takes is deprecated and will be removed in the next release; use Result.duration
    """

    def __init__(self, new: str) -> None:
        self._new = new
        self.__doc__ = f"Former name of `{new}`."

    def __set_name__(self, owner: type, name: str) -> None:
        self._old = name

    def __get__(self, instance: object, owner: type) -> Any:
        if instance is None:
            return self
        warn_renamed(f"{owner.__name__}.{self._old}", f"{owner.__name__}.{self._new}")
        return getattr(instance, self._new)


def former_signature(
    *positional: str,
    renamed: Mapping[str, str] | None = None,
    implied: Mapping[str, Mapping[str, object]] | None = None,
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorator that accepts a former signature with a warning.

    Parameters
    ----------
    *positional : str
        Names of the arguments that could formerly be given by position, after
        those that still can; deprecated names if renamed.
    renamed : mapping of str to str, optional
        New keyword of each deprecated one.
    implied : mapping of str to mapping, optional
        Additional keywords that a deprecated one implies.

    Returns
    -------
    callable
        Decorator of a function, which preserves its signature.

    Raises
    ------
    TypeError
        By the function, if an argument is given twice or under both names.

    Warns
    -----
    FutureWarning
        By the function, if a deprecated form is used.

    Examples
    --------
    >>> @former_signature("name", renamed={"output": "outputs"})
    ... def block(gain, *, outputs="u", name="block"):
    ...     return gain, outputs, name
    >>> import warnings
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     block(2.0, "mine", output="F")
    (2.0, 'F', 'mine')
    >>> [str(warning.message).partition(" is deprecated")[0] for warning in caught]
    ['name by position in block', 'output=']
    """
    new_names, also = renamed or {}, implied or {}

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        call: Callable[..., T] = function
        parameters = inspect.signature(function).parameters.values()
        count = sum(parameter.kind is parameter.POSITIONAL_OR_KEYWORD for parameter in parameters)

        @functools.wraps(function)
        def called(*args: Any, **kwargs: Any) -> T:
            extra = dict(zip(positional, args[count:], strict=False))
            if len(args) - count > len(positional) or extra.keys() & kwargs.keys():
                return call(*args, **kwargs)  # too many arguments, or one of them twice: Python raises
            given = extra | kwargs
            for old, new in new_names.items():
                if given.get(old) is not None and given.get(new) is not None:
                    raise TypeError(f"{old}= is the deprecated name of {new}=; only one of them may be given, got both")
            if extra:
                keywords = [f"{new_names.get(name, name)}=" for name in extra]
                keywords += [f"{k}={v!r}" for name in extra for k, v in also.get(name, {}).items()]
                warn_renamed(f"{', '.join(extra)} by position in {function.__name__}", ", ".join(keywords))
            for old, new in new_names.items():
                value = given.pop(old, None)
                if value is None:
                    continue
                with_it = dict(also.get(old, {}))
                if old not in extra:
                    warn_renamed(f"{old}=", ", ".join([f"{new}=", *(f"{k}={v!r}" for k, v in with_it.items())]))
                given = with_it | given | {new: value}
            return call(*args[:count], **given)

        return called

    return decorate


def outside_stacklevel() -> int:
    """`stacklevel` of a warning by the caller, for the first line outside the package."""
    package, level = __name__.partition(".")[0], 1
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, level = frame.f_back, level + 1
    return level
