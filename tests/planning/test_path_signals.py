"""Fastest time law on a path under limits of quantities: against nonlinear programs on fine grids, and closed forms."""

import math

import numpy as np
import pytest
from path_program import optimum
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan import PolySpline, TrigSpline, Waypoint, fastest
from ctrlplan.studies.crane import CRANE, nominal_waypoints, obstacle_waypoints

HOIST = PolySpline(nominal_waypoints(5))
OBSTACLE = TrigSpline(obstacle_waypoints(), alpha=4.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plan", "limits"),
    [
        (HOIST, {"F": 30e3, "theta": 0.5}),
        (OBSTACLE, {"theta": 0.08, "velocity": 3.0}),
    ],
)
def test_a_crane_is_as_fast_as_by_a_nonlinear_program(plan, limits):
    found = fastest(plan, limits, CRANE, hold="path")
    best = optimum(plan, fastest(plan, limits, CRANE).duration, limits)
    assert found.duration == pytest.approx(best, rel=0.006)
    assert found.margins.satisfied
    assert found.active.fraction == pytest.approx(0.0, abs=1e-8)
    values = CRANE.quantities(found.plan.jet(np.linspace(found.plan.start, found.plan.end, 20_001), 4))
    for name in limits.keys() & {"F", "theta"}:
        assert np.abs(values[name]).max() <= limits[name] * (1 + 1e-8)


@pytest.mark.slow
def bang_bang(limit):
    """Minimum duration of a move of 1 with y' + y''/2 = u and abs(u) <= limit: one change of sign at t_1."""
    # The velocity is L (1 - exp(-2 t_1)) at t_1, and 0 after a further t_2; u has the integral L (t_1 - t_2) = 1.
    t2 = brentq(lambda t2: math.log(2.0 - math.exp(-2.0 * (1.0 / limit + t2))) / 2.0 - t2, 0.0, 1.0, xtol=1e-15)
    return 1.0 / limit + 2.0 * t2


@pytest.mark.parametrize("limit", [1e-8, 1e-3, 1.0, 366.524, 1000.0, 7e3])
def test_a_force_of_any_size_is_a_time_law_of_its_own(limit):
    move = PolySpline([Waypoint(0, 0, 0, 0, 0, 0), Waypoint(2, 1, 0, 0, 0, 0)])
    found = fastest(move, {"u": limit}, lambda jet: {"u": jet[1, 0] + 0.5 * jet[2, 0]}, hold="path")
    assert found.margins.satisfied
    assert bang_bang(limit) <= found.duration <= 1.01 * bang_bang(limit)


@pytest.mark.parametrize("duration", [1e-9, 1e-4, 1e5, 1e12])
def test_the_time_law_does_not_depend_on_the_duration_of_the_given_plan(duration):
    move = PolySpline([Waypoint(0, 0, 0, 0, 0, 0), Waypoint(duration, 1, 0, 0, 0, 0)])
    found = fastest(move, {"u": 1.0}, lambda jet: {"u": jet[1, 0] + 0.5 * jet[2, 0]}, hold="path")
    assert bang_bang(1.0) <= found.duration <= 1.01 * bang_bang(1.0)


def test_a_linear_quantity_is_a_limit_of_its_derivative():
    """A force of 3 times the acceleration: the trapezoid."""
    move = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 4, 0, 0)])
    found = fastest(move, {"force": 3.0, "y_d1": 1.0}, lambda jet: {"force": 3.0 * jet[2, 0]}, hold="path")
    assert 5.0 * (1 - 1e-6) <= found.duration <= 5.0 * 1.006


@pytest.mark.slow
def test_speed_and_torque_in_a_region():
    """Acceleration 3 - 0.3 v while speeding up, 3 while braking: v = 10 (1 - exp(-0.3 t))."""
    corners = [(0, 3), (10, 0), (0, -3), (-10, 0)]
    move = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 10, 0, 0)])
    found = fastest(move, {"motor": cp.Region(("y_d1", "y_d2"), corners)}, hold="path")
    jet = found.plan.jet(np.linspace(found.plan.start, found.plan.end, 20_001), 2)[:, 0]
    assert (np.abs(jet[1]) / 10 + np.abs(jet[2]) / 3).max() <= 1 + 1e-9
    # From both ends to the speed at which the ways add up; braking is bounded by 3 - 0.3 v as well.
    t = np.linspace(0, 4, 400_001)
    way = 10 * t - (10 / 0.3) * (1 - np.exp(-0.3 * t))
    best = 2 * t[np.searchsorted(way, 5.0)]
    assert best * (1 - 1e-4) <= found.duration <= best * 1.006


def test_a_closed_plan_stays_closed():
    cycle = TrigSpline.cyclic([Waypoint(0, [0, 0]), Waypoint(1, [3, 0]), Waypoint(2, [1, 2])], 3.0)
    found = fastest(cycle, {"speed": 2.0}, lambda jet: {"speed": np.hypot(jet[1, 0], jet[1, 1])}, hold="path")
    first, last = found.plan.jet(found.plan.start, 3), found.plan.jet(found.plan.end, 3, left=True)
    scale = np.abs(found.plan.jet(np.linspace(found.plan.start, found.plan.end, 101), 3)).max(axis=(1, 2))
    np.testing.assert_allclose(first / scale[:, None], last / scale[:, None], rtol=0, atol=1e-9)
    t = np.linspace(cycle.start, cycle.end, 200_001)
    length = np.hypot(*cycle(t, 1)).mean() * cycle.duration
    assert length / 2.0 * (1 - 1e-6) <= found.duration <= length / 2.0 * 1.006


@pytest.mark.slow
@pytest.mark.parametrize("order", [4, 5])
def test_a_higher_derivative_alone_in_closed_form(order):
    """1 m from rest to rest with abs(y^(k)) <= M: 1 = M T^k 2^(2 - 2 k)/(k - 1)!, by polynomials of minimum L1 norm."""
    rest = [0.0] * order
    move = PolySpline([Waypoint.from_jets(0, y=[0.0, *rest]), Waypoint.from_jets(1, y=[1.0, *rest])])
    found = fastest(move, {f"y_d{order}": 1e3}, hold="path")
    best = (2.0 ** (2 * order - 2) * math.factorial(order - 1) / 1e3) ** (1 / order)
    assert best * (1 - 1e-9) <= found.duration <= 1.011 * best
    assert np.abs(found.plan(np.linspace(found.plan.start, found.plan.end, 20_001), order)).max() <= 1e3 * (1 + 1e-9)
    assert found.margins.satisfied


def resting(points):
    """Waypoints whose ends have four derivatives of 0."""
    still = [points[0], points[-1]]
    ends = [Waypoint.from_array(own.time, np.vstack([own.jet, np.zeros((2, 2))]), own.labels) for own in still]
    return [ends[0], *points[1:-1], ends[1]]


@pytest.mark.slow
def test_a_crane_over_an_obstacle_has_short_cells_where_it_speeds_up():
    """Duration 10.098 s of a nonlinear program: a cubic squared rate on 509 cells, limits at five points of each.

    With differences on an even grid such a program ends at 9.76 s, by squared rates from 1e-4 to 50 at every other
    node, which exceed the force between the nodes.
    """
    plan, limits = TrigSpline(resting(obstacle_waypoints()), alpha=4.0), {"F": 15e3, "theta": 0.1}
    found = fastest(plan, limits, CRANE, hold="path")
    assert found.duration <= 10.098
    assert found.margins.satisfied
    values = CRANE.quantities(found.plan.jet(np.linspace(found.plan.start, found.plan.end, 50_001), 4))
    for name, limit in limits.items():
        assert np.abs(values[name]).max() <= limit * (1 + 1e-8)
