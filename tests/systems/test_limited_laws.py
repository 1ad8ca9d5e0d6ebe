"""Tracking laws with saturated inputs: the states of the extension and the integrals follow what is applied."""

import control as ct
import numpy as np
import pytest

pytest.importorskip("casadi")

from flat_plants import CASES, car, planar_quadrotor
from repetitions import one_in

import ctrlplan as cp

CRANE = cp.plants.Crane()
FLAT = cp.flat_system(CRANE.iosystem(), ["x", "z"], at={"R": 10.0})
WEIGHT = CRANE.load_mass * 9.81 * CRANE.drum_radius
POLES = [[-2.0, -2.5, -3.0, -3.5]] * 2
WIDE = [[-2.0, -2.5, -3.0, -3.5, -1.5]] * 2
REST = [0.0] * 4
T = np.linspace(0.0, 25.0, 1001)


def lift():
    ends = [(0.0, [0.0, *REST], [10.0, *REST]), (15.0, [20.0, *REST], [11.0, *REST])]
    return cp.PolySpline([cp.Waypoint.from_jets(t, x=x, z=z) for t, x, z in ends])


def ignoring(law, limits):
    """The same law with saturated outputs, its states as without saturation."""
    low, high = (np.array([limits[name][k] for name in law.output_labels]) for k in (0, 1))
    return ct.nlsys(
        law.updfcn,
        lambda t, x, u, p: [
            np.minimum(np.maximum(v, a), b) for v, a, b in zip(law.outfcn(t, x, u, p), low, high, strict=True)
        ],
        inputs=law.input_labels,
        outputs=law.output_labels,
        states=law.state_labels,
        name="law",
    )


def run(law, own, start, params=None):
    plan = lift()
    source = cp.create_source_iosystem(plan, 4, suffix="_ref")
    names = [*CRANE.iosystem().output_labels, "F", "C"]
    loop = ct.interconnect([source, law, CRANE.iosystem()], inputs=0, outputs=names, name="loop")
    found = cp.simulate(loop, T, initial_state=[*own, *start], params=params, method="compiled")
    return found.outputs["C"], np.array([found.outputs["x"], found.outputs["z"]]) - plan(T)


def peak_after(torque, error, limits):
    """Times at which the torque leaves its limits by 2.5 Nm, and the peak error after the first of them."""
    low, high = limits["C"]
    on = (torque <= low + 2.5) | (torque >= high - 2.5)
    left = np.flatnonzero(on[:-1] & ~on[1:]) + 1
    return T[left], float(np.hypot(*error[:, left[0] :]).max())


@pytest.mark.slow
@pytest.mark.parametrize("heavier", [1.0, pytest.param(1.02, marks=pytest.mark.slow)])
def test_extension_and_integrals_follow_what_is_applied(heavier):
    """A load 1 m above its plan that is lowered by at most 50 Nm: its weight and 4 % of it."""
    limits = {"F": (-30e3, 30e3), "C": (-3000.0, 50.0 - WEIGHT)}
    start, own = CRANE.equilibrium(0.0, 9.0)[0], FLAT.extension_along(lift(), 0.0)
    params = {"load_mass": heavier * CRANE.load_mass}
    law = cp.create_flat_iosystem(FLAT, WIDE, integral=True, start=own, limits=limits)
    torque, error = run(law, cp.traits_of(law).initial_state, start, params)
    assert torque.max() <= limits["C"][1]
    left, peak = peak_after(torque, error, limits)
    assert left.size == 1  # it stays off its limit after the first return
    assert np.abs(error[:, -1]).max() < 1e-6
    free = cp.create_flat_iosystem(FLAT, WIDE, integral=True, start=own)
    other = run(ignoring(free, limits), cp.traits_of(free).initial_state, start, params)
    assert error[1].max() <= 0.5 * other[1][1].max()  # overshoot
    if heavier == 1.0:  # the trolley is not disturbed by the limit of the winch
        assert peak <= 0.5 * peak_after(*other, limits)[1]
        assert np.abs(error[0]).max() < 1e-4
        assert np.abs(other[1][0]).max() > 0.05


@pytest.mark.slow
def test_fast_poles_at_a_limit_for_long():
    """Poles with which the law without this leaves the domain of the plant, the rope slack."""
    limits = {"F": (-30e3, 30e3), "C": (-3000.0, 100.0 - WEIGHT)}
    plan = lift()
    t = np.linspace(0.0, 8.0, 81)
    law = cp.FlatLaw([POLES[0], [-6.0, -6.5, -7.0, -7.5]])
    loop = cp.flat_loop(FLAT, plan, law=law, limits=limits, initial_state=CRANE.equilibrium(0.0, 8.0)[0])
    found = cp.simulate(loop, t, method="compiled")
    error = np.array([found.outputs["x"], found.outputs["z"]]) - plan(t)
    assert found.outputs["C"].max() <= limits["C"][1]
    assert np.abs(error[1]).max() <= 2.0 + 1e-6
    assert np.abs(error[0]).max() < 1e-4
    assert np.abs(error[:, -1]).max() < 1e-6


@pytest.mark.parametrize("name", one_in(3, ["crane", "car", "planar quadrotor", "machine", "quadrotor"]))
def test_limits_that_are_not_reached_change_nothing(name):
    case = CASES[name]
    flat = cp.flat_system(case.plant, case.outputs, at=case.at)
    poles = [[-1.0 - 0.3 * k for k in range(r)] for r in flat.orders]
    limits = dict.fromkeys(flat.input_labels, (-1e9, 1e9))
    free, limited = (cp.create_flat_iosystem(flat, poles, limits=given) for given in (None, limits))
    rng = np.random.default_rng(4)
    own = cp.traits_of(free).initial_state if free.nstates else np.zeros(0)
    x = np.array([flat.operating_point[label] for label in flat.state_labels])
    for _ in range(5):
        state = own * rng.uniform(0.95, 1.05, own.size) + 0.01 * rng.normal(size=own.size)
        u = np.concatenate([0.1 * rng.normal(size=free.ninputs - x.size), x + 0.01 * rng.normal(size=x.size)])
        np.testing.assert_allclose(limited.output(0.0, state, u), free.output(0.0, state, u), rtol=1e-9)
        if free.nstates:
            np.testing.assert_allclose(limited.dynamics(0.0, state, u), free.dynamics(0.0, state, u), rtol=1e-9)


@pytest.mark.slow
def test_a_car_with_limits_of_speed_and_steering():
    """It starts 3 m behind and 1 m off its lane: it catches up at its highest speed, and stays in its lane."""
    flat = cp.flat_system(car, ["x", "y"], at={"v": 1.0})
    ends = [(0.0, [0, 10, 0], [0, 0, 0]), (8.0, [80, 10, 0], [3.5, 0, 0])]
    plan = cp.PolySpline([cp.Waypoint.from_jets(t, x=x, y=y) for t, x, y in ends])
    limits = {"v": (0.0, 11.0), "delta": (-0.3, 0.3)}
    poles = [[-2.0, -3.0]] * 2
    loop = cp.flat_loop(flat, plan, poles=poles, limits=limits, initial_state=[-3.0, 1.0, 0.0])
    t = np.linspace(0.0, 8.0, 161)
    found = cp.simulate(loop, t, method="compiled")
    v, delta = found.outputs["v"], found.outputs["delta"]
    assert v.max() <= 11.0
    assert np.abs(delta).max() <= 0.3
    assert (v > 10.9).sum() > 20
    x, y = found.outputs["x"] - plan(t)[0], found.outputs["y"] - plan(t)[1]
    assert x.max() < 0.02
    assert np.hypot(x[-1], y[-1]) < 1e-3


@pytest.mark.slow
def test_rotors_that_enter_by_their_squares_stay_within_their_speeds():
    """A planar quadrotor 2 m below its plan: rotors at most 15 % faster than in hover."""
    flat = cp.flat_system(planar_quadrotor, ["x", "z"], at={"th": 0.0})
    hover = flat.operating_point["left"]
    assert hover > 0.0
    limits = dict.fromkeys(("left", "right"), (0.3 * hover, 1.15 * hover))
    ends = [(0.0, [0.0, *REST], [0.0, *REST]), (6.0, [4.0, *REST], [1.0, *REST])]
    plan = cp.PolySpline([cp.Waypoint.from_jets(t, x=x, z=z) for t, x, z in ends])
    start = np.array([0.0, -2.0, 0.0, 0.0, 0.0, 0.0])
    loop = cp.flat_loop(flat, plan, poles=[[-2.0, -2.5, -3.0, -3.5]] * 2, limits=limits, initial_state=start)
    t = np.linspace(0.0, 9.0, 181)
    found = cp.simulate(loop, t, method="compiled")
    for name in limits:
        assert limits[name][0] <= found.outputs[name].min()
        assert found.outputs[name].max() <= limits[name][1]
    error = np.array([found.outputs["x"], found.outputs["z"]]) - plan(t)
    assert np.abs(error[1]).max() <= 2.0 + 1e-6
    assert np.abs(error[:, -1]).max() < 1e-4


def test_limits_must_contain_the_inputs_at_rest():
    """A winch that cannot carry the load."""
    with pytest.raises(
        ValueError, match=r"limits\['C'\] must contain the input .* at rest at 0 s, -1226\.25, got -100"
    ):
        cp.flat_loop(FLAT, lift(), poles=POLES, limits={"C": (-100.0, 100.0)})


@pytest.mark.slow
def test_limits_at_every_heading():
    """A vehicle on almost a full circle at 1 m/s, from 1 m behind: the pairing of outputs and inputs changes."""
    flat = cp.flat_system(CASES["unicycle"].plant, ["x", "y"], at={"v": 1.0})
    t = np.linspace(0.0, 12.0, 49)
    plan = cp.PiecewiseSpline(
        [
            cp.Waypoint.from_jets(
                time,
                x=[2.0 * np.sin(a), np.cos(a), -0.5 * np.sin(a)],
                y=[2.0 - 2.0 * np.cos(a), np.sin(a), 0.5 * np.cos(a)],
            )
            for time, a in zip(t.tolist(), 0.5 * t, strict=True)
        ]
    )
    limits = {"v": (0.2, 1.3), "w": (-1.5, 1.5)}
    loop = cp.flat_loop(flat, plan, poles=[[-2.0, -3.0]] * 2, limits=limits, initial_state=[-1.0, 0.0, 0.0])
    found = cp.simulate(loop, t, method="compiled")
    assert found.outputs["v"].max() <= 1.3
    error = np.hypot(*(np.array([found.outputs["x"], found.outputs["y"]]) - plan(t)))
    assert error.max() <= 1.0 + 1e-9
    assert error[-1] < 1e-6
