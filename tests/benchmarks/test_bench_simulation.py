"""Cost of the exact response beside python-control's, interleaved in one process; ratios are printed, none is asserted.

The linear loop of the paper's section 2 at gain 5, driven by a trigonometric plan, at 20,001 samples over 20 s.
"""

from statistics import median
from time import perf_counter

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlplan as cp

GAIN = 5.0
PLAN = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], alpha=1.0, labels=["r"])
T = np.linspace(0.0, 20.0, 20_001)
ROUNDS = 3


def driven():
    """The loop and the plan in one interconnection, which is what python-control simulates."""
    loop = cp.plants.integrator_lag_loop(GAIN)
    return ct.interconnect([cp.create_source_iosystem(PLAN), loop], inputs=0, outputs=["y"])


def tight():
    """y at every thousandth sample, by DOP853 near rounding, with a stop at the plan's end."""

    def rate(t, x):
        return [-x[0] + GAIN * (float(PLAN(t)) - x[1]), x[0]]

    options = {"rtol": 1e-13, "atol": 1e-15, "max_step": 0.05}
    move = solve_ivp(rate, (0.0, 1.0), [0.0, 0.0], "DOP853", **options).y[:, -1]
    rest = solve_ivp(rate, (1.0, 20.0), move, "DOP853", t_eval=T[1000::1000], **options)
    return np.append(0.0, rest.y[1])


@pytest.mark.benchmark
@pytest.mark.parametrize("form", ["input", "block"])
def test_exact_response_beside_input_output_response(form, benchmark, capsys):
    loop, whole = cp.plants.integrator_lag_loop(GAIN), driven()

    def ours():
        if form == "input":
            return cp.simulate(loop, T, PLAN, method="exact")
        return cp.simulate(whole, T, method="exact")

    def peer():
        return ct.input_output_response(whole, T)

    found = benchmark.pedantic(ours, rounds=20, warmup_rounds=1)
    assert np.abs(np.ravel(found.outputs)[::1000] - tight()).max() <= 1e-11

    times = []
    for _ in range(ROUNDS):
        seconds = []
        for function in (ours, peer):
            begin = perf_counter()
            result = function()
            seconds.append(perf_counter() - begin)
        times.append(seconds)
    # The same problem, to the peer's own tolerance.
    assert np.abs(np.ravel(result.outputs) - np.ravel(found.outputs)).max() <= 1e-2

    own, other = (median(column) for column in zip(*times, strict=True))
    ratio = median(b / a for a, b in times)
    benchmark.extra_info["ratio"] = ratio
    with capsys.disabled():
        print(f"\nexact, plan as {form}: {1e3 * own:.2f} ms, peer {1e3 * other:.0f} ms, {ratio:.0f} times faster")
