"""Units and scales of the metrics of a comparison."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ctrlplan._checks import check_kind
from ctrlplan._types import System
from ctrlplan.studies.measures import Measure, Run, checked_names
from ctrlplan.trajectories import Trajectory

if TYPE_CHECKING:  # comparisons use the units
    from ctrlplan.studies.comparison import Comparison

UNIT_SCALES = {"%": 100.0}
"""Scales of metrics in units that do not depend on signals."""


def superscript(exponent: int | str) -> str:
    """An exponent in superscript digits."""
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def with_superscripts(unit: str) -> str:
    """A unit with its powers, as in m^2, in superscript digits."""
    return re.sub(r"\^(-?\d+)", lambda power: superscript(power[1]), unit)


def scientific(value: float, digits: int = 4) -> str:
    """A value with a power of ten, rounded to significant digits."""
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}·10{superscript(int(exponent))}".replace("-", "−")


def own_scale(measure: Measure) -> float:
    """Scale of a metric that does not depend on signals: of a percentage, or of a ratio of lengths; otherwise 0."""
    return 1.0 if measure.of == "path" and not measure.unit else UNIT_SCALES.get(measure.unit, 0.0)


ROUNDING = 1e-6
"""Difference of two values of a metric that counts as rounding, relative to the scale of the metric."""


def without_rounding(value: float, scale: float) -> float:
    """Value of a metric, 0 if it differs from 0 by rounding."""
    return 0.0 if abs(value) <= ROUNDING * scale else value


@dataclass(frozen=True)
class Signals:
    """Signals of a comparison that are measured.

    Attributes
    ----------
    axes : dict of str to str
        Output that follows each axis of the plans.
    controls : tuple of str
        Outputs that are controls.
    units : dict of str to str
        Units by label, where known.
    spans, peaks : dict of str to float
        Maximum range of a plan on each axis, and peak of each control.
    run_time, move_time : float
        Maximum of the times measured, and of the durations of the plans [s].
    """

    axes: dict[str, str]
    controls: tuple[str, ...]
    units: dict[str, str]
    spans: dict[str, float] = field(default_factory=dict)
    peaks: dict[str, float] = field(default_factory=dict)
    run_time: float = 0.0
    move_time: float = 0.0

    def of_axes(self) -> dict[str, str]:
        """Unit of each axis, by its label or its output."""
        return {axis: self.units.get(axis, self.units.get(output, "")) for axis, output in self.axes.items()}

    def of_controls(self) -> dict[str, str]:
        """Unit of each control."""
        return {name: self.units.get(name, "") for name in self.controls}

    def separate(self, unit: str) -> dict[str, str]:
        """Units of the signals of a measure unless all are equal, or all unknown; otherwise empty."""
        units = self.of_axes() if "{y}" in unit else self.of_controls() if "{u}" in unit else {}
        return units if len(set(units.values())) > 1 else {}


def output_unit(comparison: Comparison, output: str) -> str:
    """Unit of an output that follows a plan, by its axis or its own label; empty if it is not given."""
    label = next(iter(comparison.plans.values())).labels[comparison.outputs.index(output)]
    return comparison.units.get(label, comparison.units.get(output, ""))


def signals_of_runs(
    plans: Mapping[str, Trajectory], runs: Mapping[str, Run], units: dict[str, str], since: float
) -> Signals:
    """Signals measured, with their units and scales."""
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
    """Peak of a control over its finite samples."""
    row = run.rows((name,))[0]
    return float(np.abs(row[np.isfinite(row)]).max(initial=0.0))


def listed_measures(
    metrics: dict[str, dict[str, float]], measures: Mapping[str, Measure], signals: Signals
) -> dict[str, Measure]:
    """Measures as shown in tables.

    A maximum over signals in different units is not defined: it becomes nan in
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
            listed[f"{name}_{label}"] = Measure(
                f"{measure.title} ({label})", in_units(measure.unit, unit, unit), definition=measure.definition
            )
    return listed


def scales_of(measures: Mapping[str, Measure], signals: Signals) -> dict[str, float]:
    """Scale of each metric by its unit; without an entry if the unit has no scale.

    The range of the plan for an output, the peak for a control, the simulated
    time for a time, 100 for a percentage.
    """
    found: dict[str, float] = {}
    for name, measure in measures.items():
        found |= {name: own_scale(measure) or _size(measure.unit, signals, None)}
        for label in signals.separate(measure.unit):
            found[f"{name}_{label}"] = _size(measure.unit, signals, label)
    return {name: size for name, size in found.items() if 0.0 < size < np.inf}


def in_units(unit: str, y: str, u: str) -> str:
    """Unit of a measure in those of output and control; empty if a required one is unknown.

    A unit that is a product, a quotient or a power is put in parentheses: the
    effort of a control in deg/s is in (deg/s)^2 s.
    """
    known = {"{y}": y, "{u}": u}
    if any(place in unit and not own for place, own in known.items()):
        return ""
    compound = {place: bool(set(own) & set(" /*·^²³")) and unit != place for place, own in known.items()}
    shown = {place: f"({own})" if compound[place] else own for place, own in known.items()}
    # In one pass, since a unit is a text of the user.
    return re.sub(r"\{[yu]\}", lambda place: shown[place[0]], unit)


def checked_units(
    units: Mapping[str, str] | None, plans: Iterable[Trajectory], systems: Iterable[System]
) -> dict[str, str]:
    """Units by label, each of an axis of a plan, a derivative of one (y_d1), or a signal of a loop.

    Raises
    ------
    TypeError
        If they are not a mapping of str to str.
    ValueError
        If a label is unknown; the known ones are in the message.
    """
    if units is None:
        return {}
    check_kind(units, "units", Mapping, "a mapping of labels to units")
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
    """Scale of a metric with a unit, for one signal or the largest; nan if the unit has no scale."""
    span, peak = (
        np.float64(known.get(label or "", max(known.values(), default=0.0))) for known in (signals.spans, signals.peaks)
    )
    t, move = signals.run_time, signals.move_time
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        sizes = {
            "s": t,
            **UNIT_SCALES,
            "{y}": span,
            "{y} s": span * t,
            "{y}^2 s": ROUNDING * span**2 * t,  # the rounding of a square is that of the signal squared
            "{y} s^2": span * t**2,
            "{y}^2/s^5": span**2 / np.float64(move) ** 5,
            "{u}": peak,
            "{u}^2 s": ROUNDING * peak**2 * t,
        }
    # A user's measure may contain the unit itself.
    for template in () if unit in sizes else sizes:
        for axis, y in signals.of_axes().items():
            if unit and in_units(template, y, "") == unit:
                return _size(template, signals, axis)
        for control, u in signals.of_controls().items():
            if unit and in_units(template, "", u) == unit:
                return _size(template, signals, control)
    return float(sizes.get(unit, np.nan))
