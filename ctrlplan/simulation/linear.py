"""A linear interconnection of python-control as one state-space form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse.csgraph import connected_components

from ctrlplan.trajectories import Trajectory

Array = NDArray[np.float64]


class NotLinearError(ValueError):
    """A block is not linear, time-invariant and continuous."""


@dataclass(frozen=True)
class LinearForm:
    """Loop x' = A x + B w, y = C x + D w.

    Attributes
    ----------
    a, b, c, d : ndarray
        The matrices; w is the external inputs, then the sources' outputs.
    sources : tuple of (Trajectory, int)
        Each source block's plan and highest derivative; its outputs go axis
        by axis.
    """

    a: Array
    b: Array
    c: Array
    d: Array
    sources: tuple[tuple[Trajectory, int], ...]


def linear_form(system: Any) -> LinearForm:
    """Flatten a linear system, nested interconnections and plan sources included.

    States, inputs and outputs keep python-control's order.

    Raises
    ------
    NotLinearError
        If a block is nonlinear or discrete; its name is in the message.
    ValueError
        If blocks form an algebraic loop without a unique solution.
    """
    if system.dt not in (None, 0):
        raise NotLinearError(f"block {system.name} is discrete (dt = {system.dt})")
    if isinstance(system, ct.InterconnectedSystem):
        return _interconnection(system)
    if isinstance(system, ct.StateSpace):
        a, b, c, d = (np.asarray(m, dtype=float) for m in (system.A, system.B, system.C, system.D))
        return LinearForm(a, b, c, d, ())
    if isinstance(system, ct.TransferFunction):
        return linear_form(ct.ss(system))
    plan = getattr(system, "plan", None)
    if isinstance(plan, Trajectory):
        n = system.noutputs
        nothing, fed, read = np.zeros((0, 0)), np.zeros((0, n)), np.zeros((n, 0))
        return LinearForm(nothing, fed, read, np.eye(n), ((plan, system.derivatives),))
    raise NotLinearError(f"block {system.name} ({type(system).__name__}) is not linear")


def _interconnection(system: Any) -> LinearForm:
    forms = [linear_form(block) for block in system.syslist]
    counts = [block.ninputs or 0 for block in system.syslist]
    a, c = (block_diag(*(getattr(f, name) for f in forms)) for name in "ac")
    inner_b, inner_d, source_b, source_d = [], [], [], []
    for form, count in zip(forms, counts, strict=True):
        inner_b.append(form.b[:, :count])
        inner_d.append(form.d[:, :count])
        source_b.append(form.b[:, count:])
        source_d.append(form.d[:, count:])
    b, d = block_diag(*inner_b), block_diag(*inner_d)
    e, f = block_diag(*source_b), block_diag(*source_d)
    external = np.asarray(system.input_map, dtype=float).reshape(sum(counts), -1)
    connect = np.asarray(system.connect_map, dtype=float)
    # u = connect y + external r and y = c x + d u + f s, solved for y.
    closing = np.eye(len(d)) - d @ connect
    if _has_singular_loop(closing):
        names = ", ".join(block.name for block in system.syslist)
        raise ValueError(f"blocks must not form an algebraic loop without a solution, got one among {names}")
    y_x, y_r, y_s = np.split(
        np.linalg.solve(closing, np.hstack([c, d @ external, f])), np.cumsum([len(a), external.shape[1]]), axis=1
    )
    u_x, u_r, u_s = connect @ y_x, connect @ y_r + external, connect @ y_s
    outputs = np.asarray(system.output_map, dtype=float)
    from_y, from_u = outputs[:, : len(d)], outputs[:, len(d) :]
    return LinearForm(
        a + b @ u_x,
        np.hstack([b @ u_r, b @ u_s + e]),
        from_y @ y_x + from_u @ u_x,
        np.hstack([from_y @ y_r + from_u @ u_r, from_y @ y_s + from_u @ u_s]),
        tuple(source for form in forms for source in form.sources),
    )


def _has_singular_loop(closing: Array) -> bool:
    """Whether signals that depend on one another at once have no unique solution.

    Only such groups are judged: large gains in a row are no loop.
    """
    count, group = connected_components(closing != 0.0, directed=True, connection="strong")
    for k in range(count):
        members = np.flatnonzero(group == k)
        block = closing[np.ix_(members, members)]
        if np.abs(block).max(axis=1).min() == 0.0:
            return True
        if members.size > 1 and np.linalg.cond(block / np.abs(block).max(axis=1, keepdims=True)) > 1e13:
            return True
    return False
