"""Extrema of functions whose degree is below that of their plan: the last coefficients of the slope are rounding."""

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from ctrlplan import PiecewiseSpline, PolySpline, SCurve, Shaper, Trapezoid, Waypoint, fastest, fit, margins, stack
from ctrlplan.trajectories.chebyshev import roots_of_rows

MOVE = PolySpline([Waypoint(0.0, 0.0, 0.0), Waypoint(4.0, 1.0, 0.0)])  # 3 u^2 - 2 u^3
TOP = 4.341636953181356


def through(function, times, order, family=PiecewiseSpline):
    """Plan of a family through the jets of a polynomial."""
    jets = [[float(function.deriv(k)(t)) if k else float(function(t)) for k in range(order + 1)] for t in times]
    return family([Waypoint(t, *jet) for t, jet in zip(times, jets, strict=True)], warn=False)


def plans_of(function, end):
    """Plans of several families that are a polynomial of degree at most 3 from 0 to an end."""
    many, few = np.linspace(0.0, end, 14), [0.0, 0.4 * end, end]
    yield through(function, [0.0, end], 2)
    yield through(function, few, 1)
    yield through(function, few, 2, PolySpline)
    for continuity in (2, 4):
        yield fit(many, function(many), continuity=continuity, warn=False)
    yield stack([fit(many, function(many), warn=False), PolySpline([Waypoint(0.0, 0.0), Waypoint(end, 1.0)])])
    yield through(function, [0.0, end], 2) + PiecewiseSpline([Waypoint(0.0, 0.0), Waypoint(end, 0.0)])
    yield through(function, [0.0, end], 2).shift(1.7)
    plan = through(function, few, 2)
    plan.extrema()
    yield plan.retime(0.61 * end)


def assert_extrema(function, end, size):
    """Extrema of all plans of a polynomial are those at the roots of its slope and at the ends, by closed form."""
    roots = function.deriv().roots()
    inner = [t.real for t in roots if abs(t.imag) < 1e-12 and 0.0 < t.real < end]
    values = function(np.array([0.0, end, *inner]))
    for plan in plans_of(function, end):
        found = plan.extrema()
        assert abs(found.maximum[0] - values.max()) <= 1e-13 * size, plan
        assert abs(found.minimum[0] - values.min()) <= 1e-13 * size, plan
        samples = plan(np.linspace(plan.start, plan.end, 2001))[0]
        assert found.maximum[0] >= samples.max() - 1e-14 * size
        assert found.minimum[0] <= samples.min() + 1e-14 * size


@pytest.mark.parametrize("top", [TOP, np.pi, 10.0 / 3.0, 5.0314])
@pytest.mark.parametrize("offset", [0.0, 1.0, 1001.0, -1e5, 1e8])
def test_parabola_reaches_its_vertex(top, offset):
    function = Polynomial([offset - top**2 / 4.0, top / 2.0, -0.25])
    assert_extrema(function, 10.0, abs(offset) + 10.0)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-1.0, 1.0), st.floats(0.5, 8.0), st.floats(-1e6, 1e6))
def test_cubics(first, second, third, end, offset):
    function = Polynomial([offset, first, second, third])
    size = abs(offset) + abs(first) * end + abs(second) * end**2 + abs(third) * end**3
    assert_extrema(function, end, max(size, 1e-3))


def test_limit_above_the_samples_but_below_the_vertex_is_violated():
    function = Polynomial([1001.0 - TOP**2 / 4.0, TOP / 2.0, -0.25])
    plan = through(function, [0.0, 10.0], 2)
    assert not margins(plan, {"y": (900.0, 1000.99)}).satisfied
    assert plan.extrema().time_max[0] == pytest.approx(TOP, abs=1e-12)


@pytest.mark.parametrize(("count", "beyond"), [(32, 0.01), (72, 0.02), (15, 0.1), (50, 0.0)])
def test_limit_of_one_axis_of_a_stack(count, beyond):
    times = np.linspace(-beyond, 4.0 + beyond, count)
    plan = stack([fit(times, times**2, continuity=4, warn=False), MOVE], labels=["a", "b"])
    assert plan.peak(1)[1] == pytest.approx(0.375, rel=1e-14)
    found = fastest(plan, {"b_d1": 0.3})
    assert 0.375 * plan.duration / found.plan.duration == pytest.approx(0.3, rel=1e-13)
    assert found.margins.satisfied


@pytest.mark.parametrize("level", [0.0, 1e-20, 1e-17, 1e-15, 1.1e-15, 1e-13, 1e-10, 1e-6])
@pytest.mark.parametrize("size", [5, 9, 17, 33, 65])
def test_roots_with_last_coefficients_of_any_size(level, size):
    rng = np.random.default_rng(size)
    true = np.array([-0.93, -0.31, 0.123456789, 0.77])
    rows = np.zeros((20, size))
    rows[:, :5] = np.polynomial.chebyshev.chebfromroots(true)
    rows += level * np.abs(rows).max() * rng.uniform(-1.0, 1.0, rows.shape)
    rows *= 10.0 ** rng.uniform(-200.0, 200.0, (20, 1))
    which, roots = roots_of_rows(rows)
    with mp.workdps(40):
        for k, row in enumerate(rows):
            own = roots[which == k]
            for start in true:
                exact = root_near(row / np.abs(row).max(), start)
                assert np.abs(own - exact).min() <= 1e-13


def root_near(series, start):
    """Root of a Chebyshev series near a start, by Newton's method in many digits."""
    slope = np.polynomial.chebyshev.chebder(series)
    x = mp.mpf(start)
    for _ in range(8):
        x -= value_at(series, x) / value_at(slope, x)
    return float(x)


def value_at(series, x):
    """Value of a Chebyshev series, by Clenshaw's recurrence."""
    first = second = mp.mpf(0)
    for c in series[:0:-1]:
        first, second = 2 * x * first - second + mp.mpf(float(c)), first
    return x * first - second + mp.mpf(float(series[0]))


SHAPED = Shaper.zvd(2.1)(SCurve([3.0, -1.0], velocity=1.1, acceleration=0.7, jerk=0.9, labels=["x", "z"]))


@pytest.mark.parametrize("nu", range(5))
@pytest.mark.parametrize(
    "plan",
    [SHAPED, -0.3 * SHAPED.shift(2.0), SHAPED.then(Trapezoid([5.0, 1.0], [3.0, -1.0], velocity=1.0, acceleration=2.0))],
    ids=["sum", "scaled", "joined"],
)
def test_combinations_of_polynomials_by_the_roots_of_their_slopes(plan, nu):
    """Each segment as the polynomial through its derivatives in the middle, by numpy."""
    assert plan.polynomial_degree == 3
    values = [[], []]
    for start, end in zip(plan.breakpoints[:-1].tolist(), plan.breakpoints[1:].tolist(), strict=True):
        middle = 0.5 * (start + end)
        for axis, jet in enumerate(plan.jet(middle, 3).T):
            function = Polynomial(jet / [1.0, 1.0, 2.0, 6.0])
            function = function.deriv(nu) if nu else function
            roots = [r.real for r in function.deriv().roots() if abs(r.imag) < 1e-12]
            inside = [r for r in roots if abs(r) < 0.5 * (end - start)]
            values[axis] += function(np.array([start - middle, end - middle, *inside])).tolist()
    found = plan.extrema(nu)
    size = np.abs(values).max() + (not np.abs(values).max())
    np.testing.assert_allclose(found.maximum, [max(row) for row in values], rtol=0.0, atol=1e-12 * size)
    np.testing.assert_allclose(found.minimum, [min(row) for row in values], rtol=0.0, atol=1e-12 * size)
