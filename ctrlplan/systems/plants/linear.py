"""Linear plants in unity feedback."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, get_args

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_finite
from ctrlplan._types import Array

Output = Literal["y", "u", "e"]
"""Output of a loop: the plant's, the control signal, the error."""


def integrator_lag_loop(gain: float, outputs: Sequence[Output] = ("y",)) -> ct.InterconnectedSystem:
    """Unity feedback of k/(s^2 + s), the loop of the paper's section 2.

    States: those of the plant, ``plant_x[0]`` and ``plant_x[1]``. Inputs: r.
    Outputs: y, or those in `outputs`.

    Parameters
    ----------
    gain : float
        k, finite.
    outputs : sequence of str, optional
        Any of "y", the output, "u", the control signal k (r - y), and "e", the
        error r - y.

    Returns
    -------
    control.InterconnectedSystem
        Blocks error, controller and plant.

    Raises
    ------
    ValueError
        If the gain is not finite or an output is unknown.

    Examples
    --------
    >>> loop = integrator_lag_loop(5.0)
    >>> [round(float(abs(pole)), 3) for pole in loop.poles()]
    [2.236, 2.236]
    """
    return _interconnected((1.0,), (1.0, 1.0, 0.0), _checked(gain, outputs), tuple(outputs))


def unity_feedback_loop(
    num: ArrayLike, den: ArrayLike, gain: float = 1.0, outputs: Sequence[Output] = ("y",)
) -> ct.InterconnectedSystem | ct.StateSpace:
    """Plant num/den with proportional gain in unity feedback.

    States: those of the plant. Inputs: r. Outputs: y, or those in `outputs`.

    Parameters
    ----------
    num, den : array_like
        Coefficients of the plant, highest power of s first.
    gain : float, optional
        Proportional gain, finite.
    outputs : sequence of str, optional
        Any of "y", "u" (after the gain) and "e".

    Returns
    -------
    control.InterconnectedSystem
        Blocks error, controller and plant. A `control.StateSpace` if num and
        den have the same degree.

    Raises
    ------
    ValueError
        If a coefficient or the gain is not finite, the plant is improper, the
        loop has no solution (1 + gain num/den = 0 at infinity), or an output
        is unknown.
    """
    gain = _checked(gain, outputs)
    above, below = (_polynomial(c, name) for c, name in ((num, "num"), (den, "den")))
    if above.size > below.size:
        raise ValueError(f"num must not be of higher degree than den, got {above.size - 1} over {below.size - 1}")
    if above.size == below.size and below[0] + gain * above[0] == 0.0:
        raise ValueError(f"the loop must have a solution, got 1 + gain num/den = 0 at infinity with gain {gain:g}")
    if above.size == below.size:
        return _direct_loop(ct.ss(ct.tf(above, below)), gain, outputs)
    return _interconnected(tuple(above.tolist()), tuple(below.tolist()), gain, tuple(outputs))


def _checked(gain: float, outputs: Sequence[Output]) -> float:
    gain = checked_finite(gain, "gain")
    for output in outputs:
        if output not in get_args(Output):
            raise ValueError(f'outputs must be of "y", "u", "e", got {output!r}')
    return gain


def _interconnected(
    num: tuple[float, ...], den: tuple[float, ...], gain: float, outputs: tuple[Output, ...]
) -> ct.InterconnectedSystem:
    """Loop of three blocks, interconnected once for all gains: python-control requires a millisecond for that."""
    wired = _wired(num, den, outputs)
    error, controller, plant = (ct.StateSpace(block, name=block.name) for block in wired.syslist)
    controller.D[0, 0] = gain
    loop = ct.LinearICSystem(wired, wired, wired.connection_type)
    loop.A, loop.B, loop.C, loop.D = _closed(plant, gain, outputs)
    loop.syslist = [error, controller, plant]
    for name in ("connect_map", "input_map", "output_map"):
        setattr(loop, name, getattr(wired, name).copy())
    return loop


@lru_cache(maxsize=16)
def _wired(num: tuple[float, ...], den: tuple[float, ...], outputs: tuple[str, ...]) -> ct.InterconnectedSystem:
    blocks = [
        ct.summing_junction(inputs=["r", "-y"], output="e", name="error"),
        ct.ss([], [], [], [[1.0]], inputs="e", outputs="u", name="controller", dt=0),
        ct.ss(ct.tf(num, den), inputs="u", outputs="y", name="plant"),
    ]
    return ct.interconnect(blocks, inputs="r", outputs=list(outputs), name="loop")


def _direct_loop(plant: ct.StateSpace, gain: float, outputs: Sequence[Output]) -> ct.StateSpace:
    """Loop around a plant with direct feedthrough, which `control.interconnect` cannot close."""
    return ct.ss(*_closed(plant, gain, outputs), inputs="r", outputs=list(outputs), name="loop")


def _closed(plant: ct.StateSpace, gain: float, outputs: Sequence[Output]) -> tuple[Array, Array, Array, Array]:
    """Exact matrices of the closed loop; python-control computes them by finite differences."""
    a, b, c, d = (np.asarray(m) for m in (plant.A, plant.B, plant.C, plant.D))
    through = 1.0 / (1.0 + gain * d[0, 0])
    rows = {
        "e": (-through * c, np.array([[through]])),
        "u": (-gain * through * c, np.array([[gain * through]])),
        "y": (through * c, gain * through * d),
    }
    read, passed = (np.vstack([rows[name][k] for name in outputs]) for k in (0, 1))
    return a - gain * through * b @ c, gain * through * b, read, passed


def _polynomial(coefficients: ArrayLike, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    values = np.atleast_1d(np.asarray(coefficients, dtype=float))
    if values.ndim != 1 or not np.isfinite(values).all() or not values.any():
        raise ValueError(f"{name} must be finite coefficients, not all 0, got {values.tolist()}")
    return np.trim_zeros(values, "f")
