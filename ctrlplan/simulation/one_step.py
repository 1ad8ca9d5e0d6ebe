"""One step of an explicit Runge-Kutta method over a short segment, with an estimate of its error.

CVODES starts with steps of first order, dozens in a segment that a method of order 8
passes in one. The method is DOP853 of Dormand and Prince, with its estimates of
orders 5 and 3 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I,
section II.10), in the norm of the sum of squares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np
from scipy.integrate import DOP853

from ctrlplan._types import Array, Value

LONGEST = 0.5
"""Length of a segment, in units of the inverse norm of the Jacobian, up to which one step is tried."""

EVALUATIONS = 12
"""Evaluations of the right-hand side in a step."""

_LARGEST = 1_000
"""Maximum number of operations of a right-hand side that is written out for each stage."""


def has_step(equations: Mapping[str, ca.SX]) -> bool:
    """Whether equations are small enough for a step."""
    return _right_hand_side(equations).n_instructions() <= _LARGEST


class OneStep:
    """Step from 0 to 1 with memory for its arguments and results, for one thread.

    Parameters
    ----------
    equations : mapping
        Time, states, parameters and their derivatives, as for `casadi.integrator`.
    """

    def __init__(self, equations: Mapping[str, ca.SX]) -> None:
        function = _step(equations)
        self._start, self._p, self._tolerances = (np.empty(function.numel_in(k)) for k in range(3))
        self._found, self._error = np.empty(function.numel_out(0)), np.empty(1)
        given: tuple[Value, Callable[[], None]] = function.buffer()  # not in the type stubs of CasADi
        self._buffer, self._evaluate = given
        for k, values in enumerate((self._start, self._p, self._tolerances)):
            self._buffer.set_arg(k, values.data)
        for k, values in enumerate((self._found, self._error)):
            self._buffer.set_res(k, values.data)
        self.is_running = False

    def state(
        self, start: Array, parameters: Sequence[Array | Sequence[float]], rtol: float, atol: float
    ) -> Array | None:
        """State at the end, valid until the next call; None if its estimated error exceeds the tolerance."""
        self.is_running = True
        try:
            self._start[:], self._tolerances[:] = start, (rtol, atol)
            first = 0
            for values in parameters:
                self._p[first : first + len(values)] = values
                first += len(values)
            self._evaluate()
            return self._found if self._error[0] <= 1.0 else None  # nan exceeds it
        finally:
            self.is_running = False


def _right_hand_side(equations: Mapping[str, ca.SX]) -> ca.Function:
    return ca.Function("rates", [equations[name] for name in ("t", "x", "p")], [equations["ode"]])


def _step(equations: Mapping[str, ca.SX]) -> ca.Function:
    """Function of (start, parameters, tolerances) that returns the state at the end and its error in tolerances."""
    rates = _right_hand_side(equations)
    x, p, tolerances = ca.SX.sym("x", rates.numel_in(1)), ca.SX.sym("p", rates.numel_in(2)), ca.SX.sym("tolerances", 2)
    stages = [rates(0.0, x, p)]
    for c, row in zip(DOP853.C[1:], DOP853.A[1:], strict=True):
        stages.append(rates(float(c), x + _sum(row, stages), p))
    end = x + _sum(DOP853.B, stages)
    size = tolerances[1] + tolerances[0] * ca.fmax(ca.fabs(x), ca.fabs(end))
    fifth, third = (ca.sumsqr(_sum(weights, stages) / size) for weights in (DOP853.E5, DOP853.E3))
    error = fifth / ca.sqrt(fifth + 0.01 * third + np.finfo(float).tiny)
    return ca.Function("step", [x, p, tolerances], [ca.densify(end), error])


def _sum(weights: Array, stages: Sequence[ca.SX]) -> ca.SX:
    terms = [float(weight) * stage for weight, stage in zip(weights, stages, strict=False) if weight]
    return sum(terms[1:], terms[0])
