"""Cost of exact responses with many states and segments compared with control.forced_response, in turn in one process.

A chain of masses and springs, 10 s with 1001 samples, the force at its first mass along one polynomial, and along
1000 segments. The peer connects the samples by straight lines.
"""

from statistics import median
from time import process_time

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation.methods import exact

T = np.linspace(0.0, 10.0, 1001)
ROUNDS = 3


def chain(masses):
    springs = 2.0 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    a = np.block([[np.zeros((masses, masses)), np.eye(masses)], [-2.0 * springs, -0.3 * np.eye(masses)]])
    return ct.ss(a, np.eye(2 * masses, 1, -masses), np.eye(1, 2 * masses), 0, inputs="r", outputs="y")


def plan(segments):
    points = [cp.Waypoint(10.0 * k / segments, float(np.sin(k)), 0, 0) for k in range(segments + 1)]
    return cp.PiecewiseSpline(points, alpha=0.0, labels=["r"])


@pytest.mark.benchmark
@pytest.mark.parametrize("segments", [1, 1000])
@pytest.mark.parametrize("states", [100, 200])
def test_many_states_and_segments(states, segments, benchmark, capsys, monkeypatch):
    system, move = chain(states // 2), plan(segments)
    ready = cp.prepare(system)

    def ours():
        return cp.simulate(ready, T, move)

    def peer():
        return ct.forced_response(system, T, move(T))

    found = benchmark.pedantic(ours, rounds=3, warmup_rounds=1)
    rows = []
    for _ in range(ROUNDS):
        seconds = []
        for function in (ours, peer):
            begin = process_time()
            function()
            seconds.append(process_time() - begin)
        rows.append(seconds)
    own, other = (median(column) for column in zip(*rows, strict=True))
    ratio = median(a / b for a, b in rows)
    benchmark.extra_info["ratio"] = ratio
    # By a series in each segment, over a tenth of the run, since that takes seconds.
    some = T[:101]
    monkeypatch.setattr(exact, "_MANY_STATES", 10**9)
    monkeypatch.setattr(exact, "_MANY_SEGMENTS", 10**9)
    begin = process_time()
    slow = cp.simulate(ready, some, move)
    before = process_time() - begin
    error = np.abs(slow.outputs - found.outputs[:101]).max() / np.abs(slow.outputs).max()
    assert error <= 1e-12
    with capsys.disabled():
        print(
            f"\n{states} states, {segments} segments: {1e3 * own:.1f} ms, peer {1e3 * other:.1f} ms, ratio "
            f"{ratio:.2f}; a tenth of it by segments {1e3 * before:.0f} ms, difference {error:.1e}"
        )


def beside_peer(system, samples, benchmark, capsys, times=T, equal=None):
    """Print the ratio of CPU times, interleaved, and check the response by the peer's of an equal system."""
    ready = cp.prepare(system)

    def ours():
        return cp.simulate(ready, times, samples)

    def peer():
        return ct.forced_response(system, times, samples)

    benchmark.pedantic(ours, rounds=3, warmup_rounds=1)
    rows = []
    for _ in range(3 * ROUNDS):
        seconds, results = [], []
        for function in (ours, peer):
            begin = process_time()
            results.append(function().outputs)
            seconds.append(process_time() - begin)
        rows.append(seconds)
    own, other = (min(column) for column in zip(*rows, strict=True))
    benchmark.extra_info["ratio"] = own / other
    if equal is not None:
        results[1] = ct.forced_response(equal, times, samples).outputs
    assert np.abs(results[0] - results[1]).max() <= 1e-11 * np.abs(results[1]).max()
    with capsys.disabled():
        print(
            f"\n{system.nstates} states, {times.size} samples of {system.ninputs} inputs: {1e3 * own:.1f} ms, peer "
            f"{1e3 * other:.1f} ms, ratio {own / other:.2f}"
        )


@pytest.mark.benchmark
@pytest.mark.parametrize("states", [4, 20, 100, 200])
def test_samples_as_input(states, benchmark, capsys):
    """Random samples connected by straight lines, as by the peer. Goal: at most 1."""
    beside_peer(chain(states // 2), np.random.default_rng(0).standard_normal(T.size), benchmark, capsys)


@pytest.mark.benchmark
@pytest.mark.parametrize("kind", ["random", "smooth"])
@pytest.mark.parametrize(
    ("states", "inputs", "outputs"),
    [(2, 100, 2), (4, 20, 5), (4, 20, 200), (9, 20, 5), (30, 20, 5), (60, 20, 60), (2, 300, 2)],
)
def test_samples_of_many_inputs(states, inputs, outputs, kind, benchmark, capsys):
    """The same for many inputs and outputs, with samples that are random or of sine waves. Goal: at most 1."""
    rng = np.random.default_rng(1)
    a = rng.standard_normal((states, states)) / states**0.5
    a -= (np.linalg.eigvals(a).real.max() + 0.3) * np.eye(states)
    system = ct.ss(a, rng.standard_normal((states, inputs)), rng.standard_normal((outputs, states)), 0)
    rates = 0.05 * (1.0 + np.arange(inputs))[:, None]
    samples = np.sin(rates * T) if kind == "smooth" else rng.standard_normal((inputs, T.size))
    beside_peer(system, samples, benchmark, capsys)


@pytest.mark.benchmark
@pytest.mark.parametrize("kind", ["chain", "badly scaled", "stiff"])
@pytest.mark.parametrize("inputs", [1, 5])
@pytest.mark.parametrize("states", [50, 100, 200, 300])
@pytest.mark.parametrize("count", [50, 200, 5000])
def test_few_and_many_samples(states, inputs, count, kind, benchmark, capsys):
    """Random samples: few of them, where the exponential is most of the work, and many. Goal: at most 1."""
    rng = np.random.default_rng(2)
    a, b, c, scale = chain(states // 2).A, rng.standard_normal((states, inputs)), np.eye(1, states), np.ones(states)
    if kind == "badly scaled":
        scale = rng.permutation(np.geomspace(1e-5, 1e5, states))
    elif kind == "stiff":
        turn = np.linalg.qr(rng.standard_normal((states, states)))[0]
        a = -turn @ np.diag(np.geomspace(0.1, 1e3, states)) @ turn.T
    system = ct.ss(a * (scale[:, None] / scale), b * scale[:, None], c / scale, 0)
    samples, times = rng.standard_normal((inputs, count)), np.linspace(0.0, 10.0, count)
    beside_peer(system, samples, benchmark, capsys, times, ct.ss(a, b, c, 0))


@pytest.mark.benchmark
@pytest.mark.parametrize("segments", [10, 137])
def test_stiff_loop_along_segments(segments, benchmark, capsys, monkeypatch):
    """50 lags with rates up to 1e4 1/s, 201 samples: the breakpoints lie between them. Printed next to the peer."""
    turn = np.linalg.qr(np.random.default_rng(2).standard_normal((50, 50)))[0]
    a = -turn @ np.diag(np.geomspace(0.1, 1e4, 50)) @ turn.T
    system, move, times = ct.ss(a, turn[:, :1], np.eye(1, 50), 0, inputs="r", outputs="y"), plan(segments), T[::5]
    ready = cp.prepare(system)

    def ours():
        return cp.simulate(ready, times, move)

    def peer():
        return ct.forced_response(system, times, move(times))

    found = benchmark.pedantic(ours, rounds=3, warmup_rounds=1)
    seconds = []
    for function in (ours, peer):
        begin = process_time()
        function()
        seconds.append(process_time() - begin)
    monkeypatch.setattr(exact, "_MANY_STATES", 10**9)
    monkeypatch.setattr(exact, "_MANY_SEGMENTS", 10**9)
    begin = process_time()
    slow = cp.simulate(ready, times, move)
    before = process_time() - begin
    error = np.abs(slow.states - found.states).max() / np.abs(slow.states).max()
    # Half an ulp of the largest rate moves the slow ones by 1e-12.
    assert error <= 1e-11
    with capsys.disabled():
        print(
            f"\nstiff, {segments} segments: {1e3 * seconds[0]:.1f} ms, peer {1e3 * seconds[1]:.1f} ms, "
            f"by segments {1e3 * before:.0f} ms, difference {error:.1e}"
        )
