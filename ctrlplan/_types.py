"""Types shared by several subpackages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NoReturn, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import control as ct

Array = NDArray[np.float64]

System: TypeAlias = "ct.InputOutputSystem"
"""Any system of python-control, which is not typed."""

Value: TypeAlias = Any
"""Number, array or symbol, or a sequence of them: arguments of functions that can be evaluated symbolically."""

Data: TypeAlias = dict[str, Any]
"""A table of plain data, as from JSON or TOML, before its entries are checked."""

Params: TypeAlias = Mapping[str, Value]
"""Parameters of blocks by name, of any type."""

BlockMap: TypeAlias = Callable[[Value, Value, Value], Value]
"""(t, state, input) of a block -> outputs or rates."""


class Frozen:
    """Base class of immutable objects."""

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"{type(self).__name__} is immutable; create a new object instead of setting {name}")

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
    """Name of an event with its own description.

    For a plain name the description is that the signal left its limits.

    Parameters
    ----------
    name : str
        Name of the event.
    words : str, optional
        Description, such as "was at its limit" for an actuator; empty if the
        name is itself a condition, such as "goal out of reach".
    """

    words: str

    def __new__(cls, name: str, words: str = "") -> EventName:
        """Name with its description."""
        self = super().__new__(cls, name)
        self.words = words
        return self
