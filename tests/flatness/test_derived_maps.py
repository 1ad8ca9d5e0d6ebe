"""Maps derived from equations against analytic ones, and against the equations of motion."""

import math
import pickle
import threading
from contextlib import nullcontext

import control as ct
import control.flatsys as fs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.integrate import trapezoid

pytest.importorskip("casadi")

from flat_plants import ARM, CASES, INERTIA, MASS, G, car, car_rate, converter, levitation, system, unicycle

import ctrlplan as cp


def rest_to_rest(labels, orders, ends, duration=3.0, starts=None):
    """Polynomial plan with all derivatives up to the orders zero at its ends."""
    axes = []
    for label, order, end, start in zip(labels, orders, ends, starts or [0.0] * len(ends), strict=True):
        points = [cp.Waypoint.from_jets(t, **{label: [p, *[0.0] * order]}) for t, p in ((0.0, start), (duration, end))]
        axes.append(cp.PolySpline(points, labels=[label]))
    return cp.stack(axes, labels=list(labels)) if len(axes) > 1 else axes[0]


def circle(turns, radius=5.0, duration=20.0, order=5, phi=0.0, count=41):
    """Circle through waypoints with exact derivatives."""
    w = 2.0 * math.pi * turns / duration

    def jets(t):
        waves = [
            radius * w**k * np.sin(w * t + phi + k * math.pi / 2 + np.array([0.0, -math.pi / 2])) for k in range(order)
        ]
        return {"x": [wave[0] for wave in waves], "y": [wave[1] for wave in waves]}

    return cp.PiecewiseSpline([cp.Waypoint.from_jets(t, **jets(t)) for t in np.linspace(0.0, duration, count)])


def bend():
    """A path with changing curvature, driven in motion."""
    ends = [(0.0, [0, 4, 0, 0], [0, 0, 0, 0]), (6.0, [25, 5, 0, 0], [6, 2, 0.5, 0])]
    return cp.PolySpline([cp.Waypoint.from_jets(t, x=x, y=y) for t, x, y in ends])


def unicycle_map(jet):
    (vx, vy), (ax, ay) = jet[1], jet[2]
    speed = np.hypot(vx, vy)
    heading = np.unwrap(np.arctan2(vy, vx))
    return [jet[0, 0], jet[0, 1], heading], [speed, (vx * ay - vy * ax) / speed**2]


def car_map(jet):
    states, (speed, turning) = unicycle_map(jet)
    return states, [speed, np.arctan(3.0 * turning / speed)]


def car_rate_map(jet):
    (vx, vy), (ax, ay), (jx, jy) = jet[1:4]
    states, (speed, delta) = car_map(jet)
    cross, rate = vx * ay - vy * ax, vx * jy - vy * jx
    curvature = cross / speed**3
    slope = rate / speed**3 - 3.0 * cross * (vx * ax + vy * ay) / speed**5
    return [*states, delta], [speed, 3.0 * slope / (1.0 + (3.0 * curvature) ** 2)]


def levitation_map(jet):
    gap, v, a, j = jet[:4, 0]
    i = gap * np.sqrt((G - a) / 1e-3)
    rate = v * i / gap - 0.5 * gap * j / np.sqrt((G - a) * 1e-3)
    return [gap, v, i], [2e-3 / gap * rate + 2.0 * i - 2e-3 * v * i / gap**2]


def two_mass_map(jet):
    y = jet[:, 0]
    x1, v1 = y[0] + 2.0 * y[2] / 50.0, y[1] + 2.0 * y[3] / 50.0
    return [x1, v1, y[0], y[1]], [y[2] + 2.0 * y[4] / 50.0 + 2.0 * y[2]]


def pvtol_map(jet):
    """Centre of oscillation: the thrust is along the body, (x'', y'' + g) is along it."""
    a = INERTIA / (MASS * ARM)
    (x2, y2), (x3, y3), (x4, y4) = jet[2], jet[3], jet[4]
    up = y2 + G
    th = np.arctan2(-x2, up)
    square = x2**2 + up**2
    w = (x2 * y3 - up * x3) / square
    alpha = (x2 * y4 - up * x4) / square - 2.0 * w * (x2 * x3 + up * y3) / square
    side = INERTIA / ARM * alpha
    lift = MASS * (np.sqrt(square) + a * w**2)
    states = [
        jet[0, 0] + a * np.sin(th),
        jet[0, 1] - a * np.cos(th),
        th,
        jet[1, 0] + a * np.cos(th) * w,
        jet[1, 1] + a * np.sin(th) * w,
        w,
    ]
    return states, [side, lift]


def converter_map(jet):
    """Energy e = L i^2/2 + C v^2/2, e' = E i - v^2/R."""
    e, e1, e2 = jet[:3, 0]
    # v^2 = (2 e - L i^2)/C in e' gives a quadratic equation of i.
    a, b, c = 0.02 / (1e-4 * 30.0), 12.0, -e1 - 2.0 * e / (1e-4 * 30.0)
    i = (-b + np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    v = np.sqrt((2.0 * e - 0.02 * i**2) / 1e-4)
    # e'' = E i' - 2 v v'/R with both rates affine in (1 - u).
    constant = 12.0 * 12.0 / 0.02 + 2.0 * v / 30.0 * v / (30.0 * 1e-4)
    slope = -12.0 * v / 0.02 - 2.0 * v * i / (30.0 * 1e-4)
    return [i, v], [1.0 - (e2 - constant) / slope]


def energy(i, v):
    return 0.5 * 0.02 * i**2 + 0.5 * 1e-4 * v**2


LOW, HIGH = energy(24.0**2 / (30.0 * 12.0), 24.0), energy(30.0**2 / (30.0 * 12.0), 30.0)

MAPS = {
    "unicycle": (CASES["unicycle"], circle(1.25), unicycle_map),
    "car, two circles": (CASES["car"], circle(2.0), car_map),
    "car, steering rate": (CASES["car, steering rate"], bend(), car_rate_map),
    "levitation": (CASES["levitation, voltage"], rest_to_rest(["gap"], [4], [0.006], 0.5, [0.01]), levitation_map),
    "two masses": (CASES["two masses"], rest_to_rest(["x2"], [5], [1.0]), two_mass_map),
    "pvtol": (
        CASES["pvtol"],
        rest_to_rest(["y1", "y2"], [5, 5], [4.0, 1.0], 2.0, [0.0, INERTIA / (MASS * ARM)]),
        pvtol_map,
    ),
    "converter": (CASES["converter, energy"], rest_to_rest(["y"], [3], [HIGH], 0.05, [LOW]), converter_map),
}


def derived(case, **options):
    return cp.flat_system(case.plant, case.outputs, **{"at": case.at, **options})


@pytest.mark.parametrize(("case", "plan", "formulas"), MAPS.values(), ids=list(MAPS))
def test_states_and_inputs_are_those_of_analytic_maps(case, plan, formulas):
    flat = derived(case)
    t = np.linspace(plan.start, plan.end, 1001)
    x, u = flat.states_and_inputs(plan, t)
    states, inputs = formulas(plan.jet(t, max(flat.orders)))
    for got, wanted in zip([*x, *u], [*states, *inputs], strict=True):
        size = np.ptp(wanted) if np.ptp(wanted) > 1e-9 * np.abs(wanted).max() else max(np.abs(wanted).max(), 1.0)
        np.testing.assert_allclose(got / size, wanted / size, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("rope_wrap", [False, True])
def test_the_crane_from_its_equations_alone(rope_wrap):
    """Against (15a-d), in any order of times, outside of the plan, with parameters."""
    crane = cp.plants.Crane(rope_wrap=rope_wrap)
    analytic = crane.flat_system()
    flat = cp.flat_system(crane.iosystem(), ["x", "z"], at={"R": 10.0}, params={"load_mass": crane.load_mass})
    plan = rest_to_rest(["x", "z"], [4, 4], [20.0, 11.0], 15.0, [0.0, 10.0])
    t = np.array([16.0, 3.0, -1.0, 15.0, 0.0, 7.5, 7.5, 14.9])
    for got, wanted in zip(flat.states_and_inputs(plan, t), analytic.states_and_inputs(plan, t), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-10)
    jet = plan.jet(np.linspace(0.0, 15.0, 31), 4)
    found, known = flat.quantities(jet), analytic.quantities(jet)
    for name in ("T", "F", "C", "R", "theta_d1"):
        np.testing.assert_allclose(found[name], known[name], rtol=1e-12, atol=1e-9)
    assert flat.quantities(jet[:4]).keys() == set(flat.state_labels)
    heavy = {"load_mass": 700.0}
    flag = [jet[:, 0, 10], jet[:, 1, 10]]
    for got, wanted in zip(flat.reverse(flag, heavy), analytic.reverse(flag, heavy), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-9)
    x, u = analytic.states_and_inputs(plan, 7.0)
    for got, wanted in zip(flat.forward(x, u), analytic.forward(x, u), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_limits_on_states_and_inputs_of_a_derived_plant():
    flat = derived(CASES["two masses"])
    plan = rest_to_rest(["x2"], [5], [1.0])
    analytic = fs_two_mass()
    limits = {"u": 2.0, "v1": 1.5}
    found, known = cp.fastest(plan, limits, flat), cp.fastest(plan, limits, analytic)
    assert found.duration == pytest.approx(known.duration, rel=1e-9)
    for one, other in zip(cp.margins(plan, limits, flat), cp.margins(plan, limits, analytic), strict=True):
        assert (one.bound.name, one.fraction) == (other.bound.name, pytest.approx(other.fraction, rel=1e-9))


def fs_two_mass():
    """Function of the jet to the states and the input of the two masses."""

    def quantities(jet):
        if len(jet) < 5:
            raise ValueError("order 4")
        states, inputs = two_mass_map(jet)
        return dict(zip(["x1", "v1", "x2", "v2", "u"], [*states, *inputs], strict=True))

    return quantities


@examples(20)
@given(st.lists(st.floats(0.0, 20.0), min_size=1, max_size=6), st.integers(0, 2**31))
def test_the_result_does_not_depend_on_the_other_times_of_a_call(times, seed):
    alone = np.array([TURNING.states_and_inputs(AROUND, t)[0] for t in times]).T
    np.testing.assert_allclose(TURNING.states_and_inputs(AROUND, times)[0], alone, rtol=1e-13, atol=1e-13)
    order = np.random.default_rng(seed).permutation(len(times))
    shuffled = TURNING.states_and_inputs(AROUND, np.array(times)[order])[0]
    np.testing.assert_array_equal(shuffled, TURNING.states_and_inputs(AROUND, times)[0][:, order])


AROUND = circle(2.0)
TURNING = derived(CASES["car"])


@pytest.mark.slow
def test_the_branch_is_that_of_the_operating_point_or_the_start():
    """A car that drives the same circle backwards has the opposite heading and speed."""
    forwards, backwards = derived(CASES["car"]), cp.flat_system(car, ["x", "y"], at={"v": -1.0})
    t = np.linspace(0.0, 20.0, 11)
    x, u = forwards.states_and_inputs(AROUND, t)
    y, v = backwards.states_and_inputs(AROUND, t)
    np.testing.assert_allclose(v[0], -u[0], rtol=1e-12)
    np.testing.assert_allclose(np.exp(1j * y[2]), -np.exp(1j * x[2]), atol=1e-11)
    turned, w = forwards.states_and_inputs(AROUND, t, start=[0.0, -5.0, math.pi])
    np.testing.assert_allclose(w[0], -u[0], rtol=1e-12)
    np.testing.assert_allclose(turned[2], x[2] + math.pi, atol=1e-11)


@pytest.mark.slow
def test_singular_points_are_named_with_time_and_quantity():
    flat = derived(CASES["car"])
    stop = rest_to_rest(["x", "y"], [2, 2], [4.0, 1.0])
    with pytest.raises(ValueError, match=r"states of car.*w1 is not determined"):
        flat.states_and_inputs(stop, [1.5])
    with pytest.raises(ValueError, match=r"^v must be determined by the plan, got nan where the plan is at rest"):
        cp.margins(stop, {flat.input_labels[0]: 20.0}, flat)
    there = cp.PolySpline(
        [cp.Waypoint.from_jets(t, x=[p, v], y=[0.3 * p, 0.3 * v]) for t, p, v in ((0, 0, 1), (2, 1, 0), (4, 0, -1))]
    )
    with pytest.raises(ValueError, match=r"not determined by the flat outputs.* at (1\.9|2)"):
        flat.states_and_inputs(there, np.linspace(0.0, 4.0, 5))
    crane = cp.flat_system(cp.plants.Crane().iosystem(), ["x", "z"], at={"R": 10.0})
    falling = rest_to_rest(["x", "z"], [4, 4], [0.0, 30.0], 2.0, [0.0, 10.0])
    with pytest.raises(ValueError, match=r"states of crane .* s"):
        crane.states_and_inputs(falling, [1.0])


def test_before_the_start_and_after_the_end_the_plant_rests():
    flat = derived(CASES["two masses"])
    plan = rest_to_rest(["x2"], [5], [1.0])
    x, u = flat.states_and_inputs(plan, [-5.0, 8.0])
    np.testing.assert_allclose(x, [[0.0, 1.0], [0.0, 0.0], [0.0, 1.0], [0.0, 0.0]], atol=1e-13)
    np.testing.assert_allclose(u, 0.0, atol=1e-12)


def test_plans_that_are_not_smooth_enough_are_rejected_where_they_jump():
    flat = derived(CASES["two masses"])
    rough = cp.PolySpline([cp.Waypoint(0.0, 0.0, 0.0), cp.Waypoint(1.0, 1.0, 0.0)], labels=["x2"])
    with pytest.raises(ValueError, match="derivative 2 jumps"):
        flat.states_and_inputs(rough, [-0.5, 0.5])


@pytest.mark.slow
def test_pickles_threads_and_copies():
    flat = derived(CASES["car"])
    again = pickle.loads(pickle.dumps(flat))
    t = np.linspace(0.0, 20.0, 50)
    wanted = flat.states_and_inputs(AROUND, t)
    for got, value in zip(again.states_and_inputs(AROUND, t), wanted, strict=True):
        np.testing.assert_array_equal(got, value)
    with pytest.raises(ValueError, match="derive it again"):
        cp.create_flat_iosystem(again, [[-1, -2]] * 2)
    results = [None] * 4

    def work(k):
        results[k] = flat.states_and_inputs(circle(1.0, radius=4.0 + k % 2), t)

    workers = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for k in range(4):
        np.testing.assert_array_equal(results[k][0], results[k % 2][0])


@pytest.mark.parametrize(
    ("name", "cost"),
    [
        ("two masses", False),
        ("two masses", True),
        ("quadrotor", False),
        pytest.param("quadrotor", True, marks=pytest.mark.slow),
        pytest.param("crane", False, marks=pytest.mark.slow),
    ],
)
def test_python_control_plans_with_the_maps(name, cost):
    """point_to_point on equal and unequal orders, with and without a cost: its trajectory obeys the equations."""
    case = CASES[name]
    flat = derived(case)
    x0 = np.array([flat.operating_point[label] for label in flat.state_labels])
    u0 = np.array([flat.operating_point[label] for label in flat.input_labels])
    xf = x0.copy()
    xf[list(flat.state_labels).index({"two masses": "x2", "quadrotor": "px", "crane": "D"}[name])] += 1.0
    if name == "two masses":
        xf[0] += 1.0
    options = {"cost": lambda x, u: u @ u, "minimize_options": {"maxiter": 2}} if cost else {}
    basis = fs.PolyFamily(2 * max(flat.orders) + 6)
    # Two iterations of the optimisation: what it returns is a plan as well.
    with pytest.warns(UserWarning, match="unable to solve") if cost else nullcontext():
        found = fs.point_to_point(flat, np.linspace(0.0, 2.0, 5), x0, u0, xf, u0, basis=basis, **options)
    t = np.linspace(0.0, 2.0, 21)
    x, u = found.eval(t)
    np.testing.assert_allclose(x[:, 0], x0, atol=1e-6)
    np.testing.assert_allclose(x[:, -1], xf, atol=1e-6)
    h = 1e-4
    rates = (found.eval(t[1:-1] + h)[0] - found.eval(t[1:-1] - h)[0]) / (2.0 * h)
    wanted = np.array([case.plant.dynamics(0.0, *both) for both in zip(x[:, 1:-1].T, u[:, 1:-1].T, strict=True)]).T
    np.testing.assert_allclose(rates, wanted, atol=1e-4 * (1.0 + np.abs(wanted).max()))


def test_the_derived_system_simulates_as_its_plant():
    flat = derived(CASES["levitation, voltage"])
    x = np.array([0.01, 0.001, 1.0])
    np.testing.assert_allclose(flat.dynamics(0.0, x, [2.0]), levitation.dynamics(0.0, x, [2.0]), rtol=1e-14)
    np.testing.assert_allclose(flat.output(0.0, x, [2.0]), x)


def test_linear_plants_choose_their_flat_output():
    chain = ct.ss(ct.tf([2.0], [1.0, 3.0, 1.0, 0.0]), name="drive", outputs="y")
    flat = cp.flat_system(chain)
    assert (flat.flat_labels, flat.orders) == (("y",), (3,))
    plan = rest_to_rest(["y"], [3], [1.0])
    u = flat.states_and_inputs(plan, [1.0])[1]
    jet = plan.jet(1.0, 3).ravel()
    assert u[0, 0] == pytest.approx((jet[3] + 3.0 * jet[2] + jet[1]) / 2.0, rel=1e-12)
    zeros = ct.ss(two_mass_matrix(), [[0.0], [1.0], [0.0], [0.0]], [[0.0, 0.0, 1.0, 0.0]], 0.0, name="damped")
    flat = cp.flat_system(zeros)
    assert flat.orders == (4,)
    assert flat.flat_labels == ("y",)
    again = np.array(flat.forward([0.3, 0.1, 0.2, -0.1], [0.0])[0][:1])
    # Up to its scale the Brunovsky output x1/24 + x2 - x2'/24 of these masses.
    ratio = again[0] / (0.3 / 24.0 + 0.2 + 0.1 / 24.0)
    other = flat.forward([1.0, 0.5, -0.2, 0.7], [0.0])[0][0] / (1.0 / 24.0 - 0.2 - 0.7 / 24.0)
    assert ratio == pytest.approx(other, rel=1e-10)
    square = ct.ss(
        [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]], [[0, 0], [1, 0], [0, 1]], [[1, 0, 0], [0, 0, 1]], 0.0
    )
    assert cp.flat_system(square).orders == (2, 1)
    with pytest.raises(ValueError, match="controllable"):
        cp.flat_system(ct.ss([[0.0, 0.0], [0.0, -1.0]], [[1.0], [0.0]], [[1.0, 1.0]], 0.0))


def two_mass_matrix():
    return [[0.0, 1.0, 0.0, 0.0], [-50.0, -2.0, 50.0, 2.0], [0.0, 0.0, 0.0, 1.0], [25.0, 1.0, -25.0, -1.0]]


def test_transfer_functions_of_several_inputs_need_a_state_space():
    with pytest.raises(TypeError, match=r"control\.ss"):
        cp.flat_system(ct.tf([[[1.0], [1.0]]], [[[1.0, 1.0], [1.0, 2.0]]]))


@pytest.mark.parametrize("plant", [unicycle, car_rate, converter, system("one", "x", "u", lambda x, u: [u - x])])
def test_flags_and_states_agree(plant):
    """reverse undoes forward at the operating point."""
    outputs = {"converter": lambda x, u, p: [energy(x[0], x[1])], "one": "x"}.get(plant.name, ["x", "y"])
    flat = cp.flat_system(plant, outputs, at={"converter": {"v": 24.0}, "one": {}}.get(plant.name, {"v": 1.0}))
    x = np.array([flat.operating_point[name] for name in flat.state_labels])
    u = np.array([flat.operating_point[name] for name in flat.input_labels])
    again = flat.reverse(flat.forward(x, u))
    np.testing.assert_allclose(again[0], x, atol=1e-12)
    np.testing.assert_allclose(again[1], u, atol=1e-10)


def one_input(update, states, name="plant"):
    return ct.nlsys(update, None, states=states, inputs=["u"], name=name)


@pytest.mark.slow
def test_inputs_that_enter_by_several_terms_are_found_for_any_demand():
    """x' = u + u^3, and x' = sin u on two of its branches."""
    plan = rest_to_rest(["x"], [3], [1e3], 1.0)
    t = np.linspace(0.0, 1.0, 11)
    cubic = cp.flat_system(one_input(lambda t, x, u, p: [u[0] + u[0] ** 3], ["x"]), "x")
    u = cubic.states_and_inputs(plan, t)[1][0]
    wanted = plan.jet(t, 1)[1, 0]
    np.testing.assert_allclose(u + u**3, wanted, rtol=1e-13, atol=1e-13 * wanted.max())
    slow = rest_to_rest(["x"], [3], [1.0], 2.2)
    for at, sign, turn in ((0.0, 1.0, 0.0), (3.0, -1.0, math.pi), (-6.0, 1.0, -math.tau)):
        sine = cp.flat_system(one_input(lambda t, x, u, p: [np.sin(u[0])], ["x"]), "x", at={"u": at})
        found = sine.states_and_inputs(slow, 2.2 * t)[1][0]
        np.testing.assert_allclose(found, sign * np.arcsin(slow.jet(2.2 * t, 1)[1, 0]) + turn, atol=1e-12)


@pytest.mark.parametrize(
    ("update", "states", "at", "ends", "times"),
    [
        (lambda t, x, u, p: [np.sin(u[0])], ["x"], {}, (0.0, 1.0), [0.0, 1.0]),  # faster than possible
        (lambda t, x, u, p: [x[1], x[0] * u[0]], ["x", "v"], {"x": -1.0}, (-1.0, 1.0), [0.0, 0.2]),
        (lambda t, x, u, p: [x[1], u[0] ** 3], ["x", "v"], {"u": 1.0}, (0.0, 1.0), [0.2]),
        (lambda t, x, u, p: [x[1], u[0] ** 2], ["x", "v"], {"u": 1.0}, (0.0, 1.0), [0.2]),  # only v' > 0
    ],
)
def test_inputs_that_are_not_determined_are_errors_over_the_whole_plan(update, states, at, ends, times):
    flat = cp.flat_system(one_input(update, states), "x", at=at)
    with pytest.raises(ValueError, match=r"(inputs|u) of plant must be determined.* s"):
        flat.states_and_inputs(rest_to_rest(["x"], [3], [ends[1]], 1.0, [ends[0]]), times)


def straight(speed):
    """Plan along x with a speed that is a polynomial of time, from 0 to 1 s."""
    way = speed.integ()
    jets = [[float(way.deriv(k)(t)) if k else float(way(t)) for k in range(6)] for t in (0.0, 1.0)]
    points = [cp.Waypoint.from_jets(t, x=jet, y=[0.0] * 6) for t, jet in zip((0.0, 1.0), jets, strict=True)]
    return cp.PolySpline(points)


@pytest.mark.slow
def test_a_stop_between_nodes_is_found_on_a_straight_line_with_another_slow_point():
    """Speed (t - t_1)^2 ((t - 3/4)^2 + 1e-5): it is 0 at t_1, and small at a node of the grid."""
    stop = 0.37113
    speed = np.polynomial.Polynomial([-stop, 1.0]) ** 2 * (np.polynomial.Polynomial([-0.75, 1.0]) ** 2 + 1e-5)
    flat = derived(CASES["unicycle"])
    with pytest.raises(ValueError, match=r"states of unicycle .* at 0\.371"):
        flat.states_and_inputs(straight(speed), [0.0, 1.0])
    # A point that is slow only, at 1e-4 of the highest speed, is passed.
    slow = speed + 1e-5
    found = flat.states_and_inputs(straight(slow), [0.0, stop, 1.0])[1][0]
    np.testing.assert_allclose(found, slow(np.array([0.0, stop, 1.0])), rtol=1e-9)


def test_starts_that_the_flat_outputs_do_not_determine_are_rejected():
    """A start across the direction of travel leaves only the speed 0 for it."""
    flat = derived(CASES["unicycle"])
    plan = rest_to_rest(["x", "y"], [2, 2], [2.0, 0.0], 2.0)
    moving = cp.PolySpline([cp.Waypoint.from_jets(t, x=[t, 1, 0, 0], y=[0.0] * 4) for t in (0.0, 2.0)])
    for heading in (math.pi / 2, -math.pi / 2):
        with pytest.raises(ValueError, match="start must be a state of unicycle that the flat outputs determine"):
            flat.states_and_inputs(moving, 0.0, start=[0.0, 0.0, heading])
    with pytest.raises(ValueError, match="start must be"):
        flat.states_and_inputs(moving, 0.0, start=[0.0, np.nan, 0.0])
    with pytest.raises(ValueError, match=r"states of unicycle at 0 s must be connected"):
        flat.states_and_inputs(plan, 0.0)


def test_signals_on_another_branch_of_the_equations_are_not_determined():
    """Drag |v| v, derived for v > 0."""
    drag = one_input(lambda t, x, u, p: [x[1], u[0] - 0.5 * abs(x[1]) * x[1]], ["x", "v"], "drag")
    flat = cp.flat_system(drag, "x", at={"v": 1.0})
    jet = np.array([[0.0, 0.0], [2.0, -2.0], [1.0, 1.0]])[:, None, :]
    found = flat.quantities(jet)
    np.testing.assert_allclose(found["u"], [3.0, np.nan])
    with pytest.raises(ValueError, match=r"equations of drag must stay on the branch .*got another one; derive"):
        flat.reverse([jet[:, 0, 1]])


def test_misspelled_parameters_and_scales_are_named():
    plant = ct.nlsys(lambda t, x, u, p: [u[0] / p.get("m", 2.0)], None, states=["v"], inputs=["F"], name="mass")
    with pytest.raises(ValueError, match=r"params must be among the parameters of mass \(none\), got 'mas'"):
        cp.flat_system(plant, "v", params={"mas": 3.0})
    assert cp.flat_system(plant, "v", params={"m": 3.0}).params["m"] == 3.0
    with pytest.raises(ValueError, match=r"scales must be among .*v, F, got 'f'"):
        cp.flat_system(plant, "v", scales={"f": 1.0})


def test_what_is_no_system_is_named_first():
    with pytest.raises(TypeError, match="system must be a python-control system, got int"):
        cp.flat_system(5)


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e9])
def test_zeros_of_linear_plants_in_any_unit_of_time(unit):
    """(1 + T s)/(1 + 1.1 T s + T^2 s^2) has a zero, so its output is not flat; without it the output is."""
    rows, right = [[0.0, 1.0 / unit], [-1.0 / unit, -1.1 / unit]], [[0.0], [1.0 / unit]]
    for zero in (0.0, 1.0, 1e-11):
        flat = cp.flat_system(ct.ss(rows, right, [[1.0, zero]], 0.0, outputs="speed"))
        assert flat.orders == (2,)
        assert flat.flat_labels == (("y",) if zero else ("speed",))


def test_grids_of_plans_with_axes_in_another_order_are_kept():
    flat = derived(CASES["unicycle"])
    plan = cp.PolySpline([cp.Waypoint.from_jets(t, y=[0.0] * 4, x=[t, 1, 0, 0]) for t in (0.0, 2.0)], labels=["y", "x"])
    x, _ = flat.states_and_inputs(plan, 1.0)
    np.testing.assert_allclose(x, [1.0, 0.0, 0.0], atol=1e-14)
    assert flat.matched(plan) is flat.matched(plan)
    assert plan.labels == ("y", "x")


@pytest.mark.slow
def test_other_values_of_parameters():
    """A crane with another load: that of the maps by formulas, for all that python-control calls as well."""
    crane, heavy = cp.plants.Crane(), cp.plants.Crane(load_mass=700.0)
    flat = cp.flat_system(crane.iosystem(), ["x", "z"], at={"R": 10.0})
    changed, known = flat.with_params({"load_mass": 700.0}), heavy.flat_system()
    plan = rest_to_rest(["x", "z"], [4, 4], [20.0, 11.0], 15.0, [0.0, 10.0])
    x, u = known.states_and_inputs(plan, 4.0)
    for got, wanted in zip(changed.states_and_inputs(plan, 4.0), (x, u), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(changed.dynamics(0.0, x, u), known.dynamics(0.0, x, u), rtol=1e-12, atol=1e-12)
    again = changed.reverse(changed.forward(x, u))
    np.testing.assert_allclose(again[0], x, rtol=1e-12, atol=1e-12)
    assert (flat.params["load_mass"], changed.params["load_mass"]) == (crane.load_mass, 700.0)
    with pytest.raises(ValueError, match="among the parameters of crane"):
        flat.with_params({"load": 700.0})


@pytest.mark.slow
def test_margins_over_ranges_of_parameters():
    """A mass with a force: the largest mass is the worst; the quintic move has the peak acceleration 10/sqrt(3)."""
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], u[0] / p["m"]], None, states=["x", "v"], inputs=["F"], params={"m": 2.0}, name="mass"
    )
    flat, plan = cp.flat_system(plant, "x"), rest_to_rest(["x"], [2], [1.0], 1.0)
    found = cp.margins(plan, {"F": 20.0}, flat, params={"m": (1.0, 3.0)})
    assert found.active.parameters == {"m": 3.0}
    assert abs(found.active.value) == pytest.approx(3.0 * 10.0 / math.sqrt(3.0), rel=1e-8)
    with pytest.raises(ValueError, match="params must be among"):
        cp.margins(plan, {"F": 20.0}, flat, params={"mass": 1.0})


@pytest.mark.parametrize("count", [7, 401])
def test_angles_of_quantities_are_continuous_along_the_plan(count):
    """Two circles: the heading grows by two turns, and the speed does not change its sign."""
    t = np.linspace(3.0, 18.0, count)
    flat = derived(CASES["unicycle"])
    found = flat.quantities(AROUND.jet(t, 2))
    (_, _, heading), (speed, turning) = unicycle_map(AROUND.jet(np.linspace(0.0, 18.0, 1801), 2))
    np.testing.assert_allclose(found["v"], np.interp(t, np.linspace(0.0, 18.0, 1801), speed), rtol=1e-6)
    if count > 50:
        np.testing.assert_allclose(
            np.diff(found["th"]), np.diff(np.interp(t, np.linspace(0, 18, 1801), heading)), atol=1e-6
        )
        np.testing.assert_allclose(found["w"], np.interp(t, np.linspace(0.0, 18.0, 1801), turning), rtol=1e-6)
    shuffled = np.random.default_rng(0).permutation(count)
    np.testing.assert_allclose(flat.quantities(AROUND.jet(t[shuffled], 2))["v"], found["v"][shuffled], rtol=1e-12)


@pytest.mark.slow
def test_limits_of_an_angle_that_turns_are_rejected():
    flat = derived(CASES["unicycle"])
    with pytest.raises(ValueError, match=r"th must stay within half a turn .*, got 12\.57 rad"):
        cp.margins(AROUND, {"th": (-20.0, 11.0)}, flat)
    assert cp.margins(AROUND, {"v": (0.0, 4.0)}, flat).active.value == pytest.approx(math.pi, rel=1e-3)
    found = cp.margins(circle(0.3), {"th": 3.0}, flat)
    assert found.active.value == pytest.approx(0.3 * math.tau, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("orders", [(2, 1), (2, 2)])
def test_optimal_control_of_python_control_on_equal_and_unequal_orders(orders):
    """The plan begins at rest, obeys the equations and costs less than to stay."""
    states = ["a", "va", "b", "vb"][: sum(orders)]
    plant = ct.nlsys(
        (lambda t, x, u, p: [x[1], u[0], u[1]]) if orders == (2, 1) else (lambda t, x, u, p: [x[1], u[0], x[3], u[1]]),
        None,
        states=states,
        inputs=["ua", "ub"],
        outputs=states,
        name="axes",
    )
    flat = cp.flat_system(plant, ["a", "b"])
    assert flat.orders == orders
    end = np.array([1.0, 0.0, 2.0, 0.0])[: len(states)]
    found = fs.solve_flat_optimal(
        flat,
        np.linspace(0.0, 2.0, 11),
        np.zeros(len(states)),
        np.zeros(2),
        trajectory_cost=lambda x, u: u @ u,
        terminal_cost=lambda x, u: 10.0 * (x - end) @ (x - end),
        minimize_method="SLSQP",
        basis=fs.PolyFamily(6),
    )
    x, u = found.eval(np.linspace(0.0, 2.0, 21))
    np.testing.assert_allclose(np.concatenate([x[:, 0], u[:, 0]]), 0.0, atol=1e-9)
    error = x[:, -1] - end
    assert trapezoid((u**2).sum(axis=0), dx=0.1) + 10.0 * error @ error < 0.5 * 10.0 * end @ end
    rates = np.array([plant.dynamics(0.0, *both) for both in zip(x.T, u.T, strict=True)]).T
    t, h = np.linspace(0.0, 2.0, 21), 1e-4
    slopes = (found.eval(t[1:-1] + h)[0] - found.eval(t[1:-1] - h)[0]) / (2.0 * h)
    np.testing.assert_allclose(slopes, rates[:, 1:-1], atol=1e-6)


@pytest.mark.slow
def test_flags_states_and_jets_of_wrong_sizes():
    flat = derived(CASES["crane"])
    for flag in ([np.zeros(3), np.zeros(5)], [np.zeros(5)]):
        with pytest.raises(ValueError, match="flag must be 5 of x, 5 of z entries, got"):
            flat.reverse(flag)
    with pytest.raises(ValueError, match=r"x and u must be 6 states and 2 inputs, got shapes \(3,\)"):
        flat.forward(np.zeros(3), np.zeros(2))
    with pytest.raises(ValueError, match="jet must be finite"):
        flat.quantities(np.full((5, 2, 3), np.nan))


@pytest.mark.slow
def test_many_flags_together_have_the_states_of_formulas():
    """More flags than are connected one by one, of a plan far from the operating point, in any order."""
    quadrotor = cp.plants.PlanarQuadrotor(mass=1.0)
    flat = cp.flat_system(quadrotor.iosystem(), ["x", "z"], at={"theta": 0.0})
    plan = rest_to_rest(["x", "z"], [4, 4], [3.0, 1.0], 1.0)
    jet = plan.jet(np.linspace(0.0, 1.0, 700), 4)
    order = np.random.default_rng(0).permutation(700)
    known = quadrotor.flat_system().quantities(jet)
    for found, places in ((flat.quantities(jet), slice(None)), (flat.quantities(jet[:, :, order]), order)):
        for name in ("theta", "theta_d1", "left", "right"):
            wanted = known[name][places]
            np.testing.assert_allclose(found[name], wanted, rtol=0.0, atol=1e-10 * np.abs(wanted).max())


@pytest.mark.slow
def test_of_several_plans_those_that_the_plant_cannot_follow_are_nan():
    """A crane whose load would fall faster than g: the rope length of the continuous states would be infinite."""
    crane = cp.plants.Crane()
    flat = cp.flat_system(crane.iosystem(), ["x", "z"], at={"R": 10.0}, params={"load_mass": crane.load_mass})
    plan = rest_to_rest(["x", "z"], [4, 4], [20.0, 8.0], 15.0, [0.0, 10.0])
    plans = [plan.retime(duration) for duration in (0.8, 15.0, 9.0)]
    jets = np.stack([one.jet(one.start + one.duration * np.linspace(0.0, 1.0, 24), 4) for one in plans], axis=2)
    found = flat.feasible_quantities(jets)["F"]
    with pytest.raises(ValueError, match="taut"):
        crane.quantities(jets[:, :, 0])
    assert np.isnan(found[0]).any()
    for k in (1, 2):
        np.testing.assert_allclose(found[k], crane.quantities(jets[:, :, k])["F"], rtol=1e-9, atol=1e-6)
