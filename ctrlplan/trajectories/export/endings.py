"""Formats by the ending of a file's name."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from ctrlplan._files import write_all
from ctrlplan.trajectories.export.c import C99
from ctrlplan.trajectories.export.cam import CamCSV, CamST
from ctrlplan.trajectories.export.csv_table import CSV
from ctrlplan.trajectories.export.formats import Format, Options, SampledTable, TableFormat
from ctrlplan.trajectories.export.mat import MAT
from ctrlplan.trajectories.export.npz import NPZ
from ctrlplan.trajectories.export.ppoly import PPolyJSON
from ctrlplan.trajectories.export.ros import JointTrajectory
from ctrlplan.trajectories.trajectory import Trajectory

ENDINGS: dict[str, Format] = {
    ".csv": CSV(),
    ".mat": MAT(),
    ".npz": NPZ(),
    ".ppoly.json": PPolyJSON(),
    ".yaml": JointTrajectory(),
    ".cam.csv": CamCSV(),
    ".cam.st": CamST(),
    ".c": C99(),
}
"""Formats by the ending of the file's name; the longest match applies."""


def export_plan(plan: Trajectory, path: str | os.PathLike[str], options: Options) -> tuple[Path, ...]:
    """Write a plan in the format of the path's ending; as `Trajectory.export`."""
    place = Path(path)
    ending = ending_of(place, ENDINGS)
    check_options(options, ending)
    files = ENDINGS[ending].files(plan, place, options)
    write_all(dict(files.items()))
    return tuple(files)


def check_options(options: Options, ending: str) -> None:
    """Raise for options that a format does not have."""
    for name in options.given():
        if name not in ENDINGS[ending].accepted:
            accepting = ", ".join(e for e, f in ENDINGS.items() if name in f.accepted)
            raise ValueError(
                f"{name} must not be given for {ending} (only for {accepting}), got {getattr(options, name)}"
            )


def export_table(table: SampledTable, path: str | os.PathLike[str]) -> Path:
    """Write signals in the format of the path's ending, one of those for sampled signals."""
    place = Path(path)
    tables = {ending: format_ for ending, format_ in ENDINGS.items() if isinstance(format_, TableFormat)}
    write_all({place: tables[ending_of(place, tables)].encoded(table)})
    return place


def ending_of(path: Path, endings: Iterable[str], name: str = "path") -> str:
    """Longest of some endings that a path has; messages call it by a name.

    Raises
    ------
    ValueError
        If it has none of them.
    """
    fitting = [ending for ending in endings if path.name.lower().endswith(ending) and path.name.lower() != ending]
    if not fitting:
        raise ValueError(f"{name} must end in one of {', '.join(endings)}, got {path}")
    return max(fitting, key=len)
