"""What a comparison measures of each response."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan import metrics
from ctrlplan.planning import SquaredDerivative
from ctrlplan.trajectories import Trajectory, Waypoint

Array = NDArray[np.float64]
Wanted = Collection[str] | None
"""Names of the metrics wanted, None for all."""


@dataclass(frozen=True)
class Measure:
    """How a metric is called and read; less is better in every one.

    Attributes
    ----------
    title : str
        In words.
    unit : str
        Unit, where ``{y}`` and ``{u}`` stand for those of output and control.
    """

    title: str
    unit: str = ""


MEASURES = {
    "settling_time": Measure("Settling time", "s"),
    "tracking_settling_time": Measure("Settling time of the error", "s"),
    "overshoot_error": Measure("Overshoot on the error", "%"),
    "overshoot_final": Measure("Overshoot on the final value", "%"),
    "lag_error": Measure("Greatest lag behind the reference", "%"),
    "iae": Measure("IAE against the reference", "{y} s"),
    "ise": Measure("ISE against the reference", "{y}^2 s"),
    "itae": Measure("ITAE against the reference", "{y} s^2"),
    "iae_final": Measure("IAE against the final value", "{y} s"),
    "ise_final": Measure("ISE against the final value", "{y}^2 s"),
    "itae_final": Measure("ITAE against the final value", "{y} s^2"),
    "control_peak": Measure("Peak of the control", "{u}"),
    "control_effort": Measure("Effort of the control", "{u}^2 s"),
    "control_variation": Measure("Total variation of the control", "{u}"),
    "wandering": Measure("Path length beyond the waypoints' polyline", ""),
    "excess_variation": Measure("Variation beyond what the waypoints force", ""),
    "turning_points": Measure("Turning points beyond those forced", ""),
    "outside_box": Measure("Distance outside the waypoints' box", "{y}"),
    "reference_jerk": Measure("Integral of the reference's squared jerk", "{y}^2/s^5"),
}


def signals_of(response: Any) -> dict[str, Array]:
    """Outputs (ntime,) of a response by their labels."""
    return dict(zip(response.output_labels, np.asarray(response.outputs), strict=True))


def response_metrics(
    timepts: Array, y: Array, plan: Trajectory, start: float, band: float, labels: tuple[str, ...], only: Wanted = None
) -> dict[str, float]:
    """Metrics of tracked outputs (naxes, ntime) against their plan.

    Each is the worst over the axes; with more than one axis those of each axis
    follow, with the axis's label behind the name.
    """
    known = slice(int(np.searchsorted(timepts, start)), None)  # no copy of the rows
    t, y = timepts[known], y[:, known]
    reference = plan.jet(t, 0)[0]
    initial, final = plan.initial, plan.final
    error, remainder = reference - y, final[:, None] - y
    return _measured(
        {
            "settling_time": lambda: metrics.settling_time(t, y, final, initial, band=band, start=start),
            "tracking_settling_time": lambda: metrics.tracking_settling_time(
                t, y, reference, final, initial, band=band, start=start
            ),
            "overshoot_error": lambda: metrics.overshoot(t, y, final, initial, reference=reference),
            "overshoot_final": lambda: metrics.overshoot(t, y, final, initial),
            "lag_error": lambda: metrics.lag(t, y, final, initial, reference=reference),
            "iae": lambda: metrics.iae(t, error),
            "ise": lambda: metrics.ise(t, error),
            "itae": lambda: metrics.itae(t, error, start=start),
            "iae_final": lambda: metrics.iae(t, remainder),
            "ise_final": lambda: metrics.ise(t, remainder),
            "itae_final": lambda: metrics.itae(t, remainder, start=start),
        },
        labels,
        only,
    )


def control_metrics(
    timepts: Array, u: Array, start: float, labels: tuple[str, ...], only: Wanted = None
) -> dict[str, float]:
    """Metrics of the controls (ncontrols, ntime): the worst, and each where there are more."""
    known = slice(int(np.searchsorted(timepts, start)), None)  # no copy of the rows
    t, u = timepts[known], u[:, known]
    return _measured(
        {
            "control_peak": lambda: metrics.peak(t, u),
            "control_effort": lambda: metrics.effort(t, u),
            "control_variation": lambda: metrics.total_variation(t, u),
        },
        labels,
        only,
    )


def path_metrics(plan: Trajectory, waypoints: tuple[Waypoint, ...]) -> dict[str, float]:
    """Metrics of the reference's own path between the waypoints it was asked to meet."""
    points = np.array([w.position for w in waypoints]).T
    if len(waypoints) < 2 or np.isnan(points).any():
        return {}
    t = np.linspace(waypoints[0].time, waypoints[-1].time, 2001)
    path = plan.jet(t, 0)[0]
    if plan.jumps(0):  # steps take no path
        names = ("wandering", "excess_variation", "turning_points", "outside_box")
        return dict.fromkeys(names, np.nan) | {"reference_jerk": np.inf}
    return {
        "wandering": float(metrics.wandering(t, path, points)),
        "excess_variation": float(metrics.excess_variation(t, path, points)),
        "turning_points": float(metrics.turning_points(t, path, points)),
        "outside_box": float(metrics.outside_box(t, path, points)),
        "reference_jerk": jerk_cost(plan),
    }


def jerk_cost(plan: Trajectory) -> float:
    """Integral of the squared jerk, inf where position, velocity or acceleration jumps."""
    return np.inf if plan.jumps(2) else SquaredDerivative(3)(plan)


def _measured(values: dict[str, Callable[[], Any]], labels: tuple[str, ...], only: Wanted) -> dict[str, float]:
    """The metrics wanted: the worst over the labels, then each where there are more than one."""
    rows = {name: np.atleast_1d(value()) for name, value in values.items() if only is None or name in only}
    found = {name: float(np.nan if np.isnan(row).all() else np.nanmax(row)) for name, row in rows.items()}
    if len(labels) > 1:
        for name, row in rows.items():
            found |= {f"{name}_{label}": float(v) for label, v in zip(labels, row, strict=True)}
    return found
