r"""Changes of velocity in minimum time with limited acceleration and jerk.

From (v, a) to (v_1, 0) with free position, jerk J and acceleration limits the motion
has three phases: jerk s J to a peak acceleration s p, constant acceleration, jerk -s J
to acceleration 0. With

.. math:: s = -\mathrm{sgn}(v - v_1 + a|a|/2J),\quad u = -s (v - v_1),\quad \alpha = s a

the peak is the smaller one of the limit in direction s and
:math:`\sqrt{J u + \alpha^2/2}`. An initial acceleration beyond the limit in that
direction is reduced first. A limit of the velocity cannot act: once an acceleration in
the wrong direction has been reduced to 0 with maximum jerk, the velocity is
monotone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ctrlplan.trajectories.common import Array


class VelocityChange(NamedTuple):
    """Phases of a change of velocity.

    Attributes
    ----------
    durations : tuple of float
        Durations of the three phases [s]; some may be 0.
    jerks : tuple of float
        Jerks of the phases.
    """

    durations: tuple[float, float, float]
    jerks: tuple[float, float, float]

    @property
    def duration(self) -> float:
        """Total duration [s]."""
        return sum(self.durations)


def fastest_velocity_change(
    change: float, acceleration: float, limits: tuple[float, float], jerk: float
) -> VelocityChange:
    """Change of velocity in minimum time.

    Parameters
    ----------
    change : float
        Final minus initial velocity.
    acceleration : float
        Initial acceleration; it may be beyond its limits.
    limits : (float, float)
        Minimum acceleration, below 0, and maximum, above 0; either may be infinite.
    jerk : float
        Maximum magnitude of the jerk.
    """
    sign, rise, initial = _normalised(change, acceleration, jerk)
    limit = limits[1] if sign > 0.0 else -limits[0]
    if initial > limit:
        hold = (rise - 0.5 * initial**2 / jerk) / limit
        return _phases(-1.0, sign * jerk, (initial - limit) / jerk, hold, limit / jerk)
    peak = min(limit, math.sqrt(max(jerk * rise + 0.5 * initial**2, 0.0)))
    hold = (rise - (peak**2 - 0.5 * initial**2) / jerk) / peak if peak else 0.0
    return _phases(1.0, sign * jerk, (peak - initial) / jerk, hold, peak / jerk)


def slower_velocity_change(change: float, acceleration: float, jerk: float, duration: float) -> VelocityChange:
    """Change of velocity in a duration that is not below the minimum one.

    Parameters
    ----------
    change, acceleration, jerk
        As for `fastest_velocity_change`.
    duration : float
        Duration [s].
    """
    sign, rise, initial = _normalised(change, acceleration, jerk)
    b = duration + initial / jerk
    c = rise + 0.5 * initial**2 / jerk
    peak = 2.0 * c / (b + math.sqrt(max(b * b - 4.0 * c / jerk, 0.0))) if b > 0.0 else 0.0
    if peak >= initial:
        hold = duration - (2.0 * peak - initial) / jerk
        return _phases(1.0, sign * jerk, (peak - initial) / jerk, hold, peak / jerk)
    rest = duration - initial / jerk
    peak = max(rise - 0.5 * initial**2 / jerk, 0.0) / rest if rest > 0.0 else 0.0
    return _phases(-1.0, sign * jerk, (initial - peak) / jerk, duration - initial / jerk, peak / jerk)


def velocity_changes(
    changes: Array, accelerations: Array, limits: Array, jerks: Array, *, together: bool
) -> list[VelocityChange]:
    """Changes of the velocities of several axes.

    Parameters
    ----------
    changes, accelerations : ndarray, shape (naxes,)
        Final minus initial velocities, and initial accelerations.
    limits : ndarray, shape (naxes, 2)
        Minimum and maximum accelerations.
    jerks : ndarray, shape (naxes,)
        Maximum magnitudes of the jerks.
    together : bool
        Whether all have the duration of the slowest one, otherwise each its own
        minimum one.
    """
    starts = list(zip(changes.tolist(), accelerations.tolist(), strict=True))
    own = [
        fastest_velocity_change(*start, (low, high), jerk)
        for start, (low, high), jerk in zip(starts, limits.tolist(), jerks.tolist(), strict=True)
    ]
    longest = max(change.duration for change in own)
    if not together:
        return own
    return [
        change if change.duration == longest else slower_velocity_change(*start, jerk, longest)
        for change, start, jerk in zip(own, starts, jerks.tolist(), strict=True)
    ]


def _normalised(change: float, acceleration: float, jerk: float) -> tuple[float, float, float]:
    """Direction s, and change of velocity and initial acceleration in that direction."""
    sign = 1.0 if change - 0.5 * acceleration * abs(acceleration) / jerk >= 0.0 else -1.0
    return sign, sign * change, sign * acceleration


def _phases(first: float, jerk: float, rise: float, hold: float, fall: float) -> VelocityChange:
    return VelocityChange((max(rise, 0.0), max(hold, 0.0), max(fall, 0.0)), (first * jerk, 0.0, -jerk))
