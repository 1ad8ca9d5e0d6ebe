"""Cost of planning again, one step of the block, beside scipy's refit in the same process and Ruckig's stored figure.

2 axes, order 2, horizon 1 s, a polynomial plan of 10 s; ratios are printed, none is asserted. Ruckig (C++, state to
state, 2 axes, new values) took 0.9 us where that was measured; it keeps limits and is time-optimal, a spline is not.
"""

import itertools
from statistics import median
from time import process_time

import numpy as np
import pytest
from scipy.interpolate import BPoly

import ctrlplan as cp
from ctrlplan import Waypoint

RUCKIG = 0.9
"""Microseconds, C++."""

PLAN = cp.PolySpline([Waypoint(0, [0, 0], 0, 0), Waypoint(10, [1, -2], 0, 0)], labels=["x", "z"])
HORIZON, PERIOD, COUNT = 1.0, 0.01, 2000

KINDS = {
    "from the reference": {"horizon": HORIZON},
    "to a goal that comes in": {"horizon": HORIZON, "goal_derivatives": 0},
    "from what is measured": {"horizon": HORIZON, "measured": 2, "suffix": "_r"},
    "shrinking, measured, to a goal": {"measured": 2, "goal_derivatives": 0, "suffix": "_r"},
    "within limits, to a goal": {"horizon": HORIZON, "goal_derivatives": 0, "limits": {1: 1e3, 2: 1e4}},
}


def cases(core, options):
    """Times, states and inputs, and of each fit the jets that it goes between and how long it takes."""
    rng = np.random.default_rng(0)
    labels, fixed, found = core.input_labels, "horizon" in options, []
    for k in range(COUNT):
        t = 0.3 + (k * PERIOD) % 8.0
        planned, deviation = PLAN.jet(t, 2).T, 0.01 * rng.normal(size=(2, 3))
        move = rng.normal(size=2) if "goal_derivatives" in options else np.zeros(2)
        values = dict(zip(names("_planned"), planned.ravel(), strict=True))
        values |= dict(zip(names(""), (planned + deviation).ravel(), strict=True))
        values |= dict(zip(["x_goal", "z_goal"], PLAN.final + move, strict=True))
        before = np.zeros(core.nstates)
        before[:2] = t - PERIOD, t - PERIOD + HORIZON
        before[-12:] = rng.normal(size=12)
        begins = deviation.T if "measured" in options else still(core, t, before)
        jets = np.stack([begins, [move, [0, 0], [0, 0]]])
        found.append((t, before, np.array([values[label] for label in labels]), jets, HORIZON if fixed else 10.0 - t))
    return found


def names(tail):
    return [f"{label}{tail}" + (f"_d{k}" if k else "") for label in "xz" for k in range(3)]


def still(core, t, x):
    """Jet (3, 2) that the block puts on top of the plan."""
    return np.array(core.outfcn(t, x, np.zeros(core.ninputs), {})).reshape(2, 3).T


@pytest.mark.benchmark(group="replanning")
@pytest.mark.parametrize("kind", KINDS)
def test_one_step(benchmark, capsys, kind):
    options = KINDS[kind]
    core = cp.create_replanner_iosystem(PLAN, PERIOD, **options).syslist[1]
    inputs = cases(core, options)

    def ours(case):
        t, x, u, _, _ = case
        return core.sample(t, x, u, {})

    def peer(case):
        t, _, _, jets, horizon = case
        return BPoly.from_derivatives([t, t + horizon], jets)

    for case in inputs[::97]:
        t, before, _, _, horizon = case
        after, poly = ours(case), peer(case)
        assert after[4] == before[4] + 1  # it did plan again
        for s in (t, t + 0.4 * horizon, t + 0.999 * horizon):
            wanted = np.array([poly.derivative(k)(s) if k else poly(s) for k in range(3)])
            assert np.abs(still(core, s, after) - wanted).max() <= 1e-9 * max(1.0, np.abs(wanted).max())

    seen = itertools.cycle(inputs)
    benchmark.pedantic(ours, setup=lambda: ((next(seen),), {}), rounds=200, warmup_rounds=5)
    times = []
    for first in range(0, COUNT, 50):
        seconds = []
        for function in (ours, peer):
            begin = process_time()
            for case in inputs[first : first + 50]:
                function(case)
            seconds.append((process_time() - begin) / 50)
        times.append(seconds)
    own, other = (1e6 * median(column) for column in zip(*times, strict=True))
    ratio = median(a / b for a, b in times)
    benchmark.extra_info |= {"ratio": ratio, "ruckig_us": RUCKIG}
    with capsys.disabled():
        print(
            f"\nreplanning {kind}: {own:.1f} us, BPoly.from_derivatives {other:.1f} us, ratio {ratio:.2f}; "
            f"Ruckig in C++ {RUCKIG} us (stored)"
        )


@pytest.mark.benchmark(group="replanning")
def test_one_step_with_limits_next_to_one_without(benchmark, capsys):
    """Limits that a bound of the coefficients decides. Goal: at most 1.5."""
    options = KINDS["within limits, to a goal"]
    limited, free = (
        cp.create_replanner_iosystem(PLAN, PERIOD, **given).syslist[1]
        for given in (options, options | {"limits": None})
    )
    inputs, times = cases(free, options)[:500], []
    for t, x, u, _, _ in inputs[::50]:
        np.testing.assert_array_equal(limited.sample(t, x, u, {}), free.sample(t, x, u, {}))
    for first in range(0, 500, 50):
        seconds = []
        for core in (limited, free):
            begin = process_time()
            for t, x, u, _, _ in inputs[first : first + 50]:
                core.sample(t, x, u, {})
            seconds.append((process_time() - begin) / 50)
        times.append(seconds)
    t, x, u, _, _ = inputs[0]
    benchmark.pedantic(lambda: limited.sample(t, x, u, {}), rounds=20)
    own, other = (1e6 * median(column) for column in zip(*times, strict=True))
    ratio = median(a / b for a, b in times)
    benchmark.extra_info["ratio"] = ratio
    with capsys.disabled():
        print(f"\nreplanning within limits: {own:.1f} us, without {other:.1f} us, ratio {ratio:.2f}")
