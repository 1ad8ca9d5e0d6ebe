"""Kinds of loops in study files: one class per kind, and one entry of `LOOP_KINDS`."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import UnionType
from typing import ClassVar, Union, get_args, get_origin

import control as ct
import numpy as np

from ctrlplan._types import Data
from ctrlplan.studies.baselines import smoother_polynomials
from ctrlplan.studies.benefit import Choices
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.crane_setup import CRANE_MEASURES, LOAD, SLACK, marked_slack
from ctrlplan.studies.reading import Reader, StudyError, got, is_number, named_in_module, one_line, reference
from ctrlplan.studies.running import Builder, System
from ctrlplan.studies.sections import AnimatedCrane, CraneMotion, CranePaths, CraneTime, PlanCurves
from ctrlplan.studies.study import Study
from ctrlplan.systems.plants import LAWS, Crane, crane_loop, unity_feedback_loop
from ctrlplan.systems.plants.crane.laws import as_law
from ctrlplan.trajectories import Trajectory, Waypoint


class LoopKind(ABC):
    """Kind of loop: entries of its table [loop], construction, and sections of its study.

    Attributes
    ----------
    entries : tuple of str
        Entries of [loop] in addition to ``kind``.
    axes : tuple of str
        Labels of waypoints that come first, in any order of the file.
    signals : tuple of str or None
        Signals that may have a unit, in addition to the axes; None for any name.
    """

    entries: ClassVar[tuple[str, ...]] = ()
    axes: ClassVar[tuple[str, ...]] = ()
    signals: ClassVar[tuple[str, ...] | None] = None

    @abstractmethod
    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop, or a function that builds a loop for each plan; StudyError if that is not possible."""

    def check(self, table: Data, reader: Reader) -> None:
        """Check the table and add its defaults; StudyError if it is wrong."""
        reader.known(table, ("kind", *self.entries), "loop")

    def experiment(self, table: Data, waypoints: Sequence[Waypoint], stated: Data, path: Path) -> tuple[Data, Choices]:
        """Fields of the experiment, and options of the benefit of planning."""
        return stated, Choices()

    def parameters(self, table: Data) -> Data:
        """Parameters of the loop, for the report."""
        return dict(table)

    def study(self, name: str, title: str, comparison: Comparison) -> Study:
        """Study of the comparison, with the sections of this kind of loop."""
        return Study(name, title, comparison, notes=comparison.notes)


class LinearLoop(LoopKind):
    """Transfer function num/den with a gain, in unity feedback."""

    entries = ("num", "den", "gain")
    signals = ("y", "u", "e")

    def check(self, table: Data, reader: Reader) -> None:
        """Check num, den and gain, and that the loop can be built."""
        super().check(table, reader)
        for key in ("num", "den"):
            table[key] = reader.numbers(table, key, f"loop.{key}")
        table["gain"] = reader.number(table, "gain", "loop.gain", default=1.0)
        self.build(table, reader.path)

    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop with the outputs y and u."""
        try:
            return unity_feedback_loop(table["num"], table["den"], table.get("gain", 1.0), outputs=("y", "u"))
        except (ValueError, TypeError) as error:
            raise StudyError(f"{path}: loop: {error}") from None


class CraneLoop(LoopKind):
    """The crane with one of its control laws."""

    entries = ("law", "force_limits", "torque_limits", *(entry.name for entry in fields(Crane)))
    axes = ("x", "z")

    def check(self, table: Data, reader: Reader) -> None:
        """Check that crane and law can be built."""
        super().check(table, reader)
        self.build(table, reader.path)

    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop of each plan: steps, shaped or not, with the set-point law, all other plans with the given law."""
        crane = self._crane(table, path)
        try:
            law = as_law(table.get("law", "generator"))
        except (ValueError, TypeError):
            raise StudyError(f"{path}: loop.law: must be one of {', '.join(LAWS)}, got {got(table['law'])}") from None
        limits = {key: table[key] for key in ("force_limits", "torque_limits") if key in table}
        for key, pair in limits.items():
            if not (isinstance(pair, list) and len(pair) == 2 and all(map(is_number, pair)) and pair[0] < pair[1]):
                raise StudyError(f"{path}: loop.{key}: must be two increasing numbers, got {got(pair)}")

        def build(name: str, plan: Trajectory) -> System:
            return crane_loop(crane, plan, LAWS["setpoint"] if plan.jumps(0) else law, **limits)

        return build

    def experiment(self, table: Data, waypoints: Sequence[Waypoint], stated: Data, path: Path) -> tuple[Data, Choices]:
        """With metrics of the sway, and with shaped references and smoother polynomials as baselines."""
        labels = waypoints[0].labels or ()
        if set(labels) != set(self.axes):
            raise StudyError(f"{path}: waypoints: axes of a crane must be x and z (down), got {', '.join(labels)}")
        crane = self._crane(table, path)
        depth = float(np.mean([point.position[labels.index("z")] for point in waypoints]))
        measures = CRANE_MEASURES | {"load": LOAD}
        own = [replace(measure, name=name) for name, measure in measures.items()]
        chosen = stated.get("measures")
        fields_of: Data = {"controls": ("F", "C")} | stated
        fields_of["events"] = (SLACK, *stated.get("events", ()))
        fields_of["measures"] = measures if chosen is None else [*own, *chosen]
        return fields_of, Choices(
            quantities=crane,
            mode=(math.sqrt(crane.gravity / depth), 0.0) if depth > 0.0 else None,
            decisive=("settling_time", "sway_after", "force_peak"),
            baselines=smoother_polynomials,
        )

    def parameters(self, table: Data) -> Data:
        """With the defaults of the crane and of its law."""
        own = {key: value for key, value in table.items() if key in _OF_CRANE}
        stated = {"kind": "crane", "law": "generator", "force_limits": "none", "torque_limits": "none"} | table
        return stated | {entry.name: own.get(entry.name, entry.default) for entry in fields(Crane)}

    def study(self, name: str, title: str, comparison: Comparison) -> Study:
        """With the paths, the motion of the crane and its animation."""
        sections = (CranePaths(), PlanCurves(), CraneTime(), CraneMotion(), AnimatedCrane())
        return Study(name, title, marked_slack(comparison), notes=comparison.notes, sections=sections)

    def _crane(self, table: Data, path: Path) -> Crane:
        try:
            return Crane(**{key: value for key, value in table.items() if key in _OF_CRANE})
        except (ValueError, TypeError) as error:
            raise StudyError(f"{path}: loop: {error}") from None


_OF_CRANE = tuple(entry.name for entry in fields(Crane))


class LoopOfModule(LoopKind):
    """Loop returned by a function of a module, which must be annotated to return one."""

    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop returned by the function."""
        kind = table["kind"]
        try:
            function = named_in_module(kind, path.resolve().parent)
            _check_declared(function)
            loop: object = function()  # type: ignore[operator]
        except (Exception, SystemExit) as error:  # of a user's own module
            must = f"must name a function of a module, such as {_SIGNATURE}"
            raise StudyError(
                f"{path}: loop.kind: {must}, got {kind!r}: {type(error).__name__}: {one_line(str(error), 300)}"
            ) from None
        if not isinstance(loop, ct.InputOutputSystem):
            raise StudyError(f"{path}: loop.kind: {kind!r} must return a control system, got {type(loop).__name__}")
        return loop


LOOP_KINDS: dict[str, LoopKind] = {"linear": LinearLoop(), "crane": CraneLoop()}
"""Kinds of loops by the entry ``kind``.

A further kind is "python:module:function": a function without arguments, in a
module next to the study file or in an installed package, whose return
annotation is a control system: ``def build() -> control.InputOutputSystem``.
Running such a study file executes the module. The same is true of a family of
plans "python:module:Class", a class derived from `WaypointSpline`.
"""


def loop_kind(kind: object) -> LoopKind | None:
    """Kind of loop of an entry ``kind``; None if it is unknown."""
    if reference(kind) is not None:
        return LoopOfModule()
    return LOOP_KINDS.get(kind) if isinstance(kind, str) else None


def build_loop(table: Data, path: Path) -> System | Builder:
    """Loop of the checked table [loop] of a study file.

    Raises
    ------
    StudyError
        If it cannot be built.
    """
    return stated_kind(table, Reader(path)).build(table, path)


def stated_kind(table: Data, reader: Reader) -> LoopKind:
    """Kind of the table [loop]; StudyError if it is unknown."""
    kind = loop_kind(table.get("kind"))
    if kind is None:
        names = ", ".join([*LOOP_KINDS, '"python:module:function"'])
        raise reader.error("loop.kind", f"must be one of {names}, got {got(table.get('kind'))}")
    return kind


_SIGNATURE = "def build() -> control.InputOutputSystem:"


def _check_declared(function: object) -> None:
    """Raise if an object is not a function without arguments that is annotated to return a control system."""
    if not callable(function) or inspect.isclass(function) or not inspect.isfunction(inspect.unwrap(function)):
        raise TypeError(f"object must be a Python function, got {type(function).__name__}")
    try:
        signature = inspect.signature(function, eval_str=True)
    except NameError as error:
        raise TypeError(f"annotations must be defined in the module, got {error}") from None
    spare = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    required = [p.name for p in signature.parameters.values() if p.default is p.empty and p.kind not in spare]
    if required:
        raise TypeError(f"function must have no required arguments, got {', '.join(required)}")
    declared = signature.return_annotation
    kinds = get_args(declared) if isinstance(declared, UnionType) or get_origin(declared) is Union else (declared,)
    if not all(inspect.isclass(kind) and issubclass(kind, ct.InputOutputSystem) for kind in kinds):
        got = "none" if declared is signature.empty else declared
        raise TypeError(f"return annotation must be a class of control systems, got {got}")
