"""The law (9)-(11): closed loops are chains of integrators, whatever the plant; other plants are rejected."""

import math

import control as ct
import control.flatsys as fs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial
from repetitions import examples
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan.systems.flat import create_flat_iosystem
from ctrlplan.systems.plants.dc_motor import dc_motor
from ctrlplan.systems.plants.flexible_joint import flexible_joint
from ctrlplan.systems.plants.integrator_chain import integrator_chain
from ctrlplan.systems.poles import hurwitz_coefficients

G = 9.81


def array(*values):
    return np.array(values)


# Plants of this file's own


def two_link_arm():
    """Fully actuated mechanics: both angles are flat outputs, coupled by the inertia."""

    def terms(q, w):
        inertia = array([3 + 2 * np.cos(q[1]), 1 + np.cos(q[1])], [1 + np.cos(q[1]), 1.0])
        swirl = np.sin(q[1]) * array(-2 * w[0] * w[1] - w[1] ** 2, w[0] ** 2)
        return inertia, swirl + G * array(np.sin(q[0]), np.sin(q[0] + q[1]))

    def accelerations(x, u):
        inertia, load = terms(x[:2], x[2:])
        return np.linalg.solve(inertia, u - load)

    def forward(x, u, params):
        return [array(x[i], x[2 + i], a) for i, a in enumerate(accelerations(x, u))]

    def reverse(flag, params):
        q, w, a = np.transpose(flag)
        inertia, load = terms(q, w)
        return np.concatenate([q, w]), inertia @ a + load

    names = ["q1", "q2", "w1", "w2"]
    return fs.FlatSystem(
        forward,
        reverse,
        lambda t, x, u, params: np.concatenate([x[2:], accelerations(x, u)]),
        lambda t, x, u, params: x,
        states=names,
        inputs=["tau1", "tau2"],
        outputs=names,
        name="arm",
    )


def levitation(at_rest=0.0):
    """Magnet, y downwards: y'' = g - c/m (i/y)^2, i the coil's current; singular at gap 0. State 0 is gap at_rest."""
    c = 2e-3

    def fall(x, u):
        return G - c * (u[0] / (at_rest + x[0])) ** 2

    def reverse(flag, params):
        y, rate, fallen = flag[0]
        return array(y, rate), array(np.sqrt((at_rest + y) ** 2 * (G - fallen) / c))

    return fs.FlatSystem(
        lambda x, u, params: [array(x[0], x[1], fall(x, u))],
        reverse,
        lambda t, x, u, params: array(x[1], fall(x, u)),
        lambda t, x, u, params: x,
        states=["gap", "gap_d1"],
        inputs=["i"],
        outputs=["gap", "gap_d1"],
        name="levitation",
    )


def pvtol(entries, eps=0.3):
    """Planar aircraft with the flat output of its equations, flags cut to so many entries (u taken for constant)."""

    def forward(x, u, params):
        s, c, w = np.sin(x[2]), np.cos(x[2]), x[5]
        pull, pull1, pull2 = u[0] - eps * w**2, -2 * eps * w * u[1], -2 * eps * u[1] ** 2
        across = array(
            x[0] - eps * s,
            x[3] - eps * c * w,
            -pull * s,
            -pull1 * s - pull * c * w,
            -pull2 * s - 2 * pull1 * c * w + pull * s * w**2 - pull * c * u[1],
        )
        up = array(
            x[1] + eps * c,
            x[4] - eps * s * w,
            pull * c - 1,
            pull1 * c - pull * s * w,
            pull2 * c - 2 * pull1 * s * w - pull * c * w**2 - pull * s * u[1],
        )
        return [across[:entries], up[:entries]]

    def reverse(flag, params):
        (y1, v1, a1, j1, s1), (y2, v2, a2, j2, s2) = flag
        th, size = np.arctan2(-a1, a2 + 1), np.hypot(a1, a2 + 1)
        w = (a1 * j2 - j1 * (a2 + 1)) / size**2
        turn = (a1 * s2 - s1 * (a2 + 1)) / size**2 - 2 * w * (a1 * j1 + (a2 + 1) * j2) / size**2
        s, c = np.sin(th), np.cos(th)
        x = array(y1 + eps * s, y2 - eps * c, th, v1 + eps * c * w, v2 + eps * s * w, w)
        return x, array(size + eps * w**2, turn)

    def update(t, x, u, params):
        s, c = np.sin(x[2]), np.cos(x[2])
        return array(x[3], x[4], x[5], -u[0] * s + eps * u[1] * c, u[0] * c + eps * u[1] * s - 1, u[1])

    return fs.FlatSystem(forward, reverse, update, states=6, inputs=["u1", "u2"], outputs=2)


def car(entries, wheelbase=2.0):
    """Kinematic car with the flat output of its rear axle, as python-control's own example has it."""

    def turning(u):
        return u[0] / wheelbase * np.tan(u[1])

    def forward(x, u, params):
        v, s, c = u[0], np.sin(x[2]), np.cos(x[2])
        return [array(x[0], v * c, -v * s * turning(u))[:entries], array(x[1], v * s, v * c * turning(u))[:entries]]

    def reverse(flag, params):
        (x, vx, ax), (y, vy, ay) = flag
        v = np.hypot(vx, vy)
        return array(x, y, np.arctan2(vy, vx)), array(v, np.arctan2(wheelbase * (vx * ay - vy * ax), v**3))

    return fs.FlatSystem(
        forward,
        reverse,
        lambda t, x, u, params: array(u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), turning(u)),
        states=["x", "y", "theta"],
        inputs=["v", "delta"],
        outputs=2,
    )


def cart_pendulum(flat_output, entries):
    """Not flat. A mass on a rod of 1 m on a cart, force by mass the input; position or angle as the output."""

    def accelerations(x, u):
        s, c = np.sin(x[1]), np.cos(x[1])
        push = (u[0] + s * (x[3] ** 2 - G * c)) / (1 + s**2)
        return push, G * s - push * c

    def forward(x, u, params):
        first = {"position": 0, "angle": 1}[flat_output]
        # The two derivatives that follow the acceleration are wrong on purpose: there are no right ones in (x, u).
        return [array(x[first], x[2 + first], accelerations(x, u)[first], x[1], x[3])[:entries]]

    return fs.FlatSystem(
        forward,
        lambda flag, params: (array(flag[0][0], 0.0, flag[0][1], 0.0), array(flag[0][2])),
        lambda t, x, u, params: array(x[2], x[3], *accelerations(x, u)),
        states=["position", "angle", "v", "w"],
        inputs=["F"],
        outputs=1,
    )


def ball_and_beam(approximate, entries=5, equations=True):
    """Not flat. The ball's position as the output; or that without the centrifugal term, a diffeomorphism."""
    b = 0.7143

    def forward(x, u, params):
        r, v, th, w = x
        s, c = np.sin(th), np.cos(th)
        if approximate:
            return [array(r, v, -b * G * s, -b * G * c * w, -b * G * (c * u[0] - s * w**2))]
        return [array(r, v, b * (r * w**2 - G * s), b * (v * w**2 + 2 * r * w * u[0] - G * c * w), u[0])[:entries]]

    def reverse(flag, params):
        z = flag[0]
        th = np.arcsin(-z[2] / (b * G))
        w = -z[3] / (b * G * np.cos(th))
        return array(z[0], z[1], th, w), array((-z[4] / (b * G) + np.sin(th) * w**2) / np.cos(th))

    def update(t, x, u, params):
        return array(x[1], b * (x[0] * x[3] ** 2 - G * np.sin(x[2])), x[3], u[0])

    return fs.FlatSystem(forward, reverse, update if equations else None, states=4, inputs=["u"], outputs=1)


# Closed loops


def smooth(order, naxes=1, labels=None):
    """Plan from 0 to 1 (2, 3, ... on further axes) with as many derivatives 0 at both ends."""
    ends = [[scale, *[0.0] * order] for scale in (0.0, 1.0)]
    points = [
        cp.Waypoint(t, *[entry * np.arange(1.0, naxes + 1) for entry in end])
        for t, end in zip((0.5, 2.5), ends, strict=True)
    ]
    return cp.TrigSpline(points, alpha=1.0, labels=labels)


def closed(plan, law, plant, order):
    source = cp.create_source_iosystem(plan, order, suffix="_ref")
    return ct.interconnect([source, law, plant], inputs=0, outputs=plant.output_labels)


def error_motion(poles, start, t):
    """Solution of the linear equation with these poles and this start (e, e', ...): (order, ntime)."""
    companion = np.diag(np.ones(len(poles) - 1), 1)
    companion[-1] = -polynomial.polyfromroots(poles).real[:-1]
    return np.array([expm(companion * s) @ start for s in t]).T


POLES = [-2.0, -3.0, -1.5 + 2.0j, -1.5 - 2.0j]
LOOPS = {
    "chain of 1": (integrator_chain(1), [POLES[:1]]),
    "chain of 2": (integrator_chain(2), [POLES[2:]]),
    "chain of 4": (integrator_chain(4), [POLES]),
    "two chains of 3": (integrator_chain(3, axes=2), [POLES[1:], [-2.0] * 3]),
    "motor": (dc_motor(), [POLES[1:]]),
    "joint": (flexible_joint(), [POLES]),
    "arm": (two_link_arm(), [POLES[2:], POLES[:2]]),
}


@pytest.mark.slow
@pytest.mark.parametrize("error", [0.0, 0.2], ids=["on the plan", "off the plan"])
@pytest.mark.parametrize(("plant", "poles"), LOOPS.values(), ids=list(LOOPS))
def test_closed_loops_are_chains_of_integrators(plant, poles, error):
    naxes, order = len(poles), len(poles[0])
    plan = smooth(order, naxes)
    loop = closed(plan, create_flat_iosystem(plant, poles, labels=plan.labels), plant, order)
    t = np.linspace(0.0, 4.0, 31)
    start = error * np.cos(np.arange(naxes * order)).reshape(naxes, order)
    flag = [np.append(plan.jet(0.0, order - 1)[:, i] + start[i], 0.0) for i in range(naxes)]
    found = cp.simulate(loop, t, initial_state=plant.reverse(flag, {})[0], method="python", rtol=1e-13, atol=1e-13)
    flags = [plant.forward(x, np.zeros(naxes), {}) for x in found.states.T]
    jets = plan.jet(t, order - 1)
    for i in range(naxes):
        got = np.array([rows[i][:order] for rows in flags]).T
        wrong = np.abs(got - jets[:, i] - error_motion(poles[i], start[i], t)).max(axis=1)
        assert (wrong < 1e-9 * np.abs(jets[:, i]).max(axis=1)).all()  # the peaks are 1 m to 11 m/s^3


def test_the_magnet_follows_its_gap_and_is_finite_where_it_is_singular():
    plant = levitation()
    law = create_flat_iosystem(plant, [-8.0, -9.0], labels="gap")
    assert law.output(0.0, np.zeros(0), np.zeros(law.ninputs)).tolist() == [0.0]
    plan = 0.01 * smooth(2, labels=["gap"]) + cp.Step(0.02, initial=0.02, labels=["gap"])
    t = np.linspace(0.0, 3.0, 31)
    found = cp.simulate(closed(plan, law, plant, 2), t, initial_state=[0.02, 0.0], rtol=1e-12, atol=1e-14)
    assert np.abs(found.states - plan.jet(t, 1)[:, 0]).max() < 1e-10
    assert found.states[0, -1] == pytest.approx(0.03)
    # About its rest it is regular in the zero state, once the input there is the law's and not 0.
    assert create_flat_iosystem(levitation(0.02), [-8.0, -9.0]).output(0.0, np.zeros(0), np.zeros(5))[0] > 0


def linear_plant():
    system = ct.ss(
        [[0.0, 1.0, 0.0], [-2.0, -0.5, 1.0], [0.3, 0.0, -4.0]],
        [[0.0], [0.4], [2.0]],
        [[3.0, 0.0, 0.5]],
        [[0.0]],
        states=["a", "b", "c"],
        inputs="F",
        outputs="y",
        name="linear",
    )
    # Its states are outputs, as the law requires.
    measured = ct.ss(system.A, system.B, np.eye(3), 0, states=3, inputs="F", outputs=["a", "b", "c"], name="measured")
    return system, measured


def test_a_linear_flat_system_of_python_control():
    system, measured = linear_plant()
    flat = fs.flatsys(system)
    law = create_flat_iosystem(flat, POLES[1:], labels="y")
    assert law.input_labels == ["y_ref", "y_ref_d1", "y_ref_d2", "y_ref_d3", "a", "b", "c"]
    plan = smooth(3)
    t = np.linspace(0.0, 4.0, 31)
    found = cp.simulate(closed(plan, law, measured, 3), t, rtol=1e-13, atol=1e-13)
    assert np.abs(flat.Cf @ found.states - plan(t)).max() < 1e-9


def test_without_references_it_places_the_poles():
    system, measured = linear_plant()
    for plant, flat in ((measured, fs.flatsys(system)), (ct.linearize(dc_motor(), np.zeros(3), 0), dc_motor())):
        law = create_flat_iosystem(flat, POLES[1:], labels="y")
        gain = ct.acker(plant.A, plant.B, POLES[1:])
        for x in np.eye(3):
            got = law.output(0.0, np.zeros(0), np.append(np.zeros(4), x))
            assert np.abs(got + gain @ x).max() < 1e-5 * np.abs(gain).max()  # the linearised motor has few digits


@pytest.mark.parametrize("angle", [0.0, 1.0, 2.5])
def test_the_linearised_joint_loop_has_the_poles_at_every_angle(angle):
    plant = flexible_joint()
    law = create_flat_iosystem(plant, POLES)
    loop = ct.interconnect([law, plant], inputs=law.input_labels[:5], outputs=["q1"])
    x, _ = plant.reverse([array(angle, 0, 0, 0, 0)])
    references = array(angle, 0, 0, 0, 0)
    model = ct.linearize(loop, x, references)
    expected = polynomial.polyfromroots(POLES).real
    assert np.abs(np.poly(model.A)[::-1] - expected).max() < 1e-3 * expected.max()
    for s in (0.3j, 2j):
        # From the references to y: the same polynomial in numerator and denominator, (s^4 + ...)/(s^4 + ...) in pieces.
        assert np.abs(model(s)[0] - expected / polynomial.polyval(s, expected)).max() < 1e-3


@pytest.mark.slow
def test_it_agrees_with_python_controls_own_simulation():
    plant = flexible_joint()
    plan = smooth(4)
    loop = closed(plan, create_flat_iosystem(plant, POLES, labels="y"), plant, 4)
    t = np.linspace(0.5, 2.5, 21)
    start = array(0.1, 0.1, 0.0, 0.0)
    peer = ct.input_output_response(loop, t, 0, start, solve_ivp_kwargs={"rtol": 1e-9, "atol": 1e-9})
    found = cp.simulate(loop, t, initial_state=start)
    assert np.abs(found.outputs - peer.outputs).max() < 1e-6


def test_along_a_plan_of_python_controls_own_it_outputs_the_inputs():
    plant = flexible_joint()
    law = create_flat_iosystem(plant, POLES)
    (x0, u0), (xf, uf) = (plant.reverse([array(y, 0, 0, 0, 0)]) for y in (0.0, 1.0))
    peer = fs.point_to_point(plant, [0.0, 2.0], x0, u0, xf, uf, basis=fs.PolyFamily(10, T=2.0))
    states, inputs = peer.eval(np.linspace(0.0, 2.0, 9))
    for x, u in zip(states.T, inputs.T, strict=True):
        (flag,) = plant.forward(x, u)
        assert np.abs(law.output(0.0, np.zeros(0), np.concatenate([flag, x])) - u).max() < 1e-9


@examples(50)
@given(st.lists(st.floats(-3, 3), min_size=4, max_size=4), st.lists(st.floats(-3, 3), min_size=5, max_size=5))
def test_the_last_derivative_is_what_the_law_commands(x, reference):
    # The definition, at any state and reference: y'''' = y_d'''' - sum sigma_k (y^(k) - y_d^(k)).
    plant = flexible_joint()
    law = LAW_OF_JOINT
    u = law.output(0.0, np.zeros(0), np.concatenate([reference, x]))
    (flag,) = plant.forward(np.array(x), u)
    sigma = polynomial.polyfromroots(POLES).real[:-1]
    requested = reference[4] - sigma @ (flag[:4] - reference[:4])
    assert abs(flag[4] - requested) < 1e-10 * (np.abs(sigma) @ np.abs(flag[:4]) + 100)


LAW_OF_JOINT = create_flat_iosystem(flexible_joint(), POLES)


# The block


def test_it_is_a_static_block_of_any_time_base():
    law = create_flat_iosystem(integrator_chain(2), [-1, -2])
    assert isinstance(law, ct.NonlinearIOSystem)
    assert (law.nstates, law.dt, law.name) == (0, None, "flat_law")
    assert create_flat_iosystem(integrator_chain(1), [-1], name="mine").name == "mine"


@pytest.mark.parametrize(("plant", "poles"), LOOPS.values(), ids=list(LOOPS))
def test_it_is_finite_at_zero_inputs(plant, poles):
    law = create_flat_iosystem(plant, poles)
    assert np.isfinite(law.output(0.0, np.zeros(0), np.zeros(law.ninputs))).all()
    assert law.output_labels == plant.input_labels


def test_names_of_its_inputs():
    def references(plant, poles, **options):
        law = create_flat_iosystem(plant, poles, **options)
        assert law.input_labels[-plant.nstates :] == plant.state_labels
        return law.input_labels[: -plant.nstates]

    chain, chains = integrator_chain(2), integrator_chain(1, axes=2)
    assert references(chain, [-1, -2]) == ["y_ref", "y_ref_d1", "y_ref_d2"]
    assert references(chain, [-1, -2], labels="x") == ["x_ref", "x_ref_d1", "x_ref_d2"]
    assert references(chains, [[-1], [-1]]) == ["y1_ref", "y1_ref_d1", "y2_ref", "y2_ref_d1"]
    assert references(chains, [[-1], [-1]], labels=["x", "z"]) == ["x_ref", "x_ref_d1", "z_ref", "z_ref_d1"]
    assert references(dc_motor(), [-1, -2, -3], labels=["angle"])[0] == "angle_ref"


@pytest.mark.parametrize(
    ("outputs", "gain", "label"),
    [("level", 1.0, "level"), ("level", 5.0, "y"), (1, 1.0, "y")],
    ids=["named and flat", "named but another quantity", "only numbered"],
)
def test_outputs_lend_their_names_where_they_are_the_flat_outputs(outputs, gain, label):
    plant = fs.FlatSystem(
        lambda x, u, params: [array(x[0], u[0])],
        lambda flag, params: (flag[0][:1], flag[0][1:]),
        lambda t, x, u, params: array(u[0]),
        lambda t, x, u, params: gain * x,
        states=["h"],
        inputs=1,
        outputs=outputs,
    )
    assert create_flat_iosystem(plant, [-1]).input_labels == [f"{label}_ref", f"{label}_ref_d1", "h"]


def test_poles_of_one_flat_output_may_be_nested():
    flat, nested = (create_flat_iosystem(integrator_chain(2), poles) for poles in ([-1, -2], np.array([[-1, -2]])))
    signals = array(1.0, 2.0, 3.0, 4.0, 5.0)
    assert flat.output(0, [], signals) == nested.output(0, [], signals)
    assert flat.output(0, [], signals) == 3.0 - 2.0 * (4.0 - 1.0) - 3.0 * (5.0 - 2.0)


def test_laws_side_by_side_share_nothing():
    blocks = []
    for axis, poles in (("x", [-1.0, -2.0]), ("z", [-3.0, -4.0])):
        renamed = {"y": axis, "y_d1": f"{axis}_d1", "u": f"u_{axis}"}
        chain = integrator_chain(2)
        chain.update_names(
            states=[renamed[s] for s in chain.state_labels],
            outputs=[renamed[s] for s in chain.output_labels],
            inputs=[f"u_{axis}"],
            name=f"chain_{axis}",
        )
        blocks += [chain, create_flat_iosystem(chain, poles, labels=axis, name=f"law_{axis}")]
    plan = smooth(2, 2, labels=["x", "z"])
    loop = ct.interconnect(
        [cp.create_source_iosystem(plan, 2, suffix="_ref"), *blocks], inputs=0, outputs=["x", "x_d1", "z", "z_d1"]
    )
    t = np.linspace(0.0, 4.0, 9)
    start = array(0.3, 0.0, 0.3, 0.0)
    found = cp.simulate(loop, t, initial_state=start, rtol=1e-12, atol=1e-12).outputs
    for i, poles in enumerate(([-1.0, -2.0], [-3.0, -4.0])):
        expected = plan.jet(t, 1)[:, i] + error_motion(poles, start[:2], t)
        assert np.abs(found[2 * i : 2 * i + 2] - expected).max() < 1e-9


def test_the_law_keeps_the_parameters_it_was_made_with():
    def forward(x, u, params):
        return [array(x[0], x[1], params["gain"] * u[0])]

    plant = fs.FlatSystem(
        forward,
        lambda flag, params: (flag[0][:2], flag[0][2:] / params["gain"]),
        lambda t, x, u, params: forward(x, u, params)[0][1:],
        lambda t, x, u, params: x,
        states=["x", "v"],
        inputs=["u"],
        outputs=["x", "v"],
        params={"gain": 2.0},
        name="plant",
    )
    plan = smooth(2)
    loop = closed(plan, create_flat_iosystem(plant, [-2, -3]), plant, 2)
    t = np.linspace(0.0, 3.0, 16)
    assert np.abs(cp.simulate(loop, t).outputs[0] - plan(t)).max() < 1e-6
    assert np.abs(cp.simulate(loop, t, params={"gain": 1.5}).outputs[0] - plan(t)).max() > 1e-2


@pytest.mark.parametrize("name", ["chain of 4", "two chains of 3", "motor", "joint"])
@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
def test_it_can_be_traced(name):
    casadi = pytest.importorskip("casadi")
    plant, poles = LOOPS[name]
    law = create_flat_iosystem(plant, poles)
    signals = casadi.SX.sym("w", law.ninputs)
    boxed = np.array([signals[i] for i in range(law.ninputs)], dtype=object)
    traced = casadi.Function("law", [signals], [casadi.vertcat(*law.outfcn(0.0, np.zeros(0), boxed, {}))])
    for values in np.random.default_rng(0).normal(size=(5, law.ninputs)):
        np.testing.assert_allclose(np.array(traced(values)).ravel(), law.output(0.0, np.zeros(0), values), rtol=1e-11)


# The gains


@settings()
@given(
    st.lists(st.floats(0.01, 10), max_size=4),
    st.lists(st.tuples(st.floats(0.01, 10), st.floats(0.01, 10)), max_size=3),
)
def test_coefficients_have_the_poles_as_roots(real, pairs):
    poles = [*(-p for p in real), *(complex(-a, b) for a, b in pairs), *(complex(-a, -b) for a, b in pairs)]
    sigma = hurwitz_coefficients(poles, len(poles))
    assert isinstance(sigma, tuple)
    assert all(value > 0.0 for value in sigma)
    for pole in poles:
        terms = np.array([*sigma, 1.0]) * pole ** np.arange(len(poles) + 1)
        assert abs(terms.sum()) < 1e-13 * np.abs(terms).sum()


def test_coefficients_in_closed_form():
    assert hurwitz_coefficients([-2], 1) == (2.0,)
    assert hurwitz_coefficients([-3 + 4j, -3 - 4j], 2) == (25.0, 6.0)
    assert hurwitz_coefficients([-1] * 4, 4) == (1.0, 4.0, 6.0, 4.0)


BAD_POLES = [
    ([-1, -2], ValueError, r"poles must be as many as the order of the flat output, 3, got \[-1, -2\]"),
    ([], ValueError, r"poles must be as many as the order of the flat output, 3, got \[\]"),
    ([[[-1], [-2], [-3]]], ValueError, "poles must be as many as"),
    ([-1, -2, 0], ValueError, r"poles must be finite with negative real parts, got \[-1, -2, 0\]"),
    ([-1, -2, 0.5], ValueError, "poles must be finite with negative real parts, got .*0.5"),
    ([-1, -2, np.nan], ValueError, "poles must be finite with negative real parts, got .*nan"),
    ([-1, -2, -np.inf], ValueError, "poles must be finite with negative real parts, got .*-inf"),
    ([-1, 1j, -1j], ValueError, "poles must be finite with negative real parts"),
    ([-1, -2 + 1j, -2 + 1j], ValueError, r"poles must be closed under conjugation, got \[.*\(-2\+1j\)"),
    ([-1, -2, -3 + 1e-3j], ValueError, "poles must be closed under conjugation"),
    (["-1", "-2", "-3"], TypeError, "poles must be numbers, got"),
    ([None, -2, -3], TypeError, "poles must be numbers, got"),
    (-1.0, TypeError, "poles must be one sequence for each flat output, got -1.0"),
]


@pytest.mark.parametrize(("poles", "error", "message"), BAD_POLES)
def test_poles_are_rejected(poles, error, message):
    with pytest.raises(error, match=f"^{message}"):
        create_flat_iosystem(dc_motor(), poles)


def test_poles_of_several_flat_outputs_are_rejected_with_their_place():
    chains = integrator_chain(2, axes=2)
    with pytest.raises(ValueError, match=r"^poles must be one sequence for each of 2 flat outputs, got 3$"):
        create_flat_iosystem(chains, [[-1, -2]] * 3)
    with pytest.raises(ValueError, match=r"^poles must be finite .* got \[-1, 2\] in poles\[1\]$"):
        create_flat_iosystem(chains, [[-1, -2], [-1, 2]])
    with pytest.raises(ValueError, match=r"^poles must be as many as .*, 2, got -1 in poles\[0\]$"):
        create_flat_iosystem(chains, [-1, -2])


# Plants that are not linearisable by static feedback


REJECTED = {
    "car": (car(3), r"got derivative 1 of flat output y1 \(the last is 2\), which depends on v$"),
    "car, flags cut": (
        car(2),
        "the decoupling matrix of last derivatives must have rank 2, got 1 at the state",
    ),
    "aircraft": (pvtol(5), r"got derivative 2 of flat output y1 \(the last is 4\), which depends on u1$"),
    "aircraft, flags cut": (pvtol(3), "the decoupling matrix of last derivatives must have rank 2, got 1 at the state"),
    "aircraft, flags cut shorter": (
        pvtol(2),
        "got derivative 1 of flat output y1, which does not .* flag is too short",
    ),
    "pendulum, angle": (cart_pendulum("angle", 3), "must add up to the number of states, 4, got 2 of y$"),
    "pendulum, position": (cart_pendulum("position", 3), "must add up to the number of states, 4, got 2 of y$"),
    "pendulum, more": (
        cart_pendulum("position", 5),
        r"got derivative 2 of flat output y \(the last is 4\), which depends on F$",
    ),
    "ball": (ball_and_beam(False), r"got derivative 3 of flat output y \(the last is 4\), which depends on u$"),
    "ball, flag cut": (ball_and_beam(False, 4), "must add up to the number of states, 4, got 3 of y$"),
    "ball, flag cut shorter": (ball_and_beam(False, 3), "got derivative 2 of flat output y, which does not"),
}


@pytest.mark.parametrize(("plant", "reason"), REJECTED.values(), ids=list(REJECTED))
def test_other_plants_are_rejected_with_the_reason(plant, reason):
    orders = [len(row) - 1 for row in plant.forward(np.ones(plant.nstates), np.ones(plant.ninputs), {})]
    with pytest.raises(ValueError, match=f"^flat must be linearisable by static feedback: .*{reason}"):
        create_flat_iosystem(plant, [[-1.0] * r for r in orders])


def test_the_aircraft_of_this_file_is_flat():
    # So that it is rejected for this reason and not for a mistake above.
    rng = np.random.default_rng(0)
    for _ in range(5):
        flag = list(rng.normal(size=(2, 5)))
        x, u = pvtol(5).reverse(flag, {})
        found = pvtol(5).forward(x, u, {})
        for got, row in zip(found, flag, strict=True):
            assert np.abs(got[:3] - row[:3]).max() < 1e-12


def double_integrator(forward=None, reverse=None, **options):
    given = {"states": ["x", "v"], "inputs": ["u"], "outputs": ["x"], **options}
    return fs.FlatSystem(
        forward or (lambda x, u, params: [array(x[0], x[1], u[0])]),
        reverse or (lambda flag, params: (flag[0][:2], flag[0][2:])),
        lambda t, x, u, params: array(x[1], u[0]),
        lambda t, x, u, params: x[:1],
        **given,
    )


def test_maps_that_do_not_belong_to_the_motion_are_rejected():
    # Invertible, but the flag is not made of derivatives: the approximate flat output of the ball and beam.
    with pytest.raises(ValueError, match=r"^forward must return derivatives along the motion .* derivative 2 of .* y "):
        create_flat_iosystem(ball_and_beam(approximate=True), [-1] * 4)
    # Without equations of motion only the maps can be checked.
    assert create_flat_iosystem(ball_and_beam(approximate=True, equations=False), [-1] * 4).ninputs == 9
    with pytest.raises(ValueError, match=r"^forward must return derivatives along the motion"):
        create_flat_iosystem(double_integrator(lambda x, u, params: [array(x[0], 2 * x[1], u[0])]), [-1, -2])


def test_a_reverse_that_does_not_undo_forward_is_rejected():
    for reverse in (
        lambda flag, params: (array(flag[0][0], 0.0), flag[0][2:]),
        lambda flag, params: (flag[0][:2], flag[0][2:] + 0.01 * flag[0][1]),
    ):
        with pytest.raises(
            ValueError, match=r"^reverse must be the inverse of forward, got .* flat output x for a flag with"
        ):
            create_flat_iosystem(double_integrator(reverse=reverse), [-1, -2])
    with pytest.raises(ValueError, match=r"^reverse must return 2 states and 1 inputs, got 1 and 1"):
        create_flat_iosystem(double_integrator(reverse=lambda flag, params: (flag[0][:1], flag[0][2:])), [-1, -2])
    with pytest.raises(ValueError, match=r"^reverse must be finite for some of the random flags, got .*nan"):
        create_flat_iosystem(
            double_integrator(reverse=lambda flag, params: (np.full(2, np.nan), flag[0][2:])), [-1, -2]
        )


@pytest.mark.parametrize(
    ("forward", "message"),
    [
        (lambda x, u, params: [array(x[0])], r"got lengths \[1\]"),
        (
            lambda x, u, params: [array(x[0], u[0]), array(x[1], u[0])],
            r"one flag per input, 1, .* got lengths \[2, 2\]",
        ),
        (lambda x, u, params: [np.zeros(3 + (x[0] > 0))], r"of constant length, got lengths \[4\]"),
        (lambda x, u, params: [array(x[0], x[1], np.nan)], "be finite in some of the random states, got .*nan"),
    ],
    ids=["too short", "too many", "of varying length", "not a number"],
)
def test_flags_are_rejected(forward, message):
    with pytest.raises(ValueError, match=f"^forward must .*{message}"):
        create_flat_iosystem(double_integrator(forward), [-1, -2])


def test_an_error_of_the_users_own_is_told():
    with pytest.raises(ValueError, match="shapes"):
        create_flat_iosystem(double_integrator(lambda x, u, params: [np.ones(2) + np.ones(3)]), [-1, -2])
    with pytest.raises(ValueError, match="shapes"):
        create_flat_iosystem(double_integrator(reverse=lambda flag, params: (np.ones(2) + np.ones(3), 0.0)), [-1, -2])
    with pytest.raises(KeyError, match="mass"):
        create_flat_iosystem(double_integrator(lambda x, u, params: [x / params["mass"]]), [-1, -2])


def test_maps_in_the_standard_librarys_functions_will_do():
    def forward(x, u, params):
        return [array(math.log(x[0]), x[1] / x[0], u[0] / x[0] - (x[1] / x[0]) ** 2)]

    def reverse(flag, params):
        y, rate, second = flag[0]
        x = math.exp(y)
        return array(x, rate * x), array((second + rate**2) * x)

    plant = double_integrator(forward, reverse)
    law = create_flat_iosystem(plant, [-2, -3])
    assert law.output(0.0, np.zeros(0), np.zeros(5)).tolist() == [0.0]
    y, rate, second = 0.3, -0.2, 0.5
    x, u = reverse([array(y, rate, second)], {})
    assert law.output(0.0, np.zeros(0), array(y, rate, second, *x)) == pytest.approx(u)


def test_a_plant_of_limited_domain_will_do():
    """A tank behind a valve: h' = sqrt(u) - sqrt(h), for h and u from 0."""
    tank = fs.FlatSystem(
        lambda x, u, params: [array(x[0], np.sqrt(u[0]) - np.sqrt(x[0]))],
        lambda flag, params: (flag[0][:1], (flag[0][1:] + np.sqrt(flag[0][:1])) ** 2),
        lambda t, x, u, params: array(np.sqrt(u[0]) - np.sqrt(x[0])),
        lambda t, x, u, params: x,
        states=["h"],
        inputs=["u"],
        outputs=["h"],
        name="tank",
    )
    law = create_flat_iosystem(tank, [-1.0])
    plan = smooth(1, labels=["h"]) + cp.Step(1.0, initial=1.0, labels=["h"])
    t = np.linspace(0.0, 3.0, 16)
    found = cp.simulate(closed(plan, law, tank, 1), t, initial_state=1.0, rtol=1e-12, atol=1e-12)
    assert np.abs(found.outputs - plan(t)).max() < 1e-10


def test_kinds_are_rejected():
    with pytest.raises(TypeError, match=r"^flat must be a control.flatsys.FlatSystem, got StateSpace"):
        create_flat_iosystem(ct.rss(2, 1, 1), [-1, -2])
    with pytest.raises(ValueError, match=r"^flat must be in continuous time, got dt = 0.1"):
        create_flat_iosystem(double_integrator(dt=0.1), [-1, -2])
    bare = fs.flatsys(lambda x, u, params: [x], lambda flag, params: (flag[0], flag[0]))
    with pytest.raises(ValueError, match=r"^flat must have states and inputs, got 0 and 0"):
        create_flat_iosystem(bare, [-1, -2])


def test_labels_are_rejected():
    chain, chains = integrator_chain(2), integrator_chain(2, axes=2)
    with pytest.raises(ValueError, match=r"^labels must be one per axis, 2, got 1"):
        create_flat_iosystem(chains, [[-1, -2]] * 2, labels=["x"])
    with pytest.raises(ValueError, match=r"^labels must be unique"):
        create_flat_iosystem(chains, [[-1, -2]] * 2, labels=["x", "x"])
    with pytest.raises(TypeError, match=r"^labels must be strings"):
        create_flat_iosystem(chain, [-1, -2], labels=[1])
    taken = double_integrator(states=["x", "x_ref_d1"])
    with pytest.raises(
        ValueError, match=r"^labels and suffix must not give references the names of states, got x_ref_d1"
    ):
        create_flat_iosystem(taken, [-1, -2])


@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
def test_a_law_that_is_singular_at_zero_inputs_can_be_traced():
    casadi = pytest.importorskip("casadi")
    law = create_flat_iosystem(levitation(), [-8.0, -9.0], labels="gap")
    signals = casadi.SX.sym("w", law.ninputs)
    boxed = np.array([signals[i] for i in range(law.ninputs)], dtype=object)
    traced = casadi.Function("law", [signals], [casadi.vertcat(*law.outfcn(0.0, np.zeros(0), boxed, {}))])
    for values in (
        [0.02, 0.0, 0.0, 0.021, 0.01],
        [0.02, 0.0, 0.3, 0.019, -0.2],
        [0.03, 0.1, 0.0, 0.03, 0.0],
        [0.0] * 5,
    ):
        np.testing.assert_allclose(np.array(traced(values)).ravel(), law.output(0.0, np.zeros(0), np.array(values)))
    assert float(traced([0.0] * 5)) == 0.0


def test_the_loop_of_such_a_law_is_compiled():
    pytest.importorskip("casadi")
    plant = levitation()
    law = create_flat_iosystem(plant, [-8.0, -9.0], labels="gap")
    plan = 0.01 * smooth(2, labels=["gap"]) + cp.Step(0.02, initial=0.02, labels=["gap"])
    t = np.linspace(0.0, 3.0, 31)
    loop = closed(plan, law, plant, 2)
    found = cp.simulate(loop, t, initial_state=[0.02, 0.0], method="compiled", rtol=1e-11, atol=1e-13)
    assert np.abs(found.states - plan.jet(t, 1)[:, 0]).max() < 1e-9
