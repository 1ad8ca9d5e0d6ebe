"""Segments of very different durations: every digit of the plan, against the same conditions solved in 80 digits."""

import itertools

import mpmath
import numpy as np
import pytest

from ctrlplan.trajectories import PiecewiseSpline, Waypoint, trajectory_from_dict

pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

WITHIN = (0.0, 0.13, 0.5, 0.8, 1.0)


def functions(alpha, count, h, s, order):
    """Derivatives of the functions of one segment of duration h at the time s in it: powers, or harmonics."""
    if not alpha:
        return [
            [mpmath.ff(j, k) * s ** (j - k) / h**j if j >= k else mpmath.mpf(0) for k in range(order + 1)]
            for j in range(count)
        ]
    rate, x = alpha / h, alpha * (s / h - mpmath.mpf(1) / 2)

    def harmonic(m, sine):
        cycle = (mpmath.sin(m * x), mpmath.cos(m * x), -mpmath.sin(m * x), -mpmath.cos(m * x))
        return [(m * rate) ** k * cycle[(k + 1 - sine) % 4] for k in range(order + 1)]

    found = [[mpmath.mpf(1)] + [mpmath.mpf(0)] * order]
    for m in range(1, (count - 1) // 2 + 1):
        found += [harmonic(m, False), harmonic(m, True)]
    # The top harmonic of an even number is sin m (tau - gamma), gamma the mean of the given entries: here the middle.
    return found if count % 2 else [*found, harmonic(count // 2, True)]


def reference(times, jets, size, alpha):
    """Jets (segment, order, position in WITHIN) up to 2 size - 1 of one axis whose ends have full jets."""
    last, m, moments, rows = len(times) - 1, 2 * size, [mpmath.mpf(t) for t in times], []

    def side(i, segment):
        start = moments[segment]
        return functions(mpmath.mpf(alpha), m, moments[segment + 1] - start, moments[i] - start, 2 * size - 1)

    for i, jet in enumerate(jets):
        segments = [segment for segment in (i - 1, i) if 0 <= segment < last]
        for k in range(size):
            if k < len(jet) and jet[k] is not None:
                rows += [({segment: [f[k] for f in side(i, segment)]}, jet[k]) for segment in segments]
            else:
                for order in (k, 2 * size - 1 - k):
                    rows.append(
                        (
                            {
                                segment: [(2 * n - 1) * f[order] for f in side(i, segment)]
                                for n, segment in enumerate(segments)
                            },
                            0,
                        )
                    )
    matrix, right = mpmath.zeros(len(rows), last * m), mpmath.zeros(len(rows), 1)
    for r, (parts, value) in enumerate(rows):
        scale = max(abs(v) for part in parts.values() for v in part)
        right[r] = value / scale
        for segment, part in parts.items():
            for j, v in enumerate(part):
                matrix[r, segment * m + j] = v / scale
    found = mpmath.lu_solve(matrix, right)
    out = np.empty((last, m, len(WITHIN)))
    for segment, (q, u) in itertools.product(range(last), enumerate(WITHIN)):
        h = moments[segment + 1] - moments[segment]
        values = functions(mpmath.mpf(alpha), m, h, mpmath.mpf(u) * h, m - 1)
        for k in range(m):
            out[segment, k, q] = float(sum(found[segment * m + j] * values[j][k] for j in range(m)))
    return out


def check(times, rows, size, alpha, tolerance=1e-13):
    """Every derivative up to 2 size - 1, of every axis, relative to its peak over the plan.

    What is left is rounding: of entries and coefficients (a few eps), and of the basis in floating point (alpha > 0).
    """
    labels = [f"y{a}" for a in range(len(rows))]
    points = [
        Waypoint.from_jets(t, **dict(zip(labels, jets, strict=True)))
        for t, jets in zip(times, zip(*rows, strict=True), strict=True)
    ]
    plan = PiecewiseSpline(points, alpha=alpha)
    with mpmath.workdps(80):
        wanted = np.array([reference(times, jets, size, alpha) for jets in rows])
    for segment, h in enumerate(np.diff(times)):
        got = plan.segment_jet(segment, h * np.array(WITHIN), 2 * size - 1)
        peak = np.abs(wanted).max(axis=(1, 3)).T[..., None]
        assert (np.abs(got - wanted[:, segment].transpose(1, 0, 2)) <= tolerance * peak).all()
    return plan


def short(gap, where, size, heights=(0.0, 1.0, 1.5, 2.0)):
    """Four points at rest at the ends, positions inside, of which two are a gap apart."""
    times = [0.0, 1.0, 1.8, 3.0]
    times[where + 1] = times[where] + gap
    if where == 2:
        times[3] = times[2] + gap
    rest = [0.0] * (size - 1)
    return times, [[heights[0], *rest], [heights[1]], [heights[2]], [heights[3], *rest]]


@pytest.mark.parametrize("gap", [1e-3, 1e-5, pytest.param(1e-7, marks=pytest.mark.slow), 1e-9])
@pytest.mark.parametrize("size", [2, 3, 4])
@pytest.mark.parametrize("alpha", [0.0, 2.0])
@pytest.mark.parametrize("where", [pytest.param(0, marks=pytest.mark.slow), 1, 2])
def test_a_short_segment_costs_no_digits(where, alpha, size, gap):
    times, jets = short(gap, where, size)
    check(times, [jets], size, alpha)


@pytest.mark.slow
def test_several_axes_and_entries_given_inside():
    """Two axes of one pattern and one of another, three durations of segments six powers of ten apart."""
    times = [10.0, 10.0 + 2.0**-20, 10.5, 10.5 + 2.0**-10, 12.0]
    rows = [
        [[0.0, 1.0, 0.0, 0.0], [0.5], [1.0, None, 0.0], [None, 2.0], [0.0, 0.0, 0.0, 0.0]],
        [[1.0, 0.0, 0.0, -3.0], [-0.5], [0.0, None, 1.0], [None, 0.0], [7.0, 0.0, 1.0, 0.0]],
    ]
    check(times, rows, 4, 0.0)
    check(times, rows, 4, 1.0)


def test_data_of_a_smooth_motion_reproduce_it_next_to_a_short_segment():
    """Points of a septic polynomial, its ends prescribed to order 3: minimum snap through them is the polynomial."""
    motion = np.polynomial.Polynomial([1.0, -2.0, 0.5, 3.0, -1.0, 0.25, 0.5, -0.125])
    times = [0.0, 1.0, 1.0 + 2.0**-12, 2.0]
    ends = [[motion.deriv(k)(t) if k else motion(t) for k in range(4)] for t in (0.0, 2.0)]
    plan = PiecewiseSpline(
        [Waypoint(0.0, *ends[0]), *(Waypoint(t, motion(t)) for t in times[1:3]), Waypoint(2.0, *ends[1])]
    )
    t = np.linspace(0.0, 2.0, 41)
    # Rounding of the two positions, 2e-16, is a slope of up to 1e-12 over the short segment.
    np.testing.assert_allclose(plan(t), motion(t), rtol=0, atol=1e-11)


def test_entries_of_ends_that_nearly_meet_keep_their_digits():
    """Near alpha = 2 pi both ends of each segment are nearly one point."""
    for alpha in (6.28, 6.28318):
        check([0.0, 1.0, 2.5], [[[0.0, 0.0, 0.0], [1.0], [0.5, 0.0, 0.0]]], 3, alpha, tolerance=1e-9)


def test_a_long_plan_with_one_short_segment():
    """Minimum jerk through 200 points: nothing that is continuous jumps, in the scale of each derivative."""
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.5, 1.5, 200))
    times[100:] -= times[100] - times[99] - 1e-6
    points = [
        Waypoint(t, *([y, 0.0, 0.0] if i in (0, 199) else [y]))
        for i, (t, y) in enumerate(zip(times, rng.normal(size=200), strict=True))
    ]
    plan = PiecewiseSpline(points)
    right, left = plan.jet(times[1:-1], 4), plan.jet(times[1:-1], 4, left=True)
    size = np.abs(right).max(axis=2, keepdims=True)
    assert (np.abs(right - left) <= 1e-12 * size).all()


def test_it_is_the_same_plan_from_a_file_and_in_another_time():
    times, jets = short(1e-6, 1, 4)
    plan = PiecewiseSpline([Waypoint.from_jets(t, y=jet) for t, jet in zip(times, jets, strict=True)])
    t = np.linspace(0.0, 3.0, 31)
    np.testing.assert_array_equal(trajectory_from_dict(plan.to_dict()).jet(t, 7), plan.jet(t, 7))
    np.testing.assert_allclose(plan.retime(6.0)(2.0 * t), plan(t), rtol=0, atol=1e-9 * plan.peak().max())


def test_entries_beyond_floating_point_are_an_error():
    points = [Waypoint(0, 0, 0, 0, 0), Waypoint(1e-160, 1.0), Waypoint(1.0, 2.0), Waypoint(2.0, 0, 0, 0, 0)]
    with pytest.raises(ValueError, match="derivatives at inner waypoints must stay within floating point"):
        PiecewiseSpline(points)
