"""One metric of trigonometric plans over alpha and duration, compared with that of their baselines."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ctrlplan._renamed import FormerAttribute
from ctrlplan._types import Array
from ctrlplan.studies.units import ROUNDING

SAME = 1e-3
"""Relative difference up to which values count as equal."""


class Mark(StrEnum):
    """How a plan compares with the best baseline."""

    EQUAL = ""
    BETTER = "better"
    WORSE = "worse"


@dataclass(frozen=True)
class Grid:
    """One metric of trigonometric plans over alpha and duration, with that of their baselines.

    Attributes
    ----------
    title, unit : str
        Name and unit of the metric; smaller is better.
    durations : ndarray, shape (ndurations,)
        Durations of the plans [s].
    alphas : ndarray, shape (nalphas,)
        Shape parameters [rad].
    values : ndarray, shape (ndurations, nalphas)
        Values of the trigonometric plans.
    baselines : dict of str to ndarray, shape (ndurations,)
        Values of the baselines by name.
    not_ranked : tuple of str
        Baselines that are shown but not ranked: steps, which violate every
        limit on a derivative, or a lower bound that no plan attains.
    scale : float
        Scale of the metric; differences below 1e-6 of it are rounding. 0 if
        unknown.
    """

    title: str
    unit: str
    durations: Array
    alphas: Array
    values: Array
    baselines: dict[str, Array]
    not_ranked: tuple[str, ...] = ()
    scale: float = 0.0

    rivals, beside = FormerAttribute("baselines"), FormerAttribute("not_ranked")

    def best(self, row: int) -> tuple[str, float]:
        """Best baseline at one of the durations, and its value; "none" and nan if none has a value."""
        ranked = {name: values for name, values in self.baselines.items() if name not in self.not_ranked}
        found = {name: float(values[row]) for name, values in ranked.items() if not math.isnan(values[row])}
        name = min(found, key=lambda baseline: found[baseline], default="none")
        return name, found.get(name, math.nan)

    def marks(self) -> list[list[Mark]]:
        """Whether each trigonometric plan is better or worse than the best baseline, or neither."""
        return [
            [_mark(value, self.best(row)[1], ROUNDING * self.scale) for value in values]
            for row, values in enumerate(self.values.tolist())
        ]

    @property
    def verdict(self) -> str:
        """Number of trigonometric plans that are better and worse than the best baseline, in a sentence."""
        if np.isnan([self.best(i)[1] for i in range(self.durations.size)]).all():
            return f"{self.title}: no baseline has a value to compare with."
        marks = self.marks()
        cells = [(i, j) for i in range(len(marks)) for j in range(self.alphas.size) if self.alphas[j] > 0.0]
        better = [(i, j) for i, j in cells if marks[i][j] is Mark.BETTER]
        worse = sum(marks[i][j] is Mark.WORSE for i, j in cells)
        names = list(dict.fromkeys(self.best(i)[0] for i in range(self.durations.size)))
        found = (
            f"{self.title}: of {len(cells)} trigonometric plans, {len(better)} are better and {worse} are worse than "
            f"the best baseline of the same duration ({', '.join(names)})"
        )
        if better:
            shapes = ", ".join(f"{self.alphas[j]:.3g}" for j in sorted({j for _, j in better}))
            times = ", ".join(f"{self.durations[i]:.3g} s" for i in sorted({i for i, _ in better}))
            found += f"; the better ones have alpha = {shapes} and durations of {times}"
        return found + "."


def _mark(value: float, baseline: float, rounding: float = 0.0) -> Mark:
    if math.isnan(value) or math.isnan(baseline) or value == baseline:
        return Mark.EQUAL
    if math.isfinite(value - baseline) and abs(value - baseline) <= max(
        SAME * max(abs(value), abs(baseline)), rounding
    ):
        return Mark.EQUAL
    return Mark.BETTER if value < baseline else Mark.WORSE
