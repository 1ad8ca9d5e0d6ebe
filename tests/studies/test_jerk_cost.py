"""The integral of a plan's squared jerk, in closed form; infinite where position, velocity or acceleration jumps."""

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies import standard_plans
from ctrlplan.studies.measures import jerk_cost, path_metrics

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]


def test_the_unit_quintic_costs_720():
    assert jerk_cost(cp.PolySpline(MOVE)) == pytest.approx(720.0, rel=1e-12)


@pytest.mark.parametrize(("alpha", "cost"), [(2.0, 781), (np.pi, 1521)])
def test_trigonometric_moves_cost_what_is_printed(alpha, cost):
    # With m = 3 and T = 1, to the whole number.
    assert jerk_cost(cp.TrigSpline(MOVE, alpha=alpha)) == pytest.approx(cost, abs=0.5)


@pytest.mark.parametrize(("height", "duration", "start"), [(3.0, 1.0, 0.0), (1.0, 10.0, 0.0), (-0.5, 1e-3, 1e3)])
def test_it_scales_with_height_and_duration(height, duration, start):
    plan = cp.PolySpline([cp.Waypoint(start, 0, 0, 0), cp.Waypoint(start + duration, height, 0, 0)])
    assert jerk_cost(plan) == pytest.approx(720.0 * height**2 / plan.duration**5, rel=1e-9)


def test_axes_add_up():
    plan = cp.stack([cp.PolySpline(MOVE, labels=["x"]), 3.0 * cp.PolySpline(MOVE, labels=["z"])])
    assert jerk_cost(plan) == pytest.approx(7200.0, rel=1e-12)


def test_legs_add_up():
    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0), cp.Waypoint(3, -1, 0, 0)]
    expected = 720.0 + 720.0 * 2**2 / 2**5
    assert jerk_cost(cp.PiecewiseSpline(points)) == pytest.approx(expected, rel=1e-12)
    first, second = (cp.PolySpline(points[i : i + 2]) for i in (0, 1))
    assert jerk_cost(first.then(second)) == pytest.approx(expected, rel=1e-12)


def test_a_septic_agrees_with_its_polynomial_integrated_by_hand():
    # 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7, whose jerk is 840 s - 5040 s^2 + 8400 s^3 - 4200 s^4.
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0, 0)])
    jerk = np.polynomial.Polynomial([0, 840, -5040, 8400, -4200])
    assert jerk_cost(plan) == pytest.approx((jerk**2).integ()(1.0), rel=1e-12)


def test_a_single_harmonic_has_its_closed_form():
    # (t - sin t)/(2 pi) over a turn: harmonic 1 beside a ramp; the jerk is cos t/(2 pi).
    class _Cycloid(cp.Trajectory):
        def __init__(self):
            self._set_fields(labels=("y",), breakpoints=np.array([0.0, 2 * np.pi]))

        def segment_jet(self, leg, s, order):
            rows = [(s - np.sin(s)), 1 - np.cos(s), np.sin(s), np.cos(s), -np.sin(s)]
            return np.array(rows[: order + 1])[:, None, :] / (2 * np.pi)

        def map_time(self, origin, shift, rate):
            raise NotImplementedError

        def to_dict(self):
            raise NotImplementedError

        @classmethod
        def from_dict(cls, data):
            raise NotImplementedError

    assert jerk_cost(_Cycloid()) == pytest.approx(1 / (4 * np.pi), rel=1e-12)


@pytest.mark.parametrize(
    ("points", "what"),
    [
        ([cp.Waypoint(0, 0, 1, 0), cp.Waypoint(1, 1, 0, 0)], "velocity at the start"),
        ([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 1, 0)], "velocity at the end"),
        ([cp.Waypoint(0, 0, 0, 1), cp.Waypoint(1, 1, 0, 0)], "acceleration at the start"),
        ([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 1)], "acceleration at the end"),
        ([cp.Waypoint(0, 0), cp.Waypoint(1, 1)], "velocity at both"),
        ([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)], "acceleration at both, left free"),
    ],
)
@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_a_jump_at_an_end_is_infinite(points, what, alpha):
    assert jerk_cost(cp.TrigSpline(points, alpha=alpha)) == np.inf, what


def test_a_jump_at_a_join_is_infinite():
    rest = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0), cp.Waypoint(2, 2, 0, 0)]
    velocity = cp.PolySpline(rest[:2]).then(cp.PolySpline([cp.Waypoint(1, 1, 1, 0), cp.Waypoint(2, 2, 0, 0)]))
    assert jerk_cost(velocity) == np.inf
    acceleration = cp.PolySpline(rest[:2]).then(cp.PolySpline([cp.Waypoint(1, 1, 0, 1), cp.Waypoint(2, 2, 0, 0)]))
    assert jerk_cost(acceleration) == np.inf
    assert np.isfinite(jerk_cost(cp.PolySpline(rest[:2]).then(cp.PolySpline(rest[1:]))))


def test_a_jump_of_one_axis_is_enough():
    calm = cp.PolySpline(MOVE, labels=["x"])
    jumping = 1e-3 * cp.PolySpline([cp.Waypoint(0, 0, 1, 0), cp.Waypoint(1, 1, 0, 0)], labels=["z"])
    assert jerk_cost(cp.stack([calm, jumping])) == np.inf


def test_an_axis_that_rests_costs_nothing():
    still = 0.0 * cp.PolySpline(MOVE, labels=["z"])
    assert jerk_cost(cp.stack([cp.PolySpline(MOVE, labels=["x"]), still])) == pytest.approx(720.0, rel=1e-12)


@pytest.mark.parametrize("height", [1e-9, 1e9])
@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_rounding_is_no_jump(height, offset):
    plan = cp.TrigSpline(
        [cp.Waypoint(0, offset * height, 0, 0), cp.Waypoint(1, (offset + 1) * height, 0, 0)], alpha=1.0
    )
    assert np.isfinite(jerk_cost(plan))


def test_a_step_takes_no_path_and_its_jerk_is_infinite():
    found = path_metrics(cp.Step(1.0), tuple(MOVE))
    assert found.pop("reference_jerk") == np.inf
    assert found
    assert all(np.isnan(value) for value in found.values())


def test_free_positions_leave_nothing_to_wander_from():
    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(0.4, np.nan, 2.0), cp.Waypoint(1, 1, 0, 0)]
    assert path_metrics(standard_plans(points)["polynomial"], tuple(points)) == {}
