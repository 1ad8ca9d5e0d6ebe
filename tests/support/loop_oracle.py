"""Response of a linear loop to a polynomial plan, by scipy's matrix exponential of loop and plan together."""

from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag, expm

import ctrlplan as cp
from ctrlplan import Waypoint

ORDER = 8
"""Highest derivative of the plans."""


def responses(loop, plan, durations, steps=1500, tail=3000, spacing=0.05):
    """Values (ndurations, noutputs, ntime) of x' = a x + sum_k b[k] r^(k), y = c x + sum_k d[k] r^(k), for durations.

    `loop` is (a, b, c, d), b (order + 1, n, naxes), d (order + 1, noutputs, naxes). One sample before the plan, steps
    + 1 in each segment, then `tail` at multiples of spacing/|largest pole|, and the final value.
    """
    a, b, c, d = loop
    durations = np.asarray(durations, dtype=float)
    count, n, naxes = durations.size, len(a), plan.naxes
    state = np.broadcast_to(np.linalg.solve(a, -b[0] @ plan.initial), (count, n))
    rows = [np.broadcast_to(c @ state[0] + d[0] @ plan.initial, (count, len(c)))[..., None]]
    edges = plan.breakpoints
    for k, (left, right) in enumerate(pairwise(edges)):
        jet = plan.segment_jet(k, np.zeros(1), ORDER)[:, :, 0]  # (order + 1, naxes) in the plan's own time
        size = n + (ORDER + 1) * naxes
        z = np.empty((count, size, 1))
        m = np.zeros((count, size, size))
        read = np.zeros((count, len(c), size))
        read[:, :, :n] = c
        for i, duration in enumerate(durations):
            scale = plan.duration / duration
            z[i, :n, 0] = state[i]
            z[i, n:, 0] = (jet * scale ** np.arange(ORDER + 1)[:, None]).ravel()
            m[i, :n, :n] = a
            for order in range(len(b)):
                m[i, :n, n + order * naxes : n + (order + 1) * naxes] = b[order]
            for order in range(len(d)):
                read[i, :, n + order * naxes : n + (order + 1) * naxes] = d[order]
            m[i, n:, n:] = np.kron(np.eye(ORDER + 1, k=1), np.eye(naxes))
            m[i] *= (right - left) / scale / steps
        step = expm(m)
        rows.append(read @ z)
        for _ in range(steps):
            z = step @ z
            rows.append(read @ z)
        state = z[:, :n, 0]
    settled = np.linalg.solve(a, -b[0] @ plan.final)
    final = (c @ settled + d[0] @ plan.final)[:, None]
    step = expm(a * spacing / np.abs(np.linalg.eigvals(a)).max())
    away = (state - settled).T
    for _ in range(tail):
        rows.append((c @ away + final).T[..., None])
        away = step @ away
    rows.append(np.broadcast_to(final, (count, *final.shape)))
    return np.concatenate(rows, axis=2)


def random_loop(rng, damping=0.005, order=0, naxes=1):
    """Stable loop (a, b, c, d): 1 to 6 states, two outputs, damping from a minimum to 1, poles of 1 to 100 rad/s."""
    n = left = int(rng.integers(1, 7))
    blocks = []
    while left:
        w = 10.0 ** rng.uniform(0.0, 2.0)
        if left >= 2 and rng.random() < 0.7:
            z = 10.0 ** rng.uniform(np.log10(damping), 0.0)
            im = w * np.sqrt(1.0 - z * z)
            blocks.append(np.array([[-z * w, im], [-im, -z * w]]))
            left -= 2
        else:
            blocks.append(np.array([[-w]]))
            left -= 1
    t = np.eye(n)
    while (np.linalg.cond(t) < 1.5 and n > 1) or np.linalg.cond(t) > 100.0:
        t = rng.normal(size=(n, n)) + 2.0 * np.eye(n)
    a = t @ block_diag(*blocks) @ np.linalg.inv(t)
    b = rng.normal(size=(order + 1, n, naxes)) * 0.02 ** np.arange(order + 1)[:, None, None]
    d = np.zeros((order + 1, 2, naxes))
    d[:, 1] = rng.normal(size=(order + 1, naxes)) * 0.02 ** np.arange(order + 1)[:, None] * (rng.random() < 0.5)
    return a, b, rng.normal(size=(2, n)), d


def system_of(loop, labels=("r",)):
    """The loop as a control.StateSpace with inputs r, r_d1, ... and outputs y1, y2, ..."""
    import control as ct

    a, b, c, d = loop
    names = [f"{label}_d{k}" if k else label for k in range(len(b)) for label in labels]
    return ct.ss(
        a, np.concatenate(b, axis=1), c, np.concatenate(d, axis=1), inputs=names,
        outputs=[f"y{i + 1}" for i in range(len(c))], name="loop",
    )  # fmt: skip


QUINTIC = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
SEPTIC = cp.PolySpline([Waypoint(0, 0, 0, 0, 0), Waypoint(1, 1, 0, 0, 0)])
VIA = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(0.4, 0.7), Waypoint(1, 1, 0, 0)])
S_CURVE = cp.SCurve(1.0, velocity=1.6, acceleration=6.0, jerk=60.0)
