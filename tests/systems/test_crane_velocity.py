"""The crane with a velocity-commanded trolley: its equations, its loop, and shaping while the rope is hoisted."""

import math

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlplan as cp
from ctrlplan.systems.plants import Crane, crane_loop

CRANE = Crane()
REST = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
DT = 0.05


def signal(response, name):
    return np.asarray(response.outputs)[list(response.output_labels).index(name)]


# Equations


@pytest.mark.parametrize("rope_wrap", [False, True])
def test_equations_of_motion(rope_wrap):
    """The equations of the documentation, with D'' = (v_cmd - D')/lag in place of that of the trolley."""
    crane = Crane(rope_wrap=rope_wrap)
    block = crane.iosystem(drive="velocity", drive_lag=0.3, wind=True)
    assert block.input_labels == ["v_cmd", "C", "wind"]
    m, M, J, b, f1, f2, g = crane.numbers()
    rng = np.random.default_rng(3)
    for _ in range(50):
        _, R, theta, D1, R1, theta1 = state = rng.normal([0, 8, 0, 0, 0, 0], [2, 1, 0.5, 1, 0.5, 0.5])
        v, C, wind = u = rng.normal([0, -1200, 0], [1, 300, 200])
        rates = block.dynamics(0.0, state, u)
        out = dict(zip(block.output_labels, block.output(0.0, state, u), strict=True))
        np.testing.assert_array_equal(rates[:3], state[3:])
        D2, R2, theta2, T = *rates[3:], out["T"]
        s, c = math.sin(theta), math.cos(theta)
        assert pytest.approx((v - D1) / 0.3, rel=1e-14) == D2
        assert c * D2 + R * theta2 == pytest.approx(wind / m * c - g * s - 2 * R1 * theta1 + b * theta1**2, abs=1e-12)
        along = s * D2 + R2 - b * theta2 + T / m
        assert along == pytest.approx(wind / m * s + g * c + R * theta1**2, abs=1e-11)
        turned, turning = (R2 / b - theta2, R1 / b - theta1) if rope_wrap else (R2 / b, R1 / b)
        assert J * turned - b * T == pytest.approx(C - f2 * turning, rel=1e-12)
        assert out["F"] == pytest.approx(M * D2 + f1 * D1 - T * s, rel=1e-12, abs=1e-9)
        assert out["sway_frequency"] == pytest.approx(math.sqrt(g / R), rel=1e-15)
        # The same force on the crane with force drive gives the same accelerations.
        np.testing.assert_allclose(crane.accelerations(state, out["F"], C, wind)[:3], rates[3:], rtol=1e-10, atol=1e-10)


def test_the_load_of_a_held_rope_is_a_pendulum():
    """The drum held by the PID: against an integration of the pendulum with the length of the response."""
    loop = crane_loop(CRANE, REST, "setpoint", drive="velocity", drive_lag=0.2)
    t = np.linspace(0.0, 12.0, 241)
    found = cp.simulate(loop, t, cp.Step(1.0), rtol=1e-10)
    b, g = CRANE.drum_radius, CRANE.gravity
    # The trolley in closed form.
    np.testing.assert_allclose(signal(found, "D_d1"), 1.0 - np.exp(-t / 0.2), rtol=0, atol=1e-8)
    lengths, rates = signal(found, "R"), signal(found, "R_d1")
    assert np.abs(lengths - 10.0).max() < 0.02

    def pendulum(time, x):
        R, R1 = np.interp(time, t, lengths), np.interp(time, t, rates)
        D2 = math.exp(-time / 0.2) / 0.2
        turning = -g * math.sin(x[0]) - 2 * R1 * x[1] + b * x[1] ** 2 - math.cos(x[0]) * D2
        return [x[1], turning / R]

    wanted = solve_ivp(pendulum, (0.0, 12.0), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-10).y[0]
    # The length is interpolated linearly: its error is far below 1e-4 of 10 m.
    np.testing.assert_allclose(signal(found, "theta"), wanted, rtol=0, atol=1e-4 * np.abs(wanted).max())


# The loop


def test_signals_of_the_loop():
    loop = crane_loop(CRANE, REST, drive="velocity")
    assert loop.input_labels == ["v_cmd"]
    force = crane_loop(CRANE, REST)
    assert set(loop.output_labels) == {*force.output_labels, "sway_frequency"}
    assert "trolley_pid" not in " ".join(block.name for block in loop.syslist)
    np.testing.assert_array_equal(loop.initial_state[-6:], CRANE.equilibrium(0.0, 10.0)[0])
    with_wind = crane_loop(CRANE, REST, drive="velocity", inputs=["wind"])
    assert with_wind.input_labels == ["wind", "v_cmd"]


def test_at_rest_without_a_command():
    found = cp.simulate(crane_loop(CRANE, REST, drive="velocity"), np.linspace(0.0, 5.0, 11), 0.0)
    np.testing.assert_allclose(signal(found, "theta"), 0.0, atol=1e-12)
    np.testing.assert_allclose(signal(found, "x"), 0.0, atol=1e-12)


def test_a_block_may_command_the_trolley():
    source = cp.create_source_iosystem(REST, 2, suffix="_ref")
    limited = cp.create_saturation_iosystem(-0.5, 0.5, inputs="v_op", outputs="v_cmd")
    loop = crane_loop(CRANE, REST, drive="velocity", reference=[source, limited], inputs=["v_op"])
    assert loop.input_labels == ["v_op"]
    found = cp.simulate(loop, [0.0, 4.0], cp.Step(3.0))
    assert signal(found, "D_d1")[-1] == pytest.approx(0.5, abs=1e-8)
    assert signal(found, "v_cmd")[-1] == 0.5


def test_the_lag_is_a_parameter():
    loop = crane_loop(CRANE, REST, drive="velocity", drive_lag=0.1)
    for lag in (0.1, 0.7):
        found = cp.simulate(loop, [0.0, 0.5, 1.0], cp.Step(1.0), params={"drive_lag": lag})
        np.testing.assert_allclose(signal(found, "D_d1"), 1.0 - np.exp(-np.array([0.0, 0.5, 1.0]) / lag), atol=1e-7)


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_methods_agree(method):
    loop = crane_loop(CRANE, REST, drive="velocity")
    t = np.linspace(0.0, 4.0, 41)
    found = cp.simulate(loop, t, cp.Step(1.0), method=method, rtol=1e-9)
    wanted = cp.simulate(loop, t, cp.Step(1.0), rtol=1e-10)
    np.testing.assert_allclose(signal(found, "theta"), signal(wanted, "theta"), rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"drive": "speed"}, "drive must be 'force' or 'velocity', got 'speed'"),
        ({"drive_lag": 0.0}, "drive_lag must be finite and above 0, got 0"),
        ({"drive_lag": math.nan}, "drive_lag must be finite and above 0, got nan"),
        ({"law": "dynamic"}, "law must have the outputs D_ref and R_ref with drive='velocity', got 'dynamic'"),
        ({"law": "feedforward"}, "law must have the outputs D_ref and R_ref with drive='velocity'"),
        ({"law": "load_feedback"}, "law must not feed back the load with drive='velocity', .* which reads x, x_d1"),
        ({"force_limits": 1e4}, "force_limits must be given with drive='force', .* limit v_cmd by create_saturation"),
    ],
)
def test_what_is_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        crane_loop(CRANE, REST, **({"drive": "velocity"} | options))


# Shaping while the rope is hoisted


def residual_sway(shaper, seconds, command, measured=False):
    """Peak sway angle after an operator's command and the hoist from 10 to 5 m [rad]."""
    hoist = cp.PolySpline([cp.Waypoint(0.0, 10.0, 0, 0), cp.Waypoint(seconds, 5.0, 0, 0)])
    plan = cp.stack([cp.Step(0.0), hoist], labels=["x", "z"])
    loop = crane_loop(CRANE, plan, "setpoint", drive="velocity")
    block = cp.create_shaper_iosystem(
        shaper, DT, frequency_input="sway_frequency" if measured else None, inputs="v_op", outputs="v_cmd"
    )
    others = [name for name in loop.output_labels if name not in ("theta", "sway_frequency")]
    system = ct.interconnect([block, loop], inputs=["v_op"], outputs=["theta", "sway_frequency", *others])
    end = max(seconds, command.end + 7.0)
    found = cp.simulate(system, np.append(0.0, np.linspace(end, end + 6.0, 241)), command)
    return float(np.abs(signal(found, "theta")[found.time >= end]).max())


def fixed_at(length):
    return cp.Shaper.zv(math.sqrt(CRANE.gravity / length))


DRIVES = {
    "pulse of 8 s": cp.Step(0.5, time=1.0) - cp.Step(0.5, time=9.0),
    "ramps": cp.Trapezoid(0.5, velocity=0.5, acceleration=2.0, time=1.0)
    - cp.Trapezoid(0.5, velocity=0.5, acceleration=2.0, time=10.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [10.0, 20.0])
@pytest.mark.parametrize("drive", DRIVES)
def test_hoisting_with_a_measured_rope(seconds, drive):
    """At most a fifth of the sway with the shaper for 10 m, and a third of that with the one for 7.5 m."""
    command = DRIVES[drive]
    left = residual_sway(fixed_at(10.0), seconds, command, measured=True)
    assert left <= 0.2 * residual_sway(fixed_at(10.0), seconds, command)
    assert left <= residual_sway(fixed_at(7.5), seconds, command) / 3.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "share"), [(cp.Shaper.zvd, 0.2), (cp.Shaper.mzv, 0.2), (cp.Shaper.two_hump_ei, 0.2), (cp.Shaper.ei, 0.5)]
)
def test_hoisting_with_other_kinds(kind, share):
    """A fifth of the sway of the same kind for 10 m; EI, which leaves its tolerance, half of it."""
    frequency = math.sqrt(CRANE.gravity / 10.0)
    command = DRIVES["pulse of 8 s"]
    left = residual_sway(kind(frequency), 10.0, command, measured=True)
    assert left <= share * residual_sway(kind(frequency), 10.0, command)
