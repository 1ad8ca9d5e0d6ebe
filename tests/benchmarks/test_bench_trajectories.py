"""Cost of trajectories beside scipy's, interleaved in one process; ratios are printed, none is asserted.

2 axes, 4 waypoints with position, velocity and acceleration: 12 constraints an axis, over 10 s.
"""

import itertools
from statistics import median
from time import process_time

import numpy as np
import pytest
from scipy.interpolate import BPoly, PPoly
from scipy.signal import czt

from ctrlplan.trajectories import PiecewiseSpline, PolySpline, TrigSpline, Waypoint, residual_spectrum

RNG = np.random.default_rng(0)
JETS = RNG.normal(size=(4, 3, 2))
TIMES = np.array([0.0, 3.0, 6.0, 10.0])
COUNT = 1_000_000
ALPHA = 1.0


def points(times, jets=JETS):
    return [Waypoint(t, *jet) for t, jet in zip(times.tolist(), jets, strict=True)]


def new_times(count):
    """Times that no run has seen, so that nothing kept from an earlier one can help."""
    return [np.array([0.0, *(TIMES[1:3] + RNG.uniform(-1, 1, 2)), 10.0]) for _ in range(count)]


@pytest.fixture
def beside(benchmark, capsys, request):
    """Benchmark ours, then time ours and the peer in turn on the same inputs; print the median of the ratios."""

    def run(ours, peer, inputs, batch=1):
        seen = itertools.cycle(inputs)
        benchmark.pedantic(ours, setup=lambda: ((next(seen),), {}), rounds=min(len(inputs), 20), warmup_rounds=1)
        times = []
        for first in range(0, len(inputs), batch):
            seconds = []
            for function in (ours, peer):
                begin = process_time()
                for data in inputs[first : first + batch]:
                    function(data)
                seconds.append((process_time() - begin) / batch)
            times.append(seconds)
        ratio = median(a / b for a, b in times)
        benchmark.extra_info["ratio"] = ratio
        own, other = (1e6 * median(column) for column in zip(*times, strict=True))
        with capsys.disabled():
            print(f"\n{request.node.name}: {own:.0f} us, peer {other:.0f} us, ratio {ratio:.3f}")

    return run


def meets(plan, times, jets=JETS):
    return np.abs(plan.jet(times, 2).transpose(2, 0, 1) - jets).max() <= 1e-12 * np.abs(plan.jet(TIMES, 2)).max()


@pytest.mark.benchmark(group="construct")
@pytest.mark.parametrize("alpha", [0.0, ALPHA])
@pytest.mark.parametrize("waypoints", ["with waypoints", "without waypoints"])
def test_construct_at_new_times(beside, waypoints, alpha):
    """Peer: BPoly.from_derivatives of the same data. Goal: at most 0.5."""
    inputs = [(times, points(times)) for times in new_times(300)]
    if waypoints == "with waypoints":

        def ours(data):
            return TrigSpline(points(data[0]), alpha=alpha, warn=False)

    else:

        def ours(data):
            return TrigSpline(data[1], alpha=alpha, warn=False)

    def peer(data):
        return BPoly.from_derivatives(data[0], JETS)

    times = inputs[0][0]
    assert meets(ours(inputs[0]), times)
    np.testing.assert_allclose(peer(inputs[0])(times), JETS[:, 0], atol=1e-12)
    beside(ours, peer, inputs, batch=10)


@pytest.mark.benchmark(group="new values")
@pytest.mark.parametrize("waypoints", ["with waypoints", "without waypoints"])
def test_new_values_at_the_same_times(beside, waypoints):
    """Peer: BPoly.from_derivatives of the new data. Wanted: under 0.1."""
    plan = TrigSpline(points(TIMES), alpha=ALPHA, warn=False)
    inputs = [(jets, points(TIMES, jets)) for jets in RNG.normal(size=(300, 4, 3, 2))]
    if waypoints == "with waypoints":

        def ours(data):
            return plan.with_values(points(TIMES, data[0]))

    else:

        def ours(data):
            return plan.with_values(data[1])

    jets = inputs[0][0]
    assert meets(ours(inputs[0]), TIMES, jets)
    np.testing.assert_array_equal(
        ours(inputs[0])(TIMES), TrigSpline(points(TIMES, jets), alpha=ALPHA, warn=False)(TIMES)
    )
    beside(ours, lambda data: BPoly.from_derivatives(TIMES, data[0]), inputs, batch=10)


SAMPLES = {
    "uniform": np.linspace(0, 10, COUNT),
    "sorted": np.sort(RNG.uniform(0, 10, COUNT)),
    "unsorted": RNG.uniform(0, 10, COUNT),
}


@pytest.mark.benchmark(group="sample")
@pytest.mark.parametrize("alpha", [0.0, ALPHA, 5.0])
@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("order", [2, 3])
def test_position_and_derivatives_at_a_million_times(beside, order, name, alpha):
    """Two and three derivatives; peer: PPoly of the same data and its derivatives. Goal: at most 0.2."""
    plan = TrigSpline(points(TIMES), alpha=alpha, warn=False)
    quintics = PPoly.from_bernstein_basis(BPoly.from_derivatives(TIMES, JETS))
    pieces = [quintics, *[quintics.derivative(nu) for nu in range(1, order + 1)]]
    t = SAMPLES[name]
    some = np.arange(0, COUNT, 1001)
    few, many = np.stack([plan.jet(float(moment), order) for moment in t[some]], axis=2), plan.jet(t, order)
    assert many.shape == (order + 1, 2, COUNT)
    assert (np.abs(many[:, :, some] - few).max(axis=2) <= 1e-12 * np.abs(few).max(axis=2)).all()
    np.testing.assert_allclose([p(TIMES[:-1]) for p in pieces[:3]], JETS[:-1].transpose(1, 0, 2), atol=1e-12)
    beside(lambda times: plan.jet(times, order), lambda times: [p(times) for p in pieces], [t] * 7)


def test_residual_spectrum_beside_a_transform_of_samples(beside):
    """2001 frequencies to 1000 over the duration; the peer is scipy's chirp transform of 16,385 samples."""
    omega, count = np.linspace(0.0, 100.0, 2001), 2**14 + 1

    def transformed(plan):
        t = np.linspace(plan.start, plan.end, count)
        step = t[1] - t[0]
        return step * np.abs(czt(plan(t, 1), 2001, np.exp(-1j * (omega[1] - omega[0]) * step), 1.0, axis=-1))

    plans = [TrigSpline(points(times), alpha=ALPHA, warn=False) for times in new_times(10)]
    for plan in plans[:2]:
        # The trapezoidal rule of a velocity that is not 0 at the ends: error (w h)^2/12 of the path, 3e-4.
        size = np.abs(plan(np.linspace(0.0, 10.0, 2001), 1)).mean() * 10.0
        np.testing.assert_allclose(transformed(plan), residual_spectrum(plan, omega), rtol=0, atol=1e-3 * size)
    beside(lambda plan: residual_spectrum(plan, omega), transformed, plans)


def horner(rows, start, duration):
    """Position, velocity, acceleration and jerk of each axis by Horner's method, in Python, and without checks."""

    def jet(t):
        u, found = (t - start) / duration, []
        for row in rows:
            a = b = c = d = 0.0
            for value in row:
                d, c, b, a = d * u + c, c * u + b, b * u + a, a * u + value
            found.append((a, b / duration, 2.0 * c / duration**2, 6.0 * d / duration**3))
        return found

    return jet


KINDS = {
    "trigonometric": lambda given: TrigSpline(given, alpha=ALPHA, warn=False),
    "polynomial": lambda given: PolySpline(given, warn=False),
    "piecewise": lambda given: PiecewiseSpline(given, warn=False),
}


def pair_of_plan_and_horner(kind, count, naxes, size):
    """A plan through random waypoints, and Horner's method of random coefficients."""
    times = np.arange(count) + RNG.uniform(0.0, 0.1, count)
    plan = KINDS[kind](
        [Waypoint(t, *jet) for t, jet in zip(times.tolist(), RNG.normal(size=(count, 3, naxes)), strict=True)]
    )
    return plan, horner(RNG.normal(size=(naxes, size)).tolist(), 0.0, plan.duration)


@pytest.mark.benchmark(group="one time")
@pytest.mark.parametrize("naxes", [1, 2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_one_time_next_to_horner(benchmark, capsys, kind, naxes):
    """jet(t, 3) at a float; peer: Horner's method of as many coefficients, written by hand. Goal: at most 6.

    The first call, of plans with waypoints at other times, next to the first call of the peer with other numbers.
    """
    cells = []
    for count in (2, 4):
        size = 6 if kind == "piecewise" else 3 * count
        plan, peer = pair_of_plan_and_horner(kind, count, naxes, size)
        exact = plan.jet(np.array([0.7, 0.2]), 3)[..., 0]
        assert np.abs(plan.jet(0.7, 3) - exact).max() <= 1e-12 * np.abs(exact).max()
        times = []
        for _ in range(7):
            row = []
            for function in (lambda plan=plan: plan.jet(0.7, 3), lambda peer=peer: peer(0.7)):
                begin = process_time()
                for _ in range(1000):
                    function()
                row.append((process_time() - begin) / 1000)
            times.append(row)
        first = []
        for _ in range(200):
            new, other = pair_of_plan_and_horner(kind, count, naxes, size)
            begin = process_time()
            new.jet(0.7, 3)
            middle = process_time()
            other(0.7)
            first.append((middle - begin, process_time() - middle))
        texts = []
        for rows in (times, first):
            own, other = (1e6 * median(column) for column in zip(*rows, strict=True))
            texts.append(f"{own:.1f} / {other:.2f} us = {own / other:.1f}")
        ratio = median(a / b for a, b in times)
        cells.append(f"{count} waypoints {texts[0]}, first call {texts[1]}")
    benchmark.extra_info["ratio"] = ratio
    benchmark.pedantic(lambda: plan.jet(0.7, 3), rounds=5, iterations=100)
    with capsys.disabled():
        print(f"\none time, {kind}, {naxes} axes: " + "; ".join(cells))


SWINGS = [(kind, count, False) for kind in KINDS for count in (2, 4)]
SWINGS += [("piecewise", count, False) for count in (10, 50, 1000)] + [("piecewise", 2, True)]


@pytest.mark.benchmark(group="construct")
@pytest.mark.parametrize(("kind", "count", "at_peak"), SWINGS)
def test_check_of_the_swing_next_to_construction(benchmark, capsys, kind, count, at_peak):
    """Samples of a sine with two derivatives. Goal: at most 5 % where bounds decide.

    They do not where both of two waypoints are near a peak, so that the plan goes far beyond their positions: there
    the values decide.
    """
    make = {
        "trigonometric": lambda given, warn: TrigSpline(given, alpha=ALPHA, warn=warn),
        "polynomial": lambda given, warn: PolySpline(given, warn=warn),
        "piecewise": lambda given, warn: PiecewiseSpline(given, warn=warn),
    }[kind]
    seconds = []
    phases = [0.0, 2.0] if at_peak or count > 2 else [-1.0, 2.0]  # of both axes
    for k in range(600 if count < 1000 else 40):
        row = {}
        for warn in (False, True) if k % 2 else (True, False):
            times = np.cumsum(RNG.uniform(0.7, 1.3, count))  # others each time: systems of equal times are shared
            given = [
                Waypoint(t, *np.sin([[t + phase + 0.5 * np.pi * nu for phase in phases] for nu in range(3)]))
                for t in times.tolist()
            ]
            begin = process_time()
            make(given, warn)
            row[warn] = process_time() - begin
        seconds.append(row)
    quiet, checked = (median(row[warn] for row in seconds) for warn in (False, True))
    benchmark.extra_info["ratio"] = checked / quiet
    benchmark.pedantic(lambda: make(given, True), rounds=20)
    with capsys.disabled():
        own, more, where = 1e6 * quiet, 1e6 * (checked - quiet), " near a peak" if at_peak else ""
        print(f"\nswing, {kind}, {count} waypoints{where}: {own:.0f} us, the check {more:+.1f} us, {more / own:+.1%}")


@pytest.mark.benchmark(group="sample")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("grid", ["uniform", "sorted", "unsorted"])
def test_position_and_two_derivatives_at_some_times(benchmark, capsys, kind, grid):
    """Peer: PPoly and its derivatives. Goals: 1.5 the first time and 1 after, 0.5 for 10,000 times.

    Each plan has waypoints at other times, so that nothing kept with an earlier one can help.
    """
    cells = []
    for count in (1000, 4096, 10_000):
        quintics = PPoly.from_bernstein_basis(BPoly.from_derivatives(TIMES, JETS))
        parts = [quintics, quintics.derivative(), quintics.derivative(2)]
        t = {"uniform": np.linspace(0, 10, count), "sorted": np.sort(RNG.uniform(0, 10, count))}.get(
            grid, RNG.uniform(0, 10, count)
        )
        plans = [KINDS[kind](points(times)) for times in new_times(25)]
        exact = np.concatenate([plans[0].jet(part, 2) for part in np.array_split(t, count // 100)], axis=2)
        assert (np.abs(plans[0].jet(t, 2) - exact) <= 1e-12 * np.abs(exact).max(axis=2, keepdims=True)).all()
        times = []
        for plan in plans[1:]:
            row = []
            for function in (plan.jet, plan.jet, lambda t, _, parts=parts: [part(t) for part in parts]):
                begin = process_time()
                function(t, 2)
                row.append(process_time() - begin)
            times.append(row)
        first, again = (median(row[k] / row[2] for row in times) for k in (0, 1))
        cells.append(f"{count}: {first:.2f}, {again:.2f}")
    benchmark.extra_info["ratio"] = again
    benchmark.pedantic(lambda: plan.jet(t, 2), rounds=5)
    with capsys.disabled():
        print(f"\nsamples, {kind}, {grid}: the first time and after: " + "; ".join(cells))
