"""Inputs of a system: trajectories, numbers and samples, by name or all together."""

from itertools import pairwise

import control as ct
import numpy as np
import pytest
from simulation_oracle import both, constant, gap, response, step

import ctrlplan as cp

A = [[0.0, 1.0], [-4.0, -0.8]]
B = [[0.0, 0.5], [4.0, -1.0]]
C = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
D = [[0.0, 0.0], [0.0, 0.3], [0.0, 0.0]]
SYSTEM = ct.ss(A, B, C, D, inputs=["r", "d"], outputs=["y", "v", "w"], name="plant")
EPS = np.finfo(float).eps
T = np.linspace(0.0, 6.0, 121)
PLAN, (R,) = both([0.4, 1.1, 2.7], [[[0.0, 0.0, 0.0], [1.0, -0.3], [0.5, 0.0, 0.0]]], 1.0)
OTHER, (S,) = both([1.0, 3.3], [[[0.0, 0.0], [-2.0, 1.0]]])
START = [0.3, -1.0]


@pytest.mark.parametrize(
    ("inputs", "signals"),
    [
        ({"r": PLAN, "d": 0.1}, [R, constant(0.1)]),
        ({"d": 0.1, "r": PLAN}, [R, constant(0.1)]),
        ({"d": OTHER}, [constant(0.0), S]),
        ({"d": cp.Step(0.7, time=1.5), "r": OTHER}, [S, step(0.7, 0.0, 1.5)]),
        ({"r": 2, "d": np.float64(-1)}, [constant(2.0), constant(-1.0)]),
        ({}, [constant(0.0), constant(0.0)]),
        (None, [constant(0.0), constant(0.0)]),
        (0, [constant(0.0), constant(0.0)]),
        (1.5, [constant(1.5), constant(1.5)]),
        ([1.5, -0.5], [constant(1.5), constant(-0.5)]),
        (cp.stack([OTHER, PLAN], labels=["a", "b"]), [S, R]),
        (cp.Step([1.0, 2.0], time=0.5), [step(1.0, 0.0, 0.5), step(2.0, 0.0, 0.5)]),
    ],
    ids=[
        "names",
        "other order",
        "one named",
        "steps",
        "numbers",
        "nothing",
        "None",
        "0",
        "number",
        "vector",
        "axes",
        "step",
    ],
)
def test_exactly(inputs, signals):
    found = cp.simulate(SYSTEM, T, inputs, START)
    outputs, states = response(A, B, C, D, signals, T, START)
    assert found.method == "exact"
    assert gap(found.outputs, outputs) <= 1e-11
    assert gap(found.states, states) <= 1e-11
    assert np.abs(found.inputs - [s(T) for s in signals]).max() <= 1e-13


def saw(t):
    return np.abs(np.mod(1.7 * t, 2) - 1)


@pytest.mark.parametrize(("rtol", "allowed"), [(1e-8, 1e-6), (1e-11, 1e-8)])
@pytest.mark.parametrize("kind", ["array", "names", "name and number"])
def test_samples_are_linear_in_between(kind, rtol, allowed):
    rows = np.array([saw(T), np.random.default_rng(1).normal(size=T.size)])
    inputs = {
        "array": rows,
        "names": {"d": rows[1], "r": rows[0]},
        "name and number": {"r": rows[0].tolist(), "d": 0.25},
    }[kind]
    if kind == "name and number":
        rows[1] = 0.25
    found = cp.simulate(SYSTEM, T, inputs, START, rtol=rtol, atol=1e-2 * rtol)
    peer = ct.forced_response(SYSTEM, T, rows, START)
    assert found.method == "exact"
    assert gap(found.outputs, peer.outputs) <= allowed
    assert gap(found.states, peer.states) <= allowed
    assert np.array_equal(found.inputs, rows)


def test_samples_at_odd_times():
    # A ramp of slope 1 is a ramp however it is sampled: x' = -x + t from 0 is t - 1 + exp(-t).
    t = np.unique(np.concatenate([[0.0], np.random.default_rng(0).uniform(0, 5, 17), [5.0]]))
    found = cp.simulate(ct.ss(-1.0, 1.0, 1.0, 0.0), t, t, rtol=1e-10, atol=1e-12)
    assert np.abs(found.outputs - (t - 1 + np.exp(-t))).max() <= 1e-9


@pytest.mark.slow
def test_a_plan_next_to_samples():
    samples = np.random.default_rng(1).normal(size=T.size)
    found = cp.simulate(SYSTEM, T, {"r": PLAN, "d": samples}, START, rtol=1e-11, atol=1e-13)
    planned = response(A, B, C, D, [R, constant(0.0)], T, START)[0]
    disturbed = ct.forced_response(SYSTEM, T, [0 * T, samples]).outputs
    assert gap(found.outputs, planned + disturbed) <= 1e-8


@pytest.mark.parametrize("count", [1001, 10_001])
def test_a_pulse_of_samples_in_a_long_rest_is_not_skipped(count):
    t = np.linspace(0.0, 100.0, count)
    pulse = np.where(np.abs(t - 50.0) < 1e-9, 1.0, 0.0)
    system = ct.ss(-1.0, 1.0, 1.0, 0.0)
    peer = ct.forced_response(system, t, pulse).outputs
    assert peer.max() > 0.5 * t[1]
    assert np.abs(cp.simulate(system, t, pulse).outputs - peer).max() <= 1e-7


def test_a_pulse_between_close_samples_after_a_wide_gap_is_not_skipped():
    # Samples 50 s apart but around the pulse: x' = -x + u with a triangle of height h and width 2 w at c.
    height, width, centre = 10.0, 0.01, 50.0
    t = np.array([0.0, centre - width, centre, centre + width, 52.0, 53.0, 100.0])
    found = cp.simulate(ct.ss(-1.0, 1.0, 1.0, 0.0), t, np.where(t == centre, height, 0.0))
    # After it the response is the triangle's Laplace transform at -1: exp(-(t - c)) 2 h (cosh(w) - 1)/w.
    exact = np.exp(centre - t[3:]) * 2 * height * (np.cosh(width) - 1) / width
    assert np.abs(found.outputs[3:] - exact).max() <= 1e-6
    assert np.abs(found.outputs[:2]).max() <= 1e-15  # interpolating the samples rounds


def test_a_single_input_takes_a_row_or_a_matrix_of_one():
    system = ct.ss(-1.0, 1.0, 1.0, 0.0)
    rows = [cp.simulate(system, T, values).outputs for values in (saw(T), saw(T)[None], saw(T).tolist())]
    assert rows[0].shape == T.shape
    assert np.array_equal(rows[0], rows[1])
    assert np.array_equal(rows[0], rows[2])


def test_inputs_are_not_written_to():
    rows, initial = np.array([saw(T), saw(2 * T)]), np.array(START)
    kept = rows.copy()
    for method in ("auto", "python"):
        cp.simulate(SYSTEM, T, rows, initial)
        cp.simulate(SYSTEM, T, {"r": PLAN}, initial, method=method)
    assert np.array_equal(rows, kept)
    assert initial.tolist() == START


def test_a_number_holds_from_the_first_sample_on():
    # Whenever the run begins: x' = -x + 2 from 0.
    t = np.linspace(-3.0, 2.0, 50)
    for method in ("exact", "python"):
        found = cp.simulate(ct.ss(-1.0, 1.0, 1.0, 0.0), t, 2.0, method=method, rtol=1e-11, atol=1e-13)
        assert np.abs(found.outputs + 2 * np.expm1(-(t + 3.0))).max() <= 1e-10
        assert np.all(found.inputs == 2.0)


def test_a_scalar_initial_state_is_for_all_states():
    found = cp.simulate(SYSTEM, T, None, 0.5)
    assert gap(found.states, response(A, B, C, D, [constant(0.0)] * 2, T, [0.5, 0.5])[1]) <= 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("method", ["compiled", "python"])
@pytest.mark.parametrize("count", [301, 601])
def test_many_samples_next_to_a_plan_that_comes_to_rest(count, method):
    """Near zero velocity the derivatives of a plan are rounding errors: no segment is halved for them without end."""
    t = np.linspace(0.0, 6.0, count)
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(4, 1, 0, 0)]
    source = cp.create_source_iosystem(cp.PolySpline(move, labels=["x"]), 2)
    limit = cp.create_saturation_iosystem(-1.0, 1.0, inputs="a", outputs="u")
    plant = ct.ss(
        [[-1.0]], [[1.0, 0.1, 0.1, 0.1]], [[1.0]], 0, inputs=["u", "x", "x_d1", "x_d2"], outputs="y", name="p"
    )
    whole = ct.interconnect([source, limit, plant], inputs=["a"], outputs=["y"])
    linear = ct.interconnect([source, plant], inputs=["u"], outputs=["y"])
    wave = 0.9 * np.sin(2.0 * t)
    found = cp.simulate(whole, t, wave, method=method)
    assert np.abs(found.outputs - cp.simulate(linear, t, wave, method="exact").outputs).max() < 1e-6


def test_samples_on_a_line_do_not_bend_by_rounding():
    from ctrlplan.simulation.signals import SampledSignal

    t = np.linspace(0.3, 7.0, 5001)
    assert SampledSignal(t, 1.0 + t / 3.0).breakpoints_between(t[0], t[-1]).size == 0
    bent = np.where(t < t[2000], 1.0 + t / 3.0, 1.0 + t[2000] / 3.0 + (1 / 3 + 1e-9) * (t - t[2000]))
    assert t[2000] in SampledSignal(t, bent).breakpoints_between(t[0], t[-1])
    assert np.array_equal(SampledSignal(t, bent).at(t)[0], bent)


@pytest.mark.parametrize("start", [0.0, -0.7, 1e5])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_samples_of_straight_lines_bend_at_their_knots_alone(start, offset):
    from ctrlplan.simulation.signals import SampledSignal

    t = start + np.linspace(0.0, 30.0, 3001)
    knots = t[::100]
    values = np.interp(t, knots, offset + np.random.default_rng(3).normal(size=knots.size))
    signal = SampledSignal(t, values)
    assert np.array_equal(signal.breakpoints_between(t[0], t[-1]), knots[1:-1])
    assert np.array_equal(signal.at(t)[0], values)
    for left, right in pairwise(knots):
        inside = (t >= left) & (t <= right)
        found = signal.analytic_at(0.5 * (left + right), left, t[inside] - left)[0]
        steep = np.ptp(values[inside]) / (right - left) * np.abs(t[[0, -1]]).max()
        assert np.abs(found - values[inside]).max() <= 8 * EPS * (np.abs(values[inside]).max() + steep)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0])
def test_a_small_curve_next_to_a_large_jump_bends_at_every_sample(size):
    from ctrlplan.simulation.signals import SampledSignal

    t = np.linspace(0.0, 10.0, 1001)
    curve = size * np.sin(t)
    values = np.where(t > 8.0, 1e6, curve)
    signal = SampledSignal(t, values)
    early = t[(t > 0.0) & (t < 7.9)]
    assert np.isin(early[np.abs(np.sin(early)) > 0.01], signal.breakpoints_between(t[0], t[-1])).all()
    assert np.array_equal(signal.at(t)[0], values)


def test_a_list_holds_what_each_input_takes():
    samples = saw(T)
    found = cp.simulate(SYSTEM, T, [PLAN, samples], START)
    assert np.array_equal(found.outputs, cp.simulate(SYSTEM, T, {"r": PLAN, "d": samples}, START).outputs)
    peer = ct.input_output_response(SYSTEM, T, [samples, 0.5], START)
    assert np.array_equal(cp.simulate(SYSTEM, T, [samples, 0.5], START).inputs, peer.inputs)
    assert np.array_equal(cp.simulate(ct.ss(-1.0, 1.0, 1.0, 0.0), T, [2.0]).inputs, np.full(T.size, 2.0))
    # As many inputs as times: numbers are for one input each, rows are samples, a plan is a plan.
    two = [0.0, 6.0]
    for inputs, rows in (
        ([1.0, 2.0], [[1, 1], [2, 2]]),
        ([[1, 2], [3, 4]], [[1, 2], [3, 4]]),
        ([PLAN, 2.0], [[0, 0.5], [2, 2]]),
    ):
        assert np.abs(cp.simulate(SYSTEM, two, inputs).inputs - rows).max() <= 1e-15


# Where a run starts


def test_none_is_the_stated_start_and_a_number_is_that_number():
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="lag")
    follower = cp.create_command_filter_iosystem(2.0, 2, inputs="y", name="follower")
    cp.declare(follower, initial_state=[3.0, -1.0, 0.5])
    loop = ct.interconnect([lag, follower], inputs="u", outputs=["y"], check_unused=False)
    t = [0.0, 1.0]
    for system in (loop, cp.prepare(loop)):
        for method in ("auto", "python"):
            begins = [cp.simulate(system, t, 0.0, *start, method=method).states[:, 0].tolist()
                      for start in ((), (None,), (0.0,), (0,), ([0.0] * 4,), (2.0,))]  # fmt: skip
            assert begins == [[0.0, 3.0, -1.0, 0.5]] * 2 + [[0.0] * 4] * 3 + [[2.0] * 4]
    cp.declare(loop, initial_state=5.0)
    assert cp.simulate(loop, t).states[:, 0].tolist() == [5.0] * 4
    assert cp.simulate(loop, t, initial_state=0.0).states[:, 0].tolist() == [0.0] * 4
    plain = ct.ss(-1.0, 1.0, 1.0, 0.0, 0.5)
    assert cp.simulate(plain, t, 0.0).states[:, 0].tolist() == [0.0]


def test_what_runs_many_loops_starts_where_it_is_told():
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)], labels=["r"])
    loop = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="y")
    cp.declare(loop, initial_state=[7.0])
    t = np.linspace(0.0, 2.0, 21)
    first = [
        cp.compare(loop, {"plan": plan}, t, initial_state=start).responses["plan"].states[0, 0]
        for start in (None, 0.0, [0.0], 2.0)
    ]
    assert first == [7.0, 0.0, 0.0, 2.0]
