"""On-line methods: one crane in four scenarios, each with five control schemes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan import metrics
from ctrlplan.planning import fastest, margins
from ctrlplan.simulation import simulate
from ctrlplan.studies.comparison import Comparison, compare
from ctrlplan.studies.crane_governor import (
    FILTER,
    LAGS,
    LAW,
    PERIOD,
    START,
    AtLoadMotion,
    filtered_loop,
    governor_check,
)
from ctrlplan.studies.crane_setup import CRANE, TORQUE_LIMITS, UNITS, DriveLimits, nominal_waypoints
from ctrlplan.studies.measures import Measure, Run, signals_of
from ctrlplan.studies.sections import AnimatedCrane, CraneOnline
from ctrlplan.studies.study import Study
from ctrlplan.systems import (
    create_governor_iosystem,
    create_replanner_iosystem,
    create_source_iosystem,
    create_time_scaling_iosystem,
    expose_states,
)
from ctrlplan.systems.plants import crane_loop
from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Step, Trajectory, TrigSpline, Waypoint, stack

Array = NDArray[np.float64]

NEAR = 0.1
"""Distance from the goal [m] within which the load has arrived."""

ONLINE_MEASURES = {
    "arrival": Measure(f"Settling time to within {NEAR:g} m of the goal", "s"),
    "error_end": Measure("Peak distance from the goal in the last 5 s", "m"),
    "overshoot_goal": Measure("Overshoot beyond the goal", "m"),
    "error_reference": Measure("Peak tracking error", "m"),
    "sway_peak": Measure("Peak sway", "rad"),
    "sway_end": Measure("Peak sway in the last 5 s", "rad"),
    "force_peak": Measure("Peak trolley force", "N"),
    "limited_time": Measure("Time with the force at its limit", "s"),
}

_REPLANNED = 0.25
"""Period of the replanner [s]."""


@dataclass(frozen=True)
class Scenario:
    """Disturbance, limit or change of goal during a move of the crane.

    Attributes
    ----------
    goal : Trajectory
        Goal of the load over time.
    off_line : Trajectory
        Plan made without knowledge of the scenario.
    force : float
        Limit of the trolley force [N].
    wind : Trajectory or None
        Horizontal force on the load [N].
    params : dict of str to float
        Parameters of the crane that differ from the model of the controllers.
    """

    goal: Trajectory
    off_line: Trajectory
    force: float = 30e3
    wind: Trajectory | None = None
    params: dict[str, float] = field(default_factory=dict)

    @property
    def plan(self) -> Trajectory:
        """The plan of the move to the first goal."""
        return _move()


def online_gust_study(progress: bool = True) -> Study:
    """A gust of 300 N on the load during the move."""
    gust = PiecewiseSpline(
        [Waypoint(5.0, 0.0, 0.0), Waypoint(6.0, 300.0, 0.0), Waypoint(8.0, 300.0, 0.0), Waypoint(9.0, 0.0, 0.0)]
    )
    found = _compared(
        Scenario(_fixed_goal(), _move(), wind=gust), "On line: a gust on the load", "0 to 300 N, 5 to 9 s"
    )
    blind, law, again, governed, slowed = (found.metrics[name] for name in WAYS)
    return _study(
        "online-gust",
        found,
        "A horizontal gust of up to 300 N acts on the load from 5 s to 9 s, during the nominal move of 20 m in 15 s.",
        "The controller of figure 3 has no feedback of the load. With the off-line plan the sway in the last 5 s is "
        f"{blind['sway_end']:.2g} rad. When the plan is recomputed from the measured load position after a deviation "
        f"of 0.2 m, the load reaches the goal in {again['arrival']:.3g} s with the same controller: replanning acts "
        "as a feedback.",
        "Each new plan starts at the measured load position, so the reference jumps and the force is at its limit for "
        f"{again['limited_time']:.2g} s. With feedback of the load in the control law, the peak force is "
        f"{law['force_peak'] / 1e3:.2g} kN and the settling time is {law['arrival']:.3g} s.",
        f"The reference governor, with a filter in place of a plan, settles in {governed['arrival']:.3g} s. With time "
        f"scaling, which slows the plan while the tracking error is large, the settling time is "
        f"{slowed['arrival']:.3g} s.",
        "The order depends on the tuning: here a horizon of 6 s for replanning, and a bandwidth of 0.5 rad/s for the "
        "feedback of the load.",
    )


def online_payload_study(progress: bool = True) -> Study:
    """A load of twice the modelled mass."""
    found = _compared(
        Scenario(_fixed_goal(), _move(), params={"load_mass": 2.0 * CRANE.load_mass}),
        "On line: load mass twice the modelled value",
        f"m = {2.0 * CRANE.load_mass:g} kg, {CRANE.load_mass:g} kg in the model",
    )
    arrivals = ", ".join(f"{name} {values['arrival']:.3g} s" for name, values in found.metrics.items())
    return _study(
        "online-payload",
        found,
        "The mass of the load is twice the value used in the control laws and in the governor.",
        "The flat map of the load does not contain its mass, so the references of trolley and rope do not change. The "
        f"integral action of the drive controllers compensates the weight. Settling times: {arrivals}.",
        "Replanning has no effect here: the deviation of the load never exceeds the threshold that triggers it.",
    )


def online_goal_study(progress: bool = True) -> Study:
    """A change of the goal during the move."""
    goal, late = Step([24.0, 11.0], [20.0, 11.0], 7.5, labels=["x", "z"]), 8.0
    rest = nominal_waypoints(5)[1]
    further = Waypoint(rest.time + late, [24.0, 11.0], 0, 0, 0, 0)
    second = PolySpline([Waypoint(rest.time, [20.0, 11.0], 0, 0, 0, 0), further], labels=["x", "z"])
    found = _compared(
        Scenario(goal, _move().then(second)),
        "On line: change of the goal during the move",
        f"goal changed from x = 20 m to 24 m at 7.5 s; the off-line plan adds a second move of {late:g} s",
    )
    arrivals = {name: f"{values['arrival']:.3g} s" for name, values in found.metrics.items()}
    return _study(
        "online-goal",
        found,
        "At 7.5 s, half of the duration of the move, the goal is changed by 4 m. The off-line plan completes the first "
        "move and then makes a second one.",
        "Replanning from the current reference, continuous up to the fourth derivative, brings the load to the goal in "
        f"{arrivals['replanned']}, before the end of the first move. With the off-line plan and its second move the "
        f"settling time is {arrivals['off-line']}.",
        f"The governor needs no plan; its settling time is {arrivals['governed']}. Time scaling does not react to a "
        "change of the goal: its plan contains the second move as well.",
    )


def online_saturated_study(progress: bool = True) -> Study:
    """A force limit below the peak force of the plan."""
    limit = 2e3
    force = f"{limit / 1e3:g} kN, where the plan requires {_peak_force() / 1e3:.3g} kN"
    found = _compared(
        Scenario(_fixed_goal(), _move(), force=limit), "On line: saturated actuators", f"|F| at most {force}"
    )
    overshoots = {name: f"{values['overshoot_goal']:.2g} m" for name, values in found.metrics.items()}
    arrivals = {name: f"{values['arrival']:.3g} s" for name, values in found.metrics.items()}
    return _study(
        "online-saturated",
        found,
        f"The trolley force is limited to {force}.",
        f"With the off-line plan the trolley lags behind and overshoots the goal by {overshoots['off-line']}, in "
        f"spite of anti-windup. With feedback of the load the overshoot is {overshoots['load feedback']}, but the "
        "sway grows: the commanded force exceeds the limit.",
        f"Time scaling, which slows the plan as the tracking error grows, settles in {arrivals['slowed']} with an "
        f"overshoot of {overshoots['slowed']}; the governor, which respects the limit, settles in "
        f"{arrivals['governed']} with {overshoots['governed']}; replanning from the measured load settles in "
        f"{arrivals['replanned']} with {overshoots['replanned']}.",
        _in_time_note(limit),
    )


def online_metrics(goal: Array, force: float, response: ct.TimeResponseData) -> dict[str, float]:
    """Metrics of a crane relative to its final goal.

    Parameters
    ----------
    goal : array_like, shape (2,)
        x and z [m].
    force : float
        Limit of the trolley force [N].
    response : control.TimeResponseData
        Of a `crane_loop`.

    Returns
    -------
    dict of str to float
        The keys of `ONLINE_MEASURES`.
    """
    t = np.asarray(response.time)
    signals = signals_of(response)
    distance = np.hypot(signals["x"] - goal[0], signals["z"] - goal[1])
    error = np.hypot(signals["x"] - signals["x_ref"], signals["z"] - signals["z_ref"])
    end = t >= t[-1] - 5.0
    limit, far = force * (1.0 - 1e-9), max(float(distance.max()), NEAR)
    # Smaller than 0.1 mm, and the corresponding angle of the rope, counts as zero.
    left, sway = float(distance[end].max()), float(metrics.peak(t[end], signals["theta"][end]))
    return {
        "arrival": float(metrics.settling_time(t, distance, 0.0, far, NEAR / far)),
        "error_end": left if left > 1e-4 else 0.0,
        "overshoot_goal": max(0.0, float(metrics.peak(t, signals["x"])) - float(goal[0])),
        "error_reference": float(metrics.peak(t, error)),
        "sway_peak": float(metrics.peak(t, signals["theta"])),
        "sway_end": sway if sway > 1e-5 else 0.0,
        "force_peak": float(np.abs(signals["F"]).max()),
        "limited_time": float(metrics.saturation_time(t, signals["F"], -limit, limit)),
    }


# The five control schemes


def _off_line(scenario: Scenario, limits: DriveLimits) -> ct.InterconnectedSystem:
    return crane_loop(CRANE, scenario.off_line, "generator", wind=scenario.wind, **limits)


def _load_feedback(scenario: Scenario, limits: DriveLimits) -> ct.InterconnectedSystem:
    return crane_loop(CRANE, scenario.off_line, LAW, wind=scenario.wind, **limits)


def _replanned(scenario: Scenario, limits: DriveLimits) -> ct.InterconnectedSystem:
    """Flat map with replanning: from the reference for a new goal, from the load after a deviation."""
    if scenario.goal.start > scenario.plan.start:
        replanner = create_replanner_iosystem(
            scenario.plan, _REPLANNED, order=4, derivatives=2, goal_derivatives=0, trigger="goal", suffix="_ref"
        )
        reference = [replanner, create_source_iosystem(scenario.goal, name="goal", suffix="_goal")]
    else:
        replanner = create_replanner_iosystem(
            scenario.plan,
            _REPLANNED,
            horizon=6.0,
            alpha=1.0,
            measured=1,
            trigger="deviation",
            threshold=0.2,
            suffix="_ref",
        )
        reference = [replanner]
    return crane_loop(CRANE, scenario.plan, "generator", reference=reference, wind=scenario.wind, **limits)


def _governed(scenario: Scenario, limits: DriveLimits) -> ct.InterconnectedSystem:
    """Goal through a reference governor and a filter, without a plan."""
    core = filtered_loop(scenario.wind, limits)
    governor = create_governor_iosystem(AtLoadMotion(scenario.force), PERIOD, initial=START[:1])
    goal = stack([scenario.goal], labels=["x_command_cmd", "z_command"])
    exposed = expose_states(core)
    unread = set(exposed.output_labels) - {*governor.input_labels, *core.output_labels}
    return ct.interconnect(
        [create_source_iosystem(goal, name="goal"), governor, exposed],
        inputs=0,
        outputs=list(core.output_labels),
        name="governed",
        ignore_outputs=[f"{exposed.name}.{label}" for label in unread],
    )


def _slowed(scenario: Scenario, limits: DriveLimits) -> ct.InterconnectedSystem:
    scaling = create_time_scaling_iosystem(scenario.off_line, errors={"x": (0.05, 0.5)}, suffix="_ref")
    return crane_loop(CRANE, scenario.off_line, LAW, reference=[scaling], wind=scenario.wind, **limits)


WAYS: dict[str, Callable[[Scenario, DriveLimits], ct.InterconnectedSystem]] = {
    "off-line": _off_line,
    "load feedback": _load_feedback,
    "replanned": _replanned,
    "governed": _governed,
    "slowed": _slowed,
}


def _compared(scenario: Scenario, title: str, what: str) -> Comparison:
    timepts = np.linspace(0.0, 50.0, 2501)
    limits: DriveLimits = {"force_limits": (-scenario.force, scenario.force), "torque_limits": TORQUE_LIMITS}

    def build(name: str, plan: Trajectory) -> ct.InterconnectedSystem:
        return WAYS[name](scenario, limits)

    def measure(run: Run) -> Mapping[str, float]:
        return online_metrics(scenario.goal.final, scenario.force, run.response)

    return compare(
        build,
        dict.fromkeys(WAYS, scenario.off_line),
        timepts,
        outputs=("x", "z"),
        controls=("F", "C"),
        params=scenario.params,
        measures=[
            *(replace(one, name=name) for name, one in ONLINE_MEASURES.items()),
            Measure("Crane relative to its goal", of="run", function=measure),
        ],
        units=UNITS,
        title=title,
        parameters={
            "scenario": what,
            "move": "20 m horizontally and 1 m down in 15 s, trigonometric, alpha = 1, ten constraints per axis",
            "limits": f"|F| ≤ {scenario.force / 1e3:g} kN, C from −3 to 1 kN m, with anti-windup",
            "off-line": "the plan with the controller of figure 3, without feedback of the load",
            "load feedback": "the plan with feedback of the load position x, bandwidth 0.5 rad/s",
            "replanned": "controller of figure 3; for a new goal, a plan from the current reference, continuous up to "
            "the fourth derivative; otherwise a plan of 6 s from the measured load after a deviation of 0.2 m; checked "
            "every 0.25 s",
            "governed": f"no plan: the goal through a reference governor (period 0.5 s, linear model, 90 % of the "
            f"force limit, sway limit 0.2 rad) and a filter ({LAGS} first-order lags, {FILTER:g} rad/s); load "
            "feedback",
            "slowed": "the plan with time scaling, slowed from 0.05 m to 0.5 m of tracking error in x; load feedback",
            "simulated time": f"{timepts[-1]:g} s",
        },
    )


def _in_time_note(limit: float) -> str:
    """Result of a plan that takes the force limit into account from the start."""
    seconds = float(np.ceil(10.0 * fastest(_move(), {"F": limit}, CRANE).duration)) / 10.0
    loop = crane_loop(CRANE, _move().retime(seconds), LAW, force_limits=(-limit, limit), torque_limits=TORQUE_LIMITS)
    found = online_metrics(_fixed_goal().final, limit, simulate(loop, np.linspace(0.0, 50.0, 2501)))
    return (
        f"A plan that takes the limit into account from the start gives the best result: with a duration of "
        f"{seconds:.3g} s the same path requires at most {limit / 1e3:g} kN, and the load settles in "
        f"{found['arrival']:.3g} s with an overshoot of {found['overshoot_goal']:.1g} m."
    )


def _study(name: str, found: Comparison, summary: str, *notes: str) -> Study:
    response = found.responses["governed"]
    force = found.limits["governed"]["F"][1]
    checked, curves = governor_check(response, force)
    sections = (CraneOnline(), curves, AnimatedCrane())
    return Study(name, found.title, found, summary, (*notes, *checked, *found.notes), sections)


def _move() -> TrigSpline:
    """The nominal move with four zero derivatives at both ends, so that the force is continuous."""
    return TrigSpline(nominal_waypoints(5), alpha=1.0)


def _fixed_goal() -> Step:
    """A goal that does not change."""
    first, last = nominal_waypoints(1)
    return Step(last.position, first.position, labels=["x", "z"])


def _peak_force() -> float:
    """Peak trolley force of the move [N]."""
    return abs(margins(_move(), {"F": 1.0}, CRANE).active.value)
