"""Trajectories as plain data, JSON and CSV."""

from __future__ import annotations

import bz2
import csv
import gzip
import io
import json
import lzma
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_count, checked_timepts
from ctrlplan._files import write_bytes, write_text
from ctrlplan._types import Data
from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.trajectory import Trajectory


def trajectory_from_dict(data: Data) -> Trajectory:
    """Trajectory from the plain data of its `to_dict`.

    Parameters
    ----------
    data : dict
        With the key "type" and the entries of that kind.

    Returns
    -------
    Trajectory
        Equal to the saved one in every bit of its values.

    Raises
    ------
    ValueError
        If the kind is unknown or an entry is missing or wrong.
    """
    kind = data.get("type") if isinstance(data, dict) else None
    if not isinstance(kind, str) or kind not in Trajectory.kinds:
        raise ValueError(f"type must be one of {', '.join(sorted(Trajectory.kinds))}, got {kind!r}")
    try:
        return Trajectory.kinds[kind].from_dict(data)
    except KeyError as missing:
        raise ValueError(f"a {kind} must have the entry {missing}, got {', '.join(map(str, data))}") from None
    except RecursionError:
        raise ValueError("data must not be nested so deeply that Python's stack overflows") from None
    except (TypeError, AttributeError, IndexError, ArithmeticError) as error:
        raise ValueError(f"a {kind} must have entries of the kinds that to_dict writes: {error}") from None


def save_trajectory(plan: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write a trajectory as JSON; numbers are restored to every bit."""
    text = json.dumps(plan.to_dict(), indent=1, allow_nan=False)
    write_text(path, text + "\n")


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Read a trajectory that `save` wrote.

    Parameters
    ----------
    path : str or path
        A JSON file.

    Returns
    -------
    Trajectory

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it does not contain a trajectory.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        return trajectory_from_dict(json.loads(text, parse_constant=_no_number))
    except RecursionError:
        raise ValueError(f"{os.fspath(path)} must contain a saved trajectory: it is nested too deeply") from None
    except (ValueError, TypeError) as error:
        raise ValueError(f"{os.fspath(path)} must contain a saved trajectory: {error}") from None


def _no_number(name: str) -> NoReturn:
    """Raise for nan and inf, which are not JSON and which `save` does not write."""
    raise ValueError(f"numbers must be finite, got {name}")


def write_csv(plan: Trajectory, path: str | os.PathLike[str], timepts: ArrayLike | None = None, order: int = 2) -> None:
    """Write times and jets as a table: time, then each axis with its derivatives.

    Parameters
    ----------
    plan : Trajectory
        Plan to be sampled.
    path : str or path
        File to be written.
    timepts : array_like, shape (ntime,), optional
        Times [s]; default: 1001 from start to end.
    order : int, optional
        Highest derivative; columns are x, x_d1, x_d2, ...

    Raises
    ------
    ValueError
        If `timepts` is not a sequence of times (but a sampling period), if a
        time is nan, or if the order is negative.
    OSError
        If the file cannot be written; an existing file is then unchanged.
    """
    times = np.linspace(plan.start, plan.end, 1001) if timepts is None else checked_timepts(timepts)
    if times.ndim != 1:
        got = f"the scalar {times:g}" if times.ndim == 0 else f"shape {times.shape}"
        step = f"{times:g}" if times.ndim == 0 else "dt"
        raise ValueError(
            f"timepts must be sample times of shape (ntime,), got {got}; for one row every {step} s pass "
            f"np.arange(plan.start, plan.end, {step})"
        )
    highest = checked_count(order, "order")
    columns = np.concatenate([times[None], signal_rows(plan, times, highest)])
    table = io.StringIO()
    np.savetxt(
        table, columns.T, fmt="%.17g", delimiter=",", header=csv_header(column_names(plan, highest)), comments=""
    )
    # As numpy does for paths with these suffixes.
    packers: dict[str, Callable[[bytes], bytes]] = {".gz": gzip.compress, ".bz2": bz2.compress, ".xz": lzma.compress}
    write_bytes(path, packers.get(Path(path).suffix, bytes)(table.getvalue().encode("utf-8")))


def csv_header(names: list[str]) -> str:
    """Header line of a table, with names quoted where necessary; duplicate names raise."""
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"columns must have different names, got {name!r} twice; rename an axis")
    line = io.StringIO(newline="")
    csv.writer(line, lineterminator="\r\n").writerow(names)  # csv then quotes names that contain either character
    return line.getvalue()[:-2]


def column_names(plan: Trajectory, order: int) -> list[str]:
    """Names of the columns: time, x, x_d1, x_d2, z, z_d1, ..."""
    return ["time", *signal_names(plan.labels, order)]


def signal_names(labels: Iterable[str], order: int) -> list[str]:
    """Names axis by axis: x, x_d1, x_d2, z, z_d1, ..."""
    return [derivative_name(label, k) for label in labels for k in range(order + 1)]


def signal_rows(plan: Trajectory, times: Array, order: int) -> Array:
    """Values axis by axis, in the order of `signal_names`: (naxes (order + 1), ntime)."""
    return plan.jet(times, order).transpose(1, 0, 2).reshape(plan.naxes * (order + 1), times.size)


def derivative_name(label: str, order: int) -> str:
    """Name of a derivative of an axis: x, x_d1, x_d2, ..."""
    return label if order == 0 else f"{label}_d{order}"
