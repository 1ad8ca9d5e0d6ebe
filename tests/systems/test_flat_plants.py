"""Plants with flat outputs: equations from first principles, maps exact in symbols, linear models, bad parameters."""

from itertools import pairwise

import control as ct
import control.flatsys as fs
import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan.systems.plants.dc_motor import dc_motor
from ctrlplan.systems.plants.flexible_joint import flexible_joint
from ctrlplan.systems.plants.integrator_chain import integrator_chain

MOTOR = {"resistance": 2.0, "inductance": 0.1, "motor_constant": 0.3, "inertia": 0.02, "friction": 0.05}
JOINT = {
    "link_inertia": 0.5,
    "motor_inertia": 0.2,
    "stiffness": 8.0,
    "mass": 1.5,
    "length": 0.4,
    "gravity": 9.81,
}
PLANTS = {
    "chain of 1": integrator_chain(1),
    "chain of 4": integrator_chain(4),
    "three chains of 2": integrator_chain(2, axes=3),
    "motor": dc_motor(),
    "another motor": dc_motor(**MOTOR),
    "joint": flexible_joint(),
    "another joint": flexible_joint(**JOINT),
    "joint without gravity": flexible_joint(**JOINT | {"gravity": 0}),
}
each_plant = pytest.mark.parametrize("plant", PLANTS.values(), ids=list(PLANTS))


class Symbol(sp.Symbol):
    """Symbol that numpy's sine and cosine take."""

    def sin(self):
        return sp.sin(self)

    def cos(self):
        return sp.cos(self)


def symbols(names):
    return np.array([Symbol(name, real=True) for name in names.split()])


def exact(factory, parameters):
    """Plant whose parameters are fractions, and those fractions."""
    fractions = {name: sp.Rational(str(value)) for name, value in parameters.items()}
    return factory(**fractions), fractions


SYMBOLIC = {
    "chain": (integrator_chain(3), symbols("y y1 y2"), symbols("u")),
    "two chains": (integrator_chain(2, 2), symbols("y y1 z z1"), symbols("u w")),
    "motor": (exact(dc_motor, MOTOR)[0], symbols("angle speed current"), symbols("V")),
    "joint": (exact(flexible_joint, JOINT)[0], symbols("q1 q2 w1 w2"), symbols("u")),
}
each_symbolic = pytest.mark.parametrize(("plant", "x", "u"), SYMBOLIC.values(), ids=list(SYMBOLIC))


def along(expression, x, rates):
    return sum(sp.diff(expression, s) * rate for s, rate in zip(x, rates, strict=True))


def orders(plant):
    return [len(row) - 1 for row in plant.forward(np.ones(plant.nstates), np.ones(plant.ninputs))]


# The equations


def test_the_chain_is_one():
    found = integrator_chain(3, 2).dynamics(0.0, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [7.0, 8.0])
    assert found.tolist() == [2, 3, 7, 5, 6, 8]


def test_the_motor_obeys_newton_kirchhoff_and_the_balance_of_power():
    plant, p = exact(dc_motor, MOTOR)
    x, (voltage,) = symbols("angle speed current"), symbols("V")
    _, speed, current = x
    rates = plant.updfcn(0.0, x, [voltage], {})
    assert rates[0] == speed
    assert sp.expand(p["inertia"] * rates[1] + p["friction"] * speed - p["motor_constant"] * current) == 0
    drop = p["inductance"] * rates[2] + p["resistance"] * current + p["motor_constant"] * speed
    assert sp.expand(drop - voltage) == 0
    # The supplied energy is stored or dissipated in resistance and friction: the conversion to torque is lossless.
    stored = (p["inertia"] * speed**2 + p["inductance"] * current**2) / 2
    dissipated = p["resistance"] * current**2 + p["friction"] * speed**2
    assert sp.expand(along(stored, x, rates) - voltage * current + dissipated) == 0


def test_the_joint_obeys_lagrange():
    plant, p = exact(flexible_joint, JOINT)
    x, (torque,) = symbols("q1 q2 w1 w2"), symbols("u")
    q, w = x[:2], x[2:]
    rates = plant.updfcn(0.0, x, [torque], {})
    kinetic = (p["link_inertia"] * w[0] ** 2 + p["motor_inertia"] * w[1] ** 2) / 2
    height = -p["length"] * sp.cos(q[0])  # of the link's centre of mass
    potential = p["mass"] * p["gravity"] * height + p["stiffness"] * (q[1] - q[0]) ** 2 / 2
    lagrangian = kinetic - potential
    assert rates[:2].tolist() == w.tolist()
    for i, force in enumerate((0, torque)):
        momentum = sp.diff(lagrangian, w[i])
        assert sp.expand(along(momentum, x, rates) - sp.diff(lagrangian, q[i]) - force) == 0


def test_textbook_values_are_the_defaults():
    # k/(s ((J s + b)(L s + R) + K^2)) at the textbook's K = 0.01, J = 0.01, b = 0.1, L = 0.5, R = 1.
    model = dc_motor().linearize(np.zeros(3), np.zeros(1))
    for s in (0.3j, 2.0 + 1.0j, -0.7):
        assert abs(model(s)[0, 0] - 0.01 / (s * ((0.01 * s + 0.1) * (0.5 * s + 1.0) + 0.01**2))) < 1e-12


# The flat maps


@each_symbolic
def test_a_flag_is_made_of_derivatives_along_the_motion(plant, x, u):
    rates = plant.updfcn(0.0, x, u, {})
    for row in plant.forward(x, u):
        for value, derivative in pairwise(row):
            assert not any(value.has(s) for s in u)
            assert sp.simplify(along(value, x, rates) - derivative) == 0


@each_symbolic
def test_reverse_of_forward_in_symbols(plant, x, u):
    found_x, found_u = plant.reverse(plant.forward(x, u))
    for got, expected in zip([*found_x, *found_u], [*x, *u], strict=True):
        assert sp.simplify(got - expected) == 0


def test_the_motor_as_a_polynomial_in_the_derivative():
    flag = symbols("z0 z1 z2 z3")
    plant, p = exact(dc_motor, MOTOR)
    (voltage,) = plant.reverse([flag])[1]
    s = sp.Symbol("s")
    K, J, b, L, R = (p[name] for name in ("motor_constant", "inertia", "friction", "inductance", "resistance"))
    operator = sp.Poly(s * ((J * s + b) * (L * s + R) + K**2) / K, s).all_coeffs()[::-1]
    assert sp.expand(voltage - sum(c * z for c, z in zip(operator, flag, strict=True))) == 0


@each_plant
@examples(40)
@given(data=st.data())
def test_forward_after_reverse_is_the_identity(plant, data):
    entries = st.floats(-10, 10)
    flag = [np.array(data.draw(st.lists(entries, min_size=r + 1, max_size=r + 1))) for r in orders(plant)]
    x, u = plant.reverse(flag)
    assert (x.shape, u.shape) == ((plant.nstates,), (plant.ninputs,))
    for got, given_row in zip(plant.forward(x, u), flag, strict=True):
        # The spring's pull is a difference of two angles that agree in many digits.
        assert np.abs(got - given_row).max() < 1e-9


@each_plant
@examples(40)
@given(data=st.data())
def test_reverse_after_forward_is_the_identity(plant, data):
    x, u = (
        np.array(data.draw(st.lists(st.floats(-10, 10), min_size=n, max_size=n)))
        for n in (plant.nstates, plant.ninputs)
    )
    found_x, found_u = plant.reverse(plant.forward(x, u))
    assert np.abs(found_x - x).max() < 1e-10
    assert np.abs(found_u - u).max() < 1e-9 * (1 + np.abs(plant.forward(x, u)[0]).max())


@pytest.mark.parametrize("name", ["chain of 4", "motor", "joint"])
def test_python_controls_own_planner_takes_them(name):
    plant = PLANTS[name]
    (r,) = orders(plant)
    start, end = [0.0] * (r + 1), [1.0] + [0.0] * r
    (x0, u0), (xf, uf) = (plant.reverse([np.array(jet)]) for jet in (start, end))
    peer = fs.point_to_point(plant, [0.0, 2.0], x0, u0, xf, uf, basis=fs.PolyFamily(2 * r + 2, T=2.0))
    plan = cp.PolySpline([cp.Waypoint(0.0, *start), cp.Waypoint(2.0, *end)])
    t = np.linspace(0.0, 2.0, 21)
    states, inputs = peer.eval(t)
    jets = plan.jet(t, r)[:, 0]
    own = [plant.reverse([jets[:, i]]) for i in range(t.size)]
    assert np.abs(np.array([x for x, _ in own]).T - states).max() < 1e-6 * np.abs(states).max()
    assert np.abs(np.array([u for _, u in own]).T - inputs).max() < 1e-6 * np.abs(inputs).max()


# Linear models


def test_the_joint_linearised_about_any_angle():
    plant = flexible_joint(**JOINT)
    I, J, k, m, length, g = JOINT.values()  # noqa: E741
    for angle in (0.0, 0.4, np.pi / 2, np.pi):
        x, u = plant.reverse([np.array([angle, 0, 0, 0, 0])])
        assert np.abs(plant.dynamics(0.0, x, u)).max() < 1e-13
        model = ct.linearize(plant, x, u)
        falling = m * g * length * np.cos(angle)
        a = [[0, 0, 1, 0], [0, 0, 0, 1], [-(k + falling) / I, k / I, 0, 0], [k / J, -k / J, 0, 0]]
        np.testing.assert_allclose(model.A, a, atol=1e-5)
        np.testing.assert_allclose(model.B, [[0], [0], [0], [1 / J]], atol=1e-5)
        np.testing.assert_allclose(model.C, np.eye(4), atol=1e-8)


def test_the_motor_is_linear():
    R, L, K, J, b = MOTOR.values()
    model = ct.linearize(dc_motor(**MOTOR), [3.0, 2.0, -1.0], [4.0])
    np.testing.assert_allclose(model.A, [[0, 1, 0], [0, -b / J, K / J], [0, -K / L, -R / L]], atol=1e-6)
    np.testing.assert_allclose(model.B, [[0], [0], [1 / L]], atol=1e-6)


@pytest.mark.parametrize("order", [1, 2, 5])
def test_the_chain_is_a_brunovsky_form(order):
    model = ct.linearize(integrator_chain(order), np.zeros(order), [0.0])
    np.testing.assert_allclose(model.A, np.diag(np.ones(order - 1), 1), atol=1e-9)
    np.testing.assert_allclose(model.B[:, 0], np.eye(order)[-1], atol=1e-9)


# Blocks of a loop


def test_names():
    assert integrator_chain(3).state_labels == ["y", "y_d1", "y_d2"]
    assert integrator_chain(3).input_labels == ["u"]
    assert integrator_chain(1, 2).state_labels == ["y1", "y2"]
    assert integrator_chain(2, axes=2).state_labels == ["y1", "y1_d1", "y2", "y2_d1"]
    assert integrator_chain(2, axes=2).input_labels == ["u1", "u2"]
    assert dc_motor().state_labels == ["angle", "speed", "current"]
    assert dc_motor().input_labels == ["voltage"]
    assert flexible_joint().state_labels == ["q1", "q2", "q1_d1", "q2_d1"]
    assert flexible_joint().input_labels == ["u"]
    assert [plant.name for plant in (integrator_chain(1), dc_motor(), flexible_joint())] == [
        "integrator_chain",
        "dc_motor",
        "flexible_joint",
    ]
    for factory in (lambda name: integrator_chain(2, name=name), lambda name: dc_motor(name=name)):
        assert factory("mine").name == "mine"
    assert flexible_joint(name="mine").name == "mine"


@each_plant
def test_outputs_are_the_states(plant):
    assert isinstance(plant, fs.FlatSystem)
    assert plant.dt == 0
    assert plant.output_labels == plant.state_labels
    x = np.arange(1.0, plant.nstates + 1)
    assert plant.output(0.0, x, np.ones(plant.ninputs)).tolist() == x.tolist()
    assert np.isfinite(plant.dynamics(0.0, np.zeros(plant.nstates), np.zeros(plant.ninputs))).all()


@each_plant
@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
def test_equations_and_maps_can_be_traced(plant):
    casadi = pytest.importorskip("casadi")
    x, u = casadi.SX.sym("x", plant.nstates), casadi.SX.sym("u", plant.ninputs)
    flags = [casadi.SX.sym(f"z{i}", r + 1) for i, r in enumerate(orders(plant))]

    def boxed(vector):
        return np.array([vector[i] for i in range(vector.shape[0])], dtype=object)

    rates = plant.updfcn(0.0, boxed(x), boxed(u), {})
    forward = np.concatenate(plant.forward(boxed(x), boxed(u)))
    reverse = np.concatenate(plant.reverse([boxed(flag) for flag in flags]))
    traced = casadi.Function("traced", [x, u, *flags], [casadi.vertcat(*part) for part in (rates, forward, reverse)])
    rng = np.random.default_rng(1)
    for _ in range(5):
        numbers = [rng.normal(size=s.shape[0]) for s in (x, u, *flags)]
        got = [np.array(part).ravel() for part in traced(*numbers)]
        np.testing.assert_allclose(got[0], plant.dynamics(0.0, *numbers[:2]), rtol=1e-13)
        np.testing.assert_allclose(got[1], np.concatenate(plant.forward(*numbers[:2])), rtol=1e-12)
        np.testing.assert_allclose(got[2], np.concatenate(plant.reverse(numbers[2:])), rtol=1e-13)


# Bad input


@pytest.mark.parametrize(("factory", "good"), [(dc_motor, MOTOR), (flexible_joint, JOINT)])
@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan, np.inf])
def test_parameters_are_rejected_by_name(factory, good, value):
    for name in good:
        may_be_zero = name in ("friction", "gravity")
        if value == 0.0 and may_be_zero:
            assert factory(**good | {name: value}).nstates
            continue
        minimum = "at least 0" if may_be_zero else "above 0"
        with pytest.raises(ValueError, match=f"^{name} must be finite and {minimum}, got {value}$"):
            factory(**good | {name: value})


@pytest.mark.parametrize("value", [0, -1, 1.5, np.nan])
def test_counts_are_rejected_by_name(value):
    with pytest.raises(ValueError, match=r"^order must be an integer of at least 1, got"):
        integrator_chain(value)
    with pytest.raises(ValueError, match=r"^axes must be an integer of at least 1, got"):
        integrator_chain(2, value)
    with pytest.raises(TypeError, match=r"^order must be an integer of at least 1, got 'two'"):
        integrator_chain("two")
