"""The offset of a log: against offsets that are known, and the bound of any unbiased estimate."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter

import ctrlplan as cp
from ctrlplan.studies.alignment import OfPlan, OfSamples, Pair, find_offset

SEEDS = range(30)
TRUE = 7.3e-3
QUINTIC = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
MOVES = cp.PiecewiseSpline([cp.Waypoint(0.2 * k, k % 2, 0, 0) for k in range(15)])  # 14 moves of 0.2 s


def logged(plan, seed, deviation, start=-0.2, end=1.3, dt=1e-3, rho=0.0):
    t = np.arange(start, end, dt)
    noise = np.random.default_rng(seed).normal(size=t.size + 1000)
    coloured = lfilter([math.sqrt(1.0 - rho**2)], [1.0, -rho], noise)[1000:]
    return t, plan(t - TRUE).ravel() + deviation * coloured


def found(plan, *args, **options):
    t, y = logged(plan, *args, **options)
    return find_offset(t, [Pair(y, OfPlan(plan, 0), 1.0)])


@pytest.mark.parametrize("seed", SEEDS)
def test_an_offset_is_found_within_three_standard_errors(seed):
    """The bound sigma sqrt(dt / int r'^2 dt) of a quintic of 1 s over 1 is sigma sqrt(0.7 dt), with int r'^2 = 10/7."""
    offset = found(QUINTIC, seed, 0.01)
    bound = 0.01 * math.sqrt(1e-3 * 7.0 / 10.0)
    assert bound == pytest.approx(0.26e-3, rel=0.02)
    # The deviation is estimated from 1500 samples, the correlation as well: each to 1/sqrt(1500), 2.6 %.
    assert offset.standard_error == pytest.approx(bound, rel=0.15)
    assert abs(offset.seconds - TRUE) <= 3.0 * offset.standard_error


@pytest.mark.parametrize("seed", SEEDS)
def test_to_a_tenth_of_a_millisecond_where_the_log_says_so_much(seed):
    assert abs(found(QUINTIC, seed, 0.001).seconds - TRUE) <= 1e-4
    assert abs(found(MOVES, seed, 0.01, -0.1, 3.0).seconds - TRUE) <= 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_the_standard_error_is_that_of_many_logs(rho):
    many = [found(QUINTIC, seed, 0.01, rho=rho) for seed in range(100)]
    relative = np.array([(one.seconds - TRUE) / one.standard_error for one in many])
    # A standard deviation of 100 normal values is 1 within 3/sqrt(200).
    assert 0.79 < relative.std() < 1.21
    assert np.abs(relative.mean()) < 0.3


def test_without_noise_the_offset_is_exact():
    for plan in (QUINTIC, MOVES):
        offset = found(plan, 0, 0.0)
        assert abs(offset.seconds - TRUE) < 1e-12
        assert 0.0 < offset.standard_error < 1e-9


def test_origins_of_time_may_be_far_apart():
    t = np.arange(5e4, 5e4 + 60.0, 2e-3)
    offset = find_offset(t, [Pair(QUINTIC(t - 50031.25).ravel(), OfPlan(QUINTIC, 0), 1.0)])
    assert abs(offset.seconds - 50031.25) < 1e-9  # times of 5e4 s are rounded to 7e-12


@pytest.mark.parametrize(("start", "end"), [(0.2, 0.8), (-3.0, 0.5), (0.4, 9.0)])
def test_a_part_of_the_move_suffices(start, end):
    offset = found(QUINTIC, 4, 0.002, start, end)
    assert abs(offset.seconds - TRUE) <= 3.0 * offset.standard_error < 3e-4


def test_uneven_samples():
    t = np.sort(np.random.default_rng(3).uniform(-0.2, 1.3, 1500))
    offset = find_offset(t, [Pair(QUINTIC(t - TRUE).ravel(), OfPlan(QUINTIC, 0), 1.0)])
    assert abs(offset.seconds - TRUE) < 1e-12


def test_several_signals_have_one_offset():
    plan = cp.stack([QUINTIC, MOVES], labels=["x", "z"])
    t = np.arange(-0.2, 3.0, 1e-3)
    noise = 0.01 * np.random.default_rng(8).normal(size=(2, t.size))
    rows = plan(t - TRUE) * [[1.0], [1.0]] + noise
    alone = [find_offset(t, [Pair(rows[a], OfPlan(plan, a), 1.0)]) for a in (0, 1)]
    both = find_offset(t, [Pair(rows[a], OfPlan(plan, a), 1.0) for a in (0, 1)])
    assert abs(both.seconds - TRUE) <= 3.0 * both.standard_error
    information = sum(one.standard_error**-2 for one in alone)
    assert both.standard_error**-2 == pytest.approx(information, rel=0.1)


def test_a_simulated_signal_is_interpolated():
    coarse = np.linspace(0.0, 1.0, 201)
    known = OfSamples(coarse, QUINTIC(coarse).ravel())
    t, y = logged(QUINTIC, 0, 0.0)
    # Monotone cubics are of second order at least: h^2/8 max |r''| = 5.8 h^2/8 is 1.8e-5, over an average rate of 1.2.
    assert abs(find_offset(t, [Pair(y, known, 1.0)]).seconds - TRUE) < 2e-5


def test_a_step_is_known_to_the_interval_between_two_samples():
    step = cp.Step(1.0, time=0.5)
    for offset in (TRUE, 7.8e-3, -0.1234):
        t = np.arange(0.0, 2.0, 1e-3)
        found = find_offset(t, [Pair(step(t - offset).ravel(), OfPlan(step, 0), 1.0)])
        assert abs(found.seconds - offset) <= 0.51e-3
        assert found.standard_error == pytest.approx(1e-3 / math.sqrt(12.0), rel=0.02)


def test_moves_that_repeat_fit_at_several_offsets():
    """A log of a plan that was followed three times: the origins of time are taken to agree."""
    plan = cp.PiecewiseSpline([cp.Waypoint(t, y, 0, 0) for t, y in ((0, 0), (0.5, 1), (1, 0))])
    t = np.arange(-9.0, 9.0, 1e-3)
    for seed in range(10):
        noise = 0.01 * np.random.default_rng(seed).normal(size=t.size)
        y = sum(plan(t - TRUE - later).ravel() for later in (-6.0, 0.0, 6.0)) + noise
        offset = find_offset(t, [Pair(y, OfPlan(plan, 0), 1.0)])
        assert offset.others >= 2
        assert abs(offset.seconds - TRUE) < 1e-3


def test_a_log_without_the_move_determines_nothing():
    t = np.arange(0.0, 2.0, 1e-3)
    for values in (np.zeros(t.size), np.ones(t.size), 0.01 * np.random.default_rng(0).normal(size=t.size)):
        assert find_offset(t, [Pair(values, OfPlan(QUINTIC, 0), 1.0)]).residual == math.inf
