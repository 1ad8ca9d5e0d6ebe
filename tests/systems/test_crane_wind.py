"""Wind on the crane's load: Lagrange's and Newton's equations, work, rest; loops by hand, references, inputs."""

import math
from itertools import pairwise
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.integrate import simpson, solve_ivp

import ctrlplan as cp
from ctrlplan.systems.plants import Crane, crane_loop

WRAPS = pytest.mark.parametrize("wrap", [False, True], ids=["paper", "wrapped"])
METHODS = ("compiled", "python")
# All numbers different, so that swapped ones are detected.
ODD = {
    "load_mass": 430.0,
    "trolley_mass": 3100.0,
    "drum_inertia": 70.0,
    "drum_radius": 0.5,
    "trolley_friction": 40.0,
    "drum_friction": 30.0,
    "gravity": 9.5,
}
STATES = st.tuples(
    st.floats(-20, 20), st.floats(1, 20), st.floats(-1.2, 1.2), st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1)
)
INPUTS = st.tuples(st.floats(-3e4, 3e4), st.floats(-3e3, 1e3), st.floats(-5e3, 5e3))


# Equations of motion


@pytest.fixture(scope="module")
def mechanics():
    """Residuals of Lagrange's equations (rope winding on the drum) and of Newton's for three bodies, by sympy."""
    t, m, mass, inertia, b, f1, f2, g, force, torque, wind, pull = sp.symbols("t m M J b f1 f2 g F C W T")
    d, r, th = (sp.Function(name)(t) for name in ("D", "R", "theta"))
    x, z = r * sp.sin(th) + d + b * sp.cos(th), r * sp.cos(th) - b * sp.sin(th)
    second, states = sp.symbols("D2 R2 theta2"), sp.symbols("D R theta D1 R1 theta1")

    def plain(expression):
        for q, one, two in zip((d, r, th), states[3:], second, strict=True):
            expression = expression.subs(q.diff(t, 2), two).subs(q.diff(t), one)
        return expression.subs(dict(zip((d, r, th), states[:3], strict=True)))

    phi = r / b - th
    kinetic = (m * (x.diff(t) ** 2 + z.diff(t) ** 2) + mass * d.diff(t) ** 2 + inertia * phi.diff(t) ** 2) / 2
    lagrangian = kinetic + m * g * z
    lagrange = []
    for q in (d, r, th):
        # Virtual work of the trolley's force, the drum's torque, and of the wind along x.
        work = (force - f1 * d.diff(t)) * sp.diff(d, q) + (torque - f2 * phi.diff(t)) * sp.diff(phi, q)
        work += wind * sp.diff(x, q)
        lagrange.append(lagrangian.diff(q.diff(t)).diff(t) - lagrangian.diff(q) - work)
    newton = [
        m * x.diff(t, 2) - wind + pull * sp.sin(th),
        m * z.diff(t, 2) - m * g + pull * sp.cos(th),
        mass * d.diff(t, 2) - (force - f1 * d.diff(t) + pull * sp.sin(th)),
    ]
    drums = [r / b, phi]  # (14b) of the paper, and with the rope on the drum
    newton += [inertia * turn.diff(t, 2) - (torque - f2 * turn.diff(t) + b * pull) for turn in drums]
    arguments = ((m, mass, inertia, b, f1, f2, g), states, second, pull, (force, torque, wind))
    return SimpleNamespace(
        lagrange=sp.lambdify(arguments, [plain(e) for e in lagrange]),
        newton=sp.lambdify(arguments, [plain(e) for e in newton]),
        load=sp.lambdify(arguments[:2], [plain(e) for e in (x, z, x.diff(t), z.diff(t))]),
    )


def numbers(crane):
    return tuple(getattr(crane, name) for name in ODD)


def solved(mechanics, crane, state, inputs):
    """D'', R'', theta'', T: Newton's equations are linear in them."""
    rows = [0, 1, 2, 4 if crane.rope_wrap else 3]

    def residual(unknown):
        return np.array(mechanics.newton(numbers(crane), state, unknown[:3], unknown[3], inputs))[rows]

    zero = residual(np.zeros(4))
    return np.linalg.solve(np.column_stack([residual(e) - zero for e in np.eye(4)]), -zero)


@WRAPS
@given(STATES, INPUTS)
@examples(60)
def test_accelerations_and_tension_are_newtons(mechanics, wrap, state, inputs):
    """Load, trolley and drum each by itself, the constraint differentiated by sympy."""
    crane = Crane(**ODD, rope_wrap=wrap)
    found = np.array(crane.accelerations(state, *inputs))
    wanted = solved(mechanics, crane, state, inputs)
    assert np.all(np.abs(found - wanted) <= 1e-9 * np.maximum(np.abs(wanted), [1, 1, 1, 1e3]))


@given(STATES, INPUTS)
@examples(60)
def test_with_the_rope_on_the_drum_they_are_lagranges(mechanics, state, inputs):
    """The wind's generalised forces are W dx/dq."""
    crane = Crane(**ODD, rope_wrap=True)
    *second, _ = crane.accelerations(state, *inputs)
    left = np.array(mechanics.lagrange(numbers(crane), state, second, 0.0, inputs))
    assert np.abs(left).max() <= 1e-9 * 3e4 * 20


@WRAPS
def test_the_block_does_what_the_equations_say(mechanics, wrap):
    """Rates and outputs under F, C and wind; parameters of a run override the mass for the wind too."""
    crane = Crane(**ODD, rope_wrap=wrap)
    block = crane.iosystem(wind=True)
    assert block.input_labels == ["F", "C", "wind"]
    rng = np.random.default_rng(0)
    for _ in range(20):
        state = rng.uniform([-5, 2, -1, -2, -2, -1], [5, 15, 1, 2, 2, 1])
        inputs = rng.uniform([-2e4, -3e3, -4e3], [2e4, 500, 4e3])
        for mass in (430.0, 900.0):
            actual = Crane(**(ODD | {"load_mass": mass}), rope_wrap=wrap)
            *second, tension = solved(mechanics, actual, state, inputs)
            rates = block.dynamics(0.0, state, inputs, params={"load_mass": mass})
            seen = block.output(0.0, state, inputs, params={"load_mass": mass})
            assert np.allclose(rates, [*state[3:], *second], rtol=1e-9, atol=1e-9)
            outputs = dict(zip(block.output_labels, seen, strict=True))
            x, z, x1, z1 = mechanics.load(numbers(actual), state)
            wanted = {"x": x, "z": z, "x_d1": x1, "z_d1": z1, "T": tension, "D": state[0], "theta_d1": state[5]}
            for name, value in wanted.items():
                assert outputs[name] == pytest.approx(value, rel=1e-9, abs=1e-9), name


@WRAPS
def test_without_wind_the_block_is_what_it_was(wrap):
    crane = Crane(**ODD, rope_wrap=wrap)
    calm, windy = crane.iosystem(), crane.iosystem(wind=True)
    assert calm.input_labels == ["F", "C"]
    state, inputs = np.array([1.0, 8.0, 0.3, 0.5, -0.4, 0.2]), [1500.0, -2000.0]
    assert np.array_equal(calm.dynamics(0, state, inputs), windy.dynamics(0, state, [*inputs, 0.0]))
    assert np.array_equal(calm.output(0, state, inputs), windy.output(0, state, [*inputs, 0.0]))
    assert cp.traits_of(calm).feedthrough.shape == (11, 2)


@WRAPS
def test_at_once_the_wind_acts_on_the_tension_alone(mechanics, wrap):
    """By as much as Newton's equations say, and the attribute says so of all inputs."""
    crane = Crane(**ODD, rope_wrap=wrap)
    block = crane.iosystem(wind=True)
    state = np.array([1.0, 8.0, 0.3, 0.5, -0.4, 0.2])
    before, after = (block.output(0, state, [100.0, -1000.0, wind]) for wind in (0.0, 700.0))
    changed = {name for name, a, b in zip(block.output_labels, before, after, strict=True) if a != b}
    assert changed == {"T"}
    assert {block.output_labels[i] for i in np.flatnonzero(cp.traits_of(block).feedthrough[:, 2])} == {"T"}
    assert cp.traits_of(block).feedthrough.shape == (11, 3)
    wanted = [solved(mechanics, crane, state, [100.0, -1000.0, wind])[3] for wind in (0.0, 700.0)]
    assert (after - before)[10] == pytest.approx(wanted[1] - wanted[0], rel=1e-9)


@pytest.mark.parametrize("wind", [-900.0, 300.0, 4000.0])
@WRAPS
def test_under_a_constant_wind_the_load_rests_aslant(wrap, wind):
    """tan theta = W/(m g), T = hypot(m g, W), F = -W, C = -b T: nothing accelerates."""
    crane = Crane(**ODD, rope_wrap=wrap)
    m, b, g = 430.0, 0.5, 9.5
    pull = math.hypot(m * g, wind)
    state = [3.0, 7.0, math.atan2(wind, m * g), 0.0, 0.0, 0.0]
    *second, tension = crane.accelerations(state, -wind, -b * pull, wind)
    assert np.abs(second).max() <= 1e-12
    assert tension == pytest.approx(pull, rel=1e-12)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("frictions", [(0.0, 0.0), (400.0, 300.0)], ids=["frictionless", "with friction"])
def test_energy_grows_by_the_work_of_wind_and_drives(frictions, method):
    """E' = W x' + F D' + C phi' - f1 D'^2 - f2 phi'^2, phi' = R'/b - theta'; by Simpson's rule."""
    f1, f2 = frictions
    crane = Crane(**(ODD | {"trolley_friction": f1, "drum_friction": f2}), rope_wrap=True)
    m, mass, inertia, b, *_ = numbers(crane)
    gust = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(2, 800, 0), cp.Waypoint(5, -300, 0)])
    torque, force = -b * m * 9.5, 150.0
    t = np.linspace(0, 5, 2001)
    start = [0.0, 8.0, 0.2, 0.1, -0.1, 0.05]
    found = cp.simulate(
        crane.iosystem(wind=True),
        t,
        {"F": force, "C": torque, "wind": gust},
        start,
        method=method,
        rtol=1e-11,
        atol=1e-11,
    )
    d1, r1, th1 = np.asarray(found.states)[3:]
    x, z, x1, z1 = (np.asarray(found.outputs)[found.output_labels.index(name)] for name in ("x", "z", "x_d1", "z_d1"))
    turn = r1 / b - th1
    energy = 0.5 * (m * (x1**2 + z1**2) + mass * d1**2 + inertia * turn**2) - m * 9.5 * z
    power = gust(t) * x1 + force * d1 + torque * turn - f1 * d1**2 - f2 * turn**2
    assert np.ptp(x) > 0.2
    assert simpson(gust(t) * x1, x=t) > 50.0  # the wind has its part
    for k in (500, 1000, 2000):
        assert energy[k] - energy[0] == pytest.approx(simpson(power[: k + 1], x=t[: k + 1]), rel=1e-7, abs=1e-4)


# Loops


def move(order=2, points=((0.0, 0.0, 10.0), (6.0, 4.0, 9.0))):
    rest = [0.0] * order
    return cp.PolySpline([cp.Waypoint.from_jets(t, x=[x, *rest], z=[z, *rest]) for t, x, z in points])


M, MC, J, B, F1, F2, G = 500.0, 5000.0, 50.0, 0.25, 20.0, 20.0, 9.81
GUST = cp.Step(600.0, time=1.5) + cp.PolySpline([cp.Waypoint(3, 0, 0), cp.Waypoint(5, -900, 0)])
TIMES = np.linspace(0, 9, 91)


def gust_by_hand(t, left):
    """600 N from 1.5 s on, down by 900 N along a cubic from 3 s to 5 s; `left` is where the part begins."""
    s = min(max((t - 3.0) / 2.0, 0.0), 1.0)
    return (600.0 if left >= 1.5 else 0.0) - 900.0 * (3 * s**2 - 2 * s**3)


def pid_by_hand(mass, friction, error, state, bias, w=5.0, tf=0.02):
    kp, ki, kd = 3 * mass * w**2, mass * w**3, 3 * mass * w - friction
    return bias + kp * error + state[0] + kd * (error - state[1]) / tf, [ki * error, (error - state[1]) / tf]


def loop_by_hand(wrap, law):
    """Crane states under law, PIDs and the gust, tightly from break to break."""
    plan, state, rows = move(), np.array([0, 0, 0, 0, -B, 10.0, 0, 0, 0, 0]), []
    edges = [0.0, 1.5, 3.0, 5.0, 6.0, 9.0]
    for left, right in pairwise(edges):

        def rate(t, y, left=left, right=right):
            (d, r, _, d1, r1, th1), s, c = y[4:], math.sin(y[6]), math.cos(y[6])
            p = plan.jet(t, 2) if left < 6 else np.array([plan.final, [0, 0], [0, 0]])
            if left < 6 <= t:
                p = plan.jet(6.0, 2, left=True)
            x, x1 = r * s + d + B * c, r1 * s + r * th1 * c + d1 - B * th1 * s
            # The feedback puts the measured x in the place of the planned one.
            where, requested = p[0, 0], p[2, 0]
            if law == "load_feedback":
                where, requested = x, requested - 2 * (x1 - p[1, 0]) - (x - p[0, 0])
            pull = math.hypot(requested, G - p[2, 1])
            d_ref = where - (B * pull - p[0, 1] * requested) / (G - p[2, 1])
            r_ref = (p[0, 1] * pull - B * requested) / (G - p[2, 1])
            force, moved = pid_by_hand(MC, F1, d_ref - d, y[:2], 0.0)
            torque, wound = pid_by_hand(J / B + M * B, F2 / B, r_ref - r, y[2:4], -B * M * G)
            wind = gust_by_hand(t, left)
            matrix = [[s, 1, -B, 1 / M], [c, 0, r, 0], [MC, 0, 0, -s], [0, J / B, -J if wrap else 0, -B]]
            right_side = [
                wind / M * s + G * c + r * th1**2,
                wind / M * c - G * s - 2 * r1 * th1 + B * th1**2,
                force - F1 * d1,
                torque - F2 * (r1 / B - (th1 if wrap else 0)),
            ]
            return [*moved, *wound, d1, r1, th1, *np.linalg.solve(matrix, right_side)[:3]]

        inside = TIMES[np.logical_and(np.greater(TIMES, left - 1e-12), np.less(TIMES, right - 1e-12))]
        requested_times = np.append(inside, right)
        run = solve_ivp(rate, (left, right), state, method="LSODA", t_eval=requested_times, rtol=1e-10, atol=1e-11)
        assert run.success
        rows.append(run.y[:, : inside.size])
        state = run.y[:, -1]
    return np.column_stack([*rows, state])


CASES = [(False, "generator"), (True, "load_feedback")]


@pytest.fixture(scope="module")
def blown():
    """The loop in the gust: as a trajectory by both methods, and from outside."""
    found = {}
    for wrap, law in CASES:
        inside = crane_loop(Crane(rope_wrap=wrap), move(), law, wind=GUST)
        outside = crane_loop(Crane(rope_wrap=wrap), move(), law, inputs=["wind"])
        for method in METHODS:
            found[law, method] = cp.simulate(inside, TIMES, method=method, rtol=1e-10, atol=1e-11)
            found[law, method, "outside"] = cp.simulate(
                outside, TIMES, {"wind": GUST}, method=method, rtol=1e-10, atol=1e-11
            )
    return found


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("wrap", "law"), CASES)
def test_a_loop_in_the_wind_against_its_equations_by_hand(blown, wrap, law, method):
    found = blown[law, method]
    wanted = loop_by_hand(wrap, law)
    assert found.method == method
    states = np.asarray(found.states)
    assert np.abs(states[-6:-3] - wanted[4:7]).max() <= 1e-6
    assert np.abs(states[-3:] - wanted[7:]).max() <= 1e-5
    calm = cp.simulate(crane_loop(Crane(rope_wrap=wrap), move(), law), TIMES)
    assert np.abs(np.asarray(calm.states)[-4] - states[-4]).max() > 0.05  # the wind has a noticeable effect on theta


@pytest.mark.parametrize("law", [law for _, law in CASES])
@pytest.mark.slow
def test_compiled_and_python_agree_in_the_wind(blown, law):
    first, second = (np.asarray(blown[law, method].outputs) for method in METHODS)
    size = np.abs(first).max(axis=1, keepdims=True)
    assert np.abs((first - second) / size).max() <= 1e-6


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("law", [law for _, law in CASES])
def test_wind_from_outside_is_the_same_as_the_trajectory(blown, law, method):
    inside, outside = blown[law, method], blown[law, method, "outside"]
    assert outside.input_labels == ["wind"]
    assert inside.output_labels == outside.output_labels
    first, second = np.asarray(inside.outputs), np.asarray(outside.outputs).reshape(len(inside.output_labels), -1)
    assert np.abs((first - second) / np.abs(first).max(axis=1, keepdims=True)).max() <= 1e-7


def test_in_a_steady_wind_feedback_settles_with_the_rope_aslant():
    """theta to atan(W/(m g)), T to hypot(m g, W), F to -W; but x deviates by the acceleration that the law commands."""
    loop = crane_loop(Crane(), move(), "load_feedback", wind=cp.Step(400.0, time=2.0))
    found = cp.simulate(loop, np.linspace(0, 60, 61))
    last = dict(zip(found.output_labels, np.asarray(found.outputs)[:, -1], strict=True))
    assert last["theta"] == pytest.approx(math.atan2(400.0, M * G), abs=1e-6)
    assert last["T"] == pytest.approx(math.hypot(400.0, M * G), rel=1e-6)
    assert last["F"] == pytest.approx(-400.0, abs=0.1)
    assert last["C"] == pytest.approx(-B * math.hypot(400.0, M * G), rel=1e-5)
    assert abs(last["x"] - 4.0) > 0.05


@pytest.mark.parametrize("law", ["dynamic", "feedforward"])
def test_laws_without_drives_feel_the_wind_too(law):
    """The impulse of a push is the same: of W for 0.2 s on the load of m the rate grows by 0.2 W/m, in little more."""
    plan = move(4, ((0.0, 0.0, 10.0), (6.0, 0.0, 10.0)))
    push = cp.Step(200.0, time=1.0) + cp.Step(-200.0, time=1.2)
    found = cp.simulate(crane_loop(Crane(), plan, law, wind=push), [0.0, 1.0, 1.2, 3.0])
    rates = np.asarray(found.outputs)[found.output_labels.index("x_d1")]
    assert abs(rates[1]) <= 1e-9
    assert rates[2] == pytest.approx(200.0 * 0.2 / M, rel=0.1)


def test_a_wind_whose_axis_has_any_name_and_breakpoints_of_its_own():
    """A gust between two samples that are far apart is not missed: its impulse remains."""
    plan = move(2, ((0.0, 0.0, 10.0), (1.0, 0.0, 10.0)))
    short = cp.Step(5e3, time=20.0, labels=["x"]) + cp.Step(-5e3, time=20.01)
    found = cp.simulate(crane_loop(Crane(), plan, wind=short), [0.0, 15.0, 20.0, 20.01, 30.0])
    rates = np.asarray(found.outputs)[found.output_labels.index("x_d1")]
    assert rates[3] == pytest.approx(5e3 * 0.01 / M, rel=0.01)


# References and initial states


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("law", ["generator", "load_feedback", "dynamic", "feedforward", "setpoint"])
def test_the_plans_source_as_the_reference_is_the_plain_loop(law, method):
    plan = move(4)
    order = {"dynamic": 4, "feedforward": 4, "setpoint": 0}.get(law, 2)
    own = crane_loop(Crane(), plan, law, reference=[cp.create_source_iosystem(plan, order, suffix="_ref", name="mine")])
    plain = crane_loop(Crane(), plan, law)
    assert own.output_labels == plain.output_labels
    assert np.array_equal(own.initial_state, plain.initial_state)
    first, second = (np.asarray(cp.simulate(loop, TIMES[:61], method=method).outputs) for loop in (own, plain))
    assert np.array_equal(first, second)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["generator", "dynamic"])
def test_an_unhurried_time_scaling_as_the_reference_is_the_plain_loop(law):
    """Without errors: the same as the source, to the tolerance of the solver."""
    plan, order = move(4), 4 if law == "dynamic" else 2
    scaling = cp.create_time_scaling_iosystem(plan, order, errors={"x": (50.0, 100.0)}, suffix="_ref")
    own = crane_loop(Crane(), plan, law, reference=[scaling])
    plain = crane_loop(Crane(), plan, law)
    assert own.nstates == plain.nstates + order + 1
    first, second = (np.asarray(cp.simulate(loop, TIMES, rtol=1e-10, atol=1e-12).outputs) for loop in (own, plain))
    assert np.abs((first - second) / np.maximum(np.abs(second).max(axis=1, keepdims=True), 1e-3)).max() <= 1e-6


@pytest.mark.slow
def test_a_slowed_time_scaling_on_the_crane_keeps_the_path_and_the_load_nearer_its_reference():
    """A plan too fast for the actuators: with the time scaling the tracking error is less than half."""
    plan = move(2, ((0.0, 0.0, 10.0), (6.0, 20.0, 9.0)))
    limits = {"force_limits": (-15e3, 15e3)}
    scaling = cp.create_time_scaling_iosystem(plan, 2, errors={"x": (0.05, 0.5)}, suffix="_ref", fastest=1.0)
    runs = {}
    for name, options in (("plain", {}), ("slowed", {"reference": [scaling]})):
        found = cp.simulate(crane_loop(Crane(), plan, **limits, **options), np.linspace(0, 40, 401))
        runs[name] = dict(zip(found.output_labels, np.asarray(found.outputs), strict=True))
    error = {name: np.abs(run["x"] - run["x_ref"])[:150].max() for name, run in runs.items()}
    assert error["slowed"] < 0.5 * error["plain"]
    x, z = runs["slowed"]["x_ref"], runs["slowed"]["z_ref"]
    assert np.abs(z - (10 - x / 20)).max() <= 1e-9  # both axes are one quintic
    assert x[-1] == pytest.approx(20.0, abs=1e-9)


def test_initial_states_in_the_order_of_the_blocks():
    """Reference blocks at their declared states, a wind without states, law and PIDs at 0, the crane in equilibrium."""
    plan = move()
    first, second = (
        cp.create_command_filter_iosystem(1.0, 2, inputs=f"{axis}_cmd", outputs=f"{axis}_ref") for axis in "xz"
    )
    cp.declare(first, initial_state=[1.0, 2.0, 3.0])
    cp.declare(second, initial_state=4.0)
    loop = crane_loop(Crane(), plan, reference=[first, second], inputs=["x_cmd", "z_cmd"], wind=GUST)
    assert loop.input_labels == ["x_cmd", "z_cmd"]
    assert loop.initial_state.tolist() == [1, 2, 3, 4, 4, 4, 0, 0, 0, 0, -B, 10, 0, 0, 0, 0]
    found = cp.simulate(loop, [0.0, 1.0], {"x_cmd": 0.0, "z_cmd": 10.0})
    assert np.asarray(found.states)[:, 0].tolist() == loop.initial_state.tolist()


def test_inputs_come_in_the_order_given():
    loop = crane_loop(Crane(), move(), inputs=["wind", "F"])
    assert loop.input_labels == ["wind", "F"]
    assert crane_loop(Crane(), move(), wind=GUST).ninputs == 0
    assert crane_loop(Crane(), move()).ninputs == 0


def test_a_force_from_outside_adds_to_that_of_the_drive():
    """At rest a push on the trolley, before the PID responds: D'' = F/M_c in the first instant."""
    plan = move(2, ((0.0, 0.0, 10.0), (1.0, 0.0, 10.0)))
    loop = crane_loop(Crane(trolley_friction=0.0), plan, inputs=["F"])
    found = cp.simulate(loop, [0.0, 1e-3], 1000.0)
    rate = np.asarray(found.states)[-3, -1]
    assert rate == pytest.approx(1000.0 / MC * 1e-3, rel=0.05)


EITHER = (TypeError, ValueError)
SOURCE = cp.create_source_iosystem(move(), 2, suffix="_ref")
BAD = {
    "a number for the wind": (EITHER, "wind must be a trajectory", {"wind": 5.0}),
    "a wind of two axes": (EITHER, "wind must be a trajectory of one axis", {"wind": cp.Step([1.0, 2.0])}),
    "wind twice": (EITHER, "wind must be .*, got wind among inputs", {"wind": GUST, "inputs": ["wind"]}),
    "a string for inputs": (TypeError, "inputs must be a sequence", {"inputs": "wind"}),
    "a block for the reference": (TypeError, "reference must be a sequence", {"reference": SOURCE}),
    "a plan in the reference": (TypeError, "reference must contain control systems", {"reference": [move()]}),
    "inputs twice": (ValueError, "inputs", {"inputs": ["wind", "wind"]}),
    "an unknown input": (ValueError, "wnd", {"inputs": ["wnd"]}),
    "no reference": (ValueError, "x_ref", {"reference": []}),
    "jets that the law lacks": (
        (ValueError, UserWarning),
        "x_ref_d2",
        {"reference": [cp.create_source_iosystem(move(), 1, suffix="_ref")]},
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_of_the_loop(case):
    kind, message, given = BAD[case]
    with pytest.raises(kind, match=message):
        crane_loop(Crane(), move(), **given)


def test_an_initial_state_of_the_wrong_size_names_its_block():
    other = cp.create_command_filter_iosystem(1.0, 2, inputs="z_cmd", outputs="z_ref")
    with pytest.raises(ValueError, match="initial_state of z_ref_filter must be a finite number or 3 of them"):
        cp.declare(other, initial_state=[10.0, 0.0])


@pytest.mark.slow
def test_a_loop_in_the_wind_is_a_system_of_python_control():
    """Its own solver runs it: the same load at the end, to that solver's tolerance."""
    loop = crane_loop(Crane(), move(), wind=cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(6, 500, 0)]))
    t = np.linspace(0, 6, 61)
    theirs = ct.input_output_response(
        loop,
        t,
        initial_state=loop.initial_state,
        solve_ivp_method="LSODA",
        solve_ivp_kwargs={"rtol": 1e-8, "atol": 1e-9},
    )
    ours = cp.simulate(loop, t)
    assert np.abs(np.asarray(theirs.outputs)[:5] - np.asarray(ours.outputs)[:5]).max() <= 1e-5
