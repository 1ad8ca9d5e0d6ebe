"""PID controller with filtered derivative, bias, limits and anti-windup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from numbers import Real

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import EventName, Params, Value
from ctrlplan.traits import declare

Array = NDArray[np.float64]


def create_pid_iosystem(
    kp: float,
    ki: float,
    kd: float,
    tf: float,
    bias: float = 0.0,
    limits: Sequence[float] | None = None,
    tracking_time: float | None = None,
    name: str = "pid",
    *,
    inputs: Sequence[str] = ("r", "y"),
    output: str = "u",
) -> ct.StateSpace | ct.NonlinearIOSystem:
    """PID on the error r - y: Kp + Ki/s + Kd s/(Tf s + 1).

    States integral (of Ki times the error) and filter (of the error); inputs
    r and y; output u. Without bias and limits it is a `control.StateSpace`.

    Parameters
    ----------
    kp, ki, kd : float
        Gains, finite; `ki` and `kd` may be 0.
    tf : float
        Time constant of the derivative filter [s], above 0.
    bias : float, optional
        Added to the output.
    limits : (float, float), optional
        Least and greatest output, acting on the total.
    tracking_time : float, optional
        Time constant [s] with which the integral is led back while a limit
        acts: sqrt(kd/ki), or kp/ki where kd is 0, unless given.
    name : str, optional
        Name of the block.
    inputs, output : optional
        Names of the signals.

    Returns
    -------
    control.StateSpace or control.NonlinearIOSystem

    Raises
    ------
    ValueError
        If a gain is not finite, `tf` or `tracking_time` is not above 0, or
        the limits do not increase.

    Examples
    --------
    >>> create_pid_iosystem(3.0, 1.0, 2.0, 0.1).state_labels
    ['integral', 'filter']
    """
    numbers: dict[str, Value] = {"kp": kp, "ki": ki, "kd": kd, "bias": bias, "tf": tf}
    for label, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, Real):
            raise TypeError(f"{label} must be a number, got {value!r}")
        if not math.isfinite(value) or (label == "tf" and not float(value) > 0.0):
            raise ValueError(f"{label} must be finite{' and above 0' if label == 'tf' else ''}, got {value}")
    if limits is not None and np.shape(limits) != (2,):
        raise ValueError(f"limits must be two numbers, got {limits!r}")
    if tracking_time is not None and not (math.isfinite(tracking_time) and tracking_time > 0.0):
        raise ValueError(f"tracking_time must be finite and above 0, got {tracking_time}")
    names: dict[str, Value] = {
        "inputs": list(inputs),
        "outputs": [output],
        "states": ["integral", "filter"],
        "name": name,
    }
    if limits is None and bias == 0.0:
        a = [[0.0, 0.0], [0.0, -1.0 / tf]]
        b = [[ki, -ki], [1.0 / tf, -1.0 / tf]]
        gain = kp + kd / tf
        return ct.ss(a, b, [[1.0, -kd / tf]], [[gain, -gain]], **names)
    low, high = (-math.inf, math.inf) if limits is None else (float(limits[0]), float(limits[1]))
    if not low < high:
        raise ValueError(f"limits must increase, got {low} and {high}")
    back = _tracking_rate(kp, ki, kd, tracking_time) if limits is not None else 0.0

    total = partial(_total, kp, kd / tf, bias)

    def limited(value: Value) -> Value:
        return value if limits is None else np.fmin(np.fmax(value, low), high)

    def update(t: float, x: Value, u: Value, params: Params) -> Array:
        error, asked = u[0] - u[1], total(x, u)
        return np.array([ki * error + back * (limited(asked) - asked), (error - x[1]) / tf])

    def out(t: float, x: Value, u: Value, params: Params) -> Array:
        return np.array([limited(total(x, u))])

    block = ct.nlsys(update, out, **names)
    if limits is not None:
        # What `ctrlplan.simulate` records the crossings of.
        declare(block, watched={EventName(output, "was at its limit"): (partial(_asked, kp, kd / tf, bias), low, high)})
    return block


def _total(kp: float, kd: float, bias: float, x: Value, u: Value) -> Value:
    """What is asked for, before the limits; kd over the filter's time constant."""
    error = u[0] - u[1]
    return bias + kp * error + x[0] + kd * (error - x[1])


def _asked(kp: float, kd: float, bias: float, t: Value, x: Value, u: Value, params: Params) -> Value:
    return _total(kp, kd, bias, x, u)


def _tracking_rate(kp: float, ki: float, kd: float, tracking_time: float | None) -> float:
    """Inverse of the tracking time, 0 where there is no integral to lead back."""
    if tracking_time is None:
        if ki == 0.0:
            return 0.0
        ratio = kd / ki if kd else (kp / ki) ** 2
        tracking_time = math.sqrt(abs(ratio)) or 1.0
    return 1.0 / tracking_time
