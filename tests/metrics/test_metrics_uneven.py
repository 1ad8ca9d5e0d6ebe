"""Records in which neighbouring steps differ by decades, as next to events and sample times."""

import numpy as np
import pytest

from ctrlplan.metrics import effort, iae, peak, total_variation

JUMPS = [  # one jump of 1 within a short step, at either end or inside
    ([0, 1e-9, 1, 10], [0, 1, 1, 1]),
    ([0, 9, 10 - 1e-9, 10], [1, 1, 1, 0]),
    ([0, 1e-9, 1, 10, 12], [0, 1, 1, 1, 1]),
    ([0, 4, 4 + 1e-6, 10], [0, 0, 1, 1]),
    ([0, 4, 4 + 1e-6, 10, 11, 12, 13], [0, 0, 1, 1, 1, 1, 1]),
    ([0, 1e-12, 1e-6, 1, 10], [0, 1, 1, 1, 1]),
    ([0, 1e-4, 1, 100], [0, 1, 1, 1]),
]


def at_one(times, values):
    """Time during which the signal is 1, with half of the short step in which it jumps."""
    return float(np.sum(np.diff(times) * (np.array(values[1:]) + values[:-1]) / 2))


@pytest.mark.parametrize(("times", "values"), JUMPS)
@pytest.mark.parametrize("scale", [1.0, -3e5])
def test_a_jump_within_a_short_step(times, values, scale):
    u = scale * np.array(values, dtype=float)
    expected = at_one(times, values)
    assert effort(times, u) == pytest.approx(scale**2 * expected, rel=1e-4)
    assert iae(times, u) == pytest.approx(abs(scale) * expected, rel=1e-4)
    assert peak(times, u) == abs(scale)
    assert total_variation(times, u) == pytest.approx(abs(scale), rel=1e-14)


@pytest.mark.parametrize("count", [2, 3, 4, 30])
@pytest.mark.parametrize("gap", [1e-4, 1e-9, 1e-12])
def test_a_staircase_with_samples_before_and_after_each_jump(count, gap):
    levels = np.random.default_rng(count).normal(size=count)
    ends = np.arange(1.0, count)
    times = np.sort(np.concatenate([[0.0, count], ends - gap, ends]))
    u = np.repeat(levels, 2)
    assert effort(times, u) == pytest.approx(np.sum(levels**2), rel=3 * gap * count + 1e-12)
    assert peak(times, u) == pytest.approx(np.abs(levels).max(), rel=1e-12)
    assert total_variation(times, u) == pytest.approx(np.abs(np.diff(levels)).sum(), rel=1e-12)


@pytest.mark.slow
def test_no_cubic_is_farther_from_the_samples_than_these_are_apart():
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(3, 14))
        steps = 10.0 ** rng.choice([0, 0, 0, -1, -2, -5, -10], n - 1) * rng.uniform(0.5, 1.5, n - 1)
        t, u = np.append(0.0, np.cumsum(steps)), rng.normal(size=n)
        assert peak(t, u) <= np.abs(u).max() + 1.5 * np.ptp(u)
        assert effort(t, u) <= (np.abs(u).max() + 1.5 * np.ptp(u)) ** 2 * t[-1]


def signal(t):
    return np.sin(t) + 0.3 * np.cos(2 * t)


EFFORT = 6 * (0.5 + 0.045) - np.sin(12) / 4 + 0.09 * np.sin(24) / 8 + 0.3 * (-np.cos(18) / 3 + np.cos(6) + 1 / 3 - 1)
"""Integral of the square from 0 to 6: of sin², of 0.09 cos², and of 0.6 sin t cos 2 t = 0.3 (sin 3 t - sin t)."""


def grids(m, gap):
    """Even times with further ones next to some of them, and pairs of times about each of them."""
    even = np.linspace(0, 6, m + 1)
    laced = np.unique(np.concatenate([even, even[[2, 5, m // 2, m - 3]] + gap]))
    return laced, np.sort(np.concatenate([[0.0, 6.0], even[1:-1] - gap, even[1:-1] + gap]))


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("kind", [0, 1])
def test_smooth_signals_have_fourth_order(gap, kind):
    coarse, fine = (grids(m, gap)[kind] for m in (80, 320))
    errors = [abs(effort(t, signal(t)) - EFFORT) for t in (coarse, fine)]
    assert errors[0] < 1e-5
    assert errors[1] < errors[0] / 200  # 256 for the fourth order
    highest = -signal(3 * np.pi / 2)  # the derivative cos t - 0.6 sin 2 t is 0 there
    assert peak(fine, signal(fine)) == pytest.approx(highest, abs=2e-8)
