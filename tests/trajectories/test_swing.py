"""A plan that swings far beyond its waypoints says so, with the swing measured."""

import math
import re
import warnings

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.trajectories import PiecewiseSpline, PolySpline, TrigSpline, Waypoint, load_trajectory

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
