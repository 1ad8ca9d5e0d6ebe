"""Constants that a plan attains, and what is true of alpha."""

import numpy as np
import pytest
from scipy.interpolate import BPoly, KroghInterpolator
from scipy.special import comb
from trajectory_oracle import waypoints

from ctrlplan.trajectories import PolySpline, TrigSpline, Waypoint

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

REST = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]


def test_minimum_jerk():
    """10 u^3 - 15 u^4 + 6 u^5 (Flash and Hogan): peaks 15/8, 10/sqrt 3 and 60."""
    plan = PolySpline(REST)
    u = np.linspace(0, 1, 101)
    np.testing.assert_allclose(plan(u), u**3 * (10 - 15 * u + 6 * u**2), rtol=0, atol=4e-15)
    assert plan.degree == (5,)
    assert plan.peak(1)[0] == pytest.approx(15 / 8, rel=1e-15)
    assert plan.peak(2)[0] == pytest.approx(10 / np.sqrt(3), rel=1e-14)
    assert plan.peak(3)[0] == pytest.approx(60, rel=1e-14)
    assert plan.peak(4)[0] == pytest.approx(360, rel=1e-14)
    found = plan.extrema(2)
    np.testing.assert_allclose(
        [found.time_max[0], found.time_min[0]], 0.5 + np.array([-1, 1]) * np.sqrt(1 / 12), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("alpha", "velocity", "jerk"), [(0.0, 1.875, 60.0), (2.0, 2.002, 39.6), (np.pi, 2.356, 69.8)], ids=["0", "2", "pi"]
)
def test_the_unit_move_at_three_alphas(alpha, velocity, jerk):
    """As printed, to half of the last digit."""
    plan = TrigSpline(REST, alpha=alpha)
    assert plan.peak(1)[0] == pytest.approx(velocity, abs=5.1e-4)
    assert plan.peak(3)[0] == pytest.approx(jerk, abs=5.1e-2)


def test_a_half_turn_has_a_closed_form():
    """alpha = pi: y' is of degree 3 and vanishes twice at both ends, which leaves c sin^3(pi t), of integral 1."""
    plan = TrigSpline(REST, alpha=np.pi)
    t = np.linspace(0, 1, 51)
    np.testing.assert_allclose(plan(t, 1), 0.75 * np.pi * np.sin(np.pi * t) ** 3, rtol=0, atol=1e-14)
    assert plan.peak(1)[0] == pytest.approx(0.75 * np.pi, rel=1e-14)


@pytest.mark.parametrize(("alpha", "cost"), [(0.0, 720.0), (2.0, 781.0), (np.pi, 1521.0)], ids=["0", "2", "pi"])
def test_integral_of_squared_jerk(alpha, cost):
    nodes, weights = np.polynomial.legendre.leggauss(40)
    jerk = TrigSpline(REST, alpha=alpha)(0.5 * (nodes + 1), 3)
    assert 0.5 * weights @ jerk**2 == pytest.approx(cost, abs=0.51)


def test_minimum_peak_jerk_and_snap():
    assert TrigSpline(REST, alpha=1.98).peak(3)[0] == pytest.approx(39.39, abs=5.1e-3)
    assert min(TrigSpline(REST, alpha=a).peak(4)[0] for a in np.arange(1.0, 3.0, 0.1)) < 240


@pytest.mark.parametrize("entries", range(1, 8))
def test_rest_to_rest_polynomial_is_the_smoothstep(entries):
    """Degree 2m - 1: the integral of the beta density, sum C(m-1+k, k) C(2m-1, m-1-k) (-u)^k u^m."""
    m = entries
    plan = PolySpline(waypoints([0.0, 1.0], [[0.0] * m, [1.0] + [0.0] * (m - 1)]))
    u = np.linspace(0, 1, 33)
    exact = u**m * sum(comb(m - 1 + k, k) * comb(2 * m - 1, m - 1 - k) * (-u) ** k for k in range(m))
    np.testing.assert_allclose(plan(u), exact, rtol=0, atol=1e-12)


@pytest.mark.parametrize("lengths", [[3, 3], [2, 1, 3], [1] * 8, [1, 4, 2, 1]])
def test_alpha_zero_is_the_polynomial_of_scipy(lengths):
    rng = np.random.default_rng(5)
    times = np.concatenate([[-1.0], np.sort(rng.uniform(-1, 3, len(lengths) - 2)), [3.0]])
    jets = [rng.normal(size=k).tolist() for k in lengths]
    krogh = KroghInterpolator(np.repeat(times, lengths), np.concatenate(jets))
    t = np.linspace(-1, 3, 41)
    exact = krogh.derivatives(t, 4)
    for plan in (PolySpline(waypoints(times, jets)), TrigSpline(waypoints(times, jets), alpha=0.0)):
        for nu in range(4):
            assert np.abs(plan(t, nu) - exact[nu]).max() <= 1e-11 * max(np.abs(exact[nu]).max(), 1.0)
    if len(times) == 2:
        bernstein = BPoly.from_derivatives(times, jets)
        np.testing.assert_allclose(PolySpline(waypoints(times, jets))(t), bernstein(t), rtol=0, atol=1e-13)


@pytest.mark.parametrize("entries", range(1, 7))
@pytest.mark.parametrize("alpha", [0.0, 0.5, 2.0, 3.0, np.pi])
def test_rest_to_rest_is_monotone_up_to_half_a_turn(alpha, entries):
    plan = TrigSpline(
        waypoints([0.0, 2.0], [[1.0] + [0.0] * (entries - 1), [4.0] + [0.0] * (entries - 1)]), alpha=alpha
    )
    slope = plan.extrema(1)
    assert slope.minimum[0] >= -1e-13 * slope.maximum[0]
    np.testing.assert_allclose([plan.extrema().minimum[0], plan.extrema().maximum[0]], [1, 4], rtol=1e-14)


@pytest.mark.parametrize("entries", [1, 3, 5])
def test_beyond_half_a_turn_an_odd_degree_turns_back(entries):
    jets = [[0.0] * entries, [1.0] + [0.0] * (entries - 1)]
    slope = TrigSpline(waypoints([0.0, 1.0], jets), alpha=np.pi + 0.05).extrema(1)
    assert slope.minimum[0] < -1e-6 * slope.maximum[0]


@pytest.mark.parametrize("lengths", [(1, 1), (2, 2), (3, 3), (2, 3), (4, 3)])
def test_blow_up_towards_a_whole_turn(lengths):
    """The peak grows like (2 pi - alpha)^-(b1 + bn + 1), b the highest orders at the ends."""
    jets = [[0.0] * lengths[0], [1.0] + [0.0] * (lengths[1] - 1)]
    gaps = np.array([1e-2, 1e-3])
    peaks = [TrigSpline(waypoints([0.0, 1.0], jets), alpha=2 * np.pi - gap).peak()[0] for gap in gaps]
    slope = np.diff(np.log(peaks))[0] / np.diff(np.log(gaps))[0]
    assert slope == pytest.approx(-(sum(lengths) - 1), abs=0.02)


@pytest.mark.parametrize("entries", [1, 2, 3])
def test_no_blow_up_where_a_plan_returns_to_rest(entries):
    rest = [1.0] + [0.0] * (entries - 1)
    jets = [rest, [3.0], rest]
    peaks = [TrigSpline(waypoints([0.0, 0.4, 1.0], jets), alpha=2 * np.pi - gap).peak()[0] for gap in (0.3, 0.1, 0.03)]
    assert max(peaks) <= 1.05 * min(peaks)
