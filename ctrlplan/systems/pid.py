"""PID controller with filtered derivative, bias, limits and anti-windup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import control as ct
import numpy as np

from ctrlplan._checks import Range, checked_finite, checked_names, checked_range
from ctrlplan._renamed import former_signature
from ctrlplan._types import Array, EventName, Params, Value
from ctrlplan.traits import declare


@former_signature("bias", "limits", "tracking_time", "name", renamed={"output": "outputs"})
def create_pid_iosystem(
    kp: float,
    ki: float,
    kd: float,
    tf: float,
    *,
    bias: float = 0.0,
    limits: Range | None = None,
    tracking_time: float | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | str | None = None,
    name: str = "pid",
) -> ct.StateSpace | ct.NonlinearIOSystem:
    """PID on the error r - y: Kp + Ki/s + Kd s/(Tf s + 1).

    States: integral (of Ki times the error) and filter (of the error). Inputs:
    r and y. Outputs: u. The block is a `control.StateSpace` if bias and limits
    are not given. With limits, `ctrlplan.simulate` records as events when the
    output reaches and leaves a limit.

    Parameters
    ----------
    kp, ki, kd : float
        Gains, finite; `ki` and `kd` may be 0. Unit of `kp`: that of u over that
        of y; of `ki` that per second, of `kd` that times seconds.
    tf : float
        Time constant of the derivative filter [s], above 0.
    bias : float, optional
        Constant added to the output.
    limits : (float, float) or float, optional
        Minimum and maximum of the output, bias included; a number a for (-a, a).
    tracking_time : float, optional
        Time constant [s] of anti-windup by back-calculation; by default
        sqrt(kd/ki), or kp/ki if kd is 0.
    inputs : sequence of str, optional
        Names of reference and measurement, by default r and y.
    outputs : str, optional
        Name of the control signal, by default u.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.StateSpace or control.NonlinearIOSystem
        In continuous time.

    Raises
    ------
    TypeError
        If a number or a name has the wrong type.
    ValueError
        If a gain is not finite, `tf` or `tracking_time` is not above 0, the
        limits do not increase, or the number of names is wrong.

    Examples
    --------
    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> pid = cp.create_pid_iosystem(3.0, 1.0, 2.0, 0.1)
    >>> pid.state_labels
    ['integral', 'filter']
    >>> plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y")
    >>> loop = ct.interconnect([pid, plant], inputs="r", outputs=["y", "u"])
    >>> cp.simulate(loop, np.linspace(0.0, 60.0, 7), cp.Step(1.0)).outputs[:, -1].round(6).tolist()
    [1.0, 1.0]
    """
    kp, ki, kd, bias = (
        checked_finite(value, label) for label, value in (("kp", kp), ("ki", ki), ("kd", kd), ("bias", bias))
    )
    tf = checked_finite(tf, "tf", above=0.0)
    low, high = (-math.inf, math.inf) if limits is None else checked_range(limits, "limits")
    if tracking_time is not None:
        tracking_time = checked_finite(tracking_time, "tracking_time", above=0.0)
    measured = checked_names(("r", "y") if inputs is None else inputs, "inputs", 2)
    control = checked_names("u" if outputs is None else outputs, "outputs", 1)
    names: dict[str, Value] = {"inputs": measured, "outputs": control, "states": ["integral", "filter"], "name": name}
    if limits is None and bias == 0.0:
        a = [[0.0, 0.0], [0.0, -1.0 / tf]]
        b = [[ki, -ki], [1.0 / tf, -1.0 / tf]]
        gain = kp + kd / tf
        return ct.ss(a, b, [[1.0, -kd / tf]], [[gain, -gain]], **names)
    back = _tracking_rate(kp, ki, kd, tracking_time) if limits is not None else 0.0

    total = partial(_total, kp, kd / tf, bias)

    def limited(value: Value) -> Value:
        return value if limits is None else np.fmin(np.fmax(value, low), high)

    def update(t: float, x: Value, u: Value, params: Params) -> Array:
        error, command = u[0] - u[1], total(x, u)
        return np.array([ki * error + back * (limited(command) - command), (error - x[1]) / tf])

    def out(t: float, x: Value, u: Value, params: Params) -> Array:
        return np.array([limited(total(x, u))])

    block = ct.nlsys(update, out, **names)
    if limits is not None:
        # `ctrlplan.simulate` records the crossings of these limits.
        command = partial(_command, kp, kd / tf, bias)
        declare(block, watched={EventName(control[0], "was at its limit"): (command, low, high)})
    return block


def _total(kp: float, kd: float, bias: float, x: Value, u: Value) -> Value:
    """Output before limiting; kd is divided by the time constant of the filter."""
    error = u[0] - u[1]
    return bias + kp * error + x[0] + kd * (error - x[1])


def _command(kp: float, kd: float, bias: float, t: Value, x: Value, u: Value, params: Params) -> Value:
    return _total(kp, kd, bias, x, u)


def _tracking_rate(kp: float, ki: float, kd: float, tracking_time: float | None) -> float:
    """Inverse of the tracking time; 0 without integral action."""
    if tracking_time is None:
        if ki == 0.0:
            return 0.0
        ratio = kd / ki if kd else (kp / ki) ** 2
        tracking_time = math.sqrt(abs(ratio)) or 1.0
    return 1.0 / tracking_time
