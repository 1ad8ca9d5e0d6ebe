"""The order of accuracy, measured: each metric against its closed form on ever finer samples of a smooth signal."""

from itertools import pairwise
from math import acos, atan2, cos, exp, floor, pi, sin, sqrt

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc

from ctrlplan import metrics

COUNTS = (81, 161, 321, 641)
STARTS = np.random.default_rng(5).uniform(0, 2 * pi, 40)
LENGTHS = np.random.default_rng(6).uniform(8, 12, 40)


def even(a, b, count):
    return np.linspace(a, b, count)


def uneven(a, b, count):
    """Return times whose spacing varies smoothly by a factor of four."""
    x = np.linspace(0, 1, count)
    return a + (b - a) * (x + 0.6 * np.sin(2 * pi * x) / (2 * pi))


def slope(errors):
    return np.log(errors[0] / errors[-1]) / np.log((COUNTS[-1] - 1) / (COUNTS[0] - 1))


def worst(metric, exact, grid):
    """Return, for each count of samples, the maximum error over many start times and durations."""
    spans = list(zip(STARTS, STARTS + LENGTHS, strict=True))
    return [max(abs(metric(grid(a, b, count)) - exact(a, b)) for a, b in spans) for count in COUNTS]


def area(x):
    """Return the integral of abs(sin) from 0."""
    turns = floor(x / pi)
    return 2 * turns + 1 - cos(x - turns * pi)


def moment(x):
    """Return the integral of t abs(sin t) from 0."""
    steps = [pi * k for k in range(floor(x / pi) + 1)] + [x]
    return sum(abs((sin(b) - b * cos(b)) - (sin(a) - a * cos(a))) for a, b in pairwise(steps))


def above(x):
    """Return the time from 0 to x during which abs(sin) >= 0.6."""
    low = np.arcsin(0.6)
    turns = floor(x / pi)
    return turns * (pi - 2 * low) + min(max(x - turns * pi - low, 0), pi - 2 * low)


BOX = [[0.0], [0.0]]
CASES = {
    "iae": (lambda t: metrics.iae(t, np.sin(t)), lambda a, b: area(b) - area(a)),
    "ise": (lambda t: metrics.ise(t, np.sin(t)), lambda a, b: (b - a) / 2 - (sin(2 * b) - sin(2 * a)) / 4),
    "itae": (
        lambda t: metrics.itae(t, np.sin(t)),
        lambda a, b: moment(b) - moment(a) - a * (area(b) - area(a)),
    ),
    "effort": (lambda t: metrics.effort(t, np.cos(t)), lambda a, b: (b - a) / 2 + (sin(2 * b) - sin(2 * a)) / 4),
    "jerk_cost": (lambda t: metrics.jerk_cost(t, [3 * np.cos(t), 3 * np.sin(t)]), lambda a, b: 9 * (b - a)),
    "peak": (lambda t: metrics.peak(t, np.cos(t)), lambda a, b: 1.0),
    "total_variation": (lambda t: metrics.total_variation(t, np.cos(t)), lambda a, b: area(b) - area(a)),
    "saturation_time": (
        lambda t: metrics.saturation_time(t, np.sin(t), -0.6, 0.6),
        lambda a, b: above(b) - above(a),
    ),
    "path_length": (
        lambda t: metrics.path_length(t, [2 * np.cos(t), np.sin(t)]),
        lambda a, b: 2 * (ellipeinc(b - pi / 2, 0.75) - ellipeinc(a - pi / 2, 0.75)),
    ),
    "there and back": (
        lambda t: metrics.path_length(t, [3 * np.cos(t), 4 * np.cos(t)]),
        lambda a, b: 5 * (area(b) - area(a)),
    ),
    "wandering": (
        lambda t: metrics.wandering(t, [np.cos(t), np.sin(t)], [[0, 3], [0, 4]]),
        lambda a, b: (b - a) / 5 - 1,
    ),
    "excess_variation": (
        lambda t: metrics.excess_variation(t, [np.cos(t), np.cos(t)], [[0, 1], [0, 0.5]]),
        lambda a, b: (2 * (area(b) - area(a)) - 1.5) / 1.5,
    ),
    "outside_box": (lambda t: metrics.outside_box(t, [2 * np.cos(t), np.sin(t)], BOX), lambda a, b: 2.0),
}


@pytest.mark.parametrize("grid", [even, uneven])
@pytest.mark.parametrize("name", CASES)
def test_integrals_and_peaks_are_of_fourth_order(name, grid):
    errors = worst(*CASES[name], grid)
    assert slope(errors) > 3.7
    assert errors[-1] < 1e-4


def test_a_quarter_of_an_ellipse():
    errors = []
    for count in COUNTS:
        t = np.linspace(0, pi / 2, count)
        errors.append(abs(metrics.path_length(t, [2 * np.cos(t), np.sin(t)]) - 2 * ellipe(0.75)))
    assert slope(errors) > 3.8
    assert errors[-1] < 1e-10


@pytest.mark.parametrize("grid", [even, uneven])
def test_settling_of_a_damped_oscillation_is_of_fourth_order(grid):
    """Error exp(-t/2) cos(3 t): its last crossing of 2 % lies after the last peak above, where tan(3 t) = -1/6."""

    def error(t):
        return np.exp(-t / 2) * np.cos(3 * t)

    peaks = (pi * np.arange(40) - atan2(1, 6)) / 3
    last = peaks[np.abs(error(peaks)) > 0.02][-1]
    exact = brentq(lambda t: abs(error(t)) - 0.02, last, last + pi / 6, xtol=1e-15)
    errors = []
    for count in COUNTS:
        spans = [grid(0.0, 10 + length, count) for length in LENGTHS]
        errors.append(max(abs(metrics.settling_time(t, 5 + 3 * error(t), 5, 8) - exact) for t in spans))
        tracking = [abs(metrics.tracking_settling_time(t, t + error(t), t, 1, 0) - exact) for t in spans]
        assert max(tracking) == pytest.approx(errors[-1], abs=1e-11)
    assert slope(errors) > 3.7
    assert errors[-1] < 1e-4


@pytest.mark.parametrize("grid", [even, uneven])
def test_overshoot_and_lag_of_a_damped_oscillation_are_of_fourth_order(grid):
    """1 - exp(-t/2) cos(3 t) peaks at tan(3 t) = -1/6: once above, and once below after t = 1.6."""
    first = (pi - atan2(1, 6)) / 3
    exact = 100 * exp(-first / 2) * -cos(3 * first)
    errors, below = [], []
    for count in COUNTS:
        spans = [grid(0.0, 10 + length, count) for length in LENGTHS]
        responses = [1 - np.exp(-t / 2) * np.cos(3 * t) for t in spans]
        errors.append(max(abs(metrics.overshoot(t, y, 1, 0) - exact) for t, y in zip(spans, responses, strict=True)))
        below.append(
            max(abs(metrics.lag(t, t - 1 + y, 0, 1, t) - exact) for t, y in zip(spans, responses, strict=True))
        )
    assert slope(errors) > 3.7
    assert slope(below) > 3.7
    assert max(errors[-1], below[-1]) < 2e-3


def test_arrival_at_a_limit_is_found_between_samples():
    """A clipped sine: the samples alone are wrong by up to a spacing at each of three corners."""
    exact = 2 * (pi - 2 * np.arcsin(2 / 3))
    errors = []
    for count in COUNTS:
        spans = [np.linspace(0, 2 * pi + 0.4 * x / 12, count) for x in LENGTHS]
        errors.append(max(abs(metrics.saturation_time(t, np.clip(3 * np.sin(t), -2, 2), -2, 2) - exact) for t in spans))
    assert slope(errors) > 2.7
    assert errors[-1] < 1e-5


@pytest.mark.parametrize("gain", [1.0, 5.0, 20.0])
def test_second_order_step_overshoot(gain):
    """Equation (1), corrected; the overshoot is 100 exp(-pi xi / sqrt(1 - xi^2))."""
    xi = 1 / (2 * sqrt(gain))
    damped = sqrt(gain) * sqrt(1 - xi**2)
    errors = []
    for count in COUNTS:
        t = np.linspace(0, 20 / sqrt(gain), count)
        y = 1 - sqrt(gain) / damped * np.exp(-xi * sqrt(gain) * t) * np.sin(damped * t + acos(xi))
        errors.append(abs(metrics.overshoot(t, y, 1, 0) - 100 * exp(-pi * xi / sqrt(1 - xi**2))))
    assert max(errors) < 5e-2
    assert errors[-1] < 2e-5
