"""States and inputs of flat systems as functions of a plan: against the plants' own equations, and as limits."""

import control as ct
import control.flatsys as fs
import numpy as np
import pytest
from repetitions import one_in

import ctrlplan as cp
from ctrlplan.flatness.quantities import quantities_of_flat_system
from ctrlplan.systems.flat import create_flat_iosystem
from ctrlplan.systems.plants.integrator_chain import integrator_chain

TURN = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(2, 6.28, 0, 0, 0)])
R, L, K, J, B = 1.0, 0.5, 0.01, 0.01, 0.1  # of the motor, as dc_motor has them


def voltage(jet):
    """V = L i' + R i + K y' with K i = J y'' + b y', by hand."""
    return (L * (J * jet[3] + B * jet[2]) + R * (J * jet[2] + B * jet[1])) / K + K * jet[1]


def test_voltage_and_current_of_the_motor():
    jet = TURN.jet(np.linspace(0, 2, 101), 3)
    found = quantities_of_flat_system(cp.plants.dc_motor())(jet)
    assert list(found) == ["angle", "speed", "current", "voltage"]
    np.testing.assert_allclose(found["voltage"], voltage(jet[:, 0]), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(found["current"], (J * jet[2, 0] + B * jet[1, 0]) / K, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found["speed"], jet[1, 0])


def test_states_need_one_derivative_less():
    quantities = quantities_of_flat_system(cp.plants.dc_motor())
    whole, short = (quantities(TURN.jet(np.linspace(0, 2, 11), order)) for order in (3, 2))
    assert list(short) == ["angle", "speed", "current"]
    np.testing.assert_allclose(short["current"], whole["current"], rtol=1e-14)
    with pytest.raises(ValueError, match=r"order of 2 for states and 3 for inputs, got \(2, 1, 11\)"):
        quantities(TURN.jet(np.linspace(0, 2, 11), 1))


def test_the_fastest_turn_keeps_the_voltage():
    found = cp.fastest(TURN, {"voltage": 120.0}, cp.plants.dc_motor())
    t = np.linspace(0, found.duration, 100001)
    peak = np.abs(voltage(found.plan.jet(t, 3)[:, 0])).max()
    assert peak == pytest.approx(120.0, rel=1e-7)
    assert peak <= 120.0 * (1 + 1e-12)
    shorter = TURN.retime(0.999 * found.duration)
    assert np.abs(voltage(shorter.jet(np.linspace(0, shorter.end, 10001), 3)[:, 0])).max() > 120.0


def test_several_flat_outputs_and_linear_systems():
    plan = cp.PolySpline([cp.Waypoint(0, [0, 1], 0, 0), cp.Waypoint(1, [1, -1], 0, 0)])
    jet = plan.jet(np.linspace(0, 1, 21), 2)
    found = quantities_of_flat_system(integrator_chain(2, axes=2))(jet)
    inputs = [found[name] for name in integrator_chain(2, axes=2).input_labels]
    np.testing.assert_allclose(inputs, jet[2], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("wrong", [None, "motor", cp.plants.integrator_lag_loop(1.0)])
def test_what_is_no_flat_system_is_rejected(wrong):
    with pytest.raises(TypeError, match=r"flat_system must be a control\.flatsys\.FlatSystem, got"):
        quantities_of_flat_system(wrong)


def test_discrete_systems_are_rejected():
    chain = integrator_chain(1)
    discrete = fs.FlatSystem(chain.forward, chain.reverse, inputs=1, outputs=1, states=1, dt=0.1)
    with pytest.raises(ValueError, match=r"continuous time, got dt = 0\.1"):
        quantities_of_flat_system(discrete)


# Maps that do not mean what their user thinks


def lagged(*lags):
    """1/(s (T_1 s + 1) ...), whose flat output to python-control is its output in another unit."""
    chain = np.poly1d([1.0, 0.0])
    for lag in lags:
        chain *= np.poly1d([lag, 1.0])
    return ct.ss(ct.tf([1.0], chain.coeffs)), chain.coeffs[::-1]


@pytest.mark.parametrize("lags", [(0.02, 0.001), (0.5,), (0.1, 0.03)])
def test_a_linear_flat_system_is_matched_to_its_output(lags):
    """The flat output of python-control is a multiple of it; u = (the plant's denominator) y."""
    system, coefficients = lagged(*lags)
    order = len(coefficients) - 1
    flat = fs.LinearFlatSystem(system)
    quantities = quantities_of_flat_system(flat)
    plan = cp.PolySpline([cp.Waypoint.from_jets(0, y=[0] * 5), cp.Waypoint.from_jets(1, y=[90, 0, 0, 0, 0])])
    jet = plan.jet(np.linspace(0, 1, 21), order)
    u = sum(c * row for c, row in zip(coefficients, jet[:, 0], strict=True))
    np.testing.assert_allclose(quantities(jet)["u[0]"], u, rtol=1e-9, atol=1e-9 * np.abs(u).max())
    loop = cp.flat_loop(flat, plan, poles=[-20.0 - k for k in range(order)])
    t = np.linspace(0.0, 1.2, 13)
    np.testing.assert_allclose(cp.simulate(loop, t, rtol=1e-10).outputs[flat.output_labels[0]], plan(t), atol=1e-5)


@pytest.mark.slow
def test_the_fastest_move_of_such_a_plant():
    """90 with |u| <= 400: u is nearly y', whose peak is 2.1875 times the mean of the septic move."""
    flat = fs.LinearFlatSystem(lagged(0.02, 0.001)[0])
    move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(1, 90, 0, 0, 0)])
    found = cp.fastest(move, {"u[0]": 400.0}, flat)
    assert found.duration == pytest.approx(2.1875 * 90 / 400, rel=0.02)


def test_a_flat_output_that_is_the_output_is_no_news():
    chain = ct.ss([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    quantities_of_flat_system(fs.LinearFlatSystem(chain))
    create_flat_iosystem(fs.LinearFlatSystem(chain), [-1.0, -2.0])


def wrong_maps(forward=lambda v: v, reverse=lambda v: v, rate=lambda v: v):
    """x'' = u with something changed."""
    return fs.FlatSystem(
        lambda x, u, params: [np.array([x[0], forward(x[1]), u[0]])],
        lambda flag, params: (np.array([flag[0][0], reverse(flag[0][1])]), np.array([flag[0][2]])),
        lambda t, x, u, params: np.array([rate(x[1]), u[0]]),
        lambda t, x, u, params: x[:1],
        states=["a", "b"],
        inputs=["u"],
        outputs=["a"],
    )


def test_maps_that_do_not_belong_together_give_no_limits():
    with pytest.raises(ValueError, match="reverse must be the inverse of forward, got"):
        quantities_of_flat_system(wrong_maps(reverse=lambda v: 1.1 * v))
    with pytest.raises(ValueError, match="forward must return derivatives along the motion"):
        quantities_of_flat_system(wrong_maps(rate=lambda v: 2.0 * v))
    quantities_of_flat_system(wrong_maps())


# One way: what planning takes as a system


@pytest.mark.slow
def test_a_crane_its_flat_system_and_its_map_are_one():
    crane, limits = cp.plants.Crane(), {"F": 20e3, "theta": 0.2, "D_d1": 3.0}
    load = cp.PolySpline(
        [
            cp.Waypoint.from_jets(0.0, x=[0, 0, 0, 0, 0], z=[10, 0, 0, 0, 0]),
            cp.Waypoint.from_jets(15.0, x=[20, 0, 0, 0, 0], z=[11, 0, 0, 0, 0]),
        ]
    )
    # theta alone does not contain z'' enough to matter: the oracle is the paper's (15c) on a fine grid.
    systems = (crane, crane.flat_system(), crane.quantities, crane.flat_system().quantities)
    found = [cp.fastest(load, limits, system).duration for system in systems]
    assert found[1:] == found[:1] * 3
    jet = load.retime(found[0]).jet(np.linspace(0.0, found[0], 20001), 2)
    angle = np.abs(np.arctan2(-jet[2, 0], 9.81 - jet[2, 1])).max()
    margin = {row.bound.name: row for row in cp.margins(load.retime(found[0]), limits, crane.flat_system())}
    assert abs(margin["theta"].value) == pytest.approx(angle, rel=1e-6)


class Counted(fs.FlatSystem):
    """A double integrator that counts its calls."""

    def __init__(self):
        self.calls = 0
        super().__init__(
            lambda x, u, params: [np.array([x[0], x[1], u[0]])],
            self.back,
            lambda t, x, u, params: np.array([x[1], u[0]]),
            lambda t, x, u, params: x[:1],
            states=["a", "b"],
            inputs=["u"],
            outputs=["a"],
        )

    def back(self, flag, params):
        self.calls += 1
        return np.array(flag[0][:2]), np.array(flag[0][2:])


def test_a_flat_system_of_python_control_is_taken_as_it_is():
    move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    counted = Counted()
    found = cp.margins(move, {"u": 10.0, "b": 3.0}, counted)
    assert counted.calls > 0
    values = {row.bound.name: abs(row.value) for row in found}
    assert values == {"u": pytest.approx(10 / np.sqrt(3), rel=1e-9), "b": pytest.approx(1.875, rel=1e-9)}


def test_the_old_names_warn_and_do_the_same():
    limits = {"voltage": 120.0}
    motor = cp.plants.dc_motor()
    new = cp.fastest(TURN, limits, system=motor).duration
    with pytest.warns(FutureWarning, match=r"quantities= is deprecated.*use system=") as caught:
        assert cp.fastest(TURN, limits, quantities=motor).duration == new
    with pytest.warns(FutureWarning, match=r"quantities= is deprecated.*use system=") as again:
        old = cp.margins(TURN, limits, quantities=motor.quantities)
    assert old == cp.margins(TURN, limits, motor)
    with pytest.warns(FutureWarning, match=r"flat_quantities\(flat_system\) is deprecated.*use flat_system") as third:
        assert cp.fastest(TURN, limits, cp.flat_quantities(motor)).duration == new
    assert [w.filename for w in (*caught, *again, *third)] == [__file__] * 3
    with pytest.raises(TypeError, match="quantities= is the deprecated name of system="):
        cp.fastest(TURN, limits, motor, quantities=motor)


@pytest.mark.parametrize(
    ("wrong", "got"),
    [
        (cp.plants.Crane, "the class Crane"),
        ({"u": 1}, "dict"),
    ],
)
def test_what_is_no_system_of_quantities(wrong, got):
    with pytest.raises(TypeError, match=rf"system must be a flat system, .* got {got}$"):
        cp.margins(TURN, {"u": 1.0}, wrong)


# Maps that are singular at rest


def car(steering):
    """Rear axle as flat output; the steering angle by its arctangent of two arguments, or by the quotient."""
    length = 3.0

    def forward(x, u, params):
        c, s, turn = np.cos(x[2]), np.sin(x[2]), u[0] * np.tan(u[1]) / length
        return [np.array([x[0], u[0] * c, -u[0] * turn * s]), np.array([x[1], u[0] * s, u[0] * turn * c])]

    def reverse(flag, params):
        (px, vx, ax), (py, vy, ay) = flag
        heading = np.arctan2(vy, vx)
        speed = vx * np.cos(heading) + vy * np.sin(heading)
        sideways = ay * np.cos(heading) - ax * np.sin(heading)
        if steering == "two arguments":
            delta = np.arctan2(length * sideways, speed**2)
        else:
            delta = np.arctan(length * (vx * ay - vy * ax) / np.hypot(vx, vy) ** 3)
        return np.array([px, py, heading]), np.array([speed, delta])

    def motion(t, x, u, params):
        return np.array([u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[0] * np.tan(u[1]) / length])

    names = ["x", "y", "theta"]
    return fs.FlatSystem(forward, reverse, motion, None, states=names, inputs=["v", "delta"], outputs=names)


FROM_REST = cp.PolySpline([cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(10, [20, 10], 0, 0)])
MOVING = cp.PolySpline([cp.Waypoint(0, [0, 0], [1, 0], 0), cp.Waypoint(10, [20, 10], [1, 0.5], 0)])


@pytest.mark.parametrize("steering", ["two arguments", "quotient"])
@pytest.mark.parametrize(
    "limits", [{"delta": 0.5}, {"theta": (0.0, 1.0)}, {"v": 3.0, "delta": 0.5}, {"delta": (0, None)}]
)
def test_what_is_singular_at_rest_is_rejected_with_the_reason(steering, limits):
    """Not 214 % beyond, which is a quotient of rounding errors."""
    for call in (cp.margins, cp.fastest):
        with pytest.raises(ValueError, match=r"(delta|theta) must be determined by the plan, got nan where"):
            call(FROM_REST, limits, car(steering))


@pytest.mark.slow
@pytest.mark.parametrize("steering", one_in(2, ["two arguments", "quotient"]))
def test_what_is_regular_at_rest_stays_limited(steering):
    found = cp.fastest(FROM_REST, {"v": 3.0}, car(steering))
    assert found.duration == pytest.approx(1.875 * np.hypot(20, 10) / 3.0, rel=1e-6)


@pytest.mark.parametrize("steering", ["two arguments", "quotient"])
def test_a_car_that_keeps_moving(steering):
    """Against the curvature, on a fine grid."""
    found = cp.margins(MOVING, {"delta": 0.5}, car(steering))
    j = MOVING.jet(np.linspace(0, 10, 200001), 2)
    delta = np.arctan(3.0 * (j[1, 0] * j[2, 1] - j[1, 1] * j[2, 0]) / np.hypot(*j[1]) ** 3)
    assert abs(found.active.value) == pytest.approx(np.abs(delta).max(), rel=1e-8)


def test_regular_plants_are_determined_at_rest():
    for plant in (cp.plants.dc_motor(), cp.plants.flexible_joint(), integrator_chain(3)):
        quantities = quantities_of_flat_system(plant)
        order = plant.nstates
        still = np.zeros((order + 1, 1, 3))
        still[0] = 0.3
        assert all(np.isfinite(row).all() for row in quantities(still).values())
