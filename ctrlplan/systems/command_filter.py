"""From a command that jumps to a reference with its derivatives."""

from __future__ import annotations

import math

import control as ct
import numpy as np

from ctrlplan._checks import checked_count, checked_number, checked_time
from ctrlplan.traits import declare
from ctrlplan.trajectories import derivative_name


def create_command_filter_iosystem(
    bandwidth: float,
    derivatives: int = 2,
    order: int | None = None,
    *,
    initial: float = 0.0,
    input: str = "r_cmd",
    output: str = "r",
    name: str | None = None,
) -> ct.StateSpace:
    """Filter 1/(s/w + 1)^n that puts out derivatives of what it makes of a command.

    What a law that reads derivatives needs before it where the reference comes
    in steps, as from a governor. Behind a plan it lags by n/w, unless the plan
    is put in with the lead of `command_lead`.

    States: the reference and n - 1 derivatives; outputs: the first of them, r,
    r_d1, ...; input: the command.

    Parameters
    ----------
    bandwidth : float
        w [rad/s], above 0.
    derivatives : int, optional
        Highest derivative put out.
    order : int, optional
        n, at least one above `derivatives`, which is taken unless given: the
        derivative n jumps with the command.
    initial : float, optional
        Reference at which it rests in the beginning, by its attribute
        ``initial_state``.
    input, output : str, optional
        Names of the signals.
    name : str, optional
        Name of the block; `output` with ``_filter`` unless given.

    Returns
    -------
    control.StateSpace

    Raises
    ------
    ValueError
        If an argument is out of range.

    Examples
    --------
    >>> create_command_filter_iosystem(2.0).output_labels
    ['r', 'r_d1', 'r_d2']
    """
    w = checked_time(bandwidth, "bandwidth", positive=True)
    count = checked_count(derivatives, "derivatives") + 1
    n = count if order is None else checked_count(order, "order", count)
    a = np.diag(np.ones(n - 1), 1)
    a[-1] = [-math.comb(n, k) * w ** (n - k) for k in range(n)]
    b = np.zeros((n, 1))
    b[-1] = w**n
    labels = [derivative_name(output, k) for k in range(n)]
    block = ct.ss(
        a,
        b,
        np.eye(count, n),
        np.zeros((count, 1)),
        inputs=[input],
        outputs=labels[:count],
        states=labels,
        name=name or f"{output}_filter",
    )
    if checked_number(initial, "initial"):
        declare(block, initial_state=np.array([initial, *[0.0] * (n - 1)]))
    return block


def command_lead(bandwidth: float, order: int) -> tuple[float, ...]:
    """Weights of a plan's derivatives 0 to n in the command that a filter turns into the plan.

    Parameters
    ----------
    bandwidth, order
        w [rad/s] and n of `create_command_filter_iosystem`.

    Returns
    -------
    tuple of float
        Coefficients of (s/w + 1)^n, lowest first.

    Examples
    --------
    >>> command_lead(2.0, 2)
    (1.0, 1.0, 0.25)
    """
    w = checked_time(bandwidth, "bandwidth", positive=True)
    n = checked_count(order, "order", 1)
    return tuple(math.comb(n, k) / w**k for k in range(n + 1))
