"""Waypoints from tables of text."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence

import numpy as np

from ctrlplan._checks import checked_finite
from ctrlplan._types import Array
from ctrlplan.trajectories.columns import Column, CsvColumns
from ctrlplan.trajectories.waypoint import Waypoint

_TIME = "t"
"""Column of the times that a file need not have."""


def waypoints_from_csv(
    path: str | os.PathLike[str],
    *,
    time: Column | None = _TIME,
    columns: Sequence[Column] | None = None,
    speed: float | None = None,
) -> list[Waypoint]:
    r"""Waypoints from a CSV file.

    Cells are separated by semicolons if the first line contains one, and decimal
    commas are then allowed; otherwise by commas. Text after # is a comment. The
    first line may be a header. Columns named x, x_d1, x_d2, ... are the position
    and the derivatives of axis x, as `Trajectory.export` writes them.

    Parameters
    ----------
    path : str or path
        File to be read, UTF-8.
    time : str, int or None, optional
        Column of the times [s]; without a header the first column, unless a
        number is given. None if the file has no times.
    columns : sequence of str or int, optional
        Columns to be read; default: all others.
    speed : float, optional
        Speed along the chords between waypoints [unit of the axes per s], for
        files without times. Default: 1, so that times are chord lengths.

    Returns
    -------
    list of Waypoint

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        With the number of the line, if a cell is empty, not a number or not
        finite, a line has too few or too many cells, or times do not increase;
        if a column is unknown, or `speed` is given for a file with times.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "path.csv")
    ...     size = path.write_text("x; z  # of the load [m]\n0; 10\n3; 6\n3; 10,5\n")
    ...     points = waypoints_from_csv(path, speed=2.0)
    >>> points[2]
    Waypoint.from_jets(4.75, x=[3.0], z=[10.5])
    """
    rate = None if speed is None else checked_finite(speed, "speed", above=0.0)
    if isinstance(time, bool) or not isinstance(time, Column | None):
        raise TypeError(f"time must be the name or the number of a column, or None, got {time!r:.80}")
    if columns is not None and not isinstance(columns, Sequence):
        raise TypeError(f"columns must be names or numbers of columns, got {columns!r:.80}")
    table = CsvColumns(path)
    values = table.numbers(range(table.width))
    when = _time_column(table, time, rate is not None)
    if when is not None and rate is not None:
        raise ValueError(
            f"speed must not be given for a file with times, got {rate:g} and the column {table.name(when)}; "
            f"pass time=None and the columns of the axes"
        )
    if columns is None:
        chosen = list(range(table.width))
    else:
        chosen = [table.column(column) for column in ([columns] if isinstance(columns, str) else columns)]
        if len(set(chosen)) < len(chosen):
            raise ValueError(f"columns must differ from each other, got {', '.join(map(table.name, chosen))}")
    used = [column for column in chosen if column != when]
    if not used:
        raise ValueError(f"{path} must have a column of positions, got one of times only; pass time=None if it is none")
    times = table.increasing(when).tolist() if when is not None else _travelled(table, values, used, rate or 1.0)
    if table.header is None:
        return [Waypoint(t, row) for t, row in zip(times, values[:, used].tolist(), strict=True)]
    jets = _jets([table.header[column] for column in used], used)
    return [
        Waypoint.from_jets(t, **{label: row[jet].tolist() for label, jet in jets.items()})
        for t, row in zip(times, values, strict=True)
    ]


def _time_column(table: CsvColumns, time: Column | None, timed: bool) -> int | None:
    """Column of the times, None if there is none; `timed` if a speed is given."""
    if time is None or isinstance(time, int):
        return None if time is None else table.column(time)
    if table.header is None:
        return None if timed else 0
    if time in table.header:
        return table.header.index(time)
    similar = [name for name in table.header if re.fullmatch(r"t(ime)?(\W.*|_s)?", name, re.IGNORECASE)]
    if time != _TIME or similar:
        found = f", got {', '.join(table.header)}"
        hint = f"; pass time={similar[0]!r}" if similar else "; pass time=None where there is none"
        raise ValueError(f"{table.title} must have the column {time!r} of times{found}{hint}")
    return None


def _travelled(table: CsvColumns, values: Array, columns: list[int], speed: float) -> list[float]:
    """Times of the lines at a speed along the chords of the positions."""
    positions = columns
    if table.header is not None:
        positions = [jet[0] for jet in _jets([table.header[column] for column in columns], columns).values()]
    steps = np.sqrt((np.diff(values[:, positions], axis=0) ** 2).sum(axis=1)) / speed
    for k, step in enumerate(steps.tolist(), 1):
        if not 0.0 < step < math.inf:
            raise ValueError(
                f"{table.title}, {table.spot(k)}: positions must differ from those of the line before, from which the "
                f"time is computed, got those of {table.spot(k - 1)}; add a column of times"
            )
    return [0.0, *np.cumsum(steps).tolist()]


def _jets(names: list[str], columns: list[int]) -> dict[str, list[int]]:
    """Columns of each axis: its position, then its derivatives."""
    where = dict(zip(names, columns, strict=True))
    jets: dict[str, list[int]] = {}
    for name, column in where.items():
        label, _, order = name.rpartition("_d")
        if not (order.isdecimal() and label in where):
            jets[name] = [column]
            k = 1
            while (derivative := f"{name}_d{k}") in where:
                jets[name].append(where[derivative])
                k += 1
        elif name != f"{label}_d1" and (lower := f"{label}_d{int(order) - 1}") not in where:
            raise ValueError(f"columns must have {lower} where they have {name}, got {', '.join(names)}")
    return jets
