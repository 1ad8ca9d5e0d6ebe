"""Exact responses of linear continuous loops with delays, compared with power series of each cell in 50 digits."""

import math

import control as ct
import mpmath as mp
import numpy as np
import pytest

import ctrlplan as cp

A = [[-0.4, 1.0], [-3.0, -0.6]]
TERMS = 50


B = np.array([[1.0, 0.0, 0.2], [0.5, 1.0, 0.0]])
"""Inputs r, and x some times ago."""


def plant(inputs):
    return ct.ss(A, B[:, : len(inputs)], np.eye(2), 0, inputs=inputs, outputs=["x", "v"], name="plant")


def by_series(cell, end, delays, rows, plan, state, times):
    """States of x' = A x + sum of rows[i] x(t - delays[i]) + b r, zero before the start.

    Powers of the time since the start of each cell; the delays and the breakpoints of the plan are multiples of a cell.
    `plan`: (first, last), a rest-to-rest polynomial of fifth degree from 0 to 1 between these cells.
    """
    with mp.workdps(50):
        a, cell = mp.matrix(A), mp.mpf(cell)
        matrices = [mp.matrix(row) for row in rows]
        b, first, last = mp.matrix([1, 0.5]), *plan
        length = (last - first) * cell
        cells, x = [], mp.matrix(state)
        for k in range(end):
            r = [mp.mpf(1 if k >= last else 0)] + [mp.mpf(0)] * TERMS
            if first <= k < last:
                s = (k - first) * cell
                whole = {3: 10 / length**3, 4: -15 / length**4, 5: 6 / length**5}
                r = [
                    sum((mp.binomial(i, j) * c * s ** (i - j) for i, c in whole.items() if i >= j), mp.mpf(0))
                    for j in range(TERMS + 1)
                ]
            coefficients = [x]
            for j in range(TERMS):
                rate = a * coefficients[j] + b * r[j]
                for matrix, delay in zip(matrices, delays, strict=True):
                    if k >= delay:
                        rate += matrix * cells[k - delay][j]
                coefficients.append(rate / (j + 1))
            cells.append(coefficients)
            x = sum((c * cell**j for j, c in enumerate(coefficients)), mp.zeros(2, 1))
        found = []
        for t in times:
            k = min(int(mp.floor(mp.mpf(float(t)) / cell + mp.mpf("1e-12"))), end - 1)
            s = mp.mpf(float(t)) - k * cell
            found.append([float(y) for y in sum((c * s**j for j, c in enumerate(cells[k])), mp.zeros(2, 1))])
    return np.array(found).T


@pytest.mark.slow
@pytest.mark.parametrize("delays", [(0.4,), (0.4, 0.6), (0.05, 0.6)])
def test_delays_between_continuous_blocks(delays):
    """The plan begins and ends inside of cells, and comes back after every sum of the delays."""
    names = [f"w{k}" for k in range(len(delays))]
    late = [
        cp.create_delay_iosystem(d, inputs="x", outputs=name, name=f"delay{k}")
        for k, (d, name) in enumerate(zip(delays, names, strict=True))
    ]
    loop = ct.interconnect([plant(["r", *names]), *late], inputs=["r"], outputs=["x", "v", "w0"])
    plan = cp.PolySpline([cp.Waypoint(0.15, 0, 0, 0), cp.Waypoint(1.25, 1, 0, 0)], labels=["r"])
    times = np.unique(np.append(np.random.default_rng(0).uniform(0.0, 3.0, 60), [0.0, 0.4, 0.6, 1.0, 3.0]))
    rows = [[[B[0, k + 1], 0.0], [B[1, k + 1], 0.0]] for k in range(len(delays))]
    cells = [round(delay / 0.05) for delay in delays]
    expected = by_series("0.05", 60, cells, rows, (3, 25), [0.3, -0.1], times)
    found = cp.simulate(loop, times, plan, [0.3, -0.1])
    assert (found.method, found.reason) == ("exact", "linear, with delays")
    assert np.abs(found.outputs[:2] - expected).max() <= 2e-14 * np.abs(expected).max()
    past = by_series("0.05", 60, cells, rows, (3, 25), [0.3, -0.1], np.maximum(times - delays[0], 0.0))[0]
    shown = np.where(times - delays[0] >= -1e-12, past, 0.0)
    assert np.abs(found.outputs[2] - shown).max() <= 2e-14 * np.abs(expected).max()


def test_a_long_undamped_run():
    """x' = -pi/2 x(t - 1) from 1: the sum of (-pi/2)^k (t - k + 1)^k/k! in 400 digits after 100 delays."""
    late = cp.create_delay_iosystem(1.0, inputs="x", outputs="w", initial=1.0)
    moved = ct.ss(0.0, -math.pi / 2, 1.0, 0.0, inputs="w", outputs="x", name="moved")
    times = np.array([0.0, 10.3, 50.0, 99.5])
    found = cp.simulate(ct.interconnect([late, moved], inputs=0, outputs="x"), times, None, 1.0)
    with mp.workdps(400):
        rate = -mp.mpf(math.pi / 2)
        expected = [
            float(sum(rate**k * (mp.mpf(t) - k + 1) ** k / mp.factorial(k) for k in range(int(t) + 2)))
            for t in times.tolist()
        ]
    assert found.method == "exact"
    assert np.abs(found.outputs - expected).max() <= 1e-13


def test_events_of_a_loop_with_a_delay():
    """1 - t + (t - 1)^2/2 = -0.4 at 2 - sqrt(0.2), where the run ends."""
    late = cp.create_delay_iosystem(1.0, inputs="x", outputs="w", initial=1.0)
    moved = ct.ss(0.0, -1.0, 1.0, 0.0, inputs="w", outputs="x", name="moved")
    loop = ct.interconnect([late, moved], inputs=0, outputs="x")
    found = cp.simulate(loop, [0.0, 9.0], None, 1.0, events=[cp.Event("x", low=-0.4, stop=True)])
    assert found.method == "exact"
    assert abs(found.time[-1] - (2.0 - math.sqrt(0.2))) <= 1e-13


def test_a_delayed_loop_that_overflows():
    late = cp.create_delay_iosystem(0.1, inputs="x", outputs="w")
    moved = ct.ss(30.0, 1.0, 1.0, 0.0, inputs="w", outputs="x", name="moved")
    loop = ct.interconnect([late, moved], inputs=0, outputs="x")
    with pytest.raises(RuntimeError, match=r"states of .* must stay finite up to 30 s, got an overflow at 23\.\d+ s"):
        cp.simulate(loop, [0.0, 30.0], None, 1.0, method="exact")


def test_delays_without_a_common_part_run_by_another_method():
    """x' = -x(t - 1) - x(t - pi) has no common part: the numerical methods run it, and the exact one says why not."""
    blocks = [
        cp.create_delay_iosystem(delay, inputs="x", outputs=f"w{k}", initial=1.0, name=f"delay{k}")
        for k, delay in enumerate((1.0, math.pi))
    ]
    moved = ct.ss(0.0, [[-1.0, -1.0]], 1.0, 0.0, inputs=["w0", "w1"], outputs="x", name="moved")
    loop = ct.interconnect([*blocks, moved], inputs=0, outputs="x")
    found = cp.simulate(loop, [0.0, 0.5, 1.0], None, 1.0)
    assert found.method in ("compiled", "python")
    assert "delays of 1, 3.14159 s, sample times and breakpoints of functions of time" in found.reason
    assert np.abs(found.outputs - [1.0, 0.0, -1.0]).max() <= 1e-7


@pytest.mark.parametrize(("delay", "offset"), [(0.13, 0.0), (0.4, 0.03)])
def test_a_sampled_control_of_a_loop_with_a_delay(delay, offset):
    """x' = -2 x(t - delay) + h with h = r - x/2 every 0.1 s: powers of the time since each of many marks."""
    late = cp.create_delay_iosystem(delay, inputs="x", outputs="w")
    law = ct.ss([], [], [], [[1.0, -0.5]], 0.1, inputs=["r", "x"], outputs="h", name="law")
    moved = ct.ss(0.0, [[-2.0, 1.0]], 1.0, 0.0, inputs=["w", "h"], outputs="x", name="moved")
    loop = ct.interconnect([late, moved, cp.sample_hold(law, 0.1, offset)], inputs="r", outputs=["x", "h"])
    found = cp.simulate(loop, 0.05 * np.arange(41), cp.Step(1.0, time=0.33), [0.5, 0.0])
    with mp.workdps(50):
        cell = mp.mpf("0.01")
        hop, first, x, h, cells, rows = round(delay / 0.01), round(offset / 0.01), mp.mpf(0.5), mp.mpf(0), [], []
        for k in range(201):
            if k >= first and (k - first) % 10 == 0:
                h = (1 if k >= 33 else 0) - x / 2
            if k % 5 == 0:
                rows.append([float(x), float(h)])
            past = cells[k - hop] if k >= hop else [mp.mpf(0)] * (TERMS + 1)
            own = [x, *((-2 * past[j] + (h if j == 0 else 0)) / (j + 1) for j in range(TERMS))]
            cells.append(own)
            x = sum(c * cell**j for j, c in enumerate(own))
    assert (found.method, found.reason) == ("exact", "linear, with delays")
    assert np.abs(found.outputs - np.array(rows).T).max() <= 1e-14


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e-9])
def test_the_unit_of_time_does_not_matter(unit):
    """x' = h - 3 x(t - 0.15), h held from samples of 1: a sum of powers after each delay."""
    rate = 1.0 / unit
    moved = ct.ss(0.0, [[rate, -3.0 * rate]], 1.0, 0.0, inputs=["h", "late"], outputs="x", name="moved")
    hold = ct.ss([], [], [], [[1.0]], 0.35 * unit, inputs="r", outputs="h", name="hold")
    late = cp.create_delay_iosystem(0.15 * unit, inputs="x", outputs="late", name="late")
    loop = ct.interconnect([moved, cp.sample_hold(hold, 0.35 * unit), late], inputs="r", outputs="x")
    times = np.linspace(0.0, 1.1, 23)
    found = cp.simulate(loop, times * unit, 1.0, [0.4, 0.0])
    since = np.maximum(times - 0.15 * np.arange(8)[:, None], 0.0)
    terms = [(-3.0) ** k * t**k / math.factorial(k) * (0.4 + t / (k + 1)) for k, t in enumerate(since)]
    terms[1:] = [np.where(t > 0.0, own, 0.0) for own, t in zip(terms[1:], since[1:], strict=True)]
    assert found.method == "exact"
    assert np.abs(found.outputs - sum(terms)).max() <= 1e-13
