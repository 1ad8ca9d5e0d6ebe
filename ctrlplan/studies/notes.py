"""What a reader must know of the runs of a comparison, in sentences."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ctrlplan.simulation import Occurrence, what_happened
from ctrlplan.studies.experiment import Measured
from ctrlplan.studies.measures import Run
from ctrlplan.studies.units import Signals


def notes_of(found: Measured) -> tuple[str, ...]:
    """Notes on the runs: loops that are unstable, start elsewhere, or never settle; events; plans that failed."""
    return (
        *_notes_of_loops(found.runs, found.metrics),
        *_notes_of_events(found.runs),
        *_notes_of_failures(found.failures),
    )


def mark_of(stop: Occurrence) -> str:
    """Reservation about a plan whose run an event ended."""
    return f"the run was ended: {stop}; measured up to then, and not ranked"


def how_measured(signals: Signals, band: float) -> dict[str, object]:
    """What the report says of the metrics."""
    several = [
        f"of {what} the worst of {', '.join(names)}"
        for what, names in (("outputs", signals.axes), ("controls", signals.controls))
        if len(names) > 1
    ]
    how: dict[str, object] = {"settling band": f"{100 * band:g} %"}
    if several:
        how["figures"] = f"{', '.join(several)}; where these differ in unit, each by itself"
    return how


def _notes_of_loops(runs: Mapping[str, Run], found: Mapping[str, Mapping[str, float]]) -> tuple[str, ...]:
    """What a reader must know of the loops: that they are unstable, start elsewhere, or never settle."""
    notes = [run.doubt for run in runs.values() if run.doubt]
    unstable = [name for name, run in runs.items() if run.is_unstable]
    if unstable:
        poles = np.concatenate([run.unstable for run in runs.values() if run.unstable is not None])
        worst = poles[poles.real.argmax()]
        pole = f"{worst.real:.4g}" + (f" ± {abs(worst.imag):.4g}j" if worst.imag else "")
        whose = "The loop" if len(unstable) == len(runs) else f"With {', '.join(unstable)}, the loop"
        return (f"{whose} is unstable: it has a pole at {pole} 1/s. No reference makes it settle.", *notes)
    never = [
        name for name, values in found.items() if values.get("settling_time") == np.inf and runs[name].stop is None
    ]
    if never:
        notes.append(
            f"With {', '.join(never)} the output does not settle within the run: the run is too short, or the loop "
            "keeps an error."
        )
    return tuple(notes)


def _notes_of_events(runs: Mapping[str, Run]) -> tuple[str, ...]:
    """What happened on the way, plan by plan."""
    notes = []
    for plan, run in runs.items():
        events = [event for event in run.response.events if event.kind != "inside"]
        happened = []
        for name in dict.fromkeys(event.name for event in events):
            at = [event.time for event in events if event.name == name]
            happened.append(f"{what_happened(name)} {len(at)} times, first at {at[0]:.4g} s")
        stop = run.stop
        ended = "" if stop is None else f"; the run was ended at {stop.time:.4g} s, and is measured up to then"
        if happened:
            notes.append(f"With {plan}, {', '.join(happened)}{ended}.")
    return tuple(notes)


def _notes_of_failures(failures: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(f"With {plan} the run failed, and it is left out: {reason}" for plan, reason in failures.items())
