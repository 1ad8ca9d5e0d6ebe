"""Outputs of a linear loop over cells of time, as polynomials with bounded remainders."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, matrix_balance, solve_continuous_lyapunov
from scipy.special import comb, factorial

from ctrlplan._types import Array

_DEGREE = 8
"""Of the polynomials that outputs are over a cell of time."""

_REMAINDER = 1e-10
"""What such a polynomial leaves, relative to the motion at the start."""

_CELLS = 3000
"""Cells after which a loop must have come to rest."""

_SEEN = 1e-7
"""Relative size of what limited outputs show of a direction of the state, from which on it counts."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Loop x' = a x + b v + e w, y = c x + d v + f w: y in units of `scale`, w within 1."""

    a: Array
    c: Array
    e: Array
    f: Array
    equilibrium: Array  # state at rest, by the reference
    gain: Array  # outputs at rest
    low: Array
    high: Array
    middle: Array  # between limits, or near the only one
    labels: tuple[str, ...]
    references: tuple[str, ...]
    states: tuple[str, ...]

    @property
    def slowest(self) -> float:
        """Rate [1/s] at which the slowest motion dies out."""
        return float(-np.linalg.eigvals(self.a).real.max()) if self.a.size else 1.0


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of time, and over each the outputs as polynomials.

    Attributes
    ----------
    ends : ndarray, shape (ncells,)
        Where they end [s].
    rows : ndarray, shape (ncells, noutputs, degree + 1, nstates)
        Bernstein coefficients of c exp(a t).
    needed : int
        Those after which outputs that have kept their limits keep them for ever.
    """

    ends: Array
    rows: Array
    needed: int


def seen_directions(problem: Problem) -> Array:
    """Directions (nstates, nseen) of the state that the limited outputs show, as long as they show as much.

    They are coordinates in which the norm of a state is what the outputs' free
    motion from there amounts to, the integral of its square: it never grows.
    """
    if not problem.a.size:
        return np.zeros((0, 0))
    balanced, scaling = matrix_balance(problem.a, permute=False)
    c = problem.c @ scaling
    size, directions = np.linalg.eigh(solve_continuous_lyapunov(balanced.T, -c.T @ c))
    length = np.sqrt(np.maximum(size, 0.0))
    shown = length > _SEEN * length.max(initial=0.0)
    return np.asarray(scaling @ (directions[:, shown] / length[shown]))


def output_cells(problem: Problem, seen: Array, margin: float) -> Cells:
    """Cells up to where the loop is at rest, or nearly.

    In the coordinates `seen` no free motion grows: a derivative of an output is
    nowhere later larger than it may be at the beginning of a cell, which bounds
    what its Taylor polynomial leaves. The square of a state's size is what it
    loses until t, no more than limits are wide, and what is left then: that
    bounds the size.
    """
    a, n, widths = problem.a, len(problem.a), problem.high - problem.low
    powers = [np.eye(n)]
    for _ in range(_DEGREE + 1):
        powers.append(powers[-1] @ a)
    orders = np.arange(_DEGREE + 1)
    # From powers of s in [0, 1] to Bernstein's polynomials, divided by factorials.
    basis = np.tril(comb(orders[:, None], orders) / comb(_DEGREE, orders)) / factorial(orders)
    moved, back, t, needed = np.eye(n), np.linalg.pinv(seen), 0.0, 0
    first = _norm(problem.c @ seen)
    ends: list[float] = []
    found: list[Array] = []
    while True:
        if len(ends) == _CELLS:
            raise ValueError(
                "time constants of the loop must not be too far apart, got a free response that has not settled after "
                f"{_CELLS} intervals of the fastest, {t:.3g} s"
            )
        bend = _norm(problem.c @ powers[-1] @ moved @ seen)
        h = (_REMAINDER * first * factorial(_DEGREE + 1) / bend) ** (1.0 / (_DEGREE + 1)) if bend else math.inf
        h = min(h, 1.0 / problem.slowest)
        series = np.stack([power * h**k for k, power in enumerate(powers[:-1])])
        found.append(np.einsum("ij,jpn->pin", basis, (problem.c @ series) @ moved))
        moved, t = expm(a * h) @ moved, t + h
        ends.append(t)
        left = _norm(problem.c @ moved @ seen)
        if not needed:
            decrease = 1.0 - np.linalg.norm(back @ moved @ seen, 2) ** 2 if seen.size else 1.0
            if decrease > 0.0 and left * math.sqrt(t * float(widths @ widths) / decrease) <= margin:
                needed = len(ends)
        # Disturbances add up until nothing moves.
        if needed and (left <= _REMAINDER * first or not problem.e.any()):
            return Cells(np.array(ends), np.array(found), needed)


def _norm(rows: Array) -> float:
    return float(np.linalg.norm(rows, axis=1).max(initial=0.0))


def elevated(rows: Array) -> Array:
    """Bernstein coefficients, along the last axis but one, of the same polynomials at a degree one higher."""
    part = (np.arange(1, rows.shape[2]) / rows.shape[2])[:, None]
    inner = part * rows[:, :, :-1] + (1.0 - part) * rows[:, :, 1:]
    return np.concatenate([rows[:, :, :1], inner, rows[:, :, -1:]], axis=2)


def erosion(problem: Problem, cells: Cells) -> tuple[Array, Array]:
    """What disturbances can make of each output: over each cell, (ncells, noutputs, degree + 2), and in all.

    It is the integral of the size of c exp(a t) e. A polynomial is nowhere
    larger than the one whose Bernstein coefficients are the sizes of its own,
    and these add up to the coefficients of the integral.
    """
    size = np.abs(cells.rows @ problem.e).sum(axis=3)
    lengths = np.diff(cells.ends, prepend=0.0)[:, None, None] / size.shape[2]
    sums = np.cumsum(np.concatenate([np.zeros_like(size[:, :, :1]), lengths * size], axis=2), axis=2)
    before = np.cumsum(sums[:, :, -1], axis=0) - sums[:, :, -1] + np.abs(problem.f).sum(axis=1)
    found = sums + before[:, :, None]
    return found, found[-1, :, -1]
