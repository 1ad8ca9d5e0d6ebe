"""Cost of figure 1's sweep over the gain beside python-control's, in one process; ratios are printed, none is asserted.

Three plans through k/(s^2 + s) in unity feedback at 500 gains from 0.25 to 1000, over 20 s, building included. The peer
is `control.forced_response`, which takes its input for linear between samples, at the coarsest even sampling over 0 to
20 s that leaves an error of 1e-6 in the output; its time is measured at some of the gains.
"""

from time import perf_counter

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation.exact import exact_states
from ctrlplan.simulation.linear import linear_forms
from ctrlplan.studies.linear import linear_plans

GAINS = np.geomspace(0.25, 1000.0, 500)
SOME = GAINS[12::25]
TIMES = np.linspace(0.0, 20.0, 8001)
PLANS = linear_plans()
ROUNDS = 3


def build(gain):
    return cp.plants.integrator_lag_loop(gain, outputs=("y", "u"))


def coarsest(gain):
    """Samples at which the peer's output has an error of 1e-6 with either smooth plan, to 2 %."""
    loop, count = build(gain), 501
    for plan in (PLANS["polynomial"], PLANS["trigonometric"]):
        while True:
            t = np.linspace(0.0, 20.0, count)
            exact = cp.simulate(loop, t, plan, method="exact").outputs[0]
            error = np.abs(ct.forced_response(loop, t, plan(t)).outputs[0] - exact).max()
            if error <= 1e-6:
                break
            # Its error is of second order in the spacing.
            count = int(count * max(1.02, 0.99 * np.sqrt(error / 1e-6)))
    return count


def seconds(function):
    begin = perf_counter()
    result = function()
    return perf_counter() - begin, result


def responses():
    """Every sample of y and u; kept is what is checked, the last y of the last plan."""
    found = []
    for gains in np.split(GAINS, range(32, GAINS.size, 32)):
        form = linear_forms([build(gain) for gain in gains])
        rest = np.zeros(form.a.shape[:2])
        for plan in PLANS.values():
            out = exact_states(form.a, form.b, plan.segment_jet_at, plan.breakpoints, TIMES, rest, form.c)
            out[:, 1] += form.d[:, 1] @ plan.jet(TIMES, 0)[0]
        found.append(out[:, 0, -1])
    return np.concatenate(found)


def sweep():
    return cp.sweep(build, GAINS, PLANS, TIMES, progress=False, measures=("settling_time", "overshoot_error"))


@pytest.mark.benchmark
def test_sweep_beside_forced_response(benchmark, capsys):
    counts = [coarsest(gain) for gain in SOME]

    def peer():
        found = []
        for gain, count in zip(SOME, counts, strict=True):
            t = np.linspace(0.0, 20.0, count)
            loop = build(gain)
            found.append([ct.forced_response(loop, t, plan(t)).outputs[0] for plan in PLANS.values()])
        return found

    found = benchmark.pedantic(sweep, rounds=3, warmup_rounds=1)
    first = int(np.searchsorted(GAINS, 0.25 + (np.pi / 20.0) ** 2))  # those before pass their final value after the run
    step, expected = found.metrics["step"]["overshoot_error"], np.exp(-0.5 * np.pi / np.sqrt(GAINS[first:] - 0.25))
    np.testing.assert_allclose(step[first:], 100 * expected, rtol=1e-5, atol=1e-6)

    ratios = []
    for _ in range(ROUNDS):
        (own, last), (whole, _), (other, theirs) = seconds(responses), seconds(sweep), seconds(peer)
        scaled = other * GAINS.size / SOME.size
        ratios.append((scaled / own, scaled / whole, own, whole, scaled))
    assert np.abs(last[12::25] - [outputs[-1][-1] for outputs in theirs]).max() <= 1e-6

    alone, all_in_all, own, whole, scaled = np.median(ratios, axis=0)
    benchmark.extra_info["ratio"] = all_in_all
    with capsys.disabled():
        print(
            f"\n500 gains, 3 plans: responses {own:.2f} s, with metrics {whole:.2f} s, peer {scaled:.0f} s at "
            f"{min(counts)} to {max(counts)} samples: {alone:.0f} and {all_in_all:.0f} times faster"
        )
