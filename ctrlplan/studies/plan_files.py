"""Plans of a study file, written for other programs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from ctrlplan.studies.files import StudyError, StudyFile
from ctrlplan.trajectories.export import ENDINGS, Options, SampledTable, TableFormat, check_options, ending_of
from ctrlplan.trajectories.files import signal_names, signal_rows


def plan_ending(path: Path, options: Options) -> str:
    """Ending of the file to write, before any work.

    Raises
    ------
    ValueError
        If it is not known or does not have an option.
    """
    ending = ending_of(path, (".json", *ENDINGS), "--out")
    if ending in ENDINGS:
        check_options(options, ending)
    elif options.given():
        raise ValueError(f"{options.given()[0]} must not be given for .json, which holds the plans themselves")
    return ending


def plan_files(study: StudyFile, path: Path, options: Options) -> dict[Path, str | bytes]:
    """Contents by path of the files that hold the plans of a study.

    JSON has each plan by its name, for `trajectory_from_dict`; tables of samples
    have the columns plan.axis. Of other formats each plan has a file of its own,
    with the plan's name at the end of its name where there are several; plans
    without duration, as a step, are left out.

    Parameters
    ----------
    study : StudyFile
        Whose plans are written.
    path : Path
        The file that was named.
    options : Options
        Of those that the format has.

    Raises
    ------
    StudyError
        If the format cannot hold the plans.
    """
    ending = plan_ending(path, options)
    form = ENDINGS.get(ending)
    if form is None:  # .json, which is none of the formats of a single plan
        data = {name: plan.to_dict() for name, plan in study.plans.items()}
        return {path: json.dumps(data, indent=1, allow_nan=False) + "\n"}
    if isinstance(form, TableFormat):
        try:
            return {path: form.encoded(_table(study, options))}
        except ValueError as error:
            raise StudyError(f"{study.path}: waypoints: {error}") from None
    plans = {name: plan for name, plan in study.plans.items() if plan.duration}
    if not plans:
        raise StudyError(f"{study.path}: plans: must have one with a duration to be written as {ending}, got steps")
    found: dict[Path, str | bytes] = {}
    for name, plan in plans.items():
        own = re.sub(r"[^\w.-]", "_", name)
        place = path if len(plans) == 1 else path.with_name(f"{path.name[: -len(ending)]}-{own}{ending}")
        if place in found:
            raise StudyError(f"{study.path}: plans: must have different names as files, got {place.name} twice")
        try:
            found |= form.files(plan, place, options)
        except ValueError as error:
            raise StudyError(f"{study.path}: plan {name}: {error}") from None
    return found


def _table(study: StudyFile, options: Options) -> SampledTable:
    """Samples of all plans, waypoints included unless a period was given."""
    start, end = study.waypoints[0].time, study.waypoints[-1].time
    times = options.times(start, end)
    if options.dt is None:
        times = np.union1d(times, [w.time for w in study.waypoints])
    names = [
        f"{name}.{signal}"
        for name, plan in study.plans.items()
        for signal in signal_names(plan.labels, options.derivatives)
    ]
    rows = [signal_rows(plan, times, options.derivatives) for plan in study.plans.values()]
    return SampledTable(times, tuple(names), np.concatenate(rows))
