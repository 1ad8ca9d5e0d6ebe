"""What metrics take a signal for between its samples: exact where it can be, sane where it cannot."""

import threading
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import trapezoid

from ctrlplan import metrics
from ctrlplan.metrics._evaluation import Evaluation
from ctrlplan.metrics._grid import Grid
from ctrlplan.metrics._pieces import cubics, cubics_of_rows

UNEVEN = np.array([-1.0, -0.7, 0.1, 0.3, 0.9, 1.0, 1.8, 2.5])


def held(p, s):
    """Return the values at s with each jump in the middle of its interval, as in the trapezoidal rule."""
    return np.where(p.jump, np.where(s < 0.5, p.a, p.end), p(s))


def maxima(t, f):
    evaluation = Evaluation(t)
    return evaluation.maxima(evaluation.add(f, "f"), np.ones(len(f)))()


@pytest.mark.parametrize("count", [4, 5, 6, 8])
def test_a_cubic_is_exact_on_uneven_samples(count):
    """x^3 - x over the first samples: turns at -+1/sqrt 3, roots at -1, 0, 1."""
    t = UNEVEN[:count]
    end = t[-1]
    turn = 1 / np.sqrt(3)
    knots = np.array([-1, -turn, *([turn] if end > turn else []), end])
    cubic = knots**3 - knots
    assert metrics.total_variation(t, t**3 - t) == pytest.approx(np.abs(np.diff(cubic)).sum(), rel=1e-13)
    assert metrics.peak(t, t**3 - t) == pytest.approx(np.abs(cubic).max(), rel=1e-13)
    roots = np.array([-1, 0, *([1] if end > 1 else []), end])
    primitive = roots**4 / 4 - roots**2 / 2
    assert metrics.iae(t, t**3 - t) == pytest.approx(np.abs(np.diff(primitive)).sum(), rel=1e-13)
    square = np.polynomial.Polynomial([0, -1, 0, 1]) ** 2
    assert metrics.ise(t, t**3 - t) == pytest.approx(square.integ()(end) - square.integ()(-1), rel=1e-13)


def test_minimum_jerk_has_its_constants():
    """The quintic of unit way and time: acceleration up to 10/sqrt 3, integral of the squared jerk 720."""
    t = np.linspace(0, 1, 12)
    acceleration = 60 * t - 180 * t**2 + 120 * t**3
    assert metrics.peak(t, acceleration) == pytest.approx(10 / np.sqrt(3), rel=1e-14)
    assert metrics.total_variation(t, acceleration) == pytest.approx(40 / np.sqrt(3), rel=1e-14)
    assert metrics.iae(t, acceleration) == pytest.approx(2 * 15 / 8, rel=1e-14)
    assert metrics.jerk_cost(t, 60 - 360 * t + 360 * t**2) == pytest.approx(720, rel=1e-14)


def test_three_samples_are_a_parabola_and_two_a_line():
    assert metrics.peak([0, 1, 2], [0.0, 3.0, 2.0]) == pytest.approx(3.125, rel=1e-15)
    assert metrics.ise([0, 1, 3], [0.0, 1.0, 9.0]) == pytest.approx(3**5 / 5, rel=1e-14)
    assert metrics.ise([0, 2], [0.0, 2.0]) == pytest.approx(8 / 3, rel=1e-15)
    assert metrics.iae([0, 4], [-1.0, 3.0]) == pytest.approx(5.0, rel=1e-15)
    assert metrics.settling_time([0, 1], [0.0, 1.0], 1, 0) == np.inf


@pytest.mark.parametrize("at", range(1, 20))
def test_a_jump_costs_what_the_samples_say(at):
    """No oscillation next to the jump; the integrals are those of the trapezoidal rule."""
    t = np.arange(20.0)
    y = np.where(t >= at, 3.0, -1.0)
    assert metrics.total_variation(t, y) == 4.0
    assert metrics.peak(t, y) == 3.0
    assert metrics.overshoot(t, y, 3, -1) == 0.0
    assert metrics.lag(t, y, 3, -1) == 100.0
    assert metrics.iae(t, y) == pytest.approx(trapezoid(np.abs(y), t), rel=1e-14)
    assert metrics.ise(t, y) == pytest.approx(trapezoid(y**2, t), rel=1e-14)
    assert metrics.path_length(t, [y, -y]) == pytest.approx(4 * np.sqrt(2), rel=1e-14)
    settled = metrics.settling_time(t, y, 3, -1)
    assert at - 1 < settled <= at if at < 19 else settled == np.inf


def test_a_jump_between_smooth_parts_spoils_neither():
    """A control that kicks at t = 5 and decays: jump interval apart, fourth order on either side."""
    t = np.linspace(0, 10, 1001)
    u = np.where(t < 5, np.sin(t), 4 * np.exp(-(t - 5)))
    last = np.sin(4.99)
    smooth = 2 + (1 + np.cos(4.99)) + 4 * (1 - np.exp(-5))
    assert metrics.iae(t, u) == pytest.approx(smooth + 0.01 * (4 + abs(last)) / 2, abs=2e-8)
    assert metrics.peak(t, u) == 4.0
    swings = 1 + 2 + (1 + last) + (4 - last) + 4 * (1 - np.exp(-5))
    assert metrics.total_variation(t, u) == pytest.approx(swings, abs=2e-8)


@pytest.mark.parametrize("shift", np.linspace(0, 1, 11))
def test_a_kink_is_not_passed(shift):
    """A ramp that ends in a hold, whatever the place of the corner between two samples."""
    t = np.arange(15.0)
    y = np.minimum(t, 7 + shift)
    assert metrics.peak(t, y) == pytest.approx(7 + shift, rel=1e-15)
    assert metrics.total_variation(t, y) == pytest.approx(7 + shift, rel=1e-15)
    area = (7 + shift) ** 2 / 2 + (7 + shift) * (7 - shift)
    sampled = trapezoid(y, t)
    assert abs(metrics.iae(t, y) - area) <= abs(sampled - area) + 1e-12


@pytest.mark.parametrize("shift", np.linspace(0, 1, 21))
def test_a_ramp_out_of_a_slow_curve_does_not_bend_it(shift):
    """Monotone on both sides of a corner between two samples, so that the way is the rise."""
    t = np.arange(15.0)
    y = 1e-6 * t**3 + 10 * np.maximum(t - 6 - shift, 0)
    assert metrics.total_variation(t, y) == pytest.approx(y[-1], rel=1e-12)


@pytest.mark.parametrize("shift", np.linspace(0, 1, 21))
@pytest.mark.parametrize("held", [1, 2, 3])
def test_a_hold_at_either_end_of_a_record_stays_a_hold(held, shift):
    t = np.arange(15.0)
    y = np.maximum(t - held - shift, 0)
    assert metrics.total_variation(t, y) == pytest.approx(y[-1], rel=1e-12)
    assert metrics.total_variation(t, y[::-1]) == pytest.approx(y[-1], rel=1e-12)


@pytest.mark.parametrize("amplitude", [1.1, 1.5, 2.0, 3.0])
def test_a_clipped_sine_stays_at_its_limit(amplitude):
    t = np.linspace(0.3, 20, 400)
    u = np.clip(amplitude * np.sin(t), -1, 1)
    assert 1.0 <= metrics.peak(t, u) <= 1.001


values = st.integers(-1000, 1000).map(lambda i: i / 8)
records = st.lists(values, min_size=2, max_size=30)
steps = st.lists(st.integers(1, 16).map(lambda i: i / 16), min_size=29, max_size=29)


@given(records, steps)
def test_any_record_stays_within_sane_bounds(record, spacing):
    t, f = np.cumsum(spacing)[: len(record) - 1], np.array(record)
    t = np.concatenate([[0.0], t])
    top, duration = np.abs(f).max(), t[-1]
    peak, variation = metrics.peak(t, f), metrics.total_variation(t, f)
    tiny = 1e-12 * (1 + top)
    assert top <= peak
    assert peak <= np.abs(f[[0, -1]]).max() + variation + tiny
    assert variation >= np.abs(np.diff(f)).sum() - len(f) * tiny
    iae, ise = metrics.iae(t, f), metrics.ise(t, f)
    assert iae <= duration * peak + tiny * (1 + duration)
    assert ise <= duration * peak**2 * (1 + 1e-12) + tiny
    assert iae**2 <= duration * ise * (1 + 1e-12) + tiny
    assert 0 <= metrics.itae(t, f) <= duration * iae * (1 + 1e-12) + tiny
    assert metrics.path_length(t, f) == pytest.approx(variation, rel=1e-9, abs=1e-9)
    assert 0 <= metrics.saturation_time(t, f, -10, 20) <= duration + 1e-12


@given(st.lists(st.integers(-100, 100), min_size=1, max_size=8), st.integers(3, 6))
def test_any_staircase_is_what_its_samples_say(levels, width):
    f = np.repeat(np.array(levels, dtype=float), width)
    t = np.arange(f.size) / 4
    assert metrics.peak(t, f) == np.abs(f).max()
    assert metrics.total_variation(t, f) == pytest.approx(np.abs(np.diff(f)).sum(), rel=1e-14)
    assert metrics.iae(t, f) == pytest.approx(trapezoid(np.abs(f), t), rel=1e-13)
    assert metrics.effort(t, f) == pytest.approx(trapezoid(f**2, t), rel=1e-13)


@pytest.mark.parametrize("count", [2, 3, 50, 700])
def test_metrics_that_are_evaluated_together_are_those_alone(count):
    """Of several signals and one of them, in any order: to the bit."""
    t = np.linspace(0.0, 3.0, count)
    rows = np.array([np.sin(3.0 * t), np.cos(2.0 * t) - 0.3, np.where(t > 1.0, 1.0, -0.5)])
    signals, edges, sides = (2.0 * rows, rows[:1]), np.array([0.1, 0.4, 2.0]), np.array([1.0, -1.0, 0.0])

    def wanted(evaluation, f):
        own, n = evaluation.add(f, "f"), len(f)
        found = [evaluation.entries(own, edges[:n]), evaluation.maxima(own, sides[:n]), evaluation.areas(own)]
        return [*found, evaluation.maxima(own, -sides[:n], extrapolated=False), evaluation.squares(own)]

    evaluation = Evaluation(t)
    together = [one for f in signals for one in wanted(evaluation, f)]
    alone = [one() for f in signals for k in range(5) for one in [wanted(Evaluation(t), f)[k]]]
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one(), other)
    second = Evaluation(t)
    own = second.add(signals[0][1:2], "f")
    found = second.entries(own, edges[1:2]), second.maxima(own, sides[1:2]), second.areas(own), second.squares(own)
    for one, other in zip(found, (*alone[:3], alone[4]), strict=True):
        np.testing.assert_array_equal(one(), other[..., 1:2])


def test_sample_times_of_one_length_are_not_confused():
    """In one thread, and in several together that use more times than are kept; an array whose values change."""
    f = np.sin(np.linspace(0.0, 3.0, 700))
    scales = [1.0 + k / 8 for k in range(12)]
    expected = [metrics.iae(np.linspace(0.0, 1.0, 700), f) * scale for scale in scales]
    found = {}

    def measure(begin):
        for _ in range(5):
            for k in range(begin, 12, 3):
                found.setdefault(k, []).append(metrics.iae(np.linspace(0.0, scales[k], 700), f))

    threads = [threading.Thread(target=measure, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, values in found.items():
        assert values == [pytest.approx(expected[k], rel=1e-13)] * 5
    t = np.linspace(0.0, 1.0, 700)
    metrics.iae(t, f)
    t *= 2.0
    assert metrics.iae(t, f) == pytest.approx(2.0 * expected[0], rel=1e-13)


@pytest.mark.parametrize("metric", [metrics.iae, metrics.itae, metrics.ise, metrics.peak])
@pytest.mark.parametrize("shift", [1e-9, 1e-3])
def test_a_sample_next_to_another_changes_little(metric, shift):
    """Even samples with three more close to others, as at the breakpoints of a plan: fourth order all the same."""
    t = np.linspace(0.0, 3.0, 801)
    more = np.sort(np.append(t, t[[1, 400, 798]] + shift))
    assert metric(more, np.sin(5.0 * more)) == pytest.approx(metric(t, np.sin(5.0 * t)), rel=2e-9)


SIGNALS = {
    "smooth": lambda t: np.exp(-0.3 * t) * np.cos(7.0 * t),
    "kinks and jumps": lambda t: (
        np.where(t < 1.0, np.abs(np.sin(5.0 * t)), np.maximum(np.cos(9.0 * t), -0.4)) - (t > 2.0)
    ),
    "noise": lambda t: np.random.default_rng(3).standard_normal(t.size),
    "far from zero": lambda t: 1e6 + np.sin(t),
}


@pytest.mark.parametrize("spread", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("kind", SIGNALS)
def test_integrals_and_peaks_of_long_signals_are_those_of_every_cubic(kind, spread):
    """Gauss-Legendre quadrature is exact for squares of cubics; no sample of a cubic exceeds the peak."""
    t = np.linspace(0.0, 3.0, 800)
    t[1:-1] += spread * t[1] * np.random.default_rng(1).uniform(-0.5, 0.5, 798)
    f = SIGNALS[kind](t)
    p, (nodes, weights) = cubics(t, f), np.polynomial.legendre.leggauss(4)
    expected = sum(
        weight / 2 * np.sum(p.step * held(p, (node + 1) / 2) ** 2) for node, weight in zip(nodes, weights, strict=True)
    )
    rounding = 64 * np.finfo(float).eps * np.sqrt(t.size)
    assert metrics.ise(t, f) == pytest.approx(expected, rel=rounding)
    fine = np.linspace(0.0, 1.0, 201)
    values = held(p, fine[:, None])
    for weighted, metric in ((False, metrics.iae), (True, metrics.itae)):
        size = np.abs(values) * (p.begin + fine[:, None] * p.step if weighted else 1.0)
        # The trapezoidal rule at a spacing h is exact to h^2 / 12 of the variation of the slope, and h / 2 at a jump.
        kinks = np.abs(np.diff(size, axis=0, prepend=size[:1], append=size[-1:], n=2)).sum(axis=0)
        expected = p.step @ trapezoid(size, fine, axis=0)
        assert metric(t, f) == pytest.approx(expected, rel=1e-12, abs=p.step @ kinks / 200)
    between = np.abs(p(fine[:, None])).max()
    bend = np.abs(p.c).max() + 3 * np.abs(p.d).max()
    assert between - 1e-14 * np.abs(f).max() <= metrics.peak(t, f) <= between + 0.5 * (0.5 / 200) ** 2 * 2 * bend


@pytest.mark.parametrize("spread", [0.0, 0.4, 1.0])
def test_cubics_of_some_intervals_are_those_of_whole_signals(spread):
    """In any order, of a few intervals of several signals or of all: to the bit."""
    t = np.linspace(0.0, 3.0, 800)
    t[1:-1] += spread * t[1] * np.random.default_rng(1).uniform(-0.5, 0.5, 798)
    f, rng = np.array([of(t) for of in SIGNALS.values()]), np.random.default_rng(2)
    rows, k = np.divmod(rng.permutation(len(f) * 799), 799)
    whole = [cubics(t, row) for row in f]
    for some in (slice(None), *(slice(begin, begin + 300) for begin in range(0, k.size, 300))):
        found = cubics_of_rows(Grid.of(t), f, rows[some], k[some])
        for field in fields(found):
            expected = np.array([getattr(p, field.name) for p in whole])[rows[some], k[some]]
            np.testing.assert_array_equal(getattr(found, field.name), expected, field.name)


@pytest.mark.parametrize("metric", [metrics.iae, metrics.itae, metrics.peak])
def test_long_signals_whose_differences_overflow_are_straight_lines_there(metric):
    """Slopes of 1e314: chords, which miss (spacing)^2 / 8 of the second derivative."""
    count, size = 800, 1e302
    t = np.linspace(0.0, 1e-12, count)
    turn = 2 * np.pi * t / t[-1]
    chord = (2 * np.pi / (count - 1)) ** 2 / 8
    assert metric(t, size * np.sin(turn)) / size == pytest.approx(metric(t, np.sin(turn)), rel=2 * chord)


@pytest.mark.parametrize("seed", range(8))
def test_extrema_by_stretches_are_those_of_all_cubics(seed):
    """Signals of many lengths, with jumps, noise and zeros: peaks, maxima and last entries from every cubic."""
    rng = np.random.default_rng(seed)
    for size in (2, 3, 4, 127, 128, 129, 131, 256, 385, 700):
        t = np.linspace(0.0, 9.0, size) if seed % 2 else np.cumsum(rng.uniform(0.01, 1.0, size))
        decay, pace, noise = rng.uniform(0.0, 1.0, (3, 4, 1))
        f = np.exp(-decay * t) * np.cos(8.0 * pace * t) + (t > t[size // 2]) * (noise > 0.5)
        f += 0.3 * (noise > 0.7) * rng.standard_normal(f.shape)
        f[0] *= seed % 3
        f[2:] += rng.choice([0.0, -7.0, 7.0], (2, 1))  # far from zero, as a torque about its bias
        edge = float(np.abs(f).max() * rng.uniform(0.01, 1.05))
        with np.errstate(divide="ignore", invalid="ignore"):
            curves = [cubics(t, row) for row in f]
            values = [np.append(p(p.cuts).ravel(), row) for p, row in zip(curves, f, strict=True)]
        np.testing.assert_allclose(metrics.peak(t, f), [np.nanmax(np.abs(v)) for v in values], rtol=1e-12)
        np.testing.assert_allclose(maxima(t, f), [np.nanmax(v) for v in values], rtol=1e-12, atol=1e-15)
        # The distance from 0 of a signal with the target 0, which starts at 1.
        entered = metrics.settling_time(t, f, 0.0, 1.0, band=edge, start=t[0])
        for found, p, row in zip(entered, curves, f, strict=True):
            s = np.linspace(0.0, 1.0, 201)[:, None]
            dense, times = np.abs(p(s)), p.time(s)
            dense[0], dense[-1] = np.abs(p.a), np.abs(p.end)
            outside = np.nonzero(dense > edge * (1.0 + 1e-12))
            if abs(row[-1]) > edge or (outside[1] == size - 2).any():
                assert found == np.inf
            elif outside[0].size:
                last = times[outside].max() - t[0]
                assert 0.0 <= found - last <= np.diff(t).max() / 199.0


@pytest.mark.parametrize("offset", [0.0, 7.0])
@pytest.mark.parametrize("place", [126, 127, 128, 300, 400])
def test_a_peak_between_samples_far_from_the_largest_sample(place, offset):
    """Two parabolas in 600 samples: 1.0 at a sample, and 1.03 halfway between two samples of 0.98."""
    t = np.arange(600.0)
    f = np.maximum(1.0 - 0.2 * (t - 550.0) ** 2, 1.03 - 0.2 * (t - place - 0.5) ** 2).clip(0.0) + offset
    assert f.max() == 1.0 + offset
    assert maxima(t, f[None]) == pytest.approx(1.03 + offset, rel=1e-14)
    assert metrics.peak(t, f) == pytest.approx(1.03 + offset, rel=1e-14)
