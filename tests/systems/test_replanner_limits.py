"""Replanners: limits on the refitted plan, and missing measurements and goals."""

import math

import control as ct
import numpy as np
import pytest
from replanner_oracle import (
    METHODS,
    NAN_INPUT,
    PLAN,
    PLANS,
    UNREACHABLE,
    Peer,
    conveyor,
    happened,
    signals,
    state_of,
    steps,
)
from scipy.interpolate import BPoly

import ctrlplan as cp
from ctrlplan import Waypoint
from ctrlplan.systems import replanner

# Limits


def grid_peaks(found, order):
    """Largest magnitudes of the derivatives 0 to `order` in a record of one axis."""
    return np.abs(found.outputs[: order + 1]).max(axis=1)


FINE = np.linspace(0.0, 13.0, 2601)


@pytest.mark.parametrize("method", METHODS)
def test_a_goal_out_of_reach_is_not_taken_and_one_within_is_taken_up_again(method):
    """Speed up to 0.6: at 4 s the goal goes to where it would take more, at 6 s back to where it takes less."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, limits={1: 0.6})
    found = cp.simulate(replanner, FINE, steps((2.2, 1.3), (4.2, 4.0), (6.1, 1.5)), method=method)
    fits = np.flatnonzero(np.diff(state_of(found, "fits"))) + 1
    assert FINE[fits].tolist() == pytest.approx([2.5, 6.5])
    assert happened(found, UNREACHABLE) == [(4.5, "above"), (6.5, "inside")]
    assert len(found.events) == 2
    peer = BPoly.from_derivatives([2.5, 10.0], [PLAN.jet(2.5, 2)[:, 0], [1.3, 0, 0]])
    beyond = BPoly.from_derivatives(
        [4.5, 10.0], [[peer.derivative(k)(4.5) if k else peer(4.5) for k in range(3)], [4.0, 0, 0]]
    )
    assert beyond.derivative()(np.linspace(4.5, 10.0, 99)).max() > 0.6
    held = (FINE >= 2.5) & (FINE < 6.5)
    assert np.abs(found.outputs[0, held] - peer(FINE[held])).max() <= 1e-10
    assert np.abs(found.outputs[:, -1] - [1.5, 0, 0]).max() <= 1e-9
    assert 0.25 < grid_peaks(found, 1)[1] <= 0.6


@pytest.mark.parametrize("horizon", ["shrinking", 3.0])
@pytest.mark.parametrize("seed", range(2))
def test_limits_hold_and_the_same_goals_are_taken_as_by_the_peer(seed, horizon):
    """Random goals, limits on position, speed and acceleration; BPoly on a grid says which fits keep them."""
    rng = np.random.default_rng(100 + seed)
    times, targets = np.sort(rng.uniform(0.5, 11.0, 8)), np.append(1.0, 1.0 + rng.normal(size=8))
    limits = {0: 1.8, 1: 0.65, 2: 0.55}
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, limits=limits, horizon=horizon)
    found = cp.simulate(replanner, FINE, steps(*zip(times.tolist(), targets[1:].tolist(), strict=True)))
    for nu, limit in limits.items():
        assert np.abs(found.outputs[nu]).max() <= limit * (1 + 1e-9)

    def goal(t):
        return np.array([[targets[np.searchsorted(times, t, side="right")]]])

    peer = Peer(PLAN, goal, 0.5, horizon=None if horizon == "shrinking" else horizon, limits=limits)
    assert any(unreachable for _, unreachable in peer.unreachable)
    coarse = np.linspace(0, 13, 131)
    wanted = peer(coarse)
    assert np.abs(found.outputs[:, ::20] - wanted).max() <= 1e-9
    changes = [
        (t, m)
        for (t, m), (_, before) in zip(peer.unreachable[1:], peer.unreachable, strict=False)
        if m != before and t <= 13
    ]
    assert happened(found, UNREACHABLE) == [(round(t, 9), "above" if m else "inside") for t, m in changes]


@pytest.mark.parametrize("name", ["trigonometric, inner waypoints, alpha 4", "piecewise", "joined"])
def test_limits_hold_on_plans_with_joins_and_for_each_axis_its_own(name):
    """Every fit that is taken keeps them to the end of the run, on a grid; and some are, and some are not."""
    plan = PLANS[name]
    rng = np.random.default_rng(5)
    limit = 1.1 * float(plan.peak(1)[0])
    replanner = cp.create_replanner_iosystem(plan, 0.5, goal_derivatives=0, limits={1: [limit]}, order=2)
    moves = [(0.2 + k, float(1.0 + 4.0 * limit * rng.normal())) for k in range(8)]
    found = cp.simulate(replanner, FINE, steps(*moves))
    assert np.abs(found.outputs[1]).max() <= limit * (1 + 1e-9)
    assert 0 < state_of(found, "fits")[-1] < 9
    assert happened(found, UNREACHABLE)


@pytest.mark.slow
def test_each_axis_has_its_limit():
    plan = cp.PolySpline([Waypoint(0, [0, 0], 0, 0), Waypoint(10, [1, 1], 0, 0)], labels=["x", "z"])
    replanner = cp.create_replanner_iosystem(plan, 0.5, goal_derivatives=0, limits={1: [0.2, 0.6]}, trigger="goal")
    core = replanner.syslist[1]
    for goal, taken in (([1.0, 2.5], 1), ([1.2, 1.0], 0), ([1.0, 3.5], 0), ([0.9, 0.0], 1)):
        x = core.sample(0.0, np.zeros(core.nstates), signals(plan, replanner, 0.0, goal=[goal]), {})
        assert (x[4], x[3]) == (taken, 1 - taken)
        speed = 15 / 8 * np.abs(goal) / 10.0  # minimum jerk
        assert bool((speed <= [0.2, 0.6]).all()) == bool(taken)


@pytest.mark.parametrize("trigger", ["period", "goal"])
def test_limits_hold_where_the_correction_ends_before_the_plan(trigger):
    """Fixed horizon: at its end the change of the goal is added to a plan that continues."""
    replanner = cp.create_replanner_iosystem(
        PLAN, 0.5, horizon=1.0, goal_derivatives=0, trigger=trigger, limits={0: 1.2}
    )
    found = cp.simulate(replanner, FINE, steps((1.1, 1.5)))
    assert np.abs(found.outputs[0]).max() <= 1.2
    assert happened(found, UNREACHABLE)[0] == (1.5, "above")
    found = cp.simulate(replanner, FINE, steps((1.1, 1.15)))
    assert np.abs(found.outputs[0]).max() == pytest.approx(1.15, abs=1e-3)
    assert found.events == []


def test_limits_on_the_speed_of_a_plan_and_a_conveyor_together():
    """Peak of the plan 0.1875; 0.15 more on top of it is beyond 0.3 though either alone is not."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, horizon=1.0, goal_derivatives=1, limits={1: 0.3})
    found = cp.simulate(replanner, FINE, conveyor(1.0, 0.15, at=0.0))
    assert np.abs(found.outputs[1]).max() <= 0.3 * (1 + 1e-9)
    assert happened(found, UNREACHABLE)[0] == (0.0, "above")


def test_what_is_measured_beyond_the_limits_is_not_begun_from():
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, measured=1, suffix="_r", limits={1: 0.5})
    core = replanner.syslist[1]
    off = np.zeros((9, 1))
    for speed, taken in ((0.2, 1), (0.4, 0), (-0.6, 1), (-0.8, 0)):
        off[1] = speed  # the plan's own is 0.12 to 0.19 here
        x = core.sample(4.0, np.zeros(core.nstates), signals(PLAN, replanner, 4.0, off=off), {})
        assert (x[4], x[3]) == (taken, 1 - taken)


def test_a_plan_that_breaks_its_limits_says_which_by_how_much_and_when():
    peak, time = 15 / 8 / 10, 5.0
    message = f"plan must satisfy limits\\[1\\] = 0.18, got {peak:.6g} of x at {time:g} s"
    with pytest.raises(ValueError, match=message):
        cp.create_replanner_iosystem(PLAN, 0.5, limits={1: 0.18})
    cp.create_replanner_iosystem(PLAN, 0.5, limits={1: peak})
    two = cp.PolySpline([Waypoint(2, [0, 0], 0, 0), Waypoint(12, [1, -2], 0, 0)], labels=["x", "z"])
    with pytest.raises(ValueError, match=r"limits\[1\] = 0.3, got -0.375 of z at 7 s"):
        cp.create_replanner_iosystem(two, 0.5, limits={1: [0.2, 0.3]})


# nan in the inputs


def gap(source, sink, name, begin, end):
    """Sensor that outputs nan for a while."""

    def seen(t, x, u, params):
        missing = (t > begin) * (t < end)
        return np.array([np.where(missing, np.nan, value) for value in u])

    return ct.nlsys(None, seen, inputs=source, outputs=sink, name=name, dt=0)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_sensor_that_fails_for_a_while(method):
    """Fits at 0 to 3 s; none at 3.5 to 5 s, while the last good plan is held; again from 5.5 s on."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, measured=1, derivatives=1, suffix="_r", min_horizon=1.0)
    plant = ct.ss(
        [[0, 1], [-9, -6]], [[0, 0], [9, 6]], np.eye(2), 0, inputs=["x_r", "x_r_d1"], outputs=["p", "v"], name="plant"
    )
    sensor = gap(["p", "v"], ["x", "x_d1"], "sensor", 3.3, 5.2)
    loop = ct.interconnect([replanner, plant, sensor], inputs=0, outputs=["p", "x_r", "x_r_d1", "x", "v", "x_d1"])
    t = np.linspace(0.0, 14.0, 281)
    state = np.zeros(loop.nstates)
    state[-2] = 0.1
    found = cp.simulate(loop, t, None, state, method=method)
    assert found.method == method
    assert np.isfinite(found.outputs[[0, 1, 2, 4]]).all()
    assert np.isfinite(found.states).all()
    assert np.isnan(found.outputs[3, (t > 3.31) & (t < 5.19)]).all()
    assert happened(found, NAN_INPUT) == [(3.5, "above"), (5.5, "inside")]
    assert len(found.events) == 2
    fits = np.flatnonzero(np.diff(state_of(found, "fits"), prepend=0.0))
    assert np.allclose(t[fits], [0, 0.5, 1, 1.5, 2, 2.5, 3, 5.5, 6, 6.5, 7, 7.5, 8, 8.5, 9])
    # Held: one polynomial from 3 s to the goal, found from the outputs before the first nan.
    x0, v0 = (float(found.outputs[k, t.searchsorted(3.0 - 1e-9)]) for k in (1, 2))
    held = (t >= 3.0 - 1e-9) & (t < 5.45)
    coefficients = np.polynomial.Polynomial.fit(t[held], found.outputs[1, held], 5)
    assert np.abs(coefficients(t[held]) - found.outputs[1, held]).max() <= 1e-10
    assert np.abs([coefficients(3.0) - x0, coefficients.deriv()(3.0) - v0]).max() <= 1e-8
    assert np.abs([coefficients(10.0) - 1.0, coefficients.deriv()(10.0), coefficients.deriv(2)(10.0)]).max() <= 1e-6
    assert abs(found.outputs[0, -1] - 1.0) <= 1e-3


@pytest.mark.parametrize("method", METHODS)
def test_a_goal_that_is_nan_for_a_while(method):
    """Between 3.3 and 5.2 s: the goal of before is kept, the one of afterwards taken up."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0)
    loop = ct.interconnect(
        [replanner, gap("wish", "x_goal", "radio", 3.3, 5.2)], inputs="wish", outputs=replanner.output_labels
    )
    t = np.linspace(0.0, 12.0, 121)
    found = cp.simulate(loop, t, steps((2.2, 1.2), (4.0, 0.5)), method=method)
    assert np.isfinite(found.outputs).all()
    assert happened(found, NAN_INPUT) == [(3.5, "above"), (5.5, "inside")]
    first = BPoly.from_derivatives([2.5, 10.0], [PLAN.jet(2.5, 2)[:, 0], [1.2, 0, 0]])
    jet = [first.derivative(k)(5.5) if k else first(5.5) for k in range(3)]
    second = BPoly.from_derivatives([5.5, 10.0], [jet, [0.5, 0, 0]])
    before, after = (t >= 2.5) & (t < 5.45), (t >= 5.5) & (t <= 10.0)
    assert np.abs(found.outputs[0, before] - first(t[before])).max() <= 1e-10
    assert np.abs(found.outputs[0, after] - second(t[after])).max() <= 1e-10


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite_leave_the_plan_unchanged(value):
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, measured=0, goal_derivatives=0, suffix="_r")
    core = replanner.syslist[1]
    before = core.sample(1.0, np.zeros(core.nstates), signals(PLAN, replanner, 1.0, goal=[[1.3]]), {})
    for label in ("x", "x_goal"):
        u = signals(PLAN, replanner, 1.5, goal=[[1.7]])
        u[core.input_labels.index(label)] = value
        after = core.sample(1.5, before, u, {})
        assert after[2] == 1.0
        assert np.array_equal(np.delete(after, 2), np.delete(before, 2))


def test_limits_that_bounds_of_the_coefficients_satisfy_are_not_searched(monkeypatch):
    """The same fit with and without far limits; near ones are searched."""
    plan = cp.PolySpline([cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(10, [1, -2], 0, 0)], labels=["x", "z"])
    searched = []
    before = replanner.stationary_times
    monkeypatch.setattr(replanner, "stationary_times", lambda *given: searched.append(given) or before(*given))
    found = []
    for limits in (None, {0: 1e3, 1: 1e3, 2: 1e4}, {1: 3.9}):
        options = {"horizon": 1.0, "goal_derivatives": 0, "limits": limits}
        core = cp.create_replanner_iosystem(plan, 0.01, **options).syslist[1]
        state = np.zeros(core.nstates)
        inputs = np.concatenate([plan.jet(2.0, 2).T.ravel(), [3.0, -1.0]])
        found.append((core.sample(2.0, state, inputs, {}), len(searched)))
    np.testing.assert_array_equal(found[1][0], found[0][0])
    assert (found[0][1], found[1][1]) == (0, 0)
    assert found[2][1] > 0  # peaks of 3.75 of the correction and of 0.375 of the plan, at different times
