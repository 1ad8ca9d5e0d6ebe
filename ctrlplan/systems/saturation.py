"""Saturation of an actuator as a block."""

from __future__ import annotations

import math
from collections.abc import Sequence

import control as ct
import numpy as np

from ctrlplan._checks import checked_names, checked_number
from ctrlplan._renamed import former_signature
from ctrlplan._types import EventName, Params, Value
from ctrlplan.traits import declare


@former_signature("inputs", "outputs", "name", renamed={"input": "inputs", "output": "outputs"})
def create_saturation_iosystem(
    low: float,
    high: float,
    *,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    name: str = "saturation",
) -> ct.NonlinearIOSystem:
    """Actuator saturation: the output is the limited command.

    No states. Inputs: the command u_cmd. Outputs: u. `ctrlplan.simulate` records
    as events when the command reaches and leaves a limit.

    Parameters
    ----------
    low, high : float
        Minimum and maximum of the output, in its unit; either may be infinite.
    inputs, outputs : str, optional
        Names of the signals, by default u_cmd and u.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.NonlinearIOSystem
        Static, of any time base.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If the limits do not increase or are nan, or more than one name is given.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> integrator = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y")
    >>> limited = ct.interconnect([cp.create_saturation_iosystem(-1.0, 2.0), integrator], inputs="u_cmd", outputs="y")
    >>> cp.simulate(limited, [0.0, 1.0, 2.0], 5.0).outputs.round(9).tolist()
    [0.0, 2.0, 4.0]
    """
    low, high = checked_number(low, "low"), checked_number(high, "high")
    if not low < high:
        raise ValueError(f"high must be above low, got {low} and {high}")
    command = checked_names("u_cmd" if inputs is None else inputs, "inputs", 1)
    limited = checked_names("u" if outputs is None else outputs, "outputs", 1)

    def out(t: float, x: Value, u: Value, params: Params) -> Value:
        return np.array([np.fmin(np.fmax(u[0], low), high)])

    block = ct.nlsys(None, out, inputs=command, outputs=limited, dt=None, name=name)
    if math.isfinite(low) or math.isfinite(high):
        declare(block, watched={EventName(limited[0], "was at its limit"): (_command, low, high)})
    return block


def _command(t: Value, x: Value, u: Value, params: Params) -> Value:
    return u[0]
