"""No digit is lost where waypoints nearly coincide: both ends near alpha = 2 pi, or close in time."""

import decimal
import itertools
import math

import mpmath as mp
import numpy as np
import pytest
from trajectory_oracle import Direct, error, waypoints

from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Transition, TrigSpline, Waypoint
from ctrlplan.trajectories.digits import _sin_cos

pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

NEAR = [6.0, 6.28, 6.2831, 6.28318, 6.283185307]
"""Alphas up to 2 pi - 1.8e-10."""


def periodic(alpha, entries, at, phase=0.3):
    """Jets of cos(alpha t + phase) as floats: what moves through the point at which the ends meet."""
    return [[alpha**k * math.cos(alpha * t + phase + 0.5 * math.pi * k) for k in range(entries)] for t in at]


CLOSED = {
    "one point between": ([0, 0.5, 1], [[1, 0, 0], [2, 0.5, 0], [1, 0, 0]]),
    "late start, uneven": ([1e3, 1e3 + 1.3, 1e3 + 3], [[1, 0, 0], [2, 0.5, 0], [1, 0, 0]]),
    "jets of all lengths": ([0, 1.3, 2.1, 3], [[1, 0, 0, 0], [2], [-3, 0.5, 7], [1, 0, 0, 0]]),
    "ends of two lengths": ([0, 0.3, 0.6, 1], [[1, 0, 0], [2], [-1], [1, 0]]),
    "ends that move": ([0, 0.3, 1], [[1, 0.3, -2], [2, 0.5, 0], [1, 0.3, -2]]),
    "ends almost equal": ([0, 0.5, 1], [[1, 0, 0], [2, 0.5, 0], [1 + 2**-52, 0, 0]]),
    "ends apart": ([0, 0.3, 1], [[0, 0, 0], [2, 0.5, 0], [1, 0, 0]]),
    "a point near the ends": ([0, 0.999, 1], [[1, 0, 0], [2, 0.5, 0], [1, 0, 0]]),
    "and two close together": ([0, 0.4, 0.4 + 2**-12, 1], [[1, 0, 0], [2, 0, 0], [2, 0, 0], [1, 0, 0]]),
    "a free velocity between": ([0, 0.3, 0.6, 1], [[1, 0, 0], [2, None, 1], [-1], [1, 0, 0]]),
    "free velocities at the ends": ([0, 0.3, 0.6, 1], [[1, None, 0], [2, 1], [-1], [1, None, 0]]),
}


@pytest.mark.parametrize("alpha", NEAR)
@pytest.mark.parametrize("name", CLOSED)
def test_ends_that_meet(name, alpha):
    """Against equation (3) solved in 250 digits; its condition is (2 pi - alpha)^-7 at most."""
    times, jets = CLOSED[name]
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert error(plan, Direct(times, jets, alpha, digits=250), order=2, ntime=13) <= 2e-12


@pytest.mark.parametrize("alpha", NEAR)
def test_ends_that_pass_through_their_meeting_point(alpha):
    """What is smooth there is determined by differences far below the rounding of its entries."""
    times, between = [0.0, 0.3, 0.62, 1.0], [[2.0, 0.5, 0.0], [2.0, 0.5, 0.0]]
    first, last = periodic(alpha, 3, [0.0, 1.0])
    jets = [first, *between, last]
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert error(plan, Direct(times, jets, alpha, digits=250), order=2, ntime=13) <= 1e-12


@pytest.mark.parametrize("alpha", NEAR)
@pytest.mark.parametrize("gamma", [0.4, 2.9])
def test_an_explicit_gamma(alpha, gamma):
    times, jets = [0.0, 0.4, 1.0], [[1, 0, 0], [3, 1], [1, 0, 0]]
    plan = TrigSpline(waypoints(times, jets), alpha=alpha, gamma=gamma)
    assert error(plan, Direct(times, jets, alpha, gamma=gamma, digits=250), order=2, ntime=13) <= 1e-12


@pytest.mark.slow
def test_every_axis_by_its_own_data():
    """One axis closes, one does not, one leaves an entry free."""
    alpha, times = 6.2831, [0.0, 0.4, 0.7, 1.0]
    axes = {
        "x": [[1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 0, 0]],
        "y": [[1, 0, 0], [2, 0, 0], [0, 1, 0], [4, 0, 0]],
        "z": [[1, 0, 0], [2, None, 0], [0, 1, 0], [1, 0, 0]],
    }
    points = [Waypoint.from_jets(t, **{k: v[i] for k, v in axes.items()}) for i, t in enumerate(times)]
    plan = TrigSpline(points, alpha=alpha)
    for name, jets in axes.items():
        assert error(plan.select([name]), Direct(times, jets, alpha, digits=250), order=2, ntime=13) <= 1e-12
    moved = plan.with_values([*points[:-1], Waypoint.from_jets(1.0, x=[2, 0, 0], y=[1, 0, 0], z=[1, 0, 0])])
    jets = [*axes["y"][:-1], [1, 0, 0]]  # now this one closes, and x does not
    assert error(moved.select(["y"]), Direct(times, jets, alpha, digits=250), order=2, ntime=13) <= 1e-12


@pytest.mark.parametrize("degree", [6, 9])
def test_spare_harmonics_approach_a_limit(degree):
    """The limit is regular: plans at 2 pi - d and 2 pi - d/10 differ by O(d)."""
    points = waypoints([0, 0.4, 1], [[1, 0, 0], [3, 1], [1, 0, 0]])
    t = np.linspace(0, 1, 101)
    plans = [TrigSpline(points, alpha=2 * math.pi - d, degree=degree)(t) for d in (1e-3, 1e-4, 1e-5, 1e-6)]
    steps = [np.abs(a - b).max() for a, b in itertools.pairwise(plans)]
    assert steps[0] < 0.1
    assert steps[1] < 0.2 * steps[0]
    assert steps[2] < 0.2 * steps[1]


@pytest.mark.parametrize("alpha", NEAR)
@pytest.mark.parametrize("moving", [False, True])
def test_transitions(alpha, moving):
    times, horizon = [0.0, 2.0], 2.0
    jets = periodic(alpha / horizon, 3, times) if moving else [[1, 0.3, 2], [1, 0.3, 2]]
    made = Transition(2, horizon, alpha)
    s = np.linspace(0, horizon, 13)
    found = made.jet(made.coefficients(np.array(jets).reshape(6, 1)), s, 2)[:, 0]
    exact = Direct(times, jets, alpha, digits=250).jet(s, 2)
    assert (np.abs(found - exact) / np.abs(exact).max(axis=1, keepdims=True)).max() <= 1e-12


def test_a_transition_to_where_it_is_stays_there():
    """Ends at rest in one point, at the last alpha below 2 pi."""
    made = Transition(3, 1.0, math.nextafter(2 * math.pi, 0))
    rest = np.zeros((8, 1))
    rest[[0, 4]] = 0.1
    np.testing.assert_array_equal(made.jet(made.coefficients(rest), np.linspace(0, 1, 7), 0), 0.1)


@pytest.mark.parametrize("alpha", [0.0, 1.0, 5.5])
@pytest.mark.parametrize("gap", [2.0**-8, 2.0**-14, 2.0**-20, 2.0**-30])
def test_a_dwell_between_two_waypoints(gap, alpha):
    """Equal jets close together leave a smooth plan: its differences must not be those of rounding."""
    times, jets = [0, 0.5, 0.5 + gap, 1], [[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]]
    plan = TrigSpline(waypoints(times, jets), alpha=alpha)
    assert error(plan, Direct(times, jets, alpha, digits=250), order=2, ntime=13) <= 1e-11


def test_several_dwells():
    times = [0, 1e-4, 1, 1.0001, 2, 2.0001]
    jets = [[0, 0], [0, 0], [1, 0], [1, 0], [-1, 0], [-1, 0]]
    plan = PolySpline(waypoints(times, jets))
    assert error(plan, Direct(times, jets, 0.0, digits=250), order=2, ntime=13) <= 1e-11


@pytest.mark.parametrize("gap", [1e-6, 1e-9, 1e-11])
def test_close_times_are_not_rounded_as_parts_of_the_duration(gap):
    """The plan goes with the fifth power of the gap's inverse, which 1/30 of the duration cannot hold."""
    times, jets = [0.0, 7.0, 7.0 + gap, 30.0], [[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 0]]
    plan = PolySpline(waypoints(times, jets))
    assert error(plan, Direct(times, jets, 0.0, digits=250), order=2, ntime=13) <= 1e-11


@pytest.mark.parametrize("alpha", [0.0, 1.0, 6.28])
@pytest.mark.parametrize("offset", [1e6, 2.0**40])
def test_a_far_origin_costs_no_digit_of_what_moves(offset, alpha):
    """Entries free or not; the origin is a power of two so that every position is exact."""
    for free in (0, None):
        jets = [[0.0, 0, 0], [2.0, free, 0], [0.0, 0, 0]]
        far = [[jet[0] + offset, *jet[1:]] for jet in jets]
        near, moved = (TrigSpline(waypoints([0, 0.4, 1], rows), alpha=alpha) for rows in (jets, far))
        t = np.linspace(0, 1, 41)
        size = np.abs(near.jet(t, 3)).max(axis=2, keepdims=True)
        assert (np.abs(moved.jet(t, 3) - near.jet(t, 3)) / size)[1:].max() <= 1e-12
        assert np.abs(moved(t) - offset - near(t)).max() <= 2 * np.spacing(offset)


def test_a_loss_of_accuracy_is_stated():
    """Free entries are no triangle, and these close waypoints leave a smooth plan only by their differences."""
    rows = [[0, 0, 0, 0], [1, None, 0, 0], [1, None, 0, 0], [0, 0, 0, 0]]
    with pytest.raises(ValueError, match=r"got an estimated loss of \d\S*; waypoints so close .* move them apart"):
        PolySpline(waypoints([0, 0.5, 0.50001, 1], rows))
    alpha, times = 6.2831, [0.0, 0.3, 1.0]
    first, last = periodic(alpha, 5, [0.0, 1.0])
    jets = [[first[0], None, *first[2:]], [2.0], [last[0], None, *last[2:]]]
    with pytest.raises(ValueError, match=r"loss of \S+; near alpha = 2 pi .* lower alpha|relative singular value"):
        TrigSpline(waypoints(times, jets), alpha=alpha)


@pytest.mark.parametrize("free", [0, 1])
@pytest.mark.parametrize("gap", [0.1, 0.02, 0.005, 1e-3, 1e-4])
def test_what_is_returned_is_right(gap, free):
    """With free entries either the digits are there or the plan is rejected."""
    jets = [[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]]
    jets[1][1 + free] = jets[2][1 + free] = None
    times = [0, 0.5, 0.5 + gap, 1]
    try:
        plan = PolySpline(waypoints(times, jets))
    except ValueError:
        return
    assert error(plan, Direct(times, jets, 0.0, digits=250), order=2, ntime=13) <= 1e-6


def natural(alpha, times, positions):
    """Rest to rest through positions, each segment of the family (2) with m = 3, derivatives 1 to 4 continuous."""
    with mp.workdps(100):
        turn = mp.mpf(alpha)
        spans = [mp.mpf(b) - mp.mpf(a) for a, b in itertools.pairwise(times)]
        size, rows, known = 6 * len(spans), [], []

        def functions(u, k, span):
            angles = [(h, h * turn * u + k * mp.pi / 2) for h in (1, 2)]
            pairs = [h**k * f(x) for h, x in angles for f in (mp.cos, mp.sin)]
            values = [mp.mpf(k == 0), *pairs, 3**k * mp.sin(3 * turn * (u - mp.mpf(1) / 2) + k * mp.pi / 2)]
            return [v * (turn / span) ** k for v in values]

        def add(value, *parts):
            row = [mp.mpf(0)] * size
            for segment, u, k, sign in parts:
                for j, v in enumerate(functions(mp.mpf(u), k, spans[segment])):
                    row[6 * segment + j] = sign * v
            rows.append(row)
            known.append(mp.mpf(value))

        for k in range(3):
            add(positions[0] if k == 0 else 0, (0, 0, k, 1))
            add(positions[-1] if k == 0 else 0, (len(spans) - 1, 1, k, 1))
        for i in range(1, len(spans)):
            add(positions[i], (i - 1, 1, 0, 1))
            add(positions[i], (i, 0, 0, 1))
            for k in (1, 2, 3, 4):
                add(0, (i - 1, 1, k, 1), (i, 0, k, -1))
        found = mp.lu_solve(mp.matrix(rows), mp.matrix(known))

        def value(t, k):
            segment = min(int(np.searchsorted(times, t, side="right")) - 1, len(spans) - 1)
            u = (mp.mpf(t) - mp.mpf(times[segment])) / spans[segment]
            return float(mp.fdot(found[6 * segment : 6 * segment + 6], functions(u, k, spans[segment])))

        t = np.linspace(times[0], times[-1], 13)
        return t, np.array([[value(x, k) for x in t] for k in range(4)])


@pytest.mark.parametrize("alpha", [5.0, 6.2, 6.283, 6.28318])
@pytest.mark.parametrize("positions", [[0.0, 1.0, -1.0, 2.0], [1.0, 1.0, 2.0, 2.0], [1.0, 2.0, 2.0, 1.0]])
def test_one_spline_a_segment(positions, alpha):
    times = [0.0, 1.0, 2.5, 3.0]
    t, exact = natural(alpha, times, positions)
    inner = [Waypoint(a, b) for a, b in zip(times[1:-1], positions[1:-1], strict=True)]
    ends = [Waypoint(times[k], positions[k], 0, 0) for k in (0, -1)]
    plan = PiecewiseSpline([ends[0], *inner, ends[1]], alpha=alpha)
    scale = np.abs(exact).max(axis=1, keepdims=True)
    assert (np.abs(plan.jet(t, 3)[:, 0] - exact) / scale).max() <= 1e-11


def test_sine_and_cosine_of_many_digits():
    with decimal.localcontext(decimal.Context(60)), mp.workdps(70):
        for x in ("0", "1e-30", "-2.5", "3.141592653589793", "6.283185307179586"):
            for ours, theirs in zip(_sin_cos(decimal.Decimal(x)), (mp.sin(mp.mpf(x)), mp.cos(mp.mpf(x))), strict=True):
                assert abs(mp.mpf(str(ours)) - theirs) < mp.mpf(10) ** -55


@pytest.mark.parametrize("gap", [1e-5, 1e-7, 1e-10])
@pytest.mark.parametrize("alpha", [6.28, 6.2831853, 2.0 * np.pi * (1.0 - 2e-16)])
def test_a_waypoint_near_the_end_is_near_the_start_too(alpha, gap):
    """On the circle: products of alpha and times near a whole turn have inaccurate sines."""
    for times, jets in (
        ([0.0, 1.0, 4.0 - gap, 4.0], [[1.0, 0.0, 0.0], [2.0], [1.1], [1.0, 0.0, 0.0]]),
        ([0.0, gap, 2.0, 4.0], [[1.0, 0.0], [2.0], [1.1], [5.0, 0.0]]),
    ):
        plan = TrigSpline(waypoints(times, jets), alpha=alpha, warn=False)
        t = np.linspace(0.0, 4.0, 17)
        exact = Direct(times, jets, alpha, digits=150).jet(t, 2)
        assert (np.abs(plan.jet(t, 2)[:, 0] - exact).max(axis=1) <= 1e-12 * np.abs(exact).max(axis=1)).all()
