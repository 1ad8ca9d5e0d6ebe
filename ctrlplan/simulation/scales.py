"""The scale of each state, in which a numerical solver controls its error.

A position in micrometres and a force in meganewtons need absolute tolerances
that are twelve powers of ten apart. The scale of a state is its largest
displacement from its start during the run, which only a run tells: the first
one is made with scales of 1, and it is repeated where a state moves a thousand
times less, or a hundred times less than it is away from zero. A state that
moves little about an offset is integrated as its displacement from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RELATIVE = 1e-10
"""Absolute tolerance of a state in its own scale, unless a number is given."""

PASSES = 4
"""Runs at most until the scales are found."""

_SMALL = 1e-3
"""Part of the scale below which a state's displacement asks for a smaller one."""

_OFFSET = 1e-2
"""Part of a state's size below which its displacement is what is integrated."""

_NOISE = 1e11
"""Scale of a state whose rate is noise of size 1 over a run of length 1: a tenth of it is the tolerance."""

_ADDED = 0.3
"""Error of a state at the end of a run, relative to the tolerance of the run, as errors of steps add up."""

_A_STEP, _A_SEGMENT = 100.0, 4.0
"""Tolerance of a run over that of a step; or, of many segments, so many times their number."""


class Tolerances(NamedTuple):
    """Tolerances of a step, relative and in the scales of the states."""

    rtol: float
    atol: float

    @classmethod
    def of_run(cls, rtol: float, atol: float, nsegments: int, tighter: float = 1.0) -> Tolerances:
        """Of a run that restarts at every segment: the errors of all add up."""
        divisor = tighter * max(_A_STEP, _A_SEGMENT * nsegments)
        return cls(max(rtol / divisor, min(rtol, 1e-13)), atol / divisor)


@dataclass(frozen=True, eq=False)
class Scales:
    """Coordinates (x - shift)/scale of the states, and the absolute tolerance in them.

    Attributes
    ----------
    shift, scale : ndarray, shape (nstates,)
        In the units of the states.
    atol : float
        Absolute tolerance in units of the scales.
    """

    shift: Array
    scale: Array
    atol: float

    @classmethod
    def plain(cls, nstates: int, atol: float | None) -> Scales:
        """The states as they are, with a tolerance in their own units."""
        return cls(np.zeros(nstates), np.ones(nstates), RELATIVE if atol is None else atol)

    def renewed(self, states: Array, noise: Callable[[], Array]) -> Scales | None:
        """Scales that fit the states of a run; None where these do.

        Parameters
        ----------
        states : ndarray, shape (nstates, ntime)
            States of the run, the first one at its start.
        noise : callable
            Returns the rounding noise of each rate times the duration, shape
            (nstates,): a state is not followed more closely.
        """
        moved = np.abs(states - states[:, :1]).max(axis=1, initial=0.0)
        size = np.abs(states).max(axis=1, initial=0.0)
        small = (moved > 0.0) & (moved < _SMALL * self.scale)
        about = (moved > 0.0) & (moved < _OFFSET * size) & (self.shift == 0.0)
        if not (small | about).any():
            return None
        floor = _NOISE * noise()
        scale = np.where(small | about, np.maximum(moved, floor), self.scale)
        scale = np.where(scale > 0.0, scale, self.scale)
        shift = np.where(about, states[:, 0], self.shift)
        if np.all(scale >= _SMALL * self.scale) and np.array_equal(shift, self.shift):
            return None
        return Scales(shift, np.minimum(scale, np.where(small, self.scale, np.inf)), self.atol)

    def uncertainty(self, states: Array, rtol: float) -> Array:
        """Error that the states of a run are taken to have (nstates,), where errors of steps do not grow."""
        size = np.abs(states - self.shift[:, None]).max(axis=1, initial=0.0)
        return _ADDED * (rtol * size + self.atol * self.scale)


def doubt(outputs: Callable[[Array], Array], states: Array, uncertainty: Array) -> tuple[Array, Array]:
    """Uncertainty of outputs from that of the states, and the outputs' ranges, shapes (noutputs,).

    Parameters
    ----------
    outputs : callable
        Maps states (nstates, npoints) at some times to outputs (noutputs, npoints).
    states : ndarray, shape (nstates, npoints)
        States there.
    uncertainty : ndarray, shape (nstates,)
        Of the states.
    """
    plain = outputs(states)
    total = np.zeros(plain.shape)
    with np.errstate(all="ignore"):
        for i, error in enumerate(uncertainty.tolist()):
            # A step that is large beside rounding, and small beside what bends the outputs.
            step = max(error, 1e-7 * float(np.abs(states[i]).max(initial=0.0))) or 1.0
            near = states.copy()
            near[i] += step
            total += np.abs(outputs(near) - plain) * (error / step)
    worst = np.where(np.isfinite(total), total, 0.0).max(axis=1, initial=0.0)
    return worst, np.ptp(plain, axis=1) if plain.shape[1] else np.zeros(len(plain))
