"""Logs of study files: measured runs, and feedforward fitted to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ctrlplan._types import Data
from ctrlplan.simulation import SimulationResponse, read_log
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.entries import Entry, Flag, Listed, Number, OneOf, Table, Text, Whole
from ctrlplan.studies.reading import Reader
from ctrlplan.studies.sections import FittedGains
from ctrlplan.systems import FeedforwardFit, fit_feedforward
from ctrlplan.systems.feedforward_fit import TERMS
from ctrlplan.trajectories import Trajectory

_COLUMN = OneOf((Text(), Whole(0)))
_FIT = Table(
    {
        "control": Entry(Text(), "control of the log; default: the first control of the loop"),
        "position": Entry(Text(), "position, or axis of the plan; default: the first output that follows the plan"),
        "terms": Entry(Listed(Text(TERMS), f"a list of {', '.join(TERMS)}"), "terms of the feedforward"),
        "from": Entry(
            Text(("position", "plan")), "derivatives of the measured position, or of the plan", default="position"
        ),
    }
)
_LOG = Table(
    {
        "log": Entry(Text(), "path of the log (.csv, .mat, .npz), relative to the study file", required=True),
        "time": Entry(_COLUMN, "column of the times, by name or number"),
        "signals": Entry(Table({}, _COLUMN), "column of each signal, by the label of the output of the loop"),
        "units": Entry(Table({}, Number()), "factors by which signals, or the time, are multiplied"),
        "max_gap": Entry(Number(above=0.0, finite=False), "longest permitted time between samples [s]"),
        "align": Entry(
            OneOf((Number(), Text(), Flag())),
            'offset of the log [s], signal by which it is found, "auto", or false for none',
            default="auto",
        ),
        "fit": Entry(OneOf((Flag(), _FIT)), "fit a feedforward to the log"),
    }
)
MEASURED = Table({}, OneOf((Text(), _LOG)))
"""Table [measured]: a log by plan."""


@dataclass(frozen=True)
class Logged:
    """Log of a study file.

    Attributes
    ----------
    log : SimulationResponse
        The log.
    options : dict
        Its table.
    """

    log: SimulationResponse
    options: Data


def check_measured(stated: Data, plans: Mapping[str, Trajectory], reader: Reader) -> None:
    """Raise if a table of [measured] is for an unknown plan."""
    for name in stated:
        if name not in plans:
            raise reader.error(f"measured.{name}", f"must be of one of the plans {', '.join(plans)}, got {name!r}")


def read_logs(stated: Data, reader: Reader) -> dict[str, Logged]:
    """Logs of the table [measured] by plan; StudyError if one cannot be read."""
    found = {}
    for name, given in stated.items():
        table: Data = {"log": given, "align": "auto"} if isinstance(given, str) else given
        options = {key: table[key] for key in ("time", "signals", "units", "max_gap") if key in table}
        try:
            log = read_log(reader.path.parent / table["log"], **options)
        except OSError as error:
            raise reader.error(f"measured.{name}", f"must be a file that can be read, got {error}") from None
        except (ValueError, TypeError) as error:
            raise reader.error(f"measured.{name}", error) from None
        found[name] = Logged(log, table)
    return found


def compared_with(comparison: Comparison, logs: Mapping[str, Logged], reader: Reader) -> Comparison:
    """Comparison with the measured runs of a study file."""
    for name, one in logs.items():
        if name in comparison.failures:
            continue
        align = one.options["align"]
        if isinstance(align, bool):
            align = "auto" if align else None
        try:
            comparison = comparison.with_measured({name: one.log}, align=align)
        except (ValueError, TypeError) as error:
            raise reader.error(f"measured.{name}", error) from None
    return comparison


def fitted(comparison: Comparison, logs: Mapping[str, Logged], reader: Reader) -> FittedGains | None:
    """Feedforward fitted to the logs that require it; None without one."""
    fits: dict[str, FeedforwardFit] = {}
    for name, run in comparison.measured.items():
        fit = logs[run.plan].options.get("fit", False)
        if fit is False:
            continue
        table: Data = {"from": "position"} if fit is True else fit
        control = table.get("control", next(iter(comparison.controls), "u"))
        position = table.get("position", comparison.outputs[0])
        terms = {"terms": table["terms"]} if "terms" in table else {}
        plan = comparison.plans[name] if table["from"] == "plan" else None
        try:
            fits[name] = fit_feedforward(run.aligned, plan, control=control, position=position, **terms)
        except (ValueError, TypeError) as error:
            raise reader.error(f"measured.{run.plan}.fit", error) from None
    return FittedGains(fits) if fits else None
