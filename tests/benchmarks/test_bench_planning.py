"""Cost of choosing alpha and of the shortest duration, beside scipy in one process; ratios are printed, none asserted.

Wanted on one core: choose_alpha on 12 constraints and 2 axes under 50 ms, fastest on the crane under 0.5 s.
"""

from itertools import pairwise
from statistics import median
from time import process_time

import numpy as np
import pytest
from in_turn import in_turn
from path_program import optimum
from scipy.optimize import brentq, minimize_scalar

import ctrlplan as cp
from ctrlplan.planning import OBJECTIVES
from ctrlplan.studies.crane import CRANE, nominal_waypoints, obstacle_waypoints

POINTS = obstacle_waypoints()
PLANS = {
    "polynomial": cp.PolySpline(nominal_waypoints(5)),
    "trigonometric": cp.TrigSpline(nominal_waypoints(5), alpha=2.0),
}
LIMITS = {"F": (-30e3, 30e3), "C": (-3e3, 1e3)}


@pytest.fixture
def beside(benchmark, capsys, request):
    """Benchmark ours, then time ours and the peer in turn; print the medians and the median of the ratios."""

    def run(ours, peer, rounds=7):
        benchmark.pedantic(ours, rounds=rounds, warmup_rounds=1)
        times = []
        for _ in range(rounds):
            seconds = []
            for function in (ours, peer):
                begin = process_time()
                function()
                seconds.append(process_time() - begin)
            times.append(seconds)
        ratio = median(a / b for a, b in times)
        benchmark.extra_info["ratio"] = ratio
        own, other = (1e3 * median(column) for column in zip(*times, strict=True))
        with capsys.disabled():
            print(f"\n{request.node.name}: {own:.1f} ms, peer {other:.1f} ms, ratio {ratio:.3f}")

    return run


@pytest.mark.benchmark(group="alpha")
@pytest.mark.parametrize("name", ["path", "wandering", "peak_velocity", "peak_jerk", "squared_jerk"])
def test_choose_alpha(beside, name):
    """Peer: bounded minimisation of the same objective from 32 parts of the range."""
    goal = OBJECTIVES[name]

    def objective(alpha):
        return goal(cp.TrigSpline(POINTS, alpha=float(alpha), warn=False))

    def peer():
        edges = np.linspace(0.0, 6.25, 33)
        found = [
            minimize_scalar(objective, bounds=(a, b), method="bounded", options={"xatol": 1e-7})
            for a, b in pairwise(edges)
        ]
        return min(found, key=lambda result: result.fun)

    best = cp.choose_alpha(POINTS, name)
    assert best.value <= peer().fun * (1 + 1e-7)
    beside(lambda: cp.choose_alpha(POINTS, name), peer, rounds=3)


@pytest.mark.benchmark(group="fastest")
@pytest.mark.parametrize("name", PLANS)
def test_fastest_on_the_crane(beside, name):
    """Peer: brentq on 2001 samples, which sees no more than those and one crossing."""
    plan = PLANS[name]
    start = plan.jet(np.linspace(plan.start, plan.end, 2001), 4)

    def excess(duration):
        jet = start * (plan.duration / duration) ** np.arange(5)[:, None, None]
        found = CRANE.quantities(jet)
        return max(
            max((found[k].max() - high) / (high - low), (low - found[k].min()) / (high - low))
            for k, (low, high) in LIMITS.items()
        )

    def peer():
        return brentq(excess, 4.0, 100.0, xtol=1e-12)

    best = cp.fastest(plan, LIMITS, CRANE)
    assert best.duration == pytest.approx(peer(), rel=1e-4)
    assert best.margins.satisfied
    beside(lambda: cp.fastest(plan, LIMITS, CRANE), peer)


@pytest.mark.benchmark(group="fastest")
@pytest.mark.parametrize("hold", ["shape", "waypoints", "path"])
def test_fastest_within_limits_of_derivatives(beside, hold):
    """Peer: brentq on 2001 samples of the retimed plan."""
    plan = cp.TrigSpline(POINTS, alpha=4.0)
    limits = {"velocity": 5.0, "acceleration": 3.0}

    def excess(duration):
        jet = np.abs(plan.retime(duration).jet(np.linspace(plan.start, plan.start + duration, 2001), 2))
        return max(jet[1].max() / 5.0, jet[2].max() / 3.0) - 1.0

    def peer():
        return brentq(excess, 1.0, 100.0, xtol=1e-12)

    best = cp.fastest(plan, limits, hold=hold)
    assert best.margins.satisfied
    if hold == "shape":
        assert best.duration == pytest.approx(peer(), rel=1e-5)
    if hold == "path":
        assert best.duration <= peer() * (1 + 1e-6)
    beside(lambda: cp.fastest(plan, limits, hold=hold), peer, rounds=3)


def through(n):
    """A piecewise spline through n random waypoints, at rest at both ends."""
    times, ends = np.cumsum(RNG.uniform(0.5, 1.5, n)), [[0.0, 0.0], [0.0, 0.0]]
    points = [
        cp.Waypoint(t, position, *(ends if i in (0, n - 1) else []))
        for i, (t, position) in enumerate(zip(times.tolist(), RNG.normal(size=(n, 2)), strict=True))
    ]
    return cp.PiecewiseSpline(points, warn=False)


RNG = np.random.default_rng(0)
FAMILIES = {
    "polynomial": lambda: cp.PolySpline(through(2).waypoints),
    "trigonometric": lambda: cp.TrigSpline(through(4).waypoints, alpha=1.0, warn=False),
    "piecewise 2": lambda: through(2),
    "piecewise 4": lambda: through(4),
    "piecewise 10": lambda: through(10),
    "piecewise 50": lambda: through(50),
}


@pytest.mark.benchmark(group="fastest")
@pytest.mark.parametrize("name", FAMILIES)
def test_fastest_next_to_the_closed_form_on_samples(benchmark, capsys, name):
    """Peer: T_0 max (peak/limit)^(1/k) of 2001 samples, which is not certified. Goal: at most 10."""
    limits, plans = {"velocity": 5.0, "acceleration": 3.0}, [FAMILIES[name]() for _ in range(12)]

    def peer(plan):
        peaks = np.abs(plan.jet(np.linspace(plan.start, plan.end, 2001), 2)).max(axis=(1, 2))
        return plan.duration * max(peaks[1] / 5.0, np.sqrt(peaks[2] / 3.0))

    rows = []
    for plan in plans:
        row = []
        for function in (lambda plan: cp.fastest(plan, limits), peer):
            begin = process_time()
            found = function(plan)
            row.append(process_time() - begin)
        rows.append(row)
        assert found <= cp.fastest(plan, limits).duration * (1 + 1e-12) <= found * (1 + 2e-3)
        assert cp.fastest(plan, limits).margins.satisfied
    ratio = median(a / b for a, b in rows)
    benchmark.extra_info["ratio"] = ratio
    benchmark.pedantic(lambda: cp.fastest(FAMILIES[name](), limits), rounds=3)
    own, other = (1e3 * median(column) for column in zip(*rows, strict=True))
    with capsys.disabled():
        print(f"\nfastest, {name}: {own:.2f} ms, closed form on 2001 samples {other:.2f} ms, ratio {ratio:.1f}")


@pytest.mark.benchmark(group="fastest")
def test_quantities_of_the_crane_on_a_path(benchmark, capsys):
    """Peer: CasADi and IPOPT on 300 intervals, whose limits hold at the nodes. Goal: durations within 1 %."""
    plan, limits = PLANS["polynomial"], {"F": 30e3, "theta": 0.5}
    guess = cp.fastest(plan, limits, CRANE).duration
    optimum(plan, guess, limits)  # loads IPOPT
    benchmark.pedantic(lambda: cp.fastest(plan, limits, CRANE, hold="path"), rounds=1, warmup_rounds=1)

    def ours():
        return cp.fastest(plan, limits, CRANE, hold="path")

    rows, (found, duration) = in_turn(ours, lambda: optimum(plan, guess, limits), 3)
    ratio = median(a / b for a, b in rows)
    benchmark.extra_info |= {"ratio": ratio, "duration": found.duration / duration}
    assert found.margins.satisfied
    assert found.duration <= 1.01 * duration
    own, other = (1e3 * median(column) for column in zip(*rows, strict=True))
    with capsys.disabled():
        print(
            f"\nfastest on a path, force and sway: {own:.0f} ms, IPOPT {other:.0f} ms, ratio {ratio:.2f}; "
            f"duration {found.duration:.4f} s, IPOPT {duration:.4f} s"
        )


OBSTACLES = [cp.Rectangle((8.0, 15.0), (20.0, 60.0)), cp.Disc((3.0, 3.0), 1.0)]


@pytest.mark.benchmark(group="clearance")
@pytest.mark.parametrize("rope", [None, CRANE.rope()], ids=["load", "load and rope"])
@pytest.mark.parametrize("kind", [cp.TrigSpline, cp.PiecewiseSpline])
def test_clearance_next_to_dense_samples(benchmark, capsys, kind, rope):
    """Peer: 20,001 samples, which certify nothing. Goal: at most 2."""
    options = {"alpha": 4.0 if kind is cp.TrigSpline else 0.0}
    plans = [kind(POINTS, **options) for _ in range(7)]

    def peer(plan):
        jet = plan.jet(np.linspace(plan.start, plan.end, 20_001), 0 if rope is None else rope.order)
        found = min(float(thing.distance(jet[0]).min()) for thing in OBSTACLES)
        if rope is None:
            return found
        return min(found, *(float(thing.segment_distance(rope.top(jet), jet[0]).min()) for thing in OBSTACLES))

    rows = []
    for plan in plans:
        row = []
        for function in (peer, lambda plan: cp.clearance(plan, OBSTACLES, rope=rope)):
            begin = process_time()
            found = function(plan)
            row.append(process_time() - begin)
        rows.append(row)
        assert found.lower <= min(found.minimum, peer(plan))
        assert found.minimum == pytest.approx(peer(plan), abs=1e-3)
    ratio = median(b / a for a, b in rows)
    benchmark.extra_info["ratio"] = ratio
    benchmark.pedantic(lambda: cp.clearance(plans[0], OBSTACLES, rope=rope), rounds=3)
    other, own = (1e3 * median(column) for column in zip(*rows, strict=True))
    with capsys.disabled():
        print(f"\nclearance, {kind.__name__}, rope {rope is not None}: {own:.2f} / {other:.2f} ms, ratio {ratio:.1f}")
