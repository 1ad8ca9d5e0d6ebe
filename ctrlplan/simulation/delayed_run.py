"""Run of a linear loop with delays, and its solution in parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.collocation import NODES, basis_at
from ctrlplan.simulation.instants import Instants, instants_of
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.sampled_form import DelayedForm
from ctrlplan.simulation.segments import time_tolerance, values_after
from ctrlplan.simulation.signals import TimeSignal, signal_values
from ctrlplan.trajectories.chebyshev import transform

PARTS = 100_000
"""Maximum number of parts of a run."""

_NOISE = 1e-11
"""Rounding errors of a function of time, relative to its largest value."""

Jump = tuple[Array, Array, Array]
"""Jump of the states: matrices from states and from delayed values, and a constant."""


@dataclass(frozen=True, eq=False)
class DelayedRun:
    """Run of a loop with delays. Times since the start of the run are in s.

    Attributes
    ----------
    form : DelayedForm
        The loop.
    signals : sequence of TimeSignal
        Functions of time, without the outputs of delays.
    first, last : float
        Start and end of the run [s].
    state : ndarray, shape (n,)
        State at the start.
    """

    form: DelayedForm
    signals: Sequence[TimeSignal]
    first: float
    last: float
    state: Array

    @property
    def span(self) -> float:
        """Duration [s]."""
        return self.last - self.first

    @cached_property
    def tolerance(self) -> float:
        """Difference of two times that counts as rounding [s]."""
        return time_tolerance(self.first, self.last)

    @cached_property
    def instants(self) -> Instants:
        """Start of the run and sample times of the discrete blocks."""
        return instants_of(self.form.base.timings, self.first, self.last, self.tolerance)

    def noise(self, length: float) -> float:
        """Rounding errors of a function of time, relative to its change over a part of a length [s]."""
        return _NOISE + 64.0 * np.finfo(float).eps * max(abs(self.first), abs(self.last)) / length

    def values(self, since: Array) -> Array:
        """Functions of time (..., ngiven) at times [s] since the start."""
        found = signal_values(self.signals, self.first + since.ravel())
        return np.asarray(found.T.reshape(*since.shape, self.form.given.size))

    def jumps(self, starts: Array) -> dict[int, Jump]:
        """Jumps at the starts [s] of parts, by the index of the part."""
        found = dict[int, Jump]()
        due = np.flatnonzero(self.instants.due)
        values = values_after(self.signals, self.instants.times[due], self.tolerance)
        places = np.searchsorted(starts, self.instants.times[due] - self.first + self.tolerance) - 1
        for place, k, w in zip(places.tolist(), due.tolist(), values.T, strict=True):
            jump, given = self.form.base.jump(int(self.instants.due[k]))
            found[place] = jump, given[:, self.form.delayed], given[:, self.form.given] @ w
        return found


@dataclass(frozen=True, eq=False)
class Parts:
    """States and inputs of the delays as Chebyshev series in the parts of a run.

    Attributes
    ----------
    starts, lengths : ndarray, shape (nparts,)
        Parts [s], since the start of the run.
    states, stored : ndarray, shapes (nparts, nodes, n) and (nparts, nodes, nstored)
        Coefficients.
    """

    starts: Array
    lengths: Array
    states: Array
    stored: Array

    @classmethod
    def of(cls, run: DelayedRun, starts: Array, lengths: Array, states: Array, stored: Array) -> Parts:
        """Parts from values at the nodes.

        Raises
        ------
        SolverError
            If one of them is not finite.
        """
        bad = ~(np.isfinite(states).all(axis=(1, 2)) & np.isfinite(stored).all(axis=(1, 2)))
        if bad.any():
            at = run.first + float(starts[int(bad.argmax())])
            raise SolverError(
                f"states of {run.form.base.name} must stay finite up to {run.last:g} s, got an overflow at {at:g} s"
            )
        to_series = transform(np.eye(NODES)).T
        return cls(starts, lengths, np.matmul(to_series, states), np.matmul(to_series, stored))

    def at(self, coefficients: Array, since: Array, tolerance: float) -> Array:
        """Values (nrows, ntime) of series (nparts, nodes, nrows) at times [s], on the right of the ends of parts."""
        place = np.clip(np.searchsorted(self.starts, since + tolerance, side="right") - 1, 0, None)
        x = np.clip(2.0 * (since - self.starts[place]) / self.lengths[place] - 1.0, -1.0, 1.0)
        return np.asarray(np.einsum("tjn,tj->nt", coefficients[place], basis_at(x)))
