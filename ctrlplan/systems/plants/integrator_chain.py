"""Chains of integrators: what every flat plant becomes under its law."""

from __future__ import annotations

import numpy as np

from ctrlplan._checks import checked_count, default_labels
from ctrlplan._types import Params, Value
from ctrlplan.flatness import FlatSystem
from ctrlplan.trajectories import derivative_name


def integrator_chain(order: int, axes: int = 1, name: str = "integrator_chain") -> FlatSystem:
    """Chains of integrators side by side: y^(order) = u on each axis.

    States, which are the outputs as well: axis by axis y, y_d1, ... up to
    order - 1, in any unit of length per s^k; inputs u, or u1, u2, ... for more
    than one axis (then y1, y1_d1, ..., y2, ...). Flat outputs: y, or y1, y2, ...

    Parameters
    ----------
    order : int
        Integrators an axis, 1 or more.
    axes : int, optional
        Chains, 1 or more.
    name : str, optional
        Name of the block.

    Returns
    -------
    ctrlplan.flatness.FlatSystem
        A `control.flatsys.FlatSystem`.

    Raises
    ------
    ValueError
        If `order` or `axes` is not a whole number from 1.

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
