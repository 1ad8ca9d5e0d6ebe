"""A user's own study, stated in a TOML file."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import io
import json
import math
import os
import sys
import tomllib
from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from types import ModuleType, UnionType
from typing import Union, get_args, get_origin

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._renamed import warn_renamed
from ctrlplan._types import Data
from ctrlplan.simulation import Event
from ctrlplan.studies.baselines import smoother_polynomials
from ctrlplan.studies.benefit import Choices, benefit_of
from ctrlplan.studies.comparison import comparison_of
from ctrlplan.studies.crane_setup import CRANE_MEASURES, LOAD, SLACK, marked_slack
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.plans import standard_plans
from ctrlplan.studies.running import Builder, System
from ctrlplan.studies.sections import AnimatedCrane, CraneMotion, CranePaths, CraneTime, PlanCurves
from ctrlplan.studies.study import Study
from ctrlplan.systems.plants import LAWS, Crane, crane_loop, unity_feedback_loop
from ctrlplan.systems.plants.crane.laws import as_law
from ctrlplan.trajectories import PolySpline, Trajectory, TrigSpline, Waypoint
from ctrlplan.trajectories.files import csv_header, signal_names, signal_rows
from ctrlplan.trajectories.waypoint_spline import FromWaypoints, families, family_name

LOOPS = {
    "linear": ("num", "den", "gain"),
    "crane": ("law", "force_limits", "torque_limits", *(entry.name for entry in fields(Crane))),
}
"""Kinds of loops by name, and the entries that each takes.

Besides, "python:module:function": a function beside the study file or of an
installed package, which takes nothing and is declared to return a loop by its
return annotation, ``def build() -> control.InputOutputSystem``. A study file
that names one is code: whoever runs the study runs the module.
The same holds of a family of plans "python:module:Class", a class derived from
`WaypointSpline`.
"""


_CRANE_ENTRIES = tuple(entry.name for entry in fields(Crane))


class StudyError(ValueError):
    """A study file is wrong: one line says what must hold, what was given and where."""

    def __init__(self, message: object) -> None:
        super().__init__(_one_line(str(message)))


@dataclass(frozen=True)
class StudyFile:
    """What a study file states.

    Attributes
    ----------
    path : pathlib.Path
        The file.
    name, title : str
        Key and heading.
    t_end : float
        Time at which the runs end [s].
    samples : int
        Number of sample times.
    waypoints : tuple of Waypoint
        What the plans meet.
    plans : dict of str to Trajectory
        The plans by name.
    loop : dict
        The table [loop].
    units : dict of str to str
        Units by label.
    benefit : bool
        Whether the report compares planning with its baselines.
    experiment : dict
        The table [experiment]: further fields of `Experiment` by name.
    """

    path: Path
    name: str
    title: str
    t_end: float
    samples: int
    waypoints: tuple[Waypoint, ...]
    plans: dict[str, Trajectory]
    loop: Data
    units: dict[str, str] = field(default_factory=dict)
    benefit: bool = False
    experiment: Data = field(default_factory=dict)

    def run(self) -> Study:
        """Simulate and measure.

        Raises
        ------
        StudyError
            If the loop does not fit the plans.
        """
        loop = build_loop(self.loop, self.path)
        fields_of, choices = self._crane() if self.loop["kind"] == "crane" else (self.experiment, Choices())
        try:
            experiment = Experiment(self.plans, self.timepts(loop), waypoints=self.waypoints, **fields_of)
            with np.errstate(over="ignore", invalid="ignore"):  # a run that leaves all bounds says so itself
                found = experiment.run(loop)
                comparison = comparison_of(experiment, found, self.units, self.parameters(), self.title)
                if self.benefit:
                    alphas = (plan.alpha for plan in comparison.plans.values() if isinstance(plan, TrigSpline))
                    choices = replace(choices, alpha=next(alphas, 1.0))
                    benefit = benefit_of(experiment, loop, choices, units=self.units)
                    comparison = comparison.with_benefit(benefit)
        except StudyError:
            raise
        except (ValueError, TypeError, RuntimeError) as error:
            raise StudyError(f"{self.path}: loop: {error}") from error
        except Exception as error:  # whatever a loop of the user's own raises with every plan
            raise StudyError(f"{self.path}: loop: must run, got {type(error).__name__}: {error}") from error
        if self.loop["kind"] != "crane":
            return Study(self.name, self.title, comparison, notes=comparison.notes)
        sections = (CranePaths(), PlanCurves(), CraneTime(), CraneMotion(), AnimatedCrane())
        return Study(self.name, self.title, marked_slack(comparison), notes=comparison.notes, sections=sections)

    def _crane(self) -> tuple[Data, Choices]:
        """Fields of the experiment with a crane, and how planning is judged: by sway, and against shaped references."""
        labels = self.waypoints[0].labels or ()
        if set(labels) != {"x", "z"}:
            raise StudyError(f"{self.path}: waypoints: a crane's axes must be x and z (down), got {', '.join(labels)}")
        crane = Crane(**{key: value for key, value in self.loop.items() if key in _CRANE_ENTRIES})
        depth = float(np.mean([point.position[labels.index("z")] for point in self.waypoints]))
        measures = CRANE_MEASURES | {"load": LOAD}
        own = [replace(measure, name=name) for name, measure in measures.items()]
        stated = self.experiment.get("measures")
        fields_of: Data = {"controls": ("F", "C")} | self.experiment
        fields_of["events"] = (SLACK, *self.experiment.get("events", ()))
        fields_of["measures"] = measures if stated is None else [*own, *stated]
        return fields_of, Choices(
            quantities=crane,
            mode=(math.sqrt(crane.gravity / depth), 0.0) if depth > 0.0 else None,
            decisive=("settling_time", "sway_after", "force_peak"),
            baselines=smoother_polynomials,
        )

    def timepts(self, loop: System | Builder) -> NDArray[np.float64]:
        """Sample times: those asked for and the waypoints', or the periods of a discrete loop."""
        start = self.waypoints[0].time
        dt = getattr(loop, "dt", None)
        if dt:
            period = 1.0 if dt is True else float(dt)
            count = (self.t_end - start) / period
            _check_memory(count, len(self.plans), self.benefit, f"{self.path}: t_end: periods of {period:g} s")
            return start + period * np.arange(int((self.t_end - start) / period * (1 + 1e-12)) + 1, dtype=float)
        return np.union1d(np.linspace(start, self.t_end, self.samples), [w.time for w in self.waypoints])

    def parameters(self) -> dict[str, object]:
        """What the report says about how it was made."""
        stated = dict(self.loop)
        if stated["kind"] == "crane":
            own = {key: value for key, value in stated.items() if key in _CRANE_ENTRIES}
            stated = {"kind": "crane", "law": "generator", "force_limits": "none", "torque_limits": "none"} | stated
            stated |= {entry.name: own.get(entry.name, entry.default) for entry in fields(Crane)}
        loop = {f"loop {key}": value for key, value in stated.items()}
        plans: dict[str, object] = {f"plan {name}": _described(plan) for name, plan in self.plans.items()}
        points: dict[str, object] = {f"waypoint {i}": repr(w) for i, w in enumerate(self.waypoints)}
        run = f"{self.waypoints[0].time:g} to {self.t_end:g} s, {self.samples} samples"
        return loop | plans | points | {"run": run}


_ENTRIES = ("title", "t_end", "samples", "benefit", "worth", "units", "experiment", "loop", "plans", "waypoints")
_EXPERIMENT = ("start", "band", "outputs", "controls", "initial_state", "params", "events", "measures")
"""Fields of `Experiment` that the table [experiment] may state; the others have entries of their own."""


def load_study(path: str | os.PathLike[str]) -> StudyFile:
    """Read and check a study file; nothing is simulated.

    Parameters
    ----------
    path : str or path
        A TOML file; see the README for its entries.

    Returns
    -------
    StudyFile

    Raises
    ------
    StudyError
        With one line: what must hold, what was given, where.
    """
    source = Path(path)
    data = _parsed(source)
    reader = _Reader(source)
    reader.known(data, _ENTRIES, "the file")
    waypoints = reader.waypoints(data)
    t_end = reader.number(data, "t_end", "t_end", default=None)
    if not t_end > waypoints[-1].time:
        raise reader.error("t_end", f"must be after the last waypoint at {waypoints[-1].time:g} s, got {t_end:g}")
    loop = reader.table(data, "loop")
    _checked_loop(loop, reader)
    samples = reader.number(data, "samples", "samples", default=4001.0)
    if samples != int(samples) or samples < 2:
        raise reader.error("samples", f"must be a whole number, 2 or more, got {samples:g}")
    title = data.get("title", source.stem)
    if not isinstance(title, str):
        raise reader.error("title", f"must be a string, got {_got(title)}")
    benefit = reader.benefit(data)
    units = reader.table(data, "units", needed=False)
    for label, unit in units.items():
        if not isinstance(unit, str):
            raise reader.error(f"units.{label}", f"must be a string, got {_got(unit)}")
        known = [*(waypoints[0].labels or ()), "y", "u", "e"]
        if label not in known and loop["kind"] == "linear":
            raise reader.error(f"units.{label}", f"must be of one of {', '.join(known)}, got {label!r}")
    plans = reader.plans(data, waypoints)
    _check_memory(samples, len(plans), benefit, f"{source}: samples")
    experiment = reader.experiment(data, plans, (waypoints[0].time, t_end))
    return StudyFile(
        source, source.stem, title, t_end, int(samples), waypoints, plans, loop, units, benefit, experiment
    )


_MEMORY = 2.0**30
"""Bytes that a run and its page may take, as far as the number of samples decides."""

_BESIDE, _EACH, _RIVALS = 750, 450, 8
"""Bytes a sample, as measured with a crane: once, and for each plan; and how many plans a benefit report adds."""


def _check_memory(samples: float, plans: int, benefit: bool, place: str) -> None:
    """Raise where the samples of all plans would take more memory than a study may."""
    each = _BESIDE + _EACH * (plans + _RIVALS * benefit)
    if samples * each > _MEMORY:
        raise StudyError(
            f"{place} must be at most {int(_MEMORY / each)} with {plans} plans, for about {_MEMORY / 1e9:.2g} GB of "
            f"memory, got {samples:.12g}, for about {samples * each / 1e9:.2g} GB"
        )


_LARGEST = 2**20
"""Bytes of a study file at most: it is written by hand."""


def _parsed(source: Path) -> Data:
    """Data of a TOML file."""
    try:
        with source.open("rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise StudyError(f"{source}: a study file must have at most {_LARGEST} bytes, got more")
        return tomllib.loads(content.decode("utf-8"))
    except FileNotFoundError:
        raise StudyError(f"{source}: a study file must exist, got no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise StudyError(f"{source}: a study file must be readable, got {error}") from None
    except StudyError:
        raise
    except RecursionError:
        raise StudyError(f"{source}: must be valid TOML, got lists or tables nested too deep") from None
    except ValueError as error:  # invalid TOML, or a number too long to read
        raise StudyError(f"{source}: must be valid TOML, got {error}") from None


def build_loop(table: Data, path: Path) -> System | Builder:
    """Loop that the table [loop] asks for.

    Raises
    ------
    StudyError
        If it cannot be built.
    """
    kind = table["kind"]
    if kind == "linear":
        try:
            return unity_feedback_loop(table["num"], table["den"], table.get("gain", 1.0), outputs=("y", "u"))
        except (ValueError, TypeError) as error:
            raise StudyError(f"{path}: loop: {error}") from None
    if kind == "crane":
        return _crane(table, path)
    return _loop_of_module(kind, path)


_SIGNATURE = "def build() -> control.InputOutputSystem:"


def _loop_of_module(kind: str, path: Path) -> System:
    """Loop that a function of a module returns, called only where it is declared to return one."""
    _, module, name = kind.split(":")
    try:
        if not all(part.isidentifier() for part in (*module.split("."), name)):
            raise ValueError("module and function must be names, with dots between packages")
        function = getattr(_module(module, path.resolve().parent), name)
        _check_declared(function)
        loop = function()
    except (Exception, SystemExit) as error:  # whatever a user's own module does must end in one line
        must = f"must name a module and a function in it, such as {_SIGNATURE}"
        raise StudyError(
            f"{path}: loop.kind: {must}, got {kind!r}: {type(error).__name__}: {_one_line(str(error), 300)}"
        ) from None
    if not (hasattr(loop, "output_labels") and hasattr(loop, "ninputs")):
        raise StudyError(f"{path}: loop.kind: {kind!r} must return a control system, got {type(loop).__name__}")
    return loop


def _check_declared(function: object) -> None:
    """Raise where a callable is not a function that takes nothing and is declared to return a control system."""
    if not callable(function) or inspect.isclass(function) or not inspect.isfunction(inspect.unwrap(function)):
        raise TypeError(f"what is called must be a function of Python, got {type(function).__name__}")
    try:
        signature = inspect.signature(function, eval_str=True)
    except NameError as error:
        raise TypeError(f"its annotations must have a meaning where the module runs, got {error}") from None
    spare = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    needed = [p.name for p in signature.parameters.values() if p.default is p.empty and p.kind not in spare]
    if needed:
        raise TypeError(f"the function must take nothing, got one that needs {', '.join(needed)}")
    declared = signature.return_annotation
    kinds = get_args(declared) if isinstance(declared, UnionType) or get_origin(declared) is Union else (declared,)
    if not all(inspect.isclass(kind) and issubclass(kind, ct.InputOutputSystem) for kind in kinds):
        got = "none" if declared is signature.empty else declared
        raise TypeError(f"its return annotation must be a class of control systems, got {got}")


def _crane(table: Data, path: Path) -> Builder:
    """Loop of each plan: steps, shaped or not, go to the drives as at rest, every other plan through the law."""
    try:
        crane = Crane(**{key: value for key, value in table.items() if key in _CRANE_ENTRIES})
    except (ValueError, TypeError) as error:
        raise StudyError(f"{path}: loop: {error}") from None
    try:
        law = as_law(table.get("law", "generator"))
    except (ValueError, TypeError):
        raise StudyError(f"{path}: loop.law: must be one of {', '.join(LAWS)}, got {_got(table['law'])}") from None
    limits = {key: table[key] for key in ("force_limits", "torque_limits") if key in table}
    for key, pair in limits.items():
        if not (isinstance(pair, list) and len(pair) == 2 and all(map(_is_number, pair)) and pair[0] < pair[1]):
            raise StudyError(f"{path}: loop.{key}: must be two increasing numbers, got {_got(pair)}")

    def build(name: str, plan: Trajectory) -> System:
        return crane_loop(crane, plan, LAWS["setpoint"] if plan.jumps(0) else law, **limits)

    return build


def _module(name: str, folder: Path) -> ModuleType:
    """Module beside the study file, never one of the same name from elsewhere; or an installed one."""
    source = folder.joinpath(*name.split(".")).with_suffix(".py")
    spec = importlib.util.spec_from_file_location(name, source) if source.is_file() else None
    if spec is None or spec.loader is None:
        return importlib.import_module(name)
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(folder))  # for what it imports itself
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
    return module


def plans_as_json(study: StudyFile) -> str:
    """Plans of a study as JSON text: each by name, for `trajectory_from_dict`."""
    return json.dumps({name: plan.to_dict() for name, plan in study.plans.items()}, indent=1, allow_nan=False) + "\n"


def plans_as_csv(study: StudyFile, order: int = 2) -> str:
    """Samples of all plans as one table: time, then plan.axis with its derivatives.

    An apostrophe stands before names that a spreadsheet would take for a formula.
    """
    times = np.linspace(study.waypoints[0].time, study.waypoints[-1].time, 1001)
    times = np.union1d(times, [w.time for w in study.waypoints])
    names, rows = ["time"], [times]
    for name, plan in study.plans.items():
        head = f"'{name}" if name.startswith(("=", "+", "-", "@", "\t", "\r")) else name
        names += [f"{head}.{signal}" for signal in signal_names(plan.labels, order)]
        rows += list(signal_rows(plan, times, order))
    try:
        header = csv_header(names)
    except ValueError as error:
        raise StudyError(f"{study.path}: waypoints: {error}") from None
    table = io.StringIO(newline="")
    np.savetxt(table, np.array(rows).T, fmt="%.17g", delimiter=",", header=header, comments="")
    return table.getvalue()


class _Reader:
    """Checks entries of one file, naming the place in every error."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def error(self, place: str, message: object) -> StudyError:
        return StudyError(f"{self.path}: {place}: {message}")

    def known(self, table: Data, names: Collection[str], place: str) -> None:
        for key in table:
            if key not in names:
                raise self.error(place, f"entries must be among {', '.join(names)}, got {key!r}")

    def table(self, data: Data, key: str, needed: bool = True) -> Data:
        found = data.get(key)
        if found is None and not needed:
            return {}
        if not isinstance(found, dict):
            raise self.error(key, f"must be a table [{key}], got {'none' if found is None else _got(found)}")
        return found

    def tables(self, data: Data, key: str) -> list[Data]:
        found = data.get(key, [])
        if not isinstance(found, list) or not all(isinstance(t, dict) for t in found):
            raise self.error(key, f"must be tables [[{key}]], got {_got(found)}")
        return found

    def number(self, table: Data, key: str, place: str, default: float | None) -> float:
        value = table.get(key, default)
        if value is None or not _is_number(value):
            raise self.error(place, f"must be a finite number, got {'none' if value is None else _got(value)}")
        return float(value)

    def numbers(self, table: Data, key: str, place: str, finite: bool = True) -> list[float]:
        value = table.get(key)
        if not isinstance(value, list) or not all(_is_number(v, finite) for v in value):
            kind = "finite numbers" if finite else "numbers"
            raise self.error(place, f"must be a list of {kind}, got {'none' if value is None else _got(value)}")
        return [float(v) for v in value]

    def choice(self, table: Data, key: str, place: str) -> float | str | list[float]:
        """What a plan was asked for: a number, "auto", or a list with one entry an axis."""
        if table[key] == "auto":
            return "auto"
        return (self.numbers if isinstance(table[key], list) else partial(self.number, default=None))(table, key, place)

    def waypoints(self, data: Data) -> tuple[Waypoint, ...]:
        loop = data.get("loop")
        # A crane is measured in x and z, in whatever order a file has them.
        first = ("x", "z") if isinstance(loop, dict) and loop.get("kind") == "crane" else ()
        points = []
        for i, table in enumerate(self.tables(data, "waypoints")):
            place = f"waypoints[{i}]"
            time = self.number(table, "time", f"{place}.time", default=None)
            labels = [label for label in first if label in table]
            labels += [label for label in table if label not in ("time", *first)]
            jets = {label: self.numbers(table, label, f"{place}.{label}", finite=False) for label in labels}
            try:
                points.append(Waypoint.from_jets(time, **jets))
            except ValueError as error:
                raise self.error(place, error) from None
        try:
            return PolySpline(points, warn=False).waypoints
        except ValueError as error:
            raise self.error("waypoints", error) from None

    def benefit(self, data: Data) -> bool:
        """Whether planning is compared with its baselines; "worth" is the former name of the entry."""
        if "worth" in data and "benefit" in data:
            raise self.error("worth", "must not be given beside benefit, got both")
        key = "worth" if "worth" in data else "benefit"
        value = data.get(key, False)
        if not isinstance(value, bool):
            raise self.error(key, f"must be true or false, got {_got(value)}")
        if key == "worth":
            warn_renamed(f"{self.path}: worth =", "benefit =")
        return value

    def experiment(self, data: Data, plans: dict[str, Trajectory], span: tuple[float, float]) -> Data:
        """The table [experiment], checked as `Experiment` does."""
        found = dict(self.table(data, "experiment", needed=False))
        self.known(found, _EXPERIMENT, "experiment")
        events = found.get("events", [])
        if not isinstance(events, list) or not all(isinstance(table, dict) for table in events):
            raise self.error("experiment.events", f"must be tables, each with a signal, got {_got(events)}")
        for key in ("start", "band"):
            if key in found:
                self.number(found, key, f"experiment.{key}", default=None)
        for table in events:
            self.known(table, [entry.name for entry in fields(Event)], "experiment.events")
            if not isinstance(table.get("signal"), str):
                raise self.error("experiment.events", f"must have a signal, the label of one, got {_got(table)}")
        try:
            if events:
                found["events"] = [Event(**table) for table in events]
            Experiment(plans, np.linspace(*span, 1001), **found)
        except (ValueError, TypeError) as error:
            raise self.error("experiment", error) from None
        return found

    def family(self, family: object, place: str) -> type[FromWaypoints] | None:
        """Kind of trajectory that a family names; None is the step."""
        known = families()
        if family == "step":
            return None
        if isinstance(family, str) and family in known:
            return known[family]
        if isinstance(family, str) and family.startswith("python:") and family.count(":") == 2:
            return _kind_of_module(family, self.path, place)
        names = ", ".join([*sorted(known), "step", '"python:module:Class"'])
        raise self.error(place, f"must be one of {names}, got {_got(family)}")

    def plans(self, data: Data, waypoints: tuple[Waypoint, ...]) -> dict[str, Trajectory]:
        plans: dict[str, Trajectory] = {}
        for i, table in enumerate(self.tables(data, "plans")):
            place = f"plans[{i}]"
            family = table.get("family", table.get("name"))
            kind = self.family(family, f"{place}.family")
            name = table.get("name", family if kind is None else family_name(kind))
            if not isinstance(name, str) or not name or name in plans:
                raise self.error(f"{place}.name", f"must be a name of its own, got {_got(name)}")
            choices = () if kind is None else kind.options
            self.known(table, ("name", "family", *choices), place)
            chosen = {key: self.choice(table, key, f"{place}.{key}") for key in choices if key in table}
            try:
                plans[name] = (
                    standard_plans(waypoints)["step"] if kind is None else _made(kind, waypoints, str(family), chosen)
                )
            except (ValueError, TypeError) as error:
                raise self.error(place, error) from None
            except Exception as error:  # whatever a kind of the user's own raises
                raise self.error(place, f"must make a plan, got {type(error).__name__}: {error}") from error
        return plans or standard_plans(waypoints)


def _kind_of_module(family: str, path: Path, place: str) -> type[FromWaypoints]:
    """Kind of trajectory that a module defines: beside the study file, or of an installed package."""
    _, module, name = family.split(":")
    try:
        if not all(part.isidentifier() for part in (*module.split("."), name)):
            raise ValueError("module and class must be names, with dots between packages")
        kind = getattr(_module(module, path.resolve().parent), name)
    except (Exception, SystemExit) as error:  # whatever a user's own module does must end in one line
        raise StudyError(
            f"{path}: {place}: must name a module and a class in it, got {family!r}: "
            f"{type(error).__name__}: {_one_line(str(error), 300)}"
        ) from None
    if not (inspect.isclass(kind) and issubclass(kind, FromWaypoints)) or inspect.isabstract(kind):
        what = kind.__name__ if inspect.isclass(kind) else type(kind).__name__
        raise StudyError(
            f"{path}: {place}: {family!r} must be made from waypoints, a class derived from WaypointSpline, got {what}"
        )
    return kind


def _made(kind: type[FromWaypoints], waypoints: tuple[Waypoint, ...], family: str, chosen: Data) -> Trajectory:
    """Plan of a kind with the options chosen, of which none that it needs may be missing."""
    parameters = inspect.signature(kind).parameters
    for name in kind.options:
        if name not in chosen and name in parameters and parameters[name].default is inspect.Parameter.empty:
            known = ", a number in [0, 2 pi)" if name == "alpha" else ""
            raise ValueError(f"a plan of the family {family} needs {name}{known}, got none")
    return kind.from_waypoints(waypoints, **chosen)


def _checked_loop(loop: Data, reader: _Reader) -> None:
    kind = loop.get("kind")
    if isinstance(kind, str) and kind.startswith("python:") and kind.count(":") == 2:
        reader.known(loop, ("kind",), "loop")
        return
    if not isinstance(kind, str) or kind not in LOOPS:
        kinds = ", ".join([*LOOPS, '"python:module:function"'])
        raise reader.error("loop.kind", f"must be one of {kinds}, got {_got(kind)}")
    reader.known(loop, ("kind", *LOOPS[kind]), "loop")
    if kind == "crane":
        build_loop(loop, reader.path)
        return
    for key in ("num", "den"):
        loop[key] = reader.numbers(loop, key, f"loop.{key}")
    loop["gain"] = reader.number(loop, "gain", "loop.gain", default=1.0)
    build_loop(loop, reader.path)


def _got(value: object) -> str:
    """A value in a message."""
    try:
        return _one_line(repr(value), 300)
    except ValueError:  # of a whole number beyond all that Python prints
        return f"a {type(value).__name__} too long to print"


def _one_line(text: str, longest: int = 1500) -> str:
    """Text in one line without control characters, its middle left out where it is long."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
    return line if len(line) <= longest else f"{line[: longest - 100]} … {line[-100:]}"


def _is_number(value: object, finite: bool = True) -> bool:
    """Whether a TOML value is a number; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value) or not finite
    except OverflowError:  # a whole number beyond all floating-point ones
        return False


def _described(plan: Trajectory) -> str:
    alpha = getattr(plan, "alpha", None) if "alpha" in getattr(plan, "options", ()) else None
    shape = "" if alpha is None else f", alpha = {alpha:g} rad"
    return f"{type(plan).__name__}{shape}, {plan.start:g} to {plan.end:g} s"
