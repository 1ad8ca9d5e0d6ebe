"""Settling, overshoot and lag: the paper's loop in closed form, the edges of the definitions, the symmetries."""

from math import acos, exp, pi, sqrt

import control as ct
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_table import GAINS, printed

from ctrlplan import metrics

# Step of k/(s^2 + s) in unity feedback: percent and seconds.
STEPS = [(gain, *printed(gain, "step")) for gain in GAINS]


def step(gain, t):
    """Return the response to a unit step, equation (1) with the gain."""
    w_n, xi = sqrt(gain), 1 / (2 * sqrt(gain))
    w_p = w_n * sqrt(1 - xi**2)
    return 1 - w_n / w_p * np.exp(-xi * w_n * t) * np.sin(w_p * t + acos(xi))


@pytest.mark.parametrize(("gain", "percent", "seconds"), STEPS)
def test_step_of_the_linear_loop(gain, percent, seconds):
    t = np.linspace(0, 20, 20001)
    y = step(gain, t)
    assert f"{metrics.settling_time(t, y, 1, 0):.6g}" == f"{seconds:.6g}"
    assert f"{metrics.overshoot(t, y, 1, 0):.6g}" == f"{percent:.6g}"
    xi = 1 / (2 * sqrt(gain))
    # Cubics through samples h apart miss a peak by at most 3/128 h^4 times the fourth derivative, here about k^2.
    bound = 100 * 3 / 128 * 0.001**4 * gain**2 + 1e-11
    assert metrics.overshoot(t, y, 1, 0) == pytest.approx(100 * exp(-pi * xi / sqrt(1 - xi**2)), abs=bound)


@pytest.mark.parametrize(("gain", "percent", "seconds"), STEPS)
def test_change_downwards_and_elsewhere_is_the_same(gain, percent, seconds):
    t = np.linspace(0, 20, 20001)
    y = 7 - 3 * step(gain, t)
    assert metrics.settling_time(t + 5, y, 4, 7) == pytest.approx(seconds, rel=1e-5)
    assert metrics.overshoot(t + 5, y, 4, 7) == pytest.approx(percent, rel=1e-5)
    assert metrics.lag(t + 5, y, 4, 7) == pytest.approx(100, rel=1e-9)


def test_settling_counts_a_peak_between_samples():
    """Errors 0.021 - (t - 5.5)^2/100: every sample is inside 0.02, the peak is not; it ends at 5.5 + sqrt 0.1."""
    t = np.array([4.0, 5.0, 6.0, 7.0])
    e = 0.021 - (t - 5.5) ** 2 / 100
    assert np.abs(e).max() < 0.02
    assert metrics.settling_time(t, 1 + e, 1, 0) == pytest.approx(1.5 + sqrt(0.1), rel=1e-12)
    assert metrics.settling_time(t, 1 - e, 1, 0) == pytest.approx(1.5 + sqrt(0.1), rel=1e-12)
    assert metrics.settling_time(t, 1 + e, 1, 0, band=0.0211) == 0.0


def test_a_peak_after_the_last_sample_but_one_is_not_settled():
    """Errors 0.021 - (t - 6.5)^2/100: inside at every sample, outside between the last two."""
    t = np.array([4.6, 5.0, 6.0, 7.0])
    e = 0.021 - (t - 6.5) ** 2 / 100
    assert np.abs(e).max() < 0.02
    assert metrics.settling_time(t, 1 + e, 1, 0) == np.inf


def test_settling_counts_a_later_peak_between_samples():
    """Outside at a sample at t = 2, inside at all later ones, and outside once more between 9 and 10."""
    t = np.arange(14.0)
    e = np.maximum(0.021 - (t - 9.5) ** 2 / 100, -0.01)
    e[:3] = 1.0
    settled = metrics.settling_time(t, 1 + e, 1, 0)
    assert 9.5 < settled < 10


@pytest.mark.parametrize(
    ("y", "expected"),
    [
        ([0.0, 0.0, 0.0, 0.0, 0.0], np.inf),
        ([0.0, 0.0, 0.0, 0.0, 1.0], np.inf),
        ([1.0, 1.0, 1.0, 1.0, 0.0], np.inf),
        ([1.0, 1.0, 1.0, 1.0, 1.0], 0.0),
        ([1.02, 0.98, 1.02, 0.98, 1.0], 0.0),
        ([0.0, 1.0, np.inf, 1.0, 1.0], np.inf),
        ([0.0, 1.0, 1.0, -np.inf, -np.inf], np.inf),
    ],
)
def test_the_edges_of_settling(y, expected):
    t = np.arange(5.0)
    assert metrics.settling_time(t, y, 1, 0) == expected
    assert metrics.tracking_settling_time(t, y, np.ones(5), 1, 0) == expected


def test_the_entry_after_the_last_sample_but_one_counts_from_two_samples_on():
    t = np.arange(5.0)
    assert 2 < metrics.settling_time(t, [0.0, 0.0, 0.0, 1.0, 1.0], 1, 0) <= 3


def test_a_sample_on_the_edge_of_the_band_is_inside():
    """Coming from far away, where the rounding of the cubic's end is wider than the band's."""
    t = np.arange(7.0)
    for far, near in np.random.default_rng(3).uniform(1e5, 1e7, (200, 2)):
        assert 1 < metrics.settling_time(t, [far, near, 0.02, 0.01, 0, 0, 0], 0, 1) <= 2


def test_settling_is_elapsed_since_the_start():
    t = np.linspace(0, 10, 201)
    y = 1 - np.exp(-t)
    settled = np.log(50)
    assert metrics.settling_time(t, y, 1, 0, start=1.5) == pytest.approx(settled - 1.5, abs=1e-5)
    assert metrics.settling_time(t, y, 1, 0, start=-2) == pytest.approx(settled + 2, abs=1e-5)
    assert metrics.settling_time(t, y, 1, 0, start=9) == 0.0
    assert metrics.settling_time(t, np.ones(201), 1, 0, start=-2) == 0.0
    assert metrics.tracking_settling_time(t, y, np.ones(201), 1, 0, start=1.5) == pytest.approx(settled - 1.5, abs=1e-5)
    assert metrics.settling_time(t, y, 1, 0, band=exp(-1)) == pytest.approx(1, abs=1e-5)


def test_nothing_to_normalise_by_is_nan():
    t, y = np.arange(5.0), np.array([[0.0, 1, 1, 1, 1], [0, 1, 2, 1, 1], [0, 1, np.inf, 1, 1]])
    for metric in (metrics.settling_time, metrics.overshoot, metrics.lag):
        values = metric(t, y, [1, 1, 1], [0, 1, 1])
        np.testing.assert_array_equal(np.isnan(values), [False, True, True])
    assert np.isnan(metrics.tracking_settling_time(t, y[0], y[1], 1, 1))


def test_levels_broadcast_to_the_leading_axes():
    t = np.linspace(0, 10, 201)
    y = np.stack([[1 - np.exp(-t), 2 - 2 * np.exp(-t)], [1 - np.exp(-2 * t), 2 - 2 * np.exp(-2 * t)]])
    both = metrics.settling_time(t, y, [1, 2], 0)
    np.testing.assert_allclose(both, np.log(50) / np.array([[1, 1], [2, 2]]), atol=1e-5)
    tracked = metrics.tracking_settling_time(t, y, np.array([[1.0], [2.0]]), [1, 2], 0)
    np.testing.assert_allclose(tracked, both, rtol=1e-12)
    with pytest.raises(ValueError, match=r"^final must broadcast to shape \(2, 2\), got shape \(3,\)"):
        metrics.settling_time(t, y, [1, 2, 3], 0)
    with pytest.raises(ValueError, match=r"^initial must broadcast to shape \(2, 2\), got shape \(3,\)"):
        metrics.overshoot(t, y, 1, [0, 0, 0])
    with pytest.raises(ValueError, match=r"^reference must broadcast to shape \(2, 2, 201\), got shape \(200,\)"):
        metrics.lag(t, y, 1, 0, np.zeros(200))


def test_overshoot_on_the_error_is_against_the_reference():
    """A response 0.3 ahead of a ramp at t = 1, and 0.2 behind it at t = 3, both on parabolas."""
    t = np.linspace(0, 4, 9)
    error = np.where(t < 2, 0.3 * t * (2 - t), -0.2 * (t - 2) * (4 - t))
    assert metrics.overshoot(t, t + error, 5, 0, reference=t) == pytest.approx(6, rel=1e-12)
    assert metrics.lag(t, t + error, 5, 0, reference=t) == pytest.approx(4, rel=1e-12)
    assert metrics.overshoot(t, -t + error, -5, 0, reference=-t) == pytest.approx(4, rel=1e-12)
    assert metrics.overshoot(t, t + error, 5, 0) == 0.0


@pytest.mark.parametrize("late", [0, 30], ids=["from the first sample", "after a hold"])
@pytest.mark.parametrize(
    "poles",
    [
        (50.0, 50.0, 50.0),
        (10.0, 10.0, 10.0),
        (54.1, 157.4, 36.9),
        (9.54, 18.7, 222.7),
        (9.77, 13.1, 139.0),
        (100.0, 30.0),
    ],
    ids=lambda poles: ", ".join(f"{p:g}" for p in poles),
)
def test_no_lag_is_above_the_step_however_coarse_the_samples(poles, late):
    """The error of a step through lags falls from its first value, 100 %; spacing up to the time constants."""
    lags = ct.ss(ct.zpk([], [-p for p in poles], np.prod(poles)))
    y = ct.step_response(lags, np.arange(100) * 0.01).outputs
    t, y = np.arange(100 + late) * 0.01, np.concatenate([np.zeros(late), y])
    assert metrics.lag(t, y, 1, 0, reference=np.where(np.arange(t.size) < late, 0.0, 1.0)) == pytest.approx(
        100.0, abs=1e-9
    )


def test_divergence_overshoots_on_its_own_side():
    t, y = np.arange(5.0), np.array([0.0, 1.0, 2.0, np.inf, np.inf])
    assert metrics.overshoot(t, y, 1, 0) == np.inf
    assert metrics.lag(t, y, 1, 0) == 100.0
    assert metrics.overshoot(t, -y, 1, 0) == 0.0
    assert metrics.lag(t, -y, 1, 0) == np.inf


@pytest.mark.parametrize("band", [0, -0.02, np.inf, np.nan, [0.02, 0.05]])
def test_a_wrong_band_is_rejected(band):
    with pytest.raises(ValueError, match=r"^band must"):
        metrics.settling_time([0, 1, 2], [0, 1, 1], 1, 0, band=band)


@pytest.mark.parametrize("start", [2.5, np.inf, np.nan, [0.0, 1.0]])
def test_a_wrong_start_is_rejected(start):
    with pytest.raises(ValueError, match=r"^start must"):
        metrics.settling_time([0, 1, 2], [0, 1, 1], 1, 0, start=start)
    with pytest.raises(ValueError, match=r"^start must"):
        metrics.itae([0, 1, 2], [0, 1, 1], start=start)


eighths = st.integers(-800, 800).map(lambda i: i / 8)
records = st.lists(eighths, min_size=2, max_size=30).map(np.array)
powers = st.integers(-20, 20).map(lambda i: 2.0**i)


def every(t, y, final, initial, reference):
    """Return the settling times, then the percentages."""
    return (
        metrics.settling_time(t, y, final, initial, band=0.3),
        metrics.tracking_settling_time(t, y, reference, final, initial, band=0.3),
        metrics.overshoot(t, y, final, initial),
        metrics.overshoot(t, y, final, initial, reference),
        metrics.lag(t, y, final, initial),
        metrics.lag(t, y, final, initial, reference),
    )


@given(records, eighths, eighths, powers, powers)
def test_scaling_by_powers_of_two_is_exact(y, final, initial, amplitude, pace):
    t = np.arange(y.size) / 4
    first = every(t, y, final, initial, y[::-1])
    second = every(pace * t, amplitude * y, amplitude * final, amplitude * initial, amplitude * y[::-1])
    np.testing.assert_array_equal(second, [pace * first[0], pace * first[1], *first[2:]])


@given(records, eighths, eighths, st.integers(-1000, 1000), st.integers(-1000, 1000))
def test_levels_and_times_may_be_shifted(y, final, initial, level, delay):
    t = np.arange(y.size) / 4
    first = every(t, y, final, initial, y[::-1])
    second = every(t + delay, y + level, final + level, initial + level, y[::-1] + level)
    np.testing.assert_allclose(second, first, rtol=1e-9, atol=1e-9)


@given(records, eighths, eighths)
def test_a_change_of_sign_swaps_nothing_and_swapped_levels_swap_sides(y, final, initial):
    t = np.arange(y.size) / 4
    r = y[::-1]
    np.testing.assert_array_equal(every(t, -y, -final, -initial, -r), every(t, y, final, initial, r))
    ahead, behind = metrics.overshoot(t, y, final, initial, r), metrics.lag(t, y, final, initial, r)
    back = 2 * final - initial
    np.testing.assert_array_equal(metrics.lag(t, y, final, back, r), ahead)
    np.testing.assert_array_equal(metrics.overshoot(t, y, final, back, r), behind)


@given(st.floats(0.2, 5), st.floats(0.01, 100), st.floats(-10, 10), st.floats(0.05, 0.9))
def test_any_scale_and_shift_of_a_smooth_response(pace, amplitude, shift, damping):
    t = np.linspace(0, 40, 801)
    y = 1 - np.exp(-damping * t) * np.cos(t)
    first = every(t, y, 1, 0, np.sin(t))
    other = shift + amplitude * np.array([y, np.ones_like(t), np.sin(t)])
    second = every(t * pace + shift, other[0], shift + amplitude, shift, other[2])
    np.testing.assert_allclose(second, [pace * first[0], pace * first[1], *first[2:]], rtol=1e-6, atol=1e-6)


@given(records, eighths, eighths)
def test_settled_means_inside_at_every_later_sample(y, final, initial):
    t = np.arange(y.size) / 4
    settled = metrics.settling_time(t, y, final, initial, band=0.3)
    if final == initial:
        assert np.isnan(settled)
        return
    outside = np.abs(y - final) > 0.3 * abs(final - initial) * (1 + 1e-9)
    assert not outside[t > settled].any()
    if outside[-2:].any():
        assert settled == np.inf
    elif outside.any():
        assert settled > t[outside][-1]


@given(records, eighths, eighths)
def test_overshoot_and_lag_bound_every_sample(y, final, initial):
    t = np.arange(y.size) / 4
    ahead = metrics.overshoot(t, y, final, initial)
    behind = metrics.lag(t, y, final, initial)
    if final != initial:
        percent = 100 * np.sign(final - initial) * (y - final) / abs(final - initial)
        assert ahead >= max(percent.max(), 0) * (1 - 1e-12)
        assert behind >= max(-percent.min(), 0) * (1 - 1e-12)
