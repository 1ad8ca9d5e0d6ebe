"""Chains of integrators."""

from __future__ import annotations

import numpy as np

from ctrlplan._checks import checked_count, default_labels
from ctrlplan._types import Params, Value
from ctrlplan.flatness import FlatSystem
from ctrlplan.trajectories import derivative_name


def integrator_chain(order: int, axes: int = 1, name: str = "integrator_chain") -> FlatSystem:
    """Parallel chains of integrators, y^(order) = u on each axis.

    States, also the outputs: y, y_d1, ... up to order - 1 of each axis, in any
    unit of length per s^k (y1, y1_d1, ..., y2, ... for more than one axis).
    Inputs: u, or u1, u2, .... Flat outputs: y, or y1, y2, ....

    Parameters
    ----------
    order : int
        Number of integrators of each axis, at least 1.
    axes : int, optional
        Number of chains, at least 1.
    name : str, optional
        Name of the block.

    Returns
    -------
    ctrlplan.flatness.FlatSystem
        A `control.flatsys.FlatSystem`.

    Raises
    ------
    ValueError
        If `order` or `axes` is not a positive integer.

    Examples
    --------
    >>> chain = integrator_chain(2, axes=2)
    >>> chain.state_labels, chain.input_labels
    (['y1', 'y1_d1', 'y2', 'y2_d1'], ['u1', 'u2'])
    """
    r, count = checked_count(order, "order", 1), checked_count(axes, "axes", 1)

    def forward(x: Value, u: Value, params: Params | None = None) -> list[Value]:
        return [np.array([*x[r * i : r * (i + 1)], u[i]]) for i in range(count)]

    def reverse(flag: Value, params: Params | None = None) -> tuple[Value, Value]:
        return np.array([value for row in flag for value in row[:r]]), np.array([row[r] for row in flag])

    def update(t: float, x: Value, u: Value, params: Params) -> Value:
        return np.array([value for row in forward(x, u, params) for value in row[1:]])

    states = [derivative_name(label, k) for label in default_labels(count) for k in range(r)]
    return FlatSystem(
        forward,
        reverse,
        update,
        lambda t, x, u, params: x,
        orders=(r,) * count,
        flat_labels=default_labels(count),
        states=states,
        inputs=[label.replace("y", "u") for label in default_labels(count)],
        outputs=states,
        name=name,
    )
