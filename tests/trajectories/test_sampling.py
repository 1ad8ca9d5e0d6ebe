"""Many times in one call: uniform, sorted and arbitrary ones agree with the jets at a few times."""

import tracemalloc

import numpy as np
import pytest
from trajectory_oracle import Direct, waypoints

from ctrlplan.trajectories import PiecewiseSpline, PolySpline, TrigSpline, Waypoint, stack

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

EPS = np.finfo(float).eps
ALPHAS = [0.0, 0.3, 1.0, 3.0, 5.5]
COUNTS = [257, 1000, 4097, 4500, 5000, 6500, 20_000, 100_000]


def random_plan(size, alpha, kind=TrigSpline, naxes=1):
    """Through Chebyshev-like times with jets of 1 to 3 entries, so that N = 6 to 40 stays moderate."""
    rng = np.random.default_rng(size)
    count = max(2, size // 2)
    times = 3.0 + 2.0 * np.cos(np.pi * np.arange(count - 1, -1, -1) / (count - 1))
    lengths = np.full(count, size // count)
    lengths[[0, -1]] += [(size - lengths.sum() + 1) // 2, (size - lengths.sum()) // 2]
    points = [
        Waypoint(
            t,
            *rng.normal(size=(k, naxes)),
        )
        for t, k in zip(times, lengths, strict=True)
    ]
    return kind(points, alpha=alpha)


def swinging(size):
    """The Chebyshev polynomial of the highest degree, with the largest cancellation of Taylor terms."""
    x = np.cos(np.pi * np.arange(size - 1, -1, -1) / (size - 1))
    return PolySpline([Waypoint(t, (-1.0) ** i) for i, t in enumerate(x)])


def few_at_a_time(plan, t, order):
    return np.concatenate([plan.jet(part, order) for part in np.array_split(t, -(-t.size // 250))], axis=2)


def disagreement(plan, t, order=2, tolerance=1e-13):
    """Maximum difference from the jets themselves; 1 is the tolerance plus what the rounding of times allows."""
    got = plan.jet(t, order)
    picked = np.unique(np.concatenate([np.arange(0, t.size, max(1, t.size // 3000)), np.arange(t.size - 30, t.size)]))
    exact = few_at_a_time(plan, t[picked], order + 1)
    size = np.abs(exact).max(axis=2)[:, :, None]
    allowed = tolerance * size[:-1] + 4 * EPS * plan.duration * size[1:]
    return float((np.abs(got[:, :, picked] - exact[:-1]) / allowed).max())


def orders_of(plan, count, rng):
    """Evenly spaced, sorted, and unsorted times in the interval."""
    inside = rng.uniform(plan.start, plan.end, count)
    return {"uniform": np.linspace(plan.start, plan.end, count), "sorted": np.sort(inside), "arbitrary": inside}


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("size", [6, 12, 24, 40])
def test_all_paths_agree_with_the_jets(size, alpha):
    plan = random_plan(size, alpha, naxes=2)
    rng = np.random.default_rng(1)
    for count in COUNTS:
        for name, t in orders_of(plan, count, rng).items():
            assert disagreement(plan, t) <= 1, (name, count)


@pytest.mark.parametrize("size", [6, 12, 24, 40])
def test_all_paths_agree_where_taylor_terms_cancel(size):
    plan = swinging(size)
    rng = np.random.default_rng(1)
    for count in COUNTS:
        for name, t in orders_of(plan, count, rng).items():
            assert disagreement(plan, t) <= 1, (name, count)


@pytest.mark.parametrize("order", [0, 1, 3, 4])
@pytest.mark.parametrize("alpha", [0.0, 2.0, 5.5])
def test_other_orders_of_derivatives(alpha, order):
    plan = random_plan(12, alpha)
    rng = np.random.default_rng(2)
    for count in (5000, 30_000):
        for name, t in orders_of(plan, count, rng).items():
            assert disagreement(plan, t, order=order) <= 1, (name, count)
            np.testing.assert_allclose(
                plan(t, order), plan.jet(t, order)[order, 0], rtol=0, atol=1e-12 * plan.peak(order)[0]
            )


@pytest.mark.parametrize("alpha", [0.0, 4.0])
def test_a_part_of_the_interval(alpha):
    plan = random_plan(12, alpha)
    rng = np.random.default_rng(3)
    for low, high in [(0.0, 0.01), (0.4, 0.6), (0.999, 1.0)]:
        a, b = plan.start + plan.duration * np.array([low, high])
        for name, t in {"uniform": np.linspace(a, b, 7000), "sorted": np.sort(rng.uniform(a, b, 7000))}.items():
            assert disagreement(plan, t) <= 1, (name, low)
        assert disagreement(plan, rng.uniform(a, b, 7000)) <= 1
    assert disagreement(plan, np.linspace(plan.end, plan.start, 9000)) <= 1


@pytest.mark.parametrize("alpha", [0.0, 4.0])
def test_times_outside_are_mixed_in(alpha):
    plan = random_plan(12, alpha)
    rng = np.random.default_rng(4)
    wide = rng.uniform(plan.start - plan.duration, plan.end + plan.duration, 30_000)
    for t in (wide, np.sort(wide), np.linspace(plan.start - 1, plan.end + 1, 30_000)):
        assert disagreement(plan, t) <= 1
        outside = (t < plan.start) | (t > plan.end)
        jet = plan.jet(t, 2)
        np.testing.assert_array_equal(jet[1:, :, outside], 0)
        np.testing.assert_array_equal(
            jet[0][:, t < plan.start], np.repeat(plan.initial[:, None], (t < plan.start).sum(), 1)
        )
        np.testing.assert_array_equal(jet[0][:, t > plan.end], np.repeat(plan.final[:, None], (t > plan.end).sum(), 1))


@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_several_segments(alpha):
    """Some with many samples, some with few; a join among the times."""
    times = [0.0, 1.0, 1.001, 4.0, 9.0]
    rng = np.random.default_rng(5)
    segments = PiecewiseSpline(waypoints(times, rng.normal(size=(5, 3)).tolist()), alpha=alpha)
    plan = stack([segments, segments.shift(0.3) + 2 * segments])
    for count in (6000, 50_000):
        for name, t in orders_of(plan, count, rng).items():
            if name == "arbitrary":
                t[count // 2] = 4.0
            assert disagreement(plan, t) <= 1, (name, count)


@pytest.mark.parametrize("duration", [1e-6, 1e6])
def test_short_and_long_plans_far_from_the_origin(duration):
    jets = [[0.0, 1.0 / duration], [2.0, 0.0], [1.0, -1.0 / duration]]
    rng = np.random.default_rng(6)
    for start in (0.0, 1e6 * duration):
        plan = TrigSpline(waypoints(start + duration * np.array([0.0, 0.4, 1.0]), jets), alpha=2.0)
        for name, t in orders_of(plan, 8000, rng).items():
            assert disagreement(plan, t) <= 1, (name, start)


def test_against_fifty_digits():
    """Not the package's own jets: equation (2) solved directly."""
    times, jets = [0.0, 0.3, 1.0], [[0.0, 1.0, 2.0], [1.0, -1.0], [0.5, 0.0, 3.0]]
    plan, oracle = TrigSpline(waypoints(times, jets), alpha=3.0), Direct(times, jets, 3.0)
    rng = np.random.default_rng(7)
    for t in orders_of(plan, 5000, rng).values():
        some = np.r_[0:5000:400, 4999]
        exact = oracle.jet(t[some], 2)
        size = np.abs(exact).max(axis=1, keepdims=True)
        assert (np.abs(plan.jet(t, 2)[:, 0, some] - exact) / size).max() <= 2e-13


def test_times_that_are_all_the_same():
    plan = random_plan(12, 2.0)
    t = np.full(5000, plan.start + 0.3)
    np.testing.assert_allclose(plan.jet(t, 2), np.repeat(plan.jet(t[:1], 2), 5000, axis=2), rtol=1e-13)
    t[:100] = plan.start
    assert disagreement(plan, np.sort(t)) <= 1


def test_almost_uniform_times_are_not_taken_for_uniform():
    """A hiccup of one sample in a million is seen."""
    plan = random_plan(12, 1.0)
    t = np.linspace(plan.start, plan.end, 50_001)
    t[33_333] += 0.4 * plan.duration / 50_000
    assert plan(t)[33_333] == pytest.approx(float(plan(t[33_333])), rel=1e-14)
    warped = plan.start + plan.duration * np.linspace(0, 1, 50_000) ** 1.0001
    assert disagreement(plan, warped) <= 1


def test_axes_that_vanish_or_stand_still():
    points = [Waypoint(0.0, [0.0, 5.0, 1e-200, 0.0], 0), Waypoint(1.0, [0.0, 5.0, 2e-200, 1e200], 0)]
    plan = TrigSpline(points, alpha=1.0)
    rng = np.random.default_rng(8)
    for t in orders_of(plan, 9000, rng).values():
        jet, exact = plan.jet(t, 2), few_at_a_time(plan, t, 2)
        size = np.abs(exact).max(axis=2, keepdims=True)
        np.testing.assert_array_equal(jet[:, 0], 0)
        np.testing.assert_allclose(jet[0, 1], 5.0, rtol=1e-14)
        assert (np.abs(jet - exact)[:, 2:] <= 1e-13 * size[:, 2:]).all()


@pytest.mark.parametrize("name", ["uniform", "sorted", "arbitrary"])
@pytest.mark.parametrize("segments", [1, 3])
def test_memory_is_a_small_multiple_of_the_result(segments, name):
    if segments == 1:
        plan = random_plan(12, 1.0, naxes=2)
    else:
        points = [Waypoint(float(i), *np.random.default_rng(i).normal(size=(3, 2))) for i in range(segments + 1)]
        plan = PiecewiseSpline(points, alpha=1.0)
    t = orders_of(plan, 1_000_000, np.random.default_rng(9))[name]
    plan.jet(t[:10_000], 2)
    tracemalloc.start()
    result = plan.jet(t, 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert result.shape == (3, 2, t.size)
    assert peak <= 2.5 * result.nbytes
