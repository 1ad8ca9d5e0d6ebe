"""Crane: equations compared with Lagrange's, flat maps with both, linear models, rejected plans."""

import math
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
import sympy as sp
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from repetitions import examples
from scipy.integrate import solve_ivp

import ctrlplan as cp
from ctrlplan.systems.plants import Crane

BOTH = pytest.mark.parametrize("wrap", [False, True], ids=["paper", "wrapped"])
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


def solved(crane, state, force, torque):
    """D'', R'', theta'', T from the four equations of motion as a matrix."""
    m, b, g = crane.load_mass, crane.drum_radius, crane.gravity
    _, r, th, d1, r1, th1 = state
    s, c = math.sin(th), math.cos(th)
    wrap = 1.0 if crane.rope_wrap else 0.0
    matrix = [
        [s, 1.0, -b, 1.0 / m],
        [c, 0.0, r, 0.0],
        [crane.trolley_mass, 0.0, 0.0, -s],
        [0.0, crane.drum_inertia / b, -wrap * crane.drum_inertia, -b],
    ]
    right = [
        g * c + r * th1**2,
        -g * s - 2.0 * r1 * th1 + b * th1**2,
        force - crane.trolley_friction * d1,
        torque - crane.drum_friction * (r1 / b - wrap * th1),
    ]
    return np.linalg.solve(matrix, right)


def mechanical_energy(crane, state):
    """Of load, trolley and drum, the load's speed by differentiating its position along the motion."""
    m, b = crane.load_mass, crane.drum_radius
    d, r, th, d1, r1, th1 = state
    step = 1e-30j  # complex step: exact to rounding
    d, r, th = d + step * d1, r + step * r1, th + step * th1
    x, z = r * np.sin(th) + d + b * np.cos(th), r * np.cos(th) - b * np.sin(th)
    speed = np.array([x.imag, z.imag]) / 1e-30
    drum = r1 / b - (th1 if crane.rope_wrap else 0.0)
    kinetic = m * speed @ speed + crane.trolley_mass * d1**2 + crane.drum_inertia * drum**2
    return 0.5 * kinetic - m * crane.gravity * z.real


# Against Lagrange and Newton, symbolically


@pytest.fixture(scope="module")
def lagrange():
    """Lagrange's equations of trolley, drum and load, the rope winding on the drum; T from Newton's law of the load."""
    t, m, mass, inertia, b, f1, f2, g, force, torque = sp.symbols("t m M J b f1 f2 g F C")
    d, r, th = (sp.Function(name)(t) for name in ("D", "R", "theta"))
    x, z = r * sp.sin(th) + d + b * sp.cos(th), r * sp.cos(th) - b * sp.sin(th)
    phi = r / b - th
    kinetic = (m * (x.diff(t) ** 2 + z.diff(t) ** 2) + mass * d.diff(t) ** 2 + inertia * phi.diff(t) ** 2) / 2
    lagrangian = kinetic + m * g * z
    equations = []
    for q in (d, r, th):
        work = (force - f1 * d.diff(t)) * sp.diff(d, q) + (torque - f2 * phi.diff(t)) * sp.diff(phi, q)
        equations.append(lagrangian.diff(q.diff(t)).diff(t) - lagrangian.diff(q) - work)
    second = sp.symbols("D2 R2 theta2")
    states = sp.symbols("D R theta D1 R1 theta1")

    def plain(expression):
        for q, one, two in zip((d, r, th), states[3:], second, strict=True):
            expression = expression.subs(q.diff(t, 2), two).subs(q.diff(t), one)
        return expression.subs(dict(zip((d, r, th), states[:3], strict=True)))

    # m (x'', z'') = T (-sin, -cos) + (0, m g), along the rope.
    pull = m * ((g - z.diff(t, 2)) * sp.cos(th) - x.diff(t, 2) * sp.sin(th))
    parameters = (m, mass, inertia, b, f1, f2, g)
    return SimpleNamespace(
        residuals=sp.lambdify((parameters, states, second, (force, torque)), [plain(e) for e in equations]),
        pull=sp.lambdify((parameters, states, second), plain(pull)),
    )


def numbers(crane):
    return tuple(
        getattr(crane, name)
        for name in (
            "load_mass",
            "trolley_mass",
            "drum_inertia",
            "drum_radius",
            "trolley_friction",
            "drum_friction",
            "gravity",
        )
    )


STATES = st.tuples(
    st.floats(-20, 20), st.floats(1, 20), st.floats(-1.2, 1.2), st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1)
)
INPUTS = st.tuples(st.floats(-3e4, 3e4), st.floats(-3e3, 1e3))


@pytest.mark.slow
@given(STATES, INPUTS)
@examples(60)
def test_with_the_rope_winding_motion_is_lagranges(lagrange, state, inputs):
    crane = Crane(**ODD, rope_wrap=True)
    *second, tension = crane.accelerations(state, *inputs)
    # Forces of 1e5 cancel here.
    np.testing.assert_allclose(lagrange.residuals(numbers(crane), state, second, inputs), 0.0, atol=1e-8)
    assert tension == pytest.approx(lagrange.pull(numbers(crane), state, second), rel=1e-10, abs=1e-8)


@BOTH
@given(STATES, INPUTS)
@examples(60)
def test_accelerations_solve_the_equations_of_motion(wrap, state, inputs):
    crane = Crane(**ODD, rope_wrap=wrap)
    expected = solved(crane, state, *inputs)
    np.testing.assert_allclose(crane.accelerations(state, *inputs), expected, rtol=1e-10, atol=1e-9)
    block = crane.iosystem()
    rates = dict(zip(block.state_labels, block.dynamics(0.0, state, inputs), strict=True))
    assert (rates["D"], rates["R"], rates["theta"]) == state[3:]
    np.testing.assert_allclose([rates[f"{q}_d1"] for q in ("D", "R", "theta")], expected[:3], rtol=1e-10, atol=1e-9)


@pytest.fixture(scope="module")
def reverse_map():
    """(15a-d) corrected, as functions of time that sympy differentiates."""
    t, m, mass, inertia, b, f1, f2, g = sp.symbols("t m M J b f1 f2 g", positive=True)
    x, z = sp.Function("x")(t), sp.Function("z")(t)
    across, hanging = x.diff(t, 2), g - z.diff(t, 2)
    pull = sp.sqrt(across**2 + hanging**2)
    r, d = (z * pull - b * across) / hanging, x - (b * pull - z * across) / hanging
    th = sp.atan2(-across, hanging)
    return SimpleNamespace(**{k: v for k, v in locals().items() if k != "pull"}, tension=m * pull)


@pytest.mark.slow
def test_the_reverse_map_is_the_geometry_and_newtons_law_symbolically(reverse_map):
    e = reverse_map
    sine, cosine = -e.across * e.m / e.tension, e.hanging * e.m / e.tension  # of theta, as g - z'' > 0
    assert sp.simplify(e.r * sine + e.d + e.b * cosine - e.x) == 0
    assert sp.simplify(e.r * cosine - e.b * sine - e.z) == 0
    assert sp.simplify(sine**2 + cosine**2) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "jet",
    [
        ((0, 1, sp.Rational(3, 2), sp.Rational(-4, 5), 2), (10, sp.Rational(-1, 2), 1, sp.Rational(1, 3), -3)),
        ((7, -2, -4, 3, sp.Rational(-7, 2)), (5, 2, -6, -5, 4)),
        ((0, 0, 0, 0, 0), (8, 0, 0, 0, 0)),
    ],
)
@BOTH
def test_quantities_are_sympys_at_rational_jets(reverse_map, wrap, jet):
    e, crane = reverse_map, Crane(**ODD, rope_wrap=wrap)
    plan = [sum(sp.Rational(c) * e.t**k / sp.factorial(k) for k, c in enumerate(axis)) for axis in jet]
    names = (e.m, e.mass, e.inertia, e.b, e.f1, e.f2, e.g)
    given_numbers = dict(zip(names, map(sp.nsimplify, numbers(crane)), strict=True))

    def along(expression):
        return expression.subs(dict(zip((e.x, e.z), plan, strict=True))).doit().subs(given_numbers)

    d, r, th, tension = (along(q) for q in (e.d, e.r, e.th, e.tension))
    phi = r / given_numbers[e.b] - (th if wrap else 0)
    n = given_numbers
    force = n[e.mass] * d.diff(e.t, 2) + n[e.f1] * d.diff(e.t) + n[e.m] * plan[0].diff(e.t, 2)
    torque = n[e.inertia] * phi.diff(e.t, 2) + n[e.f2] * phi.diff(e.t) - n[e.b] * tension
    expected = {"F": force, "C": torque}
    for name, q in {"D": d, "R": r, "theta": th, "T": tension}.items():
        expected |= {name + (f"_d{k}" if k else ""): q.diff(e.t, k) for k in range(3)}
    at_zero = {name: float(q.subs(e.t, 0).evalf(30)) for name, q in expected.items()}
    found = crane.quantities(np.array(jet, dtype=float).T)
    assert found.keys() == at_zero.keys()
    for name, value in at_zero.items():
        assert float(found[name]) == pytest.approx(value, rel=1e-12, abs=1e-11), name
    for order in (2, 3):  # shorter jets: the same numbers, fewer of them
        short = crane.quantities(np.array(jet, dtype=float).T[: order + 1])
        assert short.keys() == {n for n in found if n in "DRthetaT" or (order == 3 and n.endswith("_d1"))}
        assert {k: float(v) for k, v in short.items()} == {k: float(found[k]) for k in short}


# Forward after reverse

JETS = st.tuples(
    *[st.tuples(st.floats(*first), *[st.floats(-3, 3)] * 1, st.floats(*second), st.floats(-4, 4), st.floats(-5, 5))
      for first, second in (((-20, 20), (-6, 6)), ((2, 20), (-6, 6)))]
)  # fmt: skip


@BOTH
@given(JETS)
@examples(100)
def test_forward_after_reverse_is_the_identity(wrap, jets):
    crane = Crane(**ODD, rope_wrap=wrap)
    jet = np.array(jets).T
    q = crane.quantities(jet)
    assume(q["R"] > 0.5)
    state = [q["D"], q["R"], q["theta"], q["D_d1"], q["R_d1"], q["theta_d1"]]
    d2, r2, th2, tension = crane.accelerations(state, q["F"], q["C"])
    expected = [q["D_d2"], q["R_d2"], q["theta_d2"]]
    scale = max(1.0, *np.abs(expected))
    np.testing.assert_allclose(np.array([d2, r2, th2]) / scale, np.array(expected) / scale, atol=1e-10)
    assert tension == pytest.approx(float(q["T"]), rel=1e-10)
    block = crane.iosystem()
    out = dict(zip(block.output_labels, block.output(0.0, state, [q["F"], q["C"]]), strict=True))
    load = [[out["x"], out["z"]], [out["x_d1"], out["z_d1"]]]
    np.testing.assert_allclose(load, jet[:2], rtol=1e-10, atol=1e-10)
    # and Newton's law of the load gives its accelerations back
    fall = crane.gravity - tension * math.cos(q["theta"]) / crane.load_mass
    assert -tension * math.sin(q["theta"]) / crane.load_mass == pytest.approx(jet[2, 0], rel=1e-10, abs=1e-10)
    assert fall == pytest.approx(jet[2, 1], rel=1e-10, abs=1e-10)


def test_quantities_take_a_whole_plan_at_once():
    plan = cp.TrigSpline(
        [
            cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[10, 0, 0]),
            cp.Waypoint.from_jets(5, x=[4, 0, 0], z=[9, 0, 0]),
        ],
        alpha=1.0,
    )
    t = np.linspace(0, 5, 7)
    whole = Crane().quantities(plan.jet(t, 4))
    for i, moment in enumerate(t):
        single = Crane().quantities(plan.jet(moment, 4))
        np.testing.assert_allclose([whole[k][i] for k in single], list(single.values()), rtol=1e-12, atol=1e-9)


# Energy and equilibrium


@BOTH
def test_energy_is_that_of_load_trolley_and_drum(wrap):
    crane = Crane(**ODD, rope_wrap=wrap)
    states = np.array([[0.3, 8.0, 0.4, 1.0, -0.7, 0.9], [1.0, 3.0, -0.9, -2.0, 0.5, -0.3]])
    expected = [mechanical_energy(crane, state) for state in states]
    np.testing.assert_allclose(crane.energy(states.T), expected, rtol=1e-13)
    np.testing.assert_allclose(crane.energy(states[0]), expected[0], rtol=1e-13)


SWINGING = np.array([0.0, 6.0, 0.5, 0.6, -1.0, 0.4])


@pytest.mark.parametrize("friction", [0.0, 40.0])
@pytest.mark.parametrize(("force", "torque"), [(0.0, 0.0), (3e3, -1.4e3)])
@BOTH
def test_energy_changes_by_the_power_of_inputs_and_friction_alone(wrap, friction, force, torque):
    """With the rope winding; without, by T b theta' more: the paper's model injects it."""
    crane = Crane(trolley_friction=friction, drum_friction=friction, rope_wrap=wrap)
    block = crane.iosystem()

    def rate(t, y):
        state = y[:6]
        moved = block.dynamics(t, state, [force, torque])
        drum = state[4] / crane.drum_radius - (state[5] if wrap else 0.0)
        power = force * state[3] + torque * drum - friction * (state[3] ** 2 + drum**2)
        if not wrap:
            power += solved(crane, state, force, torque)[3] * crane.drum_radius * state[5]
        return np.append(moved, power)

    run = solve_ivp(rate, (0, 2), np.append(SWINGING, 0.0), method="DOP853", rtol=1e-12, atol=1e-12)
    assert run.success
    gained = np.array([mechanical_energy(crane, y[:6]) for y in run.y.T]) - mechanical_energy(crane, SWINGING)
    exchanged = np.abs(crane.load_mass * crane.gravity * np.ptp(run.y[1]))
    np.testing.assert_allclose(gained / exchanged, run.y[6] / exchanged, atol=1e-10)
    if wrap and not (friction or force):
        assert np.abs(gained).max() < 1e-10 * exchanged
    if not wrap:
        assert np.abs(run.y[6]).max() > 1e-3 * exchanged  # what is measured is there


@BOTH
@pytest.mark.parametrize(("x", "z"), [(0.0, 10.0), (-7.5, 0.3)])
def test_equilibrium_stays(wrap, x, z):
    crane = Crane(**ODD, rope_wrap=wrap)
    state, inputs = crane.equilibrium(x, z)
    block = crane.iosystem()
    np.testing.assert_allclose(block.dynamics(0.0, state, inputs), 0.0, atol=1e-14)
    out = dict(zip(block.output_labels, block.output(0.0, state, inputs), strict=True))
    assert (out["x"], out["z"]) == pytest.approx((x, z), abs=1e-14)
    assert out["T"] == pytest.approx(430.0 * 9.5, rel=1e-14)


# Linear models: D/F = 1/(s (M_c s + f1)), R/C = b/(s (J s + f2)), and coupled
# D/F = (R s^2 + g)/(s ((M_c s + f1)(R s^2 + g) + m g s))

FREQUENCIES = np.array([0.03, 0.4, 0.9, 1.3, 6.0, 70.0])


def response(system, source, sink):
    row, column = system.output_labels.index(sink), system.input_labels.index(source)
    return np.array([system(1j * w)[row, column] if system.nstates > 2 else system(1j * w) for w in FREQUENCIES])


def trolley_drive(crane, s):
    return 1 / (s * (crane.trolley_mass * s + crane.trolley_friction))


def hoist_drive(crane, s):
    return crane.drum_radius / (s * (crane.drum_inertia * s + crane.drum_friction))


def coupled(crane, r, s):
    g = crane.gravity
    pendulum = r * s**2 + g
    return pendulum / (s * ((crane.trolley_mass * s + crane.trolley_friction) * pendulum + crane.load_mass * g * s))


def test_drives_alone_have_the_transfer_functions():
    crane = Crane(**ODD)
    s = 1j * FREQUENCIES
    trolley, hoist = crane.linear_trolley(), crane.linear_hoist()
    assert (trolley.input_labels, trolley.output_labels) == (["F"], ["D"])
    assert (hoist.input_labels, hoist.output_labels) == (["C"], ["R"])
    np.testing.assert_allclose([trolley(w) for w in s], trolley_drive(crane, s), rtol=1e-12)
    np.testing.assert_allclose([hoist(w) for w in s], hoist_drive(crane, s), rtol=1e-12)


@BOTH
def test_drives_alone_are_the_crane_without_a_load(wrap):
    crane = Crane(**{**ODD, "load_mass": 1e-9}, rope_wrap=wrap)
    state, inputs = crane.equilibrium(0.0, 4.0)
    linear = ct.linearize(crane.iosystem(), state, inputs)
    s = 1j * FREQUENCIES
    found = np.array([linear(w) for w in s])
    labels = crane.iosystem().output_labels
    np.testing.assert_allclose(found[:, labels.index("D"), 0], trolley_drive(crane, s), rtol=1e-5)
    np.testing.assert_allclose(found[:, labels.index("R"), 1], hoist_drive(crane, s), rtol=1e-5)


@pytest.mark.parametrize("length", [4.0, 10.0])
@BOTH
def test_coupled_model_is_the_transfer_function_and_the_linearised_crane(wrap, length):
    crane = Crane(**ODD, rope_wrap=wrap)
    s = 1j * FREQUENCIES
    model = crane.linear_coupled(length)
    assert (model.input_labels, model.output_labels) == (["F"], ["D", "theta"])
    found = np.array([model(w) for w in s])
    expected = coupled(crane, length, s)
    sway = -(s**2) / (length * s**2 + crane.gravity) * expected
    np.testing.assert_allclose(found[:, 0, 0], expected, rtol=1e-10)
    np.testing.assert_allclose(found[:, 1, 0], sway, rtol=1e-10)
    linear = ct.linearize(crane.iosystem(), *crane.equilibrium(2.0, length))
    labels = crane.iosystem().output_labels
    whole = np.array([linear(w) for w in s])
    np.testing.assert_allclose(whole[:, labels.index("D"), 0], expected, rtol=1e-5)
    np.testing.assert_allclose(whole[:, labels.index("theta"), 0], sway, rtol=1e-5)


def characteristic(mass, friction, crane_mass, crane_friction, tf=0.02, w=5.0):
    """Poles of the PID for `mass` and `friction` on 1/(s (crane_mass s + crane_friction))."""
    kp, ki, kd = 3 * mass * w**2, mass * w**3, 3 * mass * w - friction
    s, lag = Polynomial([0, 1]), Polynomial([1, tf])
    return (s**2 * lag * (crane_mass * s + crane_friction) + (kp * s + ki) * lag + kd * s**2).roots()


def ordered(poles):
    return np.sort_complex(np.round(np.asarray(poles, dtype=complex), 9))


def test_trolley_loop_has_the_poles_of_the_study():
    loop = Crane().linear_trolley_loop()
    assert (loop.input_labels, loop.output_labels) == (["D_ref"], ["D"])
    poles = ordered(loop.poles())
    np.testing.assert_allclose(poles, ordered(characteristic(5e3, 20, 5e3, 20)), rtol=1e-6)
    # Two decimals; a triple pole at -5 moves there by the filter of the PID, and its fast pair is near -22.
    np.testing.assert_allclose(poles[2:], [-3.12 - 1.36j, -3.12 + 1.36j], atol=0.006)
    np.testing.assert_allclose(poles[:2].real, -22.0, atol=0.5)
    slow = Crane().linear_trolley_loop(bandwidth=2.0, tf=1e-6).poles()
    assert np.sort(np.abs(slow))[:3] == pytest.approx(2.0, rel=0.03)  # the triple pole, without the filter


def test_hoist_loop_is_its_pid_on_drum_and_load():
    """The study's poles: the PID is made for the inertia that it moves."""
    loop = Crane().linear_hoist_loop()
    assert (loop.input_labels, loop.output_labels) == (["R_ref"], ["R"])
    mass = 50 / 0.25 + 500 * 0.25
    expected = characteristic(mass, 20 / 0.25, mass, 20 / 0.25)
    np.testing.assert_allclose(ordered(loop.poles()), ordered(expected), rtol=1e-6)
    np.testing.assert_allclose(
        ordered(loop.poles()), ordered([-3.12 + 1.36j, -3.12 - 1.36j, -22 + 7.4j, -22 - 7.4j]), atol=0.05
    )


def test_drive_loops_have_unit_gain_at_rest():
    for loop in (Crane(**ODD).linear_trolley_loop(), Crane(**ODD).linear_hoist_loop()):
        assert complex(loop(1e-6j)) == pytest.approx(1.0, abs=1e-5)


# Plans the crane cannot follow


def segment(duration, first, last, at=0.0):
    """Rest-to-rest quintic."""
    points = [(at, first), (at + duration, last)]
    return cp.PolySpline([cp.Waypoint.from_jets(t, x=[x, 0, 0], z=[z, 0, 0]) for t, (x, z) in points])


def worst(plan, quantity):
    t = np.linspace(plan.start, plan.end, 200001)
    values = quantity(plan.jet(t, 2))
    return values.min(), t[values.argmin()]


def length_of(jet, g=9.81, b=0.25):
    return (jet[0, 1] * np.hypot(jet[2, 0], g - jet[2, 1]) - b * jet[2, 0]) / (g - jet[2, 1])


def numbers_in(error):
    """Value and time of a message that ends in '..., got VALUE unit at TIME s...'."""
    value, _, rest = str(error.value).partition(", got ")[2].partition(" at ")
    return float(value.split()[0]), float(rest.split()[0])


def test_a_plan_that_would_push_the_rope_is_rejected_with_value_and_time():
    plan = segment(1.5, (0, 5), (0, 10))
    with pytest.raises(ValueError, match=r"g - z'' must be above 0.*tension T <= 0") as error:
        Crane().check(plan)
    value, moment = worst(plan, lambda jet: 9.81 - jet[2, 1])
    assert numbers_in(error) == pytest.approx((value, moment), rel=1e-3)
    # from peak acceleration 5.7735 h/T^2
    assert value == pytest.approx(9.81 - 10 / math.sqrt(3) * 5 / 1.5**2, rel=1e-6)


def test_a_plan_that_would_wind_up_the_rope_is_rejected_with_value_and_time():
    plan = segment(6, (0, 5), (0, -1))
    with pytest.raises(ValueError, match="rope length R must be above 0") as error:
        Crane().check(plan)
    value, moment = worst(plan, length_of)
    assert numbers_in(error) == pytest.approx((value, moment), rel=1e-3)


def test_plans_next_to_the_limits_pass():
    Crane().check(segment(math.sqrt(10 / math.sqrt(3) * 5 / 9.8), (0, 5), (0, 10)))
    Crane().check(segment(6, (0, 5), (0, 0.01)))


@pytest.mark.parametrize("width", [1e-2, 1e-4])
def test_a_narrow_violation_between_samples_is_found(width):
    """One segment of many, far narrower than any sampling of the whole."""
    twitch = 15.0 * width**2 / (10 / math.sqrt(3))  # peak acceleration 15 m/s^2
    falling = segment(5, (0, 5), (1, 5)).then(segment(width, (1, 5), (1, 5 + twitch), 5)).then(
        segment(5, (1, 5 + twitch), (2, 5), 5 + width)
    )  # fmt: skip
    with pytest.raises(ValueError, match="tension T <= 0") as error:
        Crane().check(falling)
    value, moment = numbers_in(error)
    assert value == pytest.approx(9.81 - 15.0, abs=1e-3)
    assert moment == pytest.approx(5.0, abs=1.1 * width)
    # With z below b, the rope winds up where the load accelerates to the right hard enough.
    rushing = segment(5, (0, 0.2), (1, 0.2)).then(segment(width, (1, 0.2), (1 + twitch, 0.2), 5)).then(
        segment(5, (1 + twitch, 0.2), (2, 0.2), 5 + width)
    )  # fmt: skip
    with pytest.raises(ValueError, match="rope length R") as error:
        Crane().check(rushing)
    value, moment = numbers_in(error)
    assert value == pytest.approx((0.2 * math.hypot(15, 9.81) - 0.25 * 15) / 9.81, rel=1e-3)
    assert moment == pytest.approx(5.0, abs=1.1 * width)


def test_a_step_is_checked_by_its_positions():
    Crane().check(cp.Step([20, 11], [0, 10]))
    with pytest.raises(ValueError, match=r"R must be above 0, got -1 m at 2 s"):
        Crane().check(cp.Step([20, -1], [0, 10], 2.0))


def test_a_plan_of_one_axis_is_rejected():
    with pytest.raises(ValueError, match="axes x and z, got 1"):
        Crane().check(cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1)]))


# Bad input


@pytest.mark.parametrize("name", list(ODD))
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_parameters_must_be_finite_and_positive(name, value):
    with pytest.raises(ValueError, match=f"{name} must be finite and"):
        Crane(**{name: value})


@pytest.mark.parametrize("name", list(ODD))
def test_only_frictions_may_be_zero(name):
    if name.endswith("friction"):
        assert getattr(Crane(**{name: 0}), name) == 0
    else:
        with pytest.raises(ValueError, match=f"{name} must be finite and above 0, got 0"):
            Crane(**{name: 0})


@pytest.mark.parametrize("value", ["5", None, True, [5.0], 1j])
def test_parameters_must_be_numbers(value):
    with pytest.raises(TypeError, match="load_mass must be a number"):
        Crane(load_mass=value)


@pytest.mark.parametrize("z", [0.0, -3.0, math.nan])
def test_the_load_rests_below_the_trolley(z):
    with pytest.raises(ValueError, match="z must be finite and above 0"):
        Crane().equilibrium(0.0, z)


@pytest.mark.parametrize("length", [0.0, -3.0, math.nan])
def test_linear_model_needs_a_rope(length):
    with pytest.raises(ValueError, match="rope_length must be finite and above 0"):
        Crane().linear_coupled(length)


@pytest.mark.parametrize("bandwidth", [0.0, -5.0, math.nan, math.inf])
def test_pids_need_a_bandwidth(bandwidth):
    for pid in (Crane().trolley_pid, Crane().hoist_pid):
        with pytest.raises(ValueError, match="bandwidth must be finite and above 0"):
            pid(bandwidth)


def test_reverse_map_rejects_what_has_no_answer():
    with pytest.raises(ValueError, match="order at least 2"):
        Crane().quantities(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="jet must have shape"):
        Crane().quantities(np.zeros((5, 3)))
    with pytest.raises(ValueError, match=r"g - z'' must be above 0 for a taut rope, got -0\.19"):
        Crane().quantities([[0, 5], [0, 0], [0, 10]])
