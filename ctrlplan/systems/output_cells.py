"""Outputs of a linear loop over short time intervals (cells), as polynomials with bounded remainders."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, matrix_balance, solve_continuous_lyapunov
from scipy.special import comb, factorial

from ctrlplan._types import Array

_DEGREE = 8
"""Degree of the polynomial of an output over a cell."""

_REMAINDER = 1e-10
"""Remainder of such a polynomial, relative to the response at the start."""

_CELLS = 3000
"""Maximum number of cells until a loop has settled."""

_SEEN = 1e-7
"""Relative size of a state direction in the limited outputs above which it is observable."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Loop x' = a x + b v + e w, y = c x + d v + f w: y in units of `scale`, w within 1."""

    a: Array
    c: Array
    e: Array
    f: Array
    equilibrium: Array  # steady state per unit reference
    gain: Array  # outputs in steady state
    low: Array
    high: Array
    middle: Array  # midpoint of the limits, or the only finite one
    labels: tuple[str, ...]
    references: tuple[str, ...]
    states: tuple[str, ...]

    @property
    def slowest(self) -> float:
        """Decay rate [1/s] of the slowest mode."""
        return float(-np.linalg.eigvals(self.a).real.max()) if self.a.size else 1.0


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells, and the outputs over each as polynomials.

    Attributes
    ----------
    ends : ndarray, shape (ncells,)
        End times [s].
    rows : ndarray, shape (ncells, noutputs, degree + 1, nstates)
        Bernstein coefficients of c exp(a t).
    needed : int
        Number of cells after which outputs that have satisfied their limits do so
        for all future times.
    """

    ends: Array
    rows: Array
    needed: int


def seen_directions(problem: Problem) -> Array:
    """Observable directions (nstates, nseen) of the state, scaled by the observability Gramian.

    In these coordinates the squared norm of a state is the integral of the
    squared free response of the outputs: it never increases.
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
    """Cells up to the time at which the loop has settled, or nearly.

    In the coordinates `seen` the norm of a free response never increases: the
    bound of an output's derivative at the start of a cell holds for all later
    times, which bounds the remainder of its Taylor polynomial. The squared norm
    of a state is its decrease until t, which the width of the limits bounds,
    plus the squared norm at t: that bounds the norm.
    """
    a, n, widths = problem.a, len(problem.a), problem.high - problem.low
    powers = [np.eye(n)]
    for _ in range(_DEGREE + 1):
        powers.append(powers[-1] @ a)
    orders = np.arange(_DEGREE + 1)
    # From powers of s in [0, 1] to the Bernstein basis, divided by factorials.
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
        # The effect of disturbances accumulates until the response has settled.
        if needed and (left <= _REMAINDER * first or not problem.e.any()):
            return Cells(np.array(ends), np.array(found), needed)


def _norm(rows: Array) -> float:
    return float(np.linalg.norm(rows, axis=1).max(initial=0.0))


def elevated(rows: Array) -> Array:
    """Degree elevation: Bernstein coefficients, along axis -2, of the same polynomials at one degree higher."""
    part = (np.arange(1, rows.shape[2]) / rows.shape[2])[:, None]
    inner = part * rows[:, :, :-1] + (1.0 - part) * rows[:, :, 1:]
    return np.concatenate([rows[:, :, :1], inner, rows[:, :, -1:]], axis=2)


def erosion(problem: Problem, cells: Cells) -> tuple[Array, Array]:
    """Largest effect of disturbances on each output: over each cell (ncells, noutputs, degree + 2), and in total.

    It is the integral of |c exp(a t) e|. The polynomial with the magnitudes of
    the Bernstein coefficients bounds the magnitude of a polynomial; their
    cumulative sums are the coefficients of the integral.
    """
    size = np.abs(cells.rows @ problem.e).sum(axis=3)
    lengths = np.diff(cells.ends, prepend=0.0)[:, None, None] / size.shape[2]
    sums = np.cumsum(np.concatenate([np.zeros_like(size[:, :, :1]), lengths * size], axis=2), axis=2)
    before = np.cumsum(sums[:, :, -1], axis=0) - sums[:, :, -1] + np.abs(problem.f).sum(axis=1)
    found = sums + before[:, :, None]
    return found, found[-1, :, -1]
