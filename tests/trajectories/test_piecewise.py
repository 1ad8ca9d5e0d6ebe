"""One spline a segment: what is prescribed, what is left free, and never a jump."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.interpolate import BPoly, CubicHermiteSpline, CubicSpline, make_interp_spline
from trajectory_oracle import Direct, miss, waypoints

from ctrlplan.trajectories import PiecewiseSpline, PolySpline, TrigSpline, Waypoint

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

TIMES = [0.0, 6.0, 11.0, 16.0]
JETS = [[0.0, 0.0, 0.0], [5.0, 1.0, 0.1], [15.0, 2.0, 0.1], [20.0, 0.0, 0.0]]


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 2.0, np.pi, 5.0])
def test_three_segments_are_three_runs_of_a_single_segment(alpha):
    plan = PiecewiseSpline(waypoints(TIMES, JETS), alpha=alpha)
    assert len(plan.segments) == 3
    np.testing.assert_array_equal(plan.breakpoints, TIMES)
    for k in range(3):
        pair, inside = slice(k, k + 2), np.linspace(TIMES[k], TIMES[k + 1], 30)[:-1]
        alone = TrigSpline(waypoints(TIMES[pair], JETS[pair]), alpha=alpha)
        found, same = plan.jet(inside, 4), alone.jet(inside, 4)
        # The same function, of which the sums are rounded in another order.
        assert (np.abs(found - same) <= 1e-14 * np.abs(same).max(axis=2, keepdims=True)).all()
        exact = Direct(TIMES[pair], JETS[pair], alpha, digits=80).jet(inside, 3)
        np.testing.assert_allclose(plan.jet(inside, 3)[:, 0], exact, rtol=0, atol=1e-12 * np.abs(exact).max())


def test_full_jets_are_the_quintics_of_scipy():
    plan = PiecewiseSpline(waypoints(TIMES, JETS))
    bernstein = BPoly.from_derivatives(TIMES, JETS)
    t = np.linspace(0, 16, 101)
    for nu in range(3):
        np.testing.assert_allclose(plan(t, nu), bernstein.derivative(nu)(t) if nu else bernstein(t), rtol=0, atol=1e-12)


def inner_only(rng, n, size):
    """Times, ends with all entries, inner waypoints with position alone."""
    times = np.cumsum(rng.uniform(0.2, 2.0, n))
    jets = [rng.normal(size=size).tolist()] + [[v] for v in rng.normal(size=n - 2)] + [rng.normal(size=size).tolist()]
    return times, jets


@pytest.mark.parametrize("n", [3, 5, 12])
def test_free_velocities_give_the_clamped_cubic_spline(n):
    times, jets = inner_only(np.random.default_rng(n), n, 2)
    plan = PiecewiseSpline(waypoints(times, jets))
    spline = CubicSpline(times, [j[0] for j in jets], bc_type=((1, jets[0][1]), (1, jets[-1][1])))
    t = np.linspace(times[0], times[-1], 101)
    for nu in range(3):
        np.testing.assert_allclose(plan(t, nu), spline(t, nu), rtol=0, atol=1e-12 * np.abs(spline(t, nu)).max())


@pytest.mark.parametrize("n", [3, 5, 12])
def test_free_velocities_and_accelerations_give_the_minimum_jerk_spline(n):
    times, jets = inner_only(np.random.default_rng(n), n, 3)
    plan = PiecewiseSpline(waypoints(times, jets))
    ends = [[(1, j[1]), (2, j[2])] for j in (jets[0], jets[-1])]
    spline = make_interp_spline(times, [j[0] for j in jets], k=5, bc_type=tuple(ends))
    t = np.linspace(times[0], times[-1], 101)
    for nu in range(5):
        np.testing.assert_allclose(plan(t, nu), spline(t, nu), rtol=0, atol=1e-10 * np.abs(spline(t, nu)).max())


def test_the_minimum_jerk_spline_has_the_minimum_cost():
    """Any other choice of the free velocities and accelerations has a greater int jerk^2."""
    times, jets = inner_only(np.random.default_rng(2), 4, 3)
    plan = PiecewiseSpline(waypoints(times, jets))
    nodes, weights = np.polynomial.legendre.leggauss(6)

    def cost(p):
        segments = itertools.pairwise(times)
        return sum(0.5 * (b - a) * weights @ p(a + 0.5 * (b - a) * (nodes + 1), 3) ** 2 for a, b in segments)

    chosen = plan.jet(times, 2)[:, 0].T
    assert cost(PiecewiseSpline(waypoints(times, chosen))) == pytest.approx(cost(plan), rel=1e-9)
    for i in (1, 2):
        for k in (1, 2):
            for change in (-0.1, 0.1):
                other = chosen.copy()
                other[i, k] += change
                assert cost(PiecewiseSpline(waypoints(times, other))) > cost(plan)


# What inner waypoints prescribe between ends with position, velocity and acceleration.
INNER = {
    "positions": [[1.0], [-0.5]],
    "velocity given, acceleration free": [[1.0, 0.3], [-0.5, -1.0]],
    "velocity free, acceleration given": [[1.0, None, 0.5], [-0.5, None, 0.0]],
    "position free": [[None, 1.0, 0.0], [2.0]],
    "nothing at one": [[None], [2.0, 0.0]],
}


ENDS = {
    "all": ([0.0, 1.0, 0.5], [3.0, 0.0, 0.0]),
    "acceleration free at the start": ([0.0, 1.0], [3.0, 0.7, 0.2]),
    "velocity free at the end": ([0.0, 1.0, 0.5], [3.0, None, -0.4]),
    "position alone at the end": ([0.0, 1.0, 0.5], [3.0]),
}


@pytest.mark.parametrize("alpha", [0.0, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("inner", INNER)
@pytest.mark.parametrize("ends", ENDS)
def test_free_entries_are_continuous_and_so_are_their_conjugates(ends, inner, alpha):
    """K = 3: entry j is free where derivative 5 - j does not jump."""
    jets = [ENDS[ends][0], *INNER[inner], ENDS[ends][1]]
    plan = PiecewiseSpline(waypoints([0.0, 1.0, 1.5, 3.0], jets), alpha=alpha)
    assert miss(plan) <= 1e-12
    size = np.abs(plan.jet(np.linspace(0, 3, 101), 5)).max(axis=2)[:, 0]
    for t, jet in zip([1.0, 1.5], jets[1:3], strict=True):
        jump = np.abs(plan.jet(t, 5) - plan.jet(t, 5, left=True))[:, 0] / size
        assert jump[:3].max() <= 1e-12
        free = [j for j in range(3) if j >= len(jet) or jet[j] is None]
        assert jump[[5 - j for j in free]].max() <= 1e-11
    prescribed = [5 - j for j, v in enumerate(jets[1]) if v is not None]
    if prescribed:
        assert (np.abs(plan.jet(1.0, 5) - plan.jet(1.0, 5, left=True))[prescribed, 0] > 1e-6 * size[prescribed]).all()


def test_every_axis_has_its_own_free_entries():
    """A clamped cubic, a full quintic and a straight line side by side."""
    points = [
        Waypoint.from_jets(0.0, x=[0.0, 1.0], z=[1.0, 0.0, 0.0], s=[0.0]),
        Waypoint.from_jets(1.0, x=[2.0], z=[2.0, 1.0, 0.0], s=[1.0]),
        Waypoint.from_jets(3.0, x=[-1.0, 0.0], z=[0.0, 0.0, 1.0], s=[-1.0]),
    ]
    plan = PiecewiseSpline(points)
    assert plan.labels == ("x", "z", "s")
    t = np.linspace(0, 3, 50)
    cubic = CubicSpline([0, 1, 3], [0, 2, -1], bc_type=((1, 1.0), (1, 0.0)))
    quintic = BPoly.from_derivatives([0, 1, 3], [[1, 0, 0], [2, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(plan(t), [cubic(t), quintic(t), np.interp(t, [0, 1, 3], [0, 1, -1])], atol=1e-13)
    # A line's velocity is prescribed nowhere, so it may jump; the value at the join is the right-hand one.
    assert plan(1.0, 1)[2] == pytest.approx(-1.0, rel=1e-14)
    assert plan.jet(1.0, 1, left=True)[1, 2] == pytest.approx(1.0, rel=1e-14)


def test_axes_with_the_same_free_entries_need_not_be_neighbours():
    # Axes 0 and 2 are clamped cubic splines, the others are cubic Hermite splines: all have segments of one kind.
    times = np.array([0.0, 0.7, 1.0, 2.5, 3.0, 4.0])
    rng = np.random.default_rng(19)
    values, slopes = rng.normal(size=(2, 4, times.size))
    slopes[np.ix_([0, 2], range(1, times.size - 1))] = np.nan
    exact = []
    for row, slope in zip(values, slopes, strict=True):
        ends = ((1, slope[0]), (1, slope[-1]))
        free = np.isnan(slope).any()
        exact.append(CubicSpline(times, row, bc_type=ends) if free else CubicHermiteSpline(times, row, slope))
    plan = PiecewiseSpline.from_arrays(times, values, derivatives={1: slopes}, warn=False)
    again = PiecewiseSpline.from_arrays(times, 2.0 * values, derivatives={1: 3.0 * slopes}, warn=False)
    for own in (plan, again.with_values(values, derivatives={1: slopes})):
        for count in (11, 1000):  # by jets, by interpolants
            t = np.linspace(0.0, 4.0, count)[:-1]
            expected = np.array([[spline(t, nu) for spline in exact] for nu in range(4)])
            np.testing.assert_allclose(own.jet(t, 3), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
            found = [segment(0.5 * (segment.start + segment.end)) for segment in own.segments]
            middles = 0.5 * (times[1:] + times[:-1])
            np.testing.assert_allclose(found, np.transpose([spline(middles) for spline in exact]), rtol=0, atol=1e-12)


def test_ends_that_prescribe_less_lower_the_degree_of_their_segments():
    """Positions at the ends, a full jet inside: a cubic a segment (4 constraints)."""
    plan = PiecewiseSpline(waypoints([0.0, 1.0, 2.0], [[0.0], [1.0, 2.0, 0.0], [5.0]]))
    assert [segment.degree for segment in plan.segments] == [(3,), (3,)]
    assert miss(plan) <= 1e-14
    assert [segment.degree for segment in PiecewiseSpline(waypoints(TIMES, JETS)).segments] == [(5,)] * 3


@examples(60)
@given(
    st.lists(
        st.tuples(st.integers(20, 200), st.integers(-100, 100), st.booleans(), st.booleans()), min_size=3, max_size=8
    ),
    st.sampled_from([0.0, 1.0, 4.0]),
    st.floats(-6, 6),
)
def test_never_a_jump(rows, alpha, decade):
    """Whatever inner entries are free, position, velocity and acceleration do not jump."""
    duration = 10.0**decade
    times = duration * np.cumsum([r[0] for r in rows]) / 100
    jets = [[p / 100, None if v else p / 50 / duration, None if a else 0.0] for _, p, v, a in rows]
    jets[0], jets[-1] = [jets[0][0], 0.0, 0.0], [jets[-1][0], 0.0, 0.0]
    plan = PiecewiseSpline(waypoints(times, jets), alpha=alpha)
    assert miss(plan) <= 1e-12
    fine = np.abs(plan.jet(np.linspace(times[0], times[-1], 301), 2)).max(axis=2)[:, 0]
    size = np.maximum(fine, fine[0] / plan.duration ** np.arange(3))
    jump = np.abs(plan.jet(times[1:-1], 2) - plan.jet(times[1:-1], 2, left=True))[:, 0]
    assert (jump <= 1e-11 * size[:, None]).all()


def test_with_values_retime_and_one_segment():
    plan = PiecewiseSpline(waypoints(TIMES, [JETS[0], [5.0], [15.0, 2.0], JETS[3]]), alpha=2.0)
    other = waypoints(TIMES, [[1.0, 0.0, 0.0], [2.0], [3.0, 1.0], [4.0, 0.0, 0.0]])
    t = np.linspace(0, 16, 60)
    np.testing.assert_array_equal(plan.with_values(other).jet(t, 2), PiecewiseSpline(other, alpha=2.0).jet(t, 2))
    slow = plan.retime(32.0)
    np.testing.assert_allclose(slow(2 * t, 2), plan(t, 2) / 4, rtol=0, atol=1e-12)
    one = PiecewiseSpline(waypoints([0.0, 1.0], JETS[:2]))
    np.testing.assert_array_equal(one(t / 16), PolySpline(waypoints([0.0, 1.0], JETS[:2]))(t / 16))


@pytest.mark.parametrize("jets", [[[0.0], [None, 1.0], [1.0]], [[None, 0.0], [None, 1.0], [None, 0.0]], [[None]] * 3])
def test_what_is_not_determined_is_rejected(jets):
    """A quadratic segment has no third derivative that could fix its end; nor have velocities a position."""
    with pytest.raises(ValueError, match="free entries at inner waypoints must be determined by the prescribed ones"):
        PiecewiseSpline(waypoints([0.0, 1.0, 2.0], jets))


def test_undetermined_entries_remain_so_next_to_a_short_segment():
    with pytest.raises(ValueError, match="must be determined by the prescribed ones; prescribe more"):
        PiecewiseSpline(waypoints([0.0, 1.0, 1.0 + 1e-7, 2.0], [[None], [None], [None], [None]]))
    with pytest.raises(ValueError, match="must be determined by the prescribed ones; prescribe more"):
        PiecewiseSpline(waypoints([0.0, 1.0, 1.0 + 1e-7], [[0.0], [None, 1.0], [1.0]]))


def test_an_axis_with_nothing_prescribed_is_rejected():
    with pytest.raises(ValueError, match="an axis must have at least one prescribed entry, got none"):
        PiecewiseSpline(waypoints([0.0, 1.0], [[None], [None]]))
