"""Peak, total variation and time at the limits of a control."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctrlplan import metrics


def test_peak_between_samples():
    t = np.arange(0, 8, 0.25)
    assert metrics.peak(t, 3 - (t - 4.1) ** 2 / 8) == pytest.approx(3, rel=1e-14)
    assert metrics.peak(t, (t - 4.1) ** 2 / 8 - 3) == pytest.approx(3, rel=1e-14)


def test_the_highest_of_two_peaks_need_not_have_the_highest_sample():
    """Peaks of 1 at t = 3 on a sample, and of 1.01 between samples, seen at 1.01 - 1/64."""
    t = np.arange(0, 12, 0.25)
    u = np.maximum(0, np.maximum(1 - (t - 3) ** 2, 1.01 - (t - 8.125) ** 2))
    assert u.max() == 1.0
    assert metrics.peak(t, u) == pytest.approx(1.01, rel=1e-13)


def test_peak_of_a_fresh_kick_is_the_sample():
    t = np.linspace(0, 1, 101)
    assert metrics.peak(t, 50 * np.exp(-3 * t)) == 50.0
    u = np.where(t < 0.5, 0.0, 50 * np.exp(-3 * (t - 0.5)))
    assert metrics.peak(t, u) == pytest.approx(u.max(), rel=1e-15)


@pytest.mark.parametrize("count", [15, 40, 101, 1000])
def test_a_clipped_ramp_is_at_its_limits_for_the_exact_time(count):
    """From -5 to 5 V at 1 V/s, limits -2 and 3: 3 s below and 2 s above."""
    t = np.linspace(0, 10, count)
    u = np.clip(t - 5, -2, 3)
    assert metrics.saturation_time(t, u, -2, 3) == pytest.approx(5, rel=1e-12)
    assert metrics.saturation_time(t, u, -np.inf, 3) == pytest.approx(2, rel=1e-12)
    assert metrics.saturation_time(t, u, -2, np.inf) == pytest.approx(3, rel=1e-12)
    assert metrics.saturation_time(t, u, -np.inf, np.inf) == 0.0
    assert metrics.saturation_time(t, -u, -3, 2) == pytest.approx(5, rel=1e-12)
    assert metrics.saturation_time(t, t - 5, -2, 3) == pytest.approx(5, rel=1e-12)
    assert metrics.saturation_time(t, u, -2.1, 3.1) == 0.0


def test_a_jump_to_a_limit_belongs_to_the_sample_that_follows():
    t = np.arange(10.0)
    u = np.array([0.0, 0, 0, 2, 2, 2, 2, 0, 0, 0])
    assert metrics.saturation_time(t, u, -2, 2) == 4.0
    assert metrics.saturation_time(t, -u, -2, 2) == 4.0
    assert metrics.saturation_time(t, np.full(10, 2.0), -2, 2) == 9.0
    assert metrics.saturation_time(t, np.where(t < 4, -2.0, 2.0), -2, 2) == 9.0


def test_nearly_at_the_limit_is_at_the_limit():
    t = np.arange(10.0)
    assert metrics.saturation_time(t, np.full(10, 2 - 1e-12), -2, 2) == 9.0
    assert metrics.saturation_time(t, np.full(10, 2 - 1e-6), -2, 2) == 0.0


def test_a_peak_between_samples_reaches_the_limit():
    """1 - (t - 4.5)^2 is above 0.9 for 2 sqrt 0.1, between two samples."""
    t = np.arange(3.0, 7.0)
    assert metrics.saturation_time(t, 1 - (t - 4.5) ** 2, -9, 0.9) == pytest.approx(2 * np.sqrt(0.1), rel=1e-12)


def test_each_channel_has_its_limits():
    t = np.linspace(0, 10, 201)
    u = np.stack([np.minimum(t, 4), np.minimum(t, 7)])
    np.testing.assert_allclose(metrics.saturation_time(t, u, -1, [4, 7]), [6, 3], rtol=1e-12)
    np.testing.assert_allclose(metrics.saturation_time(t, u, [-1, -np.inf], [np.inf, 7]), [0, 3], rtol=1e-12)


def test_a_diverged_control_is_beyond_its_limit():
    t = np.arange(8.0)
    u = np.array([0.0, 0, 0, 0, np.inf, np.inf, np.inf, np.inf])
    assert 3 <= metrics.saturation_time(t, u, -1, 1) <= 4
    assert 3 <= metrics.saturation_time(t, -u, -1, 1) <= 4


@pytest.mark.parametrize(("lower", "upper"), [(1, 1), (2, -2), (np.inf, np.inf), (0, [1, -1])])
def test_limits_in_the_wrong_order_are_rejected(lower, upper):
    with pytest.raises(ValueError, match=r"^lower must be below upper, got lower = "):
        metrics.saturation_time([0, 1, 2], np.zeros((2, 3)), lower, upper)


@given(st.lists(st.integers(-20, 20).map(float), min_size=2, max_size=40), st.integers(-19, -1), st.integers(1, 19))
def test_wider_limits_are_met_for_less_time(record, lower, upper):
    t, u = np.arange(len(record)) / 2, np.array(record)
    narrow = metrics.saturation_time(t, u, lower + 0.5, upper - 0.5)
    wide = metrics.saturation_time(t, u, lower - 0.5, upper + 0.5)
    assert 0 <= wide <= narrow + 1e-12 <= t[-1] + 2e-12


@given(st.floats(0.2, 3), st.floats(0.2, 3), st.floats(-1, 1))
def test_total_variation_of_a_triangle_wave(rise, fall, level):
    """Corners on samples: the samples tell all."""
    t = np.cumsum(np.repeat(np.tile([rise, fall], 5), 4))
    u = level + np.tile([0.25, 0.5, 0.75, 1, 0.75, 0.5, 0.25, 0], 5)
    assert metrics.total_variation(t, u) == pytest.approx(0.75 + 4 * 2 + 1, rel=1e-12)
