"""Parameters of the crane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ctrlplan.systems.plants.parameters import check_parameters, parameter

Numbers = tuple[float, float, float, float, float, float, float]
"""m, M_c, J, b, f1, f2, g."""


@dataclass(frozen=True, kw_only=True)
class CraneParameters:
    """Parameters of a crane; see `Crane`."""

    load_mass: float = parameter(500.0, "kg")
    trolley_mass: float = parameter(5000.0, "kg")
    drum_inertia: float = parameter(50.0, "kg m^2")
    drum_radius: float = parameter(0.25, "m")
    trolley_friction: float = parameter(20.0, "N s/m", zero=True)
    drum_friction: float = parameter(20.0, "N m s", zero=True)
    gravity: float = parameter(9.81, "m/s^2")
    rope_wrap: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.rope_wrap, bool):
            raise TypeError(f"rope_wrap must be True or False, got {self.rope_wrap!r}")
        check_parameters(self)

    def numbers(self, params: Mapping[str, float] | None = None) -> Numbers:
        """m, M_c, J, b, f1, f2, g, each overridden by a simulation parameter of its name."""
        given = ({} if params is None else params).get  # called twice per evaluation of a loop
        return (
            given("load_mass", self.load_mass),
            given("trolley_mass", self.trolley_mass),
            given("drum_inertia", self.drum_inertia),
            given("drum_radius", self.drum_radius),
            given("trolley_friction", self.trolley_friction),
            given("drum_friction", self.drum_friction),
            given("gravity", self.gravity),
        )
