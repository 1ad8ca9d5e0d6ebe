"""The adapter between planning and plants: signals of a system as functions of the jet of a plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from ctrlplan._renamed import renamed_argument
from ctrlplan.trajectories.common import Array

Quantities = Callable[[Array], Mapping[str, Array]]
"""Maps a jet (order + 1, naxes, ntime) to signals (ntime,) by name."""


class HasQuantities(Protocol):
    """A plant whose signals are functions of the jet of a plan: a flat system, a crane."""

    @property
    def quantities(self) -> Quantities:
        """Method or function from a jet to signals by name."""


System = Quantities | HasQuantities
"""What `fastest` and `margins` take; control.flatsys.FlatSystem as well."""


def quantities_of(system: Any) -> Quantities | None:
    """Signals of a system by name, as a function of the jet; None of None.

    Parameters
    ----------
    system : flat system, plant with a method `quantities`, or callable, optional
        Of a `control.flatsys.FlatSystem` without that method the states and
        inputs are evaluated by its reverse map, one time after the other.

    Raises
    ------
    TypeError
        If it is none of these.
    ValueError
        If the maps of a flat system do not belong together, or it is in
        discrete time.
    """
    if system is None:
        return None
    if not isinstance(system, type):
        own = getattr(system, "quantities", None)
        if callable(own):
            return own
        if hasattr(system, "forward") and hasattr(system, "reverse"):
            from ctrlplan.flatness.quantities import quantities_of_flat_system

            return quantities_of_flat_system(system)
        if callable(system) and not hasattr(system, "ninputs"):  # python-control's systems are callable
            return system
    raise TypeError(
        "system must be a flat system, a plant with a method quantities (as Crane has), or a function of a jet, got "
        f"{system.__name__ if isinstance(system, type) else type(system).__name__}"
    )


def system_given(system: System | None, quantities: System | None) -> System | None:
    """The argument ``system``, which may come under its old name ``quantities``."""
    return renamed_argument("quantities", quantities, "system", system)
