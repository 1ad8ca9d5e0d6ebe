"""Integrals of errors and controls: closed forms, the reference time, scaling."""

from math import exp

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctrlplan import metrics


def test_exponential_error():
    """Over 0 to 5, e^-t: 1 - e^-5, (1 - e^-10)/2 and 1 - 6 e^-5."""
    t = np.linspace(0, 5, 501)
    e = np.exp(-t)
    assert metrics.iae(t, e) == pytest.approx(1 - exp(-5), abs=1e-9)
    assert metrics.iae(t, -e) == pytest.approx(1 - exp(-5), abs=1e-9)
    assert metrics.ise(t, e) == pytest.approx((1 - exp(-10)) / 2, abs=1e-9)
    assert metrics.effort(t, e) == pytest.approx((1 - exp(-10)) / 2, abs=1e-9)
    assert metrics.itae(t, e) == pytest.approx(1 - 6 * exp(-5), abs=1e-9)


def test_itae_starts_at_the_reference_time():
    """On the error 1 from 2 to 6 s; before the start nothing counts."""
    t = np.linspace(2, 6, 9)
    one = np.ones(9)
    assert metrics.itae(t, one) == pytest.approx(8, rel=1e-14)
    assert metrics.itae(t, one, start=0) == pytest.approx(16, rel=1e-14)
    assert metrics.itae(t, one, start=3.2) == pytest.approx(2.8**2 / 2, rel=1e-14)
    assert metrics.itae(t, one, start=6) == 0.0
    assert metrics.itae(t, 4.6 - t, start=4.4) == pytest.approx(
        0.2**3 / 6 + (1.6**3 - 0.2**3) / 3 - 0.2 * (1.6**2 - 0.2**2) / 2, rel=1e-12
    )


def test_sums_over_axes_and_rows():
    t = np.linspace(0, 2, 21)
    jerks = np.array([t, 2 * t, 1 + 0 * t])
    assert metrics.jerk_cost(t, jerks) == pytest.approx(8 / 3 + 4 * 8 / 3 + 2, rel=1e-13)
    np.testing.assert_allclose(metrics.effort(t, jerks), [8 / 3, 32 / 3, 2], rtol=1e-13)
    assert metrics.effort(t, jerks).sum() == pytest.approx(metrics.jerk_cost(t, jerks), rel=1e-15)


def test_bang_bang_control_costs_its_height():
    """A switch from one limit to the other: the cubic through it would miss two thirds of an interval."""
    t = np.linspace(0, 2, 41)
    u = np.where(t < 1, 3.0, -3.0)
    assert metrics.effort(t, u) == pytest.approx(18, rel=1e-14)
    assert metrics.iae(t, u) == pytest.approx(6, rel=1e-14)
    assert metrics.total_variation(t, u) == 6.0


def test_squares_that_overflow_are_infinite():
    t = np.arange(6.0)
    big = np.full(6, 1e300)
    assert metrics.ise(t, big) == np.inf
    assert metrics.effort(t, -big) == np.inf
    assert metrics.iae(t, big) == pytest.approx(5e300, rel=1e-14)
    assert metrics.itae(t, big) == pytest.approx(12.5e300, rel=1e-14)


eighths = st.integers(-800, 800).map(lambda i: i / 8)
records = st.lists(eighths, min_size=2, max_size=30).map(np.array)
powers = st.integers(-20, 20).map(lambda i: 2.0**i)


@pytest.mark.slow
@given(records, powers, powers)
def test_integrals_scale_with_amplitude_and_time(e, a, pace):
    t = np.arange(e.size) / 4
    expected = {
        metrics.iae: a * pace,
        metrics.ise: a**2 * pace,
        metrics.itae: a * pace**2,
        metrics.effort: a**2 * pace,
        metrics.jerk_cost: a**2 * pace,
        metrics.peak: a,
        metrics.total_variation: a,
        metrics.path_length: a,
    }
    for metric, factor in expected.items():
        assert metric(pace * t, a * e) == factor * metric(t, e)
    held = metrics.saturation_time(t, e, -10, 25)
    assert metrics.saturation_time(pace * t, a * e, -10 * a, 25 * a) == pytest.approx(pace * held, rel=1e-12)


@pytest.mark.slow
@given(records, st.integers(-1000, 1000))
def test_integrals_do_not_mind_the_sign_or_the_date(e, delay):
    t = np.arange(e.size) / 4
    for metric in (metrics.iae, metrics.ise, metrics.itae, metrics.effort, metrics.peak, metrics.total_variation):
        value = metric(t, e)
        assert metric(t, -e) == pytest.approx(value, rel=1e-13)
        assert metric(t + delay, e) == pytest.approx(value, rel=1e-9, abs=1e-9)


@given(records)
def test_integrals_do_not_mind_the_direction_of_time(e):
    t = np.arange(e.size) / 4
    for metric in (metrics.iae, metrics.ise, metrics.peak, metrics.total_variation):
        assert metric(t, e[::-1]) == pytest.approx(metric(t, e), rel=1e-9, abs=1e-9)
    together = metrics.itae(t, e) + metrics.itae(t, e[::-1])
    assert together == pytest.approx(t[-1] * metrics.iae(t, e), rel=1e-9, abs=1e-9)


def test_absolute_integrals_of_several_signals_together():
    """A parabola with two zeros inside intervals, a signal of one sign, and one that has diverged."""
    t = np.linspace(0, 4, 801)
    a, b, since = 1.2345, 2.3456, 1.7777
    parabola, positive = (t - a) * (t - b), 1 + t**3
    found = metrics.iae(t, np.array([[parabola, positive], [-parabola, np.where(t > 3, np.inf, t)]]))

    def area(s):
        return s**3 / 3 - (a + b) * s**2 / 2 + a * b * s

    def moment(s, since=since):
        return s**4 / 4 - (a + b + since) * s**3 / 3 + (a * b + since * (a + b)) * s**2 / 2 - since * a * b * s

    whole = 2 * (area(a) - area(b)) + area(4)
    np.testing.assert_allclose(found, [[whole, 68], [whole, np.inf]], rtol=1e-13)
    found = metrics.itae(t, np.array([parabola, positive]), start=since)
    below = moment(since) + moment(4) - 2 * moment(b)
    above = (16 - since**2) / 2 - since * (4 - since) + (4**5 - since**5) / 5 - since * (4**4 - since**4) / 4
    np.testing.assert_allclose(found, [below, above], rtol=1e-13)
    early = -0.75
    found = metrics.itae(t, np.array([-parabola, positive]), start=early)
    whole = 2 * moment(a, early) - 2 * moment(b, early) + moment(4, early)
    np.testing.assert_allclose(found, [whole, 8 + 4**5 / 5 - early * 68], rtol=1e-13)
