"""PID against its transfer function; limits, bias and anti-windup against closed forms."""

import math

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.systems.pid import create_pid_iosystem

GAINS = (3.0, 1.5, 2.0, 0.1)


def transfer(s, kp=3.0, ki=1.5, kd=2.0, tf=0.1):
    return kp + ki / s + kd * s / (tf * s + 1)


@pytest.mark.parametrize("gains", [GAINS, (3.0, 0.0, 2.0, 0.1), (3.0, 1.5, 0.0, 0.1), (0.0, 1.5, -2.0, 0.7)])
def test_without_limits_and_bias_it_is_the_transfer_function(gains):
    block = create_pid_iosystem(*gains)
    assert isinstance(block, ct.StateSpace)
    assert (block.input_labels, block.output_labels) == (["r", "y"], ["u"])
    for w in (0.01, 0.7, 3.0, 40.0, 900.0):
        found = block(1j * w).ravel()
        np.testing.assert_allclose(found, [transfer(1j * w, *gains), -transfer(1j * w, *gains)], rtol=1e-12)


def test_names():
    block = create_pid_iosystem(*GAINS, name="drive", inputs=("D_ref", "D"), outputs="F", limits=(-1, 1))
    assert (block.name, block.input_labels, block.output_labels) == ("drive", ["D_ref", "D"], ["F"])
    assert block.state_labels == ["integral", "filter"]
    _, low, high = cp.traits_of(block).watched["F"]
    assert (list(cp.traits_of(block).watched), low, high) == (["F"], -1.0, 1.0)


@pytest.mark.parametrize("options", [{"bias": 7.0}, {"limits": (-1e9, 1e9)}, {"bias": -2.0, "limits": (-1e9, 1e9)}])
def test_bias_is_added_and_wide_limits_do_nothing(options):
    linear, block = create_pid_iosystem(*GAINS), create_pid_iosystem(*GAINS, **options)
    for state, u in [([0.4, -1.0], [2.0, 0.5]), ([0.0, 0.0], [0.0, 0.0]), ([-3.0, 5.0], [-1.0, 4.0])]:
        shifted = linear.output(0.0, state, u) + options.get("bias", 0.0)
        np.testing.assert_allclose(block.output(0.0, state, u), shifted, rtol=1e-14)
        np.testing.assert_allclose(block.dynamics(0.0, state, u), linear.dynamics(0.0, state, u), rtol=1e-14)


def test_limits_act_on_the_total():
    block = create_pid_iosystem(2.0, 1.0, 0.0, 0.1, bias=-10.0, limits=(-12.0, 1.0))

    def out(integral, error):
        return float(block.output(0.0, [integral, 0.0], [error, 0.0])[0])

    assert out(0.0, 0.0) == -10.0
    assert out(0.0, 5.0) == 0.0  # 10 of the proportional part less the bias: not limited
    assert out(0.0, 5.75) == 1.0
    assert out(0.25, 5.5) == 1.0
    assert out(3.0, 5.0) == 1.0
    assert out(0.0, -1.0) == -12.0
    assert out(-1.0, -1.0) == -12.0


@pytest.mark.parametrize(
    ("gains", "given", "time"),
    [
        ((3.0, 1.5, 2.0, 0.1), None, math.sqrt(2 / 1.5)),
        ((3.0, 1.5, 0.0, 0.1), None, 3 / 1.5),
        ((3.0, 1.5, 2.0, 0.1), 0.25, 0.25),
    ],
)
def test_integral_is_led_back_with_the_tracking_time(gains, given, time):
    block = create_pid_iosystem(*gains, bias=1.0, limits=(-2.0, 2.0), tracking_time=given)
    # The filter at the error: no derivative part.
    for integral, error in ((50.0, 0.5), (-50.0, 0.5), (0.1, -0.2)):
        total = 1.0 + gains[0] * error + integral
        expected = gains[1] * error + (min(max(total, -2.0), 2.0) - total) / time
        found = block.dynamics(0.0, [integral, error], [error, 0.0])
        np.testing.assert_allclose(found, [expected, 0.0], rtol=1e-13, atol=1e-14)


def test_windup_is_led_back_in_closed_form():
    """With a constant error the integral converges exponentially to where the total exceeds the limit by Tt ki e."""
    block = create_pid_iosystem(2.0, 1.0, 0.0, 0.1, limits=(-5.0, 5.0), tracking_time=0.5)
    t = np.linspace(0, 6, 25)
    found = cp.simulate(block, t, {"r": 4.0}, initial_state=[0.0, 4.0], rtol=1e-11, atol=1e-12)
    # I' = 4 + (5 - 8 - I)/0.5, from 0 to -1
    np.testing.assert_allclose(found.states[0], -1 + np.exp(-2 * t), atol=1e-8)
    np.testing.assert_array_equal(np.asarray(found.outputs).ravel(), 5.0)


def test_anti_windup_leaves_saturation_sooner_than_none():
    """1/s with limits: from a long demand the overshoot stays small."""
    plant = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y", name="plant")
    overshoot = []
    for tracking in (None, 1e9):
        block = create_pid_iosystem(2.0, 1.0, 0.0, 0.1, limits=(-1.0, 1.0), tracking_time=tracking)
        loop = ct.interconnect([block, plant], inputs=["r"], outputs=["y", "u"])
        found = cp.simulate(loop, np.linspace(0, 60, 601), {"r": 10.0})
        assert np.abs(found.outputs[1]).max() == 1.0
        overshoot.append(float(np.max(found.outputs[0])) - 10.0)
        if tracking is None:
            assert found.outputs[0][-1] == pytest.approx(10.0, abs=1e-3)
    assert overshoot[0] < 1.0 < 5.0 < overshoot[1]


@pytest.mark.parametrize("name", ["kp", "ki", "kd", "bias"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_must_be_finite(name, value):
    with pytest.raises(ValueError, match=f"{name} must be finite"):
        create_pid_iosystem(**{"kp": 1.0, "ki": 1.0, "kd": 1.0, "tf": 0.1, name: value})


@pytest.mark.parametrize("tf", [0.0, -0.1, math.nan, math.inf])
def test_filter_must_be_above_zero(tf):
    with pytest.raises(ValueError, match="tf must be finite and above 0"):
        create_pid_iosystem(1.0, 1.0, 1.0, tf)


@pytest.mark.parametrize("limits", [(1.0, 1.0), (2.0, -2.0), (math.nan, 1.0), (0.0, math.nan)])
def test_limits_must_increase(limits):
    with pytest.raises(ValueError, match=r"limits must (increase|be a number, got nan)"):
        create_pid_iosystem(*GAINS, limits=limits)


@pytest.mark.parametrize("time", [0.0, -1.0, math.nan, math.inf])
def test_tracking_time_must_be_above_zero(time):
    with pytest.raises(ValueError, match="tracking_time must be finite and above 0"):
        create_pid_iosystem(*GAINS, limits=(-1, 1), tracking_time=time)
