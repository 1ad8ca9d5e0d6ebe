"""Best and worst plans by metric, and numbers, in words."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ctrlplan._renamed import FormerAttribute
from ctrlplan.studies.roles import Stability
from ctrlplan.studies.units import ROUNDING, UNIT_SCALES, in_units, scientific, superscript

if TYPE_CHECKING:  # comparisons show their verdicts
    from ctrlplan.studies.comparison import Comparison

TIE = 1e-3
"""Relative difference below which two values count as equal."""

_ROUNDING = 1e-7
"""Difference that counts as rounding in a metric whose scale is unknown."""

_ZERO = 1e-9
"""Magnitude below which a value is printed as 0."""

_INFINITE = {"s": "never"}
"""Words for an infinite value by its unit."""


@dataclass(frozen=True)
class Verdict:
    """Best and worst plans in one metric.

    Attributes
    ----------
    key, title, unit : str
        The metric.
    best, worst : tuple of str
        Plans with the minimum and the maximum value, ties included; both empty
        if all values are equal.
    minimum, maximum : float
        These values.
    sentence : str
        The result in words.
    """

    key: str
    title: str
    unit: str
    best: tuple[str, ...]
    worst: tuple[str, ...]
    minimum: float
    maximum: float
    sentence: str

    winners, losers = FormerAttribute("best"), FormerAttribute("worst")
    least, greatest = FormerAttribute("minimum"), FormerAttribute("maximum")


def verdicts(comparison: Comparison) -> list[Verdict]:
    """Best and worst plans of each metric that two or more plans have.

    Runs that an event ended are not ranked.
    """
    found: list[Verdict] = []
    if is_unstable(comparison):
        return found  # no plan settles
    for key, measure in comparison.measures.items():
        whole = {plan: rows for plan, rows in comparison.metrics.items() if plan not in comparison.stopped}
        values = {plan: rows[key] for plan, rows in whole.items() if key in rows and not math.isnan(rows[key])}
        if len(values) > 1:
            scale = comparison.scales.get(key, UNIT_SCALES.get(measure.unit, math.nan))
            rounding = _ROUNDING if math.isnan(scale) else ROUNDING * scale
            found.append(_verdict(key, measure.title, unit_of(comparison, key), values, rounding))
    return found


def summary(comparison: Comparison) -> str:
    """Number of metrics in which each plan is best and worst, in one paragraph."""
    if is_unstable(comparison):
        return comparison.notes[0]
    decided = [v for v in verdicts(comparison) if v.best]
    ended = (
        f" Not ranked, because an event ended the run: {', '.join(comparison.stopped)}." if comparison.stopped else ""
    )
    if not decided:
        return f"No metric differs between the plans.{ended}"
    parts = []
    for plan in comparison.plans:
        if plan in comparison.stopped:
            continue
        best = sum(plan in v.best for v in decided)
        worst = sum(plan in v.worst for v in decided)
        parts.append(f"{plan} is best in {best} and worst in {worst}")
    sentence = "; ".join(parts)
    return (
        f"Of {len(decided)} metrics that differ between the plans, {sentence}. Values that differ by less than 0.1 %, "
        f"or by less than 10⁻⁶ of the scale of the metric, count as equal.{ended}"
    )


def is_unstable(comparison: Comparison) -> bool:
    """Whether the loop is known to be unstable."""
    return comparison.stability is Stability.UNSTABLE


def unit_of(comparison: Comparison, key: str) -> str:
    """Unit of a metric in the units of a comparison; empty if there is none."""
    return unit_in(comparison, comparison.measures[key].unit)


def unit_in(comparison: Comparison, unit: str) -> str:
    """Unit of a measure in the units of a comparison."""
    first = next(iter(comparison.plans.values()))
    y = _shared([comparison.units.get(label, "") for label in first.labels])
    u = _shared([comparison.units.get(name, "") for name in comparison.controls])
    return in_units(re.sub(r"\^(-?\d+)", lambda power: superscript(power[1]), unit), y, u)


def number(value: float, unit: str = "") -> str:
    """A value with four significant digits; a word or a sign for an infinite or undefined one."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "−∞" if value < 0 else _INFINITE.get(unit, "∞")
    if abs(value) < _ZERO:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        digits = max(0, 3 - math.floor(math.log10(abs(value))))
        return f"{value:.{digits}f}".replace("-", "−")
    return scientific(value)


def _verdict(key: str, title: str, unit: str, values: dict[str, float], rounding: float) -> Verdict:
    minimum, maximum = min(values.values()), max(values.values())
    if _equal(minimum, maximum, rounding):
        apart = maximum - minimum if minimum < maximum else 0.0
        size = number(apart) if apart >= _ZERO else scientific(apart)
        within = f", within {size}{f' {unit}' if unit else ''}" if apart else ""
        sentence = f"{title}: equal for {_listed(tuple(values))}{within}."
        return Verdict(key, title, unit, (), (), minimum, maximum, sentence)
    best = tuple(plan for plan, value in values.items() if _equal(value, minimum, rounding))
    worst = tuple(plan for plan, value in values.items() if _equal(value, maximum, rounding))
    with_unit = f" {unit}" if unit else ""
    high = number(maximum, unit) + (with_unit if math.isfinite(maximum) else "")
    low = number(minimum) + with_unit
    sentence = f"{title}: best {low} ({_listed(best)}), worst {high} ({_listed(worst)})"
    if minimum > rounding and math.isfinite(maximum) and 1.05 <= maximum / minimum < 1e4:
        sentence += f", ratio {number(maximum / minimum)}"
    return Verdict(key, title, unit, best, worst, minimum, maximum, sentence + ".")


def _equal(one: float, other: float, rounding: float) -> bool:
    if math.isinf(one) or math.isinf(other):
        return one == other
    return abs(one - other) <= max(TIE * max(abs(one), abs(other)), rounding)


def _listed(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _shared(units: list[str]) -> str:
    return units[0] if units and len(set(units)) == 1 else ""
