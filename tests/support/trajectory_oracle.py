"""Naive independent solutions, in as many digits as it takes, for the tests of this folder."""

import mpmath as mp
import numpy as np

from ctrlplan.trajectories import Waypoint


def waypoints(times, jets):
    """One axis: waypoints at the times, an entry that is None left free."""
    return [Waypoint.from_jets(float(t), y=list(jet)) for t, jet in zip(times, jets, strict=True)]


class Direct:
    """Equation (2) with the coefficients that solve (3), or the polynomial (12): plain linear algebra.

    Jets hold None where an entry is free. The condition number of (3) is what the digits must pay for.
    """

    def __init__(self, times, jets, alpha, gamma=None, period=None, digits=50):
        self.digits = digits
        with mp.workdps(digits):
            t = [mp.mpf(float(x)) for x in times]
            self.start, self.duration = t[0], mp.mpf(float(period)) if period else t[-1] - t[0]
            self.alpha = mp.mpf(alpha)
            given = [(x, k, v) for x, jet in zip(t, jets, strict=True) for k, v in enumerate(jet) if v is not None]
            self.size = len(given)
            self.m = self.size // 2
            mean = mp.fsum(self.tau(x) for x, _, _ in given) / self.size
            self.gamma = mean if gamma is None else mp.mpf(gamma)
            matrix = mp.matrix([self.functions(x, k) for x, k, _ in given])
            self.coefficients = list(mp.lu_solve(matrix, mp.matrix([mp.mpf(float(v)) for _, _, v in given])))

    @property
    def rate(self):
        return (self.alpha or 1) / self.duration

    def tau(self, t):
        return (t - self.start) * self.rate

    def functions(self, t, nu):
        """Derivatives in t of 1, cos tau, sin tau, ..., the last one sin m(tau - gamma) where N is even."""
        tau = self.tau(t)
        if not self.alpha:
            return [mp.ff(j, nu) * tau ** (j - nu) * self.rate**nu if j >= nu else mp.mpf(0) for j in range(self.size)]
        even = self.size % 2 == 0
        values = [mp.mpf(nu == 0)]
        for k in range(1, self.m + (0 if even else 1)):
            turned, power = k * tau + nu * mp.pi / 2, (k * self.rate) ** nu
            values += [power * mp.cos(turned), power * mp.sin(turned)]
        if even:
            values.append((self.m * self.rate) ** nu * mp.sin(self.m * (tau - self.gamma) + nu * mp.pi / 2))
        return values

    def jet(self, times, order):
        """Value and derivatives, (order + 1, ntime)."""
        with mp.workdps(self.digits):
            return np.array(
                [
                    [float(mp.fdot(self.coefficients, self.functions(mp.mpf(float(t)), nu))) for t in times]
                    for nu in range(order + 1)
                ]
            )


def scales(exact, duration):
    """Largest value of each derivative, or of y/duration^nu where that is larger: (order + 1, 1)."""
    size = np.abs(exact).max(axis=-1)
    return np.maximum(size, size[0] / duration ** np.arange(len(size)))[:, None]


def error(plan, oracle, order=3, ntime=41):
    """Greatest error of one-axis jets relative to the size of each derivative."""
    t = np.linspace(plan.start, plan.end, ntime)
    exact = oracle.jet(t, order)
    return float((np.abs(plan.jet(t, order)[:, 0] - exact) / scales(exact, plan.duration)).max())


def miss(plan):
    """Greatest distance from what the waypoints prescribe, relative to the size of each derivative of each axis."""
    points = plan.waypoints
    order = max(len(w.jet) for w in points) - 1
    at = np.array([w.time for w in points])
    sampled = plan.jet(np.concatenate([at, np.linspace(plan.start, plan.end, 201)]), order)
    size = np.abs(sampled).max(axis=2)
    size = np.maximum(size, size[0] / plan.duration ** np.arange(order + 1)[:, None])
    worst = 0.0
    for i, point in enumerate(points):
        entries = len(point.jet)
        off = np.abs(sampled[:entries, :, i] - point.jet) / np.where(size > 0, size, 1.0)[:entries]
        worst = max(worst, float(off.max(initial=0.0, where=~np.isnan(point.jet))))
    return worst
