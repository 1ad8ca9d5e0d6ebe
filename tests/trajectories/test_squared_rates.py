"""Time laws by their squared rate: against its definition, quadrature, and motions in closed form."""

import math
from itertools import pairwise

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Retimed, Shaper, TimeLaw, Waypoint, trajectory_from_dict

EPS = np.finfo(float).eps


def smooth(seed, count=12, first=0.7, last=0.3):
    """Law with a continuous derivative of its squared rate."""
    rng = np.random.default_rng(seed)
    h, x = rng.uniform(0.1, 2.0, count), rng.uniform(0.05, 3.0, count)
    joints = (h[1:] * x[:-1] + h[:-1] * x[1:]) / (h[1:] + h[:-1])
    table = np.stack([np.append(first, joints), x, np.append(joints, last)])
    return TimeLaw(np.append(0.0, np.cumsum(h)) - 2.0, table, start=3.0)


def squared_rate(law, cell, u):
    """Bernstein polynomial of a cell."""
    first, middle, last = law.squared_rates[:, cell]
    return first * (1 - u) ** 2 + 2 * middle * u * (1 - u) + last * u**2


LAWS = {
    "smooth": smooth(1),
    "from rest": smooth(2, first=0.0),
    "to rest": smooth(3, last=0.0),
    "of steep cells": TimeLaw([0.0, 1.0, 2.0], [[1e4, 1e-3], [1.0, 1e-4], [1e-3, 9e3]]),
    "of one cell, from rest to rest": TimeLaw([0.0, 2.0], [[0.0], [3.0], [0.0]]),
    "at constant rate": TimeLaw([0.0, 2.0], [[4.0], [4.0], [4.0]]),
}
every = pytest.mark.parametrize("name", LAWS)


@every
def test_the_squared_rate_is_that_of_the_position(name):
    law = LAWS[name]
    for cell, (left, right) in enumerate(pairwise(law.breakpoints)):
        s = np.linspace(0.0, right - left, 41)
        jet = law.segment_jet(cell, s, 1)[:, 0]
        u = (jet[0] - law.positions[cell]) / np.diff(law.positions)[cell]
        assert (np.diff(u) > 0.0).all()
        scale = law.squared_rates[:, cell].max()
        np.testing.assert_allclose(jet[1] ** 2, squared_rate(law, cell, u), rtol=0, atol=1e-11 * scale)
        assert abs(u[-1] - 1.0) < 1e-11


@every
def test_the_duration_of_a_cell_is_an_integral(name):
    law = LAWS[name]
    for cell, duration in list(enumerate(np.diff(law.breakpoints)))[::4]:
        length = float(np.diff(law.positions)[cell])
        first, middle, last = map(mpmath.mpf, law.squared_rates[:, cell].tolist())
        # u = sin^2(w) removes the singularities at ends at rest.
        exact = mpmath.quad(
            lambda w, c=(first, middle, last): (
                mpmath.sin(2 * w)
                / mpmath.sqrt(c[0] * mpmath.cos(w) ** 4 + c[1] * mpmath.sin(2 * w) ** 2 / 2 + c[2] * mpmath.sin(w) ** 4)
            ),
            mpmath.linspace(0, mpmath.pi / 2, 9),
        )
        assert duration == pytest.approx(length * float(exact), rel=1e-12)


@every
@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_derivatives_are_those_of_the_one_below(name, order):
    """Against the derivative of a Chebyshev interpolant in a tenth of each cell."""
    law = LAWS[name]
    for cell, duration in enumerate(np.diff(law.breakpoints)):
        half = 0.05 * duration
        nodes = np.polynomial.chebyshev.chebpts1(20)
        below = law.segment_jet(cell, 0.5 * duration + half * nodes, order - 1)[-1, 0]
        series = np.polynomial.chebyshev.chebfit(nodes, below, 19)
        expected = np.polynomial.chebyshev.chebval(0.0, np.polynomial.chebyshev.chebder(series)) / half
        found = law.segment_jet(cell, np.array([0.5 * duration]), order)[-1, 0, 0]
        assert found == pytest.approx(expected, rel=1e-7, abs=1e-9 * np.abs(below).max() / half)


def test_position_rate_and_its_derivative_are_continuous():
    law = LAWS["smooth"]
    inner = law.breakpoints[1:-1]
    np.testing.assert_allclose(law.jet(inner, 2), law.jet(inner, 2, left=True), rtol=0, atol=1e-12)
    assert law.jumps(0) == ()


def test_times_of_positions_are_the_inverse():
    law = LAWS["from rest"]
    t = np.linspace(law.start, law.end, 501)[1:]
    np.testing.assert_allclose(law.moments(law(t)), t, rtol=1e-13)
    np.testing.assert_array_equal(law.moments(law.positions), law.breakpoints)


def test_constant_acceleration_in_closed_form():
    law = TimeLaw([0.0, 1.0, 3.0], [[0.0, 4.0], [2.0, 4.0], [4.0, 4.0]])
    np.testing.assert_array_equal(law.breakpoints, [0.0, 1.0, 2.0])
    t = np.linspace(0.0, 1.0, 11)
    np.testing.assert_allclose(law.jet(t, 2)[:2, 0], [t**2, 2 * t], rtol=1e-15, atol=1e-15)
    assert law([-1.0, 5.0]).tolist() == [0.0, 3.0]


@every
@pytest.mark.parametrize("nu", [0, 1, 2, 3])
def test_extrema_are_not_below_samples_and_are_attained(name, nu):
    law = LAWS[name]
    found, t = law.extrema(nu), np.linspace(law.start, law.end, 40_001)
    samples = np.concatenate([law(t, nu), law.jet(law.breakpoints[1:], nu, left=True)[nu, 0]])
    scale = np.abs(samples).max()
    assert found.maximum[0] >= samples.max() - 1e-13 * scale
    assert found.minimum[0] <= samples.min() + 1e-13 * scale
    for value, time in ((found.maximum[0], found.time_max[0]), (found.minimum[0], found.time_min[0])):
        attained = [law.jet(time, nu, left=left)[nu, 0] for left in (True, False)]
        assert min(abs(np.array(attained) - value)) <= 1e-12 * scale


@examples(20)
@given(rate=st.floats(1e-3, 1e3), start=st.floats(-1e3, 1e3))
def test_at_other_times_it_is_the_same(rate, start):
    law = LAWS["smooth"]
    moved = law.retime(law.duration / rate).shift(start)
    assert moved.duration == pytest.approx(law.duration / rate, rel=1e-12, abs=64 * EPS * abs(start))
    t = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(
        moved(moved.start + t * moved.duration), law(law.start + t * law.duration), atol=1e-12 * (1 + rate * abs(start))
    )
    for nu in (1, 2):
        assert moved.peak(nu) == pytest.approx(law.peak(nu) * rate**nu, rel=1e-10)


def test_extrema_that_are_known_are_kept_at_other_times():
    plan = Retimed(
        PolySpline([Waypoint(-2.0, 0, 0, 0), Waypoint(LAWS["smooth"].positions[-1], 1, 0, 0)]), LAWS["smooth"]
    )
    known = plan.extrema(2)
    moved = plan.retime(0.5 * plan.duration).shift(7.0)
    fresh = trajectory_from_dict(moved.to_dict()).extrema(2)
    for name in ("minimum", "maximum", "time_min", "time_max"):
        np.testing.assert_allclose(getattr(moved.extrema(2), name), getattr(fresh, name), rtol=1e-8)
    np.testing.assert_allclose(moved.extrema(2).maximum, 4.0 * known.maximum, rtol=1e-12)


@every
def test_round_trip(name, tmp_path):
    law = LAWS[name]
    again = trajectory_from_dict(law.to_dict())
    t = np.linspace(law.start - 1.0, law.end + 1.0, 99)
    np.testing.assert_array_equal(again.jet(t, 3), law.jet(t, 3))
    law.save(tmp_path / "law.json")
    np.testing.assert_array_equal(cp.load_trajectory(tmp_path / "law.json").breakpoints, law.breakpoints)


def test_a_plan_with_the_law_is_the_composition_of_both():
    path = PiecewiseSpline([Waypoint(t, [math.sin(t), t]) for t in np.linspace(-2.0, 9.0, 7)], warn=False)
    law = smooth(5, 30)
    law = TimeLaw(np.interp(law.positions, law.positions[[0, -1]], [-2.0, 9.0]), law.squared_rates, 1.0)
    plan = Retimed(path, law)
    t = np.random.default_rng(1).uniform(plan.start, plan.end, 400)
    inner, outer = law.jet(t, 2)[:, 0], path.jet(law(t), 2)
    expected = [outer[0], outer[1] * inner[1], outer[2] * inner[1] ** 2 + outer[1] * inner[2]]
    np.testing.assert_allclose(plan.jet(t, 2), expected, rtol=0, atol=1e-11 * np.abs(expected[2]).max())
    # Many times together, and each for itself.
    single = np.stack([plan.jet(moment, 2) for moment in t[:20]], axis=-1)
    np.testing.assert_allclose(plan.jet(t[:20], 2), single, rtol=0, atol=1e-13 * np.abs(single).max())
    outside = plan.jet([plan.start - 1.0, plan.end + 1.0], 1)
    np.testing.assert_allclose(outside[0].T, [path.initial, path.final], atol=1e-12)
    assert not outside[1].any()


LAW_OF_A_PATH = TimeLaw(np.linspace(0.0, 2.0, 25), np.random.default_rng(3).uniform(0.5, 1.0, (3, 24)), 1.0)
ON_A_PATH = Retimed(PiecewiseSpline([Waypoint(t, [math.sin(t), t]) for t in (0.0, 0.7, 1.1, 2.0)]), LAW_OF_A_PATH)
COMBINED = {
    "sum": ON_A_PATH + ON_A_PATH.shift(0.3),
    "scaled": -2.0 * ON_A_PATH,
    "selected": ON_A_PATH.select(["y2"]),
    "stacked": cp.stack(
        [ON_A_PATH, PolySpline([Waypoint(0.5, 0, 0, 0), Waypoint(2.5, 1, 0, 0)])], labels=["a", "b", "c"]
    ),
    "joined": PolySpline([Waypoint(0, [3, 1]), Waypoint(1, [0, 0])]).then(ON_A_PATH),
    "clipped": cp.Clipped(ON_A_PATH, 1.3, 2.2),
}


@pytest.mark.parametrize("name", COMBINED)
def test_combinations_are_evaluated_as_each_segment(name):
    plan = COMBINED[name]
    segments = np.random.default_rng(1).permutation(np.repeat(np.arange(plan.breakpoints.size - 1), 3))
    s = np.random.default_rng(2).random(segments.size) * np.diff(plan.breakpoints)[segments]
    single = [plan.segment_jet(segment, s[k : k + 1], 3)[:, :, 0] for k, segment in enumerate(segments.tolist())]
    expected = np.stack(single, axis=-1)
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(plan.segments_jet(segments, s, 3) / scale, expected / scale, rtol=0, atol=1e-12)
    t = np.linspace(plan.start, plan.end, 4001)[:-1]
    for nu in (0, 1, 2):
        found, samples = plan.extrema(nu), plan.jet(t, nu)[nu]
        scale = np.abs(samples).max()
        assert (found.maximum >= samples.max(axis=1) - 1e-12 * scale).all()
        assert (found.minimum <= samples.min(axis=1) + 1e-12 * scale).all()
        assert (found.maximum <= samples.max(axis=1) + 0.02 * scale).all()


def test_a_shaped_plan_keeps_the_rate_one():
    shaped = Shaper.zv(5.0)(PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]))
    assert Retimed(shaped, TimeLaw([0.0, shaped.end], [[1.0], [1.0], [1.0]])).duration == pytest.approx(shaped.duration)
    with pytest.raises(ValueError, match="law must have the rate 1 where the plan is shaped"):
        Retimed(shaped, TimeLaw([0.0, shaped.end], [[1.0], [2.0], [1.0]]))


@pytest.mark.parametrize(
    ("positions", "rates", "message"),
    [
        ([0.0, 0.0], [[1], [1], [1]], "positions must be two or more finite numbers that increase strictly"),
        ([0.0], np.ones((3, 0)), "positions must be two or more"),
        ([0.0, np.nan], [[1], [1], [1]], "positions must be two or more"),
        (
            [0.0, 1.0],
            [[1, 1], [1, 1], [1, 1]],
            r"squared_rates must be finite numbers of shape \(3, 1\), got shape \(3, 2\)",
        ),
        ([0.0, 1.0], [[1], [np.inf], [1]], "squared_rates must be finite"),
        ([0.0, 1.0], [[-1], [1], [1]], r"squared_rates must be at least 0 at the ends .* got \[-1.0, 1.0, 1.0\]"),
        ([0.0, 1.0], [[0], [0], [0]], "squared_rates must be at least 0 at the ends"),
        ([0.0, 1.0, 2.0], [[1, 1], [1, -1], [1, 1]], "in the cell from 1"),
        ([0.0, 1e-30], [[1], [1], [1]], "durations of the cells must be above the resolution of times"),
    ],
)
def test_errors(positions, rates, message):
    with pytest.raises(ValueError, match=message):
        TimeLaw(positions, rates, 1.0)


def test_the_middle_coefficient_may_be_negative():
    law = TimeLaw([0.0, 1.0], [[1.0], [-0.5], [1.0]])
    assert law.extrema(1).minimum[0] == pytest.approx(0.5, rel=1e-12)  # b = 1/4 at the middle
