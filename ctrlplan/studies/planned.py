"""Plans of study files: families, obstacles, limits and minimum durations."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

from ctrlplan._checks import default_labels
from ctrlplan._types import Data, System
from ctrlplan.flatness import FlatSystem
from ctrlplan.planning import (
    Clearance,
    Disc,
    Fastest,
    HalfPlane,
    Limits,
    Margins,
    Rectangle,
    avoid,
    clearance,
    fastest,
    margins,
)
from ctrlplan.planning.clearance import Rope
from ctrlplan.planning.fastest import Hold
from ctrlplan.planning.obstacles import Obstacle
from ctrlplan.studies.entries import (
    NUMBERS,
    PAIR,
    Anything,
    Entry,
    Flag,
    Listed,
    Number,
    OneOf,
    Table,
    Tables,
    Text,
    Variants,
    Whole,
)
from ctrlplan.studies.plans import standard_plans
from ctrlplan.studies.reading import Reader, StudyError, got, named_in_module, one_line, reference
from ctrlplan.systems.plants import Crane
from ctrlplan.trajectories import Shaper, Trajectory, Waypoint
from ctrlplan.trajectories.waypoint import ENTRIES
from ctrlplan.trajectories.waypoint_spline import FromWaypoints, families, family_name


@dataclass(frozen=True)
class Planned:
    """Plans of a study file, and what was found in planning.

    Attributes
    ----------
    plans : dict of str to Trajectory
        The plans by name.
    fastest : dict of str to Fastest
        Of plans with the entry ``fastest``.
    margins : dict of str to Margins
        Margins to the limits, of all plans with a duration.
    clearances : dict of str to Clearance
        Clearance from the obstacles, of all plans with a duration.
    obstacles : tuple of Obstacle
        The obstacles.
    limits : dict of str to object
        The limits, as for `margins`.
    local : dict of str to object
        Those that are not on signals of the loop.
    """

    plans: dict[str, Trajectory]
    fastest: dict[str, Fastest]
    margins: dict[str, Margins]
    clearances: dict[str, Clearance]
    obstacles: tuple[Obstacle, ...]
    limits: dict[str, object]
    local: dict[str, object]


def planned(
    data: Data,
    waypoints: tuple[Waypoint, ...],
    plant: Crane | FlatSystem | None,
    loop: Callable[[], System] | None,
    reader: Reader,
    status: Callable[[str], object],
) -> Planned:
    """Plans of a study file, whose tables have been read.

    Parameters
    ----------
    data : dict
        With the tables plans, limits, obstacles and avoid, if they are given.
    waypoints : tuple of Waypoint
        Waypoints of all plans.
    plant : Crane, FlatSystem or None
        Plant of the loop: its quantities may be limited, and the rope of a crane
        must have the clearance.
    loop : callable or None
        Returns the loop, where its signals may be limited.
    reader : Reader
        For messages.
    status : callable
        Called with a line before a plan that takes time to be found.

    Raises
    ------
    StudyError
        If a plan cannot be made, or violates what is required of it.
    """
    task = _Task(
        _limits(data.get("limits", {}), reader),
        _obstacles(data.get("obstacles", []), reader),
        data.get("avoid", {}),
        plant,
        loop,
        reader,
    )
    plans: dict[str, Trajectory] = {}
    found: dict[str, Fastest] = {}
    for i, table in enumerate(data.get("plans", [])):
        place = f"plans[{i}]"
        name, plan = _plan(table, waypoints, place, reader)
        if name in plans:
            raise reader.error(f"{place}.name", f"must be a unique name, got {got(name)}")
        if table.get("avoid"):
            status(f"planning {name} around the obstacles")
            plan = task.around(plan, place)
        if "fastest" in table:
            status(f"planning {name} in minimum time")
            found[name] = task.fastest(plan, table["fastest"], bool(table.get("avoid")), place)
            plan = found[name].plan
        plans[name] = _shaped(plan, table.get("shaper", []), f"{place}.shaper", reader)
    plans = plans or standard_plans(waypoints)
    moving = {name: plan for name, plan in plans.items() if plan.duration}
    return Planned(
        plans,
        found,
        task.margins(moving, found),
        task.clearances(moving),
        task.obstacles,
        task.limits,
        task.local(waypoints),
    )


# Families


def _tables() -> dict[str, Table]:
    """Entries of a plan by family."""
    return {name: Table(_COMMON) if kind is None else _table(kind) for name, kind in _kinds().items()}


def _kinds() -> dict[str, type[FromWaypoints] | None]:
    """Class of each family; None for a step, which has the goal alone."""
    return {**dict(sorted(families().items())), "step": None}


def _table(kind: type[FromWaypoints]) -> Table:
    """Entries of a plan of one family."""
    entries = {name: _option(kind, name) for name in kind.options}
    return Table(_COMMON | entries, shipped=is_shipped(kind))


def is_shipped(kind: type) -> bool:
    """Whether a class is one of this package: a name of its module, and not of an example in a docstring."""
    module = kind.__module__
    return module.startswith("ctrlplan.") and getattr(sys.modules.get(module), kind.__name__, None) is kind


def _option(kind: type[FromWaypoints], name: str) -> Entry:
    """Entry of an option: a number or a list, and the strings that the annotation of the argument has."""
    required, annotation = _argument(kind.__init__, name)
    strings = _strings(annotation)
    text = (Text(strings),) if strings else () if annotation is not None else (Text(),)
    what = f"option {name} of ctrlplan.{kind.__name__}; a list has one number per axis"
    return Entry(OneOf((Number(), NUMBERS, *text)), what, required)


@lru_cache(maxsize=256)
def _argument(constructor: Callable[..., None], name: str) -> tuple[bool, object]:
    """Whether an argument is required, and its annotation; None if there is none."""
    argument = inspect.signature(constructor).parameters.get(name)
    required = argument is not None and argument.default is inspect.Parameter.empty
    try:
        return required, get_type_hints(constructor).get(name)
    except (NameError, TypeError):  # names of a user's own class that cannot be resolved
        return required, None


def _strings(annotation: object) -> tuple[str, ...]:
    """Strings of an annotation such as ``float | Literal["auto"]``."""
    inner = get_args(annotation)
    if str(get_origin(annotation)) == str(Literal):
        return tuple(value for value in inner if isinstance(value, str))
    return tuple(string for value in inner for string in _strings(value))


_SHAPERS: dict[str, Callable[..., Shaper]] = {
    "zv": Shaper.zv,
    "zvd": Shaper.zvd,
    "mzv": Shaper.mzv,
    "ei": Shaper.ei,
    "two_hump_ei": Shaper.two_hump_ei,
    "three_hump_ei": Shaper.three_hump_ei,
}
SHAPERS = Tables(
    Table(
        {
            "kind": Entry(Text(tuple(_SHAPERS)), "kind of the input shaper", required=True),
            "frequency": Entry(Number(above=0.0), "undamped natural frequency of the mode [rad/s]", required=True),
            "damping": Entry(Number(minimum=0.0, below=1.0), "damping ratio of the mode; default: 0"),
            "tolerance": Entry(
                Number(above=0.0, below=1.0), "residual vibration tolerated by the ei kinds; default: 0.05"
            ),
        }
    )
)
"""Tables [[plans.shaper]], one for each mode."""

_COMMON: dict[str, Entry] = {
    "name": Entry(Text(), "name of the plan in tables and figures; default: the family"),
    "avoid": Entry(Flag(), "lead the plan around the obstacles", default=False),
    "fastest": Entry(
        Text(get_args(Hold)),
        "minimum duration under [limits], at fixed shape, fixed derivatives at the waypoints, or fixed path",
    ),
    "shaper": Entry(SHAPERS, "input shapers of the finished plan, one for each mode"),
}

PLANS = Tables(
    Variants(
        "family",
        _tables,
        'family of the plan, or "python:module:Class", a class derived from ctrlplan.WaypointSpline',
        "Class",
        Table(_COMMON, Anything()),
        otherwise="name",
    )
)
"""Tables [[plans]]."""


def _plan(table: Data, waypoints: tuple[Waypoint, ...], place: str, reader: Reader) -> tuple[str, Trajectory]:
    """Name and plan of one table."""
    family = table["family"]
    kind: type[FromWaypoints] | None = None
    if reference(family) is not None:
        kind = _kind_of_module(family, reader.path, f"{place}.family")
        own = _table(kind)
        entries = {"family": Entry(Text(), ""), **own.entries}
        table = Table(entries).read(table, place, reader)
    else:
        kind = _kinds()[family]
    name = table.get("name", family if kind is None else family_name(kind))
    if not name:
        raise reader.error(f"{place}.name", f"must be a unique name, got {got(name)}")
    try:
        if kind is None:
            return name, standard_plans(waypoints)["step"]
        return name, kind.from_waypoints(waypoints, **{key: table[key] for key in kind.options if key in table})
    except (ValueError, TypeError) as error:
        raise reader.error(place, error) from None
    except Exception as error:  # of a user's own class
        raise reader.error(place, f"construction must not fail, got {type(error).__name__}: {error}") from error


_TOLERANT = ("ei", "two_hump_ei", "three_hump_ei")
"""Kinds of shapers that leave a residual of a given tolerance."""


def _shaped(plan: Trajectory, tables: Sequence[Data], place: str, reader: Reader) -> Trajectory:
    """Plan after its input shapers."""
    for i, table in enumerate(tables):
        kind, options = table["kind"], {name: value for name, value in table.items() if name != "kind"}
        if "tolerance" in options and kind not in _TOLERANT:
            raise reader.error(f"{place}[{i}].tolerance", f"must be given for an ei kind, got {got(kind)}")
        try:
            plan = _SHAPERS[kind](**options)(plan)
        except ValueError as error:
            raise reader.error(f"{place}[{i}]", error) from None
    return plan


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


# Limits and obstacles


_SIDES = Table(
    {
        "low": Entry(Number(), "minimum; without it there is none"),
        "high": Entry(Number(), "maximum; without it there is none"),
        "rate": Entry(Number(above=0.0), "maximum rate of change"),
        "rms": Entry(Number(above=0.0), "maximum root mean square over the plan, or over period"),
        "period": Entry(Number(above=0.0), "time from the start of the plan over which rms is taken [s]"),
        "during": Entry(Listed(Number(), "two numbers", 2), "begin and end of the interval of the limits [s]"),
    }
)
LIMITS = Table({}, OneOf((Number(above=0.0), Listed(Number(), "a list of finite numbers"), _SIDES)))
"""Table [limits]."""

_SHAPES: dict[str, type[Rectangle] | type[Disc] | type[HalfPlane]] = {
    "rectangle": Rectangle,
    "disc": Disc,
    "half_plane": HalfPlane,
}
_SIDE = Listed(Number(finite=False), "two numbers", 2)
_OBSTACLE_ENTRIES = {
    "rectangle": {
        "x": Entry(_SIDE, "minimum and maximum on the first axis; one may be infinite", required=True),
        "z": Entry(_SIDE, "minimum and maximum on the second axis; one may be infinite", required=True),
    },
    "disc": {
        "centre": Entry(PAIR, "position of the centre", required=True),
        "radius": Entry(Number(above=0.0), "radius", required=True),
    },
    "half_plane": {
        "normal": Entry(PAIR, "vector into the half-plane", required=True),
        "offset": Entry(Number(), "the half-plane has normal . p of at least this", required=True),
    },
}
OBSTACLES = Tables(
    Variants("shape", lambda: {name: Table(own) for name, own in _OBSTACLE_ENTRIES.items()}, "shape of the obstacle")
)
"""Tables [[obstacles]]."""

AVOID = Table(
    {
        "clearance": Entry(Number(minimum=0.0), "required clearance from the obstacles", default=0.0),
        "load": Entry(Number(minimum=0.0), "radius of the load", default=0.0),
        "rope": Entry(Flag(), "whether the rope of a crane must have the clearance as well", default=False),
        "max_points": Entry(
            Whole(1), "maximum number of inserted via points; default: corners of the shortest path plus 1, at least 4"
        ),
    }
)
"""Table [avoid]."""


def _limits(table: Data, reader: Reader) -> dict[str, object]:
    """Limits as `margins` has them: of a derivative of all axes, a list has one number per axis."""
    found: dict[str, object] = {}
    for name, value in table.items():
        if isinstance(value, dict):
            try:
                found[name] = Limits(**value)
            except ValueError as error:
                raise reader.error(f"limits.{name}", error) from None
        else:
            found[name] = tuple(value) if isinstance(value, list) and name not in ENTRIES else value
    return found


def _of_plan(name: str, labels: Sequence[str]) -> bool:
    """Whether a name is one of the derivatives of all axes or of one axis."""
    return name in ENTRIES or any(re.fullmatch(rf"{re.escape(label)}_d\d+", name) for label in labels)


def _obstacles(tables: Sequence[Data], reader: Reader) -> tuple[Obstacle, ...]:
    found: list[Obstacle] = []
    for i, table in enumerate(tables):
        kind = _SHAPES[table["shape"]]
        try:
            found.append(kind(*(table[field.name] for field in fields(kind))))
        except (ValueError, TypeError) as error:
            raise reader.error(f"obstacles[{i}]", error) from None
    return tuple(found)


@dataclass(frozen=True)
class _Task:
    """What is required of the plans."""

    limits: dict[str, object]
    obstacles: tuple[Obstacle, ...]
    avoid: Data
    plant: Crane | FlatSystem | None
    loop: Callable[[], System] | None
    reader: Reader

    def around(self, plan: Trajectory, place: str) -> Trajectory:
        """Plan around the obstacles."""
        if not self.obstacles:
            raise self.reader.error(f"{place}.avoid", "must be given with tables [[obstacles]], got none")
        load, rope, most = self._load, self._rope, self.avoid.get("max_points")
        required = self.avoid.get("clearance", 0.0)
        try:
            return avoid(plan, self.obstacles, clearance=required, load=load, rope=rope, max_points=most).plan
        except (ValueError, TypeError, RuntimeError) as error:
            raise self.reader.error(f"{place}.avoid", error) from None

    def fastest(self, plan: Trajectory, hold: Hold, avoids: bool, place: str) -> Fastest:
        """Plan of minimum duration under the limits."""
        if not self.limits:
            raise self.reader.error(f"{place}.fastest", "must be given with a table [limits], got none")
        if avoids and hold == "waypoints":
            raise self.reader.error(
                f"{place}.fastest",
                'must be "shape" or "path" with avoid, which fixes the path, got "waypoints"',
            )
        try:
            return fastest(plan, self.limits, self._limited(plan.labels), hold=hold)
        except (ValueError, TypeError, RuntimeError) as error:
            raise self.reader.error(f"{place}.fastest", error) from None

    def margins(self, plans: Mapping[str, Trajectory], known: Mapping[str, Fastest]) -> dict[str, Margins]:
        """Margins of all plans to the limits."""
        found = {}
        for name, plan in plans.items() if self.limits else ():
            try:
                own = known.get(name)
                if own is not None and own.plan is plan:  # a shaped plan has margins of its own
                    found[name] = own.margins
                else:
                    found[name] = margins(plan, self.limits, self._limited(plan.labels))
            except (ValueError, TypeError, RuntimeError) as error:
                raise self.reader.error("limits", f"{error} (plan {name})") from None
        return found

    def clearances(self, plans: Mapping[str, Trajectory]) -> dict[str, Clearance]:
        """Clearances of all plans from the obstacles."""
        found = {}
        for name, plan in plans.items() if self.obstacles else ():
            try:
                found[name] = clearance(plan, self.obstacles, load=self._load, rope=self._rope)
            except (ValueError, TypeError, RuntimeError) as error:
                raise self.reader.error("obstacles", f"{error} (plan {name})") from None
        return found

    def local(self, waypoints: Sequence[Waypoint]) -> dict[str, object]:
        """Limits that are not on signals of the loop."""
        labels = waypoints[0].labels or default_labels(waypoints[0].naxes)
        if self.plant is not None or self.loop is None:
            return self.limits
        return {name: limit for name, limit in self.limits.items() if _of_plan(name, labels)}

    def _limited(self, labels: Sequence[str]) -> Crane | FlatSystem | System | None:
        """What has the limited signals: the plant or, if a name is not one of the plan, the loop."""
        if self.plant is not None or self.loop is None:
            return self.plant
        return None if all(_of_plan(name, labels) for name in self.limits) else self.loop()

    @property
    def _load(self) -> float:
        return float(self.avoid.get("load", 0.0))

    @property
    def _rope(self) -> Rope | None:
        if not self.avoid.get("rope"):
            return None
        if not isinstance(self.plant, Crane):
            raise self.reader.error("avoid.rope", "must be given for the loop of a crane only, got true")
        return self.plant.rope()
