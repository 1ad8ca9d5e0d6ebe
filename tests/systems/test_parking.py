"""A car that parks: simulation along a path with stops, by inputs alone and with feedback."""

import control as ct
import numpy as np
import pytest
from parking import curve, expected, law, parking

pytest.importorskip("casadi")

from flat_plants import car, car_rate

import ctrlplan as cp

PLAN = parking()
T = np.linspace(0.0, 12.0, 25)
CAR, RATE = (cp.flat_system(plant, ["x", "y"], at={"v": 1.0}) for plant in (car, car_rate))
Q, R = np.diag([1.0, 1.0, 10.0]), np.eye(2)


@pytest.mark.slow
@pytest.mark.parametrize("flat", [pytest.param(CAR, id="angle"), pytest.param(RATE, id="rate", marks=pytest.mark.slow)])
def test_inputs_alone_park_the_car_from_an_exact_start(flat):
    loop = cp.flat_loop(flat, PLAN, law=cp.Feedforward())
    found = cp.simulate(loop, T, rtol=1e-7)
    np.testing.assert_allclose([found.outputs["x"], found.outputs["y"]], PLAN(T), atol=1e-6)
    np.testing.assert_allclose(found.outputs["th"], expected(PLAN, T)[0], atol=1e-6)
    assert found.outputs["th"][-1] == pytest.approx(np.pi / 2, abs=1e-6)  # across the lane


@pytest.mark.slow
def test_the_steering_angle_may_jump_at_a_stop():
    bent = curve((0.0, [6, -5, 0, 0], [2, -5, 10, 0]), (1.0, [2, 0, 0, 0], [-4, -9, 0, 0]))
    plan = cp.PathPlan([PLAN.segments[0], bent], [1, -1], law(5.0))
    found = cp.simulate(cp.flat_loop(CAR, plan, law=cp.Feedforward()), T)
    np.testing.assert_allclose([found.outputs["x"], found.outputs["y"]], plan(T), atol=1e-6)
    assert abs(found.outputs["delta"][10]) > 0.4  # the value after the stop


@pytest.mark.slow
def test_states_and_inputs_as_a_source_for_a_state_feedback_of_python_control():
    block = cp.create_flat_feedforward_iosystem(CAR, plan=PLAN)
    assert block.input_labels == []
    assert block.output_labels == ["xd[0]", "xd[1]", "xd[2]", "ud[0]", "ud[1]"]
    plant = ct.nlsys(car.updfcn, None, states=car.state_labels, inputs=car.input_labels, outputs=3, name="car")
    gain = np.array([[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
    controller, _ = ct.create_statefbk_iosystem(plant, gain, xd_labels="xd[{i}]", ud_labels="ud[{i}]")
    loop = ct.interconnect([block, controller, plant], inputs=0, outputs=plant.output_labels, name="loop")
    short = T[T <= 3.0]
    found = cp.simulate(loop, short, initial_state=CAR.states_and_inputs(PLAN, 0.0)[0], rtol=1e-7)
    np.testing.assert_allclose(found.outputs[:2], PLAN(short), atol=1e-6)
    inputs = cp.create_flat_feedforward_iosystem(CAR, plan=PLAN, states=False)
    assert inputs.output_labels == ["ud[0]", "ud[1]"]
    np.testing.assert_allclose(inputs.output(7.0, [], []), CAR.states_and_inputs(PLAN, 7.0)[1])
    rest = cp.PolySpline([cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(4, [4, 3], 0, 0)], labels=["x", "y"])
    with pytest.raises(ValueError, match="PathPlan"):
        cp.create_flat_feedforward_iosystem(CAR, plan=rest)


@pytest.mark.slow
def test_a_regulator_returns_the_car_to_its_path():
    loop = cp.flat_loop(CAR, PLAN, law=cp.TVLQR(Q, R, final=Q), initial_state=[0.0, 0.1, 0.0])
    found = cp.simulate(loop, T, rtol=1e-5)
    off = np.hypot(*(np.array([found.outputs["x"], found.outputs["y"]]) - PLAN(T)))
    assert off[-1] < 0.05 * off[0]
    np.testing.assert_allclose(off[-2:], off[-1], atol=1e-9)  # at rest after the end
    with pytest.raises(ValueError, match=r"final must be given for car: there is no stationary gain at the end"):
        cp.flat_loop(CAR, PLAN, law=cp.TVLQR(Q, R))


@pytest.mark.parametrize("speed", [-1e-14, 1e-13])
def test_a_speed_that_rounding_leaves_at_the_end_has_no_stationary_gain(speed):
    """x' = v cos th, y' = v sin th, th' = v tan(delta): with v = 0 the car cannot be moved sideways."""
    end = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(6, 1, speed, 0)])
    plan = cp.PathPlan(PLAN.segments, PLAN.directions, [law(5.0), end])
    with pytest.raises(ValueError, match=r"final must be given for car: there is no stationary gain at the end"):
        cp.TVLQR(Q, R).gains(CAR, plan)


@pytest.mark.parametrize("options", [{}, {"quasi_static": True}, {"integral": True}])
def test_a_law_that_divides_by_the_speed_is_rejected(options):
    poles = [[-1.0, -2.0, -3.0]] * 2
    with pytest.raises(ValueError, match=r"law must be a Feedforward or TVLQR for a PathPlan.* at 0 s, 5 s, 11 s"):
        cp.flat_loop(CAR, PLAN, law=cp.FlatLaw(poles, **options))


def test_a_window_and_a_table_of_the_path(tmp_path):
    x, u = cp.reference_window(PLAN, 10.5, 0.25, 4, flat=CAR)
    np.testing.assert_allclose(x[2], expected(PLAN, 10.5 + 0.25 * np.arange(5))[0], atol=1e-9)
    np.testing.assert_array_equal(u[0, 2:], 0.0)
    (path,) = PLAN.export(tmp_path / "park.csv", dt=0.5, flat=CAR)
    header = path.read_text().splitlines()[0]
    assert header.endswith("th,v,delta")
