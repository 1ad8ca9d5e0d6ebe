"""Units and sizes of the metrics of a comparison: which signals share them, and what counts as rounding."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from ctrlplan._types import System
from ctrlplan.studies.measures import Measure, Run, checked_names
from ctrlplan.trajectories import Trajectory

ROUNDING = 1e-6
"""Difference of two values of a metric that is rounding, relative to the scale of the metric."""


@dataclass(frozen=True)
class Signals:
    """Signals that a comparison measures.

    Attributes
    ----------
    axes : dict of str to str
        Output that follows each axis of the plans.
    controls : tuple of str
        Outputs that are controls.
    units : dict of str to str
        Units by label, where known.
    spans, peaks : dict of str to float
        Largest range of a plan on each axis, largest magnitude of each control.
    run_time, move_time : float
        Longest time measured, and of a plan [s].
    """

    axes: dict[str, str]
    controls: tuple[str, ...]
    units: dict[str, str]
    spans: dict[str, float] = field(default_factory=dict)
    peaks: dict[str, float] = field(default_factory=dict)
    run_time: float = 0.0
    move_time: float = 0.0

    def of_axes(self) -> dict[str, str]:
        """Unit of each axis: that of its label, or of its output."""
        return {axis: self.units.get(axis, self.units.get(output, "")) for axis, output in self.axes.items()}

    def of_controls(self) -> dict[str, str]:
        """Unit of each control."""
        return {name: self.units.get(name, "") for name in self.controls}

    def separate(self, unit: str) -> dict[str, str]:
        """Units of the signals in whose unit a measure is, where they are known to differ; empty where not."""
        units = self.of_axes() if "{y}" in unit else self.of_controls() if "{u}" in unit else {}
        return units if len(set(filter(None, units.values()))) > 1 else {}


def signals_of_runs(
    plans: Mapping[str, Trajectory], runs: Mapping[str, Run], units: dict[str, str], since: float
) -> Signals:
    """The signals measured, with their units and sizes."""
    axes = next(iter(plans.values())).labels
    last = list(runs.values())[-1]
    extrema = [plan.extrema() for plan in plans.values()]
    spans = np.max([found.maximum - found.minimum for found in extrema], axis=0)
    return Signals(
        dict(zip(axes, last.outputs, strict=True)),
        last.controls,
        units,
        dict(zip(axes, spans.tolist(), strict=True)),
        {name: max(_peak_of(run, name) for run in runs.values()) for name in last.controls},
        max(float(run.response.time[-1]) for run in runs.values()) - since,
        max(plan.duration for plan in plans.values()),
    )


def _peak_of(run: Run, name: str) -> float:
    """Largest finite magnitude of a control."""
    row = run.rows((name,))[0]
    return float(np.abs(row[np.isfinite(row)]).max(initial=0.0))


def listed_measures(
    metrics: dict[str, dict[str, float]], measures: Mapping[str, Measure], signals: Signals
) -> dict[str, Measure]:
    """Measures as they are shown.

    Of signals that differ in unit there is no worst: its value becomes nan in
    `metrics`, and a measure of each signal is shown in its place.
    """
    listed: dict[str, Measure] = {}
    for name, measure in measures.items():
        separate = signals.separate(measure.unit)
        if not separate:
            listed[name] = measure
            continue
        for values in metrics.values():
            if name in values:
                values[name] = np.nan
        for label, unit in separate.items() if measure.of != "path" else ():
            listed[f"{name}_{label}"] = Measure(f"{measure.title} ({label})", in_units(measure.unit, unit, unit))
    return listed


def scales_of(measures: Mapping[str, Measure], signals: Signals) -> dict[str, float]:
    """Size of each metric by what it is measured in; none where that does not say.

    The range of the plan for an output, the peak for a control, the time of the
    run for a time, 100 for a percentage.
    """
    found: dict[str, float] = {}
    for name, measure in measures.items():
        size = 1.0 if measure.of == "path" and not measure.unit else _size(measure.unit, signals, None)
        found |= {name: size}
        for label in signals.separate(measure.unit):
            found[f"{name}_{label}"] = _size(measure.unit, signals, label)
    return {name: size for name, size in found.items() if 0.0 < size < np.inf}


def in_units(unit: str, y: str, u: str) -> str:
    """A measure's unit in those of output and control; empty where one that it needs is not known.

    A unit that is a product, a quotient or a power stands in brackets: the
    effort of a control in deg/s is in (deg/s)^2 s.
    """
    known = {"{y}": y, "{u}": u}
    if any(place in unit and not own for place, own in known.items()):
        return ""
    compound = {place: bool(set(own) & set(" /*·^²³")) and unit != place for place, own in known.items()}
    shown = {place: f"({own})" if compound[place] else own for place, own in known.items()}
    # In one pass, since what stands for one of them is a user's text.
    return re.sub(r"\{[yu]\}", lambda place: shown[place[0]], unit)


def checked_units(
    units: Mapping[str, str] | None, plans: Iterable[Trajectory], systems: Iterable[System]
) -> dict[str, str]:
    """Units by label, each of an axis of a plan, a derivative of one (y_d1), or a signal of a loop.

    Raises
    ------
    TypeError
        If they are no mapping of str to str.
    ValueError
        If a label is unknown; the known ones are in the message.
    """
    if units is None:
        return {}
    if not isinstance(units, Mapping):
        raise TypeError(f"units must be a mapping of labels to units, got {type(units).__name__}")
    known = dict.fromkeys(label for plan in plans for label in plan.labels)
    known |= dict.fromkeys(label for system in systems for label in _signals(system))
    checked_names([name for name in units if re.sub(r"_d[0-9]+$", "", str(name)) not in known], known, "units")
    for label, unit in units.items():
        if not isinstance(unit, str):
            raise TypeError(f"units[{label!r}] must be a string, got {unit!r}")
    return dict(units)


def _signals(system: System) -> Iterator[str]:
    """Names of the signals of a loop and of the blocks in it."""
    for labels in (system.output_labels, system.input_labels, system.state_labels):
        yield from labels or ()
    for block in getattr(getattr(system, "system", system), "syslist", ()):
        yield from _signals(block)


def _size(unit: str, signals: Signals, label: str | None) -> float:
    """Size of a metric in a unit, of one signal or of the largest; nan where the unit does not say."""
    span, peak = (
        np.float64(known.get(label or "", max(known.values(), default=0.0))) for known in (signals.spans, signals.peaks)
    )
    t, move = signals.run_time, signals.move_time
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        sizes = {
            "s": t,
            "%": 100.0,
            "{y}": span,
            "{y} s": span * t,
            "{y}^2 s": ROUNDING * span**2 * t,  # the square of rounding, in a metric that is a square
            "{y} s^2": span * t**2,
            "{y}^2/s^5": span**2 / np.float64(move) ** 5,
            "{u}": peak,
            "{u}^2 s": peak**2 * t,
        }
    # A measure of one's own may name the unit itself.
    for template in () if unit in sizes else sizes:
        for axis, y in signals.of_axes().items():
            if unit and in_units(template, y, "") == unit:
                return _size(template, signals, axis)
        for control, u in signals.of_controls().items():
            if unit and in_units(template, "", u) == unit:
                return _size(template, signals, control)
    return float(sizes.get(unit, np.nan))
