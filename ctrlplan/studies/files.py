"""A user's study, described by a TOML file.

``ctrlplan report STUDY.toml --out DIR`` runs a study and writes ``index.html``,
which can be read off line, and ``results.json``; ``ctrlplan plan STUDY.toml --out
plan.csv`` writes only the trajectories, as ``.json`` or in a format of
`ctrlplan.Trajectory.export`. A complete file:

.. code-block:: toml

    title = "Over the wall"
    author = "A. Engineer"    # optional
    text = "For the crane of hall 3."   # optional; a list has a paragraph each
    t_end = 30.0              # after the last waypoint, or at it if the plans end in motion
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
- ``"dc-motor"``, ``"flexible-joint"``, ``"kinematic-car"``,
  ``"magnetic-levitation"``, ``"planar-quadrotor"``, ``"two-mass-drive"``: plants of
  `ctrlplan.plants` with a flat law, as of `ctrlplan.flat_loop`. The axes are the
  flat outputs; any parameter of the plant is an entry. ``poles = [[-2.0, -3.0],
  [-2.0, -3.0]]``, a list for each flat output; optional: ``law`` ("flat",
  "quasi_static", "feedforward"), ``integral``, ``input_limits = {voltage = [-24.0,
  24.0]}``. A step is a set point of the law, approached from the first position.
- ``"python:module:function"``: a function annotated to return a loop, ``def
  build() -> control.InputOutputSystem``, or a `ctrlplan.FlatSystem`, with the
  entries of the law as above. Running such a study file executes the module;
  ``ctrlplan plan`` does so only for limits on its signals.

Families of plans: trigonometric, polynomial, piecewise, step, s_curve,
trapezoid, or ``"python:module:Class"``, a class derived from
`ctrlplan.WaypointSpline`. Options of a family have the names of its arguments.

Further entries and tables, each optional:

.. code-block:: toml

    waypoints = "path.csv"    # or {csv = "path.csv", speed = 0.5}, in place of tables
    [limits]                  # as for ctrlplan.margins
    velocity = 2.0            # of every axis; [2.0, 0.5] by axis
    x_d2 = [-1.0, 0.5]        # of one signal: minimum and maximum
    F = {high = 8e3}          # of a quantity of the crane, or of a signal of another loop
    u = {high = 24.0, rate = 500.0}   # also rms, period (of rms) and during = [begin, end]
    [[plans]]
    family = "polynomial"
    fastest = "shape"         # minimum duration under the limits; or "waypoints", "path"
    avoid = true              # around the obstacles; plans of two axes
    [[plans.shaper]]          # input shaper of the finished plan, one table for each mode
    kind = "zvd"              # zv, zvd, mzv, ei, two_hump_ei, three_hump_ei
    frequency = 6.0           # [rad/s]
    damping = 0.05            # and tolerance = 0.05 of the ei kinds
    [[obstacles]]             # shapes: disc, rectangle (x, z), half_plane (normal, offset)
    shape = "disc"
    centre = [10.0, 5.0]
    radius = 1.0
    [avoid]
    clearance = 0.3
    load = 0.5                # radius of the load
    rope = true               # of a crane
    [sweep]                   # comparison over values of a number of [loop]
    parameter = "gain"
    values = [1.0, 5.0, 25.0] # or {low = 1.0, high = 100.0, count = 21, scale = "log"}
    [draws]                   # comparison over random numbers of [loop]
    count = 100
    parameters = {gain = [2.0, 8.0]}
    [measured]                # logs of the machine by plan, as ctrlplan.read_log has them
    trigonometric = "log.csv" # or a table:
    [measured.step]
    log = "step.csv"
    time = "t_ms"
    signals = {y = "pos_act", u = "torque"}
    units = {time = 1e-3}
    align = "auto"            # or a signal, seconds, false
    fit = true                # feedforward from the log, or {terms = ["static", "velocity"], from = "plan"}

A sweep varies the plant and its law together. Draws of a crane vary the plant
alone, whose law has the numbers of [loop]; so do those of other plants. With a function of a module the
parameter is an argument of the function, or, in draws, a parameter of a block.

Editors complete and check study files by the JSON Schema
``ctrlplan/studies/study.schema.json``.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctrlplan._display import time_text
from ctrlplan._renamed import warn_renamed
from ctrlplan._types import Data
from ctrlplan.planning.bounds import limit_words
from ctrlplan.simulation import Event
from ctrlplan.studies.benefit import benefit_of
from ctrlplan.studies.comparison import comparison_of
from ctrlplan.studies.entries import (
    NUMBERS,
    TEXTS,
    Anything,
    Entry,
    Flag,
    Listed,
    Number,
    OneOf,
    Table,
    Tables,
    Text,
    Whole,
)
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.flat_loops import FlatLoops
from ctrlplan.studies.logged import MEASURED, check_measured, compared_with, fitted, read_logs
from ctrlplan.studies.loops import LOOP, build_loop, loop_kind
from ctrlplan.studies.planned import AVOID, LIMITS, OBSTACLES, PLANS, Planned, planned
from ctrlplan.studies.reading import Reader, StudyError
from ctrlplan.studies.running import Builder, System
from ctrlplan.studies.sections import Bands, DrawTable, FastestMove, PlanMargins, Section, SweepCurves
from ctrlplan.studies.study import Study
from ctrlplan.studies.variations import DRAWS, SWEEP, check_variations, drawn, shown_metrics, swept
from ctrlplan.trajectories import PolySpline, Trajectory, TrigSpline, Waypoint, waypoints_from_csv

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
    planned : Planned
        What was found in planning: minimum durations, margins, clearances.
    units : dict of str to str
        Units by label.
    benefit : bool
        Whether the report contains the benefit of planning.
    experiment : dict
        The table [experiment]: further fields of `Experiment` by name.
    sweep, draws : dict or None
        The tables [sweep] and [draws].
    measured : dict
        The table [measured]: logs by plan.
    author : str
        Author of the report.
    text : tuple of str
        Free text of the report, a paragraph each.
    """

    path: Path
    name: str
    title: str
    t_end: float
    samples: int
    waypoints: tuple[Waypoint, ...]
    plans: dict[str, Trajectory]
    loop: Data
    planned: Planned
    units: dict[str, str] = field(default_factory=dict)
    benefit: bool = False
    experiment: Data = field(default_factory=dict)
    sweep: Data | None = None
    draws: Data | None = None
    measured: Data = field(default_factory=dict)
    author: str = ""
    text: tuple[str, ...] = ()

    def run(self, *, progress: bool = False, status: Callable[[str], object] = lambda text: None) -> Study:
        """Simulate and measure.

        Parameters
        ----------
        progress : bool, optional
            Show bars on stderr.
        status : callable, optional
            Called with a line at the start of each part.

        Raises
        ------
        StudyError
            If the loop does not fit the plans.
        """
        kind, reader = loop_kind(self.loop), Reader(self.path)
        logs = read_logs(self.measured, reader)
        loop = kind.build(self.loop, self.path)
        fields_of, choices = kind.experiment(self.loop, self.waypoints, self.experiment, self.path)
        units = self.units
        if isinstance(loop, FlatLoops):
            fields_of, choices = loop.experiment(fields_of, choices)
            units = loop.units | units
        found_sections: list[Section] = [
            FastestMove(found, caption=f"Plan {name}: limited signals, limits (dashed), and the active point (marker).")
            for name, found in self.planned.fastest.items()
        ]
        try:
            if isinstance(loop, FlatLoops):
                for name, plan in self.plans.items():
                    loop.check_end(plan, name, self.t_end)
                    if self.benefit:
                        loop.check_benefit(plan)
            experiment = Experiment(self.plans, self.timepts(loop), waypoints=self.waypoints, **fields_of)
            with np.errstate(over="ignore", invalid="ignore"):  # a diverging run is reported by the simulation
                found = experiment.run(loop)
                comparison = comparison_of(experiment, found, units, self.parameters(), self.title)
                if self.sweep is not None:
                    shown = shown_metrics(self.sweep, comparison.metrics, reader)
                    status(f"running the sweep over {self.sweep['parameter']}")
                    swept_plans = swept(self.sweep, kind, self.loop, self.path, experiment, progress)
                    found_sections.append(SweepCurves(swept_plans, shown))
                if self.draws is not None:
                    status(f"running {self.draws['count']} draws of {', '.join(self.draws['parameters'])}")
                    ensemble = drawn(self.draws, kind, self.loop, self.path, experiment, progress)
                    found_sections += [Bands(ensemble), DrawTable(ensemble)]
                if self.benefit:
                    status("running the baselines")
                    alphas = (plan.alpha for plan in comparison.plans.values() if isinstance(plan, TrigSpline))
                    choices = replace(choices, alpha=next(alphas, 1.0), limits=self.planned.local or choices.limits)
                    benefit = benefit_of(experiment, loop, choices, units=units)
                    comparison = comparison.with_benefit(benefit)
                comparison = compared_with(comparison, logs, reader)
                gains = fitted(comparison, logs, reader)
                found_sections += [gains] if gains is not None else []
        except StudyError:
            raise
        except (ValueError, TypeError, RuntimeError) as error:
            raise StudyError(f"{self.path}: loop: {error}") from error
        except Exception as error:  # of a user's own loop
            raise StudyError(
                f"{self.path}: loop: simulation must not fail, got {type(error).__name__}: {error}"
            ) from error
        study = kind.study(self.name, self.title, comparison, self.planned.obstacles)
        if self.planned.margins:
            found_sections.append(PlanMargins(self.planned.margins))
        sections = (*found_sections, *study.sections)
        return replace(study, notes=(*study.notes, *_planning_notes(self.planned)), sections=sections, text=self.text)

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
        stated = loop_kind(self.loop).parameters(self.loop)
        loop = {f"loop {key}": value for key, value in stated.items()}
        plans: dict[str, object] = {f"plan {name}": _described(plan) for name, plan in self.plans.items()}
        points: dict[str, object] = {f"waypoint {i}": repr(w) for i, w in enumerate(self.waypoints)}
        run = f"{self.waypoints[0].time:g} to {self.t_end:g} s, {self.samples} samples"
        limits: dict[str, object] = {
            f"limit of {name}": limit_words(limit) for name, limit in self.planned.limits.items()
        }
        return loop | plans | points | limits | {"simulated time": run}


_NUMBER_OR_FREE = Number(finite=False)
_WAYPOINTS = OneOf(
    (
        Tables(
            Table(
                {"time": Entry(Number(), "time [s]", required=True)},
                Listed(_NUMBER_OR_FREE, "a list of numbers"),
            ),
            minimum=2,
        ),
        Text(),
        Table(
            {
                "csv": Entry(Text(), "path of a CSV file, relative to the study file", required=True),
                "time": Entry(OneOf((Text(), Whole(0))), "column of the times, by name or number"),
                "columns": Entry(
                    Listed(OneOf((Text(), Whole(0))), "a list of names or numbers"), "columns that are read"
                ),
                "speed": Entry(Number(above=0.0), "speed along the path [unit/s], for files without times"),
            }
        ),
    )
)
_LIMIT = Number(finite=False)
_EXPERIMENT = Table(
    {
        "start": Entry(Number(), "time from which metrics count [s]"),
        "band": Entry(Number(above=0.0), "half width of the settling band, relative to the range of the plan"),
        "outputs": Entry(TEXTS, "outputs of the loop that follow the plan"),
        "controls": Entry(TEXTS, "outputs of the loop that are controls"),
        "initial_state": Entry(OneOf((Number(), NUMBERS)), "state at the first sample time"),
        "params": Entry(Table({}, Anything()), "parameters of the blocks"),
        "events": Entry(
            Tables(
                Table(
                    {
                        "signal": Entry(Text(), "label of a signal", required=True),
                        "low": Entry(_LIMIT, "minimum"),
                        "high": Entry(_LIMIT, "maximum"),
                        "stop": Entry(Flag(), "end the run where the signal leaves its limits"),
                        "name": Entry(Text(), "name of the event"),
                    }
                )
            ),
            "limits whose crossings are recorded",
        ),
        "measures": Entry(TEXTS, "metrics, by name"),
    }
)
STUDY = Table(
    {
        "waypoints": Entry(
            _WAYPOINTS,
            "waypoints of the plans: time and, by axis, position, velocity, acceleration, ..., nan where free; or a "
            "CSV file",
            required=True,
        ),
        "title": Entry(Text(), "heading of the page"),
        "author": Entry(Text(), "author of the report"),
        "text": Entry(OneOf((Text(), TEXTS)), "free text at the head of the report, a list has a paragraph each"),
        "t_end": Entry(Number(), "end of the simulation [s], after the last waypoint", required=True),
        "samples": Entry(Whole(2), "number of sample times", default=4001),
        "benefit": Entry(Flag(), "compare with steps, profiles and minimum jerk", default=False),
        "worth": Entry(Flag(), "deprecated name of benefit"),
        "loop": Entry(LOOP, "closed loop", required=True),
        "units": Entry(Table({}, Text()), "units of axes and signals"),
        "plans": Entry(PLANS, "plans that are compared; default: step, polynomial, trigonometric, piecewise"),
        "limits": Entry(
            LIMITS,
            "limits of velocity, acceleration, jerk, snap, of a derivative of one axis (x_d1), or of a quantity of "
            "the plant: a number, by axis [1.0, 2.0], [minimum, maximum] of one signal, or {low = ..., high = ...}",
        ),
        "obstacles": Entry(OBSTACLES, "obstacles in the plane of the plans, for plans of two axes"),
        "avoid": Entry(AVOID, "how plans with avoid = true go around the obstacles"),
        "experiment": Entry(_EXPERIMENT, "further fields of ctrlplan.Experiment"),
        "sweep": Entry(SWEEP, "comparison over values of a parameter"),
        "draws": Entry(DRAWS, "comparison over random parameters"),
        "measured": Entry(MEASURED, "logs of the machine by plan: a path, or a table with the columns"),
    }
)
"""Entries of a study file: names, types, ranges and meaning."""


def load_study(path: str | os.PathLike[str], *, status: Callable[[str], object] = lambda text: None) -> StudyFile:
    """Read and check a study file; nothing is simulated.

    Parameters
    ----------
    path : str or path
        A TOML file; its entries are listed in the docstring of this module.
    status : callable, optional
        Called with a line before a plan that takes time to be found.

    Returns
    -------
    StudyFile

    Raises
    ------
    StudyError
        With a message of one line: the condition, the value given, and the place in the file.
    """
    source = Path(path)
    reader = _FileReader(source)
    data: Data = STUDY.read(_parsed(source), "", reader)
    loop = data["loop"]
    kind = loop_kind(loop)
    waypoints = reader.waypoints(data["waypoints"], kind.axes)
    t_end = data["t_end"]
    moving = _ends_in_motion(waypoints)
    if t_end < waypoints[-1].time or (t_end == waypoints[-1].time and not moving):
        raise reader.error(
            "t_end", f"must be after the last waypoint at {time_text(waypoints[-1].time)} s, got {time_text(t_end)}"
        )
    kind.check(loop, source)
    check_variations(data, kind, reader)
    benefit = reader.benefit(data)
    if kind.signals is not None:
        reader.check_units(data.get("units", {}), [*(waypoints[0].labels or ()), *kind.signals])
    found = planned(data, waypoints, kind.plant(loop, source), kind.limited(loop, source), reader, status)
    for name, plan in found.plans.items():
        if plan.end > t_end or (plan.end == t_end and not moving):
            raise reader.error(
                "t_end", f"must be after the end of the plan {name} at {time_text(plan.end)} s, got {time_text(t_end)}"
            )
    check_measured(data.get("measured", {}), found.plans, reader)
    _check_memory(data["samples"], len(found.plans), benefit, f"{source}: samples")
    experiment = reader.experiment(data.get("experiment", {}), found.plans, (waypoints[0].time, t_end))
    return StudyFile(
        path=source,
        name=source.stem,
        title=data.get("title", source.stem),
        t_end=t_end,
        samples=data["samples"],
        waypoints=waypoints,
        plans=found.plans,
        loop=loop,
        planned=found,
        units=data.get("units", {}),
        benefit=benefit,
        experiment=experiment,
        sweep=data.get("sweep"),
        draws=data.get("draws"),
        measured=data.get("measured", {}),
        author=data.get("author", ""),
        text=(text,) if isinstance(text := data.get("text", []), str) else tuple(text),
    )


def _ends_in_motion(waypoints: Sequence[Waypoint]) -> bool:
    """Whether the last waypoint prescribes a velocity: a run then may end there."""
    velocity = waypoints[-1].velocity
    return velocity is not None and bool(np.any(np.nan_to_num(velocity) != 0.0))


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
    """Reader of what the tables of a study file describe, once their structure has been checked."""

    def waypoints(self, stated: list[Data] | str | Data, first: Sequence[str]) -> tuple[Waypoint, ...]:
        """Waypoints of the entry `waypoints`, with the axes `first` before all others."""
        if not isinstance(stated, list):
            return self.waypoints_of_csv(stated, first)
        points = []
        for i, table in enumerate(stated):
            labels = [label for label in first if label in table]
            labels += [label for label in table if label not in ("time", *first)]
            try:
                points.append(Waypoint.from_jets(table["time"], **{label: table[label] for label in labels}))
            except ValueError as error:
                raise self.error(f"waypoints[{i}]", error) from None
        try:
            return PolySpline(points, warn=False).waypoints
        except ValueError as error:
            raise self.error("waypoints", error) from None

    def waypoints_of_csv(self, stated: str | Data, first: Sequence[str]) -> tuple[Waypoint, ...]:
        """Waypoints of a CSV file, named by its path or by a table with the arguments of `waypoints_from_csv`."""
        table: Data = {"csv": stated} if isinstance(stated, str) else stated
        options = dict(table)
        source = self.path.parent / options.pop("csv")
        try:
            points = waypoints_from_csv(source, **options)
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

    def check_units(self, units: Data, known: Sequence[str]) -> None:
        """Raise if a unit is that of an unknown axis or signal."""
        for label in units:
            if label not in known:
                raise self.error(f"units.{label}", f"must be of one of {', '.join(known)}, got {label!r}")

    def benefit(self, data: Data) -> bool:
        """Whether the report contains the benefit of planning; "worth" is the former name of the entry."""
        if "worth" not in data:
            return bool(data["benefit"])
        if data["benefit"]:
            raise self.error("worth", "must not be given together with benefit, got both")
        warn_renamed(f"{self.path}: worth =", "benefit =")
        return bool(data["worth"])

    def experiment(self, stated: Data, plans: dict[str, Trajectory], span: tuple[float, float]) -> Data:
        """The table [experiment], checked as `Experiment` does."""
        found = dict(stated)
        try:
            if "events" in found:
                found["events"] = [Event(**table) for table in found["events"]]
            Experiment(plans, np.linspace(*span, 1001), **found)
        except (ValueError, TypeError) as error:
            raise self.error("experiment", error) from None
        return found


def _planning_notes(found: Planned) -> Iterator[str]:
    """Limits and clearances of the plans, in sentences."""
    for name, one in found.margins.items():
        verdict = "satisfies all limits" if one.satisfied else "violates a limit"
        yield f"Plan {name} {verdict}. The smallest margin: {one.active}."
    for name, clear in found.clearances.items():
        place = f"obstacles[{clear.obstacle}] at {clear.time:.4g} s"
        yield f"The clearance of plan {name} is {clear.minimum:.4g}, of its {clear.part} from {place}."


def _described(plan: Trajectory) -> str:
    alpha = getattr(plan, "alpha", None) if "alpha" in getattr(plan, "options", ()) else None
    shape = "" if alpha is None else f", alpha = {alpha:g} rad"
    return f"{type(plan).__name__}{shape}, {time_text(plan.start)} to {time_text(plan.end)} s"
