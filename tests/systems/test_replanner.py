"""Replanners: compiled and in Python, wrong arguments, absolute times, names, and in loops."""

import math

import control as ct
import numpy as np
import pytest
from replanner_oracle import METHODS, PLAN, REST, UNREACHABLE, block_outputs, happened, signals, state_of, steps
from scipy.interpolate import BPoly

import ctrlplan as cp
from ctrlplan import Waypoint

# Methods


@pytest.fixture(scope="module")
def rich():
    """Two axes, a goal that moves, position and speed measured on lagging plants: by each method."""
    plan = cp.TrigSpline(
        [Waypoint(1.0, [0, 1], 0, 0), Waypoint(5.0, [1, 0], [0.2, 0.1]), Waypoint(9.0, [3, -1], 0, 0)],
        alpha=2.0,
        labels=["x", "z"],
    )
    replanner = cp.create_replanner_iosystem(
        plan, 0.25, measured=1, goal_derivatives=1, suffix="_r", limits={1: [3.0, 3.0], 2: 8.0}, offset=0.1
    )
    a, b = np.array([[0.0, 1.0], [-16.0, -8.0]]), np.array([[0.0, 0.0, 0.0], [16.0, 8.0, 1.0]])
    plants = [
        ct.ss(
            a, b, np.eye(2), 0, inputs=[f"{s}_r", f"{s}_r_d1", f"{s}_r_d2"], outputs=[s, f"{s}_d1"], name=f"plant_{s}"
        )
        for s in "xz"
    ]
    outputs = ["x", "z", *replanner.output_labels]
    loop = ct.interconnect([replanner, *plants], inputs=replanner.input_labels[:4], outputs=[*outputs, "x_d1", "z_d1"])
    t = np.linspace(0.0, 11.0, 221)
    goal = {"x_goal": steps((3.3, 3.5), initial=3.0), "z_goal": cp.Step(-0.6, -1.0, 4.1)}
    state = np.zeros(loop.nstates)
    state[-4:] = [0.05, 0.0, 1.0, -0.1]
    return t, {method: cp.simulate(loop, t, goal, state, method=method, rtol=1e-9, atol=1e-11) for method in METHODS}


@pytest.mark.slow
def test_compiled_and_python_agree(rich):
    _, runs = rich
    assert [runs[method].method for method in METHODS] == list(METHODS)
    one, other = (runs[method] for method in METHODS)
    assert np.abs(one.outputs - other.outputs).max() <= 1e-6 * np.abs(one.outputs).max()
    assert np.array_equal(state_of(one, "fits"), state_of(other, "fits"))
    assert state_of(one, "fits")[-1] > 10
    assert [str(e) for e in one.events] == [str(e) for e in other.events]


@pytest.mark.slow
def test_the_loop_of_two_axes_gets_to_its_goals(rich):
    _, runs = rich
    assert np.abs(runs["compiled"].outputs[:2, -1] - [3.5, -0.6]).max() <= 2e-2


def test_it_runs_in_the_hybrid_loop_by_default():
    found = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5), np.linspace(0, 10, 21))
    assert found.method == "compiled"


# Bad input

TRIG = cp.TrigSpline(REST, alpha=1.0)
BAD = [
    ({"dt": 0.0}, "dt must be finite and above 0, got 0.0"),
    ({"dt": -0.1}, "dt must be finite and above 0, got -0.1"),
    ({"dt": math.nan}, "dt must be finite and above 0, got nan"),
    ({"dt": 10.5}, "dt must be at most the plan's duration, 10 s, got 10.5 s"),
    ({"dt": 1.5, "horizon": 1.0}, "dt must be at most the horizon, 1 s, got 1.5 s"),
    ({"horizon": 0.0}, "horizon must be finite and above 0, got 0.0"),
    ({"horizon": math.inf}, "horizon must be finite and above 0, got inf"),
    ({"horizon": "growing"}, "horizon must be a number of seconds or \"shrinking\", got 'growing'"),
    ({"min_horizon": 0.1}, "min_horizon must lie between dt, 0.5 s, and the plan's duration, 10 s, got 0.1 s"),
    ({"min_horizon": 10.1}, "min_horizon must lie between dt, 0.5 s, and the plan's duration, 10 s, got 10.1 s"),
    ({"min_horizon": -1.0}, "min_horizon must be finite and above 0, got -1.0"),
    (
        {"min_horizon": 1.0, "horizon": 2.0},
        'min_horizon must be given with horizon = "shrinking" only, got 1.0 with 2 s',
    ),
    ({"trigger": "always"}, "trigger must be one of period, deviation, goal, got 'always'"),
    ({"trigger": "goal"}, 'goal_derivatives must be given for trigger = "goal", got None'),
    ({"trigger": "deviation"}, 'measured must be given for trigger = "deviation", got None'),
    (
        {"trigger": "deviation", "measured": 0, "suffix": "_r"},
        'threshold must be given for trigger = "deviation", got None',
    ),
    (
        {"trigger": "deviation", "measured": 0, "suffix": "_r", "threshold": 0.0},
        "threshold must be finite and above 0, got 0.0",
    ),
    ({"threshold": 0.1}, "threshold must be given with trigger = \"deviation\" only, got 0.1 with 'period'"),
    ({"measured": 3, "suffix": "_r"}, "measured must be at most order, 2, got 3"),
    ({"measured": -1, "suffix": "_r"}, "measured must be an integer of at least 0, got -1"),
    ({"goal_derivatives": 3}, "goal_derivatives must be at most order, 2, got 3"),
    ({"goal_derivatives": 1.5}, "goal_derivatives must be an integer of at least 0, got 1.5"),
    ({"order": -1}, "order must be an integer of at least 0, got -1"),
    ({"derivatives": -1}, "derivatives must be an integer of at least 0, got -1"),
    ({"alpha": 6.5}, "alpha must lie in [0, 2 pi), got 6.5"),
    ({"alpha": -0.5}, "alpha must lie in [0, 2 pi), got -0.5"),
    ({"measured": 1}, "suffix must make outputs differ from inputs, got '' and x, x_d1 in both"),
    (
        {"goal_derivatives": 0, "suffix": "_goal"},
        "suffix must make outputs differ from inputs, got '_goal' and x_goal in both",
    ),
    ({"offset": -0.1}, "offset must be finite and at least 0, got -0.1"),
    ({"offset": math.inf}, "offset must be finite and at least 0, got inf"),
    ({"limits": {1: 0.0}}, "limits[1] must be above 0, one number or 1, got 0.0"),
    ({"limits": {1: math.nan}}, "limits[1] must be above 0, one number or 1, got nan"),
    ({"limits": {1: [1.0, 2.0]}}, "limits[1] must be above 0, one number or 1, got [1.0, 2.0]"),
    ({"limits": {-1: 1.0}}, "orders of limits must be an integer of at least 0, got -1"),
]


@pytest.mark.parametrize(("options", "message"), BAD, ids=lambda v: ", ".join(v) if isinstance(v, dict) else "")
def test_bad_values_get_one_line(options, message):
    with pytest.raises(ValueError) as raised:
        cp.create_replanner_iosystem(PLAN, **({"dt": 0.5} | options))
    assert str(raised.value) == message


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("x", 0.5), {}, "plan must be a Trajectory, got str"),
        ((None, 0.5), {}, "plan must be a Trajectory, got NoneType"),
        ((PLAN, "0.5s"), {}, "dt must be a number, got '0.5s'"),
        ((PLAN, 0.5), {"horizon": None}, "horizon must be a number, got None"),
        ((PLAN, 0.5), {"order": "2"}, "order must be an integer of at least 0, got '2'"),
        ((PLAN, 0.5), {"measured": True}, "measured must be an integer of at least 0, got True"),
        ((PLAN, 0.5), {"limits": [1.0]}, "limits must be a mapping of orders to magnitudes, got list"),
        ((PLAN, 0.5), {"limits": {1: "fast"}}, "limits[1] must be real numbers, got 'fast'"),
    ],
)
def test_wrong_kinds_get_one_line(arguments, options, message):
    with pytest.raises(TypeError) as raised:
        cp.create_replanner_iosystem(*arguments, **options)
    assert str(raised.value) == message


def test_a_plan_without_duration_cannot_shrink():
    with pytest.raises(ValueError, match="horizon must be a number of seconds for a plan without duration"):
        cp.create_replanner_iosystem(cp.Step(1.0), 0.1)
    cp.create_replanner_iosystem(cp.Step(1.0), 0.1, horizon=1.0)


# Times, names and loops


@pytest.mark.parametrize("moment", [1e6, -1e6, 123.456])
def test_absolute_times(moment):
    """The same run later, to the resolution of times of that size."""
    goal, t = steps((3.2, 1.5)), np.linspace(-1.0, 12.0, 131)
    here = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.4, goal_derivatives=0, offset=0.1), t, goal)
    plan = PLAN.shift(moment)
    there = cp.simulate(
        cp.create_replanner_iosystem(plan, 0.4, goal_derivatives=0, offset=0.1), moment + t, goal.shift(moment)
    )
    assert np.abs(here.outputs - there.outputs).max() <= 1e-9
    assert np.array_equal(state_of(here, "fits"), state_of(there, "fits"))
    assert np.abs(here.outputs[0, t > 10.0] - 1.5).max() <= 1e-9


@pytest.mark.parametrize("begin", [-3.0, 2.0, 8.6, 10.5])
def test_a_run_begins_before_or_within_or_after_the_plan(begin):
    """Samples count from the run's beginning; a goal given before the plan's start waits for it."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.4, goal_derivatives=0, offset=0.15)
    t = begin + np.linspace(0.0, 15.0, 301)
    found = cp.simulate(replanner, t, 1.5)
    fits = np.flatnonzero(np.diff(state_of(found, "fits"))) + 1
    instants = begin + 0.15 + 0.4 * np.arange(40)
    first = instants[(instants >= 0.0) & (instants <= 8.0)][:1]
    assert np.abs(t[fits] - first).max(initial=0.0) <= 1e-9
    assert fits.size == first.size
    if first.size:
        peer = BPoly.from_derivatives([first[0], 10.0], [PLAN.jet(first[0], 2)[:, 0], [1.5, 0, 0]])
        inside = (t >= first[0] - 1e-9) & (t <= 10.0)
        assert np.abs(found.outputs[0, inside] - peer(t[inside])).max() <= 1e-10
        assert np.abs(found.outputs[0, t < first[0] - 1e-9] - PLAN(t[t < first[0] - 1e-9])).max() <= 1e-12
        assert found.events == []
    else:  # too late for it
        assert np.abs(found.outputs[0] - PLAN(t)).max() <= 1e-12
        assert happened(found, UNREACHABLE) == [(round(begin + 0.15, 9), "above")]


def test_a_plant_is_not_brought_onto_a_plan_that_has_not_begun():
    """Shrinking waits for the start; a fixed horizon does not."""
    late = PLAN.shift(5.0)
    for horizon, count in (("shrinking", 0), (2.0, 4)):
        replanner = cp.create_replanner_iosystem(late, 0.5, horizon=horizon, measured=0, suffix="_r")
        core = replanner.syslist[1]
        x = np.zeros(core.nstates)
        for t in (0.0, 0.5, 1.0, 1.5):
            x = core.sample(t, x, signals(late, replanner, t, off=0.2), {})
        assert x[4] == count
    replanner = cp.create_replanner_iosystem(late, 0.5, measured=0, suffix="_r")
    core = replanner.syslist[1]
    assert core.sample(5.0, np.zeros(core.nstates), signals(late, replanner, 5.0, off=0.2), {})[4] == 1


def test_names_of_what_comes_in_and_goes_out():
    plan = cp.PolySpline([Waypoint(0, [0, 0, 0], 0, 0), Waypoint(10, [1, 2, 3], 0, 0)], labels=["x", "y", "z"])
    replanner = cp.create_replanner_iosystem(
        plan, 0.5, measured=1, goal_derivatives=1, derivatives=1, suffix="_ref", name="planner"
    )
    assert replanner.name == "planner"
    assert replanner.output_labels == ["x_ref", "x_ref_d1", "y_ref", "y_ref_d1", "z_ref", "z_ref_d1"]
    assert replanner.input_labels == [
        "x_goal", "x_goal_d1", "y_goal", "y_goal_d1", "z_goal", "z_goal_d1", "x", "x_d1", "y", "y_d1", "z", "z_d1"
    ]  # fmt: skip
    plain = cp.create_replanner_iosystem(plan, 0.5, order=1)
    assert (plain.ninputs, plain.output_labels) == (0, ["x", "x_d1", "y", "y_d1", "z", "z_d1"])
    assert cp.create_replanner_iosystem(cp.PolySpline(REST), 0.5).output_labels == ["y", "y_d1", "y_d2"]


def test_three_axes_each_to_its_goal():
    plan = cp.PolySpline([Waypoint(0, [0, 0, 0], 0, 0), Waypoint(10, [1, 2, 3], 0, 0)], labels=["x", "y", "z"])
    replanner = cp.create_replanner_iosystem(plan, 0.5, goal_derivatives=0)
    found = cp.simulate(
        replanner, np.linspace(0, 11, 23), {"x_goal": 1.0, "y_goal": -1.0, "z_goal": cp.Step(5.0, 3.0, 4.2)}
    )
    assert np.abs(found.outputs[:, -1] - [1, 0, 0, -1, 0, 0, 5, 0, 0]).max() <= 1e-9
    for row, begin, first, to in ((3, 0.0, np.zeros(3), -1.0), (6, 4.5, plan.jet(4.5, 2)[:, 2], 5.0)):
        peer = BPoly.from_derivatives([begin, 10.0], [first, [to, 0, 0]])
        later = (found.time >= begin) & (found.time <= 10.0)
        assert np.abs(found.outputs[row, later] - peer(found.time[later])).max() <= 1e-10
    assert np.abs(found.outputs[0] - plan(found.time)[0]).max() <= 1e-10


@pytest.mark.parametrize("suffix", ["_planned", "_planned_", "_goal_planned"])
def test_no_suffix_meets_a_name_inside(suffix):
    t = np.linspace(0, 10, 11)
    found = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5, suffix=suffix, goal_derivatives=0), t, 1.0)
    assert np.abs(found.outputs - PLAN.jet(t, 2)[:, 0]).max() <= 1e-10


def test_no_label_meets_a_name_inside():
    labels = ["x", "x_planned", "x_goal"]
    plan = cp.PolySpline([Waypoint(0, [0, 0, 0], 0, 0), Waypoint(10, [1, 2, 3], 0, 0)], labels=labels)
    t = np.linspace(0, 10, 11)
    found = cp.simulate(cp.create_replanner_iosystem(plan, 0.5, order=0), t)
    assert np.abs(found.outputs - plan(t)).max() <= 1e-10


@pytest.mark.slow
def test_joined_to_a_plant_by_names():
    """The reference goes to the plant, its position back, and nothing warns; the goal is met after a push."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.1, measured=0, goal_derivatives=0, derivatives=1, suffix="_r")
    plant = ct.ss(
        [[0, 1], [-25, -10]],
        [[0, 0, 0], [25, 10, 1]],
        [[1, 0]],
        0,
        inputs=["x_r", "x_r_d1", "push"],
        outputs="x",
        name="plant",
    )
    loop = ct.interconnect([replanner, plant], inputs=["x_goal", "push"], outputs=["x", "x_r", "x_r_d1"], name="loop")
    t = np.linspace(0.0, 15.0, 151)
    found = cp.simulate(loop, t, {"x_goal": cp.Step(1.4, 1.0, 5.0), "push": cp.Step(0, 2.0, 2.0)})
    assert found.method == "compiled"
    assert abs(found.outputs[0, -1] - 1.4) <= 2e-3
    nested = ct.interconnect([loop], inputs=["x_goal", "push"], outputs=["x", "x_r", "x_r_d1"], name="nested")
    again = cp.simulate(nested, t, {"x_goal": cp.Step(1.4, 1.0, 5.0), "push": cp.Step(0, 2.0, 2.0)})
    assert np.abs(again.outputs[0] - found.outputs[0]).max() <= 1e-7


def test_two_replanners_in_one_loop():
    """Each with its own period, axis and name."""
    blocks = [
        cp.create_replanner_iosystem(cp.PolySpline(REST, labels=["a"]), 0.5, order=1, goal_derivatives=0, name="first"),
        cp.create_replanner_iosystem(
            cp.TrigSpline(REST, alpha=2.0, labels=["b"]), 0.3, order=1, goal_derivatives=0, name="second"
        ),
    ]
    loop = ct.interconnect(blocks, inputs=["a_goal", "b_goal"], outputs=["a", "a_d1", "b", "b_d1"])
    t = np.linspace(0, 11, 111)
    found = cp.simulate(loop, t, {"a_goal": 2.0, "b_goal": cp.Step(0.0, 1.0, 3.1)})
    assert np.abs(found.outputs[:, -1] - [2, 0, 0, 0]).max() <= 1e-9
    alone = cp.simulate(blocks[1], t, cp.Step(0.0, 1.0, 3.1))
    assert np.abs(found.outputs[2:] - alone.outputs).max() <= 1e-10
    late = cp.simulate(loop, t, {"a_goal": cp.Step(2.0, 1.0, 9.8), "b_goal": 1.0})
    assert [e.name for e in late.events] == [UNREACHABLE.replace("replanner", "first")]


def test_python_controls_own_simulation_is_rejected():
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0)
    with pytest.raises(RuntimeError, match=r"is sampled, must be run by ctrlplan\.simulate"):
        ct.input_output_response(replanner, np.linspace(0, 10, 11), np.ones(11))


def test_a_run_can_be_made_again():
    """Nothing is kept from one run to the next."""
    replanner, t = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0), np.linspace(0, 11, 23)
    first = cp.simulate(replanner, t, cp.Step(2.0, 1.0, 3.0))
    cp.simulate(replanner, t, -5.0)
    assert np.array_equal(cp.simulate(replanner, t, cp.Step(2.0, 1.0, 3.0)).outputs, first.outputs)


def test_jets_above_the_order_are_output_too():
    """derivatives above and below `order`: the plan's own where nothing was fitted."""
    t = np.linspace(0.0, 9.99, 31)
    many = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5, order=1, derivatives=4), t)
    assert np.abs(many.outputs - PLAN.jet(t, 4)[:, 0]).max() <= 1e-12
    few = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5, order=3, derivatives=0, goal_derivatives=0), t, 1.5)
    peer = BPoly.from_derivatives([0.0, 10.0], [[0] * 4, [0.5, 0, 0, 0]])
    assert np.abs(np.ravel(few.outputs) - PLAN(t) - peer(t)).max() <= 1e-10


def test_a_fit_some_periods_after_the_last_one_begins_where_the_reference_is_by_then():
    """Fixed horizon, new goals only: three periods between two fits."""
    replanner = cp.create_replanner_iosystem(
        cp.Step(0.0, 0.0, labels=["x"]), 0.25, horizon=2.0, goal_derivatives=0, trigger="goal"
    )
    t = np.linspace(0.0, 6.0, 61)
    found = cp.simulate(replanner, t, steps((2.0, 1.0), (2.75, -1.0), initial=0.0))
    first = BPoly.from_derivatives([2.0, 4.0], [[0, 0, 0], [1, 0, 0]])
    jet = [first.derivative(k)(2.75) if k else first(2.75) for k in range(3)]
    second = BPoly.from_derivatives([2.75, 4.75], [jet, [-1, 0, 0]])
    early, late = (t >= 2.0) & (t < 2.75), (t >= 2.75) & (t <= 4.75)
    assert np.abs(found.outputs[0, early] - first(t[early])).max() <= 1e-12
    assert np.abs(found.outputs[0, late] - second(t[late])).max() <= 1e-12
    assert np.abs(found.outputs[0, t > 4.75] + 1.0).max() <= 1e-12


IN_MOTION = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(7.3, 5, 1.0, 0)], labels=["x"])


def random_times():
    """Of which t + (7.3 - t) is not always 7.3."""
    times = np.random.default_rng(0).uniform(0.0, 6.0, 200)
    assert (times + (7.3 - times) < 7.3).sum() > 5
    return times.tolist()


def test_a_plan_that_ends_in_motion_meets_its_goal_at_every_fit_time():
    """At the very end, where the correction's end and the plan's are one but for rounding."""
    replanner = cp.create_replanner_iosystem(IN_MOTION, 0.1, goal_derivatives=1)
    core = replanner.syslist[1]
    for t in random_times():
        aim = [[5.5 - 0.8 * (7.3 - t)], [0.8]]
        x = core.sample(t, np.zeros(core.nstates), signals(IN_MOTION, replanner, t, goal=aim), {})
        assert x[4] == 1
        assert np.abs(block_outputs(IN_MOTION, replanner, 7.3, x) - [5.5, 0.8, 0.0]).max() <= 1e-9


@pytest.mark.slow
def test_limits_do_not_count_the_arrival_twice():
    """A goal 1 cm off, with a fifth of the peak speed to spare, is taken at every time."""
    limit = 1.2 * float(IN_MOTION.peak(1)[0])
    replanner = cp.create_replanner_iosystem(IN_MOTION, 0.1, goal_derivatives=1, limits={1: limit})
    core = replanner.syslist[1]
    rejected = 0
    for t in random_times():
        aim = [[5.01 - (7.3 - t)], [1.0]]
        added = BPoly.from_derivatives([t, 7.3], [[0, 0, 0], [0.01, 0, 0]])
        s = np.linspace(t, 7.3, 99)
        assert np.abs(IN_MOTION(s, 1) + added.derivative()(s)).max() < limit
        rejected += core.sample(t, np.zeros(core.nstates), signals(IN_MOTION, replanner, t, goal=aim), {})[3]
    assert rejected == 0
