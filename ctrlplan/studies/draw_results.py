"""Results of many draws: metrics, quantiles of signals, failures."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.studies.ensemble import LEVELS, Failure
from ctrlplan.studies.outcomes import Failed

_SAMPLES = (31, 1001)
"""Minimum and maximum number of times of the bands."""

_NUMBERS = 2**25
"""Maximum number of samples of all signals of all draws, from which the bands are computed."""

_NUMBERS_OF_DRAW = 2**13
"""Maximum number of samples of all signals of one draw."""

_COLUMNS = 64
"""Number of times whose quantiles are computed together."""

Outcome: TypeAlias = dict[str, tuple[dict[str, float], dict[str, Array]] | Failed]
"""By plan: metrics, and signals at the times of the bands; or the failure."""


class DrawResults:
    """Results of all draws.

    Parameters
    ----------
    count : int
        Number of draws.
    times : ndarray, shape (ntime,)
        Times of the bands [s].
    mixed : collection of str
        Metrics over signals in different units, which have no common maximum.
    """

    def __init__(self, count: int, times: Array, mixed: Collection[str]) -> None:
        self._mixed = mixed
        self.timepts = times
        self.finished = 0
        self._failures: list[Failure] = []
        self._metrics: dict[str, dict[str, Array]] = {}
        self._signals: dict[str, dict[str, Array]] = {}
        self._names: dict[str, dict[tuple[str, ...], int]] = {}
        self._count = count

    def add(self, k: int, params: dict[str, float], outcome: Outcome | Failed) -> None:
        """Add the outcome of one draw, in any order.

        Raises
        ------
        ValueError
            If it has other signals than those before it.
        """
        self.finished += 1
        if isinstance(outcome, Failed):
            self._failures.append(Failure(k, params, outcome.message))
            return
        messages = [found.message for found in outcome.values() if isinstance(found, Failed)]
        if len(messages) == len(outcome) and len(set(messages)) == 1:
            self._failures.append(Failure(k, params, messages[0]))
            return
        for plan, found in outcome.items():
            if isinstance(found, Failed):
                self._failures.append(Failure(k, params, found.message, plan))
                continue
            metrics, signals = found
            rows = self._signals_of(plan, k, tuple(signals))
            columns, names = self._metrics.setdefault(plan, {}), self._names.setdefault(plan, {})
            listed = tuple(metrics)
            names[listed] = min(k, names.get(listed, k))
            for name, value in metrics.items():
                if name not in columns:
                    columns[name] = np.full(self._count, np.nan)
                if name not in self._mixed:
                    columns[name][k] = value
            for name, curve in signals.items():
                rows[name][k, : curve.size] = curve

    def _signals_of(self, plan: str, k: int, names: tuple[str, ...]) -> dict[str, Array]:
        """Signals (ndraws, ntime) of all draws with a plan, those of another draw checked."""
        if plan not in self._signals:
            self._signals[plan] = {name: np.full((self._count, self.timepts.size), np.nan) for name in names}
        rows = self._signals[plan]
        if names != tuple(rows):
            raise ValueError(
                f"loop must return loops with the same outputs and controls for all draws, got {', '.join(names)} for "
                f"draw {k} and {', '.join(rows)} for others, with the plan {plan}; give outputs= and controls="
            )
        return rows

    def failures(self) -> tuple[Failure, ...]:
        """Failures in the order of the draws."""
        return tuple(sorted(self._failures, key=lambda failure: failure.draw))

    def metrics(self, expected: Mapping[str, Iterable[str]]) -> dict[str, dict[str, Array]]:
        """Metrics by plan, in the order in which the draws have them; nan and as expected where no draw has any."""
        found = {}
        for plan, without in expected.items():
            listed = sorted(self._names.get(plan, {}).items(), key=lambda one: one[1])
            names = dict.fromkeys(name for names, _ in listed for name in names)
            known = self._metrics.get(plan)
            if known is not None:
                found[plan] = {name: known[name] for name in names}
            elif without:
                found[plan] = {name: np.full(self._count, np.nan) for name in without}
        return found

    def bands(self, plans: Iterable[str]) -> dict[str, dict[str, Array]]:
        """Quantiles over the draws that ran."""
        return {
            plan: {name: _quantiles(rows) for name, rows in self._signals[plan].items()}
            for plan in plans
            if plan in self._signals
        }


def _quantiles(rows: Array) -> Array:
    """Quantiles (nlevels, ntime) over rows, which are nan after an event that ended the run."""
    out = np.full((len(LEVELS), rows.shape[1]), np.nan)
    for k in range(0, rows.shape[1], _COLUMNS):
        some = rows[:, k : k + _COLUMNS]
        known = ~np.isnan(some)
        for full in (True, False):
            columns = known.all(axis=0) if full else known.any(axis=0) & ~known.all(axis=0)
            if columns.any():
                out[:, k : k + _COLUMNS][:, columns] = _levels(some[:, columns], full)
    return out


def _levels(rows: Array, full: bool) -> Array:
    """Quantiles (nlevels, ntime) of columns; infinite between a finite and an infinite value."""
    quantile = np.quantile if full else np.nanquantile
    with np.errstate(over="ignore", invalid="ignore"):
        found = quantile(rows, LEVELS, axis=0)
        if np.isnan(found).any():  # of a diverging loop
            low, high = (quantile(rows, LEVELS, axis=0, method=method) for method in ("lower", "higher"))
            found = np.where(np.isnan(found), np.where(low == high, low, low + high), found)
    return np.asarray(found)


def band_samples(times: Array, draws: int, curves: int) -> NDArray[np.intp]:
    """Indices of the samples of the bands: fewer for many draws and for many curves of each."""
    low, high = _SAMPLES
    numbers = min(_NUMBERS_OF_DRAW, _NUMBERS // max(1, draws))
    count = min(times.size, high, max(low, numbers // max(1, curves)))
    return np.unique(np.linspace(0, times.size - 1, count).round().astype(np.intp))
