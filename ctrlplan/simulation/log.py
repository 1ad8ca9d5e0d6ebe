"""Measured signals of a machine, as a response."""

from __future__ import annotations

import math
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_finite, one_number
from ctrlplan._types import Array
from ctrlplan.simulation.response import SimulationResponse
from ctrlplan.trajectories.columns import Column, Columns, CsvColumns

_TIME = "time"
"""Column of the times, and their name in `units`."""

_TEXT_ENDINGS = (".csv", ".txt", ".dat")
_GAP = 10.0
"""Longest step of a log relative to the median step, unless the user gives one."""


def read_log(
    path_or_frame: str | os.PathLike[str] | Mapping[str, ArrayLike] | object,
    *,
    time: Column = _TIME,
    signals: Mapping[str, Column] | None = None,
    units: Mapping[str, float] | None = None,
    max_gap: float | None = None,
) -> SimulationResponse:
    r"""Read measured signals from a file or a table.

    Parameters
    ----------
    path_or_frame : str, path, pandas.DataFrame, or mapping of str to array_like
        A file, whose format follows from its ending:

        - ``.csv`` (also ``.txt``, ``.dat``): cells are separated by semicolons if
          the first line contains one, and decimal commas are then allowed;
          otherwise by commas. Text after # is a comment. The first line may be a
          header.
        - ``.mat``: vectors, structures with time of Simulink, and fields of
          structures as ``data.position``; not version 7.3.
        - ``.npz``: vectors.

        Or a table in memory, with named columns of shape (ntime,).
    time : str or int, optional
        Column of the times [s], by its name or number; of a DataFrame also the
        name of its index. In a file without a header the first column, unless a
        number is given.
    signals : mapping of str to str or int, optional
        Column of each signal by the label that it has in the response, such as
        ``{"y": "pos_act"}``. Default: all columns with as many values as the
        time, under their own names. Columns that are not chosen may contain text.
    units : mapping of str to float, optional
        Factor by which the values of a signal, or ``"time"``, are multiplied: the
        unit of its column in the unit of the response. ``{"time": 1e-3, "y":
        1e-3}`` reads milliseconds and millimetres as s and m.
    max_gap : float, optional
        Longest permitted time between two samples [s]; by default ten times the
        median. ``math.inf`` for signals that are constant between samples.

    Returns
    -------
    SimulationResponse
        The signals as outputs, with the method "measured". Times are those of the
        log; `Comparison.with_measured` aligns them with a plan.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        With the line (of a file), row or index, if a value is missing, text or
        not finite, if times are repeated, decrease, or have a gap; if the format
        or a column is unknown.
    TypeError
        If an argument has a wrong type, or times are dates.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "log.csv")
    ...     size = path.write_text("t_ms;pos_act;state\n0;0,0;READY\n1;2,5;MOVE\n2;7,0;MOVE\n")
    ...     log = read_log(path, time="t_ms", signals={"y": "pos_act"}, units={"time": 1e-3, "y": 1e-3})
    >>> log.time.tolist(), log.outputs.tolist(), log.method
    ([0.0, 0.001, 0.002], [0.0, 0.0025, 0.007], 'measured')
    """
    table = _table_of(path_or_frame, time)
    when = _time_column(table, time)
    chosen = _chosen(table, when, signals)
    factors = _factors(units, chosen)
    hint = "; correct or remove it, or cut the log there"
    values = table.numbers([when, *chosen.values()], hint).T[1:]
    times = table.increasing(when, hint) * factors.get(_TIME, 1.0)
    _check_gaps(table, times, max_gap)
    scale = np.array([factors.get(label, 1.0) for label in chosen])
    reason, title = f"{times.size} samples of {table.title}", f"Signals of {table.title}"
    return measured_response(times, values * scale[:, None], list(chosen), reason, title)


def measured_response(times: Array, rows: Array, labels: Sequence[str], reason: str, title: str) -> SimulationResponse:
    """Response of measured signals.

    Parameters
    ----------
    times : ndarray, shape (ntime,)
        Times [s].
    rows : ndarray, shape (nsignals, ntime)
        The signals.
    labels : sequence of str
        Their labels.
    reason, title : str
        What was measured, and the title of plots.
    """
    return SimulationResponse(
        times,
        rows,
        method="measured",
        reason=reason,
        output_labels=list(labels),
        issiso=len(labels) == 1,
        title=title,
    )


# Sources


class _Arrays(Columns):
    """Named vectors in memory; `row` is what a value's place is called."""

    def __init__(self, title: str, arrays: Mapping[str, Any], row: str = "index") -> None:
        vectors = {name: _vector(values) for name, values in arrays.items()}
        self.title, self._row = title, row
        self.header = list(vectors)
        self.width = len(vectors)
        self._vectors = list(vectors.values())

    def numbers(self, columns: Sequence[int], hint: str = "") -> Array:
        """Numbers of some columns; as `Columns.numbers`."""
        rows = [self._floats(column, hint) for column in columns]
        if len({row.size for row in rows}) > 1:
            sizes = ", ".join(f"{self.name(column)}: {row.size}" for column, row in zip(columns, rows, strict=True))
            raise ValueError(f"{self.title} must have columns of the same length, got {sizes}")
        return np.stack(rows, axis=1)

    def spot(self, row: int) -> str:
        """Index of a row."""
        return f"{self._row} {row}"

    @property
    def sizes(self) -> list[int]:
        """Number of values of each column, 0 where it is no vector."""
        return [vector.size if vector.ndim == 1 else 0 for vector in self._vectors]

    def _floats(self, column: int, hint: str) -> Array:
        vector = self._vectors[column]
        if vector.ndim != 1 or not vector.size:
            shape = f"shape {vector.shape}" if vector.ndim else f"{vector.item()!r:.40}"
            raise ValueError(f"{self.title}: column {self.name(column)} must be a vector, got {shape}")
        if vector.dtype.kind in "mM":
            raise TypeError(
                f"{self.title}: column {self.name(column)} must be numbers (times in seconds), got values of type "
                f"{vector.dtype}; convert it, for instance by (t - t[0]) / numpy.timedelta64(1, 's')"
            )
        if vector.dtype.kind in "biuf":
            found = vector.astype(float)
            wrong = np.flatnonzero(~np.isfinite(found))
        else:  # text, or numbers among other objects
            given = vector.tolist()
            wrong = np.flatnonzero([not (isinstance(value, int | float) and math.isfinite(value)) for value in given])
            found = np.array(given, dtype=float) if not wrong.size else np.empty(0)
        if wrong.size:
            row = int(wrong[0])
            raise ValueError(
                f"{self.title}, {self.spot(row)}: column {self.name(column)} must be a finite number, got "
                f"{str(vector[row])!r}{hint}"
            )
        return found


def _vector(values: Any) -> Any:
    """Values as an array, a row or a column as a vector."""
    if np.ma.isMaskedArray(values):
        values = np.ma.filled(values.astype(float), np.nan)
    array = np.asarray(values)
    return array.ravel() if array.ndim == 2 and 1 in array.shape else array


def _table_of(source: Any, time: Column) -> Columns:
    """Columns of a file or of a table in memory."""
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        ending = path.suffix.lower()
        if ending in _TEXT_ENDINGS:
            return CsvColumns(path)
        if ending not in _READERS:
            known = ", ".join((*_TEXT_ENDINGS, *_READERS))
            raise ValueError(f"path_or_frame must end in one of {known}, or be a DataFrame, got {path}")
        return _Arrays(str(path), _READERS[ending](path))
    if isinstance(source, Mapping):
        return _Arrays("the table", {str(name): values for name, values in source.items()})
    if hasattr(source, "columns") and hasattr(source, "__getitem__"):
        names = [str(name) for name in source.columns]
        if len(set(names)) < len(names):
            raise ValueError(f"columns of the frame must have different names, got {', '.join(names)}")
        columns = {str(name): source[name] for name in source.columns}
        index = getattr(source, "index", None)
        if time not in columns and index is not None and index.name == time:
            columns[str(time)] = index
        return _Arrays("the frame", columns, "row")
    raise TypeError(
        f"path_or_frame must be a path, a DataFrame or a mapping of names to arrays, got {type(source).__name__}"
    )


def _mat_arrays(path: Path) -> dict[str, Any]:
    """Vectors of a MAT file."""
    from scipy.io import loadmat

    try:
        return dict(_fields_of(loadmat(str(path), appendmat=False, simplify_cells=True)))
    except OSError:
        raise
    except NotImplementedError:
        raise ValueError(f"{path} must be a MAT file before version 7.3; write it by save(..., '-v7')") from None
    except Exception as error:  # whatever scipy raises for a damaged file
        raise ValueError(f"{path} must be a MAT file, got {type(error).__name__}: {error}") from None


def _fields_of(data: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Names and values of variables; fields of a structure after a dot."""
    found: list[tuple[str, Any]] = []
    for name, value in data.items():
        if name.startswith("__"):
            continue
        if not isinstance(value, dict):
            found.append((prefix + name, value))
        elif {"time", "signals"} <= value.keys() and isinstance(value["signals"], dict):
            found.append((prefix + name, value["signals"].get("values")))  # a structure with time of Simulink
        else:
            found += _fields_of(value, f"{prefix}{name}.")
    return found


def _npz_arrays(path: Path) -> dict[str, Any]:
    """Vectors of a NPZ file."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except OSError:
        raise
    except (ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} must be a NPZ file of numbers, got {type(error).__name__}: {error}") from None


_READERS = {".mat": _mat_arrays, ".npz": _npz_arrays}


# Choices


def _time_column(table: Columns, time: Column) -> int:
    """Number of the column of times."""
    if isinstance(time, bool) or not isinstance(time, Column):
        raise TypeError(f"time must be the name or the number of a column, got {time!r:.80}")
    if table.header is None and time == _TIME:
        return 0
    similar = [name for name in table.header or () if re.fullmatch(r"t(ime)?([\W_].*)?", name, re.IGNORECASE)]
    if table.header is not None and isinstance(time, str) and time not in table.header and similar:
        raise ValueError(
            f"{table.title} must have the column {time!r} of times, got {', '.join(table.header)}; pass "
            f"time={similar[0]!r}, with units= unless it is in s"
        )
    return table.column(time)


def _chosen(table: Columns, when: int, signals: Mapping[str, Column] | None) -> dict[str, int]:
    """Column of each signal by its label."""
    if signals is None:
        if table.header is None:
            raise ValueError(f'{table.title} has no header; give signals= by number, for instance {{"y": 1}}')
        sizes = table.sizes if isinstance(table, _Arrays) else [1] * table.width
        found = {name: k for k, name in enumerate(table.header) if k != when and sizes[k] == sizes[when]}
        if not found:
            others = ", ".join(f"{name} with {sizes[k]}" for k, name in enumerate(table.header) if k != when)
            if not others:
                raise ValueError(f"{table.title} must have a column of a signal, got one of times only")
            raise ValueError(
                f"{table.title} must have a column of a signal with {sizes[when]} values, as many as times, got "
                f"{others}"
            )
        return found
    if not isinstance(signals, Mapping):
        raise TypeError(f"signals must be a mapping of labels to columns, got {signals!r:.80}")
    if not signals:
        raise ValueError("signals must name at least one column, got none")
    for label, column in signals.items():
        if not isinstance(label, str) or not label:
            raise TypeError(f"signals must have labels that are strings, got {label!r}")
        if isinstance(column, bool) or not isinstance(column, Column):
            raise TypeError(f"signals[{label!r}] must be the name or the number of a column, got {column!r:.80}")
    return {label: table.column(column) for label, column in signals.items()}


def _factors(units: Mapping[str, object] | None, chosen: Mapping[str, int]) -> dict[str, float]:
    """Factor of each signal and of the time."""
    if units is None:
        return {}
    if not isinstance(units, Mapping):
        raise TypeError(f"units must be a mapping of labels to factors, got {units!r:.80}")
    found = {}
    for label, factor in units.items():
        if label != _TIME and label not in chosen:
            raise ValueError(f"units must be of {', '.join((_TIME, *chosen))}, got {label!r}")
        if isinstance(factor, str):
            raise TypeError(
                f"units[{label!r}] must be the factor from the log to the response, such as 1e-3 from mm to m, got "
                f"{factor!r}"
            )
        found[label] = checked_finite(factor, f"units[{label!r}]", above=0.0 if label == _TIME else None)
        if not found[label]:
            raise ValueError(f"units[{label!r}] must not be 0, got 0")
    return found


def _check_gaps(table: Columns, times: Array, max_gap: float | None) -> None:
    """Raise where two samples are too far apart, or there are fewer than two."""
    if times.size < 2:
        raise ValueError(f"{table.title} must have two or more samples, got {times.size}")
    steps = np.diff(times)
    if max_gap is None:
        limit, what = _GAP * float(np.median(steps)), f"{_GAP:g} times the median step"
    else:
        limit, what = one_number(max_gap, "max_gap"), "max_gap"
        if not limit > 0.0:
            raise ValueError(f"max_gap must be above 0, got {limit}")
    wrong = np.flatnonzero(steps > limit * (1.0 + 1e-9))
    if wrong.size:
        k = int(wrong[0])
        raise ValueError(
            f"{table.title}, {table.spot(k + 1)}: times must have no gap above {limit:.6g} s ({what}), got "
            f"{steps[k]:.6g} s after {table.spot(k)}; cut the log there, or give max_gap= where the signals are "
            "constant between samples"
        )
