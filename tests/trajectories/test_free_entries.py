"""Entries left free: Birkhoff data, each axis its own, against plain linear algebra in many digits."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from repetitions import examples
from trajectory_oracle import Direct, error, miss, waypoints

from ctrlplan.trajectories import PiecewiseSpline, PolySpline, TrigSpline, Waypoint

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

ALPHAS = [0.0, 1.0, 4.0, 5.5]

# Position and acceleration with the velocity free, velocities without positions, no entry at all, a late entry alone.
PATTERNS = {
    "velocity free": ([0.0, 0.4, 1.0], [[0.0, 0.0, 0.0], [2.0, None, 1.0], [1.0, 0.0, 0.0]]),
    "velocities free": ([0.0, 1.0, 3.0, 4.0], [[1.0, None, 0.3], [0.5, None, 2.0], [2.0, None, -1.0], [0.0, None]]),
    "positions free": ([0.0, 1.0, 1.5, 2.0], [[1.0], [None, 1.0], [None, -2.0], [None, 0.5]]),
    "nothing at the start": ([0.0, 1.0, 2.0], [[None], [1.0, 2.0, 3.0], [0.5, -1.0]]),
    "nothing at the end": ([0.0, 1.0, 2.0], [[0.3, 1.0], [1.0, 2.0], [None, None]]),
    "nothing inside": ([0.0, 1.0, 2.0], [[0.3, 1.0], [None], [1.0, 2.0]]),
    "jerk alone": ([0.0, 0.3, 1.0], [[0.0, 0.0], [None, None, None, 5.0], [1.0, 0.0]]),
}


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_birkhoff_data(pattern, alpha):
    times, jets = PATTERNS[pattern]
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    oracle = Direct(times, jets, alpha)
    assert miss(plan) <= 1e-12
    assert error(plan, oracle, order=4) <= 1e-12
    assert plan.degree == ((oracle.m,) if alpha else (oracle.size - 1,))


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 1.0, 4.0, 5.0])
@pytest.mark.parametrize("count", [4, 6, 8, 10])
def test_many_waypoints_without_velocity(count, alpha):
    """Position and acceleration at every waypoint, rest at the ends: up to N = 22.

    In many digits a change of the data by 1e-10 moves the plan by less than 1e-8: nothing here is near singular.
    """
    times = np.linspace(0, 1, count)
    inner = [[np.sin(3 * t), None, -9 * np.sin(3 * t)] for t in times[1:-1]]
    jets = [[0.0, 0.0, 0.0], *inner, [1.0, 0.0, 0.0]]
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert miss(plan) <= 1e-12
    assert error(plan, Direct(times, jets, alpha, digits=150 if alpha == 1e-4 else 60), ntime=21) <= 1e-12


def test_every_axis_has_its_own_free_entries():
    nan = np.nan
    points = [
        Waypoint(0.0, [1.0, 2.0, 3.0], [0.0, nan, 0.5], [nan, 1.0, nan]),
        Waypoint(1.0, [nan, 0.0, 1.0], [2.0, nan, nan]),
        Waypoint(4.0, [0.0, 1.0, nan], None, [1.0, nan, 0.3]),
    ]
    for alpha in (0.0, 2.0):
        plan = TrigSpline(points, alpha=alpha)
        assert miss(plan) <= 1e-12
        t = np.linspace(0, 4, 31)
        for axis in range(3):
            jets = [[None if np.isnan(v) else v for v in w.jet[:, axis]] for w in points]
            alone = TrigSpline(waypoints([0.0, 1.0, 4.0], jets), alpha=alpha)
            exact = Direct([0.0, 1.0, 4.0], jets, alpha).jet(t, 3)
            np.testing.assert_allclose(plan.jet(t, 3)[:, axis], exact, rtol=0, atol=1e-12 * np.abs(exact).max())
            assert plan.degree[axis] == alone.degree[0]
            assert plan.gamma[axis] == alone.gamma[0]


def test_units_do_not_decide_what_is_singular():
    """The same plan in microseconds and in weeks."""
    times, jets = PATTERNS["velocity free"]
    u = np.linspace(0, 1, 21)
    exact = Direct(times, jets, 2.0).jet(u, 0)[0]
    for duration in (1e-6, 1e6):
        scaled = [[v if v is None else v / duration**k for k, v in enumerate(jet)] for jet in jets]
        plan = TrigSpline(waypoints(np.array(times) * duration, scaled), alpha=2.0)
        np.testing.assert_allclose(plan(u * duration), exact, rtol=0, atol=1e-13)
        assert miss(plan) <= 1e-12


@pytest.mark.parametrize(
    ("times", "jets"),
    [
        # p(0), p(1), p'(1/2): u (1 - u) satisfies all three homogeneously.
        ([0.0, 0.5, 1.0], [[0.0], [None, 1.0], [1.0]]),
        ([5.0, 6.0, 7.0], [[0.0], [None, 0.0], [1.0]]),
        # u^3 (1 - u)^3 (u - 1/2) is odd about the middle, so its value and second derivative vanish there.
        ([0.0, 0.5, 1.0], [[0.0, 0.0, 0.0], [1.0, None, 0.0], [1.0, 0.0, 0.0]]),
        # No position anywhere: a constant is left free.
        ([0.0, 1.0], [[None, 0.0], [None, 1.0]]),
        ([0.0, 0.3, 1.0], [[None, 0.0, 1.0], [None, 0.0], [None, 1.0]]),
    ],
    ids=["paper", "shifted", "odd about the middle", "no position", "velocities"],
)
def test_singular_free_entries_are_rejected(times, jets):
    with pytest.raises(ValueError, match=r"must not make the system singular.* got a relative singular value"):
        PolySpline(waypoints(times, jets))


def test_singular_for_every_alpha_by_symmetry():
    for alpha in (0.0, 1e-4, 1.0, np.pi, 5.5):
        with pytest.raises(ValueError, match="must not make the system singular"):
            TrigSpline(waypoints([0.0, 0.5, 1.0], [[0.0], [None, 1.0], [1.0]]), alpha=alpha)


def test_one_axis_that_is_singular_is_enough():
    nan = np.nan
    points = [Waypoint(0, [0, 0], [0, nan]), Waypoint(0.5, [1, nan], [nan, 1]), Waypoint(1, [1, 1])]
    with pytest.raises(ValueError, match="must not make the system singular"):
        PolySpline(points)


@examples(60)
@given(st.data())
def test_free_entries_are_met_wherever_they_are_determined(data):
    """Any mask over 3 waypoints by 3 orders that keeps the ends' positions."""
    mask = data.draw(st.lists(st.booleans(), min_size=9, max_size=9))
    mask[0] = mask[6] = True
    jets = [[float(v) if mask[3 * i + k] else None for k, v in enumerate((i - 1, 2 * i, 1 - i))] for i in range(3)]
    alpha = data.draw(st.sampled_from([0.0, 0.7, 3.0]))
    times = [0.0, 0.37, 1.0]
    try:
        oracle = Direct(times, jets, alpha)
    except ZeroDivisionError:
        assume(False)
    assume(max(abs(float(c)) for c in oracle.coefficients) < 1e6)
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert miss(plan) <= 1e-12
    assert error(plan, oracle, ntime=11) <= 1e-11


@pytest.mark.parametrize("order", [3, 4, 9])
@pytest.mark.parametrize("spline", [PolySpline, PiecewiseSpline])
def test_a_derivative_above_the_degree_determines_nothing(spline, order):
    """Two positions and one such derivative: a parabola has none."""
    start = Waypoint.from_jets(0, y=[0.0, *[np.nan] * (order - 1), 1.0])
    with pytest.raises(ValueError, match=r"free entries .* undetermined|must be determined|must determine it"):
        spline([start, Waypoint.from_jets(1, y=[1.0])])
