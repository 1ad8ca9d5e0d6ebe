"""The scale of each state, in which a numerical solver controls its error.

A position in micrometres and a force in meganewtons need absolute tolerances
that are twelve powers of ten apart. The scale of a state is its largest
displacement from its start during the run, which only a run tells: the first
one is made with scales of 1, and it is repeated where a state moves a thousand
times less, or a hundred times less than it is away from zero. A state that
moves little about an offset is integrated as its displacement from there.

An angle of thousands of turns is accurate to a small part of itself, and a
position that depends on its sine is then not. Where the slopes of the rates at
some states of a run show that the tolerated error of one state displaces
another by more than is tolerated there, the run is repeated with a thousandth
of the relative tolerance, of that state alone where the solver has tolerances
by state; how far the two runs are apart tells the error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array

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

_CLOSER = 1e-3
"""Part of the relative tolerance with which large states are integrated that others depend on absolutely."""

_OWN = 0.1
"""Scale of such a state at most, as a part of its size."""

_FOLLOWED = 0.02
"""Error of a run with the smaller tolerance, over that of the run before it; rounding besides."""

_A_STEP, _A_SEGMENT = 100.0, 4.0
"""Tolerance of a run over that of a step; or, of many segments, so many times their number."""


class Tolerances(NamedTuple):
    """Tolerances of a step: relative, shape (nstates,), and in the scales of the states."""

    rtol: Array
    atol: float

    @classmethod
    def of_run(cls, rtol: float, scales: Scales, nsegments: int, tighter: float = 1.0) -> Tolerances:
        """Of a run that restarts at every segment: the errors of all add up."""
        divisor = tighter * max(_A_STEP, _A_SEGMENT * nsegments)
        return cls(np.maximum(rtol * scales.relative / divisor, min(rtol, 1e-13)), scales.atol / divisor)


@dataclass(frozen=True, eq=False)
class Scales:
    """Coordinates (x - shift)/scale of the states, and the absolute tolerance in them.

    Attributes
    ----------
    shift, scale : ndarray, shape (nstates,)
        In the units of the states.
    atol : float
        Absolute tolerance in units of the scales.
    relative : ndarray, shape (nstates,)
        Part of the relative tolerance that is used.
    """

    shift: Array
    scale: Array
    atol: float
    relative: Array

    @classmethod
    def plain(cls, nstates: int, atol: float | None) -> Scales:
        """The states as they are, with a tolerance in their own units."""
        return cls(np.zeros(nstates), np.ones(nstates), RELATIVE if atol is None else atol, np.ones(nstates))

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
        return replace(self, shift=shift, scale=np.minimum(scale, np.where(small, self.scale, np.inf)))

    def uncertainty(self, states: Array, rtol: float) -> Array:
        """Error that the states of a run are taken to have (nstates,), where errors of steps do not grow."""
        size = np.abs(states - self.shift[:, None]).max(axis=1, initial=0.0)
        return _ADDED * (rtol * self.relative * size + self.atol * self.scale)

    def with_closer_states(self, states: Array, loose: NDArray[np.bool_], noise: Array, by_state: bool) -> Scales:
        """Scales with which large states that others depend on absolutely are integrated more closely.

        Parameters
        ----------
        states : ndarray, shape (nstates, ntime)
            States of a run.
        loose : ndarray of bool, shape (nstates,)
            States whose relative tolerance was too large for others.
        noise : ndarray, shape (nstates,)
            Rounding noise of each rate times the duration.
        by_state : bool
            Whether the solver has relative tolerances by state; otherwise all get the smaller one.
        """
        size = np.abs(states - self.shift[:, None]).max(axis=1, initial=0.0)
        close = np.where(loose & (size > 0.0), np.maximum(_OWN * size, _NOISE * noise), np.inf)
        scale = np.minimum(self.scale, close)
        return replace(self, scale=scale, relative=np.where(loose | (not by_state), _CLOSER, self.relative))


def output_uncertainty(outputs: Callable[[Array], Array], states: Array, uncertainty: Array) -> tuple[Array, Array]:
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


def effects(slopes: Array, duration: float) -> Array:
    """Largest displacement of each state by a lasting one of another, of size 1, shape (nstates, nstates).

    Parameters
    ----------
    slopes : ndarray, shape (npoints, nstates, nstates)
        Derivatives of the rates by the states at points of a run.
    duration : float
        Of the run [s].

    Notes
    -----
    With x' = J x + e/T, an error that builds up to e in the duration T, and J as
    at one point, the mean of x weighted by exp(-t/T) is (I - T J)^-1 e. Growth
    is left out: J is shifted so that no motion grows.
    """
    n = slopes.shape[1]
    slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]
    growth = np.maximum(np.linalg.eigvals(slopes).real.max(axis=1, initial=0.0), 0.0)
    matrices = (1.0 + duration * growth)[:, None, None] * np.eye(n) - duration * slopes
    found: Array = np.abs(np.linalg.solve(matrices, np.broadcast_to(np.eye(n), matrices.shape))).max(
        axis=0, initial=0.0
    )
    np.fill_diagonal(found, 0.0)
    return found


def remaining(apart: Array, states: Array, loose: NDArray[np.bool_], evaluations: int) -> float:
    """Error of a run over its distance from the run before it, which was made with larger tolerances.

    Parameters
    ----------
    apart : ndarray, shape (nstates,)
        Largest distance of each state between the runs.
    states : ndarray, shape (nstates, ntime)
        States of the run.
    loose : ndarray of bool, shape (nstates,)
        States that were integrated more closely.
    evaluations : int
        Evaluations of the right-hand side: each rounds the states.
    """
    size = np.abs(states).max(axis=1, initial=0.0)
    rounding = 0.25 * np.finfo(float).eps * size * evaluations
    parts = rounding[loose] / np.maximum(apart[loose], np.finfo(float).tiny)
    return float(min(1.0, _FOLLOWED + parts.max(initial=0.0)))
