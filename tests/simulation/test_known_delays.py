"""Short delays in nonlinear loops: of signals known before a run, and the warning where a signal is found in it."""

from itertools import pairwise

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlplan as cp

PLAN = cp.TrigSpline([cp.Waypoint(0.1, 0.0, 0.0), cp.Waypoint(0.6, 1.0, 0.0)], alpha=1.0)
START = np.array([0.25, -0.4])
METHODS = pytest.mark.parametrize("method", ["compiled", "python"])


def rates(x, w):
    return np.array([x[1], w - 1.5 * np.sin(x[0]) - 0.4 * x[1] * abs(x[1])])


def pendulum(calls=None):
    def update(t, x, u, p):
        if calls is not None:
            calls.append(t)
        return rates(x, u[0])

    return ct.nlsys(update, lambda t, x, u, p: x[:1], states=2, inputs="w", outputs="y", name="pendulum")


def late(delay, first, second, initial=0.0):
    return cp.create_delay_iosystem(delay, inputs=first, outputs=second, name=f"late {second}", initial=initial)


def integrated(input_of, marks, times):
    """States at times, by DOP853 from mark to mark; `input_of` maps a time and the middle of its segment."""
    ends, x, found = [*marks, times[-1]], START, np.empty((2, len(times)))
    for left, right in pairwise(ends):
        inside = (times >= left) & (times <= right)
        points = np.union1d(times[inside], [left, right])
        run = solve_ivp(
            lambda t, x, middle=0.5 * (left + right): rates(x, input_of(t, middle)),
            (left, right),
            x,
            "DOP853",
            points,
            rtol=1e-12,
            atol=1e-14,
        )
        found[:, inside] = run.y[:, np.isin(points, times[inside])]
        x = run.y[:, -1]
    return found


@METHODS
@pytest.mark.parametrize("delays", [(1e-7, 3e-5), (0.2, 1e-9), (0.1, 0.3)])
def test_sums_of_plans_and_samples_through_two_delays(method, delays):
    """w = v late by the second delay, where v = 2 (plan - samples) late by the first and 0.3 before."""
    times = np.linspace(0.0, 1.0, 11)
    samples = np.where(times > 0.45, 0.7, 0.2)
    first, second = delays
    blocks = [
        pendulum(),
        ct.ss([], [], [], [[2.0, -2.0]], inputs=["r", "s"], outputs="q", name="gain"),
        late(first, "q", "v", 0.3),
        late(second, "v", "w"),
    ]
    loop = ct.interconnect(blocks, inputs=["r", "s"], outputs=["y", "w"])
    found = cp.simulate(loop, times, {"r": PLAN, "s": samples}, START, method=method, rtol=1e-11)

    def q(t, middle):
        return 2.0 * (PLAN(t) - np.interp(t, times, samples)) if middle >= 0.0 else 0.3

    def w(t, middle):
        return q(t - first - second, middle - first - second) if middle >= second else 0.0

    knots = [0.0, first, *(t + first for t in (0.1, 0.4, 0.5, 0.6)), first + second]
    marks = [t for t in np.unique([0.0, second, *(t + second for t in knots)]) if t < 1.0]
    assert np.abs(found.outputs[0] - integrated(w, marks, times)[0]).max() <= 1e-8
    # At times that differ from an arrival by rounding, the values are those after it.
    expected = [w(t, t + 1e-12) for t in times]
    assert np.abs(found.outputs[1] - expected).max() <= 1e-13


@pytest.mark.parametrize("source", ["plan", "input", "constant"])
def test_no_segments_for_a_short_delay_of_a_known_signal(source):
    """Calls of the plant by method "python", next to those without the delay: a segment each would need 10,000."""
    numbers = []
    for delayed in (False, True):
        calls = []
        name = "v" if delayed else "w"
        blocks = [pendulum(calls), *([late(1e-4, "v", "w")] if delayed else [])]
        if source == "plan":
            blocks.append(cp.create_source_iosystem(PLAN, labels=[name]))
        elif source == "constant":
            blocks.append(ct.nlsys(None, lambda t, x, u, p: [0.8], inputs=0, outputs=[name], name="bias"))
        loop = ct.interconnect(blocks, inputs=[name] if source == "input" else None, outputs="y")
        cp.simulate(loop, [0.0, 1.0], 0.8 if source == "input" else None, START, method="python")
        numbers.append(len(calls))
    assert numbers[1] < 2 * numbers[0]


def test_a_step_is_late_by_a_delay_and_sampled_where_it_arrives():
    """0.1 + 0.2 is larger than 0.3 by rounding; the sample at 0.3 s reads the step."""
    law = ct.ss([], [], [], [[1.0]], 0.1, inputs="v", outputs="u", name="law")
    plant = ct.nlsys(lambda t, x, u, p: -np.tanh(x) + u, None, states=1, inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([plant, cp.sample_hold(law, 0.1), late(0.2, "r", "v")], inputs="r", outputs=["y", "u", "v"])
    times = np.linspace(0.0, 1.0, 11)
    found = cp.simulate(loop, times, cp.Step(1.0, time=0.1))
    assert np.array_equal(found.outputs[1:], np.tile(times > 0.29, (2, 1)))


def test_a_loop_with_known_and_found_signals_before_delays():
    """w = late(r) - 2 late(y): the delay of y ends the segments, the delay of r is a function of time."""
    blocks = [
        pendulum(),
        late(0.05, "r", "v"),
        late(0.2, "y", "z"),
        ct.ss([], [], [], [[1, -2]], inputs=["v", "z"], outputs="w"),
    ]
    loop = ct.interconnect(blocks, inputs="r", outputs="y")
    times = np.linspace(0.0, 0.4, 9)
    found = cp.simulate(loop, times, PLAN, START, rtol=1e-11)
    dense = solve_ivp(
        lambda t, x: rates(x, PLAN(t - 0.05)), (0.0, 0.2), START, "DOP853", dense_output=True, rtol=1e-12, atol=1e-14
    )

    def w(t, middle):
        return PLAN(t - 0.05) - (2.0 * dense.sol(t - 0.2)[0] if middle > 0.2 else 0.0)

    assert np.abs(found.outputs - integrated(w, [0.0, 0.15, 0.2, 0.35], times)[0]).max() <= 1e-8


def fed_back(delay):
    gain = ct.ss([], [], [], [[1.0, -1.0]], inputs=["r", "z"], outputs="w", name="gain")
    return ct.interconnect([pendulum(), late(delay, "y", "z"), gain], inputs="r", outputs="y")


@METHODS
def test_a_short_delay_of_a_signal_found_in_the_run_is_reported(method):
    stop = cp.Event("y", high=0.24, stop=True)  # in the first segments, of 12,500
    text = r"delay late z of 8e-05 s divides the run of 1 s into 12500 segments, .* Pade .*leave out the delay"
    with pytest.warns(UserWarning, match=text):
        cp.simulate(fed_back(8e-5), [0.0, 1.0], 0.0, START, method=method, events=[stop])


def test_a_delay_that_would_take_hours():
    text = r"a delay must be at least 1e-05 of the run of 1 s, got 9e-06 s: .*use a longer delay, a Pade approximation"
    with pytest.raises(ValueError, match=text):
        cp.simulate(fed_back(9e-6), [0.0, 1.0], 0.0, START)
