"""Parameters of the crane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ctrlplan._checks import checked_finite
from ctrlplan.systems.plants.parameters import overridden

POSITIVE = ("load_mass", "trolley_mass", "drum_inertia", "drum_radius", "gravity")
FRICTIONS = ("trolley_friction", "drum_friction")
NUMBERS = ("load_mass", "trolley_mass", "drum_inertia", "drum_radius", *FRICTIONS, "gravity")

Numbers = tuple[float, float, float, float, float, float, float]
"""m, M_c, J, b, f1, f2, g."""


@dataclass(frozen=True, kw_only=True)
class CraneParameters:
    """Parameters of a crane; see `Crane` for their units."""

    load_mass: float = 500.0
    trolley_mass: float = 5000.0
    drum_inertia: float = 50.0
    drum_radius: float = 0.25
    trolley_friction: float = 20.0
    drum_friction: float = 20.0
    gravity: float = 9.81
    rope_wrap: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.rope_wrap, bool):
            raise TypeError(f"rope_wrap must be True or False, got {self.rope_wrap!r}")
        for name in POSITIVE:
            checked_finite(getattr(self, name), name, above=0.0)
        for name in FRICTIONS:
            checked_finite(getattr(self, name), name, minimum=0.0)

    def numbers(self, params: Mapping[str, float] | None = None) -> Numbers:
        """m, M_c, J, b, f1, f2, g, each overridden by a simulation parameter of its name."""
        m, trolley, inertia, b, f1, f2, g = overridden({name: getattr(self, name) for name in NUMBERS}, params)
        return m, trolley, inertia, b, f1, f2, g
