"""Least squares subject to inequalities, in a region of trust."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.optimize import linprog, lsq_linear, nnls

from ctrlplan._types import Array

_PRICE = 3e3
"""Penalty of a violation, relative to the initial sum of squares."""

_FIRST, _LARGEST, _SMALLEST = 0.1, 1.0, 1e-6
"""Maximum change of an unknown in the first step, and the largest and the smallest of these."""

_STEPS = 60
"""Maximum number of steps."""


class Problem(Protocol):
    """Terms whose squares are added, and functions that must be at least 0, of some unknowns."""

    def values(self, x: Array) -> tuple[Array, Array]:
        """Terms (nterms,) and functions (nfunctions,); ValueError where they are not defined."""

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Their derivatives (nterms, nunknowns) and (nfunctions, nunknowns)."""


def minimised(problem: Problem, x: Array, accuracy: float = 1e-5) -> tuple[Array, float]:
    """Unknowns of a local minimum of the sum of squares, and the largest violation of an inequality there.

    Gauss-Newton steps with linear inequalities, until the expected relative decrease is
    below `accuracy`. A step is accepted if it decreases the
    sum of squares plus a penalty of the violation, so that it does not lead through an
    obstacle, where the violation is bounded.

    Raises
    ------
    ValueError
        If the functions are not defined at the given unknowns.
    """
    terms, rooms = problem.values(x)
    scale = float(terms @ terms) or 1.0

    def merit(terms: Array, rooms: Array) -> float:
        return float(terms @ terms) / scale + _PRICE * max(0.0, -float(rooms.min()))

    here, reach, slopes = merit(terms, rooms), _FIRST, problem.slopes(x)
    for _ in range(_STEPS):
        step = _step(terms, rooms, *slopes, reach)
        expected = here - merit(terms + slopes[0] @ step, rooms + slopes[1] @ step)
        if not expected > accuracy * here or reach < _SMALLEST:
            break
        try:
            found = problem.values(x + step)
            there = merit(*found)
            after = problem.slopes(x + step) if there < here else slopes
        except ValueError:
            there, after = np.inf, slopes
        if there < here - 0.1 * expected:
            reach = min(2.0 * reach, _LARGEST) if there < here - 0.7 * expected else reach
            x, (terms, rooms), slopes, here = x + step, found, after, there
        else:
            reach *= 0.3
    return x, max(0.0, -float(rooms.min()))


def _step(terms: Array, rooms: Array, by_terms: Array, by_rooms: Array, reach: float) -> Array:
    """Change of the unknowns, each at most `reach`, that minimises the linearised terms.

    With the inequalities linearised, and relaxed by as much as is unavoidable.
    """
    count = by_terms.shape[1]
    near = rooms - reach * np.abs(by_rooms).sum(axis=1) < 0.0
    rooms, by_rooms = rooms[near], by_rooms[near]
    missed = 0.0
    if (rooms < 0.0).any():
        # The smallest violation within reach: minimise m subject to rooms + by_rooms d + m >= 0.
        rows = np.column_stack([-by_rooms, -np.ones(rooms.size)])
        bounds = [(-reach, reach)] * count + [(0.0, None)]
        found = linprog(np.append(np.zeros(count), 1.0), rows, rooms, bounds=bounds)
        missed = float(found.x[-1]) * (1.0 + 1e-9) + 1e-12 if found.success else -float(rooms.min())
    _, r = np.linalg.qr(np.vstack([by_terms, 1e-6 * np.linalg.norm(by_terms) / reach * np.eye(count)]))
    solved = np.linalg.solve(r, np.linalg.solve(r.T, -by_terms.T @ terms))  # the unconstrained minimum
    identity = np.eye(count)
    rows = np.vstack([by_rooms, identity, -identity])
    sides = np.concatenate([-rooms - missed, np.full(2 * count, -reach)])
    # A problem LDP of Lawson and Hanson (Solving Least Squares Problems, chapter 23) with y = r (d - solved):
    # min |y|^2 subject to rows d >= sides.
    g, h = np.linalg.solve(r.T, rows.T), sides - rows @ solved
    u = _least_squares(np.vstack([g, h]), np.append(np.zeros(count), 1.0))
    residual = np.append(g @ u, h @ u - 1.0)
    if not -residual[-1] > 0.0:
        return np.zeros(count)
    return np.asarray(np.clip(solved - np.linalg.solve(r, residual[:-1]) / residual[-1], -reach, reach))


def _least_squares(matrix: Array, right: Array) -> Array:
    """Unknowns of at least 0 with the smallest squares of ``matrix @ u - right``."""
    try:
        return np.asarray(nnls(matrix, right, maxiter=50 * matrix.shape[1])[0])
    except (RuntimeError, np.linalg.LinAlgError):  # releases of scipy that solve normal equations may not end, or fail
        return np.asarray(lsq_linear(matrix, right, (0.0, np.inf), method="bvls", tol=1e-14).x)
