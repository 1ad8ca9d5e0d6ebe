"""Plants of the catalogue: equations from first principles, closed-form maps against derived ones, one interface."""

import copy
import pickle
import subprocess
import sys
from dataclasses import dataclass

import control as ct
import control.flatsys as fs
import numpy as np
import pytest
import sympy as sp
from strict import WARNINGS

import ctrlplan as cp
from ctrlplan.systems.plants.parameters import values_of
from ctrlplan.systems.plants.plant import StateSpacePlant


def moved(label, order, *, first, last, duration):
    """Move of one flat output from rest to rest."""
    rest = [0.0] * order
    ends = [cp.Waypoint(0.0, first, *rest[:4]), cp.Waypoint(duration, last, *rest[:4])]
    return cp.PolySpline(ends, labels=label)


def planar(labels, order):
    rest = [0.0] * order
    (a, b), (c, d) = ((0.0, 10.0), (4.0, 11.0))
    points = [(0.0, a, b), (6.0, c, d)]
    return cp.PolySpline(
        [cp.Waypoint.from_jets(t, **{labels[0]: [p, *rest], labels[1]: [q, *rest]}) for t, p, q in points]
    )


def circles(turns, centre=(0.0, 0.0), per_turn=8):
    """Circles of 20 m at 10 m/s, to the left, through waypoints with exact derivatives up to the third."""
    rate, points = 0.5, []
    for angle in np.linspace(0.0, 2.0 * np.pi * turns, int(per_turn * turns) + 1):
        jets = [
            20.0 * rate**k * np.array([np.sin(angle + k * np.pi / 2), -np.cos(angle + k * np.pi / 2)]) for k in range(4)
        ]
        x, y = np.array(jets).T
        points.append(cp.Waypoint.from_jets(angle / rate, x=x, y=y))
    return cp.PiecewiseSpline(points)


LANE = cp.PolySpline(
    [
        cp.Waypoint.from_jets(0.0, x=[0, 20, 0, 0], y=[0, 0, 0, 0]),
        cp.Waypoint.from_jets(3, x=[60, 20, 0, 0], y=[3.5, 0, 0, 0]),
    ]
)


@dataclass(frozen=True)
class Case:
    """A plant, a plan of its flat outputs, poles, and the orders and extension that the literature states."""

    plant: cp.plants.Plant
    plan: cp.Trajectory
    poles: list
    orders: tuple
    extension: int = 0


FOUR, THREE = [-2.0, -2.5, -3.0, -3.5], [-2.0, -2.5, -3.0]
CASES = {
    "motor": Case(cp.plants.DCMotor(), moved("angle", 3, first=0.0, last=2.0, duration=1.0), [-20, -25, -30], (3,)),
    "joint": Case(
        cp.plants.FlexibleJoint(), moved("q1", 4, first=0.0, last=1.0, duration=1.0), [-9, -10, -11, -12], (4,)
    ),
    "car": Case(cp.plants.KinematicCar(), LANE, [[-2.0, -3.0]] * 2, (2, 2), 1),
    "car, steering rate": Case(cp.plants.KinematicCar(steering="rate"), LANE, [THREE] * 2, (3, 3), 2),
    "quadrotor": Case(cp.plants.PlanarQuadrotor(), planar("xz", 4), [FOUR] * 2, (4, 4), 2),
    "levitation": Case(
        cp.plants.MagneticLevitation(), moved("gap", 3, first=0.01, last=0.006, duration=0.4), [-60, -70, -80], (3,)
    ),
    "drive": Case(
        cp.plants.TwoMassDrive(), moved("load_angle", 4, first=0.0, last=3.0, duration=0.3), [-60, -70, -80, -90], (4,)
    ),
    "drive, damped": Case(
        cp.plants.TwoMassDrive(damping=0.05),
        moved("y", 4, first=0.0, last=3.0, duration=0.3),
        [-60, -70, -80, -90],
        (4,),
    ),
    "crane": Case(cp.plants.Crane(), planar("xz", 4), [FOUR] * 2, (4, 4), 2),
}
every = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))


def everyday(*names):
    """All cases, of which those named are everyday; the others take long, or differ in nothing that is new."""
    marks = {True: (), False: pytest.mark.slow}
    cases = [pytest.param(case, marks=marks[name in names], id=name) for name, case in CASES.items()]
    return pytest.mark.parametrize("case", cases)


def apart(found, known, scale=1.0):
    """Largest difference of signals (n, ntime), relative to the range of each, or its scale where it is constant."""
    size = np.maximum(np.ptp(known, axis=1), np.where(np.ptp(known, axis=1) < 1e-6 * scale, scale, 0.0))
    return float((np.abs(found - known).max(axis=1) / size).max())


def test_every_plant_is_a_case():
    exported = [getattr(cp.plants, name) for name in cp.plants.__all__]
    kinds = {kind for kind in exported if isinstance(kind, type) and issubclass(kind, cp.plants.Plant)}
    assert kinds - {cp.plants.Plant} == {type(case.plant) for case in CASES.values()}


# The equations


class Symbol(sp.Symbol):
    """Symbol that numpy's functions take."""

    def sin(self):
        return sp.sin(self)

    def cos(self):
        return sp.cos(self)

    def tan(self):
        return sp.tan(self)


def symbolic(kind, **parameters):
    """Plant with its parameters as fractions, symbols of states and inputs, and the rates."""
    fractions = {name: sp.Rational(str(value)) for name, value in parameters.items()}
    plant = kind(**fractions)
    x, u = ([Symbol(name, real=True) for name in names] for names in (plant.signals.states, plant.signals.inputs))
    rates = plant.iosystem().updfcn(0.0, x, u, {})
    return fractions, x, u, [sp.nsimplify(rate, rational=True) for rate in rates]


def along(expression, x, rates):
    return sum(sp.diff(expression, s) * rate for s, rate in zip(x, rates, strict=True))


@pytest.mark.slow
def test_neither_axle_of_the_car_slips():
    p, x, (v, delta), rates = symbolic(cp.plants.KinematicCar, wheelbase=2.5)
    px, py, theta = x
    front = [px + p["wheelbase"] * sp.cos(theta), py + p["wheelbase"] * sp.sin(theta)]
    for axle, angle in ((x[:2], theta), (front, theta + delta)):
        vx, vy = (along(entry, x, rates) for entry in axle)
        assert sp.simplify(-vx * sp.sin(angle) + vy * sp.cos(angle)) == 0
    assert sp.simplify(rates[0] * sp.cos(theta) + rates[1] * sp.sin(theta)) == v


def test_the_quadrotor_obeys_newton_and_euler():
    p, x, (left, right), rates = symbolic(cp.plants.PlanarQuadrotor, mass=1.5, inertia=0.02, arm=0.3, gravity=9.81)
    theta = x[2]
    up, out = sp.Matrix([-sp.sin(theta), sp.cos(theta)]), sp.Matrix([sp.cos(theta), sp.sin(theta)])
    force = (left + right) * up - sp.Matrix([0, p["mass"] * p["gravity"]])
    assert sp.simplify(p["mass"] * sp.Matrix(rates[3:5]) - force) == sp.zeros(2, 1)
    arms = [(-p["arm"] * out, left * up), (p["arm"] * out, right * up)]
    moment = sum(r[0] * f[1] - r[1] * f[0] for r, f in arms)
    assert sp.simplify(p["inertia"] * rates[5] - moment) == 0
    assert rates[:3] == x[3:]


def test_the_power_of_the_coil_is_stored_or_dissipated():
    """Coil, ball and weight: the force is that of the inductance."""
    p, x, (voltage,), rates = symbolic(
        cp.plants.MagneticLevitation, mass=0.07, force_constant=7e-5, resistance=11, inductance=0.4, gravity=9.81
    )
    gap, speed, current = x
    assert rates[0] == speed
    coil = p["inductance"] + 2 * p["force_constant"] / gap
    stored = p["mass"] * speed**2 / 2 - p["mass"] * p["gravity"] * gap + coil * current**2 / 2
    assert sp.simplify(along(stored, x, rates) - voltage * current + p["resistance"] * current**2) == 0
    assert sp.simplify(p["mass"] * (rates[1] - p["gravity"]) + p["force_constant"] * (current / gap) ** 2) == 0


def test_the_power_of_the_drive_is_stored_or_dissipated():
    p, x, (torque,), rates = symbolic(
        cp.plants.TwoMassDrive, motor_inertia=0.001, load_inertia=0.002, stiffness=50, damping=0.05
    )
    motor, motor_speed, load, load_speed = x
    assert (rates[0], rates[2]) == (motor_speed, load_speed)
    stored = (
        p["motor_inertia"] * motor_speed**2 + p["load_inertia"] * load_speed**2 + p["stiffness"] * (motor - load) ** 2
    ) / 2
    dissipated = p["damping"] * (motor_speed - load_speed) ** 2
    assert sp.expand(along(stored, x, rates) - torque * motor_speed + dissipated) == 0
    momentum = p["motor_inertia"] * motor_speed + p["load_inertia"] * load_speed
    assert sp.expand(along(momentum, x, rates) - torque) == 0


# The maps


@everyday(*(name for name in CASES if name not in ("crane", "car")))
def test_closed_form_and_derived_maps_agree(case):
    """Orders, extension, and states and inputs along a plan to 1e-10 of their range."""
    pytest.importorskip("casadi")
    closed, derived = case.plant.flat_system(), case.plant.flat_system(maps="derived")
    assert closed.orders == derived.orders == case.orders
    assert closed.extension == derived.extension == case.extension
    assert closed.flat_labels == derived.flat_labels == case.plan.labels
    assert closed.state_labels == derived.state_labels
    assert closed.input_labels == derived.input_labels
    t = np.linspace(case.plan.start, case.plan.end, 101)
    (x, u), (x_known, u_known) = closed.states_and_inputs(case.plan, t), derived.states_and_inputs(case.plan, t)
    assert apart(x, x_known) < 1e-10
    assert apart(u, u_known) < 1e-10
    assert isinstance(closed, fs.FlatSystem)


@every
def test_states_and_inputs_satisfy_the_equations(case):
    """Their derivatives in time, by differences of fourth order, are the rates of the block."""
    flat, plant = case.plant.flat_system(), case.plant.iosystem()
    plan = case.plan
    h = 1e-3 * plan.duration
    t = np.linspace(plan.start + 0.1 * plan.duration, plan.end - 0.1 * plan.duration, 9)
    states = [flat.states_and_inputs(plan, t + k * h)[0] for k in (-2, -1, 1, 2)]
    difference = (states[0] - states[3] + 8.0 * (states[2] - states[1])) / (12.0 * h)
    x, u = flat.states_and_inputs(plan, t)
    rates = np.array([plant.dynamics(0.0, *column) for column in zip(x.T, u.T, strict=True)]).T
    size = np.maximum(np.ptp(rates, axis=1), 1e-3)
    assert (np.abs(difference - rates).max(axis=1) / size).max() < 1e-6


@every
def test_forward_is_the_inverse_of_reverse(case):
    flat, plan = case.plant.flat_system(), case.plan
    jet = plan.jet(plan.start + 0.3 * plan.duration, max(case.orders))
    flag = [jet[: r + 1, j] for j, r in enumerate(case.orders)]
    x, u = flat.reverse(flag)
    known = np.concatenate([row[:-1] for row in flag]) if case.extension == 0 else [row[0] for row in flag]
    found = flat.forward(x, u)
    got = np.concatenate([row[:-1] for row in found]) if case.extension == 0 else [row[0] for row in found]
    np.testing.assert_allclose(got, known, rtol=1e-9, atol=1e-9 * np.abs(known).max())


@pytest.mark.parametrize("name", [name for name in CASES if name != "crane"])
def test_formulas_of_the_flag_are_the_derivatives_along_the_motion(name):
    """Against the Taylor series of the motion that the equations give."""
    case = CASES[name]
    flat, p = case.plant.flat_system(), values_of(case.plant, None)
    x, u = flat.states_and_inputs(case.plan, case.plan.start + 0.3 * case.plan.duration)
    u = 1.1 * u
    known = StateSpacePlant.forward(case.plant, x, u, p)
    for found, row in zip(flat.forward(x, u), known, strict=True):
        np.testing.assert_allclose(found, row, rtol=1e-10, atol=1e-10 * np.abs(row).max())


@everyday("car, steering rate", "levitation", "drive, damped")
def test_a_loop_of_each_plant_follows_its_plan(case):
    """`flat_loop(plant.flat_system(), plan, poles=...)`, from the plan's start."""
    pytest.importorskip("casadi")
    loop = cp.flat_loop(case.plant.flat_system(), case.plan, poles=case.poles)
    t = np.linspace(case.plan.start, case.plan.end, 11)
    found = cp.simulate(loop, t)
    rows = np.array([found.outputs[label] for label in case.plan.labels])
    wanted = np.atleast_2d(case.plan(t))
    assert np.abs(rows - wanted).max() < 1e-6 * np.ptp(wanted, axis=1).max()
    assert set(case.plant.units) <= set(loop.output_labels)


@pytest.mark.parametrize("steering", ["angle", "rate"])
@pytest.mark.parametrize("turns", [0.25, 1.0, 2.0])
def test_headings_are_continuous_round_a_circle(steering, turns):
    """On a circle of 20 m at 10 m/s the heading grows by 0.5 rad/s, without a jump of a turn."""
    flat = cp.plants.KinematicCar(wheelbase=3.0, steering=steering).flat_system()
    plan = circles(turns)
    t = np.linspace(0.0, plan.end, 41)
    x, u = flat.states_and_inputs(plan, t)
    np.testing.assert_allclose(x[2], 0.5 * t, atol=2e-3)  # between waypoints the spline is near the circle
    np.testing.assert_allclose(u[0], 10.0, rtol=1e-3)
    order = np.random.default_rng(0).permutation(t.size)
    # Times of many segments are evaluated together or not, depending on their order: equal but for rounding.
    np.testing.assert_allclose(flat.states_and_inputs(plan, t[order])[0], x[:, order], rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(flat.states_and_inputs(plan, t, start=[0, 0, 6.0, *x[3:, 0]])[0][2], x[2] + 2.0 * np.pi)


def test_a_quadrotor_that_loops():
    """On circles with an acceleration above g the roll angle grows by a turn each, as atan2 without its jumps."""
    rate, size, points = 4.0, 2.0, []
    for angle in np.linspace(0.0, 4.0 * np.pi, 33):
        turn = angle + np.arange(5) * np.pi / 2
        x, z = size * rate ** np.arange(5) * np.array([np.sin(turn), -np.cos(turn)])
        points.append(cp.Waypoint.from_jets(angle / rate, x=x, z=z))
    plan = cp.PiecewiseSpline(points)
    t = np.linspace(0.0, plan.end, 2001)
    theta = cp.plants.PlanarQuadrotor().flat_system().states_and_inputs(plan, t)[0][2]
    pull = size * rate**2
    known = np.unwrap(np.arctan2(pull * np.sin(rate * t), pull * np.cos(rate * t) + 9.81))
    np.testing.assert_allclose(theta, known, atol=5e-3)
    assert theta[-1] == pytest.approx(4.0 * np.pi, abs=1e-9)


@pytest.mark.slow
def test_a_car_in_reverse():
    """The same path backwards: at heading pi, with a negative speed and the steering angle of forward travel."""
    plan = cp.PolySpline(
        [cp.Waypoint.from_jets(0.0, x=[0, -2, 0], y=[0, 0, 0]), cp.Waypoint.from_jets(4, x=[-8, -2, 0], y=[2, 0, 0])]
    )
    car = cp.plants.KinematicCar()
    t = np.linspace(0.0, 4.0, 21)
    x, u = car.flat_system(at={"v": -1.0}).states_and_inputs(plan, t)
    assert np.abs(x[2]).max() < 0.8
    assert u[0].max() < 0.0
    pytest.importorskip("casadi")
    known = car.flat_system(maps="derived", at={"v": -1.0}).states_and_inputs(plan, t)
    np.testing.assert_allclose(x, known[0], atol=1e-12)
    np.testing.assert_allclose(u, known[1], atol=1e-11)


def test_a_negative_current_levitates_as_well():
    case = CASES["levitation"]
    t = np.linspace(0.0, 0.4, 11)
    x, u = case.plant.flat_system().states_and_inputs(case.plan, t)
    y, w = case.plant.flat_system(at={"current": -1.0}).states_and_inputs(case.plan, t)
    np.testing.assert_allclose((y[2], w[0]), (-x[2], -u[0]), rtol=1e-14)


def test_the_load_angle_of_a_damped_drive_follows_from_its_flat_output():
    """It is y + d/k y'; the transfer function from y to the load angle has the zero -k/d of the plant."""
    case = CASES["drive, damped"]
    t = np.linspace(0.0, 0.3, 7)
    x, _ = case.plant.flat_system().states_and_inputs(case.plan, t)
    np.testing.assert_allclose(x[2], case.plan(t) + 0.05 / 50.0 * case.plan(t, 1), rtol=1e-13, atol=1e-15)
    model = ct.linearize(case.plant.iosystem(), np.zeros(4), [0.0])
    zeros = ct.ss(model.A, model.B, model.C[2:3], 0.0).zeros()
    np.testing.assert_allclose(zeros[np.argmin(np.abs(zeros + 1000.0))], -1000.0, rtol=1e-5)
    pytest.importorskip("casadi")
    with pytest.raises(cp.NotFlatError, match="dimension 1"):
        cp.flat_system(case.plant.iosystem(), "load_angle")


# Parameters


@every
def test_parameters_of_a_simulation_are_those_of_the_maps_as_well(case):
    """Maps with a parameter given equal those of a plant with that parameter."""
    label = next(iter(case.plant.flat_system().params))
    value = 1.3 * getattr(case.plant, label)
    other = type(case.plant)(**{**vars(case.plant), label: value})
    flat, jet = case.plant.flat_system(), case.plan.jet(case.plan.start + 0.4 * case.plan.duration, max(case.orders))
    flag = [jet[: r + 1, j] for j, r in enumerate(case.orders)]
    known = other.flat_system().reverse(flag)
    for found in (flat.reverse(flag, {label: value}), flat.with_params({label: value}).reverse(flag)):
        np.testing.assert_array_equal(np.concatenate(found), np.concatenate(known))
    with pytest.raises(ValueError, match=f"params must be among the parameters of {flat.name} .*, got 'size'"):
        flat.with_params({"size": 1.0})
    x, u = flat.reverse(flag)
    np.testing.assert_array_equal(flat.updfcn(0.0, x, u, {label: value}), other.iosystem().dynamics(0.0, x, u))


@pytest.mark.slow
def test_a_payload_that_the_law_does_not_know():
    """The parameter of the simulation is that of the plant alone: integral action removes the error that remains."""
    pytest.importorskip("casadi")
    case = CASES["levitation"]
    errors = []
    for law in (cp.FlatLaw(case.poles), cp.FlatLaw([*case.poles, -50], integral=True)):
        loop = cp.flat_loop(case.plant.flat_system(), case.plan, law=law)
        found = cp.simulate(loop, [0.0, 2.0], params={"mass": 1.05 * case.plant.mass})
        errors.append(abs(found.outputs["gap"][-1] - 0.006))
    assert errors[0] > 1e-6
    assert errors[1] < 1e-9


@pytest.mark.parametrize("case", [CASES["quadrotor"], CASES["drive, damped"]], ids=["quadrotor", "drive"])
def test_margins_over_a_range_of_a_parameter(case):
    label = next(iter(case.plant.flat_system().params))
    value, signal = getattr(case.plant, label), next(iter(case.plant.signals.inputs))
    bounds = {label: (0.9 * value, 1.1 * value)}
    found = [
        cp.margins(case.plan, {signal: (-1e6, 1e6)}, system, params=bounds)
        for system in (case.plant, case.plant.flat_system())
    ]
    assert all(one.satisfied for one in found)
    assert str(found[0]) == str(found[1])


# One interface


@every
def test_what_is_shown_copied_and_stored(case):
    flat = case.plant.flat_system()
    assert "Flat outputs" in str(case.plant)
    assert flat.name == case.plant.name == case.plant.iosystem().name
    assert case.plant.flat_system("mine").name == case.plant.iosystem("mine").name == "mine"
    t = case.plan.start + 0.5 * case.plan.duration
    x, u = flat.states_and_inputs(case.plan, t)
    for again in (
        copy.copy(flat),
        pickle.loads(pickle.dumps(flat)),
        pickle.loads(pickle.dumps(case.plant)).flat_system(),
    ):
        y, w = again.states_and_inputs(case.plan, t)
        np.testing.assert_array_equal([*y, *w], [*x, *u])
    assert set(case.plant.units) == {*flat.state_labels, *flat.input_labels, *flat.output_labels}
    assert type(case.plant)() == type(case.plant)()


@pytest.mark.slow
def test_closed_forms_need_no_extra():
    code = (
        "import sys\n"
        "sys.modules['casadi'] = sys.modules['mpmath'] = None\n"
        "import ctrlplan as cp\n"
        "plants = cp.plants\n"
        "for plant in (plants.DCMotor(), plants.FlexibleJoint(), plants.KinematicCar(), plants.PlanarQuadrotor(),\n"
        "              plants.MagneticLevitation(), plants.TwoMassDrive(damping=0.05), plants.Crane()):\n"
        "    found = cp.check_flat(plant.flat_system()); assert found.passed\n"
        "try:\n"
        "    plants.KinematicCar().flat_system(maps='derived')\n"
        "except ImportError as error:\n"
        "    assert 'ctrlplan[fast]' in str(error)\n"
        "else:\n"
        "    raise AssertionError\n"
    )
    done = subprocess.run([sys.executable, *WARNINGS, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


# Where the maps are singular


@pytest.mark.parametrize("maps", ["closed_form", "derived"])
@pytest.mark.parametrize(
    ("plant", "plan", "message"),
    [
        (
            cp.plants.KinematicCar(),
            cp.PolySpline([cp.Waypoint.from_jets(t, x=[10 * t, 0, 0], y=[t, 0, 0]) for t in (0.0, 4.0)]),
            "squared speed of kinematic_car must be above 0 along the plan, got 0 at 0 s",
        ),
        (
            cp.plants.KinematicCar(),
            cp.PolySpline(
                [
                    cp.Waypoint.from_jets(t, x=[t * (t - 2) * (t - 4), (8, -4, 8)[i]], y=[0, 0])
                    for i, t in enumerate((0.0, 2.0, 4.0))
                ]
            ),
            "squared speed of kinematic_car must be above 0",
        ),
        (
            cp.plants.PlanarQuadrotor(),
            cp.PolySpline(
                [
                    cp.Waypoint.from_jets(t, x=[0, 0, 0], z=[z, 0, a])
                    for t, z, a in ((0, 9, 0), (1, 5, -9.81), (3, 0, 0))
                ]
            ),
            "squared thrust of planar_quadrotor must be above 0 along the plan, got .* at 0\\.02.* s",
        ),
        (
            cp.plants.MagneticLevitation(),
            cp.PolySpline([cp.Waypoint(0, 0.01, 0, 0, 0), cp.Waypoint(0.01, 0.02, 0, 0, 0)], labels="gap"),
            "magnetic force of magnetic_levitation must be above 0 along the plan, got -.* at",
        ),
        (
            cp.plants.MagneticLevitation(),
            cp.PolySpline([cp.Waypoint(0, 0.01, 0, 0, 0), cp.Waypoint(1, -0.01, 0, 0, 0)], labels="gap"),
            "the gap of magnetic_levitation must be above 0 along the plan, got -0.01 at 1 s",
        ),
    ],
    ids=["rest", "cusp", "free fall", "pulled too fast", "through the coil"],
)
def test_a_singular_point_between_the_times_given_is_named(plant, plan, message, maps):
    """The plan is checked as a whole, whatever the times."""
    if maps == "derived":
        pytest.importorskip("casadi")
        message = plant.name
    with pytest.raises(ValueError, match=message):
        plant.flat_system(maps=maps).states_and_inputs(plan, [0.3 * plan.duration])


def test_a_car_that_is_at_rest_after_its_plan():
    with pytest.raises(ValueError, match="delta of kinematic_car must be determined by the plan, got nan"):
        cp.plants.KinematicCar().flat_system().states_and_inputs(cp.Clipped(LANE, 0.0, 3.0), [3.5])


# Bad input


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: cp.plants.KinematicCar(wheelbase=0.0), ValueError, "wheelbase must be finite and above 0, got 0"),
        (lambda: cp.plants.KinematicCar(wheelbase="2.7"), TypeError, "wheelbase must be a number"),
        (
            lambda: cp.plants.KinematicCar(steering="wheel"),
            ValueError,
            "steering must be one of angle, rate, got 'wheel'",
        ),
        (lambda: cp.plants.KinematicCar(length=3.0), TypeError, "length"),
        (lambda: cp.plants.TwoMassDrive(damping=-1.0), ValueError, "damping must be finite and at least 0"),
        (lambda: cp.plants.PlanarQuadrotor(mass=np.inf), ValueError, "mass must be finite and above 0"),
        (lambda: cp.plants.DCMotor().flat_system(maps="exact"), ValueError, "maps must be one of closed_form, derived"),
        (
            lambda: cp.plants.DCMotor().flat_system(at={"v": 1.0}),
            ValueError,
            r"at must be among the states and inputs of dc_motor \(angle",
        ),
        (lambda: cp.plants.KinematicCar().flat_system(at={"v": np.nan}), ValueError, r"at\['v'\] must be finite"),
        (
            lambda: cp.plants.KinematicCar().flat_system(at={"v": 0.0}),
            ValueError,
            r"at\['v'\] must be above or below 0",
        ),
        (lambda: cp.plants.DCMotor().flat_system(at=1.0), TypeError, "at must be a mapping of states and inputs"),
        (
            lambda: cp.plants.DCMotor().flat_system().states_and_inputs(LANE, 0.0),
            ValueError,
            "plan must have the axes angle",
        ),
    ],
)
def test_what_is_wrong_is_named(make, kind, message):
    with pytest.raises(kind, match=message):
        make()


# Paths with stops


@pytest.mark.parametrize("steering", ["angle", "rate"])
def test_closed_forms_follow_a_path_with_stops(steering):
    """Forward round three quarters of a circle, and back the same way, with the heading and curvature of the circle."""
    plant = cp.plants.KinematicCar(wheelbase=3.0, steering=steering)
    circle = circles(0.75)
    signs = (-1.0) ** np.arange(4)[:, None]
    returned = [cp.Waypoint.from_array(circle.end - w.time, w.jet * signs, w.labels) for w in circle.waypoints[::-1]]
    law = cp.TrigSpline([cp.Waypoint(0, 0.0, 0, 0, 0), cp.Waypoint(10, circle.end, 0, 0, 0)], alpha=1.0)
    plan = cp.PathPlan([circle, cp.PiecewiseSpline(returned)], [1, -1], law)
    t = np.linspace(0.0, 20.0, 41)
    x, u = plant.flat_system().states_and_inputs(plan, t)
    angle = 0.5 * np.where(t <= 10.0, law(t), circle.end - law(t - 10.0))
    np.testing.assert_allclose(x[2], angle, atol=2e-3)
    np.testing.assert_allclose(u[0], 10.0 * np.where(t <= 10.0, law(t, 1), -law(t - 10.0, 1)), atol=0.02)
    np.testing.assert_allclose(x[3] if steering == "rate" else u[1], np.arctan(3.0 / 20.0), atol=5e-3)
