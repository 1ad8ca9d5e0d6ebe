"""Exact states of a linear loop with delays between continuous blocks, by the method of steps with collocation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.common_cells import CommonCells
from ctrlplan.simulation.delayed_run import PARTS, DelayedRun, Parts
from ctrlplan.simulation.hop_cells import MARKS, solved_by_hops
from ctrlplan.simulation.sampled_form import DelayedForm
from ctrlplan.simulation.signals import TimeSignal, signal_values

_MANY, _DEARER = 2_000, 5
"""Number of parts of cells of a common length above which others are considered, and the relative cost of those."""


class DelayedMotion:
    """States and delayed signals of a loop over a run.

    Parameters
    ----------
    form : DelayedForm
        The loop.
    signals : sequence of TimeSignal
        Functions of time: inputs, then the outputs of sources and delays; those of delays are not evaluated.
    first, last : float
        Start and end of the run [s].
    state : ndarray, shape (n,)
        State at the start.

    Attributes
    ----------
    instants : ndarray
        Start of the run and sample times of the discrete blocks [s].

    Raises
    ------
    NotApplicableError
        If delays and periods have no common divisor that is long enough, and too many sums.
    SolverError
        If a state overflows.
    """

    def __init__(
        self, form: DelayedForm, signals: Sequence[TimeSignal], first: float, last: float, state: Array
    ) -> None:
        begins = np.cumsum([0, *(signal.width for signal in signals)]).tolist()
        delays = {late.columns.start for late in form.lates}
        given = [s for s, begin in zip(signals, begins, strict=False) if begin not in delays]
        self._run = DelayedRun(form, given, first, last, state)
        self.instants = self._run.instants.times
        self._parts = _solved(self._run)

    def at(self, times: Array) -> tuple[Array, Array]:
        """States (n, ntime), and functions of time (nw, ntime) with the delayed ones, at times [s] of the run."""
        run, parts, since = self._run, self._parts, times - self._run.first
        w = np.empty((run.form.b.shape[1], times.size))
        w[run.form.given] = signal_values(run.signals, times)
        for late, rows in zip(run.form.lates, run.form.rows, strict=True):
            past = since - late.delay
            known = parts.at(parts.stored[..., rows], np.maximum(past, 0.0), run.tolerance)
            w[late.columns] = np.where(past >= -run.tolerance, known, late.initial[:, None])
        return parts.at(parts.states, since, run.tolerance), w


def _solved(run: DelayedRun) -> Parts:
    """States and inputs of the delays, by the parts that cost less."""
    first = next(CommonCells.of(run), None)
    if first is None or first.count > _MANY:
        found = solved_by_hops(run, PARTS if first is None else first.count // _DEARER)
        if found is not None:
            return found
    for cells in CommonCells.of(run):
        values = cells.values(run)
        if values is not None:
            return cells.solved(run, values)
    text = ", ".join(f"{late.delay:g}" for late in run.form.lates)
    raise NotApplicableError(
        f"delays of {text} s, sample times and breakpoints of functions of time divide the run of {run.span:g} s into "
        f"more than {PARTS} parts by a common divisor, and have more than {MARKS} sums"
    )
