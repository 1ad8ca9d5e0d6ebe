"""Base class of the kinds of loops in study files."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar, TypeAlias

from ctrlplan._types import Data
from ctrlplan.flatness import FlatSystem
from ctrlplan.planning import Obstacle
from ctrlplan.studies.benefit import Choices
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.entries import Entries, Number
from ctrlplan.studies.reading import Reader
from ctrlplan.studies.running import Builder, System
from ctrlplan.studies.study import Study
from ctrlplan.systems.plants import Crane
from ctrlplan.trajectories import Waypoint

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

    def plant(self, table: Data, path: Path) -> Crane | FlatSystem | None:
        """Crane or flat system of the loop, whose quantities may be limited along a plan; None for other loops."""
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
        return of_parameters(names, lambda **values: self.build(table | values, path))

    def experiment(self, table: Data, waypoints: Sequence[Waypoint], stated: Data, path: Path) -> tuple[Data, Choices]:
        """Fields of the experiment, and options of the benefit of planning."""
        return stated, Choices()

    def parameters(self, table: Data) -> Data:
        """Parameters of the loop, for the report."""
        return dict(table)

    def study(self, name: str, title: str, comparison: Comparison, obstacles: Sequence[Obstacle] = ()) -> Study:
        """Study of the comparison, with the sections of this kind of loop and obstacles in its paths."""
        return Study(name, title, comparison, notes=comparison.notes, sections=comparison.sections(obstacles))


def of_parameters(names: Sequence[str], function: Callable[..., System | Builder]) -> Varied:
    """Function with arguments of some names, by which `monte_carlo` knows it."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    setattr(function, "__signature__", inspect.Signature([inspect.Parameter(name, keyword) for name in names]))  # noqa: B010
    return function
