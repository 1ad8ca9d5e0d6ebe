"""Loops of flat plants in study files: plants by name, and the law that follows the plans."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, dataclass, fields, replace
from pathlib import Path
from typing import Literal, get_args, get_type_hints

import numpy as np

from ctrlplan._types import Array, Data
from ctrlplan.flatness import FlatSystem
from ctrlplan.studies.benefit import Choices
from ctrlplan.studies.entries import NUMBERS, PAIR, Entries, Entry, Flag, Listed, Number, OneOf, Table, Text
from ctrlplan.studies.loop_kind import LoopKind, Varied
from ctrlplan.studies.reading import StudyError, got
from ctrlplan.studies.running import Builder, System
from ctrlplan.systems.flat_loop import Feedforward, FlatLaw, flat_loop
from ctrlplan.systems.plants.closed_form import ClosedFormFlatSystem
from ctrlplan.systems.plants.plant import StateSpacePlant
from ctrlplan.systems.poles import checked_gains
from ctrlplan.trajectories import PolySpline, Trajectory, Waypoint

LawName = Literal["flat", "quasi_static", "feedforward"]

LAW: Entries = {
    "law": Entry(
        Text(get_args(LawName)),
        "law of the loop of a flat plant: flat (feedback with poles, with a dynamic extension where the plant requires "
        "one), quasi_static (without states of an extension), or feedforward (without feedback)",
    ),
    "poles": Entry(
        Listed(OneOf((Number(), NUMBERS)), "a list of numbers, or of lists of numbers"),
        "real poles of the tracking errors [rad/s]: a list for each flat output, or one list for all",
    ),
    "integral": Entry(Flag(), "integral action on each tracking error, with one pole more for each"),
    "input_limits": Entry(Table({}, PAIR), "minimum and maximum of inputs of the plant, which are saturated"),
}
"""Entries of [loop] of a flat plant."""


@dataclass(frozen=True)
class FlatLoops:
    """Loop of a flat plant for each plan.

    Attributes
    ----------
    flat : FlatSystem
        The plant.
    law : FlatLaw or Feedforward
        The law.
    limits : mapping or None
        Limits of inputs by name.
    """

    flat: FlatSystem
    law: FlatLaw | Feedforward
    limits: Mapping[str, tuple[float, float]] | None

    def __call__(self, name: str, plan: Trajectory) -> System:
        """Loop of a plan; a step is a set point, approached from the initial position."""
        if not plan.jumps(0):
            return flat_loop(self.flat, plan, law=self.law, limits=self.limits)
        if isinstance(self.law, Feedforward):
            raise ValueError(
                f"plan {name} must be continuous for a feedforward without feedback, got a step; remove it"
            )
        start = self._state_at_rest(name, plan, plan.initial)
        self._state_at_rest(name, plan, plan.final)
        return flat_loop(self.flat, _constant(plan, plan.final), law=self.law, limits=self.limits, initial_state=start)

    @property
    def units(self) -> dict[str, str]:
        """Units of signals, for plants of `ctrlplan.plants`."""
        return self.flat.plant.units if isinstance(self.flat, ClosedFormFlatSystem) else {}

    def experiment(self, stated: Data, choices: Choices) -> tuple[Data, Choices]:
        """Fields of the experiment, and options of the benefit of planning."""
        controls = tuple(self.flat.input_labels)
        return {"controls": controls} | stated, replace(choices, quantities=self.flat)

    def check_end(self, plan: Trajectory, name: str, end: float) -> None:
        """Raise for a plan that ends in motion before the end of the run where the plant has no equilibrium."""
        if plan.end < end and any(jump.order == 1 and jump.time == plan.end for jump in plan.jumps(1)):
            self._state_at_rest(name, plan, plan.final, f"end at rest, or at t_end = {end:g} s, got {plan.end:g} s,")

    def check_benefit(self, plan: Trajectory) -> None:
        """Raise if baselines, which begin and end at rest, have no states of the plant."""
        try:
            self._state_at_rest("", plan, plan.initial)
        except ValueError:
            raise ValueError(
                f"benefit must be false for {self.flat.name}, got true: its maps are singular at rest, where baselines "
                "begin and end"
            ) from None

    def _state_at_rest(self, name: str, plan: Trajectory, position: Array, must: str = "be continuous") -> Array:
        """State of the plant at rest at a position; ValueError with what the plan must be if there is none."""
        try:
            return self.flat.states_and_inputs(_constant(plan, position), plan.start)[0]
        except ValueError as error:
            raise ValueError(
                f"plan {name} must {must} for {self.flat.name}, whose maps are singular at rest: {error}"
            ) from error


def _constant(plan: Trajectory, position: Array) -> Trajectory:
    """Plan at rest at a position."""
    still = np.zeros_like(position)
    ends = [Waypoint(time, position, still) for time in (plan.start, plan.start + 1.0)]
    return PolySpline(ends, labels=plan.labels)


def flat_loops(flat: FlatSystem, table: Data, path: Path) -> FlatLoops:
    """Loops of a flat plant by the entries `LAW` of a table [loop].

    Raises
    ------
    StudyError
        If poles are missing, their number is wrong, or they are not stable.
    """
    name: LawName = table.get("law", "flat")
    limits = {label: (low, high) for label, (low, high) in table.get("input_limits", {}).items()} or None
    for label in limits or {}:
        if label not in flat.input_labels:
            raise StudyError(
                f"{path}: loop.input_limits: must be among the inputs {', '.join(flat.input_labels)}, got {label!r}"
            )
    if name == "feedforward":
        for entry in ("poles", "integral"):
            if table.get(entry):
                raise StudyError(
                    f"{path}: loop.{entry}: must not be given for the law feedforward, got {got(table[entry])}"
                )
        return FlatLoops(flat, Feedforward(), limits)
    integral, poles = table.get("integral", False), table.get("poles")
    count = len(flat.orders)
    if poles is None:
        wanted = ", ".join(f"{r + integral} of {label}" for label, r in zip(flat.flat_labels, flat.orders, strict=True))
        raise StudyError(f"{path}: loop.poles: must be given for the law {name} ({wanted}), got none")
    rows = [poles] * count if all(isinstance(pole, float) for pole in poles) else poles
    try:
        if name == "flat":
            checked_gains(rows, [r + integral for r in flat.orders])
    except (ValueError, TypeError) as error:
        raise StudyError(f"{path}: loop.poles: {error}") from None
    return FlatLoops(flat, FlatLaw(rows, quasi_static=name == "quasi_static", integral=integral), limits)


class PlantLoop(LoopKind):
    """Loop of a flat plant of `ctrlplan.plants` by its name.

    Parameters
    ----------
    plant : type
        Class of the plant, whose parameters are entries.
    """

    def __init__(self, plant: type[StateSpacePlant]) -> None:
        self._plant = plant
        self.entries = {**LAW, **{entry.name: _entry(plant, entry) for entry in fields(plant)}}  # type: ignore[misc]

    def check(self, table: Data, path: Path) -> None:
        """Check that plant and law can be built."""
        flat_loops(self.plant(table, path), table, path)

    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop of each plan."""
        return flat_loops(self.plant(table, path), table, path)

    def plant(self, table: Data, path: Path) -> FlatSystem:
        """Flat system of the plant with the parameters of the table."""
        names = [entry.name for entry in fields(self._plant)]
        try:
            return self._plant(**{name: table[name] for name in names if name in table}).flat_system()
        except (ValueError, TypeError) as error:
            raise StudyError(f"{path}: loop: {error}") from None

    def parameters(self, table: Data) -> Data:
        """With the defaults of the plant and of its law."""
        own = {entry.name: entry.default for entry in fields(self._plant)}
        return {"kind": table["kind"], "law": "flat"} | own | dict(table)

    def varied(self, names: object, table: Data, path: Path) -> Varied:
        """Loop of each plan, whose plant reads the parameters; its law has those of the table."""
        return self.build(table, path)


def _entry(plant: type[StateSpacePlant], entry: Field[float]) -> Entry:
    """Entry of a parameter of a plant."""
    what = f"parameter {entry.name} of ctrlplan.plants.{plant.__name__}"
    if "unit" in entry.metadata:
        return Entry(Number(), f"{what} [{entry.metadata['unit']}]")
    return Entry(Text(get_args(get_type_hints(plant)[entry.name])), what)
