"""The crane of the studies: parameters, moves and metrics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypedDict

import control as ct
import numpy as np

from ctrlplan import metrics
from ctrlplan._types import Array
from ctrlplan.planning import plan_length
from ctrlplan.simulation import Event
from ctrlplan.studies.baselines import are_equal
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
"""Event at which the model is no longer valid: the rope tension must stay positive."""

_LOAD = (
    "Peak tracking errors: distance of the load from its planned position in the plane, up to the last waypoint and "
    "after it; with limited drives, over the whole run with the limits of the step run. Residual sway: peak angle of "
    "the rope after the last waypoint."
)
CRANE_MEASURES = {
    "error_travel": Measure("Peak tracking error during the move", "m", definition=_LOAD),
    "error_after": Measure("Peak tracking error after the move (residual)", "m", definition=_LOAD),
    "sway_after": Measure(
        "Residual sway",
        "rad",
        of="run",
        function=lambda run: _residual_sway(run.t, run.signals, run.last),
        definition=_LOAD,
    ),
    "force_peak": Measure(
        "Peak trolley force", "N", of="run", function=lambda run: _limited_peak(run.t, run.signals["F"])
    ),
    "error_limited": Measure("Peak tracking error with limited drives", "m", definition=_LOAD),
    "slack_time": Measure("Time with slack rope", "s"),
    "path_length": Measure("Path length of the plan", "m"),
    "load_path": Measure("Path length of the load", "m"),
}

UNITS = {"x": "m", "z": "m", "F": "N", "C": "N m", "theta": "rad", "T": "N", "R": "m"}


def nominal_waypoints(prescribed: int = 3) -> tuple[Waypoint, Waypoint]:
    """First simulation: 20 m across and 1 m down in 15 s; `prescribed` values per axis and end, derivatives zero."""
    zeros = [0.0] * (prescribed - 1)
    return (
        Waypoint.from_jets(0.0, x=[0.0, *zeros], z=[10.0, *zeros]),
        Waypoint.from_jets(15.0, x=[20.0, *zeros], z=[11.0, *zeros]),
    )


def first_order_waypoints() -> tuple[Waypoint, Waypoint]:
    """Second simulation: two positions, 30 s apart."""
    return Waypoint.from_jets(0.0, x=[0.0], z=[10.0]), Waypoint.from_jets(30.0, x=[20.0], z=[11.0])


def obstacle_waypoints(duration: float = 16.0) -> tuple[Waypoint, ...]:
    """Third simulation: over a wall, through A at 6 s and B at 11 s."""
    return (
        Waypoint.from_jets(0.0, x=[0.0, 0.0, 0.0], z=[10.0, 0.0, 0.0]),
        Waypoint.from_jets(6.0, x=[5.0, 1.0, 0.1], z=[5.0, -1.0, -0.15]),
        Waypoint.from_jets(11.0, x=[15.0, 2.0, 0.1], z=[5.0, 1.0, 1.0]),
        Waypoint.from_jets(duration, x=[20.0, 0.0, 0.0], z=[11.0, 0.0, 0.0]),
    )


@dataclass(frozen=True)
class LoopsOfPlans:
    """Loops that contain their plan, built once for equal plans."""

    _built: list[tuple[Trajectory, object, ct.InterconnectedSystem]] = field(default_factory=list)

    def loop(
        self, plan: Trajectory, options: object, build: Callable[[], ct.InterconnectedSystem]
    ) -> ct.InterconnectedSystem:
        """Loop of a plan, that of an equal plan with equal options if there is one."""
        for other, others, loop in self._built:
            if others == options and are_equal(plan, other):
                return loop
        self._built.append((plan, options, build()))
        return self._built[-1][2]


def load_metrics(plan: Trajectory, response: ct.TimeResponseData, last: float) -> dict[str, float]:
    """Tracking error and sway of the load during the move, up to `last` [s], and after it.

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
    t, signals = np.asarray(response.time), signals_of(response)
    return _tracking(plan, t, signals, last) | {
        "sway_after": _residual_sway(t, signals, last),
        "force_peak": _limited_peak(t, signals["F"]),
    }


def _tracking(plan: Trajectory, t: Array, signals: dict[str, Array], last: float) -> dict[str, float]:
    """Tracking error of the load, time with a slack rope, and path lengths."""
    load = np.stack([signals["x"], signals["z"]])
    error = np.hypot(*(load - plan.jet(t, 0)[0]))
    during, after = t <= last, t >= last
    lasts = t.size > 1  # a run that an event ends at its first sample has integrals of 0
    slack = float(metrics.saturation_time(t, signals["T"], 0.0, np.inf)) if lasts else 0.0
    return {
        "error_travel": _peak(t[during], error[during]),
        "error_after": _peak(t[after], error[after]),
        "slack_time": slack
        if slack > 1e-9 * (t[-1] - t[0])
        else 0.0,  # at the event itself the tension is 0 up to rounding
        "path_length": np.nan if plan.jumps(0) else plan_length(plan),
        "load_path": float(metrics.path_length(t, load)) if lasts else 0.0,
    }


LOAD = Measure("Tracking of the load", of="run", function=lambda run: _tracking(run.plan, run.t, run.signals, run.last))
"""Measure that returns the metrics of `CRANE_MEASURES` that have no function of their own."""


def _residual_sway(t: Array, signals: dict[str, Array], last: float) -> float:
    """Peak angle of the rope from the time of the last waypoint on."""
    after = t >= last
    return _peak(t[after], signals["theta"][after])


def _limited_peak(t: Array, values: Array) -> float:
    """Peak magnitude of a signal that may saturate: interpolation between samples would exceed the limit there."""
    size = np.abs(values)
    return float(size.max()) if np.count_nonzero(size == size.max()) > 1 else _peak(t, values)


def _peak(t: Array, values: Array) -> float:
    """Peak magnitude; nan for fewer than two samples."""
    return float(metrics.peak(t, values)) if t.size > 1 else np.nan


def marked_slack(found: Comparison) -> Comparison:
    """Comparison with a mark on each plan with a slack rope, whether the event `SLACK` ended the run or not."""
    ended = {
        name: f"the rope is slack from {time:.4g} s on, and the model is not valid for a slack rope"
        for name, time in found.stopped.items()
        if any(event.name == SLACK.name and event.stop for event in found.responses[name].events)
    }
    found = found.marked(ended)
    slack = {
        name: values["slack_time"] for name, values in found.metrics.items() if values.get("slack_time", 0.0) > 0.0
    }
    return found.marked(
        {
            name: f"the rope is slack for {time:.2g} s, and the model is not valid for a slack rope"
            for name, time in slack.items()
        }
    )
