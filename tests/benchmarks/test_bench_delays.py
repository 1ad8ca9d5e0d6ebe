"""Cost of exact loops with delays compared with Runge-Kutta steps written by hand, in turn in one process.

A plant of third order with control of its delayed position along a plan, 20 s. By hand: the classical method of fourth
order, with the delayed values between its steps by cubic Hermite interpolation, and steps for an error of about 1e-9.
"""

from math import floor
from statistics import median
from time import process_time

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

A = np.array([[0.0, 1.0, 0.0], [0.0, -0.5, 1.0], [0.0, 0.0, -5.0]])
B = np.array([0.0, 0.0, 5.0])
GAINS = {0.3: -0.8, 0.5: -0.3, 0.5 + 1e-3 * 2.0**0.5: -0.3}
"""Factors of the position some times ago. The last delay has no common divisor with the others."""
PLAN = cp.PolySpline([cp.Waypoint(1.0, 0, 0, 0), cp.Waypoint(5.0, 1, 0, 0)], labels=["r"])
T = np.linspace(0.0, 20.0, 401)
STEP = 0.0125
ROUNDS = 3


def loop(delays):
    late = [cp.create_delay_iosystem(d, inputs="y", outputs=f"w{k}", name=f"delay{k}") for k, d in enumerate(delays)]
    inputs = ["r", *(f"w{k}" for k in range(len(delays)))]
    columns = np.outer(B, [1.1, *(GAINS[d] for d in delays)])
    plant = ct.ss(A, columns, [[1.0, 0.0, 0.0]], 0, inputs=inputs, outputs="y", name="plant")
    return cp.prepare(ct.interconnect([plant, *late], inputs="r", outputs="y"))


def by_hand(delays, step):
    """Position at the times, by steps of fourth order."""
    count = round(T[-1] / step)
    stages = [
        [] for _ in range(3)
    ]  # at the start, middle and end of a step: steps back, and factors of the interpolant
    for d in delays:
        for j, stage in enumerate(stages):
            place = 0.5 * j - d / step
            back = floor(place + 1e-9)
            s = max(place - back, 0.0)
            stage.append((back, GAINS[d] * (1.0 - s) ** 2 * (1.0 + 2.0 * s), GAINS[d] * s * s * (3.0 - 2.0 * s)))
            stage[-1] += (GAINS[d] * step * s * (1.0 - s) ** 2, GAINS[d] * step * s * s * (s - 1.0))

    def run():
        planned = 1.1 * PLAN(np.arange(2 * count + 1) * 0.5 * step)
        x, y, rates = np.zeros(3), [0.0] * (count + 2), [0.0] * (count + 2)
        for k in range(count):
            u = planned[2 * k : 2 * k + 3].tolist()
            for j, stage in enumerate(stages):
                for back, f0, f1, g0, g1 in stage:
                    at = k + back
                    if at >= 0:
                        u[j] += f0 * y[at] + f1 * y[at + 1] + g0 * rates[at] + g1 * rates[at + 1]
            k1 = A @ x + B * u[0]
            k2 = A @ (x + 0.5 * step * k1) + B * u[1]
            k3 = A @ (x + 0.5 * step * k2) + B * u[1]
            k4 = A @ (x + step * k3) + B * u[2]
            x = x + step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
            y[k + 1], rates[k + 1] = x[:2].tolist()
        return np.array(y[: count + 1 : round(T[1] / step)])

    return run


@pytest.mark.benchmark
@pytest.mark.parametrize("delays", [(0.3,), (0.3, 0.5), tuple(sorted(GAINS)[::2])])
def test_delays_between_continuous_blocks(delays, benchmark, capsys):
    ready, peer = loop(delays), by_hand(delays, STEP)

    def ours():
        return cp.simulate(ready, T, PLAN)

    found = benchmark.pedantic(ours, rounds=3, warmup_rounds=1)
    rows = []
    for _ in range(ROUNDS):
        seconds = []
        for function in (ours, peer):
            begin = process_time()
            result = function()
            seconds.append(process_time() - begin)
        rows.append(seconds)
    coarse, fine = (by_hand(delays, step)() for step in (2.0 * STEP, STEP))
    # Errors of fourth order: the extrapolated value is exact to a higher one.
    best = fine + (fine - coarse) / 15.0
    assert found.method == "exact"
    error, other = np.abs(found.outputs - best).max(), np.abs(result - best).max()
    assert error <= 0.5 * other
    own, theirs = (median(column) for column in zip(*rows, strict=True))
    ratio = median(a / b for a, b in rows)
    benchmark.extra_info["ratio"] = ratio
    with capsys.disabled():
        print(
            f"\ndelays {delays}: {1e3 * own:.1f} ms, by hand {1e3 * theirs:.1f} ms with an error of {other:.1e}, "
            f"ratio {ratio:.2f}"
        )
