"""Cost of exact sampled loops compared with recursions written by hand, in turn in one process; ratios are printed.

A plant of third order with a law of three states, 10 s at 1 kHz; the plan enters the law. The recursion by hand has its
matrices computed before, and makes one product a sample, or an instant: z = M z + K r.
"""

from collections import deque
from statistics import median

import control as ct
import numpy as np
import pytest
from in_turn import in_turn
from scipy.linalg import expm

import ctrlplan as cp

PERIOD, END = 1e-3, 10.0
A = np.array([[0.0, 1.0, 0.0], [-4.0, -0.8, 1.0], [0.0, 0.0, -20.0]])
B = np.array([[0.0], [0.0], [20.0]])
LAW = (
    np.diag([1.0, 0.9, 0.5]),
    np.array([[PERIOD, -PERIOD], [0.1, -0.1], [0.2, 0.0]]),
    np.array([[2.0, 0.5, 0.1]]),
    np.array([[3.0, -3.0]]),
)
PLAN = cp.PiecewiseSpline([cp.Waypoint(0.75 * k, float(k % 3), 0, 0) for k in range(13)], alpha=2.0, labels=["r"])
T = np.linspace(0.0, END, 10_001)
ROUNDS = 5


def plant(**names):
    return ct.ss(A, B, [[1.0, 0.0, 0.0]], 0, **({"inputs": "u", "outputs": "y", "name": "plant"} | names))


def law(period=PERIOD, offset=0.0, **names):
    labels = {"inputs": ["r", "y"], "outputs": "u", "name": "law"} | names
    return cp.sample_hold(ct.ss(*LAW, period, **labels), period, offset)


def held(length):
    """Change of the plant over a time, from its states and the held control."""
    whole = expm(np.block([[A, B], [np.zeros((1, 4))]]) * length)
    return whole[:3]


def interleaved(ours, peer):
    """Median seconds of both and of their ratio, run in turn, and the results of the last turn."""
    rows, results = in_turn(ours, peer, ROUNDS)
    return [median(column) for column in zip(*rows, strict=True)], median(a / b for a, b in rows), results


def show(capsys, benchmark, what, seconds, ratio, error):
    benchmark.extra_info["ratio"] = ratio
    with capsys.disabled():
        print(
            f"\n{what}: {1e3 * seconds[0]:.1f} ms, by hand {1e3 * seconds[1]:.1f} ms, "
            f"ratio {ratio:.2f}, error {error:.1e}"
        )


def at_one_rate():
    """Matrices of the recursion over a period, from (x, xi) and the plan at its start to (x, xi) at its end."""
    f, g, h, d = LAW
    change = held(PERIOD)
    control = np.hstack([d[:, 1:] @ [[1.0, 0.0, 0.0]], h])  # from x and xi; the plan's factor is d[0, 0]
    m = np.vstack([np.hstack([change[:, :3], np.zeros((3, 3))]) + change[:, 3:] @ control, np.zeros((3, 6))])
    m[3:, :3], m[3:, 3:] = g[:, 1:] @ [[1.0, 0.0, 0.0]], f
    k = np.concatenate([change[:, 3:] @ d[:, :1], g[:, :1]])
    return m, k


@pytest.mark.benchmark
@pytest.mark.parametrize("dense", [False, True])
def test_one_rate(dense, benchmark, capsys):
    loop = cp.prepare(ct.interconnect([plant(), law()], inputs="r", outputs="y"))
    times = np.union1d(T, np.random.default_rng(0).uniform(0.0, END, 100_000)) if dense else T
    m, k = at_one_rate()

    def ours():
        return cp.simulate(loop, times, PLAN)

    def by_hand():
        r = PLAN(T)[:, None]
        z, out = np.zeros(6), np.empty((T.size, 6))
        for j in range(T.size):
            out[j] = z
            z = m @ z + k @ r[j]
        return out

    benchmark.pedantic(ours, rounds=3, warmup_rounds=1)
    seconds, ratio, (found, expected) = interleaved(ours, by_hand)
    error = np.abs(found.outputs[np.searchsorted(times, T)] - expected[:, 0]).max()
    assert error <= 1e-12
    show(capsys, benchmark, "100,000 outputs between samples" if dense else "one rate", seconds, ratio, error)


def instant_by_instant(first, second, offsets, delay=0.0):
    """Two laws whose controls add up: z = M z + K r from instant to instant; the first control comes late."""
    f, g, h, d = LAW
    events = []
    for number, (period, offset) in enumerate(((first, offsets[0]), (second, offsets[1]))):
        events += [(offset + period * j, number) for j in range(int((END - offset) / period + 1e-9) + 1)]
    if delay:
        events += [(first * j + delay, 2) for j in range(int((END - delay) / first + 1e-9) + 1)]
    due = {}
    for t, number in sorted((round(t, 12), number) for t, number in events):
        due.setdefault(t, []).append(number)
    marks = np.array(list(due))

    def sampled(z, r, late, numbers):
        """States x, xi and xi of the laws, their controls, and the one that is applied late, after an instant."""
        z = z.copy()
        for number in numbers:
            if number == 2:
                z[11] = late
                continue
            own, w = slice(3 + 3 * number, 6 + 3 * number), np.array([r, z[0]])
            z[9 + number], z[own] = float(h[0] @ z[own] + d[0] @ w), f @ z[own] + g @ w
            if number == 0 and not delay:
                z[11] = z[9]
        return z

    kinds, maps = [], {}
    for numbers, length in zip(due.values(), np.diff(marks, append=END).tolist(), strict=True):
        kind = (tuple(numbers), round(length, 12))
        if kind not in maps:
            change, flow = held(length), np.eye(12)
            flow[:3, :3], flow[:3, [10, 11]] = change[:, :3], change[:, 3:]
            units = [(unit, 0.0, 0.0) for unit in np.eye(12)] + [(np.zeros(12), 1.0, 0.0), (np.zeros(12), 0.0, 1.0)]
            jump = np.array([sampled(*unit, numbers) for unit in units]).T
            maps[kind] = flow @ jump[:, :12], flow @ jump[:, 12], flow @ jump[:, 13], 2 in numbers, 0 in numbers
        kinds.append(maps[kind])

    def run():
        values = PLAN(marks).tolist()
        z, queue, out = np.zeros(12), deque(), np.empty((marks.size, 12))
        for j, (m, k, e, returns, taken) in enumerate(kinds):
            out[j] = z
            late = queue.popleft() if returns else 0.0
            z = m @ z + k * values[j]
            if returns:
                z += e * late
            if taken and delay:
                queue.append(z[9])
        return out

    return marks, run


@pytest.mark.benchmark
@pytest.mark.parametrize(
    ("second", "offsets", "delay"),
    [
        (0.7e-3, (0.0, 0.0), 0.0),
        (5e-3, (0.3e-3, 1.2e-3), 0.0),
        (0.7001e-3, (0.0, 0.0), 0.0),
        (2e-3, (0.0, 0.0), 3e-3),
        (2e-3, (0.0, 0.0), 3.4e-3),
        (2e-3, (0.0, 0.0), 0.1),
    ],
)
def test_several_rates_and_delays(second, offsets, delay, benchmark, capsys):
    names = {"outputs": "v", "name": "other"}
    total = ct.ss([], [], [], [[1.0, 1.0]], inputs=["w", "v"], outputs="s", name="total", dt=None)
    blocks = [plant(inputs="s"), law(PERIOD, offsets[0], **({} if delay else {"outputs": "w"})), total]
    blocks += [law(second, offsets[1], **names)]
    if delay:
        blocks.append(cp.create_delay_iosystem(delay, inputs="u", outputs="w"))
    loop = cp.prepare(ct.interconnect(blocks, inputs="r", outputs="y"))
    marks, by_hand = instant_by_instant(PERIOD, second, offsets, delay)
    times = marks if marks[0] == 0.0 else np.append(0.0, marks)

    def ours():
        return cp.simulate(loop, times, PLAN)

    benchmark.pedantic(ours, rounds=2, warmup_rounds=1)
    seconds, ratio, (found, expected) = interleaved(ours, by_hand)
    error = np.abs(found.outputs[-marks.size :] - expected[:, 0]).max() / np.abs(expected[:, 0]).max()
    assert found.method == "exact"
    assert error <= 1e-11
    what = f"1 and {1e3 * second:g} ms, offsets {offsets}, delay {1e3 * delay:g} ms"
    show(capsys, benchmark, what, seconds, ratio, error)


@pytest.mark.benchmark
def test_comparison_of_four_plans(benchmark, capsys):
    """Runs and metrics of four plans over 4.5 s, next to four recursions. Goal: at most 10."""
    loop = cp.prepare(ct.interconnect([plant(), law()], inputs="r", outputs=["y", "u"]))
    points = [cp.Waypoint(1.5 * k, float(k % 2), 0, 0) for k in range(3)]
    plans = {
        "step": cp.Step(1.0, labels=["r"]),
        "polynomial": cp.PolySpline(points, labels=["r"]),
        "trigonometric": cp.TrigSpline(points, alpha=1.0, labels=["r"]),
        "piecewise": cp.PiecewiseSpline(points, alpha=2.0, labels=["r"]),
    }
    times = T[:4501]
    m, k = at_one_rate()

    def ours():
        return cp.compare(loop, plans, times)

    def by_hand():
        found = {}
        for name, plan in plans.items():
            r, z, out = plan(times)[:, None], np.zeros(6), np.empty((times.size, 6))
            for j in range(times.size):
                out[j] = z
                z = m @ z + k @ r[j]
            found[name] = out[:, 0]
        return found

    benchmark.pedantic(ours, rounds=3, warmup_rounds=1)
    seconds, ratio, (found, expected) = interleaved(ours, by_hand)
    error = max(np.abs(found.responses[name].outputs[0] - expected[name]).max() for name in plans)
    assert error <= 1e-12
    show(capsys, benchmark, "compare, four plans", seconds, ratio, error)
