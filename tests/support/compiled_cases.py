"""Runs and signals that several files on compiled loops use."""

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

METHODS = ("compiled", "python")


def tight(rate, times, initial, breaks=(), solver="DOP853"):
    """States of x' = rate(t, x) near rounding, from break to break; a time at a break belongs to the leg before it."""
    state, rows = np.asarray(initial, dtype=float), []
    edges = [times[0], *sorted(b for b in breaks if times[0] < b < times[-1]), times[-1]]
    for left, right in pairwise(edges):
        inside = times[(times >= left) & (times < right)]
        # Never at the break itself, where the next leg's function holds.
        below = right - 1e-13 * max(1.0, abs(right))
        run = solve_ivp(
            lambda t, x, below=below: rate(min(t, below), x),
            (left, right),
            state,
            method=solver,
            rtol=1e-12,
            atol=1e-12,
            t_eval=np.append(inside, right),
        )
        assert run.success
        rows.append(run.y[:, : inside.size])
        state = run.y[:, -1]
    return np.column_stack([*rows, state])


T = np.unique(np.concatenate([np.linspace(0.0, 8.0, 33), [1.0, 3.0]]))
