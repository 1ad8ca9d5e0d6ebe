"""Exact responses of linear continuous loops with delays, compared with power series between marks in 32 digits."""

import math
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal, localcontext
from functools import partial
from itertools import accumulate, pairwise
from operator import mul

import control as ct
import mpmath as mp
import numpy as np
import pytest

import ctrlplan as cp

A = [[-0.4, 1.0], [-3.0, -0.6]]
TERMS, NEAR, SAME = 30, Decimal("1e-20"), Decimal("1e-12")


B = np.array([[1.0, 0.0, 0.2, -0.1], [0.5, 1.0, 0.0, 0.3]])
"""Inputs r, and x some times ago."""


def plant(inputs):
    columns = [*B[:, : len(inputs) - ("h" in inputs)].T, *([[0.0, 1.0]] if "h" in inputs else [])]
    return ct.ss(A, np.transpose(columns), np.eye(2), 0, inputs=inputs, outputs=["x", "v"], name="plant")


def by_powers(end, delays, rows, plan, state, times, law=None):
    """States of x' = A x + sum of rows[i] x[0](t - delays[i]) + b r + (0, h), zero before the start, in 32 digits.

    Powers of the time since each mark: all sums of 0, the ends of the plan and the sample times with multiples of the
    delays. `plan`: (first, last), a rest-to-rest polynomial of fifth degree from 0 to 1 between these times. `law`:
    (period, offset, gain), h = r - gain x[0] from each sample on. Also returns h at the times.
    """
    with localcontext(prec=32):
        a, b = [[*map(Decimal, row)] for row in A], [Decimal(1), Decimal("0.5")]
        rows, delays = [[*map(Decimal, row)] for row in rows], [*map(Decimal, delays)]
        end, (first, last), x = Decimal(end), map(Decimal, plan), [*map(Decimal, state)]
        period, offset, gain = map(Decimal, law or (1, end, 0))
        samples = [offset + k * period for k in range(int(end / period) + 1)]
        sums = [Decimal(0)]
        for delay in delays:
            sums = [t + k * delay for t in sums for k in range(int((end - t) / delay) + 1)]
        marks = sorted(t + s for t in {Decimal(0), first, last, *samples} for s in sums if t + s < end)
        marks = [t for k, t in enumerate(marks) if not k or t - marks[k - 1] > NEAR] + [end]
        binomial = [[Decimal(math.comb(i, j)) for j in range(i + 1)] for i in range(TERMS)]

        def reference(t):
            """Coefficients of r about a time."""
            length, s = last - first, (t - first) / (last - first)
            powers = _powers(s)
            if not -NEAR <= s < 1 - NEAR:
                return [Decimal(s > 0.5)] + [Decimal(0)] * TERMS
            own = [
                sum(binomial[i][j] * c * powers[i - j] for i, c in ((3, 10), (4, -15), (5, 6)) if i >= j)
                for j in range(6)
            ]
            return [c / length**j for j, c in enumerate(own)] + [Decimal(0)] * TERMS

        def past(t):
            """Coefficients of x[0] about an earlier time, from those of the cell that contains it."""
            if t < -NEAR:
                return [Decimal(0)] * TERMS
            k = max(k for k in range(len(cells)) if marks[k] <= t + NEAR)
            known, s = cells[k][0], _powers(t - marks[k])
            if s[1] <= NEAR:
                return known
            return [sum(binomial[i][j] * known[i] * s[i - j] for i in range(j, TERMS)) for j in range(TERMS)]

        cells, h, found = [], Decimal(0), []
        for left, right in pairwise(marks):
            r, back = reference(left), [past(left - delay) for delay in delays]
            if any(abs(t - left) < NEAR for t in samples):
                h = r[0] - gain * x[0]
            own = [[x[0]], [x[1]]]
            for j in range(TERMS - 1):
                held = (0, h if j == 0 else 0)
                for i in (0, 1):
                    fed = sum(row[i] * known[j] for row, known in zip(rows, back, strict=True))
                    own[i].append((a[i][0] * own[0][j] + a[i][1] * own[1][j] + b[i] * r[j] + fed + held[i]) / (j + 1))
            cells.append(own)
            inside = [
                Decimal(t) for t in times.tolist() if left - SAME <= Decimal(t) < right - SAME or t == right == end
            ]
            found += [[float(_sum(row, t - left)) for row in own] + [float(h)] for t in inside]
            x = [_sum(row, right - left) for row in own]
    return np.array(found).T


def _powers(s):
    return [*accumulate([Decimal(1)] + [s] * (TERMS - 1), mul)]


def _sum(coefficients, s):
    return sum(c * power for c, power in zip(coefficients, _powers(s), strict=True))


ROOT = math.sqrt(0.5)
"""0.7071 s has no common divisor with tenths of a second."""


@pytest.mark.parametrize("delays", [(0.4,), (0.4, 0.6), (0.05, 0.6), (0.4, ROOT), (0.3, 0.4, ROOT)])
def test_delays_between_continuous_blocks(delays):
    """The plan begins and ends inside of cells, and comes back after every sum of the delays."""
    loop = delayed_loop(delays)
    plan = cp.PolySpline([cp.Waypoint(0.15, 0, 0, 0), cp.Waypoint(1.25, 1, 0, 0)], labels=["r"])
    times = np.unique(np.append(np.random.default_rng(0).uniform(0.0, 3.0, 60), [0.0, 0.4, 0.6, 1.0, 3.0]))
    expected = by_powers(3.0, decimals(delays), delayed_rows(delays), ("0.15", "1.25"), [0.3, -0.1], times)[:2]
    found = cp.simulate(loop, times, plan, [0.3, -0.1])
    assert (found.method, found.reason) == ("exact", "linear, with delays")
    assert np.abs(found.outputs[:2] - expected).max() <= 2e-14 * np.abs(expected).max()
    past = cp.simulate(loop, np.unique(np.maximum(times - delays[0], 0.0)), plan, [0.3, -0.1])
    shown = np.where(times - delays[0] >= -1e-12, np.interp(times - delays[0], past.time, past.outputs[0]), 0.0)
    assert np.abs(found.outputs[2] - shown).max() <= 2e-14 * np.abs(expected).max()


def delayed_rows(delays):
    return B[:, 1 : len(delays) + 1].T.tolist()


def decimals(delays):
    """The delays as decimals where they have few digits."""
    return [f"{d:.2f}" if abs(round(d, 2) - d) < 1e-15 else d for d in delays]


def delayed_loop(delays, *further, inputs=("r",), outputs=("x", "v", "w0")):
    names = [f"w{k}" for k in range(len(delays))]
    late = [
        cp.create_delay_iosystem(d, inputs="x", outputs=name, name=f"delay{k}")
        for k, (d, name) in enumerate(zip(delays, names, strict=True))
    ]
    blocks = [plant(["r", *names, *(["h"] if further else [])]), *late, *further]
    return ct.interconnect(blocks, inputs=list(inputs), outputs=list(outputs))


@pytest.mark.parametrize("delays", [(0.15,), (ROOT,), (0.4, ROOT)])
def test_samples_and_delays_without_a_common_divisor(delays):
    """A law every 0.25 s from 0.03 s on; what it holds jumps, and returns after each delay."""
    law = ct.ss([], [], [], [[1.0, -0.5]], 0.25, inputs=["r", "x"], outputs="h", name="law")
    loop = delayed_loop(delays, cp.sample_hold(law, 0.25, 0.03), outputs=["x", "v", "h"])
    plan = cp.PolySpline([cp.Waypoint(0.15, 0, 0, 0), cp.Waypoint(1.25, 1, 0, 0)], labels=["r"])
    times = np.unique(np.append(np.random.default_rng(0).uniform(0.0, 2.0, 40), [0.0, 0.03, 0.28, 2.0]))
    values = by_powers(
        2.0, decimals(delays), delayed_rows(delays), ("0.15", "1.25"), [0.3, -0.1], times, ("0.25", "0.03", 0.5)
    )
    found = cp.simulate(loop, times, plan, [0.3, -0.1, 0.0])
    assert found.method == "exact"
    assert np.abs(found.outputs - values).max() <= 2e-14 * np.abs(values).max()


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


def two_delays(first, second, factors, moved):
    blocks = [
        cp.create_delay_iosystem(delay, inputs="x", outputs=f"w{k}", name=f"delay{k}")
        for k, delay in enumerate((first, second))
    ]
    return ct.interconnect([*blocks, moved(factors)], inputs="r", outputs="x")


def integrated(factors):
    return ct.ss(0.0, [[*factors, 1.0]], 1.0, 0.0, inputs=["w0", "w1", "r"], outputs="x", name="moved")


def added(factors):
    return ct.ss([], [], [], [[*factors, 1.0]], inputs=["w0", "w1", "r"], outputs="x", name="total", dt=None)


def sums(first, second, end):
    """Counts of both delays with a sum up to the end, the sum, and the number of orders in which they add up."""
    for n in range(int(end / first) + 1):
        for m in range(int((end - n * first) / second) + 1):
            yield n, m, n * first + m * second, math.comb(n + m, n)


@pytest.mark.parametrize(("first", "second"), [(1.0, math.sqrt(2.0)), (0.3, 0.50031)])
def test_delays_without_a_common_divisor(first, second):
    """x' = a x(t - first) + b x(t - second) + r from 1: powers of the time since each sum of the delays."""
    a, b, end = -0.7, -0.4, 12.0
    times = np.unique(np.append(np.random.default_rng(0).uniform(0.0, end, 20), [0.0, first, second, end]))
    found = cp.simulate(two_delays(first, second, (a, b), integrated), times, 1.0, 1.0)
    with mp.workdps(30):  # terms of 1e5 cancel
        expected = [mp.mpf(0)] * times.size
        for n, m, moment, ways in sums(mp.mpf(first), mp.mpf(second), end):
            k = n + m
            since = [max(mp.mpf(t) - moment, 0) for t in times.tolist()]
            factor = ways * mp.mpf(a) ** n * mp.mpf(b) ** m / mp.factorial(k)
            own = [factor * (s**k + s ** (k + 1) / (k + 1)) if s or not k else 0 for s in since]
            expected = [total + x for total, x in zip(expected, own, strict=True)]
    expected = np.array(expected, dtype=float)
    assert (found.method, found.reason) == ("exact", "linear, with delays")
    assert np.abs(found.outputs - expected).max() <= 3e-14 * np.abs(expected).max()


def test_jumps_return_after_every_sum_of_delays():
    """x = a x(t - 1) + b x(t - sqrt(2)) + r: a step of r returns as a step after each sum, never smoother."""
    first, second, end = 1.0, math.sqrt(2.0), 15.0
    loop = two_delays(first, second, (-0.5, 0.3), added)
    marks = np.array([moment for _, _, moment, _ in sums(first, second, end)])
    times = np.unique(np.concatenate([np.random.default_rng(0).uniform(0.0, end, 50), marks, [end]]))
    found = cp.simulate(loop, times, 1.0)
    expected = sum(
        ways * (-0.5) ** n * 0.3**m * (times >= moment - 1e-12) for n, m, moment, ways in sums(first, second, end)
    )
    assert found.method == "exact"
    assert np.abs(found.outputs - expected).max() <= 1e-14


def test_too_many_sums_of_delays_are_not_exact():
    loop = two_delays(1.0, math.sqrt(2.0), (-0.5, 0.3), added)
    with pytest.raises(ValueError, match=r"delays of 1, 1\.41421 s, sample times .* and have more than 20000 sums"):
        cp.simulate(loop, [0.0, 250.0], 1.0, method="exact")


def test_a_run_by_small_steps():
    """x'' = -x' - 2 x(t - 0.3) + x(t - 0.41421) + r by hand, steps of fourth order, with the interpolant of Hermite."""
    first, second, step, end = 0.3, math.sqrt(2.0) - 1.0, 2e-3, 4.0
    moved = ct.ss(
        [[0.0, 1.0], [0.0, -1.0]], [[0.0] * 3, [-2.0, 1.0, 1.0]], [[1.0, 0.0]], 0, inputs=["w0", "w1", "r"], outputs="x"
    )
    loop = two_delays(first, second, (), lambda _: moved)
    times = np.linspace(0.0, end, 21)
    found = cp.simulate(loop, times, 1.0)
    count = round(end / step)
    x, y = np.zeros(2), np.zeros((count + 2, 2))

    def past(t):
        if t < -1e-12:
            return 0.0
        k = int(t / step + 1e-9)
        s = t / step - k
        (p, v), (q, w) = y[k], y[k + 1]
        return p + s * (step * v + s * (3.0 * (q - p) - step * (2.0 * v + w) + s * (2.0 * (p - q) + step * (v + w))))

    def rate(t, z):
        return np.array([z[1], -z[1] - 2.0 * past(t - first) + past(t - second) + 1.0])

    for k in range(count):
        t = k * step
        k1 = rate(t, x)
        k2 = rate(t + 0.5 * step, x + 0.5 * step * k1)
        k3 = rate(t + 0.5 * step, x + 0.5 * step * k2)
        x = x + step / 6.0 * (k1 + 2.0 * (k2 + k3) + rate(t + step, x + step * k3))
        y[k + 1] = x
    by_hand = y[: count + 1 : count // 20, 0]
    assert found.method == "exact"
    # Jumps of x''(t - second) lie inside of steps: an error of their third power.
    assert np.abs(found.outputs - by_hand).max() <= step**3


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


@pytest.mark.slow
def test_runs_of_one_form_do_not_depend_on_earlier_ones():
    """Cells are kept for runs with the same times; other plans, starts, ends and initial states, in threads as well."""
    times = np.linspace(0.0, 6.0, 61)
    plans = [cp.PolySpline([cp.Waypoint(t, 0, 0), cp.Waypoint(t + 1.5, 1, 0)], labels=["r"]) for t in (0.2, 0.45)]
    runs = [
        (t, plan, x) for plan in [*plans, 1.0, *plans] for t in (times, times[:40], 0.3 + times) for x in (1.0, 2.0)
    ]

    def outputs(loop, run):
        return cp.simulate(loop, *run).outputs

    expected = [outputs(two_delays(0.3, 0.50031, (-0.7, -0.4), integrated), run) for run in runs]
    ready = cp.prepare(two_delays(0.3, 0.50031, (-0.7, -0.4), integrated))
    with ThreadPoolExecutor(4) as pool:
        found = [outputs(ready, run) for run in runs] + list(pool.map(partial(outputs, ready), runs))
    assert all(np.array_equal(*pair) for pair in zip(found, 2 * expected, strict=True))


def test_cells_are_computed_again_when_a_block_changes():
    loop = two_delays(0.3, 0.50031, (-0.7, -0.4), integrated)
    ready, times = cp.prepare(loop), np.linspace(0.0, 6.0, 61)
    before = cp.simulate(ready, times, 1.0, 1.0).outputs
    changed = next(block for block in loop.syslist if block.nstates)
    changed.B[0, 0] *= 2.0
    after = cp.simulate(ready, times, 1.0, 1.0).outputs
    other = two_delays(0.3, 0.50031, (-0.7, -0.4), integrated)
    next(block for block in other.syslist if block.nstates).B[0, 0] *= 2.0
    assert np.array_equal(after, cp.simulate(other, times, 1.0, 1.0).outputs)
    assert np.abs(after - before).max() > 1e-3
