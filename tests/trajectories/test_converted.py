"""Trajectories from splines of scipy and from plans of python-control, against the objects themselves."""

import pickle
from fractions import Fraction
from types import SimpleNamespace

import control as ct
import control.flatsys as fs
import control.optimal as opt
import numpy as np
import pytest
from scipy import interpolate as si

import ctrlplan as cp

RNG = np.random.default_rng(5)
KNOTS = np.array([-1.0, 0.0, 0.5, 2.0, 2.25, 3.0, 4.5])
ROWS = RNG.normal(size=(7, 2))
CLOSED = np.append(ROWS[:-1, 0], ROWS[0, 0])
SPLINES = {
    "CubicSpline": si.CubicSpline(KNOTS, ROWS),
    "CubicSpline along the last axis": si.CubicSpline(KNOTS, ROWS.T, axis=1),
    "periodic": si.CubicSpline(KNOTS, CLOSED, bc_type="periodic"),
    "pchip": si.PchipInterpolator(KNOTS, ROWS[:, 0]),
    "Akima": si.Akima1DInterpolator(KNOTS, ROWS),
    "PPoly": si.PPoly(RNG.normal(size=(5, 3, 2)), [0.0, 1.0, 1.5, 4.0]),
    "PPoly of a B-spline": si.PPoly.from_spline(si.make_interp_spline(KNOTS, ROWS[:, 0], k=3)),
    "BPoly": si.BPoly.from_derivatives(KNOTS, np.stack([ROWS, ROWS[::-1]], axis=1)),
    **{f"degree {k}": si.make_interp_spline(KNOTS, ROWS, k=k) for k in (1, 2, 3, 5)},
    "B-spline along the last axis": si.make_interp_spline(KNOTS, ROWS.T, k=3, axis=1),
    "B-spline, periodic": si.make_interp_spline(KNOTS, CLOSED, k=3, bc_type="periodic"),
    "B-spline, knots beyond": si.BSpline(np.arange(10.0), RNG.normal(size=6), 3),
    "B-spline, repeated knots": si.BSpline([0, 0, 0, 0, 1, 1, 1, 2, 2, 3, 3, 3, 3], RNG.normal(size=9), 3),
    "B-spline, steps": si.BSpline([0.0, 1.0, 2.5, 3.0], [1.0, -2.0, 0.5], 0),
}


@pytest.mark.parametrize("name", SPLINES)
def test_spline_has_the_values_and_derivatives_of_scipy(name):
    spline = SPLINES[name]
    plan = cp.as_trajectory(spline)
    t = np.append(RNG.uniform(plan.start, plan.end, 60), plan.breakpoints[:-1])
    for nu in range(4):
        # Some releases of scipy write out of bounds where a B-spline is derived more often than its degree.
        wanted = 0.0 * spline(t) if nu > getattr(spline, "k", nu) else spline(t, nu=nu)
        wanted = wanted if wanted.ndim == 1 or "last" in name else wanted.T
        np.testing.assert_allclose(plan(t, nu), wanted, rtol=0, atol=1e-12 * max(1.0, np.abs(wanted).max()))
    assert not plan.deviation.any()


def _exact(knots, coefficients, degree, time):
    """Value of a B-spline by de Boor's algorithm in rational numbers."""
    t, x = [Fraction(float(knot)) for knot in knots], Fraction(float(time))
    last = max(j for j in range(degree, len(coefficients)) if t[j] <= x and t[j] < t[j + 1])
    d = [Fraction(float(c)) for c in coefficients[last - degree : last + 1]]
    for r in range(1, degree + 1):
        for j in range(degree, r - 1, -1):
            left, right = t[j + last - degree], t[j + 1 + last - r]
            share = (x - left) / (right - left)
            d[j] = (1 - share) * d[j - 1] + share * d[j]
    return d[degree]


@pytest.mark.parametrize("degree", [5, 6, 7, 13, 25])
@pytest.mark.parametrize("inner", [[0.4, 1.1, 2.9], [1e-3, 1.5, 1.5 + 1e-6], [1.0, 1.0, 1.0, 2.0]])
def test_splines_of_high_degree_lose_no_digits(degree, inner):
    """Powers over a whole interval would lose three to the power of the degree: 6e-5 of degree 25."""
    knots = np.array([0.0] * (degree + 1) + inner + [3.0] * (degree + 1))
    coefficients = np.random.default_rng(degree).uniform(-1.0, 1.0, knots.size - degree - 1)
    plan = cp.as_trajectory(si.BSpline(knots, coefficients, degree))
    t = np.sort(np.append(np.random.default_rng(1).uniform(0.0, 3.0, 25), plan.breakpoints[:-1]))
    wanted = [float(_exact(knots, coefficients, degree, time)) for time in t]
    np.testing.assert_allclose(plan(t), wanted, rtol=0, atol=3e-14)
    assert set(knots) <= set(plan.breakpoints)


@pytest.mark.parametrize("degree", [5, 13, 25])
def test_bernstein_polynomials_of_high_degree_lose_no_digits(degree):
    times = [0.0, 0.3, 2.0]
    coefficients = np.random.default_rng(degree).uniform(-1.0, 1.0, (degree + 1, 2))
    plan = cp.as_trajectory(si.BPoly(coefficients, times))
    for segment, time in ((0, 0.29), (0, 0.1), (1, 0.3), (1, 1.7), (1, 1.99)):
        knots = [times[segment]] * (degree + 1) + [times[segment + 1]] * (degree + 1)
        wanted = float(_exact(knots, coefficients[:, segment], degree, time))
        assert abs(plan(time) - wanted) <= 3e-14


def test_degree_of_a_spline_is_limited():
    for spline in (si.BPoly(np.ones((102, 1)), [0.0, 1.0]), si.BSpline([0.0] * 102 + [1.0] * 102, np.ones(102), 101)):
        with pytest.raises(ValueError, match="degree of the spline must be at most 100, got 101"):
            cp.as_trajectory(spline)


CONTINUITY = {
    **dict.fromkeys(["CubicSpline", "CubicSpline along the last axis", "periodic", "PPoly of a B-spline"], 2),
    **dict.fromkeys(["B-spline along the last axis", "B-spline, periodic", "B-spline, knots beyond"], 2),
    **dict.fromkeys(["pchip", "Akima", "BPoly"], 1),
    **{f"degree {k}": k - 1 for k in (1, 2, 3, 5)},
    **dict.fromkeys(["PPoly", "B-spline, steps"], -1),
    "B-spline, repeated knots": 0,
}
"""Highest continuous derivative: the degree less the multiplicity of the knots, Hermite data, or none."""


@pytest.mark.parametrize("name", SPLINES)
def test_continuity_is_that_of_the_spline(name):
    plan, order = cp.as_trajectory(SPLINES[name]), CONTINUITY[name]
    found = [jump for jump in plan.jumps(order + 1) if plan.start < jump.time < plan.end]
    assert {jump.order for jump in found} == {order + 1}
    assert {jump.time for jump in found} <= ({1.0} if name.endswith("repeated knots") else set(plan.breakpoints[1:-1]))


def test_periodic_splines_close():
    for name in ("periodic", "B-spline, periodic"):
        jet = cp.as_trajectory(SPLINES[name]).jet([KNOTS[0], KNOTS[-1]], 2)[:, 0]
        np.testing.assert_allclose(jet[:, 0], jet[:, 1], rtol=0, atol=1e-12 * np.abs(jet).max())


def test_breakpoints_are_the_knots_within():
    assert cp.as_trajectory(SPLINES["CubicSpline"]).breakpoints.tolist() == KNOTS.tolist()
    assert cp.as_trajectory(SPLINES["B-spline, knots beyond"]).breakpoints.tolist() == [3.0, 4.0, 5.0, 6.0]
    assert cp.as_trajectory(SPLINES["B-spline, repeated knots"]).breakpoints.tolist() == [0.0, 1.0, 2.0, 3.0]


def test_extrema_are_those_between_the_breakpoints():
    """Cubic hat: y = s^2 (3 - 2 s) on [0, 1], back on [1, 3]; extrema of the velocity are 3/2 and -3/4."""
    plan = cp.as_trajectory(si.CubicHermiteSpline([0.0, 1.0, 3.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]), signals="x")
    found = plan.extrema(1)
    np.testing.assert_allclose([found.maximum[0], found.time_max[0]], [1.5, 0.5], rtol=1e-12)
    np.testing.assert_allclose([found.minimum[0], found.time_min[0]], [-0.75, 2.0], rtol=1e-12)
    assert [(jump.order, jump.time) for jump in plan.jumps(2) if 0 < jump.time < 3] == [(2, 1.0)]


def test_part_of_a_spline():
    spline = SPLINES["CubicSpline"]
    part = cp.as_trajectory(spline, 0.25, 2.5, signals=["x", "z"])
    t = np.linspace(0.25, 2.5, 20)
    np.testing.assert_allclose(part(t, 1), spline(t, 1).T, rtol=0, atol=1e-12)
    assert (part.start, part.end, part.labels) == (0.25, 2.5, ("x", "z"))


@pytest.mark.parametrize("name", SPLINES)
def test_saved_and_pickled_are_equal(name, tmp_path):
    plan = cp.as_trajectory(SPLINES[name])
    plan.save(tmp_path / "plan.json")
    for again in (cp.load_trajectory(tmp_path / "plan.json"), pickle.loads(pickle.dumps(plan))):
        assert again.to_dict() == plan.to_dict()


def test_trajectory_is_itself():
    plan, step = cp.as_trajectory(SPLINES["PPoly"], signals=["x", "z"]), cp.Step(1.0)
    assert cp.as_trajectory(plan) is plan
    assert cp.as_trajectory(step) is step
    assert cp.as_trajectory(plan, 1.0, 2.0, signals="z").labels == ("z",)


# Flat plans


INTEGRATOR = fs.LinearFlatSystem(ct.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0))
BASES = {
    "PolyFamily": fs.PolyFamily(6, T=3.0),
    "odd PolyFamily": fs.PolyFamily(7, T=3.0),
    "BezierFamily": fs.BezierFamily(8, T=3.0),
    "BSplineFamily": fs.BSplineFamily([0.0, 1.5, 3.0], 5),
    "TrigFamily": cp.TrigFamily(8, 3.0, alpha=2.0),
    "odd TrigFamily": cp.TrigFamily(7, 3.0, alpha=4.0),
}
pytestmark = pytest.mark.filterwarnings("ignore:basis too small", "ignore:minimal basis")


def move(basis):
    return fs.point_to_point(INTEGRATOR, 3.0, [0, 0], [0], [2, 0.5], [1], basis=basis)


@pytest.mark.parametrize("name", BASES)
def test_flat_output_is_that_of_the_basis(name):
    traj = move(BASES[name])
    plan = cp.as_trajectory(traj, 0.0, 3.0)
    t = RNG.uniform(0.0, 3.0, 50)
    for nu in range(4):
        terms = np.array([c * traj.basis.eval_deriv(j, nu, t) for j, c in enumerate(traj.coeffs[0])])
        np.testing.assert_allclose(plan(t, nu), terms.sum(axis=0), rtol=0, atol=1e-11 * np.abs(terms).max())
    assert (plan.start, plan.end) == (0.0, 3.0)


def test_start_and_end_may_be_rounded():
    traj = move(cp.TrigFamily(6, 3.0, t0=0.0, alpha=1.0))
    plan = cp.as_trajectory(traj, 0.0, np.nextafter(3.0, 4.0))
    assert plan.end == 3.0


@pytest.mark.parametrize("basis", [fs.PolyFamily(1), fs.PolyFamily(2), cp.TrigFamily(1, 3.0, alpha=1.0)])
def test_smallest_bases(basis):
    coeffs = [1.5, -0.25][: basis.N]
    plan = cp.as_trajectory(fs.SystemTrajectory(INTEGRATOR, basis, [coeffs], [3]), 0.0, 3.0)
    t = np.linspace(0.0, 3.0, 7)
    np.testing.assert_allclose(plan(t), basis.eval(coeffs, t), rtol=0, atol=1e-14)


@pytest.mark.parametrize("alpha", [1e-6, 3.0, 6.0])
def test_large_bases(alpha):
    """Random coefficients, two flat outputs with different numbers of functions."""
    basis = cp.TrigFamily([16, 19], 3.0, t0=1.0, alpha=alpha, vars=2)
    coeffs = [RNG.normal(size=n) for n in (16, 19)]
    plan = cp.as_trajectory(fs.SystemTrajectory(car(), basis, coeffs, [3, 3]))
    t = np.linspace(1.0, 4.0, 50)
    for axis in range(2):
        for nu in range(3):
            wanted = sum(c * basis.eval_deriv(j, nu, t, var=axis) for j, c in enumerate(coeffs[axis]))
            np.testing.assert_allclose(plan(t, nu)[axis], wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


def test_kinds_of_flat_plans():
    kinds = {name: type(cp.as_trajectory(move(basis), 0.0, 3.0)).__name__ for name, basis in BASES.items()}
    assert set(kinds.values()) == {"PolySpline", "PiecewisePolynomial", "TrigSpline"}
    assert kinds["TrigFamily"] == "TrigSpline"
    assert cp.as_trajectory(move(BASES["TrigFamily"])).end == 3.0
    part = cp.as_trajectory(move(BASES["TrigFamily"]), 1.0, 2.0)
    assert (part.start, part.end) == (1.0, 2.0)


def car():
    """Kinematic car with flat outputs x and y; theta and the steering angle follow."""

    def forward(x, u, params):
        flag = [np.zeros(3), np.zeros(3)]
        flag[0][:2] = x[0], u[0] * np.cos(x[2])
        flag[1][:2] = x[1], u[0] * np.sin(x[2])
        turn = u[0] / 3.0 * np.tan(u[1])
        flag[0][2], flag[1][2] = -flag[1][1] * turn, flag[0][1] * turn
        return flag

    def reverse(flag, params):
        speed, angle = np.hypot(flag[0][1], flag[1][1]), np.arctan2(flag[1][1], flag[0][1])
        turn = (flag[1][2] * np.cos(angle) - flag[0][2] * np.sin(angle)) / speed
        return np.array([flag[0][0], flag[1][0], angle]), np.array([speed, np.arctan2(3.0 * turn, speed)])

    return fs.FlatSystem(forward, reverse, states=["x", "y", "theta"], inputs=["v", "delta"], outputs=2)


@pytest.mark.parametrize(("degree", "smoothness"), [(5, 4), (5, 3), (5, 2), (3, 0), (13, 9)])
def test_flat_outputs_in_b_splines_of_any_smoothness(degree, smoothness):
    """python-control cannot derive them `degree` times where knots repeat."""
    system = ct.ss([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], 0)
    breaks = [0.0, 0.3, 2.0]
    basis = fs.BSplineFamily(breaks, degree, smoothness)
    coefficients = np.random.default_rng(1).normal(size=basis.var_ncoefs(0))
    plan = cp.as_trajectory(fs.SystemTrajectory(fs.LinearFlatSystem(system), basis, [coefficients], [3]))
    t = np.linspace(0.0, 1.99, 101)
    terms = [c * basis.eval_deriv(j, 0, t) for j, c in enumerate(coefficients)]
    np.testing.assert_allclose(plan(t), np.sum(terms, axis=0), rtol=0, atol=3e-14)
    assert set(breaks) <= set(plan.breakpoints)


def test_states_that_python_control_cannot_evaluate():
    system = ct.ss([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], 0)
    basis = fs.BSplineFamily([0.0, 0.3, 2.0], 3, 0)
    plan = fs.SystemTrajectory(fs.LinearFlatSystem(system), basis, [np.ones(7)], [3])
    with pytest.raises(ValueError, match=r"must be defined by the plan, got .*; use the flat outputs"):
        cp.as_trajectory(plan, signals="x[0]")


@pytest.fixture(scope="module")
def lane_change():
    basis = fs.BSplineFamily([0, 5, 10], [5, 6], vars=2)
    return fs.point_to_point(car(), 10, [0, -2, 0], [10, 0], [100, 2, 0], [10, 0], basis=basis)


@pytest.mark.slow
def test_flat_outputs_of_different_degrees(lane_change):
    plan = cp.as_trajectory(lane_change)
    t = RNG.uniform(0.0, 10.0, 40)
    np.testing.assert_allclose(plan(t), lane_change.eval(t)[0][:2], rtol=0, atol=1e-10)
    assert plan.labels == ("y1", "y2")
    assert plan.breakpoints.tolist() == [0.0, 5.0, 10.0]


@pytest.mark.slow
def test_states_and_inputs_within_the_deviation_stated(lane_change):
    plan = cp.as_trajectory(lane_change, signals=["theta", "delta"])
    assert plan.labels == ("theta", "delta")
    t = np.sort(RNG.uniform(0.0, 10.0, 100))
    states, inputs = lane_change.eval(t)
    for name, row, wanted, stated in zip(plan.labels, plan(t), (states[2], inputs[1]), plan.deviation, strict=True):
        error = np.abs(row - wanted).max()
        assert 0.0 < stated <= 1e-6 * np.ptp(wanted), name
        assert error <= 2.0 * stated, name  # measured in the middle of the samples, where it is largest but at ends
    assert cp.trajectory_from_dict(plan.to_dict()).deviation.tolist() == plan.deviation.tolist()
    assert "deviation of theta" in str(plan)
    assert [jump for jump in plan.jumps(0) if plan.start < jump.time < plan.end] == []


def straight(*x):
    """Motion along the x axis by a polynomial of time."""
    return fs.SystemTrajectory(car(), fs.PolyFamily(3), [np.array(x), np.zeros(3)], [3, 3])


def test_constant_signals_are_resolved():
    plan = cp.as_trajectory(straight(0.0, 10.0, 0.0), 0.0, 7.0, signals=["theta", "v"])
    np.testing.assert_allclose(plan([0.0, 3.0, 7.0]), [[0.0] * 3, [10.0] * 3], rtol=0, atol=1e-13)


def test_flat_labels_of_the_flat_system():
    motor = cp.plants.dc_motor()
    angle = motor.flat_labels[0]
    rest = [np.zeros(n) for n in (motor.nstates, motor.ninputs)]
    goal = motor.reverse([np.array([1.0, *[0.0] * (motor.orders[0])])], {})
    traj = fs.point_to_point(motor, 2.0, *rest, *goal, basis=cp.TrigFamily(8, 2.0, alpha=1.0))
    plan = cp.as_trajectory(traj, signals=angle)
    assert plan.labels == (angle,)
    np.testing.assert_allclose(plan([0.0, 2.0]), [0.0, 1.0], rtol=0, atol=1e-9)


# Results of optimal control


def result(count=21, **changes):
    """Object with the attributes of an OptimalControlResult, and known states."""
    t = np.linspace(0.0, 2.0, count)
    system = ct.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0, states=["p", "v"], inputs=["a"])
    given = {"time": t, "states": np.array([np.sin(t), np.cos(t)]), "inputs": -np.sin(t), "success": True}
    return SimpleNamespace(problem=SimpleNamespace(system=changes.pop("system", system)), **(given | changes))


@pytest.mark.parametrize("count", [6, 11, 21])
def test_error_between_samples_is_below_the_deviation(count):
    plan = cp.as_trajectory(result(count))
    t = np.linspace(0.0, 2.0, 401)
    error = np.abs(plan(t) - [np.sin(t), np.cos(t)]).max(axis=1)
    assert (error <= plan.deviation).all()
    assert (plan.deviation < 100 * error).all()
    assert [jump for jump in plan.jumps(2) if plan.start < jump.time < plan.end] == []


def test_a_part_states_the_deviation_of_the_whole():
    found = result()
    whole, part = cp.as_trajectory(found), cp.as_trajectory(found, 0.5, 1.0)
    assert part.duration == 0.5
    assert whole.deviation.any()
    assert part.deviation.tolist() == whole.deviation.tolist()
    assert cp.trajectory_from_dict(part.to_dict()).deviation.tolist() == whole.deviation.tolist()
    assert part.shift(1.0).deviation.tolist() == whole.deviation.tolist()
    assert f"deviation of {whole.labels[0]}" in str(part)
    with pytest.raises(AttributeError, match="a part of a SCurve, which interpolates no signals, has no deviation"):
        _ = cp.as_trajectory(cp.SCurve(1.0, velocity=1.0, acceleration=1.0, jerk=1.0), 0.5, 1.0).deviation


def test_inputs_are_linear_between_samples():
    found = result()
    plan = cp.as_trajectory(found, signals=["a", "v"])
    t = np.linspace(0.0, 2.0, 173)
    np.testing.assert_allclose(plan(t)[0], np.interp(t, found.time, found.inputs), rtol=0, atol=1e-15)
    assert plan.deviation[0] == 0.0
    assert plan.deviation[1] > 0.0
    inner = {(jump.order, jump.label) for jump in plan.jumps(2) if plan.start < jump.time < plan.end}
    assert inner == {(1, "a")}  # the input is continuous, the state twice differentiable


@pytest.mark.slow
def test_result_of_python_control():
    system = ct.ss([[0, 1], [0, 0]], [[0], [1]], np.eye(2), 0, name="axle")
    cost = opt.quadratic_cost(system, np.zeros((2, 2)), 1.0)
    final = opt.quadratic_cost(system, 10.0 * np.eye(2), 0.0, x0=[1.0, 0.0])
    found = opt.solve_optimal_trajectory(
        system,
        np.linspace(0.0, 2.0, 5),
        [0.0, 0.0],
        cost,
        terminal_cost=final,
        trajectory_method="shooting",
        minimize_method="SLSQP",
        solve_ivp_kwargs={"rtol": 1e-8, "atol": 1e-8},
    )
    plan = cp.as_trajectory(found, signals=["x[0]", "u[0]"])
    np.testing.assert_allclose(plan(found.time)[0], np.asarray(found.states)[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(plan(found.time)[1], np.ravel(found.inputs), rtol=0, atol=1e-12)
    # Between samples python-control's states are the response to the linear input.
    dense = np.linspace(0.0, 2.0, 201)
    exact = ct.forced_response(system, dense, np.interp(dense, found.time, np.ravel(found.inputs)), [0.0, 0.0])
    assert np.abs(plan(dense)[0] - np.asarray(exact.states)[0]).max() <= plan.deviation[0] + 1e-6


def test_unsuccessful_result_warns():
    with pytest.warns(UserWarning, match="the optimisation must have succeeded, got: Iteration limit"):
        cp.as_trajectory(result(success=False, message="Iteration limit"))


# Bad input


class Exponentials(fs.BasisFamily):
    def eval_deriv(self, i, k, t, var=None):
        return (-float(i)) ** k * np.exp(-i * np.asarray(t))


CASES = {
    "number": (lambda: cp.as_trajectory(3.0), TypeError, "obj must be a PPoly.*got float"),
    "tck": (lambda: cp.as_trajectory(si.splrep(KNOTS, CLOSED)), TypeError, r"use BSpline\(\*tck\)"),
    "matrices": (
        lambda: cp.as_trajectory(si.CubicSpline(KNOTS, np.zeros((7, 2, 2)))),
        ValueError,
        "vectors, got shape",
    ),
    "complex": (lambda: cp.as_trajectory(si.CubicSpline(KNOTS, 1j * CLOSED)), TypeError, "coefficients must be real"),
    "nan": (lambda: cp.as_trajectory(si.PPoly([[np.nan, 1.0]], [0, 1, 2])), ValueError, "coefficients must be finite"),
    "decreasing": (lambda: cp.as_trajectory(si.PPoly([[1.0, 1.0]], [2, 1, 0])), ValueError, "increase strictly"),
    "labels": (lambda: cp.as_trajectory(SPLINES["PPoly"], signals="x"), ValueError, "one per axis, 2, got 1"),
    "outside": (lambda: cp.as_trajectory(SPLINES["PPoly"], -1.0), ValueError, "from 0 s to 4 s, got -1 s and 4 s"),
    "reversed": (lambda: cp.as_trajectory(SPLINES["PPoly"], 3.0, 2.0), ValueError, "must increase and lie within"),
    "no times": (lambda: cp.as_trajectory(move(BASES["PolyFamily"])), ValueError, "start and end must be given"),
    "one time": (lambda: cp.as_trajectory(move(BASES["BezierFamily"]), 0.0), ValueError, "got 0.0 and None"),
    "reversed flat": (lambda: cp.as_trajectory(move(BASES["PolyFamily"]), 3.0, 0.0), ValueError, "must increase"),
    "outside of the basis": (
        lambda: cp.as_trajectory(move(BASES["TrigFamily"]), 0.0, 3.5, signals="x[0]"),
        ValueError,
        "from 0 s to 3 s, got 0 s and 3.5 s",
    ),
    "another basis": (
        lambda: cp.as_trajectory(move(Exponentials(6)), 0.0, 3.0),
        ValueError,
        "polynomials, B-splines or a TrigFamily, got Exponentials",
    ),
    "no signal": (lambda: cp.as_trajectory(move(BASES["TrigFamily"]), signals=[]), ValueError, "at least one signal"),
    "unknown signal": (
        lambda: cp.as_trajectory(move(BASES["TrigFamily"]), signals="torque"),
        ValueError,
        "signals must be among the states and inputs .*got 'torque'",
    ),
    "unknown state": (lambda: cp.as_trajectory(result(), signals="q"), ValueError, "p, v, a, got 'q'"),
    "few samples": (lambda: cp.as_trajectory(result(4)), ValueError, "five or more samples"),
    "shape": (lambda: cp.as_trajectory(result(states=np.zeros((21, 2)))), ValueError, r"shape \(2, 21\), got"),
    "no states": (lambda: cp.as_trajectory(result(states=None)), ValueError, "states of the result must be finite"),
    "discrete": (
        lambda: cp.as_trajectory(result(system=ct.ss([[1]], [[1]], [[1]], 0, 0.1))),
        ValueError,
        "continuous time, got the sampling period 0.1",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_input(name):
    call, error, match = CASES[name]
    with pytest.raises(error, match=match):
        call()


def test_states_that_are_not_finite_are_rejected():
    """The car is at rest at 10 s, a sample."""
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(ValueError, match="finite over the plan, got nan or inf between 5"),
    ):
        cp.as_trajectory(straight(0.0, 10.0, -0.5), 5.0, 15.0, signals=["delta"])


@pytest.mark.slow
def test_states_that_are_not_resolved_are_rejected():
    """The heading jumps by pi as the car reverses, between samples."""
    with pytest.raises(ValueError, match=r"resolved to 1e-06 of their range, got a deviation of .* of theta with"):
        cp.as_trajectory(straight(0.0, 10.0, -0.5), 4.0, 15.3, signals=["x", "theta"])


BAD = [
    ({"breakpoints": [0.0]}, "breakpoints must be two or more"),
    ({"breakpoints": [0.0, 1.0, 1.0]}, "increase strictly"),
    ({"breakpoints": [0.0, np.inf]}, "finite times"),
    ({"coefficients": [[1.0]]}, r"shape \(degree \+ 1, 1, naxes\)"),
    ({"coefficients": [[[np.inf]]]}, "coefficients must be finite, got inf for the power 0 of axis 0"),
    ({"deviation": [-1.0]}, "deviation must be 1 numbers of at least 0"),
    ({"deviation": [0.0, 1.0]}, "one per axis"),
]


@pytest.mark.parametrize(("changes", "match"), BAD)
def test_bad_coefficients(changes, match):
    given = {"breakpoints": [0.0, 1.0], "coefficients": [[[1.0]]]} | changes
    with pytest.raises(ValueError, match=match):
        cp.trajectories.PiecewisePolynomial(**given)
