"""Sweeps and random draws of study files."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ctrlplan._types import Array, Data
from ctrlplan.studies.draws import draws
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.entries import NUMBERS, PAIR, TEXTS, Entry, Number, OneOf, Table, Text, Whole
from ctrlplan.studies.experiment import Experiment, Metrics
from ctrlplan.studies.loop_kind import LoopKind
from ctrlplan.studies.monte_carlo import monte_carlo
from ctrlplan.studies.reading import Reader, got
from ctrlplan.studies.sweep import Sweep, sweep

_SPACINGS: dict[str, tuple[Callable[..., object], float]] = {
    "linear": (np.linspace, -math.inf),
    "log": (np.geomspace, 0.0),
}
"""Function of each spacing, and the bound below its values."""

_GRID = Table(
    {
        "low": Entry(Number(), "first value", required=True),
        "high": Entry(Number(), "last value", required=True),
        "count": Entry(Whole(2, 100_000), "number of values", required=True),
        "scale": Entry(Text((*_SPACINGS,)), "spacing of the values", default="linear"),
    }
)
SWEEP = Table(
    {
        "parameter": Entry(
            Text(),
            'number of [loop] that is varied, in the plant and in its law; with kind = "python:module:function" an '
            "argument of the function",
            required=True,
        ),
        "values": Entry(OneOf((NUMBERS, _GRID)), "increasing values of the parameter", required=True),
        "metrics": Entry(TEXTS, "metrics that the figure shows; default: settling_time and overshoot_error"),
    }
)
"""Table [sweep]."""

DRAWS = Table(
    {
        "count": Entry(Whole(1, 10_000), "number of draws", required=True),
        "seed": Entry(Whole(0), "seed of the random numbers", default=0),
        "parameters": Entry(
            Table({}, PAIR),
            "minimum and maximum of uniform distributions, by parameter: a number of [loop], for a crane of the plant "
            "alone, whose law has the values of [loop]",
            required=True,
        ),
    }
)
"""Table [draws]."""


def check_variations(data: Data, kind: LoopKind, reader: Reader) -> None:
    """Check the tables [sweep] and [draws] of a study file, which have been read.

    Raises
    ------
    StudyError
        If a parameter or a metric is unknown, or values do not increase.
    """
    if "sweep" in data:
        table = data["sweep"]
        kind.check_parameter(table["parameter"], "sweep.parameter", reader)
        if isinstance(table["values"], dict) and not table["values"]["low"] > _SPACINGS[table["values"]["scale"]][1]:
            raise reader.error("sweep.values.low", f"must be above 0 on a log scale, got {table['values']['low']:g}")
        values = _values(table["values"])
        if not values.size or np.any(np.diff(values) <= 0.0):
            raise reader.error("sweep.values", f"must increase strictly, got {got(table['values'])}")
    if "draws" in data:
        parameters = data["draws"]["parameters"]
        if not parameters:
            raise reader.error("draws.parameters", "must have at least one parameter, got none")
        for name, (low, high) in parameters.items():
            kind.check_parameter(name, f"draws.parameters.{name}", reader)
            if not low <= high:
                raise reader.error(f"draws.parameters.{name}", f"must increase, got {low:g} and {high:g}")


def swept(table: Data, kind: LoopKind, loop: Data, path: Path, experiment: Experiment, progress: bool) -> Sweep:
    """Metrics of the plans over the parameter of a table [sweep]."""
    name = table["parameter"]
    return sweep(
        lambda value: kind.build(loop | {name: value}, path),
        _values(table["values"]),
        experiment.plans,
        experiment.timepts,
        parameter=name,
        progress=progress,
        **_fields(experiment),
    )


def shown_metrics(table: Data, metrics: Metrics, reader: Reader) -> tuple[str, ...]:
    """Metrics that the figure of a sweep shows: those of the table, or two that the plans have."""
    known = tuple(dict.fromkeys(name for row in metrics.values() for name in row))
    for name in table.get("metrics", ()):
        if name not in known:
            raise reader.error("sweep.metrics", f"must be metrics of the plans, {', '.join(known)}, got {name!r}")
    usual = tuple(name for name in ("settling_time", "overshoot_error") if name in known)
    return tuple(table.get("metrics", ())) or usual or known[:2]


def drawn(table: Data, kind: LoopKind, loop: Data, path: Path, experiment: Experiment, progress: bool) -> Ensemble:
    """Responses over the random parameters of a table [draws]."""
    pairs = table["parameters"]
    return monte_carlo(
        kind.varied(list(pairs), loop, path),
        draws(table["count"], table["seed"], **pairs),
        experiment.plans,
        experiment.timepts,
        progress=progress,
        **_fields(experiment),
    )


def _fields(experiment: Experiment) -> Data:
    names = ("waypoints", "start", "band", "outputs", "controls", "initial_state", "params", "events", "measures")
    return {name: getattr(experiment, name) for name in names}


def _values(values: Data | list[float]) -> Array:
    if isinstance(values, list):
        return np.array(values)
    return np.asarray(_SPACINGS[values["scale"]][0](values["low"], values["high"], values["count"]))
