"""Command filter: a reference and its derivatives from a discontinuous command."""

from __future__ import annotations

import math
from collections.abc import Sequence

import control as ct
import numpy as np

from ctrlplan._checks import checked_count, checked_finite, checked_names
from ctrlplan._renamed import former_signature, warn_renamed
from ctrlplan.traits import declare
from ctrlplan.trajectories import derivative_name


@former_signature(renamed={"input": "inputs", "output": "outputs"})
def create_command_filter_iosystem(
    bandwidth: float,
    derivatives: int = 2,
    order: int | None = None,
    *,
    initial: float = 0.0,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    name: str | None = None,
) -> ct.StateSpace:
    """Command filter 1/(s/w + 1)^n with derivative outputs.

    For a controller that requires derivatives of a piecewise constant reference,
    as from a governor. The output lags the command by n/w, unless the command
    is the sum of the derivatives of the plan weighted by
    `command_filter_gains`.

    States: r and its derivatives r_d1, ... up to n - 1. Inputs: the command
    r_cmd. Outputs: r, r_d1, ... up to `derivatives`.

    Parameters
    ----------
    bandwidth : float
        w [rad/s], above 0.
    derivatives : int, optional
        Highest derivative among the outputs.
    order : int, optional
        n, at least ``derivatives + 1`` (default). Derivative n is discontinuous
        where the command is.
    initial : float, optional
        Reference at the start of a run, in equilibrium: declared as the initial
        state.
    inputs : str, optional
        Name of the command, by default r_cmd.
    outputs : str or sequence of str, optional
        Name of the reference, by default r, from which the names of its
        derivatives are formed; or a name for each output.
    name : str, optional
        Name of the block, by default that of the first output with ``_filter``.

    Returns
    -------
    control.StateSpace
        In continuous time.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If an argument is out of range, or the number of names differs from the
        number of signals.

    Examples
    --------
    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> block = cp.create_command_filter_iosystem(2.0)
    >>> block.input_labels, block.output_labels
    (['r_cmd'], ['r', 'r_d1', 'r_d2'])
    >>> plant = cp.plants.integrator_lag_loop(5.0)
    >>> loop = ct.interconnect([block, plant], inputs=["r_cmd"], outputs=["y", *block.output_labels])
    >>> found = cp.simulate(loop, np.linspace(0.0, 30.0, 7), cp.Step(1.0))
    >>> bool(abs(found.outputs[:, -1] - [1.0, 1.0, 0.0, 0.0]).max() < 1e-5)
    True
    """
    w = checked_finite(bandwidth, "bandwidth", above=0.0)
    count = checked_count(derivatives, "derivatives") + 1
    n = count if order is None else checked_count(order, "order", count)
    start = checked_finite(initial, "initial")
    a = np.diag(np.ones(n - 1), 1)
    a[-1] = [-math.comb(n, k) * w ** (n - k) for k in range(n)]
    b = np.zeros((n, 1))
    b[-1] = w**n
    base = checked_names("r" if outputs is None else outputs, "outputs")
    labels = [derivative_name(base[0], k) for k in range(n)]
    block = ct.ss(
        a,
        b,
        np.eye(count, n),
        np.zeros((count, 1)),
        inputs=checked_names("r_cmd" if inputs is None else inputs, "inputs", 1),
        outputs=labels[:count] if len(base) == 1 else checked_names(base, "outputs", count),
        states=labels,
        name=name or f"{base[0]}_filter",
    )
    if start:
        declare(block, initial_state=np.array([start, *[0.0] * (n - 1)]))
    return block


def command_filter_gains(bandwidth: float, order: int) -> tuple[float, ...]:
    """Gains of a plan's derivatives, inverse of a command filter.

    With the weighted sum of the derivatives as the command, the output of
    `create_command_filter_iosystem` is the plan.

    Parameters
    ----------
    bandwidth : float
        w [rad/s] of the filter, above 0.
    order : int
        n of the filter, at least 1.

    Returns
    -------
    tuple of float
        Coefficients of (s/w + 1)^n, of the derivatives 0 to n [s^k].

    Raises
    ------
    ValueError
        If an argument is out of range.

    Examples
    --------
    >>> command_filter_gains(2.0, 2)
    (1.0, 1.0, 0.25)
    """
    w = checked_finite(bandwidth, "bandwidth", above=0.0)
    n = checked_count(order, "order", 1)
    return tuple(math.comb(n, k) / w**k for k in range(n + 1))


def command_lead(bandwidth: float, order: int) -> tuple[float, ...]:
    """Old name of `command_filter_gains`.

    Warns
    -----
    FutureWarning
        Always.
    """
    warn_renamed("command_lead", "command_filter_gains")
    return command_filter_gains(bandwidth, order)
