"""The table of the linear loop k/(s^2 + s) in unity feedback, and the closed forms that it comes from.

``python3 tests/support/linear_table.py`` prints the table. The loop's output
obeys y'' + y' + k y = k r. Between its breaks a reference is a sum of terms c
t^n and c exp(i w t), so that y is a sum of the same functions, coefficient by
coefficient, and of two modes of the loop; nothing is integrated. Equation (1)
of the paper, which lacks the gain: after a step y = 1 - (w_n/w_p) exp(-xi w_n
t) sin(w_p t + arccos xi), w_n = sqrt k, xi = 1/(2 w_n), w_p = w_n sqrt(1 -
xi^2), k > 1/4.
"""

import numpy as np
from numpy.polynomial import Polynomial
from scipy.optimize import brentq, minimize_scalar
from trajectory_oracle import Direct

GAINS = (1, 5, 20, 100, 1000)
PLANS = ("step", "trigonometric", "quintic")
"""A step of 1; from 0 to 1 in 1 s, at rest and without acceleration at both ends, alpha = 1 and alpha = 0."""

TABLE = {
    1: (("16.3034", "8.07635"), ("16.0211", "8.56714"), ("16.0148", "8.56693")),
    5: (("48.6397", "7.56125"), ("44.5425", "8.02597"), ("44.4532", "8.02505")),
    20: (("70.2256", "7.82524"), ("48.8553", "7.62643"), ("48.4222", "7.61252")),
    100: (("85.4468", "7.60094"), ("11.4917", "3.42085"), ("10.7596", "3.39506")),
    1000: (("95.1535", "7.75851"), ("0.634705", "0.847783"), ("0.646697", "0.850593")),
}
"""By gain and plan: overshoot on the error, 100 max(y - r) [%], and settling time, last entry into 1 +- 0.02 [s]."""


def printed(gain, plan):
    """Overshoot [%] and settling time [s] of the table, as numbers."""
    return tuple(map(float, TABLE[gain][PLANS.index(plan)]))


def reference(plan):
    """Powers of t (a polynomial) and pairs (w, c) of terms Re c exp(i w t) that the plan is until its end, 1 s."""
    if plan == "step":
        return Polynomial([1.0]), []
    alpha = {"trigonometric": 1.0, "quintic": 0.0}[plan]
    found = Direct([0, 1], [[0, 0, 0], [1, 0, 0]], alpha)
    c = [float(value) for value in found.coefficients]
    if not alpha:
        return Polynomial(c), []
    terms = [(k * alpha, c[2 * k - 1] - 1j * c[2 * k]) for k in range(1, found.m)]
    last = -1j * c[-1] * np.exp(-1j * found.m * float(found.gamma))
    return Polynomial(c[:1]), [*terms, (found.m * alpha, last)]


def _free(gain, start, value, rate):
    """Solution of y'' + y' + k y = 0 with y and y' at the start, and its derivatives."""
    modes = np.roots([1.0, 1.0, gain]).astype(complex)
    weights = np.linalg.solve([[1.0, 1.0], modes], [value, rate])
    return lambda t, nu=0: np.real(np.exp(np.multiply.outer(t - start, modes)) @ (modes**nu * weights))


def responses(gain, plan):
    """Reference and output as functions of time."""
    powers, terms = reference(plan)
    slope = np.diag(np.arange(1.0, powers.coef.size), 1)  # the derivative of coefficients
    operator = slope @ slope + slope + gain * np.eye(powers.coef.size)
    forced = Polynomial(np.linalg.solve(operator, gain * powers.coef))
    answers = [(w, c * gain / (gain - w**2 + 1j * w)) for w, c in terms]

    def of(powers, terms, t, nu=0):
        waves = (np.real(c * (1j * w) ** nu * np.exp(1j * w * t)) for w, c in terms)
        return powers.deriv(nu)(t) + sum(waves)

    own = _free(gain, 0.0, -of(forced, answers, 0.0), -of(forced, answers, 0.0, 1))

    def during(t, nu=0):
        return of(forced, answers, t, nu) + own(t, nu)

    if plan == "step":
        return np.ones_like, during
    after = _free(gain, 1.0, during(1.0) - 1.0, during(1.0, 1))
    return (
        lambda t: np.where(t < 1.0, of(powers, terms, t), 1.0),
        lambda t: np.where(t < 1.0, during(t), 1.0 + after(np.maximum(t, 1.0))),
    )


def computed(gain, plan):
    """Overshoot [%] and settling time [s]."""
    r, y = responses(gain, plan)
    t = np.linspace(0.0, 15.0, 150_001)
    error = y(t) - r(t)
    at = t[np.argmax(error)]
    peak = minimize_scalar(lambda s: r(s) - y(s), bounds=(at - 1e-4, at + 1e-4), options={"xatol": 1e-10})
    last = np.flatnonzero(np.abs(y(t) - 1.0) > 0.02)[-1]
    settled = brentq(lambda s: abs(y(s) - 1.0) - 0.02, t[last], t[last + 1], xtol=1e-13)
    return 100 * max(error.max(), -peak.fun), settled


def main():
    for gain in GAINS:
        rows = (f'("{overshoot:.6g}", "{settling:.6g}")' for overshoot, settling in (computed(gain, p) for p in PLANS))
        print(f"    {gain}: ({', '.join(rows)}),")


if __name__ == "__main__":
    main()
