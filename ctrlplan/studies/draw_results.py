"""Results of many draws: metrics, quantiles of signals, failures."""

from __future__ import annotations

from collections.abc import Collection
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.studies.ensemble import LEVELS, Failure
from ctrlplan.studies.executing import Failed

_SAMPLES = 1001
"""Maximum number of times of the bands."""

Outcome: TypeAlias = dict[str, tuple[dict[str, float], dict[str, Array]] | Failed]
"""By plan: metrics, and signals at the times of the bands; or the failure."""


class DrawResults:
    """Results of all draws.

    Parameters
    ----------
    count : int
        Number of draws.
    times : ndarray, shape (ntime,)
        Sample times [s].
    mixed : collection of str
        Metrics over signals in different units, which have no common maximum.
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
        """Add the outcome of one draw."""
        self.finished += 1
        if isinstance(outcome, Failed):
            self.failures.append(Failure(k, params, outcome.message))
            return
        messages = [found.message for found in outcome.values() if isinstance(found, Failed)]
        if len(messages) == len(outcome) and len(set(messages)) == 1:
            self.failures.append(Failure(k, params, messages[0]))
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
        """Quantiles over the draws that ran."""
        return {plan: {name: _quantiles(rows) for name, rows in found.items()} for plan, found in self._signals.items()}


def _quantiles(rows: Array) -> Array:
    """Quantiles (nlevels, ntime) over rows, which are nan after an event that ended the run."""
    out = np.full((len(LEVELS), rows.shape[1]), np.nan)
    known = ~np.isnan(rows)
    for full in (True, False):
        columns = known.all(axis=0) if full else known.any(axis=0) & ~known.all(axis=0)
        if columns.any():
            quantile = np.quantile if full else np.nanquantile
            out[:, columns] = quantile(rows[:, columns], LEVELS, axis=0)
    return out


def band_samples(times: Array) -> NDArray[np.intp]:
    """Indices of the samples of the bands."""
    return np.unique(np.linspace(0, times.size - 1, min(times.size, _SAMPLES)).round().astype(np.intp))
