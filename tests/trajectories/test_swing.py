"""A plan that swings far beyond its waypoints says so, with the swing measured."""

import math
import re
import warnings

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.trajectories import (
    PiecewiseSpline,
    PolySpline,
    TrigSpline,
    Waypoint,
    load_trajectory,
    newton_spline,
    piecewise,
)
from ctrlplan.trajectories.newton import NewtonSystem

REST = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]


def quintic_family(alpha, t):
    """Rest-to-rest move with y = y' = y'' = 0 at the start: (2) with m = 3, solved directly."""
    tau = alpha * np.asarray(t)

    def row(at, nu):
        turned = [k * at + nu * math.pi / 2 for k in (1, 2)]
        pairs = [k**nu * f(x) for k, x in zip((1, 2), turned, strict=True) for f in (np.cos, np.sin)]
        top = 3**nu * np.sin(3 * (at - alpha / 2) + nu * math.pi / 2)
        return [np.full(np.shape(at), float(nu == 0)), *pairs, top]

    matrix = np.array([[float(v) for v in row(np.array(at), nu)] for at in (0.0, alpha) for nu in range(3)])
    return np.linalg.solve(matrix, [0, 0, 0, 1, 0, 0]) @ np.array(row(tau, 0))


@pytest.mark.parametrize("alpha", [4.6, 5.0, 5.5])
def test_the_swing_is_measured(alpha):
    """Against (2) solved directly on a fine grid."""
    true = np.ptp(quintic_family(alpha, np.linspace(0, 1, 4001)))
    with pytest.warns(UserWarning, match=r"swings over .* times the range of its waypoints: y from") as caught:
        TrigSpline(REST, alpha=alpha)
    said = float(re.search(r"over (\S+) times", str(caught[0].message))[1])
    assert said == pytest.approx(true, rel=0.1)
    assert caught[0].filename == __file__


def test_a_polynomial_through_many_waypoints_swings():
    """Lagrange's polynomial through alternating values at 40 even times, by its first interval's middle."""
    points = [Waypoint(float(k), (-1.0) ** k) for k in range(40)]
    with pytest.warns(UserWarning, match="use PiecewiseSpline, one polynomial per segment") as caught:
        plan = PolySpline(points)
    t, others = 0.5, np.arange(40)
    value = sum(
        (-1.0) ** k * math.prod((t - j) / (k - j) for j in others if j != k) for k in range(40)
    )  # of this size one digit is enough
    assert float(plan(0.5)) == pytest.approx(value, rel=1e-6)
    said = float(re.search(r"over (\S+) times", str(caught[0].message))[1])
    assert 0.5 * abs(value) / 2.0 <= said <= 4.0 * abs(value) / 2.0


@pytest.mark.parametrize("alpha", [5.0, 6.0])
def test_one_spline_a_segment_swings_too(alpha):
    points = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0), Waypoint(3, 0, 0, 0)]
    with pytest.warns(UserWarning, match="lower alpha from"):
        PiecewiseSpline(points, alpha=alpha)
    PiecewiseSpline(points, alpha=alpha, warn=False)
    PiecewiseSpline(points, alpha=3.0)


def test_the_axis_that_swings_is_named():
    points = [Waypoint.from_jets(0, x=[0, 0, 0], lift=[1, 0, 0]), Waypoint.from_jets(1, x=[0, 0, 0], lift=[2, 0, 0])]
    with pytest.warns(UserWarning, match="waypoints: lift from"):
        TrigSpline(points, alpha=5.0)


def test_values_given_later_are_checked_as_well():
    still = TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(1, 0, 0, 0)], alpha=5.0)
    for made in (still.with_values, still.through):
        with pytest.warns(UserWarning, match="swings over 21") as caught:
            made(REST)
        assert caught[0].filename == __file__
    segments = PiecewiseSpline(still.waypoints, alpha=5.0)
    for made in (segments.with_values, segments.through):
        with pytest.warns(UserWarning, match="swings over 2") as caught:
            made(REST)
        assert caught[0].filename == __file__


def test_declined_once_it_stays_silent(tmp_path):
    plan = TrigSpline(REST, alpha=5.0, warn=False)
    for same in (plan.with_values(REST), plan.through(REST), plan.retime(2.0), plan.shift(1.0)):
        same.with_values(same.waypoints)
    plan.save(tmp_path / "plan.json")
    assert "warn" not in (tmp_path / "plan.json").read_text()
    loaded = load_trajectory(tmp_path / "plan.json")  # whoever made it has been warned
    np.testing.assert_array_equal(loaded([0.2, 0.7]), plan([0.2, 0.7]))
    with pytest.warns(UserWarning, match="swings"):
        loaded.through(REST)
    PolySpline([Waypoint(float(k), (-1.0) ** k) for k in range(40)], warn=False)


def test_a_closed_plan_is_checked_over_its_whole_round():
    points = [Waypoint(0.1 * k, (-1.0) ** k, 0) for k in range(5)]  # half of the round is left to swing in
    with pytest.warns(UserWarning, match="swings"):
        plan = TrigSpline.cyclic(points, 1.0)
    TrigSpline.cyclic(points, 1.0, warn=False)
    assert np.ptp(plan(np.linspace(0, 1, 1001))) > 6.0


def test_the_extrapolation_of_derivatives_is_no_swing():
    """A throw up and down: its height is v T/4, of waypoints at one position."""
    for speed in (1e-3, 1.0, 1e6):
        PolySpline([Waypoint(0, 5, speed), Waypoint(2, 5, -speed)])
    PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 0, 3, 0), Waypoint(2, 0, 0, 0)])


def test_rounding_of_the_positions_is_no_range():
    TrigSpline([Waypoint(0, 5, 0, 0), Waypoint(1, np.nextafter(5, 6), 0, 0)], alpha=5.0)


@pytest.mark.slow
def test_choosing_alpha_warns_of_the_choice_only():
    found = cp.choose_alpha(REST, "peak_jerk")
    assert found.alpha < 3.0
    cp.choose_alpha(REST, family=PiecewiseSpline)
    TrigSpline(REST, alpha="auto")
    PiecewiseSpline(REST, alpha="auto")
    with pytest.warns(UserWarning, match="swings") as caught:  # an objective that wants a swing
        cp.choose_alpha(REST, lambda plan: -float(np.ptp(plan(np.linspace(0, 1, 101)))))
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cp.choose_alpha(REST, lambda plan: -float(np.ptp(plan(np.linspace(0, 1, 101)))), warn=False)


# The bound that decides whether a swing is measured


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0, 3.0, 3.5, 5.0, 6.2])
def test_ranges_of_functions_are_bounded(alpha):
    """Against 2001 values of each function; with nodes at the ends only, the bound is the range up to alpha = pi."""
    rng = np.random.default_rng(1)
    for case in range(24):
        inner = rng.uniform(0.0, 1.0, case % 4)
        times = np.sort(np.append(inner, [0.0, 1.0]))
        given = tuple(tuple(range(count)) for count in rng.integers(1, 4, times.size).tolist())
        system = NewtonSystem(alpha, times, given)
        values = system.taylor(np.linspace(0.0, 1.0, 2001), 0)[:, 0]
        ranges = np.ptp(values[1:], axis=1)
        assert (ranges <= np.array(system.ranges) * (1.0 + 1e-12)).all()
        assert (ranges <= system.coarse_ranges[1:] * (1.0 + 1e-12)).all()
        if not inner.size and not alpha and len(set(given)) == 1:
            np.testing.assert_allclose(ranges, system.coarse_ranges[1:], rtol=1e-5)
        if not inner.size and alpha <= math.pi and len(set(given)) == 1:
            np.testing.assert_allclose(ranges, system.ranges, rtol=1e-5)
        grid = system.taylor(np.linspace(0.0, 1.0, 2 * system.size + 1), 0)[:, 0]
        np.testing.assert_allclose(system.functions, grid, rtol=0, atol=1e-13 * np.abs(grid).max())


@pytest.mark.parametrize("alpha", [0.0, 1.0, 3.0, 4.5, 5.5])
def test_the_bound_lets_no_swing_pass(alpha):
    """Random moves warn where the range at 1001 times is above 3 times that of the data, and only there."""
    rng = np.random.default_rng(2)
    for case in range(40):
        n = 2 + case % 5
        times = np.cumsum(rng.uniform(0.3, 2.0, n))
        points = [Waypoint(float(t), rng.normal(), 0 if i in (0, n - 1) else None) for i, t in enumerate(times)]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            plan = TrigSpline(points, alpha=alpha) if alpha else PolySpline(points)
        swing = np.ptp(plan(np.linspace(times[0], times[-1], 1001))) / np.ptp([w.position[0] for w in points])
        assert len(caught) <= 1
        if not 2.8 < swing < 3.2:  # measured on a grid, and relative to the velocities as well
            assert bool(caught) == (swing > 3.0), swing


@pytest.mark.parametrize("alpha", [0.0, 1.0, 3.1])
def test_the_bounds_of_piecewise_splines_let_no_swing_pass(alpha):
    """Where a swing is excluded, the range at 301 times a segment is at most 3 times that of the positions."""
    rng = np.random.default_rng(3)
    decided = [0, 0]
    for case in range(200):
        n, naxes = 2 + case % 6, 1 + case % 3
        times = np.cumsum(rng.uniform(0.3, 2.0, n))
        rows = rng.normal(size=(naxes, 3, n)) * rng.choice([0.03, 0.3, 3.0], (1, 3, 1))
        if case % 2:
            rows[:, 1:, 1:-1] = np.nan
        plan = PiecewiseSpline.from_arrays(
            times, rows[:, 0], derivatives={1: rows[:, 1], 2: rows[:, 2]}, alpha=alpha, warn=False
        )
        spans = np.ptp(rows[:, 0], axis=1)
        values = plan(np.linspace(times[0], times[-1], 300 * (n - 1) + 1)).reshape(naxes, -1)
        excluded = plan._is_small(), plan._stays_near()
        if any(excluded):
            assert (np.ptp(values, axis=1) <= 3.0 * spans).all()
        decided = [count + own for count, own in zip(decided, excluded, strict=True)]
    assert decided[0] > 5 or alpha > 3.0
    assert decided[0] < decided[1] < 200


def test_a_plan_with_a_free_position_is_measured(monkeypatch):
    """Along a line: what is added to it is 0, but it leads further than the positions that are prescribed."""
    measured = []
    monkeypatch.setattr(piecewise, "warn_of_swing", lambda *given: measured.append(given))
    for count in (4, 60):
        points = [Waypoint(float(k), k if k else np.nan, 1) for k in range(count)]
        assert float(PiecewiseSpline(points)(0.0)) == pytest.approx(0.0, abs=1e-12)
    assert len(measured) == 2


@pytest.mark.parametrize("warn", [True, False])
@pytest.mark.parametrize(
    "make", [PolySpline, lambda points, warn: TrigSpline(points, alpha=2.0, warn=warn), PiecewiseSpline]
)
def test_coefficients_that_overflow_are_rejected_with_and_without_the_check(make, warn):
    points = [Waypoint(0, 0, 1e300, 0), Waypoint(1e10, 1, 0, 0)]
    with pytest.raises(ValueError, match="within floating point"):
        make(points, warn=warn)


@pytest.mark.parametrize("make", [PolySpline, lambda points: TrigSpline(points, alpha=2.0), PiecewiseSpline])
def test_moves_from_rest_to_rest_are_decided_by_the_bound(make, monkeypatch):
    def measured(*_given):
        raise AssertionError("the swing was measured")

    monkeypatch.setattr(newton_spline, "warn_of_swing", measured)
    monkeypatch.setattr(newton_spline, "within", measured)
    monkeypatch.setattr(piecewise, "warn_of_swing", measured)
    for order in (1, 2):
        make([Waypoint(0, 3, *[0] * order), Waypoint(2, -5, *[0] * order)])
    make([Waypoint(0, [0, 1], 0, 0), Waypoint(1, [1, 0], 0, 0)])


@pytest.mark.parametrize("alpha", [0.0, 1.0])
@pytest.mark.parametrize("count", [3, 4])
def test_samples_of_a_sine_are_decided_by_the_bound(alpha, count, monkeypatch):
    """Three and four waypoints with two derivatives; one that is moved away is measured."""
    measured = []
    monkeypatch.setattr(newton_spline, "within", lambda *given: measured.append(given) or True)
    times = np.linspace(0.3, 0.3 + 1.1 * (count - 1), count)
    rows = np.sin([times, times + 0.5 * np.pi, times + np.pi])
    TrigSpline([Waypoint(t, *row) for t, row in zip(times, rows.T, strict=True)], alpha=alpha)
    assert not measured
    rows[1, 1] = 100.0
    TrigSpline([Waypoint(t, *row) for t, row in zip(times, rows.T, strict=True)], alpha=alpha)
    assert len(measured) == 1


def test_the_advice_names_what_to_call():
    points = [Waypoint(float(k), (-1.0) ** k) for k in range(40)]
    with pytest.warns(UserWarning, match="over .* times the range .* PiecewiseSpline, .*or fit for samples"):
        PolySpline(points)
    with pytest.warns(UserWarning, match="lower alpha from 5 .*PiecewiseSpline, .*or fit for samples"):
        TrigSpline(REST, alpha=5.0)
    with pytest.warns(UserWarning, match="lower alpha from 5, or use fit for samples"):
        PiecewiseSpline(REST, alpha=5.0)
