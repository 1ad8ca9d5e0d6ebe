"""A time law that is slow only where limits need it: the path stays, the clock along it changes."""

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
"""Violation that is rounding, as a fraction of a limit's scale: of a position limit that the path touches."""


def with_fastest_law(plan: Trajectory, limited: Limited) -> Trajectory:
    """Plan on the fastest clock found that keeps its limits at samples.

    The clock's rate is a spline of degree 4 with positive coefficients, so that
    the clock always runs forwards and has four continuous derivatives, as many
    as a crane's force needs. The duration is the reciprocal of the mean rate.
    A fastest clock meets about as many limits as it has coefficients, so linear
    programs within a trust region get there in tens of steps; after each the
    clock is slowed down as a whole until limits hold again.

    Parameters
    ----------
    plan : Trajectory
        It keeps the limits.
    limited : Limited
        The limits.

    Returns
    -------
    Trajectory
        `Retimed`; it may break limits between samples by a little.
    """
    law = _Law(plan, limited)
    logs, reach = np.zeros(law.size), 0.5
    for _ in range(_STEPS):
        room, slope = law.room_and_slope(logs)
        # Fastest for limits that are straight lines: as many of them are met as there are variables.
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
    return Retimed(plan, law.clock(logs))


class _Law:
    """Clocks of a plan, by the logarithms of their rates' coefficients."""

    def __init__(self, plan: Trajectory, limited: Limited) -> None:
        self._knots = _graded(_PIECES, limited)
        knots = np.concatenate([np.zeros(4), self._knots, np.ones(4)])
        self.size = _PIECES + 4
        passed = BSpline(knots, np.eye(self.size), 4).antiderivative()
        self._plan, self._limited = plan, limited
        # Limits of positions hold on every clock; where one is touched, its room would be rounding.
        self._moving = [k for k, bound in enumerate(limited.bounds) if bound.axis is None or bound.order]
        self._bounds = [limited.bounds[k] for k in self._moving]
        self.weights = passed(1.0)
        samples = _graded(_SAMPLES - 1, limited)
        orders = range(limited.order + 1)
        # Taylor coefficients of the clock at the samples, in parts of the duration.
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
        """Same law, slowed down as a whole until limits hold at the samples."""
        slowest, fastest = logs - 3.0, logs
        if self._holds(fastest):
            return fastest
        for _ in range(24):
            middle = 0.5 * (slowest + fastest)
            slowest, fastest = (middle, fastest) if self._holds(middle) else (slowest, middle)
        return slowest

    def _holds(self, logs: Array) -> bool:
        """Whether every limit holds at the samples."""
        return bool(self._room(logs[:, None]).min() >= -_ROUNDING)

    def clock(self, logs: Array) -> PiecewiseSpline:
        """The clock: a quintic a part, from the plan's start to its end."""
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
            labels=["clock"],
            warn=False,
        )

    def _room(self, logs: Array) -> Array:
        """The same for many laws at once, shape (nlimits nsamples, nlaws)."""
        rates = np.exp(logs)
        durations = 1.0 / (self.weights @ rates)
        # A part of the duration is `durations` times the plan's own.
        inner = (self._basis @ rates) * durations * self._plan.duration
        inner /= (durations * self._plan.duration) ** np.arange(len(inner))[:, None, None]
        times = np.clip(self._plan.start + inner[0], self._plan.start, self._plan.end).ravel()
        shape = (-1, 1, times.size)
        order = self._limited.order
        outer = self._plan.jet(times, order) / FACTORIALS[: order + 1, None, None]
        series = np.stack(composed(list(outer), list(inner[1:].reshape(shape))))
        try:
            values = self._limited.values(series * FACTORIALS[: order + 1, None, None])
        except ValueError:  # the plant cannot follow: far beyond every limit
            return np.full((2 * len(self._bounds) * _SAMPLES, logs.shape[1]), -1e3)
        rows = [(b.high - row) / b.scale + b.slack for b, row in zip(self._bounds, values[self._moving], strict=True)]
        rows += [(row - b.low) / b.scale + b.slack for b, row in zip(self._bounds, values[self._moving], strict=True)]
        room = np.minimum(np.array(rows), 1e3)
        return room.reshape(len(rows) * _SAMPLES, logs.shape[1])


def _graded(count: int, limited: Limited) -> Array:
    """Numbers from 0 to 1; closer at both ends, where a plan that starts slowly needs a clock that starts fast.

    Limits on more than accelerations do not let it, and would be rounding on short pieces.
    """
    even = np.linspace(0.0, 1.0, count + 1)
    if limited.derivatives_only and limited.order <= 2:
        return even**2 / (even**2 + (1.0 - even) ** 2)
    return even
