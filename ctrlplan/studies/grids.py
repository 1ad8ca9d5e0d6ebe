"""One number of trigonometric plans over alpha and duration, compared with that of their baselines."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctrlplan._types import Array
from ctrlplan.studies.units import ROUNDING

SAME = 1e-3
"""Relative difference up to which values count as equal."""

Mark = Literal["", "win", "lose"]
"""Whether a plan is better than every baseline, worse than the best of them, or neither."""


@dataclass(frozen=True)
class Grid:
    """One number of trigonometric plans over alpha and duration, beside that of their rivals.

    Attributes
    ----------
    title, unit : str
        What it is; less is better.
    durations : ndarray, shape (ndurations,)
        Of the plans [s].
    alphas : ndarray, shape (nalphas,)
        Shape parameters [rad].
    values : ndarray, shape (ndurations, nalphas)
        Of the trigonometric plans.
    rivals : dict of str to ndarray, shape (ndurations,)
        Of the others by name.
    beside : tuple of str
        Rivals that are shown but do not count: steps, which keep no limit, or
        a bound that no plan can reach.
    scale : float
        Size of the number, of which a millionth is rounding; 0 where it is not
        known.
    """

    title: str
    unit: str
    durations: Array
    alphas: Array
    values: Array
    rivals: dict[str, Array]
    beside: tuple[str, ...] = ()
    scale: float = 0.0

    def best(self, row: int) -> tuple[str, float]:
        """Rival that does best at one of the durations, and its value; nan where none has one."""
        able = {name: values for name, values in self.rivals.items() if name not in self.beside}
        found = {name: float(values[row]) for name, values in able.items() if not math.isnan(values[row])}
        name = min(found, key=lambda rival: found[rival], default="none")
        return name, found.get(name, math.nan)

    def marks(self) -> list[list[Mark]]:
        """Whether each trigonometric plan wins against its best rival, loses, or neither: "win", "lose", ""."""
        return [
            [_mark(value, self.best(row)[1], ROUNDING * self.scale) for value in values]
            for row, values in enumerate(self.values.tolist())
        ]

    @property
    def verdict(self) -> str:
        """How often trigonometric plans win and lose, in a sentence."""
        if np.isnan([self.best(i)[1] for i in range(self.durations.size)]).all():
            return f"{self.title}: there is nothing to compare."
        marks = self.marks()
        cells = [(i, j) for i in range(len(marks)) for j in range(self.alphas.size) if self.alphas[j] > 0.0]
        wins = [(i, j) for i, j in cells if marks[i][j] == "win"]
        losses = sum(marks[i][j] == "lose" for i, j in cells)
        names = list(dict.fromkeys(self.best(i)[0] for i in range(self.durations.size)))
        found = f"{self.title}: of {len(cells)} trigonometric plans {len(wins)} win and {losses} lose"
        found += f" against the best rival ({', '.join(names)})"
        if wins:
            shapes = ", ".join(f"{self.alphas[j]:.3g}" for j in sorted({j for _, j in wins}))
            times = ", ".join(f"{self.durations[i]:.3g} s" for i in sorted({i for i, _ in wins}))
            found += f"; they win at alpha = {shapes} in {times}"
        return found + "."


def _mark(value: float, rival: float, rounding: float = 0.0) -> Mark:
    if math.isnan(value) or math.isnan(rival) or value == rival:
        return ""
    if math.isfinite(value - rival) and abs(value - rival) <= max(SAME * max(abs(value), abs(rival)), rounding):
        return ""
    return "win" if value < rival else "lose"
