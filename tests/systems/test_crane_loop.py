"""Closed loops of the crane compared with a hand-written right-hand side, their poles, rejected arguments."""

import math
import re
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from crane_oracle import F1, F2, MC, POLES, B, G, J, M, acceleration, by_hand, hand_rate, load_of
from numpy.polynomial import Polynomial
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan.simulation import simulate
from ctrlplan.systems.plants import LAWS, Crane, crane_loop

BOTH = pytest.mark.parametrize("wrap", [False, True], ids=["paper", "wrapped"])


def plan_of(entries, points=((0.0, 0.0, 10.0), (6.0, 4.0, 9.0))):
    rest = [0.0] * (entries - 1)
    return cp.PolySpline([cp.Waypoint.from_jets(t, x=[x, *rest], z=[z, *rest]) for t, x, z in points])


def run(loop, t, state=None, **options):
    options = {"rtol": 1e-11, "atol": 1e-11} | options
    found = simulate(loop, t, initial_state=loop.initial_state if state is None else state, **options)
    return SimpleNamespace(
        **dict(zip(found.output_labels, found.outputs, strict=True)), states=np.asarray(found.states)
    )


@BOTH
@pytest.mark.parametrize("law", ["setpoint", "generator", "load_feedback", "dynamic"])
def test_loops_are_the_hand_written_right_hand_side(law, wrap):
    """From a disturbed state, along a plan whose derivatives jump as far as the law allows, and past its end."""
    plan = plan_of(5 if law == "dynamic" else 2)
    loop = crane_loop(Crane(rope_wrap=wrap), plan, law)
    disturbed = np.array([0.2, 9.9, 0.05, 0.1, -0.05, 0.02])
    state = np.concatenate([[150.0, -40.0] if law == "dynamic" else [800.0, 0.03, -60.0, 0.02], disturbed])
    t = np.linspace(0, 8, 33)
    expected = by_hand(plan, law, wrap, state, t)
    found = run(loop, t, state)
    crane = expected[-6:]
    np.testing.assert_allclose(found.states[-6:], crane, rtol=1e-7, atol=2e-8)
    np.testing.assert_allclose([found.D, found.R, found.theta], crane[:3], rtol=1e-7, atol=2e-8)
    loads = np.array([load_of(q) for q in crane.T]).T
    np.testing.assert_allclose([found.x, found.z, found.x_d1, found.z_d1], loads, rtol=1e-7, atol=2e-8)
    tension = [acceleration(wrap, q, f, c)[3] for q, f, c in zip(crane.T, found.F, found.C, strict=True)]
    np.testing.assert_allclose(found.T, tension, rtol=1e-7)
    assert loop.output_labels[-2:] == ["x_ref", "z_ref"]
    np.testing.assert_allclose([found.x_ref, found.z_ref], plan(t), atol=1e-12)


@pytest.mark.slow
def test_saturated_step_is_the_hand_written_right_hand_side():
    plan = cp.Step([20, 11], [0, 10], labels=["x", "z"])
    limits = {"force_limits": (-30e3, 30e3), "torque_limits": (-3e3, 1e3)}
    loop = crane_loop(Crane(), plan, "setpoint", **limits)
    assert loop.initial_state[-6:] == pytest.approx([-B, 10, 0, 0, 0, 0])
    t = np.linspace(0, 0.2, 21)  # before the rope's slackness makes the model stiff
    held = np.zeros((5, 2))
    held[0] = 20, 11
    found = solve_ivp(
        hand_rate(lambda _: held, "setpoint", False, **limits),
        (0, 0.2),
        loop.initial_state,
        method="Radau",
        t_eval=t,
        rtol=1e-9,
        atol=1e-10,
    )
    assert found.success
    np.testing.assert_allclose(run(loop, t).states, found.y, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_step_saturates_the_drives_and_slackens_the_rope():
    plan = cp.Step([20, 11], [0, 10], labels=["x", "z"])
    limits = {"force_limits": (-30e3, 30e3), "torque_limits": (-3e3, 1e3)}
    found = run(crane_loop(Crane(), plan, "setpoint", **limits), np.linspace(0, 20, 2001), rtol=1e-8)
    assert found.F.min() == -30e3
    assert found.F.max() == 30e3
    assert found.C.min() >= -3e3
    assert found.C.max() == 1e3
    assert found.T.min() < 0
    free = run(crane_loop(Crane(), plan, "setpoint"), np.linspace(0, 0.01, 3))
    assert free.F[0] > 30e3  # without limits the command is larger


# Dynamic law and flat feedforward


@BOTH
def test_dynamic_law_follows_a_plan_of_ten_constraints(wrap):
    plan = plan_of(5)
    found = run(crane_loop(Crane(rope_wrap=wrap), plan, "dynamic"), np.linspace(0, 8, 81), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose([found.x, found.z], plan(np.linspace(0, 8, 81)), rtol=0, atol=1e-9)


@BOTH
def test_feedforward_follows_a_plan_of_ten_constraints(wrap):
    plan = plan_of(5)
    found = run(crane_loop(Crane(rope_wrap=wrap), plan, "feedforward"), np.linspace(0, 8, 81), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose([found.x, found.z], plan(np.linspace(0, 8, 81)), rtol=0, atol=1e-8)


@BOTH
@pytest.mark.parametrize("poles", [POLES, (-2, -0.7, -1 + 1j, -1 - 1j)])
def test_dynamic_law_leaves_two_chains_of_four_integrators(wrap, poles):
    """Errors from a disturbed start decay as the polynomial of the poles alone says."""
    plan = plan_of(5)
    loop = crane_loop(Crane(rope_wrap=wrap), plan, "dynamic", poles=poles)
    offset, rate, q = 200.0, -80.0, np.array([0.1, 9.7, 0.04, -0.1, 0.08, 0.03])
    t = np.linspace(0, 8, 41)
    found = run(loop, t, np.array([offset, rate, *q]), rtol=1e-12, atol=1e-12)
    s, c, tension, turning = math.sin(q[2]), math.cos(q[2]), M * G + offset, q[5]
    x, z, x1, z1 = load_of(q)
    jet = [[x, z], [x1, z1], [-tension * s / M, G - tension * c / M]]
    jet.append([-(rate * s + tension * turning * c) / M, -(rate * c - tension * turning * s) / M])
    errors = np.array(jet) - plan.jet(0.0, 3)
    sigma = np.real(np.poly(poles))[::-1][:4]
    companion = np.vstack([np.eye(4)[1:], -sigma])
    expected = np.array([(expm(companion * moment) @ errors)[0] for moment in t]).T
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose([found.x, found.z] - plan(t), expected, atol=1e-8)


# Poles


def loop_poles(law, wrap=False, length=10.0, **options):
    loop = crane_loop(Crane(rope_wrap=wrap), cp.Step([0, length], [0, length], labels=["x", "z"]), law, **options)
    return np.asarray(ct.linearize(loop, loop.initial_state, 0).poles())


def factors(length):
    """Of the trolley's PID the numerator, of its open loop the denominator; the pendulum; the closed hoist."""
    s, lag = Polynomial([0, 1]), Polynomial([1, 0.02])

    def controller(mass, friction):
        return (75 * mass * s + 125 * mass) * lag + (15 * mass - friction) * s**2, s * lag

    pendulum = length * s**2 + G
    num, den = controller(MC, F1)
    mass = J / B + M * B
    top, bottom = controller(mass, F2 / B)
    hoist = bottom * s * (mass * s + F2 / B) + top
    return num, den * s * ((MC * s + F1) * pendulum + M * G * s), pendulum, hoist


def expected_poles(law, length, s0=1.0, s1=2.0):
    num, den, pendulum, hoist = factors(length)
    if law == "load_feedback":
        # x = g D/(R s^2 + g) and D_ref = x - (R/g) (s1 s + s0) x
        inner = den + num * pendulum - num * G * (1 - length / G * Polynomial([s0, s1]))
    else:
        inner = den + num * pendulum
    return np.concatenate([inner.roots(), hoist.roots()])


def assert_same_poles(found, expected):
    """Each where it should be, multiple ones included; linearised by differences."""
    left = list(found)
    for pole in expected:
        nearest = min(left, key=lambda p: abs(p - pole))
        assert abs(nearest - pole) < 2e-4 * max(1.0, abs(pole)), (pole, nearest)
        left.remove(nearest)
    return left


@pytest.mark.parametrize("length", [10.0, 5.0])
@pytest.mark.parametrize("law", ["setpoint", "generator"])
def test_poles_of_the_loop_are_those_of_the_transfer_functions(law, length):
    expected = expected_poles(law, length)
    assert assert_same_poles(loop_poles(law, length=length), expected) == []


def test_the_hoist_has_the_poles_of_the_study():
    poles = factors(10.0)[3].roots()
    for pole in (-3.12 + 1.36j, -22 + 7.4j):
        assert np.abs(poles - pole).min() < 0.02
    assert_same_poles(loop_poles("generator"), poles)


def slowest(poles):
    return max(poles[np.abs(poles) > 1e-6], key=lambda pole: (pole.real, pole.imag))


def test_the_generator_lets_the_sway_grow():
    pole = slowest(loop_poles("generator"))
    assert pole.real == pytest.approx(0.00030, abs=1e-5)
    assert abs(pole.imag) == pytest.approx(0.990, abs=5e-4)
    exact = slowest(expected_poles("generator", 10.0))
    assert pole.real == pytest.approx(exact.real, abs=1e-6)


def test_load_feedback_damps_the_sway():
    assert slowest(loop_poles("load_feedback")).real == pytest.approx(-0.87, abs=0.005)


@pytest.mark.parametrize(("w", "zeta"), [(1.0, 1.0), (0.1, 0.7), (3.0, 0.7), (3.0, 1.0)])
def test_poles_with_load_feedback(w, zeta):
    found = loop_poles("load_feedback", load_bandwidth=w, damping=zeta)
    expected = expected_poles("load_feedback", 10.0, w**2, 2 * zeta * w)
    assert assert_same_poles(found, expected) == []
    assert found.real.max() < 0


# Refusals

STEP = cp.Step([20, 11], [0, 10], 1.5, labels=["x", "z"])


@pytest.mark.parametrize(
    ("law", "smooth"), [("generator", 0), ("load_feedback", 0), ("dynamic", 3), ("feedforward", 3)]
)
def test_a_step_is_rejected_where_derivatives_are_needed(law, smooth):
    text = f"law '{law}' .* continuous up to derivative {smooth}, got one whose position of x jumps by 20 at 1.5 s"
    with pytest.raises(ValueError, match=text):
        crane_loop(Crane(), STEP, law)


def test_a_step_may_be_sent_at_rest_references():
    assert crane_loop(Crane(), STEP, "setpoint").initial_state[-6:].tolist() == [-0.25, 10, 0, 0, 0, 0]


@pytest.mark.parametrize("law", ["dynamic", "feedforward"])
@pytest.mark.parametrize("entries", [1, 2, 3])
def test_a_plan_too_rough_for_the_law_is_rejected_with_derivative_and_time(law, entries):
    plan = plan_of(entries).shift(2.0)
    jump = plan.jet(2.0, entries)[entries, 0]
    text = f"up to derivative 3, got one whose derivative {entries} of x jumps by {jump:.4g} at 2 s"
    with pytest.raises(ValueError, match=re.escape(text)):
        crane_loop(Crane(), plan, law)


def test_a_jump_amid_the_plan_is_rejected_with_its_time():
    rest = [0.0] * 4
    first = cp.PolySpline(
        [
            cp.Waypoint.from_jets(0, x=[0, *rest], z=[10, *rest]),
            cp.Waypoint.from_jets(4, x=[4, 1.0, 0, 0], z=[9, 0, 0, 0]),
        ]
    )
    second = cp.PolySpline(
        [
            cp.Waypoint.from_jets(4, x=[4, 1.0, -0.5, 0], z=[9, 0, 0, 0]),
            cp.Waypoint.from_jets(9, x=[8, *rest], z=[10, *rest]),
        ]
    )
    with pytest.raises(ValueError, match=re.escape("derivative 2 of x jumps by -0.5 at 4 s")):
        crane_loop(Crane(), first.then(second), "dynamic")


@pytest.mark.parametrize("law", LAWS)
def test_a_plan_the_rope_cannot_follow_is_rejected(law):
    plunge = plan_of(5, ((0, 0, 5), (1, 0, 12)))
    with pytest.raises(ValueError, match=r"g - z'' must be above 0 for a taut rope, got -.* m/s\^2 at 0\..* s"):
        crane_loop(Crane(), plunge, law)
    above = plan_of(5, ((0, 0, 5), (9, 0, -1)))
    with pytest.raises(ValueError, match=r"R must be above 0, got -1.* m at .* s"):
        crane_loop(Crane(), above, law)


def test_what_does_not_go_together_is_rejected():
    with pytest.raises(ValueError, match="law must be one of setpoint, generator"):
        crane_loop(Crane(), plan_of(3), "pid")
    with pytest.raises(ValueError, match="force_limits and torque_limits must be given with a law that uses the PIDs"):
        crane_loop(Crane(), plan_of(5), "dynamic", force_limits=(-1, 1))
    with pytest.raises(ValueError, match="poles"):
        crane_loop(Crane(), plan_of(5), "dynamic", poles=(1, -1, -1, -1))
    with pytest.raises(ValueError, match="limits must increase"):
        crane_loop(Crane(), plan_of(5), "setpoint", force_limits=(1, -1))
    one = cp.PolySpline([cp.Waypoint(0, 5, 0, 0), cp.Waypoint(1, 6, 0, 0)])
    with pytest.raises(ValueError, match="axes x and z, got 1"):
        crane_loop(Crane(), one)


@pytest.mark.slow
def test_axes_of_other_names_are_taken_in_order():
    points = [cp.Waypoint(0, [0, 10], [0, 0], [0, 0]), cp.Waypoint(6, [4, 9], [0, 0], [0, 0])]
    loop = crane_loop(Crane(), cp.PolySpline(points, labels=["across", "down"]))
    t = np.linspace(0, 8, 5)
    same = crane_loop(Crane(), cp.PolySpline(points, labels=["x", "z"]))
    np.testing.assert_array_equal(run(loop, t).states, run(same, t).states)


def test_axes_called_x_and_z_are_taken_by_name():
    points = [(0, 6, 10), (6, 7, 9)]
    plan = cp.PolySpline([cp.Waypoint.from_jets(t, z=[z, 0, 0], x=[x, 0, 0]) for t, x, z in points])
    assert crane_loop(Crane(), plan).initial_state[-6:-4].tolist() == [6 - B, 10]


@pytest.mark.parametrize(
    ("law", "option"), [("generator", "poles"), ("load_feedback", "dampning"), ("feedforward", "poles")]
)
def test_options_that_the_law_does_not_have_are_rejected(law, option):
    with pytest.raises((TypeError, ValueError), match=option):
        crane_loop(Crane(), plan_of(5), law, **{option: 1.0})
