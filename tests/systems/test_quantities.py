"""States and inputs of flat systems as functions of a plan: against the plants' own equations, and as limits."""

import control.flatsys as fs
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.systems.plants.integrator_chain import integrator_chain

TURN = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(2, 6.28, 0, 0, 0)])
R, L, K, J, B = 1.0, 0.5, 0.01, 0.01, 0.1  # of the motor, as dc_motor has them


def voltage(jet):
    """V = L i' + R i + K y' with K i = J y'' + b y', by hand."""
    return (L * (J * jet[3] + B * jet[2]) + R * (J * jet[2] + B * jet[1])) / K + K * jet[1]


def test_voltage_and_current_of_the_motor():
    jet = TURN.jet(np.linspace(0, 2, 101), 3)
    found = cp.flat_quantities(cp.plants.dc_motor())(jet)
    assert list(found) == ["angle", "speed", "current", "voltage"]
    np.testing.assert_allclose(found["voltage"], voltage(jet[:, 0]), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(found["current"], (J * jet[2, 0] + B * jet[1, 0]) / K, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found["speed"], jet[1, 0])


def test_states_need_one_derivative_less():
    quantities = cp.flat_quantities(cp.plants.dc_motor())
    whole, short = (quantities(TURN.jet(np.linspace(0, 2, 11), order)) for order in (3, 2))
    assert list(short) == ["angle", "speed", "current"]
    np.testing.assert_allclose(short["current"], whole["current"], rtol=1e-14)
    with pytest.raises(ValueError, match=r"order of 2 for states and 3 for inputs, got \(2, 1, 11\)"):
        quantities(TURN.jet(np.linspace(0, 2, 11), 1))


def test_the_fastest_turn_keeps_the_voltage():
    found = cp.fastest(TURN, {"voltage": 120.0}, cp.flat_quantities(cp.plants.dc_motor()))
    t = np.linspace(0, found.duration, 100001)
    peak = np.abs(voltage(found.plan.jet(t, 3)[:, 0])).max()
    assert peak == pytest.approx(120.0, rel=1e-7)
    assert peak <= 120.0 * (1 + 1e-12)
    shorter = TURN.retime(0.999 * found.duration)
    assert np.abs(voltage(shorter.jet(np.linspace(0, shorter.end, 10001), 3)[:, 0])).max() > 120.0


def test_several_flat_outputs_and_linear_systems():
    plan = cp.PolySpline([cp.Waypoint(0, [0, 1], 0, 0), cp.Waypoint(1, [1, -1], 0, 0)])
    jet = plan.jet(np.linspace(0, 1, 21), 2)
    found = cp.flat_quantities(integrator_chain(2, axes=2))(jet)
    inputs = [found[name] for name in integrator_chain(2, axes=2).input_labels]
    np.testing.assert_allclose(inputs, jet[2], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("wrong", [None, "motor", cp.plants.integrator_lag_loop(1.0)])
def test_what_is_no_flat_system_is_refused(wrong):
    with pytest.raises(TypeError, match=r"flat_system must be a control\.flatsys\.FlatSystem, got"):
        cp.flat_quantities(wrong)


def test_discrete_systems_are_refused():
    chain = integrator_chain(1)
    discrete = fs.FlatSystem(chain.forward, chain.reverse, inputs=1, outputs=1, states=1, dt=0.1)
    with pytest.raises(ValueError, match=r"continuous time, got dt = 0\.1"):
        cp.flat_quantities(discrete)
