"""The crane of the studies: its parameters, its moves, and what is measured of it."""

from __future__ import annotations

from typing import TypedDict

import control as ct
import numpy as np

from ctrlplan import metrics
from ctrlplan._types import Array
from ctrlplan.simulation import Event
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.measures import Measure, signals_of
from ctrlplan.systems.plants import Crane
from ctrlplan.trajectories import Trajectory, Waypoint

CRANE = Crane()


class DriveLimits(TypedDict, total=False):
    """Limits of the drives of a `crane_loop`."""

    force_limits: tuple[float, float]
    torque_limits: tuple[float, float]


FORCE_LIMITS = (-30e3, 30e3)
TORQUE_LIMITS = (-3e3, 1e3)
WALL = ((7.0, 13.0), (6.5, 12.0))
"""The obstacle of the third simulation: sides in x and in z (down) [m]."""
SLACK = Event("T", low=0.0, stop=True, name="rope tension")
"""Where the model ends: a rope only pulls."""

CRANE_MEASURES = {
    "error_travel": Measure("Greatest error of the load on the way", "m"),
    "error_after": Measure("Greatest error of the load afterwards", "m"),
    "sway_after": Measure("Greatest sway afterwards", "rad"),
    "force_peak": Measure("Greatest force asked of the trolley", "N"),
    "error_limited": Measure("Greatest error with the drives limited", "m"),
    "slack_time": Measure("Time with a slack rope", "s"),
    "path_length": Measure("Length of the planned path", "m"),
    "load_path": Measure("Length of the load's path", "m"),
}

UNITS = {"x": "m", "z": "m", "F": "N", "C": "N m", "theta": "rad", "T": "N", "R": "m"}


def nominal_waypoints(prescribed: int = 3) -> tuple[Waypoint, Waypoint]:
    """First simulation: 20 m across and 1 m down in 15 s, `prescribed` entries prescribed at both ends."""
    zeros = [0.0] * (prescribed - 1)
    return (
        Waypoint.from_jets(0.0, x=[0.0, *zeros], z=[10.0, *zeros]),
        Waypoint.from_jets(15.0, x=[20.0, *zeros], z=[11.0, *zeros]),
    )


def first_order_waypoints() -> tuple[Waypoint, Waypoint]:
    """Second simulation: only the two positions, in 30 s."""
    return Waypoint.from_jets(0.0, x=[0.0], z=[10.0]), Waypoint.from_jets(30.0, x=[20.0], z=[11.0])


def obstacle_waypoints(duration: float = 16.0) -> tuple[Waypoint, ...]:
    """Third simulation: over a wall, through A at 6 s and B at 11 s."""
    return (
        Waypoint.from_jets(0.0, x=[0.0, 0.0, 0.0], z=[10.0, 0.0, 0.0]),
        Waypoint.from_jets(6.0, x=[5.0, 1.0, 0.1], z=[5.0, -1.0, -0.15]),
        Waypoint.from_jets(11.0, x=[15.0, 2.0, 0.1], z=[5.0, 1.0, 1.0]),
        Waypoint.from_jets(duration, x=[20.0, 0.0, 0.0], z=[11.0, 0.0, 0.0]),
    )


def load_metrics(plan: Trajectory, response: ct.TimeResponseData, last: float) -> dict[str, float]:
    """Metrics of the load against its plan, the way before `last` [s] and the time after.

    Parameters
    ----------
    plan : Trajectory
        Plan of x and z.
    response : control.TimeResponseData
        Of a `crane_loop`.
    last : float
        Time of the last waypoint [s].

    Returns
    -------
    dict of str to float
        The keys of `CRANE_MEASURES`.
    """
    t = np.asarray(response.time)
    signals = signals_of(response)
    load = np.stack([signals["x"], signals["z"]])
    error = np.hypot(*(load - plan.jet(t, 0)[0]))
    way, after = t <= last, t >= last
    travelled = None if plan.jumps(0) else plan.jet(np.linspace(plan.start, plan.end, 4001), 0)[0]
    slack = float(metrics.saturation_time(t, signals["T"], 0.0, np.inf))
    return {
        "error_travel": _peak(t[way], error[way]),
        "error_after": _peak(t[after], error[after]),
        "sway_after": _peak(t[after], signals["theta"][after]),
        "force_peak": _limited_peak(t, signals["F"]),
        "slack_time": slack if slack > 1e-9 * (t[-1] - t[0]) else 0.0,  # a run that ends there is at 0 to rounding
        "path_length": np.nan
        if travelled is None
        else float(metrics.path_length(np.linspace(plan.start, plan.end, 4001), travelled)),
        "load_path": float(metrics.path_length(t, load)),
    }


LOAD = Measure("Load against its plan", of="run", function=lambda run: load_metrics(run.plan, run.response, run.last))
"""Metrics of the load, which `CRANE_MEASURES` describes."""


def _limited_peak(t: Array, values: Array) -> float:
    """Greatest magnitude of what a limit may cut off: a curve through samples would go beyond it at the corner."""
    size = np.abs(values)
    return float(size.max()) if np.count_nonzero(size == size.max()) > 1 else _peak(t, values)


def _peak(t: Array, values: Array) -> float:
    """Greatest magnitude, nan of a record too short to have one."""
    return float(metrics.peak(t, values)) if t.size > 1 else np.nan


def marked_slack(found: Comparison) -> Comparison:
    """Comparison with a mark on every plan whose rope goes slack, at `SLACK` or in a run that goes on."""
    ended = {
        name: f"the rope is slack from {time:.4g} s on, where the model of the crane ends"
        for name, time in found.stopped.items()
        if any(event.name == SLACK.name and event.stop for event in found.responses[name].events)
    }
    found = found.marked(ended)
    slack = {name: values["slack_time"] for name, values in found.metrics.items() if values["slack_time"] > 0.0}
    return found.marked(
        {
            name: f"the rope is slack for {time:.2g} s; from then on the model is no crane"
            for name, time in slack.items()
        }
    )
