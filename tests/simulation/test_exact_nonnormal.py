"""The exact method for matrices far from normal: transient growth, and cancellation in squares.

The reference is mpmath's exponential at 60 digits, of the same floating-point
matrices with the input as states of their own. An error is held against what
half a unit in the last place of every entry does to the solution.
"""

import re
import warnings
from fractions import Fraction

import control as ct
import mpmath as mp
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation.exact import exact_states, sampled_states
from ctrlplan.simulation.pairs import pair_product, pair_sum

EPS = np.finfo(float).eps
STEP = [1.0]
QUINTIC = [0.0, 0.0, 0.0, 60.0, -360.0, 720.0]
"""Derivatives at 0 of the inputs 1 and 10 t^3 - 15 t^4 + 6 t^5."""


def turned(rng, a):
    """The matrix in other orthogonal coordinates, so that every sum in its powers has cancellation."""
    q, _ = np.linalg.qr(rng.normal(size=a.shape))
    return q @ a @ q.T


def similar(rng, n=5, condition=1e6):
    """Poles from -0.7 to -6 with eigenvectors of some condition number."""
    left, right = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    change = left @ np.diag(np.geomspace(1.0, condition, n)) @ right
    return change @ np.diag(-rng.uniform(0.7, 6.0, n)) @ np.linalg.inv(change)


def chain(rng, n=4, gain=30.0):
    return turned(rng, gain * np.eye(n, k=1) - 3.0 * np.eye(n))


def companion(rng, n=8):
    a = np.diag(np.ones(n - 1), -1)
    a[0] = -np.poly(-3.0 * (1.0 + 0.05 * rng.normal(size=n)))[1:]
    return a


def canonical(rng, n=7):
    return np.ascontiguousarray(companion(rng, n)[::-1, ::-1])


def two_rates(rng, n=6):
    change = rng.normal(size=(n, n))
    rates = np.concatenate([rng.uniform(0.5, 3.0, n // 2), rng.uniform(1e3, 1e4, n - n // 2)])
    return change @ np.diag(-rates) @ np.linalg.inv(change)


KINDS = {f.__name__: f for f in (similar, chain, companion, canonical, two_rates)}


def solution(a, b, derivatives, duration, count, start, rng=None):
    """States (n, count) at even times, of a polynomial input of unit duration; entries moved by half an ulp or not."""
    n, k = len(a), len(derivatives)
    with mp.workdps(60):

        def entry(value):
            value = mp.mpf(float(value))
            return value if rng is None else value * (1 + int(rng.choice([-1, 1])) * mp.mpf(2) ** -53)

        whole = mp.zeros(n + k)
        for i in range(n):
            for j in range(n):
                whole[i, j] = entry(a[i, j])
            whole[i, n] = entry(b[i, 0])
        for j in range(k - 1):
            whole[n + j, n + j + 1] = mp.mpf(1)
        step = mp.expm(whole * mp.mpf(duration) / (count - 1), method="taylor")
        x = mp.matrix([*map(float, start), *derivatives])
        columns = [x]
        for _ in range(count - 1):
            columns.append(step * columns[-1])
        return np.array([[column[i] for column in columns] for i in range(n)], dtype=object)


def hump(a, duration):
    """Largest number in exp(a t) at durations of this and its halves, at least 1."""
    with mp.workdps(60):
        power = mp.expm(mp.matrix(a.tolist()) * mp.mpf(duration) / 256, method="taylor")
        largest = mp.mpf(1)
        for _ in range(9):
            largest = max([largest, *(abs(value) for value in power)])
            power = power * power
        return float(largest)


def rounded(a, states, duration):
    """Rounding errors of a step-by-step propagation of states (n, count), relative to the exact solution at even times.

    A step rounds the n + 1 products of its change of the state, their sum and the new state, each by
    half an ulp; what it has rounded grows from there by the exponential of the time that is left.
    """
    n, count = states.shape
    with mp.workdps(60):
        step = mp.expm(mp.matrix(a.tolist()) * mp.mpf(duration) / (count - 1), method="taylor")
        powers = [mp.eye(n)]
        for _ in range(count - 1):
            powers.append(step * powers[-1])
    grown = np.abs([np.array(power.tolist(), dtype=float) for power in powers])
    change, sizes = np.abs(np.array((step - mp.eye(n)).tolist(), dtype=float)), np.abs(states)
    made = 0.5 * EPS * (n + 3) * (change @ sizes[:, :-1] + sizes[:, 1:] + sizes[:, :-1])
    return max(sum(grown[k - j] @ made[:, j] for j in range(k)).max() for k in range(1, count))


def reference(a, b, derivatives, duration, count, start, seed=0):
    """Solution and its error bound."""
    args = (a, b, derivatives, duration, count, start)
    exact, rng = solution(*args), np.random.default_rng(seed)
    with mp.workdps(60):
        moved = np.max([np.abs(solution(*args, rng) - exact).max(axis=1) for _ in range(3)], axis=0).astype(float)
    exact = exact.astype(float)
    # Perturbations of random signs add up as roots of sums, roundings at worst as sums: n^2 entries, a factor of n.
    # A table of exponentials rounds one by its size, and what it has rounded grows by the next one's.
    table = EPS * hump(a, duration) ** 2 * np.abs(exact).max()
    return exact, 2.0 * len(a) * (moved.max() + table) + rounded(a, exact, duration)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("duration", [0.125, 16.0])
def test_the_loss_of_digits_is_that_of_half_an_ulp_of_the_matrix(kind, duration):
    rng = np.random.default_rng([len(kind), int(8 * duration)])
    a = KINDS[kind](rng)
    b, start = rng.normal(size=(len(a), 1)), rng.normal(size=len(a))
    exact, bound = reference(a, b, STEP, duration, 33, start)
    t = np.linspace(0.0, duration, 33)
    plan = cp.Step(1.0)

    def planned(times):
        return exact_states(a, b, plan.segment_jet_at, [], times, start)

    assert np.abs(sampled_states(a, b, np.ones((1, 33)), t, start) - exact).max() <= bound
    assert np.abs(planned(t) - exact).max() <= bound
    assert np.abs(planned(t[[0, -1]]) - exact[:, [0, -1]]).max() <= bound
    assert np.abs(planned(t[[0, 3, 4, 19, 32]]) - exact[:, [0, 3, 4, 19, 32]]).max() <= bound
    assert (
        np.abs(planned(np.linspace(0.0, duration, 2049))[:, ::64] - exact).max() <= bound
    )  # far more halvings than a needs
    fine = np.linspace(0.0, duration, 257)
    assert np.abs(sampled_states(a, b, np.ones((1, 257)), fine, start)[:, ::8] - exact).max() <= bound


@pytest.mark.slow
@pytest.mark.parametrize("count", [9, 1025])
def test_a_plan_through_a_matrix_far_from_normal(count):
    rng = np.random.default_rng(5)
    a, b = 8.0 * similar(rng, 4, 1e5), rng.normal(size=(4, 1))
    exact, bound = reference(a, b, QUINTIC, 1.0, 9, np.zeros(4))
    plan = cp.PolySpline([cp.Waypoint(0.0, 0, 0, 0), cp.Waypoint(1.0, 1, 0, 0)])
    t = np.linspace(0.0, 1.0, count)
    found = exact_states(a, b, plan.segment_jet_at, plan.breakpoints, t, np.zeros(4))
    assert np.abs(found[:, :: (count - 1) // 8] - exact).max() <= bound


@pytest.mark.parametrize("count", [2, 513])
def test_a_member_of_a_batch_is_not_squared_as_often_as_the_stiffest(count):
    rng = np.random.default_rng(8)
    a, b, start = similar(rng, 4), rng.normal(size=(4, 1)), rng.normal(size=4)
    stiff = np.diag([-1e9, -1e6, -1.0, -1e-3])
    batch, t = np.stack([stiff, a, -np.eye(4)]), np.linspace(0.0, 4.0, count)
    exact, bound = reference(a, b, STEP, 4.0, 2, start)
    initial = np.tile(start, (3, 1))
    found = exact_states(batch, np.stack([b] * 3), cp.Step(1.0).segment_jet_at, [], t, initial)[..., [0, -1]]
    assert np.abs(found[1] - exact).max() <= bound
    for member, rates in ((0, -np.diag(stiff)), (2, np.ones(4))):
        decay = np.exp(-rates * 4.0)
        want = decay * start + (-np.expm1(-rates * 4.0) / rates) * b[:, 0]
        assert np.all(np.abs(found[member, :, -1] - want) <= 1e-14 * (np.abs(start) + np.abs(b[:, 0] / rates)))


def test_inputs_of_very_different_size_keep_their_digits():
    rng = np.random.default_rng(3)
    a, b = similar(rng, 4), rng.normal(size=(4, 1))
    exact, bound = reference(a, b, STEP, 4.0, 2, np.zeros(4))
    for gains in ([1.0, 2.0**40], [2.0**40, 1.0]):
        small = gains.index(1.0)
        plan = cp.stack([cp.Step(float(k == small)) for k in range(2)], labels=["a", "b"])
        found = exact_states(a, b * gains, plan.segment_jet_at, plan.breakpoints, np.array([0.0, 4.0]), np.zeros(4))
        assert np.abs(found - exact).max() <= bound


# Warnings of lost accuracy


def simulated(a, b, t):
    system = ct.ss(a, b, np.eye(len(a)), 0.0, name="bent")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = cp.simulate(system, t, cp.Step(1.0)).states
    texts = [str(warning.message) for warning in caught]
    return found, [float(re.search(r"of bent are uncertain by (\S+) %", text)[1]) / 100.0 for text in texts], texts


@pytest.mark.slow
@pytest.mark.parametrize("gain", [300.0, 500.0])
@pytest.mark.parametrize("count", [9, 65])
def test_digits_that_a_matrix_far_from_normal_loses_are_said(gain, count):
    rng = np.random.default_rng(4)
    a, b = chain(rng, 6, gain), rng.normal(size=(6, 1))
    exact, _ = reference(a, b, STEP, 2.0, 9, np.zeros(6))
    found, said, texts = simulated(a, b, np.linspace(0.0, 2.0, count))
    error = (np.abs(found[:, :: (count - 1) // 8] - exact).max(axis=1) / np.abs(exact).max(axis=1)).max()
    assert len(said) == 1
    # A draw of signs has the size of the root of a sum of n^2 squares; rounding that of the sum, at most n times more.
    assert said[0] >= 0.25 / 6.0 * min(error, 1.0)
    assert "for which the matrix is closer to normal" in texts[0]


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_said_where_digits_are_kept(kind):
    rng = np.random.default_rng(1)
    a = similar(rng, condition=1e4) if kind == "similar" else KINDS[kind](rng)
    assert simulated(a, rng.normal(size=(len(a), 1)), np.linspace(0.0, 8.0, 41))[1] == []


# Numbers in two parts


def exactly(pair):
    return [
        [Fraction(float(u)) + Fraction(float(v)) for u, v in zip(*rows, strict=True)]
        for rows in zip(*pair, strict=True)
    ]


@pytest.mark.parametrize("k", [1, 3, 19])
def test_products_of_pairs_have_a_hundred_digits(k):
    rng = np.random.default_rng(k)

    def pair(shape):
        high = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 4, shape)
        return high, 0.5 * EPS * high * rng.uniform(-1.0, 1.0, shape)

    left, right = pair((4, k)), pair((k, 5))
    found, one, other = exactly(pair_product(left, right)), exactly(left), exactly(right)
    largest = np.outer(np.abs(left[0]).max(axis=1), np.abs(right[0]).max(axis=0))
    for i in range(4):
        for j in range(5):
            want = sum(one[i][p] * other[p][j] for p in range(k))
            assert abs(found[i][j] - want) <= 8 * k**2 * Fraction(2.0**-105 * largest[i, j])


def test_sums_of_pairs_keep_what_cancels():
    one = np.array([[1.0, 1e16, -3.0]]), np.array([[1e-17, 0.5, 0.0]])
    other = np.array([[-1.0, 1.0, 3.0]]), np.array([[1e-20, 0.25, 1e-18]])
    found, first, second = (exactly(pair)[0] for pair in (pair_sum(one, other), one, other))
    for value, u, v in zip(found, first, second, strict=True):
        assert abs(value - u - v) <= Fraction(2.0**-100) * (abs(u) + abs(v))
