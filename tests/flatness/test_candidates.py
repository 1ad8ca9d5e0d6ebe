"""Which outputs are flat, and maps of others against their dynamics."""

import control as ct
import control.flatsys as fs
import numpy as np
import pytest

pytest.importorskip("casadi")

from flat_plants import CASES, car, cart, huygens, machine, pvtol, two_mass

import ctrlplan as cp


@pytest.mark.slow
def test_candidates_of_a_car_and_of_a_machine():
    found = cp.flat_candidates(car, at={"v": 1.0})
    assert found[0] == cp.FlatCandidate(("x", "y"), (2, 2), 1)
    assert all(set(one.outputs) <= {"x", "y", "th"} for one in found)
    sets = {one.outputs: one.orders for one in cp.flat_candidates(machine, at={"iq": 1.0})}
    assert sets["th", "id"] == (3, 1)
    assert cp.flat_candidates(cart) == ()


@pytest.mark.slow
def test_candidates_of_the_crane():
    """120 sets of two of its outputs and states, with a wind that is no control."""
    found = cp.flat_candidates(cp.plants.Crane().iosystem(wind=True), inputs=["F", "C"], at={"R": 10.0})
    assert found[0].outputs == ("x", "z")


def test_candidates_of_one_input():
    assert [one.outputs for one in cp.flat_candidates(two_mass(0.0))] == [("x2",)]
    with pytest.raises(ValueError, match="at most 300 sets"):
        cp.flat_candidates(ct.ss(-np.eye(40), np.ones((40, 2)), np.eye(40), np.zeros((40, 2))))


@pytest.mark.parametrize("flat", [cp.plants.Crane().flat_system(), cp.plants.dc_motor(), cp.plants.flexible_joint()])
def test_maps_of_the_package_agree_with_their_equations(flat):
    assert cp.check_flat(flat).residual < 1e-9


@pytest.mark.slow
def test_derived_maps_agree_with_their_equations():
    assert cp.check_flat(cp.flat_system(pvtol, huygens)).residual < 1e-8
    assert cp.check_flat(cp.flat_system(CASES["machine"].plant, ["th", "id"])).residual < 1e-8


def kinematic_car(division):
    """The car of python-control's manual: flag and its inverse."""
    b = 3.0

    def forward(x, u, params={}):  # noqa: B006 - the signature of python-control
        turning = u[0] / b * np.tan(u[1])
        return [
            np.array([x[0], u[0] * np.cos(x[2]), -u[0] * turning * np.sin(x[2])]),
            np.array([x[1], u[0] * np.sin(x[2]), u[0] * turning * np.cos(x[2])]),
        ]

    def reverse(flag, params={}):  # noqa: B006
        th = np.arctan2(flag[1][1], flag[0][1])
        speed = flag[0][1] * np.cos(th) + flag[1][1] * np.sin(th)
        across = flag[1][2] * np.cos(th) - flag[0][2] * np.sin(th)
        return np.array([flag[0][0], flag[1][0], th]), np.array([speed, np.arctan2(across, division(speed, b))])

    def update(t, x, u, params):
        return np.array([u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[0] / b * np.tan(u[1])])

    return fs.FlatSystem(forward, reverse, update, None, inputs=2, outputs=3, states=3, name="kincar")


def test_the_car_of_the_manual_fails_and_its_example_passes():
    """The page on flat systems divides by u[0]/b, the example kincar by u[0]**2/b."""
    assert cp.check_flat(kinematic_car(lambda speed, b: speed**2 / b)).passed
    found = cp.check_flat(kinematic_car(lambda speed, b: speed / b))
    assert not found.passed
    assert found.signal == "x[2]"
    assert set(found.where) == {"x[0]", "x[1]", "x[2]", "u[0]", "u[1]"}


def test_what_is_no_flat_system():
    with pytest.raises(TypeError, match="FlatSystem"):
        cp.check_flat(ct.ss([[0.0]], [[1.0]], [[1.0]], 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_maps_of_fast_and_slow_plants_are_checked_in_their_time(unit):
    """Correct maps pass in any unit of time; those with an input that is 1 % wrong fail."""

    def rates(t, x, u, params):
        spring = -x[0] - 0.1 * unit * x[1] + 0.3 * np.sin(x[2])
        return [x[1], spring / unit**2, (u[0] - x[2]) / unit]

    names = ["x", "v", "angle"]
    plant = ct.nlsys(rates, None, states=names, inputs=["u"], outputs=names, name="plant")
    flat = cp.flat_system(plant, "x")
    assert cp.check_flat(flat).passed
    if unit > 1.0:  # maps by hand state no operating point with slow motion
        return

    def wrong(flag, params):
        x, u = flat.reverse(flag)
        return x, 1.01 * u

    by_hand = fs.FlatSystem(flat.forward, wrong, rates, None, states=names, inputs=["u"], name="by_hand")
    assert not cp.check_flat(by_hand).passed
