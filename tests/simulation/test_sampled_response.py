"""Signals of sampled loops along a plan: extrema between samples, compared with many exact points in between."""

import math

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlplan as cp

A, B = np.array([[0.0, 1.0], [-4.0, -0.8]]), np.array([[0.0], [4.0]])
PLAN = cp.PolySpline([cp.Waypoint(0.2, 0, 0, 0), cp.Waypoint(1.7, 1.0, 0, 0)], labels=["r"])
FINE = 200


def loop(period=0.1, gain=0.6, offset=0.0, delay=0.0, **names):
    """PI control of an oscillator; the control may come late."""
    law = ct.ss(1.0, [[period, -period]], [[0.8]], [[gain, -gain]], period, inputs=["r", "y"], outputs="u", name="law")
    plant = ct.ss(A, B, np.eye(2), 0, inputs="w" if delay else "u", outputs=["y", "v"], name="plant")
    blocks = [cp.sample_hold(law, period, offset), plant]
    if delay:
        blocks.append(cp.create_delay_iosystem(delay, inputs="u", outputs="w"))
    return ct.interconnect(blocks, inputs="r", outputs=["y", "v", "u"], name="loop")


def stepped(plan, period=0.1, gain=0.6, offset=0.0, count=400):
    """y and v at many points of each period until long after the plan, and the held control, by hand."""
    step = expm(np.block([[A, B], [np.zeros((1, 3))]]) * period / FINE)
    start = plan.start + offset
    x, xi, rows, held = np.zeros(3), 0.0, [], []
    x[0] = plan.initial[0]
    xi = x[0] / 0.8
    x[2] = x[0]
    rows.append(x.copy())
    for k in range(count):
        error = float(plan(start + k * period)) - x[0]
        x[2] = 0.8 * xi + gain * error
        xi += period * error
        held.append(x[2])
        for _ in range(FINE):
            rows.append(x.copy())
            x = step @ x
    return np.array(rows), np.array(held)


@pytest.mark.parametrize("offset", [0.0, 0.03])
def test_extrema_between_samples(offset):
    rows, held = stepped(PLAN, offset=offset)
    response = cp.loop_quantities(loop(offset=offset)).quantities_of(PLAN)
    for name, column in (("y", 0), ("v", 1)):
        found = response.extremes({name: 1.0})
        # A point lies at most half a step from the extremum, where the curvature is below 40.
        allowed = 40.0 * (0.05 / FINE) ** 2
        assert -1e-12 <= rows[:, column].min() - found.low <= allowed
        assert -1e-12 <= found.high - rows[:, column].max() <= allowed
    found = response.extremes({"u": 1.0})
    assert abs(found.low - min(held.min(), 0.0)) <= 1e-12  # at rest until the first sample
    assert abs(found.high - held.max()) <= 1e-12
    assert abs(response.extremes({"u": 1.0}, rate=True).high - np.diff(held, prepend=0.0).max() / 0.1) <= 1e-11
    before, after = response.ends({"y": 1.0})
    assert (before, round(after, 12)) == (0.0, 1.0)
    assert response.note == "exact"


def test_the_interval_and_the_line_of_a_limit():
    """y - v/2 from 1.03 to 1.47 s, against its points there."""
    rows, _ = stepped(PLAN)
    times = PLAN.start + 0.1 / FINE * np.arange(len(rows) - 1)
    row = rows[1:, 0] - 0.5 * rows[1:, 1]
    inside = (times >= 1.03) & (times <= 1.47)
    response = cp.loop_quantities(loop()).quantities_of(PLAN)
    found = response.extremes({"y": 1.0, "v": -0.5}, during=(1.03, 1.47))
    # At its ends the signal may have a slope of up to 6, and a point lies at most a step from them.
    assert abs(found.high - row[inside].max()) <= 6.0 * 0.1 / FINE
    assert abs(found.low - row[inside].min()) <= 6.0 * 0.1 / FINE
    straight = response.extremes({"y": 1.0}, during=(1.0, 1.5), line=(2.0, 3.0))
    inside = (times >= 1.0) & (times <= 1.5)
    expected = rows[1:, 0][inside] - 2.0 - (times[inside] - 1.0) / 0.5
    assert abs(straight.high - expected.max()) <= 6.0 * 0.1 / FINE
    whole = response.values({"y": 1.0}, times[:600])
    assert np.abs(whole - rows[1:601, 0]).max() <= 1e-12


def test_rate_and_mean_square():
    """The derivative of y is v; the mean square by Simpson's rule over the points of the plan."""
    rows, held = stepped(PLAN)
    response = cp.loop_quantities(loop()).quantities_of(PLAN)
    rate, speed = response.extremes({"y": 1.0}, rate=True), response.extremes({"v": 1.0})
    assert np.allclose([rate.low, rate.high], [speed.low, speed.high], rtol=0.0, atol=1e-11)
    count = round(PLAN.duration / 0.1)
    points = rows[1 : 2 + count * FINE, 0] ** 2
    weights = np.tile([2.0, 4.0], points.size // 2 + 1)[: points.size]
    weights[[0, -1]] = 1.0
    mean = float(weights @ points) / 3.0 * (0.1 / FINE) / PLAN.duration
    assert abs(response.rms("y") - math.sqrt(mean)) <= 1e-9
    assert abs(response.rms("u") - math.sqrt(np.mean(held[:count] ** 2))) <= 1e-12
    with pytest.raises(ValueError, match=r"a signal with a limited rate must be continuous, got u \+ y that jumps at"):
        response.extremes({"u": 1.0, "y": 1.0}, rate=True)


def test_an_unstable_loop_is_rejected():
    with pytest.raises(ValueError, match=r"stable for limits .* loop, which is unstable: over 0\.1 s, .* factor"):
        cp.loop_quantities(loop(gain=30.0))
    memory = cp.sample_hold(ct.ss(1.0, 0.0, 1.0, 0.0, 0.1, inputs="r", outputs="h", name="memory"), 0.1)
    assert cp.loop_quantities(memory).note == "exact, at all times"
    turning = ct.ss([[0.0, -1.0], [1.0, 0.0]], [[1.0], [0.0]], [[1.0, 0.0]], 0.0, 0.1, inputs="r", outputs="h")
    with pytest.raises(ValueError, match=r"which is undamped: over 0\.1 s"):
        cp.loop_quantities(cp.sample_hold(turning, 0.1))


def test_a_delay_must_start_at_rest():
    plan = cp.PolySpline([cp.Waypoint(0, 2.0, 0, 0), cp.Waypoint(1.5, 1.0, 0, 0)], labels=["r"])
    with pytest.raises(ValueError, match=r"outputs of a delay must start at its inputs .* got initial = \[0\.0\]"):
        cp.loop_quantities(loop(delay=0.05)).quantities_of(plan)
    found = cp.loop_quantities(loop(delay=0.05)).quantities_of(PLAN).extremes({"y": 1.0})
    times = np.linspace(PLAN.start, 30.0, 20_001)
    run = cp.simulate(loop(delay=0.05), times, PLAN)
    assert abs(found.high - run.outputs[0].max()) <= 1e-6


@pytest.mark.slow
def test_the_fastest_plan_attains_the_limit():
    """The overshoot of y is the limit at the duration found, and above it at a slightly shorter one, by hand."""
    found = cp.fastest(PLAN, {"y": (-0.1, 1.05)}, loop())
    peaks = [stepped(PLAN.retime(found.duration * factor))[0][:, 0].max() for factor in (1.0, 0.999)]
    assert 1.05 - 1e-4 <= peaks[0] <= 1.05 + 1e-9
    assert peaks[1] > 1.05
    margins = cp.margins(found.plan, {"y": (-0.1, 1.05)}, loop())
    assert margins.note == "exact, at all times"
