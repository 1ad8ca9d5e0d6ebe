"""Piecewise splines through many waypoints: the splines of scipy, from arrays, with memory that grows linearly."""

import itertools
import tracemalloc

import mpmath
import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_interp_spline

from ctrlplan.trajectories import PiecewiseSpline, Waypoint, load_trajectory

pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

FREE = np.nan


def data(n, naxes=3, spread=1.0, seed=0):
    rng = np.random.default_rng(seed)
    return np.cumsum(np.exp(rng.uniform(-spread, spread, n))), rng.normal(size=(naxes, n))


def ends_only(n, value=0.0):
    row = np.full(n, FREE)
    row[[0, -1]] = value
    return row


def at_rest(n, highest):
    return {k: ends_only(n) for k in range(1, highest + 1)}


@pytest.mark.parametrize(("degree", "n"), [(3, 1000), (5, 17), (5, 1000), (7, 300)])
def test_free_entries_give_the_spline_of_scipy(degree, n):
    highest = degree // 2
    times, values = data(n, spread=0.5)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(n, highest))
    ends = [(k, np.zeros(3)) for k in range(1, highest + 1)]
    spline = make_interp_spline(times, values.T, k=degree, bc_type=(ends, ends))
    t = np.sort(np.random.default_rng(1).uniform(times[0], times[-1], 5000))
    for nu in range(highest + 1):
        wanted = spline(t, nu).T
        assert np.abs(plan(t, nu) - wanted).max() <= 1e-12 * np.abs(wanted).max()


def test_a_prescribed_velocity_separates_two_splines():
    times, values = data(500, 2)
    velocity = ends_only(500)
    velocity[250] = 0.7
    plan = PiecewiseSpline.from_arrays(times, values, derivatives={1: velocity})
    t = np.linspace(times[0], times[-1], 4001)
    for part, bounds in ((slice(0, 251), ((1, 0.0), (1, 0.7))), (slice(250, 500), ((1, 0.7), (1, 0.0)))):
        inside = t[(t >= times[part][0]) & (t < times[part][-1])]
        for axis in range(2):
            wanted = CubicSpline(times[part], values[axis, part], bc_type=bounds)(inside)
            assert np.abs(plan(inside)[axis] - wanted).max() <= 1e-12 * np.abs(wanted).max()


def test_arrays_and_waypoints_give_the_same_plan():
    times, values = data(60, 2)
    velocity, acceleration = ends_only(60), ends_only(60, 0.5)
    velocity[7] = 1.0
    velocity = np.stack([velocity, velocity])
    velocity[1, 30] = -2.0  # free entries that differ between the axes
    plan = PiecewiseSpline.from_arrays(
        times, values, derivatives={2: acceleration, 1: velocity}, labels=["x", "z"], alpha=0.5
    )
    points = [Waypoint(t, y, v, [a, a]) for t, y, v, a in zip(times, values.T, velocity.T, acceleration, strict=True)]
    other = PiecewiseSpline(points, labels=["x", "z"], alpha=0.5)
    t = np.linspace(times[0], times[-1], 777)
    np.testing.assert_array_equal(plan.jet(t, 4), other.jet(t, 4))
    assert plan.labels == ("x", "z")
    assert len(plan.waypoints) == 60
    assert plan.waypoints[7].velocity.tolist() == [1.0, 1.0]
    assert np.isnan(plan.waypoints[30].velocity[0])
    assert plan.waypoints[30].velocity[1] == -2.0


def test_all_entries_given_are_quintics():
    times, values = data(400)
    rng = np.random.default_rng(3)
    v, a = rng.normal(size=(2, 3, 400))
    plan = PiecewiseSpline.from_arrays(times, values, derivatives={1: v, 2: a})
    # Hermite quintic in the middle of a segment, in closed form.
    h = np.diff(times)
    before, after = (slice(None), slice(None, -1)), (slice(None), slice(1, None))
    terms = [
        values[before] / 2,
        values[after] / 2,
        5 * h * v[before] / 32,
        -5 * h * v[after] / 32,
        h**2 * a[before] / 64,
        h**2 * a[after] / 64,
    ]
    got = np.stack([plan.segment_jet(k, h[k : k + 1] / 2, 0)[0, :, 0] for k in range(399)], axis=1)
    size = np.abs(terms).sum(axis=0)
    assert (np.abs(got - sum(terms)) <= 32 * np.finfo(float).eps * size).all()


def exact_spline(times, values, size):
    """Entries (n, size) of the spline of minimum int (y^(size))^2 from rest to rest, in 60 digits, by its own band.

    Unknown: all derivatives below order 2 size at the start of each segment; equations: Taylor polynomials meet.
    """
    n, m = len(times), 2 * size
    with mpmath.workdps(60):
        # Response of the chain x^(m) = 0 over a segment, from its start; boundary values by shooting on blocks is
        # unstable, so that the equations of the free entries are assembled by the energy's Hessian instead.
        gram = mpmath.zeros((n - 2) * (size - 1))
        right = mpmath.zeros((n - 2) * (size - 1), 1)
        for i, (t0, t1) in enumerate(itertools.pairwise(times)):
            h = mpmath.mpf(float(t1)) - mpmath.mpf(float(t0))
            hermite = mpmath.zeros(m)
            for k in range(size):
                hermite[k, k] = mpmath.factorial(k)
                for j in range(k, m):
                    hermite[size + k, j] = mpmath.ff(j, k) * h ** (j - k)
            inverse = hermite**-1
            energy = mpmath.zeros(m)
            for p in range(size, m):
                for q in range(size, m):
                    power = p + q - 2 * size + 1
                    energy[p, q] = mpmath.ff(p, size) * mpmath.ff(q, size) * h**power / power
            own = inverse.T * energy * inverse
            known = [mpmath.mpf(float(values[i + e])) if k == 0 else mpmath.mpf(0) for e in (0, 1) for k in range(size)]
            place = [
                (i + e - 1) * (size - 1) + k - 1 if k and 0 < i + e < n - 1 else -1 for e in (0, 1) for k in range(size)
            ]
            for a, r in enumerate(place):
                for b, c in enumerate(place):
                    if r >= 0 and c >= 0:
                        gram[r, c] += own[a, b]
                    elif r >= 0:
                        right[r] -= own[a, b] * known[b]
        solved = mpmath.lu_solve(gram, right)
        found = np.zeros((n, size))
        found[:, 0] = values
        for i in range(1, n - 1):
            found[i, 1:] = [float(solved[(i - 1) * (size - 1) + k]) for k in range(size - 1)]
    return found


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1e-1, 1 / 40, 1e-4, 1e-8])
def test_segments_of_very_different_durations_keep_their_digits(ratio, monkeypatch):
    """Extended precision, which long plans use, against 60 digits."""
    monkeypatch.setattr("ctrlplan.trajectories.conjugate._DECIMALS", 0)
    rng = np.random.default_rng(2)
    times = np.cumsum(np.where(rng.uniform(size=24) < 0.3, ratio, 1.0))
    values = rng.normal(size=24)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(24, 2))
    exact = exact_spline(times, values, 3)
    got = plan.jet(times, 2)[:, 0].T
    local = np.minimum(np.append(np.inf, np.diff(times)), np.append(np.diff(times), np.inf))
    for k in range(3):
        # To the peak of each derivative; and at each waypoint to the size nearby, as far as the positions determine it.
        assert np.abs(got[:, k] - exact[:, k]).max() <= 1e-13 * np.abs(exact[:, k]).max()
        near = np.abs(np.pad(exact[:, k], 1, mode="edge"))
        near = np.maximum(np.maximum(near[:-2], near[2:]), near[1:-1])
        slack = 1e-13 * near + 1e-14 * np.abs(values).max() / local**k
        assert (np.abs(got[:, k] - exact[:, k]) <= slack).all()
    right, left = plan.jet(times[1:-1], 4), plan.jet(times[1:-1], 4, left=True)
    assert (np.abs(right - left) <= 1e-12 * np.abs(right).max(axis=2, keepdims=True)).all()


@pytest.mark.slow
def test_random_times_of_thirty_points_are_determined():
    """Three of fifty such sets counted as undetermined where all segments had one unit of time."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        times = np.sort(rng.uniform(size=30))
        plan = PiecewiseSpline.from_arrays(times, rng.normal(size=30), derivatives=at_rest(30, 3))
        size = np.abs(plan.jet(times, 6)).max(axis=2, keepdims=True)
        jump = np.abs(plan.jet(times[1:-1], 6) - plan.jet(times[1:-1], 6, left=True))
        assert (jump <= 1e-11 * size).all()


def test_trigonometric_segments_meet_their_conditions():
    times, values = data(300, 2)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(300, 2), alpha=2.0)
    assert np.abs(plan(times) - values).max() <= 1e-14 * np.abs(values).max()
    right, left = plan.jet(times[1:-1], 4), plan.jet(times[1:-1], 4, left=True)
    assert (np.abs(right - left) <= 1e-11 * np.abs(right).max(axis=2, keepdims=True)).all()


def grown(build, few, many):
    """Ratio of the peak memory of two sizes."""
    peaks = []
    for n in (few, many):
        build(n)  # tables that depend on no data
        tracemalloc.start()
        build(n)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return peaks[1] / peaks[0]


def test_memory_grows_linearly():
    def build(n):
        times, values = data(n)
        return PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(n, 2))

    assert grown(build, 200, 2000) <= 11.0


def test_one_time_touches_one_segment(monkeypatch):
    times, values = data(2000)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(2000, 2))
    touched = []
    before = type(plan).segment_rows
    monkeypatch.setattr(
        type(plan), "segment_rows", lambda self, k, s, order: touched.append(k) or before(self, k, s, order)
    )
    jet = plan.jet(0.5 * (times[700] + times[701]), 2)
    assert touched == [700]
    many = plan.jet(np.array([0.5 * (times[700] + times[701]), times[3]]), 2)
    assert np.abs(many[..., 0] - jet).max() <= 1e-14 * np.abs(jet).max()


@pytest.mark.parametrize("alpha", [0.0, 1.5])
@pytest.mark.parametrize("order", ["sorted", "random"])
def test_many_times_are_those_of_the_segments(alpha, order):
    times, values = data(400, 2)
    given = at_rest(400, 2)
    given[1] = np.stack([given[1], given[1]])
    given[1][0, 5] = 1.0  # two patterns
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=given, alpha=alpha)
    t = np.random.default_rng(0).uniform(times[0] - 1.0, times[-1] + 1.0, 3000)
    t[:400] = times
    t = np.sort(t) if order == "sorted" else t
    found = plan.jet(t, 3)
    singly = np.stack([plan.jet(x, 3) for x in t.tolist()], axis=2)
    assert (np.abs(found - singly) <= 1e-13 * np.abs(singly).max(axis=2, keepdims=True)).all()
    assert np.array_equal(plan.jet(t, 3, left=True)[:, :, t < times[0]], found[:, :, t < times[0]])


def test_new_values_reuse_the_equations(monkeypatch):
    times, values = data(200)
    given = at_rest(200, 2)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=given)
    other = np.random.default_rng(9).normal(size=values.shape)
    wanted = PiecewiseSpline.from_arrays(times, other, derivatives=given)
    monkeypatch.setattr("ctrlplan.trajectories.conjugate._Banded", None)
    t = np.linspace(times[0], times[-1], 500)
    np.testing.assert_array_equal(plan.with_values(other, derivatives=given).jet(t, 3), wanted.jet(t, 3))
    np.testing.assert_array_equal(plan.with_values(wanted.waypoints).jet(t, 3), wanted.jet(t, 3))


def test_a_closed_spline_is_the_periodic_one_of_scipy():
    times, values = data(40, 2, spread=0.5)
    period = float(times[-1] - times[0] + 0.8)
    points = [Waypoint(t, y, None) for t, y in zip(times, values.T, strict=True)]
    # An order that no waypoint prescribes is not continuous: one of them has the velocity of the periodic spline.
    whole, closed = np.append(times, times[0] + period), np.column_stack([values, values[:, :1]])
    spline = CubicSpline(whole, closed.T, bc_type="periodic")
    points[11] = Waypoint(times[11], values[:, 11], spline(times[11], 1))
    plan = PiecewiseSpline.cyclic(points, period)
    t = np.linspace(whole[0], whole[-1], 901)
    for nu in range(3):
        wanted = spline(t, nu).T
        assert np.abs(plan(t, nu) - wanted).max() <= 1e-11 * np.abs(wanted).max()
    assert (plan.end, plan.breakpoints.size) == (whole[-1], 41)


@pytest.mark.parametrize("alpha", [0.0, 1.0])
@pytest.mark.parametrize("n", [2, 3, 6, 7])
def test_a_cam_closes_with_all_free_derivatives(n, alpha):
    times, values = data(n, 1, seed=n)
    points = [Waypoint(t, y, None, None) for t, y in zip(times, values[0], strict=True)]
    points[0] = Waypoint(times[0], values[0, 0], 0.3, -1.0)
    plan = PiecewiseSpline.cyclic(points, float(times[-1] - times[0] + 1.1), alpha=alpha)
    size = np.abs(plan.jet(np.linspace(plan.start, plan.end, 301), 4)).max(axis=2)[:, 0]
    ends = np.abs(plan.jet(plan.end, 4) - plan.jet(plan.start, 4))[:, 0]
    assert (ends[:3] <= 1e-12 * size[:3]).all()  # the first waypoint prescribes all three
    inner = np.abs(plan.jet(times[1:], 4) - plan.jet(times[1:], 4, left=True))[:, 0]
    assert (inner <= 1e-11 * size[:, None]).all()
    twice = plan.then(plan)
    assert twice(plan.end + 0.4) == pytest.approx(plan(plan.start + 0.4), abs=1e-13)


def exact_closed_spline(times, period, table):
    """Power coefficients (nsegments, 2 size) by time since the start of each segment, in 60 digits, from one system.

    Each segment meets the prescribed entries (n, size); free ones and their conjugates are continuous.
    """
    n, size = table.shape
    with mpmath.workdps(60):
        moments = [mpmath.mpf(float(t)) for t in times]
        h = [b - a for a, b in itertools.pairwise([*moments, moments[0] + mpmath.mpf(period)])]
        m = 2 * size
        matrix, right = mpmath.zeros(n * m), mpmath.zeros(n * m, 1)

        def add(row, k, end, order, sign):
            """Derivative of segment k at an end, in its own unit of time."""
            for j in range(order, m):
                matrix[row, k * m + j] += sign * mpmath.ff(j, order) / h[k] ** order * (1 if end or j == order else 0)

        row = 0
        for i in range(n):
            for order in range(size):
                if np.isnan(table[i, order]):
                    for joined in (order, m - 1 - order):
                        add(row, i - 1 if i else n - 1, 1, joined, 1)
                        add(row, i, 0, joined, -1)
                        row += 1
                else:
                    for k, end in ((i - 1 if i else n - 1, 1), (i, 0)):
                        add(row, k, end, order, 1)
                        right[row] = mpmath.mpf(float(table[i, order]))
                        row += 1
        solved = mpmath.lu_solve(matrix, right)
        return [[solved[k * m + j] / h[k] ** j for j in range(m)] for k in range(n)]


@pytest.mark.parametrize("ratio", [1e-3, 1e-7])
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_a_closed_plan_with_very_different_durations_keeps_its_digits(ratio, unit):
    times = unit * np.array([0.3, 1.3, 1.3 + ratio, 2.6])
    table = np.full((4, 3), FREE)
    table[:, 0] = [0.2, -1.0, 0.5, 1.5]
    table[2, 2] = -0.7 / unit**2
    table[3, 1] = 0.1 / unit
    period = 4.0 * unit
    points = [Waypoint.from_array(t, jet[:, None].copy(), None) for t, jet in zip(times, table, strict=True)]
    plan = PiecewiseSpline.cyclic(points, period)
    exact = exact_closed_spline(times, period, table)
    got, wanted = [], []
    for k, h in enumerate(np.diff(plan.breakpoints).tolist()):
        for s in (0.0, 0.3 * h, 0.8 * h):
            got.append(plan.segment_jet(k, np.array([s]), 2)[:, 0, 0])
            with mpmath.workdps(60):
                powers = [
                    [mpmath.ff(j, nu) * c * mpmath.mpf(s) ** (j - nu) for j, c in enumerate(exact[k]) if j >= nu]
                    for nu in range(3)
                ]
                wanted.append([float(mpmath.fsum(terms)) for terms in powers])
    got, wanted = np.array(got), np.array(wanted)
    assert (np.abs(got - wanted).max(axis=0) <= 1e-14 * np.abs(wanted).max(axis=0)).all()


def test_new_values_with_other_free_entries_are_those_of_a_new_plan():
    times, values = data(30, 2)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(30, 2), labels=["x", "z"])
    other = np.random.default_rng(4).normal(size=values.shape)
    mixed = at_rest(30, 2)
    mixed[1] = np.stack([mixed[1], mixed[1]])
    mixed[1][1, 7] = 0.5
    t = np.linspace(times[0], times[-1], 333)
    for given in (mixed, at_rest(30, 1), {1: 0.0, 2: 0.0}, at_rest(30, 2)):
        got = plan.with_values(other, derivatives=given)
        wanted = PiecewiseSpline.from_arrays(times, other, derivatives=given)
        np.testing.assert_array_equal(got.jet(t, 3), wanted.jet(t, 3))
        assert got.labels == ("x", "z")


def test_plans_from_arrays_and_waypoints_are_equal(tmp_path):
    """Orders above those prescribed are free, whether an array has them or not."""
    times, values = data(6, 2)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(6, 2))
    rest = [[0.0, 0.0]] * 2
    points = [
        Waypoint(t, y, *(rest if i in (0, 5) else [])) for i, (t, y) in enumerate(zip(times, values.T, strict=True))
    ]
    other = PiecewiseSpline(points)
    assert plan == other
    assert hash(plan) == hash(other)
    assert plan.waypoints == other.waypoints
    plan.save(tmp_path / "plan.json")
    loaded = load_trajectory(tmp_path / "plan.json")
    assert loaded == plan
    t = np.linspace(times[0], times[-1], 77)
    np.testing.assert_array_equal(loaded.jet(t, 3), plan.jet(t, 3))
    assert plan != PiecewiseSpline([*points[:-1], Waypoint(times[-1], values[:, -1], 0.0)])


def test_names_given_with_arrays_are_those_of_the_waypoints():
    points = [Waypoint.from_jets(float(k), x=[k, 0.0], z=[1.0, 0.0]) for k in range(3)]
    named = PiecewiseSpline(points)
    positions = np.array([[0.0, 1.0, 2.0], [1.0, 1.0, 1.0]])
    plan = PiecewiseSpline.from_arrays([0.0, 1.0, 2.0], positions, derivatives={1: 0.0}, labels=["x", "z"])
    for one in (plan, plan.with_values(positions, derivatives={1: 0.0}), named.with_values(points)):
        assert one == named
        assert one.labels == ("x", "z")
        assert one.waypoints == named.waypoints == tuple(points)
    assert named.with_values(positions, derivatives={1: 0.0}).waypoints == tuple(points)
    assert plan.retime(5.0).waypoints[0].labels == ("x", "z")
    with pytest.raises(ValueError, match="values must keep the number of axes, 2, got 1"):
        plan.with_values(np.zeros(3))


def test_times_without_a_finite_duration_are_rejected():
    """Each segment has one, but `duration`, `retime` and a grid of times require that of the plan."""
    with pytest.raises(ValueError, match=r"duration must be finite and above 0, got 1e.308 s after -1e.308 s"):
        PiecewiseSpline.from_arrays([-1e308, 0.0, 1e308], [0.0, 1.0, 0.0])
    with pytest.raises(ValueError, match=r"duration must be finite and above 0, got inf s after 1e.308 s"):
        PiecewiseSpline.cyclic([Waypoint(1e308, 0.0), Waypoint(1.1e308, 1.0)], 1e308)


def test_waypoints_of_a_plan_cannot_change_it():
    times, values = data(5, 2)
    given = at_rest(5, 2)
    given[1][2] = 0.25
    points = PiecewiseSpline.from_arrays(times, values, derivatives=given).waypoints
    assert [point.complete for point in points] == [True, False, False, False, True]
    assert points[2] == Waypoint(times[2], values[:, 2], [0.25, 0.25], [FREE, FREE])
    with pytest.raises(ValueError, match="read-only"):
        points[0].jet[0, 0] = 1.0
    again = PiecewiseSpline(points)  # the jets are parts of one table
    t = np.linspace(times[0], times[-1], 55)
    wanted = PiecewiseSpline([Waypoint(p.time, *p.jet) for p in points])
    np.testing.assert_array_equal(again.jet(t, 2), wanted.jet(t, 2))


@pytest.mark.parametrize("n", [4, 60])
@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_few_times_give_entries_of_waypoints_in_every_bit(n, alpha):
    """As a single time and very many do; axes with different free entries are evaluated apart."""
    times, values = data(n, 2)
    velocity = np.stack([ends_only(n), np.linspace(-0.3, 0.7, n)])
    given = {1: velocity, 2: ends_only(n)}
    rng = np.random.default_rng(2)
    for chosen in ({1: velocity[1], 2: velocity[1]}, at_rest(n, 2), given):
        plan = PiecewiseSpline.from_arrays(times, values, derivatives=chosen, alpha=alpha)
        table = np.stack([values, *(np.broadcast_to(chosen[k], values.shape) for k in (1, 2))])
        for where in (np.arange(1, 3), rng.permutation(n), np.repeat(np.arange(n), 2)):
            for left in (False, True):
                where = where[where > 0] if left else where  # a plan is at rest before its start
                own, known = plan.jet(times[where], 2, left=left), table[:, :, where]
                assert ((own == known) | np.isnan(known)).all()
                np.testing.assert_array_equal(plan(times[where], 1), plan.jet(times[where], 2)[1])
                for i, moment in zip(where[:3], times[where[:3]].tolist(), strict=True):
                    one = plan.jet(moment, 2, left=left)
                    assert ((one == table[:, :, i]) | np.isnan(table[:, :, i])).all()


@pytest.mark.parametrize("n", [4, 60])
def test_few_times_next_to_waypoints_stay_as_they_are(n):
    """Neighbours of a waypoint in floating point are not replaced by it."""
    times, values = data(n, 1)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives={1: 2.0, 2: 0.0})
    t = np.sort(np.concatenate([np.nextafter(times[1:-1], side) for side in (-np.inf, np.inf)]))
    moves = plan.jet(t, 1)[0, 0] - np.repeat(values[0, 1:-1], 2)
    slack = 8.0 * np.finfo(float).eps * np.abs(values).max()
    assert (np.abs(moves - 2.0 * (t - np.repeat(times[1:-1], 2))) <= slack).all()


def test_times_before_and_after_a_plan_change_no_others():
    times, values = data(60, 2)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(60, 2))
    inside = np.linspace(times[0], times[-1], 200)[1:-1]
    t = np.random.default_rng(0).permutation(np.concatenate([times[0] - [2.0, 0.5], inside, times[-1] + [0.5, 3.0]]))
    for left in (False, True):
        jet = plan.jet(t, 2, left=left)
        within = (t > times[0]) & (t < times[-1])
        np.testing.assert_array_equal(jet[:, :, within], plan.jet(t[within], 2, left=left))
        held = np.where(t[~within] < times[0], values[:, :1], values[:, -1:])
        np.testing.assert_array_equal(jet[0][:, ~within], held)
        assert not jet[1:][:, :, ~within].any()


def test_combined_plans_of_many_segments_are_combinations_of_their_jets():
    times, values = data(60, 2)
    plan, other = (PiecewiseSpline.from_arrays(times, y, derivatives=at_rest(60, 2)) for y in (values, values[::-1]))
    t = np.sort(np.append(np.linspace(times[0] - 1.0, times[-1] + 1.0, 300), times))
    for left in (False, True):
        one, two = plan.jet(t, 3, left=left), other.jet(t, 3, left=left)
        np.testing.assert_array_equal(plan.select(["y2"]).jet(t, 3, left=left), one[:, 1:])
        np.testing.assert_array_equal((plan + other).jet(t, 3, left=left), one + two)
        np.testing.assert_array_equal((2.5 * plan).jet(t, 3, left=left), 2.5 * one)


def test_a_closed_plan_is_saved_and_retimed(tmp_path):
    points = [Waypoint(0.0, 0.0, 0.0), Waypoint(1.0, 1.0), Waypoint(2.5, -1.0)]
    plan = PiecewiseSpline.cyclic(points, 4.0)
    plan.save(tmp_path / "cam.json")
    t = np.linspace(0.0, 4.0, 57)
    np.testing.assert_array_equal(load_trajectory(tmp_path / "cam.json").jet(t, 3), plan.jet(t, 3))
    slow = plan.retime(8.0)
    assert slow.end == 8.0
    np.testing.assert_allclose(slow(2.0 * t, 1), plan(t, 1) / 2.0, rtol=0, atol=1e-14 * plan.peak(1).max())
    again = plan.with_values([Waypoint(p.time, 2.0 * p.position, p.velocity) for p in plan.waypoints])
    np.testing.assert_allclose(again(t), 2.0 * plan(t), rtol=0, atol=1e-14)
    assert "period" in str(plan)


WRONG = [
    ({"times": [0.0, 1.0, 1.0]}, ValueError, r"times must increase strictly, got times\[2\] = 1.0 after times\[1\]"),
    ({"times": [0.0, 2.0, 1.0]}, ValueError, "times must increase strictly"),
    ({"times": [0.0, np.nan, 1.0]}, ValueError, "times must be two or more finite times"),
    ({"times": [0.0]}, ValueError, "times must be two or more finite times"),
    ({"times": ["a", "b", "c"]}, TypeError, "times must be real numbers"),
    ({"values": [0.0, 1.0]}, ValueError, r"values must have shape \(naxes, 3\) or \(3,\) as times, got \(2,\)"),
    ({"values": np.zeros((0, 3))}, ValueError, "values must have shape"),
    ({"values": [0.0, np.inf, 1.0]}, ValueError, r"values must be finite or nan \(free\), got inf at times\[1\]"),
    ({"values": [0.0, "x", 1.0]}, TypeError, "values must be real numbers"),
    ({"derivatives": {1: [0.0, 1.0]}}, ValueError, r"derivatives\[1\] must be a number or have shape \(3,\)"),
    ({"derivatives": {0: 0.0}}, ValueError, "order of derivatives must be an integer of at least 1"),
    ({"derivatives": {"v": 0.0}}, TypeError, "order of derivatives must be an integer"),
    ({"derivatives": {2: [0.0, -np.inf, 1.0]}}, ValueError, r"derivatives\[2\] must be finite or nan"),
    ({"alpha": 7.0}, ValueError, r"alpha must lie in \[0, 2 pi\)"),
    ({"labels": ["a", "b"]}, ValueError, "labels must be one per axis"),
]


@pytest.mark.parametrize(("change", "error", "message"), WRONG)
def test_wrong_arrays_are_rejected(change, error, message):
    arguments = {"times": [0.0, 1.0, 2.0], "values": [0.0, 1.0, 0.0], "derivatives": {1: 0.0}} | change
    times, values = arguments.pop("times"), arguments.pop("values")
    with pytest.raises(error, match=message):
        PiecewiseSpline.from_arrays(times, values, **arguments)


def test_new_values_of_another_shape_are_rejected():
    plan = PiecewiseSpline.from_arrays([0.0, 1.0, 2.0], np.zeros((2, 3)), derivatives={1: 0.0})
    with pytest.raises(ValueError, match="values must keep the number of axes, 2, got 1"):
        plan.with_values(np.zeros(3))
    with pytest.raises(ValueError, match="values must have shape"):
        plan.with_values(np.zeros((2, 4)))
    with pytest.raises(TypeError, match="derivatives must be given with an array of positions"):
        plan.with_values(plan.waypoints, derivatives={1: 0.0})
    with pytest.raises(TypeError, match=r"as np.array\(\[...\]\), got a list"):
        plan.with_values([[0.0] * 3] * 2, derivatives={1: 0.0})


def test_the_arrays_are_copied():
    times, values, rest = np.arange(4.0), np.zeros(4), np.zeros(4)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives={1: rest})
    times[1], values[:], rest[:] = 9.0, 7.0, 5.0
    assert plan.breakpoints.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert not plan(np.linspace(0, 3, 7)).any()


@pytest.mark.parametrize("period", [1.0, 0.5])
def test_a_period_shorter_than_the_waypoints_is_rejected(period):
    with pytest.raises(ValueError, match="waypoints of a cyclic plan must lie within one period"):
        PiecewiseSpline.cyclic([Waypoint(0.0, 0.0), Waypoint(1.0, 1.0)], period)


def test_a_closed_plan_with_undetermined_entries_is_rejected():
    with pytest.raises(ValueError, match="must be determined by the prescribed ones"):
        PiecewiseSpline.cyclic([Waypoint(0.0, np.nan, 1.0), Waypoint(1.0, np.nan, 1.0)], 2.0)
    with pytest.raises(ValueError, match="got an axis without any prescribed position"):
        PiecewiseSpline.from_arrays([0.0, 1.0, 2.0], [[0.0, 1.0, 2.0], [FREE] * 3], derivatives={1: 0.0})
    with pytest.raises(ValueError, match=r"alpha must be a number in \[0, 2 pi\) here"):
        PiecewiseSpline.cyclic([Waypoint(0.0, 0.0), Waypoint(1.0, 1.0)], 2.0, alpha="auto")


def test_derivatives_that_are_no_mapping_are_rejected():
    with pytest.raises(TypeError, match="derivatives must be a mapping of orders to arrays, got 5"):
        PiecewiseSpline.from_arrays([0.0, 1.0], [0.0, 1.0], derivatives=5)


def test_a_swing_between_many_points_warns():
    times = np.arange(600.0)
    times[300] = times[299] + 0.03
    values = np.zeros(600)
    values[300] = 1.0
    with pytest.warns(UserWarning, match="the plan swings over"):
        PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(600, 1))


@pytest.mark.parametrize("nu", range(7))
def test_extrema_of_many_segments_are_those_of_each(nu):
    times, values = data(120, 2, spread=0.5)
    given = at_rest(120, 2)
    given[2] = np.stack([given[2], given[2]])
    given[2][1, 40] = 30.0
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=given)
    found = plan.extrema(nu)
    for k in range(119):
        t = np.linspace(0.0, times[k + 1] - times[k], 401)
        inside = plan.segment_jet(k, t, nu)[nu]
        slack = 1e-12 * np.abs(inside).max(axis=1)
        assert (inside.max(axis=1) <= found.maximum + slack).all()
        assert (inside.min(axis=1) >= found.minimum - slack).all()
    for axis in range(2):
        for value, time in ((found.minimum[axis], found.time_min[axis]), (found.maximum[axis], found.time_max[axis])):
            sides = [plan.jet(time, nu, left=left)[nu, axis] for left in (False, True)]
            assert min(abs(side - value) for side in sides) <= 1e-9 * max(abs(value), 1e-300)


def test_equal_extrema_are_found_at_the_earliest_time():
    times = np.arange(101.0)
    plan = PiecewiseSpline.from_arrays(times, times % 2.0, derivatives={1: 0.0, 2: 0.0})
    found = plan.extrema(1)
    assert (found.time_max[0], found.time_min[0]) == (0.5, 1.5)
    assert found.maximum[0] == pytest.approx(15.0 / 8.0, rel=1e-14)
    assert plan.extrema(0).time_max[0] == 1.0


def test_only_segments_that_can_hold_an_extremum_are_searched(monkeypatch):
    times, values = data(1000, 1)
    plan = PiecewiseSpline.from_arrays(times, values, derivatives=at_rest(1000, 2))
    searched = []
    before, durations = PiecewiseSpline.segments_jet, np.diff(times)
    monkeypatch.setattr(
        PiecewiseSpline,
        "segments_jet",
        lambda self, k, s, order: searched.extend(k[(s > 0.0) & (s < durations[k])]) or before(self, k, s, order),
    )
    plan.extrema(1)
    assert 1 <= len(set(searched)) <= 20


# Dwells

TURN = [
    Waypoint(0, 0.1, 0, 0),
    Waypoint(1, 5.3, 0, 0),
    Waypoint(2.5, 5.3, 0, 0),
    Waypoint(3, 1.7),
    Waypoint(4, 0.1, 0, 0),
]


@pytest.mark.parametrize("alpha", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["waypoints", "cyclic", "arrays", "repeated"])
def test_a_dwell_is_constant_between_segments_that_are_not(kind, alpha):
    """To rounding; the neighbours, one with free derivatives, join with continuous accelerations."""
    if kind == "arrays":
        free = np.array([0.0, 0.0, 0.0, np.nan, 0.0])
        plan = PiecewiseSpline.from_arrays(
            [0, 1, 2.5, 3, 4], [0.1, 5.3, 5.3, 1.7, 0.1], derivatives={1: free, 2: free}, alpha=alpha, warn=False
        )
    elif kind == "cyclic":
        plan = PiecewiseSpline.cyclic(TURN[:-1], 4.0, alpha=alpha, warn=False)
    else:
        plan = PiecewiseSpline(TURN, alpha=alpha, warn=False)
    plan = plan.repeat(None) if kind == "repeated" else plan
    for begin in (0.0, 4000.0) if kind == "repeated" else (0.0,):
        jet = plan.jet(np.linspace(begin + 1.0, begin + 2.499, 501), 4)[:, 0]
        assert np.abs(jet[0] - 5.3).max() <= 1e-14 * 5.3
        assert np.abs(jet[1:]).max() <= 1e-12
    assert [jump for jump in plan.jumps(2) if 0 < jump.time < 4] == []
    assert abs(plan(2.6) - 5.3) > 1e-3


@pytest.mark.parametrize(
    "arrays",
    [{"values": [True, False]}, {"values": [0.0, 1.0], "derivatives": {1: [True, False]}}],
)
def test_truth_values_are_no_entries(arrays):
    with pytest.raises(TypeError, match="must be numbers, got truth values"):
        PiecewiseSpline.from_arrays([0.0, 1.0], **arrays)
