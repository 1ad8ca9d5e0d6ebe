"""What of many draws is kept: metrics, quantiles of signals, and failures."""

from __future__ import annotations

from collections.abc import Collection
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.studies.ensemble import LEVELS, Failure
from ctrlplan.studies.executing import Failed

_SAMPLES = 1001
"""Times at which bands are kept, at most."""

Outcome: TypeAlias = dict[str, tuple[dict[str, float], dict[str, Array]] | Failed]
"""By plan: metrics, and signals at the times of the bands; or what went wrong."""


class DrawResults:
    """What of all draws is kept.

    Parameters
    ----------
    count : int
        Number of draws.
    times : ndarray, shape (ntime,)
        Sample times [s].
    mixed : collection of str
        Metrics of signals that differ in unit, of which there is no worst.
    """

    def __init__(self, count: int, times: Array, mixed: Collection[str]) -> None:
        self._mixed = mixed
        self.timepts = times[band_samples(times)]
        self.metrics: dict[str, dict[str, Array]] = {}
        self.failures: list[Failure] = []
        self.finished = 0
        self._signals: dict[str, dict[str, Array]] = {}
        self._count = count

    def add(self, k: int, params: dict[str, float], outcome: Outcome | Failed) -> None:
        """One draw, or what went wrong with it."""
        self.finished += 1
        if isinstance(outcome, Failed):
            self.failures.append(Failure(k, params, outcome.message))
            return
        wrong = [found.message for found in outcome.values() if isinstance(found, Failed)]
        if len(wrong) == len(outcome) and len(set(wrong)) == 1:
            self.failures.append(Failure(k, params, wrong[0]))
            return
        for plan, found in outcome.items():
            if isinstance(found, Failed):
                self.failures.append(Failure(k, params, found.message, plan))
                continue
            metrics, signals = found
            for name, value in metrics.items():
                column = self.metrics.setdefault(plan, {}).setdefault(name, np.full(self._count, np.nan))
                column[k] = np.nan if name in self._mixed else value
            for name, curve in signals.items():
                known = self._signals.setdefault(plan, {})
                if name not in known:
                    known[name] = np.full((self._count, self.timepts.size), np.nan)
                known[name][k, : curve.size] = curve

    def bands(self) -> dict[str, dict[str, Array]]:
        """Quantiles over the draws that were run."""
        return {plan: {name: _quantiles(rows) for name, rows in found.items()} for plan, found in self._signals.items()}


def _quantiles(rows: Array) -> Array:
    """Quantiles (nlevels, ntime) over rows, of which those that an event ended are nan from there on."""
    out = np.full((len(LEVELS), rows.shape[1]), np.nan)
    known = ~np.isnan(rows)
    for full in (True, False):
        columns = known.all(axis=0) if full else known.any(axis=0) & ~known.all(axis=0)
        if columns.any():
            quantile = np.quantile if full else np.nanquantile
            out[:, columns] = quantile(rows[:, columns], LEVELS, axis=0)
    return out


def band_samples(times: Array) -> NDArray[np.intp]:
    """Samples at which bands are kept."""
    return np.unique(np.linspace(0, times.size - 1, min(times.size, _SAMPLES)).round().astype(np.intp))
