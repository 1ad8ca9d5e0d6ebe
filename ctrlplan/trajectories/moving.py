"""Time-optimal motion between states of motion: profiles from and to moving states, by ruckig.

The library expects positions and times of order one. Axes are scaled by their
velocity limit and a common time; of several time scales the shortest profile is
chosen that satisfies the limits at its exact extrema.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from ctrlplan.trajectories.common import Array
from ctrlplan.trajectories.motion_profile import MotionProfile, profile_of_phases

Synchronize = Literal["phase", "time"]
"""Relation of the axes of a profile."""

_TOLERANCE = 1e-9
"""Excess over a limit, as a fraction of its range, that is attributed to rounding."""

_NEGLIGIBLE = 1e-13
"""Duration of a phase, as a fraction of the whole, that is a rounding error."""

_RESOLUTION = 1e-5
"""Excess that the rounding of times may cause, and that tighter limits compensate."""

_TRIALS = 6
"""Number of profiles with tighter limits that are tried if the rounding of late times exceeds the limits."""

_LINE = 1e-12
"""Relative deviation from a straight line that is a rounding error."""

Phases = tuple[Sequence[float], Sequence[float]]
"""Durations of the phases of one axis [s], and the values of its highest derivative."""


class Ranges(NamedTuple):
    """Limits of the derivatives of all axes.

    Attributes
    ----------
    low, high : ndarray, shape (order, naxes)
        Minima, below 0, and maxima, above 0, of the derivatives 1 to order.
    """

    low: Array
    high: Array


@dataclass(frozen=True)
class Problem:
    """Motion between two states in minimum time.

    Attributes
    ----------
    start, end : ndarray, shape (order, naxes)
        Position and derivatives below the highest at both ends.
    ranges : Ranges
        Limits; those of the highest derivative are symmetric.
    labels : tuple of str
        Names of the axes.
    """

    start: Array
    end: Array
    ranges: Ranges
    labels: tuple[str, ...]

    @property
    def order(self) -> int:
        """Highest derivative, 2 (acceleration) or 3 (jerk)."""
        return len(self.start)

    @property
    def is_rest_to_rest(self) -> bool:
        """Whether both ends are at rest and all limits are symmetric."""
        return not (self.start[1:].any() or self.end[1:].any() or (self.ranges.low != -self.ranges.high).any())

    def of(self, axes: Sequence[int]) -> Problem:
        """Problem of some axes."""
        ranges = Ranges(self.ranges.low[:, axes], self.ranges.high[:, axes])
        return Problem(self.start[:, axes], self.end[:, axes], ranges, tuple(self.labels[k] for k in axes))

    @property
    def moving(self) -> list[int]:
        """Axes that move."""
        moves = (self.start != self.end).any(axis=0) | self.start[1:].any(axis=0)
        return np.flatnonzero(moves).tolist()


def fastest_motion(problem: Problem, time: float, synchronize: Synchronize | None) -> MotionProfile:
    """Motion between two states in minimum time.

    Parameters
    ----------
    problem : Problem
        States and limits.
    time : float
        Start [s].
    synchronize : {"phase", "time"} or None
        "phase": on the straight line; "time": all axes end together; None: each in its
        own minimum time.

    Raises
    ------
    ValueError
        If a state exceeds the limits unavoidably, or the axes cannot be
        synchronised as required.
    ImportError
        If ruckig is required and not installed.
    RuntimeError
        If no profile within the limits was found.
    """
    for word in _unavoidable(problem):
        raise ValueError(word)
    if (problem.start == problem.end).all():
        raise ValueError(f"the end must differ from the start, got the state {problem.end.tolist()} at both")
    words, used, share = "", problem, 0.0
    for _ in range(_TRIALS):
        phases = _phases_of(used, synchronize)
        try:
            found = profile_of_phases(time, phases, problem.start, problem.end, problem.labels)
        except ValueError as reason:  # beyond what a correction of rounding errors allows
            words = str(reason)
            break
        if found is None:
            raise ValueError(
                f"the end must differ from the start by a motion that times near {time:g} s resolve, got none"
            )
        excess, words = _excess(found, problem.ranges)
        if excess <= _TOLERANCE:
            return found
        share = max(3.0 * excess, 4.0 * share)
        used = _tightened(problem, share)
    raise RuntimeError(
        f"the profile must satisfy its limits, got {words}; use a time origin nearer to 0 than {time:g} s"
    )


def _phases_of(problem: Problem, synchronize: Synchronize | None) -> list[Phases]:
    """Phases of all axes."""
    on_line = synchronize == "phase" and len(problem.labels) > 1
    return _on_line(problem) if on_line else _apart(problem, synchronize)


def _tightened(problem: Problem, share: float) -> Problem:
    """Problem with slightly tighter limits, such that the rounding of times does not exceed the given ones."""
    peaks = np.zeros((2, *problem.ranges.low.shape))
    for states, sign in ((problem.start, 1.0), (problem.end, -1.0)):
        for k, axis in np.ndindex(problem.order - 1, len(problem.labels)):
            values = _peaks(states[1:, axis], sign, problem.ranges.high[-1, axis] * (1.0 - share))[k]
            peaks[:, k, axis] = min(peaks[0, k, axis], *values), max(peaks[1, k, axis], *values)
    tighter = (side * (1.0 - share) for side in problem.ranges)
    low, high = (pick(side, peak) for pick, side, peak in zip((np.minimum, np.maximum), tighter, peaks, strict=True))
    return replace(problem, ranges=Ranges(low, high))


def _peaks(state: Array, sign: float, jerk: float) -> list[list[float]]:
    """Velocities and accelerations that a state makes unavoidable, afterwards (sign 1) or before (-1)."""
    if len(state) == 1:
        return [state.tolist()]
    velocity, acceleration = state.tolist()
    return [[velocity, velocity + sign * acceleration * abs(acceleration) / (2.0 * jerk)], [acceleration]]


def _unavoidable(problem: Problem) -> Iterator[str]:
    """Messages for states that exceed the limits whatever follows or precedes."""
    low, high = problem.ranges
    for name, states, sign in (("start", problem.start, 1.0), ("end", problem.end, -1.0)):
        for axis, label in enumerate(problem.labels):
            state = states[1:, axis]
            peaks = _peaks(state, sign, float(high[-1, axis]))
            for k in reversed(range(problem.order - 1)):
                kind = ("velocity", "acceleration")[k]
                when = (
                    f" {'after' if sign > 0.0 else 'before'} the {name} with the maximum jerk"
                    if state[1:].any()
                    else ""
                )
                yield from _beyond(
                    f"{name}_{kind}", label, peaks[k], float(low[k, axis]), float(high[k, axis]), "" if k else when
                )


def _beyond(name: str, label: str, values: list[float], low: float, high: float, when: str) -> Iterator[str]:
    worst = max(values, key=lambda value: max(value - high, low - value))
    excess = max(worst - high, low - worst)
    if excess > _LINE * (high - low):
        yield (
            f"{name} must allow a motion from {low:g} to {high:g}, the limits of {name.partition('_')[2]}, got "
            f"{worst:.6g} of {label}{when}: an unavoidable excess of {excess:.3g}; raise the limit, or change the "
            "state first, as by to_velocity"
        )


def _on_line(problem: Problem) -> list[Phases]:
    """Phases of all axes on the straight line from start to end."""
    change = problem.end[0] - problem.start[0]
    vectors = np.array([change, *problem.start[1:], *problem.end[1:]])
    line = next((v for v in vectors if v.any()), vectors[0])
    line = line / np.abs(line).max(initial=np.finfo(float).tiny)
    along = vectors @ line / (line @ line)
    off = np.abs(vectors - along[:, None] * line).max(axis=1)
    names = [
        "final - initial",
        *(f"{end}_{kind}" for end in ("start", "end") for kind in ("velocity", "acceleration")[: problem.order - 1]),
    ]
    for name, vector, distance in zip(names, vectors, off.tolist(), strict=True):
        if distance > _LINE * np.abs(vector).max():
            raise ValueError(
                f'synchronize must be "time" or None for a motion off the straight line from initial to final, got '
                f'"phase" with {name} = {vector.tolist()}, which is not along {line.tolist()}'
            )
    used = line != 0.0
    with np.errstate(divide="ignore"):
        bounds = np.stack([side[:, used] / line[used] for side in problem.ranges])
    ranges = Ranges(bounds.min(axis=0).max(axis=1)[:, None], bounds.max(axis=0).min(axis=1)[:, None])
    count = problem.order
    start = np.array([0.0, *along[1:count]])[:, None]
    end = np.array([along[0], *along[count:]])[:, None]
    ((durations, values),) = _apart(Problem(start, end, ranges, ("the line",)), None)
    return [(durations, [float(e) * value for value in values]) for e in line]


def _apart(problem: Problem, synchronize: Synchronize | None) -> list[Phases]:
    """Phases of axes that move independently, or end together."""
    phases: list[Phases] = [((), ())] * len(problem.labels)
    axes = problem.moving
    own = {axis: _one_axis(problem.of([axis])) for axis in axes}
    lasts = {axis: sum(durations) for axis, (durations, _) in own.items()}
    longest = max(lasts.values(), default=0.0)
    if synchronize is None or len(axes) < 2:
        for axis, last in lasts.items():
            if last < longest * (1.0 - _LINE) and problem.end[1:, axis].any():
                raise ValueError(
                    f'synchronize must be "time", got {synchronize} with an end in motion of {problem.labels[axis]} '
                    f"after {last:.6g} s, before the end of the motion after {longest:.6g} s"
                )
    elif problem.is_rest_to_rest:  # slower with the same shape
        for axis, (durations, values) in own.items():
            ratio = longest / lasts[axis]
            own[axis] = [ratio * d for d in durations], [value / ratio**problem.order for value in values]
    else:
        own = dict(zip(axes, _shortest(problem.of(axes)), strict=True))
    for axis, found in own.items():
        phases[axis] = found
    return phases


def _one_axis(problem: Problem) -> Phases:
    """Phases of one axis in minimum time."""
    if (problem.start == problem.end).all():
        return (), ()
    if not problem.is_rest_to_rest:
        return _shortest(problem)[0]
    change = float(problem.end[0, 0] - problem.start[0, 0])
    limits = problem.ranges.high[:, 0]
    durations = unit_move(*(limits / abs(change)).tolist())
    top = math.copysign(limits[-1], change)
    signs = [1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0] if problem.order == 3 else [1.0, 0.0, -1.0]
    return durations.tolist(), [top * sign for sign in signs]


def unit_move(velocity: float, acceleration: float, jerk: float = math.inf) -> Array:
    """Phase durations of the time-optimal move from 0 to 1; without a jerk limit the acceleration is one phase."""
    ramp = min(acceleration / jerk, np.sqrt(velocity / jerk), np.cbrt(0.5 / jerk))
    peak = acceleration if ramp == acceleration / jerk else jerk * ramp
    to_limit = velocity / peak + ramp
    halfway = 0.5 * (ramp + np.hypot(ramp, 2.0 / np.sqrt(peak)))  # acceleration over half of the distance
    rises = min(to_limit, halfway)
    cruise = 1.0 / velocity - to_limit if to_limit < halfway else 0.0
    rise = [rises] if jerk == math.inf else [ramp, rises - 2.0 * ramp, ramp]
    return np.array([*rise, cruise, *rise])


# ruckig


def _shortest(problem: Problem) -> list[Phases]:
    """Phases of the shortest profile within the limits that ruckig finds with one of several time scales."""
    found: list[tuple[float, list[Phases]]] = []
    reasons = []
    for scale in _time_scales(problem):
        try:
            found.append(_solved(problem, scale))
        except _UnsolvedError as reason:
            reasons.append(str(reason))
    for _, phases in sorted(found, key=lambda pair: pair[0]):
        try:
            profile = profile_of_phases(0.0, phases, problem.start, problem.end, problem.labels)
        except ValueError as reason:
            reasons.append(str(reason))
            continue
        excess, words = (0.0, "") if profile is None else _excess(profile, problem.ranges)
        if excess <= _RESOLUTION:
            return phases
        reasons.append(words)
    raise RuntimeError(f"ruckig must find a profile within the limits, got none: {'; '.join(dict.fromkeys(reasons))}")


def _time_scales(problem: Problem) -> list[float]:
    """Times [s] of the order of those of the motion."""
    change = np.abs(problem.end[0] - problem.start[0])
    velocity, acceleration = (np.maximum(problem.ranges.high, -problem.ranges.low)[k] for k in range(2))
    braking = np.maximum(np.abs(problem.start[1]), np.abs(problem.end[1])) ** 2 / acceleration
    scales = [np.sqrt(np.maximum(change, braking) / acceleration), velocity / acceleration]
    if problem.order == 3:
        scales.insert(1, np.sqrt(velocity / problem.ranges.high[2]))
    found = [float(np.exp(np.log(row[row > 0.0]).mean())) for row in scales if (row > 0.0).any()]
    return [*found, *(float(row.max()) for row in scales if len(row) > 1 and row.max() > 0.0)]


class _UnsolvedError(Exception):
    """No solution by ruckig."""


def _solved(problem: Problem, scale: float) -> tuple[float, list[Phases]]:
    """Duration, and phases of all axes that end together, by ruckig with a time scale."""
    ruckig = _library()
    naxes, order = len(problem.labels), problem.order
    lengths = np.maximum(problem.ranges.high[0], -problem.ranges.low[0]) * scale
    powers = scale ** np.arange(order + 1)[:, None] / lengths
    given = ruckig.InputParameter(naxes)
    given.synchronization = ruckig.Synchronization.Time
    zero, free = [0.0] * naxes, [math.inf] * naxes
    # Relative to the start: the origin of the positions may be distant.
    start, end = problem.start * powers[:order], problem.end * powers[:order]
    end[0] = (problem.end[0] - problem.start[0]) * powers[0]
    given.current_position, given.target_position = zero, end[0].tolist()
    given.current_velocity, given.target_velocity = start[1].tolist(), end[1].tolist()
    given.current_acceleration, given.target_acceleration = (
        (row[2].tolist() if order == 3 else zero) for row in (start, end)
    )
    low, high = (side * powers[1:] for side in problem.ranges)
    given.min_velocity, given.max_velocity = low[0].tolist(), high[0].tolist()
    given.min_acceleration, given.max_acceleration = low[1].tolist(), high[1].tolist()
    given.max_jerk = high[2].tolist() if order == 3 else free
    found = ruckig.Trajectory(naxes)
    try:
        result = ruckig.Ruckig(naxes).calculate(given, found)
    except ruckig.RuckigError as error:
        raise _UnsolvedError(str(error).strip().splitlines()[0]) from None
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise _UnsolvedError(str(result))
    units = 1.0 / powers[order]
    return found.duration * scale, [
        _phases(profile, order, scale, float(unit), found.duration)
        for profile, unit in zip(found.profiles[0], units, strict=True)
    ]


def _phases(profile: Any, order: int, scale: float, unit: float, duration: float) -> Phases:
    """Durations and values of the phases of one axis, in the units of the problem."""
    parts = (profile.brake, profile, profile.accel)
    durations = np.concatenate([part.t for part in parts])
    values = np.concatenate([(part.j if order == 3 else part.a)[: len(part.t)] for part in parts])
    durations[durations < _NEGLIGIBLE * duration] = 0.0
    durations *= duration / durations.sum() if durations.any() else 1.0
    return (durations * scale).tolist(), (values * unit).tolist()


def _library() -> Any:
    try:
        import ruckig
    except ImportError:
        raise ImportError(
            "profiles from or to motion, and with different limits in both directions, require ruckig; install it with "
            'pip install "ctrlplan[otg]"'
        ) from None
    return ruckig


def _excess(profile: MotionProfile, ranges: Ranges) -> tuple[float, str]:
    """Maximum excess over the limits, as a fraction of their ranges, at the exact extrema of a profile; in words."""
    order, durations = len(profile.start_state), np.diff(profile.breakpoints)
    jets = np.concatenate(
        [profile.jet(profile.breakpoints[:-1], order), profile.jet(profile.breakpoints[1:], order, left=True)], axis=2
    )
    worst, words = -math.inf, ""
    for nu in range(1, order + 1):
        values = jets[nu]
        if nu == 1 and order == 3:  # where the acceleration is 0 within a segment
            v, a, j = (jets[k][:, : durations.size] for k in (1, 2, 3))
            with np.errstate(divide="ignore", invalid="ignore"):
                inside = (-a / j > 0.0) & (-a / j < durations)
                values = np.concatenate([values, np.where(inside, v - 0.5 * a * a / j, v)], axis=1)
        low, high = ranges.low[nu - 1], ranges.high[nu - 1]
        excess = np.maximum(values - high[:, None], low[:, None] - values).max(axis=1) / (high - low)
        axis = int(excess.argmax())
        if excess[axis] > worst:
            name = ("velocity", "acceleration", "jerk")[nu - 1]
            worst = float(excess[axis])
            words = f"{name} of {profile.labels[axis]} beyond {low[axis]:g} to {high[axis]:g} by {100.0 * worst:.2g} %"
    return worst, words
