"""Cost of a step of a linear loop next to the bare matrix product; ratios are printed, none is asserted."""

from statistics import median
from time import process_time

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlplan as cp

STATES, STEPS, ROUNDS = 10, 5000, 9


def plant():
    """Ten states, two inputs, three outputs."""
    rng = np.random.default_rng(1)
    a = rng.standard_normal((STATES, STATES))
    a -= (np.linalg.eigvals(a).real.max() + 0.5) * np.eye(STATES)
    return ct.ss(a, rng.standard_normal((STATES, 2)), rng.standard_normal((3, STATES)), rng.standard_normal((3, 2)))


@pytest.mark.benchmark
def test_a_step_beside_the_bare_product(benchmark, capsys):
    system, dt = plant(), 1e-3
    inputs = list(np.random.default_rng(2).standard_normal((STEPS, 2)))
    whole = np.zeros((STATES + 2, STATES + 2))
    whole[:STATES, :STATES], whole[:STATES, STATES:] = system.A, system.B
    change = expm(dt * whole)[:STATES]
    matrix = np.concatenate([change, system.C @ change + np.hstack([0.0 * system.C, system.D])])
    prepared = cp.prepare(system)

    def ours():
        stepper = prepared.start(dt)
        step = stepper.step
        for u in inputs:
            y = step(u)
        return y

    def bare():
        both, state = np.zeros(STATES + 2), slice(0, STATES)
        for u in inputs:
            both[STATES:] = u
            found = matrix @ both
            both[state] = found[state]
        return found[STATES:]

    def product():
        both = np.ones(STATES + 2)
        for _ in inputs:
            matrix @ both

    found = benchmark.pedantic(ours, rounds=5, warmup_rounds=1)
    assert np.abs(found - bare()).max() <= 1e-11 * np.abs(bare()).max()
    times = []
    for _ in range(ROUNDS):
        seconds = []
        for function in (ours, bare, product):
            begin = process_time()
            function()
            seconds.append(process_time() - begin)
        times.append(seconds)
    own, recursion, alone = (median(column) / STEPS * 1e6 for column in zip(*times, strict=True))
    benchmark.extra_info["ratio"] = ratio = median(a / c for a, _, c in times)
    with capsys.disabled():
        print(
            f"\nstep of {STATES} states: {own:.1f} us; recursion by hand {recursion:.1f} us; "
            f"product alone {alone:.1f} us; ratio to the product {ratio:.1f}"
        )
