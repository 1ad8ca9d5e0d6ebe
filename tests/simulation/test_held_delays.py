"""Delays of what sampled blocks hold in nonlinear loops, compared with DOP853 that starts at each jump."""

from fractions import Fraction

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlplan as cp

TARGET, HELD, INITIAL = -0.7, 0.35, 0.15
"""The reference, what the controller holds at the start, and the output of the first delay before that has passed."""

START = np.array([0.25, -0.4])


def rates(x, w):
    return np.array([x[1], w - 1.5 * np.sin(x[0]) - 0.4 * x[1] * abs(x[1])])


def limited_loop(period, offset, first, second):
    """A PI controller u, s = tanh u, and w = (s + v) late, where v is s late."""
    law = ct.ss([[1.0]], [[0.1, -0.1]], [[0.9]], [[1.7, -1.7]], period, inputs=["r", "y"], outputs="u", name="law")
    blocks = [
        ct.nlsys(lambda t, x, u, p: rates(x, u[0]), lambda t, x, u, p: x[:1], states=2, inputs="w", outputs="y"),
        cp.sample_hold(law, period, offset),
        ct.nlsys(None, lambda t, x, u, p: np.tanh(u), inputs="u", outputs="s", name="limit"),
        cp.create_delay_iosystem(first, inputs="s", outputs="v", name="first", initial=INITIAL),
        ct.summing_junction(["s", "v"], "q", name="sum"),
        cp.create_delay_iosystem(second, inputs="q", outputs="w", name="second"),
    ]
    return ct.interconnect(blocks, inputs="r", outputs=["y", "u", "v", "w"])


def expected_outputs(period, offset, first, second, last):
    """Times of all jumps, and the outputs just after each."""
    samples = [offset + k * period for k in range(int((last - offset) / period) + 1)]
    changes = [Fraction(0), *samples]
    jumps = {t + late for t in changes for late in (0, first, second, first + second)} | {first, second, last}
    jumps = sorted(t for t in jumps if t <= last)
    x, integral, held, found = START, 0.5, [(Fraction(0), HELD)], []

    def s(t):
        return np.tanh(next(value for since, value in reversed(held) if since <= t))

    def v(t):
        return s(t - first) if t >= first else INITIAL

    for k, t in enumerate(jumps):
        if t in samples:
            held.append((t, 0.9 * integral + 1.7 * (TARGET - x[0])))
            integral += 0.1 * (TARGET - x[0])
        w = s(t - second) + v(t - second) if t >= second else 0.0
        found.append((x[0], held[-1][1], v(t), w))
        if t < last:
            span = float(t), float(jumps[k + 1])
            x = solve_ivp(lambda t, x, w=w: rates(x, w), span, x, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return np.array([float(t) for t in jumps]), np.transpose(found)


CASES = [("0.04", "0", "0.0007", "0.025"), ("0.08", "0.03", "0.09", "0.00002"), ("0.06", "0", "0.03", "0.03")]
"""Period, offset and two delays [s]: of a part of the period, of 2e-5 of the run, and that meet each other."""


@pytest.mark.parametrize("method", ["compiled", "python"])
@pytest.mark.parametrize("case", CASES)
def test_held_signals_through_two_delays(case, method):
    period, offset, first, second = map(Fraction, case)
    times, expected = expected_outputs(period, offset, first, second, Fraction("0.9"))
    loop = limited_loop(*map(float, (period, offset, first, second)))
    found = cp.simulate(loop, times, TARGET, [*START, 0.5, HELD], method=method, rtol=1e-11)
    assert found.method == method
    assert np.abs(found.outputs - expected).max() <= 1e-9


@pytest.mark.parametrize("delay", [0.004, 0.00004])
def test_a_stepper_with_a_held_signal_that_comes_late(delay):
    """With steps that end between the samples and the arrivals."""
    late = Fraction(str(delay))
    times, expected = expected_outputs(Fraction("0.05"), Fraction(0), late, 3 * late, Fraction("0.5"))
    stepper = cp.prepare(limited_loop(0.05, 0.0, delay, 3.0 * delay)).start(0.02, [*START, 0.5, HELD], rtol=1e-10)
    found = np.transpose([stepper.step(TARGET) for _ in range(25)])
    ends = 0.1 * np.arange(1, 5)  # samples; the outputs after a step are those before the samples at its end
    before = np.searchsorted(times, ends - 1e-9) - 1
    assert np.abs(found[0, 4:20:5] - expected[0, before + 1]).max() <= 1e-8
    assert np.abs(found[1:, 4:20:5] - expected[1:, before]).max() <= 1e-8


def test_a_short_delay_of_a_held_signal_costs_two_segments_a_sample():
    """Calls of the plant by method "python": a segment for each delay would make 300 times as many."""
    calls = []

    def counted(t, x, u, p):
        calls.append(t)
        return rates(x, u[0])

    law = ct.ss([], [], [], [[1.2, -1.2]], 0.03, inputs=["r", "y"], outputs="u", name="law")

    def loop(blocks, read):
        plant = ct.nlsys(counted, lambda t, x, u, p: x[:1], states=2, inputs=read, outputs="y", name="plant")
        return ct.interconnect([plant, cp.sample_hold(law, 0.03), *blocks], inputs="r", outputs="y")

    numbers = []
    for system in (
        loop([], "u"),
        loop([cp.create_delay_iosystem(1e-4, inputs="u", outputs="w", name="late")], "w"),
    ):
        calls.clear()
        cp.simulate(system, [0.0, 0.9], TARGET, [*START, HELD], method="python")
        numbers.append(len(calls))
    assert numbers[1] < 4 * numbers[0]


def test_a_delay_below_the_rounding_of_times():
    with pytest.raises(ValueError, match=r"a delay must exceed the rounding of times, .* s, got 1e-13 s"):
        cp.simulate(limited_loop(0.05, 0.0, 1e-13, 0.01), [0.0, 1.0], TARGET)
