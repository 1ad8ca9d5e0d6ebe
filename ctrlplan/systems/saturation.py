"""Limits of an actuator as a block."""

from __future__ import annotations

import math

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import EventName, Params, Value
from ctrlplan.traits import declare

Array = NDArray[np.float64]


def create_saturation_iosystem(
    low: float, high: float, input: str = "u_cmd", output: str = "u", name: str = "saturation"
) -> ct.NonlinearIOSystem:
    """Actuator that cannot go beyond its limits.

    No states. Input: what is asked for; output: the same within the limits. A
    run by `ctrlplan.simulate` records when limits are reached and left.

    Parameters
    ----------
    low, high : float
        Least and greatest output; one may be infinite.
    input, output : str, optional
        Names of the signals.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.NonlinearIOSystem
        Static, of any time base.

    Raises
    ------
    ValueError
        If the limits do not increase or are nan.

    Examples
    --------
    >>> create_saturation_iosystem(-1.0, 2.0).output(0.0, [], [5.0])
    array([2.])
    """
    if not float(low) < float(high):
        raise ValueError(f"high must be above low, got {low} and {high}")

    def out(t: float, x: Value, u: Value, params: Params) -> Value:
        return np.array([np.fmin(np.fmax(u[0], low), high)])

    block = ct.nlsys(None, out, inputs=[input], outputs=[output], dt=None, name=name)
    if math.isfinite(low) or math.isfinite(high):
        declare(block, watched={EventName(output, "was at its limit"): (_asked, low, high)})
    return block


def _asked(t: Value, x: Value, u: Value, params: Params) -> Value:
    return u[0]
