"""States and inputs of vehicles along a path with stops, against closed forms; plants that reject it."""

import control as ct
import control.flatsys as fs
import numpy as np
import pytest
from parking import BACKWARD, FORWARD, WHEELBASE, by_hand, curve, expected, law, parking

pytest.importorskip("casadi")

from flat_plants import CASES, car, car_rate, system, trailer, two_trailers, unicycle

import ctrlplan as cp
from ctrlplan.flatness.quantities import quantities_of_flat_system

PLAN = parking()
T = np.concatenate([np.linspace(-1.0, 12.0, 53), PLAN.stops])
CAR, RATE = (cp.flat_system(plant, ["x", "y"], at={"v": 1.0}) for plant in (car, car_rate))
LINE = cp.PolySpline([cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(4, [4, 3], 0, 0)], labels=["x", "y"])


@pytest.mark.parametrize("flat", [CAR, RATE, by_hand(), by_hand("quotient")], ids=["car", "rate", "atan2", "quotient"])
def test_cars_have_finite_states_and_inputs_at_the_stops(flat):
    x, u = flat.states_and_inputs(PLAN, T)
    theta, speed, delta, rate = expected(PLAN, T)
    states = [*PLAN(T), theta, *([delta] if flat is RATE else [])]
    np.testing.assert_allclose(x, states, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(u, [speed, rate if flat is RATE else delta], rtol=1e-9, atol=1e-10)
    assert (u[0, -3:] == 0.0).all()  # at rest to the last bit
    one, inputs = flat.states_and_inputs(PLAN, 5.0)
    np.testing.assert_allclose(one, x[:, -2], rtol=1e-13, atol=1e-13)
    assert inputs.shape == (2,)
    x, u = flat.states_and_inputs(PLAN, [])
    assert (x.shape, u.shape) == ((flat.nstates, 0), (2, 0))
    assert flat.states_and_inputs(PLAN, [[0.0, 1.0]])[0].shape == (flat.nstates, 1, 2)
    with pytest.raises(ValueError, match="timepts must be finite"):
        flat.states_and_inputs(PLAN, np.inf)


def test_the_car_of_python_control_with_its_limited_steering_angle():
    """The equations of its example: parameters, and a steering angle that is limited by clip."""

    def update(t, x, u, params):
        delta = np.clip(u[1], -params["maxsteer"], params["maxsteer"])
        return np.array([np.cos(x[2]) * u[0], np.sin(x[2]) * u[0], u[0] / params["wheelbase"] * np.tan(delta)])

    names = {"states": ("x", "y", "theta"), "inputs": ("v", "delta"), "outputs": ("x", "y", "theta")}
    plant = ct.nlsys(update, None, **names, params={"wheelbase": WHEELBASE, "maxsteer": 0.5}, name="kincar")
    wide = cp.PathPlan([2.5 * FORWARD, 2.5 * BACKWARD], [1, -1], law(8.0))
    t = np.linspace(0.0, 16.0, 33)
    flat = cp.flat_system(plant, ["x", "y"])
    x, u = flat.states_and_inputs(wide, t)
    theta, speed, delta, _ = expected(wide, t)
    np.testing.assert_allclose(x[2], theta, atol=1e-10)
    np.testing.assert_allclose(u, [speed, delta], atol=1e-10)
    with pytest.raises(ValueError, match=r"segments\[0\] of the plan, .*kincar must stay on the branch .*maxsteer"):
        flat.states_and_inputs(PLAN, 0.0)


@pytest.mark.slow
def test_unicycle_and_trailers_follow_the_equations():
    """x' = f(x, u), by differences of order 8 of states along the plan, between its stops."""
    t, h = np.concatenate([np.linspace(0.5, 4.5, 5), np.linspace(5.5, 10.5, 5)]), 1e-2
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    rest = [0.0] * 4
    smooth = [
        curve((0.0, [0, 30, *rest], [0, 0, *rest]), (1.0, [30, 30, *rest], [5, 10, *rest])),
        curve((0.0, [30, -30, *rest], [5, -10, *rest]), (1.0, [0, -30, *rest], [-4, -10, *rest])),
    ]
    plan = cp.PathPlan(smooth, [1, -1], [law(5.0), law(6.0)])
    for plant in (unicycle, trailer, two_trailers):
        flat = cp.flat_system(plant, ["x", "y"], at={"v": 1.0})
        x, u = flat.states_and_inputs(plan, t)
        rates = sum(
            weight / h * (flat.states_and_inputs(plan, t + k * h)[0] - flat.states_and_inputs(plan, t - k * h)[0])
            for k, weight in weights.items()
        )
        wanted = np.array([plant.dynamics(0.0, x[:, k], u[:, k]) for k in range(t.size)]).T
        np.testing.assert_allclose(rates, wanted, atol=1e-8)
        ends, still = flat.states_and_inputs(plan, plan.stops)
        assert np.isfinite(ends).all()
        assert (still[0] == 0.0).all()


@pytest.mark.slow
def test_the_inputs_that_set_the_pace():
    assert CAR.pace_degrees == by_hand().pace_degrees == (1, 0)
    assert RATE.pace_degrees == (1, 1)
    wheels = system("wheels", "x y th", "left right", lambda x, y, th, left, right: [
        0.05 * (left + right) * np.cos(th), 0.05 * (left + right) * np.sin(th), 0.2 * (right - left)
    ])  # fmt: skip
    assert cp.flat_system(wheels, ["x", "y"], at={"left": 1.0, "right": 1.0}).pace_degrees == (1, 1)
    for name in ("pvtol", "two-link arm"):
        case = CASES[name]
        assert cp.flat_system(case.plant, case.outputs, at=case.at).pace_degrees == ()
    assert cp.plants.Crane().flat_system().pace_degrees == ()


def test_the_heading_is_followed_through_turns():
    """Round a circle and back: the heading grows by a turn and returns, also from a start turned once more."""
    s = np.linspace(0.0, 2.0 * np.pi, 25)
    circle = cp.PiecewiseSpline(
        [
            cp.Waypoint(a, *np.array([[np.sin(a), 1 - np.cos(a)], [np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]))
            for a in s
        ]
    )
    plan = cp.PathPlan([10.0 * circle, curve((0, [0, -1, 0], [0, 0, 0]), (1, [-1, -1, 0], [0, 0, 0]))], [1, -1], [
        law(9.0, 2.0 * np.pi), law(2.0)
    ])  # fmt: skip
    for start, turns in ((None, 0.0), ([0.0, 0.0, 2.0 * np.pi], 1.0)):
        theta = CAR.states_and_inputs(plan, [0.0, 4.5, 9.0, 10.0], start=start)[0][2]
        np.testing.assert_allclose(theta / np.pi, np.array([0.0, 1.0, 2.0, 2.0]) + 2.0 * turns, atol=1e-9)


@pytest.mark.slow
def test_a_stop_on_the_path_keeps_states_and_inputs():
    stopped = PLAN.stop(7.0, {"acceleration": 3.0, "jerk": 15.0}, synchronize="path")
    t = np.linspace(0.0, stopped.end + 1.0, 41)
    theta, speed, delta, rate = expected(stopped, t)
    x, u = RATE.states_and_inputs(stopped, t)
    np.testing.assert_allclose(x, [*stopped(t), theta, delta], rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(u, [speed, rate], rtol=1e-9, atol=1e-9)


def test_axes_in_another_order():
    swapped = cp.PathPlan(
        [piece.select(list(piece.labels)[::-1]) for piece in (FORWARD, BACKWARD)],
        [1, -1],
        [law(5.0), law(6.0)],
        labels=["y", "x"],
    )
    for flat in (CAR, by_hand()):
        for got, wanted in zip(flat.states_and_inputs(swapped, T), flat.states_and_inputs(PLAN, T), strict=True):
            np.testing.assert_allclose(got, wanted, atol=1e-12)
    with pytest.raises(ValueError, match="plan must have the axes x, y, the flat outputs of car, got p, q"):
        CAR.states_and_inputs(cp.PathPlan([FORWARD], [1], law(1.0), labels=["p", "q"]), 0.0)


@pytest.mark.slow
def test_another_plant_rejects_the_path_and_names_the_stops():
    load = cp.PathPlan([FORWARD, BACKWARD], [1, -1], [law(5.0), law(6.0)], labels=["x", "z"])
    derived = cp.flat_system(cp.plants.Crane().iosystem(), ["x", "z"], at={"R": 10.0})
    for flat in (derived, cp.plants.Crane().flat_system()):
        with pytest.raises(
            ValueError, match=r"got crane, .* its states at the stops, at 0 s, 5 s, 11 s; give .*Retimed"
        ):
            flat.states_and_inputs(load, T)


def test_states_that_jump_at_a_stop_are_named():
    bent = curve((0.0, [6, -5, 0, 0], [2, -5, 10, 0]), (1.0, [2, 0, 0, 0], [-4, -9, 0, 0]))
    plan = cp.PathPlan([FORWARD, bent], [1, -1], law(5.0))
    CAR.states_and_inputs(plan, T)  # its steering angle is an input
    with pytest.raises(
        ValueError,
        match=r"states must be continuous at the stop at 5 s, got delta = \S+ at the end of segments\[0\] and 0\.4",
    ):
        RATE.states_and_inputs(plan, T)


def test_curves_that_are_not_smooth_enough_are_rejected():
    rough = curve((0, [0, 1], [0, 0]), (1, [1, 1, 0], [0.2, 1, 1])).then(
        curve((0, [1, 1, 0], [0.2, 1, 2]), (1, [2, 1], [2, 2]))
    )
    plan = cp.PathPlan([rough], [1], law(3.0, 2.0))
    CAR.states_and_inputs(plan, T)
    with pytest.raises(ValueError, match=r"segments\[0\] must be continuous up to derivative 2 .* of derivative 2"):
        RATE.states_and_inputs(plan, T)


@pytest.mark.parametrize("plan", [LINE, LINE.shift(1.0)], ids=["in time", "later"])
def test_maps_by_hand_that_are_not_finite_at_rest_say_what_to_do(plan):
    with pytest.raises(
        ValueError,
        match=rf"delta of by_hand must be determined by the plan, got nan at {plan.start:g} s: the maps are singular "
        r"there; the plan is at rest there, and a plan of a vehicle that stops must be a ctrlplan\.PathPlan",
    ):
        by_hand("quotient").states_and_inputs(plan, np.linspace(plan.start, plan.end, 5))


def test_maps_by_hand_that_are_finite_but_wrong_at_rest_are_rejected():
    """Heading and steering angle 0 at rest, on a straight line at another heading; and a turn on the spot at a cusp."""
    message = r"theta? of by_hand must be determined by the plan, got one that is at rest at {} s: .*ctrlplan\.PathPlan"
    flat = by_hand()
    for t, rest in ((0.0, "0"), ([1.0, 4.0], "4"), ([2.0, 9.0], "9")):
        with pytest.raises(ValueError, match=message.format(rest).replace("theta?", "th")):
            flat.states_and_inputs(LINE, t)
    back = cp.PolySpline(
        [cp.Waypoint.from_jets(t, x=[p, v], y=[p, v]) for t, p, v in ((0, 0, 1), (1, 1, 0), (2, 0, -1))]
    )
    with pytest.raises(ValueError, match=message.format("1").replace("theta?", "th")):
        flat.states_and_inputs(back, [0.2, 1.9])
    x, u = flat.states_and_inputs(LINE, [1.0, 2.0])  # in motion
    np.testing.assert_allclose(x[2], np.arctan2(3, 4))
    assert (u[0] > 0.0).all()


@pytest.mark.slow
def test_derived_maps_at_rest_say_what_to_do():
    for plan in (LINE, LINE.then(LINE + cp.Step([4.0, 3.0], [4.0, 3.0]))):
        with pytest.raises(ValueError, match=r"states of car.* w1 is not .*at rest there, and a plan of a .*PathPlan"):
            CAR.states_and_inputs(plan, [1.0, 2.0])
    source = cp.create_source_iosystem(LINE, 2, suffix="_ref")
    block = cp.create_flat_feedforward_iosystem(CAR)
    wanted = ct.interconnect([source, block], inputs=0, outputs=block.output_labels)
    with pytest.raises(ValueError, match=r"w1 is not determined.*at rest there, and a plan of a .*PathPlan"):
        cp.simulate(wanted, [0.0, 4.0])
    with pytest.raises(ValueError, match=r"v must be determined by the plan, got nan where .* at rest.* PathPlan"):
        cp.margins(LINE, {"v": 20.0}, CAR)
    crane = cp.flat_system(cp.plants.Crane().iosystem(), ["x", "z"], at={"R": 10.0})
    ends = [(0.0, [0.0] * 5, [10.0] + [0.0] * 4), (2.0, [0.0] * 5, [40.0] + [0.0] * 4)]
    falling = cp.PolySpline([cp.Waypoint.from_jets(t, x=x, z=z) for t, x, z in ends])
    with pytest.raises(ValueError, match=r"states of crane (?!.*PathPlan)"):
        crane.states_and_inputs(falling, [1.0])


@pytest.mark.slow
def test_a_kink_that_the_path_leaves_is_named():
    """abs(v) is replaced by v at the operating point, which does not hold in backward travel."""
    plant = system("bent", "x y th", "v w", lambda x, y, th, v, w: [v * np.cos(th), v * np.sin(th), w * np.abs(v)])
    flat = cp.flat_system(plant, ["x", "y"], at={"v": 1.0})
    forward = cp.PathPlan([FORWARD], [1], law(5.0))
    assert (flat.states_and_inputs(forward, [1.0, 4.0])[1][0] > 0.0).all()
    with pytest.raises(ValueError, match=r"equations of bent must stay on the branch .*abs of v, positive.* at 5 s"):
        flat.states_and_inputs(forward, [1.0, 5.0])
    with pytest.raises(ValueError, match=r"segments\[1\] of the plan, .*equations of bent must stay on the branch"):
        flat.states_and_inputs(PLAN, 1.0)


def test_flat_systems_of_python_control_are_quantities_of_moving_plans_only():
    """Their maps are checked before."""
    flat = by_hand()
    theirs = fs.FlatSystem(
        flat.forward, flat.reverse, car.updfcn, None, states=car.state_labels, inputs=car.input_labels, outputs=3
    )
    still = np.zeros((3, 2, 2))
    still[1, 0, 1] = 1.0
    assert np.isnan(quantities_of_flat_system(theirs)(still)["th"][0])
