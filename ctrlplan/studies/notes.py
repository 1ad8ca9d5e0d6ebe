"""Notes on the runs of a comparison: stability, events, failures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ctrlplan.simulation import Occurrence, what_happened
from ctrlplan.simulation.response import departures_in
from ctrlplan.studies.experiment import Measured
from ctrlplan.studies.measures import Run
from ctrlplan.studies.units import Signals


def notes_of(found: Measured) -> tuple[str, ...]:
    """Notes on the runs: unstable loops, starts away from equilibrium, runs that do not settle, events, failures."""
    return (
        *_notes_of_loops(found.runs, found.metrics),
        *_notes_of_events(found.runs),
        *_notes_of_failures(found.failures),
    )


def mark_of(stop: Occurrence) -> str:
    """Note on a plan whose run an event ended."""
    return f"an event ended the run ({stop}); metrics cover the time before it and are not ranked"


def how_measured(signals: Signals, band: float) -> dict[str, object]:
    """How the metrics were computed, for the report."""
    several = [
        f"maximum over the {what} {', '.join(names)}"
        for what, names in (("outputs", signals.axes), ("controls", signals.controls))
        if len(names) > 1
    ]
    how: dict[str, object] = {"settling band": f"{100 * band:g} %"}
    if several:
        how["metrics"] = f"{' and '.join(several)}; signals in different units are listed separately"
    return how


def _notes_of_loops(runs: Mapping[str, Run], found: Mapping[str, Mapping[str, float]]) -> tuple[str, ...]:
    """Notes on unstable loops, starts away from equilibrium, and runs that do not settle."""
    notes = [run.doubt for run in runs.values() if run.doubt]
    unstable = [name for name, run in runs.items() if run.is_unstable]
    if unstable:
        poles = np.concatenate([run.unstable for run in runs.values() if run.unstable is not None])
        worst = poles[poles.real.argmax()]
        pole = f"{worst.real:.4g}" + (f" ± {abs(worst.imag):.4g}j" if worst.imag else "")
        whose = "The loop" if len(unstable) == len(runs) else f"{', '.join(unstable)}: the loop"
        return (f"{whose} is unstable: it has a pole at {pole} 1/s. It does not settle for any reference.", *notes)
    never = [
        name for name, values in found.items() if values.get("settling_time") == np.inf and runs[name].stop is None
    ]
    if never:
        notes.append(
            f"{', '.join(never)}: the output does not settle within the simulated time. The simulation is too short, "
            "or the loop has a steady-state error."
        )
    return tuple(notes)


def _notes_of_events(runs: Mapping[str, Run]) -> tuple[str, ...]:
    """Events of each run."""
    notes = []
    for plan, run in runs.items():
        happened = []
        for name, number, first in departures_in(run.response):
            count = f"{number} times, first " if number > 1 else ""
            happened.append(f"{what_happened(name)} ({count}at {first:.4g} s)")
        stop = run.stop
        ended = "" if stop is None else f". The run ended at {stop.time:.4g} s; metrics cover the time before it"
        if happened:
            notes.append(f"Events in the run with {plan}: {', '.join(happened)}{ended}.")
    return tuple(notes)


def _notes_of_failures(failures: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(f"{plan}: the run failed and is omitted: {reason}" for plan, reason in failures.items())
