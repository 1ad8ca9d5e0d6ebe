"""The Newton form against plain linear algebra in many digits, and where it is hardest."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from trajectory_oracle import Direct, error, miss, waypoints

from ctrlplan.trajectories import PolySpline, TrigSpline, Waypoint
from ctrlplan.trajectories.newton import NewtonSystem

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")


@st.composite
def plans(draw, ndigits=4):
    """1 to 3 axes, each with jets of its own lengths, N <= 24 an axis, any duration, any start, any alpha."""
    naxes = draw(st.integers(1, 3))
    gaps = draw(st.lists(st.integers(5, 100), min_size=1, max_size=6))
    duration = 10.0 ** draw(st.floats(-6, 6))
    start = draw(st.sampled_from([0.0, -0.3, 1e6, -1e6])) * duration
    times = start + duration * np.concatenate([[0], np.cumsum(gaps)]) / sum(gaps)
    entry = st.integers(-(10**ndigits), 10**ndigits).map(lambda v: v / 10**ndigits)
    points = []
    left = [24] * naxes
    for i, time in enumerate(times):
        jets = {}
        for axis in range(naxes):
            most = min(5, left[axis] - (len(times) - 1 - i))
            jet = draw(st.lists(entry, min_size=1, max_size=most))
            left[axis] -= len(jet)
            jets[f"axis{axis}"] = [v / duration**k for k, v in enumerate(jet)]
        points.append(Waypoint.from_jets(time, **jets))
    return points, draw(st.one_of(st.sampled_from([0.0, 1e-12, 1e-4, 1.0, np.pi]), st.floats(1e-3, 6.2)))


@examples(150)
@given(plans())
def test_waypoints_are_met_whatever_the_plan(case):
    points, alpha = case
    plan = TrigSpline(points, alpha=alpha)
    assert miss(plan) <= 1e-12
    assert (plan.start, plan.end) == (points[0].time, points[-1].time)


def random_points(rng, durations=(-6, 6), nmax=24, jets=6):
    """Waypoints of 1 to 3 axes with normally distributed entries."""
    n, naxes = rng.integers(2, 8), rng.integers(1, 4)
    duration = 10.0 ** rng.uniform(*durations)
    gaps = rng.uniform(0.02, 1.0, n - 1)
    start = rng.choice([0.0, 1e6, -1e6]) * duration
    times = start + duration * np.concatenate([[0.0], np.cumsum(gaps)]) / gaps.sum()
    lengths = rng.integers(1, jets, (naxes, n))
    while (lengths.sum(axis=1) > nmax).any():
        lengths[lengths.sum(axis=1) > nmax, rng.integers(n)] = 1
    return [
        Waypoint.from_jets(
            t, **{f"x{a}": rng.normal(size=k) / duration ** np.arange(k) for a, k in enumerate(lengths.T[i])}
        )
        for i, t in enumerate(times)
    ]


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 0.5, 2.0, 4.0, 5.5, 6.2])
def test_waypoints_are_met_on_random_plans(alpha):
    rng = np.random.default_rng(7)
    for _ in range(60):
        assert miss(TrigSpline(random_points(rng), alpha=alpha)) <= 1e-12


# Times and numbers of entries (N even and odd).
PATTERNS = {
    "two points, N 2": ([0.0, 3.0], [1, 1]),
    "rest to rest, N 6": ([2.0, 2.5], [3, 3]),
    "uneven, N 7": ([-1.0, 0.1, 4.0], [4, 1, 2]),
    "uneven, N 9": ([0.0, 0.3, 1.0], [3, 2, 4]),
    "uneven, N 12": ([0.0, 1.0, 1.2, 7.0, 10.0], [3, 1, 5, 1, 2]),
    "positions only, N 11": (np.linspace(0, 1, 11), [1] * 11),
    "clustered, N 8": ([0.0, 0.5, 0.5 + 1e-6, 1.0], [2, 2, 2, 2]),
}


def jets_for(lengths, seed=3):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=k).tolist() for k in lengths]


@pytest.mark.parametrize("alpha", [0.0, 1e-3, 0.3, 1.0, np.pi, 5.0, 6.28])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_equation_3_solved_directly(pattern, alpha):
    times, lengths = PATTERNS[pattern]
    jets = jets_for(lengths)
    oracle = Direct(times, jets, alpha, digits=50 if alpha >= 0.3 or not alpha else 120)
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert error(plan, oracle, order=5) <= 1e-12
    assert plan.degree == ((oracle.m,) if alpha else (oracle.size - 1,))
    if alpha and oracle.size % 2 == 0:
        assert plan.gamma[0] == pytest.approx(float(oracle.gamma), rel=1e-14)
    else:
        assert plan.gamma == (None,)


@pytest.mark.parametrize("alpha", [0.3, 1.0, np.pi, 5.0])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_fourier_coefficients_of_equation_2(pattern, alpha):
    times, lengths = PATTERNS[pattern]
    jets = jets_for(lengths)
    oracle = Direct(times, jets, alpha)
    exact = np.array(oracle.coefficients, dtype=float)
    found = TrigSpline(waypoints(times, jets), alpha=alpha).fourier()[0]
    tolerance = 1e-12 * np.abs(exact).max()
    assert found.m == oracle.m
    assert abs(found.a0 - exact[0]) <= tolerance
    pairs = exact[1 : 2 * len(found.a) + 1].reshape(-1, 2)
    np.testing.assert_allclose(np.array([found.a, found.b]).T, pairs, rtol=0, atol=tolerance)
    if oracle.size % 2:
        assert len(found.a) == oracle.m
        assert found.am == 0.0
        assert np.isnan(found.gamma)
    else:
        assert len(found.a) == oracle.m - 1
        assert abs(found.am - exact[-1]) <= tolerance
        assert found.gamma == pytest.approx(float(oracle.gamma), rel=1e-14)


def test_fourier_has_a_row_for_every_axis():
    """12 + 2 sin(tau - pi/2) compared with a constant plus a full harmonic."""
    points = [Waypoint.from_jets(0.0, x=[10.0], z=[3.0]), Waypoint.from_jets(2.0, x=[11.0], z=[3.0, 1.0])]
    plan = TrigSpline(points, alpha=np.pi / 3, gamma=[np.pi / 2, None])
    found = plan.fourier()
    assert len(found) == 2
    assert [f.m for f in found] == [1, 1]
    assert found.a.shape == found.b.shape == (2, 1)
    t = np.array([0.1, 0.7, 1.9])
    tau = t * np.pi / 6
    x = found.a0[0] + found.am[0] * np.sin(tau - found.gamma[0])
    z = found.a0[1] + found.a[1, 0] * np.cos(tau) + found.b[1, 0] * np.sin(tau)
    np.testing.assert_allclose(plan(t), [x, z], rtol=1e-14)


@pytest.mark.parametrize("gamma", [-2.0, 0.0, 0.4, 1.0, 50.0])
@pytest.mark.parametrize("alpha", [0.5, 2.0, 5.5])
@pytest.mark.parametrize("pattern", ["two points, N 2", "rest to rest, N 6", "uneven, N 12"])
def test_explicit_gamma(pattern, alpha, gamma):
    times, lengths = PATTERNS[pattern]
    jets = jets_for(lengths)
    oracle = Direct(times, jets, alpha, gamma=gamma)
    plan = TrigSpline(waypoints(times, jets), alpha=alpha, gamma=gamma)
    assert plan.gamma == (gamma,)
    assert error(plan, oracle, order=4) <= 1e-12
    assert plan.fourier()[0].am == pytest.approx(float(oracle.coefficients[-1]), rel=1e-11)


def test_the_papers_crane_plan():
    """Simulation 2: 10 to 11 m with alpha = pi/3 and gamma = pi/2 is 12 + 2 sin(tau - pi/2)."""
    plan = TrigSpline([Waypoint(0.0, 10.0), Waypoint(30.0, 11.0)], alpha=np.pi / 3, gamma=np.pi / 2)
    t = np.linspace(0.0, 30.0, 61)
    rate = np.pi / 90
    tau = rate * t
    np.testing.assert_allclose(plan(t), 12 + 2 * np.sin(tau - np.pi / 2), rtol=1e-15)
    np.testing.assert_allclose(plan(t, 1), 2 * rate * np.cos(tau - np.pi / 2), rtol=0, atol=1e-15 * 2 * rate)
    found = plan.fourier()[0]
    assert (found.a0, found.am, found.m) == (pytest.approx(12, rel=1e-14), pytest.approx(2, rel=1e-14), 1)
    assert found.a.size == found.b.size == 0


@pytest.mark.parametrize("alpha", [1e-12, 1e-30, 1e-200, 1e-300, 1e-308, 5e-324])
@pytest.mark.parametrize("lengths", [[4, 1, 3], [3, 3, 3]])
def test_the_polynomial_is_the_limit(lengths, alpha):
    """As equation (2) is even in alpha, the difference is O(alpha^2) and lost in rounding."""
    points = waypoints([0.0, 0.3, 1.0], jets_for(lengths))
    t = np.linspace(0, 1, 21)
    exact = PolySpline(points).jet(t, 4)
    scale = np.abs(exact).max(axis=2, keepdims=True)
    assert (np.abs(TrigSpline(points, alpha=alpha).jet(t, 4) - exact) / scale).max() <= 1e-13


@pytest.mark.parametrize("gap", [1e-6, 1e-7])
def test_alpha_next_to_a_whole_turn(gap):
    """The plan is 1e30 large; relative to that it is exact."""
    times, jets, alpha = [0.0, 0.3, 1.0], [[0.0, 0.0, 0.0], [1.0, 2.0], [1.0, 0.0, 0.0]], 2 * np.pi - gap
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert plan.peak(0)[0] > 1e25
    assert error(plan, Direct(times, jets, alpha, digits=150)) <= 1e-12


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 1.0, 5.5])
@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9])
def test_waypoints_close_together(gap, alpha):
    times, jets = [0.0, gap, 0.5, 0.5 + gap, 1.0], jets_for([2, 2, 3, 3, 2])
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert error(plan, Direct(times, jets, alpha, digits=200)) <= 1e-12
    assert miss(plan) <= 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.0, 1e-4, 1.0, 4.2, 5.5, 6.2])
@pytest.mark.parametrize(
    ("times", "lengths"),
    [
        (np.linspace(0, 1, 8), [5] * 8),
        ([0.0, 0.1, 0.2, 1.0], [10] * 4),
        ([0.0, 0.07, 0.2, 0.21, 0.5, 0.55, 0.8, 0.9, 1.0], [5, 4, 5, 3, 5, 5, 5, 4, 4]),
    ],
    ids=["even", "long jets", "mixed"],
)
def test_forty_constraints(times, lengths, alpha):
    jets = jets_for(lengths)
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    digits = 120 if not alpha or alpha >= 1 else 300
    assert error(plan, Direct(times, jets, alpha, digits=digits), ntime=21) <= 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.0, 1.0, 5.5])
def test_long_jets_at_one_end_and_close_waypoints_at_the_other(alpha):
    """24 constraints whose order decides between 1e-15 and 1e-11: the nodes must be spread at every stage."""
    times = [0.0, 0.009, 0.0097, 0.04, 0.55, 0.7, 1.0]
    jets = [[1.0, -1.0, 0.5], [2.0, 0.1], [-0.3, -0.9], [0.2, 1.2], *([[1.0, -0.4, 0.3, -0.7, 0.2]] * 3)]
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert miss(plan) <= 1e-12
    assert error(plan, Direct(times, jets, alpha, digits=120)) <= 1e-12


def test_a_far_start_costs_no_digit():
    """A plan that starts at 2^30 s is the one that starts at 0, bit for bit where times are exact."""
    jets = jets_for([3, 2, 3])
    here = TrigSpline(waypoints([0.0, 0.25, 1.0], jets), alpha=2.0)
    far = TrigSpline(waypoints(2.0**30 + np.array([0.0, 0.25, 1.0]), jets), alpha=2.0)
    t = np.arange(65) / 64
    np.testing.assert_array_equal(far.jet(2.0**30 + t, 3), here.jet(t, 3))


def test_with_values_is_a_new_construction():
    points = [
        Waypoint.from_jets(t, x=x, z=z) for t, x, z in [(0, [1, 2, 3], [1]), (2, [0, 1], [2, 1]), (5, [3], [4, 4])]
    ]
    other = [Waypoint.from_jets(w.time, x=[7.0, *w.jet[1:, 0]], z=[-2.0, *w.jet[1:, 1]]) for w in points]
    for alpha in (0.0, 2.0):
        plan = TrigSpline(points, alpha=alpha, gamma=[0.3, None] if alpha else None)
        again = plan.with_values(other)
        fresh = TrigSpline(other, alpha=alpha, gamma=[0.3, None] if alpha else None)
        t = np.linspace(-1, 6, 50)
        np.testing.assert_array_equal(again.jet(t, 3), fresh.jet(t, 3))
        assert again.labels == ("x", "z")
        assert miss(again) <= 1e-12


def test_with_values_may_free_an_entry():
    plan = TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)], alpha=1.0)
    points = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, None, 0)]
    t = np.linspace(0, 1, 11)
    np.testing.assert_array_equal(plan.with_values(points)(t), TrigSpline(points, alpha=1.0)(t))


@pytest.mark.parametrize("alpha", [0.0, 1.0, 4.0])
def test_systems_that_amplify_rounding_are_never_taken_for_mild(alpha):
    """The bound by the squares of the inverse decides as the amplification itself, written out here."""
    rng, seen = np.random.default_rng(7), set()
    for count in range(2, 7):
        for shortest in (1e-4, 1e-2, 0.2):
            times = np.cumsum(np.append(0.0, rng.uniform(shortest, 1.0, count - 1)))
            times[1:-1] *= rng.uniform(0.1, 1.0)
            system = NewtonSystem(alpha, times / times[-1], ((0, 1, 2),) * count)
            triangle = np.tril(system._triangle)
            triangle = triangle / np.abs(triangle).max(axis=0)
            amplification = (np.abs(np.linalg.inv(triangle)) @ np.abs(triangle)).max()
            if abs(amplification / 1e5 - 1.0) < 1e-3:
                continue  # within rounding of the limit
            assert system._is_mild == (amplification < 1e5)
            seen.add(system._is_mild)
    assert seen == {False, True}


@pytest.mark.parametrize("alpha", [0.0, 1.0, 2.9, 3.1, 5.0])
def test_waypoints_are_used_in_leja_order(alpha):
    """Each has the largest product of distances on the circle to those before, of all that are left."""
    rng = np.random.default_rng(3)
    for count in (2, 3, 4, 6, 9):
        times = np.array([0.0, *np.sort(rng.uniform(0.05, 0.95, count - 2)), 1.0])
        found = NewtonSystem(alpha, times, ((0,),) * count).waypoint_index.tolist()
        apart = np.subtract.outer(times, times)
        apart = np.abs(np.sin(0.5 * alpha * apart)) if alpha else np.abs(apart)
        assert found[0] == 0
        assert sorted(found) == list(range(count))
        for k in range(1, count):
            products = np.log(apart[found[k:]][:, found[:k]]).sum(axis=1)
            assert products.argmax() == 0
