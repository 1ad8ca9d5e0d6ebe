"""Kinds of loops in study files: one class per kind, and one entry of `LOOP_KINDS`."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from types import UnionType
from typing import ClassVar, Union, get_args, get_origin

import control as ct
import control.flatsys as fs
import numpy as np

from ctrlplan._types import Data
from ctrlplan.flatness import FlatSystem
from ctrlplan.planning import Obstacle, Rectangle
from ctrlplan.studies.baselines import smoother_polynomials
from ctrlplan.studies.benefit import Choices
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.crane_setup import CRANE_MEASURES, LOAD, SLACK, marked_slack
from ctrlplan.studies.entries import NUMBERS, PAIR, Entries, Entry, Flag, Number, Table, Text, Variants
from ctrlplan.studies.flat_loops import LAW, PlantLoop, flat_loops
from ctrlplan.studies.loop_kind import LoopKind, Varied, of_parameters
from ctrlplan.studies.reading import Reader, StudyError, got, named_in_module, one_line, reference
from ctrlplan.studies.running import Builder, System
from ctrlplan.studies.sections import AnimatedCrane, CraneMotion, CranePaths, CraneTime, Paths, PlanCurves, Wall
from ctrlplan.studies.study import Study
from ctrlplan.systems.plants import (
    LAWS,
    Crane,
    DCMotor,
    FlexibleJoint,
    KinematicCar,
    MagneticLevitation,
    PlanarQuadrotor,
    TwoMassDrive,
    crane_loop,
    unity_feedback_loop,
)
from ctrlplan.systems.plants.crane.laws import OLD_NAMES, as_law
from ctrlplan.trajectories import Trajectory, Waypoint


class LinearLoop(LoopKind):
    """Transfer function num/den with a gain, in unity feedback."""

    entries: ClassVar[Entries] = {
        "num": Entry(NUMBERS, "numerator of the plant, highest power first", required=True),
        "den": Entry(NUMBERS, "denominator of the plant, highest power first", required=True),
        "gain": Entry(Number(), "gain of the controller", default=1.0),
    }
    signals = ("y", "u", "e")

    def check(self, table: Data, path: Path) -> None:
        """Check that the loop can be built."""
        self.build(table, path)

    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop with the outputs y and u."""
        try:
            return unity_feedback_loop(table["num"], table["den"], table.get("gain", 1.0), outputs=("y", "u"))
        except (ValueError, TypeError) as error:
            raise StudyError(f"{path}: loop: {error}") from None

    def limited(self, table: Data, path: Path) -> Callable[[], System]:
        """The loop."""
        return partial(self.build, table, path)


class CraneLoop(LoopKind):
    """The crane with one of its control laws."""

    entries: ClassVar[Entries] = {
        "law": Entry(Text((*LAWS, *OLD_NAMES)), "control law"),
        "force_limits": Entry(PAIR, "limits of the force of the trolley [N]"),
        "torque_limits": Entry(PAIR, "limits of the torque of the drum [N m]"),
        **{
            entry.name: Entry(
                Flag() if isinstance(entry.default, bool) else Number(),
                f"parameter {entry.name} of ctrlplan.plants.Crane",
            )
            for entry in fields(Crane)
        },
    }
    axes = ("x", "z")

    def check(self, table: Data, path: Path) -> None:
        """Check that crane and law can be built."""
        self.build(table, path)

    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop of each plan: steps, shaped or not, with the set-point law, all other plans with the given law."""
        crane, law = self.plant(table, path), as_law(table.get("law", "generator"))
        limits = {key: table[key] for key in ("force_limits", "torque_limits") if key in table}
        for key, pair in limits.items():
            if not pair[0] < pair[1]:
                raise StudyError(f"{path}: loop.{key}: must be two increasing numbers, got {got(pair)}")

        def build(name: str, plan: Trajectory) -> System:
            return crane_loop(crane, plan, LAWS["setpoint"] if plan.jumps(0) else law, **limits)

        return build

    def experiment(self, table: Data, waypoints: Sequence[Waypoint], stated: Data, path: Path) -> tuple[Data, Choices]:
        """With metrics of the sway, and with shaped references and smoother polynomials as baselines."""
        labels = waypoints[0].labels or ()
        if set(labels) != set(self.axes):
            raise StudyError(f"{path}: waypoints: axes of a crane must be x and z (down), got {', '.join(labels)}")
        crane = self.plant(table, path)
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

    def varied(self, names: Sequence[str], table: Data, path: Path) -> Varied:
        """Loop of each plan, whose crane reads the parameters; its law has those of the table."""
        return self.build(table, path)

    def study(self, name: str, title: str, comparison: Comparison, obstacles: Sequence[Obstacle] = ()) -> Study:
        """With the paths, the motion of the crane and its animation."""
        wall = next(filter(None, map(_wall, obstacles)), None)
        further = [Paths(obstacles=tuple(obstacles))] if len(obstacles) > (wall is not None) else []
        scenes = (CranePaths(wall=wall), PlanCurves(), CraneTime(), CraneMotion(wall=wall), AnimatedCrane(wall=wall))
        sections = (*scenes[:1], *further, *scenes[1:])
        return Study(name, title, marked_slack(comparison), notes=comparison.notes, sections=sections)

    def plant(self, table: Data, path: Path) -> Crane:
        """Crane with the parameters of the table."""
        try:
            return Crane(**{key: value for key, value in table.items() if key in _OF_CRANE})
        except (ValueError, TypeError) as error:
            raise StudyError(f"{path}: loop: {error}") from None


def _wall(obstacle: Obstacle) -> Wall:
    """Sides of a rectangle, which the scenes of a crane show; None if one is infinite or it is of another shape."""
    if not isinstance(obstacle, Rectangle) or not all(map(math.isfinite, (*obstacle.x, *obstacle.z))):
        return None
    return obstacle.x, obstacle.z


_OF_CRANE = tuple(entry.name for entry in fields(Crane))


class LoopOfModule(LoopKind):
    """Loop or flat system returned by a function of a module, which must be annotated to return one."""

    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop of the function, with parameters of a sweep as its arguments."""
        values = {name: value for name, value in table.items() if name != "kind" and name not in LAW}
        return self._loop(table, self._function(table, path), path, **values)

    def limited(self, table: Data, path: Path) -> Callable[[], System]:
        """The loop or flat system that the function returns; the module is imported by the call only."""
        return lambda: self._returned(table, self._function(table, path), path)

    def check_parameter(self, parameter: str, place: str, reader: Reader) -> None:
        """Nothing is known before the function is."""

    def varied(self, names: Sequence[str], table: Data, path: Path) -> Varied:
        """The function, if the parameters are among its arguments; otherwise its loop, whose blocks read them."""
        function = self._function(table, path)
        known = inspect.signature(function).parameters
        if not all(name in known for name in names):
            return self._loop(table, function, path)
        return of_parameters(names, lambda **values: self._loop(table, function, path, **values))

    def _function(self, table: Data, path: Path) -> Callable[..., object]:
        try:
            function = named_in_module(table["kind"], path.resolve().parent)
            return _checked_function(function)
        except (Exception, SystemExit) as error:  # of a user's own module
            raise self._wrong(table, path, error) from None

    def _loop(self, table: Data, function: Callable[..., object], path: Path, **values: float) -> System | Builder:
        """The loop that the function returns, or the loops of a flat system that it returns."""
        found = self._returned(table, function, path, **values)
        if isinstance(found, FlatSystem):
            return flat_loops(found, table, path)
        if isinstance(found, fs.FlatSystem):
            raise StudyError(
                f"{path}: loop.kind: {table['kind']!r} must return a loop or a ctrlplan.FlatSystem, got a "
                f"control.flatsys.{type(found).__name__}; derive the flat system with ctrlplan.flat_system"
            )
        for entry in LAW:
            if entry in table:
                raise StudyError(
                    f"{path}: loop.{entry}: must be given for a function that returns a ctrlplan.FlatSystem only, got "
                    f"{got(table[entry])} for one that returns {type(found).__name__}"
                )
        return found

    def _returned(self, table: Data, function: Callable[..., object], path: Path, **values: float) -> System:
        try:
            loop = function(**values)
        except (Exception, SystemExit) as error:  # of a user's own module
            raise self._wrong(table, path, error) from None
        if not isinstance(loop, ct.InputOutputSystem):
            raise StudyError(
                f"{path}: loop.kind: {table['kind']!r} must return a control system, got {type(loop).__name__}"
            )
        return loop

    def _wrong(self, table: Data, path: Path, error: BaseException) -> StudyError:
        must = f"must name a function of a module, such as {_SIGNATURE}"
        reason = f"{type(error).__name__}: {one_line(str(error), 300)}"
        return StudyError(f"{path}: loop.kind: {must}, got {table['kind']!r}: {reason}")


LOOP_KINDS: dict[str, LoopKind] = {
    "linear": LinearLoop(),
    "crane": CraneLoop(),
    "dc-motor": PlantLoop(DCMotor),
    "flexible-joint": PlantLoop(FlexibleJoint),
    "kinematic-car": PlantLoop(KinematicCar),
    "magnetic-levitation": PlantLoop(MagneticLevitation),
    "planar-quadrotor": PlantLoop(PlanarQuadrotor),
    "two-mass-drive": PlantLoop(TwoMassDrive),
}
"""Kinds of loops by the entry ``kind``.

A further kind is "python:module:function": a function without arguments, in a
module next to the study file or in an installed package, whose return
annotation is a control system: ``def build() -> control.InputOutputSystem``. If
it returns a `ctrlplan.FlatSystem`, the loop is that of `ctrlplan.flat_loop`.
Running such a study file executes the module. The same is true of a family of
plans "python:module:Class", a class derived from `WaypointSpline`.
"""


LOOP = Variants(
    "kind",
    lambda: {name: Table(kind.entries) for name, kind in LOOP_KINDS.items()},
    'kind of loop, or "python:module:function", a function annotated to return a control system',
    "function",
    Table(LAW),
)
"""Table [loop]."""


def loop_kind(table: Data) -> LoopKind:
    """Kind of loop of a table [loop] that has been read."""
    return LoopOfModule() if reference(table["kind"]) is not None else LOOP_KINDS[table["kind"]]


def build_loop(table: Data, path: Path) -> System | Builder:
    """Loop of the table [loop] of a study file.

    Raises
    ------
    StudyError
        If it cannot be built.
    """
    return loop_kind(table).build(table, path)


_SIGNATURE = "def build() -> control.InputOutputSystem:"


def _checked_function(function: object) -> Callable[..., object]:
    """Function without required arguments that is annotated to return a control system."""
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
    return function
