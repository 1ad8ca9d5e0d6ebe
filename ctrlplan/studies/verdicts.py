"""Best and worst plans by metric, and numbers, in words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ctrlplan._renamed import FormerAttribute
from ctrlplan.studies.limits import limits_sentence
from ctrlplan.studies.roles import Role, Stability
from ctrlplan.studies.units import (
    ROUNDING,
    UNIT_SCALES,
    in_units,
    output_unit,
    scientific,
    with_superscripts,
    without_rounding,
)

if TYPE_CHECKING:  # comparisons show their verdicts
    from ctrlplan.studies.comparison import Comparison

TIE = 1e-2
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
    difference : str
        Difference of best and worst: "equal" up to rounding, "within 1 %", or
        their ratio; otherwise empty.
    """

    key: str
    title: str
    unit: str
    best: tuple[str, ...]
    worst: tuple[str, ...]
    minimum: float
    maximum: float
    sentence: str
    difference: str = ""

    winners, losers = FormerAttribute("best"), FormerAttribute("worst")
    least, greatest = FormerAttribute("minimum"), FormerAttribute("maximum")


def verdicts(comparison: Comparison) -> list[Verdict]:
    """Best and worst plans of each metric that two or more plans have.

    Measured runs, and runs that an event ended, are not ranked.
    """
    found: list[Verdict] = []
    if is_unstable(comparison):
        return found  # no plan settles
    for key, measure in comparison.measures.items():
        whole = {plan: comparison.metrics[plan] for plan in comparison.ranked}
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
    ended += f" Not ranked, because measured: {', '.join(comparison.measured)}." if comparison.measured else ""
    if not decided:
        return f"No metric differs between the plans.{ended}"
    parts = []
    for plan in comparison.ranked:
        best = sum(plan in v.best for v in decided)
        worst = sum(plan in v.worst for v in decided)
        parts.append(f"{plan} is best in {best} and worst in {worst}")
    sentence = "; ".join(parts)
    return (
        f"Of {len(decided)} metrics that differ between the plans, {sentence}. Values within 1 % of the better one, or "
        f"within 10⁻⁶ of the scale of the metric, count as equal.{ended}"
    )


_HEADLINE = (
    ("settling_time", "arrival"),
    ("error_travel", "error_reference", "overshoot_error"),
    ("force_peak", "control_peak"),
)
"""Metrics of a headline: the first of each group that a comparison has."""


def headline(comparison: Comparison) -> str:
    """Settling time, error, peak control and duration of the best planned reference, and whether limits hold.

    The plan is the first of those that settle within 1 % of the shortest
    settling time; values of the step follow, and plans whose run failed or was
    ended by an event.
    """
    failed = (f"Failed, without values: {', '.join(comparison.failures)}.",) if comparison.failures else ()
    if is_unstable(comparison):
        return " ".join([comparison.notes[0], *failed])
    keys = [key for group in _HEADLINE if (key := _first_of(group, comparison))]
    ranked = comparison.ranked
    steps = [name for name in comparison.simulated if comparison.roles.get(name) is Role.STEP]
    planned = [name for name in ranked if name not in steps] or ranked
    parts = []
    if planned:
        plan = _leading_plan(comparison, planned, keys)
        duration = comparison.plans[plan].duration
        moved = f" (duration {duration:.4g} s)" if 0.0 < duration < math.inf else ""
        parts.append(f"With {plan}{moved}: {_values(comparison, plan, keys)}.")
        steps = [name for name in steps if name != plan]
    steps = [name for name in steps[:1] if name not in comparison.stopped]
    parts += [f"With {name}: {_values(comparison, name, keys)}." for name in steps]
    ended = ", ".join(f"{name} ({time:.4g} s)" for name, time in comparison.stopped.items())
    stopped = (f"Not ranked, because an event ended the run: {ended}.",) if ended else ()
    parts += [f"{name}: {_values(comparison, name, keys)}." for name in comparison.measured]
    return " ".join([*parts, *stopped, *failed, limits_sentence(comparison)])


def _leading_plan(comparison: Comparison, planned: list[str], keys: list[str]) -> str:
    """First plan whose first metric is the minimum, up to what counts as equal."""
    values = {name: comparison.metrics[name].get(keys[0], math.inf) if keys else 0.0 for name in planned}
    best = min(values.values())
    return next((name for name, value in values.items() if _equal(value, best, 0.0)), planned[0])


def _first_of(group: tuple[str, ...], comparison: Comparison) -> str:
    """First metric of a group that a plan has; of each signal where they differ in unit."""
    for key in comparison.measures:
        stem = next((name for name in group if key == name or key.startswith(f"{name}_")), "")
        if stem and any(not math.isnan(found.get(key, math.nan)) for found in comparison.metrics.values()):
            return key
    return ""


def _values(comparison: Comparison, plan: str, keys: list[str]) -> str:
    """Values of a plan in words."""
    found = []
    for key in keys:
        value, unit = comparison.metrics[plan].get(key, math.nan), unit_of(comparison, key)
        title = comparison.measures[key].title
        title = title[0].lower() + title[1:]
        if math.isnan(value):
            continue
        if math.isinf(value):
            found.append(f"no {title} within the simulated time")
            continue
        shown = number(without_rounding(value, comparison.scales.get(key, 0.0)))
        found.append(f"{title} {shown}{f' {unit}' if unit else ''}")
    return ", ".join(found) or "no metrics"


def is_unstable(comparison: Comparison) -> bool:
    """Whether the loop is known to be unstable."""
    return comparison.stability is Stability.UNSTABLE


def unit_of(comparison: Comparison, key: str) -> str:
    """Unit of a metric in the units of a comparison; empty if there is none."""
    return unit_in(comparison, comparison.measures[key].unit)


def unit_in(comparison: Comparison, unit: str) -> str:
    """Unit of a measure in the units of a comparison."""
    y = _shared([output_unit(comparison, output) for output in comparison.outputs])
    u = _shared([comparison.units.get(name, "") for name in comparison.controls])
    return in_units(with_superscripts(unit), y, u)


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
        difference = "equal" if not apart or apart <= rounding else f"within {100 * TIE:g} %"
        return Verdict(key, title, unit, (), (), minimum, maximum, sentence, difference)
    best = tuple(plan for plan, value in values.items() if _equal(value, minimum, rounding))
    worst = tuple(plan for plan, value in values.items() if _equal(value, maximum, rounding))
    with_unit = f" {unit}" if unit else ""
    high = number(maximum, unit) + (with_unit if math.isfinite(maximum) else "")
    low = number(minimum) + with_unit
    sentence = f"{title}: best {low} ({_listed(best)}), worst {high} ({_listed(worst)})"
    difference = ""
    if minimum > rounding and math.isfinite(maximum) and maximum / minimum < 1e4:
        difference = f"ratio {maximum / minimum:.3g}"
        sentence += f", ratio {number(maximum / minimum)}" if maximum / minimum >= 1.05 else ""
    return Verdict(key, title, unit, best, worst, minimum, maximum, f"{sentence}.", difference)


def _equal(one: float, other: float, rounding: float) -> bool:
    if math.isinf(one) or math.isinf(other):
        return one == other
    return abs(one - other) <= max(TIE * min(abs(one), abs(other)), rounding)


def _listed(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _shared(units: list[str]) -> str:
    return units[0] if units and len(set(units)) == 1 else ""
