"""A user's study, described by a TOML file.

``ctrlplan report STUDY.toml --out DIR`` runs a study and writes ``index.html``,
which can be read off line, and ``results.json``; ``ctrlplan plan STUDY.toml --out
plan.csv`` writes only the trajectories, as ``.json`` or in a format of
`ctrlplan.Trajectory.export`. A complete file:

.. code-block:: toml

    title = "Over the wall"
    t_end = 30.0
    samples = 4001            # optional
    benefit = true            # optional: compare with steps, profiles and minimum jerk, in the same time and limits
    [loop]
    kind = "linear"           # num/den with a gain in unity feedback
    num = [1.0]
    den = [1.0, 1.0, 0.0]
    gain = 5.0
    [units]                   # optional
    x = "m"
    [experiment]              # optional: further fields of ctrlplan.Experiment
    band = 0.02
    [[plans]]                 # without plans: step, polynomial, trigonometric, piecewise
    name = "trigonometric"
    family = "trigonometric"
    alpha = 4.0               # or "auto": the shortest path
    [[plans]]
    family = "step"
    [[waypoints]]
    time = 0.0
    x = [0.0, 0.0, 0.0]       # position, velocity, acceleration, ...: as many as prescribed
    [[waypoints]]
    time = 16.0
    x = [20.0, 0.0, 0.0]

Waypoints may instead be those of a CSV file, which `ctrlplan.waypoints_from_csv`
reads: ``waypoints = "path.csv"`` above the first table, or ``waypoints = {csv =
"path.csv", time = "time", columns = ["x"]}``; ``speed`` if it has no times.

Kinds of loops:

- ``"linear"``: ``num``, ``den`` and ``gain``.
- ``"crane"``: the axes are x and z (downwards). Optional: ``law`` ("setpoint",
  "generator", "load_feedback", "dynamic", "feedforward"), ``force_limits``,
  ``torque_limits``, and any parameter of `ctrlplan.plants.Crane`
  (``load_mass = 800.0``, ...).
- ``"python:module:function"``: a function annotated to return a loop, ``def
  build() -> control.InputOutputSystem``. Running such a study file
  executes the module; ``ctrlplan plan`` does not.

Families of plans: trigonometric, polynomial, piecewise, step, s_curve,
trapezoid, or ``"python:module:Class"``, a class derived from
`ctrlplan.WaypointSpline`.
"""

from __future__ import annotations

import inspect
import os
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctrlplan._renamed import warn_renamed
from ctrlplan._types import Data
from ctrlplan.simulation import Event
from ctrlplan.studies.benefit import benefit_of
from ctrlplan.studies.comparison import comparison_of
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.loops import build_loop, loop_kind, stated_kind
from ctrlplan.studies.plans import standard_plans
from ctrlplan.studies.reading import Reader, StudyError, got, named_in_module, one_line, reference
from ctrlplan.studies.running import Builder, System
from ctrlplan.studies.study import Study
from ctrlplan.trajectories import PolySpline, Trajectory, TrigSpline, Waypoint, waypoints_from_csv
from ctrlplan.trajectories.waypoint_spline import FromWaypoints, families, family_name

__all__ = ["StudyError", "StudyFile", "build_loop", "load_study"]


@dataclass(frozen=True)
class StudyFile:
    """Contents of a study file.

    Attributes
    ----------
    path : pathlib.Path
        The file.
    name, title : str
        Key in ``results.json``, and heading of the page.
    t_end : float
        End of the simulation [s].
    samples : int
        Number of sample times.
    waypoints : tuple of Waypoint
        Waypoints of the plans.
    plans : dict of str to Trajectory
        The plans by name.
    loop : dict
        The table [loop].
    units : dict of str to str
        Units by label.
    benefit : bool
        Whether the report contains the benefit of planning.
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
        kind = stated_kind(self.loop, Reader(self.path))
        loop = kind.build(self.loop, self.path)
        fields_of, choices = kind.experiment(self.loop, self.waypoints, self.experiment, self.path)
        try:
            experiment = Experiment(self.plans, self.timepts(loop), waypoints=self.waypoints, **fields_of)
            with np.errstate(over="ignore", invalid="ignore"):  # a diverging run is reported by the simulation
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
        except Exception as error:  # of a user's own loop
            raise StudyError(
                f"{self.path}: loop: simulation must not fail, got {type(error).__name__}: {error}"
            ) from error
        return kind.study(self.name, self.title, comparison)

    def timepts(self, loop: System | Builder) -> NDArray[np.float64]:
        """Sample times: evenly spaced, with those of the waypoints, or multiples of the period of a discrete loop."""
        start = self.waypoints[0].time
        dt = getattr(loop, "dt", None)
        if dt:
            period = 1.0 if dt is True else float(dt)
            count = (self.t_end - start) / period
            _check_memory(count, len(self.plans), self.benefit, f"{self.path}: t_end: periods of {period:g} s")
            return start + period * np.arange(int((self.t_end - start) / period * (1 + 1e-12)) + 1, dtype=float)
        return np.union1d(np.linspace(start, self.t_end, self.samples), [w.time for w in self.waypoints])

    def parameters(self) -> dict[str, object]:
        """Parameters of the study, for the report."""
        stated = stated_kind(self.loop, Reader(self.path)).parameters(self.loop)
        loop = {f"loop {key}": value for key, value in stated.items()}
        plans: dict[str, object] = {f"plan {name}": _described(plan) for name, plan in self.plans.items()}
        points: dict[str, object] = {f"waypoint {i}": repr(w) for i, w in enumerate(self.waypoints)}
        run = f"{self.waypoints[0].time:g} to {self.t_end:g} s, {self.samples} samples"
        return loop | plans | points | {"simulated time": run}


_ENTRIES = ("title", "t_end", "samples", "benefit", "worth", "units", "experiment", "loop", "plans", "waypoints")
_EXPERIMENT = ("start", "band", "outputs", "controls", "initial_state", "params", "events", "measures")
"""Fields of `Experiment` in the table [experiment]; other fields have separate entries."""


def load_study(path: str | os.PathLike[str]) -> StudyFile:
    """Read and check a study file; nothing is simulated.

    Parameters
    ----------
    path : str or path
        A TOML file; its entries are listed in the docstring of this module.

    Returns
    -------
    StudyFile

    Raises
    ------
    StudyError
        With a message of one line: the condition, the value given, and the place in the file.
    """
    source = Path(path)
    data = _parsed(source)
    reader = _FileReader(source)
    reader.known(data, _ENTRIES, "the file")
    waypoints = reader.waypoints(data)
    t_end = reader.number(data, "t_end", "t_end", default=None)
    if not t_end > waypoints[-1].time:
        raise reader.error("t_end", f"must be after the last waypoint at {waypoints[-1].time:g} s, got {t_end:g}")
    loop = reader.table(data, "loop")
    kind = stated_kind(loop, reader)
    kind.check(loop, reader)
    samples = reader.number(data, "samples", "samples", default=4001.0)
    if samples != int(samples) or samples < 2:
        raise reader.error("samples", f"must be an integer of at least 2, got {samples:g}")
    title = data.get("title", source.stem)
    if not isinstance(title, str):
        raise reader.error("title", f"must be a string, got {got(title)}")
    benefit = reader.benefit(data)
    units = reader.table(data, "units", required=False)
    for label, unit in units.items():
        if not isinstance(unit, str):
            raise reader.error(f"units.{label}", f"must be a string, got {got(unit)}")
        known = [*(waypoints[0].labels or ()), *(kind.signals or ())]
        if kind.signals is not None and label not in known:
            raise reader.error(f"units.{label}", f"must be of one of {', '.join(known)}, got {label!r}")
    plans = reader.plans(data, waypoints)
    _check_memory(samples, len(plans), benefit, f"{source}: samples")
    experiment = reader.experiment(data, plans, (waypoints[0].time, t_end))
    return StudyFile(
        source, source.stem, title, t_end, int(samples), waypoints, plans, loop, units, benefit, experiment
    )


_MEMORY = 2.0**30
"""Memory limit [bytes] of a run and its page, as a function of the number of samples."""

_ONCE, _EACH, _BASELINES = 750, 450, 8
"""Measured memory per sample [bytes], fixed and per plan; and the number of plans that a benefit adds."""


def _check_memory(samples: float, plans: int, benefit: bool, place: str) -> None:
    """Raise if the samples of all plans exceed the memory limit."""
    each = _ONCE + _EACH * (plans + _BASELINES * benefit)
    if samples * each > _MEMORY:
        raise StudyError(
            f"{place} must be at most {int(_MEMORY / each)} with {plans} plans, for about {_MEMORY / 1e9:.2g} GB of "
            f"memory, got {samples:.12g}, for about {samples * each / 1e9:.2g} GB"
        )


_LARGEST = 2**20
"""Maximum size of a study file [bytes]."""


def _parsed(source: Path) -> Data:
    """Data of a TOML file."""
    try:
        with source.open("rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise StudyError(f"{source}: study file must have at most {_LARGEST} bytes, got more")
        return tomllib.loads(content.decode("utf-8"))
    except FileNotFoundError:
        raise StudyError(f"{source}: study file must exist, got no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise StudyError(f"{source}: study file must be readable, got {error}") from None
    except StudyError:
        raise
    except RecursionError:
        raise StudyError(f"{source}: must be valid TOML, got lists or tables nested too deeply") from None
    except ValueError as error:  # invalid TOML, or a number too long to read
        raise StudyError(f"{source}: must be valid TOML, got {error}") from None


class _FileReader(Reader):
    """Reader of the tables of a study file."""

    def waypoints(self, data: Data) -> tuple[Waypoint, ...]:
        loop = data.get("loop")
        kind = loop_kind(loop.get("kind")) if isinstance(loop, dict) else None
        first = () if kind is None else kind.axes
        if isinstance(data.get("waypoints"), str | dict):
            return self.waypoints_of_csv(data["waypoints"], first)
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

    def waypoints_of_csv(self, stated: str | Data, first: Sequence[str]) -> tuple[Waypoint, ...]:
        """Waypoints of a CSV file, named by its path or by a table with the arguments of `waypoints_from_csv`."""
        table: Data = {"csv": stated} if isinstance(stated, str) else stated
        self.known(table, ("csv", "time", "columns", "speed"), "waypoints")
        if not isinstance(table.get("csv"), str):
            raise self.error("waypoints.csv", f"must be the path of a CSV file, got {got(table.get('csv'))}")
        options: Data = {key: value for key, value in table.items() if key != "csv"}
        try:
            points = waypoints_from_csv(self.path.parent / table["csv"], **options)
            labels = points[0].labels
            if labels is not None:
                order = sorted(range(len(labels)), key=lambda k: (*first, labels[k]).index(labels[k]))
                names = tuple(labels[k] for k in order)
                points = [Waypoint.from_array(w.time, w.jet[:, order], names) for w in points]
            return PolySpline(points, warn=False).waypoints
        except OSError as error:
            raise self.error("waypoints", f"must be a file that can be read, got {error}") from None
        except (ValueError, TypeError) as error:
            raise self.error("waypoints", error) from None

    def benefit(self, data: Data) -> bool:
        """Whether the report contains the benefit of planning; "worth" is the former name of the entry."""
        if "worth" in data and "benefit" in data:
            raise self.error("worth", "must not be given together with benefit, got both")
        key = "worth" if "worth" in data else "benefit"
        value = data.get(key, False)
        if not isinstance(value, bool):
            raise self.error(key, f"must be true or false, got {got(value)}")
        if key == "worth":
            warn_renamed(f"{self.path}: worth =", "benefit =")
        return value

    def experiment(self, data: Data, plans: dict[str, Trajectory], span: tuple[float, float]) -> Data:
        """The table [experiment], checked as `Experiment` does."""
        found = dict(self.table(data, "experiment", required=False))
        self.known(found, _EXPERIMENT, "experiment")
        events = found.get("events", [])
        if not isinstance(events, list) or not all(isinstance(table, dict) for table in events):
            raise self.error("experiment.events", f"must be a list of tables with the entry signal, got {got(events)}")
        for key in ("start", "band"):
            if key in found:
                self.number(found, key, f"experiment.{key}", default=None)
        for table in events:
            self.known(table, [entry.name for entry in fields(Event)], "experiment.events")
            if not isinstance(table.get("signal"), str):
                raise self.error(
                    "experiment.events", f"must have the entry signal, the label of a signal, got {got(table)}"
                )
        try:
            if events:
                found["events"] = [Event(**table) for table in events]
            Experiment(plans, np.linspace(*span, 1001), **found)
        except (ValueError, TypeError) as error:
            raise self.error("experiment", error) from None
        return found

    def family(self, family: object, place: str) -> type[FromWaypoints] | None:
        """Class of a family of trajectories; None for one of `_FREE_FAMILIES`."""
        known = families()
        if isinstance(family, str):
            if family in _FREE_FAMILIES:
                return None
            if family in known:
                return known[family]
            if reference(family) is not None:
                return _kind_of_module(family, self.path, place)
        names = ", ".join([*sorted(known), *_FREE_FAMILIES, '"python:module:Class"'])
        raise self.error(place, f"must be one of {names}, got {got(family)}")

    def plans(self, data: Data, waypoints: tuple[Waypoint, ...]) -> dict[str, Trajectory]:
        plans: dict[str, Trajectory] = {}
        for i, table in enumerate(self.tables(data, "plans")):
            place = f"plans[{i}]"
            family = table.get("family", table.get("name"))
            kind = self.family(family, f"{place}.family")
            name = table.get("name", family if kind is None else family_name(kind))
            if not isinstance(name, str) or not name or name in plans:
                raise self.error(f"{place}.name", f"must be a unique name, got {got(name)}")
            choices = () if kind is None else kind.options
            self.known(table, ("name", "family", *choices), place)
            chosen = {key: self.choice(table, key, f"{place}.{key}") for key in choices if key in table}
            try:
                plans[name] = (
                    _FREE_FAMILIES[str(family)](waypoints)
                    if kind is None
                    else _made(kind, waypoints, str(family), chosen)
                )
            except (ValueError, TypeError) as error:
                raise self.error(place, error) from None
            except Exception as error:  # of a user's own class
                raise self.error(place, f"construction must not fail, got {type(error).__name__}: {error}") from error
        return plans or standard_plans(waypoints)


_FREE_FAMILIES: dict[str, Callable[[tuple[Waypoint, ...]], Trajectory]] = {
    "step": lambda waypoints: standard_plans(waypoints)["step"],
}
"""Families without options that are not splines through waypoints."""


def _kind_of_module(family: str, path: Path, place: str) -> type[FromWaypoints]:
    """Class of trajectories in a module next to the study file or in an installed package."""
    try:
        kind = named_in_module(family, path.resolve().parent)
    except (Exception, SystemExit) as error:  # of a user's own module
        raise StudyError(
            f"{path}: {place}: must name a class of a module, got {family!r}: "
            f"{type(error).__name__}: {one_line(str(error), 300)}"
        ) from None
    if not (inspect.isclass(kind) and issubclass(kind, FromWaypoints)) or inspect.isabstract(kind):
        what = kind.__name__ if inspect.isclass(kind) else type(kind).__name__
        raise StudyError(f"{path}: {place}: {family!r} must be a class derived from WaypointSpline, got {what}")
    return kind


def _made(kind: type[FromWaypoints], waypoints: tuple[Waypoint, ...], family: str, chosen: Data) -> Trajectory:
    """Plan of a family with its options; ValueError if a required option is missing."""
    parameters = inspect.signature(kind).parameters
    for name in kind.options:
        if name not in chosen and name in parameters and parameters[name].default is inspect.Parameter.empty:
            known = ", a number in [0, 2 pi)" if name == "alpha" else ""
            raise ValueError(f"a plan of the family {family} requires {name}{known}, got none")
    return kind.from_waypoints(waypoints, **chosen)


def _described(plan: Trajectory) -> str:
    alpha = getattr(plan, "alpha", None) if "alpha" in getattr(plan, "options", ()) else None
    shape = "" if alpha is None else f", alpha = {alpha:g} rad"
    return f"{type(plan).__name__}{shape}, {plan.start:g} to {plan.end:g} s"
