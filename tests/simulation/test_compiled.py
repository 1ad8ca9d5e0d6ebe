"""Compiled and interpreted runs against right-hand sides written by hand, and what cannot be traced."""

import math
import warnings
from functools import cache
from itertools import pairwise

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import expit

import ctrlplan as cp
from ctrlplan.symbolic import extra
from ctrlplan.symbolic import tracing as traced_module

METHODS = ("compiled", "python")
RISE = np.polynomial.Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
"""From 0 to 1 on [0, 1], at rest at both ends up to the fourth derivative."""


def tight(rate, times, initial, breaks=(), solver="DOP853"):
    """States of x' = rate(t, x) near rounding, from break to break; a time at a break belongs to the leg before it."""
    state, rows = np.asarray(initial, dtype=float), []
    edges = [times[0], *sorted(b for b in breaks if times[0] < b < times[-1]), times[-1]]
    for left, right in pairwise(edges):
        inside = times[(times >= left) & (times < right)]
        # Never at the break itself, where the next leg's function holds.
        below = right - 1e-13 * max(1.0, abs(right))
        run = solve_ivp(
            lambda t, x, below=below: rate(min(t, below), x),
            (left, right),
            state,
            method=solver,
            rtol=1e-12,
            atol=1e-12,
            t_eval=np.append(inside, right),
        )
        assert run.success
        rows.append(run.y[:, : inside.size])
        state = run.y[:, -1]
    return np.column_stack([*rows, state])


def gap(found, exact):
    """Greatest difference, each row relative to its own greatest value."""
    found, exact = np.atleast_2d(np.asarray(found)), np.atleast_2d(exact)
    assert found.shape == exact.shape
    return float((np.abs(found - exact).max(axis=1) / np.abs(exact).max(axis=1)).max())


def rows_of(response, *labels):
    outputs = np.atleast_2d(response.outputs)
    return np.array([outputs[list(response.output_labels).index(label)] for label in labels])


# The crane by hand

M, TROLLEY, DRUM, B, F1, F2, G = 500.0, 5000.0, 50.0, 0.25, 20.0, 20.0, 9.81
CRANE = cp.plants.Crane()
START, DURATION = 0.5, 6.0
FROM, TO = np.array([1.0, 10.0]), np.array([7.0, 11.5])
CRANE_TIMES = np.unique(np.concatenate([np.linspace(0.0, 8.0, 33), [START, START + DURATION]]))
BREAKS = (START, START + DURATION)


@cache
def crane_plan(late=START):
    jets = [{"x": [p[0], 0, 0, 0, 0], "z": [p[1], 0, 0, 0, 0]} for p in (FROM, TO)]
    ends = zip((late, late + DURATION), jets, strict=True)
    return cp.PolySpline([cp.Waypoint.from_jets(t, **jet) for t, jet in ends])


def planned(t, order):
    """Jet (order + 1, 2) of the plan of the load."""
    s = (t - START) / DURATION
    if not 0.0 < s < 1.0:
        jet = np.zeros((order + 1, 2))
        jet[0] = FROM if s <= 0.0 else TO
        return jet
    rise = np.array([RISE.deriv(k)(s) / DURATION**k for k in range(order + 1)])
    jet = rise[:, None] * (TO - FROM)
    jet[0] += FROM
    return jet


def crane_motion(state, force, torque, mass=M):
    """D'', R'', theta'', T from the four equations of motion, by a solver of linear systems."""
    _, r, th, d1, r1, th1 = state
    s, c = math.sin(th), math.cos(th)
    matrix = [
        [s, 1.0, -B, 1.0 / mass],
        [c, 0.0, r, 0.0],
        [TROLLEY, 0.0, 0.0, -s],
        [0.0, DRUM / B, 0.0, -B],
    ]
    right = [G * c + r * th1**2, -G * s - 2 * r1 * th1 + B * th1**2, force - F1 * d1, torque - F2 * r1 / B]
    return np.linalg.solve(matrix, right)


def load_of(state):
    d, r, th, d1, r1, th1 = state
    s, c = np.sin(th), np.cos(th)
    return (
        r * s + d + B * c,
        r * c - B * s,
        r1 * s + r * th1 * c + d1 - B * th1 * s,
        r1 * c - r * th1 * s - B * th1 * c,
    )


def generated(x, x2, z, z2):
    """(15a,b)."""
    pull = math.hypot(x2, G - z2)
    return x - (B * pull - z * x2) / (G - z2), (z * pull - B * x2) / (G - z2)


def gains(mass, friction, w=5.0):
    return 3 * mass * w**2, mass * w**3, 3 * mass * w - friction


def pid_by_hand(error, state, given, bias=0.0, limits=(-math.inf, math.inf), tf=0.02):
    """Output and rates of (integral, filter)."""
    kp, ki, kd = given
    asked = bias + kp * error + state[0] + kd / tf * (error - state[1])
    out = min(max(asked, limits[0]), limits[1])
    back = math.sqrt(ki / kd) if math.isfinite(limits[0]) else 0.0
    return out, [ki * error + back * (out - asked), (error - state[1]) / tf]


def driven_crane(law, force_limits=(-math.inf, math.inf), mass=M):
    """Rates of [integral, filter, integral, filter, D, R, theta, rates], and (F, C, T)."""
    trolley, hoist = gains(TROLLEY, F1), gains(DRUM / B + M * B, F2 / B)

    def both(t, x):
        plant = x[4:]
        jet = planned(t, 2)
        if law == "load_feedback":
            px, _, px1, _ = load_of(plant)
            asked = jet[2, 0] - 2.0 * (px1 - jet[1, 0]) - (px - jet[0, 0])
            d_ref, r_ref = generated(px, asked, jet[0, 1], jet[2, 1])
        else:
            d_ref, r_ref = generated(jet[0, 0], jet[2, 0], jet[0, 1], jet[2, 1])
        force, rates = pid_by_hand(d_ref - plant[0], x[:2], trolley, limits=force_limits)
        torque, more = pid_by_hand(r_ref - plant[1], x[2:4], hoist, bias=-B * M * G)
        *second, tension = crane_motion(plant, force, torque, mass)
        return np.array([*rates, *more, *plant[3:], *second]), (force, torque, tension)

    return both


def dynamic_crane(poles):
    """Rates of [T - m g, T', D, R, theta, rates] under the law (9)-(11), and (F, C, T)."""
    sigma = np.poly(poles)[:0:-1]

    def both(t, x):
        tension, rate, (_, r, th, d1, r1, th1) = M * G + x[0], x[1], x[2:]
        px, pz, px1, pz1 = load_of(x[2:])
        s, c = math.sin(th), math.cos(th)
        jets = np.array(
            [
                [px, pz],
                [px1, pz1],
                [-tension * s / M, G - tension * c / M],
                [-(rate * s + tension * th1 * c) / M, -(rate * c - tension * th1 * s) / M],
            ]
        )
        plan = planned(t, 4)
        v = plan[4] - sigma @ (jets - plan[:4])
        mixed = [2 * rate * th1 * c - tension * th1**2 * s, -2 * rate * th1 * s - tension * th1**2 * c]
        tension2, th2 = np.linalg.solve([[s, tension * c], [c, -tension * s]], -M * v - mixed)
        d2 = -(r * th2 + G * s + 2 * r1 * th1 - B * th1**2) / c
        r2 = G * c + r * th1**2 + B * th2 - d2 * s - tension / M
        force = TROLLEY * d2 + F1 * d1 - tension * s
        torque = DRUM * r2 / B + F2 * r1 / B - B * tension
        *second, pulled = crane_motion(x[2:], force, torque)
        return np.array([rate, tension2, d1, r1, th1, *second]), (force, torque, pulled)

    return both


def crane_oracle(both, initial):
    states = tight(lambda t, x: both(t, x)[0], CRANE_TIMES, initial, BREAKS)
    seen = np.array([both(t, x)[1] for t, x in zip(CRANE_TIMES, states.T, strict=True)]).T
    x, z, _, _ = load_of(states[-6:])
    return {"x": x, "z": z, "D": states[-6], "R": states[-5], "theta": states[-4]} | dict(
        zip(("F", "C", "T"), seen, strict=True)
    )


REST = np.array([FROM[0] - B, FROM[1], 0.0, 0.0, 0.0, 0.0])
CASES = {
    "generator": ({}, driven_crane("generator")),
    "load_feedback": ({}, driven_crane("load_feedback")),
    "limited": ({"force_limits": (-3000.0, 2500.0)}, driven_crane("generator", (-3000.0, 2500.0))),
}


@cache
def crane_reference(case):
    if case == "dynamic":
        return crane_oracle(dynamic_crane([-1.0, -1.2, -1.4, -1.6]), [0, 0, *(REST + OFFSET)])
    return crane_oracle(CASES[case][1], [0, 0, 0, 0, *REST])


OFFSET = np.array([0.3, -0.2, 0.02, 0.0, 0.05, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", CASES)
def test_a_crane_behind_its_drives(case, method):
    options, _ = CASES[case]
    law = "load_feedback" if "load" in case else "generator"
    loop = cp.plants.crane_loop(CRANE, crane_plan(), law, **options)
    found = cp.simulate(loop, CRANE_TIMES, method=method, rtol=1e-9, atol=1e-11)
    expected = crane_reference(case)
    assert found.method == method
    for label, allowed in (("x", 1e-8), ("z", 1e-8), ("D", 1e-8), ("R", 1e-8), ("theta", 1e-6), ("T", 1e-6)):
        assert gap(rows_of(found, label), expected[label]) <= allowed, label
    assert np.abs(rows_of(found, "F") - expected["F"]).max() <= 1e-6 * np.abs(expected["F"]).max()
    if "limited" in case:
        low, high = options["force_limits"]
        assert (expected["F"].min(), expected["F"].max()) == (low, high)
        assert {o.kind for o in found.events if o.name == "F"} == {"below", "above", "inside"}


@pytest.mark.parametrize("method", METHODS)
def test_a_crane_under_the_whole_law(method):
    loop = cp.plants.crane_loop(CRANE, crane_plan(), "dynamic")
    found = cp.simulate(loop, CRANE_TIMES, None, [0, 0, *(REST + OFFSET)], method=method, rtol=1e-10, atol=1e-12)
    expected = crane_reference("dynamic")
    for label in expected:
        assert gap(rows_of(found, label), expected[label]) <= 1e-6, label


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("law", ["dynamic", "feedforward"])
def test_a_crane_on_its_plan_stays_there(law, method):
    """The exact laws from rest at the beginning: the load is where it is planned, T = m hypot(x'', g - z'')."""
    loop = cp.plants.crane_loop(CRANE, crane_plan(), law)
    found = cp.simulate(loop, CRANE_TIMES, method=method)
    jets = np.array([planned(t, 2) for t in CRANE_TIMES])
    across, hanging = jets[:, 2, 0], G - jets[:, 2, 1]
    assert np.abs(rows_of(found, "x", "z") - jets[:, 0].T).max() <= 1e-6
    assert np.abs(rows_of(found, "theta")[0] - np.arctan2(-across, hanging)).max() <= 1e-6
    assert gap(rows_of(found, "T"), M * np.hypot(across, hanging)) <= 1e-6


@cache
def heavy_states(law, end):
    both = driven_crane(law, mass=800.0)
    return tight(lambda t, x: both(t, x)[0], np.linspace(0.0, end, 7), [0, 0, 0, 0, *REST], BREAKS)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("law", ["generator", "load_feedback"])
def test_a_heavier_load_than_the_controller_knows(law, method):
    loop = cp.plants.crane_loop(CRANE, crane_plan(), law)
    times = np.linspace(0.0, 2.0, 7)
    states = heavy_states(law, 2.0)
    found = cp.simulate(loop, times, method=method, params={"load_mass": 800.0}, rtol=1e-9, atol=1e-11)
    assert np.abs(rows_of(found, "x", "z") - load_of(states[4:])[:2]).max() <= 1e-6
    assert np.abs(states[5] - FROM[1]).max() > 1e-3  # it sinks first


# Other plants


def car(t, x, u, params):
    return np.array([u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[0] * np.tan(u[1]) / params["wheelbase"]])


def steering(t, x, u, params):
    y_ref, y, theta = u
    return np.array([2.0, np.arctan(0.4 * (y_ref - y) - 1.2 * np.sin(theta))])


LANE = cp.PolySpline([cp.Waypoint(1, 0, 0, 0), cp.Waypoint(3, 2, 0, 0)], labels=["y_ref"])
T = np.unique(np.concatenate([np.linspace(0.0, 8.0, 33), [1.0, 3.0]]))


def quintic(t, start, stop, height):
    s = min(max((t - start) / (stop - start), 0.0), 1.0)
    return height * s**3 * (10 - 15 * s + 6 * s * s)


@pytest.mark.parametrize("method", METHODS)
def test_a_car_changes_lanes(method):
    plant = ct.nlsys(
        car,
        None,
        inputs=["v", "delta"],
        outputs=["x", "y", "theta"],
        states=3,
        params={"wheelbase": 2.5},
        name="car",
    )
    law = ct.nlsys(None, steering, inputs=["y_ref", "y", "theta"], outputs=["v", "delta"], name="steering", dt=None)
    loop = ct.interconnect(
        [cp.create_source_iosystem(LANE), law, plant], inputs=0, outputs=["x", "y", "theta", "delta"]
    )
    found = cp.simulate(loop, T, None, [0.0, 0.5, 0.3], method=method, rtol=1e-10, atol=1e-12)

    def turn(t, x):
        return math.atan(0.4 * (quintic(t, 1, 3, 2.0) - x[1]) - 1.2 * math.sin(x[2]))

    states = tight(
        lambda t, x: [2 * math.cos(x[2]), 2 * math.sin(x[2]), 2 * math.tan(turn(t, x)) / 2.5],
        T,
        [0.0, 0.5, 0.3],
        (1.0, 3.0),
    )
    assert found.method == method
    assert gap(found.outputs[:3], states) <= 1e-8
    assert gap(found.outputs[3], [turn(t, x) for t, x in zip(T, states.T, strict=True)]) <= 1e-8


EPS = 0.3


def pvtol(t, x, u, params):
    s, c = np.sin(x[2]), np.cos(x[2])
    return np.array([x[3], x[4], x[5], -u[0] * s + EPS * u[1] * c, u[0] * c + EPS * u[1] * s - 1.0, u[1]])


def hover(t, x, u, params):
    """Height by thrust, position by tilt."""
    z_ref, px, pz, th, vx, vz, w = (u[k] for k in range(7))
    thrust = (1.0 + 2.0 * (z_ref - pz) - 2.0 * vz) / np.cos(th)
    tilt = 0.3 * np.tanh(px + 1.5 * vx)
    return np.array([thrust, 9.0 * (tilt - th) - 5.0 * w])


@pytest.mark.parametrize("method", METHODS)
def test_a_pvtol_that_hovers(method):
    names = ["px", "pz", "th", "vx", "vz", "w"]
    plan = cp.PolySpline([cp.Waypoint(1, 0, 0, 0), cp.Waypoint(3, 2, 0, 0)], labels=["z_ref"])
    plant = ct.nlsys(pvtol, None, inputs=["u1", "u2"], outputs=names, states=6, name="pvtol")
    law = ct.nlsys(None, hover, inputs=["z_ref", *names], outputs=["u1", "u2"], name="hover", dt=None)
    loop = ct.interconnect([plant, law, cp.create_source_iosystem(plan)], inputs=0, outputs=[*names, "u1", "u2"])
    start = [1.0, 0.5, -0.2, 0.0, 0.3, 0.1]
    found = cp.simulate(loop, T, None, start, method=method, rtol=1e-10, atol=1e-12)

    def rate(t, x):
        thrust = (1 + 2 * (quintic(t, 1, 3, 2.0) - x[1]) - 2 * x[4]) / math.cos(x[2])
        moment = 9 * (0.3 * math.tanh(x[0] + 1.5 * x[3]) - x[2]) - 5 * x[5]
        s, c = math.sin(x[2]), math.cos(x[2])
        return [*x[3:], -thrust * s + EPS * moment * c, thrust * c + EPS * moment * s - 1, moment]

    states = tight(rate, T, start, (1.0, 3.0))
    assert np.abs(states[:, -1]).max() < 2.1
    assert found.method == method
    assert gap(found.outputs[:6], states) <= 1e-7


@pytest.mark.parametrize("method", METHODS)
def test_a_saturated_loop(method):
    """x'' = -x' + sat(4 (r - x) - 2 x'), the plan fast enough for both limits."""
    plan = cp.PolySpline([cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(1.5, 3, 0, 0)], labels=["r"])
    law = ct.ss([], [], [], [[4.0, -4.0, -2.0]], inputs=["r", "x", "v"], outputs="u_cmd", name="law", dt=None)
    plant = ct.ss([[0, 1], [0, -1]], [[0], [1]], np.eye(2), 0, inputs="u", outputs=["x", "v"], name="plant")
    blocks = [cp.create_source_iosystem(plan), law, cp.create_saturation_iosystem(-0.5, 2.0), plant]
    loop = ct.interconnect(blocks, inputs=0, outputs=["x", "u"])
    found = cp.simulate(loop, T, method=method, rtol=1e-10, atol=1e-12)

    def control(t, x):
        return min(max(4 * (quintic(t, 0.5, 1.5, 3.0) - x[0]) - 2 * x[1], -0.5), 2.0)

    states = tight(lambda t, x: [x[1], -x[1] + control(t, x)], T, [0.0, 0.0], (0.5, 1.5))
    asked = np.array([control(t, x) for t, x in zip(T, states.T, strict=True)])
    assert (asked.min(), asked.max()) == (-0.5, 2.0)
    assert found.method == method
    assert gap(found.outputs, [states[0], asked]) <= 1e-7


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tracking_time", [None, 0.3])
def test_a_limited_pid_with_its_anti_windup(method, tracking_time):
    """A step of 3 on 1/(s + 1)^2 behind limits that hold it back; integral and filter as states."""
    kp, ki, kd, tf, limits = 6.0, 5.0, 2.0, 0.05, (-0.5, 4.0)
    pid = cp.create_pid_iosystem(kp, ki, kd, tf, bias=0.2, limits=limits, tracking_time=tracking_time)
    plant = ct.ss([[-1, 1], [0, -1]], [[0], [1]], [[1, 0]], 0, inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([pid, plant], inputs="r", outputs=["y", "u"])
    found = cp.simulate(loop, T, cp.Step(3.0, time=1.0), method=method, rtol=1e-10, atol=1e-12)
    back = 1.0 / (tracking_time or math.sqrt(kd / ki))

    def both(t, x):
        error = (3.0 if t >= 1.0 else 0.0) - x[2]
        asked = 0.2 + kp * error + x[0] + kd / tf * (error - x[1])
        out = min(max(asked, limits[0]), limits[1])
        return [ki * error + back * (out - asked), (error - x[1]) / tf, x[3] - x[2], out - x[3]], out

    states = tight(lambda t, x: both(t, x)[0], T, np.zeros(4), (1.0,))
    assert found.method == method
    assert gap(found.states, states) <= 1e-7
    out = [both(t, x)[1] for t, x in zip(T, states.T, strict=True)]
    assert max(out) == 4.0
    assert gap(found.outputs, [states[2], out]) <= 1e-7


def test_linear_systems_are_as_by_the_exact_method():
    rng = np.random.default_rng(3)
    plan = cp.stack(
        [
            cp.TrigSpline([cp.Waypoint(0.3, 0, 0, 0), cp.Waypoint(2.0, 1, -0.5), cp.Waypoint(3, 0)], alpha=2.0),
            cp.Step(-2.0, time=1.234),
        ],
        labels=["r", "d"],
    )
    for n in (1, 3, 6):
        a = rng.normal(size=(n, n)) - 2.0 * n**0.5 * np.eye(n)
        system = ct.ss(a, rng.normal(size=(n, 2)), rng.normal(size=(3, n)), rng.normal(size=(3, 2)))
        start = rng.normal(size=n)
        exact = cp.simulate(system, T, plan, start, method="exact")
        for method in METHODS:
            found = cp.simulate(system, T, plan, start, method=method, rtol=1e-10, atol=1e-12)
            assert found.method == method
            assert gap(found.states, exact.states) <= 1e-8
            assert gap(found.outputs, exact.outputs) <= 1e-8


# All blocks of the package trace


def flat_loop(plant, order, poles, label):
    plan = cp.PolySpline([cp.Waypoint(0, *[0.0] * (order + 1)), cp.Waypoint(2, 0.5, *[0.0] * order)], labels=[label])
    law = cp.create_flat_iosystem(plant, poles, labels=[label])
    blocks = [cp.create_source_iosystem(plan, order, suffix="_ref"), law, plant]
    return ct.interconnect(blocks, inputs=0, outputs=plant.output_labels[:1]), plan


FLAT = {
    "chain": (lambda: cp.plants.integrator_chain(3), 3, [-2, -3, -4], "y"),
    "motor": (cp.plants.dc_motor, 3, [-2, -3, -4], "angle"),
    "joint": (cp.plants.flexible_joint, 4, [-5, -6, -7, -8], "q1"),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", FLAT)
def test_flat_laws_follow_their_plans(case, method):
    make, order, poles, label = FLAT[case]
    loop, plan = flat_loop(make(), order, poles, label)
    found = cp.simulate(loop, T, method=method, rtol=1e-10, atol=1e-12)
    assert found.method == method
    assert np.abs(found.outputs.ravel() - plan(T)).max() <= 1e-7


@pytest.mark.parametrize("law", cp.plants.LAWS)
@pytest.mark.parametrize("rope_wrap", [False, True])
def test_every_law_of_the_crane_traces(law, rope_wrap):
    crane = cp.plants.Crane(rope_wrap=rope_wrap)
    limits = {} if law in ("dynamic", "feedforward") else {"force_limits": (-1e3, 1e3), "torque_limits": (-3e3, 1e3)}
    loop = cp.plants.crane_loop(crane, crane_plan(), law, **limits)
    times = np.linspace(0.0, 2.0, 5)
    compiled, python = (cp.simulate(loop, times, method=m, rtol=1e-9, atol=1e-9) for m in METHODS)
    assert cp.simulate(loop, times).method == "compiled"
    assert np.abs(rows_of(compiled, "x", "z", "R") - rows_of(python, "x", "z", "R")).max() <= 1e-6


@pytest.mark.parametrize(
    "block",
    [
        cp.create_saturation_iosystem(-1.0, 1.0, inputs="r", outputs="y"),
        cp.create_saturation_iosystem(-math.inf, 1.0, inputs="r", outputs="y"),
        cp.create_pid_iosystem(1.0, 2.0, 0.0, 0.1, limits=(-1.0, 1.0), inputs=("r", "d"), outputs="y"),
        cp.create_pid_iosystem(1.0, 0.0, 0.5, 0.1, bias=0.3, inputs=("r", "d"), outputs="y"),
    ],
    ids=["saturation", "half a saturation", "limited", "biased"],
)
def test_actuators_and_controllers_trace(block):
    assert cp.simulate(block, T, cp.stack([LANE] * block.ninputs, block.input_labels), method="compiled").nstates >= 0


def test_a_feedforward_traces_beside_what_is_not_linear():
    command = cp.create_feedforward_iosystem(cp.plants.integrator_lag_loop(4.0))
    plan = cp.PolySpline([cp.Waypoint(1, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)], labels=["y"])
    bent = ct.nlsys(None, lambda t, x, u, p: u**3, inputs="y", outputs="cubed", name="bent", dt=0)
    blocks = [cp.create_source_iosystem(plan, 2, suffix="_ref"), command, cp.plants.integrator_lag_loop(4.0), bent]
    loop = ct.interconnect(blocks, inputs=0, outputs=["y", "cubed"])
    for method in METHODS:
        found = cp.simulate(loop, T, method=method, rtol=1e-10, atol=1e-12)
        assert np.abs(found.outputs - [plan(T), plan(T) ** 3]).max() <= 1e-8


# What cannot be traced is run by Python, or right all the same


def zeros_and_entries(t, x, u, p):
    dx = np.zeros(2)
    dx[0] = x[1]
    dx[1] = -np.sin(x[0]) - 0.1 * x[1]
    return dx


def entries_by_loop(t, x, u, p):
    dx = np.empty_like(x)
    for i in range(len(x)):
        dx[i] = x[1] if i == 0 else -np.sin(x[0]) - 0.1 * x[1]
    return dx


def unpacked(t, x, u, p):
    angle, rate = x
    return [rate, -np.sin(angle) - 0.1 * rate]


def comprehended(t, x, u, p):
    sines = [np.sin(v) for v in x]
    return np.array([x[1], -sines[0] - 0.1 * x[1]])


def by_math(t, x, u, p):
    return np.array([x[1], -math.sin(x[0]) - 0.1 * x[1]])


def by_float(t, x, u, p):
    return np.array([float(x[1]), -np.sin(float(x[0])) - 0.1 * float(x[1])])


def by_item(t, x, u, p):
    return np.array([x[1].item(), -np.sin(x.tolist()[0]) - 0.1 * x[1]])


def by_solving(t, x, u, p):
    return np.linalg.solve(
        [[2.0, 1.0], [1.0, 1.0]], [2 * x[1] - np.sin(x[0]) - 0.1 * x[1], x[1] - np.sin(x[0]) - 0.1 * x[1]]
    )


def by_inverse(t, x, u, p):
    mass = np.array([[2.0 + np.cos(x[0]) ** 2, 0.0], [0.0, 1.0]])
    return np.linalg.inv(mass) @ np.array([(2.0 + np.cos(x[0]) ** 2) * x[1], -np.sin(x[0]) - 0.1 * x[1]])


def in_place(t, x, u, p):
    y = x.copy()
    y *= 0.1
    return np.array([10.0 * y[1], -np.sin(10.0 * y[0]) - y[1]])


def as_floats(t, x, u, p):
    x = np.asarray(x, dtype=float)
    return np.array([x[1], -np.sin(x[0]) - 0.1 * x[1]])


def by_matrix(t, x, u, p):
    return np.array([[0.0, 1.0], [0.0, -0.1]]) @ x - np.array([0.0, 1.0]) * np.sin(x)[0]


def stacked(t, x, u, p):
    return np.hstack([x[1:], -np.sin(x[:1]) - 0.1 * x[1:]])


def columns(t, x, u, p):
    return np.array([[x[1]], [-np.sin(x[0]) - 0.1 * x[1]]])


PENDULUM = [
    zeros_and_entries,
    entries_by_loop,
    unpacked,
    comprehended,
    by_math,
    by_float,
    by_item,
    by_solving,
    by_inverse,
    in_place,
    as_floats,
    by_matrix,
    stacked,
    columns,
]


def right_or_python(block, times, initial, states, allowed=1e-6):
    """What must hold of any block: compiled and right, or run by Python, its name in the reason."""
    found = cp.simulate(block, times, None, initial)
    assert np.abs(found.states - states).max() <= allowed
    if found.method == "python":
        assert block.name in found.reason
        with pytest.raises(ValueError, match=f"compiled.*block {block.name}"):
            cp.simulate(block, times, None, initial, method="compiled")
    else:
        assert found.method == "compiled"
        again = cp.simulate(block, times, None, initial, method="compiled")
        assert np.abs(again.states - states).max() <= allowed
    python = cp.simulate(block, times, None, initial, method="python")
    assert np.abs(python.states - states).max() <= allowed
    return found


@cache
def pendulum_states():
    return tight(lambda t, x: [x[1], -math.sin(x[0]) - 0.1 * x[1]], T, [2.0, 0.5])


@pytest.mark.parametrize("rate", PENDULUM, ids=lambda rate: rate.__name__)
def test_ways_to_write_a_pendulum(rate):
    block = ct.nlsys(rate, None, inputs=0, outputs=2, states=2, name=f"written_{rate.__name__}")
    right_or_python(block, T, [2.0, 0.5], pendulum_states())


FUNCTIONS = {
    "if": lambda v: v if v > 0.5 else 0.5 * v + 0.25,
    "where": lambda v: np.where(v > 0.5, v, 0.5 * v + 0.25),
    "max": lambda v: max(v, 0.7),
    "maximum": lambda v: np.maximum(v, 0.7),
    "fmin": lambda v: np.fmin(v, 1.2),
    "clip": lambda v: np.clip(v, 0.6, 1.2),
    "abs": lambda v: abs(v - 0.7),
    "sign": lambda v: 0.2 * np.sign(v + 3.0) + v,
    "a comparison times": lambda v: (v > 0.5) * (v - 0.5) + 0.5 * v,
    "arctan2": lambda v: np.arctan2(v, 1.0 + v * v),
    "hypot": lambda v: np.hypot(v, 1.0),
    "tanh": np.tanh,
    "expm1": np.expm1,
    "cbrt": np.cbrt,
    "interp": lambda v: np.interp(v, [0.0, 0.5, 1.0, 3.0], [0.0, 0.2, 0.7, 4.0]),
    "polyval": lambda v: np.polyval([0.1, -0.2, 1.0, 0.0], v),
    "expit": expit,
    "copysign": lambda v: math.copysign(1.0, v) * v,
    "select": lambda v: np.select([v > 1.0, v > 0.5], [v, 0.5 + 0.5 * (v - 0.5) / 0.5], 0.5 + 0.0 * v),
    "power": lambda v: v**1.5,
    "mean": lambda v: np.mean([v, 2.0 * v, 0.0]),
    "norm": lambda v: np.linalg.norm([v, 1.0]),
    "heaviside": lambda v: v * np.heaviside(v - 0.5, 1.0) + 0.5 * v * np.heaviside(0.5 - v, 0.0),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_of_a_state(name):
    """x' = -f(x) through a bend, from 2 down."""
    function = FUNCTIONS[name]
    block = ct.nlsys(
        lambda t, x, u, p: np.array([-function(x[0])]), None, inputs=0, outputs=1, states=1, name=f"bent_{name[:5]}"
    )
    breaks = [0.3]
    states = tight(lambda t, x: [-float(function(x[0]))], T[T <= 1.5], [2.0], breaks, "Radau")
    right_or_python(block, T[T <= 1.5], [2.0], states, 1e-5)


def test_a_random_number_is_no_constant():
    rng = np.random.default_rng(0)
    block = ct.nlsys(
        lambda t, x, u, p: -x,
        lambda t, x, u, p: x + 1e-3 * rng.standard_normal(1),
        inputs=0,
        outputs=1,
        states=1,
        name="noisy",
    )
    found = cp.simulate(block, T, None, 1.0)
    assert found.method == "python"
    assert "noisy" in found.reason
    assert np.abs(found.outputs.ravel() - np.exp(-T)).max() <= 0.01
    assert np.unique(found.outputs.ravel() - np.exp(-T)).size == T.size
    with pytest.raises(ValueError, match="noisy"):
        cp.simulate(block, T, None, 1.0, method="compiled")


def test_a_block_that_remembers_what_it_was_asked():
    """A memory that only saves work must not hand a symbol to a run, nor a number of another state."""
    known = {}

    def rate(t, x, u, p):
        key = (x[0],)
        if key not in known:
            known[key] = -(x[0] ** 3)
        return np.array([known[key]])

    block = ct.nlsys(rate, None, inputs=0, outputs=1, states=1, name="remembering")
    right_or_python(block, T, 1.0, 1 / np.sqrt(1 + 2 * T)[None])


def test_a_block_that_remembers_its_last_answer():
    """A hysteresis is written so: what Python does with it is the only right answer, and no trace is."""
    memory = {"on": 1.0}

    def rate(t, x, u, p):
        memory["on"] = 1.0 if x[0] < 0.2 else (0.0 if x[0] > 0.8 else memory["on"])
        return np.array([2.0 * memory["on"] - x[0]])

    block = ct.nlsys(rate, None, inputs=0, outputs=1, states=1, name="relay")
    found = cp.simulate(block, T, None, 0.5, rtol=1e-5)
    assert found.method == "python"
    assert "relay" in found.reason


# Traces that are right near the start alone

OSCILLATION = np.pi * np.arange(13)


def rates_with(force):
    return lambda t, x, u, p: np.array([x[1], -x[0] + force(t, x)])


def stop_at(level):
    return lambda t, x: -500.0 * (x[0] - level) if float(x[0]) > level else 0.0


FAR = {
    "float of time": (rates_with(lambda t, x: 0.0 if float(t) < 50.0 else -3.0 * x[0]), (50.0,)),
    "float of a state": (rates_with(lambda t, x: -3.0 * x[0] if float(x[0]) < -8.0 else 0.0), ()),
    "math of a state": (rates_with(lambda t, x: 0.0 if math.floor(x[0]) > -8.0 else -3.0 * (x[0] + 7.0)), ()),
    "lookup by int": (rates_with(lambda t, x: [0.0, -1.0, -2.0][min(int(abs(x[0]) / 6.0), 2)]), ()),
    "where": (rates_with(lambda t, x: np.where(x[0] < -8.0, -3.0 * (x[0] + 8.0), 0.0)), ()),
}


@pytest.mark.parametrize("name", FAR)
def test_traces_that_are_wrong_far_from_the_start(name):
    rate, breaks = FAR[name]
    times = np.linspace(0.0, 70.0, 141) if breaks else np.linspace(0.0, 7.0, 71)
    block = ct.nlsys(rate, None, inputs=0, outputs=2, states=2, name="far")
    states = tight(lambda t, x: rate(t, x, None, None), times, [10.0, 0.0], breaks)
    assert np.abs(states[0] - 10 * np.cos(times)).max() > 1e-3  # or nothing would be shown
    right_or_python(block, times, [10.0, 0.0], states, 1e-3 if "lookup" in name else 1e-4)


def test_a_branch_that_is_taken_between_the_visited_states():
    """A stop at 9.9 of an oscillation of 10, looked at where it passes the middle: no symbol may go through float."""
    rate = rates_with(stop_at(9.9))
    block = ct.nlsys(rate, None, inputs=0, outputs=2, states=2, name="stop")
    states = tight(lambda t, x: rate(t, x, None, None), OSCILLATION, [0.0, 10.0])
    assert np.abs(states[0]).max() > 0.1
    right_or_python(block, OSCILLATION, [0.0, 10.0], states, 1e-4)


def test_a_branch_of_time_between_the_visited_states():
    """A bump of 0.8 s once in 50 s, the samples on either side of it; its ends are declared as breakpoints."""

    def rate(t, x, u, p):
        return np.array([-x[0] + (5.0 if 25.1 < float(t) < 25.9 else 0.0)])

    block = ct.nlsys(rate, None, inputs=0, outputs=1, states=1, name="bump")
    cp.declare(block, breakpoints=(25.1, 25.9))
    times = np.arange(51.0)
    bump = np.where(times > 25.5, 5.0 * (np.exp(25.9 - times) - np.exp(25.1 - times)), 0.0)
    right_or_python(block, times, 1.0, (np.exp(-times) + bump)[None])


def test_a_table_with_the_state_as_its_key():
    """A dictionary that knows one value exactly reached, and a default: a symbol is never in it."""
    table = {0.0: 3.0}

    def out(t, x, u, p):
        return np.array([table.get(float(u[0]), 1.0)])

    block = ct.nlsys(None, out, inputs=1, outputs=1, name="table", dt=0)
    found = cp.simulate(block, np.arange(3.0), np.array([1.0, 0.0, 2.0]))
    hashed = ct.nlsys(None, lambda t, x, u, p: [table.get(u[0], 1.0)], inputs=1, outputs=1, name="hashed", dt=0)
    times = np.linspace(0.0, 10.0, 1001)
    signal = np.maximum(np.abs(times - 5.0) - 0.1, 0.0)
    again = cp.simulate(hashed, times, signal)
    assert found.outputs.tolist() == [1.0, 3.0, 1.0]
    assert again.outputs.tolist() == np.where(signal == 0.0, 3.0, 1.0).tolist()


# Without CasADi


def test_without_casadi_python_runs_and_says_what_to_install(monkeypatch):
    monkeypatch.setattr(extra, "find_spec", lambda name: None)
    block = ct.nlsys(lambda t, x, u, p: -(x**3), None, inputs=0, outputs=1, states=1, name="uncompiled")
    found = cp.simulate(block, T, None, 1.0)
    assert found.method == "python"
    assert "pip install" in found.reason
    assert np.abs(found.states[0] - 1 / np.sqrt(1 + 2 * T)).max() <= 1e-6
    with pytest.raises(ValueError, match=r"compiled.*CasADi is not installed \(pip install ctrlplan\[fast\]\)"):
        cp.simulate(block, T, None, 1.0, method="compiled")
    monkeypatch.undo()
    assert cp.simulate(cp.prepare(block), T, None, 1.0, method="compiled").method == "compiled"


# Parameters


def cubic(**params):
    return ct.nlsys(
        lambda t, x, u, p: -p["k"] * x**3,
        lambda t, x, u, p: p.get("c", 1.0) * x,
        inputs=0,
        outputs=1,
        states=1,
        params=params or {"k": 1.0},
        name="cubic",
    )


def counted(monkeypatch):
    """How often blocks are traced."""
    calls = []
    plain = traced_module.traced
    monkeypatch.setattr(traced_module, "traced", lambda block, *args: calls.append(block.name) or plain(block, *args))
    return calls


def test_one_compiled_form_for_all_values(monkeypatch):
    calls = counted(monkeypatch)
    ready = cp.prepare(cubic())
    for k in (1.0, 2.5, 7, np.float64(0.3), 0):
        for start in (1.0, 2.0):
            found = cp.simulate(ready, T, None, start, params={"k": k})
            assert found.method == "compiled"
            assert np.abs(found.states[0] - start / np.sqrt(1 + 2 * k * start**2 * T)).max() <= 1e-6
    assert calls == ["cubic"]
    assert len(ready._learned.forms) == 1


def test_one_compiled_form_for_all_plans_and_times(monkeypatch):
    calls = counted(monkeypatch)
    block = ct.nlsys(lambda t, x, u, p: -x + u, lambda t, x, u, p: x**2, inputs=1, outputs=1, states=1, name="driven")
    for height in (1.0, 2.0):
        for n in (11, 21):
            times = np.linspace(0.0, 2.0, n)
            found = cp.simulate(block, times, cp.Step(height, time=0.5))
            exact = (height * -np.expm1(-np.maximum(times - 0.5, 0.0))) ** 2
            assert np.abs(found.outputs - exact).max() <= 1e-7
    assert calls == ["driven"]


def test_arrays_as_parameters():
    block = ct.nlsys(
        lambda t, x, u, p: p["a"] @ x + p["b"] * np.sin(x[0]) * 0.0,
        None,
        inputs=0,
        outputs=2,
        states=2,
        params={"a": np.array([[0.0, 1.0], [-1.0, 0.0]]), "b": np.zeros(2)},
        name="arrays",
    )
    for method in METHODS:
        for w in (1.0, 2.0, 1.0):
            params = {"a": np.array([[0.0, w], [-w, 0.0]])}
            found = cp.simulate(block, T, None, [1.0, 0.0], method=method, params=params, rtol=1e-10)
            assert found.method == method
            assert np.abs(found.states - [np.cos(w * T), -np.sin(w * T)]).max() <= 1e-7


def test_an_array_parameter_changed_in_place():
    block = ct.nlsys(
        lambda t, x, u, p: -p["k"][0] * x**3, None, inputs=0, outputs=1, states=1, params={"k": np.ones(1)}, name="a"
    )
    k = np.array([1.0])
    for value in (1.0, 4.0, 9.0):
        k[0] = value
        found = cp.simulate(block, T, None, 1.0, params={"k": k}, method="compiled")
        assert np.abs(found.states[0] - 1 / np.sqrt(1 + 2 * value * T)).max() <= 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_parameters_that_are_no_numbers(method):
    """A flag, a word, a count and a list choose the equations; they may change from run to run, and back."""

    def rate(t, x, u, p):
        total = sum(x[0] for _ in range(p["count"]))
        total = total * (2.0 if p["double"] else 1.0)
        if p["sign"] == "minus":
            total = -total
        return np.array([total * p["weights"][0]])

    block = ct.nlsys(
        rate,
        None,
        inputs=0,
        outputs=1,
        states=1,
        params={"count": 1, "double": False, "sign": "minus", "weights": [0.5]},
        name="chosen",
    )
    times = np.linspace(0.0, 1.0, 6)
    cases = [
        ({}, -0.5),
        ({"count": 3}, -1.5),
        ({"count": 2}, -1.0),
        ({"count": 3, "double": True}, -3.0),
        ({"count": 3, "double": False}, -1.5),
        ({"sign": "plus", "count": 1}, 0.5),
        ({"sign": "minus", "count": 1}, -0.5),
        ({"weights": [0.25]}, -0.25),
        ({"weights": [0.75]}, -0.75),
        ({}, -0.5),
    ]
    for params, exponent in cases:
        found = cp.simulate(block, times, None, 1.0, method=method, params=params, rtol=1e-10, atol=1e-12)
        assert found.method == method
        assert np.abs(found.states[0] - np.exp(exponent * times)).max() <= 1e-8


def test_a_number_that_becomes_an_array():
    block = cubic()
    for k in (2.0, np.array([3.0]), 4.0):
        found = cp.simulate(block, T, None, 1.0, params={"k": k})
        assert np.abs(found.states[0] - 1 / np.sqrt(1 + 2 * float(np.ravel(k)[0]) * T)).max() <= 1e-6


def test_a_parameter_that_bends_the_equations_beyond_a_value():
    block = ct.nlsys(
        lambda t, x, u, p: -(p["k"] if float(p["k"]) < 5.0 else 20.0) * x,
        None,
        inputs=0,
        outputs=1,
        states=1,
        params={"k": 1.0},
        name="bending",
    )
    for k, rate in ((1.0, 1.0), (6.0, 20.0), (2.0, 2.0)):
        found = cp.simulate(block, T, None, 1.0, params={"k": k})
        assert np.abs(found.states[0] - np.exp(-rate * T)).max() <= 1e-6


def test_a_parameter_that_no_block_reads():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = cp.simulate(cubic(), T, None, 1.0, params={"unknown": 3.0, "word": "w", "k": 2.0})
    expected = [f"params {name!r} is read by no block of cubic" for name in ("unknown", "word")]
    assert [str(w.message) for w in caught] == expected
    assert np.abs(found.states[0] - 1 / np.sqrt(1 + 4 * T)).max() <= 1e-6


# Whose parameter counts


def nested(inner=None, middle=None, outer=None):
    """A cubic decay, two floors down, each floor with parameters of its own."""
    block = cubic(**{"k": 1.0, "c": 1.0, **(inner or {})})
    wire = ct.ss([], [], [], [[1.0]], inputs="y[0]", outputs="z", name="wire", dt=None)
    options = {} if middle is None else {"params": middle}
    first = ct.interconnect(
        [block, wire], inputs=0, outputs=["z"], connections=[["wire.y[0]", "cubic.y[0]"]], **options
    )
    options = {} if outer is None else {"params": outer}
    further = ct.ss([], [], [], [[1.0]], inputs="z", outputs="q", name="further", dt=None)
    return ct.interconnect([first, further], inputs=0, outputs=["q"], **options)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("levels", "run"),
    [
        ({}, None),
        ({"inner": {"k": 2.0}}, None),
        ({"inner": {"k": 2.0}, "middle": {"k": 3.0}}, None),
        ({"inner": {"k": 2.0}, "outer": {"k": 4.0}}, None),
        ({"inner": {"k": 2.0}, "middle": {"k": 3.0}, "outer": {"k": 4.0}}, None),
        ({"inner": {"k": 2.0}, "middle": {"k": 3.0}, "outer": {"k": 4.0}}, {"k": 5.0}),
        ({"inner": {"k": 2.0}, "middle": {"c": 3.0}, "outer": {"c": 4.0}}, {"k": 5.0}),
        ({"middle": {}, "outer": {}}, None),
        ({"outer": {"c": -2.0}}, {"k": 0.5, "c": 7.0}),
    ],
    ids=str,
)
def test_precedence_is_that_of_the_peer(levels, run, method):
    loop = nested(**levels)
    times = np.linspace(0.0, 1.0, 6)
    tolerances = {"rtol": 1e-10, "atol": 1e-12}
    peer = ct.input_output_response(loop, times, 0, 1.0, params=run or {}, solve_ivp_kwargs=tolerances)
    found = cp.simulate(loop, times, None, 1.0, method=method, params=run, **tolerances)
    assert np.abs(found.outputs.ravel() - peer.outputs.ravel()).max() <= 1e-7
    assert np.abs(found.states.ravel() - peer.states.ravel()).max() <= 1e-7


@pytest.mark.parametrize("method", METHODS)
def test_precedence_after_a_change_is_that_of_the_peer(method):
    loop = nested(inner={"k": 2.0})
    first = loop.syslist[0]
    times = np.linspace(0.0, 1.0, 6)
    tolerances = {"rtol": 1e-10, "atol": 1e-12}
    for change in (
        lambda: first.syslist[0].params.update(k=6.0),
        lambda: first.params.update(k=7.0),
        lambda: loop.params.update(k=8.0),
        lambda: (loop.params.clear(), first.params.clear()),
    ):
        change()
        peer = ct.input_output_response(loop, times, 0, 1.0, solve_ivp_kwargs=tolerances)
        found = cp.simulate(loop, times, None, 1.0, method=method, **tolerances)
        assert np.abs(found.outputs.ravel() - peer.outputs.ravel()).max() <= 1e-7
