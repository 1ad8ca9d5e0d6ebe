"""Kinds of loops in study files: one class per kind, and one entry of `LOOP_KINDS`."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from types import UnionType
from typing import ClassVar, TypeAlias, Union, get_args, get_origin

import control as ct
import numpy as np

from ctrlplan._types import Data
from ctrlplan.planning import Obstacle, Rectangle
from ctrlplan.studies.baselines import smoother_polynomials
from ctrlplan.studies.benefit import Choices
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.crane_setup import CRANE_MEASURES, LOAD, SLACK, marked_slack
from ctrlplan.studies.entries import NUMBERS, PAIR, Entries, Entry, Flag, Number, Table, Text, Variants
from ctrlplan.studies.reading import Reader, StudyError, got, named_in_module, one_line, reference
from ctrlplan.studies.running import Builder, System
from ctrlplan.studies.sections import AnimatedCrane, CraneMotion, CranePaths, CraneTime, Paths, PlanCurves, Wall
from ctrlplan.studies.study import Study
from ctrlplan.systems.plants import LAWS, Crane, crane_loop, unity_feedback_loop
from ctrlplan.systems.plants.crane.laws import OLD_NAMES, as_law
from ctrlplan.trajectories import Trajectory, Waypoint

Varied: TypeAlias = "System | Builder | Callable[..., System | Builder]"
"""A loop whose blocks read parameters, or a function of these that returns a loop."""


class LoopKind(ABC):
    """Kind of loop: entries of its table [loop], construction, and sections of its study.

    Attributes
    ----------
    entries : mapping of str to Entry
        Entries of [loop] in addition to ``kind``.
    axes : tuple of str
        Labels of waypoints that come first, in any order of the file.
    signals : tuple of str or None
        Signals that may have a unit, in addition to the axes; None for any name.
    """

    entries: ClassVar[Entries] = {}
    axes: ClassVar[tuple[str, ...]] = ()
    signals: ClassVar[tuple[str, ...] | None] = None

    @abstractmethod
    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop, or a function that builds a loop for each plan; StudyError if that is not possible."""

    def check(self, table: Data, path: Path) -> None:  # noqa: B027 (nothing to check, unless a kind has more)
        """Check what can be checked before planning, of a table that has been read; StudyError if it is wrong."""

    def crane(self, table: Data, path: Path) -> Crane | None:
        """Crane of the loop, if it is the loop of one."""
        return None

    def limited(self, table: Data, path: Path) -> Callable[[], System] | None:
        """Function that returns the loop whose signals may be limited; None if there is none before the run."""
        return None

    def check_parameter(self, parameter: str, place: str, reader: Reader) -> None:
        """Raise if there is no such parameter for [sweep] and [draws], as far as is known before the run."""
        known = [key for key, entry in self.entries.items() if isinstance(entry.kind, Number)]
        if parameter not in known:
            raise reader.error(place, f"must be a number of [loop], one of {', '.join(known)}, got {parameter!r}")

    def varied(self, names: Sequence[str], table: Data, path: Path) -> Varied:
        """Function of parameters that returns a loop, or a loop whose blocks read them; for [draws]."""
        return _of_parameters(names, lambda **values: self.build(table | values, path))

    def experiment(self, table: Data, waypoints: Sequence[Waypoint], stated: Data, path: Path) -> tuple[Data, Choices]:
        """Fields of the experiment, and options of the benefit of planning."""
        return stated, Choices()

    def parameters(self, table: Data) -> Data:
        """Parameters of the loop, for the report."""
        return dict(table)

    def study(self, name: str, title: str, comparison: Comparison, obstacles: Sequence[Obstacle] = ()) -> Study:
        """Study of the comparison, with the sections of this kind of loop and obstacles in its paths."""
        return Study(name, title, comparison, notes=comparison.notes, sections=comparison.sections(obstacles))


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
        crane, law = self.crane(table, path), as_law(table.get("law", "generator"))
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
        crane = self.crane(table, path)
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

    def crane(self, table: Data, path: Path) -> Crane:
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
    """Loop returned by a function of a module, which must be annotated to return one."""

    def build(self, table: Data, path: Path) -> System | Builder:
        """Loop returned by the function, with parameters of a sweep as its arguments."""
        values = dict(table)
        del values["kind"]
        return self._returned(table, self._function(table, path), path, **values)

    def limited(self, table: Data, path: Path) -> Callable[[], System]:
        """The loop that the function returns; the module is imported by the call only."""
        return lambda: self._returned(table, self._function(table, path), path)

    def check_parameter(self, parameter: str, place: str, reader: Reader) -> None:
        """Nothing is known before the function is."""

    def varied(self, names: Sequence[str], table: Data, path: Path) -> Varied:
        """The function, if the parameters are among its arguments; otherwise its loop, whose blocks read them."""
        function = self._function(table, path)
        known = inspect.signature(function).parameters
        if not all(name in known for name in names):
            return self._returned(table, function, path)
        return _of_parameters(names, lambda **values: self._returned(table, function, path, **values))

    def _function(self, table: Data, path: Path) -> Callable[..., object]:
        try:
            function = named_in_module(table["kind"], path.resolve().parent)
            return _checked_function(function)
        except (Exception, SystemExit) as error:  # of a user's own module
            raise self._wrong(table, path, error) from None

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


LOOP_KINDS: dict[str, LoopKind] = {"linear": LinearLoop(), "crane": CraneLoop()}
"""Kinds of loops by the entry ``kind``.

A further kind is "python:module:function": a function without arguments, in a
module next to the study file or in an installed package, whose return
annotation is a control system: ``def build() -> control.InputOutputSystem``.
Running such a study file executes the module. The same is true of a family of
plans "python:module:Class", a class derived from `WaypointSpline`.
"""


def _of_parameters(names: Sequence[str], function: Callable[..., System | Builder]) -> Varied:
    """Function with arguments of some names, by which `monte_carlo` knows it."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    setattr(function, "__signature__", inspect.Signature([inspect.Parameter(name, keyword) for name in names]))  # noqa: B010
    return function


LOOP = Variants(
    "kind",
    lambda: {name: Table(kind.entries) for name, kind in LOOP_KINDS.items()},
    'kind of loop, or "python:module:function", a function annotated to return a control system',
    "function",
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
