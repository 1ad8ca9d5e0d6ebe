"""Exact responses of linear loops with discrete blocks, compared with events in 50 digits."""

import math
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import control as ct
import numpy as np
import pytest
import sampled_oracle as oracle
from sampled_oracle import Held, Plan, exact, smooth

import ctrlplan as cp

A = [[0.0, 1.0], [-4.0, -0.8]]
B = [[0.2, 0.1], [1.0, 0.3]]
"""Inputs u and d."""
LAW = [[1.0, 0.0], [0.1, 0.6]], [[0.05, -0.05], [0.3, -0.3]], [[0.8, 0.5]], [[1.2, -1.2]]
"""Two states, with feedthrough, on (r, y)."""


def plant(a=A, b=B, **names):
    labels = {"inputs": ["u", "d"][: len(b[0])], "outputs": [f"y{k}" for k in range(len(a))]} | names
    return ct.ss(a, b, np.eye(len(a)), 0, name="plant", **labels)


def law(period, offset=0.0, scale=1.0, **names):
    a, b, c, d = LAW
    labels = {"inputs": ["r", "y0"], "outputs": "u", "name": "law"} | names
    block = ct.ss(a, b, np.multiply(scale, c), np.multiply(scale, d), period, **labels)
    return cp.sample_hold(block, period, offset)


def law_by_hand(period, offset, inputs, scale=1.0):
    a, b, c, d = LAW
    return Held(period, offset, a, b, (np.multiply(scale, c)).tolist(), (np.multiply(scale, d)).tolist(), inputs)


def plan_and_oracle(first=0.033, last=0.647, size=2.0):
    plan = cp.PolySpline([cp.Waypoint(first, 0, 0, 0), cp.Waypoint(last, size, 0, 0)], labels=["r"])
    return plan, smooth(first, last, size)


def times_of(last, count, *further, seed=1):
    return np.unique(np.append(np.random.default_rng(seed).uniform(0.0, last, count), [0.0, last, *further]))


def worst(found, expected):
    """Largest error of each row, relative to its largest value."""
    found, expected = np.atleast_2d(found), np.array(expected)
    size = np.abs(expected).max(axis=1, keepdims=True)
    return float((np.abs(found - expected) / np.where(size > 0.0, size, 1.0)).max())


@pytest.mark.slow
@pytest.mark.parametrize(("period", "offset"), [(0.05, 0.0), (0.05, 0.013), (0.1, 0.25)])
def test_one_rate(period, offset):
    """The plan into controller and plant; its ends lie between samples."""
    plan, planned = plan_and_oracle()
    loop = ct.interconnect([plant(), law(period, offset)], inputs=["r", "d"], outputs=["y0", "y1", "u"])
    times = times_of(1.0, 40, 0.05, 0.1, 0.3, offset)
    block = law_by_hand(period, offset, lambda x, read: [read(planned), x[0]])
    expected = oracle.run(A, B, None, [[(0, 0)], [(planned, 0)]], [block], [planned], [0.3, -0.2], times)
    found = cp.simulate(loop, times, {"r": plan, "d": plan}, [0.3, -0.2, 0.0, 0.0, 0.0])
    assert (found.method, found.reason) == ("exact", "linear, with discrete blocks or delays")
    assert worst(found.outputs, expected) <= 1e-12
    assert np.array_equal(found.states[:2], found.outputs[:2])


@pytest.mark.parametrize("rate", [400.0, pytest.param(2e4, marks=pytest.mark.slow)])
def test_fast_modes(rate):
    """A lag that decays within 1/20 and 1/1000 of a period, between samples as well."""
    plan, planned = plan_and_oracle()
    a, b = [[0.0, 1.0, 0.0], [-4.0, -0.8, 1.0], [0.0, 0.0, -rate]], [[0.0, 0.1], [0.0, 0.3], [rate, 0.0]]
    loop = ct.interconnect([plant(a, b), law(0.05)], inputs=["r", "d"], outputs=["y0", "y1", "y2", "u"])
    times = times_of(0.2, 4, 0.05, 0.0501, 0.15, 0.1 + 1e-6)
    block = law_by_hand(0.05, 0.0, lambda x, read: [read(planned), x[0]])
    expected = oracle.run(a, b, None, [[(0, 0)], [(planned, 0)]], [block], [planned], [0.3, -0.2, 0.1], times)
    found = cp.simulate(loop, times, {"r": plan, "d": plan}, [0.3, -0.2, 0.1, 0.0, 0.0, 0.0])
    assert worst(found.outputs, expected) <= 1e-12


@pytest.mark.parametrize(
    ("first", "second", "offsets"),
    [
        (0.1, 0.07, (0.0, 0.0)),
        (0.1, 0.07, (0.03, 0.012)),
        (0.05, 0.1, (0.0, 0.0)),
        (0.1, math.sqrt(0.005), (0.0, 0.0)),
        (1.0 / 30.0, 0.04, (0.0, 0.01)),
    ],
)
def test_several_rates(first, second, offsets):
    """Two laws at their own times; the second one adds to the first through the plant's second input."""
    plan, planned = plan_and_oracle()
    other = law(second, offsets[1], 0.3, outputs="d", name="other", inputs=["u", "y1"])
    loop = ct.interconnect([plant(), law(first, offsets[0]), other], inputs="r", outputs=["y0", "y1", "u", "d"])
    times = times_of(0.8, 12, 0.1, 0.7)
    blocks = [
        law_by_hand(first, offsets[0], lambda x, read: [read(planned), x[0]]),
        law_by_hand(second, offsets[1], lambda x, read: [read(0), x[1]], 0.3),
    ]
    expected = oracle.run(A, B, None, [[(0, 0)], [(1, 0)]], blocks, [planned], [0.3, -0.2], times)
    found = cp.simulate(loop, times, plan, [0.3, -0.2, *np.zeros(6)])
    assert found.method == "exact"
    assert worst(found.outputs, expected) <= 1e-12


@pytest.mark.parametrize("late", [-1e-15, 0.0, 1e-15])
def test_a_step_at_a_sample_is_seen_by_it(late):
    """3 times 0.1 s is 0.3 s, whatever the rounding of either."""
    unit = ct.ss([], [], [], [[1.0]], 0.1, inputs="r", outputs="u", name="unit")
    found = cp.simulate(cp.sample_hold(unit, 0.1), [0.0, 0.25, 0.3, 0.35], cp.Step(1.0, time=0.3 + late))
    assert found.method == "exact"
    assert found.outputs.tolist() == [0.0, 0.0, 1.0, 1.0]


def test_each_side_of_a_jump_between_samples():
    """x' = r + h: a step of r at 0.42 s is a ramp from then on, and seen by the sample at 0.5 s."""
    unit = ct.ss([], [], [], [[2.0]], 0.1, inputs="r", outputs="h", name="unit")
    moved = ct.ss(0.0, [[1.0, 1.0]], 1.0, 0.0, inputs=["r", "h"], outputs="x", name="moved")
    loop = ct.interconnect([cp.sample_hold(unit, 0.1), moved], inputs="r", outputs=["x", "h"])
    found = cp.simulate(loop, [0.0, 0.41, 0.42, 0.46, 0.5, 0.61], cp.Step(1.0, time=0.42))
    assert np.abs(found.outputs[0] - [0.0, 0.0, 0.0, 0.04, 0.08, 0.41]).max() <= 1e-15
    assert found.outputs[1].tolist() == [0.0, 0.0, 0.0, 0.0, 2.0, 2.0]


def test_samples_as_input_are_straight_lines():
    """x' = r + h with r sampled every 7 ms: sums of trapezoids, and the values at the sample times of the block."""
    unit = ct.ss([], [], [], [[1.0]], 0.01, inputs="r", outputs="h", name="unit")
    moved = ct.ss(0.0, [[1.0, 1.0]], 1.0, 0.0, inputs=["r", "h"], outputs="x", name="moved")
    loop = ct.interconnect([cp.sample_hold(unit, 0.01), moved], inputs="r", outputs="x")
    times = 0.007 * np.arange(101)
    samples = np.random.default_rng(0).standard_normal(101)
    found = cp.simulate(loop, times, samples)
    instants = 0.01 * np.arange(71)
    held = np.interp(instants, times, samples)
    of_held = [
        held[: int(k)].sum() * 0.01 + held[int(k)] * (t - 0.01 * int(k)) for t in times for k in [t / 0.01 + 1e-9]
    ]
    of_input = np.append(0.0, np.cumsum(0.5 * (samples[1:] + samples[:-1]) * 0.007))
    assert found.method == "exact"
    assert np.abs(found.outputs - (of_input + of_held)).max() <= 1e-13


DELAYS = [
    (0.1, 0.34),
    (0.1, 0.3),
    (0.1, 0.04),
    (0.1, 0.1),
    pytest.param(0.01, 0.2, marks=pytest.mark.slow),
    (0.01, 0.213),
]
"""Periods, and delays of 3.4, 3, 0.4, 1, 20 and 21.3 of them."""


@pytest.mark.parametrize(("period", "delay"), DELAYS)
def test_a_control_that_comes_late(period, delay):
    plan, planned = plan_and_oracle()
    late = cp.create_delay_iosystem(delay, inputs="u", outputs="w")
    loop = ct.interconnect(
        [plant(inputs=["w", "d"]), law(period), late], inputs=["r", "d"], outputs=["y0", "y1", "u", "w"]
    )
    times = times_of(0.9, 10, 0.1, 0.34, 0.4)
    block = law_by_hand(period, 0.0, lambda x, read: [read(planned), x[0]])
    expected = oracle.run(A, B, None, [[(0, delay)], [(planned, 0)]], [block], [planned], [0.3, -0.2], times)
    found = cp.simulate(loop, times, {"r": plan, "d": plan}, [0.3, -0.2, 0.0, 0.0, 0.0])
    assert found.method == "exact"
    assert worst(found.outputs[:3], expected) <= 1e-12
    past = [float(block.at(exact(float(t)) - exact(delay))) for t in times]
    assert worst(found.outputs[3], [past]) <= 1e-12


@pytest.mark.parametrize(("period", "delay"), DELAYS)
def test_a_measurement_that_comes_late(period, delay):
    """The law reads the position of some time ago, sampled then."""
    plan, planned = plan_and_oracle()
    late = cp.create_delay_iosystem(delay, inputs="y0", outputs="w", initial=0.25)
    loop = ct.interconnect(
        [plant(), law(period, inputs=["r", "w"]), late], inputs=["r", "d"], outputs=["y0", "y1", "u", "w"]
    )
    times = times_of(0.9, 10, 0.1, 0.34, 0.4)
    offset = float((1 - Fraction(str(delay))) % Fraction(str(period)))
    seen = Held(period, offset, [], [], [], [[1.0]], lambda x, read: [x[0]])

    def inputs(x, read):
        past = read.__defaults__[1] - exact(delay)
        return [read(planned), seen.at(past) if past >= -oracle.NEAR else 0.25]

    blocks = [seen, law_by_hand(period, 0.0, inputs)]
    expected = oracle.run(A, B, None, [[(1, 0)], [(planned, 0)]], blocks, [planned], [0.3, -0.2], times)
    found = cp.simulate(loop, times, {"r": plan, "d": plan}, [0.3, -0.2, 0.0, 0.0, 0.0])
    assert found.method == "exact"
    assert worst(found.outputs[:3], [*expected[:2], expected[3]]) <= 1e-12
    # The delayed signal itself, between samples, from a second run that ends at each time.
    past = times - delay
    values = cp.simulate(loop, np.union1d(past[past > 0.0], [0.0]), {"r": plan, "d": plan}, [0.3, -0.2, 0.0, 0.0, 0.0])
    shown = np.where(past < -1e-12, 0.25, np.interp(past, values.time, values.outputs[0]))
    assert np.abs(found.outputs[3] - shown).max() <= 1e-12


@pytest.mark.parametrize(("method", "tolerance"), [("exact", 1e-13), ("python", 1e-8)])
@pytest.mark.parametrize("parts", [2, 3])
def test_a_delay_of_a_control_and_of_the_same_control_delayed(parts, method, tolerance):
    """y' = -2 y + u(t - h) + u(t - 2 h), with a period of 2 h or 3 h: the recurrence over each h by hand."""
    delay, count, target = 0.07, 12, -0.6
    block = cp.sample_hold(
        ct.ss([], [], [], [[0.8]], parts * delay, inputs="e", outputs="u", name="law"), parts * delay
    )
    blocks = [
        block,
        ct.ss(-2.0, 1.0, 1.0, 0.0, inputs="z", outputs="y", name="plant"),
        cp.create_delay_iosystem(delay, inputs="u", outputs="v", name="first"),
        ct.summing_junction(["u", "v"], "w", name="sum"),
        cp.create_delay_iosystem(delay, inputs="w", outputs="z", name="second"),
        ct.summing_junction(["r", "-y"], "e", name="error"),
    ]
    loop = ct.interconnect(blocks, inputs="r", outputs=["y", "z"])
    times = delay * np.arange(parts * count)
    y, held, expected = 0.4, [0.0, 0.0], []
    for k in range(times.size):
        held.append(0.8 * (target - y) if k % parts == 0 else held[-1])
        z = held[k + 1] + held[k]
        expected.append((y, z))
        y = y * math.exp(-2.0 * delay) + z * (1.0 - math.exp(-2.0 * delay)) / 2.0
    found = cp.simulate(loop, times, target, [0.0, 0.4], method=method)
    assert found.method == method
    assert worst(found.outputs, np.transpose(expected)) < tolerance


def test_two_controls_and_a_plan_through_one_delay():
    """Controls of two rates and the plan in one sum, 0.24 s late; then 0.11 s more."""
    plan, planned = plan_and_oracle()
    other = law(0.07, 0.02, 0.3, outputs="v", name="other", inputs=["u", "y1"])
    total = ct.ss([], [], [], [[1.0, 0.5, -2.0]], inputs=["u", "v", "r"], outputs="s", name="total", dt=None)
    first = cp.create_delay_iosystem(0.24, inputs="s", outputs="w", name="first")
    second = cp.create_delay_iosystem(0.11, inputs="w", outputs="d", name="second")
    blocks = [second, plant(inputs=["w", "d"]), law(0.1), other, first, total]
    loop = ct.interconnect(blocks, inputs="r", outputs=["y0", "y1", "u", "v"])
    times = times_of(0.9, 8, 0.24, 0.35)
    laws = [
        law_by_hand(0.1, 0.0, lambda x, read: [read(planned), x[0]]),
        law_by_hand(0.07, 0.02, lambda x, read: [read(0), x[1]], 0.3),
    ]
    # The factors 1, 0.5 and -2 of the sum are columns of the plant's input matrix.
    wide = [[row[0], 0.5 * row[0], -2.0 * row[0], row[1], 0.5 * row[1], -2.0 * row[1]] for row in B]
    drives = [[(signal, delay)] for delay in (0.24, 0.35) for signal in (0, 1, planned)]
    expected = oracle.run(A, wide, None, drives, laws, [planned], [0.3, -0.2], times)
    found = cp.simulate(loop, times, plan, [0.3, -0.2, *np.zeros(6)])
    assert found.method == "exact"
    assert worst(found.outputs, expected) <= 1e-12


def test_what_is_held_at_the_start_comes_late_as_well():
    """h = 3 until the first sample at 0.25 s, then 1; both 0.4 s later, and 7 before that."""
    unit = ct.ss([], [], [], [[1.0]], 0.1, inputs="r", outputs="h", name="unit")
    late = cp.create_delay_iosystem(0.4, inputs="h", outputs="w", initial=7.0)
    moved = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="w", outputs="x", name="moved")
    loop = ct.interconnect([cp.sample_hold(unit, 0.1, 0.25), late, moved], inputs="r", outputs=["h", "w", "x"])
    times = [0.0, 0.24, 0.25, 0.39, 0.4, 0.6, 0.64, 0.65, 0.8]
    found = cp.simulate(loop, times, 1.0, [3.0, 0.0])
    assert found.method == "exact"
    assert found.outputs[0].tolist() == [3.0, 3.0, *[1.0] * 7]
    assert found.outputs[1].tolist() == [7.0, 7.0, 7.0, 7.0, 3.0, 3.0, 3.0, 1.0, 1.0]
    wanted = [0.0, 1.68, 1.75, 2.73, 2.8, 3.4, 3.52, 3.55, 3.7]
    assert np.abs(found.outputs[2] - wanted).max() <= 1e-14


def test_a_plan_with_many_breakpoints_between_samples():
    """200 segments of 4.9 ms in the controller and in the plant, a period of 10 ms; each reads its own plan."""
    values = np.random.default_rng(3).standard_normal(201)
    marks = 0.0049 * np.arange(201)
    loop = ct.interconnect([plant(), law(0.01)], inputs=["r", "d"], outputs=["y0", "y1", "u"])
    plan = cp.PiecewiseSpline.from_arrays(marks, values[None], alpha=0.0, labels=["r"])
    pieces = []
    for left in marks[:-1]:
        jet = plan.segment_jet_at(left + 0.002, left, np.zeros(1), 5)[:, 0, 0]
        pieces.append([value / math.factorial(k) for k, value in enumerate(jet)])
    planned = Plan(marks, pieces)
    times = times_of(0.1, 20, 0.0049, 0.1)
    block = law_by_hand(0.01, 0.0, lambda x, read: [read(planned), x[0]])
    expected = oracle.run(A, B, None, [[(0, 0)], [(planned, 0)]], [block], [planned], [0.3, -0.2], times)
    found = cp.simulate(loop, times, {"r": plan, "d": plan}, [0.3, -0.2, 0.0, 0.0, 0.0])
    assert worst(found.outputs, expected) <= 1e-12


def test_a_plan_much_faster_than_the_samples():
    """Twenty harmonics within a period of 1 s: x' = r, against the integral of the plan by its own antiderivative."""
    points = [cp.Waypoint(0.05 * k, (-1.0) ** k, 0, 0) for k in range(41)]
    plan = cp.PiecewiseSpline(points, alpha=0.0, labels=["r"])
    moved = ct.ss([[0.0, 0.0], [0.0, -1.0]], [[1.0, 1.0], [0.0, 1.0]], np.eye(2), 0, inputs=["r", "h"], outputs=2)
    unit = cp.sample_hold(ct.ss([], [], [], [[0.0]], 1.0, inputs="r", outputs="h", name="unit"), 1.0)
    loop = ct.interconnect([moved, unit], inputs="r", outputs=moved.output_labels)
    found = cp.simulate(loop, [0.0, 0.05, 0.1, 0.975, 1.0, 2.0], plan)
    # From -1 to 1 and back by an odd function: the integral over each segment is 0.
    assert found.method == "exact"
    assert np.abs(found.outputs[0, [0, 1, 2, 4, 5]]).max() <= 1e-15
    s = 0.5
    half = 0.05 * (s - 2.0 * (10 * s**4 / 4 - 15 * s**5 / 5 + 6 * s**6 / 6))
    assert abs(found.outputs[0, 3] - -half) <= 1e-15


def test_a_loop_that_grows():
    """z+ = 3 z: exact to the last digits of 3^40, and an error once it is too large for a number."""
    memory = ct.ss(3.0, 0.0, 1.0, 0.0, 0.1, inputs="r", outputs="h", name="memory")
    moved = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="h", outputs="x", name="moved")
    loop = ct.interconnect([cp.sample_hold(memory, 0.1), moved], inputs="r", outputs=["h", "x"])
    found = cp.simulate(loop, [0.0, 4.05], 0.0, [1.0, 0.0, 0.0])
    assert abs(found.outputs[0, 1] / 3.0**40 - 1.0) <= 1e-14
    x = 0.0
    for k in range(41):
        length = 0.1 if k < 40 else 0.05
        x = x * math.exp(-length) - math.expm1(-length) * 3.0**k
    assert abs(found.outputs[1, 1] / x - 1.0) <= 1e-13
    with pytest.raises(RuntimeError, match=r"states of .* must stay finite up to 100 s, got an overflow at 64\.\d s"):
        cp.simulate(loop, [0.0, 100.0], 0.0, [1.0, 0.0, 0.0], method="exact")


def test_sampled_blocks_that_form_an_algebraic_loop():
    """u = r + w and w = u have no solution at common sample times; with an offset they count upwards."""

    def loop(offset):
        one = ct.ss([], [], [], [[1.0, 1.0]], 0.1, inputs=["r", "w"], outputs="u", name="one")
        two = ct.ss([], [], [], [[1.0]], 0.1, inputs="u", outputs="w", name="two")
        blocks = [cp.sample_hold(one, 0.1), cp.sample_hold(two, 0.1, offset)]
        return ct.interconnect(blocks, inputs="r", outputs=["u", "w"])

    with pytest.raises(ValueError, match=r"algebraic loop without a solution, got one of one, two at their common"):
        cp.simulate(loop(0.0), [0.0, 1.0], 1.0)
    found = cp.simulate(loop(0.05), [0.0, 0.05, 0.1, 0.3, 0.36], 1.0)
    assert found.method == "exact"
    assert found.outputs.tolist() == [[1.0, 1.0, 2.0, 4.0, 4.0], [0.0, 1.0, 1.0, 3.0, 4.0]]


def test_what_is_not_linear_runs_by_another_method():
    nonlinear = ct.nlsys(None, lambda t, x, u, p: np.tanh(u), inputs=1, outputs=1, dt=0.1, name="bent")
    cases = {
        "block bent, which is sampled, is not linear": cp.sample_hold(nonlinear, 0.1),
        "block saturation": ct.interconnect(
            [
                law(0.1, inputs=["r", "y"], outputs="u_cmd"),
                cp.create_saturation_iosystem(-1.0, 1.0),
                ct.tf([1], [1, 1], inputs="u", outputs="y"),
            ],
            inputs="r",
            outputs="y",
        ),
    }
    for reason, loop in cases.items():
        with pytest.raises(ValueError, match=f'method "exact" must apply.*{reason}'):
            cp.simulate(loop, [0.0, 1.0], 1.0, method="exact")
        assert cp.simulate(loop, [0.0, 1.0], 1.0).method in ("compiled", "python")


def test_an_unstable_loop_without_input_is_uncertain():
    """z+ = 2 z - 1 from 1 stays at 1; rounding of 1.1 makes it grow to 1e-16 2^70."""
    memory = ct.ss(2.0, -1.0, 1.0, 0.0, 0.1, inputs="r", outputs="h", name="memory")
    loop = cp.sample_hold(memory, 0.1)
    with pytest.warns(UserWarning, match=r"outputs h of .* are uncertain by .* % of their size"):
        cp.simulate(loop, [0.0, 7.0], 1.1, [1.1, 0.0])


def test_a_run_that_is_shorter_than_a_delay():
    """The plan has not passed the delay of 5 s when the run ends; the integrator has moved by the initial value."""
    plan, _ = plan_and_oracle()
    late = cp.create_delay_iosystem(5.0, inputs="s", outputs="w", initial=2.0)
    total = ct.ss([], [], [], [[1.0, 1.0]], inputs=["h", "r"], outputs="s", name="total", dt=None)
    unit = cp.sample_hold(ct.ss([], [], [], [[1.0]], 0.1, inputs="r", outputs="h", name="unit"), 0.1)
    moved = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="w", outputs="x", name="moved")
    loop = ct.interconnect([late, total, unit, moved], inputs="r", outputs=["x", "w"])
    found = cp.simulate(loop, [0.0, 0.4, 1.0], plan)
    assert found.method == "exact"
    assert np.abs(found.outputs - [[0.0, 0.8, 2.0], [2.0, 2.0, 2.0]]).max() <= 1e-15


def late_loop(stiffness=-4.0, delay=0.105):
    """Two rates; the delay is a register of 21 samples."""
    blocks = [
        plant([[0.0, 1.0], [stiffness, -0.8]]),
        law(0.005, outputs="early"),
        law(0.01, 0.003, name="d", outputs="d"),
    ]
    blocks.append(cp.create_delay_iosystem(delay, inputs="early", outputs="u"))
    return ct.interconnect(blocks, inputs="r", outputs=["y0", "y1", "u"])


def plans_and_times():
    plan = plan_and_oracle()[0]
    bent = cp.Step(1.0, labels=["r"])
    return [(p, np.linspace(0.0, end, 301)) for end in (3.0, 1.5, 2.0, 3.0) for p in (plan, bent)]


def test_runs_of_one_form_do_not_depend_on_earlier_ones():
    ready = cp.prepare(late_loop())
    for _ in range(2):
        for plan, times in plans_and_times():
            found, alone = cp.simulate(ready, times, plan), cp.simulate(late_loop(), times, plan)
            assert np.array_equal(found.outputs, alone.outputs)
            assert np.array_equal(found.states, alone.states)


def test_steps_are_computed_again_when_a_block_changes():
    loop = late_loop()
    plan, times = plans_and_times()[0]
    ready = cp.prepare(loop)
    before = cp.simulate(ready, times, plan).outputs
    loop.syslist[0].A[1, 0] = -5.0
    after = cp.simulate(ready, times, plan).outputs
    assert np.array_equal(after, cp.simulate(late_loop(-5.0), times, plan).outputs)
    assert np.abs(after - before).max() > 1e-3


def test_threads_share_the_steps_of_a_loop():
    runs = plans_and_times()
    expected = [cp.simulate(late_loop(), times, plan).outputs for plan, times in runs]
    for _ in range(5):
        ready = cp.prepare(late_loop())
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda run, ready=ready: cp.simulate(ready, run[1], run[0]).outputs, runs))
        assert all(np.array_equal(*pair) for pair in zip(found, expected, strict=True))
