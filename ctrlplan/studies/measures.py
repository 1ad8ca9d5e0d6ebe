"""What a comparison measures of each response: `MEASURES` is the only list."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ctrlplan import metrics
from ctrlplan.planning import SquaredDerivative
from ctrlplan.trajectories import Trajectory, Waypoint

Array = NDArray[np.float64]
Wanted = Collection[str] | None
"""Names of the metrics wanted, None for all."""

_TURNED = 1e-9
"""Net change, relative to the range of a plan, up to which the plan ends where it began."""


@dataclass(frozen=True)
class Tracked:
    """Outputs that follow a plan, as a `Measure` of responses receives them.

    Attributes
    ----------
    t : ndarray, shape (ntime,)
        Sample times [s] from `start` on.
    y, reference : ndarray, shapes (naxes, ntime)
        Outputs and the plan's positions; `y` may have more rows where the
        reference has one.
    initial, final : ndarray, shape (naxes,)
        First and last position of the plan.
    span : ndarray, shape (naxes,)
        Range of the plan: its maximum less its minimum.
    band, start : float
        Half width of the settling band relative to the range, and the time from
        which metrics count [s].
    """

    t: Array
    y: Array
    reference: Array
    initial: Array
    final: Array
    span: Array
    band: float
    start: float

    @cached_property
    def error(self) -> Array:
        """Reference less output, (naxes, ntime)."""
        return self.reference - self.y

    @cached_property
    def remainder(self) -> Array:
        """Final position less output, (naxes, ntime)."""
        return self.final[:, None] - self.y

    @cached_property
    def origin(self) -> Array:
        """Final position less the range, in the direction of the move: what relative metrics take for the beginning.

        The first position of a plan without reversals. The direction is that of the net change; of a plan that ends
        where it began, that of its farthest excursion.
        """
        net = self.final - self.initial
        far = self.reference - self.initial[:, None]
        farthest = far[np.arange(len(far)), np.abs(far).argmax(axis=1)]
        direction = np.sign(np.where(np.abs(net) > _TURNED * self.span, net, farthest))
        direction = np.where(direction == 0.0, 1.0, direction)
        return np.where(self.span == np.abs(net), self.initial, self.final - direction * self.span)


@dataclass(frozen=True)
class Acting:
    """Controls, as a `Measure` of controls receives them: sample times [s] from `start` on, u (ncontrols, ntime)."""

    t: Array
    u: Array
    start: float


@dataclass(frozen=True)
class Path:
    """A plan between its waypoints, as a `Measure` of paths receives it.

    Attributes
    ----------
    plan : Trajectory
        The plan.
    t : ndarray, shape (ntime,)
        Times [s] from the first waypoint to the last.
    path, points : ndarray, shapes (naxes, ntime) and (naxes, nwaypoints)
        Positions of the plan, and of the waypoints.
    """

    plan: Trajectory
    t: Array
    path: Array
    points: Array

    @property
    def steps(self) -> bool:
        """Whether the position jumps: steps take no path."""
        return bool(self.plan.jumps(0))


@dataclass(frozen=True)
class Measure:
    """A metric: how it is called, and how it is computed; less is better in every one.

    Attributes
    ----------
    title : str
        In words.
    unit : str
        Unit, where ``{y}`` and ``{u}`` stand for those of output and control.
    of : {"response", "control", "path"} or ""
        What `function` is given: `Tracked`, `Acting` or `Path`; empty where the
        values come from the `measure` of a comparison.
    function : callable, optional
        Maps that to one value for each axis or control, or, of a path, to one.

    Examples
    --------
    A metric of one's own is an entry of `MEASURES`, or of the ``measures`` of a comparison:

    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> from ctrlplan.studies import Measure
    >>> late = Measure("Error at the end", "{y}", "response", lambda seen: np.abs(seen.error[:, -1]))
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> loop = cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], 3.0)
    >>> found = cp.compare(loop, move, np.linspace(0, 20, 401), measures={"late": late})
    >>> round(found.metrics["step"]["late"], 9)  # 3/(s + 1) in unity feedback keeps 1/4
    0.25
    """

    title: str
    unit: str = ""
    of: Literal["", "response", "control", "path"] = ""
    function: Callable[[Any], Any] | None = None

    def __post_init__(self) -> None:
        if self.of not in ("", "response", "control", "path"):
            raise ValueError(f'of must be "response", "control" or "path", got {self.of!r}')
        if bool(self.of) != (self.function is not None):
            what = "a function" if self.of else "what it is of"
            raise ValueError(
                f"a measure with a function must say what it is of, and the other way round, got no {what}"
            )


def _smooth(function: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """A metric of a path, nan of steps, which take none."""
    return lambda seen: np.nan if seen.steps else function(seen)


MEASURES = {
    "settling_time": Measure(
        "Settling time",
        "s",
        "response",
        lambda seen: metrics.settling_time(seen.t, seen.y, seen.final, seen.origin, band=seen.band, start=seen.start),
    ),
    "tracking_settling_time": Measure(
        "Settling time of the error",
        "s",
        "response",
        lambda seen: metrics.tracking_settling_time(
            seen.t, seen.y, seen.reference, seen.final, seen.origin, band=seen.band, start=seen.start
        ),
    ),
    "overshoot_error": Measure(
        "Overshoot on the error",
        "%",
        "response",
        lambda seen: metrics.overshoot(seen.t, seen.y, seen.final, seen.origin, reference=seen.reference),
    ),
    "overshoot_final": Measure(
        "Overshoot on the final value",
        "%",
        "response",
        lambda seen: metrics.overshoot(seen.t, seen.y, seen.final, seen.origin),
    ),
    "lag_error": Measure(
        "Greatest lag behind the reference",
        "%",
        "response",
        lambda seen: metrics.lag(seen.t, seen.y, seen.final, seen.origin, reference=seen.reference),
    ),
    "iae": Measure("IAE against the reference", "{y} s", "response", lambda seen: metrics.iae(seen.t, seen.error)),
    "ise": Measure("ISE against the reference", "{y}^2 s", "response", lambda seen: metrics.ise(seen.t, seen.error)),
    "itae": Measure(
        "ITAE against the reference",
        "{y} s^2",
        "response",
        lambda seen: metrics.itae(seen.t, seen.error, start=seen.start),
    ),
    "iae_final": Measure(
        "IAE against the final value", "{y} s", "response", lambda seen: metrics.iae(seen.t, seen.remainder)
    ),
    "ise_final": Measure(
        "ISE against the final value", "{y}^2 s", "response", lambda seen: metrics.ise(seen.t, seen.remainder)
    ),
    "itae_final": Measure(
        "ITAE against the final value",
        "{y} s^2",
        "response",
        lambda seen: metrics.itae(seen.t, seen.remainder, start=seen.start),
    ),
    "control_peak": Measure("Peak of the control", "{u}", "control", lambda seen: metrics.peak(seen.t, seen.u)),
    "control_effort": Measure(
        "Effort of the control", "{u}^2 s", "control", lambda seen: metrics.effort(seen.t, seen.u)
    ),
    "control_variation": Measure(
        "Total variation of the control", "{u}", "control", lambda seen: metrics.total_variation(seen.t, seen.u)
    ),
    "wandering": Measure(
        "Path length beyond the waypoints' polyline",
        "",
        "path",
        _smooth(lambda seen: metrics.wandering(seen.t, seen.path, seen.points)),
    ),
    "excess_variation": Measure(
        "Variation beyond what the waypoints force",
        "",
        "path",
        _smooth(lambda seen: metrics.excess_variation(seen.t, seen.path, seen.points)),
    ),
    "turning_points": Measure(
        "Turning points beyond those forced",
        "",
        "path",
        _smooth(lambda seen: metrics.turning_points(seen.t, seen.path, seen.points)),
    ),
    "outside_box": Measure(
        "Distance outside the waypoints' box",
        "{y}",
        "path",
        _smooth(lambda seen: metrics.outside_box(seen.t, seen.path, seen.points)),
    ),
    "reference_jerk": Measure(
        "Integral of the reference's squared jerk", "{y}^2/s^5", "path", lambda seen: jerk_cost(seen.plan)
    ),
}
"""The metrics of a comparison by name, in the order in which they are shown: an entry is computed, listed and shown."""


def signals_of(response: Any) -> dict[str, Array]:
    """Outputs (ntime,) of a response by their labels."""
    return dict(zip(response.output_labels, np.asarray(response.outputs), strict=True))


def response_metrics(
    timepts: Array,
    y: Array,
    plan: Trajectory,
    start: float,
    band: float,
    labels: tuple[str, ...],
    only: Wanted = None,
    measures: Mapping[str, Measure] = MEASURES,
) -> dict[str, float]:
    """Metrics of tracked outputs (naxes, ntime) against their plan.

    Each is the worst over the axes; with more than one axis those of each axis
    follow, with the axis's label behind the name.
    """
    known = slice(int(np.searchsorted(timepts, start)), None)  # no copy of the rows
    t, y = timepts[known], y[:, known]
    reference = plan.jet(t, 0)[0]
    extrema = plan.extrema()
    span = np.maximum(extrema.maximum - extrema.minimum, np.abs(plan.final - plan.initial))
    seen = Tracked(t, y, reference, plan.initial, plan.final, span, band, start)
    return _measured("response", seen, labels, only, measures)


def control_metrics(
    timepts: Array,
    u: Array,
    start: float,
    labels: tuple[str, ...],
    only: Wanted = None,
    measures: Mapping[str, Measure] = MEASURES,
) -> dict[str, float]:
    """Metrics of the controls (ncontrols, ntime): the worst, and each where there are more."""
    known = slice(int(np.searchsorted(timepts, start)), None)  # no copy of the rows
    return _measured("control", Acting(timepts[known], u[:, known], start), labels, only, measures)


def path_metrics(
    plan: Trajectory,
    waypoints: tuple[Waypoint, ...],
    only: Wanted = None,
    measures: Mapping[str, Measure] = MEASURES,
) -> dict[str, float]:
    """Metrics of the reference's own path between the waypoints it was asked to meet."""
    points = np.array([w.position for w in waypoints]).T
    if len(waypoints) < 2 or np.isnan(points).any():
        return {}
    t = np.linspace(waypoints[0].time, waypoints[-1].time, 2001)
    seen = Path(plan, t, plan.jet(t, 0)[0], points)
    return {name: float(function(seen)) for name, function in _functions("path", only, measures)}


def jerk_cost(plan: Trajectory) -> float:
    """Integral of the squared jerk, inf where position, velocity or acceleration jumps."""
    return np.inf if plan.jumps(2) else SquaredDerivative(3)(plan)


def checked_names(names: Any, known: Collection[str], what: str) -> tuple[str, ...]:
    """Names given by a user, each among those known.

    Raises
    ------
    TypeError
        If they are a string, or not names.
    ValueError
        If one is unknown; the known ones are in the message.
    """
    listed = ", ".join(known) or "none"
    if isinstance(names, str):
        raise TypeError(f"{what} must be a collection of names, of {listed}, got the string {names!r}")
    found: tuple[Any, ...] = tuple(names)
    for name in found:
        if name not in known:
            raise ValueError(f"{what} must be among {listed}, got {name!r}")
    return found


def _functions(of: str, only: Wanted, measures: Mapping[str, Measure]) -> Sequence[tuple[str, Callable[[Any], Any]]]:
    """Metrics wanted of one kind, by name."""
    if isinstance(only, str):
        checked_names(only, measures, "only")
    return [
        (name, measure.function)
        for name, measure in measures.items()
        if measure.of == of and measure.function is not None and (only is None or name in only)
    ]


def _measured(
    of: str, seen: Any, labels: tuple[str, ...], only: Wanted, measures: Mapping[str, Measure]
) -> dict[str, float]:
    """The metrics wanted: the worst over the labels, then each where there are more than one."""
    rows = {name: np.atleast_1d(function(seen)) for name, function in _functions(of, only, measures)}
    found = {name: float(np.nan if np.isnan(row).all() else np.nanmax(row)) for name, row in rows.items()}
    if len(labels) > 1:
        for name, row in rows.items():
            found |= {f"{name}_{label}": float(v) for label, v in zip(labels, row, strict=True)}
    return found
