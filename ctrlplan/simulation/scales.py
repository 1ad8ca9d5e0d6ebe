"""Scales of the states for the error control of a numerical solver.

A position in micrometres and a force in meganewtons require absolute tolerances
that differ by twelve orders of magnitude. The scale of a state is its largest
displacement from its initial value, which is known only after a run: the first
run has scales of 1 and is repeated if a state moves by less than 1e-3, or by less
than 1 % of its magnitude. A state with small motion about an offset is integrated
as its displacement from there.

The relative error of an angle of thousands of turns can be small although that of
a position that depends on its sine is not. If the Jacobian at some states of a run
shows that the tolerated error of one state displaces another by more than its
tolerance, the run is repeated with a thousandth of the relative tolerance, of that
state alone if the solver has tolerances by state; the difference of the two runs
is an estimate of the error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array

RELATIVE = 1e-10
"""Default absolute tolerance of a state, relative to its scale."""

PASSES = 4
"""Maximum number of runs until the scales are found."""

_SMALL = 1e-3
"""Fraction of the scale below which the displacement of a state requires a smaller scale."""

_OFFSET = 1e-2
"""Fraction of the magnitude of a state below which its displacement is integrated instead."""

_NOISE = 1e11
"""Minimum scale of a state relative to the rounding errors of its derivative times the duration."""

_PASSED_ON = 1e-3
"""Minimum scale of a state relative to what the scales of others displace it by: their errors prevent smaller ones."""

_ADDED = 0.3
"""Accumulated error of a state at the end of a run, relative to the tolerance of the run."""

_CLOSER = 1e-3
"""Fraction of the relative tolerance for large states whose absolute error affects others."""

_STEPS = 1000
"""Evaluations of a run above which its other states are integrated more closely as well: errors of steps accumulate."""

_OWN = 0.1
"""Maximum scale of such a state, relative to its magnitude."""

_FOLLOWED = 0.02
"""Error of a run with the smaller tolerance relative to that of the run before it, without rounding."""

_A_STEP, _A_SEGMENT = 100.0, 4.0
"""Ratio of the tolerances of a run and a step: the first, or the second times the number of segments."""


class Tolerances(NamedTuple):
    """Tolerances of a step: relative, shape (nstates,), and absolute in the scales of the states."""

    rtol: Array
    atol: float

    @classmethod
    def of_run(cls, rtol: float, scales: Scales, nsegments: int, tighter: float = 1.0) -> Tolerances:
        """Tolerances of a step for a run that restarts at every segment, where errors accumulate."""
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
        Factors of the relative tolerance.
    unresolved : ndarray of bool, shape (nstates,)
        States whose displacement in the run before was below its absolute tolerance.
    """

    shift: Array
    scale: Array
    atol: float
    relative: Array
    unresolved: NDArray[np.bool_]

    @classmethod
    def plain(cls, nstates: int, atol: float | None) -> Scales:
        """Unscaled states, with a tolerance in their units."""
        ones = np.ones(nstates)
        return cls(np.zeros(nstates), ones, RELATIVE if atol is None else atol, ones, np.zeros(nstates, dtype=bool))

    def renewed(
        self,
        states: Array,
        moving: NDArray[np.intp],
        noise: Callable[[], Array],
        passed_on: Callable[[Array], Array],
    ) -> Scales | None:
        """Scales for the states of a run; None if the present ones are adequate.

        A state below the tolerances of two runs, although that of the second was set
        for it, is zero but for the errors of the solver: its scale remains.

        Parameters
        ----------
        states : ndarray, shape (nstates, ntime)
            States of the run, from its start.
        moving : ndarray of int
            States that are integrated; the scales of others do not matter.
        noise : callable
            Returns the rounding error of each derivative times the duration, shape
            (nstates,): a lower bound of the tolerances.
        passed_on : callable
            Maps errors of the states to those that they cause in others, shapes
            (nstates,). A state that others hold at zero moves by their errors only,
            which become smaller in each run.
        """
        moved = np.abs(states - states[:, :1]).max(axis=1, initial=0.0)
        size = np.abs(states).max(axis=1, initial=0.0)
        unresolved = moved < self.atol * self.scale
        moves = np.zeros(len(states), dtype=bool)
        moves[moving] = True
        real = (moved > 0.0) & ~(unresolved & self.unresolved) & moves
        small = real & (moved < _SMALL * self.scale)
        about = real & (moved < _OFFSET * size) & (self.shift == 0.0)
        if not (small | about).any():
            return None
        found = np.maximum(moved, _NOISE * noise())
        known = np.where(self.scale < 1.0, self.scale, np.minimum(moved, self.scale))  # of a run before, or of this one
        others = _PASSED_ON * passed_on(np.where(small | about, found, known))
        scale = np.where(small | about, np.maximum(found, others), self.scale)
        scale = np.where(scale > 0.0, scale, self.scale)
        shift = np.where(about, states[:, 0], self.shift)
        if np.all(scale >= _SMALL * self.scale) and np.array_equal(shift, self.shift):
            return None
        scale = np.minimum(scale, np.where(small, self.scale, np.inf))
        return replace(self, shift=shift, scale=scale, unresolved=unresolved)

    def with_sampled(self, states: Array, moving: NDArray[np.intp]) -> Scales:
        """Scales in which those of states that are not integrated are their displacements in a run."""
        scale = np.abs(states - states[:, :1]).max(axis=1, initial=0.0)
        scale[moving] = self.scale[moving]
        return replace(self, scale=scale)

    def perturbed(self, states: Array, rtol: Array | float, atol: float) -> Array:
        """States (nstates, ntime) moved by the tolerance of a step, up and down in turn."""
        relative = np.reshape(np.asarray(rtol, dtype=float), (-1, 1))
        step = relative * np.abs(states - self.shift[:, None]) + atol * self.scale[:, None]
        return np.asarray(states + in_turn(states.shape) * (step + 4.0 * np.spacing(np.abs(states))))

    def uncertainty(self, states: Array, rtol: float) -> Array:
        """Estimated error (nstates,) of the states of a run if errors do not grow."""
        size = np.abs(states - self.shift[:, None]).max(axis=1, initial=0.0)
        return _ADDED * (rtol * self.relative * size + self.atol * self.scale)

    def closer(self) -> Scales:
        """Scales with the smaller relative tolerance for all states."""
        return replace(self, relative=np.full_like(self.relative, _CLOSER))

    def with_closer_states(
        self, states: Array, loose: NDArray[np.bool_], noise: Array, evaluations: int | None
    ) -> Scales:
        """Scales with tighter tolerances for large states whose absolute error affects others.

        Parameters
        ----------
        states : ndarray, shape (nstates, ntime)
            States of a run.
        loose : ndarray of bool, shape (nstates,)
            States whose relative tolerance is too large for others.
        noise : ndarray, shape (nstates,)
            Rounding error of each derivative times the duration.
        evaluations : int or None
            Evaluations of the run, if the solver has relative tolerances by state; otherwise all states get the
            smaller one.
        """
        size = np.abs(states - self.shift[:, None]).max(axis=1, initial=0.0)
        loose = loose & (size > self.atol * self.scale)
        close = np.where(loose, np.maximum(_OWN * size, _NOISE * noise), np.inf)
        scale = np.minimum(self.scale, close)
        others = max(_CLOSER, min(1.0, _STEPS / (evaluations or 1)))
        return replace(self, scale=scale, relative=np.where(loose | (evaluations is None), _CLOSER, others))


def in_turn(shape: tuple[int, ...]) -> Array:
    """Signs of neighbouring entries that differ."""
    return np.asarray(2.0 * (np.indices(shape).sum(axis=0) % 2) - 1.0)


def rounding_of(rates: Callable[[Array], Array], states: Array) -> Array:
    """Largest change (nstates,) of derivatives by the last digits of states (nstates, npoints)."""
    rng = np.random.default_rng(0)
    plain, found = rates(states), np.zeros(len(states))
    for _ in range(3):
        apart = np.abs(rates(states * (1.0 + np.finfo(float).eps * rng.choice([-1.0, 1.0], states.shape))) - plain)
        found = np.maximum(found, np.where(np.isfinite(apart), apart, 0.0).max(axis=1, initial=0.0))
    return np.asarray(found)


def output_uncertainty(
    outputs: Callable[[Array], Array], states: Array, uncertainty: Array, moving: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Uncertainty of outputs from that of the states, and the outputs' ranges, shapes (noutputs,).

    Parameters
    ----------
    outputs : callable
        Maps states (nstates, n npoints), n times those at some times, to outputs (noutputs, n npoints).
    states : ndarray, shape (nstates, npoints)
        States at these times.
    uncertainty : ndarray, shape (nstates,)
        Uncertainty of the states.
    moving : ndarray of int
        States whose effects are added; those of all others, the memories of
        sampled blocks, are found together.
    """
    others = np.delete(np.arange(len(states)), moving)
    groups, factors = [*moving[:, None], *([others] if others.size else [])], list[float]()
    near = [states]
    with np.errstate(all="ignore"):
        for rows in groups:
            error = uncertainty[rows]
            # Steps large compared with rounding and small compared with the curvature of the outputs.
            large = 1e-7 * np.abs(states[rows]).max(axis=1, initial=0.0)
            factors.append(float(np.max(large / error, initial=1.0, where=error > 0.0)))
            near.append(states.copy())
            near[-1][rows] += factors[-1] * error[:, None]
        plain, *found = np.split(outputs(np.concatenate(near, axis=1)), len(near), axis=1)
        parts = [np.abs(displaced - plain) / factor for displaced, factor in zip(found, factors, strict=True)]
        total = np.sum([np.zeros(plain.shape), *parts], axis=0)
    worst = np.where(np.isfinite(total), total, 0.0).max(axis=1, initial=0.0)
    return worst, np.ptp(plain, axis=1) if plain.shape[1] else np.zeros(len(plain))


def growth_rates(slopes: Array) -> Array:
    """Largest growth rates (npoints,), at least 0, by Jacobians (npoints, nstates, nstates); nan where not finite."""
    finite = np.isfinite(slopes).all(axis=(1, 2))
    found = np.full(len(slopes), np.nan)
    found[finite] = np.maximum(np.linalg.eigvals(slopes[finite]).real.max(axis=1, initial=0.0), 0.0)
    return found


def effects(slopes: Array, duration: float, growth: Array | None = None) -> Array:
    """Largest displacement of each state by a unit error of another, shape (nstates, nstates).

    Parameters
    ----------
    slopes : ndarray, shape (npoints, nstates, nstates)
        Jacobians by the states at points of a run.
    duration : float
        Duration of the run [s].
    growth : ndarray, shape (npoints,), optional
        Their `growth_rates`, if these are known.

    Notes
    -----
    For x' = J x + e/T, an error that accumulates to e over the duration T, with J
    at one point, the mean of x weighted by exp(-t/T) is (I - T J)^-1 e. Growth is
    excluded: J is shifted so that no mode grows.
    """
    n = slopes.shape[1]
    growth = growth_rates(slopes) if growth is None else growth
    finite = np.isfinite(growth)
    matrices = (1.0 + duration * growth[finite])[:, None, None] * np.eye(n) - duration * slopes[finite]
    found: Array = np.abs(np.linalg.inv(matrices)).max(axis=0, initial=0.0)
    np.fill_diagonal(found, 0.0)
    return found


def remaining(apart: Array, states: Array, loose: NDArray[np.bool_], evaluations: int) -> float:
    """Error of a run relative to its difference from the previous run with larger tolerances.

    Parameters
    ----------
    apart : ndarray, shape (nstates,)
        Largest difference of each state between the runs.
    states : ndarray, shape (nstates, ntime)
        States of the run.
    loose : ndarray of bool, shape (nstates,)
        States with tighter tolerances.
    evaluations : int
        Evaluations of the right-hand side, each with rounding of the states.
    """
    size = np.abs(states).max(axis=1, initial=0.0)
    rounding = 0.25 * np.finfo(float).eps * size * evaluations
    parts = rounding[loose] / np.maximum(apart[loose], np.finfo(float).tiny)
    return float(min(1.0, _FOLLOWED + parts.max(initial=0.0)))
