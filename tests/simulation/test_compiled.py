"""Compiled loops compared with hand-written right-hand sides, integrated with the smallest tolerances."""

import math
from functools import cache

import control as ct
import numpy as np
import pytest
from compiled_cases import METHODS, T, tight

import ctrlplan as cp

RISE = np.polynomial.Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
"""From 0 to 1 on [0, 1], at rest at both ends up to the fourth derivative."""


def gap(found, exact):
    """Largest difference, each row relative to its own largest value."""
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
    requested = bias + kp * error + state[0] + kd / tf * (error - state[1])
    out = min(max(requested, limits[0]), limits[1])
    back = math.sqrt(ki / kd) if math.isfinite(limits[0]) else 0.0
    return out, [ki * error + back * (out - requested), (error - state[1]) / tf]


def driven_crane(law, force_limits=(-math.inf, math.inf), mass=M):
    """Rates of [integral, filter, integral, filter, D, R, theta, rates], and (F, C, T)."""
    trolley, hoist = gains(TROLLEY, F1), gains(DRUM / B + M * B, F2 / B)

    def both(t, x):
        plant = x[4:]
        jet = planned(t, 2)
        if law == "load_feedback":
            px, _, px1, _ = load_of(plant)
            requested = jet[2, 0] - 2.0 * (px1 - jet[1, 0]) - (px - jet[0, 0])
            d_ref, r_ref = generated(px, requested, jet[0, 1], jet[2, 1])
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


@pytest.mark.slow
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


@pytest.mark.slow
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
    """x'' = -x' + sat(4 (r - x) - 2 x'), with a plan that reaches both limits."""
    plan = cp.PolySpline([cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(1.5, 3, 0, 0)], labels=["r"])
    law = ct.ss([], [], [], [[4.0, -4.0, -2.0]], inputs=["r", "x", "v"], outputs="u_cmd", name="law", dt=None)
    plant = ct.ss([[0, 1], [0, -1]], [[0], [1]], np.eye(2), 0, inputs="u", outputs=["x", "v"], name="plant")
    blocks = [cp.create_source_iosystem(plan), law, cp.create_saturation_iosystem(-0.5, 2.0), plant]
    loop = ct.interconnect(blocks, inputs=0, outputs=["x", "u"])
    found = cp.simulate(loop, T, method=method, rtol=1e-10, atol=1e-12)

    def control(t, x):
        return min(max(4 * (quintic(t, 0.5, 1.5, 3.0) - x[0]) - 2 * x[1], -0.5), 2.0)

    states = tight(lambda t, x: [x[1], -x[1] + control(t, x)], T, [0.0, 0.0], (0.5, 1.5))
    requested = np.array([control(t, x) for t, x in zip(T, states.T, strict=True)])
    assert (requested.min(), requested.max()) == (-0.5, 2.0)
    assert found.method == method
    assert gap(found.outputs, [states[0], requested]) <= 1e-7


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tracking_time", [None, 0.3])
def test_a_limited_pid_with_its_anti_windup(method, tracking_time):
    """A step of 3 on 1/(s + 1)^2 with limits; integral and filter as states."""
    kp, ki, kd, tf, limits = 6.0, 5.0, 2.0, 0.05, (-0.5, 4.0)
    pid = cp.create_pid_iosystem(kp, ki, kd, tf, bias=0.2, limits=limits, tracking_time=tracking_time)
    plant = ct.ss([[-1, 1], [0, -1]], [[0], [1]], [[1, 0]], 0, inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([pid, plant], inputs="r", outputs=["y", "u"])
    found = cp.simulate(loop, T, cp.Step(3.0, time=1.0), method=method, rtol=1e-10, atol=1e-12)
    back = 1.0 / (tracking_time or math.sqrt(kd / ki))

    def both(t, x):
        error = (3.0 if t >= 1.0 else 0.0) - x[2]
        requested = 0.2 + kp * error + x[0] + kd / tf * (error - x[1])
        out = min(max(requested, limits[0]), limits[1])
        return [ki * error + back * (out - requested), (error - x[1]) / tf, x[3] - x[2], out - x[3]], out

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


def test_a_feedforward_traces_next_to_what_is_not_linear():
    command = cp.create_feedforward_iosystem(cp.plants.integrator_lag_loop(4.0))
    plan = cp.PolySpline([cp.Waypoint(1, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)], labels=["y"])
    bent = ct.nlsys(None, lambda t, x, u, p: u**3, inputs="y", outputs="cubed", name="bent", dt=0)
    blocks = [cp.create_source_iosystem(plan, 2, suffix="_ref"), command, cp.plants.integrator_lag_loop(4.0), bent]
    loop = ct.interconnect(blocks, inputs=0, outputs=["y", "cubed"])
    for method in METHODS:
        found = cp.simulate(loop, T, method=method, rtol=1e-10, atol=1e-12)
        assert np.abs(found.outputs - [plan(T), plan(T) ** 3]).max() <= 1e-8
