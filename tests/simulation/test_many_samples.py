"""Runs with far more sample times than can be computed end before they take time or memory."""

import tracemalloc

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

T = np.linspace(0.0, 10.0, 11)


def sampled_loop(period, linear, late=False):
    law = ct.ss([], [], [], [[1.0, -1.0]], period, inputs=["r", "y"], outputs="u", name="law")
    wire = "late" if late else "u"
    if linear:
        plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs=wire, outputs="y", name="plant")
    else:
        plant = ct.nlsys(lambda t, x, u, p: u - x**3, None, states=1, inputs=wire, outputs="y", name="plant")
    delay = [cp.create_delay_iosystem(1.0, inputs="u", outputs="late")] if late else []
    return ct.interconnect([plant, cp.sample_hold(law, period), *delay], inputs="r", outputs="y")


TEXT = r"a run must have at most 5e\+06 sample times, got 1e\+10 in 10 s, with the period of law\S* of 1e-09 s; use"


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("linear", [False, True])
def test_a_period_far_shorter_than_the_run(linear, late):
    loop = sampled_loop(1e-9, linear, late)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=TEXT):
            cp.simulate(loop, T, 1.0)
        assert tracemalloc.get_traced_memory()[1] < 50e6  # the sample times alone are 80 GB
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("linear", [False, True])
def test_a_step_with_far_too_many_samples(linear):
    with pytest.raises(ValueError, match=r"at most 5e\+06 sample times, got 1e\+09 in 1 s"):
        cp.prepare(sampled_loop(1e-9, linear)).start(1.0).step(1.0)


def test_a_discrete_system_whose_stored_values_need_too_much_memory():
    """At most 5e8 values, 1 state and 2 signals: a limit below 1e8 periods for 10 states."""
    n = 10
    wide = ct.ss(0.5 * np.eye(n), np.ones((n, 1)), np.ones((1, n)), 0, 1e-7)
    with pytest.raises(ValueError, match=r"at most 4.17e\+07 periods of .*, got 1e\+08, since 12 states"):
        cp.simulate(wide, T, 1.0)
