"""Optimisation of the time law of a plan with fixed path."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import linprog

from ctrlplan.planning.limits import Limited
from ctrlplan.trajectories import PiecewiseSpline, Retimed, Trajectory, Waypoint
from ctrlplan.trajectories.common import FACTORIALS, Array
from ctrlplan.trajectories.retimed import composed

_PIECES = 16
_SAMPLES = 161
_STEP = 1e-6
_STEPS = 150
_ROUNDING = 1e-12
"""Violation attributed to rounding, as a fraction of a limit's scale, for position limits that the path attains."""


def with_fast_time_law(plan: Trajectory, limited: Limited) -> Retimed:
    """Plan with a time law of minimum duration under limits at samples.

    The rate of the time law is a spline of degree 4 with positive coefficients,
    so that the time law is increasing and has four continuous derivatives, as
    many as the force of a crane requires. The duration is the reciprocal of the
    mean rate. At the optimum about as many limits are active as there are
    coefficients, so linear programs within a trust region converge in tens of
    steps. After each step the rate is reduced uniformly until the limits are
    satisfied.

    Parameters
    ----------
    plan : Trajectory
        Plan that satisfies the limits.
    limited : Limited
        The limits.

    Returns
    -------
    Retimed
        The plan, which may slightly violate limits between samples.
    """
    law = _Law(plan, limited)
    logs, reach = np.zeros(law.size), 0.5
    for _ in range(_STEPS):
        room, slope = law.room_and_slope(logs)
        # Minimum duration for linearised limits, of which as many are active as there are variables.
        step = linprog(
            -law.weights * np.exp(logs),
            -slope,
            np.maximum(room, 0.0),
            bounds=[(-reach, reach)] * law.size,
            method="highs",
        )
        tried = law.within_limits(logs + np.asarray(step.x)) if step.success else logs
        gain = 1.0 - law.duration(tried) / law.duration(logs)
        logs, reach = (tried, min(1.5 * reach, 2.0)) if gain > 0.0 else (logs, 0.3 * reach)
        if reach < 1e-3 or 0.0 < gain < 1e-5:
            break
    return Retimed(plan, law.time_law(logs))


class _Law:
    """Time laws of a plan, by the logarithms of the coefficients of their rates."""

    def __init__(self, plan: Trajectory, limited: Limited) -> None:
        self._knots = _graded(_PIECES, limited)
        knots = np.concatenate([np.zeros(4), self._knots, np.ones(4)])
        self.size = _PIECES + 4
        passed = BSpline(knots, np.eye(self.size), 4).antiderivative()
        self._plan, self._limited = plan, limited
        # Limits of positions do not depend on the time law; where one is attained, its margin is rounding.
        self._moving = [k for k, bound in enumerate(limited.bounds) if bound.axis is None or bound.order]
        self._bounds = [limited.bounds[k] for k in self._moving]
        self.weights = passed(1.0)
        samples = _graded(_SAMPLES - 1, limited)
        orders = range(limited.order + 1)
        # Taylor coefficients of the time law at the samples, in normalised time.
        self._basis = np.stack([passed(samples, nu=k) / FACTORIALS[k] for k in orders])
        self._at_knots = np.stack([passed(self._knots, nu=k) for k in range(3)])

    def duration(self, logs: Array) -> float:
        """Duration as a multiple of the plan's."""
        return 1.0 / float(self.weights @ np.exp(logs))

    def room_and_slope(self, logs: Array) -> tuple[Array, Array]:
        """Distance from every limit at every sample, as fractions of their scales, and its derivatives."""
        steps = np.concatenate([np.zeros((self.size, 1)), _STEP * np.eye(self.size)], axis=1)
        room = self._room(logs[:, None] + steps)
        return room[:, 0], (room[:, 1:] - room[:, :1]) / _STEP

    def within_limits(self, logs: Array) -> Array:
        """Same law with the rate reduced uniformly until limits are satisfied at the samples."""
        slowest, fastest = logs - 3.0, logs
        if self._holds(fastest):
            return fastest
        for _ in range(24):
            middle = 0.5 * (slowest + fastest)
            slowest, fastest = (middle, fastest) if self._holds(middle) else (slowest, middle)
        return slowest

    def _holds(self, logs: Array) -> bool:
        """Whether all limits are satisfied at the samples."""
        return bool(self._room(logs[:, None]).min() >= -_ROUNDING)

    def time_law(self, logs: Array) -> PiecewiseSpline:
        """The time law from the plan's start to its end, one quintic per interval."""
        plan, duration = self._plan, self.duration(logs)
        jets = plan.duration * duration * (self._at_knots @ np.exp(logs))
        jets[0] += plan.start
        jets[0, [0, -1]] = plan.start, plan.end
        length = duration * plan.duration
        times = plan.start + length * self._knots
        return PiecewiseSpline(
            [
                Waypoint(t, *jet)
                for t, jet in zip(times.tolist(), (jets / length ** np.arange(3)[:, None]).T, strict=True)
            ],
            labels=["time"],
            warn=False,
        )

    def _room(self, logs: Array) -> Array:
        """Distance from every limit for many laws, shape (nlimits nsamples, nlaws)."""
        rates = np.exp(logs)
        durations = 1.0 / (self.weights @ rates)
        # Durations are relative to that of the plan.
        inner = (self._basis @ rates) * durations * self._plan.duration
        inner /= (durations * self._plan.duration) ** np.arange(len(inner))[:, None, None]
        times = np.clip(self._plan.start + inner[0], self._plan.start, self._plan.end).ravel()
        shape = (-1, 1, times.size)
        order = self._limited.order
        outer = self._plan.jet(times, order) / FACTORIALS[: order + 1, None, None]
        series = np.stack(composed(list(outer), list(inner[1:].reshape(shape))))
        try:
            values = self._limited.values(series * FACTORIALS[: order + 1, None, None])
        except ValueError:  # infeasible for the plant: far beyond every limit
            return np.full((2 * len(self._bounds) * _SAMPLES, logs.shape[1]), -1e3)
        sides = [self._limited.sides(b, self._plan, times) for b in self._bounds]
        own = list(zip(self._bounds, values[self._moving], sides, strict=True))
        rows = [(high - row) / b.scale + b.slack for b, row, (_, high) in own]
        rows += [(row - low) / b.scale + b.slack for b, row, (low, _) in own]
        room = np.minimum(np.array(rows), 1e3)
        return room.reshape(len(rows) * _SAMPLES, logs.shape[1])


def _graded(count: int, limited: Limited) -> Array:
    """Knots from 0 to 1; denser at both ends, where a plan from rest requires a large rate.

    Not with limits on derivatives above acceleration, which have large rounding errors on short intervals.
    """
    even = np.linspace(0.0, 1.0, count + 1)
    if limited.derivatives_only and limited.order <= 2:
        return even**2 / (even**2 + (1.0 - even) ** 2)
    return even
