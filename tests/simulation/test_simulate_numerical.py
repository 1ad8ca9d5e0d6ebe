"""The numerical method: linear systems against closed forms, nonlinear ones against an accurate run by segments."""

from functools import cache
from itertools import pairwise

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from simulation_oracle import both, gap, lag_loop, response

import ctrlplan as cp

MOVE = ([0.4, 1.1, 2.7], [[[0.0, 0.0, 0.0], [1.0, -0.3], [0.5, 0.0, 0.0]]])
FULL = ([0.3, 1.0, 1.6, 2.9], [[[0.0, 1.0], [1.0, -1.0], [0.2, 0.5], [2.0, 1.0]]])
T = np.unique(np.concatenate([np.random.default_rng(0).uniform(0, 6, 60), [0.0, 1.1, 2.7, 6.0]]))


def tight(rate, plan, times, initial):
    """States of x' = rate(t, x, r): DOP853 near rounding in short steps, from breakpoint to breakpoint."""
    state, rows = np.asarray(initial, dtype=float), []
    edges = [times[0], *[b for b in plan.breakpoints if times[0] < b < times[-1]], times[-1]]
    for left, right in pairwise(edges):
        inside = times[(times >= left) & (times < right)]
        run = solve_ivp(
            lambda t, x, right=right: rate(t, x, plan.jet(t, 0, left=t == right)[0]),
            (left, right),
            state,
            "DOP853",
            t_eval=np.append(inside, right),
            rtol=1e-12,
            atol=1e-13,
            max_step=0.02,
        )
        rows.append(run.y[:, : inside.size])
        state = run.y[:, -1]
    return np.hstack([*rows, state[:, None]])


def pendulum_rate(t, x, r):
    return np.array([x[1], -9.81 * np.sin(x[0]) - 0.2 * x[1] + r[0]])


def pendulum():
    return ct.nlsys(
        lambda t, x, u, params: pendulum_rate(t, x, u),
        lambda t, x, u, params: np.array([np.sin(x[0]), -np.cos(x[0])]),
        states=["angle", "rate"],
        inputs=["torque"],
        outputs=["across", "up"],
        name="pendulum",
    )


def saturated_rate(t, x, r):
    return np.array([np.clip(8.0 * (r[0] - x[1]), -1.0, 1.0) - x[0], x[0]])


def saturated():
    """k/(s^2 + s) in unity feedback with |u| <= 1: states y' and y."""
    valve = ct.nlsys(None, lambda t, x, u, params: np.clip(u, -1.0, 1.0), inputs="e", outputs="u", name="valve", dt=0)
    gain = ct.ss([], [], [], [[8.0, -8.0]], inputs=["r", "y"], outputs="e", name="gain")
    plant = ct.ss([[-1, 0], [1, 0]], [[1], [0]], [[0, 1]], 0, inputs="u", outputs="y", name="plant")
    return ct.interconnect([gain, valve, plant], inputs="r", outputs=["y", "u"], name="saturated")


# Linear systems


@cache
def of_linear_loop(each_segment, alpha):
    _, signals = both(*(FULL if each_segment else MOVE), alpha, each_segment=each_segment)
    return response(*lag_loop(5.0), signals, T, [0.3, -0.2])


@pytest.mark.parametrize(("rtol", "allowed"), [(1e-8, 2e-7), (1e-11, 3e-10)])
@pytest.mark.parametrize("alpha", [0.0, 1e-9, 1.0, 5.0])
@pytest.mark.parametrize("each_segment", [False, True], ids=["one spline", "one a segment"])
def test_a_linear_loop(each_segment, alpha, rtol, allowed):
    plan, _ = both(*(FULL if each_segment else MOVE), alpha, each_segment=each_segment)
    loop = cp.plants.integrator_lag_loop(5.0, ["y", "u", "e"])
    found = cp.simulate(loop, T, plan, [0.3, -0.2], method="python", rtol=rtol, atol=1e-2 * rtol)
    outputs, states = of_linear_loop(each_segment, alpha)
    assert found.method == "python"
    assert gap(found.states, states) <= allowed
    assert gap(found.outputs, outputs) <= allowed


@pytest.mark.slow
def test_the_tolerance_is_obeyed():
    plan, signals = both(*MOVE, 1.0)
    states = response(*lag_loop(5.0), signals, T)[1]
    loop = cp.plants.integrator_lag_loop(5.0)
    errors = [
        gap(cp.simulate(loop, T, plan, method="python", rtol=rtol, atol=1e-2 * rtol).states, states)
        for rtol in (1e-4, 1e-6, 1e-8, 1e-10)
    ]
    assert all(e <= 30 * rtol for e, rtol in zip(errors, (1e-4, 1e-6, 1e-8, 1e-10), strict=True))
    assert errors[3] < 1e-2 * errors[1] < 1e-2 * errors[0]


@pytest.mark.parametrize("place", ["input", "block", "nested block"])
@pytest.mark.parametrize("start", [30.0, 1000.0])
def test_a_plan_that_starts_late_from_rest_is_not_skipped(start, place):
    """A solver whose steps have grown during a long dwell skips a plan of 0.2 s."""
    plan, signals = both([start, start + 0.1, start + 0.2], [[[0.0, 0.0], [1.0], [0.0, 0.0]]], 1.0)
    loop = cp.plants.integrator_lag_loop(5.0)
    t = np.append(0.0, start + np.linspace(0, 3, 31))
    if place == "input":
        found = cp.simulate(loop, t, plan, method="python")
    else:
        planned_loop = ct.interconnect(
            [cp.create_source_iosystem(cp.stack([plan], labels=["r"])), loop], inputs=0, outputs=["y"]
        )
        if place == "nested block":
            behind = ct.ss([], [], [], [[1.0]], inputs="y", outputs="z", name="wire")
            planned_loop = ct.interconnect([planned_loop, behind], inputs=0, outputs=["z"])
        found = cp.simulate(planned_loop, t, method="python")
    exact = response(*lag_loop(5.0), signals, t)[0][0]
    assert np.abs(exact).max() > 0.1
    assert np.abs(found.outputs - exact).max() <= 1e-7


@pytest.mark.parametrize("place", ["input", "block"])
def test_jumps_between_samples(place):
    plan = cp.Step(1.0, time=0.777) + cp.Step(-2.0, time=1.234) + cp.Step(1.5, time=3.0)
    loop = cp.plants.integrator_lag_loop(5.0)
    if place == "block":
        source = cp.create_source_iosystem(cp.stack([plan], labels=["r"]))
        planned_loop, inputs = ct.interconnect([source, loop], inputs=0, outputs=["y"]), None
    else:
        planned_loop, inputs = loop, plan
    found = cp.simulate(planned_loop, T, inputs, method="python", rtol=1e-10, atol=1e-12)
    w, exact = np.sqrt(4.75), 0.0
    for height, jump in ((1.0, 0.777), (-2.0, 1.234), (1.5, 3.0)):
        s = np.maximum(T - jump, 0.0)
        exact = exact + height * (1 - np.exp(-s / 2) * (np.cos(w * s) + np.sin(w * s) / (2 * w)))
    assert np.abs(found.outputs - exact).max() <= 1e-8


def test_breakpoints_a_rounding_apart():
    # 0.1 + 0.2 and 0.3 are two breakpoints of the sum, with one number between them at most.
    one, (a,) = both([0.0, 0.3], [[[0.0, 0.0], [1.0, 0.0]]])
    two, (b,) = both([0.0, 0.1 + 0.2], [[[0.0, 0.0], [1.0, 2.0]]])
    found = cp.simulate(cp.plants.integrator_lag_loop(5.0), T, one + two, method="python", rtol=1e-10, atol=1e-12)
    assert gap(found.states, response(*lag_loop(5.0), [a + b], T)[1]) <= 1e-8


# Nonlinear systems


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_a_pendulum(alpha):
    plan, _ = both([0.5, 1.5, 3.0], [[[0.0, 0.0], [6.0, 3.0], [0.0, 0.0]]], alpha)
    found = cp.simulate(pendulum(), T, plan, [2.5, -0.3], rtol=1e-11, atol=1e-13)
    states = tight(pendulum_rate, plan, T, [2.5, -0.3])
    assert found.method == "compiled"
    assert "pendulum" in found.reason
    assert gap(found.states, states) <= 1e-8
    assert gap(found.outputs, [np.sin(states[0]), -np.cos(states[0])]) <= 1e-8


def test_a_pendulum_pushed_late():
    plan, _ = both([500.0, 500.1, 500.2], [[[0.0, 0.0], [20.0], [0.0, 0.0]]], 1.0)
    t = np.concatenate([[0.0], np.linspace(500.0, 503.0, 31)])
    states = tight(pendulum_rate, plan, t[1:], [0.0, 0.0])
    assert np.abs(states[0]).max() > 0.2
    found = cp.simulate(pendulum(), t, plan)
    assert np.abs(found.states[:, 1:] - states).max() <= 1e-6


@pytest.mark.parametrize(
    "plan", [cp.Step(3.0, time=0.7), both(*MOVE, 1.0)[0], cp.Step(1.0, time=2.0) + both(*FULL, 0.0)[0]]
)
def test_a_saturated_loop(plan):
    found = cp.simulate(saturated(), T, plan)
    states = tight(saturated_rate, plan, T, [0.0, 0.0])
    assert np.abs(found.states - states).max() <= 1e-6
    control = np.clip(8.0 * (plan(T) - states[1]), -1.0, 1.0)
    assert np.abs(control).max() == 1.0
    assert np.abs(found.outputs - [states[1], control]).max() <= 1e-5


@pytest.mark.slow
def test_a_plan_inside_a_nonlinear_loop():
    plan = cp.stack([both(*MOVE, 1.0)[0].shift(2.0)], labels=["r"])
    planned_loop = ct.interconnect([cp.create_source_iosystem(plan), saturated()], inputs=0, outputs=["y", "u"])
    found, given = cp.simulate(planned_loop, T), cp.simulate(saturated(), T, plan)
    states = tight(saturated_rate, plan, T, [0.0, 0.0])
    assert found.method == given.method == "compiled"
    assert np.abs(found.states - states).max() <= 1e-6
    assert np.abs(given.states - states).max() <= 1e-6


def test_an_equation_that_depends_on_time():
    # x' = -t x + u: x = exp(-t^2/2) x0 where u = 0.
    fading = ct.nlsys(lambda t, x, u, params: -t * x + u, None, inputs=1, outputs=1, states=1, name="fading")
    t = np.linspace(0.5, 4.0, 50)
    found = cp.simulate(fading, t, 0.0, [2.0], rtol=1e-10, atol=1e-12)
    assert np.abs(found.states[0] - 2 * np.exp((0.25 - t**2) / 2)).max() <= 1e-9


def test_params_reach_the_blocks():
    decay = ct.nlsys(
        lambda t, x, u, params: -params["rate"] * x,
        None,
        inputs=0,
        outputs=1,
        states=1,
        params={"rate": 1.0},
        name="decay",
    )
    for params, rate in ((None, 1.0), ({"rate": 3.0}, 3.0)):
        found = cp.simulate(decay, T, None, 1.0, params=params, rtol=1e-10, atol=1e-12)
        assert np.abs(found.states[0] - np.exp(-rate * T)).max() <= 1e-9


def test_params_reach_outputs_and_inner_blocks():
    scale = ct.nlsys(
        None, lambda t, x, u, p: p["k"] * u, inputs="y", outputs="z", params={"k": 1.0}, name="scale", dt=0
    )
    loop = ct.interconnect([cp.plants.integrator_lag_loop(5.0), scale], inputs="r", outputs=["z"])
    plan, signals = both(*MOVE, 1.0)
    y = response(*lag_loop(5.0), signals, T)[0][0]
    found = cp.simulate(loop, T, plan, params={"k": -2.5}, rtol=1e-10, atol=1e-12)
    assert np.abs(found.outputs + 2.5 * y).max() <= 1e-8


def test_params_that_a_linear_loop_has_no_use_for():
    # python-control accepts them silently; a misspelt one would not be noticed.
    plan, signals = both(*MOVE, 1.0)
    with pytest.warns(UserWarning, match="params 'k' is read by no block of loop"):
        found = cp.simulate(cp.plants.integrator_lag_loop(5.0), T, plan, params={"k": 1.0})
    assert found.method == "exact"
    assert gap(found.states, response(*lag_loop(5.0), signals, T)[1]) <= 1e-12


def test_a_solution_that_ends_is_said_with_its_time():
    """x' = x^2 from 1 is 1/(1 - t): there is nothing at 2 s, and every solver must terminate."""
    calls = 0

    def rate(t, x, u, params):
        nonlocal calls
        calls += 1
        if calls > 20_000:
            pytest.fail("the solver does not give up")
        return x**2

    escaping = ct.nlsys(rate, None, inputs=0, outputs=1, states=1, name="escaping")
    with np.errstate(all="ignore"), pytest.raises(RuntimeError, match=r"must reach 2 s, got to (0\.9\d*|1) s"):
        cp.simulate(escaping, [0.0, 0.5, 2.0], None, 1.0)


# Reason of the choice


def test_the_reason_names_what_ran_and_why():
    loop = cp.plants.integrator_lag_loop(5.0)
    plan = both(*MOVE, 1.0)[0]
    assert cp.simulate(loop, T, plan).method == "exact"
    requested = cp.simulate(loop, T, plan, method="python")
    assert (requested.method, requested.reason) == ("python", 'method "python" was requested')
    assert cp.simulate(loop, T, np.sin(T)).method == "exact"
    bent = cp.simulate(saturated(), T, plan)
    assert bent.method == "compiled"
    assert "valve" in bent.reason
    assert requested.events == []
