"""Small types of several floors, on the ground floor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NoReturn, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import control as ct

Array = NDArray[np.float64]

System: TypeAlias = "ct.InputOutputSystem"
"""Any system of python-control, which has no types of its own."""

Value: TypeAlias = Any
"""Number, array or symbol, or a sequence of them: what functions that are evaluated with symbols as well take."""

Data: TypeAlias = dict[str, Any]
"""A table of plain data, as of JSON or TOML: of what kind an entry is, is known once it is checked."""

Params: TypeAlias = Mapping[str, Value]
"""Parameters of blocks by name, of any kind that a block can use."""

BlockMap: TypeAlias = Callable[[Value, Value, Value], Value]
"""(t, state, input) of a block -> its outputs or rates."""


class Frozen:
    """Base of the public objects: attributes are set by the constructor only."""

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"{type(self).__name__} is immutable; make a new one instead of setting {name}")

    def __delattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"{type(self).__name__} is immutable; {name} cannot be deleted")

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        return self

    def __setstate__(self, state: dict[str, object]) -> None:
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
        self.__dict__.update(state)


class EventName(str):
    """Name of an event that says in words of its own what happened.

    A block declares what it watches by such a name; of a plain name it is said
    that the signal left its limits.

    Parameters
    ----------
    name : str
        The name.
    words : str, optional
        What is said of it, as "was at its limit" of an actuator; empty where
        the name is itself a condition, as "goal out of reach".
    """

    words: str

    def __new__(cls, name: str, words: str = "") -> EventName:
        """Name with its words."""
        self = super().__new__(cls, name)
        self.words = words
        return self
