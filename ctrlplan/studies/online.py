"""What is done while the loop runs: one crane, four troubles, each met in five ways."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan import metrics
from ctrlplan.planning import fastest, margins
from ctrlplan.simulation import simulate
from ctrlplan.studies.comparison import Comparison, compare
from ctrlplan.studies.crane_setup import CRANE, TORQUE_LIMITS, UNITS, DriveLimits, nominal_waypoints
from ctrlplan.studies.measures import Measure, Run, signals_of
from ctrlplan.studies.sections import AnimatedCrane, CraneOnline
from ctrlplan.studies.study import Study
from ctrlplan.systems import (
    AdmissibleSet,
    create_command_filter_iosystem,
    create_governor_iosystem,
    create_replanner_iosystem,
    create_source_iosystem,
    create_time_scaling_iosystem,
    expose_states,
)
from ctrlplan.systems.plants import LoadFeedbackLaw, crane_loop
from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Step, Trajectory, TrigSpline, Waypoint, stack

Array = NDArray[np.float64]

NEAR = 0.1
"""Distance from the goal [m] within which the load counts as there."""

ONLINE_MEASURES = {
    "arrival": Measure(f"Load within {NEAR:g} m of the goal for good", "s"),
    "error_end": Measure("Greatest distance from the goal in the last 5 s", "m"),
    "overshoot_goal": Measure("Greatest distance beyond the goal", "m"),
    "error_reference": Measure("Greatest distance from the reference in force", "m"),
    "sway_peak": Measure("Greatest sway", "rad"),
    "sway_end": Measure("Greatest sway in the last 5 s", "rad"),
    "force_peak": Measure("Greatest force of the trolley", "N"),
    "limited_time": Measure("Time with that force at its limit", "s"),
}

START = nominal_waypoints(1)[0].position
_LAW = LoadFeedbackLaw(load_bandwidth=0.5)
_FILTER, _LAGS = 0.8, 5
"""Bandwidth [rad/s] and order of the filter behind the governor: references of force that is continuous."""
_PERIODS = {"replanned": 0.25, "governed": 0.5}


@dataclass(frozen=True)
class Scenario:
    """What happens to the crane on its way.

    Attributes
    ----------
    goal : Trajectory
        Where the load is to go, over time.
    off_line : Trajectory
        What is planned without knowing of the scenario.
    force : float
        Greatest force of the trolley [N].
    wind : Trajectory or None
        Horizontal force on the load [N].
    params : dict of str to float
        Parameters of the crane that the loop does not know of.
    """

    goal: Trajectory
    off_line: Trajectory
    force: float = 30e3
    wind: Trajectory | None = None
    params: dict[str, float] = field(default_factory=dict)

    @property
    def plan(self) -> Trajectory:
        """The move as it was planned before the goal was moved."""
        return _move()


def online_gust_study(progress: bool = True) -> Study:
    """A gust of 300 N on the load, half way."""
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
        "A gust pushes the load with up to 300 N from 5 to 9 s, on the nominal move of 20 m in 15 s.",
        f"Figure 3's generator does not see the load: off line it still swings by {blind['sway_end']:.2g} rad at the "
        "end of the run. Replanned from the measured load every time it is 0.2 m off, the same generator brings it to "
        f"the goal in {again['arrival']:.3g} s: planning again is a feedback.",
        "It has its price: every fit begins where the load is, the reference jumps there, and the force is at its "
        f"limit for {again['limited_time']:.2g} s. Feedback of the load by the law itself needs "
        f"{law['force_peak'] / 1e3:.2g} kN and arrives after {law['arrival']:.3g} s.",
        f"The governed way, which has no plan but a filter, arrives after {governed['arrival']:.3g} s. The slowed "
        f"clock waits while the law gets the load back: {slowed['arrival']:.3g} s.",
        "Who is first hangs on how fast each is made: fits over 6 s here, feedback with 0.5 rad/s.",
    )


def online_payload_study(progress: bool = True) -> Study:
    """A load twice as heavy as modelled."""
    found = _compared(
        Scenario(_fixed_goal(), _move(), params={"load_mass": 2.0 * CRANE.load_mass}),
        "On line: a load twice as heavy as modelled",
        f"m = {2.0 * CRANE.load_mass:g} kg, modelled as {CRANE.load_mass:g} kg",
    )
    arrivals = ", ".join(f"{name} {values['arrival']:.3g} s" for name, values in found.metrics.items())
    return _study(
        "online-payload",
        found,
        "The load is twice as heavy as laws, drives and governor take it to be.",
        "The flat map of the load does not contain its mass: references of trolley and rope are the same, and the "
        f"drives' integral action finds the weight. Arrivals: {arrivals}.",
        "There is nothing here that planning again could mend: the load is never so far off that it is tried.",
    )


def online_goal_study(progress: bool = True) -> Study:
    """A goal that is moved at half way."""
    goal, late = Step([24.0, 11.0], [20.0, 11.0], 7.5, labels=["x", "z"]), 8.0
    rest = nominal_waypoints(5)[1]
    further = Waypoint(rest.time + late, [24.0, 11.0], 0, 0, 0, 0)
    second = PolySpline([Waypoint(rest.time, [20.0, 11.0], 0, 0, 0, 0), further], labels=["x", "z"])
    found = _compared(
        Scenario(goal, _move().then(second)),
        "On line: the goal moved at half way",
        f"from x = 20 to 24 m at 7.5 s; off line a second move of {late:g} s follows the first",
    )
    arrivals = {name: f"{values['arrival']:.3g} s" for name, values in found.metrics.items()}
    return _study(
        "online-goal",
        found,
        "At 7.5 s, half way, the goal is moved by 4 m. Off line the crane finishes its move and makes another.",
        "Replanned from the reference, which goes on without a jump up to its fourth derivative, the load is there "
        f"after {arrivals['replanned']}, before the first move was to end; the second move takes until "
        f"{arrivals['off-line']}.",
        f"The governor needs no plan at all and takes {arrivals['governed']}. Slowing the clock is no answer to a "
        "goal: that plan makes the second move as well.",
    )


def online_saturated_study(progress: bool = True) -> Study:
    """Trolley with less force than the plan asks for."""
    limit = 2e3
    force = f"{limit / 1e3:g} kN where the plan asks for {_peak_force() / 1e3:.3g} kN"
    found = _compared(
        Scenario(_fixed_goal(), _move(), force=limit), "On line: saturated actuators", f"|F| at most {force}"
    )
    past = {name: f"{values['overshoot_goal']:.2g} m past the goal" for name, values in found.metrics.items()}
    arrivals = {name: f"{values['arrival']:.3g} s" for name, values in found.metrics.items()}
    return _study(
        "online-saturated",
        found,
        f"The trolley has {force}.",
        f"Off line the trolley falls behind and runs {past['off-line']}, anti-windup or not. With feedback of the load "
        f"it is {past['load feedback']}, but the sway goes on growing: feedback asks for more, which is not there.",
        f"A clock that slows as the error grows arrives after {arrivals['slowed']}, {past['slowed']}; the governor, "
        f"which never asks for more than there is, after {arrivals['governed']}, {past['governed']}; replanned from "
        f"the measured load it is {arrivals['replanned']}, {past['replanned']}.",
        _in_time_note(limit),
    )


def online_metrics(goal: Array, force: float, response: ct.TimeResponseData) -> dict[str, float]:
    """Metrics of a crane against the goal that it has in the end.

    Parameters
    ----------
    goal : array_like, shape (2,)
        x and z [m].
    force : float
        Greatest force of the trolley [N].
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
    behind = np.hypot(signals["x"] - signals["x_ref"], signals["z"] - signals["z_ref"])
    end = t >= t[-1] - 5.0
    limit, far = force * (1.0 - 1e-9), max(float(distance.max()), NEAR)
    # Below a tenth of a millimetre, and what that is of the rope, nothing is left.
    left, sway = float(distance[end].max()), float(metrics.peak(t[end], signals["theta"][end]))
    return {
        "arrival": float(metrics.settling_time(t, distance, 0.0, far, NEAR / far)),
        "error_end": left if left > 1e-4 else 0.0,
        "overshoot_goal": max(0.0, float(metrics.peak(t, signals["x"])) - float(goal[0])),
        "error_reference": float(metrics.peak(t, behind)),
        "sway_peak": float(metrics.peak(t, signals["theta"])),
        "sway_end": sway if sway > 1e-5 else 0.0,
        "force_peak": float(np.abs(signals["F"]).max()),
        "limited_time": float(metrics.saturation_time(t, signals["F"], -limit, limit)),
    }


# The five ways


def _off_line(scenario: Scenario, limits: DriveLimits) -> ct.InterconnectedSystem:
    return crane_loop(CRANE, scenario.off_line, "generator", wind=scenario.wind, **limits)


def _load_feedback(scenario: Scenario, limits: DriveLimits) -> ct.InterconnectedSystem:
    return crane_loop(CRANE, scenario.off_line, _LAW, wind=scenario.wind, **limits)


def _replanned(scenario: Scenario, limits: DriveLimits) -> ct.InterconnectedSystem:
    """Generator, its plan made again: from the reference for a new goal, from the load where that is off."""
    period = _PERIODS["replanned"]
    if scenario.goal.start > scenario.plan.start:
        replanner = create_replanner_iosystem(
            scenario.plan, period, order=4, derivatives=2, goal_derivatives=0, trigger="goal", suffix="_ref"
        )
        reference = [replanner, create_source_iosystem(scenario.goal, name="goal", suffix="_goal")]
    else:
        replanner = create_replanner_iosystem(
            scenario.plan,
            period,
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
    """Goal itself through a governor and a filter: no plan."""
    core = _filtered_loop(scenario.wind, limits)
    governor = create_governor_iosystem(_admissible(scenario.force), initial=START[:1])
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
    return crane_loop(CRANE, scenario.off_line, _LAW, reference=[scaling], wind=scenario.wind, **limits)


WAYS: dict[str, Callable[[Scenario, DriveLimits], ct.InterconnectedSystem]] = {
    "off-line": _off_line,
    "load feedback": _load_feedback,
    "replanned": _replanned,
    "governed": _governed,
    "slowed": _slowed,
}


def _filtered_loop(wind: Trajectory | None = None, limits: DriveLimits | None = None) -> ct.InterconnectedSystem:
    """Crane with load feedback behind filters of commands x_command and z_command."""
    filters = [
        create_command_filter_iosystem(
            _FILTER, 2, _LAGS, initial=start, inputs=f"{axis}_command", outputs=f"{axis}_ref"
        )
        for axis, start in zip(("x", "z"), START.tolist(), strict=True)
    ]
    inputs = ["x_command", "z_command"]
    return crane_loop(
        CRANE, _constant_start(), _LAW, reference=filters, inputs=inputs, wind=wind, **(limits or DriveLimits())
    )


@cache
def _admissible(force: float) -> AdmissibleSet:
    """What keeps nine tenths of a force, on the way across linearised half way down; the hoist does not act on it."""
    loop = _filtered_loop()
    rest = np.array(loop.initial_state)
    middle = 0.5 * (START[1] + 11.0)
    rest[loop.nstates - 6 :] = CRANE.equilibrium(0.0, middle)[0]
    rest[_LAGS] = middle
    linear = ct.linearize(loop, rest, [0.0, middle])
    across = ("x_ref", "trolley", "crane_D", "crane_theta")
    rows = [k for k, label in enumerate(loop.state_labels) if label.startswith(across)]
    outputs = [loop.output_labels.index(label) for label in ("F", "theta")]
    a, b, c = (np.asarray(matrix) for matrix in (linear.A, linear.B, linear.C))
    model = ct.ss(
        a[np.ix_(rows, rows)],
        b[rows, :1],
        c[np.ix_(outputs, rows)],
        np.zeros((2, 1)),
        inputs=["x_command"],
        outputs=["F", "theta"],
        states=[loop.state_labels[k] for k in rows],
    )
    limit = 0.9 * force
    return AdmissibleSet(
        model,
        {"F": (-limit, limit), "theta": (-0.2, 0.2)},
        _PERIODS["governed"],
        margin=0.05,
        origin=(rest[rows], 0.0),
    )


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
            Measure("Crane against its goal", of="run", function=measure),
        ],
        units=UNITS,
        title=title,
        parameters={
            "scenario": what,
            "move": "20 m across and 1 m down in 15 s, trigonometric, alpha = 1, ten constraints an axis",
            "limits": f"|F| ≤ {scenario.force / 1e3:g} kN, C from −3 to 1 kN m, with anti-windup",
            "off-line": "the plan through figure 3's generator, which does not see the load",
            "load feedback": "the plan through the law with feedback of the load's x, 0.5 rad/s",
            "replanned": "figure 3's generator; for a new goal from the reference, joined to the fourth derivative; "
            "else from the measured load where it is 0.2 m off, over 6 s; looked at every 0.25 s",
            "governed": f"the goal itself, without a plan, through a governor (every 0.5 s, linear model, 0.9 of the "
            f"limit, 0.2 rad) and a filter ({_LAGS} lags of {_FILTER:g} rad/s); load feedback",
            "slowed": "the plan on a clock that slows from 0.05 to 0.5 m of error in x; load feedback",
            "run": f"{timepts[-1]:g} s",
        },
    )


def _in_time_note(limit: float) -> str:
    """What it is worth to know a limit before one starts."""
    seconds = float(np.ceil(10.0 * fastest(_move(), {"F": limit}, CRANE).duration)) / 10.0
    loop = crane_loop(CRANE, _move().retime(seconds), _LAW, force_limits=(-limit, limit), torque_limits=TORQUE_LIMITS)
    found = online_metrics(_fixed_goal().final, limit, simulate(loop, np.linspace(0.0, 50.0, 2501)))
    return (
        f"Who knows the limit before the start does best: in {seconds:.3g} s the same path asks for no more than "
        f"{limit / 1e3:g} kN, and the load arrives after {found['arrival']:.3g} s, "
        f"{found['overshoot_goal']:.1g} m past the goal."
    )


def _study(name: str, found: Comparison, summary: str, *notes: str) -> Study:
    return Study(name, found.title, found, summary, (*notes, *found.notes), (CraneOnline(), AnimatedCrane()))


def _move() -> TrigSpline:
    """The nominal move with four derivatives at rest at both ends: a force without jumps."""
    return TrigSpline(nominal_waypoints(5), alpha=1.0)


def _fixed_goal() -> Step:
    """A goal that is there from the start."""
    first, last = nominal_waypoints(1)
    return Step(last.position, first.position, labels=["x", "z"])


def _constant_start() -> Step:
    return Step(START, START, labels=["x", "z"])


def _peak_force() -> float:
    """Greatest force that the move asks of the trolley [N]."""
    return abs(margins(_move(), {"F": 1.0}, CRANE).active.value)
