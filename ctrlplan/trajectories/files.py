"""Trajectories as plain data and JSON, and the names of their signals."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

from ctrlplan._files import write_text
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
    write_text(path, _text(plan.to_dict(), "\n", apart=True) + "\n")


def _text(value: object, margin: str, apart: bool = False) -> str:
    """JSON with each object on a line of its own, or on one for each entry where it contains further ones.

    With an indent of all numbers the encoder of the standard library takes four times as long.
    """
    inner = margin + " "
    if isinstance(value, dict) and (apart or any(map(_contains_objects, value.values()))):
        rows = [f"{json.dumps(name)}: {_text(entry, inner)}" for name, entry in value.items()]
        return "{" + inner + ("," + inner).join(rows) + margin + "}"
    if isinstance(value, list) and _contains_objects(value):
        return "[" + inner + ("," + inner).join([_text(entry, inner) for entry in value]) + margin + "]"
    return json.dumps(value, allow_nan=False)


def _contains_objects(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any([isinstance(entry, dict) for entry in value]))


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


def signal_names(labels: Iterable[str], order: int) -> list[str]:
    """Names axis by axis: x, x_d1, x_d2, z, z_d1, ..."""
    return [derivative_name(label, k) for label in labels for k in range(order + 1)]


def signal_rows(plan: Trajectory, times: Array, order: int) -> Array:
    """Values axis by axis, in the order of `signal_names`: (naxes (order + 1), ntime)."""
    return plan.jet(times, order).transpose(1, 0, 2).reshape(plan.naxes * (order + 1), times.size)


def derivative_name(label: str, order: int) -> str:
    """Name of a derivative of an axis: x, x_d1, x_d2, ..."""
    return label if order == 0 else f"{label}_d{order}"
