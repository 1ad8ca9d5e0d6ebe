"""Free entries and times: minimum squared derivative, against exact and independent solutions."""

import itertools
import math
import warnings

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.integrate import quad
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.optimize import brentq, minimize, minimize_scalar

from ctrlplan.planning.optimize import optimize_waypoints
from ctrlplan.trajectories import (
    Joined,
    PiecewiseSpline,
    PolySpline,
    TrigSpline,
    Waypoint,
    load_trajectory,
)

FREE = math.nan


def points_of(times, table):
    """Waypoints from entries (nwaypoints, nentries, naxes)."""
    axes = range(np.shape(table)[2])
    return [
        Waypoint.from_jets(t, **{f"q{a}": np.asarray(jet)[:, a] for a in axes})
        for t, jet in zip(times, table, strict=True)
    ]


def random_table(rng, n, size, naxes, ends=None):
    """Positions everywhere, and derivatives of the first `ends` orders at both ends."""
    table = np.full((n, size, naxes), FREE)
    table[:, 0] = rng.normal(size=(n, naxes))
    known = size if ends is None else ends
    table[[0, -1], 1:known] = rng.normal(size=(2, known - 1, naxes))
    return table


def energy(plan, k, weights=None):
    """Integral of the squared k-th derivative, by many Gauss nodes a segment."""
    nodes, gauss = np.polynomial.legendre.leggauss(60)
    plan = plan.shift(-plan.start)
    total = np.zeros(plan.naxes)
    for left, right in itertools.pairwise(plan.breakpoints):
        t = 0.5 * (left + right) + 0.5 * (right - left) * nodes
        total += 0.5 * (right - left) * (plan.jet(t, k)[k] ** 2 @ gauss)
    return float(total @ (np.ones(plan.naxes) if weights is None else weights))


class Quadratic:
    """The same quadratic program in monomials of each segment, its KKT equations solved with 60 digits; one axis."""

    def __init__(self, times, table, k, order, continuity):
        with mp.workdps(60):
            self.times = [mp.mpf(float(t)) for t in times]
            n, size = len(times), 2 * order + 2
            self.size = size
            unknowns = size * (n - 1)
            rows, right = [], []
            for i, j in itertools.product(range(n), range(order + 1)):
                here = [self.row(segment, self.times[i], j) for segment in (i - 1, i) if 0 <= segment < n - 1]
                value = table[i][j] if j < len(table[i]) else FREE
                if not math.isnan(value):
                    rows += here
                    right += [mp.mpf(float(value))] * len(here)
                elif j <= continuity and len(here) == 2:
                    rows.append([a - b for a, b in zip(*here, strict=True)])
                    right.append(mp.mpf(0))
            total = unknowns + len(rows)
            kkt, known = mp.zeros(total), mp.zeros(total, 1)
            for segment in range(n - 1):
                h = self.times[segment + 1] - self.times[segment]
                for a, b in itertools.product(range(k, size), repeat=2):
                    power = a + b - 2 * k + 1
                    kkt[segment * size + a, segment * size + b] = mp.ff(a, k) * mp.ff(b, k) * h**power / power
            for r, (row, value) in enumerate(zip(rows, right, strict=True), unknowns):
                known[r] = value
                for c, v in enumerate(row):
                    kkt[r, c] = kkt[c, r] = v
            solved = mp.lu_solve(kkt, known)
            self.coefficients = solved[:unknowns]
            hessian, found = kkt[:unknowns, :unknowns], mp.matrix(self.coefficients)
            self.cost = float((found.T * hessian * found)[0])

    def row(self, segment, t, j):
        out = [mp.mpf(0)] * (self.size * (len(self.times) - 1))
        for m in range(j, self.size):
            out[segment * self.size + m] = mp.ff(m, j) * (t - self.times[segment]) ** (m - j)
        return out

    def __call__(self, t, nu):
        with mp.workdps(60):
            found = np.searchsorted([float(v) for v in self.times], t, side="right") - 1
            segments = np.clip(found, 0, len(self.times) - 2)
            rows = [self.row(int(segment), mp.mpf(float(v)), nu) for segment, v in zip(segments, t, strict=True)]
            return np.array([float(mp.fdot(row, self.coefficients)) for row in rows])


def close(found, expected, tolerance):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


# Closed forms


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("duration", [1e-6, 0.7, 1.0, 1e6])
@pytest.mark.parametrize(("k", "constant"), [(1, 1.0), (2, 12.0), (3, 720.0), (4, 100800.0)])
def test_rest_to_rest_has_the_known_cost(k, constant, duration, single):
    rest = [0.0] * (k - 1)
    move = [Waypoint(3.0, 1.0, *rest), Waypoint(3.0 + duration, -1.5, *rest)]
    found = optimize_waypoints(move, k, single=single)
    exact = constant * 2.5**2 / (move[1].time - 3.0) ** (2 * k - 1)
    assert found.cost == pytest.approx(exact, rel=1e-12)
    assert found.unique
    assert found.waypoints == tuple(move)


def test_free_end_accelerations_have_the_known_costs():
    # The jerk is then a parabola, c s (1 - s) where both are free and (1 - s) (s - r) where the last is.
    one = optimize_waypoints([Waypoint(0, 0, 0, 0), Waypoint(2, 3, 0)])
    assert one.cost == pytest.approx(320 * 9 / 2**5, rel=1e-13)
    both = optimize_waypoints([Waypoint(0, 0, 0), Waypoint(2, 3, 0)])
    assert both.cost == pytest.approx(120 * 9 / 2**5, rel=1e-13)
    assert both.waypoints[0].acceleration == pytest.approx([5 * 3 / 2**2], rel=1e-13)


# Splines of scipy


@pytest.mark.parametrize("n", [2, 3, 8, 40])
def test_minimum_acceleration_is_the_natural_cubic_spline(n):
    rng = np.random.default_rng(n)
    times, values = np.cumsum(rng.uniform(0.1, 2.0, n)), rng.normal(size=(n, 2))
    found = optimize_waypoints([Waypoint(t, v) for t, v in zip(times, values, strict=True)], 2)
    spline = CubicSpline(times, values, bc_type="natural")
    t = np.linspace(times[0], times[-1], 201)
    assert isinstance(found.plan, PiecewiseSpline)
    assert found.unique
    for nu in range(3):
        scale = max(np.abs(spline(t, nu)).max(), 1e-2)
        np.testing.assert_allclose(found.plan(t, nu), spline(t, nu).T, rtol=0, atol=1e-11 * scale)


@pytest.mark.parametrize("n", [2, 3, 8, 40])
def test_minimum_acceleration_with_end_velocities_is_the_clamped_cubic_spline(n):
    rng = np.random.default_rng(n)
    times, values, (first, last) = np.cumsum(rng.uniform(0.1, 2.0, n)), rng.normal(size=n), rng.normal(size=2)
    points = [Waypoint(t, v) for t, v in zip(times, values, strict=True)]
    points[0], points[-1] = Waypoint(times[0], values[0], first), Waypoint(times[-1], values[-1], last)
    found = optimize_waypoints(points, 2)
    spline = CubicSpline(times, values, bc_type=((1, first), (1, last)))
    t = np.linspace(times[0], times[-1], 201)
    for nu in range(3):
        close(found.plan(t, nu), spline(t, nu), 1e-11)
    bends = spline(times, 2)
    exact = float(np.diff(times) @ (bends[1:] ** 2 + bends[1:] * bends[:-1] + bends[:-1] ** 2)) / 3.0
    assert found.cost == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("ends", ["natural", "clamped"])
@pytest.mark.parametrize("k", [3, 4])
def test_minimum_jerk_and_snap_are_the_splines_of_twice_the_order(k, ends):
    rng = np.random.default_rng(k)
    times, values, at_ends = np.cumsum(rng.uniform(0.5, 1.5, 8)), rng.normal(size=8), rng.normal(size=(2, k - 1))
    points = [Waypoint(t, v) for t, v in zip(times, values, strict=True)]
    if ends == "natural":
        conditions = [[(nu, 0.0) for nu in range(k, 2 * k - 1)]] * 2
    else:
        points[0], points[-1] = (Waypoint(times[i], values[i], *at_ends[i]) for i in (0, -1))
        conditions = [list(enumerate(jet, 1)) for jet in at_ends]
    found = optimize_waypoints(points, k)
    spline = make_interp_spline(times, values, k=2 * k - 1, bc_type=tuple(conditions))
    t = np.linspace(times[0], times[-1], 101)
    for nu in range(k + 1):
        close(found.plan(t, nu), spline(t, nu), 1e-9)


# Quadratic programs

PROGRAMS = [
    # n, k, order, continuity
    (4, 3, 2, 2),
    (4, 3, 3, 1),
    (3, 4, 3, 3),
    (3, 4, 3, 2),
    (4, 3, 2, 1),
    (3, 2, 4, 3),  # continuity above 2 k - 2
    (3, 2, 2, 0),
    (3, 1, 2, 2),
    pytest.param(4, 4, 3, 3, marks=pytest.mark.slow),
    pytest.param(6, 4, 3, 3, marks=pytest.mark.slow),
    pytest.param(5, 4, 4, 2, marks=pytest.mark.slow),
    pytest.param(4, 3, 6, 5, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("n", "k", "order", "continuity"), PROGRAMS)
def test_quadratic_programs_are_solved(n, k, order, continuity):
    rng = np.random.default_rng(10 * n + k)
    times = np.cumsum(rng.uniform(0.3, 2.0, n))
    naxes = 2 if n == 3 else 1
    table = random_table(rng, n, max(k, 2), naxes)
    table[1, 1:k] = rng.normal(size=(k - 1, naxes))  # above the continuity it holds on both sides
    table[1, 1, -1] = FREE
    if naxes == 2:
        table[1, -1, 0] = FREE
    found = optimize_waypoints(points_of(times, table), k, order=order, continuity=continuity)
    programs = [Quadratic(times, table[:, :, axis], k, order, continuity) for axis in range(naxes)]
    assert found.unique
    assert found.cost == pytest.approx(sum(p.cost for p in programs), rel=1e-12)
    t = np.linspace(times[0], times[-1], 50)[:-1]
    for nu in range(min(order, k) + 1):
        close(found.plan.jet(t, nu)[nu], np.array([p(t, nu) for p in programs]), 1e-10)
    assert isinstance(found.plan, PiecewiseSpline if continuity == order else Joined)


@pytest.mark.slow
def test_minimum_snap_of_three_axes_and_uneven_segments():
    rng = np.random.default_rng(0)
    times = np.array([0.0, 1.0, 1.001, 3.0, 3.5])
    table = random_table(rng, 5, 4, 3)
    found = optimize_waypoints(points_of(times, table), 4)
    programs = [Quadratic(times, table[:, :, axis], 4, 3, 3) for axis in range(3)]
    assert found.unique
    assert found.cost == pytest.approx(sum(p.cost for p in programs), rel=1e-8)


@pytest.mark.parametrize(("k", "tolerance"), [(2, 1e-12), (3, 1e-11), (4, 1e-9)])
def test_one_short_segment_costs_what_rounded_entries_cost(k, tolerance):
    times = np.array([0.0, 1.0, 1.0 + 2.0**-10, 3.0])
    table = random_table(np.random.default_rng(k), 4, k, 1)
    found = optimize_waypoints(points_of(times, table), k)
    assert found.unique
    program, t = Quadratic(times, table[:, :, 0], k, k - 1, k - 1), np.linspace(0, 3, 50)[:-1]
    assert found.cost == pytest.approx(program.cost, rel=tolerance)
    close(found.plan(t), program(t, 0), tolerance)


def single_polynomial_cost(times, table, k, size):
    """Minimum cost of one polynomial of `size` coefficients through the entries of one axis, with 60 digits."""
    with mp.workdps(60):
        span = [mp.mpf(float(t)) - mp.mpf(float(times[0])) for t in times]
        rows, right = [], []
        for t, jet in zip(span, table, strict=True):
            for j, value in enumerate(jet):
                if not math.isnan(value):
                    rows.append([mp.ff(m, j) * t ** (m - j) if m >= j else mp.mpf(0) for m in range(size)])
                    right.append(mp.mpf(float(value)))
        kkt, known = mp.zeros(size + len(rows)), mp.zeros(size + len(rows), 1)
        for a, b in itertools.product(range(k, size), repeat=2):
            kkt[a, b] = mp.ff(a, k) * mp.ff(b, k) * span[-1] ** (a + b - 2 * k + 1) / (a + b - 2 * k + 1)
        for r, (row, value) in enumerate(zip(rows, right, strict=True), size):
            known[r] = value
            for c, v in enumerate(row):
                kkt[r, c] = kkt[c, r] = v
        found = mp.lu_solve(kkt, known)[:size]
        return float(sum(kkt[a, b] * found[a] * found[b] for a, b in itertools.product(range(size), repeat=2)))


@pytest.mark.parametrize(("n", "k", "order"), [(3, 3, 2), (4, 4, 3), (5, 3, 3), (8, 3, 2)])
def test_one_polynomial_is_the_minimum_of_its_degree(n, k, order):
    rng = np.random.default_rng(n)
    times = np.cumsum(rng.uniform(0.5, 1.5, n))
    table = random_table(rng, n, k, 1)
    table[1, 1] = 0.5
    found = optimize_waypoints(points_of(times, table), k, order=order, single=True)
    exact = single_polynomial_cost(times, table[:, :, 0], k, n * (order + 1))
    assert isinstance(found.plan, PolySpline)
    assert found.plan.degree == (n * (order + 1) - 1,)
    assert found.cost == pytest.approx(exact, rel=1e-12)
    assert energy(found.plan, k) == pytest.approx(exact, rel=1e-12)


# Single plans by brute force


def filled(points, values, size):
    """Waypoints of one axis whose free entries are taken from a sequence."""
    rest = iter(values)
    jets = [[v if v == v else float(next(rest)) for v in [*p.jet[:, 0], FREE, FREE, FREE][:size]] for p in points]
    return [Waypoint.from_jets(p.time, y=jet) for p, jet in zip(points, jets, strict=True)]


@pytest.mark.parametrize("alpha", [0.0, 0.5, 4.0])
def test_single_plans_are_what_a_search_finds(alpha):
    points = [Waypoint(1, 0, 0, 0), Waypoint(1.7, 1, FREE, 0.5), Waypoint(3, -1, 0)]

    def cost(x):
        complete = filled(points, x, 3)
        return energy(TrigSpline(complete, alpha=alpha) if alpha else PolySpline(complete), 3)

    found = optimize_waypoints(points, single=True, alpha=alpha)
    searched = minimize(cost, np.zeros(2), method="BFGS", options={"gtol": 1e-6})
    assert type(found.plan) is (TrigSpline if alpha else PolySpline)
    assert found.cost <= searched.fun * (1 + 1e-12)
    assert found.cost == pytest.approx(searched.fun, rel=1e-9)
    best = [found.waypoints[1].velocity[0], found.waypoints[2].acceleration[0]]
    np.testing.assert_allclose(best, searched.x, rtol=1e-4)
    adaptive, _ = quad(lambda t: float(found.plan(t, 3)) ** 2, 1, 3, epsrel=1e-12)
    assert found.cost == pytest.approx(adaptive, rel=1e-12)


# What holds always

families = st.sampled_from([{}, {"alpha": 2.0}, {"single": True}, {"single": True, "alpha": 3.0}])


@examples(30)
@given(seed=st.integers(0, 2**32 - 1), k=st.integers(1, 4), n=st.integers(2, 4), options=families)
def test_no_free_entry_can_be_moved_to_advantage(seed, k, n, options):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.5, 1.5, n))
    table = random_table(rng, n, k, 2)
    missing = rng.random(table.shape) < 0.3
    missing[[0, -1]] = False
    table[missing] = FREE
    found = optimize_waypoints(points_of(times, table), k, **options)
    assert energy(found.plan, k) == pytest.approx(found.cost, rel=1e-10)
    best = np.array([w.jet for w in found])
    np.testing.assert_array_equal(best[~np.isnan(table)], table[~np.isnan(table)])
    np.testing.assert_array_equal([w.time for w in found], times)
    for where in np.argwhere(np.isnan(table))[:6]:
        costs = []
        for sign in (-1.0, 1.0):
            moved = best.copy()
            moved[tuple(where)] += sign
            points = points_of(times, moved)
            if "single" in options:
                plan = TrigSpline(points, alpha=options.get("alpha", 0.0))
            else:
                plan = PiecewiseSpline(points, **options)
            costs.append(energy(plan, k))
        # A parabola with its minimum in the middle: the cost is the same on both sides of it.
        assert min(costs) >= found.cost * (1 - 1e-12)
        assert costs[1] == pytest.approx(costs[0], rel=1e-8)


@examples(20)
@given(seed=st.integers(0, 2**32 - 1), exponent=st.floats(-6, 6), size=st.floats(-3, 3), options=families)
def test_costs_scale_with_time_and_amplitude(seed, exponent, size, options):
    rng = np.random.default_rng(seed)
    times, rate, factor = np.array([0.0, 1.0, 2.5, 3.0]), 10.0**exponent, -(10.0**size)
    table = random_table(rng, 4, 3, 1)
    found = optimize_waypoints(points_of(times, table), **options)
    slower = table * factor / (rate ** np.arange(3))[:, None]
    scaled = optimize_waypoints(points_of(times * rate, slower), **options)
    assert scaled.unique
    assert scaled.cost == pytest.approx(found.cost * factor**2 / rate**5, rel=1e-11)
    for a, b in zip(found, scaled, strict=True):
        np.testing.assert_allclose(b.scaled(a.time, rate).jet, factor * a.jet, rtol=1e-9, atol=-1e-9 * factor)


@pytest.mark.parametrize("options", [{}, {"single": True}, {"continuity": 1}, {"alpha": 3.0}])
@pytest.mark.parametrize("start", [0.0, 1e6])
def test_complete_waypoints_stay_as_they_are(options, start):
    points = [Waypoint(start, 1, 2, 3), Waypoint(start + 2, -1, 0.5, 1), Waypoint(start + 3, 1, 2, 0)]
    found = optimize_waypoints(points, **options)
    assert found.waypoints == tuple(points)
    assert found.unique
    assert found.cost == pytest.approx(energy(found.plan, 3), rel=1e-12)
    assert isinstance(found.plan, PolySpline if "single" in options else PiecewiseSpline)


def test_more_continuity_costs_more_and_more_order_less():
    points = points_of([0.0, 1.0, 1.8, 3.0], random_table(np.random.default_rng(3), 4, 3, 2))
    shared = [optimize_waypoints(points, 3, order=5, continuity=c).cost for c in (1, 2, 3, 4, 5)]
    assert shared[0] < 0.99 * shared[1]
    assert shared[1:4] == pytest.approx([shared[1]] * 3, rel=1e-11)  # the optimum has 2 k - 2 = 4 anyway
    assert shared[4] > shared[3] * 1.000001
    points = points_of([0.0, 1.0, 1.8, 3.0], random_table(np.random.default_rng(3), 4, 2, 2))
    orders = [optimize_waypoints(points, 3, order=order, continuity=1).cost for order in (1, 2, 3)]
    assert orders[0] > 1.0001 * orders[1]
    assert orders[2] == pytest.approx(orders[1], rel=1e-11)  # the optimum has degree 2 k - 1


# Entries on two sides


def test_entries_above_the_continuity_jump_where_free_and_hold_where_prescribed():
    points = [
        Waypoint(0.1, [0, 0], 0, 0),
        Waypoint(0.3, [1, 2], None, [0.5, FREE]),
        Waypoint(0.7, [0, 1], None, [FREE, FREE]),
        Waypoint(1.1, [1, 0], 0, 0),
    ]
    found = optimize_waypoints(points, continuity=1, labels=["a", "b"])
    plan = found.plan
    assert isinstance(plan, Joined)
    np.testing.assert_array_equal(plan.breakpoints, [0.1, 0.3, 0.7, 1.1])
    assert plan.labels == ("a", "b") == found.waypoints[0].labels
    left, right = (plan.jet([0.3, 0.7], 2, left=side) for side in (True, False))
    np.testing.assert_allclose(left[:2], right[:2], rtol=0, atol=1e-12)
    np.testing.assert_allclose([left[2, 0, 0], right[2, 0, 0]], 0.5, rtol=1e-12)
    assert np.abs(left - right)[2][[1, 0, 1], [0, 1, 1]].min() > 0.1
    unknown = [[0, 1], [1, 1]]
    np.testing.assert_array_equal(np.isnan([w.acceleration for w in found][1:3]), unknown)
    assert not np.isnan([w.jet[:2] for w in found]).any()


def test_plans_are_written_and_read(tmp_path):
    points = [Waypoint(0.1, 0, 0, 0), Waypoint(0.3, 1), Waypoint(0.8, 0, 0, 0)]
    for options in ({}, {"single": True, "alpha": 1.0}, {"continuity": 0}):
        plan = optimize_waypoints(points, **options).plan
        plan.save(tmp_path / "plan.json")
        t = np.linspace(0, 1, 50)
        np.testing.assert_array_equal(load_trajectory(tmp_path / "plan.json")(t, 2), plan(t, 2))


def test_order_rises_to_what_is_prescribed():
    points = [Waypoint(0, 0, 0, 0, 0), Waypoint(1, 1, None, None, 2), Waypoint(2, 0, 0)]
    found = optimize_waypoints(points, 2)
    assert [w.jet.shape for w in found] == [(4, 1)] * 3
    assert found.plan.jet([1.0], 3, left=True)[3, 0, 0] == pytest.approx(2, rel=1e-11)
    table = [[0, 0, 0, 0], [1, FREE, FREE, 2], [0, 0]]
    assert found.cost == pytest.approx(Quadratic([0, 1, 2], table, 2, 3, 3).cost, rel=1e-12)
    higher = optimize_waypoints(points, 2, order=5, continuity=1)
    assert higher.cost == pytest.approx(Quadratic([0, 1, 2], table, 2, 5, 1).cost, rel=1e-12)


def test_the_result_is_a_sequence_of_waypoints():
    points = [
        Waypoint.from_jets(0, x=[0, 0, 0, 0]),
        Waypoint.from_jets(1, x=[1]),
        Waypoint.from_jets(3, x=[0, 0, 0, 0]),
    ]
    found = optimize_waypoints(points, 4)
    again = PiecewiseSpline(found)
    assert again.labels == found.plan.labels == ("x",)
    assert len(found) == 3
    t = np.linspace(0, 3, 20)
    np.testing.assert_array_equal(again(t, 3), found.plan(t, 3))
    assert "3 waypoints" in repr(found)
    assert "not unique" not in repr(found)


# Not unique


@pytest.mark.parametrize("options", [{}, {"single": True}])
def test_data_of_a_polynomial_of_zero_cost_leave_the_shortest_choice(options):
    found = optimize_waypoints([Waypoint(0, 0), Waypoint(2, 6)], 3, **options)
    assert not found.unique
    assert "not unique" in repr(found)
    # y = 6 u + c u (1 - u) in u = t/2: velocities 6 + c, 6 - c and accelerations -2 c, shortest at c = 0.
    np.testing.assert_allclose([w.jet[:, 0] for w in found], [[0, 3, 0], [6, 3, 0]], rtol=0, atol=1e-12)
    assert found.cost < 1e-24


def test_the_shortest_choice_is_in_units_of_the_duration():
    # y = u^2 + c u (1 - u) through (0, 0), (1, 1): |(c, 2 - c)|^2 + 2 (2 - 2 c)^2 is minimal at c = 1 + 0.
    at_rest = optimize_waypoints([Waypoint(0, 0, None, 2), Waypoint(1, 1)], 3)
    assert at_rest.unique  # three data determine the quadratic
    # y = a + b u with velocity b alone: the constant that minimises a^2 + (a + b)^2.
    drift = optimize_waypoints([Waypoint(0, FREE, 3.0), Waypoint(10, FREE)], 2, order=1)
    np.testing.assert_allclose([w.jet[:, 0] for w in drift], [[-15, 3], [15, 3]], rtol=1e-13)
    assert not drift.unique


@pytest.mark.parametrize(
    ("points", "k", "unique"),
    [
        ([Waypoint(0, 0), Waypoint(1, 1), Waypoint(2, 0)], 3, True),
        ([Waypoint(0, 0), Waypoint(1, 1), Waypoint(2, 0)], 4, False),
        ([Waypoint(0, 0, 0), Waypoint(1, 1), Waypoint(2, 0)], 4, True),
        ([Waypoint(0, 0, None, 0), Waypoint(1, 1, None, 0)], 3, True),
        ([Waypoint(0, 0, None, 0), Waypoint(1, FREE, None, 0)], 3, False),  # any slope
        ([Waypoint(0, [0, 0], 0, 0), Waypoint(1, [1, FREE], 0, 0)], 3, True),
        ([Waypoint(0, [0, 0], [0, FREE], 0), Waypoint(1, [1, FREE], [0, FREE], 0)], 3, False),
    ],
)
def test_uniqueness_is_told(points, k, unique):
    for options in ({}, {"single": True}):
        assert optimize_waypoints(points, k, **options).unique is unique


def test_discontinuity_may_leave_a_function_of_zero_cost():
    points = [Waypoint(0, 0, 0, 0), Waypoint(1, 1), Waypoint(2, 3)]
    assert optimize_waypoints(points, 3, continuity=1).unique
    loose = optimize_waypoints(points, 3, continuity=0)
    assert not loose.unique  # a parabola in the last segment


def test_an_order_too_low_for_the_derivative_costs_nothing():
    found = optimize_waypoints([Waypoint(0, 0), Waypoint(1, 1), Waypoint(3, 0)], 3, order=0)
    assert found.cost == 0.0
    assert found.plan(2.0) == pytest.approx(0.5, rel=1e-14)


# Free times


def best_instant(fraction):
    """When a minimum-jerk move passes a fraction of its way, relative to its duration."""
    return brentq(lambda s: s**3 * (10 - 15 * s + 6 * s * s) - fraction, 0, 1, xtol=1e-15)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("single", [False, True])
def test_points_on_a_line_are_passed_by_the_minimum_jerk_move(single, scale):
    times, ways = np.array([1.0, 1.3, 1.5, 3.0]) * scale, [0.0, 0.1, 0.7, 1.0]
    points = [Waypoint(t, [3 * w, -w]) for t, w in zip(times, ways, strict=True)]
    points[0], points[-1] = (Waypoint(p.time, p.position, 0, 0) for p in (points[0], points[-1]))
    found = optimize_waypoints(points, free_times=True, single=single)
    assert found.cost == pytest.approx(720 * 10 / (2 * scale) ** 5, rel=1e-12)
    exact = [(1 + 2 * best_instant(w)) * scale for w in ways[1:-1]]
    np.testing.assert_allclose([w.time for w in found][1:-1], exact, rtol=1e-7)
    assert [found.waypoints[i].time for i in (0, -1)] == [times[0], times[-1]]
    np.testing.assert_array_equal([w.position for w in found], [p.position for p in points])


@pytest.mark.parametrize("weights", [None, [4.0, 0.25]])
def test_minimum_velocity_is_constant_speed_along_the_polyline(weights):
    corners = np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0], [0.0, 1.0], [0.5, 1.0]])
    points = [Waypoint(t, corner) for t, corner in zip([1, 2, 3, 4, 7], corners, strict=True)]
    found = optimize_waypoints(points, 1, free_times=True, weights=weights)
    way = np.sqrt(np.diff(corners, axis=0) ** 2 @ (np.ones(2) if weights is None else weights))
    assert found.cost == pytest.approx(way.sum() ** 2 / 6, rel=1e-13)
    np.testing.assert_allclose([w.time for w in found], 1 + 6 * np.append(0, np.cumsum(way)) / way.sum(), rtol=1e-7)


def test_one_time_is_that_of_a_search_over_cubic_splines():
    values = np.array([[0.0, 1.0], [2.0, 0.5], [1.0, 3.0]])
    weights = np.array([1.0, 5.0])

    def spline_cost(t):
        times = np.array([0.0, t, 2.0])
        bends = CubicSpline(times, values, bc_type="clamped")(times, 2)
        squares = bends[1:] ** 2 + bends[1:] * bends[:-1] + bends[:-1] ** 2
        return float(np.diff(times) @ squares @ weights) / 3.0

    searched = minimize_scalar(spline_cost, bounds=(0.1, 1.9), method="bounded", options={"xatol": 1e-10})
    points = [Waypoint(0, values[0], 0), Waypoint(1.8, values[1]), Waypoint(2, values[2], 0)]
    found = optimize_waypoints(points, 2, free_times=True, weights=weights)
    assert found.cost == pytest.approx(searched.fun, rel=1e-13)
    assert found.waypoints[1].time == pytest.approx(searched.x, rel=1e-6)
    grid = [spline_cost(t) for t in np.linspace(0.05, 1.95, 400)]
    assert found.cost <= min(grid)
    evenly = optimize_waypoints(points, 2, free_times=True)
    assert abs(evenly.waypoints[1].time - found.waypoints[1].time) > 1e-2


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"alpha": 2.0},
        {"single": True},
        {"single": True, "alpha": 3.0},
        {"single": True, "alpha": 5.0, "order": 3},
    ],
)
def test_times_cannot_be_moved_to_advantage(options):
    points = [
        Waypoint(0, [0, 0], 0, 0),
        Waypoint(1, [1, 0.5], [1, FREE]),
        Waypoint(2.2, [1.5, 2]),
        Waypoint(3, [0.5, 2.5]),
        Waypoint(5, [0, 0], 0, 0),
    ]
    found = optimize_waypoints(points, free_times=True, **options)
    given_times = optimize_waypoints(points, **options)
    assert found.cost < 0.95 * given_times.cost
    assert energy(found.plan, 3) == pytest.approx(found.cost, rel=1e-9)
    times = np.array([w.time for w in found])

    def cost(chosen):
        return optimize_waypoints([Waypoint(t, *p.jet) for t, p in zip(chosen, points, strict=True)], **options).cost

    for i in (1, 2, 3):
        step = np.zeros(5)
        step[i] = 1e-3
        up, down = cost(times + step), cost(times - step)
        assert min(up, down) > found.cost
        # The vertex of the parabola through the three lies within the search's accuracy of the time found.
        vertex = 0.5e-3 * (down - up) / (up + down - 2 * found.cost)
        assert abs(vertex) < 2e-5


@pytest.mark.parametrize("options", [{}, {"single": True, "alpha": 2.0}])
def test_symmetric_data_give_symmetric_times(options):
    rest = (0.0, 0.0)
    points = [Waypoint(0, 0, *rest), Waypoint(0.5, 1), Waypoint(1, 3), Waypoint(3, 1), Waypoint(4, 0, *rest)]
    found = optimize_waypoints(points, free_times=True, **options)
    times = np.array([w.time for w in found])
    np.testing.assert_allclose(times + times[::-1], 4.0, rtol=1e-6)


@pytest.mark.slow
@examples(8)
@given(seed=st.integers(0, 2**32 - 1), options=families)
def test_chosen_times_are_never_worse(seed, options):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    times = np.cumsum(rng.uniform(0.01, 1.5, n))
    table = random_table(rng, n, 3, 2)
    table[1:-1, 1] = np.where(rng.random((max(n - 2, 0), 2)) < 0.3, rng.normal(size=(max(n - 2, 0), 2)), FREE)
    if n > 3:
        table[2, 0] = table[1, 0]  # a segment without length
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the plan swings")  # one polynomial through random data
        warnings.filterwarnings("ignore", "the optimum is known to few digits only")
        try:
            found = optimize_waypoints(points_of(times, table), free_times=True, **options)
        except ValueError as error:  # times that the search brought so close together that their cost has no digits
            assert "must be resolved in double precision" in str(error)  # noqa: PT017
            return
        assert found.cost <= optimize_waypoints(points_of(times, table), **options).cost
    chosen = [w.time for w in found]
    assert np.diff(chosen).min() > 0
    assert (chosen[0], chosen[-1]) == (times[0], times[-1])
    best = np.array([w.jet for w in found])
    np.testing.assert_array_equal(best[~np.isnan(table)], table[~np.isnan(table)])


@pytest.mark.parametrize("free_times", [False, True])
@pytest.mark.parametrize(("unit", "length"), [(1.0, 1e200), (1e-60, 1e150)])
def test_a_cost_beyond_floating_point_is_an_error(unit, length, free_times):
    points = [Waypoint(0, 0, 0, 0), Waypoint(unit, length), Waypoint(3 * unit, -length, 0, 0)]
    with pytest.raises(ValueError, match=r"the cost must stay within floating point, got an .* other units"):
        optimize_waypoints(points, free_times=free_times)


def test_times_that_are_best_stay():
    resting = [Waypoint(0, 1), Waypoint(0.3, 1), Waypoint(1, 1)]
    found = optimize_waypoints(resting, free_times=True)
    assert [w.time for w in found] == [0, 0.3, 1]
    assert found.cost < 1e-20


# Bad input

GOOD = [Waypoint(0, [0, 0], 0), Waypoint(1, [1, 1]), Waypoint(2, [0, 0], 0)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"derivative": 0}, "derivative must be an integer of at least 1, got 0"),
        ({"derivative": 2.5}, "derivative must be an integer of at least 1, got 2.5"),
        ({"order": -1}, "order must be an integer of at least 0, got -1"),
        ({"continuity": -1}, "continuity must be an integer of at least 0, got -1"),
        ({"order": 2, "continuity": 3}, "order must be at least the continuity 3, got 2"),
        ({"continuity": 1, "single": True}, "continuity must not be given for a single plan"),
        ({"alpha": 6.3}, r"alpha must lie in \[0, 2 pi\), got 6.3"),
        ({"weights": [1.0]}, "weights must be one number per axis, 2, got 1"),
        ({"weights": [1.0, 0.0]}, r"weights\[1\] must be finite and above 0, got 0.0"),
        ({"labels": ["a"]}, "labels must be one per axis, 2, got 1"),
        ({"waypoints": GOOD[:1]}, "at least two waypoints, got 1"),
        ({"waypoints": GOOD[::-1]}, "times must increase strictly"),
        ({"waypoints": [*GOOD, Waypoint(3, 1)]}, "must have the same axes"),
        ({"waypoints": [Waypoint(0, [0, FREE]), Waypoint(1, [1, FREE])]}, "every axis must have a prescribed entry"),
    ],
)
def test_bad_values_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        optimize_waypoints(**({"waypoints": GOOD} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"derivative": "3"}, "derivative must be an integer"),
        ({"weights": ["a", "b"]}, r"weights\[0\] must be a number, got"),
        ({"waypoints": [1, 2]}, r"waypoints\[0\] must be a Waypoint, got int"),
    ],
)
def test_bad_kinds_are_rejected(arguments, message):
    with pytest.raises(TypeError, match=message):
        optimize_waypoints(**({"waypoints": GOOD} | arguments))


def test_results_cannot_be_changed():
    found = optimize_waypoints(GOOD)
    with pytest.raises(AttributeError):
        found.cost = 0.0
    with pytest.raises(ValueError, match="read-only"):
        found.waypoints[1].jet[0, 0] = 2.0


# Digits that rounding of the data costs


def minimum_jerk(times, positions):
    """Cost of minimum jerk through positions, at rest at both ends: normal equations of Hermite quintics, 50 digits."""
    with mp.workdps(50):
        hermite = mp.matrix(6, 6)
        for i, j in itertools.product(range(3), range(6)):
            hermite[i, j] = mp.factorial(i) if i == j else 0
            hermite[3 + i, j] = mp.ff(j, i) if j >= i else 0
        gram = mp.matrix(6, 6)
        for i, j in itertools.product(range(3, 6), repeat=2):
            gram[i, j] = mp.ff(i, 3) * mp.ff(j, 3) / mp.mpf(i + j - 5)
        unit = (hermite**-1).T * gram * hermite**-1
        size = 3 * len(times)
        whole, data = mp.matrix(size, size), mp.matrix(size, 1)
        for k, (left, right) in enumerate(itertools.pairwise(map(mp.mpf, times))):
            powers = [(right - left) ** i for i in range(3)] * 2
            for i, j in itertools.product(range(6), repeat=2):
                whole[3 * k + i, 3 * k + j] += unit[i, j] * powers[i] * powers[j] / (right - left) ** 5
        data[::3] = mp.matrix(list(map(mp.mpf, positions)))
        free = [k for k in range(3, size - 3) if k % 3]
        matrix = mp.matrix([[whole[i, j] for j in free] for i in free])
        known = whole * data
        for k, value in zip(free, mp.lu_solve(matrix, mp.matrix([-known[k] for k in free])), strict=True):
            data[k] = value
        return float((data.T * whole * data)[0])


def optimum_or_word(times, positions, **options):
    """Optimum of minimum jerk, and the warning or the error that was given instead of digits."""
    ends = (0, len(times) - 1)
    points = [
        Waypoint(float(t), float(p), *((0.0, 0.0) if i in ends else ()))
        for i, (t, p) in enumerate(zip(times, positions, strict=True))
    ]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = optimize_waypoints(points, **options)
        except ValueError as error:
            return None, str(error)
    return found, str(caught[0].message) if caught else ""


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("gap", [1e-2, 1e-4, 3e-5, 1e-5, 1e-6, 1e-7, 1e-9])
def test_a_short_inner_segment_is_right_or_says_what_it_costs(gap, order):
    times = [0.0, 1.0, 1.0 + gap, 2.0]
    found, word = optimum_or_word(times, times, order=order)
    if order == 2:  # the spline of minimum jerk, which keeps all digits of its entries
        assert not word
        assert found.cost == pytest.approx(minimum_jerk(times, times), rel=1e-6)
        assert found.plan(times) == pytest.approx(times, rel=1e-15)
    elif gap <= 1e-9:
        assert "have 16 digits" in word
        assert "from waypoints[1] to [2]" in word
    if gap >= 1e-5:
        assert not word
    if found:  # rounding of one position changes the cost by 2e-16/gap, and there are two
        assert found.cost == pytest.approx(minimum_jerk(times, times), rel=1e-6 if order == 2 else 1e-12 + 1e-15 / gap)


@pytest.mark.parametrize("seed", range(6))
def test_inaccuracy_is_warned_of(seed):
    """Random points, some very near, some far from the origin: without a word six digits of the cost are right."""
    rng = np.random.default_rng(seed)
    gaps = 10.0 ** rng.uniform(-(seed % 9), 0.0, rng.integers(2, 6))
    times = np.concatenate([[0.0], np.cumsum(gaps)])
    steps = rng.normal(size=times.size) * np.concatenate([[0.0], gaps])
    positions = np.cumsum(steps) + 10.0 ** rng.uniform(-2.0, 4.0)
    found, word = optimum_or_word(times, positions, order=int(rng.integers(2, 5)))
    if not word:
        assert found.cost == pytest.approx(minimum_jerk(times, positions), rel=1e-6)


def test_the_estimate_of_the_error():
    """Where a warning is given the cost is as near to the true one as the warning says."""
    told = []
    for gap in np.geomspace(1e-4, 3e-7, 14):
        times = [0.0, 1.0, 1.0 + gap, 2.0]
        found, word = optimum_or_word(times, times, order=3)
        if found and word:
            estimate = float(word.split("relative error of ")[1].split(":")[0])
            told.append(estimate)
            assert abs(found.cost / minimum_jerk(times, times) - 1.0) <= 1.1 * estimate
    assert len(told) >= 2


@pytest.mark.parametrize(
    ("times", "positions"),
    [
        (np.arange(30.0), np.arange(30.0)),  # a straight line but for its ends
        (np.arange(5.0), np.zeros(5)),
        (np.arange(5.0), np.full(5, 1e6)),
        (1e-6 * np.arange(5.0), 1e-9 * np.arange(5.0) ** 2),
        (1e6 * np.arange(5.0), [0.0, 1e7, -1e7, 1e7, 0.0]),
        (1e5 + np.arange(4.0), [0.0, 1.0, 3.0, 2.0]),
        (np.cumsum([0.0, 1.0, 1e-3, 1.0]), [0.0, 1.0, 1.001, 2.0]),
    ],
)
def test_no_warning_if_the_cost_is_accurate(times, positions):
    found, word = optimum_or_word(times, positions)
    assert not word
    size = np.ptp(positions) ** 2 / (times[-1] - times[0]) ** 5
    # Relative to a cost of 0: the effect of rounding of the positions.
    rounding = (1e-13 * np.abs(positions).max() / np.diff(times).min() ** 2.5) ** 2
    assert found.cost == pytest.approx(minimum_jerk(times, positions), rel=1e-6, abs=1e-12 * size + rounding)


def test_rounding_far_from_the_origin():
    """A move of a millimetre at 1e12, where numbers are 0.1 mm apart."""
    found, word = optimum_or_word([0.0, 1.0, 2.0], [1e12, 1e12 + 1e-3, 1e12])
    assert found is None
    assert "use an origin nearer to the positions" in word


def test_a_single_spline_through_near_points_is_inaccurate_as_well():
    points = [Waypoint(t, math.sin(9.0 * t), 9.0 * math.cos(9.0 * t), 0.0) for t in (0.0, 0.5, 0.5 + 1e-6, 1.0)]
    with pytest.raises(ValueError, match="the cost must be resolved in double precision, got an estimated relative"):
        optimize_waypoints(points, single=True)


def test_one_spline_through_many_points_names_that_reason():
    points = [Waypoint(0, 0, 0, 0), *(Waypoint(t, math.sin(t)) for t in range(1, 30)), Waypoint(30, 0, 0, 0)]
    said = r"one spline has all 31 waypoints, .*; use one spline for each segment \(single=False\), merge waypoints"
    with pytest.raises(ValueError, match=said):
        optimize_waypoints(points, single=True)
    assert optimize_waypoints(points).unique


def clamped(n, derivative, seed=0):
    """Times, positions of three axes, waypoints at rest at both ends, and scipy's spline of the same problem."""
    rng = np.random.default_rng(seed)
    times, positions = np.cumsum(rng.uniform(0.5, 1.5, n)), rng.normal(size=(n, 3))
    rest = [np.zeros(3)] * (derivative - 1)
    points = [
        Waypoint(t, y, *(rest if i in (0, n - 1) else []))
        for i, (t, y) in enumerate(zip(times.tolist(), positions, strict=True))
    ]
    ends = [(k, np.zeros(3)) for k in range(1, derivative)]
    return times, points, make_interp_spline(times, positions, k=2 * derivative - 1, bc_type=(ends, ends))


def squared_cost(spline, times, derivative):
    """Integral of the squared derivative, a polynomial on each segment, by Gauss-Legendre points."""
    nodes, weights = np.polynomial.legendre.leggauss(derivative + 1)
    h = np.diff(times)
    values = spline(times[:-1, None] + 0.5 * h[:, None] * (nodes + 1.0), derivative)
    return float(0.5 * h @ ((values**2).sum(axis=2) @ weights))


@pytest.mark.parametrize("derivative", [2, 3, 4])
@pytest.mark.parametrize("n", [3, 40, 1000])
def test_many_waypoints_have_the_cost_of_the_clamped_spline(n, derivative):
    times, points, spline = clamped(n, derivative)
    found = optimize_waypoints(points, derivative=derivative)
    assert found.unique
    assert found.cost == pytest.approx(squared_cost(spline, times, derivative), rel=1e-11)
    t = np.linspace(times[0], times[-1], 2001)
    assert np.abs(found.plan(t) - spline(t).T).max() <= 1e-11 * np.abs(spline(t)).max()


def test_free_ends_of_many_waypoints_are_natural():
    """Nothing but positions: derivatives 3 to 5 vanish at both ends of the minimum-jerk plan."""
    times, points, _ = clamped(300, 3)
    points = [Waypoint(p.time, p.position) for p in points]
    found = optimize_waypoints(points)
    natural = [(k, np.zeros(3)) for k in (3, 4)]
    positions = np.array([p.position for p in points])
    spline = make_interp_spline(times, positions, k=5, bc_type=(natural, natural))
    t = np.linspace(times[0], times[-1], 1001)
    assert np.abs(found.plan(t) - spline(t).T).max() <= 1e-10 * np.abs(spline(t)).max()
    assert found.cost == pytest.approx(squared_cost(spline, times, 3), rel=1e-10)
    assert found.unique


def test_many_waypoints_without_dense_equations(monkeypatch):
    monkeypatch.setattr("ctrlplan.planning.optimize._least_squares", None)
    _, points, _ = clamped(200, 4)
    assert optimize_waypoints(points, derivative=4).unique


def test_free_times_of_many_waypoints_lower_the_cost():
    times, points, _ = clamped(60, 3)
    fixed, free = optimize_waypoints(points), optimize_waypoints(points, free_times=True)
    assert free.cost < 0.8 * fixed.cost
    chosen = np.array([p.time for p in free.waypoints])
    assert (chosen[[0, -1]] == times[[0, -1]]).all()
    # Stationary: moving a waypoint either way costs more.
    for i in (7, 30):
        for change in (-1e-3, 1e-3):
            moved = [
                Waypoint(t + change * (k == i), *p.jet) for k, (t, p) in enumerate(zip(chosen, points, strict=True))
            ]
            assert optimize_waypoints(moved).cost > free.cost


@pytest.mark.parametrize("height", [1.01, 1.003, 1.2])
def test_free_times_of_one_spline_stay_where_the_cost_is_resolved(height):
    points = [Waypoint(0, 0, 0, 0), Waypoint(1.2, 1), Waypoint(2.1, height), Waypoint(3.5, 2.2, 0, 0)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = optimize_waypoints(points, free_times=True, single=True)
    plan, times = found.plan, [point.time for point in found.waypoints]
    exact = quad(lambda t: plan(t, 3) ** 2, 0, 3.5, epsabs=0, epsrel=1e-12, points=times[1:-1])[0]
    assert found.cost == pytest.approx(exact, rel=1e-6)
    assert plan([times[1], times[2]]) == pytest.approx([1, height], abs=1e-9)
    gap = times[2] - times[1]
    costs = [
        optimize_waypoints([points[0], Waypoint(t, 1), Waypoint(t + step, height), points[3]], single=True).cost
        for step in gap * np.array([1.0, 1.5, 3.0, 10.0])
        for t in np.linspace(0.2, 3.3 - step, 12)
        if t + step < 3.3
    ]
    assert found.cost <= min(costs) * (1 + 1e-6)
