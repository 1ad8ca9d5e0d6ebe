"""Loops of flat plants from a plan and a law; states and inputs for controllers of other kinds."""

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp, trapezoid
from scipy.interpolate import CubicSpline

pytest.importorskip("casadi")

from flat_plants import CASES, car, system

import ctrlplan as cp

FAST, SLOW = [-2.0, -2.5, -3.0, -3.5], [-2.0, -3.0]
LANE = cp.PolySpline(
    [cp.Waypoint.from_jets(0.0, x=[0, 10, 0], y=[0, 0, 0]), cp.Waypoint.from_jets(4.0, x=[40, 10, 0], y=[3.5, 0, 0])]
)
CAR = cp.flat_system(car, ["x", "y"], at={"v": 1.0})
MOTOR = cp.plants.dc_motor()
TURN = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(1, 2, 0, 0, 0)], labels="angle")


def crane(**options):
    return cp.flat_system(
        cp.plants.Crane().iosystem(wind=True), ["x", "z"], inputs=["F", "C"], at={"R": 10.0}, **options
    )


def table(plan):
    """States and inputs of the car along a plan, interpolated between a thousand samples, as a function of time."""
    t = np.linspace(plan.start, plan.end, 1001)
    return CubicSpline(t, np.concatenate(CAR.states_and_inputs(plan, t)), axis=1)


def lift():
    rest = [0.0] * 4
    ends = [(0.0, [0.0, *rest], [10.0, *rest]), (15.0, [20.0, *rest], [11.0, *rest])]
    return cp.PolySpline([cp.Waypoint.from_jets(t, x=x, z=z) for t, x, z in ends])


@pytest.mark.slow
def test_the_loop_starts_on_the_plan_and_stays_on_it():
    plan, t = lift(), np.linspace(0.0, 17.0, 18)
    loop = cp.flat_loop(crane(), plan, poles=[FAST, FAST], disturbances="wind")
    assert loop.input_labels == ["wind"]
    assert {"x", "z", "R", "theta", "T", "F", "C"} <= set(loop.output_labels)
    found = cp.simulate(loop, t, np.zeros((1, t.size)))
    for name, row in zip(("x", "z"), plan(t), strict=True):
        np.testing.assert_allclose(found.outputs[name], row, atol=1e-6)
    windy = cp.simulate(loop, t, np.full((1, t.size), 50.0))
    assert abs(windy.outputs["x"][-1] - 20.0) > 1e-3  # a constant force leaves an error without integral action


@pytest.mark.slow
def test_a_plant_with_maps_of_its_own():
    loop = cp.flat_loop(MOTOR, TURN, poles=[-20, -25, -30])
    t = np.linspace(0.0, 1.2, 13)
    np.testing.assert_allclose(cp.simulate(loop, t).outputs["angle"], TURN(t), atol=1e-7)
    limited = cp.flat_loop(MOTOR, TURN, law=cp.FlatLaw([-20, -25, -30]), limits={"voltage": 3.0})
    assert np.abs(cp.simulate(limited, t).outputs["voltage"]).max() <= 3.0


@pytest.mark.slow
def test_feedforward_alone_follows_the_plan_from_its_start():
    loop = cp.flat_loop(CAR, LANE, law=cp.Feedforward())
    t = np.linspace(0.0, 4.0, 21)
    found = cp.simulate(loop, t)
    np.testing.assert_allclose([found.outputs["x"], found.outputs["y"]], LANE(t), atol=1e-5)


@pytest.mark.slow
def test_riccati_gains_minimise_the_cost_of_the_linearised_plant():
    """The cost of a run of the linearised plant is e0' P(0) e0, and larger with other gains."""
    q, r, final = np.diag([1.0, 1.0, 10.0]), np.diag([1.0, 10.0]), np.diag([1.0, 1.0, 10.0])
    gain, _ = cp.TVLQR(q, r, final).gains(CAR, LANE)
    e0 = np.array([0.1, -0.2, 0.03])

    along = table(LANE)

    def slopes(t):
        """Jacobians of the car by hand."""
        _, _, th, v, delta = along(t)
        a = np.array([[0, 0, -v * np.sin(th)], [0, 0, v * np.cos(th)], [0, 0, 0]])
        b = [[np.cos(th), 0.0], [np.sin(th), 0.0], [np.tan(delta) / 3.0, v / 3.0 / np.cos(delta) ** 2]]
        return a, np.array(b)

    def cost(factor):
        def rate(t, state):
            e = state[:3]
            a, b = slopes(t)
            v = -factor * gain(t) @ e
            return [*(a @ e + b @ v), e @ q @ e + v @ r @ v]

        end = solve_ivp(rate, (0.0, 4.0), [*e0, 0.0], rtol=1e-6, atol=1e-9).y[:, -1]
        return end[3] + end[:3] @ final @ end[:3]

    def riccati(t, p):
        a, b = slopes(t)
        p = p.reshape(3, 3)
        return -(a.T @ p + p @ a - p @ b @ np.linalg.inv(r) @ b.T @ p + q).ravel()

    first = solve_ivp(riccati, (4.0, 0.0), final.ravel(), rtol=1e-7, atol=1e-9).y[:, -1].reshape(3, 3)
    best = cost(1.0)
    assert best == pytest.approx(e0 @ first @ e0, rel=1e-4)
    assert best < min(cost(0.8), cost(1.2))


@pytest.mark.slow
def test_riccati_law_returns_a_car_to_its_lane():
    law = cp.TVLQR(np.diag([1.0, 1.0, 10.0]), np.diag([1.0, 10.0]), final=np.diag([1.0, 1.0, 10.0]))
    loop = cp.flat_loop(CAR, LANE, law=law, initial_state=[0.0, 0.3, 0.0])
    t = np.linspace(0.0, 4.0, 21)
    off = np.abs(cp.simulate(loop, t).outputs["y"] - LANE(t)[1])
    assert off[-1] < 0.02 * off[0]
    with pytest.raises(ValueError, match="final must be given for car"):
        cp.flat_loop(CAR, LANE, law=cp.TVLQR(np.eye(3), np.eye(2)))
    for wrong in (
        cp.TVLQR(np.eye(2), np.eye(2)),
        cp.TVLQR(np.eye(3), np.zeros((2, 2))),
        cp.TVLQR(-np.eye(3), np.eye(2)),
    ):
        with pytest.raises(ValueError, match=r"(Q|R) must"):
            cp.flat_loop(CAR, LANE, law=wrong)


@pytest.mark.slow
def test_riccati_gains_of_maps_by_formulas_are_those_of_the_equations():
    """The motor is linear: the stationary gain is that of its matrices."""
    R, L, K, J, b = 1.0, 0.5, 0.01, 0.01, 0.1
    a = [[0, 1, 0], [0, -b / J, K / J], [0, -K / L, -R / L]]
    gain, after = cp.TVLQR(np.eye(3), np.eye(1)).gains(MOTOR, TURN)
    known = ct.lqr(np.array(a), np.array([[0.0], [0.0], [1.0 / L]]), np.eye(3), np.eye(1))[0]
    np.testing.assert_allclose(after, known, rtol=1e-9)
    np.testing.assert_allclose(gain(0.5), known, rtol=1e-6)
    loop = cp.flat_loop(MOTOR, TURN, law=cp.TVLQR(np.eye(3), np.eye(1)))
    np.testing.assert_allclose(cp.simulate(loop, [0.0, 0.5, 1.0]).outputs["angle"], TURN([0.0, 0.5, 1.0]), atol=1e-6)


def test_after_the_end_the_stationary_gain_is_used():
    case = CASES["two masses"]
    flat = cp.flat_system(case.plant, "x2")
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0, 0, 0)], labels="x2")
    _, after = cp.TVLQR(np.eye(4), np.eye(1)).gains(flat, plan)
    a, b = flat.linearised(*flat.states_and_inputs(plan, 5.0))
    np.testing.assert_allclose(after, ct.lqr(a, b, np.eye(4), np.eye(1))[0], rtol=1e-8)


@pytest.mark.slow
def test_states_and_inputs_for_a_state_feedback_of_python_control():
    """The car with gains by python-control's create_statefbk_iosystem, from a start off the lane."""
    block = cp.create_flat_feedforward_iosystem(CAR)
    plant = ct.nlsys(car.updfcn, None, states=car.state_labels, inputs=car.input_labels, outputs=3, name="car")
    x, u = CAR.states_and_inputs(LANE, 0.0)
    gain = ct.lqr(*CAR.linearised(x, u), np.diag([1.0, 1.0, 10.0]), np.diag([1.0, 10.0]))[0]
    controller, _ = ct.create_statefbk_iosystem(plant, gain, xd_labels="xd[{i}]", ud_labels="ud[{i}]")
    source = cp.create_source_iosystem(LANE, 2, suffix="_ref")
    loop = ct.interconnect([source, block, controller, plant], inputs=0, outputs=plant.output_labels, name="loop")
    t = np.linspace(0.0, 4.0, 21)
    found = cp.simulate(loop, t, initial_state=[0.0, 0.0, 0.0])
    np.testing.assert_allclose(found.outputs[:2], LANE(t), atol=1e-5)
    off = cp.simulate(loop, t, initial_state=[0.0, 0.3, 0.0])
    assert abs(off.outputs[1, -1] - LANE(4.0)[1]) < 0.02


def test_a_window_ahead():
    x, u = cp.reference_window(LANE, 0.5, 0.1, 10, flat=CAR)
    assert (x.shape, u.shape) == ((3, 11), (2, 10))
    known = CAR.states_and_inputs(LANE, 0.5 + 0.1 * np.arange(11))
    np.testing.assert_array_equal(x, known[0])
    np.testing.assert_array_equal(u, known[1][:, :-1])
    np.testing.assert_array_equal(cp.reference_window(LANE, 3.9, 0.1, 3), LANE.jet(3.9 + 0.1 * np.arange(4), 2))
    after, _ = cp.reference_window(TURN, 0.95, 0.1, 3, flat=MOTOR)
    np.testing.assert_allclose(after[0, 1:], 2.0, rtol=1e-12)
    assert cp.reference_window(LANE, 0.0, 0.01, 400, flat=CAR)[0].shape == (3, 401)
    for wrong in ({"dt": 0.0}, {"count": 0}, {"count": 10_000_000}, {"time": np.nan}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            cp.reference_window(LANE, **{"time": 0.0, "dt": 0.1, "count": 3, **wrong})


@pytest.mark.slow
def test_bad_arguments_of_a_loop():
    with pytest.raises(TypeError, match="one of poles and law"):
        cp.flat_loop(MOTOR, TURN)
    with pytest.raises(TypeError, match="one of poles and law"):
        cp.flat_loop(MOTOR, TURN, poles=[-1, -2, -3], law=cp.Feedforward())
    with pytest.raises(TypeError, match="law must be"):
        cp.flat_loop(MOTOR, TURN, law="lqr")
    with pytest.raises(ValueError, match="initial_state"):
        cp.flat_loop(MOTOR, TURN, poles=[-1, -2, -3], initial_state=[0.0])
    with pytest.raises(ValueError, match="disturbances must be among"):
        cp.flat_loop(crane(), lift(), poles=[FAST, FAST], disturbances="rain")
    with pytest.raises(ValueError, match="axes"):
        cp.flat_loop(MOTOR, cp.PolySpline(TURN.waypoints, labels="speed"), poles=[-1, -2, -3])
    with pytest.raises(ValueError, match="limits must"):
        cp.flat_loop(MOTOR, TURN, poles=[-20, -25, -30], limits={"i": 1.0})


@pytest.mark.slow
@pytest.mark.parametrize("law", [cp.FlatLaw([-20, -25, -30]), cp.Feedforward(), cp.TVLQR(np.eye(3), np.eye(1))])
def test_a_step_is_rejected(law):
    with pytest.raises(ValueError, match=r"plan must be continuous .* got a step of angle by 2 at 0\.3 s; give a plan"):
        cp.flat_loop(MOTOR, cp.Step(2.0, time=0.3, labels="angle"), law=law)


def test_a_set_point_is_a_plan_at_rest():
    """The error is that of a chain of integrators with the poles of the law."""
    rest = cp.PolySpline([cp.Waypoint(0, 2.0, 0, 0), cp.Waypoint(1, 2.0, 0, 0)], labels="angle")
    t, p = np.linspace(0.0, 1.5, 16), np.array([-20.0, -25.0, -30.0])
    loop = cp.flat_loop(MOTOR, rest, law=cp.FlatLaw(p), initial_state=[0.0, 0.0, 0.0])
    c = np.linalg.solve(np.vander(p, 3, increasing=True).T, [-2.0, 0.0, 0.0])
    np.testing.assert_allclose(cp.simulate(loop, t).outputs["angle"], 2.0 + np.exp(np.outer(t, p)) @ c, atol=1e-6)


@pytest.mark.slow
def test_equality_with_zero_is_no_switch():
    """A law evaluates elsewhere where all its inputs are 0: this makes no breakpoints where one of them crosses 0."""
    flat = crane()
    loop = cp.flat_loop(flat, lift(), poles=[FAST, FAST])
    short = cp.simulate(loop, [0.0, 0.1], method="compiled")
    np.testing.assert_allclose(short.outputs["x"], lift()([0.0, 0.1])[0], atol=1e-9)
    toggled = system("toggled", "x", "u", lambda x, u: [np.where(u == 0.0, 1.0, 0.0) - x])
    t = np.linspace(-1.0, 1.0, 21)
    found = cp.simulate(toggled, t, t, method="compiled")
    np.testing.assert_allclose(found.outputs[0], 0.0, atol=1e-7)


@pytest.mark.parametrize("size", [1.0, 1e-12])
@pytest.mark.parametrize(
    ("q", "message"),
    [
        ([[1.0, 1.0], [0.0, 1.0]], r"Q must be symmetric, got .* at \[0, 1\] and 0 at \[1, 0\]"),
        ([[1.0, np.nan], [np.nan, 1.0]], "Q must be finite, got nan or inf"),
        (np.eye(3), r"Q must be a symmetric matrix of shape \(2, 2\), got shape \(3, 3\)"),
    ],
)
def test_weights_that_are_not_symmetric_or_finite(q, message, size):
    plant = ct.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0, inputs="F", outputs="y", states=["p", "v"], name="cart")
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], labels=["p"])
    law = cp.TVLQR(size * np.asarray(q), [[1.0]])
    with pytest.raises(ValueError, match=message):
        cp.flat_loop(cp.flat_system(plant, "p"), plan, law=law)


@pytest.mark.slow
def test_a_law_of_measured_outputs_with_an_observer_of_python_control():
    """Positions of two masses are measured; an estimator by `create_estimator_iosystem` gives the law its states.

    The estimator is stationary, P its covariance, and starts at the
    state of the plan, the plant 0.1 m from it.
    """
    states = ["x1", "v1", "x2", "v2"]
    a = np.array([[0, 1, 0, 0], [-50, 0, 50, 0], [0, 0, 0, 1], [25, 0, -25, 0]])
    b, c = np.array([[0.0], [1.0], [0.0], [0.0]]), np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])
    plant = ct.ss(a, b, c, 0.0, states=states, inputs="u", outputs=["m1", "m2"], name="two_masses")
    noise, measured = 10.0 * np.eye(4), 1e-3 * np.eye(2)
    covariance = ct.lqe(a, np.eye(4), c, noise, measured)[1]
    estimator = ct.create_estimator_iosystem(
        ct.ss(a, np.hstack([b, np.eye(4)]), c, 0.0, inputs=["u", *(f"w{k}" for k in range(4))], outputs=["m1", "m2"]),
        noise,
        measured,
        P0=covariance,
        control_indices=["u"],
        disturbance_indices=[f"w{k}" for k in range(4)],
        estimate_labels="{i}",
        measurement_labels=["m1", "m2"],
        control_labels=["u"],
    )
    flat = cp.flat_system(plant, "x2")
    law = cp.create_flat_iosystem(flat, [-2.0, -2.5, -3.0, -3.5])
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0, 0, 0)], labels="x2")
    source = cp.create_source_iosystem(plan, 4, suffix="_ref", name="plan")
    renamed = dict(zip(estimator.output_labels, states, strict=True))
    estimator.set_outputs([renamed[name] for name in estimator.output_labels])
    loop = ct.interconnect([source, law, estimator, plant], inputs=0, outputs=["m1", "m2", "u"], name="loop")
    start = np.array([0.1, 0.0, 0.1, 0.0])
    first = np.concatenate([np.zeros(4), covariance.ravel(), start])
    found = cp.simulate(loop, np.linspace(0.0, 15.0, 151), initial_state=first)
    error = found.outputs["m2"] - plan(found.time)
    assert error[0] == pytest.approx(0.1)
    assert np.abs(error[-1]) < 1e-5
    free = np.concatenate([np.zeros(4), covariance.ravel(), np.zeros(4)])
    exact = cp.simulate(loop, np.linspace(0.0, 2.5, 26), initial_state=free, rtol=1e-9)
    np.testing.assert_allclose(exact.outputs["m2"], plan(exact.time), atol=1e-6)


@pytest.mark.slow
def test_riccati_law_costs_no_more_than_gains_scheduled_on_speed():
    """Terminal cost included, from a start off by 1 % of the move, along a bend on which the car accelerates.

    Gains over speed are those of a straight line, in the frame of the car, as in
    python-control's example of gain scheduling.
    """
    q, r, final = np.diag([1.0, 1.0, 10.0]), np.diag([1.0, 10.0]), np.diag([1.0, 1.0, 10.0])
    ends = [(0.0, [0, 2, 0, 0], [0, 0, 0, 0]), (6.0, [40, 10, 0, 0], [8, 3, 0, 0])]
    plan = cp.PolySpline([cp.Waypoint.from_jets(t, x=x, y=y) for t, x, y in ends])
    speeds = np.linspace(1.0, 15.0, 29)
    straight = [(np.array([[0, 0, 0], [0, 0, v], [0, 0, 0]]), np.array([[1, 0], [0, 0], [0, v / 3.0]])) for v in speeds]
    gains = np.array([ct.lqr(*slopes, q, r)[0] for slopes in straight])

    along = table(plan)

    def scheduled(t, x, u, p):
        states, inputs = np.split(along(t), [3])
        c, s = np.cos(states[2]), np.sin(states[2])
        frame = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        k = int(np.argmin(np.abs(speeds - inputs[0])))
        return inputs - gains[k] @ frame @ (np.asarray(u) - states)

    block = ct.nlsys(None, scheduled, inputs=CAR.state_labels, outputs=CAR.input_labels, name="law")
    names = ["x", "y", "th", "v", "delta"]
    theirs = ct.interconnect([block, car], inputs=0, outputs=names, name="scheduled")
    start = CAR.states_and_inputs(plan, 0.0)[0] + [0.0, 0.4, 0.0]
    ours = cp.flat_loop(CAR, plan, law=cp.TVLQR(q, r, final=final), initial_state=start)
    t = np.linspace(0.0, 6.0, 121)
    wanted = np.concatenate(CAR.states_and_inputs(plan, t))
    costs = []
    for loop in (ours, theirs):
        found = cp.simulate(loop, t, initial_state=start, rtol=1e-6)
        e = np.array([found.outputs[name] for name in names]) - wanted
        rates = np.einsum("it,ij,jt->t", e[:3], q, e[:3]) + np.einsum("it,ij,jt->t", e[3:], r, e[3:])
        costs.append(trapezoid(rates, t) + e[:3, -1] @ final @ e[:3, -1])
    assert costs[0] <= costs[1]


@pytest.mark.slow
def test_payloads_in_a_monte_carlo():
    """Draws of the payload are parameters of the plant, not of the law, which has no integral action here."""
    rest = [0.0] * 4
    ends = [(0.0, [0.0, *rest], [10.0, *rest]), (8.0, [6.0, *rest], [11.0, *rest])]
    plan = cp.PolySpline([cp.Waypoint.from_jets(t, x=x, z=z) for t, x, z in ends])
    flat = cp.flat_system(cp.plants.Crane().iosystem(), ["x", "z"], at={"R": 10.0})

    def loop(name, plan):
        return cp.flat_loop(flat, plan, poles=[FAST, FAST])

    found = cp.monte_carlo(
        loop,
        {"load_mass": np.array([490.0, 500.0, 510.0])},
        {"plan": plan},
        np.linspace(0.0, 12.0, 61),
        outputs=["x", "z"],
        controls=["F", "C"],
        progress=False,
    )
    assert found.finished == 3
    assert not found.failures
    errors = found.metrics["plan"]["iae_z"]
    assert errors[1] < 1e-6 < 0.1 < min(errors[0], errors[2])
