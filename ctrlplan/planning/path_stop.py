r"""Stops on the path of a plan, by a time law from its own rate to standstill.

The rate of the time law is 1 for a delay, then falls to 0 in a duration T with
the jerk :math:`-j, 0, j` in three phases, of which the second has the fraction f of T;
so j = 4/(T^2 (1 - f^2)), and T/2 of the plan is traversed. A delay allows a plan
to finish a segment in which a limit of the jerk is attained already. Feasibility
is not monotone in T: for every f and delay durations are scanned at
samples, and the shortest one is lengthened until the exact extrema satisfy
the limits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple, NoReturn

import numpy as np
from scipy.optimize import brentq

from ctrlplan.planning.bounds import Bound
from ctrlplan.trajectories import Clipped, MotionProfile, Retimed, Trajectory
from ctrlplan.trajectories.combined import is_shaped
from ctrlplan.trajectories.common import Array

_FRACTIONS = np.linspace(0.0, 0.9, 10)
_STEPS = (0.025, 0.00625)
"""Steps of the fractions near the best one."""
_DELAYS = np.arange(1, 16) / 16.0
"""Delays as fractions of the remaining time, in addition to the breakpoints of the plan."""
_BREAKPOINTS = 16
"""Number of breakpoints after the beginning of a stop up to which it may be delayed."""
_SCANNED = np.geomspace(1.0 / 512.0, 32.0, 113)
"""Durations T relative to the remaining time, eight per octave."""
_REFINED = np.linspace(0.0, 1.0, 65)[1:]
_NEAR = np.linspace(0.88, 1.0, 97)
"""Durations relative to the best one that are scanned with fractions near the best one."""
_SAMPLES = np.linspace(0.0, 1.0, 41)
_TOLERANCE = 1e-9
_LENGTHENED = 1.0 + 1e-3 * 1.3 ** np.arange(40)
"""Factors of T that are tried until the exact extrema satisfy the limits."""


class _Law(NamedTuple):
    """Time law of a stop.

    Attributes
    ----------
    delay, duration : float
        Duration at rate 1, and from rate 1 to 0 [s].
    fraction : float
        Fraction of `duration` with constant slope of the rate.
    total : float
        Time from the beginning to standstill or to the end of the path [s].
    """

    delay: float
    duration: float
    fraction: float
    total: float


def stopped_on_path(plan: Trajectory, time: float, bounds: tuple[Bound, ...]) -> Trajectory:
    """Motion on the path of a plan from its state at a time to rest.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration, in motion at the time.
    time : float
        Start of the stop [s], within the plan.
    bounds : tuple of Bound
        Limits on derivatives of the axes.

    Returns
    -------
    Trajectory
        Plan from `time` on. Limits that the plan exceeds at `time` are exceeded by no
        more than that, where this is possible.

    Raises
    ------
    ValueError
        If the plan is shaped, or ends in motion before it can be stopped.
    """
    if is_shaped(plan):
        raise ValueError(
            'synchronize must be "time" or None for a shaped plan, got "path": another time law would change the '
            "delays of the shaper"
        )
    return _Search(plan, time, bounds).found()


class _Search:
    """Search of the time law of minimum duration."""

    def __init__(self, plan: Trajectory, time: float, bounds: tuple[Bound, ...]) -> None:
        self._plan, self._time, self._left = plan, time, plan.end - time
        end = plan.jet(plan.end, 1, left=True)[1]
        size = np.abs(plan.jet(np.linspace(plan.start, plan.end, 65), 1)[1]).max(axis=1)
        self._ends_at_rest = bool((np.abs(end) <= 1e-9 * size).all())
        state = plan.jet(time, 3, left=time > plan.start)
        # What the plan exceeds at the beginning cannot be less.
        self._rows = [
            (b, int(b.axis), min(b.low, float(state[b.order, b.axis])), max(b.high, float(state[b.order, b.axis])))
            for b in bounds
            if b.axis is not None and b.order
        ]

    def found(self) -> Trajectory:
        """The motion from the beginning of the stop."""
        if not self._left:
            self._raise_moving()
        whole = self._plan_itself()
        best = self._shortest(self._left if whole is not None else math.inf)
        if best is not None:
            return self._certified(best)
        if whole is not None:
            return whole
        if not self._ends_at_rest:
            self._raise_moving()
        return self._motion(self._compromise())

    def _raise_moving(self) -> NoReturn:
        raise ValueError(
            f'synchronize must be "time" or None, got "path": the plan ends in motion at {self._plan.end:.6g} s, '
            f"before it can be stopped on its path from {self._time:.6g} s on; lengthen the plan, or raise the limits"
        )

    def _plan_itself(self) -> Trajectory | None:
        """Plan to its end, if it satisfies the limits and ends at rest."""
        if not self._ends_at_rest:
            return None
        rest = Clipped(self._plan, self._time, self._plan.end)
        return rest if self._exact_excess(rest) <= _TOLERANCE else None

    def _shortest(self, total: float) -> _Law | None:
        """Law of minimum total time below a given one that satisfies the limits at samples."""
        best: _Law | None = None
        for delay in self._delays():
            if delay >= (total if best is None else best.total):
                break
            for fraction in _FRACTIONS.tolist():
                best = self._better(delay, fraction, total, best)
        return None if best is None else self._refined(best, total)

    def _refined(self, best: _Law, total: float) -> _Law:
        """Law with a fraction near that of the best one found."""
        for step in _STEPS:
            delay, fractions = best.delay, best.fraction + step * np.arange(-4.0, 5.0)
            durations = best.duration * _NEAR
            for fraction in fractions.clip(0.0, 0.95).tolist():
                duration = self._first(delay, fraction, durations, total - delay)
                if duration is not None:
                    best = min(best, self._law(delay, duration, fraction), key=lambda law: law.total)
        return best

    def _better(self, delay: float, fraction: float, total: float, best: _Law | None) -> _Law | None:
        """Law of minimum duration with a delay and fraction, if it is shorter than the best one."""
        limit = (total if best is None else best.total) - delay
        ratio = _SCANNED[1] / _SCANNED[0]
        found = self._first(delay, fraction, _SCANNED * self._left, limit * ratio)
        if found is None:
            return best
        low = found / ratio
        refined = self._first(delay, fraction, low + (found - low) * _REFINED, limit)
        law = None if refined is None else self._law(delay, refined, fraction)
        return law if law is not None and (best is None or law.total < best.total) else best

    def _delays(self) -> Iterator[float]:
        """Delays, increasing, during which the plan satisfies the limits at samples."""
        yield 0.0
        edges = self._plan.breakpoints_between(np.nextafter(self._time, math.inf), self._plan.end)[:_BREAKPOINTS]
        for delay in np.unique([*(edges - self._time), *self._left * _DELAYS]).tolist():
            times = self._time + delay * _SAMPLES
            jets = np.concatenate([self._plan.jet(times[:-1], 3), self._plan.jet(times[1:], 3, left=True)], axis=2)
            if self._excess(jets[:, :, None]).max() > _TOLERANCE:
                return
            yield delay

    def _first(self, delay: float, fraction: float, durations: Array, limit: float) -> float | None:
        """First duration that satisfies the limits at samples, with a total below a limit."""
        tried = durations[durations < limit] if math.isfinite(limit) else durations
        if not self._ends_at_rest:
            tried = tried[tried <= 2.0 * (self._left - delay)]
        if not tried.size:
            return None
        holds = np.flatnonzero(self._excess(self._jets(delay, fraction, tried)) <= _TOLERANCE)
        return float(tried[holds[0]]) if holds.size else None

    def _compromise(self) -> _Law:
        """Law with the smallest excess at samples; the shortest one of nearly the same excess."""
        tried = _SCANNED * self._left
        rows = np.array([self._excess(self._jets(0.0, fraction, tried)) for fraction in _FRACTIONS.tolist()])
        near = rows <= rows.min() * 1.01
        column = int(near.any(axis=0).argmax())
        return self._law(0.0, float(tried[column]), float(_FRACTIONS[rows[:, column].argmin()]))

    def _jets(self, delay: float, fraction: float, durations: Array) -> Array:
        """Jets (4, naxes, ndurations, ntime) of the motions after the delay, at samples of all phases."""
        rate = [part.T.reshape(1, -1) for part in _unit_law(fraction)]
        passed, rate1, rate2, rate3 = (row / durations[:, None] ** k for k, row in enumerate(rate, -1))
        times = self._time + delay + passed
        plan = self._plan.jet(np.minimum(times, self._plan.end).ravel(), 3).reshape(4, -1, *times.shape)
        plan[1:] *= times < self._plan.end  # what follows is rest
        return np.stack(
            [
                plan[0],
                plan[1] * rate1,
                plan[2] * rate1**2 + plan[1] * rate2,
                plan[3] * rate1**3 + 3.0 * plan[2] * rate1 * rate2 + plan[1] * rate3,
            ]
        )

    def _excess(self, jets: Array) -> Array:
        """Maximum excess (ndurations,) over all limits, relative to their scales."""
        found = [
            np.maximum(jets[b.order, axis] - high, low - jets[b.order, axis]).max(axis=-1) / b.scale
            for b, axis, low, high in self._rows
        ]
        return np.max(found, axis=0)

    def _exact_excess(self, motion: Trajectory) -> float:
        """Maximum excess over a whole motion."""
        extrema = {order: motion.extrema(order) for order in {b.order for b, *_ in self._rows}}
        return max(
            max(float(extrema[b.order].maximum[axis]) - high, low - float(extrema[b.order].minimum[axis])) / b.scale
            for b, axis, low, high in self._rows
        )

    def _certified(self, law: _Law) -> Trajectory:
        """Motion, lengthened until the exact extrema satisfy the limits."""
        motion = self._motion(law)
        for factor in _LENGTHENED.tolist():
            if self._exact_excess(motion) <= _TOLERANCE:
                break
            motion = self._motion(self._law(law.delay, law.duration * factor, law.fraction))
        return motion

    def _law(self, delay: float, duration: float, fraction: float) -> _Law:
        left = self._left - delay
        if 0.5 * duration <= left or not self._ends_at_rest:
            return _Law(delay, duration, fraction, delay + duration)
        law = _law_profile(0.0, 0.0, duration, fraction)
        passed = brentq(lambda t: float(law(t)) - left, 0.0, duration, xtol=1e-15 * duration)
        return _Law(delay, duration, fraction, delay + float(passed))

    def _motion(self, law: _Law) -> Trajectory:
        """Plan with the time law, from the beginning of the stop."""
        profile: Trajectory = _law_profile(self._time, law.delay, law.duration, law.fraction)
        end = float(profile.final[0])
        if end > self._plan.end:
            profile, end = Clipped(profile, self._time, self._time + law.total), self._plan.end
        return Retimed(Clipped(self._plan, self._time, end), profile)


def _unit_law(fraction: float) -> tuple[Array, Array, Array, Array]:
    """Time law of unit duration from rate 1 to 0 and its derivatives, (nsamples, 3) at samples of its phases."""
    law = _law_profile(0.0, 0.0, 1.0, fraction)
    rows = [law.segment_jet(k, _SAMPLES * d, 3)[:, 0] for k, d in enumerate(np.diff(law.breakpoints).tolist())]
    jets = np.stack(rows, axis=2)
    return jets[0], jets[1], jets[2], jets[3]


def _law_profile(time: float, delay: float, duration: float, fraction: float) -> MotionProfile:
    """Time law from the value and rate (time, 1) to rate 0."""
    ramp = 0.5 * duration * (1.0 - fraction)
    jerk = 1.0 / (ramp * (duration - ramp))
    durations = [delay, ramp, duration - 2.0 * ramp, ramp]
    present = [k for k, value in enumerate(durations) if value > 0.0]
    times = time + np.cumsum([0.0, *(durations[k] for k in present)])
    values = [[(0.0, -jerk, 0.0, jerk)[k] for k in present]]
    end = [[time + delay + 0.5 * duration], [0.0], [0.0]]
    return MotionProfile(times, values, [[time], [1.0], [0.0]], end, labels="time")
