"""Runs and states at which a compiled form is compared with Python."""

from __future__ import annotations

import random

import numpy as np
from numpy.typing import NDArray

from ctrlplan._lru import BUILDING
from ctrlplan._types import Array

_FEW = 4
"""Number of changes of each switch with priority over the peaks of the signals."""

_ENOUGH = 12
"""Number of states that are compared without switches, plus one for each signal."""


class Compared:
    """Record of the runs, and sides of switches, in which a form has been compared.

    A form is compared in its first two runs, in one random run of the next two,
    of the next four, and so on, and in any run on a new side of a switch.
    """

    def __init__(self, nswitches: int) -> None:
        self._seen = np.zeros((3, nswitches), dtype=bool)
        self._runs, self._next = 0, 1  # number of runs so far, and of the next comparison
        self._chance = random.Random(0)

    @property
    def is_expected(self) -> bool:
        """Whether the next run is to be compared on any side of its switches."""
        return self._runs + 1 >= self._next

    def is_due(self, sides: Array) -> bool:
        """Whether to compare a run on these sides (nswitches, ntime) of its switches."""
        lowest, highest = (extreme.reduce(sides, axis=1, initial=np.nan) for extreme in (np.fmin, np.fmax))
        reached = np.array([lowest < 0.0, (sides == 0.0).any(axis=1), highest > 0.0])
        with BUILDING:
            self._runs += 1
            fresh = bool((reached & ~self._seen).any())
            self._seen |= reached
            if self._runs < self._next:
                return fresh
            first = 1 << (self._runs - 1).bit_length()
            self._next = first + 1 + self._chance.randrange(first)
            return True


def telling_states(sides: Array, signals: Array, count: int) -> NDArray[np.intp]:
    """Samples of a run at which an error of a form is likely, in order of time.

    Parameters
    ----------
    sides : ndarray, shape (nswitches, ntime)
        Signs of the switches' arguments.
    signals : ndarray, shape (nsignals, ntime)
        Signals and states.
    count : int
        Maximum number of samples.

    Returns
    -------
    ndarray of int
        Both sides of changes of switches, the first change of every switch
        before any second one; maxima and minima of signals; some evenly spaced.
    """
    ntime = signals.shape[1]
    switch, before = np.nonzero(sides[:, 1:] != sides[:, :-1])
    rank = np.arange(switch.size) - np.searchsorted(switch, switch)
    order = np.argsort(rank, kind="stable")
    changes = np.column_stack([before, before + 1])[order].ravel()
    early = 2 * int((rank < _FEW).sum())
    peaks = np.concatenate([signals.argmax(axis=1), signals.argmin(axis=1)])
    enough = _ENOUGH + len(signals)
    count = min(count, changes.size + enough)
    spread = np.concatenate([np.linspace(0, ntime - 1, enough).astype(int), np.arange(min(ntime, 2 * enough))])
    places = np.concatenate([[0, ntime - 1], changes[:early], peaks, changes[early:], spread])
    _, first = np.unique(places, return_index=True)
    return np.sort(places[np.sort(first)[:count]].astype(np.intp))
