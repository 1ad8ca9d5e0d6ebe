"""Control laws of the crane as values: required derivatives of the plan, options, and the block."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import control as ct

from ctrlplan._checks import checked_finite
from ctrlplan._renamed import warn_renamed
from ctrlplan.systems.plants.crane import blocks
from ctrlplan.systems.plants.crane.parameters import CraneParameters
from ctrlplan.systems.poles import hurwitz_coefficients

LawName = Literal["setpoint", "generator", "load_feedback", "dynamic", "feedforward"]


@dataclass(frozen=True)
class Law(ABC):
    """Control law of a crane loop.

    A new law is a frozen dataclass whose fields are its options. It must define

    - `name`, `order`, `continuity`, and `outputs` if they are not the
      references of the PIDs,
    - `build`, which returns the block.

    An instance is given to `crane_loop`. One line in `LAWS` gives it a name, which
    can also be used in study files.

    Attributes
    ----------
    name : str
        Name of the law, in messages and in `LAWS`.
    order : int
        Highest derivative of the plan among the inputs of the block.
    continuity : int
        Highest derivative of the plan that must be continuous; -1 if positions
        may jump.
    outputs : tuple of str
        D_ref and R_ref, the references of the PIDs, or F and C, the inputs of
        the crane.

    Examples
    --------
    A set-point law with a constant error, for a test of integral action:

    >>> from dataclasses import dataclass
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> @dataclass(frozen=True)
    ... class OffsetLaw(cp.Law):
    ...     name = "offset"
    ...     order = 0
    ...     continuity = -1
    ...     offset: float = 0.1
    ...     def build(self, crane):
    ...         gain = [[1.0, 0.0], [0.0, 1.0]]
    ...         return ct.nlsys(
    ...             None,
    ...             lambda t, x, u, params: [u[0] - crane.drum_radius + self.offset, u[1]],
    ...             inputs=["x_ref", "z_ref"], outputs=["D_ref", "R_ref"], name="offset",
    ...         )
    >>> step = cp.Step([1.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    >>> loop = cp.plants.crane_loop(cp.plants.Crane(), step, OffsetLaw(offset=0.2))
    >>> "offset" in [block.name for block in loop.syslist]
    True
    """

    name: ClassVar[str]
    order: ClassVar[int]
    continuity: ClassVar[int]
    outputs: ClassVar[tuple[str, str]] = ("D_ref", "R_ref")

    @abstractmethod
    def build(self, crane: CraneParameters) -> ct.NonlinearIOSystem:
        """Block of the law.

        Parameters
        ----------
        crane : Crane
            The plant model of the law.

        Returns
        -------
        control.NonlinearIOSystem
            Its inputs are among x_ref, x_ref_d1, ... up to `order`, the same of z,
            and the outputs of the crane. Its outputs are those in `outputs`.
        """


@dataclass(frozen=True)
class SetpointLaw(Law):
    """Set-point law for steps; block `create_setpoint_iosystem`."""

    name = "setpoint"
    order = 0
    continuity = -1

    def build(self, crane: CraneParameters) -> ct.NonlinearIOSystem:
        """Block from x_ref and z_ref to D_ref and R_ref."""
        return blocks.create_setpoint_iosystem(crane)


@dataclass(frozen=True)
class GeneratorLaw(Law):
    """Reference generator, figure 3; block `create_generator_iosystem`."""

    name = "generator"
    order = 2
    continuity = 0

    def build(self, crane: CraneParameters) -> ct.NonlinearIOSystem:
        """Block from the jets of order 2 to D_ref and R_ref."""
        return blocks.create_generator_iosystem(crane)


@dataclass(frozen=True)
class LoadFeedbackLaw(Law):
    """Reference generator with load feedback.

    Its block is `create_load_feedback_iosystem`.

    Parameters
    ----------
    load_bandwidth : float, optional
        Natural frequency of the error of the load [rad/s], above 0; the loop
        with the PIDs of the study is stable from 0.1 to 3.
    damping : float, optional
        Its damping ratio, above 0; 0.7 to 1.

    Raises
    ------
    TypeError
        If an option is not a number.
    ValueError
        If an option is not finite and above 0.
    """

    name = "load_feedback"
    order = 2
    continuity = 0

    load_bandwidth: float = 1.0
    damping: float = 1.0

    def __post_init__(self) -> None:
        checked_finite(self.load_bandwidth, "load_bandwidth", above=0.0)
        checked_finite(self.damping, "damping", above=0.0)

    def build(self, crane: CraneParameters) -> ct.NonlinearIOSystem:
        """Block from jets of order 2 and x to D_ref and R_ref."""
        return blocks.create_load_feedback_iosystem(crane, self.load_bandwidth, self.damping)


@dataclass(frozen=True)
class DynamicLaw(Law):
    """Dynamic feedback linearisation, (9)-(11).

    Its block is `create_dynamic_law_iosystem`.

    Parameters
    ----------
    poles : sequence of complex, optional
        Four poles [rad/s] of the error of x; the error of z has the same.

    Raises
    ------
    ValueError
        If the poles are not four, not conjugate pairs, or not stable.
    """

    name = "dynamic"
    order = 4
    continuity = 3
    outputs = ("F", "C")

    poles: Sequence[complex] = (-1.0, -1.2, -1.4, -1.6)

    def __post_init__(self) -> None:
        hurwitz_coefficients(self.poles, 4)
        object.__setattr__(self, "poles", tuple(self.poles))

    def build(self, crane: CraneParameters) -> ct.NonlinearIOSystem:
        """Block from jets of order 4 and outputs of the crane to F and C."""
        return blocks.create_dynamic_law_iosystem(crane, self.poles)


@dataclass(frozen=True)
class FeedforwardLaw(Law):
    """Flat feedforward; block `create_crane_feedforward_iosystem`."""

    name = "feedforward"
    order = 4
    continuity = 3
    outputs = ("F", "C")

    def build(self, crane: CraneParameters) -> ct.NonlinearIOSystem:
        """Block from the jets of order 4 to F and C."""
        return blocks.create_crane_feedforward_iosystem(crane)


LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        SetpointLaw(),
        GeneratorLaw(),
        LoadFeedbackLaw(),
        DynamicLaw(),
        FeedforwardLaw(),
    )
}
"""Laws with their default options, by name."""

OLD_NAMES = {"still": "setpoint"}
"""Deprecated names of laws."""


def as_law(law: Law | str) -> Law:
    """Law from itself or from its name.

    Raises
    ------
    TypeError
        If it is neither a law nor a name.
    ValueError
        If the name is not in `LAWS`.

    Warns
    -----
    FutureWarning
        If the name is an old one.
    """
    if isinstance(law, Law):
        return law
    if not isinstance(law, str):
        raise TypeError(f"law must be a Law or one of {', '.join(LAWS)}, got {law!r}")
    if law in OLD_NAMES:
        warn_renamed(f'law "{law}"', f'"{OLD_NAMES[law]}"')
    name = OLD_NAMES.get(law, law)
    if name not in LAWS:
        raise ValueError(f"law must be one of {', '.join(LAWS)}, got {law!r}")
    return LAWS[name]
