"""Sample times are exact multiples: an event at a sample time is included, however its time was rounded."""

import control as ct
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp

EPS = np.finfo(float).eps
METHODS = ["exact", "compiled", "python"]


def held(period, offset=0.0):
    """Sample and hold of one signal."""
    return cp.sample_hold(ct.ss([], [], [], [[1.0]], period, inputs="r", outputs="y", name="hold"), period, offset)


def first_seen(system, t, inputs, method):
    """Index of the first sample time at which the output is no longer 0."""
    outputs = np.ravel(cp.simulate(system, t, inputs, method=method).outputs)
    return int(np.flatnonzero(outputs)[0])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shift", [-1e-15, 0.0, 4 * EPS, 1e-15, 1e-13])
@pytest.mark.parametrize("instant", [3, 6, 7])
def test_a_step_at_an_instant_is_seen_by_its_sample(instant, shift, method):
    t = 0.1 * np.arange(11)
    found = first_seen(held(0.1), t, cp.Step(1.0, time=instant / 10 + shift), method)
    assert found == instant


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("step", "delay"), [(0.1, 0.2), (0.3, 0.4), (0.7, 0.1), (0.2, 0.4), (0.1, 0.7)])
def test_a_jump_that_arrives_at_an_instant_is_seen_by_its_sample(step, delay, method):
    late = cp.create_delay_iosystem(delay, inputs="v", outputs="r")
    loop = ct.interconnect([late, held(0.1)], inputs="v", outputs="y")
    t = np.linspace(0.0, 1.0, 11)
    assert first_seen(loop, t, cp.Step(1.0, time=step), method) == round(10 * (step + delay))
    # What the delay itself outputs at that time is the value after the jump.
    assert first_seen(late, t, cp.Step(1.0, time=step), method) == round(10 * (step + delay))


@pytest.mark.slow
@examples(30)
@example(1 / 44100, 2999, 3600.0)
@given(
    st.sampled_from([0.1, 1e-3, 0.7e-3, 1 / 3, 1 / 44100, 2.0**-10, 0.3, 1.2e-3, 0.05]),
    st.integers(1, 300),
    st.sampled_from([0.0, 0.1, -5.0, 1e4, 3600.0]),
)
def test_every_instant_sees_a_step_at_its_decimal_time(period, k, first):
    """The time of the step is computed as a user would: first + k period, and as first plus a decimal."""
    t = first + period * np.array([0, k - 1, k, k + 1]) if k > 1 else first + period * np.arange(3)
    for time in (first + k * period, first + float(f"{k * period:.15g}")):
        block = held(period)
        outputs = np.ravel(cp.simulate(block, t, cp.Step(1.0, time=time), method="python").outputs)
        place = int(np.argmin(np.abs(t - time)))
        assert outputs[place:].tolist() == [1.0] * (t.size - place)
        assert outputs[:place].tolist() == [0.0] * place


@pytest.mark.parametrize("method", METHODS)
def test_blocks_of_several_rates_meet_at_common_instants(method):
    """A block every 0.1 s in front of one every 0.3 s: at 0.3 k the slow one sees the new output of the fast one."""
    fast = cp.sample_hold(ct.ss([], [], [], [[1.0]], 0.1, inputs="r", outputs="v", name="fast"), 0.1)
    slow = cp.sample_hold(ct.ss([], [], [], [[1.0]], 0.3, inputs="v", outputs="y", name="slow"), 0.3)
    loop = ct.interconnect([slow, fast], inputs="r", outputs=["v", "y"])
    t = np.linspace(0.0, 3.0, 31)
    ramp = cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(3, 3)])
    found = cp.simulate(loop, t, ramp, method=method)
    expected = np.array([np.arange(31) / 10, np.arange(31) // 3 * 0.3])
    assert np.abs(found.outputs - expected).max() < 8 * EPS


@pytest.mark.parametrize("first", [1e9, -1e9])
def test_a_run_that_starts_late_keeps_its_instants(first):
    """1 kHz at 1e9 s: sample times are 1 ms apart, not merged."""
    counter = ct.nlsys(
        lambda t, x, u, params: x + 1, lambda t, x, u, params: x + 1, inputs=0, outputs="n", states="n", dt=0.001
    )
    found = cp.simulate(cp.sample_hold(counter, 0.001, name="count"), first + np.array([0.0, 0.05, 0.1]))
    assert found.outputs[0].tolist() == [1.0, 51.0, 101.0]


def test_a_period_below_the_resolution_of_time_is_rejected():
    with pytest.raises(ValueError, match="the period of hold must exceed the rounding of times up to 1e"):
        cp.simulate(held(1e-9), 1e9 + np.array([0.0, 1.0]), 1.0)


@pytest.mark.parametrize("end", [0.999, pytest.param(9.999, marks=pytest.mark.slow)])
def test_the_samples_of_a_long_run_do_not_drift(end):
    """The 10,000th sample of a signal at 1 kHz is that of 9.999 s to rounding of the signal there."""
    t = np.array([0.0, end + 0.0005])
    sine = cp.TrigSpline([cp.Waypoint(0, 0, 1), cp.Waypoint(10, 3, -2)], alpha=3.0)
    found = cp.simulate(held(1e-3), t, sine, method="python")
    assert float(np.ravel(found.outputs)[-1]) == pytest.approx(float(sine(end)), rel=8 * EPS)
